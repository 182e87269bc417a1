"""The closed forms: right by a high-precision integration, refused where the scenario is another motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import ellipj, ellipkinc

from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Model, State
from plumbline.model.invariants import attitude_error, position_error
from plumbline.model.kinematics import complete_state, quaternion_product, rotation_matrix
from plumbline.truth.closed_form import CLOSED_FORMS, ClosedFormMismatch, closed_form_motion
from plumbline.truth.closed_form.tops_and_pendulums import elliptic_f, elliptic_pi, jacobi
from tests.helpers.catalogue import catalogue_scenarios

TIMES = np.arange(41) * 0.05
CLOSED_FORM_SCENARIOS = {
    name: scenario for name, scenario in catalogue_scenarios().items() if scenario.closed_form
}


@dataclass(frozen=True)
class ScenarioStub:
    """The part of a scenario that `closed_form_motion` reads."""

    closed_form: str | None
    model: Model
    state: State


def one_body(**changes):
    values = {
        "mass": np.array([1.3]),
        "inertia": np.diag([0.02, 0.02, 0.03])[None],
        "proximal": np.array([[0.0, 0.0, -0.2]]),
        "distal": np.zeros((1, 3)),
        "length": np.zeros(1),
        "gravity": np.array([0.0, 0.0, -9.81]),
        "force": np.zeros((1, 3)),
        "moment": np.zeros((1, 3)),
        "drag_force": np.zeros(1),
        "drag_moment": np.zeros(1),
    }
    return Model.chain(**(values | changes))


def quaternion(axis, angle):
    axis = np.array(axis) / np.linalg.norm(axis)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])[None]


def make_state(model, p, omega, u=None, udot=None):
    none = np.zeros((model.n, 3))
    return complete_state(
        model, State(p, np.array([omega]), none if u is None else u, none if udot is None else udot)
    )


def closed_form_errors(case, times=TIMES):
    """Position (m) and attitude (rad) by which the closed form misses the best integration there is."""
    r, p = closed_form_motion(case)(times)
    try:
        from plumbline.truth.taylor import simulate_taylor

        run, _ = simulate_taylor(case.model, case.state, times, "extended")
        true_r, true_p = np.asarray(run.r, dtype=float), np.asarray(run.p, dtype=float)
    except ImportError:
        run = load_adapter("reference").simulate(case.model, case.state, times, "collocation", 1e-14)
        true_r, true_p = run.r, run.p
    return np.max(position_error(r, true_r)), np.max(attitude_error(p, true_p))


NOT_SMALL_OSCILLATIONS = [
    name for name, scenario in CLOSED_FORM_SCENARIOS.items() if not scenario.closed_form.startswith("small")
]


@pytest.mark.parametrize("name", NOT_SMALL_OSCILLATIONS)
def test_catalogue(name):
    position, attitude = closed_form_errors(CLOSED_FORM_SCENARIOS[name])
    assert position < 1e-13
    assert attitude < 1e-13


TOPS = {
    "tumbling, hanging": (0.4, [2.0, -1.0, 3.0], 0.03),
    "fast, upright": (2.9, [0.5, 0.2, 60.0], 0.03),
    "spinning backwards": (2.0, [0.0, 1.0, -25.0], 0.01),
    "no spin": (1.2, [1.0, -2.0, 0.0], 0.03),
    "nutating from a cusp": (1.0, [0.0, 0.0, 20.0], 0.03),
    "passing close to straight down": (0.8, [3.0, 2.0, -4.0], 0.039),
}


@pytest.mark.parametrize("name", TOPS)
def test_lagrange_top(name):
    tilt, omega, axial = TOPS[name]
    model = one_body(inertia=np.diag([0.02, 0.02, axial])[None])
    p = quaternion_product(
        quaternion([0.3, 1.0, 0.2], 0.7),
        quaternion_product(quaternion([1.0, 0.5, 0.0], tilt), quaternion([0, 0, 1], 1.1)),
    )
    case = ScenarioStub("lagrange-top", model, make_state(model, p, omega))
    position, attitude = closed_form_errors(case)
    height = closed_form_motion(case)(np.linspace(0, 2, 2001))[0][:, 0, 2] / 0.2
    closest = np.min(1 - np.abs(height))  # ½ δ²: the azimuth turns fast there and loses digits
    assert position < 1e-12
    assert attitude < 1e-12 + 1e-15 / closest


def test_a_top_released_from_rest_is_refused_as_a_planar_pendulum():
    model = one_body()
    case = ScenarioStub("lagrange-top", model, make_state(model, quaternion([1, 0, 0], 1.0), [0, 0, 0]))
    with pytest.raises(ClosedFormMismatch, match="straight up or down"):
        closed_form_motion(case)
    position, attitude = closed_form_errors(replace(case, closed_form="planar-pendulum"))
    assert max(position, attitude) < 1e-12


def test_steady_precession_keeps_its_digits():
    """A double root of the cubic, where the roots of a formed polynomial would have half the digits."""
    model = one_body()
    transverse, axial = 0.02 + 1.3 * 0.04, 0.03
    theta, rate = 0.6, 1.7  # axis at θ from up; precession at the rate: spin from the balance
    need = (1.3 * 9.81 * 0.2 + transverse * rate**2 * np.cos(theta)) / (axial * rate)
    omega = [0.0, rate * np.sin(theta), need]
    p = quaternion([1, 0, 0], theta)
    case = ScenarioStub("lagrange-top", model, make_state(model, p, omega))
    r, _ = closed_form_motion(case)(TIMES)
    assert np.ptp(r[:, 0, 2]) < 1e-14
    assert max(closed_form_errors(case)) < 1e-12


@pytest.mark.parametrize(
    "omega", [[0.1, 8, 0.05], [0.1, 8, -0.2], [-3, 0.1, 2], [0.3, -0.2, -9], [1, 2, 3]], ids=str
)
@pytest.mark.parametrize(
    "moments", [[0.02, 0.03, 0.04], [0.04, 0.02, 0.03], [0.02, 0.02, 0.03], [0.02, 0.03, 0.03]], ids=str
)
def test_free_top(omega, moments):
    axes = rotation_matrix(quaternion([1, 2, -1], 0.8))[0]
    inertia = axes @ np.diag(moments) @ axes.T
    model = one_body(inertia=(inertia + inertia.T)[None] / 2, proximal=np.zeros((1, 3)))
    spin = axes @ np.array(omega)
    position, attitude = closed_form_errors(
        ScenarioStub("free-top", model, make_state(model, quaternion([1, 1, 0], 1.0), list(spin)))
    )
    assert position == 0
    assert attitude < 2e-12


@pytest.mark.parametrize("omega", [[0, 0, 5.0], [0, 3.0, 0], [0, 0, 0]], ids=str)
def test_a_free_top_about_a_principal_axis_rotates_uniformly(omega):
    model = one_body(inertia=np.diag([0.02, 0.03, 0.04])[None], proximal=np.zeros((1, 3)))
    state = make_state(model, quaternion([1, 1, 0], 1.0), omega)
    _, p = closed_form_motion(ScenarioStub("free-top", model, state))(TIMES)
    half = np.linalg.norm(omega) * TIMES / 2
    axis = np.array(omega) / (np.linalg.norm(omega) or 1.0)
    expected = quaternion_product(
        state.p, np.concatenate([np.cos(half)[:, None], np.sin(half)[:, None] * axis], 1)
    )
    assert np.max(np.abs(p[:, 0] - expected)) < 1e-14


def test_spherical_pendulum_on_a_rod_rotates_as_a_free_top():
    model = one_body(
        inertia=np.diag([0.02, 0.03, 0.04])[None], proximal=np.zeros((1, 3)), length=np.array([0.6])
    )
    u = np.array([[0.6, 0.0, -0.8]])
    state = make_state(model, quaternion([1, 0, 1], 0.5), [1.0, -2.0, 0.7], u, np.array([[0.4, 2.0, 0.3]]))
    assert max(closed_form_errors(ScenarioStub("spherical-pendulum", model, state))) < 2e-12


@pytest.mark.parametrize("rate", [0.0, 4.0, 9.0, 11.0, 16.0, -16.0])
@pytest.mark.parametrize("angle", [0.3, 2.9, -2.0])
def test_planar_pendulum(angle, rate):
    model = one_body(inertia=np.diag([0.02, 0.05, 0.03])[None], proximal=np.array([[0.0, 0.0, 0.3]]))
    p = quaternion_product(quaternion([0, 0, 1], 0.5), quaternion([0, 1, 0], angle))
    position, attitude = closed_form_errors(
        ScenarioStub("planar-pendulum", model, make_state(model, p, [0.0, rate, 0.0]))
    )
    assert max(position, attitude) < (5e-12 if abs(angle) > 2.5 else 1e-12)


@pytest.mark.parametrize(
    "name",
    [name for name, scenario in CLOSED_FORM_SCENARIOS.items() if scenario.closed_form.startswith("small")],
)
def test_small_oscillations_err_by_the_cube_of_the_amplitude(name):
    """Position error ∝ amplitude³, so the relative one ∝ amplitude²: halved, an eighth."""
    case = CLOSED_FORM_SCENARIOS[name]
    found = []
    for part in (1.0, 0.5, 0.25):
        smaller = scale_oscillation(case, part)
        run = load_adapter("reference").simulate(smaller.model, smaller.state, TIMES, "collocation", 1e-14)
        motion = closed_form_motion(smaller)
        found.append(np.max(position_error(motion(TIMES)[0], run.r)))
        assert motion.amplitude == pytest.approx(part * closed_form_motion(case).amplitude, rel=1e-4)
        assert (
            found[-1]
            < motion.amplitude**2 * np.max(np.abs(smaller.state.r - equilibrium_state(smaller).r)) * 100
        )
    assert found[0] / found[1] == pytest.approx(8, rel=0.1)
    assert found[1] / found[2] == pytest.approx(8, rel=0.2)


def equilibrium_state(case):
    return scale_oscillation(case, 0.0).state


def scale_oscillation(case, part):
    """The same small motion with angles and rates times ``part``."""
    p = np.empty_like(case.state.p)
    for k in range(case.model.n):
        s = rotation_matrix(case.state.p[k]) @ case.model.proximal[k]
        s /= np.linalg.norm(s)
        axis = np.cross(s, [0, 0, 1.0])
        sine = np.linalg.norm(axis)
        angle = np.arctan2(sine, s[2])
        back = quaternion(list(axis if sine else [1.0, 0, 0]), (1 - part) * angle)
        p[k] = quaternion_product(back[0], case.state.p[k])
    state = complete_state(case.model, State(p, part * case.state.omega, case.state.u, case.state.udot))
    return ScenarioStub(case.closed_form, case.model, state)


def test_small_oscillations_of_a_chain_with_rods():
    model = CLOSED_FORM_SCENARIOS["double-planar-small"].model.changed(length=np.array([0.0, 0.4]))
    found = []
    for part in (1.0, 0.5):
        p = np.concatenate([quaternion([0, 1, 0], 0.002 * part), quaternion([0, 1, 0], -0.004 * part)])
        u = np.array([[0, 0, 0], [-np.sin(0.003 * part), 0, -np.cos(0.003 * part)]])
        udot = np.cross([[0, 0, 0], [0, 0.01 * part, 0]], u)
        state = complete_state(model, State(p, np.zeros((2, 3)), u, udot))
        found.append(closed_form_errors(ScenarioStub("small-double", model, state))[0])
    assert found[0] < 1e-6
    assert found[0] / found[1] == pytest.approx(8, rel=0.01)


SLANTED = quaternion([1, 0, 0], 1.0)
TURNING, RESTING = (make_state(one_body(), SLANTED, [rate] * 3) for rate in (1.0, 0.0))
REFUSED_MOTIONS = {
    "planar-pendulum": (one_body(), TURNING, "axis"),
    "lagrange-top": (one_body(inertia=np.diag([0.02, 0.021, 0.03])[None]), TURNING, "symmetric"),
    "spherical-pendulum": (one_body(), TURNING, "no spin"),
    "free-top": (one_body(), TURNING, "centre of mass"),
    "conical": (one_body(), TURNING, "same vertical"),
    "rest": (one_body(), RESTING, "balance"),
    "small-chain": (one_body(), TURNING, "one plane"),
}


@pytest.mark.parametrize("kind", REFUSED_MOTIONS)
def test_another_motion_is_refused_with_the_condition(kind):
    model, state, words = REFUSED_MOTIONS[kind]
    with pytest.raises(ClosedFormMismatch, match=words):
        closed_form_motion(ScenarioStub(kind, model, state))


@pytest.mark.parametrize("kind", CLOSED_FORMS)
def test_loads_are_refused(kind):
    case = next(s for s in CLOSED_FORM_SCENARIOS.values() if s.closed_form == kind)
    with pytest.raises(ClosedFormMismatch, match="no loads"):
        closed_form_motion(
            ScenarioStub(kind, replace(case.model, moment=case.model.moment + 0.1), case.state)
        )


def test_a_scenario_without_closed_form_has_no_motion():
    assert closed_form_motion(ScenarioStub(None, one_body(), RESTING)) is None


@pytest.mark.parametrize("m1", [1.0, 0.9, 0.3, 1e-2])
def test_elliptic_functions_agree_with_scipy(m1):
    u = np.linspace(-12, 12, 101)
    for own, theirs in zip(jacobi(u, m1), ellipj(u, 1 - m1), strict=True):
        assert own == pytest.approx(theirs, abs=3e-13)
    assert elliptic_f(u, m1) == pytest.approx(ellipkinc(u, 1 - m1), rel=1e-13, abs=1e-15)


@pytest.mark.parametrize("m1", [1e-3, 1e-12, 1e-30, 0.0])
def test_elliptic_functions_keep_their_digits_near_the_separatrix(m1):
    """Am inverts F, to a few units in the last place of u, however close m is to 1."""
    phi = np.linspace(-1.3, 1.3, 27)
    sn, cn, dn, am = jacobi(elliptic_f(phi, m1), m1)
    assert am == pytest.approx(phi, abs=3e-15)
    assert sn**2 + cn**2 == pytest.approx(np.ones(27), abs=1e-15)
    assert dn == pytest.approx(np.sqrt(np.cos(phi) ** 2 + m1 * np.sin(phi) ** 2), abs=3e-15)


def test_the_integral_of_the_third_kind_agrees_with_mpmath():
    mpmath = pytest.importorskip("mpmath")
    for n, phi, m in ((0.3, 1.2, 0.7), (-2.0, 4.0, 0.2), (0.9, -7.5, 0.5), (-0.1, 0.4, 0.999)):
        assert elliptic_pi(n, phi, 1 - m) == pytest.approx(float(mpmath.ellippi(n, phi, m)), rel=1e-13)
