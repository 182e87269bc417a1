"""What an engine may read in another frame, or not as the number that it is: causes without an amount."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from plumbline.diagnosis.joint_causes import element_words, one_number
from plumbline.diagnosis.joint_prediction import Seen
from plumbline.model.datatypes import JOINT_ELEMENTS, KINDS, Array, Model, State
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
TURNS = {1: "as", -1: "against", 2: "twice as", -2: "twice against"}


def misreadings(model: Model) -> Iterator[tuple[str, Misreading]]:
    """List what an engine may read in another frame, or not as the number that it is.

    Args:
        model: the mechanism.

    Yields:
        Words that complete "behaves as if", and the mechanism and the state that the engine sees.

    """
    alone = list(_single_misreadings(model))
    yield from alone
    yield from _repeated(alone)
    for name, words in {
        **dict.fromkeys(JOINT_ELEMENTS, "joint"),
        **dict.fromkeys(BODY_VALUES, "body"),
    }.items():
        values = getattr(model, name)
        for shift, where in ((1, "before"), (-1, "after")):
            moved = np.roll(values, shift, axis=0)
            moved[0 if shift > 0 else -1] = values[0 if shift > 0 else -1]
            if len(values) > 2 and np.any(moved != values):
                text = f"{element_words(name)} of every {words} were that of the {words} {where}"
                yield text, _field(name, moved * _has_place(model, name))


def _single_misreadings(model: Model) -> Iterator[tuple[str, Misreading]]:
    """What may be read in another way of one body, joint or spring."""
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
                yield (
                    f"{words} {i + 1} of joint {k + 1} were its absolute value",
                    _coordinate(name, k, i, abs),
                )
        if len(KINDS[model.kind[k]].motions) == 2:
            for name, words in (("x", "coordinates"), ("xdot", "rates")):
                yield f"the {words} of joint {k + 1} were exchanged", _exchanged(name, k)
        for times, how in TURNS.items() if not KINDS[model.kind[k]].has_attitude else ():
            turn = np.linalg.matrix_power(rotation_matrix(model.turn[k, 1]), times)
            inertia = turn @ model.inertia[k] @ turn.T
            if np.max(np.abs(inertia - model.inertia[k])) > EQUAL * np.max(np.abs(inertia)):
                yield f"the inertia {of} were turned {how} its joint's axes", _number("inertia", k, inertia)
    yield from _point_misreadings(model)
    yield from _axes_misreadings(model)
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
        for i, motion in enumerate(KINDS[model.kind[k]].motions)
        if motion[0] == "turn"
    ]
    guesses: list[Callable[[Array], Array]] = [lambda x: -x, *map(_turned_over, turns)]
    for given in map(int, np.flatnonzero(model.body[: model.n, 0] < 0)):
        if len(KINDS[model.kind[given]].motions) == 1:
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


def _point_misreadings(model: Model) -> Iterator[tuple[str, Misreading]]:
    """Points of joints negated, exchanged, left out, or in other axes."""
    for k, kind in enumerate(model.kind):
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
        if kind != "free":
            yield from _different("point", k, points, readings)


def _axes_misreadings(model: Model) -> Iterator[tuple[str, Misreading]]:
    """Frames of joints left out, turned the other way, exchanged or misread; axes reversed or exchanged."""
    for k, kind in enumerate(model.kind):
        motions = [axis for _, axis in KINDS[kind].motions]
        if not motions and kind != "weld":
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
        for i, j in ((0, 1), (0, 2), (1, 2)) if kind == "universal" else ((0, 2), (1, 2)) if motions else ():
            half = np.array([0.0, *(np.sqrt(0.5) * (np.eye(3)[i] + np.eye(3)[j]))])
            pair = (quaternion_product(far, half), quaternion_product(near, half))
            readings[f"axes {'xyz'[i]} and {'xyz'[j]} of joint {k + 1} were exchanged"] = pair
        yield from _different("turn", k, frames, readings, kind == "weld")


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
    changed: dict[str, Any] = {name: values}
    return lambda model, state: Seen(replace(model, **changed), state)


def _number(name: str, k: int, value: Array) -> Misreading:
    return lambda model, state: Seen(one_number(name, (k,))(model, value), state)


def _has_place(model: Model, name: str) -> Array:
    """Where a field has a meaning: elements on a joint's coordinates (J, 2), 1 for all other fields."""
    if name not in JOINT_ELEMENTS:
        return np.ones(1)
    is_idle = name in ("rest", "effort")
    counts = [len(KINDS[kind].motions) or int(kind == "ball" and not is_idle) for kind in model.kind]
    return np.asarray(np.arange(2) < np.array(counts)[:, None], float)


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
