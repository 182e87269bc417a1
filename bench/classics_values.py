"""Published figures of benchmark problems, and the values that are computed for them here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.classic_motions import (
    four_bar_angle,
    light_cart_pole,
    squeezer_motion,
    squeezer_start_acceleration,
)
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import rotation_matrix
from plumbline.scenario.loader import Scenario, find_scenario_file, load_scenario
from plumbline.truth.certified_state import certify_state
from plumbline.truth.closed_form import exact_samples
from plumbline.truth.taylor import simulate_taylor

OWN_SCENARIOS = Path(__file__).with_name("scenarios")  # too hard for a run of the catalogue
ROUNDING = 2.0**-52
SQUEEZER_ANGLES = {  # IVP test set, at 0.03 s
    "beta": 15.81077119629904, "Theta": -15.75637105984298, "gamma": 0.04082224013073101,
    "Phi": -0.5347301163226948, "delta": 0.5244099658805304, "Omega": 0.5347301163226948,
    "epsilon": 1.048080741042263,
}  # fmt: skip
SQUEEZER_RATES = {"beta": 1139.920302151208, "Theta": -1424.379294994111}
SQUEEZER_START = {"beta": 14222.4439199541138706, "Theta": -10666.8329399655854029}  # rad/s²
BRICK_SIM_1 = {  # NESC check-case 2, rates in rad/s
    1.0: (0.07433081345339321, 0.40351912643342025, 0.49532126129028836),
    2.0: (-0.030557492077356096, 0.41276264954940695, 0.48993696016429605),
}
BRICK_SIM_5 = (12.61842377, -17.3974441, 31.11960301)  # at 30 s, degrees/s
CART_POLE = {10.0: (1.999763282461620, -1.549129441897076)}  # x [m], θ [rad]


@dataclass(frozen=True)
class Value:
    """A published figure and the value computed here."""

    name: str
    published: float | None
    ours: float
    uncertainty: float
    unit: str


def find_problem_scenario(name: str) -> Scenario:
    """Load a scenario of bench/scenarios, or of the catalogue.

    Args:
        name: of the file, without its suffix.

    """
    own = OWN_SCENARIOS / f"{name}.yaml"
    return load_scenario(own if own.is_file() else find_scenario_file(name))


def free_body_rates(scenario: Scenario, times: Array) -> Array:
    """Compute body rates from the closed form's attitudes: the angular momentum is constant in the world.

    Args:
        scenario: a free top.
        times: (T,) [s].

    Returns:
        (T, 3) [rad/s], body frame.

    """
    samples = exact_samples(scenario, times)
    assert samples is not None
    J, A = scenario.model.inertia[0], rotation_matrix(samples[1][:, 0])
    momentum = rotation_matrix(scenario.state.p[0]) @ J @ scenario.state.omega[0]
    return np.asarray(np.linalg.solve(J, (A.mT @ momentum).T).T)


def true_slider_height(scenario: Scenario, times: Array) -> Array:
    """Compute the height of the governor's slider by Taylor's method in extended precision.

    Args:
        scenario: the stiff governor.
        times: (T,) [s].

    Returns:
        (T, 1) [m].

    """
    run, _ = simulate_taylor(scenario.model, scenario.state, times, "extended")
    return np.asarray(run.r[:, 3, 2:], dtype=float)


def true_rod_end(scenario: Scenario, times: Array) -> Array:
    """Compute the end of the third rod of Bricard's mechanism by Taylor's method in extended precision.

    Args:
        times: (T,) [s].

    Returns:
        (T, 3) [m].

    """
    run, _ = simulate_taylor(scenario.model, scenario.state, times, "extended")
    turn = rotation_matrix(np.asarray(run.p[:, 2], dtype=float))
    return np.asarray(np.asarray(run.r[:, 2], dtype=float) - np.matvec(turn, scenario.model.proximal[2]))


def _a01() -> list[Value]:
    samples = exact_samples(find_problem_scenario("a01-simple-pendulum"), np.array([2000.0]))
    assert samples is not None
    x, _, z = samples[0][0, 0]
    uncertainty = 2000 * np.sqrt(9.81) * ROUNDING  # of the elliptic functions' argument
    return [Value("x(2000 s)", None, x, uncertainty, "m"), Value("y(2000 s)", None, z, uncertainty, "m")]


def _a02() -> list[Value]:
    angle = float(four_bar_angle(2, 0.05, np.array([10.0]))[0])
    return [
        Value("B₀ x(10 s), N = 2", None, np.cos(angle), 1e-14, "m"),
        Value("B₀ y(10 s), N = 2", None, np.sin(angle), 1e-14, "m"),
    ]


def _a03() -> list[Value]:
    s = find_problem_scenario("squeezer")
    alpha = certify_state(s.model, s.state).quantities.angular_acceleration[:2, 2]
    motion, published = squeezer_motion("0.03"), SQUEEZER_START
    found = [
        Value("beta''(0)", published["beta"], squeezer_start_acceleration(), 2e-12, "rad/s²"),
        # of the model's doubles, not of the decimals
        Value("Theta''(0)", published["Theta"], alpha[1] - alpha[0], 1e-10, "rad/s²"),
    ]
    found += [
        Value(f"{n}(0.03 s)", v, motion.angles[n], max(1.0, abs(v)) * 2 * ROUNDING, "rad")
        for n, v in SQUEEZER_ANGLES.items()
    ]
    return found + [
        Value(f"{n}'(0.03 s)", v, motion.rates[n], abs(v) * 2 * ROUNDING, "rad/s")
        for n, v in SQUEEZER_RATES.items()
    ]


def _a05() -> list[Value]:
    times = np.array([0.0, 1.0, 2.0, 10.0])
    heights = true_slider_height(find_problem_scenario("a05-stiff-governor"), times)[1:, 0]
    return [
        Value(f"s({t:g} s)", None, s, 1e-14, "m") for t, s in zip(times[1:], heights.tolist(), strict=True)
    ]


def _cart_pole() -> list[Value]:
    ((time, published),) = CART_POLE.items()
    ours = [float(y[0]) for y in light_cart_pole(np.array([time]))]
    names = (f"x({time:g} s)", "m"), (f"θ({time:g} s)", "rad")
    return [
        Value(n, v, y, 4 * ROUNDING, unit) for (n, unit), v, y in zip(names, published, ours, strict=True)
    ]


def _nesc() -> list[Value]:
    times = [*BRICK_SIM_1, 30.0]
    rates = free_body_rates(find_problem_scenario("nesc-tumbling-brick"), np.array([0.0, *times]))[1:]
    published = [*BRICK_SIM_1.values(), tuple(np.radians(BRICK_SIM_5))]
    return [
        Value(f"{axis}({time:g} s)", float(v), float(y), 1e-13, "rad/s")
        for time, row, values in zip(times, rates, published, strict=True)
        for axis, y, v in zip("pqr", row, values, strict=True)
    ]


VALUES = {"A01": _a01, "A02": _a02, "A03": _a03, "A05": _a05, "cart-pole": _cart_pole, "NESC-2": _nesc}
