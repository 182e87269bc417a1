"""Every engine on trees: each kind of joint alone, and all kinds mixed, against the certified truth."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import KINDS, Unsupported
from plumbline.model.kinematics import complete_state, quaternion_product
from plumbline.model.loops import motion_without_inertia
from plumbline.model.random_mechanisms import ELEMENTS, random_tree
from plumbline.model.sampling import random_states
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import MAX_RELATIVE_BOUND, state_rounding_bound
from tests.helpers.shared_answers import sharing

ENGINES = ["reference", "mujoco", "pinocchio", "pinocchio-aba", "pinocchio-maximal", "exudyn", "exudyn-tree"]
MIXES = {**{kind: (kind,) for kind in KINDS}, "all": tuple(KINDS)}


@pytest.fixture(scope="module", autouse=True)
def shared_truths():
    """Certified truths and bounds are the same for every engine."""
    with sharing(__name__, "certify_state", "state_rounding_bound"):
        yield


@pytest.mark.parametrize("mix", MIXES)
@pytest.mark.parametrize("engine", ENGINES)
def test_states_of_random_trees_are_right(engine, mix):
    adapter = load_adapter(engine)
    for seed in range(4):
        model = random_tree(np.random.default_rng([seed, len(mix)]), 6, MIXES[mix])
        states = random_states(model, 2, seed)
        for state, found in zip(states, adapter.evaluate(model, states), strict=True):
            truth = certify_state(model, state, mass_matrix=True).quantities
            bound = state_rounding_bound(model, state)
            for name, scale in bound.scale.items():
                answer, value = getattr(found, name), getattr(truth, name)
                if answer is None or value is None:
                    assert model.is_chain or engine == "exudyn-tree"
                    continue
                error = np.asarray(answer - value)
                error = np.linalg.norm(error, axis=-1) if error.shape[-1:] == (3,) else np.abs(error)
                assert np.all(error <= bound.tolerance(name)), (name, seed, model.kind)
                assert bound.relative_bound(name) < MAX_RELATIVE_BOUND, (name, seed, scale)


def without_inertia(seed):
    """A random tree of points, thin rods and bodies; on hinges and slides that carry points at a distance."""
    rng = np.random.default_rng(seed)
    model = random_tree(rng, 5, ("hinge", "slide", "universal", "ball"))
    inertia = model.inertia.copy()
    for k, kind in enumerate(model.kind):
        inertia[k] *= kind == "ball"
        if kind == "ball":
            thin = rng.normal(size=3)
            inertia[k] = 0.05 * (thin @ thin * np.eye(3) - np.outer(thin, thin))
    return replace(model, inertia=inertia)


@pytest.mark.parametrize("engine", ENGINES)
def test_bodies_without_inertia_are_right_where_they_are_determinate(engine):
    adapter, compared = load_adapter(engine), 0
    for seed in range(6):
        model = without_inertia(seed)
        (state,) = random_states(model, 1, seed)
        assert model.lacks_inertia and not model.is_chain
        if motion_without_inertia(model, state) is not None:
            continue
        if engine == "pinocchio-maximal":
            with pytest.raises(Unsupported, match="without inertia"):
                adapter.evaluate(model, [state])
            compared += 1
            continue
        try:
            (found,) = adapter.evaluate(model, [state])
        except Unsupported as reason:  # angles near their singularity
            assert engine == "exudyn-tree" and "singularity" in str(reason)
            continue
        truth, bound = certify_state(model, state).quantities, state_rounding_bound(model, state)
        for name in ("acceleration", "angular_acceleration", "joint_reaction", "joint_moment"):
            if getattr(found, name) is not None:
                error = np.linalg.norm(getattr(found, name) - getattr(truth, name), axis=1)
                assert np.all(error <= bound.tolerance(name)), (name, seed)
                assert bound.relative_bound(name) < 1e-6, (name, seed)
        compared += 1
    assert compared >= 3


def test_a_turn_without_inertia_is_found():
    model = without_inertia(1)
    (state,) = random_states(model, 1, 1)
    alone = random_tree(np.random.default_rng(0), 2, ("ball",))
    point = replace(alone, inertia=alone.inertia * np.array([1.0, 0.0])[:, None, None])
    (at,) = random_states(point, 1, 0)
    assert motion_without_inertia(point, at) == 1  # it turns about the line to its joint
    assert motion_without_inertia(alone, at) is None
    assert motion_without_inertia(replace(model, inertia=model.inertia + 1e-3 * np.eye(3)), state) is None


MOVING = ("ball", "hinge", "universal", "slide", "cylindrical")
# what an engine cannot build: element, kind of joint, and words of its reason
MISSING = {
    "pinocchio-maximal": [(element, None, "no joints with rotors, springs") for element in ELEMENTS],
    "exudyn": [
        ("armature", None, "no rotor between two bodies"),
        *((element, "ball", "rotation vector") for element in ("damping", "stiffness")),
        ("stiffness", "universal", "a joint with one turn"),
    ],
    "exudyn-tree": [(element, "ball", "three revolutes") for element in ("armature", "damping", "stiffness")],
}


def reasons_to_refuse(engine, model, element):
    found = []
    for what, kind, words in MISSING.get(engine, ()):
        has = [k for k, own in enumerate(model.kind) if kind in (own, None) and own in MOVING]
        is_there = len(model.spring_body) if what == "springs" else np.any(getattr(model, what)[has])
        found += [words] * bool(what in element and is_there)
    return found


@pytest.mark.parametrize("kinds", [*((kind,) for kind in MOVING), tuple(KINDS)], ids="+".join)
@pytest.mark.parametrize("element", [*((name,) for name in ELEMENTS), ELEMENTS], ids="+".join)
@pytest.mark.parametrize("engine", ENGINES)
def test_states_of_trees_with_elements_are_right_or_refused(engine, element, kinds):
    adapter = load_adapter(engine)
    for seed in range(2):
        model = random_tree(np.random.default_rng([seed, 5]), 5, kinds, elements=element)
        (state,) = random_states(model, 1, seed)
        if reasons := reasons_to_refuse(engine, model, element):
            with pytest.raises(Unsupported) as caught:
                adapter.evaluate(model, [state])
            assert any(words in str(caught.value) for words in reasons)
            continue
        (found,) = adapter.evaluate(model, [state])
        truth = certify_state(model, state, mass_matrix=True).quantities
        bound = state_rounding_bound(model, state)
        for name in bound.scale:
            answer, value = getattr(found, name), getattr(truth, name)
            if answer is None and engine == "exudyn-tree":
                continue
            error = np.asarray(answer - value)
            error = np.linalg.norm(error, axis=-1) if error.shape[-1:] == (3,) else np.abs(error)
            assert np.all(error <= bound.tolerance(name)), (name, seed, model.kind)


@pytest.mark.parametrize("engine", ["mujoco", "pinocchio", "pinocchio-aba", "exudyn", "exudyn-tree"])
def test_a_spring_on_a_hinge_that_has_turned_round_twice(engine):
    model = random_tree(np.random.default_rng(3), 2, ("hinge",)).changed(
        stiffness=np.array([[2.0, 0.0], [3.0, 0.0]]), rest=np.array([[0.4, 0.0], [-9.0, 0.0]])
    )
    (state,) = random_states(model, 1, 3)
    state = complete_state(model, replace(state, x=state.x + 2 * np.pi * np.array([[2, 0], [-3, 0]])))
    (found,) = load_adapter(engine).evaluate(model, [state])
    truth, bound = certify_state(model, state).quantities, state_rounding_bound(model, state)
    error = np.linalg.norm(found.acceleration - truth.acceleration, axis=1)
    assert np.all(error <= bound.acceleration)


@pytest.mark.parametrize("engine", ["reference-printed"])
def test_an_engine_that_builds_no_trees_gives_the_reason(engine):
    model = random_tree(np.random.default_rng(0), 3, ("hinge",))
    with pytest.raises(Unsupported, match="chains of rods and balls"):
        load_adapter(engine).evaluate(model, random_states(model, 1, 0))


def turned(model, k, side, axis):
    """The joint's axes in one body turned by 1e-7 rad about one of themselves."""
    turn = model.turn.copy()
    turn[k, side] = quaternion_product(turn[k, side], np.array([1.0, *(5e-8 * np.eye(3)[axis])]))
    return model.changed(turn=turn / np.linalg.norm(turn, axis=-1, keepdims=True))


def exchanged_universal_axes(model, k):
    """The near body's axis turns first: x and y of the far body exchanged with those of the near one."""
    turn = model.turn.copy()
    turn[k] = quaternion_product(turn[k], np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]))
    return model.changed(turn=turn)


def moved_point(model, k, side):
    point = model.point.copy()
    point[k, side, 0] += 1e-7
    return model.changed(point=point)


FAULTS = {
    "axis in the far body": ("hinge", lambda m: turned(m, 1, 0, 0)),
    "axis in the near body": ("hinge", lambda m: turned(m, 1, 1, 1)),
    "axis of a slide": ("slide", lambda m: turned(m, 1, 0, 0)),
    "frame of a weld": ("weld", lambda m: turned(m, 1, 1, 2)),
    "order of a universal joint's axes": ("universal", lambda m: exchanged_universal_axes(m, 1)),
    "far point": ("cylindrical", lambda m: moved_point(m, 1, 0)),
    "near point": ("ball", lambda m: moved_point(m, 1, 1)),
    "another parent": ("hinge", lambda m: m.changed(body=np.array([[-1, 0], [0, 1], [0, 2]]))),
    "a hinge that slides": ("cylindrical", lambda m: m.changed(kind=("hinge", "slide", "hinge"))),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("engine", [engine for engine in ENGINES if engine != "reference"])
def test_a_fault_in_a_joint_is_reported(engine, fault):
    kind, change = FAULTS[fault]
    rng = np.random.default_rng(7)
    model = replace(random_tree(rng, 3, ("hinge",)), body=np.array([[-1, 0], [0, 1], [1, 2]]))
    model = replace(model, kind=("hinge", kind, "hinge"))
    (state,) = random_states(model, 1, 3)
    wrong = change(model)
    truth, bound = certify_state(model, state).quantities, state_rounding_bound(model, state)
    (found,) = load_adapter(engine).evaluate(wrong, [complete_state(wrong, state)])
    error = np.linalg.norm(found.acceleration - truth.acceleration, axis=1)
    assert np.max(error / bound.acceleration) > 1
