"""Truth along trajectories: two methods of different kind and coordinates, and quad precision above them."""

import sys

import numpy as np
import pytest

from plumbline.model.datatypes import EngineFailure
from plumbline.model.invariants import attitude_error, motion_errors, motion_scales, position_error
from plumbline.processes.worker_pool import Limits, Task, WorkerPool
from plumbline.truth import ground_truth
from plumbline.truth import trajectory_truth as trajectory
from plumbline.truth.certified_state import certify_state
from plumbline.truth.closed_form import closed_form_motion
from plumbline.truth.taylor import load_heyoka, simulate_taylor
from plumbline.truth.trajectory_truth import (
    MAX_EXTENDED_PRECISION_BODIES,
    NOTES_RTOL,
    simulate_notes_form,
    trajectory_truth,
)
from tests.helpers.catalogue import catalogue_scenario, catalogue_scenarios
from tests.helpers.commands import run_python
from tests.helpers.nightly_tests import fast_are
from tests.helpers.random_chains import random_chain
from tests.helpers.requirements import needs_truth_tools

TIMES = np.arange(41) * 0.05
CATALOGUE = [s for s in catalogue_scenarios().values() if s.model.has_chain_joints]
BALL_JOINT_SCENARIOS = [s for s in CATALOGUE if not s.model.rods.any()]
FAST_BALLS = ("loaded-ball", "double-mass-ratio-1000", "chain-3-balls")  # loads, masses far apart, several
FAST_CLOSED_FORMS = ("planar-170", "lagrange-top", "spherical", "double-conical")  # one of each kind
CLOSED_FORM_SCENARIOS = [s for s in CATALOGUE if (closed := closed_form_motion(s)) and closed.amplitude == 0]


pytestmark = needs_truth_tools


# the yardstick


LONGER = [[1, 1], [0, 1, 0], [1, 0, 1], [0] * 5]


@pytest.mark.parametrize(
    "rods", [[0], [1], [0, 0], *(pytest.param(x, marks=pytest.mark.full) for x in LONGER)], ids=str
)
def test_extended_precision_agrees_with_quad(rods):
    """Each precision from quad, and the notes' form on its manifold, which shares no equation with them."""
    model, state = random_chain(1, rods, loads=True, drag=True)
    quad, extended, double = (
        simulate_taylor(model, state, TIMES, kind)[0] for kind in ("quad", "extended", "double")
    )
    fine, middle, coarse = (np.asarray(run.r, dtype=float) for run in (quad, extended, double))
    assert np.max(np.abs(middle - fine)) < 1e-15
    assert np.max(np.abs(coarse - fine)) < 1e-12
    assert np.max(np.abs(coarse - fine)) > 0, "double and quad gave the same bits: is quad really quad?"
    assert np.max(np.abs(simulate_notes_form(model, state, TIMES, NOTES_RTOL).r - fine)) < 1e-12


@pytest.mark.full
@pytest.mark.parametrize("scenario", CATALOGUE, ids=lambda s: s.name)
def test_the_uncertainty_covers_the_error_measured_in_higher_precision(scenario):
    """Quad for a body or two, extended precision above.

    Beyond the difference a bit per link: in double both methods add up a chain's links alike.
    """
    precision = "quad" if scenario.model.n <= 2 else "extended"
    fine, _ = simulate_taylor(scenario.model, scenario.state, TIMES, precision)
    closed = scenario in CLOSED_FORM_SCENARIOS
    exact = (*closed_form_motion(scenario)(TIMES), "") if closed else None
    truth = trajectory_truth(scenario.model, scenario.state, TIMES, exact)
    r, p = (np.asarray(y, dtype=float) for y in (fine.r, fine.p))
    size = scenario.model.n * 2.0**-52 * max(1.0, float(np.max(np.abs(r))))
    off = position_error(truth.trajectory.r, r)
    print(f"{scenario.name}: {np.max(off):.1e} m off, uncertain by {truth.uncertainty['position'][-1]:.1e} m")
    assert np.all(off <= 2 * truth.uncertainty["position"] + size)
    turned = attitude_error(truth.trajectory.p, p)
    assert np.all(turned <= 2 * truth.uncertainty["attitude"] + 4 * 2.0**-52)


# what the truth is, and how sure


LONG_BALLS = [s for s in BALL_JOINT_SCENARIOS if s.model.n >= 10]


@pytest.mark.parametrize(
    "scenario",
    [
        *fast_are(FAST_BALLS, [s for s in BALL_JOINT_SCENARIOS if s.model.n < 10]),
        *(pytest.param(s, id=s.name, marks=pytest.mark.full) for s in LONG_BALLS),
    ],
)
def test_the_uncertainty_is_below_a_picometre_on_balls(scenario):
    truth = trajectory_truth(scenario.model, scenario.state, TIMES)
    precision = "extended" if scenario.model.n <= MAX_EXTENDED_PRECISION_BODIES else "double"
    print(
        f"{scenario.name}: {truth.uncertainty['position'][-1]:.1e} m, "
        f"{truth.uncertainty['attitude'][-1]:.1e} rad"
    )
    assert f"Taylor's method in minimal coordinates and {precision} precision" in truth.method
    assert np.max(truth.uncertainty["position"]) < 1e-12
    assert np.all(np.diff(truth.uncertainty["position"]) >= 0)


@pytest.mark.parametrize("scenario", fast_are(FAST_CLOSED_FORMS, CLOSED_FORM_SCENARIOS))
def test_the_truth_agrees_with_the_closed_forms(scenario):
    r, p = closed_form_motion(scenario)(TIMES)
    truth = trajectory_truth(scenario.model, scenario.state, TIMES, (r, p, "a book"))
    assert truth.method.startswith("closed form: a book; uncertainty: its difference from Taylor's method")
    assert np.array_equal(truth.trajectory.r, r)
    assert np.max(truth.uncertainty["position"]) < 1e-14
    assert np.max(truth.uncertainty["attitude"]) < 3e-14
    speed = motion_scales(scenario.model, truth.trajectory, 1.0)["velocity"]
    # its quaternions may have the other sign
    usual = trajectory_truth(scenario.model, scenario.state, TIMES)
    for name in ("velocity", "angular_velocity"):
        assert motion_errors(truth.trajectory, usual.trajectory)[name][-1] < 1e-14 * speed
        assert np.array_equal(truth.uncertainty[name], usual.uncertainty[name])
        assert truth.uncertainty[name][-1] < 2e-13 * speed


def test_accelerations_along_a_run_agree_with_the_certified_ones():
    """ω′ and v of a mixed chain, differenced over a microsecond, against ball arithmetic at one state."""
    model, state = random_chain(4, [1, 0], loads=True, drag=True)
    h = 1e-4
    run, _ = simulate_taylor(model, state, np.array([0.0, h, 2 * h]), "extended")
    reported = certify_state(model, state).quantities
    for values, expected in ((run.omega, reported.angular_acceleration), (run.v, reported.acceleration)):
        slope = np.asarray((-3 * values[0] + 4 * values[1] - values[2]) / (2 * h), dtype=float)
        assert slope == pytest.approx(expected, abs=3e-6 * np.max(np.abs(expected)))


# a wrong truth is seen


@pytest.mark.parametrize(
    ("side", "field", "factor"),
    [
        ("simulate_taylor", "mass", np.array([1, 1 + 1e-11])),
        ("simulate_notes_form", "mass", np.array([1, 1 + 1e-11])),
        ("simulate_taylor", "gravity", 1 + 1e-11),
        ("simulate_taylor", "inertia", 1 + 1e-11 * np.diag([1.0, 0, 0])),
    ],
)
def test_a_parameter_error_of_1e_11_in_one_method_is_detected(monkeypatch, side, field, factor):
    scenario = catalogue_scenario("double-tumbling-balls")
    usual = ground_truth.motion_truth(scenario.model, scenario.state, TIMES, None)
    right = getattr(trajectory, side)

    def wrong(model, *rest):
        return right(model.changed(**{field: getattr(model, field) * factor}), *rest)

    monkeypatch.setattr(trajectory, side, wrong)
    planted = ground_truth.motion_truth(scenario.model, scenario.state, TIMES, None)
    assert planted.uncertainty["position"][-1] > 1e2 * usual.uncertainty["position"][-1]
    assert planted.method == usual.method and not usual.conflict
    assert planted.conflict.startswith(ground_truth.TRUTHS_DIFFER)


def test_an_error_in_a_closed_form_is_detected():
    scenario = catalogue_scenario("lagrange-top")
    r, p = closed_form_motion(scenario)(TIMES)
    truth = ground_truth.motion_truth(
        scenario.model, scenario.state, TIMES, (r * (1 + 1e-9), p, "a misprint")
    )
    assert truth.conflict.startswith(ground_truth.TRUTHS_DIFFER)


# where Taylor's method cannot be had


def check_fall_back(reason, **arguments):
    scenario = catalogue_scenario("double-tumbling-balls")
    truth = ground_truth.motion_truth(scenario.model, scenario.state, TIMES[:11], None, **arguments)
    assert truth.method == (
        "the notes' form by collocation; uncertainty: its difference from the same by DOP853, "
        f"no Taylor series: {reason}"
    )
    assert 0 < truth.uncertainty["position"][-1] < 1e-12


def test_long_chains_fall_back_to_the_notes_equations():
    check_fall_back("not used for more than 1 bodies", max_compiled_bodies=1)


def test_without_heyoka_dop853_is_the_second_method(monkeypatch):
    load_heyoka.cache_clear()
    monkeypatch.setitem(sys.modules, "heyoka", None)
    try:
        check_fall_back(
            "truth tools not installed (heyoka is missing: import of heyoka halted; None in sys.modules); "
            "`uv pip install -r locks/truth.lock` installs them"
        )
    finally:
        load_heyoka.cache_clear()


def test_the_closed_form_is_compared_without_heyoka_too():
    scenario = catalogue_scenario("lagrange-top")
    r, p = closed_form_motion(scenario)(TIMES)
    truth = trajectory_truth(scenario.model, scenario.state, TIMES, (r, p, "a book"), max_compiled_bodies=0)
    assert truth.method.startswith(
        "closed form: a book; uncertainty: its difference from the notes' form by collocation; "
        "of velocities that of the notes' form by collocation from the same by DOP853"
    )
    assert 0 < truth.uncertainty["position"][-1] < 1e-13


def test_the_truth_survives_a_failure_of_heyoka(monkeypatch):
    def fails(*arguments):
        raise EngineFailure("heyoka stopped: err_nf_state")

    monkeypatch.setattr(trajectory, "simulate_taylor", fails)
    check_fall_back("EngineFailure: heyoka stopped: err_nf_state")


def test_the_truth_of_ten_bodies_fits_into_a_worker():
    """Ten bodies compile and run within a quarter of a worker's address space."""
    scenario = catalogue_scenario("chain-10-rods")
    arguments = (scenario.model, scenario.state, TIMES)
    with WorkerPool(1, Limits(gigabytes=2.0)) as workers:
        (outcome,) = workers.run([Task("truth", trajectory_truth, arguments)])
    assert outcome.failure is None
    assert "Taylor" in outcome.value.method


def test_sympy_is_hidden_only_while_heyoka_is_imported():
    """It would take two seconds; later it must be there for who needs it."""
    program = (
        "from plumbline.truth import taylor; taylor.load_heyoka(); import sys; print('sympy' in sys.modules)"
    )
    done = run_python("-c", program, code=0)
    assert done.stdout.strip() == "False"
