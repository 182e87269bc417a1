"""Fit the amounts of causes to the difference between an engine and the truth, and test what they explain.

A cause with an amount is fitted by Gauss–Newton to all quantities at once, each in units of its rounding
bound.  It explains the difference where it predicts what the engine reported within the rounding bounds, for
every quantity, body and state.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from plumbline.diagnosis.defect_model import DefectCase, concatenate_cases, evaluate_case, select_states
from plumbline.diagnosis.hypotheses import Cause, all_causes
from plumbline.model.datatypes import Array
from plumbline.truth.rounding_bound import state_rounding_bound

MIN_SIGNIFICANT_RATIO = 3.0  # an amount must differ from its nominal by this many times its resolution
MAX_EXPLAINED_RATIO = 1.0  # in bounds: a prediction agrees within the sum of both states' bounds
MAX_ITERATIONS = 12
MAX_CANDIDATES = 16
DERIVATIVE_STEP = 1e-6  # of central differences, relative to the cause's scale
MIN_CHANGE_RATIO = 2.0  # in bounds of both pendulums: a smaller difference would need no change
TINY = float(np.finfo(float).tiny)

Answers = dict[str, Array]


@dataclass(frozen=True, eq=False)
class ObservedDifference:
    """What an engine reported at S states, the truth and the bounds, for the quantities that it offers."""

    case: DefectCase
    reported: Answers  # (S, …)
    expected: Answers
    bounds: Answers  # (S,) or (S, N)
    previous_expected: Answers  # the truth at the state before each; the first has none

    def error_ratio(self, predicted: Answers, bounds: Answers | None = None) -> float:
        """Measure how well a prediction matches what the engine reported.

        Args:
            predicted: predicted quantities, by name.
            bounds: bounds to divide by; default those of the states.

        Returns:
            The largest difference of any quantity, state and body, in bounds.

        """
        bounds = bounds or self.bounds
        ratios = [max_error_ratio(self.reported[q] - predicted[q], bounds[q]) for q in self.reported]
        return float(np.max(ratios))  # not a number where any of them is

    def wrong_quantities(self, ratio: float = MAX_EXPLAINED_RATIO) -> list[str]:
        """List the quantities whose error exceeds a number of bounds."""
        return [
            q
            for q, x in self.expected.items()
            if q in self.reported and not max_error_ratio(self.reported[q] - x, self.bounds[q]) <= ratio
        ]

    def at_state(self, i: int) -> ObservedDifference:
        """Restrict the data to one state.

        Args:
            i: its index.

        """
        return self._restricted(slice(i, i + 1), self.reported)

    def of_quantities(self, quantities: Sequence[str]) -> ObservedDifference:
        """Restrict the data to some quantities."""
        return self._restricted(slice(None), quantities)

    def _restricted(self, states: slice, quantities: Iterable[str]) -> ObservedDifference:
        parts = (self.reported, self.expected, self.bounds, self.previous_expected)
        case = select_states(self.case, range(len(self.case.p))[states])
        kept = ({q: part[q][states] for q in quantities if q in part} for part in parts)
        return ObservedDifference(case, *kept)

    def weighted_vector(self, x: Answers) -> Array:
        """Flatten quantities into one vector without units.

        Args:
            x: quantities by name, shaped as ``reported``.

        Returns:
            (K,) all entries of all quantities, in bounds.

        """
        return np.concatenate([(x[q] / per_entry(self.bounds[q], x[q])).ravel() for q in self.reported])

    def residual(self, predicted: Answers) -> Array:
        """Return what a prediction leaves unexplained.

        Args:
            predicted: predicted quantities, by name.

        Returns:
            (K,) reported minus predicted, in bounds.

        """
        return self.weighted_vector({q: self.reported[q] - predicted[q] for q in self.reported})


@dataclass(frozen=True)
class FittedCause:
    """A cause with the amount that fits best."""

    cause: Cause
    fitted_amount: float
    resolution: float  # change of the amount that moves the prediction by one rounding bound


def max_error_ratio(difference: Array, bound: Array) -> float:
    """Return the largest ‖difference‖/bound.

    Args:
        difference: (S,) scalars, or (S, ..., 3) vectors.
        bound: tolerances, of the shape of the norms.

    Returns:
        The largest ratio over states and bodies.

    """
    size = np.abs(difference) if difference.ndim == 1 else np.linalg.norm(difference, axis=-1)
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.max(size / np.maximum(bound, TINY)))


def per_entry(bound: Array, values: Array) -> Array:
    """Broadcast bounds to the entries of a quantity.

    Args:
        bound: (S,) or (S, N) tolerances.
        values: the quantity, (S, ...) scalars or vectors.

    Returns:
        Positive bounds that broadcast against ``values``.

    """
    bound = np.maximum(bound, TINY)
    return bound[..., None] if values.ndim > bound.ndim else bound


def find_explanations(
    difference: ObservedDifference, *, are_conventions_only: bool = False
) -> list[tuple[FittedCause, float]]:
    """Fit all causes and keep those that explain all quantities.

    Args:
        are_conventions_only: whether to try only causes without an amount: where the error scatters, no
            number explains it.

    Returns:
        Causes, conventions before numbers, with the largest difference that they leave, in rounding bounds.

    """
    model_answers = evaluate_case(difference.case)
    causes = list(all_causes(difference.case))
    fits = [FittedCause(cause, cause.nominal, 0.0) for cause in causes if cause.scale is None]
    if not are_conventions_only:
        fits += fit_causes(difference, model_answers, [cause for cause in causes if cause.scale is not None])
    found = [(fit, remaining_ratio(difference, model_answers, fit)) for fit in fits]
    return [(fit, ratio) for fit, ratio in found if ratio <= MAX_EXPLAINED_RATIO]


def remaining_ratio(difference: ObservedDifference, model_answers: Answers, fit: FittedCause) -> float:
    """Measure what a fitted cause leaves unexplained.

    Args:
        model_answers: quantities of the fast model without defect.

    Returns:
        The largest remaining difference over the bounds of the true and, where needed, also of the altered
        mechanism; infinite where the altered numbers are no mechanism, or where these bounds would allow the
        difference without any change. Above 1 it is that of the first state that is not explained.

    """
    altered = fit.cause.alter(difference.case, fit.fitted_amount)
    with np.errstate(all="ignore"):  # the altered numbers may be no mechanism: a negative mass, for example
        try:
            predicted = _predict_answers(difference, model_answers, evaluate_case(altered))
            ratio = difference.error_ratio(predicted)
            if ratio <= MAX_EXPLAINED_RATIO:
                return ratio
            worst = change = 0.0
            for i in range(len(altered.p)):  # the costly bounds one after the other, until one is exceeded
                bound = state_rounding_bound(*altered.model_and_state(i))
                both = {
                    q: x[i : i + 1] + np.array([bound.tolerance(q)]) for q, x in difference.bounds.items()
                }
                here = difference.at_state(i)
                ratio = here.error_ratio({q: x[i : i + 1] for q, x in predicted.items()}, both)
                if not ratio <= MAX_EXPLAINED_RATIO:  # also where it is not a number
                    return ratio if np.isfinite(ratio) else np.inf
                worst = max(worst, ratio)
                change = max(change, here.error_ratio(here.expected, both))
        except np.linalg.LinAlgError:
            return np.inf
    # bounds that would allow the difference without any change explain nothing
    return worst if change > MIN_CHANGE_RATIO else np.inf


def derivatives_by_amount(difference: ObservedDifference, at: Sequence[tuple[Cause, float]]) -> Array:
    """Differentiate the quantities by the amounts of causes, by central differences.

    Args:
        at: causes with the amounts at which to differentiate.

    Returns:
        (causes, K) in bounds per unit of each amount.

    """
    columns: list[Array] = []
    batch = max(1, 4096 // (len(difference.case.p) * difference.case.n**2))
    for start in range(0, len(at), batch):
        causes = at[start : start + batch]
        steps = [DERIVATIVE_STEP * (cause.scale or 1.0) for cause, _ in causes]
        sides = [
            cause.alter(difference.case, x + sign * h)
            for (cause, x), h in zip(causes, steps, strict=True)
            for sign in (1, -1)
        ]
        answers = _evaluate_together(sides)
        columns += [
            _slope(difference, up, down, h)
            for up, down, h in zip(answers[::2], answers[1::2], steps, strict=True)
        ]
    return np.array(columns)


def _slope(difference: ObservedDifference, up: Answers, down: Answers, h: float) -> Array:
    """Central difference over ± h, in bounds per unit."""
    return difference.weighted_vector({q: (up[q] - down[q]) / (2 * h) for q in difference.reported})


def _evaluate_together(cases: Sequence[DefectCase]) -> list[Answers]:
    """Answers of batches of equal size, evaluated as one."""
    size, answers = len(cases[0].p), evaluate_case(concatenate_cases(cases))
    return [{q: x[i * size : (i + 1) * size] for q, x in answers.items()} for i in range(len(cases))]


def fit_causes(
    difference: ObservedDifference, model_answers: Answers, causes: Sequence[Cause]
) -> list[FittedCause]:
    """Fit the causes whose first-order effect is most nearly parallel to the difference.

    Args:
        model_answers: quantities of the fast model without defect.
        causes: causes with an amount.

    Returns:
        At most `MAX_CANDIDATES` causes that converged to a significant amount.

    """
    data = difference.residual(difference.expected)
    slopes = derivatives_by_amount(difference, [(cause, cause.nominal) for cause in causes])
    square = np.sum(slopes**2, axis=1)
    scale = np.array([cause.scale or 1.0 for cause in causes])
    visible = (
        square * scale**2 > 1.0
    )  # a change of the natural size moves the data by a rounding bound or more
    alignment = np.where(visible, (slopes @ data) ** 2 / np.maximum(square, TINY), 0.0) / (data @ data)
    best = [int(i) for i in np.argsort(-alignment)[:MAX_CANDIDATES] if alignment[i] > 0.01]
    return [fit for i in best if (fit := fit_cause(difference, model_answers, causes[i], slopes[i]))]


def fit_cause(
    difference: ObservedDifference, model_answers: Answers, cause: Cause, slope: Array
) -> FittedCause | None:
    """Fit the amount of one cause by Gauss–Newton, starting from its nominal amount.

    Args:
        model_answers: quantities of the fast model without defect.
        cause: a cause with an amount.
        slope: (K,) derivative of the data by the amount at its nominal value, in bounds per unit.

    Returns:
        The fit; None where it diverges or the amount does not differ significantly from the nominal one.

    """
    amount, resolution, best = cause.nominal, np.inf, np.inf
    h = DERIVATIVE_STEP * (cause.scale or 1.0)
    for _ in range(MAX_ITERATIONS):
        moved = amount != cause.nominal
        try:
            here, *sides = _evaluate_together(
                [cause.alter(difference.case, amount + shift) for shift in (0.0, *((h, -h) if moved else ()))]
            )
        except np.linalg.LinAlgError:
            return None
        residual = difference.residual(_predict_answers(difference, model_answers, here))
        if not np.all(np.isfinite(residual)) or float(residual @ residual) > best * 4:
            return None
        best = min(best, float(residual @ residual))
        if moved:
            slope = _slope(difference, sides[0], sides[1], h)
        if not np.any(slope):  # the fit has reached amounts whose changes have no effect
            return None
        step = float(slope @ residual / (slope @ slope))
        amount += step
        resolution = 1 / float(np.linalg.norm(slope))
        if abs(step) < 0.1 * resolution or abs(step) < 1e-15 * abs(amount):
            break
    significant = abs(amount - cause.nominal) > MIN_SIGNIFICANT_RATIO * resolution
    return FittedCause(cause, amount, resolution) if significant else None


def _predict_answers(difference: ObservedDifference, model_answers: Answers, answers: Answers) -> Answers:
    """The truth, changed as the fast model changes, so that the model's own rounding cancels."""
    return {q: difference.expected[q] + (answers[q] - model_answers[q]) for q in difference.reported}
