"""The nightly: everything, unattended; one folder per night, and what is unfinished beside them.

    OUT/unfinished/plan.json   seed and number of the random scenarios, when it was begun
    OUT/unfinished/cells/      finished cells (`plumbline.execution.result_cache`)
    OUT/unfinished/night/      results as they are written, and what the instrument's own test said
    OUT/history/ID/            a complete night, moved there by one rename

Killed at any moment, the same command reads the plan and goes on; a folder in history is never half.
"""

from __future__ import annotations

import itertools
import json
import os
import secrets
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import reports
from plumbline.execution.result_cache import DiskResultCache
from plumbline.execution.runner import LevelSelection, Plan, ProgressCallback, RunResult, run_plan, save
from plumbline.execution.selftest import SelfTestResult
from plumbline.processes.workers import Limits
from plumbline.scenario import loader as scenarios
from plumbline.scenario.generator import RANDOM_FAMILY, RandomScenarios
from plumbline.storage.history import next_night_number, stored_runs
from plumbline.storage.results_store import write_atomically

EXTRA_REFINEMENTS = 1  # halvings beyond the quick ladders


@dataclass(frozen=True)
class NightPlan:
    """What one night adds to the catalogue, and when it was begun."""

    seed: int
    random_count: int
    started: str  # ISO 8601, UTC

    @classmethod
    def resume_or_start(cls, folder: Path, seed: int | None, random: int) -> NightPlan:
        """The unfinished night of ``folder`` if it is the same one, else a new one, written down."""
        path = folder / "plan.json"
        try:
            night = cls(**json.loads(path.read_text(encoding="utf-8")))
            if night.random_count == random and seed in (None, night.seed):
                return night
        except (OSError, ValueError, TypeError):
            pass  # none, or damaged: a new one
        night = cls(secrets.randbits(32) if seed is None else seed, random, utc_now())
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(asdict(night)).encode())
        return night


def utc_now() -> str:
    """The time, UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def run_nightly(
    out: Path,
    selected_scenarios: Sequence[scenarios.Scenario],
    engines: Sequence[str],
    *,
    random: int,
    seed: int | None,
    jobs: int,
    limits: Limits,
    whole: bool,
    command: str,
    finer: int = EXTRA_REFINEMENTS,
    endurance: float = 0.0,
    level: LevelSelection = "all",
    scheduler: str | None = None,
    self_test: Callable[[Path], SelfTestResult] | None = None,
    progress: ProgressCallback,
    log: Callable[[str], None],
) -> tuple[RunResult, Path]:
    """Run a night, or what is left of it; returns its result and its folder in OUT/history.

    ``instrument`` is the instrument's own test, given the place of its JUnit file.
    """
    unfinished = out / "unfinished"
    night = NightPlan.resume_or_start(unfinished, seed, random)
    if is_already_recorded(night, out / "history"):  # killed as it was done: only this was left of it
        shutil.rmtree(unfinished)
        night = NightPlan.resume_or_start(unfinished, seed, random)
    kept = sum(1 for _ in unfinished.glob("cells/*.cell"))
    log(f"random scenarios: {night.random_count}, seed {night.seed}")
    if kept:
        log(f"going on with the night begun {night.started}: {kept} cells are done")
    drawn = RandomScenarios(night.seed, night.random_count)
    plan = Plan(
        selected_scenarios,
        engines,
        level,
        jobs=jobs,
        limits=limits,
        extra_refinements=finer,
        long_run_seconds=endurance,
        is_full_catalogue=whole,
        scheduler=scheduler,
        random_scenarios=drawn,
        result_cache=DiskResultCache(unfinished / "cells", log),
    )
    result = run_plan(plan, progress)
    place = unused_path(out / "history" / result.metadata["id"])
    result.metadata |= {"id": place.name, "night": next_night_number(place.parent)}
    result.metadata |= {"started": night.started, "random": night.random_count, "seed": night.seed}
    folder = unfinished / "night"
    shutil.rmtree(folder, ignore_errors=True)
    if self_test is not None:
        folder.mkdir()
        answer = self_test(folder / "self_test.xml")
        result.metadata |= {
            "self_test": answer.counts,
            "sentence": f"{result.metadata['sentence']}; {answer.summary}",
        }
        if answer.failure:
            result.metadata["exit_code"] = result.metadata["exit_code"] or 1
    save(result, folder, command)
    write_random_scenario_files(result, drawn, folder / "scenarios")
    with result.cpu_times.measure("report"):
        reports.write(folder, out / "history")
    place.parent.mkdir(exist_ok=True)
    os.replace(folder, place)
    shutil.rmtree(unfinished)
    return result, place


def is_already_recorded(night: NightPlan, history: Path) -> bool:
    """Whether that very night is complete already."""
    if not (history.parent / "unfinished" / "cells").is_dir():
        return False
    wanted = night.started, night.seed, night.random_count
    return any(
        tuple(run.metadata.get(name) for name in ("started", "seed", "random")) == wanted
        for run in stored_runs(history)
    )


def unused_path(place: Path) -> Path:
    """``place``, or with a number after it where a clock that was set back gave another night its name."""
    names = itertools.chain([place], (place.with_name(f"{place.name}-{k}") for k in itertools.count(2)))
    return next(name for name in names if not name.exists())


def write_random_scenario_files(result: RunResult, drawn: Sequence[scenarios.Scenario], folder: Path) -> None:
    """The scenario file of every random scenario that someone should see: `run FILE` repeats it."""
    wanted = {row.scenario for row in result.rows if row.family == RANDOM_FAMILY}
    for s in (drawn[int(name.rpartition("-")[2])] for name in sorted(wanted)):
        folder.mkdir(exist_ok=True)
        text = json.dumps(s.document, indent=1)  # JSON is YAML
        write_atomically(folder / f"{s.name}.yaml", text.encode())
