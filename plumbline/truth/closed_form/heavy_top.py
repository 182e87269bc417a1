"""Lagrange's top and the spherical pendulum, by elliptic integrals of the third kind."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import quaternion_product, rotation_matrix
from plumbline.truth.closed_form.free_top import torque_free_attitude
from plumbline.truth.closed_form.motion import (
    CONDITION_RTOL,
    ClosedFormMotion,
    axis_angle_quaternions,
    inertia_about_pivot,
    require,
    require_gravity_without_loads,
    require_heavy_body_on_ball,
    require_single_body,
)
from plumbline.truth.elliptic import elliptic_f, elliptic_pi, jacobi

MIN_POLE_DISTANCE = 1e-6  # of u = cos θ from ±1 and of the roots of f: nearer, the azimuth has no digits


def lagrange_top(model: Model, state: State) -> ClosedFormMotion:
    """Solve a heavy symmetric body on a ball joint, the pivot on its axis.  Whittaker § 71.

    Args:
        model: one body whose inertia about the pivot is symmetric about the axis to the pivot.

    Raises:
        ClosedFormMismatch: the scenario is not a Lagrange top, or its axis reaches the vertical.

    """
    A, up, gravity, lever = require_heavy_body_on_ball(model, state)
    c = -model.proximal[0] / lever
    inertia = inertia_about_pivot(model)
    axial = float(c @ inertia @ c)
    transverse = float((np.trace(inertia) - axial) / 2)
    asymmetry = inertia - (transverse * np.eye(3) + (axial - transverse) * np.outer(c, c))
    require(
        np.max(np.abs(asymmetry)) < CONDITION_RTOL * transverse,
        "inertia symmetric about the axis to the pivot",
    )
    beta = 2 * model.mass[0] * gravity * lever / transverse
    attitude_and_axis = _symmetric_top_motion(
        up, A @ c, A @ state.omega[0], axial / transverse, beta, state.p[0], c
    )

    def evaluate(t: Array) -> tuple[Array, Array]:
        p, axis = attitude_and_axis(t)
        return lever * axis[:, None], p[:, None]

    return ClosedFormMotion(evaluate, "elliptic functions and integrals of the third kind, Whittaker § 71")


def spherical_pendulum(model: Model, state: State) -> ClosedFormMotion:
    """Solve a symmetric body without axial spin on a ball joint, or a body on a rod at its centre of mass.

    The second is a point on a sphere of the rod's length, and a free top about that point.  Whittaker § 55.

    Args:
        model: one body, on either joint.

    Raises:
        ClosedFormMismatch: the scenario is not a spherical pendulum, or it reaches the vertical.

    """
    if not model.rods[0]:
        axis = model.proximal[0]
        spin = abs(float(axis @ state.omega[0]))
        require(
            spin <= CONDITION_RTOL * np.linalg.norm(axis) * np.linalg.norm(state.omega[0]),
            "no spin about the axis to the pivot (else it is a lagrange-top)",
        )
        return lagrange_top(model, state)
    up, gravity = require_gravity_without_loads(model)
    require_single_body(model, rod=True)
    require(not np.any(model.proximal[0]), "a rod attached at the centre of mass")
    ell, u = float(model.length[0]), state.u[0]
    identity = np.array([1.0, 0, 0, 0])
    point = _symmetric_top_motion(up, u, np.cross(u, state.udot[0]), 0.0, 2 * gravity / ell, identity, u)
    attitude = torque_free_attitude(model.inertia[0], state.p[0], state.omega[0])

    def evaluate(t: Array) -> tuple[Array, Array]:
        return ell * point(t)[1][:, None], attitude(t)[:, None]

    return ClosedFormMotion(evaluate, "elliptic functions and integrals of the third kind, Whittaker § 55")


def _symmetric_top_motion(
    up: Array, c: Array, omega: Array, ratio: float, beta: float, p: Array, body_c: Array
) -> Callable[[Array], tuple[Array, Array]]:
    """Motion of a heavy symmetric top: times (T,) → p (T, 4), axis (T, 3) in the world frame.

    ``c`` and ``omega`` at t = 0 in the world frame, ``body_c`` the axis in the body frame, ``ratio`` =
    I_axial / I_transverse about the pivot, ``beta`` = 2 m g d / I_transverse.
    With u = c·ẑ, a = ratio·ω·c and b = (ω − (ω·c)c)·ẑ + a u,

        u̇² = f(u) = β (u − u₁)(u − u₂)(u − u₃),     u = u₁ + (u₂ − u₁) sn²(λt + τ₀),   λ = ½ √(β(u₃ − u₁))
        φ̇ = (b − a u)/(1 − u²),                      ψ̇ = ω·c − φ̇ u

    Whittaker § 71.  f is expanded about u(0), where f and f′ follow from the state without cancellation, so
    that steady precession, a double root, keeps its digits.
    """
    u0, spin = float(c @ up), float(omega @ c)
    across = omega - spin * c
    q0, w2, a = float(across @ up), float(across @ across), ratio * spin
    udot = float(np.cross(omega, c) @ up)
    x1, x2, x3 = _cubic_roots(
        beta, 2 * beta * u0 - w2 - a**2, -beta * (1 - u0**2) - 2 * u0 * w2 + 2 * a * q0, udot**2
    )
    u1, u2 = u0 + x1, u0 + x2
    require(
        1 + u1 > MIN_POLE_DISTANCE and 1 - u2 > MIN_POLE_DISTANCE,
        "an axis that never points straight up or down",
    )
    m1 = (x3 - x2) / (x3 - x1)
    speed = np.sqrt(beta * (x3 - x1)) / 2
    start = np.arctan2(np.sqrt(max(-x1, 0.0)), np.copysign(np.sqrt(max(x2, 0.0)), udot))
    tau0 = float(elliptic_f(start, m1))
    minus, plus = q0 + a * u0 - a, q0 + a * u0 + a  # b − a, b + a
    n_minus, n_plus = (x2 - x1) / (1 - u1), -(x2 - x1) / (1 + u1)
    node = np.cross(up, c)
    sin_theta0 = np.linalg.norm(node)
    theta0, node = np.arctan2(sin_theta0, u0), node / sin_theta0

    def evaluate(t: Array) -> tuple[Array, Array]:
        sn, _, _, am = jacobi(speed * t + tau0, m1)
        u = u1 + (x2 - x1) * sn**2

        def azimuth(numerator: float, pole_distance: float, n: float) -> Array:
            """½ ∫ numerator/(pole distance of u) dt."""
            integral = elliptic_pi(n, am, m1) - elliptic_pi(n, start, m1)
            return np.asarray(numerator / pole_distance * integral / (2 * speed))

        about_top, about_bottom = azimuth(minus, 1 - u1, n_minus), azimuth(plus, 1 + u1, n_plus)
        phi, psi = about_top + about_bottom, (spin - a) * t - (about_top - about_bottom)
        theta = np.arctan2(np.sqrt((1 - u) * (1 + u)), u)
        turn = quaternion_product(
            axis_angle_quaternions(up, phi), axis_angle_quaternions(node, theta - theta0)
        )
        axis = (rotation_matrix(turn) @ c[:, None])[..., 0]
        attitude = quaternion_product(turn, np.broadcast_to(p, (len(t), 4)))
        return quaternion_product(attitude, axis_angle_quaternions(body_c, psi)), axis

    return evaluate


def _cubic_roots(c3: float, c2: float, c1: float, c0: float) -> tuple[float, float, float]:
    """Real roots x₁ ≤ 0 ≤ x₂ < x₃ of c₃x³ + c₂x² + c₁x + c₀, c₀ ≥ 0; x₁ and x₂ by Vieta's formulas."""
    x3 = float(np.max(np.real(np.roots([c3, c2, c1, c0]))))
    for _ in range(3):  # Newton's method on the simple root
        slope = (3 * c3 * x3 + 2 * c2) * x3 + c1
        x3 -= (((c3 * x3 + c2) * x3 + c1) * x3 + c0) / slope if slope else 0.0
    require(x3 > MIN_POLE_DISTANCE, "an axis that stays away from straight up")
    product = -c0 / (c3 * x3)  # x1 x2 ≤ 0
    negated_sum = (product - c1 / c3) / x3  # −(x1 + x2)
    root = np.sqrt(negated_sum**2 - 4 * product)
    larger = -(negated_sum + np.copysign(root, negated_sum)) / 2
    smaller = product / larger if larger else 0.0
    return min(larger, smaller), max(larger, smaller), x3
