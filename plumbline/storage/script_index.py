"""The index of a results folder's reproduction scripts: scripts/index.json, row key → file name."""

from __future__ import annotations

import json
from pathlib import Path

from plumbline.storage.results_schema import DamagedResults
from plumbline.storage.results_store import load_json, write_atomically

MAX_NAME_BYTES = 255  # of a file's name, on most file systems


def scripts_folder(folder: Path) -> Path:
    """Return where stand-alone scripts of a run are kept.

    Args:
        folder: a results folder.

    Returns:
        Where its scripts and their index are, or would be.

    """
    return folder / "scripts"


def read_script_index(folder: Path) -> dict[str, str]:
    """Look up which rows of a run have a stand-alone script.

    Args:
        folder: a results folder.

    Returns:
        File name of the script of each row key that has one; empty where there is no index.

    Raises:
        DamagedResults: the file is not a JSON object of plain file names.

    """
    path = scripts_folder(folder) / "index.json"
    try:
        index = load_json(path)
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise DamagedResults(f"{path}: not readable as JSON ({error}); remove it to go on") from None
    if not isinstance(index, dict) or not all(_is_file_name(name) for name in index.values()):
        raise DamagedResults(f"{path}: not an object of row keys and file names; remove it to go on")
    return index


def write_script_index(folder: Path, index: dict[str, str]) -> None:
    """Write the index; the scripts' folder exists.

    Args:
        folder: a results folder.
        index: file name of the script of each row key.

    """
    data = json.dumps(index, indent=1).encode()
    write_atomically(scripts_folder(folder) / "index.json", data)


def _is_file_name(name: object) -> bool:
    if not isinstance(name, str) or not name.isprintable() or name != Path(name).name:
        return False
    return 0 < len(name.encode()) <= MAX_NAME_BYTES
