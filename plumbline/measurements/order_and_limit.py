"""Step refinement: observed order, extrapolated limit and its uncertainty.

A refinement study is the same motion at steps h, h/2, h/4, …, sampled at times that every step hits.
Source: Romberg's scheme for an error expansion with known powers of h; E. Hairer,
S. P. Nørsett, G. Wanner, Solving Ordinary Differential Equations I, II.9.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plumbline.model.datatypes import Array, Float, Integrator

ORDER_MARGIN = 0.1  # two consecutive orders this near to the declared one show it (verification.md)
ORDER_CHANGE_FACTOR = 3.0  # three consecutive orders this many of their changes away show another order
ROUNDING_FLOOR_FACTOR = 32.0  # a difference this many times rounding gives its order to 0.05: log2(1 + 1/32)
MAX_RISE = 1.5  # of errors from run to run where they fall on the whole: coarse runs may be of any error
STEP_EXPONENTS = {1: (9, 15), 2: (8, 12), 4: (5, 12)}  # by order: coarsest and finest step, -log2 of seconds
MAX_BODY_STEPS = 2**19  # most steps × bodies of the finest run, without extra refinements
RTOL_FACTORS = 1e2, 1.0  # relative tolerances of an adaptive method, over its tightest: no verdict needs more


def step_unit(sample_interval: float, duration: float, coarsest: int) -> float:
    """Return the unit of the steps 2^−k, k ≥ ``coarsest``, that hit every sample.

    Args:
        sample_interval: time between samples [s].
        duration: length of the motion [s].
        coarsest: k of the coarsest step.

    Returns:
        ``sample_interval`` times the power of two that brings it next to 1 [s], 1 for a power of two; in
        proportion to a duration below 1 s where the coarsest step would be longer than the sample interval.

    """
    unit = float(sample_interval * 2.0 ** -round(np.log2(sample_interval)))
    if unit * 2.0**-coarsest > sample_interval:
        unit *= 2.0 ** int(np.floor(np.log2(min(duration, 1.0))))
    return unit


def refinement_resolutions(
    integrator: Integrator,
    bodies: int,
    duration: float,
    extra_refinements: int = 0,
    sample_interval: float = 1.0,
) -> list[float]:
    """Choose the resolutions of a refinement study.

    Args:
        integrator: has fixed steps of an order, or a tolerance.
        bodies: number of bodies; long chains stop where the finest run would pass `MAX_BODY_STEPS`.
        duration: length of the motion [s].
        extra_refinements: how many times the finest step is halved beyond that (in the nightly).
        sample_interval: time between samples [s].

    Returns:
        From coarse to fine at least four steps [s], powers of two of `step_unit`; or two relative tolerances.

    """
    if integrator.kind == "tolerance":
        return [integrator.min_rtol * factor for factor in RTOL_FACTORS]
    coarse, fine = STEP_EXPONENTS[integrator.order]
    affordable = int(np.floor(np.log2(MAX_BODY_STEPS / (bodies * max(duration, 1.0)))))
    fine = max(min(fine, affordable), coarse + 3) + extra_refinements
    unit = step_unit(sample_interval, duration, coarse)
    return [unit * 2.0**-k for k in range(coarse, fine + 1)]


def max_norm(y: Float[Array, "... width"]) -> float:
    """Return the largest Euclidean norm over all leading axes.

    Returns:
        The norm; inf where any component is not finite.

    """
    size = float(np.max(np.linalg.norm(y, axis=-1), initial=0.0))
    return size if np.isfinite(size) else np.inf


def falls_with_resolution(errors: Sequence[float], floor: float) -> bool:
    """Find out whether the errors of runs fall, however slowly, as their resolution is made finer.

    Args:
        errors: of each run, coarse to fine; runs whose error is not finite are left out.
        floor: what rounding explains.

    Returns:
        Whether the last one is at most half of the first, and none above `MAX_RISE` times the one before it;
        or rounding.

    """
    finite = [error for error in errors if np.isfinite(error)]
    if len(finite) < 2:
        return True
    pairs = [(*pair, MAX_RISE) for pair in itertools.pairwise(finite)] + [(finite[0], finite[-1], 0.5)]
    return all(fine <= max(floor, factor * coarse) for coarse, fine, factor in pairs)


@dataclass(frozen=True)
class ObservedOrder:
    """The order of a refinement study in one window of time."""

    value: float | None  # the last trusted order; None where nothing could be observed
    is_asymptotic: bool  # two consecutive orders near the declared one, or three that stay away from it
    is_at_rounding_floor: bool  # differences are rounding at every step, so no order can be observed
    orders: tuple[float, ...]  # all consecutive ones, coarse to fine
    differences: tuple[float, ...]  # between consecutive steps


def observed_order(
    ys: Sequence[Float[Array, "samples bodies width"]], floor: float, declared: int
) -> ObservedOrder:
    """Observe the order from consecutive differences D_k = max |y_k - y_{k+1}|, as log2(D_k / D_{k+1}).

    The finest pair of consecutive orders that are both within `ORDER_MARGIN` of the declared one shows that
    order; else the finest three may show one (`extrapolated_order`).

    Args:
        ys: samples of each run, coarse to fine, steps halving.
        floor: rounding, in the unit of the samples. Only differences above `ROUNDING_FLOOR_FACTOR` times it
            count: rounding changes their order by less than half the margin.
        declared: the method's theoretical order.

    Returns:
        The order, and whether it can be trusted.

    """
    differences = [max_norm(a - b) for a, b in itertools.pairwise(ys)]
    orders = []
    for coarse, fine in itertools.pairwise(differences):
        usable = 0 < coarse < np.inf and fine > ROUNDING_FLOOR_FACTOR * floor
        orders.append(float(np.log2(coarse / fine)) if usable else np.nan)
    at_floor = all(d <= ROUNDING_FLOOR_FACTOR * floor for d in differences)
    near = [
        b
        for a, b in itertools.pairwise(orders)
        if abs(a - declared) <= ORDER_MARGIN and abs(b - declared) <= ORDER_MARGIN
    ]  # NaN compares false
    trusted = [k for k, order in enumerate(orders) if np.isfinite(order)]
    last = orders[trusted[-1] - 2 : trusted[-1] + 1] if trusted and trusted[-1] >= 2 else []
    shown = near[-1] if near else extrapolated_order(last, declared)
    if shown is not None:
        return ObservedOrder(shown, True, False, tuple(orders), tuple(differences))
    finite = [order for order in orders if np.isfinite(order)]
    return ObservedOrder(finite[-1] if finite else None, False, at_floor, tuple(orders), tuple(differences))


def extrapolated_order(last: Sequence[float], declared: int) -> float | None:
    """Extrapolate the three finest observed orders.

    Observed orders are off by c h + …: where two halvings of the step have each about halved the distance to
    the declared order, and the next halving leads to it, they show that order.  Where it leads elsewhere, the
    distance does not halve yet.  Where three orders stay away from the declared one by many times their own
    changes, the method has another order.

    Args:
        last: the three finest orders, coarse to fine; fewer where there are not as many.
        declared: the method's theoretical order.

    Returns:
        The order; None where the three allow no conclusion.

    """
    if len(last) < 3 or not np.all(np.isfinite(last)):
        return None
    left = np.asarray(last) - declared
    halved = bool(np.all(np.abs(left[1:] / left[:-1] - 0.5) <= 0.2))
    following = 2 * last[2] - last[1]
    if halved and abs(left[2]) <= 2 * ORDER_MARGIN and abs(following - declared) <= ORDER_MARGIN:
        return float(following)
    changes = abs(last[1] - last[0]) + abs(last[2] - last[1])
    return float(last[2]) if abs(left[2]) > ORDER_MARGIN + ORDER_CHANGE_FACTOR * changes else None


@dataclass(frozen=True, eq=False)
class ExtrapolatedLimit:
    """The motion at step zero, extrapolated from all runs."""

    y: Float[Array, "samples bodies width"]
    uncertainty: Float[Array, "samples"]  # running maximum over time, same unit
    eliminated_powers: int  # how many powers were eliminated


def romberg(ys: Sequence[Float[Array, "samples bodies width"]], powers: Sequence[int]) -> ExtrapolatedLimit:
    """Extrapolate to step zero (Romberg), for errors with known powers of h.

    Column m of the scheme has the first m powers eliminated.  Its uncertainty is the larger of its distances
    to its row before the last and to the column before: the errors of those, so an overestimate where the
    study converges, and the size of the noise where it does not (column 0, which has no column before,
    takes twice the first distance).  The column with the smallest uncertainty is the limit.

    Args:
        ys: samples of each run, coarse to fine, steps halving; runs before the last one that is
            not finite are left out.
        powers: exponents of h in the error expansion, ascending.

    Raises:
        ValueError: fewer than two runs are finite.

    """
    finite = [k for k, y in enumerate(ys) if np.all(np.isfinite(y))]
    usable = list(ys[finite[0] :]) if finite and all(k in finite for k in range(finite[0], len(ys))) else []
    if len(usable) < 2:
        raise ValueError("fewer than two finite runs: nothing to extrapolate")
    column = usable
    best = _column_limit(column, 0, 2 * column[-2] - column[-1])
    for m, power in enumerate(powers[: len(usable) - 2], start=1):
        factor, before = 2.0**power - 1.0, column[-1]
        column = [fine + (fine - coarse) / factor for coarse, fine in itertools.pairwise(column)]
        candidate = _column_limit(column, m, before)
        if candidate.uncertainty[-1] < best.uncertainty[-1]:
            best = candidate
    return best


def _column_limit(column: Sequence[Array], m: int, before: Array) -> ExtrapolatedLimit:
    """The last row of a column; its uncertainty is its distance to the row before or to ``before``."""
    gaps = [np.max(np.linalg.norm(column[-1] - other, axis=-1), axis=1) for other in (column[-2], before)]
    return ExtrapolatedLimit(column[-1], np.maximum.accumulate(np.maximum(*gaps)), m)


def tightest_tolerance_limit(ys: Sequence[Float[Array, "samples bodies width"]]) -> ExtrapolatedLimit:
    """Return the run with the tightest tolerance as the limit of a method with step control.

    Args:
        ys: samples of each run, loose to tight.

    Returns:
        The tightest run; its uncertainty is the distance to the run before it.

    """
    return _column_limit(ys, 0, ys[-2])
