"""Parts shared by both Pinocchio formulations: read-outs, welded parts, calls of older versions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from plumbline.engines.metamorphic_hooks import MetamorphicHooks
from plumbline.model.datatypes import Array, Float, Unsupported
from plumbline.model.kinematics import cross, quaternion_rate
from plumbline.model.welding import RigidPart

WORLD_ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class PinocchioAdapter(MetamorphicHooks):
    """Declarations common to all columns of Pinocchio."""

    package = "pin"
    supported_versions = ">=2.6.21,<5"
    # What the wheels of version 3 were linked with.
    extra_requirements = (("<4", "cmeel-urdfdom<5"), ("<4", "cmeel-tinyxml2<11"))
    welding_unsupported_reason = ""

    def version(self) -> str:
        """Return the version of the pin wheel."""
        return str(pin.__version__)


def joint_of(frame: pin.Frame) -> int:
    """Return the joint that carries a frame; version 2 has another name for it."""
    return int(frame.parentJoint if hasattr(frame, "parentJoint") else frame.parent)


def armature(pin_model: pin.Model) -> Float[Array, "nv"]:
    """Return the inertias [kg m², kg] of the joints' rotors; before version 3 models have none."""
    return np.array(getattr(pin_model, "armature", np.zeros(pin_model.nv)))


def translation(point: Float[Array, "3"]) -> pin.SE3:
    """Return the placement of a frame without rotation.

    Args:
        point: its origin [m] in the parent frame.

    """
    return pin.SE3(np.eye(3), point)


def append_parts(pin_model: pin.Model, joint: int, parts: tuple[RigidPart, ...], placement: pin.SE3) -> None:
    """Append the parts of a body to a joint; Pinocchio welds everything appended to one joint.

    Args:
        joint: index of the joint that carries the body.
        parts: the body's parts.
        placement: of the body's frame in the joint's frame.

    """
    for part in parts:
        inertia = pin.Inertia(part.mass, np.zeros(3), part.inertia)
        pin_model.appendBodyToJoint(joint, inertia, placement * translation(part.centre))


def field_of(data: Any, name: str) -> Any:
    """Return a field; one whose type is unknown to Python in the engine's version is a missing name."""
    try:
        return getattr(data, name)
    except TypeError as error:
        raise AttributeError(str(error), name=name, obj=data) from error


def composite(*joints: Any) -> pin.JointModelComposite:
    """Make one joint of several.

    Args:
        *joints: Pinocchio's models of them, from the parent on.

    """
    joint = pin.JointModelComposite()
    for part in joints:
        joint.addJoint(part)
    return joint


def parts_of(joint: Any) -> list[Any]:
    """Return the joints of a composite one; of another one itself."""
    own = joint.extract() if hasattr(joint, "extract") else joint
    return list(getattr(own, "joints", (joint,)))


def axis_of(joint: Any) -> Float[Array, "3"]:
    """Return the axis of a joint that is named after it."""
    return np.asarray(np.eye(3)["XYZ".index(joint.shortname()[-1])])


def rebuilt(pin_model: pin.Model, parts: Callable[[Any], Sequence[Any]]) -> tuple[pin.Model, list[int]]:
    """Rebuild a model with some joints in turn, and nothing between them, in place of each of its own.

    Returns:
        The model, without frames and rotors, and by joint the number of its last part.

    """
    other, last = pin.Model(), [0]
    other.gravity = pin_model.gravity
    for j in range(1, pin_model.njoints):
        number, place, name = last[pin_model.parents[j]], pin_model.jointPlacements[j], pin_model.names[j]
        for i, part in enumerate(parts(pin_model.joints[j])):
            number = other.addJoint(number, part, place, f"{name}, part {i}")
            place = pin.SE3.Identity()
        other.appendBodyToJoint(number, pin_model.inertias[j], pin.SE3.Identity())
        last.append(number)
    return other, last


def with_single_joints(pin_model: pin.Model) -> tuple[pin.Model, list[int]]:
    """Rebuild a model with the parts of composite joints; q, v and the numbers of frames are the same."""
    other, last = rebuilt(pin_model, parts_of)
    for frame in list(pin_model.frames)[1:]:
        other.addFrame(pin.Frame(frame.name, last[joint_of(frame)], 0, frame.placement, frame.type))
    if hasattr(other, "armature"):
        other.armature = pin_model.armature
    return other, last


Place = tuple[int, pin.SE3]  # a joint, and a place in its frame


def rigid_constraints(
    kind: Any, pin_model: pin.Model, pairs: Iterable[tuple[Place, Place]]
) -> tuple[Any, Any]:
    """Return constraints of a kind that hold pairs of places together, and their data."""
    constraints, data = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    for near, far in pairs:
        ends = *near, *far, pin.ReferenceFrame.LOCAL
        constraints.append(pin.RigidConstraintModel(kind, pin_model, *ends))
        data.append(constraints[-1].createData())
    return constraints, data


def add_frame(pin_model: pin.Model, name: str, joint: int, placement: pin.SE3) -> int:
    """Add an operational frame to a joint.

    Args:
        name: a name that no other frame has.
        joint: index of the joint that carries the frame.
        placement: of the frame in the joint's frame.

    """
    return int(pin_model.addFrame(pin.Frame(name, joint, 0, placement, pin.FrameType.OP_FRAME)))


def point_acceleration(pin_model: pin.Model, data: pin.Data, frame: int) -> Float[Array, "3"]:
    """Read the acceleration of a frame's origin from the last forward kinematics.

    Args:
        data: the workspace made for it, with frame placements up to date.
        frame: index of the frame.

    Returns:
        Second time derivative [m/s²] of the origin's position, world frame.

    """
    return np.asarray(pin.getFrameClassicalAcceleration(pin_model, data, frame, WORLD_ALIGNED).linear)


def energies_and_momentum(
    pin_model: pin.Model, data: pin.Data, q: Float[Array, "nq"], v: Float[Array, "nv"], elastic: float = 0.0
) -> dict[str, Any]:
    """Evaluate the quantities of the whole mechanism.

    Args:
        data: the workspace made for it.
        q: configuration, in Pinocchio's convention.
        v: velocity, in Pinocchio's convention.
        elastic: potential energy of springs [J], which the engine has none of.

    Returns:
        ``kinetic_energy`` and ``potential_energy`` [J] and ``angular_momentum`` (3,) [kg m²/s] about the
        world origin.

    """
    kinetic = pin.computeKineticEnergy(pin_model, data, q, v)
    potential = pin.computePotentialEnergy(pin_model, data, q)
    momentum = pin.computeCentroidalMomentum(pin_model, data, q, v)
    return {
        "kinetic_energy": float(kinetic),
        "potential_energy": float(potential) + elastic,
        "angular_momentum": momentum.angular + cross(data.com[0], momentum.linear),
    }


# -- calls that differ before version 4.0 ------------------------------------------------------------


def init_constraint_dynamics(pin_model: pin.Model, data: pin.Data, contacts: Any, contact_data: Any) -> None:
    """Allocate what `constraintDynamics` needs.

    Args:
        data: the workspace made for it.
        contact_data: their data, which version 3 does not take.

    """
    try:
        pin.initConstraintDynamics(pin_model, data, contacts, contact_data)
    except TypeError:
        pin.initConstraintDynamics(pin_model, data, contacts)


def set_corrector(contact: Any, rate: float) -> None:
    """Set the engine's own correction of gaps in a constraint (Baumgarte's).

    Args:
        rate: a [1/s]; adds −2 a Ċ − a² C to its accelerations.

    """
    before = getattr(contact, "corrector", None)  # version 3
    gains = contact.m_baumgarte_parameters if before is None else before
    gains.Kp, gains.Kd = (
        (rate**2, 2 * rate) if before is None else (np.full(6, rate**2), np.full(6, 2 * rate))
    )


def configuration_rate(
    pin_model: pin.Model, q: Float[Array, "nq"], v: Float[Array, "nv"]
) -> Float[Array, "nq"]:
    """Map a velocity to the rate of the configuration.

    Args:
        pin_model: of any joints; before version 4 of spherical ones.

    Returns:
        q̇; version 3 has no tangent map, and q̇ = ½ q v of spherical joints is evaluated here.

    Raises:
        Unsupported: version 3, and joints other than spherical ones.

    """
    if hasattr(pin, "tangentMapProduct"):
        return np.asarray(pin.tangentMapProduct(pin_model, q, v[:, None])).ravel()
    if 3 * len(q) != 4 * len(v):
        raise Unsupported("Pinocchio before version 4 has no tangent map of joints other than balls and rods")
    p = np.roll(q.reshape(-1, 4), 1, axis=1)
    return np.roll(quaternion_rate(p, v.reshape(-1, 3)), -1, axis=1).ravel()
