"""sweep.html: the map of a parameter sweep, one file without a script, from its stored rows."""

from __future__ import annotations

import json
import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq

from plumbline.model.grouping import grouped
from plumbline.storage.results_store import write_atomically
from reports import html_report
from reports.stored_results import Record, replace_unprintable
from reports.verdicts import count_verdicts, severity

MAX_AXIS_VALUES = 24  # values of an axis that are shown one by one; more are gathered into intervals
AXIS_INTERVALS = 16
MAX_LISTED_ROWS = 60  # rows that do not agree, written out
SHADE_COUNT = 8
MAP_COLUMNS = {  # per implementation: column, title
    True: (("uncertainty", "uncertainty, m"), ("reach", "reach of the last body, m")),  # the reference
    False: (("position_error", "largest distance from the truth, m"),),
}


class Axis(NamedTuple):
    """A parameter's values along one side of the map."""

    name: str
    titles: list[str]
    values: list[float]
    edges: list[float] | None  # of intervals; None where every value is shown

    def index_of(self, value: float) -> int:
        """Find the place of a value along the axis.

        Returns:
            The index of the value, or of the interval that holds it.

        """
        if self.edges is None:
            return self.values.index(value)
        return min(max(bisect_right(self.edges, value) - 1, 0), len(self.edges) - 2)


def write(folder: Path) -> Path:
    """Render sweep.html from sweep.parquet.

    Raises:
        OSError: the table cannot be read, or the page not be written.
        ValueError: the table is damaged (`pyarrow.ArrowInvalid`).

    """
    table = pq.read_table(folder / "sweep.parquet")
    names = replace_unprintable(table.column_names)
    rows = replace_unprintable(table.rename_columns(names).to_pylist())
    about = replace_unprintable(json.loads((table.schema.metadata or {}).get(b"sweep", b"{}")))
    path = folder / "sweep.html"
    write_atomically(path, render(names[: names.index("cell")], rows, about).encode())
    return path


def render(parameters: Sequence[str], rows: Sequence[Record], sweep_info: Record) -> str:
    """Render the page of a sweep.

    Args:
        rows: the sweep's records, one per cell and implementation.
        sweep_info: content of the sweep's file; may be empty.

    """
    varied = [name for name in parameters if len({row[name] for row in rows}) > 1] or list(parameters)
    across = make_axis(varied[0], rows)
    down = make_axis(varied[1], rows) if len(varied) > 1 else None
    maps = [
        {
            "name": name,
            "integrator": next((r["integrator"] for r in theirs if r["integrator"]), ""),
            "title": title,
            "counts": count_verdicts(theirs),
            **map_cells(theirs, column, across, down),
        }
        for name, theirs in grouped(rows, itemgetter("implementation")).items()
        for column, title in MAP_COLUMNS[name == "reference"]
    ]
    poor = [row for row in rows if row["verdict"] not in ("agrees", "not installed")]
    cells = len({row["cell"] for row in rows})
    counts = Counter((row["implementation"], row["verdict"]) for row in rows)
    return html_report.render_page(
        "sweep.html",
        sentence=f"{cells} cells: "
        + "; ".join(f"{name} {verdict} {k}" for (name, verdict), k in counts.items()),
        scenario=sweep_info.get("scenario", ""),
        about=sweep_info,
        across=across,
        down=down,
        folded=varied[2:],
        maps=maps,
        poor=poor[:MAX_LISTED_ROWS],
        unlisted=len(poor) - MAX_LISTED_ROWS,
        parameters=parameters,
        shades=SHADE_COUNT,
    )


def make_axis(name: str, rows: Sequence[Record]) -> Axis:
    """Lay out a parameter's values along an axis, as intervals where there are too many values."""
    values = sorted({float(row[name]) for row in rows})
    if len(values) <= MAX_AXIS_VALUES:
        return Axis(name, [f"{value:.4g}" for value in values], values, None)
    ratios = values[0] > 0 and values[-1] > 100 * values[0]
    edges = (np.geomspace if ratios else np.linspace)(values[0], values[-1], AXIS_INTERVALS + 1).tolist()
    return Axis(name, [f"{a:.3g} … {b:.3g}" for a, b in pairwise(edges)], edges, edges)


def map_cells(rows: Sequence[Record], column: str, across: Axis, down: Axis | None) -> Record:
    """Summarise the records at each place of the map.

    Args:
        column: the column whose largest value is shown.
        down: parameter along the columns, or None.

    Returns:
        ``cells``: worst row, largest value, number of records and shade by (down, across) place; a shade is a
        step of the value's logarithm. ``low`` and ``high``: smallest and largest positive value, or None.

    """

    def place_of(row: Record) -> tuple[int, int]:
        return down.index_of(row[down.name]) if down else 0, across.index_of(row[across.name])

    def size(row: Record) -> float:
        return -math.inf if row[column] is None or math.isnan(row[column]) else float(row[column])

    held = grouped(rows, place_of)
    largest = {place: max(map(size, theirs)) for place, theirs in held.items()}
    logs = {place: math.log10(value) for place, value in largest.items() if 0 < value < math.inf}
    low, high = min(logs.values(), default=0.0), max(logs.values(), default=0.0)
    cells: dict[tuple[int, int], dict[str, Any]] = {}
    for place, theirs in held.items():
        worst = max(theirs, key=lambda row: (severity(row), size(row)))
        value = largest[place]
        part = (logs[place] - low) / (high - low) if place in logs and high > low else 0.0
        cells[place] = {
            "row": worst,
            "value": value if value > -math.inf else None,
            "count": len(theirs),
            "shade": round(part * (SHADE_COUNT - 1)),
        }
    return {"cells": cells, "low": 10**low if logs else None, "high": 10**high if logs else None}
