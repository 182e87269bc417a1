"""E4: the raw form drifts; how much, how fast, and that an injected defect of γ grows as δ t and δ t²/2."""

from itertools import pairwise

import numpy as np
import pytest

from reference_impl.drift import BINS_PER_DECADE, fit_growth, largest_joint_gaps, measure_drift
from reference_impl.integrate import integrate_dop853
from reference_impl.joints import constraint_rows
from tests.helpers.notes_test_data import on_manifold, random_chain

DEFECT = 1e-4


@pytest.mark.parametrize("rods", [[True], [False], [True, False, True]], ids=str)
def test_an_injected_defect_comes_out_as_delta_t_and_half_delta_t_squared(rods):
    """One δ per row, all different, signs mixed; truncation (rtol 1e-12) is far below 1 % of it."""
    rng = np.random.default_rng(len(rods))
    chain = random_chain(rng, rods)
    state = on_manifold(chain, rng)
    count = int(np.sum(np.where(rods, 1, 3)))
    delta = DEFECT * (1 + np.arange(count)) * (-1.0) ** np.arange(count)
    times = np.linspace(0, 2, 9)
    run = integrate_dop853(chain, *state, times, 1e-12, gamma_defect=delta)
    for t, *sample in zip(times[1:], run.r[1:], run.p[1:], run.v[1:], run.pdot[1:], strict=True):
        joints = constraint_rows(chain, *sample)
        np.testing.assert_allclose(joints.C, delta * t**2 / 2, rtol=0.01)
        np.testing.assert_allclose(joints.constraint_rate(*sample[2:]), delta * t, rtol=0.01)


def test_an_injected_defect_has_exponents_1_and_2():
    rng = np.random.default_rng(7)
    chain = random_chain(rng, [True])
    length = chain.length[0]
    decades = np.array([0.02, 0.2, 2.0])
    measured = measure_drift(chain, *on_manifold(chain, rng), 1e-11, decades, gamma_defect=DEFECT, samples=10)
    assert measured.rtol == 1e-11 and measured.decades is decades and measured.steps > 10
    assert abs(measured.joint_gap.exponent - 2) < 0.02
    assert abs(measured.gap_rate.exponent - 1) < 0.02
    np.testing.assert_allclose(
        measured.joint_gap.maxima * 2 * length, DEFECT * decades[1:] ** 2 / 2, rtol=0.01
    )
    np.testing.assert_allclose(measured.gap_rate.maxima * 2 * length, DEFECT * decades[1:], rtol=0.01)


def test_gaps_are_metres_and_metres_a_second_of_the_worst_joint():
    """A ball opened by 5 cm and 0.5 m/s; a rod stretched by 1e-6 m along itself, and at 1e-3 m/s."""
    rng = np.random.default_rng(8)
    chain = random_chain(rng, [False])
    r, p, v, pdot = on_manifold(chain, rng)
    found = largest_joint_gaps(chain, r + np.array([0.03, 0.04, 0]), p, v + np.array([0, 0.3, 0.4]), pdot)
    # rounding of a metre on a gap of 5 cm; on one of 1e-6 m (whose own square is 1e-6 of it) and 1e-3 m/s
    np.testing.assert_allclose(found, (0.05, 0.5), rtol=1e-12)
    chain = random_chain(rng, [True])
    r, p, v, pdot = on_manifold(chain, rng)
    u = constraint_rows(chain, r, p, v, pdot).d / chain.length[0]
    np.testing.assert_allclose(largest_joint_gaps(chain, r + 1e-6 * u, p, v, pdot)[0], 1e-6, rtol=1e-5)
    np.testing.assert_allclose(largest_joint_gaps(chain, r, p, v + 1e-3 * u, pdot)[1], 1e-3, rtol=1e-9)


def falls_with_the_tolerance(rods, decades, tolerances):
    """Drift at each tolerance; every maximum falls by a decade at least for three decades of tolerance."""
    rng = np.random.default_rng(4)
    chain = random_chain(rng, rods, loads=False)
    state = on_manifold(chain, rng)
    runs = [measure_drift(chain, *state, rtol, np.array(decades)) for rtol in tolerances]
    for coarse, fine in pairwise(runs):
        for name in ("joint_gap", "gap_rate", "norm"):
            before, after = getattr(coarse, name).maxima, getattr(fine, name).maxima
            assert np.all(after < 0.1 * before), f"{name}: {before} at {coarse.rtol}, {after} at {fine.rtol}"
    return runs


@pytest.mark.parametrize("rods", [[True], [False]], ids=["rod", "ball"])
def test_drift_falls_with_the_tolerance(rods):
    runs = falls_with_the_tolerance(rods, [0.1, 1, 10], (1e-4, 1e-7, 1e-10))
    for run in runs:
        assert run.joint_gap.maxima.shape == (2,) and run.steps > 10
        assert run.joint_gap.maxima[1] > run.joint_gap.maxima[0] > 0, "the raw form has no stabilisation"


@pytest.mark.full
@pytest.mark.timeout(900)
@pytest.mark.parametrize("rods", [[True], [False], [True, True]], ids=["rod", "ball", "two rods"])
def test_drift_to_100_s(rods):
    for run in falls_with_the_tolerance(rods, [0.1, 1, 10, 100], (1e-6, 1e-9, 1e-12)):
        assert np.all(np.diff(run.joint_gap.maxima) > 0)
        assert 0 < run.joint_gap.exponent < 3 and np.isfinite(run.joint_gap.half_interval)


def test_the_fit_recovers_a_power_law_and_says_how_sure_it_is():
    ends = 10 ** (np.arange(1, 2 * BINS_PER_DECADE + 1) / BINS_PER_DECADE)
    exact = fit_growth(3e-9 * ends**1.7, ends)
    assert abs(exact.exponent - 1.7) < 1e-12 and exact.half_interval < 1e-6
    np.testing.assert_allclose(exact.maxima, 3e-9 * np.array([10, 100]) ** 1.7)
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        noisy = fit_growth(np.exp(0.3 * rng.normal(size=len(ends))) * ends**1.7, ends)
        covered += abs(noisy.exponent - 1.7) < noisy.half_interval
    assert covered >= 180, "a 95 % interval holds the exponent in about 190 of 200 draws"
    x, y = np.log(ends), np.log(ends**1.7) + np.array([0.3, -0.1, 0.2, -0.4, 0.1, 0.0, -0.2, 0.1])
    slope, offset = np.polyfit(x, y, 1)
    error = np.sqrt(np.sum((y - slope * x - offset) ** 2) / 6 / np.sum((x - x.mean()) ** 2))
    found = fit_growth(np.exp(y), ends)
    assert found.exponent == pytest.approx(slope, rel=1e-12)  # rounding of sums over eight points
    assert found.half_interval == pytest.approx(2.446912 * error, rel=3e-7), (
        "Student's t of 8 - 2, in 7 digits"
    )


def test_zeros_take_no_part_in_the_fit_and_three_points_make_one():
    ends = 10 ** (np.arange(1, 2 * BINS_PER_DECADE + 1) / BINS_PER_DECADE)
    few = np.where(np.arange(2 * BINS_PER_DECADE) < 5, 0.0, ends**2)
    assert fit_growth(few, ends).exponent == pytest.approx(2, rel=1e-12)
    two = fit_growth(np.where(np.arange(2 * BINS_PER_DECADE) < 6, 0.0, ends), ends)
    assert (*two.maxima, two.exponent, two.half_interval) == (0.0, 100.0, 0.0, np.inf)
