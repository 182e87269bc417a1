"""The equations of motion of a tree of bodies on joints, in any kind of numbers.

Articulated bodies (Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 7), each about its own joint's
near point P and in world axes.  With the acceleration a of P and the angular acceleration α, the bodies from
a joint on need the wrench

    F = c a + b α + f,    N = bᵀa + i α + n,

N about P.  A joint is made of at most two blocks: all turns, all slides, one turn or one slide, or the
swing of a rod.  Each block takes its motions out, from the near body to the far one:

    one motion S with effort τ and rotor a      M ← M − U Uᵀ/D,  U = M S,  D = SᵀU + a
    all turns without rotors                    c ← c − b i⁻¹ bᵀ,  b = i = 0
    the swing of a rod along u                  c ← u uᵀ/(uᵀ c⁻¹ u)

What is exactly 0 after a block is not computed (None).  About the world's origin the same recursion loses a
digit per body.  Whether a mechanism is a chain or a tree plays no part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from plumbline.equations.arithmetic import Arithmetic
from plumbline.model.datatypes import JOINT_ELEMENTS, Model, State
from plumbline.model.kinematics import own_rates, path_to_world, rate_count

SUMS = ("kinetic_energy", "potential_energy", "angular_momentum")


@dataclass(frozen=True, eq=False)
class Articulated:
    """F = c a + b α + f, N = bᵀa + i α + n; b, i and n are None where they are exactly 0."""

    c: Any
    b: Any
    i: Any
    f: Any
    n: Any


@dataclass(frozen=True, eq=False)
class Solution:
    """What a tree does: lists over bodies and their joints, world axes."""

    acceleration: list[Any]  # of the centres of mass
    turning: list[Any]  # angular acceleration
    force: list[Any]  # of joint k on body k
    moment: list[Any]  # the same about the near point; None where it is exactly 0
    # of each joint's blocks: ẍ of one motion, α of the body, a of a free point, or of the near end of a rod
    # what it has more than the far end
    rates: list[list[Any]]

    def combined(self, combine: Callable[[Any], Any]) -> Solution:
        """Apply one function to every vector.

        Args:
            combine: of a matrix with a column per wrench, to a vector.

        """
        vectors = {name: rows for name, rows in vars(self).items() if name != "rates"}
        found = {name: [x if x is None else combine(x) for x in rows] for name, rows in vectors.items()}
        return Solution(**found, rates=[[combine(x) for x in blocks] for blocks in self.rates])


class _Swing:
    """The near point moves on a sphere: uᵀa = uᵀa_far − ℓ u̇², F along u but for what a spinning rod holds."""

    armature = None

    def __init__(self, num: Arithmetic, u: Any, pull: Any, length: Any, across: Any) -> None:
        self.num, self.u, self.pull, self.length = num, u, num.from_rows([[pull]]), length
        self.across = across

    def reduce(self, x: Articulated) -> Articulated:
        num = self.num
        across = None if self.across is None else num.widened(self.across, x.f)
        self.f = x.f if across is None else x.f - across
        self.inverse = num.inverse(x.c)
        w = num.mul(self.inverse, self.u)
        self.size = 1 / num.dot(self.u, w)
        self.push = num.widened(self.pull * self.size, x.f) + num.mul(num.transpose(w), self.f) * self.size
        c = num.symmetric(num.mul(self.u * self.size, num.transpose(self.u)))
        f = num.mul(self.u, self.push)
        return Articulated(c, None, None, f if across is None else f + across, None)

    def advance(self, a: Any, alpha: Any) -> tuple[Any, Any, Any]:
        num = self.num
        tension = num.mul(num.transpose(self.u), a) * self.size + self.push
        near = num.mul(self.inverse, num.mul(self.u, tension) - self.f)
        return near, alpha, near - a


class _Slides:
    """The near point moves freely, with no force on it."""

    armature = None

    def __init__(self, num: Arithmetic) -> None:
        self.num = num

    def reduce(self, x: Articulated) -> Articulated:
        self.x = x
        return Articulated(self.num.matrix(np.zeros((3, 3))), None, None, x.f * self.num.scalar(0.0), None)

    def advance(self, a: Any, alpha: Any) -> tuple[Any, Any, Any]:
        near = self.num.mul(self.num.inverse(self.x.c), -self.x.f)
        return near, alpha, near


class _Turns:
    """The body turns freely about the near point, under a moment and with a rotor about every axis."""

    def __init__(self, num: Arithmetic, effort: Any, armature: Any) -> None:
        self.num, self.effort, self.armature = num, effort, armature

    def reduce(self, x: Articulated) -> Articulated:
        num, a = self.num, self.armature
        i = x.i if a is None else x.i + num.matrix(np.eye(3)) * a
        self.b, self.inverse = x.b, num.inverse(i)
        effort = None if self.effort is None else num.widened(self.effort, x.n)
        self.push = -x.n if effort is None else effort - x.n
        gain = num.mul(x.b, self.inverse)
        c = num.symmetric(x.c - num.mul(gain, num.transpose(x.b)))
        f = x.f + num.mul(gain, self.push)
        if a is None:
            return Articulated(c, None, None, f, effort)
        n = -num.mul(self.inverse, self.push) * a
        n = n if effort is None else n + effort
        return Articulated(c, gain * a, num.matrix(np.eye(3)) * a - self.inverse * (a * a), f, n)

    def advance(self, a: Any, alpha: Any) -> tuple[Any, Any, Any]:
        num = self.num
        push = self.push - num.mul(num.transpose(self.b), a)
        turning = num.mul(self.inverse, push if self.armature is None else push + alpha * self.armature)
        return a, turning, turning


class _Single:
    """One turn about or one slide along an axis through the near point, or a turn that advances along it."""

    def __init__(
        self, num: Arithmetic, axis: Any, along: Any | None, about: Any | None, effort: Any, armature: Any
    ) -> None:
        """Take the axis, and what a unit rate is: velocity of the near point and angular velocity."""
        self.num, self.axis, self.along, self.about = num, axis, along, about
        self.effort, self.armature = num.from_rows([[effort]]), armature

    def reduce(self, x: Articulated) -> Articulated:
        num, along, about = self.num, self.along, self.about
        self.U = U = _sum(num.mul, (x.c, along), (x.b, about))
        self.V = V = _sum(num.mul, (num.transpose(x.b), along), (x.i, about))
        size = _sum(num.dot, (U, along), (V, about))
        self.inverse = 1 / (size if self.armature is None else size + self.armature)
        push = _sum(partial(_projected, num), (x.f, along), (x.n, about))
        self.push = q = num.widened(self.effort, push) - push
        u, v = U * self.inverse, V * self.inverse
        return Articulated(
            num.symmetric(x.c - num.mul(u, num.transpose(U))),
            x.b - num.mul(u, num.transpose(V)),
            num.symmetric(x.i - num.mul(v, num.transpose(V))),
            x.f + num.mul(u, q),
            x.n + num.mul(v, q),
        )

    def advance(self, a: Any, alpha: Any) -> tuple[Any, Any, Any]:
        num = self.num
        U, V = num.transpose(self.U), num.transpose(self.V)
        rate = (self.push - num.mul(U, a) - num.mul(V, alpha)) * self.inverse
        a = a if self.along is None else a + num.mul(self.along, rate)
        alpha = alpha if self.about is None else alpha + num.mul(self.about, rate)
        return a, alpha, rate


def _sum(product: Callable[[Any, Any], Any], *pairs: tuple[Any, Any | None]) -> Any:
    """Sum of products; None as a second factor is 0."""
    found = [product(x, e) for x, e in pairs if e is not None]
    return found[0] if len(found) == 1 else found[0] + found[1]


def _projected(num: Arithmetic, x: Any, e: Any) -> Any:
    return num.mul(num.transpose(e), x)


def rotation_rows(p: Sequence[Any]) -> tuple[list[list[Any]], Any]:
    """Return pᵀp A of a quaternion of four scalars, row by row, and pᵀp."""
    w, x, y, z = p
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    rows = [
        [ww + xx - yy - zz, (x * y - w * z) * 2, (x * z + w * y) * 2],
        [(x * y + w * z) * 2, ww - xx + yy - zz, (y * z - w * x) * 2],
        [(x * z - w * y) * 2, (y * z + w * x) * 2, ww - xx - yy + zz],
    ]
    return rows, ww + xx + yy + zz


class Tree:
    """A tree at a state: lists over the bodies, in world axes.

    Coordinates are the state's doubles; a subclass may give others of the kind of numbers.

    Attributes:
        A: attitudes; ``r``, ``v``: centres of mass and their velocities; ``w``: angular velocities.
        near: from the centre of mass to the near point of the body's joint.
        arm: from the far body's near point to the point that this joint carries: the near point, or of a rod
            the far one; from the world's origin where the far body is the world.
        blocks: what each joint is made of, from the far body on.
        shifted: by body, inertia about all axes [kg m²] that it has more than the model's.

    """

    def __init__(self, num: Arithmetic, model: Model, state: State) -> None:
        """Place and move every body.

        Args:
            state: of which the minimal coordinates are used; of many, arrays with leading axes.

        """
        self.num, self.model, self.state = num, model, state
        self.shifted: Mapping[int, float] = {}
        self.zero, self.one = num.vector(np.zeros(3)), num.matrix(np.eye(3))
        self.far = [int(far) for far in model.body[: model.n, 0]]
        self.A, self.r, self.v, self.w, self.near, self.arm = (list[Any]() for _ in range(6))
        self.blocks = list[list[Any]]()
        self._bias = list[tuple[Any, Any]]()  # acceleration of the carried point, angular acceleration
        self._inward = list[Any]()  # ω × (ω × s) of the near points
        self._kinetic = self._potential = num.scalar(0.0)  # of the joints' elements
        for k in range(model.n):
            self._add_body(k)

    def rotation(self, p: Any) -> Any:
        """A of a quaternion of any length but 0.

        Args:
            p: (..., 4) doubles, scalar first.

        Returns:
            A matrix, body → world.

        """
        return self.rotation_of([self.num.scalar(p[..., i]) for i in range(4)])

    def rotation_of(self, p: Sequence[Any]) -> Any:
        """A of a quaternion of four scalars.

        Returns:
            A matrix, body → world.

        """
        rows, square = rotation_rows(p)
        return self.num.from_rows(rows) * (1 / square)

    def _add_body(self, k: int) -> None:
        """Go from the far body along joint k to body k."""
        num, model, far = self.num, self.model, self.far[k]
        kind = model.kinds[k]
        hang = self.joint_point(k, 0)
        above, w, arm, bend = self.one, self.zero, hang, self.zero
        P, v = hang, self.zero
        if far >= 0:
            above, w, lever = self.A[far], self.w[far], num.mul(self.A[far], hang)
            P, v = self.r[far] + lever, self.v[far] + num.cross(w, lever)
            arm = lever - self.near[far]
            bend = self.centripetal(far, hang, lever) - self._inward[far]
        swing, blocks = self.zero, list[Any]()
        if kind.has_attitude:
            A, own = self.attitude(k)
            if kind.holds_distance:
                u, udot = self.rod_direction(k)
                ell = num.scalar(model.length[..., k])
                P, v = P + u * ell, v + udot * ell
                blocks.append(_Swing(num, u, -(ell * num.dot(udot, udot)), ell, self.force_across(k)))
            elif kind.holds_nothing:
                P, v = self.free_point(k)
                blocks.append(_Slides(num))
            relative = own - w
            effort, armature = self._ball_elements(k, above, A, relative)
            blocks.append(_Turns(num, effort, armature))
            swing, w = num.cross(w, relative), own
        else:
            A, P, v, w, arm, bend, swing, blocks = self._move(k, above, P, v, w, arm, bend)
        point = self.joint_point(k, 1)
        near = self.zero if kind.holds_nothing else num.mul(A, point)
        self.A.append(A)
        self.w.append(w)
        self.near.append(near)
        self._inward.append(self.zero if kind.holds_nothing else self.centripetal(k, point, near))
        self.arm.append(arm)
        self.r.append(P - near)
        self.v.append(v - num.cross(w, near))
        self._bias.append((bend, swing))
        self.blocks.append(blocks)

    def coordinate(self, k: int, i: int) -> tuple[Any, Any]:
        """Return a scalar coordinate and its rate.

        Args:
            i: which of its motions.

        Returns:
            Two scalars [rad, m] and per second.

        """
        return self.num.scalar(self.state.x[..., k, i]), self.num.scalar(self.state.xdot[..., k, i])

    def attitude(self, k: int) -> tuple[Any, Any]:
        """Return A and the angular velocity of a body whose joint leaves its attitude free.

        Returns:
            A matrix, and a vector in world axes [rad/s].

        """
        A = self.rotation(self.state.p[..., k, :])
        return A, self.num.mul(A, self.num.vector(self.state.omega[..., k, :]))

    def free_point(self, k: int) -> tuple[Any, Any]:
        """Return the centre of mass of a free body and its velocity.

        Returns:
            Two vectors, world axes [m, m/s].

        """
        return self.num.vector(self.state.r[..., k, :]), self.num.vector(self.state.v[..., k, :])

    def inertia(self, k: int) -> Any:
        """Return the inertia of a body about its centre of mass.

        Returns:
            A matrix, body axes [kg m²].

        """
        own = self.num.matrix(self.model.inertia[..., k, :, :])
        return own + self.one * self.num.scalar(self.shifted[k]) if k in self.shifted else own

    def near_inertia(self, k: int) -> Any:
        """Return the inertia of a body about its near point.

        Returns:
            A matrix, body axes [kg m²].

        """
        num, J, model = self.num, self.inertia(k), self.model
        if model.kinds[k].holds_nothing:
            return J
        s = num.cross_matrix(self.joint_point(k, 1))
        return J - num.mul(s, s) * num.scalar(model.mass[..., k])

    def centripetal(self, k: int, point: Any, arm: Any) -> Any:
        """Return ω × (ω × s) of a point of body k.

        Args:
            point: s in body axes [m].
            arm: s in world axes.

        Returns:
            A vector in world axes.

        """
        return self.num.cross(self.w[k], self.num.cross(self.w[k], arm))

    def gyroscopic(self, k: int, inertia: Any) -> Any:
        """Return ω × (I ω) of body k.

        Args:
            inertia: I about the near point, world axes.

        Returns:
            A vector in world axes.

        """
        return self.num.cross(self.w[k], self.num.mul(inertia, self.w[k]))

    def joint_point(self, k: int, side: int) -> Any:
        """Return the point of joint k in its far (0) or its near body (1), from the body's centre of mass.

        Returns:
            A vector, body axes.

        """
        return self.num.vector(self.model.point[..., k, side, :])

    def joint_axes(self, k: int, side: int) -> Any:
        """Return the axes of joint k in its far (0) or its near body (1).

        Returns:
            A matrix.

        """
        return self.rotation(self.model.turn[..., k, side, :])

    def rod_direction(self, k: int) -> tuple[Any, Any]:
        """Return the direction u of rod k as a unit vector and u̇ perpendicular to it.

        Returns:
            Two vectors, and per second.

        """
        num = self.num
        u, udot = (num.vector(x[..., k, :]) for x in (self.state.u, self.state.udot))
        u = u * (1 / num.sqrt(num.dot(u, u)))
        return u, udot - u * num.dot(u, udot)

    def force_across(self, k: int) -> Any:
        """Return the force across rod k on its body, which a rod without inertia has not.

        Returns:
            A vector, or None.

        """
        return None

    def _move(self, k: int, above: Any, P: Any, v: Any, w: Any, arm: Any, bend: Any) -> tuple[Any, ...]:
        """Go along the scalar motions of joint k."""
        num, model = self.num, self.model
        A, swing, blocks = num.mul(above, self.joint_axes(k, 0)), self.zero, []
        for i, (what, number) in enumerate(model.kinds[k].motions):
            x, rate = self.coordinate(k, i)
            unit = num.vector(np.eye(3)[number])
            axis = num.mul(A, unit)
            effort, armature = num.scalar(0.0), None
            numbers = [getattr(model, name)[..., k, i] for name in JOINT_ELEMENTS]
            if any(map(np.any, numbers)):
                a, d, stiffness, rest, push = map(num.scalar, numbers)
                stretch = x - rest
                effort, armature = push - stiffness * stretch - d * rate, a
                self._kinetic = self._kinetic + a * rate * rate / 2
                self._potential = self._potential + stiffness * stretch * stretch / 2
            along, about = (axis, None) if what == "slide" else (None, axis)
            if model.kinds[k].has_pitch:
                along = axis * num.scalar(model.length[..., k])
            blocks.append(_Single(num, axis, along, about, effort, armature))
            if along is not None:
                shift = along * x
                P, arm, bend = P + shift, arm + shift, bend + num.cross(w, num.cross(w, shift))
                bend = bend + num.cross(swing, shift) + num.cross(w, along) * (rate * 2)
                v = v + num.cross(w, shift) + along * rate
            if about is not None:
                swing, w = swing + num.cross(w, axis) * rate, w + axis * rate
                A = num.mul(A, self._turn_about(number, x))
        A = num.mul(A, num.transpose(self.joint_axes(k, 1)))
        return A, P, v, w, arm, bend, swing, blocks

    def _turn_about(self, axis: int, angle: Any) -> Any:
        """The rotation about a coordinate axis."""
        s, c = self.num.sin_cos(angle)
        zero, one = self.num.scalar(0.0), self.num.scalar(1.0)
        rows = [[one if i == j else zero for j in range(3)] for i in range(3)]
        i, j = (axis + 1) % 3, (axis + 2) % 3
        rows[i][i], rows[i][j], rows[j][i], rows[j][j] = c, -s, s, c
        return self.num.from_rows(rows)

    def _ball_elements(self, k: int, above: Any, A: Any, spin: Any) -> tuple[Any, Any]:
        """Moment of spring and damper of a joint with all turns, and its rotor; None where there is none."""
        num, model = self.num, self.model
        numbers = [getattr(model, name)[..., k, 0] for name in ("armature", "damping", "stiffness")]
        if not any(map(np.any, numbers)):
            return None, None
        a, damping, stiffness = (num.scalar(x) for x in numbers)
        effort = -spin * damping
        if np.any(numbers[2]):
            far, near = num.mul(above, self.joint_axes(k, 0)), num.mul(A, self.joint_axes(k, 1))
            R = num.mul(near, num.transpose(far))

            def entry(i: int, j: int) -> Any:
                return num.entry(R, i, j)

            sine = num.from_rows([[(entry(i, j) - entry(j, i)) / 2] for i, j in ((2, 1), (0, 2), (1, 0))])
            turn = sine * self.turn_over_sine(k, sine, (entry(0, 0) + entry(1, 1) + entry(2, 2) - 1) / 2)
            effort = effort - turn * stiffness
            self._potential = self._potential + stiffness * num.dot(turn, turn) / 2
        self._kinetic = self._kinetic + a * num.dot(spin, spin) / 2
        return effort, a if np.any(numbers[0]) else None

    def turn_over_sine(self, k: int, sine: Any, cosine: Any) -> Any:
        """Return θ/sin θ of the turn θ of a joint with all turns.

        Args:
            sine: sin θ times the axis, a vector in world axes.
            cosine: cos θ.

        """
        return self.num.turn_over_sine(self.num.sqrt(self.num.dot(sine, sine)), cosine)

    def _pulls(self) -> tuple[dict[int, tuple[Any, Any]], Any]:
        """What springs between points do to bodies: force, moment about the near point; and their energy."""
        num, model, pulls = self.num, self.model, dict[int, tuple[Any, Any]]()
        energy = num.scalar(0.0)
        for number in range(model.spring_body.shape[-2]):
            bodies, ends = [int(body) for body in model.spring_body[number]], list[tuple[Any, Any, Any]]()
            for end, body in enumerate(bodies):
                at, rate, lever = num.vector(model.spring_point[..., number, end, :]), self.zero, None
                if body >= 0:
                    arm = num.mul(self.A[body], at)
                    at, rate = self.r[body] + arm, self.v[body] + num.cross(self.w[body], arm)
                    lever = arm - self.near[body]
                ends.append((at, rate, lever))
            d, change = ends[1][0] - ends[0][0], ends[1][1] - ends[0][1]
            length = num.sqrt(num.dot(d, d))
            stiffness, damping, rest = (
                num.scalar(x[..., number])
                for x in (model.spring_stiffness, model.spring_damping, model.spring_length)
            )
            stretch = length - rest
            tension = stiffness * stretch + damping * num.dot(d, change) / length
            energy = energy + stiffness * stretch * stretch / 2
            pull = d * (tension / length)
            for body, (_, _, lever), force in zip(bodies, ends, (pull, -pull), strict=True):
                if body >= 0:
                    own = force, num.cross(lever, force)
                    before = pulls.get(body)
                    pulls[body] = (before[0] + own[0], before[1] + own[1]) if before else own
        return pulls, energy

    def _spin(self, k: int) -> Any:
        """Angular momentum of body k about its centre of mass."""
        num, J = self.num, self.inertia(k)
        return num.mul(self.A[k], num.mul(J, num.mul(num.transpose(self.A[k]), self.w[k])))

    def totals(self) -> tuple[Any, Any, Any]:
        """Sum over bodies, rotors and springs.

        Returns:
            Kinetic and potential energy [J], and the angular momentum about the origin [kg m²/s].

        """
        num, model, momentum = self.num, self.model, self.zero
        kinetic, potential = self._kinetic, self._potential + self._pulls()[1]
        g = num.vector(model.gravity)
        for k in range(model.n):
            m, spin, v = num.scalar(model.mass[..., k]), self._spin(k), self.v[k]
            kinetic = kinetic + (m * num.dot(v, v) + num.dot(self.w[k], spin)) / 2
            potential = potential - m * num.dot(g, self.r[k])
            momentum = momentum + num.cross(self.r[k], v) * m + spin
        return kinetic, potential, momentum

    def _body_alone(
        self, k: int, pull: tuple[Any, Any] | None, wrenches: Sequence[Mapping[int, tuple[Any, Any]]]
    ) -> Articulated:
        """What body k needs by itself: under its loads, and in further columns against each wrench alone."""
        num, model, s = self.num, self.model, self.near[k]
        c, b, i = self._inertia(k)
        m = num.scalar(model.mass[..., k])
        load, moment = self._own_load(k)
        load = load + num.vector(model.gravity) * m
        f = -self._inward[k] * m - load
        n = self.gyroscopic(k, i) + num.cross(s, load) - moment
        if pull is not None:
            f, n = f - pull[0], n - pull[1]
        if wrenches:
            own = [wrench.get(k) for wrench in wrenches]  # None where one acts on other bodies
            f = num.columns([f, *(-one[0] if one else self.zero for one in own)])
            n = num.columns([n, *(num.cross(s, one[0]) - one[1] if one else self.zero for one in own)])
        return Articulated(c, b, i, f, n)

    def _own_load(self, k: int) -> tuple[Any, Any]:
        """Load and drag of body k: force and moment about its centre of mass."""
        num, model = self.num, self.model
        load = num.vector(model.force[..., k, :])
        moment = num.mul(self.A[k], num.vector(model.moment[..., k, :]))
        if np.any(model.drag_force[..., k]):
            load = load - self.v[k] * num.scalar(model.drag_force[..., k])
        if np.any(model.drag_moment[..., k]):
            moment = moment - self.w[k] * num.scalar(model.drag_moment[..., k])
        return load, moment

    def loads(self) -> list[tuple[Any, Any]]:
        """Sum loads, drag and springs between points over each body.

        Returns:
            Forces, and moments about the centres of mass.

        """
        pulls, found = self._pulls()[0], list[tuple[Any, Any]]()
        for k in range(self.model.n):
            load, moment = self._own_load(k)
            if k in pulls:
                force, about_near = pulls[k]
                load, moment = load + force, moment + about_near + self.num.cross(self.near[k], force)
            found.append((load, moment))
        return found

    def coasting(self) -> tuple[list[Any], list[Any]]:
        """Find what the velocities alone cause, where no coordinate of a joint accelerates.

        Returns:
            Accelerations of the centres of mass, and angular accelerations.

        """
        num, at, acceleration, turning = self.num, list[Any](), list[Any](), list[Any]()
        for k in range(self.model.n):
            a, alpha = self._carried(k, self.zero, at, turning)
            if self.model.kinds[k].holds_distance:
                swing = self.blocks[k][0]
                a = a + swing.u * swing.pull
            at.append(a)
            turning.append(alpha)
            acceleration.append(a + num.cross(self.near[k], alpha) - self._inward[k])
        return acceleration, turning

    def _carried(self, k: int, like: Any, at: list[Any], turning: list[Any]) -> tuple[Any, Any]:
        """Accelerations of the point that joint k carries, and of its turn, by those of the bodies before."""
        num, far = self.num, self.far[k]
        a, alpha = (num.widened(bias, like) for bias in self._bias[k])
        if far < 0:
            return a, alpha
        return a + at[far] - num.mul(num.cross_matrix(self.arm[k]), turning[far]), alpha + turning[far]

    def _inertia(self, k: int) -> tuple[Any, Any, Any]:
        """c, b and i of body k by itself."""
        num, m, s = self.num, self.num.scalar(self.model.mass[..., k]), self.num.cross_matrix(self.near[k])
        inertia = num.mul(num.mul(self.A[k], self.near_inertia(k)), num.transpose(self.A[k]))
        return self.one * m, s * m, num.symmetric(inertia)

    def solve(self, wrenches: Sequence[Mapping[int, tuple[Any, Any]]] = ()) -> Solution:
        """Solve for the accelerations and the wrenches of the joints.

        Args:
            wrenches: further ones, by bodies: force at the centre of mass, and moment.

        Returns:
            The solution; with ``wrenches``, matrices whose first column is the solution and the further
            ones what each wrench alone adds.

        Raises:
            ZeroDivisionError: of balls, where an articulated inertia has no inverse.

        """
        num, n = self.num, self.model.n
        pulls, _ = self._pulls()
        total = [self._body_alone(k, pulls.get(k), wrenches) for k in range(n)]
        carried: list[Any] = [None] * n
        for k in reversed(range(n)):
            carried[k] = x = self.reduced(k, total[k])
            if self.far[k] >= 0:
                total[self.far[k]] = self._carry(k, x, total[self.far[k]])
        acceleration, turning, forces, moments = list[Any](), list[Any](), list[Any](), list[Any]()
        rates: list[list[Any]] = [[]] * n
        at: list[Any] = []  # accelerations of the near points
        for k in range(n):
            x = carried[k]
            a, alpha = self._carried(k, x.f, at, turning)
            force, moment = num.mul(x.c, a) + x.f, x.n
            if x.b is not None:
                force = force + num.mul(x.b, alpha)
                moment = num.mul(num.transpose(x.b), a) + num.mul(x.i, alpha) + x.n
            a, alpha, rates[k] = self.advanced(k, a, alpha)
            at.append(a)
            turning.append(alpha)
            forces.append(force)
            moments.append(moment)
            inward = num.widened(self._inward[k], a)
            acceleration.append(a + num.mul(num.cross_matrix(self.near[k]), alpha) - inward)
        return Solution(acceleration, turning, forces, moments, rates)

    def solve_joined(self, ends: Sequence[tuple[int, int]], rows: Sequence[int]) -> Solution:
        """Solve with forces λ that hold parts of one body together where loops are cut.

        They follow from the response to unit wrenches on the two parts,

            K λ = −(a_b − a_c, A_bᵀ (α_b − α_c)) at λ = 0,    K = what λ adds to the right-hand side.

        Args:
            ends: the parts b and c of each loop.
            rows: of six per loop those that do not depend on others; of the others λ is 0.

        """
        if not rows:
            return self.solve()
        num, wrenches, relative = self.num, list[dict[int, tuple[Any, Any]]](), list[Any]()
        units = [num.vector(e) for e in np.eye(3)]
        for row in rows:
            (b, c), axis, is_force = ends[row // 6], units[row % 3], bool(row % 6 < 3)
            wrenches.append(self.end_wrench(b, c, axis if is_force else num.mul(self.A[b], axis), is_force))
        found = self.solve(wrenches)
        for b, c in ends:
            relative.append(found.acceleration[b] - found.acceleration[c])
            relative.append(num.mul(num.transpose(self.A[b]), found.turning[b] - found.turning[c]))
        kept = [[num.entry(relative[row // 3], row % 3, j) for j in range(len(rows) + 1)] for row in rows]
        multipliers = num.solve(
            num.from_rows([row[1:] for row in kept]), num.from_rows([[-row[0]] for row in kept])
        )
        own = [[num.scalar(1.0)], *([num.entry(multipliers, i)] for i in range(len(rows)))]
        shares = num.from_rows(own)
        return found.combined(lambda x: num.mul(x, shares))

    def end_wrench(
        self, b: int, c: int, axis: Any, is_force: bool, lever: Any | None = None
    ) -> dict[int, tuple[Any, Any]]:
        """Return a unit force, or moment, along an axis on body b, and what is against it on body c.

        Args:
            lever: from the centre of mass of c to that of b, where the force acts; absent: 0.

        """
        if not is_force:
            return {b: (self.zero, axis), c: (self.zero, -axis)}
        moment = self.zero if lever is None else -self.num.cross(lever, axis)
        return {b: (axis, self.zero), c: (-axis, moment)}

    def reduced(self, k: int, x: Articulated) -> Articulated:
        """Take the motions of joint k out of what its body and all beyond need."""
        for block in reversed(self.blocks[k]):
            x = block.reduce(x)
        return x

    def advanced(self, k: int, a: Any, alpha: Any) -> tuple[Any, Any, list[Any]]:
        """Go from the far side of joint k to the near one.

        Args:
            a: acceleration of the point that the joint carries, without its own motions.
            alpha: angular acceleration before them.

        Returns:
            Both with the joint's motions, and its rates as `Solution` has them.

        """
        rates = list[Any]()
        for block in self.blocks[k]:
            a, alpha, rate = block.advance(a, alpha)
            rates.append(rate)
        return a, alpha, rates

    def quantities(self, solution: Solution) -> dict[str, Any]:
        """Return the state quantities but the mass matrix, by name: of those per body a list.

        Accelerations, forces and moments are in world axes, angular accelerations in those of their bodies.
        """
        return {
            "acceleration": solution.acceleration,
            "angular_acceleration": self.in_bodies(solution.turning),
            "joint_reaction": solution.force,
            "joint_moment": [self.zero if moment is None else moment for moment in solution.moment],
        } | self.sums()

    def sums(self) -> dict[str, Any]:
        """Return the sums over all bodies of `totals` by their names as state quantities."""
        return dict(zip(SUMS, self.totals(), strict=True))

    def in_bodies(self, vectors: Sequence[Any]) -> list[Any]:
        """Turn a vector of each body from world axes to the body's."""
        num = self.num
        return [num.mul(num.transpose(A), x) for A, x in zip(self.A, vectors, strict=True)]

    def _carry(self, k: int, x: Articulated, far: Articulated) -> Articulated:
        """Add to the far body what joint k and all beyond need of it."""
        num, (bend, swing) = self.num, self._bias[k]
        push, n = num.mul(x.c, bend), x.n
        if x.b is not None:
            push = push + num.mul(x.b, swing)
            n = n + num.widened(num.mul(num.transpose(x.b), bend) + num.mul(x.i, swing), n)
        f = x.f + num.widened(push, x.f)
        c, b, i = self._carried_inertia(k, x.c, x.b, x.i)
        moment = num.mul(num.cross_matrix(self.arm[k]), f)
        moment = moment if n is None else moment + n
        return Articulated(far.c + c, far.b + b, far.i + i, far.f + f, far.n + moment)

    def _carried_inertia(self, k: int, c: Any, b: Any, i: Any) -> tuple[Any, Any, Any]:
        """Move c, b and i of joint k to the far body's near point."""
        num, R = self.num, self.num.cross_matrix(self.arm[k])
        moved = -num.mul(c, R) if b is None else b - num.mul(c, R)
        product = num.mul(R, moved)
        if b is not None:
            product = product + i - num.mul(num.transpose(b), R)
        return c, moved, num.symmetric(product)

    def mass_matrix(self, is_relative: bool = False) -> Any:
        """Compute M of the rates ν of `StateQuantities.mass_matrix`, or of rates relative to the far bodies.

        A rate ω′ or u̇ of ν turns or swings its own body alone: what is attached to a body with an attitude of
        its own is carried without a turn, as by a joint whose b and i are 0.
        """
        num, model, n = self.num, self.model, self.model.n
        keeps_attitude = [kind.has_attitude and not is_relative for kind in model.kinds]
        total = [self._inertia(k) for k in range(n)]
        for k in reversed(range(n)):
            far, keeps = self.far[k], keeps_attitude[k]
            if far >= 0:
                c, b, i = total[k]
                moved = self._carried_inertia(k, c, None if keeps else b, None if keeps else i)
                c, b, i = (x + y for x, y in zip(total[far], moved, strict=True))
                total[far] = c, b, i
        columns = self._rate_columns()
        blocks: dict[tuple[int, int], Any] = {}

        def add(row: int, column: int, block: Any) -> None:
            blocks[row, column] = blocks[row, column] + block if (row, column) in blocks else block
            if row != column:
                blocks[column, row] = num.transpose(blocks[row, column])

        for k in range(n):
            c, b, i = total[k]
            for at, slide, turn in columns[k]:
                push = _sum(num.mul, (c, slide), (b, turn))
                moment = _sum(num.mul, (num.transpose(b), slide), (i, turn))
                for j in path_to_world(self.far, k):
                    for row, along, about in columns[j]:
                        if j < k or row <= at:
                            add(row, at, _sum(partial(_projected, num), (push, along), (moment, about)))
                    lever = num.mul(num.cross_matrix(self.arm[j]), push)
                    moment = lever if keeps_attitude[j] else moment + lever
        for pairs, armature in self._rotors(columns):
            for number, (row, left) in enumerate(pairs):
                for column, right in pairs[number:]:
                    add(row, column, num.mul(num.transpose(left), right) * armature)
        return num.assemble(rate_count(model), blocks)

    def joint_forces(self, wrenches: Sequence[tuple[Any, Any]]) -> list[Any]:
        """Project wrenches on the bodies on the relative rates of the joints.

        Args:
            wrenches: of each body a force and a moment about its centre of mass.

        Returns:
            Columns, which follow each other as the rates do.

        """
        num, found = self.num, dict[int, Any]()
        f = [force for force, _ in wrenches]
        n = [moment - num.cross(s, force) for s, (force, moment) in zip(self.near, wrenches, strict=True)]
        for k, columns in reversed([*enumerate(self._rate_columns())]):
            for at, slide, turn in columns:
                found[at] = _sum(partial(_projected, num), (f[k], slide), (n[k], turn))
            if (far := self.far[k]) >= 0:
                f[far] = f[far] + f[k]
                n[far] = n[far] + n[k] + num.cross(self.arm[k], f[k])
        return [found[at] for at in sorted(found)]

    def _rate_columns(self) -> list[list[tuple[int, Any, Any]]]:
        """Of each joint's rates in ν: where they are, and the velocities of the near point or the turns."""
        num, model, found, rods = self.num, self.model, list[list[tuple[int, Any, Any]]](), 0
        for k, own in enumerate(own_rates(model)):
            kind, columns = model.kinds[k], list[tuple[int, Any, Any]]()
            if kind.holds_distance:
                swing = self.blocks[k][0]
                across = self.one - num.mul(swing.u, num.transpose(swing.u))
                columns.append((3 * rods, across * swing.length, None))
                rods += 1
            if kind.holds_nothing:
                columns.append((own.start, self.one, None))
            if kind.has_attitude:
                columns.append((own.stop - 3, None, self.A[k]))
            else:
                columns += [(own.start + i, x.along, x.about) for i, x in enumerate(self.blocks[k])]
            found.append(columns)
        return found

    def _rotors(
        self, columns: list[list[tuple[int, Any, Any]]]
    ) -> Iterator[tuple[list[tuple[int, Any]], Any]]:
        """Of each rotor the turns that the rates give it, by their places in ν, and its inertia."""
        for k in range(self.model.n):
            for block, (at, _, turn) in zip(reversed(self.blocks[k]), reversed(columns[k]), strict=True):
                if block.armature is None:
                    continue
                if not self.model.kinds[k].has_attitude:
                    axis = block.axis  # of length 1: ½ a ẋ²
                    yield [(at, axis)], block.armature
                    continue
                turns, j = [(at, turn)], self.far[k]
                while j >= 0:
                    turns += [(place, -about) for place, _, about in columns[j] if about is not None]
                    j = -1 if self.model.kinds[j].has_attitude else self.far[j]
                yield turns, block.armature
