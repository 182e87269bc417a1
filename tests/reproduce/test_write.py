"""Scripts of a results folder: which rows get one, and what damaged or wrong input leads to."""

import json
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.execution.result_cache import DiskResultCache
from plumbline.judging.known_issues import project_known_issues
from plumbline.judging.rows import RowContext
from plumbline.layout import ROOT
from plumbline.processes.worker_pool import Outcome
from plumbline.reproduce import write
from plumbline.reproduce.write import NotReproducible, write_scripts
from plumbline.storage import results_store
from plumbline.storage.results_schema import DamagedResults
from plumbline.storage.script_index import read_script_index
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.commands import invoke
from tests.helpers.reproduction import run_alone

for name in ("mujoco", "pinocchio", "exudyn", "flint"):
    pytest.importorskip(name)

SLOW = {"level": "trajectory", "integrator": "rkmk4", "quantity": "attitude", "cpu_time": 2.0}


@pytest.fixture
def results(tmp_path):
    """A results folder with real disagreements of aba, one row that agrees and one without a script."""
    scenario = catalogue_scenario("chain-30-balls")
    about = {
        "family": "chain",
        "title": "Thirty balls",
        "bodies": scenario.model.n,
        "digest": scenario.digest,
        "model": {k: np.asarray(v).tolist() for k, v in scenario.model.fields.items()},
        "state": {k: x.tolist() for k, x in vars(scenario.state).items()},
    }
    version = load_adapter("pinocchio-aba").version()
    context = RowContext("chain", "chain", "pinocchio-aba", "Pinocchio", version)
    rows = [
        results_store.row_record(
            context.make_row(level, integrator, quantity, verdict, "off", ratio=400.0, extra={"state": 0.0})
        ) | {"key": key}
        for key, level, integrator, quantity, verdict in (
            ("a", "state", "-", "acceleration", "disagrees"),
            ("b", "relations", "rkmk4", "reversed in time", "disagrees"),
            ("c", "state", "-", "joint_reaction", "agrees"),
            ("d", "relations", "-", "re-chosen body frame", "disagrees"))
    ]  # fmt: skip
    document = {
        "schema_version": results_store.SCHEMA_VERSION,
        "run": {"id": "x", "started": "2026-01-01", "duration": 1.0, "sentence": "off", "exit_code": 1},
        "scenarios": {"chain": about},
        "engines": {"pinocchio-aba": {"title": "Pinocchio", "version": version}},
        "rows": rows,
    }
    store(tmp_path, document)
    return tmp_path


def store(folder, document):
    (folder / "results.json").write_text(json.dumps(document))


def command(*arguments):
    """The command's exit code and its output; a traceback is a failure."""
    done = invoke(*arguments)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.output


def test_the_command_lists_and_writes(results):
    code, listed = command("reproduce", results)
    assert code == 0 and "a: off" in listed and "c:" not in listed
    with patch("plumbline.reproduce.write.REQUESTED_SECONDS", 0.0):
        code, printed = command("reproduce", results / "results.json", "a", "d")
    assert code == 0, printed
    index = read_script_index(results)
    assert set(index) == {"a", "d"}
    for name in index.values():
        path = results / "scripts" / name
        assert str(path) in printed
        assert max(run_alone(path.read_text(encoding="utf-8"), results)) > 1
    code, refused = command("reproduce", results, "nothing")
    assert code == 2 and "no row 'nothing' disagrees here" in refused
    assert "did you mean 'a'?" in command("reproduce", results, "aa")[1]
    code, refused = command("reproduce", results, "a", "--form", "mujoco")
    assert code == 2 and "--form is for results of `model`" in refused
    code, refused = command("reproduce", results, "b")
    assert code == 1 and "relations of runs have no script" in refused


def test_the_runs_behind_a_row_are_those_of_its_refinement_study(results):
    document = results_store.read_results(results)
    found = {"scenario": "chain", "engine": "mujoco", "integrator": "RK4", "level": "trajectory",
             "verdict": "disagrees", "declared_order": 4, "compared_until": 1.7, "ratio": 20.0,
             "quantity": "order", "extra": {}}  # fmt: skip
    finest = found | {"quantity": "position", "verdict": "agrees", "extra": {"resolution": 2.0**-8}}
    others = ({"level": "relations"}, {"level": "invariants", "quantity": "energy_drift_long"})
    document["rows"] = [found, finest, *(finest | o | {"extra": {"resolution": 2.0**-12}} for o in others)]
    disagreement = write.find_disagreement(document, [found], 1.0)
    assert disagreement.case.steps == (2.0**-5, 2.0**-6, 2.0**-7, 2.0**-8)
    assert disagreement.case.until == 1.0 and disagreement.ratio == 20
    assert disagreement.quantities == ("order",)
    limit = finest | {"quantity": "position_limit", "declared_order": None}
    document["rows"] = [found, finest, limit]
    assert write.find_disagreement(document, [limit], 1.0).case.until == 1.0
    for rows, reason in (([found], "refinement study"), ([limit], "adaptive steps")):
        document["rows"] = rows
        with pytest.raises(NotReproducible, match=reason):
            write.find_disagreement(document, rows, 1.0)


def test_a_lost_worker_leaves_no_script(results):
    def lost(_, tasks):
        return [Outcome(t.key, failure="hung") for t in tasks]

    with patch("plumbline.reproduce.write.WorkerPool.run", lost):
        written = write_scripts(results)
        assert write_scripts(results, ["d"]).reasons == {"d": "hung"}
    assert written.reasons["a"] == "hung" and "relations of runs" in written.reasons["b"]
    assert "the state-level script" in written.reasons["d"] and not written.files
    assert not list((results / "scripts").glob("*.py"))


def test_a_script_is_made_again_only_where_its_rows_have_changed(results):
    cells = DiskResultCache(results / "cells")
    no_worker = patch("plumbline.reproduce.write.WorkerPool", side_effect=AssertionError("began"))
    with patch("plumbline.reproduce.write.UNREQUESTED_SECONDS", 0.0):
        text = write_scripts(results, results=cells).files["a"].read_text(encoding="utf-8")
        with no_worker:
            assert write_scripts(results, results=cells).files["a"].read_text(encoding="utf-8") == text
        document = results_store.read_results(results)
        document["rows"][0]["engine_version"] = "9.9.9"
        store(results, document)
        with no_worker, pytest.raises(AssertionError, match="began"):
            write_scripts(results, results=cells)


def test_at_the_end_of_a_run_nothing_long_is_begun(results):
    document = results_store.read_results(results)
    document["rows"] = [document["rows"][0] | SLOW | {"key": "s"}]
    store(results, document)
    with patch("plumbline.reproduce.write.WorkerPool", side_effect=AssertionError("began")):
        reasons = write_scripts(results).reasons
    hint = "request this row by its key"
    assert reasons == {"s": f"one candidate takes 2.0 s, too long at the end of a run; {hint}"}
    with patch("plumbline.reproduce.write.find_disagreement", side_effect=NotReproducible("began")):
        assert write_scripts(results, ["s"]).reasons == {"s": "began"}


@pytest.mark.parametrize("level", ["surface", "state"])
def test_at_the_end_of_a_run_a_finding_has_one_script_at_each_level(level, results):
    """Of its smallest mechanism, whichever version it is of; where that has none, of the next two."""
    document = results_store.read_results(results)
    row = document["rows"][0] | {"integrator": "-"}
    document["rows"] = [
        row | {"key": name, "quantity": "frame_axes", "scenario": name, "engine": engine, "level": own}
        for name, engine, own in (
            ("large", "mujoco", level),
            ("small", "mujoco@3.6.0", level),
            ("without", "mujoco", level),
            ("moving", "mujoco", "trajectory"),
            ("other", "mujoco", level),
            ("larger", "mujoco", level),
            ("largest", "mujoco", level),
        )
    ]
    document["scenarios"] |= {one["key"]: document["scenarios"]["chain"] for one in document["rows"]}
    document["engines"] |= {one["engine"]: document["engines"]["pinocchio-aba"] for one in document["rows"]}
    lists = "versions", "right_versions", "scenarios", "quantities", "identity"
    about = {"engine": "mujoco", "verdict": "disagrees", "title": "wrong", "sentence": "wrong"}
    about |= {"known_issue": None, "largest_ratio": 2.0, **{name: [] for name in lists}}
    document["findings"] = [
        about | {"name": "wrong", "rows": ["without", "small", "large", "larger", "largest", "moving"]},
        about | {"name": "other", "rows": ["other"]},
    ]
    store(results, document)
    begun = []

    def begin(_, rows, seconds):
        if rows[0]["key"] == "without":
            raise NotReproducible("nothing to measure")
        begun.append(rows[0]["key"])
        return SimpleNamespace(engine=SimpleNamespace(python="of another version"))

    def run(*hung):
        """All have a script, but these scenarios."""

        def outcomes(_, tasks):
            text = {"raw_value": ("text", "")}
            return [Outcome(t.key, **({"failure": "hung"} if t.key[0] in hung else text)) for t in tasks]

        return patch("plumbline.reproduce.write.WorkerPool.run", outcomes)

    with patch("plumbline.reproduce.write.find_disagreement", side_effect=begin):
        with run("small", "moving", "large", "other", "larger"):
            reasons = write_scripts(results).reasons
            assert write_scripts(results, ["large"]).reasons == {"large": "hung"}
        assert begun == ["other", "small", "moving", "large", "larger", "large"]
        with run("small"):
            second = write_scripts(results)
        with run():
            written = write_scripts(results)
    hint = "request this row by its key"
    assert reasons.pop("largest") == f"larger shows the same finding and has none (hung); {hint}"
    assert reasons.pop("without") == "nothing to measure" and set(reasons.values()) == {"hung"}
    assert set(second.files) == {"large", "moving", "other"} and second.reasons["small"] == "hung"
    assert second.reasons["larger"] == f"large shows the same finding and has a script; {hint}"
    assert set(written.files) == {"small", "moving", "other"}
    assert written.reasons["large"] == f"small shows the same finding and has a script; {hint}"


def test_rows_of_a_known_issue_get_its_script_at_the_end_of_a_run(results):
    issue = next(one for one in project_known_issues() if one.script)
    other = next(one for one in project_known_issues() if one.verdict == "disagrees" and not one.script)
    document = results_store.read_results(results)
    row = document["rows"][0]
    document["rows"] = [
        row | {"key": name, "level": level, "quantity": quantity, "known_issue": found.name}
        for name, level, quantity, found in (
            ("one", "surface", "frame_axes", issue),
            ("two", "state", "energy", issue),
            ("own", "surface", "frame_position", other),
        )
    ]
    store(results, document)
    with patch("plumbline.reproduce.write.find_disagreement", side_effect=NotReproducible("began")):
        written = write_scripts(results)
        by_key = write_scripts(results, ["one"])
    assert written.reasons == {"own": "began"} and by_key.reasons == {"one": "began"}
    assert set(written.files) == {"one", "two"} == set(read_script_index(results))
    recorded = ROOT / "docs" / "surface" / issue.script
    for path in written.files.values():
        assert path.parent == results / "scripts" and path.read_bytes() == recorded.read_bytes()


# --- damaged input ------------------------------------------------------------------------------------

INDICES = (
    "", "{", "[]", "null", "3", '"text"', '{"a": 1}', '{"a": null}', '{"a": ["b"]}', '{"a": ""}',
    '{"a": "../../etc/passwd"}', '{"a": "/etc/passwd"}', '{"a": "b\\u0000c"}', '{"a": "\\ud800"}',
    '{"a": "' + "n" * 300 + '"}', "\udcff", "[" * 100_000,
)  # fmt: skip


@pytest.mark.parametrize("text", INDICES, ids=[repr(text)[:20] for text in INDICES])
def test_a_damaged_index_is_named(results, text):
    (results / "scripts").mkdir()
    (results / "scripts" / "index.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(DamagedResults, match=r"index\.json"):
        read_script_index(results)
    for arguments in (("reproduce", results, "a"), ("report", results)):
        code, output = command(*arguments)
        assert code == 2 and "index.json" in output and "remove it" in output


def damaged(document):
    """Copies of a document, each with one value of a row or scenario removed or replaced."""
    chain = document["scenarios"]["chain"]
    for value in (None, 7, "text", [[1.0]]):
        for name in ("rows", "scenarios", "run"):
            yield document | {name: value}
        for name in document["rows"][0]:
            yield document | {"rows": [document["rows"][0] | {name: value}]}
        for name in ("model", "state", "digest"):
            yield document | {"scenarios": {"chain": chain | {name: value}}}
    for name in document["rows"][0]:
        kept = {k: v for k, v in document["rows"][0].items() if k != name}
        yield document | {"rows": [kept]}
    for part in ("model", "state"):
        for name in chain[part]:
            for value in (None, [], [float("nan")]):
                yield document | {"scenarios": {"chain": chain | {part: chain[part] | {name: value}}}}


def test_damaged_results_are_named_and_raise_nothing_else(results):
    document = results_store.read_results(results)

    def no_work(_, tasks):
        return [Outcome(t.key, failure="not run") for t in tasks]

    with patch("plumbline.reproduce.write.WorkerPool.run", no_work):
        for copy in damaged(document):
            store(results, copy)
            for arguments in (("reproduce", results), ("reproduce", results, "a")):
                code, output = command(*arguments)
                assert code in (0, 1, 2), output
                assert code != 2 or "results.json" in output or "no row 'a' disagrees" in output, output
                assert code != 2 or "results.json" in output or "no row 'a'" in output, output
