"""Check a certified solution by the definition of the mechanism alone, in ball arithmetic (python-flint).

No equation of motion is derived here: no mass matrix, no Jacobian, no right-hand side γ.  With the attitudes
A, positions r, velocities and accelerations of the solution, each body moves as a series in time,

    r(t) = r + v t + ½ r̈ t²,    A(t) = A (1 + ω̃ t + ½ (ω̃² + ω̇̃) t²)          (ω, ω̇ in body axes)

and what is checked is what the words of the model say:

- the coordinates and rates of each joint are the state's (in a loop they are near it, since some follow);
- every row of every joint, uᵀw of the series (`KINDS`), has the coefficients 0, 1 and 2 equal to 0;
- m r̈ and d/dt (A J ω) are what weight, loads, drag, springs and the joints' wrenches give;
- each joint's wrench does on its free motions the work of its rotor, damper, spring and effort;
- energies and momentum are the sums over bodies and elements, and ½ νᵀ M ν is the kinetic energy.

Every statement is the difference of two sides as a ball: it must contain 0 and be small against the terms.
The equations that are checked share no text with this file but the records of the model.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import joint_coordinates, minimal_rates
from plumbline.processes.exceptions import PlumblineError

MAX_DIFFERENCE = 1e-18  # of the two sides, relative to the size of the terms
MAX_LOOP_DEVIATION = 1e-8  # of a loop's pose and rates from the state's doubles, relative to their size
MAX_OPEN_DEVIATION = 1e-12  # of what redundant rows of loops leave open, since rounded geometry is not exact
_AXES, _WORLD, _FAR, _NEAR = range(3), "ijk", "xyz", "XYZ"


class DefinitionViolated(PlumblineError, ArithmeticError):
    """A certified solution contradicts the definition of the mechanism: the truth is in doubt."""


@dataclass(frozen=True, eq=False)
class _Series:
    """The motion of a body: coefficients of 1, t and t²."""

    turn: list[Any]  # 3×3 matrices, body → world
    place: list[Any]  # 3×1, of the centre of mass


def definition_holds(flint: Any, model: Model, state: State, balls: dict[str, Any]) -> bool:
    """Check a solution at the working precision.

    Args:
        state: the state, of which the minimal coordinates are used.
        balls: the solution, as `plumbline.truth.certified_state.enclose_quantities` returns it.

    Returns:
        Whether every statement was checked to `MAX_DIFFERENCE`; False where a ball is too wide for that.

    Raises:
        DefinitionViolated: a statement is false; the message names it.

    """
    check = _Check(flint, model, state, balls)
    check.run()
    return check.is_sharp


class _Check:
    """One solution: lists over bodies and joints of matrices of balls, positions and forces in world axes."""

    def __init__(self, flint: Any, model: Model, state: State, balls: dict[str, Any]) -> None:
        self.mat, self.arb, self.model, self.state, self.balls = flint.arb_mat, flint.arb, model, state, balls
        self.is_sharp, self.scale = True, balls["scale"]
        # Rounded geometry leaves relative gaps of 1e-20 to 1e-16 (of turned loops of the catalogue); those of
        # exact geometry are radii of balls, far smaller, and leave the slack in proportion.
        size, gap = max(self.scale["r"], self.scale["v"]), self.scale.get("gap", 0.0)
        self.slack = MAX_OPEN_DEVIATION * min(1.0, gap / (MAX_DIFFERENCE * size)) if gap else 0.0
        self.zero, self.one = self.mat(3, 1, [0] * 3), self.mat(3, 3, [1, 0, 0, 0, 1, 0, 0, 0, 1])
        self.world = _Series([self.one, self.mat(3, 3), self.mat(3, 3)], [self.zero] * 3)
        self.A = [self.mat(3, 3, own) for own in balls["attitude"]]
        moments = balls.get("joint_moment", [[0] * 3] * len(model.kind))
        self.r, self.v, self.a, self.omega, self.alpha, self.force, self.moment = (
            [self.mat(3, 1, own) for own in rows]
            for rows in (
                *(balls[name] for name in ("r", "v", "acceleration", "angular_velocity")),
                *(balls[name] for name in ("angular_acceleration", "joint_reaction")),
                moments,
            )
        )
        self.bodies = [self._series(k) for k in range(model.n)]
        rate, speed = self.scale["angular_velocity"], self.scale["v"]
        length, acceleration = self.scale["r"], self.scale["acceleration"]
        # of the coefficients of lengths, of products of unit vectors and of a squared length
        self.length_sizes = (length, speed, acceleration)
        self.unit_sizes = (1.0, rate, rate**2 + self.scale["angular_acceleration"])
        self.square_sizes = (length**2, length * speed, length * acceleration + speed**2)
        inertia = float(np.sum(np.linalg.norm(model.inertia, axis=(1, 2))))
        self.moment_size = self.scale["joint_reaction"] * length + inertia * self.unit_sizes[2]
        self.moment_size += float(np.max(np.abs(model.moment), initial=0.0))

    def run(self) -> None:
        """Check every statement."""
        model, kinetic, potential, momentum = self.model, self.arb(0), self.arb(0), self.zero
        pulls = [self._loads(k) for k in range(model.n)]
        for number in range(len(model.spring_body)):
            potential += self._pull_of_spring(number, pulls)
        given = joint_coordinates(model, self.state)
        for k in range(len(model.kind)):
            of_rotor, of_spring = self._joint(k, [x[k] for x in given])
            kinetic, potential = kinetic + of_rotor, potential + of_spring
            far, near = (int(body) for body in model.body[k])
            at = self.r[near] + self.A[near] * self._vector(model.point[k, 1])
            for body, sign in ((near, 1), (far, -1)):
                self._push(pulls, body, at, self.force[k] * sign, self.moment[k] * sign)
        for k, (force, moment) in enumerate(pulls):
            m, spin = self.arb(float(model.mass[k])), self._matrix(model.inertia[k]) * self.omega[k]
            change = self.bodies[k].turn[1] * spin
            change += self.A[k] * (self._matrix(model.inertia[k]) * self.alpha[k])
            size = self.scale["joint_reaction"]
            self._equal(f"momentum of body {k + 1}", self.a[k] * m - force, size, self.slack)
            self._equal(f"angular momentum of body {k + 1}", change - moment, self.moment_size, self.slack)
            kinetic += (m * self._dot(self.v[k], self.v[k]) + self._dot(self.omega[k], spin)) / 2
            potential -= m * self._dot(self._vector(model.gravity), self.r[k])
            momentum += self._cross(self.r[k]) * self.v[k] * m + self.A[k] * spin
        self._totals(kinetic, potential, momentum)

    def _totals(self, kinetic: Any, potential: Any, momentum: Any) -> None:
        """Energies, the angular momentum of the mechanism, and the mass matrix at the state's rates."""
        found = {"kinetic_energy": [kinetic], "potential_energy": [potential]}
        for name, total in (found | {"angular_momentum": momentum.entries()}).items():
            pairs = zip(total, self.balls[name], strict=True)
            self._equal(name.replace("_", " "), [x - y for x, y in pairs], self.scale[name], self.slack)
        if self.balls.get("mass_matrix"):
            nu = self.mat([[float(x)] for x in minimal_rates(self.model, self.state)])
            energy = (nu.transpose() * self.mat(self.balls["mass_matrix"]) * nu)[0, 0] / 2
            self._equal("mass matrix", [energy - kinetic], self.scale["kinetic_energy"])

    def _series(self, k: int) -> _Series:
        """The motion of body k."""
        A, w = self.A[k], self._cross(self.omega[k])
        second = (w * w + self._cross(self.alpha[k])) * self.arb("0.5")
        return _Series([A, A * w, A * second], [self.r[k], self.v[k], self.a[k] * self.arb("0.5")])

    def _loads(self, k: int) -> tuple[Any, Any]:
        """Force and moment about the centre of mass of body k, besides springs and joints."""
        model, spin = self.model, self.A[k] * self.omega[k]
        force = self._vector(model.gravity) * self.arb(float(model.mass[k])) + self._vector(model.force[k])
        force -= self.v[k] * self.arb(float(model.drag_force[k]))
        return force, self.A[k] * self._vector(model.moment[k]) - spin * self.arb(float(model.drag_moment[k]))

    def _pull_of_spring(self, number: int, pulls: list[tuple[Any, Any]]) -> Any:
        """Add the pull of a spring between points to both bodies; returns its potential energy."""
        model, ends = self.model, []
        bodies = [int(body) for body in model.spring_body[number]]
        for body, point in zip(bodies, model.spring_point[number], strict=True):
            motion, s = self._body(body), self._vector(point)
            ends.append([place + turn * s for place, turn in zip(motion.place, motion.turn, strict=True)])
        d, rate = (second - first for first, second in list(zip(*ends, strict=True))[:2])
        length, k = self._dot(d, d).sqrt(), self.arb(float(model.spring_stiffness[number]))
        stretch = length - self.arb(float(model.spring_length[number]))
        tension = k * stretch + self.arb(float(model.spring_damping[number])) * self._dot(d, rate) / length
        for body, (at, *_), sign in zip(bodies, ends, (1, -1), strict=True):
            self._push(pulls, body, at, d * (tension * sign / length), self.zero)
        return k * stretch * stretch / 2

    def _push(self, pulls: list[tuple[Any, Any]], body: int, at: Any, force: Any, moment: Any) -> None:
        """Add a force at a place, and a moment, to those of a body; the world bears them."""
        if body >= 0:
            moment = moment + self._cross(at - self.r[body]) * force
            pulls[body] = pulls[body][0] + force, pulls[body][1] + moment

    def _joint(self, k: int, given: list[Array]) -> tuple[Any, Any]:
        """Rows, coordinates and work of joint k; returns the energies of its rotor and its spring."""
        model, kind = self.model, self.model.kinds[k]
        (far, near), name = (self._body(int(body)) for body in model.body[k]), f"joint {k + 1}"
        s, t = (self._vector(point) for point in model.point[k, ::-1])
        d = [near.place[i] + near.turn[i] * s - far.place[i] - far.turn[i] * t for i in _AXES]
        axes = [[turn * self._rotation(q) for turn in motion.turn]
                for motion, q in zip((far, near), model.turn[k], strict=True)]  # fmt: skip
        columns = {_FAR: axes[0], _NEAR: axes[1], "d": d, _WORLD: self.world.turn}
        products: dict[tuple[str, str], list[Any]] = {}

        def coefficients(u: str, w: str) -> list[Any]:
            """Of uᵀw, three balls."""
            (names, i), (others, j) = (next((g, g.index(v)) for g in columns if v in g) for v in (u, w))
            if (names, others) not in products:
                U, W = [c.transpose() for c in columns[names]], columns[others]
                found = [U[0] * W[0], U[0] * W[1] + U[1] * W[0], U[0] * W[2] + U[1] * W[1] + U[2] * W[0]]
                products[names, others] = found
            return [c[i, j] for c in products[names, others]]

        ell, is_closing = self.arb(float(model.length[k])), k >= model.n
        for u, w in kind.rows:
            row, sizes = coefficients(u, w), self.length_sizes if w == "d" else self.unit_sizes
            if u == w:
                row, sizes = [row[0] - ell * ell, *row[1:]], self.square_sizes
            elif kind.has_pitch and (u, w) == ("z", "d"):
                angle = self._angle(coefficients, 2, 0, self.arb(float(given[2][0])))
                row = [value - ell * turn for value, turn in zip(row, angle, strict=True)]
            for order, (value, size) in enumerate(zip(row, sizes, strict=True)):
                slack = self.slack if is_closing else 0.0
                self._equal(f"{name}: row {u}{w}, coefficient {order}", [value], size, slack)
        if kind.has_attitude:
            self._attitude(k, d, given, is_closing)
            return self._work_at_point(k, axes, d[0])
        return self._work_of_coordinates(k, coefficients, [c[0] for c in axes], given, is_closing)

    def _attitude(self, k: int, d: list[Any], given: list[Array], is_closing: bool) -> None:
        """Compare a free attitude, the direction of a rod and a free point with the state."""
        if is_closing:
            return
        model, state, name = self.model, self.state, f"coordinates of body {k + 1}"
        turned = self.A[k] - self._rotation(state.p[k])
        spin = self.omega[k] - self._vector(state.omega[k])
        self._equal(name, turned, 1.0, self._deviation)
        self._equal(f"rates of body {k + 1}", spin, self.unit_sizes[1], self._deviation)
        kind = model.kinds[k]
        if kind.holds_distance:
            u, rate = (self._vector(x) for x in given[:2])
            u = u * (1 / self._dot(u, u).sqrt())
            rate = rate - u * self._dot(u, rate)
            ell = self.arb(float(model.length[k]))
            d = [d[0] - u * ell, d[1] - rate * ell]
        elif kind.holds_nothing:
            d = [self.r[k] - self._vector(state.r[k]), self.v[k] - self._vector(state.v[k])]
        else:
            return
        for what, difference, size in zip(
            (name, f"rates of body {k + 1}"), d, self.length_sizes, strict=False
        ):
            self._equal(what, difference, size, self._deviation)

    def _work_at_point(self, k: int, axes: list[list[Any]], d: Any) -> tuple[Any, Any]:
        """Of a joint that leaves the attitude free: it holds its point, its distance or nothing."""
        model, kind, name = self.model, self.model.kinds[k], f"wrench of joint {k + 1}"
        a, c, stiffness = (self.arb(float(x[k, 0])) for x in (model.armature, model.damping, model.stiffness))
        (wa, ra), (wb, rb) = (self._spin(int(body)) for body in model.body[k])
        spin = wb - wa
        R = axes[0][0].transpose() * axes[1][0]
        z = axes[0][0] * self.mat(3, 1, [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        z = z * self.arb("0.5")  # of length sin θ
        theta = self.arb.atan2(
            self._dot(z, z).nonnegative_part().sqrt(), (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2
        )
        turn = z * (1 / theta.sinc()) if model.stiffness[k, 0] else self.zero
        moment = turn * stiffness + spin * c + (rb - ra - self._cross(wa) * spin) * a
        self._equal(name, self.moment[k] + moment, self.moment_size, self.slack)
        if kind.holds_distance:
            across = self._cross(d) * self.force[k]
            self._equal(name, across, self.moment_size, self.slack)
        elif kind.holds_nothing:
            self._equal(name, self.force[k], self.scale["joint_reaction"], self.slack)
        return a * self._dot(spin, spin) / 2, stiffness * self._dot(turn, turn) / 2

    def _work_of_coordinates(
        self, k: int, coefficients: Any, axes: list[Any], given: list[Array], is_closing: bool
    ) -> tuple[Any, Any]:
        """Of a joint with scalar coordinates: their values, rates, second derivatives and power."""
        model, motions, name = self.model, self.model.kinds[k].motions, f"joint {k + 1}"
        turns = [axis for what, axis in motions if what == "turn"]
        for axis in {0: _AXES, 1: turns}.get(len(turns), ()):  # axes that the joint does not turn
            row = coefficients(_FAR[axis], _NEAR[axis])
            slack = max(self._deviation, self.slack)
            self._equal(f"{name}: {_FAR[axis]}{_NEAR[axis]}", [row[0] - 1], 1.0, slack)
        kinetic = potential = self.arb(0)
        passed = 0  # turns between the far body and this motion
        for i, (what, axis) in enumerate(motions):
            # the axis as the far body carries it, or after the first turn as the near body does
            side = 0 if passed == 0 else 1
            along = self.mat(3, 1, [axes[side][row, axis] for row in _AXES])
            x0, rate0 = self.arb(float(given[2][i])), self.arb(float(given[3][i]))
            if what == "slide":
                value, rate, second = coefficients((_FAR, _NEAR)[side][axis], "d")
                push, sizes = self._dot(along, self.force[k]), self.length_sizes
                push_size = self.scale["joint_reaction"]
                value = value - x0
            else:
                own = (axis + 1 + passed) % 3
                value, rate, second = self._angle(coefficients, axis, own, x0)
                value = value - x0
                push, sizes, passed = self._dot(along, self.moment[k]), self.unit_sizes, passed + 1
                push_size = self.moment_size
                if model.kinds[k].has_pitch:
                    pitch = self.arb(float(model.length[k]))
                    push += pitch * self._dot(along, self.force[k])
                    push_size += abs(float(model.length[k])) * self.scale["joint_reaction"]
            if not is_closing:
                self._equal(f"{name}: coordinate {i + 1}", [value], max(1.0, sizes[0]), self._deviation)
                self._equal(f"{name}: rate {i + 1}", [rate - rate0], sizes[1], self._deviation)
            a, damping, stiffness, rest, effort = (
                self.arb(float(x[k, i]))
                for x in (model.armature, model.damping, model.stiffness, model.rest, model.effort)
            )
            x = x0 + value - rest
            given_push = effort - stiffness * x - damping * rate - a * (2 * second)
            self._equal(f"{name}: work on motion {i + 1}", [push - given_push], push_size, self.slack)
            kinetic, potential = kinetic + a * rate * rate / 2, potential + stiffness * x * x / 2
        return kinetic, potential

    def _angle(self, coefficients: Any, axis: int, own: int, near: Any) -> list[Any]:
        """Coefficients of the turn about an axis, ``own`` perpendicular to all turns, near a value."""
        j, m = (axis + 1) % 3, (axis + 2) % 3
        sine, cosine = coefficients(_FAR[m], _NEAR[j]), coefficients(_FAR[own], _NEAR[own])
        s, c = near.sin_cos()
        off = self.arb.atan2(sine[0] * c - cosine[0] * s, cosine[0] * c + sine[0] * s)
        return [near + off, *(cosine[0] * sine[n] - sine[0] * cosine[n] for n in (1, 2))]

    @property
    def _deviation(self) -> float:
        """How far coordinates may be from the state's, relative to their size."""
        return MAX_LOOP_DEVIATION if self.model.has_loops else 0.0

    def _body(self, body: int) -> _Series:
        return self.bodies[body] if body >= 0 else self.world

    def _spin(self, body: int) -> tuple[Any, Any]:
        """Angular velocity and acceleration of a body or the world, world axes."""
        if body < 0:
            return self.zero, self.zero
        return self.A[body] * self.omega[body], self.A[body] * self.alpha[body]

    def _equal(self, what: str, difference: Any, size: float, slack: float = 0.0) -> None:
        """Require that balls contain 0 and are small, or are below ``slack`` of the size for certain."""
        for x in difference if isinstance(difference, list) else difference.entries():
            bound = float(abs(x).upper())
            if bound <= slack * size:
                continue
            if float(abs(x).lower()) > slack * size:
                raise DefinitionViolated(
                    f"{what}: the certified solution contradicts the definition of the mechanism by "
                    f"{float(abs(x).mid()):.3g}, terms of {size:.3g}"
                )
            if not bound <= MAX_DIFFERENCE * size:
                self.is_sharp = False

    def _vector(self, v: Iterable[float]) -> Any:
        return self.mat(3, 1, [float(x) for x in v])

    def _matrix(self, m: Array) -> Any:
        return self.mat(3, 3, [float(x) for x in np.ravel(m)])

    @staticmethod
    def _dot(a: Any, b: Any) -> Any:
        return a[0, 0] * b[0, 0] + a[1, 0] * b[1, 0] + a[2, 0] * b[2, 0]

    def _cross(self, a: Any) -> Any:
        """Matrix of the cross product with a vector."""
        found = self.mat(3, 3)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            found[k, j], found[j, k] = a[i, 0], -a[i, 0]
        return found

    def _rotation(self, p: Array) -> Any:
        """1 + 2 (w ẽ + ẽ²)/pᵀp of a quaternion p = (w, e) of any length but 0."""
        e = self._cross(self._vector(p[1:]))
        size = sum((self.arb(float(x)) * self.arb(float(x)) for x in p), self.arb(0))
        return self.one + (e * self.arb(float(p[0])) + e * e) * (2 / size)
