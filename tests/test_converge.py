"""Orders and limits of ladders whose answer is known."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plumbline.converge import approached, ladder, observed_order, romberg
from plumbline.records import Integrator

TIMES = np.linspace(0, 2, 17)


def rungs(order: int, powers: tuple[int, ...], count: int = 6, size: float = 1.0) -> tuple[np.ndarray, list]:
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
    limit, ys = rungs(order, powers)
    seen = observed_order(ys, 1e-16, order)
    assert seen.asymptotic
    assert seen.value == pytest.approx(order, abs=0.1)
    found = romberg(ys, powers)
    error = np.max(np.linalg.norm(found.y - limit, axis=-1))
    assert error <= found.uncertainty[-1] + 1e-14
    assert error < 1e-6 * np.max(np.abs(ys[-1] - limit)) + 1e-14


def test_order_two_under_an_order_four_name_is_seen_as_two():
    _, ys = rungs(2, (2, 3, 4))
    seen = observed_order(ys, 1e-16, 4)
    assert seen.asymptotic
    assert seen.value == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize(
    ("last", "shown"),
    [
        ((4.55, 4.3, 4.15), 4.0),  # each halving of the step halves what is left
        ((2.1, 2.05, 2.02), 2.02),  # stays away from 4
        ((4.38, 4.5, 4.3), None),
        ((3.6, 3.7, 3.78), None),
        ((float("nan"), 4.3, 4.15), None),
        ((4.3, 4.15), None),
    ],
)
def test_what_three_orders_lead_to(last, shown):
    found = approached(last, 4)
    assert found == (None if shown is None else pytest.approx(shown))


def test_an_order_on_its_way_shows_nothing():
    limit, ys = rungs(1, (1, 2, 3))
    hs = [2.0**-k for k in range(5, 11)]
    creeping = [
        limit + (y - limit) / h * h ** (1.5 + 0.3 * k) for k, (y, h) in enumerate(zip(ys, hs, strict=True))
    ]
    assert not observed_order(creeping, 1e-16, 4).asymptotic


def test_wrong_powers_are_paid_for_in_uncertainty():
    limit, ys = rungs(1, (1, 2, 3))
    found = romberg(ys, (4, 5, 6))
    assert np.max(np.linalg.norm(found.y - limit, axis=-1)) <= found.uncertainty[-1]


def test_rounding_is_not_an_order():
    limit, _ = rungs(4, (4,))
    noise = np.random.default_rng(1).normal(size=(6, *limit.shape)) * 1e-16
    seen = observed_order([limit + n for n in noise], 1e-15, 4)
    assert seen.at_floor
    assert seen.value is None


def test_a_run_that_blew_up_is_a_point_of_the_study():
    limit, ys = rungs(4, (4, 5, 6))
    ys[0] = np.full_like(limit, np.nan)
    assert observed_order(ys, 1e-16, 4).value == pytest.approx(4, abs=0.1)
    assert np.max(np.abs(romberg(ys, (4, 5, 6)).y - limit)) < 1e-12


def test_nothing_finite_is_said():
    with pytest.raises(ValueError, match="fewer than two finite runs"):
        romberg([np.full((3, 1, 3), np.nan)] * 3, (1, 2))


@given(st.integers(1, 60), st.sampled_from([1, 2, 4]), st.floats(0.25, 100))
def test_ladders_halve_and_keep_four_rungs(bodies, order, duration):
    steps = ladder(Integrator("x", "step", order, (order,)), bodies, duration)
    assert len(steps) >= 4
    assert all(a == 2 * b for a, b in itertools.pairwise(steps))
