"""The system of the notes, N1–N6: Lagrange's equation, S and b as printed, their solution, N6."""

import numpy as np
import pytest
from scipy.special import ellipk

from reference_impl import integrate as integrator
from reference_impl import notes
from reference_impl.direct import DirectSystem, is_singular, power_of_two_scale, solve_dense
from reference_impl.euler_parameters import A, L, angular_velocity
from reference_impl.euler_parameters import euler_parameter_rate as pdot_of
from reference_impl.fast.tree_elimination import fastest_acceleration
from reference_impl.integrate import (
    direct_acceleration,
    integrate_dop853,
    pack_state,
    state_scales,
    unpack_state,
)
from reference_impl.joints import constraint_rows
from tests.helpers.notes_test_data import Symbols, loaded_chain, state_off_manifold, state_on_manifold
from tests.helpers.random_chains import random_model

MIXES = [[True], [False], [True, True], [False, False], [True, False, False, True, False], [False] * 50]


def unknowns_vector(x):
    return np.concatenate([x.acceleration.ravel(), x.pddot.ravel(), x.multiplier, x.norm_multiplier])


def test_N2_is_lagranges_equation():
    """d_t ∂T/∂ṗ − ∂T/∂p = 4 LᵀJL p̈ − 8 L̇ᵀJL̇ p of T = 2 ṗᵀLᵀJLṗ; n′ does the power n′ᵀω′: for every p."""
    x = Symbols(bodies=2, attachments=3)
    p, pdot, pddot, moment = x.p[0], x.pdot[0], x.p[1], x.r[0]
    J = x.s + x.s.T
    T = 2 * (pdot @ L(p).T @ J @ L(p) @ pdot)
    momentum = x.gradient(T, pdot)
    left = x.gradient(momentum, p) @ pdot + x.gradient(momentum, pdot) @ pddot - x.gradient(T, p)
    quadratic = 8 * (L(pdot).T @ J @ L(pdot) @ p)
    assert x.is_zero(left - 4 * (L(p).T @ J @ L(p) @ pddot) + quadratic)
    assert x.is_zero(quadratic + 8 * (L(pdot).T @ J @ L(p) @ pdot)), "the sign that the lost dots decide"
    assert x.is_zero(x.gradient(moment @ angular_velocity(p, pdot), pdot) - 2 * (L(p).T @ moment))


@pytest.mark.parametrize("states", [state_on_manifold, state_off_manifold])
@pytest.mark.parametrize("n", [1, 2])
def test_N5_is_assembled_as_printed(n, states):
    chain, state = loaded_chain([True] * n, n, states)
    S, b = DirectSystem(chain).assemble(*state)
    S_printed, b_printed = notes.assemble_system(chain, *state)
    np.testing.assert_allclose(S, S_printed, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(b, b_printed, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("states", [state_on_manifold, state_off_manifold])
@pytest.mark.parametrize("rods", MIXES, ids=str)
def test_the_band_and_the_dense_form_give_the_same_solution(rods, states):
    """Both solve S x = b to a backward error of a few roundings, so they differ by that times κ at most."""
    chain, state = loaded_chain(rods, len(rods), states)
    system = DirectSystem(chain)
    S, b = system.assemble(*state)
    x, dense = unknowns_vector(system.solve(*state)), solve_dense(S, b)
    np.testing.assert_allclose(x, dense, rtol=0, atol=1e-14 * np.max(np.abs(dense)))
    read, densely = system.solve(*state), system.solve_with_dense_factors(*state)
    np.testing.assert_array_equal(unknowns_vector(densely), dense)
    reaction = 1e-13 * np.max(np.abs(read.joint_reaction))
    np.testing.assert_allclose(densely.joint_reaction, read.joint_reaction, rtol=0, atol=reaction)
    residual = np.abs(S @ x - b) / (np.abs(S) @ np.abs(x) + np.abs(b))
    assert np.max(residual) < 16 * np.finfo(float).eps
    assert system._width <= 10, "of the band, whatever the number of bodies"


@pytest.mark.parametrize("without", [(), ("drag_force",), ("drag_moment",)], ids=str)
@pytest.mark.parametrize("rods", MIXES, ids=str)
def test_the_solution_obeys_newton_and_euler(rods, without):
    """m r̈ = F + reactions and J ω̇′ + ω′ × J ω′ = moments of the reactions about the centre of mass + n′."""
    chain, (r, p, v, pdot) = loaded_chain(rods, 11 + len(rods))
    chain = chain.changed(**{name: np.zeros(chain.n) for name in without})
    x = DirectSystem(chain).solve(r, p, v, pdot)
    omega, turn = angular_velocity(p, pdot), A(p)
    near, far = x.joint_reaction, -np.concatenate([x.joint_reaction[1:], np.zeros((1, 3))])
    load = chain.mass[:, None] * chain.gravity + chain.force - chain.drag_force[:, None] * v
    np.testing.assert_allclose(chain.mass[:, None] * x.acceleration, load + near + far, atol=1e-12)

    def body(force):
        return (turn.swapaxes(-1, -2) @ force[..., None])[..., 0]

    def inertial(w):
        return (chain.inertia @ w[..., None])[..., 0]

    moment = np.cross(chain.proximal, body(near)) + np.cross(chain.distal, body(far))
    moment += chain.moment - chain.drag_moment[:, None] * omega
    omega_dot = 2 * (L(p) @ x.pddot[..., None])[..., 0]
    np.testing.assert_allclose(inertial(omega_dot) + np.cross(omega, inertial(omega)), moment, atol=1e-12)


def test_units_do_not_decide_the_digits():
    """The same motion with masses × 2^±30: without equilibration the pivots would follow the units."""
    chain, state = loaded_chain([True, False, True], 5)
    x = DirectSystem(chain).solve(*state)
    loads = ("mass", "inertia", "force", "moment", "drag_force", "drag_moment")
    for scale in (2.0**-30, 2.0**30):
        scaled = chain.changed(**{name: scale * getattr(chain, name) for name in loads})
        y = DirectSystem(scaled).solve(*state)
        np.testing.assert_allclose(y.acceleration, x.acceleration, rtol=0, atol=1e-13)
        np.testing.assert_allclose(y.joint_reaction / scale, x.joint_reaction, rtol=0, atol=1e-13)


def test_refinement_solves_every_row_to_its_own_rounding():
    """Masses over 1e±3: |S x − b| ≤ (k + 1) ε (|S||x| + |b|) row by row, k entries in the fullest row.

    That is the rounding of evaluating the residual itself; 1.0 ε seen, and 830 ε without refinement.
    """
    rng = np.random.default_rng(0)
    for _ in range(100):
        chain = random_model(rng, list(rng.random(4) < 0.5), loads=True, drag=True)
        scale = 10 ** rng.uniform(-3, 3, 4)
        chain = chain.changed(mass=chain.mass * scale, inertia=chain.inertia * scale[:, None, None])
        state = state_on_manifold(chain, rng)
        system = DirectSystem(chain)
        S, b = system.assemble(*state)
        fullest = np.max(np.count_nonzero(S, axis=1))
        for x in (unknowns_vector(system.solve(*state)), solve_dense(S, b)):
            x = x.astype(np.longdouble)
            residual = np.abs(S.astype(np.longdouble) @ x - b) / (np.abs(S) @ np.abs(x) + np.abs(b))
            assert np.max(residual) <= (fullest + 1) * np.finfo(float).eps


def test_a_planted_defect_is_added_to_every_gamma():
    """C_r r̈ + C_p p̈ = γ + δ, a δ for each row."""
    chain, state = loaded_chain([True, False, True], 14)
    joints, delta = constraint_rows(chain, *state), np.arange(1.0, 6.0)
    x = DirectSystem(chain).solve(*state, gamma_defect=delta)
    np.testing.assert_allclose(
        joints.constraint_rate(x.acceleration, x.pddot) - joints.gamma, delta, atol=1e-11
    )
    still = 2 * np.sum(state[1] * x.pddot, axis=1) + 2 * np.sum(state[3] ** 2, axis=1)
    np.testing.assert_allclose(still, 0, atol=1e-12)


def test_units_do_not_decide_the_steps_of_N6():
    """A thousandth of the size: the absolute tolerance is in the sizes of the motion."""
    rng = np.random.default_rng(15)
    chain = random_model(rng, [False])
    r, p, v, pdot = state_on_manifold(chain, rng)
    times, unit = np.array([0.0, 0.5]), 2.0**-10
    here = integrate_dop853(chain, r, p, v, pdot, times, 1e-6)
    small = chain.changed(
        inertia=unit**2 * chain.inertia,
        **{name: unit * getattr(chain, name) for name in ("proximal", "distal", "gravity")},
    )
    there = integrate_dop853(small, unit * r, p, unit * v, pdot, times, 1e-6)
    # the very same steps: what differs is rounding (4 ε a step and coordinate), far below a step's 1e-6
    assert there.steps == here.steps
    np.testing.assert_allclose(there.r, unit * here.r, rtol=1e-9)


def test_a_vanishing_step_of_N6_is_an_error():
    chain, state = loaded_chain([False], 16)
    stiff = chain.changed(drag_force=np.array([1e17]))
    with pytest.raises(ArithmeticError, match="DOP853 stopped at t = "):
        integrate_dop853(stiff, *state, np.array([1.0, 2.0]), 1e-6)


def test_N6_orders_y_as_r_p_v_pdot():
    chain, state = loaded_chain([True, False], 8)
    y = pack_state(*state)
    for part, back in zip(state, unpack_state(y, 2), strict=True):
        np.testing.assert_array_equal(part, back)
    x = DirectSystem(chain).solve(*state)
    expected = np.concatenate([x.acceleration.ravel(), x.pddot.ravel()])
    np.testing.assert_array_equal(direct_acceleration(chain)(*state), expected)


def planar_pendulum(amplitude, arm=0.4, mass=1.3, about_centre=0.05):
    """A body on a ball joint that swings about the y axis, at rest at ``amplitude``."""
    rng = np.random.default_rng(0)
    chain = random_model(rng, [False]).changed(
        mass=np.array([mass]),
        inertia=about_centre * np.eye(3)[None],
        proximal=np.array([[0, 0, arm]]),
        gravity=np.array([0, 0, -9.81]),
    )
    p = np.array([[np.cos(amplitude / 2), 0, np.sin(amplitude / 2), 0]])
    omega_0 = np.sqrt(mass * 9.81 * arm / (about_centre + mass * arm**2))
    r = -(A(p) @ chain.proximal[..., None])[..., 0]
    return chain, (r, p, np.zeros((1, 3)), np.zeros((1, 4))), 4 * ellipk(np.sin(amplitude / 2) ** 2) / omega_0


def test_N6_swings_with_the_exact_period():
    """After one period 4 K(sin²(θ₀/2)) / ω₀ of a 170° swing the body is back, with rtol's accuracy."""
    chain, state, period = planar_pendulum(np.radians(170))
    errors = []
    for rtol in (1e-6, 1e-9, 1e-12):
        run = integrate_dop853(chain, *state, np.array([0, period / 2, period]), rtol)
        errors.append(np.max(np.abs(run.r[-1] - state[0])))
        np.testing.assert_allclose(run.r[1, 0, 0], -state[0][0, 0], atol=1e3 * rtol)
    assert errors[2] < 1e-9, errors
    assert errors[2] < 1e-3 * errors[1] * 10 and errors[1] < 1e-3 * errors[0] * 10, errors


def test_samples_do_not_change_the_steps():
    """Dense output: the same steps whatever times are asked, and the last sample is a step's own end."""
    chain, state = loaded_chain([True, False], 9)
    few = integrate_dop853(chain, *state, np.array([0.0, 1.0]), 1e-10)
    many = integrate_dop853(chain, *state, np.linspace(0, 1, 101), 1e-10)
    assert (few.steps, few.t.size, many.t.size) == (many.steps, 2, 101)
    np.testing.assert_array_equal(few.r[-1], many.r[-1])
    gap = np.abs(integrate_dop853(chain, *state, np.array([0.0, 0.37]), 1e-10).r[-1] - many.r[37])
    assert np.max(gap) < 1e-9


def test_natural_sizes_are_of_the_stretched_chain_its_fall_and_its_motion():
    chain, (r, p, v, _) = loaded_chain([True, False, True], 12)
    near, far = (np.linalg.norm(s, axis=1) for s in (chain.proximal, chain.distal))
    reach = np.sum(chain.length) + np.sum(near) + far[0] + far[1]
    fall = np.sqrt(np.linalg.norm(chain.gravity) * reach)

    def sizes(r, v, omega, chain=chain):
        y = state_scales(chain, r, p, v, pdot_of(p, omega))
        parts = np.split(y, np.cumsum([9, 12, 9]))
        assert [len(part) for part in parts] == [9, 12, 9, 12] and all(np.ptp(part) == 0 for part in parts)
        return [part[0] for part in parts]

    still, turn = np.zeros((3, 3)), np.array([[0, 0, 0], [0, -40.0, 0], [1, 0, 0]])
    assert sizes(r, still, still) == pytest.approx([reach, 1, fall, fall / reach / 2], rel=1e-14)
    fast = sizes(r, v - np.array([[0, 0, 0], [0, 0, 50.0], [0, 0, 0]]), still)
    assert fast[2] == np.max(np.abs(v[1, 2] - 50)) and fast[3] == pytest.approx(fast[2] / reach / 2)
    assert sizes(r, still, turn) == pytest.approx([reach, 1, 40 * reach, 20], rel=1e-13)
    away = sizes(r - [[0, 9.0, 0]] * np.ones((3, 1)), still, still)
    assert away[0] == np.max(np.abs(r - [0, 9.0, 0])) > reach
    point = chain.changed(proximal=still, distal=still, length=np.zeros(3), gravity=np.zeros(3))
    assert sizes(still, still, still, point) == [1, 1, 0, 0]


def test_the_structured_form_integrates_the_same_and_steps_are_counted(monkeypatch):
    chain, state = loaded_chain([True, False, True], 13)
    times = np.linspace(0, 0.3, 4)
    counted = []

    class Counted(integrator.DOP853):
        def step(self):
            counted.append(self.t)
            return super().step()

    monkeypatch.setattr(integrator, "DOP853", Counted)
    direct = integrate_dop853(chain, *state, times, 1e-10)
    assert direct.steps == len(counted) and direct.evaluations > 10 * direct.steps
    structured = integrate_dop853(chain, *state, times, 1e-10, acceleration=fastest_acceleration(chain))
    assert structured.steps == direct.steps and structured.evaluations == direct.evaluations
    for name in ("r", "p", "v", "pdot"):
        np.testing.assert_allclose(getattr(structured, name), getattr(direct, name), rtol=0, atol=1e-10)


def test_the_printed_system_is_exact_on_complex_numbers():
    """dS/dp along a direction by a complex step is that by differences: no part drops the imaginary one."""
    rng = np.random.default_rng(14)
    chain = random_model(rng, [True, True], loads=True, drag=True)
    r, p, v, pdot = state_on_manifold(chain, rng)
    along, h = rng.normal(size=p.shape), 1e-6
    S, b = notes.assemble_system(chain, r, p + 1e-30j * along, v, pdot)
    ends = [notes.assemble_system(chain, r, p + s * h * along, v, pdot) for s in (1, -1)]
    for x, (up, down) in zip((S, b), zip(*ends, strict=True), strict=True):
        np.testing.assert_allclose(x.imag / 1e-30, (up - down) / (2 * h), rtol=0, atol=1e-8)


def test_one_and_two_bodies_are_what_the_notes_print():
    chain, state = loaded_chain([True] * 3, 3)
    with pytest.raises(ValueError, match="one and two bodies"):
        notes.assemble_system(chain, *state)


def test_equilibration_is_by_the_powers_of_two_that_bring_entries_near_1():
    largest = np.array([3e-9, 0.3, 0.5, 1.0, 2.0, 7.0, 4e11])
    scale = power_of_two_scale(largest)
    np.testing.assert_array_equal(np.frexp(scale)[0], 0.5)
    assert np.all((scale**2 * largest >= 0.5) & (scale**2 * largest < 2))
    assert power_of_two_scale(np.zeros(1)).tolist() == [1.0], "an empty row stays as it is"


@pytest.mark.parametrize("unit", [1e-5, 1.0, 1e5])
def test_what_is_singular_to_rounding_is_so_in_any_unit(unit):
    assert is_singular(unit * np.array([1.0, -1e-17]))
    assert not is_singular(unit * np.array([1.0, -1e-14]))
