"""Find the one change of a number, a term, a convention or a returned quantity that explains a difference.

Every cause of `hypotheses` is evaluated with `defect_model`; a cause with an amount is fitted by Gauss–Newton
to all quantities at once, each in units of its rounding bound.  A cause is named only where it predicts what
the engine reported within the rounding bounds, for every quantity, body and state examined.  All causes that
pass are named, because the data cannot distinguish them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from plumbline.diagnosis.defect_model import DefectCase, concatenate_cases, evaluate_case, make_defect_case
from plumbline.diagnosis.hypotheses import Cause, all_causes, format_significant
from plumbline.diagnosis.output_defects import OUTPUT_DEFECTS
from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Array, Model, State, StateQuantities
from plumbline.model.kinematics import state_from_minimal
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.rounding_bound import state_rounding_bound

QUANTITIES = (
    "acceleration", "angular_acceleration", "joint_reaction", "kinetic_energy", "potential_energy",
    "angular_momentum",
)  # fmt: skip
MAX_STATES = 8  # examined; fewer for long chains
MIN_SIGNIFICANT_RATIO = 3.0  # an amount must differ from its nominal by this many times its resolution
MIN_DIAGNOSABLE_RATIO = (
    8.0  # in bounds: of a hundred fitted causes, some explain a smaller difference by chance
)
MAX_EXPLAINED_RATIO = 1.0  # in bounds: a prediction agrees within the sum of both states' bounds
MAX_ITERATIONS = 12
MAX_CANDIDATES = 12
DERIVATIVE_STEP = 1e-6  # of central differences, relative to the cause's scale
TINY = float(np.finfo(float).tiny)

Answers = dict[str, Array]
Evaluate = Callable[[Model, list[State]], list[StateQuantities]]


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

    def weighted_vector(self, x: Answers) -> Array:
        """Flatten quantities into one vector without units.

        Args:
            x: quantities by name, shaped as ``reported``.

        Returns:
            (K,) all entries of all quantities, in bounds.

        """
        return np.concatenate([(x[q] / _per_entry(self.bounds[q], x[q])).ravel() for q in self.reported])

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


def explain_disagreement(
    engine: str, model: Model, engine_quantities: list[StateQuantities], truth: StateTruth
) -> str:
    """Diagnose quantities that disagree with the truth; loads the engine, so call it in a worker.

    Args:
        engine: its name in the registry.
        model: the mechanism.
        engine_quantities: what the engine returned at the states of ``truth``.
        truth: true quantities and bounds.

    Returns:
        The sentence of `diagnose`.

    """
    return diagnose(model, engine_quantities, truth, load_adapter(engine).evaluate)


def diagnose(
    model: Model,
    reported: Sequence[StateQuantities],
    truth: StateTruth,
    evaluate: Evaluate | None = None,
) -> str:
    """Name the defect that explains how an engine differs from the truth.

    Args:
        model: the mechanism.
        reported: what the engine returned at the states of ``truth``.
        truth: true quantities and bounds.
        evaluate: evaluates the engine again, at rest, without gravity, without loads and drag, to localise
            the difference; None to skip that.

    Returns:
        A sentence: "behaves as if …" or that no single change explains the difference, and where it persists.

    """
    difference = observe_difference(model, reported, truth)
    ratio = difference.error_ratio(difference.expected)
    if ratio <= MAX_EXPLAINED_RATIO:
        return "the difference is in the mass matrix alone; all other quantities are right"
    if ratio <= MIN_DIAGNOSABLE_RATIO:
        text = "the difference is too close to the rounding bound to name a single term"
    else:
        text = _describe_explanations(difference) or _describe_quantities(difference)
    return text + (f" ({_localise_difference(model, difference, evaluate)})" if evaluate else "")


def observe_difference(
    model: Model, reported: Sequence[StateQuantities], truth: StateTruth
) -> ObservedDifference:
    """Select consecutive states around the one with the largest error, so that stale fields can be detected.

    Args:
        model: the mechanism.
        reported: what the engine returned at the states of ``truth``.
        truth: true quantities and bounds.

    Returns:
        The data to be explained: at most `MAX_STATES` states, the quantities that the engine offers at all.

    """
    quantities = [q for q in QUANTITIES if all(getattr(a, q) is not None for a in reported)]
    count = min(len(reported), MAX_STATES if model.n <= 6 else 4 if model.n <= 12 else 2)
    everywhere = range(len(reported))

    def column(answers: Sequence[StateQuantities], q: str, states: Sequence[int]) -> Array:
        return np.array([np.asarray(getattr(answers[i], q), float) for i in states])

    def bounds(q: str, states: Sequence[int]) -> Array:
        return np.array([truth.bounds[i].tolerance(q) for i in states])

    ratios = [
        max(
            max_error_ratio(column(reported, q, [i]) - column(truth.quantities, q, [i]), bounds(q, [i]))
            for q in quantities
        )
        for i in everywhere
    ]
    first = int(np.clip(int(np.argmax(ratios)) - count // 2, 0, len(reported) - count))
    window = everywhere[first : first + count]
    return ObservedDifference(
        make_defect_case(model, [truth.states[i] for i in window]),
        {q: column(reported, q, window) for q in quantities},
        {q: column(truth.quantities, q, window) for q in quantities},
        {q: bounds(q, window) for q in quantities},
        {q: column(truth.quantities, q, [i - 1 for i in window]) for q in quantities},
    )


def _per_entry(bound: Array, values: Array) -> Array:
    """Bounds (S,) or (S, N), at least the smallest positive number, broadcast to the entries of vectors."""
    bound = np.maximum(bound, TINY)
    return bound[..., None] if values.ndim > bound.ndim else bound


# --- causes -------------------------------------------------------------------------------------


def _describe_explanations(difference: ObservedDifference) -> str:
    """Sentence that names every cause that explains all quantities; empty where there is none."""
    found = find_explanations(difference)
    if not found:
        return ""
    first, *others = (fit.cause.describe(fit.fitted_amount, fit.resolution) for fit, _ in found)
    text = f"behaves as if {first}"
    if others:
        text += f"; the data cannot distinguish this from: {'; '.join(others)}"
    return (
        text + f"; this explains the difference to {max(left for _, left in found):.2g} of the rounding bound"
    )


def find_explanations(difference: ObservedDifference) -> list[tuple[FittedCause, float]]:
    """Fit all causes and keep those that explain all quantities.

    Args:
        difference: the data to be explained.

    Returns:
        Causes, conventions before numbers, with the largest difference that they leave, in rounding bounds.

    """
    model_answers = evaluate_case(difference.case)
    causes = list(all_causes(difference.case))
    fits = [FittedCause(cause, cause.nominal, 0.0) for cause in causes if cause.scale is None]
    fits += fit_causes(difference, model_answers, [cause for cause in causes if cause.scale is not None])
    found = [(fit, remaining_ratio(difference, model_answers, fit)) for fit in fits]
    return [(fit, ratio) for fit, ratio in found if ratio <= MAX_EXPLAINED_RATIO]


def _predict_answers(difference: ObservedDifference, model_answers: Answers, altered: DefectCase) -> Answers:
    """The truth, changed as the fast model changes, so that the model's own rounding cancels."""
    answers = evaluate_case(altered)
    return {q: difference.expected[q] + (answers[q] - model_answers[q]) for q in difference.reported}


def remaining_ratio(difference: ObservedDifference, model_answers: Answers, fit: FittedCause) -> float:
    """Measure what a fitted cause leaves unexplained.

    Args:
        difference: the data to be explained.
        model_answers: quantities of the fast model without defect.
        fit: the cause and its amount.

    Returns:
        The largest remaining difference over the bounds of the true and, where needed, also of the altered
        mechanism; infinite where the altered numbers are no mechanism.

    """
    altered = fit.cause.alter(difference.case, fit.fitted_amount)
    with np.errstate(all="ignore"):  # the altered numbers may be no mechanism: a negative mass, for example
        try:
            predicted = _predict_answers(difference, model_answers, altered)
            ratio = difference.error_ratio(predicted)
            if ratio <= MAX_EXPLAINED_RATIO:
                return ratio
            bounds = [state_rounding_bound(*altered.model_and_state(i)) for i in range(len(altered.p))]
        except np.linalg.LinAlgError:
            return np.inf
    both = {q: x + np.array([b.tolerance(q) for b in bounds]) for q, x in difference.bounds.items()}
    ratio = difference.error_ratio(predicted, both)
    return ratio if np.isfinite(ratio) else np.inf


def derivatives_by_amount(difference: ObservedDifference, at: Sequence[tuple[Cause, float]]) -> Array:
    """Differentiate the quantities by the amounts of causes, by central differences.

    Args:
        difference: the data to be explained.
        at: causes with the amounts at which to differentiate.

    Returns:
        (causes, K) in bounds per unit of each amount.

    """
    size, columns = len(difference.case.p), []
    batch = max(1, 4096 // (size * difference.case.n**2))
    for start in range(0, len(at), batch):
        causes = at[start : start + batch]
        steps = [DERIVATIVE_STEP * (cause.scale or 1.0) for cause, _ in causes]
        sides = [
            cause.alter(difference.case, x + sign * h)
            for (cause, x), h in zip(causes, steps, strict=True)
            for sign in (1, -1)
        ]
        answers = evaluate_case(concatenate_cases(sides))
        for i, h in enumerate(steps):
            up, down = (slice((2 * i + j) * size, (2 * i + j + 1) * size) for j in (0, 1))
            slope = {q: (answers[q][up] - answers[q][down]) / (2 * h) for q in difference.reported}
            columns.append(difference.weighted_vector(slope))
    return np.array(columns)


def fit_causes(
    difference: ObservedDifference, model_answers: Answers, causes: Sequence[Cause]
) -> list[FittedCause]:
    """Fit the causes whose first-order effect is most nearly parallel to the difference.

    Args:
        difference: the data to be explained.
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
        difference: the data to be explained.
        model_answers: quantities of the fast model without defect.
        cause: a cause with an amount.
        slope: (K,) derivative of the data by the amount at its nominal value, in bounds per unit.

    Returns:
        The fit; None where it diverges or the amount does not differ significantly from the nominal one.

    """
    amount, resolution, best = cause.nominal, np.inf, np.inf
    for _ in range(MAX_ITERATIONS):
        try:
            predicted = _predict_answers(difference, model_answers, cause.alter(difference.case, amount))
            residual = difference.residual(predicted)
            if not np.all(np.isfinite(residual)) or float(residual @ residual) > best * 4:
                return None
            best = min(best, float(residual @ residual))
            if amount != cause.nominal:
                (slope,) = derivatives_by_amount(difference, [(cause, amount)])
        except np.linalg.LinAlgError:
            return None
        step = float(slope @ residual / (slope @ slope))
        amount += step
        resolution = 1 / float(np.linalg.norm(slope))
        if abs(step) < 0.1 * resolution or abs(step) < 1e-15 * abs(amount):
            break
    significant = abs(amount - cause.nominal) > MIN_SIGNIFICANT_RATIO * resolution
    return FittedCause(cause, amount, resolution) if significant else None


# --- returned quantities -------------------------------------------------------------------------


def _describe_quantities(difference: ObservedDifference) -> str:
    """Sentence that names a defect for each wrong quantity alone, as far as there is one."""
    wrong = [
        q
        for q, x in difference.expected.items()
        if max_error_ratio(difference.reported[q] - x, difference.bounds[q]) > MAX_EXPLAINED_RATIO
    ]
    texts = {q: diagnose_quantity(difference, q) for q in wrong}
    named = [text for text in dict.fromkeys(texts.values()) if text]
    unnamed = [q.replace("_", " ") for q, text in texts.items() if not text]
    parts = ["behaves as if " + "; and ".join(named)] if named else []
    if unnamed:
        parts.append(
            f"no single change of a parameter, term or convention explains the {' and '.join(unnamed)}"
        )
    return "; ".join(parts)


def diagnose_quantity(difference: ObservedDifference, quantity: str) -> str | None:
    """Find what an engine returned in place of one quantity.

    Args:
        difference: the data to be explained.
        quantity: name of the wrong quantity.

    Returns:
        The completion of "behaves as if …"; None where no known defect explains the quantity.

    """
    name = quantity.replace("_", " ")
    reported, expected = difference.reported[quantity], difference.expected[quantity]
    bound = difference.bounds[quantity]

    def matches(x: Array, rows: slice = slice(None)) -> bool:
        return max_error_ratio((reported - x)[rows], (2 * bound)[rows]) <= MAX_EXPLAINED_RATIO

    if len(reported) > 2 and matches(difference.previous_expected[quantity], slice(1, None)):
        return f"it returned the {name} of the previous state (a stale field)"
    for defect in OUTPUT_DEFECTS:
        if defect.quantity == quantity and matches(defect.compute(difference.case, difference.expected)):
            return defect.description
    weight = 1 / _per_entry(bound, reported)
    square = max(float(np.sum((expected * weight) ** 2)), TINY)
    factor = float(np.sum(reported * expected * weight**2) / square)
    if matches(factor * expected):
        if abs(factor + 1) < 1e-9:
            return f"it returned the {name} with the opposite sign"
        return f"it returned the {name} multiplied by {format_significant(factor, 1.0, 0.0)}"
    if np.all(reported == np.asarray(reported, np.float32)):
        return f"it rounded the {name} to single precision"
    offset = np.mean(reported - expected, axis=0)
    if len(reported) > 2 and matches(expected + offset):
        if quantity == "potential_energy":
            return f"the origin of the potential energy were elsewhere: {offset:+.6g} J at every state"
        return f"it added a constant to the {name} at every state"
    return None


# --- where the difference persists ----------------------------------------------------------------


def _localise_difference(model: Model, difference: ObservedDifference, evaluate: Evaluate) -> str:
    """Sentence on where the difference persists: at rest, without gravity, without loads and drag."""
    states = [difference.case.model_and_state(i)[1] for i in range(min(len(difference.case.p), 4))]
    at_rest = [state_from_minimal(model, s.p, 0 * s.omega, s.u, 0 * s.udot) for s in states]
    trials = [
        ("at rest", model, at_rest),
        ("without gravity", replace(model, gravity=0 * model.gravity), states),
    ]
    if model.has_loads or model.has_drag:
        unloaded = {k: 0 * getattr(model, k) for k in ("force", "moment", "drag_force", "drag_moment")}
        trials.append(("without loads and drag", replace(model, **unloaded), states))
    findings = []
    for name, changed, at in trials:
        try:
            answers = evaluate(changed, at)
        except Exception as error:  # an engine may raise anything; a failure here is information too
            findings.append(f"fails {name}: {' '.join(str(error).split())[:80]}")
            continue
        expected = evaluate_case(make_defect_case(changed, at))
        bounds = [state_rounding_bound(changed, s) for s in at]
        ratio = max(
            max_error_ratio(
                np.array([np.asarray(getattr(a, q), float) for a in answers]) - expected[q],
                np.array([b.tolerance(q) for b in bounds]),
            )
            for q in difference.reported
        )
        findings.append(f"{'vanishes' if ratio <= MAX_EXPLAINED_RATIO else 'persists'} {name}")
    return "the difference " + ", ".join(findings)
