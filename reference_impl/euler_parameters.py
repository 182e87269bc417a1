"""Euler parameters of a body: A, L, G, B and what follows from them (N7–N10 of formulation.md).

Every function takes leading batch dimensions and uses only +, − and ×, so it runs on floats, on complex
numbers (complex-step differentiation) and on exact rationals or symbols in object arrays: the tests check
these very functions.  ṽ, L, G and B are linear in their vector v.  They are written for one vector, as the
notes write them, and `_linear` applies them to batches as Σ vᵢ X(eᵢ), which rounds nothing.  By linearity,
too, L̇ = L(ṗ), Ġ = G(ṗ) and Ḣ = H(ṗ, s) (N9).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps

import numpy as np

from reference_impl.arrays import AnyArray, Shaped

I3 = np.eye(3, dtype=int)  # integers: exact in every field
_NEXT = np.array([1, 2, 0])  # of each axis the next one


def _linear(size: int) -> Callable[[Callable[[AnyArray], AnyArray]], Callable[[AnyArray], AnyArray]]:
    """Apply a matrix that is linear in one vector (size,) to vectors (..., size)."""

    def batched(matrix: Callable[[AnyArray], AnyArray]) -> Callable[[AnyArray], AnyArray]:
        of_units = np.array([matrix(unit) for unit in np.eye(size, dtype=int)])
        table, shape = of_units.reshape(size, -1), of_units.shape[1:]

        @wraps(matrix)
        def of_batch(v: AnyArray) -> AnyArray:
            return np.asarray(v @ table).reshape(*v.shape[:-1], *shape)

        return of_batch

    return batched


@_linear(3)
def tilde(v: Shaped[AnyArray, "... 3"]) -> Shaped[AnyArray, "... 3 3"]:
    """Return the cross-product matrix ṽ, ṽ w = v × w."""
    x, y, z = v
    return np.array(
        [
            [0, -z, y],
            [z, 0, -x],
            [-y, x, 0],
        ]
    )


def outer(a: Shaped[AnyArray, "... i"], b: Shaped[AnyArray, "... j"]) -> Shaped[AnyArray, "... i j"]:
    """Return the outer product a bᵀ."""
    return a[..., :, None] * b[..., None, :]


def dot(a: Shaped[AnyArray, "... i"], b: Shaped[AnyArray, "... i"]) -> Shaped[AnyArray, "..."]:
    """Return the inner product aᵀb without complex conjugation, as complex steps need it."""
    return np.asarray((a * b).sum(-1))


def cross(a: Shaped[AnyArray, "... 3"], b: Shaped[AnyArray, "... 3"]) -> Shaped[AnyArray, "... 3"]:
    """Return a × b, in a fifth of the time that `numpy.cross` takes on a few vectors."""
    return np.asarray((a * b.take(_NEXT, -1) - a.take(_NEXT, -1) * b).take(_NEXT, -1))


def A(p: Shaped[AnyArray, "... 4"]) -> Shaped[AnyArray, "... 3 3"]:
    """Return A = (2 p0² − 1) I + 2 (e eᵀ + p0 ẽ) (N7).

    Returns:
        A: a rotation, body → world, where pᵀp = 1.

    """
    p0, e = p[..., 0, None, None], p[..., 1:]
    return np.asarray((2 * p0**2 - 1) * I3 + 2 * (outer(e, e) + p0 * tilde(e)))


@_linear(4)
def L(p: Shaped[AnyArray, "... 4"]) -> Shaped[AnyArray, "... 3 4"]:
    """Return L = [−e, p0 I − ẽ], with which ω′ = 2 L ṗ.

    Args:
        p: Euler parameters or their rates.

    """
    p0, e = p[0], p[1:]
    return np.column_stack([-e, p0 * I3 - tilde(e)])


@_linear(4)
def G(p: Shaped[AnyArray, "... 4"]) -> Shaped[AnyArray, "... 3 4"]:
    """Return G = [−e, p0 I + ẽ], with which A = G Lᵀ + (pᵀp − 1) I (N10).

    Args:
        p: Euler parameters or their rates.

    """
    p0, e = p[0], p[1:]
    return np.column_stack([-e, p0 * I3 + tilde(e)])


@_linear(3)
def B(s: Shaped[AnyArray, "... 3"]) -> Shaped[AnyArray, "... 4 4"]:
    """Return B = [[0, −sᵀ], [s, −s̃]] (N8).

    Args:
        s: points of the body [m], body frame.

    Returns:
        B [m].

    """
    return np.block([[np.zeros((1, 1), int), -s[None, :]], [s[:, None], -tilde(s)]])


def H(p: Shaped[AnyArray, "... 4"], s: Shaped[AnyArray, "... 3"]) -> Shaped[AnyArray, "... 3 4"]:
    """Return H = G(p) B(s) + s pᵀ, half of ∂(A s)/∂p (D4).

    Args:
        p: Euler parameters or their rates.
        s: points of the body [m], body frame.

    Returns:
        H [m].

    """
    return G(p) @ B(s) + outer(s, p)


def dAs_dp(p: Shaped[AnyArray, "... 4"], s: Shaped[AnyArray, "... 3"]) -> Shaped[AnyArray, "... 3 4"]:
    """Return ∂(A s)/∂p = 2 G(p) B(s) + 2 s pᵀ, for every p (N8).

    Args:
        s: points of the body [m], body frame.

    Returns:
        [m].

    """
    return np.asarray(2 * G(p) @ B(s) + 2 * outer(s, p))


def A_rate(p: Shaped[AnyArray, "... 4"], pdot: Shaped[AnyArray, "... 4"]) -> Shaped[AnyArray, "... 3 3"]:
    """Return Ȧ = 2 G L̇ᵀ as the notes use it (N10); off pᵀṗ = 0 the rate of (N7) is 2 (pᵀṗ) I more (E3).

    Args:
        pdot: their rates ṗ [1/s].

    Returns:
        Ȧ [1/s].

    """
    return 2 * G(p) @ L(pdot).swapaxes(-1, -2)


def angular_velocity(
    p: Shaped[AnyArray, "... 4"], pdot: Shaped[AnyArray, "... 4"]
) -> Shaped[AnyArray, "... 3"]:
    """Return ω′ = 2 L(p) ṗ.

    Args:
        pdot: their rates ṗ [1/s].

    Returns:
        ω′ [rad/s], body frame.

    """
    return np.asarray(2 * (L(p) @ pdot[..., None])[..., 0])


def euler_parameter_rate(
    p: Shaped[AnyArray, "... 4"], omega: Shaped[AnyArray, "... 3"]
) -> Shaped[AnyArray, "... 4"]:
    """Return ṗ = ½ L(p)ᵀ ω′, the inverse of ω′ = 2 L ṗ where pᵀp = 1; then pᵀṗ = 0.

    Args:
        omega: angular velocities ω′ [rad/s], body frame.

    Returns:
        ṗ [1/s].

    """
    return np.asarray((L(p).swapaxes(-1, -2) @ omega[..., None])[..., 0] / 2)
