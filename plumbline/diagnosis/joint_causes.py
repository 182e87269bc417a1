"""The numbers of bodies, joints and elements that an engine may have wrong, one at a time.

A cause replaces one number, or multiplies a vector or one element of all joints by a factor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from plumbline.model.datatypes import JOINT_ELEMENTS, KINDS, SPRING_FIELDS, Model
from plumbline.model.kinematics import quaternion_product

ACCEPTED_SHARE = 1e-6  # of the difference; evaluating in doubles leaves 1e-10 of it and less
ELEMENT_WORDS = {"rest": "the rest position", "effort": "the effort"}
NAMES = {"force": "the applied force", "moment": "the applied moment", "drag_force": "the drag force",
         "drag_moment": "the drag moment"}  # fmt: skip
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
                yield JointCause(
                    f"{_word(name)} of {of}", one_number(name, (k, i)), float(values[k, i]), scale
                )
    for i in range(len(model.spring_body)):
        for name in SPRING_FIELDS[2:]:
            value = float(getattr(model, name)[i])
            subject = f"the {name.removeprefix('spring_')} of spring {i + 1}"
            yield JointCause(subject, one_number(name, (i,)), value, abs(value) or 1.0)
    for k, kind in enumerate(model.kind):
        if kind == "free":
            continue
        for side, where in ((0, "far"), (1, "near")):
            for axis in range(3):
                at = (k, side, axis)
                subject = f"{'xyz'[axis]} of the {where} point of joint {k + 1}"
                yield JointCause(subject, one_number("point", at), float(model.point[at]), 0.1, " m")
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
        yield JointCause(f"gravity {'xyz'[i]}", one_number("gravity", (i,)), float(weight[i]), size, " m/s²")
    for k in range(model.n):
        of, mass = f"of body {k + 1}", float(model.mass[k])
        yield JointCause(f"the mass {of}", one_number("mass", (k,)), mass, mass, " kg", False)
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
                    yield JointCause(subject, one_number(name, (k, i)), float(value[i]), mass * size)
            elif not np.any(value):
                yield JointCause(f"{words} {of}", one_number(name, (k,)), 0.0, mass)


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


def one_number(name: str, at: tuple[int, ...]) -> Callable[[Model, Any], Model]:
    """Change one number of a field, or one vector.

    Args:
        name: the field.
        at: its place there.

    Returns:
        The change: of a model, to a value.

    """

    def change(model: Model, x: Any) -> Model:
        values = getattr(model, name).copy()
        values[at] = x
        return replace(model, **{name: values})

    return change


def _symmetric(k: int, i: int, j: int) -> Callable[[Model, float], Model]:
    """Replace an entry of an inertia and its mirror image."""
    return lambda model, x: one_number("inertia", (k, j, i))(one_number("inertia", (k, i, j))(model, x), x)


def _scaled(name: str, k: int) -> Callable[[Model, float], Model]:
    """Multiply a number or a vector of one body by a factor."""
    return lambda model, x: one_number(name, (k,))(model, x * getattr(model, name)[k])


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
