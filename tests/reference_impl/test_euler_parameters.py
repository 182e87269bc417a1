"""Kinematics of Euler parameters, N7–N10: as polynomials in all variables, so for every p, unit or not."""

import numpy as np
import pytest

from reference_impl.euler_parameters import (
    I3,
    A,
    A_rate,
    B,
    G,
    H,
    L,
    angular_velocity,
    dAs_dp,
    dot,
    euler_parameter_rate,
    tilde,
)
from tests.helpers.notes_test_data import Symbols

x = Symbols(bodies=1, attachments=1)
p, pdot, s, v = x.p[0], x.pdot[0], x.s[0], x.v[0]


def test_tilde_is_the_cross_product():
    assert x.is_zero(tilde(s) @ v - np.cross(s, v))


def test_N7_is_the_rotation_of_a_unit_quaternion():
    """About z by θ, and orthogonal with determinant 1 for a random unit p."""
    half = 0.35
    turn = A(np.array([np.cos(half), 0, 0, np.sin(half)])) @ np.array([1.0, 0, 0])
    np.testing.assert_allclose(turn, [np.cos(2 * half), np.sin(2 * half), 0], atol=1e-15)
    q = np.random.default_rng(7).normal(size=(5, 4))
    matrices = A(q / np.linalg.norm(q, axis=1, keepdims=True))
    np.testing.assert_allclose(
        matrices @ matrices.swapaxes(-1, -2), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-15
    )
    np.testing.assert_allclose(np.linalg.det(matrices), 1, atol=1e-15)


def test_N8_is_the_derivative_of_As():
    assert x.is_zero(dAs_dp(p, s) - x.gradient(A(p) @ s, p))
    assert x.is_zero(dAs_dp(p, s) - 2 * G(p) @ B(s) - 2 * s[:, None] * p)


@pytest.mark.parametrize("function", [L, G, lambda y: H(y, s)], ids=["L", "G", "H"])
def test_N9_rates_are_the_functions_of_pdot(function):
    assert x.is_zero(x.time_derivative(function(p)) - function(pdot))


def test_N9_products():
    assert x.is_zero(L(pdot) @ pdot)
    assert x.is_zero(L(pdot) @ p + L(p) @ pdot)


def test_N10_with_what_it_leaves_out():
    """For every p: A = G Lᵀ + (pᵀp − 1) I, Ȧ = 2 G L̇ᵀ + 2 (pᵀṗ) I, and 2 G L̇ᵀ = 2 Ġ Lᵀ."""
    assert x.is_zero(A(p) - G(p) @ L(p).T - I3 * (p @ p - 1))
    assert x.is_zero(x.time_derivative(A(p)) - A_rate(p, pdot) - I3 * (2 * (p @ pdot)))
    assert not x.is_zero(x.time_derivative(A(p)) - A_rate(p, pdot))
    assert x.is_zero(A_rate(p, pdot) - 2 * G(p) @ L(pdot).T)
    assert x.is_zero(A_rate(p, pdot) - 2 * G(pdot) @ L(p).T)


def test_angular_velocity_is_the_rotation_rate():
    """Ȧ s = A (ω′ × s) for unit p and pᵀṗ = 0, and ṗ = ½ Lᵀ ω′ inverts ω′ = 2 L ṗ."""
    rng = np.random.default_rng(1)
    q = rng.normal(size=(20, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    omega = rng.normal(size=(20, 3))
    qdot = euler_parameter_rate(q, omega)
    np.testing.assert_allclose(angular_velocity(q, qdot), omega, atol=2e-15)
    np.testing.assert_allclose(dot(q, qdot), 0, atol=1e-15)
    np.testing.assert_allclose(A_rate(q, qdot), A(q) @ tilde(omega), atol=5e-15)


def test_complex_steps_give_the_same_derivatives():
    rng = np.random.default_rng(2)
    q, qdot, point, h = rng.normal(size=4), rng.normal(size=4), rng.normal(size=3), 1e-30
    step = (A(q + 1j * h * qdot) @ point).imag / h
    np.testing.assert_allclose(step, dAs_dp(q, point) @ qdot, rtol=1e-14)
