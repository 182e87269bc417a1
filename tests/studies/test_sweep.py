"""Sweeps: what a file makes of a scenario, and how a cell is judged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from plumbline.engines.calls import RefinementStudy, run_refinement
from plumbline.scenario.errors import ScenarioError
from plumbline.studies import sweep

FILE = """\
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


def write(folder: Path, text: str) -> Path:
    path = folder / "sweep.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_grid_and_the_draws(tmp_path: Path) -> None:
    spec, cells = sweep.load(write(tmp_path, FILE))
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
    again = sweep.load(write(tmp_path, FILE))[1]
    assert [cell.values for cell in again] == [cell.values for cell in cells]
    assert [c.values for c in sweep.load(write(tmp_path, FILE.replace("7", "8")))[1]] != [
        c.values for c in cells
    ]


def test_a_sweep_runs_and_is_kept(tmp_path: Path) -> None:
    spec, cells = sweep.load(
        write(tmp_path, FILE.replace("points: 3", "points: 2").replace("[-1, 1]", "[1]"))
    )
    table = sweep.run(spec, cells, jobs=1)
    kept = pq.read_table(sweep.write(table, tmp_path / "out")).to_pylist()
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


def test_values_that_make_no_pendulum_are_a_cell_with_a_reason(tmp_path: Path) -> None:
    vary = "vary: {'bodies[0].mass': {values: [-1, 1]}}"
    text = f"schema_version: 1\nscenario: tumbling-rod\n{vary}\nduration: 0.25\n"
    spec, cells = sweep.load(write(tmp_path, text))
    assert cells[0].scenario is None
    rows = sweep.run(spec, cells).to_pylist()
    assert [row["verdict"] for row in rows] == ["unsupported", "agrees"]
    assert "bodies[0].mass" in rows[0]["reason"]


@pytest.mark.parametrize("mistake", [1e-3, 0.0])
def test_a_mistake_of_the_engine_disagrees(tmp_path: Path, mistake: float) -> None:
    """An engine whose second mass is off by a thousandth; and one that is right."""
    spec, cells = sweep.load(write(tmp_path, FILE))
    cell = cells[0]
    assert cell.scenario is not None
    truth: dict[int, sweep.ReferenceMotion] = {}
    sweep._run_reference_batch([(cell, cell.scenario)], truth)
    scenario = cell.scenario
    wrong = replace(scenario, model=replace(scenario.model, mass=scenario.model.mass * [1, 1 + mistake]))
    found = sweep._run_engine_refinement("mujoco", "RK4", wrong, spec.step)
    assert isinstance(found, RefinementStudy)
    row = sweep._judge_cell(cell, "mujoco", "RK4", found, None, truth[cell.index])
    assert row["verdict"] == ("disagrees" if mistake else "agrees"), row["reason"]


def test_an_engine_too_coarse_to_tell_is_unresolved(tmp_path: Path) -> None:
    cell = sweep.load(write(tmp_path, FILE))[1][0]
    assert cell.scenario is not None
    truth: dict[int, sweep.ReferenceMotion] = {}
    sweep._run_reference_batch([(cell, cell.scenario)], truth)
    s = cell.scenario
    coarse = run_refinement(
        "mujoco",
        "Euler",
        s.model,
        s.state,
        s.times,
        [s.sample_interval, s.sample_interval / 2, s.sample_interval / 4],
    )
    assert (
        sweep._judge_cell(cell, "mujoco", "Euler", coarse, None, truth[cell.index])["verdict"] == "unresolved"
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("points: 3, log: true", "log: true"), r":4:.*bodies\[0\]\.mass: a range needs"),
        (("from: 0.5", "from: -0.5"), r":4:.*log needs"),
        (("bodies[0].mass", "bodies[0].mas"), r":4:.*no number"),
        (("bodies[0].mass", "bodies[7].mass"), r":4:.*no number"),
        (("uniform: [-0.05, 0.05]", "uniform: [0.05, -0.05]"), r":6:.*low ≤ high"),
        (("uniform: [-0.05, 0.05]", "normal: [0, -1]"), r":6:.*standard deviation"),
        (("values: [-1, 1]", "values: [-1, 1], uniform: [0, 1]"), r":5:.*exactly one"),
        (("mujoco: RK4", "mujoco: RK5"), r":10:.*no integrator 'RK5'"),
        (("mujoco: RK4", "mujoko: RK4"), r":10:.*no engine"),
        (("scenario: double", "scenario: duble"), r"unknown scenario"),
        (("seed: 7", "seeds: 7"), r":8:.*seeds"),
        (("points: 3", "points: 90000"), r":4:.*points"),
        (("count: 2", "count: 90000"), r"540000 cells"),
        (("schema_version: 1", "schema_version: 2"), r":1:.*is not 1"),
    ],
)
def test_mistakes_in_the_file_are_named_with_their_place(
    tmp_path: Path, change: tuple[str, str], words: str
) -> None:
    with pytest.raises(ScenarioError, match=words):
        sweep.load(write(tmp_path, FILE.replace(*change)))
