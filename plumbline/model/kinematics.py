"""Rigid-body kinematics with unit quaternions, for scenario loading, adapters and invariants.

Independent of `reference_impl`, whose Euler-parameter algebra is under test.
Imports nothing of the project but its types.
"""

from __future__ import annotations

import numpy as np

from plumbline.model.datatypes import Array, Model, State


def rotation_matrix(p: Array) -> Array:
    """Return the rotation matrices A of quaternions: the homogeneous quadratic form divided by pᵀp.

    Args:
        p: (..., 4) quaternions, scalar first, of any length but 0.

    Returns:
        (..., 3, 3) rotations, body → world.

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


def cross(a: Array, b: Array) -> Array:
    """Return a × b as `numpy.cross` does, to the bit, in a third of its time on a few vectors.

    Args:
        a: (..., 3) left factors.
        b: (..., 3) right factors; the leading dimensions are broadcast.

    Returns:
        (..., 3) products.

    """
    a0, a1, a2, b0, b1, b2 = (x[..., i] for x in (a, b) for i in range(3))
    first = a1 * b2 - a2 * b1
    product = np.empty((*np.shape(first), 3), first.dtype)
    product[..., 0], product[..., 1], product[..., 2] = first, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    return product


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
    """Multiply quaternions: rotation_matrix(a b) = rotation_matrix(a) rotation_matrix(b).

    Args:
        a: (..., 4) left factors, scalar first.
        b: (..., 4) right factors, scalar first.

    Returns:
        (..., 4) products a b.

    """
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    scalar = aw * bw - np.sum(av * bv, -1, keepdims=True)
    return np.concatenate([scalar, aw * bv + bw * av + cross(av, bv)], -1)


def quaternion_conjugate(p: Array) -> Array:
    """Return the conjugate quaternions; of unit ones, the inverse rotations.

    Args:
        p: (..., 4) quaternions, scalar first.

    Returns:
        (..., 4) conjugates.

    """
    return np.asarray(p * np.array([1.0, -1.0, -1.0, -1.0]))


def quaternion_rate(p: Array, omega: Array) -> Array:
    """Return ṗ = ½ L(p)ᵀ ω′, the inverse of `angular_velocity` for unit quaternions.

    Args:
        p: (..., 4) unit quaternions.
        omega: (..., 3) angular velocities ω′, body frame [rad/s].

    Returns:
        (..., 4) rates ṗ [1/s].

    """
    return 0.5 * quaternion_product(p, np.concatenate([np.zeros_like(omega[..., :1]), omega], -1))


def angular_velocity(p: Array, pdot: Array) -> Array:
    """Return ω′ = 2 L(p) ṗ as the notes define it, also where pᵀp ≠ 1.

    Args:
        p: (..., 4) quaternions, not normalised here.
        pdot: (..., 4) their rates [1/s].

    Returns:
        (..., 3) angular velocities, body frame [rad/s].

    """
    return 2.0 * quaternion_product(quaternion_conjugate(p), pdot)[..., 1:]


def state_from_minimal(model: Model, p: Array, omega: Array, u: Array, udot: Array) -> State:
    """Complete minimal coordinates to a state: centres of mass and their velocities from the pivot outwards.

    Args:
        model: the chain of N bodies.
        p: (N, 4) unit quaternions, body → world.
        omega: (N, 3) angular velocities, body frame [rad/s].
        u: (N, 3) unit directions of the rods, world frame; zero for ball joints.
        udot: (N, 3) their rates, perpendicular to ``u`` [1/s].

    Returns:
        The state, on the constraint manifold to rounding.

    """
    r, v = forward_kinematics(model, p, omega, u, udot)
    return State(p=p, omega=omega, u=u, udot=udot, r=r, v=v)


def forward_kinematics(model: Model, p: Array, omega: Array, u: Array, udot: Array) -> tuple[Array, Array]:
    """Return the centres of mass and their velocities, of one state or of many.

    Args:
        model: the chain of N bodies.
        p: (..., N, 4) unit quaternions, body → world.
        omega: (..., N, 3) angular velocities, body frame [rad/s].
        u: (..., N, 3) unit directions of the rods, world frame; zero for ball joints.
        udot: (..., N, 3) their rates [1/s].

    Returns:
        Positions r [m] and velocities ṙ [m/s], (..., N, 3) each, world frame.

    """
    a = rotation_matrix(p)  # (..., N, 3, 3)
    r, v = np.empty(omega.shape), np.empty(omega.shape)
    near, far = cross(omega, model.proximal), cross(omega, model.distal)
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
    """Return d_k, the vectors from the point where joint k hangs to the proximal point of body k.

    Zero for a ball joint that is closed, of length ℓ_k for a rod.

    Args:
        model: the chain of N bodies.
        r: (..., N, 3) centres of mass, world frame [m].
        p: (..., N, 4) quaternions, normalised here.

    Returns:
        (..., N, 3) vectors, world frame [m].

    """
    a = rotation_matrix(p)
    near = r + np.einsum("...kij,kj->...ki", a, model.proximal)
    far = r + np.einsum("...kij,kj->...ki", a, model.distal)
    hang = np.concatenate([np.zeros_like(far[..., :1, :]), far[..., :-1, :]], -2)
    return np.asarray(near - hang)


def velocity_jacobian(model: Model, state: State) -> Array:
    """Return the map W from the minimal rates to the bodies' velocities: (v_0, ω′_0, v_1, ω′_1, …) = W ν.

    ν holds udot of the rods in order, then ω′ of all bodies, as in `StateQuantities.mass_matrix`.  A rod
    moves its lower end by ℓ (u × udot) × u = ℓ (I − u uᵀ) udot, so the axial part of udot moves nothing; the
    angular velocity ω′ of a body moves its point s by −A s̃ ω′ (world frame).

    Args:
        model: the chain of N bodies.
        state: a state on the constraint manifold.

    Returns:
        (6N, nu) matrix, nu = 3·(number of rods) + 3N; linear velocities in the world frame, angular in the
            body's.

    """
    n, rods = model.n, np.flatnonzero(model.rods)
    a = rotation_matrix(state.p)

    def lever(s: Array) -> Array:
        """−A s̃ (N, 3, 3): the velocity of point s of each body per ω′ of the body."""
        return np.asarray(cross(s[:, None, :], a))  # row i: aᵢ·(ω′ × s) = (s × aᵢ)·ω′

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
    """Return M = Wᵀ diag(m_k I, J_k) W with W of `velocity_jacobian`: the kinetic energy is ½ νᵀ M ν.

    Args:
        model: the chain of N bodies.
        state: a state on the constraint manifold.

    Returns:
        (nu, nu) symmetric matrix, as `StateQuantities.mass_matrix`.

    """
    w = velocity_jacobian(model, state).reshape(model.n, 6, -1)
    linear, angular = w[:, :3], w[:, 3:]
    out = np.einsum("k,kia,kib->ab", model.mass, linear, linear)
    return np.asarray(out + np.einsum("kia,kij,kjb->ab", angular, model.inertia, angular, optimize=True))
