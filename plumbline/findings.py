"""What judging yields: rows about a subject, and the tables behind them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from plumbline.records import Level, Row, Verdict


@dataclass(frozen=True)
class Subject:
    """Who is judged, on what."""

    scenario: str
    family: str
    engine: str
    title: str
    version: str

    def row(
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
class Findings:
    """Rows and the tables behind them, as the store keeps them: column name → value per record."""

    rows: list[Row] = field(default_factory=list)
    states: list[dict[str, Any]] = field(default_factory=list)
    convergence: list[dict[str, Any]] = field(default_factory=list)
    curves: list[dict[str, Any]] = field(default_factory=list)
    trajectories: list[dict[str, Any]] = field(default_factory=list)

    def extend(self, other: Findings) -> None:
        """Take in another's rows and tables."""
        self.rows += other.rows
        for name, table in self.tables().items():
            table += getattr(other, name)

    def tables(self) -> dict[str, list[dict[str, Any]]]:
        """The tables by their name in the store."""
        return {name: getattr(self, name) for name in ("states", "convergence", "curves", "trajectories")}
