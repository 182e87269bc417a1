"""What judging yields: rows about a subject, and the tables behind them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from plumbline.model.datatypes import Level, Row, Verdict

Columns = dict[str, Any]  # column name → its values (n,), or the one value of all n records


@dataclass(frozen=True)
class RowContext:
    """Who is judged, on what."""

    scenario: str
    family: str
    engine: str
    title: str
    version: str

    def make_row(
        self,
        level: Level,
        integrator: str,
        quantity: str,
        verdict: Verdict,
        reason: str,
        unit: str = "1",
        **more: Any,
    ) -> Row:
        """A row about this subject."""
        more = {"value": None, "tolerance": None} | more
        return Row(
            self.scenario, self.family, self.engine, self.version, level, integrator, quantity, unit,
            verdict=verdict, reason=reason, **more,
        )  # fmt: skip


@dataclass
class JudgingResult:
    """Rows, and parts of the tables behind them by their name in the store."""

    rows: list[Row] = field(default_factory=list)
    tables: list[tuple[str, Columns]] = field(default_factory=list)
