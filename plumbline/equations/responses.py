"""What a mechanism does at many states, and its responses to wrenches and to accelerations of its joints.

A motion is x = x₀ + A ν̇, x = (r̈, α) per body in world axes: x₀ is what the velocities cause alone, and a
column of A moves a joint in one of its free directions, with all bodies beyond it.  C x are the relative
accelerations of the joints, at their near points.  With rotors a and efforts τ along the free directions,

    (AᵀM A + a) ν̇ = Aᵀ(f − M x₀) + τ,    CᵀF = M x − f − Gᵀλ,

F the wrenches of the joints about their near points.  Rows G x = γ join parts of a body where loops are cut.
The motions then are those that keep them.  Where rows depend on others, wrenches are determined only up to
those that balance each other, and the smallest are taken.  No inverse of a mass or an inertia is needed: both
may be 0 where the motions that are left have inertia.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from scipy.linalg import lu

from plumbline.equations.arithmetic import floats, stacked
from plumbline.equations.tree import Tree
from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import cross, cross_matrix, rotate_vectors, rotation_matrix, stack_states

DEPENDENT = 3e-7  # singular values of scaled rows, relative: below it a row depends on the others
EndRows = Literal["accelerations", "twists", "without velocity terms", "without those of rods as bodies"]


class Responses:
    """A tree, with rows that join bodies where loops are cut, at S states.

    Attributes:
        solution: (S, N, 4, 3) r̈ [m/s²], α [rad/s²], force [N] and moment [N m] of the joints; world axes.
        omega: (S, N, 3) rad/s, world axes.
        load, torque: (S, N, 3) of loads, drag and springs between points, about the centres of mass.
        arm: (S, N, 3) m, from the centre of mass to the near point.
        far_arm: from the far body's centre of mass to the point that the joint carries: the near point, or of
            a rod the far one; 0 at the world.
        held: per joint the directions (S, 6, c) that it holds, orthonormal; first the linear ones.
        indeterminate: (S, 6 N, 6 L) wrenches of the joints that balance each other.

    """

    def __init__(
        self,
        model: Model,
        states: Sequence[State] | State,
        ends: Sequence[tuple[int, int]] = (),
        row_scale: Array | None = None,
        end_rows: EndRows = "accelerations",
    ) -> None:
        """Solve for the motions.

        Args:
            model: a tree, or a mechanism cut open; its numbers may be others at each state.
            states: S states of it, or one of arrays (S, ...).
            ends: L pairs of bodies that are joined besides, parts of one body.
            row_scale: (6 L,) factors that make their rows comparable.
            end_rows: what these rows make equal: accelerations of the bodies, or rates of their twists, which
                is another law where the ends are apart; or accelerations, without what velocities cause in
                these coordinates, or in those of rods that are bodies on ball joints.

        """
        state = stack_states(states)
        self.tree = tree = Tree(floats(), model, state)
        self.state, self.n, self.far, self._count = state, model.n, tree.far, len(state.p)
        self._mass = model.mass[..., None, None]
        A = rotation_matrix(state.p)
        self._inertia = A @ model.inertia @ A.mT
        self.omega, self.arm = self._vectors(tree.w), self._vectors(tree.near)
        self.load, self.torque = (self._vectors(some) for some in zip(*tree.loads(), strict=True))
        carried = self.arm[:, self.far] + self._vectors(tree.arm)
        self.far_arm = np.where((np.array(self.far) >= 0)[:, None], carried, 0.0)
        self._near, self._far = cross_matrix(self.arm), cross_matrix(self.far_arm)
        self._find_directions(model, tree)
        self._find_motions()
        self.ends, self._end_rows = ends, end_rows
        self._join(np.ones(6 * len(ends)) if row_scale is None else row_scale)

        forces = self.load + model.mass[..., None] * model.gravity[..., None, :]
        moments = self.torque - cross(self.omega, rotate_vectors(self._inertia, self.omega))
        self._pushed = pushed = np.concatenate([forces, moments], -1)[..., None]
        self._coasting = np.concatenate([self._vectors(some) for some in tree.coasting()], -1)[..., None]
        gaps = self._velocity_terms_of_ends() - self._rows_of_ends(self._coasting)
        if end_rows == "without velocity terms":
            gaps = np.zeros_like(gaps)
        if end_rows == "without those of rods as bodies":
            gaps = self._rows_of_ends(self._coasting_of_rods())
        found = self._respond(self._coasting, pushed, gaps, self._effort[..., None])
        self.solution: Array = found[..., 0]

    def to_wrenches(self) -> Array:
        """Respond to unit forces and moments at the bodies: (S, N, 4, 3, N, 2, 3) as the solution."""
        units = np.broadcast_to(np.eye(6 * self.n), (self._count, 6 * self.n, 6 * self.n))
        found = self._respond(pushed=units.reshape(self._count, self.n, 6, -1))
        return found.reshape(*found.shape[:-1], self.n, 2, 3)

    def to_joints(self) -> Array:
        """Respond to unit relative accelerations along the held directions of all joints: (S, N, 4, 3, c)."""
        relative = self._blocks(self.held)
        if self.ends:  # the part of them that leaves the loops closed
            flat = relative.reshape(self._count, 6 * self.n, -1)
            flat = flat - self._weights * (self._projector.mT @ (self.indeterminate.mT @ flat))
            relative = flat.reshape(relative.shape)
        x = self._beyond(relative)
        return self._respond(x, gaps=-self._rows_of_ends(x))

    def to_gaps(self) -> Array:
        """Respond to unit accelerations of the ends against each other: (S, N, 4, 3, 6 L)."""
        units = np.eye(6 * len(self.ends))
        return self._respond(gaps=np.broadcast_to(units, (self._count, *units.shape)))

    def to_factors(self) -> tuple[Array, Array]:
        """Respond to errors of the equations H ν̇ − Gᵀλ = b and G ν̇ = γ, of each in a unit of its own.

        Returns:
            (S, N, 4, 3, ν + 6 L) as the solution; ν̇ and λ (S, ν + 6 L) in these units, the roots of the
            diagonals of H and of G H⁻¹ Gᵀ.

        """
        S, rows = self._count, self._rows_of_ends(self._A.reshape(self._count, self.n, 6, -1))
        free = rows @ np.linalg.pinv(self._H)
        unit = np.sqrt(np.maximum(np.einsum("sij,sij->si", free, rows), 0.0))
        units = np.broadcast_to(np.eye(rows.shape[-1]), self._H.shape)
        moved = self.solution[:, :, :2].reshape(S, -1, 1) - self._coasting.reshape(S, -1, 1)
        rate = np.linalg.pinv(self._A) @ moved
        multipliers = (self._J_inverse.mT @ (self._H @ rate - self._along_motions()))[..., 0] * unit
        found = self._respond(effort=units), self.to_gaps() * unit[:, None, None, None]
        return np.concatenate(found, -1), np.concatenate([rate[..., 0], multipliers], -1)

    def errors_of_inverse(self) -> Array:
        """Return what r̈ and α (S, N, 2) are off by, over ε, where ν̇ is a product of H⁻¹ and b, of a tree.

        By factors L U of H in SI units, with pivots of rows, each column x of H⁻¹ is off by U⁻¹ δ from its
        own back substitution, |δ| <= m ε |U| |x| of m rates (Higham, Accuracy and Stability of Numerical
        Algorithms, 2002, theorem 8.5).  In H⁻¹ b the columns cancel each other, and these errors do not;
        those of the factors cancel, as they are the same for all.
        """
        # runs that become infinite have no bound, and are no error here
        _, _, U = lu(self._H / (self._unit[:, :, None] * self._unit[:, None]), check_finite=False)
        U = U * self._unit[:, None]
        lost = U.shape[-1] * (np.abs(U) @ (np.abs(self._inverse) @ np.abs(self._along_motions())))
        moved = (self._A @ np.linalg.inv(U)).reshape(self._count, self.n, 2, 3, -1)
        return np.asarray((np.linalg.norm(moved, axis=3) @ lost[:, None])[..., 0])

    def indeterminate_wrenches(self, k: int) -> list[tuple[Array, Array]]:
        """Return forces and moments (S, 3) of a joint that span what is indeterminate of its wrench."""
        own = self.indeterminate[:, 6 * k : 6 * k + 6]
        directions, sizes, _ = np.linalg.svd(own, full_matrices=False)
        count = int(np.max(np.sum(sizes > DEPENDENT * np.max(sizes, initial=0.0), axis=1), initial=0))
        return [(directions[:, :3, i], directions[:, 3:, i]) for i in range(count)]

    def velocity_terms(self) -> Array:
        """Return the relative accelerations (S, N, 6) of the joints by velocities alone."""
        x = self._coasting[..., 0]
        far = np.where((np.array(self.far) >= 0)[:, None], x[:, self.far], 0.0)
        found = x - far
        found[..., :3] += cross(x[..., 3:], self.arm) - cross(far[..., 3:], self.far_arm)
        return found

    def _coasting_of_rods(self) -> Array:
        """What velocities cause besides (S, N, 6, 1) where rods are bodies that turn as those on balls."""
        relative = np.zeros_like(self._coasting)
        for k, blocks in enumerate(self.tree.blocks):
            if not self.tree.model.kinds[k].holds_distance:
                continue
            far, own = self.far[k], self.omega[:, k]
            above = self.omega[:, far] if far >= 0 else 0 * own
            along = np.broadcast_to(blocks[0].u, (self._count, 3, 1))[..., 0]
            swing = cross(along, self.state.udot[:, k])
            turning = (self._coasting + self._beyond(relative))[:, far, 3:, 0] if far >= 0 else 0 * own
            turning = turning + cross(above, swing)
            relative[:, k, :3, 0] = self.tree.model.length[..., k, None] * cross(turning, along)
            relative[:, k, 3:, 0] = cross(above, swing) + cross(swing, own) - cross(above, own)
        return self._beyond(relative)

    def _vectors(self, vectors: Sequence[Any]) -> Array:
        """(S, N, 3) of a list of vectors."""
        return stacked(vectors, (self._count,))

    def _find_directions(self, model: Model, tree: Tree) -> None:
        """Free and held directions of every joint, with rotors and efforts along the free ones."""
        S = self._count
        none, every = np.zeros((S, 3, 0)), np.broadcast_to(np.eye(3), (S, 3, 3))
        self.held, self._free = list[Array](), list[Array]()
        armature, efforts = list[Array](), list[Array]()
        for k, blocks in enumerate(tree.blocks):
            kind = model.kinds[k]
            if kind.has_attitude:
                slides = every if kind.holds_nothing else none
                slides = _across(blocks[0].u) if kind.holds_distance else slides
                turns = every
                elements = [(slides.shape[-1], None, None), (3, blocks[-1].effort, blocks[-1].armature)]
            else:
                ordered = sorted(blocks, key=lambda block: block.about is not None)
                axes = [np.broadcast_to(block.axis, (S, 3, 1)) for block in ordered]
                count = sum(block.about is None for block in ordered)
                slides, turns = (np.concatenate([none, *some], -1) for some in (axes[:count], axes[count:]))
                elements = [(1, block.effort, block.armature) for block in ordered]
            self._free.append(_both(slides, turns))
            self.held.append(_both(_across(slides), _across(turns)))
            if kind.has_pitch:
                self._add_pitch(turns, model.length[..., k, None, None])
            for size, effort, rotor in elements:
                efforts.append(np.broadcast_to(0.0 if effort is None else effort[..., 0], (S, size)))
                armature.append(np.broadcast_to(0.0 if rotor is None else rotor[..., 0], (S, size)))
        self._armature, self._effort = np.concatenate(armature, -1), np.concatenate(efforts, -1)

    def _add_pitch(self, axis: Array, pitch: Array) -> None:
        """Let the last joint's turn about an axis (S, 3, 1) advance along it."""
        free, held = self._free[-1].copy(), self.held[-1].copy()
        free[:, :3] = pitch * axis
        size = np.sqrt(1 + pitch**2)
        # the axis is held but for what the pitch gives it, and the moment about it that goes with the force
        across, both = _across(axis), np.concatenate([axis, -pitch * axis], 1) / size
        held[:, :3, :2] = across
        held[:, :, 2:3] = both
        self._free[-1], self.held[-1] = free, held

    def _along_motions(self) -> Array:
        """Forces, velocity terms and efforts along the motions (S, ν, 1): b of H ν̇ = b."""
        pushed = (self._pushed - self._weigh(self._coasting)).reshape(self._count, -1, 1)
        return np.asarray(self._A.mT @ pushed + self._effort[..., None])

    def _find_motions(self) -> None:
        """A and H = AᵀM A + a, with rates in units in which H has a unit diagonal."""
        x = self._beyond(self._blocks(self._free))
        A = x.reshape(self._count, 6 * self.n, -1)
        H = A.mT @ self._weigh(x).reshape(A.shape) + self._armature[:, None] * np.eye(A.shape[-1])
        size = np.einsum("sii->si", H)
        # a motion without inertia has no unit of its own, and is held by rows of loops
        unit = 1 / np.sqrt(np.where(size > 0, size, np.max(size, axis=1, keepdims=True, initial=0.0)))
        self._A, self._H, self._effort = (
            A * unit[:, None],
            H * unit[:, :, None] * unit[:, None],
            self._effort * unit,
        )
        self._unit = unit  # of SI

    def _join(self, scale: Array) -> None:
        """The inverse of H on the motions that keep the rows of the ends; the indeterminate wrenches."""
        S, dof = self._count, self._H.shape[-1]
        self.indeterminate = np.zeros((S, 6 * self.n, 6 * len(self.ends)))
        if not self.ends:
            self._inverse = np.linalg.inv(self._H)
            return
        J = self._rows_of_ends(self._A.reshape(S, self.n, 6, -1)) * scale[:, None]
        back = np.linalg.pinv(J, DEPENDENT)
        kept, dependent = np.eye(dof) - back @ J, np.eye(len(scale)) - J @ back
        self._J_inverse = back * scale
        self._inverse = kept @ np.linalg.inv(kept @ self._H @ kept + np.eye(dof) - kept) @ kept
        self._weights = self._yielding()
        dependent = dependent * (np.trace(dependent, axis1=1, axis2=2) > 0.5)[:, None, None]
        wrenches = self._wrenches(self._of_multipliers(dependent * scale[:, None]))
        self.indeterminate = wrenches.reshape(self.indeterminate.shape)
        self._projector = np.linalg.pinv(self.indeterminate * self._weights, DEPENDENT)

    def _yielding(self) -> Array:
        """(S, 6 N, 1) roots of the relative accelerations by unit wrenches at each joint alone."""
        inverse, found = np.linalg.pinv(self._inertia), np.zeros((self._count, self.n, 6))
        for k, far in enumerate(self.far):
            for body, arm in ((k, self._near[:, k]), (far, self._far[:, k])):
                if body >= 0:
                    turning = arm @ inverse[:, body] @ arm.mT
                    found[:, k, :3] += 1 / self._mass[..., body, :, 0] + np.einsum("sii->si", turning)
                    found[:, k, 3:] += np.einsum("sii->si", inverse[:, body])
        return np.sqrt(found).reshape(self._count, -1, 1)

    def _blocks(self, directions: Sequence[Array]) -> Array:
        """(S, N, 6, m): along columns, each joint's own directions."""
        first = np.cumsum([0, *(some.shape[-1] for some in directions)])
        found = np.zeros((self._count, self.n, 6, first[-1]))
        for k, own in enumerate(directions):
            found[:, k, :, first[k] : first[k + 1]] = own
        return found

    def _beyond(self, relative: Array) -> Array:
        """Accelerations (S, N, 6, m) of the bodies by relative accelerations of the joints."""
        x = relative.copy()
        for k, far in enumerate(self.far):
            if far >= 0:
                turning = x[:, far, 3:]
                x[:, k, :3] += x[:, far, :3] - self._far[:, k] @ turning
                x[:, k, 3:] += turning
            x[:, k, :3] += self._near[:, k] @ x[:, k, 3:]
        return x

    def _wrenches(self, forces: Array) -> Array:
        """Wrenches (S, N, 6, m) of the joints that give the bodies these forces and moments."""
        found = forces.copy()
        for k in reversed(range(self.n)):
            force = found[:, k, :3]
            found[:, k, 3:] -= self._near[:, k] @ force
            if (far := self.far[k]) >= 0:
                found[:, far, :3] += force
                found[:, far, 3:] += found[:, k, 3:] + self._far[:, k] @ force
        return found

    def _weigh(self, x: Array) -> Array:
        """M x."""
        return np.concatenate([self._mass * x[:, :, :3], self._inertia @ x[:, :, 3:]], axis=2)

    def _rows_of_ends(self, x: Array) -> Array:
        """G x (S, 6 L, m), loop by loop."""
        found = [x[:, b] - x[:, c] for b, c in self.ends]
        if self._end_rows == "twists":
            for rows, (b, c) in zip(found, self.ends, strict=True):
                rows[:, :3] += self._apart(b, c) @ x[:, c, 3:]
        return np.concatenate([x[:, 0, :0], *found], axis=1)

    def _of_multipliers(self, multipliers: Array) -> Array:
        """Gᵀλ (S, N, 6, m)."""
        found = np.zeros((self._count, self.n, 6, multipliers.shape[-1]))
        for loop, (b, c) in enumerate(self.ends):
            own = multipliers[:, 6 * loop : 6 * loop + 6]
            found[:, b] += own
            found[:, c] -= own
            if self._end_rows == "twists":
                found[:, c, 3:] -= self._apart(b, c) @ own[:, :3]
        return found

    def _apart(self, b: int, c: int) -> Array:
        return cross_matrix(self.state.r[:, b] - self.state.r[:, c])

    def _velocity_terms_of_ends(self) -> Array:
        """γ (S, 6 L, 1): 0, or of V̇_b − V̇_c + (V_b − V_c) × V_c = 0 at r_b what velocities cause."""
        found = [np.zeros((self._count, 0))]
        for b, c in self.ends:
            if self._end_rows != "twists":
                found.append(np.zeros((self._count, 6)))
                continue
            (w, spin), apart = (self.omega[:, b], self.omega[:, c]), self.state.v[:, b] - self.state.v[:, c]
            d = self.state.r[:, b] - self.state.r[:, c]
            found += [cross(w, apart - cross(spin, d)) + cross(spin, apart), cross(spin, w)]
        return np.concatenate(found, -1)[..., None]

    def _respond(
        self,
        x: Array | None = None,
        pushed: Array | None = None,
        gaps: Array | None = None,
        effort: Array | None = None,
    ) -> Array:
        """Accelerations and wrenches (S, N, 4, 3, m).

        Args:
            x: (S, N, 6, m) accelerations besides A ν̇.
            pushed: (S, N, 6, m) forces and moments at the bodies.
            gaps: (S, 6 L, m) what A ν̇ makes G x.
            effort: (S, ν, m) along the free directions; then the result is refined.

        """
        terms = [some for some in (pushed, None if x is None else -self._weigh(x)) if some is not None]
        b = 0.0 if effort is None else effort
        if terms:
            b = b + self._A.mT @ sum(terms[1:], terms[0]).reshape(self._count, 6 * self.n, -1)
        if self.ends:
            rate = 0.0 if gaps is None else self._J_inverse @ gaps
            rate = rate + self._inverse @ (b if gaps is None else b - self._H @ rate)
        else:
            rate = self._inverse @ b
        if effort is not None:  # the product with an inverse is off by more than rounding
            rate = rate + self._inverse @ (b - self._H @ rate)
        moved = (self._A @ rate).reshape(self._count, self.n, 6, -1)
        x = moved if x is None else moved + x
        forces = self._weigh(x)
        if pushed is not None:
            forces -= pushed
        if self.ends:
            multipliers = self._J_inverse.mT @ (self._H @ rate - b)
            forces -= self._of_multipliers(multipliers)
        wrenches = self._wrenches(forces)
        if self.ends:
            flat = wrenches.reshape(self._count, 6 * self.n, -1)
            flat = flat - self.indeterminate @ (self._projector @ (self._weights * flat))
            wrenches = flat.reshape(wrenches.shape)
        return np.concatenate([x, wrenches], axis=2).reshape(self._count, self.n, 4, 3, -1)


def _across(directions: Array) -> Array:
    """Orthonormal directions (S, 3, 3 − f) across those of (S, 3, f)."""
    f = directions.shape[-1]
    if f in (0, 3):
        return np.broadcast_to(np.eye(3)[:, f:], (len(directions), 3, 3 - f))
    return np.asarray(np.linalg.svd(directions.mT)[2][:, f:].mT)


def _both(linear: Array, angular: Array) -> Array:
    """(S, 6, m) linear directions, then angular ones."""
    found = np.zeros((len(linear), 6, linear.shape[-1] + angular.shape[-1]))
    found[:, :3, : linear.shape[-1]], found[:, 3:, linear.shape[-1] :] = linear, angular
    return found
