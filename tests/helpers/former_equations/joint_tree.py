"""Vectors, rotations and mass matrices in ball arithmetic, as the former equations of trees had them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from plumbline.equations.balls import entries
from plumbline.model.datatypes import Array


class BallVectors:
    """Vectors and rotations in balls; vectors are 3×1 ``arb_mat``."""

    def __init__(self, flint: Any) -> None:
        self.flint, self.mat, self.arb = flint, flint.arb_mat, flint.arb
        self.zero = self.vector((0.0, 0.0, 0.0))
        self.eye = self.matrix(np.eye(3))
        self.units = [self.vector(e) for e in np.eye(3)]

    def vector(self, v: Iterable[float]) -> Any:
        """A vector of doubles.

        Args:
            v: three doubles.

        Returns:
            A 3×1 matrix.

        """
        return self.mat(3, 1, [self.arb(float(x)) for x in v])

    def matrix(self, m: Array) -> Any:
        """A 3×3 matrix of doubles.

        Args:
            m: (3, 3) doubles.

        Returns:
            A 3×3 matrix.

        """
        return self.mat(3, 3, [self.arb(float(x)) for x in np.ravel(m)])

    def cross_matrix(self, a: Any) -> Any:
        """ã: ã b = a × b.

        Returns:
            A 3×3 matrix.

        """
        x, y, z = a[0, 0], a[1, 0], a[2, 0]
        return self.mat(3, 3, [0, -z, y, z, 0, -x, -y, x, 0])

    @staticmethod
    def dot(a: Any, b: Any) -> Any:
        """aᵀb."""
        return a[0, 0] * b[0, 0] + a[1, 0] * b[1, 0] + a[2, 0] * b[2, 0]

    def rotation(self, p: Array) -> Any:
        """A (N7) of the normalised quaternion: the homogeneous quadratic form over pᵀp.

        Args:
            p: (4,) a quaternion of doubles, scalar first, of any length but 0.

        Returns:
            A 3×3 matrix, body → world.

        """
        return self.rotation_of([self.arb(float(c)) for c in p])

    def rotation_of(self, q: list[Any]) -> Any:
        """A of a quaternion of balls, as `rotation`.

        Args:
            q: four balls, scalar first.

        Returns:
            A 3×3 matrix, body → world.

        """
        w, x, y, z = q
        ww, xx, yy, zz = w * w, x * x, y * y, z * z
        entries_ = [
            [ww + xx - yy - zz, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), ww - xx + yy - zz, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), ww - xx - yy + zz],
        ]
        return self.mat(entries_) * (1 / (ww + xx + yy + zz))


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
