"""Relations on trees with every joint and element, and planted defects that break one of them."""

from dataclasses import replace

import numpy as np
import pytest

from adapters.mujoco_engine import Mujoco
from adapters.reference_engine import Reference
from plumbline.judging.run_relations import check_run_relations
from plumbline.judging.state_relations import check_state_relations
from plumbline.model.equivalent import reorder_bodies, rotate_world, siblings_reversed
from plumbline.model.random_mechanisms import random_tree
from plumbline.model.sampling import random_states
from plumbline.scenario.loader import find_scenario_file, load_scenario

Q = np.array([0.5, -0.5, 0.5, 0.5])
TREE = load_scenario(find_scenario_file("tree-of-seven"))


def ratios(engine, model, states):
    return {r.relation: r.ratio for r in check_state_relations(engine, model, states) if r.ratio is not None}


@pytest.mark.parametrize("engine", [Reference, Mujoco])
@pytest.mark.parametrize("seed", range(4))
def test_relations_hold_on_random_trees_with_elements(engine, seed):
    rng = np.random.default_rng(seed)
    model = random_tree(rng, 6, elements=("armature", "damping", "stiffness", "effort", "springs"))
    found = ratios(engine(), model, random_states(model, 2, seed))
    assert {"rotated world", "re-chosen body frame", "masses doubled", "lengths × 4"} <= set(found)
    assert "time reversed" not in found  # dampers
    assert max(found.values()) <= 1, found


def test_time_reversal_and_permuted_siblings_hold_on_a_tree():
    model = replace(TREE.model, drag_force=np.zeros(8), drag_moment=np.zeros(8))
    found = ratios(Mujoco(), model, [TREE.state])
    assert found["time reversed"] <= 1 and found["siblings permuted"] <= 1


def test_permuted_siblings_are_the_same_tree():
    order = siblings_reversed(TREE.model)
    assert order.tolist() == [7, 0, 6, 4, 5, 1, 2, 3]
    model, state = reorder_bodies(TREE.model, TREE.state, order)
    assert np.all(model.body[:, 0] < np.arange(8))
    back, again = reorder_bodies(model, state, np.argsort(order))
    assert back.kind == TREE.model.kind and np.array_equal(back.body, TREE.model.body)
    assert np.array_equal(again.r, TREE.state.r)


def test_a_rotated_tree_is_rotated_as_a_whole():
    model, state = rotate_world(TREE.model, TREE.state, Q)
    turn = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
    np.testing.assert_allclose(state.r, TREE.state.r @ turn.T, atol=1e-15)
    np.testing.assert_allclose(state.v, TREE.state.v @ turn.T, atol=1e-14)
    np.testing.assert_array_equal(model.point[1:7], TREE.model.point[1:7])


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


@pytest.mark.parametrize(
    ("engine", "relation"), [(WorldUpOnly, "rotated world"), (FirstSiblingHeavier, "siblings permuted")]
)
def test_planted_defects_break_a_relation(engine, relation):
    found = ratios(engine(), TREE.model, [TREE.state])
    assert found[relation] > 10
    assert found["masses doubled"] <= 1


def test_runs_of_trees_return_when_time_is_reversed():
    model = replace(TREE.model, drag_force=np.zeros(8), drag_moment=np.zeros(8))
    results = list(check_run_relations(Reference(), model, TREE.state))
    assert [r.integrator for r in results] == ["collocation"]
    assert results[0].ratio <= 1
