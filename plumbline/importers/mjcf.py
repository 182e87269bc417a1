"""MJCF files: includes expanded, unnamed bodies and joints named, and where the file says each number.

MuJoCo defines the format: its compiled model is the neutral reading (`plumbline.model_files.prepared_file`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain
from os.path import isfile
from pathlib import Path

from plumbline.importers.neutral_model import ElementaryJoint, Feature, NeutralBody, NeutralModel, Source
from plumbline.importers.xml_tree import Element, ModelFileError, parse_numbers, read_xml
from plumbline.scenario.line_and_column_errors import shorten

MAX_INCLUDES = 200
_JOINT_FIELDS = {
    "axis": "axis", "anchor": "pos", "reference": "ref", "armature": "armature", "damping": "damping",
    "stiffness": "stiffness", "spring_reference": "springref", "friction_loss": "frictionloss",
}  # fmt: skip
_JOINT_FEATURES = {  # attribute: what is not compared of it, and with how many numbers
    "range": ("limit", 1), "frictionloss": ("friction", 1), "springyield": ("yield of a spring", 1),
    "damping": ("damping that is not linear", 2), "stiffness": ("stiffness that is not linear", 2),
}  # fmt: skip
_ASSET_FOLDERS = {"texture": "texturedir"} | dict.fromkeys(("mesh", "hfield", "skin", "flexcomp"), "meshdir")
_FILES = {"file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback"}
_FLUID = ("density", "viscosity")  # without either there is no force of it
_SECTIONS = ("actuator", "tendon", "equality", "contact", "sensor", "keyframe", "deformable", "extension")
_STRIPPED = ("contact", "sensor", "keyframe", "visual", "custom")  # what refers to geometry
_GEOMETRY = ("geom", "light", "camera")
_FRAMES = ("frame", "replicate")  # whose content belongs to the body around them


def expand_includes(root: Element, root_folder: Path, shown: str) -> None:
    """Put the content of included files in place of each <include>.

    Args:
        root: the file's root element, which is changed.
        root_folder: folder outside of which nothing is read.

    Raises:
        ModelFileError: an included file is missing, outside the folder, or included in a circle.

    """
    included: set[Path] = {Path(shown).resolve()}
    stack = [root]
    while stack:
        element = stack.pop()
        place = 0
        while place < len(element.children):
            child = element.children[place]
            if child.tag != "include":
                place += 1
                continue
            name, target = _include_target(child, shown, root_folder)
            if target in included:
                message = f"includes {child.attributes['file']!r} twice or in a circle"
                raise ModelFileError([child.problem(message, "file", "a file that is included once")])
            included.add(target)
            if len(included) > MAX_INCLUDES:
                raise ModelFileError([child.problem(f"there are more than {MAX_INCLUDES} includes")])
            element.children[place : place + 1] = read_xml(target, name).children
        stack.extend(element.children)
    if len(included) > 1:  # one world, as before: Pinocchio reads the bodies of two worlds twice
        first, *others = root.find_all("worldbody") or [root]
        first.children += [child for world in others for child in world.children]
        root.children = [c for c in root.children if c is first or c.tag != "worldbody"]


def _include_target(element: Element, shown: str, root_folder: Path) -> tuple[str, Path]:
    """The included file as it is named in messages, and its path."""
    name = element.attributes.get("file", "")
    places = [str(Path(file).parent / name) for file in (shown, element.source.file)]  # in MuJoCo's order
    place = next(filter(isfile, places), places[0])
    target = resolve_inside(Path(place), root_folder)
    if target is None:
        message = f"{shorten(repr(name))} is outside {root_folder}"
        hint = "name a folder that holds both with --root"
        raise ModelFileError([element.problem(message, "file", hint=hint)])
    if not isfile(target):
        raise ModelFileError([element.problem(f"there is no file {shorten(repr(name))}", "file")])
    return place, target


def resolve_inside(path: Path, folder: Path) -> Path | None:
    """Resolve a path with its links.

    Args:
        path: any path.
        folder: a resolved folder.

    Returns:
        The resolved path; None where it is outside the folder or cannot be resolved.

    """
    try:
        target = path.resolve()
    except (OSError, ValueError, RuntimeError):
        return None
    return target if target.is_relative_to(folder) else None


def world_elements(root: Element) -> Iterator[Element]:
    """Go through all elements <worldbody> and what is in them, in the order of the file."""
    return chain.from_iterable(world.walk() for world in root.find_all("worldbody"))


def body_elements(root: Element) -> Iterator[Element]:
    """Go through the bodies of a file, a parent before its children."""
    return (element for element in world_elements(root) if element.tag == "body")


def joint_elements(body: Element) -> list[Element]:
    """List the joints of a body, in frames too.

    Args:
        body: an element <body>.

    Returns:
        Its elements <joint> and <freejoint>, in the order of the file.

    """
    found: list[Element] = []
    stack = list(reversed(body.children))
    while stack:
        element = stack.pop()
        if element.tag in ("joint", "freejoint"):
            found.append(element)
        elif element.tag in _FRAMES:
            stack.extend(reversed(element.children))
    return found


def name_elements(root: Element) -> bool:
    """Give a name to every body and joint that has none: "body@LINE", "joint@LINE", "BODY/free".

    Args:
        root: the file's root element, which is changed.

    """
    used = {element.attributes.get("name", "") for element in root.walk()}
    changed = False
    for body in body_elements(root):
        for element in (body, *joint_elements(body)):
            if element.attributes.get("name"):
                continue
            is_free = element.tag == "freejoint" or element.attributes.get("type") == "free"
            wanted = f"{element.tag}@{element.source.line}"
            name = wanted = f"{body.attributes['name']}/free" if is_free else wanted
            count = 1
            while name in used:
                count += 1
                name = f"{wanted}.{count}"
            used.add(name)
            element.attributes["name"] = name
            changed = True
    return changed


def make_paths_absolute(root: Element, folder: Path) -> None:
    """Write file names of assets as absolute paths, so that a copy elsewhere finds them.

    Args:
        root: the file's root element, which is changed.

    """
    for element, attribute, path in asset_files(root, folder):
        element.attributes[attribute] = str(path)
    for compiler in root.find_all("compiler"):
        for name in ("meshdir", "texturedir", "assetdir", "strippath"):
            compiler.attributes.pop(name, None)


def asset_files(root: Element, folder: Path) -> Iterator[tuple[Element, str, Path]]:
    """Go through the files that a MJCF refers to, besides includes, as MuJoCo finds them.

    Args:
        folder: of the file that includes the others.

    Yields:
        Element, attribute, path.

    """
    settings: dict[str, str] = {}
    for compiler in root.find_all("compiler"):
        if (both := compiler.attributes.get("assetdir")) is not None:
            settings |= {"meshdir": both, "texturedir": both}
        settings |= compiler.attributes
    for element in root.walk():
        below = settings.get(_ASSET_FOLDERS.get(element.tag, ""), "")
        for attribute in sorted(_FILES & element.attributes.keys()):
            name = element.attributes[attribute]
            beside = Path(element.source.file).parent.resolve() / name  # the file that names it
            path = beside if element.tag == "model" else folder / below / name
            if element.tag in _ASSET_FOLDERS and settings.get("strippath") == "true":
                path = folder / below / name.replace("\\", "/").rpartition("/")[2]
            elif element.source.file != root.source.file and not isfile(path) and isfile(beside):
                path = beside
            if element.tag != "include":
                yield element, attribute, path


def strip_geometry(root: Element) -> None:
    """Remove geometry from bodies whose inertia is explicit, and what refers to geometry.

    Args:
        root: the file's root element, which is changed.

    """
    from_geoms = any(c.attributes.get("inertiafromgeom") == "true" for c in root.find_all("compiler"))
    wrapped = {e.attributes.get("geom") for t in root.find_all("tendon") for e in t.walk()} - {None}
    stack = [(world, True) for world in root.find_all("worldbody")]
    while stack:
        holder, is_explicit = stack.pop()
        if is_explicit and not from_geoms:
            holder.children = [
                c for c in holder.children if c.tag not in _GEOMETRY or c.attributes.get("name") in wrapped
            ]
        for child in holder.children:
            has_inertial = is_explicit if child.tag in _FRAMES else child.find("inertial") is not None
            stack.append((child, has_inertial))
    root.children = [child for child in root.children if child.tag not in _STRIPPED]
    shapes = ("mesh", "hfield")
    used = {(tag, e.attributes.get(tag)) for e in root.walk() if e.tag == "geom" for tag in shapes}
    for asset in root.find_all("asset"):
        asset.children = [
            c for c in asset.children if c.tag not in _ASSET_FOLDERS or (c.tag, _asset_name(c)) in used
        ]
    for deformable in root.find_all("deformable"):
        deformable.children = [child for child in deformable.children if child.tag != "skin"]
    for element in root.walk():
        if element.tag in ("material", "light"):  # materials of default classes too
            element.attributes.pop("texture", None)
            element.children = []


def _asset_name(element: Element) -> str:
    return element.attributes.get("name") or Path(element.attributes.get("file", "")).stem


def with_sources(model: NeutralModel, root: Element) -> NeutralModel:
    """Add to a compiled model where the file says each of its numbers.

    Args:
        root: the file's root element, with all names.

    """
    bodies = {e.attributes["name"]: e for e in body_elements(root)}
    defaults = DefaultClasses(root)
    nowhere = Source(root.source.file, 0)
    found = [_body_with_sources(body, bodies, defaults, nowhere) for body in model.bodies]
    setter = disabling_flag(root, "gravity") or _last_options(root).get("gravity")
    gravity = setter.source if setter else nowhere
    return replace(model, bodies=tuple(found), gravity_source=gravity)


def _last_options(root: Element) -> dict[str, Element]:
    """Find the element <option> that sets each option: the last one does."""
    return {name: option for option in root.find_all("option") for name in option.attributes}


def disabling_flag(root: Element, name: str) -> Element | None:
    """Find the element <flag> that switches something off; None where it is on."""
    flags = [f for o in root.find_all("option") for f in o.find_all("flag") if name in f.attributes]
    return flags[-1] if flags and flags[-1].attributes[name] == "disable" else None


def features_not_compared(root: Element) -> tuple[Feature, ...]:
    """List what a file has that is not compared.

    Args:
        root: the file's root element, with all names and its geometry.

    """
    features = [
        Feature(section.tag, _name_of(element), element.source)
        for section in root.children
        if section.tag in _SECTIONS
        for element in section.children
    ]
    features += [
        Feature("flex" if element.tag == "flexcomp" else "mocap body", _name_of(element), element.source)
        for element in world_elements(root)
        if element.tag == "flexcomp" or element.attributes.get("mocap") == "true"
    ]
    fluid = [e for n, e in _last_options(root).items() if n in _FLUID and parse_numbers(e, n, 1, []) != [0.0]]
    features += [Feature("fluid", "", element.source) for element in fluid[:1]]
    return (*features, *_joint_features(root, DefaultClasses(root)))


def _name_of(element: Element) -> str:
    for name in ("name", "joint", "tendon", "joint1", "body1", "geom1", "site"):
        if name in element.attributes:
            return element.attributes[name]
    return ""


def _joint_features(root: Element, defaults: DefaultClasses) -> list[Feature]:
    found = []
    for body in body_elements(root):
        for joint in joint_elements(body):
            for attribute, (what, least) in _JOINT_FEATURES.items():
                element = defaults.setter(joint, attribute)
                if element is not None and len(element.attributes[attribute].split()) >= least:
                    found.append(Feature(what, joint.attributes.get("name", ""), element.source))
        if "gravcomp" in body.attributes:
            found.append(Feature("gravity compensation", body.attributes["name"], body.source))
    return found


class DefaultClasses:
    """Where an attribute of an element comes from: the element, or a default class."""

    def __init__(self, root: Element) -> None:
        self.classes: dict[str, list[Element]] = {}  # name → the elements <default>, the own one first
        self.class_of: dict[int, str] = {}  # id of an element of the worldbody → its class
        tops = root.find_all("default")[::-1]  # each is the class of all elements, whatever its name
        # a class copies what is set before it
        stack = [(top, tops[place:]) for place, top in enumerate(tops)]
        while stack:
            element, chain = stack.pop()
            if "class" in element.attributes:
                self.classes[element.attributes["class"]] = chain
            stack.extend((child, [child, *chain]) for child in element.find_all("default"))
        self.classes |= {top.attributes.get("class", "main"): tops for top in tops} | {"main": tops}
        for world in root.find_all("worldbody"):
            walk: list[tuple[Element, str]] = [(world, "main")]
            while walk:
                element, inherited = walk.pop()
                self.class_of[id(element)] = element.attributes.get("class", inherited)
                inherited = element.attributes.get("childclass", inherited)
                walk.extend((child, inherited) for child in element.children)

    def chain(self, element: Element) -> list[Element]:
        """List the elements <default> that hold for an element.

        Returns:
            The elements, that of the nearest class first.

        """
        own = element.attributes.get("class", "main")  # outside of the worldbody
        return self.classes.get(self.class_of.get(id(element), own), [])

    def setter(self, element: Element, attribute: str, kind: str = "joint") -> Element | None:
        """Find the element that sets an attribute.

        Args:
            element: a <joint> or <freejoint>, or one of another kind.
            kind: what default classes call such elements.

        Returns:
            The element, or that of a default class; None where the file does not set it.

        """
        if attribute in element.attributes:
            return element
        if element.tag == "freejoint":
            return None
        defaults = (holder.find(kind) for holder in self.chain(element))
        return next((d for d in defaults if d is not None and attribute in d.attributes), None)


def _body_with_sources(
    body: NeutralBody, elements: Mapping[str, Element], defaults: DefaultClasses, nowhere: Source
) -> NeutralBody:
    element = elements.get(body.name)
    if element is None:  # of a <replicate> or <attach>, whose names are made by the compiler
        return replace(body, source=nowhere)
    inertial = element.find("inertial") or element.find("geom") or element
    fields = dict.fromkeys(("mass", "center", "inertia"), inertial.source)
    named = {e.attributes.get("name", ""): e for e in joint_elements(element)}
    joints = tuple(_joint_with_sources(j, named.get(j.name), defaults, nowhere) for j in body.joints)
    return replace(body, joints=joints, source=element.source, fields=fields)


def _joint_with_sources(
    joint: ElementaryJoint, element: Element | None, defaults: DefaultClasses, nowhere: Source
) -> ElementaryJoint:
    if element is None:
        return replace(joint, source=nowhere)
    setters = {name: defaults.setter(element, attribute) for name, attribute in _JOINT_FIELDS.items()}
    fields = {name: setter.source for name, setter in setters.items() if setter is not None}
    return replace(joint, source=element.source, fields=fields)
