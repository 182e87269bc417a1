"""The neutral model: what a model file says, as a tree of bodies on elementary joints.

Pose of a body in its parent's frame, with the coordinates x of its joints J₁, J₂, … in their order:

    T(x) = Trans(position) Rot(attitude) J₁(x₁) J₂(x₂) …
    hinge  J = Trans(anchor) Rot(axis, x − reference) Trans(−anchor)
    slide  J = Trans(axis (x − reference))
    ball   J = Trans(anchor) Rot(x) Trans(−anchor)
    free   T(x) is the pose x of the body frame in the world; position and attitude do not matter

Canonical coordinates x and velocities v, in the order of the bodies and, in a body, of its joints:

    hinge  angle [rad], its rate
    slide  displacement [m], its rate
    ball   unit quaternion (scalar first); angular velocity of the ball [rad/s] in the axes after the ball
    free   position [m] of the body frame and unit quaternion, in the world;
           linear velocity of the body frame's origin in world axes, angular velocity in body axes

With q the coordinates of an engine and v_e = T v its velocities: M = TᵀM_eT, h = Tᵀ(M_e Ṫv + h_e), f = Tᵀf_e.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from plumbline.model.datatypes import Array, Float
from plumbline.scenario.line_and_column_errors import Problem

MAX_MAGNITUDE = 1e30  # of a file's SI numbers: beyond it products leave the range where engines can compute
MIN_INERTIA = 1e-100  # kg, kg m²: below it products lose digits, or vanish
_JOINT_NUMBERS = (
    "axis", "anchor", "reference", "armature", "damping", "stiffness", "spring_reference", "friction_loss"
)  # fmt: skip
JointKind = Literal["hinge", "slide", "ball", "free"]
COORDINATE_COUNT: dict[JointKind, int] = {"hinge": 1, "slide": 1, "ball": 4, "free": 7}
VELOCITY_COUNT: dict[JointKind, int] = {"hinge": 1, "slide": 1, "ball": 3, "free": 6}


@dataclass(frozen=True, order=True)
class Source:
    """Where a file says something."""

    file: str  # as the user typed it, or relative to the root
    line: int  # from 1; 0: the file does not say it, the format's default holds
    column: int = 1  # from 1, of the element's beginning

    def __str__(self) -> str:
        """Write as ``file:line``."""
        return f"{self.file}:{self.line}" if self.line else self.file

    def problem(self, message: str, valid: str = "", hint: str = "", field: str = "") -> Problem:
        """Make a problem at this place, see `Problem`."""
        return Problem(self.file, self.line, self.column, field, message, valid, hint)


@dataclass(frozen=True, eq=False)
class ElementaryJoint:
    """One joint with one kind of motion; a body may have several, applied one after another.

    ``armature`` … ``friction_loss`` hold for each of its degrees of freedom alike.  The passive force is
    −damping v − stiffness (x − spring_reference); of a ball −stiffness times the rotation vector of its
    quaternion, in the axes after the ball; of a free joint the same, from the pose of the reference.
    """

    name: str  # unique in the model; a free joint without a name is called "<body>/free"
    kind: JointKind
    axis: Float[Array, "3"]  # unit, body frame before this joint's motion; zero for ball and free
    anchor: Float[Array, "3"]  # m, body frame; zero for slide and free
    reference: float = 0.0  # rad or m: coordinate at which the joint does not move the body
    armature: float = 0.0  # kg m² or kg, added to the diagonal of the mass matrix
    damping: float = 0.0  # N m s/rad or N s/m
    stiffness: float = 0.0  # N m/rad or N/m
    spring_reference: float = 0.0  # rad or m
    friction_loss: float = 0.0  # N m or N; no part of the passive force
    source: Source = Source("", 0)
    fields: Mapping[str, Source] = field(default_factory=dict)  # places of fields that are set elsewhere


@dataclass(frozen=True, eq=False)
class NeutralBody:
    """A body: its pose in the parent at the joints' reference, its joints and its inertial parameters."""

    name: str  # unique in the model
    parent: int  # index of the parent, always smaller; −1: the world
    position: Float[Array, "3"]  # m, origin of the body frame in the parent's frame
    attitude: Float[Array, "4"]  # unit quaternion, scalar first, body frame → parent's frame
    joints: tuple[ElementaryJoint, ...]
    mass: float  # kg
    center: Float[Array, "3"]  # m, centre of mass in the body frame
    inertia: Float[Array, "3 3"]  # kg m², about the centre of mass, body axes
    source: Source = Source("", 0)
    fields: Mapping[str, Source] = field(default_factory=dict)


@dataclass(frozen=True)
class Feature:
    """Something in the file that is not compared, or that the format leaves open."""

    what: str  # as "actuator", "limit", "mimic"
    name: str
    source: Source


@dataclass(frozen=True, eq=False)
class NeutralModel:
    """A model file's meaning, or an importer's reading of it."""

    name: str
    bodies: tuple[NeutralBody, ...]  # depth first: a parent precedes its children
    gravity: Float[Array, "3"]  # m/s², world frame
    not_compared: tuple[Feature, ...] = ()
    ambiguous: tuple[Feature, ...] = ()  # what the format leaves open, as links without <inertial>
    gravity_source: Source = Source("", 0)

    @property
    def joints(self) -> tuple[ElementaryJoint, ...]:
        """The joints of all bodies in canonical order."""
        return tuple(joint for body in self.bodies for joint in body.joints)

    @property
    def velocity_count(self) -> int:
        """Number of degrees of freedom."""
        return sum(VELOCITY_COUNT[joint.kind] for joint in self.joints)

    def joint_slices(self) -> Iterator[tuple[ElementaryJoint, slice, slice]]:
        """Go through the joints with their places.

        Yields:
            Joint, slice of its canonical coordinates, slice of its canonical velocities.

        """
        x = v = 0
        for joint in self.joints:
            dx, dv = COORDINATE_COUNT[joint.kind], VELOCITY_COUNT[joint.kind]
            yield joint, slice(x, x + dx), slice(v, v + dv)
            x, v = x + dx, v + dv


@dataclass(frozen=True, eq=False)
class CanonicalState:
    """Canonical coordinates and velocities of a neutral model."""

    coordinates: Float[Array, "coordinates"]
    velocities: Float[Array, "velocities"]


MODEL_UNITS = {  # of what is compared, by the name of its row
    "joints": "1",
    "total_mass": "kg",
    "position": "m",
    "attitude": "1",
    "mass_matrix": "SI",
    "gravity_force": "SI",
    "bias_force": "SI",
    "passive_force": "SI",
    "damping": "SI",
    "acceleration": "SI",
    "kinetic_energy": "J",
    "potential_energy": "J",
    "rewritings": "1",
}


@dataclass(frozen=True, eq=False)
class ModelQuantities:
    """What is computed of a model at one state, in canonical velocities of the reading that was evaluated.

    The equations of motion are M v̇ + h = passive_force; None where an importer's engine does not compute it.
    """

    poses: Mapping[str, Array]  # body name → (3, 4): rotation body → world, and origin [m]
    mass_matrix: Float[Array, "n n"] | None = None  # with armature
    bias_force: Float[Array, "n"] | None = None  # h: Coriolis, centrifugal and gravity, on the left
    gravity_force: Float[Array, "n"] | None = None  # h at v = 0
    passive_force: Float[Array, "n"] | None = None  # of dampers and springs, as on the right
    acceleration: Float[Array, "n"] | None = None  # v̇ without friction loss, contacts, limits, actuators
    kinetic_energy: float | None = None  # J: ½ vᵀMv, with armature
    potential_energy: float | None = None  # J: −Σ m g·c of gravity alone, zero at the world's origin


def without_passive_forces(model: NeutralModel) -> NeutralModel:
    """Leave dampers and springs out, for engines whose equations do not have them.

    Args:
        model: any model.

    Returns:
        The model without them; the same object where it has none.

    """
    if not any(joint.damping or joint.stiffness for joint in model.joints):
        return model
    bodies = tuple(
        replace(body, joints=tuple(replace(j, damping=0.0, stiffness=0.0) for j in body.joints))
        for body in model.bodies
    )
    return replace(model, bodies=bodies)


def zero_directions(model: NeutralModel) -> Iterator[tuple[str, float, str, Source]]:
    """Find axes and attitudes without a direction, as normalising extreme numbers leaves them.

    Args:
        model: what a file says; its numbers are finite.

    Yields:
        As `extreme_numbers`: the parameter, its length, what would be valid, and where the file says it.

    """
    moving = {f"joint {joint.name}" for joint in model.joints if joint.kind in ("hinge", "slide")}
    for name, owner, values, place in _parameters(model):
        is_direction = name == "attitude" or (name == "axis" and owner in moving)
        if is_direction and not 0.5 < (length := float(np.linalg.norm(values))) < 2:
            yield f"the normalised {name} of {owner}", length, "numbers whose squares are in range", place


def extreme_numbers(model: NeutralModel) -> Iterator[tuple[str, float, str, Source]]:
    """Find numbers with which no engine can compute: not finite, too large, or inertia that is nearly none.

    Args:
        model: what a file says, or an importer's reading of it.

    Yields:
        The parameter with its owner in words, the number, what would be valid, and where the file says it.

    """
    for name, owner, values, place in _parameters(model):
        worst = float(np.max(np.abs(values)))
        if not worst <= MAX_MAGNITUDE:
            yield f"{name} of {owner}", worst, f"a number up to {MAX_MAGNITUDE:g}", place
        elif name in ("mass", "inertia") and 0 < worst < MIN_INERTIA:
            yield f"{name} of {owner}", worst, f"0, or at least {MIN_INERTIA:g}", place


def _parameters(model: NeutralModel) -> Iterator[tuple[str, str, Array | float, Source]]:
    """Every parameter: its name, its owner in words, its numbers, and where the file says it."""
    yield "gravity", "the model", model.gravity, model.gravity_source
    for body in model.bodies:
        for name in ("position", "attitude", "mass", "center", "inertia"):
            yield name, f"body {body.name}", getattr(body, name), body.fields.get(name, body.source)
        for joint in body.joints:
            for name in _JOINT_NUMBERS:
                place = joint.fields.get(name, joint.source)
                yield name.replace("_", " "), f"joint {joint.name}", getattr(joint, name), place
