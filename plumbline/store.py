"""The output folder: results.json and Parquet tables, each written whole or not at all.

Layout (`SCHEMA_VERSION` changes whenever a reader must): results.json, summary.parquet,
states.parquet, convergence.parquet, curves.parquet, trajectories.parquet; see
docs/results.md.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from plumbline.records import Row

SCHEMA_VERSION = 1
TEXT = pa.string()
REAL = pa.float64()
WHOLE = pa.int32()


def _schema(**columns: pa.DataType) -> pa.Schema:
    return pa.schema(list(columns.items()))


_CELL = {"scenario": TEXT, "engine": TEXT}
_RUN = {**_CELL, "integrator": TEXT, "resolution": REAL}
TABLES: dict[str, pa.Schema] = {
    "summary": _schema(
        key=TEXT, scenario=TEXT, family=TEXT, engine=TEXT, engine_version=TEXT, level=TEXT, integrator=TEXT,
        quantity=TEXT, unit=TEXT, value=REAL, tolerance=REAL, verdict=TEXT, reason=TEXT, derivation=TEXT,
        uncertainty=REAL, horizon=REAL, order=REAL, declared_order=WHOLE, alias_of=TEXT, known=TEXT,
        diagnosis=TEXT, accept=REAL, wall_time=REAL, extra=TEXT,
    ),
    "states": _schema(**_CELL, quantity=TEXT, state=WHOLE, body=WHOLE, error=REAL, bound=REAL, scale=REAL),
    "convergence": _schema(**_RUN, quantity=TEXT, error=REAL, cost=REAL, steps=WHOLE, order=REAL),
    "curves": _schema(
        **_RUN, t=REAL, position_error=REAL, attitude_error=REAL, limit_error=REAL, tolerance=REAL,
        energy_drift=REAL, momentum_drift=REAL, joint_gap=REAL, gap_rate=REAL, norm_drift=REAL,
    ),
    "trajectories": _schema(
        **_RUN, t=REAL, body=WHOLE, rx=REAL, ry=REAL, rz=REAL, p0=REAL, p1=REAL, p2=REAL, p3=REAL
    ),
}  # fmt: skip


def write_atomically(path: Path, data: bytes) -> None:
    """Write to a temporary name beside ``path``, flush to the disk, rename; the old file stays on failure."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):  # what stopped the writing may stop this too, and is what to tell
            os.unlink(temporary)
        raise


def plain(value: Any) -> Any:
    """JSON has no NaN or infinity: they become null, everywhere below ``value``."""
    if isinstance(value, float) and not (-float("inf") < value < float("inf")):
        return None
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def row_record(row: Row) -> dict[str, Any]:
    """A row as results.json holds it."""
    return {"key": row.key, **plain(asdict(row))}


def write_table(folder: Path, name: str, records: Sequence[dict[str, Any]]) -> None:
    """One Parquet table: zstd, floats split by byte."""
    schema = TABLES[name]
    table = pa.Table.from_pylist(list(records), schema=schema)
    sink = pa.BufferOutputStream()
    reals = [f.name for f in schema if f.type == REAL]
    texts = [f.name for f in schema if f.type == TEXT]
    pq.write_table(
        table,
        sink,
        compression="zstd",
        use_dictionary=texts,
        column_encoding=dict.fromkeys(reals, "BYTE_STREAM_SPLIT"),
    )
    write_atomically(folder / f"{name}.parquet", sink.getvalue().to_pybytes())


def read_table(folder: Path, name: str) -> list[dict[str, Any]]:
    """The records of one table."""
    records: list[dict[str, Any]] = pq.read_table(folder / f"{name}.parquet").to_pylist()
    return records


def write(
    folder: Path,
    run: dict[str, Any],
    scenarios: dict[str, Any],
    engines: dict[str, Any],
    rows: Sequence[Row],
    tables: dict[str, list[dict[str, Any]]],
) -> None:
    """Write one run's results; ``tables`` by name as in `TABLES`, without the summary."""
    folder.mkdir(parents=True, exist_ok=True)
    records = [row_record(row) for row in rows]
    for name, table in tables.items():
        write_table(folder, name, table)
    write_table(folder, "summary", [{**r, "extra": json.dumps(r["extra"])} for r in records])
    document = {
        "schema_version": SCHEMA_VERSION,
        "run": run,
        "scenarios": scenarios,
        "engines": engines,
        "rows": records,
    }
    # results.json last: its presence says that the folder is complete
    text = json.dumps(plain(document), ensure_ascii=False, indent=1)
    write_atomically(folder / "results.json", text.encode())


def read(folder: Path) -> dict[str, Any]:
    """The document of results.json; ValueError where it is not one of this schema."""
    path = folder / "results.json"
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        found = document["schema_version"]
    except FileNotFoundError:
        raise ValueError(
            f"{path}: no results here; `python -m plumbline run --out {folder}` makes them"
        ) from None
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a results file of plumbline ({error})") from None
    if found != SCHEMA_VERSION:
        raise ValueError(f"{path}: schema_version {found}, this version reads {SCHEMA_VERSION}")
    return document
