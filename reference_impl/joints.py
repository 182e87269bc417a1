"""The constraints of an open chain of N bodies on any mix of rods and ball joints: C, C_r, C_p, γ.

Joint k has one row (rod) or three (ball) and touches body k, its near body, and body k−1, its far
body; the far body of joint 0 is the pivot.  With x = r_k − r_{k−1}, a = A_{k−1} s_{k−1,distal} and
b = A_k s_{k,proximal} (r, a and their rates are 0 at the pivot), d = x + b − a and

    rod   C = xᵀx + 2 xᵀ(b − a) + bᵀb − 2 aᵀb + aᵀa − ℓ²,  bᵀb and aᵀa replaced by s-products (E2)
          C_r near, far =  2 dᵀ, −2 dᵀ                                                     (S2, D3)
          C_p near, far =  4 (x − a)ᵀH_near, −4 (x + b)ᵀH_far                              (S3, D4)
    ball  C = d,  C_r = I, −I,  C_p = 2 H_near, −2 H_far                                   (E1, N8)

and γ = −d_t(C_r) ṙ − d_t(C_p) ṗ with Ȧ = 2 G L̇ᵀ in the rods' rows, as the notes have it (E3).
The ball's γ = −2 Ḣ_near ṗ_near + 2 Ḣ_far ṗ_far is exact for every p.  For one and two
bodies on rods they are S1–S4 and D2–D6, which `notes` has as printed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from reference_impl.euler_parameters import I3, A, AnyArray, B, G, L, dot, outer
from reference_impl.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class ConstraintRows:
    """The joints' rows in the order of the joints; c rows in all, c = Σ (1 per rod, 3 per ball)."""

    joint: NDArray[np.intp]  # (c,) the joint of the row; its near body
    C: AnyArray  # (c,) m² of a rod, m of a ball
    r_near: AnyArray  # (c, 3) ∂C/∂r of the near body; of the far body it is −r_near
    p_near: AnyArray  # (c, 4) ∂C/∂p of the near body
    p_far: AnyArray  # (c, 4) ∂C/∂p of the far body; 0 for the pivot
    gamma: AnyArray  # (c,) C̈ = C_r r̈ + C_p p̈ − γ
    d: AnyArray  # (N, 3) m, world frame, from where joint k hangs to the near body's proximal point

    def constraint_rate(self, v: AnyArray, pdot: AnyArray) -> AnyArray:
        """Return Ċ = C_r ṙ + C_p ṗ.

        Args:
            v: velocities ṙ (N, 3) [m/s], world frame.
            pdot: rates ṗ (N, 4) [1/s].

        Returns:
            Ċ (c,): m²/s of a rod, m/s of a ball.

        """
        far_v, far_pdot = far_body_values(v), far_body_values(pdot)
        k = self.joint
        moved = dot(self.r_near, v[k] - far_v[k])
        return np.asarray(moved + dot(self.p_near, pdot[k]) + dot(self.p_far, far_pdot[k]))


def far_body_values(x: AnyArray) -> AnyArray:
    """Return the far body's value for every joint.

    Args:
        x: values of the bodies (N, ...).

    Returns:
        (N, ...): zeros for the pivot, then x of bodies 0 … N−2.

    """
    return np.concatenate([np.zeros_like(x[:1]), x[:-1]])


def joint_of_rows(chain: Mechanism) -> NDArray[np.intp]:
    """Number the rows of C by their joints.

    Args:
        chain: the mechanism; a rod has one row, a ball joint three.

    Returns:
        (c,) the joint of each row, ascending.

    """
    return np.repeat(np.arange(chain.n), np.where(chain.rods, 1, 3))


@dataclass(frozen=True, eq=False)
class _RowLayout:
    """What the rows of a chain have in common at every state."""

    bodies: NDArray[np.intp]  # (2, N) near and far body of each joint; the pivot's is body 0, see `s`
    s: AnyArray  # (2, N, 3) m, their points; 0 for the pivot, which takes body 0 out: H(p, 0) = 0
    B: AnyArray  # (2, N, 4, 4) B(s)
    point_squares: AnyArray  # (N,) m²: sᵀs of both points less ℓ²
    rod_joints: NDArray[np.intp] | slice  # joints that are rods; all of them as a slice, which copies nothing
    ball_joints: NDArray[np.intp] | slice
    rod_count: int  # how many
    ball_count: int
    joint: NDArray[np.intp]  # (c,) the joint of each row
    order: NDArray[np.intp]  # (c,) rows of the rods, then of the balls, in the order of the joints


@lru_cache(maxsize=64)  # chains are never changed, and a run uses the same one ten thousand times
def _row_layout(chain: Mechanism) -> _RowLayout:
    k = np.arange(chain.n)
    s = np.stack([chain.proximal, far_body_values(chain.distal)])
    rod, ball = np.flatnonzero(chain.rods), np.flatnonzero(~chain.rods)
    return _RowLayout(
        bodies=np.stack([k, np.maximum(k - 1, 0)]),
        s=s,
        B=B(s),
        point_squares=dot(s, s).sum(0) - chain.length**2,
        rod_joints=rod if len(ball) else slice(None),
        ball_joints=ball if len(rod) else slice(None),
        rod_count=len(rod),
        ball_count=len(ball),
        joint=joint_of_rows(chain),
        order=np.argsort(np.concatenate([rod, np.repeat(ball, 3)]), kind="stable"),
    )


def constraint_rows(
    chain: Mechanism, r: AnyArray, p: AnyArray, v: AnyArray, pdot: AnyArray
) -> ConstraintRows:
    """Evaluate C, C_r, C_p and γ of every joint (S1–S4, D2–D6 for rods; E1, N8 for balls).

    Args:
        chain: the mechanism.
        r: positions (N, 3) [m], world frame.
        p: Euler parameters (N, 4).
        v: velocities ṙ (N, 3) [m/s], world frame.
        pdot: rates ṗ (N, 4) [1/s].

    Returns:
        The rows in the order of the joints, on or off the constraints.

    """
    fixed = _row_layout(chain)
    s = fixed.s
    q, qdot = p[fixed.bodies], pdot[fixed.bodies]  # (2, N, 4): near and far body of each joint
    x, xdot = r.copy(), v.copy()  # from the far body to the near one
    x[1:] -= r[:-1]
    xdot[1:] -= v[:-1]
    both = np.stack([q, qdot])
    turn = G(both)
    (H_near, H_far), (H_near_rate, H_far_rate) = turn @ fixed.B + outer(s, both)  # H, Ḣ (D4)
    b, a = _matrix_vector(A(q), s)
    d = x + b - a

    parts: list[tuple[AnyArray, ...]] = []
    if fixed.rod_count:
        k = fixed.rod_joints
        bdot, adot = 2 * _matrix_vector(
            turn[0][:, k], _vector_matrix(s[:, k], L(qdot[:, k]))
        )  # Ȧ s, Ȧ = 2 G L̇ᵀ (N10)
        y, ydot, z, zdot = x[k] - a[k], xdot[k] - adot, x[k] + b[k], xdot[k] + bdot
        C = dot(x[k], x[k]) + 2 * dot(x[k], b[k] - a[k]) - 2 * dot(a[k], b[k]) + fixed.point_squares[k]
        near_rate = _vector_matrix(ydot, H_near[k]) + _vector_matrix(y, H_near_rate[k])
        far_rate = _vector_matrix(zdot, H_far[k]) + _vector_matrix(z, H_far_rate[k])
        gamma = (
            -2 * dot(zdot - adot, xdot[k]) - 4 * dot(near_rate, qdot[0, k]) + 4 * dot(far_rate, qdot[1, k])
        )
        parts.append((C, 2 * d[k], 4 * _vector_matrix(y, H_near[k]), -4 * _vector_matrix(z, H_far[k]), gamma))
    if fixed.ball_count:
        k = fixed.ball_joints
        gamma = 2 * (_matrix_vector(H_far_rate[k], qdot[1, k]) - _matrix_vector(H_near_rate[k], qdot[0, k]))
        identity = np.broadcast_to(I3, (fixed.ball_count, 3, 3))
        blocks = (d[k], identity, 2 * H_near[k], -2 * H_far[k], gamma)
        parts.append(
            tuple(np.reshape(block, (3 * fixed.ball_count, *np.shape(block)[2:])) for block in blocks)
        )
    columns = parts[0]
    if len(parts) == 2:
        columns = tuple(np.concatenate(column)[fixed.order] for column in zip(*parts, strict=True))
    C, r_near, p_near, p_far, gamma = columns
    return ConstraintRows(joint=fixed.joint, C=C, r_near=r_near, p_near=p_near, p_far=p_far, gamma=gamma, d=d)


def _matrix_vector(matrix: AnyArray, vector: AnyArray) -> AnyArray:
    """Matrix times vector, batched."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _vector_matrix(vector: AnyArray, matrix: AnyArray) -> AnyArray:
    """Row vector times matrix, batched."""
    return np.asarray((vector[..., None, :] @ matrix)[..., 0, :])
