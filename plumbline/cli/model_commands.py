"""The command `model`: one URDF or MJCF file, every engine's importer."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
from rich.markup import escape
from rich.table import Table

from plumbline import __version__
from plumbline.cli import options
from plumbline.cli.help_texts import command
from plumbline.cli.terminal_output import (
    ProgressDisplay,
    command_line,
    count_noun,
    log,
    make_console,
    print_json,
    print_legend,
)
from plumbline.cli.verdict_matrix import coloured_glyph, engine_heading
from plumbline.engines.environments import is_optional_importer
from plumbline.engines.registry import IMPORTERS
from plumbline.execution.runner import git_commit
from plumbline.importers.neutral_model import MODEL_UNITS, Feature
from plumbline.judging.rows import Row, Verdict
from plumbline.layout import IS_INSTALLED
from plumbline.model_files.importer_cause import Explanation
from plumbline.model_files.mechanism_of_file import feature_words, load_model_file
from plumbline.model_files.model_rows import IS_REFUSED, FileResult
from plumbline.model_files.model_run import ModelPlan, ModelRunResult, run_model_files
from plumbline.processes.user_cache import naming_file
from plumbline.processes.worker_pool import Limits
from plumbline.scenario.line_and_column_errors import MAX_LISTED_PROBLEMS, ScenarioError, shorten
from plumbline.scenario.mechanism_document import scenario_text
from plumbline.storage.results_store import Record, row_record, to_json_value

COLUMN_HEADINGS = {
    "joints": "joints", "total_mass": "mass", "position": "position", "attitude": "attitude",
    "mass_matrix": "M", "gravity_force": "gravity", "bias_force": "h", "passive_force": "passive",
    "damping": "damping", "acceleration": "accel.",
    "kinetic_energy": "kinetic", "potential_energy": "potential", "rewritings": "rewritten",
}  # fmt: skip
MAX_STATES = 10_000
MAX_REASON = 400  # characters on the terminal; the results have all


def _choose_importers(_: click.Context, __: click.Parameter, names: Sequence[str]) -> tuple[str, ...]:
    for name in names:
        options.check_importer(name)
    return tuple(dict.fromkeys(names)) or tuple(IMPORTERS)


def _parse_state(_: click.Context, __: click.Parameter, text: str | None) -> dict[str, float] | None:
    """Parse j1=0.3,j2=-0.1."""
    if text is None:
        return None
    state: dict[str, float] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, sign, value = part.rpartition("=")
        if not sign:
            raise click.BadParameter(f"{part!r} is no JOINT=NUMBER")
        try:
            state[name.strip()] = float(options.FiniteNumber().convert(value, None, None))
        except click.BadParameter as error:
            raise click.BadParameter(f"{part!r}: {error.message}") from None
    return state


@command(
    "model robot.urdf",
    "model robot.urdf --base free --engine mujoco --engine pinocchio",
    "model robots/*.xml --strip-geometry --json | jq '.files[].causes'",
    "model arm.urdf --engine mujoco@3.9.0 --engine mujoco@4.0.0",
    "model arm.urdf --at shoulder=0.3,elbow=-1.2",
)
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@options.model_file_options(are_passed=True)
@click.option(
    "--engine",
    "engines",
    multiple=True,
    callback=_choose_importers,
    help="Only this engine's importer (may be repeated); mujoco@3.9.0, @latest or @path/to.whl for another "
    f"version. Default: {', '.join(IMPORTERS)}.",
)
@click.option(
    "--states",
    "state_count",
    type=click.IntRange(1, MAX_STATES),
    default=20,
    help="Random states at which the quantities are compared; the same for the same file name.",
)
@click.option(
    "--at",
    "state",
    metavar="STATE",
    callback=_parse_state,
    help="Compare at this state at rest instead: JOINT=NUMBER,… in rad or m; other joints at their "
    "reference.",
)
@click.option(
    "--strip-geometry",
    is_flag=True,
    help="Load a copy without visual and collision geometry, so that missing meshes do not matter. In MJCF "
    "only bodies with <inertial> are stripped: elsewhere geometry defines the mass.",
)
@options.known_option
@options.jobs_option
@options.limits_options(120.0)
@options.json_option
@click.option("--out", type=options.FolderPath(), help="Folder for report, junit.xml, SARIF and results.")
@click.option(
    "--to-scenario",
    "scenario_file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Compare nothing; write one model file as a scenario file, to be changed and run.",
)
def model(
    files: tuple[str, ...], base: Any, engines: tuple[str, ...], state_count: int,
    state: dict[str, float] | None, strip_geometry: bool, root: Path | None, known_files: tuple[Path, ...],
    jobs: int, limits: Limits, as_json: bool, out: Path | None, scenario_file: Path | None,
) -> None:  # fmt: skip
    """Compare what engines' importers make of a URDF or MJCF file, and name the parameter that differs.

    Each importer loads the file in a process of its own. At random states its joints, masses, poses, mass
    matrix M, bias force h, gravity and passive forces, accelerations and energies are compared with
    certified values of what the file says: of a URDF by Plumbline's own reader, of an MJCF by MuJoCo's
    compiled model, since MuJoCo defines that format. A difference is named by body or joint, parameter, both
    values and line where one change of the model reproduces all of the importer's numbers to rounding.

    Actuators, tendons, equalities, contacts, limits and mimic joints are not compared, and listed. An
    importer that refuses the file has answered; the exit code is then 1 only if --engine named it.
    """
    if scenario_file is not None:
        return _write_scenario(files, base, root, scenario_file)
    plan = ModelPlan(
        files, engines, options.are_engines_named(), base, root, strip_geometry, state_count,
        state, jobs, limits, tuple(options.read_known_issues(known_files, files)),
    )  # fmt: skip
    folder = options.claim_folder(out) if out is not None else None
    with options.exit_on_io_error(), ProgressDisplay(sys.stderr) as progress:
        result = run_model_files(plan, progress)
    document = model_document(result)
    if as_json:
        print_json(document)
    else:
        for file in result.files:
            _print_file(file, result)
        if result.files:
            print_legend(row for file in result.files for row in file.rows)
            _print_missing(result)
    for problem in result.problems[:MAX_LISTED_PROBLEMS]:
        log(str(problem))
    if folder is not None:
        _write_reports(document, folder, as_json)
    sys.exit(result.exit_code)


def _write_scenario(files: Sequence[str], base: Any, root: Path | None, to: Path) -> None:
    """Write a model file as a scenario file, and what the mechanism leaves out."""
    if len(files) != 1:
        raise click.UsageError("--to-scenario takes one model file")
    if to.exists() and Path(files[0]).exists() and to.samefile(files[0]):
        raise click.BadParameter("would overwrite the model file", param_hint="--to-scenario")
    try:
        scenario, document = load_model_file(Path(files[0]), base, root)
    except ScenarioError as error:
        options.exit_on_bad_file(error)
    with options.exit_on_io_error(), naming_file(to):
        to.write_text(scenario_text(document), encoding="utf-8")
    click.echo(f"{to}: {count_noun(scenario.model.n, 'body', 'bodies')}. {scenario.purpose}")


def _write_reports(document: Record, folder: Path, as_json: bool) -> None:
    from reports import model_page

    with options.exit_on_io_error():
        page = model_page.write(folder, document)
    click.echo(f"report: {page}", err=as_json)


def model_document(result: ModelRunResult) -> Record:
    """Write a result as a document for other programs."""
    plan = result.plan
    document = {
        "version": __version__,
        "commit": git_commit(),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command_line(),
        "options": {
            "base": plan.base,
            "root": None if plan.root is None else str(plan.root),
            "strip_geometry": plan.strip_geometry,
            "at": plan.at,
        },
        "engines": {name: {"version": i.version, "missing": i.missing} for name, i in result.engines.items()},
        "files": [
            {
                "file": file.file,
                "name": file.model.name,
                "bodies": len(file.model.bodies),
                "degrees_of_freedom": file.model.velocity_count,
                "quantities": _compared_quantities(file),
                "rows": [row_record(row) for row in file.rows],
                "causes": list(_cause_records(file)),
                "unproved": [name for name, e in file.explanations.items() if not e.is_proved],
                "drawing": [
                    {
                        "name": body.name,
                        "parent": file.model.bodies[body.parent].name if body.parent >= 0 else "",
                        "origin": file.poses[body.name][:, 3].tolist(),
                    }
                    for body in file.model.bodies
                    if body.name in file.poses
                ],
                "not_compared": [_feature_record(f) for f in file.model.not_compared],
                "ambiguous": [_feature_record(f) for f in file.model.ambiguous],
            }
            for file in result.files
        ],
        "problems": [
            {"file": p.file, "line": p.line, "column": p.column, "text": str(p)} for p in result.problems
        ],
        "exit_code": int(result.exit_code),
    }
    found: Record = to_json_value(document)
    return found


def _cause_records(file: FileResult) -> Iterator[Record]:
    for name, explanation in file.explanations.items():
        rows = [row for row in file.rows if row.engine == name and row.verdict == Verdict.DISAGREES]
        is_known = all(row.known_issue is not None for row in rows)
        for cause in explanation.causes:
            first = cause.changes[0]
            source = {"file": first.source.file, "line": first.source.line}
            yield {
                "engine": name, "field": cause.field, "body": first.body, "joint": first.joint,
                "bodies": sorted({change.carrier or change.body for change in cause.changes}),
                "count": len(cause.changes), "source": source, "sentence": cause.sentence, "known": is_known,
            }  # fmt: skip


def _feature_record(feature: Feature) -> Record:
    source = feature.source
    return {"what": feature.what, "name": feature.name, "file": source.file, "line": source.line}


def _print_file(file: FileResult, result: ModelRunResult) -> None:
    """Print the table of one file, the causes and what is not compared."""
    out = make_console(sys.stdout)
    bodies = count_noun(len(file.model.bodies), "body", "bodies")
    freedom = count_noun(file.model.velocity_count, "degree of freedom", "degrees of freedom")
    out.print(f"[bold]{escape(file.file)}[/]: {bodies}, {freedom}")
    by_engine: dict[str, list[Row]] = {}
    for row in file.rows:
        by_engine.setdefault(row.engine, []).append(row)
    out.print(_file_table(file, by_engine, result))
    for name, rows in by_engine.items():
        for line in _reasons(name, rows, file):
            out.print(line)
    for title, features in (("not compared", file.model.not_compared), ("left open", file.model.ambiguous)):
        if features:
            out.print(f"[dim]{title}: {escape(feature_words(features, file.file))}[/]")


def _print_missing(result: ModelRunResult) -> None:
    """Print why importers are missing, those with one reason together."""
    glyph = Verdict.NOT_INSTALLED.style.glyph
    absent = [name for name in result.plan.importers if result.engines[name].missing]
    optional = [n for n in absent if is_optional_importer(n) and not result.engines[n].version]
    if optional:
        it, importers = ("it", "importer") if len(optional) == 1 else ("them", "importers")
        way = "pip" if IS_INSTALLED else "`make importers`"
        click.echo(f"{glyph} {importers} of {', '.join(optional)}: not installed here; {way} installs {it}")
    for name in absent:
        if name not in optional:
            click.echo(f"{glyph} {name}: {result.engines[name].missing}")


def _compared_quantities(file: FileResult) -> list[str]:
    """The quantities that any importer's rows have, in the order of the tables."""
    found = {row.quantity for row in file.rows}
    return [quantity for quantity in MODEL_UNITS if quantity in found]


def _file_table(file: FileResult, by_engine: dict[str, list[Row]], result: ModelRunResult) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("importer")
    shown = _compared_quantities(file)
    for quantity in shown:
        table.add_column(COLUMN_HEADINGS[quantity])
    for name, rows in by_engine.items():
        cells = {row.quantity: coloured_glyph(row) for row in rows}
        heading = engine_heading(name, result.engines[name].version) if name in result.engines else name
        first = f"{cells['all']} {escape(heading)}" if "all" in cells else escape(heading)
        table.add_row(first, *(cells.get(quantity, "") for quantity in shown))
    return table


def _reasons(name: str, rows: Sequence[Row], file: FileResult) -> list[str]:
    """Say why an importer's rows do not agree: proved causes, else each row's reason."""
    silent = (Verdict.AGREES, Verdict.INFORMATION, Verdict.NOT_INSTALLED)
    bad = [row for row in rows if row.verdict not in silent and row.known_issue is None]
    explanation = file.explanations.get(name) or Explanation(is_proved=True)
    informed = [row for row in rows if row.verdict == Verdict.INFORMATION]
    not_read = [row for row in informed if row.extra.get(IS_REFUSED) or row.quantity == "all"]
    unexplained = [row for row in bad if row.diagnosis is None]
    lines = [f"{coloured_glyph(bad[0])} {escape(cause.sentence)}" for cause in explanation.causes if bad]
    for row in (*unexplained, *not_read):
        words = shorten(" ".join(row.reason.split()), MAX_REASON)
        lines.append(f"{coloured_glyph(row)} {escape(f'{row.engine}: {words}')}")
    if bad and not explanation.is_proved:
        fields = Counter(change.field for change in explanation.differences)
        words = ", ".join(f"{field} ({count})" for field, count in fields.items()) or "nothing"
        lines.append(f"  no cause is proved; its description differs from the file in: {escape(words)}")
    return lines
