"""Pairs of features: legal where the format accepts them, covered where a scenario shows either left out."""

import itertools
from collections import Counter

import numpy as np
import pytest

from plumbline.engines.engine_calls import Evaluation
from plumbline.engines.registry import load_adapter
from plumbline.judging.rows import RowContext, Verdict
from plumbline.judging.state_level import judge_states
from plumbline.model.datatypes import JOINT_ELEMENTS, KINDS
from plumbline.model.features import ROLES, Feature, Place, features, joint_roles, without_feature
from plumbline.model.kinematics import complete_state
from plumbline.scenario.generator import random_mechanism
from plumbline.studies import feature_pairs
from plumbline.truth.ground_truth import state_truth
from tests.helpers.catalogue import catalogue_scenario, catalogue_scenarios, states_of
from tests.helpers.in_process import InProcessWorkers

PARTS = [f"crowded-loops-{k}" for k in range(1, 7)]  # together they have all pairs
GROUP = 14  # places: larger groups make fewer examples of the same pairs


def test_every_kind_is_legal_in_every_role_but_a_free_body_that_closes_a_loop():
    every = {Place(kind, role) for kind in KINDS for role in ROLES}
    assert every - set(feature_pairs.legal_places()) == {Place("free", "closing")}


def test_no_legal_pair_is_lost():
    legal = feature_pairs.legal_pairs(GROUP)
    counts = Counter(
        pair for name in PARTS for pair in feature_pairs.all_pairs(features(catalogue_scenario(name).model))
    )
    assert not [pair for pair in legal if not counts[pair]], "no scenario has these pairs"
    assert {counts[pair] for pair in legal} >= {1, 2}  # without any of the scenarios pairs were lost
    for one, other in (
        (Feature("stiffness 1", "ball", "closing"), Feature("armature 2", "cylindrical", "closing")),
        (Feature("drag force", "hinge", "loop"), Feature("length", "rod", "beside")),
        (Feature("effort 2", "universal", "closing"), Feature("rest 1", "slide", "loop")),
        (Feature("gravity x"), Feature("damping", "", "a spring between two trees")),
        (Feature("mass", "free", "beside"), Feature("moment", "free", "loop")),
    ):
        assert tuple(sorted((one, other))) in legal, (one, other)
    illegal = Feature("mass", "free", "single"), Feature("mass", "free", "beside")
    assert tuple(sorted(illegal)) not in legal


def test_every_legal_pair_of_places_is_in_the_examples():
    places = feature_pairs.legal_places()
    legal = feature_pairs.legal_pairs()
    assert legal == feature_pairs.legal_pairs(GROUP)
    for one, other in itertools.combinations_with_replacement(places, 2):
        for is_hub_world in (False, True):
            example = feature_pairs.example_scenario([one, other], is_hub_world)
            assert example is None or feature_pairs.all_pairs(features(example.model)) <= legal, (one, other)


def test_every_legal_pair_is_covered():
    shown = feature_pairs.measure_features(InProcessWorkers(), [catalogue_scenario(name) for name in PARTS])
    covered = set().union(*map(feature_pairs.all_pairs, shown.values()))
    assert feature_pairs.legal_pairs() <= covered


def test_roles_of_joints():
    model = catalogue_scenario("flyball-governor").model
    assert joint_roles(model)[model.n :] == ["closing"] * (len(model.kind) - model.n)
    tree = catalogue_scenario("tree-of-seven-sprung").model
    assert dict(zip(tree.kind, joint_roles(tree), strict=True)) == {
        "ball": "beside",  # the drifter is on the world too
        "hinge": "beside", "universal": "single", "weld": "single", "cylindrical": "beside", "rod": "single",
        "slide": "beside", "free": "beside",
    }  # fmt: skip


def test_features_are_what_is_not_neutral_and_can_be_left_out():
    model = catalogue_scenario("crowded-loops-6").model
    for one in features(model)[::5]:
        left = features(without_feature(model, one))
        assert one not in left or one.field == "parent", one
    bare = model.changed(**{name: np.zeros_like(getattr(model, name)) for name in JOINT_ELEMENTS})
    gone = {one.field for one in features(model)} - {one.field for one in features(bare)}
    assert gone == {f"{name} {i}" for name in JOINT_ELEMENTS for i in range(1, model.columns + 1)}


def wrong_rows(engine, name, feature):
    """Rows of a real engine on a scenario that disagree if its adapter leaves the feature out."""
    scenario = catalogue_scenario(name)
    states = states_of(scenario, feature_pairs.STATES)
    changed = without_feature(scenario.model, feature)
    answers = load_adapter(engine).evaluate(changed, [complete_state(changed, one) for one in states])
    context = RowContext(name, "", engine, engine, "0")
    rows = judge_states(context, state_truth(scenario.model, states), Evaluation(answers)).rows
    return [row.quantity for row in rows if row.verdict == Verdict.DISAGREES]


def confirmed(engine, name, count):
    """Features of a scenario drawn at random, and those of them that a wrong adapter shows as predicted."""
    scenario = catalogue_scenario(name)
    states = states_of(scenario, feature_pairs.STATES)
    shown = feature_pairs.shown_features(scenario.model, states)
    # without a point or an axis a loop is open, and what an engine makes of that is its own
    some = [one for one in shown if not one.field.startswith(("point", "axes", "parent", "length"))]
    chosen = [some[i] for i in np.random.default_rng(28).permutation(len(some))[:count]]
    return [one for one in chosen if wrong_rows(engine, name, one)], chosen


@pytest.mark.parametrize("engine", ["pinocchio", "mujoco", "reference"])
@pytest.mark.parametrize("name", ["crowded-loops-6", "crowded-tree"])
def test_what_is_shown_by_prediction_is_shown_by_an_engine(engine, name):
    found, chosen = confirmed(engine, name, 12)
    assert found == chosen and len(chosen) == 12


def test_a_feature_that_is_left_out_by_an_engine_is_reported():
    found, chosen = confirmed("pinocchio", "tree-of-seven-sprung", 3)
    assert found == chosen and len(chosen) == 3


def test_triples_are_counted_once():
    a, b, c, d = (Feature(f"gravity {letter}") for letter in "xyzw")
    assert feature_pairs.count_triples([[a, b]], []) == (0, 0)
    assert feature_pairs.count_triples([[a, b, c], [c, b, a]], []) == (1, 1)
    assert feature_pairs.count_triples([[a, b, c, d]], [[d, b, c], [a, d]]) == (4, 3)


@pytest.mark.full
def test_a_week_of_nights_has_the_legal_triples():
    legal = feature_pairs.legal_pairs(GROUP)
    known = sorted({one for pair in legal for one in pair})
    index = {one: i for i, one in enumerate(known)}
    pairs = np.zeros((len(known),) * 2, bool)
    for one, other in legal:
        pairs[index[one], index[other]] = pairs[index[other], index[one]] = True
    found = np.zeros((len(known),) * 3, bool)
    for night, k in itertools.product(range(7), range(100)):  # as many as nights have by default
        some = [index[one] for one in features(random_mechanism(night, k).model) if one in index]
        found[np.ix_(some, some, some)] = True
    wanted = pairs[:, :, None] & pairs[:, None, :] & pairs[None, :, :]
    assert np.count_nonzero(found & wanted) > 0.99 * np.count_nonzero(wanted)


def test_everything_of_a_joint_a_body_or_a_spring_stands_alone_once():
    """An adapter may read one thing only where there is another: a scenario has it without the other."""
    of_joint, of_body = ("armature", "damping", "stiffness", "effort", "rest"), ("force", "moment")
    of_body += ("drag_force", "drag_moment")
    of_spring = ("spring_stiffness", "spring_damping", "spring_length")
    needs = {"rest": {"stiffness"}, "spring_length": {"spring_stiffness"}}  # without effect beside it alone
    found, wanted = set(), set()
    for model in (s.model for s in catalogue_scenarios().values()):
        for k, kind in enumerate(model.kinds):
            where = "a closing joint" if k >= model.n else "a joint"
            for i in range(kind.element_count):
                has = {name for name in of_joint if getattr(model, name)[k, i]}
                found |= {(where, one, other) for one in has for other in set(of_joint) - has}
        for k in range(model.n):
            has = {name for name in of_body if np.any(getattr(model, name)[k])}
            found |= {("a body", one, other) for one in has for other in set(of_body) - has}
        for i in range(len(model.spring_length)):
            has = {name for name in of_spring if getattr(model, name)[i]}
            found |= {("a spring", one, other) for one in has for other in set(of_spring) - has}
    groups = (
        ("a joint", of_joint),
        ("a closing joint", of_joint),
        ("a body", of_body),
        ("a spring", of_spring),
    )
    for where, names in groups:
        wanted |= {
            (where, *pair)
            for pair in itertools.permutations(names, 2)
            if pair[1] not in needs.get(pair[0], ())
        }
    # a rotor on a closing joint stands beside a spring and a damper everywhere
    assert wanted - found == {("a closing joint", "armature", other) for other in ("damping", "stiffness")}
