"""Rigid-body kinematics with unit quaternions, for scenario loading, adapters and invariants.

Independent of `reference_impl`, whose Euler-parameter algebra is under test.
Imports nothing of the project but its types.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plumbline.model.datatypes import JOINT_ELEMENTS, Array, Bool, Flags, Float, Indices, Int, Model, State

_NEXT = np.array([1, 2, 0])  # of each axis the next one


def rotation_matrix(p: Float[Array, "... 4"]) -> Float[Array, "... 3 3"]:
    """Return the rotation matrices A of quaternions: the homogeneous quadratic form divided by pᵀp.

    Args:
        p: quaternions, scalar first, of any length but 0.

    Returns:
        Rotations, body → world.

    """
    p = np.asarray(p, dtype=np.result_type(p, float))
    # of one quaternion numbers, which are faster than arrays
    w, x, y, z = p.tolist() if p.shape == (4,) else (p[..., i] for i in range(4))
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    wx, wy, wz, xy, xz, yz = w * x, w * y, w * z, x * y, x * z, y * z
    s = ww + xx + yy + zz
    A = np.empty((*p.shape[:-1], 3, 3), p.dtype)
    A[..., 0, 0], A[..., 0, 1], A[..., 0, 2] = s - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy)
    A[..., 1, 0], A[..., 1, 1], A[..., 1, 2] = 2 * (xy + wz), s - 2 * (xx + zz), 2 * (yz - wx)
    A[..., 2, 0], A[..., 2, 1], A[..., 2, 2] = 2 * (xz - wy), 2 * (yz + wx), s - 2 * (xx + yy)
    return np.asarray(A / np.asarray(s)[..., None, None])


def normalised(x: Float[Array, "... n"]) -> Float[Array, "... n"]:
    """Return vectors or quaternions divided by their lengths."""
    return np.asarray(x / np.linalg.norm(x, axis=-1, keepdims=True))


def rotate_vectors(A: Float[Array, "... m n"], v: Float[Array, "... n"]) -> Float[Array, "... m"]:
    """Multiply matrices (rotations, inertias, …) and vectors pairwise: A v."""
    return np.asarray((A @ v[..., None])[..., 0])


def cross(a: Float[Array, "... 3"], b: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Return a × b as `numpy.cross` does, to the bit, in a sixth of its time on a few vectors.

    Args:
        b: right factors; the leading dimensions are broadcast.

    """
    return np.asarray((a * b.take(_NEXT, -1) - a.take(_NEXT, -1) * b).take(_NEXT, -1))


def cross_matrix(s: Float[Array, "... 3"]) -> Float[Array, "... 3 3"]:
    """Return the skew-symmetric matrix s̃ with s̃ v = s × v."""
    half = np.zeros((*s.shape, 3), np.result_type(s, float))
    half[..., 0, 1], half[..., 0, 2], half[..., 1, 2] = -s[..., 2], s[..., 1], -s[..., 0]
    return half - half.swapaxes(-1, -2)


def quaternion_product(a: Float[Array, "... 4"], b: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """Multiply quaternions: rotation_matrix(a b) = rotation_matrix(a) rotation_matrix(b).

    Args:
        a: left factors, scalar first.
        b: right factors, scalar first.

    Returns:
        Products a b.

    """
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    scalar = aw * bw - (av * bv).sum(-1, keepdims=True)
    return np.concatenate([scalar, aw * bv + bw * av + cross(av, bv)], -1)


def quaternion_conjugate(p: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """Return the conjugate quaternions; of unit ones, the inverse rotations.

    Args:
        p: quaternions, scalar first.

    """
    return np.asarray(p * np.array([1.0, -1.0, -1.0, -1.0]))


def quaternion_exponential(half_turn: Float[Array, "... 3"]) -> Float[Array, "... 4"]:
    """Return the quaternions of rotations by twice a vector.

    Args:
        half_turn: halves of rotation vectors [rad].

    Returns:
        Unit quaternions, scalar first.

    """
    size = np.sqrt(np.sum(half_turn * half_turn, -1, keepdims=True))
    small = size < 1e-5
    ratio = np.where(small, 1 - size**2 / 6, np.sin(size) / np.where(small, 1.0, size))
    return np.concatenate([np.cos(size), ratio * half_turn], -1)


def turn_of_z(u: Float[Array, "... 3"]) -> Float[Array, "... 4"]:
    """Return quaternions that turn z into u; into a u below the horizontal after half a turn about x.

    Returns:
        Quaternions of a length between √2 and 2.

    """
    x, y, z = np.moveaxis(u, -1, 0)
    o = np.zeros_like(x)
    up, down = np.stack([1 + z, -y, x, o], -1), np.stack([o - y, 1 - z, o, x], -1)
    return np.where((z >= 0)[..., None], up, down)


def quaternion_of(rotation: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """Return the unit quaternion of a rotation matrix.

    Args:
        rotation: a proper rotation.

    Returns:
        The quaternion, scalar first and not negative.

    """
    R = np.asarray(rotation, float)
    products = np.array(  # 4 q qᵀ, of whose columns the longest is taken
        [
            [1 + R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], 1 + R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[1, 0] + R[0, 1], 1 - R[0, 0] + R[1, 1] - R[2, 2], R[2, 1] + R[1, 2]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], 1 - R[0, 0] - R[1, 1] + R[2, 2]],
        ]
    )
    column = products[np.argmax(np.diag(products))]
    q = column / np.linalg.norm(column)
    return np.asarray(-q if q[0] < 0 else q)


def rotation_vector(q: Float[Array, "... 4"]) -> Float[Array, "... 3"]:
    """Return the rotation vector θ u of quaternions, 0 ≤ θ ≤ π.

    Args:
        q: quaternions, scalar first, of any length but 0.

    Returns:
        Vectors [rad], the same in both frames.

    """
    size = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    theta = 2 * np.arctan2(size, np.abs(q[..., :1])) * np.where(q[..., :1] < 0, -1, 1)
    ratio = np.divide(theta, size, out=np.full_like(size, 2.0), where=size > 0)
    return np.asarray(ratio * q[..., 1:])


def ball_spring_rest(model: Model, k: int) -> Float[Array, "4"]:
    """Return the turn of a ball joint at which its spring is unloaded.

    Returns:
        Quaternion, near → far body.

    """
    return quaternion_product(model.turn[k, 0], quaternion_conjugate(model.turn[k, 1]))


def ball_spring_turn(
    model: Model, k: int, p: Float[Array, "... bodies 4"]
) -> tuple[Float[Array, "... 4"], Float[Array, "... 3"]]:
    """Return the near body's attitude at which a ball joint's spring is unloaded, and its turn from there.

    Returns:
        Quaternions, and rotation vectors [rad] in the axes of the unloaded body.

    """
    (far, near), unloaded = model.body[k], ball_spring_rest(model, k)
    if far >= 0:
        unloaded = quaternion_product(p[..., far, :], unloaded)
    return unloaded, rotation_vector(quaternion_product(quaternion_conjugate(unloaded), p[..., near, :]))


def quaternion_rate(p: Float[Array, "... 4"], omega: Float[Array, "... 3"]) -> Float[Array, "... 4"]:
    """Return ṗ = ½ L(p)ᵀ ω′, the inverse of `angular_velocity` for unit quaternions.

    Args:
        omega: angular velocities ω′, body frame [rad/s].

    Returns:
        Rates ṗ [1/s].

    """
    return 0.5 * quaternion_product(p, np.concatenate([np.zeros_like(omega[..., :1]), omega], -1))


def maximal_coordinates(
    *states: State,
) -> tuple[
    Float[Array, "bodies 3"], Float[Array, "bodies 4"], Float[Array, "bodies 3"], Float[Array, "bodies 4"]
]:
    """Return r, p, ṙ and ṗ of the bodies, in which the notes state their equations.

    Args:
        states: of mechanisms side by side, whose bodies follow each other.

    """
    r, p, v, omega = (np.concatenate([getattr(s, name) for s in states]) for name in ("r", "p", "v", "omega"))
    return r, p, v, quaternion_rate(p, omega)


def angular_velocity(p: Float[Array, "... 4"], pdot: Float[Array, "... 4"]) -> Float[Array, "... 3"]:
    """Return ω′ = 2 L(p) ṗ as the notes define it, also where pᵀp ≠ 1.

    Args:
        p: quaternions, not normalised here.
        pdot: their rates [1/s].

    Returns:
        Angular velocities, body frame [rad/s].

    """
    return 2.0 * quaternion_product(quaternion_conjugate(p), pdot)[..., 1:]


def stack_states(states: Sequence[State] | State) -> State:
    """Put states into one, of arrays with a leading axis; one that has it stays as it is.

    Returns:
        The states, (S, ...) arrays.

    """
    if isinstance(states, State):
        return states
    return State(**{name: np.array([getattr(s, name) for s in states]) for name in vars(states[0])})


def complete_state(model: Model, state: State) -> State:
    """Compute all that follows from the minimal coordinates of a state, from the world outwards.

    Args:
        model: the mechanism of N bodies; it need not be the one that the state was made for.
        state: a state of which the minimal coordinates are used; or many, of arrays with leading axes.

    Returns:
        The state of the model with the same minimal coordinates.

    """
    u, udot, x, xdot = state.u, state.udot, state.x, state.xdot
    if (missing := model.columns - x.shape[-1]) > 0:  # of a joint that was added
        x, xdot = (np.pad(values, [(0, 0)] * (x.ndim - 1) + [(0, missing)]) for values in (x, xdot))
    p, omega, r, v = (given.copy() for given in (state.p, state.omega, state.r, state.v))
    A = rotation_matrix(p)  # (..., N, 3, 3)
    for k in range(model.n):
        kind, far = model.kinds[k], int(model.body[k, 0])
        if kind.holds_nothing:
            continue
        above = A[..., far, :, :] if far >= 0 else np.eye(3)
        hang, own_point = model.point[..., k, 0, :], model.point[..., k, 1, :]
        tip, tip_v, spin = hang, np.zeros(3), np.zeros(3)
        if far >= 0:
            tip = r[..., far, :] + rotate_vectors(above, hang)
            swing = cross(omega[..., far, :], hang)
            tip_v = v[..., far, :] + rotate_vectors(above, swing)
            spin = rotate_vectors(above, omega[..., far, :])
        length = model.length[..., k, None]
        d, d_rate = length * u[..., k, :], length * udot[..., k, :]
        if not kind.has_attitude:
            (d, relative), (d_rate, turning) = JointFrame(model, k, above).motion(
                x[..., k, :], xdot[..., k, :]
            )
            d_rate = d_rate + cross(spin, d)
            own = quaternion_product(p[..., far, :], relative) if far >= 0 else relative
            p[..., k, :] = normalised(own)
            A[..., k, :, :] = rotation_matrix(p[..., k, :])
            omega[..., k, :] = rotate_vectors(A[..., k, :, :].swapaxes(-1, -2), spin + turning)
        near = cross(omega[..., k, :], own_point)
        r[..., k, :] = tip + d - rotate_vectors(A[..., k, :, :], own_point)
        v[..., k, :] = tip_v + d_rate - rotate_vectors(A[..., k, :, :], near)
    return State(p, omega, u, udot, r, v, x, xdot)


class Motion(NamedTuple):
    """What one coordinate of a joint does, world axes; None where it is exactly 0."""

    axis: Float[Array, "... 3"]  # a unit vector
    along: Float[Array, "... 3"] | None  # velocity of the near point by a unit rate [m/rad or 1]
    about: Float[Array, "... 3"] | None  # angular velocity by a unit rate


class JointFrame:
    """Joint k with coordinates x seen from its far body, of attitude ``above`` (..., 3, 3).

    The coordinates are those of the kind's motions, in order from the far body on.
    """

    def __init__(self, model: Model, k: int, above: Array) -> None:
        self.motions = model.kinds[k].motions
        self.pitch = model.length[..., k, None] if model.kinds[k].has_pitch else None
        self.turn_far, self.turn_near = model.turn[..., k, 0, :], model.turn[..., k, 1, :]
        self.above = above

    def motion(
        self, x: Float[Array, "... coordinates"], xdot: Float[Array, "... motions"]
    ) -> tuple[
        tuple[Float[Array, "... 3"], Float[Array, "... 4"]],
        tuple[Float[Array, "... 3"], Float[Array, "... 3"]],
    ]:
        """Return where the near body is from the far one, and its rates seen from there.

        Returns:
            The shift of the near point [m], world axes, and the quaternion near → far body; then the rates of
            the shift and Ω = ω_near − ω_far, world axes.

        """
        shift = shift_rate = spin = np.zeros(3)
        axes, turn = self._axes_and_turn(x)
        for i, (_, along, about) in enumerate(axes):
            value, rate = x[..., i, None], xdot[..., i, None]
            if along is not None:
                shift, shift_rate = shift + along * value, shift_rate + along * rate
            if about is not None:
                spin = spin + about * rate
        return (shift, quaternion_product(turn, quaternion_conjugate(self.turn_near))), (shift_rate, spin)

    def axes(self, x: Float[Array, "... coordinates"]) -> list[Motion]:
        """Return what a unit rate of every motion is."""
        return self._axes_and_turn(x)[0]

    def _axes_and_turn(self, x: Array) -> tuple[list[Motion], Array]:
        """`axes`, and the quaternion from the near body's joint frame to the far body."""
        turn, axes = self.turn_far, list[Motion]()
        for i, (what, axis) in enumerate(self.motions):
            value = x[..., i, None]
            unit = rotate_vectors(self.above, rotation_matrix(turn)[..., axis])
            if what == "slide":
                axes.append(Motion(unit, unit, None))
            else:
                axes.append(Motion(unit, None if self.pitch is None else self.pitch * unit, unit))
                half = np.zeros((*value.shape[:-1], 4), value.dtype)
                half[..., :1], half[..., 1 + axis, None] = np.cos(value / 2), np.sin(value / 2)
                turn = quaternion_product(turn, half)
        return axes, turn


def joint_vectors(
    model: Model, r: Float[Array, "... bodies 3"], p: Float[Array, "... bodies 4"]
) -> Float[Array, "... joints 3"]:
    """Return d_k, the vectors from the far to the near point of every joint.

    Zero for a joint that is closed, of length ℓ_k for a rod, along the axis for a slide.

    Args:
        r: centres of mass, world frame [m].
        p: quaternions, normalised here.

    Returns:
        Vectors, world frame [m].

    """
    return _between(_places(r, p, model.body, model.point))


def spring_vectors(
    model: Model, r: Float[Array, "... bodies 3"], p: Float[Array, "... bodies 4"]
) -> Float[Array, "... springs 3"]:
    """Return the vectors from the first to the second point of every spring.

    Args:
        model: the mechanism of N bodies with K springs.
        r: centres of mass, world frame [m].
        p: quaternions, normalised here.

    Returns:
        Vectors, world frame [m].

    """
    return _between(_places(r, p, model.spring_body, model.spring_point))


def joint_vector_rates(
    model: Model,
    p: Float[Array, "... bodies 4"],
    v: Float[Array, "... bodies 3"],
    omega: Float[Array, "... bodies 3"],
) -> Float[Array, "... joints 3"]:
    """Return ḋ, the rates of `joint_vectors`.

    Args:
        p: quaternions, normalised here.
        v: velocities of the centres of mass, world frame [m/s].
        omega: angular velocities, body frame [rad/s].

    Returns:
        Rates, world frame [m/s].

    """
    return _between(_velocities(p, v, omega, model.body, model.point))


def spring_vector_rates(
    model: Model,
    p: Float[Array, "... bodies 4"],
    v: Float[Array, "... bodies 3"],
    omega: Float[Array, "... bodies 3"],
) -> Float[Array, "... springs 3"]:
    """Return the rates of `spring_vectors` [m/s], as `joint_vector_rates`."""
    return _between(_velocities(p, v, omega, model.spring_body, model.spring_point))


def _places(r: Array, p: Array, body: NDArray[np.intp], point: Array) -> Array:
    """Places (..., pairs, 2, 3) of pairs of points, each of a body or the world (−1)."""
    found = r[..., body, :] + rotate_vectors(rotation_matrix(p)[..., body, :, :], point)
    return np.where((body < 0)[..., None], point, found)


def _velocities(p: Array, v: Array, omega: Array, body: NDArray[np.intp], point: Array) -> Array:
    """Velocities (..., pairs, 2, 3) of such points."""
    turning = rotate_vectors(rotation_matrix(p)[..., body, :, :], cross(omega[..., body, :], point))
    return np.where((body < 0)[..., None], 0.0, v[..., body, :] + turning)


def _between(pairs: Array) -> Array:
    return np.asarray(pairs[..., 1, :] - pairs[..., 0, :])


def elastic_energy(model: Model, state: State) -> float:
    """Return the potential energy of all springs.

    Returns:
        Σ ½ k (x − x₀)² + Σ ½ k θ² + Σ ½ k (l − l₀)² [J].

    """
    x = joint_coordinates(model, state)[2]
    energy = np.sum(model.stiffness * (x - model.rest) ** 2)
    for k, kind in enumerate(model.kinds):
        if kind.is_spherical and model.stiffness[k, 0]:
            _, turn = ball_spring_turn(model, k, state.p)
            energy += model.stiffness[k, 0] * (turn @ turn - x[k, 0] ** 2)
    length = np.linalg.norm(spring_vectors(model, state.r, state.p), axis=-1)
    return float(energy + np.sum(model.spring_stiffness * (length - model.spring_length) ** 2)) / 2


def kinetic_energy_of_rotors(model: Model, state: State) -> float:
    """Return the kinetic energy of all rotors.

    Returns:
        Σ ½ a ẋ² + Σ ½ a ‖ω − ω_far‖² [J].

    """
    rates = joint_coordinates(model, state)[3]
    energy = np.sum(model.armature * rates**2)
    spin = rotate_vectors(rotation_matrix(state.p), state.omega)
    for k in [k for k, kind in enumerate(model.kinds) if kind.is_spherical]:
        far, near = model.body[k]
        relative = spin[near] - (spin[far] if far >= 0 else 0.0)
        energy += model.armature[k, 0] * (relative @ relative - rates[k, 0] ** 2)
    return float(energy) / 2


def rate_count(model: Model) -> int:
    """Count the minimal rates ν of `velocity_jacobian`.

    Returns:
        Their number: the size of `StateQuantities.mass_matrix`.

    """
    return int(own_rates(model)[-1].stop)


def own_rates(model: Model) -> list[slice]:
    """Return where in ν each body's own rates are, behind those of the rods: ω′, or (ṙ, ω′), or ẋ."""
    counts = [3 if kind.holds_distance else kind.freedom for kind in model.tree.kinds]
    first = 3 * int(model.tree.rods.sum()) + np.cumsum([0, *counts])
    return [slice(int(start), int(end)) for start, end in pairwise(first)]


def minimal_rates(model: Model, state: State) -> Float[Array, "nu"]:
    """Return ν, the minimal rates of a state.

    Returns:
        In the order of `velocity_jacobian`.

    """
    model, own = model.tree, list[Array]()
    for k, kind in enumerate(model.kinds):
        own += [state.v[k]] if kind.holds_nothing else []
        own += [state.omega[k] if kind.has_attitude else state.xdot[k, : len(kind.motions)]]
    return np.concatenate([state.udot[model.rods].ravel(), *own])


def velocity_jacobian(model: Model, state: State) -> Float[Array, "... rows nu"]:
    """Return the map W from the minimal rates to the bodies' velocities: (v_0, ω′_0, v_1, ω′_1, …) = W ν.

    ν holds udot of the rods in order, then body by body ω′, (ṙ, ω′) of a free body, or the rates of its
    joint, as in `StateQuantities.mass_matrix`.  A rod moves its lower end by ℓ (u × udot) × u
    = ℓ (I − u uᵀ) udot, so the axial part of udot moves nothing; the angular velocity ω′ of a body moves its
    point s by −A s̃ ω′ (world frame).

    Args:
        state: a state on the constraint manifold; or many, of arrays with leading axes.

    Returns:
        Six rows per body; linear velocities in the world frame, angular in the body's.

    """
    model = model.tree
    n, rods = model.n, np.flatnonzero(model.rods)
    a = rotation_matrix(state.p)
    near = cross(model.proximal[:, None, :], a)  # −A s̃ (N, 3, 3), row i: aᵢ·(ω′ × s) = (s × aᵢ)·ω′
    out = np.zeros((*a.shape[:-3], n, 6, rate_count(model)))
    for k, (kind, far, own) in enumerate(zip(model.kinds, model.body[:, 0], own_rates(model), strict=True)):
        if kind.holds_nothing:
            out[..., k, :, own] = np.eye(6)
            continue
        # velocity of the near point, angular velocity, world
        tip, spin = np.zeros((2, *a.shape[:-3], 3, out.shape[-1]))
        above = a[..., far, :, :] if far >= 0 else np.eye(3)
        if far >= 0:
            tip = out[..., far, :3, :] + cross(model.point[k, 0], above) @ out[..., far, 3:, :]
            spin = above @ out[..., far, 3:, :]
        if kind.holds_distance:
            at, u = 3 * int(np.searchsorted(rods, k)), state.u[..., k, :]
            across = np.eye(3) - u[..., :, None] * u[..., None, :]
            tip[..., at : at + 3] = model.length[k] * across
        if kind.has_attitude:
            out[..., k, 3:, own] = np.eye(3)
        else:
            x = state.x[..., k, :]
            motions = JointFrame(model, k, above).axes(x)
            for i, (_, along, _) in enumerate(motions):
                if along is not None:
                    tip = tip + cross_matrix(-x[..., i, None] * along) @ spin
            for i, (_, *pair) in enumerate(motions):
                for moved, vector in zip((tip, spin), pair, strict=True):
                    if vector is not None:
                        moved[..., own.start + i] += vector
            out[..., k, 3:, :] = a[..., k, :, :].swapaxes(-1, -2) @ spin
        out[..., k, :3, :] = tip - near[..., k, :, :] @ out[..., k, 3:, :]
    return out.reshape(*a.shape[:-3], 6 * n, -1)


# Adapters ask at the same states by every option and variant; states and models do not change.
remembered_velocity_jacobian = lru_cache(maxsize=64)(velocity_jacobian)


def rod_inertias(model: Model) -> Float[Array, "bodies"]:
    """Return what the axial inertia of a rod is a share of [kg m²]: positive, and scaled as units are.

    tr J of the body that hangs by it; of a point mass m ℓ².
    """
    of_body = np.trace(model.inertia, axis1=1, axis2=2)
    return np.where(of_body > 0, of_body, model.mass * model.length[: model.n] ** 2)


def mass_matrix(model: Model, state: State) -> Float[Array, "... nu nu"]:
    """Return M = Wᵀ diag(m_k I, J_k) W with W of `velocity_jacobian`: the kinetic energy is ½ νᵀ M ν.

    Args:
        model: the tree of N bodies.
        state: a state on the constraint manifold; or many, of arrays with leading axes.

    Returns:
        Symmetric matrix, as `StateQuantities.mass_matrix`, with the rotors.

    """
    flat = velocity_jacobian(model, state)
    w = flat.reshape(*flat.shape[:-2], model.n, 6, -1)
    linear, angular = w[..., :3, :], w[..., 3:, :]
    out = np.sum(model.mass[:, None, None] * (linear.swapaxes(-1, -2) @ linear), axis=-3)
    out += np.sum(angular.swapaxes(-1, -2) @ model.inertia @ angular, axis=-3)
    for k, own in enumerate(own_rates(model) if np.any(model.armature) else ()):
        if not model.kinds[k].is_spherical:
            for i in range(len(model.kinds[k].motions)):
                out[..., own.start + i, own.start + i] += model.armature[k, i]
        elif model.armature[k, 0]:
            a, far = rotation_matrix(state.p), model.body[k, 0]
            relative = a[..., k, :, :] @ angular[..., k, :, :]
            if far >= 0:
                relative = relative - a[..., far, :, :] @ angular[..., far, :, :]
            out += model.armature[k, 0] * (relative.swapaxes(-1, -2) @ relative)
    return np.asarray(out)


def joint_coordinates(
    model: Model, state: State
) -> tuple[
    Float[Array, "... joints 3"],
    Float[Array, "... joints 3"],
    Float[Array, "... joints coordinates"],
    Float[Array, "... joints coordinates"],
]:
    """Return the coordinates of all joints: those of closing ones follow from the bodies.

    Returns:
        u, u̇ of rods, x, ẋ of other joints, as those of `State`.

    """
    if not model.has_loops:
        return state.u, state.udot, state.x, state.xdot
    closing = coordinates_of_joints(model, state, range(model.n, len(model.kind)))
    given = state.u, state.udot, state.x, state.xdot
    u, udot, x, xdot = (np.concatenate(pair, -2) for pair in zip(given, closing, strict=True))
    return u, udot, x, xdot


def with_joint_coordinates(model: Model, state: State) -> State:
    """Compute the joint coordinates of a state from the motion of its bodies, as `coordinates_of_joints`.

    Args:
        model: a tree.
        state: of which p, omega, r and v count.

    """
    u, udot, x, xdot = coordinates_of_joints(model, state, range(model.n))
    return replace(state, u=u, udot=udot, x=x, xdot=xdot)


def coordinates_of_joints(
    model: Model, state: State, joints: Sequence[int]
) -> tuple[
    Float[Array, "... joints 3"],
    Float[Array, "... joints 3"],
    Float[Array, "... joints coordinates"],
    Float[Array, "... joints coordinates"],
]:
    """Compute coordinates of joints from the motion of the bodies.

    Angles are in (−π, π]; of joints with a pitch they count full turns.

    Args:
        model: its numbers and the state may have the same leading axes.
        state: of which p, omega, r and v count.

    Returns:
        u, u̇ of rods, x, ẋ of other joints, as those of `State`.

    """
    a = rotation_matrix(state.p)
    shape = (*state.r.shape[:-2], len(joints))
    u, udot, x, xdot = (np.zeros((*shape, size)) for size in (3, 3, model.columns, model.columns))
    omega, d = rotate_vectors(a, state.omega), joint_vectors(model, state.r, state.p)
    d_rate = joint_vector_rates(model, state.p, state.v, state.omega)
    for at, k in enumerate(joints):
        far, near = model.body[k]
        above, spin = (a[..., far, :, :], omega[..., far, :]) if far >= 0 else (np.eye(3), np.zeros(3))
        own, rate, kind = d[..., k, :], d_rate[..., k, :], model.kinds[k]
        if kind.holds_distance:
            rod = normalised(own)
            along = np.sum(rod * rate, axis=-1, keepdims=True)
            u[..., at, :], udot[..., at, :] = rod, (rate - rod * along) / model.length[..., k, None]
            continue
        far_axes, near_axes = (
            attitude @ rotation_matrix(model.turn[..., k, side, :])
            for side, attitude in enumerate((above, a[..., near, :, :]))
        )
        relative = far_axes.swapaxes(-1, -2) @ near_axes
        turning, moving, is_turned = omega[..., near, :] - spin, rate - cross(spin, own), False
        for i, (what, axis) in enumerate(kind.motions):
            along = (near_axes if is_turned else far_axes)[..., axis]
            moved = moving if what == "slide" else turning
            xdot[..., at, i] = np.sum(along * moved, axis=-1)
            if what == "slide":
                x[..., at, i] = np.sum(along * own, axis=-1)
                continue
            one, two = (axis + 1) % 3, (axis + 2) % 3
            kept = two if is_turned else one  # perpendicular to all turns
            x[..., at, i] = np.arctan2(relative[..., two, one], relative[..., kept, kept])
            is_turned = True
            if kind.has_pitch:  # which counts full turns
                shift = np.sum(along * own, axis=-1)
                x[..., at, i] = nearest_turn(x[..., at, i], shift, model.length[..., k])
    return u, udot, x, xdot


def nearest_turn(
    angle: Float[Array, "..."], shift: Float[Array, "..."], pitch: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Add the full turns to an angle [rad] that bring a shift [m] nearest to its pitch [m/rad] times it."""
    angle, pitch = np.asarray(angle), np.broadcast_to(pitch, np.shape(angle))
    turned = np.divide(shift, pitch, out=angle.copy(), where=pitch != 0)
    return np.asarray(angle + 2 * np.pi * np.round((turned - angle) / (2 * np.pi)))


def bodies_beyond(model: Model) -> Bool[Flags, "bodies bodies"]:
    """Return [k, b]: whether body b is k or beyond it."""
    found = np.eye(model.n, dtype=bool)
    for k, far in reversed([*enumerate(model.body[: model.n, 0])]):
        if far >= 0:
            found[far] |= found[k]
    return found


def joints_with_elements(model: Model) -> Bool[Flags, "joints"]:
    """Return which joints have a rotor, a damper, a spring or an effort."""
    return np.asarray(np.any([getattr(model, name) for name in JOINT_ELEMENTS], axis=(0, -1)))


def sliding_coordinates(model: Model) -> Bool[Flags, "joints coordinates"]:
    """Return which coordinates of the joints are slides."""
    found = np.zeros((len(model.kind), model.columns), bool)
    for k, kind in enumerate(model.kinds):
        found[k, : len(kind.motions)] = [what == "slide" for what, _ in kind.motions]
    return found


def path_to_world(far: Sequence[int] | Int[Indices, "bodies"], body: int) -> Iterator[int]:
    """Go from a body to the world, along the far bodies (−1: the world) of all bodies' joints."""
    while body >= 0:
        yield body
        body = int(far[body])


def depth_first(
    above: Int[Indices, "bodies"], first: int | None = None, is_reversed: bool = False
) -> list[int]:
    """Order bodies by their parents (−1: the world), branch by branch, one root before all."""
    order, step = list[int](), 1 if is_reversed else -1
    waiting = [int(k) for k in np.flatnonzero(above < 0)[::step] if k != first]
    waiting += [] if first is None else [first]
    while waiting:
        order.append(waiting.pop())
        waiting += np.flatnonzero(above == order[-1])[::step].tolist()
    return order


def stretched_length(model: Model) -> Float[Array, "bodies"]:
    """Measure how far each body and its rod extend the stretched mechanism.

    Returns:
        [m] rod length, and the far point's distance from the world's origin where the joint is on the
        world, plus the largest of: distance from the near point to the far points of the joints beyond,
        distance from the near point to the centre of mass, radius of gyration.

    """
    model = model.tree
    span, far = np.zeros(model.n), model.body[:, 0]
    on_body = far >= 0
    distance = np.linalg.norm(model.proximal[far[on_body]] - model.point[on_body, 0], axis=1)
    np.maximum.at(span, far[on_body], distance)
    gyration = np.sqrt(np.trace(model.inertia, axis1=1, axis2=2) / (2 * model.mass))
    sizes = [span, np.linalg.norm(model.proximal, axis=1), gyration]
    from_origin = np.where(on_body, 0.0, np.linalg.norm(model.point[:, 0], axis=1))
    return np.asarray(model.length + np.max(sizes, axis=0) + from_origin)
