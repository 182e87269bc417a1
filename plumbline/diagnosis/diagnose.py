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

from plumbline.diagnosis.defect_model import Case, answer, case, together
from plumbline.diagnosis.hypotheses import Cause, causes, digits, readings
from plumbline.model.datatypes import Array, Model, State, StateQuantities
from plumbline.model.kinematics import lift
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.rounding_bound import Bound, state_bound

QUANTITIES = (
    "acceleration", "angular_acceleration", "joint_reaction", "kinetic_energy", "potential_energy",
    "angular_momentum",
)  # fmt: skip
STATES = 8  # looked at; fewer for long chains
SEEN = 3.0  # amounts below this many rounding bounds of their own are no change
NEAR = 8.0  # bounds: of a hundred causes with an amount to fit, some explain a nearer difference by chance
EXPLAINED = 1.0  # a prediction agrees within the sum of both states' bounds
ITERATIONS = 12
CANDIDATES = 12
ROUGH = 1e-6  # relative step of the numerical derivatives
TINY = float(np.finfo(float).tiny)

Evaluate = Callable[[Model, list[State]], list[StateQuantities]]


@dataclass(frozen=True, eq=False)
class Difference:
    """What an engine said at S states, what is right, and the bounds; only the quantities that it offers."""

    case: Case
    said: dict[str, Array]  # (S, …)
    right: dict[str, Array]
    bounds: dict[str, Array]  # (S, 1 or N)
    before: dict[str, Array]  # right answers at the state before each; the first has none

    def off(self, predicted: dict[str, Array], bounds: dict[str, Array] | None = None) -> dict[str, float]:
        """Largest distance of what was said from a prediction, per quantity, in bounds."""
        allowed = bounds or self.bounds
        return {q: worst(self.said[q] - predicted[q], allowed[q]) for q in self.said}

    def weighted(self, x: dict[str, Array]) -> Array:
        """All quantities as one vector, in bounds."""
        parts = []
        for q in self.said:
            b = np.maximum(self.bounds[q], TINY)
            parts.append((x[q] / (b[..., None] if x[q].ndim > b.ndim else b)).ravel())
        return np.concatenate(parts)


def worst(difference: Array, bound: Array) -> float:
    """Largest ‖difference‖/bound over states (and bodies)."""
    size = np.abs(difference) if difference.ndim == 1 else np.linalg.norm(difference, axis=-1)
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.max(size / np.maximum(bound, TINY)))


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
    seen = observe(model, said, truth)
    if max(seen.off(seen.right).values()) <= EXPLAINED:
        return "accelerations, reactions, energies and momentum are right: it is in the mass matrix alone"
    near = max(seen.off(seen.right).values()) <= NEAR
    whole = [] if near else explanations(seen)
    if near:
        text = "too near the rounding bound for any one term to be named"
    elif whole:
        text = "behaves as if " + "; or, which these data cannot tell apart, as if ".join(whole)
    else:
        texts = {q: misread(seen, q) for q, ratio in seen.off(seen.right).items() if ratio > EXPLAINED}
        named = [text for text in dict.fromkeys(texts.values()) if text]
        unnamed = [q.replace("_", " ") for q, text in texts.items() if not text]
        text = "behaves as if " + "; and ".join(named) if named else ""
        if unnamed:
            none = f"no single change of a parameter, term or convention explains the {' and '.join(unnamed)}"
            text = f"{text}; {none}" if text else none
    where = localised(model, seen, evaluate) if evaluate else ""
    return text + (f" ({where})" if where else "")


def observe(model: Model, said: Sequence[StateQuantities], truth: StateTruth) -> Difference:
    """The states around the worst one, consecutive, so that a stale answer is seen."""
    quantities = [q for q in QUANTITIES if all(getattr(a, q) is not None for a in said)]
    count = min(len(said), STATES if model.n <= 6 else 4 if model.n <= 12 else 2)
    ratios = [
        max(worst(np.asarray(getattr(a, q) - getattr(t, q))[None], tolerance(b, q)) for q in quantities)
        for a, t, b in zip(said, truth.quantities, truth.bounds, strict=True)
    ]
    first = int(np.clip(int(np.argmax(ratios)) - count // 2, 0, len(said) - count))
    window = range(first, first + count)

    def column(answers: Sequence[StateQuantities], q: str, back: int = 0) -> Array:
        return np.array([np.asarray(getattr(answers[i - back], q), float) for i in window])

    return Difference(
        case(model, [truth.states[i] for i in window]),
        {q: column(said, q) for q in quantities},
        {q: column(truth.quantities, q) for q in quantities},
        {q: np.array([tolerance(truth.bounds[i], q) for i in window]) for q in quantities},
        {q: column(truth.quantities, q, 1) for q in quantities},
    )


def tolerance(bound: Bound, quantity: str) -> Array:
    """(N,) or () tolerance of one state."""
    return np.asarray(bound.tolerance(quantity), float)


# --- causes -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fit:
    """A cause with the amount that fits best."""

    cause: Cause
    amount: float
    resolution: float  # what a rounding bound in the data does to the amount


def explanations(seen: Difference) -> list[str]:
    """Words for every cause that explains all quantities, conventions before numbers."""
    model_right = answer(seen.case)
    data = seen.weighted({q: seen.said[q] - seen.right[q] for q in seen.said})
    found = list(causes(seen.case))
    discrete = [Fit(c, c.usual, 0.0) for c in found if c.scale is None]
    fitted = fits(seen, model_right, data, [c for c in found if c.scale is not None])
    named = [fit for fit in [*discrete, *fitted] if explains(seen, model_right, fit)]
    return [fit.cause.words(fit.amount, fit.resolution) for fit in named]


def predict(seen: Difference, model_right: dict[str, Array], altered: Case) -> dict[str, Array]:
    """The right answers, changed as the fast model changes: its own rounding cancels."""
    model_said = answer(altered)
    return {q: seen.right[q] + (model_said[q] - model_right[q]) for q in seen.said}


def explains(seen: Difference, model_right: dict[str, Array], fit: Fit) -> bool:
    """Whether the cause predicts what was said, within the bounds of the right and the altered pendulum."""
    altered = fit.cause.alter(seen.case, fit.amount)
    with np.errstate(all="ignore"):  # a cause may be no pendulum at all: a mass below zero, say
        try:
            predicted = predict(seen, model_right, altered)
            if max(seen.off(predicted).values()) <= EXPLAINED:
                return True
            bounds = [state_bound(*altered.pendulum(i)) for i in range(len(altered.p))]
        except np.linalg.LinAlgError:
            return False
    both = {q: seen.bounds[q] + np.array([tolerance(b, q) for b in bounds]) for q in seen.said}
    return max(seen.off(predicted, both).values()) <= EXPLAINED


def derivatives(seen: Difference, at: Sequence[tuple[Cause, float]]) -> Array:
    """(causes, K) central derivatives of the answers by each cause's amount, in bounds per unit."""
    size, columns = len(seen.case.p), []
    many = max(1, 4096 // (size * seen.case.n**2))
    for start in range(0, len(at), many):
        some = at[start : start + many]
        steps = [ROUGH * (c.scale or 1.0) for c, _ in some]
        sides = [
            c.alter(seen.case, x + s * h) for (c, x), h in zip(some, steps, strict=True) for s in (1, -1)
        ]
        said = answer(together(sides))
        for i, h in enumerate(steps):
            up, down = (slice((2 * i + j) * size, (2 * i + j + 1) * size) for j in (0, 1))
            columns.append(seen.weighted({q: (said[q][up] - said[q][down]) / (2 * h) for q in seen.said}))
    return np.array(columns)


def fits(seen: Difference, model_right: dict[str, Array], data: Array, found: Sequence[Cause]) -> list[Fit]:
    """The causes that point most nearly along the difference, each with its fitted amount."""
    slopes = derivatives(seen, [(c, c.usual) for c in found])
    square = np.sum(slopes**2, axis=1)
    scale = np.array([c.scale or 1.0 for c in found])
    visible = square * scale**2 > 1.0  # a change of its natural size is one rounding bound at least
    along = np.where(visible, (slopes @ data) ** 2 / np.maximum(square, TINY), 0.0) / (data @ data)
    best = [int(i) for i in np.argsort(-along)[:CANDIDATES] if along[i] > 0.01]
    return [fit for i in best if (fit := fitted(seen, model_right, found[i], slopes[i]))]


def fitted(seen: Difference, model_right: dict[str, Array], cause: Cause, slope: Array) -> Fit | None:
    """Gauss–Newton from the usual amount; None where it does not settle on a change that is seen."""
    x, fine, best = cause.usual, np.inf, np.inf
    for _ in range(ITERATIONS):
        try:
            predicted = predict(seen, model_right, cause.alter(seen.case, x))
            left = seen.weighted({q: seen.said[q] - predicted[q] for q in seen.said})
            if not np.all(np.isfinite(left)) or float(left @ left) > best * 4:
                return None
            best = min(best, float(left @ left))
            if x != cause.usual:
                (slope,) = derivatives(seen, [(cause, x)])
        except np.linalg.LinAlgError:
            return None
        step = float(slope @ left / (slope @ slope))
        x += step
        fine = 1 / float(np.linalg.norm(slope))
        if abs(step) < 0.1 * fine or abs(step) < 1e-15 * abs(x):
            break
    return Fit(cause, x, fine) if abs(x - cause.usual) > SEEN * fine else None


# --- answers ------------------------------------------------------------------------------------


def misread(seen: Difference, quantity: str) -> str | None:
    """What one quantity is instead of what it is said to be, or None."""
    name, said, right = quantity.replace("_", " "), seen.said[quantity], seen.right[quantity]

    def is_(x: Array, rows: slice = slice(None)) -> bool:
        return worst((said - x)[rows], (2 * seen.bounds[quantity])[rows]) <= EXPLAINED

    if len(said) > 2 and is_(seen.before[quantity], slice(1, None)):
        return f"{name} of the state before were given (a stale field)"
    for reading in readings():
        if reading.quantity == quantity and is_(reading.of(seen.case, seen.right)):
            return reading.words
    bound = seen.bounds[quantity]
    weight = 1 / np.maximum(bound[..., None] if said.ndim > bound.ndim else bound, TINY)
    factor = float(np.sum(said * right * weight**2) / max(float(np.sum((right * weight) ** 2)), TINY))
    if is_(factor * right):
        if abs(factor + 1) < 1e-9:
            return f"{name} with the opposite sign were given"
        return f"{name} were {digits(factor, 1.0, 0.0)} times as large"
    if np.all(said == np.asarray(said, np.float32)):
        return f"{name} were rounded to single precision"
    offset = np.mean(said - right, axis=0)
    if len(said) > 2 and is_(right + offset):
        if quantity == "potential_energy":
            return f"origin of the potential energy were elsewhere: {offset:.6g} J more at every state"
        return f"a constant were added to the {name} at every state"
    return None


# --- where --------------------------------------------------------------------------------------


def localised(model: Model, seen: Difference, evaluate: Evaluate) -> str:
    """Where the difference persists: asked again at rest, without gravity, without loads and drag."""
    states = [seen.case.pendulum(i)[1] for i in range(min(len(seen.case.p), 4))]
    still = [lift(model, s.p, 0 * s.omega, s.u, 0 * s.udot) for s in states]
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
        right = answer(case(changed, at))
        bounds = [state_bound(changed, s) for s in at]
        ratio = max(
            worst(
                np.array([np.asarray(getattr(a, q), float) for a in answers]) - right[q],
                np.array([tolerance(b, q) for b in bounds]),
            )
            for q in seen.said
        )
        said.append(f"{'vanishes' if ratio <= EXPLAINED else 'persists'} {name}")
    return "the difference " + ", ".join(said)
