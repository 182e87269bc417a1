"""Scripts of trees, loops and elements: what an engine holds, written out, gives the recorded numbers."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.measurements.state_relations import QUANTITIES
from plumbline.model.datatypes import Unsupported
from plumbline.reproduce.engine_client import EngineClient
from plumbline.reproduce.measure import ConvergenceMeasure, Disagreement, StateMeasure
from plumbline.reproduce.render import render_script
from plumbline.reproduce.shrink import ReproductionCase
from plumbline.reproduce.write import make_script
from plumbline.truth.rounding_bound import EPS
from tests.helpers import ROOT
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.reproduction import (
    DRIFTS,
    check_script,
    defective,
    execute,
    measured_drifts,
    other_answer,
    run_alone,
    script_of,
    state_evidence,
    step_evidence,
    stored_row,
)
from tests.helpers.tables import table

for name in ("mujoco", "pinocchio", "exudyn", "flint"):
    pytest.importorskip(name)

BIASED_PINOCCHIO = """import pinocchio
real = pinocchio.crba
pinocchio.crba = lambda *all: real(*all) * 1.0001
"""
HEAVY_PINOCCHIO = """import pinocchio
real = pinocchio.Inertia
pinocchio.Inertia = lambda mass, *more: real(1.0001 * mass, *more)
"""


def case_of(scenario):
    found = catalogue_scenario(scenario)
    return ReproductionCase(found.model, found.state)


RUFF = Path(sys.executable).parent / "ruff"
THROUGHOUT = [
    (engine, scenario)
    for engine in ("mujoco", "pinocchio", "exudyn")
    for scenario in ("loaded-tree", "four-bar", "sprung-hinge")
]
OTHERS = [
    ("pinocchio-maximal", "loaded-tree"),
    ("pinocchio-maximal", "four-bar"),
    ("exudyn-tree", "sprung-hinge"),
]


@pytest.mark.parametrize(("engine", "scenario"), [*THROUGHOUT, *OTHERS])
def test_a_script_gives_the_recorded_numbers(engine, scenario, tmp_path):
    """On a tree, on a loop and on a mechanism with springs, in a process that has no Plumbline."""
    case = case_of(scenario)
    evidence = StateMeasure(EngineClient(engine), (*QUANTITIES, "mass_matrix"))(case)
    (answer,) = load_adapter(engine).evaluate(case.model, [case.state])
    system = evidence.written(EngineClient(engine))
    recorded = {q: np.asarray(getattr(answer, q), float) for q in evidence.expected}
    script = render_script(stored_row(engine), replace(evidence, expected=recorded), system)
    assert "plumbline" not in script
    found = run_alone(script, tmp_path)
    for options in (["check", "--ignore", "D,E501"], ["format", "--diff"]):
        command = [RUFF, *options, "--no-cache", "--config", ROOT / "pyproject.toml", tmp_path / "script.py"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout
    assert len(found) == len(recorded) - len(system.get("missing", ())) >= 5 and max(found) < 0.1
    other = {q: x * (1 + 1e-7) for q, x in recorded.items()}
    wrong = render_script(stored_row(engine), replace(evidence, expected=other), system)
    assert max(run_alone(wrong, tmp_path)) > 1


@pytest.mark.parametrize("lines", [BIASED_PINOCCHIO, HEAVY_PINOCCHIO], ids=["solution", "masses"])
def test_a_defect_is_shown_by_the_script_of_a_smaller_tree(lines, tmp_path):
    case = case_of("loaded-tree")
    found = Disagreement(EngineClient("pinocchio"), "state", ("acceleration",), "-", case, 50.0, 2.0)
    with defective(lines):
        script, reason = make_script(found, stored_row("pinocchio", level="state"))
    assert script, reason
    assert script.count("model.addJoint(") < len(case.model.kind)
    assert max(run_alone(script, tmp_path, before=lines)) > 1
    assert max(run_alone(script, tmp_path)) < 1


def test_what_a_script_cannot_show_is_a_sentence():
    case, row = case_of("hand-on-welds"), stored_row("pinocchio")
    evidence = StateMeasure(EngineClient("pinocchio"), ("joint_reaction",))(case)
    with pytest.raises(Unsupported, match="merges at a weld"):
        render_script(row, evidence, evidence.written(EngineClient("pinocchio")))
    with pytest.raises(Unsupported, match="writes no mechanisms"):
        EngineClient("reference").write(case.model, case.state)
    case = replace(case_of("sprung-hinge"), until=1.0, steps=(2.0**-6, 2.0**-7, 2.0**-8))
    drift = ConvergenceMeasure(EngineClient("mujoco"), "RK4", "invariants", ("energy_drift",))(case)
    with pytest.raises(Unsupported, match="energy of rotors"):
        script_of(drift)


# every integrator, on trees, loops and mechanisms with springs
MOTIONS = table(__file__)


@pytest.mark.parametrize(("engine", "integrator", "scenario"), MOTIONS)
def test_a_script_of_runs_gives_the_recorded_motion(engine, integrator, scenario):
    """Of trees, loops and mechanisms with springs; the error over its bound is that of the harness."""
    steps = tuple(2.0**-k for k in (6, 7, 8))
    measure = ConvergenceMeasure(EngineClient(engine), integrator, "trajectory", ("order", "position_limit"))
    case = replace(case_of(scenario), until=0.0625, steps=steps)
    found, names = execute(script_of(measure(case)))
    assert len(found) == 5
    _, runs = measure.run(case, measure.sample_times(case))
    for run, mine in zip(runs, names["runs"], strict=True):
        for name, values in zip(("r", "p", "v"), mine, strict=False):
            own = getattr(run.trajectory, name)
            off = (
                np.abs(values - own)
                if name != "p"
                else np.minimum(np.abs(values - own), np.abs(values + own))
            )
            assert np.max(off) < 1e-10, (name, run.resolution)


@pytest.mark.parametrize(
    ("engine", "integrator", "scenario"),
    [
        ("mujoco", "RK4", "loaded-tree"),
        ("pinocchio", "rkmk4", "four-bar"),
        ("exudyn-tree", "RK44", "sprung-hinge"),
    ],
)
def test_a_script_of_a_step_finds_what_the_harness_finds(engine, integrator, scenario):
    evidence = step_evidence(engine, integrator, case_of(scenario), 2, 0.01)
    assert evidence.ratio < 1 and len(check_script(evidence, 1 + 1e-9)) == 4


@pytest.mark.parametrize(
    ("engine", "relation", "scenario"),
    [
        ("mujoco", "by dense mass matrix", "four-bar"),
        ("mujoco", "by joint equalities", "sprung-hinge"),
        ("mujoco", "two welded halves", "loaded-tree"),
        ("pinocchio", "by cholesky", "loaded-tree"),
        ("pinocchio", "two welded halves", "sprung-hinge"),
        ("pinocchio", "as pinocchio-maximal", "four-bar"),
    ],
)
def test_a_script_calls_the_engine_in_its_second_way(engine, relation, scenario):
    evidence = other_answer(engine, relation, case_of(scenario))
    script, usual = script_of(evidence), script_of(state_evidence(engine, evidence.case))
    assert script.split("found, why")[0] != usual.split("found, why")[0]
    assert max(execute(script)[0]) < 1


@pytest.mark.parametrize("scenario", ["tree-of-seven", "four-bar"])
def test_a_script_measures_drifts_as_the_harness_does(scenario):
    steps = tuple(2.0**-k for k in (6, 7, 8))
    case = replace(case_of(scenario), until=1.0, steps=steps)
    measure = ConvergenceMeasure(EngineClient("exudyn"), "trapezoidal", "invariants", DRIFTS)
    evidence, names, drifts = measured_drifts(measure, case)
    compared = {"joint_gap", "gap_rate", "norm_drift"}
    assert compared <= {*evidence.drifts}
    for quantity in compared:
        harness = getattr(drifts[-1], quantity)[-1]
        own = names[quantity](*names["runs"][-1])
        # differences of positions and velocities of about 1 m and 1 m/s, rounded some times
        np.testing.assert_allclose(own, harness, rtol=0, atol=64 * EPS)
