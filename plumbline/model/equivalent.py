"""Other descriptions of the same pendulum, whose answers follow from the answers to the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import (
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    state_from_minimal,
)

WORLD_VECTORS = ("acceleration", "joint_reaction", "angular_momentum")  # state quantities in world axes
BODY_VECTORS = ("angular_acceleration",)  # … in body axes


def rotate_world(model: Model, state: State, q: Array) -> tuple[Model, State]:
    """Rotate everything in world axes: gravity, applied forces, attitudes and rod directions.

    Args:
        model: the pendulum.
        state: a state of it.
        q: (4,) unit quaternion of the rotation, scalar first.

    Returns:
        The rotated pendulum and its state; attitudes are unit quaternions again.

    """
    turn = rotation_matrix(q)
    rotated = replace(model, gravity=turn @ model.gravity, force=model.force @ turn.T)
    p = quaternion_product(q, state.p)
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    return rotated, state_from_minimal(rotated, p, state.omega, state.u @ turn.T, state.udot @ turn.T)


def rotate_body_frames(model: Model, state: State, q: Array) -> tuple[Model, State]:
    """Describe every body in other axes of its own: a body vector x becomes Q x.

    Args:
        model: the pendulum.
        state: a state of it.
        q: (4,) unit quaternion of the rotation Q, scalar first.

    Returns:
        The same pendulum in these axes and its state; attitudes are unit quaternions again.

    """
    turn = rotation_matrix(q)
    inertia = turn @ model.inertia @ turn.T
    rotated = replace(
        model,
        inertia=(inertia + inertia.mT) / 2,
        point=np.where((model.body >= 0)[..., None], model.point @ turn.T, model.point),
        moment=model.moment @ turn.T,
    )
    p = quaternion_product(state.p, quaternion_conjugate(q))
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    return rotated, state_from_minimal(rotated, p, state.omega @ turn.T, state.u, state.udot)


def unrotate(answers: dict[str, Array], vectors: Sequence[str], q: Array) -> dict[str, Array]:
    """Rotate vectors of a rotated pendulum back.

    Args:
        answers: quantities by their names in `StateQuantities`.
        vectors: names of those to rotate: `WORLD_VECTORS` or `BODY_VECTORS`.
        q: (4,) the quaternion that `rotate_world` or `rotate_body_frames` was given.

    Returns:
        The same quantities in the axes of the first description.

    """
    return {name: x @ rotation_matrix(q) if name in vectors else x for name, x in answers.items()}


def first_bodies(model: Model, state: State, count: int) -> tuple[Model, State]:
    """Cut a chain behind some bodies.

    Args:
        model: the pendulum.
        state: a state of it.
        count: number of bodies that remain, from the pivot.

    Returns:
        The shorter pendulum, and the same state of it.

    """
    fields = {name: x if name == "gravity" else x[:count] for name, x in vars(model).items()}
    return replace(model, **fields), State(**{name: x[:count] for name, x in vars(state).items()})
