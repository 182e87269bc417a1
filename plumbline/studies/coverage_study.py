"""Coverage tables of many scenarios, as records and as a file beside the results of a run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import pyarrow as pa

from plumbline.execution.plan import ProgressCallback, no_progress
from plumbline.judging.rows import Level, Row
from plumbline.judging.smallest_detectable_mistake import COVERED_LEVELS, CoverageEntry, scenario_coverage
from plumbline.model.datatypes import BALL, JOINT_ELEMENTS, ROD
from plumbline.model.grouping import grouped
from plumbline.model.sampling import compared_states
from plumbline.processes.cpu_time import CpuTimes
from plumbline.processes.exceptions import PlumblineError
from plumbline.processes.worker_pool import Executor, Task
from plumbline.scenario.loader import Scenario
from plumbline.storage.results_store import COVERAGE_TABLE
from plumbline.studies.parquet_files import make_table
from plumbline.truth.parameters import list_parameters

FILE = "coverage.parquet"
# those of a chain of 100 bodies take minutes, and no worker has them all at the end
PARAMETERS_PER_TASK = 160
# Kinds of parameters that few scenarios have: those of first and of later bodies are looked for together.
_RARE_KINDS = (*JOINT_ELEMENTS, "anchor", "frame", "body_frame")


class CoverageFailure(PlumblineError):
    """The coverage of a scenario could not be computed; the message names it and the reason."""


def measure_coverage(
    executor: Executor,
    scenarios: Sequence[Scenario],
    rows: Iterable[Row],
    state_count: int,
    levels: Sequence[Level] = COVERED_LEVELS,
    progress: ProgressCallback = no_progress,
    cpu_times: CpuTimes | None = None,
) -> list[CoverageEntry]:
    """Compute the coverage of scenarios.

    Args:
        executor: makes the calls, one per scenario and `PARAMETERS_PER_TASK` of its parameters.
        scenarios: which to cover.
        levels: of `COVERED_LEVELS`.
        progress: called with calls done, calls in all and the scenario of the last one.
        cpu_times: gets the CPU time as "judging".

    Returns:
        The entries, in the order of the scenarios.

    Raises:
        CoverageFailure: a call failed.

    """
    by_scenario = grouped(rows, lambda row: row.scenario)
    tasks = []
    for s in sorted(scenarios, key=lambda s: -s.model.n):  # no long task alone at the end
        states = compared_states(s.model, s.state, s.seed, state_count)
        arguments = s.name, s.model, s.state, s.times, states, by_scenario.get(s.name, []), levels
        for first in range(0, len(list_parameters(s.model, s.state)), PARAMETERS_PER_TASK):
            part = slice(first, first + PARAMETERS_PER_TASK)
            tasks.append(Task((s.name, first), scenario_coverage, (*arguments, part), executor.limits))
    found = run_all(executor, tasks, "coverage", progress, cpu_times)
    order = {s.name: k for k, s in enumerate(scenarios)}
    entries: list[CoverageEntry] = [
        entry for key in sorted(found, key=lambda key: key[1]) for entry in found[key]
    ]
    return sorted(entries, key=lambda entry: (order[entry.scenario], COVERED_LEVELS.index(entry.level)))


def run_all(
    executor: Executor,
    tasks: Sequence[Task],
    what: str,
    progress: ProgressCallback,
    cpu_times: CpuTimes | None = None,
) -> dict[Any, Any]:
    """Run tasks, whose keys begin with a scenario's name: values by key.

    Raises:
        CoverageFailure: a call failed.

    """
    found: dict[Any, Any] = {}
    for outcome in executor.run(tasks):
        if cpu_times is not None:
            cpu_times.add_outcome(outcome, "judging")
        if outcome.failure:
            raise CoverageFailure(f"no {what} of {outcome.key[0]}: {outcome.failure}")
        found[outcome.key] = outcome.value
        progress(len(found), len(tasks), outcome.key[0])
    return found


def coverage_table(entries: Iterable[CoverageEntry]) -> pa.Table:
    """Put coverage entries into a table.

    Args:
        entries: of `measure_coverage`.

    Returns:
        One row per entry, with the columns of `COVERAGE_TABLE`.

    """
    return make_table([asdict(entry) for entry in entries], COVERAGE_TABLE)


def summarize_coverage(entries: Iterable[CoverageEntry]) -> list[dict[str, Any]]:
    """Summarize entries by level and kind of parameter, over all bodies and scenarios.

    Args:
        entries: of any scenarios.

    Returns:
        The summaries, in the order of first appearance: numbers of ``entries``, of those ``seen``, of those
        with a proof (``invisible``) and of the others (``blind``); ``sharpest``, ``median`` and ``bluntest``
        smallest mistake over its scale, None where none is seen.

    """
    found = []
    for (level, kind), members in grouped(entries, lambda entry: (entry.level, entry.kind)).items():
        seen = sorted(entry.smallest for entry in members if entry.smallest is not None)
        proven = sum(bool(entry.proof) for entry in members)
        sharpest, median, bluntest = (seen[0], seen[len(seen) // 2], seen[-1]) if seen else [None] * 3
        found.append(
            {
                "level": level,
                "kind": kind,
                "entries": len(members),
                "seen": len(seen),
                "sharpest": sharpest,
                "median": median,
                "bluntest": bluntest,
                "invisible": proven,
                "blind": len(members) - len(seen) - proven,
            }
        )
    return found


def blind_spots(entries: Iterable[CoverageEntry]) -> list[str]:
    """List what no scenario shows at a level.

    A parameter is looked for by the kind of joint that the body hangs by, and of chains' parameters on rods
    and balls separately on the first body and on later ones. It counts as seen where its value is not zero
    and a mistake relative to that value is reported: an engine that ignores drag is right wherever there is
    none.

    Returns:
        Sentences; empty where every parameter is seen at every level, or has a proof wherever it is not.

    """
    seen: dict[tuple[str, ...], bool] = {}
    for entry in entries:
        place = "body" if entry.body else "gravity"
        if entry.joint in (ROD, BALL) and entry.kind not in _RARE_KINDS:
            place = "first body" if entry.body == 1 else "later body"
        key = entry.level, entry.parameter, place, entry.joint
        counts = entry.is_seen and (entry.scale == abs(entry.value) or entry.unit == "rad")
        always = entry.level == "invariants" and bool(entry.proof)
        seen[key] = seen.get(key, False) or counts or always
    return [
        f"{level} level: no scenario sees {parameter}" + (f" of a {place} on a {joint}" if joint else "")
        for (level, parameter, place, joint), is_seen in seen.items()
        if not is_seen
    ]
