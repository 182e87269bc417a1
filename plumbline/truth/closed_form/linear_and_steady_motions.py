"""Motions that keep their shape, small oscillations by normal modes, and the damped linear oscillator."""

from __future__ import annotations

import numpy as np
import scipy

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import quaternion_product, rotate_vectors, rotation_matrix
from plumbline.truth.closed_form.motion import (
    CONDITION_RTOL,
    ClosedFormMotion,
    axis_angle_quaternions,
    require,
    require_gravity_without_loads,
    require_no_loads,
)

# -- equilibria, and rotations of the whole chain about the vertical -----------------------------------


def steady_rotation(model: Model, state: State) -> ClosedFormMotion:
    """Solve a relative equilibrium: the chain rotates about the vertical as if it were rigid.

    Args:
        model: a chain of any length, moved by gravity alone.
        state: all angular velocities vertical and equal, forces balanced in the rotating frame.

    Raises:
        ClosedFormMismatch: the state is not a relative equilibrium.

    """
    up, _ = require_gravity_without_loads(model)
    omega = rotate_vectors(rotation_matrix(state.p), state.omega)
    rate = float(omega[0] @ up)
    tolerance = CONDITION_RTOL * (abs(rate) or 1.0)
    require(np.max(np.abs(omega - rate * up)) < tolerance, "the same vertical angular velocity in all bodies")
    rigid_udot = np.where(model.rods[:, None], rate * np.cross(up, state.u), 0.0)
    require(np.max(np.abs(state.udot - rigid_udot)) < tolerance, "rods that rotate with the bodies")
    require(
        _relative_imbalance(model, state, rate * up) < CONDITION_RTOL,
        "forces and moments that balance in the rotating frame",
    )

    def evaluate(t: Array) -> tuple[Array, Array]:
        turn = axis_angle_quaternions(up, rate * t)
        r = np.einsum("tij,nj->tni", rotation_matrix(turn), state.r)
        return r, quaternion_product(turn[:, None], state.p[None])

    return ClosedFormMotion(evaluate, "relative equilibrium: a rigid rotation about the vertical")


def equilibrium(model: Model, state: State) -> ClosedFormMotion:
    """Solve a chain at rest.

    Args:
        model: a chain of any length without loads.
        state: no velocity, forces and moments balanced.

    Raises:
        ClosedFormMismatch: the state moves or is not balanced.

    """
    require(not (np.any(state.omega) or np.any(state.udot)), "no velocity")
    require_no_loads(model)
    require(
        _relative_imbalance(model, state, np.zeros(3)) < CONDITION_RTOL, "forces and moments that balance"
    )

    def evaluate(t: Array) -> tuple[Array, Array]:
        return np.repeat(state.r[None], len(t), 0), np.repeat(state.p[None], len(t), 0)

    return ClosedFormMotion(evaluate, "equilibrium")


def _relative_imbalance(model: Model, state: State, spin: Array) -> float:
    """Largest unbalanced force or moment, relative to its terms, in a frame rotating at ``spin`` [rad/s]."""
    A = rotation_matrix(state.p)
    near, far = (rotate_vectors(A, s) for s in (model.proximal, model.distal))
    inertia = A @ model.inertia @ A.mT
    worst, force_below = 0.0, np.zeros(3)
    for k in reversed(range(model.n)):
        acceleration = np.cross(spin, np.cross(spin, state.r[k]))
        force = model.mass[k] * (acceleration - model.gravity) + force_below
        gyroscopic = np.cross(spin, inertia[k] @ spin)
        moment = np.cross(near[k], force) - np.cross(far[k], force_below) - gyroscopic
        size = sum(
            np.linalg.norm(s) * np.linalg.norm(f) for s, f in ((near[k], force), (far[k], force_below))
        ) + np.linalg.norm(gyroscopic)
        worst = max(worst, float(np.linalg.norm(moment) / size) if size else 0.0)
        if model.rods[k]:
            sine = np.linalg.norm(np.cross(state.u[k], force)) / np.linalg.norm(force)
            worst = max(worst, float(sine) if state.u[k] @ force < 0 else np.inf)
        force_below = force
    return worst


# -- planar small oscillations of a hanging chain ------------------------------------------------------


def small_oscillation(model: Model, state: State) -> ClosedFormMotion:
    """Solve planar small oscillations about hanging, of any chain whose joints lie on the bodies' axes.

    M θ̈ + K θ = 0 in the angles θ of rods and bodies, solved by its normal modes (Rayleigh, Theory of Sound,
    § 62 for the chain).  Asymptotic: exact in the limit of zero amplitude.

    Args:
        model: a chain moved by gravity alone.
        state: near hanging, moving in one vertical plane.

    Returns:
        The linearised motion; its ``amplitude`` [rad] measures its error.

    Raises:
        ClosedFormMismatch: the chain does not oscillate in one vertical plane, or its joints are off-axis.

    """
    up, gravity = require_gravity_without_loads(model)
    n, rods = model.n, np.flatnonzero(model.rods)
    near, far = np.linalg.norm(model.proximal, axis=1), np.linalg.norm(model.distal, axis=1)
    far[-1] = 0.0
    require(np.all(near > 0), "a lever between each joint and the centre of mass")
    c = model.proximal / near[:, None]  # upwards along the body when it hangs
    off_axis = np.max(np.abs(model.distal[:-1] + far[:-1, None] * c[:-1]), initial=0.0)
    require(
        off_axis < CONDITION_RTOL * np.max(near), "joints on one axis through the centre of mass of each body"
    )
    A = rotation_matrix(state.p)
    body_up, omega = rotate_vectors(A, c), rotate_vectors(A, state.omega)
    rod_omega = np.cross(state.u, state.udot)
    axis = _axis_of_motion(
        model, A, up, np.concatenate([np.cross(up, body_up), omega, np.cross(state.u, up), rod_omega])
    )
    across = np.cross(axis, up)

    def angles_from_up(v: Array) -> Array:
        return np.asarray(np.arctan2(v @ across, v @ up))

    angle = np.concatenate([angles_from_up(-state.u[rods]), angles_from_up(body_up)])
    rate = np.concatenate([rod_omega[rods] @ axis, omega @ axis])
    J = np.einsum("ki,kij,kj->k", A.mT @ axis, model.inertia, A.mT @ axis)
    # first-order displacement of centre b: minus Σ lever_bi θ_i
    lever = np.zeros((n, len(rods) + n))
    for b in range(n):
        lever[b, : len(rods)] = np.where(rods <= b, model.length[rods], 0.0)
        lever[b, len(rods) : len(rods) + b] = near[:b] + far[:b]
        lever[b, len(rods) + b] = near[b]
    M = lever.T @ (model.mass[:, None] * lever) + np.diag(np.concatenate([np.zeros(len(rods)), J]))
    K = np.diag(gravity * (model.mass @ lever))
    squared_frequency, modes = scipy.linalg.eigh(K, M)
    frequency = np.sqrt(squared_frequency)
    cosines, sines = modes.T @ M @ angle, modes.T @ M @ rate / frequency

    def evaluate(t: Array) -> tuple[Array, Array]:
        phase = np.outer(t, frequency)
        theta = (np.cos(phase) * cosines + np.sin(phase) * sines) @ modes.T  # (T, rods + N)
        tip, r = np.zeros((len(t), 3)), np.empty((len(t), n, 3))
        direction = np.cos(theta)[..., None] * up + np.sin(theta)[..., None] * across  # exact unit vectors
        for k in range(n):
            if model.rods[k]:
                tip = tip - model.length[k] * direction[:, np.searchsorted(rods, k)]
            r[:, k] = tip - near[k] * direction[:, len(rods) + k]
            tip = r[:, k] - far[k] * direction[:, len(rods) + k]
        turn = axis_angle_quaternions(axis, (theta - angle)[:, len(rods) :])
        return r, quaternion_product(turn, np.broadcast_to(state.p, (len(t), n, 4)))

    amplitude = float(np.max(np.abs(modes) @ np.hypot(cosines, sines)))
    return ClosedFormMotion(evaluate, "normal modes of small oscillations", amplitude)


def _axis_of_motion(model: Model, A: Array, up: Array, rotations: Array) -> Array:
    """Unit normal (3,) of the vertical plane in which all ``rotations`` (K, 3), tilts and rates, lie."""
    axis = rotations[np.argmax(np.linalg.norm(rotations, axis=1))]
    require(np.any(axis), "some motion")
    axis = axis / np.linalg.norm(axis)
    out_of_plane = np.max(np.abs(rotations - np.outer(rotations @ axis, axis)))
    require(out_of_plane < CONDITION_RTOL, "one plane of motion")
    require(abs(axis @ up) < CONDITION_RTOL, "a vertical plane of motion")
    body_axis = A.mT @ axis
    J = np.einsum("ki,kij,kj->k", body_axis, model.inertia, body_axis)
    off_axis = np.max(np.abs(rotate_vectors(model.inertia, body_axis) - J[:, None] * body_axis))
    require(off_axis < CONDITION_RTOL * np.max(J), "a principal axis of rotation in every body")
    return np.asarray(axis)


# -- a body on a slide, or on a hinge where gravity has no moment --------------------------------------


def damped_oscillator(model: Model, state: State) -> ClosedFormMotion:
    """Solve (m + a) ẍ + c ẋ + k (x − x₀) = f on a slide; of a turn with moments of inertia and moments.

    A turn with a pitch h has m h² besides its moment of inertia, and h times the force along its axis.

    Of the rotor a, damper c, spring k, effort and the constant part f of gravity any may be zero.

    Args:
        model: one body on a joint of one motion at the world.

    Raises:
        ClosedFormMismatch: the scenario is not a linear oscillator.

    """
    kinds = model.kinds
    require(len(kinds) == 1 and kinds[0].freedom == 1, "one body on a joint of one motion")
    require_no_loads(model)
    require(not len(model.spring_body), "no springs between points")
    axis = rotation_matrix(model.turn[0, 0])[:, 2]
    A = rotation_matrix(state.p[0])
    arm = -(A @ model.proximal[0])  # from the joint's near point to the centre of mass
    mass, turns = float(model.mass[0]), bool(kinds[0].turn_axes)
    pitch = float(model.length[0]) if turns else 1.0  # m per unit of the coordinate
    across = arm - (arm @ axis) * axis
    weight_across = np.linalg.norm(np.cross(model.gravity, axis))
    size = np.linalg.norm(arm) * np.linalg.norm(model.gravity)
    is_balanced = np.linalg.norm(across) * weight_across <= CONDITION_RTOL * size
    require(not turns or bool(is_balanced), "a turn about whose axis gravity has no moment at any angle")
    body_axis = A.T @ axis
    about = float(body_axis @ model.inertia[0] @ body_axis + mass * (across @ across)) if turns else 0.0
    inertia = mass * pitch**2 + about + float(model.armature[0, 0])
    k, c = float(model.stiffness[0, 0]), float(model.damping[0, 0])
    force = float(model.effort[0, 0]) + k * float(model.rest[0, 0])
    force += mass * pitch * float(model.gravity @ axis)
    # d/dt (x, ẋ, 1) is linear
    system = np.array([[0, 1, 0], [-k / inertia, -c / inertia, force / inertia], [0, 0, 0]])
    start = np.array([state.x[0, 0], state.xdot[0, 0], 1.0])

    def evaluate(t: Array) -> tuple[Array, Array]:
        moved = (scipy.linalg.expm(system * t[:, None, None]) @ start)[:, 0] - start[0]
        turn = axis_angle_quaternions(axis, turns * moved)
        swung = rotate_vectors(rotation_matrix(turn), arm) - arm
        r = state.r[0] + swung + (pitch * moved)[:, None] * axis
        return r[:, None], quaternion_product(turn, state.p[0][None])[:, None]

    return ClosedFormMotion(evaluate, "exponential of the linear oscillator's matrix")
