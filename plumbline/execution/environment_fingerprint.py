"""What answers depend on besides their task: code, installed files, variables and the processor, as one hash.

The files that tasks import from this checkout are hashed by content.  Of the ten thousand others path, size
and times are hashed.  No program can set the time at which a file's inode changed last (ctime): a file that
is patched and given its old time, or replaced by another of its size, differs too.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.machinery import all_suffixes
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from plumbline.layout import IS_INSTALLED, ROOT
from plumbline.processes.processor import processor_features
from plumbline.processes.worker_environment import hashed_environment

_OWN_FOLDERS = (
    [ROOT] if IS_INSTALLED else [ROOT / name for name in ("plumbline", "adapters", "reference_impl")]
)
_HASHED_BY_CONTENT = frozenset(map(str, _OWN_FOLDERS))
# Tasks call functions of the packages below these; tests/architecture checks that those import none of them.
_UNHASHED_PACKAGES = ("cli", "execution", "storage", "studies", "judging/known_issues.yaml",
                      "reports", "scenarios", "bench")  # fmt: skip
_UNIMPORTED_FOLDERS = {"tests", "reports", "bench", "tools"}  # of the checkout, by tasks
# never read by an import; half of the files that are installed
_SOURCES_OF_COMPILERS = (".hpp", ".hxx", ".ipp", ".h", ".c", ".cpp", ".f90", ".pxd", ".pyi", ".cmake")
_UNREAD_FOLDERS = {"__pycache__", ".git"}
_LIBRARY_FOLDERS = ("LD_", "DYLD_")  # variables whose folders the dynamic linker searches

_FileIdentity = tuple[str, int, int, int]  # path, size, times of change of content and inode [ns]


@cache
def environment_fingerprint(python: str) -> str:
    """Hash what every answer of this process's tasks depends on.

    Args:
        python: interpreter of another environment that makes the calls; empty: that of this process.

    Returns:
        The SHA-256 as hexadecimal text.

    """
    digest = hashlib.sha256()
    if python:
        digest.update(environment_fingerprint("").encode())
        facts: list[Any] = sorted(installed_files([Path(python).parent.parent]))
    else:
        for path in _project_files():
            digest.update(f"{path.relative_to(ROOT)} {path.stat().st_size}\n".encode())
            digest.update(path.read_bytes())
        variables = hashed_environment()
        facts = [sys.version, processor_features(), sys.path, sorted(variables.items())]
        facts += [*sorted(installed_files(_import_folders())), *_named_files(variables)]
    digest.update(json.dumps(facts).encode())
    return digest.hexdigest()


def _project_files() -> Iterator[Path]:
    for folder in _OWN_FOLDERS:
        for path in sorted(folder.rglob("*")):
            name = path.relative_to(ROOT).as_posix().removeprefix("plumbline/")
            if "__pycache__" not in path.parts and not name.startswith(_UNHASHED_PACKAGES) and path.is_file():
                yield path


def _import_folders() -> list[Path]:
    """The folders that Python imports from, without the standard library, which belongs to its version."""
    standard = {os.path.realpath(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")}
    skipped = {*standard, *(os.path.join(path, "lib-dynload") for path in standard)}
    return [Path(path) for path in map(os.path.realpath, sys.path) if path not in skipped]


def installed_files(folders: Iterable[Path]) -> set[_FileIdentity]:
    """Identify the files in folders, and in those that are linked from there.

    A package that is installed for editing lies elsewhere: its `direct_url.json` (PEP 610) or a `.pth` file
    names the folder.

    Args:
        folders: folders that Python imports from, or environments.

    Returns:
        The identities of all files but those that no import reads.

    """
    waiting, seen, found = [str(folder) for folder in folders], set[tuple[int, int]](), set[_FileIdentity]()
    while waiting:
        folder = waiting.pop()
        with contextlib.suppress(OSError):
            about = os.stat(folder)
            if (about.st_dev, about.st_ino) in seen:
                continue
            seen.add((about.st_dev, about.st_ino))
            with os.scandir(folder) as entries:
                for entry in _readable(folder, entries):
                    if entry.is_dir():  # a link comes last, so that files have the same paths each time
                        waiting.insert(0 if entry.is_symlink() else len(waiting), entry.path)
                    else:
                        with contextlib.suppress(OSError):  # a link to nothing
                            found.add(_identity(entry.path, entry.stat()))
                        if entry.name == "direct_url.json" or entry.name.endswith(".pth"):
                            waiting += _linked_folders(Path(entry.path))
    return found


def _readable(folder: str, entries: Iterable[os.DirEntry[str]]) -> Iterator[os.DirEntry[str]]:
    """The entries that tasks may read, of thirty thousand; this checkout has results besides its modules."""
    is_checkout = folder == str(ROOT)
    for entry in entries:
        if entry.name in _UNREAD_FOLDERS or entry.name.endswith(_SOURCES_OF_COMPILERS):
            continue
        if entry.path in _HASHED_BY_CONTENT or (is_checkout and not _is_imported_from_checkout(entry)):
            continue
        yield entry


def _is_imported_from_checkout(entry: os.DirEntry[str]) -> bool:
    if entry.name in _UNIMPORTED_FOLDERS:
        return False
    return Path(entry, "__init__.py").exists() or entry.name.endswith(tuple(all_suffixes()))


def _linked_folders(path: Path) -> list[str]:
    """The folders elsewhere that a file of an installation names."""
    try:
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".pth":
            lines = (line.strip() for line in text.splitlines())
            names = [line for line in lines if line and not line.startswith(("#", "import ", "import\t"))]
            return [str(path.parent / name) for name in names]
        about = json.loads(text)
        return [unquote(urlsplit(about["url"]).path)] if about["dir_info"]["editable"] else []
    except (OSError, ValueError, LookupError, TypeError):
        return []


def _named_files(variables: dict[str, str]) -> list[_FileIdentity]:
    """Identify the files that variables name, and those in folders that the dynamic linker searches."""
    found = []
    for name, value in variables.items():
        for part in filter(os.path.isabs, value.split(os.pathsep)):
            with contextlib.suppress(OSError, ValueError):
                paths = [part]
                if os.path.isdir(part) and name.startswith(_LIBRARY_FOLDERS):
                    paths = sorted(entry.path for entry in os.scandir(part))
                found += [_identity(path, os.stat(path)) for path in paths if os.path.isfile(path)]
    return found


def _identity(path: str, about: os.stat_result) -> _FileIdentity:
    return path, about.st_size, about.st_mtime_ns, about.st_ctime_ns
