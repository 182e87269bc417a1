"""The command that searches for new findings with random mechanisms."""

from __future__ import annotations

import secrets
import sys
import time
from pathlib import Path

import click

from plumbline import layout
from plumbline.cli import options
from plumbline.cli.findings_output import describe_run
from plumbline.cli.help_texts import command
from plumbline.cli.terminal_output import command_line, count_noun, line_width, log, make_console, print_json
from plumbline.execution.exit_codes import ExitCode
from plumbline.execution.plan import Plan
from plumbline.judging.known_issues import KNOWN_ISSUES_FILE
from plumbline.processes.worker_pool import Limits

MAX_MINUTES = 1e5


@command(
    "fuzz --minutes 10",
    "fuzz --engine mujoco --engine pinocchio --seed 7 --findings 3",
    "fuzz --minutes 480 --corpus corpus --jobs 4",
    session="""
\b
A session:
  random mechanisms of seed 2875430316 (--seed repeats them)
  new: mujoco-joint-forces-without-springs-between-points (random-mechanism-2875430316-5)
  96 mechanisms, 1 new finding, 31 s
  ✗ mujoco-joint-forces-without-springs-between-points  3.13.0
    behaves as if it returned the joint reaction without spring 1
    2 rows, random-mechanism-2875430316-5, up to 1.2e+12 times the tolerance
  smallest mechanism: fuzz/mujoco-joint-forces-without-springs-between-points.yaml
""",
)
@options.engines_option
@click.option(
    "--seed", type=click.IntRange(0, options.MAX_SEED), help="Seed of the mechanisms. Default: random."
)
@click.option(
    "--minutes", type=options.FiniteNumber(0, MAX_MINUTES), default=10.0, help="End after so many minutes."
)
@click.option(
    "--findings",
    "max_findings",
    type=click.IntRange(1, 1000),
    default=20,
    help="End after so many new findings.",
)
@click.option(
    "--corpus",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder that keeps mechanisms with new pairs of features; a search of the same seed goes on "
    "where the last one ended.",
)
@click.option(
    "--corpus-size",
    type=click.IntRange(0, 100_000),
    default=500,
    help="Largest number of files in the corpus.",
)
@options.jobs_option
@options.known_option
@options.out_option(layout.output_folder("fuzz"))
@options.json_option
@options.limits_options(300.0)
def fuzz(
    engines: list[str], seed: int | None, minutes: float, max_findings: int, corpus: Path | None,
    corpus_size: int, jobs: int, known_files: tuple[Path, ...], out: Path, as_json: bool, limits: Limits,
) -> None:  # fmt: skip
    """Compare random mechanisms at states until the time is over or enough new findings are found.

    What is found is grouped at once: one cause is one finding. Of each new one the smallest mechanism that
    still shows it is written to OUT as a scenario file, which `run` repeats; `explain` and `report` read OUT.
    Ctrl-C ends with the findings so far.
    """
    from plumbline.studies.fuzz import Corpus, FuzzResult, search, write_findings

    known_issues = options.read_known_issues((KNOWN_ISSUES_FILE, *known_files), [])
    folder = options.claim_folder(out)
    result = FuzzResult(secrets.randbits(32) if seed is None else seed)
    log(f"random mechanisms of seed {result.seed} (--seed repeats them)")
    plan = Plan([], engines, "state", jobs, limits, random_level="state",
                known_issues=known_issues, are_engines_required=options.are_engines_named())  # fmt: skip
    began, is_interrupted = time.monotonic(), False
    with options.exit_on_io_error():
        try:
            search(
                plan, result, seconds=60 * minutes, max_findings=max_findings,
                corpus=Corpus(corpus, corpus_size), log=log,
            )  # fmt: skip
        except KeyboardInterrupt:
            is_interrupted = True
        written = list(write_findings(result, folder, command_line()))
    new = result.new
    summary = f"{count_noun(result.scenario_count, 'mechanism')}, {count_noun(len(new), 'new finding')}"
    summary += "" if result.scenario_count else ": nothing was compared in time"
    log(f"{summary}, {time.monotonic() - began:.0f} s")
    if as_json:
        print_json([f.record() for f in result.findings])
    else:
        out_console = make_console(sys.stdout)
        for line in describe_run([], result.findings, line_width(out_console), {}):
            out_console.print(line)
        for path in written:
            click.echo(f"smallest mechanism: {path}")
    if is_interrupted:
        sys.exit(ExitCode.INTERRUPTED)
    sys.exit(result.exit_code)
