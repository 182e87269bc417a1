"""Run a plan: scenarios × engines × levels, through workers, to judged rows and tables."""

from __future__ import annotations

import itertools
import os
import platform
import subprocess
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from plumbline.engines import engine_calls, environments
from plumbline.engines.adapter import EngineInfo
from plumbline.engines.importer_calls import describe_importer
from plumbline.engines.specifications import task_engine
from plumbline.engines.surface import SURFACES, SurfaceChanges, surface_changes
from plumbline.execution.exit_codes import ExitCode
from plumbline.execution.plan import (
    Plan,
    ProgressCallback,
    RunObserver,
    TaskKey,
    TaskKind,
    scenario_level,
    task_keys,
)
from plumbline.execution.random_batch import RandomBatch
from plumbline.execution.scenario_verdicts import ScenarioRun
from plumbline.judging import known_issues
from plumbline.judging.findings import Finding, find_findings
from plumbline.judging.identity import RUN_SCENARIO, IdentityCheck
from plumbline.judging.rows import RUN_FAMILY, Row, Verdict
from plumbline.layout import IS_INSTALLED
from plumbline.processes.cpu_time import CpuTimes
from plumbline.processes.processor import processor_name
from plumbline.processes.worker_pool import (
    Executor,
    ExecutorUnavailable,
    Outcome,
    ResultCache,
    Scheduler,
    Task,
    WorkerPool,
)
from plumbline.storage import results_store

RUN_SUMMARY: results_store.Record = {  # of the rows that are about the whole run
    "family": RUN_FAMILY,
    "title": "All scenarios of the run together",
    "purpose": "Shows two columns that are one computation under two names.",
    "file": "",
    "bodies": 0,
    "joints": [],
    "duration": 0.0,
    "sample": 0.0,
}


@dataclass
class RunResult:
    """A judged run.

    Random scenarios are in ``rows`` only where one of their rows needs a look. ``random_batch`` counts the
    others, and the summary in ``tables`` has all rows.
    """

    rows: list[Row]
    stale_issues: list[known_issues.KnownIssue]  # known issues that no longer occur
    engines: dict[str, EngineInfo]
    scenarios: dict[str, results_store.Record]
    random_batch: RandomBatch
    tables: results_store.ResultTables
    cpu_times: CpuTimes
    metadata: results_store.Record  # the entry ``run`` of results.json
    own_scenarios: frozenset[str] = frozenset()  # names of those of the user's own files
    wide_issues: tuple[str, ...] = ()  # what `KnownIssues.wide_issues` describes

    @cached_property
    def findings(self) -> list[Finding]:
        """The rows that do not agree, by cause."""
        return find_findings(self.rows, {name: about["bodies"] for name, about in self.scenarios.items()})

    def note(self, sentence: str, **facts: Any) -> None:
        """Add facts to what is stored of the run, and a sentence, which may be empty, to its own."""
        self.metadata |= facts
        self.metadata["sentence"] += f"; {sentence}" if sentence else ""


def describe_engines(
    executor: Executor,
    engines: Sequence[str],
    *,
    are_required: bool = False,
    result_cache: ResultCache | None = None,
    are_importers: bool = False,
) -> dict[str, EngineInfo]:
    """Ask every engine for its description, in the version that its name demands.

    Args:
        engines: names, as ``mujoco`` or ``mujoco@3.12.0``.
        are_required: whether an engine that is not installed has failed, since the user named it.
        result_cache: descriptions of earlier runs with the same installation.
        are_importers: whether the names are importers of model files.

    Returns:
        Description by name; an engine that raises, crashes or hangs when it is imported, and a version whose
        environment cannot be made, is described as missing and failed.

    """
    found: dict[str, EngineInfo] = {}
    tasks = []
    describe = describe_importer if are_importers else engine_calls.describe_engine
    for name in engines:
        base, version = environments.split_version(name)
        try:
            if are_importers:
                python = environments.importer_interpreter(name)
            else:
                python = environments.ensure_interpreter(name) if version else ""
        except environments.EnvironmentUnavailable as error:
            found[name] = EngineInfo(name, name, "", (), str(error), has_failed=bool(version))
            continue
        key = TaskKey(TaskKind.DESCRIPTION, engine=name)
        engine, digest = task_engine(base)
        tasks.append(Task(key, describe, (engine,), executor.limits, digest, python, engine=name))
    pythons = {task.key: task.python for task in tasks}
    for outcome in Scheduler(executor, result_cache).run(tasks):
        name, python = outcome.key.engine, pythons[outcome.key]
        info = outcome.value or EngineInfo(
            name, name, "", (), f"cannot be loaded: {outcome.failure}", has_failed=True
        )
        if are_required and info.missing is not None and not info.version and not info.has_failed:
            info = replace(info, missing=f"{info.missing} (it was named explicitly)", has_failed=True)
        if python and not info.missing and not are_importers:
            info = replace(info, title=f"{info.title} {info.version}")
        found[name] = replace(info, name=name, python=python)
    return {name: found[name] for name in engines}


def compare_surfaces(executor: Executor) -> list[SurfaceChanges]:
    """Compare the installed engines with their declared surfaces.

    Returns:
        The changes of those that can be imported.

    """
    tasks = [
        Task(TaskKey(TaskKind.DESCRIPTION, engine=name), surface_changes, (name,), executor.limits)
        for name in SURFACES
    ]
    found = {outcome.key.engine: outcome.value for outcome in executor.run(tasks) if outcome.value}
    return [found[name] for name in SURFACES if name in found]


def run_plan(
    plan: Plan,
    progress: ProgressCallback,
    observer: RunObserver | None = None,
    executor: Executor | None = None,
) -> RunResult:
    """Run a whole plan.

    Args:
        progress: called after every task.
        observer: gets the rows as they are judged.
        executor: makes the calls; None for one that ends with the run.

    Returns:
        The result; a task that is lost becomes a row with the verdict failed.

    Raises:
        ExecutorUnavailable: the cluster cannot be had.

    """
    begin, started = time.monotonic(), datetime.now(UTC)
    run = _Run(plan, observer or RunObserver())
    calls = make_executor(plan) if executor is None else nullcontext(executor)
    with run.cpu_times.measure_overhead(), calls as given:
        run.execute(given, progress)
    result = run.result()
    result.metadata = {
        "id": started.strftime("%Y%m%dT%H%M%SZ"),
        "started": started.isoformat(timespec="seconds"),
        "duration": time.monotonic() - begin,
        "platform": platform.platform(),
        "machine": {"processor": processor_name(), "cores": str(os.cpu_count()), "jobs": str(plan.jobs)},
        "commit": git_commit(),
        "python": platform.python_version(),
        "versions": {name: info.version for name, info in result.engines.items()},
        "truth": "; ".join(
            f"{method} ({n} scenario{'s' * (n != 1)})" for method, n in run.truth_methods.most_common()
        ),
        "level": plan.level,
        "states": plan.random_state_count + 1,
        "sentence": summarize_verdicts(result),
        "exit_code": int(exit_code(result)),
        "cached_tasks": run.cpu_times.cached_count,
        "identity": run.identity.summary(),
        "stale_issues": [issue.id for issue in result.stale_issues],
        "wide_issues": list(result.wide_issues),
    }
    if len(plan.random_scenarios):
        count = min(plan.random_trajectory_count, len(plan.random_scenarios))
        result.metadata["random_batch"] = result.random_batch.summary() | {"trajectories": count}
    return result


class _Run:
    """A plan while it runs."""

    def __init__(self, plan: Plan, observer: RunObserver) -> None:
        self.plan, self.observer = plan, observer
        self.cpu_times = CpuTimes()
        self.truth_methods: Counter[str] = Counter()
        self.engines: dict[str, EngineInfo] = {}
        self.known, self.known_of_observer = (  # the second marks rows before their scenario is complete
            known_issues.KnownIssues(plan.known_issues, plan.extra_refinements > 0) for _ in range(2)
        )
        self.tables = results_store.ResultTables()
        self.random_batch = RandomBatch()
        self.rows: dict[str, list[Row]] = {s.name: [] for s in plan.scenarios}
        self.summaries: dict[str, results_store.Record] = {s.name: {} for s in plan.scenarios}
        self.open: dict[str, ScenarioRun] = {}  # in the order of their making, which is that of the tables

    def execute(self, executor: Executor, progress: ProgressCallback) -> None:
        plan = self.plan
        cache = self.cpu_times.timed_cache(plan.result_cache)
        self.engines = describe_engines(
            executor, plan.engines, are_required=plan.are_engines_required, result_cache=cache
        )
        self.identity = IdentityCheck(self.engines)
        self.observer.on_start(self.engines)
        has_long_runs = plan.long_run_seconds > 0

        def count(level: Any, has_long: bool, has_other: bool) -> int:
            return sum(1 for _ in task_keys("", self.engines, level, has_long, has_other))

        total = sum(
            count(scenario_level(s, plan.level), has_long_runs, plan.has_other_steps(s))
            for s in plan.scenarios
        )
        runs = min(plan.random_trajectory_count, len(plan.random_scenarios))
        total += runs * count(plan.level, False, False)
        others = len(plan.random_scenarios) - runs
        total += others * count(plan.random_level, False, False)
        scheduler = Scheduler(executor, cache)
        for done, outcome in enumerate(scheduler.run(self._tasks()), start=1):
            self.cpu_times.add_outcome(outcome, outcome.key.cpu_time_kind)
            with self.cpu_times.measure("judging"):
                scenario_run = self.open[outcome.key.scenario]
                left_before = scenario_run.left_to_the_night
                following = scenario_run.on_outcome(outcome)
                total -= scenario_run.left_to_the_night - left_before
                self._show_rows(scenario_run, outcome)
                self._finish_done()
            for task in following:
                scheduler.submit(task)
                total += task.key.kind == TaskKind.DIAGNOSIS
            progress(done, total, str(outcome.key))
        self._finish_done()  # the last ones may have no task at all

    def result(self) -> RunResult:
        if rows := self.known.mark_known(self.identity.rows(), bodies=0):
            self.rows[RUN_SCENARIO], self.summaries[RUN_SCENARIO] = rows, RUN_SUMMARY
            self.tables.add_rows(rows)
        return RunResult(
            [row for rows in self.rows.values() for row in rows],
            self.known.stale_issues(is_full_matrix=self.plan.is_full_catalogue),
            self.engines, self.summaries, self.random_batch, self.tables, self.cpu_times, {},
            frozenset(s.name for s in self.plan.scenarios if not s.is_in_catalogue),
            tuple(self.known.wide_issues()),
        )  # fmt: skip

    def _tasks(self) -> Iterator[Task]:
        order = sorted(self.plan.scenarios, key=lambda s: -s.model.n)  # no long task alone at the end
        for number, scenario in enumerate(itertools.chain(order, self.plan.random_scenarios), -len(order)):
            level = self.plan.level if number < self.plan.random_trajectory_count else None
            scenario_run = ScenarioRun(
                self.plan, scenario, self.engines, number >= 0, self.known, level=level
            )
            self.open[scenario.name] = scenario_run
            yield from scenario_run.tasks()

    def _show_rows(self, scenario_run: ScenarioRun, outcome: Outcome) -> None:
        name, model = scenario_run.scenario.name, scenario_run.scenario.model
        if name not in self.rows:  # random scenarios are many
            return
        if scenario_run.is_done:
            rows = scenario_run.judged_rows(scenario_run.findings(), self.known_of_observer)
        else:
            rows = self.known_of_observer.mark_known(
                scenario_run.new_rows(outcome), model.n, joints=model.kind
            )
        if rows:
            self.observer.on_rows(name, rows, scenario_run.is_done)

    def _finish_done(self) -> None:
        """Finish scenarios in the order in which they were opened, up to the first with open tasks."""
        while self.open and (first := next(iter(self.open.values()))).is_done:
            self._finish(self.open.pop(first.scenario.name))

    def _finish(self, scenario_run: ScenarioRun) -> None:
        """Keep the rows and tables of a scenario whose tasks have all finished."""
        found, name = scenario_run.findings(), scenario_run.scenario.name
        rows = scenario_run.judged_rows(found, self.known)
        self.truth_methods.update(scenario_run.truth_methods())
        if fingerprints := scenario_run.fingerprints():
            self.identity.add_scenario(fingerprints)
        self.tables.add_rows(rows)
        if name not in self.rows:  # a random scenario
            rows = self.random_batch.add_scenario(rows)
            if not rows:
                return
        for table, columns in found.tables:
            self.tables.add(table, columns)
        self.rows[name], self.summaries[name] = rows, scenario_run.summary()


def make_executor(plan: Plan) -> Executor:
    """Start the workers of a plan, or connect to its cluster.

    Returns:
        A context manager that makes the calls.

    Raises:
        ExecutorUnavailable: the cluster cannot be had.

    """
    if plan.scheduler is None:
        return WorkerPool(plan.jobs, plan.limits)
    try:
        from plumbline.processes.dask_cluster import DaskCluster  # an optional dependency
    except ImportError as error:
        raise ExecutorUnavailable(f"a cluster needs the packages of the group `cluster`: {error}") from None
    return DaskCluster(plan.scheduler, plan.limits)


def save(result: RunResult, folder: Path, command: str) -> None:
    """Store a result.

    Args:
        result: of `run_plan`.
        command: the command line that made the result.

    Raises:
        OSError: a file cannot be written.

    """
    engines = {
        name: {**asdict(replace(info, python="")), "installed": info.missing is None}
        for name, info in result.engines.items()
    }
    run = {**result.metadata, "command": command, "cpu": result.cpu_times.seconds}
    with result.cpu_times.measure("storage"):
        results_store.write_results(folder, run, result.scenarios, engines, result.rows, result.tables)


MAX_NAMED = 3  # findings that the sentence of a run names


def summarize_verdicts(result: RunResult) -> str:
    """Return the verdicts of a run in one sentence: independent checks, verdicts, findings by name."""
    parts, checks = [], 0
    for verdict in sorted(Verdict, key=lambda verdict: verdict != Verdict.HARNESS_FAILED):  # it comes first
        rows = [row for row in result.rows if row.verdict == verdict]
        count = len(rows) + result.random_batch.counts_by_verdict[verdict]
        if not count:
            continue
        part = f"{count:,} {verdict.style.counted(count)}"
        checks += count if verdict.is_comparison else 0
        new = [row for row in rows if row.known_issue is None]
        if verdict in (Verdict.DISAGREES, Verdict.FAILED, Verdict.HARNESS_FAILED) and new:
            named = [f.name for f in result.findings if f.needs_attention and f.verdict == verdict]
            part += f" ({', '.join(named) if len(named) <= MAX_NAMED else f'{len(named)} findings'})"
        # rows of random scenarios that are only counted are expected, except where there is nothing to expect
        if verdict.needs_attention and count > len(new):
            declared = sum(row.is_declared for row in rows)
            expected = {"as declared": declared, "as recorded": count - len(new) - declared}
            part += _share(expected, count)
        parts.append(part)
    if not has_comparison(result):
        parts.append("nothing was compared" if not checks else "nothing was decided")
    text = f"{checks:,} independent check{'s' * (checks != 1)}: {', '.join(parts)}"
    if result.stale_issues:
        ids = ", ".join(issue.id for issue in result.stale_issues)
        count = len(result.stale_issues)
        text += (
            f"; {count} known {'entry no longer occurs' if count == 1 else 'entries no longer occur'} ({ids})"
        )
    return text


def _share(expected: dict[str, int], count: int) -> str:
    """Say how many of ``count`` rows were expected, and why: " as recorded" where all were for one reason."""
    parts = [why if number == count else f"{number:,} {why}" for why, number in expected.items() if number]
    return f" {parts[0]}" if count in expected.values() else f" ({', '.join(parts)})"


def leave_out_findings(result: RunResult, seen: Collection[str]) -> None:
    """Let findings that an earlier run had not count for the exit code of a run."""
    if seen and result.metadata["exit_code"] == ExitCode.DISAGREEMENT:
        result.metadata["exit_code"] = int(exit_code(result, seen))


def exit_code(result: RunResult, seen: Collection[str] = ()) -> ExitCode:
    """Return the exit code of a run.

    Args:
        result: the run; unresolved rows of the user's own scenarios do not count.
        seen: names of findings that do not count where they disagree, because an earlier run had them.

    Returns:
        As `exit_code_of_rows`.

    """
    own, left_out = result.own_scenarios, set[str]()
    if seen:
        left_out = {row.key for found in result.findings if found.name in seen for row in found.rows}
        left_out -= {row.key for found in result.findings if found.name not in seen for row in found.rows}
        left_out -= {
            row.key for row in result.rows if row.verdict in (Verdict.FAILED, Verdict.HARNESS_FAILED)
        }
    counted = [
        row
        for row in result.rows
        if row.key not in left_out and not (row.verdict == Verdict.UNRESOLVED and row.scenario in own)
    ]
    return exit_code_of_rows(
        counted, has_stale_issues=bool(result.stale_issues), has_comparison=has_comparison(result)
    )


def exit_code_of_rows(rows: Iterable[Row], *, has_stale_issues: bool, has_comparison: bool) -> ExitCode:
    """Return the exit code that judged rows demand.

    Args:
        rows: all rows, or those that need a look.

    Returns:
        5 where the truth is in doubt or missing; else 3 where an engine failed unexpectedly; else 1 for other
        unexpected verdicts, a stale known issue, or where nothing was compared; else 0.

    """
    new = {row.verdict for row in rows if row.known_issue is None}
    if Verdict.HARNESS_FAILED in new:
        return ExitCode.HARNESS_FAILED
    if Verdict.FAILED in new:
        return ExitCode.ENGINE_FAILED
    is_good = not any(verdict.needs_attention for verdict in new) and not has_stale_issues
    return ExitCode.SUCCESS if is_good and has_comparison else ExitCode.DISAGREEMENT


def has_comparison(result: RunResult) -> bool:
    """Find out whether a run compared anything; of the user's own scenarios, with a result.

    Returns:
        Whether a row agrees, disagrees or, in other scenarios, is unresolved.

    """
    found = set(result.random_batch.counts_by_verdict)
    found |= {row.verdict for row in result.rows if row.scenario not in result.own_scenarios}
    decided = {row.verdict for row in result.rows} & {Verdict.AGREES, Verdict.DISAGREES}
    return bool(decided) or any(verdict.is_comparison for verdict in found)


def git_commit() -> str | None:
    """Find the commit of the checkout.

    Returns:
        Its abbreviated hash or tag, with a + where files differ from it; None outside git, and where the
        project is installed: a repository around it is another one.

    """
    if IS_INSTALLED:
        return None
    try:
        done = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--abbrev=12"],
            cwd=Path(__file__).parent, capture_output=True, text=True, check=True, timeout=10,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
