"""`python -m bench.daily_loop [--all] [--random COUNT]`: how long the commands of a day take.

Measures `--help`, one scenario and the whole catalogue at state level, each for the first time and again
unchanged; with `--all` also the whole catalogue at every level; with `--random COUNT` also COUNT random
scenarios on one run with two workers against two independent runs at the same time.  Appends a record with
date, commit, processor and load to bench/results/daily_loop.json.  Needs about two minutes on two idle cores;
the load before and after shows whether the machine was idle.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from plumbline.execution.runner import git_commit
from plumbline.processes.processor import processor_name
from plumbline.storage.results_store import write_atomically

ROOT = Path(__file__).resolve().parents[1]
STORED = ROOT / "bench" / "results" / "daily_loop.json"
SCENARIO = "double-tumbling-rods"
RANDOM_SEED = 600


def time_command(arguments: list[str], cache: Path) -> dict[str, float]:
    """Run a command of the command line.

    Args:
        arguments: what follows ``plumbline``.
        cache: the folder of the user's cache.

    Returns:
        Wall time and the CPU time of the command's own process, without its workers [s].

    """
    environment = {**os.environ, "PLUMBLINE_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
    begin, before = time.monotonic(), os.times()
    subprocess.run(
        [sys.executable, "-m", "plumbline", *arguments],
        cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True,
    )  # fmt: skip
    after = os.times()
    own = after.children_user + after.children_system - before.children_user - before.children_system
    return {"wall": time.monotonic() - begin, "cpu of the command": own}


def time_run(words: list[str], folder: Path) -> dict[str, Any]:
    """Run scenarios for the first time and again.

    Args:
        words: what follows ``plumbline run``.
        folder: an empty folder.

    Returns:
        Times [s] of the first run and of the second, with the first one's CPU time by kind.

    """
    found: dict[str, Any] = {}
    for name in ("first", "again"):
        found[name] = time_command(["run", *words, "--jobs", "2", "--out", str(folder / "out")], folder)
        run = json.loads((folder / "out" / "results.json").read_text(encoding="utf-8"))["run"]
        found[name] |= {"cpu by kind": run["cpu"], "answers of earlier runs": run["cached_tasks"]}
    return found


def random_scenarios_per_second(count: int, jobs: int, part: int, parts: int) -> float:
    """Compare random scenarios at state level on all engines.

    Args:
        count: number of scenarios of all parts.
        jobs: number of workers.
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

    Args:
        count: number of random scenarios.

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


def measure(is_all_levels: bool, random_count: int) -> dict[str, Any]:
    """Measure the commands.

    Args:
        is_all_levels: whether the whole catalogue is run at every level too.
        random_count: number of random scenarios for the comparison of two workers with two runs; 0: none.

    Returns:
        The record to store.

    """
    record: dict[str, Any] = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": git_commit(),
        "processor": processor_name(),
        "cores": os.cpu_count(),
        "load before": os.getloadavg(),
    }
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        record["--help"] = time_command(["--help"], folder)
        record[f"run {SCENARIO} --level state"] = time_run([SCENARIO, "--level", "state"], folder / "one")
        record["run --level state"] = time_run(["--level", "state"], folder / "state")
        if is_all_levels:
            record["run"] = time_run([], folder / "all")
    if random_count:
        record[f"{random_count} random scenarios"] = two_workers_over_two_runs(random_count)
    return record | {"load after": os.getloadavg()}


def main() -> None:
    """Measure, print and store; or run one part of the random scenarios for the measurement."""
    assert __doc__
    parser = argparse.ArgumentParser("python -m bench.daily_loop", description=__doc__.partition("\n\n")[2])
    parser.add_argument("--all", action="store_true", help="run the whole catalogue at every level too")
    parser.add_argument("--random", type=int, default=0, metavar="COUNT", help="number of random scenarios")
    parser.add_argument("--part", type=int, nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        print(random_scenarios_per_second(*options.part))
        return
    record = measure(options.all, options.random)
    print(json.dumps(record, indent=1))
    stored = json.loads(STORED.read_text(encoding="utf-8")) if STORED.exists() else []
    write_atomically(STORED, (json.dumps([*stored, record], indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
