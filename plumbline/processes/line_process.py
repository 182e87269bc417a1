"""A program that answers lines: JSON on its standard input and output, one line each way (protocol 1).

The program runs without a shell, in a session of its own, with a short list of environment variables, in the
working folder of its worker. It ends with the worker; Linux kills it where the worker is killed.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import re
import shlex
import subprocess
import threading
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from plumbline.processes.exceptions import PlumblineError, one_line
from plumbline.processes.isolation import die_with_parent, kill_tree
from plumbline.processes.remote_python import describe_exit
from plumbline.processes.worker_environment import KERNELS, SINGLE_THREAD, TEMPORARY_FOLDER

COMMAND_PREFIX = "cmd:"
Message = dict[str, Any]  # the fields of a question or an answer, as JSON has them
_VARIABLE = re.compile(r"[A-Za-z_]\w*=.*", re.DOTALL)
MAX_LINE = 2**26  # bytes of an answer
MAX_SHOWN = 200  # characters of a line or of the last words, in messages
SECONDS_TO_END = 2.0  # after its input was closed, or its output
INHERITED = ("PATH", "HOME", "LANG", "LC_ALL", "SYSTEMROOT", *TEMPORARY_FOLDER, *SINGLE_THREAD, *KERNELS)


class BadSpecification(PlumblineError):
    """An engine of the user cannot be what its specification says; the message says why."""


def split_command(specification: str) -> tuple[tuple[str, ...], dict[str, str]]:
    """Split a specification with `cmd:` into program and arguments, and environment variables before them.

    Raises:
        BadSpecification: there is no program, or a quotation mark is not closed.

    """
    try:
        words = shlex.split(specification.removeprefix(COMMAND_PREFIX))
    except ValueError as error:
        raise BadSpecification(f"{specification!r}: {error}") from None
    count = next((i for i, word in enumerate(words) if not _VARIABLE.fullmatch(word)), len(words))
    if count == len(words):
        raise BadSpecification(f"{specification!r} names no program")
    return tuple(words[count:]), dict(word.split("=", 1) for word in words[:count])


class LineFault(PlumblineError):
    """The program broke the protocol or ended; the message is a verb phrase about it."""


class LineProcess:
    """A running program, asked one question at a time; after a fault it has ended."""

    def __init__(self, command: Sequence[str], variables: Mapping[str, str]) -> None:
        """Start the program.

        Args:
            command: program and arguments.
            variables: environment variables besides `INHERITED`.

        Raises:
            LineFault: it cannot be started.

        """
        inherited = {name: os.environ[name] for name in INHERITED if name in os.environ}
        owner = os.getpid()
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                env=inherited | dict(variables), start_new_session=True,
                preexec_fn=(lambda: _prepare(owner)) if os.name == "posix" else None,
            )  # fmt: skip
        except (OSError, ValueError, subprocess.SubprocessError) as error:
            raise LineFault(f"cannot be started: {error}") from None
        self._words = b""  # the last ones on its standard error
        self._number = 0
        self._reader = threading.Thread(target=self._read_errors, daemon=True)
        self._reader.start()
        atexit.register(self.end)

    def _read_errors(self) -> None:
        """Keep the end of what the program writes besides its answers; a full pipe would stop it."""
        assert self._process.stderr is not None
        while block := self._process.stderr.read1(2**16):  # type: ignore[attr-defined]
            self._words = (self._words + block)[-4 * MAX_SHOWN :]

    def ask(self, question: Message) -> Message:
        """Send a question and wait for its answer; the worker's time limit ends the waiting.

        Args:
            question: fields, without the number of the question.

        Returns:
            The fields of the answer.

        Raises:
            LineFault: the program ended, or its line is not the answer to this question.

        """
        self._number += 1
        text = json.dumps({"id": self._number, **question}, allow_nan=False, separators=(",", ":"))
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # the reason is found below
            self._process.stdin.write(text.encode() + b"\n")
            self._process.stdin.flush()
        line = self._process.stdout.readline(MAX_LINE + 1)
        if not line.endswith(b"\n"):
            self._fail(f"wrote a line of more than {MAX_LINE} bytes" if len(line) > MAX_LINE else "")
        try:
            answer = json.loads(line.decode(), parse_constant=_refuse, parse_int=_whole_number)
        except (ValueError, RecursionError) as error:
            self._fail(f"wrote {_shown(line)} instead of an answer: {one_line(str(error))[:MAX_SHOWN]}")
        if not isinstance(answer, dict) or answer.get("id") != self._number:
            self._fail(f"wrote {_shown(line)}, which is no answer with the id {self._number}")
        return answer

    @property
    def has_ended(self) -> bool:
        """Whether the program has ended, or was ended."""
        return self._process.poll() is not None

    def _fail(self, fault: str) -> NoReturn:
        """End the program, and raise what it did, or how it ended."""
        if not fault:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(SECONDS_TO_END)
            code = self._process.poll()
            fault = "closed its output" if code is None else describe_exit(code)
        self.end()
        words = self._words.decode(errors="replace").strip().splitlines()
        raise LineFault(f"{fault}: {one_line(words[-1])[:MAX_SHOWN]}" if words else fault)

    def end(self) -> None:
        """End the program and all that it has started."""
        atexit.unregister(self.end)
        with contextlib.suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        kill_tree(self._process.pid)
        self._process.wait()
        self._reader.join(SECONDS_TO_END)  # a process that it left may hold the pipe


def _prepare(owner: int) -> None:
    """Bind the program to its worker; data count against the memory limit, not reserved addresses.

    Java and JAX reserve more address space than they use.
    """
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_DATA, (soft, soft))
    die_with_parent(owner)


def _refuse(word: str) -> NoReturn:
    raise ValueError(f"{word} is not a number")


def _whole_number(text: str) -> float:
    """−0.0 is "-0" in the decimals of C."""
    return -0.0 if text == "-0" else int(text)


def _shown(line: bytes) -> str:
    text = one_line(line.decode(errors="replace").strip())
    return repr(text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…")
