"""Engines of other versions: a task's call made by a Python of another environment.

Inside a worker, `call` keeps one child per environment, ``python -m plumbline.processes.remote_python``,
and talks to it through its standard input and output in frames: a length of 8 bytes, then a pickle. The
child is in the worker's process group of fate: it dies with the worker, has its limits, and what kills
it is told as if the worker had died of it.
"""

from __future__ import annotations

import atexit
import os
import pickle
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any

from plumbline.processes.errors import PlumblineError

ROOT = Path(__file__).resolve().parents[2]
FRAME_LENGTH = struct.Struct("<Q")


class RemoteCrash(PlumblineError):
    """The child ended before it answered; the message says how."""


class RemoteError(PlumblineError):
    """What was raised in the child: class and words, its own class may not exist here."""


def send_frame(stream: IO[bytes], value: Any) -> None:
    """One frame."""
    body = pickle.dumps(value, protocol=5)
    stream.write(FRAME_LENGTH.pack(len(body)))
    stream.write(body)
    stream.flush()


def receive_frame(stream: IO[bytes]) -> Any:
    """One frame; EOFError where the other side has gone."""
    head = stream.read(FRAME_LENGTH.size)
    if len(head) < FRAME_LENGTH.size:
        raise EOFError
    (size,) = FRAME_LENGTH.unpack(head)
    body = stream.read(size)
    if len(body) < size:
        raise EOFError
    return pickle.loads(body)


@cache
def child_process(python: str) -> subprocess.Popen[bytes]:
    """The child of this process for an environment's interpreter, started at first use."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    process = subprocess.Popen(
        [python, "-P", "-m", "plumbline.processes.remote_python", str(os.getpid())],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        env={**environment, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    atexit.register(process.kill)
    return process


def call_remote(python: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """``function(*arguments)`` in the child; raises Elsewhere or Crashed."""
    process = child_process(python)
    assert process.stdin is not None and process.stdout is not None
    try:
        send_frame(process.stdin, (function.__module__, function.__qualname__, arguments))
        raised, value = receive_frame(process.stdout)
    except (EOFError, BrokenPipeError):
        child_process.cache_clear()
        raise RemoteCrash(describe_exit(process.wait())) from None
    if raised:
        if value[0] == "MemoryError":
            raise MemoryError
        raise RemoteError(": ".join(value))
    return value


def call_timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """``function(*arguments)``, and the CPU time in s that this process spent on it."""
    begin = time.process_time()
    return function(*arguments), time.process_time() - begin


def describe_exit(code: int) -> str:
    """An exit code in words: the signal's name where one ended the process."""
    if code < 0:
        try:
            return f"died of {signal.Signals(-code).name}"
        except ValueError:
            return f"died of signal {-code}"
    return f"exited with code {code}"


def serve_calls(parent: int) -> None:
    """The child's loop.  Engines print: the pipe moves away from descriptor 1 before any is loaded."""
    from plumbline.processes.isolation import die_with_parent

    die_with_parent(parent)
    answers = os.fdopen(os.dup(1), "wb")
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    questions = os.fdopen(os.dup(0), "rb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    while True:
        try:
            module, name, arguments = receive_frame(questions)
        except EOFError:
            return
        try:
            answer = False, getattr(import_module(module), name)(*arguments)
        except Exception as error:
            answer = True, (type(error).__name__, str(error))
        send_frame(answers, answer)


if __name__ == "__main__":
    serve_calls(int(sys.argv[1]))
