"""Where a run's CPU time went: the engines, the truth, and the harness around them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from plumbline.processes.worker_pool import Outcome, ResultCache, Task

CPU_TIME_KINDS = ("engines", "reference", "truth", "diagnosis", "process", "judging", "storage", "report")
MIN_ENGINE_TIME = 5.0  # s


class CpuTimes:
    """CPU time by kind.

    Attributes:
        seconds: CPU time [s] by kind of `CPU_TIME_KINDS`; "process" is starting workers and moving data.
        cached_count: number of tasks whose answer was in the result cache.

    """

    def __init__(self) -> None:
        """Start with zero seconds of every kind."""
        self.seconds = dict.fromkeys(CPU_TIME_KINDS, 0.0)
        self.cached_count = 0
        self._measured = 0.0  # s of this process, counted by `measure`

    def add_outcome(self, outcome: Outcome, kind: str) -> None:
        """Count what a task took in its worker: the call, its judge, imports and transfer.

        An answer from the result cache took nothing.

        Args:
            kind: the kind of the call, of `CPU_TIME_KINDS`.

        """
        if outcome.is_cached:
            self.cached_count += 1
            return
        self.seconds[kind] += outcome.cpu_time
        self.seconds["judging"] += outcome.judge_cpu_time
        self.seconds["process"] += outcome.overhead_cpu_time

    @contextmanager
    def measure(self, kind: str) -> Iterator[None]:
        """Count what this process takes inside the context.

        Yields:
            Nothing.

        """
        begin = time.process_time()
        try:
            yield
        finally:
            elapsed = time.process_time() - begin
            self.seconds[kind] += elapsed
            self._measured += elapsed

    @contextmanager
    def measure_overhead(self) -> Iterator[None]:
        """Count as "process" what this process takes inside the context and `measure` does not count.

        Yields:
            Nothing.

        """
        begin, before = time.process_time(), self._measured
        yield
        self.seconds["process"] += time.process_time() - begin - (self._measured - before)

    def timed_cache(self, result_cache: ResultCache) -> ResultCache:
        """Wrap a result cache so that its work is counted as storage.

        Returns:
            A cache with the same content.

        """
        times = self

        class TimedCache(ResultCache):
            def get(self, task: Task) -> Outcome | None:
                with times.measure("storage"):
                    return result_cache.get(task)

            def put(self, task: Task, outcome: Outcome) -> Outcome:
                with times.measure("storage"):
                    return result_cache.put(task, outcome)

        return TimedCache()

    def summary(self) -> str:
        """Describe the CPU times in words.

        Returns:
            The total, the seconds by kind, and the harness's time over the engines' own; of less than
            `MIN_ENGINE_TIME` of the engines a ratio would say nothing.

        """
        total, engines = sum(self.seconds.values()), self.seconds["engines"]
        parts = ", ".join(f"{kind} {s:.1f}" for kind, s in self.seconds.items())
        if engines < MIN_ENGINE_TIME:
            return f"CPU {total:.1f} s: {parts}"
        calls = sum(self.seconds[kind] for kind in ("engines", "reference", "truth", "diagnosis"))
        return (
            f"CPU {total:.1f} s: {parts}; as a share of the engines' time: harness "
            f"{100 * (total - calls) / engines:.0f} %, truth and reference "
            f"{100 * (calls - engines) / engines:.0f} %"
        )
