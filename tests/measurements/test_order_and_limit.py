"""Orders and limits of refinement studies whose answer is known."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plumbline.measurements.order_and_limit import (
    ORDER_MARGIN,
    STEP_EXPONENTS,
    extrapolated_order,
    falls_with_resolution,
    max_norm,
    observed_order,
    refinement_resolutions,
    romberg,
    step_unit,
    tightest_tolerance_limit,
)
from plumbline.model.datatypes import STEP_ORDERS, Integrator

TIMES = np.linspace(0, 2, 17)


def samples_with_error(order, powers, count=6, size=1.0):
    """Samples (T, 1, 3) whose error is a sum of powers of h with coefficients of order one."""
    rng = np.random.default_rng(order)
    limit = np.sin(TIMES[:, None, None] + np.arange(3))
    wobble = [rng.normal(size=3) * TIMES[:, None, None] for _ in powers]
    hs = [2.0**-k for k in range(5, 5 + count)]
    return limit, [limit + size * sum(w * h**p for w, p in zip(wobble, powers, strict=True)) for h in hs]


@pytest.mark.parametrize(
    ("order", "powers"), [(1, (1, 2, 3)), (2, (2, 4, 6)), (2, (2, 3, 4)), (4, (4, 5, 6))]
)
def test_the_order_is_seen_and_the_limit_is_reached(order, powers):
    limit, ys = samples_with_error(order, powers)
    seen = observed_order(ys, 1e-16, order)
    assert seen.is_asymptotic
    assert seen.value == pytest.approx(order, abs=ORDER_MARGIN)
    found = romberg(ys, powers)
    error = np.max(np.linalg.norm(found.y - limit, axis=-1))
    assert error <= found.uncertainty[-1] + 1e-14
    assert error < 1e-6 * np.max(np.abs(ys[-1] - limit)) + 1e-14


@pytest.mark.parametrize(
    ("last", "shown"),
    [
        ((4.55, 4.3, 4.15), 4.0),  # each halving of the step halves what is left
        ((2.1, 2.05, 2.02), 2.02),  # stays away from 4
        ((4.38, 4.5, 4.3), None),
        ((3.6, 3.7, 3.78), None),
        ((float("nan"), 4.3, 4.15), None),
        ((4.3, 4.15), None),
        ((5.0, 4.5, 4.25), None),  # halving what is left, but not there yet
        ((4.75, 4.41, 4.15), None),  # on its way, faster than by half: its next order is not known
        ((4.5, 4.6, 4.5), None),  # away by less than three times the way it has gone, there and back
        ((4.22, 4.2, 4.18), None),  # near 4 and hardly moving: neither on its way there nor far enough
    ],
)
def test_what_three_orders_lead_to(last, shown):
    found = extrapolated_order(last, 4)
    assert found == (None if shown is None else pytest.approx(shown))


def test_an_order_on_its_way_shows_nothing():
    limit, ys = samples_with_error(1, (1, 2, 3))
    hs = [2.0**-k for k in range(5, 11)]
    creeping = [
        limit + (y - limit) / h * h ** (1.5 + 0.3 * k) for k, (y, h) in enumerate(zip(ys, hs, strict=True))
    ]
    assert not observed_order(creeping, 1e-16, 4).is_asymptotic


def test_wrong_powers_are_paid_for_in_uncertainty():
    limit, ys = samples_with_error(1, (1, 2, 3))
    found = romberg(ys, (4, 5, 6))
    assert np.max(np.linalg.norm(found.y - limit, axis=-1)) <= found.uncertainty[-1]


def test_without_finite_runs_there_is_no_limit():
    with pytest.raises(ValueError, match="fewer than two finite runs"):
        romberg([np.full((3, 1, 3), np.nan)] * 3, (1, 2))


@given(st.integers(1, 60), st.sampled_from([1, 2, 4]), st.floats(0.25, 100))
def test_steps_halve_and_are_at_least_four(bodies, order, duration):
    steps = refinement_resolutions(Integrator("x", "step", order, (order,)), bodies, duration)
    assert steps == refinement_resolutions(
        Integrator("x", "step", order, (order,)), bodies, duration, extra_refinements=0
    )
    assert len(steps) >= 4
    assert all(a == 2 * b for a, b in itertools.pairwise(steps))


@pytest.mark.parametrize(
    ("order", "bodies", "duration", "extra", "coarse", "fine"),
    [
        (4, 1, 2.0, 0, 5, 12),
        (1, 1, 2.0, 0, 9, 15),
        (2, 2, 10.0, 0, 8, 12),
        (1, 8, 2.0, 0, 9, 15),  # 2^15 steps a second for 2 s of 8 bodies are just affordable
        (1, 9, 2.0, 0, 9, 14),
        (1, 16, 1.0, 0, 9, 15),
        (1, 16, 0.1, 0, 9, 15),  # less than a second counts as one
        (1, 17, 0.1, 0, 9, 14),
        (2, 60, 100.0, 0, 8, 11),  # four steps, whatever they cost
        (4, 1, 2.0, 1, 5, 13),
        (2, 60, 100.0, 2, 8, 13),
    ],
)
def test_a_study_has_as_many_steps_as_are_affordable(order, bodies, duration, extra, coarse, fine):
    steps = refinement_resolutions(Integrator("x", "step", order, (order,)), bodies, duration, extra)
    assert steps == [2.0**-k for k in range(coarse, fine + 1)]


@given(st.sampled_from([1, 2, 4]), st.floats(0.01, 100), st.sampled_from([0.001, 1 / 64, 0.03, 1 / 4, 1.0]))
def test_samples_and_durations_never_make_steps_longer(order, duration, sample_interval):
    """Seen: at 2 s and samples closer than 1/32 s the steps were doubled."""
    method = Integrator("x", "step", order, (order,))
    steps = refinement_resolutions(method, 1, duration, 0, sample_interval)
    coarsest = STEP_EXPONENTS[order][0]
    usual = step_unit(sample_interval, 1.0, coarsest) * 2.0**-coarsest
    assert steps[0] <= usual
    assert steps[0] == usual or (usual > sample_interval and duration < 1)


def test_an_adaptive_method_is_refined_by_tolerances():
    method = Integrator("x", "tolerance", 8, min_rtol=1e-13)
    assert refinement_resolutions(method, 50, 100.0) == pytest.approx([1e-11, 1e-13], rel=1e-12, abs=0)


def test_the_largest_length_is_over_everything_but_the_last_axis():
    y = np.zeros((2, 3, 2))
    y[0, 1], y[1, 2] = [4, -2], [3, -4]
    assert max_norm(y) == 5.0
    assert max_norm(np.zeros((0, 3, 2))) == 0.0
    y[0, 0, 0] = np.nan
    assert max_norm(y) == np.inf


@pytest.mark.parametrize(
    ("errors", "falls"),
    [
        ((64.0, 16.0, 4.0, 1.0), True),
        ((4.0, 2.0), True),
        ((4.0, 2.1), False),
        ((4.0, 4.0, 5.9, 4.0, 1.0), True),
        ((4.0, 4.0, 6.1, 4.0, 1.0), False),
        ((0.3, 0.2, 0.4, 0.5), True),  # rounding
        ((0.3, 0.2, 0.4, 0.7), False),
        ((np.inf, np.nan, 4.0, 2.0), True),
        ((np.inf, 4.0), True),
        ((4.0, np.inf, 4.0), False),
    ],
)
def test_errors_fall_on_the_whole_and_never_rise_by_much(errors, falls):
    assert falls_with_resolution(errors, 0.5) is falls


def test_all_orders_of_fixed_steps_have_a_study():
    assert tuple(STEP_EXPONENTS) == STEP_ORDERS


def runs_with_differences(*differences):
    """Runs (1, 1, 1) whose consecutive differences are these, coarse to fine."""
    return [np.full((1, 1, 1), x) for x in np.cumsum([0.0, *differences])]


def order_of(differences, floor, declared):
    return observed_order(runs_with_differences(*differences), floor, declared)


def test_orders_are_logarithms_of_ratios_of_differences():
    seen = order_of((64.0, 16.0, 4.0, 0.5), 1e-9, 2)
    assert seen.orders == (2.0, 2.0, 3.0)
    assert seen.differences == (64.0, 16.0, 4.0, 0.5)
    assert (seen.value, seen.is_asymptotic, seen.is_at_rounding_floor) == (2.0, True, False)


@pytest.mark.parametrize(
    ("floor", "used"), [(0.5 / 32 * 0.99, 3), (0.5 / 32, 2), (4.0 / 32, 1), (16.0 / 32, 0)]
)
def test_a_difference_counts_above_32_floors(floor, used):
    seen = order_of((64.0, 16.0, 4.0, 0.5), floor, 5)
    assert np.isfinite(seen.orders).tolist() == [k < used for k in range(3)]
    assert seen.value == ([2.0, 2.0, 3.0][used - 1] if used else None)
    assert seen.differences == (64.0, 16.0, 4.0, 0.5)
    assert not seen.is_asymptotic and not seen.is_at_rounding_floor


@pytest.mark.parametrize(("floor", "at_floor"), [(2.0, True), (1.99, False)])
def test_all_differences_within_32_floors_are_rounding(floor, at_floor):
    assert order_of((64.0, 16.0, 4.0), floor, 2).is_at_rounding_floor is at_floor


@pytest.mark.parametrize(
    ("orders", "declared", "shown"),
    [
        ((2.05, 1.95), 2, 1.95),
        ((2.15, 2.0), 2, None),
        ((2.0, 1.85), 2, None),
        ((2.0, 2.0, 2.5), 2, 2.0),  # shown once; the last one may be rounding
        ((3.0, 2.09, 2.08), 2, 2.08),
    ],
)
def test_two_consecutive_orders_near_the_declared_one_show_it(orders, declared, shown):
    sizes = 1e3 * 2.0 ** -np.cumsum([0.0, *orders])
    seen = order_of(sizes, 1e-12, declared)
    assert seen.is_asymptotic is (shown is not None)
    assert shown is None or seen.value == pytest.approx(shown, abs=1e-9)


@pytest.mark.parametrize("more", [(), (1.0,)])
def test_the_three_finest_orders_above_rounding_lead_somewhere(more):
    """4.55, 4.3, 4.15 are on their way to 4; differences below rounding do not count."""
    sizes = 1e3 * 2.0 ** -np.cumsum([0.0, 4.55, 4.3, 4.15, *more])
    seen = order_of(sizes, sizes[3] / 32 * 0.99, 4)
    assert seen.is_asymptotic and seen.value == pytest.approx(4.0, abs=1e-9)


def test_runs_that_agree_have_no_order():
    assert np.isnan(order_of((0.0, 4.0, 1.0), 1e-9, 2).orders).tolist() == [True, False]


def test_romberg_is_richardson_by_hand():
    """Errors h + h²: one column leaves h² alone, two leave nothing; the uncertainty is the column's gaps."""
    limit, hs = 5.0, (1.0, 0.5, 0.25, 0.125)
    ys = [np.full((1, 1, 1), limit + h + h**2) for h in hs]
    found = romberg(ys, (1, 2))
    assert found.eliminated_powers == 2 and found.y == pytest.approx(limit, abs=1e-14)
    first = romberg(ys, (1,))
    assert first.eliminated_powers == 1 and first.y == pytest.approx(limit - 0.25 * 0.125, abs=1e-14)
    # The row before: 5 − 0.5 · 0.25; the column before: 5 + 1/8 + 1/64.
    assert first.uncertainty == pytest.approx([0.125 + 1 / 64 + 0.25 * 0.125], abs=1e-14)
    bare = romberg(ys[:2], (1,))  # nothing to eliminate with: twice the last difference
    assert bare.eliminated_powers == 0 and bare.y == ys[1] and bare.uncertainty == pytest.approx([2 * 1.25])
    bare = romberg(ys, ())
    assert (
        bare.eliminated_powers == 0
        and bare.y == ys[3]
        and bare.uncertainty == pytest.approx([2 * (0.125 + 3 / 64)])
    )


def test_an_uncertainty_never_shrinks_with_time():
    ys = [np.array([0.0, 4.0, 1.0])[:, None, None] * h for h in (1.0, 0.5)]
    assert tightest_tolerance_limit(ys).uncertainty.tolist() == [0.0, 2.0, 2.0]
    assert tightest_tolerance_limit(ys).y is ys[-1] and tightest_tolerance_limit(ys).eliminated_powers == 0


def test_a_run_that_is_not_finite_in_between_leaves_the_smaller_steps_usable():
    ys = runs_with_differences(4.0, 1.0, 0.25)
    with pytest.raises(ValueError, match="fewer than two"):
        romberg([ys[0], np.full_like(ys[0], np.nan), ys[2]][:2], (1,))
    with pytest.raises(ValueError, match="fewer than two"):
        romberg([ys[0], np.full_like(ys[0], np.nan), ys[2], ys[3]], (1,))
    assert romberg([np.full_like(ys[0], np.inf), *ys[1:]], (2,)).y == romberg(ys[1:], (2,)).y
