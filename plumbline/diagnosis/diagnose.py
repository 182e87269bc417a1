"""Find the one change of a number, a term, a convention or a returned quantity that explains a difference.

Every cause of `hypotheses` is evaluated with `defect_model` and fitted (`fit`); all causes that explain every
quantity are named, because the data cannot distinguish them.  Where there is none, each wrong quantity is
compared with the table of `output_defects`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from plumbline.diagnosis.defect_model import evaluate_case, make_defect_case
from plumbline.diagnosis.fit import (
    MAX_EXPLAINED_RATIO,
    TINY,
    ObservedDifference,
    find_explanations,
    max_error_ratio,
    per_entry,
)
from plumbline.diagnosis.hypotheses import format_significant
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
# in bounds: of a hundred fitted causes, some explain a smaller difference by chance
MIN_DIAGNOSABLE_RATIO = 8.0

Evaluate = Callable[[Model, list[State]], list[StateQuantities]]


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
    weight = 1 / per_entry(bound, reported)
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
