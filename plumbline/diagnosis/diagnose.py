"""Which term is wrong: one change of a number, a term, a convention or an answer that explains a difference.

Every cause of `hypotheses` is put into the fast model of `suspect`; one with an amount is fitted by
Gauss–Newton on all quantities at once, each measured in its rounding bound.  A cause is named only
where what it predicts is what the engine said, to the rounding bound, for every quantity, body and
state looked at; all that pass are named, for then the data cannot tell them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from plumbline.diagnosis.defect_model import DefectCase, concatenate_cases, evaluate_case, make_defect_case
from plumbline.diagnosis.hypotheses import Cause, all_causes, format_significant, output_defects
from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Array, Model, State, StateQuantities
from plumbline.model.kinematics import state_from_minimal
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.rounding_bound import RoundingBound, state_rounding_bound

QUANTITIES = (
    "acceleration", "angular_acceleration", "joint_reaction", "kinetic_energy", "potential_energy",
    "angular_momentum",
)  # fmt: skip
MAX_STATES = 8  # looked at; fewer for long chains
MIN_SIGNIFICANT_RATIO = 3.0  # amounts below this many rounding bounds of their own are no change
MIN_DIAGNOSABLE_RATIO = (
    8.0  # bounds: of a hundred causes with an amount to fit, some explain a nearer difference by chance
)
MAX_EXPLAINED_RATIO = 1.0  # a prediction agrees within the sum of both states' bounds
MAX_ITERATIONS = 12
MAX_CANDIDATES = 12
DERIVATIVE_STEP = 1e-6  # relative step of the numerical derivatives
TINY = float(np.finfo(float).tiny)

Evaluate = Callable[[Model, list[State]], list[StateQuantities]]


@dataclass(frozen=True, eq=False)
class ObservedDifference:
    """What an engine said at S states, what is right, and the bounds; only the quantities that it offers."""

    case: DefectCase
    reported: dict[str, Array]  # (S, …)
    expected: dict[str, Array]
    bounds: dict[str, Array]  # (S, 1 or N)
    previous_expected: dict[str, Array]  # right answers at the state before each; the first has none

    def error_ratios(
        self, predicted: dict[str, Array], bounds: dict[str, Array] | None = None
    ) -> dict[str, float]:
        """Largest distance of what was said from a prediction, per quantity, in bounds."""
        allowed = bounds or self.bounds
        return {q: max_error_ratio(self.reported[q] - predicted[q], allowed[q]) for q in self.reported}

    def weighted_vector(self, x: dict[str, Array]) -> Array:
        """All quantities as one vector, in bounds."""
        parts = []
        for q in self.reported:
            b = np.maximum(self.bounds[q], TINY)
            parts.append((x[q] / (b[..., None] if x[q].ndim > b.ndim else b)).ravel())
        return np.concatenate(parts)


def max_error_ratio(difference: Array, bound: Array) -> float:
    """Largest ‖difference‖/bound over states (and bodies)."""
    size = np.abs(difference) if difference.ndim == 1 else np.linalg.norm(difference, axis=-1)
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.max(size / np.maximum(bound, TINY)))


def explain_disagreement(
    engine: str, model: Model, engine_quantities: list[StateQuantities], truth: StateTruth
) -> str:
    """Load the engine and diagnose answers of it that disagree with the truth (to be called in a worker).

    Args:
        engine: its name in the registry.
        model: the pendulum.
        engine_quantities: the engine's answer at each of the truth's states.
        truth: the right answers and their rounding bounds.

    Returns:
        A sentence that names the wrong term.

    """
    return diagnose(model, engine_quantities, truth, load_adapter(engine).evaluate)


def diagnose(
    model: Model,
    said: Sequence[StateQuantities],
    truth: StateTruth,
    evaluate: Evaluate | None = None,
) -> str:
    """The guilty term in a sentence, or that none was found, and where the difference lives.

    ``evaluate`` asks the engine again, for the extra states that localise the difference: at rest, without
    gravity, without loads and drag.
    """
    seen = observe_difference(model, said, truth)
    if max(seen.error_ratios(seen.expected).values()) <= MAX_EXPLAINED_RATIO:
        return "accelerations, reactions, energies and momentum are right: it is in the mass matrix alone"
    near = max(seen.error_ratios(seen.expected).values()) <= MIN_DIAGNOSABLE_RATIO
    whole = [] if near else find_explanations(seen)
    if near:
        text = "too near the rounding bound for any one term to be named"
    elif whole:
        text = "behaves as if " + "; or, which these data cannot tell apart, as if ".join(whole)
    else:
        texts = {
            q: diagnose_quantity(seen, q)
            for q, ratio in seen.error_ratios(seen.expected).items()
            if ratio > MAX_EXPLAINED_RATIO
        }
        named = [text for text in dict.fromkeys(texts.values()) if text]
        unnamed = [q.replace("_", " ") for q, text in texts.items() if not text]
        text = "behaves as if " + "; and ".join(named) if named else ""
        if unnamed:
            none = f"no single change of a parameter, term or convention explains the {' and '.join(unnamed)}"
            text = f"{text}; {none}" if text else none
    where = localise_difference(model, seen, evaluate) if evaluate else ""
    return text + (f" ({where})" if where else "")


def observe_difference(
    model: Model, said: Sequence[StateQuantities], truth: StateTruth
) -> ObservedDifference:
    """The states around the worst one, consecutive, so that a stale answer is seen."""
    quantities = [q for q in QUANTITIES if all(getattr(a, q) is not None for a in said)]
    count = min(len(said), MAX_STATES if model.n <= 6 else 4 if model.n <= 12 else 2)
    ratios = [
        max(
            max_error_ratio(np.asarray(getattr(a, q) - getattr(t, q))[None], bound_tolerance(b, q))
            for q in quantities
        )
        for a, t, b in zip(said, truth.quantities, truth.bounds, strict=True)
    ]
    first = int(np.clip(int(np.argmax(ratios)) - count // 2, 0, len(said) - count))
    window = range(first, first + count)

    def column(answers: Sequence[StateQuantities], q: str, back: int = 0) -> Array:
        return np.array([np.asarray(getattr(answers[i - back], q), float) for i in window])

    return ObservedDifference(
        make_defect_case(model, [truth.states[i] for i in window]),
        {q: column(said, q) for q in quantities},
        {q: column(truth.quantities, q) for q in quantities},
        {q: np.array([bound_tolerance(truth.bounds[i], q) for i in window]) for q in quantities},
        {q: column(truth.quantities, q, 1) for q in quantities},
    )


def bound_tolerance(bound: RoundingBound, quantity: str) -> Array:
    """(N,) or () tolerance of one state."""
    return np.asarray(bound.tolerance(quantity), float)


# --- causes -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FittedCause:
    """A cause with the amount that fits best."""

    cause: Cause
    fitted_amount: float
    resolution: float  # what a rounding bound in the data does to the amount


def find_explanations(difference: ObservedDifference) -> list[str]:
    """Words for every cause that explains all quantities, conventions before numbers."""
    model_right = evaluate_case(difference.case)
    data = difference.weighted_vector(
        {q: difference.reported[q] - difference.expected[q] for q in difference.reported}
    )
    found = list(all_causes(difference.case))
    discrete = [FittedCause(c, c.nominal, 0.0) for c in found if c.scale is None]
    fitted = fit_causes(difference, model_right, data, [c for c in found if c.scale is not None])
    named = [fit for fit in [*discrete, *fitted] if is_explanation(difference, model_right, fit)]
    return [fit.cause.describe(fit.fitted_amount, fit.resolution) for fit in named]


def predict_answers(
    difference: ObservedDifference, model_answers: dict[str, Array], altered: DefectCase
) -> dict[str, Array]:
    """The right answers, changed as the fast model changes: its own rounding cancels."""
    model_said = evaluate_case(altered)
    return {q: difference.expected[q] + (model_said[q] - model_answers[q]) for q in difference.reported}


def is_explanation(difference: ObservedDifference, model_answers: dict[str, Array], fit: FittedCause) -> bool:
    """Whether the cause predicts what was said, within the bounds of the right and the altered pendulum."""
    altered = fit.cause.alter(difference.case, fit.fitted_amount)
    with np.errstate(all="ignore"):  # a cause may be no pendulum at all: a mass below zero, say
        try:
            predicted = predict_answers(difference, model_answers, altered)
            if max(difference.error_ratios(predicted).values()) <= MAX_EXPLAINED_RATIO:
                return True
            bounds = [state_rounding_bound(*altered.model_and_state(i)) for i in range(len(altered.p))]
        except np.linalg.LinAlgError:
            return False
    both = {
        q: difference.bounds[q] + np.array([bound_tolerance(b, q) for b in bounds])
        for q in difference.reported
    }
    return max(difference.error_ratios(predicted, both).values()) <= MAX_EXPLAINED_RATIO


def derivatives_by_amount(difference: ObservedDifference, at: Sequence[tuple[Cause, float]]) -> Array:
    """(causes, K) central derivatives of the answers by each cause's amount, in bounds per unit."""
    size, columns = len(difference.case.p), []
    many = max(1, 4096 // (size * difference.case.n**2))
    for start in range(0, len(at), many):
        some = at[start : start + many]
        steps = [DERIVATIVE_STEP * (c.scale or 1.0) for c, _ in some]
        sides = [
            c.alter(difference.case, x + s * h)
            for (c, x), h in zip(some, steps, strict=True)
            for s in (1, -1)
        ]
        said = evaluate_case(concatenate_cases(sides))
        for i, h in enumerate(steps):
            up, down = (slice((2 * i + j) * size, (2 * i + j + 1) * size) for j in (0, 1))
            columns.append(
                difference.weighted_vector(
                    {q: (said[q][up] - said[q][down]) / (2 * h) for q in difference.reported}
                )
            )
    return np.array(columns)


def fit_causes(
    difference: ObservedDifference, model_answers: dict[str, Array], data: Array, found: Sequence[Cause]
) -> list[FittedCause]:
    """The causes that point most nearly along the difference, each with its fitted amount."""
    slopes = derivatives_by_amount(difference, [(c, c.nominal) for c in found])
    square = np.sum(slopes**2, axis=1)
    scale = np.array([c.scale or 1.0 for c in found])
    visible = square * scale**2 > 1.0  # a change of its natural size is one rounding bound at least
    along = np.where(visible, (slopes @ data) ** 2 / np.maximum(square, TINY), 0.0) / (data @ data)
    best = [int(i) for i in np.argsort(-along)[:MAX_CANDIDATES] if along[i] > 0.01]
    return [fit for i in best if (fit := fit_cause(difference, model_answers, found[i], slopes[i]))]


def fit_cause(
    difference: ObservedDifference, model_answers: dict[str, Array], cause: Cause, slope: Array
) -> FittedCause | None:
    """Gauss–Newton from the usual amount; None where it does not settle on a change that is seen."""
    x, fine, best = cause.nominal, np.inf, np.inf
    for _ in range(MAX_ITERATIONS):
        try:
            predicted = predict_answers(difference, model_answers, cause.alter(difference.case, x))
            left = difference.weighted_vector(
                {q: difference.reported[q] - predicted[q] for q in difference.reported}
            )
            if not np.all(np.isfinite(left)) or float(left @ left) > best * 4:
                return None
            best = min(best, float(left @ left))
            if x != cause.nominal:
                (slope,) = derivatives_by_amount(difference, [(cause, x)])
        except np.linalg.LinAlgError:
            return None
        step = float(slope @ left / (slope @ slope))
        x += step
        fine = 1 / float(np.linalg.norm(slope))
        if abs(step) < 0.1 * fine or abs(step) < 1e-15 * abs(x):
            break
    return FittedCause(cause, x, fine) if abs(x - cause.nominal) > MIN_SIGNIFICANT_RATIO * fine else None


# --- answers ------------------------------------------------------------------------------------


def diagnose_quantity(difference: ObservedDifference, quantity: str) -> str | None:
    """What one quantity is instead of what it is said to be, or None."""
    name, said, right = (
        quantity.replace("_", " "),
        difference.reported[quantity],
        difference.expected[quantity],
    )

    def is_(x: Array, rows: slice = slice(None)) -> bool:
        return (
            max_error_ratio((said - x)[rows], (2 * difference.bounds[quantity])[rows]) <= MAX_EXPLAINED_RATIO
        )

    if len(said) > 2 and is_(difference.previous_expected[quantity], slice(1, None)):
        return f"{name} of the state before were given (a stale field)"
    for reading in output_defects():
        if reading.quantity == quantity and is_(reading.compute(difference.case, difference.expected)):
            return reading.describe
    bound = difference.bounds[quantity]
    weight = 1 / np.maximum(bound[..., None] if said.ndim > bound.ndim else bound, TINY)
    factor = float(np.sum(said * right * weight**2) / max(float(np.sum((right * weight) ** 2)), TINY))
    if is_(factor * right):
        if abs(factor + 1) < 1e-9:
            return f"{name} with the opposite sign were given"
        return f"{name} were {format_significant(factor, 1.0, 0.0)} times as large"
    if np.all(said == np.asarray(said, np.float32)):
        return f"{name} were rounded to single precision"
    offset = np.mean(said - right, axis=0)
    if len(said) > 2 and is_(right + offset):
        if quantity == "potential_energy":
            return f"origin of the potential energy were elsewhere: {offset:.6g} J more at every state"
        return f"a constant were added to the {name} at every state"
    return None


# --- where --------------------------------------------------------------------------------------


def localise_difference(model: Model, difference: ObservedDifference, evaluate: Evaluate) -> str:
    """Where the difference persists: asked again at rest, without gravity, without loads and drag."""
    states = [difference.case.model_and_state(i)[1] for i in range(min(len(difference.case.p), 4))]
    still = [state_from_minimal(model, s.p, 0 * s.omega, s.u, 0 * s.udot) for s in states]
    trials = [
        ("at rest", model, still),
        ("without gravity", replace(model, gravity=0 * model.gravity), states),
    ]
    if model.has_loads or model.has_drag:
        bare = {k: 0 * getattr(model, k) for k in ("force", "moment", "drag_force", "drag_moment")}
        trials.append(("without loads and drag", replace(model, **bare), states))
    said = []
    for name, changed, at in trials:
        try:
            answers = evaluate(changed, at)
        except Exception as error:  # an engine may raise anything; a failure there says something too
            said.append(f"fails {name}: {' '.join(str(error).split())[:80]}")
            continue
        right = evaluate_case(make_defect_case(changed, at))
        bounds = [state_rounding_bound(changed, s) for s in at]
        ratio = max(
            max_error_ratio(
                np.array([np.asarray(getattr(a, q), float) for a in answers]) - right[q],
                np.array([bound_tolerance(b, q) for b in bounds]),
            )
            for q in difference.reported
        )
        said.append(f"{'vanishes' if ratio <= MAX_EXPLAINED_RATIO else 'persists'} {name}")
    return "the difference " + ", ".join(said)
