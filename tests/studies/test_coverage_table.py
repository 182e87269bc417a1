"""Coverage of many scenarios: one table, whatever the tasks."""

from dataclasses import replace

import pytest

from plumbline.judging.rows import RowContext, Verdict
from plumbline.studies import coverage_study
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.in_process import InProcessWorkers


def test_parameters_in_several_tasks_give_the_table_of_one(monkeypatch):
    scenarios, rows = [catalogue_scenario(name) for name in ("planar-small", "tumbling-rod")], []
    for s in scenarios:
        context = RowContext(s.name, "", "mujoco", "MuJoCo", "0")
        figures = {"value": 1e-12, "tolerance": 1e-10, "compared_until": s.duration / 16}
        for level, quantity in (("trajectory", "position_limit"), ("invariants", "energy_drift")):
            rows.append(context.make_row(level, "RK4", quantity, Verdict.AGREES, "", **figures))
    whole = coverage_study.measure_coverage(InProcessWorkers(), scenarios, rows, 1)
    assert {entry.level for entry in whole} == set(coverage_study.COVERED_LEVELS)
    monkeypatch.setattr(coverage_study, "PARAMETERS_PER_TASK", 20)
    executor, seen = InProcessWorkers(), []
    parts = coverage_study.measure_coverage(
        executor, scenarios, rows, 1, progress=lambda *counts: seen.append(counts)
    )
    assert len(executor.started) == len(seen) == seen[-1][1] == 2 * len(scenarios)
    assert [replace(entry, smallest=None) for entry in parts] == [
        replace(entry, smallest=None) for entry in whole
    ]
    for one, other in zip(parts, whole, strict=True):
        # batches of other sizes sum in another order
        assert one.smallest == (other.smallest and pytest.approx(other.smallest, rel=1e-6)), one
