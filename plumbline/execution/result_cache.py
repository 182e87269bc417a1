"""Finished cells of an unfinished run on disk: killed at any moment, the same command resumes.

A cell is one task's answer before it is judged, in OUT/cells/HASH.cell.  The hash covers everything that the
answer depends on: the call and its arguments (model, states, times, steps, integrator), the engine's version,
this project's code and the libraries under it.  A file is the SHA-256 of the rest, then a pickle, written
whole or not at all; the cell of a damaged file is reported and runs again.  Loading a pickle can run any
code: share results, never this folder.
"""

from __future__ import annotations

import hashlib
import pickle
import platform
import shutil
import struct
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from plumbline.processes.workers import Outcome, Pickled, ResultCache, Task
from plumbline.storage.results_store import write_atomically

ROOT = Path(__file__).resolve().parents[2]
_HASHED_PACKAGES = ("plumbline", "adapters", "reference_impl")
_HASHED_LIBRARIES = ("numpy", "scipy", "python-flint")  # of truth and reference; engines have their versions


class DiskResultCache(ResultCache):
    """The finished cells of one output folder."""

    def __init__(self, folder: Path, log: Callable[[str], None] = lambda _: None) -> None:
        """Open the cache.

        Args:
            folder: folder of the cells, made when the first one is written.
            log: called with a sentence about each damaged file.

        """
        self._folder, self._log = folder, log
        self._pending_paths: dict[Any, Path] = {}  # of running tasks, by their keys

    def cell_path(self, task: Task) -> Path:
        """Locate the answer to a task.

        Args:
            task: any task; its key does not matter.

        Returns:
            The path of its file, which need not exist.

        """
        return self._folder / f"{task_hash(task)}.cell"

    def get(self, task: Task) -> Outcome | None:
        """Read a stored answer.

        Args:
            task: the call to look up.

        Returns:
            The outcome, or None where there is no undamaged file.

        """
        path = self._pending_paths[task.key] = self.cell_path(task)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            self._log(f"{path}: cannot be read ({error.strerror}); the cell runs again")
            return None
        if hashlib.sha256(data[32:]).digest() != data[:32]:
            self._log(f"{path}: damaged; the cell runs again")
            return None
        del self._pending_paths[task.key]
        answer, cost = pickle.loads(data[32:])
        return Outcome(task.key, Pickled(answer), cpu_time=cost)

    def put(self, task: Task, outcome: Outcome) -> None:
        """Write an answer to disk, except a failure, whose cause may have been the machine.

        Args:
            task: the call that was made.
            outcome: its answer.

        Raises:
            OSError: the file cannot be written.

        """
        path = self._pending_paths.pop(task.key, None) or self.cell_path(task)
        if outcome.failure is None:
            self._folder.mkdir(parents=True, exist_ok=True)
            body = pickle.dumps((outcome.pickled.data, outcome.cpu_time), protocol=5)
            write_atomically(path, hashlib.sha256(body).digest() + body)

    def clear(self) -> None:
        """Remove all cells, after the run has been stored."""
        shutil.rmtree(self._folder, ignore_errors=True)


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
    name = f"{task.function.__module__}.{task.function.__qualname__}"
    for part in (_environment_fingerprint(), name, task.version, task.arguments):
        _update_hash(digest, part)
    return digest.hexdigest()


@cache
def _environment_fingerprint() -> str:
    """Hash the project's code, the interpreter, the libraries and the kind of machine."""
    digest = hashlib.sha256()
    for folder in _HASHED_PACKAGES:
        for path in sorted((ROOT / folder).rglob("*.py")):
            _update_hash(digest, (path.relative_to(ROOT).as_posix(), path.read_bytes()))
    _update_hash(digest, (sys.version, platform.machine(), *map(_installed_version, _HASHED_LIBRARIES)))
    return digest.hexdigest()


def _installed_version(package: str) -> str:
    """A distribution's version, empty where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


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
            head, body = "packed", value.data
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
