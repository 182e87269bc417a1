"""Scripts of mechanisms that are no chains: what an engine holds, written out, gives the recorded numbers."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plumbline.engines.engine_calls import write_mechanism
from plumbline.engines.registry import load_adapter
from plumbline.measurements.state_relations import QUANTITIES
from plumbline.model.datatypes import Unsupported
from plumbline.reproduce.engine_client import EngineClient
from plumbline.reproduce.measure import Disagreement, StateMeasure
from plumbline.reproduce.render import render_script
from plumbline.reproduce.shrink import ReproductionCase
from plumbline.reproduce.write import make_script
from tests.helpers.catalogue import catalogue_scenarios
from tests.helpers.reproduction import defective, run_alone, stored_row

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
    found = catalogue_scenarios()[scenario]
    return ReproductionCase(found.model, found.state)


ROOT, RUFF = Path(__file__).resolve().parents[2], Path(sys.executable).parent / "ruff"
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
    system = write_mechanism(engine, case.model, case.state)
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
        render_script(row, evidence, write_mechanism("pinocchio", case.model, case.state))
    with pytest.raises(Unsupported, match="writes no mechanisms"):
        write_mechanism("reference", case.model, case.state)
