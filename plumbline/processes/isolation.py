"""Processes and folders that do not outlive their owner.

A scratch folder holds a lock file that its owner keeps locked. The system unlocks it however the owner ends,
so that the next owner can remove it. Clocks and process numbers do not matter: another machine or container
may use the same ones.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows: orphaned folders stay there
    fcntl = None  # type: ignore[assignment]

_LOCK_FILE = "owner.lock"
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def die_with_parent(parent: int) -> None:
    """Have Linux kill this process when its parent ends, however that ends; elsewhere do nothing.

    Args:
        parent: process id of the parent.

    """
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent and not Path(f"/proc/{parent}").exists():
        os._exit(1)  # the parent ended before the call


class ScratchFolder:
    """A new temporary folder; making one removes those whose owner has ended.

    Attributes:
        path: the folder.

    """

    def __init__(self, prefix: str = "plumbline-", parent: Path | None = None) -> None:
        """Make the folder.

        Args:
            prefix: beginning of the folder's name.
            parent: folder to make it in; None for the system's temporary folder.

        """
        remove_orphaned_folders(prefix, parent)
        self.path = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
        self._lock: IO[bytes] | None = None
        if fcntl is not None:
            made = self.path / f"{_LOCK_FILE}.new"  # renamed once it is locked
            self._lock = made.open("wb")
            fcntl.flock(self._lock, fcntl.LOCK_EX)
            os.rename(made, self.path / _LOCK_FILE)

    def __enter__(self) -> Path:
        """Return the folder."""
        return self.path

    def __exit__(self, *_: object) -> None:
        """Remove the folder."""
        self.remove()

    def remove(self) -> None:
        """Remove the folder, as far as that is possible."""
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock is not None:
            self._lock.close()


def remove_orphaned_folders(prefix: str, parent: Path | None = None) -> list[Path]:
    """Remove the scratch folders whose owner has ended.

    Args:
        prefix: beginning of the folders' names.
        parent: folder that they are in; None for the system's temporary folder.

    Returns:
        The removed folders.

    """
    removed = []
    locks = Path(parent or tempfile.gettempdir()).glob(f"{prefix}*/{_LOCK_FILE}")
    for lock in locks if fcntl is not None else ():
        with contextlib.suppress(OSError), lock.open("r+b") as file:  # another user's, or just removed
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # OSError: its owner is alive
            shutil.rmtree(lock.parent, ignore_errors=True)
            removed.append(lock.parent)
    return removed
