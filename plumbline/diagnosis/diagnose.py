"""Find the one change of a number, a term, a convention or a returned quantity that explains a difference.

Every cause of `hypotheses` is evaluated with `defect_model` and fitted (`fit`); all causes that explain every
quantity are named, because the data cannot distinguish them.  Where there is none, each wrong quantity is
compared with the table of `output_defects`, and those without a match are explained together, because a
defect may be in the accelerations and not in the energies.  An error that scatters where little more than the
last bits of the problem change has no such cause: `digit_loss`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plumbline.diagnosis.defect_model import evaluate_case, make_defect_case
from plumbline.diagnosis.digit_loss import (
    DigitLoss,
    Evaluate,
    describe_scatter,
    find_digit_loss,
    measure_scatter,
)
from plumbline.diagnosis.fit import (
    MAX_EXPLAINED_RATIO,
    MIN_CHANGE_RATIO,
    TINY,
    ObservedDifference,
    find_explanations,
    max_error_ratio,
    per_entry,
)
from plumbline.diagnosis.hypotheses import format_significant
from plumbline.diagnosis.joint_diagnosis import diagnose_joints
from plumbline.diagnosis.output_defects import output_defects
from plumbline.diagnosis.result import Diagnosis
from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Array, Model, State, StateQuantities
from plumbline.model.kinematics import state_from_minimal
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.rounding_bound import rounding_bounds

QUANTITIES = (
    "acceleration", "angular_acceleration", "joint_reaction", "kinetic_energy", "potential_energy",
    "angular_momentum",
)  # fmt: skip
MAX_STATES = 8  # examined; fewer for long chains
SINGLE_ROUNDING = 1e-5  # of the largest value: what computing in single precision may cost
MAX_LOCATED = 4  # states at which the difference is looked for at rest, without gravity and without loads
# in bounds: of a hundred fitted causes, some explain a smaller difference by chance
MIN_DIAGNOSABLE_RATIO = 8.0


def explain_disagreement(
    engine: str, model: Model, engine_quantities: list[StateQuantities], truth: StateTruth, is_known: bool
) -> Diagnosis:
    """Diagnose quantities that disagree with the truth; loads the engine, so call it in a worker.

    Args:
        engine_quantities: what the engine returned at the states of ``truth``.
        is_known: whether the cause is on record as rounding: then only the scatter of the error is measured.

    Returns:
        The sentence of `diagnose`, or the scatter of the error.

    """
    if not model.is_chain:
        return Diagnosis("" if is_known else diagnose_joints(model, engine_quantities, truth))
    evaluate = load_adapter(engine).evaluate
    if not is_known:
        return Diagnosis(diagnose(model, engine_quantities, truth, evaluate))
    difference = observe_difference(model, engine_quantities, truth)
    scatter = measure_scatter(difference.of_quantities(difference.wrong_quantities()), model, evaluate)
    return Diagnosis("" if scatter is None else describe_scatter(scatter), scatter)


def diagnose(
    model: Model,
    reported: Sequence[StateQuantities],
    truth: StateTruth,
    evaluate: Evaluate | None = None,
) -> str:
    """Name the defect that explains how an engine differs from the truth.

    Args:
        reported: what the engine returned at the states of ``truth``.
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
        text = _describe_cause(difference, model, evaluate)
    return text + (f" ({_localise_difference(model, difference, evaluate)})" if evaluate else "")


def _describe_cause(difference: ObservedDifference, model: Model, evaluate: Evaluate | None) -> str:
    """Sentence on what explains the difference: of all quantities together, of each, or as loss of digits."""
    loss = _digit_loss(difference, difference.wrong_quantities(MIN_DIAGNOSABLE_RATIO), model, evaluate)
    text = _describe_explanations(difference, loss is not None)
    if text:
        return text
    named, unnamed = _name_quantities(difference)
    close = [q for q in difference.wrong_quantities() if q not in named and q not in unnamed]
    parts = ["behaves as if " + "; and ".join(dict.fromkeys(named.values()))] if named else []
    if unnamed:
        loss = loss or (_digit_loss(difference, unnamed, model, evaluate) if named else None)
        together = "" if loss else _describe_part(difference, [*unnamed, *close])
        if together:
            parts.append(together)
            close = []
        elif loss and loss.grows:
            parts.append(loss.describe())
        else:
            parts.append(
                "no single change of a parameter, term or convention explains the " + _enumerate(unnamed)
            )
            if loss:
                parts.append(loss.describe())
    if close:
        parts.append(
            f"the difference of the {_enumerate(close)} is too close to the rounding bound to name a term"
        )
    return "; ".join(parts)


def _digit_loss(
    difference: ObservedDifference, quantities: Sequence[str], model: Model, evaluate: Evaluate | None
) -> DigitLoss | None:
    """How the error of some quantities scatters; None where it does not or nothing can be evaluated."""
    return find_digit_loss(difference.of_quantities(quantities), model, evaluate) if evaluate else None


def _enumerate(quantities: Sequence[str]) -> str:
    return " and ".join(q.replace("_", " ") for q in quantities)


def observe_difference(
    model: Model, reported: Sequence[StateQuantities], truth: StateTruth
) -> ObservedDifference:
    """Select consecutive states around the one with the largest error, so that stale fields can be detected.

    Args:
        reported: what the engine returned at the states of ``truth``.

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


# --- causes -------------------------------------------------------------------------------------


def _describe_explanations(difference: ObservedDifference, are_conventions_only: bool = False) -> str:
    """Sentence that names every cause that explains all quantities; empty where there is none."""
    found = find_explanations(difference, are_conventions_only=are_conventions_only)
    if not found:
        return ""
    first, *others = (fit.cause.describe(fit.fitted_amount, fit.resolution) for fit, _ in found)
    text = f"behaves as if {first}"
    if others:
        text += f"; the data cannot distinguish this from: {'; '.join(others)}"
    return (
        text + f"; this explains the difference to {max(left for _, left in found):.2g} of the rounding bound"
    )


def _describe_part(difference: ObservedDifference, quantities: Sequence[str]) -> str:
    """Sentence that names a cause which acts on some quantities alone; empty where there is none."""
    if len(quantities) == len(difference.reported):
        return ""
    text = _describe_explanations(difference.of_quantities(quantities))
    return text and f"in the {_enumerate(quantities)} alone it {text}"


# --- returned quantities -------------------------------------------------------------------------


def _name_quantities(difference: ObservedDifference) -> tuple[dict[str, str], list[str]]:
    """What was returned in place of each wrong quantity, and the quantities without a name."""
    wrong = difference.wrong_quantities(MIN_DIAGNOSABLE_RATIO)
    texts = {q: diagnose_quantity(difference, q) for q in wrong}
    return {q: text for q, text in texts.items() if text}, [q for q, text in texts.items() if not text]


def diagnose_quantity(difference: ObservedDifference, quantity: str) -> str | None:
    """Find what an engine returned in place of one quantity.

    Args:
        quantity: name of the wrong quantity.

    Returns:
        The completion of "behaves as if …"; None where no known defect explains the quantity.

    """
    every = _diagnose_bodies(difference, quantity, None, "")
    reported, bound = difference.reported[quantity], difference.bounds[quantity]
    if every or bound.ndim < 2 or bound.shape[1] < 2:
        return every
    off = reported - difference.expected[quantity]
    wrong = [
        k for k in range(bound.shape[1]) if max_error_ratio(off[:, k], bound[:, k]) > MAX_EXPLAINED_RATIO
    ]
    if not wrong or len(wrong) == bound.shape[1]:
        return None
    of = f" of bod{'y' if len(wrong) == 1 else 'ies'} {' and '.join(str(k + 1) for k in wrong)}"
    return _diagnose_bodies(difference, quantity, wrong, of)


def _diagnose_bodies(
    difference: ObservedDifference, quantity: str, bodies: list[int] | None, of: str
) -> str | None:
    """What was returned in place of one quantity of all or of some bodies, which ``of`` names."""
    name = quantity.replace("_", " ") + of

    def rows_of_bodies(x: Array) -> Array:
        return x if bodies is None else x[:, bodies]

    reported, expected = (rows_of_bodies(x[quantity]) for x in (difference.reported, difference.expected))
    bound = rows_of_bodies(difference.bounds[quantity])

    def matches(x: Array, rows: slice = slice(None)) -> bool:
        """Whether x is what was reported, and differs from what is right by more than both bounds."""
        is_near = max_error_ratio((reported - x)[rows], (2 * bound)[rows]) <= MAX_EXPLAINED_RATIO
        return is_near and max_error_ratio((x - expected)[rows], (2 * bound)[rows]) > MIN_CHANGE_RATIO

    if len(reported) > 2 and matches(rows_of_bodies(difference.previous_expected[quantity]), slice(1, None)):
        return f"it returned the {name} of the previous state (a stale field)"
    if bodies is not None and len(bodies) == 1:
        for k in range(difference.case.n):
            if k not in bodies and matches(difference.expected[quantity][:, [k]]):
                return f"it returned the {quantity.replace('_', ' ')} of body {k + 1} as that{of}"
    for defect in output_defects(difference.case, quantity):
        if matches(rows_of_bodies(defect.compute(difference.case, difference.expected))):
            return defect.description.format(of=of)
    weight = 1 / per_entry(bound, reported)
    square = max(float(np.sum((expected * weight) ** 2)), TINY)
    factor = float(np.sum(reported * expected * weight**2) / square)
    if matches(factor * expected):
        if abs(factor + 1) < 1e-9:
            return f"it returned the {name} with the opposite sign"
        return f"it returned the {name} multiplied by {format_significant(factor, 1.0, 0.0)}"
    is_near = np.max(np.abs(reported - expected)) <= SINGLE_ROUNDING * np.max(np.abs(expected))
    if is_near and np.all(reported == np.asarray(reported, np.float32)):
        return f"it rounded the {name} to single precision"
    offset = np.mean(reported - expected, axis=0)
    if len(reported) > 2 and matches(expected + offset):
        if quantity == "potential_energy":
            return f"the origin of the potential energy were elsewhere: {offset:+.6g} J at every state"
        return f"it added a constant to the {name} at every state"
    return None


# --- where the difference persists ----------------------------------------------------------------


def _localise_difference(model: Model, difference: ObservedDifference, evaluate: Evaluate) -> str:
    """Sentence on where the difference persists: at rest, without gravity, without loads and drag.

    Only states at which the difference shows are tried, and nothing follows where it does not show again.
    """
    case, count = difference.case, len(difference.case.p)
    ratios = [difference.at_state(i).error_ratio(difference.at_state(i).expected) for i in range(count)]
    worst = [int(i) for i in np.argsort(ratios)[::-1][:MAX_LOCATED] if ratios[i] > MAX_EXPLAINED_RATIO]
    states = [case.model_and_state(i)[1] for i in worst]

    def persists(changed: Model, at: list[State]) -> bool:
        answers = evaluate(changed, at)
        expected = evaluate_case(make_defect_case(changed, at))
        bounds = rounding_bounds(changed, at)
        return any(
            not max_error_ratio(
                np.array([np.asarray(getattr(a, q), float) for a in answers]) - expected[q],
                np.array([b.tolerance(q) for b in bounds]),
            )
            <= MAX_EXPLAINED_RATIO
            for q in difference.reported
        )

    at_rest = [state_from_minimal(model, s.p, 0 * s.omega, s.u, 0 * s.udot) for s in states]
    trials = [
        ("at rest", model, at_rest),
        ("without gravity", replace(model, gravity=0 * model.gravity), states),
    ]
    if model.has_loads or model.has_drag:
        unloaded = {k: 0 * getattr(model, k) for k in ("force", "moment", "drag_force", "drag_moment")}
        trials.append(("without loads and drag", replace(model, **unloaded), states))
    where = "the state" if len(states) == 1 else f"the {len(states)} states"
    where += " where it is largest, the difference "
    findings = []
    for name, changed, at in [("", model, states), *trials]:
        try:
            is_there = persists(changed, at)
        except Exception as error:  # an engine may raise anything; a failure here is information too
            findings.append(f"fails {name or 'again'}: {' '.join(str(error).split())[:80]}")
            continue
        if name:
            findings.append(f"{'persists' if is_there else 'vanishes'} {name}")
        elif not is_there:
            return f"at {where}does not show again when these are evaluated alone"
    return f"at {where}" + ", ".join(findings)
