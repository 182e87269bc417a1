"""Tests of an engine for its own repository.

    pytest --pyargs plumbline.conformance --plumbline-engine ENGINE [--plumbline-level all]

One test per scenario and quantity at state level; at the other levels one per scenario.
`plumbline-known.toml` of the current folder lists expected failures with their reasons, as
`"state/chain-50-balls/*acceleration" = "why"`; one that passes fails.  For an adapter in Python,

    test_engine = contract_tests(MyEngine)
"""

from importlib import import_module
from typing import Any


def __getattr__(name: str) -> Any:
    """Load `contract_tests` when it is used: every session of pytest loads this package's plugin."""
    if name == "contract_tests":
        return import_module(f"{__name__}.contract").contract_tests
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
