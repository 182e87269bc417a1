"""Motions of mechanisms with loops: two formulations against each other and against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.model.invariants import attitude_error, compute_invariants, position_error
from plumbline.model.kinematics import complete_state, with_joint_coordinates
from plumbline.model.loops import assembled, loop_gaps, smallest_singular_value
from plumbline.model.random_mechanisms import random_loop_mechanism
from plumbline.truth.ground_truth import motion_truth, perturbed_models
from plumbline.truth.predictability_horizon import perturbation_growth, perturbed_states
from plumbline.truth.taylor import simulate_taylor
from plumbline.truth.trajectory_truth import (
    REGULARITY_RTOL,
    first_doubt,
    regular_motion,
    simulate_notes_form,
    trajectory_truth,
)
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.requirements import needs_truth_tools

pytestmark = needs_truth_tools


EPS = np.finfo(float).eps


def tops(motions, times, windows=2, thickness=0.05):
    """Top ends of the upright bars of equal four-bars, before they lie flat."""
    angle = motions.four_bar_angle(windows, thickness, times)
    return np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)


@pytest.fixture(scope="module")
def motions():
    from bench import classic_motions

    return classic_motions


def state_at(scenario, run, sample):
    """The state of a scenario's model at a sample of a run."""
    x = {k: np.asarray(getattr(run, k)[sample], float) for k in ("p", "omega", "u", "udot", "r", "v")}
    return with_joint_coordinates(scenario.model, replace(scenario.state, **x))


def test_equal_four_bars_move_as_their_closed_form(motions):
    s = catalogue_scenario("four-bars-2")
    times = s.times[s.times <= 0.5]
    truth = trajectory_truth(s.model, s.state, times)
    claimed = float(np.max(truth.uncertainty["position"]))
    bound = claimed + 4 * EPS  # and the rounding of coordinates up to 2 m on both sides
    for run in (truth.trajectory, simulate_notes_form(s.model, s.state, times, 1e-13)):
        # links 0 and 1 (bodies 1 and 3) move with the bars' top ends and do not turn
        shift = run.r[:, 1] - np.array([0.5, 0, 0])
        np.testing.assert_allclose(shift, tops(motions, times), rtol=0, atol=bound)
        apart = np.tile([1.0, 0, 0], (len(times), 1))
        np.testing.assert_allclose(run.r[:, 3] - run.r[:, 1], apart, rtol=0, atol=bound)
    assert claimed < 1e-13  # the tolerance that the second method integrates with


def test_the_squeezer_moves_as_its_quadrature(motions):
    s = catalogue_scenario("squeezer")
    exact = motions.squeezer_motion("0.01953125")
    times = np.array([0.0, 0.01953125])
    truth = trajectory_truth(s.model, s.state, times)
    notes = simulate_notes_form(s.model, s.state, times, 1e-13).p
    bound = truth.uncertainty["attitude"][-1] + 4 * EPS * abs(exact.angles["beta"])  # the angle's rounding
    # and that of the initial coordinates, which have grown: in quad precision too the error is 1.25e-14
    bound += EPS * perturbation_growth(s.model, s.state, times)[-1]
    assert bound < 1e-10
    for p in (truth.trajectory.p, notes):
        crank = 2 * np.arctan2(p[-1, 0, 3], p[-1, 0, 0])
        error = crank - exact.angles["beta"]
        error -= 2 * np.pi * np.round(error / (2 * np.pi))
        assert abs(error) < bound


@pytest.mark.parametrize("name", ["four-bar", "slider-crank", "bricard"])
def test_the_catalogues_loops_stay_closed_and_keep_their_energy(name):
    s = catalogue_scenario(name)
    truth = trajectory_truth(s.model, s.state, s.times[:9])
    assert "tree without its closing joints" in truth.method
    # The uncertainty is what two methods differ by, one of them with a tolerance of 1e-13: it is no smaller.
    assert np.max(truth.uncertainty["position"]) < 1e-13
    found = compute_invariants(s.model, truth.trajectory)
    assert found.joint_gap.shape[1] == len(s.model.kind) > s.model.n
    for drift in (found.joint_gap, found.gap_rate, found.energy_drift):
        assert np.max(np.abs(drift)) < 1e-13


def test_both_methods_agree_on_random_loops():
    times = np.arange(5) / 32
    for seed in (2, 5):
        model, state = random_loop_mechanism(seed, 5, ("hinge",), tree=("hinge", "universal", "ball"))
        notes = simulate_notes_form(model, state, times, 1e-13)
        run, _ = simulate_taylor(model, state, times)
        # 100 tolerances: over 1/8 s at rates of some rad/s errors grow by less
        assert np.max(position_error(np.asarray(run.r, float), notes.r)) < 1e-11
        assert np.max(attitude_error(np.asarray(run.p, float), notes.p)) < 1e-11


def test_a_motion_ends_before_its_singular_pose(motions):
    s = catalogue_scenario("four-bars-2")
    found = regular_motion(s.model, s.state, s.times)
    angle = motions.four_bar_angle(2, 0.05, np.array([found.end]))[0]
    assert found.is_singular and 0 < angle < 0.05  # nearly flat
    truth = motion_truth(s.model, s.state, s.times, None)
    assert truth.trajectory.t[-1] <= found.end < truth.trajectory.t[-1] + s.sample_interval
    assert truth.singular.startswith("singular: from t = ") and not truth.conflict
    regular = catalogue_scenario("four-bar")
    times = regular.times[:5]
    run, _ = simulate_taylor(regular.model, regular.state, times)
    value = smallest_singular_value(regular.model, state_at(regular, run, 4))
    near = pytest.approx(value, rel=1e3 * REGULARITY_RTOL)  # of a motion followed with this tolerance
    assert regular_motion(regular.model, regular.state, times) == (times[4], False, near)


def test_samples_of_a_run_show_whether_a_singular_pose_may_be_between_them():
    """The bars come to lie flat at 0.7144 s, between two samples whose singular values are above 0.01."""
    s = catalogue_scenario("four-bars-2")
    times = s.times[:12]
    run = simulate_notes_form(s.model, s.state, times, 1e-9)
    assert times[-1] == 0.6875 and first_doubt(s.model, s.state, run) == 0.6875
    before = replace(run, **{name: getattr(run, name)[:8] for name in ("t", "r", "p", "v", "pdot")})
    assert first_doubt(s.model, s.state, before) is None


def test_neighbours_of_a_loop_and_models_with_other_numbers_are_closed():
    s = catalogue_scenario("slider-crank")
    pairs = [(s.model, state) for state in perturbed_states(s.model, s.state)]
    others = perturbed_models(s.model, s.state)
    for model, state in (
        *pairs,
        *others,
    ):  # at most some ten roundings of lengths of 1 m and rates of 10 rad/s
        gaps, rates = loop_gaps(model, state)
        assert np.max(gaps) < 1e-14 and np.max(rates) < 1e-13
    distances = [position_error(state.r, s.state.r) for _, state in pairs]
    assert 1e-10 < min(distances) < max(distances) < 1e-5
    larger, grown = others[-1]
    np.testing.assert_allclose(grown.r, 1.0001 * s.state.r, atol=1e-14)
    np.testing.assert_allclose(larger.point, 1.0001 * s.model.point, rtol=1e-15)


def test_a_loop_moved_on_its_manifold_is_the_same_motion():
    """Started at a later sample, the motion goes on as before."""
    s = catalogue_scenario("slider-crank")
    times = np.arange(9) / 16
    whole, _ = simulate_taylor(s.model, s.state, times)
    there = state_at(s, whole, 4)
    rest, _ = simulate_taylor(s.model, assembled(s.model, complete_state(s.model, there)), times[:5])
    assert np.max(position_error(np.asarray(rest.r[-1], float), np.asarray(whole.r[-1], float))) < 1e-13
