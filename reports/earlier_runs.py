"""Earlier runs for the report: the nights of the stored history that were completed before this run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from plumbline.storage import history_of_nights
from reports.stored_results import Record, Results, replace_unprintable
from reports.verdicts import needs_attention

MAX_NIGHTS = 90  # nights that the trend page shows


@dataclass(frozen=True)
class EarlierRun:
    """One earlier run."""

    run: Record  # its entry ``run`` of results.json
    rows: dict[str, Record]  # value, tolerance, ratio, verdict and known issue by row key
    has_passed: bool


@dataclass(frozen=True)
class History:
    """Earlier runs, oldest first."""

    nights: list[EarlierRun] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)  # names of folders that could not be read
    missing_keys: int = 0  # rows of the last passed run, without random scenarios, that the current one lacks

    @classmethod
    def load(cls, folder: Path | None, current: Results) -> History:
        """Read the last nights before a run.

        Args:
            folder: folder of the nights; None for no history.
            current: the run that is reported.

        Returns:
            The nights completed before ``current``; all nights where ``current`` is not among them.

        """
        if folder is None:
            return cls()
        stored = history_of_nights.History(folder)
        keys = [row["key"] for row in current.rows]
        before = stored.before(current.run["id"])[-MAX_NIGHTS:]
        nights = [
            EarlierRun(replace_unprintable(run.metadata), stored.rows_by_key(index, keys), run.has_passed)
            for index, run in before
        ]
        last = next((index for index, run in reversed(before) if run.has_passed), None)
        compared = stored.query("SELECT key FROM rows WHERE night = ? AND family <> 'random'", [last])
        missing = {replace_unprintable(row["key"]) for row in compared} - set(keys)
        return cls(nights, list(stored.damaged), len(missing))

    @property
    def last_passed(self) -> EarlierRun | None:
        """The latest earlier run that ended with exit code 0."""
        return next((night for night in reversed(self.nights) if night.has_passed), None)

    def first_seen(self, rows: Sequence[Record]) -> str | None:
        """Return when a finding was first seen: the start of the earliest of the last nights with it.

        Args:
            rows: of the finding.

        Returns:
            Date and time; None where no earlier night had it, or there is none.

        """
        first = None
        for night in reversed(self.nights):
            before = [night.rows.get(row["key"]) for row in rows]
            if not any(one is not None and one["verdict"] == row["verdict"]
                       for one, row in zip(before, rows, strict=True)):  # fmt: skip
                break
            first = str(night.run["started"])
        return first

    def is_new(self, row: Record) -> bool:
        """Report whether a row's disagreement was not in the last run that passed.

        Returns:
            True where the verdict differs from that run's, or is unexpected and the key is new.

        """
        passed = self.last_passed
        if passed is None or row["verdict"] in ("agrees", "information"):
            return False
        before = passed.rows.get(row["key"])
        return needs_attention(row) if before is None else before["verdict"] != row["verdict"]
