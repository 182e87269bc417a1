"""Finished cells on disk: an unchanged cell is not computed again, and a killed run goes on where it stopped.

A cell is one task's answer and what its judge returned, in FOLDER/HASH.cell.  The hash covers everything that
they depend on: the calls and their arguments (model, states, times, steps, integrator, truth), the engine's
version, this project's code below `execution`, and the files that can be imported.  A file is the SHA-256 of
the rest, then a pickle, written whole or not at all; the cell of a damaged file is reported and runs again.
Loading a pickle can run any code: share results, never this folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import shutil
import struct
import sys
import sysconfig
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from plumbline.processes.processor import processor_features
from plumbline.processes.user_cache import CheckedFiles, DamagedFile, user_cache_folder
from plumbline.processes.workers import Outcome, Pickled, ResultCache, Task

ROOT = Path(__file__).resolve().parents[2]
_HASHED_PACKAGES = ("plumbline", "adapters", "reference_impl")
# Tasks call functions of the packages below these; tests/architecture checks that those import none of them.
_UNHASHED_PACKAGES = ("plumbline/cli", "plumbline/execution", "plumbline/reproduce", "plumbline/storage",
                      "plumbline/studies")  # fmt: skip
# never read by an import; half of the files that are installed
_SOURCES_OF_COMPILERS = (".hpp", ".hxx", ".ipp", ".h", ".c", ".cpp", ".f90", ".pxd", ".pyi", ".cmake")
MAX_BYTES = 2 * 2**30  # of the cells that runs share


class DiskResultCache(ResultCache):
    """The finished cells of one folder."""

    def __init__(
        self, folder: Path, log: Callable[[str], None] = lambda _: None, *, is_fresh: bool = False
    ) -> None:
        """Open the cache.

        Args:
            folder: folder of the cells, made when the first one is written.
            log: called with a sentence about each damaged file.
            is_fresh: whether cells of earlier runs are computed again.

        """
        self._folder, self._log, self._is_fresh = folder, log, is_fresh
        self._files = CheckedFiles(folder)
        self._names: dict[Any, str] = {}  # files of running tasks, by their keys

    def get(self, task: Task) -> Outcome | None:
        """Read a stored answer.

        Args:
            task: the call to look up.

        Returns:
            The outcome, or None where there is no undamaged file.

        """
        name = self._names[task.key] = _file_name(task)
        try:
            body = None if self._is_fresh else self._files.read(name)
        except DamagedFile as error:
            self._log(f"{error}; the cell runs again")
            return None
        except OSError as error:
            self._log(f"{self._files.path(name)}: cannot be read ({error.strerror}); the cell runs again")
            return None
        if body is None:
            return None
        del self._names[task.key]
        answer, cost, judged = pickle.loads(body)
        return Outcome(
            task.key, None if answer is None else Pickled(answer), cpu_time=cost, judge_result=judged,
            is_cached=True,
        )  # fmt: skip

    def put(self, task: Task, outcome: Outcome) -> None:
        """Write an answer to disk, except a failure, whose cause may have been the machine.

        Args:
            task: the call that was made.
            outcome: its answer.

        Raises:
            OSError: the file cannot be written.

        """
        name = self._names.pop(task.key, None) or _file_name(task)
        if outcome.failure is None and not outcome.judge_failure:
            answer = None if outcome.raw_value is None else outcome.pickled.data
            content = answer, outcome.cpu_time, outcome.judge_result
            self._files.write(name, pickle.dumps(content, protocol=5))

    def clear(self) -> None:
        """Remove all cells, after the run has been stored."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def trim(self, max_bytes: int = MAX_BYTES) -> None:
        """Remove the cells that were not used for longest, until the others fit.

        Args:
            max_bytes: what the cells may take together.

        """
        self._files.trim(max_bytes)


def user_cells_folder() -> Path:
    """Locate the cells that the user's runs share.

    Returns:
        The folder; it need not exist.

    """
    return user_cache_folder() / "cells"


def _file_name(task: Task) -> str:
    return f"{task_hash(task)}.cell"


def task_hash(task: Task) -> str:
    """Hash everything that a task's answer depends on.

    Args:
        task: any task; key and limits do not count.

    Returns:
        The SHA-256 as hexadecimal text.

    Raises:
        TypeError: an argument is of a type without a defined hash.

    """
    digest = hashlib.sha256()
    parts = _function_name(task.function), task.version, task.python, task.arguments
    judge = _function_name(task.judge), task.judge_arguments, _function_name(task.needs_answer)
    for part in (_environment_fingerprint(), *parts, *judge):
        _update_hash(digest, part)
    return digest.hexdigest()


def _function_name(function: Callable[..., Any] | None) -> str:
    return f"{function.__module__}.{function.__qualname__}" if function else ""


@cache
def _environment_fingerprint() -> str:
    """Hash the project's code, the interpreter, what can be imported, and the processor."""
    digest = hashlib.sha256()
    for folder in _HASHED_PACKAGES:
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            if not name.startswith(_UNHASHED_PACKAGES):
                _update_hash(digest, (name, path.read_bytes()))
    _update_hash(digest, (sys.version, processor_features(), *_importable_files()))
    return digest.hexdigest()


def _importable_files() -> list[tuple[str, int, int]]:
    """Name, size and time of change [ns] of every file below the folders that Python imports from.

    An engine may be built again under the same version, patched where it is installed, or replaced by a
    module on PYTHONPATH; none of that changes the versions of what is installed.  The standard library
    belongs to the interpreter's version; of this checkout the code that tasks call is hashed by content.
    """
    standard = {os.path.realpath(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")}
    skipped = {*standard, *(os.path.join(path, "lib-dynload") for path in standard)}
    folders = [path for path in map(os.path.realpath, sys.path) if path not in skipped]
    seen, found = set(skipped), []
    while folders:
        folder = folders.pop()
        if folder in seen:
            continue
        seen.add(folder)
        with contextlib.suppress(OSError), os.scandir(folder) as entries:
            for entry in entries:
                if not entry.is_dir():
                    if entry.name.endswith(_SOURCES_OF_COMPILERS):
                        continue
                    about = entry.stat()
                    found.append((entry.path, about.st_size, about.st_mtime_ns))
                elif entry.name != "__pycache__" and folder != str(ROOT):
                    folders.append(entry.path)
    return sorted(found)


def _update_hash(digest: Any, value: Any) -> None:
    """Add a value to a hash, unambiguously: every part is preceded by its kind and size."""
    match value:
        case None:
            head, body = "none", b""
        case bool() | int():
            head, body = "int", str(int(value)).encode()
        case float():
            head, body = "float", struct.pack("<d", value)
        case str():
            head, body = "str", value.encode()
        case bytes():
            head, body = "bytes", value
        case Pickled():
            head, body = "packed", value.digest
        case np.ndarray():
            head, body = f"array {value.dtype.str} {value.shape}", np.ascontiguousarray(value).tobytes()
        case list() | tuple():
            digest.update(f"list {len(value)}\n".encode())
            for item in value:
                _update_hash(digest, item)
            return
        case dict():
            digest.update(f"dict {len(value)}\n".encode())
            for item in value.items():
                _update_hash(digest, item)
            return
        case _ if is_dataclass(value) and not isinstance(value, type):
            digest.update(f"{type(value).__name__} {len(fields(value))}\n".encode())
            for field in fields(value):
                _update_hash(digest, (field.name, getattr(value, field.name)))
            return
        case _:
            raise TypeError(f"no content hash of a {type(value).__name__}")
    digest.update(f"{head} {len(body)}\n".encode())
    digest.update(body)
