"""The same mechanism made of other joints and elements, whose answers follow from the answers to the first.

    root moved         the last body of the first branch is the root, free; the joints between are reversed,
                       and the joint that the root had on the world closes a loop
    joints as rods     a hinge, universal joint or weld is a ball joint, and each of its rows aᵀB = 0 a rod,
                       between points s along a and B: its length is √2 s
    inertia as rotors  a body on a hinge on the world turns about its axis z only: δ z zᵀ of its inertia may
                       be a rotor of inertia δ (on a moving body not: rotors have no gyroscopic terms)
    springs as loads   at one state, springs and dampers of joints are efforts, those between points loads
    rods taken out     bodies on rods are free, rods that close loops are left out: an adapter puts ties in
                       their place
    joints as cylinders  hinges, slides, welds and joints with a pitch are cylindrical joints: an adapter
                       holds the coordinates that these have in addition, at 0 or the pitch times the turn

A universal joint is not described as two hinges with a body between them: that body would have no mass, and a
small one would change the mechanism.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plumbline.model.datatypes import (
    BALL,
    BODY_FIELDS,
    CYLINDRICAL,
    FREE,
    HINGE,
    JOINT_ELEMENTS,
    JOINT_FIELDS,
    KINDS,
    ROD,
    SPRING_FIELDS,
    Bool,
    Flags,
    Indices,
    Int,
    Kind,
    Model,
    State,
)
from plumbline.model.kinematics import (
    complete_state,
    cross,
    depth_first,
    joints_with_elements,
    path_to_world,
    quaternion_product,
    rotate_vectors,
    rotation_matrix,
    spring_vector_rates,
    spring_vectors,
)
from plumbline.model.loops import wrench_length

_CYLINDER = KINDS[CYLINDRICAL].motions
HELD_KINDS = tuple(  # made of cylindrical joints by holding some of their motions
    name
    for name, kind in KINDS.items()
    if not (kind.has_attitude or kind.has_pitch) and {*kind.motions} < {*_CYLINDER}
)
PITCHED_KINDS = tuple(name for name, kind in KINDS.items() if kind.has_pitch)
EXCHANGE = np.array([0.0, 1.0, 1.0, 0.0]) / np.sqrt(2)  # half a turn that exchanges x and y


@dataclass(frozen=True, eq=False)
class Rearranged:
    """A mechanism with bodies and joints in another order, and with other free bodies."""

    model: Model
    order: Int[Indices, "bodies"]  # the first mechanism's bodies in the new order
    joint: Int[Indices, "joints"]  # of each joint of the first mechanism its new number; −1: left out
    is_reversed: Bool[Flags, "joints"]  # of the first mechanism's joints

    def state(self, state: State) -> State:
        """Describe a state of the first mechanism as one of this one."""
        fields = {name: getattr(state, name)[self.order] for name in ("p", "omega", "r", "v")}
        for name in ("u", "udot", "x", "xdot"):
            values = np.zeros_like(getattr(state, name))
            for k, value in enumerate(getattr(state, name)):
                place = self.joint[k]
                if 0 <= place < self.model.n:
                    is_swapped = self.model.kinds[place].exchanges_axes and name in ("x", "xdot")
                    if self.is_reversed[k]:
                        value = -value[_swapped(len(value))] if is_swapped else -value
                    values[place] = value
            fields[name] = values
        return complete_state(self.model, State(**fields))


def moved_root(model: Model) -> Rearranged | None:
    """Make the last body of the first branch the root, a free body.

    Returns:
        The same mechanism; None where the root's joint has elements, a joint cannot be reversed, or there is
        no other body to be the root of a free one.

    """
    n, far = model.n, model.body[: model.n, 0]
    last = next((k for k in range(1, n) if far[k] != k - 1), n) - 1
    path = [*path_to_world(far, last)]
    root = path[-1]
    is_free = model.free[root]
    if joints_with_elements(model)[root] or (is_free and last == root):
        return None
    above = far.copy()
    for k in path[:-1]:
        above[far[k]] = k
    above[last] = -1
    place = np.argsort(depth_first(above, last))
    count = len(model.kind)
    joint = np.concatenate([place, np.arange(n, count)])
    is_reversed = np.zeros(count, bool)
    for k in path[:-1]:
        joint[k], is_reversed[k] = place[far[k]], True
    joint[root] = -1 if is_free else count
    if not all(kind.is_reversible for kind, flip in zip(model.kinds, is_reversed, strict=True) if flip):
        return None
    return _rearranged(model, joint, is_reversed, place)


def rods_taken_out(model: Model) -> Rearranged:
    """Leave out every rod; a body that hung on one is free.

    Returns:
        The mechanism without rods.

    """
    n, is_rod = model.n, model.rods
    place = np.argsort(depth_first(np.where(is_rod[:n], -1, model.body[:n, 0])))
    closing = n + np.cumsum(~is_rod[n:]) - 1
    joint = np.where(is_rod, -1, np.concatenate([place, closing]))
    return _rearranged(model, joint, np.zeros(len(joint), bool), place)


def _rearranged(
    model: Model, joint: NDArray[np.intp], is_reversed: NDArray[np.bool_], place: NDArray[np.intp]
) -> Rearranged:
    """The mechanism with its joints at their new numbers, some reversed; bodies without a joint are free."""
    sources = {int(to): k for k, to in enumerate(joint) if to >= 0}
    fields: dict[str, list[Any]] = {name: [] for name in JOINT_FIELDS}
    world = np.append(place, -1)  # the world is −1 in both
    for to in range(max(model.n, int(np.max(joint)) + 1)):
        if to not in sources:
            free = (FREE, [-1, to], np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)), 0.0)
            for name, value in zip(JOINT_FIELDS, (*free, *np.zeros((5, model.columns))), strict=True):
                fields[name].append(value)
            continue
        k = sources[to]
        flip = -1 if is_reversed[k] else 1
        turn, swap = model.turn[k][::flip], list(range(model.columns))
        if is_reversed[k] and model.kinds[k].exchanges_axes:  # its axes x and y change places
            turn, swap = quaternion_product(turn, EXCHANGE), _swapped(model.columns)
        fields["kind"].append(model.kind[k])
        fields["body"].append(world[model.body[k]][::flip])
        fields["point"].append(model.point[k][::flip])
        fields["turn"].append(turn)
        fields["length"].append(model.length[k])
        for name in JOINT_ELEMENTS:
            fields[name].append(getattr(model, name)[k][swap] * (flip if name in ("rest", "effort") else 1))
    changes = {name: np.array(values) for name, values in fields.items() if name != "kind"}
    order = np.argsort(place)
    for name in ("mass", "inertia", *BODY_FIELDS):
        changes[name] = getattr(model, name)[order]
    other = replace(model, kind=tuple(fields["kind"]), spring_body=world[model.spring_body], **changes)
    return Rearranged(other, order, joint, is_reversed)


def _swapped(columns: int) -> list[int]:
    """The columns of coordinates with the first two exchanged."""
    return [1, 0, *range(2, columns)]


def joints_as_cylinders(model: Model, some: Collection[Kind]) -> Model:
    """Make cylindrical joints of some kinds.

    Args:
        model: a tree.
        some: of `HELD_KINDS` and `PITCHED_KINDS`.

    Returns:
        The tree, whose joints have motions in addition.

    """
    kinds = tuple(CYLINDRICAL if kind in some else kind for kind in model.kind)
    elements: dict[str, Any] = {
        name: _of_cylinders(model, kinds, getattr(model, name)) for name in JOINT_ELEMENTS
    }
    length = np.where([kind in some for kind in model.kind], 0.0, model.length)
    return replace(model, kind=kinds, length=length, **elements)


def added_motions(model: Model, cylinders: Model) -> list[tuple[int, ...]]:
    """List the coordinates that each joint has in addition where it is a cylindrical one."""
    pairs = zip(model.kind, cylinders.kind, model.kinds, strict=True)
    return [
        tuple(i for i, motion in enumerate(_CYLINDER) if old != new and motion not in kind.motions)
        for old, new, kind in pairs
    ]


def state_of_cylinders(model: Model, cylinders: Model, state: State) -> State:
    """Describe a state for cylindrical joints in the place of others.

    Args:
        model: a tree.
        cylinders: `joints_as_cylinders` of it.
        state: of the tree; or many, of arrays with leading axes.

    Returns:
        The same state; shifts that joints have in addition are their pitches times the turns, or zero.

    """
    pitched = np.array([kind.has_pitch for kind in model.kinds])
    x, xdot = (_of_cylinders(model, cylinders.kind, values) for values in (state.x, state.xdot))
    for values in (x, xdot):
        values[..., pitched, 0] = model.length[pitched] * values[..., pitched, 1]
    return complete_state(cylinders, replace(state, x=x, xdot=xdot))


def _of_cylinders(model: Model, kinds: Sequence[Kind], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Numbers of coordinates in the columns of those of cylindrical joints, zeros of added ones."""
    found = values.copy()
    for k, kind in enumerate(model.kinds):
        if model.kind[k] != kinds[k]:
            places = [_CYLINDER.index(motion) for motion in kind.motions]
            found[..., k, :] = 0.0
            found[..., k, places] = values[..., k, : len(places)]
    return found


def joints_as_rods(model: Model) -> Model:
    """Make ball joints and rods of hinges, universal joints and welds that have no elements.

    Args:
        model: a tree.

    Returns:
        The same mechanism; the model itself where it has none of them.

    """
    is_more_than_a_ball = [kind.holds_points and not kind.is_spherical for kind in model.kinds]
    chosen = np.flatnonzero((is_more_than_a_ball & ~joints_with_elements(model))[: model.n]).tolist()
    size = wrench_length(model)
    body, point, kind = [], [], list[Kind](model.kind)
    for k in chosen:
        # [side, axis]: a vector in that side's body
        axes = rotation_matrix(model.turn[k]).swapaxes(-1, -2) * size
        for one, other in model.kinds[k].rows[3:]:
            ends = np.array([axes[0, "xyz".index(one)], axes[1, "XYZ".index(other)]])
            body.append(model.body[k])
            point.append(model.point[k] + ends)
        kind[k] = BALL
    if not chosen:
        return model
    new = len(body)
    kind += [ROD] * new
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (new, 2, 1))
    return replace(
        model,
        kind=tuple(kind),
        body=np.concatenate([model.body, body]),
        point=np.concatenate([model.point, point]),
        turn=np.concatenate([model.turn, identity]),
        length=np.concatenate([model.length, np.full(new, np.sqrt(2.0) * size)]),
    )


def state_of_balls(model: Model, state: State) -> State:
    """Describe a state for a mechanism in which ball joints have taken the place of other joints.

    Args:
        model: that mechanism.

    """
    has_coordinates = np.array([not kind.has_attitude for kind in model.kinds[: model.n]])[:, None]
    x, xdot = (np.where(has_coordinates, values, 0.0) for values in (state.x, state.xdot))
    return complete_state(model, replace(state, x=x, xdot=xdot))


def inertia_as_rotors(model: Model) -> Model:
    """Make rotors of a part of the inertia of bodies on hinges on the world; what is left is physical.

    Returns:
        The same mechanism; the model itself where there are no such bodies.

    """
    inertia, armature = model.inertia.copy(), model.armature.copy()
    for k in range(model.n):
        if model.kind[k] == HINGE and model.body[k, 0] < 0:
            second = np.trace(inertia[k]) / 2 * np.eye(3) - inertia[k]  # moments of the mass, ∫ x xᵀ dm
            part = float(np.linalg.eigvalsh(second)[0])
            z = rotation_matrix(model.turn[k, 1])[:, 2]
            inertia[k] -= part * np.outer(z, z)
            armature[k, 0] += part
    is_same = np.array_equal(armature, model.armature)
    return model if is_same else replace(model, inertia=inertia, armature=armature)


def springs_as_loads(model: Model, state: State) -> Model:
    """Make efforts of springs and dampers of joints, and loads of those between points, at one state.

    Args:
        state: where it is; angles count full turns.

    Returns:
        The mechanism with the same forces at this state; springs and dampers of ball joints, and of joints
        that close loops, stay.

    """
    effort, stiffness, damping = model.effort.copy(), model.stiffness.copy(), model.damping.copy()
    scalar = np.array([not kind.is_spherical for kind in model.kinds[: model.n]])[:, None]
    pull = -stiffness[: model.n] * (state.x - model.rest[: model.n]) - damping[: model.n] * state.xdot
    effort[: model.n] += np.where(scalar, pull, 0.0)
    for values in (stiffness, damping):
        values[: model.n] = np.where(scalar, 0.0, values[: model.n])
    force, moment = model.force.copy(), model.moment.copy()
    a = rotation_matrix(state.p)
    vectors = spring_vectors(model, state.r, state.p)
    rates = spring_vector_rates(model, state.p, state.v, state.omega)
    for i, (d, rate) in enumerate(zip(vectors, rates, strict=True)):
        length = float(np.linalg.norm(d))
        tension = model.spring_stiffness[i] * (length - model.spring_length[i])
        tension += model.spring_damping[i] * float(rate @ d) / length
        for b, at, sign in zip(model.spring_body[i], model.spring_point[i], (1.0, -1.0), strict=True):
            if b >= 0:
                push = sign * tension * d / length
                force[b] += push
                moment[b] += cross(at, rotate_vectors(a[b].T, push))
    none: dict[str, Any] = {name: getattr(model, name)[:0] for name in SPRING_FIELDS}
    return replace(
        model, effort=effort, stiffness=stiffness, damping=damping, force=force, moment=moment, **none
    )
