"""The notes' single and double pendulum as formulation.md prints them: S1–S5, D1–D6 and S x = b (N5).

Open this file beside formulation.md: one property per equation, in the same order, with the errata applied.
Both joints are rods (E1).  The equations share nothing with the chain of N bodies in `joints` and `direct`,
so that each can be compared with the other.  They use only +, − and ×, so they run on floats, complex
numbers, exact rationals and symbols, as `euler_parameters` does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from reference_impl.arrays import AnyArray, Array, Float, Motion, Shaped
from reference_impl.direct import check_state_solvable, solve_dense
from reference_impl.euler_parameters import A, A_rate, B, G, H, L, outer
from reference_impl.mechanism import Mechanism

Number = Any  # float, complex or exact


@dataclass(frozen=True, eq=False)
class SinglePendulum:
    """One state of the single pendulum, on or off the constraints, and its equations (S1–S5)."""

    r: Shaped[AnyArray, "3"]  # m, centre of mass, world frame
    p: Shaped[AnyArray, "4"]  # Euler parameters
    rdot: Shaped[AnyArray, "3"]  # m/s
    pdot: Shaped[AnyArray, "4"]  # 1/s
    s1: Shaped[AnyArray, "3"]  # m, attachment of the rod, body frame
    ell: Number  # m, length of the rod; 0 makes S singular (E1)

    @property
    def C(self) -> Number:
        """(S1) C = rᵀr + 2 rᵀA s₁ + s₁ᵀs₁ − ℓ² [m²]: dᵀd − ℓ² with s₁ᵀs₁ for s₁ᵀAᵀA s₁ (E2)."""
        r, p, s1, ell = self.r, self.p, self.s1, self.ell
        return r @ r + 2 * (r @ A(p) @ s1) + s1 @ s1 - ell * ell

    @property
    def C_r(self) -> Shaped[AnyArray, "3"]:
        """(S2) C_r = 2 rᵀ + 2 s₁ᵀAᵀ [m]."""
        r, p, s1 = self.r, self.p, self.s1
        return np.asarray(2 * r + 2 * (s1 @ A(p).T))

    @property
    def C_p(self) -> Shaped[AnyArray, "4"]:
        """(S3) C_p = 4 rᵀ (G B(s₁) + s₁ pᵀ) [m²]."""
        r, p, s1 = self.r, self.p, self.s1
        return np.asarray(4 * (r @ (G(p) @ B(s1) + outer(s1, p))))

    @property
    def gamma(self) -> Number:
        """(S4) γ = −2 ṙᵀṙ − 4 s₁ᵀL̇Gᵀṙ − 4 [(ṙᵀG + rᵀĠ) B(s₁) + ṙᵀs₁ pᵀ + rᵀs₁ ṗᵀ] ṗ [m²/s²]."""
        r, p, rdot, pdot, s1 = self.r, self.p, self.rdot, self.pdot, self.s1
        Ldot, Gdot = L(pdot), G(pdot)
        bracket = (rdot @ G(p) + r @ Gdot) @ B(s1) + rdot @ outer(s1, p) + r @ outer(s1, pdot)
        return -2 * (rdot @ rdot) - 4 * (s1 @ Ldot @ G(p).T @ rdot) - 4 * (bracket @ pdot)

    @property
    def C_E(self) -> Number:
        """(S5) C_E = pᵀp − 1."""
        return self.p @ self.p - 1

    @property
    def C_Ep(self) -> Shaped[AnyArray, "4"]:
        """(S5) C_{E,p} = 2 pᵀ."""
        return np.asarray(2 * self.p)

    @property
    def gamma_E(self) -> Number:
        """(S5) γ_E = −2 ṗᵀṗ [1/s²]."""
        return -2 * (self.pdot @ self.pdot)


@dataclass(frozen=True, eq=False)
class DoublePendulum:
    """One state of the double pendulum, on or off the constraints, and its equations (D2–D6)."""

    r: Shaped[AnyArray, "2 3"]  # m, centres of mass, world frame
    p: Shaped[AnyArray, "2 4"]  # Euler parameters
    rdot: Shaped[AnyArray, "2 3"]  # m/s
    pdot: Shaped[AnyArray, "2 4"]  # 1/s
    s: Shaped[AnyArray, "3 3"]  # m, s₁, s₂, s₃, body frames
    ell: Shaped[AnyArray, "2"]  # m, lengths of the rods

    @cached_property
    def bodies(self) -> list[SinglePendulum]:
        """Body 1 on its rod, which is the single pendulum; of body 2 only the normalisation (S5) applies."""
        motion = self.r, self.p, self.rdot, self.pdot
        return [SinglePendulum(*of_body) for of_body in zip(*motion, self.s[[0, 2]], self.ell, strict=True)]

    @cached_property
    def A(self) -> Shaped[AnyArray, "2 3 3"]:
        """A₁ and A₂."""
        return A(self.p)

    @cached_property
    def H(self) -> Shaped[AnyArray, "2 3 4"]:
        """H of p₁, s₂ and of p₂, s₃ [m]."""
        return H(self.p, self.s[1:])

    @property
    def C(self) -> Shaped[AnyArray, "2"]:
        """(S1, D2) C [m²]: C₂ = dᵀd − ℓ₂² expanded, with s₂ᵀs₂ and s₃ᵀs₃ (E2)."""
        (r1, r2), (A1, A2), (_, s2, s3), (_, ell2) = self.r, self.A, self.s, self.ell
        C2 = r1 @ r1 - 2 * (r1 @ r2) + r2 @ r2 + 2 * ((r1 - r2) @ (A1 @ s2 - A2 @ s3))
        C2 = C2 + s2 @ s2 - 2 * (s2 @ A1.T @ A2 @ s3) + s3 @ s3 - ell2 * ell2
        return np.array([self.bodies[0].C, C2])

    @property
    def C_r(self) -> Shaped[AnyArray, "2 6"]:
        """(S2, D3) C_r [m]: ∂C₂/∂r₁ = 2 (r₁ − r₂)ᵀ + 2 (A₁s₂ − A₂s₃)ᵀ = −∂C₂/∂r₂."""
        (r1, r2), (A1, A2), (_, s2, s3) = self.r, self.A, self.s
        C2_r1 = 2 * (r1 - r2) + 2 * (A1 @ s2 - A2 @ s3)
        return np.concatenate([self.bodies[0].C_r, 0 * r2, C2_r1, -C2_r1]).reshape(2, 6)

    @property
    def C_p(self) -> Shaped[AnyArray, "2 8"]:
        """(S3, D4) C_p [m²], with H(p, s) = G(p) B(s) + s pᵀ."""
        (r1, r2), (A1, A2), (H1, H2), (_, s2, s3) = self.r, self.A, self.H, self.s
        C2_p1 = +4 * ((r1 - r2) @ H1) - 4 * (s3 @ A2.T @ H1)
        C2_p2 = -4 * ((r1 - r2) @ H2) - 4 * (s2 @ A1.T @ H2)
        return np.concatenate([self.bodies[0].C_p, 0 * self.p[1], C2_p1, C2_p2]).reshape(2, 8)

    @property
    def C2_r_rate(self) -> Shaped[AnyArray, "6"]:
        """(D5) d_t(∂C₂/∂r) [m/s]: 2 (ṙ₁ − ṙ₂)ᵀ + 4 (s₂ᵀL̇₁G₁ᵀ − s₃ᵀL̇₂G₂ᵀ) = −d_t(∂C₂/∂r₂)."""
        (rdot1, rdot2), (_, s2, s3) = self.rdot, self.s
        (L1dot, L2dot), (G1, G2) = L(self.pdot), G(self.p)
        C2_r1_rate = 2 * (rdot1 - rdot2) + 4 * (s2 @ L1dot @ G1.T - s3 @ L2dot @ G2.T)
        return np.concatenate([C2_r1_rate, -C2_r1_rate])

    @property
    def C2_p_rate(self) -> Shaped[AnyArray, "8"]:
        """(D6) d_t(∂C₂/∂p) [m²/s], with Ḣ(p, s) = H(ṗ, s) and Ȧᵀ = 2 L̇ Gᵀ (E3)."""
        (r1, r2), (rdot1, rdot2), (_, s2, s3) = self.r, self.rdot, self.s
        (A1, A2), (A1dot, A2dot) = self.A, A_rate(self.p, self.pdot)
        (H1, H2), (H1dot, H2dot) = self.H, H(self.pdot, self.s[1:])
        C2_p1_rate = 4 * ((rdot1 - rdot2) @ H1) + 4 * ((r1 - r2) @ H1dot)
        C2_p1_rate = C2_p1_rate - 4 * (s3 @ A2dot.T @ H1) - 4 * (s3 @ A2.T @ H1dot)
        C2_p2_rate = -4 * ((rdot1 - rdot2) @ H2) - 4 * ((r1 - r2) @ H2dot)
        C2_p2_rate = C2_p2_rate - 4 * (s2 @ A1dot.T @ H2) - 4 * (s2 @ A1.T @ H2dot)
        return np.concatenate([C2_p1_rate, C2_p2_rate])

    @property
    def gamma(self) -> Shaped[AnyArray, "2"]:
        """(N3) γ = −d_t(C_r) ṙ − d_t(C_p) ṗ [m²/s²]: γ₁ by (S4), γ₂ by (D5, D6)."""
        gamma_2 = -self.C2_r_rate @ self.rdot.ravel() - self.C2_p_rate @ self.pdot.ravel()
        return np.array([self.bodies[0].gamma, gamma_2])


def block_diagonal(blocks: Shaped[AnyArray, "n i j"]) -> Shaped[AnyArray, "n*i n*j"]:
    """Put matrices on the diagonal of one; scipy's block_diag would take two fifths of `solve_system`."""
    n, i, j = blocks.shape
    matrix = np.zeros((n, i, n, j), blocks.dtype)
    matrix[np.arange(n), :, np.arange(n)] = blocks
    return matrix.reshape(n * i, n * j)


def assemble_system(
    chain: Mechanism, *motion: *Motion
) -> tuple[Shaped[AnyArray, "unknowns unknowns"], Shaped[AnyArray, "unknowns"]]:
    """Assemble S and b of (N5) for one body (S1–S5) or two (D1–D6); every joint is read as a rod.

    Args:
        chain: the pendulum, N = 1 or 2.
        motion: r, p, ṙ and ṗ.

    Returns:
        S and b, for x = (r̈, p̈, λ, λ_E).

    Raises:
        ValueError: the chain has more than two bodies.

    """
    n, (r, p, v, pdot) = chain.n, motion
    if n == 1:
        one = SinglePendulum(r[0], p[0], v[0], pdot[0], chain.proximal[0], chain.length[0])
        bodies, C_r, C_p, gamma = [one], one.C_r[None], one.C_p[None], np.array([one.gamma])
    elif n == 2:
        s = np.stack([chain.proximal[0], chain.distal[0], chain.proximal[1]])
        two = DoublePendulum(r, p, v, pdot, s, chain.length)
        bodies, C_r, C_p, gamma = two.bodies, two.C_r, two.C_p, two.gamma
    else:
        raise ValueError(f"the notes print one and two bodies, not {n}")
    C_Ep = block_diagonal(np.array([[body.C_Ep] for body in bodies]))
    gamma_E = np.array([body.gamma_E for body in bodies])
    M = block_diagonal(chain.mass[:, None, None] * np.eye(3))  # (D1), and the next two lines
    J = block_diagonal(chain.inertia)
    L_, Ldot = block_diagonal(L(p)), block_diagonal(L(pdot))
    p_, omega = p.ravel(), 2 * (L(p) @ pdot[..., None])[..., 0]
    F = chain.mass[:, None] * chain.gravity + chain.force - chain.drag_force[:, None] * v
    moment = chain.moment - chain.drag_moment[:, None] * omega  # n′

    def zero(rows: int, columns: int) -> Array:
        return np.zeros((rows, columns))

    S = [
        [M, zero(3 * n, 4 * n), C_r.T, zero(3 * n, n)],  # (N1)
        [zero(4 * n, 3 * n), 4 * L_.T @ J @ L_, C_p.T, C_Ep.T],  # (N2)
        [C_r, C_p, zero(n, n), zero(n, n)],  # (N3)
        [zero(n, 3 * n), C_Ep, zero(n, n), zero(n, n)],  # (N4)
    ]
    b = [F.ravel(), 8 * Ldot.T @ J @ Ldot @ p_ + 2 * L_.T @ moment.ravel(), gamma, gamma_E]
    # numpy.block checks the nesting again at every call, which takes a third of the time
    return np.concatenate([np.concatenate(row, axis=1) for row in S]), np.concatenate(b)


def solve_system(chain: Mechanism, *motion: *Motion) -> Float[Array, "unknowns"]:
    """Solve (N5) for x = (r̈, p̈, λ, λ_E).

    Args:
        chain: the pendulum, N = 1 or 2.
        motion: r, p, ṙ and ṗ.

    Returns:
        r̈ [m/s²], p̈ [1/s²], λ [N/m] and λ_E.

    Raises:
        SingularSystem: S is singular; the message names the body and the cause (E1, E7).

    """
    n = chain.n
    S, b = assemble_system(chain, *motion)
    d = np.array([S[7 * n + k, 3 * k : 3 * k + 3] / 2 for k in range(n)])  # by (S2, D3), up to its sign
    check_state_solvable(chain, *motion[:2], d, np.full(n, True), (S, b))
    return solve_dense(S, b)
