"""Other versions of an engine: `mujoco@3.12.0`, `@latest`, `@pre`, `mujoco@path/to.whl`.

Each version lives in its own environment, which uv makes once in the user's cache.  The environment is built
in a temporary folder and renamed, so that an existing one is complete.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from packaging.specifiers import SpecifierSet
from packaging.utils import InvalidWheelFilename, canonicalize_name, parse_wheel_filename
from packaging.version import Version

from plumbline.engines.missing_names import BASE_REQUIREMENTS
from plumbline.engines.registry import ENGINES, IMPORTERS, USER_ENGINES
from plumbline.layout import IS_INSTALLED, PREFIX, ROOT
from plumbline.processes.exceptions import PlumblineError
from plumbline.processes.isolation import ScratchFolder
from plumbline.processes.user_cache import (
    UntrustedFolder,
    check_ownership,
    make_private_folder,
    user_cache_folder,
)

INSTALL_TIMEOUT = 900  # s for uv to fetch and install


class EnvironmentUnavailable(PlumblineError):
    """The environment of a version cannot be made here; the message is the reason."""


def split_version(name: str) -> tuple[str, str]:
    """Split ``mujoco@3.12.0`` into ("mujoco", "3.12.0").

    Args:
        name: an engine as typed on the command line, with or without a version.

    Returns:
        The name in the registry, and the version; empty where none is given.

    """
    base, _, version = name.partition("@")
    return base, version


def version_problem(name: str) -> str | None:
    """Check the version part of a name before anything is downloaded.

    Args:
        name: an engine as typed on the command line.

    Returns:
        A sentence about what is wrong, or None.

    """
    base, version = split_version(name)
    if "@" in name and base in USER_ENGINES:
        return "its version is what it reports; @ is for engines of Plumbline"
    if "@" not in name or version in ("latest", "pre"):
        return None
    if version.endswith(".whl"):
        return _wheel_problem(Path(version), declared_attribute(base, "package"))
    try:
        Version(version)
    except ValueError:  # InvalidVersion, or a number of thousands of digits
        return f"{version!r} is not a version; write one as 3.12.0, or latest, pre, or the path of a wheel"
    return None


def _wheel_problem(path: Path, package: str) -> str | None:
    """Return what is wrong with a wheel of ``package``, judged by its file name and file type."""
    try:
        found, *_ = parse_wheel_filename(path.name)
    except InvalidWheelFilename as error:
        return str(error)
    if found != canonicalize_name(package):
        return f"{path} is a wheel of {found}, not of {package}"
    if not path.is_file():
        return f"there is no file {path}"
    return None if zipfile.is_zipfile(path) else f"{path} is not a wheel: it is no zip file"


def declared_attribute(engine: str, attribute: str) -> Any:
    """Read a literal class attribute of an adapter, or of an importer without adapter, without importing it.

    The name of the distribution, for one, is needed where the engine is not installed.

    Args:
        attribute: name of a class attribute of the class or of one of its bases, written as a literal.

    Returns:
        Its value; None where no class declares it, and of an engine of the user.

    """
    if engine in USER_ENGINES or ":" in engine:
        return None
    module, _, class_name = {**IMPORTERS, **ENGINES}[engine].partition(":")
    return _read_attribute(module, class_name, attribute)


def declared_importer_attribute(importer: str, attribute: str) -> Any:
    """Read a literal class attribute of an importer column without importing it.

    Args:
        importer: its name, with or without a version.

    Returns:
        Its value; None where no class declares it.

    """
    module, _, class_name = IMPORTERS[split_version(importer)[0]].partition(":")
    return _read_attribute(module, class_name, attribute)


@cache
def _parse(source: Path) -> list[ast.stmt]:
    return ast.parse(source.read_text(encoding="utf-8")).body


def _read_attribute(module: str, class_name: str, attribute: str) -> Any:
    """Read an attribute in the source of a class, or of the first of its bases that has it."""
    source = ROOT / f"{module.removeprefix(PREFIX).replace('.', '/')}.py"
    if not source.is_file():
        return None
    body = _parse(source)
    bases: list[str] = []
    for definition in (node for node in body if isinstance(node, ast.ClassDef) and node.name == class_name):
        bases = [base.id for base in definition.bases if isinstance(base, ast.Name)]
        for node in definition.body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            if any(isinstance(t, ast.Name) and t.id == attribute for t in targets):
                value = getattr(node, "value", None)
                return None if value is None else ast.literal_eval(value)
    imported_from = {
        name.name: node.module or ""
        for node in body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    found = (_read_attribute(imported_from.get(base, module), base, attribute) for base in bases)
    return next((value for value in found if value is not None), None)


def ensure_interpreter(name: str, declared: Callable[[str, str], Any] = declared_attribute) -> str:
    """Find the Python of a version's environment; make the environment where there is none.

    Args:
        name: an engine with a version, as typed on the command line.
        declared: reads the attributes of its column: `declared_attribute` or `declared_importer_attribute`.

    Raises:
        OSError: the finished environment could not be moved into the cache.

    `EnvironmentUnavailable` passes through where uv fails.

    """
    base, version = split_version(name)
    package = declared(base, "package")
    if version.endswith(".whl"):
        wheel = Path(version).resolve()
        requirement, label = str(wheel), hashlib.sha256(wheel.read_bytes()).hexdigest()[:16]
        number = str(parse_wheel_filename(wheel.name)[1])
    else:
        requirement = f"{package}=={version}"
        if version in ("latest", "pre"):
            requirement = newest_requirement(package, pre=version == "pre")
        number = label = requirement.partition("==")[2]
    extra = declared(base, "extra_requirements") or ()
    wanted = [requirement, *BASE_REQUIREMENTS]
    wanted += [need for versions, need in extra if SpecifierSet(versions).contains(number)]
    tag = hashlib.sha256("\n".join([*wanted, sys.version]).encode()).hexdigest()[:8]
    place = user_cache_folder() / "engines" / f"{package}-{label}-{tag}"
    try:
        check_ownership(place)
    except FileNotFoundError:
        pass  # it is made below
    except UntrustedFolder as error:
        raise EnvironmentUnavailable(f"{error.filename} is not used: {error.strerror}") from None
    if not _interpreter_path(place).exists():
        make_private_folder(place.parent)
        with ScratchFolder(".making-", place.parent) as scratch:
            made = scratch / "environment"
            _run_uv("venv", "--relocatable", "--python", sys.executable, str(made))
            _run_uv("pip", "install", "--python", str(_interpreter_path(made)), *wanted)
            try:
                os.rename(made, place)
            except OSError:  # another process made it meanwhile
                if not _interpreter_path(place).exists():
                    raise
    return str(_interpreter_path(place))


def importer_interpreter(name: str) -> str:
    """Find the Python that has an importer.

    Args:
        name: an importer of model files, with or without a version, as typed on the command line.

    Returns:
        Path of the interpreter; empty for this process's own.

    Raises:
        EnvironmentUnavailable: the importer is optional and its environment has not been made, or uv fails.

    """
    base, version = split_version(name)
    if version:
        return ensure_interpreter(name, declared_importer_attribute)
    folder = declared_importer_attribute(base, "environment")
    if not folder or IS_INSTALLED:  # there it may be installed beside the project
        return ""
    python = _interpreter_path(ROOT / folder)
    if not python.exists():
        raise EnvironmentUnavailable(f"{base} is not installed here; `make importers` installs it")
    return str(python)


def is_optional_importer(name: str) -> bool:
    """Find out whether `make importers` installs an importer, into an environment of its own.

    Args:
        name: an importer, with or without a version.

    Returns:
        Whether it does; not of another version, which has another environment.

    """
    base, version = split_version(name)
    return not version and bool(declared_importer_attribute(base, "environment"))


def _interpreter_path(environment: Path) -> Path:
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def newest_requirement(package: str, *, pre: bool) -> str:
    """Look up the newest version of a distribution.

    Args:
        pre: whether pre-releases count.

    Returns:
        The requirement ``package==version``.

    """
    with tempfile.TemporaryDirectory() as scratch:
        source = Path(scratch) / "wanted.in"
        source.write_text(package)
        kind = ["--prerelease", "allow"] if pre else []
        found = _run_uv(
            "pip", "compile", "--no-deps", "--no-header", "--no-annotate", "--python", sys.executable, *kind,
            str(source),
        )  # fmt: skip
    return found.split()[0]


@dataclass(frozen=True)
class PublishedVersions:
    """Versions of a distribution on the package index, oldest first."""

    usable: tuple[str, ...]  # with a wheel for this Python and system, without pre-releases
    without_wheel: tuple[str, ...]


def published_versions(package: str) -> PublishedVersions:
    """List the versions of a distribution that the package index offers.

    `EnvironmentUnavailable` passes through where the index cannot be reached or has no such distribution.
    """
    listing = ("tool", "run", "--python", sys.executable, "pip", "index", "versions", package, "--json")
    every, usable = (
        json.loads(_run_uv(*listing, *option, purpose=f"list the versions of {package}"))["versions"]
        for option in ((), ("--only-binary", ":all:"))
    )
    rest = set(every) - set(usable)
    return PublishedVersions(*(tuple(sorted(found, key=Version)) for found in (usable, rest)))


def _run_uv(*arguments: str, purpose: str = "make an environment for it") -> str:
    """Run uv and return its output; raise EnvironmentUnavailable with its error message."""
    # The environment may be a link to that of another checkout, where make has put uv beside it.
    beside = [folder / ".uv" / "bin" / "uv" for folder in (ROOT, Path(sys.prefix).resolve().parent)]
    program = shutil.which("uv") or next((str(path) for path in beside if path.exists()), "uv")
    environment = {
        "UV_PYTHON_DOWNLOADS": "never",
        "UV_SYSTEM_CERTS": "true",
        "UV_LINK_MODE": "copy",  # a file that is patched in one environment stays as it is in the others
        **os.environ,
    }
    try:
        done = subprocess.run(
            [program, "--quiet", "--no-config", *arguments],
            capture_output=True, text=True, timeout=INSTALL_TIMEOUT, env=environment,
        )  # fmt: skip
    except FileNotFoundError:
        raise EnvironmentUnavailable("uv is not on PATH; install it (pip install uv) for @versions") from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise EnvironmentUnavailable(f"uv cannot {purpose}: {error}") from None
    if done.returncode:
        raise EnvironmentUnavailable(f"uv cannot {purpose}: {' '.join(done.stderr.split())}")
    return done.stdout
