"""Closed-form motions: independent of every engine and of the notes' equations.

`solution` picks one by the scenario's ``exact`` and checks first that the scenario really is that motion.
Notation: ẑ is up (against gravity), c the body axis from the pivot to the centre of mass, quaternions
scalar first and body → world.  At 2 s they are right to 3e-15 m and 2e-14 rad over the catalogue; an
axis that passes straight up or down within an angle δ costs a factor 1/δ² in its azimuth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import eigh

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import quaternion_product, rotation_matrix
from plumbline.processes.errors import PlumblineError
from plumbline.truth.elliptic import elliptic_f, elliptic_pi, jacobi

CONDITION_RTOL = 1e-12  # relative: what a rounded input may miss a condition by


class ClosedFormMismatch(PlumblineError, ValueError):
    """The scenario does not satisfy what its closed form presupposes; the message says which condition."""


class ClosedFormScenario(Protocol):
    """What of a scenario is needed here."""

    @property
    def closed_form(self) -> str | None:
        """A key of `SOLUTIONS`, or None."""

    @property
    def model(self) -> Model:
        """The pendulum."""

    @property
    def state(self) -> State:
        """Where it starts."""


@dataclass(frozen=True)
class ClosedFormMotion:
    """A closed-form motion: ``motion(times)`` gives r (T, N, 3) m and p (T, N, 4).

    ``amplitude`` is 0 for an exact solution; for one of small oscillations it is the largest angle (rad),
    and the relative error is of the size of its square, growing with time as its frequencies drift.
    """

    evaluate: Callable[[Array], tuple[Array, Array]]
    source: str
    amplitude: float = 0.0

    def __call__(self, times: Array) -> tuple[Array, Array]:
        """Positions r and attitudes p at ``times`` (T,) s from the initial state."""
        return self.evaluate(np.atleast_1d(np.asarray(times, dtype=float)))


def closed_form_motion(scenario: ClosedFormScenario) -> ClosedFormMotion | None:
    """The closed form that the scenario names, None where it names none; raises NotThatMotion."""
    if scenario.closed_form is None:
        return None
    return CLOSED_FORMS[scenario.closed_form](scenario.model, scenario.state)


def planar_pendulum(model: Model, state: State) -> ClosedFormMotion:
    """One body on a ball joint, swinging or turning in a vertical plane.

    θ from hanging, Ω² = m g d / I: sin ½θ = k sn(Ωt + u₀), θ̇ = 2kΩ cn for k < 1; ½θ = am(kΩt + u₀ | 1/k²)
    for k > 1; k² = sin² ½θ₀ + θ̇₀²/4Ω².  Whittaker, Analytical Dynamics, § 44.
    """
    A, up, g = _require_single_body(model, state, rod=False)
    m, s, d = model.mass[0], model.proximal[0], np.linalg.norm(model.proximal[0])
    _require(g > 0 and d > 0, "gravity and a lever between pivot and centre of mass")
    rate = float(np.linalg.norm(state.omega[0]))
    axis = A @ (state.omega[0] / rate) if rate > 0 else np.cross(A @ s, -up)
    _require(np.linalg.norm(axis) > 0, "a rate or a torque that shows the plane")
    axis = axis / np.linalg.norm(axis)
    inertia = _inertia_about_pivot(model)
    body_axis = A.T @ axis
    _require(abs(axis @ up) < CONDITION_RTOL, "a horizontal axis of rotation")
    _require(abs(body_axis @ s) < CONDITION_RTOL * d, "a centre of mass in the plane of motion")
    I = float(body_axis @ inertia @ body_axis)  # noqa: E741
    _require(
        np.linalg.norm(inertia @ body_axis - I * body_axis) < CONDITION_RTOL * I,
        "a principal axis of rotation",
    )
    across, down, out = np.cross(up, axis), -up, -(A @ s) / d
    theta0 = np.arctan2(out @ across, out @ down)
    own = np.sqrt(m * g * d / I)
    rate = float(state.omega[0] @ body_axis)
    s0, c0, w = np.sin(theta0 / 2), np.cos(theta0 / 2), rate / (2 * own)
    k, complement = np.hypot(s0, w), (c0 - w) * (c0 + w)  # 1 − k²
    way = 1.0 if w >= 0 else -1.0

    def path(t: Array) -> tuple[Array, Array]:
        if complement >= 0:
            start = elliptic_f(np.arctan2(s0, w), complement)
            sn, _, dn, _ = jacobi(own * t + start, complement)
            half_sin, half_cos = k * sn, dn
        else:
            m1 = -complement / k**2
            half_sin, half_cos, _, _ = jacobi(k * own * t + elliptic_f(way * theta0 / 2, m1), m1)
            half_sin = way * half_sin
        # r along θ, and the turn by θ − θ₀ about the axis from its half angle
        sin, cos = 2 * half_sin * half_cos, 1 - 2 * half_sin**2
        r = d * (cos[:, None] * down + sin[:, None] * across)
        turn_cos, turn_sin = half_cos * c0 + half_sin * s0, half_sin * c0 - half_cos * s0
        turn = np.concatenate([turn_cos[:, None], turn_sin[:, None] * axis], 1)
        return r[:, None], quaternion_product(turn, state.p[0][None])[:, None]

    return ClosedFormMotion(path, "elliptic functions, Whittaker § 44")


def lagrange_top(model: Model, state: State) -> ClosedFormMotion:
    """A heavy symmetric body on a ball joint, pivot on its axis.  See `_axis_motion`."""
    A, up, g = _require_single_body(model, state, rod=False)
    d = float(np.linalg.norm(model.proximal[0]))
    _require(g > 0 and d > 0, "gravity and a lever between pivot and centre of mass")
    c = -model.proximal[0] / d
    inertia = _inertia_about_pivot(model)
    axial = float(c @ inertia @ c)
    transverse = float((np.trace(inertia) - axial) / 2)
    symmetric = transverse * np.eye(3) + (axial - transverse) * np.outer(c, c)
    _require(
        np.max(np.abs(inertia - symmetric)) < CONDITION_RTOL * transverse,
        "inertia symmetric about the axis to the pivot",
    )
    omega = A @ state.omega[0]
    turn = _symmetric_top_motion(
        up, A @ c, omega, axial / transverse, 2 * model.mass[0] * g * d / transverse, state.p[0], c
    )

    def path(t: Array) -> tuple[Array, Array]:
        p, axis = turn(t)
        return d * axis[:, None], p[:, None]

    return ClosedFormMotion(path, "elliptic functions and integrals of the third kind, Whittaker § 71")


def spherical_pendulum(model: Model, state: State) -> ClosedFormMotion:
    """A symmetric body on a ball joint without spin about its axis, or a body hung at its centre of mass.

    The second is a point on a sphere of the rod's length, and a free top about that point.
    """
    if not model.rods[0]:
        axis = model.proximal[0]
        spin = abs(float(axis @ state.omega[0]))
        _require(
            spin <= CONDITION_RTOL * np.linalg.norm(axis) * np.linalg.norm(state.omega[0]),
            "no spin about the axis to the pivot (else it is a lagrange-top)",
        )
        return lagrange_top(model, state)
    _, up, g = _require_single_body(model, state, rod=True)
    _require(g > 0 and not np.any(model.proximal[0]), "gravity, and a rod attached at the centre of mass")
    ell, u = float(model.length[0]), state.u[0]
    point = _symmetric_top_motion(
        up, u, np.cross(u, state.udot[0]), 0.0, 2 * g / ell, np.array([1.0, 0, 0, 0]), u
    )
    body = _torque_free_attitude(model.inertia[0], state.p[0], state.omega[0])

    def path(t: Array) -> tuple[Array, Array]:
        return ell * point(t)[1][:, None], body(t)[:, None]

    return ClosedFormMotion(path, "elliptic functions and integrals of the third kind, Whittaker § 55")


def free_top(model: Model, state: State) -> ClosedFormMotion:
    """Euler's top: one body held at its centre of mass by a ball joint.  See `_free`."""
    _require_single_body(model, state, rod=False)
    _require(not np.any(model.proximal[0]), "a pivot at the centre of mass")
    body = _torque_free_attitude(model.inertia[0], state.p[0], state.omega[0])

    def path(t: Array) -> tuple[Array, Array]:
        return np.zeros((len(t), 1, 3)), body(t)[:, None]

    return ClosedFormMotion(
        path, "elliptic functions and integrals of the third kind, Landau & Lifshitz, Mechanics, § 37"
    )


def steady_rotation(model: Model, state: State) -> ClosedFormMotion:
    """Relative equilibrium: every body and rod turns about the vertical at one rate, as if rigid."""
    _require_no_loads(model)
    _require(np.any(model.gravity), "gravity")
    up = -model.gravity / np.linalg.norm(model.gravity)
    A = rotation_matrix(state.p)
    omega = (A @ state.omega[..., None])[..., 0]
    rate = float(omega[0] @ up)
    size = abs(rate) or 1.0
    _require(
        np.max(np.abs(omega - rate * up)) < CONDITION_RTOL * size,
        "the same vertical angular velocity in all bodies",
    )
    carried = np.where(model.rods[:, None], rate * np.cross(up, state.u), 0.0)
    _require(np.max(np.abs(state.udot - carried)) < CONDITION_RTOL * size, "rods that turn with the bodies")
    _require(
        _relative_imbalance(model, state, rate * up) < CONDITION_RTOL,
        "forces and moments that balance in the turning frame",
    )

    def path(t: Array) -> tuple[Array, Array]:
        half = rate * t / 2
        turn = np.concatenate([np.cos(half)[:, None], np.sin(half)[:, None] * up], 1)
        return np.einsum("tij,nj->tni", rotation_matrix(turn), state.r), quaternion_product(
            turn[:, None], state.p[None]
        )

    return ClosedFormMotion(path, "relative equilibrium: a rigid turn about the vertical")


def equilibrium(model: Model, state: State) -> ClosedFormMotion:
    """Everything hangs still."""
    _require(not (np.any(state.omega) or np.any(state.udot)), "no velocity")
    _require_no_loads(model)
    _require(
        _relative_imbalance(model, state, np.zeros(3)) < CONDITION_RTOL, "forces and moments that balance"
    )

    def path(t: Array) -> tuple[Array, Array]:
        return np.repeat(state.r[None], len(t), 0), np.repeat(state.p[None], len(t), 0)

    return ClosedFormMotion(path, "equilibrium")


def small_oscillation(model: Model, state: State) -> ClosedFormMotion:
    """Planar small oscillations about hanging, of any chain whose joints lie on the bodies' axes.

    M θ̈ + K θ = 0 in the angles of bodies and rods, solved by its normal modes (Rayleigh, Theory of
    Sound, § 62 for the chain).  Asymptotic: exact in the limit of zero amplitude.
    """
    _require_no_loads(model)
    n, g = model.n, float(np.linalg.norm(model.gravity))
    _require(g > 0, "gravity")
    up, A = -model.gravity / g, rotation_matrix(state.p)
    near, far = np.linalg.norm(model.proximal, axis=1), np.linalg.norm(model.distal, axis=1)
    far[-1] = 0.0
    _require(np.all(near > 0), "a lever between each joint and the centre of mass")
    c = model.proximal / near[:, None]  # up the body when it hangs
    aligned = np.max(np.abs(model.distal[:-1] + far[:-1, None] * c[:-1]), initial=0.0)
    _require(
        aligned < CONDITION_RTOL * np.max(near), "joints on one axis through the centre of mass of each body"
    )
    out = (A @ c[..., None])[..., 0]
    omega = (A @ state.omega[..., None])[..., 0]
    tilts = np.concatenate([np.cross(up, out), omega, np.cross(state.u, up), np.cross(state.u, state.udot)])
    axis = tilts[np.argmax(np.linalg.norm(tilts, axis=1))]
    _require(np.any(axis), "some motion")
    axis = axis / np.linalg.norm(axis)
    _require(np.max(np.abs(tilts - np.outer(tilts @ axis, axis))) < CONDITION_RTOL, "one plane of motion")
    _require(abs(axis @ up) < CONDITION_RTOL, "a vertical plane of motion")
    body_axis = A.mT @ axis
    J = np.einsum("ki,kij,kj->k", body_axis, model.inertia, body_axis)
    off = (model.inertia @ body_axis[..., None])[..., 0] - J[:, None] * body_axis
    _require(np.max(np.abs(off)) < CONDITION_RTOL * np.max(J), "a principal axis of rotation in every body")

    across = np.cross(axis, up)
    rods = np.flatnonzero(model.rods)
    angle = np.concatenate([_angles_from_up(-state.u[rods], up, across), _angles_from_up(out, up, across)])
    rate = np.concatenate([np.cross(state.u, state.udot)[rods] @ axis, omega @ axis])
    # displacement of centre b to first order: minus Σ lever_bi θ_i
    lever = np.zeros((n, len(rods) + n))
    for b in range(n):
        lever[b, : len(rods)] = np.where(rods <= b, model.length[rods], 0.0)
        lever[b, len(rods) : len(rods) + b] = near[:b] + far[:b]
        lever[b, len(rods) + b] = near[b]
    M = lever.T @ (model.mass[:, None] * lever) + np.diag(np.concatenate([np.zeros(len(rods)), J]))
    K = np.diag(g * (model.mass @ lever))
    squared, modes = eigh(K, M)
    own = np.sqrt(squared)
    at, speed = modes.T @ M @ angle, modes.T @ M @ rate / own

    def path(t: Array) -> tuple[Array, Array]:
        phase = np.outer(t, own)
        theta = (np.cos(phase) * at + np.sin(phase) * speed) @ modes.T  # (T, rods + N)
        tip, r = np.zeros((len(t), 3)), np.empty((len(t), n, 3))
        up_of = np.cos(theta)[..., None] * up + np.sin(theta)[..., None] * across  # unit vectors, exactly
        for k in range(n):
            if model.rods[k]:
                tip = tip - model.length[k] * up_of[:, np.searchsorted(rods, k)]
            r[:, k] = tip - near[k] * up_of[:, len(rods) + k]
            tip = r[:, k] - far[k] * up_of[:, len(rods) + k]
        half = (theta - angle)[:, len(rods) :] / 2
        turn = np.concatenate([np.cos(half)[..., None], np.sin(half)[..., None] * axis], -1)
        return r, quaternion_product(turn, np.broadcast_to(state.p, (len(t), n, 4)))

    amplitude = float(np.max(np.abs(modes) @ np.hypot(at, speed)))
    return ClosedFormMotion(path, "normal modes of small oscillations", amplitude)


CLOSED_FORMS: dict[str, Callable[[Model, State], ClosedFormMotion]] = {
    "planar-pendulum": planar_pendulum,
    "spherical-pendulum": spherical_pendulum,
    "lagrange-top": lagrange_top,
    "free-top": free_top,
    "conical": steady_rotation,
    "double-conical": steady_rotation,
    "small-double": small_oscillation,
    "small-chain": small_oscillation,
    "rest": equilibrium,
}


def _symmetric_top_motion(
    up: Array, c: Array, omega: Array, ratio: float, beta: float, p: Array, body_c: Array
) -> Callable[[Array], tuple[Array, Array]]:
    """Motion of a heavy symmetric top: times (T,) → p (T, 4), axis (T, 3) in the world.

    ``c``, ``omega`` in the world at t = 0, ``ratio`` = I_axial / I_transverse about the pivot, ``beta`` =
    2 m g d / I_transverse.  With u = c·ẑ, a = ratio·ω·c and b = (ω − (ω·c)c)·ẑ + a u,

        u̇² = f(u) = β (u − u₁)(u − u₂)(u − u₃),     u = u₁ + (u₂ − u₁) sn²(λt + τ₀),   λ = ½ √(β(u₃ − u₁))
        φ̇ = (b − a u)/(1 − u²),                      ψ̇ = ω·c − φ̇ u

    Whittaker § 71.  f is expanded about u(0), where f and f′ follow from the state without
    cancellation, so steady precession, a double root, keeps its digits.
    """
    u0, spin = float(c @ up), float(omega @ c)
    across = omega - spin * c
    q0, w2, a = float(across @ up), float(across @ across), ratio * spin
    udot = float(np.cross(omega, c) @ up)
    c0, c1 = udot**2, -beta * (1 - u0**2) - 2 * u0 * w2 + 2 * a * q0
    c2 = 2 * beta * u0 - w2 - a**2
    x3 = float(np.max(np.real(np.roots([beta, c2, c1, c0]))))
    for _ in range(3):  # polish the simple root
        slope = (3 * beta * x3 + 2 * c2) * x3 + c1
        x3 -= (((beta * x3 + c2) * x3 + c1) * x3 + c0) / slope if slope else 0.0
    _require(x3 > 1e-6, "an axis that stays away from straight up")
    product = -c0 / (beta * x3)  # x1 x2 ≤ 0
    total = (product - c1 / beta) / x3  # −(x1 + x2)
    root = np.sqrt(total**2 - 4 * product)
    larger = -(total + np.copysign(root, total)) / 2
    smaller = product / larger if larger else 0.0
    x1, x2 = min(larger, smaller), max(larger, smaller)
    u1, u2 = u0 + x1, u0 + x2
    _require(1 + u1 > 1e-6 and 1 - u2 > 1e-6, "an axis that never points straight up or down")
    m1 = (x3 - x2) / (x3 - x1)
    speed = np.sqrt(beta * (x3 - x1)) / 2
    start = np.arctan2(np.sqrt(max(-x1, 0.0)), np.copysign(np.sqrt(max(x2, 0.0)), udot))
    tau0 = float(elliptic_f(start, m1))
    minus, plus = q0 + a * u0 - a, q0 + a * u0 + a  # b − a, b + a
    n_minus, n_plus = (x2 - x1) / (1 - u1), -(x2 - x1) / (1 + u1)
    node = np.cross(up, c)
    node = node / np.linalg.norm(node)
    theta0 = np.arctan2(np.linalg.norm(np.cross(up, c)), u0)

    def path(t: Array) -> tuple[Array, Array]:
        sn, _, _, am = jacobi(speed * t + tau0, m1)
        u = u1 + (x2 - x1) * sn**2
        towards = (
            minus / (1 - u1) * (elliptic_pi(n_minus, am, m1) - elliptic_pi(n_minus, start, m1)) / (2 * speed)
        )
        away = plus / (1 + u1) * (elliptic_pi(n_plus, am, m1) - elliptic_pi(n_plus, start, m1)) / (2 * speed)
        phi, psi = towards + away, (spin - a) * t - (towards - away)
        theta = np.arctan2(np.sqrt((1 - u) * (1 + u)), u)
        turn = quaternion_product(
            _axis_angle_quaternions(up, phi), _axis_angle_quaternions(node, theta - theta0)
        )
        axis = (rotation_matrix(turn) @ c[:, None])[..., 0]
        return quaternion_product(
            quaternion_product(turn, np.broadcast_to(p, (len(t), 4))), _axis_angle_quaternions(body_c, psi)
        ), axis

    return path


def _torque_free_attitude(inertia: Array, p: Array, omega: Array) -> Callable[[Array], Array]:
    """Attitude p (T, 4) of a body free of moments.  Landau & Lifshitz, Mechanics, § 37.

    Principal moments ordered so that ω circles the third axis: ω₁ = a₁ cn, ω₂ = ±a₂ sn, ω₃ = a₃ dn; the body
    precesses about L by χ̇ = L (I₁ω₁² + I₂ω₂²)/(I₁²ω₁² + I₂²ω₂²), an integral of the third kind.  All
    differences (L² − 2E I…) are formed from ω's components, so a spin about the middle axis keeps its digits.
    """
    moments, axes = eigh(inertia)
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
        axis = omega / rate if rate else np.array([0.0, 0.0, 1.0])
        return lambda t: quaternion_product(
            np.broadcast_to(p, (len(t), 4)), _axis_angle_quaternions(axis, rate * t)
        )
    _require(gap > 0, "a motion that is not exactly on the separatrix")
    sign = np.copysign(1.0, w[2]) * np.sign(I3 - I1)
    a1, a2 = np.sqrt(D / (I1 * (I3 - I1))), np.sqrt(D / (I2 * (I3 - I2)))
    a3 = np.copysign(np.sqrt(B / (I3 * (I3 - I1))), w[2])
    speed = np.sqrt((I3 - I2) * B / (I1 * I2 * I3))
    m1 = min(1.0, abs(I3 - I1) * gap / ((I3 - I2) * B))
    start = np.arctan2(sign * w[1] / a2, w[0] / a1)
    tau0, n = float(elliptic_f(start, m1)), I3 * (I1 - I2) / (I1 * (I3 - I2))

    def towards(w1: Array, w2: Array, w3: Array) -> Array:
        """Rx(θ) Rz(ψ), which turns the body-frame direction of L into z."""
        theta = np.arctan2(np.hypot(I1 * w1, I2 * w2), I3 * w3)
        return quaternion_product(
            _axis_angle_quaternions(np.eye(3)[0], theta),
            _axis_angle_quaternions(np.eye(3)[2], np.arctan2(I1 * w1, I2 * w2)),
        )

    principal = _quaternion_from_matrix(axes)
    inverse = np.array([1.0, -1.0, -1.0, -1.0])
    base = quaternion_product(
        quaternion_product(p, principal), towards(*(np.atleast_1d(x) for x in w))[0] * inverse
    )

    def path(t: Array) -> Array:
        sn, cn, dn, am = jacobi(speed * t + tau0, m1)
        chi = L * t / I3 + L * (I3 - I1) / (I1 * I3 * speed) * (
            elliptic_pi(n, am, m1) - elliptic_pi(n, start, m1)
        )
        turned = quaternion_product(
            _axis_angle_quaternions(np.eye(3)[2], chi), towards(a1 * cn, sign * a2 * sn, a3 * dn)
        )
        return quaternion_product(
            quaternion_product(np.broadcast_to(base, (len(t), 4)), turned), principal * inverse
        )

    return path


def _require(holds: bool | np.bool_, condition: str) -> None:
    if not holds:
        raise ClosedFormMismatch(f"this closed form needs {condition}")


def _require_no_loads(model: Model) -> None:
    _require(not model.has_loads and not model.has_drag, "no loads and no drag")


def _require_single_body(model: Model, state: State, rod: bool) -> tuple[Array, Array, float]:
    """A (3, 3), the unit vector up and |g| of a scenario with one body, no loads and the right joint."""
    _require_no_loads(model)
    _require(model.n == 1, "one body")
    _require(bool(model.rods[0]) == rod, "a rod" if rod else "a ball joint")
    g = float(np.linalg.norm(model.gravity))
    return rotation_matrix(state.p[0]), -model.gravity / g if g else np.array([0.0, 0.0, 1.0]), g


def _inertia_about_pivot(model: Model) -> Array:
    """Inertia (3, 3) about the pivot, body frame."""
    s = model.proximal[0]
    return np.asarray(model.inertia[0] + model.mass[0] * (s @ s * np.eye(3) - np.outer(s, s)))


def _relative_imbalance(model: Model, state: State, spin: Array) -> float:
    """Force and moment, relative to their terms, that a rigid turn of everything at ``spin`` leaves over."""
    A = rotation_matrix(state.p)
    near, far = ((A @ s[..., None])[..., 0] for s in (model.proximal, model.distal))
    inertia = A @ model.inertia @ A.mT
    worst, below = 0.0, np.zeros(3)
    for k in reversed(range(model.n)):
        a = np.cross(spin, np.cross(spin, state.r[k]))
        pull = model.mass[k] * (a - model.gravity) + below
        gyro = np.cross(spin, inertia[k] @ spin)
        terms = [np.cross(near[k], pull), -np.cross(far[k], below), -gyro]
        sizes = [near[k], far[k]], [pull, below]
        size = sum(np.linalg.norm(s) * np.linalg.norm(f) for s, f in zip(*sizes, strict=True))
        size += np.linalg.norm(gyro)
        worst = max(worst, float(np.linalg.norm(sum(terms)) / size) if size else 0.0)
        if model.rods[k]:
            askew = np.linalg.norm(np.cross(state.u[k], pull)) / np.linalg.norm(pull)
            worst = max(worst, float(askew) if state.u[k] @ pull < 0 else np.inf)
        below = pull
    return worst


def _angles_from_up(v: Array, up: Array, across: Array) -> Array:
    """Angle (K,) of unit vectors v (K, 3) from up towards across."""
    return np.asarray(np.arctan2(v @ across, v @ up))


def _axis_angle_quaternions(axis: Array, angle: Array) -> Array:
    """Quaternions (T, 4) of rotations by angle (T,) about a unit axis (3,)."""
    half = np.asarray(angle)[:, None] / 2
    return np.concatenate([np.cos(half), np.sin(half) * axis], 1)


def _quaternion_from_matrix(A: Array) -> Array:
    """Unit quaternion (4,) of a rotation matrix: the largest column of 4 p pᵀ."""
    xx, yy, zz = np.diag(A)
    a, b, c = A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]
    xy, xz, yz = A[0, 1] + A[1, 0], A[0, 2] + A[2, 0], A[1, 2] + A[2, 1]
    K = np.array(
        [
            [1 + xx + yy + zz, a, b, c],
            [a, 1 + xx - yy - zz, xy, xz],
            [b, xy, 1 - xx + yy - zz, yz],
            [c, xz, yz, 1 - xx - yy + zz],
        ]
    )
    best = K[np.argmax(np.diag(K))]
    return np.asarray(best / np.linalg.norm(best))
