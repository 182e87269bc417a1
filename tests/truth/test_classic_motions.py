"""Benchmark mechanisms: quadratures against certified accelerations and published figures."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.model.kinematics import complete_state
from plumbline.model.loops import assembled
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.requirements import needs_truth_tools

pytestmark = needs_truth_tools


@pytest.fixture(scope="module")
def motions():
    from bench import classic_motions

    return classic_motions


def certified_rates(s, x, xdot):
    """ω̇′ of all bodies at joint coordinates and rates of a loop that close it, certified."""
    from plumbline.truth.certified_state import certify_state

    coordinates, rates = np.zeros((2, s.model.n, 2))
    coordinates[:, 0], rates[:, 0] = x, xdot
    at = complete_state(s.model, replace(s.state, x=coordinates, xdot=rates))
    closed = assembled(s.model, at)
    assert np.max(np.abs(closed.x - at.x)) < 1e-12
    return certify_state(s.model, closed).quantities.angular_acceleration


def test_the_squeezer_starts_as_published(motions):
    assert motions.squeezer_start_acceleration() == 14222.4439199541138706


def test_the_squeezer_accelerates_as_its_certified_equations_say(motions):
    """β̈ from the quadrature's rates at two times, against Newton and Euler with closed loops in balls."""
    before, at, after = (motions.squeezer_motion(t) for t in ("0.02999", "0.03", "0.03001"))
    slope = (after.rates["beta"] - before.rates["beta"]) / 2e-5
    order = ("beta", "Theta", "gamma", "delta", "Phi", "epsilon", "Omega")
    x, xdot = ([values[name] for name in order] for values in (at.angles, at.rates))
    found = certified_rates(catalogue_scenario("squeezer"), x, xdot)[0, 2]
    curvature = abs(after.rates["beta"] - 2 * at.rates["beta"] + before.rates["beta"]) / 1e-5
    assert slope == pytest.approx(found, abs=0.05 * curvature + 1e-6 * abs(found))


def test_the_published_squeezer_differs_by_more_than_the_uncertainty(motions):
    """IVP test set, β and Θ at 0.03 s."""
    found = motions.squeezer_motion("0.03")
    assert found.uncertainty < 1e-20
    for name, published in (("beta", 15.81077119629904), ("Theta", -15.75637105984298)):
        assert 1e-9 < abs(found.angles[name] - published) < 2e-9
    for name, published in (("delta", 0.5244099658805304), ("epsilon", 1.048080741042263)):
        assert abs(found.angles[name] - published) < 1e-12


def test_the_light_cart_pole_falls_as_published(motions):
    x, theta = motions.light_cart_pole(np.array([0.2, 0.3, 10.0]))
    published = [1.943608126629934e-2, 1.027140372631889e-1, 1.999763282461620]
    np.testing.assert_allclose(x, published, atol=1e-11)
    np.testing.assert_allclose(theta[1:], [1.113582331681891, -1.549129441897076], atol=1e-11)


def test_the_light_cart_pole_falls_as_taylors_method_says(motions):
    from bench.classics_values import find_problem_scenario
    from plumbline.truth.taylor import simulate_taylor

    s, times = find_problem_scenario("light-cart-pole-rod"), np.array([0.0, 0.125, 0.25, 0.5, 0.75])
    run, _ = simulate_taylor(s.model, s.state, times, "extended")
    x, theta = motions.light_cart_pole(times)
    pole = np.asarray(run.r[:, 1] - run.r[:, 0], float)
    assert np.max(np.abs(np.asarray(run.r[:, 0, 0], float) - x)) < 1e-12
    assert np.max(np.abs(np.arctan2(pole[:, 0], -pole[:, 2]) - theta)) < 1e-12


@pytest.mark.parametrize("time", [0.1, 0.35])
def test_four_bars_accelerate_as_their_certified_equations_say(motions, time):
    h = 2.0**-10
    before, at, after = motions.four_bar_angle(2, 0.05, np.array([time - h, time, time + h]))
    tilt, rate = np.pi / 2 - at, -(after - before) / (2 * h)
    pattern = np.array([1, -1, 1, -1, 1])
    found = certified_rates(catalogue_scenario("four-bars-2"), tilt * pattern, rate * pattern)
    assert -(after - 2 * at + before) / h**2 == pytest.approx(found[0, 1], rel=1e-5)
