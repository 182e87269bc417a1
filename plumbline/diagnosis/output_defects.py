"""Table of what an engine or its adapter may return in place of a quantity.

Descriptions complete "behaves as if …".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from plumbline.diagnosis.defect_model import DefectCase, centre_positions_and_velocities
from plumbline.diagnosis.hypotheses import to_body, to_world
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import rotate_vectors

Answers = dict[str, Array]


@dataclass(frozen=True)
class OutputDefect:
    """The hypothesis that ``compute(case, right answers)`` is returned as ``quantity``."""

    quantity: str
    description: str
    compute: Callable[[DefectCase, Answers], Array]


def _arm_acceleration(c: DefectCase, answers: Answers) -> Array:
    """Acceleration of the proximal point relative to the centre of mass (B, N, 3), world frame."""
    swing = np.cross(c.omega, np.cross(c.omega, c.proximal))
    return to_world(c, np.cross(answers["angular_acceleration"], c.proximal) + swing)


def _spin_momentum(c: DefectCase) -> Array:
    """Angular momentum (B, 3) of the bodies about their own centres of mass, world frame."""
    return np.asarray(np.sum(to_world(c, rotate_vectors(c.inertia, c.omega)), axis=1))


def _rotational_energy(c: DefectCase) -> Array:
    """½ Σ ω′·J ω′ (B,)."""
    return np.asarray(0.5 * np.sum(c.omega * rotate_vectors(c.inertia, c.omega), axis=(1, 2)))


def _orbital_momentum(c: DefectCase) -> Array:
    """Angular momentum (B, 3) of the total mass, at the common centre of mass, about the pivot."""
    r, v = centre_positions_and_velocities(c)
    m = c.mass[..., None]
    centre = np.sum(m * r, axis=1) / np.sum(m, axis=1)
    return np.cross(centre, np.sum(m * v, axis=1))


BODY_PERMUTATIONS: dict[str, Callable[[Array], Array]] = {
    "the next one": lambda x: np.roll(x, -1, 1),
    "the previous one": lambda x: np.roll(x, 1, 1),
    "the one counted from the other end": lambda x: x[:, ::-1],
}


def _of_another_body(name: str, which: str) -> OutputDefect:
    description = f"it returned the {name.replace('_', ' ')} of another body, {which}"
    return OutputDefect(name, description, lambda _, q: BODY_PERMUTATIONS[which](q[name]))


OUTPUT_DEFECTS = (
    OutputDefect("acceleration",
                 "it returned the spatial acceleration (r̈ − ω × ṙ) instead of the classical one",
                 lambda c, q: q["acceleration"]
                 - np.cross(to_world(c, c.omega), centre_positions_and_velocities(c)[1])),
    OutputDefect("acceleration", "it returned the acceleration minus gravity",
                 lambda c, q: q["acceleration"] - c.gravity[:, None]),
    OutputDefect("acceleration", "it returned the acceleration plus gravity",
                 lambda c, q: q["acceleration"] + c.gravity[:, None]),
    OutputDefect("acceleration", "it returned the acceleration of the proximal point",
                 lambda c, q: q["acceleration"] + _arm_acceleration(c, q)),
    OutputDefect("acceleration", "it returned the acceleration in the body frame",
                 lambda c, q: to_body(c, q["acceleration"])),
    OutputDefect("joint_reaction", "it returned the joint reaction in the body frame",
                 lambda c, q: to_body(c, q["joint_reaction"])),
    OutputDefect("angular_acceleration", "it returned the angular acceleration in the world frame",
                 lambda c, q: to_world(c, q["angular_acceleration"])),
    *(_of_another_body(name, which)
      for name in ("acceleration", "angular_acceleration", "joint_reaction") for which in BODY_PERMUTATIONS),
    OutputDefect("kinetic_energy", "it returned the kinetic energy without rotation",
                 lambda c, q: q["kinetic_energy"] - _rotational_energy(c)),
    OutputDefect("kinetic_energy", "it returned the kinetic energy of rotation alone",
                 lambda c, _: _rotational_energy(c)),
    OutputDefect("angular_momentum", "it returned the angular momentum about the centre of mass",
                 lambda c, q: q["angular_momentum"] - _orbital_momentum(c)),
    OutputDefect("angular_momentum", "it returned the angular momentum of the bodies about their own centres",
                 lambda c, _: _spin_momentum(c)),
    OutputDefect("angular_momentum", "it returned the angular momentum without the bodies' own spin",
                 lambda c, q: q["angular_momentum"] - _spin_momentum(c)),
)  # fmt: skip
