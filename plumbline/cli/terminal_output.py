"""What a run prints on the terminal: progress, findings, and where it is wanted the matrix of verdicts."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import click
from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from plumbline.cli.findings_output import WIDTH, describe_run, legend, wrap
from plumbline.cli.verdict_matrix import VerdictMatrix, matrix_of_rows
from plumbline.execution.plan import ProgressCallback
from plumbline.execution.runner import RunResult
from plumbline.judging.findings import Finding
from plumbline.judging.rows import SHOWN_STYLES, Row, Verdict

MAX_WIDTH = 160  # columns of a wide terminal that sentences use
PIPED_WIDTH = 10_000  # columns: in a pipe or a log nothing is cut or wrapped, unless COLUMNS is set


def make_console(file: Any) -> Console:
    """Make a console of the terminal's width; piped, of the width COLUMNS, or wide enough for all tables.

    Args:
        file: an open text file, as sys.stdout.

    """
    columns = os.environ.get("COLUMNS", "")
    is_set = file.isatty() or (columns.isdecimal() and int(columns) > 0)
    return Console(file=file, width=None if is_set else PIPED_WIDTH, highlight=False)


def line_width(out: Console) -> int:
    """Return the width of sentences: that of a terminal or of COLUMNS; in a pipe 80 columns."""
    return WIDTH if out.width == PIPED_WIDTH else min(out.width, MAX_WIDTH)


def wrap_items(items: Iterable[str], width: int) -> str:
    """Write items side by side and begin a line before one that does not fit; none is broken.

    Args:
        items: texts without line breaks.
        width: of the lines, in columns.

    """
    lines = [""]
    for item in items:
        if lines[-1] and cell_len(lines[-1]) + 2 + cell_len(item) > width:
            lines.append("")
        lines[-1] += f"  {item}" if lines[-1] else item
    return "\n".join(lines)


def command_line() -> str:
    """Write the command as it can be typed again.

    Returns:
        The line for a shell.

    """
    return shlex.join(["python", "-m", "plumbline", *sys.argv[1:]])


def count_noun(count: int, singular: str, plural: str = "") -> str:
    """Write a number with its noun, as "1 body" or "2 bodies".

    Args:
        singular: the noun for one.
        plural: the noun for several; absent: ``singular`` with an s.

    """
    return f"{count} {singular if count == 1 else plural or singular + 's'}"


def log(sentence: str) -> None:
    """Print a sentence on stderr."""
    click.echo(sentence, err=True)


def print_json(document: Any) -> None:
    """Print a document on stdout, for other programs."""
    click.echo(json.dumps(document, ensure_ascii=False, indent=1))


def print_table(records: Iterable[Mapping[str, Any]], title: str | None = None) -> None:
    """Print records as a table on stdout; nothing where there are none.

    Args:
        records: rows that have the same keys, which become the header.

    """
    table = Table(box=None, pad_edge=False, header_style="bold", title=title)
    for record in records:
        if not table.columns:
            for name in record:
                table.add_column(name, overflow="fold")
        table.add_row(*(escape(_format_value(value)) for value in record.values()))
    if table.columns:
        make_console(sys.stdout).print(table)


def _format_value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return "" if value is None else ", ".join(value) if isinstance(value, list) else str(value)


class ProgressDisplay:
    """A progress bar on a terminal; elsewhere a line after each tenth of the tasks."""

    def __init__(self, file: Any) -> None:
        self.bar = Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
            console=Console(file=file), transient=True, disable=not file.isatty(),
        )  # fmt: skip
        self.file = file
        self.last_tenth = 0

    def __enter__(self) -> ProgressCallback:
        """Start the bar; the value is the function to call after each task."""
        self.bar.start()
        self.task = self.bar.add_task("running", total=None)
        return self.update

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        self.bar.stop()

    def update(self, done: int, total: int, task_name: str) -> None:
        """Show how far the run is.

        Args:
            total: tasks that are known so far.
            task_name: the task that finished last.

        """
        self.bar.update(self.task, completed=done, total=total, description=escape(task_name[:48].ljust(48)))
        if not self.file.isatty() and done * 10 // total > self.last_tenth:
            self.last_tenth = done * 10 // total
            print(f"{done} of {total} tasks done", file=self.file, flush=True)


def print_matrix(matrix: VerdictMatrix) -> None:
    """Print the matrix of verdicts and its legend on stdout."""
    out = make_console(sys.stdout)
    for line in matrix.heads():
        out.print(escape(line))
    out.print(matrix.table())
    legend = wrap_items((f"{style.glyph} {shown}" for shown, style in SHOWN_STYLES.items()), out.width)
    out.print(f"[dim]each cell: worst verdict, its error over tolerance\n{legend}[/]")


def print_findings(
    rows: Sequence[Row], findings: Sequence[Finding], verdict_count: Mapping[Verdict, int] | None = None
) -> None:
    """Print findings and families.

    Args:
        verdict_count: rows of random scenarios that are only counted.

    """
    out = make_console(sys.stdout)
    for line in describe_run(rows, findings, line_width(out), verdict_count or {}):
        out.print(line)
    print_legend(rows)


def print_legend(rows: Iterable[Row]) -> None:
    """Print the glyphs of rows with their words on stdout."""
    out = make_console(sys.stdout)
    out.print(f"[dim]{escape(wrap_items(legend(rows), line_width(out)))}[/]")


def print_result(result: RunResult, *, has_matrix: bool = False) -> None:
    """Print what a run found.

    Args:
        has_matrix: whether to print the cells, scenarios × engines, too.

    """
    out = make_console(sys.stdout)

    def print_sentence(text: str, style: str) -> None:
        for line in wrap(text, line_width(out), ""):
            out.print(f"[{style}]{escape(line)}[/]")

    in_doubt = {row.reason: None for row in result.rows if row.verdict == Verdict.HARNESS_FAILED}
    for reason in in_doubt:
        print_sentence(f"{Verdict.HARNESS_FAILED.style.glyph} the harness failed: {reason}", "magenta bold")
    if has_matrix:
        print_matrix(matrix_of_rows(result.rows, result.engines))
    print_findings(result.rows, result.findings, result.random_batch.counts_by_verdict)
    for sentence in result.wide_issues:
        print_sentence(f"i {sentence}", "yellow")
    for entry in result.stale_issues:
        print_sentence(f"! known entry {entry.id} no longer occurs: remove it from its file", "red")
    print_sentence(result.metadata["sentence"], "bold")
