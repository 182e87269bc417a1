"""When a refinement study stops: never before order and limits are resolved, and without the truth."""

import ast
import inspect
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plumbline.engines.engine_calls import RefinementRun, RefinementStudy, run_refinement
from plumbline.engines.no_answer import NoAnswer
from plumbline.engines.registry import load_adapter
from plumbline.judging.trajectory_level import judge_trajectory
from plumbline.measurements import refinement_study
from plumbline.measurements.order_and_limit import observed_order, refinement_resolutions
from plumbline.measurements.refinement_study import (
    MIN_RUNS,
    STOP_MARGIN,
    is_resolved,
    run_refinement_study,
    scaled_states,
)
from plumbline.model.datatypes import Integrator
from plumbline.model.kinematics import complete_state
from plumbline.truth.ground_truth import RUN_ROUNDING, motion_truth
from tests.helpers.catalogue import catalogue_scenario
from tests.judging.test_trajectory_verdicts import (
    METHOD,
    MODEL,
    STEPS,
    UNCERTAINTY,
    WHO,
    judged_rows,
    make_truth,
    of_each,
    trajectory_with_error,
)
from tests.judging.test_trajectory_verdicts import (
    refinement_study as study_with_errors,
)

H = np.array(STEPS)
SHARP = {"uncertainty": of_each(dict.fromkeys(UNCERTAINTY, 0.0)), "growth": np.ones(17)}


def stops_after(study, method=METHOD, model=MODEL):
    """The number of runs after which the rule ends a study; None where it runs to the end."""
    for number in range(1, len(study.runs) + 1):
        if is_resolved(model, method, study.runs[:number]):
            return number
    return None


def test_a_study_with_a_known_expansion_stops_as_soon_as_its_order_is_seen_twice():
    assert stops_after(study_with_errors(1e-3 * H**2)) == MIN_RUNS


def test_a_study_whose_differences_are_rounding_stops():
    assert stops_after(study_with_errors(0 * H)) == MIN_RUNS


@pytest.mark.parametrize(
    "errors",
    [
        1e-3 * H,  # another order than declared
        1e-3 * H**3,
        1e-3 * H**2 + 1e-9 * H**0.5,  # a part that no power of the expansion removes
        1e-3 * H**2 + 1e-12 * (-1.0) ** np.arange(6),  # noise above rounding
        1e-3 * H**2 + 1e-3 * H**2.5,
        1e-9 * (-1.0) ** np.arange(6),  # no convergence
        np.linspace(1e-6, 2e-6, 6),
    ],
    ids=["order 1", "order 3", "slow part", "noise", "no expansion", "alternating", "growing"],
)
def test_an_unresolved_study_runs_to_its_finest_step(errors):
    assert stops_after(study_with_errors(errors)) is None


@pytest.mark.parametrize("rough", ["", "position", "attitude", "speed"])
def test_one_unresolved_part_is_enough_to_go_on(rough, monkeypatch):
    if rough != "speed":  # an error of positions or attitudes alone opens the joint
        monkeypatch.setattr(refinement_study, "INVARIANT_UNITS", {})
    study = study_with_errors(1e-3 * H**2)
    for i, (run, clean) in enumerate(zip(study.runs, 1e-3 * H**2, strict=True)):
        error = {
            part: clean + (part == rough) * 1e-11 * (-1) ** i for part in ("position", "attitude", "speed")
        }
        made = trajectory_with_error(error["position"], error["attitude"], error["speed"])
        study.runs[i] = replace(run, trajectory=made)
    assert stops_after(study) == (None if rough else MIN_RUNS)


def test_the_order_must_be_the_declared_one(monkeypatch):
    monkeypatch.setattr(refinement_study, "STOP_MARGIN", np.inf)
    monkeypatch.setattr(refinement_study, "INVARIANT_UNITS", {})
    assert stops_after(study_with_errors(1e-3 * H**2)) == MIN_RUNS
    assert stops_after(study_with_errors(1e-3 * H)) is None
    assert stops_after(study_with_errors(1e-3 * H**3)) is None


@pytest.mark.parametrize("lost", range(6))
def test_a_study_counts_from_its_last_failure_on(lost):
    study = study_with_errors(1e-3 * H**2)
    study.runs[lost] = replace(study.runs[lost], trajectory=None, failure=NoAnswer("diverged", False))
    first = lost + 1 + MIN_RUNS if lost < MIN_RUNS else MIN_RUNS
    assert stops_after(study) == (first if first <= 6 else None)


def test_step_control_is_never_stopped():
    method = Integrator("a", "tolerance", 8, min_rtol=1e-12)
    assert stops_after(study_with_errors(0 * H), method) is None


def test_a_resolved_limit_that_is_wrong_is_reported_all_the_same():
    study = study_with_errors(1e-3 * H**2 + 1e-11)
    number = stops_after(study)
    assert number is not None and number < len(STEPS)
    rows = judged_rows(RefinementStudy(study.runs[:number]), **SHARP)
    assert {rows["position_limit"].verdict, rows["attitude_limit"].verdict} == {"disagrees"}


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(-1, 1)] * 3),
    st.floats(-8, -2).map(lambda x: 10.0**x),
    st.floats(-18, -13).map(lambda x: 10.0**x),
    st.integers(0, 99),
)
def test_no_finer_step_lowers_a_bound_by_more_than_the_margin(coefficients, size, noise, seed):
    expansion = sum(c * H**power for c, power in zip(coefficients, (2, 3, 4), strict=True))
    study = study_with_errors(size * expansion + noise * np.random.default_rng(seed).normal(size=6))
    number = stops_after(study)
    if number is None:
        return
    stopped, *finer = (
        judged_rows(RefinementStudy(study.runs[:n]), **SHARP) for n in range(number, len(STEPS) + 1)
    )
    for quantity in ("position_limit", "attitude_limit"):
        for rows in finer:
            assert stopped[quantity].tolerance <= (1 + STOP_MARGIN) * rows[quantity].tolerance * (1 + 1e-9)


@pytest.mark.parametrize("engine", ["mujoco", "pinocchio"])
def test_a_stopped_study_has_the_first_runs_of_the_whole_one_and_its_verdicts(engine):
    scenario = catalogue_scenario("planar-small")
    method = {"mujoco": "RK4", "pinocchio": "rkmk4"}[engine]
    s, integrator = scenario, Integrator(method, "step", 4, (4, 5, 6, 7, 8))
    steps = refinement_resolutions(integrator, s.model.n, s.duration)
    arguments = engine, method, s.model, s.state, s.times, steps
    stopped, whole = run_refinement_study(*arguments), run_refinement(*arguments)
    assert MIN_RUNS <= len(stopped.runs) < len(whole.runs) == len(steps)
    for one, other in zip(stopped.runs, whole.runs, strict=False):
        for name in ("r", "p", "v", "pdot"):
            assert np.array_equal(getattr(one.trajectory, name), getattr(other.trajectory, name))
    truth = motion_truth(s.model, s.state, s.times, None)
    found, every = (judge_trajectory(WHO, s.model, truth, integrator, x).rows for x in (stopped, whole))
    assert [(row.quantity, row.verdict) for row in found] == [(row.quantity, row.verdict) for row in every]
    bounds = ({r.quantity: r.tolerance for r in rows} for rows in (found, every))
    sharp, sharpest = bounds
    for quantity in ("position_limit", "attitude_limit"):
        assert sharp[quantity] <= (1 + STOP_MARGIN) * sharpest[quantity]


def test_sampled_rates_that_are_scaled_late_are_reported():
    """By 1e-7 after 1 s: neither positions and attitudes nor the step level up to its ten steps show it."""
    s = catalogue_scenario("double-hinge-skew")
    integrator = load_adapter("mujoco").integrator("RK4")
    steps = refinement_resolutions(integrator, s.model.n, s.duration)
    study = run_refinement_study("mujoco", "RK4", s.model, s.state, s.times, steps)
    truth = motion_truth(s.model, s.state, s.times, None)
    factors = 1 + 1e-7 * (s.times > 1)[:, None, None]
    sampled = [run.trajectory for run in study.runs]
    scaled = [replace(run, v=factors * run.v, pdot=factors * run.pdot) for run in sampled]
    wrong = {}
    for name, motions in (("as sampled", sampled), ("scaled", scaled)):
        runs = [replace(run, trajectory=motion) for run, motion in zip(study.runs, motions, strict=True)]
        rows = judge_trajectory(WHO, s.model, truth, integrator, RefinementStudy(runs)).rows
        wrong[name] = {r.quantity for r in rows if r.level == "trajectory" and r.verdict == "disagrees"}
    assert wrong == {"as sampled": set(), "scaled": {"velocity_limit", "angular_velocity_limit"}}


@pytest.mark.parametrize(("drift", "is_rounding"), [(0.0, True), (1e-9, False)])
def test_runs_of_what_nothing_moves_differ_by_rounding_unless_they_move(drift, is_rounding):
    r = np.broadcast_to([0.1, 0.2, -0.3], (9, 1, 3))
    runs = scaled_states([r] * 4, [drift * k + 0 * r for k in range(4)], 0.5, 0.0)
    assert observed_order(runs, RUN_ROUNDING / 8, 4).is_at_rounding_floor is is_rounding


def test_rows_of_what_nothing_moves_have_no_ratio_of_zeros():
    s = catalogue_scenario("tumbling-ball")
    model = s.model.changed(**{name: 0 * getattr(s.model, name) for name in ("gravity", "force", "moment")})
    still = complete_state(model, replace(s.state, omega=0 * s.state.omega))
    truth = motion_truth(model, still, s.times, None)
    runs = [RefinementRun(h, replace(truth.trajectory, steps=64)) for h in (0.02, 0.01, 0.005, 0.0025)]
    integrator = load_adapter("mujoco").integrator("RK4")
    rows = judge_trajectory(WHO, model, truth, integrator, RefinementStudy(runs)).rows
    assert {row.verdict for row in rows} <= {"agrees", "information"} and len(rows) >= 8
    assert not any(np.isnan(row.ratio) for row in rows if row.ratio is not None)


def test_the_rule_cannot_see_the_truth():
    assert list(inspect.signature(is_resolved).parameters) == ["model", "integrator", "runs"]
    imported = {
        alias.name
        for node in ast.walk(ast.parse(inspect.getsource(refinement_study)))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("plumbline.truth")
        for alias in node.names
    }
    assert imported == {"RUN_ROUNDING"}, "a constant"
    assert make_truth().growth.min() >= 1, "the derivation takes G ≥ 1"
