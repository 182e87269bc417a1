"""Truth: what engines are judged by, with its uncertainty.

A model and states enter; true state quantities with rounding bounds (`ground_truth.state_truth`) and true
motions with uncertainties and the growth of perturbations (`ground_truth.motion_truth`) leave.  High
precision needs python-flint and mpmath, motions also the optional group `truth` (SymPy, heyoka), imported
inside functions: where one is missing, `TruthUnavailable` is raised and `ground_truth` falls back to doubles.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from plumbline.layout import IS_INSTALLED
from plumbline.processes.exceptions import PlumblineError


class TruthUnavailable(PlumblineError, ImportError):
    """A package of the group `truth` is not installed; the message names it and the command to install it."""


def has_independent_truth() -> bool:
    """Find out whether python-flint is installed: without it the reference itself is the truth."""
    return find_spec("flint") is not None


def import_truth_tool(module: str) -> Any:
    """Import an optional module.

    Raises:
        TruthUnavailable: it is not installed.

    """
    try:
        return import_module(module)
    except ImportError as error:
        way = "pip install 'plumbline[truth]'" if IS_INSTALLED else "uv pip install -r locks/truth.lock"
        reason = f"truth tools not installed ({module} is missing: {error}); `{way}` installs them"
        raise TruthUnavailable(reason) from error
