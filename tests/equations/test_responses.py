"""Responses to wrenches and accelerations of joints, against changed mechanisms."""

import numpy as np
import pytest

from plumbline.equations.responses import Responses
from plumbline.model.kinematics import rotation_matrix
from plumbline.model.loops import cut_open
from plumbline.model.sampling import compared_states
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers.catalogue import catalogue_scenarios

NAMES = (
    "chain-5-mixed", "tree-of-seven-sprung", "free-body-with-rotors", "point-mass-arm", "flyball-governor",
    "crowded-loops-1",
)  # fmt: skip


def cut(name, count=2):
    """A scenario's mechanism, cut open, with its states and the arguments of its ends."""
    scenario = catalogue_scenarios()[name]
    model, states = scenario.model, compared_states(scenario.model, scenario.state, scenario.seed, count)
    if not model.has_loops:
        return model, states, ()
    opened = cut_open(model)
    return opened.model, [opened.state(state) for state in states], (opened.ends, opened.row_scale)


@pytest.mark.parametrize("name", (*NAMES, "bricard", "squeezer", "four-bars-2-flat"))
def test_solutions_are_true(name):
    scenario = catalogue_scenarios()[name]
    states = compared_states(scenario.model, scenario.state, scenario.seed, 3)
    model, opened, ends = cut(name, 3)
    place = cut_open(scenario.model).place[: scenario.model.n] if ends else np.arange(model.n)
    for solution, state in zip(Responses(model, opened, *ends).solution, states, strict=True):
        true, bound = (
            certify_state(scenario.model, state).quantities,
            state_rounding_bound(scenario.model, state),
        )
        error = np.linalg.norm(solution[place, 0] - true.acceleration, axis=1)
        assert np.all(error <= 0.1 * bound.acceleration)


@pytest.mark.parametrize("name", NAMES)
def test_responses_to_wrenches_are_differences_between_loads(name):
    model, states, ends = cut(name)
    right, scale = Responses(model, states, *ends), 1e3
    force, moment = np.random.default_rng(3).normal(size=(2, model.n, 3)) * scale
    turned = model.changed(force=model.force + force)
    body_axes = [np.matvec(rotation_matrix(state.p).mT, moment) for state in states]
    answer = np.einsum("snqikcj,kcj->snqi", right.to_wrenches(), np.stack([force, moment], 1))
    for s, state in enumerate(states):
        other = turned.changed(moment=turned.moment + body_axes[s])
        change = Responses(other, [state], *ends).solution[0] - right.solution[s]
        np.testing.assert_allclose(answer[s], change, rtol=0, atol=1e-8 * np.max(np.abs(change)))


@pytest.mark.parametrize("name", [name for name in NAMES if "rotors" not in name and "loops" not in name])
def test_wrenches_and_accelerations_of_joints_are_reciprocal(name):
    """Without rotors: what a wrench at a body does to a joint, the joint does to the body."""
    model, states, ends = cut(name)
    found = Responses(model, states, *ends)
    of_bodies, of_joints, first = found.to_wrenches(), found.to_joints(), 0
    for k, held in enumerate(found.held):
        wrench = np.moveaxis(of_bodies[:, k, 2:], (1, 2), (-2, -1)).reshape(len(states), model.n, 2, 3, 6)
        expected = -wrench @ held[:, None, None]
        last = first + held.shape[-1]
        np.testing.assert_allclose(
            of_joints[:, :, :2, :, first:last],
            expected,
            rtol=0,
            atol=1e-9 * np.max(np.abs(expected), initial=1.0),
        )
        first = last
