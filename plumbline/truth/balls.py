"""Vectors, rotations and inertias of a mechanism in ball arithmetic (python-flint)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from plumbline.model.datatypes import Array, Model, State


class BallArithmetic:
    """A model in balls; vectors are 3×1 ``arb_mat``; ``J`` is in body axes, gravity ``g`` in world axes."""

    def __init__(self, flint: Any, model: Model) -> None:
        self.flint, self.model, self.n = flint, model, model.n
        self.mat, self.arb = flint.arb_mat, flint.arb
        self.m = [self.arb(float(m)) for m in model.mass]
        self.J = [self.matrix(J) for J in model.inertia]
        self.g = self.vector(model.gravity)
        self.zero = self.vector((0.0, 0.0, 0.0))
        self.eye = self.matrix(np.eye(3))

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

        Args:
            a: a vector.

        Returns:
            A 3×3 matrix.

        """
        x, y, z = a[0, 0], a[1, 0], a[2, 0]
        return self.mat(3, 3, [0, -z, y, z, 0, -x, -y, x, 0])

    @staticmethod
    def dot(a: Any, b: Any) -> Any:
        """aᵀb.

        Args:
            a: a vector.
            b: a vector.

        Returns:
            A ball.

        """
        return a[0, 0] * b[0, 0] + a[1, 0] * b[1, 0] + a[2, 0] * b[2, 0]

    def rotation(self, p: Array) -> Any:
        """A (N7) of the normalised quaternion: the homogeneous quadratic form over pᵀp.

        Args:
            p: (4,) a quaternion of doubles, scalar first, of any length but 0.

        Returns:
            A 3×3 matrix, body → world.

        """
        w, x, y, z = (self.arb(float(c)) for c in p)
        ww, xx, yy, zz = w * w, x * x, y * y, z * z
        entries_ = [
            [ww + xx - yy - zz, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), ww - xx + yy - zz, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), ww - xx - yy + zz],
        ]
        return self.mat(entries_) * (1 / (ww + xx + yy + zz))

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


def entries(v: Any) -> list[Any]:
    """List the balls of a matrix of one column.

    Args:
        v: an ``arb_mat`` (m, 1).

    Returns:
        Its m entries.

    """
    return list(v.entries())


def flatten(ball: list[Any]) -> list[Any]:
    """List all balls of a list or of a list of lists.

    Args:
        ball: balls, or lists of them.

    Returns:
        All balls.

    """
    return [x for row in ball for x in row] if isinstance(ball[0], list) else ball


def midpoints(ball: list[Any]) -> Array:
    """Return midpoints rounded to double.

    Args:
        ball: balls, or lists of them.

    Returns:
        An array of the list's shape.

    """
    return np.array(
        [[float(x.mid()) for x in row] if isinstance(row, list) else float(row.mid()) for row in ball]
    )
