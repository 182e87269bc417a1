"""Scripts call an engine as its adapter does, run with the engine and NumPy alone, and pass ruff."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plumbline.engines.registry import ENGINES as REGISTERED
from plumbline.measurements.state_relations import STATE_RELATIONS
from plumbline.reproduce.engine_client import EngineClient
from plumbline.reproduce.measure import StateMeasure
from plumbline.reproduce.render import TEMPLATES, no_script_reason
from tests.helpers import ROOT
from tests.helpers.reproduction import (
    ALL_QUANTITIES,
    ENGINES,
    HOSTILE,
    check_script,
    defective,
    every_evidence,
    execute,
    measured_drifts,
    motion_measure,
    other_answer,
    relation_evidence,
    run_alone,
    script_of,
    second_ways,
    state_case,
    state_evidence,
    step_evidence,
    step_methods,
)
from tests.helpers.tables import table

for name in ("mujoco", "pinocchio", "exudyn", "flint"):
    pytest.importorskip(name)

STEPS = [(engine, name) for engine in ENGINES for name in step_methods(engine)]
WAYS = [(engine, name) for engine in ENGINES for name in second_ways(engine)]


@pytest.mark.parametrize("engine", ENGINES)
def test_every_template_renders_to_what_ruff_accepts(engine, tmp_path):
    """Every kind of script, with rods, loads and drag and without; also for the engine's old versions."""
    scripts = []
    for joints, loaded in (("rod-ball", True), ("ball", False)):
        for evidence in every_evidence(engine, joints, loaded):
            scripts += [script_of(evidence, engine_version=version) for version in ("1.0", "99")]
    assert len(scripts) >= 8
    for i, script in enumerate(scripts):
        (tmp_path / f"{i}.py").write_text(script, encoding="utf-8")
    ruff = [Path(sys.executable).parent / "ruff"]
    for command in (
        ["check", "--ignore", "D,E501"],  # the engine's own descriptions have long lines
        ["format", "--diff"],
    ):  # of docstrings the functions need none
        config = ["--no-cache", "--config", ROOT / "pyproject.toml", tmp_path]
        done = subprocess.run([*ruff, *command, *config], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout
    assert "plumbline" not in "".join(scripts)


def test_every_template_is_used():
    frame = {"script", "state", "step", "motion", "invariants", "exudyn-common", "model-file", "surface"}
    names = {path.name.removesuffix(".py.j2") for path in TEMPLATES.iterdir()} - frame
    assert names == {
        name for name in REGISTERED if not no_script_reason(name, {"level": "state", "quantity": "energy"})
    } - {"pinocchio-aba"}


# --- a script calls the engine as the adapter does: it has no mistake of its own -----------------------


@pytest.mark.parametrize(
    ("engine", "joints"), [("pinocchio-maximal", "balls"), *((name, "rod-ball") for name in ENGINES)]
)
def test_a_script_of_a_state_calls_the_engine_as_the_adapter_does(engine, joints):
    evidence = state_evidence(engine, state_case(joints, loads=True, drag=True))
    found, _ = execute(script_of(evidence))
    assert len(found) >= 6 and max(found) < 1, found


@pytest.mark.parametrize("joints", ["rod-ball", "ball-rod", "rods"])
def test_a_script_of_tendons_in_place_of_rods_finds_what_the_harness_finds(joints):
    """In motion MuJoCo's tendons are off, at rest they are not."""
    case = state_case(joints, loads=True, drag=True)
    names = ("omega", "udot", "v")
    at_rest = replace(case.state, **{name: 0 * getattr(case.state, name) for name in names})
    evidence = other_answer("mujoco", "by tendon equalities", case)
    found, _ = execute(script_of(evidence))
    assert max(found) == pytest.approx(evidence.ratio, rel=1e-2) and evidence.ratio > 1e10
    evidence = other_answer("mujoco", "by tendon equalities", replace(case, state=at_rest))
    assert max(execute(script_of(evidence))[0]) < 1


@pytest.mark.parametrize(("engine", "integrator"), STEPS)
def test_a_script_of_steps_finds_what_the_harness_finds(engine, integrator):
    evidence = step_evidence(engine, integrator, state_case("rod-ball", loads=True, drag=True), 5, 0.01)
    assert evidence.ratio < 1 and len(check_script(evidence, 1 + 1e-9)) == 4


@pytest.mark.parametrize(
    ("engine", "integrator", "loaded", "count"),
    [("exudyn", "trapezoidal", False, 5), ("pinocchio", "rkmk4", True, 4)],
)
def test_a_script_measures_drifts_as_the_harness_does(engine, integrator, loaded, count):
    """Momentum is not conserved under loads; the work of moments and drag is integrated without SciPy."""
    measure, case = motion_measure(engine, integrator, "invariants", "rod-ball", loaded, 1.0)
    evidence, names, drifts = measured_drifts(measure, case)
    assert len(evidence.drifts) == count
    for quantity in evidence.drifts:
        apart = []
        for run, drift in zip(names["runs"][-2:], drifts[-2:], strict=True):
            harness = np.max(np.linalg.norm(getattr(drift, quantity)[-1], axis=-1))
            script = np.max(np.linalg.norm(np.atleast_1d(names[quantity](*run)), axis=-1))
            apart.append(abs(script - harness))
        # The harness integrates the work over polynomials through positions and rates, the script over rates:
        # of steps of order q they differ by O(h^q) too, which falls by 2^(q - 1) or more, and by quadrature.
        work = quantity == "energy_drift" and loaded
        by_work = max(
            2 * drifts[-1].uncertainty["energy_drift"], apart[0] / 2 ** (measure.integrator.order - 1)
        )
        assert apart[1] <= 0.01 * harness + 1e-13 + work * by_work, quantity


@pytest.mark.parametrize("relation", [r.name for r in STATE_RELATIONS])
def test_a_script_of_a_relation_shows_the_other_description(relation, engine="pinocchio"):
    case = state_case("rod-ball", loads=True, drag=True)
    assert relation_evidence(engine, relation, case).ratio < 1
    evidence = other_answer(engine, relation, case)
    assert evidence.case.content != case.content and len(check_script(evidence, 1.001)) == 6


@pytest.mark.parametrize(("engine", "relation"), WAYS)
def test_a_script_calls_the_engine_in_its_second_way(engine, relation):
    case = state_case("rod-ball", loads=True, drag=True)
    assert relation_evidence(engine, relation, case).ratio < 1
    evidence = other_answer(engine, relation, case)
    check_script(evidence, 1.001)
    scripts = [script_of(x) for x in (evidence, state_evidence(engine, case))]
    calls = [text.split("found, why")[0].split("\ndef ", 1)[1] for text in scripts]
    assert calls[0] != calls[1], "the second way is the usual one"


@pytest.mark.parametrize(("function", "variant"), [("aba", ""), ("crba", "by crba")])
def test_of_two_answers_the_one_that_is_off_is_shown(function, variant):
    change = f"real = pinocchio.{function}\npinocchio.{function} = lambda *all: 1.001 * real(*all)"
    case = state_case("balls", rate=1.0)
    with defective(f"import pinocchio\n{change}"):
        evidence = relation_evidence("pinocchio-aba", "by crba", case)
        found, _ = execute(script_of(evidence))
    assert (evidence.variant, evidence.relation) == (variant, "by crba") and max(found) > 1
    assert max(execute(script_of(evidence))[0]) < 1


def test_another_environment_is_called_and_runs_the_script():
    """This interpreter stands for that of another version: the way there and back is the same."""
    case = state_case("ball")
    there = StateMeasure(EngineClient("mujoco", sys.executable), ALL_QUANTITIES)(case)
    assert there.ratio == state_evidence("mujoco", case).ratio
    script = script_of(there)
    printed = EngineClient("mujoco", sys.executable).run_script(script)
    assert printed == EngineClient("mujoco").run_script(script)
    assert printed.count("\n  off by ") == len(ALL_QUANTITIES) and printed.startswith("MuJoCo 4")


# --- texts ------------------------------------------------------------------------------------------------


def test_literals_are_exact_and_hostile_names_stay_text(tmp_path):
    case = state_case("ball")
    state = state_evidence("mujoco", case)
    relation = replace(relation_evidence("mujoco", "masses doubled", case), relation=HOSTILE)
    measure, study = motion_measure("mujoco", "RK4", "trajectory", "ball", False, 0.25)
    for evidence in (state, relation, measure(study)):
        script = script_of(evidence, engine_version=HOSTILE)
        head = re.split(r"^from ", script, flags=re.M)[0]
        assert all(line.startswith("#") or not line for line in head.splitlines())
        assert "os.abort" in head
        _, names = execute(script)
        np.testing.assert_array_equal(names["c"].link_force, evidence.case.model.force)
    run_alone(script_of(state, engine_version=HOSTILE), tmp_path)


@pytest.mark.parametrize(
    ("engine", "level", "quantity", "integrator", "words"),
    table(__file__),
)
def test_what_has_no_script_is_explained_in_a_sentence(engine, level, quantity, integrator, words):
    row = {"level": level, "quantity": quantity, "integrator": integrator}
    reported = no_script_reason(engine, row)
    assert words in reported and bool(words) == bool(reported)
