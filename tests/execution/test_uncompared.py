"""What is not compared of a scenario has a row that says so."""

from dataclasses import replace

import pytest

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.registry import load_adapter
from plumbline.execution.plan import Plan, TaskKind
from plumbline.execution.scenario_verdicts import ScenarioRun
from plumbline.judging.rows import Verdict
from plumbline.judging.state_level import SINGULAR_POSE
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.runs import run_scenarios


@pytest.mark.parametrize(
    ("name", "level", "expected"),
    [
        ("double-tumbling-rods", "all", set()),
        ("furuta", "all", set()),
        ("furuta", "state", set()),
        ("damped-hinge", "all", set()),
        ("four-bar", "all", set()),
        ("four-bar", "trajectory", set()),
        ("four-bars-2-flat", "all", {"step", "trajectory", "invariants"}),  # singular at the start
    ],
)
def test_levels_that_are_left_out_are_reported(name, level, expected):
    scenario = catalogue_scenario(name)
    info: EngineInfo = load_adapter("mujoco").describe()
    run = ScenarioRun(Plan([scenario], ["mujoco"], level, long_run_seconds=1.0), scenario, {"mujoco": info})
    rows = run.findings().rows
    assert {row.level for row in rows} == expected and len(rows) == len(expected)
    assert all(row.verdict == Verdict.INFORMATION and "not compared: " in row.reason for row in rows)
    assert (TaskKind.STEP in {task.key.kind for task in run.tasks()}) == (level == "all" and not expected)


def test_a_singular_initial_pose_is_unresolved_and_the_others_are_compared():
    engines = ["reference", "mujoco", "pinocchio-aba"]
    result = run_scenarios(["four-bars-2-flat"], engines, "state", random_state_count=3)
    singular = {row.engine: row for row in result.rows if row.quantity == SINGULAR_POSE}
    assert set(singular) == {"reference", "mujoco"}  # the third refuses loops
    for row in singular.values():
        assert row.verdict == Verdict.UNRESOLVED and row.known_issue == "four-bars-reach-their-flat-pose"
        assert row.value < 1e-14 and row.reason.startswith("singular: ")
    compared = [row for row in result.rows if row.verdict == Verdict.AGREES]
    assert sum(row.level == "state" for row in compared) == 2 * 7
    assert {row.extra["states"] for row in compared} == {3.0}
    assert result.metadata["exit_code"] == 0


def test_a_regular_pose_beside_a_singular_one_is_compared():
    """The dead centres of a slider-crank are regular: the crank turns there."""
    result = run_scenarios(["slider-crank"], ["reference"], "state", random_state_count=1)
    assert {row.extra["states"] for row in result.rows} == {2.0}


@pytest.mark.parametrize("level", ["all", "trajectory", "state"])
def test_a_scenario_that_asks_for_states_is_compared_at_ten_only(level):
    assert catalogue_scenario("crowded-tree").level == "state"
    scenario = replace(catalogue_scenario("damped-hinge"), level="state")
    result = run_scenarios([scenario], ["reference"], level)
    assert {(row.level, row.verdict, row.extra["states"]) for row in result.rows} == {
        ("state", Verdict.AGREES, 10.0)
    }
