"""Answers and folders that several tests share, where it is not their making that is tested."""

from __future__ import annotations

import fcntl
import hashlib
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest


def by_content(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its answers kept by the content of the arguments."""
    known: dict[bytes, Any] = {}

    def call(*arguments: Any, **options: Any) -> Any:
        try:
            key = hashlib.sha256(pickle.dumps((arguments, options))).digest()
        except (AttributeError, pickle.PicklingError):  # a function among the arguments
            return function(*arguments, **options)
        if key not in known:
            known[key] = function(*arguments, **options)
        return known[key]

    return call


@contextmanager
def sharing(module: str, *names: str) -> Iterator[None]:
    """Keep the answers of functions that a module calls by these names."""
    with ExitStack() as stack:
        for name in names:
            stack.enter_context(patch(f"{module}.{name}", by_content(getattr(import_module(module), name))))
        yield


def folder_made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], Any]) -> Path:
    """A copy of a folder that the processes of pytest-xdist make once."""
    base = factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, unfinished = base / name, base / f"{name}.unfinished"
    with (base / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # until the file is closed
        if not folder.exists():
            shutil.rmtree(unfinished, ignore_errors=True)
            make(unfinished)
            unfinished.rename(folder)
    return shutil.copytree(folder, factory.mktemp("shared") / name)
