"""Worker processes that can be killed: a crash, hang or memory blow-up loses one task and says so.

Each worker runs in a scratch folder of its own, has its output thrown away at the level of file
descriptors (engines print from C++), one BLAS thread, a limit of address space, and dies with
its parent.
"""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

from pebble import ProcessExpired, ProcessPool

from plumbline.processes.errors import PlumblineError
from plumbline.processes.isolation import ScratchFolder
from plumbline.processes.packed import Pickled
from plumbline.processes.parent_death import die_with_parent
from plumbline.processes.remote_python import RemoteCrash, RemoteError, call_remote, call_timed, describe_exit

SINGLE_THREAD_ENV = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


POLL_INTERVAL = 0.2  # s between looks at what runs too long


@dataclass(frozen=True)
class Limits:
    """What one task may use."""

    seconds: float = 300.0  # wall clock
    gigabytes: float = 8.0  # address space of the worker


@dataclass(frozen=True)
class Task:
    """A call to make in a worker: a picklable function and its arguments, packed ones opened there."""

    key: Any
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    limits: Limits = field(default_factory=Limits)
    version: str = ""  # of the engine that answers; a part of the answer's content key
    python: str = ""  # the interpreter of another environment to make the call in; empty: this one's
    judge: Callable[[Any], Any] | None = (
        None  # picklable; the worker asks it of the value, in this environment
    )


@dataclass(frozen=True)
class Outcome:
    """What became of a task: its value, or the sentence that says how it was lost."""

    key: Any
    raw_value: Any = None  # the value, or that value packed as its worker sent it
    failure: str | None = None
    cpu_time: float = 0.0  # CPU s of the call
    judge_result: Any = None  # what the task's judge said; of an answer from before: None
    judge_cpu_time: float = 0.0  # CPU s of the judge

    @property
    def value(self) -> Any:
        """The answer, opened at every look."""
        return self.raw_value.load() if isinstance(self.raw_value, Pickled) else self.raw_value

    @property
    def pickled(self) -> Pickled:
        """The answer as it goes to others."""
        return self.raw_value if isinstance(self.raw_value, Pickled) else Pickled.of(self.raw_value)


class ExecutorUnavailable(PlumblineError):
    """Those who should do the work cannot be had; the message says why."""


class ResultCache:
    """What is known of tasks from before; this one knows nothing."""

    def get(self, task: Task) -> Outcome | None:
        """The outcome of a task that need not run again."""
        return None

    def put(self, task: Task, outcome: Outcome) -> None:
        """Take note of a task's outcome."""


class WorkerPool:
    """A pool of ``jobs`` workers; `run` yields outcomes as they come, a lost worker costs one of them."""

    def __init__(self, jobs: int, limits: Limits | None = None) -> None:
        self.jobs = jobs
        self.limits = limits or Limits()
        self._scratch = ScratchFolder()
        os.environ.update(
            SINGLE_THREAD_ENV
        )  # inherited by the spawned interpreters, before NumPy loads there
        self._pool = ProcessPool(
            max_workers=jobs,
            context=multiprocessing.get_context("spawn"),
            initializer=initialize_worker,
            initargs=(str(self._scratch.path), self.limits.gigabytes, os.getpid()),
        )

    def __enter__(self) -> WorkerPool:
        """The pool itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Kill what still runs and remove the scratch folders."""
        self._pool.stop()  # type: ignore[no-untyped-call]
        self._pool.join()
        self._scratch.remove()

    def run(self, tasks: Iterable[Task | None], result_cache: ResultCache | None = None) -> Iterator[Outcome]:
        """Outcomes in the order of completion; only a few tasks are handed over at a time.

        ``tasks`` may yield None: no task until another outcome has come.  What ``memory`` has is not run
        again; it is told of every other outcome before the caller.
        """
        result_cache = result_cache or ResultCache()
        waiting: dict[Future[Any], Task] = {}
        began: dict[Future[Any], float] = {}
        source = iter(tasks)
        exhausted = False
        while waiting or not exhausted:
            while not exhausted and len(waiting) < 2 * self.jobs:
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
                future: Future[Any] = self._pool.schedule(run_task, args=(task,))
                waiting[future] = task
            if not waiting:
                return
            done, _ = wait(waiting, timeout=POLL_INTERVAL, return_when=FIRST_COMPLETED)
            cancel_overdue(waiting, began)
            for future in done:
                task = waiting.pop(future)
                began.pop(future, None)
                found = outcome_from_future(task, future)
                result_cache.put(task, found)
                yield found


def run_task(task: Task) -> Outcome:
    """Make a task's call, here or in the environment that it names."""
    try:
        return _call_and_judge(task)
    except MemoryError:
        pass  # what it filled hangs on the error's traceback, which the pool would keep during the next task
    gc.collect()
    raise MemoryError


def _call_and_judge(task: Task) -> Outcome:
    """The same; a MemoryError holds what filled the memory."""
    arguments = [one.load() if isinstance(one, Pickled) else one for one in task.arguments]
    if task.python:
        value, cost = call_remote(task.python, call_timed, task.function, *arguments)
    else:
        value, cost = call_timed(task.function, *arguments)
    judged, judging = call_timed(task.judge, value) if task.judge else (None, 0.0)
    return Outcome(task.key, Pickled.of(value), None, cost, judged, judging)


def cancel_overdue(waiting: dict[Future[Any], Task], began: dict[Future[Any], float]) -> None:
    """Cancel what runs longer than its limit, which kills its worker.

    The pool would do it by the clock of the wall: set forward it kills what is in time, set back it waits.
    """
    now = time.monotonic()
    for future, task in waiting.items():
        if future.running() and now - began.setdefault(future, now) > task.limits.seconds:
            future.cancel()


def outcome_from_future(task: Task, future: Future[Outcome]) -> Outcome:
    """The outcome of a finished future, or how its worker was lost."""
    try:
        return future.result()
    except CancelledError:  # by `stop_late`, and by nobody else
        return Outcome(task.key, failure=f"hung: no answer within {task.limits.seconds:g} s, worker killed")
    except ProcessExpired as expired:
        return Outcome(task.key, failure=f"crashed: the worker {describe_exit(expired.exitcode)}")
    except RemoteCrash as crashed:
        return Outcome(task.key, failure=f"crashed: the worker {crashed}")
    except RemoteError as error:
        return Outcome(task.key, failure=str(error))
    except MemoryError:
        return Outcome(task.key, failure=f"out of memory: over {task.limits.gigabytes:g} GB of address space")
    except Exception as error:  # ImportError among them: the caller tells "not installed" by its name
        return Outcome(task.key, failure=f"{type(error).__name__}: {error}")


def initialize_worker(scratch: str, gigabytes: float, parent: int) -> None:
    """Initialise a worker process: called by the pool, in the worker, before any task."""
    os.environ.update(SINGLE_THREAD_ENV)
    os.chdir(tempfile.mkdtemp(dir=scratch))
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    os.close(sink)
    die_with_parent(parent)
    with contextlib.suppress(ImportError, ValueError, OSError):  # no such limit on Windows
        import resource

        size = int(gigabytes * 2**30)
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
