"""Search for the smallest model file that still shows something: delta debugging on the XML tree."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from copy import deepcopy

from plumbline.importers.mjcf_rewriting import rewritings
from plumbline.importers.xml_tree import Element

Shows = Callable[[Element], bool]
_NUMBERS = set("0123456789+-.eE ")
_REFERRED = {"body", "joint", "freejoint", "link", "robot"}  # whose names the script or the format needs
_EXPANDED_DEFAULTS = "defaults expanded"


def shrink_tree(root: Element, shows: Shows, seconds: float) -> Element:
    """Remove elements and attributes, and round numbers, as long as a file still shows the difference.

    Args:
        root: of a file that shows it.
        seconds: after which the best file so far is returned.

    Returns:
        The smallest tree that was found.

    """
    deadline = time.monotonic() + seconds
    best = root
    passes = (_without_branches, _without_elements, _hoisted, _without_attributes, _rounded)
    for candidates in (_without_defaults, _without_kinds, *passes, _without_kinds, *passes):
        place = 0
        while time.monotonic() < deadline:
            candidate = next(_from(candidates(best), place), None)
            if candidate is None:
                break
            if shows(candidate):
                best = candidate
            else:
                place += 1
    return best


def _from(candidates: Iterator[Element], place: int) -> Iterator[Element]:
    """Skip candidates that have been tried; those before the place stay as they were when one is accepted."""
    for _ in range(place):
        if next(candidates, None) is None:
            return
    yield from candidates


def _size(element: Element) -> int:
    return sum(1 for _ in element.walk())


def _paths(root: Element) -> list[tuple[Element, int]]:
    """Every element but the root as its parent and its index there, the largest first."""
    found = [(parent, i) for parent in root.walk() for i in range(len(parent.children))]
    return sorted(found, key=lambda pair: -_size(pair[0].children[pair[1]]))


def _copied(root: Element, change: Callable[[list[Element]], None]) -> Element:
    copy = deepcopy(root)
    change(list(copy.walk()))
    return copy


def _without_branches(root: Element) -> Iterator[Element]:
    """URDF: without a link and its descendants, or with a link as the root."""
    joints = [j for j in root.find_all("joint") if j.find("parent") and j.find("child")]
    ends = {id(j): tuple(j.find(t).attributes.get("link", "") for t in ("parent", "child")) for j in joints}  # type: ignore[union-attr]
    for joint in joints:
        below = {ends[id(joint)][1]}
        for _ in joints:
            below |= {child for parent, child in ends.values() if parent in below}
        for dropped in (below, {link.attributes.get("name", "") for link in root.find_all("link")} - below):
            yield _without_links(root, dropped)


def _without_links(root: Element, dropped: set[str]) -> Element:
    copy = deepcopy(root)
    copy.children = [
        child
        for child in copy.children
        if not (child.tag == "link" and child.attributes.get("name") in dropped)
        and not (child.tag == "joint" and dropped & {e.attributes.get("link") for e in child.children})
    ]
    return copy


def _without_defaults(root: Element) -> Iterator[Element]:
    """MJCF: what is inherited written at each joint and geom, without the sections that are not compared."""
    if root.tag == "mujoco" and (expanded := rewritings(root).get(_EXPANDED_DEFAULTS)):
        yield expanded


def _without_kinds(root: Element) -> Iterator[Element]:
    """Without all elements of a tag, or one attribute of all of them: most of a file goes in few trials."""
    elements = list(root.walk())
    for tag in dict.fromkeys(element.tag for element in elements[1:]):
        copy = deepcopy(root)
        for element in copy.walk():
            element.children = [child for child in element.children if child.tag != tag]
        yield copy
    for tag, name in dict.fromkeys((e.tag, name) for e in elements for name in e.attributes):
        if not _is_kept(tag, name):
            copy = deepcopy(root)
            for element in copy.walk():
                if element.tag == tag:
                    element.attributes.pop(name, None)
            yield copy


def _is_kept(tag: str, attribute: str) -> bool:
    return attribute == "link" or (attribute == "name" and tag in _REFERRED)


def _without_elements(root: Element) -> Iterator[Element]:
    order = {id(element): i for i, element in enumerate(root.walk())}
    for parent, index in _paths(root):
        place = order[id(parent)]

        def remove(elements: list[Element], place: int = place, index: int = index) -> None:
            del elements[place].children[index]

        yield _copied(root, remove)


def _hoisted(root: Element) -> Iterator[Element]:
    """MJCF: a body replaced by the bodies in it; a fixed link of a URDF by the links below it."""
    order = {id(element): i for i, element in enumerate(root.walk())}
    for parent, index in _paths(root):
        if parent.children[index].tag != "body":
            continue
        place = order[id(parent)]

        def hoist(elements: list[Element], place: int = place, index: int = index) -> None:
            holder = elements[place]
            inner = holder.children[index].find_all("body")
            holder.children[index : index + 1] = inner

        yield _copied(root, hoist)
    for joint in root.find_all("joint"):
        parent_end, child_end = joint.find("parent"), joint.find("child")
        if parent_end is None or child_end is None:
            continue
        old, new = child_end.attributes.get("link", ""), parent_end.attributes.get("link", "")
        copy = _without_links(root, set())
        copy.children = [
            c for c in copy.children if c.attributes.get("name") not in (joint.attributes.get("name"), old)
        ]
        for other in copy.find_all("joint"):
            for end in other.find_all("parent"):
                if end.attributes.get("link") == old:
                    end.attributes["link"] = new
        yield copy


def _without_attributes(root: Element) -> Iterator[Element]:
    for place, element in enumerate(root.walk()):
        for name in element.attributes:
            if not _is_kept(element.tag, name):

                def remove(elements: list[Element], place: int = place, name: str = name) -> None:
                    del elements[place].attributes[name]

                yield _copied(root, remove)


def _rounded(root: Element) -> Iterator[Element]:
    """Numbers as zeros, as ones, with one digit."""
    for place, element in enumerate(root.walk()):
        for name, value in element.attributes.items():
            words = value.split()
            if not words or not set(value) <= _NUMBERS or _is_kept(element.tag, name):
                continue
            for simple in _simpler(words):
                if simple == value or len(simple) > len(value):
                    continue

                def change(
                    elements: list[Element], place: int = place, name: str = name, simple: str = simple
                ) -> None:
                    elements[place].attributes[name] = simple

                yield _copied(root, change)


def _simpler(words: list[str]) -> Iterator[str]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        return
    yield " ".join("0" for _ in values)
    yield " ".join("1" for _ in values)
    yield " ".join(f"{value:.1g}" for value in values)
    yield " ".join(f"{value:.2g}" for value in values)
