"""Refinement of runs at halved steps: observed orders and the extrapolated limit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from plumbline.model.datatypes import Array


def observed_orders(runs: Array) -> Array:
    """(L − 2,) log₂ of the ratio of consecutive changes of L runs (L, …) at halved steps."""
    change = np.linalg.norm(np.diff(runs, axis=0).reshape(len(runs) - 1, -1), axis=1)
    return np.asarray(np.log2(change[:-1] / change[1:]))


def romberg_columns(runs: Array, exponents: Iterable[int]) -> list[Array]:
    """The columns of Romberg's table of L runs, for an error in these powers of the step."""
    columns = [np.asarray(runs)]
    for exponent, _ in zip(exponents, runs[1:], strict=False):
        finer, coarser = columns[-1][1:], columns[-1][:-1]
        columns.append(finer + (finer - coarser) / (2**exponent - 1))
    return columns


def extrapolated(runs: Array, exponents: Sequence[int]) -> Array:
    """The finest entry of the table's last column."""
    return np.asarray(romberg_columns(runs, exponents)[-1][-1])
