"""Tests of an adapter in Python, as functions of its own test files."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Sequence
from functools import cache

import pytest

from plumbline.engines.adapter import Adapter
from plumbline.execution.comparison import CONTRACT_SCENARIOS, Comparison, compare
from plumbline.execution.plan import LevelSelection
from plumbline.judging.rows import Row, Verdict


def contract_tests(
    engine: type[Adapter] | str,
    scenarios: Sequence[str] = CONTRACT_SCENARIOS,
    level: LevelSelection = "all",
) -> Callable[[str], None]:
    """Make the test that an engine is to pass, one case per scenario.

    Args:
        engine: an adapter's class, at the top level of a module that workers can import; or a specification,
            as `cmd:PROGRAM`.
        scenarios: names of the catalogue, or paths of files.
        level: the levels to compare at.

    Returns:
        A test function for pytest; all scenarios are compared at once, before its first case.

    """
    specification = engine if isinstance(engine, str) else _specification(engine)

    @cache
    def comparison() -> Comparison:
        return compare(specification, scenarios, level, jobs=os.cpu_count() or 1)

    @pytest.mark.parametrize("scenario", scenarios)
    def test(scenario: str) -> None:
        found = comparison()
        check_rows(found, [row for row in found.rows if row.scenario == scenario])

    return test


def check_rows(comparison: Comparison, rows: Sequence[Row]) -> None:
    """Fail the current test if rows have a problem; skip it if none agrees.

    Args:
        comparison: what the rows are of.
        rows: any of its rows.

    """
    if problems := [row for row in rows if row in comparison.problems]:
        found = (filter(None, (f"{row.key}: {row.reason}", row.diagnosis)) for row in problems)
        pytest.fail("\n".join(map("; ".join, found)), pytrace=False)
    if not any(row.verdict == Verdict.AGREES for row in rows):
        pytest.skip(rows[0].reason if rows else "the mechanism has no such quantity")


def _specification(adapter: type[Adapter]) -> str:
    """MODULE:CLASS, by which workers load it; FILE:CLASS where its module is in no package."""
    if "." in adapter.__module__:
        return f"{adapter.__module__}:{adapter.__qualname__}"
    return f"{inspect.getfile(adapter)}:{adapter.__qualname__}"
