"""The certified quantities of trees: against a hinge pendulum and the reference."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adapters.reference_engine import Reference
from plumbline.equations.arithmetic import midpoints
from plumbline.model.kinematics import complete_state, spring_vectors
from plumbline.model.random_mechanisms import ELEMENTS, random_loop_mechanism, random_tree
from plumbline.model.sampling import compared_states, random_states
from plumbline.truth.certified_state import certify_state, enclose_quantities
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers.random_chains import tree_from_seed
from tests.helpers.true_answers import assert_within_bound


def test_the_rates_of_a_loop_are_those_that_its_state_gives():
    """A ball, a universal joint and a free body in one loop: good coordinates would be bad rates here."""
    model, start = random_loop_mechanism(17, 3, ["weld"], ("ball", "universal", "free"))
    assert model.kind == ("ball", "universal", "free", "weld")
    for state in compared_states(model, start, "rates 10", 9):
        found = midpoints(enclose_quantities(model, state, 300)["v"])
        np.testing.assert_allclose(found, state.v, rtol=0, atol=1e-14 * np.max(np.abs(state.v)))


def rotation_of(q):
    return Rotation.from_quat(np.roll(q, -1)).as_matrix()


def compared(truth, found):
    """The true and the found quantities of a state; a limit is none of them, and an exact answer has none."""
    assert truth.limit_error is None
    pairs = [(name, x, getattr(found, name)) for name, x in vars(truth).items() if name != "limit_error"]
    assert all((x is None) == (y is None) for _, x, y in pairs)  # no joint transmits a moment
    return [pair for pair in pairs if pair[1] is not None]


@pytest.mark.parametrize("elements", [(), ELEMENTS], ids=["bare", "elements"])
@pytest.mark.parametrize("seed", range(10))
def test_the_reference_agrees_on_random_trees(seed, elements):
    """Single joints and elements: tests/adapters/test_engines_on_trees.py, on every engine."""
    model = tree_from_seed(seed, 8, elements=elements)
    states = random_states(model, 2, seed)
    for state, found in zip(states, Reference().evaluate(model, states), strict=True):
        truth, bound = certify_state(model, state, mass_matrix=True), state_rounding_bound(model, state)
        assert_within_bound(found, truth.quantities, bound)
        for name, value, own in compared(truth.quantities, found):
            scale = max(1.0, np.max(np.abs(value)))
            np.testing.assert_allclose(own, value, atol=1e-12 * scale, err_msg=name)
            assert name in bound.scale
        assert max(truth.radius.values()) < 1e-20


def one_body(kind, **elements):
    tree = tree_from_seed(3, 1, (kind,), loads=False)
    tree = replace(tree, gravity=np.zeros(3))
    return tree.changed(**{name: np.array([[value, 0.0]]) for name, value in elements.items()})


def at(model, x, rate):
    (state,) = random_states(model, 1, 3)
    return complete_state(model, replace(state, x=np.array([[x, 0.0]]), xdot=np.array([[rate, 0.0]])))


@pytest.mark.parametrize("turns", [-1, 0, 2])
def test_a_sprung_hinge_counts_whole_turns(turns):
    model = one_body("hinge", stiffness=2.0, rest=0.5)
    near, far = (at(model, 0.4 + 2 * np.pi * n, 0.0) for n in (0, turns))
    a, b = (certify_state(model, state).quantities.angular_acceleration[0] for state in (near, far))
    assert np.linalg.norm(b) == pytest.approx(np.linalg.norm(a) * abs(2 * np.pi * turns - 0.1) / 0.1)
    (found,) = Reference().evaluate(model, [far])
    np.testing.assert_allclose(found.angular_acceleration[0], b, rtol=1e-12)


def test_springs_at_exactly_their_rest_length_are_certified():
    """A ball around 0, squared by `**`, is NaN in python-flint."""
    model = tree_from_seed(8, 2, ("slide", "hinge"), loads=False, elements=("stiffness", "springs"))
    (state,) = random_states(model, 1, 3)
    length = np.linalg.norm(spring_vectors(model, state.r, state.p), axis=-1)
    at_rest = replace(model, rest=state.x, spring_length=length)
    found = certify_state(at_rest, state).quantities
    assert abs(found.potential_energy + np.sum(model.mass * (state.r @ model.gravity))) < 1e-12
    bare = replace(at_rest, stiffness=0 * model.stiffness, spring_stiffness=0 * model.spring_stiffness)
    right = certify_state(bare, state).quantities
    np.testing.assert_allclose(found.acceleration, right.acceleration, rtol=1e-10, atol=1e-10)
    assert model.stiffness.any() and len(length)


def test_a_rotor_is_a_body_that_spins_with_the_joint():
    """A rotor on a hinge is a second body on it, welded, whose only inertia is about the axis."""
    rng = np.random.default_rng(8)
    tree = random_tree(rng, 2, ("hinge",))
    state = random_states(tree, 1, 8)[0]
    k, a = 1, 0.7
    axis = rotation_of(tree.turn[k, 1])[:, 2]
    alone = replace(tree, body=np.array([[-1, 0], [-1, 1]]))  # from the world, where both spin alike
    state = complete_state(alone, state)
    heavy = alone.inertia.copy()
    heavy[k] += a * np.outer(axis, axis)
    armature = np.zeros((2, 2))
    armature[k, 0] = a
    body, rotor = (
        certify_state(model, state, mass_matrix=True).quantities
        for model in (alone.changed(inertia=heavy), alone.changed(armature=armature))
    )
    for name in ("acceleration", "angular_acceleration", "kinetic_energy", "mass_matrix"):
        np.testing.assert_allclose(getattr(rotor, name), getattr(body, name), rtol=1e-12, err_msg=name)


def test_a_ball_spring_pulls_along_the_rotation_vector():
    model = one_body("ball", stiffness=2.0)
    rest = (
        Rotation.from_quat(np.roll(model.turn[0, 0], -1))
        * Rotation.from_quat(np.roll(model.turn[0, 1], -1)).inv()
    )
    vector = np.array([0.6, -1.1, 0.3])
    attitude = Rotation.from_rotvec(vector) * rest
    (state,) = random_states(model, 1, 3)
    p = np.roll(attitude.as_quat(), 1)[None]
    state = complete_state(model, replace(state, p=p / np.linalg.norm(p), omega=np.zeros((1, 3))))
    truth = certify_state(model, state).quantities
    assert truth.potential_energy == pytest.approx(vector @ vector)
    moment = truth.joint_moment[0]
    np.testing.assert_allclose(moment, -2.0 * vector, rtol=1e-12)
    at_rest = np.roll(rest.as_quat(), 1)[None]
    unloaded = complete_state(model, replace(state, p=at_rest / np.linalg.norm(at_rest)))
    assert np.max(np.abs(certify_state(model, unloaded).quantities.angular_acceleration)) < 1e-13


def test_point_springs_pull_both_bodies_together():
    rng = np.random.default_rng(5)
    model = random_tree(rng, 2, ("free",), loads=False)
    model = replace(model, gravity=np.zeros(3)).changed(
        spring_body=np.array([[0, 1]]), spring_point=np.zeros((1, 2, 3)), spring_stiffness=np.array([5.0]),
        spring_damping=np.array([0.5]), spring_length=np.array([0.3]),
    )  # fmt: skip
    (state,) = random_states(model, 1, 5)
    truth = certify_state(model, state).quantities
    d, rate = state.r[1] - state.r[0], state.v[1] - state.v[0]
    length = np.linalg.norm(d)
    pull = (5.0 * (length - 0.3) + 0.5 * d @ rate / length) * d / length
    np.testing.assert_allclose(truth.acceleration, [pull / model.mass[0], -pull / model.mass[1]], rtol=1e-12)
    assert truth.potential_energy == pytest.approx(2.5 * (length - 0.3) ** 2)
