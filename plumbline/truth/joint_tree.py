"""Mass matrix and sums over subtrees of a tree of bodies on joints, in ball arithmetic.

Each joint has the motions that it allows as columns S_k (6, m_k) of twists about the world's origin: angular
velocity, and velocity of the point at the origin, in world axes (Featherstone, Rigid Body Dynamics
Algorithms, 2008, table 6.2: composite rigid bodies).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from plumbline.truth.ball_geometry import BallVectors, entries


class JointTree(BallVectors):
    """Bodies of a tree, as lists: far bodies, motions S, attitudes A, centres r, masses m, inertias J."""

    n: int
    far: list[int]  # −1: the world
    S: list[Any]
    A: list[Any]
    r: list[Any]
    m: list[Any]
    J: list[Any]  # about the centre of mass, body axes

    def spatial_inertia(self, k: int) -> Any:
        """Return the inertia of a body about the world's origin: twist → momentum, angular part first.

        Returns:
            A 6×6 matrix.

        """
        c = self.cross_matrix(self.r[k]) * self.m[k]
        top = self.A[k] * self.J[k] * self.A[k].transpose() - c * self.cross_matrix(self.r[k])
        rows = [[*[top[i, j] for j in range(3)], *[c[i, j] for j in range(3)]] for i in range(3)] + [
            [*[-c[i, j] for j in range(3)], *[self.m[k] * int(i == j) for j in range(3)]] for i in range(3)
        ]
        return self.mat(rows)

    def twist_columns(self, P: Any, columns: list[tuple[Any, Any]]) -> Any:
        """Write motions as twists about the world's origin.

        Args:
            P: a point of the bodies beyond the joint.
            columns: of each motion the angular velocity and the velocity of that point.

        Returns:
            A matrix with a column of six per motion.

        """
        origin = self.cross_matrix(P)
        twists = [[*entries(axis), *entries(along + origin * axis)] for axis, along in columns]
        return self.mat(6, len(twists), [x for row in zip(*twists, strict=True) for x in row])

    def subtree_sums(self, wrenches: list[Any]) -> list[Any]:
        """Sum over each body and all bodies beyond it.

        Returns:
            One sum per body.

        """
        total = list(wrenches)
        for k in reversed(range(self.n)):
            if self.far[k] >= 0:
                total[self.far[k]] = total[self.far[k]] + total[k]
        return total

    def joint_mass_matrix(self) -> tuple[Any, list[int]]:
        """Compute the mass matrix of the joints' rates.

        Returns:
            M, and where each joint's rates begin.

        """
        first = [int(i) for i in np.cumsum([0, *(S.ncols() for S in self.S)])]
        composite = self.subtree_sums([self.spatial_inertia(k) for k in range(self.n)])
        rows = [[self.arb(0)] * first[-1] for _ in range(first[-1])]
        for k in range(self.n):
            if not self.S[k].ncols():
                continue
            momentum, j = composite[k] * self.S[k], k
            while j >= 0:
                block = self.S[j].transpose() * momentum
                for row in range(self.S[j].ncols()):
                    for column in range(self.S[k].ncols()):
                        rows[first[j] + row][first[k] + column] = block[row, column]
                        rows[first[k] + column][first[j] + row] = block[row, column]
                j = self.far[j]
        return self.mat(rows) if rows else self.mat(0, 0), first
