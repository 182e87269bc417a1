"""Worker processes: every way to lose one costs one task and is reported."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from plumbline.processes.isolation import remove_orphaned_folders
from plumbline.processes.worker_pool import Limits, Outcome, ResultCache, Scheduler, Task, WorkerPool
from tests.helpers import ROOT, faults
from tests.helpers.in_process import InProcessWorkers


def parent_script(folder, body):
    """A program with the names of this file, whose main part is ``body``."""
    script = folder / "parent.py"
    script.write_text(
        "import json, signal, sys\n"
        f"sys.path[:0] = {[str(ROOT), str(Path(__file__).parent)]!r}\n"
        "from test_worker_pool import *\n"
        "if __name__ == '__main__':\n" + textwrap.indent(textwrap.dedent(body), "    ")
    )
    return script


def double(x):
    return 2 * x


def exhaust_memory():
    return len(bytearray(64 * 2**30))


def exit_beside_a_child():
    """The child, which holds the pipe open, lives longer than its parent."""
    if os.fork():
        os._exit(0)
    time.sleep(600)


def interrupt():
    raise KeyboardInterrupt


def leave():
    sys.exit(0)


def raise_unprintable():
    raise faults.Unprintable


def raise_long_text():
    raise RuntimeError("word " * 200_000 + "\x1b[2J")


def return_what_cannot_be_pickled():
    return lambda: 0


class Unloadable:
    """Can be pickled, and not loaded."""

    def __reduce__(self):
        return int, ("x",)


def come_back_twice():
    os.fork()
    return "twice"


def write_file_and_flood_output():
    """Write a file into the working folder and flood both outputs, as engines do."""
    Path("dropped.txt").write_text("x")
    os.write(1, b"noise\n" * 10_000)
    os.write(2, b"noise\n" * 10_000)
    return os.getcwd()


def process_id():
    return os.getpid()


LOSSES = [
    (faults.segfault, "crashed: the worker died of SIGSEGV"),
    (faults.abort, "crashed: the worker died of SIGABRT"),
    (faults.exit_7, "crashed: the worker exited with code 7"),
    (exhaust_memory, "out of memory"),
    (faults.hang, "timeout: no answer within"),
    (faults.hang_in_c, "timeout: no answer within"),
    (faults.stop_itself, "timeout: no answer within"),
]


# Each is noticed at once: a time limit that no test waits for.
FAULTS = [
    (faults.exit_0, "crashed: the worker exited with code 0"),
    (faults.exit_by_c, "crashed: the worker exited with code 0"),
    (faults.exit_by_thread, "crashed: the worker exited with code 0"),
    (exit_beside_a_child, "crashed: the worker exited with code 0"),
    (interrupt, "KeyboardInterrupt: no message"),
    (faults.interrupt_by_signal, "KeyboardInterrupt: no message"),
    (leave, "SystemExit: 0"),
    (raise_unprintable, "Unprintable: no readable message"),
    (raise_long_text, "word  … (cut: 1,000,004 characters)"),
    (return_what_cannot_be_pickled, "Can't pickle local object"),
    (faults.write_everywhere, "crashed: the worker did not reply, but"),
    (faults.close_descriptors, "crashed: the worker"),
    (faults.end_its_group, "crashed: the worker died of SIGKILL"),
]


def test_faults_are_reported_at_once_and_change_no_other_task(tmp_path):
    """Also where the command ignores SIGINT, as a job in the background does: no worker inherits that."""
    script = parent_script(tmp_path, """
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        limits = Limits(seconds=100, gigabytes=4)
        tasks = [Task(fault.__name__, fault, (), limits, engine='faulty') for fault, _ in FAULTS]
        tasks += [Task(str(i), double, (i,), limits) for i in range(len(FAULTS))]
        with WorkerPool(2, limits) as workers:
            outcomes = {o.key: (o.failure, o.value) for o in workers.run(tasks)}
        json.dump(outcomes, open(sys.argv[1], 'w'))
    """)  # fmt: skip
    found = tmp_path / "outcomes.json"
    subprocess.run([sys.executable, script, found], check=True, timeout=200)
    outcomes = json.loads(found.read_text())
    for fault, words in FAULTS:
        assert words in (outcomes[fault.__name__][0] or ""), fault.__name__
        assert len(outcomes[fault.__name__][0]) < 2200
    assert [outcomes[str(i)][1] for i in range(len(FAULTS))] == [2 * i for i in range(len(FAULTS))]


def test_ctrl_c_while_the_libraries_load_reaches_the_command_alone(tmp_path):
    (tmp_path / "slow_library.py").write_text("open('loading', 'w').close()\nimport time\ntime.sleep(1)\n")
    script = parent_script(tmp_path, """
        from plumbline.processes.worker_pool import start_warm_process
        sys.path.insert(0, sys.argv[1])
        signal.signal(signal.SIGINT, lambda *_: print('interrupted'))
        start_warm_process(['slow_library'])
        while not Path('loading').exists():
            time.sleep(0.01)
        os.killpg(0, signal.SIGINT)
        with WorkerPool(1) as workers:
            print(*(o.value for o in workers.run([Task(0, double, (3,))])))
    """)  # fmt: skip
    command = [sys.executable, script, tmp_path]
    ran = subprocess.run(
        command, cwd=tmp_path, start_new_session=True, capture_output=True, text=True, timeout=100
    )
    assert (ran.stdout, ran.stderr) == ("interrupted\n6\n", "")


def test_an_engine_that_forks_answers_once():
    with WorkerPool(1) as workers:
        tasks = [Task(0, come_back_twice, engine="e"), Task(1, double, (3,), engine="e")]
        found = {outcome.key: outcome.value for outcome in workers.run(tasks)}
    assert found == {0: "twice", 1: 6}


def raise_on(_):
    raise ValueError("the judge's")


def test_answers_that_cannot_be_loaded_are_the_engine_s_fault_and_judges_their_own():
    with WorkerPool(1) as workers:
        tasks = [
            Task("unloadable", Unloadable, judge=double, engine="e"),
            Task("judge", double, (1,), judge=raise_on, engine="e"),
            Task("judge dies", double, (1,), judge=faults.abort, engine="e"),
        ]
        found = {outcome.key: outcome for outcome in workers.run(tasks)}
    assert "the answer cannot be read: ValueError" in found["unloadable"].failure
    assert found["judge"].failure is None and found["judge"].judge_failure == "ValueError: the judge's"
    assert found["judge dies"].failure is None and "crashed" in found["judge dies"].judge_failure


def spoil_process():
    """Change everything that calls in the same process share."""
    np.sum = np.cross = None
    np.seterr(all="raise")
    os.environ["SPOILED"] = "yes"
    os.chdir("/")
    sys.path.clear()


def is_spoiled():
    return np.sum is None or os.getcwd() == "/" or "SPOILED" in os.environ or not sys.path


def is_spoiled_beside(answer):
    return is_spoiled()


def test_an_engine_changes_neither_others_nor_judges():
    with WorkerPool(1) as workers:
        tasks = [
            Task("spoils", spoil_process, judge=is_spoiled_beside, engine="bad"),
            Task("itself", is_spoiled, engine="bad"),
            Task("other", is_spoiled, engine="good"),
            Task("truth", is_spoiled),
        ]
        found = {outcome.key: outcome for outcome in workers.run(tasks)}
    assert found["spoils"].judge_result is False and found["itself"].value is True
    assert found["other"].value is False and found["truth"].value is False


def leave_processes():
    """This one, a child, a child in a session of its own, a grandchild whose parent has ended, a program."""
    started = [os.getpid()]
    for make in (lambda: None, os.setsid):
        child = os.fork()
        if not child:
            make()
            time.sleep(600)
            os._exit(0)
        started.append(child)
    read, write = os.pipe()
    if not os.fork():
        os.setsid()
        grandchild = os.fork()
        if grandchild:
            os.write(write, str(grandchild).encode())
            os._exit(0)
        time.sleep(600)
        os._exit(0)
    os.wait()
    started.append(int(os.read(read, 100)))
    started.append(subprocess.Popen(["sleep", "600"], start_new_session=True).pid)
    return started


def leave_processes_and_hang(path):
    Path(path).write_text(" ".join(map(str, leave_processes())))
    time.sleep(600)


def wait_until_ended(processes):
    deadline = time.monotonic() + 20
    while (left := [p for p in processes if is_alive(p)]) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not left


def is_alive(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


linux_only = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="subreapers are Linux's")


@linux_only
def test_processes_that_an_engine_starts_end_with_the_pool(tmp_path):
    """In a process of its own: another test may have ended the warm process, which adopts what is left."""
    script = parent_script(tmp_path, """
        limits, path = Limits(seconds=4), sys.argv[1]
        hangs = Task('hangs', leave_processes_and_hang, (path,), limits, engine='e')
        with WorkerPool(1, limits) as workers:
            answered, lost = workers.run([Task('answers', leave_processes, engine='e'), hangs])
        started = [*answered.value, *map(int, open(path).read().split())]
        print(len(started), wait_until_ended(started), 'timeout' in lost.failure)
    """)  # fmt: skip
    done = subprocess.run(
        [sys.executable, script, tmp_path / "started"], capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["10", "True", "True"], done.stdout + done.stderr


@linux_only
def test_processes_that_an_engine_starts_end_with_a_killed_run(tmp_path):
    script = parent_script(tmp_path, """
        with WorkerPool(1) as workers:
            for outcome in workers.run([Task(0, leave_processes), Task(1, faults.hang)]):
                print(*outcome.value, flush=True)
    """)  # fmt: skip
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    started = [int(word) for word in parent.stdout.readline().split()]
    assert len(started) == 5 and all(map(is_alive, started))
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    assert wait_until_ended(started)


def test_each_loss_costs_one_task_and_is_reported():
    limits = Limits(seconds=5, gigabytes=4)
    quick = Limits(seconds=2, gigabytes=4)
    with WorkerPool(2, limits) as workers:
        tasks = [Task(("fine", i), double, (i,), limits) for i in range(6)]
        for k, (loss, _) in enumerate(LOSSES):
            tasks.insert(2 * k, Task(("lost", k), loss, (), quick))
        outcomes = {o.key: o for o in workers.run(tasks)}
    assert [outcomes["fine", i].value for i in range(6)] == [2 * i for i in range(6)], outcomes
    for k, (loss, words) in enumerate(LOSSES):
        assert words in (outcomes["lost", k].failure or ""), loss.__name__


def test_a_task_that_an_outcome_submits_runs_while_others_do():
    finished = []
    with WorkerPool(2) as workers:
        scheduler = Scheduler(workers)
        for outcome in scheduler.run([Task("long", sleep_for, (4.0,)), Task("short", sleep_for, (0.0,))]):
            assert outcome.failure is None
            finished.append(outcome.key)
            if outcome.key == "short":
                scheduler.submit(Task("follows", sleep_for, (0.0,)))
    assert finished == ["short", "follows", "long"]


class Remembering(ResultCache):
    """Knows the answer of "known"; keeps what it gets."""

    def __init__(self):
        self.kept = []

    def get(self, task):
        return Outcome("known", "from before") if task.key == "known" else None

    def put(self, task, outcome):
        self.kept.append(outcome.key)
        return outcome


def test_the_scheduler_takes_submitted_tasks_first_and_cached_answers_at_once():
    executor, cache, found = InProcessWorkers(), Remembering(), []
    scheduler = Scheduler(executor, cache)
    tasks = [Task(key, double, (1,)) for key in ("a", "known", "b", "c")]
    for outcome in scheduler.run(iter(tasks)):
        found.append((outcome.key, outcome.value))
        if outcome.key == "known":
            scheduler.submit(Task("of known", double, (2,)))
        if outcome.key == "c":
            scheduler.submit(Task("of c", double, (3,)))
    assert executor.started == ["a", "of known", "b", "c", "of c"] and cache.kept == [k for k, _ in found[1:]]
    assert found[0] == ("known", "from before") and dict(found[1:]) == {
        "a": 2, "of known": 4, "b": 2, "c": 2, "of c": 6
    }  # fmt: skip


def test_files_and_output_of_an_engine_go_nowhere(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with WorkerPool(1) as workers:
        (outcome,) = workers.run([Task("x", write_file_and_flood_output)])
    assert outcome.value != str(tmp_path)
    assert not Path(outcome.value).exists(), "the scratch folder is removed"
    assert list(tmp_path.iterdir()) == []
    assert "noise" not in "".join(capfd.readouterr())


def sleep_for(seconds):
    time.sleep(seconds)
    return seconds


def test_a_clock_that_is_set_neither_kills_nor_spares(monkeypatch):
    """By the clock of the wall the nap would be over its limit, and the hang within it for an hour."""
    real, off = time.time, [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + off[0])
    with WorkerPool(3) as workers:
        list(workers.run([Task(k, sleep_for, (0.4,)) for k in range(6)]))  # now all three are there
        for step in (3600.0, -3600.0):
            tasks = [
                Task("nap", sleep_for, (2.0,), Limits(seconds=60)),
                Task("hang", faults.hang, (), Limits(seconds=2)),
                Task("go", sleep_for, (0.5,)),
            ]
            found = {}
            for outcome in workers.run(tasks):
                if outcome.key == "go":
                    off[0] += step  # while the others run
                found[outcome.key] = outcome
            assert found["nap"].value == 2.0
            assert "timeout" in (found["hang"].failure or "")


def test_what_a_killed_run_leaves_is_removed_by_the_next(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    script = (
        "import time; from plumbline.processes.isolation import ScratchFolder\n"
        "mine = ScratchFolder(); print(mine.path, flush=True); time.sleep(600)"
    )
    owners = [
        subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, cwd=ROOT)
        for _ in range(2)
    ]
    dead, alive = (Path(p.stdout.readline().strip()) for p in owners)
    (dead / "deep").mkdir()
    (dead / "deep" / "file").write_text("x")
    (tmp_path / "plumbline-of-somebody").mkdir()  # none of ours: nobody locks it
    owners[0].kill()
    owners[0].wait()
    assert dead.is_dir() and alive.is_dir(), "nobody has come by yet"
    with WorkerPool(1) as workers:
        mine = workers._scratch.path
        left = {path.name for path in tmp_path.iterdir()}
        assert {alive.name, mine.name, "plumbline-of-somebody"} <= left and dead.name not in left
    owners[1].kill()
    owners[1].wait()
    assert not mine.exists() and remove_orphaned_folders("plumbline-") == [alive]


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no process groups")
def test_a_run_that_is_stopped_and_continued_loses_no_task(tmp_path):
    """As Ctrl-Z and fg: the process and its workers stand still for longer than the time limit."""
    script = parent_script(tmp_path, """
        limits = Limits(seconds=5)
        with WorkerPool(1) as workers:
            for tasks in ([Task(0, process_id)], [Task(1, sleep_for, (1.5,), limits)],
                          [Task(2, faults.hang, (), limits)]):
                for outcome in workers.run(tasks):
                    print(outcome.failure or outcome.value, flush=True)
    """)  # fmt: skip
    parent = subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert parent.stdout.readline().strip().isdigit()
    time.sleep(0.5)
    os.killpg(parent.pid, signal.SIGSTOP)
    time.sleep(7)
    os.killpg(parent.pid, signal.SIGCONT)
    assert parent.stdout.readline().strip() == "1.5"
    assert "timeout: no answer within 5 s" in parent.stdout.readline(), "a hang is still found"
    assert parent.wait(timeout=60) == 0
