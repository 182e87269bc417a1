"""The command line as a user types it: real engines, real exit codes."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch
from xml.etree import ElementTree

import pytest

import plumbline as package
from plumbline.cli.main import COMMANDS, main
from plumbline.cli.verdict_matrix import engine_heading
from plumbline.execution.runner import exit_code, summarize_verdicts
from plumbline.judging.findings import find_findings
from plumbline.judging.rows import RowContext, Verdict
from plumbline.scenario import loader
from plumbline.storage.results_store import SCHEMA_VERSION, read_results
from tests.helpers import ROOT
from tests.helpers.commands import invoke, run_plumbline, run_python
from tests.helpers.tables import table

CONTEXT = RowContext("scenario", "family", "engine", "Engine", "1.0")


def test_help_has_examples_and_exit_codes():
    result = run_plumbline("--help", code=0)
    for words in (
        "Exit codes",
        "0  everything agrees",
        "1  a disagreement",
        "2  bad usage",
        "3  an engine failed",
    ):
        assert words in result.stdout
    example = "\n    python -m plumbline run --family chain --level state\n"
    assert example in invoke("run", "--help").stdout
    assert "\\b" not in result.stdout


def test_every_command_has_a_short_help_that_the_list_shows_whole():
    listed = invoke().stdout
    assert listed == invoke("--help").stdout
    for name, (_, short_help) in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(short_help)}$", listed, re.M)
        command = main.get_command(None, name)
        assert command.name == name and command.help


def test_the_version_is_that_of_the_project():
    """The wheel gets it from the line that the command prints."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["tool"]["hatch"]["version"]["path"] == "plumbline/__init__.py"
    assert re.fullmatch(r"\d+\.\d+\.\d+", package.__version__)
    assert invoke("--version").stdout == f"plumbline {package.__version__}\n"


def test_the_launcher_runs_this_checkout_from_another_folder(tmp_path):
    launcher, elsewhere = tmp_path / "plumbline", tmp_path / "elsewhere"
    subprocess.run(
        ["make", "--silent", "--old-file=.venv/pyvenv.cfg", f"LAUNCHER={launcher}", launcher],
        cwd=ROOT,
        check=True,
    )
    (elsewhere / "plumbline").mkdir(parents=True)  # a package of that name there must not be taken
    (elsewhere / "plumbline" / "__init__.py").write_text("raise SystemExit('the wrong package')")
    scenario = elsewhere / "a b.yaml"
    scenario.write_text((ROOT / "scenarios" / "single" / "rest.yaml").read_text())
    result = subprocess.run([launcher, "check", "a b.yaml"], cwd=elsewhere, capture_output=True, text=True)
    assert (result.returncode, result.stdout) == (0, "a b.yaml: ok: a b, 1 body (ball)\n"), result.stderr


@pytest.fixture(scope="module")
def checkouts(tmp_path_factory):
    """Checkouts: a, with an environment; linked, with a link to it; copied, with its copy; bare, without."""
    folder = tmp_path_factory.mktemp("checkouts").resolve()
    for name in ("a", "linked", "copied", "bare"):
        place = folder / name
        for part in ("plumbline", "tools"):
            shutil.copytree(ROOT / part, place / part, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "Makefile", place)
        (place / "plumbline" / "__init__.py").write_text(f'"""A copy."""\n\n__version__ = "{name}"\n')
    environment = folder / "a" / ".venv"
    (environment / "bin").mkdir(parents=True)
    (environment / "bin" / "python").symlink_to(Path(sys.executable).resolve())
    shutil.copy(Path(sys.prefix) / "pyvenv.cfg", environment)
    (environment / "lib").symlink_to((Path(sys.prefix) / "lib").resolve())
    make = ["make", "--silent", "--old-file=.venv/pyvenv.cfg", ".venv/bin/plumbline"]
    subprocess.run(make, cwd=folder / "a", check=True)
    (folder / "linked" / ".venv").symlink_to(environment)
    shutil.copytree(environment, folder / "copied" / ".venv", symlinks=True)
    (folder / "elsewhere").mkdir()
    (folder / "link to the launcher").symlink_to(environment / "bin" / "plumbline")
    return folder


@pytest.mark.parametrize(
    ("current", "launcher", "expected"),
    [
        ("a", ".venv/bin/plumbline", "a"),
        ("a/tools", "../.venv/bin/plumbline", "a"),
        ("a/.venv/bin", "./plumbline", "a"),
        ("elsewhere", "CHECKOUTS/a/.venv/bin/plumbline", "a"),
        ("elsewhere", "CHECKOUTS/link to the launcher", "a"),
        ("linked", ".venv/bin/plumbline", "linked"),
        ("linked/tools", "CHECKOUTS/linked/.venv/bin/plumbline", "linked"),
        ("elsewhere", "CHECKOUTS/linked/.venv/bin/plumbline", "linked"),
        ("copied", ".venv/bin/plumbline", "copied"),
        ("elsewhere", "../copied/.venv/bin/plumbline", "copied"),
        ("linked", "CHECKOUTS/a/.venv/bin/plumbline", None),
        ("bare/plumbline/cli", "CHECKOUTS/a/.venv/bin/plumbline", None),
        ("a", "CHECKOUTS/copied/.venv/bin/plumbline", None),
        ("bare", "CHECKOUTS/link to the launcher", None),
    ],
)
def test_a_launcher_never_silently_runs_another_checkout(checkouts, current, launcher, expected):
    done = subprocess.run(
        [launcher.replace("CHECKOUTS", str(checkouts)), "--version"], cwd=checkouts / current,
        env={key: value for key, value in os.environ.items() if key != "PYTHONPATH"},
        capture_output=True, text=True,
    )  # fmt: skip
    if expected:
        assert (done.returncode, done.stdout) == (0, f"plumbline {expected}\n"), done.stderr
        return
    assert (done.returncode, done.stdout) == (2, "")
    here = checkouts / current.partition("/")[0]
    assert (
        f"the current folder is in another checkout, {here}: call {here}/.venv/bin/plumbline" in done.stderr
    )


def row(verdict, known_issue=None, quantity="q", **more):
    return CONTEXT.make_row("state", "-", quantity, Verdict(verdict), "why", known_issue=known_issue, **more)


def result_of(rows, stale=0, own=frozenset()):
    """What a run found, as far as its summary and its exit code depend on it."""
    return SimpleNamespace(
        rows=rows,
        findings=find_findings(rows, {}),
        stale_issues=stale * [SimpleNamespace(id="k")],
        random_batch=SimpleNamespace(counts_by_verdict=Counter()),
        own_scenarios=own,
    )


def test_the_summary_counts_one_and_several():
    one, several = (result_of(count * [row("agrees"), row("disagrees")], count) for count in (1, 2))
    assert summarize_verdicts(one).startswith("2 independent checks: 1 agrees, ")
    words = "1 disagrees (engine-q-at-level-state)", "1 known entry no longer occurs (k)"
    assert all(part in summarize_verdicts(one) for part in words)
    words = "2 agree", "2 disagree (engine-q-at-level-state)", "2 known entries no longer occur (k, k)"
    assert all(part in summarize_verdicts(several) for part in words)


def test_findings_of_the_last_night_do_not_count_but_new_ones_and_failures_do():
    old, new = row("disagrees"), row("disagrees", quantity="new")
    found = result_of([row("agrees"), old])
    (name,) = (finding.name for finding in found.findings)
    assert (exit_code(found), exit_code(found, {name}), exit_code(found, {"other"})) == (1, 0, 1)
    for rows, code in (([old, new], 1), ([old, row("failed")], 3), ([old, row("harness failed")], 5)):
        found = result_of([row("agrees"), *rows])
        seen = {one.name for one in found.findings if one.quantities != ["new"]}
        assert exit_code(found, seen) == code


def test_information_is_counted_apart_and_changes_no_exit_code():
    result = result_of([row("agrees")] * 1200 + [row("information")] * 3)
    assert summarize_verdicts(result) == "1,200 independent checks: 1,200 agree, 3 are information"
    assert exit_code(result) == 0
    one = result_of([row("agrees"), row("information")])
    assert summarize_verdicts(one) == "1 independent check: 1 agrees, 1 is information"
    result.rows.append(row("unsupported", quantity="all"))
    assert summarize_verdicts(result).startswith("1,200 independent checks: "), "nothing was compared there"


def test_the_summary_says_why_rows_were_expected():
    known = [row("disagrees", "entry"), row("unsupported", "entry"), *2 * [row("unresolved", "entry")]]
    declared = 2 * [row("unsupported", "loops", is_declared=True)]
    assert summarize_verdicts(result_of([*known, *declared, row("unresolved")])) == (
        "4 independent checks: 1 disagrees as recorded, 3 unresolved (2 as recorded), "
        "3 unsupported (2 as declared, 1 as recorded)"
    )


@pytest.mark.parametrize(
    ("verdicts", "own", "catalogue"),
    [
        (["agrees", "unresolved"], 0, 1),
        (["unresolved"], 1, 1),
        (["agrees", "disagrees"], 1, 1),
        (["agrees", "unsupported"], 1, 1),
        (["agrees", "failed"], 3, 3),
        (["agrees"], 0, 0),
    ],
)
def test_unresolved_rows_of_own_scenarios_fail_no_run(verdicts, own, catalogue):
    for names, code in ((frozenset({CONTEXT.scenario}), own), (frozenset(), catalogue)):
        assert exit_code(result_of(list(map(row, verdicts)), own=names)) == code


def test_a_column_names_an_engines_version_once():
    assert engine_heading("mujoco@3.12.0", "3.12.0") == "mujoco 3.12.0"
    assert engine_heading("mujoco@latest", "3.12.0") == "mujoco@latest 3.12.0"
    assert engine_heading("mujoco", "3.8.0") == "mujoco 3.8.0"
    assert engine_heading("mujoco", "") == "mujoco"


def test_list_scenarios_and_engines_as_text_and_json():
    names = [s["name"] for s in json.loads(invoke("list", "scenarios", "--json").stdout)]
    assert {"rest", "bricard"} <= set(names)
    some = dict(list(loader.catalogue().items())[:3])
    with patch("plumbline.scenario.loader.catalogue", lambda: some):
        text = invoke("list", "scenarios").stdout
    assert all(name in text for name in some) and len(names) > 80
    engines = {e["name"]: e for e in json.loads(invoke("list", "engines", "--json").stdout)}
    assert {"reference", "mujoco", "pinocchio", "exudyn"} <= set(engines)
    assert "RK4" in engines["mujoco"]["integrators"]
    names = {x["name"]: x for x in json.loads(invoke("list", "surface", "mujoco", "--json").stdout)}
    assert names["mj_fullM"] | {"place": ""} == {
        "name": "mj_fullM", "place": "", "status": "compared", "detail": "rows of the level surface"
    }  # fmt: skip
    assert invoke("list", "engines", "mujoco").exit_code == 2


def test_a_run_writes_everything_and_exits_by_its_verdict(tmp_path):
    result = run_plumbline(
        "run", "rest", "--engine", "mujoco", "--engine", "reference", "--out", tmp_path / "o o", code=0
    )
    assert "agree" in result.stdout
    assert "report.html" in result.stdout
    files = {p.name for p in (tmp_path / "o o").iterdir()}
    assert {"results.json", "summary.parquet", "states.parquet", "report.html", "junit.xml"} <= files
    document = read_results(tmp_path / "o o")
    assert document["schema_version"] == SCHEMA_VERSION
    checks = [row for row in document["rows"] if row["verdict"] != "information"]
    assert {row["verdict"] for row in checks if row["known_issue"] is None} == {"agrees"}
    shown = {row["quantity"] for row in document["rows"] if row not in checks and row["alias_of"] is None}
    # "order": below rounding; "all": studies that are left to the night
    assert shown == {"position", "attitude", "order", "all"}
    count = sum(row["verdict"] in ("agrees", "disagrees", "unresolved") for row in checks)
    assert document["run"]["sentence"].startswith(f"{count} independent checks: ")
    for name in ("report.html", "summary.md", "junit.xml"):
        assert f"{count} independent checks" in (tmp_path / "o o" / name).read_text(), name
    assert (tmp_path / "o o" / "junit.xml").read_text().count("<testcase ") == len(checks)
    (tmp_path / "o o" / "report.html").unlink()
    invoke("report", tmp_path / "o o", code=0)
    assert (tmp_path / "o o" / "report.html").exists()


def test_stdout_holds_json_alone_with_the_users_tolerance(tmp_path):
    options = "--engine mujoco --level state --json --user-rtol 1e-6 --out"
    result = invoke("run", "rest", *options.split(), tmp_path)
    document = json.loads(result.stdout)
    assert {row["user_rtol"] for row in document["rows"]} == {1e-6}
    assert document["run"]["exit_code"] == result.exit_code == 0


def test_a_name_stays_text_on_the_terminal_in_html_and_in_junit(tmp_path):
    name = "[red] <img src=x onerror=alert(1)> & 'quoted' $(reboot)"
    mine = tmp_path / "hostile.yaml"
    rest = (ROOT / "scenarios" / "single" / "rest.yaml").read_text()
    mine.write_text(rest.replace("schema_version: 1", f"schema_version: 1\nname: {json.dumps(name)}"))
    result = invoke(
        "run", mine, "--engine", "mujoco", "--level", "state", "--matrix", "--out", tmp_path / "out", code=0
    )
    assert name[:30] in result.stdout
    assert "<img" not in (tmp_path / "out" / "report.html").read_text()
    cases = ElementTree.parse(tmp_path / "out" / "junit.xml").iter("testcase")
    assert any(name in (case.get("name") or "") + (case.get("classname") or "") for case in cases)


@pytest.mark.parametrize(
    ("words", "expected"),
    table(__file__),
)
def test_bad_usage_ends_with_2_and_a_suggestion(words, expected):
    result = invoke(*words, code=2)
    assert expected in " ".join(result.stderr.split())


@pytest.mark.parametrize("command", ["run", "check", "sweep", "nightly", "prove", "coverage"])
def test_missing_files_are_reported_before_the_imports_of_the_command(command, tmp_path):
    words = [command, "--jobs=1", "no file.yaml", "none.yml"] if command == "run" else [command, "none.yml"]
    code = (
        "import sys\nfrom plumbline.cli.main import main\ntry:\n    main(sys.argv[1:])\n"
        "finally:\n    assert not {'numpy', 'pydantic', 'ruamel.yaml'} & {*sys.modules}, 'loaded'\n"
    )
    done = run_python("-c", code, *words, cwd=tmp_path)
    files = words[2:] if command == "run" else words[1:]
    assert done.stderr.splitlines() == [
        f"{name}: cannot be read: No such file or directory" for name in files
    ]
    assert (done.returncode, done.stdout, sorted(tmp_path.iterdir())) == (2, "", [])


def test_mistakes_of_other_files_are_reported_beside_a_missing_one(tmp_path):
    (tmp_path / "bad.yaml").write_text("schema_version: 1\n")
    with patch("plumbline.cli.run_commands.start_warm_process") as started:
        result = invoke("run", tmp_path / "bad.yaml", tmp_path / "none.yaml", "--out", tmp_path / "out")
    assert result.exit_code == 2 and not started.called
    assert "none.yaml: cannot be read: No such file" in result.stderr and "title: is missing" in result.stderr
    assert "Usage" in invoke("run", "none.yaml", "--help").stdout


def test_a_closed_form_that_does_not_fit_is_reported_with_line_and_column(tmp_path):
    for name, scenario in (("a", "tumbling-ball"), ("b", "tumbling-rod")):
        text = (ROOT / "scenarios" / "single" / f"{scenario}.yaml").read_text()
        (tmp_path / f"{name}.yaml").write_text(f"exact: free-top\n{text}")
    result = invoke("check", tmp_path / "a.yaml", tmp_path / "b.yaml", code=2)
    lines = result.stderr.splitlines()
    for name, line in zip("ab", lines, strict=True):
        assert line.startswith(f"{tmp_path / name}.yaml:1:8: exact: this closed form needs ")
        assert line.endswith("; remove `exact`, or name the closed form that fits")


def test_an_output_folder_that_cannot_be_written_is_an_error_before_any_work(tmp_path):
    (tmp_path / "file").write_text("x")
    result = invoke("run", "rest", "--out", tmp_path / "file" / "out", code=2)
    assert "cannot write to" in result.stderr


def test_schema_is_json():
    assert json.loads(invoke("schema").stdout)["properties"]
