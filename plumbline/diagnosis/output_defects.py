"""Table of what an engine or its adapter may return in place of a quantity.

Descriptions complete "behaves as if …"; {of} in them becomes "" or, where only one body is wrong,
" of body k".
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
    description = f"it returned the {name.replace('_', ' ')}{{of}} of another body, {which}"
    return OutputDefect(name, description, lambda _, q: BODY_PERMUTATIONS[which](q[name]))


def _drag_force(c: DefectCase) -> Array:
    """−c_t ṙ (B, N, 3)."""
    return np.asarray(-c.drag_force[..., None] * centre_positions_and_velocities(c)[1])


FORCES: dict[str, Callable[[DefectCase], Array]] = {
    "applied force": lambda c: c.force,
    "drag force": _drag_force,
    "weight": lambda c: np.asarray(c.mass[..., None] * c.gravity[:, None]),
}


def _scalar_terms(c: DefectCase) -> dict[str, tuple[str, Array]]:
    """What each body adds to energies and momentum: by description the quantity and (B, N[, 3])."""
    r, v = centre_positions_and_velocities(c)
    spin = rotate_vectors(c.inertia, c.omega)
    m = c.mass[..., None]
    orbital = np.cross(r, m * v)
    return {
        "kinetic energy without {}": (
            "kinetic_energy", 0.5 * (c.mass * np.sum(v * v, -1) + np.sum(c.omega * spin, -1))),
        "kinetic energy without the rotation of {}": ("kinetic_energy", 0.5 * np.sum(c.omega * spin, -1)),
        "kinetic energy without the translation of {}": ("kinetic_energy", 0.5 * c.mass * np.sum(v * v, -1)),
        "potential energy without {}": ("potential_energy", -c.mass * np.sum(r * c.gravity[:, None], -1)),
        "angular momentum without {}": ("angular_momentum", orbital + to_world(c, spin)),
        "angular momentum without the spin of {}": ("angular_momentum", to_world(c, spin)),
        "angular momentum without the translation of {}": ("angular_momentum", orbital),
        "angular momentum with the spin in body axes of {}": ("angular_momentum", to_world(c, spin) - spin),
    }  # fmt: skip


def output_defects(case: DefectCase, quantity: str) -> Iterator[OutputDefect]:
    """List what may be returned in place of a quantity.

    Args:
        case: the mechanism, at the states to be explained.

    Yields:
        The table's defects of the quantity, then those in one force, one body or one term of it.

    """
    yield from (defect for defect in OUTPUT_DEFECTS if defect.quantity == quantity)
    if quantity == "joint_reaction":
        for name, force in FORCES.items():
            missing = force(case)
            bodies = [k for k in range(case.n) if np.any(missing[:, k])]
            if len(bodies) > 1:
                yield _reaction_without(f"the {name}s", missing)
            for k in bodies:
                alone = np.where(np.arange(case.n)[:, None] == k, missing, 0.0)
                yield _reaction_without(f"the {name} of body {k + 1}", alone)
        return
    for words, (name, term) in _scalar_terms(case).items():
        if name == quantity:
            if "in body axes" in words:
                yield _without_term(quantity, words.format("all bodies"), np.sum(term, axis=1))
            for k in range(case.n):
                yield _without_term(quantity, words.format(f"body {k + 1}"), term[:, k])


def _reaction_without(what: str, missing: Array) -> OutputDefect:
    """Forces (B, N, 3) left out of the sum over the bodies that a joint carries."""
    carried = np.cumsum(missing[:, ::-1], axis=1)[:, ::-1]
    words = f"it returned the joint reaction without {what}"
    return OutputDefect("joint_reaction", words, lambda _, q: q["joint_reaction"] + carried)


def _without_term(quantity: str, what: str, term: Array) -> OutputDefect:
    return OutputDefect(quantity, f"it returned the {what}", lambda _, q: q[quantity] - term)


OUTPUT_DEFECTS = (
    OutputDefect("acceleration",
                 "it returned the spatial acceleration{of} (r̈ − ω × ṙ) instead of the classical one",
                 lambda c, q: q["acceleration"]
                 - np.cross(to_world(c, c.omega), centre_positions_and_velocities(c)[1])),
    OutputDefect("acceleration", "it returned the acceleration{of} minus gravity",
                 lambda c, q: q["acceleration"] - c.gravity[:, None]),
    OutputDefect("acceleration", "it returned the acceleration{of} plus gravity",
                 lambda c, q: q["acceleration"] + c.gravity[:, None]),
    OutputDefect("acceleration", "it returned the acceleration of the proximal point{of}",
                 lambda c, q: q["acceleration"] + _arm_acceleration(c, q)),
    OutputDefect("acceleration", "it returned the acceleration{of} in the body frame",
                 lambda c, q: to_body(c, q["acceleration"])),
    OutputDefect("joint_reaction", "it returned the joint reaction{of} in the body frame",
                 lambda c, q: to_body(c, q["joint_reaction"])),
    OutputDefect("angular_acceleration", "it returned the angular acceleration{of} in the world frame",
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
