"""The report's two tables about the reference implementation: drift of its variants, and its cost.

Both are read from the output folder where it holds them, else from the stored copies in ``bench/results``.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path

from plumbline.storage.results_schema import DamagedResults
from reports.stored_results import Record, replace_unprintable, study_records

STORED_RESULTS = Path(__file__).parent.parent / "bench" / "results"
DRIFT_COLUMNS = {  # column: title, unit
    "gap": ("Joint gap", "m"),
    "gap_rate": ("Gap rate", "m/s"),
    "norm": ("|‖p‖ − 1|", ""),
    "energy": ("Energy error", "of m g reach"),
}
PICTURE_TITLES = {
    "work-precision.svg": "CPU time against the error at 2 s, one pendulum: the reference and the engines",
    "work-precision-64.svg": "CPU time against the error at 2 s, 64 in a batch: reference and engines",
}


def drift_table(folder: Path, stored: Path = STORED_RESULTS) -> Record | None:
    """Arrange the drift of the reference's variants for the template.

    Args:
        stored: folder with a stored measurement, used where ``folder`` has none.

    Returns:
        Times, column titles, and a line per variant for each scenario and rtol; None where no folder has a
        drift.parquet.

    """
    place = _first_folder_with("drift.parquet", folder, stored)
    if place is None:
        return None
    records = study_records(place, "drift")
    times = sorted({record["time"] for record in records})
    blocks: dict[tuple[str, float], dict[str, Record]] = {}
    for record in records:
        line = blocks.setdefault((record["scenario"], record["rtol"]), {}).setdefault(
            record["variant"], {"at": {}, "cost": None, "reasons": {}}
        )
        if record["reason"]:
            line["reasons"][record["reason"]] = None
        else:
            line["at"][record["time"]] = record
            line["cost"] = record["cpu_seconds"]
    return {"times": times, "columns": DRIFT_COLUMNS, "blocks": blocks, "stored": place != folder}


def benchmark_table(folder: Path, stored: Path = STORED_RESULTS) -> Record | None:
    """Arrange the measured cost of the reference for the template.

    The pictures are included as images, in which no script can run and from which no request can start.

    Args:
        stored: folder with a stored measurement, used where ``folder`` has none.

    Returns:
        Goals with the measured values, a note on the measurement, and the work–precision pictures as data
        URIs; None where no folder has a figures.json.

    """
    place = _first_folder_with("figures.json", folder, stored)
    if place is None:
        return None
    goals = _stored_goals(place / "figures.json")
    readme = place / "README.md"
    note = (
        replace_unprintable(readme.read_text(encoding="utf-8")).split("\n\n")[0] if readme.is_file() else ""
    )
    return {
        "goals": [goal | {"met": goal["measured"] <= goal["goal"]} for goal in goals],
        "pictures": [
            {"title": title, "uri": _data_uri(place / name)}
            for name, title in PICTURE_TITLES.items()
            if (place / name).is_file()
        ],
        "note": note.replace("`", "") if place != folder else "",
        "stored": place != folder,
    }


def _stored_goals(path: Path) -> list[Record]:
    """Read the goals of figures.json and their measured values; raise DamagedResults where they are none."""
    try:
        goals: list[Record] = replace_unprintable(json.loads(path.read_text(encoding="utf-8"))["goals"])
        kinds = {"what": str, "measured": int | float, "goal": int | float}
        for name, kind in kinds.items():
            if not all(isinstance(goal[name], kind) for goal in goals):
                raise ValueError(f"a goal's {name!r} is of another kind")
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise DamagedResults(f"{path}: not the figures of a benchmark ({error})") from None
    return goals


def _first_folder_with(name: str, *folders: Path) -> Path | None:
    return next((folder for folder in folders if (folder / name).is_file()), None)


def _data_uri(path: Path) -> str:
    return f"data:image/svg+xml;base64,{base64.b64encode(path.read_bytes()).decode()}"
