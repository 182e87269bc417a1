"""Loops that cannot move: `check` names them, sampled rates are exactly 0, and no engine disagrees."""

from pathlib import Path

import numpy as np
import pytest

from plumbline.engines.engine_calls import evaluate_states
from plumbline.execution.exit_codes import ExitCode
from plumbline.judging.rows import RowContext
from plumbline.judging.state_level import judge_states
from plumbline.model.loops import immovable_joints
from plumbline.scenario.loader import find_scenario_file, load_scenario_text
from plumbline.storage.results_store import read_results
from plumbline.truth.certified_state import certify_state
from plumbline.truth.ground_truth import state_truth
from tests.helpers.catalogue import catalogue_scenario, states_of
from tests.helpers.commands import invoke
from tests.helpers.nightly_tests import slow

TRUSS = """\
schema_version: 1
family: own
title: Two bars and the ground, a triangle
purpose: A loop that cannot move.
bodies:
  - {name: left, mass: 1, inertia: {principal: [0.01, 0.02, 0.015]}, joint: {kind: hinge, axis: [0, 1, 0]},
     proximal: [-0.5, 0, 0], distal: [0.5, 0, 0]}
  - {name: right, mass: 2, inertia: {principal: [0.01, 0.02, 0.015]}, joint: {kind: hinge, axis: [0, 1, 0]},
     proximal: [0, 0, -0.5], distal: [0, 0, 0.5]}
closes:
  - {body: right, parent: world, anchor: [1, 0, 1], proximal: [0, 0, 0.5],
     joint: {kind: hinge, axis: [0, 1, 0]}}
"""
BOB = """\
  - {name: bob, parent: PARENT, anchor: [0.1, 0, 0.2], mass: 0.5, inertia: {principal: [0.01, 0.02, 0.015]},
     joint: {kind: ball}, proximal: [0, 0.1, 0.3], attitude: {axis_angle: {axis: [1, 2, 0], angle: 0.4}}}
closes:
"""
CARTS = """\
schema_version: 1
family: own
title: Two carts on one rail, coupled by a hinge
purpose: The sprung hinge between them never turns.
gravity: [0, 0, 0]
bodies:
  - {name: cart, mass: 1, inertia: {principal: [0.01, 0.02, 0.015]}, proximal: [0, 0, 0],
     joint: {kind: slide, axis: [1, 0, 0], rates: [1.0]}}
  - {name: wagon, parent: world, anchor: [0.5, 0, 0], mass: 2, inertia: {principal: [0.01, 0.02, 0.015]},
     joint: {kind: slide, axis: [1, 0, 0]}, proximal: [0, 0, 0]}
closes:
  - {body: wagon, parent: cart, anchor: [0.5, 0.1, 0], proximal: [0, 0.1, 0],
     joint: {kind: hinge, axis: [0, 1, 0], stiffness: [200]}}
"""


def held_bricard():
    """Bricard's linkage with its closing hinge replaced by a slide."""
    head, end = find_scenario_file("bricard").read_text(encoding="utf-8").split("closes:")
    return head.replace("family: loop", "family: own") + "closes:" + end.replace("hinge", "slide")


TEXTS = {
    "truss": TRUSS,
    "bricard held": held_bricard(),
    "bob on truss": TRUSS.replace("closes:\n", BOB.replace("PARENT", "right")),
    "bob beside truss": TRUSS.replace("closes:\n", BOB.replace("PARENT", "world")),
    "carts": CARTS,
}
FLAT = TRUSS.replace("[0, 0, -0.5], distal: [0, 0, 0.5]", "[-0.5, 0, 0], distal: [0.5, 0, 0]").replace(
    "anchor: [1, 0, 1], proximal: [0, 0, 0.5]", "anchor: [2, 0, 0], proximal: [0.5, 0, 0]"
)
STILL = {"truss": [0, 1, 2], "bricard held": list(range(6)), "carts": [2]}


@pytest.mark.parametrize("name", TEXTS)
def test_joints_that_cannot_move_are_found_and_have_rates_of_zero(name):
    s = load_scenario_text(TEXTS[name])
    still = STILL.get(name, [0, 1, 3])
    assert immovable_joints(s.model, s.state) == still
    states = states_of(s, 5)
    held = [k for k in still if k < s.model.n]
    assert len(states) == 6
    for state in states:
        for rates in (state.xdot, state.omega, state.v):
            assert not np.any(rates[held])
        assert np.any(state.v) == (len(held) < s.model.n and bool(np.any(state.omega) or name == "carts"))
    moving = [k for k in range(s.model.n) if k not in held]
    assert all(np.any(states[-1].v[k]) for k in moving)


@pytest.mark.parametrize("name", ["bricard", "four-bar", "slider-crank", "squeezer", "four-bars-2-flat"])
def test_dead_points_and_dependent_rows_hold_no_joint(name):
    s = catalogue_scenario(name)
    assert immovable_joints(s.model, s.state) == []


@pytest.mark.parametrize("engine", ["reference", "mujoco", "pinocchio"])
@pytest.mark.parametrize("name", ["truss", "bricard held", "bob on truss"])
def test_engines_agree_on_mechanisms_that_cannot_move(name, engine):
    s = load_scenario_text(TEXTS[name])
    states = states_of(s, 3)
    truth, answer = state_truth(s.model, states), evaluate_states(engine, s.model, states, ["surface"])
    rows = judge_states(RowContext(name, "own", engine, engine, "1"), truth, answer).rows
    assert {row.verdict for row in rows if row.level == "surface"} <= {"agrees"}
    assert [row.verdict for row in rows if row.level == "state"] == ["agrees"] * 7


def test_rates_that_almost_fit_are_set_to_zero_and_others_are_refused():
    given = TRUSS.replace("axis: [0, 1, 0]}", "axis: [0, 1, 0], rates: [1.0e-12]}", 1)
    assert not np.any(load_scenario_text(given).state.xdot)
    with pytest.raises(Exception, match="opens: rates differ by"):
        load_scenario_text(given.replace("1.0e-12", "0.5"))


def test_a_spring_that_is_unloaded_up_to_rounding_has_an_energy():
    """The hinge's angle is 0 in theory: a ball that contains 0, whose square must not be NaN."""
    s = load_scenario_text(CARTS)
    found = certify_state(s.model, s.state)
    assert found.quantities.potential_energy == pytest.approx(0, abs=1e-30)
    assert found.quantities.kinetic_energy == 1.5


def test_check_names_what_cannot_move(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("truss", "bob on truss"):
        Path(f"{name}.yaml").write_text(TEXTS[name])
    done = invoke("check", "truss.yaml", "bob on truss.yaml", code=0)
    first, second = done.output.splitlines()
    assert first.endswith("; the mechanism cannot move: its loops hold every joint")
    assert second.endswith("; the loops hold these joints, which cannot move: left, right, closes[0]")


def test_a_truss_with_its_bars_in_one_line_cannot_be_compared(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("flat.yaml").write_text(FLAT)
    done = invoke("check", "flat.yaml", find_scenario_file("four-bars-2-flat"))
    flat, dead_point = done.output.splitlines()
    assert "; nothing can be compared: every pose that the loops allow is singular" in flat
    assert "; at t = 0 the pose is singular, as at a dead point: states at other poses are" in dead_point


@slow
def test_a_truss_with_its_bars_in_one_line_is_not_compared(tmp_path, monkeypatch):
    """Its rows allow a rate, but no motion: neither a false "harness failed", nor green."""
    monkeypatch.chdir(tmp_path)
    Path("flat.yaml").write_text(FLAT)
    words = ["run", "flat.yaml", "--engine", "mujoco", "--jobs", "1", "--out", "out"]
    ran = invoke(*words, code=ExitCode.DISAGREEMENT)
    assert "0 independent checks: 4 are information, nothing was compared" in ran.output
    rows = read_results(Path("out"))["rows"]
    assert {row["level"] for row in rows} == {"state", "step", "trajectory", "relations"}
    assert all("every pose that the loops allow is singular" in row["reason"] for row in rows)
