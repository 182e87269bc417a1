"""Certified quantities of model files: closed forms, energy, MuJoCo's dynamics, and no false alarms."""

import math
from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.importer_calls import evaluate_model_file
from plumbline.importers.lumping import lump_fixed_bodies
from plumbline.importers.neutral_model import CanonicalState, ElementaryJoint, NeutralBody, NeutralModel
from plumbline.importers.urdf import read_urdf
from plumbline.importers.xml_tree import parse_xml
from plumbline.model_files.certified_model import certify_model, pose_tolerances
from plumbline.model_files.model_comparison import certify_states, mismatches, model_states
from tests.helpers.importer_columns import prepared_file, read_by_mujoco
from tests.helpers.random_robots import random_mjcf, random_urdf

FALSE_ALARM_ROBOTS = 500  # of each format, with 10 states


def pendulum(**joint):
    hinge = ElementaryJoint("j", "hinge", np.array([0.0, 1.0, 0.0]), np.zeros(3), **joint)
    turn, center = np.array([1.0, 0, 0, 0]), np.array([0, 0, -0.5])
    body = NeutralBody("b", -1, np.zeros(3), turn, (hinge,), 2.0, center, np.diag([1, 3, 2.0]))
    return NeutralModel("pendulum", (body,), np.array([0, 0, -10.0]))


def test_a_pendulum_has_its_closed_form():
    state = CanonicalState(np.array([0.4]), np.array([-0.7]))
    certified = certify_model(
        pendulum(armature=0.25, damping=0.3, stiffness=2.0, spring_reference=0.1, reference=0.15), state
    ).quantities
    angle, M = 0.4 - 0.15, 3 + 2 * 0.5**2 + 0.25
    gravity, passive = 2 * 10 * 0.5 * math.sin(angle), 0.3 * 0.7 - 2 * (0.4 - 0.1)
    assert certified.mass_matrix == pytest.approx(np.array([[M]]), rel=1e-15)
    assert certified.bias_force == pytest.approx([gravity], rel=1e-14)
    assert certified.gravity_force == pytest.approx([gravity], rel=1e-14)
    assert certified.passive_force == pytest.approx([passive], rel=1e-14)
    assert certified.acceleration == pytest.approx([(passive - gravity) / M], rel=1e-14)
    assert certified.kinetic_energy == pytest.approx(M * 0.7**2 / 2, rel=1e-15)
    assert certified.potential_energy == pytest.approx(-2 * 10 * 0.5 * math.cos(angle), rel=1e-15)


def test_lumped_bodies_have_the_same_quantities():
    rng = np.random.default_rng(3)
    text = random_urdf(rng, 5, ("revolute", "fixed", "fixed"))
    model = read_urdf(parse_xml(text.encode(), "robot"), "fixed")
    lumped = lump_fixed_bodies(model)
    assert len(lumped.bodies) < len(model.bodies)
    states = model_states(model, 3, 1)
    found = mismatches(
        lumped, certify_states(lumped, states), [t.quantities for t in certify_states(model, states)]
    )
    assert max(m.ratio for m in found.values()) < 0.2


def test_a_massless_moving_link_has_no_acceleration():
    model = pendulum()
    body = model.bodies[0]
    still = NeutralBody("c", 0, np.zeros(3), body.attitude, body.joints, 0.0, np.zeros(3), np.zeros((3, 3)))
    certified = certify_model(
        NeutralModel("m", (body, still), model.gravity), CanonicalState(np.zeros(2), np.ones(2))
    )
    assert certified.quantities.acceleration is None
    assert certified.quantities.mass_matrix[1, 1] == 0


def test_the_rounding_of_a_balls_damping_is_that_of_a_turned_vector():
    """An engine that has the rates in other axes has the rounding of the largest in each."""
    body = pendulum().bodies[0]
    joint = replace(body.joints[0], kind="ball", damping=0.05, stiffness=0.0)
    model = NeutralModel("m", (replace(body, joints=(joint,)),), np.array([0.0, 0, -10]))
    state = CanonicalState(np.array([1.0, 0, 0, 0]), np.array([0.1, 3.0, 0]))
    limits = certify_model(model, state).tolerance["passive_force"]
    assert limits == pytest.approx([limits[1]] * 3, rel=1e-12, abs=0)
    assert limits[1] >= 0.05 * 3 * 2.0**-53


def compare(tmp_path, text, count):
    _, prepared = prepared_file(tmp_path, text)
    model = read_by_mujoco(prepared)
    states = model_states(model, count, 7)
    answers = evaluate_model_file("mujoco", prepared.file, states)
    return {name: m.ratio for name, m in mismatches(model, certify_states(model, states), answers).items()}


@pytest.mark.parametrize("seed", range(6))
def test_mujoco_agrees_at_random_states_of_random_robots(tmp_path, seed):
    rng = np.random.default_rng(seed)
    for make in (random_urdf, random_mjcf):
        found = compare(tmp_path, make(rng, 5), 3)
        assert {"position", "attitude", "mass_matrix", "bias_force", "acceleration"} <= found.keys()
        assert max(found.values()) <= 1, found


def test_no_bound_of_a_pose_is_zero_where_anything_lies_elsewhere():
    """A fixed part's way counts for what carries it and for what hangs there; rounding passes through it."""
    model = pendulum()
    still = NeutralBody("still", -1, np.zeros(3), np.array([1.0, 0, 0, 0]), (), 1.0, np.zeros(3), np.eye(3))
    far = replace(still, name="far", parent=0, position=np.array([2.0, 0, 0]))
    hung = replace(
        model.bodies[0], name="hung", parent=0, position=np.zeros(3), center=np.zeros(3), joints=()
    )
    state = CanonicalState(np.zeros(0), np.zeros(0))
    alone = pose_tolerances(NeutralModel("m", (still, hung), model.gravity), state)
    assert alone["hung"][0, 3] == 0, "all terms vanish"
    bounds = pose_tolerances(NeutralModel("m", (still, far, hung), model.gravity), state)
    assert bounds["still"][0, 3] == bounds["hung"][0, 3] == pytest.approx(2 * bounds["hung"][0, 0])


@pytest.mark.full
@pytest.mark.timeout(3000)
def test_no_false_alarm_in_ten_thousand_states(tmp_path):
    rng = np.random.default_rng(11)
    worst = {}
    for _ in range(FALSE_ALARM_ROBOTS):
        for make in (random_urdf, random_mjcf):
            for name, ratio in compare(tmp_path, make(rng, int(rng.integers(1, 9))), 10).items():
                worst[name] = max(ratio, worst.get(name, 0.0))
    print(worst)
    assert max(worst.values()) <= 1
