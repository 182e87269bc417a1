"""Scenario files with `closes`: what they build, and what they refuse, where; published accelerations."""

import re

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.model.kinematics import joint_coordinates
from plumbline.model.loops import loop_gaps, smallest_singular_value
from plumbline.model.sampling import random_loop_states
from plumbline.scenario.line_and_column_errors import ScenarioError
from plumbline.scenario.loader import find_scenario_file, load_scenario_text
from plumbline.truth.certified_state import certify_state
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.refusals import refusal
from tests.helpers.tables import table

FOUR_BAR = find_scenario_file("four-bar").read_text(encoding="utf-8")
PUBLISHED_SQUEEZER = [14222.4439199541138706, -10666.8329399655854029]  # β̈(0), Θ̈(0): IVP test set


def problems(old, new):
    assert old in FOUR_BAR
    return [str(problem) for problem in refusal(load_scenario_text, FOUR_BAR.replace(old, new, 1)).problems]


@pytest.mark.parametrize("name", ["four-bar", "slider-crank", "bricard", "squeezer", "flyball-governor"])
def test_loops_are_closed_to_rounding(name):
    s = catalogue_scenario(name)
    gaps, rates = loop_gaps(s.model, s.state)
    assert np.max(gaps) < 1e-15 and np.max(rates) < 1e-14
    assert s.model.has_loops and not s.model.has_chain_joints and len(s.model.kind) > s.model.n


def test_the_rates_that_are_given_stay_and_the_others_follow():
    s = load_scenario_text(FOUR_BAR)
    assert s.state.xdot[0, 0] == 4.0
    assert np.all(np.abs(s.state.xdot[1:, 0]) > 0.1)
    x = joint_coordinates(s.model, s.state)[2]
    turned = x[0, 0] + x[1, 0] + 0  # the coupler's angle; the closing hinge turns from it to the rocker
    assert x[3, 0] == pytest.approx(x[2, 0] - turned, abs=1e-14)


@pytest.mark.parametrize(
    "old, new, message",
    table(__file__),
)
def test_a_loop_that_cannot_be_is_refused_with_its_place(old, new, message):
    if old.startswith("axis"):  # the closing joint's is the last
        new = FOUR_BAR[FOUR_BAR.rindex("  - body") :].replace(old, new)
        old = FOUR_BAR[FOUR_BAR.rindex("  - body") :]
    (problem,) = problems(old, new)
    assert message in problem
    assert re.match(r"^\S+:\d+:\d+: ", problem)


def test_a_loop_is_closed_by_any_joint_but_a_free_one():
    closing = FOUR_BAR[FOUR_BAR.rindex("  - body") :]
    (problem,) = problems(closing, closing.replace("kind: hinge", "kind: free"))
    assert "has the kind 'free'; valid would be one of kind: rod, ball, hinge, " in problem
    assert problem.endswith(", weld")


def test_rates_that_open_the_loop_are_refused():
    rates = re.sub(r"(coordinates: \[[-0-9.]+\])\}", r"\1, rates: [1.0]}", FOUR_BAR)
    with pytest.raises(ScenarioError, match="opens: rates differ by"):
        load_scenario_text(rates)


def test_the_squeezer_starts_as_published():
    s = catalogue_scenario("squeezer")
    truth = certify_state(s.model, s.state).quantities
    alpha = truth.angular_acceleration[:2, 2]
    np.testing.assert_allclose([alpha[0], alpha[1] - alpha[0]], PUBLISHED_SQUEEZER, rtol=1e-12)


@pytest.mark.parametrize("name, windows", [("four-bars-2", 2), ("four-bars-6", 6)])
def test_four_bars_move_as_the_parallelogram_does(name, windows):
    """θ̈ = g sin θ ((N+1)/2 + N)/((N+1) I + N), θ from the upright, I = 1/4 + J of a bar about its end."""
    s = catalogue_scenario(name)
    truth = certify_state(s.model, s.state).quantities
    np.testing.assert_allclose(truth.angular_acceleration, 0, atol=1e-12)  # upright: no torque
    np.testing.assert_allclose(truth.acceleration[0], [0, 0, -0.5], atol=1e-12)  # ω² ℓ/2 towards the world
    (state,) = random_loop_states(s.model, s.state, 1, 3)
    found = certify_state(s.model, state).quantities
    theta, J = state.x[0, 0], s.model.inertia[0, 1, 1]
    weight = 9.81 * np.sin(theta) * ((windows + 1) / 2 + windows)
    assert found.angular_acceleration[0, 1] == pytest.approx(
        weight / ((windows + 1) * (0.25 + J) + windows), rel=1e-12
    )


def test_flat_four_bars_are_singular():
    s = catalogue_scenario("four-bars-2-flat")
    assert smallest_singular_value(s.model, s.state) < 1e-6
    upright = catalogue_scenario("four-bars-2")
    assert smallest_singular_value(upright.model, upright.state) > 0.1


def test_dead_centres_of_a_slider_crank_are_regular():
    """There the slider stands still while the crank turns: the rows keep their rank."""
    text = find_scenario_file("slider-crank").read_text(encoding="utf-8")
    s = load_scenario_text(text)
    values = [
        smallest_singular_value(s.model, state) for state in random_loop_states(s.model, s.state, 40, 1)
    ]
    assert min(values) > 0.1


def test_engines_agree_on_what_dependent_rows_leave_determinate():
    s = catalogue_scenario("bricard")
    answers = [load_adapter(name).evaluate(s.model, [s.state])[0] for name in ("reference", "exudyn")]
    for name in ("joint_reaction", "joint_moment"):
        one, other = (getattr(answer, name) for answer in answers)
        assert np.max(np.abs(one - other)) < 1e-12 * np.max(np.abs(one))
