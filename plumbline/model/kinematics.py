"""Rigid-body kinematics of unit quaternions, shared by scenario loading, adapters and measures.

Written apart from `reference_impl`, whose Euler-parameter algebra is under test.
Imports nothing of the project but its types.
"""

from __future__ import annotations

import numpy as np

from plumbline.model.datatypes import Array, Model, State


def rotation_matrix(p: Array) -> Array:
    """Rotation matrix (..., 3, 3), body → world, of quaternions p (..., 4), scalar first.

    The homogeneous-quadratic form divided by pᵀp: a rotation for every p ≠ 0.
    """
    p = np.asarray(p, dtype=float)
    w, x, y, z = np.moveaxis(p, -1, 0)
    s = w * w + x * x + y * y + z * z
    rows = [
        [s - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), s - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), s - 2 * (x * x + y * y)],
    ]
    return np.asarray(np.stack([np.stack(row, -1) for row in rows], -2) / s[..., None, None])


def rotate_vectors(A: Array, v: Array) -> Array:
    """Multiply matrices and vectors pairwise: A v.

    Args:
        A: (..., 3, 3) matrices, for example rotations body → world; inertias and their like do as well.
        v: (..., 3) vectors.

    Returns:
        (..., 3) products.

    """
    return np.asarray((A @ v[..., None])[..., 0])


def cross_matrix(s: Array) -> Array:
    """Return the skew-symmetric matrix s̃ with s̃ v = s × v.

    Args:
        s: (..., 3) vectors.

    Returns:
        (..., 3, 3) matrices.

    """
    half = np.zeros((*s.shape, 3))
    half[..., 0, 1], half[..., 0, 2], half[..., 1, 2] = -s[..., 2], s[..., 1], -s[..., 0]
    return half - half.swapaxes(-1, -2)


def quaternion_product(a: Array, b: Array) -> Array:
    """Quaternion product a b, (..., 4) each, scalar first: rotation(a b) = rotation(a) rotation(b)."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    scalar = aw * bw - np.sum(av * bv, -1, keepdims=True)
    return np.concatenate([scalar, aw * bv + bw * av + np.cross(av, bv)], -1)


def quaternion_conjugate(p: Array) -> Array:
    """Conjugate quaternion (..., 4): the inverse rotation of a unit one."""
    return np.asarray(p * np.array([1.0, -1.0, -1.0, -1.0]))


def quaternion_rate(p: Array, omega: Array) -> Array:
    """ṗ = ½ L(p)ᵀ ω′ (..., 4) of unit quaternions p and body-frame ω′ (..., 3)."""
    return 0.5 * quaternion_product(p, np.concatenate([np.zeros_like(omega[..., :1]), omega], -1))


def angular_velocity(p: Array, pdot: Array) -> Array:
    """ω′ = 2 L(p) ṗ (..., 3), body frame, as the notes define it (also off pᵀp = 1)."""
    return 2.0 * quaternion_product(quaternion_conjugate(p), pdot)[..., 1:]


def state_from_minimal(model: Model, p: Array, omega: Array, u: Array, udot: Array) -> State:
    """The exact state that follows from minimal coordinates: r and v from the pivot outwards."""
    r, v = forward_kinematics(model, p, omega, u, udot)
    return State(p=p, omega=omega, u=u, udot=udot, r=r, v=v)


def forward_kinematics(model: Model, p: Array, omega: Array, u: Array, udot: Array) -> tuple[Array, Array]:
    """The places and velocities r, v (..., N, 3) of one or of many states at once, as `lift` has them."""
    a = rotation_matrix(p)  # (..., N, 3, 3)
    r, v = np.empty(omega.shape), np.empty(omega.shape)
    near, far = np.cross(omega, model.proximal), np.cross(omega, model.distal)
    tip = tip_v = np.zeros(3)
    for k in range(model.n):
        turn = a[..., k, :, :]
        hang = tip + model.length[k] * u[..., k, :]
        hang_v = tip_v + model.length[k] * udot[..., k, :]
        r[..., k, :] = hang - turn @ model.proximal[k]
        v[..., k, :] = hang_v - (turn @ near[..., k, :, None])[..., 0]
        tip = r[..., k, :] + turn @ model.distal[k]
        tip_v = v[..., k, :] + (turn @ far[..., k, :, None])[..., 0]
    return r, v


def joint_vectors(model: Model, r: Array, p: Array) -> Array:
    """d_k (..., N, 3), world frame: from where joint k hangs to body k's proximal point.

    Zero for an exact ball joint, of length ℓ_k for an exact rod.  p is normalised first.
    """
    a = rotation_matrix(p)
    near = r + np.einsum("...kij,kj->...ki", a, model.proximal)
    far = r + np.einsum("...kij,kj->...ki", a, model.distal)
    hang = np.concatenate([np.zeros_like(far[..., :1, :]), far[..., :-1, :]], -2)
    return np.asarray(near - hang)


def velocity_jacobian(model: Model, state: State) -> Array:
    """Map W (6N, nu) of the minimal rates to the bodies': (v_0, ω′_0, v_1, ω′_1, …) = W ν.

    ν = (udot of the rods in order, then omega of all bodies), as `StateQuantities.mass_matrix`
    has it.  A rod moves its lower end by ℓ (u × udot) × u = ℓ (I − u uᵀ) udot, so the axial part of
    udot moves nothing; a body's ω′ moves a point s of it by −A s̃ ω′ (world frame).  The kinetic
    energy of the bodies is ½ νᵀ Wᵀ diag(m_k I, J_k) W ν: `mass_matrix`.
    """
    n, rods = model.n, np.flatnonzero(model.rods)
    a = rotation_matrix(state.p)

    def lever(s: Array) -> Array:
        """−A s̃ (N, 3, 3): the velocity of point s of each body per ω′ of the body."""
        return np.asarray(np.cross(s[:, None, :], a))  # row i: aᵢ·(ω′ × s) = (s × aᵢ)·ω′

    prox, dist = lever(model.proximal), lever(model.distal)
    out = np.zeros((n, 6, 3 * (len(rods) + n)))
    tip = np.zeros((3, out.shape[-1]))  # velocity of where the next body hangs, as a function of ν
    for k in range(n):
        own = slice(3 * (len(rods) + k), 3 * (len(rods) + k) + 3)
        if model.length[k] > 0:
            rod = 3 * int(np.searchsorted(rods, k))
            tip[:, rod : rod + 3] = model.length[k] * (np.eye(3) - np.outer(state.u[k], state.u[k]))
        out[k, :3] = tip
        out[k, :3, own] = -prox[k]
        out[k, 3:, own] = np.eye(3)
        tip = out[k, :3].copy()
        tip[:, own] += dist[k]
    return out.reshape(6 * n, -1)


def mass_matrix(model: Model, state: State) -> Array:
    """M (nu, nu) of `StateQuantities.mass_matrix` from the map W: Wᵀ diag(m_k I, J_k) W."""
    w = velocity_jacobian(model, state).reshape(model.n, 6, -1)
    linear, angular = w[:, :3], w[:, 3:]
    out = np.einsum("k,kia,kib->ab", model.mass, linear, linear)
    return np.asarray(out + np.einsum("kia,kij,kjb->ab", angular, model.inertia, angular, optimize=True))
