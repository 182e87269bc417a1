"""Every engine on trees: each kind of joint alone, and all kinds mixed, against the certified truth."""

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import KINDS, Unsupported
from plumbline.model.sampling import random_states
from plumbline.truth.certified import certify_state
from plumbline.truth.rounding_bound import MAX_RELATIVE_BOUND, state_rounding_bound
from tests.helpers.random_trees import random_tree

ENGINES = ["reference", "mujoco", "pinocchio", "pinocchio-aba", "pinocchio-maximal", "exudyn", "exudyn-tree"]
MIXES = {**{kind: (kind,) for kind in KINDS}, "all": tuple(KINDS)}


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


@pytest.mark.parametrize("engine", ["reference-printed"])
def test_an_engine_that_builds_no_trees_says_so(engine):
    model = random_tree(np.random.default_rng(0), 3, ("hinge",))
    with pytest.raises(Unsupported, match="chains of rods and balls"):
        load_adapter(engine).evaluate(model, random_states(model, 1, 0))


def test_motions_of_trees_are_refused():
    model = random_tree(np.random.default_rng(0), 3, ("hinge",))
    (state,) = random_states(model, 1, 0)
    with pytest.raises(Unsupported, match="chains of rods and balls"):
        load_adapter("mujoco").simulate(model, state, np.array([0.0, 0.25]), "RK4", 0.125)
