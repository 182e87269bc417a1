"""The report's coverage tables: how small a mistake in each kind of number the run would report."""

from __future__ import annotations

from pathlib import Path

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
    scenarios: dict[str, dict[tuple[str, str], Record]] = {}
    total: dict[tuple[str, str], Record] = {}
    proofs: dict[tuple[str, str, str], dict[str, None]] = {}
    for record in records:
        cell = record["level"], record["kind"]
        _add(scenarios.setdefault(record["scenario"], {}), cell, record["smallest"])
        _add(total, cell, record["smallest"])
        if record["proof"]:
            key = record["level"], record["parameter"], record["proof"]
            proofs.setdefault(key, {})[record["scenario"]] = None
    return {
        "levels": levels,
        "kinds": kinds,
        "total": total,
        "scenarios": scenarios,
        "proofs": [
            {"level": level, "parameter": parameter, "proof": proof, "scenarios": list(names)}
            for (level, parameter, proof), names in proofs.items()
        ],
        "count": len(records),
    }


def _add(cells: dict[tuple[str, str], Record], cell: tuple[str, str], smallest: float | None) -> None:
    """Count an entry; a smallest mistake that is None is one that is not seen."""
    found = cells.setdefault(cell, {"least": None, "most": None, "seen": 0, "count": 0})
    found["count"] += 1
    if smallest is None:
        return
    found["seen"] += 1
    found["least"] = smallest if found["least"] is None else min(found["least"], smallest)
    found["most"] = smallest if found["most"] is None else max(found["most"], smallest)
