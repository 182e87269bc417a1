"""A robot as a drawing: its bodies' frames joined by lines, names, and numbers at those that differ."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from reports.stored_results import Record

_SIZE = 312  # px, the larger of width and height of a robot of many bodies
_STEP = 80  # px, the same per body of a small one
_MARGIN = 26  # px around it, for the numbers
_NAME_WIDTH = 110  # px beside a point, for its name
_MAX_NAME = 18  # characters of a name
_LINE_HEIGHT = 12  # px
_NEAR = 9.0  # px: marks that are nearer to each other share one
_MAX_RANGES = 2  # of numbers at one place
_AXIS = 22.0  # px, length of the world's axes in the drawing
_AZIMUTH, _ELEVATION = math.radians(35), math.radians(25)  # of the view
Point = tuple[float, float]


def _flatten(origin: Sequence[float]) -> Point:
    """Project a point of the world [m] to the picture's plane, y downwards."""
    x, y, z = origin
    across = y * math.cos(_AZIMUTH) - x * math.sin(_AZIMUTH)
    depth = x * math.cos(_AZIMUTH) + y * math.sin(_AZIMUTH)
    return across, -(z * math.cos(_ELEVATION) - depth * math.sin(_ELEVATION))


def draw(bodies: Sequence[Record], marked: Mapping[str, Sequence[str]]) -> Record | None:
    """Draw a robot.

    Args:
        bodies: name, parent's name and origin [m] of each body's frame.
        marked: by body what differs in it.

    Returns:
        ``size``: width and height [px]; ``lines``: x1, y1, x2, y2 [px] from each parent's origin to the
        body's; ``points``: x, y, name and is_marked of each body; ``labels``: x, y, text and anchor of names
        where there is room; ``numbers``: the same beside marked bodies; ``legend``: name and words by number;
        ``axes`` and ``world``: of the world's frame.
        None where there is nothing to draw.

    """
    if not bodies:
        return None
    flat: dict[str, Point] = {"": (0.0, 0.0)} | {body["name"]: _flatten(body["origin"]) for body in bodies}
    low = [min(p[i] for p in flat.values()) for i in (0, 1)]
    spans = [max(p[i] for p in flat.values()) - low[i] for i in (0, 1)]
    places = {(round(x, 6), round(y, 6)) for x, y in flat.values()}
    size = float(min(_SIZE, _STEP * (len(places) - 1)))
    scale = size / (max(spans) or 1.0)

    def place(name: str) -> Point:
        x, y = (round(_MARGIN + (flat[name][i] - low[i]) * scale, 1) for i in (0, 1))
        return x, y

    lines, points = [], []
    for body in bodies:
        x, y = place(body["name"])
        if body["parent"]:
            x1, y1 = place(body["parent"])
            lines.append({"x1": x1, "y1": y1, "x2": x, "y2": y})
        points.append({"x": x, "y": y, "name": body["name"], "is_marked": body["name"] in marked})
    width, height = (span * scale + 2 * _MARGIN for span in spans)
    numbers = _numbers([(p["x"], p["y"]) for p in points if p["is_marked"]], width / 2)
    return {
        "size": [round(width + _NAME_WIDTH), round(height)],
        "lines": lines,
        "points": points,
        "numbers": numbers,
        "labels": _labels(points),
        "legend": [{"name": p["name"], "words": marked[p["name"]]} for p in points if p["is_marked"]],
        "world": place(""),
        "axes": [_axis(place(""), k) for k in range(3)],
    }


def _axis(start: Point, k: int) -> Record:
    across, down = _flatten([float(i == k) for i in range(3)])
    return {
        "name": "xyz"[k],
        "x": round(start[0] + _AXIS * across, 1),
        "y": round(start[1] + _AXIS * down, 1),
    }


def _labels(points: Sequence[Record]) -> list[Record]:
    """Write names to the right of their points, those that would cover others left out."""
    found: list[Record] = []
    for point in points:
        x, y = point["x"] + (26 if point["is_marked"] else 8), point["y"] + 4  # beside a number
        if any(abs(y - o["y"]) < _LINE_HEIGHT and abs(x - o["x"]) < _NAME_WIDTH for o in found):
            continue
        name = str(point["name"])
        text = name if len(name) <= _MAX_NAME else name[: _MAX_NAME - 1] + "…"
        found.append({"x": x, "y": y, "text": text, "anchor": "start"})
    return found


def _numbers(places: Sequence[Point], middle: float) -> list[Record]:
    """Write the numbers of marks that lie together as one text, towards the middle of the drawing."""
    groups: list[tuple[Point, list[int]]] = []
    for number, place in enumerate(places, 1):
        near = next((numbers for first, numbers in groups if math.dist(first, place) < _NEAR), None)
        if near is None:
            groups.append((place, [number]))
        else:
            near.append(number)
    found = []
    for (x, y), numbers in groups:
        is_right = x > middle
        found.append({"x": x - 8 if is_right else x + 8, "y": y + 4, "text": _ranges(numbers),
                      "anchor": "end" if is_right else "start"})  # fmt: skip
    return found


def _ranges(numbers: Sequence[int]) -> str:
    """Write ascending numbers as "1–3, 5"; of many ranges the first."""
    ranges: list[list[int]] = []
    for number in numbers:
        if ranges and ranges[-1][-1] == number - 1:
            ranges[-1][1:] = [number]
        else:
            ranges.append([number])
    texts = ["–".join(map(str, one)) for one in ranges]
    return ", ".join(texts[:_MAX_RANGES]) + (" …" if len(texts) > _MAX_RANGES else "")
