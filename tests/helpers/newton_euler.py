"""An independent yardstick for adapters: Newton–Euler equations in maximal coordinates, nothing of the notes.

Unknowns per body are r̈, ω̇′ and the vector force F of its joint, so a rod is a ball joint
whose force has no component across it.  Everything is assembled in extended precision
from the double-precision inputs and refined there: the answer is limited by the inputs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from plumbline.model import kinematics
from plumbline.model.datatypes import Array, Model, State


@dataclass(frozen=True, eq=False)
class NewtonEulerSolution:
    """r̈ (N, 3) m/s² and F (N, 3) N in the world frame, ω̇′ (N, 3) rad/s² in the body frame."""

    acceleration: Array
    angular_acceleration: Array
    joint_reaction: Array


def solve(model: Model, state: State, dtype: type = np.longdouble) -> NewtonEulerSolution:
    """The accelerations and joint forces at a state, from p, ω′, u and u̇ alone (r and v follow)."""

    def exact(x: Array) -> Array:
        return np.asarray(x, dtype)

    n = model.n
    A = np.zeros((9 * n, 9 * n), dtype)
    b = np.zeros(9 * n, dtype)
    R = _rotation(exact(state.p))
    omega, u, udot = exact(state.omega), exact(state.u), exact(state.udot)
    J, near, far = exact(model.inertia), exact(model.proximal), exact(model.distal)
    mass, length = exact(model.mass), exact(model.length)
    drag_force, drag_moment = exact(model.drag_force), exact(model.drag_moment)
    v = _velocities(R, omega, length[:, None] * udot, near, far)
    acc, ang, force = (lambda k, o=o: slice(9 * k + o, 9 * k + o + 3) for o in (0, 3, 6))
    for k in range(n):
        w = omega[k]
        # Newton: m r̈ − F_k + F_{k+1} = applied;  Euler, in the body frame, about the centre of mass.
        A[acc(k), acc(k)] = mass[k] * np.eye(3)
        A[acc(k), force(k)] = -np.eye(3)
        b[acc(k)] = mass[k] * model.gravity + model.force[k] - drag_force[k] * v[k]
        A[ang(k), ang(k)] = J[k]
        A[ang(k), force(k)] = -_skew(near[k]) @ R[k].T
        b[ang(k)] = model.moment[k] - drag_moment[k] * w - _cross(w, J[k] @ w)
        if k + 1 < n:
            A[acc(k), force(k + 1)] = np.eye(3)
            A[ang(k), force(k + 1)] = _skew(far[k]) @ R[k].T
        # The joint: difference of the accelerations of the two attachment points = d̈ = ℓ ü.
        rows = np.zeros((3, 9 * n), dtype)
        rows[:, acc(k)], rows[:, ang(k)] = np.eye(3), -R[k] @ _skew(near[k])
        known = -R[k] @ _cross(w, _cross(w, near[k]))
        if k > 0:
            rows[:, acc(k - 1)], rows[:, ang(k - 1)] = -np.eye(3), R[k - 1] @ _skew(far[k - 1])
            known += R[k - 1] @ _cross(omega[k - 1], _cross(omega[k - 1], far[k - 1]))
        if model.length[k] > 0:
            along, across = u[k] / np.sqrt(u[k] @ u[k]), _perpendicular(u[k])
            known = np.array([along @ known - length[k] * (udot[k] @ udot[k]), 0, 0])
            rows = np.vstack([along @ rows, np.zeros((2, 9 * n), dtype)])
            rows[1:, force(k)] = across
        A[force(k)], b[force(k)] = rows, known
    x = _solve(A, b).reshape(n, 9)
    return NewtonEulerSolution(x[:, :3], x[:, 3:6], x[:, 6:])


def integrate(model: Model, state: State, times: Array, rtol: float = 3e-14) -> list[State]:
    """States at ``times`` by DOP853 on the minimal coordinates (p, ω′, u, u̇): no joint can drift."""
    shapes = [(model.n, 4), *[(model.n, 3)] * 3]
    cuts = np.cumsum([np.prod(s) for s in shapes])[:-1]

    def unpack(y: Array) -> State:
        p, omega, u, udot = (part.reshape(s) for part, s in zip(np.split(y, cuts), shapes, strict=True))
        return kinematics.state_from_minimal(model, p, omega, u, udot)

    def rhs(_t: float, y: Array) -> Array:
        at = unpack(y)
        truth = solve(model, at, float)  # rounding, like that of the integrator
        d_ddot = _attachment_acceleration(model, at, truth)
        uddot = np.where(model.rods[:, None], d_ddot / np.where(model.rods, model.length, 1)[:, None], 0)
        parts = kinematics.quaternion_rate(at.p, at.omega), truth.angular_acceleration, at.udot, uddot
        return np.concatenate([np.ravel(part) for part in parts])

    start = np.concatenate([np.ravel(x) for x in (state.p, state.omega, state.u, state.udot)])
    run = solve_ivp(rhs, (0, times[-1]), start, "DOP853", t_eval=times, rtol=rtol, atol=1e-14)
    return [unpack(y) for y in run.y.T]


def kinetic_energy(model: Model, state: State) -> float:
    """½ Σ m v·v + ω′·J ω′ (J)."""
    spin = np.einsum("ki,kij,kj", state.omega, model.inertia, state.omega)
    return float(0.5 * (model.mass @ np.sum(state.v**2, -1) + spin))


def potential_energy(model: Model, state: State) -> float:
    """−Σ m g·r (J), zero at the pivot."""
    return float(-model.mass @ state.r @ model.gravity)


def angular_momentum(model: Model, state: State) -> Array:
    """Σ r × m v + A J ω′ (3,), about the world origin."""
    spin = np.einsum("kij,kjl,kl->i", kinematics.rotation_matrix(state.p), model.inertia, state.omega)
    return np.asarray(np.sum(model.mass[:, None] * np.cross(state.r, state.v), 0) + spin)


def mass_matrix(model: Model, state: State) -> Array:
    """M of ½ νᵀ M ν, ν = (u̇ of the rods, ω′ of all): velocities are linear in ν, so unit ν give columns."""
    rods = np.flatnonzero(model.rods)
    columns = []
    for unit in np.eye(3 * (len(rods) + model.n)):
        udot, omega = np.zeros((model.n, 3)), unit[3 * len(rods) :].reshape(model.n, 3)
        udot[rods] = unit[: 3 * len(rods)].reshape(-1, 3)
        udot -= state.u * np.sum(state.u * udot, -1, keepdims=True)  # a rod turns with u × u̇
        columns.append(
            np.hstack([kinematics.state_from_minimal(model, state.p, omega, state.u, udot).v, omega])
        )
    B = np.array(columns)  # (nu, N, 6)
    linear = np.einsum("akj,k,bkj->ab", B[..., :3], model.mass, B[..., :3])
    return np.asarray(linear + np.einsum("aki,kij,bkj->ab", B[..., 3:], model.inertia, B[..., 3:]))


def _rotation(p: Array) -> Array:
    """A (N, 3, 3) of p/‖p‖, from A v = v + 2 e × (e × v + p0 v)."""
    q = p / np.sqrt(np.sum(p * p, -1, keepdims=True))
    E = np.array([_skew(e) for e in q[:, 1:]])
    return np.asarray(np.eye(3, dtype=p.dtype) + 2 * (E @ E + q[:, :1, None] * E))


def _velocities(R: Array, omega: Array, rod_rate: Array, near: Array, far: Array) -> Array:
    v = np.zeros_like(omega)
    tip = np.zeros_like(omega[0])
    for k in range(len(v)):
        v[k] = tip + rod_rate[k] - R[k] @ _cross(omega[k], near[k])
        tip = v[k] + R[k] @ _cross(omega[k], far[k])
    return v


def _attachment_acceleration(model: Model, state: State, truth: NewtonEulerSolution) -> Array:
    """d̈ (N, 3): of body k's proximal point relative to the point where joint k hangs."""
    a = kinematics.rotation_matrix(state.p)

    def point(s: Array) -> Array:
        turn = _cross(truth.angular_acceleration, s) + _cross(state.omega, _cross(state.omega, s))
        return np.asarray(truth.acceleration + np.einsum("kij,kj->ki", a, turn))

    return point(model.proximal) - np.vstack([np.zeros(3), point(model.distal)[:-1]])


def _cross(a: Array, b: Array) -> Array:
    """a × b along the last axis; numpy's own spends five times as long on generality."""
    return np.asarray(a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]])


def _skew(a: Array) -> Array:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]], a.dtype)


def _perpendicular(u: Array) -> Array:
    """Two vectors (2, 3) across u, well apart."""
    first = _cross(u, np.eye(3, dtype=u.dtype)[np.argmin(np.abs(u))])
    first = first / np.sqrt(first @ first)
    return np.array([first, _cross(u, first)], u.dtype)


def _solve(A: Array, b: Array) -> Array:
    """Equilibrated double-precision inverse, refined against residuals in the numbers' own precision."""
    row = 1 / np.max(np.abs(A), 1)
    column = 1 / np.max(np.abs(row[:, None] * A), 0)
    scaled = row[:, None] * A * column
    inverse = np.linalg.inv(scaled.astype(float))
    x = np.zeros_like(b)
    for _ in range(8):
        step = (inverse @ (row * b - scaled @ x).astype(float)).astype(b.dtype)
        x = x + step
        if np.max(np.abs(step)) <= 4 * np.finfo(b.dtype).eps * np.max(np.abs(x)):
            break
    return np.asarray(column * x, dtype=float)
