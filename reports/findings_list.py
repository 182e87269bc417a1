"""The findings of a run for the page: each with its mechanism drawn, a plot of its rows, and its history."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import itemgetter
from typing import Any

from plumbline.judging.rows import RUN_FAMILY
from plumbline.model.datatypes import Model
from plumbline.model.grouping import grouped
from reports import robot_drawing
from reports.earlier_runs import History
from reports.stored_results import Record, Results

MAX_DRAWN = 40  # findings with pictures
PLOT = (220.0, 64.0)  # px
MAX_DECADES = 14.0  # above the tolerance: the plot's height


def findings_for_page(results: Results, history: History) -> list[Record]:
    """Describe every finding, those that need attention first.

    Returns:
        The findings of results.json, each with its representative ``row``, the place marked in a ``drawing``
        of the smallest scenario, a ``plot`` of its rows, ``first_seen`` and whether it has a script.

    """
    by_key = {row["key"]: row for row in results.rows}
    found = list[Record]()
    for finding in results.findings:
        rows = [by_key[key] for key in finding["rows"] if key in by_key]
        if not rows:
            continue
        is_drawn = len(found) < MAX_DRAWN
        found.append(
            finding
            | {
                "row": rows[0],
                "drawing": _drawing(results.scenarios[rows[0]["scenario"]], rows[0]) if is_drawn else None,
                "plot": _plot(rows) if is_drawn else None,
                "first_seen": history.first_seen(rows),
                "is_scripted": any(row["key"] in results.scripts for row in rows),
            }
        )
    return found


def declared_gaps(results: Results) -> list[Record]:
    """Group what engines declare not to do, by engine and sentence."""
    declared = (row for row in results.rows if row["is_declared"])
    gaps = [
        {"row": rows[0], "count": len(rows), "scenarios": dict.fromkeys(row["scenario"] for row in rows)}
        for rows in grouped(declared, itemgetter("engine", "known_issue", "reason")).values()
    ]
    return sorted(gaps, key=lambda gap: (gap["row"]["engine"], -gap["count"]))


def _drawing(scenario: Record, row: Record) -> Record | None:
    """The mechanism at its initial state, with the body of the largest error marked."""
    if scenario["family"] == RUN_FAMILY or scenario["model"] is None or scenario["state"] is None:
        return None
    model = Model.from_fields(scenario["model"])
    origins = scenario["state"]["r"]
    names = [f"body {k + 1}" for k in range(model.n)]
    parents = [names[far] if far >= 0 else "" for far in model.body[: model.n, 0].tolist()]
    bodies = [
        {"name": name, "parent": parent, "origin": origin}
        for name, parent, origin in zip(names, parents, origins, strict=True)
    ]
    worst = int((row["extra"] or {}).get("body") or 0)
    marked = {f"body {worst}": ["the largest error"]} if 0 < worst <= model.n else {}
    return robot_drawing.draw(bodies, marked)


def _plot(rows: Sequence[Record]) -> Record | None:
    """Dots of the rows' errors over their tolerances, on a log scale, in the order of the finding."""
    sizes = [(row["key"], row["ratio"]) for row in rows if row["ratio"]]
    sizes = [(key, ratio) for key, ratio in sizes if math.isfinite(ratio) and ratio > 0][:200]
    if not sizes:
        return None
    width, height = PLOT
    top = min(MAX_DECADES, max(1.0, *(math.log10(ratio) for _, ratio in sizes)))
    dots: list[dict[str, Any]] = []
    for place, (key, ratio) in enumerate(sizes):
        share = min(max(math.log10(ratio), -1.0), top) / (top + 1) + 1 / (top + 1)
        dots.append(
            {
                "x": round((place + 0.5) * width / len(sizes), 1),
                "y": round(height * (1 - share), 1),
                "words": f"{key}: {ratio:.3g}",
            }
        )
    return {
        "dots": dots,
        "tolerance": round(height * (1 - 1 / (top + 1)), 1),
        "size": PLOT,
        "largest": 10**top,
    }
