"""Commands that cover chains only refuse trees; a run compares trees at state level and reports them."""

import json

from click.testing import CliRunner

from plumbline.cli.main import main


def test_a_drift_table_of_a_tree_is_refused(tmp_path):
    done = CliRunner().invoke(main, ["drift", "furuta", "--out", str(tmp_path / "out")])
    assert done.exit_code == 2 and "furuta is a tree" in done.output
    assert not (tmp_path / "out").exists()


def test_a_sweep_of_a_tree_is_refused_with_its_place(tmp_path):
    (tmp_path / "s.yaml").write_text(
        "schema_version: 1\nscenario: furuta\nvary:\n  bodies[0].mass: {values: [1.0]}\n"
    )
    done = CliRunner().invoke(main, ["sweep", str(tmp_path / "s.yaml"), "--out", str(tmp_path / "out")])
    assert done.exit_code == 2 and "furuta is a tree" in done.output


def test_a_tree_is_compared_with_its_joint_moments(tmp_path):
    done = CliRunner().invoke(
        main, ["run", "universal-pendulum", "--engine", "mujoco", "--out", str(tmp_path), "--json"]
    )
    assert done.exit_code == 0, done.output
    results = json.loads((tmp_path / "results.json").read_text())
    rows = {row["quantity"]: row["verdict"] for row in results["rows"]}
    assert rows["joint_moment"] == rows["acceleration"] == "agrees"
    levels = {"state", "step", "trajectory", "invariants", "relations"}
    assert {row["level"] for row in results["rows"]} == levels
    assert {row["verdict"] for row in results["rows"] if row["level"] == "step"} == {"agrees"}
    assert results["scenarios"]["universal-pendulum"]["model"]["kind"] == ["universal"]


def test_coverage_of_a_tree(tmp_path):
    done = CliRunner().invoke(
        main, ["coverage", "hinge-pendulum", "--level", "state", "--json", "--out", str(tmp_path / "out")]
    )
    assert done.exit_code == 0, done.output
    entries = json.loads(done.stdout)["entries"]
    assert {"mass", "inertia", "frame", "body_frame", "coordinate", "rate"} <= {e["kind"] for e in entries}
    assert all(entry["smallest"] is not None or entry["proof"] for entry in entries)
