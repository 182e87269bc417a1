"""What a reader of the notes must know, E1–E7 (E4, the drift, has a file of its own)."""

import numpy as np
import pytest

from reference_impl import notes
from reference_impl.direct import DirectSystem, check_state_solvable, solve_dense
from reference_impl.euler_parameters import A, G, H, L, dAs_dp, dot
from reference_impl.integrate import integrate_dop853
from reference_impl.joints import constraint_rows
from reference_impl.mechanism import Mechanism
from reference_impl.singular_system import SingularSystem
from tests.helpers.notes_test_data import Symbols, loaded_chain, state_off_manifold, state_on_manifold
from tests.helpers.random_chains import random_model


def hanging_chain(rods, length=0.5, arm=0.3):
    """Bodies at rest straight below each other, attachments on the body's z axis."""
    n = len(rods)
    zeros = np.zeros((n, 3))
    chain = Mechanism.chain(
        mass=np.arange(1.0, n + 1),
        inertia=np.broadcast_to(0.02 * np.diag([1.0, 1.2, 0.9]), (n, 3, 3)),
        proximal=zeros + np.array([0, 0, arm]),
        distal=zeros - np.array([0, 0, arm]),
        length=np.where(rods, length, 0.0),
        gravity=np.array([0, 0, -9.81]),
        force=zeros,
        moment=zeros,
        drag_force=zeros[:, 0],
        drag_moment=zeros[:, 0],
    )
    r = zeros.copy()
    r[:, 2] = -np.cumsum(chain.length + 2 * arm) + arm
    return chain, (r, np.tile([1.0, 0, 0, 0], (n, 1)), zeros, np.zeros((n, 4)))


# --- E1 -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2])
def test_E1_printed_with_length_0_is_singular_and_names_the_body(n):
    """Read literally, d = 0: C_r = 0, and C_p, 0 for dᵀd, is by E2 a multiple of pᵀ: the normalisation row.

    The printed form reads every joint as a rod.
    """
    chain, state = hanging_chain([False] * n)
    S, b = notes.assemble_system(chain, *state)
    rows_C, rows_E = S[7 * n : 8 * n], S[8 * n :]
    np.testing.assert_allclose(rows_C[:, : 3 * n], 0, atol=1e-15)
    assert np.linalg.matrix_rank(np.concatenate([rows_C, rows_E])) == n
    with pytest.raises(SingularSystem, match="singular"):
        solve_dense(S, b)
    with pytest.raises(SingularSystem, match=r"rod above body 1 has length 0.*E1.*ball"):
        notes.solve_system(chain, *state)


def test_E1_a_rod_whose_ends_meet_is_singular_in_the_general_form_too():
    """Also where rounding leaves 1e-17 of d, which would otherwise be solved as a direction."""
    chain, (r, p, v, pdot) = loaded_chain([False, False, False], 0)
    rod = chain.changed(length=np.array([0, 0, 0.4]))
    d = constraint_rows(rod, r, p, v, pdot).d[2]
    assert np.linalg.norm(d) < 1e-15
    with pytest.raises(SingularSystem, match="rod above body 3 has length 0"):
        DirectSystem(rod).solve(r, p, v, pdot)


def test_E1_the_length_changes_neither_jacobians_nor_gamma():
    chain, state = loaded_chain([True, True], 1)
    longer = chain.changed(length=chain.length + 1)
    one, other = (DirectSystem(c).assemble(*state) for c in (chain, longer))
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1], other[1])


def test_E1_the_ball_is_the_limit_of_the_rod():
    """A rod that starts along the ball's reaction swings about it ever less: positions differ by O(ℓ)."""
    rng = np.random.default_rng(2)
    ball = random_model(rng, [False])
    r, p, v, pdot = state_on_manifold(ball, rng)
    times = np.linspace(0, 0.5, 6)
    truth = integrate_dop853(ball, r, p, v, pdot, times, 1e-10)
    pull = DirectSystem(ball).solve(r, p, v, pdot).joint_reaction
    direction = -pull / np.linalg.norm(pull)
    errors = []
    for length in (1e-2, 1e-3):
        rod = ball.changed(length=np.array([length]))
        run = integrate_dop853(rod, r + length * direction, p, v, pdot, times, 1e-9)
        errors.append(np.max(np.abs(run.r - truth.r)))
    assert errors[0] < 0.1 and errors[1] < 0.15 * errors[0], errors


# --- E2, E3 ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2])
def test_E2_changes_only_the_norm_multiplier(n):
    """With the derivatives of dᵀd itself C_p differs by multiples of pᵀ: r̈, p̈, λ are the same, λ_E is not."""
    rng, h = np.random.default_rng(3), 1e-30
    chain = random_model(rng, [True] * n, loads=True, drag=True)

    def jacobian(r, p):
        """Of every dᵀd, (N, 7 N)."""
        near = r + np.einsum("kij,kj->ki", A(p), chain.proximal)
        far = r + np.einsum("kij,kj->ki", A(p), chain.distal)
        d = near - np.concatenate([0 * far[:1], far[:-1]])
        of_r, of_p = np.zeros((n, n, 3), d.dtype), np.zeros((n, n, 4), d.dtype)
        for k in range(n):
            of_r[k, k], of_p[k, k] = 2 * d[k], 2 * d[k] @ dAs_dp(p[k], chain.proximal[k])
            if k > 0:
                of_r[k, k - 1], of_p[k, k - 1] = -2 * d[k], -2 * d[k] @ dAs_dp(p[k - 1], chain.distal[k - 1])
        return np.concatenate([of_r.reshape(n, -1), of_p.reshape(n, -1)], axis=1)

    r, p, v, pdot = state_on_manifold(chain, rng)
    S, b = notes.assemble_system(chain, r, p, v, pdot)
    x, rows, rates = solve_dense(S, b), jacobian(r, p), np.concatenate([v.ravel(), pdot.ravel()])
    difference = (rows - S[7 * n : 8 * n, : 7 * n])[:, 3 * n :].reshape(n, n, 4)  # of C_p, joint by body
    along = np.einsum("jki,ki->jk", difference, p)
    assert np.all(np.abs(along[np.tril_indices(n)]) > 0.01)
    np.testing.assert_allclose(difference, along[..., None] * p, atol=2e-15)
    S[7 * n : 8 * n, : 7 * n], S[: 7 * n, 7 * n : 8 * n] = rows, rows.T
    b[7 * n : 8 * n] = -(jacobian(r + 1j * h * v, p + 1j * h * pdot).imag / h) @ rates
    y = solve_dense(S, b)
    np.testing.assert_allclose(y[: 8 * n], x[: 8 * n], rtol=0, atol=1e-13 * np.max(np.abs(x)))
    assert np.all(np.abs(y[8 * n :] - x[8 * n :]) > 1e-3)


def test_E2_off_the_sphere_is_another_constraint():
    """The notes' C minus dᵀd − ℓ² is s₁ᵀs₁ − s₁ᵀAᵀA s₁: 0 where pᵀp = 1 only."""
    rng = np.random.default_rng(4)
    chain = random_model(rng, [True], loads=True, drag=True)
    for states, off in ((state_on_manifold, False), (state_off_manifold, True)):
        r, p, v, pdot = states(chain, rng)
        joints = constraint_rows(chain, r, p, v, pdot)
        turned = A(p[0]) @ chain.proximal[0]
        difference = joints.C[0] - (dot(joints.d, joints.d)[0] - chain.length[0] ** 2)
        np.testing.assert_allclose(
            difference, dot(chain.proximal, chain.proximal)[0] - turned @ turned, atol=1e-15
        )
        assert (abs(difference) > 1e-3) == off


def test_E3_is_exact_for_a_chain():
    """γ_true − γ = −d_t(C) rows with 2 (pᵀṗ) I added to every Ȧ, the single one −4 (s₁ᵀṙ)(pᵀṗ)."""
    chain, (r, p, v, pdot) = loaded_chain([True, True, True], 5, state_off_manifold)
    h = 1e-30
    joints = constraint_rows(chain, r, p, v, pdot)
    moved = constraint_rows(chain, r + 1j * h * v, p + 1j * h * pdot, v.astype(complex), pdot.astype(complex))
    missing = -moved.constraint_rate(v, pdot).imag / h - joints.gamma
    np.testing.assert_allclose(missing[0], -4 * (chain.proximal[0] @ v[0]) * (p[0] @ pdot[0]), atol=1e-13)
    for k in (1, 2):
        near, far = dot(p[k], pdot[k]) * chain.proximal[k], dot(p[k - 1], pdot[k - 1]) * chain.distal[k - 1]
        near_rate, far_rate = (
            dAs_dp(p[k], chain.proximal[k]) @ pdot[k],
            dAs_dp(p[k - 1], chain.distal[k - 1]) @ pdot[k - 1],
        )
        expected = -4 * (v[k] - v[k - 1]) @ (near - far) + 4 * (far @ near_rate + near @ far_rate)
        np.testing.assert_allclose(missing[k], expected, atol=1e-13)
    assert np.all(np.abs(missing) > 1e-3)


# --- E5 -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rods", [[True], [False], [True, True], [True, False, True]], ids=str)
def test_E5_multipliers_at_rest_carry_the_weight(rods):
    """Tension 2 ℓ λ and the reaction are the weight hanging below; λ of a ball is minus the reaction."""
    chain, state = hanging_chain(rods)
    x = DirectSystem(chain).solve(*state)
    weight = np.cumsum(chain.mass[::-1])[::-1] * 9.81
    np.testing.assert_allclose(x.acceleration, 0, atol=1e-13)
    np.testing.assert_allclose(x.joint_reaction, weight[:, None] * [0, 0, 1], atol=1e-12)
    for k, rod in enumerate(rods):
        multiplier = x.multiplier[x.joint == k]
        if rod:
            np.testing.assert_allclose(x.tension[k], weight[k], rtol=1e-13)
            np.testing.assert_allclose(multiplier, weight[k] / (2 * chain.length[k]), rtol=1e-13)
        else:
            assert np.isnan(x.tension[k])
            np.testing.assert_allclose(multiplier, -x.joint_reaction[k], atol=0)


def test_E5_the_reaction_of_a_rod_is_minus_2_lambda_d():
    chain, state = loaded_chain([True, True], 6)
    x, d = DirectSystem(chain).solve(*state), constraint_rows(chain, *state).d
    np.testing.assert_allclose(x.joint_reaction, -2 * x.multiplier[:, None] * d, atol=1e-14)
    np.testing.assert_allclose(np.abs(x.tension), np.linalg.norm(x.joint_reaction, axis=1), rtol=1e-14)


# --- E6 -------------------------------------------------------------------------------------------------


def test_E6_the_recognised_text_without_transposes_is_not_the_derivative():
    x = Symbols(bodies=2, attachments=3)
    pendulum = notes.DoublePendulum(x.r, x.p, x.v, x.pdot, x.s, x.length)
    (_, s2, s3), (p1, p2) = x.s, x.p
    lost = 4 * ((x.r[0] - x.r[1]) @ H(p1, s2)) - 4 * (s3 @ A(p2) @ H(p1, s2))
    assert not x.is_zero(lost - x.gradient(pendulum.C[1], p1))
    unequal = 2 * (x.v[0] - x.v[1]) + 4 * (s2 @ L(x.pdot[0]) @ G(p1).T)
    assert not x.is_zero(unequal - pendulum.C2_r_rate[:3])


# --- E7 -------------------------------------------------------------------------------------------------


def test_E7_rank_three_without_the_normalisation_row():
    chain, (r, p, v, pdot) = loaded_chain([True], 7)
    block = 4 * L(p[0]).T @ chain.inertia[0] @ L(p[0])
    assert np.linalg.matrix_rank(block) == 3
    np.testing.assert_allclose(block @ p[0], 0, atol=1e-15)
    S, b = DirectSystem(chain).assemble(r, p, v, pdot)
    assert np.linalg.matrix_rank(S) == 9
    # Hung at its centre of mass C_p = 0, so nothing but the normalisation row holds the kernel along p.
    loose = chain.changed(proximal=np.zeros((1, 3)))
    S, b = DirectSystem(loose).assemble(r, p, v, pdot)
    assert np.linalg.matrix_rank(S[:8, :8]) == 7
    with pytest.raises(SingularSystem):
        solve_dense(S[:8, :8], b[:8])


@pytest.mark.parametrize("rods", [[True, True], [False, False], [True, False]], ids=str)
def test_E7_p_zero_names_the_body(rods):
    chain, (r, p, v, pdot) = loaded_chain(rods, 8)
    p[1] = 0
    with pytest.raises(SingularSystem, match=r"p of body 2 is 0.*E7"):
        DirectSystem(chain).solve(r, p, v, pdot)


def test_E7_singular_inertia_names_the_body():
    """No inertia about the axis through the attachments: a spin about it meets no resistance."""
    chain, state = hanging_chain([False, True])
    inertia = chain.inertia.copy()
    inertia[1, 2, 2] = 0
    with pytest.raises(SingularSystem, match=r"inertia of body 2 is singular.*E7"):
        DirectSystem(chain.changed(inertia=inertia)).solve(*state)
    with pytest.raises(SingularSystem, match=r"inertia of body 2 is singular.*E7"):
        integrate_dop853(chain.changed(inertia=inertia), *state, np.array([0.0, 1.0]), 1e-6)


def test_E1_a_rod_is_as_short_as_its_own_surroundings_allow():
    """A rod of 1e-9 m is a direction beside bodies of decimetres, and rounding 1e7 m from the pivot."""
    chain, (r, p, *_) = loaded_chain([True, True], 16)
    far = np.array([[0, 0, 0], [1e7, 0, 0]])
    d, entries = 1e-9 * np.eye(3)[:2], (np.ones(1),)
    check_state_solvable(chain, r, p, d, chain.rods, entries)
    with pytest.raises(SingularSystem, match="rod above body 2 has length 0"):
        check_state_solvable(chain, r + far, p, d, chain.rods, entries)
    with pytest.raises(SingularSystem, match="rod above body 1 has length 0"):
        check_state_solvable(chain, r + far[::-1], p, d, chain.rods, entries)


@pytest.mark.parametrize("heavy", [1.0, 1e6, 1e-6])
def test_E7_an_inertia_is_flat_beside_its_own_size(heavy):
    """A stick along a slanting axis has a least principal value of rounding, in any unit."""
    chain, state = hanging_chain([False, True])
    turn = np.linalg.qr(np.random.default_rng(15).normal(size=(3, 3)))[0]
    inertia, proximal = heavy * chain.inertia, chain.proximal.copy()
    stick = turn @ np.diag([0.02, 0.02, 0]) @ turn.T
    inertia[1], proximal[1] = heavy * (stick + stick.T) / 2, 0.3 * turn[:, 2]
    flat = chain.changed(mass=heavy * chain.mass, inertia=inertia, proximal=proximal)
    with pytest.raises(SingularSystem, match=r"inertia of body 2 is singular.*E7"):
        DirectSystem(flat).solve(*state)


def test_a_singular_inertia_that_the_joint_makes_good_is_solved():
    """J of a thin stick hung off its axis: S is regular, and its solution is the limit of thicker sticks."""
    rng = np.random.default_rng(9)
    chain = random_model(rng, [False])
    state = state_on_manifold(chain, rng)
    answers = []
    for thin in (1e-6, 0.0):
        stick = chain.changed(inertia=0.05 * np.diag([1.0, 1.0, thin])[None])
        answers.append(DirectSystem(stick).solve(*state).acceleration)
    np.testing.assert_allclose(answers[0], answers[1], atol=1e-3)


def test_no_mass_names_the_body():
    chain, state = hanging_chain([True, True])
    massless = chain.changed(mass=np.array([1.0, 0.0]), inertia=0 * chain.inertia)
    with pytest.raises(SingularSystem, match="mass of body 2 is 0"):
        DirectSystem(massless).solve(*state)


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [(0, np.nan, "body 2"), (1, np.inf, "body 2"), (2, np.nan, "rate"), (3, np.inf, "rate")],
)
def test_what_is_not_finite_is_named(part, value, message):
    chain, state = hanging_chain([True, False])
    state = [x.copy() for x in state]
    state[part][1, 1] = value
    with pytest.raises(SingularSystem, match=rf"{message}.*not finite"):
        DirectSystem(chain).solve(*state)


@pytest.mark.parametrize("n", [1, 2])
def test_the_pendulum_of_the_notes_is_regular(n):
    """On rods of ℓ > 0, s₁ on a body axis included, S has rank 9 N (E7), x satisfies every row of (N5)."""
    rng = np.random.default_rng(10)
    chain = random_model(rng, [True] * n, loads=True, drag=True)
    chain = chain.changed(proximal=np.array([[-0.4, 0, 0]] * n))
    state = state_on_manifold(chain, rng)
    S, b = notes.assemble_system(chain, *state)
    assert S.shape == (9 * n, 9 * n) and np.linalg.matrix_rank(S) == 9 * n
    x = notes.solve_system(chain, *state)
    np.testing.assert_allclose(S @ x, b, atol=1e-12 * np.max(np.abs(b)))
    general = DirectSystem(chain).solve(*state)
    np.testing.assert_allclose(x[: 3 * n], general.acceleration.ravel(), atol=1e-12)
    np.testing.assert_allclose(x[7 * n : 8 * n], general.multiplier, atol=1e-12)
    loose = chain.changed(proximal=np.zeros((n, 3)), distal=np.zeros((n, 3)))
    S, _ = notes.assemble_system(loose, *state_on_manifold(loose, rng))
    assert np.linalg.matrix_rank(S) == 9 * n
    assert np.linalg.matrix_rank(S[: 8 * n, : 8 * n]) == 7 * n, "C_p = 0: only the norm holds p̈ along p (E7)"
