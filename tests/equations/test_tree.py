"""One set of equations in balls and in floating-point numbers: certified, and to their digits."""

from dataclasses import replace

import flint
import numpy as np
import pytest

from plumbline.equations.arithmetic import balls as ball_arithmetic
from plumbline.equations.arithmetic import floats
from plumbline.equations.tree import Tree
from plumbline.model.datatypes import KINDS, State
from plumbline.model.kinematics import minimal_rates, stack_states
from plumbline.model.loops import motion_without_inertia
from plumbline.model.random_mechanisms import ELEMENTS, random_tree
from plumbline.model.sampling import compared_states, random_states
from plumbline.scenario.generator import random_mechanism, random_scenario
from plumbline.truth.certified_state import certify_state, enclose_quantities
from plumbline.truth.parameter_effects import evaluate_models
from plumbline.truth.rounding_bound import EPS, state_rounding_bound
from tests.helpers.catalogue import catalogue_scenario, catalogue_scenarios, states_of
from tests.helpers.nightly_tests import SLOW

BITS = 400
SHARE = 0.1  # of the rounding bound that doubles may be off by
SAMPLE = (
    "double-loaded-rods", "chain-5-mixed", "chain-10-balls", "light-cart-pole", "loaded-tree",
    "tree-of-seven-sprung", "sprung-without-rotors", "free-body-with-rotors", "point-mass-arm",
)  # fmt: skip
TREES = [name for name, scenario in catalogue_scenarios().items() if not scenario.model.has_loops]


def sprung_tree(seed, kinds):
    """Rotors of ball joints on moving bodies, and several springs at one body."""
    rng = np.random.default_rng(seed)
    return random_tree(rng, 5, kinds, elements=ELEMENTS).changed(
        spring_body=np.array([[0, 1], [1, 2], [2, -1]]),
        spring_point=0.5 * rng.normal(size=(3, 2, 3)),
        **{f"spring_{name}": rng.uniform(0.5, 1.5, 3) for name in ("stiffness", "damping", "length")},
    )


@pytest.mark.parametrize("kinds", [("ball",), ("hinge", "ball"), tuple(KINDS)], ids=len)
@pytest.mark.parametrize("seed", [1, 2, *(pytest.param(n, marks=pytest.mark.full) for n in range(3, 20))])
def test_trees_with_every_element_are_certified(kinds, seed):
    model = sprung_tree(seed, kinds)
    for state in random_states(model, 2, seed):
        certify_state(model, state, mass_matrix=True)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(40, 50))])
def test_a_loop_may_hold_a_body_that_could_turn_without_inertia(seed):
    """Cut open, a thin rod or a point mass would turn freely about its axis or its joint."""
    regular = 0
    for index in (1, 5, 9, 13):  # mechanisms with loops
        scenario = random_mechanism(seed, index)
        axis = np.linalg.qr(np.random.default_rng(index).normal(size=(3, 3)))[0][0]
        for thin in (0.1 * (np.eye(3) - np.outer(axis, axis)), np.zeros((3, 3))):
            inertia = scenario.model.inertia.copy()
            inertia[scenario.model.body[scenario.model.n, 1]] = thin
            model = replace(scenario.model, inertia=inertia)
            if motion_without_inertia(model, scenario.state) is None:
                true = certify_state(model, scenario.state, mass_matrix=True).quantities
                at = stack_states([scenario.state])
                found = evaluate_models(model, [scenario.state], [(model, at)])
                bound = state_rounding_bound(model, scenario.state)
                for name in ("acceleration", "joint_reaction"):
                    off = np.max(np.abs(found[name][0, 0] - getattr(true, name)))
                    assert off <= np.max(bound.tolerance(name)), name
                regular += 1
    assert regular


def test_of_a_batch_only_a_singular_system_has_no_solution():
    a, b = np.array([np.eye(2), np.zeros((2, 2))]), np.ones((2, 2, 1))
    np.testing.assert_array_equal(floats().solve(a, b), [np.ones((2, 1)), np.full((2, 1), np.nan)])


@pytest.mark.parametrize("dtype", [float, np.longdouble])
def test_an_inverse_loses_the_digits_of_the_condition_number_once(dtype):
    """A heavy body below a rod: cofactors lose them twice."""
    u = np.linalg.qr(np.random.default_rng(3).normal(size=(20, 3, 3)))[0][:, :1].astype(dtype)
    light = np.random.default_rng(4).normal(size=(20, 3, 3)).astype(dtype)
    a = 431 * u.mT * u + 1e-5 * (light @ light.mT + np.eye(3))
    x = floats(dtype).inverse(a)
    lost = 431 / 1e-5 * float(np.finfo(dtype).eps)
    # An entry of the inverse and of the product goes through about ten roundings.
    assert np.max(np.abs(a @ x - np.eye(3))) < 10 * lost
    np.testing.assert_array_equal(x, x.mT)


def batch(states):
    """Many states as one, of arrays with a leading axis."""
    return State(**{name: np.stack([getattr(state, name) for state in states]) for name in vars(states[0])})


def evaluated(num, model, state):
    """Quantities in floating-point numbers, arrays (S, ...)."""
    tree = Tree(num, model, state)
    solution, lead = tree.solve(), state.p.shape[:-2]
    kinetic, potential, momentum = tree.totals()

    def rows(vectors):
        return np.stack([np.broadcast_to(v, (*lead, 3, 1))[..., 0] for v in vectors], -2)

    return {
        "acceleration": rows(solution.acceleration),
        "angular_acceleration": rows([A.mT @ x for A, x in zip(tree.A, solution.turning, strict=True)]),
        "joint_reaction": rows(solution.force),
        "joint_moment": rows([tree.zero if m is None else m for m in solution.moment]),
        "kinetic_energy": kinetic[..., 0, 0],
        "potential_energy": potential[..., 0, 0],
        "angular_momentum": momentum[..., 0],
        "mass_matrix": tree.mass_matrix(),
    }


@pytest.mark.parametrize("name", [pytest.param(x, marks=[] if x in SAMPLE else SLOW) for x in TREES])
def test_doubles_in_a_batch_are_within_a_tenth_of_the_rounding_bound(name):
    """The errors of doubles over the rounding bounds that engines are judged by."""
    scenario = catalogue_scenario(name)
    model, states = scenario.model, states_of(scenario, 4)
    found = evaluated(floats(), model, batch(states))
    for i, state in enumerate(states):
        truth = certify_state(model, state, mass_matrix=True).quantities
        bound = state_rounding_bound(model, state)
        for quantity, values in found.items():
            if (true := getattr(truth, quantity)) is None:
                assert not np.any(values[i])
                continue
            error = np.abs(np.broadcast_to(values, (len(states), *np.shape(true)))[i] - true)
            if quantity not in ("mass_matrix", "kinetic_energy", "potential_energy"):
                error = np.linalg.norm(error, axis=-1)
            assert np.all(error <= SHARE * bound.tolerance(quantity)), quantity


@pytest.mark.parametrize("name", ["double-loaded-rods", "tree-of-seven-sprung", "free-body-with-rotors"])
def test_long_doubles_have_their_digits(name):
    """Against balls, which have more digits: the errors are below the rounding of doubles."""
    scenario = catalogue_scenario(name)
    model, state = scenario.model, states_of(scenario, 2)[1]
    found = evaluated(floats(np.longdouble), model, state)
    with flint.ctx.workprec(BITS):
        balls = enclose_quantities(model, state, BITS, mass_matrix=True)
        for quantity, values in found.items():
            true = np.ravel(np.array(balls.get(quantity, np.zeros(values.shape)), dtype=object))
            errors = [
                abs(float(flint.arb(np.format_float_positional(x, unique=False, precision=40)) - y))
                for x, y in zip(np.ravel(values), true, strict=True)
            ]
            assert max(errors) <= 3e-18 * balls["scale"].get(quantity, 1.0), quantity


def test_long_doubles_have_their_digits_where_masses_differ():
    """Bodies of 3, 0.003 and 0.001 kg with one of 432 kg on a rod below them.

    The rounding bound of doubles is 2e-7 of the largest acceleration there; cofactors are off by 4e-6 of it.
    """
    scenario = random_scenario(5, 11)
    model, state = scenario.model, scenario.state
    true = certify_state(model, state).quantities.acceleration
    found = evaluated(floats(np.longdouble), model, state)["acceleration"].astype(float)
    assert np.max(np.abs(found - true)) < 1e-9 * np.max(np.abs(true))


@pytest.mark.parametrize("seed", range(4))
def test_forces_of_joints_do_the_work_of_the_wrenches_that_they_stand_for(seed):
    """At rest without weight the bodies' accelerations x by wrenches w have wᵀx = τᵀ M⁺ τ."""
    rng = np.random.default_rng(seed)
    model = random_tree(rng, 6)
    loads = {name: rng.normal(size=(6, 3)) for name in ("force", "moment")}
    model = model.changed(gravity=np.zeros(3), **loads)
    (moving,) = random_states(model, 1, seed)
    still = {name: np.zeros_like(getattr(moving, name)) for name in ("omega", "udot", "v", "xdot")}
    state = batch([replace(moving, **still)])
    tree, moved = Tree(floats(float), model, state), evaluated(floats(float), model, state)
    turns = np.array([np.broadcast_to(A, (1, 3, 3))[0] for A in tree.A])
    wrenches = [
        (F[:, None], (A @ n)[:, None]) for F, n, A in zip(model.force, model.moment, turns, strict=True)
    ]
    tau = np.concatenate([np.reshape(part, -1) for part in tree.joint_forces(wrenches)])
    mass = np.reshape(tree.mass_matrix(is_relative=True), (len(tau), len(tau)))
    work = np.sum(model.force * moved["acceleration"]) + np.sum(model.moment * moved["angular_acceleration"])
    inverse = np.linalg.pinv(mass, hermitian=True)  # a rod has no rate along itself
    # every product and sum rounds, and the inverse multiplies that by the condition of what it inverts
    condition = np.linalg.norm(mass, 2) * np.linalg.norm(inverse, 2)
    assert work == pytest.approx(tau @ inverse @ tau, rel=EPS * len(tau) * condition)


@pytest.mark.parametrize("seed", range(4))
def test_the_mass_matrix_gives_the_kinetic_energy_of_bodies_and_rotors(seed):
    """Also where only some coordinates of a joint have elements."""
    rng = np.random.default_rng(seed)
    model = random_tree(rng, 8, elements=ELEMENTS)
    some = rng.integers(2, size=model.armature.shape)
    fields = ("armature", "damping", "stiffness", "rest", "effort")
    model = model.changed(**{name: getattr(model, name) * some for name in fields})
    for state in random_states(model, 2, seed):
        found, rates = evaluated(floats(), model, state), minimal_rates(model, state)
        energy = rates @ found["mass_matrix"] @ rates / 2
        sizes = np.abs(rates) @ np.abs(found["mass_matrix"]) @ np.abs(rates) / 2
        rounding = EPS * len(rates) ** 2 * sizes  # one rounding for each of as many terms
        assert energy == pytest.approx(float(found["kinetic_energy"]), rel=0, abs=rounding)


def test_wrenches_of_ends_balance_each_other_about_every_point():
    scenario = catalogue_scenario("chain-3-balls")
    rng = np.random.default_rng(1)
    tree = Tree(floats(), scenario.model, compared_states(scenario.model, scenario.state, "ends", 0)[0])
    axis, of_c, lever = rng.normal(size=(3, 3, 1))
    # a dozen products and sums of such terms make a component of the moments' sum
    allowed = 12 * EPS * (np.sum(np.abs(of_c)) + np.sum(np.abs(lever))) * np.max(np.abs(axis))
    for is_force, apart in ((True, lever), (True, None), (False, None)):
        wrenches = tree.end_wrench(2, 0, axis, is_force, apart)
        assert list(wrenches) == [2, 0]
        at = {0: of_c, 2: of_c + (0.0 if apart is None else apart)}
        forces, moments = zip(*wrenches.values(), strict=True)
        around_origin = sum(np.cross(at[body], force, axis=0) for body, (force, _) in wrenches.items())
        np.testing.assert_array_equal(sum(forces), 0)
        np.testing.assert_allclose(sum(moments) + around_origin, 0, atol=allowed)
        np.testing.assert_array_equal((forces if is_force else moments)[0], axis)


def test_a_batch_is_its_states():
    scenario = catalogue_scenario("tree-of-seven-sprung")
    states = states_of(scenario, 3)
    together = evaluated(floats(), scenario.model, batch(states))
    for i, state in enumerate(states):
        for quantity, value in evaluated(floats(), scenario.model, state).items():
            scale = max(1.0, np.max(np.abs(value)))
            np.testing.assert_allclose(together[quantity][i], value, rtol=0, atol=1e-13 * scale)


def test_balls_that_cannot_be_inverted_raise():
    """Nothing resists the spin of a point mass on a ball joint."""
    scenario = catalogue_scenario("double-loaded-balls")
    model = scenario.model.changed(inertia=np.zeros((2, 3, 3)))
    with pytest.raises(ZeroDivisionError):
        Tree(ball_arithmetic(flint), model, scenario.state).solve()
