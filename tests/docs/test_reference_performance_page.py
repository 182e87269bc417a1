"""docs/measurements/reference-performance.md cites stored runs: its tables' figures are in bench/results."""

import json

import pyarrow.parquet as pq
import pytest

from tests.helpers import ROOT

PAGE = (ROOT / "docs" / "measurements" / "reference-performance.md").read_text(encoding="utf-8")
FIGURES = json.loads((ROOT / "bench" / "results" / "figures.json").read_text(encoding="utf-8"))
COLUMNS = {
    "structured": "reference",
    "direct": "direct",
    "SuperLU": "superlu",
    "MuJoCo forward": "mujoco",
    "Pinocchio aba": "pinocchio",
    "Exudyn step": "exudyn step",
}


def table(first):
    """The rows of the page's table whose header starts so."""
    lines = PAGE[PAGE.index(f"| {first} |") :].split("\n\n")[0].splitlines()
    head, _, *rows = ([cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines)
    return [dict(zip(head, row, strict=True)) for row in rows]


def record(**where):
    (found,) = (r for r in FIGURES["records"] if where.items() <= r.items())
    return dict(found["microseconds"])


def close(reported, stored):
    return float(reported.replace(",", "")) == pytest.approx(stored, rel=0.05 if "e" in reported else 5.1e-3)


def test_the_goals():
    rows = table("what")
    assert [row["what"] for row in rows] == [goal["what"] for goal in FIGURES["goals"]]
    for row, goal in zip(rows, FIGURES["goals"], strict=True):
        assert close(row["measured"], goal["measured"]), row
        assert float(row["goal, at most"]) == goal["goal"]


@pytest.mark.parametrize("kind", ["single", "batch"])
def test_the_times(kind):
    second = "joints" if kind == "single" else "batch"
    for row in table(f"bodies, {second}"):
        bodies, other = row.pop(f"bodies, {second}").split(", ")
        stored = record(kind=kind, bodies=int(bodies), **{second: other if kind == "single" else int(other)})
        for column, reported in row.items():
            name = COLUMNS[column]
            assert (reported == "–") == (name not in stored), (bodies, other, column)
            assert reported == "–" or close(reported, stored[name]), (bodies, other, column)


def test_the_drifts():
    stored = pq.read_table(ROOT / "bench" / "results" / "drift.parquet").to_pylist()
    late = [row for row in stored if row["time"] == 1000]
    rows = table("scenario")
    assert len(rows) == len(late) == 21
    for reported, row in zip(rows, late, strict=True):
        assert (reported["scenario"], reported["variant"]) == (row["scenario"], row["variant"])
        assert float(reported["rtol"]) == row["rtol"]
        for column, name in (
            ("joint gap, m", "gap"),
            ("gap rate, m/s", "gap_rate"),
            ("energy error", "energy"),
        ):
            assert reported[column] == f"{row[name]:.1e}"
