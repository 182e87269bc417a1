"""Exit codes: one table, and no way to exit 0 without a comparison."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import patch

import pytest

from plumbline.cli.study_commands import _sweep_exit_code
from plumbline.execution.exit_codes import EXIT_CODE_MEANINGS, ExitCode
from plumbline.judging.known_issues import load_known_issues
from plumbline.processes import worker_process
from plumbline.processes.worker_pool import ExecutorLost
from plumbline.storage.results_store import read_results
from plumbline.truth.ground_truth import TRUTHS_DIFFER
from tests.helpers import ROOT, wrong_truths
from tests.helpers.commands import invoke, run_plumbline, run_python, user_environment

ON_ONE = ("--jobs", "1", "--out")
AT_STATES = ("--level", "state", *ON_ONE)


def with_module(folder, name, text):
    (folder / f"{name}.py").write_text(text)
    return {"path": (folder, ROOT)}


# one table


def test_every_code_has_a_meaning_and_the_help_has_the_table():
    assert set(EXIT_CODE_MEANINGS) == set(ExitCode)
    shown = invoke("--help").stdout
    table = shown[shown.index("Exit codes:") :]
    assert all(len(line) <= 80 for line in table.splitlines())
    shown = re.sub(r"\n {8,}", " ", shown)
    for code, meaning in EXIT_CODE_MEANINGS.items():
        assert re.search(rf"^ +{code:d}  {re.escape(meaning)}$", shown, re.M), code


@pytest.mark.parametrize("page", ["README.md", "docs/reading-a-disagreement.md"])
def test_the_pages_have_the_same_table(page):
    rows = re.findall(r"^\| (\d+) \| (.+) \|$", (ROOT / page).read_text(encoding="utf-8"), re.M)
    assert rows == [(str(int(code)), meaning) for code, meaning in EXIT_CODE_MEANINGS.items()]


# nothing compared is not success


def test_an_engine_without_the_level_compares_nothing(tmp_path):
    chosen = ["run", "rest", "--engine", "pinocchio-aba", "--level", "trajectory"]
    result = invoke(*chosen, *ON_ONE, tmp_path, code=ExitCode.DISAGREEMENT)
    assert "nothing was compared" in result.stdout
    assert "Every cell agrees" not in (tmp_path / "report.html").read_text()


def test_recorded_gaps_alone_are_no_comparison(tmp_path):
    chosen = ["run", "chain-3-balls", "--engine", "reference-printed"]
    result = invoke(*chosen, *AT_STATES, tmp_path, code=ExitCode.DISAGREEMENT)
    assert "0 independent checks: 1 unsupported as declared, nothing was compared" in result.stdout


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("raise SystemExit(0)\n", "SystemExit: 0"),
        ("import os\nos.abort()\n", "crashed: the worker died of SIGABRT"),
        ("raise RuntimeError('libGL broken')\n", "RuntimeError: libGL broken"),
        ("raise ImportError('libGL.so.1: cannot open')\n", "ImportError: libGL.so.1: cannot open"),
        ("import time\ntime.sleep(600)\n", "timeout: no answer within 5 s"),
        ("raise ModuleNotFoundError('No module', name='scipy.x')\n", "ModuleNotFoundError: No module"),
    ],
    ids=["exit", "crash", "exception", "missing library", "timeout", "missing module of the harness"],
)
def test_an_engine_that_fails_at_import_has_failed(tmp_path, text, words):
    place = with_module(tmp_path, "mujoco", text)
    chosen = ["run", "rest", "--engine", "mujoco", "--engine", "reference", "--timeout", "5", *AT_STATES]
    result = run_plumbline(*chosen, tmp_path / "out", **place, code=ExitCode.ENGINE_FAILED)
    shown = " ".join(result.stdout.split())
    assert words in shown and "1 failed" in shown and "7 agree" in shown
    page = (tmp_path / "out" / "report.html").read_text()
    assert re.search(r">MuJoCo|>mujoco", page) and '<span class="version">failed</span>' in page
    assert '<span class="version">not installed</span>' not in page


MISSING = "raise ModuleNotFoundError(\"No module named 'exudyn'\", name='exudyn')\n"


def test_a_missing_engine_is_a_failure_only_where_it_was_named(tmp_path):
    place = with_module(tmp_path, "exudyn", MISSING)
    chosen = ["run", "rest", "--engine", "exudyn", *AT_STATES, tmp_path / "a"]
    named = run_plumbline(*chosen, **place, code=ExitCode.ENGINE_FAILED)
    assert "it was named explicitly" in " ".join(named.stdout.split())
    usual = run_plumbline("run", "rest", *AT_STATES, tmp_path / "b", **place, code=ExitCode.SUCCESS)
    assert "2 not installed" in usual.stdout


def test_a_version_whose_environment_cannot_be_made_has_failed(tmp_path, monkeypatch):
    for name in ("PATH", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    chosen = ["run", "rest", "--engine", "mujoco@0.0.1", *AT_STATES, tmp_path / "out"]
    result = invoke(*chosen, code=ExitCode.ENGINE_FAILED)
    assert "1 failed" in result.stdout
    beside = (ROOT, Path(sys.prefix).resolve().parent)
    if not any((folder / ".uv").exists() for folder in beside):  # else uv knows no such version
        assert "uv is not on PATH" in " ".join(result.stdout.split())


@pytest.mark.parametrize(
    ("verdicts", "code"),
    [
        ({"agrees"}, 0),
        ({"agrees", "disagrees"}, 1),
        ({"agrees", "not installed"}, 3),
        ({"disagrees", "failed"}, 3),
        ({"failed", "harness failed"}, 5),
        (set(), 1),
    ],
)
def test_a_sweep_needs_the_engines_that_its_file_names(verdicts, code):
    assert _sweep_exit_code(verdicts) == code


# the harness


def test_a_truth_with_a_wrong_gravity_fails_the_harness(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(worker_process, "initialize_worker", wrong_truths.prepare)
    chosen = ["run", "tumbling-ball", "--engine", "mujoco", *ON_ONE, tmp_path]
    result = invoke(*chosen, code=ExitCode.HARNESS_FAILED)
    first = " ".join(result.stdout.split())
    assert first.startswith(f"☒ the harness failed: tumbling-ball: {TRUTHS_DIFFER}")
    rows = read_results(tmp_path)["rows"]
    assert {row["level"] for row in rows if row["verdict"] == "harness failed"} == {"trajectory"}
    compared = [row for row in rows if row["level"] in ("trajectory", "invariants")]
    assert {row["verdict"] for row in compared} == {"harness failed"}
    assert 'type="harness failed"' in (tmp_path / "junit.xml").read_text()


def test_a_certified_state_that_contradicts_the_definition_fails_the_harness(monkeypatch, tmp_path):
    monkeypatch.setattr(worker_process, "initialize_worker", wrong_truths.prepare_states)
    chosen = ["run", "double-loaded-rods", "--engine", "pinocchio", *AT_STATES]
    result = invoke(*chosen, tmp_path, code=ExitCode.HARNESS_FAILED)
    assert "contradicts the definition of the mechanism" in " ".join(result.stdout.split())
    assert {row["verdict"] for row in read_results(tmp_path)["rows"]} == {"harness failed"}


@pytest.mark.parametrize(("level", "quantity"), [("state", "acceleration"), ("trajectory", "position_limit")])
def test_engines_that_agree_against_an_accepted_truth_put_the_harness_in_doubt(
    level, quantity, monkeypatch, tmp_path
):
    monkeypatch.setattr(worker_process, "initialize_worker", wrong_truths.prepare_accepted)
    chosen = ["run", "tumbling-ball", "--engine", "mujoco", "--engine", "reference", "--level", level]
    result = invoke(*chosen, *ON_ONE, tmp_path, code=ExitCode.HARNESS_FAILED)
    shown = " ".join(result.stdout.split())
    assert shown.startswith(
        f"☒ the harness failed: tumbling-ball, {level}: all engines that were compared (reference and "
        f"mujoco) differ from the truth in {quantity}, by "
    )
    assert "and agree with each other: suspect the truth" in shown
    rows = read_results(tmp_path)["rows"]
    failed = {row["quantity"].partition("_by_")[0] for row in rows if row["verdict"] == "harness failed"}
    assert failed == {quantity}
    assert not [row for row in rows if row["verdict"] == "disagrees"]
    assert 'type="harness failed"' in (tmp_path / "junit.xml").read_text()


def test_an_internal_error_is_a_sentence_and_a_file(tmp_path):
    with patch("plumbline.cli.run_commands.run_plan", side_effect=KeyError("a mistake\nof two lines")):
        result = invoke("run", "rest", "--engine", "reference", "--level", "state", "--out", tmp_path)
    assert result.exit_code == ExitCode.HARNESS_FAILED
    (line,) = result.stderr.splitlines()
    found = re.fullmatch(r"internal error: KeyError: '.+'; the traceback is in (.+)", line)
    path = Path(found[1])
    assert "a mistake" in path.read_text() and "Traceback" in path.read_text()
    path.unlink()


@pytest.mark.parametrize(
    ("error", "words"),
    [(ExecutorLost("the scheduler has gone"), "the cluster was lost"), (OSError(28, "full"), "I/O error")],
)
def test_a_machine_that_fails_exits_with_4(tmp_path, error, words):
    with patch("plumbline.cli.run_commands.run_plan", side_effect=error):
        result = invoke("run", "rest", "--engine", "reference", "--level", "state", "--out", tmp_path)
    assert result.exit_code == ExitCode.MACHINE_FAILED and words in result.stderr


# interruptions


@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_run_explains_how_to_resume_and_leaves_no_process(tmp_path, own_cells, which):
    process = subprocess.Popen(
        [sys.executable, "-m", "plumbline", "run", "chain-3-balls", "--engine", "mujoco", *ON_ONE, tmp_path],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        # also under nohup, where the signal would be ignored
        preexec_fn=lambda: signal.signal(which, signal.SIG_DFL), env=user_environment(),
    )  # fmt: skip
    deadline = time.monotonic() + 60
    while not list(own_cells.glob("*.cell")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(which)
    _, reported = process.communicate(timeout=60)
    assert process.returncode == ExitCode.INTERRUPTED, reported
    assert reported.rstrip().endswith("interrupted; finished cells are kept, run the same command to resume")
    assert "Traceback" not in reported and "leaked" not in reported
    assert list(own_cells.glob("*.cell"))
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    raise AssertionError("a process is left")


SWALLOWING_MODULE = """
import contextlib, os, signal, time
with contextlib.suppress(BaseException):
    os.kill(os.getpid(), signal.{name})
    time.sleep(0.2)
"""


@pytest.mark.parametrize(
    "statement",
    ["exec('raise KeyboardInterrupt')", "import swallow_SIGINT", "import swallow_SIGTERM"],
    ids=["raised", "SIGINT", "SIGTERM"],
)
def test_an_interruption_inside_an_import_has_the_exit_code_too(tmp_path, statement):
    """As of a dataclass that is being made, or of a compiled module that swallows exceptions."""
    for name in ("SIGINT", "SIGTERM"):
        (tmp_path / f"swallow_{name}.py").write_text(SWALLOWING_MODULE.format(name=name))
    (tmp_path / "interrupted.py").write_text(
        "import signal, time\nfrom unittest.mock import patch\nfrom plumbline.cli.main import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"def stop(*_, **__):\n    {statement}\n    time.sleep(5)\n"
        "with patch('plumbline.cli.run_commands.run_plan', stop):\n    main(['run', 'rest'])\n"
    )
    # only of modules is the exit code replaced
    done = run_python("-m", "interrupted", cwd=tmp_path, path=(ROOT, tmp_path))
    assert "interrupted" in done.stderr
    assert done.returncode == ExitCode.INTERRUPTED, done


def test_an_interruption_while_loading_prints_no_traceback(tmp_path):
    (tmp_path / "click.py").write_text("raise KeyboardInterrupt\n")
    done = run_plumbline("--help", path=(tmp_path, ROOT))
    assert (done.returncode, done.stderr) == (ExitCode.INTERRUPTED, "")


# known issues of the user

MINE = "- {id: mine, scenario: rest, engine: mujoco, verdict: unresolved, evidence: e, reason: r}\n"


@pytest.mark.parametrize("command", ["run", "nightly"])
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("- {id: [red]x[/nope]}", ":1:13: "),
        (MINE.replace("mujoco", "mujocoo"), ":1:38: [0].engine: no engine matches 'mujocoo'; did you mean"),
        (None, "cannot be read: No such file"),
        (
            MINE.replace("mine", "unstable-steady-motion"),
            "[0].id: the id 'unstable-steady-motion' is used twice, first at ",
        ),
    ],
)
def test_a_bad_file_of_known_issues_is_bad_usage(tmp_path, command, text, words):
    path = tmp_path / "known.yaml"
    if text is not None:
        path.write_text(text)
    result = invoke(command, "rest", "--known", path, "--out", tmp_path / "out", code=ExitCode.BAD_USAGE)
    assert f"{path}" in result.stderr and words in result.stderr, result.stderr
    assert not (tmp_path / "out").exists()


class Stopped(Exception):
    pass


@pytest.mark.parametrize("where", ["plumbline.cli.run_commands.run_plan", "plumbline.cli.nightly.run_plan"])
def test_known_issues_of_the_user_are_added_to_those_of_the_project(tmp_path, where):
    (tmp_path / "known.yaml").write_text(MINE)
    words = ["run" if "run_commands" in where else "nightly", "rest", "--known", tmp_path / "known.yaml"]
    with patch(where, side_effect=Stopped) as called:
        invoke(*words, "--engine", "mujoco", "--out", tmp_path / "out")
    plan = called.call_args.args[0]
    assert [issue.id for issue in plan.known_issues] == [e.id for e in load_known_issues()] + ["mine"]
    assert plan.are_engines_required


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("list engines >&-", 0),
        ("check nothing.yaml 2>/dev/full", 4),
        ("list engines >/dev/full", 4),
        ("run rest --level state --engine reference --out {} --jobs 1", 0),
    ],
)
def test_streams_that_take_no_words_or_not_all_letters(tmp_path, command, code):
    """Closed, full, or in an encoding without the glyphs of the table."""
    done = subprocess.run(
        f"'{sys.executable}' -m plumbline {command.format(tmp_path / 'out')}", shell=True, cwd=ROOT,
        capture_output=True, text=True, timeout=240,
        env=user_environment(PYTHONIOENCODING="ascii"),
    )  # fmt: skip
    assert done.returncode == code and "internal error" not in done.stderr, done
