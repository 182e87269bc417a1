"""Motion by heyoka's adaptive Taylor method in joint coordinates, in double, extended or quad precision.

The equations are those of `plumbline.equations.tree`, as expressions in the coordinates: u, u̇ of a rod (world
axes), r, ṙ of a free body, p and ω′ of both and of balls, x and ẋ of the other joints.  No constraint is
integrated, so nothing drifts; only loops are held by accelerations, and drift by rounding: they are cut open
(`plumbline.model.loops`), and the forces on the ends follow from the tree's response to unit wrenches.

A spring of a joint with all turns needs θ/sin θ of its turn θ, which has no Taylor series by recurrence where
θ = 0.  Hence θ² and γ = θ/(6 sin θ) are integrated beside the motion; (8) of `certificate_checker` has their
rates, whose series in θ² is f₀.

The numbers of the model enter as parameters, which keeps numbers that were rounded to doubles out of the
equations.  What is exactly 0 is left out: one compiled integrator serves every model with the same joints and
the same zeros.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Generator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from plumbline.equations import arithmetic, tree
from plumbline.model.datatypes import (
    JOINT_ELEMENTS,
    KINDS,
    ZERO_INERTIA,
    Array,
    EngineFailure,
    Kind,
    Model,
    State,
)
from plumbline.model.kinematics import complete_state, joints_with_elements, rotation_matrix
from plumbline.model.loops import CutMechanism, cut_open, independent_rows
from plumbline.processes.processor import processor_features
from plumbline.processes.user_cache import content_key, recall, remember
from plumbline.truth import import_truth_tool
from reference_impl import joint_kinds

Precision = Literal["double", "extended", "quad", "octuple"]
OCTUPLE_BITS, OCTUPLE_DIGITS = 237, 75
BALL_SPRING_TERMS = 40  # of f₀
# Numbers of a model that are parameters as they are
PLAIN_NUMBERS = (
    "gravity", "mass", "point", "length", "force", "moment", "drag_force", "drag_moment", *JOINT_ELEMENTS,
    "spring_point", "spring_stiffness", "spring_damping", "spring_length",
)  # fmt: skip
# Of a loop the bodies b and c, and which of the six rows are held: shifts, then turns, in axes of b.
Closure = tuple[int, int, tuple[int, ...]]


class Structure(NamedTuple):
    """What the equations depend on besides the values of the parameters."""

    kind: tuple[Kind, ...]
    body: tuple[tuple[int, int], ...]
    springs: tuple[tuple[int, int], ...]  # bodies of springs between points
    closures: tuple[Closure, ...]
    # by name the shape, and the entries: a constant, or None for a parameter
    numbers: tuple[tuple[str, tuple[int, ...], tuple[float | None, ...]], ...]


def simulate_taylor(
    model: Model, state: State, times: Array, precision: Precision = "extended"
) -> tuple[State, int]:
    """Integrate the motion from a state.

    Args:
        state: initial state, of which the minimal coordinates are used, normalised in that precision.
        times: (T,) [s] of the samples, times[0] = 0.

    Returns:
        The motion at ``times``, arrays (T, ...) of the precision's own type, at most extended; and the number
        of steps.

    Raises:
        TruthUnavailable: heyoka (Linux only) or mpmath is not installed.
        EngineFailure: a step fails, as where a ball joint with a spring comes to half a turn and its moment
            jumps, or heyoka was built without quad precision.

    """
    cut = cut_open(model)
    there, opened = cut.state(state), cut.model
    integrator, number = _prepared_integrator(opened, there, precision, closures=_closures(cut, there))
    outcome, _, _, steps, _, samples = integrator.propagate_grid([number(float(t)) for t in times])
    if "time_limit" not in str(outcome):
        raise EngineFailure(f"heyoka stopped: {outcome}")
    y = np.asarray(samples)
    is_quad = y.dtype not in (np.dtype(float), np.dtype(np.longdouble))
    if is_quad and all(kind.has_attitude for kind in opened.kinds):
        y = y.astype(object)  # NumPy multiplies matrices of these numbers as objects only
    elif is_quad:  # sines of angles are computed in extended precision
        y = np.vectorize(lambda x: np.longdouble(str(x)), otypes=[np.longdouble])(y)
    shape = {"p": 4, "x": opened.columns, "xdot": opened.columns}
    names = ("p", "omega", "u", "udot", "r", "v", "x", "xdot")
    parts = {name: np.zeros((len(times), opened.n, shape.get(name, 3)), y.dtype) for name in names}
    parts["p"][..., 0], at = 1, 0
    for k, kind in enumerate(opened.kind):
        for name, size in _coordinate_names(kind):
            parts[name][:, k, :size] = y[:, at : at + size]
            at += size
    motion = complete_state(opened, State(**parts))
    if y.dtype == object:
        motion = State(*(np.array(x.tolist(), samples.dtype) for x in vars(motion).values()))
    return motion[:, cut.place[: model.n]], int(steps)


def _closures(cut: CutMechanism, state: State) -> tuple[Closure, ...]:
    """Choose rows that close the loops and do not depend on others, at a state with the ends together."""
    if not cut.ends:
        return ()
    J = cut.jacobian(state).reshape(len(cut.ends), 6, -1)
    for block, (b, _) in zip(J, cut.ends, strict=True):
        block[:3] = rotation_matrix(state.p[b]).T @ block[:3]
    rows = independent_rows(J.reshape(-1, J.shape[-1]), cut.row_scale)
    return tuple(
        (b, c, tuple(int(row) - 6 * loop for row in rows if row // 6 == loop))
        for loop, (b, c) in enumerate(cut.ends)
    )


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
    springs = _ball_springs(model)
    first, last = 0, sum(size for kind in model.kind for _, size in _coordinate_names(kind))
    for k, kind in enumerate(model.kind):
        own: dict[str, list[int]] = {}
        for name, size in _coordinate_names(kind):
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
    with mp.workdps(100):
        numbers, initial = _numbers_and_coordinates(mp, model, state, bool(closures))
        shapes = tuple(
            (name, x.shape, tuple(_constant(name, entry) for entry in x.flat)) for name, x in numbers.items()
        )
        body, springs = (tuple((int(a), int(b)) for a, b in x) for x in (model.body, model.spring_body))
        structure = Structure(model.kind, body, springs, closures, shapes)
        integrator = _compiled_integrator(structure, precision, order)
        values = [
            number(x) for name, every in numbers.items() for x in every.flat if _constant(name, x) is None
        ]
        integrator.pars[:] = values[: len(integrator.pars)]  # up to the last one that the equations have
        integrator.state[:] = [number(x) for x in initial]
    integrator.time = number(0.0)
    return integrator, number


def _constant(name: str, value: Any) -> float | None:
    """A number that is left out of the parameters: 0, and of axes ±1, whose products are exact."""
    return float(value) if value == 0 or (name == "axes" and abs(value) == 1) else None


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


def _coordinate_names(kind: Kind) -> list[tuple[str, int]]:
    """Fields of `State` with the coordinates of a joint in the order of the equations, and their sizes."""
    joint = KINDS[kind]
    if not joint.has_attitude:
        count = len(joint.motions)
        return [("x", count), ("xdot", count)] if count else []
    place = [("u", 3), ("udot", 3)] if joint.holds_distance else []
    place = [("r", 3), ("v", 3)] if joint.holds_nothing else place
    return [*place, ("p", 4), ("omega", 3)]


def _ball_springs(model: Model) -> list[int]:
    """Joints with all turns and a spring."""
    return [k for k, kind in enumerate(model.kinds) if kind.is_spherical and model.stiffness[k, 0] != 0]


def _bare_joints(model: Model) -> list[int]:
    """Rods and balls without elements whose bodies have inertia, no springs, and carry only such joints."""
    principal = np.linalg.eigvalsh(model.inertia)
    bare = (model.mass > 0) & (principal[:, 0] > ZERO_INERTIA * principal[:, 2])
    bare &= ~np.isin(np.arange(model.n), model.spring_body)
    bare &= bool(np.any(model.rods))  # balls alone need more products so
    bare &= [kind.holds_no_turn for kind in model.kinds] & ~joints_with_elements(model)
    for k in reversed(range(model.n)):
        if model.body[k, 0] >= 0 and not bare[k]:
            bare[model.body[k, 0]] = False
    return [int(k) for k in np.flatnonzero(bare)]


def _exactly(mp: Any) -> Callable[[Any], Any]:
    """The map from doubles and integers to numbers of mpmath."""
    return lambda x: mp.mpf(float(x))


class _PreciseTree(tree.Tree):
    """A tree in numbers of mpmath, with the turns θ of joints with springs."""

    def __init__(self, mp: Any, model: Model, state: State) -> None:
        self.angles: dict[int, Any] = {}
        self.mp = mp
        super().__init__(arithmetic.objects(mp, _exactly(mp)), model, state)

    def turn_over_sine(self, k: int, sine: Any, cosine: Any) -> Any:
        self.angles[k] = self.mp.atan2(self.mp.norm([*sine[:, 0]]), cosine)
        return super().turn_over_sine(k, sine, cosine)


def _numbers_and_coordinates(
    mp: Any, model: Model, state: State, is_closed: bool
) -> tuple[dict[str, Any], list[Any]]:
    """Numbers of the model by name, and its coordinates, quaternions and directions normalised.

    Gravity enters as a force.  ``reach`` leads from the near point of the far body to the joint's far point.
    """
    precise, n, lift = _PreciseTree(mp, model, state), model.n, np.vectorize(_exactly(mp), otypes=[object])
    numbers = {name: lift(getattr(model, name)) for name in PLAIN_NUMBERS}
    point, mass = numbers["point"], numbers["mass"]
    weight = mass[:, None] * numbers["gravity"]
    numbers |= {"force": numbers["force"] + weight, "gravity": lift(np.zeros(3))}
    numbers["axes"] = np.array([[precise.joint_axes(k, side) for side in (0, 1)] for k in range(n)])
    numbers["inertia"] = np.array([precise.near_inertia(k) for k in range(n)])
    numbers["per_length"] = np.array([1 / x if x else x for x in numbers["length"]])
    numbers["terms"] = np.array([-1 / mp.mpf(2 * (i + 1) * (2 * i + 5)) for i in range(BALL_SPRING_TERMS)])
    far = model.body[:n, 0]
    numbers["reach"] = np.where((far >= 0)[:, None], point[:n, 0] - point[far, 1], mp.mpf(0))
    numbers["mobility"] = lift(np.zeros((n, 6, 6)))
    for k in () if is_closed else _bare_joints(model):
        b = precise.num.cross_matrix(point[k, 1][:, None] * mass[k])
        M = np.block([[precise.one * mass[k], b], [b.T, precise.near_inertia(k)]])
        numbers["mobility"][k] = np.array((mp.matrix(M.tolist()) ** -1).tolist())
    values: list[Any] = []
    for k, kind in enumerate(model.kind):
        parts = {
            name: mp.matrix(getattr(state, name)[k, :size].tolist()) for name, size in _coordinate_names(kind)
        }
        if KINDS[kind].has_attitude:
            parts["p"] /= mp.norm(parts["p"])
        if KINDS[kind].holds_distance:
            parts |= zip(("u", "udot"), (x[:, 0] for x in precise.rod_direction(k)), strict=True)
        values += [entry for part in parts.values() for entry in part]
    for k in _ball_springs(model):
        theta = precise.angles[k]
        values += [theta**2, 1 / (6 * mp.sinc(theta))]
    return numbers, values


@cache
def _compiled_integrator(structure: Structure, precision: Precision, order: int | None = None) -> Any:
    """The Taylor integrator of a mechanism; order None: the precision's own.

    It is remembered with its machine code: to read it takes a third to a quarter of the time of compiling it.
    """
    hy = load_heyoka()
    sources = (__file__, tree.__file__, arithmetic.__file__, joint_kinds.__file__)
    code = b"".join(Path(file).read_bytes() for file in sources)
    key = content_key(
        "Taylor", code, hy.__version__, processor_features(), repr((structure, precision, order))
    )
    integrator = recall(key, lambda found: hasattr(found, "propagate_grid"))
    if integrator is None:
        integrator = _compile_integrator(hy, structure, precision, order)
        remember(key, integrator)
    return integrator


def _compile_integrator(hy: Any, structure: Structure, precision: Precision, order: int | None) -> Any:
    system = _ExpressionTree(hy, structure).equations(structure.closures)
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


class _ExpressionTree(tree.Tree):
    """The mechanism at variables of heyoka, its numbers parameters or 0."""

    def __init__(self, hy: Any, structure: Structure) -> None:
        self.hy, parameter = hy, 0
        found: dict[str, Any] = {}
        for name, shape, entries in structure.numbers:
            values: list[Any] = []
            for entry in entries:
                values.append(hy.par[parameter] if entry is None else entry)
                parameter += entry is None
            found[name] = np.fromiter(values, object, len(values)).reshape(shape)
        own = ("axes", "per_length", "terms", "mobility", "reach")
        self.axes, self.per_length, self.terms, self.mobility, self.reach = (found.pop(x) for x in own)
        self.bare: dict[int, _BareJoint] = {}
        self.springs: dict[int, Any] = {}  # sin θ times the axis
        self.coordinates = [
            {
                name: [hy.expression(f"{name}{i}_{k}") for i in range(size)]
                for name, size in _coordinate_names(kind)
            }
            for k, kind in enumerate(structure.kind)
        ]
        body, springs = (np.array(x, np.intp).reshape(-1, 2) for x in (structure.body, structure.springs))
        turn = np.zeros((len(body), 2, 4), object)
        model = Model(kind=structure.kind, body=body, spring_body=springs, turn=turn, **found)
        super().__init__(arithmetic.objects(hy), model, None)  # type: ignore[arg-type]

    def column(self, k: int, name: str) -> Any:
        return self.num.vector(self.coordinates[k][name])

    def coordinate(self, k: int, i: int) -> tuple[Any, Any]:
        return self.coordinates[k]["x"][i], self.coordinates[k]["xdot"][i]

    def attitude(self, k: int) -> tuple[Any, Any]:
        A = self.num.from_rows(tree.rotation_rows(self.coordinates[k]["p"])[0])
        return A, A @ self.column(k, "omega")

    def free_point(self, k: int) -> tuple[Any, Any]:
        return self.column(k, "r"), self.column(k, "v")

    def rod_direction(self, k: int) -> tuple[Any, Any]:
        return self.column(k, "u"), self.column(k, "udot")

    def joint_axes(self, k: int, side: int) -> Any:
        return self.axes[k, side]

    def near_inertia(self, k: int) -> Any:
        return self.num.matrix(self.model.inertia[k])

    def centripetal(self, k: int, point: Any, arm: Any) -> Any:
        if not self.model.kinds[k].has_attitude:
            return super().centripetal(k, point, arm)
        squares = self.squares(k)
        return self.A[k] @ ((squares - self.one * np.trace(squares)) @ point)

    def gyroscopic(self, k: int, inertia: Any) -> Any:
        if not self.model.kinds[k].has_attitude:
            return super().gyroscopic(k, inertia)
        return self.A[k] @ self.gyration(k)

    def gyration(self, k: int) -> Any:
        """Return ω′ × (I′ ω′)."""
        x = self.near_inertia(k) @ self.squares(k)
        return self.num.vector([x[2, 1] - x[1, 2], x[0, 2] - x[2, 0], x[1, 0] - x[0, 1]])

    def squares(self, k: int) -> Any:
        """ω′ω′ᵀ: in body axes, products with the body's own numbers cost little."""
        w = self.column(k, "omega")
        return w @ w.T

    def turn_over_sine(self, k: int, sine: Any, cosine: Any) -> Any:
        self.springs[k] = sine
        return 6.0 * self.hy.expression(f"ratio_{k}")

    def reduced(self, k: int, x: tree.Articulated) -> tree.Articulated:
        if not np.any(self.mobility[k] != 0):
            return super().reduced(k, x)
        self.bare[k] = _BareJoint(self, k)
        return self.bare[k].articulated()

    def advanced(self, k: int, a: Any, alpha: Any) -> tuple[Any, Any, list[Any]]:
        return self.bare[k].advanced(a) if k in self.bare else super().advanced(k, a, alpha)

    def equations(self, closures: Sequence[Closure]) -> list[tuple[Any, Any]]:
        """Pairs (coordinate, its rate)."""
        places = [(b, c, row, row % 3) for b, c, rows in closures for row in rows]
        found = self.solve(
            [self.end_wrench(b, c, self.A[b][:, i : i + 1], row < 3) for b, c, row, i in places]
        )
        if closures:
            rows = np.concatenate([self._relative(found, *closure) for closure in closures])
            shares = np.concatenate([[[1.0]], _solve_symmetric(rows[:, 1:], -rows[:, :1])])
            found = found.combined(lambda x: x @ shares)
        system: list[tuple[Any, Any]] = []
        for k, own in enumerate(self.coordinates):
            rates = self._rates(k, found)
            system += [pair for name, x in own.items() for pair in zip(x, rates[name], strict=True)]
        for k in self.springs:
            system += self._turn_rates(k)
        number = self.hy.expression
        return [(x, number(rate) if isinstance(rate, float) else rate) for x, rate in system]

    def _rates(self, k: int, found: tree.Solution) -> dict[str, Any]:
        """Rates of the coordinates of joint k by name."""
        kind, own, blocks = self.model.kinds[k], self.coordinates[k], found.rates[k]
        if not kind.has_attitude:
            return {"x": own.get("xdot"), "xdot": [rate.item() for rate in blocks]}
        wx, wy, wz = (0.5 * w for w in own["omega"])
        p0, p1, p2, p3 = own["p"]
        rates: dict[str, Any] = {
            "p": [
                -p1 * wx - p2 * wy - p3 * wz,
                p0 * wx - p3 * wy + p2 * wz,
                p3 * wx + p0 * wy - p1 * wz,
                -p2 * wx + p1 * wy + p0 * wz,
            ],
            "omega": (self.bare[k].turning if k in self.bare else self.A[k].T @ found.turning[k])[:, 0],
        }
        if kind.holds_distance:
            u, udot = self.rod_direction(k)
            relative = blocks[0] * self.per_length[k]
            along = self.num.dot(relative, u) + self.num.dot(udot, udot)  # written so, ‖u‖ does not drift
            rates |= {"u": own["udot"], "udot": (relative - u * along)[:, 0]}
        if kind.holds_nothing:
            rates |= {"r": own["v"], "v": blocks[0][:, 0]}
        return rates

    def _turn_rates(self, k: int) -> list[tuple[Any, Any]]:
        """Pairs (θ², rate) and (γ, rate) of a joint with all turns and a spring."""
        square, ratio = self.hy.make_vars(f"square_{k}", f"ratio_{k}")
        spin = self.w[k] - self.w[self.far[k]] if self.far[k] >= 0 else self.w[k]
        change, f = 12.0 * ratio * self.num.dot(self.springs[k], spin), 1.0
        for term in reversed(self.terms):
            f = square * f * term + 1.0
        return [(square, change), (ratio, ratio * ratio * change * f)]

    def _relative(self, found: tree.Solution, b: int, c: int, rows: Sequence[int]) -> Any:
        """Relative accelerations of b and c in the rows that are held."""
        parts = (x[b] - x[c] for x in (found.acceleration, found.turning))
        return np.concatenate([self.A[b].T @ part for part in parts])[list(rows)]


class _BareJoint:
    """A rod or a ball joint whose body carries only such joints, by the body's mobility Λ in its own axes.

    There Λ is constant: articulated bodies need twice as many products of series.  With the force F of the
    joint along its directions D, forces F_j of those joints j that the body carries at e, Z = (D, e × D) in
    body axes, Z₀ of its own, and w what the body needs at rest,

        x = (a′, α′) = Λ (Z₀ F − w − Σ Z_j F_j),    Z_jᵀ x = Y_j F_j − g_j,    Dᵀ a_far = Y F − g.

    Attributes:
        directions: D, world axes.
        yielding, driven: Y and g.
        turning: α′.
        hanging, forces: by the joints that the body carries a_far, world axes, and F_j.

    """

    def __init__(self, mechanism: _ExpressionTree, k: int) -> None:
        num, model, back, mobility = mechanism.num, mechanism.model, mechanism.A[k].T, mechanism.mobility[k]
        self.mechanism, self.k = mechanism, k
        s, squares = num.vector(model.point[k, 1]), mechanism.squares(k)
        self.inward = squares - mechanism.one * np.trace(squares)
        load = back @ (num.vector(model.force[k]) - mechanism.v[k] * num.scalar(model.drag_force[k]))
        moment = num.vector(model.moment[k]) - mechanism.column(k, "omega") * num.scalar(model.drag_moment[k])
        f = -(self.inward @ s) * num.scalar(model.mass[k]) - load
        self.rest = mobility @ np.concatenate([f, mechanism.gyration(k) + num.cross(s, load) - moment])
        swings = [block for block in mechanism.blocks[k] if hasattr(block, "u")]
        self.directions = swings[0].u if swings else mechanism.one
        own = np.concatenate([back @ self.directions, np.full((3, self.directions.shape[1]), 0.0, object)])
        self.unit = mobility @ own
        self.yielding, self.driven = own.T @ self.unit, own.T @ self.rest
        for swing in swings:
            self.driven = self.driven + swing.pull
        self.carried = [joint for j, joint in mechanism.bare.items() if mechanism.far[j] == k]
        self.hanging, self.forces = dict[int, Any](), dict[int, Any]()
        self.gained, self.shares = np.full((6, 0), 0.0, object), np.full((0, 1 + own.shape[1]), 0.0, object)
        if not self.carried:
            return
        Z, driven, blocks, at = list[Any](), list[Any](), dict[tuple[int, int], Any](), 0
        for joint in self.carried:
            D, e = back @ joint.directions, num.vector(mechanism.reach[joint.k])
            Z.append(np.concatenate([D, num.cross_matrix(e) @ D]))
            driven.append(joint.driven + D.T @ (self.inward @ e))
            blocks[at, at] = joint.yielding
            at += len(joint.yielding)
        others = np.concatenate(Z, 1)
        self.gained = mobility @ others
        right = [np.concatenate(driven) - others.T @ self.rest, others.T @ self.unit]
        K = others.T @ self.gained + num.assemble(at, blocks)
        self.shares = _solve_symmetric(K, np.concatenate(right, 1))  # F_j by what drives them and by F
        by_others = own.T @ self.gained
        self.driven = self.driven + by_others @ self.shares[:, :1]
        self.yielding = num.symmetric(self.yielding - by_others @ self.shares[:, 1:])

    def articulated(self) -> tree.Articulated:
        """What a body needs at the joint's far point."""
        D = self.directions
        found = D @ _solve_symmetric(self.yielding, np.concatenate([D.T, self.driven], 1))
        return tree.Articulated(self.mechanism.num.symmetric(found[:, :3]), None, None, found[:, 3:], None)

    def advanced(self, a: Any) -> tuple[Any, Any, list[Any]]:
        """Accelerations as `Tree.advanced` returns them."""
        num, A, far = self.mechanism.num, self.mechanism.A[self.k], self.mechanism.far[self.k]
        if far in self.mechanism.bare:
            above = self.mechanism.bare[far]
            a, force = above.hanging[self.k], above.forces[self.k]
        else:
            force = _solve_symmetric(self.yielding, self.directions.T @ a + self.driven)
        forces, at = self.shares[:, :1] + self.shares[:, 1:] @ force, 0
        x = self.unit @ force - self.rest - self.gained @ forces
        near, self.turning = x[:3], x[3:]
        for joint in self.carried:
            e, count = num.vector(self.mechanism.reach[joint.k]), len(joint.yielding)
            self.hanging[joint.k] = A @ (near + num.cross(self.turning, e) + self.inward @ e)
            self.forces[joint.k], at = forces[at : at + count], at + count
        near, turning = A @ near, A @ self.turning
        return near, turning, [near - a, turning]


def _solve_symmetric(K: Any, b: Any) -> Any:
    """Solve K x = b (n, ·) by the lower triangle of K = L D Lᵀ; ``scaled`` is L D."""
    n = len(b)
    scaled, L, x = K.copy(), K.copy(), [*b]
    for j in range(n):
        for i in range(j, n):
            for m in range(j):
                scaled[i, j] = scaled[i, j] - L[i, m] * scaled[j, m]
            L[i, j] = scaled[i, j] / scaled[j, j]
    for i in range(n):
        for j in range(i):
            x[i] = x[i] - L[i, j] * x[j]
    for i in reversed(range(n)):
        x[i] = x[i] / scaled[i, i]
        for j in range(i + 1, n):
            x[i] = x[i] - L[j, i] * x[j]
    return np.array(x, object)
