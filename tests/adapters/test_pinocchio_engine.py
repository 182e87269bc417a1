"""What is Pinocchio's own: the digits of its algorithms, massless rods, limits of a column."""

import multiprocessing
from dataclasses import replace
from functools import wraps

import numpy as np
import pytest

from plumbline.model import kinematics
from plumbline.model.datatypes import Unsupported
from plumbline.model.sampling import random_states
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers import engine_process as worker
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.random_chains import tree_from_seed

pin = pytest.importorskip("pinocchio")
pinocchio_engine = pytest.importorskip("adapters.pinocchio_engine")
maximal = pytest.importorskip("adapters.pinocchio_maximal_engine")
Chain, Pinocchio = pinocchio_engine.PinocchioChain, pinocchio_engine.Pinocchio
PinocchioMaximal = maximal.PinocchioMaximal

TIMES = np.linspace(0, 2, 5)
EPS = np.finfo(float).eps


def in_engine_process(test):
    """Run the test where a crash of the engine fails that test alone."""

    @wraps(test)
    def guarded(*args, **kwargs):
        if multiprocessing.parent_process():
            return test(*args, **kwargs)
        return worker.run_in_engine_process("pinocchio", guarded, *args, *kwargs.values())

    return guarded


def by(algorithm):
    engine = Pinocchio()
    engine.option = algorithm
    return engine


@in_engine_process
def test_rotors_that_a_copy_of_the_model_loses_are_seen():
    s, engine = catalogue_scenario("furuta-motor"), Pinocchio()
    (copying,) = (variant for variant in engine.variants if variant.names == ("Model.copy",))

    def mass_matrix(remake):
        change = replace(copying.change, remake=remake)
        other = engine.with_variant(replace(copying, change=change))
        return other.evaluate(s.model, [s.state])[0].mass_matrix

    def without_rotors(model):
        other = model.copy()
        other.armature = 0 * model.armature
        return other

    lost = mass_matrix(copying.change.remake) - mass_matrix(without_rotors)
    rotors = s.model.armature[:, 0]
    assert np.any(rotors)
    bound = state_rounding_bound(s.model, s.state).mass_matrix
    np.testing.assert_allclose(lost, np.diag(rotors), rtol=0, atol=2 * bound)


@in_engine_process
def test_aba_loses_the_symmetry_of_articulated_inertias():
    """A finding about pin: if this fails, its aba got better; then crba can leave the adapter's docstring."""
    error, asymmetry = {}, {}
    for bodies in (10, 30, 50):
        scenario = catalogue_scenario(f"chain-{bodies}-balls")
        truth = certify_state(scenario.model, scenario.state).quantities.acceleration
        for algorithm in ("aba", "crba"):
            (got,) = by(algorithm).evaluate(scenario.model, [scenario.state])
            error[algorithm, bodies] = np.max(np.abs(got.acceleration - truth))
        chain = Chain(scenario.model, "aba")
        chain.acceleration(*chain.coordinates(scenario.state))
        inertias = np.array([np.array(y) for y in chain.data.Yaba[1:]])
        asymmetry[bodies] = np.max(np.abs(inertias - inertias.mT)) / np.max(np.abs(inertias))
    assert all(error["crba", n] < 1e-10 for n in (10, 30, 50)), error
    assert error["aba", 10] < 1e-12 and error["aba", 30] > 1e-10 and error["aba", 50] > 1e-5, error
    assert asymmetry[10] < 1e-14 and asymmetry[50] > 1e-6, asymmetry


@in_engine_process
def test_derivatives_of_forward_dynamics_lose_digits_by_their_inverse_alone():
    """A rod of 0.1 kg and a ball of 100 kg: ∂v̇/∂v is -∂v̇/∂τ ∂τ/∂v to rounding, and ∂v̇/∂τ is not M⁻¹."""
    model = tree_from_seed(70, 2, ("ball", "rod"))
    scale = np.array([0.1, 100.0]) / model.mass
    model = replace(model, mass=model.mass * scale, inertia=model.inertia * scale[:, None, None])
    (state,) = random_states(model, 1, 70)
    chain = Chain(model, "crba")
    m, data, (q, v), zero = chain.pin_model, chain.data, chain.coordinates(state), chain.zero_torque
    M = pin.crba(m, data, q)
    _, by_v, inverse = (x.copy() for x in pin.computeABADerivatives(m, data, q, v, zero))
    inverse = np.triu(inverse) + np.triu(inverse, 1).T
    of_torque = pin.computeRNEADerivatives(m, data, q, v, zero)[1]
    lost, own = (np.max(np.abs(x @ M - np.eye(m.nv))) for x in (inverse, np.linalg.inv(M)))
    assert own < m.nv * EPS * np.linalg.cond(M) and lost > 1e4 * m.nv * EPS * np.linalg.cond(M)
    products = np.abs(inverse) @ np.abs(of_torque) @ np.abs(v)  # two here, two there, of nv terms
    assert np.all(np.abs(by_v @ v + inverse @ of_torque @ v) < 4 * m.nv * EPS * products)


@in_engine_process
def test_rods_point_everywhere_and_spin_about_themselves_by_integration_error_only():
    near_down = np.array([[1e-9, -2e-9, -1], [1e-160, 0, -1], [1e-9, 0, 0.0]])
    ups = np.vstack([np.eye(3), -np.eye(3), near_down, np.random.default_rng(0).normal(size=(50, 3))])
    for u in ups:
        u = u / np.linalg.norm(u)
        toward = kinematics.rotation_matrix(
            kinematics.turn_of_z(u) / np.linalg.norm(kinematics.turn_of_z(u))
        )[:, 2]
        assert np.max(np.abs(toward - u)) < 1e-15, f"{toward} for {u}"
    model = pendulums.make_model("rbr", loads=True)
    state = pendulums.state_from_seed(model)
    spins = np.abs([_rod_spins(model, state, h) for h in (5e-4, 2.5e-4)])
    assert np.all(spins[:, 0] < 1e-12), spins  # no parent whose attitude the integrator could miss
    assert np.all(np.abs(np.log2(spins[0, 1:] / spins[1, 1:]) - 4) < 0.2), spins


def _rod_spins(model, state, h):
    """Spin of each rod about itself after 1 s, rad/s: zero but for the integrator's error."""
    chain = Chain(model, "aba")
    q, v = chain.coordinates(state)
    for _ in range(round(1 / h)):
        q, v = pinocchio_engine.rkmk4(chain, q, v, h)
    pin.forwardKinematics(chain.pin_model, chain.data, q, v)
    return [chain.data.v[int(j) + 1].angular[2] for j in chain.rod_rows]


@in_engine_process
def test_maximal_coordinates_know_their_limits():
    scenario = catalogue_scenario("chain-50-balls")
    with pytest.raises(Unsupported, match="workspace for 50 free bodies"):
        PinocchioMaximal().evaluate(scenario.model, [scenario.state])
    with pytest.raises(KeyError, match="no integrator"):
        PinocchioMaximal().simulate(scenario.model, scenario.state, TIMES, "rkmk4", 0.1)
