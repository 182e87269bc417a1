"""Equivalent rewritings of an MJCF file: the same model written otherwise.

MuJoCo defines the format, so its compiler can only be judged against itself: each rewriting has to compile
to the same bodies, joints and numbers.  What is not compared (actuators, tendons, sensors, sites, …) is left
out of a rewriting.  The meaning of the attributes is that of MuJoCo's XML reference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import replace

import numpy as np

from plumbline.importers.lumping import merge_bodies
from plumbline.importers.mjcf import (
    DefaultClasses,
    body_elements,
    joint_elements,
    strip_geometry,
    world_elements,
)
from plumbline.importers.neutral_model import NeutralBody
from plumbline.importers.xml_tree import Element
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import (
    quaternion_exponential,
    quaternion_of,
    quaternion_product,
    rotation_matrix,
)

RENAMED = "renamed_"  # before every name of the rewriting with other names
DENSITY = 1000.0  # kg/m³, of geoms without mass or density
MIN_MOMENT = 1e-12  # kg m²: MuJoCo takes smaller principal moments as `diaginertia` only
ORIENTATIONS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")
_KEPT_SECTIONS = ("compiler", "option", "size", "default", "asset", "worldbody")
_POSED = ("body", "geom", "frame")
_UNKNOWN = ("replicate", "attach", "composite", "flexcomp", "extension", "deformable", "plugin", "model")
_EXPANDED = ("joint", "geom")


class _NoRewriting(Exception):
    """The file has something that the rewriting does not cover."""


def rewritings(root: Element) -> dict[str, Element]:
    """Write a model in several equivalent ways.

    Args:
        root: of an MJCF file, includes expanded and all bodies and joints named.

    Returns:
        Rewritten trees by what was done, without those that change nothing or do not cover the file's
        features. In "other names and order" each name has `RENAMED` before it.

    """
    is_fused = any(c.attributes.get("fusestatic") == "true" for c in root.find_all("compiler"))
    if is_fused or any(element.tag in _UNKNOWN for element in root.walk()):
        return {}
    plain = _moving_parts(root)
    found = {}
    for name, rewrite in _REWRITINGS.items():
        tree = deepcopy(plain)
        try:
            changed = rewrite(tree)
        except (_NoRewriting, ValueError, IndexError, KeyError):  # MuJoCo reports what is wrong in the file
            continue
        if changed:
            found[name] = tree
    return found


def _moving_parts(root: Element) -> Element:
    """The file without what is not compared, and without geometry that defines no inertia."""
    copy = deepcopy(root)
    strip_geometry(copy)
    copy.children = [child for child in copy.children if child.tag in _KEPT_SECTIONS]
    for element in world_elements(copy):
        element.children = [c for c in element.children if c.tag not in ("site", "camera", "light")]
    return copy


def _expand_defaults(root: Element) -> bool:
    """Write what joints and geoms inherit from default classes at each of them."""
    defaults, changed = DefaultClasses(root), False
    for element in [e for e in world_elements(root) if e.tag in _EXPANDED]:
        inherited: dict[str, str] = {}
        for holder in reversed(defaults.chain(element)):
            for default in holder.find_all(element.tag):
                _override(inherited, default.attributes)
        changed |= bool(inherited)
        _override(inherited, element.attributes)
        element.attributes = inherited
    for top in root.find_all("default"):
        for holder in [e for e in top.walk() if e.tag == "default"]:
            holder.children = [c for c in holder.children if c.tag not in _EXPANDED]
    return changed


def _override(inherited: dict[str, str], own: dict[str, str]) -> None:
    if any(name in own for name in ORIENTATIONS):
        for name in ORIENTATIONS:
            inherited.pop(name, None)
    inherited |= {name: value for name, value in own.items() if name != "class"}


def _introduce_frames(root: Element) -> bool:
    """Give the pose of each body to a frame around it."""
    changed = False
    for holder in list(world_elements(root)):
        for place, child in enumerate(holder.children):
            if child.tag != "body" or holder.tag == "frame":
                continue
            moved = {n: child.attributes.pop(n) for n in ("pos", *ORIENTATIONS) if n in child.attributes}
            holder.children[place] = Element("frame", moved, child.source, [child])
            changed |= bool(moved)
    return changed


def _flatten_frames(root: Element) -> bool:
    """Apply each frame's pose to what is in it."""
    _expand_defaults(root)  # a geom's own pose may be of a default class
    compiler, changed = _Compiler(root), False
    for holder in world_elements(root):  # a frame in a frame is met again in its holder's list
        while (frame := holder.find("frame")) is not None:
            changed = True
            place = holder.children.index(frame)
            for child in frame.children:
                if child.tag not in _POSED:
                    raise _NoRewriting(child.tag)
                compiler.move(child, *compiler.pose(frame))
            holder.children[place : place + 1] = frame.children
    return changed


def _change_angles(root: Element) -> bool:
    """Write angles in radians where they are in degrees, and the other way round."""
    _expand_defaults(root)
    compiler, changed = _Compiler(root), False
    factor = math.pi / 180 if compiler.is_degree else 180 / math.pi
    for element in world_elements(root):
        kind = element.attributes.get("type", "hinge") if element.tag == "joint" else ""
        angles = {"hinge": ("ref", "springref", "springyield", "range"), "ball": ("range",)}.get(kind, ())
        for name in ("euler", "axisangle", *angles):
            if name in element.attributes:
                values = _numbers(element, name)
                first = 3 if name == "axisangle" else 0
                values[first:] *= factor
                element.attributes[name] = _text(values)
                changed = True
    for holder in root.find_all("compiler"):
        holder.attributes.pop("angle", None)
    unit = {"angle": "radian" if compiler.is_degree else "degree"}
    root.children.insert(0, Element("compiler", unit, root.source))
    return changed


def _change_inertials(root: Element) -> bool:
    """Write diagonal inertias as full ones, and full ones by principal axes."""
    _expand_defaults(root)  # a joint may be free by its class
    compiler, changed = _Compiler(root), False
    for body in body_elements(root):
        for inertial in body.find_all("inertial") if not compiler.aligns(body) else ():
            if "fullinertia" in inertial.attributes:
                xx, yy, zz, xy, xz, yz = _numbers(inertial, "fullinertia")
                moments, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
                axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
                del inertial.attributes["fullinertia"]
                inertial.attributes |= {"diaginertia": _text(moments), "xyaxes": _text(axes.T[:2])}
                changed = True
            elif "diaginertia" in inertial.attributes:
                if np.min(_numbers(inertial, "diaginertia")) < MIN_MOMENT:
                    continue
                R = rotation_matrix(compiler.pose(inertial)[1])
                _set_inertia(inertial, R @ np.diag(_numbers(inertial, "diaginertia")) @ R.T)
                changed = True
    return changed


def _set_inertia(inertial: Element, J: Array) -> None:
    for name in ("diaginertia", *ORIENTATIONS):
        inertial.attributes.pop(name, None)
    entries = [J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]]
    inertial.attributes["fullinertia"] = _text(entries)


def _replace_geoms(root: Element) -> bool:
    """Write the inertia of bodies that have it of their geoms, by the formulas of solid bodies."""
    _flatten_frames(root)
    compiler, changed = _Compiler(root), False
    if compiler.settings.get("inertiafromgeom", "auto") != "auto" or "inertiagrouprange" in compiler.settings:
        raise _NoRewriting("inertiafromgeom")
    for body in body_elements(root):
        geoms = body.find_all("geom")
        if body.find("inertial") is not None or not geoms or compiler.aligns(body):
            continue
        parts = [_solid(geom, compiler) for geom in geoms]
        if any(part is None for part in parts):
            continue
        total, *others = (part for part in parts if part is not None)
        for other in others:
            total = merge_bodies(total, other, np.zeros(3), np.eye(3))
        if total.mass <= 0:
            continue
        inertial = Element("inertial", {"pos": _text(total.center), "mass": _text([total.mass])}, body.source)
        _set_inertia(inertial, total.inertia)
        body.children = [inertial, *(child for child in body.children if child.tag != "geom")]
        changed = True
    return changed


def _solid(geom: Element, compiler: _Compiler) -> NeutralBody | None:
    """Mass, centre and inertia in the body's axes of a solid geom; None for another kind of geom."""
    a = geom.attributes
    kind = a.get("type", "sphere")
    if "mesh" in a or a.get("shellinertia") == "true" or kind not in _VOLUMES:
        return None
    size = _numbers(geom, "size")
    center, turn = compiler.pose(geom)
    if "fromto" in a:
        if kind not in ("capsule", "cylinder"):
            return None
        ends = _numbers(geom, "fromto").reshape(2, 3)
        along = ends[1] - ends[0]
        size, center = np.array([size[0], np.linalg.norm(along) / 2]), ends.mean(axis=0)
        turn = _turn_z_to(-along)
    volume, moments = _VOLUMES[kind](*size[: {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)])
    mass = float(a["mass"]) if "mass" in a else float(a.get("density", DENSITY)) * volume
    R = rotation_matrix(turn)
    J = mass * R @ np.diag(moments) @ R.T
    return NeutralBody("", -1, np.zeros(3), np.array([1.0, 0, 0, 0]), (), mass, center, J)


def _capsule(r: float, h: float) -> tuple[float, Array]:
    """A cylinder of half length h between two half balls of radius r; the ball's centroid is 3r/8 inside."""
    tube, ball = 2 * math.pi * r * r * h, 4 / 3 * math.pi * r**3
    total = tube + ball
    across = tube * (r * r / 4 + h * h / 3) + ball * (2 / 5 * r * r + h * h + 3 / 4 * h * r)
    along = tube * r * r / 2 + ball * 2 / 5 * r * r
    return total, np.array([across, across, along]) / total


_VOLUMES: dict[str, Callable[..., tuple[float, Array]]] = {  # volume, and moments over the mass
    "sphere": lambda r: (4 / 3 * math.pi * r**3, np.full(3, 2 / 5 * r * r)),
    "capsule": _capsule,
    "cylinder": lambda r, h: (
        2 * math.pi * r * r * h,
        np.array([r * r / 4 + h * h / 3, r * r / 4 + h * h / 3, r * r / 2]),
    ),
    "box": lambda x, y, z: (8 * x * y * z, np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 3),
    "ellipsoid": lambda x, y, z: (
        4 / 3 * math.pi * x * y * z,
        np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 5,
    ),
}


def _rename_and_reorder(root: Element) -> bool:
    """Other names of bodies and joints, and the children of each body in the opposite order."""
    for body in list(body_elements(root)):
        for element in (body, *joint_elements(body)):
            element.attributes["name"] = RENAMED + element.attributes["name"]
    for holder in world_elements(root):
        bodies = [
            c for c in holder.children if c.tag == "body" or (c.tag == "frame" and not joint_elements(c))
        ]
        places = {id(child) for child in bodies}  # joints stay in their order, those in frames too
        holder.children = [bodies.pop() if id(child) in places else child for child in holder.children]
    return True


_REWRITINGS: dict[str, Callable[[Element], bool]] = {
    "defaults expanded": _expand_defaults,
    "frames around bodies": _introduce_frames,
    "frames flattened": _flatten_frames,
    "angles in the other unit": _change_angles,
    "inertias re-expressed": _change_inertials,
    "geoms replaced by their inertials": _replace_geoms,
    "other names and order": _rename_and_reorder,
}


class _Compiler:
    """The settings of <compiler> that poses depend on."""

    def __init__(self, root: Element) -> None:
        self.settings: dict[str, str] = {}
        for element in root.find_all("compiler"):
            self.settings |= element.attributes
        self.is_degree = self.settings.get("angle", "degree") == "degree"

    def aligns(self, body: Element) -> bool:
        """Whether a body's frame becomes that of its inertia, which depends on how it is written."""
        choices = {
            joint.attributes.get("align", "auto")
            for joint in joint_elements(body)
            if joint.tag == "freejoint" or joint.attributes.get("type") == "free"
        }
        return "true" in choices or ("auto" in choices and self.settings.get("alignfree") == "true")

    def angle(self, value: float) -> float:
        """An angle in rad."""
        return math.radians(value) if self.is_degree else value

    def pose(self, element: Element) -> tuple[Array, Array]:
        """Position and quaternion that an element's attributes give."""
        position = _numbers(element, "pos") if "pos" in element.attributes else np.zeros(3)
        return position, self._turn(element)

    def _turn(self, element: Element) -> Array:
        name = next((name for name in ORIENTATIONS if name in element.attributes), "")
        if not name:
            return np.array([1.0, 0.0, 0.0, 0.0])
        values = _numbers(element, name)
        if name == "quat":
            return np.asarray(values / np.linalg.norm(values))
        if name == "axisangle":
            return _about(values[:3], self.angle(values[3]))
        if name == "zaxis":
            return _turn_z_to(values)
        if name == "xyaxes":
            return _turn_of_axes(values[:3], values[3:])
        turn = np.array([1.0, 0.0, 0.0, 0.0])
        for letter, value in zip(self.settings.get("eulerseq", "xyz"), values, strict=True):
            step = _about(np.eye(3)["xyz".index(letter.lower())], self.angle(value))
            turn = quaternion_product(*((turn, step) if letter.islower() else (step, turn)))
        return turn

    def move(self, element: Element, position: Array, turn: Array) -> None:
        """Apply a pose before an element's own."""
        A = rotation_matrix(turn)
        if "fromto" in element.attributes:
            ends = _numbers(element, "fromto").reshape(2, 3)
            element.attributes["fromto"] = _text(position + ends @ A.T)
            return
        inner, own = self.pose(element)
        for name in ORIENTATIONS:
            element.attributes.pop(name, None)
        element.attributes["pos"] = _text(position + A @ inner)
        element.attributes["quat"] = _text(quaternion_product(turn, own))


def _about(axis: Array, angle: float) -> Array:
    return quaternion_exponential(angle / 2 * axis / np.linalg.norm(axis))


def _turn_z_to(direction: Array) -> Array:
    """The smallest rotation that turns z to a direction."""
    z = direction / np.linalg.norm(direction)
    axis = np.array([-z[1], z[0], 0.0])
    length = float(np.linalg.norm(axis))
    return _about(axis if length else np.eye(3)[0], math.atan2(length, z[2]))


def _turn_of_axes(x: Array, y: Array) -> Array:
    """The rotation whose first two columns are x and y, made orthogonal."""
    x, z = x / np.linalg.norm(x), np.cross(x, y)
    z = z / np.linalg.norm(z)
    return quaternion_of(np.column_stack([x, np.cross(z, x), z]))


def _numbers(element: Element, name: str) -> Array:
    return np.array(element.attributes[name].split(), float)


def _text(values: Array | list[float]) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def names_as_written(bodies: tuple[NeutralBody, ...]) -> Iterator[NeutralBody]:
    """Take `RENAMED` from names of bodies and joints.

    Yields:
        The bodies with the names of the file.

    """
    for body in bodies:
        joints = tuple(replace(joint, name=joint.name.removeprefix(RENAMED)) for joint in body.joints)
        yield replace(body, name=body.name.removeprefix(RENAMED), joints=joints)
