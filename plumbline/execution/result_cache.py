"""Finished cells of an unfinished run: killed at any moment, the same command goes on where it stopped.

A cell is one task's raw answer, before any verdict, kept as OUT/cells/KEY.cell.  KEY is a hash of all
that determines the answer: the call and its arguments (model, states, times, steps, integrator), the
engine's version, this project's code and the libraries under it.  A file is the SHA-256 of the rest,
then a pickle, written whole or not at all; one that is damaged is named, and its cell runs again.
Pickles are code to whoever reads them: share results, never this folder.
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
HASHED_PACKAGES = ("plumbline", "adapters", "reference_impl")
HASHED_LIBRARIES = (
    "numpy",
    "scipy",
    "python-flint",
)  # of the truth and the notes; engines name their own version


class DiskResultCache(ResultCache):
    """The cells of one output folder; ``tell`` gets a sentence about each damaged file."""

    def __init__(self, folder: Path, log: Callable[[str], None] = lambda _: None) -> None:
        self.folder, self.tell = folder, log
        self._pending_paths: dict[Any, Path] = {}  # of tasks that are on their way, by their keys

    def cell_path(self, task: Task) -> Path:
        """Where the answer to ``task`` is or will be."""
        return self.folder / f"{task_hash(task)}.cell"

    def get(self, task: Task) -> Outcome | None:
        """The stored answer, or None where there is none that can be trusted."""
        path = self._pending_paths[task.key] = self.cell_path(task)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            self.tell(f"{path}: cannot be read ({error.strerror}); the cell runs again")
            return None
        if hashlib.sha256(data[32:]).digest() != data[:32]:
            self.tell(f"{path}: damaged; the cell runs again")
            return None
        del self._pending_paths[task.key]
        answer, cost = pickle.loads(data[32:])
        return Outcome(task.key, Pickled(answer), cpu_time=cost)

    def put(self, task: Task, outcome: Outcome) -> None:
        """Keep an answer.  A lost cell is not kept: what killed it may have been the machine."""
        path = self._pending_paths.pop(task.key, None) or self.cell_path(task)
        if outcome.failure is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            body = pickle.dumps((outcome.pickled.data, outcome.cpu_time), protocol=5)
            write_atomically(path, hashlib.sha256(body).digest() + body)

    def clear(self) -> None:
        """Forget all: the run is complete, the next one begins anew."""
        shutil.rmtree(self.folder, ignore_errors=True)


def task_hash(task: Task) -> str:
    """The content hash of a task."""
    digest = hashlib.sha256()
    name = f"{task.function.__module__}.{task.function.__qualname__}"
    for part in (environment_fingerprint(), name, task.version, task.arguments):
        update_hash(digest, part)
    return digest.hexdigest()


@cache
def environment_fingerprint() -> str:
    """Hash of the project's code, the interpreter, the libraries and the kind of machine."""
    digest = hashlib.sha256()
    for folder in HASHED_PACKAGES:
        for path in sorted((ROOT / folder).rglob("*.py")):
            update_hash(digest, (path.relative_to(ROOT).as_posix(), path.read_bytes()))
    update_hash(digest, (sys.version, platform.machine(), *map(installed_version, HASHED_LIBRARIES)))
    return digest.hexdigest()


def installed_version(package: str) -> str:
    """A distribution's version, empty where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def update_hash(digest: Any, value: Any) -> None:
    """Feed a value to a hash, unambiguously: every part is preceded by its kind and size."""
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
                update_hash(digest, item)
            return
        case dict():
            digest.update(f"dict {len(value)}\n".encode())
            for item in value.items():
                update_hash(digest, item)
            return
        case _ if is_dataclass(value) and not isinstance(value, type):
            digest.update(f"{type(value).__name__} {len(fields(value))}\n".encode())
            for field in fields(value):
                update_hash(digest, (field.name, getattr(value, field.name)))
            return
        case _:
            raise TypeError(f"no content hash of a {type(value).__name__}")
    digest.update(f"{head} {len(body)}\n".encode())
    digest.update(body)
