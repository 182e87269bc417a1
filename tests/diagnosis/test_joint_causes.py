"""Defects of joints and passive elements: every one is reported, and named by its own number."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from plumbline.diagnosis.joint_diagnosis import diagnose_joints
from plumbline.engines.engine_calls import Evaluation
from plumbline.engines.registry import load_adapter
from plumbline.judging.rows import RowContext
from plumbline.judging.state_level import judge_states
from plumbline.model.kinematics import complete_state, rotation_matrix
from plumbline.model.sampling import random_states
from plumbline.scenario.loader import catalogue, load_scenario
from plumbline.truth.ground_truth import state_truth
from tests.helpers.nightly_tests import some_fast
from tests.helpers.planted_elements import ELEMENT_DEFECTS, ElementDefect, subject
from tests.helpers.shared_answers import sharing


@pytest.fixture(scope="module", autouse=True)
def shared_predictions():
    """The effects of most causes are the same for every defect."""
    with sharing("plumbline.diagnosis.joint_diagnosis", "_predict"):
        yield


@cache
def right():
    model = subject()
    return model, state_truth(model, random_states(model, 5, seed=2))


@cache
def report(defect):
    """Quantities that disagree, and the diagnosis."""
    model, truth = right()
    wrong = defect.change(model) if defect.change else model
    states = [complete_state(wrong, state) for state in truth.states]
    found = load_adapter(defect.engine).evaluate(wrong, states)
    if defect.answer:
        found = [defect.answer(model, s, a) for s, a in zip(truth.states, found, strict=True)]
    context = RowContext("planted", "planted", defect.name, defect.name, "0")
    rows = judge_states(context, truth, Evaluation(found, None, None, 0.0)).rows
    return [row.quantity for row in rows if row.verdict == "disagrees"], found


@pytest.mark.parametrize("defect", ELEMENT_DEFECTS, ids=[d.name for d in ELEMENT_DEFECTS])
def test_every_defect_is_reported(defect):
    assert report(defect)[0], f"nothing reports {defect.name}"


@pytest.mark.parametrize("defect", some_fast([d for d in ELEMENT_DEFECTS if d.expected], 8))
def test_every_defect_is_named(defect):
    text = diagnose_joints(*right()[:1], report(defect)[1], right()[1])
    assert defect.expected in text and "cannot distinguish" not in text, f"{defect.name}: {text}"


@pytest.mark.parametrize("engine", ["reference", "mujoco", "pinocchio", "pinocchio-aba"])
def test_the_engines_without_defect_are_not_reported(engine):
    assert report(ElementDefect("clean", engine=engine))[0] == []


def test_there_are_forty_and_nine_of_ten_are_named():
    assert len(ELEMENT_DEFECTS) >= 40 and len({d.name for d in ELEMENT_DEFECTS}) == len(ELEMENT_DEFECTS)
    assert sum(bool(d.expected) for d in ELEMENT_DEFECTS) >= 0.9 * len(ELEMENT_DEFECTS)


def test_a_misread_velocity_that_only_energies_show_is_named_without_gravity():
    scenario = load_scenario(catalogue()["free-body-with-rotors"])
    model, states = scenario.model, random_states(scenario.model, 3, seed=2)
    truth = state_truth(model, states)
    assert not np.any(model.gravity) and truth.bounds[0].tolerance("potential_energy") == 0
    turned = [replace(s, v=np.matvec(rotation_matrix(s.p), s.v)) for s in truth.states]
    found = load_adapter("pinocchio").evaluate(model, turned)
    assert "the velocity of body 1 were given in the body frame" in diagnose_joints(model, found, truth)
