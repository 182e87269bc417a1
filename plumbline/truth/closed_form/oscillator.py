"""The damped linear oscillator: a body on a slide, or on a hinge where gravity has no moment."""

from __future__ import annotations

import numpy as np
import scipy

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import quaternion_product, rotate_vectors, rotation_matrix
from plumbline.truth.closed_form.motion import (
    CONDITION_RTOL,
    ClosedFormMotion,
    axis_angle_quaternions,
    require,
    require_no_loads,
)


def damped_oscillator(model: Model, state: State) -> ClosedFormMotion:
    """Solve (m + a) ẍ + c ẋ + k (x − x₀) = f on a slide; on a hinge with moments of inertia and moments.

    Of the rotor a, damper c, spring k, effort and the constant part f of gravity any may be zero.

    Args:
        model: one body on a slide or hinge at the world.

    Raises:
        ClosedFormMismatch: the scenario is not a linear oscillator.

    """
    kinds = model.kinds
    require(len(kinds) == 1 and len(kinds[0].rows) == 5, "one body on a slide or a hinge")
    require_no_loads(model)
    require(not len(model.spring_body), "no springs between points")
    axis = rotation_matrix(model.turn[0, 0])[:, 2]
    A = rotation_matrix(state.p[0])
    arm = -(A @ model.proximal[0])  # from the joint's near point to the centre of mass
    mass, slides = float(model.mass[0]), bool(kinds[0].slide_axes)
    across = arm - (arm @ axis) * axis
    weight_across = np.linalg.norm(np.cross(model.gravity, axis))
    size = np.linalg.norm(arm) * np.linalg.norm(model.gravity)
    is_balanced = np.linalg.norm(across) * weight_across <= CONDITION_RTOL * size
    require(slides or bool(is_balanced), "a hinge about which gravity has no moment at any angle")
    body_axis = A.T @ axis
    own = mass if slides else float(body_axis @ model.inertia[0] @ body_axis + mass * (across @ across))
    inertia = own + float(model.armature[0, 0])
    k, c = float(model.stiffness[0, 0]), float(model.damping[0, 0])
    force = float(model.effort[0, 0]) + k * float(model.rest[0, 0])
    force += mass * float(model.gravity @ axis) if slides else 0.0
    # d/dt (x, ẋ, 1) is linear
    system = np.array([[0, 1, 0], [-k / inertia, -c / inertia, force / inertia], [0, 0, 0]])
    start = np.array([state.x[0, 0], state.xdot[0, 0], 1.0])

    def evaluate(t: Array) -> tuple[Array, Array]:
        moved = (scipy.linalg.expm(system * t[:, None, None]) @ start)[:, 0] - start[0]
        if slides:
            return state.r + moved[:, None, None] * axis, np.tile(state.p, (len(t), 1, 1))
        turn = axis_angle_quaternions(axis, moved)
        r = state.r[0] - arm + rotate_vectors(rotation_matrix(turn), arm)
        return r[:, None], quaternion_product(turn, state.p[0][None])[:, None]

    return ClosedFormMotion(evaluate, "exponential of the linear oscillator's matrix")
