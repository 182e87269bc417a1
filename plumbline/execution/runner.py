"""The matrix: scenarios × engines × levels, through workers, to judged rows and tables."""

from __future__ import annotations

import itertools
import os
import platform
import subprocess
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from plumbline.engines import calls, environments
from plumbline.engines.adapter import EngineInfo
from plumbline.execution.random_batch import RandomBatch
from plumbline.execution.scenario_run import ScenarioRun, TruthFailure, task_keys
from plumbline.judging import known_issues
from plumbline.judging.rows import Row, Verdict
from plumbline.processes.cpu_time import CpuTimes
from plumbline.processes.workers import ExecutorUnavailable, Limits, ResultCache, Task, WorkerPool
from plumbline.reproduce import write
from plumbline.scenario.loader import Scenario
from plumbline.storage import results_store

if TYPE_CHECKING:
    from plumbline.processes.dask_cluster import DaskCluster

RANDOM_STATES = 50  # random states per scenario, besides the initial one

LevelSelection = Literal["state", "trajectory", "all"]
ProgressCallback = Callable[[int, int, str], None]  # done, total, what was last


@dataclass(frozen=True)
class Plan:
    """What to run."""

    scenarios: Sequence[Scenario]
    engines: Sequence[str]
    level: LevelSelection = "all"
    jobs: int = 1
    limits: Limits = field(default_factory=Limits)
    random_state_count: int = RANDOM_STATES
    extra_refinements: int = 0  # how many times the finest step halves beyond the quick form
    long_run_seconds: float = 0.0  # s of the long runs whose invariants are judged; 0: none
    user_rtol: float | None = None  # relative to each quantity's scale; shown beside the verdict only
    is_full_catalogue: bool = False  # the full catalogue on all engines: every known entry must occur
    scheduler: str | None = None  # address of a dask cluster to run on, instead of ``jobs`` workers here
    random_scenarios: Sequence[
        Scenario
    ] = ()  # asked about at state level only, at few states; may be made one by one
    result_cache: ResultCache = field(default_factory=ResultCache)  # of cells that need not run again


@dataclass
class RunResult:
    """A judged run, as the store writes it and the command line tells it.

    ``rows`` are those of the scenarios, and of the probes those that someone should see; the summary
    in ``tables`` has them all, and ``probes`` says what they came to.
    """

    rows: list[Row]
    stale_entries: list[known_issues.KnownIssue]
    engines: dict[str, EngineInfo]
    scenarios: dict[str, dict[str, Any]]
    random_batch: RandomBatch
    tables: results_store.ResultTables
    cpu_times: CpuTimes
    metadata: dict[str, Any]


def describe_engines(workers: WorkerPool | DaskCluster, engines: Sequence[str]) -> dict[str, EngineInfo]:
    """Every engine's description, of the version asked for; one that crashes on import is missing for it."""
    found: dict[str, EngineInfo] = {}
    tasks = []
    for name in engines:
        base, version = environments.split_version(name)
        try:
            python = environments.ensure_interpreter(name) if version else ""
        except environments.EnvironmentUnavailable as error:
            found[name] = EngineInfo(name, name, "", (), str(error))
            continue
        tasks.append(Task(name, calls.describe_engine, (base,), workers.limits, python=python))
    pythons = {task.key: task.python for task in tasks}
    for outcome in workers.run(tasks):
        name = outcome.key
        info = outcome.value or EngineInfo(name, name, "", (), outcome.failure)
        if pythons[name]:
            title = info.title if info.missing else f"{info.title} {info.version}"
            info = replace(info, name=name, title=title, python=pythons[name])
        found[name] = info
    return {name: found[name] for name in engines}


def run_plan(plan: Plan, progress: ProgressCallback) -> RunResult:
    """Run the whole plan; cells that are lost become rows that say so."""
    begin, started = time.monotonic(), datetime.now(UTC)
    excuses, tables, probes = (
        known_issues.KnownIssues(known_issues.load_known_issues(), plan.extra_refinements > 0),
        results_store.ResultTables(),
        RandomBatch(),
    )
    rows: dict[str, list[Row]] = {s.name: [] for s in plan.scenarios}
    summaries: dict[str, dict[str, Any]] = {s.name: {} for s in plan.scenarios}
    methods: Counter[str] = Counter()
    split = CpuTimes()
    open_: dict[str, ScenarioRun] = {}  # in the order of their making, which is that of the tables
    questions: deque[Task] = deque()

    def tasks() -> Iterator[Task | None]:
        # the longest first, so that no long task is left alone at the end
        order = sorted(plan.scenarios, key=lambda s: -s.model.n)
        for number, scenario in enumerate(itertools.chain(order, plan.random_scenarios)):
            bench = open_[scenario.name] = ScenarioRun(plan, scenario, engines, number >= len(order))
            for task in bench.tasks():
                while questions:
                    yield questions.popleft()
                yield task
        while open_:
            yield questions.popleft() if questions else None

    def finish_scenario(bench: ScenarioRun) -> None:
        found = bench.findings()
        marked = excuses.mark_known(found.rows)
        methods.update(describe_truth_methods(bench))
        tables.add_rows(marked)
        if bench.scenario.name not in rows:  # a probe
            marked = probes.add_scenario(marked)
            if not marked:
                return
        for name, columns in found.tables:
            tables.add(name, columns)
        rows[bench.scenario.name] = marked
        summaries[bench.scenario.name] = bench.summary()

    with split.measure_overhead(), make_executor(plan) as workers:
        engines = describe_engines(workers, plan.engines)
        total = sum(
            sum(1 for _ in task_keys("", engines, plan.level, plan.long_run_seconds > 0))
            for _ in plan.scenarios
        )
        total += len(plan.random_scenarios) * sum(1 for _ in task_keys("", engines, "state"))
        done = 0
        for outcome in workers.run(tasks(), split.timed_cache(plan.result_cache)):
            split.add_outcome(outcome)
            with split.measure("judging"):
                asked = open_[outcome.key[0]].on_outcome(outcome)
                while open_ and (first := next(iter(open_.values()))).is_done:
                    finish_scenario(open_.pop(first.scenario.name))
            questions.extend(asked)
            done, total = done + 1, total + sum(task.key[1] == "why" for task in asked)
            progress(done, total, " ".join(outcome.key))
    result = RunResult(
        [row for name in rows for row in rows[name]],
        excuses.stale_issues(is_full_matrix=plan.is_full_catalogue),
        engines, summaries, probes, tables, split, {},
    )  # fmt: skip
    result.metadata = {
        "id": started.strftime("%Y%m%dT%H%M%SZ"),
        "started": started.isoformat(timespec="seconds"),
        "duration": time.monotonic() - begin,
        "platform": platform.platform(),
        "machine": {"processor": platform.machine(), "cores": str(os.cpu_count()), "jobs": str(plan.jobs)},
        "commit": git_commit(),
        "python": platform.python_version(),
        "versions": {name: info.version for name, info in engines.items()},
        "truth": "; ".join(f"{method} ({number} scenarios)" for method, number in methods.most_common()),
        "level": plan.level,
        "states": plan.random_state_count + 1,
        "sentence": summarize_verdicts(result),
        "exit_code": exit_code(result),
        "stale_issues": [entry.id for entry in result.stale_entries],
    }
    if len(plan.random_scenarios):
        result.metadata["random_batch"] = probes.summary()
    return result


def make_executor(plan: Plan) -> WorkerPool | DaskCluster:
    """Those who do the work: worker processes here, or a cluster's."""
    if plan.scheduler is None:
        return WorkerPool(plan.jobs, plan.limits)
    try:
        from plumbline.processes.dask_cluster import DaskCluster  # an optional dependency
    except ImportError as error:
        raise ExecutorUnavailable(f"a cluster needs the packages of the group `cluster`: {error}") from None
    return DaskCluster(plan.scheduler, plan.limits)


def save(result: RunResult, folder: Path, command: str) -> None:
    """Store a result in ``folder``, with a script for every disagreement that one can be made of."""
    engines = {
        name: {**asdict(replace(info, python="")), "installed": info.missing is None}
        for name, info in result.engines.items()
    }
    run = {**result.metadata, "command": command, "cpu": result.cpu_times.seconds}
    with result.cpu_times.measure("storage"):
        results_store.write_results(folder, run, result.scenarios, engines, result.rows, result.tables)
    with result.cpu_times.measure("report"):
        write.write(folder)


def describe_truth_methods(bench: ScenarioRun) -> list[str]:
    """What a scenario's verdicts were measured with, by level."""
    return [
        f"{level} level: {truth.method}"
        for level, truth in bench.truths.items()
        if not isinstance(truth, TruthFailure)
    ]


def summarize_verdicts(result: RunResult) -> str:
    """The verdict in one sentence: counts, the disagreements by name, what is expected."""
    verb = {Verdict.AGREES: "agree", Verdict.DISAGREES: "disagree"}
    parts = []
    for verdict in Verdict:
        here = [row for row in result.rows if row.verdict == verdict]
        number = len(here) + result.random_batch.counts_by_verdict[verdict]
        if not number:
            continue
        part = f"{number} {verb.get(verdict, verdict)}"
        new = [row for row in here if row.known_issue is None]
        # of probes only what is recorded or agrees, and engines that are not installed, are not in the rows
        old = 0 if verdict in (Verdict.AGREES, Verdict.NOT_INSTALLED) else number - len(new)
        aliases = sum(row.alias_of is not None for row in here)
        if verdict == Verdict.AGREES and aliases:
            part += f" ({aliases} by an alias of another integrator)"
        if verdict in (Verdict.DISAGREES, Verdict.FAILED) and new:
            named = list(dict.fromkeys(f"{row.engine}, {row.scenario}: {row.quantity}" for row in new))
            more = f" and {len(named) - 3} more" if len(named) > 3 else ""
            part += f" ({'; '.join(named[:3])}{more})"
        if old:
            part += f" ({old} as recorded)"
        parts.append(part)
    text = ", ".join(parts) or "nothing was compared"
    if result.stale_entries:
        text += f"; {len(result.stale_entries)} known entries no longer occur ({', '.join(e.id for e in result.stale_entries)})"
    return text


def exit_code(result: RunResult) -> int:
    """0 all agree or differ as recorded; 1 a disagreement or an unexpected gap; 3 an engine failed."""
    new = {row.verdict for row in result.rows if row.known_issue is None}
    if Verdict.FAILED in new:
        return 3
    return (
        1 if new & {Verdict.DISAGREES, Verdict.UNRESOLVED, Verdict.UNSUPPORTED} or result.stale_entries else 0
    )


def git_commit() -> str | None:
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
