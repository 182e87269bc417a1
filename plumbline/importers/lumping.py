"""Bodies that are fixed to another one, lumped into it; importers do so or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plumbline.importers.neutral_model import NeutralBody, NeutralModel
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import quaternion_product, rotation_matrix


def lump_fixed_bodies(model: NeutralModel) -> NeutralModel:
    """Give the mass of each body without joints to the body that carries it, and leave it out.

    Args:
        model: any model.

    Returns:
        A model whose bodies all have joints; what is fixed to the world is left out.

    """
    carrier: list[int] = []  # index of the new body that carries the old one; −1: the world
    pose: list[tuple[Array, Array]] = []  # of the old body in its carrier: position, quaternion
    bodies: list[NeutralBody] = []
    for body in model.bodies:
        position, attitude = np.asarray(body.position, float), np.asarray(body.attitude, float)
        onto = -1
        if body.parent >= 0:
            onto, (origin, turn) = carrier[body.parent], pose[body.parent]
            position = origin + rotation_matrix(turn) @ position
            attitude = quaternion_product(turn, attitude)
        if body.joints:
            bodies.append(replace(body, parent=onto, position=position, attitude=attitude))
            carrier.append(len(bodies) - 1)
            pose.append((np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])))
            continue
        carrier.append(onto)
        pose.append((position, attitude))
        if onto >= 0:
            bodies[onto] = _merged(bodies[onto], body, position, rotation_matrix(attitude))
    return replace(model, bodies=tuple(bodies))


def _merged(body: NeutralBody, added: NeutralBody, position: Array, A: Array) -> NeutralBody:
    """A body with the mass of another one that is fixed to it."""
    mass = body.mass + added.mass
    center = position + A @ added.center
    middle = (body.mass * body.center + added.mass * center) / mass if mass else body.center
    inertia = A @ added.inertia @ A.T + body.inertia
    for part, place in ((body.mass, body.center), (added.mass, center)):
        arm = place - middle
        inertia = inertia + part * (float(arm @ arm) * np.eye(3) - np.outer(arm, arm))
    return replace(body, mass=mass, center=middle, inertia=inertia)
