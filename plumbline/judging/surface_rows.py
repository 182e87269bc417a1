"""Rows of the level "surface": what an engine's functions and sensors report besides the state quantities.

One row per quantity, whichever calls of the engine give it; the worst of them is named.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plumbline.engines.engine_calls import Evaluation
from plumbline.engines.missing_names import FAILED_PARTS, LATER_CALLS, MISSING_NAMES
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
from plumbline.truth.rounding_bound import MAX_RELATIVE_BOUND, TINY, bound_over_scale
from plumbline.truth.surface_truth import SURFACE_QUANTITIES, SurfaceTruth

NOTES = (FAILED_PARTS, LATER_CALLS, MISSING_NAMES)  # in a surface, beside the quantities


def judge_surface(context: RowContext, truth: StateTruth, evaluation: Evaluation) -> list[Row]:
    """Judge each quantity that the engine offers, by the worst of all calls, states and bodies.

    Args:
        truth: with the truth of the surface at the first states.
        evaluation: with the engine's answers at the same states, or why there are none.

    Returns:
        One row per quantity, with the number of calls in ``extra``, and rows of what failed or is lacking.

    """
    if evaluation.surface_failure and truth.surface:
        return [context.make_no_answer_row("surface", "-", "all", evaluation.surface_failure)]
    rows = [
        _row(context, name, truth.surface[name], evaluation)
        for name in SURFACE_QUANTITIES
        if name in truth.surface and evaluation.surface.get(name)
    ]
    if unknown := sorted({*evaluation.surface} - {*SURFACE_QUANTITIES, *NOTES}):
        reason = f"the surface of {context.title} has unknown quantities: {', '.join(unknown)}"
        rows.append(context.make_row("surface", "-", "all", Verdict.FAILED, reason))
    if parts := sorted(evaluation.surface.get(FAILED_PARTS, ())):
        reason, place = ("; ".join(some) for some in zip(*parts, strict=True))
        rows.append(context.make_row("surface", "-", "all", Verdict.FAILED, reason, place=place))
    if later := evaluation.surface.get(LATER_CALLS):
        calls = "; ".join(", ".join(call) for call in later)
        reason = f"compared up to the first state at which {context.title} does not report it: by {calls}"
        rows.append(context.make_row("surface", "-", "all", Verdict.INFORMATION, reason))
    if missing := evaluation.surface.get(MISSING_NAMES):  # what was not compared is no agreement
        names = ", ".join(name for call in missing for name in call)
        reason = f"version {context.version} has no {names}: what they report is not compared"
        rows.append(context.make_row("surface", "-", "all", Verdict.INFORMATION, reason))
    return rows


def _row(context: RowContext, quantity: str, true: SurfaceTruth, evaluation: Evaluation) -> Row:
    unit, name = SURFACE_QUANTITIES[quantity][0], quantity.replace("_", " ")
    compared = {
        ", ".join(call): _compare(value, true) for call, value in evaluation.surface[quantity].items()
    }
    ratio, error, tolerance, state, call = max((*one[:-1], call) for call, one in compared.items())
    wrong = {call: one[0] for call, one in compared.items() if one[0] > 1}
    others = sorted(wrong.keys() - {call})
    looseness = bound_over_scale(np.max(true.tolerance, axis=1), np.max(true.scale, axis=1))
    count, loosest = max(len(one[-1]) for one in compared.values()), np.max(looseness)
    is_sharp = looseness[:count] <= MAX_RELATIVE_BOUND
    for *_, is_decided in compared.values():
        is_sharp[: len(is_decided)][~is_decided] = False
    sharp = np.sum(is_sharp)
    if ratio > 1:
        verdict = Verdict.DISAGREES
        reason = (
            f"{context.title}: the {name} by {call} is off by {with_unit(error, unit, 3)} at state {state}, "
        )
        reason += f"{ratio:.3g} times the rounding bound"
        reason += f"; by {', '.join(others)} too" if others else ""
    elif 2 * sharp >= count:
        verdict = Verdict.AGREES
        reason = (
            f"{name} within {ratio:.2g} of the rounding bound at {sharp} states, by {len(compared)} calls"
        )
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
        extra={"states": count, "state": state, "calls": len(compared)}
        | ({WRONG_CALL: most_wrong_call(wrong), FAILED_CALLS: "\n".join(sorted(wrong))} if wrong else {}),
    )  # fmt: skip


def _compare(value: Array, true: SurfaceTruth) -> tuple[float, float, float, int, NDArray[np.bool_]]:
    """The largest ratio of error and tolerance, with both and the state; infinite of what is no answer.

    Besides them whether a mistake would be seen at each state of the answer: in each entry with a scale the
    tolerance is sharp, or the error as small as a sharp one.  Without a tolerance nothing is compared.
    """
    first = slice(len(value))  # some calls are made at the first states only
    if not len(value) or value.shape != true.value[first].shape:
        return np.inf, np.inf, 0.0, 0, np.zeros(0, bool)
    error, tolerance = np.linalg.norm(value - true.value[first], axis=-1), true.tolerance[first]
    error, scale = np.where(np.isfinite(error), error, np.inf), true.scale[first]
    ratio = np.where(np.isfinite(tolerance), error / np.maximum(tolerance, TINY), 0.0)
    at = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    is_small = np.minimum(tolerance, error) <= MAX_RELATIVE_BOUND * scale
    is_decided = np.all(is_small | (scale == 0), axis=1)
    return float(ratio[at]), float(error[at]), float(tolerance[at]), int(at[0]), is_decided
