"""Jets as numbers of the equations: values in doubles with their first derivatives in many directions.

The fields of a model or a state become jets by a leading axis of the length 1 + D: the values, then the
derivatives in D directions (`with_slopes`).  A field without that axis is constant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from plumbline.equations.arithmetic import Arithmetic, floats
from plumbline.model.datatypes import Model, State


class Jet:
    """Matrices (..., rows, columns) and their derivatives (D, ..., rows, columns); None where all are 0."""

    __slots__ = ("slope", "value")
    __array_ufunc__ = None  # arrays leave the operators to this class

    def __init__(self, value: Any, slope: Any = None) -> None:
        self.value, self.slope = value, slope

    def __add__(self, other: Any) -> Jet:
        if not isinstance(other, Jet):
            return Jet(self.value + other, self.slope)
        return Jet(self.value + other.value, _sum(self.slope, other.slope))

    def __neg__(self) -> Jet:
        return Jet(-self.value, None if self.slope is None else -self.slope)

    def __sub__(self, other: Any) -> Jet:
        return Jet.__add__(self, -other)

    def __mul__(self, other: Any) -> Jet:
        if not isinstance(other, Jet):
            return Jet(self.value * other, None if self.slope is None else self.slope * other)
        return bilinear(np.multiply, self, other)

    def __truediv__(self, other: Any) -> Jet:
        return Jet.__mul__(self, 1 / other)

    def __rtruediv__(self, other: Any) -> Jet:
        value = other / self.value
        return Jet(value, None if self.slope is None else self.slope * (-value / self.value))


def with_slopes(model: Model, states: State, derivatives: Sequence[Mapping[str, Any]]) -> tuple[Model, State]:
    """Give the fields of a model and of its states their derivatives.

    Args:
        states: S states, (S, ...) arrays.
        derivatives: of D directions those by field of either, of shapes that broadcast to the field's.

    Returns:
        Model and states for `Tree`; the values of jets are then (S, rows, columns).

    """

    def fields(owner: Any) -> dict[str, Any]:
        found = {}
        for name in vars(owner).keys() & {name for one in derivatives for name in one}:
            value = getattr(owner, name)
            slopes = np.zeros((1 + len(derivatives), *value.shape))
            slopes[0] = value
            for slope, one in zip(slopes[1:], derivatives, strict=True):
                slope[...] = one.get(name, 0.0)
            found[name] = slopes if owner is states else slopes[:, None]
        return found

    every = {name: value[None] for name, value in vars(states).items()}
    return replace(model, **fields(model)), State(**(every | fields(states)))


def bilinear(product: Callable[[Any, Any], Any], a: Jet, b: Jet) -> Jet:
    """Apply a product of two factors."""
    left = None if a.slope is None else product(a.slope, b.value)
    right = None if b.slope is None else product(a.value, b.slope)
    return Jet(product(a.value, b.value), _sum(left, right))


def _sum(a: Any, b: Any) -> Any:
    return b if a is None else a if b is None else a + b


class _Jets(Arithmetic):
    """Values in doubles with first derivatives."""

    def __init__(self) -> None:
        self.num = floats()
        for name in ("cross_matrix", "transpose", "symmetric"):
            setattr(self, name, self._linear(getattr(self.num, name)))
        for name in ("mul", "dot", "cross"):
            setattr(self, name, partial(bilinear, getattr(self.num, name)))

    @staticmethod
    def _linear(function: Callable[[Any], Any]) -> Callable[[Jet], Jet]:
        return lambda x: Jet(function(x.value), None if x.slope is None else function(x.slope))

    def _lift(self, x: Any, axes: int, shaped: Callable[[Any], Any]) -> Jet:
        x = np.asarray(x, float)
        if x.ndim == axes:
            return Jet(shaped(x))
        return Jet(shaped(x[0]), shaped(x[1:]) if np.any(x[1:]) else None)

    def scalar(self, x: Any) -> Jet:
        return self._lift(x, 0, self.num.scalar)

    def vector(self, x: Any) -> Jet:
        return self._lift(x, 1, self.num.vector)

    def matrix(self, x: Any) -> Jet:
        return self._lift(x, 2, self.num.matrix)

    def entry(self, x: Jet, row: int, column: int = 0) -> Jet:
        return self._linear(lambda y: self.num.entry(y, row, column))(x)

    def _joined(self, parts: Sequence[Jet], join: Callable[[Sequence[Any]], Any]) -> Jet:
        """Apply a linear function of several jets."""
        value = join([one.value for one in parts])
        if all(one.slope is None for one in parts):
            return Jet(value)
        return Jet(
            value, join([np.zeros_like(one.value) if one.slope is None else one.slope for one in parts])
        )

    def from_rows(self, rows: Sequence[Sequence[Jet]]) -> Jet:
        width = len(rows[0])

        def join(entries: Sequence[Any]) -> Any:
            return self.num.from_rows([entries[i : i + width] for i in range(0, len(entries), width)])

        return self._joined([x for row in rows for x in row], join)

    def columns(self, vectors: Sequence[Jet]) -> Jet:
        return self._joined(vectors, self.num.columns)

    def widened(self, x: Jet, like: Jet) -> Jet:
        return self._linear(lambda y: self.num.widened(y, like.value))(x)

    def assemble(self, size: int, blocks: Mapping[tuple[int, int], Jet]) -> Jet:
        def join(parts: Sequence[Any]) -> Any:
            return self.num.assemble(size, dict(zip(blocks, parts, strict=True)))

        return self._joined(list(blocks.values()), join)

    def inverse(self, a: Jet) -> Jet:
        x = self.num.inverse(a.value)
        return Jet(x, None if a.slope is None else self.num.symmetric(-(x @ a.slope @ x)))

    def solve(self, a: Jet, b: Jet) -> Jet:
        x = Jet(self.num.solve(a.value, b.value))
        left = b - self.mul(a, x)
        return Jet(x.value, None if left.slope is None else self.num.solve(a.value, left.slope))

    def sqrt(self, x: Jet) -> Jet:
        root = self.num.sqrt(x.value)
        if x.slope is None:
            return Jet(root)
        return Jet(root, x.slope * np.divide(0.5, root, out=np.zeros_like(root), where=root > 0))

    def sin_cos(self, x: Jet) -> tuple[Jet, Jet]:
        s, c = self.num.sin_cos(x.value)
        if x.slope is None:
            return Jet(s), Jet(c)
        return Jet(s, c * x.slope), Jet(c, -s * x.slope)

    def turn_over_sine(self, sine: Jet, cosine: Jet) -> Jet:
        s, c = sine.value, cosine.value
        ratio = self.num.turn_over_sine(s, c)
        squared, some = s * s + c * c, np.where(s > 0, s, 1.0)
        # θ′ = (c s′ − s c′)/(s² + c²); at s = 0 the ratio is even in s
        by_sine = np.where(s > 0, (c / squared - ratio) / some, 0.0)
        left = None if sine.slope is None else by_sine * sine.slope
        right = None if cosine.slope is None else -cosine.slope / squared
        return Jet(ratio, _sum(left, right))


jets = _Jets
