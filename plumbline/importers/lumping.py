"""Bodies that are fixed to another one, lumped into it; importers do so or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plumbline.importers.neutral_model import NeutralBody, NeutralModel
from plumbline.model.datatypes import Array, Float
from plumbline.model.kinematics import quaternion_product, rotation_matrix

Part = tuple[NeutralBody, Array, Array]  # a fixed body, its position and rotation matrix in its carrier


def lump_fixed_bodies(model: NeutralModel) -> NeutralModel:
    """Give the mass of each body without joints to the body that carries it, and leave it out.

    Args:
        model: any model.

    Returns:
        A model whose bodies all have joints; what is fixed to the world is left out.

    """
    return _lumped(model)[0]


def fixed_parts(model: NeutralModel) -> dict[str, list[Part]]:
    """List the bodies that `lump_fixed_bodies` lumps into each body, that body first.

    Args:
        model: any model.

    Returns:
        By name of the carrying body: the body, its position and its rotation matrix in the carrier.

    """
    return _lumped(model)[1]


def _lumped(model: NeutralModel) -> tuple[NeutralModel, dict[str, list[Part]]]:
    parts: dict[str, list[Part]] = {}
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
            parts[body.name] = [(body, np.zeros(3), np.eye(3))]
            carrier.append(len(bodies) - 1)
            pose.append((np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])))
            continue
        carrier.append(onto)
        pose.append((position, attitude))
        if onto >= 0:
            parts[bodies[onto].name].append((body, position, rotation_matrix(attitude)))
            bodies[onto] = merge_bodies(bodies[onto], body, position, rotation_matrix(attitude))
    return replace(model, bodies=tuple(bodies)), parts


def merge_bodies(
    body: NeutralBody, added: NeutralBody, position: Float[Array, "3"], A: Float[Array, "3 3"]
) -> NeutralBody:
    """Give a body the mass of another one that is fixed to it.

    Args:
        added: the body that is fixed to it.
        position: of the added body's frame [m] in the carrier's.
        A: rotation matrix, added body → carrier.

    Returns:
        The carrier with the mass, centre of mass and inertia of both.

    """
    mass = body.mass + added.mass
    center = position + A @ added.center
    middle = (body.mass * body.center + added.mass * center) / mass if mass else body.center
    inertia = A @ added.inertia @ A.T + body.inertia
    for part, place in ((body.mass, body.center), (added.mass, center)):
        arm = place - middle
        inertia = inertia + part * (float(arm @ arm) * np.eye(3) - np.outer(arm, arm))
    return replace(body, mass=mass, center=middle, inertia=inertia)
