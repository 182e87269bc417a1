"""Parquet files of studies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from plumbline.storage.results_store import to_json_value, write_atomically


def make_table(records: list[dict[str, Any]], schema: pa.Schema) -> pa.Table:
    """Make a table of records; numbers that are not finite become null.

    Args:
        records: one dictionary per row, by column; missing columns are null.

    """
    return pa.Table.from_pylist([to_json_value(record) for record in records], schema=schema)


def write_table(table: pa.Table, path: Path) -> Path:
    """Write a table as Parquet, as a whole or not at all.

    Args:
        path: the file, in an existing folder.

    Returns:
        ``path``.

    """
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    write_atomically(path, sink.getvalue().to_pybytes())
    return path
