"""One step of a declared method, computed from its formula in extended precision (x87 long double).

Joint-space methods: the accelerations at the states that a step visits come from the Newton–Euler equations
in absolute angular accelerations; nothing is shared with an engine, the reference or the certified truth.
Constrained methods are not solved: their quadrature and their equations are evaluated at the engine's answer.
docs/integrators.md states every formula with its source.

Arrays have leading axes ``...`` for many states at once.  The links of a chain are connected by ball joints:
bodies, and rods as massless links with an inertia about their own axis only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from plumbline.model.datatypes import Model, State, StepRun
from plumbline.model.kinematics import quaternion_conjugate, quaternion_product
from plumbline.model.step_methods import ConstrainedMethod, JointSpaceMethod

Array = NDArray[Any]  # in this module of extended precision, where nothing else is stated
LongDouble = np.longdouble
HAS_EXTENDED_PRECISION = np.finfo(LongDouble).eps < 1e-18  # False on Apple's arm64 and with MSVC


@dataclass(frozen=True, eq=False)
class LinkStates:
    """Motion of the bodies of a chain, extended precision; leading axes as in the states it was made from."""

    r: Array  # (..., N, 3) m, world
    p: Array  # (..., N, 4) unit quaternions
    v: Array  # (..., N, 3) m/s, world
    omega: Array  # (..., N, 3) rad/s, body frame
    u: Array  # (..., N, 3) directions of the rods, world; zero for ball joints
    udot: Array  # (..., N, 3) 1/s


def joint_space_steps(
    model: Model,
    states: Sequence[State],
    steps: Sequence[float],
    method: JointSpaceMethod,
    count: int,
    angle_axes: Sequence[Array | None],
) -> list[LinkStates]:
    """Take steps of a declared method from each state.

    Args:
        model: the mechanism.
        states: B initial states.
        steps: the step [s] from each.
        method: the declared formula.
        count: how many steps.
        angle_axes: for "joint angles", the axes (angles, 3) of the revolute joints at each state.

    Returns:
        The motion (B, N, ·) after 0, 1, 2, …, ``count`` steps; not finite where a step leads into a
        singularity.

    """
    chain = _LinkChain(model, method.rod_axial_inertia)
    system: _System = (
        _JointRotations(chain, method)
        if method.coordinates == "joint rotations"
        else _JointAngles(chain, states, [axes for axes in angle_axes if axes is not None])
    )
    if method.reuses_acceleration:
        system = _Reusing(system)
    q, v = system.start(states)
    h = np.array(steps, LongDouble)[:, None, None] * LongDouble(method.step_factor) / method.substeps
    found = [chain.bodies(*system.links(q, v))]
    with np.errstate(all="ignore"):
        for _ in range(count):
            for _ in range(method.substeps):
                if isinstance(system, _Reusing):
                    system.is_new_step = True
                q, v = _STEPS[method.formula](system, method, q, v, h)
            found.append(chain.bodies(*system.links(q, v)))
    return found


def fastest_rates(model: Model, states: Sequence[State], iterations: int = 12) -> Array:
    """Estimate the spectral radius of the linearised equations of motion by power iteration.

    Args:
        model: the mechanism.
        states: B states.
        iterations: how many; the growth over the second half counts.

    Returns:
        (B,) [1/s].

    """
    chain = _LinkChain(model, 1.0)
    system = _JointRotations(chain, JointSpaceMethod("Runge-Kutta", "joint rotations"))
    q, v = system.start(states)
    a = system.acceleration(q, v)
    rng = np.random.default_rng(0)
    theta, rate = rng.normal(size=(2, *v.shape)).astype(LongDouble)

    def size(theta: Array, rate: Array) -> Array:
        return np.asarray(np.sqrt(np.sum(theta * theta + rate * rate, axis=(-2, -1), keepdims=True)))

    tiny, growth = LongDouble(1e-7), []
    for _ in range(iterations):
        total = size(theta, rate)
        theta, rate = tiny * theta / total, tiny * rate / total
        change = system.acceleration(system.move(q, theta), v + rate) - a
        # d/dt of a displacement in the moving frame: δθ̇ = δv − v × θ
        theta, rate = rate - _cross(v, theta), change
        growth.append(size(theta, rate) / tiny)
    later = np.log(np.array(growth[iterations // 2 :], float))
    return np.asarray(np.exp(np.mean(later, axis=0)).ravel())


# -- the equations of motion -------------------------------------------------------------------------


class _LinkChain:
    """The chain as nj links on ball joints: link j's tip carries the next one."""

    def __init__(self, model: Model, rod_axial_inertia: float) -> None:
        self.model = model
        rods = model.rods
        self.of_body = np.arange(model.n) + np.cumsum(rods)  # link of each body
        self.of_rod = self.of_body[rods] - 1
        self.count = nj = model.n + int(rods.sum())
        self.mass, self.inertia, self.tip, self.centre, self.force, self.moment = (
            np.zeros((nj, *shape), LongDouble) for shape in ((), (3, 3), (3,), (3,), (3,), (3,))
        )
        self.drag_force, self.drag_moment = np.zeros((2, nj, 1), LongDouble)
        proximal, b = model.proximal.astype(LongDouble), self.of_body
        self.mass[b], self.inertia[b], self.centre[b] = model.mass, model.inertia, -proximal
        self.tip[b] = model.distal.astype(LongDouble) - proximal
        self.force[b], self.moment[b] = model.force, model.moment
        self.drag_force[b, 0], self.drag_moment[b, 0] = model.drag_force, model.drag_moment
        self.tip[self.of_rod, 2] = model.length[rods]
        trace = np.trace(model.inertia.astype(LongDouble), axis1=1, axis2=2)
        self.inertia[self.of_rod, 2, 2] = LongDouble(rod_axial_inertia) * trace[rods]
        self.gravity = model.gravity.astype(LongDouble)
        self.mass_beyond = _suffix_sum(self.mass[:, None])[:, 0]

    def attitudes(self, states: Sequence[State]) -> tuple[Array, Array]:
        """Quaternions (B, nj, 4) and angular velocities (B, nj, 3; world) of the links; z of a rod is u."""
        p = np.zeros((len(states), self.count, 4), LongDouble)
        omega = np.zeros((len(states), self.count, 3), LongDouble)
        quaternions = _unit(np.array([state.p for state in states], LongDouble))
        p[:, self.of_body] = quaternions
        body_rates = np.array([state.omega for state in states], LongDouble)
        omega[:, self.of_body] = _times(_rotation(quaternions), body_rates)
        rods = self.model.rods
        u = _unit(np.array([state.u for state in states], LongDouble)[:, rods])
        udot = np.array([state.udot for state in states], LongDouble)[:, rods]
        p[:, self.of_rod], omega[:, self.of_rod] = _turn_of_z(u), _cross(u, udot)
        return p, omega

    def acceleration(self, A: Array, omega: Array) -> Array:
        """Angular accelerations (..., nj, 3), world, at attitudes A (..., nj, 3, 3)."""
        moment = self.moments(A, omega)
        flat = (*moment.shape[:-2], 3 * self.count)
        return _solve(self.mass_matrix(A), moment.reshape(flat)).reshape(moment.shape)

    def mass_matrix(self, A: Array) -> Array:
        """M (..., 3nj, 3nj) of absolute angular accelerations, world: M α = `moments`.

        For links i < j: M_ij = −L̃_i S̃_j with S_j = m_j c_j + L_j Σ_{k>j} m_k;
        M_jj = I_j − m_j c̃_j c̃_j − L̃_j L̃_j Σ_{k>j} m_k.
        """
        tip, centre = _times(A, self.tip), _times(A, self.centre)
        m, beyond = self.mass[:, None], self.mass_beyond[:, None]
        left, right = _cross_matrix(tip), _cross_matrix(m * centre + beyond * tip)
        M = -np.einsum("...iab,...jbc->...iajc", left, right)
        i, j = np.tril_indices(self.count, -1)
        M = np.moveaxis(M, (-4, -2), (0, 1))  # (nj, nj, ..., 3, 3)
        M[i, j] = np.swapaxes(M[j, i], -1, -2)
        c = _cross_matrix(centre)
        own = (
            A @ self.inertia @ np.swapaxes(A, -1, -2)
            - m[..., None] * (c @ c)
            - beyond[..., None] * (left @ left)
        )
        diagonal = np.arange(self.count)
        M[diagonal, diagonal] = np.moveaxis(own, -3, 0)
        M = np.moveaxis(M, (0, 1), (-4, -2))
        return np.asarray(M.reshape(*M.shape[:-4], 3 * self.count, 3 * self.count))

    def moments(self, A: Array, omega: Array, forces: str = "all") -> Array:
        """Moments (..., nj, 3) on the links, world: loads, drag and velocity terms, or drag alone."""
        tip, centre = _times(A, self.tip), _times(A, self.centre)
        below = _prefix_sum(_cross(omega, tip))
        velocity = below + _cross(omega, centre)
        push, turn = -self.drag_force * velocity, -self.drag_moment * omega
        if forces == "all":
            bend = _prefix_sum(_cross(omega, _cross(omega, tip))) + _cross(omega, _cross(omega, centre))
            push = push + self.force + self.mass[:, None] * (self.gravity - bend)
            momentum = _times(A, _times(self.inertia, _times(np.swapaxes(A, -1, -2), omega)))
            turn = turn + _times(A, self.moment) - _cross(omega, momentum)
        return _cross(centre, push) + _cross(tip, _suffix_sum(push)) + turn

    def bodies(self, p: Array, omega: Array) -> LinkStates:
        """Positions and rates of the bodies from quaternions and world rates of the links."""
        A, b = _rotation(p), self.of_body
        tip, centre = _times(A, self.tip), _times(A, self.centre)
        r = _prefix_sum(tip) + centre
        v = _prefix_sum(_cross(omega, tip)) + _cross(omega, centre)
        u, udot = (np.zeros_like(r[..., b, :]) for _ in range(2))
        u[..., self.model.rods, :] = axis = A[..., 2][..., self.of_rod, :]
        udot[..., self.model.rods, :] = _cross(omega[..., self.of_rod, :], axis)
        rates = _times(np.swapaxes(A, -1, -2), omega)[..., b, :]
        return LinkStates(r[..., b, :], p[..., b, :], v[..., b, :], rates, u, udot)


class _System(Protocol):
    """Coordinates of a chain: configuration q, velocity v."""

    def start(self, states: Sequence[State]) -> tuple[Array, Array]: ...

    def acceleration(self, q: Array, v: Array) -> Array: ...

    def damped_acceleration(self, q: Array, v: Array, h: Array, forces: str) -> Array: ...

    def move(self, q: Array, displacement: Array) -> Array: ...

    def displacement_rate(self, theta: Array, v: Array) -> Array: ...

    def links(self, q: Array, v: Array) -> tuple[Array, Array]: ...


class _Reusing:
    """A system whose first acceleration in a step is the last one of the step before, at an older state."""

    def __init__(self, system: _System) -> None:
        self.system, self.is_new_step = system, True
        self.last: Array | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.system, name)

    def acceleration(self, q: Array, v: Array) -> Array:
        if self.last is None or not self.is_new_step:
            self.last = self.system.acceleration(q, v)
        self.is_new_step = False
        return self.last


class _JointRotations:
    """q: quaternions (..., nj, 4) relative to the link before; v: their rates (..., nj, 3), child's frame."""

    def __init__(self, chain: _LinkChain, method: JointSpaceMethod) -> None:
        self.chain, self.method = chain, method

    def start(self, states: Sequence[State]) -> tuple[Array, Array]:
        p, omega = self.chain.attitudes(states)
        relative = _times(np.swapaxes(_rotation(p), -1, -2), omega - _before(omega))
        q = p.copy()
        q[..., 1:, :] = quaternion_product(quaternion_conjugate(p[..., :-1, :]), p[..., 1:, :])
        return q, relative

    def links(self, q: Array, v: Array) -> tuple[Array, Array]:
        p = q.copy()
        for j in range(1, self.chain.count):
            p[..., j, :] = quaternion_product(p[..., j - 1, :], q[..., j, :])
        return p, np.cumsum(_times(_rotation(p), v), axis=-2)

    def move(self, q: Array, displacement: Array) -> Array:
        if self.method.is_rotation_exact:
            return quaternion_product(q, _exponential(displacement))
        turn = np.concatenate([np.ones_like(displacement[..., :1]), displacement / 2], -1)
        return _unit(quaternion_product(q, turn))

    def displacement_rate(self, theta: Array, v: Array) -> Array:
        """dexp⁻¹(θ) v = v + θ×v/2 + (1 − (θ/2) cot(θ/2)) θ×(θ×v)/θ², of displacements on the right."""
        angle = np.sqrt(np.sum(theta * theta, -1, keepdims=True))
        small = angle < 1e-3
        half = np.where(small, LongDouble(1), angle / 2)
        series = LongDouble(1) / 12 + angle**2 / 720 + angle**4 / 30240
        factor = np.where(small, series, (1 - half / np.tan(half)) / (4 * half * half))
        once, terms = _cross(theta, v), self.method.correction_terms
        if terms is not None:
            return np.asarray(v + (terms > 0) * once / 2 + (terms > 1) * _cross(theta, once) / 12)
        return np.asarray(v + once / 2 + factor * _cross(theta, once))

    def acceleration(self, q: Array, v: Array) -> Array:
        p, omega = self.links(q, v)
        A = _rotation(p)
        alpha = self.chain.acceleration(A, omega)
        relative = alpha - _before(alpha) + _cross(omega, _before(omega))
        return _times(np.swapaxes(A, -1, -2), relative)

    def damped_acceleration(self, q: Array, v: Array, h: Array, forces: str) -> Array:
        """(M + h D)⁻¹ M a with D = −∂f/∂v of all forces f = M a, or of the drag alone."""
        p, _ = self.links(q, v)
        A, nv = _rotation(p), 3 * self.chain.count
        # ω of the links = T v, blocks A_i for i ≤ j
        T = np.zeros((*q.shape[:-2], nv, nv), LongDouble)
        for i in range(self.chain.count):
            for j in range(i, self.chain.count):
                T[..., 3 * j : 3 * j + 3, 3 * i : 3 * i + 3] = A[..., i, :, :]
        M = self.chain.mass_matrix(A)

        def generalized_forces(v: Array, forces: str) -> Array:
            """(K, ..., nv): Tᵀ (moments − M Ṫ v), of velocities (K, ..., nj, 3)."""
            omega = np.cumsum(_times(A, v), axis=-2)
            found = self.chain.moments(A, omega, forces).reshape(*v.shape[:-2], nv)
            if forces == "all":
                bend = np.cumsum(_cross(omega, _times(A, v)), axis=-2)
                found = found - _times(M, bend.reshape(found.shape))
            return _times(np.swapaxes(T, -1, -2), found)

        units = np.eye(nv, dtype=LongDouble).reshape(nv, *(1,) * (q.ndim - 2), self.chain.count, 3)
        # f is quadratic in v: a central difference of any size is exact
        columns = (generalized_forces(v - units, forces) - generalized_forces(v + units, forces)) / 2
        D = LongDouble(self.method.damping_factor) * np.moveaxis(columns, 0, -1)
        if self.method.is_damping_symmetric:
            D = (D + np.swapaxes(D, -1, -2)) / 2
        MT = np.swapaxes(T, -1, -2) @ M @ T
        solved = _solve(MT + h * D, generalized_forces(v, "all"))
        return solved.reshape(v.shape)


class _JointAngles:
    """q, v: angles and rates (..., angles, 1) of revolute joints; three turn a body, two a rod.

    A rod without inertia takes its axial spin from the link before it; that spin acts on nothing.
    """

    def __init__(self, chain: _LinkChain, states: Sequence[State], axes: Sequence[Array]) -> None:
        self.chain = chain
        self.axes = np.array(axes, LongDouble)  # (B, angles, 3) world, at the start
        self.start_attitude, self.start_omega = chain.attitudes(states)
        sizes = np.full(chain.count, 3)
        sizes[chain.of_rod] = 2
        self.ends = np.cumsum(sizes)
        self.is_rod = sizes == 2

    def start(self, states: Sequence[State]) -> tuple[Array, Array]:
        relative, rates = self.start_omega - _before(self.start_omega), []
        spin = np.zeros_like(relative[:, 0])  # axial spin of the rod before, beyond that of `start_omega`
        for j, end in enumerate(self.ends):
            count = 2 if self.is_rod[j] else 3
            a, b = self.axes[:, end - count], self.axes[:, end - count + 1]
            third = -_cross(a, b) if self.is_rod[j] else self.axes[:, end - 1]
            found = _solve3(a, b, third, relative[:, j] - spin)
            rates.append(found[:, :count])
            spin = -third * found[:, 2:] if self.is_rod[j] else np.zeros_like(spin)
        v = np.concatenate(rates, axis=1)[..., None]
        return np.zeros_like(v), v

    def move(self, q: Array, displacement: Array) -> Array:
        return q + displacement

    def displacement_rate(self, theta: Array, v: Array) -> Array:
        return v

    def damped_acceleration(self, q: Array, v: Array, h: Array, forces: str) -> Array:
        raise NotImplementedError("no engine has this method")

    def links(self, q: Array, v: Array) -> tuple[Array, Array]:
        p, omega, _ = self._turns(q, v)
        return p, omega

    def acceleration(self, q: Array, v: Array) -> Array:
        p, omega, axes = self._turns(q, v)
        A = _rotation(p)
        # without the rods' axial spin, which acts on nothing, the equations hold for any axial inertia
        rods = self.chain.of_rod
        along, free = A[..., 2][:, rods], omega.copy()
        free[:, rods] -= np.sum(omega[:, rods] * along, -1, keepdims=True) * along
        alpha = self.chain.acceleration(A, free)
        before, omega_before, found = np.zeros_like(alpha[:, 0]), np.zeros_like(alpha[:, 0]), []
        for j, end in enumerate(self.ends):
            count = 2 if self.is_rod[j] else 3
            three = list(np.moveaxis(axes[:, end - count : end], 1, 0))
            bend, turning = before, omega_before
            for axis, rate in zip(three, np.moveaxis(v[:, end - count : end], 1, 0), strict=True):
                bend = bend + _cross(turning, axis * rate)
                turning = turning + axis * rate
            target, u = alpha[:, j], A[:, j, :, 2]
            if self.is_rod[j]:  # across the rod: u × ü = α − s u × ω, with the axial spin s
                target = target - np.sum(u * alpha[:, j], -1, keepdims=True) * u
                target = target - np.sum(u * turning, -1, keepdims=True) * _cross(u, turning)
                three.append(-u)
            rates = _solve3(three[0], three[1], three[2], target - bend)
            found.append(rates[:, :count])
            before = target + rates[:, 2:] * u if self.is_rod[j] else target
            omega_before = turning
        return np.concatenate(found, axis=1)[..., None]

    def _turns(self, q: Array, v: Array) -> tuple[Array, Array, Array]:
        """Quaternions and world rates of the links, and the axes now: a product of exponentials."""
        turn: Array = np.zeros((len(q), 4), LongDouble)
        turn[:, 0] = 1
        spin, p, omega = np.zeros((len(q), 3), LongDouble), [], []
        axes = np.empty_like(self.axes)
        ends = {int(end): j for j, end in enumerate(self.ends)}
        for i in range(q.shape[1]):
            axes[:, i] = _times(_rotation(turn), self.axes[:, i])
            turn = quaternion_product(turn, _exponential(self.axes[:, i] * q[:, i]))
            spin = spin + axes[:, i] * v[:, i]
            if i + 1 in ends:
                p.append(quaternion_product(turn, self.start_attitude[:, ends[i + 1]]))
                omega.append(spin)
        return np.stack(p, 1), np.stack(omega, 1), axes


# -- steps -------------------------------------------------------------------------------------------


def _semi_implicit_euler(
    system: _System, method: JointSpaceMethod, q: Array, v: Array, h: Array
) -> tuple[Array, Array]:
    if method.implicit_forces == "none":
        new = v + h * system.acceleration(q, v)
    else:
        new = v + h * system.damped_acceleration(q, v, h, method.implicit_forces)
    share = LongDouble(method.new_velocity_share)
    mover = share * new + (1 - share) * v
    if method.stale_joint is not None:
        mover[..., method.stale_joint, :] = v[..., method.stale_joint, :]
    return system.move(q, h * mover), new


def _positions_first(
    system: _System, method: JointSpaceMethod, q: Array, v: Array, h: Array
) -> tuple[Array, Array]:
    q = system.move(q, h * v)
    return q, v + h * system.acceleration(q, v)


def _velocity_verlet(
    system: _System, method: JointSpaceMethod, q: Array, v: Array, h: Array
) -> tuple[Array, Array]:
    a = system.acceleration(q, v)
    q = system.move(q, h * v + h * h * a / 2)
    return q, v + h / 2 * (a + system.acceleration(q, v + h / 2 * a))


def _runge_kutta(
    system: _System, method: JointSpaceMethod, q: Array, v: Array, h: Array
) -> tuple[Array, Array]:
    rates: list[Array] = []
    accelerations: list[Array] = []

    def weighted(weights: Sequence[float], values: list[Array]) -> Array:
        return sum(((h * LongDouble(w)) * x for w, x in zip(weights, values, strict=True)), np.zeros_like(v))

    for row in method.stages:
        theta, rate = weighted(row, rates), v + weighted(row, accelerations)
        rates.append(system.displacement_rate(theta, rate))
        accelerations.append(system.acceleration(system.move(q, theta), rate))
    theta = weighted(method.weights, rates)
    return system.move(q, theta), v + weighted(method.weights, accelerations)


_STEPS = {
    "semi-implicit Euler": _semi_implicit_euler,
    "positions first": _positions_first,
    "velocity Verlet": _velocity_verlet,
    "Runge-Kutta": _runge_kutta,
}


# -- constrained methods -----------------------------------------------------------------------------


def constrained_quadrature(method: ConstrainedMethod, run: StepRun, h: float) -> tuple[Array, Array]:
    """Predict q₁ and q̇₁ of every step from the engine's own q̈ and its coordinates before the step.

    Args:
        method: the declared formula.
        run: T samples of consecutive steps with accelerations.
        h: step [s].

    Returns:
        q and q̇ (T − 1, N, 7), extended precision.

    """
    q, qdot, qddot = engine_coordinates(run)
    a, step = qddot[0], LongDouble(h)
    alpha_m, alpha_f, beta, gamma = (
        LongDouble(x) for x in (method.alpha_m, method.alpha_f, method.beta, method.gamma)
    )
    positions, rates = [], []
    for i in range(len(q) - 1):
        new = ((1 - alpha_f) * qddot[i + 1] + alpha_f * qddot[i] - alpha_m * a) / (1 - alpha_m)
        positions.append(q[i] + step * qdot[i] + step**2 * ((LongDouble(0.5) - beta) * a + beta * new))
        rates.append(qdot[i] + step * ((1 - gamma) * a + gamma * new))
        a = new
    return np.array(positions), np.array(rates)


def engine_coordinates(run: StepRun) -> tuple[Array, Array, Array]:
    """Return an engine's q = (r, p), q̇ and q̈ in extended precision.

    Args:
        run: T samples with accelerations.

    Returns:
        Three arrays (T, N, 7).

    """
    t = run.trajectory
    assert run.coordinate_acceleration is not None
    q, qdot = np.concatenate([t.r, t.p], -1), np.concatenate([t.v, t.pdot], -1)
    return q.astype(LongDouble), qdot.astype(LongDouble), run.coordinate_acceleration.astype(LongDouble)


@dataclass(frozen=True, eq=False)
class ConstrainedResidual:
    """How far Exudyn's answer is from its equations; sizes are of the terms, for rounding."""

    residual: Array  # (T,) 2-norm of M q̈ + Cᵀ λ − f and of the constraints, N and m or m/s
    first_residual: Array  # (T,) N, the same of q̈ = 0 and λ = 0
    size: Array  # (T,) norm of the largest terms, N and m or m/s


def constrained_residual(model: Model, method: ConstrainedMethod, run: StepRun) -> ConstrainedResidual:
    """Evaluate Exudyn's equations of rigid bodies with Euler parameters at its answers.

    They differ from textbook ones where |p| ≠ 1: A(p) = 1 − 2 (…), G = 2 L(p), M = diag(m, GᵀJG),
    f = −Gᵀ(ω′ × Jω′), a point's rows are [1, −A s̃ G], moments enter as (2E(p))ᵀ (A n′ − c_r A ω′).

    Args:
        model: the mechanism.
        method: whose constraint level and coordinates these are.
        run: T samples with accelerations and multipliers.

    Returns:
        The residuals at each sample but the first.

    """
    q, qdot, qddot = (x[1:] for x in engine_coordinates(run))
    assert run.multipliers is not None
    multipliers = run.multipliers[1:].astype(LongDouble)
    r, p, v, pdot = q[..., :3], q[..., 3:], qdot[..., :3], qdot[..., 3:]
    J, mass = model.inertia.astype(LongDouble), model.mass.astype(LongDouble)[:, None]
    A, G = _euler_parameter_rotation(p), 2 * _body_rate_matrix(p)
    omega = _times(G, pdot)
    gravity, world_rate = mass * model.gravity.astype(LongDouble), _times(A, omega)
    drag = model.drag_force.astype(LongDouble)[:, None] * v
    torque = _times(A, np.broadcast_to(model.moment.astype(LongDouble), omega.shape))
    torque = torque - model.drag_moment.astype(LongDouble)[:, None] * world_rate
    transpose = np.swapaxes(G, -1, -2)
    gyroscopic = _times(transpose, _cross(omega, _times(J, omega)))
    applied = 2 * _times(np.swapaxes(_world_rate_matrix(p), -1, -2), torque)
    terms = [
        (mass * qddot[..., :3], _times(transpose, _times(J, _times(G, qddot[..., 3:])))),
        (drag - model.force.astype(LongDouble) - gravity, gyroscopic - applied),
    ]
    near, far = model.proximal.astype(LongDouble), model.distal.astype(LongDouble)
    d, ddot = _joint_differences(A, r, v, omega, near, far)
    rods, length = model.rods, model.length.astype(LongDouble)[:, None]
    distance = np.sqrt(np.sum(d * d, -1, keepdims=True))
    along = d / np.where(rods[:, None], distance, LongDouble(1))
    F = np.where(rods[:, None], along * multipliers[..., :1], multipliers[..., :3])
    below = np.concatenate([F[..., 1:, :], np.zeros_like(F[..., :1, :])], -2)

    def pushed(s: Array, force: Array) -> Array:
        """(−A s̃ G)ᵀ F."""
        return _times(transpose, _cross(s, _times(np.swapaxes(A, -1, -2), force)))

    terms.append((F - below, pushed(near, F) - pushed(far, below) + 2 * p * multipliers[..., 3:]))
    if method.constraint_level == "position":
        gaps = np.where(rods[:, None], distance - length, d)
        norms = np.sum(p * p, -1, keepdims=True) - 1
    else:
        gaps = np.where(rods[:, None], np.sum(along * ddot, -1, keepdims=True), ddot)
        norms = 2 * np.sum(p * pdot, -1, keepdims=True)
    gaps = np.where(rods[:, None] & (np.arange(3) > 0), LongDouble(0), gaps)

    def norm(*parts: Any) -> Array:
        return np.asarray(np.sqrt(sum(np.sum(part**2, axis=(-2, -1)) for part in parts)), float)

    sums = [sum(term[i] for term in terms) for i in range(2)]
    lengths = np.abs(r).max(-1, keepdims=True) + np.abs(near).max() + np.abs(far).max() + length
    sizes = [np.sqrt(sum(term[i] ** 2 for term in terms)) for i in range(2)]
    return ConstrainedResidual(
        residual=norm(*sums, gaps, norms),
        first_residual=norm(*terms[1]),
        size=norm(*sizes, np.broadcast_to(lengths, r[..., :1].shape)),
    )


def first_coordinate_acceleration(model: Model, state: State) -> Array:
    """Compute q̈ of q = (r, p) at a state, p̈ = ½ L(p)ᵀ ω̇′ + ½ L(ṗ)ᵀ ω′.

    Args:
        model: the mechanism.
        state: a state of it.

    Returns:
        (N, 7) m/s² and 1/s², extended precision.

    """
    chain = _LinkChain(model, 1.0)
    p, omega = chain.attitudes([state])
    A = _rotation(p)
    alpha, tip, centre = chain.acceleration(A, omega), _times(A, chain.tip), _times(A, chain.centre)

    def swing(s: Array) -> Array:
        return _cross(alpha, s) + _cross(omega, _cross(omega, s))

    b = chain.of_body
    acceleration = (_prefix_sum(swing(tip)) + swing(centre))[0, b]
    q, rates, turning = (x[0, b] for x in (p, _times(np.swapaxes(A, -1, -2), omega), alpha))
    body_turning = _times(np.swapaxes(A[0, b], -1, -2), turning)

    def rate(q: Array, w: Array) -> Array:
        return quaternion_product(q, np.concatenate([np.zeros_like(w[..., :1]), w], -1)) / 2

    return np.concatenate([acceleration, rate(q, body_turning) + rate(rate(q, rates), rates)], -1)


def first_acceleration_bound(model: Model, method: ConstrainedMethod, state: State) -> Array:
    """Bound what the engine's finite differences of C(q) q̇ leave in its first q̈.

    It solves M q̈ + Cᵀ λ = f, C q̈ = γ = −∂(C q̇)/∂q q̇, with the derivative from forward differences of size δ.
    C q̇ and q + δ are rounded, so a row of γ is off by up to

        32 · 2⁻⁵³ (|C| |q̇|) √(Σ q̇ᵢ²) / δ,   over the coordinates i that this row of C depends on,

    which are the Euler parameters and, of rods, the positions.  q̈ is off by |S⁻¹| times that.  What δ cuts
    off is below the roundings.

    Args:
        model: the chain.
        method: whose ``difference_step`` is δ.
        state: where the step starts.

    Returns:
        (N,) largest error of a coordinate of each body [m/s² or 1/s²].

    """
    n, r, p = model.n, state.r, state.p
    A, G = _euler_parameter_rotation(p), 2 * _body_rate_matrix(p)
    rates = np.concatenate([state.v, 0.25 * _times(np.swapaxes(G, -1, -2), state.omega)], -1).ravel()
    near, far = model.proximal, model.distal
    d, _ = _joint_differences(A, r, state.v, state.omega, near, far)
    M, rows, depends = np.zeros((7 * n, 7 * n)), [], []
    for k in range(n):
        positions, turns = slice(7 * k, 7 * k + 3), slice(7 * k + 3, 7 * k + 7)
        M[positions, positions], M[turns, turns] = model.mass[k] * np.eye(3), G[k].T @ model.inertia[k] @ G[k]
        point, norm = np.zeros((3, 7 * n)), np.zeros((1, 7 * n))
        point[:, positions], point[:, turns] = np.eye(3), -A[k] @ _cross_matrix(near[k]) @ G[k]
        if k:
            point[:, 7 * k - 7 : 7 * k - 4] = -np.eye(3)
            point[:, 7 * k - 4 : 7 * k] = A[k - 1] @ _cross_matrix(far[k - 1]) @ G[k - 1]
        norm[0, turns] = 2 * p[k]
        joint = _unit(d[k])[None] @ point if model.rods[k] else point
        rows += [joint, norm]
        depends += [np.abs(row) > 0 for row in (joint, norm)]
        if not model.rods[k]:
            depends[-2][:, np.arange(7 * n) % 7 < 3] = False
    C, used = np.concatenate(rows), np.concatenate(depends)
    S = np.block([[M, C.T], [C, np.zeros((len(C), len(C)))]])
    gamma = 32 * 2.0**-53 * (np.abs(C) @ np.abs(rates)) * np.sqrt(used @ rates**2) / method.difference_step
    error = np.abs(np.linalg.inv(S)[: 7 * n, 7 * n :]) @ gamma
    return np.asarray(np.max(error.reshape(n, 7), axis=1))


def _joint_differences(
    A: Array, r: Array, v: Array, omega: Array, near: Array, far: Array
) -> tuple[Array, Array]:
    """Vectors (T, N, 3) from where each joint hangs to the body's proximal point, and their rates."""

    def point(s: Array) -> tuple[Array, Array]:
        arms = np.broadcast_to(s, r.shape)
        return r + _times(A, arms), v + _times(A, _cross(omega, arms))

    (here, here_v), (there, there_v) = point(near), point(far)
    return here - _before(there), here_v - _before(there_v)


def _euler_parameter_rotation(p: Array) -> Array:
    """A(p) with the diagonal 1 − 2 (y² + z²), …: a rotation only where |p| = 1."""
    w, x, y, z = np.moveaxis(p, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _body_rate_matrix(p: Array) -> Array:
    """L(p) (..., 3, 4): ω′ = 2 L(p) ṗ."""
    w, x, y, z = np.moveaxis(p, -1, 0)
    rows = [[-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _world_rate_matrix(p: Array) -> Array:
    """E(p) (..., 3, 4): ω = 2 E(p) ṗ."""
    w, x, y, z = np.moveaxis(p, -1, 0)
    rows = [[-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


# -- algebra in extended precision -------------------------------------------------------------------


def _cross_matrix(s: Array) -> Array:
    """s̃ in the precision of s."""
    x, y, z = np.moveaxis(s, -1, 0)
    o = np.zeros_like(x)
    rows = [[o, -z, y], [z, o, -x], [-y, x, o]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _times(A: Array, v: Array) -> Array:
    """A v of matrices (..., m, n) and vectors (..., n)."""
    return np.asarray(np.sum(A * v[..., None, :], axis=-1))


def _cross(a: Array, b: Array) -> Array:
    a, b = np.broadcast_arrays(a, b)
    i, j = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[..., i] * b[..., j] - a[..., j] * b[..., i])


def _before(x: Array) -> Array:
    """Value (..., n, 3) at the link before each link, 0 at the pivot."""
    return np.concatenate([np.zeros_like(x[..., :1, :]), x[..., :-1, :]], -2)


def _prefix_sum(x: Array) -> Array:
    """Sum (..., n, 3) over the links before each link."""
    return _before(np.cumsum(x, axis=-2))


def _suffix_sum(x: Array) -> Array:
    """Sum (..., n, 3) over the links beyond each link."""
    return np.asarray(np.cumsum(x[..., ::-1, :], axis=-2)[..., ::-1, :] - x)


def _unit(x: Array) -> Array:
    return np.asarray(x / np.sqrt(np.sum(x * x, -1, keepdims=True)))


def _rotation(p: Array) -> Array:
    return _euler_parameter_rotation(_unit(p))


def _exponential(t: Array) -> Array:
    """Quaternions (..., 4) of rotation vectors (..., 3)."""
    half = np.sqrt(np.sum(t * t, -1, keepdims=True)) / 2
    small = half < 1e-5
    ratio = np.where(small, 1 - half**2 / 6, np.sin(half) / np.where(small, LongDouble(1), half))
    return np.concatenate([np.cos(half), ratio * t / 2], -1)


def _turn_of_z(u: Array) -> Array:
    """Unit quaternions (..., 4) that turn z into u; half turns about z + u or, if u points down, near it."""
    x, y, z = np.moveaxis(u, -1, 0)
    o = np.zeros_like(x)
    up, down = np.stack([1 + z, -y, x, o], -1), np.stack([-y, 1 - z, o, x], -1)
    return _unit(np.where((z >= 0)[..., None], up, down))


def _solve(S: Array, b: Array) -> Array:
    """Solve S x = b (..., n) without pivoting: the symmetric part of S is positive definite."""
    S, b = S.copy(), b.copy()
    n = S.shape[-1]
    for k in range(n - 1):
        factor = S[..., k + 1 :, k] / S[..., k, k, None]
        S[..., k + 1 :, k + 1 :] -= factor[..., None] * S[..., k, None, k + 1 :]
        b[..., k + 1 :] -= factor * b[..., k, None]
    for k in reversed(range(n)):
        b[..., k] = (b[..., k] - np.sum(S[..., k, k + 1 :] * b[..., k + 1 :], -1)) / S[..., k, k]
    return b


def _solve3(a: Array, b: Array, c: Array, x: Array) -> Array:
    """Coefficients (..., 3) of x in three vectors: Cramer's rule."""
    bc = _cross(b, c)
    parts = [np.sum(x * bc, -1), np.sum(x * _cross(c, a), -1), np.sum(x * _cross(a, b), -1)]
    return np.asarray(np.stack(parts, -1) / np.sum(a * bc, -1)[..., None])
