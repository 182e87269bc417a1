"""Check a certificate of a motion and enclose the motion: a proof that is read from the top.

This file imports numpy, python-flint, the standard library, and what reads the file, `certificate_file`,
which imports numpy and the standard library only. Inequality (2), the jumps in (7) and the result are
evaluated in balls (python-flint), whose radii enclose every rounding; the other bounds in doubles by the
rules (F). Guesses (inverses, singular vectors, a fundamental matrix) need no trust: a wrong one makes a
check fail and cannot make a false statement pass. Nor does the program that wrote the certificate.

THE MECHANISM. A tree of N bodies with the doubles of the file as its numbers. Joint k holds body k at its
near point s_k on a body before it or on the world, the far body, at its far point t_k:

  rod, ball   by a massless rod of length l_k and direction u_k with ball joints at its ends; by a ball joint;
  free        by nothing: l_k u_k is the place of s_k from t_k, and the far body is the world;
  others      in axes of the joint, which `turn` sets in either body: slide, moved by x along z; hinge, turned
              by x about z; cylindrical, both; universal, turned about x and then about y; weld, neither.

Its state y = (q, v) has as q per joint the Euler parameters p of a body on a rod or ball or free, u, each
coordinate x, cos x and sin x of each turn, σ = φ² and γ = φ/(6 sin φ) of a ball with a spring (k ≠ 0), and
at last λ = 1/|d| of each spring between points, d from its first point to its second; as v the rate ω of
such a body in its own axes, u̇ and ẋ. Where `turn` sets the axes f_i in the far and h_i in the near body of
a ball, the turn from f_i to h_i is φ about a unit vector z, 0 ≤ φ < π: ψ = z sin φ = ½ Σ f_i × h_i and cos
φ = ½ (Σ f_iᵀh_i − 1), here in axes of the near body. With A the rotation of a body (the homogeneous
quadratic A(p), or what the turns make of the far body's), and sums over the joints j on it,

  m r̈ = m g + f − c ṙ + F_k − Σ F_j + Σ pulls,
  J ω̇ + ω × J ω + d ω = n + N_k + s × AᵀF_k − Σ (N_j + t_j × AᵀF_j) + Σ moments of pulls

define the force F_k (world axes) and moment N_k (body axes, about s_k) of joint k on body k; N_j turns with
its axes, t_j moves with the slide, and N_j = 0 for rods, free bodies and balls without elements. A spring
between points pulls by (k (1 − l₀ λ) + c λ² dᵀḋ) d = (k (|d| − l₀) + c |d|˙) d/|d|. v̇ solves G(y, v̇) = 0,
which is

  N = 0                                          for each rod, free body and ball without elements,
  N + a (ω̇ − ω̇₀ − ω₀ × ω) + c (ω − ω₀) + 6 k γ ψ = 0   for a ball, ω₀ and ω̇₀ of the far body,
  F − u (uᵀF) + m l u (uᵀü + u̇ᵀu̇) = 0           for each rod,
  F = 0                                          for each free body,
  e·F or e·N + a ẍ + c ẋ + k (x − x₀) − τ = 0    for each x along or about an axis e:

Newton's and Euler's equations with rotors, dampers, springs and efforts (a, c, k, τ; the spring of a ball
has the moment −k φ z, and 6 γ ψ = φ z), with F_k along u_k and |u_k| = 1. G is polynomial, and affine in
v̇: G = M(y) v̇ + G(y, 0). The kinematic equations are ṗ = ½ L(p)ᵀω, du/dt = u̇, dx/dt = ẋ, (cos x)˙ = −ẋ
sin x, (sin x)˙ = ẋ cos x, λ˙ = −λ³ dᵀḋ, σ̇ = 12 γ ψᵀ(ω − ω₀) and γ̇ = γ² f₀(σ) σ̇, polynomial but for the
entire function f₀ = −6 S′, S(φ²) = sin φ/φ. They conserve |p|; their only solutions from cos x, sin x,
1/|d|, φ² and φ/(6 sin φ) are these, the last two as long as φ < π; where |u| = 1 and uᵀu̇ = 0 they and G =
0 give d(uᵀu̇)/dt = 0 for rods, so that a solution that starts there stays there and is the motion.

THEOREM. Let y(t) solve these equations with y(0) the state of the file, normalised exactly: p/|p|, u/|u|
and u̇ − u (uᵀu̇) of rods, turn/|turn|. If `enclose_motion` returns, y exists up to the last sample time, no
ball with a spring comes to half a turn φ = π, where its moment jumps, and at every sample time each
position, attitude, velocity and rate lies in the ball that is returned.

PROOF.  The file has a unit of time, a power of two [s], into which every number is converted exactly.  On a
step of length h let s ∈ [0, 1], t = t_k + h s, ỹ(s) the polynomials of the file, e = y − ỹ, ′ = d/ds.  ‖·‖ is
the Euclidean norm of vectors and the Frobenius norm of matrices, |·| the absolute value of each entry, its
largest for s ∈ [0, 1] where it bounds a function.

 (F) Floating point. Assumed is that each operation of doubles is off by at most 2⁻⁵² of its result, or by
     2⁻¹⁰²² where it underflows (true of every direction of rounding), and that NumPy evaluates a product
     of arrays as sums of products, added in any order. Then a sum of K ≤ 2¹⁵ products is off by at most
     2⁻⁵¹ K Σ|products| + 2⁻¹⁰⁰⁰, one product also where a factor (a number of the file or six times it, an
     entry of a joint's axes, or of (8)) is off by 2⁻⁵³ (1 + 2⁻⁷) of itself; and an expression of numbers ≥
     0, of at most ten nested sums, products, quotients and roots, by 2⁻³⁰ of itself and 2⁻¹⁰⁰⁰: `round_up`.
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
 (6) e stays in the tube: ‖P‖ ρ⁺ < ε. It starts there, and e is continuous: it cannot leave before
     s = 1, and y exists up to there because M has an inverse in the tube.
 (7) Next step, with T = P⁺(0) and Q an approximate inverse, ‖I − Q T‖ ≤ θ″ < 1: e(0) = X w(1) + j, X =
     P(1), with the jump j = ỹ(1) − ỹ⁺(0) (at the start: j = y(0) − ỹ⁺(0), ρ⁺ = 0) is T w⁺(0), and ‖w⁺(0)‖
     ≤ (√(largest row sum of |B Bᵀ|) ρ⁺ + ‖|Q| |j|‖)/(1 − θ″) with B = Q X.
 (8) f_n(σ) = 1 − σ f_{n+1}(σ)/(2 (n + 1)(2 n + 5)), f₀ = Σ 6 (n + 1)(−σ)ⁿ/(2 n + 3)!. For |σ| ≤ 10 and N ≥
     1 |f_N − 1| ≤ 10/28 + (10/28)² + … < 1: along the motion f_N(σ(s)) is a function of s, r(s) = 1 ± 1.
     With it in place of f_N the equations are polynomial, and the motion solves them: (2) encloses them at
     ỹ for every such r, (3) their derivatives for the number r(s), which does not depend on y. |σ| < 9.86
     must hold in the tube of (3), which is below π² and 10: before φ came to π, σ would have left it. In (2)
     the powers of s above the last of σ̃ stand in each f_n(σ̃) as a function of s in the ball of their sum.

Comparisons reject unless they hold: never for NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb, arb_poly, ctx

from plumbline.truth.certificate_file import JOINTS, SHAPES, Array, Certificate

DEGREE, GUARD_BITS = 11, 18  # of the linear part (R falls with h¹²); of (2) beyond the certificate's own
MIN_TUBE, MAX_CONDITION, FAST = 2.0**-44, 100.0, 256.0  # of ε, of T, and of rates where steps are short
ROUNDING, TINY = 2.0**-51, 2.0**-1000  # of (F)
MAX_SIGMA, UNIT = 9.86, arb(0.5, 0.5)  # of (8), below π²; [0, 1]


class Rejected(ArithmeticError):
    """The certificate proves nothing; the message names the step and the inequality that does not hold."""


def _require(holds: Any, failure: str) -> None:
    if not holds:
        raise Rejected(failure)


# --- functions of s -----------------------------------------------------------------------------------


def round_up(x: Any) -> Any:
    """(F): an upper bound of an expression of numbers ≥ 0 that was evaluated in doubles."""
    return x * (1 + 2.0**-30) + TINY


def norm_bound(bounds: Array, axis: int | None = None) -> Any:
    """Upper bound of the Frobenius norm, or of the Euclidean norms along an axis."""
    return round_up(np.sqrt(round_up(np.sum(bounds * bounds, axis))))


def upper_bounds(balls: Iterable[Any]) -> Array:
    """Doubles above the absolute values of balls."""
    return np.array([round_up(float(abs(ball).upper())) for ball in balls])


class Series:
    """(F), (1): a matrix of functions of s, each within r of c₀ + c₁ s + … + c_D s^D, where D = DEGREE.

    c has the shape (D + 1, rows, columns), r (rows, columns).  `@` is the product of matrices; `*` is that of
    two functions, each stored with its partial derivatives as one row: value, derivatives.
    """

    def __init__(self, c: Array, r: Any = 0.0, roundings: int = 0) -> None:
        self.c, self.total = c, np.abs(c).sum(0)
        self.r = round_up(r + roundings * ROUNDING * self.total) if roundings else r + 0 * self.total

    @property
    def size(self) -> Array:
        """Upper bounds of the absolute values on [0, 1]."""
        return round_up(self.total + self.r)  # type: ignore[no-any-return]

    def block(self, rows: slice, columns: slice = slice(None)) -> Series:
        """Some rows and columns."""
        return Series(self.c[:, rows, columns], self.r[rows, columns])

    def __neg__(self) -> Series:
        return Series(-self.c, self.r)

    def __add__(self, other: Any) -> Series:
        if not isinstance(other, Series):  # a constant, whose derivatives are zero
            other = constant_series(np.eye(1, self.c.shape[2]) * other)
        return Series(self.c + other.c, self.r + other.r, 1)

    def __sub__(self, other: Any) -> Series:
        return self.__add__(-other)

    def __matmul__(self, other: Series) -> Series:
        full = convolution(self.c, other.c)
        rounding = ROUNDING * (DEGREE + 1) * self.c.shape[2] * other.total
        r = self.total @ (other.r + rounding) + self.r @ (other.total + other.r)
        return Series(full[: DEGREE + 1], round_up(r + np.abs(full[DEGREE + 1 :]).sum(0)))

    def __mul__(self, other: Any) -> Series:
        if not isinstance(other, Series):  # a constant
            return Series(self.c * other, self.r * abs(other), 1)
        c, r = (np.concatenate([getattr(x, name)[..., :1] for x in (self, other)], -1) for name in ("c", "r"))
        slopes = 1 - np.eye(1, self.c.shape[2])  # of self, whose value `other` has
        return Series(c, r) @ _join([other, Series(self.c * slopes, self.r * slopes)])

    __rmul__ = __mul__


def convolution(a: Array, b: Array) -> Any:
    """Coefficients (2 DEGREE + 1, m, n) of the product of two matrix polynomials."""
    m, shape = len(a), (a.shape[1], b.shape[2])
    products = np.zeros((m, 2 * m, *shape))
    np.matmul(a[:, None], b, out=products[:, :m])
    return products.reshape(-1, *shape)[: m * (2 * m - 1)].reshape(m, -1, *shape).sum(0)  # row i starts at i


def constant_series(matrix: Array) -> Series:
    """Make the series of a matrix that does not change."""
    return Series(np.concatenate([matrix[None], np.zeros((DEGREE, *matrix.shape))]))


def _join(parts: Sequence[Series]) -> Series:
    """Rows below rows."""
    return Series(np.concatenate([x.c for x in parts], 1), np.concatenate([x.r for x in parts]))


def recurrence(J: Array, first: Array, power: int) -> Array:
    """Coefficients P_0, P_1, … with k**power P_k = J_0 P_(k−1) + J_1 P_(k−2) + … and P_0 given."""
    P = [first]
    for k in range(1, DEGREE + 1):
        P.append(sum(J[i] @ P[k - 1 - i] for i in range(k)) / k**power)
    return np.array(P)


def inverse_guess(a: Array) -> Array:
    """Coefficients of the inverse of a matrix polynomial."""
    return recurrence(-np.linalg.inv(a[0]) @ a[1:], np.linalg.inv(a[0]), 0)


def inverse_error(a: Series, b: Series, failure: str) -> float:
    """Bound of ‖I − a b‖, which must be below 1."""
    theta = norm_bound((constant_series(np.eye(len(a.r))) - a @ b).size)
    _require(theta < 1, failure)
    return float(theta)


def _vector(x: Iterable[Any]) -> Array:
    """Array of objects, also of those that NumPy would take for sequences."""
    return np.fromiter(x, object)


def _times(a: Array, b: Array) -> Any:
    """Return the product of quaternions."""
    return _vector([a[0] * b[0] - a[1:] @ b[1:], *(a[:1] * b[1:] + b[:1] * a[1:] + np.cross(a[1:], b[1:]))])


def _turned(x: Array, axis: int, cosine: Array, sine: Array) -> Array:
    """Components, the rows of x, in axes turned about one of them."""
    (j, k), found = np.add.outer([1, 2], [axis]) % 3, x.copy()
    found[j], found[k] = x[j] * cosine + x[k] * sine, x[k] * cosine - x[j] * sine
    return found


def _rotation(p: Array) -> Array:
    """Return A(p), homogeneous and quadratic: a rotation where |p| = 1."""
    (w, x, y, z), (ww, xx, yy, zz) = p, p * p
    xy, wz, xz, wy, yz, wx = x * y * 2, w * z * 2, x * z * 2, w * y * 2, y * z * 2, w * x * 2
    return _vector([ww + xx - yy - zz, xy - wz, xz + wy, xy + wz, ww - xx + yy - zz, yz - wx,
                    xz - wy, yz + wx, ww - xx - yy + zz]).reshape(3, 3)  # fmt: skip


# --- the mechanism ------------------------------------------------------------------------------------


class Mechanism:
    """The model in the certificate's unit of time; vectors are arrays of balls, polynomials or `Series`."""

    def __init__(self, file: Certificate, number: Callable[[Any], Any]) -> None:
        self.far, self.springs, self.joints = file.far, file.springs, [(k, *JOINTS[k]) for k in file.kind]
        self.nq, self.nv, self.sizes, self.unit = file.nq, file.nv, file.sizes, arb(2) ** file.time_exponent
        self.exact, self.needs_rates = number is arb, bool(np.any(file.data["drag_force"]) or file.springs)
        # exact, because the unit is a power of two
        data: Any = {x: np.frompyfunc(arb, 1, 1)(c) / self.unit ** SHAPES[x][1] for x, c in file.data.items()}
        data["axes"] = np.array([[_rotation(q) / (q @ q) for q in pair] for pair in data["turn"]])
        _require(all(x.rel_accuracy_bits() > 60 for x in data["axes"].ravel()), "turn: axes too inexact")
        # of (8), by n + 1
        self.terms = [number(-1) / (4 * n * n + 6 * n) for n in range(1, ctx.prec // 6 if self.exact else 13)]
        self.data: dict[str, Any] = {name: np.frompyfunc(number, 1, 1)(x) for name, x in data.items()}
        self.unknown = arb(0, 1) if self.exact else Series(np.zeros((DEGREE + 1, 1, 1)), 1.0)  # 0 ± 1 of (8)

    def equations(self, y: Sequence[Any], vdot: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        """Return q̇ (nq,) and the residual G(y, v̇) (nv,)."""
        z, data, qdot, residual = Motion(self, y, vdot), self.data, list[Any](), list[Any]()
        a, v = z.centres(2), z.centres(1) if self.needs_rates else []
        F, N = [z.zero] * len(z.A), [z.zero] * len(z.A)  # of springs and of the joints beyond, on each body
        for j, (d, ddot) in enumerate(zip(z.spans(0), z.spans(1), strict=True)):
            k, c, rest = (data[f"spring_{name}"][j] for name in ("stiffness", "damping", "length"))
            inverse = y[self.nq - len(self.springs) + j]
            change = inverse * inverse * (d @ ddot)
            qdot, pull = [*qdot, -(inverse * change)], d * _vector([(inverse * -rest + 1) * k + change * c])
            for b, s, f in zip(self.springs[j], data["spring_point"][j], (pull, -pull), strict=True):
                F[b], N[b] = F[b] - f, N[b] - np.cross(s, z.A[b].T @ f)
        for k, far in reversed([*enumerate(self.far)]):
            m, J, (_, s), f, n, c, d, length, *elements = (data[x][k] for x in list(SHAPES)[1:14])
            A, B, w, wdot, axes, rows = z.A[k], z.A[far], z.w[k], z.wdot[k], data["axes"][k], list[Any]()
            (p, u, x, functions), (_, udot, xdot, _), (_, uddot, xddot, _) = (part[k] for part in z.parts)
            F[k] = F[k] + (a[k] - data["gravity"]) * m - f + (v[k] * c if self.needs_rates else 0)
            N[k] = N[k] + J @ wdot + np.cross(w, J @ w) + w * d - n - np.cross(s, A.T @ F[k])
            rates, moment = [*udot, *xdot], z.zero
            if len(p):
                rates, rows = [*_times(p, _vector([0, *(w * 0.5)])), *rates], [*N[k]]
                armature, damping, stiffness, *_ = (x[0] for x in elements)
                if armature != 0 or damping != 0 or stiffness != 0:
                    w0, wdot0, moment = A.T @ (B @ z.w[far]), A.T @ (B @ z.wdot[far]), B.T @ (A @ N[k])
                    rows = [*(N[k] + (wdot - wdot0 - np.cross(w0, w)) * armature + (w - w0) * damping)]
                if len(functions):
                    (σ, γ), bend = functions, z.bend(k)[0]
                    change, f = γ * (bend @ (w - w0)) * 12, σ * 0 + self.unknown + 1
                    for term in self.terms[::-1]:
                        f = σ * f * term
                        f = (f.truncate(len(σ)) + f.right_shift(len(σ))(UNIT) * UNIT if self.exact else f) + 1
                    _require(self.exact or σ.size[0, 0] < MAX_SIGMA, "inequality (8): near half a turn")
                    rates += [change, γ * γ * change * f]
                    rows = [*(_vector(rows) + bend * _vector([γ * (stiffness * 6)]))]
            else:
                moment = axes[1].T @ N[k]
                for i, (cosine, sine), *_ in reversed(z.turns[k]):
                    rows, moment = [moment[i], *rows], _turned(moment, i, cosine, -sine)
                along, moment = axes[0][:, 2] @ (B.T @ F[k]), axes[0] @ moment
                every = zip([along] * self.joints[k][3] + rows, x, xdot, xddot, *elements, strict=False)
                rows = [g + ẍ * a + ẋ * c + (x - x0) * k - τ for g, x, ẋ, ẍ, a, c, k, x0, τ in every]
            if len(u):
                along = (u @ uddot + udot @ udot) * m * length - u @ F[k] if self.joints[k][0] == "rod" else 0
                rows += [*(F[k] + u * _vector([along]))]
            F[far], N[far] = F[far] + F[k], N[far] + moment + np.cross(z.tips[k][0], B.T @ F[k])
            rates += [x for _, (cos, sin), ẋ, _ in z.turns[k] for x in (-(sin * ẋ)[0], (cos * ẋ)[0])]
            qdot, residual = rates + qdot, rows + residual
        return qdot, residual


class Motion:
    """A state and v̇; of each body, the world last as body −1, its attitude A, and ω and ω̇ in its axes."""

    def __init__(self, mechanism: Mechanism, y: Sequence[Any], vdot: Sequence[Any]) -> None:
        self.mechanism, self.zero, nq = mechanism, _vector([y[0] * 0] * 3), mechanism.nq
        parts = map(np.split, map(_vector, (y[:nq], y[nq:], vdot)), map(np.cumsum, mechanism.sizes))
        self.parts = [[x[4 * k : 4 * k + 4] for k in range(len(mechanism.far))] for x in parts]  # of q, v, v̇
        world = np.eye(3), *np.zeros((2, 3))
        self.A, self.w, self.wdot = ([self.zero + x] * (1 + len(mechanism.far)) for x in world)
        self.tips, self.turns = list[Any](), list[Any]()  # of each joint, see `arm` and below
        for k, far in enumerate(mechanism.far):
            p, w, wdot = (part[k][0] for part in self.parts)
            (first, last), (*_, slide, axes) = mechanism.data["axes"][k], mechanism.joints[k]
            tip = [first[:, 2] * part[k][2][:1] if slide else 0 for part in self.parts]
            self.tips.append([tip[0] + mechanism.data["point"][k, 0], *tip[1:]])
            rates = (part[k][2][slide:].reshape(-1, 1) for part in self.parts[1:])
            self.turns.append([*zip(axes, self.parts[0][k][3].reshape(-1, 2, 1), *rates, strict=False)])
            if len(p):
                self.A[k], self.w[k], self.wdot[k] = _rotation(p), w, wdot
                continue
            A, w, dw = (first.T @ x for x in (self.A[far].T, self.w[far], self.wdot[far]))
            for axis, (cosine, sine), rate, acc in self.turns[k]:
                A, w, dw = (_turned(x, axis, cosine, sine) for x in (A, w, dw))
                i, j, m = np.add.outer([0, 1, 2], [axis]) % 3
                dw[i], dw[j], dw[m], w[i] = dw[i] + acc, dw[j] + w[m] * rate, dw[m] - w[j] * rate, w[i] + rate
            self.A[k], self.w[k], self.wdot[k] = (last @ A).T, last @ w, last @ dw

    def bend(self, k: int) -> tuple[Any, Any]:
        """Of a ball joint, ψ and cos φ."""
        first, last = self.mechanism.data["axes"][k]
        far = self.A[k].T @ (self.A[self.mechanism.far[k]] @ first)
        return np.cross(far.T, last.T).sum(0) * 0.5, (far * last).sum() * 0.5 - 0.5

    def arm(self, k: int, level: int, s: Any, rate: Any = 0, change: Any = 0) -> Any:
        """From the centre of a body to the point s, which moves in it: place, velocity or acceleration."""
        turn = np.cross(self.w[k], s) + rate if level else s
        return turn if level < 2 else np.cross(self.wdot[k], s) + np.cross(self.w[k], turn + rate) + change

    def centres(self, level: int) -> list[Any]:
        """Places, velocities or accelerations of the centres of mass, the world's last."""
        found, data = [self.zero] * len(self.A), self.mechanism.data
        for k, far in enumerate(self.mechanism.far):
            tip, reach = self.tips[k], self.parts[level][k][1]
            hang = found[far] + (self.A[far] @ self.arm(far, level, *tip) if far >= 0 else tip[level])
            hang = hang + reach * data["length"][k] if len(reach) else hang
            found[k] = hang - self.A[k] @ self.arm(k, level, data["point"][k, 1])
        return found

    def spans(self, level: int) -> list[Any]:
        """Of each spring d or its rate, from the first point to the second."""
        centres = self.centres(level) if self.mechanism.springs else []
        ends = zip(self.mechanism.springs, self.mechanism.data["spring_point"], strict=True)
        at = [[centres[b] + self.A[b] @ self.arm(b, level, s) for b, s in zip(*x, strict=True)] for x in ends]
        return [end - start for start, end in at]


# --- one step -----------------------------------------------------------------------------------------


def bound_defect(exact: Mechanism, y: list[Any], h: Any) -> tuple[Array, Array]:
    """(2): bounds of h q̇ − q̃′ and of g."""
    qdot, g = exact.equations(y, [poly.derivative() * (1 / h) for poly in y[exact.nq :]])
    kinematic = (x * h - poly.derivative() for x, poly in zip(qdot, y[: exact.nq], strict=True))
    return upper_bounds(x(UNIT) for x in kinematic), upper_bounds(x(UNIT) for x in g)


def dual_variables(coefficients: list[Array], radii: Array) -> list[Series]:
    """Functions of s with their derivatives by each other, from coefficients that are rounded once."""
    n, found = len(coefficients), []
    for i, row in enumerate(coefficients):
        x = constant_series(np.eye(1, 1 + n, 1 + i))
        x.c[: len(row), 0, 0] = row[: DEGREE + 1]
        found.append(Series(x.c, np.eye(1, 1 + n) * round_up(radii[i] + np.abs(row[DEGREE + 1 :]).sum()), 1))
    return found


def linearise(mechanism: Mechanism, rows: list[Array], tube: float, g: Array) -> tuple[Any, Any, float]:
    """(3), (4): the derivatives of q̇ and G by y and v̇, C, and θ."""
    nq, n = mechanism.nq, mechanism.nq + mechanism.nv
    for beta in tube * 16.0 ** np.arange(3, 16):
        x = dual_variables(rows, np.repeat([tube, beta], [n, mechanism.nv]))
        qdot, residual = mechanism.equations(x[:n], x[n:])
        slopes = _join([*qdot, *residual]).block(slice(None), slice(1, None))
        D, M = slopes.block(slice(nq, None), slice(n)), slopes.block(slice(nq, None), slice(n, None))
        C = Series(inverse_guess(M.c))
        theta = inverse_error(C, M, "inequality (3): M is not proved to be invertible over the step")
        if round_up(norm_bound(C.size @ round_up(g + tube * D.size.sum(1))) / (1 - theta)) <= beta:
            return slopes, C, theta
    raise Rejected("inequality (4): the accelerations leave their tube")


def prove_step(mechanism: Mechanism, rows: list[Array], h: float, defect: Any, T: Array, rho: float) -> Any:
    """(3)–(6): P and ρ⁺."""
    q, v, n = slice(mechanism.nq), slice(mechanism.nq, None), len(T)
    tube = max(MIN_TUBE, 1024 * float(np.linalg.norm(T)) * rho)
    slopes, C, theta = linearise(mechanism, rows, tube, defect[1])
    J = np.concatenate([slopes.c[:, q, :n], -convolution(C.c, slopes.c[:, v, :n])[: DEGREE + 1]], 1)
    P = Series(recurrence(J * h, T, 1))  # P′ = h J P
    Phi = Series(inverse_guess(P.c))
    derivative = Series(np.roll(P.c * np.arange(DEGREE + 1.0)[:, None, None], -1, 0), roundings=1)
    product = slopes @ _join([P * h, derivative.block(v)])
    of_columns = norm_bound(round_up(C.size @ product.block(v).size), axis=0) / (1 - theta)
    R = [(derivative.block(q) - product.block(q)).size, np.tile(round_up(of_columns), (mechanism.nv, 1))]
    delta = [defect[0], np.full(mechanism.nv, round_up(h * norm_bound(C.size @ defect[1]) / (1 - theta)))]
    theta = inverse_error(Phi, P, "inequality (5): Φ is no approximate inverse of P")
    a, b = (round_up(norm_bound(Phi.size @ x) / (1 - theta)) for x in map(np.concatenate, (R, delta)))
    _require(a < 1, "inequality (5): the error grows too fast")
    rho = round_up((rho + b) / (1 - a))
    _require(round_up(norm_bound(P.size) * rho) < tube, "inequality (6): the error leaves the tube")
    return P, rho


def evaluate_series(P: Series, s: float) -> Series:
    """P(s), by Horner's rule, where s is rounded once."""
    return Series(constant_series(np.polyval(P.c[::-1], s)).c, round_up(4 * DEGREE * ROUNDING * P.total))


def next_ellipsoid(X: Series, rho: float, jump: Array, scale: Any = 1.0) -> tuple[Array, float]:
    """(7): T and the bound of ‖w⁺(0)‖."""
    U, S, _ = np.linalg.svd(X.c[0] * scale)
    T = U * np.maximum(S / S[0], 1 / MAX_CONDITION) / scale
    Q = constant_series(np.linalg.inv(T))
    theta = inverse_error(Q, constant_series(T), "inequality (7): Q is no approximate inverse of T")
    B = Q @ X
    largest = np.sqrt(round_up(np.max((B @ Series(B.c.mT, B.r.T)).size.sum(1))))
    return T, round_up((largest * rho + norm_bound(Q.size @ jump)) / (1 - theta))


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

    Raises:
        Rejected: an inequality does not hold.

    """
    per_second = Fraction(2) ** (certificate.bits - certificate.time_exponent)
    remaining, samples, at = [Fraction(t) * per_second for t in certificate.times], [], 0
    unit, bits = arb(2) ** -certificate.bits, certificate.bits
    with ctx.workprec(bits + GUARD_BITS), np.errstate(all="ignore"):
        exact, rounded = Mechanism(certificate, arb), Mechanism(certificate, float)
        end, X, rho = initial_values(exact), constant_series(np.eye(exact.nq + exact.nv)), 0.0
        for k, (length, *rows) in enumerate(certificate.steps):
            y, h = [arb_poly([c * unit for c in row]) for row in rows], length * unit
            scale = np.repeat([1.0, min(1.0, FAST * float(h))], [exact.nq, exact.nv])[:, None]
            try:
                rates = ([j * c / length for j, c in enumerate(row[1:], 1)] for row in rows[exact.nq :])
                rows = [np.array(x) for x in (*([c / 2**bits for c in row] for row in rows), *rates)]
                jump = upper_bounds(x - f[0] for x, f in zip(end, y, strict=True))
                start = next_ellipsoid(X, rho, jump, scale)
                P, rho = prove_step(rounded, rows, float(h), bound_defect(exact, y, h), *start)
            except (Rejected, OverflowError, np.linalg.LinAlgError) as error:
                raise Rejected(f"step {k + 1} of {len(certificate.steps)}: {error}") from None
            end, X = [poly(arb(1)) for poly in y], evaluate_series(P, 1.0)
            while remaining and remaining[0] <= at + length:  # exact
                samples.append(sample_at(exact, y, P, rho, (remaining.pop(0) - at) / length))
            at += length
            on_step(k + 1, len(certificate.steps))
    _require(not remaining, f"the steps end at {float(at / per_second):g} s, before the last sample")
    return Enclosure(certificate.times, *(np.array(x) for x in zip(*samples, strict=True)))


def initial_values(exact: Mechanism) -> list[Any]:
    """y(0), normalised, in the certificate's unit of time."""
    q, v = list[Any](), list[Any]()
    for k, (joint, (n_p, n_u, n_x, n)) in enumerate(zip(exact.joints, exact.sizes[0], strict=True)):
        p, w, u, udot, x, xdot = (exact.data[name][k] for name in ("p", "omega", "u", "udot", "x", "xdot"))
        if joint[0] == "rod":
            u, udot = u / (u @ u).sqrt(), udot - u * (u @ udot) / (u @ u)
        functions = [f for angle in x[joint[3] : n_x] for f in (angle.cos(), angle.sin())]
        q += [*(p / (p @ p).sqrt())[:n_p], *u[:n_u], *x[:n_x], *[*functions, *x][:n]]
        v += [*w[:n_p], *udot[:n_u], *xdot[:n_x]]
    motion = Motion(exact, [*q, *q[:1] * len(exact.springs), *v], v)
    for k, (own, *_, bent) in enumerate(motion.parts[0]):
        if len(own) and len(bent):
            bend, cosine = motion.bend(k)
            angle = arb.atan2((bend @ bend).nonnegative_part().sqrt(), cosine)
            bent[:] = angle * angle, 1 / (6 * angle.sinc())
    q = [x for joint in motion.parts[0] for part in joint for x in part]
    return [*q, *(1 / (d @ d).sqrt() for d in motion.spans(0)), *v]


def sample_at(exact: Mechanism, y: list[Any], P: Series, rho: float, s: Fraction) -> tuple[list[Array], ...]:
    """Balls r, p, ṙ, ω′ of every body at s; |p| = |u| = 1, so that nothing is normalised."""
    spread = round_up(norm_bound(evaluate_series(P, s.numerator / s.denominator).size, axis=1) * rho)
    y = [f(arb(s.numerator) / s.denominator) + arb(0, float(e)) for f, e in zip(y, spread, strict=True)]
    z = Motion(exact, y, y[exact.nq :])
    p = [np.eye(4)[0]] * (1 + len(exact.far))
    for k, (far, (own, _, x, _)) in enumerate(zip(exact.far, z.parts[0], strict=True)):
        before, after = (q / (q @ q).sqrt() for q in exact.data["turn"][k])
        p[k] = _times(p[far], before)
        for (axis, *_), half in zip(z.turns[k], x[exact.joints[k][3] :] / 2, strict=True):
            p[k] = _times(p[k], _vector([half.cos(), *(np.eye(3)[axis] * half.sin())]))
        p[k] = own if len(own) else _times(p[k], after * [1, -1, -1, -1])
    return z.centres(0)[:-1], p[:-1], *([x / exact.unit for x in w[:-1]] for w in (z.centres(1), z.w))
