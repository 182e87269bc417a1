"""Metamorphic relations: one engine compared with itself on equivalent problems; no truth is needed."""

from __future__ import annotations

from collections.abc import Sequence

from plumbline.engines.metamorphic_hooks import metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.judging.relation_result import RelationResult
from plumbline.judging.rows import JudgingResult, Row, RowContext, Verdict
from plumbline.judging.run_relations import check_run_relations
from plumbline.judging.state_relations import check_state_relations
from plumbline.model.datatypes import Model, State


def check_relations(engine: str, model: Model, states: Sequence[State]) -> list[RelationResult]:
    """Check every relation on one engine; runs inside a worker.

    Args:
        engine: name of the engine.
        model: the pendulum.
        states: states of it; runs start from the first.

    Returns:
        The results of the relations at states, then of those of runs.

    """
    adapter = metamorphic_hooks(load_adapter(engine))
    return [
        *check_state_relations(adapter, model, states),
        *check_run_relations(adapter, model, states[0]),
    ]


def judge_relations(context: RowContext, results: Sequence[RelationResult]) -> JudgingResult:
    """Judge relations: a difference may be what rounding explains on both sides.

    Args:
        context: scenario and engine.
        results: the results of `check_relations`.

    Returns:
        One row per result, its value the ratio of difference and tolerance.

    """
    return JudgingResult([_relation_row(context, result) for result in results])


def _relation_row(context: RowContext, result: RelationResult) -> Row:
    if result.ratio is None:
        return context.make_row(
            "relations", result.integrator, result.relation, result.verdict, result.refusal_reason
        )
    extra = {"states": float(result.state_count), "state": float(result.worst_state)}
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
    if result.ratio <= 1:
        verdict = Verdict.AGREES
        reason = f"both results of {context.title} agree within {result.ratio:.2g} of {limit}, over {over}"
    else:
        verdict, name = Verdict.DISAGREES, result.quantity.replace("_", " ")
        reason = f"the {name} of {context.title} at {where} differs by {result.ratio:.3g} times {limit}"
    return context.make_row(
        "relations", result.integrator, result.relation, verdict, f"{result.relation}: {reason}",
        value=result.ratio, tolerance=1.0, derivation=derivation, extra=extra,
    )  # fmt: skip
