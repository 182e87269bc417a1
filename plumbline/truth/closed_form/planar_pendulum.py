"""The planar pendulum, oscillating or rotating, by Jacobi's elliptic functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from plumbline.model.datatypes import HINGE, ROD, Array, Model, State
from plumbline.model.kinematics import quaternion_product, rotation_matrix
from plumbline.truth.closed_form.motion import (
    CONDITION_RTOL,
    ClosedFormMotion,
    inertia_about_pivot,
    require,
    require_gravity_without_loads,
    require_heavy_body_on_ball,
)
from plumbline.truth.elliptic import elliptic_f, jacobi


@dataclass(frozen=True)
class _Pendulum:
    """One body that moves in a plane about a fixed axis."""

    axis: Array  # (3,) unit vector
    centre: Array  # (3,) m, on the axis, of the circle that the centre of mass describes
    arm: Array  # (3,) m, from there to the centre of mass
    moment: float  # kg m² about the axis
    rate: float  # rad/s about the axis
    turns: bool = True  # whether the body turns with the arm


def planar_pendulum(model: Model, state: State) -> ClosedFormMotion:
    """Solve one body that moves in a plane: on a hinge, a ball joint, or a rod at its centre of mass.

    With g the gravity across the axis, Ω² = m g d / I, and the angle from hanging by `half_angle`.

    Args:
        model: one body; on a ball joint its principal axis of rotation is horizontal.

    Raises:
        ClosedFormMismatch: the scenario is not a planar pendulum.

    """
    kind = model.kind[0] if model.n == len(model.kind) == 1 else ""
    pendulum = (_on_hinge if kind == HINGE else _on_rod if kind == ROD else _on_ball)(model, state)
    axis, lever = pendulum.axis, float(np.linalg.norm(pendulum.arm))
    across_axis = model.gravity - (model.gravity @ axis) * axis
    gravity = float(np.linalg.norm(across_axis))
    require(gravity > CONDITION_RTOL * np.linalg.norm(model.gravity), "gravity across the axis")
    down, out = across_axis / gravity, pendulum.arm / lever
    across = np.cross(axis, down)
    theta0 = float(np.arctan2(out @ across, out @ down))
    frequency = float(np.sqrt(model.mass[0] * gravity * lever / pendulum.moment))
    halves = half_angle(frequency, theta0, pendulum.rate)
    sin0, cos0 = np.sin(theta0 / 2), np.cos(theta0 / 2)

    def evaluate(t: Array) -> tuple[Array, Array]:
        half_sin, half_cos = halves(t)
        sin, cos = 2 * half_sin * half_cos, 1 - 2 * half_sin**2  # of θ
        r = pendulum.centre + lever * (cos[:, None] * down + sin[:, None] * across)
        # rotation by θ − θ₀ about the axis, from its half angle
        turn_cos, turn_sin = half_cos * cos0 + half_sin * sin0, half_sin * cos0 - half_cos * sin0
        turn = np.concatenate([turn_cos[:, None], turn_sin[:, None] * axis], 1)
        p = quaternion_product(turn, state.p[0][None]) if pendulum.turns else np.tile(state.p[0], (len(t), 1))
        return r[:, None], p[:, None]

    return ClosedFormMotion(evaluate, "elliptic functions, Whittaker § 44")


def half_angle(frequency: float, theta0: float, rate: float) -> Callable[[Array], tuple[Array, Array]]:
    """Solve θ̈ = −Ω² sin θ.

    With k² = sin² ½θ₀ + θ̇₀²/4Ω²:

        k < 1, oscillation:  sin ½θ = k sn(Ωt + u₀),  θ̇ = 2 k Ω cn
        k > 1, rotation:     ½θ = am(kΩt + u₀ | 1/k²)

    Whittaker, Analytical Dynamics, § 44; DLMF § 22.19(i).

    Args:
        frequency: Ω [rad/s] of small oscillations.
        theta0: angle from hanging at t = 0 [rad].
        rate: its rate at t = 0 [rad/s].

    Returns:
        The function from times (T,) [s] to sin ½θ and cos ½θ, each (T,).

    """
    sin0, cos0, w = np.sin(theta0 / 2), np.cos(theta0 / 2), rate / (2 * frequency)
    k, complement = np.hypot(sin0, w), (cos0 - w) * (cos0 + w)  # 1 − k²
    direction = 1.0 if w >= 0 else -1.0

    def evaluate(t: Array) -> tuple[Array, Array]:
        if complement >= 0:
            start = elliptic_f(np.arctan2(sin0, w), complement)
            sn, _, dn, _ = jacobi(frequency * t + start, complement)
            return k * sn, dn
        m1 = -complement / k**2
        start = elliptic_f(direction * theta0 / 2, m1)
        half_sin, half_cos, _, _ = jacobi(k * frequency * t + start, m1)
        return direction * half_sin, half_cos

    return evaluate


def _on_ball(model: Model, state: State) -> _Pendulum:
    """Check that a body on a ball joint moves in a vertical plane."""
    A, up, _, lever = require_heavy_body_on_ball(model, state)
    s = model.proximal[0]
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
    return _Pendulum(axis, np.zeros(3), -(A @ s), moment, float(state.omega[0] @ body_axis))


def _on_hinge(model: Model, state: State) -> _Pendulum:
    """Take a body on a hinge of any axis: the joint bears what is not about the axis."""
    require_gravity_without_loads(model)
    require(not model.has_elements, "a hinge without rotor, spring, damper and effort")
    A = rotation_matrix(state.p[0])
    axis = rotation_matrix(model.turn[0, 0])[:, 2]
    offset = -(A @ model.proximal[0])
    arm = offset - (offset @ axis) * axis
    require(bool(np.any(arm)), "a lever between the axis and the centre of mass")
    body_axis = A.T @ axis
    moment = float(body_axis @ model.inertia[0] @ body_axis + model.mass[0] * (arm @ arm))
    return _Pendulum(axis, model.point[0, 0] + offset - arm, arm, moment, float(state.xdot[0, 0]))


def _on_rod(model: Model, state: State) -> _Pendulum:
    """Check that a body that does not turn hangs by its centre of mass and moves in a vertical plane."""
    up, _ = require_gravity_without_loads(model)
    require(not (np.any(model.proximal) or np.any(state.omega)), "a rod at the centre of mass, and no spin")
    u, spin = state.u[0], np.cross(state.u[0], state.udot[0])
    rate = float(np.linalg.norm(spin))
    axis = spin if rate > 0 else np.cross(u, -up)
    require(np.linalg.norm(axis) > 0, "an angular velocity or a torque that defines the plane")
    axis = axis / np.linalg.norm(axis)
    require(abs(axis @ up) < CONDITION_RTOL, "a horizontal axis of rotation")
    arm = model.length[0] * u
    moment = float(model.mass[0] * model.length[0] ** 2)
    return _Pendulum(axis, model.point[0, 0], arm, moment, rate, turns=False)
