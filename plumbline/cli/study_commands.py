"""Commands that study scenarios beyond one run: sweep, drift, coverage."""

from __future__ import annotations

import collections
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import click
import pyarrow as pa

import reports
from plumbline import layout
from plumbline.cli import options
from plumbline.cli.help_texts import command, examples
from plumbline.cli.terminal_output import ProgressDisplay, count_noun, log, print_json, print_table
from plumbline.engines.registry import ENGINES
from plumbline.execution.exit_codes import ExitCode
from plumbline.execution.plan import Plan
from plumbline.execution.runner import run_plan
from plumbline.judging.rows import Level, Verdict
from plumbline.judging.smallest_detectable_mistake import COVERED_LEVELS
from plumbline.model.sampling import RANDOM_STATES
from plumbline.processes.worker_pool import Limits, WorkerPool
from plumbline.scenario.line_and_column_errors import ScenarioError
from plumbline.scenario.loader import Scenario

MAX_LISTED_CELLS = 10


@command()
@click.argument("file", metavar="FILE", type=click.Path(path_type=Path))
@options.jobs_option
@options.out_option(layout.output_folder("sweep"))
@options.limits_options(300.0)
def sweep(file: Path, jobs: int, out: Path, limits: Limits) -> None:
    """Vary a scenario's parameters over a grid or distributions, as a sweep file says (docs/sweeps.md).

    Writes sweep.parquet, one row per cell and implementation, and its map, sweep.html.
    """
    from plumbline.execution.runner import describe_engines
    from plumbline.studies import sweep as sweeps
    from plumbline.studies import sweep_file
    from plumbline.studies.parquet_files import write_table
    from reports import sweep_page

    try:
        with ProgressDisplay(sys.stderr) as progress:
            spec, cells = sweep_file.load(file, progress)
        folder = options.claim_folder(out)
        with options.exit_on_io_error(), WorkerPool(jobs, limits) as workers:
            engines = describe_engines(workers, list(spec.engines))
            sweep_file.check_integrators(file, spec, engines)
            with ProgressDisplay(sys.stderr) as progress:
                table = sweeps.run(spec, cells, workers, engines, progress)
    except ScenarioError as error:
        options.exit_on_bad_file(error)
    with options.exit_on_io_error():
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
@options.out_option(layout.DEFAULT_OUT)
def drift(names: tuple[str, ...], rtols: tuple[float, ...], max_cpu_seconds: float, out: Path) -> None:
    """Measure the drift of raw, Baumgarte and projected runs in 10, 100, 1000 s (default: two scenarios).

    Writes drift.parquet, and report.html again where OUT holds results: the report shows the table.
    """
    from plumbline.studies import drift as drifts
    from plumbline.studies.parquet_files import write_table

    chosen = options.read_scenarios(names or ("tumbling-ball", "tumbling-rod"))
    folder = options.claim_folder(out)
    with options.exit_on_io_error():
        with ProgressDisplay(sys.stderr) as progress:
            table = drifts.measure_drift(chosen, max_cpu_seconds, rtols=rtols, progress=progress, log=log)
        path = write_table(table, folder / "drift.parquet")
        print_table(table.to_pylist())
        click.echo(f"results: {path}")
        if report := _write_report_again(folder):
            click.echo(f"report: {report}")
    rows = table.to_pylist()
    runs, ended = (
        {(row["scenario"], row["variant"], row["rtol"]) for row in some}
        for some in (rows, [row for row in rows if row["steps"] is not None])
    )
    sys.exit(ExitCode.SUCCESS if runs == ended else ExitCode.ENGINE_FAILED)


def _write_report_again(folder: Path) -> Path | None:
    """Write the report of a folder that holds results of a run."""
    with options.exit_on_damaged_results():
        return reports.write(folder) if (folder / "results.json").is_file() else None


@command(
    "coverage double-tumbling-rods",
    "coverage furuta four-bar --level state",
    "coverage --level state --json | jq '.entries[] | select(.smallest == null)'",
    "coverage drag-rod --engine mujoco --engine exudyn",
    "coverage --pairs",
)
@options.names_argument
@click.option(
    "--engine",
    "engines",
    multiple=True,
    type=click.Choice(list(ENGINES)),
    default=("reference",),
    help="Engine whose tolerances count at trajectory and invariants level (may be repeated: then the "
    "bluntest counts).",
)
@click.option(
    "--level",
    "level",
    type=click.Choice([*COVERED_LEVELS, "all"]),
    default="all",
    help="Only this level. state and step need no engine; the others run each engine's refinement studies.",
)
@click.option(
    "--pairs",
    "has_pairs",
    is_flag=True,
    help="Instead: how many legal pairs of features the scenarios cover, and which are not covered.",
)
@options.jobs_option
@options.out_option(layout.DEFAULT_OUT)
@options.json_option
@options.limits_options(600.0)
def coverage(
    names: tuple[str, ...], engines: tuple[str, ...], level: Any, has_pairs: bool, jobs: int, out: Path,
    as_json: bool, limits: Limits,
) -> None:  # fmt: skip
    """Compute, for every number of every body, the smallest mistake that a run would report.

    The engine is correct, but one number of its model or initial state is wrong: a mass, an entry of an
    inertia, a point, a length, gravity, a load, a drag coefficient, an attitude or a rate. The table has one
    entry per level and number: the smallest mistake as a fraction of the number (of a natural size where it
    is zero), and the row that reports it first; or the proof that no mistake can be seen there.

    Prints the range per kind of number, and everything with --json. Writes coverage.parquet, and report.html
    again where OUT holds results: the report shows the table. With --pairs it writes nothing and ends with 1
    where a legal pair is not covered.
    """
    from plumbline.studies import coverage_study as study
    from plumbline.studies.parquet_files import write_table

    chosen = options.choose_scenarios(names, ())
    if has_pairs:
        _print_pairs(chosen, jobs, limits, as_json)
    chosen = [s for s in chosen if names or s.level == "all"]
    levels: tuple[Level, ...] = COVERED_LEVELS if level == "all" else (level,)
    folder = options.claim_folder(out)
    with options.exit_on_io_error():
        with ProgressDisplay(sys.stderr) as progress:
            rows = []
            if {"trajectory", "invariants"} & set(levels):
                rows = run_plan(Plan(chosen, list(engines), "trajectory", jobs, limits), progress).rows
            with WorkerPool(jobs, limits) as executor:
                found = study.measure_coverage(executor, chosen, rows, RANDOM_STATES, levels, progress)
        path = write_table(study.coverage_table(found), folder / study.FILE)
        report = _write_report_again(folder)
    summary = study.summarize_coverage(found)
    if as_json:
        entries = [asdict(entry) for entry in found]
        print_json({"summary": summary, "blind_spots": study.blind_spots(found), "entries": entries})
    else:
        print_table(summary)
        for sentence in study.blind_spots(found) if not names else []:
            click.echo(sentence)
    for kind, written in (("results", path), ("report", report)):
        if written is not None:
            click.echo(f"{kind}: {written}", err=as_json)


def _print_pairs(chosen: list[Scenario], jobs: int, limits: Limits, as_json: bool) -> NoReturn:
    """Print how many legal pairs of features the scenarios cover; exit with 1 if one is not covered."""
    from plumbline.studies import feature_pairs

    with ProgressDisplay(sys.stderr) as progress, WorkerPool(jobs, limits) as executor:
        shown = feature_pairs.measure_features(executor, chosen, progress)
    legal = feature_pairs.legal_pairs()
    lacking = sorted(legal.difference(*map(feature_pairs.all_pairs, shown.values())))
    if as_json:
        lists = {name: [str(one) for one in some] for name, some in shown.items()}
        missing = [[str(one), str(other)] for one, other in lacking]
        print_json({"legal": len(legal), "lacking": missing, "shown": lists})
    else:
        count = len({one for pair in legal for one in pair})
        click.echo(
            f"{count} features, {len(legal):,} legal pairs: {len(legal) - len(lacking):,} covered by "
            f"{count_noun(len(chosen), 'scenario')}, {len(lacking):,} not"
        )
        for one, other in lacking[:MAX_LISTED_CELLS]:
            click.echo(f"not covered: {one} and {other}")
    sys.exit(ExitCode.DISAGREEMENT if lacking else ExitCode.SUCCESS)
