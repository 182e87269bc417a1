"""Baumgarte and projection hold the manifold that the raw form drifts from, and change nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from adapters.reference_engine import chain
from plumbline.kinematics import rate
from reference_impl.forest import Forest, lay
from reference_impl.stabilised import VARIANTS, constraint_errors, drift_table, run
from tests.random_chains import random_chain


@pytest.mark.parametrize("rods", [[False], [True], [False, True, False]])
def test_every_variant_converges_to_the_same_motion(rods: list[bool]) -> None:
    model, state = random_chain(np.random.default_rng(60), rods, loads=True, drag=True)
    start = chain(model), state.r, state.p, state.v, rate(state.p, state.omega)
    times = np.linspace(0, 0.5, 6)
    runs = [run(variant, *start, times, 1e-13) for variant in VARIANTS]
    for other in runs[1:]:
        assert np.max(np.abs(other.r - runs[0].r)) < 1e-10
        assert np.max(np.abs(other.pdot - runs[0].pdot)) < 1e-9


@pytest.mark.parametrize("rods", [[False], [True], [True, False, True]])
def test_projection_is_newton_on_every_constraint(rods: list[bool]) -> None:
    """From 1e-5 off the manifold to rounding; a state on it stays."""
    rng = np.random.default_rng(61)
    model, state = random_chain(rng, rods)
    forest, pdot = Forest([chain(model)]), rate(state.p, state.omega)
    q, v = lay(state.r, state.p), lay(state.v, pdot)
    near = forest.project(q + 1e-5 * rng.normal(size=q.shape), v + 1e-5 * rng.normal(size=q.shape))
    for error in forest.constraints(*near):
        assert np.max(np.abs(error)) < 1e-14
    assert np.max(np.abs(np.sum(near[0][3:] ** 2, axis=0) - 1)) < 1e-15
    assert np.max(np.abs(np.sum(near[0][3:] * near[1][3:], axis=0))) < 1e-15
    assert np.max(np.abs(near[0] - q)) < 1e-4
    for moved, was in zip(forest.project(q, v), (q, v), strict=True):
        assert np.max(np.abs(moved - was)) < 1e-13


def test_raw_drifts_and_the_others_do_not() -> None:
    model, state = random_chain(np.random.default_rng(62), [False])
    table = drift_table(
        chain(model), state.r, state.p, state.v, rate(state.p, state.omega), rtols=(1e-6,), times=(3.0, 30.0)
    )
    held = {(row.variant, row.time): row for row in table}
    assert held["raw", 30.0].gap > 3 * held["raw", 3.0].gap
    assert held["baumgarte", 30.0].gap < 0.05 * held["raw", 30.0].gap
    assert held["projected", 30.0].gap < 1e-14
    assert held["projected", 30.0].norm < 1e-15
    assert held["projected", 30.0].energy < 0.05 * held["raw", 30.0].energy


def test_baumgarte_pulls_back_at_its_rate() -> None:
    """A gap of 1e-6 with a = 10/s is critically damped: (1 + a t) e^{−a t} of it is left."""
    model, state = random_chain(np.random.default_rng(63), [False])
    r, times = state.r + np.array([1e-6, 0, 0]), np.linspace(0, 1, 5)
    held = run(
        "baumgarte", chain(model), r, state.p, state.v, rate(state.p, state.omega), times, 1e-12, rate=10.0
    )
    left = constraint_errors(chain(model), held)[0] / 1e-6
    assert np.max(np.abs(left - (1 + 10 * times) * np.exp(-10 * times))) < 1e-3


@pytest.mark.full
def test_energy_over_a_thousand_seconds() -> None:
    model, state = random_chain(np.random.default_rng(64), [False])
    start = chain(model), state.r, state.p, state.v, rate(state.p, state.omega)
    row = drift_table(*start, rtols=(1e-13,), times=(1000.0,), variants=("projected",))[0]
    assert row.energy <= 1e-12
    assert row.gap < 1e-14
