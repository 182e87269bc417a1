"""Other time integrators, planted under the names of the declared ones: what the step level must report.

Every defect has the order of the method that it replaces, or nearly so: order, limit and drift of a
refinement study do not show it.  Accelerations, rotations and read-outs are the real engine's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any, Literal
from unittest.mock import patch

import mujoco
import numpy as np

from adapters import exudyn_engine, exudyn_tree_engine, mujoco_engine, pinocchio_engine
from plumbline.engines.adapter import Adapter
from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Array, Integrator, Model, State, Trajectory
from plumbline.model.kinematics import quaternion_rate

Step = Callable[[Any, Array, Array, float], tuple[Array, Array]]  # system, q, v, h -> q, v


@dataclass(frozen=True)
class StepDefect:
    """A wrong integrator: of step, integrator_used, settings and samples one is given."""

    name: str
    description: str
    engine: str
    integrator: str  # the name that it goes by
    joints: str = "balls"  # key of tests.helpers.pendulums.JOINT_PATTERNS
    has_drag: bool = False
    step: Step | None = None  # replaces the step, on the engine's accelerations and rotations
    integrator_used: str = ""  # another integrator of the same engine in its place
    step_factor: float = 1.0  # on the step size
    solver_type: str = ""  # another explicit solver of Exudyn
    settings: tuple[tuple[str, Any], ...] = ()  # attributes of Exudyn's generalizedAlpha
    quadrature: Literal["", "a is the acceleration", "sign of alpha_m", "rates by Euler"] = ""


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
        return mujoco_engine._full_mass_matrix(self.m, self.d)

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


def exchanged_halves(system: Any, q: Array, v: Array, h: float) -> tuple[Array, Array]:
    """Positions first, by the old velocity; then velocities, by the new accelerations."""
    q = system.integrate(q, h * v)
    return q, v + h * system.acceleration(q, v)


def stale_velocity(system: Any, q: Array, v: Array, h: float) -> tuple[Array, Array]:
    """Explicit Euler: positions by the old velocity."""
    return system.integrate(q, h * v), v + h * system.acceleration(q, v)


def mean_velocity(system: Any, q: Array, v: Array, h: float) -> tuple[Array, Array]:
    """Positions by the mean of the old and the new velocity."""
    new = v + h * system.acceleration(q, v)
    return system.integrate(q, h * (v + new) / 2), new


def first_order_quaternion(system: Any, q: Array, v: Array, h: float) -> tuple[Array, Array]:
    """Quaternions by p + h ṗ, normalised."""
    v = v + h * system.acceleration(q, v)
    p, w = system.quaternions(q), h * v.reshape(-1, 3) / 2
    turn = np.concatenate([np.ones((len(w), 1)), w], axis=1)
    scalar = p[:, :1] * turn[:, :1] - np.sum(p[:, 1:] * turn[:, 1:], 1, keepdims=True)
    vector = p[:, :1] * turn[:, 1:] + turn[:, :1] * p[:, 1:] + np.cross(p[:, 1:], turn[:, 1:])
    moved = np.concatenate([scalar, vector], axis=1)
    return system.configuration(moved / np.linalg.norm(moved, axis=1, keepdims=True)), v


def reused_acceleration(system: Any, q: Array, v: Array, h: float) -> tuple[Array, Array]:
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


def two_half_steps(system: Any, q: Array, v: Array, h: float) -> tuple[Array, Array]:
    """Two semi-implicit steps of half the size."""
    for _ in range(2):
        v = v + h / 2 * system.acceleration(q, v)
        q = system.integrate(q, h / 2 * v)
    return q, v


def velocity_verlet(system: Any, q: Array, v: Array, h: float) -> tuple[Array, Array]:
    """Kick, drift, kick; the second kick by the accelerations at the half-way velocity."""
    half = v + h / 2 * system.acceleration(q, v)
    q = system.integrate(q, h * half)
    return q, half + h / 2 * system.acceleration(q, half)


def last_body_stale(system: Any, q: Array, v: Array, h: float) -> tuple[Array, Array]:
    """The last joint's position by the old velocity, all others semi-implicitly."""
    new = v + h * system.acceleration(q, v)
    return system.integrate(q, h * np.concatenate([new[:-3], v[-3:]])), new


def runge_kutta(
    system: Any, q: Array, v: Array, h: float, a: tuple[tuple[float, ...], ...], b: tuple[float, ...],
    terms: int = 9,
) -> tuple[Array, Array]:  # fmt: skip
    """An explicit Runge-Kutta step in exponential coordinates; ``terms`` of dexp⁻¹ after the identity."""
    k: list[tuple[Array, Array]] = []
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
) -> tuple[Array, Array]:  # fmt: skip
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

STEP_DEFECTS = (
    *(
        StepDefect(f"{name}-{engine}-{integrator}", size, engine, integrator, step=step)
        for engine, integrator in EULERS if integrator != "implicit"
        for name, size, step in (
            ("exchanged-halves", "position first, then velocity", exchanged_halves),
            ("stale-velocity", "positions by the old velocity", stale_velocity),
            ("mean-velocity", "positions by the mean velocity", mean_velocity),
            ("first-order-quaternion", "p + h ṗ normalised", first_order_quaternion),
            ("two-half-steps", "two steps of h/2", two_half_steps),
            ("last-joint-stale", "stale velocity of the last joint only", last_body_stale),
            ("verlet", "velocity Verlet", velocity_verlet),
        )
    ),
    *(
        StepDefect(f"{name}-{engine}", size, engine, integrator, step=step)
        for engine, integrator in RK4S
        for name, size, step in (
            ("no-dexp", "θ̇ = v: order 2", no_correction),
            ("one-dexp-term", "θ̇ = v + θ×v/2", one_term),
            ("third-stage-by-first", "k₃ from k₁", third_by_first),
            ("reused-acceleration", "k₁ is k₄ of the step before", reused_acceleration),
            ("three-eighths-rule", "Kutta's 3/8 rule: order 4 too", three_eighths),
            ("weights-2.001-1.999", "weights 1, 2.001, 1.999, 1", wrong_weights),
        )
    ),
    StepDefect("implicit-is-euler", "no damping in the matrix", M, "implicit", integrator_used="Euler"),
    StepDefect("implicit-is-implicitfast", "D without Coriolis terms", M, "implicit", "rods", True,
               integrator_used="implicitfast"),
    StepDefect("damping-halved", "D/2", M, "implicit", step=halved_damping),
    StepDefect("damping-symmetric", "(D + Dᵀ)/2", M, "implicit", step=symmetric_damping),
    StepDefect("implicit-stale", "positions by the old velocity", M, "implicit", step=implicit_stale),
    StepDefect("drag-explicit", "drag by the old velocity", M, "implicitfast", has_drag=True,
               integrator_used="Euler"),
    StepDefect("drag-implicit", "drag by the new velocity", M, "Euler", has_drag=True,
               integrator_used="implicitfast"),
    StepDefect("euler-is-rk4", "a better method than declared", M, "Euler", integrator_used="RK4"),
    StepDefect("long-step-mujoco", "h (1 + 1e-9)", M, "RK4", step_factor=1 + 1e-9),
    StepDefect("long-step-tree", "h (1 + 1e-9)", T, "RK44", step_factor=1 + 1e-9),
    StepDefect("tree-rk33", "Heun's order 3", T, "RK44", solver_type="RK33"),
    StepDefect("tree-rk67", "order 6 in place of order 4", T, "RK44", solver_type="RK67"),
    StepDefect("tree-verlet", "velocity Verlet", T, "RK44", solver_type="VelocityVerlet"),
    *(
        StepDefect(f"spectral-radius-{radius:.10g}", f"ρ = {radius:.10g}", E, "generalized-alpha", joints,
                   settings=(("spectralRadius", radius),))
        for radius in (0.8, 0.89, 0.900001) for joints in ("balls",)
    ),
    StepDefect("newmark-for-alpha", "Newmark, index 3", E, "generalized-alpha",
               settings=(("useNewmark", True),)),
    StepDefect("newmark-on-velocities", "Newmark, index 2", E, "generalized-alpha",
               settings=(("useNewmark", True), ("useIndex2Constraints", True))),
    StepDefect("alpha-acceleration", "a = q̈ in place of the averaged a", E, "generalized-alpha",
               quadrature="a is the acceleration"),
    StepDefect("alpha-m-sign", "−αm in place of αm", E, "generalized-alpha", quadrature="sign of alpha_m"),
    StepDefect("trapezoidal-beta", "β = 1/6", E, "trapezoidal", settings=(("newmarkBeta", 1 / 6),)),
    StepDefect("trapezoidal-gamma", "γ = ½ + 1e-6", E, "trapezoidal",
               settings=(("newmarkGamma", 0.5 + 1e-6),)),
    StepDefect("trapezoidal-index-3", "constraints on positions", E, "trapezoidal", "rods",
               settings=(("useIndex2Constraints", False),)),
    StepDefect("trapezoidal-is-alpha", "generalised-α 0.9", E, "trapezoidal",
               settings=(("useNewmark", False), ("useIndex2Constraints", False), ("spectralRadius", 0.9))),
    StepDefect("rates-by-euler", "q̇₁ = q̇₀ + h q̈₁", E, "trapezoidal", quadrature="rates by Euler"),
    StepDefect("first-accelerations-zero", "q̈₀ = 0", E, "trapezoidal", "rods",
               settings=(("computeInitialAccelerations", False),)),
    StepDefect("first-accelerations-zero-alpha", "q̈₀ = 0", E, "generalized-alpha",
               settings=(("computeInitialAccelerations", False),)),
)  # fmt: skip


# What the diagnosis must say, by the beginning of a defect's name; of others, that nothing explains them.
STEP_NAMES = {
    "exchanged-halves": "exchanged the halves of semi-implicit Euler",
    "stale-velocity": "explicit Euler's step",
    "mean-velocity": "the mean of the old and the new velocity",
    "first-order-quaternion": "quaternions by p + h ṗ",
    "two-half-steps": "2 steps of 1/2 of the size",
    "last-joint-stale": "the joint of body 2 by the old velocity",
    "verlet": "velocity Verlet's step",
    "no-dexp": "left dexp⁻¹ out",
    "one-dexp-term": "cut dexp⁻¹ after θ×v/2",
    "reused-acceleration": "its declared step, with the last acceleration of the step before",
    "third-stage-by-first": "third stage by the first slope",
    "three-eighths-rule": "3/8 rule",
    "weights-2.001": "weight of stage 2 were larger by 0.000167",
    "implicit-is-euler": "semi-implicit Euler's step, with all forces explicit",
    "implicit-is-implicitfast": "with the drag implicit",
    "damping-halved": "derivatives of forces in the matrix were 0.5 times as large",
    "damping-symmetric": "symmetrised the derivatives",
    "implicit-stale": "positions by the old velocity",
    "drag-explicit": "with all forces explicit",
    "drag-implicit": "with the drag implicit",
    "euler-is-rk4": "the classical Runge–Kutta method",
    "long-step": "a step 1.000000001 times as long",
    "tree-verlet": "velocity Verlet's step, with the last acceleration of the step before",
    "tree-rk33": "Heun's method of order 3",
    "tree-rk67": "Butcher's method of order 6",
    "spectral-radius-0.8": "spectral radius 0.8",
    "spectral-radius-0.89": "spectral radius 0.89",
    "spectral-radius-0.900001": "spectral radius 0.900001",
    "newmark-for-alpha": "the trapezoidal rule",
    "newmark-on-velocities": "constraints on velocities",
    "alpha-acceleration": "a were q̈",
    "alpha-m-sign": "αm had the opposite sign",
    "trapezoidal-beta": "β were 0.1667",
    "trapezoidal-gamma": "γ were 0.500001",
    "trapezoidal-index-3": "constraints on positions",
    "trapezoidal-is-alpha": "spectral radius 0.9 with constraints on positions",
    "rates-by-euler": "γ were 1 ",
    "first-accelerations-zero": "first accelerations were 0",
}


def words_for(defect: StepDefect) -> str:
    """What the diagnosis must say about a defect; empty where no formula explains it."""
    found = [name for name in STEP_NAMES if defect.name.startswith(name)]
    return STEP_NAMES[max(found, key=len)] if found else ""


# -- planting ------------------------------------------------------------------------------------


@contextmanager
def planted_step(defect: StepDefect) -> Iterator[Adapter]:
    """The real adapter with a wrong integrator inside."""
    real = type(load_adapter(defect.engine))

    class Planted(real):  # type: ignore[misc, valid-type]
        def _simulate(
            self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
        ) -> Trajectory:
            if defect.engine == M and defect.step:
                return _mujoco_run(defect.step, model, state, times, resolution)
            if defect.integrator_used:
                integrator = replace(integrator, name=defect.integrator_used)
            factor = defect.step_factor
            run = super()._simulate(model, state, times * factor, integrator, resolution * factor)
            return replace(run, t=times)

    steps = pinocchio_engine.FIXED_STEPS
    if defect.engine == P and defect.step:
        steps = steps | {defect.integrator: _pinocchio_step(defect.step)}
    with (
        patch.object(pinocchio_engine, "FIXED_STEPS", steps),
        patch.object(exudyn_engine, "run_solver", partial(_run_altered, defect)),
        patch.object(exudyn_tree_engine, "run_solver", partial(_run_altered, defect)),
    ):
        yield Planted()


def _mujoco_run(step: Step, model: Model, state: State, times: Array, h: float) -> Trajectory:
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


def _pinocchio_step(step: Step) -> Step:
    """The step on Pinocchio's system, whose quaternions are scalar last."""

    def wrapped(system: Any, q: Array, v: Array, h: float) -> tuple[Array, Array]:
        system.quaternions = lambda q: np.roll(q.reshape(-1, 4), 1, axis=1)
        system.configuration = lambda p: np.roll(p, -1, axis=1).ravel()
        return step(system, q, v, h)

    return wrapped


def _run_altered(defect: StepDefect, solver: Any, mbs: Any, settings: Any, *more: Any, **names: Any) -> Any:
    """`run_solver` with other settings, or with samples from another quadrature of the same q̈."""
    import exudyn

    from adapters.exudyn_common import run_solver

    for name, value in defect.settings:
        setattr(settings.timeIntegration.generalizedAlpha, name, value)
    if defect.solver_type:
        settings.timeIntegration.solverType = getattr(exudyn.DynamicSolverType, defect.solver_type)
    samples = run_solver(solver, mbs, settings, *more, **names)
    return _requadrated(defect.quadrature, samples, more[1]) if defect.quadrature else samples


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
