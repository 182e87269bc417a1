"""CPU time is counted once, by what it went into."""

import time

import pytest

from plumbline.execution.runner import Plan, execute
from plumbline.processes.cpu_time import KINDS, Split, spent
from plumbline.processes.workers import Memory, Outcome
from plumbline.scenario import loader


def burn(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_what_is_measured_inside_is_not_process_too():
    split = Split()
    with split.work():
        burn(0.05)
        with split.measure("judging"):
            burn(0.1)
    assert 0.09 < split.seconds["judging"] < 0.2
    assert 0.04 < split.seconds["process"] < 0.1


def test_calls_are_counted_by_whom_they_asked():
    split = Split()
    for key, cost in ((("s", "truth", "state"), 1.0), (("s", "reference", "state"), 2.0),
                      (("s", "mujoco", "state"), 4.0), (("s", "why", "mujoco"), 8.0)):  # fmt: skip
        split.count(Outcome(key, cost=cost))
    assert [split.seconds[k] for k in ("truth", "reference", "engines", "diagnosis")] == [1.0, 2.0, 4.0, 8.0]
    assert "harness 0 %, truth and reference 275 %" in split.sentence()


def test_a_memory_is_the_same_and_measured():
    class Slow(Memory):
        def get(self, task):
            burn(0.05)
            return Outcome(("a",), 3)

    split = Split()
    assert split.storing(Slow()).get(None).value == 3
    assert split.seconds["storage"] > 0.04


def test_a_run_accounts_for_its_time():
    pytest.importorskip("mujoco")
    begin = spent()
    chosen = loader.load_many(["rest"])
    split = execute(Plan(chosen, ["reference", "mujoco"], states=3), lambda *_: None).split
    seconds = {kind: split.seconds[kind] for kind in KINDS}
    assert all(seconds[k] > 0 for k in ("engines", "reference", "truth", "process", "judging")), seconds
    assert 0.7 * (spent() - begin) < sum(seconds.values()) < 1.1 * (spent() - begin), seconds
