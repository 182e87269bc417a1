"""Every engine on mechanisms with loops: each joint that may close one, against the certified truth."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import KINDS, EngineFailure, Unsupported
from plumbline.model.kinematics import quaternion_product
from plumbline.model.loops import assembled, cut_open, loop_gaps
from plumbline.model.random_mechanisms import random_loop_mechanism
from plumbline.model.sampling import random_loop_states
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import MAX_RELATIVE_BOUND, state_rounding_bound
from tests.helpers.shared_answers import sharing

ENGINES = ["reference", "mujoco", "pinocchio", "pinocchio-maximal", "exudyn"]
CLOSING = {kind: [kind] for kind in KINDS if kind != "free"} | {"ball and rod": ["ball", "rod"]}
VECTORS = ("acceleration", "angular_acceleration", "joint_reaction", "joint_moment")


@pytest.fixture(scope="module", autouse=True)
def shared_truths():
    """Mechanisms, certified truths and bounds are the same for every engine."""
    with sharing(__name__, "random_loop_mechanism", "certify_state", "state_rounding_bound"):
        yield


@pytest.mark.parametrize("closing", CLOSING)
@pytest.mark.parametrize("engine", ENGINES)
def test_states_of_random_loops_are_right(engine, closing):
    adapter = load_adapter(engine)
    for seed in range(2):
        model, start = random_loop_mechanism(seed, 6, CLOSING[closing])
        states = [start, *random_loop_states(model, start, 1, seed)]
        for state, found in zip(states, adapter.evaluate(model, states), strict=True):
            truth = certify_state(model, state).quantities
            bound = state_rounding_bound(model, state)
            for name, scale in bound.scale.items():
                if name == "mass_matrix":
                    continue
                value = getattr(truth, name)
                error = np.asarray(getattr(found, name) - value)
                error = np.linalg.norm(error, axis=-1) if error.shape[-1:] == (3,) else np.abs(error)
                allowed = bound.tolerance(name) + (found.limit_error or {}).get(name, 0.0)
                assert np.all(error <= allowed), (name, seed, model.kind)
                assert np.max(allowed) < 1e-9 * np.max(scale), (name, seed)
                assert bound.relative_bound(name) < MAX_RELATIVE_BOUND, (name, seed, scale)
                if name in VECTORS:
                    assert np.max(error) <= 1e-10 * np.max(np.abs(value)), (name, seed)


@pytest.mark.parametrize("engine", ["exudyn-tree", "pinocchio-aba", "reference-printed"])
def test_an_engine_that_closes_no_loops_gives_the_reason(engine):
    model, state = random_loop_mechanism(0, 4, ["ball"])
    with pytest.raises(Unsupported, match=r"loops|constraints|chains of rods and balls"):
        load_adapter(engine).evaluate(model, [state])


def changed_joint(model, k, kind=None, point=None, turn=None):
    """Joint k of another kind, its near point moved or its axes turned by 1e-7 in the near body."""
    points, turns, kinds = model.point.copy(), model.turn.copy(), list(model.kind)
    if point is not None:
        points[k, 1, point] += 1e-7
    if turn is not None:
        turns[k, 1] = quaternion_product(turns[k, 1], np.array([1.0, *(5e-8 * np.eye(3)[turn])]))
        turns[k, 1] /= np.linalg.norm(turns[k, 1])
    kinds[k] = kind or kinds[k]
    return model.changed(point=points, turn=turns, kind=tuple(kinds))


def opened(model):
    """The mechanism with its last loop left open."""
    fields = {name: value[:-1] for name, value in vars(model).items() if len(value) == len(model.kind)}
    return replace(model, **fields)


FAULTS = {
    "a loop left open": opened,
    "a row left out: hinge for cylindrical": lambda m: changed_joint(m, -1, "cylindrical"),
    "a row left out: ball for hinge": lambda m: changed_joint(m, -1, "ball"),
    "a row too many: weld for hinge": lambda m: changed_joint(m, -1, "weld"),
    "axis of the closing joint about x": lambda m: changed_joint(m, -1, turn=0),
    "axis of the closing joint about y": lambda m: changed_joint(m, -1, turn=1),
    "point of the closing joint": lambda m: changed_joint(m, -1, point=0),
    "axis of a joint in the loop": lambda m: changed_joint(m, 3, turn=0),
    "closed on the world": lambda m: m.changed(body=np.vstack([m.body[:-1], [[-1, m.body[-1, 1]]]])),
    "mass of a body in the loop": lambda m: m.changed(mass=m.mass * np.array([1, 1, 1, 1 + 1e-7])),
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
    error = np.linalg.norm(found.acceleration - truth.acceleration, axis=1)
    assert np.max(error / bound.acceleration) > 1


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
