"""What an engine may read in another frame, or not as the number that it is: causes without an amount."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np

from plumbline.diagnosis.joint_causes import element_words, one_number
from plumbline.diagnosis.joint_prediction import Seen
from plumbline.model.datatypes import JOINT_ELEMENTS, SPRING_FIELDS, Array, Model, State
from plumbline.model.kinematics import (
    complete_state,
    own_rates,
    quaternion_conjugate,
    quaternion_product,
    rate_count,
    rotation_matrix,
    spring_vectors,
)
from plumbline.model.loops import assembled, loop_gaps

CLOSED = 1e-9  # m, rad: a larger gap is an open loop
EQUAL = 1e-12  # of two readings
Misreading = Callable[[Model, State], Seen]
BODY_VALUES = ("mass", "inertia", "force", "moment", "drag_force", "drag_moment")
PLACE, PLURALS = (
    re.compile(r"of (body|joint|spring) \d+"),
    {"body": "bodies", "joint": "joints", "spring": "springs"},
)
MISSING = {
    "the springs and dampers of all joints were missing": ("damping", "stiffness"),
    "the springs and efforts of all joints were missing": ("stiffness", "effort"),
    "the springs, dampers and efforts of all joints were missing": ("damping", "stiffness", "effort"),
    "all elements of joints were missing": ("armature", "damping", "stiffness", "effort"),
    "all springs and dampers between points were missing": ("spring_damping", "spring_stiffness"),
    "all applied forces and moments were missing": ("force", "moment"),
    "all drags were missing": ("drag_force", "drag_moment"),
}
OTHERS = {"before": "the {} before", "after": "the {} after", "first": "the first {}",
          "parent": "the {} on which it hangs"}  # fmt: skip
PRODUCTS = ("yz", "xz", "xy")  # entries of an inertia by the axis that they leave out
MAX_PLACES = 12  # bodies of a tree in which a field may be another's from each of them on
TURNS = {1: "as", -1: "against", 2: "twice as", -2: "twice against"}


def misreadings(model: Model) -> Iterator[tuple[str, Misreading]]:
    """List what an engine may read in another frame, or not as the number that it is.

    Yields:
        Words that complete "behaves as if", and the mechanism and the state that the engine sees.

    """
    alone = list(_single_misreadings(model))
    yield from alone
    yield from _repeated(alone)
    yield from _fields_of_others(model)
    known = []
    for words, names in MISSING.items():
        present = {name for name in names if np.any(getattr(model, name))}
        if len(present) > 1 and present not in known:  # one field alone is a cause with a factor
            known.append(present)
            yield words, _fields({name: 0 * getattr(model, name) for name in present})


def _fields_of_others(model: Model) -> Iterator[tuple[str, Misreading]]:
    """A field of all bodies, joints or springs taken from another one, or only of those from one on."""
    for name, things in {
        **dict.fromkeys(JOINT_ELEMENTS, "joint"),
        **dict.fromkeys(BODY_VALUES, "body"),
        **dict.fromkeys(SPRING_FIELDS[1:], "spring"),
    }.items():
        values, words = getattr(model, name), element_words(name.removeprefix("spring_"))
        count = len(values)
        if count < 3:
            continue
        places, known = np.arange(count), [values]
        sources = {
            "before": np.maximum(places - 1, 0),
            "after": np.minimum(places + 1, count - 1),
            "first": 0 * places,
        }
        if things != "spring":
            sources["parent"] = np.where(model.body[:count, 0] < 0, places, model.body[:count, 0])
        for where, source in sources.items():
            for first in range(count - 2 if where != "after" and count <= MAX_PLACES else 1):
                taken = np.where(places > first, source, places) if first else source
                moved = values[taken] * _has_place(model, name)
                if np.sum(moved != values) < 2 or any(np.array_equal(moved, one) for one in known):
                    continue  # a single number is a cause of its own
                known.append(moved)
                which = f"{PLURALS[things]} {first + 2} to {count}" if first else f"every {things}"
                yield f"{words} of {which} were that of {OTHERS[where].format(things)}", _field(name, moved)


def _single_misreadings(model: Model) -> Iterator[tuple[str, Misreading]]:
    """What may be read in another way of one body, joint or spring."""
    for k in range(model.n):
        of = f"of body {k + 1}"
        if model.kinds[k].has_attitude:
            yield f"the world-frame angular velocity {of} were used", _turned_state("omega", k, False)
        if model.free[k]:
            yield f"the velocity {of} were given in the body frame", _turned_state("v", k, False)
            yield f"the body-frame velocity {of} were used", _turned_state("v", k, True)
        if np.any(model.force[k]):
            yield f"the applied force {of} were given in the body frame", _turned_load("force", k, False)
        if np.any(model.moment[k]):
            yield f"the applied moment {of} were given in the world frame", _turned_load("moment", k, True)
        for i, (what, _) in enumerate(model.kinds[k].motions):
            if what == "turn":
                words = f"angle {i + 1} of joint {k + 1} were its principal value"
                yield words, _coordinate("x", k, i, lambda x: float(np.arctan2(np.sin(x), np.cos(x))))
            for name, words in (("x", "coordinate"), ("xdot", "rate")):
                text = f"{words} {i + 1} of joint {k + 1} had the opposite sign"
                yield text, _coordinate(name, k, i, lambda x: -x)
                yield (
                    f"{words} {i + 1} of joint {k + 1} were its absolute value",
                    _coordinate(name, k, i, abs),
                )
        if len(model.kinds[k].motions) == 2:
            for name, words in (("x", "coordinates"), ("xdot", "rates")):
                yield f"the {words} of joint {k + 1} were exchanged", _exchanged(name, k)
            for name in JOINT_ELEMENTS:
                pair = getattr(model, name)[k]
                if pair[0] != pair[1]:
                    words = f"{element_words(name)} of the two coordinates of joint {k + 1} were exchanged"
                    yield words, _number(name, k, pair[[1, 0, *range(2, len(pair))]])
        yield from _body_misreadings(model, k)
        for i in range(len(model.kinds[k].motions)):
            if model.stiffness[k, i]:
                yield f"spring {i + 1} of joint {k + 1} did not count its coordinate", _unmoved_spring(k, i)
        for times, how in TURNS.items() if not model.kinds[k].has_attitude else ():
            turn = np.linalg.matrix_power(rotation_matrix(model.turn[k, 1]), times)
            inertia = turn @ model.inertia[k] @ turn.T
            if np.max(np.abs(inertia - model.inertia[k])) > EQUAL * np.max(np.abs(inertia)):
                yield f"the inertia {of} were turned {how} its joint's axes", _number("inertia", k, inertia)
    yield from _point_misreadings(model)
    yield from _axes_misreadings(model)
    yield from _spring_misreadings(model)
    for number in map(int, np.flatnonzero(model.spring_damping)):
        yield f"the rate of spring {number + 1} were dᵀḋ, not over the length", _undivided_rate(number)


def other_branches(model: Model) -> Iterator[tuple[str, list[Misreading]]]:
    """List joints on the world at whose coordinates an engine may close the loops in other poses.

    Args:
        model: with loops.

    Yields:
        Words that complete "behaves as if", and what the engine may see: the poses that guesses lead to.

    """
    turns = [
        (k, i)
        for k in range(model.n)
        for i, motion in enumerate(model.kinds[k].motions)
        if motion[0] == "turn"
    ]
    guesses: list[Callable[[Array], Array]] = [lambda x: -x, *map(_turned_over, turns)]
    for given in map(int, np.flatnonzero(model.body[: model.n, 0] < 0)):
        if len(model.kinds[given].motions) == 1:
            words = f"the loops were closed on another branch at the coordinate of joint {given + 1}"
            yield words, [_branch(given, guess) for guess in guesses]


def _turned_over(turn: tuple[int, int]) -> Callable[[Array], Array]:
    """A guess: one angle is half a turn more."""

    def guess(x: Array) -> Array:
        y = x.copy()
        y[turn] += np.pi
        return y

    return guess


def _branch(given: int, guess: Callable[[Array], Array]) -> Misreading:
    """The pose to which loops close from a guess of the coordinates (N, 2), joint ``given`` held."""

    def misread(model: Model, state: State) -> Seen:
        x = guess(state.x)
        x[given] = state.x[given]
        movable = np.ones(rate_count(model.tree), bool)
        movable[own_rates(model)[given]] = False
        there = complete_state(model, replace(state, x=x))
        other = assembled(model, there, movable, is_pose_kept=True)
        if max(map(np.max, loop_gaps(model, other))) > CLOSED:
            raise ValueError("the loops do not close from this guess")
        return Seen(model, other, is_elsewhere=True)

    return misread


def _body_misreadings(model: Model, k: int) -> Iterator[tuple[str, Misreading]]:
    """Products of inertia in another order, loads or drags exchanged, and drag by other velocities."""
    of = f"of body {k + 1}"
    inertia, known = model.inertia[k], [model.inertia[k]]
    for order in permutations(range(3)):
        other, signs = inertia.copy(), (-1.0, 1.0)
        for sign in signs:
            for i, j in enumerate(order):
                a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
                other[a, b] = other[b, a] = sign * inertia[c, d]
            if all(np.max(np.abs(other - one)) > EQUAL * np.max(np.abs(inertia)) for one in known):
                known.append(other.copy())
                taken = ", ".join("-" * (sign < 0) + PRODUCTS[j] for j in order)
                words = f"the products of inertia yz, xz, xy {of} were {taken}"
                yield words, _number("inertia", k, other.copy())
    for one, other_name, words in (
        ("force", "moment", "the applied force and moment"),
        ("drag_force", "drag_moment", "the drag force and the drag moment"),
    ):
        a, b = getattr(model, one)[k], getattr(model, other_name)[k]
        if np.any(a != b):
            yield f"{words} {of} were exchanged", _two_numbers(k, {one: b, other_name: a})
    if model.drag_moment[k]:
        yield (
            f"the drag moment {of} were taken with the world-frame angular velocity",
            _other_drag("moment", k),
        )
    if model.drag_force[k]:
        yield f"the drag force {of} were taken with the body-frame velocity", _other_drag("force", k)
        yield (
            f"the drag force {of} were taken with the velocity of its joint's point",
            _other_drag("point", k),
        )


def _two_numbers(k: int, values: Mapping[str, Any]) -> Misreading:
    def misread(model: Model, state: State) -> Seen:
        for name, value in values.items():
            model = one_number(name, (k,))(model, value)
        return Seen(model, state)

    return misread


def _other_drag(what: str, k: int) -> Misreading:
    """The drag of a body by another velocity than its own; the difference acts as a load."""

    def misread(model: Model, state: State) -> Seen:
        at = complete_state(model, state)
        turn = rotation_matrix(at.p[k])
        own, other = {
            "moment": (at.omega[k], turn @ at.omega[k]),
            "force": (at.v[k], turn.T @ at.v[k]),
            "point": (at.v[k], at.v[k] + turn @ np.cross(at.omega[k], model.proximal[k])),
        }[what]
        name = "moment" if what == "moment" else "force"
        load = getattr(model, name)[k] + getattr(model, f"drag_{name}")[k] * (own - other)
        return Seen(one_number(name, (k,))(model, load), state)

    return misread


def _unmoved_spring(k: int, i: int) -> Misreading:
    """A joint's spring that pulls with its rest position alone."""

    def misread(model: Model, state: State) -> Seen:
        effort = model.effort[k, i] + model.stiffness[k, i] * state.x[k, i]
        return Seen(one_number("effort", (k, i))(model, effort), state)

    return misread


def _spring_misreadings(model: Model) -> Iterator[tuple[str, Misreading]]:
    """Points of springs negated, left out or exchanged."""
    for i, points in enumerate(model.spring_point):
        readings = {f"the points of spring {i + 1} were exchanged": (points[1], points[0])}
        for side, where in enumerate(("first", "second")):
            where = f"the {where} point" if model.spring_body[i, side] >= 0 else "the world's point"
            for words, point in (("negated", -points[side]), ("left out", 0 * points[side])):
                pair = (point, points[1]) if side == 0 else (points[0], point)
                readings[f"{where} of spring {i + 1} were {words}"] = pair
        yield from _different("spring_point", i, points, readings)


def _point_misreadings(model: Model) -> Iterator[tuple[str, Misreading]]:
    """Points of joints negated, exchanged, left out, or in other axes."""
    for k in range(len(model.kind)):
        far, near = points = model.point[k]
        readings = {
            f"the points of joint {k + 1} in the two bodies were exchanged": (near, far),
            f"the points of joint {k + 1} in both bodies were negated": (-far, -near),
        }
        for side, where in enumerate(("far", "near")):
            turn = rotation_matrix(model.turn[k, side])
            for words, point in (
                ("were negated", -points[side]),
                ("were left out", 0 * points[side]),
                ("were that of the other body", points[1 - side]),
                ("were given in the axes of the joint", turn @ points[side]),
                ("were turned into the axes of the joint", turn.T @ points[side]),
            ):
                pair = (point, near) if side == 0 else (far, point)
                readings[f"the {where} point of joint {k + 1} {words}"] = pair
        if not model.free[k]:
            yield from _different("point", k, points, readings)


def _axes_misreadings(model: Model) -> Iterator[tuple[str, Misreading]]:
    """Frames of joints left out, turned the other way, exchanged or misread; axes reversed or exchanged."""
    for k, kind in enumerate(model.kinds):
        motions = [axis for _, axis in kind.motions]
        if kind.has_attitude:
            continue
        far, near = frames = model.turn[k]
        axes = f"the axes of joint {k + 1}"
        readings: dict[str, tuple[Array, Array]] = {}
        for axis in dict.fromkeys(motions):
            half = np.roll(np.eye(4)[1], int(axis == 0))  # about y for x, about x for the others
            pair = (quaternion_product(far, half), quaternion_product(near, half))
            readings[f"axis {'xyz'[axis]} of joint {k + 1} were reversed"] = pair
        for sides, where in (
            ((0,), "in the far body"),
            ((1,), "in the near body"),
            ((0, 1), "in both bodies"),
        ):
            for words, misread in QUATERNIONS.items():
                read = [misread(q) if side in sides else q for side, q in enumerate(frames)]
                readings[f"{axes} {where} {words}"] = read[0], read[1]
        readings[f"{axes} in the two bodies were exchanged"] = near, far
        readings[f"{axes} in the far body were those of the near body"] = near, near
        readings[f"{axes} in the near body were those of the far body"] = far, far
        pairs = ((0, 2), (1, 2)) if kind.is_about_z else ((0, 1), (0, 2), (1, 2))
        for i, j in pairs if motions else ():
            half = np.array([0.0, *(np.sqrt(0.5) * (np.eye(3)[i] + np.eye(3)[j]))])
            pair = (quaternion_product(far, half), quaternion_product(near, half))
            readings[f"axes {'xyz'[i]} and {'xyz'[j]} of joint {k + 1} were exchanged"] = pair
        yield from _different("turn", k, frames, readings, kind.is_rigid)


QUATERNIONS: dict[str, Callable[[Array], Array]] = {
    "were not turned": lambda q: np.eye(4)[0],
    "were turned the other way": quaternion_conjugate,
    "were read with the scalar last": lambda q: np.roll(q, 1),
    "were given with the scalar last": lambda q: np.roll(q, -1),
}


def _different(
    name: str,
    k: int,
    right: Array,
    readings: Mapping[str, tuple[Array, Array]],
    is_relative: bool = False,
) -> Iterator[tuple[str, Misreading]]:
    """Readings of a pair (2, ·) that differ from the right one and from each other; of turns ±q are one."""
    known: list[Array] = []

    def key(pair: Array) -> Array:
        if is_relative:
            pair = quaternion_product(pair[0], quaternion_conjugate(pair[1]))[None]
        if name != "turn":
            return pair
        return np.array([np.outer(q, q) for q in pair])

    known.append(key(right))
    for words, pair in readings.items():
        value = np.array(pair)
        here = key(value)
        if all(np.max(np.abs(here - one)) > EQUAL for one in known):
            known.append(here)
            yield words, _joint_field(name, k, value)


def _repeated(found: Sequence[tuple[str, Misreading]]) -> Iterator[tuple[str, Misreading]]:
    """The same reading of all bodies, joints or springs that it concerns."""
    groups: dict[str, list[Misreading]] = {}
    for words, misread in found:
        groups.setdefault(PLACE.sub(lambda place: f"of all {PLURALS[place[1]]}", words, count=1), []).append(
            misread
        )
    for words, parts in groups.items():
        if len(parts) > 1:
            yield words, _one_after_another(parts)


def _one_after_another(parts: Sequence[Misreading]) -> Misreading:
    def misread(model: Model, state: State) -> Seen:
        for part in parts:
            seen = part(model, state)
            model, state = seen.model, seen.state
        return Seen(model, state)

    return misread


def _exchanged(name: str, k: int) -> Misreading:
    """The two coordinates of a joint, or their rates, exchanged."""

    def misread(model: Model, state: State) -> Seen:
        values = getattr(state, name).copy()
        values[k] = values[k, ::-1]
        return Seen(model, replace(state, **{name: values}))

    return misread


def _field(name: str, values: Array) -> Misreading:
    return _fields({name: values})


def _fields(changed: Mapping[str, Any]) -> Misreading:
    return lambda model, state: Seen(replace(model, **changed), state)


def _number(name: str, k: int, value: Array) -> Misreading:
    return lambda model, state: Seen(one_number(name, (k,))(model, value), state)


def _has_place(model: Model, name: str) -> Array:
    """Where a field has a meaning: elements on a joint's coordinates (J, 2), 1 for all other fields."""
    if name not in JOINT_ELEMENTS:
        return np.ones(1)
    is_idle = name in ("rest", "effort")
    counts = [len(kind.motions) or int(kind.is_spherical and not is_idle) for kind in model.kinds]
    return np.asarray(np.arange(model.columns) < np.array(counts)[:, None], float)


def _joint_field(name: str, k: int, value: Array) -> Misreading:
    return lambda model, state: Seen(one_number(name, (k,))(model, value), state)


def _turned_state(name: str, k: int, to_body: bool) -> Misreading:
    def misread(model: Model, state: State) -> Seen:
        values, turn = getattr(state, name).copy(), rotation_matrix(state.p[k])
        values[k] = (turn.T if to_body else turn) @ values[k]
        return Seen(model, replace(state, **{name: values}))

    return misread


def _turned_load(name: str, k: int, to_body: bool) -> Misreading:
    def misread(model: Model, state: State) -> Seen:
        turn = rotation_matrix(complete_state(model, state).p[k])
        values = getattr(model, name).copy()
        values[k] = (turn.T if to_body else turn) @ values[k]
        return Seen(replace(model, **{name: values}), state)

    return misread


def _coordinate(name: str, k: int, i: int, change: Callable[[float], float]) -> Misreading:
    def misread(model: Model, state: State) -> Seen:
        values = getattr(state, name).copy()
        values[k, i] = change(float(values[k, i]))
        return Seen(model, replace(state, **{name: values}))

    return misread


def _undivided_rate(i: int) -> Misreading:
    def misread(model: Model, state: State) -> Seen:
        length = float(np.linalg.norm(spring_vectors(model, state.r, state.p)[i]))
        return Seen(one_number("spring_damping", (i,))(model, length * float(model.spring_damping[i])), state)

    return misread
