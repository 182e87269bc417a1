"""Planar small oscillations of a hanging chain, by its normal modes."""

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
)


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
