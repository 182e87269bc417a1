"""Motions of trees: Taylor's method in joint coordinates, the notes' form, closed forms, the horizon."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.model.datatypes import KINDS
from plumbline.model.invariants import attitude_error, position_error
from plumbline.model.kinematics import ball_spring_rest, complete_state, quaternion_rate
from plumbline.model.random_mechanisms import ELEMENTS
from plumbline.model.sampling import random_states
from plumbline.truth import ground_truth
from plumbline.truth import trajectory_truth as trajectory
from plumbline.truth.ground_truth import perturbed_models
from plumbline.truth.predictability_horizon import perturbation_growth, perturbed_states, project_to_manifold
from plumbline.truth.taylor import simulate_taylor
from plumbline.truth.trajectory_truth import NOTES_RTOL, simulate_notes_form, trajectory_truth
from reference_impl.joints import constraint_rows
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.nightly_tests import SLOW
from tests.helpers.random_chains import tree_from_seed
from tests.helpers.requirements import needs_truth_tools

TIMES = np.arange(9) * 0.125
UNIT = np.array([1.0, 0.0, 0.0, 0.0])

pytestmark = needs_truth_tools


def taylor(model, state, times=TIMES, precision="extended"):
    run, _ = simulate_taylor(model, state, times, precision)
    return np.asarray(run.r, float), np.asarray(run.p, float), run


FAST_KINDS = ("universal", "cylindrical", "free")  # compiled in a second each; engines run the others


@pytest.mark.parametrize("kind", [pytest.param(x, marks=[] if x in FAST_KINDS else SLOW) for x in KINDS])
def test_both_methods_agree_on_every_kind_of_joint(kind):
    model = tree_from_seed(5, 3, (kind, "hinge", "ball"))
    (state,) = random_states(model, 1, 2)
    other = simulate_notes_form(model, state, TIMES, NOTES_RTOL)
    r, p, run = taylor(model, state)
    assert np.max(position_error(r, other.r)) < 1e-12 * max(1.0, np.max(np.abs(r)))
    assert np.max(attitude_error(p, other.p)) < 1e-11
    np.testing.assert_allclose(np.asarray(run.v, float), other.v, atol=1e-11 * np.max(np.abs(other.v)))


def test_both_methods_agree_on_mixed_trees():
    for seed in range(3):
        model = tree_from_seed(seed, 6)
        (state,) = random_states(model, 1, seed)
        truth = trajectory_truth(model, state, TIMES)
        assert "Taylor's method" in truth.method
        assert "the notes' form by collocation" in truth.method
        # a disturbance of one rate by 1e-9, relative, grows as the roundings of both methods do
        disturbed = replace(state, xdot=state.xdot * (1 + 1e-9), omega=state.omega * (1 + 1e-9))
        r, _, _ = taylor(model, complete_state(model, disturbed))
        growth = np.max(position_error(r, truth.trajectory.r)) / 1e-9
        # every step of the notes' form rounds the rates by ε at most, which grows as the disturbance does
        steps = simulate_notes_form(model, state, TIMES, NOTES_RTOL).steps
        assert np.max(truth.uncertainty["position"]) < steps * np.finfo(float).eps * growth


@pytest.mark.parametrize(
    ("kinds", "element"),
    [
        pytest.param(kinds, element, marks=SLOW if (i + k) % 2 else [])  # every element on one of the two
        for i, kinds in enumerate([("hinge", "cylindrical", "rod"), ("universal", "slide", "weld")])
        for k, element in enumerate(ELEMENTS)
    ],
)
def test_both_methods_agree_on_every_element(kinds, element):
    model = tree_from_seed(3, 3, kinds, elements=(element,))
    (state,) = random_states(model, 1, 2)
    times = TIMES[:3]
    other = simulate_notes_form(model, state, times, NOTES_RTOL)
    r, p, _ = taylor(model, state, times, "double")
    assert np.max(position_error(r, other.r)) < 1e-13
    assert np.max(attitude_error(p, other.p)) < 1e-12


@pytest.mark.parametrize("kinds", [("ball",), ("ball", "universal", "rod")], ids=str)
def test_both_methods_agree_on_springs_of_balls(kinds):
    model = tree_from_seed(3, 3, kinds, elements=("stiffness",))
    (state,) = random_states(model, 1, 2)
    truth = trajectory_truth(model, state, TIMES[:3])
    assert "ball" in model.kind and truth.method.startswith("Taylor's method")
    assert truth.uncertainty["position"][-1] < 1e-13 and truth.uncertainty["attitude"][-1] < 1e-12


def test_a_spring_of_a_ball_at_rest_has_a_taylor_series():
    """θ/sin θ is 0/0 where the spring is unloaded."""
    model = tree_from_seed(3, 1, ("ball",), elements=("stiffness",))
    (state,) = random_states(model, 1, 2)
    unloaded = complete_state(model, replace(state, p=np.array([ball_spring_rest(model, 0)])))
    truth = trajectory_truth(model, unloaded, TIMES[:3])
    assert truth.method.startswith("Taylor's method") and truth.uncertainty["position"][-1] < 1e-13


def test_precisions_agree():
    model = tree_from_seed(3, 3, ("rod", "universal", "cylindrical"))
    (state,) = random_states(model, 1, 1)
    quad, extended, double = (taylor(model, state, TIMES, name)[2] for name in ("quad", "extended", "double"))
    assert extended.r.dtype == quad.r.dtype == np.longdouble
    assert np.max(np.abs(extended.r - quad.r)) < 1e-16
    assert 0 < np.max(np.abs(double.r - quad.r)) < 1e-12


# a wrong truth is reported


@pytest.mark.parametrize("side", ["simulate_taylor", "simulate_notes_form"])
@pytest.mark.parametrize("field", ["mass", "point"])
def test_a_parameter_error_of_1e_10_in_one_method_is_detected(monkeypatch, side, field):
    case = catalogue_scenario("cart-pole")
    assert not ground_truth.motion_truth(case.model, case.state, TIMES, None).conflict
    right = getattr(trajectory, side)

    def wrong(model, state, *rest):
        changed = model.changed(
            **{
                field: getattr(model, field)
                * (1 + 1e-10 * (np.arange(2) > 0)).reshape(-1, *(1,) * (getattr(model, field).ndim - 1))
            }
        )
        return right(changed, complete_state(changed, state), *rest)

    monkeypatch.setattr(trajectory, side, wrong)
    assert ground_truth.motion_truth(case.model, case.state, TIMES, None).conflict


# the horizon


def test_perturbed_states_are_on_the_manifold_and_near():
    model = tree_from_seed(4, 7)
    (state,) = random_states(model, 1, 3)
    for near in perturbed_states(model, state, 1e-6, 5):
        pdot = quaternion_rate(near.p, near.omega)
        rows = constraint_rows(model, near.r, near.p, near.v, pdot)
        assert np.max(np.abs(rows.C)) < 1e-14
        assert np.max(np.abs(rows.constraint_rate(near.v, pdot))) < 1e-13
        assert 0 < position_error(near.r, state.r) < 1e-4
        back = project_to_manifold(model, near.r + 1e-9, near.p, near.v, pdot)
        assert position_error(back.r, near.r) < 1e-8


def test_growth_of_perturbations_is_that_of_two_runs():
    case = catalogue_scenario("double-hinge-skew")
    times = np.arange(5) * 0.5
    growth = perturbation_growth(case.model, case.state, times)
    near = perturbed_states(case.model, case.state, 1e-9, 1)[0]
    one, other = (taylor(case.model, at, times)[:2] for at in (case.state, near))
    arm = np.max(np.linalg.norm(one[0], axis=-1))
    apart = np.maximum(position_error(one[0], other[0]) / arm, attitude_error(one[1], other[1])) / 1e-9
    assert np.all(apart[1:] < 20 * growth[1:])
    assert np.all(apart[1:] > growth[1:] / 100)
    assert growth[-1] > 10


def test_perturbed_models_change_points_of_joints():
    case = catalogue_scenario("tree-of-seven")
    *_, moved = perturbed_models(case.model, case.state)
    ratio = moved[0].point[case.model.point != 0] / case.model.point[case.model.point != 0]
    np.testing.assert_allclose(np.abs(ratio - 1), 1e-4, rtol=1e-8)
    np.testing.assert_array_equal(moved[1].x, case.state.x)
