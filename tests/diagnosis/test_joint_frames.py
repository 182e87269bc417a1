"""Defects of axes, frames and points of joints in the catalogue's trees: reported, and named."""

from functools import cache

import pytest

from plumbline.diagnosis.joint_diagnosis import diagnose_joints
from plumbline.engines.engine_calls import Evaluation
from plumbline.engines.registry import load_adapter
from plumbline.judging.rows import RowContext
from plumbline.judging.state_level import judge_states
from plumbline.model.sampling import random_states
from plumbline.scenario.loader import load_scenarios
from plumbline.truth.ground_truth import state_truth
from tests.helpers.nightly_tests import some_fast
from tests.helpers.planted_axes import JOINT_DEFECTS


@cache
def right(name):
    model = load_scenarios([name])[0].model
    return model, state_truth(model, random_states(model, 4, seed=3))


@cache
def report(defect):
    """Quantities that disagree, and the engine's answers."""
    model, truth = right(defect.scenario)
    engine = load_adapter(defect.engine)
    seen = [defect.see(model, state) for state in truth.states]
    found = [defect.answered(engine.evaluate(m, [state])[0]) for m, state in seen]
    context = RowContext("planted", "planted", defect.name, defect.name, "0")
    rows = judge_states(context, truth, Evaluation(found, None, None, 0.0)).rows
    return [row.quantity for row in rows if row.verdict == "disagrees"], found


@pytest.mark.parametrize("defect", some_fast(JOINT_DEFECTS, 6))
def test_every_defect_is_reported(defect):
    assert report(defect)[0], f"nothing reports {defect.name}"


@pytest.mark.parametrize("defect", some_fast(JOINT_DEFECTS, 12))
def test_every_defect_is_named(defect):
    model, truth = right(defect.scenario)
    text = diagnose_joints(model, report(defect)[1], truth)
    assert defect.expected in text, f"{defect.name}: {text}"
    equal = text.split("the data cannot distinguish")[1:]
    assert bool(equal) == bool(defect.others) and all(name in text for name in defect.others), text
