"""The double pendulum, D1–D6: as polynomials in all variables, on the manifold and off it."""

import numpy as np

from reference_impl.euler_parameters import A, G, H, L
from reference_impl.notes import DoublePendulum, SinglePendulum
from tests.helpers.notes_test_data import Symbols

x = Symbols(bodies=2, attachments=3)
r, p, v, pdot, s = x.r, x.p, x.v, x.pdot, x.s
(s1, s2, s3), (p1, p2), (pd1, pd2) = s, p, pdot
pendulum = DoublePendulum(r, p, v, pdot, s, x.length)
first = SinglePendulum(r[0], p1, v[0], pd1, s1, x.length[0])
C, C_r, C_p = pendulum.C, pendulum.C_r, pendulum.C_p
c1, c2 = p1 @ pd1, p2 @ pd2  # what N10 neglects (E3)


def test_D2_is_dTd_with_E2s_replacement():
    a, b = A(p1) @ s2, A(p2) @ s3
    d = r[0] + a - r[1] - b
    assert x.is_zero(C[1] - (d @ d - x.length[1] ** 2) + a @ a - s2 @ s2 + b @ b - s3 @ s3)
    assert x.is_zero(C[0] - first.C)


def test_D3_D4_are_the_derivatives_of_D2():
    assert x.is_zero(C_r - x.gradient(C, r.ravel()))
    assert x.is_zero(C_p - x.gradient(C, p.ravel()))


def test_D5_is_the_rate_of_D3_up_to_E3():
    missing = 4 * (s2 * c1 - s3 * c2)
    difference = x.time_derivative(C_r[1]) - pendulum.C2_r_rate
    assert x.is_zero(difference - np.concatenate([missing, -missing]))


def test_D6_is_the_rate_of_D4_up_to_E3():
    difference = x.time_derivative(C_p[1]) - pendulum.C2_p_rate
    missing = np.concatenate([-8 * (s3 @ H(p1, s2)) * c2, -8 * (s2 @ H(p2, s3)) * c1])
    assert x.is_zero(difference - missing)


def test_gamma_is_minus_the_rates_times_the_velocities():
    rates = pendulum.C2_r_rate @ v.ravel()
    rates = rates + pendulum.C2_p_rate @ pdot.ravel()
    assert x.is_zero(pendulum.gamma[1] + rates)
    assert x.is_zero(pendulum.gamma[0] - first.gamma)


def test_E6_the_recognised_text_without_transposes_is_not_the_derivative():
    lost = 4 * ((r[0] - r[1]) @ H(p1, s2)) - 4 * (s3 @ A(p2) @ H(p1, s2))
    assert not x.is_zero(lost - x.gradient(C[1], p1))
    unequal = 2 * (v[0] - v[1]) + 4 * (s2 @ L(pd1) @ G(p1).T)
    assert not x.is_zero(unequal - pendulum.C2_r_rate[:3])
