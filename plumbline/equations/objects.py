"""Python objects as numbers of the equations: expressions of heyoka, or numbers of mpmath."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import numpy as np

from plumbline.equations.arithmetic import Arithmetic


def objects(functions: Any, number: Callable[[Any], Any] = lambda x: x) -> Arithmetic:
    """Take objects that can be added and multiplied.

    Expressions that are 0 have to be Python's 0.0, which costs nothing: heyoka does not simplify a − a.

    Args:
        functions: a module with ``sqrt``, ``sin``, ``cos`` and, of numbers, ``atan2`` and ``sinc``.
        number: what makes an object of a double.

    Returns:
        Operations on arrays of objects (rows, columns); scalars are the objects.

    """
    return cast(Arithmetic, _Objects(functions, number))


class _Objects:
    """As `objects`."""

    def __init__(self, functions: Any, number: Callable[[Any], Any]) -> None:
        self.functions, self.number, self.sqrt = functions, number, functions.sqrt

    def scalar(self, x: Any) -> Any:
        return self.number(np.asarray(x, object).item())

    def vector(self, x: Any) -> Any:
        return np.array([[self.number(e)] for e in x], object)

    def matrix(self, x: Any) -> Any:
        return np.array([[self.number(e) for e in row] for row in x], object)

    def entry(self, x: Any, row: int, column: int = 0) -> Any:
        return x[row, column]

    def from_rows(self, rows: Sequence[Sequence[Any]]) -> Any:
        return np.array(rows, object)

    def columns(self, vectors: Sequence[Any]) -> Any:
        return np.concatenate(vectors, 1)

    def widened(self, x: Any, like: Any) -> Any:
        return self.columns([x] + [np.full(x.shape, 0.0, object)] * (like.shape[1] - 1))

    def assemble(self, size: int, blocks: Mapping[tuple[int, int], Any]) -> Any:
        out = np.full((size, size), 0.0, object)
        for (i, j), block in blocks.items():
            out[i : i + block.shape[0], j : j + block.shape[1]] = block
        return out

    def mul(self, a: Any, b: Any) -> Any:
        return a @ b

    def transpose(self, a: Any) -> Any:
        return a.T

    def symmetric(self, a: Any) -> Any:
        return np.where(np.tri(len(a), dtype=bool), a.T, a)

    def dot(self, a: Any, b: Any) -> Any:
        return (a.T @ b).item()

    def cross(self, a: Any, b: Any) -> Any:
        return np.cross(a, b, axis=0)

    def cross_matrix(self, a: Any) -> Any:
        x, y, z = a[:, 0]
        return self.from_rows([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])

    def inverse_parts(self, a: Any) -> tuple[Any, Any]:
        cofactors = self.symmetric(np.cross(np.roll(a, -1, 1), np.roll(a, -2, 1), axis=0))
        return cofactors, self.dot(a[:, :1], cofactors[:, :1])

    def inverse(self, a: Any) -> Any:
        cofactors, determinant = self.inverse_parts(a)
        return cofactors * (1 / determinant)

    def sin_cos(self, x: Any) -> tuple[Any, Any]:
        return self.functions.sin(x), self.functions.cos(x)

    def turn_over_sine(self, sine: Any, cosine: Any) -> Any:
        return 1 / self.functions.sinc(self.functions.atan2(sine, cosine))
