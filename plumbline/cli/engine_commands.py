"""Commands for authors of engines: serve, contract."""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import click

from plumbline.cli import options
from plumbline.cli.help_texts import command, examples
from plumbline.engines import specifications
from plumbline.processes.exceptions import describe_exception
from plumbline.processes.line_process import BadSpecification
from plumbline.processes.worker_pool import Limits
from plumbline.storage.results_store import row_record, write_atomically
from reports.junit import add_suite


@click.command(epilog=examples("serve my_package.adapter:MyEngine", "serve my_engine.py:MyEngine"))
@click.argument("engine")
def serve(engine: str) -> None:
    """Answer protocol 1 on standard input and output for a Python adapter.

    ENGINE is FILE.py:Class or package.module:Class. Start it in the environment that has the engine; a run in
    another environment names it --adapter 'cmd:plumbline serve ENGINE'.
    """
    from plumbline.engines.registry import load_adapter
    from plumbline.engines.serve import serve_standard_streams

    try:
        adapter = load_adapter(specifications.resolve(engine, Path.cwd()))
    except Exception as error:  # of the user's file, which may do anything
        raise click.BadParameter(describe_exception(error), param_hint="ENGINE") from None
    serve_standard_streams(adapter)


@command(
    "contract 'cmd:./my_engine --fast'",
    "contract my_engine.py:MyEngine --level all --junit contract.xml",
)
@click.argument("engine")
@click.option(
    "--level",
    type=click.Choice(["state", "step", "trajectory", "all"]),
    default="all",
    help="As of `run`.",
)
@click.option("--junit", type=click.Path(path_type=Path), help="A JUnit file of all checks.")
@options.jobs_option
@options.limits_options(300.0)
def contract(engine: str, level: Any, junit: Path | None, jobs: int, limits: Limits) -> None:
    """Test an engine: its start, its answers at states and its motions on mechanisms of every kind of joint.

    ENGINE is 'cmd:PROGRAM ARGUMENTS', FILE.py:Class or package.module:Class. What it declares as a gap is
    skipped and counted; what differs is printed with its likely cause.
    """
    from plumbline.execution.comparison import CONTRACT_SCENARIOS, compare

    try:
        found = compare(engine, CONTRACT_SCENARIOS, level, jobs=jobs, limits=limits)
    except BadSpecification as error:
        raise click.BadParameter(str(error), param_hint="ENGINE") from None
    for row in found.problems:
        click.echo(f"{row.style.glyph} {row.key}: {row.reason}")
        if row.diagnosis:
            click.echo(f"    {row.diagnosis}")
    click.echo(found.sentence)
    if junit:
        suites = ET.Element("testsuites", name="plumbline contract")
        for name in dict.fromkeys(row.scenario for row in found.rows):
            add_suite(suites, name, [row_record(row) for row in found.rows if row.scenario == name], {})
        write_atomically(junit, ET.tostring(suites, encoding="utf-8", xml_declaration=True))
    sys.exit(found.exit_code)
