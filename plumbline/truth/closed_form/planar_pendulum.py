"""The planar physical pendulum, oscillating or rotating, by Jacobi's elliptic functions."""

from __future__ import annotations

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import quaternion_product
from plumbline.truth.closed_form.motion import (
    CONDITION_RTOL,
    ClosedFormMotion,
    inertia_about_pivot,
    require,
    require_heavy_body_on_ball,
)
from plumbline.truth.elliptic import elliptic_f, jacobi


def planar_pendulum(model: Model, state: State) -> ClosedFormMotion:
    """Solve one body on a ball joint that moves in a vertical plane.

    With θ the angle from hanging and Ω² = m g d / I, k² = sin² ½θ₀ + θ̇₀²/4Ω²:

        k < 1, oscillation:  sin ½θ = k sn(Ωt + u₀),  θ̇ = 2 k Ω cn
        k > 1, rotation:     ½θ = am(kΩt + u₀ | 1/k²)

    Whittaker, Analytical Dynamics, § 44; DLMF § 22.19(i).

    Args:
        model: one body whose principal axis of rotation is horizontal.
        state: the initial state.

    Returns:
        The exact motion.

    Raises:
        ClosedFormMismatch: the scenario is not a planar pendulum.

    """
    A, up, gravity, lever = require_heavy_body_on_ball(model, state)
    m, s = model.mass[0], model.proximal[0]
    rate = float(np.linalg.norm(state.omega[0]))
    axis = A @ (state.omega[0] / rate) if rate > 0 else np.cross(A @ s, -up)
    require(np.linalg.norm(axis) > 0, "an angular velocity or a torque that defines the plane")
    axis = axis / np.linalg.norm(axis)
    pivot_inertia = inertia_about_pivot(model)
    body_axis = A.T @ axis
    require(abs(axis @ up) < CONDITION_RTOL, "a horizontal axis of rotation")
    require(abs(body_axis @ s) < CONDITION_RTOL * lever, "a centre of mass in the plane of motion")
    moment = float(body_axis @ pivot_inertia @ body_axis)
    off_axis = np.linalg.norm(pivot_inertia @ body_axis - moment * body_axis)
    require(off_axis < CONDITION_RTOL * moment, "a principal axis of rotation")
    across, down, out = np.cross(up, axis), -up, -(A @ s) / lever
    theta0 = np.arctan2(out @ across, out @ down)
    frequency = np.sqrt(m * gravity * lever / moment)
    rate = float(state.omega[0] @ body_axis)
    sin0, cos0, w = np.sin(theta0 / 2), np.cos(theta0 / 2), rate / (2 * frequency)
    k, complement = np.hypot(sin0, w), (cos0 - w) * (cos0 + w)  # 1 − k²
    direction = 1.0 if w >= 0 else -1.0

    def evaluate(t: Array) -> tuple[Array, Array]:
        if complement >= 0:
            start = elliptic_f(np.arctan2(sin0, w), complement)
            sn, _, dn, _ = jacobi(frequency * t + start, complement)
            half_sin, half_cos = k * sn, dn
        else:
            m1 = -complement / k**2
            start = elliptic_f(direction * theta0 / 2, m1)
            half_sin, half_cos, _, _ = jacobi(k * frequency * t + start, m1)
            half_sin = direction * half_sin
        sin, cos = 2 * half_sin * half_cos, 1 - 2 * half_sin**2  # of θ
        r = lever * (cos[:, None] * down + sin[:, None] * across)
        # rotation by θ − θ₀ about the axis, from its half angle
        turn_cos, turn_sin = half_cos * cos0 + half_sin * sin0, half_sin * cos0 - half_cos * sin0
        turn = np.concatenate([turn_cos[:, None], turn_sin[:, None] * axis], 1)
        return r[:, None], quaternion_product(turn, state.p[0][None])[:, None]

    return ClosedFormMotion(evaluate, "elliptic functions, Whittaker § 44")
