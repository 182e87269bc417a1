"""Other descriptions of the same mechanism, whose answers follow from the answers to the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plumbline.model.datatypes import BODY_FIELDS, JOINT_FIELDS, Array, Float, Indices, Int, Model, State
from plumbline.model.kinematics import (
    complete_state,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
)

WORLD_VECTORS = (
    "acceleration",
    "joint_reaction",
    "joint_moment",
    "angular_momentum",
)  # state quantities in world axes
BODY_VECTORS = ("angular_acceleration",)  # … in body axes


def rotate_world(model: Model, state: State, q: Float[Array, "4"]) -> tuple[Model, State]:
    """Rotate everything in world axes: gravity, applied forces, attitudes and rod directions.

    Args:
        q: unit quaternion of the rotation, scalar first.

    Returns:
        The rotated mechanism and its state; attitudes are unit quaternions again.

    """
    turn = rotation_matrix(q)
    fixed, spring_end = model.body < 0, model.spring_body < 0
    rotated = replace(
        model,
        gravity=turn @ model.gravity,
        force=model.force @ turn.T,
        point=np.where(fixed[..., None], model.point @ turn.T, model.point),
        turn=np.where(fixed[..., None], _normalised(quaternion_product(q, model.turn)), model.turn),
        spring_point=np.where(spring_end[..., None], model.spring_point @ turn.T, model.spring_point),
    )
    vectors = {name: getattr(state, name) @ turn.T for name in ("u", "udot", "r", "v")}
    p = _normalised(quaternion_product(q, state.p))
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
    moving, spring_end = model.body >= 0, model.spring_body >= 0
    rotated = replace(
        model,
        inertia=(inertia + inertia.mT) / 2,
        point=np.where(moving[..., None], model.point @ turn.T, model.point),
        turn=np.where(moving[..., None], _normalised(quaternion_product(q, model.turn)), model.turn),
        moment=model.moment @ turn.T,
        spring_point=np.where(spring_end[..., None], model.spring_point @ turn.T, model.spring_point),
    )
    p = _normalised(quaternion_product(state.p, quaternion_conjugate(q)))
    return rotated, complete_state(rotated, replace(state, p=p, omega=state.omega @ turn.T))


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


def _normalised(q: Array) -> Array:
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def siblings_reversed(model: Model) -> Int[Indices, "bodies"]:
    """Order the bodies depth first with the branches on every body, and on the world, in reverse.

    Returns:
        The bodies in the new order; ascending where no two joints have the same far body.

    """
    order: list[int] = []
    far = model.body[: model.n, 0]
    waiting = np.flatnonzero(far < 0).tolist()
    while waiting:
        order.append(waiting.pop())
        waiting += np.flatnonzero(far == order[-1]).tolist()
    return np.array(order, np.intp)


def reorder_bodies(model: Model, state: State, order: Int[Indices, "bodies"]) -> tuple[Model, State]:
    """Number the bodies and joints in another order.

    Args:
        order: the bodies in the new order, each behind its far body.

    """
    place = np.append(np.argsort(order), -1)  # the world is −1 in both
    joints = np.append(order, np.arange(model.n, len(model.kind)))  # those that close loops stay
    fields = {name: getattr(model, name)[order] for name in ("mass", "inertia", *BODY_FIELDS)}
    fields |= {name: getattr(model, name)[joints] for name in JOINT_FIELDS if name not in ("kind", "body")}
    kind = tuple(model.kind[k] for k in joints)
    spring_body = place[model.spring_body]
    reordered = replace(model, kind=kind, body=place[model.body[joints]], spring_body=spring_body, **fields)
    return reordered, State(**{name: x[order] for name, x in vars(state).items()})


def first_bodies(model: Model, state: State, count: int) -> tuple[Model, State]:
    """Cut a chain behind some bodies.

    Args:
        count: number of bodies that remain, from the pivot.

    Returns:
        The shorter pendulum, and the same state of it.

    """
    fields = {name: x if name == "gravity" else x[:count] for name, x in vars(model).items()}
    return replace(model, **fields), State(**{name: x[:count] for name, x in vars(state).items()})
