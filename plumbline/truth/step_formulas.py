"""One step of a declared method, computed from its formula in extended precision (x87 long double).

Joint-space methods: the accelerations at the states that a step visits come from `step_charts`; nothing is
shared with an engine or the reference.
Constrained methods are not solved: their quadrature and their equations are evaluated at the engine's answer.
docs/integrators.md states every formula with its source.

Arrays have leading axes ``...`` for many states at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plumbline.model.datatypes import Model, State, StepRun
from plumbline.model.kinematics import (
    angular_velocity,
    complete_state,
    cross,
    cross_matrix,
    quaternion_conjugate,
    quaternion_product,
    quaternion_rate,
    rotate_vectors,
    stretched_length,
    velocity_jacobian,
    with_joint_coordinates,
)
from plumbline.model.step_methods import ConstrainedMethod, JointSpaceMethod
from plumbline.truth.step_charts import BodyStates, LongDouble, StepCharts

Array = NDArray[Any]  # in this module of extended precision, where nothing else is stated
Coordinates = list[Array]
MAX_EXTENDED_EPSILON = 1e-18  # of the numbers that formulas of steps need
POWER_ITERATIONS = 12
FIRST_ITERATE = 1.5  # of Newton's for |p|² = 1 from |p| = ½, over what is found in the end
HAS_EXTENDED_PRECISION = np.finfo(LongDouble).eps < MAX_EXTENDED_EPSILON


def joint_space_steps(
    model: Model,
    states: Sequence[State],
    steps: Sequence[float],
    method: JointSpaceMethod,
    count: int,
    angle_axes: Sequence[Array | None],
) -> list[BodyStates]:
    """Take steps of a declared method from each state, as `steps_in_charts`.

    Args:
        steps: the step [s] from each.
        angle_axes: for "joint angles", the axes (angles, 3) of the revolute joints at each state.

    """
    charts = (_ReusingCharts if method.reuses_acceleration else StepCharts)(model, method, states, angle_axes)
    return steps_in_charts(charts, *charts.start(), steps, count)


def steps_in_charts(
    tree: StepCharts, q: Coordinates, v: Array, steps: Sequence[float], count: int
) -> list[BodyStates]:
    """Take steps of the declared method from coordinates.

    Args:
        v: (B, nv).
        steps: B steps [s], or one.

    Returns:
        The motion (B, N, ·) after 0, 1, 2, …, ``count`` steps; not finite where a step leads into a
        singularity.

    """
    found = [tree.bodies(q, v)]
    for _ in range(count):
        q, v = coordinates_after(tree, q, v, steps)
        with np.errstate(all="ignore"):
            found.append(tree.bodies(q, v))
    return found


def coordinates_after(
    tree: StepCharts, q: Coordinates, v: Array, steps: Sequence[float]
) -> tuple[Coordinates, Array]:
    """Take one step of the declared method from coordinates.

    Args:
        v: (B, nv).
        steps: B steps [s], or one.

    Returns:
        q and v after it; not finite where it leads into a singularity.

    """
    method = tree.method
    h = np.array(steps, LongDouble)[:, None] * LongDouble(method.step_factor) / method.substeps
    with np.errstate(all="ignore"):
        for _ in range(method.substeps):
            tree.is_new_step = True
            q, v = _STEPS[method.formula](tree, q, v, h)
    return q, v * LongDouble(method.rate_factor)


def fastest_rates(model: Model, states: Sequence[State]) -> Array:
    """Estimate the spectral radius of the linearised equations of motion by power iteration.

    The growth over the second half of the iterations counts.

    Returns:
        (B,) [1/s].

    """
    system = StepCharts(model, JointSpaceMethod("Runge-Kutta", "joint rotations"), states)
    q, v = system.start()
    a = system.acceleration(q, v)
    rng = np.random.default_rng(0)
    theta, rate = rng.normal(size=(2, *v.shape)).astype(LongDouble)

    def size(theta: Array, rate: Array) -> Array:
        return np.asarray(np.sqrt(np.sum(theta * theta + rate * rate, axis=-1, keepdims=True)))

    tiny, growth = LongDouble(1e-7), []
    for _ in range(POWER_ITERATIONS):
        total = np.maximum(size(theta, rate), np.finfo(float).tiny)  # where no force depends on the motion
        theta, rate = tiny * theta / total, tiny * rate / total
        change = system.acceleration(system.move(q, theta), v + rate) - a
        # d/dt of a displacement in the moving frame: δθ̇ = δv − [v, θ]
        theta, rate = rate - system.bracket(v, theta), change
        growth.append(size(theta, rate) / tiny)
    with np.errstate(divide="ignore"):
        later = np.log(np.array(growth[POWER_ITERATIONS // 2 :], float))
    return np.asarray(np.exp(np.mean(later, axis=0)).ravel())


class _ReusingCharts(StepCharts):
    """A tree whose first acceleration in a step is the last one of the step before, at an older state."""

    last: Array | None = None

    def acceleration(self, q: Coordinates, v: Array) -> Array:
        if self.last is None or not self.is_new_step:
            self.last = super().acceleration(q, v)
        self.is_new_step = False
        return self.last


# -- steps -------------------------------------------------------------------------------------------


def _semi_implicit_euler(system: StepCharts, q: Coordinates, v: Array, h: Array) -> tuple[Coordinates, Array]:
    method = system.method
    if method.implicit_forces == "none":
        new = v + h * system.acceleration(q, v)
    else:
        new = v + h * system.damped_acceleration(q, v, h, method.implicit_forces)
    share = LongDouble(method.new_velocity_share)
    mover = share * new + (1 - share) * v
    if method.stale_joint is not None:
        own = system.own[method.stale_joint]
        mover[..., own] = v[..., own]
    return system.move(q, h * mover), new


def _positions_first(system: StepCharts, q: Coordinates, v: Array, h: Array) -> tuple[Coordinates, Array]:
    q = system.move(q, h * v)
    return q, v + h * system.acceleration(q, v)


def _velocity_verlet(system: StepCharts, q: Coordinates, v: Array, h: Array) -> tuple[Coordinates, Array]:
    a = system.acceleration(q, v)
    q = system.move(q, h * v + h * h * a / 2)
    return q, v + h / 2 * (a + system.acceleration(q, v + h / 2 * a))


def _runge_kutta(system: StepCharts, q: Coordinates, v: Array, h: Array) -> tuple[Coordinates, Array]:
    method, rates = system.method, list[Array]()
    accelerations = list[Array]()

    def weighted(weights: Sequence[float], values: list[Array]) -> Array:
        return sum(((h * LongDouble(w)) * x for w, x in zip(weights, values, strict=True)), np.zeros_like(v))

    for row in method.stages:
        if not any(row):  # at the start of the step
            rates.append(v)
            accelerations.append(system.acceleration(q, v))
            continue
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

    residual: Array  # (T,) 2-norm of M q̈ + Cᵀ λ − f and of the constraints, N and m or m/s; at least
    # (T,) of the terms, N and m or m/s: Newton's first residual has those of the step before, or of this one
    size: Array


def has_written_rows(model: Model) -> bool:
    """Whether `constrained_residual` has the rows of all joints off |p| = 1: those of bare rods and balls."""
    return not (model.has_joint_moments or model.has_loops or len(model.spring_body))


def constrained_residual(model: Model, method: ConstrainedMethod, run: StepRun) -> ConstrainedResidual:
    """Evaluate Exudyn's equations of rigid bodies with Euler parameters at its answers.

    They differ from textbook ones where |p| ≠ 1: A(p) = 1 − 2 (…), G = 2 L(p), M = diag(m, GᵀJG),
    f = −Gᵀ(ω′ × Jω′), a point's rows are [1, −A s̃ G], moments enter as (2E(p))ᵀ (A n′ − c_r A ω′).

    Args:
        method: whose constraint level and coordinates these are.
        run: T samples with accelerations and multipliers.

    Returns:
        The residuals at each sample but the first.

    """
    q, qdot, qddot = engine_coordinates(run)
    assert run.multipliers is not None
    multipliers = run.multipliers.astype(LongDouble)
    terms = _inertial_and_applied(model, q, qdot, qddot)
    C, gaps = _constraint_rows(model, q)
    used = np.ones((model.n, 4), bool)
    used[model.rods, 1:3] = False
    held = rotate_vectors(C.mT, multipliers[:, used])
    far, near = np.abs(model.point).max(axis=(0, 2))
    of_gaps = np.abs(q[..., :3]).max(-1) + far + near + model.length.astype(LongDouble)
    if method.constraint_level == "velocity":
        rates = qdot.reshape(len(qdot), -1)
        gaps, of_gaps = rotate_vectors(C, rates), rotate_vectors(np.abs(C), np.abs(rates))
    return ConstrainedResidual(
        residual=_norm(terms[0] + terms[1] + held, gaps)[1:],
        size=_sizes_of_steps(_inertial_sizes(model, q, qddot), terms[1], held, of_gaps),
    )


def projected_residual(model: Model, run: StepRun) -> ConstrainedResidual:
    """Evaluate the same equations along the motions of a tree's joints, which no joint's force resists.

    The joints have to be together: by constraints on positions they are, but for Newton's tolerance.

    Args:
        model: a tree without elements.
        run: T samples with accelerations.

    Returns:
        At each sample but the first the larger of Wᵀ (M q̈ − f) over |W|, W from the rates of the joints to q̇,
        and of how far the bodies are from where the joints' coordinates put them over what a gap of 1 in all
        joints would move them: the engine's residual is not less.

    """
    q, qdot, qddot = engine_coordinates(run)
    inertial, negative = _inertial_and_applied(model, q, qdot, qddot)
    sizes = _sizes_of_steps(_inertial_sizes(model, q, qddot), negative)
    q, t = q[1:], run.trajectory
    count = len(q)
    omega = angular_velocity(t.p[1:], t.pdot[1:])
    bodies = with_joint_coordinates(model, State(t.p[1:], omega, r=t.r[1:], v=t.v[1:]))
    twists = velocity_jacobian(model, bodies).reshape(count, model.n, 6, -1)
    there = complete_state(model, bodies)
    sign = np.where(np.sum(bodies.p * there.p, -1, keepdims=True) < 0, -1.0, 1.0)
    gaps = np.concatenate([bodies.r - there.r, bodies.p - sign * there.p], -1).reshape(count, -1)
    reach = model.n * (1 + float(np.sum(stretched_length(model))))
    turning = _body_rate_matrix(t.p[1:]).mT / 2 @ twists[..., 3:, :]
    rates = np.concatenate([twists[..., :3, :], turning], -2).reshape(count, 7 * model.n, -1)
    size = np.maximum(np.linalg.norm(rates, axis=(1, 2)), np.finfo(float).tiny)  # 0 of what is welded
    along = np.maximum(_norm(rotate_vectors(rates.mT, (inertial + negative)[1:])) / size, _norm(gaps) / reach)
    return ConstrainedResidual(residual=along, size=sizes)


def _inertial_and_applied(model: Model, q: Array, qdot: Array, qddot: Array) -> tuple[Array, Array]:
    """M q̈ and −f (T, 7N) of rigid bodies with Euler parameters, joints apart, as Exudyn writes them."""
    p, v, pdot = q[..., 3:], qdot[..., :3], qdot[..., 3:]
    J, mass = model.inertia.astype(LongDouble), model.mass.astype(LongDouble)[:, None]
    A, G = _euler_parameter_rotation(p), 2 * _body_rate_matrix(p)
    omega = rotate_vectors(G, pdot)
    gravity, world_rate = mass * model.gravity.astype(LongDouble), rotate_vectors(A, omega)
    drag = model.drag_force.astype(LongDouble)[:, None] * v
    torque = rotate_vectors(A, np.broadcast_to(model.moment.astype(LongDouble), omega.shape))
    torque = torque - model.drag_moment.astype(LongDouble)[:, None] * world_rate
    gyroscopic = rotate_vectors(G.mT, cross(omega, rotate_vectors(J, omega)))
    applied = 2 * rotate_vectors(_world_rate_matrix(p).mT, torque)
    turning = rotate_vectors(G.mT, rotate_vectors(J, rotate_vectors(G, qddot[..., 3:])))
    inertial = np.concatenate([mass * qddot[..., :3], turning], -1)
    negative = np.concatenate([drag - model.force.astype(LongDouble) - gravity, gyroscopic - applied], -1)
    return inertial.reshape(len(q), -1), negative.reshape(len(q), -1)


def _inertial_sizes(model: Model, q: Array, qddot: Array) -> Array:
    """Sizes (T, 2 N) of m r̈ and, with all of p̈, of 4 Lᵀ J L p̈, which leaves out what is along p.

    In generalised-α nothing but |p|² = 1 holds p̈ along p, which may alternate and grow.  An iteration that
    turns p finds it across, and its first step is (1 + |p|)/(2 |p|) times as long as it had to be.
    """
    inertia = 4 * np.linalg.norm(model.inertia, 2, axis=(1, 2))
    linear, turning = (np.sqrt(np.sum(x * x, -1)) for x in (qddot[..., :3], qddot[..., 3:]))
    turning = FIRST_ITERATE * turning * np.sum(q[..., 3:] ** 2, -1)
    return np.concatenate([model.mass * linear, inertia * turning], -1)


def _sizes_of_steps(*parts: Any) -> Array:
    """(T − 1,) sums of the norms of terms (T, ·), of each step the larger one of those at its ends."""
    size = np.sum([_norm(part) for part in parts], axis=0)
    return np.asarray(np.maximum(size[:-1], size[1:]))


def _norm(*parts: Any) -> Array:
    return np.asarray(np.sqrt(sum(np.sum(part**2, axis=-1) for part in parts)), float)


def first_coordinate_acceleration(model: Model, state: State) -> Array:
    """Compute q̈ of q = (r, p) at a state, p̈ = ½ L(p)ᵀ ω̇′ + ½ L(ṗ)ᵀ ω′.

    Returns:
        (N, 7) m/s² and 1/s², extended precision.

    """
    tree = StepCharts(model, JointSpaceMethod("Runge-Kutta", "joint rotations"), [state])
    (acceleration,), (turning,) = tree.body_accelerations()
    here = tree.bodies(*tree.start())
    p, omega = here.p[0], here.omega[0]
    pddot = quaternion_rate(p, turning) + quaternion_rate(quaternion_rate(p, omega), omega)
    return np.concatenate([acceleration, pddot], -1)


def first_acceleration_bound(model: Model, method: ConstrainedMethod, state: State) -> Array:
    """Bound what the engine's finite differences of C(q) q̇ leave in its first q̈.

    It solves M q̈ + Cᵀ λ = f, C q̈ = γ = −∂(C q̇)/∂q q̇, with the derivative from forward differences of size δ.
    C q̇ and the coordinates in it are rounded (in each of two values q + δ, an entry of A, A s and its sum
    with r), and the differences cut off second derivatives, so a row of γ is off by up to

        2⁻⁵³ (32 |C| |q̇| + 8 |∂(C q̇)/∂q| s) √(Σ q̇ᵢ²) / δ + Σ |∂²(C q̇)/∂qᵢ²| |q̇ᵢ| δ / 2

    over the coordinates i that this row of C depends on, which are the Euler parameters and, of rods, the
    positions.  sᵢ is 1 for Euler parameters, and for a position its size and that of the lever of its joints.
    q̈ is off by |S⁻¹| times that.

    Args:
        model: a tree on bare rods and balls.
        method: whose ``difference_step`` is δ.
        state: where the step starts.

    Returns:
        (N,) largest error of a coordinate of each body [m/s² or 1/s²].

    """
    n, q = model.n, np.concatenate([state.r, state.p], -1)
    G = 2 * _body_rate_matrix(state.p)
    rates = np.concatenate([state.v, 0.25 * rotate_vectors(G.mT, state.omega)], -1).ravel()
    M = np.zeros((7 * n, 7 * n))
    for k in range(n):
        positions, turns = slice(7 * k, 7 * k + 3), slice(7 * k + 3, 7 * k + 7)
        M[positions, positions], M[turns, turns] = model.mass[k] * np.eye(3), G[k].T @ model.inertia[k] @ G[k]
    levers, on_body = np.zeros(n), model.body >= 0
    np.add.at(levers, model.body[on_body], np.linalg.norm(model.point, axis=-1)[on_body])
    sizes = np.ones((n, 7))
    sizes[:, :3] = np.abs(state.r) + levers[:, None]
    # the derivatives vary over lengths and angles of order 1: exact to 1e-8
    h = 1e-4 * np.eye(7 * n).reshape(-1, n, 7)
    C = _constraint_rows(model, q)[0]
    after, before = (_constraint_rows(model, q + change)[0] @ rates for change in (h, -h))
    first, second = np.abs(after - before).T / 2e-4, np.abs(after - 2 * C @ rates + before).T / 1e-8
    S = np.block([[M, C.T], [C, np.zeros((len(C), len(C)))]])
    speed = np.sqrt(_dependence(model) @ rates**2)
    rounding = 2.0**-53 * (32 * np.abs(C) @ np.abs(rates) + 8 * first @ sizes.ravel())
    gamma = rounding * speed / method.difference_step + second @ np.abs(rates) * method.difference_step / 2
    error = np.abs(np.linalg.inv(S)[: 7 * n, 7 * n :]) @ gamma
    return np.asarray(np.max(error.reshape(n, 7), axis=1))


def _constraint_rows(model: Model, q: Array) -> tuple[Array, Array]:
    """C (..., rows, 7N) and the gaps (..., rows) of a tree on bare rods and balls at q (..., N, 7).

    Of each body in turn the rows of its joint, three or a rod's distance, and that of |p|².
    """
    r, p, n = q[..., :3], q[..., 3:], model.n
    A, G = _euler_parameter_rotation(p), 2 * _body_rate_matrix(p)
    rows, gaps = list[Array](), list[Array]()
    for k, (pair, points) in enumerate(zip(model.body, model.point.astype(q.dtype), strict=True)):
        point, norm = np.zeros((*q.shape[:-2], 3, n, 7), q.dtype), np.zeros((*q.shape[:-2], 1, n, 7), q.dtype)
        d = 0 * r[..., 0, :]
        for b, s, sign in zip(pair, points, (-1, 1), strict=True):
            if b >= 0:
                point[..., b, :3] = sign * np.eye(3)
                point[..., b, 3:] = -sign * A[..., b, :, :] @ cross_matrix(s) @ G[..., b, :, :]
            d = d + sign * (r[..., b, :] + A[..., b, :, :] @ s if b >= 0 else s)
        if model.rods[k]:
            distance = np.sqrt(np.sum(d * d, -1, keepdims=True))
            point = np.einsum("...i,...ijk->...jk", d / distance, point)[..., None, :, :]
            d = distance - model.length[k].astype(q.dtype)
        norm[..., 0, k, 3:] = 2 * p[..., k, :]
        rows += [point, norm]
        gaps += [d, np.sum(p[..., k, :] ** 2, -1, keepdims=True) - 1]
    C = np.concatenate(rows, -3)
    return C.reshape(*C.shape[:-2], -1), np.concatenate(gaps, -1)


def _dependence(model: Model) -> Array:
    """(rows, 7N) whether a row of C changes with a coordinate, also where it is 0 at a state."""
    blocks = []
    for k, pair in enumerate(model.body):
        joint, norm = np.zeros((2, model.n, 7), bool)
        joint[pair[pair >= 0], 0 if model.rods[k] else 3 :] = True
        norm[k, 3:] = True
        blocks += [joint.ravel()] * (1 if model.rods[k] else 3) + [norm.ravel()]
    return np.array(blocks)


def _euler_parameter_rotation(p: Array) -> Array:
    """A(p) with the diagonal 1 − 2 (y² + z²), …: a rotation only where |p| = 1."""
    excess = 1 - np.sum(p * p, -1)[..., None, None]
    return np.asarray(_world_rate_matrix(p) @ _body_rate_matrix(p).mT + excess * np.eye(3))


def _body_rate_matrix(p: Array) -> Array:
    """L(p) (..., 3, 4): ω′ = 2 L(p) ṗ."""
    return quaternion_product(quaternion_conjugate(p)[..., None, :], np.eye(4))[..., 1:].mT


def _world_rate_matrix(p: Array) -> Array:
    """E(p) (..., 3, 4): ω = 2 E(p) ṗ."""
    return quaternion_product(np.eye(4), quaternion_conjugate(p)[..., None, :])[..., 1:].mT
