"""CPU time is counted once, by what it went into."""

import time

import pytest

from plumbline.execution.plan import Plan, TaskKey, TaskKind
from plumbline.execution.runner import run_plan
from plumbline.processes.cpu_time import CPU_TIME_KINDS, CpuTimes, cpu_time_spent
from plumbline.processes.workers import Outcome, ResultCache
from plumbline.scenario import loader


def burn(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_what_is_measured_inside_is_not_process_too():
    split = CpuTimes()
    with split.measure_overhead():
        burn(0.05)
        with split.measure("judging"):
            burn(0.1)
    assert 0.09 < split.seconds["judging"] < 0.2
    assert 0.04 < split.seconds["process"] < 0.1


def test_calls_are_counted_by_whom_they_asked():
    split = CpuTimes()
    costs = {
        TaskKey(TaskKind.MOTION_TRUTH, "s"): 1.0,
        TaskKey(TaskKind.STATE, "s", "reference"): 2.0,
        TaskKey(TaskKind.STATE, "s", "mujoco"): 4.0,
        TaskKey(TaskKind.DIAGNOSIS, "s", "mujoco"): 8.0,
    }
    for key, cost in costs.items():
        split.add_outcome(Outcome(key, cpu_time=cost), key.cpu_time_kind)
    assert [split.seconds[k] for k in ("truth", "reference", "engines", "diagnosis")] == [1.0, 2.0, 4.0, 8.0]
    assert "harness 0 %, truth and reference 275 %" in split.summary()


def test_a_memory_is_the_same_and_measured():
    class Slow(ResultCache):
        def get(self, task):
            burn(0.05)
            return Outcome(("a",), 3)

    split = CpuTimes()
    assert split.timed_cache(Slow()).get(None).value == 3
    assert split.seconds["storage"] > 0.04


def test_a_run_accounts_for_its_time():
    pytest.importorskip("mujoco")
    begin = cpu_time_spent()
    chosen = loader.load_scenarios(["rest"])
    split = run_plan(Plan(chosen, ["reference", "mujoco"], random_state_count=3), lambda *_: None).cpu_times
    seconds = {kind: split.seconds[kind] for kind in CPU_TIME_KINDS}
    assert all(seconds[k] > 0 for k in ("engines", "reference", "truth", "process", "judging")), seconds
    assert 0.7 * (cpu_time_spent() - begin) < sum(seconds.values()) < 1.1 * (cpu_time_spent() - begin), (
        seconds
    )
