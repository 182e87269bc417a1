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
from tests.helpers import ROOT


def invoke(*words: object, code: int | None = None) -> Result:
    """A command in this process, which must end with the exit code, if one is given."""
    result = CliRunner().invoke(main, [*map(str, words)])
    assert code in (None, result.exit_code), result.output
    return result


def user_environment(*first: object, **variables: str) -> dict[str, str]:
    """This process's variables, without Python's own; modules of the folders hide others of their names."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return kept | {"PYTHONPATH": os.pathsep.join(map(str, first or (ROOT,)))} | variables


def run_plumbline(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """A command in a process that has not the current folder among its modules."""
    return run_python("-m", "plumbline", *words, **options)


def run_python(
    *words: object,
    cwd: Path = ROOT,
    path: Iterable[object] = (ROOT,),
    code: int | None = None,
    largest_file: int = 0,
    **variables: str,
) -> subprocess.CompletedProcess[str]:
    """Python with the folders of ``path``, which must end with the exit code, if one is given.

    Files above ``largest_file`` bytes, if that is given, are refused by the kernel.
    """

    def refuse_larger_files() -> None:
        import resource  # which Windows lacks

        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))

    done = subprocess.run(
        [sys.executable, "-P", *map(str, words)], cwd=cwd, env=user_environment(*path, **variables),
        capture_output=True, text=True, timeout=240, check=False,
        preexec_fn=refuse_larger_files if largest_file else None,
    )  # fmt: skip
    assert code in (None, done.returncode), done.stdout + done.stderr
    return done
