"""Which names of an engine's surface are exercised: a change of 1e-6 in what a name returns turns a row red.

    python -m plumbline.studies.exercised_names [ENGINE ...]

computes it for all engines with a surface, or for some, on `MECHANISMS`, and writes it into
adapters/surface/exercised.json, where the entries of other engines stay.  The pages docs/surface/ENGINE.md
are made from it.  All columns of an engine are asked, by single steps too.  A night computes it, and fails
where the file says otherwise (tests/engines/test_surface.py).
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from plumbline.engines.engine_calls import SURFACE_STATES, Evaluation, StepAttempt, evaluate_states
from plumbline.engines.no_answer import NoAnswer
from plumbline.engines.registry import load_adapter
from plumbline.engines.surface import EXERCISED_FILE, SURFACES, exercised_rows, other_names
from plumbline.judging.rows import Row, RowContext, Verdict
from plumbline.judging.state_level import judge_states, judge_variants
from plumbline.judging.step_level import judge_steps
from plumbline.judging.surface_rows import judge_surface
from plumbline.measurements.single_steps import MAX_STEP_BODIES, run_step_study
from plumbline.measurements.state_relations import quantity_values
from plumbline.model.datatypes import Call, Model, State, StateQuantities
from plumbline.model.sampling import compared_states
from plumbline.scenario.loader import load_scenarios
from plumbline.truth.ground_truth import StateTruth, state_truth

CHANGE = 1e-6  # relative
MECHANISMS = (
    "rest", "double-rod-then-ball", "furuta", "sprung-slider-on-arm", "free-body-with-rotors",
    "tree-of-seven", "universal-pendulum", "planar-top", "slider-crank",
    "cart-pole", "nesc-tumbling-brick", "helical-screw", "double-loaded-balls", "spring-pendulum",
    "sprung-without-rotors", "sprung-hinge", "light-cart-pole", "acrobot",
)  # fmt: skip
_CONTEXT = RowContext("", "", "", "the engine", "")


def exercised_names(
    truth: StateTruth,
    evaluation: Evaluation,
    column_names: Sequence[Call] = (),
) -> dict[str, set[str]]:
    """Change what each call and each variant returned, one at a time, and see which rows turn red.

    Args:
        truth: with the truth of the surface.
        evaluation: of the engine at the same states.
        column_names: of the adapter, that the state quantities themselves come from.

    Returns:
        By name of the engine the quantities of these rows.

    """
    found = defaultdict[str, set[str]](set)
    bare = replace(evaluation, surface={}, variants={})

    def compare(call: Call, judge: Callable[..., list[Row]], *both: dict[str, Any]) -> None:
        _add_red_rows(found, call, *(judge(_CONTEXT, truth, replace(bare, **changes)) for changes in both))

    for quantity, calls in evaluation.surface.items():
        for call, value in calls.items():
            both = ({"surface": {quantity: {call: x}}} for x in (value, value * (1 + CHANGE)))
            compare(call, judge_surface, *both)
    for kind, variants in evaluation.variants.items():
        for call, answers in variants.items():
            if not isinstance(answers, NoAnswer):
                some = ({"variants": {kind: {call: x}}} for x in (answers, _changed(answers)))
                compare(call, judge_variants, *some)
    states = [{"quantities": x} for x in (bare.quantities, _changed(bare.quantities))]
    for call in column_names:
        compare(call, lambda *given: judge_states(*given).rows, *states)
    return found


def _changed(answers: Sequence[StateQuantities]) -> list[StateQuantities]:
    return [
        replace(one, **{q: getattr(one, q) * (1 + CHANGE) for q in quantity_values(one)}) for one in answers
    ]


def names_of_steps(column: str, model: Model, states: Sequence[State]) -> dict[str, set[str]]:
    """Change the velocities after single steps, and see which rows turn red.

    Returns:
        By name of an engine's integrators (`Integrator.names`) the quantities of these rows.

    """
    found = defaultdict[str, set[str]](set)
    for integrator in load_adapter(column).integrators if model.n <= MAX_STEP_BODIES else ():
        if not integrator.names or integrator.method is None:
            continue
        answer = replace(run_step_study(column, integrator, model, states), run=None)
        changed = replace(answer, attempts=[_changed_step(one) for one in answer.attempts])
        rows = [judge_steps(_CONTEXT, integrator, model, states, x).rows for x in (answer, changed)]
        if len(rows[0]) == len(rows[1]):
            _add_red_rows(found, integrator.names, *rows)
    return found


def _changed_step(attempt: StepAttempt) -> StepAttempt:
    if attempt.run is None:
        return attempt
    run = attempt.run.trajectory
    changed = replace(run, v=run.v * (1 + CHANGE), pdot=run.pdot * (1 + CHANGE))
    return replace(attempt, run=replace(attempt.run, trajectory=changed))


def _add_red_rows(found: dict[str, set[str]], call: Call, before: list[Row], after: list[Row]) -> None:
    red = {
        row.quantity
        for was, row in zip(before, after, strict=True)
        if (was.verdict, row.verdict) == (Verdict.AGREES, Verdict.DISAGREES)
    }
    for name in call if red else ():
        found[name] |= red


def names_of_engine(engine: str) -> dict[str, list[str]]:
    """Compute it on `MECHANISMS`.

    Args:
        engine: one of `plumbline.engines.surface.SURFACES`, which is imported.

    Returns:
        By name of the engine the quantities of the rows that turn red, both sorted.

    """
    names = defaultdict[str, set[str]](set)
    for s in load_scenarios(MECHANISMS):
        states = compared_states(s.model, s.state, s.seed, SURFACE_STATES)[:SURFACE_STATES]
        truth = state_truth(s.model, states)
        for column in filter(None, (engine, load_adapter(engine).other_formulation)):
            evaluation = evaluate_states(column, s.model, states)
            own = [call for call, suits in load_adapter(column).column_names if suits(s.model)]
            of_steps = names_of_steps(column, s.model, states[:1])
            for seen in (exercised_names(truth, evaluation, own), of_steps):
                for name, quantities in seen.items():
                    names[name] |= quantities
    for name, same in other_names(engine).items():
        for other in same if name in names else ():
            names[other] |= names[name]
    return {name: sorted(names[name]) for name in sorted(names)}


def main() -> None:
    """Write the names of all engines, or of those that are given."""
    found = {engine: names_of_engine(engine) for engine in sys.argv[1:] or SURFACES}
    written = {engine: found.get(engine) or exercised_rows(engine) for engine in SURFACES}
    EXERCISED_FILE.write_text(json.dumps(written, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
