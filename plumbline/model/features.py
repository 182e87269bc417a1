"""Features of mechanisms: each field that is not zero, by the kind of its joint and the joint's role.

A feature is left out by giving the field its neutral value on all joints of that kind and role, as an adapter
that ignores it would.  docs/coverage.md defines what a pair of features is and when it is covered.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from plumbline.model.datatypes import JOINT_ELEMENTS, Array, Kind, Model
from plumbline.model.kinematics import path_to_world

Index = tuple[int | NDArray[np.bool_], ...]
Role = Literal["single", "beside", "loop", "closing"]
ROLE_PHRASES: dict[str, str] = {
    "single": "a {} alone on its parent",
    "beside": "a {} beside another branch",
    "loop": "a {} in a loop",
    "closing": "a {} that closes a loop",
}
_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


ROLES: tuple[Role, ...] = get_args(Role)


class Place(NamedTuple):
    """A kind of joint in a role."""

    kind: Kind
    role: Role


class Feature(NamedTuple):
    """One field of the model where it stands."""

    field: str
    kind: str = ""  # of the joint; empty for gravity and springs between points
    role: str = ""  # of the joint, or which bodies a spring joins

    def __str__(self) -> str:
        where = ROLE_PHRASES.get(self.role, self.role).format(self.kind)
        return f"{self.field} of {where}" if where else self.field


class _Value(NamedTuple):
    """One value of a mechanism that an adapter may ignore."""

    feature: Feature
    name: str  # of the array of the model
    at: Index
    neutral: Array | float = 0.0


def joint_roles(model: Model) -> list[Role]:
    """Tell what part each joint has in the mechanism.

    Returns:
        (J,) "closing" of joints that close loops, "loop" of joints of the tree on a loop, "beside" where the
        parent, or the world, carries another joint of the tree, else "single".

    """
    far = model.body[: model.n, 0]
    in_loops = set[int]()
    for ends in model.body[model.n :]:
        first, second = (set(path_to_world(far, int(end))) for end in ends)
        in_loops |= first ^ second
    found: list[Role] = []
    for k in range(model.n):
        is_single = np.count_nonzero(far == far[k]) == 1
        found.append("loop" if k in in_loops else "single" if is_single else "beside")
    return found + ["closing"] * (len(model.kind) - model.n)


def features(model: Model) -> list[Feature]:
    """List the features of a mechanism.

    Returns:
        The features, each once.

    """
    return list(dict.fromkeys(value.feature for value in _values(model)))


def without_feature(model: Model, feature: Feature) -> Model:
    """Leave a feature out.

    Args:
        model: a mechanism with the feature.
        feature: one of `features`.

    Returns:
        The mechanism with neutral values in its place.

    """
    changes: dict[str, Array] = {}
    for value in _values(model):
        if value.feature == feature:
            array = changes.setdefault(value.name, getattr(model, value.name).copy())
            array[value.at] = value.neutral
    return model.changed(**changes)


def _values(model: Model) -> Iterator[_Value]:
    """All values that are not neutral."""
    return (one for one in _every_value(model) if np.any(getattr(model, one.name)[one.at] != one.neutral))


def _every_value(model: Model) -> Iterator[_Value]:
    for axis, letter in enumerate("xyz"):
        yield _Value(Feature(f"gravity {letter}"), "gravity", (axis,))
    roles = joint_roles(model)
    for k, (kind, role) in enumerate(zip(model.kind, roles, strict=True)):
        for field, name, index, neutral in _joint_values(model, k):
            yield _Value(Feature(field, kind, role), name, index, neutral)
    tree = [min(path_to_world(model.body[: model.n, 0], k)) for k in range(model.n)]
    for k, (one, other) in enumerate(model.spring_body):
        where = "two bodies" if tree[one] == tree[other] else "two trees"
        where = f"a spring between {'a body and the world' if min(one, other) < 0 else where}"
        for side, field in enumerate(("first point", "second point")):
            yield _Value(Feature(field, "", where), "spring_point", (k, side))
        for field in ("stiffness", "damping", "length"):
            yield _Value(Feature(field, "", where), f"spring_{field}", (k,))


def _joint_values(model: Model, k: int) -> Iterator[tuple[str, str, Index, Array | float]]:
    """Of joint k and the body that it holds in the tree: field, array, index and neutral value."""
    far, near = model.body[k]
    # another parent: the world, or the body before
    if far >= 0 or (near and not model.kinds[k].holds_nothing):
        yield "parent", "body", (k, 0), -1 if far >= 0 else near - 1
    # What follows from the state of a closing joint: of a rod its length, of a turn with a pitch that number
    # and the far point, on which neither its angle nor a rate depends.
    own, is_given = model.kinds[k].own_number, k < model.n
    for side, end in enumerate(("parent", "body")):
        if is_given or side or not model.kinds[k].has_pitch:
            yield f"point of the {end}", "point", (k, side), 0.0
        yield f"axes in the {end}", "turn", (k, side), _IDENTITY
    if own and is_given:
        yield own, "length", (k,), float(model.kinds[k].holds_distance)
    for name in JOINT_ELEMENTS:
        for i in range(model.columns):
            yield f"{name} {i + 1}", name, (k, i), 0.0
    if k >= model.n:
        return
    yield "mass", "mass", (k,), 1.0
    yield "products of inertia", "inertia", (k, ~np.eye(3, dtype=bool)), 0.0
    moments = np.diagonal(model.inertia[k])
    yield "unequal moments of inertia", "inertia", (k, np.eye(3, dtype=bool)), np.full(3, moments.mean())
    for name in ("force", "moment", "drag_force", "drag_moment"):
        yield name.replace("_", " "), name, (k,), 0.0
