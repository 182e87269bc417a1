"""Stabilised variants beside the notes' raw form (E4), and the table of their drifts.

Baumgarte (Comput. Methods Appl. Mech. Eng. 1, 1972) takes γ − 2 a Ċ − a² C for γ, so that constraint errors
die as e^{−a t} in place of growing; projection moves the end of every step, and every sample, onto C = 0 and
Ċ = 0 in the metric of the mass matrix.  Neither stands in for the raw form: its drift is a result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reference_impl.collocation import DEFAULT_NODES, BatchIntegrationResult, integrate_collocation
from reference_impl.euler_parameters import angular_velocity
from reference_impl.integrate import IntegrationResult
from reference_impl.mechanism import Array, Mechanism
from reference_impl.structured import StructuredSystem, component_first

BAUMGARTE_RATE = 10.0  # 1/s
VARIANTS = ("raw", "baumgarte", "projected")


@dataclass(frozen=True)
class DriftRow:
    """The largest constraint and energy errors of one variant over [0, time]."""

    variant: str
    rtol: float
    time: float  # s
    gap: float  # m: a ball's ‖d‖, a rod's |‖d‖ − ℓ|
    gap_rate: float  # m/s: a ball's ‖ḋ‖, the rate of a rod's length
    norm: float  # |√(pᵀp) − 1|
    energy: float  # |E − E(0)| over the sum of m g (reach of the stretched chain)
    steps: int


def integrate_variant(
    variant: str,
    chain: Mechanism,
    r: Array,
    p: Array,
    v: Array,
    pdot: Array,
    times: Array,
    rtol: float,
    rate: float = BAUMGARTE_RATE,
    nodes: int = DEFAULT_NODES,
) -> BatchIntegrationResult:
    """Integrate one of `VARIANTS` by collocation.

    Args:
        variant: "raw", "baumgarte" or "projected".
        chain: the mechanism.
        r: initial positions (N, 3) [m], world frame.
        p: initial Euler parameters (N, 4).
        v: initial velocities ṙ (N, 3) [m/s], world frame.
        pdot: initial rates ṗ (N, 4) [1/s].
        times: sample times (T,) [s], ascending from the initial time.
        rtol: relative tolerance of the integration.
        rate: Baumgarte's a [1/s].
        nodes: of the collocation.

    Returns:
        The motion at ``times``.

    Raises:
        ValueError: there is no such variant.

    """
    if variant not in VARIANTS:
        raise ValueError(f"no variant {variant!r}; there are {VARIANTS}")
    return integrate_collocation(
        [chain],
        *(r, p, v, pdot),
        times,
        rtol,
        nodes=nodes,
        baumgarte=rate if variant == "baumgarte" else 0.0,
        project=variant == "projected",
    )


def drift_table(
    chain: Mechanism,
    r: Array,
    p: Array,
    v: Array,
    pdot: Array,
    rtols: Sequence[float] = (1e-6, 1e-9, 1e-12),
    times: Sequence[float] = (10.0, 100.0, 1000.0),
    samples: int = 40,
    variants: Sequence[str] = VARIANTS,
) -> list[DriftRow]:
    """Measure how far each variant leaves the constraints and its energy.

    Args:
        chain: the mechanism.
        r: initial positions (N, 3) [m], world frame.
        p: initial Euler parameters (N, 4).
        v: initial velocities ṙ (N, 3) [m/s], world frame.
        pdot: initial rates ṗ (N, 4) [1/s].
        rtols: relative tolerances of the integration.
        times: ends of the intervals [0, time] [s].
        samples: number of samples in each interval, of which the maxima are taken.
        variants: names from `VARIANTS`.

    Returns:
        A row for every variant, tolerance and time; its energy error is NaN with loads or drag.

    """
    grid = np.unique(np.concatenate([np.linspace(0, end, samples + 1) for end in times]))
    table = []
    for variant in variants:
        for rtol in rtols:
            motion = integrate_variant(variant, chain, r, p, v, pdot, grid, rtol)
            errors = np.stack([*constraint_errors(chain, motion), energy_error(chain, motion)])
            for end in times:
                gap, gap_rate, norm, energy = np.max(errors[:, grid <= end], axis=1).tolist()
                steps = round(motion.steps * end / times[-1])
                table.append(DriftRow(variant, rtol, end, gap, gap_rate, norm, energy, steps))
    return table


def constraint_errors(chain: Mechanism, motion: IntegrationResult) -> tuple[Array, Array, Array]:
    """Measure the constraint errors of a motion, of the worst joint or body at each sample.

    Args:
        chain: the mechanism.
        motion: T samples of it.

    Returns:
        Gap [m], gap rate [m/s] and |‖p‖ − 1|, (T,) each.

    """
    forest, found = StructuredSystem([chain]), []
    for state in zip(motion.r, motion.p, motion.v, motion.pdot, strict=True):
        d, rate = forest.joint_gaps(component_first(*state[:2]), component_first(*state[2:]))
        distance = np.sqrt(np.sum(d * d, axis=0))
        along = np.sum(d * rate, axis=0) / np.where(chain.rods, distance, 1.0)
        gap = np.where(chain.rods, np.abs(distance - chain.length), distance)
        gap_rate = np.where(chain.rods, np.abs(along), np.sqrt(np.sum(rate * rate, axis=0)))
        found.append((np.max(gap), np.max(gap_rate), np.max(np.abs(np.linalg.norm(state[1], axis=1) - 1))))
    gap, gap_rate, norm = np.array(found).T
    return gap, gap_rate, norm


def energy_error(chain: Mechanism, motion: IntegrationResult) -> Array:
    """Measure the change of the energy.

    Args:
        chain: the mechanism.
        motion: T samples of it.

    Returns:
        |E − E(0)| (T,) over Σ m g (reach of the stretched chain); NaN with loads or drag.

    """
    if any(np.any(x) for x in (chain.force, chain.moment, chain.drag_force, chain.drag_moment)):
        return np.full(len(motion.t), np.nan)
    omega = angular_velocity(motion.p, motion.pdot)
    spin = np.einsum("tki,kij,tkj->t", omega, chain.inertia, omega)
    energy = (np.einsum("k,tki,tki->t", chain.mass, motion.v, motion.v) + spin) / 2
    energy -= np.einsum("k,tki,i->t", chain.mass, motion.r, chain.gravity)
    near, far = np.linalg.norm(chain.proximal, axis=1), np.linalg.norm(chain.distal, axis=1)
    hang = np.cumsum(chain.length + near) + np.concatenate([[0.0], np.cumsum(far)[:-1]])
    scale = float(np.sum(chain.mass * hang) * np.linalg.norm(chain.gravity))
    return np.asarray(np.abs(energy - energy[0]) / scale)
