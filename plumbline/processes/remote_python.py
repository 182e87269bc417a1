"""Calls made by a Python of another environment, for other versions of engines.

A worker keeps one child process per environment and exchanges pickles with it through its standard input and
output. The child is killed when its worker exits and has the worker's limits; a crash of the child is
reported as a crash of the worker.
"""

from __future__ import annotations

import atexit
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import IO, Any

from plumbline.layout import IS_INSTALLED, ROOT
from plumbline.processes.exceptions import PlumblineError, describe_exception

# Starts the child. An installed `plumbline` is loaded by its path: the packages beside it, which are this
# environment's, must not hide those of the other one.
_START = """
import importlib.util, sys
folder, parent = sys.argv[1:]
if folder:
    spec = importlib.util.spec_from_file_location("plumbline", f"{folder}/__init__.py")
    sys.modules["plumbline"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["plumbline"])
from plumbline.processes.remote_python import serve_parent
serve_parent(int(parent))
"""


class RemoteCrash(PlumblineError):
    """The child ended before it answered; the message says how it ended."""


class RemoteError(PlumblineError):
    """An exception of the child, as text: its class may not exist in this environment."""


def _send(stream: IO[bytes], value: Any) -> None:
    stream.write(pickle.dumps(value, protocol=5))  # all at once: nothing is sent of what cannot be pickled
    stream.flush()


@cache
def _child_process(python: str) -> subprocess.Popen[bytes]:
    """The child of this process for an environment's interpreter, started at first use."""
    return _new_child(python)


def _new_child(python: str) -> subprocess.Popen[bytes]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    folder = str(ROOT) if IS_INSTALLED else ""
    if not IS_INSTALLED:
        environment["PYTHONPATH"] = str(ROOT)
    process = subprocess.Popen(
        [python, "-P", "-c", _START, folder, str(os.getpid())],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment,
    )  # fmt: skip
    atexit.register(process.kill)
    return process


def call_remote(python: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in the child process of another environment.

    Args:
        python: that environment's interpreter.
        function: a function of a module that can be imported there.
        arguments: its positional arguments, which can be pickled.

    Raises:
        RemoteCrash: the child ended before it answered.
        RemoteError: the function raised an exception.
        MemoryError: the function ran out of memory.

    """
    process = _child_process(python)
    try:
        return _ask(process, function, arguments)
    except RemoteCrash:
        _child_process.cache_clear()
        raise


def call_fresh(python: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a new child, which has imported nothing yet; else as `call_remote`."""
    process = _new_child(python)
    try:
        return _ask(process, function, arguments)
    finally:
        process.kill()
        process.wait()


def _ask(process: subprocess.Popen[bytes], function: Callable[..., Any], arguments: Any) -> Any:
    assert process.stdin is not None and process.stdout is not None
    try:
        _send(process.stdin, (function.__module__, function.__qualname__, arguments))
        raised, value = pickle.load(process.stdout)
    except (EOFError, pickle.UnpicklingError, BrokenPipeError):  # it ended, perhaps within its answer
        raise RemoteCrash(describe_exit(process.wait())) from None
    if raised:
        raise RemoteError(value) if value else MemoryError
    return value


def call_timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Call a function and measure the CPU time of this process.

    Args:
        function: any function.

    Returns:
        The function's result and the CPU time [s].

    """
    begin = time.process_time()
    return function(*arguments), time.process_time() - begin


def describe_exit(code: int) -> str:
    """Describe how a process ended.

    Args:
        code: exit code; −n where signal n ended the process.

    Returns:
        A verb phrase, as "died of SIGSEGV" or "exited with code 7".

    """
    if code < 0:
        try:
            return f"died of {signal.Signals(-code).name}"
        except ValueError:
            return f"died of signal {-code}"
    return f"exited with code {code}"


def _accept_arrays_of_numpy_2() -> None:
    """Pickles of NumPy 2 name modules that NumPy 1 has under another name."""
    from importlib.util import find_spec

    if find_spec("numpy._core") and not find_spec("numpy._core.numeric"):
        sys.modules["numpy._core.numeric"] = import_module("numpy.core.numeric")


def serve_parent(parent: int) -> None:
    """Answer the calls of the parent.  Engines print: the pipe leaves descriptor 1 before any is loaded.

    Args:
        parent: its process id; this process ends with it.

    """
    from plumbline.processes.isolation import die_with_parent

    die_with_parent(parent)
    answers = os.fdopen(os.dup(1), "wb")
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    questions = os.fdopen(os.dup(0), "rb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    _accept_arrays_of_numpy_2()
    while True:
        try:
            module, name, arguments = pickle.load(questions)
        except EOFError:
            return
        try:
            answer = False, getattr(import_module(module), name)(*arguments)
        except MemoryError:
            answer = True, ""
        except BaseException as error:  # the engine's own failure
            answer = True, describe_exception(error)
        _send(answers, answer)
