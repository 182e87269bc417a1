"""The output folder is whole or as it was; what was written is read back."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from plumbline.judging.rows import Row, RowContext
from plumbline.storage import results_store

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


def write_results(folder):
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
    results_store.write_results(folder, {"id": "x"}, {"s": {"title": "<b>"}}, {}, [ROW], tables)


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
    with pytest.raises(OSError, match="No space"):
        results_store.write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", json.dumps({"schema_version": 99}), "\xff"])
def test_foreign_or_broken_results_are_refused_by_name(tmp_path, text):
    (tmp_path / "results.json").write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=r"results\.json"):
        results_store.read_results(tmp_path)


def test_no_results_says_how_to_make_them(tmp_path):
    with pytest.raises(ValueError, match="plumbline run"):
        results_store.read_results(tmp_path)


def test_the_field_reference_names_every_field_and_column():
    text = (Path(__file__).resolve().parents[2] / "docs" / "results.md").read_text()
    for field in dataclasses.fields(Row):
        assert f"`{field.name}`" in text, field.name
    for name, schema in results_store.TABLES.items():
        if name != "summary":
            assert f"- `{name}`: {', '.join(schema.names)}" in text, name
