"""The smallest model file that still shows something: delta debugging on the parts of the XML tree."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from plumbline.importers.mjcf_rewriting import rewritings
from plumbline.importers.xml_tree import Element
from plumbline.reproduce.shrink import shrink

_NUMBERS = set("0123456789+-.eE ")
_REFERRED = {"body", "joint", "freejoint", "link", "robot"}  # whose names the script or the format needs
_EXPANDED_DEFAULTS = "defaults expanded"
_Replacements = Mapping[int, Sequence[Element]]  # by the identity of an element what takes its place


def shrink_tree(root: Element, shows: Callable[[Element], bool], seconds: float) -> Element:
    """Remove elements and attributes, and round numbers, as long as a file still shows the difference.

    Args:
        root: of a file that shows it.
        seconds: after which the best file so far is returned.

    Returns:
        The smallest tree that was found.

    """
    deadline = time.monotonic() + seconds
    parts = (_without_branches, _without_elements, _hoisted, _without_attributes, _rounded)
    passes = (_without_defaults, _without_kinds, *parts, _without_kinds, *parts)
    return shrink(root, passes, shows, lambda: time.monotonic() > deadline)


def _copied(root: Element, new: _Replacements) -> Element:
    """Copy a tree with other elements in the place of some."""
    (top,) = new.get(id(root), [root])
    children = [part for child in top.children for part in new.get(id(child), [child])]
    return replace(top, attributes=dict(top.attributes), children=[_copied(child, new) for child in children])


def _without(root: Element, dropped: Iterable[Element]) -> Element:
    return _copied(root, {id(element): [] for element in dropped})


def _with_attribute(element: Element, name: str, value: str | None) -> list[Element]:
    others = {key: text for key, text in element.attributes.items() if key != name}
    kept = others if value is None else element.attributes | {name: value}
    return [replace(element, attributes=kept)]


def _largest_first(root: Element) -> list[Element]:
    """Every element but the root."""
    return sorted([*root.walk()][1:], key=lambda element: -sum(1 for _ in element.walk()))


def _link_joints(root: Element) -> dict[str, tuple[Element, str]]:
    """The joints of a URDF and their parent links, by child link."""
    ends = [(j, j.find("parent"), j.find("child")) for j in root.find_all("joint")]
    return {
        child.attributes.get("link", ""): (joint, parent.attributes.get("link", ""))
        for joint, parent, child in ends
        if parent and child
    }


def _without_branches(root: Element) -> Iterator[Element]:
    """URDF: without a link and its descendants, or with a link as the root."""
    joints = _link_joints(root)
    links = {link.attributes.get("name", ""): link for link in root.find_all("link")}
    for top in joints:
        below = {top}
        for _ in joints:
            below |= {child for child, (_, parent) in joints.items() if parent in below}
        for dropped in (below, links.keys() - below):
            ends = [joint for child, (joint, parent) in joints.items() if dropped & {child, parent}]
            yield _without(root, [*ends, *(link for name, link in links.items() if name in dropped)])


def _without_defaults(root: Element) -> Iterator[Element]:
    """MJCF: what is inherited written at each joint and geom, without the sections that are not compared."""
    if root.tag == "mujoco" and (expanded := rewritings(root).get(_EXPANDED_DEFAULTS)):
        yield expanded


def _without_kinds(root: Element) -> Iterator[Element]:
    """Without all elements of a tag, or one attribute of all of them: most of a file goes in few trials."""
    elements = list(root.walk())
    for tag in dict.fromkeys(element.tag for element in elements[1:]):
        yield _without(root, [element for element in elements[1:] if element.tag == tag])
    for tag, name in dict.fromkeys(_free_attributes(elements)):
        some = [e for e in elements if e.tag == tag and name in e.attributes]
        yield _copied(root, {id(element): _with_attribute(element, name, None) for element in some})


def _free_attributes(elements: Iterable[Element]) -> Iterator[tuple[str, str]]:
    """Tags and attributes of elements, but for those that the script or the format needs."""
    for element in elements:
        for name in element.attributes:
            if name != "link" and not (name == "name" and element.tag in _REFERRED):
                yield element.tag, name


def _without_elements(root: Element) -> Iterator[Element]:
    return (_without(root, [element]) for element in _largest_first(root))


def _hoisted(root: Element) -> Iterator[Element]:
    """MJCF: a body replaced by the bodies in it; a link of a URDF by the links below it."""
    for element in _largest_first(root):
        if element.tag == "body":
            yield _copied(root, {id(element): element.find_all("body")})
    joints = _link_joints(root)
    links = {link.attributes.get("name", ""): link for link in root.find_all("link")}
    for child, (joint, parent) in joints.items():
        ends = [other.find("parent") for other, above in joints.values() if above == child]
        moved = {id(end): _with_attribute(end, "link", parent) for end in ends if end}
        dropped = [joint, *([links[child]] if child in links else [])]
        yield _copied(root, moved | {id(element): [] for element in dropped})


def _without_attributes(root: Element) -> Iterator[Element]:
    for element in root.walk():
        for _, name in _free_attributes([element]):
            yield _copied(root, {id(element): _with_attribute(element, name, None)})


def _rounded(root: Element) -> Iterator[Element]:
    """Numbers as zeros, as ones, with one digit or two."""
    for element in root.walk():
        for _, name in _free_attributes([element]):
            value = element.attributes[name]
            for simple in _simpler(value) if set(value) <= _NUMBERS else ():
                if simple != value and len(simple) <= len(value):
                    yield _copied(root, {id(element): _with_attribute(element, name, simple)})


def _simpler(text: str) -> Iterator[str]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return
    for form in ("0", "1", "{:.1g}", "{:.2g}") if values else ():
        yield " ".join(form.format(value) for value in values)
