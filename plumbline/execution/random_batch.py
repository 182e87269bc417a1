"""Random scenarios: rows that need no look are counted, the others are kept."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from plumbline.judging.rows import Row, Verdict


@dataclass
class RandomBatch:
    """Counts over the random scenarios of a run, in a size that does not depend on their number."""

    scenario_count: int = 0
    counts_by_verdict: Counter[Verdict] = field(default_factory=Counter)  # of rows that are not kept
    # by engine and quantity: the worst ratio of rows that are not kept, and its scenario
    worst_ratios: dict[tuple[str, str], tuple[float, str]] = field(default_factory=dict)

    def add_scenario(self, rows: Sequence[Row]) -> list[Row]:
        """Count the rows of a scenario.

        Args:
            rows: all its rows, known issues marked.

        Returns:
            The rows to keep: all of the engines with a row that needs a look.

        """
        self.scenario_count += 1
        kept = {row.engine for row in rows if _needs_a_look(row)}
        for row in rows:
            if row.engine in kept:
                continue
            self.counts_by_verdict[row.verdict] += 1
            if row.ratio is not None:
                cell = row.engine, row.quantity
                self.worst_ratios[cell] = max(
                    (row.ratio, row.scenario), self.worst_ratios.get(cell, (-1.0, ""))
                )
        return [row for row in rows if row.engine in kept]

    def summary(self) -> dict[str, Any]:
        """Summarize the random scenarios for results.json.

        Returns:
            Their number, the counts by verdict and the worst ratio by engine and quantity.

        """
        return {
            "scenarios": self.scenario_count,
            "counts_by_verdict": dict(self.counts_by_verdict),
            "worst_ratios": [
                {"engine": engine, "quantity": quantity, "ratio": ratio, "scenario": scenario}
                for (engine, quantity), (ratio, scenario) in self.worst_ratios.items()
            ],
        }


def _needs_a_look(row: Row) -> bool:
    """Whether a row is neither agreement nor a recorded gap; other recorded verdicts are shown too."""
    if row.verdict == Verdict.UNSUPPORTED:
        return not row.known_issue
    return Verdict(row.verdict).needs_attention
