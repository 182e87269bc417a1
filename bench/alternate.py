"""Timing of several contenders in turn, so that a busy machine is busy for all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import process_time

import numpy as np


@dataclass(frozen=True)
class Timing:
    """CPU seconds per call of one contender, round by round."""

    rounds: tuple[float, ...]

    @property
    def best(self) -> float:
        """The fastest round: what the code costs when least disturbed."""
        return min(self.rounds)

    def ratio_to(self, other: Timing) -> float:
        """Median over the rounds of this one's time over the other's of the same round."""
        return float(np.median(np.array(self.rounds) / other.rounds))


def time_interleaved(
    contenders: Mapping[str, Callable[[], object]], rounds: int = 9, min_seconds: float = 0.02
) -> dict[str, Timing]:
    """Time every contender once per round, for at least ``least`` s of CPU each, in alternating order."""
    calls = {name: _calls_to_fill(call, min_seconds) for name, call in contenders.items()}
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for turn in range(rounds):
        names = list(contenders)
        for name in names if turn % 2 else reversed(names):
            call, count = contenders[name], calls[name]
            start = process_time()
            for _ in range(count):
                call()
            times[name].append((process_time() - start) / count)
    return {name: Timing(tuple(spent)) for name, spent in times.items()}


def _calls_to_fill(call: Callable[[], object], min_seconds: float) -> int:
    """How many calls fill ``least`` seconds."""
    count = 1
    while True:
        start = process_time()
        for _ in range(count):
            call()
        spent = process_time() - start
        if spent >= min_seconds / 2:
            return max(1, round(count * min_seconds / spent))
        count *= 4
