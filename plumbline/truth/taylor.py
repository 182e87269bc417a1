"""Motion by heyoka's adaptive Taylor method in minimal coordinates, in double, extended or quad precision.

Coordinates per body: quaternion p, ω′, and for a rod u, u̇ (world).  The joint forces come from the
elimination of `certified`, as formulas in the coordinates; no constraint is integrated, so nothing drifts.
One compiled integrator serves every model with the same pattern of joints: numbers enter as parameters,
which also keeps double-precision constants out of the quad model.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np

from plumbline.model.datatypes import Array, EngineFailure, Model, State
from plumbline.truth import import_truth_tool

Precision = Literal["double", "extended", "quad"]


@dataclass(frozen=True, eq=False)
class MinimalCoordinateRun:
    """A motion in minimal coordinates at ``t`` (T,), of the precision's own number type.

    p (T, N, 4), omega (T, N, 3) body frame, u, udot (T, N, 3) world frame, and r, v (T, N, 3) lifted from
    them in the same precision.
    """

    t: Array
    p: Any
    omega: Any
    u: Any
    udot: Any
    r: Any
    v: Any
    steps: int


def simulate_taylor(
    model: Model, state: State, times: Array, precision: Precision = "extended"
) -> MinimalCoordinateRun:
    """The motion from ``state`` (its minimal coordinates, normalised in that precision) at ``times``.

    Raises TruthUnavailable without heyoka (Linux only) and mpmath, EngineFailure where a step fails.
    """
    hy, mp = load_heyoka(), import_truth_tool("mpmath")
    kind = _number_type(hy, precision)
    integrator = _compiled_integrator(tuple(bool(rod) for rod in model.rods), model.has_drag, precision)
    with mp.workdps(60):

        def number(x: Any) -> Any:
            return float(x) if kind is float else kind(mp.nstr(mp.mpf(x), 40))

        used = len(integrator.pars)  # it ends at the last parameter that the equations name
        integrator.pars[:] = [number(x) for x in _parameter_values(mp, model)[:used]]
        integrator.state[:] = [number(x) for x in _initial_values(mp, model, state)]
        exact = [[number(mp.mpf(float(x))) for x in row] for row in (*model.proximal, *model.distal)]
        ell = [number(mp.mpf(float(x))) for x in model.length]
    integrator.time = kind(0.0)
    outcome, _, _, steps, _, samples = integrator.propagate_grid([kind(float(t)) for t in times])
    if "time_limit" not in str(outcome):
        raise EngineFailure(f"heyoka stopped: {outcome}")
    return _lift_run(model, times, np.asarray(samples), exact, ell, int(steps))


@cache
def load_heyoka() -> Any:
    """The module, without SymPy, which it imports where it can (2 s) for translations not wanted here.

    One thread, as everything in a worker; no cache on disk, which unoptimised code does not need.
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


def _number_type(hy: Any, precision: Precision) -> Any:
    if precision == "quad" and not hasattr(hy, "real128"):
        raise EngineFailure("this heyoka has no quad precision")
    return {"double": float, "extended": np.longdouble, "quad": getattr(hy, "real128", None)}[precision]


def _initial_values(mp: Any, model: Model, state: State) -> list[Any]:
    """Coordinates in the order of `_compiled`, normalised at 60 digits."""
    values: list[Any] = []
    for k in range(model.n):
        if model.rods[k]:
            u, udot = _column_vector(mp, state.u[k]), _column_vector(mp, state.udot[k])
            u /= mp.norm(u)
            udot -= u * (u.T * udot)[0]
            values += [*u, *udot]
        p = _column_vector(mp, state.p[k])
        values += [*(p / mp.norm(p)), *_column_vector(mp, state.omega[k])]
    return values


def _parameter_values(mp: Any, model: Model) -> list[Any]:
    """Numbers of the model in the order of `_Body`: gravity, then per body."""
    values = [*_column_vector(mp, model.gravity)]
    for k in range(model.n):
        m, J = mp.mpf(float(model.mass[k])), mp.matrix(model.inertia[k].tolist())
        J_inverse = J**-1
        cross = [_cross_matrix(mp, s) for s in (model.proximal[k], model.distal[k])]
        Y = [
            mp.eye(3) / m - a * J_inverse * b
            for a, b in ((0, 0), (0, 1), (1, 1))
            for a, b in ((cross[a], cross[b]),)
        ]
        values += [*J, *J_inverse, *Y[0], *Y[1], *Y[2]]
        values += [*_column_vector(mp, model.proximal[k]), *_column_vector(mp, model.distal[k]), 1 / m]
        values += [*(_column_vector(mp, model.force[k]) / m), *_column_vector(mp, model.moment[k])]
        values += [
            mp.mpf(float(model.length[k])),
            float(model.drag_force[k]) / m,
            float(model.drag_moment[k]),
        ]
    return values


def _column_vector(mp: Any, v: Any) -> Any:
    return mp.matrix([float(x) for x in v])


def _cross_matrix(mp: Any, s: Any) -> Any:
    x, y, z = (mp.mpf(float(c)) for c in s)
    return mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@cache
def _compiled_integrator(rods: tuple[bool, ...], drag: bool, precision: Precision) -> Any:
    """The Taylor integrator of a chain of that pattern."""
    hy = load_heyoka()
    system = _equations_of_motion(hy, rods, drag)
    kind = _number_type(hy, precision)
    # Unoptimised code runs two to three times as long and is there in a tenth of the time: of ten bodies in
    # 0.4 s, where optimising takes 3 s … 6 s and saves 0.4 s in a run of 2 s in double, 1 s in extended.
    return hy.taylor_adaptive(system, [kind(0.0)] * len(system), fp_type=kind, compact_mode=True, opt_level=0)


Expression = Any
Vector = list[Expression]
Matrix = list[list[Expression]]


class _BodyParameters:
    """Parameters of one body as heyoka expressions, in the order of `_parameters`."""

    def __init__(self, hy: Any, first: int) -> None:
        self.at, self.hy = first, hy
        self.J, self.J_inverse, self.Ypp, self.Ypd, self.Ydd = (self.take_matrix() for _ in range(5))
        self.sp, self.sd, (self.inverse_mass,) = (
            self.take_parameters(3),
            self.take_parameters(3),
            self.take_parameters(1),
        )
        self.f, self.n = self.take_parameters(3), self.take_parameters(3)
        self.ell, self.ct, self.cr = self.take_parameters(3)

    def take_parameters(self, count: int) -> Vector:
        self.at += count
        return [self.hy.par[i] for i in range(self.at - count, self.at)]

    def take_matrix(self) -> Matrix:
        flat = self.take_parameters(9)
        return [flat[0:3], flat[3:6], flat[6:9]]


def _equations_of_motion(hy: Any, rods: tuple[bool, ...], drag: bool) -> list[tuple[Any, Any]]:
    """(coordinate, its rate) of the chain."""
    n, g = len(rods), [hy.par[i] for i in range(3)]
    bodies: list[_BodyParameters] = []
    for _ in rods:
        bodies.append(_BodyParameters(hy, bodies[-1].at if bodies else 3))
    names = [
        [hy.make_vars(*(f"{c}{i}_{k}" for i in range(w))) for c, w in (("p", 4), ("w", 3))] for k in range(n)
    ]
    links = [[hy.make_vars(*(f"{c}{i}_{k}" for i in range(3))) for c in ("u", "d")] for k in range(n)]
    A = [_rotation_matrix(p) for p, _ in names]
    turn: list[Vector] = []
    far_a: list[Vector] = []
    near_a: list[Vector] = []
    v: Vector = [hy.expression(0.0)] * 3
    for k, body in enumerate(bodies):
        w = list(names[k][1])
        moment = _subtract(body.n, _cross(w, _matrix_times_vector(body.J, w)))
        free = _add(g, body.f)
        if drag:
            moment = _subtract(moment, [body.cr * x for x in w])
            if rods[k]:
                v = _add(v, [body.ell * x for x in links[k][1]])
            v = _subtract(v, _matrix_times_vector(A[k], _cross(w, body.sp)))
            free = _subtract(free, [body.ct * x for x in v])
            v = _add(v, _matrix_times_vector(A[k], _cross(w, body.sd)))
        turn.append(_matrix_times_vector(body.J_inverse, moment))
        for point, into in ((body.sp, near_a), (body.sd, far_a)):
            inside = _add(_cross(turn[k], point), _cross(w, _cross(w, point)))
            into.append(_add(free, _matrix_times_vector(A[k], inside)))

    solves: list[Any] = []
    rhs: list[Vector] = []
    off: list[Matrix] = []
    for k, body in enumerate(bodies):
        D, e = _congruence(A[k], body.Ypp), [-x for x in near_a[k]]
        if k:
            D = [_add(a, b) for a, b in zip(D, _congruence(A[k - 1], bodies[k - 1].Ydd), strict=True)]
            e = _add(e, far_a[k - 1])
        E = _transposed([list(links[k][0])]) if rods[k] else None  # 3 × 1
        D, e = _project_block(E, D, E), _project_vector(E, e)
        if rods[k]:
            e = [e[0] - body.ell * _dot(links[k][1], links[k][1])]
        if k:
            E_above = _transposed([list(links[k - 1][0])]) if rods[k - 1] else None
            couple = _project_block(E_above, _congruence(A[k - 1], bodies[k - 1].Ypd), E)
            off.append([[-x for x in row] for row in couple])  # (above, here)
            columns = _transposed(off[-1])
            gain = [solves[-1](column) for column in columns]  # D⁻¹ of the column, one per row here
            D = [[D[i][j] - _dot(gain[i], columns[j]) for j in range(len(D))] for i in range(len(D))]
            e = [e[i] - _dot(gain[i], rhs[-1]) for i in range(len(e))]
        solves.append(_symmetric_solve(D))
        rhs.append(e)
    F: list[Vector] = [[]] * n
    multiplier: Vector = []
    for k in reversed(range(n)):
        e = rhs[k] if k == n - 1 else _subtract(rhs[k], _matrix_times_vector(off[k], multiplier))
        multiplier = solves[k](e)
        F[k] = [multiplier[0] * x for x in links[k][0]] if rods[k] else multiplier

    system: list[tuple[Any, Any]] = []
    far: Vector | None = None
    for k, body in enumerate(bodies):
        (p, w), (u, udot) = names[k], links[k]
        pull = _matrix_times_vector(_transposed(A[k]), F[k])
        couple_k = _cross(body.sp, pull)
        below = F[k + 1] if k + 1 < n else None
        if below is not None:
            couple_k = _subtract(couple_k, _cross(body.sd, _matrix_times_vector(_transposed(A[k]), below)))
        alpha = _add(turn[k], _matrix_times_vector(body.J_inverse, couple_k))
        if rods[k]:  # ℓ ü is the acceleration of the rod's tip relative to where it hangs
            near = _point_acceleration(A[k], body.Ypp, body.Ypd, near_a[k], F[k], below)
            relative = near if far is None else _subtract(near, far)
            # the part along u is −u̇² u, by definition of a unit vector: taken so, ‖u‖ does not wander
            across = [x / body.ell for x in relative]
            along = _dot(across, u) + _dot(udot, udot)
            system += [*zip(u, udot, strict=True)]
            system += [(d, a - along * x) for d, a, x in zip(udot, across, u, strict=True)]
        if k + 1 < n and rods[k + 1]:
            far = _point_acceleration(A[k], _transposed(body.Ypd), body.Ydd, far_a[k], F[k], below)
        p0, p1, p2, p3 = p
        wx, wy, wz = (0.5 * x for x in w)
        rates = [-p1 * wx - p2 * wy - p3 * wz, p0 * wx - p3 * wy + p2 * wz]
        rates += [p3 * wx + p0 * wy - p1 * wz, -p2 * wx + p1 * wy + p0 * wz]
        system += [*zip(p, rates, strict=True), *zip(w, alpha, strict=True)]
    return system


def _point_acceleration(
    A: Matrix, Yf: Matrix, Yb: Matrix, free: Vector, F: Vector, below: Vector | None
) -> Vector:
    """Acceleration of a point: free motion, the force at the proximal point, the one passed on below."""
    pulled = _matrix_times_vector(Yf, _matrix_times_vector(_transposed(A), F))
    if below is not None:
        pulled = _subtract(pulled, _matrix_times_vector(Yb, _matrix_times_vector(_transposed(A), below)))
    return _add(free, _matrix_times_vector(A, pulled))


def _rotation_matrix(p: Sequence[Expression]) -> Matrix:
    w, x, y, z = p
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    x2, y2, w2 = x + x, y + y, w + w  # no constant: quad arrays do not mix with Python's numbers
    return [
        [ww + xx - yy - zz, x2 * y - w2 * z, x2 * z + w2 * y],
        [x2 * y + w2 * z, ww - xx + yy - zz, y2 * z - w2 * x],
        [x2 * z - w2 * y, y2 * z + w2 * x, ww - xx - yy + zz],
    ]


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    return sum((x * y for x, y in zip(a[1:], b[1:], strict=True)), a[0] * b[0])


def _add(a: Sequence[Any], b: Sequence[Any]) -> Vector:
    return [x + y for x, y in zip(a, b, strict=True)]


def _subtract(a: Sequence[Any], b: Sequence[Any]) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def _cross(a: Sequence[Any], b: Sequence[Any]) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _matrix_times_vector(M: Matrix, v: Sequence[Any]) -> Vector:
    return [_dot(row, v) for row in M]


def _transposed(M: Matrix) -> Matrix:
    return [list(column) for column in zip(*M, strict=True)]


def _matrix_product(a: Matrix, b: Matrix) -> Matrix:
    columns = _transposed(b)
    return [[_dot(row, column) for column in columns] for row in a]


def _congruence(A: Matrix, Y: Matrix) -> Matrix:
    """A Y Aᵀ."""
    return _matrix_product(_matrix_product(A, Y), _transposed(A))


def _project_block(E: Matrix | None, Y: Matrix, E2: Matrix | None) -> Matrix:
    """Eᵀ Y E2 where None stands for the identity."""
    if E is not None:
        Y = _matrix_product(_transposed(E), Y)
    return Y if E2 is None else _matrix_product(Y, E2)


def _project_vector(E: Matrix | None, e: Vector) -> Vector:
    return e if E is None else [_dot([row[0] for row in E], e)]


def _symmetric_solve(D: Matrix) -> Any:
    """The map b → D⁻¹ b of a 1×1 or 3×3 symmetric positive definite D, by LDLᵀ."""
    if len(D) == 1:
        return lambda b: [b[0] / D[0][0]]
    d0 = D[0][0]
    l10, l20 = D[1][0] / d0, D[2][0] / d0
    d1 = D[1][1] - l10 * D[1][0]
    c21 = D[2][1] - l20 * D[1][0]
    l21 = c21 / d1
    d2 = D[2][2] - l20 * D[2][0] - l21 * c21

    def solve(b: Sequence[Any]) -> Vector:
        y1 = b[1] - l10 * b[0]
        y2 = b[2] - l20 * b[0] - l21 * y1
        x2 = y2 / d2
        x1 = y1 / d1 - l21 * x2
        return [b[0] / d0 - l10 * x1 - l20 * x2, x1, x2]

    return solve


def _lift_run(
    model: Model, times: Array, y: Any, points: list[Any], ell: list[Any], steps: int
) -> MinimalCoordinateRun:
    """Coordinates by name, and r, v from the pivot outwards, in the precision of y (T, coordinates)."""
    n, zero = model.n, y[:, :3] - y[:, :3]
    parts: dict[str, list[Any]] = {name: [] for name in ("p", "omega", "u", "udot", "r", "v")}
    tip, tip_v, at = zero, zero, 0
    for k in range(n):
        u_k, d_k = zero, zero
        if model.rods[k]:
            u_k, d_k, at = y[:, at : at + 3], y[:, at + 3 : at + 6], at + 6
        p_k, w_k, at = y[:, at : at + 4], y[:, at + 4 : at + 7], at + 7
        A = _rotation_matrix([p_k[:, i] for i in range(4)])

        def arm(s: Any, A: Matrix = A, w: Any = w_k) -> tuple[Any, Any]:
            """A s and A (ω′ × s)."""
            swing = _cross([w[:, i] for i in range(3)], s)
            return np.stack(_matrix_times_vector(A, s), 1), np.stack(_matrix_times_vector(A, swing), 1)

        near, near_v = arm(points[k])
        far, far_v = arm(points[n + k])
        r_k, v_k = tip + u_k * ell[k] - near, tip_v + d_k * ell[k] - near_v
        tip, tip_v = r_k + far, v_k + far_v
        for into, value in zip(parts.values(), (p_k, w_k, u_k, d_k, r_k, v_k), strict=True):
            into.append(value)
    return MinimalCoordinateRun(t=times, steps=steps, **{name: np.stack(x, 1) for name, x in parts.items()})
