"""Probes: many scenarios at state level, of which only what someone should see is kept one by one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from plumbline.judging.rows import Row, Verdict

# What a probe may say without being looked at: it agrees, or cannot and that is recorded.
UNREMARKABLE_VERDICTS: tuple[Verdict, ...] = (Verdict.AGREES, Verdict.UNSUPPORTED, Verdict.NOT_INSTALLED)


@dataclass
class RandomBatch:
    """What the probes of a run came to, in a size that does not depend on their number."""

    scenario_count: int = 0
    counts_by_verdict: Counter[Verdict] = field(default_factory=Counter)  # rows that are not kept, by verdict
    worst_ratios: dict[tuple[str, str], tuple[float, str]] = field(
        default_factory=dict
    )  # by engine and quantity

    def add_scenario(self, rows: Sequence[Row]) -> list[Row]:
        """Count a probe's rows, known ones marked; those of engines of which one should be seen are kept."""
        self.scenario_count += 1
        seen = {row.engine for row in rows if is_remarkable(row)}
        for row in rows:
            if row.engine in seen:
                continue
            self.counts_by_verdict[row.verdict] += 1
            if row.ratio is not None:
                cell = row.engine, row.quantity
                found = row.ratio, row.scenario
                self.worst_ratios[cell] = max(found, self.worst_ratios.get(cell, (-1.0, "")))
        return [row for row in rows if row.engine in seen]

    def summary(self) -> dict[str, Any]:
        """As results.json holds it."""
        return {
            "scenarios": self.scenario_count,
            "counts_by_verdict": dict(self.counts_by_verdict),
            "worst_ratios": [
                {"engine": engine, "quantity": quantity, "ratio": ratio, "scenario": scenario}
                for (engine, quantity), (ratio, scenario) in self.worst_ratios.items()
            ],
        }


def is_remarkable(row: Row) -> bool:
    """Whether someone should see what is said of a probe, recorded or not."""
    return row.verdict not in UNREMARKABLE_VERDICTS or (
        row.verdict == Verdict.UNSUPPORTED and not row.known_issue
    )
