"""The product as tests: every scenario × engine × level is a test of its own.

`pytest -k "double and mujoco"` runs those of one family and engine; the failure message is the
verdict's own sentence.  By default the cells that `tests.helpers.fast_matrix` selects run; `-m full` runs
the rest.
"""

import os

import pytest

from plumbline.engines.registry import ENGINES
from plumbline.execution.plan import Plan
from plumbline.execution.runner import describe_engines
from plumbline.execution.scenario_verdicts import ScenarioRun
from plumbline.judging import known_issues
from plumbline.model.invariants import inertia_ratio
from plumbline.processes.worker_pool import Limits, WorkerPool
from tests.helpers.catalogue import catalogue_scenario, catalogue_scenarios
from tests.helpers.fast_matrix import features, is_fast, levels


def matrix_cells():
    for name, scenario in catalogue_scenarios().items():
        for engine in ENGINES:
            for level in levels(engine, scenario):
                label = name if scenario.family in name else f"{scenario.family}-{name}"
                marks = [] if is_fast(scenario, level) else [pytest.mark.full]
                yield pytest.param(name, engine, level, id=f"{label}: {engine}-{level}", marks=marks)


@pytest.mark.parametrize("level", ["state", "step", "trajectory"])
def test_the_fast_form_has_everything_on_every_engine(level):
    """Random trees have the joints that are left out: test_tree_motions.py, test_step_level.py."""
    left_out = set() if level == "state" else {"universal", "cylindrical", "planar", "helical", "weld"}
    left_out |= {"hinge", "slide", "elements", "several bodies"} if level == "trajectory" else set()
    found = {engine: (set(), set()) for engine in ENGINES}  # features of the fast cells, and of all
    for cell in matrix_cells():
        name, engine, of_cell = cell.values
        model = catalogue_scenario(name).model
        if of_cell == level and not (engine == "reference-printed" and (model.n > 2 or not model.rods.all())):
            fast, every = found[engine]
            every |= features(catalogue_scenario(name))
            fast |= set() if cell.marks else features(catalogue_scenario(name))
    for engine, (fast, every) in found.items():
        if engine != "reference-printed" or level == "state":
            assert every - fast <= left_out, engine


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
    found = catalogue_scenario(name)
    info = engines[engine]
    if info.missing:
        pytest.skip(info.missing)
    plan = Plan([found], [engine], level, limits=Limits(600))
    excuses = known_issues.KnownIssues(known_issues.project_known_issues(), has_extra_refinements=False)
    bench = ScenarioRun(plan, found, {engine: info}, known=excuses)
    known_truth = truths.get((name, level))
    tasks = [*(bench.on_outcome(known_truth) if known_truth else []), *bench.tasks()]
    while tasks:
        follow = []
        for outcome in workers.run(tasks):
            if outcome.key.is_truth:
                truths[name, level] = outcome
            follow += bench.on_outcome(outcome)
        tasks = follow
    rows = bench.findings().rows
    assert rows, "no answer at all"
    wrong = [
        f"{r.key} {r.verdict}: {r.reason}"
        for r in excuses.mark_known(rows, found.model.n, inertia_ratio(found.model), found.model.kind)
        if r.verdict.needs_attention and r.known_issue is None
    ]
    stale = [f"known entry {e.id} no longer occurs" for e in excuses.stale_issues(is_full_matrix=False)]
    assert not wrong + stale, "\n".join(wrong + stale)
