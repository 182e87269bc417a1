"""Rare branches: what a run and a night compare suffices to report each planted one.

A state is evaluated only where the defect alters what the engine is given, as elsewhere it cannot show.
"""

import itertools
from functools import cache

import numpy as np
import pytest

from plumbline.engines.engine_calls import Evaluation
from plumbline.engines.registry import load_adapter
from plumbline.execution.plan import STATES_PER_RANDOM_SCENARIO
from plumbline.judging.rows import RowContext
from plumbline.judging.state_level import judge_states
from plumbline.measurements.single_steps import STEP_STATES
from plumbline.model.datatypes import Unsupported
from plumbline.model.sampling import RANDOM_STATES
from plumbline.scenario.generator import RandomScenarios
from plumbline.truth import step_formulas
from plumbline.truth.ground_truth import state_truth
from tests.helpers.catalogue import catalogue_scenarios, states_of
from tests.helpers.nightly_tests import some_fast
from tests.helpers.planted_branches import BRANCH_DEFECTS, BRANCH_STEPS
from tests.helpers.planting import plant, planted
from tests.helpers.requirements import require_engines
from tests.helpers.shared_answers import sharing
from tests.judging.test_step_level import judged

require_engines()

CONTEXT = RowContext("branches", "test", "engine", "engine", "0")
RANDOM_COUNT = 200  # of a night
SEED = 404
MAX_BODIES = 10
MAX_EVALUATED = 3  # states of a scenario


@pytest.fixture(scope="module", autouse=True)
def shared_truths():
    """Certified truths are the same for every defect."""
    with sharing(__name__, "state_truth"):
        yield


@cache
def catalogue_chains():
    return [s for s in catalogue_scenarios().values() if s.model.has_chain_joints and s.model.n <= MAX_BODIES]


@cache
def problem(index):
    """A chain of the catalogue or of a night, for which the defects are made, and its compared states."""
    chains = catalogue_chains()
    if index < len(chains):
        s, count = chains[index], RANDOM_STATES
    else:
        s, count = RandomScenarios(SEED, RANDOM_COUNT)[index - len(chains)], STATES_PER_RANDOM_SCENARIO
    return s, states_of(s, count)


def problems():
    """All of them, made as they are needed: most defects show early."""
    return map(problem, range(len(catalogue_chains()) + RANDOM_COUNT))


def is_altered(defect, model, state):
    other, at = defect.inputs(model, state)
    fields = [(getattr(at, k), getattr(state, k)) for k in ("p", "omega", "u", "udot")]
    fields += [(getattr(other, k), value) for k, value in model.fields.items()]
    return not all(np.array_equal(a, b) for a, b in fields)


def is_reported(defect, model, state):
    truth = state_truth(model, [state])
    try:
        answers = plant(defect).evaluate(model, [state])
    except Unsupported:  # the engine is not compared on this scenario
        return False
    rows = judge_states(CONTEXT, truth, Evaluation(answers)).rows
    return any(row.verdict == "disagrees" for row in rows)


@pytest.mark.parametrize("defect", some_fast(BRANCH_DEFECTS, 3))
def test_a_defect_in_a_rare_branch_is_reported(defect):
    reported = (
        is_reported(defect, s.model, state)
        for s, states in problems()
        for state in itertools.islice(
            (state for state in states if is_altered(defect, s.model, state)), MAX_EVALUATED
        )
    )
    assert any(reported), f"no scenario reports {defect.name}"


@pytest.mark.skipif(not step_formulas.HAS_EXTENDED_PRECISION, reason="no extended precision on this machine")
@pytest.mark.parametrize("defect", BRANCH_STEPS, ids=[d.name for d in BRANCH_STEPS])
def test_a_step_in_a_rare_branch_is_reported(defect):
    integrator = load_adapter(defect.engine).integrator(defect.integrator)
    with planted(defect) as adapter:
        assert any(
            row.verdict == "disagrees"
            for s, states in problems()
            for row in judged(adapter, integrator, s.model, states[:STEP_STATES])
        ), f"no scenario reports {defect.name}"
