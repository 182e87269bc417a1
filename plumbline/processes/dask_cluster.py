"""Cells on many machines: dask.distributed, with the same isolated worker inside each of its tasks.

Every machine needs this project's checkout on its import path, and an environment like this one:

    dask worker tcp://SCHEDULER:8786 --nthreads 1 --nworkers 2        (in the checkout)

A machine that is lost in the middle loses nothing: the scheduler hands its cells to the others.
"""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Any

import distributed

from plumbline.processes.workers import ExecutorUnavailable, Limits, Outcome, ResultCache, Task, WorkerPool

dask: Any = distributed  # untyped

TASKS_PER_THREAD = 2  # tasks per thread of the cluster that are on their way at a time
CONNECT_TIMEOUT = 10  # s to find the scheduler
MAX_RETRIES = 5  # times that a cell goes to another machine where its own was lost
_thread_local = threading.local()  # the isolated worker of each thread of a dask worker


class DaskCluster:
    """Like `Workers`, but on the cluster of the scheduler at ``address``."""

    def __init__(self, address: str, limits: Limits | None = None) -> None:
        """Connect; NoCrew where no scheduler answers within `PATIENCE`."""
        self.limits = limits or Limits()
        try:
            self._client = dask.Client(address, timeout=CONNECT_TIMEOUT)
        except (OSError, ValueError) as error:
            raise ExecutorUnavailable(f"no dask scheduler answers at {address}: {error}") from None

    def __enter__(self) -> DaskCluster:
        """The cluster itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the cluster as it is; what is still on its way is dropped."""
        self._client.close()

    def run(self, tasks: Iterable[Task | None], result_cache: ResultCache | None = None) -> Iterator[Outcome]:
        """Outcomes in the order of completion; as `Workers.run`."""
        result_cache = result_cache or ResultCache()
        waiting: dict[str, tuple[Task, int]] = {}  # with the number of times it was handed over
        done = dask.as_completed([])
        source = iter(tasks)
        exhausted = False

        def submit_task(task: Task, times: int) -> None:
            future = self._client.submit(run_isolated, task, pure=False, retries=MAX_RETRIES)
            waiting[future.key] = task, times
            done.add(future)

        while waiting or not exhausted:
            while not exhausted and len(waiting) < self._max_pending_tasks():
                try:
                    task = next(source)
                except StopIteration:
                    exhausted = True
                    break
                if task is None:
                    break
                before = result_cache.get(task)
                if before is not None:
                    yield before
                    continue
                submit_task(task, 1)
            if not waiting:
                return
            future = next(done)
            task, times = waiting.pop(future.key)
            try:
                found: Outcome = future.result()
            except Exception as error:  # `isolated` raises nothing: an answer was lost with its machine
                if times <= MAX_RETRIES:
                    submit_task(task, times + 1)
                    continue
                found = Outcome(task.key, failure=f"the cluster: {type(error).__name__}: {error}")
            result_cache.put(task, found)
            yield found

    def _max_pending_tasks(self) -> int:
        threads: int = sum(self._client.nthreads().values())
        return max(2, TASKS_PER_THREAD * threads)


def run_isolated(task: Task) -> Outcome:
    """Run on a dask worker: the task in a process that can be killed, kept from task to task."""
    if getattr(_thread_local, "limits", None) != task.limits:
        if hasattr(_thread_local, "workers"):
            _thread_local.workers.__exit__(None, None, None)
        # A nanny marks its process as a daemon, which may have no children; ours die with it anyhow.
        multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
        _thread_local.workers, _thread_local.limits = WorkerPool(1, task.limits), task.limits
    (found,) = _thread_local.workers.run([task])
    return found  # type: ignore[no-any-return]
