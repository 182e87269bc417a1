"""One test per scenario and quantity; all scenarios are compared at once, before the first test."""

from __future__ import annotations

import os

import pytest

from plumbline.engines.protocol import QUANTITIES
from plumbline.execution.comparison import Comparison, compare
from plumbline.judging.rows import Row, Verdict
from plumbline.scenario.loader import catalogue


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Make the tests."""
    cases = [(name, quantity) for name in catalogue() for quantity in QUANTITIES]
    metafunc.parametrize(("scenario", "quantity"), cases, ids=[f"state/{s}/{q}" for s, q in cases])


@pytest.fixture(scope="session")
def comparison(request: pytest.FixtureRequest) -> Comparison:
    """What came of all scenarios that this session tests."""
    engine = request.config.getoption("--plumbline-engine")
    if not engine:
        raise pytest.UsageError("--plumbline-engine names the engine to test")
    calls = (getattr(item, "callspec", None) for item in request.session.items)
    names = dict.fromkeys(c.params["scenario"] for c in calls if c is not None and "scenario" in c.params)
    return compare(engine, list(names), jobs=os.cpu_count() or 1)


def test_quantity(comparison: Comparison, scenario: str, quantity: str) -> None:
    """The quantity agrees with the truth, or the engine declares that it has it not."""
    rows = [r for r in comparison.rows if r.scenario == scenario and r.quantity in (quantity, "all")]
    problems = [row for row in rows if row in comparison.problems]
    if problems:
        pytest.fail("\n".join(map(_words, problems)), pytrace=False)
    if not any(row.verdict == Verdict.AGREES for row in rows):
        pytest.skip(rows[0].reason if rows else "the mechanism has no such quantity")


def _words(row: Row) -> str:
    return f"{row.reason}; {row.diagnosis}" if row.diagnosis else row.reason
