"""Random damage to model files: numbers at the ends of the doubles, attributes, elements, names and bytes."""

from __future__ import annotations

import random
import re
from collections.abc import Sequence

import numpy as np

from tests.helpers import ROOT
from tests.helpers.mutations import damaged_bytes
from tests.helpers.random_robots import random_mjcf, random_urdf

FOLDER = ROOT / "tests" / "adapters" / "model_files"
EXTREME_NUMBERS = (
    "0", "-0", "-1", "1e308", "-1e308", "1.7976931348623157e308", "1e200", "-1e154", "1e100", "1e30", "1e-30",
    "1e-154", "-1e-200", "1e-308", "1e-320", "5e-324", "nan", "inf", "-inf", "1e999", "-1e-999", "0x10",
    "1,5", "1e", "", "one", "9" * 400, "1 2", "1e999999999",
)  # fmt: skip
WORDS = ("", " ", "base", "world", "link0", "a" * 3000, "../x", "é", "\u202e", "&amp;", "&#0;", "<", "[red]")
_NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_ATTRIBUTE = re.compile(r'\s([\w:]+)="([^"]*)"')
_TAG = re.compile(r"<(/?)(\w+)")
_ELEMENT = re.compile(r"<(\w+)[^<>]*/>")


def robots() -> dict[str, str]:
    """Return eleven small robots by the name of their file."""
    found = {path.name: path.read_text(encoding="utf-8") for path in sorted(FOLDER.iterdir())}
    rng = np.random.default_rng(3)
    found |= {f"random{n}.urdf": random_urdf(rng, n) for n in (2, 4, 7)}
    return found | {f"random{n}.xml": random_mjcf(rng, n) for n in (2, 5)}


def damaged_model(text: str, draw: random.Random) -> bytes:
    """Return a model file with one to three changes, most of them to numbers."""
    for _ in range(draw.choice((1, 1, 2, 3))):
        text = _changed(text, draw)
    data = text.encode("utf-8", "surrogatepass")
    return damaged_bytes(data, draw) if draw.random() < 0.1 else data


def extreme_model(text: str, draw: random.Random) -> bytes:
    """Return a model file of which one or two numbers are finite and extreme."""
    for _ in range(draw.choice((1, 1, 2))):
        text = _replaced(text, _attribute_numbers(text), draw, EXTREME_NUMBERS[:16])
    return text.encode()


def _changed(text: str, draw: random.Random) -> str:
    attributes = [match.span(2) for match in _ATTRIBUTE.finditer(text)]
    match draw.randrange(8):
        case 0 | 1 | 2:
            return _replaced(text, _attribute_numbers(text), draw, EXTREME_NUMBERS)
        case 3:
            return _replaced(text, attributes, draw, WORDS)
        case 4:  # one attribute's value for another's
            values = [text[a:b] for a, b in attributes]
            return _replaced(text, attributes, draw, values or WORDS)
        case 5:
            names = [match.span(1) for match in _ATTRIBUTE.finditer(text)]
            return _replaced(text, names, draw, ("name", "mass", "xyz", "pos", "type", "joint", "x"))
        case 6:
            tags = [match.span(2) for match in _TAG.finditer(text)]
            return _replaced(text, tags, draw, ("link", "joint", "body", "inertial", "geom", "robot", "x"))
    elements = [match.span() for match in _ELEMENT.finditer(text)]
    if not elements:
        return text[: draw.randrange(len(text) + 1)]
    a, b = draw.choice(elements)
    return text[:a] + text[a:b] * draw.choice((0, 2)) + text[b:]


def _attribute_numbers(text: str) -> list[tuple[int, int]]:
    return [
        (match.start(2) + number.start(), match.start(2) + number.end())
        for match in _ATTRIBUTE.finditer(text)
        if match[1] not in ("name", "link", "joint", "class")
        for number in _NUMBER.finditer(match[2])
    ]


def _replaced(text: str, places: list[tuple[int, int]], draw: random.Random, words: Sequence[str]) -> str:
    if not places:
        return text
    a, b = draw.choice(places)
    return text[:a] + draw.choice(words) + text[b:]
