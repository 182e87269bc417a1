"""What is not compared of a scenario has a row that says so."""

import pytest

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.registry import load_adapter
from plumbline.execution.plan import Plan, TaskKind
from plumbline.execution.scenario_run import ScenarioRun, uncompared_kinds
from plumbline.judging.rows import Verdict
from tests.helpers.catalogue import catalogue_scenarios


@pytest.mark.parametrize(
    ("name", "level", "expected"),
    [
        ("double-tumbling-rods", "all", set()),
        ("chain-30-balls", "all", {"step"}),
        ("furuta", "all", {"step"}),
        ("furuta", "state", set()),
        ("four-bar", "all", {"step", "trajectory", "relations"}),
        ("four-bar", "trajectory", {"trajectory"}),
    ],
)
def test_levels_that_are_left_out_are_reported(name, level, expected):
    scenario = catalogue_scenarios()[name]
    info: EngineInfo = load_adapter("mujoco").describe()
    run = ScenarioRun(Plan([scenario], ["mujoco"], level), scenario, {"mujoco": info})
    rows = run.findings().rows
    assert {row.level for row in rows} == expected and len(rows) == len(expected)
    assert all(row.verdict == Verdict.INFORMATION and "not compared: " in row.reason for row in rows)
    left_out = uncompared_kinds(scenario.model)
    assert all(task.key.kind not in left_out for task in run.tasks())
    assert (TaskKind.STEP in left_out) == (name != "double-tumbling-rods")
