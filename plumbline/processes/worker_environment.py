"""Environment variables of workers: those of the user, without the ones that differ from session to session.

The result cache hashes what workers get; a variable that it does not hash cannot be read by an engine.
"""

from __future__ import annotations

import os
import sys
from fnmatch import fnmatchcase

SINGLE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
# Variables that choose the kernels of numerical libraries. Some libraries need them on some processors, and
# results of different kernels differ in their last digits.
KERNELS = (
    "OPENBLAS_CORETYPE", "OPENBLAS_L2_SIZE", "NPY_DISABLE_CPU_FEATURES", "MKL_CBWR",
    "MKL_ENABLE_INSTRUCTIONS", "BLIS_ARCH_TYPE", "NVPL_BLAS_DEBUG_CPU_TYPE",
)  # fmt: skip
# Variables that name a terminal, a login, a job or a test, and settings of tools that workers do not run.
SESSION_VARIABLES = (
    "_", "PWD", "OLDPWD", "SHLVL", "HOSTNAME", "PS[1-4]", "PROMPT*", "HIST*", "MAIL", "PAGER", "LESS*",
    "MORE", "EDITOR", "VISUAL", "BROWSER", "MANPATH", "INFOPATH",
    "TERM", "TERM_*", "COLORTERM", "COLUMNS", "LINES", "LS_COLORS", "NO_COLOR", "FORCE_COLOR", "CLICOLOR*",
    "WINDOWID", "VTE_VERSION", "GNOME_*", "KONSOLE_*", "KITTY_*", "ALACRITTY_*", "WEZTERM_*", "ITERM_*",
    "WT_*", "TMUX*", "STY", "VSCODE_*",
    "SSH_*", "GPG_*", "XDG_SESSION_*", "XDG_RUNTIME_DIR", "XDG_VTNR", "XDG_SEAT*", "DBUS_*",
    "SESSION_MANAGER", "INVOCATION_ID", "JOURNAL_STREAM", "SYSTEMD_*",
    "MAKE*", "MFLAGS", "GNUMAKEFLAGS", "GIT_*", "UV_*", "PIP_*", "VIRTUAL_ENV*",
    "PYTEST_*", "COVERAGE_*", "GITHUB_*", "RUNNER_*", "ACTIONS_*",
    "PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX", "PYTHONUNBUFFERED", "PYTHONSTARTUP", "PYTHON_COLORS",
    "PYTHON_HISTORY", "PYTHONBREAKPOINT",
)  # fmt: skip
TEMPORARY_FOLDER = ("TMPDIR", "TEMP", "TMP")  # in a worker: its own scratch folder


def worker_environment() -> dict[str, str]:
    """Return the variables that the workers of this process get.

    PATH begins with the interpreter's folder, and PYTHONPATH holds what `sys.path` has besides the
    interpreter's own folders: both are the same however the command was started.
    """
    found = {
        name: value
        for name, value in os.environ.items()
        if not any(fnmatchcase(name, pattern) for pattern in SESSION_VARIABLES)
    }
    folders = [os.path.dirname(sys.executable), *found.get("PATH", os.defpath).split(os.pathsep)]
    installed = tuple(os.path.join(prefix, "") for prefix in (sys.prefix, sys.base_prefix))
    imports = [path for path in map(os.path.abspath, sys.path) if not path.startswith(installed)]
    paths = {"PATH": folders, "PYTHONPATH": imports}
    return found | {k: os.pathsep.join(dict.fromkeys(v)) for k, v in paths.items()} | SINGLE_THREAD


def hashed_environment() -> dict[str, str]:
    """Return the variables that answers may depend on: those of workers but for where they keep files."""
    unhashed = (*TEMPORARY_FOLDER, "PLUMBLINE_CACHE")
    return {name: value for name, value in sorted(worker_environment().items()) if name not in unhashed}
