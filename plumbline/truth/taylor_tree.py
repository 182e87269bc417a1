"""The equations of motion of a tree with any joints, as expressions in joint coordinates for `taylor`.

Sums over subtrees (composite rigid bodies, recursive Newton–Euler; Featherstone, tables 5.1 and 6.2), about
the world's origin, and M ν̇ = −h by M = Lᵀ D L, which keeps the zeros between branches (Featherstone, Rigid
Body Dynamics Algorithms, 2008, section 6.5).  A rod moves its near end by ℓ (I − u uᵀ) ν̇, three columns of
rank two: m ℓ² u uᵀ added to its block of M leaves their part across u, and sets that along u to 0.
Rotors, springs and dampers act on the relative rates ν of their joints, which those of a ball joint are too:
Ω along the world's axes, whose rotor adds a (Ω̇ + Ω × ω) in the turning near body's axes.
A spring of a ball joint adds 6 k γ n with n = sin θ times the axis of its turn θ, γ = θ/(6 sin θ).  θ² and γ
are integrated beside the motion, because θ/sin θ has no Taylor series by recurrence where θ = 0; (8) of
`certificate_checker` has their rates, whose series in θ² is f₀.
Loops are cut open (`plumbline.model.loops`): the ends b and c of each get forces λ on rows J of their
relative acceleration in the axes of b, with X = M⁻¹ Jᵀ and ν̇₀ of the tree alone

    J X λ = −(J ν̇₀ + A_bᵀ (a_b − a_c, α_b − α_c) at ν̇ = 0),      ν̇ = ν̇₀ + X λ.

Coordinates per body: u, u̇ of a rod (world axes), r, ṙ of a free body, p and ω′ of both and of balls, x and ẋ
of the other joints.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from plumbline.model.datatypes import JOINT_ELEMENTS, KINDS, Kind, Model, State
from plumbline.model.loops import CutMechanism, independent_rows

# Of a loop the bodies b and c, and which of the six rows are held: shifts, then turns, in axes of b.
Closure = tuple[int, int, tuple[int, ...]]


class Topology(NamedTuple):
    """What the equations of a tree depend on besides its numbers."""

    kind: tuple[Kind, ...]
    far: tuple[int, ...]  # far body of each joint, −1 the world
    has_drag: bool
    has_joint_elements: bool = False
    springs: tuple[tuple[int, int], ...] = ()  # bodies of springs between points, −1 the world
    closures: tuple[Closure, ...] = ()
    ball_springs: tuple[int, ...] = ()  # joints


def topology(model: Model) -> Topology:
    """Return the topology of a model.

    Returns:
        Kinds of joints, far bodies, and what elements there are.

    """
    far = tuple(int(far) for far in model.body[:, 0])
    springs = tuple((int(a), int(b)) for a, b in model.spring_body)
    bent = (kind == "ball" and k != 0 for kind, k in zip(model.kind, model.stiffness[:, 0], strict=True))
    ball_springs = tuple(k for k, is_bent in enumerate(bent) if is_bent)
    return Topology(
        model.kind, far, model.has_drag, model.has_joint_elements, springs, ball_springs=ball_springs
    )


def closures(cut: CutMechanism, state: State) -> tuple[Closure, ...]:
    """Choose rows that close the loops and do not depend on others.

    Args:
        state: of its tree, the ends together.

    Returns:
        The ends and rows of each loop.

    """
    J = cut.jacobian(state).reshape(len(cut.ends), 6, -1)
    for block, (b, _) in zip(J, cut.ends, strict=True):
        block[:3] = rotation_matrix(state.p[b]).astype(float).T @ block[:3]
    rows = independent_rows(J.reshape(-1, J.shape[-1]), cut.row_scale)
    return tuple(
        (b, c, tuple(int(row) - 6 * loop for row in rows if row // 6 == loop))
        for loop, (b, c) in enumerate(cut.ends)
    )


def coordinate_names(kind: Kind) -> list[tuple[str, int]]:
    """List the coordinates of a joint in the order of the equations.

    Returns:
        Names of fields of `State`, with the number of components each.

    """
    if not KINDS[kind].has_attitude:
        count = len(KINDS[kind].motions)
        return [("x", count), ("xdot", count)] if count else []
    first = {"rod": [("u", 3), ("udot", 3)], "free": [("r", 3), ("v", 3)]}.get(kind, [])
    return [*first, ("p", 4), ("omega", 3)]


def initial_values(mp: Any, model: Model, state: State) -> list[Any]:
    """Return the coordinates at a state, quaternions and directions normalised.

    Returns:
        Numbers of mpmath in the order of `equations_of_motion`.

    """
    values: list[Any] = []
    for k, kind in enumerate(model.kind):
        x = {
            name: mp.matrix(getattr(state, name)[k, :size].tolist()) for name, size in coordinate_names(kind)
        }
        if KINDS[kind].has_attitude:
            x["p"] /= mp.norm(x["p"])
        if kind == "rod":
            x["u"] /= mp.norm(x["u"])
            x["udot"] -= x["u"] * (x["u"].T * x["udot"])[0]
        values += [entry for part in x.values() for entry in part]
    for k in topology(model).ball_springs:
        theta = _ball_angle(mp, model, state, k)
        values += [theta**2, 1 / (6 * mp.sinc(theta))]
    return values


def _ball_angle(mp: Any, model: Model, state: State, k: int) -> Any:
    """The turn 0 ≤ θ ≤ π of ball joint k."""
    first, last = (_unit_rotation(mp, q) for q in model.turn[k])
    far, near = (_attitude(mp, model, state, body) for body in (int(model.body[k, 0]), k))
    R = (far @ first).T @ near @ last
    sine = mp.norm([R[i, j] - R[j, i] for i, j in ((2, 1), (0, 2), (1, 0))])
    return mp.atan2(sine, R[0, 0] + R[1, 1] + R[2, 2] - 1)


def _attitude(mp: Any, model: Model, state: State, k: int) -> Any:
    """Rotation matrix of a body by the joint coordinates: its quaternion in the state is rounded."""
    if k < 0:
        return np.eye(3)
    kind = model.kind[k]
    if KINDS[kind].has_attitude:
        return _unit_rotation(mp, state.p[k])
    A = _attitude(mp, model, state, int(model.body[k, 0])) @ _unit_rotation(mp, model.turn[k, 0])
    for x, (what, number) in zip(state.x[k].tolist(), KINDS[kind].motions, strict=False):
        half = mp.mpf(x) / 2 if what == "turn" else mp.mpf(0)
        A = A @ _unit_rotation(mp, [mp.cos(half), *(mp.sin(half) * np.eye(3)[number])])
    return A @ _unit_rotation(mp, model.turn[k, 1]).T


def _unit_rotation(mp: Any, q: Iterable[Any]) -> Any:
    unit = mp.matrix([*q])
    return rotation_matrix(unit / mp.norm(unit))


def parameter_values(mp: Any, model: Model) -> list[Any]:
    """Return the numbers of the model in the order of `_Body`: gravity, then per body.

    Returns:
        Numbers of mpmath or Python.

    """
    values: list[Any] = model.gravity.tolist()
    for k in range(model.n):
        values += [float(model.mass[k]), *model.inertia[k].ravel().tolist(), *model.point[k].ravel().tolist()]
        for q in model.turn[k]:
            values += _unit_rotation(mp, q).ravel().tolist()
        values += [*model.force[k].tolist(), *model.moment[k].tolist()]
        values += [float(x[k]) for x in (model.drag_force, model.drag_moment, model.length)]
        values += [x for name in JOINT_ELEMENTS for x in getattr(model, name)[k].tolist()]
    for j, point in enumerate(model.spring_point):
        numbers = model.spring_stiffness, model.spring_damping, model.spring_length
        values += [*point.ravel().tolist(), *(float(x[j]) for x in numbers)]
    return [*values, *(-1 / mp.mpf(2 * (n + 1) * (2 * n + 5)) for n in reversed(range(_BALL_SPRING_TERMS)))]


def equations_of_motion(hy: Any, tree: Topology) -> list[tuple[Any, Any]]:
    """Write the equations of a tree.

    Returns:
        Pairs (coordinate, its rate).

    """
    bodies: list[_Body] = []
    for k, far in enumerate(tree.far):
        bodies.append(_Body(hy, tree, k, bodies[far] if far >= 0 else None))
    gravity = vector(hy.par[i] for i in range(3))
    inertias = _subtree_sums(tree, [body.spatial_inertia() for body in bodies])
    own_wrenches = [body.wrench_at_rest(gravity, tree.has_drag) for body in bodies]
    for j, ends in enumerate(tree.springs):
        _add_spring(hy, bodies, own_wrenches, ends, 3 + _PARAMETERS * len(bodies) + _SPRING_PARAMETERS * j)
    wrenches = _subtree_sums(tree, own_wrenches)
    mass, before, right = _mass_matrix(tree, bodies, inertias, wrenches)
    _factor_sparse(mass, before)
    rates = _substitute_sparse(mass, before, right)
    if tree.closures:
        rates = _close_loops(tree, bodies, mass, before, rates)
    gained: list[Any] = []
    system: list[tuple[Any, Any]] = []
    for k, (body, far) in enumerate(zip(bodies, tree.far, strict=True)):
        own, rates = rates[: len(body.S)], rates[len(body.S) :]
        above = gained[far] if far >= 0 else vector([0.0] * 6)
        gained.append(sum((column * rate for column, rate in zip(body.S, own, strict=True)), above))
        system += body.equations(tree.kind[k], above, gained[k], own)
    first = 3 + _PARAMETERS * len(bodies) + _SPRING_PARAMETERS * len(tree.springs)
    terms = [hy.par[first + n] for n in range(_BALL_SPRING_TERMS)]
    for k in tree.ball_springs:
        system += bodies[k].turn_equations(terms)
    return system


class _Body:
    """Body k and its joint: parameters, coordinates and kinematics as expressions.

    ``A`` its attitude; ``r``, ``v``, ``w`` motion of its centre and angular velocity, ``P`` the near point,
    ``S`` the motions' twists (6,) about the world's origin; accelerations that S ν̇ adds to: ``bend``
    of the centre, ``near_bend`` and ``hang_bend`` of near and far point, ``twist`` ω̇.  World axes.
    """

    A: Any
    r: Any
    relative_spin: Any  # Ω of a ball joint
    turn: Any  # of a ball joint with a spring, n
    bend: Any

    def __init__(self, hy: Any, tree: Topology, k: int, far: _Body | None) -> None:
        self.hy, self.next_parameter = hy, 3 + _PARAMETERS * k
        (self.m,), self.J = self._take(1), self._take(9).reshape(3, 3)
        s_far, s_near = self._take(3), self._take(3)
        turn_far, turn_near = self._take(9).reshape(3, 3), self._take(9).reshape(3, 3)
        self.force, self.moment = self._take(3), self._take(3)
        self.drag_force, self.drag_moment, self.length = self._take(3)
        self.elements = self._take(10).reshape(5, 2)  # rows in the order of `JOINT_ELEMENTS`
        kind = tree.kind[k]
        self.x: dict[str, Any] = {
            name: vector(hy.expression(f"{name}{i}_{k}") for i in range(size))
            for name, size in coordinate_names(kind)
        }
        zero = vector([0.0] * 3)
        self.P, self.v, self.near_bend, self.w, self.twist = s_far, zero, zero, zero, zero
        axes = turn_far
        if far is not None:
            arm = far.A @ s_far
            self.P, self.v = far.r + arm, far.v + np.cross(far.w, arm)
            self.w, self.twist = far.w, far.twist
            self.near_bend = far.bend + np.cross(far.twist, arm) + np.cross(far.w, np.cross(far.w, arm))
            axes = far.A @ turn_far
        self.hang, self.hang_bend = self.P, self.near_bend
        units = [vector([float(i == j) for j in range(3)]) for i in range(3)]
        columns: list[tuple[Any, Any]] = []  # angular velocity, velocity of the near point
        if kind == "rod":
            u, udot, ell = self.x["u"], self.x["udot"], self.length
            self.P, self.v = self.P + ell * u, self.v + ell * udot
            self.near_bend = self.near_bend - (ell * (udot @ udot)) * u
            columns = [(zero, ell * (e - u[i] * u)) for i, e in enumerate(units)]
        if kind == "free":
            self.P, self.v, self.near_bend = self.x["r"], self.x["v"], zero
            columns = [(zero, e) for e in units]
        if KINDS[kind].has_attitude:
            self.A = rotation_matrix(self.x["p"])
            self.turn = None
            if k in tree.ball_springs:
                pairs = zip(axes.T, (self.A @ turn_near).T, strict=True)
                self.turn = sum((np.cross(a, b) for a, b in pairs), zero) * 0.5
                self.square, self.ratio = hy.make_vars(f"square_{k}", f"ratio_{k}")
            far_spin = self.w
            self.w = self.A @ self.x["omega"]
            self.relative_spin = self.w - far_spin
            columns += [(e, zero) for e in units]
        else:
            self.A = self._move(kind, axes, columns) @ turn_near.T
        near = zero if kind == "free" else self.A @ s_near
        self.S = [np.concatenate([axis, along + np.cross(self.P, axis)]) for axis, along in columns]
        self.r, self.v = self.P - near, self.v - np.cross(self.w, near)
        self.bend = self.near_bend - np.cross(self.twist, near) - np.cross(self.w, np.cross(self.w, near))

    def _take(self, count: int) -> Any:
        self.next_parameter += count
        return vector(self.hy.par[i] for i in range(self.next_parameter - count, self.next_parameter))

    def _move(self, kind: Kind, axes: Any, columns: list[Any]) -> Any:
        """Go along the joint's motions, adding their columns; returns the joint's axes in the near body."""
        zero = vector([0.0] * 3)
        for i, (what, number) in enumerate(KINDS[kind].motions):
            x, rate, axis = self.x["x"][i], self.x["xdot"][i], axes[:, number]
            if what == "slide":
                shift, swing = x * axis, np.cross(self.w, axis)
                self.near_bend = self.near_bend + np.cross(self.twist, shift)
                self.near_bend = (
                    self.near_bend + np.cross(self.w, np.cross(self.w, shift)) + 2.0 * rate * swing
                )
                self.P, self.v = self.P + shift, self.v + np.cross(self.w, shift) + rate * axis
                columns.append((zero, axis))
            else:
                self.twist = self.twist + rate * np.cross(self.w, axis)
                self.w = self.w + rate * axis
                columns.append((axis, zero))
                j, k = (number + 1) % 3, (number + 2) % 3
                c, s, turned = self.hy.cos(x), self.hy.sin(x), axes.copy()
                turned[:, j], turned[:, k] = c * axes[:, j] + s * axes[:, k], c * axes[:, k] - s * axes[:, j]
                axes = turned
        return axes

    def joint_elements(self, kind: Kind) -> list[tuple[Any, Any]]:
        """Of each rate ν of the joint: what its rotor adds to M, and what its elements add to h."""
        a, c, k, rest, effort = self.elements
        if kind == "ball":
            torque = a[0] * np.cross(self.relative_spin, self.w) + c[0] * self.relative_spin
            if self.turn is not None:
                torque = torque + (6.0 * k[0] * self.ratio) * self.turn
            return [(a[0], torque[i]) for i in range(3)]
        if KINDS[kind].has_attitude:
            return []
        x, rate = (self.x.get(name, ()) for name in ("x", "xdot"))
        return [(a[i], c[i] * rate[i] + k[i] * (x[i] - rest[i]) - effort[i]) for i in range(len(x))]

    def turn_equations(self, terms: list[Any]) -> list[tuple[Any, Any]]:
        """Pairs (θ², rate) and (γ, rate) of a ball joint with a spring."""
        change, f = 12.0 * self.ratio * (self.turn @ self.relative_spin), 1.0
        for term in terms:
            f = self.square * f * term + 1.0
        return [(self.square, change), (self.ratio, self.ratio * self.ratio * change * f)]

    def spatial_inertia(self) -> Any:
        """Inertia (6, 6) about the world's origin: twist → momentum, angular part first."""
        c = self.m * _cross_matrix(self.r)
        top = self.A @ self.J @ self.A.T - c @ _cross_matrix(self.r)
        mass = np.array([[self.m if i == j else 0.0 for j in range(3)] for i in range(3)], object)
        return np.block([[top, c], [-c, mass]])

    def wrench_at_rest(self, gravity: Any, has_drag: bool) -> Any:
        """Moment about the origin and force (6,) that the body needs at ν̇ = 0, besides weight and loads."""
        force, spin = self.m * (self.bend - gravity) - self.force, self.A.T @ self.w
        moment = self.A @ (self.J @ (self.A.T @ self.twist) + np.cross(spin, self.J @ spin) - self.moment)
        if has_drag:
            force, moment = force + self.drag_force * self.v, moment + self.drag_moment * self.w
        return np.concatenate([moment + np.cross(self.r, force), force])

    def equations(self, kind: Kind, above: Any, gained: Any, rates: Any) -> list[tuple[Any, Any]]:
        """Pairs (coordinate, rate), from the accelerations (6,) that ν̇ adds to the far and to this body."""
        found: list[tuple[Any, Any]] = []

        def pair(name: str, rate: Any) -> None:
            found.extend(zip(self.x[name], rate, strict=True))

        def moved(point: Any, twist: Any) -> Any:
            return twist[3:] + np.cross(twist[:3], point)

        if not KINDS[kind].has_attitude:
            if self.x:
                pair("x", self.x["xdot"])
                pair("xdot", rates)
            return found
        if kind == "rod":
            u, udot = self.x["u"], self.x["udot"]
            tip = self.near_bend + moved(self.P, gained) - self.hang_bend - moved(self.hang, above)
            relative = tip / self.length
            pair("u", udot)
            pair("udot", relative - (relative @ u + udot @ udot) * u)  # written so, ‖u‖ does not drift
        if kind == "free":
            pair("r", self.x["v"])
            pair("v", self.bend + moved(self.r, gained))
        p0, p1, p2, p3 = self.x["p"]
        wx, wy, wz = 0.5 * self.x["omega"]
        rate = [-p1 * wx - p2 * wy - p3 * wz, p0 * wx - p3 * wy + p2 * wz]
        pair("p", [*rate, p3 * wx + p0 * wy - p1 * wz, -p2 * wx + p1 * wy + p0 * wz])
        pair("omega", self.A.T @ (self.twist + gained[:3]))
        return found


_PARAMETERS = 1 + 9 + 6 + 18 + 6 + 3 + 10  # of a body
_SPRING_PARAMETERS = 6 + 3
_BALL_SPRING_TERMS = 40  # of f₀; they are parameters, because constants would be rounded to double


def _add_spring(
    hy: Any, bodies: list[_Body], wrenches: list[Any], ends: tuple[int, int], first_parameter: int
) -> None:
    """Subtract the pull of a spring between two points from the wrenches that its bodies need."""
    numbers = vector(hy.par[i] for i in range(first_parameter, first_parameter + _SPRING_PARAMETERS))
    points, (k, c, rest), places, rates = numbers[:6].reshape(2, 3), numbers[6:], [], []
    for end, point in zip(ends, points, strict=True):
        body = bodies[end] if end >= 0 else None
        arm = point if body is None else body.A @ point
        places.append(arm if body is None else body.r + arm)
        rates.append(vector([0.0] * 3) if body is None else body.v + np.cross(body.w, arm))
    d = places[1] - places[0]
    length = hy.sqrt(d @ d)
    tension = k * (length - rest) + c * (d @ (rates[1] - rates[0])) / length
    for end, place, sign in zip(ends, places, (1.0, -1.0), strict=True):
        if end >= 0:
            pull = (sign * tension / length) * d
            wrenches[end] = wrenches[end] - np.concatenate([np.cross(place, pull), pull])


def _subtree_sums(tree: Topology, values: list[Any]) -> list[Any]:
    total = list(values)
    for k in reversed(range(len(total))):
        if tree.far[k] >= 0:
            total[tree.far[k]] = total[tree.far[k]] + total[k]
    return total


def _mass_matrix(
    tree: Topology, bodies: list[_Body], composite: list[Any], wrench: list[Any]
) -> tuple[list[list[Any]], list[int], list[Any]]:
    """The lower triangle of M as rows, the rate before each along the tree (−1: none), and −h."""
    first = np.cumsum([0, *(len(body.S) for body in bodies)]).tolist()
    last = [-1] * len(bodies)  # last rate on the path to each body
    H: list[list[Any]] = [[None] * (row + 1) for row in range(first[-1])]
    before, right = [-1] * first[-1], []
    for k, body in enumerate(bodies):
        reached = last[tree.far[k]] if tree.far[k] >= 0 else -1
        for i, column in enumerate(body.S):
            row = first[k] + i
            before[row], reached = reached, row
            right.append(-(column @ wrench[k]))
            momentum, j, own = composite[k] @ column, k, i + 1
            while j >= 0:
                for other in range(own):
                    H[row][first[j] + other] = bodies[j].S[other] @ momentum
                j = tree.far[j]
                own = len(bodies[j].S) if j >= 0 else 0
        last[k] = reached
        if tree.has_joint_elements:
            for i, (rotor, force) in enumerate(body.joint_elements(tree.kind[k])):
                H[first[k] + i][first[k] + i] = H[first[k] + i][first[k] + i] + rotor
                right[first[k] + i] = right[first[k] + i] - force
        if tree.kind[k] == "rod":  # no motion along u
            u, size = body.x["u"], body.m * body.length * body.length
            for i in range(3):
                for j in range(i + 1):
                    H[first[k] + i][first[k] + j] = H[first[k] + i][first[k] + j] + size * u[i] * u[j]
    return H, before, right


def _path(before: list[int], i: int) -> Iterable[int]:
    while (i := before[i]) >= 0:
        yield i


def _factor_sparse(H: list[list[Any]], before: list[int]) -> None:
    """Factor H = Lᵀ D L in place, along the tree's branches only."""
    for k in reversed(range(len(H))):
        for i in _path(before, k):
            factor = H[k][i] / H[k][k]
            for j in (i, *_path(before, i)):
                H[i][j] = H[i][j] - factor * H[k][j]
            H[k][i] = factor


def _substitute_sparse(H: list[list[Any]], before: list[int], b: list[Any]) -> list[Any]:
    """Solve H x = b by the factors of H."""
    x = list(b)
    for k in reversed(range(len(x))):
        for i in _path(before, k):
            x[i] = x[i] - H[k][i] * x[k]
    for k in range(len(x)):
        x[k] = x[k] / H[k][k]
        for i in _path(before, k):
            x[k] = x[k] - H[k][i] * x[i]
    return x


def _close_loops(
    tree: Topology, bodies: list[_Body], H: list[list[Any]], before: list[int], free: list[Any]
) -> list[Any]:
    """ν̇ with the loops closed, from the factors of M and the ν̇₀ of the open tree."""
    first = np.cumsum([0, *(len(body.S) for body in bodies)]).tolist()
    J: list[list[Any]] = []
    gap: list[Any] = []  # relative accelerations at ν̇ = ν̇₀
    for b, c, rows in tree.closures:
        turned = bodies[b].A.T
        columns = np.full((6, first[-1]), 0.0, object)
        for end, sign in ((b, 1.0), (c, -1.0)):
            k = end
            while k >= 0:
                for i, S in enumerate(bodies[k].S):
                    at = np.concatenate([S[3:] + np.cross(S[:3], bodies[end].r), S[:3]])
                    columns[:, first[k] + i] = columns[:, first[k] + i] + sign * at
                k = tree.far[k]
        bend, twist = bodies[b].bend - bodies[c].bend, bodies[b].twist - bodies[c].twist
        columns = np.concatenate([turned @ columns[:3], turned @ columns[3:]])
        bias = np.concatenate([turned @ bend, turned @ twist])
        J += [list(columns[row]) for row in rows]
        gap += [
            bias[row] + sum((x * y for x, y in zip(columns[row], free, strict=True)), 0.0) for row in rows
        ]
    X = [_substitute_sparse(H, before, row) for row in J]
    held = [
        [sum((x * y for x, y in zip(J[i], X[j], strict=True)), 0.0) for j in range(i + 1)]
        for i in range(len(J))
    ]
    dense = [i - 1 for i in range(len(J))]
    _factor_sparse(held, dense)
    multipliers = _substitute_sparse(held, dense, [-x for x in gap])
    return [
        sum((X[i][j] * multiplier for i, multiplier in enumerate(multipliers)), rate)
        for j, rate in enumerate(free)
    ]


def vector(entries: Iterable[Any]) -> Any:
    """Make a one-dimensional array of objects.

    Args:
        entries: expressions, numbers or arrays.

    """
    return np.fromiter(entries, dtype=object)


def rotation_matrix(p: Any) -> Any:
    """Write the rotation of a unit quaternion without constants, which quad arrays do not mix with.

    Args:
        p: four expressions or arrays, scalar first.

    Returns:
        (3, 3) array of objects, body → world.

    """
    w, x, y, z = p
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    x2, y2, w2 = x + x, y + y, w + w
    return vector(
        [
            *(ww + xx - yy - zz, x2 * y - w2 * z, x2 * z + w2 * y),
            *(x2 * y + w2 * z, ww - xx + yy - zz, y2 * z - w2 * x),
            *(x2 * z - w2 * y, y2 * z + w2 * x, ww - xx - yy + zz),
        ]
    ).reshape(3, 3)


def _cross_matrix(s: Any) -> Any:
    x, y, z = s
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], object)
