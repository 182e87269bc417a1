"""The project's own reader of URDF: the neutral model that the format's specification describes.

Every decimal is rounded to double once.  With the joint's origin (xyz, rpy) the frame of the child link is
T = Trans(xyz) Rz(yaw) Ry(pitch) Rx(roll) J(x), and the joint moves about or along its axis in that frame
(http://wiki.ros.org/urdf/XML).  A continuous joint is a hinge; a planar one two slides perpendicular to its
axis and a hinge about it; a floating one a free joint below the root and links fixed to it, else three slides
and a ball.  From version 1.1 an origin may have a quaternion quat_xyzw in place of rpy
(https://github.com/ros/urdfdom).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from plumbline.importers.neutral_model import (
    ElementaryJoint,
    Feature,
    JointKind,
    NeutralBody,
    NeutralModel,
    Source,
)
from plumbline.importers.xml_tree import Element, ModelFileError, parse_numbers
from plumbline.model.datatypes import Array, Float
from plumbline.model.kinematics import quaternion_product, rotation_matrix
from plumbline.scenario.line_and_column_errors import Problem, did_you_mean, first_words, shorten

GRAVITY = (0.0, 0.0, -9.81)  # m/s²; a URDF does not say it
_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_NOT_DYNAMIC = {"material", "verbose"}  # children of <robot> that no dynamics depends on
_READ = {  # what is read of each element: its attributes, and the first of each of these elements in it
    "link": ({"name"}, {"inertial"}),
    "inertial": (set[str](), {"origin", "mass", "inertia"}),
    "joint": ({"name", "type"}, {"origin", "parent", "child", "axis", "dynamics"}),
    "origin": ({"xyz", "rpy"}, set[str]()),
    "mass": ({"value"}, set[str]()),
    "inertia": (set(_INERTIA), set[str]()),
    "parent": ({"link"}, set[str]()),
    "child": ({"link"}, set[str]()),
    "axis": ({"xyz"}, set[str]()),
    "dynamics": ({"damping", "friction"}, set[str]()),
}
_QUATERNION = "quat_xyzw"
_VERSION = re.compile(r"(\d{1,9})\.(\d{1,9})", re.ASCII)
_GEOMETRY = {"visual", "collision"}
_TRIANGLE_ROUNDING = 1e-9  # relative; published inertias are rounded to a few decimals


def read_urdf(root: Element, base: str) -> NeutralModel:
    """Translate a parsed file to the neutral model; gravity is (0, 0, −9.81).

    Args:
        base: "fixed" or "free": whether the root link is fixed to the world.

    Returns:
        Bodies depth first, children in the order of the file's joints.

    Raises:
        ModelFileError: the file has mistakes; all of them are listed.

    """
    return _UrdfReader(root).read(base)


@dataclass(frozen=True)
class _Joint:
    """A joint as the file has it."""

    element: Element
    kind: str
    parent: str
    child: str


class _UrdfReader:
    """Reads one file and collects its problems."""

    def __init__(self, root: Element) -> None:
        self.root = root
        self.problems: list[Problem] = []
        self.features: list[Feature] = []
        self.ambiguous: list[Feature] = []
        self.links = self.named("link")
        self.joints = self.named("joint")
        version = _VERSION.fullmatch(root.attributes.get("version", ""))
        self.has_quaternions = version is not None and (int(version[1]), int(version[2])) >= (1, 1)
        self.fixed_to_root: set[str] = set()  # links that no joint of the file moves, with the root itself

    def named(self, tag: str) -> dict[str, Element]:
        """Index the robot's children of a tag by name."""
        found: dict[str, Element] = {}
        for element in self.root.find_all(tag):
            name = element.attributes.get("name", "")
            if not name:
                self.problems.append(element.problem("has no name", "name", "a name, unique in the file"))
            elif name in found:
                message = f"has the name of the {tag} at {found[name].source}"
                self.problems.append(element.problem(message, "name", "a name, unique in the file"))
            else:
                found[name] = element
        return found

    def read(self, base: str) -> NeutralModel:
        """Read the robot; the bodies come depth first, children in the order of the file's joints."""
        if not self.links and not self.problems:
            self.problems.append(self.root.problem("has no <link>"))
        below, top = self.tree()
        if top == "world" and base == "free":
            message = "is the root link: importers take it for the world itself, which is fixed"
            hint = "leave --base free out, or rename the link"
            self.problems.append(self.links[top].problem(message, "name", hint=hint))
        self.note_features()
        bodies: list[NeutralBody] = []
        stack: list[tuple[str, int, _Joint | None]] = [(top, -1, None)] if top else []
        while stack:
            name, parent, joint = stack.pop()
            if joint is None or (joint.kind == "fixed" and joint.parent in self.fixed_to_root):
                self.fixed_to_root.add(name)
            bodies.append(self.body(name, parent, joint, base))
            stack.extend((j.child, len(bodies) - 1, j) for j in reversed(below.get(name, [])))
        if self.problems:
            raise ModelFileError(self.problems)
        return NeutralModel(
            self.root.attributes.get("name", ""), tuple(bodies), np.array(GRAVITY),
            tuple(self.features), tuple(self.ambiguous), Source(self.root.source.file, 0),
        )  # fmt: skip

    def tree(self) -> tuple[dict[str, list[_Joint]], str]:
        """Return the joints below each link, and the root link; empty where there is no tree."""
        below: dict[str, list[_Joint]] = {}
        holder: dict[str, _Joint] = {}
        for element in self.joints.values():
            ends = [self.end(element, tag) for tag in ("parent", "child")]
            kind = element.attributes.get("type", "")
            if kind not in _TYPES:
                valid, hint = "one of " + ", ".join(_TYPES), did_you_mean(kind, _TYPES)
                self.problems.append(element.problem(f"is {shorten(repr(kind))}", "type", valid, hint))
            if not all(ends):
                continue
            joint = _Joint(element, kind, *ends)
            if joint.child in holder:
                other = holder[joint.child].element
                message = f"link {joint.child!r} is the child of joint {other.attributes['name']!r} too"
                self.problems.append(
                    element.problem(f"{message} ({other.source})", hint="remove one of them")
                )
                continue
            holder[joint.child] = joint
            below.setdefault(joint.parent, []).append(joint)
        tops = [name for name in self.links if name not in holder]
        is_any_left_out = len(holder) < len(self.root.find_all("joint"))  # with a mistake, which is listed
        if len(tops) > 1 and not is_any_left_out:
            listed = ", ".join(f"{name!r} ({self.links[name].source})" for name in tops[:5])
            message = f"has {len(tops)} links that are no joint's child: {listed}"
            self.problems.append(self.root.problem(message, valid="one root link"))
        self.check_cycles(tops, below)
        return below, tops[0] if tops else ""

    def check_cycles(self, tops: list[str], below: dict[str, list[_Joint]]) -> None:
        """Report links that no root reaches: they hang in a circle."""
        reached, stack = set(tops), list(tops)
        while stack:
            children = [joint.child for joint in below.get(stack.pop(), [])]
            reached.update(children)
            stack += children
        circle = [name for name in self.links if name not in reached]
        if circle and not any(problem.field.startswith("<joint") for problem in self.problems):
            names = first_words([*map(repr, circle)], 5)
            message = f"is in a circle of joints, with the links {names}"
            self.problems.append(self.links[circle[0]].problem(message, valid="a tree"))

    def end(self, element: Element, tag: str) -> str:
        """Return the link at one end of a joint; empty where the file has a mistake."""
        child = element.find(tag)
        if child is None:
            self.problems.append(element.problem(f"has no <{tag}>", valid=f'<{tag} link="…"/>'))
            return ""
        name = child.attributes.get("link", "")
        if name not in self.links:
            hint = did_you_mean(name, list(self.links))
            self.problems.append(
                child.problem(f"there is no link {shorten(repr(name))}", "link", "the name of a link", hint)
            )
            return ""
        return name

    def numbers(self, element: Element | None, attribute: str, default: tuple[float, ...]) -> list[float]:
        """Read an attribute's numbers; the default where the attribute or its element is missing."""
        if element is None or attribute not in element.attributes:
            return list(default)
        return parse_numbers(element, attribute, len(default), self.problems)

    def required(self, element: Element | None, owner: Element, tag: str, attribute: str) -> float:
        """Read one number that must be there."""
        if element is None or attribute not in element.attributes:
            message = f"has no <{tag} {attribute}=…>"
            self.problems.append((element or owner).problem(message, valid="a number"))
            return 0.0
        return parse_numbers(element, attribute, 1, self.problems)[0]

    def pose(self, owner: Element) -> tuple[Array, Array]:
        """Read an <origin>: position and unit quaternion."""
        origin = owner.find("origin")
        zeros = (0.0, 0.0, 0.0)
        position, rpy = (self.numbers(origin, name, zeros) for name in ("xyz", "rpy"))
        if not self.has_quaternions or origin is None or _QUATERNION not in origin.attributes:
            return np.array(position), quaternion_from_rpy(rpy)
        if "rpy" in origin.attributes:
            self.problems.append(origin.problem("stands beside rpy", _QUATERNION, "one of the two"))
        return np.array(position), np.roll(self.unit(origin, _QUATERNION, 4, "a turn"), 1)

    def body(self, name: str, parent: int, joint: _Joint | None, base: str) -> NeutralBody:
        """Read a link and the joint that holds it."""
        link = self.links[name]
        position, attitude = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        joints: tuple[ElementaryJoint, ...] = ()
        fields: dict[str, Source] = {}
        if joint is None:
            if base == "free":
                joints = (_joint(f"{name}/free", "free", np.zeros(3), link.source),)
        else:
            position, attitude = self.pose(joint.element)
            joints = self.elementary(joint)
            origin = joint.element.find("origin")
            fields = dict.fromkeys(("position", "attitude"), (origin or joint.element).source)
        mass, center, inertia = self.inertial(link, fields)
        return NeutralBody(
            name, parent, position, attitude, joints, mass, center, inertia, link.source, fields
        )

    def inertial(self, link: Element, fields: dict[str, Source]) -> tuple[float, Array, Array]:
        """Read mass [kg], centre of mass [m] and inertia [kg m²] in link axes; zero where there are none."""
        inertial = link.find("inertial")
        if inertial is None:
            name = link.attributes["name"]
            self.ambiguous.append(Feature("link without <inertial>: read as massless", name, link.source))
            return 0.0, np.zeros(3), np.zeros((3, 3))
        mass_element, tensor = inertial.find("mass"), inertial.find("inertia")
        mass = self.required(mass_element, inertial, "mass", "value")
        if mass < 0:
            assert mass_element is not None
            self.problems.append(mass_element.problem(f"is {mass:g} kg", "value", "a mass, at least 0"))
        values = [self.required(tensor, inertial, "inertia", name) for name in _INERTIA]
        ixx, ixy, ixz, iyy, iyz, izz = values
        center, attitude = self.pose(inertial)
        A = rotation_matrix(attitude)
        own = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        self.check_inertia(own, tensor or inertial, link.attributes["name"])
        fields |= {
            "mass": (mass_element or inertial).source,
            "center": (inertial.find("origin") or inertial).source,
            "inertia": (tensor or inertial).source,
        }
        return mass, center, A @ own @ A.T

    def check_inertia(self, inertia: Array, element: Element, name: str) -> None:
        """Note an inertia that no distribution of mass has; importers differ in what they do with it."""
        low, middle, high = np.linalg.eigvalsh(inertia)
        if low < -_TRIANGLE_ROUNDING * abs(high):
            self.ambiguous.append(Feature("inertia that is not positive", name, element.source))
        elif high > (low + middle) * (1 + _TRIANGLE_ROUNDING):
            self.ambiguous.append(Feature("inertia that violates A + B ≥ C", name, element.source))

    def elementary(self, joint: _Joint) -> tuple[ElementaryJoint, ...]:
        """Translate a joint to elementary ones."""
        element, kind = joint.element, joint.kind
        name, source = element.attributes["name"], element.source
        if kind == "fixed" or kind not in _TYPES:
            return ()
        dynamics = element.find("dynamics")
        damping, friction = (self.numbers(dynamics, n, (0.0,))[0] for n in ("damping", "friction"))
        where = (dynamics or element).source
        passive: dict[str, Any] = {
            "damping": damping,
            "friction_loss": friction,
            "fields": {
                "damping": where,
                "friction_loss": where,
                "axis": (element.find("axis") or element).source,
            },
        }
        if kind == "floating":
            if joint.parent in self.fixed_to_root:
                return (_joint(name, "free", np.zeros(3), source, **passive),)
            *names, rotation = self.names_of_parts(name, ("x", "y", "z", "rotation"))
            slides = [
                _joint(own, "slide", e, source, **passive) for own, e in zip(names, np.eye(3), strict=True)
            ]
            return (*slides, _joint(rotation, "ball", np.zeros(3), source, **passive))
        axis = self.axis(element)
        if kind == "planar":
            first, second = _perpendicular_axes(axis)
            self.ambiguous.append(Feature("planar joint: directions of its two slides", name, source))
            x, y, angle = self.names_of_parts(name, ("x", "y", "angle"))
            return (
                _joint(x, "slide", first, source, **passive),
                _joint(y, "slide", second, source, **passive),
                _joint(angle, "hinge", axis, source, **passive),
            )
        return (_joint(name, "slide" if kind == "prismatic" else "hinge", axis, source, **passive),)

    def names_of_parts(self, joint: str, parts: Sequence[str]) -> list[str]:
        """Make up names of a joint's parts that no joint of the file has."""
        stem, count = joint, 1
        while (count > 1 and stem in self.joints) or any(f"{stem}/{p}" in self.joints for p in parts):
            count += 1
            stem = f"{joint}.{count}"
        return [f"{stem}/{part}" for part in parts]

    def axis(self, joint: Element) -> Array:
        """Read a joint's axis as a unit vector; (1, 0, 0) where the file has none."""
        element = joint.find("axis")
        if element is None:
            return np.array([1.0, 0.0, 0.0])
        if "xyz" not in element.attributes:
            self.problems.append(element.problem("has no xyz", valid="a direction, or no <axis>"))
            return np.zeros(3)
        return self.unit(element, "xyz", 3, "a direction")

    def unit(self, element: Element, attribute: str, count: int, valid: str) -> Array:
        """Read the numbers of an attribute and normalise them."""
        values = np.array(parse_numbers(element, attribute, count, self.problems, math.inf))
        largest = float(np.max(np.abs(values)))
        if largest == 0:
            if not self.problems or self.problems[-1].line != element.source.line:
                self.problems.append(element.problem("is zero", attribute, valid))
            return values
        values = values / largest  # so that its square neither overflows nor vanishes
        unit: Array = values / math.sqrt(float(values @ values))
        return unit

    def note_features(self) -> None:
        """List what is in the file and not compared."""
        for element in self.root.children:
            name = element.attributes.get("name", element.attributes.get("reference", ""))
            if element.tag not in {"link", "joint"} | _NOT_DYNAMIC:
                self.features.append(Feature(element.tag, name, element.source))
        for name, link in self.links.items():
            self.note_unread(link, name)
        for name, joint in self.joints.items():
            self.note_unread(joint, name)
            dynamics = joint.find("dynamics")
            if dynamics is not None and dynamics.attributes.get("friction", "0").strip("0.") != "":
                self.features.append(Feature("friction", name, dynamics.source))

    def note_unread(self, element: Element, owner: str) -> None:
        """List attributes and elements of a link or joint that are not read, misspelt ones too."""
        attributes, parts = _READ[element.tag]
        if element.tag == "origin" and self.has_quaternions:
            attributes = attributes | {_QUATERNION}
        for name in sorted(element.attributes.keys() - attributes):
            what = f"attribute {shorten(name)} of <{element.tag}>"
            self.features.append(Feature(what, owner, element.source))
        for child in element.children:
            if child.tag not in parts:
                is_still = child.tag == "limit" and element.attributes.get("type") == "fixed"
                if child.tag not in _GEOMETRY and not is_still:
                    self.features.append(Feature(child.tag, owner, child.source))
            elif child is element.find(child.tag):
                self.note_unread(child, owner)
            else:
                what = f"more than one <{child.tag}> in <{element.tag}>: the first is read"
                self.ambiguous.append(Feature(what, owner, child.source))


def _joint(name: str, kind: JointKind, axis: Array, source: Source, **more: Any) -> ElementaryJoint:
    return ElementaryJoint(name, kind, axis, np.zeros(3), source=source, **more)


def _perpendicular_axes(axis: Float[Array, "3"]) -> tuple[Array, Array]:
    """Return two unit vectors that form a right-handed frame with an axis; x and y where it is z.

    Args:
        axis: a unit vector.

    Returns:
        The two vectors (3,).

    """
    start = np.eye(3)[0] if abs(axis[0]) < 0.9 else np.eye(3)[1]
    first = start - axis * float(axis @ start)
    first = first / math.sqrt(float(first @ first))
    return first, np.cross(axis, first)


def quaternion_from_rpy(rpy: Sequence[float]) -> Float[Array, "4"]:
    """Turn roll, pitch and yaw about fixed axes into a quaternion: Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        rpy: three angles [rad].

    Returns:
        A unit quaternion, scalar first.

    """
    q = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in enumerate(rpy):
        turn = np.zeros(4)
        turn[0], turn[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
        q = quaternion_product(turn, q)
    unit: Array = q / math.sqrt(float(q @ q))
    return unit
