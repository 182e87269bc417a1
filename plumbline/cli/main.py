"""The command line: `python -m plumbline`."""

from __future__ import annotations

import collections
import json
import os
import shlex
import sys
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import click
from rich.table import Table

import reports
from plumbline.cli.console import ProgressDisplay, make_console, print_result
from plumbline.cli.options import (
    choose_engines,
    choose_scenarios,
    ensure_writable,
    exit_on_io_error,
    read_scenarios,
)
from plumbline.engines.registry import ENGINES
from plumbline.execution.result_cache import DiskResultCache
from plumbline.execution.runner import Plan, describe_engines, run_plan, save
from plumbline.processes.workers import Limits, WorkerPool
from plumbline.scenario import loader as scenarios
from plumbline.scenario.errors import ScenarioError
from plumbline.storage.results_store import read_results, row_record, to_json_value

DEFAULT_OUT = Path("reports") / "out"
EXIT_CODES = """
\b
Exit codes:
  0  everything agrees, or differs as recorded in plumbline/judging/known_issues.yaml
  1  a disagreement, or a cell unresolved or unsupported that is not recorded
  2  bad usage or a bad scenario file
  3  an engine failed: raised, crashed, hung, ran out of memory, was not finite
  4  the machine failed: disk full, input/output error; the same command goes on from there
An engine that is not installed is a verdict and changes no exit code.
"""


class SuggestingGroup(click.Group):
    """Bad usage suggests the nearest command."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Name the nearest command where there is none of that name."""
        if args and args[0] not in self.commands:
            near = get_close_matches(args[0], self.commands, 1)
            hint = f" Did you mean {near[0]!r}?" if near else f" There are: {', '.join(self.commands)}."
            raise click.UsageError(f"no command {args[0]!r}.{hint}")
        return super().resolve_command(ctx, args)


@click.group(cls=SuggestingGroup, epilog=EXIT_CODES, context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Run identical pendulums through the notes' equations and multibody engines, and say who is wrong.

    \b
    Start with:
      python -m plumbline list scenarios
      python -m plumbline run double-tumbling-balls
      python -m plumbline run                  (everything; a few minutes)
    """


@main.command("list")
@click.argument("what", type=click.Choice(["scenarios", "engines"]))
@click.option("--json", "as_json", is_flag=True, help="JSON on stdout, for other programs.")
def list_(what: str, as_json: bool) -> None:
    """List the scenarios of the catalogue, or the engines with their versions and integrators."""
    records = list_scenarios() if what == "scenarios" else list_engines()
    if as_json:
        click.echo(json.dumps(records, ensure_ascii=False, indent=1))
        return
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in records[0]:
        if column not in ("purpose", "file"):
            table.add_column(column, overflow="fold")
    for record in records:
        table.add_row(
            *(
                ", ".join(v) if isinstance(v, list) else str(v)
                for k, v in record.items()
                if k not in ("purpose", "file")
            )
        )
    make_console(sys.stdout).print(table)


def list_scenarios() -> list[dict[str, Any]]:
    """One record per scenario of the catalogue."""
    found = scenarios.load_scenarios(scenarios.catalogue())
    return [
        {
            "name": s.name,
            "family": s.family,
            "bodies": s.model.n,
            "title": s.title,
            "purpose": s.purpose,
            "file": str(s.path),
        }
        for s in found
    ]


def list_engines() -> list[dict[str, Any]]:
    """One record per engine of the registry, asked in worker processes."""
    with WorkerPool(1) as workers:
        found = describe_engines(workers, list(ENGINES))
    return [
        {
            "name": name,
            "title": info.title,
            "version": info.version or "not installed",
            "integrators": [i.name for i in info.integrators],
        }
        for name, info in found.items()
    ]


@main.command(epilog=EXIT_CODES)
@click.argument("names", nargs=-1, metavar="[SCENARIO]...")
@click.option("--family", "families", multiple=True, help="Only scenarios of this family (may be repeated).")
@click.option(
    "--engine",
    "engines",
    multiple=True,
    help="Only this engine (may be repeated); mujoco@3.12.0, @latest, @pre or @path/to.whl for another "
    "version than the installed one. Default: all.",
)
@click.option(
    "--level",
    type=click.Choice(["state", "trajectory", "all"]),
    default="all",
    show_default=True,
    help="state: accelerations, reactions, energies at 51 states. trajectory: orders, limits, drifts.",
)
@click.option("--jobs", type=click.IntRange(1), default=None, help="Worker processes. Default: one per core.")
@click.option("--scheduler", metavar="ADDRESS", help="A dask cluster to run on instead, as tcp://HOST:8786.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=DEFAULT_OUT, show_default=True, help="Output folder."
)
@click.option("--json", "as_json", is_flag=True, help="The rows as JSON on stdout instead of the table.")
@click.option(
    "--accept",
    type=click.FloatRange(0, min_open=True),
    default=None,
    help="Your own relative tolerance, shown beside each derived verdict, never in its place.",
)
@click.option(
    "--timeout",
    type=click.FloatRange(0, min_open=True),
    default=300.0,
    show_default=True,
    help="Seconds per task.",
)
@click.option(
    "--memory", type=click.FloatRange(0, min_open=True), default=8.0, show_default=True, help="GB per worker."
)
def run(
    names: tuple[str, ...], families: tuple[str, ...], engines: tuple[str, ...], level: Any, jobs: int | None,
    scheduler: str | None, out: Path, as_json: bool, accept: float | None, timeout: float, memory: float,
) -> None:  # fmt: skip
    """Compare scenarios (names of the catalogue, or paths of YAML files; default: all) on all engines.

    \b
    Examples:
      python -m plumbline run                                    everything
      python -m plumbline run double-tumbling-balls --engine mujoco
      python -m plumbline run --family chain --level state
      python -m plumbline run my-pendulum.yaml --out results --json | jq .sentence
    """
    chosen = choose_scenarios(names, families)
    chosen_engines = choose_engines(engines)
    folder = ensure_writable(out)
    whole = not names and not families and not engines and level == "all"
    cells = DiskResultCache(folder / "cells", lambda sentence: click.echo(sentence, err=True))
    plan = Plan(
        chosen,
        chosen_engines,
        level,
        jobs or os.cpu_count() or 1,
        Limits(timeout, memory),
        user_rtol=accept,
        is_full_catalogue=whole,
        result_cache=cells,
        scheduler=scheduler,
    )
    with exit_on_io_error():
        with ProgressDisplay(sys.stderr) as progress:
            result = run_plan(plan, progress)
        save(result, folder, shlex.join(["python", "-m", "plumbline", *sys.argv[1:]]))
        with result.cpu_times.measure("report"):
            written = reports.write(folder)
        cells.clear()
    if as_json:
        document = {
            "run": result.metadata,
            "sentence": result.metadata["sentence"],
            "rows": [row_record(r) for r in result.rows],
        }
        click.echo(json.dumps(to_json_value(document), ensure_ascii=False, indent=1))
    else:
        print_result(result)
    click.echo(f"report: {written}", err=as_json)
    click.echo(result.cpu_times.summary(), err=True)
    sys.exit(result.metadata["exit_code"])


@main.command(epilog=EXIT_CODES)
@click.argument("names", nargs=-1, metavar="[SCENARIO]...")
@click.option("--engine", "engines", multiple=True, help="Only this engine (may be repeated). Default: all.")
@click.option(
    "--random", "count", type=click.IntRange(0), default=200, show_default=True, help="Random scenarios."
)
@click.option(
    "--seed", type=click.IntRange(0), default=None, help="Their seed. Default: drawn, told, stored."
)
@click.option(
    "--finer",
    type=click.IntRange(0, 4),
    default=1,
    show_default=True,
    help="Halvings of the step beyond those of `run`.",
)
@click.option(
    "--endurance",
    type=click.FloatRange(0),
    default=100.0,
    show_default=True,
    help="Seconds of the long runs whose invariants are judged; 0 for none.",
)
@click.option(
    "--instrument/--no-instrument",
    default=True,
    show_default=True,
    help="The instrument's own test: planted mistakes must be reported and named.",
)
@click.option("--jobs", type=click.IntRange(1), default=None, help="Worker processes. Default: one per core.")
@click.option("--scheduler", metavar="ADDRESS", help="A dask cluster to run on instead, as tcp://HOST:8786.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("nightly"),
    show_default=True,
    help="Output folder; complete nights are in its folder `history`.",
)
@click.option(
    "--timeout",
    type=click.FloatRange(0, min_open=True),
    default=1800.0,
    show_default=True,
    help="Seconds per task.",
)
@click.option(
    "--memory", type=click.FloatRange(0, min_open=True), default=8.0, show_default=True, help="GB per worker."
)
def nightly(
    names: tuple[str, ...], engines: tuple[str, ...], count: int, seed: int | None, finer: int,
    endurance: float, self_test: bool, jobs: int | None, scheduler: str | None, out: Path, timeout: float,
    memory: float,
) -> None:  # fmt: skip
    """Run everything, unattended: catalogue, finer steps, long runs, random scenarios, the instrument's own
    test; and remember the night.

    Killed at any moment, the same command goes on where it stopped.

    \b
    Examples:
      python -m plumbline nightly                               everything
      python -m plumbline nightly --random 1000 --seed 7 --out nights
      python -m plumbline history nightly
    """
    from plumbline.cli.nightly import run_nightly as run_night
    from plumbline.execution.selftest import run_self_test

    chosen, chosen_engines, folder = (
        choose_scenarios(names, ()),
        choose_engines(engines),
        ensure_writable(out),
    )
    with exit_on_io_error(), ProgressDisplay(sys.stderr) as progress:
        result, place = run_night(
            folder, chosen, chosen_engines, random=count, seed=seed, jobs=jobs or os.cpu_count() or 1,
            limits=Limits(timeout, memory), whole=not names and not engines, finer=finer, progress=progress,
            endurance=endurance, scheduler=scheduler, self_test=run_self_test if self_test else None,
            command=shlex.join(["python", "-m", "plumbline", *sys.argv[1:]]),
            log=lambda sentence: click.echo(sentence, err=True),
        )  # fmt: skip
    print_result(result)
    click.echo(f"report: {place / 'report.html'}")
    click.echo(result.cpu_times.summary(), err=True)
    sys.exit(result.metadata["exit_code"])


@main.command()
@click.argument("file", metavar="FILE", type=click.Path(path_type=Path))
@click.option("--jobs", type=click.IntRange(1), default=None, help="Worker processes. Default: one per core.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("sweep"), show_default=True, help="Output folder."
)
def sweep(file: Path, jobs: int | None, out: Path) -> None:
    """Vary a scenario's parameters over a grid or distributions; FILE as plumbline/studies/sweep.py shows.

    Writes sweep.parquet, one row per cell and implementation, and its map, sweep.html. Exit codes as for run.
    """
    from plumbline.studies import sweep as sweeps
    from reports import sweep_page

    try:
        spec, cells = sweeps.load(file)
    except ScenarioError as error:
        click.echo(str(error), err=True)
        sys.exit(2)
    folder = ensure_writable(out)
    with exit_on_io_error():
        table = sweeps.run(spec, cells, jobs or os.cpu_count() or 1)
        path = sweeps.write(table, folder)
        drawn = sweep_page.write(folder)
    counts = collections.Counter(
        zip(*(table[k].to_pylist() for k in ("implementation", "verdict")), strict=True)
    )
    click.echo(f"{len(cells)} cells: " + "; ".join(f"{e} {v} {k}" for (e, v), k in sorted(counts.items())))
    poor = table.filter(
        [v not in ("agrees", "not installed") for v in table["verdict"].to_pylist()]
    ).to_pylist()
    for row in poor[:10]:
        click.echo(f"cell {row['cell']}, {row['implementation']}: {row['verdict']}: {row['reason']}")
    click.echo(f"results: {path}")
    click.echo(f"map: {drawn}")
    lost = sum(k for (_, v), k in counts.items() if v == "failed")
    judged = sum(k for (_, v), k in counts.items() if v not in ("agrees", "failed", "not installed"))
    sys.exit(3 if lost else 1 if judged else 0)


@main.command()
@click.argument("names", nargs=-1, metavar="[SCENARIO]...")
@click.option(
    "--rtol",
    "rtols",
    type=click.FloatRange(1e-14, 1e-2),
    multiple=True,
    default=(1e-6, 1e-9, 1e-12),
    show_default=True,
    help="Tolerance of the runs (may be repeated).",
)
@click.option(
    "--longest",
    type=click.FloatRange(0, min_open=True),
    default=120.0,
    show_default=True,
    help="CPU seconds that one run may take; later times are left out where they would cost more.",
)
@click.option(
    "--out", type=click.Path(path_type=Path), default=DEFAULT_OUT, show_default=True, help="Output folder."
)
def drift(names: tuple[str, ...], rtols: tuple[float, ...], max_cpu_seconds: float, out: Path) -> None:
    """Measure the drift of raw, Baumgarte and projected runs in 10, 100, 1000 s (default: two bodies).

    Writes drift.parquet, and report.html again where OUT holds results: the report shows the table.

    \b
    Examples:
      python -m plumbline drift
      python -m plumbline drift double-tumbling-rods --longest 30 --out results
    """
    from plumbline.studies import drift as drifts

    chosen = read_scenarios(names or ("tumbling-ball", "tumbling-rod"))
    folder = ensure_writable(out)
    with exit_on_io_error():
        with ProgressDisplay(sys.stderr) as progress:
            found = drifts.measure_drift(
                chosen,
                max_cpu_seconds,
                rtols=rtols,
                progress=progress,
                log=lambda words: click.echo(words, err=True),
            )
        path = drifts.write(found, folder)
        shown = Table(box=None, pad_edge=False, header_style="bold")
        for column in found.column_names:
            shown.add_column(column)
        for row in found.to_pylist():
            shown.add_row(
                *(f"{v:.2g}" if isinstance(v, float) else "" if v is None else str(v) for v in row.values())
            )
        make_console(sys.stdout).print(shown)
        click.echo(f"results: {path}")
        if (folder / "results.json").is_file():
            click.echo(f"report: {reports.write(folder)}")
    sys.exit(3 if any(r.startswith("failed") for r in found["reason"].to_pylist()) else 0)


@main.command()
@click.argument("folder", default="nightly", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--key", "pattern", default=None, help="Trend of the rows whose key matches (* and ?).")
@click.option("--json", "as_json", is_flag=True, help="JSON on stdout, for other programs.")
def history(folder: Path, pattern: str | None, as_json: bool) -> None:
    """What the nights in FOLDER say together: counts, first bad nights, changes since the last green.

    \b
    Examples:
      python -m plumbline history nightly
      python -m plumbline history nightly --key "double-*/mujoco/state/*"
    """
    from plumbline.storage.history import History

    told = History(folder).to_document(pattern)
    if as_json:
        click.echo(json.dumps(told, ensure_ascii=False, indent=1))
        return
    out = make_console(sys.stdout)
    for name, records in (("nights", told["nights"]), ("trend", told.get("trend", []))):
        table = Table(
            *(records[0] if records else ()), box=None, pad_edge=False, header_style="bold", title=name
        )
        for record in records:
            table.add_row(
                *(
                    "" if v is None else f"{v:.3g}" if isinstance(v, float) else str(v)
                    for v in record.values()
                )
            )
        if records:
            out.print(table)
    lines = [f"damaged, left out: {sentence}" for sentence in told["damaged"]]
    lines += [f"version: {sentence}" for sentence in told["versions"]]
    for bad in told["first_bad"]:
        good = f"last good {bad['last_good']}" if bad["last_good"] else "never good"
        lines.append(f"{bad['key']} {bad['verdict']} since {bad['first_bad']} ({good}): {bad['reason']}")
    for change in told["since_green"]:
        lines.append(
            f"since the last green {told['last_green']}: {change['key']} {change['was']} → {change['is']}"
        )
    for line in lines or ["nothing is bad, nothing changed"]:
        out.print(line, markup=False)


@main.command()
@click.argument("folder", default=DEFAULT_OUT, type=click.Path(path_type=Path))
@click.option(
    "--history",
    "nights",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    default=None,
    help="Folder of earlier nights: adds trends and the comparison with the last green one.",
)
def report(folder: Path, history_folder: Path | None) -> None:
    """Write report.html, junit.xml and summary.md again, from the results stored in FOLDER."""
    try:
        read_results(folder)
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    click.echo(f"report: {reports.write(ensure_writable(folder), history_folder)}")


@main.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE...", type=click.Path(path_type=Path))
def check(files: tuple[Path, ...]) -> None:
    """Validate scenario files: every problem of every file at once, as file:line:column."""
    found = read_scenarios(files)
    for s in found:
        joints = ", ".join("rod" if rod else "ball" for rod in s.model.rods[:6]) + (
            " …" if s.model.n > 6 else ""
        )
        click.echo(f"{s.path}: ok: {s.name}, {s.model.n} {'body' if s.model.n == 1 else 'bodies'} ({joints})")


@main.command()
def schema() -> None:
    """Print the JSON Schema of scenario files, for editors and other programs."""
    click.echo(json.dumps(scenarios.json_schema(), ensure_ascii=False, indent=1))


@main.command()
@click.argument("result", type=click.Path(path_type=Path, exists=True))
@click.argument("keys", nargs=-1, metavar="[KEY]...")
def reproduce(result: Path, keys: tuple[str, ...]) -> None:
    """Write a stand-alone script that shows a disagreement, for the engine's maintainers.

    RESULT is a results folder or its results.json; KEY a row's key. Without KEY the disagreements are listed.

    \b
    Examples:
      python -m plumbline reproduce reports/out
      python -m plumbline reproduce reports/out chain-50-balls/pinocchio-aba/state/-/acceleration
    """
    from plumbline.reproduce import write as scripts

    folder = result if result.is_dir() else result.parent
    try:
        if not keys:
            rows = scripts.disputed(read_results(folder))
            for row in rows:
                click.echo(f"{row['key']}: {row['diagnosis'] or row['reason']}")
            click.echo(f"{len(rows)} disagreements" if rows else "nothing disagrees", err=True)
            return
        told = scripts.write(folder, keys)
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    for key, name in told.items():
        path = folder / "scripts" / name
        if not path.is_file():
            raise click.ClickException(f"{key}: {name}")
        click.echo(str(path))
