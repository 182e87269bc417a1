"""The report's coverage tables: how small a mistake in each kind of number the run would report."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path

from plumbline.model.grouping import grouped
from reports.stored_results import Record, study_records


def coverage_tables(folder: Path) -> Record | None:
    """Arrange the coverage of a run for the template.

    Returns:
        Levels, kinds of parameters, the range per kind and level over all scenarios and of each scenario, and
        where nothing can be seen the reasons; None where the folder has no coverage.parquet.

    """
    records = study_records(folder, "coverage")
    if not records:
        return None
    levels, kinds = (list(dict.fromkeys(record[name] for record in records)) for name in ("level", "kind"))
    proven = grouped((r for r in records if r["proof"]), itemgetter("level", "parameter", "proof"))
    return {
        "levels": levels,
        "kinds": kinds,
        "total": _cells(records),
        "scenarios": {name: _cells(some) for name, some in grouped(records, itemgetter("scenario")).items()},
        "proofs": [
            some[0] | {"scenarios": list(dict.fromkeys(r["scenario"] for r in some))}
            for some in proven.values()
        ],
        "count": len(records),
    }


def _cells(records: Sequence[Record]) -> dict[tuple[str, str], Record]:
    """Count entries by level and kind; a smallest mistake that is None is one that is not seen."""
    found = {}
    for cell, some in grouped(records, itemgetter("level", "kind")).items():
        seen = [record["smallest"] for record in some if record["smallest"] is not None]
        least, most = min(seen, default=None), max(seen, default=None)
        found[cell] = {"least": least, "most": most, "seen": len(seen), "count": len(some)}
    return found
