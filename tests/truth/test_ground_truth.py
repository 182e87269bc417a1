"""What engines are measured with: sizes, mistakes that must be visible, and where the truth comes from."""

import re
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import State, StateQuantities, Trajectory
from plumbline.model.invariants import MOTION_UNITS, invariant_scales
from plumbline.model.kinematics import complete_state, quaternion_product, quaternion_rate
from plumbline.model.sampling import random_states
from plumbline.truth import TruthUnavailable, ground_truth
from plumbline.truth.ground_truth import (
    DETECTABLE_PARAMETER_ERROR,
    TRUTHS_DIFFER,
    detectable_effect,
    least_detectable_effect,
    motion_truth,
    perturbed_models,
    stretched_length,
)
from plumbline.truth.predictability_horizon import perturbation_growth
from plumbline.truth.rounding_bound import state_rounding_bound
from plumbline.truth.trajectory_truth import TrajectoryTruth, trajectory_truth
from tests.helpers import pendulums

TIMES = np.linspace(0, 1, 9)


def test_stretched_length_is_the_largest_extent_of_each_body():
    """At least to its centre, at least its radius of gyration; nothing is attached to the last."""
    model = pendulums.make_model("rbb").changed(
        mass=np.array([1.0, 2.0, 4.0]),
        inertia=np.array([1e-4, 1e-4, 8.0 * 2 / 3])[:, None, None] * np.eye(3),
        proximal=np.array([[0, 0, 0.3], [0.6, 0, 0], [0, 0, 0.5]]),
        distal=np.array([[0, 0.4, 0], [0.5, 0, 0], [9.0, 9, 9]]),
        length=np.array([0.25, 0, 0]),
    )
    assert stretched_length(model) == pytest.approx([0.25 + 0.5, 0.6, np.sqrt(2.0)], rel=1e-14)
    assert stretched_length(model.changed(inertia=1e-3 * model.inertia)) == pytest.approx(
        [0.75, 0.6, 0.5], rel=1e-14
    )


def test_the_least_effect_ignores_invisible_ones():
    effects = [np.array([0, 1.0, 3, 2]), np.array([0, 5.0, 1, 9]), np.array([0, 1e-9, 2e-9, 0])]
    assert least_detectable_effect(effects, 1e-3).tolist() == [0, 1, 3, 3]
    assert least_detectable_effect(effects, 1e-7).tolist() == [0, 1e-9, 2e-9, 2e-9]
    assert least_detectable_effect(effects, 5e3).tolist() == [0, 5, 5, 9]
    assert least_detectable_effect(effects, 9e3).tolist() == [9e3] * 4, "none is visible"
    assert least_detectable_effect(effects[:1], 9e3).tolist() == [9e3] * 4


@pytest.mark.parametrize("joints", ["b", "rb"])
def test_each_perturbed_model_has_one_kind_of_error_of_one_part_in_ten_thousand(joints):
    model = pendulums.make_model(joints)
    at = pendulums.state_from_seed(model, seed=5)
    altered = ["gravity", "mass", "inertia", "point"]
    found = perturbed_models(model, at)
    assert len(found) == len(altered)
    for (wrong, state), its_own in zip(found, altered, strict=True):
        for name in model.fields:
            was, now = getattr(model, name), getattr(wrong, name)
            if name != its_own:
                assert np.array_equal(was, now), name
                continue
            if name == "point":  # the chain hangs from the origin
                assert np.array_equal(now[0, 0], was[0, 0])
                was, now = was[was != 0], now[was != 0]
            part = np.abs(now / was - 1)
            if name == "inertia":  # two entries of ± 1e-4 make one of a symmetric tensor
                assert (
                    np.all(part < 1.001 * DETECTABLE_PARAMETER_ERROR)
                    and np.ptp(now / was) > 0.9 * DETECTABLE_PARAMETER_ERROR
                )
                assert np.array_equal(now, now.mT)
            else:
                assert part == pytest.approx(np.full(part.shape, DETECTABLE_PARAMETER_ERROR), rel=1e-9)
        lifted = complete_state(wrong, State(at.p, at.omega, at.u, at.udot))
        for name in ("p", "omega", "u", "udot", "r", "v"):
            assert np.array_equal(getattr(state, name), getattr(lifted, name))
    offsets = found[3][0].proximal / model.proximal
    assert np.any(offsets > 1) and np.any(offsets < 1), "signs are drawn"


def test_a_motion_that_no_mistake_changes_must_be_seen_to_change():
    model = pendulums.make_model("b").changed(gravity=np.zeros(3))
    found = motion_truth(model, pendulums.state_from_seed(model, seed=2, rate=0.0), TIMES, None)
    assert np.array_equal(found.detectable["attitude"], np.full(9, DETECTABLE_PARAMETER_ERROR))


def test_detectable_effects_are_the_least_on_each_quantity():
    model = pendulums.make_model("b")
    length = float(np.sum(stretched_length(model)))
    r, p = np.zeros((4, 9, 1, 3)), np.tile([1.0, 0, 0, 0], (4, 9, 1, 1))
    v, omega = np.zeros((2, 4, 9, 1, 3))
    speed = np.sqrt(np.linalg.norm(model.gravity) * length)  # of a fall: at rest nothing is faster
    for k, size in enumerate((2e-5, 5e-5, 0.9e-3 * DETECTABLE_PARAMETER_ERROR * length), start=1):
        r[k, :, 0, 1] = size * TIMES
    for k, angle in enumerate((1e-5, 3e-5, 0.9e-3 * DETECTABLE_PARAMETER_ERROR), start=1):
        turn = np.stack(
            [np.cos(angle * TIMES / 2), *(np.sin(angle * TIMES / 2) * np.eye(3)[k - 1][:, None])], -1
        )
        p[k] = quaternion_product(p[k], turn[:, None])
    threshold = 0.9e-3 * DETECTABLE_PARAMETER_ERROR * speed
    for k, size in enumerate((3e-5, 4e-5, threshold), start=1):
        v[k, :, 0, 2] = size * TIMES
    for k, size in enumerate((5e-5, 4e-5, 2 * threshold / length), start=1):
        omega[k, :, 0, 0] = size * TIMES

    def found():
        rates = quaternion_rate(p, omega)
        return detectable_effect(
            model, [Trajectory(TIMES, *run, 0) for run in zip(r, p, v, rates, strict=True)]
        )

    effects = found()
    assert effects["position"] == pytest.approx(2e-5 * TIMES, abs=1e-18)  # the third is no effect
    assert effects["attitude"] == pytest.approx(1e-5 * TIMES, rel=1e-6, abs=0)
    assert effects["velocity"] == pytest.approx(3e-5 * TIMES, abs=1e-18)
    assert effects["angular_velocity"] == pytest.approx(4e-5 * TIMES, rel=1e-9, abs=1e-18)
    r[3] *= 1.2 / 0.9
    assert found()["position"] == pytest.approx(
        1.2e-3 * DETECTABLE_PARAMETER_ERROR * length * TIMES, rel=1e-9, abs=0
    )


def test_state_truth_is_certified_or_states_that_it_is_not():
    pytest.importorskip("flint")
    model = pendulums.make_model("rb", loads=True, drag=True)
    states = random_states(model, 3, seed=2)
    found = ground_truth.state_truth(model, states)
    assert re.fullmatch(r"certified: enclosed in ball arithmetic of \d+ bits", found.method)
    with patch("plumbline.truth.ground_truth.certify_state", side_effect=TruthUnavailable("gone")):
        other = ground_truth.state_truth(model, states)
    assert "truth tools are not installed" in other.method
    reported = load_adapter("reference").evaluate(model, states)
    for truth in (found, other):
        assert truth.states == states
        for mine, theirs, bound, state in zip(truth.quantities, reported, truth.bounds, states, strict=True):
            assert np.array_equal(bound.acceleration, state_rounding_bound(model, state).acceleration)
            for q in bound.scale.keys() - {"joint_moment"}:  # a chain of balls and rods has none
                off = np.max(np.abs(np.asarray(getattr(mine, q)) - getattr(theirs, q)))
                assert off <= np.max(bound.tolerance(q)), q
    assert all(isinstance(q, StateQuantities) and q.mass_matrix is not None for q in found.quantities)


def test_motion_truth_holds_growth_length_and_detectable_effects():
    model = pendulums.make_model("bb")
    at = pendulums.state_from_seed(model, seed=2, rate=0.5)
    found, run = motion_truth(model, at, TIMES, None), trajectory_truth(model, at, TIMES)
    for name in ("r", "p", "v", "pdot"):
        assert np.array_equal(getattr(found.trajectory, name), getattr(run.trajectory, name))
    assert found.uncertainty.keys() == run.uncertainty.keys() == MOTION_UNITS.keys()
    for name, size in found.uncertainty.items():
        assert np.array_equal(size, run.uncertainty[name])
    assert found.method == run.method and found.length == pytest.approx(
        float(np.sum(stretched_length(model)))
    )
    assert np.all(np.diff(found.growth) >= 0) and found.growth[0] >= 1
    assert found.growth == pytest.approx(
        np.maximum.accumulate(perturbation_growth(model, at, TIMES)),
        rel=1e-4,  # in other company, so by other steps
    )
    runs = [
        pendulums.reference_trajectory(m, s, TIMES) for m, s in [(model, at), *perturbed_models(model, at)]
    ]
    for name, theirs in detectable_effect(model, runs).items():
        mine = found.detectable[name]
        assert mine[1:] == pytest.approx(theirs[1:], rel=1e-5) and mine[-1] > 1e-7


@pytest.fixture(scope="module")
def ball():
    """A ball, its initial state and its motion."""
    model = pendulums.make_model("b")
    at = pendulums.state_from_seed(model, seed=2, rate=0.5)
    return model, at, motion_truth(model, at, TIMES, None)


@pytest.mark.parametrize("wrong", ["", *MOTION_UNITS])
def test_two_methods_that_differ_by_more_than_rounding_are_reported(ball, wrong):
    model, at, sound = ball
    limit = 1e3 * np.finfo(float).eps * sound.growth  # 10³ ε G(t), as the rows say
    off = np.zeros(9)
    off[-1] = 1.0
    speed = invariant_scales(model, sound.trajectory, sound.length)["gap_rate"]
    scales = sound.length, 2.0, speed, 2 * speed / sound.length
    differences = {
        name: (1.1 if name == wrong else 0.9) * scale * limit * off
        for name, scale in zip(MOTION_UNITS, scales, strict=True)
    }
    made = TrajectoryTruth(sound.trajectory, differences, "made")
    with patch("plumbline.truth.trajectory_truth.trajectory_truth", lambda *_: made):
        found = motion_truth(model, at, TIMES, None)
    assert found.method == "made" and bool(found.conflict) is bool(wrong)
    assert not wrong or (found.conflict.startswith(TRUTHS_DIFFER) and "1.1 times what" in found.conflict)


@pytest.mark.parametrize("name", MOTION_UNITS)
def test_a_truth_that_is_not_a_number_is_in_doubt(ball, name):
    model, at, sound = ball
    made = TrajectoryTruth(sound.trajectory, sound.uncertainty | {name: np.full(9, np.nan)}, "made")
    with patch("plumbline.truth.trajectory_truth.trajectory_truth", lambda *_: made):
        assert motion_truth(model, at, TIMES, None).conflict


def test_what_nothing_moves_has_a_truth(ball):
    """Where rates are 0 rounding explains no difference, and there is none; a difference is in doubt."""
    model, at, _ = ball
    alone = model.changed(**{name: 0 * getattr(model, name) for name in ("gravity", "force", "moment")})
    still = complete_state(alone, replace(at, omega=0 * at.omega))
    sound = motion_truth(alone, still, TIMES, None)
    assert not sound.conflict and not np.any(sound.uncertainty["velocity"])
    off = TrajectoryTruth(sound.trajectory, sound.uncertainty | {"velocity": np.full(9, 1e-20)}, "made")
    with patch("plumbline.truth.trajectory_truth.trajectory_truth", lambda *_: off):
        assert motion_truth(alone, still, TIMES, None).conflict


def test_the_wanted_time_does_not_shrink_with_the_uncertainty(ball):
    *_, sound = ball
    vague = replace(sound, uncertainty=sound.uncertainty | {"position": np.linspace(0, 1e-8, 9)})
    assert sound.horizon == sound.wanted_time == vague.wanted_time == 1.0
    assert vague.horizon == 0.0


def test_taylors_method_is_limited_in_bodies(ball):
    model, at, _ = ball
    found = motion_truth(model, at, TIMES[:3], None, max_compiled_bodies=0)
    assert "not used for more than 0 bodies" in found.method


def test_a_closed_form_replaces_the_motion(ball):
    model, at, _ = ball
    run = pendulums.reference_trajectory(model, at, TIMES)
    found = motion_truth(model, at, TIMES, (run.r + 1e-9, run.p, "a book"))
    assert np.array_equal(found.trajectory.r, run.r + 1e-9) and "closed form: a book" in found.method
    assert found.uncertainty["position"][-1] == pytest.approx(1e-9 * np.sqrt(3), rel=1e-6, abs=0)
