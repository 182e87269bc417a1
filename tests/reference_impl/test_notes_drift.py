"""E4: the raw form drifts; how much, how fast, and that an injected defect of γ grows as δ t and δ t²/2."""

from itertools import pairwise

import numpy as np
import pytest

from plumbline.studies.drift import drift_errors
from reference_impl.integrate import direct_acceleration, integrate_dop853
from reference_impl.joints import constraint_rows
from tests.helpers.notes_test_data import loaded_chain, state_on_manifold
from tests.helpers.random_chains import random_model

GAMMA_DEFECT = 1e-4


@pytest.mark.parametrize("rods", [[True], [False], [True, False, True]], ids=str)
def test_an_injected_defect_comes_out_as_delta_t_and_half_delta_t_squared(rods):
    """One δ per row, all different, signs mixed; truncation (rtol 1e-12) is far below 1 % of it."""
    chain, state = loaded_chain(rods, len(rods))
    count = int(np.sum(np.where(rods, 1, 3)))
    delta = GAMMA_DEFECT * (1 + np.arange(count)) * (-1.0) ** np.arange(count)
    times = np.linspace(0, 2, 9)
    run = integrate_dop853(chain, *state, times, 1e-12, direct_acceleration(chain, delta))
    for t, *sample in zip(times[1:], run.r[1:], run.p[1:], run.v[1:], run.pdot[1:], strict=True):
        joints = constraint_rows(chain, *sample)
        np.testing.assert_allclose(joints.C, delta * t**2 / 2, rtol=0.01)
        np.testing.assert_allclose(joints.constraint_rate(*sample[2:]), delta * t, rtol=0.01)


def measure_drift(chain, state, rtol, decades, gamma_defect=0.0, samples=400):
    """The largest gap [m], gap rate [m/s] and |‖p‖ − 1| of a raw run in each decade (3, K), and its steps."""
    times = [np.geomspace(a, b, samples + 1)[1:] for a, b in pairwise(decades)]
    run = integrate_dop853(
        chain, *state, np.concatenate([[0.0], *times]), rtol, direct_acceleration(chain, gamma_defect)
    )
    found = drift_errors(chain, run)
    errors = np.array([found[name] for name in ("gap", "gap_rate", "norm")])[:, 1:]
    return errors.reshape(3, len(times), samples).max(axis=2), run.steps


def drift_falls_with_the_tolerance(rods, decades, tolerances):
    """Drift at each tolerance; every maximum falls by a decade at least for three decades of tolerance."""
    rng = np.random.default_rng(4)
    chain = random_model(rng, rods)
    state = state_on_manifold(chain, rng)
    runs = [measure_drift(chain, state, rtol, decades) for rtol in tolerances]
    for (coarse, _), (fine, _) in pairwise(runs):
        assert np.all(fine < 0.1 * coarse), (coarse, fine)
    return runs


@pytest.mark.parametrize("rods", [[True], [False]], ids=["rod", "ball"])
def test_drift_falls_with_the_tolerance(rods):
    for (gap, *_), steps in drift_falls_with_the_tolerance(rods, [0.1, 1, 10], (1e-4, 1e-7, 1e-10)):
        assert steps > 10
        assert gap[1] > gap[0] > 0, "the raw form has no stabilisation"


@pytest.mark.full
@pytest.mark.timeout(900)
@pytest.mark.parametrize("rods", [[True], [False], [True, True]], ids=["rod", "ball", "two rods"])
def test_drift_to_100_s(rods):
    for (gap, *_), _ in drift_falls_with_the_tolerance(rods, [0.1, 1, 10, 100], (1e-6, 1e-9, 1e-12)):
        assert np.all(np.diff(gap) > 0)
        assert 0 < np.polyfit([0, 1, 2], np.log10(gap), 1)[0] < 3
