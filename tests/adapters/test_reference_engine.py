"""The reference as an engine: the map to the contract's quantities, its errors, its raw trajectories."""

import numpy as np
import pytest

from adapters.reference_engine import Reference
from plumbline.model.datatypes import EngineFailure, State
from plumbline.model.kinematics import (
    angular_velocity,
    complete_state,
    velocity_jacobian,
)
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.random_chains import random_chain


def model_and_state(rods, seed=0, loads=True):
    """A generic model and a state of it."""
    return random_chain(seed, rods, rate=1.0, loads=loads, drag=loads)


def generalized_velocity(model, state):
    """ν of the contract's mass matrix."""
    return np.concatenate([state.udot[model.rods].ravel(), state.omega.ravel()])


@pytest.mark.parametrize("rods", [[True], [False], [True, False, True], [False, True, False, False]], ids=str)
def test_velocity_map_gives_the_bodies_rates(rods):
    model, state = model_and_state(rods)
    bodies = (velocity_jacobian(model, state) @ generalized_velocity(model, state)).reshape(model.n, 6)
    np.testing.assert_allclose(bodies, np.hstack([state.v, state.omega]), atol=1e-14)


def test_trajectories_are_raw():
    """p leaves the unit sphere by truncation and nothing puts it back (E4)."""
    model, state = model_and_state([True, False])
    run = Reference().simulate(model, state, np.linspace(0, 2, 21), "dop853", 1e-6)
    off = np.abs(np.sum(run.p**2, -1) - 1)
    np.testing.assert_array_equal(run.p[0], state.p)
    assert 1e-8 < np.max(off) < 1e-3


def test_a_singular_model_fails_with_its_cause():
    model, state = model_and_state([False])
    inertia = np.diag([0.1, 0.1, 0.0])[None]
    thin_body = model.changed(inertia=inertia, proximal=np.array([[0, 0, 0.3]]))
    state = complete_state(thin_body, State(state.p, state.omega, state.u, state.udot))
    with pytest.raises(EngineFailure, match="inertia of body 1 is singular"):
        Reference().evaluate(thin_body, [state])
    with pytest.raises(EngineFailure, match="inertia of body 1 is singular"):
        Reference().simulate(thin_body, state, np.array([0.0, 1.0]), "dop853", 1e-6)


@pytest.mark.parametrize("option", Reference.options)
@pytest.mark.parametrize("name", ["sprung-ball", "tree-of-seven-sprung", "flyball-governor"])
def test_other_ways_to_solve_take_account_of_elements_and_loops(option, name):
    """Each answer is within the bound, and so their difference within two."""
    scenario = catalogue_scenario(name)
    usual, other = (
        engine.evaluate(scenario.model, [scenario.state])[0]
        for engine in (Reference(), Reference().with_option(option))
    )
    allowed = 2 * state_rounding_bound(scenario.model, scenario.state).acceleration
    assert np.all(np.linalg.norm(usual.acceleration - other.acceleration, axis=1) <= allowed)


@pytest.mark.full
def test_fifty_bodies_for_two_seconds():
    """A chain of 50 balls released with random rates keeps its energy to its tolerance's drift."""
    model, state = model_and_state([False] * 50, loads=False)
    run = Reference().simulate(model, state, np.linspace(0, 2, 5), "dop853", 1e-9)
    omega = angular_velocity(run.p, run.pdot)
    kinetic = np.einsum("n,tni,tni->t", model.mass, run.v, run.v)
    kinetic += np.einsum("tni,nij,tnj->t", omega, model.inertia, omega)
    energy = kinetic / 2 - np.einsum("n,tni,i->t", model.mass, run.r, model.gravity)
    assert np.max(np.abs(energy - energy[0])) < 1e-5 * kinetic.max()
