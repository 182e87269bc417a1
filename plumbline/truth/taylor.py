"""Motion by heyoka's adaptive Taylor method in minimal coordinates, in double, extended or quad precision.

Coordinates per body: the quaternion p, ω′, and for a rod u, u̇ (world frame).  The joint forces come from the
block elimination described in `certified_state`, written as expressions in the coordinates; no constraint is
integrated, so nothing drifts.  Mechanisms with other joints have the equations of `taylor_tree`; loops are
held by accelerations there, and drift by rounding.  One compiled integrator serves every model with the same
sequence of joints: the numbers of the model enter as parameters, which also keeps double-precision constants
out of the quad model.  Vectors (3,) and matrices (3, 3) of expressions are NumPy arrays of objects.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from plumbline.model.datatypes import Array, EngineFailure, Model, State
from plumbline.model.kinematics import forward_kinematics
from plumbline.model.loops import cut_open
from plumbline.processes.processor import processor_features
from plumbline.processes.user_cache import content_key, recall, remember
from plumbline.truth import import_truth_tool, taylor_tree
from plumbline.truth.taylor_tree import Closure, Topology, rotation_matrix, vector

Precision = Literal["double", "extended", "quad", "octuple"]
OCTUPLE_BITS, OCTUPLE_DIGITS = 237, 75
_Joints = tuple[bool, ...] | Topology  # of a chain whether each joint is a rod


@dataclass(frozen=True, eq=False)
class MinimalCoordinateRun:
    """A motion in minimal coordinates; arrays hold numbers of the precision's own type."""

    t: Array  # (T,) s
    p: Any  # (T, N, 4)
    omega: Any  # (T, N, 3) rad/s, body frame
    u: Any  # (T, N, 3), world frame; 0 for ball joints
    udot: Any  # (T, N, 3) 1/s, world frame
    r: Any  # (T, N, 3) m, world frame, computed from the coordinates in the same precision
    v: Any  # (T, N, 3) m/s, world frame
    steps: int


def simulate_taylor(
    model: Model, state: State, times: Array, precision: Precision = "extended"
) -> MinimalCoordinateRun:
    """Integrate the motion from a state.

    Args:
        state: initial state, of which the minimal coordinates are used, normalised in that precision.
        times: (T,) [s] of the samples, times[0] = 0.

    Returns:
        The motion at ``times``.

    Raises:
        TruthUnavailable: heyoka (Linux only) or mpmath is not installed.
        EngineFailure: a step fails, as where a ball joint with a spring comes to half a turn and its moment
            jumps, or heyoka was built without quad precision.

    """
    if model.has_loops:
        cut = cut_open(model)
        there, bodies = cut.state(state), cut.place[: model.n]
        run = _simulate(cut.model, there, times, precision, taylor_tree.closures(cut, there))
        names = ("p", "omega", "u", "udot", "r", "v")
        return replace(run, **{name: getattr(run, name)[:, bodies] for name in names})
    return _simulate(model, state, times, precision, ())


def _simulate(
    model: Model, state: State, times: Array, precision: Precision, closures: tuple[Closure, ...]
) -> MinimalCoordinateRun:
    """Integrate a tree, its loops closed."""
    integrator, number = _prepared_integrator(model, state, precision, closures=closures)
    outcome, _, _, steps, _, samples = integrator.propagate_grid([number(float(t)) for t in times])
    if "time_limit" not in str(outcome):
        raise EngineFailure(f"heyoka stopped: {outcome}")
    if not model.is_chain:
        return _tree_kinematics(model, times, samples, int(steps))
    proximal, distal = ([vector(map(number, s)) for s in x] for x in (model.proximal, model.distal))
    length = [number(x) for x in model.length]
    return _forward_kinematics(model, times, np.asarray(samples), proximal, distal, length, int(steps))


def taylor_series(
    model: Model, state: State, order: int, precision: Precision
) -> Generator[list[tuple[list[Any], bool]], list[Any], None]:
    """Expand the motion in Taylor series, each around the values that the caller sends.

    Args:
        state: initial state, of which the minimal coordinates are used.
        precision: "quad" or "octuple".

    Yields:
        Per coordinate its Taylor coefficients with respect to time, from the power 0 on, and whether it is a
        rate: p, u or r, and x of each body, then ω′, u̇ or ṙ, and ẋ of each body; numbers of mpmath.  The
        caller sends the values around which to expand next, in the same order.

    Raises:
        TruthUnavailable: heyoka (Linux only) or mpmath is not installed.
        EngineFailure: a step fails, or heyoka was built without that precision.

    """
    mp = import_truth_tool("mpmath")
    integrator, number = _prepared_integrator(model, state, precision, order)
    places = _positions_then_rates(model)
    while True:
        outcome, _ = integrator.step(number(2.0**-30), write_tc=True)  # the caller makes the step
        if outcome.name not in ("success", "time_limit"):
            raise EngineFailure(f"heyoka stopped: {outcome}")
        values = yield [([mp.mpf(str(c)) for c in integrator.tc[i]], is_rate) for i, is_rate in places]
        for (i, _), value in zip(places, values, strict=True):
            integrator.state[i] = number(value)


def _positions_then_rates(model: Model) -> list[tuple[int, bool]]:
    """Places in heyoka's state of p, u or r, x of all bodies, then of rates, and whether each is one."""
    q: list[int] = []
    v: list[int] = []
    springs = taylor_tree.topology(model).ball_springs
    first, last = 0, sum(size for kind in model.kind for _, size in taylor_tree.coordinate_names(kind))
    for k, kind in enumerate(model.kind):
        own: dict[str, list[int]] = {}
        for name, size in taylor_tree.coordinate_names(kind):
            own[name] = [*range(first, first + size)]
            first += size
        if k in springs:
            own["turn"] = [last, last + 1]
            last += 2
        q += [i for name in ("p", "u", "r", "x", "turn") for i in own.get(name, [])]
        v += [i for name in ("omega", "udot", "v", "xdot") for i in own.get(name, [])]
    return [(i, False) for i in q] + [(i, True) for i in v]


@cache
def load_heyoka() -> Any:
    """Import heyoka without SymPy, which it would load for conversions that are not used here (2 s).

    One thread, as in every worker; no cache of heyoka's own on disk: `_compiled_integrator` has one.

    Raises:
        TruthUnavailable: heyoka is not installed.

    """
    hidden = sys.modules.setdefault("sympy", None) is None  # type: ignore[arg-type]
    try:
        hy = import_truth_tool("heyoka")
    finally:
        if hidden:
            del sys.modules["sympy"]
    hy.set_nthreads(1)
    hy.llvm_state.set_diskcache_enabled(False)
    return hy


def _prepared_integrator(
    model: Model,
    state: State,
    precision: Precision,
    order: int | None = None,
    closures: tuple[Closure, ...] = (),
) -> tuple[Any, Callable[[Any], Any]]:
    """The integrator of a model at time 0 in a state, and the conversion to its numbers."""
    mp, number = import_truth_tool("mpmath"), _number_conversion(precision)
    joints: _Joints = taylor_tree.topology(model)._replace(closures=closures)
    parameters, values = taylor_tree.parameter_values, taylor_tree.initial_values
    if model.is_chain:
        joints = tuple(bool(rod) for rod in model.rods)
        parameters, values = _parameter_values, _initial_values
    integrator = _compiled_integrator(joints, model.has_drag, precision, order)
    with mp.workdps(100):
        used = len(integrator.pars)  # up to the last parameter that appears in the equations
        integrator.pars[:] = [number(x) for x in parameters(mp, model)[:used]]
        integrator.state[:] = [number(x) for x in values(mp, model, state)]
    integrator.time = number(0.0)
    return integrator, number


def _number_conversion(precision: Precision) -> Callable[[Any], Any]:
    """The map from numbers of mpmath or Python to those of the integrator."""
    hy, mp = load_heyoka(), import_truth_tool("mpmath")
    if precision == "double":
        return float
    if precision == "quad" and not hasattr(hy, "real128"):
        raise EngineFailure("this heyoka has no quad precision")
    if precision == "octuple" and not hasattr(hy, "real"):
        raise EngineFailure("this heyoka has no multiprecision numbers")

    def number(x: Any) -> Any:
        with mp.workdps(100):
            text = mp.nstr(mp.mpf(x), OCTUPLE_DIGITS if precision == "octuple" else 40)
        if precision == "octuple":
            return hy.real(text, OCTUPLE_BITS)
        return np.longdouble(text) if precision == "extended" else hy.real128(text)

    return number


def _initial_values(mp: Any, model: Model, state: State) -> list[Any]:
    """Coordinates in the order of `_equations_of_motion`, normalised in mpmath's precision."""
    values: list[Any] = []
    for k in range(model.n):
        p, omega, u, udot = (mp.matrix(x[k].tolist()) for x in (state.p, state.omega, state.u, state.udot))
        if model.rods[k]:
            u /= mp.norm(u)
            udot -= u * (u.T * udot)[0]
            values += [*u, *udot]
        values += [*(p / mp.norm(p)), *omega]
    return values


def _parameter_values(mp: Any, model: Model) -> list[Any]:
    """Numbers of the model in the order of `_Body`: gravity, then per body."""
    values: list[Any] = model.gravity.tolist()
    for k in range(model.n):
        m, J = mp.mpf(float(model.mass[k])), mp.matrix(model.inertia[k].tolist())
        J_inverse = J**-1
        sp, sd = (_cross_matrix(mp, s[k]) for s in (model.proximal, model.distal))
        values += [*J, *J_inverse]
        for a, b in ((sp, sp), (sp, sd), (sd, sd)):
            values += [*(mp.eye(3) / m - a * J_inverse * b)]
        values += [*model.proximal[k].tolist(), *model.distal[k].tolist(), 1 / m]
        values += [*(mp.matrix(model.force[k].tolist()) / m), *model.moment[k].tolist()]
        values += [float(model.length[k]), float(model.drag_force[k]) / m, float(model.drag_moment[k])]
    return values


def _cross_matrix(mp: Any, s: Array) -> Any:
    x, y, z = (mp.mpf(float(c)) for c in s)
    return mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@cache
def _compiled_integrator(joints: _Joints, drag: bool, precision: Precision, order: int | None = None) -> Any:
    """The Taylor integrator of a mechanism with these joints; order None: the precision's own.

    It is remembered with its machine code: to read it takes a third to a quarter of the time of compiling it.
    """
    hy = load_heyoka()
    code = b"".join(Path(file).read_bytes() for file in (__file__, taylor_tree.__file__))
    key = content_key(
        "Taylor", code, hy.__version__, processor_features(), repr((joints, drag, precision, order))
    )
    integrator = recall(key, lambda found: hasattr(found, "propagate_grid"))
    if integrator is None:
        integrator = _compile_integrator(hy, joints, drag, precision, order)
        remember(key, integrator)
    return integrator


def _compile_integrator(hy: Any, joints: _Joints, drag: bool, precision: Precision, order: int | None) -> Any:
    if isinstance(joints, Topology):
        system = taylor_tree.equations_of_motion(hy, joints)
    else:
        system = _equations_of_motion(hy, joints, drag)
    number = _number_conversion(precision)
    zero = number(0.0)
    # Unoptimised code takes two to three times as long to run and a tenth of the time to compile: for ten
    # bodies 0.4 s, where optimising takes 3 … 6 s and saves 0.4 s of a run of 2 s in double, 1 s in extended.
    # heyoka's order is 1 − ½ ln tol
    options = {} if order is None else {"tol": number(math.exp(2 - 2 * order))}
    return hy.taylor_adaptive(
        system, [zero] * len(system), fp_type=type(zero), compact_mode=True, opt_level=0, **options
    )


# --- equations of motion as expressions -----------------------------------------------------------


class _Body:
    """Parameters (in the order of `_parameter_values`) and coordinates of one body as expressions."""

    def __init__(self, hy: Any, k: int, first_parameter: int) -> None:
        self.next_parameter, self.hy = first_parameter, hy
        self.J, self.J_inverse, self.Ypp, self.Ypd, self.Ydd = (self.take(9).reshape(3, 3) for _ in range(5))
        self.sp, self.sd, (self.inverse_mass,) = self.take(3), self.take(3), self.take(1)
        self.force_per_mass, self.moment = self.take(3), self.take(3)
        self.length, self.drag_force_per_mass, self.drag_moment = self.take(3)
        self.p, self.w, self.u, self.udot = (
            vector(hy.make_vars(*(f"{name}{i}_{k}" for i in range(size))))
            for name, size in (("p", 4), ("w", 3), ("u", 3), ("d", 3))
        )
        self.A = rotation_matrix(self.p)

    def take(self, count: int) -> Any:
        self.next_parameter += count
        return vector(self.hy.par[i] for i in range(self.next_parameter - count, self.next_parameter))

    def centripetal(self, s: Any) -> Any:
        """ω′ × (ω′ × s) (3,), body frame."""
        return np.cross(self.w, np.cross(self.w, s))

    def point_acceleration(self, at_force: Any, at_below: Any, free: Any, force: Any, below: Any) -> Any:
        """Acceleration of a point (3,): free motion, the proximal force, minus the force passed on below.

        ``at_force`` and ``at_below`` are the mobilities of the point for the two forces, body frame.
        """
        pulled = at_force @ (self.A.T @ force)
        if below is not None:
            pulled = pulled - at_below @ (self.A.T @ below)
        return free + self.A @ pulled


def _equations_of_motion(hy: Any, rods: tuple[bool, ...], drag: bool) -> list[tuple[Any, Any]]:
    """Pairs (coordinate, its rate) of the chain."""
    bodies: list[_Body] = []
    for k in range(len(rods)):
        bodies.append(_Body(hy, k, bodies[-1].next_parameter if bodies else 3))
    turn, near_a, far_a = _free_accelerations(hy, rods, drag, bodies)
    F = [*_joint_forces(rods, bodies, near_a, far_a), None]
    system: list[tuple[Any, Any]] = []
    hanging_point: Any = None  # acceleration of the distal point above
    for k, body in enumerate(bodies):
        couple = np.cross(body.sp, body.A.T @ F[k])
        if F[k + 1] is not None:
            couple = couple - np.cross(body.sd, body.A.T @ F[k + 1])
        if rods[k]:  # ℓ ü is the acceleration of the rod's tip relative to its upper end
            near = body.point_acceleration(body.Ypp, body.Ypd, near_a[k], F[k], F[k + 1])
            relative = (near if hanging_point is None else near - hanging_point) / body.length
            # the part along u is −u̇² u for a unit vector; written so, ‖u‖ does not drift
            along = relative @ body.u + body.udot @ body.udot
            system += [*zip(body.u, body.udot, strict=True)]
            system += zip(body.udot, relative - along * body.u, strict=True)
        if k + 1 < len(rods) and rods[k + 1]:
            hanging_point = body.point_acceleration(body.Ypd.T, body.Ydd, far_a[k], F[k], F[k + 1])
        p0, p1, p2, p3 = body.p
        wx, wy, wz = 0.5 * body.w
        p_rate = [-p1 * wx - p2 * wy - p3 * wz, p0 * wx - p3 * wy + p2 * wz]
        p_rate += [p3 * wx + p0 * wy - p1 * wz, -p2 * wx + p1 * wy + p0 * wz]
        w_rate = turn[k] + body.J_inverse @ couple
        system += [*zip(body.p, p_rate, strict=True), *zip(body.w, w_rate, strict=True)]
    return system


def _free_accelerations(
    hy: Any, rods: tuple[bool, ...], drag: bool, bodies: list[_Body]
) -> tuple[list[Any], list[Any], list[Any]]:
    """Without joint forces: ω̇′ (body frame), accelerations of proximal and distal points (world frame)."""
    gravity = vector(hy.par[i] for i in range(3))
    turn: list[Any] = []
    near_a: list[Any] = []
    far_a: list[Any] = []
    v = vector([hy.expression(0.0)] * 3)
    for body, rod in zip(bodies, rods, strict=True):
        moment = body.moment - np.cross(body.w, body.J @ body.w)
        free = gravity + body.force_per_mass
        if drag:
            moment = moment - body.drag_moment * body.w
            if rod:
                v = v + body.length * body.udot
            v = v - body.A @ np.cross(body.w, body.sp)
            free = free - body.drag_force_per_mass * v
            v = v + body.A @ np.cross(body.w, body.sd)
        turn.append(body.J_inverse @ moment)
        for point, accelerations in ((body.sp, near_a), (body.sd, far_a)):
            inside = np.cross(turn[-1], point) + body.centripetal(point)
            accelerations.append(free + body.A @ inside)
    return turn, near_a, far_a


def _joint_forces(
    rods: tuple[bool, ...], bodies: list[_Body], near_a: list[Any], far_a: list[Any]
) -> list[Any]:
    """Force (3,) on each body at its proximal point, world frame, by block elimination along the chain."""
    solves: list[Callable[[Any], Any]] = []
    rhs: list[Any] = []
    off: list[Any] = []  # (above, here)
    directions = [body.u[:, None] if rod else None for body, rod in zip(bodies, rods, strict=True)]
    for k, body in enumerate(bodies):
        D, e, E = body.A @ body.Ypp @ body.A.T, -near_a[k], directions[k]
        if k:
            above = bodies[k - 1]
            D, e = D + above.A @ above.Ydd @ above.A.T, e + far_a[k - 1]
            coupling = -_project(directions[k - 1], above.A @ above.Ypd @ above.A.T, E)
        D = _project(E, D, E)
        if rods[k]:
            e = vector([body.u @ e - body.length * (body.udot @ body.udot)])
        if k:
            off.append(coupling)
            gain = np.stack([solves[-1](column) for column in coupling.T])
            D, e = D - gain @ coupling, e - gain @ rhs[-1]
        solves.append(_symmetric_solve(D))
        rhs.append(e)
    F: list[Any] = [None] * len(bodies)
    multiplier: Any = None
    for k in reversed(range(len(bodies))):
        multiplier = solves[k](rhs[k] if multiplier is None else rhs[k] - off[k] @ multiplier)
        F[k] = multiplier[0] * bodies[k].u if rods[k] else multiplier
    return F


def _project(E: Any, Y: Any, E2: Any) -> Any:
    """Eᵀ Y E2, where None stands for the identity."""
    if E is not None:
        Y = E.T @ Y
    return Y if E2 is None else Y @ E2


def _symmetric_solve(D: Any) -> Callable[[Any], Any]:
    """The map b → D⁻¹ b of a 1×1 or 3×3 symmetric positive definite D, by LDLᵀ."""
    if len(D) == 1:
        return lambda b: b / D[0, 0]
    d0 = D[0, 0]
    l10, l20 = D[1, 0] / d0, D[2, 0] / d0
    d1 = D[1, 1] - l10 * D[1, 0]
    c21 = D[2, 1] - l20 * D[1, 0]
    l21 = c21 / d1
    d2 = D[2, 2] - l20 * D[2, 0] - l21 * c21

    def solve(b: Any) -> Any:
        y1 = b[1] - l10 * b[0]
        y2 = b[2] - l20 * b[0] - l21 * y1
        x2 = y2 / d2
        x1 = y1 / d1 - l21 * x2
        return vector([b[0] / d0 - l10 * x1 - l20 * x2, x1, x2])

    return solve


def _forward_kinematics(
    model: Model, times: Array, y: Any, proximal: list[Any], distal: list[Any], length: list[Any], steps: int
) -> MinimalCoordinateRun:
    """Coordinates by name, and r, v from the pivot outwards, in the precision of y (T, coordinates)."""
    columns = iter(y.T)
    zero = y[:, 0] - y[:, 0]
    parts: dict[str, list[Any]] = {name: [] for name in ("p", "omega", "u", "udot", "r", "v")}
    tip = tip_v = vector([zero] * 3)
    for k in range(model.n):
        u, udot = (vector([next(columns) if model.rods[k] else zero for _ in range(3)]) for _ in range(2))
        p, w = vector(next(columns) for _ in range(4)), vector(next(columns) for _ in range(3))
        A = rotation_matrix(p)
        r = tip + u * length[k] - A @ proximal[k]
        v = tip_v + udot * length[k] - A @ np.cross(w, proximal[k])
        tip, tip_v = r + A @ distal[k], v + A @ np.cross(w, distal[k])
        for part, value in zip(parts.values(), (p, w, u, udot, r, v), strict=True):
            part.append(np.stack(list(value), 1))
    return MinimalCoordinateRun(t=times, steps=steps, **{name: np.stack(x, 1) for name, x in parts.items()})


def _tree_kinematics(model: Model, times: Array, samples: Any, steps: int) -> MinimalCoordinateRun:
    """Coordinates by name and what follows from them; in extended precision where the samples have more."""
    y = np.asarray(samples)
    if y.dtype not in (np.dtype(float), np.dtype(np.longdouble)):
        y = np.vectorize(lambda x: np.longdouble(str(x)), otypes=[np.longdouble])(y)
    shape = {"p": 4, "x": 2, "xdot": 2}
    names = ("p", "omega", "u", "udot", "r", "v", "x", "xdot")
    parts = {name: np.zeros((len(times), model.n, shape.get(name, 3)), y.dtype) for name in names}
    parts["p"][..., 0], at = 1, 0
    for k, kind in enumerate(model.kind):
        for name, size in taylor_tree.coordinate_names(kind):
            parts[name][:, k, :size] = y[:, at : at + size]
            at += size
    p, omega, r, v = forward_kinematics(model, *parts.values())
    return MinimalCoordinateRun(times, p, omega, parts["u"], parts["udot"], r, v, steps)
