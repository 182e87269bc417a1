"""The system S x = b of the notes for any joints; trees in O(bodies), eliminated leaves first.

The rows are those of `joints`.  With π = pᵀp and α of p̈ = Lᵀα/2π − p ṗᵀṗ/π as in `chain_elimination`, the
rows of joint k are n_k a_k + f_k a_far = γ_k for a = (r̈, α), and every body obeys

    A_k a_k = b_k − n_kᵀ λ_k,   A = diag(m I, J),   b = (F, n′ − ω×Jω/π − 2 (σ/π) Jω)

With all joints beyond body k eliminated, S_k = n_k A_k⁻¹ n_kᵀ and S_k λ_k = n_k A_k⁻¹ b_k + f_k a_far − γ_k
leave

    A_far += f_kᵀ S_k⁻¹ f_k,   b_far −= f_kᵀ S_k⁻¹ (n_k A_k⁻¹ b_k − γ_k).

A rotor (L4) is one row more of its joint, with 1/a on the diagonal of S_k; see `elements`.

Joints of the same depth and number of rows are eliminated together, those of many trees at once.

Mechanisms with loops, or with bodies without inertia, have the same rows and are solved as they stand, by
dense factors of

    A a + nᵀ λ + fᵀ λ = b,    n a_k + f a_far − λ / a_rotor = γ

with rows that do not depend on others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reference_impl.arrays import Array, Float, Indices, Int, Motion
from reference_impl.direct import (
    RUN_RANK_TOLERANCE,
    Solution,
    independent_rows,
    joint_forces,
    power_of_two_scale,
)
from reference_impl.elements import ElementForces, Elements
from reference_impl.euler_parameters import L, angular_velocity, cross, dot
from reference_impl.fast.chain_elimination import StructuredSystem, component_first
from reference_impl.integrate import Acceleration, direct_acceleration
from reference_impl.joints import ConstraintRows, constraint_rows, joint_of_rows
from reference_impl.mechanism import Mechanism, side_by_side
from reference_impl.singular_system import SingularSystem


@dataclass(frozen=True, eq=False)
class _Level:
    """Joints of one depth and one number of rows c."""

    body: Int[Indices, "g"]  # their near bodies
    far: Int[Indices, "g"]  # their far bodies, −1 the world
    row: Int[Indices, "g c"]


class TreeSystem:
    """Trees side by side; M bodies in all.  q = (r; p) and v = (ṙ; ṗ), (7, M), as in `StructuredSystem`."""

    def __init__(
        self, chains: Sequence[Mechanism], x: Float[Array, "joints coordinates"] | None = None
    ) -> None:
        """Join the mechanisms.

        Args:
            x: joint coordinates near which the angles of springs are taken [rad]; absent:
                principal values.

        """
        self.chains = tuple(chains)
        self.first_body = np.cumsum([0, *(chain.n for chain in chains)])
        self.body_count = int(self.first_body[-1])
        self.forest = side_by_side(self.chains)
        self.weight = np.concatenate([c.mass[:, None] * c.gravity + c.force for c in chains])
        self.x, self.elements = x, Elements(self.forest) if self.forest.has_elements else None
        # springs on angles: the motion depends on their full turns, which r and p do not hold
        self.winding = self.elements if self.elements and self.elements.has_winding_angles else None
        joint, self.compliance = joint_of_rows(self.forest), np.zeros(0)
        if self.elements:  # the rows of rotors follow those of all constraints
            rotors = self.elements.rotors
            self.compliance = 1 / self.elements.armature[rotors]
            joint = np.concatenate([joint, self.elements.joint[rotors]])
        self.compliance = np.concatenate([np.zeros(len(joint) - len(self.compliance)), self.compliance])
        self.joint, self.joint_count = joint, len(self.forest.kind)
        self.far, self.near = self.forest.body[joint].T
        self.levels = self._levels()
        self.inertia = np.zeros((self.body_count, 6, 6))
        self.inertia[:, :3, :3] = self.forest.mass[:, None, None] * np.eye(3)
        self.inertia[:, 3:, 3:] = self.forest.inertia

    def _levels(self) -> list[_Level]:
        """The joints in the order from the world on."""
        far, depth = self.forest.body[:, 0], np.zeros(self.body_count, np.intp)
        for k in np.flatnonzero(far >= 0):
            depth[k] = depth[far[k]] + 1
        count = np.bincount(self.joint, minlength=self.body_count)
        first, in_order, levels = np.cumsum(count) - count, np.argsort(self.joint, kind="stable"), []
        for level, rows in sorted(set(zip(depth.tolist(), count.tolist(), strict=True))):
            at = np.flatnonzero((depth == level) & (count == rows))
            levels.append(_Level(at, far[at], in_order[first[at, None] + np.arange(rows)]))
        return levels

    def repeated(self, count: int) -> TreeSystem:
        """Repeat the trees: all of them, then all again.

        Returns:
            A system of ``count`` times as many trees.

        """
        if count == 1:
            return self
        return type(self)(self.chains * count, None if self.x is None else np.tile(self.x, (count, 1)))

    def acceleration(
        self,
        q: Float[Array, "7 bodies"],
        v: Float[Array, "7 bodies"],
        baumgarte: float = 0.0,
        x: Float[Array, "joints coordinates"] | None = None,
    ) -> Float[Array, "7 bodies"]:
        """Return the accelerations, on or off the constraints.

        Args:
            q: (r; p) [m, –].
            v: (ṙ; ṗ) [m/s, 1/s].
            baumgarte: a [1/s]; adds −2 a Ċ − a² C to γ and likewise to γ_E.  0 is the notes' raw form.
            x: joint coordinates in place of those of the constructor.

        Returns:
            (r̈; p̈) [m/s², 1/s²].

        Raises:
            SingularSystem: S is singular.

        """
        return self._solve_motion(q, v, baumgarte, x)[0]

    def _solve_motion(
        self, q: Array, v: Array, a: float, x: Array | None, refine: bool = False
    ) -> tuple[Array, Array, ConstraintRows, ElementForces | None]:
        """(r̈; p̈) (7, M), the multipliers of all rows, the rows, and what elements there are."""
        (p, rdot, pdot), forest = (q[3:].T, v[:3].T, v[3:].T), self.forest
        with np.errstate(all="ignore"):  # what is not finite raises SingularSystem
            rows, rate, elements = self._rows(q, v, x)
            gamma, norm, sigma, stretch = rows.gamma, dot(p, p), dot(p, pdot), dot(pdot, pdot)
            if a:
                gamma -= 2 * a * rate + a * a * rows.C
                stretch = stretch + 2 * a * sigma + 0.5 * a * a * (norm - 1)
            omega = angular_velocity(p, pdot)
            momentum = np.matvec(forest.inertia, omega)
            force = self.weight - forest.drag_force[:, None] * rdot
            moment = forest.moment - forest.drag_moment[:, None] * omega
            moment = moment - (cross(omega, momentum) + 2 * sigma[:, None] * momentum) / norm[:, None]
            along = p * (stretch / norm)[:, None]  # −p̈ along p
            gamma = gamma + dot(rows.p_near, along[self.near]) + dot(rows.p_far, along[self.far])
            if elements:
                force = force + elements.force
                moment = moment + np.matvec(L(p), elements.p_force) / (2 * norm)[:, None]
            body_terms = np.concatenate([force, moment], 1)
            linear, turn, multiplier = self._eliminate(rows, p, body_terms, gamma, refine)
        found = component_first(linear, turn - along)
        if not np.isfinite(found.sum()):
            raise SingularSystem("the accelerations are not finite: S is singular, or the state is no number")
        return found, multiplier, rows, elements

    def solve(self, *motion: *Motion, x: Float[Array, "joints coordinates"] | None = None) -> Solution:
        """Solve (N5) for every tree.

        Args:
            motion: r, p, ṙ and ṗ.
            x: joint coordinates in place of those of the constructor.

        Returns:
            r̈, p̈, λ and the wrenches at the joints, those of elements included; λ_E is not computed (NaN).

        Raises:
            SingularSystem: S is singular.

        """
        r, p, v, pdot = motion
        q, qdot = component_first(r, p), component_first(v, pdot)
        found, multiplier, rows, elements = self._solve_motion(q, qdot, 0.0, x, refine=True)
        c = len(self.joint) - np.count_nonzero(self.compliance)
        return Solution(
            acceleration=found[:3].T,
            pddot=found[3:].T,
            multiplier=multiplier[:c],
            norm_multiplier=np.full(self.body_count, np.nan),
            joint=self.joint[:c],
            **joint_forces(self.forest, p, rows, multiplier, elements),
        )

    def project(
        self, q: Float[Array, "7 bodies"], v: Float[Array, "7 bodies"]
    ) -> tuple[Float[Array, "7 bodies"], Float[Array, "7 bodies"]]:
        """Project onto C = 0, pᵀp = 1, Ċ = 0, pᵀṗ = 0 by Newton steps in the metric of M and 4 LᵀJL.

        Args:
            q: (r; p) [m, –].
            v: (ṙ; ṗ) [m/s, 1/s].

        Returns:
            q and v on the constraints.

        Raises:
            SingularSystem: S is singular.

        """
        q, v = q.copy(), v.copy()
        rest = np.zeros((self.body_count, 6))
        for _ in range(2):  # the second step takes the square of the gap away
            q[3:] /= np.sqrt(dot(q[3:].T, q[3:].T))
            rows = self._held_rows(q, v)[0]
            q += component_first(*self._eliminate(rows, q[3:].T, rest, -rows.C)[:2])
        q[3:] /= np.sqrt(dot(q[3:].T, q[3:].T))
        v[3:] -= q[3:] * dot(q[3:].T, v[3:].T)
        rows, rate = self._held_rows(q, v)
        v += component_first(*self._eliminate(rows, q[3:].T, rest, -rate)[:2])
        return q, v

    def _rows(
        self, q: Array, v: Array, x: Float[Array, "joints coordinates"] | None = None
    ) -> tuple[ConstraintRows, Array, ElementForces | None]:
        """The rows of all joints and then of all rotors, Ċ, and the elements."""
        if self.elements is None:
            return *self._held_rows(q, v), None
        state = q[:3].T, q[3:].T, v[:3].T, v[3:].T
        rows = constraint_rows(self.forest, *state)
        rate = rows.constraint_rate(*state[2:])
        found = self.elements.evaluate(*state, x=self.x if x is None else x)
        rotors = np.zeros(len(self.elements.rotors))
        return self.elements.with_rotors(rows, found), np.concatenate([rate, rotors]), found

    def _held_rows(self, q: Array, v: Array) -> tuple[ConstraintRows, Array]:
        """The rows of all joints, with those of rotors if there are any, and Ċ."""
        if self.elements and len(self.elements.rotors):
            return self._rows(q, v)[:2]
        rows = constraint_rows(self.forest, q[:3].T, q[3:].T, v[:3].T, v[3:].T)
        return rows, rows.constraint_rate(v[:3].T, v[3:].T)

    def _eliminate(
        self, rows: ConstraintRows, p: Array, wrench: Array, gamma: Array, refine: bool = False
    ) -> tuple[Array, Array, Array]:
        """Solve for a: r̈ (M, 3) and Lᵀα/2π (M, 4), with b = ``wrench`` (M, 6); and for all multipliers.

        Refined once, it keeps the digits that a light body before a heavy one costs.
        """
        turn = L(p).swapaxes(-1, -2) / (2 * dot(p, p))[:, None, None]
        near = np.concatenate([rows.r_near, np.vecmat(rows.p_near, turn[self.near])], 1)
        far = np.concatenate([-rows.r_near, np.vecmat(rows.p_far, turn[self.far])], 1)
        a, multiplier = self._substitute(near, far, wrench, gamma)
        if refine:
            left = wrench - np.matvec(self.inertia, a)
            np.subtract.at(left, self.near, multiplier[:, None] * near)
            held = self.far >= 0
            np.subtract.at(left, self.far[held], (multiplier[:, None] * far)[held])
            far_a = np.where(held[:, None], a[self.far], 0.0)
            open_ = gamma - dot(near, a[self.near]) - dot(far, far_a) + self.compliance * multiplier
            a_change, change = self._substitute(near, far, left, open_)
            a, multiplier = a + a_change, multiplier + change
        return a[:, :3], np.matvec(turn, a[:, 3:]), multiplier

    def _substitute(self, near: Array, far: Array, wrench: Array, gamma: Array) -> tuple[Array, Array]:
        """Eliminate from the leaves, substitute from the world: a (M, 6) and the multipliers."""
        A, b, kept = self.inertia.copy(), wrench.copy(), []
        try:
            for level in reversed(self.levels):
                n, f = near[level.row], far[level.row]
                solved = np.linalg.solve(A[level.body], np.concatenate([n.mT, b[level.body, :, None]], 2))
                X, y = solved[..., :-1], solved[..., -1]
                right = np.concatenate([f, (np.matvec(n, y) - gamma[level.row])[..., None]], 2)
                Z = np.linalg.solve(n @ X + self.compliance[level.row][:, None] * np.eye(n.shape[1]), right)
                kept.append((X, y, Z))
                up = level.far >= 0
                np.add.at(A, level.far[up], (f.mT @ Z[..., :-1])[up])
                np.subtract.at(b, level.far[up], np.vecmat(Z[..., -1], f)[up])
        except np.linalg.LinAlgError:
            raise SingularSystem("S is singular: the rows of a joint are not independent") from None
        a, multiplier = np.zeros((self.body_count + 1, 6)), np.zeros(len(self.joint))  # a[-1]: the world
        for level, (X, y, Z) in zip(self.levels, reversed(kept), strict=True):
            multiplier[level.row] = own = np.matvec(Z[..., :-1], a[level.far]) + Z[..., -1]
            a[level.body] = y - np.matvec(X, own)
        return a[:-1], multiplier


class DenseSystem(TreeSystem):
    """Mechanisms of the same joints between the same bodies, with loops or not; solved by dense factors.

    Inertias may be singular where the joints leave no motion without inertia.  Rows that depend on others are
    those of the first mechanism: the others differ little from it.
    """

    def _levels(self) -> list[_Level]:
        """None; the rows mechanism by mechanism, where those of rotors follow those of all constraints."""
        self.by_mechanism = np.argsort(self.near // self.chains[0].n, kind="stable")
        return []

    def _substitute(self, near: Array, far: Array, wrench: Array, gamma: Array) -> tuple[Array, Array]:
        """Solve for a (M, 6) and the multipliers, 0 of rows that depend on others."""
        batch, n = len(self.chains), self.chains[0].n
        c, each = len(gamma) // batch, np.arange(len(gamma) // batch)
        order, gamma = self.by_mechanism, gamma[self.by_mechanism]
        first, compliance = order[:c], self.compliance[order].reshape(batch, c)
        C, held = np.zeros((batch, c, 6 * n)), np.flatnonzero(self.far[first] >= 0)
        for part, body, rows in ((near, self.near, each), (far, self.far, held)):
            columns = 6 * body[first[rows], None] + np.arange(6)
            C[:, rows[:, None], columns] = part[order].reshape(batch, c, 6)[:, rows]
        is_soft = compliance[0] > 0
        of_joints = np.flatnonzero(~is_soft)
        kept = of_joints[independent_rows(C[0, of_joints], RUN_RANK_TOLERANCE)]
        kept = np.sort(np.concatenate([kept, np.flatnonzero(is_soft)]))
        C, compliance, inertia = C[:, kept], compliance[:, kept], self.inertia.reshape(batch, n, 6, 6)
        # S is scaled before it is put together: most of its entries are 0
        size, of_rows = np.abs(C), np.abs(inertia).max(axis=-1).reshape(batch, -1)
        largest = [np.maximum(of_rows, size.max(axis=1)), np.maximum(compliance, size.max(axis=2))]
        of_a, of_rows = scales = [power_of_two_scale(x) for x in largest]
        C *= of_rows[:, :, None]
        C *= of_a[:, None]
        S = np.zeros((batch, 6 * n + len(kept), 6 * n + len(kept)))
        S[:, 6 * n :, : 6 * n], S[:, : 6 * n, 6 * n :] = C, C.mT
        for k in range(n):
            own = slice(6 * k, 6 * k + 6)
            S[:, own, own] = inertia[:, k] * of_a[:, own, None] * of_a[:, None, own]
        each = 6 * n + np.arange(len(kept))
        S[:, each, each] = -compliance * of_rows**2
        right = np.concatenate([wrench.reshape(batch, -1), gamma.reshape(batch, -1)[:, kept]], axis=1)
        scale = np.concatenate(scales, axis=1)
        try:
            found = scale * np.linalg.solve(S, (right * scale)[..., None])[..., 0]
        except np.linalg.LinAlgError:
            raise SingularSystem("S is singular: the rows of a loop are not independent") from None
        multiplier = np.zeros(len(gamma))
        multiplier[order.reshape(batch, c)[:, kept]] = found[:, 6 * n :]
        return found[:, : 6 * n].reshape(-1, 6), multiplier


EliminatedSystem = StructuredSystem | TreeSystem


def eliminated_system(
    mechanisms: Sequence[Mechanism], x: Float[Array, "joints coordinates"] | None = None
) -> EliminatedSystem:
    """Make the form of the notes' system that motions are integrated in: O(bodies) where there are no loops.

    Args:
        mechanisms: chains of rods and balls, trees with any joints, or mechanisms with loops that have the
            same joints between the same bodies.
        x: as of `TreeSystem`.

    Returns:
        The form of chains where all are such, else that of trees, or the dense one of loops and of bodies
        without inertia about some axis.

    """
    if any(mechanism.has_loops or mechanism.lacks_inertia for mechanism in mechanisms):
        return DenseSystem(mechanisms, x)
    if all(mechanism.has_chain_joints for mechanism in mechanisms):
        return StructuredSystem(mechanisms)
    return TreeSystem(mechanisms, x)


def fastest_acceleration(chain: Mechanism) -> Acceleration:
    """Return the right-hand side in the form that takes least time at one state.

    Returns:
        r̈ and p̈ (7 N,) as a function of r, p, ṙ, ṗ: by the structured form of chains, else the direct one.

    """
    system = eliminated_system([chain])
    if not isinstance(system, StructuredSystem):
        return direct_acceleration(chain)

    def acceleration(r: Array, p: Array, v: Array, pdot: Array, _: Array | None = None) -> Array:
        a = system.acceleration(component_first(r, p), component_first(v, pdot))
        return np.concatenate([a[:3].T.ravel(), a[3:].T.ravel()])

    return acceleration
