"""A scenario's cells: what waits for the truth, and what a lost truth costs."""

import os
from dataclasses import replace

import pytest

from plumbline.execution.plan import Plan, TaskKind, plainest
from plumbline.execution.runner import describe_engines
from plumbline.execution.scenario_verdicts import ScenarioRun
from plumbline.processes.worker_pool import Limits, Outcome, WorkerPool, run_task
from plumbline.scenario import loader
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.runs import run_scenarios
from tests.helpers.shared_answers import by_content

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def engines():
    with WorkerPool(1) as workers:
        return describe_engines(workers, ["reference", "mujoco"])


@pytest.fixture
def mujoco(engines):
    return {"mujoco": engines["mujoco"]}


outcome_of = by_content(run_task)  # many tests begin with the same truth and the same answers


def make_scenario_run(engines, level, name="rest", states=2, **more):
    chosen = catalogue_scenario(name)
    plan = Plan([chosen], list(engines), level, random_state_count=states)
    return ScenarioRun(plan, chosen, engines, **more)


def begun(engines, level="state"):
    """A run of a scenario at one level, and the tasks that follow its truth."""
    bench = make_scenario_run(engines, level)
    (truth,) = bench.tasks()
    return bench, bench.on_outcome(outcome_of(truth))


def finished_rows(bench, tasks):
    """All rows, once the tasks are done."""
    for task in tasks:
        bench.on_outcome(outcome_of(task))
    assert bench.is_done
    return bench.findings().rows


def truth_of(bench, kind):
    """The task of the truth of a kind."""
    return next(x for x in bench.tasks() if x.key.kind == kind)


def with_verdict(outcome, verdict, *quantities):
    """The outcome with this verdict on some quantities."""
    rows = [
        replace(row, verdict=verdict) if row.quantity in quantities else row
        for row in outcome.judge_result.rows
    ]
    return replace(outcome, judge_result=replace(outcome.judge_result, rows=rows))


def test_runs_follow_their_truth_and_may_finish_in_any_order(engines):
    rows = []
    for turned in (False, True):
        bench, tasks = begun(engines, "trajectory")
        for task in reversed(tasks) if turned else tasks:
            assert not bench.is_done
            assert bench.on_outcome(outcome_of(task)) == []
        assert bench.is_done
        rows.append([(r.key, r.value, r.verdict) for r in bench.findings().rows])
    assert rows[0] == rows[1] and len(rows[0]) > 14


def test_states_follow_their_truth_and_are_judged_by_the_worker(engines):
    bench, cells = begun(engines)
    assert [(task.key.engine, task.key.kind) for task in cells] == [
        (name, TaskKind.STATE) for name in ("reference", "mujoco")
    ]
    for task in cells:
        assert not bench.is_done
        found = outcome_of(task)
        assert sum(row.level == "state" for row in found.judge_result.rows) == 7
        bench.on_outcome(found)
    assert bench.is_done
    assert sum(row.level == "state" for row in bench.findings().rows) == 14


def raise_key_error(*_):
    raise KeyError("a mistake")


def test_a_judge_that_raises_is_a_failure_of_the_harness(engines):
    bench, cells = begun(engines)
    rows = finished_rows(bench, [replace(task, judge=raise_key_error) for task in cells])
    assert [(r.verdict, r.reason) for r in rows] == [
        ("harness failed", "the answer cannot be judged: KeyError: 'a mistake'")
    ] * 2


def test_a_lost_truth_of_states_fails_every_cell_with_the_reason(engines):
    bench = make_scenario_run(engines, "state")
    (truth,) = bench.tasks()
    rows = finished_rows(bench, bench.on_outcome(Outcome(truth.key, failure="crashed")))
    assert [(r.verdict, r.reason) for r in rows] == [
        ("harness failed", "rest has no truth to judge by: crashed")
    ] * 2


def test_a_motion_truth_whose_worker_died_is_computed_again_without_a_compiler(engines):
    bench = make_scenario_run(engines, "trajectory")
    (truth,) = bench.tasks()
    (second,) = bench.on_outcome(Outcome(truth.key, failure="crashed: the worker died of SIGSEGV"))
    assert second.key == truth.key and second.arguments[-1] == 0 and not bench.is_done
    rows = finished_rows(bench, bench.on_outcome(outcome_of(second)))
    assert not any(row.verdict.needs_attention for row in rows)
    assert "Taylor" not in bench.truths[TaskKind.MOTION_TRUTH].method.split("closed form")[0]


def test_a_truth_that_is_lost_twice_fails_every_cell_with_the_reason(engines):
    bench = make_scenario_run(engines, "trajectory")
    (truth,) = bench.tasks()
    bench.on_outcome(Outcome(truth.key, failure="crashed"))
    cells = bench.on_outcome(Outcome(truth.key, failure="crashed twice"))
    rows = finished_rows(bench, cells)
    assert len(rows) == len(cells)
    reason = "rest has no truth to judge by: crashed twice"
    assert all(r.verdict == "harness failed" and r.reason == reason for r in rows)


def exit_process(*_):
    """Ends its process as a crash does."""
    os._exit(11)


def test_in_a_run_the_second_truth_is_handed_over(monkeypatch):
    truth, requested = ScenarioRun.truth_task, []

    def first_crashes(self, key, *uncompiled):
        requested.append(truth(self, key, *uncompiled))
        return requested[-1] if uncompiled else replace(requested[-1], function=exit_process)

    monkeypatch.setattr(ScenarioRun, "truth_task", first_crashes)
    result = run_scenarios(["rest"], ["mujoco"], "trajectory", limits=Limits(120))
    assert len(requested) == 2
    assert result.metadata["exit_code"] == 0, result.metadata["sentence"]


class Recorded:
    """Known issues about some quantities."""

    def __init__(self, *quantities):
        self.quantities = quantities

    def mark_known(self, rows, bodies, inertia_ratio, joints):
        return [replace(row, known_issue="id") if row.quantity in self.quantities else row for row in rows]


@pytest.mark.parametrize(
    ("quantities", "searched"),
    [((), True), (("acceleration",), True), (("acceleration", "joint_reaction"), False)],
)
def test_of_a_cell_whose_disagreements_are_all_recorded_only_the_scatter_is_measured(
    mujoco, quantities, searched
):
    run = make_scenario_run(mujoco, "state", known=Recorded(*quantities))
    (truth,) = run.tasks()
    (cell,) = run.on_outcome(outcome_of(truth))
    found = outcome_of(replace(cell, needs_answer=None))
    (diagnosis,) = run.on_outcome(with_verdict(found, "disagrees", "acceleration", "joint_reaction"))
    *_, is_known = diagnosis.arguments
    assert diagnosis.key.kind == TaskKind.DIAGNOSIS and is_known is not searched


def steps_of(bench, engine, integrator):
    """The task of the steps of one integrator."""
    (task,) = [
        x
        for x in bench.tasks()
        if (x.key.kind, x.key.engine, x.key.integrator) == (TaskKind.STEP, engine, integrator)
    ]
    return task


@pytest.mark.parametrize("are_states_first", [True, False])
@pytest.mark.parametrize(
    ("quantity", "recorded", "searched"),
    [
        ("acceleration", (), ["state"]),
        ("joint_reaction", (), ["state", "step"]),
        ("acceleration", ("acceleration",), ["state", "step"]),
    ],
)
def test_steps_are_not_searched_where_the_accelerations_they_are_made_of_disagree(
    mujoco, quantity, recorded, searched, are_states_first
):
    bench = make_scenario_run(mujoco, "all", "tumbling-ball", 1, known=Recorded(*recorded))
    steps = steps_of(bench, "mujoco", "Euler")
    (states,) = bench.on_outcome(outcome_of(truth_of(bench, TaskKind.STATE_TRUTH)))
    wrong = [
        with_verdict(outcome_of(replace(task, needs_answer=None)), "disagrees", wanted)
        for task, wanted in ((states, quantity), (steps, "run_rate"))
    ]
    following = [
        x for one in (wrong if are_states_first else wrong[::-1]) for x in bench.on_outcome(one)
        if x.key.kind == TaskKind.DIAGNOSIS
    ]  # fmt: skip
    assert ["step" if x.key.integrator else "state" for x in following] == searched


def run_with_studies(engines, name, has_all_studies=False):
    chosen = catalogue_scenario(name)
    plan = Plan([chosen], ["mujoco"], random_state_count=1, has_all_studies=has_all_studies)
    return ScenarioRun(plan, chosen, engines)


@pytest.mark.parametrize("is_truth_first", [True, False])
def test_a_study_of_low_order_is_left_to_the_night_where_steps_decide(mujoco, is_truth_first):
    bench = run_with_studies(mujoco, "double-tumbling-rods")
    truth = truth_of(bench, TaskKind.MOTION_TRUTH)
    euler, rk4 = (outcome_of(steps_of(bench, "mujoco", name)) for name in ("Euler", "RK4"))
    studies = []
    for outcome in (outcome_of(truth), euler, rk4) if is_truth_first else (euler, rk4, outcome_of(truth)):
        studies += [x.key.integrator for x in bench.on_outcome(outcome) if x.key.kind == TaskKind.TRAJECTORY]
    assert studies == ["RK4"] and bench.left_to_the_night == 1
    (row,) = [r for r in bench.findings().rows if (r.level, r.integrator) == ("trajectory", "Euler")]
    assert row.verdict == "information" and "the study of RK4 runs" in row.reason
    assert "of this family all run on double-loaded-rods" in row.reason


def test_a_study_of_low_order_runs_where_steps_do_not_decide(mujoco):
    bench = run_with_studies(mujoco, "double-tumbling-rods")
    bench.on_outcome(outcome_of(truth_of(bench, TaskKind.MOTION_TRUTH)))
    lost = Outcome(steps_of(bench, "mujoco", "Euler").key, failure="crashed")
    assert [x.key for x in bench.on_outcome(lost)] == [replace(lost.key, kind=TaskKind.TRAJECTORY)]
    assert bench.left_to_the_night == 0


def test_every_study_runs_at_night_and_on_the_plainest_scenario(mujoco):
    for has_all_studies, name in ((True, "double-tumbling-rods"), (False, "double-loaded-rods")):
        bench = run_with_studies(mujoco, name, has_all_studies)
        truth = outcome_of(truth_of(bench, TaskKind.MOTION_TRUTH))
        following = [x.key.integrator for x in bench.on_outcome(truth)]
        assert following == ["Euler", "implicit", "implicitfast", "RK4"]


def test_of_each_family_the_plainest_scenario_is_studied_and_of_others_the_plainest_of_the_run(tmp_path):
    every = loader.load_scenarios(list(loader.catalogue()))
    assert plainest(every) == loader.FAMILIES
    names = ["double-tumbling-rods", "double-loaded-balls"]
    own = [replace(s, path=tmp_path / s.path.name) for s in loader.load_scenarios(names)]
    plan = Plan([*own, every[0]], ["mujoco"])
    assert [plan.studied(s) for s in own] == ["double-loaded-balls"] * 2
    assert plan.studied(every[0]) == loader.FAMILIES[every[0].family]


@pytest.mark.parametrize(
    ("name", "left"), [("double-tumbling-rods", 1), ("double-hinge-skew", 1), ("spring-pendulum", 0)]
)
def test_of_methods_of_one_order_the_first_ones_study_runs(name, left):
    """Of trees the equations of Exudyn's steps are compared, with springs they are not."""
    with WorkerPool(1) as workers:
        bench = run_with_studies(describe_engines(workers, ["exudyn"]), name)
    truth = outcome_of(truth_of(bench, TaskKind.MOTION_TRUTH))
    assert [x.key.integrator for x in bench.on_outcome(truth)] == ["trapezoidal"]
    bench.on_outcome(outcome_of(steps_of(bench, "exudyn", "generalized-alpha")))
    assert bench.left_to_the_night == left


@pytest.mark.parametrize(("of_steps", "expected"), [("agrees", "information"), ("disagrees", "unresolved")])
def test_what_a_study_leaves_open_is_information_where_every_step_agrees(mujoco, of_steps, expected):
    bench = make_scenario_run(mujoco, "all", "tumbling-ball", 1)
    studies = bench.on_outcome(outcome_of(truth_of(bench, TaskKind.MOTION_TRUTH)))
    study = next(x for x in studies if (x.key.engine, x.key.integrator) == ("mujoco", "RK4"))
    for task, quantity, verdict in (
        (study, "position_limit", "unresolved"), (steps_of(bench, "mujoco", "RK4"), "run_rate", of_steps),
    ):  # fmt: skip
        bench.on_outcome(with_verdict(outcome_of(task), verdict, quantity))
    (row,) = [r for r in bench.findings().rows if (r.integrator, r.quantity) == ("RK4", "position_limit")]
    assert row.verdict == expected


def test_a_worker_that_ends_in_what_is_asked_besides_costs_that_only(engines):
    bench, (of_reference, of_mujoco) = begun(engines)
    assert bench.on_outcome(Outcome(of_reference.key, failure="crashed")) == []  # nothing is asked besides
    (again,) = bench.on_outcome(Outcome(of_mujoco.key, failure="crashed"))
    (at_last,) = bench.on_outcome(Outcome(of_mujoco.key, failure="crashed again"))
    assert [task.arguments[-1] for task in (of_mujoco, again, at_last)] == [
        ("surface", "variants"), ("surface", "variants", "apart"), (),
    ]  # fmt: skip
    assert not bench.is_done
    assert bench.on_outcome(outcome_of(at_last)) == [] and bench.is_done
    rows = [row for row in bench.findings().rows if row.engine == "mujoco"]
    assert {(r.quantity, r.verdict, r.reason) for r in rows if r.level == "surface"} == {
        ("all", "failed", "crashed again"), ("all_variants", "failed", "crashed again"),
    }  # fmt: skip
    assert sum(row.level == "state" and row.verdict == "agrees" for row in rows) == 7


def test_an_engine_that_hangs_is_asked_for_the_states_alone_at_once(engines):
    bench, (_, of_mujoco) = begun(engines)
    (at_last,) = bench.on_outcome(Outcome(of_mujoco.key, failure="hung", is_overdue=True))
    assert at_last.arguments[-1] == ()
    bench.on_outcome(Outcome(of_mujoco.key, failure="hung", is_overdue=True))
    (row,) = (row for row in bench.findings().rows if row.engine == "mujoco")
    assert (row.level, row.quantity, row.verdict, row.reason) == ("state", "all", "failed", "hung")
