"""The product as tests: every scenario × engine × level is a test of its own.

`pytest -k "double and mujoco"` runs those of one family and engine; the failure message is the
verdict's own sentence.  By default steps and motions run on the scenarios that `tests.helpers.fast_matrix`
selects; `-m full` runs the rest.
"""

import os

import pytest

from plumbline.engines.registry import ENGINES
from plumbline.execution.plan import Plan, TaskKind
from plumbline.execution.runner import describe_engines
from plumbline.execution.scenario_run import ScenarioRun
from plumbline.judging import known_issues
from plumbline.model.invariants import inertia_ratio
from plumbline.processes.workers import Limits, WorkerPool
from tests.helpers.catalogue import catalogue_scenarios
from tests.helpers.fast_matrix import levels, representatives


def matrix_cells():
    for name, scenario in catalogue_scenarios().items():
        for engine in ENGINES:
            for level in levels(engine, scenario):
                is_fast = level == "state" or name in representatives(level)
                label = name if scenario.family in name else f"{scenario.family}-{name}"
                marks = [] if is_fast else [pytest.mark.full]
                yield pytest.param(name, engine, level, id=f"{label}: {engine}-{level}", marks=marks)


def joints_compared(cells):
    """(engine, level, kind of joint) of the cells that an engine does not refuse."""
    models = [(engine, level, catalogue_scenarios()[name].model) for name, engine, level in cells]
    allowed = [x for x in models if x[0] != "reference-printed" or (x[2].n <= 2 and x[2].rods.all())]
    return {(engine, level, kind) for engine, level, model in allowed for kind in model.kind}


def test_the_fast_form_has_every_joint_on_every_engine_and_every_scenario_at_state_level():
    cells = list(matrix_cells())
    fast = [cell.values for cell in cells if not cell.marks]
    left_out = joints_compared(cell.values for cell in cells) - joints_compared(fast)
    in_tree_motions = {"cylindrical"}  # tests/adapters/test_tree_motions.py: on every engine
    assert {joint[1:] for joint in left_out} <= {("trajectory", kind) for kind in in_tree_motions}
    assert {cell[:2] for cell in fast if cell[2] == "state"} == {cell.values[:2] for cell in cells}


@pytest.fixture(scope="session")
def workers():
    with WorkerPool(1 if "PYTEST_XDIST_WORKER" in os.environ else os.cpu_count() or 1) as pool:
        yield pool


@pytest.fixture(scope="session")
def engines(workers):
    return describe_engines(workers, list(ENGINES))


@pytest.fixture(scope="session")
def truths():
    return {}


@pytest.mark.parametrize(("name", "engine", "level"), list(matrix_cells()))
@pytest.mark.timeout(900)
def test_cell(name, engine, level, workers, engines, truths):
    found = catalogue_scenarios()[name]
    info = engines[engine]
    if info.missing:
        pytest.skip(info.missing)
    plan = Plan([found], [engine], level, limits=Limits(600))
    bench = ScenarioRun(plan, found, {engine: info})
    known_truth = truths.get((name, level))
    tasks = [*(bench.on_outcome(known_truth) if known_truth else []), *bench.tasks()]
    while tasks:
        follow = []
        for outcome in workers.run(tasks):
            if outcome.key.is_truth:
                truths[name, level] = outcome
            follow += bench.on_outcome(outcome)
        tasks = [task for task in follow if task.key.kind != TaskKind.DIAGNOSIS]
    rows = bench.findings().rows
    assert rows, "no answer at all"
    excuses = known_issues.KnownIssues(known_issues.project_known_issues(), has_extra_refinements=False)
    wrong = [
        f"{r.key} {r.verdict}: {r.reason}"
        for r in excuses.mark_known(rows, found.model.n, inertia_ratio(found.model))
        if r.verdict.needs_attention and r.known_issue is None
    ]
    stale = [f"known entry {e.id} no longer occurs" for e in excuses.stale_issues(is_full_matrix=False)]
    assert not wrong + stale, "\n".join(wrong + stale)
