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

from plumbline.processes.workers import Limits, Memory, NoCrew, Outcome, Task, Workers

dask: Any = distributed  # untyped

HANDED_OVER = 2  # tasks per thread of the cluster that are on their way at a time
PATIENCE = 10  # s to find the scheduler
RETRIES = 5  # times that a cell goes to another machine where its own was lost
_here = threading.local()  # the isolated worker of each thread of a dask worker


class Cluster:
    """Like `Workers`, but on the cluster of the scheduler at ``address``."""

    def __init__(self, address: str, limits: Limits | None = None) -> None:
        """Connect; NoCrew where no scheduler answers within `PATIENCE`."""
        self.limits = limits or Limits()
        try:
            self._client = dask.Client(address, timeout=PATIENCE)
        except (OSError, ValueError) as error:
            raise NoCrew(f"no dask scheduler answers at {address}: {error}") from None

    def __enter__(self) -> Cluster:
        """The cluster itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the cluster as it is; what is still on its way is dropped."""
        self._client.close()

    def run(self, tasks: Iterable[Task | None], memory: Memory | None = None) -> Iterator[Outcome]:
        """Outcomes in the order of completion; as `Workers.run`."""
        memory = memory or Memory()
        waiting: dict[str, tuple[Task, int]] = {}  # with the number of times it was handed over
        done = dask.as_completed([])
        source = iter(tasks)
        exhausted = False

        def hand_over(task: Task, times: int) -> None:
            future = self._client.submit(isolated, task, pure=False, retries=RETRIES)
            waiting[future.key] = task, times
            done.add(future)

        while waiting or not exhausted:
            while not exhausted and len(waiting) < self._room():
                try:
                    task = next(source)
                except StopIteration:
                    exhausted = True
                    break
                if task is None:
                    break
                before = memory.get(task)
                if before is not None:
                    yield before
                    continue
                hand_over(task, 1)
            if not waiting:
                return
            future = next(done)
            task, times = waiting.pop(future.key)
            try:
                found: Outcome = future.result()
            except Exception as error:  # `isolated` raises nothing: an answer was lost with its machine
                if times <= RETRIES:
                    hand_over(task, times + 1)
                    continue
                found = Outcome(task.key, lost=f"the cluster: {type(error).__name__}: {error}")
            memory.put(task, found)
            yield found

    def _room(self) -> int:
        threads: int = sum(self._client.nthreads().values())
        return max(2, HANDED_OVER * threads)


def isolated(task: Task) -> Outcome:
    """Run on a dask worker: the task in a process that can be killed, kept from task to task."""
    if getattr(_here, "limits", None) != task.limits:
        if hasattr(_here, "workers"):
            _here.workers.__exit__(None, None, None)
        # A nanny marks its process as a daemon, which may have no children; ours die with it anyhow.
        multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
        _here.workers, _here.limits = Workers(1, task.limits), task.limits
    (found,) = _here.workers.run([task])
    return found  # type: ignore[no-any-return]
