"""Worker processes that can be killed, and the scheduler that hands tasks to them.

Each worker runs in a scratch folder of its own, discards its output at the level of file descriptors (engines
print from C++), uses one BLAS thread and a limited address space, and dies with its parent. A crash, a
timeout or a lack of memory loses one task, whose outcome holds the reason.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import hashlib
import multiprocessing
import os
import pickle
import tempfile
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from dataclasses import dataclass, field
from functools import cache, cached_property
from multiprocessing import forkserver
from multiprocessing.context import BaseContext
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from plumbline.processes.errors import PlumblineError
from plumbline.processes.isolation import ScratchFolder, die_with_parent
from plumbline.processes.record_encoding import EncodedRecord
from plumbline.processes.remote_python import RemoteCrash, RemoteError, call_remote, call_timed, describe_exit
from plumbline.processes.worker_environment import SINGLE_THREAD, TEMPORARY_FOLDER, worker_environment

if TYPE_CHECKING:
    from pebble import ProcessPool

_POLL_INTERVAL = 0.2  # s between checks for tasks that run too long
_MAX_POLL_GAP = 2.0  # s: a longer time between two checks is one in which this process was stopped, or busy
_WARM_MODULE = "plumbline.processes.warm"
_worker_cpu_time = {"reported": 0.0}  # s that this worker has reported in outcomes


@dataclass(frozen=True)
class Pickled:
    """A pickled value: pickled once, and loaded only where it is used. Loading a pickle can run any code."""

    data: bytes

    @classmethod
    def of(cls, value: Any) -> Pickled:
        """Pickle a value.

        Args:
            value: any value that can be pickled.

        Returns:
            The pickle.

        """
        return cls(pickle.dumps(value, protocol=5))

    @cached_property
    def digest(self) -> bytes:
        """SHA-256 of the pickle."""
        return hashlib.sha256(self.data).digest()

    def load(self) -> Any:
        """Load the pickle.

        Returns:
            A new copy of the value.

        """
        return pickle.loads(self.data)


Packed = Pickled | EncodedRecord


@dataclass(frozen=True)
class Limits:
    """What one task may use."""

    seconds: float = 300.0  # wall clock
    gigabytes: float = 8.0  # address space of the worker


@dataclass(frozen=True)
class Task:
    """A call to make in a worker; arguments that are bytes of a value are loaded there."""

    key: Any  # hashable
    function: Callable[..., Any]  # can be pickled
    arguments: tuple[Any, ...] = ()
    limits: Limits = field(default_factory=Limits)
    version: str = ""  # of the engine, a part of the content hash of the answer
    python: str = ""  # interpreter of another environment that makes the call; empty: the worker itself
    judge: Callable[..., Any] | None = None  # called in the worker with judge_arguments and the answer
    judge_arguments: tuple[Any, ...] = ()
    # asked of what the judge returned, whether the answer is needed besides; None: it is
    needs_answer: Callable[[Any], bool] | None = None


@dataclass(frozen=True)
class Outcome:
    """The answer to a task, or the reason why there is none."""

    key: Any
    raw_value: Any = None  # the answer, or bytes of it as the worker or the result cache gave them
    failure: str | None = None
    cpu_time: float = 0.0  # s of the call
    judge_result: Any = None  # what the task's judge returned
    judge_failure: str = ""  # why it returned nothing, where it raised
    judge_cpu_time: float = 0.0  # s of the judge
    overhead_cpu_time: float = 0.0  # s of the worker besides these, since its last outcome
    is_cached: bool = False  # whether an earlier call gave the answer
    is_overdue: bool = False  # whether the call was ended at its time limit

    @property
    def value(self) -> Any:
        """The answer, loaded anew at every access."""
        return _load(self.raw_value)

    @property
    def packed(self) -> Packed:
        """The answer as bytes, to be loaded where it is used."""
        return self.raw_value if isinstance(self.raw_value, Packed) else Pickled.of(self.raw_value)


class ExecutorUnavailable(PlumblineError):
    """The workers or the cluster cannot be had; the message gives the reason."""


class ExecutorLost(PlumblineError):
    """The cluster failed during the run; the message gives the reason."""


class ResultCache:
    """Answers of earlier tasks. This base class holds none."""

    def get(self, task: Task) -> Outcome | None:
        """Look a task's answer up.

        Args:
            task: the call to look up.

        Returns:
            Its outcome, or None where the task has to run.

        """
        return None

    def put(self, task: Task, outcome: Outcome) -> Outcome:
        """Take note of an outcome.

        Args:
            task: the call that was made.
            outcome: its answer or failure.

        Returns:
            The outcome; its answer may have another representation, of which a later run has an equal one.

        """
        return outcome


class Executor(ABC):
    """Something that makes the calls of tasks: the workers of this machine or of a cluster."""

    limits: Limits

    def __enter__(self) -> Self:
        """Return the executor."""
        return self

    def __exit__(  # noqa: B027 (nothing to drop by default)
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Drop what still runs."""

    @property
    @abstractmethod
    def capacity(self) -> int:
        """How many tasks may be handed over at a time."""

    @abstractmethod
    def start(self, task: Task) -> None:
        """Hand a task over.

        Args:
            task: a task that is not in the result cache.

        """

    @abstractmethod
    def collect(self) -> Sequence[tuple[Task, Outcome]]:
        """Wait a moment for tasks to finish.

        Returns:
            The tasks that finished, with their outcomes; empty where none has finished yet.

        """

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Run tasks without a cache.

        Args:
            tasks: the calls to make, in this order.

        Yields:
            Outcomes in the order of completion.

        """
        yield from Scheduler(self).run(tasks)


class Scheduler:
    """Hands tasks to an executor, a few at a time, and takes new ones while it runs."""

    def __init__(self, executor: Executor, result_cache: ResultCache | None = None) -> None:
        """Make a scheduler.

        Args:
            executor: makes the calls.
            result_cache: its answers are not computed again; it gets every other outcome before the caller.

        """
        self._executor = executor
        self._cache = result_cache or ResultCache()
        self._submitted: deque[Task] = deque()

    def submit(self, task: Task) -> None:
        """Add a task that arose from an outcome; it starts before those that `run` was given.

        Args:
            task: the call to make.

        """
        self._submitted.append(task)

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Run tasks until neither ``tasks`` nor the submitted ones are left.

        Args:
            tasks: the tasks, taken one by one as the executor has room.

        Yields:
            Outcomes in the order of completion.

        """
        source = iter(tasks)
        pending = 0
        while True:
            while pending < self._executor.capacity:
                task = self._submitted.popleft() if self._submitted else next(source, None)
                if task is None:
                    break
                known = self._cache.get(task)
                if known is not None:
                    yield known
                    continue
                self._executor.start(task)
                pending += 1
            if not pending:
                return
            for task, outcome in self._executor.collect():
                pending -= 1
                yield self._cache.put(task, outcome)


class WorkerPool(Executor):
    """Worker processes on this machine."""

    def __init__(self, jobs: int, limits: Limits | None = None) -> None:
        """Prepare the pool; its workers start with the first task.

        Args:
            jobs: number of worker processes.
            limits: their limits; the time limit is each task's own.

        """
        self.limits = limits or Limits()
        self._jobs = jobs
        self._pool: ProcessPool | None = None
        self._scratch = ScratchFolder()
        self._tasks: dict[Future[Any], Task] = {}
        self._started: dict[Future[Any], float] = {}  # `_clock` when a task was first seen running
        self._clock, self._last_poll = 0.0, time.monotonic()  # s

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Kill what still runs and remove the scratch folders."""
        if self._pool is not None:
            self._pool.stop()  # type: ignore[no-untyped-call]
            self._pool.join()
        self._scratch.remove()

    @property
    def capacity(self) -> int:
        """Two tasks per worker: one runs, one waits."""
        return 2 * self._jobs

    def start(self, task: Task) -> None:
        """Queue a task for the next idle worker.

        Args:
            task: the call to make there.

        """
        if self._pool is None:
            self._pool = self._make_pool()
        self._tasks[self._pool.schedule(run_task, args=(task,))] = task

    def _make_pool(self) -> ProcessPool:
        from pebble import ProcessPool  # with asyncio: not in a run whose answers all come from the cache

        return ProcessPool(
            max_workers=self._jobs,
            context=start_warm_process(),
            initializer=initialize_worker,
            initargs=(str(self._scratch.path), self.limits.gigabytes, os.getpid(), worker_environment()),
        )

    def collect(self) -> list[tuple[Task, Outcome]]:
        """Wait for a task to finish, at most `_POLL_INTERVAL`, and cancel those over their time limit.

        Returns:
            The finished tasks and their outcomes.

        """
        done, _ = wait(self._tasks, timeout=_POLL_INTERVAL, return_when=FIRST_COMPLETED)
        self._cancel_overdue()
        found = []
        for future in done:
            task = self._tasks.pop(future)
            self._started.pop(future, None)
            found.append((task, _outcome_from_future(task, future)))
        return found

    def _cancel_overdue(self) -> None:
        """Cancel tasks over their time limit, which kills their workers.

        The pool's own timeout goes by the wall clock: set forward it would kill tasks that are in time. While
        this process is stopped, as by Ctrl-Z, its workers are too, and that time does not count.
        """
        now = time.monotonic()
        self._clock += min(now - self._last_poll, _MAX_POLL_GAP)
        self._last_poll = now
        for future, task in self._tasks.items():
            if future.running():
                started = self._started.setdefault(future, self._clock)
                if self._clock - started > task.limits.seconds:
                    future.cancel()


def start_warm_process() -> BaseContext:
    """Start the process that loads the engines' libraries and from which workers are forked, if none runs.

    A command calls it first, so that the libraries are loaded while it reads its input.

    Returns:
        What starts workers: forked from that process, or anew where a platform cannot fork.

    """
    os.environ.update(SINGLE_THREAD)  # inherited by the workers, before NumPy loads there
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    _keep_sockets_in_scratch_folder()
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([_WARM_MODULE])
    try:
        forkserver.ensure_running()  # in this thread: the warm process ends with the thread that started it
    except OSError:  # the path of its socket has at most 107 bytes, and TMPDIR may be longer
        return multiprocessing.get_context("spawn")
    return context


@cache
def _keep_sockets_in_scratch_folder() -> None:
    """Have multiprocessing put its sockets where the next run removes them if this process is killed."""
    folder = ScratchFolder()
    atexit.register(folder.remove)
    multiprocessing.current_process()._config["tempdir"] = str(folder.path)  # type: ignore[attr-defined]


def run_task(task: Task) -> Outcome:
    """Make a task's call in this process, or in the environment that the task names.

    Args:
        task: the call to make and to judge.

    Returns:
        The outcome; exceptions of the call are raised.

    Raises:
        MemoryError: the call needs more memory than there is.

    """
    try:
        return _call_and_judge(task)
    except MemoryError:
        pass  # the traceback, which the pool would keep during the next task, references what filled it
    gc.collect()
    raise MemoryError


def _call_and_judge(task: Task) -> Outcome:
    arguments = [_load(one) for one in task.arguments]
    if task.python:
        value, cost = call_remote(task.python, call_timed, task.function, *arguments)
    else:
        value, cost = call_timed(task.function, *arguments)
    answer, judged, failure, judging = Pickled.of(value), None, "", 0.0
    if task.judge:
        begin = time.process_time()
        try:
            # a copy, whose arrays lie in memory alike wherever the call was made: sums depend on that
            judged = task.judge(*map(_load, task.judge_arguments), answer.load())
        except MemoryError:
            raise
        except Exception as error:  # the harness's, not the engine's
            failure = f"{type(error).__name__}: {error}"
        judging = time.process_time() - begin
    is_needed = task.needs_answer is None or judged is None or task.needs_answer(judged)
    total = time.process_time()
    overhead = total - _worker_cpu_time["reported"] - judging - (0.0 if task.python else cost)
    _worker_cpu_time["reported"] = total
    return Outcome(task.key, answer if is_needed else None, None, cost, judged, failure, judging, overhead)


def _load(value: Any) -> Any:
    return value.load() if isinstance(value, Packed) else value


def _outcome_from_future(task: Task, future: Future[Outcome]) -> Outcome:
    """The outcome of a finished future, or how its worker was lost."""
    from pebble import ProcessExpired

    try:
        return future.result()
    except CancelledError:  # by `_cancel_overdue` only
        failure = f"timeout: no answer within {task.limits.seconds:g} s, worker killed"
        return Outcome(task.key, failure=failure, is_overdue=True)
    except ProcessExpired as expired:
        return Outcome(task.key, failure=f"crashed: the worker {describe_exit(expired.exitcode)}")
    except RemoteCrash as crashed:
        return Outcome(task.key, failure=f"crashed: the worker {crashed}")
    except RemoteError as error:
        return Outcome(task.key, failure=str(error))
    except MemoryError:
        return Outcome(task.key, failure=f"out of memory: over {task.limits.gigabytes:g} GB of address space")
    except (Exception, SystemExit) as error:  # ImportError: the caller recognises "not installed" by its name
        return Outcome(task.key, failure=f"{type(error).__name__}: {error}")


def initialize_worker(scratch: str, gigabytes: float, parent: int, environment: Mapping[str, str]) -> None:
    """Prepare a worker process before its first task.

    Args:
        scratch: folder in which the worker makes its working folder.
        gigabytes: limit of its address space.
        parent: process id of the pool's process.
        environment: its environment variables; those of the warm process may be older.

    """
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(tempfile.mkdtemp(dir=scratch))
    os.environ.update(
        dict.fromkeys(TEMPORARY_FOLDER, os.getcwd())
    )  # removed with it, if the worker is killed
    tempfile.tempdir = None  # as found before
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
