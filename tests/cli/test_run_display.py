"""What a run shows while it goes on, and what an interrupted one leaves on the terminal."""

from dataclasses import replace
from io import StringIO
from unittest.mock import patch

import pytest

from plumbline.cli.findings_output import explain
from plumbline.cli.run_display import RunDisplay
from plumbline.cli.terminal_output import line_width, make_console, print_matrix
from plumbline.cli.verdict_matrix import VerdictMatrix
from plumbline.engines.adapter import EngineInfo
from plumbline.execution.exit_codes import ExitCode
from plumbline.execution.plan import Plan, RunObserver
from plumbline.execution.runner import run_plan
from plumbline.judging.findings import find_findings
from plumbline.judging.known_issues import MECHANISMS, KnownIssue, KnownIssues
from plumbline.judging.rows import SHOWN_STYLES, Row, Verdict
from plumbline.scenario import loader
from tests.helpers.commands import invoke

ENGINES = {"mujoco": EngineInfo("mujoco", "MuJoCo", "4.0.0", ())}


def row(scenario, verdict, ratio=0.1):
    return Row(
        scenario, "test", "mujoco", "4.0.0", "state", "-", "acceleration", "m/s²", None, None, verdict, "r",
        ratio=ratio,
    )  # fmt: skip


class Terminal(StringIO):
    def isatty(self):
        return True


def test_the_worst_scenario_comes_first():
    matrix = VerdictMatrix(ENGINES)
    for name, verdict in (("a", Verdict.AGREES), ("b", Verdict.DISAGREES), ("c", Verdict.UNRESOLVED)):
        matrix.add_rows(name, [row(name, verdict)])
    assert list(matrix.table().columns[0].cells) == ["b", "c", "a"]
    assert list(matrix.table(max_lines=1).columns[0].cells) == ["b"]


def test_a_terminal_shows_cells_of_a_scenario_that_still_runs():
    file = Terminal()
    display = RunDisplay(file)
    with display as progress:
        display.on_start(ENGINES)
        display.on_rows("conical", [row("conical", Verdict.DISAGREES)], is_complete=False)
        progress(1, 7, "conical mujoco state")
        shown = file.getvalue()
        assert "conical" in shown and "✗" in shown and " 0.1" in shown and "1/7" in shown
    assert not display.rows


def test_without_a_terminal_each_finished_scenario_is_one_line():
    file = StringIO()
    display = RunDisplay(file)
    with display:
        display.on_start(ENGINES)
        display.on_rows("conical", [row("conical", Verdict.AGREES)], is_complete=False)
        assert file.getvalue() == ""
        display.on_rows("conical", [row("conical", Verdict.AGREES)], is_complete=True)
    assert file.getvalue() == "conical: ✓ 1\n"


@pytest.mark.parametrize(("option", "resume"), [((), ""), (("--fresh",), " without --fresh")])
def test_an_interrupted_run_leaves_the_findings_of_what_has_finished(tmp_path, option, resume):
    def interrupted(plan, progress, observer):
        observer.on_start(ENGINES)
        observer.on_rows("rest", [row("rest", Verdict.AGREES)], True)
        observer.on_rows("conical", [row("conical", Verdict.AGREES)], False)
        raise KeyboardInterrupt

    words = ["run", "rest", "conical", "--engine", "mujoco", "--out", str(tmp_path), *option]
    with patch("plumbline.cli.run_commands.run_plan", side_effect=interrupted):
        result = invoke(*words)
    assert result.exit_code == ExitCode.INTERRUPTED
    assert "1 scenario   ✓ 1\n" in result.stdout
    assert "1 of 2 scenarios finished" in result.stdout
    end = f"interrupted; finished cells are kept, run the same command{resume} to resume\n"
    assert result.stderr.endswith(end)


class Recorder(RunObserver):
    def __init__(self):
        self.partial, self.complete = [], {}

    def on_start(self, engines):
        assert list(engines) == ["mujoco"]

    def on_rows(self, scenario, rows, is_complete):
        if is_complete:
            self.complete[scenario] = list(rows)
        else:
            self.partial += rows


@pytest.mark.parametrize("level", ["state", "trajectory"])
def test_an_observer_gets_the_rows_of_the_result(level):
    chosen = loader.load_scenarios(["rest", "conical"])
    recorder = Recorder()
    result = run_plan(Plan(chosen, ["mujoco"], level, random_state_count=2), lambda *_: None, recorder)
    assert [r for s in chosen for r in recorder.complete[s.name]] == result.rows
    assert {r.key for r in recorder.partial} <= {r.key for r in result.rows}
    assert bool(recorder.partial) == (level == "trajectory")


@pytest.mark.parametrize(
    ("columns", "width"), [("", None), ("80", 80), ("120", 120), ("0", None), ("wide", None)]
)
def test_a_pipe_has_the_width_columns_or_room_for_everything(monkeypatch, columns, width):
    monkeypatch.setenv("COLUMNS", columns)
    file = StringIO()
    words = "word " * 100
    make_console(file).print(words.strip())
    longest = max(map(len, file.getvalue().splitlines()))
    assert longest == len(words) - 1 if width is None else width - 5 < longest <= width


def test_a_terminal_keeps_its_width(monkeypatch):
    monkeypatch.setenv("COLUMNS", "77")
    assert make_console(Terminal()).width == 77


@pytest.mark.parametrize(("columns", "width"), [("60", 60), ("", 80), ("500", 160)])
def test_sentences_have_the_width_of_the_terminal(monkeypatch, columns, width):
    monkeypatch.setenv("COLUMNS", columns)
    assert line_width(make_console(StringIO())) == width


def test_a_record_is_printed_once():
    issue = KnownIssue(
        "a", "rest", "mujoco", "disagrees", "measured", "the axis is read twice", mechanism="rounding"
    )
    known = KnownIssues([issue], has_extra_refinements=False)
    scattering = replace(row("rest", "disagrees", 2.0), extra={"scatter": 1.5})
    (finding,) = find_findings(known.mark_known([scattering], 1), {"rest": 1})
    shown = list(explain(finding, issue, {}, 1000, ""))
    text = " ".join(shown)
    assert text.count("read twice") == text.count(MECHANISMS["rounding"]) == text.count("2 × tolerance") == 1
    assert "Checked: they differ by 3 × tolerance." in shown


@pytest.mark.parametrize("width", [30, 40, 80, 200])
def test_no_item_of_the_legend_is_broken(monkeypatch, capsys, width):
    monkeypatch.setenv("COLUMNS", str(width))
    print_matrix(VerdictMatrix(ENGINES))
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= width
    for name, style in SHOWN_STYLES.items():
        assert f"{style.glyph} {name}" in shown


def test_the_matrix_of_ten_engines_has_a_hundred_columns_and_every_name(capsys):
    engines = {
        f"engine-{k}-of-a-long-name": EngineInfo("", "", f"4.0.0.dev2026110{k}", ()) for k in range(10)
    }
    matrix = VerdictMatrix(engines)
    scenario = "a-scenario-of-a-long-name"
    for name in engines:
        matrix.add_rows(scenario, [replace(row(scenario, Verdict.DISAGREES, 4.1e12), engine=name)])
    print_matrix(matrix)
    shown = capsys.readouterr().out
    assert all(f"{name} {info.version}" in shown for name, info in engines.items()) and "…" not in shown
    cells = next(line for line in shown.splitlines() if line.startswith(scenario))
    assert len(cells) <= 100 and cells.count("✗ 4e12") == 10
