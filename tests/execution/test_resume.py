"""A run that is killed goes on where it stopped, and ends as if it had not been."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import psutil
import pyarrow.parquet as pq
import pytest

from plumbline.engines import engine_calls
from plumbline.execution.result_cache import DiskResultCache, task_hash
from plumbline.processes.worker_pool import Outcome, Pickled, Task
from plumbline.storage.results_store import read_results
from tests.helpers import ROOT
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.commands import invoke, run_plumbline
from tests.helpers.runs import run_scenarios

TIME_FIELDS = {"cpu_time", "cost"}  # what may differ between two runs
SCENARIOS = ["rest", "tumbling-ball"]


def quiet(*_):
    pass


def command(out, level):
    """Words of a run, and its variables: cells of its own for each output folder."""
    engines = "--engine", "mujoco", "--engine", "pinocchio"
    words = "run", *SCENARIOS, *engines, "--jobs", "2", "--out", str(out), "--level", level
    return words, {"PLUMBLINE_CACHE": str(out / "cache")}


def finished_results(out, level):
    """The results of a run that is not killed."""
    words, variables = command(out, level)
    run_plumbline(*words, code=0, **variables)
    return comparable_results(out)


def comparable_results(out):
    """All results of a run without its times."""
    document = read_results(out)
    run = {k: document["run"][k] for k in ("sentence", "exit_code", "versions", "truth", "stale_issues")}
    rows = [{k: v for k, v in row.items() if k not in TIME_FIELDS} for row in document["rows"]]
    tables = {}
    for path in sorted(out.glob("*.parquet")):
        table = pq.read_table(path)
        table = table.drop_columns([c for c in table.column_names if c in TIME_FIELDS])
        tables[path.name] = repr(table.to_pylist())  # to the last bit, and NaN equals NaN
    return run, rows, document["scenarios"], tables


def run_and_kill(out, after, from_new_cell, level):
    """Run, kill -9 ``after`` seconds (from the first new cell, if asked); whether it was still running.

    No process of it may remain.
    """
    before = stored_cells(out)
    words, variables = command(out, level)
    process = subprocess.Popen(
        [sys.executable, "-m", "plumbline", *words], cwd=ROOT, env=os.environ | variables,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    while from_new_cell and process.poll() is None and stored_cells(out).keys() <= before.keys():
        time.sleep(0.01)
    try:
        process.wait(timeout=after)
        return False
    except subprocess.TimeoutExpired:
        children = psutil.Process(process.pid).children(recursive=True)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        _, alive = psutil.wait_procs(children, timeout=20)
        assert not alive, f"orphans: {alive}"
        return True


def stored_cells(out):
    """Path and time of every stored cell."""
    found = {}
    for path in out.glob("cache/cells/*.cell"):
        with contextlib.suppress(FileNotFoundError):
            found[path] = path.stat().st_mtime_ns
    return found


def check_results_after_kills(tmp_path, kills, level):
    """Kill ``kills`` times at random moments; runs that finish between them are checked."""
    rng = random.Random(20)
    begin = time.monotonic()
    expected = finished_results(tmp_path / "calm", level)
    longest = time.monotonic() - begin
    done, finished = 0, 0
    while done < kills:
        out = tmp_path / f"rough{finished}"
        before = stored_cells(out)
        from_new_cell = bool(done % 2)
        after = rng.uniform(0.0, 0.2 * longest if from_new_cell else longest)
        if run_and_kill(out, after, from_new_cell, level):
            done += 1
            kept = stored_cells(out)
            assert before.keys() <= kept.keys(), "a finished cell is lost"
        else:
            assert comparable_results(out) == expected
            finished += 1
    assert finished_results(tmp_path / f"rough{finished}", level) == expected
    return done, finished


@pytest.mark.timeout(240)
def test_five_kills_change_nothing(tmp_path):
    check_results_after_kills(tmp_path, 5, "state")


@pytest.mark.full
@pytest.mark.timeout(3600)
def test_a_hundred_kills_change_nothing(tmp_path, record_testsuite_property):
    kills, finished = check_results_after_kills(tmp_path, 100, "all")
    record_testsuite_property("kills", kills)
    record_testsuite_property("runs finished between them", finished)


# --- the same in one process: which cells run, and which do not --------------------------------


class Interrupted(Exception):
    pass


def run_and_count(cells, stop_after=None):
    """(rows, number of cells that ran); raises Interrupted after ``stop_after`` outcomes."""
    ran = 0
    put = cells.put

    def counting(task, outcome):
        nonlocal ran
        ran += 1
        return put(task, outcome)

    cells.put = counting

    def progress(done, *_):
        if done == stop_after:
            raise Interrupted

    options = {"result_cache": cells, "random_state_count": 3, "progress": progress}
    try:
        result = run_scenarios(["rest", "conical"], ["mujoco"], "state", **options)
    except Interrupted:
        return None, ran
    return [replace(row, cpu_time=0.0) for row in result.rows], ran


def test_only_what_was_not_finished_runs_again(tmp_path):
    expected, everything = run_and_count(DiskResultCache(tmp_path / "calm"))
    _, first = run_and_count(DiskResultCache(tmp_path / "rough"), stop_after=2)
    rows, rest = run_and_count(DiskResultCache(tmp_path / "rough"))
    assert (everything, first, rest) == (7, 5, 2)  # with the engine's description and two draws of states
    assert rows == expected


def test_a_damaged_cell_is_named_and_runs_again(tmp_path):
    expected, _ = run_and_count(DiskResultCache(tmp_path))
    paths = sorted(tmp_path.glob("*.cell"))
    data = bytearray(paths[0].read_bytes())
    data[len(data) // 2] ^= 1
    paths[0].write_bytes(data)
    paths[1].write_bytes(paths[1].read_bytes()[:-1])
    paths[2].write_bytes(b"")
    reported = []
    rows, ran = run_and_count(DiskResultCache(tmp_path, reported.append))
    assert ran == 3 and rows == expected
    assert len(reported) == 3 and all("damaged" in sentence for sentence in reported)


def test_a_lost_cell_is_tried_again(tmp_path):
    task = Task(("s", "mujoco", "state"), quiet)
    DiskResultCache(tmp_path).put(task, Outcome(task.key, failure="crashed"))
    assert DiskResultCache(tmp_path).get(task) is None


def test_the_key_is_the_content():
    s = catalogue_scenario("double-tumbling-balls")
    turned = replace(s.state, omega=-s.state.omega)
    other = replace(s.model, mass=np.nextafter(s.model.mass, 9.0))
    base = Task(
        "a",
        engine_calls.run_refinement,
        ("mujoco", "RK4", s.model, s.state, s.times, [0.5, 0.25]),
        version="4.0.0",
    )
    key = task_hash(base)
    assert key == task_hash(replace(base, key="b")), "the key is not the label's"
    changed = [
        replace(base, version="3.3.0"),
        replace(base, function=engine_calls.evaluate_states),
        *(
            replace(base, arguments=(*base.arguments[:i], value, *base.arguments[i + 1 :]))
            for i, value in enumerate(
                [
                    "pinocchio",
                    "Euler",
                    other,
                    turned,
                    s.times[:-1],
                    [0.5, 0.125],
                ]
            )
        ),
    ]
    assert len({key, *map(task_hash, changed)}) == 1 + len(changed)
    assert task_hash(replace(base, arguments=(["ab", "c"],))) != task_hash(
        replace(base, arguments=(["a", "bc"],))
    )
    packed = [
        task_hash(replace(base, arguments=(Pickled.of([state]),))) for state in (s.state, s.state, turned)
    ]
    assert packed[0] == packed[1] != packed[2]


# --- cells that runs share ---------------------------------------------------------------------


def run_in_process(*more):
    result = invoke("run", "rest", "--engine", "mujoco", "--level", "state", *more, code=0)
    return result.stderr


def test_an_unchanged_run_computes_nothing_and_a_fresh_one_everything(tmp_path):
    for out, more in ((tmp_path / "1", ()), (tmp_path / "2", ()), (tmp_path / "3", ("--fresh",))):
        reported = run_in_process("--out", str(out), *more)
        assert ("2 answers of earlier runs were used" in reported) == (out.name == "2")
    first, again, fresh = (comparable_results(tmp_path / name) for name in "123")
    assert first == again == fresh


def test_cells_that_were_not_used_for_longest_are_removed_first(tmp_path):
    run_and_count(DiskResultCache(tmp_path))
    paths = sorted(tmp_path.glob("*.cell"))
    for age, path in enumerate(paths):
        os.utime(path, (1e9 - age, 1e9 - age))
    kept = sum(path.stat().st_size for path in paths[:2])
    DiskResultCache(tmp_path).trim(kept)
    assert sorted(tmp_path.glob("*.cell")) == paths[:2]


def test_a_judge_that_changes_has_another_cell(tmp_path):
    judged = Task("a", quiet, (), judge=quiet, judge_arguments=(1,))
    others = [
        replace(judged, judge_arguments=(2,)),
        replace(judged, judge=run_in_process),
        replace(judged, python=str(tmp_path / "bin" / "python")),
        replace(judged, needs_answer=quiet),
    ]
    assert len({task_hash(judged), *map(task_hash, others)}) == 5
