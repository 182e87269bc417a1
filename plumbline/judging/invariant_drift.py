"""Invariants along a refinement study: every drift must vanish with the step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plumbline.judging.refinement_analysis import RefinementAnalysis
from plumbline.judging.rows import Row, Verdict, first_decided, with_unit
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
    drift = np.maximum.accumulate(np.max(np.linalg.norm(samples[-1], axis=-1), axis=1))
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
            value=float(drift[at]), tolerance=tolerance, ratio=ratio, derivation=derivation,
            compared_until=float(times[at]), extra={"scale": scale, "whole": float(drift[-1]), **extra},
            **study.common_fields,
        )  # fmt: skip

    end, failure, tolerance = len(times) - 1, "", np.full(len(times), floor)
    try:
        limit = study.extrapolated_limit(samples)
        tolerance = limit.uncertainty + floor + uncertainty
    except ValueError as error:
        failure = str(error)
    if drift[end] <= floor:
        reason = f"{name} {with_unit(drift[end], unit)}: rounding"
        ratio = float(drift[end] / floor)
        return row(Verdict.AGREES, reason, end, floor, ratio=ratio, limit_tolerance=float(tolerance[end]))
    if failure:
        return row(Verdict.UNRESOLVED, failure, end, floor)
    limit_drift = np.maximum.accumulate(np.max(np.linalg.norm(limit.y, axis=-1), axis=1))
    is_trusted = not study.has_steps or observed_order(samples, floor, study.integrator.order).is_asymptotic

    def judge_window(number: int) -> Row:
        at = number - 1
        to_limit = float(np.max(np.linalg.norm((samples[-1] - limit.y)[:number], axis=-1)))
        allowed = to_limit + float(tolerance[at])
        at_zero = (
            f"{limit_drift[at]:.2g} ± {with_unit(tolerance[at], unit)} at step zero, t ≤ {times[at]:g} s"
        )
        derivation = (
            f"{to_limit:.2g} from the finest step to step zero, itself ± {limit.uncertainty[at]:.2g}; "
            f"{rounding}; {UNCERTAIN} ± {uncertainty:.2g}"
        )
        ratio = float(limit_drift[at] / tolerance[at])
        extra = {"limit": float(limit_drift[at]), "limit_tolerance": float(tolerance[at])}
        if limit_drift[at] <= tolerance[at] <= DETECTABLE_PARAMETER_ERROR * scale:
            reason = f"{name} {with_unit(drift[at], unit)} at the finest step, {at_zero}"
            return row(Verdict.AGREES, reason, at, allowed, derivation, ratio, **extra)
        if limit_drift[at] > tolerance[at] and is_trusted:
            reason = f"{name} does not vanish with the step: {at_zero}"
            return row(Verdict.DISAGREES, reason, at, float(tolerance[at]), derivation, ratio, **extra)
        reason = f"{name} {with_unit(drift[at], unit)}: {at_zero} does not decide"
        return row(Verdict.UNRESOLVED, reason, at, allowed, derivation, ratio, **extra)

    found = first_decided(judge_window(number) for number in study.window_lengths(float(times[-1])))
    duration, last_sample = float(times[-1]), int(np.searchsorted(times, found.compared_until or 0.0))
    verdict, reason = found.verdict, found.reason
    if verdict != Verdict.UNRESOLVED and study.is_too_short(last_sample, duration):
        verdict, reason = Verdict.UNRESOLVED, f"too short a time to decide: {reason}"
    reason += study.coverage_remark(last_sample, duration, duration)
    return replace(found, verdict=verdict, reason=reason)
