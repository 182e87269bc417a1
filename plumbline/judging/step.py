"""Step level: one step and ten of the declared method, against its formula in extended precision.

`plumbline.truth.step_comparison` has the differences and their bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from plumbline.engines.calls import StepEvaluation, run_steps
from plumbline.judging.rows import JudgingResult, Row, RowContext, Verdict
from plumbline.model.datatypes import ZERO_INERTIA, Integrator, Model, State
from plumbline.model.loops import STABILISATION, keeps_dependent_rows
from plumbline.model.step_methods import ConstrainedMethod, JointSpaceMethod
from plumbline.processes.workers import Pickled
from plumbline.truth.rounding_bound import remembered_rounding_bound
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
    fastest_rates,
    first_coordinate_acceleration,
)

STEP_SIZES = (0.01, 0.0237)  # s; large: a bound grows as h, the effect of a wrong formula faster
MAX_STEP_RATE = 10.0  # rad/s; in faster motions the steps are smaller: explicit methods become unstable
# rad/s, of loops: at the larger step gaps close by half as fast as h a = 1, where Euler's method rings
LOOP_RATE = 2 * STABILISATION * MAX_STEP_RATE * STEP_SIZES[-1]
STEP_STATES = 5  # the initial state and random ones
MAX_STEP_BODIES = 10
OPEN_ROWS = (
    "not compared: rows of the loops depend on others in closed poses only; where a step has opened the "
    "loops, the accelerations are those of the solver's iterations"
)
MAX_STEP_BOUND = 1e-6  # of the accelerations' effect; a looser bound could hide a mistake


def run_step_study(
    engine: str, integrator: Integrator, model: Model, states: Sequence[State]
) -> StepEvaluation:
    """Take the steps that `judge_steps` judges (to be called in a worker).

    Args:
        engine: name of the engine in the registry.
        integrator: one of its integrators, with a declared formula.
        model: the pendulum.
        states: states of it.

    Returns:
        The steps.

    """
    assert integrator.method is not None
    sizes = _remembered_step_sizes(
        isinstance(integrator.method, ConstrainedMethod), Pickled.of((model, states))
    )
    return run_steps(engine, integrator.name, model, states, sizes, step_counts(integrator.method))


@lru_cache(maxsize=4)
def _remembered_step_sizes(has_constraints: bool, arguments: Pickled) -> list[list[float]]:
    """The steps of a scenario, whose integrators a worker gets in a row."""
    return step_sizes(has_constraints, *arguments.load())


def step_sizes(has_constraints: bool, model: Model, states: Sequence[State]) -> list[list[float]]:
    """Choose the steps from each state: `STEP_SIZES`, in proportion smaller where the motion is fast.

    Args:
        has_constraints: whether the declared formula is a `ConstrainedMethod`.
        model: the pendulum.
        states: states of it.

    Returns:
        Steps [s] per state: `STEP_SIZES` × `MAX_STEP_RATE` over the fastest rate, where that is larger.  Of
        loops it is `LOOP_RATE` at least: engines' corrections of gaps have to be stable.  Else it
        is the largest of √(2 |p̈|) = (α² + ω⁴/4)^¼ of a body, of |u̇| of a rod, of the linearised equations'
        eigenvalues, and for methods with constraints of √(F |s| / J) of a joint's force, doubled: their
        Newton iteration leaves that stiffness out and diverges at large steps.

    """
    norm, found = np.linalg.norm, []
    for state, fastest in zip(states, fastest_rates(model, states), strict=True):
        turning = np.asarray(first_coordinate_acceleration(model, state)[:, 3:], float)
        squares = [2 * np.max(norm(turning, axis=1)), np.max(norm(state.udot, axis=1)) ** 2, fastest**2]
        if has_constraints:
            bound = remembered_rounding_bound(model, state)
            force, near = np.asarray(bound.scale["joint_reaction"]), model.body[:, 1]
            lever, principal = norm(model.point[:, 1], axis=1), np.linalg.eigvalsh(model.inertia)
            least = np.where(principal[:, 0] > ZERO_INERTIA * principal[:, 2], principal[:, 0], np.inf)
            on_body = model.body[:, 0] >= 0
            beyond = np.zeros(model.n)
            np.maximum.at(beyond, model.body[on_body, 0], norm(model.point[on_body, 0], axis=1))
            squares.append(np.max(force * (lever + beyond[near]) / least[near]))
            if not model.is_chain:
                squares.append(np.max(bound.scale["joint_moment"] / least[near]))
            squares = [4 * np.max(squares)]
        if model.has_loops:
            squares.append(LOOP_RATE**2)
        rate = float(np.sqrt(np.max(squares)))
        found.append([h * min(1.0, MAX_STEP_RATE / rate if rate > 0 else 1.0) for h in STEP_SIZES])
    return found


def judge_steps(
    context: RowContext, integrator: Integrator, model: Model, states: Sequence[State], answer: StepEvaluation
) -> JudgingResult:
    """Judge the steps of one integrator by its declared formula.

    Args:
        context: scenario and engine.
        integrator: the integrator, with a declared method.
        model: the pendulum.
        states: the states that the steps start from.
        answer: the engine's steps, or why there are none.

    Returns:
        One row per quantity.

    """
    method, verdict, reason = integrator.method, Verdict.UNSUPPORTED, ""
    attempts = [attempt for attempt in answer.attempts if attempt.run is not None]
    runs = [(attempt.state, attempt.step, attempt.run) for attempt in attempts if attempt.run is not None]
    if isinstance(method, ConstrainedMethod):
        failures = [attempt.failure for attempt in answer.attempts]
    else:
        failures = [attempt.failure for attempt in answer.attempts if attempt.run is None]
    if any(failures):
        verdict, reason = Verdict.FAILED, next(filter(None, failures))
    elif not runs:
        reason = next(attempt.refusal for attempt in answer.attempts)
    elif not HAS_EXTENDED_PRECISION:
        reason = "the formulas need an extended precision that this machine does not have"
    elif isinstance(method, JointSpaceMethod) and not keeps_dependent_rows(model, states[0]):
        verdict, reason = Verdict.INFORMATION, OPEN_ROWS
    if reason:
        return JudgingResult([context.make_row("step", integrator.name, "all", verdict, reason)])
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
