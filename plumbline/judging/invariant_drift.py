"""Invariants along a refinement study: every drift must vanish with the step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from plumbline.judging.refinement_analysis import RefinementAnalysis
from plumbline.judging.rows import Row, Verdict, with_unit
from plumbline.measurements.order_and_limit import observed_order
from plumbline.measurements.refinement_study import ROUNDING_PER_STEP, rounding_floor
from plumbline.model.datatypes import Array
from plumbline.model.invariants import INVARIANT_UNITS, UNCERTAIN
from plumbline.truth.ground_truth import DETECTABLE_PARAMETER_ERROR


def invariant_rows(study: RefinementAnalysis) -> list[Row]:
    """Judge every invariant that is conserved in this motion.

    Args:
        study: the refinement study.

    Returns:
        One row per invariant: its drift in the finest run, and the verdict on its limit at step zero.

    """
    rows = []
    for quantity, unit in INVARIANT_UNITS.items():
        series = [None if d is None else getattr(d, quantity) for d in study.invariant_drifts]
        if series[-1] is not None:
            ys = [np.full_like(series[-1], np.nan) if s is None else s for s in series]
            rows.append(_invariant_row(study, quantity, unit, ys))
    return rows


def _invariant_row(study: RefinementAnalysis, quantity: str, unit: str, samples: Sequence[Array]) -> Row:
    """The limit of a drift is zero, within its uncertainty and the rounding of all steps."""
    name, scale, times = quantity.replace("_", " "), study.invariant_scales[quantity], study.times
    steps = study.finest.steps
    accepted = 0.0 if study.has_steps else study.runs[-1].resolution  # by step control in every step
    floor, per_step = rounding_floor(steps, scale, accepted), ROUNDING_PER_STEP + accepted
    uncertainty = study.invariant_uncertainty(quantity)
    drifts = [np.max(np.linalg.norm(y, axis=-1), axis=1) for y in samples]
    drift = np.maximum.accumulate(drifts[-1])
    rounding = f"{steps} steps, {per_step:.1g} × {with_unit(scale, unit, 3)} each: {floor:.2g}"

    def row(
        verdict: Verdict,
        reason: str,
        at: int,
        tolerance: float,
        derivation: str = rounding,
        ratio: float | None = None,
        **extra: float,
    ) -> Row:
        return study.context.make_row(
            "invariants", study.integrator.name, quantity, verdict, reason, unit,
            value=drift[at], tolerance=tolerance, ratio=ratio, derivation=derivation,
            compared_until=times[at], extra={"scale": scale, "whole": drift[-1], **extra},
            **study.common_fields,
        )  # fmt: skip

    end, failure, tolerance = len(times) - 1, "", np.full(len(times), floor)
    try:
        limit = study.extrapolated_limit(samples)
        tolerance = limit.uncertainty + floor + uncertainty
    except ValueError as error:
        failure = str(error)
    allowed = min(floor, DETECTABLE_PARAMETER_ERROR * scale)  # step control may accept more
    if drift[end] <= allowed:
        reason = f"{name} {with_unit(drift[end], unit)}: rounding"
        return row(Verdict.AGREES, reason, end, allowed, limit_tolerance=tolerance[end])
    if failure:
        return row(Verdict.UNRESOLVED, failure, end, floor)
    limit_drift = np.maximum.accumulate(np.max(np.linalg.norm(limit.y, axis=-1), axis=1))
    is_trusted = not study.has_steps or observed_order(samples, floor, study.integrator.order).is_asymptotic

    def judge_window(at: int) -> tuple[Verdict, str]:
        at_zero = (
            f"{limit_drift[at]:.2g} ± {with_unit(tolerance[at], unit)} at step zero, t ≤ {times[at]:g} s"
        )
        if limit_drift[at] <= tolerance[at] <= DETECTABLE_PARAMETER_ERROR * scale:
            return Verdict.AGREES, f"{name} {with_unit(drift[at], unit)} at the finest step, {at_zero}"
        if limit_drift[at] > tolerance[at] and is_trusted:
            return Verdict.DISAGREES, f"{name} does not vanish with the step: {at_zero}"
        return Verdict.UNRESOLVED, f"{name} {with_unit(drift[at], unit)}: {at_zero} does not decide"

    duration = float(times[-1])
    allowed_drift = np.full(len(times), floor + uncertainty)
    verdict, reason, at, _ = study.decide(judge_window, drifts, allowed_drift, duration, duration)
    to_limit = np.max(np.linalg.norm((samples[-1] - limit.y)[: at + 1], axis=-1))
    is_off = limit_drift[at] > tolerance[at] and is_trusted
    return row(
        verdict,
        reason,
        at,
        tolerance[at] + (0.0 if is_off else to_limit),
        f"{to_limit:.2g} from the finest step to step zero, itself ± {limit.uncertainty[at]:.2g}; "
        f"{rounding}; {UNCERTAIN} ± {uncertainty:.2g}",
        limit_drift[at] / tolerance[at],
        limit=limit_drift[at],
        limit_tolerance=tolerance[at],
    )
