"""Commands of the program: in this process, or in one of their own, which takes ten times as long."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from plumbline.cli.main import main

ROOT = Path(__file__).resolve().parents[2]


def invoke(*words: object) -> Result:
    """A command in this process."""
    return CliRunner().invoke(main, [*map(str, words)])


def user_environment(*first: object, **variables: str) -> dict[str, str]:
    """This process's variables, without Python's own; modules of the folders hide others of their names."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return kept | {"PYTHONPATH": os.pathsep.join(map(str, first or (ROOT,)))} | variables


def run_plumbline(
    *words: object, cwd: Path = ROOT, path: Iterable[object] = (ROOT,), **variables: str
) -> subprocess.CompletedProcess[str]:
    """A command in a process that has not the current folder among its modules."""
    return run_python("-m", "plumbline", *words, cwd=cwd, path=path, **variables)


def run_python(
    *words: object, cwd: Path = ROOT, path: Iterable[object] = (ROOT,), **variables: Any
) -> subprocess.CompletedProcess[str]:
    """Python with the folders of ``path``."""
    return subprocess.run(
        [sys.executable, "-P", *map(str, words)], cwd=cwd, env=user_environment(*path, **variables),
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
