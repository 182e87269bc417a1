"""Loss of digits: errors that scatter with the last bits of a problem, against errors with a cause."""

import re
import zlib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from plumbline.diagnosis.diagnose import diagnose
from plumbline.diagnosis.digit_loss import MIN_SCATTER, find_digit_loss, growth_words, worst_difference
from plumbline.engines.registry import load_adapter
from plumbline.model.equivalent import WORLD_VECTORS, bodies_between, rotate_world, unrotate
from plumbline.model.kinematics import complete_state
from plumbline.model.sampling import random_states
from plumbline.truth.certified_state import certify_state
from plumbline.truth.ground_truth import state_truth
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario

pytest.importorskip("flint")


@cache
def known(joints="bb", loaded=True):
    model = pendulums.make_model(joints, loads=loaded, drag=loaded)
    return model, state_truth(model, random_states(model, 3, seed=4))


def answering(change):
    """An engine that returns the truth, its acceleration changed by the state, the model and the truth."""

    def evaluate(model, states):
        reported = state_truth(model, states).quantities
        return [
            replace(a, acceleration=change(model, s, a.acceleration))
            for s, a in zip(states, reported, strict=True)
        ]

    return evaluate


def loss_of(change, joints="bb"):
    model, truth = known(joints)
    evaluate = answering(change)
    return find_digit_loss(worst_difference(model, evaluate(model, truth.states), truth), evaluate)


def noise(state, shape):
    return np.random.default_rng(zlib.crc32(state.p.tobytes())).normal(size=shape)


def test_a_turned_world_turns_the_answers():
    model, truth = known("rb")
    q = np.array([0.1, 0.7, -0.1, 0.7])
    turned = certify_state(*rotate_world(model, truth.states[0], q)).quantities
    back = unrotate(
        {"acceleration": turned.acceleration, "kinetic_energy": turned.kinetic_energy}, WORLD_VECTORS, q
    )
    np.testing.assert_allclose(back["acceleration"], truth.quantities[0].acceleration, rtol=1e-12)
    assert back["kinetic_energy"] == pytest.approx(truth.quantities[0].kinetic_energy, rel=1e-13)
    np.testing.assert_allclose(
        turned.angular_acceleration, truth.quantities[0].angular_acceleration, rtol=1e-11
    )


@pytest.mark.parametrize(
    ("name", "joints", "springs"), [("chain-3-rods", 2, 0), ("crowded-loops-1", 2, 0), ("four-bar", 2, 0)]
)
def test_the_first_bodies_of_a_mechanism_are_where_they_were(name, joints, springs):
    s = catalogue_scenario(name)
    short, state = bodies_between(s.model, s.state, 0, 2)
    assert short.n == 2 and len(short.kind) == joints and len(short.spring_body) == springs
    assert np.array_equal(short.gravity, s.model.gravity) and np.array_equal(short.mass, s.model.mass[:2])
    again = complete_state(short, state)
    assert again.r == pytest.approx(s.state.r[:2], abs=1e-14)
    assert bodies_between(s.model, s.state, 0, s.model.n)[0].kind == s.model.kind


@pytest.mark.parametrize(
    "change",
    [
        lambda m, s, a: 1.001 * a,
        lambda m, s, a: (
            a + 1e-9 * np.array([1.0, 2, 3])
        ),  # a constant in the world: it turns with the problem
        lambda m, s, a: a + 1e-6 * np.sign(s.v),
        lambda m, s, a: a * np.nan,
    ],
    ids=["factor", "constant", "sign", "nan"],
)
def test_an_error_with_a_cause_does_not_scatter(change):
    assert loss_of(change) is None


def test_an_engine_that_keeps_the_call_before_loses_no_digits():
    model, truth = known()
    kept = list(truth.quantities[-1:])

    def evaluate(requested, states):
        reported = [*kept, *state_truth(requested, states).quantities]
        kept[:] = reported[-1:]
        return reported[:-1]

    problem = worst_difference(model, evaluate(model, truth.states), truth)
    assert np.max(np.abs(problem.values)) > 1e9
    assert find_digit_loss(problem, evaluate) is None


def test_noise_scatters_and_grows_only_where_it_does():
    flat = loss_of(lambda m, s, a: a * (1 + 1e-9 * noise(s, a.shape)), "bbbb")
    assert flat is not None and flat.amount[0] > MIN_SCATTER
    assert flat.change.endswith("; rounding or noise in the algorithm")
    cause = loss_of(
        lambda m, s, a: a * (1 + 1e-12 * 10.0 ** np.arange(m.n)[:, None] * noise(s, a.shape)), "bbbb"
    )
    assert cause is not None and cause.kind == "rounding"
    assert cause.change.startswith("lose digits: they scatter by ")
    bounds = r"in rounding bounds: \S+ for 4, \S+ for 2, \S+ for 1"
    assert re.search(rf"the error grows .* \({bounds}\); rounding in the algorithm$", cause.change)


def test_growth_compares_the_chain_with_its_half():
    assert "grows" in growth_words({8: 41.0, 4: 10.0, 2: 90.0})
    assert "grows" not in growth_words({8: 39.0, 4: 10.0, 2: 0.1})
    assert "grows" not in growth_words({1: 39.0})


def test_an_engine_that_fails_on_turned_problems_is_not_accused_of_losing_digits():
    model, truth = known()
    reported = [replace(a, acceleration=2 * a.acceleration) for a in truth.quantities]

    def evaluate(requested, states):
        raise RuntimeError("no")

    assert find_digit_loss(worst_difference(model, reported, truth), evaluate) is None


@pytest.mark.parametrize("name", ["chain-30-balls", "chain-50-balls"])
def test_what_aba_loses_on_long_chains_has_its_name(name):
    pytest.importorskip("pinocchio")
    model = catalogue_scenario(name).model
    truth = state_truth(model, random_states(model, 2, seed=1))
    evaluate = load_adapter("pinocchio-aba").evaluate
    (cause,) = diagnose(model, evaluate(model, truth.states), truth, evaluate).causes
    assert cause.kind == "rounding" and "the error grows with the number of bodies" in cause.change, cause
