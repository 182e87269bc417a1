"""What decides the rows about motion, on refinement studies whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.engine_calls import RefinementRun, RefinementStudy
from plumbline.engines.no_answer import NoAnswer
from plumbline.judging.refinement_analysis import RefinementAnalysis
from plumbline.judging.rows import RowContext
from plumbline.judging.trajectory_level import judge_trajectory, pose_columns
from plumbline.measurements.order_and_limit import romberg
from plumbline.measurements.refinement_study import ROUNDING_PER_STEP
from plumbline.model.datatypes import Integrator, Trajectory
from plumbline.model.invariants import compute_invariants, motion_samples
from plumbline.model.kinematics import (
    angular_velocity,
    quaternion_product,
    rotate_vectors,
    rotation_matrix,
    stretched_length,
)
from plumbline.truth.ground_truth import RUN_ROUNDING, MotionTruth
from tests.helpers import pendulums

TIMES = np.linspace(0, 2, 17)
MODEL = pendulums.make_model("b")
LENGTH = float(np.sum(stretched_length(MODEL)))  # m, as of every truth
TRUE_TRAJECTORY = pendulums.reference_trajectory(
    MODEL, pendulums.state_from_seed(MODEL, seed=2, rate=0.5), TIMES
)
WHO = RowContext("s", "f", "mujoco", "MuJoCo", "4")
METHOD = Integrator("Heun", "step", 2, (2, 3, 4))
STEPS = tuple(2.0**-k for k in range(5, 11))
LIMITS = {
    "position_limit": "m", "attitude_limit": "rad",
    "velocity_limit": "m/s", "angular_velocity_limit": "rad/s",
}  # fmt: skip
DIRECTION = np.array([2.0, -1.0, 2.0]) / 3
ROUNDED = 1e-3  # of uncertainties of 1e-12: Romberg's own is a rounding of positions of 0.25 m, some 1e-16


UNCERTAINTY = {"position": 1e-12, "attitude": 2e-12, "velocity": 3e-12, "angular_velocity": 4e-12}
DETECTABLE = {"position": 1e-6, "attitude": 2e-6, "velocity": 3e-6, "angular_velocity": 4e-6}


def of_each(sizes, **changes):
    """(17,) of each quantity; the changes in place of some."""
    return {name: size * np.ones(17) for name, size in (sizes | changes).items()}


def make_truth(horizon=2.0, **changes):
    """A truth that is compared with up to ``horizon``, whatever its uncertainty and growth."""
    made = type("MadeTruth", (MotionTruth,), {"horizon": horizon})
    held = made(
        TRUE_TRAJECTORY,
        of_each(UNCERTAINTY),
        1 + TIMES,
        of_each(DETECTABLE),
        length=LENGTH,
        method="made",
    )
    return replace(held, **changes)


def trajectory_with_error(error, attitude=None, speed=None, steps=100):
    """The truth, off by ``error`` t m along one direction, ``attitude`` t rad and ``speed`` t m/s."""
    attitude, speed = (error if x is None else x for x in (attitude, speed))
    off = TIMES[:, None, None] * DIRECTION
    half = attitude * TIMES / 2
    turn = np.stack([np.cos(half), *(np.sin(half) * DIRECTION[:, None])], -1)[:, None]
    p = quaternion_product(TRUE_TRAJECTORY.p, turn)
    return Trajectory(
        TIMES,
        TRUE_TRAJECTORY.r + error * off,
        p,
        TRUE_TRAJECTORY.v + speed * off,
        TRUE_TRAJECTORY.pdot,
        steps,
    )


def refinement_study(errors=None, **more):
    """A study with error c h² and cost 1, 2, 3, … s; or with these errors."""
    errors = [0.01 * h**2 for h in STEPS] if errors is None else errors
    runs = [
        RefinementRun(h, trajectory_with_error(e, **more), i + 1.0)
        for i, (h, e) in enumerate(zip(STEPS, errors, strict=True))
    ]
    return RefinementStudy(runs)


def judged_rows(study=None, method=METHOD, model=MODEL, **changes):
    found = judge_trajectory(WHO, model, make_truth(**changes), method, study or refinement_study())
    return {row.quantity: row for row in found.rows}


def analysis(study=None, method=METHOD, model=MODEL, **changes):
    return RefinementAnalysis(
        WHO, model, make_truth(**changes), method, (study or refinement_study()).runs, 2.0
    )


@pytest.mark.parametrize("kind", ["step", "tolerance"])
def test_coarse_runs_that_failed_are_named(kind):
    study = refinement_study([1e-13] * len(STEPS) if kind == "tolerance" else None)
    lost = [
        replace(run, trajectory=None, failure=NoAnswer("it broke", is_refusal=False))
        for run in study.runs[:2]
    ]
    found = judged_rows(RefinementStudy([*lost, *study.runs[2:]]), replace(METHOD, kind=kind))
    said = f"; 2 of {len(STEPS)} runs failed, the finest of these at {STEPS[1]:g}: it broke"
    assert said in found["position_limit"].derivation and found["position_limit"].verdict == "agrees"
    assert kind == "tolerance" or found["order"].reason.endswith(said)


def test_a_sound_study_agrees_in_everything_and_states_what_it_measured():
    found = judged_rows()
    assert list(found) == [
        "order", "position_limit", "position", "attitude_limit", "attitude",
        "velocity_limit", "angular_velocity_limit",
        "energy_drift", "momentum_drift", "joint_gap", "gap_rate", "norm_drift",
    ]  # fmt: skip
    information = {quantity for quantity, row in found.items() if row.verdict == "information"}
    assert information == {"position", "attitude"}, "the limits imply them"
    assert {found[quantity].verdict for quantity in found.keys() - information} == {"agrees"}
    assert {row.integrator for row in found.values()} == {"Heun"}
    units = ["1", "m", "m", "rad", "rad", "m/s", "rad/s", "J", "kg m²/s", "m", "m/s", "1"]
    assert [row.unit for row in found.values()] == units
    assert [row.level for row in found.values()] == ["trajectory"] * 7 + ["invariants"] * 5
    assert {row.cpu_time for row in found.values()} == {21.0}
    order = found["order"]
    assert (order.value, order.order) == (pytest.approx(0, abs=1e-6), pytest.approx(2, abs=1e-6))
    assert (order.tolerance, order.declared_order, order.compared_until) == (0.1, 2, 2.0)
    assert (order.level, order.unit) == ("trajectory", "1")
    assert "steps 0.03125 … 0.000976562 s, t ≤ 2 s" in order.reason and "observed order 2.00" in order.reason
    assert "2.00, 2.00, 2.00, 2.00" in order.derivation
    rounding = RUN_ROUNDING * 3.0 * LENGTH
    limit, own = found["position_limit"], found["position"]
    assert limit.value < 1e-15 and limit.compared_until == 2.0 and limit.unit == own.unit == "m"
    assert limit.uncertainty == pytest.approx(1e-12, rel=ROUNDED, abs=0)
    assert limit.tolerance == pytest.approx(1e-12 + rounding, rel=ROUNDED, abs=0)
    assert limit.ratio == limit.value / limit.tolerance and limit.extra == {"visible": 1e-6, "growth": 3.0}
    assert own.value == pytest.approx(0.02 * STEPS[-1] ** 2, rel=1e-6)
    assert own.tolerance == pytest.approx(own.value + limit.tolerance, rel=1e-6)
    assert own.ratio == own.value / own.tolerance < 1 and own.extra == {"resolution": STEPS[-1]}
    assert limit.reason.startswith("position limit within") and "at step 0.000976562" in own.reason
    turned = found["attitude"]
    assert turned.value == pytest.approx(0.02 * STEPS[-1] ** 2, rel=1e-4) and turned.unit == "rad"
    assert found["attitude_limit"].tolerance == pytest.approx(
        2e-12 + 2 * RUN_ROUNDING * 3.0, rel=ROUNDED, abs=0
    )
    assert found["attitude_limit"].extra["visible"] == 2e-6
    speed = analysis().invariant_scales["gap_rate"]
    for name, size, scale in (("velocity", 3, speed), ("angular_velocity", 4, 2 * speed / LENGTH)):
        rate = found[f"{name}_limit"]
        allowed = 1e-12 * size + RUN_ROUNDING * 3.0 * scale
        assert rate.tolerance == pytest.approx(allowed, rel=ROUNDED, abs=0) and rate.value < 1e-3 * allowed
        assert rate.extra["visible"] == pytest.approx(size * 1e-6)
    assert "powers of h from (2, 3, 4) eliminated over 6 steps" in limit.derivation
    assert "a mistake of 0.0001 in a parameter changes it by 1e-06" in limit.derivation


@pytest.mark.parametrize(("until", "numbers"), [(2.0, [17, 9, 5, 3]), (9.0, [17, 9, 5, 3]), (1.0, [9, 5, 3])])
def test_windows_halve_down_to_an_eighth_with_three_samples_at_least(until, numbers):
    assert analysis().window_lengths(until) == numbers
    assert analysis().window_lengths(0.3) == [3]
    assert analysis().window_lengths(0.1) == [3]
    dense = analysis()
    dense.truth = make_truth(trajectory=replace(TRUE_TRAJECTORY, t=np.linspace(0, 2, 65)))
    assert dense.window_lengths(2.0) == [65, 33, 17, 9]


def test_an_order_that_stays_away_disagrees_and_one_on_its_way_decides_nothing():
    one = judged_rows(
        refinement_study([0.01 * h for h in STEPS]), replace(METHOD, error_exponents=(1, 2, 3))
    )["order"]
    assert (one.verdict, one.order, one.value) == ("disagrees", pytest.approx(1), pytest.approx(1))
    lost = judged_rows(refinement_study([0.01, 0.003, 0.002, 0.0003, 0.0002, 0.00001]))["order"]
    assert lost.verdict == "unresolved" and lost.reason.startswith("not in the asymptotic range: orders ")
    assert lost.compared_until == 2.0, "the longest window, where none shows an order"
    floor = judged_rows(refinement_study([1e-16, 0, 1e-16, 0, 1e-16, 0]))["order"]
    assert (floor.verdict, floor.order, floor.value) == ("information", None, None)
    assert "not observable" in floor.reason and floor.compared_until == 2.0


@pytest.mark.parametrize(("solver_rtol", "verdict"), [(1e-9, "information"), (1e-3, "unresolved")])
def test_a_solver_that_hides_mistakes_hides_no_order(solver_rtol, verdict):
    """An order 1 of a method whose order is 2, below what the engine says of its solver."""
    study = refinement_study([1e-9 * h for h in STEPS])
    for index, run in enumerate(study.runs):
        study.runs[index] = replace(run, trajectory=replace(run.trajectory, solver_rtol=solver_rtol))
    rows = judged_rows(study)
    assert rows["order"].verdict == verdict
    assert {rows[name].verdict for name in LIMITS} == {"agrees" if verdict == "information" else "unresolved"}


@pytest.mark.parametrize(("factor", "until"), [(0.98, 2.0), (1.02, 1.0)])
def test_differences_within_four_times_the_rounding_have_no_order(factor, until):
    """32 floors of an eighth of what rounding has grown to; over half the time they are smaller still."""
    held = analysis()
    per_error = 2.0 * np.hypot(1 / held.truth.length, 1 / held.invariant_scales["gap_rate"])
    error = factor * 4 * RUN_ROUNDING * 3.0 / per_error
    found = analysis(refinement_study([error * x for x in (1, 0, 0.6, 0.1, 0.9, 0)]))
    assert found.observed.is_at_rounding_floor and found.observed_until == until


def test_order_is_of_positions_and_velocities_over_their_scales():
    """Positions without error and velocities of order 1: an order 1, not a rounding floor."""
    made = [RefinementRun(h, trajectory_with_error(0.0, 0.0, 0.01 * h)) for h in STEPS]
    held = analysis(RefinementStudy(made))
    assert held.observed.value == pytest.approx(1)
    sizes = held.truth.length, held.invariant_scales["gap_rate"]
    expected = np.concatenate([TRUE_TRAJECTORY.r / sizes[0], made[0].trajectory.v / sizes[1]], -1)
    np.testing.assert_allclose(held.scaled_states[0], expected, rtol=1e-13)


def test_a_limit_elsewhere_disagrees_only_where_the_study_shows_its_order():
    shifted = [1e-9 + 0.01 * h**2 for h in STEPS]
    found = judged_rows(refinement_study(shifted))
    limit = found["position_limit"]
    assert limit.verdict == found["attitude_limit"].verdict == "disagrees"
    assert found["position"].verdict == "information", "the limit is reported once"
    assert limit.value == pytest.approx(2e-9, rel=1e-6) and limit.compared_until == 2.0
    assert f"{limit.value / limit.tolerance:.3g} times the uncertainties" in limit.reason
    assert limit.ratio == pytest.approx(limit.value / limit.tolerance)
    irregular = [1e-9 + e for e in (0.01, 0.003, 0.002, 0.0003, 0.0002, 0.0002)]
    lost = judged_rows(refinement_study(irregular))["position_limit"]
    assert lost.verdict == "unresolved"
    tight = judged_rows(refinement_study([1e-9] * 6))["position_limit"]  # at the floor at every step: trusted
    assert tight.verdict == "disagrees"


@pytest.mark.parametrize("quantity", ["velocity", "angular_velocity"])
def test_velocities_that_are_off_alone_are_reported(quantity):
    """Sampled rates × (1 + 1e-7) after 1 s: a motion that is right in every other respect."""
    factors = 1 + 1e-7 * (TIMES > 1)[:, None, None]
    name = {"velocity": "v", "angular_velocity": "pdot"}[quantity]
    study = refinement_study()
    for index, run in enumerate(study.runs):
        scaled = getattr(run.trajectory, name) * factors
        study.runs[index] = replace(run, trajectory=replace(run.trajectory, **{name: scaled}))
    found = judge_trajectory(WHO, MODEL, make_truth(), METHOD, study)
    rows = {row.quantity: row for row in found.rows}
    assert {name for name in LIMITS if rows[name].verdict == "disagrees"} == {f"{quantity}_limit"}
    row, true = rows[f"{quantity}_limit"], motion_samples(TRUE_TRAJECTORY)[quantity]
    largest = 1e-7 * np.max(np.linalg.norm(true[TIMES > 1], axis=-1))
    assert row.value == pytest.approx(largest, rel=1e-3) and row.compared_until == 2.0
    np.testing.assert_allclose(found.deviations[row.key].vectors, (factors - 1) * true, atol=1e-3 * largest)


def test_a_shorter_window_may_tell_where_the_long_one_cannot():
    late = np.where(TIMES > 1, 1e-3, 1e-12)
    found = judged_rows(uncertainty=of_each(UNCERTAINTY, position=late))
    limit = found["position_limit"]
    assert (limit.verdict, limit.compared_until) == ("agrees", 1.0)
    assert limit.extra["growth"] == 2.0 and "up to t = 1 s" in limit.reason
    assert found["position"].value == pytest.approx(0.01 * STEPS[-1] ** 2, rel=1e-6)
    assert found["position"].tolerance == pytest.approx(0.01 * STEPS[-1] ** 2 + limit.tolerance, rel=1e-6)
    assert found["attitude_limit"].compared_until == 2.0
    both = judged_rows(detectable=of_each(DETECTABLE, position=1e-14))
    blind = both["position_limit"]
    assert both["position"].verdict == "information"
    assert (blind.verdict, blind.compared_until) == ("unresolved", 2.0)
    assert "is above the 1e-14 m that a mistake of 0.0001 would make" in blind.reason
    short = judged_rows(horizon=0.5)["position_limit"]
    assert short.compared_until == 0.5


KICKS = (0.05, -0.02, 0.08, -0.06, 0.03, -0.04)


@pytest.mark.parametrize(("sizes", "verdict"), [(KICKS, "unresolved"), (STEPS, "agrees")])
def test_a_half_window_does_not_overrule_errors_that_do_not_fall(sizes, verdict):
    """Right to 1 s, then off by so much in each run."""
    late = (TIMES > 1)[:, None, None]
    study = refinement_study()
    for index, (run, size) in enumerate(zip(study.runs, sizes, strict=True)):
        right = run.trajectory
        off = replace(right, r=right.r + late * size * DIRECTION, v=right.v * (1 + late * size))
        study.runs[index] = replace(run, trajectory=off)
    rows = judged_rows(study)
    for name in ("position_limit", "velocity_limit", "energy_drift", "joint_gap", "gap_rate"):
        assert rows[name].verdict == verdict and rows[name].compared_until == (
            2.0 if verdict != "agrees" else 1.0
        )


def test_the_border_is_the_tolerance_and_the_tolerance_what_is_visible():
    tolerance = judged_rows()["position_limit"].tolerance
    for shift, verdict in ((0.95 * tolerance / 2, "agrees"), (1.05 * tolerance / 2, "disagrees")):
        assert (
            judged_rows(refinement_study([shift + 0.01 * h**2 for h in STEPS]))["position_limit"].verdict
            == verdict
        )
    for visible, horizon in ((1.01 * tolerance, 2.0), (0.99 * tolerance, 1.0)):  # rounding grows with time
        assert (
            judged_rows(detectable=of_each(DETECTABLE, position=visible))["position_limit"].compared_until
            == horizon
        )


def test_runs_that_did_not_stay_finite_are_points_of_the_study():
    some = refinement_study()
    some.runs[0] = replace(some.runs[0], trajectory=None, failure=NoAnswer("blew up", False))
    found = judge_trajectory(WHO, MODEL, make_truth(), METHOD, some)
    assert {row.verdict for row in found.rows} == {"agrees", "information"}
    table = dict(found.tables)["convergence"]
    assert table["steps"][:3] == [0, 0, 100] and np.isnan(table["error"][0])
    for index in range(5):
        some.runs[index] = replace(some.runs[index], trajectory=None)
    alone = judge_trajectory(WHO, MODEL, make_truth(), METHOD, some)
    reported = {row.quantity: row for row in alone.rows}
    for name, unit in LIMITS.items():
        assert reported[name].verdict == "unresolved" and "fewer than two" in reported[name].reason
        assert (reported[name].level, reported[name].integrator) == ("trajectory", "Heun")
        assert reported[name].unit == unit
    assert "position" not in reported
    curves = dict(alone.tables)["curves"]
    assert np.all(np.isnan([curves["limit_error"], curves["tolerance"]]))
    some.runs[-1] = replace(some.runs[-1], trajectory=None, failure=NoAnswer("NaN at 1 s", False))
    (lost,) = judge_trajectory(WHO, MODEL, make_truth(), METHOD, some).rows
    assert (lost.quantity, lost.verdict, lost.integrator) == ("all", "failed", "Heun")
    assert lost.reason == "at the finest resolution 0.000976562: NaN at 1 s"
    (never,) = judge_trajectory(
        WHO, MODEL, make_truth(), METHOD, RefinementStudy([], NoAnswer("no drag here", True))
    ).rows
    assert (never.quantity, never.verdict, never.reason) == ("all", "unsupported", "no drag here")
    assert (lost.level, never.level, never.integrator) == ("trajectory", "trajectory", "Heun")


def test_a_method_with_a_tolerance_has_no_order_and_its_tightest_run_is_the_limit():
    method = Integrator("DOP853", "tolerance", 8)
    found = judged_rows(refinement_study([1e-6, 1e-8, 1e-10, 1e-11, 2e-12, 1e-12]), method)
    assert "order" not in found
    limit = found["position_limit"]
    assert limit.verdict == "agrees" and "tightest of 6 tolerances" in limit.derivation
    assert limit.value == pytest.approx(2e-12, rel=ROUNDED, abs=0)
    assert limit.uncertainty == pytest.approx(1e-12 + 2e-12, rel=ROUNDED, abs=0)
    assert found["attitude_limit"].uncertainty == pytest.approx(2e-12 + 2e-12, rel=ROUNDED, abs=0)
    assert found["position"].reason.startswith("position at tolerance 0.000976562 is 2e-12 m")
    irregular = (1e-7, 5e-8, 4.9e-8, 1e-9, 9e-10, 0)  # no order of any kind
    off = judged_rows(refinement_study([1e-6 + e for e in irregular]), method)["position_limit"]
    assert off.verdict == "disagrees", "trusted without any order"
    still = trajectory_with_error(0.0)
    tight = RefinementStudy([RefinementRun(rtol, still) for rtol in (1e-5, 1e-7)])
    floor = judged_rows(tight, method)["energy_drift"]
    assert floor.tolerance == pytest.approx(
        (ROUNDING_PER_STEP + 1e-7) * 100 * floor.extra["scale"], rel=1e-12
    )
    constant = judged_rows(refinement_study([0.5 + e for e in (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 0)]), method)[
        "joint_gap"
    ]
    assert constant.verdict == "disagrees", "trusted without any order"


def test_an_implicit_solver_walks_at_random():
    study = refinement_study()
    finest = study.runs[-1]
    study.runs[-1] = replace(finest, trajectory=replace(finest.trajectory, solver_rtol=1e-11))
    held = analysis(study)
    np.testing.assert_allclose(held.rounding, (RUN_ROUNDING + 1e-10) * (1 + TIMES), rtol=1e-12)
    assert held.rounding_description == "(10³ ε + 1e-11 of the step's solver × √100) G(t)"
    assert analysis().rounding_description == "10³ ε G(t)"


def test_the_true_motion_shows_how_uncertain_the_work_is():
    dragged = replace(MODEL, drag_moment=np.array([0.1]))  # the motion is that without drag
    off = np.max(np.abs(compute_invariants(dragged, TRUE_TRAJECTORY).energy_drift))
    held = analysis(model=dragged)
    assert held.invariant_uncertainty("energy_drift") == off > 0
    assert held.invariant_drifts[-1].uncertainty["energy_drift"] < off / 10
    assert judged_rows(model=dragged)["energy_drift"].verdict == "unresolved"
    assert held.invariant_uncertainty("joint_gap") == analysis().invariant_uncertainty("energy_drift") == 0


def test_an_alias_is_reported_and_differs_with_drag():
    method = replace(METHOD, alias_of="Euler")
    assert {row.alias_of for row in judged_rows(method=method).values()} == {"Euler"}
    dragged = replace(MODEL, drag_moment=np.array([0.1]))
    assert {row.alias_of for row in judged_rows(method=method, model=dragged).values()} == {None}


def test_attitudes_have_two_signs():
    some, right = refinement_study(), analysis()
    for index in (2, 4):
        run = some.runs[index].trajectory
        some.runs[index] = replace(some.runs[index], trajectory=replace(run, p=-run.p, pdot=-run.pdot))
    for mine, theirs in zip(analysis(some).samples["attitude"], right.samples["attitude"], strict=True):
        assert np.array_equal(mine, theirs)
    assert np.array_equal(right.samples["position"][1], refinement_study().runs[1].trajectory.r)
    rows = judged_rows(some)
    assert rows["attitude_limit"].verdict == rows["angular_velocity_limit"].verdict == "agrees"


def test_the_sign_of_an_attitude_is_that_of_its_body_and_time():
    """Of two bodies, with signs at random; a component about zero decides nothing."""
    model = pendulums.make_model("br")
    p = pendulums.reference_trajectory(model, pendulums.state_from_seed(model, seed=3), TIMES).p
    p[..., 3] = 1e-12
    other = p * [1, 1, 1, -1e6]
    signs = np.random.default_rng(1).choice([-1.0, 1.0], size=(17, 2, 1))
    still = np.zeros((17, 2, 3))
    runs = [Trajectory(TIMES, still, x, still, 0 * x, 1) for x in (signs * other, p)]
    made = [RefinementRun(h, run) for h, run in zip(STEPS, runs, strict=False)]
    held = RefinementAnalysis(WHO, model, make_truth(trajectory=runs[1]), METHOD, made, 2.0)
    assert np.array_equal(held.samples["attitude"][0], other)
    assert np.array_equal(held.samples["attitude"][1], p)


# --- invariants ---------------------------------------------------------------------------------


def test_scales_are_sizes_of_what_the_invariants_are_made_of():
    model = pendulums.make_model("br")
    state = pendulums.state_from_seed(model, seed=3, rate=4.0)
    true = pendulums.reference_trajectory(model, state, TIMES)
    held = RefinementAnalysis(
        WHO, model, make_truth(trajectory=true), METHOD, [RefinementRun(0.1, true)], 2.0
    )
    scales, omega = held.invariant_scales, angular_velocity(true.p, true.pdot)
    g = np.linalg.norm(model.gravity)
    kinetic = [
        sum(model.mass[k] * v[k] @ v[k] / 2 + w[k] @ model.inertia[k] @ w[k] / 2 for k in range(2))
        for v, w in zip(true.v, omega, strict=True)
    ]
    height = [model.mass * (r @ model.gravity) for r in true.r]
    potential = np.max([np.sum(np.abs(x)) for x in height])
    height_energy = np.ptp([np.sum(x) for x in height])
    assert scales["energy_drift"] == pytest.approx(max(*kinetic, potential, height_energy), rel=1e-12)
    fall = np.sqrt(g * LENGTH)
    speed = max(fall, *np.linalg.norm(true.v, axis=-1).ravel())
    spin = max(fall / LENGTH, *np.linalg.norm(omega, axis=-1).ravel())
    arm = np.max(np.linalg.norm(true.r, axis=-1))
    inertia = sum(np.linalg.norm(J) for J in model.inertia)
    assert scales["momentum_drift"] == pytest.approx(sum(model.mass) * arm * speed + inertia * spin)
    assert scales["joint_gap"] == max(LENGTH, arm) and scales["norm_drift"] == 1.0
    assert scales["gap_rate"] == pytest.approx(max(speed, spin * LENGTH), rel=1e-12)
    truth = make_truth(trajectory=replace(true, v=0 * true.v, pdot=0 * true.pdot))
    still = RefinementAnalysis(WHO, model, truth, METHOD, held.runs, 2.0).invariant_scales
    assert still["energy_drift"] == pytest.approx(max(potential, height_energy), rel=1e-12)
    over = (
        np.linspace(1, -1, 17)[:, None, None] * TRUE_TRAJECTORY.r[0]
    )  # from one side of the pivot to the other
    turned = replace(TRUE_TRAJECTORY, r=over, v=0 * TRUE_TRAJECTORY.v, pdot=0 * TRUE_TRAJECTORY.pdot)
    raised = 2 * abs(MODEL.mass[0] * TRUE_TRAJECTORY.r[0, 0] @ MODEL.gravity)
    assert analysis(trajectory=turned).invariant_scales["energy_drift"] == pytest.approx(raised, rel=1e-12)
    truth = make_truth(trajectory=true, length=50.0)  # a fall is faster than this
    long = RefinementAnalysis(WHO, model, truth, METHOD, held.runs, 2.0).invariant_scales
    assert long["joint_gap"] == 50.0
    assert long["gap_rate"] == pytest.approx(
        max(np.sqrt(g * 50), np.max(np.linalg.norm(omega, axis=-1)) * 50)
    )


def largest_gap(error):
    """Largest distance of the body's proximal point from the pivot where position and attitude are off."""
    off = trajectory_with_error(error)
    return np.max(np.linalg.norm(off.r + rotate_vectors(rotation_matrix(off.p), MODEL.proximal), axis=-1))


def test_a_drift_that_falls_with_the_step_agrees_and_one_that_does_not_disagrees():
    found = judged_rows()["joint_gap"]
    whole = largest_gap(0.01 * STEPS[-1] ** 2)
    assert (found.verdict, found.level, found.unit, found.compared_until) == (
        "agrees",
        "invariants",
        "m",
        2.0,
    )
    assert found.value == pytest.approx(whole, rel=1e-6) and found.extra["whole"] == found.value
    floor = ROUNDING_PER_STEP * 100 * found.extra["scale"]
    assert found.tolerance == pytest.approx(found.value + floor, rel=1e-6)
    assert found.extra["limit"] < 1e-14 and "at the finest step" in found.reason
    constant = judged_rows(refinement_study([1e-6 + 0.01 * h**2 for h in STEPS]))["joint_gap"]
    assert constant.verdict == "disagrees" and "joint gap does not vanish with the step" in constant.reason
    assert "from the finest step to step zero" in constant.derivation
    assert constant.extra["limit"] == pytest.approx(largest_gap(1e-6), rel=1e-6)
    assert constant.ratio == pytest.approx(constant.extra["limit"] / constant.tolerance, rel=1e-9)
    irregular = judged_rows(refinement_study([0.1, 0.03, 0.02, 0.003, 0.002, 0.001]))["joint_gap"]
    assert irregular.verdict == "unresolved" and irregular.reason.endswith("does not decide")
    unclear = judged_rows(refinement_study([1e-3 + e for e in (0.0, 1e-5, -1e-5, 2e-5, 1e-5, 0)]))[
        "joint_gap"
    ]
    assert unclear.ratio > 1 and unclear.verdict == "unresolved", "no order, no trust"
    alone = refinement_study()
    for index in range(5):
        alone.runs[index] = replace(alone.runs[index], trajectory=None)
    lost = judged_rows(alone)["joint_gap"]
    assert lost.verdict == "unresolved" and "fewer than two" in lost.reason
    assert lost.tolerance == pytest.approx(floor, abs=0) and lost.derivation.startswith("100 steps, ")


def test_an_unresolved_drift_is_allowed_what_the_study_leaves_open():
    errors = [1e-3 + e for e in (0.0, 1e-5, -1e-5, 2e-5, 1e-5, 0)]
    found = judged_rows(refinement_study(errors, attitude=0.0, speed=0.0))["joint_gap"]
    limit = romberg([np.full((1, 1, 1), 2 * e) for e in errors], METHOD.error_exponents)  # at 2 s
    own = abs(2e-3 - limit.y[0, 0, 0])
    assert found.verdict == "unresolved" and found.value == pytest.approx(2e-3)
    assert found.tolerance == pytest.approx(own + limit.uncertainty[0], rel=1e-6)
    assert f"{own:.2g} from the finest step to step zero" in found.derivation


@pytest.mark.parametrize(("steps", "counted"), [(10, 64), (64, 64), (1000, 1000)])
def test_a_drift_of_rounding_agrees_at_once(steps, counted):
    """So much in every step, of at least 64 steps."""
    base = judged_rows(refinement_study([0.0] * 6, steps=steps))["norm_drift"]
    assert base.verdict == "agrees" and base.reason.endswith("rounding")
    assert base.tolerance == pytest.approx(ROUNDING_PER_STEP * counted, rel=1e-12, abs=0)
    assert base.ratio == pytest.approx(base.value / base.tolerance)
    assert base.derivation.startswith(f"{steps} steps, ") and base.compared_until == 2.0
    held = refinement_study([0.0] * 6, steps=steps)
    for factor, reported in ((0.9, True), (1.1, False)):
        grown = TRUE_TRAJECTORY.p * (1 + factor * base.tolerance * TIMES / 2)[:, None, None]
        held.runs[-1] = replace(held.runs[-1], trajectory=replace(held.runs[-1].trajectory, p=grown))
        assert judged_rows(held)["norm_drift"].reason.endswith("rounding") is reported


@pytest.mark.parametrize(("rtol", "steps"), [(1e-6, 3000), (1e-10, 10**9), (1e-6, 90)])
def test_step_control_cannot_accept_what_a_mistake_makes(rtol, steps):
    method, scale = Integrator("DOP853", "tolerance", 8), judged_rows()["energy_drift"].extra["scale"]

    def energy_drift(speed):
        run = trajectory_with_error(0.0, speed=speed, steps=steps)
        row = judged_rows(RefinementStudy([RefinementRun(100 * rtol, run), RefinementRun(rtol, run)]), method)
        return row["energy_drift"]

    small, large = energy_drift(1e-6), energy_drift(1e-3)
    assert small.verdict == "agrees" and small.tolerance == pytest.approx(min(rtol * steps, 1e-4) * scale)
    assert 1e-4 * scale < large.value < 0.1 * scale
    assert large.verdict == ("disagrees" if rtol * steps < 1e-4 else "unresolved")


def test_what_the_quadrature_of_the_work_leaves_open_is_allowed():
    """Drag: energy by the samples' spline; its uncertainty is part of the tolerance, and only there."""
    model = replace(MODEL, drag_moment=np.array([1e-5]))
    true = pendulums.reference_trajectory(model, pendulums.state_from_seed(model, seed=2, rate=0.5), TIMES)
    runs = [RefinementRun(h, replace(true, v=true.v * (1 + h**2 * TIMES[:, None, None]))) for h in STEPS]
    found = judged_rows(RefinementStudy(runs), model=model, trajectory=true)
    uncertain = compute_invariants(model, runs[-1].trajectory).uncertainty["energy_drift"]
    assert uncertain > 1e-8
    row = found["energy_drift"]
    assert f"the work by quadrature, or the limit of softer runs ± {uncertain:.2g}" in row.derivation
    assert "the limit of softer runs ± 0" in found["gap_rate"].derivation
    assert row.extra["limit"] < uncertain and row.verdict == "agrees"
    assert "momentum_drift" not in found


# --- tables -------------------------------------------------------------------------------------


def test_the_tables_hold_every_run_every_sample_and_every_pose():
    found = dict(judge_trajectory(WHO, MODEL, make_truth(horizon=1.0), METHOD, refinement_study()).tables)
    table = found["convergence"]
    assert (table["scenario"], table["engine"], table["integrator"]) == ("s", "mujoco", "Heun")
    assert table["quantity"] == ["position", "attitude"] * 6
    assert table["resolution"] == [h for h in STEPS for _ in range(2)]
    assert table["cost"] == [float(i) for i in range(1, 7) for _ in range(2)] and set(table["steps"]) == {100}
    np.testing.assert_allclose(table["error"][::2], [0.01 * h**2 for h in STEPS], rtol=1e-6)
    np.testing.assert_allclose(table["error"][1::2], [0.01 * h**2 for h in STEPS], rtol=1e-4)
    np.testing.assert_allclose(table["order"][::2], [np.nan, np.nan, 2, 2, 2, 2], rtol=1e-6)
    curves = found["curves"]
    assert curves["resolution"] == STEPS[-1] and curves["t"] is TIMES
    np.testing.assert_allclose(curves["position_error"], 0.01 * STEPS[-1] ** 2 * TIMES, atol=1e-15)
    np.testing.assert_allclose(curves["attitude_error"], 0.01 * STEPS[-1] ** 2 * TIMES, atol=1e-14)
    assert np.max(curves["limit_error"]) < 1e-14
    np.testing.assert_allclose(curves["tolerance"], 1e-12 + LENGTH * RUN_ROUNDING * (1 + TIMES), rtol=0.05)
    finest = refinement_study().runs[-1].trajectory
    held = compute_invariants(MODEL, finest)
    np.testing.assert_allclose(curves["joint_gap"], np.linalg.norm(held.joint_gap[:, 0], axis=-1))
    np.testing.assert_allclose(curves["norm_drift"], np.abs(held.norm_drift[:, 0, 0]))
    bare = dict(
        judge_trajectory(
            WHO,
            replace(MODEL, gravity=0 * MODEL.gravity),
            make_truth(horizon=1.0),
            METHOD,
            refinement_study(),
        ).tables
    )
    assert np.all(np.isnan(bare["curves"]["momentum_drift"]))
    poses = found["trajectories"]
    assert poses["t"].tolist() == TIMES.tolist() and set(poses["body"]) == {0}
    np.testing.assert_array_equal(poses["rz"], finest.r[:, 0, 2])
    np.testing.assert_array_equal(poses["p3"], finest.p[:, 0, 3])
    assert poses["resolution"] == STEPS[-1]


def test_poses_are_in_order_of_time_then_body():
    r, p = np.arange(12.0).reshape(2, 2, 3), 100 + np.arange(16.0).reshape(2, 2, 4)
    table = pose_columns(Trajectory(np.array([0.0, 1.0]), r, p, r, p, 1))
    assert table["t"].tolist() == [0, 0, 1, 1] and table["body"].tolist() == [0, 1, 0, 1]
    assert table["rx"].tolist() == [0, 3, 6, 9] and table["p0"].tolist() == [100, 104, 108, 112]
    assert list(table)[2:] == ["rx", "ry", "rz", "p0", "p1", "p2", "p3"]


# how much of the scenario's time is compared


@pytest.mark.parametrize(
    ("until", "verdict", "words"),
    [
        (2.0, "agrees", ""),
        (1.5, "agrees", "; covers 1.5 s of the scenario's 2 s"),
        (1.0, "agrees", "; covers 1 s of the scenario's 2 s"),
        (0.875, "unresolved", "; covers 0.875 s of the scenario's 2 s"),
    ],
)
def test_a_comparison_of_less_than_half_of_the_time_decides_nothing(until, verdict, words):
    rows = judged_rows(horizon=until)
    for name in (*LIMITS, "position", "attitude"):
        expected = verdict if name.endswith("_limit") else "information"
        assert rows[name].verdict == expected and rows[name].compared_until == until
        reason = rows[name].reason
        assert reason.endswith(words) if words else "covers" not in reason
    for name in LIMITS:
        reason = rows[name].reason
        assert reason.startswith("too short a time to decide: ") == (verdict == "unresolved")


def test_a_motion_that_can_be_predicted_for_less_is_compared_up_to_there():
    growth = 10.0 ** (8 * TIMES)  # 1e3 ε of 0.3 m grows beyond 1e-9 m after 0.5 s
    rows = judged_rows(horizon=0.5, growth=growth)
    assert rows["position_limit"].verdict == "agrees"
    assert rows["position_limit"].reason.endswith(
        "; covers 0.5 s of the scenario's 2 s, which can be predicted for 0.5 s"
    )


def test_a_window_just_below_half_of_the_time_counts_as_half():
    found = analysis(horizon=2.0)
    assert not found.is_too_short(8, 2.0)  # 1 s
    assert found.is_too_short(7, 2.0)  # 0.875 s: the sample at 1 s is within the half
    assert not found.is_too_short(7, 1.9)  # 0.875 s of 0.95 s: the next sample is beyond it
