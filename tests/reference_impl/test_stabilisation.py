"""Baumgarte and projection hold the manifold that the raw form drifts from, and change nothing else."""

import numpy as np
import pytest

from plumbline.model.kinematics import maximal_coordinates
from reference_impl.fast.chain_elimination import StructuredSystem
from reference_impl.fast.collocation import integrate_collocation
from tests.helpers.notes_test_data import components
from tests.helpers.random_chains import random_chain


@pytest.mark.parametrize("rods", [[False], [True], [False, True, False]])
def test_every_variant_converges_to_the_same_motion(rods):
    model, state = random_chain(np.random.default_rng(60), rods, loads=True, drag=True)
    start = maximal_coordinates(state)
    times = np.linspace(0, 0.5, 6)
    variants = {}, {"baumgarte": 10.0}, {"project": True}
    runs = [integrate_collocation([model], *start, times, 1e-13, **variant) for variant in variants]
    for other in runs[1:]:
        assert np.max(np.abs(other.r - runs[0].r)) < 1e-10
        assert np.max(np.abs(other.pdot - runs[0].pdot)) < 1e-9


@pytest.mark.parametrize("rods", [[False], [True], [True, False, True]])
def test_projection_is_newton_on_every_constraint(rods):
    """From 1e-5 off the manifold to rounding; a state on it stays."""
    rng = np.random.default_rng(61)
    model, state = random_chain(rng, rods)
    forest, (q, v) = StructuredSystem([model]), components(*maximal_coordinates(state))
    near = forest.project(q + 1e-5 * rng.normal(size=q.shape), v + 1e-5 * rng.normal(size=q.shape))
    for error in forest.constraints(*near):
        assert np.max(np.abs(error)) < 1e-14
    assert np.max(np.abs(np.sum(near[0][3:] ** 2, axis=0) - 1)) < 1e-15
    assert np.max(np.abs(np.sum(near[0][3:] * near[1][3:], axis=0))) < 1e-15
    assert np.max(np.abs(near[0] - q)) < 1e-4
    for moved, was in zip(forest.project(q, v), (q, v), strict=True):
        assert np.max(np.abs(moved - was)) < 1e-13


def test_projection_from_afar_ends_on_unit_quaternions():
    """From 5 % off what is left of the gaps is of higher order, but p is normalised to rounding."""
    rng = np.random.default_rng(69)
    model, state = random_chain(rng, [True, False, False])
    forest, (q, v) = StructuredSystem([model]), components(*maximal_coordinates(state))
    far = q + 0.05 * rng.normal(size=q.shape)
    near = forest.project(far, v + 0.05 * rng.normal(size=q.shape))
    assert np.max(np.abs(np.sum(near[0][3:] ** 2, axis=0) - 1)) < 1e-15
    assert np.max(np.abs(np.sum(near[0][3:] * near[1][3:], axis=0))) < 1e-15
    left, before = (np.max(np.abs(forest.constraints(x, v)[0])) for x in (near[0], far))
    assert left < 0.02 * before
