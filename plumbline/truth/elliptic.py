"""Jacobi's elliptic functions and Legendre's integrals from the complementary parameter m₁ = 1 − m.

SciPy takes m alone, which loses the digits of 1 − m near a separatrix (a pendulum close to upright, a brick
spun about its middle axis), so the functions are computed here from the arithmetic-geometric mean and from
Carlson's symmetric integrals.
"""

from __future__ import annotations

import numpy as np
import scipy

from plumbline.model.datatypes import Array


def jacobi(u: Array, m1: float) -> tuple[Array, Array, Array, Array]:
    """Evaluate Jacobi's functions by descending Landen transformations.

    DLMF § 22.20(ii), Abramowitz & Stegun 16.4; for m₁ = 0 the hyperbolic limits of DLMF Table 22.5.4.

    Args:
        u: (T,) arguments.
        m1: complementary parameter 1 − m, 0 ≤ m1 ≤ 1.

    Returns:
        sn, cn, dn and the amplitude am, each (T,).

    """
    u = np.asarray(u, dtype=float)
    if m1 == 0:
        sech = 1 / np.cosh(u)
        return np.tanh(u), sech, sech, 2 * np.arctan(np.tanh(u / 2))
    a, b, c = [1.0], np.sqrt(m1), [np.sqrt(1 - m1)]
    while c[-1] > 1e-9 * a[-1]:  # the next c is c²/4a
        a, b, c = [*a, (a[-1] + b) / 2], np.sqrt(a[-1] * b), [*c, (a[-1] - b) / 2]
    phi = 2.0 ** (len(a) - 1) * a[-1] * u
    for ratio in reversed([cn / an for cn, an in zip(c[1:], a[1:], strict=True)]):
        phi = (phi + np.arcsin(np.clip(ratio * np.sin(phi), -1, 1))) / 2
    sn, cn = np.sin(phi), np.cos(phi)
    return sn, cn, np.sqrt(cn * cn + m1 * sn * sn), phi


def elliptic_f(phi: Array | float, m1: float) -> Array:
    """Evaluate F(φ | m), Legendre's integral of the first kind, by DLMF 19.25.5 and Carlson's R_F.

    Args:
        phi: amplitudes of any shape [rad], of any size.
        m1: complementary parameter 1 − m, 0 ≤ m1 ≤ 1.

    Returns:
        The integral, with the shape of ``phi``.

    """
    half_turns, s, c = _reduce_angle(phi)
    part = s * scipy.special.elliprf(c * c, c * c + m1 * s * s, 1.0)
    return np.asarray(
        part + 2 * half_turns * scipy.special.elliprf(0.0, m1, 1.0) if np.any(half_turns) else part
    )


def elliptic_pi(n: float, phi: Array | float, m1: float) -> Array:
    """Evaluate Π(n; φ | m) = ∫ dφ / ((1 − n sin²φ) √(1 − m sin²φ)) by DLMF 19.25.14.

    Args:
        n: characteristic, n < 1.
        phi: amplitudes of any shape [rad], of any size.
        m1: complementary parameter 1 − m, 0 ≤ m1 ≤ 1.

    Returns:
        The integral, with the shape of ``phi``.

    """
    half_turns, s, c = _reduce_angle(phi)
    part = _elliptic_pi_reduced(n, s, c, m1)
    complete = _elliptic_pi_reduced(n, np.ones(1), np.zeros(1), m1)[0] if np.any(half_turns) else 0.0
    return np.asarray(part + 2 * half_turns * complete)


def _elliptic_pi_reduced(n: float, s: Array, c: Array, m1: float) -> Array:
    """Π from the sine and cosine of an amplitude in [−π/2, π/2]."""
    d, q = c * c + m1 * s * s, c * c + (1 - n) * s * s
    return np.asarray(
        s * scipy.special.elliprf(c * c, d, 1.0) + n / 3 * s**3 * scipy.special.elliprj(c * c, d, 1.0, q)
    )


def _reduce_angle(phi: Array | float) -> tuple[Array, Array, Array]:
    """Number of half turns, and sine and cosine of the remainder in [−π/2, π/2]."""
    phi = np.asarray(phi, dtype=float)
    half_turns = np.round(phi / np.pi)
    sign = np.where(half_turns % 2 == 0, 1.0, -1.0)
    return half_turns, sign * np.sin(phi), np.abs(np.cos(phi))
