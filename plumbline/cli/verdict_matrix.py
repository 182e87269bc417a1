"""The matrix of verdicts, scenarios × engines, on the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.markup import escape
from rich.table import Table

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.environments import split_version
from plumbline.judging.rows import Row, Verdict

VERDICT_COLOURS = {
    Verdict.AGREES: "green", Verdict.DISAGREES: "red bold", Verdict.UNRESOLVED: "yellow",
    Verdict.UNSUPPORTED: "dim", Verdict.NOT_INSTALLED: "dim", Verdict.FAILED: "red bold",
    Verdict.HARNESS_FAILED: "magenta bold",
    Verdict.INFORMATION: "dim",
}  # fmt: skip
MAX_COMPLETE_TABLE = 60  # scenarios; of more, those where everything agrees are left out of the table


class VerdictMatrix:
    """The rows of a run by scenario, worst scenario first.

    Attributes:
        scenario_count: number of scenarios with rows.

    """

    def __init__(self, engines: Mapping[str, EngineInfo]) -> None:
        """Start without rows."""
        self._engines = engines
        self._rows: dict[str, list[Row]] = {}

    @property
    def scenario_count(self) -> int:
        """Number of scenarios."""
        return len(self._rows)

    def add_rows(self, scenario: str, rows: Sequence[Row]) -> None:
        """Add rows of a scenario."""
        self._rows.setdefault(scenario, []).extend(rows)

    def replace_rows(self, scenario: str, rows: Sequence[Row]) -> None:
        """Replace the rows of a scenario."""
        self._rows[scenario] = list(rows)

    def table(self, max_lines: int | None = None) -> Table:
        """Format the matrix.

        Args:
            max_lines: scenarios to show; None for all.

        Returns:
            One line per scenario, those with the worst verdict first.

        """
        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("scenario")
        for name, info in self._engines.items():
            table.add_column(escape(engine_heading(name, info.version)))
        shown = list(self._rows)
        if len(shown) > MAX_COMPLETE_TABLE:
            shown = [name for name in shown if self._is_remarkable(name)]
        for scenario in sorted(shown, key=self._severity, reverse=True)[:max_lines]:
            of = ([r for r in self._rows[scenario] if r.engine == engine] for engine in self._engines)
            table.add_row(escape(scenario), *map(_format_cell, of))
        return table

    def line(self, scenario: str) -> str:
        """Format the cells of a scenario."""
        of = {engine: [r for r in self._rows[scenario] if r.engine == engine] for engine in self._engines}
        cells = ", ".join(f"{engine} {_format_cell(rows)}" for engine, rows in of.items() if rows)
        return f"{escape(scenario)}: {cells}"

    def _severity(self, scenario: str) -> int:
        return max((row.rank[0] for row in self._rows[scenario]), default=-1)

    def _is_remarkable(self, scenario: str) -> bool:
        return any(r.verdict not in (Verdict.AGREES, Verdict.INFORMATION) for r in self._rows[scenario])


def coloured_glyph(row: Row) -> str:
    """Format the glyph of a row's verdict.

    Returns:
        The glyph as rich markup, dimmed where a known issue expects the verdict.

    """
    colour = "dim" if row.known_issue else VERDICT_COLOURS[row.verdict]
    return f"[{colour}]{row.style.glyph}[/]"


def engine_heading(name: str, version: str) -> str:
    """Write an engine with its version once: ``mujoco@3.12.0`` becomes "mujoco 3.12.0".

    Args:
        name: the engine as it was named on the command line.
        version: the installed version; empty where the engine is not installed.

    Returns:
        The heading of the engine's column.

    """
    base, requested = split_version(name)
    return f"{base if requested == version else name} {version}".strip()


def _format_cell(rows: Sequence[Row]) -> str:
    """Return one cell of the matrix: the worst row's glyph, the counts and the worst row's ratio."""
    if not rows:
        return ""
    worst = max(rows, key=lambda row: row.rank)
    agreeing = sum(row.verdict == Verdict.AGREES for row in rows)
    checks = sum(row.verdict != Verdict.INFORMATION for row in rows)
    ratio = "" if worst.ratio is None else f" {worst.ratio:.1g}"
    return f"{coloured_glyph(worst)} {agreeing}/{checks}{ratio}"
