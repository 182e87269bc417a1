"""The matrix: scenarios × engines × levels, through workers, to judged rows and tables."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from plumbline import known, relations, reproduce, store, versions, work, yardstick
from plumbline.converge import ladder
from plumbline.exact import solution
from plumbline.findings import Findings, Subject
from plumbline.motion_verdicts import judge_motion
from plumbline.records import Row, StateQuantities, Verdict
from plumbline.sampling import random_states, seed_of
from plumbline.scenario import Scenario
from plumbline.state_verdicts import judge_states
from plumbline.work import EngineInfo
from plumbline.workers import Limits, Memory, NoCrew, Outcome, Task, Workers
from plumbline.yardstick import ROUNDING, MotionTruth, StateTruth

if TYPE_CHECKING:
    from plumbline.cluster import Cluster

STATES = 50  # random states per scenario, besides the initial one
PROBE_STATES = 9  # the same of a probe: there are many of them
HORIZON_TOLERANCE = 1e-9  # m: positions are compared while rounding, grown, stays below this

Levels = Literal["state", "trajectory", "all"]
Progress = Callable[[int, int, str], None]  # done, total, what was last


@dataclass(frozen=True)
class Plan:
    """What to run."""

    scenarios: Sequence[Scenario]
    engines: Sequence[str]
    level: Levels = "all"
    jobs: int = 1
    limits: Limits = field(default_factory=Limits)
    states: int = STATES
    finer: int = 0  # how many times the finest step halves beyond the quick form
    accept: float | None = None  # relative to each quantity's scale; shown beside the verdict only
    whole: bool = False  # the full catalogue on all engines: every known entry must occur
    scheduler: str | None = None  # address of a dask cluster to run on, instead of ``jobs`` workers here
    probes: frozenset[str] = frozenset()  # names of scenarios asked about at state level only, at few states
    memory: Memory = field(default_factory=Memory)  # of cells that need not run again


@dataclass
class Result:
    """A judged run, as the store writes it and the command line tells it."""

    rows: list[Row]
    stale: list[known.Entry]
    engines: dict[str, EngineInfo]
    scenarios: dict[str, dict[str, Any]]
    tables: dict[str, list[dict[str, Any]]]
    run: dict[str, Any]


def describe_all(workers: Workers | Cluster, engines: Sequence[str]) -> dict[str, EngineInfo]:
    """Every engine's description, of the version asked for; one that crashes on import is missing for it."""
    found: dict[str, EngineInfo] = {}
    tasks = []
    for name in engines:
        base, version = versions.split(name)
        try:
            python = versions.interpreter(name) if version else ""
        except versions.NoSuchEnvironment as error:
            found[name] = EngineInfo(name, name, "", (), str(error))
            continue
        tasks.append(Task(name, work.describe, (base,), workers.limits, python=python))
    pythons = {task.key: task.python for task in tasks}
    for outcome in workers.run(tasks):
        name = outcome.key
        info = outcome.value or EngineInfo(name, name, "", (), outcome.lost)
        if pythons[name]:
            title = info.title if info.missing else f"{info.title} {info.version}"
            info = replace(info, name=name, title=title, python=pythons[name])
        found[name] = info
    return {name: found[name] for name in engines}


def execute(plan: Plan, progress: Progress) -> Result:
    """Run the whole plan; cells that are lost become rows that say so."""
    begin, started = time.monotonic(), datetime.now(UTC)
    with crew(plan) as workers:
        engines = describe_all(workers, plan.engines)
        # the longest first, so that no long task is left alone at the end
        order = sorted(plan.scenarios, key=lambda s: -s.model.n)
        benches = {s.name: Bench(plan, s, engines) for s in order}
        tasks = [task for bench in benches.values() for task in bench.tasks()]
        for done, outcome in enumerate(workers.run(tasks, plan.memory), start=1):
            benches[outcome.key[0]].take(outcome)
            progress(done, len(tasks), " ".join(outcome.key))
        questions = [task for bench in benches.values() for task in bench.questions()]
        for outcome in workers.run(questions):
            benches[outcome.key[0]].explain(outcome)
    found = Findings()
    for scenario in plan.scenarios:
        found.extend(benches[scenario.name].findings())
    judged = known.excuse(found.rows, known.load(), whole=plan.whole, finer=plan.finer > 0)
    summaries = {s.name: benches[s.name].summary() for s in plan.scenarios}
    result = Result(judged.rows, judged.stale, engines, summaries, found.tables(), {})
    result.run = {
        "id": started.strftime("%Y%m%dT%H%M%SZ"),
        "started": started.isoformat(timespec="seconds"),
        "duration": time.monotonic() - begin,
        "platform": platform.platform(),
        "machine": {"processor": platform.machine(), "cores": str(os.cpu_count()), "jobs": str(plan.jobs)},
        "commit": commit(),
        "python": platform.python_version(),
        "versions": {name: info.version for name, info in engines.items()},
        "truth": truth_words(benches.values()),
        "level": plan.level,
        "states": plan.states + 1,
        "sentence": sentence(result),
        "exit_code": exit_code(result),
        "stale": [entry.id for entry in judged.stale],
    }
    return result


def crew(plan: Plan) -> Workers | Cluster:
    """Those who do the work: worker processes here, or a cluster's."""
    if plan.scheduler is None:
        return Workers(plan.jobs, plan.limits)
    try:
        from plumbline.cluster import Cluster  # an optional dependency
    except ImportError as error:
        raise NoCrew(f"a cluster needs the packages of the group `cluster`: {error}") from None
    return Cluster(plan.scheduler, plan.limits)


def save(result: Result, folder: Path, command: str) -> None:
    """Store a result in ``folder``, with a script for every disagreement that one can be made of."""
    engines = {
        name: {**asdict(replace(info, python="")), "installed": info.missing is None}
        for name, info in result.engines.items()
    }
    run = {**result.run, "command": command}
    store.write(folder, run, result.scenarios, engines, result.rows, result.tables)
    reproduce.write(folder)


class Bench:
    """One scenario on all engines: makes the tasks, takes their outcomes, judges once the truth is there."""

    def __init__(self, plan: Plan, scenario: Scenario, engines: dict[str, EngineInfo]) -> None:
        self.plan, self.scenario, self.engines = plan, scenario, engines
        self.judged: dict[Any, Findings] = {}  # by cell, in the order of the tasks
        self.truths: dict[str, StateTruth | MotionTruth | Lost] = {}
        self.early: list[Outcome] = []  # engines' answers that came before the truth
        self.disputed: dict[Any, list[StateQuantities]] = {}  # answers of cells that disagree at state level
        probe = scenario.name in plan.probes
        self.level: Levels = "state" if probe else plan.level
        count = min(plan.states, PROBE_STATES) if probe else plan.states
        self.states = [
            scenario.state,
            *random_states(scenario.model, count, seed_of("states", scenario.digest)),
        ]

    def tasks(self) -> Iterator[Task]:
        """Truth first (unless it is there already), then every engine's cells."""
        s, limits = self.scenario, self.plan.limits
        if self.level in ("state", "all") and "state" not in self.truths:
            yield Task((s.name, "truth", "state"), yardstick.state_truth, (s.model, self.states), limits)
        if self.level in ("trajectory", "all") and "trajectory" not in self.truths:
            closed = solution(s)
            exact = (*closed(s.times), closed.source) if closed and closed.amplitude == 0 else None
            arguments = (s.model, s.state, s.times, exact)
            yield Task((s.name, "truth", "trajectory"), yardstick.motion_truth, arguments, limits)
        for name, info in self.engines.items():
            if info.missing is not None:
                verdict: Verdict = "unsupported" if info.version else "not installed"
                row = self.who(name).row("state", "-", "all", verdict, info.missing)
                self.judged[s.name, name] = Findings([row])
                continue
            if self.level in ("state", "all"):
                yield self.cell((s.name, name, "state"), work.evaluate, s.model, self.states)
            if self.level == "all":
                yield self.cell((s.name, name, "relations"), relations.check, s.model, self.states)
            if self.level in ("trajectory", "all"):
                for integrator in info.integrators:
                    steps = ladder(integrator, s.model.n, s.duration, self.plan.finer)
                    key = (s.name, name, "trajectory", integrator.name)
                    yield self.cell(key, work.climb, integrator.name, s.model, s.state, s.times, steps)

    def cell(self, key: tuple[str, ...], call: Callable[..., Any], *arguments: Any) -> Task:
        """The task of one cell; its place among the findings is that of its making."""
        self.judged[key] = Findings()
        base, _ = versions.split(key[1])
        info = self.engines[key[1]]
        return Task(key, call, (base, *arguments), self.plan.limits, info.version, info.python)

    def findings(self) -> Findings:
        """All that was found, in the order of the tasks, whichever answered first."""
        found = Findings()
        for part in self.judged.values():
            found.extend(part)
        return found

    def who(self, engine: str) -> Subject:
        """The subject of this scenario's rows about an engine."""
        info = self.engines[engine]
        return Subject(self.scenario.name, self.scenario.family, engine, info.title, info.version)

    def take(self, outcome: Outcome) -> None:
        """Keep a truth and judge what waited for it; judge an answer or let it wait."""
        _, subject, level, *_ = outcome.key
        if subject != "truth":
            self.early.append(outcome)
        elif outcome.lost is None:
            self.truths[level] = outcome.value
        else:
            self.truths[level] = Lost(outcome.lost)
        waiting, self.early = self.early, []
        for answer in waiting:
            if answer.key[2] in self.truths or answer.key[2] == "relations":
                self.judged[answer.key] = self.judge(answer)
            else:
                self.early.append(answer)

    def judge(self, outcome: Outcome) -> Findings:
        """Verdicts on one cell."""
        _, engine, level, *integrators = outcome.key
        who, truth = self.who(engine), self.truths.get(level)
        name = integrators[0] if integrators else "-"
        if outcome.lost or isinstance(truth, Lost):
            lost = outcome.lost or f"no truth to judge by: {getattr(truth, 'reason', '')}"
            return Findings(rows=[who.row(level, name, "all", "failed", lost)])
        if truth is None:
            found = relations.judge_relations(who, outcome.value)
        elif isinstance(truth, StateTruth):
            found = judge_states(who, truth, outcome.value)
            if any(row.verdict == "disagrees" for row in found.rows):
                self.disputed[outcome.key] = outcome.value.quantities
        else:
            integrator = next(i for i in self.engines[engine].integrators if i.name == name)
            horizon = horizon_of(truth)
            found = judge_motion(who, self.scenario.model, truth, integrator, outcome.value, horizon)
        if self.plan.accept is not None:
            found.rows = [replace(row, accept=self.plan.accept) for row in found.rows]
        return found

    def questions(self) -> Iterator[Task]:
        """One task per cell that disagrees at state level: which term is it?"""
        for key, said in self.disputed.items():
            (base, _), info = versions.split(key[1]), self.engines[key[1]]
            arguments = (base, self.scenario.model, said, self.truths["state"])
            yield Task(key, work.explain, arguments, self.plan.limits, info.version, info.python)

    def explain(self, outcome: Outcome) -> None:
        """Take the answer to a question into the rows that disagree."""
        text = outcome.value or f"no diagnosis: {outcome.lost}"
        cell = self.judged[outcome.key]
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


@dataclass(frozen=True)
class Lost:
    """A truth that could not be had."""

    reason: str


def horizon_of(truth: MotionTruth) -> float:
    """T_h in s: the last sample at which rounding and the truth's error, grown, are below the tolerance."""
    reached = truth.length * ROUNDING * truth.growth + truth.position_uncertainty
    good = np.maximum.accumulate(reached) <= HORIZON_TOLERANCE
    return float(truth.trajectory.t[np.flatnonzero(good)[-1]]) if good.any() else 0.0


def truth_words(benches: Iterable[Bench]) -> str:
    """What the verdicts were measured with, and on how many scenarios each."""
    methods = Counter(
        f"{level} level: {truth.method}"
        for bench in benches
        for level, truth in bench.truths.items()
        if not isinstance(truth, Lost)
    )
    return "; ".join(f"{method} ({number} scenarios)" for method, number in methods.most_common())


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Rows by verdict, in a fixed order, without those that have none."""
    names = ("agrees", "disagrees", "unresolved", "unsupported", "not installed", "failed")
    found = {name: sum(row.verdict == name for row in rows) for name in names}
    return {name: number for name, number in found.items() if number}


def sentence(result: Result) -> str:
    """The verdict in one sentence: counts, the disagreements by name, what is expected."""
    verb = {"agrees": "agree", "disagrees": "disagree"}
    parts = []
    for verdict, number in counts(result.rows).items():
        part = f"{number} {verb.get(verdict, verdict)}"
        new = [row for row in result.rows if row.verdict == verdict and row.known is None]
        old = number - len(new)
        aliases = sum(row.alias_of is not None for row in result.rows if row.verdict == verdict)
        if verdict == "agrees" and aliases:
            part += f" ({aliases} by an alias of another integrator)"
        if verdict in ("disagrees", "failed") and new:
            named = list(dict.fromkeys(f"{row.engine}, {row.scenario}: {row.quantity}" for row in new))
            more = f" and {len(named) - 3} more" if len(named) > 3 else ""
            part += f" ({'; '.join(named[:3])}{more})"
        if old:
            part += f" ({old} as recorded)"
        parts.append(part)
    text = ", ".join(parts) or "nothing was compared"
    if result.stale:
        text += (
            f"; {len(result.stale)} known entries no longer occur ({', '.join(e.id for e in result.stale)})"
        )
    return text


def exit_code(result: Result) -> int:
    """0 all agree or differ as recorded; 1 a disagreement or an unexpected gap; 3 an engine failed."""
    new = {row.verdict for row in result.rows if row.known is None}
    if "failed" in new:
        return 3
    return 1 if new & {"disagrees", "unresolved", "unsupported"} or result.stale else 0


def commit() -> str | None:
    """The checkout's commit, with a + where files differ from it; None outside git."""
    here = Path(__file__).parent
    try:
        done = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--abbrev=12"],
            cwd=here, capture_output=True, text=True, check=True, timeout=10,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
