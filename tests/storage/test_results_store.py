"""The output folder is whole or as it was; what was written is read back."""

import dataclasses
import json
import os
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from plumbline.judging.rows import Row, RowContext
from plumbline.storage import results_store
from plumbline.storage.results_schema import DamagedResults
from reports import model_page
from tests.helpers import ROOT
from tests.helpers.nightly_tests import SLOW

ROW = RowContext("s", "single", "mujoco", "MuJoCo", "4.0").make_row(
    "state",
    "-",
    "acceleration",
    "agrees",
    "fine",
    "m/s²",
    value=1e-15,
    tolerance=float("inf"),
    ratio=float("nan"),
    extra={"scale": float("nan")},
)
STATES = [
    {
        "scenario": "s",
        "engine": "mujoco",
        "quantity": "q",
        "state": k,
        "body": 0,
        "error": 0.1 * k,
        "bound": 1.0,
        "scale": 2.0,
    }
    for k in range(3)
]


RUN = {"started": "2026-01-01", "duration": 1.0, "sentence": "one", "exit_code": 0}
ENGINE = {"title": "MuJoCo", "version": "4.0"}


def write_results(folder, run_id="x"):
    tables = results_store.ResultTables()
    names = {"scenario": "s", "engine": "mujoco", "quantity": "q"}
    for part in ([0], [1, 2]):
        tables.add(
            "states",
            names
            | {
                "state": part,
                "body": [0] * len(part),
                "error": 0.1 * np.array(part, float),
                "bound": 1.0,
                "scale": 2.0,
            },
        )
    tables.add_rows([ROW])
    scenario = {"family": "single", "title": "<b>", "bodies": 1}
    results_store.write_results(
        folder, RUN | {"id": run_id}, {"s": scenario}, {"mujoco": ENGINE}, [ROW], tables
    )


def test_what_is_written_is_read_back(tmp_path):
    write_results(tmp_path / "new")
    document = results_store.read_results(tmp_path / "new")
    (row,) = document["rows"]
    assert row["key"] == "s/mujoco/state/-/acceleration"
    assert row["value"] == 1e-15
    assert row["tolerance"] is None, "JSON has no infinity"
    assert row["ratio"] is None and row["extra"] == {"scale": None}
    assert results_store.read_table(tmp_path / "new", "states").to_pylist() == STATES
    (summary,) = results_store.read_table(tmp_path / "new", "summary").to_pylist()
    assert summary["key"] == row["key"]


def test_nothing_temporary_is_left(tmp_path):
    write_results(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"results.json"} | {
        f"{n}.parquet" for n in results_store.TABLES
    }


def test_many_records_take_several_row_groups_and_none_is_lost(tmp_path, monkeypatch):
    monkeypatch.setattr(results_store, "ROW_GROUP_SIZE", 7)
    tables = results_store.ResultTables()
    for k in range(20):
        column = np.arange(3.0) + 3 * k
        tables.add(
            "states",
            {
                "scenario": "s",
                "engine": f"e{k}",
                "quantity": "q",
                "state": column.astype(int),
                "body": [0] * 3,
                "error": column,
                "bound": 1.0,
                "scale": 2.0,
            },
        )
    tables.write_parquet(tmp_path)
    assert [r["error"] for r in results_store.read_table(tmp_path, "states").to_pylist()] == list(range(60))
    assert pq.ParquetFile(tmp_path / "states.parquet").num_row_groups > 2
    assert results_store.read_table(tmp_path, "curves").to_pylist() == []


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "results.json"
    results_store.write_atomically(path, b"old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=re.escape(f"No space left on device: '{path}'")):
        results_store.write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", json.dumps({"schema_version": 99}), "\xff"])
def test_foreign_or_broken_results_are_refused_by_name(tmp_path, text):
    (tmp_path / "results.json").write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=r"results\.json"):
        results_store.read_results(tmp_path)


def test_missing_results_are_reported_with_the_command_that_makes_them(tmp_path):
    with pytest.raises(ValueError, match="plumbline run"):
        results_store.read_results(tmp_path)


def test_the_field_reference_names_every_field_and_column():
    text = (ROOT / "docs" / "results.md").read_text()
    for field in dataclasses.fields(Row):
        assert f"`{field.name}`" in text, field.name
    for name, schema in results_store.TABLES.items():
        if name != "summary":
            assert f"- `{name}`: {', '.join(schema.names)}" in text, name


PAGES = ("report.html", "junit.xml", "summary.md", "scripts/index.json", "scripts/a.py")


@pytest.mark.parametrize("step", range(6))
def test_a_run_that_is_killed_while_it_saves_leaves_no_mixture(tmp_path, monkeypatch, step):
    write_results(tmp_path, "old")
    (tmp_path / "scripts").mkdir()
    for name in (*PAGES, "drift.parquet"):
        (tmp_path / name).write_text("of the old run, but for drift")
    replace, count = os.replace, iter(range(100))

    def kill(*paths):
        if next(count) == step:
            raise KeyboardInterrupt
        replace(*paths)

    monkeypatch.setattr(os, "replace", kill)
    with pytest.raises(KeyboardInterrupt):
        write_results(tmp_path, "new")
    monkeypatch.undo()
    assert not [name for name in PAGES if (tmp_path / name).exists()]
    assert (tmp_path / "drift.parquet").exists(), "no part of a run"
    with pytest.raises(DamagedResults, match=r"no results here, or not completely written"):
        results_store.read_results(tmp_path)
    write_results(tmp_path, "new")
    assert results_store.read_results(tmp_path)["run"]["id"] == "new"


def test_temporary_files_of_a_killed_run_are_removed(tmp_path):
    for name in (".states.parquet.a1b2c3d4", ".results.json.a1b2c3d4"):
        (tmp_path / name).write_text("half")
    write_results(tmp_path)
    assert not list(tmp_path.glob(".*"))


def test_a_folder_has_results_of_a_run_or_of_model(tmp_path):
    options = {"at": None, "base": "auto", "root": None, "strip_geometry": False}
    document = {"files": [], "problems": [], "options": options, "engines": {}}
    write_results(tmp_path)
    model_page.write(tmp_path, document | dict.fromkeys(("version", "commit", "started", "command"), ""))
    assert not (tmp_path / "results.json").exists() and (tmp_path / "model.json").is_file()
    write_results(tmp_path)
    assert (tmp_path / "results.json").is_file() and not list(tmp_path.glob("model.*"))


def test_a_damaged_document_of_model_is_one_short_sentence(tmp_path):
    (tmp_path / "model.json").write_bytes(bytes(range(128, 256)) * 1000)
    with pytest.raises(DamagedResults, match="no results of `plumbline model`") as error:
        results_store.read_model_results(tmp_path)
    assert len(str(error.value)) < 400 + len(str(tmp_path))


def assert_damaged(path, words, read, *arguments):
    with pytest.raises(DamagedResults) as caught:
        read(*arguments)
    assert str(caught.value).startswith(f"{path}: ") and words in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("run"), "run: is missing"),
        (lambda d: d["run"].update(exit_code="0"), "run.exit_code: is the text '0', not a whole number"),
        (lambda d: d["rows"][0].update(value="x"), "rows[0].value: is the text 'x', not a number"),
        (
            lambda d: d["rows"][0].update(verdict="agree"),
            "rows[0].verdict: is 'agree' (did you mean 'agrees'?)",
        ),
        (lambda d: d["rows"][0].update(scenario="t"), "rows[0].scenario is 't'; valid would be one of the"),
        (lambda d: d["rows"][0].pop("reason"), "rows[0].reason: is missing"),
        (
            lambda d: d["scenarios"]["s"].update(model={"mass": [1], "kind": ["ball"]}),
            "model.inertia does not fit the bodies",
        ),
        (lambda d: d.update(engines=[]), "engines: is a list"),
        (lambda d: d["rows"].extend([3] * 9), "… and 4 more problems"),
    ],
)
def test_a_wrong_field_is_named(tmp_path, change, words):
    write_results(tmp_path)
    path = tmp_path / "results.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    assert_damaged(path, words, results_store.read_results, tmp_path)


def without(name):
    return lambda table: table.drop_columns([name])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without("bound"), "has no column bound"),
        (lambda t: t.set_column(4, "body", t["error"]), "body: is of type double; valid would be int32"),
        (lambda t: t.set_column(4, "body", pa.nulls(3, pa.int32())), "body: has empty values"),
    ],
)
def test_a_table_without_what_readers_need_is_named(tmp_path, change, words):
    write_results(tmp_path)
    path = tmp_path / "states.parquet"
    pq.write_table(change(pq.read_table(path)), path)
    assert_damaged(path, words, results_store.read_table, tmp_path, "states")


@pytest.mark.parametrize("step", [7, pytest.param(1, marks=SLOW)])
def test_every_changed_byte_of_a_tables_data_is_found(tmp_path, step):
    """Pages have checksums: no damaged number is read as another number."""
    write_results(tmp_path)
    path = tmp_path / "states.parquet"
    whole, before = path.read_bytes(), results_store.read_table(tmp_path, "states").to_pylist()
    found = 0
    for at in range(0, len(whole), step):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 16]) + whole[at + 1 :])
        try:
            assert results_store.read_table(tmp_path, "states").to_pylist() == before
        except DamagedResults:
            found += 1
    assert found > len(whole) / step / 3, "of the others most are statistics and names that nobody reads"
