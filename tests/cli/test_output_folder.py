"""The output folder: one command at a time writes to it; stored results are named by folder or by file."""

import json
import os
import shutil
from unittest.mock import patch

import pytest

from plumbline.cli.options import LOCK_FILE
from plumbline.execution.exit_codes import ExitCode
from plumbline.processes.isolation import FileLock
from plumbline.storage.results_store import read_results
from tests.helpers import ROOT, example_results
from tests.helpers.commands import invoke, run_plumbline
from tests.helpers.requirements import needs_pipes

SWEEP = (
    "schema_version: 1\nscenario: tumbling-rod\nvary: {'bodies[0].mass': {values: [1, 2]}}\nduration: 0.25\n"
)


@pytest.fixture
def results(tmp_path):
    return example_results.build_small(tmp_path / "out")


@pytest.mark.parametrize("command", ["run", "nightly", "sweep", "drift", "report", "reproduce"])
def test_a_folder_that_another_command_writes_to_is_refused(results, tmp_path, command):
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    words = {
        "run": ["rest", "--out", results],
        "nightly": ["rest", "--out", results],
        "sweep": [tmp_path / "sweep.yaml", "--out", results],
        "drift": ["rest", "--out", results],
        "report": [results],
        "reproduce": [results, "a key"],
    }[command]
    before = {path: path.stat().st_mtime_ns for path in results.rglob("*")}
    with FileLock(results / LOCK_FILE):
        result = invoke(command, *words, code=ExitCode.BAD_USAGE)
        assert "another command writes to" in " ".join(result.stderr.split())
        assert ("--out" in result.stderr) == ("--out" in words)
    assert before.items() == {path: path.stat().st_mtime_ns for path in results.rglob("*")}.items()


def test_a_command_holds_the_lock_while_it_runs_and_leaves_none(tmp_path):
    class Began(BaseException):
        pass

    def run_plan(*_):
        assert invoke("run", "rest", "--out", tmp_path).exit_code == ExitCode.BAD_USAGE
        raise Began

    with patch("plumbline.cli.run_commands.run_plan", side_effect=run_plan) as ran, pytest.raises(Began):
        invoke("run", "rest", "--out", tmp_path)
    assert ran.call_count == 1 and not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["report", "reproduce"])
def test_results_are_named_by_their_folder_or_their_file(results, command):
    for name in (results, results / "results.json"):
        invoke(command, name, code=0)
    other = invoke(command, results / "summary.parquet", code=ExitCode.BAD_USAGE)
    assert "is neither a results folder nor its results.json" in " ".join(other.stderr.split())


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [
        ("trajectories.parquet", lambda data: data[:-20], "trajectories.parquet: is damaged: "),
        ("states.parquet", lambda data: b"PAR1", "states.parquet: is damaged: "),
        ("results.json", lambda data: data[:1000], "results.json: not a results file of plumbline"),
        ("scripts/index.json", lambda data: b"[1]", "index.json: not an object of row keys"),
        ("trajectories.parquet", None, "trajectories.parquet: has not the 2 bodies of results.json"),
    ],
)
def test_a_damaged_file_leaves_the_report_as_it_was(results, name, damage, words):
    assert invoke("report", results).exit_code == 0
    pages = [(results / page) for page in ("report.html", "junit.xml", "summary.md")]
    for page in pages:
        page.write_text("as it was")
    if damage:
        (results / name).write_bytes(damage((results / name).read_bytes()))
    else:  # one body more than the table has
        document = read_results(results)
        for scenario in document["scenarios"].values():
            scenario["bodies"] = 2
            for name in scenario["model"].keys() - {"gravity"}:
                scenario["model"][name] *= 2
            scenario.pop("state", None)
        (results / "results.json").write_text(json.dumps(document))
    result = invoke("report", results, code=ExitCode.BAD_USAGE)
    assert words in result.stderr
    assert all(page.read_text() == "as it was" for page in pages)


@pytest.mark.timeout(60)  # opening a pipe that nobody writes to blocks
@needs_pipes
@pytest.mark.parametrize("make", ["mkdir", "mkfifo"])
def test_a_folder_or_a_pipe_in_the_place_of_a_file_is_a_bad_file(results, make):
    files = {"results.json": ["report", "reproduce"], "scripts/index.json": ["report"]}
    for name, commands in (files | {"states.parquet": ["report"]}).items():
        path = results / name
        path.parent.mkdir(exist_ok=True)
        content = path.read_bytes() if path.exists() else b"{}"
        path.unlink(missing_ok=True)
        getattr(os, make)(path)
        for command in commands:
            result = invoke(command, results, code=ExitCode.BAD_USAGE)
            message = " ".join(result.stderr.split())
            assert path.name in message and "not a regular file" in message
        path.rmdir() if make == "mkdir" else path.unlink()
        path.write_bytes(content)


def test_the_command_that_repeats_a_cell_names_the_file_as_given(tmp_path, monkeypatch):
    """A file of the user that has the name of a catalogue file is not taken for that file."""
    monkeypatch.chdir(tmp_path)
    mine = tmp_path / "rest.yaml"
    shutil.copy(ROOT / "scenarios" / "single" / "rest.yaml", mine)
    for given, stored in (("rest.yaml", "./rest.yaml"), (str(mine), str(mine)), ("rest", "rest.yaml")):
        words = ["run", given, "--engine", "mujoco", "--level", "state", "--jobs", "1", "--out", "out"]
        run_plumbline(*words, cwd=tmp_path, code=0)
        assert read_results(tmp_path / "out")["scenarios"]["rest"]["file"] == stored


def test_an_engine_that_crashes_at_import_ends_no_sweep(tmp_path):
    (tmp_path / "sweep.yaml").write_text(SWEEP + "engines: {mujoco: RK4}\n")
    (tmp_path / "mujoco.py").write_text("import os\nos.abort()\n")
    words = ["sweep", "sweep.yaml", "--jobs", "1", "--out", "out"]
    done = run_plumbline(*words, cwd=tmp_path, path=(tmp_path, ROOT), code=ExitCode.ENGINE_FAILED)
    assert "mujoco failed 2; reference agrees 2" in done.stdout
    assert "crashed: the worker died of SIGABRT" in done.stdout
    assert "of 1 tasks done" in done.stderr
