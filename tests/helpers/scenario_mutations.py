"""Mistakes that people and programs make in scenario files, as random edits of the text or of its data.

An edit takes the data of a valid file, or its text, and a source of random numbers.
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import random
import re
from typing import Any

from ruamel.yaml import YAML

from tests.helpers.mutations import HOSTILE_VALUES, damaged_bytes, places

KINDS = (
    "ball",
    "rod",
    "hinge",
    "universal",
    "slide",
    "cylindrical",
    "weld",
    "free",
    "screw",
    "planar",
    "helical",
    "Ball",
)
PLANTED: dict[str, Any] = {  # fields of scenario files, right or wrong where they are planted, and strangers
    "armature": 0.1, "damping": [0.1], "stiffness": 3.0, "rest": [0.2], "effort": 1.0,
    "coordinates": [0.1, 0.2],
    "rates": [1.0], "axis": [0, 1, 0], "frame": {"quaternion": [1, 0, 0, 0]}, "body_frame": {"euler": {}},
    "springs": [{"bodies": ["world", "a"], "points": [[0, 0, 0], [0, 0, 1]], "stiffness": 1}],
    "closes": [{"body": "a", "joint": {"kind": "ball"}, "proximal": [0, 0, 0]}], "parent": "world",
    "anchor": [0, 0, 1], "distal": [0, 0, -1], "proximal": [0, 0, 1], "name": "a", "mass": 1.0, "length": 1.0,
    "inertia": {"six": [1, 1, 1, 0, 0, 0]}, "attitude": {"axis_angle": {"axis": [1, 0, 0], "degrees": 30}},
    "angular_velocity": [0, 0, 1], "load": {"force": [0, 0, 1]}, "drag": {"moment": 0.1}, "force": [1, 0, 0],
    "moment": 1.0, "position": [0, 0, 0], "velocity": [0, 0, 0], "direction": [0, 0, -1], "rate": [0, 1, 0],
    "kind": "hinge", "repeat": 3, "cycle": [], "turn": {"axis": [0, 0, 1], "angle": 0.1},
    "gravity": [0, 0, 0],
    "duration": 0.5, "sample": 0.25, "exact": "rest", "seed": "x", "family": "own", "schema_version": 1,
    "quaternion": [0, 0, 0, 1], "principal": [1, 1, 1], "axes": {}, "matrix": [[1]], "convention": "xyz",
    "body": "a", "points": [[0, 0, 0]], "bodies": [], "pos": [0, 0, 0], "limit": [0, 1], "friction": 0.1,
}  # fmt: skip


def _holders(document: Any, kind: type) -> list[Any]:
    return [holder[key] for holder, key in places({"": document}) if isinstance(holder[key], kind)]


def _numbers(document: Any) -> list[tuple[Any, Any]]:
    found = [(holder, key) for holder, key in places(document) if type(holder[key]) in (int, float)]
    return found or [(document, "duration")]


def _block(document: Any) -> str:
    stream = io.StringIO()
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.dump(document, stream)
    return stream.getvalue()


def _replace_value(document: Any, draw: random.Random) -> None:
    holder, key = draw.choice(list(places(document)))
    holder[key] = copy.deepcopy(draw.choice(HOSTILE_VALUES))


def _remove(document: Any, draw: random.Random) -> None:
    holder, key = draw.choice(list(places(document)))
    del holder[key]


def _rename(document: Any, draw: random.Random) -> None:
    holder = draw.choice(_holders(document, dict))
    key = draw.choice(list(holder) or [""])
    k = draw.randrange(len(key) + 1)
    other = draw.choice(
        (key.upper(), key + "s", key[:k] + key[k + 1 :], key[:k] + "x" + key[k:], key[::-1], "")
    )
    holder[other] = holder.pop(key, None)


def _plant(document: Any, draw: random.Random) -> None:
    for name in draw.sample(list(PLANTED), draw.choice((1, 1, 2))):
        draw.choice(_holders(document, dict))[name] = copy.deepcopy(PLANTED[name])


def _scale(document: Any, draw: random.Random) -> None:
    for holder, key in draw.sample(found := _numbers(document), min(len(found), draw.choice((1, 2, 5)))):
        factor = draw.choice((-1, 0, 2, 1e-3, 1e3, 1e-12, 1e12, 1e150, 1e-150, 1e300, 1 + 1e-9))
        holder[key] = (holder.get(key, 1.0) if isinstance(holder, dict) else holder[key]) * factor


def _special_number(document: Any, draw: random.Random) -> None:
    holder, key = draw.choice(_numbers(document))
    holder[key] = draw.choice((5e-324, -0.0, 1e308, 2**53 + 1, 10**400, 1e-320, 0.1 + 0.2, -1, 0, 1, 7))


def _number_as_text(document: Any, draw: random.Random) -> None:
    holder, key = draw.choice(_numbers(document))
    form = draw.choice(
        ("{} kg", "{}m", "'{}'", "{}°", "{},5", "{} 1", "1_0{}", "0x{}", "~{}", "{}e", "NaN", "inf")
    )
    holder[key] = form.format(holder[key] if not isinstance(holder, dict) else holder.get(key))


def _resize(document: Any, draw: random.Random) -> None:
    found = draw.choice(_holders(document, list) or [[]])
    if found and draw.random() < 0.5:
        found.pop(draw.randrange(len(found)))
    else:
        found.insert(draw.randrange(len(found) + 1), draw.choice((0, 1.0, "x", None, [], *found)))


def _wrap(document: Any, draw: random.Random) -> None:
    holder, key = draw.choice(list(places(document)))
    holder[key] = draw.choice(
        ([holder[key]], {"value": holder[key]}, {str(key): holder[key]}, str(holder[key]))
    )


def _exchange(document: Any, draw: random.Random) -> None:
    (one, i), (other, j) = draw.choices(list(places(document)), k=2)
    one[i], other[j] = copy.deepcopy(other[j]), copy.deepcopy(one[i])


def _shuffle(document: Any, draw: random.Random) -> None:
    bodies = document.get("bodies")
    if isinstance(bodies, list):
        draw.shuffle(bodies)
        bodies += copy.deepcopy(bodies[: draw.choice((0, 0, 1, 2))])


def _names(document: Any, draw: random.Random) -> None:
    """Names of bodies, and fields that refer to them."""
    bodies = [body for body in document.get("bodies", []) if isinstance(body, dict)]
    names = [str(body["name"]) for body in bodies if "name" in body]
    words = (*names, "world", "World", "nobody", "", "a" * 81, "a\nb", "\u202e")
    for joint in draw.choices([*bodies, *document.get("closes", []), *document.get("springs", [])], k=2):
        field = draw.choice(("name", "parent") if "mass" in joint else ("body", "parent", "bodies"))
        joint[field] = [draw.choice(words), draw.choice(words)] if field == "bodies" else draw.choice(words)


def _kind(document: Any, draw: random.Random) -> None:
    joints = [found for found in _holders(document, dict) if "kind" in found]
    if joints:
        draw.choice(joints)["kind"] = draw.choice(KINDS)


def _close(document: Any, draw: random.Random) -> None:
    """Loops and springs between bodies that are there, most of them impossible."""
    bodies = [body for body in document.get("bodies", []) if isinstance(body, dict)]
    for k, body in enumerate(bodies):
        body.setdefault("name", f"b{k}")
    names = ["world", *(body["name"] for body in bodies)]
    kind = draw.choice(KINDS[:7])
    joint = {"kind": kind} | ({"length": draw.choice((0, 0.3, 1))} if kind == "rod" else {})
    points = [[draw.choice((0, 0.5, -1)) for _ in range(3)] for _ in range(2)]
    ends = draw.choices(names, k=2)
    if draw.random() < 0.5:
        closing = {
            "body": ends[0],
            "parent": ends[1],
            "joint": joint,
            "anchor": points[0],
            "proximal": points[1],
        }
        document.setdefault("closes", []).append(closing)
    else:
        spring = {"bodies": ends, "points": points, "stiffness": draw.choice((-1, 0, 10.0))}
        document.setdefault("springs", []).append(spring)


def _repeat(document: Any, draw: random.Random) -> None:
    bodies = document["bodies"]
    k = draw.randrange(len(bodies))
    run = {"repeat": draw.choice((0, 1, 2, 7, 300, 10**6)), "cycle": [bodies[k]]}
    bodies[k] = run | draw.choice(({}, {"turn": PLANTED["turn"]}, {"turn": {"axis": [0, 0, 0], "angle": 1}}))


def _indent(text: str, draw: random.Random) -> str:
    lines = text.splitlines(keepends=True)
    k = draw.randrange(len(lines))
    lines[k] = draw.choice((" ", "\t", "    ", "- ", "")) + (
        lines[k] if draw.random() < 0.7 else lines[k].lstrip()
    )
    return "".join(lines)


def _mark(text: str, draw: random.Random) -> str:
    """Tags, anchors, aliases, merges, documents and comments."""
    words = (
        "!!str ",
        "!x ",
        "&a ",
        "*a ",
        "<<: *a\n",
        "---\n",
        "...\n",
        "%YAML 1.1\n",
        "# ",
        "? ",
        "| ",
        "> ",
        "!!float ",
    )
    at = [match.end() for match in re.finditer(r": |- |\n", text)]
    for _ in range(draw.choice((1, 1, 3))):
        k = draw.choice(at)
        text = text[:k] + draw.choice(words) + text[k:]
    return text


def _repeat_line(text: str, draw: random.Random) -> str:
    lines = text.splitlines(keepends=True)
    k, j = draw.randrange(len(lines)), draw.randrange(len(lines))
    lines.insert(j if draw.random() < 0.5 else k, lines[k])
    return "".join(lines)


def _characters(text: str, draw: random.Random) -> str:
    for _ in range(draw.choice((1, 2, 5))):
        k = draw.randrange(len(text))
        word = draw.choice(
            ("\u00a0", "\u2212", "“", "٣", "\ufeff", "\x07", "\ud800", "𝟏", "\x85", "\u2028", "{", "]", '"')
        )
        text = text[:k] + word + text[k + draw.choice((0, 1)) :]
    return text


EDITS_OF_DATA = (
    _replace_value, _remove, _rename, _plant, _scale, _special_number, _number_as_text, _resize, _wrap,
    _exchange, _shuffle, _names, _kind, _close, _repeat,
)  # fmt: skip
EDITS_OF_TEXT = (_indent, _mark, _repeat_line, _characters)


def mutated(document: Any, draw: random.Random) -> tuple[str, bytes]:
    """A random mutator's name, and the file that it makes of a valid one's data."""
    edit: Any = draw.choice((*EDITS_OF_DATA, *EDITS_OF_TEXT, damaged_bytes))
    name = edit.__name__.strip("_")
    if edit in EDITS_OF_DATA:
        changed = copy.deepcopy(document)
        edit(changed, draw)
        if draw.random() < 0.3:  # a second mistake, where the first has left what it needs
            with contextlib.suppress(TypeError, ValueError, AttributeError, LookupError):
                draw.choice(EDITS_OF_DATA)(changed, draw)
        return name, json.dumps(changed, indent=1).encode("utf-8", "surrogatepass")  # JSON is YAML
    if edit is damaged_bytes:
        return name, damaged_bytes(_block(document).encode(), draw)
    return name, edit(_block(document), draw).encode("utf-8", "surrogatepass")
