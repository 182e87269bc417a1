"""Tasks on many machines: dask.distributed, with an isolated worker process inside each dask worker.

Every machine needs this project's checkout on its import path, and an environment like this one:

    dask worker tcp://SCHEDULER:8786 --nthreads 1 --nworkers 2        (in the checkout)

When a machine is lost, the scheduler hands its tasks to the others.
"""

from __future__ import annotations

import multiprocessing
import threading
from typing import Any

import distributed

from plumbline.processes.worker_pool import (
    Executor,
    ExecutorLost,
    ExecutorUnavailable,
    Limits,
    Outcome,
    Task,
    WorkerPool,
)

_dask: Any = distributed  # untyped

_TASKS_PER_THREAD = 2  # tasks handed over at a time, per thread of the cluster
_CONNECT_TIMEOUT = 10  # s to find the scheduler
_MAX_RETRIES = 5  # times that a task is handed over again after its machine was lost
_thread_local = threading.local()  # the isolated worker of each thread of a dask worker


class DaskCluster(Executor):
    """The workers of a dask cluster."""

    def __init__(self, address: str, limits: Limits | None = None) -> None:
        """Connect to the cluster.

        Args:
            address: of the scheduler, as ``tcp://HOST:8786``.
            limits: default limits of the tasks.

        Raises:
            ExecutorUnavailable: no scheduler answers within `_CONNECT_TIMEOUT`.

        """
        self.limits = limits or Limits()
        try:
            self._client = _dask.Client(address, timeout=_CONNECT_TIMEOUT)
        except (OSError, ValueError) as error:
            raise ExecutorUnavailable(f"no dask scheduler answers at {address}: {error}") from None
        self._tasks: dict[str, tuple[Task, int]] = {}  # by key of the future, with the number of attempts
        self._done = _dask.as_completed([])

    def __exit__(self, *_: object) -> None:
        """Disconnect; tasks that still run are dropped."""
        self._client.close()

    @property
    def capacity(self) -> int:
        """Two tasks per thread of the cluster, which may grow and shrink."""
        try:
            threads: int = sum(self._client.nthreads().values())
        except Exception as error:  # distributed raises errors of many kinds where the scheduler has gone
            raise _lost(error) from None
        return max(2, _TASKS_PER_THREAD * threads)

    def start(self, task: Task) -> None:
        """Hand a task to the cluster.

        Args:
            task: the call, for any of the cluster's workers.

        """
        self._submit(task, 1)

    def collect(self) -> list[tuple[Task, Outcome]]:
        """Wait for the next task to finish.

        Returns:
            The task and its outcome; nothing where its machine was lost and it was handed over again.

        Raises:
            ExecutorLost: the scheduler has gone, or machines were lost with the same task too often.

        """
        future = next(self._done)
        task, attempts = self._tasks.pop(future.key)
        try:
            return [(task, future.result())]
        except Exception as error:  # `_run_isolated` raises nothing: the answer was lost with its machine
            if attempts <= _MAX_RETRIES:
                self._submit(task, attempts + 1)
                return []
            raise _lost(error) from None

    def _submit(self, task: Task, attempts: int) -> None:
        try:
            future = self._client.submit(_run_isolated, task, pure=False, retries=_MAX_RETRIES)
        except Exception as error:  # as above
            raise _lost(error) from None
        self._tasks[future.key] = task, attempts
        self._done.add(future)


def _lost(error: Exception) -> ExecutorLost:
    return ExecutorLost(f"{type(error).__name__}: {' '.join(str(error).split())}")


def _run_isolated(task: Task) -> Outcome:
    """Run a task on a dask worker: in a process that can be killed, kept from task to task."""
    if getattr(_thread_local, "limits", None) != task.limits:
        if hasattr(_thread_local, "workers"):
            _thread_local.workers.__exit__(None, None, None)
        # A nanny marks its process as a daemon, which may have no children; ours die with it anyhow.
        multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
        _thread_local.workers, _thread_local.limits = WorkerPool(1, task.limits), task.limits
    (found,) = _thread_local.workers.run([task])
    return found  # type: ignore[no-any-return]
