"""What a run tells on the terminal: progress, the matrix, the sentences of what does not agree."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from plumbline.execution.runner import RunResult
from plumbline.judging.rows import Row, Verdict


def make_console(file: Any) -> Console:
    """A console that wraps to the terminal, or never where the output is piped."""
    return Console(file=file, width=None if file.isatty() else 200, highlight=False)


class ProgressDisplay:
    """A progress bar on a terminal, plain lines (each tenth) otherwise."""

    def __init__(self, file: Any) -> None:
        self.bar = Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
            console=Console(file=file), transient=True, disable=not file.isatty(),
        )  # fmt: skip
        self.file = file
        self.last_tenth = 0

    def __enter__(self) -> Callable[[int, int, str], None]:
        """The function to call after each task."""
        self.bar.start()
        self.task = self.bar.add_task("running", total=None)
        return self.update

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        self.bar.stop()

    def update(self, done: int, total: int, task_name: str) -> None:
        """Show how far the run is."""
        self.bar.update(self.task, completed=done, total=total, description=escape(task_name[:48].ljust(48)))
        if not self.file.isatty() and done * 10 // total > self.last_tenth:
            self.last_tenth = done * 10 // total
            print(f"{done} of {total} tasks done", file=self.file, flush=True)


VERDICT_COLOURS = {
    Verdict.AGREES: "green", Verdict.DISAGREES: "red bold", Verdict.UNRESOLVED: "yellow",
    Verdict.UNSUPPORTED: "dim", Verdict.NOT_INSTALLED: "dim", Verdict.FAILED: "red bold",
}  # fmt: skip
MAX_COMPLETE_TABLE = 60  # scenarios; of more, those where everything agrees are left out of the table


def print_result(result: RunResult) -> None:
    """The matrix of scenario × engine, the sentences of what does not agree, the verdict."""
    out = make_console(sys.stdout)
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("scenario")
    for name, info in result.engines.items():
        table.add_column(f"{name} {info.version}".strip())
    rows_of: dict[str, list[Row]] = {scenario: [] for scenario in result.scenarios}
    for row in result.rows:
        rows_of[row.scenario].append(row)
    for scenario in result.scenarios:
        of = [[r for r in rows_of[scenario] if r.engine == engine] for engine in result.engines]
        if len(result.scenarios) <= MAX_COMPLETE_TABLE or any(
            r.verdict != Verdict.AGREES for rows in of for r in rows
        ):
            table.add_row(escape(scenario), *map(format_cell, of))
    out.print(table)
    out.print(
        "[dim]each cell: worst verdict, agreeing rows / all rows, error over tolerance of the worst row; "
        + "  ".join(f"{verdict.style.glyph} {verdict}" for verdict in Verdict)
        + "[/]"
    )
    for row in result.rows:
        if row.verdict != Verdict.AGREES and row.known_issue is None:
            out.print(f"{coloured_glyph(row)} {escape(row.key)}: {escape(row.reason)}")
    for entry in result.stale_entries:
        out.print(f"[red]![/] known entry {entry.id} no longer occurs: remove it from known_issues.yaml")
    out.print(f"[bold]{escape(result.metadata['sentence'])}[/]")


def coloured_glyph(row: Row) -> str:
    """Return the verdict's glyph as rich markup, dimmed where a known issue expects the verdict.

    Args:
        row: any judged row.

    Returns:
        Markup for `rich`.

    """
    colour = "dim" if row.known_issue else VERDICT_COLOURS[row.verdict]
    return f"[{colour}]{row.verdict.style.glyph}[/]"


def format_cell(rows: Sequence[Row]) -> str:
    """Return one cell of the matrix: the worst row's glyph, the counts and the worst row's ratio.

    Args:
        rows: all rows of one scenario and engine.

    Returns:
        Markup for `rich`; empty for no rows.

    """
    if not rows:
        return ""
    worst = max(rows, key=lambda row: row.rank)
    agreeing = sum(row.verdict == Verdict.AGREES for row in rows)
    ratio = "" if worst.ratio is None else f" {worst.ratio:.1g}"
    return f"{coloured_glyph(worst)} {agreeing}/{len(rows)}{ratio}"
