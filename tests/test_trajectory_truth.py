"""Truth along trajectories: two methods of different kind and coordinates, and quad precision above them."""

from __future__ import annotations

import numpy as np
import pytest

from plumbline.exact import solution
from plumbline.measures import attitude_error, position_error
from plumbline.scenario import find, load
from plumbline.truth.certified import certify
from tests.random_chains import random_chain

pytest.importorskip("heyoka")
pytest.importorskip("mpmath")
from plumbline.truth.taylor import taylor
from plumbline.truth.trajectory import trajectory_truth

TIMES = np.arange(41) * 0.05


@pytest.mark.parametrize("rods", [[0], [1], [0, 0]], ids=str)
def test_extended_precision_is_as_good_as_quad_says(rods):
    check_precisions(rods)


@pytest.mark.full
@pytest.mark.parametrize("rods", [[1, 1], [0, 1, 0], [1, 0, 1]], ids=str)
def test_extended_precision_is_as_good_as_quad_says_on_longer_chains(rods):
    check_precisions(rods)


def check_precisions(rods):
    model, state = random_chain(np.random.default_rng(1), rods, loads=True, drag=True)
    quad, extended, double = (taylor(model, state, TIMES, kind) for kind in ("quad", "extended", "double"))
    fine, middle, coarse = (np.asarray(run.r, dtype=float) for run in (quad, extended, double))
    assert np.max(np.abs(middle - fine)) < 1e-15
    assert np.max(np.abs(coarse - fine)) < 1e-12
    assert np.max(np.abs(coarse - fine)) > 0, "double and quad gave the same bits: is quad really quad?"


@pytest.mark.parametrize("name", ["tumbling-ball", "lagrange-top", "double-tumbling-balls"])
def test_the_uncertainty_is_below_a_picometre_on_balls(name):
    scenario = load(find(name))
    truth = trajectory_truth(scenario.model, scenario.state, TIMES)
    assert np.max(truth.position_uncertainty) < 1e-12
    assert np.all(np.diff(truth.position_uncertainty) >= 0)


@pytest.mark.parametrize("name", ["free-top", "planar-170", "lagrange-top", "spherical"])
def test_it_agrees_with_the_closed_forms(name):
    scenario = load(find(name))
    run = taylor(scenario.model, scenario.state, TIMES, "extended")
    r, p = solution(scenario)(TIMES)
    assert np.max(position_error(np.asarray(run.r, float), r)) < 2e-13
    assert np.max(attitude_error(np.asarray(run.p, float), p)) < 1e-12


def test_its_accelerations_are_the_certified_ones():
    """ω′ and v of a mixed chain, differenced over a microsecond, against ball arithmetic at one state."""
    model, state = random_chain(np.random.default_rng(4), [1, 0], loads=True, drag=True)
    h = 1e-4
    run = taylor(model, state, np.array([0.0, h, 2 * h]), "extended")
    said = certify(model, state).quantities
    for values, expected in ((run.omega, said.angular_acceleration), (run.v, said.acceleration)):
        slope = np.asarray((-3 * values[0] + 4 * values[1] - values[2]) / (2 * h), dtype=float)
        assert slope == pytest.approx(expected, abs=3e-6 * np.max(np.abs(expected)))


def test_long_chains_say_that_the_equations_are_the_same():
    model, state = random_chain(np.random.default_rng(0), [0, 0])
    truth = trajectory_truth(model, state, TIMES[:5], compiled=1)
    assert "DOP853" in truth.method
    assert np.max(truth.position_uncertainty) < 1e-11
