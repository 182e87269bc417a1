"""The index of a results folder's reproduction scripts: scripts/index.json, row key → file name."""

from __future__ import annotations

import json
import re
from pathlib import Path

from plumbline.storage.results_schema import DamagedResults
from plumbline.storage.results_store import load_json, write_atomically

# Letters, digits and a few signs, as the scripts are named; file systems allow 255 bytes for a name.
_SCRIPT_NAME = re.compile(r"[\w-][\w.-]{0,250}\.py", re.ASCII)


def scripts_folder(folder: Path) -> Path:
    """Return where stand-alone scripts of a run are kept.

    Returns:
        Where its scripts and their index are, or would be.

    """
    return folder / "scripts"


def script_name(text: str) -> str:
    """Return a file name of safe characters for a script.

    Args:
        text: what the script is about; any text.

    Returns:
        Its letters, digits and signs, shortened, with the ending .py; different texts may have one name.

    """
    return f"{re.sub(r'[^A-Za-z0-9._-]+', '-', text).strip('-.')[:100] or 'script'}.py"


def read_script_index(folder: Path) -> dict[str, str]:
    """Look up which rows of a run have a stand-alone script.

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
    if not isinstance(index, dict) or not all(_is_script_name(name) for name in index.values()):
        raise DamagedResults(f"{path}: not an object of row keys and file names; remove it to go on")
    return index


def write_script_index(folder: Path, index: dict[str, str]) -> None:
    """Write the index; the scripts' folder exists.

    Args:
        index: file name of the script of each row key.

    """
    data = json.dumps(index, indent=1).encode()
    write_atomically(scripts_folder(folder) / "index.json", data)


def _is_script_name(name: object) -> bool:
    return isinstance(name, str) and _SCRIPT_NAME.fullmatch(name) is not None
