"""Compare one engine with the truth, from Python: `plumbline.compare`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.registry import ENGINES, USER_ENGINES
from plumbline.engines.specifications import add_engine
from plumbline.execution.plan import LevelSelection, Plan
from plumbline.execution.result_cache import DiskResultCache, user_cells_folder
from plumbline.execution.runner import run_plan
from plumbline.judging.rows import ATTENTION_SEVERITY, Row, severity
from plumbline.processes.worker_pool import Limits
from plumbline.scenario.loader import catalogue, load_scenarios

# One of each kind of joint, chains, loads, elements, loops; the small ones first.
CONTRACT_SCENARIOS = (
    "tumbling-ball", "tumbling-rod", "double-tumbling-balls", "double-loaded-rods", "double-hinge-skew",
    "slider-on-arm", "universal-pendulum", "robot-arm", "crowded-tree", "four-bar",
)  # fmt: skip


@dataclass(frozen=True)
class Comparison:
    """What came of comparing an engine."""

    rows: tuple[Row, ...]  # one per scenario, level, integrator and quantity
    engine: EngineInfo
    sentence: str  # the counts of all verdicts
    exit_code: int  # as of `plumbline run`

    @property
    def problems(self) -> list[Row]:
        """The rows that need attention: disagreements, failures, gaps that the engine does not declare."""
        return [row for row in self.rows if severity(row.verdict, row.known_issue) >= ATTENTION_SEVERITY]


def compare(
    engine: str,
    scenarios: Sequence[str] | None = None,
    level: LevelSelection = "state",
    *,
    jobs: int = 1,
    limits: Limits | None = None,
) -> Comparison:
    """Compare an engine with the truth.

    Its workers import the main module again: a script calls this below `if __name__ == "__main__":`.

    Args:
        engine: name of an engine, or `[NAME=]cmd:PROGRAM …`, `FILE.py:Class`, `package.module:Class`.
        scenarios: names of the catalogue or paths of files; None for the whole catalogue.
        level: the levels to compare at.
        jobs: number of worker processes.
        limits: of each task.

    Raises:
        BadSpecification: the engine is none of these.
        ScenarioError: a scenario does not exist or has mistakes.

    """
    name = engine if engine in {**ENGINES, **USER_ENGINES} else add_engine(engine, Path.cwd())
    chosen = load_scenarios(tuple(catalogue()) if scenarios is None else scenarios)
    plan = Plan(
        chosen, [name], level, jobs=jobs, limits=limits or Limits(), are_engines_required=True,
        result_cache=DiskResultCache(user_cells_folder()),
    )  # fmt: skip
    result = run_plan(plan, lambda *_: None)
    about = result.metadata
    return Comparison(tuple(result.rows), result.engines[name], about["sentence"], about["exit_code"])
