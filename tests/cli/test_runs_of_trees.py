"""Commands on trees and loops: runs, coverage, sweeps and drift tables."""

import json
from unittest.mock import patch

import pyarrow.parquet as pq

from plumbline.storage.results_store import read_results
from tests.helpers.commands import invoke


def test_a_sweep_and_a_drift_table_of_a_tree_and_a_loop(tmp_path):
    (tmp_path / "s.yaml").write_text(
        "schema_version: 1\nscenario: four-bar\nvary:\n  bodies[0].mass: {values: [1.0, 2.0]}\n"
        "duration: 0.25\nengines: {mujoco: RK4}\n"
    )
    done = invoke("sweep", tmp_path / "s.yaml", "--out", tmp_path / "out", code=0)
    rows = pq.read_table(tmp_path / "out" / "sweep.parquet").to_pylist()
    assert [row["verdict"] for row in rows] == ["agrees"] * 4, [row["reason"] for row in rows]
    with patch("plumbline.studies.drift.TIMES", (0.25, 0.5)):
        done = invoke("drift", "sprung-hinge", "--rtol", "1e-6", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert len(pq.read_table(tmp_path / "out" / "drift.parquet")) == 6


def test_a_tree_is_compared_with_its_joint_moments(tmp_path):
    invoke("run", "universal-pendulum", "--engine", "mujoco", "--out", tmp_path, "--json", code=0)
    results = read_results(tmp_path)
    rows = {row["quantity"]: row["verdict"] for row in results["rows"]}
    assert rows["joint_moment"] == rows["acceleration"] == "agrees"
    levels = {"state", "step", "trajectory", "invariants", "relations"}
    assert {row["level"] for row in results["rows"]} == levels
    assert {row["verdict"] for row in results["rows"] if row["level"] == "step"} == {"agrees"}
    assert results["scenarios"]["universal-pendulum"]["model"]["kind"] == ["universal"]


def test_coverage_of_a_tree(tmp_path):
    done = invoke(
        "coverage", "hinge-pendulum", "--level", "state", "--json", "--out", tmp_path / "out", code=0
    )
    entries = json.loads(done.stdout)["entries"]
    assert {"mass", "inertia", "frame", "body_frame", "coordinate", "rate"} <= {e["kind"] for e in entries}
    assert all(entry["smallest"] is not None or entry["proof"] for entry in entries)
