"""Defects planted in an importer: MuJoCo reads another text than the one that is its file.

Each changes one parameter of the XML tree and says by which field and owner the report must name it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from plumbline.importers.xml_tree import Element

Rng = np.random.Generator


class Expected(NamedTuple):
    """How a planted defect must be named."""

    field: str
    owner: str  # joint or body; empty: the model


Place = tuple[Element, str]  # an element that may be changed, and its owner's name
Places = Callable[[Element], Iterable[Place]]
Plant = Callable[[Element, Rng], Expected | None]  # None: the robot has no such parameter
Vector = list[float]
MOVING = ("revolute", "continuous", "prismatic")


def _child(element: Element, tag: str) -> Element:
    found = element.find(tag)
    assert found is not None
    return found


def changed(
    places: Places, attributes: str, change: Callable[[Vector], Iterable[float]] | str, field: str
) -> Plant:
    """Change attributes of one of the places, each alike: numbers by a function, or to another text."""

    def edit(element: Element) -> None:
        for name in attributes.split():
            if isinstance(change, str):
                element.attributes[name] = change
            else:
                values = [float(word) for word in element.attributes[name].split()]
                element.attributes[name] = " ".join(map(repr, change(values)))

    return edited(places, edit, field)


def edited(places: Places, edit: Callable[[Element], None], field: str) -> Plant:
    """Edit one of the places."""

    def plant(root: Element, rng: Rng) -> Expected | None:
        found = list(places(root))
        if not found:
            return None
        element, owner = found[rng.integers(len(found))]
        edit(element)
        return Expected(field, owner)

    return plant


def factor(by: float) -> Callable[[Vector], Vector]:
    """All numbers times a factor."""
    return lambda v: [x * by for x in v]


def added(axis: int, by: float) -> Callable[[Vector], Vector]:
    """Something added to one number."""
    return lambda v: [x + by * (i == axis) for i, x in enumerate(v)]


def in_single_precision(v: Vector) -> Vector:
    """All numbers rounded to single precision."""
    return [float(np.float32(x)) for x in v]


# --- URDF ---------------------------------------------------------------------------------------


def _joints(root: Element, *kinds: str) -> Iterator[Element]:
    return (j for j in root.find_all("joint") if j.attributes["type"] in (kinds or MOVING))


def _link_of(joint: Element) -> str:
    return _child(joint, "child").attributes["link"]


def _named_link(root: Element, name: str) -> Element:
    return next(link for link in root.find_all("link") if link.attributes["name"] == name)


def of_link(tag: str) -> Places:
    """Parts of the inertials of links that turn about a joint of their own: all of them have effects."""

    def places(root: Element) -> Iterator[Place]:
        for joint in _joints(root, "revolute", "continuous"):
            yield _child(_child(_named_link(root, _link_of(joint)), "inertial"), tag), _link_of(joint)

    return places


def of_joint(tag: str) -> Places:
    """Parts of moving joints, of those that have them."""
    return lambda root: ((x, j.attributes["name"]) for j in _joints(root) if (x := j.find(tag)))


def joint_origins(root: Element) -> Iterator[Place]:
    """Origins of moving joints; they place the link."""
    return ((_child(joint, "origin"), _link_of(joint)) for joint in _joints(root))


def joints(*kinds: str) -> Places:
    """Joints of some kinds, by their links."""
    return lambda root: ((joint, _link_of(joint)) for joint in _joints(root, *kinds))


def fixed_links(root: Element) -> Iterator[Place]:
    """Links that are fixed to a moving one."""
    parents = {_link_of(joint): joint for joint in root.find_all("joint")}
    for name, joint in parents.items():
        holder = joint
        while holder.attributes["type"] == "fixed":
            above = _child(holder, "parent").attributes["link"]
            if above not in parents:
                break
            holder = parents[above]
        if joint.attributes["type"] == "fixed" and holder.attributes["type"] != "fixed":
            yield _named_link(root, name), name


def parents_that_move(root: Element) -> Iterator[Place]:
    """Parents of moving joints that move themselves."""
    not_fixed = [joint for joint in root.find_all("joint") if joint.attributes["type"] != "fixed"]
    moving = {_link_of(joint) for joint in not_fixed}
    for joint in not_fixed:
        if _child(joint, "parent").attributes["link"] in moving:
            yield _child(joint, "parent"), _link_of(joint)


ENTRIES = "ixx ixy ixz iyy iyz izz"
URDF_DEFECTS: dict[str, Plant] = {
    "mass off by 1e-6": changed(of_link("mass"), "value", factor(1 + 1e-6), "mass"),
    "mass doubled": changed(of_link("mass"), "value", factor(2.0), "mass"),
    "centre of mass moved along x": changed(of_link("origin"), "xyz", added(0, 1e-5), "center"),
    "centre of mass moved along y": changed(of_link("origin"), "xyz", added(1, 0.01), "center"),
    "centre of mass moved along z": changed(of_link("origin"), "xyz", added(2, -0.003), "center"),
    "inertial origin ignored": changed(of_link("origin"), "xyz", "0 0 0", "center"),
    "attitude of the inertial ignored": changed(of_link("origin"), "rpy", "0 0 0", "inertia"),
    **{
        f"{entry} off by 1e-5": changed(of_link("inertia"), entry, factor(1 + 1e-5), "inertia")
        for entry in ("ixx", "iyy", "izz")
    },
    **{
        f"sign of {entry}": changed(of_link("inertia"), entry, factor(-1.0), "inertia")
        for entry in ("ixy", "ixz", "iyz")
    },
    "products of inertia dropped": changed(of_link("inertia"), "ixy ixz iyz", factor(0.0), "inertia"),
    "inertia in g m²": changed(of_link("inertia"), ENTRIES, factor(1e-3), "inertia"),
    "inertia in single precision": changed(of_link("inertia"), ENTRIES, in_single_precision, "inertia"),
    "joint origin moved": changed(joint_origins, "xyz", added(0, 1e-6), "position"),
    "joint origin ignored": changed(joint_origins, "xyz", factor(0.0), "position"),
    "joint origin in single precision": changed(joint_origins, "xyz", in_single_precision, "position"),
    "joint attitude ignored": changed(joint_origins, "rpy", factor(0.0), "attitude"),
    "roll and yaw exchanged": changed(joint_origins, "rpy", lambda v: v[::-1], "attitude"),
    "rpy in degrees": changed(joint_origins, "rpy", factor(np.pi / 180), "attitude"),
    "pitch negated": changed(joint_origins, "rpy", lambda v: [v[0], -v[1], v[2]], "attitude"),
    "axis flipped": changed(of_joint("axis"), "xyz", factor(-1.0), "axis"),
    "axis ignored": changed(of_joint("axis"), "xyz", "1 0 0", "axis"),
    "axis permuted": changed(of_joint("axis"), "xyz", lambda v: [v[1], v[2], v[0]], "axis"),
    "axis rounded to a coordinate axis": changed(
        of_joint("axis"), "xyz", lambda v: [float(abs(x) == max(map(abs, v))) for x in v], "axis"
    ),
    "damping dropped": changed(of_joint("dynamics"), "damping", factor(0.0), "damping"),
    "damping per degree": changed(of_joint("dynamics"), "damping", factor(180 / np.pi), "damping"),
    "revolute read as prismatic": changed(joints("revolute", "continuous"), "type", "prismatic", "joints"),
    "prismatic read as revolute": changed(joints("prismatic"), "type", "revolute", "joints"),
    "joint read as fixed": changed(joints(), "type", "fixed", "joints"),
    "fixed joint read as revolute": changed(joints("fixed"), "type", "revolute", "joints"),
    "mass of a fixed link lost": edited(fixed_links, lambda link: link.children.clear(), "inertial"),
    "joint on the wrong parent": changed(parents_that_move, "link", "base", "parent"),
}


# --- MJCF ---------------------------------------------------------------------------------------


def _bodies(root: Element) -> Iterator[Element]:
    return (e for e in root.walk() if e.tag == "body")


def joints_with(name: str, *nonzero: str) -> Places:
    """Joints with an attribute that matters, beside others that are not 0."""
    return lambda root: (
        (e, e.attributes["name"])
        for e in root.walk()
        if e.tag == "joint"
        and abs(float(e.attributes.get(name, "0"))) > 1e-3
        and all(float(e.attributes.get(other, "0")) for other in nonzero)
    )


def joints_that_have(name: str) -> Places:
    """Joints with an attribute."""
    return lambda root: (
        (e, e.attributes["name"]) for e in root.walk() if e.tag == "joint" and name in e.attributes
    )


def jointed_bodies(root: Element) -> Iterator[Place]:
    """Bodies on joints that do not leave them free."""
    for body in _bodies(root):
        if (first := body.find("joint")) is not None and first.attributes["type"] != "free":
            yield body, body.attributes["name"]


def inertials(root: Element) -> Iterator[Place]:
    """Inertials of bodies that move."""
    return ((_child(b, "inertial"), b.attributes["name"]) for b in _bodies(root) if b.find("joint"))


def bodies_on_several_joints(*without: str) -> Places:
    """Bodies on several joints, none of some kind."""
    return lambda root: (
        (body, body.attributes["name"])
        for body in _bodies(root)
        if len(kinds := [joint.attributes["type"] for joint in body.find_all("joint")]) > 1
        and not set(kinds) & set(without)
    )


def options(root: Element) -> Iterator[Place]:
    """The options of the model."""
    return iter([(_child(root, "option"), "")])


def reverse_joints(body: Element) -> None:
    """Exchange the joints of a body."""
    others = [child for child in body.children if child.tag != "joint"]
    body.children = others[:1] + body.find_all("joint")[::-1] + others[1:]


def lose_joint(body: Element) -> None:
    """Remove the last joint of a body."""
    body.children.remove(body.find_all("joint")[-1])


MJCF_DEFECTS: dict[str, Plant] = {
    "armature dropped": changed(joints_with("armature"), "armature", factor(0.0), "armature"),
    "armature squared": changed(joints_with("armature"), "armature", lambda v: [v[0] * v[0]], "armature"),
    "damping dropped in MJCF": changed(joints_with("damping"), "damping", factor(0.0), "damping"),
    "stiffness dropped": changed(joints_with("stiffness"), "stiffness", factor(0.0), "stiffness"),
    "stiffness halved": changed(joints_with("stiffness"), "stiffness", factor(0.5), "stiffness"),
    "spring reference ignored": changed(
        joints_with("springref", "stiffness"), "springref", factor(0.0), "spring_reference"
    ),
    "reference ignored": changed(joints_with("ref"), "ref", factor(0.0), "reference"),
    "reference in degrees": changed(joints_with("ref"), "ref", factor(np.pi / 180), "reference"),
    "anchor ignored": changed(joints_that_have("pos"), "pos", factor(0.0), "anchor"),
    "anchor negated": changed(joints_that_have("pos"), "pos", factor(-1.0), "anchor"),
    "axis of MJCF flipped": changed(joints_that_have("axis"), "axis", factor(-1.0), "axis"),
    "body position ignored": changed(jointed_bodies, "pos", factor(0.0), "position"),
    "quaternion conjugated": changed(
        jointed_bodies, "quat", lambda v: [v[0], *(-x for x in v[1:])], "attitude"
    ),
    "quaternion scalar last": changed(jointed_bodies, "quat", lambda v: [v[3], *v[:3]], "attitude"),
    "products of inertia exchanged": changed(
        inertials, "fullinertia", lambda v: [*v[:3], v[5], v[4], v[3]], "inertia"
    ),
    "products of inertia negated": changed(
        inertials, "fullinertia", lambda v: [*v[:3], *(-x for x in v[3:])], "inertia"
    ),
    "gravity 9.80665": changed(options, "gravity", "0.3 -0.2 -9.80665", "gravity"),
    "gravity of the file ignored": changed(options, "gravity", "0 0 -9.81", "gravity"),
    "gravity zero": changed(options, "gravity", "0 0 0", "gravity"),
    "joints in reverse order": edited(bodies_on_several_joints("ball"), reverse_joints, "joints"),
    "last joint of a body lost": edited(bodies_on_several_joints(), lose_joint, "joints"),
}
