"""A robot as a drawing: its bodies' frames joined by lines, and numbers at those that differ."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from reports.results import Record

_SIZE = 312  # px, the larger of width and height of the robot
_MARGIN = 26  # px around it, for the numbers
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
        body's; ``points``: x, y, name and is_marked of each body; ``numbers``: x, y, text and anchor beside
        marked bodies; ``legend``: name and words by number; ``axes`` and ``world``: of the world's frame.
        None where there is nothing to draw.

    """
    if not bodies:
        return None
    flat: dict[str, Point] = {"": (0.0, 0.0)} | {body["name"]: _flatten(body["origin"]) for body in bodies}
    low = [min(p[i] for p in flat.values()) for i in (0, 1)]
    spans = [max(p[i] for p in flat.values()) - low[i] for i in (0, 1)]
    scale = _SIZE / (max(spans) or 1.0)

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
    return {
        "size": [round(span * scale + 2 * _MARGIN) for span in spans],
        "lines": lines,
        "points": points,
        "numbers": _numbers([(p["x"], p["y"]) for p in points if p["is_marked"]]),
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


def _numbers(places: Sequence[Point]) -> list[Record]:
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
        is_right = x > _SIZE / 2
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
