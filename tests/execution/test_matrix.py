"""The product as tests: every scenario × engine × level is a test of its own.

`pytest -k "double and mujoco"` runs those of one family and engine; the failure message is the
verdict's own sentence.  By default long chains and trees run at state level only, and single steps of one and
two bodies; `-m full` runs the rest.
"""

import os

import pytest

from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.execution.plan import Plan, TaskKind
from plumbline.execution.runner import describe_engines
from plumbline.execution.scenario_run import ScenarioRun, uncompared_kinds
from plumbline.judging import known_issues
from plumbline.model.invariants import inertia_ratio
from plumbline.processes.workers import Limits, WorkerPool
from tests.helpers.catalogue import catalogue_scenarios

MAX_BODIES_IN_FAST_FORM = {"state": 50, "step": 2, "trajectory": 5}  # longer chains in the full form only


def levels(engine, scenario):
    """Levels at which an engine is compared on a scenario."""
    integrators, left_out = load_adapter(engine).integrators, uncompared_kinds(scenario.model)
    has_steps = any(i.method is not None for i in integrators) and TaskKind.STEP not in left_out
    has_motions = bool(integrators) and TaskKind.TRAJECTORY not in left_out
    return ("state", *["step"] * has_steps, *["trajectory"] * has_motions)


def matrix_cells():
    for name, scenario in catalogue_scenarios().items():
        for engine in ENGINES:
            for level in levels(engine, scenario):
                is_motion_of_tree = level == "trajectory" and not scenario.model.is_chain
                is_full = scenario.model.n > MAX_BODIES_IN_FAST_FORM[level] or is_motion_of_tree
                marks = [pytest.mark.full] if is_full else []
                label = name if scenario.family in name else f"{scenario.family}-{name}"
                yield pytest.param(name, engine, level, id=f"{label}: {engine}-{level}", marks=marks)


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
