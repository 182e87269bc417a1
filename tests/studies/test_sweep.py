"""Sweeps: what a file makes of a scenario, and how a cell is judged."""

import time
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import pyarrow.parquet as pq
import pytest

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.engine_calls import run_refinement
from plumbline.engines.registry import load_adapter
from plumbline.execution.runner import describe_engines
from plumbline.judging.rows import RowContext
from plumbline.judging.trajectory_level import judge_trajectory
from plumbline.measurements.order_and_limit import refinement_resolutions
from plumbline.processes.worker_pool import Limits, WorkerPool
from plumbline.scenario.line_and_column_errors import ScenarioError
from plumbline.studies import sweep, sweep_file
from plumbline.studies.parquet_files import write_table
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.mutations import limited_time
from tests.helpers.planted_defects import MOTION_DEFECTS
from tests.helpers.planting import Defect, motion_subject, planted
from tests.helpers.tables import table

SWEEP_FILE = """\
schema_version: 1
scenario: double-tumbling-balls
vary:
  bodies[0].mass: {from: 0.5, to: 2.0, points: 3, log: true}
  bodies[1].angular_velocity[2]: {values: [-1, 1]}
  bodies[1].proximal[0]: {uniform: [-0.05, 0.05]}
count: 2
seed: 7
duration: 0.25
engines: {mujoco: RK4}
"""


def write_sweep_file(folder, text):
    path = folder / "sweep.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def loaded(folder, text=SWEEP_FILE):
    return sweep_file.load(write_sweep_file(folder, text))


def run_sweep(spec, cells, seconds=300.0, progress=lambda *_: None, **engines):
    """The rows of a sweep; descriptions of engines may be given instead of those found here."""
    with WorkerPool(1, Limits(seconds)) as workers:
        found = describe_engines(workers, list(spec.engines)) | engines
        return sweep.run(spec, cells, workers, found, progress)


def test_the_grid_and_the_draws(tmp_path):
    spec, cells = loaded(tmp_path)
    assert len(cells) == 3 * 2 * spec.count
    assert sorted({cell.values["bodies[0].mass"] for cell in cells}) == pytest.approx([0.5, 1.0, 2.0])
    drawn = [cell.values["bodies[1].proximal[0]"] for cell in cells]
    assert len(set(drawn)) == len(cells)
    assert max(np.abs(drawn)) <= 0.05
    for cell in cells:
        assert cell.scenario is not None
        assert cell.scenario.model.mass[0] == cell.values["bodies[0].mass"]
        assert cell.scenario.model.proximal[1, 0] == cell.values["bodies[1].proximal[0]"]
        assert cell.scenario.state.omega[1, 2] == cell.values["bodies[1].angular_velocity[2]"]
        assert cell.scenario.duration == 0.25
    again = loaded(tmp_path)[1]
    assert [cell.values for cell in again] == [cell.values for cell in cells]
    assert [c.values for c in loaded(tmp_path, SWEEP_FILE.replace("7", "8"))[1]] != [c.values for c in cells]


def test_a_sweep_runs_and_is_kept(tmp_path):
    spec, cells = sweep_file.load(
        write_sweep_file(tmp_path, SWEEP_FILE.replace("points: 3", "points: 2").replace("[-1, 1]", "[1]"))
    )
    table = run_sweep(spec, cells)
    kept = pq.read_table(write_table(table, tmp_path / "sweep.parquet")).to_pylist()
    assert len(kept) == 2 * len(cells)
    assert {(row["implementation"], row["verdict"]) for row in kept} == {
        ("reference", "agrees"),
        ("mujoco", "agrees"),
    }, [row["reason"] for row in kept]
    for row in kept:
        assert row["bodies[0].mass"] == cells[row["cell"]].values["bodies[0].mass"]
        assert row["uncertainty"] < 1e-9
    ends = [[row[k] for k in "xyz"] for row in kept]
    assert np.ptp(np.array(ends)[::2], axis=0).max() > 1e-3  # the parameters matter


def test_values_that_make_no_pendulum_are_a_cell_with_a_reason(tmp_path):
    vary = "vary: {'bodies[0].mass': {values: [-1, 1]}}"
    text = f"schema_version: 1\nscenario: tumbling-rod\n{vary}\nduration: 0.25\n"
    spec, cells = loaded(tmp_path, text)
    assert cells[0].scenario is None
    rows = run_sweep(spec, cells).to_pylist()
    assert [row["verdict"] for row in rows] == ["unsupported", "agrees"]
    assert "bodies[0].mass" in rows[0]["reason"]


@cache
def cell(loaded=False):
    """A slow tumble whose every mistake shows within two seconds."""
    s = catalogue_scenario("double-tumbling-balls")
    model, state, truth = motion_subject("balls", loaded)
    return replace(s, model=model, state=state, duration=2.0, sample_interval=0.125), truth


def judged_by_run_and_sweep(defect):
    """The verdicts of a run and that of a sweep on one cell, by an engine with a planted defect."""
    (s, truth), engine = cell(defect.loaded), load_adapter(defect.engine)
    method = engine.integrator(defect.integrator)
    info = EngineInfo("mujoco", "MuJoCo", "0", engine.integrators)

    def study(steps):
        with (
            planted(defect) as engine,
            patch("plumbline.engines.engine_calls.load_adapter", lambda _: engine),
        ):
            return run_refinement("mujoco", method.name, s.model, s.state, s.times, steps)

    run_steps = refinement_resolutions(method, s.model.n, s.duration)
    context = RowContext(s.name, s.family, "mujoco", "MuJoCo", "0")
    rows = judge_trajectory(context, s.model, truth, method, study(run_steps)).rows
    own, _ = sweep._judge_cell(info, method, s, study(sweep._resolutions(method, s, None)), truth)
    return {row.verdict for row in rows if row.verdict.is_comparison or row.verdict == "failed"}, own.verdict


@pytest.mark.parametrize("defect", MOTION_DEFECTS, ids=lambda defect: defect.name)
def test_a_defect_that_a_run_reports_is_reported_by_a_sweep(defect):
    by_run, by_sweep = judged_by_run_and_sweep(defect)
    assert by_run != {"agrees"} and by_sweep in by_run - {"agrees"}
    assert (by_sweep == "disagrees") == ("disagrees" in by_run and "failed" not in by_run)


def test_an_engine_without_defect_agrees_in_both():
    assert judged_by_run_and_sweep(Defect("clean")) == ({"agrees"}, "agrees")


def test_an_engine_too_coarse_to_resolve_a_mistake_is_unresolved(tmp_path):
    text = (
        SWEEP_FILE.replace("points: 3", "points: 1").replace("[-1, 1]", "[1]").replace("count: 2", "count: 1")
    )
    text = text.replace("mujoco: RK4", "mujoco: Euler") + "step: 0.03125\n"
    spec, cells = loaded(tmp_path, text)
    _, row = run_sweep(spec, cells).to_pylist()
    assert (row["implementation"], row["integrator"], row["verdict"]) == ("mujoco", "Euler", "unresolved")
    assert row["position_error"] > 0 and row["finest_error"] > 0 and row["attitude_error"] > 0


@pytest.mark.parametrize("interval", [0.03125, 0.05])
def test_every_step_hits_every_sample(interval):
    """The steps of a run where the samples allow them; else shorter ones, or those of the file."""
    s = replace(catalogue_scenario("tumbling-rod"), sample_interval=interval)
    method = load_adapter("mujoco").integrator("RK4")
    usual = refinement_resolutions(method, s.model.n, s.duration)
    steps = sweep._resolutions(method, s, None)
    assert len(steps) == len(usual) and (steps == usual) == (interval == 0.03125)
    for found, largest in ((steps, usual[0]), (sweep._resolutions(method, s, 0.002), 0.002)):
        assert found[0] <= largest < 2 * found[0]
        assert found == [found[0] / 2**k for k in range(len(found))]
        assert interval / found[0] == pytest.approx(round(interval / found[0]), rel=1e-12)
    assert len(sweep._resolutions(method, s, 0.002)) == 4


def test_a_missing_engine_and_a_truth_that_fails_are_rows(tmp_path):
    text = (
        SWEEP_FILE.replace("points: 3", "points: 1").replace("[-1, 1]", "[1]").replace("count: 2", "count: 1")
    )
    spec, cells = loaded(tmp_path, text)
    missing = EngineInfo("mujoco", "MuJoCo", "", (), "mujoco is not installed here: No module")
    _, row = run_sweep(spec, cells, mujoco=missing).to_pylist()
    assert (row["verdict"], row["reason"]) == ("not installed", missing.missing)
    with patch("plumbline.studies.sweep._compute_truths", return_value={0: "crashed"}):
        _, row = run_sweep(spec, cells).to_pylist()
    assert (row["verdict"], row["reason"]) == ("harness failed", "no truth to judge by: crashed")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    table(__file__),
)
def test_mistakes_in_the_file_are_named_with_their_place(tmp_path, old, new, words):
    text = new if old == "FILE" else SWEEP_FILE.replace(old, new)
    with pytest.raises(ScenarioError, match=words):
        loaded(tmp_path, text)


def test_an_integrator_that_the_engine_has_not_is_named_with_its_place(tmp_path):
    path = write_sweep_file(tmp_path, SWEEP_FILE.replace("mujoco: RK4", "mujoco: RK5"))
    spec, _ = sweep_file.load(path)
    engines = {"mujoco": EngineInfo("mujoco", "MuJoCo", "4", load_adapter("mujoco").integrators)}
    with pytest.raises(ScenarioError, match=r":10:19: engines\.mujoco: has no integrator 'RK5'; valid would"):
        sweep_file.check_integrators(path, spec, engines)
    missing = {"mujoco": EngineInfo("mujoco", "MuJoCo", "", (), "not here")}
    sweep_file.check_integrators(path, spec, missing)


def test_a_cell_that_no_step_is_short_enough_for_ends_soon_and_alone(tmp_path):
    vary = "vary: {'gravity[2]': {values: [-9.81, -1.0e20]}}"
    head = "schema_version: 1\nscenario: double-tumbling-balls\n"
    text = f"{head}{vary}\nduration: 0.25\nengines: {{mujoco: RK4}}\n"
    spec, cells = loaded(tmp_path, text)
    done = []
    with limited_time(20):
        rows = run_sweep(spec, cells, progress=lambda *counts: done.append(counts)).to_pylist()
    found = {(row["cell"], row["implementation"]): row for row in rows}
    assert [found[0, name]["verdict"] for name in ("reference", "mujoco")] == ["agrees", "agrees"]
    assert found[1, "reference"]["verdict"] == "failed"
    assert "needs more than 1e+06 steps" in found[1, "reference"]["reason"]
    assert found[1, "mujoco"]["verdict"] == "harness failed"
    assert "the reference failed" in found[1, "mujoco"]["reason"]
    assert [count for count, _, _ in done] == list(range(1, len(done) + 1))
    assert all(count <= total for count, total, _ in done) and done[-1][0] == done[-1][1]
    assert {what for _, _, what in done} == {"reference", "truth", "engines"}


def hang(*_):
    time.sleep(600)


def test_a_reference_that_hangs_is_stopped(tmp_path, monkeypatch):
    """A batch that is over its time is tried cell by cell, each with the same limit."""
    monkeypatch.setattr(sweep, "_run_reference_batch", hang)
    text = SWEEP_FILE.replace("engines: {mujoco: RK4}", "").replace("points: 3", "points: 1")
    spec, cells = loaded(tmp_path, text.replace("count: 2", "count: 1"))
    rows = run_sweep(spec, cells, seconds=1.0).to_pylist()
    assert [(row["verdict"], row["reason"][:23]) for row in rows] == [
        ("failed", "timeout: no answer with")
    ] * 2
