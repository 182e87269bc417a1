"""Other descriptions of the same mechanism, whose answers follow from the answers to the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plumbline.model.datatypes import (
    BODY_FIELDS,
    JOINT_FIELDS,
    SPRING_FIELDS,
    Array,
    Float,
    Indices,
    Int,
    Model,
    State,
)
from plumbline.model.kinematics import (
    complete_state,
    depth_first,
    normalised,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
)

# state quantities in world axes
WORLD_VECTORS = ("acceleration", "joint_reaction", "joint_moment", "angular_momentum")
BODY_VECTORS = ("angular_acceleration",)  # … in body axes


def rotate_world(model: Model, state: State, q: Float[Array, "4"]) -> tuple[Model, State]:
    """Rotate everything in world axes: gravity, applied forces, attitudes and rod directions.

    Args:
        q: unit quaternion of the rotation, scalar first.

    Returns:
        The rotated mechanism and its state; attitudes are unit quaternions again.

    """
    turn = rotation_matrix(q)
    rotated = replace(
        _with_rotated_ends(model, q, model.body < 0, model.spring_body < 0),
        gravity=turn @ model.gravity,
        force=model.force @ turn.T,
    )
    vectors = {name: getattr(state, name) @ turn.T for name in ("u", "udot", "r", "v")}
    p = normalised(quaternion_product(q, state.p))
    return rotated, complete_state(rotated, replace(state, p=p, **vectors))


def rotate_body_frames(model: Model, state: State, q: Float[Array, "4"]) -> tuple[Model, State]:
    """Describe every body in other axes of its own: a body vector x becomes Q x.

    Args:
        q: unit quaternion of the rotation Q, scalar first.

    Returns:
        The same mechanism in these axes and its state; attitudes are unit quaternions again.

    """
    turn = rotation_matrix(q)
    inertia = turn @ model.inertia @ turn.T
    rotated = replace(
        _with_rotated_ends(model, q, model.body >= 0, model.spring_body >= 0),
        inertia=(inertia + inertia.swapaxes(-1, -2)) / 2,
        moment=model.moment @ turn.T,
    )
    p = normalised(quaternion_product(state.p, quaternion_conjugate(q)))
    return rotated, complete_state(rotated, replace(state, p=p, omega=state.omega @ turn.T))


def _with_rotated_ends(
    model: Model, q: Array, of_joints: NDArray[np.bool_], of_springs: NDArray[np.bool_]
) -> Model:
    """Rotate points and axes of joints, and points of springs, on some of their bodies."""
    turn = rotation_matrix(q)
    return replace(
        model,
        point=np.where(of_joints[..., None], model.point @ turn.T, model.point),
        turn=np.where(of_joints[..., None], normalised(quaternion_product(q, model.turn)), model.turn),
        spring_point=np.where(of_springs[..., None], model.spring_point @ turn.T, model.spring_point),
    )


def unrotate(answers: dict[str, Array], vectors: Sequence[str], q: Float[Array, "4"]) -> dict[str, Array]:
    """Rotate vectors of a rotated pendulum back.

    Args:
        answers: quantities by their names in `StateQuantities`.
        vectors: names of those to rotate: `WORLD_VECTORS` or `BODY_VECTORS`.
        q: the quaternion that `rotate_world` or `rotate_body_frames` was given.

    Returns:
        The same quantities in the axes of the first description.

    """
    return {name: x @ rotation_matrix(q) if name in vectors else x for name, x in answers.items()}


def siblings_reversed(model: Model) -> Int[Indices, "bodies"]:
    """Order the bodies depth first with the branches on every body, and on the world, in reverse.

    Returns:
        The bodies in the new order; ascending where no two joints have the same far body.

    """
    return np.array(depth_first(model.body[: model.n, 0], is_reversed=True), np.intp)


def reorder_bodies(model: Model, state: State, order: Int[Indices, "bodies"]) -> tuple[Model, State]:
    """Number the bodies and joints in another order.

    Args:
        order: the bodies in the new order, each behind its far body.

    """
    place = np.append(np.argsort(order), -1)  # the world is −1 in both
    joints = np.append(order, np.arange(model.n, len(model.kind)))  # those that close loops stay
    fields = _fields_of(model, order, joints)
    changes = {"body": place[fields["body"]], "spring_body": place[model.spring_body]}
    return replace(model, **fields | changes), state[order]


def _fields_of(model: Model, bodies: Any, joints: NDArray[np.intp]) -> dict[str, Any]:
    """Fields of some bodies and joints, in an order; the joints' bodies by their old numbers."""
    fields = {name: getattr(model, name)[bodies] for name in ("mass", "inertia", *BODY_FIELDS)}
    fields |= {name: getattr(model, name)[joints] for name in JOINT_FIELDS if name != "kind"}
    return fields | {"kind": tuple(model.kind[k] for k in joints)}


def bodies_between(model: Model, state: State, first: int, end: int) -> tuple[Model, State]:
    """Cut off all but some consecutive bodies, with the closing joints and springs of the others.

    Args:
        first: the first body that remains; joints of later ones on earlier ones are moved to the origin.
        end: the body after the last one that remains.

    Returns:
        The smaller mechanism, and the state of it with the same numbers: the same state where ``first`` is 0.

    """
    tree = np.arange(len(model.kind)) < model.n
    inside, springs = (
        np.all((pairs < 0) | (pairs >= first) & (pairs < end), axis=1)
        for pairs in (model.body, model.spring_body)
    )
    near = model.body[:, 1]
    joints = np.flatnonzero(np.where(tree, (near >= first) & (near < end), inside))
    fields = _fields_of(model, slice(first, end), joints)
    fields["point"][~inside[joints], 0] = 0.0
    fields |= {name: getattr(model, name)[springs] for name in SPRING_FIELDS}
    fields |= {name: np.maximum(fields[name] - first, -1) for name in ("body", "spring_body")}
    return replace(model, **fields), state[first:end]
