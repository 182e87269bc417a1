"""The command `bisect`: the version of an engine that changed an answer."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from plumbline.cli import options
from plumbline.cli.help_texts import command
from plumbline.cli.terminal_output import log, print_json
from plumbline.engines.environments import EnvironmentUnavailable, version_problem
from plumbline.engines.registry import IMPORTERS
from plumbline.execution.exit_codes import ExitCode
from plumbline.execution.plan import Plan
from plumbline.model_files.model_run import ModelPlan
from plumbline.processes.worker_pool import Limits
from plumbline.scenario.generator import RANDOM_FAMILY, RandomScenarios, random_seed
from plumbline.scenario.line_and_column_errors import did_you_mean, nearest_or_all, shorten
from plumbline.scenario.loader import Scenario
from plumbline.storage.results_store import Record, read_model_results, read_results
from plumbline.storage.version_changes import add_version_change
from plumbline.studies.version_search import NoSearch, VersionChange, search_versions

STATES = 3  # of a model file; a reading that differs shows at any


def _check_engine(_: click.Context, __: click.Parameter, name: str | None) -> str | None:
    if name is not None and name not in IMPORTERS:
        raise click.BadParameter(f"no importer {name!r}; {nearest_or_all(name, IMPORTERS)}")
    return name


def _check_version(_: click.Context, parameter: click.Parameter, text: str | None) -> str:
    if text and (text in ("latest", "pre") or version_problem(f"mujoco@{text}")):
        raise click.BadParameter(f"{text!r} is not a version; write one as 3.12.0")
    return text or ""


@command(
    "bisect robot.urdf --engine mujoco",
    "bisect robot.urdf --engine pinocchio --good 3.4.0 --bad 4.1.0",
    "bisect reports/out tumbling-ball/mujoco@3.9.0/trajectory/RK4/order",
)
@click.argument("target", metavar="FILE|RESULT", type=click.Path(path_type=Path, exists=True))
@click.argument("key", required=False)
@click.option("--engine", callback=_check_engine, help="Of a model file: whose importer.")
@click.option("--good", callback=_check_version, help="One end of the search. Default: the oldest version.")
@click.option("--bad", callback=_check_version, help="The other end. Default: the newest version.")
@options.model_file_options(are_passed=True)
@click.option("--strip-geometry", is_flag=True, help="As for `model`.")
@options.jobs_option
@options.limits_options(300.0)
@options.json_option
def bisect(
    target: Path, key: str | None, engine: str | None, good: str, bad: str, base: Any, strip_geometry: bool,
    root: Path | None, jobs: int, limits: Limits, as_json: bool,
) -> None:  # fmt: skip
    """Find the version of an engine that changed its reading of a model file, or the verdict of a row.

    FILE is a URDF or MJCF file. RESULT is a folder that `run --out` or `model --out` wrote, and KEY the key
    of one of its rows. The versions that the package index has for this Python are searched by halving;
    each runs in an environment that is made once and kept. Versions that cannot be installed are skipped.
    The ends may be given in any order: between an older bad and a newer good one, the mending is found.

    Exit code 0: a change was found; 1: both ends answer alike.
    """
    try:
        if key is not None:
            change, notes = _search_result(target, key, good, bad, jobs, limits)
        elif target.is_dir():
            raise click.UsageError(f"{target} is a folder: name a row of it by its KEY")
        elif engine is None:
            raise click.UsageError("name the importer: --engine mujoco")
        else:
            plan = ModelPlan(
                (str(target),), base=base, root=root, strip_geometry=strip_geometry, state_count=STATES,
                jobs=jobs, limits=limits,
            )  # fmt: skip
            change, notes = search_versions(plan, engine, good, bad, _report)
    except NoSearch as error:
        raise click.UsageError(str(error)) from None
    except EnvironmentUnavailable as error:
        log(str(error))
        sys.exit(ExitCode.ENGINE_FAILED)
    for note in notes:
        log(note)
    document = _document(change) | {"not_tried": notes}
    if key is not None:
        about = {name: document[name] for name in ("last_before", "first_after")}
        add_version_change(target, key, about | {"note": change.note})
    if as_json:
        print_json(document)
    else:
        click.echo(change.sentence)
    sys.exit(ExitCode.SUCCESS if change.first_after else ExitCode.DISAGREEMENT)


def _report(version: str, text: str) -> None:
    log(f"{version}: {text}")


def _document(change: VersionChange) -> Record:
    return {
        "engine": change.engine,
        "oldest": change.oldest,
        "newest": change.newest,
        "last_before": change.last_before or None,
        "first_after": change.first_after or None,
        "answers": {version: answer.text for version, answer in change.answers.items()},
        "skipped": dict(change.skipped),
        "sentence": change.sentence,
    }


def _search_result(
    folder: Path, key: str, good: str, bad: str, jobs: int, limits: Limits
) -> tuple[VersionChange, list[str]]:
    """Search about a row of a results folder."""
    if (folder / "model.json").is_file():
        with options.exit_on_damaged_results():
            document = read_model_results(folder)
        row = _row(key, {row["key"]: row for file in document["files"] for row in file["rows"]})
        plan = ModelPlan.of_row(row, document["options"], state_count=STATES, jobs=jobs, limits=limits)
        return search_versions(plan, row["engine"].partition("@")[0], good, bad, _report)
    with options.exit_on_damaged_results():
        document = read_results(folder)
    row = _row(key, {row["key"]: row for row in document["rows"]})
    scenario = _scenario(row["scenario"], document["scenarios"])
    run = Plan([scenario], [], jobs=jobs, limits=limits)
    return search_versions(run, row["engine"].partition("@")[0], good, bad, _report, row)


def _row(key: str, rows: Mapping[str, Record]) -> Record:
    if key not in rows:
        hint = did_you_mean(key, list(rows)) or "`reproduce` lists the disagreements"
        raise click.UsageError(f"no row {shorten(repr(key))}; {hint}")
    return rows[key]


def _scenario(name: str, stored: Mapping[str, Any]) -> Scenario:
    """The scenario of a row: random ones are made again, others read from their file."""
    entry, seed = stored.get(name, {}), random_seed(name)
    if entry.get("family") == RANDOM_FAMILY and seed is not None:
        return RandomScenarios(seed, 0).named(name)
    origin = str(entry.get("file", ""))
    (found,) = options.read_scenarios([origin if "/" in origin else name])
    if entry.get("digest") not in (None, found.digest):
        log(f"the scenario {name} has changed since the run")
    return found
