"""The certified quantities of trees: against the chains' formulas, a hinge pendulum and the reference."""

import time
from dataclasses import replace

import flint
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adapters.reference_engine import Reference
from plumbline.model.kinematics import complete_state, state_from_minimal
from plumbline.model.sampling import random_states
from plumbline.truth.balls import midpoints
from plumbline.truth.certified import certify_state, enclose_quantities
from plumbline.truth.certified_tree import enclose_tree
from tests.helpers.random_chains import random_chain
from tests.helpers.random_trees import random_tree


@pytest.mark.parametrize("rods", [(0,), (1,), (1, 0, 0, 1, 1)])
def test_a_chain_as_a_tree_has_the_same_quantities(rods):
    model, state = random_chain(np.random.default_rng(len(rods)), rods, loads=True, drag=True)
    chain = enclose_quantities(model, state, 200, mass_matrix=True)
    with flint.ctx.workprec(200):
        tree = enclose_tree(flint, model, state, mass_matrix=True)
    for name in set(chain) - {"scale", "tension"}:
        a, b = midpoints(chain[name]), midpoints(tree[name])
        np.testing.assert_allclose(a, b, rtol=1e-15, atol=1e-15 * np.max(np.abs(a)), err_msg=name)
    assert np.max(np.abs(midpoints(tree["joint_moment"]))) < 1e-40


def test_a_hinge_pendulum_obeys_its_equation():
    rng = np.random.default_rng(2)
    model = replace(random_tree(rng, 1, ("hinge",), loads=False), gravity=np.array([0.0, 0.0, -9.81]))
    (state,) = random_states(model, 1, 5)
    truth = certify_state(model, state).quantities
    near, far = (q[0] for q in np.split(model.turn[0], 2))
    z = state_axis(near)
    arm = state.r[0] - model.point[0, 0]
    rotation = rotation_of(state.p[0])
    inertia = z @ (rotation @ model.inertia[0] @ rotation.T) @ z
    inertia += model.mass[0] * (arm @ arm - (arm @ z) ** 2)
    angle = z @ np.cross(arm, model.mass[0] * model.gravity) / inertia
    np.testing.assert_allclose(truth.angular_acceleration[0], angle * state_axis(far), rtol=1e-12)


def state_axis(q):
    return rotation_of(q)[:, 2]


def rotation_of(q):
    return Rotation.from_quat(np.roll(q, -1)).as_matrix()


@pytest.mark.parametrize("seed", range(10))
def test_the_reference_agrees_on_random_trees(seed):
    model = random_tree(np.random.default_rng(seed), 8)
    states = random_states(model, 2, seed)
    for state, found in zip(states, Reference().evaluate(model, states), strict=True):
        truth = certify_state(model, state, mass_matrix=True)
        for name, value in vars(truth.quantities).items():
            scale = max(1.0, np.max(np.abs(value)))
            np.testing.assert_allclose(getattr(found, name), value, atol=1e-12 * scale, err_msg=name)
        assert max(truth.radius.values()) < 1e-20


def test_a_tree_of_thirty_takes_a_tenth_of_a_second():
    model = random_tree(np.random.default_rng(1), 30)
    (state,) = random_states(model, 1, 1)
    certify_state(model, state)
    start = time.process_time()
    certify_state(model, state)
    assert time.process_time() - start < 0.1


def test_a_wrong_coordinate_is_seen():
    model = random_tree(np.random.default_rng(4), 4, ("hinge",))
    (state,) = random_states(model, 1, 4)
    moved = complete_state(model, replace(state, x=state.x + 1e-9))
    here, there = (certify_state(model, at).quantities.acceleration for at in (state, moved))
    assert np.max(np.abs(here - there)) > 1e-11
    again = state_from_minimal(model, **vars(state))
    np.testing.assert_array_equal(again.r, state.r)
