"""Every engine on trees: each kind of joint alone, and all kinds mixed, against the certified truth."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import KINDS, Unsupported
from plumbline.model.kinematics import complete_state
from plumbline.model.loops import motion_without_inertia
from plumbline.model.random_mechanisms import ELEMENTS, random_tree
from plumbline.model.sampling import random_states
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers.nightly_tests import SLOW
from tests.helpers.planting import model_change, number_change, turned_by
from tests.helpers.random_chains import tree_from_seed
from tests.helpers.shared_answers import sharing
from tests.helpers.true_answers import assert_reported, assert_within_bound

ENGINES = ["reference", "mujoco", "pinocchio", "pinocchio-aba", "pinocchio-maximal", "exudyn", "exudyn-tree"]


@pytest.fixture(scope="module", autouse=True)
def shared_truths():
    """Certified truths and bounds are the same for every engine."""
    with sharing(__name__, "certify_state", "state_rounding_bound"):
        yield


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
        assert model.lacks_inertia
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
        assert_within_bound(found, truth, bound)
        compared += 1
    assert compared >= 3


@pytest.mark.parametrize("engine", [engine for engine in ENGINES if engine != "pinocchio-maximal"])
def test_a_rod_that_ends_in_a_point_which_carries_a_body_is_right(engine):
    alone = tree_from_seed(0, 2, ("weld",))
    inertia = alone.inertia * np.array([0.0, 1.0])[:, None, None]
    joints = {"kind": ("rod", "weld"), "body": np.array([[-1, 0], [0, 1]]), "length": np.array([0.5, 0.0])}
    model = replace(alone, inertia=inertia, **joints)
    model.point[0, 1] = 0.0  # the rod ends where the mass is
    (state,) = random_states(model, 1, 0)
    assert motion_without_inertia(model, state) is None
    (found,) = load_adapter(engine).evaluate(model, [state])
    truth, bound = certify_state(model, state).quantities, state_rounding_bound(model, state)
    assert_within_bound(found, truth, bound)


@pytest.mark.parametrize("engine", ["mujoco", "pinocchio"])
def test_a_screw_through_a_point_is_refused_where_it_is_a_slide_and_a_turn(engine):
    model = tree_from_seed(0, 1, ("helical",))
    model = replace(model, inertia=0 * model.inertia)
    model.point[0, 1] = 0.0
    (state,) = random_states(model, 1, 0)
    adapter = load_adapter(engine)
    if engine == "mujoco":
        with pytest.raises(Unsupported) as refusal:
            adapter.evaluate(model, [state])
        assert refusal.value.gap in adapter.gaps
        return
    (found,) = adapter.evaluate(model, [state])
    assert_within_bound(found, certify_state(model, state).quantities, state_rounding_bound(model, state))


def test_a_turn_without_inertia_is_found():
    model = without_inertia(1)
    (state,) = random_states(model, 1, 1)
    alone = tree_from_seed(0, 2, ("ball",))
    point = replace(alone, inertia=alone.inertia * np.array([1.0, 0.0])[:, None, None])
    (at,) = random_states(point, 1, 0)
    assert motion_without_inertia(point, at) == 1  # it turns about the line to its joint
    assert motion_without_inertia(alone, at) is None
    assert motion_without_inertia(replace(model, inertia=model.inertia + 1e-3 * np.eye(3)), state) is None


MOVING = ("ball", "hinge", "universal", "slide", "cylindrical", "planar", "helical")
# what an engine cannot build: element, kind of joint, and words of its reason
MISSING = {
    "pinocchio-maximal": [(element, None, "no joints with rotors, springs") for element in ELEMENTS],
    "exudyn": [
        ("armature", None, "no rotor between two bodies"),
        *((element, "ball", "rotation vector") for element in ("damping", "stiffness")),
        ("stiffness", "universal", "a joint with one turn"),
        *((element, "planar", "two slides") for element in ("damping", "stiffness", "effort")),
    ],
    "exudyn-tree": [(element, "ball", "three revolutes") for element in ("armature", "damping", "stiffness")],
}


NOT_BUILT = {"exudyn": ("helical",), "exudyn-tree": ("helical",)}


def reasons_to_refuse(engine, model, element):
    found = []
    for what, kind, words in MISSING.get(engine, ()):
        has = [k for k, own in enumerate(model.kind) if kind in (own, None) and own in MOVING]
        is_there = len(model.spring_body) if what == "springs" else np.any(getattr(model, what)[has])
        found += [words] * bool(what in element and is_there)
    return found


EVERY = tuple(KINDS)
CASES = [((), kinds, seed) for kinds in (*((kind,) for kind in KINDS), EVERY) for seed in range(4)]
CASES += [
    (elements, kinds, seed)
    for elements in (*((name,) for name in ELEMENTS), ELEMENTS)
    for kinds in (*((kind,) for kind in MOVING), EVERY)
    for seed in range(2)
]


def is_fast(elements, kinds, seed):
    """Without one element alone on one kind of joint: it is there with the others, and alone on all kinds."""
    return seed == 0 and (len(elements) != 1 or kinds == EVERY)


@pytest.mark.parametrize(
    ("elements", "kinds", "seed"),
    [
        pytest.param(*case, id=f"{'+'.join(case[0])}-{'+'.join(case[1])}-{case[2]}",
                     marks=[] if is_fast(*case) else SLOW)
        for case in CASES
    ],
)  # fmt: skip
@pytest.mark.parametrize("engine", ENGINES)
def test_states_of_random_trees_are_right_or_refused(engine, elements, kinds, seed):
    adapter, missing = load_adapter(engine), NOT_BUILT.get(engine, ())
    kinds = tuple(kind for kind in kinds if kind not in missing) or missing
    model = tree_from_seed([seed, 5], 6, kinds, elements=elements)
    states = random_states(model, 2, seed)
    if kinds == missing:
        words = ["advances", *reasons_to_refuse(engine, model, elements)]
        with pytest.raises(Unsupported, match="|".join(words)):
            adapter.evaluate(model, states)
        return
    if reasons := reasons_to_refuse(engine, model, elements):
        with pytest.raises(Unsupported) as caught:
            adapter.evaluate(model, states)
        assert any(words in str(caught.value) for words in reasons)
        return
    for state, found in zip(states, adapter.evaluate(model, states), strict=True):
        truth = certify_state(model, state, mass_matrix=True).quantities
        assert_within_bound(found, truth, state_rounding_bound(model, state))


@pytest.mark.parametrize("engine", ["mujoco", "pinocchio", "pinocchio-aba", "exudyn", "exudyn-tree"])
def test_a_spring_on_a_hinge_that_has_turned_round_twice(engine):
    model = tree_from_seed(3, 2, ("hinge",)).changed(
        stiffness=np.array([[2.0, 0.0], [3.0, 0.0]]), rest=np.array([[0.4, 0.0], [-9.0, 0.0]])
    )
    (state,) = random_states(model, 1, 3)
    state = complete_state(model, replace(state, x=state.x + 2 * np.pi * np.array([[2, 0], [-3, 0]])))
    (found,) = load_adapter(engine).evaluate(model, [state])
    assert_within_bound(found, certify_state(model, state).quantities, state_rounding_bound(model, state))


def test_an_engine_that_builds_no_trees_gives_the_reason():
    model, adapter = tree_from_seed(0, 3, ("hinge",)), load_adapter("reference-printed")
    states = random_states(model, 1, 0)
    with pytest.raises(Unsupported, match="chains of rods and balls"):
        adapter.evaluate(model, states)
    with pytest.raises(Unsupported, match="chains of rods and balls"):
        adapter.simulate(model, *states, np.array([0.0, 0.25]), "dop853", 1e-9)


def turned(side, axis):
    """The middle joint's axes in one body turned by 1e-7 rad about one of themselves."""
    return number_change("turn", 1, side, to=turned_by(*(1e-7 * np.eye(3)[axis])))


FAULTS = {
    "axis in the far body": ("hinge", turned(0, 0)),
    "axis in the near body": ("hinge", turned(1, 1)),
    "axis of a slide": ("slide", turned(0, 0)),
    "frame of a weld": ("weld", turned(1, 2)),
    # the near body's axis turns first: x and y of the far body exchanged with those of the near one
    "order of a universal joint's axes": (
        "universal",
        number_change("turn", 1, to=turned_by(0, 0, np.pi / 2)),
    ),
    "far point": ("cylindrical", number_change("point", 1, 0, 0, by=1e-7)),
    "near point": ("ball", number_change("point", 1, 1, 0, by=1e-7)),
    "another parent": ("hinge", number_change("body", 2, 0, to=lambda _: 0)),
    "a hinge that slides": ("cylindrical", model_change(lambda *_: {"kind": ("hinge", "slide", "hinge")})),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("engine", [engine for engine in ENGINES if engine != "reference"])
def test_a_fault_in_a_joint_is_reported(engine, fault):
    kind, change = FAULTS[fault]
    model = replace(
        tree_from_seed(7, 3, ("hinge",)),
        body=np.array([[-1, 0], [0, 1], [1, 2]]), kind=("hinge", kind, "hinge"),
    )  # fmt: skip
    (state,) = random_states(model, 1, 3)
    wrong, at = change(model, state)
    (found,) = load_adapter(engine).evaluate(wrong, [at])
    assert_reported(found, certify_state(model, state).quantities, state_rounding_bound(model, state))
