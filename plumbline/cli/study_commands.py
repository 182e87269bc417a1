"""Commands that study one scenario over ranges of parameters or long times: sweep, drift."""

from __future__ import annotations

import collections
import sys
from pathlib import Path

import click
import pyarrow as pa

import reports
from plumbline.cli import options
from plumbline.cli.console import ProgressDisplay, count_noun, print_table
from plumbline.cli.help_texts import EXIT_CODES, examples
from plumbline.execution.exit_codes import ExitCode
from plumbline.judging.rows import Verdict
from plumbline.scenario.errors import ScenarioError

MAX_LISTED_CELLS = 10


@click.command(epilog=EXIT_CODES)
@click.argument("file", metavar="FILE", type=click.Path(path_type=Path))
@options.jobs_option
@options.out_option(Path("sweep"))
def sweep(file: Path, jobs: int, out: Path) -> None:
    """Vary a scenario's parameters over a grid or distributions, as a sweep file says (docs/sweeps.md).

    Writes sweep.parquet, one row per cell and implementation, and its map, sweep.html.
    """
    from plumbline.studies import sweep as sweeps
    from plumbline.studies import sweep_file
    from plumbline.studies.tables import write_table
    from reports import sweep_page

    try:
        spec, cells = sweep_file.load(file)
    except ScenarioError as error:
        options.exit_on_bad_file(error)
    folder = options.ensure_writable(out)
    with options.exit_on_io_error():
        table = sweeps.run(spec, cells, jobs)
        path = write_table(table, folder / "sweep.parquet")
        page = sweep_page.write(folder)
    _print_sweep(table, len(cells))
    click.echo(f"results: {path}")
    click.echo(f"map: {page}")
    sys.exit(_sweep_exit_code(set(table["verdict"].to_pylist())))


def _sweep_exit_code(verdicts: set[str]) -> ExitCode:
    """Return the exit code of a sweep; its file names the engines, so that a missing one has failed."""
    if Verdict.HARNESS_FAILED in verdicts:
        return ExitCode.HARNESS_FAILED
    if verdicts & {Verdict.FAILED, Verdict.NOT_INSTALLED}:
        return ExitCode.ENGINE_FAILED
    return ExitCode.SUCCESS if verdicts == {Verdict.AGREES} else ExitCode.DISAGREEMENT


def _print_sweep(table: pa.Table, cell_count: int) -> None:
    """Print how often each implementation got each verdict, and the first cells that do not agree."""
    rows = table.to_pylist()
    counts = collections.Counter((row["implementation"], row["verdict"]) for row in rows)
    shown = "; ".join(f"{name} {verdict} {count}" for (name, verdict), count in sorted(counts.items()))
    click.echo(f"{count_noun(cell_count, 'cell')}: {shown}")
    disagreeing = [row for row in rows if row["verdict"] != Verdict.AGREES]
    for row in disagreeing[:MAX_LISTED_CELLS]:
        click.echo(f"cell {row['cell']}, {row['implementation']}: {row['verdict']}: {row['reason']}")


@click.command(
    epilog=examples("drift", "drift double-tumbling-rods --max-cpu-seconds 30 --out results"),
)
@options.names_argument
@click.option(
    "--rtol",
    "rtols",
    type=options.FiniteNumber(1e-14, 1e-2),
    multiple=True,
    default=(1e-6, 1e-9, 1e-12),
    help="Relative tolerance of the integration (may be repeated).",
)
@click.option(
    "--max-cpu-seconds",
    type=options.FiniteNumber(0, min_open=True),
    default=120.0,
    help="CPU seconds that one run may take; later times are left out where they would cost more.",
)
@options.out_option(options.DEFAULT_OUT)
def drift(names: tuple[str, ...], rtols: tuple[float, ...], max_cpu_seconds: float, out: Path) -> None:
    """Measure the drift of raw, Baumgarte and projected runs in 10, 100, 1000 s (default: two scenarios).

    Writes drift.parquet, and report.html again where OUT holds results: the report shows the table.
    """
    from plumbline.studies import drift as drifts
    from plumbline.studies.tables import write_table

    chosen = options.read_scenarios(names or ("tumbling-ball", "tumbling-rod"))
    folder = options.ensure_writable(out)
    with options.exit_on_io_error():
        with ProgressDisplay(sys.stderr) as progress:
            table = drifts.measure_drift(
                chosen,
                max_cpu_seconds,
                rtols=rtols,
                progress=progress,
                log=lambda sentence: click.echo(sentence, err=True),
            )
        path = write_table(table, folder / "drift.parquet")
        print_table(table.to_pylist())
        click.echo(f"results: {path}")
        if (folder / "results.json").is_file():
            click.echo(f"report: {reports.write(folder)}")
    has_failed = any(reason.startswith("failed") for reason in table["reason"].to_pylist())
    sys.exit(ExitCode.ENGINE_FAILED if has_failed else ExitCode.SUCCESS)
