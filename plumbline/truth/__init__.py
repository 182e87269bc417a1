"""Truth: what engines are judged by, with its uncertainty.

A model and states enter; true state quantities with rounding bounds (`ground_truth.state_truth`) and true
motions with uncertainties and the growth of perturbations (`ground_truth.motion_truth`) leave.  High
precision needs the optional group `truth` (python-flint, mpmath, SymPy, heyoka), imported inside functions:
where it is missing, `TruthUnavailable` is raised and `ground_truth` falls back to double precision.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from plumbline.processes.exceptions import PlumblineError


class TruthUnavailable(PlumblineError, ImportError):
    """A package of the group `truth` is not installed; the message names it and the command to install it."""


def import_truth_tool(module: str) -> Any:
    """Import an optional module.

    Raises:
        TruthUnavailable: it is not installed.

    """
    try:
        return import_module(module)
    except ImportError as error:
        raise TruthUnavailable(
            f"truth tools not installed ({module} is missing: {error}); "
            "`uv pip install -r locks/truth.lock` installs them"
        ) from error
