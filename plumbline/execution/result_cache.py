"""Finished cells on disk: an unchanged cell is not computed again, and a killed run goes on where it stopped.

A cell is one task's answer and what its judge returned, in FOLDER/HASH.cell.  The hash covers everything that
they depend on: the calls and their arguments (model, states, times, steps, integrator, truth), the engine's
version, and what `plumbline.execution.environment_fingerprint` lists.  A file is a checksum, then two records
(`plumbline.processes.record_encoding`), written whole or not at all; a damaged file is reported, and its cell
runs again.  Where the folder cannot be used, the run goes on without it and says so once.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import struct
import types
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from plumbline.execution.environment_fingerprint import environment_fingerprint
from plumbline.judging.rows import JudgingResult
from plumbline.processes.record_encoding import EncodedRecord, UnfitRecord, decode_record, encode_record
from plumbline.processes.user_cache import (
    CheckedFiles,
    DamagedFile,
    content_key,
    describe_failure,
    user_cache_folder,
)
from plumbline.processes.worker_pool import Outcome, Packed, ResultCache, Task

MAX_BYTES = 2 * 2**30  # of the cells that runs share
MAX_UNFINISHED_NIGHTS = 4  # that keep their cells
_SIZE = struct.Struct("<Q")


class DiskResultCache(ResultCache):
    """The finished cells of one folder."""

    def __init__(
        self, folder: Path, log: Callable[[str], None] = lambda _: None, *, is_fresh: bool = False
    ) -> None:
        """Open the cache.

        Args:
            folder: folder of the cells, made when the first one is written.
            log: called with a sentence about each damaged file, and where the folder cannot be used.
            is_fresh: whether cells of earlier runs are computed again.

        """
        self._files, self._log, self._is_fresh = CheckedFiles(folder), log, is_fresh
        self._is_off = False  # the folder cannot be read or written, or is not the user's own
        self._names: dict[Any, str] = {}  # files of running tasks, by their keys

    @property
    def holds_everything(self) -> bool:
        """Whether all cells that were finished so far are on disk."""
        return not self._is_off

    def get(self, task: Task) -> Outcome | None:
        """Read a stored answer.

        Returns:
            The outcome, or None where there is no undamaged file.

        """
        if self._is_off:
            return None
        name = self._names[task.key] = _file_name(task)
        try:
            body = None if self._is_fresh else self._files.read(name)
            outcome = None if body is None else _decode_outcome(task, body)
        except (DamagedFile, UnfitRecord) as error:
            damage = (
                error if isinstance(error, DamagedFile) else f"{self._files.folder / name}: damaged ({error})"
            )
            self._log(f"{damage}; the cell runs again")
            return None
        except OSError as error:
            self._switch_off(error, "used")
            return None
        if outcome is not None:
            del self._names[task.key]
        return outcome

    def put(self, task: Task, outcome: Outcome) -> Outcome:
        """Write an answer to disk, except a failure, whose cause may have been the machine.

        Args:
            task: the call that was made.

        Returns:
            The outcome as `get` will return it, but not marked as cached.

        """
        if self._is_off or outcome.failure is not None or outcome.judge_failure:
            self._names.pop(task.key, None)
            return outcome
        name = self._names.pop(task.key, None) or _file_name(task)
        try:
            body = _encode_outcome(outcome)
            stored = _decode_outcome(task, body)
        except UnfitRecord:  # an answer of another type than the call promises is judged, but not kept
            return outcome
        try:
            self._files.write(name, body)
        except OSError as error:
            self._switch_off(error, "written")
        return replace(outcome, raw_value=stored.raw_value, judge_result=stored.judge_result)

    def _switch_off(self, error: OSError, what: str) -> None:
        self._is_off = True
        reason = describe_failure(error, self._files.folder)
        self._log(f"the result cache cannot be {what}, the run goes on without it: {reason}")

    def clear(self) -> None:
        """Remove all cells, after the run has been stored."""
        shutil.rmtree(self._files.folder, ignore_errors=True)

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


def night_cells_folder(token: str) -> Path:
    """Locate the cells of an unfinished night, and remove those of nights that were left unfinished long ago.

    Args:
        token: identifies the night; any text.

    Returns:
        The folder; it need not exist.

    """
    place = user_cache_folder() / "nights"
    with contextlib.suppress(OSError):
        nights = sorted(place.iterdir(), key=lambda folder: folder.stat().st_mtime)
        folder = place / content_key(token)
        for old in [night for night in nights if night != folder][:-MAX_UNFINISHED_NIGHTS]:
            shutil.rmtree(old, ignore_errors=True)
    return place / content_key(token)


def _encode_outcome(outcome: Outcome) -> bytes:
    """The answer as a record, preceded by its size; then the call's CPU time and what the judge returned."""
    answer = b"" if outcome.raw_value is None else encode_record(outcome.value)
    return _SIZE.pack(len(answer)) + answer + encode_record((outcome.cpu_time, outcome.judge_result))


def _decode_outcome(task: Task, body: bytes) -> Outcome:
    """Read what `_encode_outcome` wrote; raise UnfitRecord if the task has no such answer."""
    if len(body) < _SIZE.size:
        raise UnfitRecord("too short")
    end = _SIZE.size + _SIZE.unpack_from(body)[0]
    answer = EncodedRecord(body[_SIZE.size : end], returned_type(task.function)) if end > _SIZE.size else None
    hint = returned_type(task.judge) if task.judge else None
    cost, judged = decode_record(body[end:], tuple[float, hint])  # type: ignore[valid-type]
    if answer is None and (task.judge is None or task.needs_answer is None or task.needs_answer(judged)):
        raise UnfitRecord("there is no answer")
    if answer is not None:
        answer.check()
    if isinstance(judged, JudgingResult) and not all(map(_is_table, judged.tables)):
        raise UnfitRecord("columns of a table differ in length")
    return Outcome(task.key, answer, cpu_time=cost, judge_result=judged, is_cached=True)


def _is_table(table: tuple[str, dict[str, Any]]) -> bool:
    return len({len(column) for column in table[1].values() if isinstance(column, list | np.ndarray)}) <= 1


@cache
def returned_type(function: Callable[..., Any]) -> Any:
    """The type that a function is annotated to return; other annotations need not be known at run time."""
    returned = types.SimpleNamespace(__annotations__={"return": function.__annotations__.get("return")})
    return get_type_hints(returned, function.__globals__)["return"]


def _file_name(task: Task) -> str:
    return f"{task_hash(task)}.cell"


def task_hash(task: Task) -> str:
    """Hash everything that a task's answer depends on.

    Args:
        task: any task; key and limits do not count.

    Returns:
        The SHA-256 as hexadecimal text.

    Raises:
        UnfitRecord: an argument is of a type without an encoding.

    """
    arguments = [
        [one.digest if isinstance(one, Packed) else one for one in some]
        for some in (task.arguments, task.judge_arguments)
    ]
    functions = (task.function, task.judge, task.needs_answer)
    names = [f"{one.__module__}.{one.__qualname__}" if one else "" for one in functions]
    parts = environment_fingerprint(task.python), task.version, task.python, names, arguments
    return hashlib.sha256(encode_record(parts)).hexdigest()
