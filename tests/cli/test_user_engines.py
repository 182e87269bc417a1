"""Engines of the user: by command, file or plumbline.toml; nothing of a folder is started without consent."""

import json
import shlex
import sys
from pathlib import Path

import pytest

from plumbline.engines import specifications
from plumbline.engines.registry import USER_ENGINES
from plumbline.processes.line_process import BadSpecification
from plumbline.storage.results_store import read_results
from tests.helpers import ROOT
from tests.helpers.commands import invoke

TOY = ROOT / "tests" / "helpers" / "toy_server.py"
RUN = ("run", "tumbling-ball", "--level", "state")


@pytest.fixture(autouse=True)
def no_engine_is_left(tmp_path, monkeypatch):
    monkeypatch.setenv("PLUMBLINE_CACHE", str(tmp_path / "cache"))
    USER_ENGINES.clear()
    yield
    USER_ENGINES.clear()


def toy(path=TOY):
    return f"cmd:{shlex.quote(sys.executable)} {shlex.quote(str(path))}"


def test_a_program_is_a_column_and_its_answers_are_kept_until_it_changes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    server = tmp_path / "toy.py"
    server.write_text(TOY.read_text())
    words = *RUN, "--adapter", toy("toy.py"), "--out", tmp_path / "out"
    first, second = invoke(*words), invoke(*words)
    assert first.exit_code == second.exit_code == 0, first.output
    assert "2 agree" in first.stdout and "answers of earlier runs" not in first.stderr
    assert "answers of earlier runs were used" in second.stderr
    results = read_results(tmp_path / "out")
    assert results["run"]["versions"] == {"toy": "0.1"}
    lifted = {row["quantity"] for row in results["rows"] if row["extra"].get("lifted")}
    assert lifted == {"acceleration", "angular_acceleration"}
    server.write_text(server.read_text().replace("omega, J @ omega", "omega, 1.001 * J @ omega"))
    third = invoke(*words, code=1)
    assert "disagree" in third.stdout, third.output


@pytest.mark.usefixtures("nothing_remembered")
def test_what_the_folder_names_is_started_only_with_consent_to_its_contents(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    marks = tmp_path / "started"
    server = tmp_path / "engine.py"
    server.write_text(f"open({str(marks)!r}, 'a').write('x')\n")
    python = shlex.quote(sys.executable)
    Path("plumbline.toml").write_text(f"[engines]\nmine = {json.dumps(f'cmd:{python} engine.py')}\n")
    words = *RUN, "--engine", "mine", "--out", tmp_path / "out"
    for command in (words, (*RUN, "--engine", "reference", "--out", tmp_path / "out")):
        refused = invoke(*command)
        assert not marks.exists()
    refused = invoke(*words, code=2)
    assert "--trust allows it" in refused.stderr and not marks.exists()
    assert invoke(*words, "--trust").exit_code == 3 and marks.exists()
    USER_ENGINES.clear()
    marks.unlink()
    assert invoke(*words, "--fresh").exit_code == 3 and marks.exists(), "the consent is kept"
    USER_ENGINES.clear()
    marks.unlink()
    server.write_text(server.read_text() + "\n")
    assert invoke(*words).exit_code == 2 and not marks.exists(), "another file needs another consent"


@pytest.mark.parametrize(
    "text, reason",
    [
        ("cmd:", "names no program"),
        ("cmd:A=1 B=2", "names no program"),
        ("cmd:'open", "No closing quotation"),
        ("cmd:./nothing-here", "there is no program ./nothing-here"),
        ("nothing.py:Engine", "there is no file nothing.py"),
        ("some words", "is none of cmd:PROGRAM"),
        ("mujoco=package.module:Engine", "mujoco is an engine of Plumbline"),
        ("package.module:class-name", "is none of"),
    ],
)
def test_a_specification_with_a_mistake_is_bad_usage(text, reason):
    done = invoke(*RUN, "--adapter", text, code=2)
    assert reason in " ".join(done.stderr.split())


def test_words_of_a_command_reach_the_program_as_they_are(tmp_path):
    (tmp_path / "a file").write_text("")
    found = specifications.resolve(f"cmd:X='1; echo' {sys.executable} 'a file' '$HOME' ';' -c", tmp_path)
    command, variables = specifications.split_command(found)
    assert command == (sys.executable, str(tmp_path / "a file"), "$HOME", ";", "-c")
    assert variables == {"X": "1; echo"}


def test_a_bad_project_file_is_bad_usage(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for text in ("[engines", "[engines]\nx = 1\n", "engines = 3\n", "# \xe9"):
        Path("plumbline.toml").write_bytes(text.encode("latin-1"))
        done = invoke(*RUN, "--engine", "mine", code=2)
        assert "plumbline.toml" in done.stderr
    Path("plumbline.toml").unlink()
    Path("plumbline.toml").mkdir()
    with pytest.raises(BadSpecification, match=r"plumbline\.toml: Is a directory"):
        list(specifications.found_engines(tmp_path))


@pytest.mark.parametrize(
    "text, engine, reason",
    [
        ("", "math:pi", "must be a class derived from Adapter"),
        ("from plumbline.engines.adapter import Adapter", "mine.py:Adapter", "TypeError: "),
        ("def", "mine.py:Mine", "SyntaxError: "),
        ("1 / 0", "mine.py:Mine", "ZeroDivisionError: division by zero"),
    ],
)
def test_an_adapter_that_cannot_be_served_is_bad_usage(tmp_path, monkeypatch, text, engine, reason):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(text)
    assert reason in " ".join(invoke("serve", engine, code=2).stderr.split())


def test_an_adapter_of_a_file_is_a_column(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "from adapters.reference_engine import Reference\n"
        "class Mine(Reference):\n    name = 'mine'\n    title = 'Mine'\n"
    )
    done = invoke(*RUN, "--adapter", f"{file}:Mine", "--out", tmp_path / "out", code=0)
    assert "7 agree" in done.stdout, done.output


def test_a_contract_names_what_differs_with_its_cause_and_writes_junit(tmp_path):
    wrong = tmp_path / "wrong.py"
    wrong.write_text(TOY.read_text().replace("omega, J @ omega", "omega, 1.001 * J @ omega"))
    done = invoke("contract", toy(wrong), "--level", "state", "--junit", tmp_path / "junit.xml", code=1)
    assert "✗ tumbling-ball/wrong/state/-/acceleration" in done.stdout
    assert "unsupported as declared" in done.stdout
    assert "<failure" in (tmp_path / "junit.xml").read_text()
