"""Loss of digits as a mechanism: the error is no function of the problem but of its last bits.

A wrong term or parameter gives nearly the same error where the axes of the world and of the bodies are
turned by a millionth of a radian.
Rounding that an algorithm amplifies gives another error each time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import ParamSpec, TypeVar

import numpy as np

from plumbline.diagnosis.cause import Cause, CauseKind, quantity_words
from plumbline.diagnosis.fit import Difference
from plumbline.diagnosis.prediction import (
    QUANTITIES,
    Predictor,
    View,
    error_ratio,
    error_ratios,
    tolerances,
    values_of,
)
from plumbline.model.datatypes import Array, EngineFailure, Model, State, StateQuantities, StepRun
from plumbline.model.equivalent import (
    BODY_VECTORS,
    WORLD_VECTORS,
    bodies_between,
    rotate_body_frames,
    rotate_world,
    unrotate,
)
from plumbline.model.step_methods import JointSpaceMethod
from plumbline.processes.exceptions import PlumblineError, describe_exception
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.rounding_bound import rounding_bounds
from plumbline.truth.step_comparison import RESIDUAL_STEPS, FormulaSteps

COPIES = 8
TURN = 1e-6  # rad
MIN_SCATTER = 0.3  # of the error; 0.5 to 1 where its digits are lost, about TURN where it has a cause
MIN_COPY_ERROR = 0.02  # of the error; an engine that keeps the call before is off by about TURN in a copy
MIN_GROWTH = 4.0  # of the error in rounding bounds, from half of the bodies to all

# what `ask`, the equations and their bounds raise of problems that they refuse
REFUSALS = (PlumblineError, ArithmeticError, np.linalg.LinAlgError)

Evaluate = Callable[[Model, list[State]], list[StateQuantities]]
Turns = tuple[Array, Array]  # unit quaternions of rotations of the world and of all bodies
_P = ParamSpec("_P")
_T = TypeVar("_T")


def ask(engine: Callable[_P, _T], *given: _P.args, **named: _P.kwargs) -> _T:
    """Call an engine; whatever it raises becomes an error of the project."""
    try:
        return engine(*given, **named)
    except Exception as error:  # an engine may raise anything
        raise EngineFailure(describe_exception(error)) from error


def ask_ratios(
    evaluate: Evaluate, model: Model, states: list[State], quantities: Iterable[str]
) -> dict[str, float]:
    """Call an engine; return by quantity the largest error in bounds, inf of what it does not give."""
    answers, right = ask(evaluate, model, states), Predictor(model, states, View()).right
    bounds = rounding_bounds(model, states)
    return {
        q: error_ratio(values_of(answers, q) - right[q], tolerances(bounds, q))
        if all(getattr(answer, q) is not None for answer in answers)
        else np.inf
        for q in quantities
    }


def scatter_cause(quantities: Sequence[str], scatter: float) -> Cause:
    """State how an error scatters."""
    is_loss = scatter >= MIN_SCATTER
    verb = "lose digits: they scatter" if is_loss else "have a cause: they scatter"
    text = f"{verb} by {scatter:.2g} of their error when world and body axes are turned by {TURN:g} rad"
    kind: CauseKind = "rounding" if is_loss else "unexplained"
    return Cause(kind, quantity_words(quantities), "", text, (scatter,), quantities=tuple(quantities))


def growth_words(ratios: dict[int, float]) -> str:
    """Say whether an error grows with the number of bodies by more than its bound does.

    Args:
        ratios: errors in rounding bounds of the first n bodies, by n, descending.

    """
    largest = list(ratios.values())
    if len(largest) < 2 or not largest[0] > MIN_GROWTH * largest[1]:
        return "; rounding or noise in the algorithm"
    lengths = ", ".join(f"{ratio:.2g} for {n}" for n, ratio in ratios.items())
    text = f", and the error grows with the number of bodies (in rounding bounds: {lengths})"
    return f"{text}; rounding in the algorithm"


def worst_difference(
    model: Model,
    reported: Sequence[StateQuantities],
    truth: StateTruth,
    quantities: Sequence[str] = QUANTITIES,
) -> Difference:
    """Return the difference at the state where it is largest, of the quantities that the engine offers."""
    ratios = np.max([error_ratios(reported, truth, q) for q in quantities], axis=0)
    at = int(np.argmax(np.nan_to_num(ratios, posinf=0.0)))
    return Difference(model, reported, truth, View(tuple(quantities)), [at])


def find_digit_loss(problem: Difference, evaluate: Evaluate) -> Cause | None:
    """Test whether the error at the worst state scatters when all axes are turned by a tiny angle.

    Returns:
        The loss; None where the error has a cause, or where the engine fails on the turned problems.

    """
    scatter = measure_scatter(problem, evaluate)
    if scatter is None or scatter < MIN_SCATTER:
        return None
    found = scatter_cause(problem.names, scatter)
    return replace(found, change=found.change + growth_words(_ratios(problem, evaluate)))


def measure_scatter(problem: Difference, evaluate: Evaluate) -> float | None:
    """Measure how the error at the worst state scatters when all axes are turned by a tiny angle.

    Returns:
        The median distance of the errors from their mean, over their size; None where the engine fails.

    """
    model, (state,) = problem.model, problem.predictor.states

    def error(turns: Turns | None) -> Array:
        if turns is None:
            ask(evaluate, model, [state])  # what an engine keeps is then of this problem
            return problem.values
        turned, at = _turned(model, state, turns)
        answers = ask(evaluate, turned, [at])
        values = {q: values_of(answers, q) for q in problem.names}
        return problem.off(unrotate(unrotate(values, WORLD_VECTORS, turns[0]), BODY_VECTORS, turns[1]))

    return _scatter(error)


def measure_step_scatter(
    model: Model, state: State, h: float, method: JointSpaceMethod, step: Callable[[Model, State], StepRun]
) -> float | None:
    """Measure how the error of a step scatters when all axes are turned by a tiny angle.

    Args:
        state: where the step starts.
        h: step [s].

    Returns:
        As `measure_scatter`.

    """

    def error(turns: Turns | None) -> Array:  # turning it back would change it by the angle only
        turned, start = (model, state) if turns is None else _turned(model, state, turns)
        run = ask(step, turned, start)
        formula = FormulaSteps(method, turned, [start], [(0, h, run.angle_axes)], [RESIDUAL_STEPS])
        return formula.residuals(method, [run], turned)

    return _scatter(error)


def _turned(model: Model, state: State, turns: Turns) -> tuple[Model, State]:
    return rotate_body_frames(*rotate_world(model, state, turns[0]), turns[1])


def _scatter(error: Callable[[Turns | None], Array]) -> float | None:
    """Median distance of errors of turned problems from their mean over their median length.

    0 where they are not finite, or all much shorter than that of the problem: then it is not they that
    scatter; None where the engine refuses a problem.
    """
    rng = np.random.default_rng(0)
    try:
        own = error(None)
        errors = np.array([error((_tiny_rotation(rng), _tiny_rotation(rng))) for _ in range(COPIES)])
    except REFUSALS:
        return None
    largest = float(max(np.max(np.abs(errors)), np.max(np.abs(own))))
    if not 0 < largest < np.inf:
        return 0.0
    errors, own = errors / largest, own / largest
    distances = np.linalg.norm(errors - np.mean(errors, axis=0), axis=1)
    length = float(np.median(np.linalg.norm(errors, axis=1)))
    return float(np.median(distances)) / length if length > MIN_COPY_ERROR * np.linalg.norm(own) else 0.0


def _tiny_rotation(rng: np.random.Generator) -> Array:
    """Unit quaternion of a rotation by `TURN` about a random axis."""
    axis = rng.normal(size=3)
    return np.array([np.cos(TURN / 2), *(np.sin(TURN / 2) * axis / np.linalg.norm(axis))])


def _ratios(problem: Difference, evaluate: Evaluate) -> dict[int, float]:
    """Worst error, in rounding bounds, of the whole mechanism and of its first half and quarter."""
    model, (state,), ratios = problem.model, problem.predictor.states, dict[int, float]()
    for n in sorted({model.n, -(-model.n // 2), -(-model.n // 4)}, reverse=True):
        short, at = bodies_between(model, state, 0, n)
        try:
            ratios[n] = max(ask_ratios(evaluate, short, [at], problem.names).values())
        except REFUSALS:  # of a part of the mechanism
            continue
    return ratios
