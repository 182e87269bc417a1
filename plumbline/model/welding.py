"""Bodies as one rigid piece, or as two halves to be welded.

With Σ = ½ tr(J) I − J, the second moments of the body's mass about its centre, the halves have m/2 each
at ± c and share what their distance leaves of the inertia, ¼ and ¾, so that no two are alike:

    c = √(1/2m) Σ^½ w,    J₁ + J₂ + m (c·c I − c cᵀ) = J,    w no principal axis.

Half of what the body has along c is then still the halves' own: Σ − m c cᵀ ≥ ½ Σ, so that they are
physical, and as well conditioned as the body to within a factor of 8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plumbline.model.datatypes import Array, Float, Model

INERTIA_SHARES = 0.25, 0.75  # of the inertia that is left
SPLIT_DIRECTION = np.ones(3) / np.sqrt(3.0)  # in principal axes


@dataclass(frozen=True, eq=False)
class RigidPart:
    """One rigid piece of a body, welded to the others."""

    mass: float  # kg
    centre: Float[Array, "3"]  # m, from the body's centre of mass, body frame
    inertia: Float[Array, "3 3"]  # kg m², about the piece's own centre, body axes


BodyParts = list[tuple[RigidPart, ...]]  # of every body


def undivided_bodies(model: Model) -> BodyParts:
    """Describe every body as one piece.

    Args:
        model: the chain of N bodies.

    Returns:
        For each body a tuple of one piece.

    """
    each = zip(model.mass, model.inertia, strict=True)
    return [(RigidPart(float(mass), np.zeros(3), inertia),) for mass, inertia in each]


def split_bodies(model: Model) -> BodyParts:
    """Describe every body as two pieces that have its mass, centre of mass and inertia together.

    Args:
        model: the chain of N bodies.

    Returns:
        For each body a tuple of two pieces.

    """
    return [split_body(float(mass), inertia) for mass, inertia in zip(model.mass, model.inertia, strict=True)]


def split_body(mass: float, inertia: Float[Array, "3 3"]) -> tuple[RigidPart, RigidPart]:
    """Split a body into the two halves of the module's docstring.

    Args:
        mass: the body's mass [kg].
        inertia: about its centre of mass, body frame [kg m²].

    """
    principal, axes = np.linalg.eigh(inertia)
    moments = np.maximum(np.sum(principal) / 2 - principal, 0.0)  # of a flat body one is a rounding of zero
    centre = axes @ (np.sqrt(moments / (2 * mass)) * SPLIT_DIRECTION)
    left = inertia - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return RigidPart(mass / 2, centre, INERTIA_SHARES[0] * left), RigidPart(
        mass / 2, -centre, INERTIA_SHARES[1] * left
    )


def part_offsets(parts: BodyParts) -> Float[Array, "bodies"]:
    """Return how far the centres of the pieces are from their body's centre of mass.

    Returns:
        The largest distance in each body [m].

    """
    return np.array([max(float(np.linalg.norm(part.centre)) for part in pieces) for pieces in parts])
