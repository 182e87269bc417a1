"""Find the one number of a tree's joints or passive elements that explains how an engine differs.

A cause replaces one number, or multiplies one element of all joints by a factor.  Its effect is that of the
changed mechanism on accelerations and joint wrenches, in doubles, added to the truth; the amount is fitted by
least squares in units of the rounding bound.  Every cause that explains the difference is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

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
)
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.rounding_bound_tree import tree_solution

MAX_STATES = 2
MAX_STEPS = 8  # of the least squares
MIN_SIMILARITY = 0.3  # cosine between the difference and a cause's effect, to be fitted at all
ACCEPTED_SHARE = 1e-6  # of the difference; evaluating in doubles leaves 1e-10 of it and less
ACCEPTED_RATIO = 4.0  # in bounds
VECTORS = ("acceleration", "angular_acceleration", "joint_reaction", "joint_moment")
ENERGIES = ("kinetic_energy", "potential_energy")
ELEMENT_WORDS = {"rest": "the rest position", "effort": "the effort"}
FACTORS = {0.0: "were missing", 2.0: "were doubled", -1.0: "had the opposite sign"}


@dataclass(frozen=True)
class JointCause:
    """A change of the mechanism by a number x, of which ``nominal`` is right."""

    subject: str
    change: Callable[[Model, float], Model]
    nominal: float
    scale: float  # natural size of a change of x
    unit: str = ""

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
        Elements of all joints together, of each coordinate and of each spring; points and axes of each joint.

    """
    for name in JOINT_ELEMENTS:
        values = getattr(model, name)
        if np.count_nonzero(values) > 1:
            yield JointCause(f"{_word(name)} of all joints", _all(name), 1.0, 1.0)
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


def diagnose_joints(model: Model, reported: Sequence[StateQuantities], truth: StateTruth) -> str:
    """Name the number that explains how an engine differs from the truth on a tree.

    Args:
        model: the mechanism.
        reported: what the engine returned at the states of ``truth``.
        truth: true quantities and bounds.

    Returns:
        A sentence: "behaves as if …" or that no single number explains the difference.

    """
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
    right = _predict(model, truth.states[: len(states)], names)

    def effect(cause: JointCause, x: float) -> Array:
        found = _predict(cause.change(model, x), truth.states[: len(states)], names)
        return np.asarray((found - right) / weight)

    accepted = max(ACCEPTED_RATIO, ACCEPTED_SHARE * float(np.max(np.abs(difference))))
    found = [
        cause.describe(x)
        for cause in joint_causes(model)
        if (x := _fitted(cause, effect, difference, len(difference) - vectors, accepted)) is not None
    ]
    if not found:
        return "no single number of a joint, of its elements or of a spring explains the difference"
    first, *others = found
    return f"behaves as if {first}" + (
        f"; the data cannot distinguish this from: {'; '.join(others)}" if others else ""
    )


def _fitted(
    cause: JointCause,
    effect: Callable[[JointCause, float], Array],
    difference: Array,
    energies: int,
    accepted: float,
) -> float | None:
    """The amount at which a cause explains the difference, to ``accepted`` bounds; None where it does not.

    It is fitted to all but the last numbers, which are energies.
    """
    vectors, x, step = slice(-energies or None), cause.nominal, 1e-4 * cause.scale
    slope = (effect(cause, x + step) / step)[vectors]
    left = difference
    size, length = float(slope @ slope), float(np.linalg.norm(left[vectors]))
    if abs(float(slope @ left[vectors])) <= MIN_SIMILARITY * np.sqrt(size) * length:
        return None
    for factor in FACTORS if cause.nominal else ():
        if np.max(np.abs(difference - effect(cause, factor * x))) <= accepted:
            return factor * x
    for _ in range(MAX_STEPS):
        x += float(slope @ left[vectors]) / size
        with np.errstate(all="ignore"):
            left = difference - effect(cause, x)
        if np.max(np.abs(left)) <= accepted:
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


def _predict(model: Model, states: Sequence[State], names: Sequence[str]) -> Array:
    """Quantities of a mechanism at all states, one after the other."""
    found: dict[str, list[Array]] = {name: [] for name in names}
    for state in states:
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


def _one(name: str, at: tuple[int, ...]) -> Callable[[Model, float], Model]:
    """Replace one number of a field."""

    def change(model: Model, x: float) -> Model:
        values = getattr(model, name).copy()
        values[at] = x
        return replace(model, **{name: values})

    return change


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
