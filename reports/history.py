"""Earlier runs: every folder of HISTORY with a results.json; a damaged one is named and skipped."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from reports.results import Record, Results
from reports.verdicts import needs_attention

MAX_NIGHTS = 90  # nights that the trend page shows


@dataclass(frozen=True)
class EarlierRun:
    """One earlier run: its ``run`` record and its rows by key."""

    run: Record
    rows: dict[str, Record]

    @property
    def has_passed(self) -> bool:
        """Nothing disagreed, failed or was missing without being expected."""
        return self.run.get("exit_code") == 0


@dataclass(frozen=True)
class History:
    """Earlier runs in the order they started, and what could not be read."""

    nights: list[EarlierRun] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)

    @classmethod
    def load(cls, folder: Path | None, current: Results) -> History:
        """Read HISTORY/*/results.json except the current run's own; none for a folder of None."""
        nights, damaged = [], []
        for path in sorted(folder.glob("*/results.json")) if folder else []:
            try:
                stored = Results.load(path.parent)
                night = EarlierRun(stored.run, {row["key"]: row for row in stored.rows})
                if not isinstance(stored.run["started"], str):
                    raise ValueError("started is not a text")
            except (OSError, ValueError, KeyError, TypeError, AttributeError):
                damaged.append(path.parent.name)
                continue
            if stored.run["id"] != current.run["id"] and stored.run["started"] <= current.run["started"]:
                nights.append(night)
        nights.sort(key=lambda night: night.run["started"])
        return cls(nights[-MAX_NIGHTS:], damaged)

    @property
    def last_passed(self) -> EarlierRun | None:
        """The latest earlier run that ended with exit code 0."""
        return next((night for night in reversed(self.nights) if night.has_passed), None)

    def is_new(self, row: Record) -> bool:
        """Does not agree, and did not say so in the last green run (or is new and unexpected)."""
        green = self.last_passed
        if green is None or row["verdict"] == "agrees":
            return False
        before = green.rows.get(row["key"])
        return needs_attention(row) if before is None else before["verdict"] != row["verdict"]
