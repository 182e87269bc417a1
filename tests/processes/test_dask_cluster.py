"""Cells on a cluster started by dask's own command line: the same results, also when a machine is lost."""

import contextlib
import os
import signal
import time
from dataclasses import replace
from importlib.util import find_spec

import psutil
import pytest

if find_spec("distributed") is None:
    pytest.skip("distributed is not installed", allow_module_level=True)

from plumbline.execution.plan import Plan
from plumbline.execution.runner import run_plan
from plumbline.processes.worker_pool import Limits, Task
from plumbline.scenario import loader
from tests.helpers.commands import run_plumbline
from tests.helpers.dask_cluster import cluster


def run_rows(plan, progress=lambda *_: None):
    return [replace(row, cpu_time=0.0) for row in run_plan(plan, progress).rows]


def make_plan(**more):
    chosen = loader.load_scenarios(["rest", "double-tumbling-balls"])
    return Plan(chosen, ["mujoco", "pinocchio"], "state", random_state_count=2, **more)


@pytest.mark.timeout(300)
def test_a_cluster_gives_the_same_answers_and_survives_a_lost_machine(tmp_path):
    expected = run_rows(make_plan())
    with cluster(tmp_path, 2) as (address, machines):
        assert run_rows(make_plan(scheduler=address)) == expected

        def lose_one(done, *_):
            if done == 2:
                victim = machines[0]
                for process in [*psutil.Process(victim.pid).children(recursive=True), victim]:
                    with contextlib.suppress(psutil.NoSuchProcess):
                        os.kill(process.pid, signal.SIGKILL)

        assert run_rows(make_plan(scheduler=address), lose_one) == expected
        assert machines[0].poll() is not None, "no machine was lost: the test tests nothing"
        check_losses_cost_one_task(address)


def check_losses_cost_one_task(address):
    """A crash and a hang inside a dask worker lose their own task, and no dask worker."""
    import ctypes
    import operator

    from plumbline.processes.dask_cluster import DaskCluster

    limits = Limits(5, 4)
    with DaskCluster(address, limits) as crew:
        calls = {"a": (operator.mul, 2, 3), "crash": (ctypes.string_at, 0), "hang": (time.sleep, 600),
                 "b": (operator.mul, 3, 3)}  # fmt: skip
        tasks = [Task(key, call, tuple(arguments), limits) for key, (call, *arguments) in calls.items()]
        found = {o.key: o for o in crew.run(tasks)}
    assert (found["a"].value, found["b"].value) == (6, 9)
    assert found["crash"].failure == "crashed: the worker died of SIGSEGV"
    assert "timeout" in found["hang"].failure


def test_a_missing_scheduler_is_reported():
    done = run_plumbline("run", "rest", "--scheduler", "nonsense", code=2)
    assert "nonsense" in done.stderr


class LostClient:
    """A client whose scheduler has gone."""

    def nthreads(self):
        raise OSError("timed out")

    def submit(self, *_, **__):
        raise RuntimeError("the client is closed")


class LostFuture:
    key = "a"

    def result(self):
        raise RuntimeError("its machine was lost")


def test_a_lost_cluster_ends_the_run():
    from plumbline.processes import dask_cluster
    from plumbline.processes.worker_pool import ExecutorLost

    made = object.__new__(dask_cluster.DaskCluster)
    made._client, made._tasks = LostClient(), {"a": (Task("a", len), dask_cluster._MAX_RETRIES + 1)}
    made._done = iter([LostFuture()])
    with pytest.raises(ExecutorLost, match="OSError: timed out"):
        _ = made.capacity
    with pytest.raises(ExecutorLost, match="RuntimeError: its machine was lost"):
        made.collect()
    with pytest.raises(ExecutorLost, match="RuntimeError: the client is closed"):
        made.start(Task("b", len))
