"""The single and the double pendulum exactly as the notes print them: S1–S5 and D1–D6.

One function per equation, on one state, in the order of the notes; the equations share nothing with
the general chain of `joints`, so that each can be held against the other.  Both joints are rods
(E1); a length of 0 is accepted here and makes S singular, which is what E1 says of the notes read
literally.  Exact on any number field, as `euler_parameters`.
"""

from __future__ import annotations

import numpy as np

from reference_impl.chain import Array, Chain
from reference_impl.direct import check_state_solvable, solve_dense
from reference_impl.euler_parameters import A, A_rate, AnyArray, B, G, H, L, outer
from reference_impl.joints import constraint_rows

# --- single pendulum: r, p, ṙ, ṗ of the body, s₁ its attachment, ℓ the rod -------------------------------


def single_C(r: AnyArray, p: AnyArray, s1: AnyArray, length: float) -> AnyArray:
    """(S1) C = rᵀr + 2 rᵀA s₁ + s₁ᵀs₁ − ℓ², m²; s₁ᵀAᵀA s₁ replaced by s₁ᵀs₁ (E2)."""
    return np.asarray(r @ r + 2 * (r @ A(p) @ s1) + s1 @ s1 - length * length)


def single_C_r(r: AnyArray, p: AnyArray, s1: AnyArray) -> AnyArray:
    """(S2) C_r = 2 rᵀ + 2 s₁ᵀAᵀ, (3,)."""
    return np.asarray(2 * r + 2 * (s1 @ A(p).T))


def single_C_p(r: AnyArray, p: AnyArray, s1: AnyArray) -> AnyArray:
    """(S3) C_p = 4 rᵀ (G B(s₁) + s₁ pᵀ), (4,)."""
    return np.asarray(4 * (r @ (G(p) @ B(s1) + outer(s1, p))))


def single_gamma(r: AnyArray, p: AnyArray, v: AnyArray, pdot: AnyArray, s1: AnyArray) -> AnyArray:
    """(S4) γ = −2 ṙᵀṙ − 4 s₁ᵀL̇Gᵀṙ − 4 [(ṙᵀG + rᵀĠ) B(s₁) + ṙᵀs₁ pᵀ + rᵀs₁ ṗᵀ] ṗ."""
    bracket = (v @ G(p) + r @ G(pdot)) @ B(s1) + v @ outer(s1, p) + r @ outer(s1, pdot)
    return np.asarray(-2 * (v @ v) - 4 * (s1 @ L(pdot) @ G(p).T @ v) - 4 * (bracket @ pdot))


def norm_C(p: AnyArray) -> AnyArray:
    """(S5) C_E = pᵀp − 1."""
    return np.asarray(p @ p - 1)


def norm_C_p(p: AnyArray) -> AnyArray:
    """(S5) C_{E,p} = 2 pᵀ, (4,)."""
    return np.asarray(2 * p)


def norm_gamma(pdot: AnyArray) -> AnyArray:
    """(S5) γ_E = −2 ṗᵀṗ."""
    return np.asarray(-2 * (pdot @ pdot))


# --- double pendulum: r, p, ṙ, ṗ have a row per body, s = (s₁, s₂, s₃), ℓ = (ℓ₁, ℓ₂) ------------------------


def double_C(r: AnyArray, p: AnyArray, s: AnyArray, length: AnyArray) -> AnyArray:
    """(D2) C₁ as (S1); C₂ expanded, s₂ᵀA₁ᵀA₁s₂ and s₃ᵀA₂ᵀA₂s₃ replaced by s₂ᵀs₂ and s₃ᵀs₃, (2,)."""
    (r1, r2), (p1, p2), (s1, s2, s3) = r, p, s
    C2 = r1 @ r1 - 2 * (r1 @ r2) + r2 @ r2 + 2 * ((r1 - r2) @ (A(p1) @ s2 - A(p2) @ s3))
    C2 = C2 + s2 @ s2 - 2 * (s2 @ A(p1).T @ A(p2) @ s3) + s3 @ s3 - length[1] * length[1]
    return np.array([single_C(r1, p1, s1, length[0])[()], C2])


def double_C_r(r: AnyArray, p: AnyArray, s: AnyArray) -> AnyArray:
    """(S2, D3) C_r, (2, 6)."""
    (r1, r2), (p1, p2), (s1, s2, s3) = r, p, s
    row = 2 * (r1 - r2) + 2 * (A(p1) @ s2 - A(p2) @ s3)
    return np.stack([np.concatenate([single_C_r(r1, p1, s1), 0 * r2]), np.concatenate([row, -row])])


def double_C_p(r: AnyArray, p: AnyArray, s: AnyArray) -> AnyArray:
    """(S3, D4) C_p, (2, 8)."""
    (r1, r2), (p1, p2), (s1, s2, s3) = r, p, s
    p1_row = 4 * ((r1 - r2) @ H(p1, s2)) - 4 * (s3 @ A(p2).T @ H(p1, s2))
    p2_row = -4 * ((r1 - r2) @ H(p2, s3)) - 4 * (s2 @ A(p1).T @ H(p2, s3))
    return np.stack([np.concatenate([single_C_p(r1, p1, s1), 0 * p2]), np.concatenate([p1_row, p2_row])])


def double_C_r_rate(p: AnyArray, v: AnyArray, pdot: AnyArray, s: AnyArray) -> AnyArray:
    """(D5) d_t(∂C₂/∂r), (6,)."""
    (p1, p2), (v1, v2), (pd1, pd2), (_, s2, s3) = p, v, pdot, s
    row = 2 * (v1 - v2) + 4 * (s2 @ L(pd1) @ G(p1).T - s3 @ L(pd2) @ G(p2).T)
    return np.concatenate([row, -row])


def double_C_p_rate(r: AnyArray, p: AnyArray, v: AnyArray, pdot: AnyArray, s: AnyArray) -> AnyArray:
    """(D6) d_t(∂C₂/∂p), (8,)."""
    (r1, r2), (p1, p2), (v1, v2), (pd1, pd2), (_, s2, s3) = r, p, v, pdot, s
    H1, H1_rate, H2, H2_rate = H(p1, s2), H(pd1, s2), H(p2, s3), H(pd2, s3)
    p1_row = 4 * ((v1 - v2) @ H1) + 4 * ((r1 - r2) @ H1_rate)
    p1_row = p1_row - 4 * (s3 @ A_rate(p2, pd2).T @ H1) - 4 * (s3 @ A(p2).T @ H1_rate)
    p2_row = -4 * ((v1 - v2) @ H2) - 4 * ((r1 - r2) @ H2_rate)
    p2_row = p2_row - 4 * (s2 @ A_rate(p1, pd1).T @ H2) - 4 * (s2 @ A(p1).T @ H2_rate)
    return np.concatenate([p1_row, p2_row])


def double_gamma(r: AnyArray, p: AnyArray, v: AnyArray, pdot: AnyArray, s: AnyArray) -> AnyArray:
    """(N3 with S4, D5, D6) γ = −d_t(C_r) ṙ − d_t(C_p) ṗ, (2,)."""
    gamma_2 = -double_C_r_rate(p, v, pdot, s) @ v.ravel() - double_C_p_rate(r, p, v, pdot, s) @ pdot.ravel()
    return np.array([single_gamma(r[0], p[0], v[0], pdot[0], s[0])[()], gamma_2])


# --- N5 for both ---------------------------------------------------------------------------------------


def block_diagonal(matrices: AnyArray) -> AnyArray:
    """diag(X₁, …, X_N) of X (N, i, j): (N i, N j)."""
    n, i, j = matrices.shape
    out = np.zeros((n, i, n, j), matrices.dtype)
    out[np.arange(n), :, np.arange(n), :] = matrices
    return out.reshape(n * i, n * j)


def assemble_system(
    chain: Chain, r: AnyArray, p: AnyArray, v: AnyArray, pdot: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """(N5 with S1–S5 or D1–D6) S and b of a chain of one or two bodies, every joint read as a rod.

    Unknowns (r̈, p̈, λ, λ_E): S is (9, 9) for one body and (18, 18) for two.
    """
    s = np.stack([chain.proximal[0], chain.distal[0], chain.proximal[-1]])
    if chain.n == 1:
        C_r, C_p = single_C_r(r[0], p[0], s[0])[None], single_C_p(r[0], p[0], s[0])[None]
        gamma = single_gamma(r[0], p[0], v[0], pdot[0], s[0])[None]
    elif chain.n == 2:
        C_r, C_p, gamma = double_C_r(r, p, s), double_C_p(r, p, s), double_gamma(r, p, v, pdot, s)
    else:
        raise ValueError(f"the notes print one and two bodies, not {chain.n}")
    L_, L_rate, J = block_diagonal(L(p)), block_diagonal(L(pdot)), block_diagonal(chain.inertia)
    M = np.diag(np.repeat(chain.mass, 3))
    C_Ep = block_diagonal(norm_C_p(p)[:, None, :])
    force = chain.mass[:, None] * chain.gravity + chain.force - chain.drag_force[:, None] * v
    moment = chain.moment - chain.drag_moment[:, None] * (2 * (L_ @ pdot.ravel())).reshape(-1, 3)

    def zero(rows: int, columns: int) -> AnyArray:
        return np.zeros((rows, columns), M.dtype)

    n = chain.n
    S = np.block(
        [
            [M, zero(3 * n, 4 * n), C_r.T, zero(3 * n, n)],
            [zero(4 * n, 3 * n), 4 * L_.T @ J @ L_, C_p.T, C_Ep.T],
            [C_r, C_p, zero(n, n), zero(n, n)],
            [zero(n, 3 * n), C_Ep, zero(n, n), zero(n, n)],
        ]
    )
    quadratic = 8 * L_rate.T @ (J @ (L_rate @ p.ravel()))
    b = [force.ravel(), quadratic + 2 * L_.T @ moment.ravel(), gamma, [norm_gamma(x)[()] for x in pdot]]
    return S, np.concatenate(b)


def solve_printed(chain: Chain, r: Array, p: Array, v: Array, pdot: Array) -> Array:
    """(N5) (r̈, p̈, λ, λ_E), (9 N,), of `system`; SingularSystem names the cause and the body (E1, E7)."""
    d = constraint_rows(chain, r, p, v, pdot).d
    S, b = assemble_system(chain, r, p, v, pdot)
    check_state_solvable(chain, r, p, d, np.full(chain.n, True), (S, b))
    return solve_dense(S, b)
