"""Commands about stored results: history, report, reproduce."""

from __future__ import annotations

import sys
from pathlib import Path

import click

import reports
from plumbline import layout
from plumbline.cli import options
from plumbline.cli.help_texts import examples
from plumbline.cli.terminal_output import count_noun, line_width, log, make_console, print_json, print_table
from plumbline.engines.registry import SCRIPTED_IMPORTERS
from plumbline.judging.rows import Verdict
from plumbline.scenario.line_and_column_errors import did_you_mean
from plumbline.storage.results_store import Record, read_results

NIGHTS = layout.output_folder("nightly")
MAKES_ONE = f"`python -m plumbline nightly` makes one in the folder `{NIGHTS}`"


@click.command(
    epilog=examples("history nightly", 'history nightly --key "double-*/mujoco/state/*"'),
)
@click.argument("folder", default=NIGHTS, type=options.FolderPath())
@click.option("--key", "pattern", help="Trend of the rows whose key matches (* and ?).")
@options.json_option
def history(folder: Path, pattern: str | None, as_json: bool) -> None:
    """Print verdict counts, findings with their lives and changes since the last green night in FOLDER."""
    from plumbline.storage.history_of_nights import History

    _check_history_folder(folder)
    document = History(folder).to_document(pattern)
    if as_json:
        print_json(document)
    else:
        _print_history(folder, document, pattern)
    if document["damaged"]:
        raise click.UsageError(
            "\n".join(f"damaged, left out: {sentence}" for sentence in document["damaged"])
        )


def _print_issue(folder: Path, name: str) -> None:
    """Print the text for the tracker, with a script that is written where the run wrote none."""
    from plumbline.reproduce.write import write_scripts
    from reports.issue_text import issue_text
    from reports.stored_results import Results

    with options.exit_on_damaged_results():
        results = Results.load(folder)
        finding = results.findings[_place_of(name, [f["name"] for f in results.findings])]
        verdicts = {row["key"]: row["verdict"] for row in results.rows}
        wrong = [key for key in finding["rows"] if verdicts[key] == Verdict.DISAGREES]
        if wrong and results.scripts.keys().isdisjoint(finding["rows"]):
            written = write_scripts(options.claim_folder(folder, "FOLDER"), wrong[:1])
            for reason in written.reasons.values():
                log(f"no script: {reason}")
            results = Results.load(folder)
        click.echo(issue_text(results, finding))


def _place_of(name: str, names: list[str]) -> int:
    """Return which finding has a name, or alone begins with it."""
    places = [names.index(name)] if name in names else [i for i, x in enumerate(names) if x.startswith(name)]
    if len(places) != 1:
        hint = did_you_mean(name, [names[i] for i in places] or names) or "`plumbline explain` lists them"
        several = f"{len(places)} findings begin so" if places else "no finding has this name"
        raise click.UsageError(f"{name!r}: {several}; {hint}")
    return places[0]


def _print_history(folder: Path, document: Record, pattern: str | None) -> None:
    trend = document.get("trend", [])
    print_table(document["nights"], "nights")
    print_table(
        [{k: v for k, v in life.items() if k != "sentence"} for life in document["findings"]], "findings"
    )
    print_table(trend, "trend")
    lines = list(_history_lines(document))
    if not document["nights"]:
        lines.append(f"no readable nights in {folder}")
    elif pattern is not None and not trend:
        lines.append(f"no row matches {pattern!r}")
    out = make_console(sys.stdout)
    for line in lines or ["nothing is bad, nothing changed"]:
        out.print(line, markup=False)


def _check_history_folder(folder: Path) -> None:
    options.check_history_tool()
    if not folder.is_dir():
        what = f"{folder} is a file and no folder of nights" if folder.exists() else f"no folder {folder}"
        raise click.UsageError(f"{what}: no nights yet; {MAKES_ONE}")
    from plumbline.storage.history_of_nights import night_folders

    if not night_folders(folder):
        raise click.UsageError(f"no complete night in {folder}; {MAKES_ONE}")


def _history_lines(document: Record) -> list[str]:
    lines = [f"version: {sentence}" for sentence in document["versions"]]
    since = f"since the last green {document['last_green']}"
    return lines + [f"{since}: {c['key']} {c['was']} → {c['is']}" for c in document["since_green"]]


def _reproduce_model(folder: Path, keys: tuple[str, ...], form: str | None) -> None:
    """Write scripts of importers' differences, or list the differences."""
    from plumbline.model_files.model_run import ModelPlan
    from plumbline.model_files.model_script import NoModelScript, stored_differences, write_model_script
    from plumbline.storage.results_store import read_model_results, write_atomically
    from plumbline.storage.script_index import script_name, scripts_folder
    from plumbline.storage.version_changes import read_version_changes

    with options.exit_on_damaged_results():
        document = read_model_results(folder)
    found = stored_differences(document)
    if not keys:
        for key, row in found.items():
            click.echo(f"{key}: {row['diagnosis'] or row['reason']}")
        log(count_noun(len(found), "difference") if found else "nothing differs")
        return
    for key in keys:
        if key not in found:
            raise click.UsageError(f"no difference {key!r}; without KEY the command lists them")
    chosen, changes = options.claim_folder(folder, "RESULT"), read_version_changes(folder)
    for key in keys:
        row = found[key]
        engine, since = row["engine"].partition("@")[0], str(changes.get(key, {}).get("note", ""))
        plan = ModelPlan.of_row(row, document["options"])
        try:
            script = write_model_script(plan, form or engine, since=since)
        except NoModelScript as error:
            raise click.ClickException(f"{key}: {error}") from None
        path = scripts_folder(chosen) / script_name(f"{Path(row['scenario']).stem}-{row['engine']}")
        path.parent.mkdir(exist_ok=True)
        write_atomically(path, script.text.encode())
        click.echo(str(path))


@click.command()
@click.argument("folder", default=layout.DEFAULT_OUT, type=options.ResultsPath())
@click.option(
    "--history",
    "history_folder",
    type=options.FolderPath(),
    help="Folder of earlier nights: adds trends and the comparison with the last green one.",
)
@click.option(
    "--issue",
    metavar="FINDING",
    help="Print the text of an issue for the engine's tracker instead, of a finding or of the one whose name "
    "begins so.",
)
def report(folder: Path, history_folder: Path | None, issue: str | None) -> None:
    """Write report.html, junit.xml, summary.md and findings.sarif again, from the results in FOLDER.

    With --issue: print what to tell the engine's maintainers about a finding, in their tracker's form.
    """
    if issue is not None:
        _print_issue(folder, issue)
        return
    if history_folder is not None:
        _check_history_folder(history_folder)
    with options.exit_on_damaged_results():
        read_results(folder)  # before the folder is made writable: there may be none
        click.echo(f"report: {reports.write(options.claim_folder(folder, 'FOLDER'), history_folder)}")


@click.command(
    epilog=examples(
        "reproduce reports/out", "reproduce reports/out chain-50-balls/pinocchio-aba/state/-/acceleration"
    ),
)
@click.argument("folder", metavar="RESULT", type=options.ResultsPath())
@click.argument("keys", nargs=-1, metavar="[KEY]...")
@click.option(
    "--form",
    type=click.Choice(SCRIPTED_IMPORTERS),
    help="Of results of `model`: the engine whose calls the script uses. Default: the importer's own.",
)
def reproduce(folder: Path, keys: tuple[str, ...], form: str | None) -> None:
    """Write a stand-alone script that shows a disagreement, for the engine's maintainers.

    RESULT is a results folder or its results.json; KEY is a row's key. Without KEY, the disagreements are
    listed. Of a folder that `model --out` wrote, the script holds the smallest model file that still shows
    the difference.
    """
    if (folder / "model.json").is_file():
        _reproduce_model(folder, keys, form)
        return
    if form is not None:
        raise click.UsageError("--form is for results of `model`; these are of a run")
    from plumbline.reproduce.write import list_disagreements, write_scripts

    with options.exit_on_damaged_results():
        if not keys:
            found = list_disagreements(folder)
            for key, reason in found.items():
                click.echo(f"{key}: {reason}")
            log(count_noun(len(found), "disagreement") if found else "nothing disagrees")
            return
        read_results(folder)
        written = write_scripts(options.claim_folder(folder, "RESULT"), keys)
    for path in dict.fromkeys(written.files.values()):
        click.echo(str(path))
    for key, reason in written.reasons.items():
        raise click.ClickException(f"{key}: {reason}")


@click.command(
    epilog=examples(
        "explain", "explain mujoco-by-tendon-equalities", "explain NAME --results nightly/history/ID"
    ),
)
@click.argument("name", required=False, metavar="[FINDING]")
@click.option(
    "--results",
    "folder",
    default=layout.DEFAULT_OUT,
    type=options.ResultsPath(),
    help="Folder of results. Default: that of `run`.",
)
@options.known_option
def explain(name: str | None, folder: Path, known_files: tuple[Path, ...]) -> None:
    """Print everything that is known about a finding of a run, or list its findings.

    FINDING is a name that `run` prints, or its beginning.
    """
    from plumbline.cli import findings_output as output
    from plumbline.judging.known_issues import project_known_issues
    from plumbline.storage.schema_upgrade import findings_of_records
    from plumbline.storage.script_index import read_script_index, scripts_folder

    with options.exit_on_damaged_results():
        document = read_results(folder)
        scripts = {key: str(scripts_folder(folder) / file) for key, file in read_script_index(folder).items()}
    found = findings_of_records(document["rows"], document["scenarios"])
    if name is None:
        for finding in found:
            click.echo(f"{finding.name}: {output.coverage(finding)}")
        log(count_noun(len(found), "finding") if found else "no finding")
        return
    chosen = found[_place_of(name, [f.name for f in found])]
    own = options.read_known_issues(known_files, list(document["scenarios"]))
    issues = {issue.name: issue for issue in (*project_known_issues(), *own)}
    issue, width = issues.get(chosen.known_issue or ""), line_width(make_console(sys.stdout))
    is_own = document["scenarios"].get(chosen.rows[0].scenario, {}).get("own", False)
    command = str(document["run"]["command"]) if is_own else ""
    for line in output.explain(chosen, issue, scripts, width, command):
        click.echo(line)


@click.command(epilog=examples("known mine.yaml > mine-by-finding.yaml"))
@options.files_argument
def known(files: tuple[Path, ...]) -> None:
    """Print entries of files of known issues by finding: those of one engine and one reason as one.

    Older files have an entry for each selection of rows; they stay valid.
    """
    from plumbline.judging.known_issue_text import entry_lines, merge_entries
    from plumbline.judging.known_issues import KNOWN_ISSUES_FILE
    from plumbline.scenario.yaml_reader import read_yaml

    options.read_known_issues((KNOWN_ISSUES_FILE, *files), [])  # ends with every problem of the files
    for entry in merge_entries([entry for path in files for entry in read_yaml(path).data]):
        for line in entry_lines(entry):
            click.echo(line)
