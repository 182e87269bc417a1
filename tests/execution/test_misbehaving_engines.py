"""Engines that misbehave: each fails alone, with a sentence; the reference beside them agrees."""

import contextlib
import os

import psutil
import pytest

from plumbline.engines import registry
from plumbline.execution.runner import exit_code
from plumbline.processes import worker_process
from plumbline.processes.worker_pool import Limits
from tests.helpers import misbehaving_engines as engines
from tests.helpers.runs import run_scenarios

SECONDS = 15.0


@pytest.fixture
def run_engines(monkeypatch):
    for name, place in engines.places().items():
        monkeypatch.setitem(registry.ENGINES, name, place)
    monkeypatch.setattr(worker_process, "initialize_worker", engines.prepare_worker)

    def run(names):
        return run_scenarios(
            ["tumbling-ball"], ["reference", *names], "state", random_state_count=10,
            jobs=2, limits=Limits(SECONDS, 4), are_engines_required=True,
        )  # fmt: skip

    return run


def faults_of(result, name):
    """What is wrong with how a misbehaving engine was reported."""
    rows, expected = [row for row in result.rows if row.engine == name], engines.EXPECTED[name]
    verdicts, reasons = {str(row.verdict) for row in rows}, " ".join(row.reason or "" for row in rows)
    if expected == engines.HARMLESS:
        return "" if verdicts <= {"agrees", "information"} else reasons
    if expected == engines.RED:
        return "" if "disagrees" in verdicts else f"{verdicts}"
    if expected == engines.REFUSED:
        return "" if verdicts == {"unsupported"} and len(reasons) < 3000 else f"{verdicts} {reasons[:200]}"
    return "" if verdicts == {"failed"} and expected in reasons and len(reasons) < 3000 else reasons[:400]


def living_descendants():
    """Process ids and command lines below this process."""
    found = set()
    for process in psutil.Process(os.getpid()).children(recursive=True):
        with contextlib.suppress(psutil.Error):
            if process.status() != psutil.STATUS_ZOMBIE:
                found.add((process.pid, " ".join(process.cmdline()), process.ppid()))
    return found


def is_kept(process):
    """Whether a process is the warm process or multiprocessing's resource tracker."""
    _, command, parent = process
    return parent == os.getpid() and ("forkserver" in command or "resource_tracker" in command)


def check(run_engines, names):
    before, descriptors = living_descendants(), len(os.listdir("/proc/self/fd"))
    result = run_engines(names)
    faults = {name: found for name in names if (found := faults_of(result, name))}
    assert not faults, "\n".join(f"{name}: {found}" for name, found in faults.items())
    reference = {str(row.verdict) for row in result.rows if row.engine == "reference"}
    assert reference <= {"agrees", "information"}, reference
    assert exit_code(result) == 3
    assert not [one for one in living_descendants() - before if not is_kept(one)]
    assert len(os.listdir("/proc/self/fd")) <= descriptors + 12  # of the warm process


def test_some_misbehaving_engines_fail_alone(run_engines):
    check(run_engines, engines.FAST)


def test_every_misbehaving_engine_fails_alone(run_engines):
    check(run_engines, list(engines.EXPECTED))
