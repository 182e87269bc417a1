"""Euler's free top: a rigid body without applied moments."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from plumbline.model.datatypes import FREE, Array, Model, State
from plumbline.model.kinematics import quaternion_conjugate, quaternion_product
from plumbline.truth.closed_form.motion import (
    ClosedFormMotion,
    axis_angle_quaternions,
    require,
    require_no_loads,
    require_single_body,
)
from plumbline.truth.elliptic import elliptic_f, elliptic_pi, jacobi

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

    principal = _quaternion_from_matrix(axes)
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
