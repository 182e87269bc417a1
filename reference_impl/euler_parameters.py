"""Euler parameters: A, L, G, B of a body and what follows from them (N7–N10 of the notes).

Everything takes leading batch dimensions and is exact algebra of +, − and ×, so it runs on
floats, on complex numbers (complex-step differentiation) and on exact rationals or symbols
in object arrays: the tests check these very functions, not a copy.  L, G, B and H are linear
in their arguments, so L̇ = L(ṗ), Ġ = G(ṗ) and Ḣ = H(ṗ, s).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

AnyArray = NDArray[Any]  # float, complex or exact entries

I3 = np.eye(3, dtype=int)  # integers: exact in every field


def _signed_index_pattern(*rows: str) -> tuple[NDArray[Any], NDArray[Any]]:
    """Places and signs of a matrix whose every entry is 0 or ± a component of the vector it is made of.

    Taken at once: the matrices below are most of what a right-hand side costs in calls.
    """
    entries = np.array([row.split() for row in rows])
    place = np.array([[int(entry[-1]) for entry in row] for row in entries])
    sign = np.array([[{"-": -1, "+": 1, "0": 0}[entry[0]] for entry in row] for row in entries])
    return place, sign


_TILDE_PATTERN = _signed_index_pattern("00 -2 +1", "+2 00 -0", "-1 +0 00")
_L_PATTERN = _signed_index_pattern("-1 +0 +3 -2", "-2 -3 +0 +1", "-3 +2 -1 +0")
_G_PATTERN = _signed_index_pattern("-1 +0 -3 +2", "-2 +3 +0 -1", "-3 -2 +1 +0")
_B_PATTERN = _signed_index_pattern("00 -0 -1 -2", "+0 00 +2 -1", "+1 -2 00 +0", "+2 +1 -0 00")


def _apply_pattern(x: AnyArray, linear: tuple[NDArray[Any], NDArray[Any]]) -> AnyArray:
    """The matrix (..., i, j) of x (..., k)."""
    place, sign = linear
    return np.asarray(x.take(place, axis=-1) * sign)


def tilde(v: AnyArray) -> AnyArray:
    """Cross-product matrix ṽ (..., 3, 3) of v (..., 3): ṽ w = v × w."""
    return _apply_pattern(v, _TILDE_PATTERN)


def outer(a: AnyArray, b: AnyArray) -> AnyArray:
    """Outer product a bᵀ (..., i, j) of a (..., i) and b (..., j)."""
    return a[..., :, None] * b[..., None, :]


def dot(a: AnyArray, b: AnyArray) -> AnyArray:
    """Inner product aᵀb (...) of a, b (..., i); never conjugates, as a complex step needs it."""
    return np.asarray((a * b).sum(-1))


def A(p: AnyArray) -> AnyArray:
    """(N7) A = (2 p0² − 1) I + 2 (e eᵀ + p0 ẽ), (..., 3, 3): a rotation, body → world, where pᵀp = 1."""
    p0, e = p[..., 0, None, None], p[..., 1:]
    return np.asarray((2 * p0 * p0 - 1) * I3 + 2 * (outer(e, e) + p0 * tilde(e)))


def L(p: AnyArray) -> AnyArray:
    """The notes' matrix [−e, p0 I − ẽ], (..., 3, 4): ω′ = 2 Lṗ, body frame."""
    return _apply_pattern(p, _L_PATTERN)


def G(p: AnyArray) -> AnyArray:
    """The notes' matrix [−e, p0 I + ẽ], (..., 3, 4): A = G Lᵀ + (pᵀp − 1) I."""
    return _apply_pattern(p, _G_PATTERN)


def B(s: AnyArray) -> AnyArray:
    """(N8) B = [[0, −sᵀ], [s, −s̃]], (..., 4, 4)."""
    return _apply_pattern(s, _B_PATTERN)


def H(p: AnyArray, s: AnyArray) -> AnyArray:
    """(D4) H = G(p) B(s) + s pᵀ, (..., 3, 4): half of ∂(A s)/∂p."""
    return G(p) @ B(s) + outer(s, p)


def dAs_dp(p: AnyArray, s: AnyArray) -> AnyArray:
    """(N8) ∂(A s)/∂p = 2 G(p) B(s) + 2 s pᵀ, (..., 3, 4), for every p."""
    return 2 * H(p, s)


def A_rate(p: AnyArray, pdot: AnyArray) -> AnyArray:
    """(N10) Ȧ = 2 G L̇ᵀ, (..., 3, 3), as the notes use it: Ȧ of (N7) is 2 (pᵀṗ) I more where pᵀṗ ≠ 0 (E3)."""
    return 2 * G(p) @ L(pdot).swapaxes(-1, -2)


def angular_velocity(p: AnyArray, pdot: AnyArray) -> AnyArray:
    """ω′ = 2 L(p) ṗ, (..., 3) rad/s, body frame."""
    return np.asarray(2 * (L(p) @ pdot[..., None])[..., 0])


def euler_parameter_rate(p: AnyArray, omega: AnyArray) -> AnyArray:
    """ṗ = ½ L(p)ᵀ ω′, (..., 4) 1/s, for pᵀp = 1; then pᵀṗ = 0."""
    return np.asarray((L(p).swapaxes(-1, -2) @ omega[..., None])[..., 0] / 2)
