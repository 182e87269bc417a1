"""The pytest plugin: options, and expected failures from the engine's own file."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

KNOWN_FILE = "plumbline-known.toml"
_MODULE = "test_conformance.py"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the suite."""
    group = parser.getgroup("plumbline")
    group.addoption(
        "--plumbline-engine", metavar="ENGINE", help="cmd:PROGRAM …, FILE.py:Class, package:Class"
    )
    levels = ("state", "step", "trajectory", "all")
    group.addoption(
        "--plumbline-level", choices=levels, default="state", help="what is compared; default state"
    )
    group.addoption("--plumbline-known", metavar="FILE", help=f"expected failures; default {KNOWN_FILE}")


def pytest_collection_modifyitems(config: pytest.Config, items: Sequence[pytest.Item]) -> None:
    """Mark the tests that the engine's file expects to fail."""
    own = [item for item in items if item.path.name == _MODULE and item.path.parent == Path(__file__).parent]
    given = config.getoption("--plumbline-known")
    path = Path(given or KNOWN_FILE)
    if not own or not (given or path.is_file()):
        return
    try:
        known = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise pytest.UsageError(f"{path}: {error}") from None
    for pattern, reason in known.items():
        found = [item for item in own if fnmatchcase(item.name.partition("[")[2][:-1], pattern)]
        if not found or not isinstance(reason, str):
            raise pytest.UsageError(f"{path}: {pattern!r} matches no test, or its reason is no text")
        for item in found:
            item.add_marker(pytest.mark.xfail(reason=reason, strict=True))
