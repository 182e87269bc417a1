"""Tests of an engine; all scenarios are compared at once, before the first test."""

from __future__ import annotations

import os

import pytest

from plumbline.conformance.contract import check_rows
from plumbline.engines.protocol import QUANTITIES
from plumbline.execution.comparison import Comparison, compare
from plumbline.judging.rows import Level
from plumbline.scenario.loader import catalogue

LEVELS: dict[str, tuple[Level, ...]] = {  # those of the rows, besides "state", at each level of a run
    "state": (), "step": ("step",), "trajectory": ("trajectory", "invariants"),
    "all": ("step", "trajectory", "invariants", "relations"),
}  # fmt: skip


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Make the tests: of states one per quantity, of the other levels one for all that they compare."""
    level = metafunc.config.getoption("--plumbline-level")
    quantities = QUANTITIES if level in ("state", "all") else ()
    kinds = [("state", q) for q in quantities] + [(one, "all") for one in LEVELS[level]]
    cases = [(one, name, quantity) for name in catalogue() for one, quantity in kinds]
    metafunc.parametrize(("level", "scenario", "quantity"), cases, ids=["/".join(case) for case in cases])


@pytest.fixture(scope="session")
def comparison(request: pytest.FixtureRequest) -> Comparison:
    """What came of all scenarios that this session tests."""
    engine = request.config.getoption("--plumbline-engine")
    if not engine:
        raise pytest.UsageError("--plumbline-engine names the engine to test")
    calls = (getattr(item, "callspec", None) for item in request.session.items)
    names = dict.fromkeys(c.params["scenario"] for c in calls if c is not None and "scenario" in c.params)
    level = request.config.getoption("--plumbline-level")
    return compare(engine, list(names), level, jobs=os.cpu_count() or 1)


def test_engine(comparison: Comparison, level: str, scenario: str, quantity: str) -> None:
    """What the engine computes agrees with the truth, or it declares that it has it not."""
    rows = [row for row in comparison.rows if (row.scenario, row.level) == (scenario, level)]
    check_rows(
        comparison, [row for row in rows if "all" in (quantity, row.quantity) or row.quantity == quantity]
    )
