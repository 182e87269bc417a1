"""Truth in high precision: certified state quantities and trajectories with an earned uncertainty.

Needs the optional group `truth` (python-flint, mpmath, sympy, heyoka), imported inside the functions:
where it is missing `TruthUnavailable` says so and the main job goes on without.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from plumbline.processes.errors import PlumblineError


class TruthUnavailable(PlumblineError, ImportError):
    """The truth tools are not installed; the message says which and how to get them."""


def import_truth_tool(module: str) -> Any:
    """The optional module of that name; raises TruthUnavailable with a sentence where it is missing."""
    try:
        return import_module(module)
    except ImportError as error:
        raise TruthUnavailable(
            f"truth tools not installed ({module} is missing: {error}); "
            "`uv pip install -r locks/truth.lock` installs them"
        ) from error
