"""The report's coverage tables: how small a mistake in each kind of number the run would report."""

from __future__ import annotations

from pathlib import Path

from reports.stored_results import Record, Results


def coverage_tables(folder: Path) -> Record | None:
    """Arrange the coverage of a run for the template.

    Returns:
        Levels, kinds of parameters, the range per kind and level over all scenarios and of each scenario, and
        where nothing can be seen the reasons; None where the folder has no coverage.parquet.

    """
    table = Results(folder, {}, {}, {}, []).table("coverage")
    if not table or not len(table["level"]):
        return None
    columns = {name: values.tolist() for name, values in table.items()}
    records = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    levels, kinds = (list(dict.fromkeys(columns[name])) for name in ("level", "kind"))
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
    """Count an entry; a smallest mistake that is not a number, or None, is one that is not seen."""
    found = cells.setdefault(cell, {"least": None, "most": None, "seen": 0, "count": 0})
    found["count"] += 1
    if smallest is None or smallest != smallest:
        return
    found["seen"] += 1
    found["least"] = smallest if found["least"] is None else min(found["least"], smallest)
    found["most"] = smallest if found["most"] is None else max(found["most"], smallest)
