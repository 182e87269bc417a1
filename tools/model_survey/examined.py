"""What was examined by hand: kinds of difference, by importer, format and parameter.

A cause that `plumbline model` names belongs to the first entry that fits.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

Kind = Literal["differs from the file", "not supported", "left open by the file", "accuracy"]


@dataclass(frozen=True)
class Examined:
    """One kind of difference."""

    importer: str
    format: str
    fields: tuple[str, ...]  # of the causes
    kind: Kind
    title: str  # a clause about the importer
    script: str = ""  # in docs/importers
    pattern: str = ""  # regular expression that the file's name and the cause's sentence match

    def fits(self, importer: str, form: str, field: str, sentence: str) -> bool:
        """Whether a cause is of this kind.

        Args:
            importer: that differs.
            sentence: the file's name and the sentence of the cause.

        """
        own = importer, form
        return (
            own == (self.importer, self.format)
            and field in self.fields
            and (not self.pattern or re.search(self.pattern, sentence) is not None)
        )


INERTIAL_FIELDS = ("mass", "center", "inertia", "inertial")
WITHOUT_INERTIAL = ("default inertial", "assumed inertial")
JOINT_POSE = ("axis", "anchor", "position", "attitude", "reference")

EXAMINED = (
    Examined(
        "mujoco", "urdf", ("inertial", "inertia"), "differs from the file",
        "drops the inertia of a massless link that is fixed to another one", "mujoco_massless_link.py",
    ),
    Examined(
        "pinocchio", "mjcf", ("gravity",), "not supported",
        "does not read `<option gravity>` and its flag", "pinocchio_gravity.py",
    ),
    Examined(
        "pinocchio", "mjcf", ("joints", "missing body"), "not supported",
        "reads only the first body of `<worldbody>`", "pinocchio_second_root.py",
        r"as none \(fixed\)|leaves out",
    ),
    Examined(
        "pinocchio", "mjcf", ("position", "attitude"), "differs from the file",
        "drops the pose of a root body without joint", "pinocchio_root_pose.py",
    ),
    Examined(
        "pinocchio", "mjcf", ("origin",), "differs from the file",
        "puts a free root body that the file turns elsewhere, by p − R p", "pinocchio_root_pose.py",
    ),
    Examined(
        "pinocchio", "mjcf", INERTIAL_FIELDS, "differs from the file",
        "reads no mass of geoms from the defaults, none of geoms that collide with nothing, and no "
        "`settotalmass`", "pinocchio_geom_mass.py",
    ),
    Examined(
        "pinocchio", "mjcf", ("anchor", "damping"), "differs from the file",
        "reads no `pos` of joints from the defaults, no damping of ball joints and no `springdamper`",
        "pinocchio_joint_defaults.py",
    ),
    Examined(
        "pinocchio", "mjcf", ("armature in the kinetic energy",), "differs from the file",
        "`computeKineticEnergy` leaves out the armature of hinges whose axis is none of x, y, z",
        "pinocchio_armature.py",
    ),
    Examined(
        "drake", "urdf", INERTIAL_FIELDS, "differs from the file",
        "replaces mass and inertia that no rigid body has by others, with a warning",
        "drake_replaced_inertia.py",
    ),
    Examined(
        "drake", "mjcf", ("axis", "anchor"), "differs from the file",
        "applies the pose of a body with several joints after the first of them", "drake_several_joints.py",
    ),
    Examined(
        "drake", "mjcf", ("stiffness",), "not supported", "does not read joint springs, with a warning",
        "drake_springs.py",
    ),
    Examined(
        "drake", "mjcf", ("armature",), "not supported",
        "reads the armature only of joints with an actuator that it reads", "drake_springs.py",
    ),
    Examined(
        "drake", "mjcf", ("gravity", "damping", "mass", "inertia"), "differs from the file",
        "reads no `flag gravity` and no `settotalmass`, with a warning, and no joint defaults through a "
        "class without `<joint>`", "drake_defaults.py", r"^(?!.*omron)",  # there it is the mass of meshes
    ),
    Examined("drake", "mjcf", ("reference", "position"), "not supported", "does not read `ref` of joints"),
    Examined(
        "dart", "urdf", (*INERTIAL_FIELDS, *WITHOUT_INERTIAL), "left open by the file",
        "gives a link without `<inertial>` a mass of 1 kg and moments of 1 kg m²", "dart_default_inertial.py",
    ),
    Examined(
        "dart", "mjcf", ("joints",), "differs from the file", "does not read `<freejoint>`",
        "dart_freejoint.py",
    ),
    Examined(
        "dart", "mjcf", INERTIAL_FIELDS, "differs from the file",
        "reads `<inertial>` only beside a `<geom>`, and its moments never; where it infers mass, counts the "
        "first `<geom>` only, with a warning", "dart_mjcf_inertial.py",
    ),
    Examined(
        "dart", "mjcf", ("position", "attitude"), "differs from the file",
        "puts a body without `pos` at its first `<geom>`", "dart_body_pose.py",
    ),
    Examined(
        "dart", "mjcf", ("stiffness", "armature"), "not supported", "reads no springs and no armature",
        "dart_joints.py",
    ),
    Examined(
        "dart", "mjcf", ("gravity",), "not supported", "does not read `<option gravity>`", "dart_joints.py"
    ),
    Examined(
        "dart", "mjcf", ("reference",), "not supported", "does not read `ref` of joints", "dart_joints.py"
    ),
    Examined(
        "exudyn", "urdf", ("damping",), "differs from the file",
        "reads no damping, and takes a joint's friction for viscous friction, which the caller may apply",
        "exudyn_friction.py",
    ),
    Examined(
        "mujoco", "urdf", ("assumed inertial",), "left open by the file",
        "takes the mass of a link without `<inertial>` from its geometry",
    ),
    Examined(
        "exudyn", "urdf", ("inertial", "mass", "center", "inertia"), "differs from the file",
        "leaves links on fixed joints out, with their mass", "exudyn_fixed_link.py",
    ),
    Examined(
        "exudyn", "urdf", (*JOINT_POSE, "parent"), "differs from the file",
        "turns the frame of a link whose axis is none of x, y, z, and not what the link carries; attaches "
        "children of links without joint to the world", "exudyn_turned_axis.py",
    ),
    Examined(
        "pybullet", "mjcf", ("joints", "missing body"), "not supported",
        "reads no joints without `type` and no `<freejoint>`", "pybullet_joint_type.py",
    ),
    Examined("pybullet", "mjcf", ("damping",), "not supported", "reads no damping", "pybullet_joints.py"),
    Examined(
        "pybullet", "mjcf", INERTIAL_FIELDS, "differs from the file",
        "does not read `diaginertia`, and keeps numbers in single precision", "pybullet_mjcf_inertial.py",
    ),
    Examined("pybullet", "mjcf", ("armature",), "not supported", "reads no armature", "pybullet_joints.py"),
    Examined(
        "pybullet", "mjcf", ("gravity",), "not supported", "takes gravity from its caller",
        "pybullet_joints.py",
    ),
    Examined(
        "pybullet", "mjcf", JOINT_POSE, "accuracy", "keeps numbers in single precision",
        "pybullet_mjcf_inertial.py",
    ),
    Examined(
        "pybullet", "urdf", ("mass", "center", *WITHOUT_INERTIAL), "left open by the file",
        "gives a link without `<inertial>` a mass of 1 kg and moments of 1 kg m²",
        "pybullet_urdf_inertial.py",
    ),
    Examined(
        "pybullet", "urdf", ("inertia",), "accuracy",
        "diagonalises inertias to a limited accuracy, and replaces those that no rigid body has",
        "pybullet_urdf_inertial.py",
    ),
    Examined(
        "pybullet", "urdf", ("displacement",), "left open by the file",
        "places a link on a slide by the coordinate times the length of its axis, and has the unit axis in "
        "its equations", "pybullet_slide_axis.py",
    ),
    Examined(
        "pybullet", "urdf", ("joints",), "differs from the file", "fixes a base without mass to the world"
    ),
)  # fmt: skip

# Differences that no change of parameters explains: what looking at them showed, by importer and file name.
UNPROVED = {
    ("pinocchio", "rodent.xml"): "`pos` of joints from the defaults "
    "([pinocchio_joint_defaults.py](importers/pinocchio_joint_defaults.py)), the pose of the root, and the "
    "frames of bodies whose joints have several anchors (the shoulder blades, 5 mm), together",
    ("mujoco", "convex.xml"): "the centre of mass of a free mesh is 3 nm off its frame: MuJoCo takes the "
    "frames for one and leaves m c out of M",
    ("pybullet", "general_dyntype.xml"): "a mass in single precision, and of four slides of one body one "
    "with an axis of length √2 ([pybullet_slide_axis.py](importers/pybullet_slide_axis.py))",
    ("pybullet", "pendula.xml"): "bodies are left out, with ball joints and joints without `type` "
    "([pybullet_joint_type.py](importers/pybullet_joint_type.py))",
    ("dart", "rodent.xml"): "armature, springs, inertias and masses as elsewhere; moments of 1e-7 kg m² are "
    "read as 1, and what remains is 3 to 58 times the bound of rounding, which the file's moments make",
}  # fmt: skip

# The first version that does what the entries say, found by running the scripts and `plumbline bisect` with
# other versions: all entries of one importer and format have the same.
SINCE = {
    ("mujoco", "urdf"): "3.2.0 or earlier",
    ("pinocchio", "mjcf"): "3.3.1 or earlier",
    ("drake", "urdf"): "1.32.0 or earlier",
    ("drake", "mjcf"): "1.32.0 or earlier",
    ("dart", "urdf"): "6.16.2 or earlier",
    ("dart", "mjcf"): "6.20.0, the first that reads the scripts' files",
    ("exudyn", "urdf"): "1.10.0, the first with the loader",
    ("pybullet", "urdf"): "3.2.6 or earlier",
    ("pybullet", "mjcf"): "3.2.6 or earlier",
}
