"""Ways in which code of an engine ends or stops its process; whatever arguments it is called with."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import threading
import time
from typing import Any


class Unprintable(BaseException):
    """Has neither a message nor a representation, and cannot be pickled."""

    def __str__(self) -> str:
        raise RuntimeError

    __repr__ = __reduce__ = __str__  # type: ignore[assignment]


def hang(*_: Any) -> None:
    time.sleep(600)


def hang_in_c(*_: Any) -> None:
    """Native code that never returns and never releases the interpreter lock."""
    ctypes.PyDLL(None).sleep(600)


def segfault(*_: Any) -> None:
    ctypes.string_at(0)


def abort(*_: Any) -> None:
    os.abort()


def exit_0(*_: Any) -> None:
    os._exit(0)


def exit_7(*_: Any) -> None:
    os._exit(7)


def exit_by_c(*_: Any) -> None:
    ctypes.CDLL(None).exit(0)


def exit_by_thread(*_: Any) -> None:
    threading.Thread(target=os._exit, args=(0,)).start()
    time.sleep(600)


def stop_itself(*_: Any) -> None:
    os.kill(os.getpid(), signal.SIGSTOP)
    time.sleep(600)


def interrupt_by_signal(*_: Any) -> None:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(600)


def end_its_group(*_: Any) -> None:
    os.killpg(0, signal.SIGKILL)


def close_descriptors(*_: Any) -> None:
    os.closerange(0, 4096)


def write_everywhere(*_: Any) -> None:
    """Into whichever descriptor it is that the answer goes through."""
    for descriptor in range(3, 4096):
        with contextlib.suppress(OSError):
            os.write(descriptor, b"garbage\n" * 100)
    time.sleep(600)
