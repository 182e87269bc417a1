"""Relations on trees with every joint and element, and planted defects that break one of them."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from adapters.mujoco_engine import Mujoco, _Tie
from adapters.reference_engine import Reference
from plumbline.engines.metamorphic_hooks import metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.judging.known_issues import KnownIssues, project_known_issues
from plumbline.judging.relation_rows import judge_relations
from plumbline.judging.rows import RowContext
from plumbline.measurements.state_relations import (
    MISSING_TERMS,
    REDESCRIPTIONS,
    Relation,
    check_state_relation,
)
from plumbline.model.datatypes import JOINT_ELEMENTS
from plumbline.model.kinematics import complete_state, quaternion_product
from plumbline.model.loops import loop_gaps
from plumbline.model.random_mechanisms import random_loop_mechanism, random_tree
from plumbline.model.redescription import moved_root
from plumbline.model.sampling import random_states
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.random_chains import random_chain, tree_from_seed
from tests.helpers.relation_checks import check_run_relations, check_state_relations
from tests.helpers.shared_answers import sharing

TREE = catalogue_scenario("tree-of-seven")
BY_TENDONS = "by tendon equalities"
LOOP_ENGINES = ["reference", "mujoco", "pinocchio", "pinocchio-maximal", "exudyn"]


@pytest.fixture(scope="module", autouse=True)
def shared_bounds():
    """Engines with and without a defect are judged by the same bounds."""
    with sharing("plumbline.measurements.state_relations", "rounding_bounds"):
        yield


def ratios(engine, model, states):
    """By relation its ratio; MuJoCo's tendon equalities are a defect on record (tests/adapters)."""
    results = check_state_relations(engine, model, states)
    return {r.relation: r.ratio for r in results if r.ratio is not None and r.relation != BY_TENDONS}


@pytest.mark.parametrize("engine", [Reference, Mujoco])
@pytest.mark.parametrize("seed", range(4))
def test_relations_hold_on_random_trees_with_elements(engine, seed):
    rng = np.random.default_rng(seed)
    model = random_tree(rng, 6, elements=("armature", "damping", "stiffness", "effort", "springs"))
    found = ratios(engine(), model, random_states(model, 2, seed))
    assert {"rotated world", "re-chosen body frame", "masses doubled", "lengths × 4"} <= set(found)
    assert {"time reversed", "springs as loads"} <= set(found)
    assert max(found.values()) <= 1, found


def test_time_reversal_and_permuted_siblings_hold_on_a_tree():
    model = replace(TREE.model, drag_force=np.zeros(8), drag_moment=np.zeros(8))
    found = ratios(Mujoco(), model, [TREE.state])
    assert found["time reversed"] <= 1 and found["siblings permuted"] <= 1


class WorldUpOnly(Reference):
    """Takes gravity for vertical."""

    def _evaluate(self, model, states):
        fallen = replace(model, gravity=np.array([0, 0, -np.linalg.norm(model.gravity)]))
        return super()._evaluate(fallen, states)


class FirstSiblingHeavier(Reference):
    """The first branch of a body is heavier than it should be."""

    def _evaluate(self, model, states):
        return super()._evaluate(
            model.changed(mass=model.mass * (1 + 1e-9 * (np.arange(model.n) == 1))), states
        )


def loop_of_hinges():
    """Two branches on the world, one of which closes on the other; bodies on hinges, a rod and a ball."""
    return random_loop_mechanism(6, 4, ["hinge"], ("hinge", "ball", "rod"))


@pytest.mark.parametrize("is_loop", [False, True], ids=["tree", "loop"])
@pytest.mark.parametrize(
    ("engine", "relation"), [(WorldUpOnly, "rotated world"), (FirstSiblingHeavier, "siblings permuted")]
)
def test_planted_defects_break_a_relation(engine, relation, is_loop):
    model, state = loop_of_hinges() if is_loop else (TREE.model, TREE.state)
    found = ratios(engine(), model, [state])
    assert found[relation] > 10
    assert found["masses doubled"] <= 1


class Redescribed(Reference):
    """An engine that computes another mechanism than the given one; equivalent descriptions then differ."""

    change = staticmethod(lambda model: model)

    def _evaluate(self, model, states):
        return super()._evaluate(self.change(model), states)


def far_points_moved(model):
    """Points of far bodies are a little off, as for a mistake in the offset of a child from its parent."""
    point = model.point.copy()
    point[:, 0] *= np.where(model.body[:, :1] >= 0, 1 + 1e-8, 1.0)
    return model.changed(point=point)


def near_axes_turned(model):
    """The axes of joints with axes are a little off in the near body."""
    turn = model.turn.copy()
    for k, kind in enumerate(model.kind):
        if kind in ("hinge", "universal"):
            turn[k, 1] = quaternion_product(turn[k, 1], np.array([1.0, 1e-8, 0.0, 0.0]))
    return model.changed(turn=turn)


REDESCRIPTION_DEFECTS = {  # the change, and the relations that see it; no other does
    "root moved": (far_points_moved, {"root moved", "joints as rods"}),
    "joints as rods": (near_axes_turned, {"joints as rods", "root moved"}),
    "inertia as rotors": (lambda m: m.changed(armature=m.armature * (1 + 1e-8)), {"inertia as rotors"}),
    "springs as loads": (lambda m: m.changed(rest=m.rest * (1 + 1e-8)), {"springs as loads"}),
    "springs as loads, between points": (
        lambda m: m.changed(spring_stiffness=m.spring_stiffness * (1 + 1e-8)), {"springs as loads"},
    ),
}  # fmt: skip


def redescribed_tree(elements=("stiffness", "damping", "springs")):
    """Bodies on hinges, a universal joint and a weld, whose root is bare, so that it can move."""
    tree = tree_from_seed(5, 4, ("hinge",), elements=elements)
    bare = np.array([[True], [True], [True], [False]])
    return replace(
        tree,
        kind=("hinge", "universal", "weld", "hinge"),
        body=np.array([[-1, 0], [0, 1], [1, 2], [1, 3]]),
        **{name: np.where(bare, 0.0, getattr(tree, name)) for name in JOINT_ELEMENTS},
    )


@pytest.mark.parametrize("defect", REDESCRIPTION_DEFECTS)
def test_a_planted_defect_breaks_its_redescription(defect):
    change, seen_by = REDESCRIPTION_DEFECTS[defect]
    model = redescribed_tree()
    (state,) = random_states(model, 1, 2)
    engine = Redescribed()
    honest = ratios(engine, model, [state])
    assert max(honest.values()) <= 1 and set(REDESCRIPTIONS) <= set(honest)
    engine.change = change
    found = ratios(engine, model, [state])
    assert {name for name, ratio in found.items() if ratio > 1} == seen_by, found


def test_time_reversal_sees_a_wrong_sign_of_a_rate_though_there_are_dampers():
    class Leaning(Reference):
        def _evaluate(self, model, states):
            found = super()._evaluate(model, states)
            pushed = [a.acceleration + 1e-8 * s.v for a, s in zip(found, states, strict=True)]
            return [replace(a, acceleration=x) for a, x in zip(found, pushed, strict=True)]

    model = redescribed_tree()
    found = ratios(Leaning(), model, random_states(model, 1, 2))
    assert {"time reversed"} <= {name for name, ratio in found.items() if ratio > 1}


@pytest.mark.parametrize("engine", ["mujoco", "pinocchio", "pinocchio-maximal", "exudyn"])
def test_redescriptions_hold_on_every_engine_that_closes_loops(engine):
    model = redescribed_tree(elements=())
    hooks = metamorphic_hooks(load_adapter(engine))
    found = ratios(hooks, model, random_states(model, 1, 4))
    rotors = {"inertia as rotors"} if engine in ("mujoco", "pinocchio") else set()
    assert {"root moved", "joints as rods"} | rotors <= set(found)
    assert max(found.values()) <= 1, found


def test_a_slow_ball_without_gravity_has_the_same_moved_root():
    """A stabilisation of 1/s² in MuJoCo's weld pulled a gap of one rounding, 1e-16 m, to zero."""
    ball = random_chain(0, [False])[0].changed(
        gravity=np.zeros(3), mass=np.array([0.69]), inertia=np.diag([0.013, 0.006, 0.008])[None],
        proximal=np.array([[-0.506, -0.121, -0.273]]),
    )  # fmt: skip
    p = np.array([[0.259, 0.124, -0.937, -0.197]])
    state = replace(random_states(ball, 1, 0)[0], p=p / np.linalg.norm(p), omega=np.full((1, 3), 5e-3))
    turned = [complete_state(ball, replace(state, omega=x * state.omega)) for x in (1, -0.9, 0.8, -0.7)]
    assert ratios(Mujoco(), ball, turned)["root moved"] <= 1


@pytest.mark.parametrize("engine", LOOP_ENGINES)
def test_relations_hold_on_loops(engine):
    model, state = loop_of_hinges()
    found = ratios(metamorphic_hooks(load_adapter(engine)), model, [state])
    expected = {"rotated world", "re-chosen body frame", "masses doubled", "lengths × 4", "time reversed"}
    assert expected | {"siblings permuted", "root moved", "joints as rods"} <= set(found)
    assert max(found.values()) <= 1, found


@pytest.mark.parametrize("seed", range(6))
def test_a_moved_root_is_the_same_mechanism(seed):
    """Every kind of joint reversed: the loop that the root's joint closes is closed, and bodies stay."""
    model = tree_from_seed(seed, 5, elements=())
    (state,) = random_states(model, 1, seed)
    moved = moved_root(model)
    if moved is None:  # a free body alone
        assert model.kind[0] == "free" and (model.n == 1 or model.body[1, 0] < 0)
        return
    there = moved.state(state)
    for name in ("r", "v", "p", "omega"):
        value, expected = getattr(there, name), getattr(state, name)[moved.order]
        sign = np.sign(np.sum(value * expected, axis=1, keepdims=True)) if name == "p" else 1.0
        np.testing.assert_allclose(value * sign, expected, atol=1e-13 * max(1.0, np.max(np.abs(expected))))
    if moved.model.has_loops:
        assert max(np.max(gap) for gap in loop_gaps(moved.model, there)) < 1e-12


def test_runs_of_trees_return_when_time_is_reversed():
    model = replace(TREE.model, drag_force=np.zeros(8), drag_moment=np.zeros(8))
    results = list(check_run_relations(Reference(), model, TREE.state))
    assert [r.integrator for r in results] == ["collocation"]
    assert results[0].ratio <= 1


@pytest.mark.parametrize("is_loop", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_what_tendons_are_off_by_is_the_term_that_they_leave_out(seed, is_loop):
    """In motion; measured on 20 trees and loops: of 1e8 to 1e12 tolerances at most 0.06 are left."""
    kinds = ("rod", "ball", "hinge", "universal", "cylindrical", "slide")
    if is_loop:
        model, state = random_loop_mechanism(seed, 4, ["rod"], kinds[:3])
    else:
        model = tree_from_seed(seed, 4, kinds[:1] + kinds, elements=("armature", "springs"))
        (state,) = random_states(model, 1, seed)
    assert "rod" in model.kind
    found = tendons(model, state)
    assert found.ratio > 1e6 and found.unexplained < 0.2


def tendons(model, state):
    """The relation's result, without the other relations."""
    engine, bounds = Mujoco(), [state_rounding_bound(model, state)]
    relation = Relation(BY_TENDONS, missing_term=MISSING_TERMS["tendon equalities"])
    other = engine.with_option("tendon equalities").evaluate
    usual = engine.evaluate(model, [state])
    return check_state_relation(relation, usual, other, model, [state], bounds, bounds)


@pytest.mark.parametrize("moved", [0.0, 1e-7])
def test_an_error_besides_the_recorded_one_of_tendons_is_a_new_disagreement(moved):
    """A tendon that ends 0.1 µm beside its point, in motion, where the recorded error is 1e11 tolerances."""
    model = tree_from_seed(1, 3, ("rod", "hinge"))
    (state,) = random_states(model, 1, 1)

    def tie(bodies, points, length, softness):
        return _Tie(bodies, points + moved, length, softness)

    with patch("adapters.mujoco_engine._Tie", tie):
        found = tendons(model, state)
    rows = judge_relations(RowContext("rest", "", "mujoco", "MuJoCo", "4.0.0"), [found]).rows
    known = KnownIssues(project_known_issues(), has_extra_refinements=False)
    (row,) = known.mark_known(rows, model.n, joints=model.kind)
    assert row.verdict == "disagrees" and (row.known_issue is None) == (moved > 0), row
