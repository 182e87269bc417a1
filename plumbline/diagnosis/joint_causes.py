"""Find the one number of a tree's bodies, joints or elements that explains how an engine differs.

A cause replaces one number, or multiplies a vector or one element of all joints by a factor.  Its effect is
that of the changed mechanism on accelerations and joint wrenches, in doubles, added to the truth; the amount
is fitted by least squares in units of the rounding bound.  A misreading, for example a velocity in another
frame, changes mechanism or state and has no amount.  Every cause that explains the difference is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from plumbline.model.datatypes import (
    JOINT_ELEMENTS,
    KINDS,
    SPRING_FIELDS,
    Array,
    Model,
    State,
    StateQuantities,
)
from plumbline.model.invariants import kinetic_energy, potential_energy
from plumbline.model.kinematics import (
    complete_state,
    elastic_energy,
    kinetic_energy_of_rotors,
    quaternion_product,
    rotation_matrix,
    spring_vectors,
)
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.parameter_effects import evaluate_models, stack_states
from plumbline.truth.rounding_bound_tree import tree_solution

MAX_STATES = 2
STEP = 1e-4  # of a cause's scale, in differences
MAX_STEPS = 8  # of the least squares
MIN_SIMILARITY = 0.3  # cosine between the difference and a cause's effect, to be fitted at all
ACCEPTED_SHARE = 1e-6  # of the difference; evaluating in doubles leaves 1e-10 of it and less
ACCEPTED_RATIO = 4.0  # in bounds
VECTORS = ("acceleration", "angular_acceleration", "joint_reaction", "joint_moment")
ENERGIES = ("kinetic_energy", "potential_energy")
ELEMENT_WORDS = {"rest": "the rest position", "effort": "the effort"}
NAMES = {"force": "the applied force", "moment": "the applied moment", "drag_force": "the drag force",
         "drag_moment": "the drag moment"}  # fmt: skip
Misreading = Callable[[Model, State], tuple[Model, State]]
UNEXPLAINED = "no single number of a body, a joint, its elements or a spring explains the difference"
FACTORS = {0.0: "were missing", 2.0: "were doubled", -1.0: "had the opposite sign"}


@dataclass(frozen=True)
class JointCause:
    """A change of the mechanism by a number x, of which ``nominal`` is right."""

    subject: str
    change: Callable[[Model, float], Model]
    nominal: float
    scale: float  # natural size of a change of x
    unit: str = ""
    can_vanish: bool = True  # whether factors of `FACTORS` are possible

    def describe(self, x: float) -> str:
        """Complete "behaves as if …".

        Args:
            x: the fitted number.

        Returns:
            The subject and what it were.

        """
        for factor, words in FACTORS.items() if self.nominal else ():
            if abs(x - factor * self.nominal) <= ACCEPTED_SHARE * abs(self.nominal):
                return f"{self.subject} {words}"
        return f"{self.subject} were {x:.9g}{self.unit} instead of {self.nominal:.9g}{self.unit}"


def joint_causes(model: Model) -> Iterator[JointCause]:
    """List the causes of a mechanism.

    Args:
        model: the mechanism.

    Yields:
        Numbers of the bodies; elements of all joints together, of each coordinate and of each spring; points
        and axes of each joint.

    """
    yield from _body_causes(model)
    for name in JOINT_ELEMENTS:
        values = getattr(model, name)
        if np.count_nonzero(values) > 1:
            yield JointCause(f"{_word(name)} of all joints", _all(name), 1.0, 1.0)
            for what in ("slide", "turn"):
                places = [at for at in _coordinates(model) if _is(model, at, what)]
                if 0 < len(places) < np.count_nonzero(values):
                    change = _scaled_places(name, places)
                    yield JointCause(f"{_word(name)} of all {what}s", change, 1.0, 1.0)
        for k, i in _coordinates(model):
            which = f" {'xy'[i] if model.kind[k] == 'universal' else ('slide', 'turn')[i]}"
            of = f"joint {k + 1}" + which * (len(KINDS[model.kind[k]].motions) > 1)
            if name not in ("rest", "effort") or model.kind[k] != "ball":
                scale = float(abs(values[k, i])) or 1.0
                yield JointCause(f"{_word(name)} of {of}", _one(name, (k, i)), float(values[k, i]), scale)
    for i in range(len(model.spring_body)):
        for name in SPRING_FIELDS[2:]:
            value = float(getattr(model, name)[i])
            subject = f"the {name.removeprefix('spring_')} of spring {i + 1}"
            yield JointCause(subject, _one(name, (i,)), value, abs(value) or 1.0)
    for k, kind in enumerate(model.kind):
        if kind == "free":
            continue
        for side, where in ((0, "far"), (1, "near")):
            for axis in range(3):
                at = (k, side, axis)
                subject = f"{'xyz'[axis]} of the {where} point of joint {k + 1}"
                yield JointCause(subject, _one("point", at), float(model.point[at]), 0.1, " m")
                if kind not in ("rod", "ball"):
                    subject = f"the turn of the axes of joint {k + 1} in the {where} body about {'xyz'[axis]}"
                    yield JointCause(subject, _turned(k, side, axis), 0.0, 0.1, " rad")


def _body_causes(model: Model) -> Iterator[JointCause]:
    """Gravity, masses, inertias, loads and drags."""
    weight = model.gravity
    size = float(np.linalg.norm(weight)) or 1.0
    if np.any(weight):
        yield JointCause("gravity", _all("gravity"), 1.0, 1.0)
    for i in range(3):
        yield JointCause(f"gravity {'xyz'[i]}", _one("gravity", (i,)), float(weight[i]), size, " m/s²")
    for k in range(model.n):
        of, mass = f"of body {k + 1}", float(model.mass[k])
        yield JointCause(f"the mass {of}", _one("mass", (k,)), mass, mass, " kg", False)
        trace = float(np.trace(model.inertia[k]))
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
            subject = f"the inertia {'xyz'[i]}{'xyz'[j]} {of}"
            entry = float(model.inertia[k, i, j])
            yield JointCause(subject, _symmetric(k, i, j), entry, trace, " kg m²", i != j)
        for name, words in NAMES.items():
            value = np.atleast_1d(getattr(model, name)[k])
            if np.any(value):
                yield JointCause(f"{words} {of}", _scaled(name, k), 1.0, 1.0)
            if len(value) == 3:
                for i in range(3):
                    subject = f"{words} {'xyz'[i]} {of}"
                    yield JointCause(subject, _one(name, (k, i)), float(value[i]), mass * size)
            elif not np.any(value):
                yield JointCause(f"{words} {of}", _one(name, (k,)), 0.0, mass)


def misreadings(model: Model) -> Iterator[tuple[str, Misreading]]:
    """List what an engine may read in another frame, or not as the number that it is.

    Args:
        model: the mechanism.

    Yields:
        Words that complete "behaves as if", and the mechanism and the state that the engine sees.

    """
    for k in range(model.n):
        of = f"of body {k + 1}"
        if KINDS[model.kind[k]].has_attitude:
            yield f"the world-frame angular velocity {of} were used", _turned_state("omega", k, False)
        if model.kind[k] == "free":
            yield f"the velocity {of} were given in the body frame", _turned_state("v", k, False)
            yield f"the body-frame velocity {of} were used", _turned_state("v", k, True)
        if np.any(model.force[k]):
            yield f"the applied force {of} were given in the body frame", _turned_load("force", k, False)
        if np.any(model.moment[k]):
            yield f"the applied moment {of} were given in the world frame", _turned_load("moment", k, True)
        for i, (what, _) in enumerate(KINDS[model.kind[k]].motions):
            if what == "turn":
                words = f"angle {i + 1} of joint {k + 1} were its principal value"
                yield words, _coordinate("x", k, i, lambda x: float(np.arctan2(np.sin(x), np.cos(x))))
            for name, words in (("x", "coordinate"), ("xdot", "rate")):
                text = f"{words} {i + 1} of joint {k + 1} had the opposite sign"
                yield text, _coordinate(name, k, i, lambda x: -x)
    for number in map(int, np.flatnonzero(model.spring_damping)):
        yield f"the rate of spring {number + 1} were dᵀḋ, not over the length", _undivided_rate(number)


def _turned_state(name: str, k: int, to_body: bool) -> Misreading:
    def misread(model: Model, state: State) -> tuple[Model, State]:
        values, turn = getattr(state, name).copy(), rotation_matrix(state.p[k])
        values[k] = (turn.T if to_body else turn) @ values[k]
        return model, replace(state, **{name: values})

    return misread


def _turned_load(name: str, k: int, to_body: bool) -> Misreading:
    def misread(model: Model, state: State) -> tuple[Model, State]:
        turn = rotation_matrix(complete_state(model, state).p[k])
        values = getattr(model, name).copy()
        values[k] = (turn.T if to_body else turn) @ values[k]
        return replace(model, **{name: values}), state

    return misread


def _coordinate(name: str, k: int, i: int, change: Callable[[float], float]) -> Misreading:
    def misread(model: Model, state: State) -> tuple[Model, State]:
        values = getattr(state, name).copy()
        values[k, i] = change(float(values[k, i]))
        return model, replace(state, **{name: values})

    return misread


def _undivided_rate(i: int) -> Misreading:
    def misread(model: Model, state: State) -> tuple[Model, State]:
        length = float(np.linalg.norm(spring_vectors(model, state.r, state.p)[i]))
        return _one("spring_damping", (i,))(model, length * float(model.spring_damping[i])), state

    return misread


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


def _word(name: str) -> str:
    return ELEMENT_WORDS.get(name, f"the {name}")


def _coordinates(model: Model) -> list[tuple[int, int]]:
    """Joint and column of all coordinates that can have elements."""
    counts = [1 if kind == "ball" else len(KINDS[kind].motions) for kind in model.kind]
    return [(k, i) for k, count in enumerate(counts) for i in range(count)]


def _is(model: Model, at: tuple[int, int], what: str) -> bool:
    """Whether a coordinate is a slide or a turn."""
    motions = KINDS[model.kind[at[0]]].motions
    return (motions[at[1]][0] if motions else "turn") == what


def _scaled_places(name: str, places: Sequence[tuple[int, int]]) -> Callable[[Model, float], Model]:
    """Multiply a field at some places by a factor."""

    def change(model: Model, x: float) -> Model:
        values = getattr(model, name).copy()
        for at in places:
            values[at] *= x
        return replace(model, **{name: values})

    return change


def _one(name: str, at: tuple[int, ...]) -> Callable[[Model, Any], Model]:
    """Replace one number of a field, or one vector."""

    def change(model: Model, x: Any) -> Model:
        values = getattr(model, name).copy()
        values[at] = x
        return replace(model, **{name: values})

    return change


def _symmetric(k: int, i: int, j: int) -> Callable[[Model, float], Model]:
    """Replace an entry of an inertia and its mirror image."""
    return lambda model, x: _one("inertia", (k, j, i))(_one("inertia", (k, i, j))(model, x), x)


def _scaled(name: str, k: int) -> Callable[[Model, float], Model]:
    """Multiply a number or a vector of one body by a factor."""
    return lambda model, x: _one(name, (k,))(model, x * getattr(model, name)[k])


def _all(name: str) -> Callable[[Model, float], Model]:
    """Multiply a field by a factor."""
    return lambda model, x: replace(model, **{name: x * getattr(model, name)})


def _turned(k: int, side: int, axis: int) -> Callable[[Model, float], Model]:
    """Turn the axes of a joint in one body about one of themselves."""

    def change(model: Model, x: float) -> Model:
        turn, half = model.turn.copy(), np.zeros(4)
        half[0], half[1 + axis] = np.cos(x / 2), np.sin(x / 2)
        turn[k, side] = quaternion_product(turn[k, side], half)
        return replace(model, turn=turn)

    return change
