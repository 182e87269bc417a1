"""Defects planted in an importer: MuJoCo reads another text than the one that is its file.

Each kind changes one parameter of the XML tree and says by which field and owner the report must name it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from plumbline.importers.xml_tree import Element


@dataclass(frozen=True)
class Expected:
    """How a planted defect must be named."""

    fields: frozenset[str]
    owner: str  # joint or body; empty: the model


Plant = Callable[[Element, np.random.Generator], Expected | None]  # None: the robot has no such parameter
URDF_DEFECTS: dict[str, Plant] = {}
MJCF_DEFECTS: dict[str, Plant] = {}


def _expected(owner: str, *fields: str) -> Expected:
    return Expected(frozenset(fields), owner)


def _values(element: Element, name: str) -> list[float]:
    return [float(word) for word in element.attributes[name].split()]


def _choose(elements: Iterable[Element], rng: np.random.Generator) -> Element | None:
    found = list(elements)
    return found[rng.integers(len(found))] if found else None


def _moving_joint(root: Element, rng: np.random.Generator, *kinds: str) -> Element | None:
    kinds = kinds or ("revolute", "continuous", "prismatic")
    return _choose((j for j in root.find_all("joint") if j.attributes["type"] in kinds), rng)


def _child(element: Element, tag: str) -> Element:
    found = element.find(tag)
    assert found is not None
    return found


def _moving_link(root: Element, rng: np.random.Generator) -> tuple[Element, str] | None:
    """A link that turns about a joint of its own, and its <inertial>: all of it has an effect."""
    joint = _moving_joint(root, rng, "revolute", "continuous")
    if joint is None:
        return None
    name = _child(joint, "child").attributes["link"]
    link = next(link for link in root.find_all("link") if link.attributes["name"] == name)
    return _child(link, "inertial"), name


def _plant_mass(factor: float) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected | None:
        found = _moving_link(root, rng)
        if found is None:
            return None
        mass = _child(found[0], "mass")
        mass.attributes["value"] = repr(_values(mass, "value")[0] * factor)
        return _expected(found[1], "mass")

    return plant


def _plant_inertia(name: str, change: Callable[[float], float]) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected | None:
        found = _moving_link(root, rng)
        if found is None:
            return None
        tensor = _child(found[0], "inertia")
        for entry in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz") if name == "all" else name.split():
            tensor.attributes[entry] = repr(change(_values(tensor, entry)[0]))
        return _expected(found[1], "inertia")

    return plant


def _plant_center(axis: int, change: float) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected | None:
        found = _moving_link(root, rng)
        if found is None:
            return None
        origin = _child(found[0], "origin")
        values = _values(origin, "xyz")
        values[axis] += change
        origin.attributes["xyz"] = " ".join(map(repr, values))
        return _expected(found[1], "center")

    return plant


def _plant_inertial_rpy(root: Element, rng: np.random.Generator) -> Expected | None:
    found = _moving_link(root, rng)
    if found is None:
        return None
    _child(found[0], "origin").attributes["rpy"] = "0 0 0"
    return _expected(found[1], "inertia")


def _plant_inertial_origin(root: Element, rng: np.random.Generator) -> Expected | None:
    found = _moving_link(root, rng)
    if found is None:
        return None
    _child(found[0], "origin").attributes["xyz"] = "0 0 0"
    return _expected(found[1], "center")


def _plant_origin(attribute: str, change: Callable[[list[float]], list[float]]) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected | None:
        joint = _moving_joint(root, rng)
        if joint is None:
            return None
        origin = _child(joint, "origin")
        origin.attributes[attribute] = " ".join(map(repr, change(_values(origin, attribute))))
        field = "position" if attribute == "xyz" else "attitude"
        return _expected(_child(joint, "child").attributes["link"], field)

    return plant


def _plant_axis(change: Callable[[list[float]], list[float]]) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected | None:
        joint = _moving_joint(root, rng)
        if joint is None:
            return None
        axis = _child(joint, "axis")
        axis.attributes["xyz"] = " ".join(map(repr, change(_values(axis, "xyz"))))
        return _expected(joint.attributes["name"], "axis")

    return plant


def _plant_type(kinds: tuple[str, ...], to: str) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected | None:
        joint = _moving_joint(root, rng, *kinds)
        if joint is None:
            return None
        joint.attributes["type"] = to
        return _expected(_child(joint, "child").attributes["link"], "joints")

    return plant


def _plant_damping(change: Callable[[float], float]) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected | None:
        joint = _choose((j for j in root.find_all("joint") if j.find("dynamics")), rng)
        if joint is None:
            return None
        dynamics = _child(joint, "dynamics")
        dynamics.attributes["damping"] = repr(change(_values(dynamics, "damping")[0]))
        return _expected(joint.attributes["name"], "damping")

    return plant


def _plant_fixed_mass(root: Element, rng: np.random.Generator) -> Expected | None:
    """The mass of a link that is fixed to a moving one is lost."""
    parents = {_child(j, "child").attributes["link"]: j for j in root.find_all("joint")}
    found = []
    for name, joint in parents.items():
        holder = joint
        while holder.attributes["type"] == "fixed":
            above = _child(holder, "parent").attributes["link"]
            if above not in parents:
                break
            holder = parents[above]
        if joint.attributes["type"] == "fixed" and holder.attributes["type"] != "fixed":
            found.append(name)
    if not found:
        return None
    name = found[rng.integers(len(found))]
    link = next(link for link in root.find_all("link") if link.attributes["name"] == name)
    link.children = []
    return _expected(name, "inertial")


def _plant_parent(root: Element, rng: np.random.Generator) -> Expected | None:
    """A joint is attached to the base, not to its parent; chosen where the parent moves."""
    moving = {
        _child(j, "child").attributes["link"]
        for j in root.find_all("joint")
        if j.attributes["type"] != "fixed"
    }
    joint = _choose(
        (
            j
            for j in root.find_all("joint")
            if _child(j, "parent").attributes["link"] in moving and j.attributes["type"] != "fixed"
        ),
        rng,
    )
    if joint is None:
        return None
    _child(joint, "parent").attributes["link"] = "base"
    return _expected(_child(joint, "child").attributes["link"], "parent")


URDF_DEFECTS |= {
    "mass off by 1e-6": _plant_mass(1 + 1e-6),
    "mass doubled": _plant_mass(2.0),
    "centre of mass moved along x": _plant_center(0, 1e-5),
    "centre of mass moved along y": _plant_center(1, 0.01),
    "centre of mass moved along z": _plant_center(2, -0.003),
    "inertial origin ignored": _plant_inertial_origin,
    "attitude of the inertial ignored": _plant_inertial_rpy,
    "ixx off by 1e-5": _plant_inertia("ixx", lambda x: x * (1 + 1e-5)),
    "iyy off by 1e-5": _plant_inertia("iyy", lambda x: x * (1 + 1e-5)),
    "izz off by 1e-5": _plant_inertia("izz", lambda x: x * (1 + 1e-5)),
    "sign of ixy": _plant_inertia("ixy", lambda x: -x),
    "sign of ixz": _plant_inertia("ixz", lambda x: -x),
    "sign of iyz": _plant_inertia("iyz", lambda x: -x),
    "products of inertia dropped": _plant_inertia("ixy ixz iyz", lambda x: 0.0),
    "inertia in g m²": _plant_inertia("all", lambda x: x * 1e-3),
    "inertia in single precision": _plant_inertia("all", lambda x: float(np.float32(x))),
    "joint origin moved": _plant_origin("xyz", lambda v: [v[0] + 1e-6, *v[1:]]),
    "joint origin ignored": _plant_origin("xyz", lambda v: [0.0, 0.0, 0.0]),
    "joint origin in single precision": _plant_origin("xyz", lambda v: [float(np.float32(x)) for x in v]),
    "joint attitude ignored": _plant_origin("rpy", lambda v: [0.0, 0.0, 0.0]),
    "roll and yaw exchanged": _plant_origin("rpy", lambda v: v[::-1]),
    "rpy in degrees": _plant_origin("rpy", lambda v: [x * np.pi / 180 for x in v]),
    "pitch negated": _plant_origin("rpy", lambda v: [v[0], -v[1], v[2]]),
    "axis flipped": _plant_axis(lambda v: [-x for x in v]),
    "axis ignored": _plant_axis(lambda v: [1.0, 0.0, 0.0]),
    "axis permuted": _plant_axis(lambda v: [v[1], v[2], v[0]]),
    "axis rounded to a coordinate axis": _plant_axis(
        lambda v: [float(abs(x) == max(map(abs, v))) for x in v]
    ),
    "damping dropped": _plant_damping(lambda x: 0.0),
    "damping per degree": _plant_damping(lambda x: x * 180 / np.pi),
    "revolute read as prismatic": _plant_type(("revolute", "continuous"), "prismatic"),
    "prismatic read as revolute": _plant_type(("prismatic",), "revolute"),
    "joint read as fixed": _plant_type(("revolute", "continuous", "prismatic"), "fixed"),
    "fixed joint read as revolute": _plant_type(("fixed",), "revolute"),
    "mass of a fixed link lost": _plant_fixed_mass,
    "joint on the wrong parent": _plant_parent,
}


def _bodies(root: Element) -> list[Element]:
    return [e for e in root.walk() if e.tag == "body"]


def _plant_joint_attribute(
    name: str, change: Callable[[float], float], field: str, condition: str = ""
) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected | None:
        joint = _choose(
            (
                e
                for e in root.walk()
                if e.tag == "joint"
                and abs(float(e.attributes.get(name, "0"))) > 1e-3
                and (not condition or float(e.attributes.get(condition, "0")))
            ),
            rng,
        )
        if joint is None:
            return None
        joint.attributes[name] = repr(change(_values(joint, name)[0]))
        return _expected(joint.attributes["name"], field)

    return plant


def _plant_joint_vector(name: str, change: Callable[[list[float]], list[float]], field: str) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected | None:
        joint = _choose((e for e in root.walk() if e.tag == "joint" and name in e.attributes), rng)
        if joint is None:
            return None
        joint.attributes[name] = " ".join(map(repr, change(_values(joint, name))))
        return _expected(joint.attributes["name"], field)

    return plant


def _plant_body_vector(name: str, change: Callable[[list[float]], list[float]], field: str) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected | None:
        fitting = [
            b
            for b in _bodies(root)
            if (first := b.find("joint")) is not None and first.attributes["type"] != "free"
        ]
        body = _choose(fitting, rng)
        if body is None:
            return None
        body.attributes[name] = " ".join(map(repr, change(_values(body, name))))
        return _expected(body.attributes["name"], field)

    return plant


def _plant_full_inertia(change: Callable[[list[float]], list[float]]) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected | None:
        body = _choose((b for b in _bodies(root) if b.find("joint")), rng)
        if body is None:
            return None
        inertial = _child(body, "inertial")
        inertial.attributes["fullinertia"] = " ".join(map(repr, change(_values(inertial, "fullinertia"))))
        return _expected(body.attributes["name"], "inertia")

    return plant


def _plant_gravity(value: str) -> Plant:
    def plant(root: Element, rng: np.random.Generator) -> Expected:
        _child(root, "option").attributes["gravity"] = value
        return _expected("", "gravity")

    return plant


def _plant_joint_order(root: Element, rng: np.random.Generator) -> Expected | None:
    body = _choose((b for b in _bodies(root) if len(b.find_all("joint")) > 1 and not _has_ball(b)), rng)
    if body is None:
        return None
    joints = body.find_all("joint")
    body.children = (
        [c for c in body.children if c.tag != "joint"][:1]
        + joints[::-1]
        + [c for c in body.children if c.tag != "joint"][1:]
    )
    return _expected(body.attributes["name"], "joints")


def _plant_lost_joint(root: Element, rng: np.random.Generator) -> Expected | None:
    body = _choose((b for b in _bodies(root) if len(b.find_all("joint")) > 1), rng)
    if body is None:
        return None
    body.children.remove(body.find_all("joint")[-1])
    return _expected(body.attributes["name"], "joints")


def _has_ball(body: Element) -> bool:
    return any(j.attributes["type"] == "ball" for j in body.find_all("joint"))


MJCF_DEFECTS |= {
    "armature dropped": _plant_joint_attribute("armature", lambda x: 0.0, "armature"),
    "armature squared": _plant_joint_attribute("armature", lambda x: x * x, "armature"),
    "damping dropped in MJCF": _plant_joint_attribute("damping", lambda x: 0.0, "damping"),
    "stiffness dropped": _plant_joint_attribute("stiffness", lambda x: 0.0, "stiffness"),
    "stiffness halved": _plant_joint_attribute("stiffness", lambda x: x / 2, "stiffness"),
    "spring reference ignored": _plant_joint_attribute(
        "springref", lambda x: 0.0, "spring_reference", "stiffness"
    ),
    "reference ignored": _plant_joint_attribute("ref", lambda x: 0.0, "reference"),
    "reference in degrees": _plant_joint_attribute("ref", lambda x: x * np.pi / 180, "reference"),
    "anchor ignored": _plant_joint_vector("pos", lambda v: [0.0, 0.0, 0.0], "anchor"),
    "anchor negated": _plant_joint_vector("pos", lambda v: [-x for x in v], "anchor"),
    "axis of MJCF flipped": _plant_joint_vector("axis", lambda v: [-x for x in v], "axis"),
    "body position ignored": _plant_body_vector("pos", lambda v: [0.0, 0.0, 0.0], "position"),
    "quaternion conjugated": _plant_body_vector("quat", lambda v: [v[0], *(-x for x in v[1:])], "attitude"),
    "quaternion scalar last": _plant_body_vector("quat", lambda v: [v[3], *v[:3]], "attitude"),
    "products of inertia exchanged": _plant_full_inertia(lambda v: [*v[:3], v[5], v[4], v[3]]),
    "products of inertia negated": _plant_full_inertia(lambda v: [*v[:3], *(-x for x in v[3:])]),
    "gravity 9.80665": _plant_gravity("0.3 -0.2 -9.80665"),
    "gravity of the file ignored": _plant_gravity("0 0 -9.81"),
    "gravity zero": _plant_gravity("0 0 0"),
    "joints in reverse order": _plant_joint_order,
    "last joint of a body lost": _plant_lost_joint,
}
