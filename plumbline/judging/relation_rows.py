"""Rows of metamorphic relations: an engine's two answers differ by no more than rounding explains."""

from __future__ import annotations

from collections.abc import Sequence

from plumbline.judging.rows import JudgingResult, Row, RowContext, Verdict
from plumbline.measurements.relation_result import REPEATABILITY, UNEXPLAINED, RelationResult


def judge_relations(context: RowContext, results: Sequence[RelationResult]) -> JudgingResult:
    """Judge relations: a difference may be what rounding explains on both sides.

    Args:
        results: the results of `check_relations`.

    Returns:
        One row per result, its value the ratio of difference and tolerance; of repeatability the largest
        relative difference, which must be zero.

    """
    return JudgingResult([_relation_row(context, result) for result in results])


def _relation_row(context: RowContext, result: RelationResult) -> Row:
    integrator, name = result.integrator, result.relation
    if result.no_answer:
        return context.make_no_answer_row("relations", integrator, name, result.no_answer)
    if result.ratio is None:
        reason = f"not compared: {result.note}"
        return context.make_row("relations", integrator, name, Verdict.INFORMATION, reason)
    extra: dict[str, float] = {"states": result.state_count, "state": result.worst_state}
    if result.unexplained is not None:
        extra[UNEXPLAINED] = result.unexplained
    if result.relation == REPEATABILITY:
        return _repeatability_row(context, result, extra)
    if result.steps:
        limit = "what rounding and the tolerance of the step's solver explain"
        over, where = f"{result.steps} steps", "the end"
        derivation = (
            "worst difference, relative to the pendulum's length, speed and rate of rotation, over (10³ ε + "
            "the tolerance of the step's solver × √steps × the ratio of masses + the state-level rounding "
            "bound × time) × the growth of a small perturbation"
        )
        extra |= {"resolution": result.resolution, "end": result.end_time}
    else:
        limit, over = "the sum of both rounding bounds", f"{result.state_count} states"
        where = f"state {result.worst_state}"
        derivation = "worst difference over the sum of the state-level rounding bounds of both sides"
    if result.ratio <= 1 and result.undecided:
        verdict, reason = Verdict.UNRESOLVED, f"inconclusive: {result.undecided}"
    elif result.ratio <= 1:
        verdict = Verdict.AGREES
        reason = f"both results of {context.title} agree within {result.ratio:.2g} of {limit}, over {over}"
    else:
        verdict, quantity = Verdict.DISAGREES, result.quantity.replace("_", " ")
        reason = f"the {quantity} of {context.title} at {where} differs by {result.ratio:.3g} times {limit}"
    return context.make_row(
        "relations", integrator, name, verdict, f"{name}: {reason}{result.remark}",
        value=result.ratio, tolerance=1.0, derivation=derivation, extra=extra,
    )  # fmt: skip


def _repeatability_row(context: RowContext, result: RelationResult, extra: dict[str, float]) -> Row:
    """The row of equal questions: it disagrees on any bit that differs."""
    asked = f"a run of {result.steps} steps" if result.steps else f"{result.state_count} states"
    if result.note:
        verdict, reason = Verdict.DISAGREES, result.note
    elif result.quantity:
        verdict = Verdict.DISAGREES
        reason = f"{result.quantity}, differs by {result.ratio:.2g} of its size from the first answer"
    else:
        verdict, reason = Verdict.AGREES, f"{asked} gave the same bits each time"
    reason = f"{REPEATABILITY} of {context.title}: {reason}{result.remark}"
    return context.make_row(
        "relations", result.integrator, REPEATABILITY, verdict, reason, value=result.ratio, tolerance=0.0,
        derivation="equal questions give equal bits: alone, in one call, in reverse order, after another one",
        extra=extra,
    )  # fmt: skip
