"""Engines of the user: how they are named, where they are found, and what may be started.

    cmd:[NAME=VALUE …] PROGRAM [ARGUMENT …]     a program that answers protocol 1, without a shell
    FILE.py:Class                               an adapter in a file
    package.module:Class                        an adapter in an installed package

Names come from `--adapter [NAME=]SPECIFICATION`, from the table `[engines]` of `plumbline.toml` in the
current folder, and from entry points of the group `plumbline.engines`. What that file names is started only
where the user trusts it: the consent is kept for the contents of the file and of the files that its commands
name.
"""

from __future__ import annotations

import hashlib
import re
import shlex
import shutil
import tomllib
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path

from plumbline.engines.registry import ENGINES, IMPORTERS, USER_ENGINES
from plumbline.processes.line_process import COMMAND_PREFIX, BadSpecification, split_command
from plumbline.processes.user_cache import content_key, recall, remember

PROJECT_FILE = "plumbline.toml"
ENTRY_POINTS = "plumbline.engines"
MAX_HASHED_FILE = 2**28  # bytes of a file that a command names
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,39}")


def resolve(specification: str, folder: Path) -> str:
    """Make a specification valid in the working folder of any worker: paths become absolute.

    Args:
        folder: that relative paths begin at.

    Raises:
        BadSpecification: it is none, or its program or file does not exist.

    """
    if specification.startswith(COMMAND_PREFIX):
        command, variables = split_command(specification)
        program = shutil.which(command[0]) if "/" not in command[0] else str(folder / command[0])
        if program is None or not Path(program).is_file():
            raise BadSpecification(f"there is no program {command[0]}")
        paths = [str(folder / word) if (folder / word).is_file() else word for word in command[1:]]
        set_variables = (f"{name}={value}" for name, value in variables.items())
        return COMMAND_PREFIX + shlex.join([*set_variables, program, *paths])
    module, _, class_name = specification.rpartition(":")
    if module.endswith(".py") and class_name.isidentifier():
        if not (folder / module).is_file():
            raise BadSpecification(f"there is no file {module}")
        return f"{(folder / module).resolve()}:{class_name}"
    if class_name.isidentifier() and all(part.isidentifier() for part in module.split(".")):
        return specification
    raise BadSpecification(f"{specification!r} is none of cmd:PROGRAM …, FILE.py:Class, package.module:Class")


def named_files(specification: str) -> list[Path]:
    """List the files that a resolved specification names: program, arguments, the file of a class."""
    if specification.startswith(COMMAND_PREFIX):
        return [Path(word) for word in split_command(specification)[0] if Path(word).is_file()]
    module = specification.rpartition(":")[0]
    return [Path(module)] if module.endswith(".py") else []


def content_digest(specification: str) -> str:
    """Hash a resolved specification with the contents of the files that it names.

    A program that is built again under its old version is another one.
    """
    digest = hashlib.sha256(specification.encode())
    for path in named_files(specification):
        about = path.stat()
        if about.st_size > MAX_HASHED_FILE:
            digest.update(f"\n{path} {about.st_size} {about.st_mtime_ns} {about.st_ctime_ns}".encode())
        else:
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def task_engine(base: str) -> tuple[str, str]:
    """Return what workers load an engine by, and what its answers depend on besides its version.

    Args:
        base: name of an engine without a version.

    Returns:
        The name of a built-in engine, or the specification of one of the user; the hash of its files.

    """
    specification = USER_ENGINES.get(base)
    return (base, "") if specification is None else (specification, content_digest(specification))


def add_engine(text: str, folder: Path) -> str:
    """Add an engine of the user to this process.

    Args:
        text: a specification, or NAME=SPECIFICATION.
        folder: that relative paths begin at.

    Returns:
        Its name.

    Raises:
        BadSpecification: the text is none, or the name is taken.

    """
    name, specification = _split_name(text)
    specification = resolve(specification, folder)
    if not _NAME.fullmatch(name):
        raise BadSpecification(
            f"{name!r} is no name of an engine: small letters, digits, - and _; write NAME={text}"
        )
    if name in {**ENGINES, **IMPORTERS}:
        raise BadSpecification(f"{name} is an engine of Plumbline; name yours, as my-{name}={specification}")
    if USER_ENGINES.setdefault(name, specification) != specification:
        raise BadSpecification(f"two engines are called {name}: {USER_ENGINES[name]} and {specification}")
    return name


def _split_name(text: str) -> tuple[str, str]:
    """The name before the first = of a specification, or one made of it: its last file, or its class."""
    before, sign, after = text.partition("=")
    if sign and _NAME.fullmatch(before) and ":" in after:
        return before, after
    if not text.startswith(COMMAND_PREFIX):
        return text.rpartition(":")[2].lower(), text
    words = split_command(text)[0]
    files = [word for word in words if "/" in word or "." in word] or list(words)
    return Path(files[-1]).stem.lower(), text


def found_engines(folder: Path) -> Iterator[tuple[str, str, Path | None]]:
    """List the engines that are named elsewhere than on the command line.

    Args:
        folder: has `plumbline.toml`, or not.

    Yields:
        Name, specification, and the file that must be trusted, None for installed packages.

    Raises:
        BadSpecification: the file is not valid.

    """
    path = folder / PROJECT_FILE
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8")).get("engines", {})
    except FileNotFoundError:
        table = {}
    except (OSError, ValueError) as error:
        raise BadSpecification(f"{PROJECT_FILE}: {getattr(error, 'strerror', None) or error}") from None
    if not isinstance(table, dict) or not all(isinstance(value, str) for value in table.values()):
        raise BadSpecification(f"{PROJECT_FILE}: [engines] must have a specification, a text, for each name")
    yield from ((name, value, path) for name, value in table.items())
    for point in entry_points(group=ENTRY_POINTS):
        if point.name not in table:
            yield point.name, point.value, None


def is_trusted(specification: str, path: Path, *, consent: bool) -> bool:
    """Find out whether the user trusts what a file of the current folder wants to start.

    Args:
        specification: resolved.
        path: the file that names it.
        consent: whether the user gives it now; it is kept for these contents.

    """
    key = content_key(
        "trust", str(path.resolve()).encode(), path.read_bytes(), content_digest(specification).encode()
    )
    if consent:
        remember(key, True)
    return consent or recall(key, lambda value: value is True) is not None
