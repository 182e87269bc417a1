"""The system S x = b of the notes for trees with any joints, in O(bodies): eliminated leaves first.

The rows are those of `joints`.  With π = pᵀp and α of p̈ = Lᵀα/2π − p ṗᵀṗ/π as in `structured`, the rows of
joint k are n_k a_k + f_k a_far = γ_k for a = (r̈, α), and every body obeys

    A_k a_k = b_k − n_kᵀ λ_k,   A = diag(m I, J),   b = (F, n′ − ω×Jω/π − 2 (σ/π) Jω)

With all joints beyond body k eliminated, S_k = n_k A_k⁻¹ n_kᵀ and S_k λ_k = n_k A_k⁻¹ b_k + f_k a_far − γ_k
leave

    A_far += f_kᵀ S_k⁻¹ f_k,   b_far −= f_kᵀ S_k⁻¹ (n_k A_k⁻¹ b_k − γ_k).

Joints of the same depth and number of rows are eliminated together, those of many trees at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_impl.errors import SingularSystem
from reference_impl.euler_parameters import L, angular_velocity, dot
from reference_impl.joints import ConstraintRows, constraint_rows, joint_of_rows
from reference_impl.mechanism import Array, Mechanism
from reference_impl.structured import StructuredSystem, component_first


@dataclass(frozen=True, eq=False)
class _Level:
    """Joints of one depth and one number of rows c."""

    body: NDArray[np.intp]  # (g,) their near bodies
    far: NDArray[np.intp]  # (g,) their far bodies, −1 the world
    row: NDArray[np.intp]  # (g, c)


class TreeSystem:
    """Trees side by side; M bodies in all.  q = (r; p) and v = (ṙ; ṗ), (7, M), as in `StructuredSystem`."""

    def __init__(self, chains: Sequence[Mechanism]) -> None:
        """Join the mechanisms.

        Args:
            chains: the mechanisms.

        """
        if any(chain.has_elements for chain in chains):
            raise ValueError("the O(bodies) form has no passive elements yet")
        self.chains = tuple(chains)
        self.first_body = np.cumsum([0, *(chain.n for chain in chains)])
        self.body_count = int(self.first_body[-1])
        self.forest = _joined(self.chains, self.first_body)
        self.weight = np.concatenate([c.mass[:, None] * c.gravity + c.force for c in chains])
        far = self.forest.body[:, 0]
        depth: NDArray[np.intp] = np.zeros(self.body_count, np.intp)
        for k in np.flatnonzero(far >= 0):
            depth[k] = depth[far[k]] + 1
        joint = joint_of_rows(self.forest)
        count = np.bincount(joint, minlength=self.body_count)
        first = np.cumsum(count) - count
        self.levels = []
        for level, rows in sorted(set(zip(depth.tolist(), count.tolist(), strict=True))):
            at = np.flatnonzero((depth == level) & (count == rows))
            self.levels.append(_Level(at, far[at], first[at, None] + np.arange(rows)))
        self.inertia = np.zeros((self.body_count, 6, 6))
        self.inertia[:, :3, :3] = self.forest.mass[:, None, None] * np.eye(3)
        self.inertia[:, 3:, 3:] = self.forest.inertia

    def repeated(self, count: int) -> TreeSystem:
        """Repeat the trees: all of them, then all again.

        Args:
            count: how many times.

        Returns:
            A system of ``count`` times as many trees.

        """
        return self if count == 1 else TreeSystem(self.chains * count)

    def acceleration(self, q: Array, v: Array, baumgarte: float = 0.0) -> Array:
        """Return the accelerations, on or off the constraints.

        Args:
            q: (r; p) (7, M) [m, –].
            v: (ṙ; ṗ) (7, M) [m/s, 1/s].
            baumgarte: a [1/s]; adds −2 a Ċ − a² C to γ and likewise to γ_E.  0 is the notes' raw form.

        Returns:
            (r̈; p̈) (7, M) [m/s², 1/s²].

        Raises:
            SingularSystem: S is singular.

        """
        (p, rdot, pdot), forest, a = (q[3:].T, v[:3].T, v[3:].T), self.forest, baumgarte
        with np.errstate(all="ignore"):  # what is not finite raises SingularSystem
            rows = self._rows(q, v)
            gamma, norm, sigma, stretch = rows.gamma, dot(p, p), dot(p, pdot), dot(pdot, pdot)
            if a:
                gamma = gamma - 2 * a * rows.constraint_rate(rdot, pdot) - a * a * rows.C
                stretch = stretch + 2 * a * sigma + 0.5 * a * a * (norm - 1)
            omega = angular_velocity(p, pdot)
            momentum = np.matvec(forest.inertia, omega)
            force = self.weight - forest.drag_force[:, None] * rdot
            moment = forest.moment - forest.drag_moment[:, None] * omega
            moment = moment - (np.cross(omega, momentum) + 2 * sigma[:, None] * momentum) / norm[:, None]
            along = p * (stretch / norm)[:, None]  # −p̈ along p
            gamma = gamma + dot(rows.p_near, along[rows.joint]) + dot(rows.p_far, along[rows.far])
            linear, turn = self._eliminate(rows, p, np.concatenate([force, moment], 1), gamma)
        found = component_first(linear, turn - along)
        if not np.isfinite(found.sum()):
            raise SingularSystem("the accelerations are not finite: S is singular, or the state is no number")
        return found

    def project(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Project onto C = 0, pᵀp = 1, Ċ = 0, pᵀṗ = 0 by Newton steps in the metric of M and 4 LᵀJL.

        Args:
            q: (r; p) (7, M) [m, –].
            v: (ṙ; ṗ) (7, M) [m/s, 1/s].

        Returns:
            q and v on the constraints.

        Raises:
            SingularSystem: S is singular.

        """
        q, v = q.copy(), v.copy()
        rest = np.zeros((self.body_count, 6))
        for _ in range(2):  # the second step takes the square of the gap away
            q[3:] /= np.sqrt(dot(q[3:].T, q[3:].T))
            rows = self._rows(q, v)
            q += component_first(*self._eliminate(rows, q[3:].T, rest, -rows.C))
        q[3:] /= np.sqrt(dot(q[3:].T, q[3:].T))
        v[3:] -= q[3:] * dot(q[3:].T, v[3:].T)
        rows = self._rows(q, v)
        rate = rows.constraint_rate(v[:3].T, v[3:].T)
        v += component_first(*self._eliminate(rows, q[3:].T, rest, -rate))
        return q, v

    def _rows(self, q: Array, v: Array) -> ConstraintRows:
        return constraint_rows(self.forest, q[:3].T, q[3:].T, v[:3].T, v[3:].T)

    def _eliminate(self, rows: ConstraintRows, p: Array, wrench: Array, gamma: Array) -> tuple[Array, Array]:
        """Solve for a: r̈ (M, 3) and Lᵀα/2π (M, 4), with b = ``wrench`` (M, 6)."""
        turn = L(p).swapaxes(-1, -2) / (2 * dot(p, p))[:, None, None]
        near = np.concatenate([rows.r_near, np.vecmat(rows.p_near, turn[rows.joint])], 1)
        far = np.concatenate([-rows.r_near, np.vecmat(rows.p_far, turn[rows.far])], 1)
        A, b, kept = self.inertia.copy(), wrench.copy(), []
        try:
            for level in reversed(self.levels):
                n, f = near[level.row], far[level.row]
                solved = np.linalg.solve(A[level.body], np.concatenate([n.mT, b[level.body, :, None]], 2))
                X, y = solved[..., :-1], solved[..., -1]
                right = np.concatenate([f, (np.matvec(n, y) - gamma[level.row])[..., None]], 2)
                Z = np.linalg.solve(n @ X, right)
                kept.append((X, y, Z))
                up = level.far >= 0
                np.add.at(A, level.far[up], (f.mT @ Z[..., :-1])[up])
                np.subtract.at(b, level.far[up], np.vecmat(Z[..., -1], f)[up])
        except np.linalg.LinAlgError:
            raise SingularSystem("S is singular: the rows of a joint are not independent") from None
        a = np.zeros((self.body_count + 1, 6))  # the last one is the world
        for level, (X, y, Z) in zip(self.levels, reversed(kept), strict=True):
            a[level.body] = y - np.matvec(X, np.matvec(Z[..., :-1], a[level.far]) + Z[..., -1])
        return a[:-1, :3], np.matvec(turn, a[:-1, 3:])


EliminatedSystem = StructuredSystem | TreeSystem


def eliminated_system(mechanisms: Sequence[Mechanism]) -> EliminatedSystem:
    """Make the O(bodies) form of the notes' system.

    Args:
        mechanisms: chains of rods and balls, or trees with any joints.

    Returns:
        The form of chains where all are such, else that of trees.

    """
    if all(mechanism.is_chain for mechanism in mechanisms):
        return StructuredSystem(mechanisms)
    return TreeSystem(mechanisms)


def _joined(mechanisms: Sequence[Mechanism], first: NDArray[np.intp]) -> Mechanism:
    """One mechanism of all, without gravity, which may differ between them."""
    fields: dict[str, Any] = {}
    for name in vars(mechanisms[0]):
        parts = [getattr(mechanism, name) for mechanism in mechanisms]
        if name == "kind":
            fields[name] = sum(parts, ())
        elif name in ("body", "spring_body"):
            fields[name] = np.concatenate(
                [np.where(x < 0, x, x + at) for x, at in zip(parts, first, strict=False)]
            )
        else:
            fields[name] = np.zeros(3) if name == "gravity" else np.concatenate(parts)
    return Mechanism(**fields)
