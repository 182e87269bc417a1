"""Rotors, springs, dampers and efforts in the rounding bound: the sizes of what is rounded in their forces.

The torque of a joint's coordinate is e − k (x − x₀) − c ẋ − a ẍ.  Engines that hold positions find x and the
lengths of springs as differences: k multiplies their roundings, of the positions' size.  Arrays have a
leading axis of S states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plumbline.model.datatypes import JOINT_ELEMENTS, Array, Model, State
from plumbline.model.kinematics import (
    ball_spring_rest,
    cross,
    quaternion_conjugate,
    quaternion_product,
    rotate_vectors,
    rotation_matrix,
    rotation_vector,
    spring_vectors,
)


@dataclass(frozen=True, eq=False)
class JointElement:
    """The elements along one coordinate of joint k, of a ball joint about one axis."""

    k: int
    is_slide: bool
    armature: float  # kg m² or kg, a
    size: Array  # (S,) N m or N, of the terms of the torque, and what their roundings amount to
    kinetic: Array  # (S,) J
    potential: Array  # (S,) J, of the terms


@dataclass(frozen=True, eq=False)
class SpringTerms:
    """Springs between points: sizes of what is rounded, summed over the bodies."""

    size: Array  # (S, N) N
    moment_size: Array  # (S, N) N m
    potential: Array  # (S,) J


def joint_elements(model: Model, state: State, bends: Array) -> list[JointElement]:
    """List the elements of all joints.

    Args:
        bends: (S, N) sizes of the relative accelerations that velocities alone cause.

    Returns:
        Those coordinates that have any, in the order of the joints.

    """
    found: list[JointElement] = []
    if not model.has_joint_elements:
        return found
    norm, lever = np.linalg.norm, 2 * float(np.max(np.abs(model.point)))
    spin = norm(state.omega, axis=-1)
    sizes = norm(state.r, axis=-1) + lever, norm(state.v, axis=-1) + lever * spin, spin
    for k, kind in enumerate(model.kinds[: model.n]):
        far = model.body[k, 0]
        reach, speed, rate = (x[:, k] + (x[:, far] if far >= 0 else 0.0) for x in sizes)
        bend = bends[:, k] + (spin[:, k] * spin[:, far] if far >= 0 else 0.0)
        coordinates = [(what, i, state.x[:, k, i]) for i, (what, _) in enumerate(kind.motions)]
        if kind.is_spherical:
            unloaded = ball_spring_rest(model, k)
            unloaded = quaternion_product(state.p[:, far], unloaded) if far >= 0 else unloaded
            turn = rotation_vector(quaternion_product(quaternion_conjugate(unloaded), state.p[:, k]))
            turn = rotate_vectors(rotation_matrix(unloaded), turn)
            coordinates = [("turn", 0, angle) for angle in turn.T]
        for what, i, x in coordinates:
            a, c, stiffness, rest, effort = (float(getattr(model, name)[k, i]) for name in JOINT_ELEMENTS)
            if not (a or c or stiffness or effort):
                continue
            is_slide = what == "slide"
            pace = speed if is_slide else rate
            stretch = np.abs(x) + abs(rest) + (reach if is_slide else 1.0)  # what x is a difference of
            size = abs(effort) + stiffness * stretch + c * pace + a * bend
            found.append(JointElement(k, is_slide, a, size, a * pace**2 / 2, stiffness * stretch**2 / 2))
    return found


def spring_terms(model: Model, state: State) -> SpringTerms:
    """Measure what is rounded in the forces of springs between points."""
    norm, body, has_body = np.linalg.norm, model.spring_body, model.spring_body >= 0
    A = rotation_matrix(state.p)
    arm = np.where(has_body[..., None], rotate_vectors(A[:, body], model.spring_point), 0.0)
    omega = rotate_vectors(A, state.omega)[:, body]
    velocity = np.where(has_body[..., None], state.v[:, body] + cross(omega, arm), 0.0)
    d, d_rate = spring_vectors(model, state.r, state.p), velocity[:, :, 1] - velocity[:, :, 0]
    length, change = norm(d, axis=-1), norm(d_rate, axis=-1)
    k, c = model.spring_stiffness, model.spring_damping
    tension = k * (length - model.spring_length) + c * np.sum(d * d_rate, -1) / length
    # what d and its rate are differences of
    place = np.sum(norm(model.spring_point, axis=-1) + has_body * norm(state.r, axis=-1)[:, body], -1)
    pace = np.sum(has_body * norm(state.v, axis=-1)[:, body] + norm(omega, axis=-1) * norm(arm, axis=-1), -1)
    size = (k + (np.abs(tension) + c * change) / length) * place + k * model.spring_length + c * pace
    of_body = np.zeros((2, len(state.p), model.n))
    for spring, end in np.argwhere(has_body):
        of_body[0, :, body[spring, end]] += size[:, spring]
        of_body[1, :, body[spring, end]] += norm(arm[:, spring, end], axis=-1) * size[:, spring]
    potential = np.sum(k * (length + model.spring_length + place) ** 2, -1) / 2
    return SpringTerms(of_body[0], of_body[1], potential)
