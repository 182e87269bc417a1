"""Motions that keep their shape: equilibria, and rotations of the whole chain about the vertical."""

from __future__ import annotations

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import quaternion_product, rotate_vectors, rotation_matrix
from plumbline.truth.closed_form.motion import (
    CONDITION_RTOL,
    ClosedFormMotion,
    axis_angle_quaternions,
    require,
    require_gravity_without_loads,
    require_no_loads,
)


def steady_rotation(model: Model, state: State) -> ClosedFormMotion:
    """Solve a relative equilibrium: the chain rotates about the vertical as if it were rigid.

    Args:
        model: a chain of any length, moved by gravity alone.
        state: all angular velocities vertical and equal, forces balanced in the rotating frame.

    Raises:
        ClosedFormMismatch: the state is not a relative equilibrium.

    """
    up, _ = require_gravity_without_loads(model)
    omega = rotate_vectors(rotation_matrix(state.p), state.omega)
    rate = float(omega[0] @ up)
    tolerance = CONDITION_RTOL * (abs(rate) or 1.0)
    require(np.max(np.abs(omega - rate * up)) < tolerance, "the same vertical angular velocity in all bodies")
    rigid_udot = np.where(model.rods[:, None], rate * np.cross(up, state.u), 0.0)
    require(np.max(np.abs(state.udot - rigid_udot)) < tolerance, "rods that rotate with the bodies")
    require(
        _relative_imbalance(model, state, rate * up) < CONDITION_RTOL,
        "forces and moments that balance in the rotating frame",
    )

    def evaluate(t: Array) -> tuple[Array, Array]:
        turn = axis_angle_quaternions(up, rate * t)
        r = np.einsum("tij,nj->tni", rotation_matrix(turn), state.r)
        return r, quaternion_product(turn[:, None], state.p[None])

    return ClosedFormMotion(evaluate, "relative equilibrium: a rigid rotation about the vertical")


def equilibrium(model: Model, state: State) -> ClosedFormMotion:
    """Solve a chain at rest.

    Args:
        model: a chain of any length without loads.
        state: no velocity, forces and moments balanced.

    Raises:
        ClosedFormMismatch: the state moves or is not balanced.

    """
    require(not (np.any(state.omega) or np.any(state.udot)), "no velocity")
    require_no_loads(model)
    require(
        _relative_imbalance(model, state, np.zeros(3)) < CONDITION_RTOL, "forces and moments that balance"
    )

    def evaluate(t: Array) -> tuple[Array, Array]:
        return np.repeat(state.r[None], len(t), 0), np.repeat(state.p[None], len(t), 0)

    return ClosedFormMotion(evaluate, "equilibrium")


def _relative_imbalance(model: Model, state: State, spin: Array) -> float:
    """Largest unbalanced force or moment, relative to its terms, in a frame rotating at ``spin`` [rad/s]."""
    A = rotation_matrix(state.p)
    near, far = (rotate_vectors(A, s) for s in (model.proximal, model.distal))
    inertia = A @ model.inertia @ A.mT
    worst, force_below = 0.0, np.zeros(3)
    for k in reversed(range(model.n)):
        acceleration = np.cross(spin, np.cross(spin, state.r[k]))
        force = model.mass[k] * (acceleration - model.gravity) + force_below
        gyroscopic = np.cross(spin, inertia[k] @ spin)
        moment = np.cross(near[k], force) - np.cross(far[k], force_below) - gyroscopic
        size = sum(
            np.linalg.norm(s) * np.linalg.norm(f) for s, f in ((near[k], force), (far[k], force_below))
        ) + np.linalg.norm(gyroscopic)
        worst = max(worst, float(np.linalg.norm(moment) / size) if size else 0.0)
        if model.rods[k]:
            sine = np.linalg.norm(np.cross(state.u[k], force)) / np.linalg.norm(force)
            worst = max(worst, float(sine) if state.u[k] @ force < 0 else np.inf)
        force_below = force
    return worst
