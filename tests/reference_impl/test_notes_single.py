"""The single pendulum, S1–S5: as polynomials in all variables, on the manifold and off it."""

import numpy as np

from reference_impl.euler_parameters import A, dot
from reference_impl.notes import SinglePendulum
from tests.helpers.notes_test_data import Symbols

x = Symbols(bodies=1, attachments=1)
r, p, v, pdot, s1, length = x.r[0], x.p[0], x.v[0], x.pdot[0], x.s[0], x.length[0]
pendulum = SinglePendulum(r, p, v, pdot, s1, length)
C, C_r, C_p, gamma = pendulum.C, pendulum.C_r, pendulum.C_p, pendulum.gamma


def test_S1_is_dTd_with_E2s_replacement():
    d, turned = r + A(p) @ s1, A(p) @ s1
    assert x.is_zero(C - (d @ d - length**2) + turned @ turned - s1 @ s1)


def test_S2_S3_are_the_derivatives_of_S1():
    assert x.is_zero(C_r - x.gradient(C, r))
    assert x.is_zero(C_p - x.gradient(C, p))


def test_S4_is_minus_the_rate_of_the_jacobians_up_to_E3():
    true = -x.time_derivative(C_r) @ v - x.time_derivative(C_p) @ pdot
    assert x.is_zero(true - gamma + 4 * (s1 @ v) * (p @ pdot)), "E3 is not exactly −4 (s₁ᵀṙ)(pᵀṗ)"
    assert not x.is_zero(true - gamma)


def test_S5_is_the_normalisation_and_its_derivatives():
    assert x.is_zero(pendulum.C_E - (p @ p - 1))
    assert x.is_zero(pendulum.C_Ep - x.gradient(pendulum.C_E, p))
    assert x.is_zero(pendulum.gamma_E + x.time_derivative(pendulum.C_Ep) @ pdot)


def test_the_notes_own_s1_on_a_body_axis():
    """s₁ = (−R, 0, 0): hanging straight down, the body is on the manifold and C_p is along pᵀ."""
    R, rod = 0.4, 0.7
    half = np.pi / 4  # x axis turned down: the attachment −R x is above the centre of mass
    q = np.array([np.cos(half), 0, np.sin(half), 0])
    centre = np.array([0, 0, -rod - R])
    hanging = SinglePendulum(centre, q, np.zeros(3), np.zeros(4), np.array([-R, 0, 0]), rod)
    assert abs(hanging.C) < 1e-15
    np.testing.assert_allclose(hanging.C_r, [0, 0, -2 * rod], atol=1e-15)
    row = hanging.C_p
    np.testing.assert_allclose(row, dot(row, q) * q, atol=1e-15)
