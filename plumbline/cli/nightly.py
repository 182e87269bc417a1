"""The nightly: runs everything unattended, resumes after interruption, keeps the history of earlier nights.

OUT/unfinished/plan.json   seed and number of the random scenarios, start and token of the night
OUT/unfinished/night/      results while they are written, and the self-test's JUnit file
OUT/history/ID/            a complete night, moved there by one rename

Finished cells are in the user's cache (`plumbline.execution.result_cache`), under a name made of the token.
"""

from __future__ import annotations

import itertools
import json
import os
import secrets
import shutil
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import pyarrow as pa

import reports
from plumbline.cli.options import announce_result_cache
from plumbline.execution.exit_codes import ExitCode
from plumbline.execution.plan import Plan, ProgressCallback, RunObserver
from plumbline.execution.proofs import prove_changed_motions
from plumbline.execution.result_cache import DiskResultCache, night_cells_folder
from plumbline.execution.runner import RunResult, compare_surfaces, leave_out_findings, run_plan, save
from plumbline.execution.selftest import SelfTestResult
from plumbline.model.features import Feature, features
from plumbline.processes.worker_pool import WorkerPool
from plumbline.reproduce.write import write_scripts
from plumbline.scenario.generator import RANDOM_FAMILY, RandomScenarios, random_seed
from plumbline.storage.history_of_nights import next_night_number, stored_runs
from plumbline.storage.results_store import write_atomically
from plumbline.studies.coverage_study import FILE as COVERAGE_FILE
from plumbline.studies.coverage_study import CoverageFailure, coverage_table, measure_coverage
from plumbline.studies.feature_pairs import count_triples
from plumbline.studies.parquet_files import write_table

FEATURES_FILE = "features.json"  # features of each random mechanism of a night
WEEK = 7  # nights


@dataclass(frozen=True)
class NightPlan:
    """The random scenarios of one night, and its start."""

    seed: int
    random_count: int
    started: str  # ISO 8601, UTC
    token: str  # names the folder of its cells

    @classmethod
    def resume_or_start(cls, folder: Path, seed: int | None, random_count: int) -> NightPlan:
        """Read the plan of the unfinished night, or write a new one.

        Args:
            seed: seed of the random scenarios; None for the unfinished night's, or a new one.

        Returns:
            The plan of the unfinished night if it has this seed and number, else a new one.

        Raises:
            OSError: the plan cannot be written.

        """
        path = folder / "plan.json"
        try:
            night = cls(**json.loads(path.read_text(encoding="utf-8")))
            is_wanted = night.random_count == random_count and seed in (None, night.seed)
            if is_wanted and isinstance(night.token, str):
                return night
        except (OSError, ValueError, TypeError):
            pass  # missing or damaged: a new one
        started = datetime.now(UTC).isoformat(timespec="seconds")
        seed = secrets.randbits(32) if seed is None else seed
        night = cls(seed, random_count, started, secrets.token_hex(8))
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(asdict(night)).encode())
        return night


def run_nightly(
    out: Path,
    plan: Plan,
    *,
    random_count: int,
    seed: int | None,
    command: str,
    self_test: Callable[[Path, int], SelfTestResult] | None = None,
    proof_cpu_seconds: float = 0.0,
    seen_findings: Collection[str] = (),
    progress: ProgressCallback,
    observer: RunObserver | None = None,
    log: Callable[[str], None],
) -> tuple[RunResult, Path]:
    """Run a night, or what is left of an interrupted one.

    Args:
        plan: without random scenarios and result cache, which are the night's own.
        random_count: number of random scenarios: half of them chains, the others mechanisms of any joints.
        seed: their seed; None for the interrupted night's, or a new one.
        command: the command line, stored with the results.
        self_test: runs the self-test of a night, given by its number, and writes its JUnit file to the given
            path; None for no self-test.
        proof_cpu_seconds: CPU time after which no further proof of a motion is begun [s]; 0: none is begun.
        seen_findings: names of those that do not count for the exit code.
        progress: called after every task.
        observer: gets the rows of named scenarios as they are judged.
        log: called with sentences for the user.

    Returns:
        The result and the night's folder in OUT/history.

    Raises:
        OSError: a file cannot be written; the same call goes on from there.
        ExecutorUnavailable: the cluster cannot be had.

    """
    unfinished, history = out / "unfinished", out / "history"
    was_begun = unfinished.exists()
    night = NightPlan.resume_or_start(unfinished, seed, random_count)
    if was_begun and _is_recorded(night, history):  # interrupted when only the clean-up was left
        shutil.rmtree(unfinished)
        DiskResultCache(night_cells_folder(night.token)).clear()
        night = NightPlan.resume_or_start(unfinished, seed, random_count)
    cells = night_cells_folder(night.token)
    finished = sum(1 for _ in cells.glob("*.cell"))
    result_cache = DiskResultCache(cells, log)
    announce_result_cache(result_cache)
    log(f"random scenarios: {night.random_count}, seed {night.seed}")
    if finished:
        log(f"resuming the night begun {night.started}: {finished} cells are finished")
    mechanisms = night.random_count // 2  # the others are chains
    random_scenarios = RandomScenarios(
        night.seed, night.random_count - mechanisms, plan.random_trajectory_count, mechanisms
    )
    plan = replace(plan, random_scenarios=random_scenarios, random_level="random", result_cache=result_cache)
    proofs = (
        prove_changed_motions(plan.scenarios, plan.jobs, plan.limits, proof_cpu_seconds, log, progress)
        if proof_cpu_seconds
        else None
    )
    result = run_plan(plan, progress, observer)
    leave_out_findings(result, seen_findings)
    place = unused_path(history / result.metadata["id"])
    result.metadata |= {"id": place.name, "night": next_night_number(history)}
    result.metadata |= {"started": night.started, "random": night.random_count, "seed": night.seed}
    folder = unfinished / "night"
    shutil.rmtree(folder, ignore_errors=True)
    if proofs is not None:
        result.note(proofs.sentence, proofs=asdict(proofs))
        if proofs.exceeded:
            result.metadata["exit_code"] = ExitCode.HARNESS_FAILED
    if self_test is not None:
        folder.mkdir()
        answer = self_test(folder / "self_test.xml", result.metadata["night"])
        result.note(answer.summary, self_test=answer.counts)
        if answer.failure:
            result.metadata["exit_code"] = result.metadata["exit_code"] or 1
    for name, about in result.scenarios.items():
        if about["family"] == RANDOM_FAMILY and random_seed(name) == night.seed:
            about["file"] = (place / "scenarios" / f"{name}.yaml").as_posix()
    if plan.level == "all":
        log("every cell is compared; next: the smallest mistake in each number that this night would show")
    coverage = night_coverage(result, plan, progress) if plan.level == "all" else None
    drawn = [features(s.model) for s in random_scenarios.mechanisms]
    if drawn:
        earlier = itertools.chain(
            *map(_stored_features, [run.folder for run in stored_runs(history)][1 - WEEK :])
        )
        found, new = count_triples(drawn, earlier)
        words = f"random mechanisms: {found:,} triples of features, {new:,} of them new in {WEEK} nights"
        result.note(words, feature_triples={"found": found, "new": new})
    with WorkerPool(1, plan.limits) as executor:
        for changes in compare_surfaces(executor):
            result.note(changes.sentence)
    save(result, folder, command)
    write_atomically(folder / FEATURES_FILE, json.dumps(drawn).encode())
    if coverage is not None:
        write_table(coverage, folder / COVERAGE_FILE)
    write_random_scenario_files(result, random_scenarios, folder / "scenarios")
    log("next: scripts of the findings, and the report")
    with result.cpu_times.measure("report"):
        result.cpu_times.seconds["report"] += write_scripts(folder).cpu_time
        reports.write(folder, history)
    history.mkdir(exist_ok=True)
    os.replace(folder, place)
    shutil.rmtree(unfinished)
    result_cache.clear()
    return result, place


def night_coverage(result: RunResult, plan: Plan, progress: ProgressCallback) -> pa.Table | None:
    """Compute the coverage of the night's catalogue, by the tolerances of its own rows.

    Where that fails the night is kept, with the reason in its sentence and the exit code of a failed harness.

    Args:
        progress: called after every scenario.

    Returns:
        The table of `plumbline.studies.coverage_study`; None where it could not be computed.

    """
    moving = [s for s in plan.scenarios if s.level == "all"]  # of the others pairs of features are computed
    try:
        with WorkerPool(plan.jobs, plan.limits) as executor:
            found = measure_coverage(
                executor, moving, result.rows, plan.random_state_count, progress=progress,
                cpu_times=result.cpu_times,
            )  # fmt: skip
    except CoverageFailure as error:
        result.note(str(error), exit_code=ExitCode.HARNESS_FAILED)
        return None
    return coverage_table(found)


def _stored_features(folder: Path) -> list[list[Feature]]:
    """The features of each random mechanism of an earlier night; none where they cannot be read."""
    try:
        stored = json.loads((folder / FEATURES_FILE).read_text(encoding="utf-8"))
        return [[Feature(*map(str, one)) for one in some] for some in stored]
    except (OSError, ValueError, TypeError):
        return []


def unused_path(place: Path) -> Path:
    """Return a path that does not exist: a clock that was set back can give two nights the same name.

    Returns:
        ``place``, or with -2, -3, … after it.

    """
    names = itertools.chain([place], (place.with_name(f"{place.name}-{k}") for k in itertools.count(2)))
    return next(name for name in names if not name.exists())


def write_random_scenario_files(result: RunResult, drawn: RandomScenarios, folder: Path) -> None:
    """Write the files of the random scenarios that have rows in the result, so that `run FILE` repeats them.

    Raises:
        OSError: a file cannot be written.

    """
    names = {row.scenario for row in result.rows if row.family == RANDOM_FAMILY}
    for s in (drawn.named(name) for name in sorted(names) if random_seed(name) == drawn.seed):
        folder.mkdir(exist_ok=True)
        text = json.dumps(s.document, indent=1)  # JSON is YAML
        write_atomically(folder / f"{s.name}.yaml", text.encode())


def _is_recorded(night: NightPlan, history: Path) -> bool:
    """Whether the unfinished night is complete in the history already."""
    wanted = night.started, night.seed, night.random_count
    return any(
        tuple(run.metadata.get(name) for name in ("started", "seed", "random")) == wanted
        for run in stored_runs(history)
    )
