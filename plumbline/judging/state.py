"""State level: each engine's answer against the truth, per body, within the rounding bound."""

from __future__ import annotations

import numpy as np

from plumbline.engines.calls import Evaluation
from plumbline.judging.rows import Columns, JudgingResult, Row, RowContext, Verdict
from plumbline.model.datatypes import Array
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.rounding_bound import MAX_RELATIVE_BOUND

STATE_UNITS = {
    "acceleration": "m/s²",
    "angular_acceleration": "rad/s²",
    "joint_reaction": "N",
    "kinetic_energy": "J",
    "potential_energy": "J",
    "angular_momentum": "kg m²/s",
    "mass_matrix": "kg m²",
}
TINY = float(np.finfo(float).tiny)  # an exact zero against a tolerance of zero is no error


def judge_states(context: RowContext, truth: StateTruth, evaluation: Evaluation) -> JudgingResult:
    """Verdicts on every state quantity, worst over bodies and states."""
    found = JudgingResult()
    if evaluation.unsupported is not None:
        found.rows.append(context.make_row("state", "-", "all", Verdict.UNSUPPORTED, evaluation.unsupported))
        return found
    if evaluation.failure is not None:
        found.rows.append(context.make_row("state", "-", "all", Verdict.FAILED, evaluation.failure))
        return found
    for quantity, unit in STATE_UNITS.items():
        if any(getattr(answer, quantity) is None for answer in evaluation.quantities):
            reason = f"{context.title} offers no {quantity.replace('_', ' ')} of its own"
            found.rows.append(context.make_row("state", "-", quantity, Verdict.UNSUPPORTED, reason, unit))
            continue
        worst = worst_error_per_state(quantity, truth, evaluation)
        found.tables.append(
            (
                "states",
                {"scenario": context.scenario, "engine": context.engine, "quantity": quantity, **worst},
            )
        )
        found.rows.append(state_row(context, quantity, unit, worst, truth.method, evaluation.cpu_time))
    return found


def worst_error_per_state(quantity: str, truth: StateTruth, evaluation: Evaluation) -> Columns:
    """Per state (S,): the error, bound and scale of the body that comes nearest to its bound."""
    answers = zip(evaluation.quantities, truth.quantities, strict=True)
    differences = [getattr(answer, quantity) - getattr(true, quantity) for answer, true in answers]
    error = error_norms(quantity, np.array(differences))
    bound = np.array([bound.tolerance(quantity) for bound in truth.bounds]).reshape(error.shape)
    scale = np.array([bound.scale[quantity] for bound in truth.bounds]).reshape(error.shape)
    state, body = np.arange(len(error)), np.argmax(error / np.maximum(bound, TINY), axis=1)
    at = state, body
    return {"state": state, "body": body, "error": error[at], "bound": bound[at], "scale": scale[at]}


def error_norms(quantity: str, difference: Array) -> Array:
    """(S, N) Euclidean lengths per state and body; (S, 1) of scalars, momentum, the matrix's worst entry."""
    count = len(difference)
    if quantity == "mass_matrix":
        return np.asarray(np.max(np.abs(difference.reshape(count, -1)), axis=1, keepdims=True))
    components = 1 if difference.ndim == 1 else 3
    return np.asarray(np.linalg.norm(difference.reshape(count, -1, components), axis=-1))


def state_row(context: RowContext, quantity: str, unit: str, found: Columns, method: str, cost: float) -> Row:
    """The verdict on one quantity: its worst error over bound decides, a blunt bound decides nothing."""
    error, bound, scale = found["error"], found["bound"], found["scale"]
    ratios, there = error / np.maximum(bound, TINY), scale > 0
    at = int(np.argmax(ratios))
    relative = float(np.max(error[there] / scale[there], initial=0.0))
    bluntness = float(np.median(bound[there] / scale[there])) if there.any() else 0.0
    worst, allowed = float(error[at]), float(bound[at])
    state, body = int(found["state"][at]), int(found["body"][at]) + 1
    name, ratio, count = quantity.replace("_", " "), float(np.max(ratios)), len(ratios)
    where = f"state {state}, body {body}"
    common = {
        "value": worst,
        "tolerance": allowed,
        "derivation": (
            f"first-order rounding bound per body and state, {allowed:.2g} {unit} at {where}, "
            f"{bluntness:.1g} of the scale in the median of {count} states; truth: {method}"
        ),
        "cpu_time": cost,
        "ratio": ratio,
        "extra": {
            "relative": relative,
            "states": float(count),
            "bound_relative": bluntness,
            "state": float(state),
            "body": float(body),
        },
    }
    if ratio > 1:
        reason = (
            f"{context.title}'s {name} is off by {worst:.3g} {unit} at {where}, {ratio:.3g} times the "
            f"rounding bound; {int(np.sum(ratios > 1))} of {count} states disagree"
        )
        return context.make_row("state", "-", quantity, Verdict.DISAGREES, reason, unit, **common)
    if not (
        ratio <= 1 and bluntness <= MAX_RELATIVE_BOUND
    ):  # a bound that is not a number decides nothing either
        reason = f"blunt: the rounding bound is {bluntness:.1g} of the scale, above {MAX_RELATIVE_BOUND:g} or no number"
        return context.make_row("state", "-", quantity, Verdict.UNRESOLVED, reason, unit, **common)
    reason = f"{name} within {ratio:.2g} of the rounding bound at {count} states"
    return context.make_row("state", "-", quantity, Verdict.AGREES, reason, unit, **common)
