"""Baumgarte and projection hold the manifold that the raw form drifts from, and change nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.model.kinematics import quaternion_rate
from reference_impl.collocation import integrate_collocation
from reference_impl.euler_parameters import angular_velocity
from reference_impl.joints import constraint_rows
from reference_impl.stabilised import (
    VARIANTS,
    constraint_errors,
    drift_table,
    energy_error,
    integrate_variant,
)
from reference_impl.structured import StructuredSystem, component_first
from tests.helpers.random_chains import random_chain


@pytest.mark.parametrize("rods", [[False], [True], [False, True, False]])
def test_every_variant_converges_to_the_same_motion(rods):
    model, state = random_chain(np.random.default_rng(60), rods, loads=True, drag=True)
    start = model, state.r, state.p, state.v, quaternion_rate(state.p, state.omega)
    times = np.linspace(0, 0.5, 6)
    runs = [integrate_variant(variant, *start, times, 1e-13) for variant in VARIANTS]
    for other in runs[1:]:
        assert np.max(np.abs(other.r - runs[0].r)) < 1e-10
        assert np.max(np.abs(other.pdot - runs[0].pdot)) < 1e-9


@pytest.mark.parametrize("rods", [[False], [True], [True, False, True]])
def test_projection_is_newton_on_every_constraint(rods):
    """From 1e-5 off the manifold to rounding; a state on it stays."""
    rng = np.random.default_rng(61)
    model, state = random_chain(rng, rods)
    forest, pdot = StructuredSystem([model]), quaternion_rate(state.p, state.omega)
    q, v = component_first(state.r, state.p), component_first(state.v, pdot)
    near = forest.project(q + 1e-5 * rng.normal(size=q.shape), v + 1e-5 * rng.normal(size=q.shape))
    for error in forest.constraints(*near):
        assert np.max(np.abs(error)) < 1e-14
    assert np.max(np.abs(np.sum(near[0][3:] ** 2, axis=0) - 1)) < 1e-15
    assert np.max(np.abs(np.sum(near[0][3:] * near[1][3:], axis=0))) < 1e-15
    assert np.max(np.abs(near[0] - q)) < 1e-4
    for moved, was in zip(forest.project(q, v), (q, v), strict=True):
        assert np.max(np.abs(moved - was)) < 1e-13


def test_raw_drifts_and_the_others_do_not():
    model, state = random_chain(np.random.default_rng(62), [False])
    table = drift_table(
        model,
        state.r,
        state.p,
        state.v,
        quaternion_rate(state.p, state.omega),
        rtols=(1e-6,),
        times=(3.0, 30.0),
    )
    held = {(row.variant, row.time): row for row in table}
    assert held["raw", 30.0].gap > 3 * held["raw", 3.0].gap
    assert held["baumgarte", 30.0].gap < 0.05 * held["raw", 30.0].gap
    assert held["projected", 30.0].gap < 1e-14
    assert held["projected", 30.0].norm < 1e-15
    assert held["projected", 30.0].energy < 0.05 * held["raw", 30.0].energy


def test_baumgarte_pulls_back_at_its_rate():
    """A gap of 1e-6 with a = 10/s is critically damped: (1 + a t) e^{−a t} of it is left."""
    model, state = random_chain(np.random.default_rng(63), [False])
    r, times = state.r + np.array([1e-6, 0, 0]), np.linspace(0, 1, 5)
    held = integrate_variant(
        "baumgarte",
        model,
        r,
        state.p,
        state.v,
        quaternion_rate(state.p, state.omega),
        times,
        1e-12,
        rate=10.0,
    )
    left = constraint_errors(model, held)[0] / 1e-6
    assert np.max(np.abs(left - (1 + 10 * times) * np.exp(-10 * times))) < 1e-3


@pytest.mark.full
def test_energy_over_a_thousand_seconds():
    model, state = random_chain(np.random.default_rng(64), [False])
    start = model, state.r, state.p, state.v, quaternion_rate(state.p, state.omega)
    row = drift_table(*start, rtols=(1e-13,), times=(1000.0,), variants=("projected",))[0]
    assert row.energy <= 1e-12
    assert row.gap < 1e-14


@pytest.mark.parametrize("rods", [[True, False, True], [False], [True]], ids=str)
def test_constraint_errors_are_metres_and_metres_a_second(rods):
    """A rod's stretch and its rate, a ball's distance and speed, each the worst of its state, from `rows`."""
    rng = np.random.default_rng(65)
    model, state = random_chain(rng, rods)
    one, pdot = model, quaternion_rate(state.p, state.omega)
    motion = integrate_variant("raw", one, state.r, state.p, state.v, pdot, np.linspace(0, 0.1, 3), 1e-6)
    n = model.n
    moved = replace(
        motion,
        r=motion.r + 0.02 * rng.normal(size=(3, n, 3)),
        v=motion.v + 0.3 * rng.normal(size=(3, n, 3)),
    )
    found = constraint_errors(one, moved)
    for t in range(3):
        joints = constraint_rows(one, moved.r[t], moved.p[t], moved.v[t], moved.pdot[t])
        rates = joints.constraint_rate(moved.v[t], moved.pdot[t])
        gaps, speeds = [], []
        for k in range(n):
            distance = np.linalg.norm(joints.d[k])
            gaps.append(abs(distance - one.length[k]))
            speed = rates[joints.joint == k]
            speeds.append(abs(speed[0]) / (2 * distance) if rods[k] else np.linalg.norm(speed))
        assert found[0][t] == pytest.approx(max(gaps), abs=1e-6)
        assert found[1][t] == pytest.approx(max(speeds), rel=1e-4)
        assert found[2][t] == pytest.approx(np.max(np.abs(np.linalg.norm(moved.p[t], axis=1) - 1)), abs=1e-15)
    still = constraint_errors(one, replace(motion, p=1.5 * motion.p))
    assert still[2] == pytest.approx(np.full(3, 0.5), abs=1e-6)


def test_energy_is_over_the_weight_and_reach_of_the_stretched_chain():
    model, state = random_chain(np.random.default_rng(66), [True, False, True])
    one, pdot = model, quaternion_rate(state.p, state.omega)
    motion = integrate_variant(
        "projected", one, state.r, state.p, state.v, pdot, np.linspace(0, 0.1, 3), 1e-12
    )
    near, far = np.linalg.norm(model.proximal, axis=1), np.linalg.norm(model.distal, axis=1)
    hang = [model.length[0] + near[0], 0.0, 0.0]
    hang[1] = hang[0] + far[0] + near[1]
    hang[2] = hang[1] + far[1] + model.length[2] + near[2]
    scale = 9.81 * float(np.sum(model.mass * hang))
    assert np.max(energy_error(one, motion)) < 1e-11
    lifted = replace(motion, r=motion.r + np.array([0.0, 0.5, 1.0])[:, None, None] * [0, 0, 1.0])
    raised = 9.81 * float(np.sum(model.mass)) * np.array([0, 0.5, 1]) / scale
    assert energy_error(one, lifted) == pytest.approx(raised, abs=1e-10)
    faster = replace(motion, v=motion.v * np.array([1.0, 1.0, 2.0])[:, None, None])
    more = 1.5 * float(np.sum(model.mass * np.sum(motion.v[2] ** 2, axis=1))) / scale
    assert energy_error(one, faster) == pytest.approx([0, 0, more], abs=1e-10)
    spun = replace(motion, pdot=motion.pdot * np.array([1.0, 1.0, 3.0])[:, None, None])
    omega = angular_velocity(motion.p[2], motion.pdot[2])
    turned = 4 * float(np.einsum("ki,kij,kj", omega, model.inertia, omega)) / scale
    assert energy_error(one, spun) == pytest.approx([0, 0, turned], abs=1e-10)
    loaded = replace(one, drag_moment=np.array([0, 0, 0.1]))
    assert np.all(np.isnan(energy_error(loaded, motion)))


def test_a_table_has_a_row_for_each_variant_tolerance_and_time():
    """The maxima up to a time, and the share of the steps that falls to it."""
    model, state = random_chain(np.random.default_rng(67), [False])
    start = model, state.r, state.p, state.v, quaternion_rate(state.p, state.omega)
    rtols, times = (1e-4, 1e-6), (0.5, 2.0, 4.0)
    table = drift_table(*start, rtols=rtols, times=times, samples=8, variants=("raw", "projected"))
    expected = [(v, rtol, end) for v in ("raw", "projected") for rtol in rtols for end in times]
    assert [(row.variant, row.rtol, row.time) for row in table] == expected
    grid = np.unique(np.concatenate([np.linspace(0, end, 9) for end in times]))
    motion = integrate_variant("raw", *start, grid, 1e-4)
    errors = [*constraint_errors(start[0], motion), energy_error(start[0], motion)]
    for row in table[:3]:
        upto = [float(np.max(error[grid <= row.time])) for error in errors]
        assert [row.gap, row.gap_rate, row.norm, row.energy] == upto
        assert row.steps == round(motion.steps * row.time / 4.0)


def test_there_are_three_variants_and_no_other():
    model, state = random_chain(np.random.default_rng(68), [False])
    start = model, state.r, state.p, state.v, quaternion_rate(state.p, state.omega)
    with pytest.raises(ValueError, match="no variant 'damped'"):
        integrate_variant("damped", *start, np.array([0.0, 0.1]), 1e-6)


def test_projection_from_afar_ends_on_unit_quaternions():
    """From 5 % off what is left of the gaps is of higher order, but p is normalised to rounding."""
    rng = np.random.default_rng(69)
    model, state = random_chain(rng, [True, False, False])
    forest = StructuredSystem([model])
    q, v = component_first(state.r, state.p), component_first(state.v, quaternion_rate(state.p, state.omega))
    far = q + 0.05 * rng.normal(size=q.shape)
    near = forest.project(far, v + 0.05 * rng.normal(size=q.shape))
    assert np.max(np.abs(np.sum(near[0][3:] ** 2, axis=0) - 1)) < 1e-15
    assert np.max(np.abs(np.sum(near[0][3:] * near[1][3:], axis=0))) < 1e-15
    left, before = (np.max(np.abs(forest.constraints(x, v)[0])) for x in (near[0], far))
    assert left < 0.02 * before


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_variant_is_collocation_with_its_own_option_and_no_other(variant):
    model, state = random_chain(np.random.default_rng(70), [False, True])
    state = replace(state, r=state.r + 1e-3)  # off the manifold, where the options differ
    start, times = (state.r, state.p, state.v, quaternion_rate(state.p, state.omega)), np.linspace(0, 0.2, 3)
    ours = integrate_variant(variant, model, *start, times, 1e-6, rate=7.0, nodes=5)
    same = integrate_collocation(
        [model],
        *start,
        times,
        1e-6,
        nodes=5,
        baumgarte=7.0 * (variant == "baumgarte"),
        project=variant == "projected",
    )
    assert np.array_equal(ours.r, same.r) and np.array_equal(ours.pdot, same.pdot)
