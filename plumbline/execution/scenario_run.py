"""One scenario on all engines: makes the tasks, judges their outcomes once the truth is there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from plumbline.engines import calls, environments
from plumbline.engines.calls import EngineInfo
from plumbline.judging import metamorphic, outlier
from plumbline.judging.convergence import ladder
from plumbline.judging.long_runs import course, endure, judge_endurance
from plumbline.judging.rows import Findings, Subject
from plumbline.judging.state import judge_packed, judge_states
from plumbline.judging.trajectory import judge_motion
from plumbline.model.datatypes import Integrator, StateQuantities, Verdict
from plumbline.model.sampling import random_states, seed_of
from plumbline.processes.packed import Packed
from plumbline.processes.workers import Outcome, Task
from plumbline.scenario.loader import Scenario
from plumbline.truth import ground_truth
from plumbline.truth.closed_form import solution
from plumbline.truth.ground_truth import ROUNDING, MotionTruth, StateTruth

if TYPE_CHECKING:
    from plumbline.execution.runner import Plan

PROBE_STATES = 9  # random states of a probe: there are many probes
TRUTHLESS = ("relations", "endurance")  # levels judged without a truth
HORIZON_TOLERANCE = 1e-9  # m: positions are compared while rounding, grown, stays below this

Key = tuple[str, ...]  # scenario, engine or "truth" or "why", level, …


@dataclass(frozen=True)
class Lost:
    """A truth that could not be had."""

    reason: str


class Bench:
    """A scenario's cells: ``keys`` of its tasks, and ``judged`` by key as their outcomes come."""

    def __init__(
        self, plan: Plan, scenario: Scenario, engines: dict[str, EngineInfo], probe: bool = False
    ) -> None:
        self.plan, self.scenario, self.engines = plan, scenario, engines
        self.level = "state" if probe else plan.level
        self.keys = list(keys(scenario.name, engines, self.level, plan.endurance > 0))
        self.open = set(self.keys)  # not answered yet
        self.judged: dict[Key, Findings] = {}
        self.truths: dict[str, StateTruth | MotionTruth | Lost] = {}
        self.again = False  # whether the motion's truth was asked for a second time
        self.early: list[Outcome] = []  # engines' answers that came before the truth
        self.state_truth: Packed | None = None  # for those who judge and explain elsewhere
        count = min(plan.states, PROBE_STATES) if probe else plan.states
        drawn = random_states(scenario.model, count, seed_of("states", scenario.digest))
        self.states = Packed.of([scenario.state, *drawn])  # many tasks have them

    def tasks(self) -> Iterator[Task]:
        """Truths that are not there yet, then all cells but those of states, which follow their truth."""
        for key in self.keys:
            if key[1] != "truth":
                if key[2] != "state":
                    yield self.cell(key)
            elif key[2] not in self.truths:
                yield self.truth(key)

    def truth(self, key: Key, *uncompiled: int) -> Task:
        """The task of what the engines are measured with; ``uncompiled``: 0 to do without a compiler."""
        s = self.scenario
        if key[2] == "state":
            return Task(key, ground_truth.state_truth, (s.model, self.states), self.plan.limits)
        closed = solution(s)
        exact = (*closed(s.times), closed.source) if closed and closed.amplitude == 0 else None
        arguments = (s.model, s.state, s.times, exact, *uncompiled)
        return Task(key, ground_truth.motion_truth, arguments, self.plan.limits)

    def cell(self, key: Key) -> Task:
        """The task of one cell."""
        s, (_, name, level, *rest) = self.scenario, key
        info = self.engines[name]
        call: Callable[..., Any] = {"state": calls.evaluate, "relations": metamorphic.check}.get(
            level, calls.climb
        )
        arguments: tuple[Any, ...] = (s.model, self.states)
        if level == "trajectory":
            integrator = self.integrator(name, rest[0])
            steps = ladder(integrator, s.model.n, s.duration, self.plan.finer)
            arguments = (integrator.name, s.model, s.state, s.times, steps)
        elif level == "endurance":
            call, integrator = endure, self.integrator(name, rest[0])
            length = course(integrator, s.model.n, self.plan.endurance)
            arguments = (integrator.name, s.model, s.state, s.sample, length)
        base, _ = environments.split(name)
        judge = None
        if level == "state" and self.state_truth is not None:
            judge = partial(judge_packed, self.who(name), self.state_truth)
        return Task(key, call, (base, *arguments), self.plan.limits, info.version, info.python, judge)

    @property
    def done(self) -> bool:
        """Whether nothing is on its way any more."""
        return not self.open

    def findings(self) -> Findings:
        """All that was found, in the order of the tasks, whichever answered first."""
        found = Findings()
        for name, info in self.engines.items():
            if info.missing is not None:
                verdict: Verdict = "unsupported" if info.version else "not installed"
                found.rows.append(self.who(name).row("state", "-", "all", verdict, info.missing))
            for key in self.keys:
                if key[1] == name and key in self.judged:
                    found.rows += self.judged[key].rows
                    found.tables += self.judged[key].tables
        found.rows = outlier.told(found.rows)
        return found

    def who(self, engine: str) -> Subject:
        """The subject of this scenario's rows about an engine."""
        info = self.engines[engine]
        return Subject(self.scenario.name, self.scenario.family, engine, info.title, info.version)

    def integrator(self, engine: str, name: str) -> Integrator:
        """An engine's integrator by its name."""
        return next(i for i in self.engines[engine].integrators if i.name == name)

    def take(self, outcome: Outcome) -> list[Task]:
        """Keep a truth, judge an answer or let it wait for its truth; the tasks that follow."""
        if outcome.lost and outcome.key[1:] == ("truth", "trajectory") and not self.again:
            self.again = True  # compiled code brought the worker down: a truth is to be had without
            return [self.truth(outcome.key, 0)]
        self.open.discard(outcome.key)
        questions = []
        if outcome.key[1] == "why":
            self.explain(outcome)
        elif outcome.key[1] != "truth":
            self.early.append(outcome)
        else:
            self.truths[outcome.key[2]] = Lost(outcome.lost) if outcome.lost else outcome.value
            if outcome.key[2] == "state":
                self.state_truth = None if outcome.lost else outcome.packed
                questions = [self.cell(key) for key in self.keys if key[1] != "truth" and key[2] == "state"]
        waiting, self.early = self.early, []
        for answer in waiting:
            if answer.key[2] not in self.truths and answer.key[2] not in TRUTHLESS:
                self.early.append(answer)
                continue
            found = self.judged[answer.key] = self.judge(answer)
            if answer.key[2] == "state" and any(row.verdict == "disagrees" for row in found.rows):
                questions.append(self.question(answer.key[1], answer.value.quantities))
        self.open |= {task.key for task in questions}
        return questions

    def judge(self, outcome: Outcome) -> Findings:
        """Verdicts on one cell."""
        _, engine, level, *integrators = outcome.key
        who, truth = self.who(engine), self.truths.get(level)
        name = integrators[0] if integrators else "-"
        if outcome.lost or isinstance(truth, Lost):
            lost = outcome.lost or f"no truth to judge by: {getattr(truth, 'reason', '')}"
            if level == "endurance":
                return Findings(rows=[who.row("invariants", name, "all_long", "failed", lost)])
            return Findings(rows=[who.row(level, name, "all", "failed", lost)])
        if outcome.judged is not None:
            found: Findings = outcome.judged
        elif level == "endurance":
            integrator = self.integrator(engine, name)
            regular = self.scenario.exact is not None
            found = judge_endurance(who, self.scenario.model, integrator, outcome.value, regular)
        elif truth is None:
            found = metamorphic.judge_relations(who, outcome.value)
        elif isinstance(truth, StateTruth):
            found = judge_states(who, truth, outcome.value)
        else:
            integrator = self.integrator(engine, name)
            horizon = horizon_of(truth)
            found = judge_motion(who, self.scenario.model, truth, integrator, outcome.value, horizon)
        if self.plan.accept is not None:
            found.rows = [replace(row, accept=self.plan.accept) for row in found.rows]
        return found

    def question(self, engine: str, said: list[StateQuantities]) -> Task:
        """Which term is it, in a cell that disagrees at state level?"""
        (base, _), info = environments.split(engine), self.engines[engine]
        arguments = (base, self.scenario.model, said, self.state_truth)
        key = (self.scenario.name, "why", engine)
        return Task(key, calls.explain, arguments, self.plan.limits, info.version, info.python)

    def explain(self, outcome: Outcome) -> None:
        """Take the answer to a question into the rows that disagree."""
        text = outcome.value or f"no diagnosis: {outcome.lost}"
        cell = self.judged[self.scenario.name, outcome.key[2], "state"]
        cell.rows = [replace(r, diagnosis=text) if r.verdict == "disagrees" else r for r in cell.rows]

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
            "sample": s.sample,
            "exact": s.exact,
            "digest": s.digest,
            "model": {key: np.asarray(value).tolist() for key, value in vars(s.model).items()},
            "state": {key: getattr(s.state, key).tolist() for key in ("p", "omega", "u", "udot")},
        }
        if isinstance(truth, MotionTruth):
            about |= {
                "horizon": horizon_of(truth),
                "growth": float(truth.growth[-1]),
                "truth": truth.method,
                "truth_uncertainty": float(truth.position_uncertainty[-1]),
            }
        return about


def keys(scenario: str, engines: dict[str, EngineInfo], level: str, endurance: bool = False) -> Iterator[Key]:
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
            if endurance:
                yield from ((scenario, name, "endurance", i.name) for i in info.integrators)


def horizon_of(truth: MotionTruth) -> float:
    """T_h in s: the last sample at which rounding and the truth's error, grown, are below the tolerance."""
    reached = truth.length * ROUNDING * truth.growth + truth.position_uncertainty
    good = np.maximum.accumulate(reached) <= HORIZON_TOLERANCE
    return float(truth.trajectory.t[np.flatnonzero(good)[-1]]) if good.any() else 0.0
