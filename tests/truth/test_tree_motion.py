"""Motions of trees: Taylor's method in joint coordinates, the notes' form, closed forms, the horizon."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from plumbline.model.datatypes import KINDS, Model
from plumbline.model.invariants import attitude_error, compute_invariants, position_error
from plumbline.model.kinematics import ball_spring_rest, complete_state, quaternion_rate, state_from_minimal
from plumbline.model.random_mechanisms import ELEMENTS, random_tree
from plumbline.model.sampling import random_states
from plumbline.scenario.loader import find_scenario_file, load_scenario
from plumbline.truth import ground_truth
from plumbline.truth import trajectory_truth as trajectory
from plumbline.truth.closed_form.tops_and_pendulums import free_top, planar_pendulum
from plumbline.truth.ground_truth import perturbed_models
from plumbline.truth.predictability_horizon import perturbation_growth, perturbed_states, project_to_manifold
from plumbline.truth.taylor import simulate_taylor
from plumbline.truth.trajectory_truth import NOTES_RTOL, simulate_notes_form, trajectory_truth
from reference_impl.joints import constraint_rows
from tests.helpers.nightly_tests import SLOW

TIMES = np.arange(9) * 0.125
UNIT = np.array([1.0, 0.0, 0.0, 0.0])

pytestmark = pytest.mark.skipif(
    not (find_spec("heyoka") and find_spec("mpmath")), reason="the truth tools are not installed"
)


def taylor(model, state, times=TIMES, precision="extended"):
    run = simulate_taylor(model, state, times, precision)
    return np.asarray(run.r, float), np.asarray(run.p, float), run


FAST_KINDS = ("universal", "cylindrical", "free")  # compiled in a second each; engines run the others


@pytest.mark.parametrize("kind", [pytest.param(x, marks=[] if x in FAST_KINDS else SLOW) for x in KINDS])
def test_both_methods_agree_on_every_kind_of_joint(kind):
    model = random_tree(np.random.default_rng(5), 3, (kind, "hinge", "ball"))
    (state,) = random_states(model, 1, 2)
    other = simulate_notes_form(model, state, TIMES, NOTES_RTOL)
    r, p, run = taylor(model, state)
    assert np.max(position_error(r, other.r)) < 1e-12 * max(1.0, np.max(np.abs(r)))
    assert np.max(attitude_error(p, other.p)) < 1e-11
    np.testing.assert_allclose(np.asarray(run.v, float), other.v, atol=1e-11 * np.max(np.abs(other.v)))


def test_both_methods_agree_on_mixed_trees():
    for seed in range(3):
        model = random_tree(np.random.default_rng(seed), 6)
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
    model = random_tree(np.random.default_rng(3), 3, kinds, elements=(element,))
    (state,) = random_states(model, 1, 2)
    times = TIMES[:3]
    other = simulate_notes_form(model, state, times, NOTES_RTOL)
    r, p, _ = taylor(model, state, times, "double")
    assert np.max(position_error(r, other.r)) < 1e-13
    assert np.max(attitude_error(p, other.p)) < 1e-12


@pytest.mark.parametrize("kinds", [("ball",), ("ball", "universal", "rod")], ids=str)
def test_both_methods_agree_on_springs_of_balls(kinds):
    model = random_tree(np.random.default_rng(3), 3, kinds, elements=("stiffness",))
    (state,) = random_states(model, 1, 2)
    truth = trajectory_truth(model, state, TIMES[:3])
    assert "ball" in model.kind and truth.method.startswith("Taylor's method")
    assert truth.uncertainty["position"][-1] < 1e-13 and truth.uncertainty["attitude"][-1] < 1e-12


def test_a_spring_of_a_ball_at_rest_has_a_taylor_series():
    """θ/sin θ is 0/0 where the spring is unloaded."""
    model = random_tree(np.random.default_rng(3), 1, ("ball",), elements=("stiffness",))
    (state,) = random_states(model, 1, 2)
    unloaded = complete_state(model, replace(state, p=np.array([ball_spring_rest(model, 0)])))
    truth = trajectory_truth(model, unloaded, TIMES[:3])
    assert truth.method.startswith("Taylor's method") and truth.uncertainty["position"][-1] < 1e-13


def test_precisions_agree():
    model = random_tree(np.random.default_rng(3), 3, ("rod", "universal", "cylindrical"))
    (state,) = random_states(model, 1, 1)
    quad, extended, double = (taylor(model, state, TIMES, name)[2] for name in ("quad", "extended", "double"))
    assert extended.r.dtype == quad.r.dtype == np.longdouble
    assert np.max(np.abs(extended.r - quad.r)) < 1e-16
    assert 0 < np.max(np.abs(double.r - quad.r)) < 1e-12


def test_invariants_hold_along_the_true_motion():
    model = replace(
        random_tree(np.random.default_rng(2), 6, loads=False), gravity=np.array([0.0, 0.0, -9.81])
    )
    (state,) = random_states(model, 1, 4)
    run = trajectory_truth(model, state, TIMES).trajectory
    found = compute_invariants(model, run)
    for name in ("energy_drift", "joint_gap", "gap_rate", "norm_drift"):
        assert np.max(np.abs(getattr(found, name))) < 1e-10, name


@pytest.mark.parametrize(
    ("scenario", "is_conserved"), [("furuta", True), ("hinge-pendulum", False), ("universal-pendulum", False)]
)
def test_momentum_is_conserved_where_joints_at_the_world_allow_it(scenario, is_conserved):
    case = load_scenario(find_scenario_file(scenario))
    bare = {name: 0 * getattr(case.model, name) for name in ("force", "moment", "drag_force", "drag_moment")}
    model = replace(case.model, **bare)
    run = trajectory_truth(model, case.state, TIMES).trajectory
    drift = compute_invariants(model, run).momentum_drift
    assert (drift is not None) == is_conserved
    if drift is not None:
        assert np.max(np.abs(drift)) < 1e-14


def planar_bodies(n, inertia):
    """A chain of balls that moves in the plane x z, and its state."""
    model = Model.chain(
        mass=np.array([1.2, 0.7])[:n], inertia=inertia, proximal=np.array([[0.1, 0, 0.3], [0, 0, 0.2]])[:n],
        distal=np.array([[0.05, 0, -0.3], [0, 0, 0]])[:n], length=np.zeros(n),
        gravity=np.array([0, 0, -9.81]), force=np.zeros((n, 3)), moment=np.zeros((n, 3)),
        drag_force=np.zeros(n), drag_moment=np.zeros(n),
    )  # fmt: skip
    half = np.array([0.4, -0.9])[:n]
    p = np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half], 1)
    omega = np.array([[0, 1.5, 0], [0, -4.0, 0]])[:n]
    return model, state_from_minimal(model, p, omega, np.zeros((n, 3)), np.zeros((n, 3)))


def on_hinges(model, state):
    """The same bodies on hinges about y, with products of inertia that balls would feel."""
    half = np.sqrt(0.5)
    turn = np.tile([half, -half, 0, 0], (model.n, 2, 1))  # takes z to y
    full = model.inertia.copy()
    full[:, 0, 1] = full[:, 1, 0] = 0.004
    hinged = Model(**(vars(model) | {"kind": ("hinge",) * model.n, "turn": turn, "inertia": full}))
    angle = 2 * np.arctan2(state.p[:, 2], state.p[:, 0])
    x, xdot = np.zeros((2, model.n, 2))
    x[:, 0] = np.diff(angle, prepend=0.0)
    xdot[:, 0] = np.diff(state.omega[:, 1], prepend=0.0)
    return hinged, complete_state(hinged, replace(state, x=x, xdot=xdot))


def test_a_hinge_pendulum_moves_by_elliptic_functions():
    model, state = planar_bodies(1, np.diag([0.03, 0.03, 0.03])[None])
    hinged, start = on_hinges(model, state)
    np.testing.assert_allclose(start.r, state.r, atol=1e-15)
    r, p, _ = taylor(hinged, start)
    exact_r, exact_p = planar_pendulum(model, state)(TIMES)
    assert np.max(position_error(r, exact_r)) < 2e-15
    assert np.max(attitude_error(p, exact_p)) < 5e-15
    other = simulate_notes_form(hinged, start, TIMES, NOTES_RTOL)
    assert np.max(position_error(other.r, exact_r)) < 1e-14


def test_a_double_pendulum_on_parallel_hinges_moves_as_one_on_balls():
    """Joint angles and M = LᵀDL against quaternions and block elimination of joint forces."""
    model, state = planar_bodies(2, np.stack([np.diag([0.03, 0.02, 0.03]), np.diag([0.01, 0.015, 0.01])]))
    r, p, _ = taylor(*on_hinges(model, state))
    expected_r, expected_p, _ = taylor(model, state)
    assert np.max(position_error(r, expected_r)) < 1e-13
    assert np.max(attitude_error(p, expected_p)) < 1e-12


def test_a_free_body_turns_as_the_free_top_and_falls():
    case = load_scenario(find_scenario_file("free-top"))
    free = {"kind": ("free",), "point": 0 * case.model.point}
    model = replace(case.model, **free)
    velocity = np.array([[0.3, -0.2, 1.0]])
    state = complete_state(model, replace(case.state, r=np.zeros((1, 3)), v=velocity))
    r, p, _ = taylor(model, state)
    fall = TIMES[:, None, None] * velocity + TIMES[:, None, None] ** 2 / 2 * model.gravity
    assert np.max(position_error(r, fall)) < 2e-15
    assert np.max(attitude_error(p, free_top(case.model, case.state)(TIMES)[1])) < 1e-14


# a wrong truth is reported


@pytest.mark.parametrize("side", ["simulate_taylor", "simulate_notes_form"])
@pytest.mark.parametrize("field", ["mass", "point"])
def test_a_parameter_error_of_1e_10_in_one_method_is_detected(monkeypatch, side, field):
    case = load_scenario(find_scenario_file("cart-pole"))
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
    model = random_tree(np.random.default_rng(4), 7)
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
    case = load_scenario(find_scenario_file("double-hinge-skew"))
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
    case = load_scenario(find_scenario_file("tree-of-seven"))
    *_, moved = perturbed_models(case.model, case.state)
    ratio = moved[0].point[case.model.point != 0] / case.model.point[case.model.point != 0]
    np.testing.assert_allclose(np.abs(ratio - 1), 1e-4, rtol=1e-8)
    np.testing.assert_array_equal(moved[1].x, case.state.x)
