"""The core: scenario files enter, verdicts leave."""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"
_COMPARISON = ("compare", "Comparison")  # the API; loaded when it is used, because it loads everything else


def __getattr__(name: str) -> Any:
    """Load a name of the API."""
    if name in _COMPARISON:
        return getattr(import_module(f"{__name__}.execution.comparison"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
