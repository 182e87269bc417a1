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
from plumbline.model.datatypes import Row


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


VERDICT_GLYPHS = {
    "agrees": "[green]✓[/]", "disagrees": "[red bold]✗[/]", "unresolved": "[yellow]?[/]",
    "unsupported": "[dim]–[/]", "not installed": "[dim]∅[/]", "failed": "[red bold]![/]",
}  # fmt: skip
MAX_COMPLETE_TABLE = 60  # scenarios; of more, those where everything agrees are left out of the table
VERDICTS_WORST_FIRST = ("failed", "disagrees", "unresolved", "unsupported", "not installed", "agrees")


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
            r.verdict != "agrees" for rows in of for r in rows
        ):
            table.add_row(escape(scenario), *map(format_cell, of))
    out.print(table)
    out.print(
        "[dim]each cell: agreeing rows / all rows, then the worst error over its tolerance; "
        "✓ agrees  ✗ disagrees  ? unresolved  – unsupported  ∅ not installed  ! failed[/]"
    )
    for row in result.rows:
        if row.verdict != "agrees" and row.known_issue is None:
            out.print(f"{VERDICT_GLYPHS[row.verdict]} {escape(row.key)}: {escape(row.reason)}")
    for entry in result.stale_entries:
        out.print(f"[red]![/] known entry {entry.id} no longer occurs: remove it from known_issues.yaml")
    out.print(f"[bold]{escape(result.metadata['sentence'])}[/]")


def format_cell(rows: Sequence[Row]) -> str:
    """One cell of the matrix: worst verdict that nothing explains, counts, worst error over tolerance."""
    if not rows:
        return ""
    open_rows = [r for r in rows if r.known_issue is None] or rows
    worst = min((r.verdict for r in open_rows), key=VERDICTS_WORST_FIRST.index)
    agreeing = sum(r.verdict == "agrees" for r in rows)
    ratios = [r.extra["ratio"] for r in rows if r.verdict == "agrees" and "ratio" in r.extra]
    return f"{VERDICT_GLYPHS[worst]} {agreeing}/{len(rows)}" + (f" {max(ratios):.1g}" if ratios else "")
