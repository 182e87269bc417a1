"""Where a run's CPU time went: what the engines took, and what the harness took to ask and judge them."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

from plumbline.processes.workers import Outcome, ResultCache, Task

CPU_TIME_KINDS = ("engines", "reference", "truth", "diagnosis", "process", "judging", "storage", "report")


class CpuTimes:
    """CPU seconds by kind; "process" is what starting workers and moving questions and answers took."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(CPU_TIME_KINDS, 0.0)

    def add_outcome(self, outcome: Outcome) -> None:
        """Take in what a task's call and its judge took in its worker."""
        subject = outcome.key[1]
        kind = {"truth": "truth", "why": "diagnosis", "reference": "reference"}.get(subject, "engines")
        self.seconds[kind] += outcome.cpu_time
        self.seconds["judging"] += outcome.judge_cpu_time

    @contextmanager
    def measure(self, kind: str) -> Iterator[None]:
        """Count what this process, and its children that end meanwhile, take inside."""
        begin = cpu_time_spent()
        try:
            yield
        finally:
            self.seconds[kind] += cpu_time_spent() - begin

    @contextmanager
    def measure_overhead(self) -> Iterator[None]:
        """What is taken inside and counted by nobody else was process."""
        begin, before = cpu_time_spent(), sum(self.seconds.values())
        yield
        counted = sum(self.seconds.values()) - before
        self.seconds["process"] += max(
            0.0, cpu_time_spent() - begin - counted
        )  # answers from before took nothing now

    def timed_cache(self, result_cache: ResultCache) -> ResultCache:
        """The same memory, what it takes counted as storage."""
        split = self

        class Measured(ResultCache):
            def get(self, task: Task) -> Outcome | None:
                with split.measure("storage"):
                    return result_cache.get(task)

            def put(self, task: Task, outcome: Outcome) -> None:
                with split.measure("storage"):
                    result_cache.put(task, outcome)

        return Measured()

    @property
    def worker_cpu_time(self) -> float:
        """CPU s of the calls in workers."""
        return sum(self.seconds[kind] for kind in ("engines", "reference", "truth", "diagnosis"))

    def summary(self) -> str:
        """The split in words; what is neither an engine's answer nor what it is held to is the harness."""
        total, engines = sum(self.seconds.values()), self.seconds["engines"]
        parts = ", ".join(f"{kind} {s:.1f}" for kind, s in self.seconds.items())
        if not engines:
            return f"CPU {total:.1f} s: {parts}"
        return (
            f"CPU {total:.1f} s: {parts}; over the engines' own time: harness "
            f"{100 * (total - self.worker_cpu_time) / engines:.0f} %, truth and reference "
            f"{100 * (self.worker_cpu_time - engines) / engines:.0f} %"
        )


def cpu_time_spent() -> float:
    """CPU s of this process and of its children that have ended."""
    times = os.times()  # in ticks of 10 ms: too coarse for this process's own time, taken in small parts
    return time.process_time() + times.children_user + times.children_system
