"""Check a certificate of a motion and enclose the motion: a proof in ball arithmetic, read from the top.

This file imports numpy, python-flint and the standard library only.  All inequalities below are evaluated in
balls (python-flint), whose radii enclose every rounding.  NumPy supplies guesses (inverses, singular vectors,
a fundamental matrix): a wrong guess makes a check fail and cannot make a false statement pass, so nothing
is assumed of floating point, of the BLAS, or of the program that wrote the certificate.

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
step of length h let s ∈ [0, 1], t = t_k + h s, ỹ(s) the polynomials of the file, e = y − ỹ, ′ = d/ds.  A
polynomial P with ball coefficients *encloses* a function f if f(s) ∈ P(s) for all s ∈ [0, 1]; sums and
products of enclosing polynomials enclose sums and products.  ‖·‖ is the Euclidean norm of vectors and the
Frobenius norm of matrices; |·| of vectors and matrices is meant entry by entry; every bound holds for all s.

 (1) P = P₀ + s^(d+1) P₁ is enclosed by P₀ + [0, 1] P₁([0, 1]), of degree d: no series is cut without its
     remainder (`_fold`; for matrices `_product`).
 (2) Defect: g = G(ỹ, ṽ′/h) and the kinematic defect h q̇(ỹ) − q̃′ in high precision (`_bound_defect`).
 (3) Linear part: for |e_i| ≤ ε and |v̇_i − ṽ_i′/h| ≤ β automatic differentiation encloses D = ∂G/∂y and M.
     With C an approximate inverse, ‖I − C M‖ ≤ θ < 1 proves that M has an inverse, ‖M⁻¹x‖ ≤ ‖C x‖/(1 − θ) and
     ‖M⁻¹x − C x‖ ≤ θ/(1 − θ) ‖C x‖, which enclose ∂v̇/∂y = −M⁻¹D (`_linearise`).
 (4) β is large enough: with |G(y, ṽ′/h)| ≤ |g| + |D| ε for |e_i| ≤ ε by the mean value theorem,
     |v̇ − ṽ′/h| = |M⁻¹G(y, ṽ′/h)| ≤ ‖|C| (|g| + |D| ε)‖/(1 − θ), which must be ≤ β.
 (5) Growth: with Ψ, Φ polynomials (guesses of the fundamental matrix and its inverse, Ψ(0) = I), Q ≈ T⁻¹,
     e = Ψ T w, R = Ψ′ − h J Ψ, J the mean of ∂ẏ/∂y from ỹ to y, δ = (kinematic defect, −h M⁻¹g):
     w′ = T⁻¹Ψ⁻¹(δ − R T w).  ‖I − Q T‖ ≤ θ₁ < 1 and ‖Q (I − Φ Ψ) T‖/(1 − θ₁) ≤ θ₂ < 1 give ‖w‖′ ≤ a ‖w‖ + b,
     a = ‖Q Φ R T‖/((1 − θ₁)(1 − θ₂)), b = ‖Q Φ δ‖/((1 − θ₁)(1 − θ₂)), and from ‖w(0)‖ ≤ ρ follows
     ‖w(s)‖ ≤ ρ⁺ = exp(a) (ρ + b) as long as e has been in the tube |e_i| ≤ ε.
 (6) e stays in the tube: ‖row i of Ψ T‖ ρ⁺ < ε.  It starts there, and e is continuous: it cannot leave before
     s = 1, and y exists up to there because M has an inverse in the tube (`_prove_step`).
 (7) Next step: e(0) = Ψ(1) T w(1) + j with the jump j = ỹ(1) − ỹ⁺(0) (at the start: j = y(0) − ỹ⁺(0), ρ⁺ = 0)
     is T⁺w⁺, ‖w⁺‖ ≤ (√(largest row sum of |B Bᵀ|) ρ⁺ + ‖Q⁺j‖)/(1 − θ₁⁺), B = Q⁺Ψ(1) T (`_next_ellipsoid`).

Comparisons reject unless they hold: of balls, `<` holds only where it holds for all their points, and never
for NaN.
"""

from __future__ import annotations

import gzip
import json
import math
import sys
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from flint import arb, arb_mat, arb_poly, ctx, fmpq
from numpy.typing import NDArray

FORMAT, VERSION = "plumbline enclosure certificate", 1
DEGREE = 11  # of Ψ and of the Jacobian: R falls with the step's power DEGREE + 1
LOW_BITS = 64  # precision of the linear part
GUARD_BITS = 40  # of the defect, beyond the certificate's own
MIN_TUBE = 2.0**-44
MAX_CONDITION = 100.0  # of T
MAX_BITS, MAX_BODIES, MAX_ORDER, MAX_STEPS = 2000, 100, 400, 1_000_000
UNIT, SIGN = arb(0.5, 0.5), arb(0, 1)  # [0, 1] and [−1, 1]
SHAPES: dict[str, tuple[int, ...]] = {  # per body, but gravity; the last four are the initial state
    "gravity": (3,), "length": (), "mass": (), "inertia": (3, 3), "proximal": (3,), "distal": (3,),
    "force": (3,), "moment": (3,), "drag_force": (), "drag_moment": (),
    "p": (4,), "omega": (3,), "u": (3,), "udot": (3,),
}  # fmt: skip
TIME_POWERS = {"gravity": 2, "force": 2, "moment": 2, "drag_force": 1, "drag_moment": 1,
               "omega": 1, "udot": 1}  # fmt: skip
Array = NDArray[Any]


class MalformedCertificate(ValueError):
    """The file is no certificate; the message names the field and what is valid."""


class Rejected(ArithmeticError):
    """The certificate proves nothing; the message names the step and the inequality that does not hold."""


def _require(holds: bool, failure: str) -> None:
    """Reject unless an inequality holds; of balls, ``<`` holds where it holds for all their points."""
    if not holds:
        raise Rejected(failure)


# --- the file ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Certificate:
    """A candidate motion, and what it is a motion of."""

    data: dict[str, Array]  # the model and its initial state by the names of SHAPES; doubles, SI
    times: list[float]  # s, of the samples
    time_exponent: int  # the unit of time is 2**time_exponent s
    bits: int  # lengths and coefficients are integers times 2**-bits
    steps: list[Any]  # [length, then per coordinate (q, then v) its coefficients from the power 0 of s on]
    scenario: str = ""  # content hash of the scenario, for finding the file; the proof does not use it


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
        data = json.loads(gzip.decompress(raw) if raw[:2] == b"\x1f\x8b" else raw)
    except (EOFError, zlib.error, gzip.BadGzipFile, ValueError, RecursionError) as error:
        raise MalformedCertificate(f"not a complete gzip or JSON file: {error}") from None
    _expect(isinstance(data, dict) and data.get("format") == FORMAT, "format", f"the text {FORMAT!r}")
    _expect(data.get("version") == VERSION, "version", str(VERSION))
    n = len(_doubles(data, "length", (-1,)))
    _expect(0 < n <= MAX_BODIES, "length", f"1 to {MAX_BODIES} bodies")
    shapes = {name: (n, *shape) if name != "gravity" else shape for name, shape in SHAPES.items()}
    arrays = {name: _doubles(data, name, shape) for name, shape in shapes.items()}
    _expect(bool(np.all(arrays["mass"] > 0)), "mass", "positive numbers")
    _expect(bool(np.all(arrays["length"] >= 0)), "length", "numbers that are not negative")
    _expect(bool(np.all(arrays["inertia"] == arrays["inertia"].mT)), "inertia", "symmetric matrices")
    bits, exponent = _integer(data, "bits", 16, MAX_BITS), _integer(data, "time_exponent", -60, 60)
    times, steps = _doubles(data, "times", (-1,)), data.get("steps")
    _expect(
        len(times) > 0 and times[0] >= 0 and bool(np.all(np.diff(times) > 0)),
        "times",
        "ascending numbers ≥ 0",
    )
    _expect(isinstance(steps, list) and 0 < len(steps) <= MAX_STEPS, "steps", f"1 to {MAX_STEPS} steps")
    size = 7 * n + 6 * int(np.sum(arrays["length"] > 0))
    for k, step in enumerate(steps):
        _expect(isinstance(step, list) and len(step) == 1 + size and type(step[0]) is int and step[0] > 0,
                f"steps[{k}]", f"a positive length, then {size} lists of coefficients")  # fmt: skip
        for row in step[1:]:
            fits = isinstance(row, list) and len(row) <= MAX_ORDER + 1 and all(type(c) is int for c in row)
            _expect(fits, f"steps[{k}]", f"lists of at most {MAX_ORDER + 1} integers")
    return Certificate(arrays, times.tolist(), exponent, bits, steps, str(data.get("scenario", "")))


def _expect(condition: bool, field: str, valid: str) -> None:
    if not condition:
        raise MalformedCertificate(f"{field}: expected {valid}")


def _integer(data: dict[str, Any], field: str, low: int, high: int) -> int:
    value = data.get(field)
    _expect(type(value) is int and low <= value <= high, field, f"an integer from {low} to {high}")
    return int(value)  # type: ignore[arg-type]


def _doubles(data: dict[str, Any], field: str, shape: tuple[int, ...]) -> Array:
    """Array of doubles from nested lists of hexadecimal texts; the shape (-1,) stands for any length."""
    try:
        texts = np.array(data.get(field), dtype=object)
        numbers = np.array([float.fromhex(text) for text in texts.ravel()])
    except (ValueError, TypeError, OverflowError):
        texts = numbers = np.array(math.nan)
    fits = texts.ndim == 1 if shape == (-1,) else texts.shape == shape
    _expect(
        fits and bool(np.all(np.isfinite(numbers))), field, f"finite doubles as '0x1.8p+0', shape {shape}"
    )
    return numbers.reshape(shape)


# --- functions of s with derivatives ------------------------------------------------------------------


def _fold(poly: Any, degree: int) -> Any:
    """Inequality (1): a polynomial of at most this degree that encloses what ``poly`` encloses."""
    if poly.degree() <= degree:
        return poly
    return poly.truncate(degree + 1) + UNIT * poly.right_shift(degree + 1)(UNIT)


class _Dual:
    """An enclosed function of s and its enclosed partial derivatives by some variables (others: zero)."""

    __slots__ = ("degree", "slopes", "value")

    def __init__(self, value: Any, degree: int, slopes: dict[int, Any] | None = None) -> None:
        self.value, self.degree, self.slopes = value, degree, slopes or {}

    def __add__(self, other: Any) -> _Dual:
        if not isinstance(other, _Dual):
            return _Dual(self.value + other, self.degree, self.slopes)
        return _Dual(self.value + other.value, self.degree, _sum_of_slopes(self.slopes, other.slopes))

    def __neg__(self) -> _Dual:
        return _Dual(-self.value, self.degree, {k: -slope for k, slope in self.slopes.items()})

    def __sub__(self, other: Any) -> _Dual:
        return self.__add__(-other)

    def __mul__(self, other: Any) -> _Dual:
        d = self.degree
        if not isinstance(other, _Dual):  # a constant
            slopes = {} if other == 0 else {k: slope * other for k, slope in self.slopes.items()}
            return _Dual(self.value * other, d, slopes)
        left = {k: _fold(slope * other.value, d) for k, slope in self.slopes.items()}
        right = {k: _fold(self.value * slope, d) for k, slope in other.slopes.items()}
        return _Dual(_fold(self.value * other.value, d), d, _sum_of_slopes(left, right))

    __rmul__ = __mul__


def _sum_of_slopes(a: dict[int, Any], b: dict[int, Any]) -> dict[int, Any]:
    return a | {k: a[k] + slope if k in a else slope for k, slope in b.items()}


def _rotation(p: Array) -> Array:
    """Return A(p), homogeneous and quadratic: a rotation where |p| = 1."""
    w, x, y, z = p
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    xy, wz, xz, wy, yz, wx = x * y * 2, w * z * 2, x * z * 2, w * y * 2, y * z * 2, w * x * 2
    rows = [[ww + xx - yy - zz, xy - wz, xz + wy], [xy + wz, ww - xx + yy - zz, yz - wx],
            [xz - wy, yz + wx, ww - xx - yy + zz]]  # fmt: skip
    return np.array(rows, dtype=object)


# --- the mechanism ------------------------------------------------------------------------------------


class _Mechanism:
    """The model in the certificate's unit of time; vectors are NumPy arrays of balls or of `_Dual`."""

    def __init__(self, certificate: Certificate) -> None:
        to_ball = np.frompyfunc(arb, 1, 1)
        self.unit: Any = arb(2) ** certificate.time_exponent
        self.data: dict[str, Any] = {  # exact: powers of two
            name: to_ball(x) * self.unit ** TIME_POWERS.get(name, 0) for name, x in certificate.data.items()
        }
        self.rods = certificate.data["length"] > 0
        self.has_drag = bool(np.any(certificate.data["drag_force"]))
        self.n = len(self.rods)
        self.nq, self.nv = (int(size * self.n + 3 * np.sum(self.rods)) for size in (4, 3))

    def split(self, x: Sequence[_Dual], size: int) -> tuple[list[Array], list[Array]]:
        """Per body its part (size,) of q, v or v̇ and that of its rod (3,), zero for a ball joint."""
        own, of_rod, rest = [], [], list(x)
        for rod in self.rods:
            own.append(np.array(rest[:size]))
            of_rod.append(np.array(rest[size : size + 3] if rod else [rest[0] * arb(0)] * 3))
            rest = rest[size + 3 * rod :]
        return own, of_rod

    def centres(self, A: list[Array], rod: list[Array], turn: Callable[[int, Array], Array]) -> list[Array]:
        """Positions, velocities or accelerations of the centres of mass, from u, u̇ or ü and A turn(k, s)."""
        found: list[Array] = []
        tip = 0 * rod[0]
        for k in range(self.n):
            hang = tip + rod[k] * self.data["length"][k] if self.rods[k] else tip
            found.append(hang - A[k] @ turn(k, self.data["proximal"][k]))
            tip = found[k] + A[k] @ turn(k, self.data["distal"][k])
        return found

    def velocities(self, A: list[Array], w: list[Array], udot: list[Array]) -> list[Array]:
        """Return ṙ of the centres of mass."""
        return self.centres(A, udot, lambda k, s: np.cross(w[k], s))

    def equations(self, y: Sequence[_Dual], vdot: Sequence[_Dual]) -> tuple[list[_Dual], list[_Dual]]:
        """Return q̇ (nq,) and the residual G(y, v̇) (nv,)."""
        (p, u), (w, udot), (wdot, uddot) = (
            self.split(y[: self.nq], 4), self.split(y[self.nq :], 3), self.split(vdot, 3)
        )  # fmt: skip
        A = [_rotation(x) for x in p]
        a = self.centres(A, uddot, lambda k, s: np.cross(wdot[k], s) + np.cross(w[k], np.cross(w[k], s)))
        v = self.velocities(A, w, udot) if self.has_drag else a
        qdot: list[_Dual] = []
        residual: list[_Dual] = []
        F = 0 * a[0]
        for k in reversed(range(self.n)):
            length, m, J, s, t, f, n, c, d = (self.data[name][k] for name in list(SHAPES)[1:10])
            below, F = F, F + a[k] * m - (self.data["gravity"] * m + f)
            F = F + v[k] * c if self.has_drag else F
            G = J @ wdot[k] + np.cross(w[k], J @ w[k]) + w[k] * d - n
            G = [*(G - np.cross(s, A[k].T @ F) + np.cross(t, A[k].T @ below))]
            half = w[k] * arb(0.5)
            rate = [-(p[k][1:] @ half), *(half * p[k][0] + np.cross(p[k][1:], half))]
            if self.rods[k]:
                along = (u[k] @ uddot[k] + udot[k] @ udot[k]) * (m * length) - u[k] @ F
                G, rate = [*G, *(F + u[k] * along)], [*rate, *udot[k]]
            qdot, residual = rate + qdot, G + residual
        return qdot, residual


# --- matrices of functions of s: lists of DEGREE + 1 coefficient matrices -------------------------------


def _matrix(x: Array) -> Any:
    """Balls of a matrix of doubles, exactly."""
    return arb_mat(x.shape[0], x.shape[1], [arb(float(c)) for c in x.ravel()])


def _column(x: Sequence[Any]) -> Any:
    """Balls as a column."""
    return arb_mat(len(x), 1, list(x))


def _midpoints(x: Any) -> Array:
    """Doubles near the midpoints, for guesses."""
    return np.array([float(c.mid()) for c in x.entries()]).reshape(x.nrows(), x.ncols())


def _jacobian(functions: Sequence[_Dual], variables: range) -> list[Any]:
    """Partial derivatives of functions."""
    polys = [f.slopes.get(j, arb_poly()) for f in functions for j in variables]
    flat = [[*poly.coeffs(), *[arb(0)] * (DEGREE - poly.degree())] for poly in polys]
    return [arb_mat(len(functions), len(variables), [c[k] for c in flat]) for k in range(DEGREE + 1)]


def _product(a: list[Any], b: list[Any]) -> list[Any]:
    """Product, with inequality (1) for the terms above the degree."""
    found = [sum((a[i] * b[k - i] for i in range(1, k + 1)), a[0] * b[k]) for k in range(DEGREE + 1)]
    above = arb_mat(b[0].nrows(), b[0].ncols())  # bound of the terms of b above the degree less i
    for i in range(1, DEGREE + 1):
        above = above + _magnitude([b[DEGREE + 1 - i]])
        found[0] = found[0] + _magnitude([a[i]]) * above * SIGN
    return found


def _magnitude(a: list[Any]) -> Any:
    """Balls around upper bounds over s ∈ [0, 1] of the absolute values of the entries: Σ |coefficients|."""
    bounds = [arb_mat(x.nrows(), x.ncols(), [c.abs_upper() for c in x.entries()]) for x in a]
    return sum(bounds[1:], bounds[0])


def _norm(a: Any) -> Any:
    """Upper bound of the Frobenius norm; NaN and infinity propagate."""
    return sum((x * x for x in a.entries()), arb(0)).sqrt().upper()


def _identity_minus(a: list[Any]) -> list[Any]:
    """I − a."""
    return [_matrix(np.eye(a[0].nrows())) - a[0], *(-x for x in a[1:])]


def _stack(above: Any, below: Any) -> Any:
    """One matrix above another."""
    return arb_mat(above.nrows() + below.nrows(), above.ncols(), [*above.entries(), *below.entries()])


def _inverse_guess(x: Array) -> Array:
    """Inverse in doubles, NaN where there is none."""
    try:
        return np.linalg.inv(x)
    except np.linalg.LinAlgError:
        return np.full(x.shape, math.nan)


# --- one step -----------------------------------------------------------------------------------------


def _bound_defect(
    mechanism: _Mechanism, y: list[Any], vdot: list[Any], h: Any
) -> tuple[list[Any], list[Any]]:
    """(2): bounds over the step of h q̇ − q̃′ and of g = G(ỹ, ṽ′/h)."""
    degree = max(poly.degree() for poly in y)
    qdot, g = mechanism.equations([_Dual(x, degree) for x in y], [_Dual(x, degree) for x in vdot])
    kinematic = [x.value * h - poly.derivative() for x, poly in zip(qdot, y[: mechanism.nq], strict=True)]
    return [abs(x(UNIT)).upper() for x in kinematic], [abs(x.value(UNIT)).upper() for x in g]


def _linearise(
    mechanism: _Mechanism, y: list[Any], vdot: list[Any], tube: Any, beta: Any, g: list[Any]
) -> tuple[list[Any], Any, Any]:
    """(3), (4): J = ∂ẏ/∂y over the tube, a bound of each entry of M⁻¹g, and the β that (4) needs."""
    n, nv = len(y), mechanism.nv
    one = arb_poly([1])
    qdot, residual = mechanism.equations(
        [_Dual(_fold(x, DEGREE) + tube * SIGN, DEGREE, {i: one}) for i, x in enumerate(y)],
        [_Dual(_fold(x, DEGREE) + beta * SIGN, DEGREE, {n + i: one}) for i, x in enumerate(vdot)],
    )
    K, D, M = (
        _jacobian(qdot, range(n)), _jacobian(residual, range(n)), _jacobian(residual, range(n, n + nv))
    )  # fmt: skip
    guess = [_midpoints(x) for x in M]
    series = [_inverse_guess(guess[0])]  # of M⁻¹
    for k in range(1, DEGREE + 1):
        series.append(-series[0] @ np.sum([guess[i] @ series[k - i] for i in range(1, k + 1)], axis=0))
    C = [_matrix(x) for x in series]
    theta = _norm(_magnitude(_identity_minus(_product(C, M))))
    _require(theta < 1, "inequality (3): M is not proved to be invertible over the step")
    CD = _product(C, D)
    CD[0] = CD[0] + arb_mat(nv, n, [theta / (1 - theta) * _norm(_magnitude(CD)) * SIGN] * (nv * n))
    J = [_stack(k, -x) for k, x in zip(K, CD, strict=True)]
    moved = [x + tube * sum(row, arb(0)) for x, row in zip(g, _magnitude(D).tolist(), strict=True)]
    defect, needed = (_norm(_magnitude(C) * _column(x)) / (1 - theta) for x in (g, moved))
    return J, defect, needed


def _fundamental_guesses(J: list[Array]) -> tuple[list[Array], list[Array]]:
    """Power series of Ψ′ = J Ψ and Φ′ = −Φ J from I, in doubles."""
    psi, phi = [np.eye(len(J[0]))], [np.eye(len(J[0]))]
    for k in range(DEGREE):
        psi.append(np.sum([J[i] @ psi[k - i] for i in range(k + 1)], axis=0) / (k + 1))
        phi.append(-np.sum([phi[k - i] @ J[i] for i in range(k + 1)], axis=0) / (k + 1))
    return psi, phi


@dataclass(frozen=True, eq=False)
class _Ellipsoid:
    """The set of errors T w with ‖w‖ ≤ radius."""

    T: Any
    Q: Any  # approximate inverse of T
    theta: Any  # ≥ ‖I − Q T‖, below 1
    radius: Any


def _make_ellipsoid(T: Array, bound: Callable[[Any], Any]) -> _Ellipsoid:
    """Return the ellipsoid of T; ``bound`` maps Q to a bound ‖Q e‖ of all errors e to be covered."""
    exact, Q = _matrix(T), _matrix(_inverse_guess(T))
    theta = _norm(_identity_minus([Q * exact])[0])
    _require(theta < 1, "inequality (5): Q is no approximate inverse of T")
    return _Ellipsoid(exact, Q, theta, (bound(Q) / (1 - theta)).upper())


def _prove_step(
    mechanism: _Mechanism, y: list[Any], h: Any, start: _Ellipsoid, bits: int
) -> tuple[list[Any], Any]:
    """(2)–(6): Ψ T, and ρ′ with e(s) ∈ Ψ(s) T w, ‖w‖ ≤ ρ′, on the step."""
    with ctx.workprec(bits):
        vdot = [poly.derivative() * (1 / h) for poly in y[mechanism.nq :]]
        kinematic, g = _bound_defect(mechanism, y, vdot, h)
    tube = arb(max(MIN_TUBE, 1024 * float(_norm(start.T)) * float(start.radius)))
    beta = tube * 2**14
    for _ in range(6):
        J, defect, needed = _linearise(mechanism, y, vdot, tube, beta, g)
        if needed <= beta:
            break
        beta = 4 * needed
    else:
        raise Rejected("inequality (4): the accelerations leave their tube")
    J = [x * h for x in J]
    Psi, Phi = ([_matrix(x) for x in guess] for guess in _fundamental_guesses([_midpoints(x) for x in J]))
    R = [-x for x in _product(J, Psi)]
    for k in range(DEGREE):
        R[k] = R[k] + Psi[k + 1] * (k + 1)
    T = _magnitude([start.T])
    theta = _norm(_magnitude([start.Q]) * _magnitude(_identity_minus(_product(Phi, Psi))) * T) / (
        1 - start.theta
    )
    _require(theta < 1, "inequality (5): Φ is no approximate inverse of Ψ")
    W = _magnitude([start.Q * x for x in Phi])
    a, b = (
        _norm(W * x) / ((1 - start.theta) * (1 - theta))
        for x in (_magnitude(R) * T, _column([*kinematic, *[defect * h] * mechanism.nv]))
    )
    radius = (a.exp() * (start.radius + b)).upper()
    PT = [x * start.T for x in Psi]
    inside = all(_norm(_column(row)) * radius < tube for row in _magnitude(PT).tolist())
    _require(inside, "inequality (6): the error leaves the tube")
    return PT, radius


def _next_ellipsoid(PT: list[Any], radius: Any, jump: Any) -> _Ellipsoid:
    """(7)."""
    X = sum(PT[1:], PT[0])  # Ψ(1) T
    try:
        U, S, _ = np.linalg.svd(_midpoints(X))
    except np.linalg.LinAlgError:
        raise Rejected("inequality (7): the ellipsoid is not finite") from None

    def bound(Q: Any) -> Any:
        B = Q * X
        sums = [sum(map(abs, row), arb(0)) for row in (B * B.transpose()).tolist()]
        largest = arb(max(map(float, sums)) * (1 + 1e-9))
        _require(all(x < largest for x in sums), "inequality (7): the ellipsoid is not finite")
        return largest.sqrt() * radius + _norm(Q * jump)

    return _make_ellipsoid(U * np.maximum(S / S[0], 1 / MAX_CONDITION), bound)


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


def enclose_motion(
    certificate: Certificate, on_step: Callable[[int, int], None] = lambda _done, _of: None
) -> Enclosure:
    """Prove the theorem for a certificate.

    Args:
        certificate: candidate motion, model and initial state.
        on_step: called after each step with the numbers of proved steps and of all.

    Returns:
        Balls at every sample time.

    Raises:
        Rejected: an inequality does not hold.

    """
    mechanism, bits = _Mechanism(certificate), certificate.bits + GUARD_BITS
    per_second = Fraction(2) ** (certificate.bits - certificate.time_exponent)
    remaining, samples, at = [Fraction(t) * per_second for t in certificate.times], [], 0
    with ctx.workprec(LOW_BITS):
        end = _initial_values(mechanism, bits)
        PT, radius = [_matrix(np.eye(len(end)))], arb(0)
        for k, (length, *rows) in enumerate(certificate.steps):
            y = _polynomials(rows, certificate.bits)
            with ctx.workprec(bits):
                h = arb(length) * arb(2) ** -certificate.bits
                jump = _column([x - poly(arb(0)) for x, poly in zip(end, y, strict=True)])
                end = [poly(arb(1)) for poly in y]
            try:
                PT, radius = _prove_step(mechanism, y, h, _next_ellipsoid(PT, radius, jump), bits)
            except Rejected as error:
                raise Rejected(f"step {k + 1} of {len(certificate.steps)}: {error}") from None
            while remaining and remaining[0] <= at + length:  # exact
                s = (remaining.pop(0) - at) / length
                samples.append(_sample(mechanism, y, PT, radius, fmpq(s.numerator, s.denominator), bits))
            at += length
            on_step(k + 1, len(certificate.steps))
    _require(not remaining, f"the steps end at {float(at / per_second):g} s, before the last sample")
    return Enclosure(certificate.times, *(np.array(x, dtype=object) for x in zip(*samples, strict=True)))


def _polynomials(rows: list[list[int]], bits: int) -> list[Any]:
    """Polynomials of one step, exact."""
    with ctx.workprec(max(c.bit_length() for row in rows for c in [*row, 1]) + 2):
        return [arb_poly([arb(c) * arb(2) ** -bits for c in row]) for row in rows]


def _initial_values(mechanism: _Mechanism, bits: int) -> list[Any]:
    """y(0), normalised, in the certificate's unit of time."""
    q: list[Any] = []
    v: list[Any] = []
    with ctx.workprec(bits):
        for k, rod in enumerate(mechanism.rods):
            p, w, u, udot = (mechanism.data[name][k] for name in ("p", "omega", "u", "udot"))
            q, v = [*q, *(p / (p @ p).sqrt())], [*v, *w]
            if rod:
                u = u / (u @ u).sqrt()
                q, v = [*q, *u], [*v, *(udot - u * (u @ udot))]
    return [*q, *v]


def _sample(
    mechanism: _Mechanism, y: list[Any], PT: list[Any], radius: Any, s: Any, bits: int
) -> list[list[list[Any]]]:
    """Balls r, p, ṙ, ω′ of every body at s; |p| = |u| = 1, so that nothing is normalised."""
    at = sum((x * arb(s) ** k for k, x in enumerate(PT[1:], 1)), PT[0])
    spread = [_norm(_column(row)) * radius * SIGN for row in at.tolist()]
    with ctx.workprec(bits):
        z = [poly(arb(s)) + e for poly, e in zip(y, spread, strict=True)]
        (p, u), (w, udot) = mechanism.split(z[: mechanism.nq], 4), mechanism.split(z[mechanism.nq :], 3)
        A = [_rotation(x) for x in p]
        r, v = mechanism.centres(A, u, lambda _, s: s), mechanism.velocities(A, w, udot)
        return [
            [[*x] for x in r],
            [[*x] for x in p],
            *([[*(x / mechanism.unit)] for x in rate] for rate in (v, w)),
        ]


def main(paths: Sequence[str]) -> int:
    """Check files without the rest of the project: ``python enclosure_checker.py FILE…``.

    Args:
        paths: certificates.

    Returns:
        0; a file that is not proved raises `Rejected` or `MalformedCertificate`.

    """
    for path in paths:
        enclosure = enclose_motion(parse_certificate(Path(path).read_bytes()))
        print(f"{path}: proved to {enclosure.times[-1]:g} s, positions to {enclosure.radius('r'):.2g} m")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
