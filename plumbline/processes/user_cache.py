"""The user's cache folder: what can be made again, in files that carry their checksum."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import pickle
import shlex
import stat
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

_CHECKSUM_SIZE = 32  # bytes
_MAX_REMEMBERED_BYTES = 200 * 2**20  # an integrator of thirty bodies takes 9 MB


class DamagedFile(ValueError):
    """The content of a file does not fit its checksum."""


class UntrustedFolder(PermissionError):
    """Another user owns a folder of the cache or can write to it; ``strerror`` says so."""


class CheckedFiles:
    """Files of one folder of the user's cache, each written whole or not at all.

    No file is flushed to the disk: after a power failure, its checksum shows that it is damaged.  It covers
    the file's name too.  Nothing is read from or written to a folder that `check_ownership` refuses.
    """

    def __init__(self, folder: Path) -> None:
        """Name the folder.

        Args:
            folder: made when the first file is written.

        """
        self.folder = folder

    def read(self, name: str) -> bytes | None:
        """Read a file, and note that it was used.

        Returns:
            Its content; None where there is no such file.

        Raises:
            DamagedFile: the content does not fit its checksum.
            OSError: the file cannot be read.

        """
        path = self.folder / name
        try:
            with path.open("rb") as file:
                check_ownership(self.folder)
                _check_owner(path, os.fstat(file.fileno()))
                data = file.read()
        except FileNotFoundError:
            return None
        body = data[_CHECKSUM_SIZE:]
        if _checksum(name, body) != data[:_CHECKSUM_SIZE]:
            raise DamagedFile(f"{path}: damaged")
        with contextlib.suppress(OSError):
            os.utime(path)
        return body

    def write(self, name: str, body: bytes) -> None:
        """Write or replace a file.

        Args:
            body: its content.

        Raises:
            OSError: the file cannot be written.

        """
        make_private_folder(self.folder)
        replace_file(self.folder / name, _checksum(name, body) + body)

    def trim(self, max_bytes: int) -> None:
        """Remove the files that were not used for longest, until the others fit.

        Args:
            max_bytes: what the files may take together.

        """
        found = []
        with contextlib.suppress(OSError):
            check_ownership(self.folder)
            for entry in os.scandir(self.folder):
                with contextlib.suppress(OSError):  # another run may have removed it
                    about = entry.stat()
                    found.append((about.st_mtime, about.st_size, entry.path))
        excess = sum(size for _, size, _ in found) - max_bytes
        for _, size, path in sorted(found):
            if excess <= 0:
                return
            with contextlib.suppress(OSError):
                os.unlink(path)
                excess -= size


def replace_file(path: Path, data: bytes, *, is_public: bool = False) -> None:
    """Replace a file as a whole: write a temporary file beside it, and rename it.

    Args:
        path: the file; its old content stays where writing fails.
        data: its new content.
        is_public: whether others may read it; such a file is flushed to the disk before it is renamed.

    Raises:
        OSError: the file cannot be written.

    """
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with naming_file(path), os.fdopen(handle, "wb") as file:
            file.write(data)
            if is_public:
                file.flush()
                os.fsync(file.fileno())
        if is_public:
            os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):  # the first error is the one to report
            os.unlink(temporary)
        raise


@contextlib.contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Let errors of writing name the file: that of a full disk has no name.

    Args:
        path: the file that is written.

    Yields:
        Nothing.

    """
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def _checksum(name: str, body: bytes) -> bytes:
    return hashlib.sha256(name.encode() + b"\0" + body).digest()


def make_private_folder(folder: Path) -> None:
    """Make a folder of the user's cache, in which only the user may write; raise OSError where others may."""
    for part in _parts_in_cache(folder, user_cache_folder()):
        part.parent.mkdir(parents=True, exist_ok=True)
        part.mkdir(mode=0o700, exist_ok=True)
    check_ownership(folder)


def check_ownership(folder: Path) -> None:
    """Raise `UntrustedFolder` if another user may have written to a folder of the cache.

    Some files of the cache are code, and all of them are answers that are believed.
    """
    for part in _parts_in_cache(folder, user_cache_folder()):
        _check_owner(part, part.stat())


def describe_failure(error: OSError, folder: Path) -> str:
    """Describe why a folder of the user's cache cannot be used, and where another one is named."""
    place = folder if error.filename is None else error.filename
    return f"{place}: {error.strerror} (the variable PLUMBLINE_CACHE names another folder for the cache)"


@cache
def _parts_in_cache(folder: Path, top: Path) -> list[Path]:
    """The cache folder ``top`` and those in it that lead to ``folder``; a folder elsewhere alone."""
    if not folder.is_relative_to(top):
        return [folder]
    return [part for part in (*reversed(folder.parents), folder) if part.is_relative_to(top)]


def _check_owner(path: Path, about: os.stat_result) -> None:
    if os.name == "nt":
        return
    if about.st_uid not in (os.geteuid(), 0):
        reason = f"it belongs to another user (number {about.st_uid})"
    elif about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        reason = f"other users may write to it; `chmod go-w {shlex.quote(str(path))}` ends that"
    else:
        return
    raise UntrustedFolder(errno.EPERM, reason, str(path))


def user_cache_folder() -> Path:
    """Locate the user's cache folder.

    Returns:
        The folder of the variable PLUMBLINE_CACHE, else ``plumbline`` in the platform's cache folder; it need
        not exist.

    """
    if given := os.environ.get("PLUMBLINE_CACHE"):
        return Path(given)
    if os.name == "nt":
        home = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    else:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "plumbline"


def content_key(*parts: bytes | str) -> str:
    """Make the name under which a value is remembered.

    Args:
        *parts: everything that the value depends on, the code that makes it included.

    """
    digest = hashlib.sha256()
    for part in parts:
        body = part.encode() if isinstance(part, str) else part
        digest.update(b"%d\n" % len(body) + body)
    return digest.hexdigest()


def recall(key: str, is_fit: Callable[[Any], bool] = lambda _: True) -> Any:
    """Read a remembered value.

    Args:
        key: of `content_key`.
        is_fit: whether a value is one that was remembered under this key.

    Returns:
        The value; None where there is none, or none that can be read.

    """
    try:
        body = _remembered().read(key)
        value = None if body is None else pickle.loads(body)
        return value if is_fit(value) else None
    except Exception:  # damaged, or of another version of what made it: it is made again
        return None


def remember(key: str, value: Any) -> None:
    """Store a value for later processes; where that fails, they make it again.

    Args:
        key: of `content_key`.
        value: a value that can be pickled.

    """
    with contextlib.suppress(OSError):
        _remembered().write(key, pickle.dumps(value, protocol=5))
        _remembered().trim(_MAX_REMEMBERED_BYTES)


def _remembered() -> CheckedFiles:
    return CheckedFiles(user_cache_folder() / "remembered")
