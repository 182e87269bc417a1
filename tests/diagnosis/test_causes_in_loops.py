"""Defects in mechanisms with loops: reported, and named."""

from functools import cache

import pytest

from plumbline.diagnosis.joint_diagnosis import diagnose_joints
from plumbline.engines.engine_calls import Evaluation
from plumbline.judging.rows import RowContext
from plumbline.judging.state_level import judge_states
from plumbline.model.sampling import compared_states
from plumbline.scenario.loader import load_scenarios
from plumbline.truth.ground_truth import state_truth
from tests.helpers.nightly_tests import slow, some_fast
from tests.helpers.planted_loops import LOOP_DEFECTS


@cache
def right(name):
    scenario = load_scenarios([name])[0]
    states = compared_states(scenario.model, scenario.state, scenario.seed, 4)
    return scenario.model, state_truth(scenario.model, states)


@cache
def report(defect):
    """Quantities that disagree, and the engine's answers."""
    model, truth = right(defect.scenario)
    found = [defect.answer(model, state) for state in truth.states]
    context = RowContext("planted", "planted", defect.name, defect.name, "0")
    rows = judge_states(context, truth, Evaluation(found, None, None, 0.0)).rows
    return [row.quantity for row in rows if row.verdict == "disagrees"], found


@pytest.mark.parametrize("defect", some_fast(LOOP_DEFECTS, 6))
def test_every_defect_is_reported(defect):
    assert report(defect)[0], f"nothing reports {defect.name}"


@pytest.mark.parametrize("defect", some_fast([d for d in LOOP_DEFECTS if d.expected], 14))
def test_every_defect_with_words_is_named(defect):
    model, truth = right(defect.scenario)
    text = diagnose_joints(model, report(defect)[1], truth)
    assert defect.expected in text and "cannot distinguish" not in text, text


@slow
@pytest.mark.parametrize("defect", [d for d in LOOP_DEFECTS if not d.expected], ids=lambda d: d.name)
def test_what_has_no_words_gets_no_wrong_name(defect):
    model, truth = right(defect.scenario)
    assert "behaves as if" not in diagnose_joints(model, report(defect)[1], truth)
