"""Stored results, read back: results.json and the Parquet tables of one output folder."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from plumbline.storage.results_store import read_results
from plumbline.storage.script_index import read_script_index, scripts_folder

Record = dict[str, Any]
Columns = dict[str, np.ndarray]

# What neither XML 1.0 nor a reader can show (control characters, lone surrogates, U+FFFE/F) and what
# would turn the text around it (bidirectional controls); all become U+FFFD.
_UNPRINTABLE = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)

# What a run of one level only, or of another program, may leave out.
_RUN_DEFAULTS: Record = {
    "random_batch": {},
    "truth": "",
    "machine": {},
    "commit": None,
    "command": "",
    "platform": "",
    "versions": {},
}
_SCENARIO_DEFAULTS: Record = {
    "horizon": None,
    "truth_uncertainty": None,
    "exact": None,
    "truth": None,
    "file": "",
    "digest": "",
}


def replace_unprintable(value: Any) -> Any:
    """The same value with every unprintable character of every text in it replaced by U+FFFD."""
    if isinstance(value, str):
        plain = value.isascii() and value.isprintable()  # most are, and this is quicker told
        return value if plain else _UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", value)
    if isinstance(value, dict):
        return {replace_unprintable(k): replace_unprintable(v) for k, v in value.items()}
    if isinstance(value, list):
        return [replace_unprintable(v) for v in value]
    return value


@dataclass(frozen=True)
class Results:
    """One run: ``results.json`` read and cleaned, tables on demand."""

    folder: Path
    run: Record
    scenarios: dict[str, Record]
    engines: dict[str, Record]
    rows: list[Record]

    @classmethod
    def load(cls, folder: Path) -> Results:
        """Read OUT/results.json, of any schema version; raises ValueError where it is missing or damaged."""
        stored = replace_unprintable(read_results(folder))
        scenarios = {name: _SCENARIO_DEFAULTS | about for name, about in stored["scenarios"].items()}
        return cls(folder, _RUN_DEFAULTS | stored["run"], scenarios, stored["engines"], stored["rows"])

    def table(self, name: str) -> Columns:
        """Columns of OUT/<name>.parquet as NumPy arrays, texts cleaned; {} where the file is absent."""
        path = self.folder / f"{name}.parquet"
        if not path.exists():
            return {}
        table = pq.read_table(path)
        columns: Columns = {}
        for column in table.column_names:
            values = table[column].to_numpy(zero_copy_only=False)
            columns[column] = _clean_texts(values) if values.dtype == object else values
        return columns

    @cached_property
    def row_indices(self) -> dict[str, list[int]]:
        """Indices of each scenario's rows."""
        found: dict[str, list[int]] = {name: [] for name in self.scenarios}
        for place, row in enumerate(self.rows):
            found[row["scenario"]].append(place)
        return found

    def table_by_scenario(self, name: str) -> dict[str, Columns]:
        """The named table, split by scenario."""
        columns = self.table(name)
        return {
            scenario: {k: values[rows] for k, values in columns.items()}
            for (scenario,), rows in group_rows(columns, "scenario")
        }

    def restricted_to(self, names: Collection[str]) -> Results:
        """The same run with these scenarios alone."""
        kept = {name: about for name, about in self.scenarios.items() if name in names}
        return replace(self, scenarios=kept, rows=[row for row in self.rows if row["scenario"] in kept])

    @cached_property
    def scripts(self) -> dict[str, str]:
        """Stand-alone script of each row key that has one (OUT/scripts/index.json)."""
        folder = scripts_folder(self.folder)
        return {
            replace_unprintable(key): replace_unprintable((folder / name).read_text("utf-8", "replace"))
            for key, name in read_script_index(self.folder).items()
            if (folder / name).is_file()
        }


def _clean_texts(values: np.ndarray) -> np.ndarray:
    known: dict[Any, Any] = {}
    return np.array([known.setdefault(v, replace_unprintable(v)) for v in values.tolist()], dtype=object)


def group_rows(columns: Columns, *by: str) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
    """Row indices of each distinct combination of the named columns, in order of first appearance."""
    if not columns:
        return
    found: dict[tuple[str, ...], list[int]] = {}
    for index, key in enumerate(zip(*(columns[name].tolist() for name in by), strict=True)):
        found.setdefault(key, []).append(index)
    for key, indices in found.items():
        yield key, np.array(indices)
