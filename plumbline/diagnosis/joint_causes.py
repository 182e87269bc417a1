"""The numbers of bodies, joints and elements that an engine may have wrong, one at a time.

A cause replaces one number, or multiplies a vector or one element of all joints by a factor.  Where no number
explains a difference, a point may be elsewhere, axes may be turned about any axis, and a load or gravity may
be another vector: causes of three numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from plumbline.model.datatypes import JOINT_ELEMENTS, SPRING_FIELDS, Array, Model
from plumbline.model.kinematics import quaternion_exponential, quaternion_product, rotation_matrix

ACCEPTED_SHARE = 1e-6  # of the difference; evaluating in doubles leaves 1e-10 of it and less
ELEMENT_WORDS = {"rest": "the rest position", "effort": "the effort"}
NAMES = {"force": "the applied force", "moment": "the applied moment", "drag_force": "the drag force",
         "drag_moment": "the drag moment"}  # fmt: skip
FACTORS = {0.0: "were missing", 2.0: "were doubled", -1.0: "had the opposite sign"}


@dataclass(frozen=True)
class JointCause:
    """A change of the mechanism by a number or three, x, of which ``nominal`` are right."""

    subject: str
    change: Callable[[Model, Any], Model]
    nominal: float | tuple[float, float, float]
    scale: float  # natural size of a change of x
    unit: str = ""
    can_vanish: bool = True  # whether factors of `FACTORS` are possible

    def describe(self, x: Any) -> str:
        """Complete "behaves as if …".

        Args:
            x: the fitted number, or (3,) numbers.

        Returns:
            The subject and what it were.

        """
        if isinstance(self.nominal, tuple):
            return self._describe_vector(np.asarray(x))
        for factor, words in FACTORS.items() if self.nominal else ():
            if abs(x - factor * self.nominal) <= ACCEPTED_SHARE * abs(self.nominal):
                return f"{self.subject} {words}"
        digits = 9 if abs(x - self.nominal) > 1e-8 * abs(self.nominal) else 15
        return f"{self.subject} were {x:.{digits}g}{self.unit} instead of {self.nominal:.9g}{self.unit}"

    def _describe_vector(self, x: Array) -> str:
        if self.unit != " rad":
            return f"{self.subject} were ({', '.join(f'{value:.9g}' for value in x)}){self.unit}"
        angle = float(np.linalg.norm(x))
        axis = x / angle
        if angle > np.pi:
            angle, axis = 2 * np.pi - angle, -axis
        along = ", ".join(f"{value:.6g}" for value in axis)
        return f"{self.subject} were turned by {angle:.9g} rad about their own ({along})"


def joint_causes(model: Model) -> Iterator[JointCause]:
    """List the causes of a mechanism.

    Yields:
        Numbers of the bodies; elements of all joints together, of each coordinate and of each spring; points
        and axes of each joint.

    """
    yield from _body_causes(model)
    yield from _repeated_causes(model)
    for name in JOINT_ELEMENTS:
        values = getattr(model, name)
        if np.count_nonzero(values) > 1:
            yield JointCause(f"{element_words(name)} of all joints", _all(name), 1.0, 1.0)
            for what in ("slide", "turn"):
                places = [at for at in _coordinates(model) if _is(model, at, what) and values[at]]
                if 1 < len(places) < np.count_nonzero(values):
                    change = _scaled_places(name, places)
                    yield JointCause(f"{element_words(name)} of all {what}s", change, 1.0, 1.0)
        for k, i in _coordinates(model):
            names = model.kinds[k].motion_names
            of = f"joint {k + 1}" + (f" {names[i]}" if len(names) > 1 else "")
            if name not in ("rest", "effort") or not model.kinds[k].is_spherical:
                scale = float(abs(values[k, i])) or 1.0
                yield JointCause(
                    f"{element_words(name)} of {of}", one_number(name, (k, i)), float(values[k, i]), scale
                )
    for i in range(len(model.spring_body)):
        for name in SPRING_FIELDS[2:]:
            value = float(getattr(model, name)[i])
            subject = f"the {name.removeprefix('spring_')} of spring {i + 1}"
            yield JointCause(subject, one_number(name, (i,)), value, abs(value) or 1.0)
    for k, kind in enumerate(model.kinds):
        if kind.holds_nothing:
            continue
        if kind.holds_distance:
            length = float(model.length[k])
            yield JointCause(
                f"the length of joint {k + 1}", one_number("length", (k,)), length, length, " m", False
            )
        if _is(model, (k, 0), "slide") and _shift_is_askew(model, k):
            yield JointCause(f"the origin of the slide of joint {k + 1}", _shifted_slide(k), 0.0, 0.1, " m")
        for side, where in ((0, "far"), (1, "near")):
            for axis in range(3):
                at = (k, side, axis)
                subject = f"{'xyz'[axis]} of the {where} point of joint {k + 1}"
                yield JointCause(subject, one_number("point", at), float(model.point[at]), 0.1, " m")
                if not kind.has_attitude and (side == 0 or not kind.is_rigid):  # equal to a far turn
                    subject = f"the turn of the axes of joint {k + 1} in the {where} body about {'xyz'[axis]}"
                    yield JointCause(subject, _turned(k, side, axis), 0.0, 0.1, " rad")


def vector_causes(model: Model) -> Iterator[JointCause]:
    """List the causes of three numbers.

    Yields:
        Points and turns of the axes of each joint, loads of each body, and gravity.

    """
    for k, kind in enumerate(model.kinds):
        if kind.holds_nothing:
            continue
        for side, where in enumerate(("far", "near")):
            if not kind.has_attitude and (side == 0 or not kind.is_rigid):
                subject = f"the axes of joint {k + 1} in the {where} body"
                yield JointCause(subject, _turned_about(k, side), (0.0, 0.0, 0.0), 0.1, " rad")
            subject = f"the {where} point of joint {k + 1}"
            yield _vector(model, subject, "point", (k, side), 0.1, " m")
    size = float(np.linalg.norm(model.gravity)) or 1.0
    for k in range(model.n):
        for name, unit in (("force", " N"), ("moment", " N m")):
            weight = float(model.mass[k]) * size
            yield _vector(model, f"{NAMES[name]} of body {k + 1}", name, (k,), weight, unit)
    yield _vector(model, "gravity", "gravity", (slice(None),), size, " m/s²")


def _vector(
    model: Model, subject: str, name: str, at: tuple[Any, ...], scale: float, unit: str
) -> JointCause:
    """Replace a vector of a field."""
    x, y, z = map(float, getattr(model, name)[at])
    return JointCause(subject, one_number(name, at), (x, y, z), scale, unit)


def _body_causes(model: Model) -> Iterator[JointCause]:
    """Gravity, masses, inertias, loads and drags."""
    weight = model.gravity
    size = float(np.linalg.norm(weight)) or 1.0
    if np.count_nonzero(weight) > 1:  # else it is a component
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


def _repeated_causes(model: Model) -> Iterator[JointCause]:
    """One factor in several places: of all bodies, joints or springs, or from one of them on."""
    off_diagonal = 1 - np.eye(3)
    fields = [
        ("the products of inertia", "inertia", "bodies", off_diagonal),
        ("the inertia", "inertia", "bodies", 1),
    ]
    fields += [(words, name, "bodies", 1) for name, words in NAMES.items()]
    fields += [(element_words(name), name, "joints", 1) for name in JOINT_ELEMENTS]
    for side, where in enumerate(("far", "near")):
        fields.append((f"the {where} points", "point", "joints", np.eye(2)[side][:, None]))
    fields += [(f"the {name.removeprefix('spring_')}", name, "springs", 1) for name in SPRING_FIELDS[2:]]
    for words, name, things, part in fields:
        scaled = [bool(np.any(one)) for one in getattr(model, name) * part]
        places = np.flatnonzero(scaled)
        for first in places[int(things == "joints" and name in JOINT_ELEMENTS) : -1]:
            which = f"all {things}" if first == places[0] else f"{things} {first + 1} to {len(scaled)}"
            yield JointCause(
                f"{words} of {which}",
                _scaled_from(name, int(first), part),
                1.0,
                1.0,
                "",
                words != "the inertia",
            )


def _scaled_from(name: str, first: int, part: Any) -> Callable[[Model, float], Model]:
    """Multiply a part of a field by a factor, from one place on."""

    def change(model: Model, x: float) -> Model:
        values = getattr(model, name).copy()
        values[first:] *= 1 + (x - 1) * part
        return replace(model, **{name: values})

    return change


def element_words(name: str) -> str:
    """Name a field of the mechanism.

    Returns:
        The words, with an article.

    """
    return ELEMENT_WORDS.get(name) or NAMES.get(name, f"the {name}")


def _coordinates(model: Model) -> list[tuple[int, int]]:
    """Joint and column of all coordinates that can have elements."""
    return [(k, i) for k, kind in enumerate(model.kinds) for i in range(kind.element_count)]


def _shift_is_askew(model: Model, k: int) -> bool:
    """Whether another origin of a slide is more than a coordinate of its far point."""
    along = rotation_matrix(model.turn[k, 0])[:, model.kinds[k].motions[0][1]]
    return bool(model.stiffness[k, 0] or np.count_nonzero(np.abs(along) > ACCEPTED_SHARE) > 1)


def _is(model: Model, at: tuple[int, int], what: str) -> bool:
    """Whether a coordinate is a slide or a turn."""
    motions = model.kinds[at[0]].motions
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
    turn = _turned_about(k, side)
    return lambda model, x: turn(model, x * np.eye(3)[axis])


def _turned_about(k: int, side: int) -> Callable[[Model, Array], Model]:
    """Turn the axes of a joint in one body by a rotation vector in themselves."""

    def change(model: Model, x: Array) -> Model:
        turned = quaternion_product(model.turn[k, side], quaternion_exponential(np.asarray(x) / 2))
        return one_number("turn", (k, side))(model, turned)

    return change


def _shifted_slide(k: int) -> Callable[[Model, float], Model]:
    """Count a slide's coordinate, spring included, from a point further along its axis."""

    def change(model: Model, x: float) -> Model:
        along = rotation_matrix(model.turn[k, 0])[:, model.kinds[k].motions[0][1]]
        moved = one_number("point", (k, 0))(model, model.point[k, 0] + x * along)
        return one_number("rest", (k, 0))(moved, model.rest[k, 0] - x)

    return change
