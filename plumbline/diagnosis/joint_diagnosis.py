"""Find the cause of how an engine differs on a mechanism of any joints: a number, or a misreading.

The effect of a cause is that of the changed mechanism on accelerations and joint wrenches, in doubles, added
to the truth; the amount is fitted by least squares in units of the rounding bound.  Every cause that explains
the difference is named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from plumbline.diagnosis.joint_causes import ACCEPTED_SHARE, FACTORS, JointCause, joint_causes
from plumbline.diagnosis.misreadings import misreadings
from plumbline.model.datatypes import Array, Model, State, StateQuantities
from plumbline.model.invariants import kinetic_energy, potential_energy
from plumbline.model.kinematics import (
    complete_state,
    elastic_energy,
    kinetic_energy_of_rotors,
    rotation_matrix,
)
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.parameter_effects import evaluate_models, stack_states
from plumbline.truth.rounding_bound_tree import tree_solution

MAX_STATES = 2
STEP = 1e-4  # of a cause's scale, in differences
MAX_STEPS = 8  # of the least squares
MIN_SIMILARITY = 0.3  # cosine between the difference and a cause's effect, to be fitted at all
ACCEPTED_RATIO = 4.0  # in bounds
VECTORS = ("acceleration", "angular_acceleration", "joint_reaction", "joint_moment")
ENERGIES = ("kinetic_energy", "potential_energy")
UNEXPLAINED = "no single number of a body, a joint, its elements or a spring explains the difference"


def diagnose_joints(model: Model, reported: Sequence[StateQuantities], truth: StateTruth) -> str:
    """Name the number that explains how an engine differs from the truth on a tree.

    Args:
        model: the mechanism.
        reported: what the engine returned at the states of ``truth``.
        truth: true quantities and bounds.

    Returns:
        A sentence: "behaves as if …" or that no single number explains the difference.

    """
    if model.has_loops:
        return "mechanisms with loops have no diagnosis yet"
    names = [q for q in (*VECTORS, *ENERGIES) if getattr(reported[0], q) is not None]
    states = range(min(len(reported), MAX_STATES))
    weights, off = [], []
    for q, i in ((q, i) for q in names for i in states):
        wrong = np.asarray(getattr(reported[i], q) - getattr(truth.quantities[i], q))
        off.append(wrong.ravel())
        weights.append(np.repeat(truth.bounds[i].tolerance(q), 3 if q in VECTORS else 1))
    weight = np.concatenate(weights)
    difference = np.concatenate(off) / weight
    vectors = 3 * len([q for q in names if q in VECTORS]) * model.n * len(states)
    if np.max(np.abs(difference[:vectors])) <= ACCEPTED_RATIO:
        return _energy_cause(model, reported, truth)
    some = truth.states[: len(states)]
    right = _predict([model] * len(some), some, names)

    def effect(cause: JointCause, x: float) -> Array:
        try:
            found = _predict([cause.change(model, x)] * len(some), some, names)
        except np.linalg.LinAlgError:  # no such mechanism
            return np.full(len(weight), np.inf)
        return np.asarray((found - right) / weight)

    accepted = max(ACCEPTED_RATIO, ACCEPTED_SHARE * float(np.max(np.abs(difference))))
    found = [
        cause.describe(x)
        for cause in _similar(model, some, names, weight[:vectors], difference[:vectors])
        if (x := _fitted(cause, effect, difference, len(difference) - vectors, accepted)) is not None
    ]
    for words, misread in misreadings(model):
        seen = [misread(model, state) for state in truth.states[: len(states)]]
        changed = _predict([m for m, _ in seen], [state for _, state in seen], names)
        if np.max(np.abs(difference - (changed - right) / weight)) <= accepted:
            found.append(words)
    if not found:
        return _moment_cause(model, reported, truth) or UNEXPLAINED
    first, *others = found
    return f"behaves as if {first}" + (
        f"; the data cannot distinguish this from: {'; '.join(others)}" if others else ""
    )


def _similar(
    model: Model, states: Sequence[State], names: Sequence[str], weight: Array, difference: Array
) -> list[JointCause]:
    """The causes whose effects on the vectors point in the direction of the difference; all in one batch."""
    causes = list(joint_causes(model))
    models = [model, *(cause.change(model, cause.nominal + STEP * cause.scale) for cause in causes)]
    stacked = stack_states(states)
    found = evaluate_models([(one, complete_state(one, stacked)) for one in models])
    parts = [found[name].reshape(len(models), -1) for name in names if name in VECTORS]
    flat = np.concatenate(parts, axis=1)
    slopes = (flat[1:] - flat[0]) / weight
    sizes = np.linalg.norm(slopes, axis=1) * np.linalg.norm(difference)
    near = np.abs(slopes @ difference) > MIN_SIMILARITY * sizes
    return [cause for cause, is_near in zip(causes, near, strict=True) if is_near]


def _fitted(
    cause: JointCause,
    effect: Callable[[JointCause, float], Array],
    difference: Array,
    energies: int,
    accepted: float,
) -> float | None:
    """The amount at which a cause explains the difference, to ``accepted`` bounds; None where it does not.

    It is fitted to all but the last numbers, which are energies: of them more may be left, by what one bound
    in each of the others changes the amount.
    """
    vectors, x, step = slice(-energies or None), cause.nominal, STEP * cause.scale
    slopes = effect(cause, x + step) / step
    slope, left = slopes[vectors], difference
    most = np.full(len(slopes), accepted)
    most[len(slope) :] += (
        np.abs(slopes[len(slope) :]) * np.sum(np.abs(slope)) / max(float(slope @ slope), 1e-300)
    )
    size, length = float(slope @ slope), float(np.linalg.norm(left[vectors]))
    if abs(float(slope @ left[vectors])) <= MIN_SIMILARITY * np.sqrt(size) * length:
        return None
    for factor in FACTORS if cause.nominal and cause.can_vanish else ():
        if np.all(np.abs(difference - effect(cause, factor * x)) <= most):
            return factor * x
    for _ in range(MAX_STEPS):
        x += float(slope @ left[vectors]) / size
        with np.errstate(all="ignore"):
            left = difference - effect(cause, x)
        if np.all(np.abs(left) <= most):
            return x
        before, length = length, float(np.linalg.norm(left[vectors]))
        if not length < before / 2:  # it converges quadratically, or the cause is another one
            return None
        slope = ((effect(cause, x + step) - effect(cause, x)) / step)[vectors]
        size = max(float(slope @ slope), 1e-300)
    return None


def _energy_cause(model: Model, reported: Sequence[StateQuantities], truth: StateTruth) -> str:
    """Name what an energy leaves out, where accelerations and wrenches are right."""
    parts: list[tuple[str, str, Callable[[Model, State], float]]] = [
        ("kinetic_energy", "the rotors", kinetic_energy_of_rotors),
        ("potential_energy", "the springs", elastic_energy),
    ]
    for name, what, energy in parts:
        if getattr(reported[0], name) is None:
            continue
        pairs = list(zip(reported, truth.quantities, truth.states, truth.bounds, strict=True))
        off = [getattr(a, name) - getattr(b, name) for a, b, _, _ in pairs]
        bounds = [ACCEPTED_RATIO * float(np.max(bound.tolerance(name))) for *_, bound in pairs]
        if max(abs(x) / bound for x, bound in zip(off, bounds, strict=True)) <= 1:
            continue
        shares = [energy(model, state) for _, _, state, _ in pairs]
        for factor, words in ((-1.0, "without"), (1.0, "with twice")):
            if all(abs(x - factor * y) <= b for x, y, b in zip(off, shares, bounds, strict=True)):
                return f"behaves as if it returned the {name.replace('_', ' ')} {words} that of {what}"
    return "accelerations and joint wrenches are right; no part of an energy explains the difference"


def _moment_cause(model: Model, reported: Sequence[StateQuantities], truth: StateTruth) -> str:
    """Name the point about which moments of joints are, where nothing else is wrong: λ (near − P) × F."""
    off, sizes, arms = [], [], dict[str, list[Array]]()
    for answer, true, state, bound in zip(
        reported, truth.quantities, truth.states, truth.bounds, strict=True
    ):
        for name in VECTORS:
            wrong = getattr(answer, name)
            if wrong is None:
                return ""
            ratio = np.linalg.norm(wrong - getattr(true, name), axis=1) / bound.tolerance(name)
            if name != "joint_moment" and np.max(ratio) > ACCEPTED_RATIO:
                return ""
        assert true.joint_reaction is not None and true.joint_moment is not None
        near = state.r + np.matvec(rotation_matrix(state.p), model.proximal)
        tree = model.mass @ state.r / np.sum(model.mass)
        points = {"the centres of mass": state.r, "the world's origin": 0 * near,
                  "the centre of mass of the whole": np.broadcast_to(tree, near.shape)}  # fmt: skip
        for words, point in points.items():
            arms.setdefault(words, []).append(np.cross(near - point, true.joint_reaction).ravel())
        off.append(np.ravel(np.asarray(answer.joint_moment) - true.joint_moment))
        sizes.append(np.repeat(bound.tolerance("joint_moment"), 3))
    difference, size = np.concatenate(off), np.concatenate(sizes)
    accepted = max(ACCEPTED_RATIO, ACCEPTED_SHARE * float(np.max(np.abs(difference / size))))
    for words, parts in arms.items():
        lever = np.concatenate(parts)
        factor = float(lever @ difference) / max(float(lever @ lever), 1e-300)
        if np.max(np.abs(difference - factor * lever) / size) <= accepted:
            if abs(factor - 1) < ACCEPTED_SHARE:
                return f"behaves as if the moments of joints were about {words}"
            return f"behaves as if the arm of joint moments to {words} counted {1 - factor:.6g} times"
    return ""


def _predict(models: Sequence[Model], states: Sequence[State], names: Sequence[str]) -> Array:
    """Quantities of mechanisms at their states, one after the other."""
    found: dict[str, list[Array]] = {name: [] for name in names}
    for model, state in zip(models, states, strict=True):
        at = complete_state(model, state)
        values = dict(zip(VECTORS, tree_solution(model, at), strict=True))
        values["angular_acceleration"] = np.matvec(rotation_matrix(at.p).mT, values["angular_acceleration"])
        values["kinetic_energy"] = kinetic_energy(model, at.v, at.omega) + kinetic_energy_of_rotors(model, at)
        values["potential_energy"] = potential_energy(model, at.r) + elastic_energy(model, at)
        for name in names:
            found[name].append(np.ravel(values[name]))
    return np.concatenate([value for values_ in found.values() for value in values_])
