"""The history over all nights of a folder; a damaged one is named and left out."""

import json
import os
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner

from plumbline.cli.main import main
from plumbline.execution.exit_codes import ExitCode
from plumbline.judging.rows import RowContext
from plumbline.storage import results_store
from plumbline.storage.history_of_nights import History, last_findings, next_night_number
from reports.earlier_runs import History as ReportHistory
from reports.stored_results import Results
from tests.helpers.commands import invoke
from tests.helpers.requirements import needs_pipes

KEY = "s/mujoco/state/-/acceleration"


def store_run(folder, day, verdicts, version="4.0", known=None, family="single", number=0):
    """Store a run of one scenario per verdict: "s", then "s1", …; as a nightly's where it has a number."""
    rows = []
    for k, verdict in enumerate(verdicts):
        context = RowContext(f"s{k or ''}", family, "mujoco", "MuJoCo", version)
        more = {"value": 10.0**-day, "tolerance": 1.0, "known_issue": known}
        rows.append(context.make_row("state", "-", "acceleration", verdict, f"it {verdict}", "m/s²", **more))
    bad = any(v != "agrees" for v in verdicts) and known is None
    run = {
        "id": f"2026010{day}T000000Z",
        "started": f"2026-01-0{day}T00:00:00+00:00",
        "exit_code": int(bad),
        "sentence": "",
        "duration": 1.0,
        "versions": {"mujoco": version},
    }
    if number:
        run["night"] = number
    tables = results_store.ResultTables()
    tables.add_rows(rows)
    scenarios = {row.scenario: {"family": family, "title": "", "bodies": 1} for row in rows}
    engines = {"mujoco": {"title": "MuJoCo", "version": version}}
    results_store.write_results(folder / run["id"], run, scenarios, engines, rows, tables)


def test_first_bad_night_and_last_green(tmp_path):
    store_run(tmp_path, 1, ["disagrees", "agrees"])  # an old trouble that went away
    store_run(tmp_path, 2, ["agrees", "agrees"])
    store_run(tmp_path, 3, ["agrees", "unresolved"], known="k")  # expected: green
    store_run(tmp_path, 4, ["disagrees", "agrees"], version="4.1")
    store_run(tmp_path, 5, ["failed", "agrees"], version="4.1")
    history = History(tmp_path)
    (found,) = history.first_bad()
    assert (found["key"], found["first_bad"], found["last_good"]) == (
        KEY,
        "20260104T000000Z",
        "20260103T000000Z",
    )
    green, changes = history.changes_since_green()
    assert green == "20260103T000000Z"
    assert [(c["key"], c["was"], c["is"]) for c in changes] == [
        (KEY, "agrees", "failed"),
        ("s1/mujoco/state/-/acceleration", "unresolved", "agrees"),
    ]
    assert [n["bad"] for n in history.overview()] == [1, 0, 0, 1, 1]
    assert history.version_changes() == ["20260104T000000Z: mujoco 4.0 → 4.1"]
    assert [t["value"] for t in history.trend("s/mujoco/*")] == [10.0**-d for d in range(1, 6)]


def test_a_key_that_was_never_good(tmp_path):
    store_run(tmp_path, 1, ["disagrees"])
    store_run(tmp_path, 2, ["disagrees"])
    history = History(tmp_path)
    assert [(f["first_bad"], f["last_good"]) for f in history.first_bad()] == [("20260101T000000Z", None)]
    assert history.changes_since_green() == (None, [])


def test_random_scenarios_are_counted_only(tmp_path):
    store_run(tmp_path, 1, ["agrees", "agrees"], family="random")
    store_run(tmp_path, 2, ["disagrees"], family="random")
    history = History(tmp_path)
    assert history.first_bad() == [] and history.changes_since_green()[1] == []
    assert [n["random"] for n in history.overview()] == [2, 1]


def test_nights_keep_their_order_when_the_clock_is_set_back(tmp_path):
    for number, (day, verdict) in enumerate([(5, "agrees"), (6, "agrees"), (1, "disagrees")], 1):
        store_run(tmp_path, day, [verdict], number=number)
    ids = [f"2026010{day}T000000Z" for day in (5, 6, 1)]
    history = History(tmp_path)
    assert [n.id for n in history.nights] == ids
    assert [n["id"] for n in history.overview()] == [t["id"] for t in history.trend(KEY)] == ids
    assert [(f["first_bad"], f["last_good"]) for f in history.first_bad()] == [(ids[2], ids[1])]
    assert next_night_number(tmp_path) == 4
    last = Results.load(tmp_path / ids[2])
    report = ReportHistory.load(tmp_path, last)
    assert [n.run["id"] for n in report.nights] == ids[:2], "the report has the same nights before this one"
    assert report.last_passed.run["id"] == ids[1] and report.is_new(last.rows[0])
    store_run(tmp_path / "unfinished", 2, ["disagrees"])  # the next night, before it is moved to the history
    next_one = Results.load(tmp_path / "unfinished" / "20260102T000000Z")
    assert [n.run["id"] for n in ReportHistory.load(tmp_path, next_one).nights] == ids


def with_fields(**fields):
    return lambda path: path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def change_verdicts(path):
    table = pq.read_table(path)
    place = table.schema.get_field_index("verdict")
    pq.write_table(table.set_column(place, "verdict", pa.array(["accords"] * len(table))), path)


SPOILED = [  # a file of a night, what is done to it, and the message that names it
    ("results.json", lambda path: path.write_text("{"), "results.json: not a results file"),
    ("summary.parquet", lambda path: path.write_bytes(path.read_bytes()[:-8]), "summary.parquet: is damaged"),
    ("summary.parquet", Path.unlink, "summary.parquet"),
    ("results.json", with_fields(schema_version=99), "results.json: schema_version 99, this version reads 6"),
    ("results.json", lambda path: path.write_text(path.read_text().replace(': "agrees"', ': "accords"')),
     "results.json: rows[0].verdict: is 'accords'; valid would be one of agrees, disagrees"),
    ("summary.parquet", change_verdicts, "summary.parquet has the verdict 'accords', which no run gives"),
    ("results.json", lambda path: (path.unlink(), os.mkfifo(path)),
     "results.json: not a results file of plumbline (ValueError: it is not a regular file)"),
    ("summary.parquet", lambda path: (path.unlink(), path.mkdir()),
     "summary.parquet: is damaged: it is not a regular file"),
    ("results.json", with_fields(rows=[]), "summary.parquet has 1 rows, results.json expects 0"),
]  # fmt: skip


@needs_pipes
@pytest.mark.parametrize(("name", "spoil", "words"), SPOILED)
def test_a_damaged_night_is_named_and_left_out(tmp_path, name, spoil, words):
    for day in (1, 2, 3):
        store_run(tmp_path, day, ["agrees"])
    spoil(tmp_path / "20260102T000000Z" / name)
    history = History(tmp_path)
    assert [n.id for n in history.nights] == ["20260101T000000Z", "20260103T000000Z"]
    assert list(history.damaged) == ["20260102T000000Z"]
    assert words in history.damaged["20260102T000000Z"]
    for options in ([], ["--json"]):
        shown = invoke("history", tmp_path, *options, code=ExitCode.BAD_USAGE)
        assert "20260103" in shown.stdout and "damaged, left out: 20260102T000000Z: " in shown.stderr


def test_only_new_findings_of_nights_that_can_be_read(tmp_path):
    store_run(tmp_path / "nights", 1, ["agrees"])
    (tmp_path / "nights" / "20260101T000000Z" / "results.json").write_text("{")
    out = tmp_path / "out"
    words = (
        "run",
        "rest",
        "--engine",
        "reference",
        "--level",
        "state",
        "--jobs",
        1,
        "--out",
        out,
        "--new-only",
    )
    assert "damaged, left out: 20260101T000000Z: " in invoke(*words, tmp_path / "nights", code=0).stderr
    (tmp_path / "file").write_text("")
    assert "is a file and no folder of nights" in invoke(*words, tmp_path / "file", code=2).stderr


def test_an_empty_folder_has_no_nights(tmp_path):
    document = History(tmp_path).to_document("*")
    assert document.pop("last_green") is None
    assert set(document) == {"nights", "damaged", "versions", "findings", "first_bad", "since_green", "trend"}
    assert all(part == [] for part in document.values())


@pytest.mark.parametrize("made", ["", "history", "unfinished/night", "20260101T000000Z"])
@pytest.mark.parametrize("words", [["history"], ["history", "--json"], ["report", "RESULTS", "--history"]])
def test_a_folder_without_nights_is_bad_usage(tmp_path, made, words):
    folder = tmp_path / "some folder"
    (folder / made).mkdir(parents=True)
    store_run(tmp_path, 1, ["agrees"])
    known = str(tmp_path / "20260101T000000Z")
    result = CliRunner().invoke(
        main, [known if word == "RESULTS" else word for word in words] + [str(folder)]
    )
    assert (result.exit_code, result.stdout) == (ExitCode.BAD_USAGE, ""), result.output
    assert f"no complete night in {folder}; `python -m plumbline nightly` makes one" in result.stderr
    assert "Traceback" not in result.output


def test_the_command_reports_it(tmp_path):
    store_run(tmp_path / "history", 1, ["agrees"])
    store_run(tmp_path / "history", 2, ["disagrees"])
    reported = invoke("history", tmp_path, code=0)
    name = "mujoco-acceleration-at-level-state"
    assert f"{name} new 20260102T000000Z 1 4.0 20260102T000000Z" in " ".join(reported.output.split())
    data = invoke("history", tmp_path, "--key", "s/*", "--json")
    assert len(json.loads(data.output)["trend"]) == 2
    invoke("history", tmp_path / "absent", code=2)


def test_the_life_of_a_finding(tmp_path):
    name, gap = "mujoco-acceleration-at-level-state", "mujoco-unresolved-acceleration-at-level-state"
    store_run(tmp_path, 1, ["unresolved"])
    store_run(tmp_path, 2, ["disagrees"])
    store_run(tmp_path, 3, ["disagrees", "disagrees"], version="4.1")
    present, gone = History(tmp_path).findings()
    assert (present["finding"], present["state"], present["nights"]) == (name, "present", 2)
    assert (present["first_seen"], present["versions"]) == ("20260102T000000Z", ["4.0", "4.1"])
    assert (gone["finding"], gone["state"], gone["last_seen"]) == (gap, "gone", "20260101T000000Z")
    assert last_findings(tmp_path) == {name} and last_findings(tmp_path / "empty") == frozenset()
    store_run(tmp_path, 4, ["disagrees"], known="k")
    last = History(tmp_path).findings()[0]
    assert (last["finding"], last["state"]) == ("k", "recorded")
