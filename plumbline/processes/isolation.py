"""Processes, folders and locks that do not outlive their owner.

An owner keeps a lock file locked. The system unlocks it however the owner ends, so that the next owner can
take or remove what it guards. Clocks and process numbers do not matter: another machine or container may use
the same ones.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import errno
import os
import pickle
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import IO, Self, TypeVar

from plumbline.processes.exceptions import PlumblineError

try:
    import fcntl
except ImportError:  # Windows: orphaned folders stay there
    fcntl = None  # type: ignore[assignment]

T = TypeVar("T")
_LOCK_FILE = "owner.lock"
_RANDOM_NAME = "[a-z0-9_]" * 8  # what mkdtemp adds to a prefix
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36  # linux/prctl.h
_PROC = Path("/proc")


def die_with_parent(parent: int, number: int = 9) -> None:
    """Have Linux send this process a signal when its parent ends, however that ends; elsewhere do nothing.

    Args:
        parent: process id of the parent.
        number: the signal; 9 kills.

    """
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent and not (_PROC / str(parent)).exists():
        os._exit(1)  # the parent ended before the call


class EndedEarly(PlumblineError):
    """A process ended before it had an answer."""


def call_in_fork(call: Callable[[], T]) -> T:
    """Call in a process of its own, so that a crash ends nothing else; in this one where there is no fork.

    Raises:
        EndedEarly: the call raised, or ended the process.

    """
    if not hasattr(os, "fork"):
        return call()
    parent, (read, write) = os.getpid(), os.pipe()
    if not (child := os.fork()):
        code = 1
        with contextlib.suppress(BaseException):
            die_with_parent(parent)
            with open(write, "wb") as stream:
                pickle.dump(call(), stream)
            code = 0
        os._exit(code)
    os.close(write)
    with open(read, "rb") as stream:
        sent = stream.read()
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code < 0:
        raise EndedEarly(f"crashed: the process died of {signal.Signals(-code).name}")
    if code:
        raise EndedEarly("the process ended without an answer")
    answer: T = pickle.loads(sent)
    return answer


def adopt_orphans() -> None:
    """Become the parent of descendants whose parent ends, on Linux; and when ended, kill all descendants."""

    def end(*_: object) -> None:
        kill_orphans(os.getpid(), ())
        os._exit(1)

    signal.signal(signal.SIGTERM, end)
    atexit.register(kill_orphans, os.getpid(), ())
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1)


def kill_tree(pid: int) -> None:
    """Kill a process that leads a session, that session and all descendants; some may end on the way."""
    found = _descendants(pid)
    with contextlib.suppress(OSError, AttributeError):
        os.killpg(pid, signal.SIGKILL)
    for one in (pid, *found):
        with contextlib.suppress(OSError):
            os.kill(one, signal.SIGKILL)


def kill_orphans(reaper: int, spared: Collection[int]) -> None:
    """Kill the children of a process and their descendants, again until no new one has appeared.

    Args:
        reaper: process id of one that adopts orphans.
        spared: those of its children that are none.

    """
    killed: set[int] = set()
    while found := [pid for pid in _descendants(reaper, spared) if pid not in killed]:
        for pid in found:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        killed.update(found)


def _descendants(pid: int, spared: Collection[int] = ()) -> list[int]:
    """The processes below one, parents first, where Linux lists them; without the spared ones and theirs."""
    children: dict[int, list[int]] = {}
    for path in _PROC.glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            parent = path.read_bytes().rpartition(b")")[2].split()[1]
            children.setdefault(int(parent), []).append(int(path.parent.name))
    found = [pid]
    for one in found:
        found += [child for child in children.get(one, ()) if child not in spared]
    return found[1:]


class LockHeld(PlumblineError):
    """Another process holds the lock."""


class FileLock:
    """A lock file, held until it is released or its process ends."""

    def __init__(self, path: Path) -> None:
        """Make the file where it is missing, and lock it.

        Raises:
            LockHeld: another process holds it.
            OSError: the file cannot be made.

        """
        self._path = path
        while True:
            self._file = path.open("ab")
            try:
                _try_lock(self._file)
                if self._is_in_place():
                    return
            except BlockingIOError:
                self._file.close()
                raise LockHeld(str(path)) from None
            self._file.close()  # its last owner removed the file after it was opened here

    def _is_in_place(self) -> bool:
        """Whether the locked file is the one that its path names."""
        with contextlib.suppress(FileNotFoundError):
            return os.path.samestat(os.fstat(self._file.fileno()), self._path.stat())
        return False

    def __enter__(self) -> Self:
        """Return the lock."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the lock."""
        self.release()

    def release(self) -> None:
        """Remove the file, as far as that is possible, and unlock it."""
        with contextlib.suppress(OSError):
            self._path.unlink()
        self._file.close()


def _try_lock(file: IO[bytes]) -> None:
    """Lock a file where the file system has locks; raise BlockingIOError if another process holds it."""
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
                raise


class ScratchFolder:
    """A new temporary folder; making one removes those whose owner has ended.

    Attributes:
        path: the folder.

    """

    def __init__(self, prefix: str = "plumbline-", parent: Path | None = None) -> None:
        """Make the folder.

        Args:
            parent: folder to make it in; None for the system's temporary folder.

        """
        remove_orphaned_folders(prefix, parent)
        while True:
            self.path = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
            try:
                self._lock = FileLock(self.path / _LOCK_FILE)
                return
            except (FileNotFoundError, LockHeld):
                pass  # another process took the folder for an orphan, as it was not locked yet

    def __enter__(self) -> Path:
        """Return the folder."""
        return self.path

    def __exit__(self, *_: object) -> None:
        """Remove the folder."""
        self.remove()

    def remove(self) -> None:
        """Remove the folder, as far as that is possible."""
        shutil.rmtree(self.path, ignore_errors=True)
        self._lock.release()


def remove_orphaned_folders(prefix: str, parent: Path | None = None) -> list[Path]:
    """Remove the scratch folders whose owner has ended.

    Args:
        parent: folder that they are in; None for the system's temporary folder.

    """
    removed = []
    folders = Path(parent or tempfile.gettempdir()).glob(f"{prefix}{_RANDOM_NAME}")
    for folder in folders if fcntl is not None else ():
        with contextlib.suppress(OSError, LockHeld):  # of another user, alive, just removed, or none of ours
            if (folder / _LOCK_FILE).exists():
                with FileLock(folder / _LOCK_FILE):
                    shutil.rmtree(folder, ignore_errors=True)
            else:
                folder.rmdir()  # an owner that ended before it locked the folder left it empty
            removed.append(folder)
    return removed
