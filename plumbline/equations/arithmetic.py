"""Kinds of numbers that the equations are evaluated in: what each offers, and NumPy's floating-point types.

Every quantity is a matrix: vectors have one column, scalars are what `Arithmetic.scalar` returns.  Sums,
differences and products with scalars are the operators + − * of the matrices; quotients are of scalars.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, cast

import numpy as np

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])  # of each axis the next and the one after


class Arithmetic(Protocol):
    """Operations on matrices of one kind of numbers."""

    scalar: Callable[[Any], Any]  # of doubles (...,)
    vector: Callable[[Any], Any]  # column of doubles (..., 3)
    matrix: Callable[[Any], Any]  # of doubles (..., 3, 3)
    entry: Callable[..., Any]  # x, row, column = 0: a scalar
    from_rows: Callable[[Sequence[Sequence[Any]]], Any]  # the matrix of scalars
    columns: Callable[[Sequence[Any]], Any]  # the matrix of columns
    widened: Callable[[Any, Any], Any]  # x and columns of 0, as many as a matrix has
    assemble: Callable[[int, Mapping[tuple[int, int], Any]], Any]  # size, blocks by first row and column
    mul: Callable[[Any, Any], Any]  # product of two matrices
    transpose: Callable[[Any], Any]
    symmetric: Callable[[Any], Any]  # of a matrix that is symmetric but for rounding
    dot: Callable[[Any, Any], Any]  # aᵀb, a scalar
    cross: Callable[[Any, Any], Any]  # a × b
    cross_matrix: Callable[[Any], Any]  # ã: ã b = a × b
    inverse: Callable[[Any], Any]  # of a symmetric 3×3 matrix
    inverse_parts: Callable[[Any], tuple[Any, Any]]  # a matrix X and a scalar d with X/d the inverse
    sqrt: Callable[[Any], Any]  # of a scalar that is not negative, but for rounding
    sin_cos: Callable[[Any], tuple[Any, Any]]  # of a scalar
    turn_over_sine: Callable[[Any, Any], Any]  # θ/sin θ by sin θ and cos θ, 0 ≤ θ < π


def floats(dtype: Any = np.float64) -> Arithmetic:
    """Take NumPy's floating-point numbers, in batches.

    Returns:
        Operations on arrays (..., rows, columns); scalars are (..., 1, 1).

    """
    return cast(Arithmetic, _Floats(dtype))


class _Floats:
    """As `floats`."""

    def __init__(self, dtype: Any) -> None:
        self.dtype = dtype

    def scalar(self, x: Any) -> Any:
        return np.asarray(x, self.dtype)[..., None, None]

    def vector(self, x: Any) -> Any:
        return np.asarray(x, self.dtype)[..., None]

    def matrix(self, x: Any) -> Any:
        return np.asarray(x, self.dtype)

    def entry(self, x: Any, row: int, column: int = 0) -> Any:
        return x[..., row : row + 1, column : column + 1]

    def from_rows(self, rows: Sequence[Sequence[Any]]) -> Any:
        lead = np.broadcast_shapes(*(x.shape[:-2] for row in rows for x in row))
        out = np.empty((*lead, len(rows), len(rows[0])), self.dtype)
        for i, row in enumerate(rows):
            for j, x in enumerate(row):
                out[..., i, j] = x[..., 0, 0]
        return out

    def columns(self, vectors: Sequence[Any]) -> Any:
        return np.concatenate(np.broadcast_arrays(*vectors), -1)

    def widened(self, x: Any, like: Any) -> Any:
        return x if like.shape[-1] == 1 else self.columns([x] + [np.zeros_like(x)] * (like.shape[-1] - 1))

    def assemble(self, size: int, blocks: Mapping[tuple[int, int], Any]) -> Any:
        lead = np.broadcast_shapes(*(block.shape[:-2] for block in blocks.values()))
        out = np.zeros((*lead, size, size), self.dtype)
        for (i, j), block in blocks.items():
            out[..., i : i + block.shape[-2], j : j + block.shape[-1]] = block
        return out

    def mul(self, a: Any, b: Any) -> Any:
        return a @ b

    def transpose(self, a: Any) -> Any:
        return a.mT

    def symmetric(self, a: Any) -> Any:
        return (a + a.mT) / 2

    def dot(self, a: Any, b: Any) -> Any:
        return np.sum(a * b, -2, keepdims=True)

    def cross(self, a: Any, b: Any) -> Any:
        return a.take(_NEXT, -2) * b.take(_LAST, -2) - a.take(_LAST, -2) * b.take(_NEXT, -2)

    def cross_matrix(self, a: Any) -> Any:
        out = np.zeros((*a.shape[:-1], 3), self.dtype)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            out[..., k, j], out[..., j, k] = a[..., i, 0], -a[..., i, 0]
        return out

    def inverse(self, a: Any) -> Any:
        cofactors = self.cross(a.take(_NEXT, -1), a.take(_LAST, -1))
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.symmetric(cofactors / self.dot(a[..., :1], cofactors[..., :1]))

    def inverse_parts(self, a: Any) -> tuple[Any, Any]:
        return self.inverse(a), self.scalar(1.0)

    def sqrt(self, x: Any) -> Any:
        return np.sqrt(x)

    def sin_cos(self, x: Any) -> tuple[Any, Any]:
        return np.sin(x), np.cos(x)

    def turn_over_sine(self, sine: Any, cosine: Any) -> Any:
        theta = np.arctan2(sine, cosine)
        return np.where(sine > 0, theta / np.where(sine > 0, sine, 1), 1)
