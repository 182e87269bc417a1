"""Kinds of numbers that the equations are evaluated in: what each offers.

NumPy's floating-point types in batches, Python objects as expressions of heyoka and numbers of mpmath, and
balls of python-flint, which enclose every rounding of their computation.

Every quantity is a matrix: vectors have one column, scalars are what `Arithmetic.scalar` returns.  Sums,
differences and products with scalars are the operators + − * of the matrices; quotients are of scalars.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plumbline.model.datatypes import Array
from plumbline.model.kinematics import cross_matrix

_NEXT = np.array([1, 2, 0])  # of each axis the one that follows it
_LOWER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))  # triangle of a symmetric matrix, by rows


def _inverse_rows(a: Any, b: Any, c: Any, d: Any, e: Any, f: Any) -> list[list[Any]]:
    """Invert a symmetric 3×3 matrix, given by its lower triangle, by L D Lᵀ.

    That loses the digits of the condition number once, and cofactors lose them twice: where a heavy body
    hangs by a rod below light ones, what these need is 1e-8 of the largest entry.
    """
    first = 1 / a  # of D⁻¹
    k, m = b * first, d * first  # L = [[1, 0, 0], [k, 1, 0], [m, n, 1]]
    second, s = 1 / (c - k * b), e - m * b
    n = s * second
    last, j = 1 / (f - m * d - n * s), k * n - m  # L⁻¹ = [[1, 0, 0], [−k, 1, 0], [j, −n, 1]]
    aside, below = j * last, -(n * last)
    beside = -(k * second) - n * aside
    return [
        [first + k * k * second + j * aside, beside, aside],
        [beside, second - n * below, below],
        [aside, below, last],
    ]


class Arithmetic:
    """Operations on matrices of one kind of numbers."""

    scalar: Callable[[Any], Any]  # of doubles (...,)
    vector: Callable[[Any], Any]  # column of doubles (..., 3)
    matrix: Callable[[Any], Any]  # of doubles (..., 3, 3)
    entry: Callable[..., Any]  # x, row, column = 0: a scalar
    from_rows: Callable[[Sequence[Sequence[Any]]], Any]  # the matrix of scalars
    columns: Callable[[Sequence[Any]], Any]  # the matrix of columns
    widened: Callable[[Any, Any], Any]  # x and columns of 0, as many as a matrix has
    assemble: Callable[[int, Mapping[tuple[int, int], Any]], Any]  # size, blocks by first row and column
    symmetric: Callable[[Any], Any]  # of a matrix that is symmetric but for rounding
    dot: Callable[[Any, Any], Any]  # aᵀb, a scalar
    cross: Callable[[Any, Any], Any]  # a × b
    cross_matrix: Callable[[Any], Any]  # ã: ã b = a × b
    inverse: Callable[[Any], Any]  # of a symmetric 3×3 matrix
    solve: Callable[[Any, Any], Any]  # x of a x = b, of floating-point numbers, jets and balls
    sqrt: Callable[[Any], Any]  # of a scalar that is not negative, but for rounding
    sin_cos: Callable[[Any], tuple[Any, Any]]  # of a scalar
    turn_over_sine: Callable[[Any, Any], Any]  # θ/sin θ by sin θ and cos θ, 0 ≤ θ < π

    def mul(self, a: Any, b: Any) -> Any:
        """Return the product of two matrices."""
        return a @ b

    def transpose(self, a: Any) -> Any:
        """Return the transpose of a matrix."""
        return a.mT


class _Floats(Arithmetic):
    """NumPy's floating-point numbers, in batches: arrays (..., rows, columns); scalars are (..., 1, 1)."""

    def __init__(self, dtype: Any = np.float64) -> None:
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
        out = np.empty((*np.broadcast_shapes(*(x.shape[:-1] for x in vectors)), len(vectors)), self.dtype)
        for j, x in enumerate(vectors):
            out[..., j] = x[..., 0]
        return out

    def widened(self, x: Any, like: Any) -> Any:
        if like.shape[-1] == 1:
            return x
        out = np.zeros((*x.shape[:-1], like.shape[-1]), self.dtype)
        out[..., 0] = x[..., 0]
        return out

    def assemble(self, size: int, blocks: Mapping[tuple[int, int], Any]) -> Any:
        lead = np.broadcast_shapes(*(block.shape[:-2] for block in blocks.values()))
        out = np.zeros((*lead, size, size), self.dtype)
        for (i, j), block in blocks.items():
            out[..., i : i + block.shape[-2], j : j + block.shape[-1]] = block
        return out

    def symmetric(self, a: Any) -> Any:
        return (a + a.mT) / 2

    def dot(self, a: Any, b: Any) -> Any:
        return np.sum(a * b, -2, keepdims=True)

    def cross(self, a: Any, b: Any) -> Any:
        return (a * b.take(_NEXT, -2) - a.take(_NEXT, -2) * b).take(_NEXT, -2)

    def cross_matrix(self, a: Any) -> Any:
        return cross_matrix(a[..., 0])

    def inverse(self, a: Any) -> Any:
        out = np.empty_like(a)
        with np.errstate(divide="ignore", invalid="ignore"):
            rows = _inverse_rows(*(a[..., i, j] for i, j in _LOWER))
        for i, row in enumerate(rows):
            for j, x in enumerate(row):
                out[..., i, j] = x
        return out

    def solve(self, a: Any, b: Any) -> Any:
        is_singular = np.linalg.slogdet(a).sign == 0  # of which the others of a batch must not fail
        return np.linalg.solve(np.where(is_singular[..., None, None], np.nan, a), b)

    def sqrt(self, x: Any) -> Any:
        return np.sqrt(x)

    def sin_cos(self, x: Any) -> tuple[Any, Any]:
        return np.sin(x), np.cos(x)

    def turn_over_sine(self, sine: Any, cosine: Any) -> Any:
        theta = np.arctan2(sine, cosine)
        return np.where(sine > 0, theta / np.where(sine > 0, sine, 1), 1)


floats = _Floats


class _Objects(Arithmetic):
    """Objects that can be added and multiplied, in arrays (rows, columns); scalars are the objects.

    Expressions that are 0 have to be Python's 0.0, which costs nothing: heyoka does not simplify a − a.
    """

    def __init__(self, functions: Any, number: Callable[[Any], Any] = lambda x: x) -> None:
        """Take a module with ``sqrt``, ``sin``, ``cos`` and, of numbers, ``atan2`` and ``sinc``.

        Args:
            number: what makes an object of a double.

        """
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

    def symmetric(self, a: Any) -> Any:
        return np.where(np.tri(len(a)), a.T, a)

    def dot(self, a: Any, b: Any) -> Any:
        return (a.T @ b).item()

    def cross(self, a: Any, b: Any) -> Any:
        return np.cross(a, b, axis=0)

    def cross_matrix(self, a: Any) -> Any:
        x, y, z = a[:, 0]
        return self.from_rows([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])

    def inverse(self, a: Any) -> Any:
        return self.from_rows(_inverse_rows(*(a[i, j] for i, j in _LOWER)))

    def sin_cos(self, x: Any) -> tuple[Any, Any]:
        return self.functions.sin(x), self.functions.cos(x)

    def turn_over_sine(self, sine: Any, cosine: Any) -> Any:
        return 1 / self.functions.sinc(self.functions.atan2(sine, cosine))


objects = _Objects


class _Balls(Arithmetic):
    """Balls of python-flint at the working precision of ``flint.ctx``: ``arb_mat``; scalars are ``arb``."""

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

    def solve(self, a: Any, b: Any) -> Any:
        return a.solve(b)

    def sqrt(self, x: Any) -> Any:
        return x.nonnegative_part().sqrt()

    def sin_cos(self, x: Any) -> tuple[Any, Any]:
        found: tuple[Any, Any] = x.sin_cos()
        return found

    def turn_over_sine(self, sine: Any, cosine: Any) -> Any:
        return 1 / self.arb.atan2(sine, cosine).sinc()


balls = _Balls


def stacked(vectors: Sequence[Any], lead: tuple[int, ...]) -> NDArray[Any]:
    """Return an array (*lead, N, 3) of a list of vectors of floating-point numbers, in batches."""
    return np.stack([np.broadcast_to(x[..., 0], (*lead, 3)) for x in vectors], -2)


def quantity_arrays(quantities: Mapping[str, Any], lead: tuple[int, ...]) -> dict[str, Array]:
    """Return lists of vectors as arrays (*lead, N, 3), vectors (*lead, 3), and scalars (*lead)."""
    found = dict[str, Array]()
    for name, value in quantities.items():
        if isinstance(value, list):
            found[name] = stacked(value, lead)
        else:
            array = np.broadcast_to(value[..., 0], (*lead, value.shape[-2]))
            found[name] = array if array.shape[-1] > 1 else array[..., 0]
    return found


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
