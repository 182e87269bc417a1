"""Results that schema version 1 stored stay readable: by `history`, `report` and `reproduce`."""

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from plumbline.cli.main import main
from plumbline.judging.rows import Row
from plumbline.storage.history_of_nights import History
from plumbline.storage.results_store import read_results, read_table
from tests.helpers.commands import invoke

STORED = Path(__file__).with_name("version_1") / "20261122T112600Z"  # `run rest --level state`, two engines
KEY = "rest/mujoco/state/-/acceleration"


@pytest.fixture
def results(tmp_path):
    return Path(shutil.copytree(STORED, tmp_path / "history" / STORED.name))


def stored_rows():
    return json.loads((STORED / "results.json").read_text())["rows"]


def test_rows_get_the_present_names_and_keep_their_values():
    old, new = stored_rows(), read_results(STORED)["rows"]
    assert len(new) == len(old) == 14
    for before, now in zip(old, new, strict=True):
        assert set(now) == {"key", *Row.__dataclass_fields__}
        kept = ("key", "value", "tolerance", "verdict", "reason", "derivation")
        assert all(now[name] == before[name] for name in kept)
        assert now["compared_until"] == before["horizon"] and now["known_issue"] == before["known"]
        assert now["user_rtol"] == before["accept"] == 1e-6 and now["cpu_time"] == before["wall_time"]
        assert now["ratio"] == before["extra"].get("ratio") and "ratio" not in now["extra"]
    assert {row["known_issue"] for row in new} == {None, "kinematic-tree-reactions"}


def test_the_summary_has_the_same_rows_as_the_document():
    table = {row["key"]: row for row in read_table(STORED, "summary").to_pylist()}
    for row in read_results(STORED)["rows"]:
        assert table[row["key"]] | {"extra": row["extra"], "causes": row["causes"]} == row
        assert json.loads(table[row["key"]]["extra"]) == row["extra"]


def test_run_and_engines_get_the_present_names(tmp_path):
    document = json.loads((STORED / "results.json").read_text())
    document["run"] |= {
        "probes": {"scenarios": 2, "folded": {"agrees": 3}, "worst": []},
        "instrument": {"planted": 67},
    }
    (tmp_path / "results.json").write_text(json.dumps(document))
    found = read_results(tmp_path)
    batch = {"scenarios": 2, "counts_by_verdict": {"agrees": 3}, "worst_ratios": []}
    assert found["run"]["random_batch"] == batch and found["run"]["self_test"] == {"planted": 67}
    assert found["run"]["stale_issues"] == []
    midpoint = found["engines"]["mujoco"]["integrators"][0]
    assert (midpoint["error_exponents"], midpoint["is_symmetric"]) == ([1, 2, 3, 4, 5, 6], False)
    assert (midpoint["solver_rtol"], midpoint["min_rtol"]) == (0.0, 1e-12)


def test_history_report_and_reproduce_read_them(results):
    history = History(results.parent)
    assert [night.id for night in history.nights] == [STORED.name] and not history.damaged
    (trend,) = history.trend(KEY)
    assert trend["ratio"] == next(r["extra"]["ratio"] for r in stored_rows() if r["key"] == KEY)
    assert history.overview()[0]["as_recorded"] == 1
    command = CliRunner()
    answer = command.invoke(main, ["report", str(results), "--history", str(results.parent)])
    assert answer.exit_code == 0, answer.output
    assert "**13** agree" in (results / "summary.md").read_text()
    answer = command.invoke(main, ["reproduce", str(results)])
    assert answer.exit_code == 0 and "nothing disagrees" in answer.output, answer.output


def test_a_disagreement_of_version_1_can_be_selected(results):
    document = json.loads((results / "results.json").read_text())
    for row in document["rows"]:
        if row["key"] == KEY:
            row |= {"verdict": "disagrees", "extra": row["extra"] | {"ratio": 30.0}}
    (results / "results.json").write_text(json.dumps(document))
    answer = invoke("reproduce", results, KEY)
    assert "the engine agrees" in answer.output, answer.output
