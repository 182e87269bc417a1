"""The general chain of rods and balls: the printed forms where they exist, differentiation everywhere."""

import numpy as np
import pytest

from reference_impl.euler_parameters import dot
from reference_impl.joints import constraint_rows
from reference_impl.mechanism import Mechanism
from reference_impl.notes import DoublePendulum, SinglePendulum
from tests.helpers.notes_test_data import Symbols, loaded_chain, state_off_manifold, state_on_manifold


def symbolic_chain(rods):
    """A chain of symbols (lengths 2, 3 where there are rods), its symbols and its rows."""
    n = len(rods)
    x = Symbols(bodies=n, attachments=2 * n)
    names = "mass", "inertia", "gravity", "force", "moment", "drag_force", "drag_moment"
    length = np.where(rods, np.arange(2, 2 + n), 0)
    chain = Mechanism.chain(x.s[:n], x.s[n:], length, **dict.fromkeys(names, np.zeros(n)))
    return x, chain, constraint_rows(chain, x.r, x.p, x.v, x.pdot)


def jacobians(joints, n):
    """C_r (c, 3 n) and C_p (c, 4 n) from the blocks of the near and far bodies."""
    C_r = np.zeros((len(joints.joint), n, 3), joints.C.dtype)
    C_p = np.zeros((len(joints.joint), n, 4), joints.C.dtype)
    for row, k in enumerate(joints.joint):
        C_r[row, k], C_p[row, k] = joints.r_near[row], joints.p_near[row]
        if k > 0:
            C_r[row, k - 1], C_p[row, k - 1] = -joints.r_near[row], joints.p_far[row]
    return C_r.reshape(-1, 3 * n), C_p.reshape(-1, 4 * n)


@pytest.mark.parametrize("n", [1, 2])
def test_rods_are_the_printed_forms_identically(n):
    """As polynomials, so on the manifold and off it."""
    x, chain, joints = symbolic_chain([True] * n)
    C_r, C_p = jacobians(joints, n)
    if n == 1:
        printed = SinglePendulum(x.r[0], x.p[0], x.v[0], x.pdot[0], x.s[0], 2)
    else:
        printed = DoublePendulum(x.r, x.p, x.v, x.pdot, x.s[[0, 2, 1]], chain.length)
    for general, as_printed in (
        (joints.C, printed.C),
        (C_r, printed.C_r),
        (C_p, printed.C_p),
        (joints.gamma, printed.gamma),
    ):
        assert x.is_zero(general - as_printed)


@pytest.mark.parametrize(
    "rods", [[False], [True], [False, False], [True, True], [True, False], [False, True]], ids=str
)
def test_every_mix_of_two_differentiates(rods):
    """C_r, C_p differentiate C for every p; γ does too for balls, and up to E3 for rods."""
    x, _, joints = symbolic_chain(rods)
    C_r, C_p = jacobians(joints, len(rods))
    assert x.is_zero(C_r - x.gradient(joints.C, x.r.ravel()))
    assert x.is_zero(C_p - x.gradient(joints.C, x.p.ravel()))
    assert x.is_zero(joints.constraint_rate(x.v, x.pdot) - x.time_derivative(joints.C))
    true = -x.time_derivative(C_r) @ x.v.ravel() - x.time_derivative(C_p) @ x.pdot.ravel()
    ball = ~np.array(rods)[joints.joint]
    assert x.is_zero((true - joints.gamma)[ball])
    assert not ball.all() or x.is_zero(true - joints.gamma)


@pytest.mark.parametrize("states", [state_on_manifold, state_off_manifold])
def test_a_long_mixed_chain_differentiates_by_complex_step(states):
    """Ċ and γ at N = 7; off the manifold pᵀṗ is taken out first, since γ holds only without it (E3)."""
    chain, (r, p, v, pdot) = loaded_chain([True, False, True, True, False, False, True], 0, states)
    pdot = pdot - p * (dot(p, pdot) / dot(p, p))[:, None]
    joints, h = constraint_rows(chain, r, p, v, pdot), 1e-30
    moved = constraint_rows(chain, r + 1j * h * v, p + 1j * h * pdot, v.astype(complex), pdot.astype(complex))
    np.testing.assert_allclose(joints.constraint_rate(v, pdot), moved.C.imag / h, rtol=0, atol=1e-14)
    np.testing.assert_allclose(-joints.gamma, moved.constraint_rate(v, pdot).imag / h, rtol=0, atol=1e-13)


def test_consistent_states_satisfy_every_row():
    chain, (r, p, v, pdot) = loaded_chain([True, False, False, True, True], 1)
    joints = constraint_rows(chain, r, p, v, pdot)
    assert len(joints.C) == 9
    np.testing.assert_allclose(joints.C, 0, atol=1e-15)
    np.testing.assert_allclose(joints.constraint_rate(v, pdot), 0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(joints.d, axis=1), chain.length, atol=1e-15)


def test_a_balls_rows_keep_their_order_in_a_long_chain():
    chain, state = loaded_chain([True, False, False] * 15, 2)
    joints = constraint_rows(chain, *state)
    assert np.all(np.diff(joints.joint) >= 0)
    balls = joints.r_near[~chain.rods[joints.joint]].reshape(-1, 3, 3)
    np.testing.assert_array_equal(balls, np.broadcast_to(np.eye(3), (30, 3, 3)))
