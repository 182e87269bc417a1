"""Timing of several calls in turn, so that other load on the machine affects all of them alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import process_time

import numpy as np


@dataclass(frozen=True)
class Timing:
    """CPU time of one call [s], round by round."""

    rounds: tuple[float, ...]

    @property
    def best(self) -> float:
        """The fastest round: what the code costs when least disturbed."""
        return min(self.rounds)

    def ratio_to(self, other: Timing) -> float:
        """Compare with another call, round by round.

        Args:
            other: times of the other call in the same rounds.

        Returns:
            The median over the rounds of this call's time over the other's.

        """
        return float(np.median(np.array(self.rounds) / other.rounds))


def time_interleaved(
    calls: Mapping[str, Callable[[], object]], rounds: int = 9, min_seconds: float = 0.02
) -> dict[str, Timing]:
    """Time every call once per round, in alternating order, so that a busy machine slows all of them alike.

    Args:
        calls: what is timed, by name.
        min_seconds: CPU time [s] that one timing takes at least; short calls are repeated.

    Returns:
        The CPU time of one call in each round, by name.

    """
    repeats = {name: _repeats_to_fill(call, min_seconds) for name, call in calls.items()}
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds):
        names = list(calls)
        for name in names if turn % 2 else reversed(names):
            call, count = calls[name], repeats[name]
            start = process_time()
            for _ in range(count):
                call()
            times[name].append((process_time() - start) / count)
    return {name: Timing(tuple(spent)) for name, spent in times.items()}


def _repeats_to_fill(call: Callable[[], object], min_seconds: float) -> int:
    """Return how many repeats take at least half of ``min_seconds``, scaled to all of it."""
    count = 1
    while True:
        start = process_time()
        for _ in range(count):
            call()
        spent = process_time() - start
        if spent >= min_seconds / 2:
            return max(1, round(count * min_seconds / spent))
        count *= 4
