"""Step level: one step and ten of the declared method, against its formula in extended precision.

`plumbline.truth.step_comparison` has the differences and their bounds.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from plumbline.engines.engine_calls import StepEvaluation
from plumbline.judging.rows import JudgingResult, Row, RowContext, Verdict
from plumbline.model.datatypes import Integrator, Model, State
from plumbline.model.loops import keeps_dependent_rows
from plumbline.model.step_methods import ConstrainedMethod, JointSpaceMethod
from plumbline.truth.step_comparison import (
    CONSTRAINED_UNITS,
    STEP_UNITS,
    Comparisons,
    FormulaSteps,
    compare_parts,
    step_counts,
)
from plumbline.truth.step_formulas import (
    HAS_EXTENDED_PRECISION,
)

OPEN_ROWS = (
    "not compared: rows of the loops depend on others in closed poses only; where a step has opened the "
    "loops, the accelerations are those of the solver's iterations"
)
MAX_STEP_BOUND = 1e-6  # of the accelerations' effect; a looser bound could hide a mistake


def judge_steps(
    context: RowContext, integrator: Integrator, model: Model, states: Sequence[State], answer: StepEvaluation
) -> JudgingResult:
    """Judge the steps of one integrator by its declared formula.

    Args:
        integrator: the integrator, with a declared method.
        states: the states that the steps start from.
        answer: the engine's steps, or why there are none.

    Returns:
        One row per quantity.

    """
    method, verdict, reason, gap = integrator.method, Verdict.UNSUPPORTED, "", ""
    attempts = [attempt for attempt in answer.attempts if attempt.run is not None]
    runs = [(attempt.state, attempt.step, attempt.run) for attempt in attempts if attempt.run is not None]
    if isinstance(method, ConstrainedMethod):
        failures = [attempt.failure for attempt in answer.attempts]
    else:
        failures = [attempt.failure for attempt in answer.attempts if attempt.run is None]
    if any(failures):
        verdict, reason = Verdict.FAILED, next(filter(None, failures))
    elif not runs:
        reason, gap = next((attempt.refusal, attempt.gap) for attempt in answer.attempts)
    elif not HAS_EXTENDED_PRECISION:
        reason = "the formulas need an extended precision that this machine does not have"
    elif isinstance(method, JointSpaceMethod) and not keeps_dependent_rows(model, states[0]):
        verdict, reason = Verdict.INFORMATION, OPEN_ROWS
    if reason:
        return JudgingResult([context.make_row("step", integrator.name, "all", verdict, reason, gap=gap)])
    if isinstance(method, JointSpaceMethod):
        starts = [(index, h, run.angle_axes) for index, h, run in runs]
        steps = FormulaSteps(method, model, states, starts)
        for i, attempt in enumerate(attempts):
            if attempt.failure and steps.is_stable(i):
                row = context.make_row("step", integrator.name, "all", Verdict.FAILED, attempt.failure)
                return JudgingResult([row])
        found, units = steps.compare([run for *_, run in runs]), STEP_UNITS
    else:
        assert isinstance(method, ConstrainedMethod)
        found, units = compare_parts(method, model, states, runs), CONSTRAINED_UNITS
    alias = None if model.has_drag else integrator.alias_of  # with drag the two methods differ
    complete = sum(not (attempt.refusal or attempt.failure) for attempt in answer.attempts)
    note = f"{complete} runs of {max(step_counts(method))} steps"
    return JudgingResult(
        [
            _row(context, integrator, quantity, units[quantity], comparisons, note, alias, answer.cpu_time)
            for quantity, comparisons in found.items()
        ]
    )


def _row(
    context: RowContext, integrator: Integrator, quantity: str, unit: str, found: Comparisons, note: str,
    alias: str | None, cpu_time: float,
) -> Row:  # fmt: skip
    """The row of one quantity: its worst ratio decides, unless most bounds are too loose."""
    error, bound = np.array(found.errors), np.array(found.bounds)
    ratios = error / np.maximum(bound, np.finfo(float).tiny)
    at, looseness = int(np.argmax(ratios)), np.array(found.looseness)
    place = f"body {found.bodies[at] + 1}, {found.places[at]}"
    ratio, is_sharp = float(ratios[at]), looseness <= MAX_STEP_BOUND
    name = quantity.removeprefix("step_").replace("_", " ")
    if ratio > 1:
        verdict = Verdict.DISAGREES
        reason = (
            f"{context.title} does not take the declared step of {integrator.name}: {name} off by "
            f"{error[at]:.3g} {unit} ({place}), {ratio:.3g} times the rounding bound"
        )
    elif not ratio <= 1 or np.mean(is_sharp) < 0.5:
        verdict = Verdict.UNRESOLVED
        reason = (
            f"inconclusive: at {np.mean(~is_sharp):.0%} of the comparisons the rounding bound is above "
            f"{MAX_STEP_BOUND:g} of the accelerations' effect, too loose to detect an error"
        )
    else:
        verdict = Verdict.AGREES
        reason = f"{name} within {ratio:.2g} of the rounding bound of the declared step in {note}"
    return context.make_row(
        "step", integrator.name, quantity, verdict, reason, unit,
        value=float(error[at]), tolerance=float(bound[at]), ratio=ratio, alias_of=alias, cpu_time=cpu_time,
        derivation=f"{bound[at]:.2g} {unit} at {place}; in the median {np.median(looseness):.1g} "
        "of the accelerations' effect on a step; truth: the declared formula in extended precision "
        "(docs/integrators.md)",
        extra={"comparisons": float(len(error)), "bound_relative": float(np.max(looseness)),
               "state": float(found.places[at].state), "step": found.places[at].step,
               "steps": float(found.places[at].count)},
    )  # fmt: skip
