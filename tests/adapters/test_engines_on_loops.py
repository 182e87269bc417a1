"""Every engine on mechanisms with loops: each joint that may close one, against the certified truth."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import KINDS, EngineFailure, Unsupported
from plumbline.model.loops import assembled, cut_open, loop_gaps, motion_without_inertia
from plumbline.model.random_mechanisms import LOOP_KINDS, random_loop_mechanism
from plumbline.model.sampling import random_loop_states
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.nightly_tests import SLOW
from tests.helpers.planting import number_change, turned_by
from tests.helpers.shared_answers import sharing
from tests.helpers.true_answers import assert_reported, assert_within_bound, sizes

ENGINES = ["reference", "mujoco", "pinocchio", "pinocchio-maximal", "exudyn"]
CLOSING = {kind: [kind] for kind in KINDS if kind != "free"} | {"ball and rod": ["ball", "rod"]}
VECTORS = ("acceleration", "angular_acceleration", "joint_reaction", "joint_moment")


@pytest.fixture(scope="module", autouse=True)
def shared_truths():
    """Mechanisms, certified truths and bounds are the same for every engine."""
    with sharing(__name__, "random_loop_mechanism", "certify_state", "state_rounding_bound"):
        yield


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=SLOW)])
@pytest.mark.parametrize("closing", CLOSING)
@pytest.mark.parametrize("engine", ENGINES)
def test_states_of_random_loops_are_right(engine, closing, seed):
    missing = ("helical",) if engine == "exudyn" else ()
    model, start = random_loop_mechanism(
        seed, 6, CLOSING[closing], [kind for kind in LOOP_KINDS if kind not in missing]
    )
    states = [start, *random_loop_states(model, start, 1, seed)]
    if closing in missing:
        with pytest.raises(Unsupported, match="advances"):
            load_adapter(engine).evaluate(model, states)
        return
    for state, found in zip(states, load_adapter(engine).evaluate(model, states), strict=True):
        truth, bound = certify_state(model, state).quantities, state_rounding_bound(model, state)
        assert_within_bound(found, truth, bound)
        used = {}  # of the bounds
        for name in VECTORS:
            value = getattr(truth, name)
            off = sizes(getattr(found, name) - value)
            assert np.max(off) <= 1e-10 * np.max(np.abs(value)), name
            used[name] = np.max(off / bound.tolerance(name))
        for name, scale in bound.scale.items():
            # where rows nearly depend on each other, what engines are off by grows as the bound does
            is_sharp = np.max(bound.tolerance(name)) < 1e-9 * np.max(scale) or used.get(name, 0.0) > 1e-4
            assert name == "mass_matrix" or is_sharp, name


@pytest.mark.parametrize("engine", ["exudyn-tree", "pinocchio-aba", "reference-printed"])
def test_an_engine_that_closes_no_loops_gives_the_reason(engine):
    model, state = random_loop_mechanism(0, 4, ["ball"])
    with pytest.raises(Unsupported, match=r"loops|constraints|chains of rods and balls"):
        load_adapter(engine).evaluate(model, [state])


def opened(model):
    """The mechanism with its last loop left open."""
    fields = {name: value[:-1] for name, value in vars(model).items() if len(value) == len(model.kind)}
    return replace(model, **fields)


def closed_by(kind):
    return lambda model: model.changed(kind=(*model.kind[:-1], kind))


def changed(*place, **change):
    """Numbers changed, with the bodies where they are."""
    change_numbers = number_change(*place, **change, are_bodies_moved=False)
    return lambda model: change_numbers(model, None)[0]


FAULTS = {
    "a loop left open": opened,
    "a row left out: hinge for cylindrical": closed_by("cylindrical"),
    "a row left out: ball for hinge": closed_by("ball"),
    "a row too many: weld for hinge": closed_by("weld"),
    "axis of the closing joint about x": changed("turn", -1, 1, to=turned_by(1e-7, 0, 0)),
    "axis of the closing joint about y": changed("turn", -1, 1, to=turned_by(0, 1e-7, 0)),
    "point of the closing joint": changed("point", -1, 1, 0, by=1e-7),
    "axis of a joint in the loop": changed("turn", 3, 1, to=turned_by(1e-7, 0, 0)),
    "closed on the world": changed("body", -1, 0, to=lambda _: -1),
    "mass of a body in the loop": changed("mass", 3, times=1 + 1e-7),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("engine", [engine for engine in ENGINES if engine != "reference"])
def test_a_fault_in_a_loop_is_seen(engine, fault):
    model, state = random_loop_mechanism(5, 4, ["hinge"], ("ball", "universal"))
    while model.body[-1, 0] < 0:
        model, state = random_loop_mechanism(int(model.n * 7), 4, ["hinge"], ("ball", "universal"))
    wrong = FAULTS[fault](model)
    truth, bound = certify_state(model, state).quantities, state_rounding_bound(model, state)
    try:
        (found,) = load_adapter(engine).evaluate(wrong, [assembled(wrong, state)])
    except EngineFailure:  # the loop cannot be closed
        return
    assert_reported(found, truth, bound)


@pytest.mark.parametrize("engine", [engine for engine in ENGINES if engine != "pinocchio-maximal"])
def test_a_cut_that_lets_a_point_turn_is_refused(engine):
    """A rocker that is a point where it is hinged, and has its inertia from the loop."""
    s = catalogue_scenario("four-bar")
    point, inertia = s.model.point.copy(), s.model.inertia * np.array([1.0, 1.0, 0.0])[:, None, None]
    point[2, 1] = 0.0
    model = replace(s.model, point=point, inertia=inertia)
    state, adapter = assembled(model, s.state), load_adapter(engine)
    assert motion_without_inertia(model, state) is None
    if engine in ("mujoco", "pinocchio"):
        with pytest.raises(Unsupported) as refusal:
            adapter.evaluate(model, [state])
        assert refusal.value.gap in adapter.gaps
        return
    (found,) = adapter.evaluate(model, [state])
    assert_within_bound(found, certify_state(model, state).quantities, state_rounding_bound(model, state))


def test_the_parts_of_a_cut_body_add_up_to_it():
    model, state = random_loop_mechanism(2, 6, ["ball", "rod"])
    cut = cut_open(model)
    there, near = cut.state(state), model.body[:, 1]
    for quantity in ("mass", "inertia"):
        total = np.zeros_like(getattr(model, quantity))
        np.add.at(total, near, getattr(cut.model, quantity)[cut.place])
        np.testing.assert_array_equal(total, getattr(model, quantity))
    np.testing.assert_allclose(there.r[cut.place], state.r[near], rtol=0, atol=1e-14)
    assert max(np.max(gap) for gap in loop_gaps(model, state)) < 1e-13
