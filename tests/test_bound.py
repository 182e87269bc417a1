"""The state-level tolerance: same in any units, never below an honest engine, sharp enough for a mistake."""

from __future__ import annotations

import bisect
import time
import warnings
from dataclasses import replace

import numpy as np
import pytest

from plumbline.bound import BLUNT, EPS, ROUNDINGS, state_bound
from plumbline.kinematics import lift
from plumbline.records import Unsupported
from plumbline.registry import ENGINES, adapter
from plumbline.sampling import random_states
from plumbline.scenario import find, load
from tests.random_chains import norms, random_chain, rescaled

VECTORS = ("acceleration", "angular_acceleration", "joint_reaction")


def over_bound(said, true, bound):
    """Per quantity, the largest difference over its tolerance."""
    ratios = {}
    for quantity in bound.scale:
        value, expected = getattr(said, quantity), getattr(true, quantity)
        if value is None or expected is None:
            continue
        difference = np.asarray(value) - np.asarray(expected)
        size = norms(difference) if quantity in (*VECTORS, "angular_momentum") else np.abs(difference)
        tolerance = np.maximum(bound.tolerance(quantity), np.finfo(float).tiny)
        ratios[quantity] = float(np.max(size / tolerance))
    return ratios


@pytest.mark.parametrize("rods", [[0], [1], [0, 0, 0], [1, 1, 1], [0, 1, 1, 0]], ids=str)
@pytest.mark.parametrize("units", [(0.3, 1, 1), (1, 7e3, 1), (1, 1, 60.1), (39.37, 2.2046, 1e-3)], ids=str)
def test_other_units_change_nothing(rods, units):
    length, mass, second = units
    model, state = random_chain(np.random.default_rng(2), rods, decades=1, loads=True, drag=True)
    force = mass * length / second**2
    unit = {
        "acceleration": length / second**2,
        "angular_acceleration": 1 / second**2,
        "joint_reaction": force,
        "kinetic_energy": force * length,
        "potential_energy": force * length,
        "angular_momentum": mass * length**2 / second,
        "mass_matrix": mass * length**2,
    }
    here, there = state_bound(model, state), state_bound(*rescaled(model, state, length, mass, second))
    for quantity, factor in unit.items():
        assert there.tolerance(quantity) / factor == pytest.approx(here.tolerance(quantity), rel=1e-7), (
            quantity
        )
        assert there.bluntness(quantity) == pytest.approx(here.bluntness(quantity), rel=1e-7), quantity


LOSES_DIGITS = "pinocchio-aba"  # on long chains and wide mass ratios, really: see the test after these
HONEST = [name for name in ENGINES if name != LOSES_DIGITS]


@pytest.mark.parametrize("name", HONEST)
def test_no_honest_engine_is_blamed(name):
    honest(name, 40)


@pytest.mark.full
@pytest.mark.parametrize("name", HONEST)
def test_no_honest_engine_is_blamed_in_two_thousand_chains(name):
    honest(name, 2000)


def honest(name, count):
    """An engine's worst error over the tolerance stays below a half: there is room for worse luck."""
    pytest.importorskip("flint")
    from plumbline.truth.certified import certify

    try:
        engine = adapter(name)
    except ImportError as error:
        pytest.skip(f"{name} is not installed: {error}")
    rng = np.random.default_rng(17)
    checks, worst = 0, {}
    for _ in range(count):
        n, kind = int(rng.integers(1, 11)), rng.integers(4)
        rods = [0] * n if kind == 0 else [1] * n if kind == 1 else list(rng.integers(0, 2, n))
        model, state = random_chain(rng, rods, decades=rng.uniform(0, 3), rate=10 ** rng.uniform(-1, 1.3))
        try:
            said = engine.evaluate(model, [state])[0]
        except Unsupported:
            continue
        true = certify(model, state, mass_matrix=n <= 3).quantities
        for quantity, ratio in over_bound(said, true, state_bound(model, state)).items():
            checks += 1
            worst[quantity] = max(worst.get(quantity, 0.0), ratio)
    print(name, checks, {quantity: f"{ratio:.3f}" for quantity, ratio in worst.items()})
    assert checks > count
    assert max(worst.values()) < 0.5, worst


def test_a_real_loss_of_digits_is_blamed():
    """The articulated-body recursion on a chain of 50 balls is off by far more than roundings explain."""
    pytest.importorskip("flint")
    pytest.importorskip("pinocchio")
    from plumbline.truth.certified import certify

    scenario = load(find("chain-50-balls"))
    (state,) = random_states(scenario.model, 1, seed=3)
    true, bound = certify(scenario.model, state).quantities, state_bound(scenario.model, state)
    recursion, matrix = (
        adapter(name).evaluate(scenario.model, [state])[0] for name in (LOSES_DIGITS, "pinocchio")
    )
    assert max(over_bound(recursion, true, bound).values()) > 10
    assert max(over_bound(matrix, true, bound).values()) < 0.5


def test_scales_do_not_vanish_with_the_answer():
    """In steady conical motion and at rest ω̇′ is zero, and a tolerance relative to it would mean nothing."""
    for name in ("double-conical", "planar-rotating", "rest", "chain-10-small"):
        scenario = load(find(name))
        assert state_bound(scenario.model, scenario.state).bluntness("angular_acceleration") < BLUNT, name


PLANTED = {
    "mass": lambda model, e: replace(model, mass=model.mass * (1 + e * np.array([0.0, 1.0]))),
    "inertia": lambda model, e: replace(
        model,
        inertia=model.inertia
        + e * np.array([0.0, 1.0])[:, None, None] * np.diag([0, model.inertia[1, 1, 1], 0]),
    ),
    "offset": lambda model, e: replace(
        model, proximal=model.proximal * (1 + e * np.array([[0, 0, 0], [0, 0, 1.0]]))
    ),
    "gravity": lambda model, e: replace(model, gravity=model.gravity * (1 + e)),
}


@pytest.mark.parametrize("rods, sharp", [([0, 0], 3e-11), ([1, 1], 1e-9)], ids=["balls", "rods"])
@pytest.mark.parametrize("what", PLANTED)
def test_a_small_mistake_is_seen(what, rods, sharp):
    """The smallest relative error that ten random states show in every one of ten models."""
    pytest.importorskip("flint")
    smallest = smallest_seen(what, rods)
    print(f"{what} on {rods}: {smallest:.1e}")
    assert smallest < sharp


def smallest_seen(what, rods):
    from plumbline.truth.certified import certify

    rng, worst = np.random.default_rng(5), 0.0
    for _ in range(10):
        model, _ = random_chain(rng, rods)
        states = random_states(model, 10, seed=int(rng.integers(2**31)))
        bounds = [state_bound(model, state) for state in states]
        true = [certify(model, state).quantities for state in states]

        def seen(e, model=model, states=states, bounds=bounds, true=true):
            wrong = PLANTED[what](model, e)
            relifted = [lift(wrong, s.p, s.omega, s.u, s.udot) for s in states]
            said = [certify(wrong, state).quantities for state in relifted]
            return any(max(over_bound(*each).values()) > 1 for each in zip(said, true, bounds, strict=True))

        grid = 10 ** np.arange(-14, -5, 0.25)
        worst = max(worst, grid[bisect.bisect_left(grid, True, hi=len(grid) - 1, key=seen)])
    return worst


def test_bounds_stay_sharp_and_say_how_they_came_about():
    model, state = random_chain(np.random.default_rng(0), [0, 1, 0])
    bound = state_bound(model, state)
    for quantity in bound.scale:
        assert 8 * EPS < bound.bluntness(quantity) < BLUNT, quantity
    assert str(ROUNDINGS) in bound.explain("acceleration")
    assert f"{np.max(bound.acceleration):.1e}" in bound.explain("acceleration")


def test_a_wild_scenario_is_called_blunt():
    model, state = random_chain(np.random.default_rng(1), [0] * 10)
    model = replace(model, mass=np.geomspace(1e-6, 1e6, 10), inertia=model.inertia * 1e-4)
    assert state_bound(model, state).bluntness("angular_acceleration") > BLUNT


def test_states_without_motion_or_gravity_have_finite_bounds():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for rods in ([0], [1], [0, 1]):
            model, state = random_chain(np.random.default_rng(3), rods, rate=0.0)
            still = replace(model, gravity=np.zeros(3))
            for bound in (state_bound(model, state), state_bound(still, state)):
                assert all(np.all(np.isfinite(bound.tolerance(q))) for q in bound.scale)
            centred = replace(model, proximal=np.zeros_like(model.proximal))
            assert np.all(np.isfinite(state_bound(centred, state).acceleration))


def test_fifty_bodies_take_milliseconds():
    model, state = random_chain(np.random.default_rng(0), [1] * 50)
    spent = []
    for _ in range(5):
        start = time.thread_time()
        state_bound(model, state)
        spent.append(time.thread_time() - start)
    assert min(spent) < 0.2
