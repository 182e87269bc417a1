"""Loss of digits as a mechanism: the error is no function of the problem but of its last bits.

A wrong term or parameter gives nearly the same error where the axes of the world and of the bodies are
turned by a millionth of a radian.
Rounding that an algorithm amplifies gives another error each time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from plumbline.diagnosis.defect_model import evaluate_case, make_defect_case
from plumbline.diagnosis.fit import Answers, ObservedDifference, max_error_ratio
from plumbline.model.datatypes import Array, Model, State, StateQuantities, StepRun
from plumbline.model.equivalent import (
    BODY_VECTORS,
    WORLD_VECTORS,
    first_bodies,
    rotate_body_frames,
    rotate_world,
    unrotate,
)
from plumbline.model.step_methods import JointSpaceMethod
from plumbline.truth.rounding_bound import state_rounding_bound
from plumbline.truth.step_comparison import FormulaSteps

COPIES = 8
TURN = 1e-6  # rad
MIN_SCATTER = 0.3  # of the error; 0.5 to 1 where its digits are lost, about TURN where it has a cause
MIN_COPY_ERROR = 0.02  # of the error; an engine that keeps the call before is off by about TURN in a copy
MIN_GROWTH = 4.0  # of the error in rounding bounds, from half of the chain to the whole

Evaluate = Callable[[Model, list[State]], list[StateQuantities]]


def describe_scatter(scatter: float) -> str:
    """Describe how an error scatters.

    Args:
        scatter: of `measure_scatter`.

    Returns:
        A sentence without subject.

    """
    verb = "loses digits: the answer scatters" if scatter >= MIN_SCATTER else "has a cause: it scatters"
    return f"{verb} by {scatter:.2g} of its error when world and body axes are turned by {TURN:g} rad"


@dataclass(frozen=True)
class DigitLoss:
    """How the error of an engine scatters, and how it depends on the length of the chain."""

    scatter: float  # median distance of the errors of equivalent problems from their mean, over their size
    ratio_by_length: dict[int, float]  # error in rounding bounds of the first n bodies, by n, descending

    @property
    def grows(self) -> bool:
        """Whether the error grows with the chain by more than its bound does."""
        ratios = list(self.ratio_by_length.values())
        return len(ratios) > 1 and ratios[0] > MIN_GROWTH * ratios[1]

    def describe(self) -> str:
        """Describe the loss.

        Returns:
            A sentence without subject.

        """
        text = (
            f"loses digits: the answer scatters by {self.scatter:.2g} of its error when world and body "
            f"axes are turned by {TURN:g} rad"
        )
        if self.grows:
            lengths = ", ".join(f"{ratio:.2g} for {n}" for n, ratio in self.ratio_by_length.items())
            text += f", and the error grows with the chain (in rounding bounds: {lengths} bodies)"
            return text + "; rounding in the algorithm"
        return text + "; rounding or noise in the algorithm"


def find_digit_loss(difference: ObservedDifference, model: Model, evaluate: Evaluate) -> DigitLoss | None:
    """Test whether the error at the worst state scatters when all axes are turned by a tiny angle.

    Returns:
        The loss; None where the error has a cause, or where the engine fails on the turned problems.

    """
    try:
        scatter, here, state = _measure_scatter(difference, model, evaluate)
        return DigitLoss(scatter, _ratios(here, model, state, evaluate)) if scatter >= MIN_SCATTER else None
    except Exception:  # an engine may raise anything; then nothing is known about its digits
        return None


def measure_scatter(difference: ObservedDifference, model: Model, evaluate: Evaluate) -> float | None:
    """Measure how the error at the worst state scatters when all axes are turned by a tiny angle.

    Returns:
        The median distance of the errors from their mean, over their size; None where the engine fails.

    """
    try:
        return _measure_scatter(difference, model, evaluate)[0]
    except Exception:  # as above
        return None


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
    rng = np.random.default_rng(0)
    problems = [(model, state)]
    problems += [
        rotate_body_frames(*rotate_world(model, state, _tiny_rotation(rng)), _tiny_rotation(rng))
        for _ in range(COPIES)
    ]
    try:
        # turning an error back would change it by the angle only
        errors = []
        for turned, turned_state in problems:
            run = step(turned, turned_state)
            formula = FormulaSteps(method, turned, [turned_state], [(0, h, run.angle_axes)])
            errors.append(formula.residuals(method, [run]))
        return _scatter(np.array(errors[1:]), errors[0])
    except Exception:  # as above
        return None


def _measure_scatter(
    difference: ObservedDifference, model: Model, evaluate: Evaluate
) -> tuple[float, ObservedDifference, State]:
    """The scatter at the worst state, the difference there, and the state."""
    each = [difference.at_state(i) for i in range(len(difference.case.p))]
    worst = int(np.argmax([here.error_ratio(here.expected) for here in each]))
    here, (_, state) = each[worst], difference.case.model_and_state(worst)
    rng = np.random.default_rng(0)
    errors = []
    evaluate(model, [state])  # an engine that keeps something of the call before keeps it of this problem
    for _ in range(COPIES):
        world, body = (_tiny_rotation(rng) for _ in range(2))
        turned, turned_state = rotate_body_frames(*rotate_world(model, state, world), body)
        (answer,) = evaluate(turned, [turned_state])
        values = unrotate(unrotate(_values(answer, here), WORLD_VECTORS, world), BODY_VECTORS, body)
        errors.append(here.weighted_vector({name: x - here.expected[name] for name, x in values.items()}))
    return _scatter(np.array(errors), here.residual(here.expected)), here, state


def _tiny_rotation(rng: np.random.Generator) -> Array:
    """Unit quaternion of a rotation by `TURN` about a random axis."""
    axis = rng.normal(size=3)
    return np.array([np.cos(TURN / 2), *(np.sin(TURN / 2) * axis / np.linalg.norm(axis))])


def _scatter(errors: Array, error: Array) -> float:
    """Median distance of vectors (COPIES, K) from their mean over their median length.

    0 where they are not finite, or all much shorter than ``error`` (K,): then it is not they that scatter.
    """
    largest = float(max(np.max(np.abs(errors)), np.max(np.abs(error))))
    if not 0 < largest < np.inf:
        return 0.0
    errors, error = errors / largest, error / largest
    distances = np.linalg.norm(errors - np.mean(errors, axis=0), axis=1)
    length = float(np.median(np.linalg.norm(errors, axis=1)))
    return float(np.median(distances)) / length if length > MIN_COPY_ERROR * np.linalg.norm(error) else 0.0


def _values(answer: StateQuantities, here: ObservedDifference) -> Answers:
    """The quantities of one answer as a batch of one state."""
    return {name: np.asarray(getattr(answer, name), float)[None] for name in here.reported}


def _ratios(here: ObservedDifference, model: Model, state: State, evaluate: Evaluate) -> dict[int, float]:
    """Worst error, in rounding bounds, of the whole chain and of its first half and quarter."""
    ratios = {model.n: here.error_ratio(here.expected)}
    for n in sorted({-(-model.n // 2), -(-model.n // 4)} - {model.n}, reverse=True):
        short, at = first_bodies(model, state, n)
        right = evaluate_case(make_defect_case(short, [at]))
        values, bound = _values(evaluate(short, [at])[0], here), state_rounding_bound(short, at)
        ratios[n] = max(
            max_error_ratio(x - right[name], np.array([bound.tolerance(name)])) for name, x in values.items()
        )
    return ratios
