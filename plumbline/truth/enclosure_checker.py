"""Check a certificate of a motion and enclose the motion: a proof that is read from the top.

This file imports numpy, python-flint and the standard library only.  Inequality (2), the jumps in (7) and the
result are evaluated in balls (python-flint), whose radii enclose every rounding; the other bounds in doubles
by the rules (F).  Guesses (inverses, singular vectors, a fundamental matrix) need no trust: a wrong one makes
a check fail and cannot make a false statement pass.  Nor does the program that wrote the certificate.

THE MECHANISM.  A chain of N bodies, body k hung by a ball joint or by a massless rod of length l_k, with the
doubles of the file as its numbers.  Its state y = (q, v) has q = (p_k, of rods u_k), the Euler parameters and
the rod's direction, and v = (ω_k, of rods u̇_k), the rate in body axes and the rate of the direction.  With
A(p) the homogeneous quadratic rotation matrix, m_k r̈_k = m_k g + f_k − c_k ṙ_k + F_k − F_{k+1} defines the
joint forces F_k (world axes, on body k at its proximal point s_k; t_k is its distal point), and v̇ solves

  G(y, v̇) = 0:  J_k ω̇ + ω × J_k ω + d_k ω − n_k − s_k × AᵀF_k + t_k × AᵀF_{k+1} = 0         for each body,
                F_k − u (uᵀF_k) + m_k l_k u (uᵀü + u̇ᵀu̇) = 0                                for each rod:

Newton's and Euler's equations, with F_k along u_k and |u_k| = 1.  G is polynomial, and affine in v̇:
G = M(y) v̇ + G(y, 0).  The kinematic equations are ṗ = ½ L(p)ᵀω and du/dt = u̇.  They conserve |p|; where
|u| = 1 and uᵀu̇ = 0 they and G = 0 give d(uᵀu̇)/dt = 0, so that a solution that starts there stays there and
is the motion.

THEOREM.  Let y(t) solve these equations with y(0) the state of the file, normalised exactly: p/|p|, u/|u|,
u̇ − u (uᵀu̇).  If `enclose_motion` returns, y exists up to the last sample time, and at every sample time each
position, attitude, velocity and rate lies in the ball that is returned.

PROOF.  The file has a unit of time, a power of two [s], into which every number is converted exactly.  On a
step of length h let s ∈ [0, 1], t = t_k + h s, ỹ(s) the polynomials of the file, e = y − ỹ, ′ = d/ds.  ‖·‖ is
the Euclidean norm of vectors and the Frobenius norm of matrices, |·| the absolute value of each entry, its
largest for s ∈ [0, 1] where it bounds a function.

 (F) Floating point. Assumed is that each operation of doubles is off by at most 2⁻⁵² of its result, or by
     2⁻¹⁰²² where it underflows (true of every direction of rounding), and that NumPy evaluates a product
     of arrays as sums of products, added in any order. Then a sum of K ≤ 2¹⁵ products is off by at most
     2⁻⁵¹ K Σ|products| + 2⁻¹⁰⁰⁰, one product also where a factor is off by 2⁻⁵³ of itself; and an
     expression of numbers ≥ 0, of at most ten nested sums, products, quotients and roots, by 2⁻³⁰ of
     itself and 2⁻¹⁰⁰⁰ at most: `_up`.
 (1) A function is *enclosed* by c₀ + … + c_D s^D, D = DEGREE, and a radius r if they differ by at most r
     for all s ∈ [0, 1]. Products of enclosing polynomials are computed whole: their terms above s^D, the
     roundings and the products with the factors' radii go into r, so that no series is cut without its
     remainder.
 (2) Defect: g = G(ỹ, ṽ′/h) and the kinematic defect h q̇(ỹ) − q̃′, whole polynomials of balls.
 (3) Linear part: automatic differentiation encloses K = ∂q̇/∂y, D = ∂G/∂y and M = ∂G/∂v̇ for |e_i| ≤ ε and
     |v̇_i − ṽ_i′/h| ≤ β, and so also their means from (ỹ, ṽ′/h) to (y, v̇), for which K, D and M stand
     from here on: e_q′ = h K e + h q̇(ỹ) − q̃′ and 0 = g + D e + M (v̇ − ṽ′/h). With C an approximate
     inverse, ‖I − C M‖ ≤ θ < 1 proves that M has an inverse, and ‖M⁻¹x‖ ≤ ‖C x‖/(1 − θ).
 (4) β is large enough: since G is affine in v̇, |v̇ − ṽ′/h| = |M⁻¹G(y, ṽ′/h)| ≤ ‖|C| (|g| + |D| ε)‖/(1 −
     θ), which must be ≤ β.
 (5) Growth: with polynomial guesses P of a fundamental matrix and Φ of its inverse, e = P w. R = P′ − h J
     P, J composed of K and −M⁻¹D, has the rows P_q′ − h K P and M⁻¹(M P_v′ + h D P), and δ = (kinematic
     defect, −h M⁻¹g): w′ = P⁻¹(δ − R w). ‖I − Φ P‖ ≤ θ′ < 1 gives ‖w‖′ ≤ a ‖w‖ + b with a = ‖|Φ| |R|‖/(1 −
     θ′) < 1 and b = ‖|Φ| |δ|‖/(1 − θ′), and from ‖w(0)‖ ≤ ρ follows ‖w(s)‖ ≤ exp(a) (ρ + b) ≤ ρ⁺ = (ρ +
     b)/(1 − a) as long as e has been in the tube |e_i| ≤ ε.
 (6) e stays in the tube: ‖row i of P‖ ρ⁺ < ε. It starts there, and e is continuous: it cannot leave before
     s = 1, and y exists up to there because M has an inverse in the tube.
 (7) Next step, with T = P⁺(0) and Q an approximate inverse, ‖I − Q T‖ ≤ θ″ < 1: e(0) = X w(1) + j, X =
     P(1), with the jump j = ỹ(1) − ỹ⁺(0) (at the start: j = y(0) − ỹ⁺(0), ρ⁺ = 0) is T w⁺(0), and ‖w⁺(0)‖
     ≤ (√(largest row sum of |B Bᵀ|) ρ⁺ + ‖|Q| |j|‖)/(1 − θ″) with B = Q X.

Comparisons reject unless they hold: never for NaN.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb, arb_poly, ctx

FORMAT, VERSION = "plumbline enclosure certificate", 1
DEGREE, GUARD_BITS = 11, 40  # of the linear part (R falls with h¹²); of (2) beyond the certificate's own
MIN_TUBE, MAX_CONDITION = 2.0**-44, 100.0  # of ε and of T
MAX_BITS, MAX_BODIES, MAX_TERMS = 2000, 100, 401
ROUNDING, TINY = 2.0**-51, 2.0**-1000  # of (F)
UNIT = arb(0.5, 0.5)  # [0, 1]
SHIFTED = np.subtract.outer(np.arange(2 * DEGREE + 1), np.arange(DEGREE + 1))  # for `_convolution`
SHIFTED[(SHIFTED < 0) | (SHIFTED > DEGREE)] = DEGREE + 1
SHAPES: dict[str, tuple[tuple[int, ...], int]] = {  # and power of seconds; per body, but gravity
    "gravity": ((3,), -2), "length": ((), 0), "mass": ((), 0), "inertia": ((3, 3), 0), "proximal": ((3,), 0),
    "distal": ((3,), 0), "force": ((3,), -2), "moment": ((3,), -2), "drag_force": ((), -1),
    "drag_moment": ((), -1), "p": ((4,), 0), "omega": ((3,), -1), "u": ((3,), 0), "udot": ((3,), -1),
}  # fmt: skip
Array = np.ndarray[Any, Any]


class MalformedCertificate(ValueError):
    """The file is no certificate; the message names the field and what is valid."""


class Rejected(ArithmeticError):
    """The certificate proves nothing; the message names the step and the inequality that does not hold."""


def _require(holds: Any, failure: str, error: type[Exception] = Rejected) -> None:
    if not holds:
        raise error(failure)


# --- the file ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Certificate:
    """A candidate motion, and what it is a motion of."""

    data: dict[str, Array]  # the model and its initial state by the names of SHAPES; doubles, SI
    times: list[float]  # s, of the samples
    time_exponent: int  # the unit of time is 2**time_exponent s
    bits: int  # lengths and coefficients are integers times 2**-bits
    steps: list[Any]  # [length, then per coordinate (q, then v) its coefficients from the power 0 of s on]


def parse_certificate(raw: bytes) -> Certificate:
    """Validate a certificate.

    Args:
        raw: the file's bytes: gzip-compressed JSON, or JSON.

    Returns:
        The certificate, with every number finite and every shape as the model demands.

    Raises:
        MalformedCertificate: something is wrong with the file; the message says where and what is valid.

    """
    try:
        data = json.loads(zlib.decompress(raw, 31) if raw[:2] == b"\x1f\x8b" else raw)
    except (zlib.error, ValueError, RecursionError) as error:
        raise MalformedCertificate(f"not a complete gzip or JSON file: {error}") from None
    _expect(isinstance(data, dict) and data.get("format") == FORMAT, "format", f"the text {FORMAT!r}")
    _expect(data.get("version") == VERSION, "version", str(VERSION))
    bits, exponent, steps = (data.get(name) for name in ("bits", "time_exponent", "steps"))
    _expect(type(bits) is int and 16 <= bits <= MAX_BITS, "bits", f"an integer from 16 to {MAX_BITS}")
    _expect(type(exponent) is int and abs(exponent) <= 60, "time_exponent", "an integer from -60 to 60")
    times, length = (_doubles(data, name, (-1,)) for name in ("times", "length"))
    _expect(times[:1] >= 0 and np.all(np.diff(times) > 0), "times", "ascending numbers ≥ 0")
    _expect(0 < len(length) <= MAX_BODIES and np.all(length >= 0), "length", f"1 to {MAX_BODIES} numbers ≥ 0")
    arrays = {name: _doubles(data, name, shape if name == "gravity" else (len(length), *shape))
              for name, (shape, _) in SHAPES.items()}  # fmt: skip
    _expect(np.all(arrays["mass"] > 0), "mass", "positive numbers")
    _expect(np.all(arrays["inertia"] == arrays["inertia"].mT), "inertia", "symmetric matrices")
    _expect(isinstance(steps, list) and len(steps) > 0, "steps", "a list of steps")
    size = 7 * len(length) + 6 * int(np.sum(length > 0))
    for k, step in enumerate(steps):
        fits = isinstance(step, list) and len(step) == 1 + size and type(step[0]) is int and step[0] > 0
        _expect(fits, f"steps[{k}]", f"a positive length, then {size} lists of coefficients")
        fits = all(type(x) is list and len(x) <= MAX_TERMS and {*map(type, x)} <= {int} for x in step[1:])
        _expect(fits, f"steps[{k}]", f"lists of at most {MAX_TERMS} integers")
    return Certificate(arrays, times.tolist(), exponent, bits, steps)


def _expect(holds: Any, field: str, valid: str) -> None:
    _require(holds, f"{field}: expected {valid}", MalformedCertificate)


def _doubles(data: dict[str, Any], field: str, shape: tuple[int, ...]) -> Array:
    """Array of doubles from nested lists of hexadecimal texts; the shape (-1,) stands for any length."""
    try:
        texts = np.array(data.get(field), dtype=object)
        numbers = np.array([float.fromhex(text) for text in texts.ravel()]).reshape(texts.shape)
    except (ValueError, TypeError, OverflowError):
        numbers = np.array(np.nan)
    fits = numbers.ndim == 1 if shape == (-1,) else numbers.shape == shape
    sound = np.isfinite(numbers) & ((numbers == 0) | (np.abs(numbers) > 1e-100))  # exact in any unit
    _expect(fits and np.all(sound), field, f"finite doubles as '0x1.8p+0', shape {shape}, not below 1e-100")
    return numbers


# --- functions of s -----------------------------------------------------------------------------------


def _up(x: Any) -> Any:
    """(F): an upper bound of an expression of numbers ≥ 0 that was evaluated in doubles."""
    return x * (1 + 2.0**-30) + TINY


def _norm(bounds: Array, axis: int | None = None) -> Any:
    """Upper bound of the Frobenius norm, or of the Euclidean norms along an axis."""
    return _up(np.sqrt(_up(np.sum(bounds * bounds, axis))))


def _upper(balls: Iterable[Any]) -> Array:
    """Doubles above the absolute values of balls."""
    return np.array([_up(float(abs(ball).upper())) for ball in balls])


class _Series:
    """(F), (1): a matrix of functions of s, each within r of c₀ + c₁ s + … + c_D s^D, where D = DEGREE.

    c has the shape (D + 1, rows, columns), r (rows, columns).  `@` is the product of matrices; `*` is that of
    two functions, each stored with its partial derivatives as one row: value, derivatives.
    """

    def __init__(self, c: Array, r: Any = 0.0, roundings: int = 0) -> None:
        self.c, self.total = c, np.abs(c).sum(0)
        self.r = _up(r + roundings * ROUNDING * self.total) if roundings else r + 0 * self.total

    @property
    def size(self) -> Array:
        """Upper bounds of the absolute values on [0, 1]."""
        return _up(self.total + self.r)  # type: ignore[no-any-return]

    def block(self, rows: slice, columns: slice = slice(None)) -> _Series:
        """Some rows and columns."""
        return _Series(self.c[:, rows, columns], self.r[rows, columns])

    def __neg__(self) -> _Series:
        return _Series(-self.c, self.r)

    def __add__(self, other: Any) -> _Series:
        if not isinstance(other, _Series):  # a constant, whose derivatives are zero
            other = _constant(np.eye(1, self.c.shape[2]) * other)
        return _Series(self.c + other.c, self.r + other.r, 1)

    def __sub__(self, other: Any) -> _Series:
        return self.__add__(-other)

    def __matmul__(self, other: _Series) -> _Series:
        full = _convolution(self.c, other.c)
        rounding = ROUNDING * (DEGREE + 1) * self.c.shape[2] * other.total
        r = self.total @ (other.r + rounding) + self.r @ (other.total + other.r)
        return _Series(full[: DEGREE + 1], _up(r + np.abs(full[DEGREE + 1 :]).sum(0)))

    def __mul__(self, other: Any) -> _Series:
        if not isinstance(other, _Series):  # a constant
            return _Series(self.c * other, self.r * abs(other), 1)
        values = _join([self.block(slice(None), slice(1)), other.block(slice(None), slice(1))], 1)
        found = values @ _join([other, self])
        halves = 1 - np.eye(1, self.c.shape[2]) / 2  # of the value, which this adds twice
        return _Series(found.c * halves, found.r * halves)

    __rmul__ = __mul__


def _convolution(a: Array, b: Array) -> Array:
    """Coefficients (2 DEGREE + 1, m, n) of the product of two matrix polynomials."""
    (m, k), n = a.shape[1:], b.shape[2]
    if m > 1:
        full = np.zeros((2 * DEGREE + 1, m, n))
        for i, factor in enumerate(a):
            full[i : i + DEGREE + 1] += factor @ b
        return full
    table = np.concatenate([a, np.zeros((1, m, k))])[SHIFTED].reshape(-1, (DEGREE + 1) * k)
    return (table @ b.reshape(-1, n))[:, None]


def _constant(matrix: Array) -> _Series:
    return _Series(np.concatenate([matrix[None], np.zeros((DEGREE, *matrix.shape))]))


def _join(parts: Sequence[_Series], axis: int = 0) -> _Series:
    """Rows below rows, or columns beside columns."""
    return _Series(np.concatenate([x.c for x in parts], 1 + axis), np.concatenate([x.r for x in parts], axis))


def _inverse_guess(a: Array) -> Array:
    """Coefficients of the inverse of a matrix polynomial."""
    series = [np.linalg.inv(a[0])]
    for k in range(1, DEGREE + 1):
        series.append(-series[0] @ sum(a[i] @ series[k - i] for i in range(1, k + 1)))
    return np.array(series)


def _inverse_error(a: _Series, b: _Series, failure: str) -> float:
    """Bound of ‖I − a b‖, which must be below 1."""
    theta = _norm((_constant(np.eye(len(a.r))) - a @ b).size)
    _require(theta < 1, failure)
    return float(theta)


def _vector(x: Iterable[Any]) -> Array:
    """Array of objects, also of those that NumPy would take for sequences."""
    return np.fromiter(x, object)


def _rotation(p: Array) -> Array:
    """Return A(p), homogeneous and quadratic: a rotation where |p| = 1."""
    w, x, y, z = p
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    xy, wz, xz, wy, yz, wx = x * y * 2, w * z * 2, x * z * 2, w * y * 2, y * z * 2, w * x * 2
    return _vector([ww + xx - yy - zz, xy - wz, xz + wy, xy + wz, ww - xx + yy - zz, yz - wx,
                    xz - wy, yz + wx, ww - xx - yy + zz]).reshape(3, 3)  # fmt: skip


# --- the mechanism ------------------------------------------------------------------------------------


class _Mechanism:
    """The model in the certificate's unit of time; vectors are arrays of balls, polynomials or `_Series`."""

    def __init__(self, certificate: Certificate, number: Callable[[float], Any]) -> None:
        self.unit = number(2.0) ** certificate.time_exponent
        self.data: dict[str, Any] = {  # exact: powers of two
            name: np.frompyfunc(number, 1, 1)(x) * self.unit ** -SHAPES[name][1]
            for name, x in certificate.data.items()
        }
        self.rods = certificate.data["length"] > 0
        self.has_drag = bool(np.any(certificate.data["drag_force"]))
        self.n = len(self.rods)
        self.nq, self.nv = (int(size * self.n + 3 * np.sum(self.rods)) for size in (4, 3))

    def split(self, x: Sequence[Any], size: int) -> tuple[list[Array], list[Array]]:
        """Per body its part (size,) of q, v or v̇ and that of its rod (3,), zero for a ball joint."""
        own, of_rod, rest = [], [], list(x)
        for rod in self.rods:
            own.append(_vector(rest[:size]))
            of_rod.append(_vector(rest[size : size + 3] if rod else [rest[0] * 0] * 3))
            rest = rest[size + 3 * rod :]
        return own, of_rod

    def centres(self, A: list[Array], rod: list[Array], turn: Callable[[int, Array], Array]) -> list[Array]:
        """Positions, velocities or accelerations of the centres of mass, from u, u̇ or ü and A turn(k, s)."""
        found: list[Array] = []
        for k in range(self.n):
            tip = found[-1] + A[k - 1] @ turn(k - 1, self.data["distal"][k - 1]) if found else 0 * rod[0]
            hang = tip + rod[k] * self.data["length"][k] if self.rods[k] else tip
            found.append(hang - A[k] @ turn(k, self.data["proximal"][k]))
        return found

    def velocities(self, A: list[Array], w: list[Array], udot: list[Array]) -> list[Array]:
        """Return ṙ of the centres of mass."""
        return self.centres(A, udot, lambda k, s: np.cross(w[k], s))

    def equations(self, y: Sequence[Any], vdot: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        """Return q̇ (nq,) and the residual G(y, v̇) (nv,)."""
        (p, u), (w, udot) = self.split(y[: self.nq], 4), self.split(y[self.nq :], 3)
        wdot, uddot = self.split(vdot, 3)
        A = [_rotation(x) for x in p]
        a = self.centres(A, uddot, lambda k, s: np.cross(wdot[k], s) + np.cross(w[k], np.cross(w[k], s)))
        v = self.velocities(A, w, udot) if self.has_drag else a
        qdot, residual, F = list[Any](), list[Any](), 0 * a[0]
        for k in reversed(range(self.n)):
            length, m, J, s, t, f, n, c, d = (self.data[name][k] for name in list(SHAPES)[1:10])
            below, F = F, F + (a[k] - self.data["gravity"]) * m - f
            F = F + v[k] * c if self.has_drag else F
            G = J @ wdot[k] + np.cross(w[k], J @ w[k]) + w[k] * d - n
            G = [*(G - np.cross(s, A[k].T @ F) + np.cross(t, A[k].T @ below))]
            half = w[k] * 0.5
            rate = [-(p[k][1:] @ half), *(half * p[k][:1] + np.cross(p[k][1:], half))]
            if self.rods[k]:
                along = (u[k] @ uddot[k] + udot[k] @ udot[k]) * m * length - u[k] @ F
                G, rate = [*G, *(F + u[k] * _vector([along]))], [*rate, *udot[k]]
            qdot, residual = rate + qdot, G + residual
        return qdot, residual


# --- one step -----------------------------------------------------------------------------------------


def _bound_defect(exact: _Mechanism, y: list[Any], h: Any) -> tuple[Array, Array]:
    """(2): bounds of h q̇ − q̃′ and of g."""
    qdot, g = exact.equations(y, [poly.derivative() * (1 / h) for poly in y[exact.nq :]])
    kinematic = (x * h - poly.derivative() for x, poly in zip(qdot, y[: exact.nq], strict=True))
    return _upper(x(UNIT) for x in kinematic), _upper(x(UNIT) for x in g)


def _variables(coefficients: list[Array], radii: Array) -> list[_Series]:
    """Functions of s with their derivatives by each other, from coefficients that are rounded once."""
    n, found = len(coefficients), []
    for i, row in enumerate(coefficients):
        x = _constant(np.eye(1, 1 + n, 1 + i))
        low, above = row[: DEGREE + 1], row[DEGREE + 1 :]
        x.c[: len(low), 0, 0] = low
        found.append(_Series(x.c, np.eye(1, 1 + n) * _up(radii[i] + np.abs(above).sum()), 1))
    return found


def _linearise(mechanism: _Mechanism, rows: list[Array], tube: float, g: Array) -> tuple[Any, Any, float]:
    """(3), (4): the derivatives of q̇ and G by y and v̇, C, and θ."""
    nq, n = mechanism.nq, mechanism.nq + mechanism.nv
    for beta in tube * 16.0 ** np.arange(3, 9):
        x = _variables(rows, np.repeat([tube, beta], [n, mechanism.nv]))
        qdot, residual = mechanism.equations(x[:n], x[n:])
        slopes = _join([*qdot, *residual]).block(slice(None), slice(1, None))
        D, M = slopes.block(slice(nq, None), slice(n)), slopes.block(slice(nq, None), slice(n, None))
        C = _Series(_inverse_guess(M.c))
        theta = _inverse_error(C, M, "inequality (3): M is not proved to be invertible over the step")
        if _up(_norm(C.size @ _up(g + tube * D.size.sum(1))) / (1 - theta)) <= beta:
            return slopes, C, theta
    raise Rejected("inequality (4): the accelerations leave their tube")


def _fundamental_guess(J: Array, T: Array) -> Array:
    """Power series of P′ = J P, P(0) = T."""
    P = [T]
    for k in range(DEGREE):
        P.append(sum(J[i] @ P[k - i] for i in range(k + 1)) / (k + 1))
    return np.array(P)


def _prove_step(
    mechanism: _Mechanism, rows: list[Array], h: float, defect: tuple[Array, Array], T: Array, rho: float
) -> tuple[_Series, float]:
    """(3)–(6): P and ρ⁺."""
    q, v, n = slice(mechanism.nq), slice(mechanism.nq, None), len(T)
    tube = max(MIN_TUBE, 1024 * float(np.linalg.norm(T)) * rho)
    slopes, C, theta = _linearise(mechanism, rows, tube, defect[1])
    J = np.concatenate([slopes.c[:, q, :n], -_convolution(C.c, slopes.c[:, v, :n])[: DEGREE + 1]], 1)
    P = _Series(_fundamental_guess(J * h, T))
    Phi = _Series(_inverse_guess(P.c))
    derivative = _Series(np.roll(P.c * np.arange(DEGREE + 1.0)[:, None, None], -1, 0), roundings=1)
    product = slopes @ _join([P * h, derivative.block(v)])
    accelerations = _norm(_up(C.size @ product.block(v).size), axis=0) / (1 - theta)  # of each column
    R = [(derivative.block(q) - product.block(q)).size, np.tile(_up(accelerations), (mechanism.nv, 1))]
    delta = [defect[0], np.full(mechanism.nv, _up(h * _norm(C.size @ defect[1]) / (1 - theta)))]
    theta = _inverse_error(Phi, P, "inequality (5): Φ is no approximate inverse of P")
    a, b = (_up(_norm(Phi.size @ x) / (1 - theta)) for x in map(np.concatenate, (R, delta)))
    _require(a < 1, "inequality (5): the error grows too fast")
    rho = _up((rho + b) / (1 - a))
    _require(np.all(_up(_norm(P.size, axis=1) * rho) < tube), "inequality (6): the error leaves the tube")
    return P, rho


def _evaluate(P: _Series, s: float) -> _Series:
    """P(s), by Horner's rule, where s is rounded once."""
    value = P.c[DEGREE]
    for coefficient in P.c[DEGREE - 1 :: -1]:
        value = value * s + coefficient
    return _Series(_constant(value).c, _up(4 * DEGREE * ROUNDING * P.total))


def _next_ellipsoid(X: _Series, rho: float, jump: Array) -> tuple[Array, float]:
    """(7): T and the bound of ‖w⁺(0)‖."""
    U, S, _ = np.linalg.svd(X.c[0])
    T = U * np.maximum(S / S[0], 1 / MAX_CONDITION)
    Q = _constant(np.linalg.inv(T))
    theta = _inverse_error(Q, _constant(T), "inequality (7): Q is no approximate inverse of T")
    B = Q @ X
    largest = np.sqrt(_up(np.max((B @ _Series(B.c.mT, B.r.T)).size.sum(1))))
    return T, _up((largest * rho + _norm(Q.size @ jump)) / (1 - theta))


# --- the motion ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Enclosure:
    """The theorem's conclusion: arrays of balls (python-flint ``arb``), SI."""

    times: list[float]  # (T,) s
    r: Array  # (T, N, 3) m, centres of mass, world frame
    p: Array  # (T, N, 4) –, unit quaternions, scalar first
    v: Array  # (T, N, 3) m/s, world frame
    omega: Array  # (T, N, 3) rad/s, body frame

    def radius(self, name: str) -> float:
        """Return the largest radius of a quantity.

        Args:
            name: r, p, v or omega.

        Returns:
            The radius, in the quantity's unit.

        """
        return max(float(x.rad()) for x in getattr(self, name).ravel())


def enclose_motion(certificate: Certificate, on_step: Callable[..., Any] = lambda *_: None) -> Enclosure:
    """Prove the theorem for a certificate.

    Args:
        certificate: candidate motion, model and initial state.
        on_step: called after each step with the numbers of proved steps and of all.

    Returns:
        Balls at every sample time.

    Raises:
        Rejected: an inequality does not hold.

    """
    per_second = Fraction(2) ** (certificate.bits - certificate.time_exponent)
    remaining, samples, at = [Fraction(t) * per_second for t in certificate.times], [], 0
    unit = arb(2) ** -certificate.bits
    with ctx.workprec(certificate.bits + GUARD_BITS), np.errstate(all="ignore"):
        exact, rounded = _Mechanism(certificate, arb), _Mechanism(certificate, float)
        end = _initial_values(exact)
        X, rho = _constant(np.eye(len(end))), 0.0
        for k, (length, *rows) in enumerate(certificate.steps):
            y, h = [arb_poly([c * unit for c in row]) for row in rows], length * unit
            try:
                rows = _rounded_coefficients(rows, exact.nq, length, certificate.bits)
                start = _next_ellipsoid(X, rho, _upper(x - f(arb(0)) for x, f in zip(end, y, strict=True)))
                P, rho = _prove_step(rounded, rows, float(h), _bound_defect(exact, y, h), *start)
            except (Rejected, OverflowError, np.linalg.LinAlgError) as error:
                raise Rejected(f"step {k + 1} of {len(certificate.steps)}: {error}") from None
            end, X = [poly(arb(1)) for poly in y], _evaluate(P, 1.0)
            while remaining and remaining[0] <= at + length:  # exact
                samples.append(_sample(exact, y, P, rho, (remaining.pop(0) - at) / length))
            at += length
            on_step(k + 1, len(certificate.steps))
    _require(not remaining, f"the steps end at {float(at / per_second):g} s, before the last sample")
    return Enclosure(certificate.times, *(np.array(x, dtype=object) for x in zip(*samples, strict=True)))


def _rounded_coefficients(rows: list[list[int]], nq: int, length: int, bits: int) -> list[Array]:
    """Coefficients of ỹ and ṽ′/h, each rounded once."""
    values = [[c / 2**bits for c in row] for row in rows]
    values += [[j * c / length for j, c in enumerate(row[1:], 1)] for row in rows[nq:]]
    return [np.array(row, dtype=float) for row in values]


def _initial_values(exact: _Mechanism) -> list[Any]:
    """y(0), normalised, in the certificate's unit of time."""
    q, v = list[Any](), list[Any]()
    for k, rod in enumerate(exact.rods):
        p, w, u, udot = (exact.data[name][k] for name in ("p", "omega", "u", "udot"))
        q, v = [*q, *(p / (p @ p).sqrt())], [*v, *w]
        if rod:
            u = u / (u @ u).sqrt()
            q, v = [*q, *u], [*v, *(udot - u * (u @ udot))]
    return [*q, *v]


def _sample(exact: _Mechanism, y: list[Any], P: _Series, rho: float, s: Fraction) -> tuple[list[Array], ...]:
    """Balls r, p, ṙ, ω′ of every body at s; |p| = |u| = 1, so that nothing is normalised."""
    spread = _up(_norm(_evaluate(P, s.numerator / s.denominator).size, axis=1) * rho)
    at = arb(s.numerator) / s.denominator
    z = [poly(at) + arb(0, float(e)) for poly, e in zip(y, spread, strict=True)]
    (p, u), (w, udot) = exact.split(z[: exact.nq], 4), exact.split(z[exact.nq :], 3)
    A = [_rotation(x) for x in p]
    r, v = exact.centres(A, u, lambda _, s: s), exact.velocities(A, w, udot)
    return r, p, [x / exact.unit for x in v], [x / exact.unit for x in w]
