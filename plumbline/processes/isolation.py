"""Folders that go with their owner: a process that is killed leaves its own behind, the next one removes it.

A folder holds a lock file that its owner keeps locked, and the system unlocks it however the owner ends:
no clock and no process number decides, which another machine or container may use again.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows: nothing is swept there
    fcntl = None  # type: ignore[assignment]

LOCK_FILE = "owner.lock"


class ScratchFolder:
    """A new folder ``path`` in ``parent`` (default: the temporary folder); those of dead owners go first."""

    def __init__(self, prefix: str = "plumbline-", parent: Path | None = None) -> None:
        remove_orphaned_folders(prefix, parent)
        self.path = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
        self._lock: IO[bytes] | None = None
        if fcntl is not None:
            made = self.path / f"{LOCK_FILE}.new"  # it gets its name when it is locked, not before
            self._lock = made.open("wb")
            fcntl.flock(self._lock, fcntl.LOCK_EX)
            os.rename(made, self.path / LOCK_FILE)

    def __enter__(self) -> Path:
        """The folder."""
        return self.path

    def __exit__(self, *_: object) -> None:
        """Remove it."""
        self.remove()

    def remove(self) -> None:
        """Remove the folder, as far as that is possible."""
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock is not None:
            self._lock.close()


def remove_orphaned_folders(prefix: str, parent: Path | None = None) -> list[Path]:
    """Remove the folders whose owner is no more, and return them."""
    removed = []
    for lock in (
        Path(parent or tempfile.gettempdir()).glob(f"{prefix}*/{LOCK_FILE}") if fcntl is not None else ()
    ):
        with contextlib.suppress(OSError), lock.open("r+b") as file:  # another user's, or just removed
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # OSError: its owner lives
            shutil.rmtree(lock.parent, ignore_errors=True)
            removed.append(lock.parent)
    return removed
