"""Coordinates of the declared steps of a mechanism, in extended precision, and accelerations in them.

A joint's coordinates q and velocities v, from the far body on: of a rod its turn, a quaternion against the
far body with the relative angular velocity in the rod's own frame; of a body on a rod or a ball the same
against the rod or the far body; the numbers of the other joints.  A free body has r and ṙ in the world before
its turn, or a rigid motion with the twist in its own frame.  Turns of "joint angles" are angles about two or
three axes.  The accelerations are those of `plumbline.equations.tree`.

Cut open, the ends b and c of a loop are two parts of one body.  With the twists V, about the world's origin,

    V̇_b − V̇_c = −(V_b − V_c) × V_c − 2 a (V_b − V_c) + a² log(b⁻¹ c)

in the frame of b, with the correction of gaps a that the method declares, or ẍ = −2 a ẋ − a² x of the gaps x
that it declares in place of the logarithm.  So does the gap of a slide that is held at the pitch times the
turn of its joint.  The forces λ of rows that depend on others are not unique, v̇ is: proximal iterations find
it.

Arrays have leading axes ``...`` for many states at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import islice
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plumbline.equations.arithmetic import floats, stacked
from plumbline.equations.tree import Solution, Tree
from plumbline.model.datatypes import EngineFailure, Model, State
from plumbline.model.kinematics import (
    cross,
    cross_matrix,
    normalised,
    quaternion_conjugate,
    quaternion_exponential,
    quaternion_product,
    rod_inertias,
    rotate_vectors,
    rotation_matrix,
    rotation_vector,
    stack_states,
    turn_of_z,
)
from plumbline.model.loops import cut_open
from plumbline.model.redescription import PITCHED_KINDS, joints_as_cylinders, state_of_cylinders
from plumbline.model.step_methods import JointSpaceMethod

Array = NDArray[Any]  # in this module of extended precision, where nothing else is stated
LongDouble: Any = np.longdouble
Forces = Literal["all", "applied", "joint dampers"]
UNIT: Array = np.array([1, 0, 0, 0], LongDouble)
PROXIMAL_DAMPING = LongDouble(1e-10)  # of rows scaled to a unit diagonal of J M⁻¹ Jᵀ
PROXIMAL_STEPS = 10


class _Attitudes(NamedTuple):
    """The attitudes of the bodies and rods at coordinates."""

    p: list[Array]  # (..., 4) quaternions of the bodies
    turned: dict[int, Array]  # by joint the matrices of the bodies whose attitude is a coordinate
    rods: dict[int, Array]  # by joint the matrices of the rods
    axes: dict[int, list[Array]]  # by chart (..., 3, 1) of its angles


@dataclass(frozen=True, eq=False)
class BodyStates(State):
    """Motion of the bodies, extended precision; leading axes as in the coordinates it was made from."""

    energy: Array = field(kw_only=True)  # (...,) J, kinetic and potential
    momentum: Array = field(kw_only=True)  # (..., 3) kg m²/s, angular, about the origin

    def rounded(self) -> State:
        """Round the motion to doubles."""
        return State(*(np.asarray(getattr(self, one.name), float) for one in fields(State)))


@dataclass(frozen=True, eq=False)
class _Chart:
    """Coordinates of a rod or of the rest of a joint."""

    q: Array  # (B, ·) at the states
    v: Array  # (B, size)
    is_group: bool = False  # a quaternion comes first in q, and a turn last in v
    is_point: bool = False  # of a free body
    is_rigid: bool = False  # the point and its turn are a rigid motion
    axes: tuple[Array, ...] = ()  # (B, 3) of angles, in the frame before
    rest: Array = field(default_factory=lambda: UNIT)  # attitude in that frame at angles of 0


class StepCharts:
    """Coordinates and accelerations of a mechanism; q is a list over the charts, v is (..., nv)."""

    is_new_step = True  # for formulas that keep accelerations from step to step
    _tree: tuple[list[Array], Array, _MovingTree] | None = None
    _attitudes: tuple[list[Array], _Attitudes] | None = None

    def __init__(
        self, model: Model, method: JointSpaceMethod, states: Sequence[State] | State,
        angle_axes: Sequence[Array | None] = (),
    ) -> None:  # fmt: skip
        """Set up the charts.

        Args:
            states: B states, of loops closed or nearly, or one of arrays (B, ...).
            angle_axes: for "joint angles", the axes (angles, 3) of the turns of balls and rods at each state.

        """
        cut = cut_open(model)
        self.place, self.ends = cut.place[: model.n], cut.ends  # of the mechanism's bodies, of loops' ends
        model, s = cut.model, cut.state(stack_states(states))
        # by joint which of the coordinates here are the mechanism's, and the pitches at which slides are held
        self.given = [slice(None, len(kind.motions)) for kind in model.kinds]
        self.held: dict[int, float] = {}
        if method.holds_pitches:
            self.held = {k: float(model.length[k]) for k, kind in enumerate(model.kinds) if kind.has_pitch}
            tree, model = model, joints_as_cylinders(model, PITCHED_KINDS)
            s = state_of_cylinders(tree, model, s)
            self.given = [slice(1, 2) if k in self.held else own for k, own in enumerate(self.given)]
        self.model, self.method = model, method
        self.is_held = bool(self.ends or self.held)
        self.state = s = State(**{name: x.astype(LongDouble) for name, x in vars(s).items()})
        u = normalised(np.where(model.rods[:, None], s.u, UNIT[:3]))
        attitudes, rods = normalised(s.p), normalised(turn_of_z(u))
        spins, rod_spins = rotate_vectors(rotation_matrix(attitudes), s.omega), cross(s.u, s.udot)
        axes = np.array([a for a in angle_axes if a is not None], LongDouble).reshape(len(u), -1, 3)
        rest = iter(np.moveaxis(axes, 1, 0) if method.coordinates == "joint angles" else ())
        self.charts: list[_Chart] = []
        self.joint_axes: dict[tuple[int, int], Array] = {}
        self.of_body: list[int] = []
        self.of_rod: dict[int, int] = {}
        for k, kind in enumerate(model.kinds):
            far = int(model.body[k, 0])
            before, w = np.tile(UNIT, (len(u), 1)), np.zeros_like(u[:, 0])
            if far >= 0:
                before, w = attitudes[:, far], spins[:, far]
            if kind.holds_distance:
                self.of_rod[k] = len(self.charts)
                w = self._add_turn(before, rods[:, k], w, rod_spins[:, k], [*islice(rest, 2)], u[:, k])
                before = rods[:, k]
            self.of_body.append(len(self.charts))
            if kind.has_attitude:
                point = (s.r[:, k], s.v[:, k]) if kind.holds_nothing else None
                own = attitudes[:, k], w, spins[:, k], [*islice(rest, 3)]
                self._add_turn(before, *own, point=point)
            else:
                count = len(kind.motions)
                self.charts.append(_Chart(s.x[:, k, :count], s.xdot[:, k, :count]))
        sizes = [chart.v.shape[1] for chart in self.charts]
        self.own = [slice(end - size, end) for end, size in zip(np.cumsum(sizes), sizes, strict=True)]
        self.nv = sum(sizes)
        pairs = [*zip(self.own, self.charts, strict=True)]
        places = [range(own.stop - 3, own.stop) for own, chart in pairs if chart.is_group]
        self.turns = np.array(places, np.intp).reshape(-1, 3)  # places of ω among the velocities
        self.rigid = [own for own, chart in pairs if chart.is_rigid]

    def _add_turn(
        self, before: Array, here: Array, w_before: Array, w: Array, axes: list[Array],
        rod: Array | None = None, point: tuple[Array, Array] | None = None,
    ) -> Array:  # fmt: skip
        """Add a turn, after the point of a free body; returns the angular velocity after it."""
        relative = quaternion_product(quaternion_conjugate(before), here)
        if axes:
            # A rod has two angles: what it turns about itself is theirs, and acts on nothing.
            found = _solve3(axes if rod is None else [*axes, rod], w - w_before)[:, : len(axes)]
            q, v, back = [0 * found], [found], np.swapaxes(rotation_matrix(before), -1, -2)
            turned = tuple(rotate_vectors(back, axis) for axis in axes)
            if point is not None:
                q, v = [point[0], *q], [point[1], *v]
            is_point = point is not None
            chart = _Chart(_joined(q), _joined(v), is_point=is_point, axes=turned, rest=relative)
            self.charts.append(chart)
            return w_before + sum(axis * found[:, i : i + 1] for i, axis in enumerate(axes))
        back = np.swapaxes(rotation_matrix(here), -1, -2)
        q, v, is_point = [relative], [rotate_vectors(back, w - w_before)], point is not None
        is_rigid = is_point and self.method.free_coordinates == "rigid motion"
        if point is not None:
            q, v = [*q, point[0]], [rotate_vectors(back, point[1]) if is_rigid else point[1], *v]
        self.charts.append(_Chart(_joined(q), _joined(v), True, is_point, is_rigid))
        return w

    # -- coordinates ---------------------------------------------------------------------------------

    def start(self) -> tuple[list[Array], Array]:
        """Return the coordinates of the states.

        Returns:
            q, a list over the charts, and v (B, nv).

        """
        return [chart.q for chart in self.charts], _joined([chart.v for chart in self.charts])

    def reported(self) -> tuple[Array, Array]:
        """Return the coordinates of the states as an engine reports them, in double precision.

        Returns:
            (B, Σ ·) and (B, nv), for `divided`.

        """
        q, v = self.start()
        return np.asarray(_joined(q), float), np.asarray(v, float)

    def divided(self, coordinates: Array, velocities: Array) -> tuple[list[Array], Array]:
        """Divide an engine's own coordinates among the charts, as `start` returns those of the states.

        Args:
            coordinates: (..., Σ ·) of `Trajectory`.
            velocities: (..., nv).

        Raises:
            EngineFailure: they are not as many as the mechanism has.

        """
        size = sum(chart.q.shape[-1] for chart in self.charts)
        for name, array, expected in (
            ("coordinates", coordinates, size),
            ("velocities", velocities, self.nv),
        ):
            if array.shape[-1] != expected:
                raise EngineFailure(f"{name} has {array.shape[-1]} entries per sample, expected {expected}")
        q = self._by_chart(coordinates)
        for at, chart in zip(q, self.charts, strict=True):
            if chart.is_group:
                at[..., :4] = normalised(at[..., :4])
        return q, velocities.astype(LongDouble)

    def _by_chart(self, coordinates: Array) -> list[Array]:
        ends = np.cumsum([chart.q.shape[-1] for chart in self.charts])
        return np.split(coordinates.astype(LongDouble), ends[:-1], axis=-1)

    def middle_cosine(self, q: list[Array]) -> Array:
        """Return the smallest cosine (...,) of the second of a turn's angles; 1 where turns have none."""
        found = np.ones(q[0].shape[:-1])
        for at, chart in zip(q, self.charts, strict=True):
            if chart.axes:
                found = np.minimum(found, np.abs(np.cos(at[..., 1 - len(chart.axes)])).astype(float))
        return found

    def coordinate_sizes(self, coordinates: Array) -> dict[str, Array]:
        """Measure what roundings of an engine's coordinates depend on.

        Args:
            coordinates: (..., Σ ·) of `Trajectory`.

        Returns:
            By joint of each body (..., N): the sum of its angles that are numbers, and by how much its
            quaternions are not of length 1.

        """
        q, shape = self._by_chart(coordinates), coordinates.shape[:-1]
        turned, stretched = np.zeros((2, *shape, self.model.n))
        for k, kind in enumerate(self.model.kinds):
            for at in (self.of_rod.get(k), self.of_body[k]):
                if at is None:
                    continue
                chart, own = self.charts[at], q[at]
                if chart.is_group:
                    length = np.sqrt(np.sum(own[..., :4] ** 2, axis=-1))
                    stretched[..., k] += np.asarray(np.abs(length - 1), float)
                    continue
                turns = [i for i, (what, _) in enumerate(kind.motions) if what == "turn"]
                angles = own[..., 3 * chart.is_point :] if chart.axes else own[..., turns]
                turned[..., k] += np.asarray(np.sum(np.abs(angles), axis=-1), float)
        return {"turned": turned[..., self.place], "stretched": stretched[..., self.place]}

    def move(self, q: list[Array], displacement: Array) -> list[Array]:
        """Displace the coordinates.

        Args:
            displacement: (..., nv), chart by chart: rotation vectors, twists, numbers.

        """
        moved = []
        for chart, own, at in zip(self.charts, self.own, q, strict=True):
            change = displacement[..., own]
            if not chart.is_group:
                moved.append(at + change)
                continue
            turn, point = change[..., -3:], at[..., 4:]
            if chart.is_rigid:
                shift = rotate_vectors(_left_jacobian(turn), change[..., :3])
                point = point + rotate_vectors(rotation_matrix(at[..., :4]), shift)
            elif chart.is_point:
                point = point + change[..., :3]
            moved.append(_joined([self._turned(at[..., :4], turn), point]))
        return moved

    def _turned(self, q: Array, turn: Array) -> Array:
        if self.method.is_rotation_exact:
            return quaternion_product(q, quaternion_exponential(turn / 2))
        return normalised(quaternion_product(q, np.concatenate([np.ones_like(turn[..., :1]), turn / 2], -1)))

    def bracket(self, a: Array, b: Array) -> Array:
        """Return the Lie bracket of displacements, chart by chart: a × b of rotations, 0 of numbers.

        Args:
            a: (..., nv).
            b: (..., nv).

        Returns:
            (..., nv).

        """
        found = np.zeros(np.broadcast_shapes(a.shape, b.shape), LongDouble)
        found[..., self.turns] = cross(a[..., self.turns], b[..., self.turns])
        for own in self.rigid:
            x, y = a[..., own], b[..., own]
            shift = cross(x[..., 3:], y[..., :3]) + cross(x[..., :3], y[..., 3:])
            found[..., own.start : own.start + 3] = shift
        return found

    def displacement_rate(self, theta: Array, v: Array) -> Array:
        """Apply dexp⁻¹(θ) v = Σ Bₖ/k! adₖ(θ) v of displacements on the right (B₁ = ½).

        Args:
            theta: (..., nv), turns of less than 2 rad.
            v: (..., nv).

        Returns:
            θ̇ (..., nv).

        """
        if not len(self.turns):
            return v
        terms = self.method.correction_terms
        weights = BERNOULLI if terms is None else BERNOULLI[: int(terms > 1)]
        return _bernoulli_series(self.bracket, theta, v, 0.5 if terms != 0 else 0.0, weights)

    # -- accelerations -------------------------------------------------------------------------------

    def acceleration(self, q: list[Array], v: Array) -> Array:
        """Return v̇.

        Args:
            v: (..., nv).

        Returns:
            (..., nv).

        """
        return np.asarray(self._solved(q, v)[0] * LongDouble(self.method.acceleration_factor))

    def damped_acceleration(self, q: list[Array], v: Array, h: Array, forces: Forces) -> Array:
        """Return (M + h D)⁻¹ M v̇ with D = −∂(M v̇)/∂v of some of the forces, in the sparsity of M.

        In "applied" forces, free bodies on which nothing moves have the derivatives of all.

        Args:
            v: (B, nv).
            h: (B, 1) [s].

        Returns:
            (B, nv).

        """
        own = self._standalone_columns() if forces == "applied" else []
        factor = LongDouble(self.method.damping_factor)
        if forces == "joint dampers":  # as rotors of inertia h c
            added = factor * h[..., None] * self.model.damping
            damped = replace(self.model, armature=self.model.armature + added)
            found, *_ = self._solved(q, v, damped if np.any(self.model.damping) else None)
            return np.asarray(found * LongDouble(self.method.acceleration_factor))
        if forces == "applied" and not own and not self.model.is_dissipative:
            return self.acceleration(q, v)
        M, D = self._mass_matrix(q), np.zeros((*v.shape, self.nv), LongDouble)
        if forces == "all" or self.model.is_dissipative:
            D = self._damping(q, v, M, forces)
        if own:
            D[..., own, :] = 0
            block = (..., np.array(own)[:, None], own)
            D[block] = self._damping(q, v, M, "all")[block]
        D = factor * np.where(self._on_one_path(), D, 0)
        if self.method.is_damping_symmetric:
            D = (D + np.swapaxes(D, -1, -2)) / 2
        return solve_definite(M + h[..., None] * D, rotate_vectors(M, self.acceleration(q, v)))

    def _solved(
        self, q: list[Array], v: Array, damped: Model | None = None
    ) -> tuple[Array, Solution, _MovingTree]:
        """v̇ with all rows held; ``damped`` has further rotors."""
        tree = self.tree(q, v) if damped is None or self.is_held else _MovingTree(self, q, v, damped)
        wrenches = tree.holding_wrenches()
        found = tree.solve(wrenches)
        if self.is_held:
            shares = tree.holding_shares(found)
            if damped is not None:
                found = _MovingTree(self, q, v, damped).solve(wrenches)
            found = found.combined(lambda x: x @ shares)
        return tree.velocity_rates(found), found, tree

    def _damping(self, q: list[Array], v: Array, M: Array, forces: Forces) -> Array:
        """−∂(M v̇)/∂v (B, nv, nv) of forces: M v̇ is quadratic in v, and its part by applied forces linear."""
        units = np.eye(self.nv, dtype=LongDouble)[:, None]
        if forces == "applied":
            parts = ("drag_force", "drag_moment", "damping", "spring_damping")
            undamped = replace(self.model, **{name: 0 * getattr(self.model, name) for name in parts})
            cases, size = ((units, undamped), (units, self.model)), 1
        else:  # a central difference of any size is exact
            cases, size = ((v - units, self.model), (v + units, self.model)), 2
        before, after = (
            (tree := _MovingTree(self, q, rates, model)).velocity_rates(tree.solve())
            for rates, model in cases
        )
        return np.asarray(M @ np.moveaxis((before - after) / size, 0, -1))

    def _mass_matrix(self, q: list[Array]) -> Array:
        """M (B, nv, nv), by the velocities that each rate alone gives the bodies; rotors included."""
        tree, model = _MovingTree(self, q, np.eye(self.nv, dtype=LongDouble)[:, None]), self.model
        lead, left, right = (self.nv, len(q[0])), list[Array](), list[Array]()

        def add(rate: Array, momentum: Array) -> None:
            for found, x in ((left, rate), (right, momentum)):
                found.append(np.broadcast_to(x, (*lead, *x.shape[-2:]))[..., 0])

        for k in range(model.n):
            spin = tree.num.mul(tree.A[k].mT, tree.w[k])
            add(tree.v[k], tree.v[k] * LongDouble(model.mass[k]))
            add(spin, tree.num.mul(tree.inertia(k), spin))
            if k in self.of_rod:
                about = tree.rod_spin(k)
                add(about, about * self.axial_inertia(k))
        rates, momenta = (np.ascontiguousarray(np.swapaxes(_joined(x), 0, 1)) for x in (left, right))
        M = rates @ np.ascontiguousarray(momenta.mT)
        for k in range(model.n):
            if np.any(model.armature[k]):
                places = range(*self.own[self.of_body[k]].indices(self.nv))
                of_all = model.kinds[k].has_attitude
                for i, place in enumerate(places):
                    M[..., place, place] += LongDouble(model.armature[k, 0 if of_all else i])
        return np.asarray(M)

    def axial_inertia(self, k: int) -> Any:
        """Return the inertia of rod k about itself, of which only relative rotations take account."""
        if self.method.coordinates == "joint angles":
            return LongDouble(0)
        return LongDouble(self.method.rod_axial_inertia) * LongDouble(rod_inertias(self.model)[k])

    def _on_one_path(self) -> Array:
        """(nv, nv) whether a branch of the tree has both coordinates: the sparsity of M."""
        found, paths = np.zeros((self.nv, self.nv), bool), list[list[int]]()
        for k, far in enumerate(self.model.body[:, 0]):
            path = [*(paths[far] if far >= 0 else [])]
            for chart in (*((self.of_rod[k],) if k in self.of_rod else ()), self.of_body[k]):
                path += range(*self.own[chart].indices(self.nv))
                found[self.own[chart], path] = True
            paths.append(path)
        return found | found.T

    def _standalone_columns(self) -> list[int]:
        """Columns of free bodies with nothing on them but welded bodies."""
        related, found = self._on_one_path(), list[int]()
        for own, chart in zip(self.own, self.charts, strict=True):
            if chart.is_point and np.sum(related[own.start]) == own.stop - own.start:
                found += range(own.start, own.stop)
        return found

    # -- bodies --------------------------------------------------------------------------------------

    def tree(self, q: list[Array], v: Array) -> _MovingTree:
        """The mechanism at coordinates and velocities; asked for in turn for the same arrays, it is one."""
        if self._tree is None or self._tree[0] is not q or self._tree[1] is not v:
            self._tree = q, v, _MovingTree(self, q, v)
        return self._tree[2]

    def attitudes(self, q: list[Array]) -> _Attitudes:
        """The attitudes at coordinates; asked for in turn for the same list, they are found once."""
        if self._attitudes is None or self._attitudes[0] is not q:
            self._attitudes = q, self._find_attitudes(q)
        return self._attitudes[1]

    def _find_attitudes(self, q: list[Array]) -> _Attitudes:
        found = _Attitudes([], {}, {}, {})
        for k, kind in enumerate(self.model.kinds):
            far, at = int(self.model.body[k, 0]), self.of_body[k]
            here = found.p[far] if far >= 0 else UNIT
            if k in self.of_rod:
                rod = self.of_rod[k]
                here, found.axes[rod] = _turned_by(here, self.charts[rod], q[rod])
                found.rods[k] = rotation_matrix(here)
            if kind.has_attitude:
                here, found.axes[at] = _turned_by(here, self.charts[at], q[at])
                found.turned[k] = rotation_matrix(here)
            else:
                first, last = normalised(self.model.turn[k].astype(LongDouble))
                here = quaternion_product(here, first)
                for i, (what, axis) in enumerate(kind.motions):
                    if what == "turn":
                        half = np.eye(3, dtype=LongDouble)[axis] * q[at][..., i : i + 1] / 2
                        here = quaternion_product(here, quaternion_exponential(half))
                here = quaternion_product(here, quaternion_conjugate(last))
            found.p.append(np.broadcast_to(here, (*q[at].shape[:-1], 4)))
        return found

    def bodies(self, q: list[Array], v: Array) -> BodyStates:
        """Return the motion of the mechanism's bodies.

        Args:
            v: (B, nv).

        Returns:
            Positions, attitudes, rates, and coordinates of joints.

        """
        tree, n = self.tree(q, v), self.model.n
        lead = v.shape[:-1]
        omega = tree.in_bodies(tree.w)
        r, velocity, omega_ = (stacked(x, lead) for x in (tree.r, tree.v, omega))
        u, udot, x, xdot = (
            np.zeros((*lead, n, size), LongDouble) for size in (3, 3, *[self.model.columns] * 2)
        )
        for k, (chart, kind) in enumerate(zip(self.of_body, self.model.kinds, strict=True)):
            if k in self.of_rod:
                u[..., k, :], udot[..., k, :] = (part[..., 0] for part in tree.rod_direction(k))
            if kind.motions:
                own, rates = q[chart][..., self.given[k]], v[..., self.own[chart]][..., self.given[k]]
                x[..., k, : own.shape[-1]], xdot[..., k, : own.shape[-1]] = own, rates
        kinetic, potential, momentum = tree.totals()
        energy = np.broadcast_to((kinetic + potential)[..., 0, 0], lead)
        every = np.stack(tree.p, -2), omega_, u, udot, r, velocity, x, xdot
        momentum = np.broadcast_to(momentum[..., 0], (*lead, 3))
        return BodyStates(*(one[..., self.place, :] for one in every), energy=energy, momentum=momentum)

    def body_accelerations(self) -> tuple[Array, Array]:
        """Return r̈ (B, N, 3), world axes, and ω̇′ (B, N, 3), body axes, at the states.

        Returns:
            Both [m/s², rad/s²].

        """
        q, v = self.start()
        _, found, tree = self._solved(q, v)
        turning = tree.in_bodies(found.turning)
        linear, angular = (stacked(x, v.shape[:-1]) for x in (found.acceleration, turning))
        return linear[..., self.place, :], angular[..., self.place, :]


class _MovingTree(Tree):
    """The mechanism at coordinates of its charts: scalars are (..., 1, 1), vectors (..., 3, 1)."""

    def __init__(self, charts: StepCharts, q: list[Array], v: Array, model: Model | None = None) -> None:
        self.charts, self.q = charts, q
        self.rates = [v[..., own] for own in charts.own]
        self.p, self.turned, self.rod_turned, self.turned_axes = charts.attitudes(q)
        self.rod_w: dict[int, Array] = {}
        self.rods: dict[int, tuple[Array, Array]] = {}  # u and u̇
        self.axes: dict[int, tuple[list[Array], Array]] = {}  # by chart: of its angles; α at q̈ = 0 of them
        super().__init__(floats(LongDouble), model or charts.model, charts.state)

    def joint_axes(self, k: int, side: int) -> Any:
        known = self.charts.joint_axes  # the same at all coordinates
        if (k, side) not in known:
            known[k, side] = super().joint_axes(k, side)
        return known[k, side]

    def coordinate(self, k: int, i: int) -> tuple[Any, Any]:
        at = self.charts.of_body[k]
        return self.q[at][..., i, None, None], self.rates[at][..., i, None, None]

    def attitude(self, k: int) -> tuple[Any, Any]:
        w = self.w[self.far[k]] if self.far[k] >= 0 else self.zero
        if k in self.charts.of_rod:
            w = self.rod_w[k] = self._spin_after(self.charts.of_rod[k], self.rod_turned[k], w)
            u = self.rod_turned[k][..., 2:]
            self.rods[k] = u, self.num.cross(w, u)
        here = self.turned[k]
        return here, self._spin_after(self.charts.of_body[k], here, w)

    def _spin_after(self, at: int, here: Array, w: Array) -> Array:
        """The angular velocity after a turn, w before it."""
        turned, rates, bias = self.turned_axes[at], self.rates[at], self.zero
        if not turned:
            return np.asarray(w + here @ rates[..., -3:, None])
        for i, axis in enumerate(turned):
            rate = rates[..., i - len(turned), None, None]
            bias = bias + self.num.cross(w, axis) * rate
            w = w + axis * rate
        self.axes[at] = turned, bias
        return w

    def free_point(self, k: int) -> tuple[Any, Any]:
        at = self.charts.of_body[k]
        chart, r, v = self.charts.charts[at], self.q[at][..., :3], self.rates[at][..., :3, None]
        if not chart.axes:
            r = self.q[at][..., 4:]
        return r[..., None], self.turned[k] @ v if chart.is_rigid else v

    def rod_direction(self, k: int) -> tuple[Any, Any]:
        return self.rods[k]

    def rod_spin(self, k: int) -> Any:
        """The rod's angular velocity about itself."""
        return self.num.dot(self.rods[k][0], self.rod_w[k])

    def force_across(self, k: int) -> Any:
        """What turns the angular momentum J σ u of rod k: F ⟂ u with −ℓ u × F = J σ u̇."""
        momentum = self.rod_spin(k) * self.charts.axial_inertia(k)
        u, udot = self.rods[k]
        return self.num.cross(u, udot) * (momentum / LongDouble(self.model.length[k]))

    def velocity_rates(self, found: Solution) -> Array:
        """Return v̇ (..., nv) of accelerations."""
        out: list[Array] = []
        for k, kind in enumerate(self.model.kinds):
            far = self.far[k]
            own, w, alpha = self.charts.of_body[k], self.zero, self.zero
            if far >= 0:
                w, alpha = self.w[far], found.turning[far]
            if not kind.has_attitude:
                out += [rate[..., 0] for rate in found.rates[k]]
                continue
            if kind.holds_distance:
                u, udot = self.rods[k]
                bend = found.rates[k][0] / LongDouble(self.model.length[k])  # ü
                wanted = self.num.cross(u, bend) + udot * self.rod_spin(k)
                rates, alpha_rod = self._rates_of_turn(
                    self.charts.of_rod[k], self.rod_turned[k], (w, self.rod_w[k]), (alpha, wanted), u
                )
                out.append(rates)
                w, alpha = self.rod_w[k], alpha_rod
            if kind.holds_nothing:
                shift = found.acceleration[k]
                if self.charts.charts[own].is_rigid:
                    shift = self.A[k].mT @ (shift - self.num.cross(self.w[k], self.v[k]))
                out.append(shift[..., 0])
            turns = (w, self.w[k]), (alpha, found.turning[k])
            out.append(self._rates_of_turn(own, self.turned[k], *turns)[0])
        return _joined(out)

    def _rates_of_turn(
        self, at: int, here: Array, w: tuple[Array, Array], alpha: tuple[Array, Array], rod: Any = None
    ) -> tuple[Array, Array]:
        """Rates (..., 2 or 3) of a turn's velocities by w and α before and after it, and that α after it.

        A rod's α along itself is what its angles make it.
        """
        if at not in self.axes:
            gained = alpha[1] - alpha[0] - self.num.cross(w[1], w[1] - w[0])
            return (here.mT @ gained)[..., 0], alpha[1]
        turned, bias = self.axes[at]
        three = [x[..., 0] for x in (*turned, *(() if rod is None else (rod,)))]
        rates = _solve3(three, (alpha[1] - alpha[0] - bias)[..., 0])[..., : len(turned)]
        after = alpha[0] + bias + sum(a * rates[..., i, None, None] for i, a in enumerate(turned))
        return rates, after

    def holding_wrenches(self) -> list[Mapping[int, tuple[Any, Any]]]:
        """Wrenches, and what is against them, that belong to the rows of `holding_shares`."""
        found: list[Mapping[int, tuple[Any, Any]]] = []
        for b, c in self.charts.ends:
            if self.charts.method.gap_form == "logarithm":  # about and along the axes of b, at its centre
                turns = pushes = self.A[b]
                lever = self.r[b] - self.r[c]
            else:
                e = self._turn_between(c, b)
                turns = self.A[c] @ np.swapaxes(_rate_of_vector(e, np.eye(3, dtype=LongDouble)), -1, -2)
                pushes, lever = np.eye(3, dtype=LongDouble), None
            axes = [x[..., i : i + 1] for x in (turns, pushes) for i in range(3)]
            found += [self.end_wrench(b, c, e, i > 2, lever) for i, e in enumerate(axes)]
        return found + [self._pitch_wrench(k, pitch) for k, pitch in self.charts.held.items()]

    def _pitch_wrench(self, k: int, pitch: float) -> Mapping[int, tuple[Any, Any]]:
        """A unit force along the slide of a cylindrical joint, and minus the pitch of moment."""
        axis, far = self.blocks[k][0].axis, self.far[k]
        turn = axis * LongDouble(pitch)
        found = {k: (axis, self.num.cross(self.near[k], axis) - turn)}
        if far >= 0:
            lever = self.r[k] + self.near[k] - self.r[far]
            found[far] = -axis, turn - self.num.cross(lever, axis)
        return found

    def _turn_between(self, b: int, c: int) -> Array:
        """The quaternion from the attitude of b to that of c."""
        return quaternion_product(quaternion_conjugate(self.p[b]), self.p[c])

    def holding_shares(self, found: Solution) -> Array:
        """Compute 1 and the λ (..., 1 + rows, 1) of the wrenches that make gaps as the method declares."""
        lead = self.rates[0].shape[:-1]
        rows_of = {"logarithm": self._twist_rows, "distance and quaternion": self._distance_rows}
        answers = list[Array]()
        for pair in self.charts.ends:
            motions = [
                [
                    np.broadcast_to(x[k], (*lead, *x[k].shape[-2:]))
                    for x in (self.w, self.v, self.r, found.acceleration, found.turning)
                ]
                for k in pair
            ]
            answers.append(rows_of[self.charts.method.gap_form](pair, *motions))
        for k, pitch in self.charts.held.items():
            row = self._pitch_row(k, LongDouble(pitch), found)
            answers.append(np.broadcast_to(row, (*lead, *row.shape[-2:])))
        rows = np.concatenate(answers, -2)
        K, missing = rows[..., 1:], -rows[..., 0]
        size = np.einsum("...ii->...i", K)
        # a row that is 0, as those out of a plane, is met anyway
        scale = 1 / np.sqrt(np.maximum(size, LongDouble(1e-30) * np.max(size, -1, keepdims=True)))
        K, missing = K * scale[..., None] * scale[..., None, :], missing * scale
        unit = np.eye(K.shape[-1])
        # in doubles: the iterations take its rounding away with the damping
        inverse = floats().solve(np.asarray(K + PROXIMAL_DAMPING * unit, float), unit).astype(LongDouble)
        push = np.zeros_like(missing)
        for _ in range(PROXIMAL_STEPS):
            push = push + np.matvec(inverse, missing - np.matvec(K, push))
        return np.concatenate([np.ones_like(push[..., :1]), scale * push], -1)[..., None]

    def _twist_rows(self, pair: tuple[int, int], *motions: Sequence[Array]) -> Array:
        """What is missing of the rate of one end's twist in the other, by the solution and each wrench."""
        num, a, (b, c) = self.num, LongDouble(self.charts.method.gap_correction), pair
        back, here = self.A[b].mT, self.r[b]
        twist, change = list[Array](), list[Array]()
        for w, v, at, A, alpha in motions:
            twist.append(np.concatenate([w, v - num.cross(w, at)], -2)[..., 0])
            carried = num.widened(num.cross(w, v), A)
            change.append(np.concatenate([alpha, A + num.mul(num.cross_matrix(at), alpha) - carried], -2))
        apart = twist[0] - twist[1]
        turn = rotation_vector(self._turn_between(b, c))
        # the logarithm's linear part: Σ Bₖ/k! (turn ×)ᵏ shift, B₁ = −½; turns of less than 2 rad
        shift = (back @ (self.r[c] - here))[..., 0]
        gap = np.concatenate([turn, _bernoulli_series(cross, turn, shift, -0.5, BERNOULLI)], -1)
        wanted = (-_twist_cross(apart, twist[1]) - 2 * a * apart)[..., None]
        missing = change[0] - change[1]
        missing = np.concatenate([missing[..., :1] - wanted, missing[..., 1:]], -1)
        moving = missing[..., 3:, :] - num.mul(num.cross_matrix(here), missing[..., :3, :])
        rows = np.concatenate([back @ missing[..., :3, :], back @ moving], -2)
        rows[..., 0] -= a * a * gap
        return np.asarray(rows)

    def _distance_rows(self, pair: tuple[int, int], *motions: Sequence[Array]) -> Array:
        """What is missing of ẍ, x the vector of a quaternion e, then a distance.

        In the frame of the second end, with the difference β of the angular velocities,

            ė = ½ β e,    ẍ = ½ (e₀ β̇ + β̇ × x + ė₀ β + β × ẋ)
        """
        a, (b, c) = LongDouble(self.charts.method.gap_correction), pair
        back, e = self.A[c].mT, self._turn_between(c, b)
        (w, v, at, A, alpha), (w_c, v_c, at_c, A_c, alpha_c) = motions
        spin, carried = ((back @ x)[..., 0] for x in (w - w_c, w_c))
        rate = _rate_of_vector(e, spin[..., None])[..., 0]
        scalar_rate = -np.sum(spin * e[..., 1:], -1, keepdims=True) / 2
        turning = back @ (alpha - alpha_c)
        turning[..., 0] -= cross(carried, spin)
        turned = _rate_of_vector(e, turning)
        turned[..., 0] += (scalar_rate * spin + cross(spin, rate)) / 2 + 2 * a * rate + a * a * e[..., 1:]
        moved = A - A_c
        moved[..., 0] += (2 * a * (v - v_c) + a * a * (at - at_c))[..., 0]
        return np.concatenate([turned, moved], -2)

    def _pitch_row(self, k: int, pitch: Any, found: Solution) -> Array:
        """What is missing of ẍ, x the slide of joint k less the pitch times its turn."""
        a, (slide, turn) = LongDouble(self.charts.method.gap_correction), found.rates[k]
        (x, rate), (angle, turning) = (self.coordinate(k, i) for i in range(2))
        row = slide - pitch * turn
        row[..., :1] += 2 * a * (rate - pitch * turning) + a * a * (x - pitch * angle)
        return np.asarray(row)


# Bₖ/k! of even k from 2 on: 1/12, −1/720, …
BERNOULLI = [
    LongDouble(a) / b
    for a, b in (
        (1, 12), (-1, 720), (1, 30240), (-1, 1209600), (1, 47900160), (-691, 1307674368000),
        (1, 74724249600), (-3617, 10670622842880000),
    )
]  # fmt: skip


# -- algebra in extended precision -------------------------------------------------------------------


def _joined(parts: Sequence[Array]) -> Array:
    """(..., Σ ·) of (..., ·)."""
    lead = np.broadcast_shapes(*(x.shape[:-1] for x in parts))
    return np.concatenate([np.broadcast_to(x, (*lead, x.shape[-1])) for x in parts], -1)


def _turned_by(before: Array, chart: _Chart, q: Array) -> tuple[Array, list[Array]]:
    """The attitude (..., 4) after a turn, and the axes (..., 3, 1) of its angles."""
    if not chart.axes:
        return quaternion_product(before, q[..., :4]), []
    turned = list[Array]()
    for i, axis in enumerate(chart.axes):
        turned.append(rotation_matrix(before) @ axis[..., None])
        half = axis * q[..., i - len(chart.axes), None] / 2
        before = quaternion_product(before, quaternion_exponential(half))
    return quaternion_product(before, chart.rest), turned


def _twist_cross(a: Array, b: Array) -> Array:
    """Rate of a twist b (..., 6) that is carried by the twist a."""
    w, v = a[..., :3], a[..., 3:]
    return np.concatenate([cross(w, b[..., :3]), cross(w, b[..., 3:]) + cross(v, b[..., :3])], -1)


def _rate_of_vector(e: Array, spins: Array) -> Array:
    """½ (e₀ β + β × x) (..., 3, M) of the columns β of angular velocities, x the vector of a quaternion e."""
    x = e[..., None, 1:]
    return np.asarray(np.swapaxes(e[..., None, :1] * spins.mT + cross(spins.mT, x), -1, -2) / 2)


def _bernoulli_series(
    bracket: Callable[[Array, Array], Array], by: Array, v: Array, first: float, weights: Sequence[Any]
) -> Array:
    """V + B₁ [by, v] + Σ weights × the brackets of even order."""
    power = bracket(by, v)
    total = v + first * power
    for weight in weights:
        power = bracket(by, power)
        total, power = total + weight * power, bracket(by, power)
    return total


def _left_jacobian(t: Array) -> Array:
    """V (..., 3, 3) with exp(twist) = (exp(t), V ρ): 1 + (1 − cos θ)/θ² t̃ + (θ − sin θ)/θ³ t̃²."""
    square = np.sum(t * t, -1)[..., None, None]
    angle, small = np.sqrt(square), square < 1e-4
    safe = np.where(small, LongDouble(1), angle)
    first = np.where(
        small, 0.5 - square / 24 + square**2 / 720 - square**3 / 40320, (1 - np.cos(safe)) / safe**2
    )
    sixth = LongDouble(1) / 6
    second = np.where(
        small, sixth - square / 120 + square**2 / 5040 - square**3 / 362880, (safe - np.sin(safe)) / safe**3
    )
    skew = cross_matrix(t)
    return np.asarray(np.eye(3, dtype=LongDouble) + first * skew + second * (skew @ skew))


def solve_definite(S: Array, b: Array) -> Array:
    """Solve S x = b without pivoting.

    Args:
        S: (..., n, n), its symmetric part positive definite.
        b: (..., n).

    Returns:
        x (..., n).

    """
    S, b = S.copy(), b.copy()
    n = S.shape[-1]
    for k in range(n - 1):
        factor = S[..., k + 1 :, k] / S[..., k, k, None]
        S[..., k + 1 :, k + 1 :] -= factor[..., None] * S[..., k, None, k + 1 :]
        b[..., k + 1 :] -= factor * b[..., k, None]
    for k in reversed(range(n)):
        b[..., k] = (b[..., k] - np.sum(S[..., k, k + 1 :] * b[..., k + 1 :], -1)) / S[..., k, k]
    return b


def _solve3(three: Sequence[Array], x: Array) -> Array:
    """Coefficients (..., 3) of x in three vectors: Cramer's rule."""
    a, b, c = three
    bc = cross(b, c)
    parts = [np.sum(x * bc, -1), np.sum(x * cross(c, a), -1), np.sum(x * cross(a, b), -1)]
    return np.asarray(np.stack(parts, -1) / np.sum(a * bc, -1)[..., None])
