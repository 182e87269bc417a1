"""Stored results, read back: results.json and the Parquet tables of one output folder."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from plumbline.model.datatypes import Indices, Int
from plumbline.model.grouping import grouped
from plumbline.storage.results_store import read_results, read_table
from plumbline.storage.schema_upgrade import findings_of_records
from plumbline.storage.script_index import read_script_index, scripts_folder

Record = dict[str, Any]
Columns = dict[str, np.ndarray]

# Characters that XML 1.0 cannot hold or nobody can read (control characters, lone surrogates, U+FFFE/F) and
# those that change the direction of the text around them (bidirectional controls); all become U+FFFD.
_UNPRINTABLE = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)


# Of a document as JSON text, which escapes the control characters; another escape may match too.
_UNPRINTABLE_IN_JSON = re.compile(_UNPRINTABLE.pattern + r"|\\[bfru]")


def replace_unprintable(value: Any) -> Any:
    """Replace every unprintable character of every text by U+FFFD.

    Args:
        value: texts, and lists and dictionaries of them, between other values.

    """
    if isinstance(value, str):
        plain = value.isascii() and value.isprintable()  # most are, and this test is faster
        return value if plain else _UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", value)
    if isinstance(value, dict):
        return {replace_unprintable(k): replace_unprintable(v) for k, v in value.items()}
    if isinstance(value, list):
        return [replace_unprintable(v) for v in value]
    return value


@dataclass(frozen=True)
class Results:
    """One stored run: results.json as read, with unprintable characters replaced; tables on demand."""

    folder: Path
    run: Record
    scenarios: dict[str, Record]
    engines: dict[str, Record]
    rows: list[Record]

    @classmethod
    def load(cls, folder: Path, document: Record | None = None) -> Results:
        """Read results.json of any readable schema version.

        Args:
            document: content of the file, where it has been read already.

        Raises:
            DamagedResults: the file is missing or damaged.

        """
        stored = document or read_results(folder)
        if _UNPRINTABLE_IN_JSON.search(json.dumps(stored, ensure_ascii=False)):  # seldom, and far slower
            stored = replace_unprintable(stored)
        return cls(folder, stored["run"], stored["scenarios"], stored["engines"], stored["rows"])

    def table(self, name: str) -> Columns:
        """Read one Parquet table.

        Args:
            name: the file's name without ``.parquet``.

        Returns:
            (n,) arrays by column, with unprintable characters replaced; {} where the file is missing.

        Raises:
            DamagedResults: the file is damaged.

        """
        table = _table_if_any(self.folder, name)
        columns: Columns = {}
        for column in table.column_names if table else ():
            values = table[column].to_numpy(zero_copy_only=False)
            if values.dtype == object:
                texts = values.tolist()
                clean = {text: replace_unprintable(text) for text in set(texts)}
                values = np.array([clean[text] for text in texts], dtype=object)
            columns[column] = values
        return columns

    @cached_property
    def row_indices(self) -> dict[str, list[int]]:
        """Indices of each scenario's rows."""
        found: dict[str, list[int]] = {name: [] for name in self.scenarios}
        for index, row in enumerate(self.rows):
            found[row["scenario"]].append(index)
        return found

    def table_by_scenario(self, name: str) -> dict[str, Columns]:
        """Read one Parquet table and split it by scenario.

        Args:
            name: the file's name without ``.parquet``.

        Returns:
            For each scenario its columns, as `table` returns them.

        """
        columns = self.table(name)
        return {
            scenario: {k: values[rows] for k, values in columns.items()}
            for (scenario,), rows in group_rows(columns, "scenario")
        }

    def restricted_to(self, names: Collection[str]) -> Results:
        """Select some scenarios of the run.

        Args:
            names: scenarios that are kept.

        Returns:
            The run with only those scenarios and their rows.

        """
        kept = {name: about for name, about in self.scenarios.items() if name in names}
        return replace(self, scenarios=kept, rows=[row for row in self.rows if row["scenario"] in kept])

    @cached_property
    def findings(self) -> list[Record]:
        """The rows that do not agree, by cause: those that nothing expects first."""
        return [finding.record() for finding in findings_of_records(self.rows, self.scenarios)]

    @cached_property
    def scripts(self) -> dict[str, str]:
        """Stand-alone script by row key, for the rows that have one."""
        folder = scripts_folder(self.folder)
        return {
            replace_unprintable(key): replace_unprintable((folder / name).read_text("utf-8", "replace"))
            for key, name in read_script_index(self.folder).items()
            if (folder / name).is_file()
        }


def study_records(folder: Path, name: str) -> list[Record]:
    """Read the table of a study, "drift" or "coverage", as records; none where the file is missing.

    Raises:
        DamagedResults: the file is damaged.

    """
    table = _table_if_any(folder, name)
    records: list[Record] = replace_unprintable(table.to_pylist() if table else [])
    return records


def _table_if_any(folder: Path, name: str) -> Any:
    try:
        return read_table(folder, name)
    except FileNotFoundError:
        return None


def group_rows(columns: Columns, *by: str) -> Iterator[tuple[tuple[str, ...], Int[Indices, "records"]]]:
    """Group the records of a table by some of its columns.

    Args:
        columns: arrays by column.

    Yields:
        Each distinct combination of values, in order of first appearance, and the indices of its records.

    """
    if not columns:
        return
    keys = list(zip(*(columns[name].tolist() for name in by), strict=True))
    for key, indices in grouped(range(len(keys)), keys.__getitem__).items():
        yield key, np.array(indices)
