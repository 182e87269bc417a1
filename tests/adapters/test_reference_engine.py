"""The reference as an engine: the map to the contract's quantities, its errors, its raw trajectories."""

from dataclasses import replace

import numpy as np
import pytest

import plumbline
from adapters.reference_engine import Reference
from plumbline.model.datatypes import EngineFailure
from plumbline.model.kinematics import (
    angular_velocity,
    mass_matrix,
    rotation_matrix,
    state_from_minimal,
    velocity_jacobian,
)
from tests.helpers.random_chains import random_chain


def model_and_state(rods, seed=0, loads=True):
    """A generic model and a state of it."""
    return random_chain(np.random.default_rng(seed), rods, rate=1.0, loads=loads, drag=loads)


def generalized_velocity(model, state):
    """ν of the contract's mass matrix."""
    return np.concatenate([state.udot[model.rods].ravel(), state.omega.ravel()])


@pytest.mark.parametrize("rods", [[True], [False], [True, False, True], [False, True, False, False]], ids=str)
def test_velocity_map_gives_the_bodies_rates(rods):
    model, state = model_and_state(rods)
    bodies = (velocity_jacobian(model, state) @ generalized_velocity(model, state)).reshape(model.n, 6)
    np.testing.assert_allclose(bodies, np.hstack([state.v, state.omega]), atol=1e-14)


@pytest.mark.parametrize("rods", [[True], [False], [True, False, True], [False, True, False, False]], ids=str)
def test_energy_momentum_and_mass_matrix_belong_together(rods):
    model, state = model_and_state(rods)
    (reported,) = Reference().evaluate(model, [state])
    nu = generalized_velocity(model, state)
    np.testing.assert_allclose(reported.kinetic_energy, nu @ reported.mass_matrix @ nu / 2, rtol=1e-14)
    np.testing.assert_allclose(reported.mass_matrix, mass_matrix(model, state), atol=1e-14)
    spin = np.einsum("nij,njk,nk->ni", rotation_matrix(state.p), model.inertia, state.omega)
    momentum = np.cross(state.r, model.mass[:, None] * state.v) + spin
    np.testing.assert_allclose(reported.angular_momentum, momentum.sum(0), atol=1e-14)
    weight = -model.mass[:, None] * model.gravity
    np.testing.assert_allclose(reported.potential_energy, np.sum(weight * state.r), rtol=1e-13)


@pytest.mark.parametrize("rods", [[True, False], [False, True]], ids=str)
def test_accelerations_are_the_rates_of_the_velocities(rods):
    """Central differences of the simulated velocities at the middle of a run, to their own h² ω² error."""
    model, state = model_and_state(rods)
    h = 1e-4
    run = Reference().simulate(model, state, np.array([0, h, 2 * h]), "dop853", 1e-13)
    omega = angular_velocity(run.p, run.pdot)
    p = run.p[1] / np.linalg.norm(run.p[1], axis=1, keepdims=True)
    now = replace(state, p=p, r=run.r[1], v=run.v[1], omega=omega[1])
    (reported,) = Reference().evaluate(model, [now])
    np.testing.assert_allclose((run.v[2] - run.v[0]) / (2 * h), reported.acceleration, atol=1e-4)
    np.testing.assert_allclose((omega[2] - omega[0]) / (2 * h), reported.angular_acceleration, atol=1e-4)


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
    state = state_from_minimal(thin_body, state.p, state.omega, state.u, state.udot)
    with pytest.raises(EngineFailure, match="inertia of body 1 is singular"):
        Reference().evaluate(thin_body, [state])
    with pytest.raises(EngineFailure, match="inertia of body 1 is singular"):
        Reference().simulate(thin_body, state, np.array([0.0, 1.0]), "dop853", 1e-6)


def test_the_version_is_the_checkouts():
    assert Reference().version() == plumbline.__version__
    assert Reference.package == plumbline.__name__


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
