"""Rows of the level "surface": what an engine's functions and sensors report besides the state quantities.

One row per quantity, whichever calls of the engine give it; the worst of them is named.
"""

from __future__ import annotations

import numpy as np

from plumbline.engines.engine_calls import Evaluation
from plumbline.engines.missing_names import FAILED_PARTS, MISSING_NAMES
from plumbline.judging.rows import (
    FAILED_CALLS,
    WRONG_CALL,
    Row,
    RowContext,
    Verdict,
    most_wrong_call,
    with_unit,
)
from plumbline.model.datatypes import Array
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.rounding_bound import MAX_RELATIVE_BOUND, TINY
from plumbline.truth.surface_truth import SURFACE_QUANTITIES, SurfaceTruth


def judge_surface(context: RowContext, truth: StateTruth, evaluation: Evaluation) -> list[Row]:
    """Judge each quantity that the engine offers, by the worst of all calls, states and bodies.

    Args:
        truth: with the truth of the surface at the first states.
        evaluation: with the engine's answers at the same states, or why there are none.

    Returns:
        One row per quantity, with the number of calls in ``extra``, and rows of what failed or is lacking.

    """
    if evaluation.surface_failure and truth.surface:
        return [context.make_row_of_none("surface", "-", "all", evaluation.surface_failure)]
    rows = [
        _row(context, name, truth.surface[name], evaluation)
        for name in SURFACE_QUANTITIES
        if name in truth.surface and name in evaluation.surface
    ]
    if parts := sorted(evaluation.surface.get(FAILED_PARTS, ())):
        reason, place = ("; ".join(some) for some in zip(*parts, strict=True))
        rows.append(context.make_row("surface", "-", "all", Verdict.FAILED, reason, place=place))
    if missing := evaluation.surface.get(MISSING_NAMES):  # what was not compared is no agreement
        names = ", ".join(name for call in missing for name in call)
        reason = f"version {context.version} has no {names}: what they report is not compared"
        rows.append(context.make_row("surface", "-", "all", Verdict.INFORMATION, reason))
    return rows


def _row(context: RowContext, quantity: str, true: SurfaceTruth, evaluation: Evaluation) -> Row:
    unit, name = SURFACE_QUANTITIES[quantity][0], quantity.replace("_", " ")
    found = [(*_worst(value, true), ", ".join(call)) for call, value in evaluation.surface[quantity].items()]
    ratio, error, tolerance, state, call = max(found)
    wrong = {one[-1]: one[0] for one in found if one[0] > 1}
    others = sorted(wrong.keys() - {call})
    # single entries may have no scale
    scale, loose = np.max(true.scale, axis=1), np.max(true.tolerance, axis=1)
    looseness = np.where(scale > 0, loose / np.where(scale > 0, scale, 1.0), 0.0)
    sharp, count, loosest = np.sum(looseness <= MAX_RELATIVE_BOUND), len(scale), np.max(looseness)
    if ratio > 1:
        verdict = Verdict.DISAGREES
        reason = (
            f"{context.title}: the {name} by {call} is off by {with_unit(error, unit, 3)} at state {state}, "
        )
        reason += f"{ratio:.3g} times the rounding bound"
        reason += f"; by {', '.join(others)} too" if others else ""
    elif 2 * sharp >= count:
        verdict = Verdict.AGREES
        reason = f"{name} within {ratio:.2g} of the rounding bound at {sharp} states, by {len(found)} calls"
    else:
        verdict = Verdict.UNRESOLVED
        reason = (
            f"inconclusive: the rounding bound is up to {loosest:.1g} of the {name} (limit "
            f"{MAX_RELATIVE_BOUND:g}) at {count - sharp} of {count} states, too loose to detect an error"
        )
    return context.make_row(
        "surface", "-", quantity, verdict, reason, unit, value=error, tolerance=tolerance, ratio=ratio,
        derivation="a formula on the certified motion; errors of its inputs are propagated to first order, "
        f"its terms are rounded once each; at most {loosest:.1g} of the scale at {count} states",
        cpu_time=evaluation.cpu_time,
        extra={"states": count, "state": state, "calls": len(found)}
        | ({WRONG_CALL: most_wrong_call(wrong), FAILED_CALLS: "\n".join(sorted(wrong))} if wrong else {}),
    )  # fmt: skip


def _worst(value: Array, true: SurfaceTruth) -> tuple[float, float, float, int]:
    """The largest ratio of error and tolerance, with both and the state; infinite of what is no answer."""
    first = slice(len(value))  # some calls are made at the first states only
    if not len(value) or value.shape != true.value[first].shape:
        return np.inf, np.inf, 0.0, 0
    error, tolerance = np.linalg.norm(value - true.value[first], axis=-1), true.tolerance[first]
    error = np.where(np.isfinite(error), error, np.inf)
    ratio = error / np.maximum(tolerance, TINY)
    at = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    return float(ratio[at]), float(error[at]), float(tolerance[at]), int(at[0])
