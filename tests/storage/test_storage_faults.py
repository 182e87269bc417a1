"""Faults of the disk: every write fails in turn; nothing half is ever read as good, and the night goes on."""

import errno
import os
import sys
import tempfile
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import pytest

from plumbline.cli import nightly
from plumbline.execution import runner
from plumbline.execution.plan import Plan
from plumbline.storage.history_of_nights import History
from plumbline.storage.results_store import read_results
from tests.helpers.commands import run_plumbline
from tests.helpers.in_process import InProcessWorkers
from tests.helpers.nights import run_night

DISK_ERRORS = [errno.ENOSPC, errno.EIO, errno.EROFS, errno.EDQUOT]


class FaultyDisk:
    """Counts every step of every write; fails the ``at``-th, once or from then on."""

    def __init__(self, monkeypatch):
        self.steps, self.at, self.for_good, self.error = 0, 0, False, errno.ENOSPC
        disk, fdopen = self, os.fdopen

        def halving(write):
            """The same, which takes a half of the data before it fails."""

            def half(owner, data, *args, **options):
                try:
                    disk.step()
                except OSError:
                    write(owner, data[: len(data) // 2], *args, **options)
                    raise
                return write(owner, data, *args, **options)

            return half

        class File:
            def __init__(self, file):
                self.file = file

            def __enter__(self):
                return self

            def __exit__(self, *_):
                self.file.close()

            write = halving(lambda self, data: self.file.write(data))

            def __getattr__(self, name):
                return getattr(self.file, name)

        def stepping(call):
            def stepped(*args, **options):
                disk.step()
                return call(*args, **options)

            return stepped

        for owner, name in ((os, "replace"), (os, "fsync"), (tempfile, "mkstemp"), (Path, "mkdir")):
            monkeypatch.setattr(owner, name, stepping(getattr(owner, name)))
        monkeypatch.setattr(Path, "write_text", halving(Path.write_text))
        monkeypatch.setattr(os, "fdopen", lambda handle, mode: File(fdopen(handle, mode)))

    def step(self):
        self.steps += 1
        if self.at and (self.steps == self.at or (self.for_good and self.steps > self.at)):
            raise OSError(self.error, os.strerror(self.error))

    def fail_at(self, failing_step, error=errno.ENOSPC, persistent=False):
        self.steps, self.at, self.error, self.for_good = 0, failing_step, error, persistent

    def repair(self):
        self.fail_at(0)


@pytest.fixture
def quick_nights(monkeypatch):
    monkeypatch.setattr(runner, "WorkerPool", InProcessWorkers)
    monkeypatch.setattr(nightly, "Plan", lambda *a, **k: Plan(*a, **k, random_state_count=1))


@pytest.fixture
def faulty_disk(monkeypatch, quick_nights):
    return FaultyDisk(monkeypatch)


def night(out):
    result, place = run_night(out, level="state")
    return [replace(row, cpu_time=0.0) for row in result.rows], place


def check_recovery(disk, out, expected, failing_step, error, persistent):
    disk.fail_at(failing_step, error, persistent)
    try:
        rows, _ = night(out)
        assert rows == expected, "where no cell can be kept, the night goes on"
    except OSError as failure:
        assert os.strerror(error) in str(failure)
    disk.repair()
    found = History(out) if out.exists() else None
    if found:
        assert not found.damaged and len(found.nights) <= 1  # 1: whole, a later step failed
    rows, place = night(out)
    assert rows == expected
    assert read_results(place)["run"]["exit_code"] == 0
    assert sorted(p.name for p in out.iterdir()) == ["history"]
    assert not list(out.rglob(".*")), "temporary files are left"


def check_every_step(disk, tmp_path, errors, persistence):
    expected, _ = night(tmp_path / "calm")
    disk.repair()
    assert night(tmp_path / "count")[0] == expected
    steps = disk.steps
    faults = 0
    for at in range(1, steps + 1):
        for error in errors:
            for for_good in persistence:
                out = tmp_path / f"{at}-{error}-{for_good}"
                check_recovery(disk, out, expected, at, error, for_good)
                faults += 1
    return steps, faults


@pytest.mark.timeout(300)
def test_a_full_disk_at_every_step_of_every_write(faulty_disk, tmp_path):
    steps, _ = check_every_step(faulty_disk, tmp_path, [errno.ENOSPC], [False])
    assert steps > 30, "the faults no longer reach the writes"


@pytest.mark.full
@pytest.mark.timeout(3600)
def test_every_error_at_every_step_once_and_for_good(faulty_disk, tmp_path, record_testsuite_property):
    steps, faults = check_every_step(faulty_disk, tmp_path, DISK_ERRORS, [False, True])
    record_testsuite_property("steps of writing", steps)
    record_testsuite_property("faults injected", faults)


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of file size")
def test_the_command_reports_the_damage_and_continues(tmp_path, own_cells):
    """The kernel refuses files above 120 kB: the cells fit, the report does not."""
    words = ["run", "rest", "--engine", "mujoco", "--level", "state", "--jobs", "1", "--out", tmp_path]
    limited = run_plumbline(*words, code=4, largest_file=120_000)
    assert "I/O error" in limited.stderr and "run the same command to resume" in limited.stderr
    assert not (tmp_path / "report.html").exists()
    assert len(list(own_cells.glob("*.cell"))) == 4  # description, states, truth, answer
    again = run_plumbline(*words, code=0)
    assert (tmp_path / "report.html").exists() and "2 answers of earlier runs" in again.stderr


def test_a_clock_set_back_overwrites_no_night(tmp_path):
    place = tmp_path / "20260101T000000Z"
    assert nightly.unused_path(place) == place
    place.mkdir()
    assert nightly.unused_path(place).name == "20260101T000000Z-2"


@pytest.mark.usefixtures("quick_nights")
def test_nights_are_listed_in_the_order_of_their_making(tmp_path, monkeypatch):
    """The clock is set back, forward within the second night, and then shows the first one again."""
    days = iter([10, 10, 5, 8, 10, 10])  # when a night begins, and when its run does

    class Clock(datetime):
        @classmethod
        def now(cls, tz=None):
            return datetime(2026, 1, next(days), tzinfo=tz)

    monkeypatch.setattr(nightly, "datetime", Clock)
    monkeypatch.setattr(runner, "datetime", Clock)
    made = [night(tmp_path)[1].name for _ in range(3)]
    assert made == ["20260110T000000Z", "20260108T000000Z", "20260110T000000Z-2"]
    history = History(tmp_path)
    assert [n.folder.name for n in history.nights] == made
    assert [n["id"] for n in history.overview()] == made
    assert [t["id"] for t in history.trend("rest/mujoco/state/-/acceleration")] == made
