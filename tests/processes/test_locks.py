"""Locks and scratch folders: taken and removed however their owner ended."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from plumbline.processes import isolation
from plumbline.processes.isolation import FileLock, LockHeld, ScratchFolder
from tests.helpers import ROOT


def test_a_lock_is_held_by_one_process_until_it_ends(tmp_path):
    path = tmp_path / "lock"
    script = (
        "import sys, time; from pathlib import Path; from plumbline.processes.isolation import FileLock\n"
        "held = FileLock(Path(sys.argv[1])); print('held', flush=True); time.sleep(600)"
    )
    owner = subprocess.Popen(
        [sys.executable, "-c", script, path], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert owner.stdout.readline() == "held\n"
    with pytest.raises(LockHeld, match="lock"):
        FileLock(path)
    owner.kill()
    owner.wait()
    with FileLock(path), pytest.raises(LockHeld):
        FileLock(path)
    assert not path.exists()


def test_a_lock_whose_file_its_owner_removed_meanwhile_is_taken_anew(tmp_path, monkeypatch):
    path, owners, lock = tmp_path / "lock", [FileLock(tmp_path / "lock")], isolation._try_lock

    def release_first(file):
        while owners:
            owners.pop().release()
        lock(file)

    monkeypatch.setattr(isolation, "_try_lock", release_first)
    with FileLock(path):
        monkeypatch.undo()
        with pytest.raises(LockHeld):
            FileLock(path)


def test_a_folder_whose_owner_ended_before_it_locked_it_is_removed(tmp_path):
    for name in ("plumbline-a1b2c3d_", "plumbline-of-somebody", "plumbline-12345678"):
        (tmp_path / name).mkdir()
    (tmp_path / "plumbline-12345678" / "file").write_text("of somebody")
    made = ScratchFolder(parent=tmp_path)
    left = {p.name for p in tmp_path.iterdir()}
    assert left == {"plumbline-of-somebody", "plumbline-12345678", made.path.name}
    made.remove()


def test_a_new_folder_that_another_run_takes_for_an_orphan_is_made_again(tmp_path, monkeypatch):
    make, made = tempfile.mkdtemp, []

    def make_and_lose(**options):
        made.append(make(**options))
        if len(made) == 1:
            os.rmdir(made[0])
        return made[-1]

    monkeypatch.setattr(tempfile, "mkdtemp", make_and_lose)
    with ScratchFolder(parent=tmp_path) as folder:
        assert str(folder) == made[1] and folder.is_dir()


@pytest.fixture
def short_folder():
    """A folder in which a socket's path has room."""
    with tempfile.TemporaryDirectory(prefix="sockets-") as folder:
        yield Path(folder)


@pytest.mark.parametrize("is_short", [True, False], ids=["sockets", "no room for sockets"])
def test_sockets_of_a_killed_run_are_removed_by_the_next(tmp_path, request, is_short):
    script = tmp_path / "killed.py"
    script.write_text(
        f"import sys, time\nsys.path.insert(0, {str(ROOT)!r})\n"
        "from plumbline.processes.worker_pool import Task, WorkerPool\n"
        "if __name__ == '__main__':\n"
        "    with WorkerPool(1) as workers:\n"
        "        list(workers.run([Task(0, abs, (-1,))]))\n"
        "        print('begun', flush=True)\n"
        "        time.sleep(float(sys.argv[1]))\n"
    )
    place = request.getfixturevalue("short_folder") if is_short else tmp_path / ("x" * 60)
    place.mkdir(exist_ok=True)

    def start(seconds):
        words = [sys.executable, script, seconds]
        return subprocess.Popen(
            words, stdout=subprocess.PIPE, text=True, env={**os.environ, "TMPDIR": str(place)}
        )

    killed = start("600")
    assert killed.stdout.readline() == "begun\n"
    killed.kill()
    killed.wait()
    assert list(place.iterdir()), "nobody has come by yet"
    assert start("0").wait(timeout=60) == 0
    assert not list(place.iterdir())
