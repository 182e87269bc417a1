"""The tasks of a run, the workers that make their calls, and the scheduler that hands tasks to them.

A crash, a timeout or a lack of memory loses one task, whose outcome holds the reason.
"""

from __future__ import annotations

import os
import pickle
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Self

from plumbline.processes import worker_process
from plumbline.processes.exceptions import PlumblineError, describe_exception
from plumbline.processes.isolation import ScratchFolder
from plumbline.processes.worker_environment import worker_environment
from plumbline.processes.worker_process import Packed as Packed
from plumbline.processes.worker_process import Pickled as Pickled
from plumbline.processes.worker_process import Reply, WorkerLost, WorkerProcess, load_packed, make_reply
from plumbline.processes.worker_process import start_warm_process as start_warm_process

_POLL_INTERVAL = 0.2  # s between checks for tasks that run too long
_MAX_POLL_GAP = 2.0  # s: a longer time between two checks is one in which this process was stopped, or busy


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
    engine: str = ""  # that the call runs: engines share no process, with each other or with the judges
    judge: Callable[..., Any] | None = None  # called in a worker with judge_arguments and the answer
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
    is_out_of_memory: bool = False  # whether the call reached its memory limit

    @property
    def value(self) -> Any:
        """The answer, loaded anew at every access."""
        return load_packed(self.raw_value)

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

        Returns:
            Its outcome, or None where the task has to run.

        """
        return None

    def put(self, task: Task, outcome: Outcome) -> Outcome:
        """Take note of an outcome.

        Args:
            task: the call that was made.

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

    def __exit__(self, *_: object) -> None:  # noqa: B027 (nothing to drop by default)
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
            result_cache: its answers are not computed again; it gets every other outcome before the caller.

        """
        self._executor = executor
        self._cache = result_cache or ResultCache()
        self._submitted: deque[Task] = deque()

    def submit(self, task: Task) -> None:
        """Add a task that arose from an outcome; it starts before those that `run` was given."""
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


@dataclass(eq=False)
class _Call:
    """A task in the pool."""

    task: Task
    process: WorkerProcess | None = None  # that computes it now
    is_overdue: bool = False
    started: float | None = None  # `WorkerPool._clock` when it was first seen running


class WorkerPool(Executor):
    """Worker processes on this machine.

    Engines change the process that they run in: modules, locale, threads. Each has processes of its own, and
    the judges have theirs. At most one process per job computes at a time.
    """

    def __init__(self, jobs: int, limits: Limits | None = None) -> None:
        """Prepare the pool; its workers start with the first task.

        Args:
            jobs: number of tasks that run at a time.
            limits: their limits; the time limit is each task's own.

        """
        self.limits = limits or Limits()
        self._jobs = jobs
        self._threads: ThreadPoolExecutor | None = None  # each waits for a process
        self._scratch = ScratchFolder()
        self._calls: dict[Future[Outcome], _Call] = {}
        self._lock = threading.Lock()  # of what follows and of the calls
        self._idle: dict[str, list[WorkerProcess]] = {}  # by what they run: an engine, or "" for the judges
        self._is_closed = False
        self._clock, self._last_poll = 0.0, time.monotonic()  # s

    def __exit__(self, *_: object) -> None:
        """Kill what still runs and remove the scratch folders."""
        with self._lock:
            self._is_closed = True
            for call in self._calls.values():
                if call.process is not None:
                    call.process.kill()
        if self._threads is not None:
            self._threads.shutdown(cancel_futures=True)
        for process in (process for idle in self._idle.values() for process in idle):
            process.end()
        self._scratch.remove()

    @property
    def capacity(self) -> int:
        """Two tasks per worker: one runs, one waits."""
        return 2 * self._jobs

    def start(self, task: Task) -> None:
        """Queue a task for the next idle worker."""
        if self._threads is None:
            start_warm_process()  # in this thread, with which it ends
            self._threads = ThreadPoolExecutor(self._jobs)
        call = _Call(task)
        make_call = partial(self._call_in_process, call)
        self._calls[self._threads.submit(run_task, task, make_call)] = call

    def collect(self) -> list[tuple[Task, Outcome]]:
        """Wait for a task to finish, at most `_POLL_INTERVAL`, and kill what is over its time limit.

        Returns:
            The finished tasks and their outcomes.

        """
        done, _ = wait(self._calls, timeout=_POLL_INTERVAL, return_when=FIRST_COMPLETED)
        self._kill_overdue()
        return [(self._calls.pop(future).task, future.result()) for future in done]

    def _kill_overdue(self) -> None:
        """Kill the workers of tasks over their time limit.

        While this process is stopped, as by Ctrl-Z, that time does not count.
        """
        now = time.monotonic()
        self._clock += min(now - self._last_poll, _MAX_POLL_GAP)
        self._last_poll = now
        with self._lock:
            for call in self._calls.values():
                if call.process is None:
                    continue
                if call.started is None:
                    call.started = self._clock
                elif self._clock - call.started > call.task.limits.seconds:
                    call.is_overdue = True
                    call.process.kill()

    def _call_in_process(
        self, call: _Call, name: str, function: Callable[..., Any], arguments: Sequence[Any], python: str
    ) -> Reply:
        """Make a call in a process that runs nothing but ``name``."""
        with self._lock:
            idle = self._idle.setdefault(name, [])
            process = idle.pop() if idle else None
        reply = Reply()
        try:
            process = process or self._start_process()
            with self._lock:
                call.process = process
                if self._is_closed or call.is_overdue:
                    process.kill()
            reply = process.call(function, arguments, python, self.limits.gigabytes)
        except (WorkerLost, OSError) as lost:
            reply = Reply(failure=f"crashed: the worker {lost}", is_lost=True)
        with self._lock:
            call.process = None
            is_lost = reply.is_lost or self._is_closed or call.is_overdue
            if process is not None and not is_lost:
                self._idle[name].append(process)
        if process is not None and is_lost:
            process.end()
        if call.is_overdue:
            seconds = call.task.limits.seconds
            failure = f"timeout: no answer within {seconds:g} s, worker killed"
            return Reply(failure=failure, is_lost=True, is_overdue=True)
        return reply

    def _start_process(self) -> WorkerProcess:
        arguments = str(self._scratch.path), self.limits.gigabytes, os.getpid(), worker_environment()
        return WorkerProcess(start_warm_process(), worker_process.initialize_worker, arguments)


class _Judged(NamedTuple):
    """What a judge made of an answer."""

    result: Any = None
    is_answer_needed: bool = True
    unreadable: str = ""  # why the pickle of the answer cannot be loaded: the engine's fault


def run_task(task: Task, make_call: Callable[..., Reply] | None = None) -> Outcome:
    """Make a task's call, and have its answer judged.

    Args:
        make_call: makes a call in a process of a name: (name, function, arguments, interpreter) → reply;
            None to make it in this process.

    """
    make_call = make_call or _call_here
    reply = make_call(task.engine, task.function, task.arguments, task.python)
    outcome = Outcome(
        task.key,
        reply.answer,
        reply.failure,
        reply.cpu_time,
        overhead_cpu_time=reply.overhead_cpu_time,
        is_overdue=reply.is_overdue,
        is_out_of_memory=reply.is_out_of_memory,
    )
    if task.judge is None or reply.answer is None:
        return outcome
    arguments = task.judge, task.needs_answer, reply.answer.data, *task.judge_arguments
    judging = make_call("", _judge_answer, arguments, "")
    outcome = replace(
        outcome,
        judge_failure=judging.failure or "",
        judge_cpu_time=judging.cpu_time,
        overhead_cpu_time=reply.overhead_cpu_time + judging.overhead_cpu_time,
    )
    if judging.answer is None:
        return outcome
    judged: _Judged = judging.answer.load()
    if judged.unreadable:
        return Outcome(task.key, failure=f"the answer cannot be read: {judged.unreadable}")
    value = reply.answer if judged.is_answer_needed else None
    return replace(outcome, raw_value=value, judge_result=judged.result)


def _call_here(_: str, function: Callable[..., Any], arguments: Sequence[Any], python: str) -> Reply:
    return make_reply(pickle.dumps((function, tuple(arguments), python, 0.0), protocol=5))


def _judge_answer(
    judge: Callable[..., Any], needs_answer: Callable[[Any], bool] | None, data: bytes, *arguments: Any
) -> _Judged:
    try:
        # a copy, whose arrays lie in memory alike wherever the call was made: sums depend on that
        answer = pickle.loads(data)
    except MemoryError:
        raise
    except Exception as error:
        return _Judged(unreadable=describe_exception(error))
    result = judge(*arguments, answer)
    return _Judged(result, needs_answer is None or needs_answer(result))
