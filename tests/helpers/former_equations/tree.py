"""The trees' certified quantities as they were before `plumbline.equations`, in joint coordinates.

No constraint rows: each joint has the motions that it allows, as columns S_k (6, m_k) of twists about the
world's origin, (angular velocity; velocity of the point at the origin), world axes, carried rigidly by all
bodies beyond.  With I_c the composite inertia of a subtree and w its wrench at ν̇ = 0, both about the origin,

    M_jk = S_jᵀ I_c,k S_k  for j on the path from the world to k     (composite rigid bodies, CRBA)
    h_k  = S_kᵀ w_k                                                  (recursive Newton–Euler, RNEA)
    M ν̇ = −h,   with passive elements also of `ball_elements`

(Featherstone, Rigid Body Dynamics Algorithms, 2008, tables 5.1 and 6.2).  A rod lets its near end slide
along two tangents of the sphere about its far end, and has a ball joint there.  Rates ν are relative to the
far body.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from plumbline.equations.balls import entries
from plumbline.model.datatypes import KINDS, Model, State
from plumbline.model.kinematics import own_rates, rate_count
from plumbline.truth.certified_state import quantity_scales
from tests.helpers.former_equations.ball_elements import ball_elements
from tests.helpers.former_equations.joint_tree import BallVectors, JointTree


class BallArithmetic(BallVectors):
    """A model in balls; ``J`` is in body axes, gravity ``g`` in world axes."""

    def __init__(self, flint: Any, model: Model) -> None:
        super().__init__(flint)
        self.model, self.n = model, model.n
        self.m = [self.arb(float(m)) for m in model.mass]
        self.J = [self.matrix(J) for J in model.inertia]
        self.g = self.vector(model.gravity)

    def rod_direction(self, state: State, k: int) -> tuple[Any, Any]:
        """U of rod k as a unit vector and u̇ perpendicular to it.

        Args:
            state: a state of the model.
            k: the rod.

        Returns:
            u, and u̇ [1/s].

        """
        u, udot = self.vector(state.u[k]), self.vector(state.udot[k])
        u = u * (1 / self.dot(u, u).sqrt())
        return u, udot - u * self.dot(u, udot)


class BallTree(JointTree, BallArithmetic):
    """Model and state in balls: lists over the bodies of 3×1 ``arb_mat`` in world axes.

    Attitudes A, centres r, velocities v, angular velocities w; of the joints the near points P, the motions S
    and the tangents of rods; accelerations that the joints allow, to which S ν̇ adds: ``bend`` r̈, ``twist`` ω̇.
    """

    def __init__(self, flint: Any, model: Model, state: State) -> None:
        super().__init__(flint, model)
        self.state, self.far = state, [int(far) for far in model.body[:, 0]]
        self.A: list[Any] = []
        self.r: list[Any] = []
        self.v: list[Any] = []
        self.w: list[Any] = []
        self.P: list[Any] = []
        self.S: list[Any] = []
        self.bend: list[Any] = []
        self.twist: list[Any] = []
        self.tangents: list[list[Any]] = []
        for k in range(self.n):
            self._add_body(k)

    def coordinate(self, k: int, i: int) -> tuple[Any, Any]:
        """Return a scalar coordinate and its rate.

        Args:
            k: the joint.
            i: which of its motions.

        Returns:
            Two balls [rad, m] and per second.

        """
        return self.arb(float(self.state.x[k, i])), self.arb(float(self.state.xdot[k, i]))

    def attitude(self, k: int) -> tuple[Any, Any]:
        """Return A and the angular velocity of a body, where they are coordinates.

        Args:
            k: the body.

        Returns:
            A 3×3 matrix, and a vector in world axes [rad/s].

        """
        A = self.rotation(self.state.p[k])
        return A, A * self.vector(self.state.omega[k])

    def rod(self, k: int) -> tuple[Any, Any]:
        """Return the direction of a rod and its rate.

        Args:
            k: the rod.

        Returns:
            Two vectors, world axes.

        """
        return self.rod_direction(self.state, k)

    def free_point(self, k: int) -> tuple[Any, Any]:
        """Return the centre of mass of a free body and its velocity.

        Args:
            k: the body.

        Returns:
            Two vectors, world axes [m, m/s].

        """
        return self.vector(self.state.r[k]), self.vector(self.state.v[k])

    def _add_body(self, k: int) -> None:
        """Place joint k, from its far point to its near point, and body k."""
        model, state, kind, far = self.model, self.state, self.model.kind[k], self.far[k]
        P, v, a = self.vector(model.point[k, 0]), self.zero, self.zero
        w = alpha = self.zero
        if far >= 0:
            w, alpha, arm = self.w[far], self.twist[far], self.A[far] * P
            cross = self.cross_matrix(w)
            P, v = self.r[far] + arm, self.v[far] + cross * arm
            a = self.bend[far] + self.cross_matrix(alpha) * arm + cross * (cross * arm)
        columns: list[tuple[Any, Any]] = []  # angular velocity, velocity of the near point
        self.tangents.append([])
        if kind == "rod":
            u, udot = self.rod(k)
            ell = self.arb(float(model.length[k]))
            P, v, a = P + u * ell, v + udot * ell, a - u * (self.dot(udot, udot) * ell)
            first = self.cross_matrix(u) * self.units[int(np.argmin(np.abs(state.u[k])))]
            self.tangents[k] = [first, self.cross_matrix(u) * first]
            columns = [(self.zero, t * ell) for t in self.tangents[k]]
        if kind == "free":
            (P, v), a = self.free_point(k), self.zero
            columns = [(self.zero, e) for e in self.units]
        if KINDS[kind].has_attitude:
            A, w = self.attitude(k)
            columns += [(e, self.zero) for e in self.units]
        else:
            A, w, P, v, a, alpha = self._move(k, w, P, v, a, alpha, columns)
        near = self.zero if kind == "free" else A * self.vector(model.point[k, 1])
        cross = self.cross_matrix(w)
        self.A.append(A)
        self.w.append(w)
        self.P.append(P)
        self.r.append(P - near)
        self.v.append(v - cross * near)
        self.twist.append(alpha)
        self.bend.append(a - self.cross_matrix(alpha) * near - cross * (cross * near))
        self.S.append(self.twist_columns(P, columns))

    def _move(
        self, k: int, w: Any, P: Any, v: Any, a: Any, alpha: Any, columns: list[Any]
    ) -> tuple[Any, ...]:
        """Go along the motions of joint k; adds its columns."""
        A = self.rotation(self.model.turn[k, 0])
        if self.far[k] >= 0:
            A = self.A[self.far[k]] * A
        for i, (what, number) in enumerate(KINDS[self.model.kind[k]].motions):
            x, rate = self.coordinate(k, i)
            axis, cross = A * self.units[number], self.cross_matrix(w)
            if what == "slide":
                shift = axis * x
                P, v = P + shift, v + cross * shift + axis * rate
                a = a + self.cross_matrix(alpha) * shift + cross * (cross * shift) + cross * axis * (2 * rate)
                columns.append((self.zero, axis))
            else:
                w, alpha = w + axis * rate, alpha + cross * axis * rate
                A = A * self.turn_about(number, x)
                columns.append((axis, self.zero))
        return A * self.rotation(self.model.turn[k, 1]).transpose(), w, P, v, a, alpha

    def turn_about(self, axis: int, angle: Any) -> Any:
        """Return the rotation about a coordinate axis.

        Args:
            axis: 0, 1 or 2.
            angle: a ball [rad].

        Returns:
            A 3×3 matrix.

        """
        c, s = angle.cos(), angle.sin()
        m = [[self.arb(int(i == j)) for j in range(3)] for i in range(3)]
        i, j = (axis + 1) % 3, (axis + 2) % 3
        m[i][i], m[i][j], m[j][i], m[j][j] = c, -s, s, c
        return self.mat(m)

    def wrench_at_rest(self, k: int) -> Any:
        """Return what a body needs at ν̇ = 0, besides weight and loads.

        Args:
            k: the body.

        Returns:
            Its moment about the origin and its force, a 6×1 matrix.

        """
        model, ball = self.model, self.arb
        force = (self.bend[k] - self.g) * self.m[k] - self.vector(model.force[k])
        force = force + self.v[k] * ball(float(model.drag_force[k]))
        inertia = self.A[k] * self.J[k] * self.A[k].transpose()
        moment = inertia * self.twist[k] + self.cross_matrix(self.w[k]) * (inertia * self.w[k])
        moment = moment - self.A[k] * self.vector(model.moment[k])
        moment = moment + self.w[k] * ball(float(model.drag_moment[k])) + self.cross_matrix(self.r[k]) * force
        return self.mat(6, 1, [*entries(moment), *entries(force)])


@dataclass(frozen=True, eq=False)
class TreeEquations:
    """M ν̇ = right in a tree's relative rates."""

    M: Any
    right: list[Any]
    first: list[int]  # where each joint's rates begin
    wrenches: list[Any]  # (6, 1) that each body needs at ν̇ = 0
    kinetic: Any  # J, of rotors
    potential: Any  # J, of springs


def equations_of_motion(c: BallTree) -> TreeEquations:
    """Set up the equations of a tree.

    Args:
        c: the tree.

    Returns:
        The equations.

    """
    model = c.model
    M, first = c.joint_mass_matrix()
    wrenches = [c.wrench_at_rest(k) for k in range(c.n)]
    kinetic = potential = c.arb(0)
    effort = [c.arb(0)] * first[-1]
    if model.has_elements:
        elements = ball_elements(c)
        kinetic, potential = elements.kinetic, elements.potential
        wrenches = [wrench - pull for wrench, pull in zip(wrenches, elements.wrench, strict=True)]
        effort = [x for own in elements.effort for x in own]
        for i, a in enumerate(a for own in elements.armature for a in own):
            M[i, i] += a
    total = c.subtree_sums(wrenches)
    h = [x for k in range(c.n) for x in entries(c.S[k].transpose() * total[k])]
    right = [push - x for push, x in zip(effort, h, strict=True)]
    return TreeEquations(M, right, first, wrenches, kinetic, potential)


def moving_quantities(
    c: BallTree, equations: TreeEquations, rates: list[Any], applied: dict[int, Any] | None = None
) -> dict[str, Any]:
    """Compute the quantities of a tree from ν̇.

    Args:
        c: the tree.
        equations: of the same tree.
        rates: ν̇.
        applied: further wrenches (6, 1) on bodies: moment about the origin, force.

    Returns:
        By quantity, as `plumbline.truth.certified_state.enclose_quantities`, without mass matrix and scales.

    """
    first, wrenches = equations.first, list(equations.wrenches)
    kinetic, potential = equations.kinetic, equations.potential
    for k, wrench in (applied or {}).items():
        wrenches[k] = wrenches[k] - wrench
    acceleration, angular, momentum = [], [], c.zero
    gained: list[Any] = []  # twist that ν̇ adds
    for k in range(c.n):
        own = c.mat(6, 1, [0] * 6)
        if first[k + 1] > first[k]:
            own = c.S[k] * c.mat(first[k + 1] - first[k], 1, rates[first[k] : first[k + 1]])
        gained.append(own + gained[c.far[k]] if c.far[k] >= 0 else own)
        top, bottom = (c.mat(3, 1, entries(gained[k])[part]) for part in (slice(0, 3), slice(3, 6)))
        acceleration.append(c.bend[k] + bottom + c.cross_matrix(top) * c.r[k])
        angular.append(c.A[k].transpose() * (c.twist[k] + top))
        spin = c.A[k] * (c.J[k] * (c.A[k].transpose() * c.w[k]))
        kinetic += (c.m[k] * c.dot(c.v[k], c.v[k]) + c.dot(c.w[k], spin)) / 2
        potential -= c.m[k] * c.dot(c.g, c.r[k])
        momentum += c.cross_matrix(c.r[k]) * c.v[k] * c.m[k] + spin
        wrenches[k] = wrenches[k] + c.spatial_inertia(k) * gained[k]
    force, moment = [], []
    for k, wrench in enumerate(c.subtree_sums(wrenches)):
        about_origin, pull = (c.mat(3, 1, entries(wrench)[part]) for part in (slice(0, 3), slice(3, 6)))
        force.append(entries(pull))
        moment.append(entries(about_origin - c.cross_matrix(c.P[k]) * pull))
    return {
        "acceleration": [entries(a) for a in acceleration],
        "angular_acceleration": [entries(a) for a in angular],
        "joint_reaction": force,
        "joint_moment": moment,
        "kinetic_energy": [kinetic],
        "potential_energy": [potential],
        "angular_momentum": entries(momentum),
        "r": [entries(r) for r in c.r],
        "v": [entries(v) for v in c.v],
        "attitude": [entries(A) for A in c.A],
        "angular_velocity": [entries(A.transpose() * w) for A, w in zip(c.A, c.w, strict=True)],
    }


def enclose_tree(flint: Any, model: Model, state: State, mass_matrix: bool) -> dict[str, Any]:
    """Enclose every quantity of a tree at the working precision.

    Args:
        flint: the module python-flint.
        model: the mechanism.
        state: the state, of which the minimal coordinates are used.
        mass_matrix: whether to compute the mass matrix too.

    Returns:
        As `plumbline.truth.certified_state.enclose_quantities`.

    Raises:
        ZeroDivisionError: the mass matrix is not invertible, at this precision.

    """
    c = BallTree(flint, model, state)
    equations = equations_of_motion(c)
    M, right = equations.M, equations.right
    rates = entries(M.solve(c.mat(len(right), 1, right))) if right else []
    balls = moving_quantities(c, equations, rates)
    if mass_matrix:
        T = _relative_rates(c, equations.first)
        balls["mass_matrix"] = (T.transpose() * M * T).tolist()
    return balls | {"scale": quantity_scales(c, balls)}


def _relative_rates(c: BallTree, first: list[int]) -> Any:
    """The matrix from the rates ν of `StateQuantities.mass_matrix` to the relative ones.

    A ball joint's are A ω′ − ω_far, a rod's besides tᵀ(u̇ − ω_far × u)/tᵀt along its tangents t.
    """
    rows = [[c.arb(0)] * rate_count(c.model) for _ in range(first[-1])]
    spins: list[dict[int, Any]] = []  # of each body: column of ν → its angular velocity, world axes
    rods = np.cumsum(c.model.rods) - 1
    for k, own in enumerate(own_rates(c.model)):
        kind, far = c.model.kind[k], c.far[k]
        above = spins[far] if far >= 0 and kind != "free" else {}
        spin, at = dict(above), first[k]
        if kind == "rod":
            u, _ = c.rod_direction(c.state, k)
            for row, t in enumerate(c.tangents[k]):
                scale = 1 / c.dot(t, t)
                for i in range(3):
                    rows[at + row][3 * int(rods[k]) + i] = t[i, 0] * scale
                for column, w in above.items():
                    rows[at + row][column] = -c.dot(t, c.cross_matrix(w) * u) * scale
            at += 2
        if kind == "free":
            for i in range(3):
                rows[at + i][own.start + i] = c.arb(1)
            at += 3
        if KINDS[kind].has_attitude:
            spin = {}
            for i in range(3):
                spin[own.stop - 3 + i] = w = c.A[k] * c.units[i]
                for row in range(3):
                    rows[at + row][own.stop - 3 + i] = w[row, 0]
            for column, w in above.items():
                for row in range(3):
                    rows[at + row][column] = -w[row, 0]
        else:
            for i in range(c.S[k].ncols()):
                rows[at + i][own.start + i] = c.arb(1)
                spin[own.start + i] = c.mat(3, 1, [c.S[k][row, i] for row in range(3)])
        spins.append(spin)
    return c.mat(rows) if rows else c.mat(0, 0)
