"""The drift table: what is measured, what is left out for its cost, and what the report shows of it."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from plumbline.model.kinematics import maximal_coordinates
from plumbline.scenario import loader as scenarios
from plumbline.storage.results_store import DRIFT_TABLE
from plumbline.studies import drift
from plumbline.studies.drift import VARIANTS, drift_errors
from reference_impl.euler_parameters import angular_velocity
from reference_impl.fast.collocation import integrate_collocation
from reference_impl.joints import constraint_rows
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.commands import invoke
from tests.helpers.random_chains import random_chain


def measure_drift(names, longest, **options):
    found: list[dict[str, Any]] = drift.measure_drift(
        scenarios.load_scenarios(names), longest, rtols=(1e-6,), **options
    ).to_pylist()
    return found


def test_every_variant_and_time_has_a_row_and_the_drift_is_the_raw_one(tmp_path):
    reported: list[str] = []
    rows = measure_drift(["tumbling-ball"], 60, times=(1.0, 10.0), log=reported.append)
    assert [(row["variant"], row["time"]) for row in rows] == [(v, t) for v in VARIANTS for t in (1.0, 10.0)]
    late = {row["variant"]: row for row in rows if row["time"] == 10.0}
    assert late["raw"]["gap"] > 10 * late["baumgarte"]["gap"] > 1e-11
    assert late["projected"]["gap"] < 1e-14
    assert all(0 < row["energy"] < 1e-5 and row["cpu_seconds"] > 0 and not row["reason"] for row in rows)
    assert len(reported) == len(VARIANTS)
    assert all("to 10 s, about" in sentence for sentence in reported)


def test_a_time_that_costs_too_much_is_left_out_with_a_reason():
    rows = measure_drift(["tumbling-ball"], 0.001, times=(1.0, 10.0))
    for first, second in zip(rows[::2], rows[1::2], strict=True):
        assert first["gap"] is not None
        assert first["reason"] == ""
        assert second["gap"] is None
        assert "left out: would cost" in second["reason"]


def test_a_run_that_fails_is_a_row_with_its_reason():
    s = catalogue_scenario("tumbling-ball")
    massless = replace(s, model=replace(s.model, mass=np.zeros(1)))
    rows = drift.measure_drift([massless], 60, times=(1.0, 10.0), rtols=(1e-6,)).to_pylist()
    assert len(rows) == 2 * len(VARIANTS)
    assert all(row["gap"] is None and "failed: the mass of body 1" in row["reason"] for row in rows)


def test_the_command_writes_the_table(tmp_path, monkeypatch):
    quick = functools.partial(drift.measure_drift, times=(0.5, 1.0))
    monkeypatch.setattr(drift, "measure_drift", quick)
    ran = invoke("drift", "tumbling-rod", "--rtol", "1e-6", "--out", tmp_path, code=0)
    kept = pq.read_table(tmp_path / "drift.parquet")
    assert kept.schema.names == DRIFT_TABLE.names
    assert {(row["time"], row["rtol"]) for row in kept.to_pylist()} == {(0.5, 1e-6), (1.0, 1e-6)}
    assert "baumgarte" in ran.output
    assert invoke("drift", "no-such-thing", "--out", tmp_path).exit_code == 2


def start_of(rng, rods, **options):
    """A random chain and its initial state as the integration takes it."""
    model, state = random_chain(rng, rods, **options)
    return model, maximal_coordinates(state)


def table_of(model, state, **options):
    """The drift table of a chain that is no scenario of the catalogue."""
    s = catalogue_scenario("tumbling-ball")
    return drift.measure_drift([replace(s, model=model, state=state)], 1e4, **options).to_pylist()


def test_raw_drifts_and_the_others_do_not():
    table = table_of(*random_chain(62, [False]), rtols=(1e-6,), times=(3.0, 30.0))
    held = {(row["variant"], row["time"]): row for row in table}
    assert held["raw", 30.0]["gap"] > 3 * held["raw", 3.0]["gap"]
    assert held["baumgarte", 30.0]["gap"] < 0.05 * held["raw", 30.0]["gap"]
    assert held["projected", 30.0]["gap"] < 1e-14
    assert held["projected", 30.0]["norm"] < 1e-15
    assert held["projected", 30.0]["energy"] < 0.05 * held["raw", 30.0]["energy"]


@pytest.mark.full
def test_energy_over_a_thousand_seconds():
    model, start = start_of(64, [False])
    times = np.linspace(0, 1000, 41)
    errors = drift_errors(model, integrate_collocation([model], *start, times, 1e-13, project=True))
    assert np.max(errors["energy"]) <= 1e-12
    assert np.max(errors["gap"]) < 1e-14


@pytest.mark.parametrize("rods", [[True, False, True], [False], [True]], ids=str)
def test_constraint_errors_are_metres_and_metres_a_second(rods):
    """A rod's stretch and its rate, a ball's distance and speed, each the worst of its state, from `rows`."""
    rng = np.random.default_rng(65)
    one, state = random_chain(rng, rods)
    n, times = one.n, np.linspace(0, 0.1, 3)
    motion = integrate_collocation([one], *maximal_coordinates(state), times, 1e-6)
    moved = replace(
        motion,
        r=motion.r + 0.02 * rng.normal(size=(3, n, 3)),
        v=motion.v + 0.3 * rng.normal(size=(3, n, 3)),
    )
    found = drift_errors(one, moved)
    for t in range(3):
        joints = constraint_rows(one, moved.r[t], moved.p[t], moved.v[t], moved.pdot[t])
        rates = joints.constraint_rate(moved.v[t], moved.pdot[t])
        gaps, speeds = [], []
        for k in range(n):
            distance = np.linalg.norm(joints.d[k])
            gaps.append(abs(distance - one.length[k]))
            speed = rates[joints.joint == k]
            speeds.append(abs(speed[0]) / (2 * distance) if rods[k] else np.linalg.norm(speed))
        assert found["gap"][t] == pytest.approx(max(gaps), abs=1e-6)
        assert found["gap_rate"][t] == pytest.approx(max(speeds), rel=1e-4)
        assert found["norm"][t] == pytest.approx(
            np.max(np.abs(np.linalg.norm(moved.p[t], axis=1) - 1)), abs=1e-15
        )
    still = drift_errors(one, replace(motion, p=1.5 * motion.p))
    assert still["norm"] == pytest.approx(np.full(3, 0.5), abs=1e-6)


def test_energy_is_over_the_weight_and_reach_of_the_stretched_chain():
    model, start = start_of(66, [True, False, True])
    motion = integrate_collocation([model], *start, np.linspace(0, 0.1, 3), 1e-12, project=True)

    def energy_error(chain, run):
        return drift_errors(chain, run)["energy"]

    near, far = np.linalg.norm(model.proximal, axis=1), np.linalg.norm(model.distal, axis=1)
    hang = [model.length[0] + near[0], 0.0, 0.0]
    hang[1] = hang[0] + far[0] + near[1]
    hang[2] = hang[1] + far[1] + model.length[2] + near[2]
    scale = 9.81 * float(np.sum(model.mass * hang))
    assert np.max(energy_error(model, motion)) < 1e-11
    lifted = replace(motion, r=motion.r + np.array([0.0, 0.5, 1.0])[:, None, None] * [0, 0, 1.0])
    raised = 9.81 * float(np.sum(model.mass)) * np.array([0, 0.5, 1]) / scale
    assert energy_error(model, lifted) == pytest.approx(raised, abs=1e-10)
    faster = replace(motion, v=motion.v * np.array([1.0, 1.0, 2.0])[:, None, None])
    more = 1.5 * float(np.sum(model.mass * np.sum(motion.v[2] ** 2, axis=1))) / scale
    assert energy_error(model, faster) == pytest.approx([0, 0, more], abs=1e-10)
    spun = replace(motion, pdot=motion.pdot * np.array([1.0, 1.0, 3.0])[:, None, None])
    omega = angular_velocity(motion.p[2], motion.pdot[2])
    turned = 4 * float(np.einsum("ki,kij,kj", omega, model.inertia, omega)) / scale
    assert energy_error(model, spun) == pytest.approx([0, 0, turned], abs=1e-10)
    loaded = replace(model, drag_moment=np.array([0, 0, 0.1]))
    assert np.all(np.isnan(energy_error(loaded, motion)))


def test_a_table_has_a_row_for_each_variant_tolerance_and_time():
    """The maxima up to a time, and the share of the steps that falls to it."""
    model, state = random_chain(67, [False])
    rtols, times = (1e-4, 1e-6), (0.5, 2.0, 4.0)
    table = table_of(model, state, rtols=rtols, times=times)
    assert [(row["variant"], row["rtol"], row["time"]) for row in table] == [
        (variant, rtol, end) for rtol in rtols for variant in VARIANTS for end in times
    ]
    grid = np.unique(np.concatenate([np.linspace(0, end, 41) for end in times]))
    start = maximal_coordinates(state)
    motion = integrate_collocation([model], *start, grid, 1e-4)
    errors = drift_errors(model, motion)
    for row in table[:3]:
        for name, error in errors.items():
            assert row[name] == np.max(error[grid <= row["time"]])
        assert row["steps"] == round(motion.steps * row["time"] / 4.0)
