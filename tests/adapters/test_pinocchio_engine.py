"""What is Pinocchio's own: its algorithms against each other, its integrators, loads and massless rods."""

import multiprocessing
from functools import wraps
from unittest.mock import patch

import numpy as np
import pytest

from plumbline.model import kinematics
from plumbline.model.datatypes import Unsupported
from plumbline.scenario.loader import find_scenario_file, load_scenario
from tests.helpers import engine_process as worker
from tests.helpers import newton_euler, pendulums
from tests.helpers.pendulums import JOINT_PATTERNS
from tests.helpers.refinement import extrapolated, observed_orders

pin = pytest.importorskip("pinocchio")
pinocchio_engine = pytest.importorskip("adapters.pinocchio_engine")
maximal = pytest.importorskip("adapters.pinocchio_maximal_engine")
Chain, Pinocchio = pinocchio_engine.PinocchioChain, pinocchio_engine.Pinocchio
PinocchioMaximal = maximal.PinocchioMaximal

TIMES = np.linspace(0, 2, 5)


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


def relative_error(got, expected, floor):
    return np.max(np.abs(got - expected)) / max(floor, np.max(np.abs(expected)))


@pytest.mark.parametrize("loaded", [False, True], ids=["free", "loads and drag"])
@pytest.mark.parametrize("joints", ["ball", "balls", "rods", "mixed"])
@in_engine_process
def test_algorithms_and_formulations_agree(joints, loaded):
    """aba in both conventions, crba with a solve, and constrained free bodies: one engine, one answer."""
    model = pendulums.make_model(JOINT_PATTERNS[joints], loads=loaded, drag=loaded)
    states = [pendulums.state_from_seed(model, seed) for seed in range(10)]
    # The world convention is 1e-11 off by five bodies already, see the adapter's docstring on aba.
    others = [by("aba"), PinocchioMaximal(), *([by("aba-world")] if model.n <= 2 else [])]
    first = by("crba")
    for other in others:
        for a, b in zip(first.evaluate(model, states), other.evaluate(model, states), strict=True):
            for name, floor in (
                ("acceleration", 9.81),
                ("angular_acceleration", 9.81),
                ("joint_reaction", 9.81),
            ):
                error = relative_error(getattr(b, name), getattr(a, name), floor)
                assert error < 1e-11, f"{name} differs by {error:.1e} of {other.title}"
            assert relative_error(b.mass_matrix, a.mass_matrix, 0) < 1e-13
            assert relative_error(b.angular_momentum, a.angular_momentum, 1) < 1e-13


@in_engine_process
def test_aba_loses_the_symmetry_of_articulated_inertias():
    """A finding about pin: if this fails, its aba got better; then crba can leave the adapter's docstring."""
    error, asymmetry = {}, {}
    for bodies in (10, 30, 50):
        scenario = load_scenario(find_scenario_file(f"chain-{bodies}-balls"))
        truth = newton_euler.solve(scenario.model, scenario.state).acceleration
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


# -- integrators -------------------------------------------------------------------------------


def positions_by_step_size(model, state, integrator, coarsest, levels):
    """Positions (levels, T, N, 3) at the step halved again and again."""
    engine = Pinocchio()
    return np.array(
        [engine.simulate(model, state, TIMES, integrator, coarsest / 2**i).r for i in range(levels)]
    )


@pytest.mark.parametrize(
    "joints", ["ball", *(pytest.param(x, marks=pytest.mark.full) for x in ("balls", "rod"))]
)
@in_engine_process
def test_orders_and_limits_at_two_seconds(joints):
    model = pendulums.make_model(JOINT_PATTERNS[joints])
    state = pendulums.state_from_seed(model, seed=2, rate=0.5)
    truth = np.array([s.r for s in newton_euler.integrate(model, state, TIMES)])
    for integrator, order, coarsest, levels in (
        ("rkmk4", 4, 2.0**-9, 4),
        ("semi-implicit-euler", 1, 2.0**-8, 7),
    ):
        runs = positions_by_step_size(model, state, integrator, coarsest, levels)
        seen = observed_orders(runs)
        assert np.all(np.abs(seen[-2:] - order) < 0.1), f"{integrator}: orders {seen}"
        error = np.max(np.abs(extrapolated(runs, range(order, order + levels)) - truth))
        assert error < 1e-11, f"{integrator}: limit off by {error:.1e} m"
    run = Pinocchio().simulate(model, state, TIMES, "dop853", 1e-13)
    assert np.max(np.abs(run.r - truth)) < 1e-11


@in_engine_process
def test_without_the_inverse_differential_the_order_is_two():
    """Why Munthe-Kaas: Runge–Kutta stages through `integrate` alone look the same and are order 2."""
    model = pendulums.make_model("bb")
    state = pendulums.state_from_seed(model, rate=0.5)
    with patch.object(Chain, "exponential_coordinate_rate", lambda self, q, theta, v: v):
        seen = observed_orders(positions_by_step_size(model, state, "rkmk4", 2.0**-9, 4))
    assert np.all(np.abs(seen - 2) < 0.1), f"orders {seen}"


@in_engine_process
def test_loads_are_taken_at_every_stage():
    """World force and drag, frozen over a step, would leave order 1."""
    model = pendulums.make_model("br", loads=True, drag=True)
    state = pendulums.state_from_seed(model, rate=0.5)
    seen = observed_orders(positions_by_step_size(model, state, "rkmk4", 2.0**-7, 4))
    assert np.all(np.abs(seen - 4) < 0.1), f"orders {seen}"

    def frozen(chain, q, v, h):
        chain.update_loads(q, v)
        with patch.object(Chain, "update_loads", lambda self, q, v: None):
            return step(chain, q, v, h)

    step = pinocchio_engine.rkmk4
    with patch.dict(pinocchio_engine.FIXED_STEPS, rkmk4=frozen):
        seen = observed_orders(positions_by_step_size(model, state, "rkmk4", 2.0**-9, 3))
    assert np.all(np.abs(seen - 1) < 0.1), f"orders {seen}"


# -- loads and rods ----------------------------------------------------------------------------


@in_engine_process
def test_a_balanced_load_shows_in_the_reaction():
    """By hand: where the moment balances weight and force about the pivot, nothing moves."""
    model = pendulums.make_model("b", loads=True)
    state = pendulums.state_from_seed(model, rate=0.0)
    pull = model.mass[0] * model.gravity + model.force[0]
    arm = state.r[0]
    moment = -kinematics.rotation_matrix(state.p[0]).T @ np.cross(arm, pull)
    model = model.changed(moment=moment[None])
    for engine in (by("aba"), by("crba"), PinocchioMaximal()):
        (got,) = engine.evaluate(model, [state])
        assert np.max(np.abs(got.angular_acceleration)) < 1e-12
        # The joint then carries weight and force together.
        assert np.max(np.abs(got.joint_reaction[0] + pull)) < 1e-13 * np.linalg.norm(pull)


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
    scenario = load_scenario(find_scenario_file("chain-50-balls"))
    with pytest.raises(Unsupported, match="workspace for 50 free bodies"):
        PinocchioMaximal().evaluate(scenario.model, [scenario.state])
    with pytest.raises(KeyError, match="no integrator"):
        PinocchioMaximal().simulate(scenario.model, scenario.state, TIMES, "rkmk4", 0.1)
