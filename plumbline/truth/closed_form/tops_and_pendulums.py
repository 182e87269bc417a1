"""Pendulums and tops, by Jacobi's elliptic functions and elliptic integrals.

Jacobi's functions and Legendre's integrals have the complementary parameter m₁ = 1 − m.  SciPy takes m alone,
which loses the digits of 1 − m near a separatrix (a pendulum close to upright, a brick spun about its middle
axis), so they are computed here from the arithmetic-geometric mean and from Carlson's symmetric integrals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from plumbline.model.datatypes import FREE, HINGE, ROD, Array, Model, State
from plumbline.model.kinematics import (
    quaternion_conjugate,
    quaternion_of,
    quaternion_product,
    rotation_matrix,
)
from plumbline.truth.closed_form.motion import (
    CONDITION_RTOL,
    ClosedFormMotion,
    axis_angle_quaternions,
    inertia_about_pivot,
    require,
    require_gravity_without_loads,
    require_heavy_body_on_ball,
    require_no_loads,
    require_single_body,
)

# -- elliptic functions --------------------------------------------------------------------------------


def jacobi(u: Array, m1: float) -> tuple[Array, Array, Array, Array]:
    """Evaluate Jacobi's functions by descending Landen transformations.

    DLMF § 22.20(ii), Abramowitz & Stegun 16.4; for m₁ = 0 the hyperbolic limits of DLMF Table 22.5.4.

    Args:
        u: (T,) arguments.
        m1: complementary parameter 1 − m, 0 ≤ m1 ≤ 1.

    Returns:
        sn, cn, dn and the amplitude am, each (T,).

    """
    u = np.asarray(u, dtype=float)
    if m1 == 0:
        sech = 1 / np.cosh(u)
        return np.tanh(u), sech, sech, 2 * np.arctan(np.tanh(u / 2))
    a, b, c = [1.0], np.sqrt(m1), [np.sqrt(1 - m1)]
    while c[-1] > 1e-9 * a[-1]:  # the next c is c²/4a
        a, b, c = [*a, (a[-1] + b) / 2], np.sqrt(a[-1] * b), [*c, (a[-1] - b) / 2]
    phi = 2.0 ** (len(a) - 1) * a[-1] * u
    for ratio in reversed([cn / an for cn, an in zip(c[1:], a[1:], strict=True)]):
        phi = (phi + np.arcsin(np.clip(ratio * np.sin(phi), -1, 1))) / 2
    sn, cn = np.sin(phi), np.cos(phi)
    return sn, cn, np.sqrt(cn * cn + m1 * sn * sn), phi


def elliptic_f(phi: Array | float, m1: float) -> Array:
    """Evaluate F(φ | m), Legendre's integral of the first kind, by DLMF 19.25.5 and Carlson's R_F.

    Args:
        phi: amplitudes of any shape [rad], of any size.
        m1: complementary parameter 1 − m, 0 ≤ m1 ≤ 1.

    Returns:
        The integral, with the shape of ``phi``.

    """
    half_turns, s, c = _reduce_angle(phi)
    part = s * scipy.special.elliprf(c * c, c * c + m1 * s * s, 1.0)
    return np.asarray(
        part + 2 * half_turns * scipy.special.elliprf(0.0, m1, 1.0) if np.any(half_turns) else part
    )


def elliptic_pi(n: float, phi: Array | float, m1: float) -> Array:
    """Evaluate Π(n; φ | m) = ∫ dφ / ((1 − n sin²φ) √(1 − m sin²φ)) by DLMF 19.25.14.

    Args:
        n: characteristic, n < 1.
        phi: amplitudes of any shape [rad], of any size.
        m1: complementary parameter 1 − m, 0 ≤ m1 ≤ 1.

    Returns:
        The integral, with the shape of ``phi``.

    """
    half_turns, s, c = _reduce_angle(phi)
    part = _elliptic_pi_reduced(n, s, c, m1)
    complete = _elliptic_pi_reduced(n, np.ones(1), np.zeros(1), m1)[0] if np.any(half_turns) else 0.0
    return np.asarray(part + 2 * half_turns * complete)


def _elliptic_pi_reduced(n: float, s: Array, c: Array, m1: float) -> Array:
    """Π from the sine and cosine of an amplitude in [−π/2, π/2]."""
    d, q = c * c + m1 * s * s, c * c + (1 - n) * s * s
    return np.asarray(
        s * scipy.special.elliprf(c * c, d, 1.0) + n / 3 * s**3 * scipy.special.elliprj(c * c, d, 1.0, q)
    )


def _reduce_angle(phi: Array | float) -> tuple[Array, Array, Array]:
    """Number of half turns, and sine and cosine of the remainder in [−π/2, π/2]."""
    phi = np.asarray(phi, dtype=float)
    half_turns = np.round(phi / np.pi)
    sign = np.where(half_turns % 2 == 0, 1.0, -1.0)
    return half_turns, sign * np.sin(phi), np.abs(np.cos(phi))


# -- the planar pendulum, oscillating or rotating ------------------------------------------------------


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
    axis = _horizontal(axis, up)
    pivot_inertia = inertia_about_pivot(model)
    body_axis = A.T @ axis
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
    axis = _horizontal(axis, up)
    arm = model.length[0] * u
    moment = float(model.mass[0] * model.length[0] ** 2)
    return _Pendulum(axis, model.point[0, 0], arm, moment, rate, turns=False)


def _horizontal(axis: Array, up: Array) -> Array:
    """The axis of a plane of motion as a unit vector."""
    require(np.linalg.norm(axis) > 0, "an angular velocity or a torque that defines the plane")
    axis = axis / np.linalg.norm(axis)
    require(bool(abs(axis @ up) < CONDITION_RTOL), "a horizontal axis of rotation")
    return axis


# -- Euler's free top: a rigid body without applied moments --------------------------------------------


X, _, Z = np.eye(3)


def free_top(model: Model, state: State) -> ClosedFormMotion:
    """Solve one body that a ball joint holds at its centre of mass, or a free one that falls.

    Args:
        model: one body, free or with its pivot at the centre of mass.

    Raises:
        ClosedFormMismatch: the scenario is not a free top, or its motion is exactly on the separatrix.

    """
    require_no_loads(model)
    is_free = model.kind == (FREE,)
    if not is_free:
        require_single_body(model, rod=False)
        require(not np.any(model.proximal[0]), "a pivot at the centre of mass")
    attitude = torque_free_attitude(model.inertia[0], state.p[0], state.omega[0])

    def evaluate(t: Array) -> tuple[Array, Array]:
        time = t[:, None, None] * is_free
        return state.r * is_free + time * state.v + time**2 / 2 * model.gravity, attitude(t)[:, None]

    source = "elliptic functions and integrals of the third kind, Landau & Lifshitz, Mechanics, § 37"
    return ClosedFormMotion(evaluate, source)


def torque_free_attitude(inertia: Array, p: Array, omega: Array) -> Callable[[Array], Array]:
    """Solve the rotation of a body without applied moments.  Landau & Lifshitz, Mechanics, § 37.

    Principal moments ordered so that ω circles the third axis: ω₁ = a₁ cn, ω₂ = ±a₂ sn, ω₃ = a₃ dn; the body
    precesses about L by χ̇ = L (I₁ω₁² + I₂ω₂²)/(I₁²ω₁² + I₂²ω₂²), an integral of the third kind.  All
    differences (L² − 2E I…) are formed from the components of ω, so that a spin about the middle axis keeps
    its digits.

    Args:
        inertia: (3, 3) [kg m²] about the centre of mass, body frame.
        p: (4,) initial attitude, body → world.
        omega: (3,) [rad/s] initial angular velocity, body frame.

    Returns:
        The function from times (T,) [s] to attitudes (T, 4).

    Raises:
        ClosedFormMismatch: the motion is exactly on the separatrix.

    """
    moments, axes = np.linalg.eigh(inertia)
    w = axes.T @ omega
    gap = (
        moments[2] * (moments[2] - moments[1]) * w[2] ** 2
        - moments[0] * (moments[1] - moments[0]) * w[0] ** 2
    )
    if gap < 0:  # L² < 2 E I₂: ω circles the axis of least inertia
        moments, axes, gap = moments[::-1], axes[:, ::-1], -gap
    if np.linalg.det(axes) < 0:
        axes = -axes
    (I1, I2, I3), w = moments, axes.T @ omega
    L = np.linalg.norm(moments * w)
    D = I1 * (I3 - I1) * w[0] ** 2 + I2 * (I3 - I2) * w[1] ** 2  # 2 E I₃ − L²
    B = I2 * (I2 - I1) * w[1] ** 2 + I3 * (I3 - I1) * w[2] ** 2  # L² − 2 E I₁
    if D == 0 or B == 0 or np.count_nonzero(w) < 2:  # about one principal axis, or a sphere
        rate = np.linalg.norm(omega)
        axis = omega / rate if rate else Z
        return lambda t: quaternion_product(
            np.broadcast_to(p, (len(t), 4)), axis_angle_quaternions(axis, rate * t)
        )
    require(gap > 0, "a motion that is not exactly on the separatrix")
    sign = np.copysign(1.0, w[2]) * np.sign(I3 - I1)
    a1, a2 = np.sqrt(D / (I1 * (I3 - I1))), np.sqrt(D / (I2 * (I3 - I2)))
    a3 = np.copysign(np.sqrt(B / (I3 * (I3 - I1))), w[2])
    speed = np.sqrt((I3 - I2) * B / (I1 * I2 * I3))
    m1 = min(1.0, abs(I3 - I1) * gap / ((I3 - I2) * B))
    start = np.arctan2(sign * w[1] / a2, w[0] / a1)
    tau0, n = float(elliptic_f(start, m1)), I3 * (I1 - I2) / (I1 * (I3 - I2))

    def momentum_to_z(w1: Array, w2: Array, w3: Array) -> Array:
        """Rx(θ) Rz(ψ), which rotates the body-frame direction of L into z."""
        theta = np.arctan2(np.hypot(I1 * w1, I2 * w2), I3 * w3)
        return quaternion_product(
            axis_angle_quaternions(X, theta), axis_angle_quaternions(Z, np.arctan2(I1 * w1, I2 * w2))
        )

    principal = quaternion_of(axes)
    at_start = momentum_to_z(*(np.atleast_1d(x) for x in w))[0]
    base = quaternion_product(quaternion_product(p, principal), quaternion_conjugate(at_start))

    def evaluate(t: Array) -> Array:
        sn, cn, dn, am = jacobi(speed * t + tau0, m1)
        integral = elliptic_pi(n, am, m1) - elliptic_pi(n, start, m1)
        chi = L * t / I3 + L * (I3 - I1) / (I1 * I3 * speed) * integral
        turned = quaternion_product(
            axis_angle_quaternions(Z, chi), momentum_to_z(a1 * cn, sign * a2 * sn, a3 * dn)
        )
        return quaternion_product(
            quaternion_product(np.broadcast_to(base, (len(t), 4)), turned), quaternion_conjugate(principal)
        )

    return evaluate


# -- Lagrange's top and the spherical pendulum ---------------------------------------------------------


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
