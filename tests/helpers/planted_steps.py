"""Other time integrators, planted under the names of the declared ones: what the step level must report.

Every defect has the order of the method that it replaces, or nearly so: order, limit and drift of a
refinement study do not show it.  Accelerations, rotations and read-outs are the real engine's.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import mujoco
import numpy as np

from adapters import mujoco_engine, pinocchio_engine
from plumbline.model.datatypes import Array, Integrator, Model, State, Trajectory
from plumbline.model.kinematics import quaternion_rate
from tests.helpers.planting import Defect, replaced_by, run_as, run_with_clock

Coordinates = tuple[Array, Array]  # q, v
Step = Callable[[Any, Array, Array, float], Coordinates]  # system, q, v, h
Quadrature = Literal["", "a is the acceleration", "sign of alpha_m", "rates by Euler"]


class MujocoSystem:
    """MuJoCo's accelerations and rotations, for steps of our own."""

    def __init__(self, chain: Any) -> None:
        self.m, self.d = chain.m, chain.d

    def acceleration(self, q: Array, v: Array) -> Array:
        """v̇ (nv,) of a configuration (nq,) and a velocity (nv,)."""
        self.d.qpos, self.d.qvel = q, v
        mujoco.mj_forward(self.m, self.d)
        return np.array(self.d.qacc)

    def integrate(self, q: Array, displacement: Array) -> Array:
        """q ⊕ displacement."""
        moved = q.copy()
        mujoco.mj_integratePos(self.m, moved, displacement, 1.0)
        return moved

    def exponential_coordinate_rate(self, q: Array, theta: Array, v: Array) -> Array:
        """θ̇ (nv,) of joint-wise exponential coordinates."""
        return inverse_differential(theta, v)

    def mass_matrix(self) -> Array:
        """M (nv, nv) at the last configuration."""
        return mujoco_engine.full_mass_matrix(self.m, self.d)

    def quaternions(self, q: Array) -> Array:
        """The joints' quaternions (nj, 4), scalar first."""
        return q.reshape(-1, 4)

    def configuration(self, p: Array) -> Array:
        """The configuration of joint quaternions (nj, 4), scalar first."""
        return p.ravel()


def inverse_differential(theta: Array, v: Array, terms: int = 9) -> Array:
    """v + θ×v/2 + θ×(θ×v)/12 + …, joint by joint: ``terms`` after v (more than two: in full)."""
    t, w = theta.reshape(-1, 3), v.reshape(-1, 3)
    once = np.cross(t, w)
    twice = np.cross(t, once)
    angle = np.linalg.norm(t, axis=1, keepdims=True)
    half = np.where(angle > 1e-3, angle / 2, 1.0)
    full = np.where(angle > 1e-3, (1 - half / np.tan(half)) / (4 * half**2), 1 / 12 + angle**2 / 720)
    factor = (0.0, 0.0, 1 / 12)[terms] if terms < 3 else full
    return np.asarray(w + (terms > 0) * once / 2 + factor * twice).ravel()


# -- steps ---------------------------------------------------------------------------------------


def exchanged_halves(system: Any, q: Array, v: Array, h: float) -> Coordinates:
    """Positions first, by the old velocity; then velocities, by the new accelerations."""
    q = system.integrate(q, h * v)
    return q, v + h * system.acceleration(q, v)


def stale_velocity(system: Any, q: Array, v: Array, h: float) -> Coordinates:
    """Explicit Euler: positions by the old velocity."""
    return system.integrate(q, h * v), v + h * system.acceleration(q, v)


def mean_velocity(system: Any, q: Array, v: Array, h: float) -> Coordinates:
    """Positions by the mean of the old and the new velocity."""
    new = v + h * system.acceleration(q, v)
    return system.integrate(q, h * (v + new) / 2), new


def first_order_quaternion(system: Any, q: Array, v: Array, h: float) -> Coordinates:
    """Quaternions by p + h ṗ, normalised."""
    v = v + h * system.acceleration(q, v)
    p, w = system.quaternions(q), h * v.reshape(-1, 3) / 2
    turn = np.concatenate([np.ones((len(w), 1)), w], axis=1)
    scalar = p[:, :1] * turn[:, :1] - np.sum(p[:, 1:] * turn[:, 1:], 1, keepdims=True)
    vector = p[:, :1] * turn[:, 1:] + turn[:, :1] * p[:, 1:] + np.cross(p[:, 1:], turn[:, 1:])
    moved = np.concatenate([scalar, vector], axis=1)
    return system.configuration(moved / np.linalg.norm(moved, axis=1, keepdims=True)), v


def reused_acceleration(system: Any, q: Array, v: Array, h: float) -> Coordinates:
    """The classical method whose first slope is the last one of the step before, never computed again."""
    rate, a = v, getattr(system, "last", None)
    a = system.acceleration(q, v) if a is None else a
    slopes = [(rate, a)]
    for part in (0.5, 0.5, 1.0):
        theta, rate = part * h * slopes[-1][0], v + part * h * slopes[-1][1]
        moved = system.integrate(q, theta)
        slopes.append((inverse_differential(theta, rate), system.acceleration(moved, rate)))
    system.last = slopes[-1][1]
    theta, change = (h * (k[0] + 2 * k[1] + 2 * k[2] + k[3]) / 6 for k in zip(*slopes, strict=True))
    return system.integrate(q, theta), v + change


def two_half_steps(system: Any, q: Array, v: Array, h: float) -> Coordinates:
    """Two semi-implicit steps of half the size."""
    for _ in range(2):
        v = v + h / 2 * system.acceleration(q, v)
        q = system.integrate(q, h / 2 * v)
    return q, v


def velocity_verlet(system: Any, q: Array, v: Array, h: float) -> Coordinates:
    """Kick, drift, kick; the second kick by the accelerations at the half-way velocity."""
    half = v + h / 2 * system.acceleration(q, v)
    q = system.integrate(q, h * half)
    return q, half + h / 2 * system.acceleration(q, half)


def last_body_stale(system: Any, q: Array, v: Array, h: float) -> Coordinates:
    """The last joint's position by the old velocity, all others semi-implicitly."""
    new = v + h * system.acceleration(q, v)
    return system.integrate(q, h * np.concatenate([new[:-3], v[-3:]])), new


def runge_kutta(
    system: Any, q: Array, v: Array, h: float, a: tuple[tuple[float, ...], ...], b: tuple[float, ...],
    terms: int = 9,
) -> Coordinates:  # fmt: skip
    """An explicit Runge-Kutta step in exponential coordinates; ``terms`` of dexp⁻¹ after the identity."""
    k: list[Coordinates] = []
    for row in a:
        theta = sum((h * w * s[0] for w, s in zip(row, k, strict=True)), np.zeros_like(v))
        rate = sum((h * w * s[1] for w, s in zip(row, k, strict=True)), v)
        k.append(
            (inverse_differential(theta, rate, terms), system.acceleration(system.integrate(q, theta), rate))
        )
    theta = sum(h * w * s[0] for w, s in zip(b, k, strict=True))
    return system.integrate(q, theta), v + sum(h * w * s[1] for w, s in zip(b, k, strict=True))


CLASSICAL = ((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0))
WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
no_correction = partial(runge_kutta, a=CLASSICAL, b=WEIGHTS, terms=0)
one_term = partial(runge_kutta, a=CLASSICAL, b=WEIGHTS, terms=1)
third_by_first = partial(runge_kutta, a=((), (0.5,), (0.5, 0.0), (0.0, 0.0, 1.0)), b=WEIGHTS)
three_eighths = partial(
    runge_kutta, a=((), (1 / 3,), (-1 / 3, 1.0), (1.0, -1.0, 1.0)), b=(1 / 8, 3 / 8, 3 / 8, 1 / 8)
)
wrong_weights = partial(runge_kutta, a=CLASSICAL, b=(1 / 6, 2.001 / 6, 1.999 / 6, 1 / 6))


def implicit(
    system: Any, q: Array, v: Array, h: float,
    change: Callable[[Array], Array] = lambda D: D, moves_by_old: bool = False,
) -> Coordinates:  # fmt: skip
    """v + h (M + hD)⁻¹ M a with D = −∂(M a)/∂v altered; f is quadratic in v, so differences are exact."""
    a, M = system.acceleration(q, v), system.mass_matrix()
    columns = [
        M @ (system.acceleration(q, v - e) - system.acceleration(q, v + e)) / 2 for e in np.eye(len(v))
    ]
    new = v + h * np.linalg.solve(M + h * change(np.array(columns).T), M @ a)
    return system.integrate(q, h * (v if moves_by_old else new)), new


halved_damping = partial(implicit, change=lambda D: D / 2)
symmetric_damping = partial(implicit, change=lambda D: (D + D.T) / 2)
implicit_stale = partial(implicit, moves_by_old=True)

M, P, E, T = "mujoco", "pinocchio", "exudyn", "exudyn-tree"
EULERS = ((M, "Euler"), (M, "implicit"), (P, "semi-implicit-euler"))
RK4S = ((M, "RK4"), (P, "rkmk4"))

# -- planting ------------------------------------------------------------------------------------


def step_defect(name: str, engine: str, integrator: str, step: Step, expected: str = "") -> Defect:
    """A step that replaces the engine's own, on its accelerations and rotations."""
    defect = partial(Defect, name, expected, engine, integrator=integrator)
    if engine == M:
        return defect(run=_mujoco_run(step))
    steps = pinocchio_engine.FIXED_STEPS | {integrator: _pinocchio_step(step)}
    return defect(patch=replaced_by("adapters.pinocchio_engine:FIXED_STEPS", lambda _: steps))


def exudyn_defect(
    name: str, integrator: str, expected: str = "", solver_type: str = "",
    mechanism: str = "balls", quadrature: Quadrature = "", **settings: Any,
) -> Defect:  # fmt: skip
    """Other attributes of Exudyn's generalizedAlpha, another explicit solver, or samples requadrated."""

    def make(run_solver: Any) -> Any:
        def run(solver: Any, mbs: Any, options: Any, *more: Any, **names: Any) -> Any:
            import exudyn

            for attribute, value in settings.items():
                setattr(options.timeIntegration.generalizedAlpha, attribute, value)
            if solver_type:
                options.timeIntegration.solverType = getattr(exudyn.DynamicSolverType, solver_type)
            samples, clock = run_solver(solver, mbs, options, *more, **names)
            return (_requadrated(quadrature, samples, more[1]) if quadrature else samples), clock

        return run

    engine, module = (T, "exudyn_tree_engine") if solver_type else (E, "exudyn_engine")
    patch = replaced_by(f"adapters.{module}:run_solver", make)
    return Defect(name, expected, engine, mechanism, integrator=integrator, patch=patch)


def _mujoco_run(step: Step) -> Callable[..., Trajectory]:
    """The run of MuJoCo's model by another step."""

    def run(_: Any, model: Model, state: State, times: Array, __: Integrator, h: float) -> Trajectory:
        chain = mujoco_engine._MujocoChain(model)
        chain.set_state(state)
        system, rows = MujocoSystem(chain), [chain.sample()]
        q, v = np.array(chain.d.qpos), np.array(chain.d.qvel)
        for count in np.diff(np.rint(times / h).astype(int)):
            for _ in range(count):
                q, v = step(system, q, v, h)
            chain.d.qpos, chain.d.qvel = q, v
            rows.append(tuple(np.array(part) for part in chain.sample()))
        r, p, rdot, omega = (np.array(column) for column in zip(*rows, strict=True))
        return Trajectory(times, r, p, rdot, quaternion_rate(p, omega), round(times[-1] / h))

    return run


def _pinocchio_step(step: Step) -> Step:
    """The step on Pinocchio's system, whose quaternions are scalar last."""

    def wrapped(system: Any, q: Array, v: Array, h: float) -> Coordinates:
        system.quaternions = lambda q: np.roll(q.reshape(-1, 4), 1, axis=1)
        system.configuration = lambda p: np.roll(p, -1, axis=1).ravel()
        return step(system, q, v, h)

    return wrapped


def _requadrated(how: str, samples: list[Any], h: float) -> list[Any]:
    """Samples (q, q̇, q̈, …) of consecutive steps with q and q̇ by another formula from the same q̈."""
    rho = 0.9
    alpha_m, alpha_f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
    gamma = 0.5 + alpha_f - alpha_m
    beta = 0.25 * (gamma + 0.5) ** 2
    alpha_m *= -1 if how == "sign of alpha_m" else 1
    out, a = [samples[0]], samples[0][2]
    for q0, q1 in pairwise(samples):
        q, v = out[-1][0], out[-1][1]
        if how == "rates by Euler":
            out.append((q + h * v + h * h / 4 * (q0[2] + q1[2]), v + h * q1[2], *q1[2:]))
            continue
        new = ((1 - alpha_f) * q1[2] + alpha_f * q0[2] - alpha_m * a) / (1 - alpha_m)
        if how == "a is the acceleration":
            a, new = q0[2], q1[2]
        out.append((q + h * v + h * h * ((0.5 - beta) * a + beta * new),
                    v + h * ((1 - gamma) * a + gamma * new), *q1[2:]))  # fmt: skip
        a = new
    return out


STEP_DEFECTS = (
    *(
        step_defect(f"{name}-{engine}-{integrator}", engine, integrator, step, words)
        for engine, integrator in EULERS if integrator != "implicit"
        for name, step, words in (
            ("exchanged-halves", exchanged_halves, "exchanged the halves of semi-implicit Euler"),
            ("stale-velocity", stale_velocity, "explicit Euler's step"),
            ("mean-velocity", mean_velocity, "the mean of the old and the new velocity"),
            ("first-order-quaternion", first_order_quaternion, "quaternions by p + h ṗ"),
            ("two-half-steps", two_half_steps, "2 steps of 1/2 of the size"),
            ("last-joint-stale", last_body_stale, "the joint of body 2 by the old velocity"),
            ("verlet", velocity_verlet, "velocity Verlet's step"),
        )
    ),
    *(
        step_defect(f"{name}-{engine}", engine, integrator, step, words)
        for engine, integrator in RK4S
        for name, step, words in (
            ("no-dexp", no_correction, "left dexp⁻¹ out"),
            ("one-dexp-term", one_term, "cut dexp⁻¹ after θ×v/2"),
            ("third-stage-by-first", third_by_first, "third stage by the first slope"),
            ("reused-acceleration", reused_acceleration,
             "its declared step, with the last acceleration of the step before"),
            ("three-eighths-rule", three_eighths, "3/8 rule"),
            ("weights-2.001-1.999", wrong_weights, "weight of stage 2 were larger by 0.000166"),
        )
    ),
    *(
        Defect(name, words, engine, mechanism, loaded, integrator, run=run)
        for name, engine, mechanism, loaded, integrator, run, words in (
            ("implicit-is-euler", M, "balls", False, "implicit",
             run_as("Euler"), "semi-implicit Euler's step, with all forces explicit"),
            ("implicit-is-implicitfast", M, "rods", True, "implicit",
             run_as("implicitfast"), "with the drag implicit"),
            ("drag-explicit", M, "balls", True, "implicitfast",
             run_as("Euler"), "with all forces explicit"),
            ("drag-implicit", M, "balls", True, "Euler",
             run_as("implicitfast"), "with the drag implicit"),
            ("euler-is-rk4", M, "balls", False, "Euler",
             run_as("RK4"), "the classical Runge–Kutta method"),
            ("long-step-mujoco", M, "balls", False, "RK4",
             run_with_clock(1 + 1e-9), "a step 1.000000001 times as long"),
            ("long-step-tree", T, "balls", False, "RK44",
             run_with_clock(1 + 1e-9), "a step 1.000000001 times as long"),
        )
    ),
    step_defect("damping-halved", M, "implicit", halved_damping,
                "derivatives of forces in the matrix were 0.5 times as large"),
    step_defect("damping-symmetric", M, "implicit", symmetric_damping, "symmetrised the derivatives"),
    step_defect("implicit-stale", M, "implicit", implicit_stale, "positions by the old velocity"),
    exudyn_defect("tree-rk33", "RK44", "Heun's method of order 3", solver_type="RK33"),
    exudyn_defect("tree-rk67", "RK44", "Butcher's method of order 6", solver_type="RK67"),
    exudyn_defect("tree-verlet", "RK44",
                  "velocity Verlet's step, with the last acceleration of the step before",
                  solver_type="VelocityVerlet"),
    *(
        exudyn_defect(f"spectral-radius-{radius:.10g}", "generalized-alpha",
                      f"spectral radius {radius:.10g}", spectralRadius=radius)
        for radius in (0.8, 0.89, 0.900001)
    ),
    exudyn_defect("newmark-for-alpha", "generalized-alpha", "the trapezoidal rule", useNewmark=True),
    exudyn_defect("newmark-on-velocities", "generalized-alpha", "constraints on velocities", useNewmark=True,
                  useIndex2Constraints=True),
    exudyn_defect("alpha-acceleration", "generalized-alpha", "a were q̈", quadrature="a is the acceleration"),
    exudyn_defect("alpha-m-sign", "generalized-alpha", "αm had the opposite sign",
                  quadrature="sign of alpha_m"),
    exudyn_defect("trapezoidal-beta", "trapezoidal", "β were 0.1666", newmarkBeta=1 / 6),
    exudyn_defect("trapezoidal-gamma", "trapezoidal", "γ were 0.500001", newmarkGamma=0.5 + 1e-6),
    exudyn_defect("trapezoidal-index-3", "trapezoidal", "constraints on positions", mechanism="rods",
                  useIndex2Constraints=False),
    exudyn_defect("trapezoidal-is-alpha", "trapezoidal", "spectral radius 0.9 with constraints on positions",
                  useNewmark=False, useIndex2Constraints=False, spectralRadius=0.9),
    exudyn_defect("rates-by-euler", "trapezoidal", "γ were 1 ", quadrature="rates by Euler"),
    exudyn_defect("first-accelerations-zero", "trapezoidal", "first accelerations were 0", mechanism="rods",
                  computeInitialAccelerations=False),
    exudyn_defect("first-accelerations-zero-alpha", "generalized-alpha", "first accelerations were 0",
                  computeInitialAccelerations=False),
)  # fmt: skip
