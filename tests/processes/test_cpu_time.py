"""CPU time is counted once, by what it went into."""

import time

import pytest

from plumbline.execution.plan import Plan, TaskKey, TaskKind
from plumbline.execution.runner import run_plan
from plumbline.processes.cpu_time import CpuTimes
from plumbline.processes.worker_pool import Outcome, ResultCache, Task, WorkerPool
from plumbline.scenario import loader


def use_cpu(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_what_is_measured_inside_is_not_process_too():
    split = CpuTimes()
    with split.measure_overhead():
        use_cpu(0.05)
        with split.measure("judging"):
            use_cpu(0.1)
    assert 0.09 < split.seconds["judging"] < 0.2
    assert 0.04 < split.seconds["process"] < 0.1


def test_calls_are_counted_by_the_engine_called():
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
    assert "as a share of the engines' time" not in split.summary(), "too little to compare with"
    split.add_outcome(Outcome(key, cpu_time=4.0), "engines")
    assert "harness 0 %, truth and reference 138 %" in split.summary()


def test_a_memory_is_the_same_and_measured():
    class Slow(ResultCache):
        def get(self, task):
            use_cpu(0.05)
            return Outcome(("a",), 3)

    split = CpuTimes()
    assert split.timed_cache(Slow()).get(None).value == 3
    assert split.seconds["storage"] > 0.04


def test_a_run_accounts_for_its_time():
    pytest.importorskip("mujoco")
    begin, wall = time.process_time(), time.monotonic()
    chosen = loader.load_scenarios(["rest"])
    plan = Plan(chosen, ["reference", "mujoco"], "state", random_state_count=3, jobs=1)
    seconds = run_plan(plan, lambda *_: None).cpu_times.seconds
    own, wall = time.process_time() - begin, time.monotonic() - wall
    assert all(seconds[k] > 0 for k in ("engines", "reference", "truth", "process", "judging")), seconds
    assert 0.7 * own < sum(seconds.values()) < 1.1 * (own + wall), (seconds, own, wall)


def test_a_worker_reports_all_its_time():
    task = Task("a", use_cpu, (0.2,))
    with WorkerPool(1) as workers:
        outcomes = [outcome for _ in range(2) for outcome in workers.run([task])]
    assert all(0.2 <= outcome.cpu_time < 0.3 for outcome in outcomes)
    assert 0 < outcomes[1].overhead_cpu_time < 0.1
