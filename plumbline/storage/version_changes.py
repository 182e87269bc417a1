"""Since which version an engine answers so: what `plumbline bisect` found, kept beside the results."""

from __future__ import annotations

import json
from pathlib import Path

from plumbline.storage.results_store import Record, load_json, write_atomically

FILE = "version_changes.json"


def read_version_changes(folder: Path) -> dict[str, Record]:
    """Read what was found of the rows of a results folder.

    Returns:
        By the row's key ``last_before``, ``first_after`` and ``note``; empty where nothing was searched.

    """
    try:
        found: dict[str, Record] = load_json(folder / FILE)
    except (OSError, ValueError):
        return {}
    return found


def add_version_change(folder: Path, key: str, change: Record) -> None:
    """Keep what was found of a row.

    Args:
        change: ``last_before``, ``first_after`` and ``note``.

    """
    text = json.dumps(read_version_changes(folder) | {key: change}, ensure_ascii=False, indent=1)
    write_atomically(folder / FILE, text.encode())
