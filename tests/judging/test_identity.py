"""Two columns of a run that are one computation under two names are reported; independent ones never are."""

from dataclasses import replace

import numpy as np
import pytest

import reports
from plumbline.engines.adapter import EngineInfo
from plumbline.engines.registry import load_adapter
from plumbline.execution import runner
from plumbline.execution.plan import Plan
from plumbline.execution.result_cache import DiskResultCache
from plumbline.judging.identity import (
    MIN_SCENARIOS,
    RUN_SCENARIO,
    IdentityCheck,
    run_fingerprints,
    state_fingerprints,
)
from plumbline.model.datatypes import Integrator
from plumbline.processes.worker_pool import Limits
from plumbline.storage.results_store import read_results
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario

pytest.importorskip("mujoco")

TIMES = np.linspace(0, 0.25, 5)
EULER, FAST, IMPLICIT = (
    Integrator("Euler", "step", 1),
    Integrator("fast", "step", 1, alias_of="Euler"),
    Integrator("implicit", "step", 1),
)


def info(name, *integrators):
    return EngineInfo(name, name.title(), "1.0", integrators)


def checked(engines, *scenarios):
    check = IdentityCheck({one.name: one for one in engines})
    for fingerprints in scenarios:
        check.add_scenario(fingerprints)
    return check


def of_run(integrator, bits, *resolutions):
    return {(integrator, "run", str(resolution)): bits for resolution in resolutions}


def scenarios(make, count=MIN_SCENARIOS):
    return [make(str(k).encode()) for k in range(count)]


def test_equal_bits_on_every_scenario_are_reported_once_there_are_enough():
    engine = info("engine", EULER, IMPLICIT)

    def same(bits):
        return {"engine": of_run("Euler", bits, 1, 2) | of_run("implicit", bits, 2, 3)}

    (row,) = checked([engine], *scenarios(same)).rows()
    assert (row.engine, row.level, row.integrator) == ("engine", "relations", "implicit")
    assert (row.scenario, row.quantity, row.verdict) == (
        RUN_SCENARIO, "identity with engine Euler", "disagrees",
    )  # fmt: skip
    assert "with implicit equals that of Engine with Euler bit for bit on all 3 generic" in row.reason
    assert checked([engine], *scenarios(same, MIN_SCENARIOS - 1)).rows() == []
    differing = {"engine": of_run("Euler", b"a", 2) | of_run("implicit", b"b", 2)}
    assert checked([engine], *scenarios(same), differing).rows() == []
    one_step = {
        "engine": of_run("Euler", b"a", 1, 2) | of_run("implicit", b"a", 1) | of_run("implicit", b"b", 2)
    }
    assert checked([engine], *scenarios(same), one_step).rows() == [], "one step size that differs is enough"
    apart = {"engine": of_run("Euler", b"a", 1) | of_run("implicit", b"a", 2)}
    assert checked([engine], *[apart] * 5).rows() == [], "no step size in common"


def test_declared_aliases_and_versions_of_one_engine_may_be_equal():
    def same(bits):
        return {"engine": of_run("Euler", bits, 1) | of_run("fast", bits, 1)}

    check = checked([info("engine", EULER, FAST)], *scenarios(same))
    assert check.rows() == [] and check.summary() == {"scenarios": 3, "pairs": 0}

    def versions(bits):
        return {name: {("-", "acceleration", ""): bits} for name in ("engine", "engine@3.12.0")}

    assert checked([info("engine"), info("engine@3.12.0")], *scenarios(versions)).rows() == []


def test_two_engines_with_equal_answers_are_reported_by_quantity():
    def same(bits):
        return {
            "one": {("-", "acceleration", ""): bits, ("-", "joint_reaction", ""): bits},
            "two": {("-", "acceleration", ""): bits + b"!", ("-", "joint_reaction", ""): bits},
        }

    check = checked([info("one"), info("two")], *scenarios(same))
    (row,) = check.rows()
    assert row.engine == "two" and row.quantity == "identity with one"
    assert "the joint reaction of Two equals that of One bit for bit" in row.reason
    assert check.summary() == {"scenarios": 3, "pairs": 2}


def test_fingerprints_are_of_bits():
    model = pendulums.make_model("br")
    states = [pendulums.state_from_seed(model, seed=k) for k in range(2)]
    answers = load_adapter("mujoco").evaluate(model, states)
    found = state_fingerprints(answers)
    assert set(found) == {("-", q, "") for q in ("acceleration", "angular_acceleration", "joint_reaction")}
    up = [answers[0], replace(answers[1], acceleration=np.nextafter(answers[1].acceleration, np.inf))]
    changed = state_fingerprints(up)
    assert [key[1] for key in found if found[key] != changed[key]] == ["acceleration"]
    less = state_fingerprints([replace(a, joint_reaction=None) for a in answers])
    assert ("-", "joint_reaction", "") not in less


@pytest.mark.parametrize("is_euler", [True, False])
def test_an_implicit_integrator_that_calls_euler_is_reported(is_euler):
    class Planted(type(load_adapter("mujoco"))):
        def _simulate(self, model, state, times, integrator, resolution):
            called = self.integrator("Euler") if is_euler and integrator.name == "implicit" else integrator
            return super()._simulate(model, state, times, called, resolution)

    engine, check = Planted(), IdentityCheck({"mujoco": load_adapter("mujoco").describe()})
    for seed in range(MIN_SCENARIOS):
        model = pendulums.make_model("br", seed=seed)
        state = pendulums.state_from_seed(model, seed=seed)
        found = {}
        for integrator in engine.integrators:
            runs = {h: engine.simulate(model, state, TIMES, integrator.name, h) for h in (2.0**-9, 2.0**-10)}
            found |= run_fingerprints(integrator.name, runs)
        check.add_scenario({"mujoco": found})
    assert [(row.integrator, row.quantity) for row in check.rows()] == (
        [("implicit", "identity with mujoco Euler"), ("implicitfast", "identity with mujoco implicit")]
        if is_euler
        else []
    )


def test_a_run_reports_an_alias_that_is_not_declared(monkeypatch, tmp_path):
    describe = runner.describe_engines

    def undeclared(*arguments, **options):
        return {
            name: replace(one, integrators=tuple(replace(i, alias_of=None) for i in one.integrators))
            for name, one in describe(*arguments, **options).items()
        }

    names = ("rest", "planar-small", "tumbling-ball", "tumbling-rod", "on-axis-rod")
    chosen = [catalogue_scenario(name) for name in names]
    cells = DiskResultCache(tmp_path / "cells")
    plan = Plan(chosen, ["mujoco"], "trajectory", limits=Limits(120), result_cache=cells)
    declared = runner.run_plan(plan, lambda *_: None)
    assert declared.metadata["exit_code"] == 0 and declared.metadata["identity"]["scenarios"] == 3
    assert RUN_SCENARIO not in declared.scenarios
    monkeypatch.setattr(runner, "describe_engines", undeclared)
    result = runner.run_plan(plan, lambda *_: None)
    (row,) = [row for row in result.rows if row.verdict.needs_attention]
    assert (row.scenario, row.integrator, row.quantity) == (
        RUN_SCENARIO, "implicitfast", "identity with mujoco Euler",
    )  # fmt: skip
    assert (
        result.metadata["exit_code"] == 1
        and "1 disagrees (mujoco-identity-with-mujoco-euler-of-implicitfast" in result.metadata["sentence"]
    )
    runner.save(result, tmp_path / "out", "test")
    page = reports.write(tmp_path / "out").read_text()
    assert "implicitfast equals that of MuJoCo with Euler bit for bit" in page
    assert read_results(tmp_path / "out")["scenarios"][RUN_SCENARIO]["family"] == "run"
