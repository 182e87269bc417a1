"""Balls of python-flint as numbers of the equations: each encloses every rounding of its computation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from plumbline.equations.arithmetic import Arithmetic
from plumbline.model.datatypes import Array


def balls(flint: Any) -> Arithmetic:
    """Take balls at the working precision of ``flint.ctx``.

    Returns:
        Operations on ``arb_mat``; scalars are ``arb``.

    """
    return cast(Arithmetic, _Balls(flint))


class _Balls:
    """As `balls`."""

    def __init__(self, flint: Any) -> None:
        self.mat, self.arb = flint.arb_mat, flint.arb

    def scalar(self, x: Any) -> Any:
        return self.arb(float(x))

    def vector(self, x: Any) -> Any:
        return self.mat(3, 1, [float(e) for e in x])

    def matrix(self, x: Any) -> Any:
        return self.mat(3, 3, [float(e) for e in np.ravel(x)])

    def entry(self, x: Any, row: int, column: int = 0) -> Any:
        return x[row, column]

    def from_rows(self, rows: Sequence[Sequence[Any]]) -> Any:
        return self.mat(len(rows), len(rows[0]), [e for row in rows for e in row])

    def columns(self, vectors: Sequence[Any]) -> Any:
        rows = range(vectors[0].nrows())
        return self.mat(len(rows), len(vectors), [v[row, 0] for row in rows for v in vectors])

    def widened(self, x: Any, like: Any) -> Any:
        if like.ncols() == 1:
            return x
        out = self.mat(x.nrows(), like.ncols())
        for row in range(x.nrows()):
            out[row, 0] = x[row, 0]
        return out

    def assemble(self, size: int, blocks: Mapping[tuple[int, int], Any]) -> Any:
        out = self.mat(size, size)
        for (i, j), block in blocks.items():
            for row in range(block.nrows()):
                for column in range(block.ncols()):
                    out[i + row, j + column] = block[row, column]
        return out

    def mul(self, a: Any, b: Any) -> Any:
        return a * b

    def transpose(self, a: Any) -> Any:
        return a.transpose()

    def symmetric(self, a: Any) -> Any:
        return a

    def dot(self, a: Any, b: Any) -> Any:
        return a[0, 0] * b[0, 0] + a[1, 0] * b[1, 0] + a[2, 0] * b[2, 0]

    def cross(self, a: Any, b: Any) -> Any:
        (x, y, z), (u, v, w) = ((c[0, 0], c[1, 0], c[2, 0]) for c in (a, b))
        return self.mat(3, 1, [y * w - z * v, z * u - x * w, x * v - y * u])

    def cross_matrix(self, a: Any) -> Any:
        x, y, z = a[0, 0], a[1, 0], a[2, 0]
        return self.mat(3, 3, [0, -z, y, z, 0, -x, -y, x, 0])

    def inverse(self, a: Any) -> Any:
        return a.inv()

    def inverse_parts(self, a: Any) -> tuple[Any, Any]:
        return a.inv(), self.arb(1)

    def sqrt(self, x: Any) -> Any:
        return x.nonnegative_part().sqrt()

    def sin_cos(self, x: Any) -> tuple[Any, Any]:
        found: tuple[Any, Any] = x.sin_cos()
        return found

    def turn_over_sine(self, sine: Any, cosine: Any) -> Any:
        return 1 / self.arb.atan2(sine, cosine).sinc()


def entries(v: Any) -> list[Any]:
    """List the balls of a matrix of one column.

    Args:
        v: an ``arb_mat`` (m, 1).

    """
    return list(v.entries())


def flatten(ball: list[Any]) -> list[Any]:
    """List all balls of a list or of a list of lists.

    Args:
        ball: balls, or lists of them.

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
