"""State level: each engine's answer against the truth, per body, within the rounding bound."""

from __future__ import annotations

import numpy as np

from plumbline.engines.calls import Evaluation
from plumbline.judging.rows import Columns, Findings, Subject
from plumbline.model.datatypes import Array, Row
from plumbline.processes.packed import Packed
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.rounding_bound import BLUNT

UNITS = {
    "acceleration": "m/s²",
    "angular_acceleration": "rad/s²",
    "joint_reaction": "N",
    "kinetic_energy": "J",
    "potential_energy": "J",
    "angular_momentum": "kg m²/s",
    "mass_matrix": "kg m²",
}
TINY = float(np.finfo(float).tiny)  # an exact zero against a tolerance of zero is no error


def judge_states(who: Subject, truth: StateTruth, said: Evaluation) -> Findings:
    """Verdicts on every state quantity, worst over bodies and states."""
    found = Findings()
    if said.unsupported is not None:
        found.rows.append(who.row("state", "-", "all", "unsupported", said.unsupported))
        return found
    if said.failure is not None:
        found.rows.append(who.row("state", "-", "all", "failed", said.failure))
        return found
    for quantity, unit in UNITS.items():
        if any(getattr(answer, quantity) is None for answer in said.quantities):
            reason = f"{who.title} offers no {quantity.replace('_', ' ')} of its own"
            found.rows.append(who.row("state", "-", quantity, "unsupported", reason, unit))
            continue
        worst = compare(quantity, truth, said)
        found.tables.append(
            ("states", {"scenario": who.scenario, "engine": who.engine, "quantity": quantity, **worst})
        )
        found.rows.append(row(who, quantity, unit, worst, truth.method, said.cost))
    return found


def judge_packed(who: Subject, truth: Packed, said: Evaluation) -> Findings:
    """The same in the worker that has the answer: the process that has all answers is spared it."""
    return judge_states(who, truth.open(), said)


def compare(quantity: str, truth: StateTruth, said: Evaluation) -> Columns:
    """Per state (S,): the error, bound and scale of the body that comes nearest to its bound."""
    answers = zip(said.quantities, truth.quantities, strict=True)
    differences = [getattr(answer, quantity) - getattr(true, quantity) for answer, true in answers]
    error = sizes(quantity, np.array(differences))
    bound = np.array([bound.tolerance(quantity) for bound in truth.bounds]).reshape(error.shape)
    scale = np.array([bound.scale[quantity] for bound in truth.bounds]).reshape(error.shape)
    state, body = np.arange(len(error)), np.argmax(error / np.maximum(bound, TINY), axis=1)
    at = state, body
    return {"state": state, "body": body, "error": error[at], "bound": bound[at], "scale": scale[at]}


def sizes(quantity: str, difference: Array) -> Array:
    """(S, N) Euclidean lengths per state and body; (S, 1) of scalars, momentum, the matrix's worst entry."""
    count = len(difference)
    if quantity == "mass_matrix":
        return np.asarray(np.max(np.abs(difference.reshape(count, -1)), axis=1, keepdims=True))
    components = 1 if difference.ndim == 1 else 3
    return np.asarray(np.linalg.norm(difference.reshape(count, -1, components), axis=-1))


def row(who: Subject, quantity: str, unit: str, found: Columns, method: str, cost: float) -> Row:
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
        "wall_time": cost,
        "extra": {
            "ratio": ratio,
            "relative": relative,
            "states": float(count),
            "bound_relative": bluntness,
            "state": float(state),
            "body": float(body),
        },
    }
    if ratio > 1:
        reason = (
            f"{who.title}'s {name} is off by {worst:.3g} {unit} at {where}, {ratio:.3g} times the "
            f"rounding bound; {int(np.sum(ratios > 1))} of {count} states disagree"
        )
        return who.row("state", "-", quantity, "disagrees", reason, unit, **common)
    if not (ratio <= 1 and bluntness <= BLUNT):  # a bound that is not a number decides nothing either
        reason = f"blunt: the rounding bound is {bluntness:.1g} of the scale, above {BLUNT:g} or no number"
        return who.row("state", "-", quantity, "unresolved", reason, unit, **common)
    reason = f"{name} within {ratio:.2g} of the rounding bound at {count} states"
    return who.row("state", "-", quantity, "agrees", reason, unit, **common)
