"""One killable process per engine, kept for the session: a crash or a hang of an engine fails one test."""

from __future__ import annotations

import atexit
from collections.abc import Callable
from functools import cache
from typing import Any

from plumbline.engines.adapter import Adapter
from plumbline.engines.registry import load_adapter
from plumbline.processes.worker_pool import Limits, Task, WorkerPool

TIMEOUT = 60.0  # s


class ProcessLost(Exception):
    """The process ended or was killed; the message says why."""


def call_adapter(
    engine: str,
    method: str,
    *args: Any,
    overrides: dict[str, Callable[..., Any]] | None = None,
    timeout: float = TIMEOUT,
) -> Any:
    """``adapter(engine).method(*args)`` in the engine's own process; what it raises is raised here.

    ``tamper`` replaces methods of the adapter by functions of (its own method, *args), to see
    what the contract's checks make of it.  Raises ProcessLost when the process dies or must be
    killed; the next call gets a new process.
    """
    return run_in_engine_process(engine, _call_method, engine, method, args, overrides or {}, timeout=timeout)


def adapter_attribute(engine: str, name: str) -> Any:
    """A class attribute of the adapter, read in its own process."""
    return run_in_engine_process(engine, _attribute, engine, name)


def run_in_engine_process(
    engine: str, function: Callable[..., Any], *args: Any, timeout: float = TIMEOUT
) -> Any:
    """Any picklable function in the engine's process."""
    task = Task(0, _call_and_catch, (function, *args), Limits(timeout), engine=engine)
    (outcome,) = _pool().run([task])
    if outcome.failure:
        raise ProcessLost(outcome.failure)
    error, value = outcome.value
    if error is not None:
        raise error
    return value


def _call_and_catch(function: Callable[..., Any], *args: Any) -> tuple[Exception | None, Any]:
    try:
        return None, function(*args)
    except Exception as error:
        return error, None


@cache
def _pool() -> WorkerPool:
    pool = WorkerPool(1)
    atexit.register(pool.__exit__, None, None, None)
    return pool


@cache
def _adapter(engine: str) -> Adapter:
    return load_adapter(engine)


def _call_method(
    engine: str, method: str, args: tuple[Any, ...], overrides: dict[str, Callable[..., Any]]
) -> Any:
    planted_adapter = _adapter(engine)
    if overrides:
        planted_adapter = _with_overrides(planted_adapter, overrides)
    return getattr(planted_adapter, method)(*args)


def _attribute(engine: str, name: str) -> Any:
    return getattr(_adapter(engine), name)


def _with_overrides(real: Adapter, overrides: dict[str, Callable[..., Any]]) -> Adapter:
    """An instance of a subclass of the real adapter in which some methods pass through a tampering hand."""

    def wrap(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda self, *args: function(lambda *a: getattr(real, name)(*a), *args)

    members = {name: wrap(name, function) for name, function in overrides.items()}
    doctored: Adapter = type("Doctored", (type(real),), members)()
    return doctored
