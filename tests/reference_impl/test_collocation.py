"""Collocation against DOP853 on the direct form, closed relations, and its own order."""

import warnings
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from numpy.polynomial.legendre import legval

from plumbline.model.kinematics import maximal_coordinates
from reference_impl import integrate as raw
from reference_impl.fast import collocation
from reference_impl.fast.chain_elimination import StructuredSystem
from reference_impl.fast.collocation import gauss_tables, integrate_collocation
from tests.helpers.notes_test_data import components
from tests.helpers.random_chains import in_other_units, random_chain

TIMES = np.linspace(0.0, 1.0, 11)


def make_stepper(forest, initial, table):
    """A stepper before its first step, with the scales of the initial values."""
    return collocation._Stepper(forest, initial, 1e-6, 1e-7, table, True, baumgarte=0.0)


def run(model, state, rtol, times=TIMES, **options):
    return integrate_collocation([model], *maximal_coordinates(state), times, rtol, **options)


@pytest.mark.parametrize("S", [4, 12, 20])
def test_tables_integrate_polynomials_exactly(S):
    """∫₀^c of x^k for k < S by A, ∫₀¹ for k < 2 S by b, and both integrals of the dense output."""
    table = gauss_tables(S)
    for k in range(S):
        values = table.c**k
        assert np.max(np.abs(table.A @ values - table.c ** (k + 1) / (k + 1))) < 4e-15
        tau = np.linspace(0, 1, 7)
        once, twice = table.mode_integrals(tau)
        assert np.max(np.abs(once @ table.node_to_mode @ values - tau ** (k + 1) / (k + 1))) < 4e-15
        assert (
            np.max(np.abs(twice @ table.node_to_mode @ values - tau ** (k + 2) / (k + 1) / (k + 2))) < 4e-15
        )
    for k in range(2 * S):
        assert abs(table.b @ table.c**k - 1 / (k + 1)) < 4e-15


@pytest.mark.parametrize("rods", [[False], [False, False], [True], [True, False], [False, True, False]])
def test_two_methods_share_their_digits(rods):
    """Direct form with DOP853, structured form with collocation: nothing in common but the notes."""
    model, state = random_chain(31, rods, loads=True, drag=True)
    dop = raw.integrate_dop853(model, *maximal_coordinates(state), TIMES, 1e-13)
    ours = run(model, state, 1e-13)
    assert np.max(np.abs(ours.r - dop.r)) < (2e-11 if any(rods) else 1e-12)
    assert np.max(np.abs(ours.p - dop.p)) < (2e-11 if any(rods) else 1e-12)
    assert np.array_equal(ours.r[0], state.r)
    assert ours.t is TIMES


@pytest.mark.parametrize("dense", [True, False])
def test_the_error_follows_the_tolerance(dense):
    model, state = random_chain(32, [False, False])
    truth = run(model, state, 1e-14)
    growth = 1e3  # of a local error by t = 1 s, at most (a perturbation of this motion grows 1e2-fold)
    for rtol in (1e-5, 1e-7, 1e-9, 1e-11):
        error = np.max(np.abs(run(model, state, rtol, dense=dense).r - truth.r))
        assert error < growth * rtol


def test_dense_output_inside_the_steps():
    """Samples between the ends of steps are as good as those at the ends."""
    model, state = random_chain(33, [False, True])
    fine = np.linspace(0, 0.5, 83)
    inside, ends = run(model, state, 1e-10, fine), run(model, state, 1e-13, fine, dense=False)
    assert inside.steps < 40 < ends.steps
    assert np.max(np.abs(inside.r - ends.r)) < 1e-8
    assert np.max(np.abs(inside.pdot - ends.pdot)) < 1e-7


def test_order_is_twice_the_nodes(monkeypatch):
    """S = 2 nodes with fixed steps: order 4 at the ends of steps."""
    monkeypatch.setattr(collocation, "USUAL_SWEEPS", 1e6)  # no step is cut for its sweeps
    model, state = random_chain(34, [False], rate=2.0)
    truth = run(model, state, 1e-14, TIMES[[0, -1]])
    error = []
    for count in (40, 80, 160):
        # A tolerance out of reach of the tail leaves the step at the distance of the times.
        times = np.linspace(0, 1, count + 1)
        fixed = run(model, state, 1e3, times, dense=False, nodes=2, sweep_tolerance=1e-15)
        assert fixed.steps == count
        error.append(np.max(np.abs(fixed.r[-1] - truth.r[-1])))
    orders = np.log2(np.array(error[:-1]) / error[1:])
    assert np.all(np.abs(orders - 4) < 0.1), orders


def test_a_batch_is_every_chain_alone():
    rng = np.random.default_rng(35)
    drawn = [random_chain(rng, rods) for rods in ([False], [True, False], [False, False, False], [True])]
    packed = maximal_coordinates(*(state for _, state in drawn))
    batch = integrate_collocation([model for model, _ in drawn], *packed, TIMES, 1e-12)
    at = 0
    for model, state in drawn:
        alone = run(model, state, 1e-12)
        assert np.max(np.abs(batch.r[:, at : at + model.n] - alone.r)) < 1e-9
        at += model.n


def test_stiffness_is_reported():
    model, state = random_chain(36, [False, False])
    stiff = model.changed(drag_force=model.mass * 3e3)
    assert "stiff" in run(stiff, state, 1e-6, TIMES[:2]).note
    assert run(model, state, 1e-6).note == ""


def test_rest_stays_at_rest():
    model, state = random_chain(37, [False])
    still = model.changed(gravity=np.zeros(3))
    resting = replace(state, omega=np.zeros((1, 3)), v=np.zeros((1, 3)))
    moved = run(still, resting, 1e-10)
    assert np.array_equal(moved.r[-1], state.r)
    assert np.array_equal(moved.p[-1], state.p)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ends = run(still, resting, 1e-10, dense=False)
    assert np.array_equal(ends.r[-1], state.r) and ends.steps == len(TIMES) - 1


@pytest.mark.parametrize("nodes", [4, collocation.DEFAULT_NODES])
@pytest.mark.parametrize("dense", [True, False])
@pytest.mark.parametrize("rods", [[False, False], [True, False]], ids=str)
def test_other_units_take_the_same_steps(rods, dense, nodes):
    """Lengths and times by powers of two, masses by powers of four (roots): every digit is the same.

    Of 4 nodes the tail sets the steps, of 16 the sweeps.
    """
    model, state = random_chain(39, rods, loads=True, drag=True)
    times = TIMES[:4]
    here = run(model, state, 1e-6, times, dense=dense, nodes=nodes)
    for length, mass, second in (
        (2.0**6, 1.0, 1.0),
        (1.0, 2.0**-8, 1.0),
        (1.0, 1.0, 2.0**5),
        (0.25, 4.0, 0.5),
    ):
        there = run(
            *in_other_units(model, state, length, mass, second),
            1e-6,
            times * second,
            dense=dense,
            nodes=nodes,
        )
        assert (there.steps, there.evaluations) == (here.steps, here.evaluations)
        assert np.array_equal(there.r, here.r * length)
        assert np.array_equal(there.p, here.p)
        assert np.array_equal(there.v, here.v * length / second)


class StepRecorder:
    """A run whose steps, and questions to the right-hand side, are written down."""

    def __init__(self, monkeypatch):
        self.steps: list[tuple[float, int, bool, bool]] = []  # h, sweeps, made, limited by the sweeps
        self.evaluations = 0
        step, acceleration = collocation._Stepper.try_step, StructuredSystem.acceleration

        def noted(stepper, h):
            before = stepper.sweeps
            made = step(stepper, h)
            self.steps.append((h, stepper.sweeps - before, *made))
            return made

        def counted(forest, *args):
            self.evaluations += 1
            return acceleration(forest, *args)

        monkeypatch.setattr(collocation._Stepper, "try_step", noted)
        monkeypatch.setattr(StructuredSystem, "acceleration", counted)


def test_a_step_begins_with_the_last_one_s_polynomial_up_to_its_smallest_term(
    monkeypatch,
):
    model, state = random_chain(40, [False, True], rate=4.0)
    guess, cuts = collocation._Stepper._extrapolated_acceleration, []

    def checked(stepper, ratio):
        ahead = 1 + 2 * ratio * stepper.table.c  # −1 … 1 is the last step
        modes = stepper.modes
        grown = [np.max(np.abs(modes[:, k]) / stepper.v_size) * legval(ahead[-1], np.eye(k + 1)[k])
                 for k in range(modes.shape[1])]  # fmt: skip
        last = min(range(1, len(grown)), key=lambda k: grown[k])
        cuts.append(len(grown) - 1 - last)
        found = guess(stepper, ratio)
        by_hand = sum(
            np.multiply.outer(legval(ahead, np.eye(k + 1)[k]), modes[:, k]) for k in range(last + 1)
        )
        # terms of up to 16 times their sum, in a dozen roundings each
        limit = 16 * 12 * 2.0**-52 * np.max(np.abs(found))
        np.testing.assert_allclose(found, np.moveaxis(by_hand, 0, 1), rtol=0, atol=limit)
        return found

    monkeypatch.setattr(collocation._Stepper, "_extrapolated_acceleration", checked)
    run(model, state, 1e-10, np.array([0.0, 2.0]))
    assert len(cuts) > 10 and min(cuts) == 0 < max(cuts)


@pytest.mark.parametrize("rods, rtol", [([False, False], 1e-3), ([False, False], 1e-12), ([True], 1e-8)])
def test_a_run_reports_its_steps(rods, rtol, monkeypatch):
    model, state = random_chain(40, rods, rate=4.0)
    watched = StepRecorder(monkeypatch)
    done = run(model, state, rtol, np.array([0.0, 0.7, 2.1]))
    made = np.array([h for h, _, ok, _ in watched.steps if ok])
    assert (done.steps, done.rejected_steps) == (len(made), len(watched.steps) - len(made))
    assert done.stiff_steps == sum(ok and slow for _, _, ok, slow in watched.steps)
    assert done.evaluations == sum(sweeps for _, sweeps, _, _ in watched.steps)
    assert watched.evaluations == done.evaluations + 2  # for the sizes, and the first guess
    assert abs(np.sum(made) - 2.1) < 1e-13
    assert np.all(made[1:] <= made[:-1] * (1.6 + 1e-12)), "a step grows to 1.6 times the last at most"
    assert np.min(made[:-1]) > 0.01 * np.max(made), "no crumbs"


def test_steps_that_take_many_sweeps_are_followed_by_shorter_ones(monkeypatch):
    """Strong drag: the sweeps decide, so the step is cut before it would have to be repeated."""
    model, state = random_chain(36, [False, False])
    watched = StepRecorder(monkeypatch)
    done = run(model.changed(drag_force=model.mass * 3e3), state, 1e-6, TIMES[:2])
    pairs = zip(watched.steps[:-2], watched.steps[1:-1], strict=True)
    many = [(h, sweeps, after) for (h, sweeps, made, _), (after, *_) in pairs
            if made and sweeps > collocation.USUAL_SWEEPS]  # fmt: skip
    assert len(many) >= 10
    for h, sweeps, after in many:
        # the next step is √(USUAL_SWEEPS / sweeps) times as long, 0.93 at most; three roundings of it
        assert after <= h * (collocation.USUAL_SWEEPS / sweeps) ** 0.5 * (1 + 3 * 2.0**-53), (
            h,
            sweeps,
            after,
        )
    assert done.rejected_steps < 0.1 * done.steps
    assert max(sweeps for _, sweeps, made, _ in watched.steps if made) <= collocation.MAX_SWEEPS


@pytest.mark.parametrize("dense", [True, False])
def test_the_last_step_ends_where_it_should(dense):
    """t + (end − t) is not always the end in double precision; what is missing is no step of its own."""
    model, state = random_chain(41, [False])
    drawn = np.random.default_rng(41).uniform([1e-4, 1e-3], [5e-4, 2e-3], (2000, 2))
    missed = [pair for pair in drawn if pair[0] + (pair[1] - pair[0]) != pair[1]]
    assert len(missed) > 5
    for pair in missed[:6]:
        assert run(model, state, 1e-4, pair, dense=dense).steps == 1


def test_a_step_that_vanishes_is_an_error():
    """Drag of 1e13/s holds the sweeps to steps of 1e-13 s: nothing beside 1000 s, but much of 1e-12 s."""
    model, state = random_chain(42, [False])
    model = model.changed(drag_force=1e13 * model.mass)
    with pytest.raises(ArithmeticError, match=r"stopped at t = 0\.0 s: the step vanishes"):
        run(model, state, 1e-6, np.array([0.0, 1e3]))
    assert run(model, state, 1e-6, np.array([0.0, 1e-12])).steps > 2


@pytest.mark.parametrize("ratio", [0.3, 1.0, 1.6])
def test_the_last_steps_polynomial_goes_on_in_the_next(ratio):
    """Any polynomial of degree < S, at the nodes of a step ``ratio`` times as long."""
    table = gauss_tables(8)
    for k in range(8):
        found = table.extrapolation_matrix(ratio) @ table.node_to_mode @ table.c**k
        # at 1 + 2 · 1.6, outside of its interval, Legendre's polynomial of degree 7 is 6e5: eight terms of ε
        np.testing.assert_allclose(found, (1 + ratio * table.c) ** k, rtol=8 * 6e5 * 2.0**-52)


def test_a_batch_has_every_chains_own_sizes():
    """A pendulum of a millimetre beside one of a metre keeps its own scales, and sets the first step."""
    drawn = [random_chain(43, [False] * n) for n in (2, 3, 1)]
    drawn[1] = in_other_units(*drawn[1], 1e-3, 1e-6, 1e-2)

    def sized(models):
        forest = StructuredSystem([model for model, _ in models])
        return make_stepper(forest, maximal_coordinates(*(s for _, s in models)), gauss_tables(4))

    together, alone = sized(drawn), [sized([one]) for one in drawn]
    for name in ("q_size", "v_size"):
        # sums of a batch may be taken in another order; a neighbour's size would be orders of magnitude off
        np.testing.assert_allclose(
            getattr(together, name), np.hstack([getattr(one, name) for one in alone]), rtol=1e-9
        )
    assert together.h == pytest.approx(min(one.h for one in alone), rel=1e-9)


@pytest.mark.parametrize("rods", [[False, False], [True, False]], ids=str)
def test_open_joints_close_at_the_stabilisation_rate(rods):
    """C̈ + 2 a Ċ + a² C = 0 has (C + (Ċ + a C) t) e^{−a t}; a projection leaves nothing at all."""
    model, state = random_chain(44, rods)
    opened = replace(state, r=state.r + np.array([[0.01, 0, -0.02], [0.03, 0.01, 0]]))
    forest, times, a = StructuredSystem([model]), np.array([0.0, 0.3, 2.0]), 3.0

    def left(found):
        samples = zip(found.r, found.p, found.v, found.pdot, strict=True)
        return np.array([forest.constraints(*components(*sample)) for sample in samples])

    C = left(run(model, opened, 1e-9, times, baumgarte=a))
    (C_0, rate_0), t = C[0], times[:, None, None]
    reported = (C_0 + (rate_0 + a * C_0) * t) * np.exp(-a * t)
    assert np.max(np.abs(C_0)) > 0.01
    growth = 1e3  # of local errors of 1e-9, as above
    np.testing.assert_allclose(C[:, 0], reported, rtol=0, atol=growth * 1e-9)
    # Numbers of size 1, some roundings each.
    assert np.max(np.abs(left(run(model, opened, 1e-9, times, project=True))[1:, 0])) < 1e-14


def test_close_times_are_no_vanishing_steps():
    model, state = random_chain(44, [False])
    times = np.array([0.0, 0.1, 0.1 + 5e-15])
    done = run(model, state, 1e-6, times, dense=False)
    assert np.max(np.abs(done.r[2] - done.r[1])) < 1e-13


def test_sweeps_end_at_what_rounding_leaves():
    """No sweep tolerance at all: the sweeps still end, and the motion is as good as double precision."""
    model, state = random_chain(45, [False, True], loads=True, drag=True)
    usual, quiet = run(model, state, 1e-12), run(model, state, 1e-12, sweep_tolerance=0.0)
    assert quiet.rejected_steps <= 1
    assert np.max(np.abs(quiet.r - usual.r)) < 1e-10


def test_a_step_is_made_where_its_error_is_within_the_tolerance(monkeypatch):
    """Longer and longer first steps: good ones, then too long for the tolerance, then for the sweeps."""
    model, state = random_chain(46, [False])
    tails, tail = [], collocation._Stepper._error_over_tolerance

    def noted(stepper, a, h):
        tails.append(tail(stepper, a, h))
        return tails[-1]

    monkeypatch.setattr(collocation._Stepper, "_error_over_tolerance", noted)
    forest, found = StructuredSystem([model]), []
    for h in np.geomspace(0.01, 1.0, 60):
        stepper = make_stepper(forest, maximal_coordinates(state), gauss_tables(8))
        tails.clear()
        made, slow = stepper.try_step(h)
        assert made == (bool(tails) and tails[0] <= 1)
        assert made or slow == (not tails)
        assert made or 0.3 * h <= stepper.h < h
        found.append((made, slow))
    assert {(True, False), (False, False), (False, True)} <= set(found)


def test_the_tolerance_sets_the_steps(monkeypatch):
    """Of few nodes the next step's error is foreseen; of many, what takes the usual sweeps is kept."""
    model, state = random_chain(47, [False, False])
    done = run(model, state, 1e-6, np.array([0.0, 1.0]), nodes=4)
    assert done.rejected_steps < 0.1 * done.steps and done.stiff_steps == 0
    watched = StepRecorder(monkeypatch)
    run(model, state, 1e-12, np.array([0.0, 2.0]))
    for (h, sweeps, made, _), (after, *_) in zip(watched.steps[:-2], watched.steps[1:-1], strict=True):
        assert not made or sweeps > collocation.USUAL_SWEEPS or after > 0.95 * h


def test_no_crumb_before_a_time(monkeypatch):
    """Steps that end on the times asked for share the way to each."""
    model, state = random_chain(48, [False])
    watched, times = StepRecorder(monkeypatch), np.linspace(0, 1.5, 8)
    run(model, state, 1e-9, times, dense=False)
    h = np.array([h for h, _, made, _ in watched.steps if made])
    ends = np.searchsorted(np.cumsum(h), times[1:] - 1e-9)  # the last step of each interval
    assert np.all(h[ends[1:]] > 0.4 * h[ends[1:] - 1])


def test_a_thousand_steps_add_up_to_the_last_digit():
    """Constant parts: the compensated sums are the exact ones but for one rounding."""
    model, state = random_chain(49, [False])
    forest, table = StructuredSystem([model]), gauss_tables(4)
    for push in (0.0, 0.3):
        stepper = make_stepper(forest, maximal_coordinates(state), table)
        first, a, h = (stepper.q, stepper.v), np.full((7, 4, 1), push), 0.1
        stepper.new_modes = table.node_to_mode @ a
        stepper._advance(a, h)
        part = h * first[1] if push == 0 else h * np.einsum("j,ijm->im", table.b, a)
        for _ in range(999):
            stepper._advance(a, h)
        begun, ended = (first[0], stepper.q) if push == 0 else (first[1], stepper.v)
        exact = [
            float(Fraction(x) + 1000 * Fraction(dx)) for x, dx in zip(begun.flat, part.flat, strict=True)
        ]
        # a compensated sum is off by the last rounding or two, 2⁻⁵³ each, plain ones by up to 500 ε
        np.testing.assert_allclose(ended.ravel(), exact, rtol=4e-16, atol=1e-17)
