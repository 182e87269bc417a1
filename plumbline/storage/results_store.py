"""The output folder of a run: results.json and Parquet tables, each written as a whole or not at all.

Files (`SCHEMA_VERSION` changes whenever a reader has to): results.json, summary.parquet,
states.parquet, convergence.parquet, curves.parquet, trajectories.parquet; see
docs/results.md.
"""

from __future__ import annotations

import json
import re
import stat
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from plumbline.judging.findings import find_findings
from plumbline.judging.rows import Columns, Row
from plumbline.processes.user_cache import replace_file
from plumbline.scenario.line_and_column_errors import shorten
from plumbline.storage.results_schema import DamagedResults, check_results
from plumbline.storage.schema_upgrade import Record as Record
from plumbline.storage.schema_upgrade import upgrade_document, upgrade_summary

SCHEMA_VERSION = 6
READABLE_VERSIONS = (1, 2, 3, 4, 5, 6)
_PLAIN_TYPES = (str, type(None), int, bool)
TEXT = pa.string()
REAL = pa.float64()
INTEGER = pa.int32()
ROW_GROUP_SIZE = 8_192  # records encoded together: what waits is small


def _schema(**columns: pa.DataType) -> pa.Schema:
    return pa.schema(list(columns.items()))


_CELL_COLUMNS = {"scenario": TEXT, "engine": TEXT}
_RUN_COLUMNS = {**_CELL_COLUMNS, "integrator": TEXT, "resolution": REAL}
TABLES: dict[str, pa.Schema] = {
    "summary": _schema(
        key=TEXT, scenario=TEXT, family=TEXT, engine=TEXT, engine_version=TEXT, level=TEXT, integrator=TEXT,
        quantity=TEXT, unit=TEXT, value=REAL, tolerance=REAL, verdict=TEXT, reason=TEXT, ratio=REAL,
        derivation=TEXT, uncertainty=REAL, compared_until=REAL, order=REAL, declared_order=INTEGER,
        alias_of=TEXT, known_issue=TEXT, is_declared=pa.bool_(), diagnosis=TEXT, causes=TEXT, user_rtol=REAL,
        cpu_time=REAL, extra=TEXT,
    ),
    "states": _schema(
        **_CELL_COLUMNS, quantity=TEXT, state=INTEGER, body=INTEGER, error=REAL, bound=REAL, scale=REAL,
    ),
    "convergence": _schema(**_RUN_COLUMNS, quantity=TEXT, error=REAL, cost=REAL, steps=INTEGER, order=REAL),
    "curves": _schema(
        **_RUN_COLUMNS, t=REAL, position_error=REAL, attitude_error=REAL, limit_error=REAL, tolerance=REAL,
        energy_drift=REAL, momentum_drift=REAL, joint_gap=REAL, gap_rate=REAL, norm_drift=REAL,
    ),
    "trajectories": _schema(
        **_RUN_COLUMNS, t=REAL, body=INTEGER, rx=REAL, ry=REAL, rz=REAL, p0=REAL, p1=REAL, p2=REAL, p3=REAL
    ),
}  # fmt: skip
DRIFT_TABLE = _schema(
    scenario=TEXT,
    variant=TEXT,
    rtol=REAL,
    time=REAL,  # s, the errors are the largest over [0, time]
    gap=REAL,  # m; null, with a reason, where the run was left out or failed
    gap_rate=REAL,  # m/s
    norm=REAL,  # |‖p‖ − 1|
    energy=REAL,  # |E − E(0)| over Σ m g reach; null with loads or drag
    steps=pa.int64(),
    cpu_seconds=REAL,  # of the run, to this time in proportion
    reason=TEXT,
)
COVERAGE_TABLE = _schema(
    scenario=TEXT,
    level=TEXT,
    body=INTEGER,  # from 1; 0 for gravity
    joint=TEXT,
    kind=TEXT,
    parameter=TEXT,
    value=REAL,  # in ``unit``
    unit=TEXT,
    scale=REAL,  # in ``unit``
    smallest=REAL,  # over ``scale``; null where the level sees no mistake
    engine=TEXT,
    row=TEXT,
    proof=TEXT,
)
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
_STUDIES = {"drift": DRIFT_TABLE, "coverage": COVERAGE_TABLE}  # tables beside those of a run
_NEVER_NULL = {  # columns by which readers group and sort
    "key", "scenario", "family", "engine", "level", "integrator", "quantity", "verdict", "state", "body",
    "variant", "rtol", "time", "reason", "kind", "parameter", "proof",
}  # fmt: skip
# What is made of results.json after it has been written; see `write_results`.
_MADE_OF_RESULTS = (
    "report.html",
    "junit.xml",
    "summary.md",
    "findings.sarif",
    "scripts/index.json",
    "scripts/*.py",
    "model.json",  # of `plumbline model`, whose results a folder has instead of those of a run
    "model.html",
    "model.sarif",
)


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file as a whole: write a temporary file beside it, flush it to the disk, rename it.

    Args:
        path: the file; its old content stays where writing fails.
        data: its new content.

    Raises:
        OSError: the file cannot be written.

    """
    replace_file(path, data, is_public=True)


def to_json_value(value: Any) -> Any:
    """Replace what JSON cannot hold: NaN and infinity become None.

    Args:
        value: numbers, texts, and lists and dictionaries of them.

    Returns:
        The same structure, tuples as lists, keys as texts.

    """
    if type(value) in _PLAIN_TYPES:  # nearly all: this runs for every field of every row
        return value
    if isinstance(value, float):
        return value if -float("inf") < value < float("inf") else None
    if isinstance(value, dict):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_value(item) for item in value]
    return value


def row_record(row: Row) -> Record:
    """Convert a row to its entry in results.json.

    Args:
        row: any judged row.

    Returns:
        The fields of `Row` and the row's ``key``.

    """
    return {
        "key": row.key,
        **{name: to_json_value(value) for name, value in vars(row).items()},
    }


class ResultTables:
    """The tables of a run as Parquet files in memory; ten thousand cells take a few megabytes.

    Compressed with zstd, floats split by byte, in row groups of `ROW_GROUP_SIZE` records.
    """

    def __init__(self) -> None:
        """Start with empty tables."""
        self._waiting: dict[str, list[tuple[int, Columns]]] = {}  # number of records, and their columns
        self._files: dict[str, tuple[pa.BufferOutputStream, pq.ParquetWriter]] = {}

    def add(self, name: str, columns: Columns) -> None:
        """Add records to a table.

        Args:
            name: a key of `TABLES`.
            columns: every column of that table; equal numbers of values, or one value of all records.

        """
        count = next((len(c) for c in columns.values() if isinstance(c, list | np.ndarray)), 1)
        waiting = self._waiting.setdefault(name, [])
        waiting.append((count, columns))
        if sum(count for count, _ in waiting) >= ROW_GROUP_SIZE:
            self._encode(name)

    def add_rows(self, rows: Iterable[Row]) -> None:
        """Add rows to the summary.

        Args:
            rows: any judged rows.

        """
        records = [row_record(row) for row in rows]
        columns: Columns = {name: [record[name] for record in records] for name in TABLES["summary"].names}
        for name in ("causes", "extra"):
            columns[name] = list(map(json.dumps, columns[name]))
        self.add("summary", columns)

    def _encode(self, name: str) -> None:
        """Write the waiting records; column by column, since most tables that are added are small."""
        schema, waiting = TABLES[name], self._waiting.pop(name, [])
        if name not in self._files:
            sink = pa.BufferOutputStream()
            writer = pq.ParquetWriter(
                sink,
                schema,
                compression="zstd",
                use_dictionary=[f.name for f in schema if f.type == TEXT],
                column_encoding={f.name: "BYTE_STREAM_SPLIT" for f in schema if f.type == REAL},
                write_page_checksum=True,
            )
            self._files[name] = sink, writer
        arrays = [
            _joined_column([(count, c[field.name]) for count, c in waiting], field.type) for field in schema
        ]
        self._files[name][1].write_table(pa.Table.from_arrays(arrays, schema=schema), ROW_GROUP_SIZE)

    def write_parquet(self, folder: Path) -> None:
        """Write every table; nothing can be added afterwards.

        Args:
            folder: gets a file NAME.parquet per table.

        Raises:
            OSError: a file cannot be written.

        """
        for name in TABLES:
            if name in self._waiting or name not in self._files:
                self._encode(name)
            sink, writer = self._files[name]
            writer.close()
            write_atomically(folder / f"{name}.parquet", sink.getvalue().to_pybytes())


def _joined_column(parts: Sequence[tuple[int, Any]], kind: pa.DataType) -> pa.Array:
    """Join the values of a column, of which a part has one value of all its records, or a list or array."""
    if parts and all(isinstance(values, np.ndarray) for _, values in parts):
        return pa.array(np.concatenate([values for _, values in parts]), kind)
    values: list[Any] = []
    for count, part in parts:
        values += part if isinstance(part, list | np.ndarray) else [part] * count
    return pa.array(values, kind)


def read_table(folder: Path, name: str) -> pa.Table:
    """Read one table of a run, or the table of `plumbline drift` in its folder.

    Args:
        name: a key of `TABLES`, or ``drift``.

    Returns:
        The table; a summary with the names of the present schema version.

    Raises:
        FileNotFoundError: the file is missing.
        OSError: the file cannot be read.
        DamagedResults: the file is damaged, or lacks a column.

    """
    path = folder / f"{name}.parquet"
    schema = _STUDIES.get(name) or TABLES[name]
    try:
        _check_is_regular(path)
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read()
        table.validate(full=True)
        table = upgrade_summary(table) if name == "summary" else table
    except (pa.ArrowException, OSError, ValueError, LookupError, TypeError) as error:
        if isinstance(error, OSError) and error.errno:  # Arrow's own errors of this kind have no number
            raise
        raise DamagedResults(f"{path}: is damaged: {shorten(' '.join(str(error).split()), 200)}") from None
    for field in schema:
        if field.name not in table.column_names:
            raise DamagedResults(
                f"{path}: has no column {field.name}; valid would be {', '.join(schema.names)}"
            )
        column = table[field.name]
        if column.type != field.type:
            raise DamagedResults(
                f"{path}: {field.name}: is of type {column.type}; valid would be {field.type}"
            )
        if field.name in _NEVER_NULL and column.null_count:
            raise DamagedResults(f"{path}: {field.name}: has empty values; valid would be {field.type}")
    return table


def write_results(
    folder: Path,
    run: Record,
    scenarios: Record,
    engines: Record,
    rows: Sequence[Row],
    tables: ResultTables,
) -> None:
    """Write the results of one run.

    An earlier run in the folder is removed first, results.json before all else, and the new results.json is
    written last: a folder that has it is complete, and a folder never mixes two runs.

    Args:
        folder: output folder, made where it is missing.
        scenarios: model, truth and description by scenario.
        engines: description by engine.
        tables: the Parquet tables, whose summary may have more rows than results.json (of random scenarios).

    Raises:
        OSError: a file cannot be written.

    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").unlink(missing_ok=True)
    for pattern in (*_MADE_OF_RESULTS, ".*.parquet.*", ".*.json.*"):  # and temporary files of a killed run
        for path in folder.glob(pattern):
            path.unlink(missing_ok=True)
    tables.write_parquet(folder)
    head = {"schema_version": SCHEMA_VERSION, "run": run, "scenarios": scenarios, "engines": engines}
    found = find_findings(rows, {name: about["bodies"] for name, about in scenarios.items()})
    document = {
        **to_json_value(head),
        "findings": to_json_value([finding.record() for finding in found]),
        "rows": [row_record(row) for row in rows],
    }
    text = json.dumps(document, ensure_ascii=False)  # an indent takes the encoder in Python
    write_atomically(folder / "results.json", text.encode())


def read_model_results(folder: Path) -> Record:
    """Read what `plumbline model --out` wrote.

    Returns:
        The content of model.json: options, and of each file its rows.

    Raises:
        DamagedResults: the file is missing or damaged.

    """
    path = folder / "model.json"
    texts = ("key", "scenario", "engine", "verdict", "reason")
    try:
        document = load_json(path)
        rows = [row for file in document["files"] for row in file["rows"]]
        sound = all(isinstance(row[name], str) for row in rows for name in texts)
        about = document["options"]
        sound &= about["base"] in ("auto", "fixed", "free") and isinstance(about["strip_geometry"], bool)
        sound &= isinstance(about["root"], str | None)
    except (OSError, ValueError, KeyError, TypeError) as error:
        found = shorten(f"{type(error).__name__}: {error}", 200)
        raise DamagedResults(f"{path}: no results of `plumbline model` ({found})") from None
    if not sound:
        raise DamagedResults(f"{path}: no results of `plumbline model`: a row or an option is damaged")
    return document  # type: ignore[no-any-return]


def load_json(path: Path) -> Any:
    """Read a JSON file; surrogates without their other half, which no other file can hold, become "?".

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no regular file, or no JSON.

    """
    _check_is_regular(path)
    text = path.read_text(encoding="utf-8")
    document = json.loads(text)
    if _SURROGATE.search(text):
        document = json.loads(json.dumps(document, ensure_ascii=False).encode("utf-8", "replace"))
    return document


def _check_is_regular(path: Path) -> None:
    """Raise ValueError for what is no regular file: a pipe would wait, a device never end."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise ValueError("it is not a regular file")


def read_results(folder: Path) -> Record:
    """Read results.json, of any readable schema version.

    Returns:
        The document, with the names of the present schema version.

    Raises:
        DamagedResults: the file is missing, damaged or of another version.
        OSError: the file cannot be read.

    """
    path = folder / "results.json"
    try:
        document = load_json(path)
        version = document["schema_version"]
        if version in READABLE_VERSIONS:
            document = upgrade_document(document)
    except (FileNotFoundError, NotADirectoryError):
        raise DamagedResults(
            f"{path}: no results here, or not completely written; `python -m plumbline run --out {folder}` "
            "makes them"
        ) from None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        found = shorten(f"{type(error).__name__}: {error}", 200)
        raise DamagedResults(f"{path}: not a results file of plumbline ({found})") from None
    if version not in READABLE_VERSIONS:
        raise DamagedResults(
            f"{path}: schema_version {shorten(repr(version))}, this version reads {SCHEMA_VERSION}"
        )
    check_results(path, document)
    return document  # type: ignore[no-any-return]
