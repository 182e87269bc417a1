"""One scenario on all engines: makes the tasks, judges their outcomes once the truth is there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from plumbline.diagnosis.diagnose import explain_disagreement
from plumbline.engines import calls, environments
from plumbline.engines.adapter import EngineInfo
from plumbline.judging import metamorphic, outlier
from plumbline.judging.convergence import refinement_resolutions
from plumbline.judging.long_run_study import plan_long_run, run_long_run_study
from plumbline.judging.long_runs import judge_long_runs
from plumbline.judging.rows import JudgingResult, RowContext, Verdict
from plumbline.judging.state import judge_states, judge_states_pickled
from plumbline.judging.trajectory import judge_trajectory
from plumbline.model.datatypes import Integrator, StateQuantities
from plumbline.model.sampling import derive_seed, random_states
from plumbline.processes.packed import Pickled
from plumbline.processes.workers import Outcome, Task
from plumbline.scenario.loader import Scenario
from plumbline.truth import ground_truth
from plumbline.truth.closed_form import closed_form_motion
from plumbline.truth.ground_truth import MotionTruth, StateTruth

if TYPE_CHECKING:
    from plumbline.execution.runner import Plan

STATES_PER_RANDOM_SCENARIO = 9  # random states of a probe: there are many probes
LEVELS_WITHOUT_TRUTH = ("relations", "endurance")  # levels judged without a truth

TaskKey = tuple[str, ...]  # scenario, engine or "truth" or "why", level, …


@dataclass(frozen=True)
class TruthFailure:
    """A truth that could not be had."""

    reason: str


class ScenarioRun:
    """A scenario's cells: ``keys`` of its tasks, and ``judged`` by key as their outcomes come."""

    def __init__(
        self, plan: Plan, scenario: Scenario, engines: dict[str, EngineInfo], is_random: bool = False
    ) -> None:
        self.plan, self.scenario, self.engines = plan, scenario, engines
        self.level = "state" if is_random else plan.level
        self.keys = list(task_keys(scenario.name, engines, self.level, plan.long_run_seconds > 0))
        self.pending_keys = set(self.keys)  # not answered yet
        self.findings_by_key: dict[TaskKey, JudgingResult] = {}
        self.truths: dict[str, StateTruth | MotionTruth | TruthFailure] = {}
        self.has_retried_truth = False  # whether the motion's truth was asked for a second time
        self.waiting_for_truth: list[Outcome] = []  # engines' answers that came before the truth
        self.state_truth: Pickled | None = None  # for those who judge and explain elsewhere
        count = (
            min(plan.random_state_count, STATES_PER_RANDOM_SCENARIO) if is_random else plan.random_state_count
        )
        drawn = random_states(scenario.model, count, derive_seed("states", scenario.digest))
        self.states = Pickled.of([scenario.state, *drawn])  # many tasks have them

    def tasks(self) -> Iterator[Task]:
        """Truths that are not there yet, then all cells but those of states, which follow their truth."""
        for key in self.keys:
            if key[1] != "truth":
                if key[2] != "state":
                    yield self.cell_task(key)
            elif key[2] not in self.truths:
                yield self.truth_task(key)

    def truth_task(self, key: TaskKey, *compiled_bodies: int) -> Task:
        """The task of what the engines are measured with; ``uncompiled``: 0 to do without a compiler."""
        s = self.scenario
        if key[2] == "state":
            return Task(key, ground_truth.state_truth, (s.model, self.states), self.plan.limits)
        closed = closed_form_motion(s)
        exact = (*closed(s.times), closed.source) if closed and closed.amplitude == 0 else None
        arguments = (s.model, s.state, s.times, exact, *compiled_bodies)
        return Task(key, ground_truth.motion_truth, arguments, self.plan.limits)

    def cell_task(self, key: TaskKey) -> Task:
        """The task of one cell."""
        s, (_, name, level, *rest) = self.scenario, key
        info = self.engines[name]
        call: Callable[..., Any] = {
            "state": calls.evaluate_states,
            "relations": metamorphic.check_relations,
        }.get(level, calls.run_refinement)
        arguments: tuple[Any, ...] = (s.model, self.states)
        if level == "trajectory":
            integrator = self.integrator(name, rest[0])
            steps = refinement_resolutions(integrator, s.model.n, s.duration, self.plan.extra_refinements)
            arguments = (integrator.name, s.model, s.state, s.times, steps)
        elif level == "endurance":
            call, integrator = run_long_run_study, self.integrator(name, rest[0])
            length = plan_long_run(integrator, s.model.n, self.plan.long_run_seconds)
            arguments = (integrator.name, s.model, s.state, s.sample_interval, length)
        base, _ = environments.split_version(name)
        judge = None
        if level == "state" and self.state_truth is not None:
            judge = partial(judge_states_pickled, self.subject(name), self.state_truth)
        return Task(key, call, (base, *arguments), self.plan.limits, info.version, info.python, judge)

    @property
    def is_done(self) -> bool:
        """Whether nothing is on its way any more."""
        return not self.pending_keys

    def findings(self) -> JudgingResult:
        """All that was found, in the order of the tasks, whichever answered first."""
        found = JudgingResult()
        for name, info in self.engines.items():
            if info.missing is not None:
                verdict: Verdict = Verdict.UNSUPPORTED if info.version else Verdict.NOT_INSTALLED
                found.rows.append(self.subject(name).make_row("state", "-", "all", verdict, info.missing))
            for key in self.keys:
                if key[1] == name and key in self.findings_by_key:
                    found.rows += self.findings_by_key[key].rows
                    found.tables += self.findings_by_key[key].tables
        found.rows = outlier.annotate_outliers(found.rows)
        return found

    def subject(self, engine: str) -> RowContext:
        """The subject of this scenario's rows about an engine."""
        info = self.engines[engine]
        return RowContext(self.scenario.name, self.scenario.family, engine, info.title, info.version)

    def integrator(self, engine: str, name: str) -> Integrator:
        """An engine's integrator by its name."""
        return next(i for i in self.engines[engine].integrators if i.name == name)

    def on_outcome(self, outcome: Outcome) -> list[Task]:
        """Keep a truth, judge an answer or let it wait for its truth; the tasks that follow."""
        if outcome.failure and outcome.key[1:] == ("truth", "trajectory") and not self.has_retried_truth:
            self.has_retried_truth = (
                True  # compiled code brought the worker down: a truth is to be had without
            )
            return [self.truth_task(outcome.key, 0)]
        self.pending_keys.discard(outcome.key)
        questions = []
        if outcome.key[1] == "why":
            self.add_diagnosis(outcome)
        elif outcome.key[1] != "truth":
            self.waiting_for_truth.append(outcome)
        else:
            self.truths[outcome.key[2]] = TruthFailure(outcome.failure) if outcome.failure else outcome.value
            if outcome.key[2] == "state":
                self.state_truth = None if outcome.failure else outcome.pickled
                questions = [
                    self.cell_task(key) for key in self.keys if key[1] != "truth" and key[2] == "state"
                ]
        waiting, self.waiting_for_truth = self.waiting_for_truth, []
        for answer in waiting:
            if answer.key[2] not in self.truths and answer.key[2] not in LEVELS_WITHOUT_TRUTH:
                self.waiting_for_truth.append(answer)
                continue
            found = self.findings_by_key[answer.key] = self.judge(answer)
            if answer.key[2] == "state" and any(row.verdict == Verdict.DISAGREES for row in found.rows):
                questions.append(self.diagnosis_task(answer.key[1], answer.value.quantities))
        self.pending_keys |= {task.key for task in questions}
        return questions

    def judge(self, outcome: Outcome) -> JudgingResult:
        """Verdicts on one cell."""
        _, engine, level, *integrators = outcome.key
        who, truth = self.subject(engine), self.truths.get(level)
        name = integrators[0] if integrators else "-"
        if outcome.failure or isinstance(truth, TruthFailure):
            lost = outcome.failure or f"no truth to judge by: {getattr(truth, 'reason', '')}"
            if level == "endurance":
                return JudgingResult(
                    rows=[who.make_row("invariants", name, "all_long", Verdict.FAILED, lost)]
                )
            return JudgingResult(rows=[who.make_row(level, name, "all", Verdict.FAILED, lost)])
        if outcome.judge_result is not None:
            found: JudgingResult = outcome.judge_result
        elif level == "endurance":
            integrator = self.integrator(engine, name)
            regular = self.scenario.closed_form is not None
            found = judge_long_runs(who, self.scenario.model, integrator, outcome.value, regular)
        elif truth is None:
            found = metamorphic.judge_relations(who, outcome.value)
        elif isinstance(truth, StateTruth):
            found = judge_states(who, truth, outcome.value)
        else:
            integrator = self.integrator(engine, name)
            found = judge_trajectory(who, self.scenario.model, truth, integrator, outcome.value)
        if self.plan.user_rtol is not None:
            found.rows = [replace(row, user_rtol=self.plan.user_rtol) for row in found.rows]
        return found

    def diagnosis_task(self, engine: str, engine_quantities: list[StateQuantities]) -> Task:
        """Which term is it, in a cell that disagrees at state level?"""
        (base, _), info = environments.split_version(engine), self.engines[engine]
        arguments = (base, self.scenario.model, engine_quantities, self.state_truth)
        key = (self.scenario.name, "why", engine)
        return Task(key, explain_disagreement, arguments, self.plan.limits, info.version, info.python)

    def add_diagnosis(self, outcome: Outcome) -> None:
        """Take the answer to a question into the rows that disagree."""
        text = outcome.value or f"no diagnosis: {outcome.failure}"
        cell = self.findings_by_key[self.scenario.name, outcome.key[2], "state"]
        cell.rows = [replace(r, diagnosis=text) if r.verdict == Verdict.DISAGREES else r for r in cell.rows]

    def summary(self) -> dict[str, Any]:
        """What the store keeps of the scenario."""
        s, truth = self.scenario, self.truths.get("trajectory")
        about = {
            "family": s.family,
            "title": s.title,
            "purpose": s.purpose,
            "file": s.path.name,
            "bodies": s.model.n,
            "joints": ["rod" if rod else "ball" for rod in s.model.rods],
            "duration": s.duration,
            "sample": s.sample_interval,
            "exact": s.closed_form,
            "digest": s.digest,
            "model": {key: np.asarray(value).tolist() for key, value in vars(s.model).items()},
            "state": {key: getattr(s.state, key).tolist() for key in ("p", "omega", "u", "udot")},
        }
        if isinstance(truth, MotionTruth):
            about |= {
                "horizon": truth.horizon,
                "growth": float(truth.growth[-1]),
                "truth": truth.method,
                "truth_uncertainty": float(truth.position_uncertainty[-1]),
            }
        return about


def task_keys(
    scenario: str, engines: dict[str, EngineInfo], level: str, long_runs: bool = False
) -> Iterator[TaskKey]:
    """The keys of a scenario's tasks, in the order in which they are made."""
    levels = [one for one in ("state", "trajectory") if level in (one, "all")]
    yield from ((scenario, "truth", one) for one in levels)
    for name, info in engines.items():
        if info.missing is not None:
            continue
        if "state" in levels:
            yield scenario, name, "state"
        if level == "all":
            yield scenario, name, "relations"
        if "trajectory" in levels:
            yield from ((scenario, name, "trajectory", i.name) for i in info.integrators)
            if long_runs:
                yield from ((scenario, name, "endurance", i.name) for i in info.integrators)
