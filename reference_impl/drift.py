"""How far the raw form (N6) leaves its constraints (E4): maxima per decade and fitted exponents.

A defect δ of γ of constant sign gives Ċ = δ t and C = δ t²/2.  Truncation changes sign and rounding walks,
so the exponents of a real run scatter below 1 and 2; both are measured here, none is assumed.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import stats

from reference_impl.chain import Array, Chain
from reference_impl.euler_parameters import dot
from reference_impl.integrate import integrate_dop853
from reference_impl.joints import ConstraintRows, constraint_rows

BINS_PER_DECADE = 4  # per decade, in the fit of the exponents


@dataclass(frozen=True, eq=False)
class DriftGrowth:
    """Growth of one error with time."""

    maxima: Array  # (K,) the largest in each decade, unit of the error
    exponent: float  # of t in a power law through the maxima of quarter decades
    half_interval: float  # half width of the exponent's 95 % confidence interval, for scatter about the law


@dataclass(frozen=True, eq=False)
class RawFormDrift:
    """Drift of one run of the raw form."""

    rtol: float
    decades: Array  # (K + 1,) s, their bounds
    joint_gap: DriftGrowth  # m, worst joint: ‖C‖ of a ball, |C|/2ℓ of a rod
    gap_rate: DriftGrowth  # m/s, likewise of Ċ
    norm: DriftGrowth  # –, worst body: |pᵀp − 1|
    steps: int


def measure_drift(
    chain: Chain,
    r: Array,
    p: Array,
    v: Array,
    pdot: Array,
    rtol: float,
    decades: Array,
    gamma_defect: float | Array = 0.0,
    samples: int = 100,
) -> RawFormDrift:
    """Integrate raw from r, ṙ (N, 3), p, ṗ (N, 4) at t = 0 and measure C, Ċ and pᵀp − 1.

    ``decades`` (K + 1,) s are the bounds of the decades, ascending, the last one is the end of the run;
    ``samples`` is the number of times looked at in each quarter decade.  Errors as `integrate`.
    """
    quarters = np.arange(BINS_PER_DECADE * (len(decades) - 1) + 1) / BINS_PER_DECADE
    bounds = 10 ** np.interp(quarters, np.arange(len(decades)), np.log10(decades))
    bounds[-1] = decades[-1]
    bins = [np.geomspace(a, b, samples + 1)[1:] for a, b in pairwise(bounds)]
    run = integrate_dop853(chain, r, p, v, pdot, np.concatenate([[0.0], *bins]), rtol, gamma_defect)
    states = zip(run.r, run.p, run.v, run.pdot, strict=True)
    gap, gap_rate = np.array([largest_joint_gaps(chain, *state) for state in states]).T
    norm = np.max(np.abs(dot(run.p, run.p) - 1), axis=1)
    largest = (x[1:].reshape(-1, samples).max(axis=1) for x in (gap, gap_rate, norm))
    gap_growth, rate_growth, norm_growth = (fit_growth(maxima, bounds[1:]) for maxima in largest)
    return RawFormDrift(rtol, decades, gap_growth, rate_growth, norm_growth, run.steps)


def largest_joint_gaps(chain: Chain, r: Array, p: Array, v: Array, pdot: Array) -> tuple[float, float]:
    """Joint gap, m, and gap rate, m/s, of the worst joint: C and Ċ of the notes, the rods' over 2 ℓ."""
    joints = constraint_rows(chain, r, p, v, pdot)
    return largest_row_norm(chain, joints, joints.C), largest_row_norm(
        chain, joints, joints.constraint_rate(v, pdot)
    )


def largest_row_norm(chain: Chain, joints: ConstraintRows, values: Array) -> float:
    """Largest joint norm of row values (c,), the rods' divided by 2 ℓ: metres out of m²."""
    scale = np.where(chain.rods, 2 * chain.length, 1.0)[joints.joint]
    squares = np.bincount(joints.joint, (values / scale) ** 2)
    return float(np.sqrt(np.max(squares)))


def fit_growth(maxima: Array, ends: Array) -> DriftGrowth:
    """Fit maxima ∝ t^exponent to the maxima of quarter decades that end at ``ends`` s; zeros take no part."""
    per_decade = maxima.reshape(-1, BINS_PER_DECADE).max(axis=1)
    seen = maxima > 0
    if np.count_nonzero(seen) < 3:
        return DriftGrowth(per_decade, 0.0, np.inf)
    fit = stats.linregress(np.log(ends[seen]), np.log(maxima[seen]))
    half = stats.t.ppf(0.975, np.count_nonzero(seen) - 2) * fit.stderr
    return DriftGrowth(per_decade, float(fit.slope), float(half))
