"""Errors between two motions and the invariants of one, each against what it is by definition."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.model.datatypes import JOINT_ELEMENTS, State, Trajectory
from plumbline.model.invariants import (
    INVARIANT_UNITS,
    attitude_error,
    compute_invariants,
    element_energies,
    first_departure,
    inertia_ratio,
    kinetic_energy,
    position_error,
    work_of_loads,
)
from plumbline.model.kinematics import (
    angular_velocity,
    complete_state,
    joint_vector_rates,
    joint_vectors,
    quaternion_product,
    quaternion_rate,
)
from tests.helpers import pendulums
from tests.helpers.nightly_tests import SLOW
from tests.helpers.random_chains import random_chain, tree_from_seed

TIMES = np.linspace(0.0, 1.0, 41)


def make_motion(rods, times=TIMES, **options):
    model, state = random_chain(70, rods, **options)
    return model, pendulums.reference_trajectory(model, state, times)


def test_position_error_is_the_largest_distance_of_a_body():
    a = np.zeros((2, 3, 3))
    b = a.copy()
    b[0, 1], b[0, 2], b[1, 0] = [3, 0, 4], [1, 1, 1], [0, 0, -2]
    assert position_error(a, b).tolist() == [5.0, 2.0]
    assert position_error(b[0], a[0]) == 5.0


def test_a_run_has_left_where_error_less_radius_is_above_a_millimetre():
    t = np.array([0, 0.5, 1, 1.5])
    error = np.array([0, 1e-3, 1.4e-3, 2e-3])
    assert first_departure(t, error, 0.0) == 1.0
    assert first_departure(t, error, 5e-4) == 1.5
    assert first_departure(t, error, np.array([0, 0, 5e-4, 2e-3])) is None
    assert first_departure(t, np.array([0, 1e-4, np.nan, 0]), 0.0) == 1.0
    assert first_departure(t, np.full(4, np.nextafter(1e-3, 1)), 0.0) is None, (
        "within the rounding of the error"
    )


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 1.0, 3.0, np.pi])
def test_attitude_error_is_the_largest_rotation_angle(angle):
    rng = np.random.default_rng(71)
    p = rng.normal(size=(4, 2, 4))
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    axis = np.array([2.0, -1.0, 2.0]) / 3
    turn, less = (np.array([np.cos(x / 2), *(np.sin(x / 2) * axis)]) for x in (angle, angle / 2))
    q = np.stack(
        [
            quaternion_product(p[:, 0], np.tile(less, (4, 1))),
            quaternion_product(p[:, 1], np.tile(turn, (4, 1))),
        ],
        1,
    )
    q[1::2] *= -1  # the same attitude
    assert attitude_error(p, q) == pytest.approx(np.full(4, angle), rel=1e-6)
    assert attitude_error(p * 1.1, q * 0.7) == pytest.approx(np.full(4, angle), rel=1e-6)
    assert attitude_error(p[1], q[1]) == pytest.approx(angle, rel=1e-6)
    assert np.array_equal(attitude_error(p, -p), np.zeros(4))


def rotating_trajectory(model, angle, rate, times):
    """A run in which body 1 turns about x, so that a moment of 1 N m about it has the power ``rate``."""
    still = np.zeros((len(times), model.n, 3))
    omega = still.copy()
    omega[:, 0, 0] = rate
    p = np.tile([1.0, 0, 0, 0], (len(times), model.n, 1))
    p[:, 0, 0], p[:, 0, 1] = np.cos(angle / 2), np.sin(angle / 2)
    return Trajectory(times, still, p, still, quaternion_rate(p, omega), 1)


def work_about_x(model, run):
    """Work of a moment of 1 N m about x of body 1."""
    return work_of_loads(
        model.changed(moment=np.eye(1, 3 * model.n).reshape(-1, 3)),
        run,
        angular_velocity(run.p, run.pdot),
    )


@pytest.mark.parametrize("degree", [0, 1, 4])
@pytest.mark.parametrize("flipped", [False, True])
def test_work_of_a_moment_is_the_integral_of_its_power(degree, flipped):
    """Also where quaternions change their sign from sample to sample."""
    model, _ = random_chain(73, [False, False])
    times = np.linspace(0, 2, 65)
    angle = times ** (degree + 1) / (degree + 1)
    run = rotating_trajectory(model, angle, times**degree, times)
    if flipped:
        sign = np.where(np.arange(65) % 3, 1.0, -1.0)[:, None, None]
        run = replace(run, p=sign * run.p, pdot=sign * run.pdot)
    done, uncertainty = work_about_x(model, run)
    np.testing.assert_allclose(done, angle, rtol=0, atol=1e-7 if degree == 4 else 1e-12)
    assert uncertainty < (1e-4 if degree == 4 else 1e-10)
    omega = angular_velocity(run.p, run.pdot)
    lost, _ = work_of_loads(model.changed(drag_moment=np.array([0.5, 0.0])), run, omega)
    expected = -0.5 * times ** (2 * degree + 1) / (2 * degree + 1)
    np.testing.assert_allclose(lost, expected, rtol=0, atol=1e-5 if degree == 4 else 1e-12)


def test_work_of_a_force_needs_no_quadrature_and_drag_takes():
    model, _ = random_chain(74, [False, False])
    rng = np.random.default_rng(74)
    r = rng.normal(size=(25, 2, 3))
    times, force = np.linspace(0, 2, 25), rng.normal(size=(2, 3))
    v = np.zeros((25, 2, 3))
    v[:, 1, 2] = times**2
    p = np.tile([1.0, 0, 0, 0], (25, 2, 1))
    run, still = Trajectory(times, r, p, v, 0 * p, 1), np.zeros((25, 2, 3))
    done, uncertainty = work_of_loads(model.changed(force=force), run, still)
    np.testing.assert_allclose(done, np.sum(force * (r - r[0]), axis=(1, 2)), rtol=0, atol=1e-14)
    assert uncertainty == 0.0
    r[:, 1] = times[:, None] ** 3 / 3 * [0, 0, 1]
    lost, _ = work_of_loads(model.changed(drag_force=np.array([0.0, 3.0])), run, still)
    np.testing.assert_allclose(lost, -3 * times**5 / 5, rtol=0, atol=1e-12)


@pytest.mark.parametrize("count, sharp", [(9, 0.1), (13, 1e-2), (25, 1e-4), (49, 1e-8)])
def test_the_quadrature_knows_its_error(count, sharp):
    """Of a power that few samples hardly resolve the work is uncertain by at least its error."""
    model, _ = random_chain(75, [False])
    times = np.linspace(0, 2, count)
    run = rotating_trajectory(model, np.sin(9 * times) / 9, np.cos(9 * times), times)
    done, uncertainty = work_about_x(model, run)
    error = float(np.max(np.abs(done - np.sin(9 * times) / 9)))
    assert 0 < error <= uncertainty < sharp


def random_rate(rng, times):
    """A rate and its integral, analytic up to the sample interval from real time, resolved or hardly."""
    h, amplitude = times[1] - times[0], rng.normal()
    if rng.random() < 0.5:
        frequency = 10 ** rng.uniform(-1.5, 0, 3) * np.pi / h
        phase = rng.uniform(0, 2 * np.pi, 3)
        return (
            lambda t: amplitude * np.sum(np.sin(t[:, None] * frequency + phase), axis=1),
            lambda t: -amplitude * np.sum(np.cos(t[:, None] * frequency + phase) / frequency, axis=1),
        )
    width, at = 10 ** rng.uniform(0, 1) * h, rng.uniform(0, 2)
    return (
        lambda t: amplitude / (1 + ((t - at) / width) ** 2),
        lambda t: amplitude * width * np.arctan((t - at) / width),
    )


@pytest.mark.parametrize("seed", [pytest.param(k, marks=SLOW if k % 5 else []) for k in range(40)])
def test_the_work_of_random_motions_is_as_uncertain_as_it_is_wrong(seed):
    """Of a moment and of a drag, in motions that their samples resolve and in some that they do not."""
    rng = np.random.default_rng((1407, seed))
    model, _ = random_chain(73, [False, False])
    times = np.linspace(0, 2, int(rng.integers(3, 66)))
    rate, angle = random_rate(rng, times)
    turned = angle(times) - angle(times[:1])
    run = rotating_trajectory(model, turned, rate(times), times)
    dragged = model.changed(drag_moment=np.array([0.5, 0.0]))
    nodes, weights = np.polynomial.legendre.leggauss(60)
    inside = times[:-1, None] + times[1] / 2 * (1 + nodes)
    power = -0.5 * rate(inside.ravel()).reshape(inside.shape) ** 2
    lost = np.concatenate([[0.0], np.cumsum(power @ weights * times[1] / 2)])
    by_drag = work_of_loads(dragged, run, angular_velocity(run.p, run.pdot))
    for true, (done, uncertainty) in ((turned, work_about_x(model, run)), (lost, by_drag)):
        assert np.max(np.abs(done - true)) <= uncertainty + 1e-13 * np.max(np.abs(true))


@pytest.mark.parametrize(("width", "least"), [(0.5, 1e-4), (1.0, 1e-6), (4.0, 0.0)])
def test_a_peak_between_samples_is_not_passed_by_wider_polynomials(width, least):
    """Six samples and eight differ by less than the error; what every second sample makes does not."""
    model, _ = random_chain(73, [False])
    times, dragged = np.linspace(0, 2, 33), model.changed(drag_moment=np.array([0.5]))
    peak = width * times[1]
    rate, angle = 1 / (1 + ((times - 1) / peak) ** 2), peak * np.arctan((times - 1) / peak)
    run = rotating_trajectory(model, angle - angle[0], rate, times)
    lost = -0.25 * (peak * ((times - 1) / peak * rate + np.arctan((times - 1) / peak)))
    done, uncertainty = work_of_loads(dragged, run, angular_velocity(run.p, run.pdot))
    error = np.max(np.abs(done - (lost - lost[0])))
    assert least <= error <= uncertainty < (0.1 if least else 1e-6)


def test_two_samples_are_integrated_and_one_is_not():
    model, _ = random_chain(76, [False])
    for times in (np.array([0.0, 0.5]), np.zeros(1)):
        done, _ = work_about_x(model, rotating_trajectory(model, times + times**2 / 2, 1 + times, times))
        np.testing.assert_allclose(done, times + times**2 / 2, atol=1e-3)


def test_the_energy_of_a_spring_counts_full_turns():
    """Also where an angle moves by more than half a turn from sample to sample: its rate chooses the turn."""
    model = replace(
        tree_from_seed(0, 1, ("hinge",), loads=False),
        point=np.zeros((1, 2, 3)), turn=np.tile([1.0, 0, 0, 0], (1, 2, 1)), gravity=np.zeros(3),
        inertia=0.1 * np.eye(3)[None], stiffness=np.array([[2.5, 0.0]]), rest=np.array([[1.0, 0.0]]),
    )  # fmt: skip
    times = np.linspace(0, 3, 49)
    angle = 1.0 + 13.0 * np.cos(5 * times)
    rate = -65.0 * np.sin(5 * times)
    assert np.max(np.abs(np.diff(angle))) > 4
    p = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], -1)[:, None]
    still = np.zeros((49, 1, 3))
    pdot = quaternion_rate(p, np.stack([0 * rate, 0 * rate, rate], -1)[:, None])
    run = Trajectory(times, still, p, still, pdot, 1, np.array([[14.0, 0.0]]))
    assert np.max(np.abs(compute_invariants(model, run).energy_drift)) < 1e-10
    lost = compute_invariants(model, replace(run, initial_x=None)).energy_drift
    assert np.max(np.abs(lost)) > 10


def test_a_spring_on_a_closing_joint_with_a_pitch_counts_full_turns():
    """The body screws along z; what it slides says how often it has turned, whatever the run begins with."""
    pitch, stiffness, rest = 0.3, 2.5, 1.0
    model = replace(
        tree_from_seed(0, 1, ("cylindrical",), loads=False),
        kind=("cylindrical", "helical"), body=np.array([[-1, 0], [-1, 0]]), point=np.zeros((2, 2, 3)),
        turn=np.tile([1.0, 0, 0, 0], (2, 2, 1)), length=np.array([0.0, pitch]), gravity=np.zeros(3),
        **{name: np.zeros((2, 2)) for name in JOINT_ELEMENTS},
    )  # fmt: skip
    model = model.changed(stiffness=np.diag([0.0, stiffness])[:, ::-1], rest=np.diag([0.0, rest])[:, ::-1])
    angle = np.linspace(4.0, 14.0, 49)
    p = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], -1)[:, None]
    r, omega = np.zeros((2, 49, 1, 3))
    r[:, 0, 2], omega[..., 2] = pitch * angle, 1.0
    run = Trajectory(angle - 4.0, r, p, pitch * omega, quaternion_rate(p, omega), 1)
    expected = stiffness * (angle - rest) ** 2 / 2
    # twice what some ten roundings of 14 rad are of the smallest stretch, 3 rad
    rtol = 2 * 10 * np.finfo(float).eps * angle[-1] / (angle[0] - rest)
    np.testing.assert_allclose(element_energies(model, run, omega).springs, expected, rtol=rtol)


OPTIONS = ({}, {"loads": True}, {"drag": True})


@pytest.mark.parametrize(
    ("rods", "options"),
    [
        pytest.param(rods, options, id=f"{rods}-{options}", marks=[] if k == place else SLOW)
        for rods, place in (([False, False], 1), ([True, False], 2), ([True], None))
        for k, options in enumerate(OPTIONS)
    ],
)
def test_true_motion_has_no_drift(rods, options):
    model, run = make_motion(rods, np.linspace(0, 1, 161), **options)
    found = compute_invariants(model, run)
    size = float(np.max(kinetic_energy(model, run.v, 2 * run.pdot[..., 1:]))) + 9.81
    assert np.max(np.abs(found.energy_drift)) <= found.uncertainty["energy_drift"] + 1e-11 * size
    assert found.energy_drift[0, 0, 0] == 0.0
    assert (found.momentum_drift is None) == bool(options)
    if found.momentum_drift is not None:
        assert np.max(np.abs(found.momentum_drift)) < 1e-11 * size
        assert found.momentum_drift.shape == (161, 1, 1)
    for name, width in (("joint_gap", 3), ("gap_rate", 3), ("norm_drift", 1)):
        series = getattr(found, name)
        assert series.shape == (161, len(rods), width)
        assert np.max(np.abs(series)) < 1e-13, name
    assert set(INVARIANT_UNITS) <= set(vars(found))


def test_a_gap_is_the_vector_of_a_ball_and_the_stretch_of_a_rod():
    model, run = make_motion([False, True])
    away, faster = np.array([1e-3, -2e-3, 3e-3]), np.array([4e-3, 1e-3, -2e-3])
    moved = compute_invariants(model, replace(run, r=run.r + away, v=run.v + faster))
    np.testing.assert_allclose(moved.joint_gap[:, 0], np.tile(away, (41, 1)), atol=1e-14)
    np.testing.assert_allclose(moved.gap_rate[:, 0], np.tile(faster, (41, 1)), atol=1e-13)
    assert np.max(np.abs(moved.joint_gap[:, 1])) < 1e-13, "the second body moved with the first"
    r, v = run.r.copy(), run.v.copy()
    r[:, 1, 0] += 1e-3
    v[:, 1, 1] += 1e-3
    down = replace(run, r=r, v=v)
    stretched = compute_invariants(model, down)
    d = joint_vector_of_second_body(model, run)
    d[:, 0] += 1e-3
    long = np.linalg.norm(d, axis=-1)
    np.testing.assert_allclose(stretched.joint_gap[:, 1, 0], long - model.length[1], atol=1e-14)
    omega = 2 * quaternion_product(run.p * [1, -1, -1, -1], run.pdot)[..., 1:]
    rates = joint_vector_rates(model, down.p, down.v, omega)[:, 1]
    np.testing.assert_allclose(stretched.gap_rate[:, 1, 0], np.sum(d * rates, -1) / long, atol=1e-13)
    assert not np.any(stretched.joint_gap[:, 1, 1:]) and not np.any(stretched.gap_rate[:, 1, 1:])
    assert np.max(np.abs(stretched.joint_gap[:, 1, 0])) > 1e-5


def test_the_ends_of_a_rod_in_one_place_are_its_length_off():
    model, _ = random_chain(78, [True])
    model = model.changed(proximal=np.zeros((1, 3)))
    found = compute_invariants(model, rotating_trajectory(model, TIMES**2 / 2, TIMES, TIMES))
    np.testing.assert_array_equal(found.joint_gap[:, 0, 0], -model.length[0])
    assert not np.any(found.gap_rate), "a stretch has no direction there"


def joint_vector_of_second_body(model, run):
    """ℓ u (T, 3) of the second joint, from where it hangs to the second body's proximal point."""
    found = []
    for r, p in zip(run.r, run.p, strict=True):
        still = np.zeros((2, 3))
        hung = complete_state(model.changed(length=np.zeros(2)), State(p, still, still, still)).r
        found.append(r[1] - hung[1] - (r[0] - hung[0]))
    return np.array(found)


@pytest.mark.parametrize("rods", [[False], [True, False, True]], ids=str)
def test_joint_rates_are_the_slopes_of_the_joint_vectors(rods):
    """Off the manifold, where they are not zero: ṙ shifted by a constant moves r by it times t."""
    model, run = make_motion(rods)
    rng, h = np.random.default_rng(77), 1e-6
    drift = rng.normal(size=(len(rods), 3))
    omega = 2 * quaternion_product(run.p * [1, -1, -1, -1], run.pdot)[..., 1:]
    rates = joint_vector_rates(model, run.p, run.v + drift, omega)
    ends = [joint_vectors(model, run.r + s * h * (run.v + drift), run.p + s * h * run.pdot) for s in (1, -1)]
    np.testing.assert_allclose(rates, (ends[0] - ends[1]) / (2 * h), rtol=0, atol=1e-8)
    assert np.max(np.abs(rates)) > 0.1


def test_what_is_not_conserved_is_not_judged():
    """Momentum about gravity: not with loads, drag or without gravity; energy by a shift, norm as it is."""
    model, run = make_motion([False])
    assert compute_invariants(model.changed(gravity=np.zeros(3)), run).momentum_drift is None
    light, usual = (compute_invariants(model.changed(gravity=x * model.gravity), run) for x in (1e-2, 1))
    np.testing.assert_allclose(light.momentum_drift, usual.momentum_drift, rtol=0, atol=1e-15)
    assert compute_invariants(model.changed(force=np.ones((1, 3))), run).momentum_drift is None
    assert compute_invariants(model.changed(drag_moment=np.ones(1)), run).momentum_drift is None
    long = compute_invariants(model, replace(run, p=1.01 * run.p))
    np.testing.assert_allclose(long.norm_drift, 0.01, atol=1e-13)
    faster = replace(run, v=np.concatenate([run.v[:1], 2 * run.v[1:]]))
    shifted = compute_invariants(model, faster)
    extra = 1.5 * model.mass[0] * np.sum(run.v[1:, 0] ** 2, -1)
    np.testing.assert_allclose(shifted.energy_drift[1:, 0, 0], extra, atol=1e-11)
    about = model.mass[0] * np.cross(run.r[1:, 0], run.v[1:, 0]) @ [0, 0, -1.0]
    assert shifted.momentum_drift is not None
    np.testing.assert_allclose(shifted.momentum_drift[1:, 0, 0], about, atol=1e-11)


def test_the_ratio_of_inertias_of_a_light_body_that_carries_a_heavy_one():
    model = pendulums.make_model("balls")
    light = model.changed(
        mass=np.array([1.0, 1000.0]), inertia=np.array([np.diag([0.1, 0.2, 0.2])] * 2),
        proximal=np.array([[0, 0, 0.5]] * 2), distal=np.array([[0, 0, -0.5]] * 2),
    )  # fmt: skip
    assert inertia_ratio(light) == pytest.approx((1000.0 + 0.2) / 0.1)
    assert inertia_ratio(replace(light, mass=light.mass[::-1])) == pytest.approx((1.0 + 0.2) / 0.1)
