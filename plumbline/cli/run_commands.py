"""Commands that run scenarios on engines and judge the results: run, nightly."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

import reports
from plumbline import layout
from plumbline.cli import options
from plumbline.cli.findings_output import wrap
from plumbline.cli.help_texts import command
from plumbline.cli.run_display import RunDisplay
from plumbline.cli.terminal_output import (
    command_line,
    line_width,
    log,
    make_console,
    print_findings,
    print_json,
    print_result,
)
from plumbline.engines.registry import ENGINES
from plumbline.execution import scenario_verdicts
from plumbline.execution.plan import Plan
from plumbline.execution.result_cache import DiskResultCache, user_cells_folder
from plumbline.execution.runner import RunResult, leave_out_findings, run_plan, save
from plumbline.judging.findings import find_findings
from plumbline.judging.known_issues import KNOWN_ISSUES_FILE, KnownIssue
from plumbline.processes.worker_pool import Limits, start_warm_process
from plumbline.scenario.loader import Scenario
from plumbline.storage.results_store import read_results, row_record, to_json_value

MAX_PROOF_CPU_SECONDS = 1e6


new_only_option = click.option(
    "--new-only",
    type=options.FolderPath(),
    metavar="NIGHTS",
    help="Folder of nights: exit with 1 only for findings that the last of them did not have.",
)


@command(
    "run                                    (everything)",
    "run double-tumbling-balls --engine mujoco",
    "run --family chain --level state",
    "run my-pendulum.yaml --out results --json | jq .sentence",
    "run my-robot.urdf --base free",
)
@options.names_argument
@options.model_file_options(are_passed=False)
@click.option("--family", "families", multiple=True, help="Only scenarios of this family (may be repeated).")
@options.engines_option
@click.option(
    "--level",
    type=click.Choice(["state", "step", "trajectory", "all"]),
    default="all",
    help="state: accelerations, reactions and energies at 51 states. step: single steps, and every step of "
    "a run, against the declared formula of each integrator. trajectory: observed orders, limits and "
    "invariants. all: all of them, and the metamorphic relations.",
)
@options.jobs_option
@options.scheduler_option
@options.known_option
@options.out_option(layout.DEFAULT_OUT)
@options.json_option
@click.option(
    "--user-rtol",
    type=options.FiniteNumber(options.MIN_USER_RTOL, 1.0),
    help="A relative tolerance of your own; results and report show it beside each derived verdict, which it "
    "does not change.",
)
@click.option("--matrix", "has_matrix", is_flag=True, help="Print each cell, scenarios × engines, too.")
@new_only_option
@click.option("--fresh", is_flag=True, help="Compute everything again, also what earlier runs computed.")
@options.limits_options(300.0)
def run(
    names: tuple[str, ...], families: tuple[str, ...], engines: list[str], level: Any, jobs: int,
    scheduler: str | None, known_files: tuple[Path, ...], out: Path, as_json: bool, user_rtol: float | None,
    has_matrix: bool, new_only: Path | None, fresh: bool, limits: Limits,
) -> None:  # fmt: skip
    """Compare scenarios (names of the catalogue, or paths of files; default: all) on all engines.

    A file is a scenario in YAML, or a robot in URDF or MJCF; what its mechanism leaves out is listed first.
    """
    if scheduler is None and options.are_scenarios_found(names):
        start_warm_process([scenario_verdicts.__name__])
    chosen = options.choose_scenarios(names, families)
    for s in chosen:
        if s.is_from_model_file:
            log(f"{s.path}: {s.purpose}")
    known_issues = _read_known_issues(known_files, chosen)
    seen = _seen_findings(new_only)
    folder = options.claim_folder(out)
    cache = DiskResultCache(user_cells_folder(), log, is_fresh=fresh)
    options.announce_result_cache(cache)
    plan = Plan(
        chosen,
        engines,
        level,
        jobs,
        limits,
        user_rtol=user_rtol,
        is_full_catalogue=not names and not families and {*ENGINES} <= {*engines} and level == "all",
        result_cache=cache,
        scheduler=scheduler,
        known_issues=known_issues,
        are_engines_required=options.are_engines_named(),
        has_all_studies=level != "all",
    )
    from plumbline.reproduce.write import write_scripts

    with options.exit_on_io_error():
        result = _run_visibly(plan, as_json, fresh)
        leave_out_findings(result, seen)
        save(result, folder, command_line())
        with result.cpu_times.measure("report"):
            document = read_results(folder)
            scripts = write_scripts(folder, results=cache, document=document)
            result.cpu_times.seconds["report"] += scripts.cpu_time
            report = reports.write(folder, document=document)
        cache.trim()
    if as_json:
        document = {
            "run": result.metadata,
            "sentence": result.metadata["sentence"],
            "findings": [finding.record() for finding in result.findings],
            "rows": [row_record(r) for r in result.rows],
        }
        print_json(to_json_value(document))
    _finish(result, report, as_json, has_matrix)


@command(
    "nightly                               (everything)",
    "nightly --random 1000 --seed 7 --out nights",
    "history nightly",
)
@options.names_argument
@options.engines_option
@click.option(
    "--random",
    "random_count",
    type=click.IntRange(0, options.MAX_RANDOM_SCENARIOS),
    default=200,
    help="Number of random scenarios: half of them chains, the others mechanisms of any joints.",
)
@click.option(
    "--random-trajectories",
    type=click.IntRange(0, options.MAX_RANDOM_SCENARIOS),
    default=20,
    help="Number of random motions besides, which are compared at every level; others at states and steps.",
)
@click.option(
    "--seed",
    type=click.IntRange(0, options.MAX_SEED),
    help="Seed of the random scenarios. Default: random; printed and stored in results.json.",
)
@click.option(
    "--extra-refinements",
    type=click.IntRange(0, 4),
    default=1,
    help="Halvings of the step beyond those of `run`.",
)
@click.option(
    "--long-run-seconds",
    type=options.FiniteNumber(0, options.MAX_LONG_RUN),
    default=100.0,
    help="Simulated seconds of the long runs whose invariants are judged; 0: no long runs.",
)
@click.option(
    "--self-test/--no-self-test",
    default=True,
    help="Plant mistakes in an engine and require that the run reports and names them.",
)
@click.option(
    "--proof-cpu-seconds",
    type=options.FiniteNumber(0, MAX_PROOF_CPU_SECONDS),
    default=600.0,
    help="CPU seconds after which no further motion of the catalogue is proved; 0: none is. Motions that "
    "earlier nights or `prove` have proved are not proved again.",
)
@options.jobs_option
@options.scheduler_option
@options.known_option
@options.out_option(layout.output_folder("nightly"), "; complete nights are in its folder `history`")
@new_only_option
@options.limits_options(1800.0)
def nightly(
    names: tuple[str, ...], engines: list[str], random_count: int, random_trajectories: int, seed: int | None,
    extra_refinements: int, long_run_seconds: float, self_test: bool,
    proof_cpu_seconds: float, jobs: int, scheduler: str | None,
    known_files: tuple[Path, ...], out: Path, new_only: Path | None, limits: Limits,
) -> None:  # fmt: skip
    """Run the catalogue with finer steps, long runs, random scenarios and the self-test.

    Runs unattended, keeps the history of earlier nights, and resumes after interruption: give the same
    command again.
    """
    from plumbline.cli.nightly import run_nightly
    from plumbline.execution.selftest import run_self_test

    options.check_history_tool()
    chosen = options.choose_scenarios(names, ())
    known_issues = _read_known_issues(known_files, chosen)
    seen = _seen_findings(new_only)
    folder = options.claim_folder(out)
    display = RunDisplay(sys.stderr)
    plan = Plan(
        chosen, engines, jobs=jobs, limits=limits, extra_refinements=extra_refinements,
        long_run_seconds=long_run_seconds, is_full_catalogue=not names and {*ENGINES} <= {*engines},
        scheduler=scheduler, random_trajectory_count=random_trajectories, known_issues=known_issues,
        are_engines_required=options.are_engines_named(),
    )  # fmt: skip
    with options.exit_on_io_error(), display as progress:
        result, place = run_nightly(
            folder, plan, random_count=random_count, seed=seed, command=command_line(),
            self_test=run_self_test if self_test and not layout.IS_INSTALLED else None,
            proof_cpu_seconds=proof_cpu_seconds, seen_findings=seen, progress=progress, observer=display,
            log=log,
        )  # fmt: skip
    _finish(result, place / "report.html", as_json=False)


def _seen_findings(nights: Path | None) -> frozenset[str]:
    """The names of the findings of the last night."""
    if nights is None:
        return frozenset()
    from plumbline.storage.history_of_nights import last_findings

    if nights.exists() and not nights.is_dir():
        raise click.BadParameter(f"{nights} is a file and no folder of nights", param_hint="--new-only")
    return last_findings(nights, log)


def _read_known_issues(files: Sequence[Path], chosen: Sequence[Scenario]) -> list[KnownIssue]:
    """Load the project's known issues and the user's, whose entries may name scenarios of the run."""
    return options.read_known_issues((KNOWN_ISSUES_FILE, *files), [s.name for s in chosen])


def _run_visibly(plan: Plan, as_json: bool, is_fresh: bool) -> RunResult:
    """Run a plan and show verdicts as they come; an interruption leaves the findings of what has finished."""
    display = RunDisplay(sys.stderr)
    try:
        with display as progress:
            return run_plan(plan, progress, display)
    except KeyboardInterrupt:
        if not as_json and display.rows:
            rows = [row for some in display.rows.values() for row in some]
            print_findings(rows, find_findings(rows, {s.name: s.model.n for s in plan.scenarios}))
            click.echo(f"{len(display.rows)} of {len(plan.scenarios)} scenarios finished")
        if is_fresh:  # with it the finished cells would be computed again
            raise KeyboardInterrupt("without --fresh") from None
        raise


def _finish(result: RunResult, report: Path, as_json: bool, has_matrix: bool = False) -> None:
    """Print the result for people, unless stdout holds JSON, and exit with the run's code."""
    if not as_json:
        print_result(result, has_matrix=has_matrix)
    click.echo(f"report: {report}", err=as_json)
    if cached := result.cpu_times.cached_count:
        log(f"{cached} answers of earlier runs were used; --fresh computes them again")
    log("\n".join(wrap(result.cpu_times.summary(), line_width(make_console(sys.stderr)), "")))
    sys.exit(result.metadata["exit_code"])
