"""Real runs of correct engines with one wrong number: does a level report it?

The engine is the real one; between the harness and the adapter one parameter of the model, or of the initial
state, is changed. The truth and all bounds are those of the unchanged scenario.
"""

from __future__ import annotations

from functools import cache
from unittest.mock import patch

import numpy as np

from plumbline.engines.engine_calls import Evaluation
from plumbline.judging.rows import Level, Row, RowContext
from plumbline.judging.smallest_detectable_mistake import CoverageEntry, scenario_coverage
from plumbline.judging.state_level import judge_states
from plumbline.judging.step_level import judge_steps
from plumbline.judging.trajectory_level import judge_trajectory
from plumbline.measurements.order_and_limit import refinement_resolutions
from plumbline.measurements.refinement_study import run_refinement_study
from plumbline.measurements.single_steps import STEP_STATES, run_step_study
from plumbline.model.datatypes import Model, State
from plumbline.truth.closed_form import closed_form_motion
from plumbline.truth.ground_truth import MotionTruth, StateTruth, motion_truth, state_truth
from plumbline.truth.parameters import STATE_KINDS, Parameter, list_parameters, perturb
from tests.helpers.catalogue import catalogue_scenario, states_of
from tests.helpers.planting import Defect, Inputs, plant

STATES = 50
STATE_ENGINE, STEP_ENGINE, STEP_INTEGRATOR = "reference", "pinocchio", "rkmk4"
MOTION_ENGINE, MOTION_INTEGRATOR = "reference", "collocation"


@cache
def states(name: str) -> list[State]:
    """The states at which it is compared."""
    s = catalogue_scenario(name)
    return states_of(s, STATES)


@cache
def true_states(name: str) -> StateTruth:
    """The certified truth at those states."""
    return state_truth(catalogue_scenario(name).model, states(name))


@cache
def true_motion(name: str) -> MotionTruth:
    """The true motion, as a run computes it."""
    s = catalogue_scenario(name)
    closed = closed_form_motion(s)
    exact = (*closed(s.times), closed.source) if closed and closed.amplitude == 0 else None
    return motion_truth(s.model, s.state, s.times, exact)


def judged_rows(name: str, level: Level, change: Inputs) -> list[Row]:
    """The rows of one level of a scenario, of the level's engine with a change."""
    s, context = catalogue_scenario(name), RowContext(name, "", MOTION_ENGINE, MOTION_ENGINE, "0")
    if level == "state":
        answers = plant(Defect("", engine=STATE_ENGINE, inputs=change)).evaluate(s.model, states(name))
        return judge_states(context, true_states(name), Evaluation(answers)).rows
    engine = STEP_ENGINE if level == "step" else MOTION_ENGINE
    adapter = plant(Defect("", engine=engine, inputs=change))
    with patch("plumbline.engines.engine_calls.load_adapter", lambda _: adapter):
        if level == "step":
            integrator, some = adapter.integrator(STEP_INTEGRATOR), states(name)[:STEP_STATES]
            answer = run_step_study(STEP_ENGINE, integrator, s.model, some)
            rows = judge_steps(context, integrator, s.model, some, answer).rows
            return [row for row in rows if row.quantity != "run_mean"]  # which the table does not count
        integrator = adapter.integrator(MOTION_INTEGRATOR)
        steps = refinement_resolutions(integrator, s.model.n, s.duration, 0, s.sample_interval)
        study = run_refinement_study(MOTION_ENGINE, MOTION_INTEGRATOR, s.model, s.state, s.times, steps)
    return judge_trajectory(context, s.model, true_motion(name), integrator, study).rows


@cache
def coverage(name: str, level: Level) -> tuple[CoverageEntry, ...]:
    """The coverage table of one level, by the tolerances of the level's engine."""
    s = catalogue_scenario(name)
    rows = judged_rows(name, level, lambda m, x: (m, x)) if level in ("trajectory", "invariants") else []
    return tuple(scenario_coverage(name, s.model, s.state, s.times, states(name), rows, (level,)))


def is_reported(entry: CoverageEntry, factor: float) -> bool:
    """Whether a mistake of so many times the table's smallest one is reported at the entry's level."""
    s = catalogue_scenario(entry.scenario)
    parameter = next(
        one
        for one in list_parameters(s.model, s.state)
        if (one.body + 1, one.name) == (entry.body, entry.parameter)
    )
    assert entry.smallest is not None
    rows = judged_rows(entry.scenario, entry.level, change_of(parameter, s.state, factor * entry.smallest))
    return any(row.level == entry.level and row.verdict.needs_attention for row in rows)


def change_of(parameter: Parameter, initial: State, size: float) -> Inputs:
    """A mistake in the model, or in the initial state alone."""

    def change(model: Model, state: State) -> tuple[Model, State]:
        is_initial = np.array_equal(state.p, initial.p) and np.array_equal(state.omega, initial.omega)
        if parameter.kind in STATE_KINDS and not is_initial:
            return model, state
        return perturb(model, state, parameter, size)

    return change
