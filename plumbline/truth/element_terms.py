"""Rotors, springs, dampers and efforts in the rounding bound of trees: their forces, and what is rounded.

Coordinate i of a joint acts along s (6,): a unit force at, and a unit torque about, the near point, world
axes.  Its torque is e − k (x − x₀) − c ẋ − a ẍ, where ẍ = sᵀ(relative acceleration) + bias.  Engines that
hold positions find x and l as differences: k multiplies their roundings, of the positions' size.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from plumbline.model.datatypes import JOINT_ELEMENTS, Array, Model, State
from plumbline.model.kinematics import (
    JointFrame,
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
    """The elements along one coordinate of joint k."""

    k: int
    direction: Array  # (6,) s
    is_slide: bool
    armature: float  # kg m² or kg, a
    torque: float  # N m or N, all but a ẍ
    bias: float  # rad/s² or m/s², ẍ where no body accelerates
    size: float  # N m or N, of the terms of the torque, and what their roundings amount to
    kinetic: float  # J
    potential: float  # J, of the terms


@dataclass(frozen=True, eq=False)
class SpringTerms:
    """Springs between points, summed by the bodies."""

    force: Array  # (N, 3) N
    moment: Array  # (N, 3) N m about the centres, world axes
    size: Array  # (N,) N
    moment_size: Array  # (N,) N m
    potential: float = field(default=0.0)  # J


def joint_elements(model: Model, state: State, bends: list[Array]) -> list[JointElement]:
    """List the elements of all joints.

    Args:
        bends: per joint the relative acceleration (6,) that velocities alone cause.

    Returns:
        Those coordinates that have any, in the order of the joints.

    """
    found: list[JointElement] = []
    for k in range(model.n if model.has_joint_elements else 0):
        far, bend = model.body[k, 0], float(np.linalg.norm(bends[k]))
        spins, reaches, speeds = zip(*(_motion(model, state, b) for b in (k, far)), strict=True)
        bend += float(np.linalg.norm(spins[0]) * np.linalg.norm(spins[1]))
        for what, axis, i, x, rate, bias in _coordinates(model, state, k, bends[k], spins):
            a, c, stiffness, rest, effort = (float(getattr(model, name)[k, i]) for name in JOINT_ELEMENTS)
            if not (a or c or stiffness or effort):
                continue
            is_slide = what == "slide"
            place = sum(reaches) if is_slide else 1.0  # what x is a difference of
            pace = sum(speeds) if is_slide else sum(float(np.linalg.norm(spin)) for spin in spins)
            stretch = abs(x) + abs(rest) + place
            found.append(
                JointElement(
                    k=k,
                    direction=np.concatenate([axis * is_slide, axis * (not is_slide)]),
                    is_slide=is_slide,
                    armature=a,
                    torque=effort - stiffness * (x - rest) - c * rate,
                    bias=bias,
                    size=abs(effort) + stiffness * stretch + c * pace + a * bend,
                    kinetic=a * pace**2 / 2,
                    potential=stiffness * stretch**2 / 2,
                )
            )
    return found


def _motion(model: Model, state: State, body: int) -> tuple[Array, float, float]:
    """Angular velocity (3,) of a body, world axes; distance from the origin and speed of its points."""
    if body < 0:
        return np.zeros(3), 0.0, 0.0
    norm, lever = np.linalg.norm, 2 * float(np.max(np.abs(model.point)))
    spin = rotation_matrix(state.p[body]) @ state.omega[body]
    return spin, float(norm(state.r[body])) + lever, float(norm(state.v[body]) + lever * norm(spin))


def _coordinates(
    model: Model, state: State, k: int, bend: Array, spins: tuple[Array, ...]
) -> list[tuple[str, Array, int, float, float, float]]:
    """What moves, the axis, the column of the elements, x, ẋ and the bias of every coordinate of joint k."""
    kind, far = model.kinds[k], model.body[k, 0]
    if kind.is_spherical:
        rest = ball_spring_rest(model, k)
        unloaded = quaternion_product(state.p[far], rest) if far >= 0 else rest
        turn = rotation_vector(quaternion_product(quaternion_conjugate(unloaded), state.p[k]))
        values = rotation_matrix(unloaded) @ turn, spins[0] - spins[1], -cross(spins[1], spins[0])
        of_axis = zip(np.eye(3), *(value.tolist() for value in values), strict=True)
        return [("turn", axis, 0, x, rate, bias) for axis, x, rate, bias in of_axis]
    if kind.has_attitude:
        return []
    axes = JointFrame(model, k, rotation_matrix(state.p[far]) if far >= 0 else np.eye(3)).axes(state.x[k])
    biases = [float(axis @ bend[3 * (what == "turn") :][:3]) for what, axis in axes]
    return [
        (what, axis, i, float(state.x[k, i]), float(state.xdot[k, i]), biases[i])
        for i, (what, axis) in enumerate(axes)
    ]


def spring_terms(model: Model, state: State) -> SpringTerms:
    """Sum the springs between points over the bodies.

    Returns:
        Their forces and the sizes of what is rounded in them.

    """
    n, body = model.n, model.spring_body
    total = SpringTerms(np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n), np.zeros(n))
    A, has_body = rotation_matrix(state.p), body >= 0
    arm = np.where(has_body[..., None], rotate_vectors(A[body], model.spring_point), 0.0)
    omega = rotate_vectors(A, state.omega)
    velocity = np.where(has_body[..., None], state.v[body] + cross(omega[body], arm), 0.0)
    d, d_rate = spring_vectors(model, state.r, state.p), velocity[:, 1] - velocity[:, 0]
    length = np.linalg.norm(d, axis=1)
    k, c = model.spring_stiffness, model.spring_damping
    tension = k * (length - model.spring_length) + c * np.sum(d * d_rate, -1) / length
    norms = np.linalg.norm(model.spring_point, axis=2) + np.where(
        has_body, np.linalg.norm(state.r, axis=1)[body], 0.0
    )
    place = norms.sum(1)  # what d is a difference of
    pace = np.where(has_body, np.linalg.norm(state.v, axis=1)[body], 0.0).sum(1)
    pace = pace + (np.linalg.norm(omega, axis=1)[body] * np.linalg.norm(arm, axis=2)).sum(1)
    drift = c * np.linalg.norm(d_rate, axis=1)
    size = (k + (np.abs(tension) + drift) / length) * place + k * model.spring_length + c * pace
    pull = d * (tension / length)[:, None]
    for side, sign in ((0, 1.0), (1, -1.0)):
        at = body[:, side][has_body[:, side]]
        own, force = arm[has_body[:, side], side], sign * pull[has_body[:, side]]
        own_size = size[has_body[:, side]]
        np.add.at(total.force, at, force)
        np.add.at(total.moment, at, cross(own, force))
        np.add.at(total.size, at, own_size)
        np.add.at(total.moment_size, at, np.linalg.norm(own, axis=1) * own_size)
    stretch = length + model.spring_length + place
    return SpringTerms(
        total.force, total.moment, total.size, total.moment_size, float(np.sum(k * stretch**2) / 2)
    )
