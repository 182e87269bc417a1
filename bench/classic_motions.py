"""Motions of benchmark mechanisms by quadrature, independent of every engine and of the notes' equations.

A conservative mechanism with one degree of freedom obeys ½ M(q) q̇² = W(q), the work done from rest, so that
t = ∫ √(M / 2W) dq.  The integrals are computed in ball arithmetic (python-flint) of `PRECISION` bits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from flint import acb, arb, ctx

from plumbline.model.datatypes import Array
from plumbline.truth.closed_form.tops_and_pendulums import half_angle

PRECISION = 160  # bits
GRAVITY = "9.81"  # m/s²


def four_bar_angle(windows: int, thickness: float, times: Array) -> Array:
    """Solve N equal parallelograms of square bars of 1 m and 1 kg that start upright at a rate of −1 rad/s.

    Every bar turns alike and every link moves without turning, so θ̈ = −κ cos θ with θ from the horizontal,
    κ = g ((N + 1)/2 + N) / ((N + 1)(J + ¼) + N) and J = (1 + thickness²)/12: a pendulum.

    Args:
        thickness: width of the bars [m].
        times: (T,) [s].

    Returns:
        θ (T,) [rad], without whole turns.

    """
    bars, inertia = windows + 1, (1 + thickness**2) / 12
    frequency = np.sqrt(float(GRAVITY) * (bars / 2 + windows) / (bars * (inertia + 0.25) + windows))
    half_sin, half_cos = half_angle(frequency, np.pi, -1.0)(times)
    return np.asarray(2 * np.arctan2(half_sin, half_cos) - np.pi / 2)


def light_cart_pole(times: Array) -> tuple[Array, Array]:
    """Solve a cart of M = 1e-6 kg with a point mass of m = 1 kg on a pole of l = 1 m, released horizontally.

    θ̇² = 2g (M + m) cos θ / l (M + m sin² θ) and x = m l (1 − sin θ) / (M + m); with θ = ½π − w² the
    integrand is smooth at the release.  The motion is composed of quarters of a period.

    Args:
        times: (T,) [s] since the release.

    Returns:
        The cart's x (T,) [m] and the pole's angle θ (T,) [rad] from hanging, ½π at first.

    """
    ctx.prec = PRECISION
    cart = arb("1e-6")
    end = (arb.pi() / 2).sqrt()
    grid = [end * k / 400 for k in range(401)]
    table = np.array([float(_fall_time(w)) for w in grid])
    quarter = _fall_time(end)
    theta = np.empty(len(times))
    for i, time in enumerate(times):
        count = int(float(arb(time) / quarter))
        tau = arb(time) - count * quarter if count % 2 == 0 else (count + 1) * quarter - arb(time)
        at = min(max(int(np.searchsorted(table, float(tau))), 1), 400)
        w = _solve(lambda w, tau=tau: (_fall_time(w) - tau, _fall_rate(w).real), grid[at - 1], grid[at])
        theta[i] = float(arb.pi() / 2 - w * w) * (1 if count % 4 in (0, 3) else -1)
    return np.asarray((1 - np.sin(theta)) / (1 + float(cart))), theta


def _fall_rate(w: arb | acb, analytic: bool = False) -> acb:
    """dt/dw of the light cart-pole: cos θ = sin w², sin θ = cos w²."""
    square, cart, gravity = acb(w) ** 2, acb(arb("1e-6")), acb(arb(GRAVITY))
    ratio = (cart + square.cos() ** 2) / (2 * gravity * (cart + 1) * square.sinc())
    return 2 * ratio.sqrt(analytic=analytic)


def _fall_time(w: arb) -> arb:
    """Time of the light cart-pole from the release to θ = ½π − w², enclosed."""
    return acb.integral(_fall_rate, 0, w, rel_tol=arb(2) ** -80).real


def _solve(function: Callable[[arb], tuple[arb, arb]], low: arb, high: arb) -> arb:
    """Find the root of an increasing function between two points by Newton's method, else by bisection."""
    x = (low + high) / 2
    for _ in range(200):
        value, slope = function(x)
        low, high = (low, x) if value > 0 else (x, high)
        step = (value / slope).mid()
        if abs(float(step)) < 1e-20:
            return x
        x = (x - step).mid() if low < x - step < high else ((low + high) / 2).mid()
    return x


@dataclass(frozen=True)
class SqueezerMotion:
    """The squeezer at one time; angles as the IVP test set names them [rad], with their rates [rad/s]."""

    angles: dict[str, float]
    rates: dict[str, float]
    uncertainty: float  # of β, rad: what other nodes of the quadrature change, and the last Newton step


# of each body the points in whose line it is, and its centre from the first: along, across [m]; mass, inertia
_BARS = (
    ("O", "C", "0.00092", "0", "0.04325", "2.194e-6"),
    ("C", "P", "0.0115", "0", "0.00365", "4.410e-7"),
    ("B", "P", "0.01874", "0.01043", "0.02373", "5.255e-6"),
    ("E", "P", "0.00579", "0", "0.00706", "5.667e-7"),
    ("A", "E", "0.02308", "0.00916", "0.07050", "1.169e-5"),
    ("F", "P", "0.00579", "0", "0.00706", "5.667e-7"),
    ("A", "F", "0.01228", "-0.00449", "0.05498", "1.912e-5"),
)
_RR, _D, _SS, _E, _ZT, _U, _ZF = "0.007", "0.028", "0.035", "0.02", "0.04", "0.04", "0.02"
_BETA0, _MOMENT = "-0.0617138900142764496", "0.033"  # rad, N m
_SPRING, _SPRING_AT, _STIFFNESS, _LENGTH = ("0.014", "0.072"), ("0.018", "0.02"), "4530", "0.07785"


def _complex(x: str, y: str) -> acb:
    return acb(arb(x), arb(y))


def _dot(a: acb, b: acb) -> arb:
    return a.real * b.real + a.imag * b.imag


def _joint(p: acb, r: str, q: acb, s: str, side: int) -> acb:
    """The point r from p and s from q, on the left of p → q for side 1, on the right for −1."""
    line = q - p
    square = _dot(line, line)
    along = (arb(r) ** 2 - arb(s) ** 2 + square) / (2 * square)
    return p + line * acb(along, side * (arb(r) ** 2 / square - along**2).sqrt())


def _joint_rate(x: acb, p: acb, p_rate: acb, q: acb, q_rate: acb) -> acb:
    """The velocity of a point whose distances from p and q are constant."""
    a, b = x - p, x - q
    twist = acb(_dot(a, p_rate)) * b - acb(_dot(b, q_rate)) * a
    return acb(0, -1) * twist / (a.real * b.imag - a.imag * b.real)


def _squeezer_points(beta: arb) -> tuple[dict[str, acb], dict[str, acb]]:
    """The joints' points at a crank angle, and their derivatives by it."""
    crank = acb(beta.cos(), beta.sin()) * arb(_RR)
    at = {
        "O": acb(0),
        "C": crank,
        "A": _complex("-0.06934", "-0.00227"),
        "B": _complex("-0.03635", "0.03273"),
    }
    rate = dict.fromkeys("OAB", acb(0)) | {"C": crank * acb(0, 1)}
    for name, p, r, q, s, side in (
        ("P", "C", _D, "B", _SS, 1), ("E", "A", _ZT, "P", _E, 1), ("F", "A", _U, "P", _ZF, -1)
    ):  # fmt: skip
        at[name] = _joint(at[p], r, at[q], s, side)
        rate[name] = _joint_rate(at[name], at[p], rate[p], at[q], rate[q])
    return at, rate


def _turn_rate(line: acb, line_rate: acb) -> arb:
    return (line.real * line_rate.imag - line.imag * line_rate.real) / _dot(line, line)


def squeezer_energy(beta: arb) -> tuple[arb, arb]:
    """Compute M(β) of the kinetic energy ½ M β̇², and the spring's energy, of Andrews' squeezer.

    Args:
        beta: angle of the crank [rad].

    Returns:
        M [kg m²] and the energy [J].

    """
    at, rate = _squeezer_points(beta)
    inertia = arb(0)
    for start, end, along, across, mass, moment in _BARS:
        line, line_rate = at[end] - at[start], rate[end] - rate[start]
        centre = rate[start] + line_rate * _complex(along, across) / _dot(line, line).sqrt()
        inertia += arb(mass) * _dot(centre, centre) + arb(moment) * _turn_rate(line, line_rate) ** 2
    line = at["P"] - at["B"]
    spring = at["B"] + line * _complex(*_SPRING_AT) / arb(_SS) - _complex(*_SPRING)
    stretch = _dot(spring, spring).sqrt() - arb(_LENGTH)
    return inertia, arb(_STIFFNESS) * stretch**2 / 2


def squeezer_start_acceleration() -> float:
    """Compute β̈ of Andrews' squeezer at its release, (moment − dV/dβ) / M, by a central difference.

    Returns:
        [rad/s²]

    """
    ctx.prec = PRECISION
    beta, h = arb(_BETA0), arb(2) ** -50
    slope = (squeezer_energy(beta + h)[1] - squeezer_energy(beta - h)[1]) / (2 * h)
    return float((arb(_MOMENT) - slope) / squeezer_energy(beta)[0])


def squeezer_motion(time: str) -> SqueezerMotion:
    """Compute Andrews' squeezer at a time after its release, by Gauss–Legendre quadrature.

    With β = β₀ + s² the integrand is smooth at the release.

    Args:
        time: decimal [s]; the crank turns forward up to then.

    """
    ctx.prec = PRECISION
    beta0, start_energy = arb(_BETA0), squeezer_energy(arb(_BETA0))[1]

    def slope(s: arb) -> arb:  # dt/ds
        inertia, energy = squeezer_energy(beta0 + s * s)
        work = arb(_MOMENT) * s * s + start_energy - energy
        return 2 * s * (inertia / (2 * work)).sqrt()

    def elapsed(s: arb, nodes: int) -> arb:
        points = [arb.legendre_p_root(nodes, k, weight=True) for k in range(nodes)]
        panel = s / 40
        total = sum(
            (w * slope(panel * (i + (x + 1) / 2)) for i in range(40) for x, w in points), start=arb(0)
        )
        return total * panel / 2

    s = arb(4)  # the integrand is nearly constant: Newton's method converges from anywhere
    for _ in range(12):
        step = ((elapsed(s, 16) - arb(time)) / slope(s)).mid()
        s = (s - step).mid()
        if abs(float(step)) < 1e-13:
            break
    step = ((elapsed(s, 24) - arb(time)) / slope(s)).mid()
    s, last = (s - step).mid(), abs(float(step))
    return _squeezer_state(beta0 + s * s, 2 * s / slope(s), 2 * float(s) * last)


def _squeezer_state(beta: arb, rate: arb, uncertainty: float) -> SqueezerMotion:
    """Read the test set's angles: crank β, Θ = K2 − β, γ K3, Φ = K4 − δ, δ K5, Ω = K6 − ε, ε K7."""
    at, rates = _squeezer_points(beta)
    lines = {name: at[b] - at[a] for name, (a, b) in _LINES.items()}
    turns = {name: rate * _turn_rate(lines[name], rates[b] - rates[a]) for name, (a, b) in _LINES.items()}
    turns["K1"] = rate
    directions = {name: float(arb.atan2(line.imag, line.real)) for name, line in lines.items()}
    directions["K1"] = float(beta)
    right = np.pi / 2
    zero = {"K1": 0.0, "K2": np.pi, "K3": -right, "K4": -right, "K5": 0.0, "K6": 0.0, "K7": -right}
    body = {name: directions[name] - zero[name] for name in zero}
    pairs = {"beta": ("K1", ""), "Theta": ("K2", "K1"), "gamma": ("K3", ""), "Phi": ("K4", "K5"),
             "delta": ("K5", ""), "Omega": ("K6", "K7"), "epsilon": ("K7", "")}  # fmt: skip
    rate_of = {name: float(turn) for name, turn in turns.items()} | {"": 0.0}
    angle_of = body | {"": 0.0}
    angles = {name: angle_of[a] - angle_of[b] for name, (a, b) in pairs.items()}
    for name in ("Theta", "Phi", "Omega"):  # atan2 has no whole turns; Θ follows the crank's
        near = -float(beta) if name == "Theta" else 0.0
        angles[name] += 2 * np.pi * round((near - angles[name]) / (2 * np.pi))
    return SqueezerMotion(
        angles, {name: rate_of[a] - rate_of[b] for name, (a, b) in pairs.items()}, uncertainty
    )


_LINES = {"K1": "OC", "K2": "CP", "K3": "BP", "K4": "EP", "K5": "AE", "K6": "FP", "K7": "AF"}
