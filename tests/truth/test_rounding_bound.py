"""The state-level tolerance: same in any units, never below an honest engine, sharp enough for a mistake."""

import bisect
import warnings
from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.execution.plan import STATES_PER_RANDOM_SCENARIO
from plumbline.model.datatypes import State, Unsupported
from plumbline.model.kinematics import complete_state
from plumbline.model.sampling import compared_states, random_states
from plumbline.model.welding import split_bodies
from plumbline.scenario.generator import random_mechanism
from plumbline.scenario.loader import scenario_from_dict
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import (
    EPS,
    MAX_RELATIVE_BOUND,
    ROUNDING_FACTOR,
    SUM_ROUNDING_FACTOR,
    rounding_bounds,
    state_rounding_bound,
)
from tests.helpers.catalogue import catalogue_scenario, states_of
from tests.helpers.random_chains import in_other_units, norms_per_body, random_chain
from tests.helpers.shared_answers import sharing

pytest.importorskip("flint")
VECTORS = ("acceleration", "angular_acceleration", "joint_reaction", "joint_moment")


@pytest.fixture(scope="module", autouse=True)
def shared_truths():
    """The truth of random chains is the same for every engine."""
    with sharing(__name__, "certify_state", "state_rounding_bound"):
        yield


def error_ratios(reported, true, bound):
    """Per quantity, the largest difference over its tolerance."""
    ratios = {}
    for quantity in bound.scale:
        value, expected = getattr(reported, quantity), getattr(true, quantity)
        if value is None or expected is None:
            continue
        difference = np.asarray(value) - np.asarray(expected)
        size = (
            norms_per_body(difference) if quantity in (*VECTORS, "angular_momentum") else np.abs(difference)
        )
        tolerance = np.maximum(bound.tolerance(quantity), np.finfo(float).tiny)
        ratios[quantity] = float(np.max(size / tolerance))
    return ratios


@pytest.mark.parametrize("rods", [[0], [1], [0, 0, 0], [1, 1, 1], [0, 1, 1, 0]], ids=str)
@pytest.mark.parametrize("units", [(0.3, 1, 1), (1, 7e3, 1), (1, 1, 60.1), (39.37, 2.2046, 1e-3)], ids=str)
def test_relative_bounds_are_independent_of_units(rods, units):
    length, mass, second = units
    model, state = random_chain(2, rods, mass_decades=1, loads=True, drag=True)
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
    here, there = (
        state_rounding_bound(model, state),
        state_rounding_bound(*in_other_units(model, state, length, mass, second)),
    )
    # a bound is itself rounded, through an inverse; a unit forgotten would be off by a power of ten
    for quantity, factor in unit.items():
        assert there.tolerance(quantity) / factor == pytest.approx(
            here.tolerance(quantity), rel=1e-7, abs=0
        ), quantity
        assert there.relative_bound(quantity) == pytest.approx(
            here.relative_bound(quantity), rel=1e-7, abs=0
        ), quantity


INACCURATE_ENGINE = "pinocchio-aba"  # on long chains and wide mass ratios, really: see the test after these
SOUND_ENGINES = [name for name in ENGINES if name != INACCURATE_ENGINE]


@pytest.mark.parametrize("name", SOUND_ENGINES)
@pytest.mark.parametrize("count", [40, pytest.param(2000, marks=pytest.mark.full)])
def test_no_sound_engine_exceeds_the_bound(name, count):
    """The worst error in so many chains stays below half of the tolerance, which leaves a margin."""
    try:
        engine = load_adapter(name)
    except ImportError as error:
        pytest.skip(f"{name} is not installed: {error}")
    rng = np.random.default_rng(17)
    checks, worst = 0, {}
    for _ in range(count):
        n, kind = int(rng.integers(1, 11)), rng.integers(4)
        rods = [0] * n if kind == 0 else [1] * n if kind == 1 else list(rng.integers(0, 2, n))
        if name == "reference-printed":  # the notes print one and two bodies on rods
            n = 1 + n % 2
            rods = [1] * n
        model, state = random_chain(
            rng, rods, mass_decades=rng.uniform(0, 3), rate=10 ** rng.uniform(-1, 1.3)
        )
        try:
            reported = engine.evaluate(model, [state])[0]
        except Unsupported:
            continue
        true = certify_state(model, state, mass_matrix=n <= 3).quantities
        for quantity, ratio in error_ratios(reported, true, state_rounding_bound(model, state)).items():
            checks += 1
            worst[quantity] = max(worst.get(quantity, 0.0), ratio)
    print(name, checks, {quantity: f"{ratio:.3f}" for quantity, ratio in worst.items()})
    assert checks > count
    assert max(worst.values()) < 0.5, worst


BALL = {"kind": "ball"}
HINGE = {"kind": "hinge", "axis": [0, 1, 0]}
UPRIGHT = {"attitude": {"quaternion": [1, 0, 0, 0]}}
FAR = {  # the joint of the first body, its other fields, and the joint of the second one
    "rod of a kilometre": ({"kind": "rod", "length": 1e3, "direction": [0.3, 0, -1]}, UPRIGHT, BALL, UPRIGHT),
    "rod of a megametre": ({"kind": "rod", "length": 1e6, "direction": [0.3, 0, -1]}, UPRIGHT, BALL, UPRIGHT),
    "ten kilometres away": (HINGE, {"parent": "world", "anchor": [1e4, 0, 0]}, {"kind": "universal"}, {}),
}


@pytest.mark.parametrize("engine", ["mujoco", "pinocchio", "pinocchio-maximal", "exudyn-tree"])
@pytest.mark.parametrize("case", FAR)
def test_positions_far_from_the_origin_lose_digits_of_arms_within_the_bound(case, engine):
    """An arm that an engine finds as a difference of positions is off by a rounding of these."""
    inertia = {"six": [0.021, 0.034, 0.042, 0.004, -0.003, 0.005]}
    joint, more, second, its = FAR[case]
    bodies = [
        {
            "mass": 1.3,
            "inertia": inertia,
            "joint": joint,
            "proximal": [0.05, -0.08, 0.17],
            "distal": [0.1, 0, -0.2],
        }
        | more,
        {"mass": 0.7, "inertia": inertia, "joint": second, "proximal": [0, 0.1, 0.2]} | its,
    ]
    content = {"schema_version": 1, "family": "own", "title": "t", "purpose": "p", "bodies": bodies}
    s, adapter = scenario_from_dict(content, "far"), load_adapter(engine)
    for state in compared_states(s.model, s.state, "far", 12):
        true, bound = certify_state(s.model, state).quantities, state_rounding_bound(s.model, state)
        ratios = error_ratios(adapter.evaluate(s.model, [state])[0], true, bound)
        assert max(ratios.values()) < 1, ratios


def test_a_real_loss_of_digits_exceeds_the_bound():
    """The articulated-body recursion on a chain of 50 balls is off by far more than roundings explain."""
    pytest.importorskip("pinocchio")
    scenario = catalogue_scenario("chain-50-balls")
    (state,) = random_states(scenario.model, 1, seed=3)
    true, bound = certify_state(scenario.model, state).quantities, state_rounding_bound(scenario.model, state)
    recursion, matrix = (
        load_adapter(name).evaluate(scenario.model, [state])[0] for name in (INACCURATE_ENGINE, "pinocchio")
    )
    assert max(error_ratios(recursion, true, bound).values()) > 10
    assert max(error_ratios(matrix, true, bound).values()) < 0.5


def test_scales_do_not_vanish_with_the_quantity():
    """In steady conical motion and at rest ω̇′ is zero, and a tolerance relative to it would mean nothing."""
    for name in ("double-conical", "planar-rotating", "rest", "chain-10-small"):
        scenario = catalogue_scenario(name)
        assert (
            state_rounding_bound(scenario.model, scenario.state).relative_bound("angular_acceleration")
            < MAX_RELATIVE_BOUND
        ), name


MODEL_ERRORS = {
    "mass": lambda model, e: model.changed(mass=model.mass * (1 + e * np.array([0.0, 1.0]))),
    "inertia": lambda model, e: model.changed(
        inertia=model.inertia
        + e * np.array([0.0, 1.0])[:, None, None] * np.diag([0, model.inertia[1, 1, 1], 0]),
    ),
    "offset": lambda model, e: model.changed(
        proximal=model.proximal * (1 + e * np.array([[0, 0, 0], [0, 0, 1.0]]))
    ),
    "gravity": lambda model, e: model.changed(gravity=model.gravity * (1 + e)),
}


@pytest.mark.parametrize("rods, sharp", [([0, 0], 3e-11), ([1, 1], 1e-9)], ids=["balls", "rods"])
@pytest.mark.parametrize("what", MODEL_ERRORS)
def test_a_small_parameter_error_exceeds_the_bound(what, rods, sharp):
    """The smallest relative error that ten random states show in every one of ten models."""
    smallest = smallest_detected_error(what, rods)
    print(f"{what} on {rods}: {smallest:.1e}")
    assert smallest < sharp


def smallest_detected_error(what, rods):
    rng, worst = np.random.default_rng(5), 0.0
    for _ in range(10):
        model, _ = random_chain(rng, rods)
        states = random_states(model, 10, seed=int(rng.integers(2**31)))
        bounds = [state_rounding_bound(model, state) for state in states]
        true = [certify_state(model, state).quantities for state in states]

        def seen(e, model=model, states=states, bounds=bounds, true=true):
            wrong = MODEL_ERRORS[what](model, e)
            relifted = [complete_state(wrong, State(s.p, s.omega, s.u, s.udot)) for s in states]
            reported = [certify_state(wrong, state).quantities for state in relifted]
            return any(
                max(error_ratios(*each).values()) > 1 for each in zip(reported, true, bounds, strict=True)
            )

        grid = 10 ** np.arange(-14, -5, 0.25)
        worst = max(worst, grid[bisect.bisect_left(grid, True, hi=len(grid) - 1, key=seen)])
    return worst


def test_bounds_are_sharp_and_describe_their_derivation():
    model, state = random_chain(0, [0, 1, 0])
    bound = state_rounding_bound(model, state)
    for quantity in bound.scale:
        assert 8 * EPS < bound.relative_bound(quantity) < MAX_RELATIVE_BOUND, quantity
        how = "terms of the Newton-Euler equations" if quantity in VECTORS else "sum of the magnitudes"
        assert how in bound.describe(quantity)
        assert str(ROUNDING_FACTOR if quantity in VECTORS else SUM_ROUNDING_FACTOR) in bound.describe(
            quantity
        )
    assert (np.finfo(float).eps / 2, 64, 256) == (EPS, ROUNDING_FACTOR, SUM_ROUNDING_FACTOR), (
        "calibrated, see below"
    )
    assert f"{np.max(bound.acceleration):.1e}" in bound.describe("acceleration")


def test_extreme_mass_ratios_give_an_inconclusive_bound():
    model, state = random_chain(1, [0] * 10)
    model = model.changed(mass=np.geomspace(1e-6, 1e6, 10), inertia=model.inertia * 1e-4)
    assert state_rounding_bound(model, state).relative_bound("angular_acceleration") > MAX_RELATIVE_BOUND


def test_states_without_motion_or_gravity_have_finite_bounds():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for rods in ([0], [1], [0, 1]):
            model, state = random_chain(3, rods, rate=0.0)
            still = model.changed(gravity=np.zeros(3))
            for bound in (state_rounding_bound(model, state), state_rounding_bound(still, state)):
                assert all(np.all(np.isfinite(bound.tolerance(q))) for q in bound.scale)
            centred = model.changed(proximal=np.zeros_like(model.proximal))
            assert np.all(np.isfinite(state_rounding_bound(centred, state).acceleration))


def test_a_scale_of_zero_does_not_count_in_the_relative_bound():
    bound = state_rounding_bound(*random_chain(0, [0, 1, 0]))
    scale = {"acceleration": np.array([0.0, 4.0, 1.0])}
    bound = replace(bound, acceleration=np.array([1.0, 4e-12, 3e-12]), scale=scale)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert bound.relative_bound("acceleration") == 3e-12


@pytest.mark.parametrize("name", ["chain-5-mixed", "tree-of-seven-sprung", "flyball-governor", "four-bars-2"])
def test_bounds_of_many_states_are_those_of_each(name):
    scenario = catalogue_scenario(name)
    states = states_of(scenario, 3)
    for together, state in zip(rounding_bounds(scenario.model, states), states, strict=True):
        alone = state_rounding_bound(scenario.model, state)
        for quantity in alone.scale:
            np.testing.assert_allclose(together.tolerance(quantity), alone.tolerance(quantity), rtol=1e-6)
            np.testing.assert_allclose(together.scale[quantity], alone.scale[quantity], rtol=1e-6)


@pytest.mark.parametrize("name", ["mujoco", "pinocchio", "exudyn", "exudyn-tree", "reference"])
def test_a_small_body_on_a_rod_at_its_centre_of_mass_keeps_within_the_bound(name):
    """Spatial algebra holds ṙ × m ṙ, whose rounding turns a body of small inertia."""
    model = catalogue_scenario("spherical").model
    model = model.changed(inertia=1e-4 * model.inertia)
    states = random_states(model, 5, seed=7)
    try:
        answers = load_adapter(name).evaluate(model, states)
    except ImportError as error:
        pytest.skip(f"{name} is not installed: {error}")
    for state, answer, bound in zip(states, answers, rounding_bounds(model, states), strict=True):
        true = certify_state(model, state).quantities
        assert max(error_ratios(answer, true, bound).values()) < 0.5


def test_what_a_dense_solve_leaves_at_a_ball_beside_other_branches_is_within_the_bound():
    """Factors of M fill its zeros: the moment is off by 1e-13 N m, by a solution in 40 digits 1e-15 N m."""
    s = random_mechanism(32281128, 60)
    state = states_of(s, STATES_PER_RANDOM_SCENARIO)[3]
    try:
        (answer,) = load_adapter("pinocchio").evaluate(s.model, [state])
    except ImportError as error:
        pytest.skip(f"pinocchio is not installed: {error}")
    true, bound = certify_state(s.model, state).quantities, state_rounding_bound(s.model, state)
    assert error_ratios(answer, true, bound)["joint_moment"] < 0.5


def test_welded_parts_widen_the_bounds_of_every_mechanism():
    for name in ("chain-3-rods", "tree-of-seven-sprung"):
        scenario = catalogue_scenario(name)
        plain, welded = (
            state_rounding_bound(scenario.model, scenario.state, parts)
            for parts in (None, split_bodies(scenario.model))
        )
        for quantity in plain.scale:
            assert np.all(welded.tolerance(quantity) >= plain.tolerance(quantity)), quantity
        assert np.all(welded.acceleration > plain.acceleration)


def test_a_joint_moment_that_is_zero_has_a_scale():
    """A ball that turns on a hinge through its centre: the moment, J ω × ω = 0, is compared with J ω²."""
    model = scenario_from_dict(
        {
            "schema_version": 1, "family": "joint", "title": "A propeller", "purpose": "Balance.",
            "gravity": [0, 0, -9.81],
            "bodies": [
                {
                    "name": "ball", "mass": 1.0, "inertia": {"principal": [0.02, 0.02, 0.02]},
                    "parent": "world", "proximal": [0, 0, 0],
                    "joint": {"kind": "hinge", "axis": [0, 0, 1], "coordinates": [0.3], "rates": [2.0]},
                }
            ],
        },
        "propeller",
    )  # fmt: skip
    bound = state_rounding_bound(model.model, model.state)
    assert np.all(certify_state(model.model, model.state).quantities.joint_moment == 0)
    assert bound.relative_bound("joint_moment") <= MAX_RELATIVE_BOUND
    assert np.all(bound.scale["joint_moment"] > 0)
