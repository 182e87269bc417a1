"""The nightly: random scenarios that are the same again, a whole folder per night, and what is left over."""

import json
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pyarrow.parquet as pq
import pytest

from plumbline.cli import nightly
from plumbline.cli.nightly import NightPlan
from plumbline.execution.random_batch import RandomBatch
from plumbline.execution.runner import RunResult
from plumbline.judging.rows import RowContext
from plumbline.model.datatypes import JOINT_ELEMENTS, KINDS
from plumbline.model.features import joint_roles
from plumbline.model.loops import loop_gaps
from plumbline.model.random_mechanisms import ELEMENTS, random_loop_mechanism
from plumbline.processes.cpu_time import CpuTimes
from plumbline.scenario import loader
from plumbline.scenario.generator import (
    MAX_RANDOM_BODIES,
    PLACES,
    RANDOM_FAMILY,
    RandomScenarios,
    random_document,
    random_mechanism,
    random_scenario,
)
from plumbline.scenario.mechanism_document import mechanism_document
from plumbline.storage.history_of_nights import History
from plumbline.storage.results_store import ResultTables, read_results, read_table
from plumbline.studies.coverage_study import CoverageFailure
from tests.helpers.nightly_tests import slow
from tests.helpers.nights import run_night
from tests.helpers.requirements import needs_truth_tools
from tests.reports.test_report import decoded_chunks


def test_a_random_scenario_depends_on_its_seed_and_number_alone():
    first = list(RandomScenarios(5, 12))
    assert [s.digest for s in first] == [random_scenario(5, k).digest for k in range(12)]
    assert first[3].digest != random_scenario(6, 3).digest
    assert len({s.digest for s in first}) == 12


def test_random_scenarios_cover_what_they_promise():
    drawn = list(RandomScenarios(1, 300))
    mass = np.concatenate([s.model.mass for s in drawn])
    assert {s.model.n for s in drawn} == set(range(1, MAX_RANDOM_BODIES + 1))
    assert mass.min() < 1e-2 and mass.max() > 1e2
    assert any(s.model.has_loads for s in drawn) and any(s.model.has_drag for s in drawn)
    rods = np.concatenate([s.model.rods for s in drawn])
    assert 0.3 < rods.mean() < 0.5
    off_diagonal = np.concatenate([s.model.inertia[:, [0, 0, 1], [1, 2, 2]] for s in drawn])
    assert np.mean(off_diagonal != 0) > 0.8


def test_some_random_scenarios_have_special_values():
    """At least 3 of 300 have each, at the initial state; the others have none."""
    drawn = list(RandomScenarios(1, 300))
    special = [s for s in drawn if "special" in s.title]
    assert 100 < len(special) < 140
    for counts in (
        lambda m, s: np.any(s.p[:, 0] == 1), lambda m, s: np.any(s.p[:, 0] == 0),
        lambda m, s: np.all(s.p[:, 0] < 0), lambda m, s: not np.all(s.omega),
        lambda m, s: not np.all(m.proximal), lambda m, s: m.n > 1 and np.ptp(m.mass) == 0,
        lambda m, s: np.any(m.inertia[:, 0, 0] == m.inertia[:, 1, 1]),
        lambda m, s: m.has_loads and not np.all(np.any(m.force, axis=1)),
        lambda m, s: m.n > 1 and not np.any(m.force[:-1]) and np.any(m.force[-1]),
        lambda m, s: m.n > 1 and m.drag_force[0] == 0 and np.any(m.drag_force[1:]),
        lambda m, s: m.n > 2 and np.all(s.p[:, 0] == 1), lambda m, _: np.any(m.gravity[:2]),
    ):  # fmt: skip
        assert sum(bool(counts(s.model, s.state)) for s in special) >= 3
    rest = [s for s in drawn if s not in special]
    assert all(np.all(s.state.omega) and np.all(abs(s.state.p[:, 0]) < 1) for s in rest)


def test_a_random_scenario_is_a_file_like_any_other(tmp_path):
    path = tmp_path / "some.yaml"
    path.write_text(json.dumps(random_document(3, 4)))
    assert loader.load_scenario(path).digest == random_scenario(3, 4).digest


def test_random_mechanisms_cover_every_joint_element_and_topology():
    drawn = list(RandomScenarios(5, 0, mechanism_count=224))
    assert [s.digest for s in drawn[:3]] == [random_mechanism(5, k).digest for k in range(3)]
    assert RandomScenarios(5, 2, 1, 3).named("random-mechanism-5-2").digest == drawn[2].digest
    trees, loops, mixed = drawn[::4], drawn[1::4], [*drawn[2::4], *drawn[3::4]]
    assert not any(s.model.has_loops for s in trees) and all(s.model.has_loops for s in loops)
    assert {len(s.model.kind) - s.model.n for s in loops} == {1, 2}
    assert {s.model.n for s in trees} <= set(range(1, MAX_RANDOM_BODIES + 1))
    assert {place for s in mixed for place in zip(s.model.kind, joint_roles(s.model), strict=True)} == set(
        PLACES
    )
    assert any(s.model.kind.count("free") > 1 for s in mixed)
    assert any(np.any(s.model.stiffness[s.model.n :]) for s in loops)
    for count in (lambda m: m.n, lambda m: len(m.kind)):  # tree joints, and with those that close loops
        assert {kind for s in drawn for kind in s.model.kind[: count(s.model)]} == set(KINDS)
    assert {s.model.kind[-1] for s in loops} == set(KINDS) - {"free"}
    for element in (*JOINT_ELEMENTS, "spring_body"):
        has = [np.any(getattr(s.model, element)) for s in drawn]
        assert 0.5 < np.mean(has) < 0.75, element
    rotors = [s for s in drawn if "free" in s.model.kind and np.any(s.model.armature)]
    assert len(rotors) >= 5
    assert max(np.max(loop_gaps(s.model, s.state)) for s in [*loops, *mixed]) < 1e-11


def test_a_mechanism_comes_back_from_its_file():
    """But for rounding of axes and attitudes; axes of balls, rods and free bodies are not in a file."""
    model, state = random_loop_mechanism(3, 5, ["hinge", "rod"], tuple(KINDS), ELEMENTS)
    texts = {"schema_version": 1, "name": "copy", "title": "copy", "purpose": "copy", "duration": 1.0}
    found = loader.scenario_from_dict(texts | mechanism_document(model, state), "copy.yaml")
    has_axes = [not KINDS[kind].has_attitude for kind in model.kind]
    for name, value in vars(model).items():
        other = getattr(found.model, name)
        if name in ("kind", "body", "spring_body"):
            assert np.array_equal(value, other)
        elif name == "turn":
            np.testing.assert_allclose(value[has_axes], other[has_axes], atol=1e-15)
        elif name == "rest":  # has no effect without a spring
            used = model.stiffness > 0
            np.testing.assert_array_equal(value[used], other[used])
        else:
            np.testing.assert_allclose(value, other, rtol=1e-15, atol=0)
    for name in ("p", "omega", "u", "udot", "r", "v"):
        np.testing.assert_allclose(getattr(state, name), getattr(found.state, name), atol=1e-13)


def run_nightly(out, **more):
    return run_night(out, more.pop("engine", "mujoco"), **({"random_count": 3} | more))


@needs_truth_tools
def test_a_night_proves_motions_and_uses_them(tmp_path):
    result, place = run_nightly(tmp_path, random_count=0, proof_cpu_seconds=10.0)
    assert result.metadata["proofs"]["proved"] == ["rest"]
    assert "; motions: 1 proved, 1 of them now" in result.metadata["sentence"]
    assert read_results(place)["scenarios"]["rest"]["truth"].startswith("proved: ")
    shown = decoded_chunks((place / "report.html").read_text(encoding="utf-8"))["scenario-0"]["departures"]
    assert shown["runs"] and all(run["left"] is None and run["until"] == 2 for run in shown["runs"])
    result, _ = run_nightly(tmp_path, random_count=0, proof_cpu_seconds=10.0)
    assert result.metadata["proofs"]["proved"] == [] and result.metadata["proofs"]["known"] == 1


@slow
def test_a_night_with_every_level_has_its_coverage(tmp_path):
    result, place = run_nightly(tmp_path)
    covered = pq.read_table(place / "coverage.parquet").to_pylist()
    # at rest every invariant is exactly zero, so it reveals no wrong motion
    assert {row["level"] for row in covered} == {"state", "step", "trajectory"}
    assert {row["engine"] for row in covered if row["smallest"]} <= {"", "mujoco"}
    assert all(row["smallest"] or row["proof"] for row in covered)
    assert 'id="coverage"' in (place / "report.html").read_text(encoding="utf-8")
    levels = {"state", "surface", "step", "trajectory", "invariants", "relations"}
    assert {r.level for r in result.rows if r.scenario == "rest"} == levels


def test_a_night_is_whole_and_remembered(tmp_path):
    result, place = run_nightly(tmp_path, random_count=2, engine="pinocchio", level="state")
    assert {p.name for p in place.iterdir()} >= {
        "results.json", "summary.parquet", "states.parquet", "curves.parquet", "junit.xml",
        "report.html", "summary.md",
    }  # fmt: skip
    assert sorted(p.name for p in tmp_path.iterdir()) == ["history"]
    stored = read_results(place)["run"]
    assert (stored["seed"], stored["random"]) == (11, 2)
    kept = [row for row in result.rows if row.family == RANDOM_FAMILY]
    for row in kept:  # scenarios without anything remarkable are only counted
        assert any(other.verdict != "agrees" for other in kept if other.scenario == row.scenario), row.key
    counted = result.random_batch.counts_by_verdict
    random = [r for r in read_table(place, "summary").to_pylist() if r["family"] == RANDOM_FAMILY]
    assert {r["scenario"] for r in random} == {"random-11-0", "random-mechanism-11-0"}
    assert {r["level"] for r in random} == {"state", "step", "surface"}
    assert counted.total() + len(kept) == len(random)
    assert stored["random_batch"]["scenarios"] == 2
    keys = {row.key for row in kept}
    ratios = [r["ratio"] for r in random if r["verdict"] == "agrees" and r["key"] not in keys]
    assert max(cell["ratio"] for cell in stored["random_batch"]["worst_ratios"]) == max(ratios)
    agree = sum(row.verdict == "agrees" for row in result.rows) + counted["agrees"]
    checks = sum(row.verdict.is_comparison for row in result.rows) + counted["agrees"]
    assert stored["sentence"].startswith(f"{checks} independent checks: {agree} agree")
    assert "2 random scenarios" in (place / "report.html").read_text()
    assert "2 random scenarios" in (place / "summary.md").read_text()
    (seen,) = History(tmp_path).overview()
    assert seen["id"] == place.name and seen["random"] == 2


def test_a_night_counts_what_its_random_mechanisms_add(tmp_path):
    options = {"random_count": 8, "level": "state", "engine": "pinocchio-aba"}  # which takes no steps
    first, place = run_nightly(tmp_path, **options)
    found = first.metadata["feature_triples"]
    assert found["found"] == found["new"] > 1000
    assert f"{found['new']:,} of them new in 7 nights" in first.metadata["sentence"]
    again, _ = run_nightly(tmp_path, **options)
    assert again.metadata["feature_triples"] == {"found": found["found"], "new": 0}
    (place / "features.json").write_text("{", encoding="utf-8")
    other, _ = run_nightly(tmp_path, **options | {"seed": 12})
    assert 0 < other.metadata["feature_triples"]["new"] < other.metadata["feature_triples"]["found"]


def test_a_night_is_kept_without_its_coverage(tmp_path):
    reason = "no coverage of rest: SingularSystem: the joint rows are not independent"
    with patch.object(nightly, "measure_coverage", side_effect=CoverageFailure(reason)):
        result, place = run_nightly(tmp_path, random_count=0)
    assert result.metadata["exit_code"] == 5 and not (place / "coverage.parquet").exists()
    assert read_results(place)["run"]["sentence"].endswith(reason)
    assert "no coverage of rest" in (place / "report.html").read_text(encoding="utf-8")


class Killed(Exception):
    pass


def test_an_unfinished_night_goes_on_with_its_seed(tmp_path, own_cells):
    def progress(done, *_):
        if done == 4:
            raise Killed

    with pytest.raises(Killed):
        run_nightly(tmp_path, seed=None, progress=progress)
    begun = json.loads((tmp_path / "unfinished" / "plan.json").read_text())
    assert not (tmp_path / "history").exists()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["plan.json", "unfinished"], (
        "cells are private"
    )
    kept = sorted(own_cells.parent.glob("nights/*/*.cell"))
    # the description of the engine and the finished cells; the worker may have finished the next one
    assert len(kept) in (1 + 4, 1 + 5)
    for path in kept:  # what is kept is used: no cell of it is written again
        path.chmod(0o400)
    result, _ = run_nightly(tmp_path, seed=None)
    assert result.metadata["seed"] == begun["seed"] and result.metadata["started"] == begun["started"]
    assert not any(path.exists() for path in kept), "a finished night removes its cells"
    uninterrupted, _ = run_nightly(tmp_path / "calm", seed=begun["seed"])
    assert [(r.key, r.value, r.verdict) for r in result.rows] == [
        (r.key, r.value, r.verdict) for r in uninterrupted.rows
    ]


@pytest.mark.parametrize("damage", ["", "{", '{"seed": 1}', "[]"])
def test_a_damaged_plan_begins_a_new_night(tmp_path, damage):
    (tmp_path / "plan.json").write_text(damage)
    night = NightPlan.resume_or_start(tmp_path, None, 7)
    assert NightPlan.resume_or_start(tmp_path, None, 7) == night
    assert NightPlan.resume_or_start(tmp_path, night.seed + 1, 7) != night


def test_remarkable_random_scenarios_are_kept_with_their_files(tmp_path):
    drawn = RandomScenarios(2, 3)
    probes, kept = RandomBatch(), []
    for s, verdict in zip(drawn, ("agrees", "disagrees", "unsupported"), strict=True):
        context = RowContext(s.name, RANDOM_FAMILY, "mujoco", "MuJoCo", "4")
        fine = context.make_row("state", "-", "joint_reaction", "agrees", "why", ratio=0.5)
        other = replace(fine, engine="exudyn")
        kept += probes.add_scenario(
            [other, fine, context.make_row("state", "-", "acceleration", verdict, "why")]
        )
    assert [r.verdict for r in kept] == ["agrees", "disagrees", "agrees", "unsupported"]
    assert {r.engine for r in kept} == {"mujoco"}, "rows of engines that agree are only counted"
    assert probes.counts_by_verdict == {"agrees": 5} and probes.worst_ratios["mujoco", "joint_reaction"] == (
        0.5,
        drawn[0].name,
    )
    excused = replace(kept[-1], known_issue="k")
    assert probes.add_scenario([excused]) == [], "a recorded gap of every probe is only counted"
    kept.append(replace(kept[-1], scenario="a user's file of the family random"))
    nightly.write_random_scenario_files(
        RunResult(kept, [], {}, {}, probes, ResultTables(), CpuTimes(), {}), drawn, tmp_path
    )
    found = sorted(tmp_path.iterdir())
    assert [loader.load_scenario(path).digest for path in found] == [drawn[1].digest, drawn[2].digest]


def test_random_motions_run_at_every_level(tmp_path):
    result, place = run_nightly(tmp_path, random_count=1, random_trajectory_count=2, seed=4)
    rows = [row for row in read_table(place, "summary").to_pylist() if row["family"] == RANDOM_FAMILY]
    levels = {}
    for row in rows:
        levels.setdefault(row["scenario"], set()).add(row["level"])
    few = {"state", "surface", "step"}
    every = {*few, "trajectory", "invariants", "relations"}
    assert levels == {"random-motion-4-0": every, "random-motion-4-1": every, "random-4-0": few}
    assert result.metadata["random_batch"]["trajectories"] == 2
    assert result.metadata["exit_code"] == 0, result.metadata["sentence"]
    summary = (place / "summary.md").read_text()
    assert "3 random scenarios at state level, 2 of them" in summary


def test_random_motions_do_not_change_the_other_random_scenarios():
    drawn = RandomScenarios(4, 3, 2)
    names = ["random-motion-4-0", "random-motion-4-1", "random-4-0", "random-4-1", "random-4-2"]
    assert [one.name for one in drawn] == names and len(drawn) == 5
    assert [drawn.named(name).digest for name in names] == [one.digest for one in drawn]
    assert [one.digest for one in drawn[2:]] == [one.digest for one in RandomScenarios(4, 3)]
    motions = list(RandomScenarios(9, 0, 40))
    assert {one.model.n for one in motions} == {1, 2, 3}
    assert all(one.closed_form is None for one in motions)
    assert {bool(np.any(one.model.force)) for one in motions} == {True, False}
    assert {one.model.has_drag for one in motions} == {True, False}
