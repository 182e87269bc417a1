"""The matrix of verdicts, scenarios × engines, on the terminal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from string import ascii_uppercase

from rich.markup import escape
from rich.table import Table

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.environments import split_version
from plumbline.judging.rows import SHOWN_STYLES, Row, Verdict, shown_verdict

VERDICT_COLOURS = {
    Verdict.AGREES: "green", Verdict.DISAGREES: "red bold", Verdict.UNRESOLVED: "yellow",
    Verdict.UNSUPPORTED: "dim", Verdict.NOT_INSTALLED: "dim", Verdict.FAILED: "red bold",
    Verdict.HARNESS_FAILED: "magenta bold",
    Verdict.INFORMATION: "dim",
}  # fmt: skip


class VerdictMatrix:
    """The rows of a run by scenario, worst scenario first."""

    def __init__(self, engines: Mapping[str, EngineInfo]) -> None:
        """Start without rows."""
        self._engines = engines
        self._rows: dict[str, list[Row]] = {}

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
        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
        table.add_column("scenario")
        for letter, _ in zip(ascii_uppercase, self._engines, strict=False):
            table.add_column(letter)
        for scenario in sorted(self._rows, key=self._severity, reverse=True)[:max_lines]:
            of = ([r for r in self._rows[scenario] if r.engine == engine] for engine in self._engines)
            table.add_row(escape(scenario), *map(_format_cell, of))
        return table

    def heads(self) -> list[str]:
        """List the engines of the columns."""
        names = [engine_heading(name, info.version) for name, info in self._engines.items()]
        return [f"{letter} {name}" for letter, name in zip(ascii_uppercase, names, strict=False)]

    def line(self, scenario: str) -> str:
        """Count the verdicts of a scenario."""
        counts = Counter(shown_verdict(row.verdict, row.known_issue) for row in self._rows[scenario])
        parts = (f"{style.glyph} {counts[word]}" for word, style in SHOWN_STYLES.items() if counts[word])
        return f"{escape(scenario)}: {' '.join(parts)}"

    def _severity(self, scenario: str) -> int:
        return max((row.rank[0] for row in self._rows[scenario]), default=-1)


def matrix_of_rows(rows: Iterable[Row], engines: Mapping[str, EngineInfo]) -> VerdictMatrix:
    """Make the matrix of a finished run."""
    matrix = VerdictMatrix(engines)
    for row in rows:
        matrix.add_rows(row.scenario, [row])
    return matrix


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
    """Return one cell of the matrix: the worst row's glyph and ratio."""
    if not rows:
        return ""
    worst = max(rows, key=lambda row: row.rank)
    ratio = "" if worst.ratio is None else f" {worst.ratio:.1g}".replace("e+0", "e").replace("e+", "e")
    return f"{coloured_glyph(worst)}{ratio}"
