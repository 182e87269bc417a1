"""Whatever an engine returns on a scenario of the catalogue, the diagnosis is a sentence, never an error."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from plumbline.diagnosis.diagnose import explain_disagreement
from plumbline.diagnosis.integrator_search import explain_disagreeing_steps
from plumbline.engines.registry import load_adapter
from plumbline.judging.rows import Verdict
from plumbline.judging.state_level import STATE_UNITS
from plumbline.judging.step_level import judge_steps
from plumbline.truth import step_formulas
from plumbline.truth.ground_truth import state_truth
from tests.helpers.catalogue import catalogue_scenario, catalogue_scenarios, states_of
from tests.judging.test_step_level import CONTEXT, methods, stepped

STATES = 3  # besides the initial one
MAX_BODIES = 10  # longer chains take minutes
SUBJECTS = sorted(name for name, s in catalogue_scenarios().items() if s.model.n <= MAX_BODIES)


@cache
def right(name):
    scenario = catalogue_scenario(name)
    states = states_of(scenario, STATES)
    return scenario.model, state_truth(scenario.model, states)


def noisy(truth, quantity, ratio, places):
    """The truth with random errors of one quantity at some states."""
    rng, found = np.random.default_rng(7), list(truth.quantities)
    for i in places:
        value = np.asarray(getattr(found[i], quantity))
        bound = np.asarray(truth.bounds[i].tolerance(quantity))
        size = ratio * np.maximum(bound.reshape(bound.shape + (1,) * (value.ndim - bound.ndim)), 1e-15)
        wrong = value + size * rng.normal(size=value.shape)
        found[i] = replace(found[i], **{quantity: wrong if value.ndim else float(wrong)})
    return found


@pytest.mark.timeout(1800)  # a minute of CPU time on the largest loops
@pytest.mark.parametrize("quantity", STATE_UNITS)
@pytest.mark.parametrize("name", SUBJECTS)
def test_random_errors_of_states_are_diagnosed_without_an_exception(name, quantity):
    """Large errors at every state, and small ones at the last state alone."""
    model, truth = right(name)
    if getattr(truth.quantities[0], quantity) is None:
        return  # chains have no moments of joints
    last = len(truth.states) - 1
    for ratio, places in ((1e7, range(last + 1)), (30.0, [last])):
        reported = noisy(truth, quantity, ratio, places)
        text = explain_disagreement("reference", model, reported, truth, False).text
        assert text and "nan" not in text, text
        assert f"{quantity.replace('_', ' ')} are right" not in text


@pytest.mark.filterwarnings("error")
def test_rows_that_hold_a_body_without_inertia_are_no_division_by_zero():
    """One cause that is tried leaves out the joint that keeps the point mass from turning."""
    test_random_errors_of_states_are_diagnosed_without_an_exception("point-mass-arm", "acceleration")


def steppers():
    """Scenarios whose steps are compared, with the engines that have formulas for them."""
    for name, scenario in catalogue_scenarios().items():
        for engine in ("mujoco", "pinocchio", "exudyn"):
            if scenario.model.n <= MAX_BODIES:
                yield pytest.param(name, engine, id=f"{name}-{engine}")


@pytest.mark.skipif(not step_formulas.HAS_EXTENDED_PRECISION, reason="no extended precision on this machine")
@pytest.mark.parametrize(("name", "engine"), list(steppers()))
def test_random_errors_of_steps_are_diagnosed_without_an_exception(name, engine):
    pytest.importorskip(engine)
    scenario = catalogue_scenario(name)
    model, adapter = scenario.model, load_adapter(engine)
    states = states_of(scenario, 1)
    integrator = methods(engine)[0]
    answer = stepped(adapter, integrator, model, states)
    runs = [one.run.trajectory for one in answer.attempts if one.run is not None]
    rng = np.random.default_rng(5)
    for run in runs:
        for x in (run.r, run.p, run.v, run.pdot):
            x[1:] += 1e-6 * rng.normal(size=x[1:].shape)
    rows = judge_steps(CONTEXT, integrator, model, states, answer).rows
    if any(row.verdict == Verdict.DISAGREES for row in rows):
        text = explain_disagreeing_steps(engine, integrator.name, model, states, answer, False).text
        assert text and "nan" not in text, text
    else:  # steps that have no formula say why
        assert not runs or all("not compared" in row.reason for row in rows), rows
