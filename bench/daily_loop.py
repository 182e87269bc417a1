"""`python -m bench.daily_loop [--all] [--random COUNT] [--night]`: how long the commands of a day take.

Measures `--help`, one scenario, and the scenarios that the catalogue had at commit 031e87a at state level,
each for the first time and again unchanged; with `--all` also these scenarios, and all of today's, at every
level; with `--random COUNT` also COUNT random scenarios on one run with two workers against two independent
runs at the same time; with `--night` also a night of these scenarios and 200 random ones, without new
certificates.  Appends a record with date, commit, processor and load to bench/results/daily_loop.json after
every part, so that an interrupted measurement keeps what it has; the load before and after shows whether the
machine was idle.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from itertools import takewhile
from pathlib import Path
from typing import Any

from plumbline.execution.exit_codes import ExitCode
from plumbline.execution.runner import git_commit
from plumbline.processes.processor import processor_name
from plumbline.storage.results_store import write_atomically

ROOT = Path(__file__).resolve().parents[1]
STORED = ROOT / "bench" / "results" / "daily_loop.json"
SCENARIO = "double-tumbling-rods"
RANDOM_SEED = 600
CATALOGUE_COMMIT = "031e87a"  # scenarios of other commits are outside the figures that are compared
NIGHT_OPTIONS = ("--random", "200", "--seed", "801", "--proof-cpu-seconds", "0")


def earlier_scenarios() -> list[str]:
    """List the scenarios of the catalogue at `CATALOGUE_COMMIT`.

    Raises:
        CalledProcessError: the checkout's history does not reach back to that commit.

    """
    words = ["git", "ls-tree", "-r", "--name-only", CATALOGUE_COMMIT, "scenarios"]
    listed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [Path(line).stem for line in listed.splitlines() if line.endswith(".yaml")]


def time_command(arguments: list[str], cache: Path) -> dict[str, float]:
    """Run a command of the command line.

    Args:
        arguments: what follows ``plumbline``.

    Returns:
        Wall time and the CPU time of the command's own process, without its workers [s], and its exit code.

    Raises:
        RuntimeError: the command failed.

    """
    environment = {**os.environ, "PLUMBLINE_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
    begin, before = time.monotonic(), os.times()
    code = subprocess.run(
        [sys.executable, "-m", "plumbline", *arguments],
        cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    ).returncode  # fmt: skip
    if code not in (ExitCode.SUCCESS, ExitCode.DISAGREEMENT):
        raise RuntimeError(f"plumbline {' '.join(arguments)} ended with exit code {code}")
    after = os.times()
    own = after.children_user + after.children_system - before.children_user - before.children_system
    return {"wall": time.monotonic() - begin, "cpu of the command": own, "exit code": code}


def time_run(words: list[str], folder: Path) -> dict[str, Any]:
    """Run scenarios for the first time and again.

    Args:
        words: what follows ``plumbline run``.
        folder: an empty folder.

    Returns:
        Times [s] of the first run and of the second, with their CPU times by kind.

    """
    names = list(takewhile(lambda word: not word.startswith("-"), words))
    found: dict[str, Any] = {"scenarios": len(names) or "all"}
    for name in ("first", "again"):
        found[name] = time_command(["run", *words, "--jobs", "2", "--out", str(folder / "out")], folder)
        found[name] |= cpu_times(folder / "out")
    return found


def cpu_times(results: Path) -> dict[str, Any]:
    """Read a run's CPU times.

    Returns:
        CPU time [s] in all, by kind, and in all over the engines' own; how many answers were in the cache.

    """
    run = json.loads((results / "results.json").read_text(encoding="utf-8"))["run"]
    total, engines = sum(run["cpu"].values()), run["cpu"]["engines"]
    return {
        "cpu": total,
        "cpu by kind": run["cpu"],
        "cpu over the engines' own": total / engines if engines else None,
        "answers of earlier runs": run["cached_tasks"],
    }


def time_night(folder: Path) -> dict[str, Any]:
    """Run a night of the earlier catalogue.

    Args:
        folder: an empty folder.

    Returns:
        Times [s] with the CPU time by kind.

    """
    words = ["nightly", *earlier_scenarios(), *NIGHT_OPTIONS, "--jobs", "2", "--out", str(folder / "nights")]
    found = time_command(words, folder)
    (night,) = (folder / "nights" / "history").iterdir()
    return found | cpu_times(night)


def random_scenarios_per_second(count: int, jobs: int, part: int, parts: int) -> float:
    """Compare random scenarios at state level on all engines.

    Args:
        count: number of scenarios of all parts.
        part: index of the part to run.
        parts: number of parts.

    Returns:
        Scenarios per second of wall time, with the start of the workers.

    """
    from plumbline.engines.registry import ENGINES
    from plumbline.execution.plan import Plan
    from plumbline.execution.runner import run_plan
    from plumbline.scenario.generator import RandomScenarios

    chosen = list(RandomScenarios(RANDOM_SEED, count, 0))[part::parts]
    begin = time.monotonic()
    run_plan(Plan([], list(ENGINES), "state", jobs=jobs, random_scenarios=chosen), lambda *_: None)
    return len(chosen) / (time.monotonic() - begin)


def two_workers_over_two_runs(count: int) -> dict[str, float]:
    """Compare one run with two workers and two runs with one worker each, at the same time.

    Returns:
        Scenarios per second of both, and their ratio.

    """

    def start(jobs: int, part: int, parts: int) -> subprocess.Popen[str]:
        words = ["-m", "bench.daily_loop", "--part", *map(str, (count, jobs, part, parts))]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(
            [sys.executable, *words], cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True
        )

    rates = []
    for children in ([(2, 0, 1)], [(1, 0, 2), (1, 1, 2)]):
        running = [start(*child) for child in children]
        rates.append(sum(float(process.communicate()[0]) for process in running))
    together, apart = rates
    return {"one run": together, "two runs": apart, "ratio": together / apart}


def measure(is_all_levels: bool, random_count: int, has_night: bool) -> Iterator[tuple[str, dict[str, Any]]]:
    """Measure the commands.

    Args:
        is_all_levels: whether the catalogues are run at every level too.
        random_count: number of random scenarios for the comparison of two workers with two runs; 0: none.

    Yields:
        After each part its name and the record to store.

    """
    record: dict[str, Any] = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": git_commit(),
        "processor": processor_name(),
        "cores": os.cpu_count(),
        "load before": os.getloadavg(),
    }
    earlier, of_earlier = earlier_scenarios(), f"of the catalogue of {CATALOGUE_COMMIT}"
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        parts: dict[str, Callable[[], dict[str, Any]]] = {
            "--help": lambda: time_command(["--help"], folder),
            f"run {SCENARIO} --level state": lambda: time_run([SCENARIO, "--level", "state"], folder / "one"),
            f"run --level state {of_earlier}": lambda: time_run(
                [*earlier, "--level", "state"], folder / "state"
            ),
        }
        if random_count:
            name = f"{random_count} random scenarios"
            parts[name] = lambda: two_workers_over_two_runs(random_count)
        if is_all_levels:
            parts[f"run {of_earlier}"] = lambda: time_run(earlier, folder / "earlier")
        if has_night:
            parts[f"nightly {of_earlier}, {' '.join(NIGHT_OPTIONS)}"] = lambda: time_night(folder / "night")
        if is_all_levels:
            parts["run"] = lambda: time_run([], folder / "all")
        for name, measured in parts.items():
            record |= {name: measured(), "load after": os.getloadavg()}
            yield name, record


def main() -> None:
    """Measure, print and store; or run one part of the random scenarios for the measurement."""
    assert __doc__
    parser = argparse.ArgumentParser("python -m bench.daily_loop", description=__doc__.partition("\n\n")[2])
    parser.add_argument("--all", action="store_true", help="run the catalogues at every level too")
    parser.add_argument("--random", type=int, default=0, metavar="COUNT", help="number of random scenarios")
    parser.add_argument("--night", action="store_true", help="run a night too")
    parser.add_argument("--part", type=int, nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        print(random_scenarios_per_second(*options.part))
        return
    stored = json.loads(STORED.read_text(encoding="utf-8")) if STORED.exists() else []
    for name, record in measure(options.all, options.random, options.night):
        write_atomically(STORED, (json.dumps([*stored, record], indent=1) + "\n").encode())
        print(json.dumps({name: record[name]}, indent=1), flush=True)


if __name__ == "__main__":
    main()
