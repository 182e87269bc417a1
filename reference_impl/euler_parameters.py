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

Field = NDArray[Any]  # float, complex or exact entries

I3 = np.eye(3, dtype=int)  # integers: exact in every field


def tilde(v: Field) -> Field:
    """Cross-product matrix ṽ (..., 3, 3) of v (..., 3): ṽ w = v × w."""
    out = np.zeros((*v.shape, 3), v.dtype)
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return out - out.swapaxes(-1, -2)


def outer(a: Field, b: Field) -> Field:
    """Outer product a bᵀ (..., i, j) of a (..., i) and b (..., j)."""
    return a[..., :, None] * b[..., None, :]


def dot(a: Field, b: Field) -> Field:
    """Inner product aᵀb (...) of a, b (..., i); never conjugates, as a complex step needs it."""
    return np.asarray((a * b).sum(-1))


def A(p: Field) -> Field:
    """(N7) A = (2 p0² − 1) I + 2 (e eᵀ + p0 ẽ), (..., 3, 3): a rotation, body → world, where pᵀp = 1."""
    p0, e = p[..., 0, None, None], p[..., 1:]
    return np.asarray((2 * p0 * p0 - 1) * I3 + 2 * (outer(e, e) + p0 * tilde(e)))


def L(p: Field) -> Field:
    """The notes' matrix [−e, p0 I − ẽ], (..., 3, 4): ω′ = 2 Lṗ, body frame."""
    return np.concatenate([-p[..., 1:, None], p[..., 0, None, None] * I3 - tilde(p[..., 1:])], -1)


def G(p: Field) -> Field:
    """The notes' matrix [−e, p0 I + ẽ], (..., 3, 4): A = G Lᵀ + (pᵀp − 1) I."""
    return np.concatenate([-p[..., 1:, None], p[..., 0, None, None] * I3 + tilde(p[..., 1:])], -1)


def B(s: Field) -> Field:
    """(N8) B = [[0, −sᵀ], [s, −s̃]], (..., 4, 4)."""
    out = np.zeros((*s.shape[:-1], 4, 4), s.dtype)
    out[..., 0, 1:], out[..., 1:, 0], out[..., 1:, 1:] = -s, s, -tilde(s)
    return out


def H(p: Field, s: Field) -> Field:
    """(D4) H = G(p) B(s) + s pᵀ, (..., 3, 4): half of ∂(A s)/∂p."""
    return G(p) @ B(s) + outer(s, p)


def dAs_dp(p: Field, s: Field) -> Field:
    """(N8) ∂(A s)/∂p = 2 G(p) B(s) + 2 s pᵀ, (..., 3, 4), for every p."""
    return 2 * H(p, s)


def A_rate(p: Field, pdot: Field) -> Field:
    """(N10) Ȧ = 2 G L̇ᵀ, (..., 3, 3), as the notes use it: Ȧ of (N7) is 2 (pᵀṗ) I more where pᵀṗ ≠ 0 (E3)."""
    return 2 * G(p) @ L(pdot).swapaxes(-1, -2)


def angular_velocity(p: Field, pdot: Field) -> Field:
    """ω′ = 2 L(p) ṗ, (..., 3) rad/s, body frame."""
    return np.asarray(2 * (L(p) @ pdot[..., None])[..., 0])


def rate(p: Field, omega: Field) -> Field:
    """ṗ = ½ L(p)ᵀ ω′, (..., 4) 1/s, for pᵀp = 1; then pᵀṗ = 0."""
    return np.asarray((L(p).swapaxes(-1, -2) @ omega[..., None])[..., 0] / 2)
