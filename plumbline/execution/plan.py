"""What a run does: scenarios, engines and limits (`Plan`), and the keys of its tasks (`TaskKey`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Literal

import numpy as np

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.registry import REFERENCE_ENGINES
from plumbline.judging.known_issues import KnownIssue, project_known_issues
from plumbline.judging.rows import Row
from plumbline.model.sampling import RANDOM_STATES
from plumbline.processes.worker_pool import Limits, ResultCache
from plumbline.scenario.loader import FAMILIES, Scenario

STATES_PER_RANDOM_SCENARIO = 9  # the same for a random scenario, or one that asks for states only

LevelSelection = Literal["state", "step", "trajectory", "all"]
ProgressCallback = Callable[[int, int, str], None]  # finished tasks, all tasks, name of the last one


def no_progress(done: int, total: int, what: str) -> None:
    """Show nothing."""


class RunObserver:
    """Follows a run. This base class ignores what it is given."""

    def on_start(self, engines: Mapping[str, EngineInfo]) -> None:
        """Take the descriptions of the engines.

        Args:
            engines: description by name.

        """

    def on_rows(self, scenario: str, rows: Sequence[Row], is_complete: bool) -> None:
        """Take rows of a scenario of the catalogue or the user, as they are judged.

        Args:
            rows: new rows; all rows of the scenario where it is complete.

        """


@dataclass(frozen=True)
class Plan:
    """What to run."""

    scenarios: Sequence[Scenario]
    engines: Sequence[str]
    level: LevelSelection = "all"
    jobs: int = 1
    limits: Limits = field(default_factory=Limits)
    random_state_count: int = RANDOM_STATES
    extra_refinements: int = 0  # how many times the finest step is halved beyond the usual refinement study
    long_run_seconds: float = 0.0  # s of the long runs whose invariants are judged; 0: none
    are_engines_required: bool = False  # whether an engine that is not installed has failed
    known_issues: Sequence[KnownIssue] = field(default_factory=project_known_issues)
    user_rtol: float | None = None  # relative to each quantity's scale; shown beside the verdict only
    is_full_catalogue: bool = False  # the full catalogue on all engines: every known issue must occur
    scheduler: str | None = None  # address of a dask cluster to run on, instead of ``jobs`` workers here
    random_scenarios: Sequence[Scenario] = ()  # compared at few states; may be made one by one
    random_level: Literal["state", "random"] = "state"  # of the random scenarios; "random": state and step
    random_trajectory_count: int = 0  # so many of the random scenarios, the first ones, run at every level
    result_cache: ResultCache = field(default_factory=ResultCache)
    # Whether all refinement studies run; else those of low order only where every step of a run does not
    # decide, and on one scenario of each family.
    has_all_studies: bool = True

    def studied(self, scenario: Scenario) -> str:
        """Return the scenario of its family whose refinement studies always run.

        In the catalogue it is the same in every run, so that a scenario has the same rows in each; of others
        it is the plainest of the run.
        """
        if scenario.is_in_catalogue:
            return FAMILIES[scenario.family]
        return self._studied_others.get(scenario.family, scenario.name)

    @cached_property
    def _studied_others(self) -> dict[str, str]:
        return plainest([s for s in self.scenarios if not s.is_in_catalogue])

    def has_other_steps(self, scenario: Scenario) -> bool:
        """Whether steps of integrators without motions are compared: of all scenarios, or of the studied."""
        return self.has_all_studies or self.studied(scenario) == scenario.name


def plainest(scenarios: Iterable[Scenario]) -> dict[str, str]:
    """Return by family the scenario that every engine can move, in the most general motion.

    Of those with motions it is the one with the fewest bodies, without elements and with inertia, that has
    the most numbers that are not zero.
    """
    found: dict[str, Scenario] = {}
    for s in sorted(scenarios, key=_plainness):
        if s.level == "all":
            found.setdefault(s.family, s)
    return {family: s.name for family, s in found.items()}


def _plainness(scenario: Scenario) -> tuple[bool, int, int, str]:
    model, state = scenario.model, scenario.state
    numbers = [x for name, x in model.fields.items() if name != "kind"] + list(vars(state).values())
    used = sum(int(np.count_nonzero(x)) for x in numbers)
    return model.has_elements or model.lacks_inertia, model.n, -used, scenario.name


class TaskKind(StrEnum):
    """What a task computes."""

    STATE_TRUTH = "state truth"
    MOTION_TRUTH = "motion truth"
    RELATION_BOUNDS = "relation bounds"
    STATE = "state"
    STEP = "step"
    RELATIONS = "relations"
    TRAJECTORY = "trajectory"
    LONG_RUN = "long run"
    DIAGNOSIS = "diagnosis"
    DESCRIPTION = "description"


_CPU_TIME_KINDS = {
    TaskKind.STATE_TRUTH: "truth",
    TaskKind.MOTION_TRUTH: "truth",
    TaskKind.RELATION_BOUNDS: "truth",
    TaskKind.DIAGNOSIS: "diagnosis",
}
_TRUTHS = {
    TaskKind.STATE: TaskKind.STATE_TRUTH,
    TaskKind.TRAJECTORY: TaskKind.MOTION_TRUTH,
    TaskKind.RELATIONS: TaskKind.RELATION_BOUNDS,
}


@dataclass(frozen=True)
class TaskKey:
    """The identity of one task of a run."""

    kind: TaskKind
    scenario: str = ""  # empty for descriptions
    engine: str = ""  # empty for truths
    integrator: str = ""  # empty for kinds without an integrator

    def __str__(self) -> str:
        return " ".join(part for part in (self.scenario, self.engine, self.kind, self.integrator) if part)

    @property
    def is_truth(self) -> bool:
        """Whether the task computes what the answers of engines are judged by."""
        return self.kind in _TRUTHS.values()

    @property
    def needed_truth(self) -> TaskKind | None:
        """The task whose result the answer is judged by; None where it is judged without one."""
        return _TRUTHS.get(self.kind)

    @property
    def cpu_time_kind(self) -> str:
        """The kind of `plumbline.processes.cpu_time` that the call counts as."""
        return _CPU_TIME_KINDS.get(self.kind, "reference" if self.engine in REFERENCE_ENGINES else "engines")


def scenario_level(
    scenario: Scenario, level: LevelSelection | Literal["random"]
) -> LevelSelection | Literal["random"]:
    """Return the levels of a run at which a scenario is compared.

    Args:
        scenario: whose file may ask for states only.

    Returns:
        "state", or the level of the run.

    """
    return level if scenario.level == "all" else "state"


def task_keys(
    scenario: str,
    engines: Mapping[str, EngineInfo],
    level: LevelSelection | Literal["random"],
    has_long_runs: bool = False,
    has_other_steps: bool = True,
) -> Iterator[TaskKey]:
    """List the tasks of a scenario that are known beforehand.

    Args:
        engines: descriptions of the engines; those that are missing get no task.
        level: which levels to compare at; "random" is state and step level.
        has_other_steps: whether steps of integrators without motions are compared.

    Yields:
        The truths, then the cells engine by engine.

    """
    has_states, has_runs = level in ("state", "random", "all"), level in ("trajectory", "all")
    wanted = [TaskKind.STATE_TRUTH] * has_states + [TaskKind.MOTION_TRUTH] * has_runs
    wanted += [TaskKind.RELATION_BOUNDS] * (level == "all")
    yield from (TaskKey(kind, scenario) for kind in wanted)
    for name, info in engines.items():
        if info.missing is not None:
            continue
        keys = [TaskKey(TaskKind.STATE, scenario, name)] * has_states
        if level in ("step", "random", "all"):
            declared = (one for one in info.integrators if one.method is not None)
            keys += [
                TaskKey(TaskKind.STEP, scenario, name, one.name)
                for one in declared
                if one.has_motions or has_other_steps
            ]
        keys += [TaskKey(TaskKind.RELATIONS, scenario, name)] * (level == "all")
        runs = [TaskKind.TRAJECTORY] * has_runs + [TaskKind.LONG_RUN] * (has_runs and has_long_runs)
        moving = [one for one in info.integrators if one.has_motions]
        keys += [TaskKey(kind, scenario, name, one.name) for kind in runs for one in moving]
        yield from keys
