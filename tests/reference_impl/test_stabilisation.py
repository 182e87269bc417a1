"""Baumgarte and projection hold the manifold that the raw form drifts from, and change nothing else."""

import numpy as np
import pytest

from plumbline.model.kinematics import maximal_coordinates
from reference_impl.fast.collocation import integrate_collocation
from tests.helpers.random_chains import random_chain


@pytest.mark.parametrize("rods", [[False], [True], [False, True, False]])
def test_every_variant_converges_to_the_same_motion(rods):
    model, state = random_chain(60, rods, loads=True, drag=True)
    start = maximal_coordinates(state)
    times = np.linspace(0, 0.5, 6)
    variants = {}, {"baumgarte": 10.0}, {"project": True}
    runs = [integrate_collocation([model], *start, times, 1e-13, **variant) for variant in variants]
    for other in runs[1:]:
        assert np.max(np.abs(other.r - runs[0].r)) < 1e-10
        assert np.max(np.abs(other.pdot - runs[0].pdot)) < 1e-9
