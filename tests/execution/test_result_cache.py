"""What the result cache reads, refuses and covers, and what happens where its folder cannot be used."""

import os
import pickle
import sys
from dataclasses import replace

import numpy as np
import pytest

from plumbline.diagnosis.cause import Cause, Diagnosis
from plumbline.engines.environments import EnvironmentUnavailable, ensure_interpreter
from plumbline.execution import environment_fingerprint
from plumbline.execution.environment_fingerprint import installed_files
from plumbline.execution.result_cache import DiskResultCache, task_hash
from plumbline.judging.rows import JudgingResult, RowContext
from plumbline.processes.record_encoding import decode_record, encode_record
from plumbline.processes.user_cache import CheckedFiles, recall, remember
from plumbline.processes.worker_environment import hashed_environment
from plumbline.processes.worker_pool import Task, WorkerPool
from tests.helpers.commands import invoke, run_plumbline
from tests.helpers.in_process import InProcessWorkers
from tests.helpers.runs import run_scenarios


def quiet(*_):
    pass


def hash_anew(python=""):
    """The hash of a task of an environment, with the files and variables of now."""
    environment_fingerprint.environment_fingerprint.cache_clear()
    try:
        return task_hash(Task("a", quiet, python=python))
    finally:
        environment_fingerprint.environment_fingerprint.cache_clear()


# --- what the hash covers ----------------------------------------------------------------------


def make_environment(folder):
    site = folder / "lib" / "python3.11" / "site-packages"
    (site / "engine").mkdir(parents=True)
    (folder / "lib64").symlink_to("lib")
    (site / "engine" / "__init__.py").write_text("x = 1\n")
    (site / "engine" / "core.so").write_bytes(b"old")
    (site / "engine-1.0.dist-info").mkdir()
    return site


def patch_keeping_size_and_time(path):
    about = path.stat()
    path.write_bytes(path.read_bytes()[::-1])
    os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))


def replace_library(site, elsewhere):
    (elsewhere / "core.so").write_bytes(b"new")
    os.utime(elsewhere / "core.so", ns=(0, (site / "engine" / "core.so").stat().st_mtime_ns))
    os.replace(elsewhere / "core.so", site / "engine" / "core.so")


def link_by_pth(site, elsewhere):
    (site / "engine.pth").write_text(f"# built here\n{elsewhere}\n")


def install_for_editing(site, elsewhere):
    (site / "engine-1.0.dist-info" / "direct_url.json").write_text(
        f'{{"url": "{elsewhere.as_uri()}", "dir_info": {{"editable": true}}}}'
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda site, _: (site / "engine" / "__init__.py").write_text("x = 12\n"),
        lambda site, _: patch_keeping_size_and_time(site / "engine" / "__init__.py"),
        lambda site, _: (site / "sitecustomize.py").write_text(""),
        lambda site, _: (site / "engine" / "core.so").unlink(),
        replace_library,
        link_by_pth,
        install_for_editing,
    ],
)
def test_a_changed_file_of_an_environment_is_noticed(tmp_path, change):
    site, elsewhere = make_environment(tmp_path / "environment"), tmp_path / "built"
    elsewhere.mkdir()
    before = installed_files([tmp_path / "environment"])
    assert before == installed_files([tmp_path / "environment"])
    change(site, elsewhere)
    assert before != installed_files([tmp_path / "environment"])


@pytest.mark.parametrize("link", [link_by_pth, install_for_editing])
def test_a_rebuilt_file_of_a_package_that_lies_elsewhere_is_noticed(tmp_path, link):
    site, elsewhere = make_environment(tmp_path / "environment"), tmp_path / "built here"
    elsewhere.mkdir()
    link(site, elsewhere)
    (elsewhere / "core.so").write_bytes(b"old")
    before = installed_files([tmp_path / "environment"])
    (elsewhere / "core.so").write_bytes(b"new")
    assert before != installed_files([tmp_path / "environment"])


def test_the_answers_of_another_version_depend_on_its_environment(tmp_path):
    site = make_environment(tmp_path)
    hashes = set()
    for text in ("x = 1\n", "x = 2\n"):
        (site / "engine" / "__init__.py").write_text(text)
        hashes.add(hash_anew(str(tmp_path / "bin" / "python")))
    assert len(hashes) == 2 and hash_anew() not in hashes


@pytest.mark.parametrize("file", ["engine-1.0.dist-info/RECORD", "engine/libengine.so.4", "mujoco.py"])
def test_another_installation_has_other_cells(tmp_path, monkeypatch, file):
    """The same version of an engine: installed again, built again in its place, replaced on PYTHONPATH."""
    (tmp_path / file).parent.mkdir(exist_ok=True)
    monkeypatch.syspath_prepend(tmp_path)
    hashes = set()
    for size in (1, 2):
        (tmp_path / file).write_text("x" * size)
        hashes.add(hash_anew())
    assert len(hashes) == 2


def test_another_processor_has_other_cells(monkeypatch):
    """The last bits of results depend on its vector instructions."""
    hashes = set()
    for features in ("flags: fma", "flags: fma avx512f"):
        monkeypatch.setattr(environment_fingerprint, "processor_features", lambda features=features: features)
        hashes.add(hash_anew())
    assert len(hashes) == 2


@pytest.mark.parametrize("name", ["BAD", "MUJOCO_DEBUG", "LD_LIBRARY_PATH", "OPENBLAS_CORETYPE", "x"])
def test_a_variable_that_an_engine_can_read_changes_the_hash(monkeypatch, name):
    before = hash_anew()
    monkeypatch.setenv(name, "/nan")
    assert hash_anew() != before


def test_a_file_that_a_variable_names_changes_the_hash(monkeypatch, tmp_path):
    for name, path in (("ENGINE_SETTINGS", tmp_path / "a.yaml"), ("LD_LIBRARY_PATH", tmp_path)):
        (tmp_path / "a.yaml").write_text("x: 1\n")
        monkeypatch.setenv(name, f"/usr/lib:{path}")
        before = hash_anew()
        patch_keeping_size_and_time(tmp_path / "a.yaml")
        assert hash_anew() != before
        monkeypatch.delenv(name)


def test_another_terminal_has_the_same_cells(monkeypatch):
    before = hash_anew()
    for name in ("TERM", "COLUMNS", "SSH_CONNECTION", "SHLVL", "GITHUB_RUN_ID", "PLUMBLINE_CACHE", "TMPDIR"):
        monkeypatch.setenv(name, "/another")
    assert hash_anew() == before


def variables_of_worker():
    import tempfile

    return dict(os.environ), tempfile.gettempdir(), os.getcwd()


def test_a_worker_has_no_variable_that_is_not_hashed(monkeypatch):
    monkeypatch.setenv("TERM", "unhashed")
    monkeypatch.setenv("BAD", "nan")
    with WorkerPool(1) as workers:
        (outcome,) = workers.run([Task("a", variables_of_worker)])
    found, scratch, working_folder = outcome.value
    hashed = hashed_environment()
    assert hashed["BAD"] == "nan" and "TERM" not in found
    others = {name for name in found if found[name] != hashed.get(name)}
    assert others - {"LC_CTYPE"} <= {"PLUMBLINE_CACHE", "TMPDIR", "TEMP", "TMP"}  # Python sets LC_CTYPE
    assert scratch == working_folder, "what an engine leaves there is removed with its worker"


# --- what is read ------------------------------------------------------------------------------


class Touch:
    """A pickle of it makes a file where it is loaded."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"touch {self.path}",)


def run_rest(folder, log=quiet):
    ran = []

    class Workers(InProcessWorkers):
        def start(self, task):
            ran.append(task)
            super().start(task)

    options = {"random_state_count": 2, "result_cache": DiskResultCache(folder, log)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("plumbline.execution.runner.WorkerPool", Workers)
        result = run_scenarios(["rest"], ["reference"], "state", **options)
    return [replace(row, cpu_time=0.0) for row in result.rows], len(ran)


def size_and(record):
    return len(record).to_bytes(8, "little") + record


CONTEXT = RowContext("rest", "single", "reference", "Reference", "1")
ROW = CONTEXT.make_row("state", "-", "acceleration", "agrees", "why")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"12345678",
        b"\xff" * 40,
        pickle.dumps(5),
        size_and(b"") + encode_record(5),
        size_and(b"") + encode_record((1.0, None)),
        size_and(b"") + encode_record((1.0, [1, 2])),
        size_and(b"") + encode_record(("a", JudgingResult([ROW]))),
        size_and(b"") + encode_record((1.0, JudgingResult([5]))),
        size_and(b"") + encode_record((1.0, JudgingResult(None))),
        size_and(b"") + encode_record((1.0, JudgingResult([replace(ROW, value="1")]))),
        size_and(b"") + encode_record((1.0, JudgingResult([replace(ROW, verdict="perfect")]))),
        size_and(b"") + encode_record((1.0, JudgingResult([ROW], [("states", {"a": [1], "b": [1, 2]})]))),
        size_and(encode_record({"a": np.zeros(2)})) + encode_record((1.0, None)),
    ],
)
def test_a_cell_with_the_right_checksum_and_another_content_runs_again(tmp_path, content):
    expected, everything = run_rest(tmp_path)
    for path in tmp_path.glob("*.cell"):
        CheckedFiles(tmp_path).write(path.name, content)
    reported = []
    assert run_rest(tmp_path, reported.append) == (expected, everything)
    assert len(reported) == everything + 1, "with the cell of the states, which no worker computes"
    assert all("damaged" in sentence for sentence in reported)
    assert run_rest(tmp_path) == (expected, 0)


def test_cells_that_change_places_run_again(tmp_path):
    expected, everything = run_rest(tmp_path)
    paths = sorted(tmp_path.glob("*.cell"))
    contents = [path.read_bytes() for path in paths]
    for path, content in zip(paths, contents[1:] + contents[:1], strict=True):
        path.write_bytes(content)
    assert run_rest(tmp_path) == (expected, everything)


def test_no_code_of_a_cell_runs(tmp_path):
    expected, everything = run_rest(tmp_path / "cells")
    for path in (tmp_path / "cells").glob("*.cell"):
        CheckedFiles(path.parent).write(path.name, pickle.dumps(Touch(tmp_path / "touched")))
    assert run_rest(tmp_path / "cells") == (expected, everything)
    assert not (tmp_path / "touched").exists()


# --- whose folder it is ------------------------------------------------------------------------


def run_command(out):
    result = invoke("run", "rest", "--engine", "reference", "--level", "state", "--out", out, code=0)
    return result.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="no permissions of this kind")
@pytest.mark.parametrize(("folder", "mode"), [(".", 0o777), ("cells", 0o770)])
def test_a_cache_that_others_can_write_to_is_not_used(tmp_path, own_cells, folder, mode):
    run_command(tmp_path)
    place = own_cells.parent / folder
    place.chmod(mode)
    reported = run_command(tmp_path)
    assert reported.count("the result cache cannot be used, the run goes on without it") == 1
    assert str(place.resolve()) in reported and "chmod go-w" in reported and "PLUMBLINE_CACHE" in reported
    assert "answers of earlier runs" not in reported
    place.chmod(0o700)
    assert "2 answers of earlier runs" in run_command(tmp_path)


@pytest.mark.skipif(sys.platform == "win32", reason="no owners of this kind")
def test_a_cache_of_another_user_is_not_used(tmp_path, own_cells, monkeypatch):
    run_command(tmp_path)
    remember("a", 1)
    number = own_cells.stat().st_uid
    for path in (own_cells.parent, *own_cells.parent.rglob("*")):
        os.chown(path, 12345, -1, follow_symlinks=False) if number == 0 else None
    monkeypatch.setattr(os, "geteuid", lambda: 54321)
    reported = run_command(tmp_path)
    assert "belongs to another user" in reported and "answers of earlier runs" not in reported
    assert recall("a") is None


@pytest.mark.skipif(sys.platform == "win32", reason="no permissions of this kind")
def test_no_environment_is_used_that_others_can_write_to(own_cells):
    engines = own_cells.parent / "engines"
    engines.unlink()
    engines.mkdir()
    engines.chmod(0o777)
    with pytest.raises(EnvironmentUnavailable, match="other users may write to it"):
        ensure_interpreter("mujoco@3.12.0")


# --- a folder that cannot be written -----------------------------------------------------------


def test_a_run_goes_on_without_a_cache_that_cannot_be_made(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("PLUMBLINE_CACHE", str(tmp_path / "file"))
    reported = run_command(tmp_path / "out")
    assert reported.count("the result cache cannot be") == 1 and "PLUMBLINE_CACHE" in reported
    assert (tmp_path / "out" / "report.html").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of file size")
def test_a_full_disk_is_reported_for_what_it_is(tmp_path):
    """The kernel refuses files above 2 kB: neither the cells fit, nor the results."""
    words = ["run", "rest", "--engine", "reference", "--level", "state", "--jobs", "1", "--out", tmp_path]
    done = run_plumbline(*words, code=4, largest_file=2_000)
    assert done.stderr.count("the result cache cannot be written, the run goes on without it") == 1
    assert done.stderr.rstrip().endswith("Finished cells were not saved; the same command begins again.")


def test_a_cause_that_holds_causes_is_kept():
    def cause(term, *equal):
        return Cause("number", term, "body 1", "twice", equal=equal)

    whole = Diagnosis((cause("mass", cause("inertia"), cause("length")), cause("gravity")))
    assert decode_record(encode_record(whole), Diagnosis) == whole
