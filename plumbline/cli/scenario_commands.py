"""Commands about scenarios and engines: list, check, schema."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from plumbline.cli import options
from plumbline.cli.terminal_output import count_noun, print_json, print_table
from plumbline.engines.protocol import protocol_schema
from plumbline.engines.registry import ENGINES
from plumbline.engines.surface import STATUSES, SURFACES, declared_surface
from plumbline.execution.runner import compare_surfaces, describe_engines
from plumbline.execution.scenario_verdicts import NO_REGULAR_POSE
from plumbline.model.loops import immovable_joints, is_singular, smallest_singular_value
from plumbline.model.sampling import compared_states
from plumbline.processes.worker_pool import WorkerPool
from plumbline.scenario import loader as scenarios

SINGULAR_TRIES = 10  # states that are looked for where the initial pose is singular
JSON_ONLY = ("purpose", "file")  # columns too long for a terminal


@click.command("list")
@click.argument("what", type=click.Choice(["scenarios", "engines", "surface"]))
@click.argument("engine", required=False, type=click.Choice(SURFACES))
@options.json_option
def list_(what: str, engine: str | None, as_json: bool) -> None:
    """List the scenarios of the catalogue, the engines with their versions and integrators, or their surface.

    `list surface` counts the public names of each engine by what is compared, with those that its installed
    version has besides; `list surface ENGINE` lists them.
    """
    if engine and what != "surface":
        raise click.UsageError(f"only `list surface` takes an engine, not `list {what}`")
    lists = {"scenarios": _scenario_records, "engines": _engine_records, "surface": _surface_records}
    records = [vars(one) for one in declared_surface(engine).names] if engine else lists[what]()
    if as_json:
        print_json(records)
    else:
        print_table({k: v for k, v in record.items() if k not in JSON_ONLY} for record in records)


def _scenario_records() -> list[dict[str, Any]]:
    return [
        {
            "name": s.name,
            "family": s.family,
            "bodies": s.model.n,
            "title": s.title,
            "purpose": s.purpose,
            "file": str(s.path),
        }
        for s in scenarios.load_scenarios(scenarios.catalogue())
    ]


def _engine_records() -> list[dict[str, Any]]:
    with WorkerPool(1) as workers:
        found = describe_engines(workers, list(ENGINES))
    return [
        {
            "name": name,
            "title": info.title,
            "version": info.version or ("failed" if info.has_failed else "not installed"),
            "integrators": [i.name for i in info.integrators],
        }
        for name, info in found.items()
    ]


def _surface_records() -> list[dict[str, Any]]:
    with WorkerPool(1) as workers:
        changes = {one.engine: one for one in compare_surfaces(workers)}
    found = []
    for name in SURFACES:
        surface, change = declared_surface(name), changes.get(name)
        counts: dict[str, Any] = {status: surface.counts()[status] for status in STATUSES}
        record = {"engine": name, "version": change.version if change else "not installed", **counts}
        if change:
            record |= {"new": list(change.new), "vanished": list(change.vanished)}
        found.append(record)
    return found


@click.command()
@options.files_argument
def check(files: tuple[Path, ...]) -> None:
    """Check scenario files and print every problem of every file, as file:line:column."""
    for s in options.read_scenarios(files):
        joints = ", ".join(s.model.kind[:6])
        more = " …" if s.model.n > 6 else ""
        notes = [describe_immovable_joints(s), _describe_singular_pose(s)] if s.model.has_loops else []
        bodies = count_noun(s.model.n, "body", "bodies")
        click.echo("; ".join([f"{s.path}: ok: {s.name}, {bodies} ({joints}{more})", *filter(None, notes)]))


def describe_immovable_joints(s: scenarios.Scenario) -> str:
    """Name the joints that loops keep from moving.

    Returns:
        What cannot move: the mechanism, or the joints by the bodies that they carry and by their number
        among `closes`; empty where every joint can.

    """
    still, n = immovable_joints(s.model, s.state), s.model.n
    if not still:
        return ""
    if len(still) == sum(not kind.is_rigid for kind in s.model.kinds):
        return "the mechanism cannot move: its loops hold every joint"
    names = [s.body_names[k] if k < n else f"closes[{k - n}]" for k in still]
    return f"the loops hold these joints, which cannot move: {', '.join(names)}"


def _describe_singular_pose(s: scenarios.Scenario) -> str:
    if not is_singular(smallest_singular_value(s.model, s.state)):
        return ""
    if compared_states(s.model, s.state, s.seed, SINGULAR_TRIES):
        return (
            "at t = 0 the pose is singular, as at a dead point: states at other poses are compared, no motion"
        )
    return f"nothing can be compared: {NO_REGULAR_POSE}"


@click.command()
@click.option("--protocol", is_flag=True, help="Of the answers of engines that are programs instead.")
def schema(protocol: bool) -> None:
    """Print the JSON Schema of scenario files, for editors and other programs."""
    print_json(protocol_schema() if protocol else scenarios.json_schema())
