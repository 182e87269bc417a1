"""Tests that run nightly only, for their time: `tests/nightly_tests.txt` has the list and the rule."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

_LINES = (Path(__file__).parents[1] / "nightly_tests.txt").read_text(encoding="utf-8").splitlines()
_PAIRS = [line.split(" | ") for line in _LINES if not line.startswith("#")]
NIGHTLY = {moved: tuple(fast.split(" ")) for moved, fast in _PAIRS}

SLOW = (pytest.mark.full, pytest.mark.slow)


def slow(test: Any) -> Any:
    """Move a test function to the nightly."""
    for mark in SLOW:
        test = mark(test)
    return test


def nightly(cases: Iterable[Any]) -> list[Any]:
    """Parameters of a test that run nightly."""
    return [pytest.param(case, marks=SLOW) for case in cases]


def some_fast(cases: Sequence[Any], step: int) -> list[Any]:
    """Parameters of a test, by name, of which every ``step``-th runs fast and the others nightly."""
    return [
        pytest.param(case, id=getattr(case, "name", case), marks=SLOW if k % step else [])
        for k, case in enumerate(cases)
    ]


def fast_are(names: Sequence[str], cases: Sequence[Any]) -> list[Any]:
    """Parameters of a test, by name, of which those of ``names`` run fast and the others nightly."""
    missing = {*names} - {case.name for case in cases}
    assert not missing, f"no cases: {missing}"
    return [pytest.param(c, id=c.name, marks=[] if c.name in names else SLOW) for c in cases]


def is_nightly(nodeid: str) -> bool:
    """Whether the table moves a test, or one of its cases, to the nightly."""
    name, _, case = nodeid.removeprefix("tests/").partition("[")
    return name in NIGHTLY and case.removesuffix("]") not in NIGHTLY[name]


def stale_entries(collected: set[str], fast: set[str]) -> list[str]:
    """Entries of the table that name no test of a whole collection, or leave none fast."""
    here = [{name.removeprefix("tests/") for name in names} for names in (collected, fast)]
    every, still_fast = ({*names, *(name.partition("[")[0] for name in names)} for names in here)
    stale = [moved for moved in NIGHTLY if moved not in every]
    for moved, others in NIGHTLY.items():
        file = moved.partition("::")[0]
        for name in others:
            if not {f"{moved}[{name}]", f"{file}::{name}", name} & still_fast:
                stale.append(f"{moved}: {name}")
    return stale
