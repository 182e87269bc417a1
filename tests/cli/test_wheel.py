"""The wheel: built, installed and run in an empty folder, where it writes nothing but its results."""

import ast
import json
import os
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

from plumbline.engines.environments import _run_uv
from plumbline.storage.results_store import read_results
from plumbline.truth import has_independent_truth
from tests.helpers.commands import run_plumbline, run_python
from tests.helpers.dask_cluster import cluster
from tests.helpers.terminal_counts import agreed
from tools.release import problem, release_notes

RUN = ("run", "tumbling-ball", "--level", "state", "--engine", "reference", "--engine", "mujoco")
MAX_WHEEL_BYTES = 1.5e6
MAX_INSTALLED_BYTES = 500e6  # with MuJoCo alone, without the bytecode that Python makes of it or not
MAX_SECONDS_TO_VERDICT = 30  # of CPU: another test may run on the same cores
MOVED = {"adapters", "reference_impl", "reports", "bench", "tests", "tools"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    run_python("-m", "hatchling", "build", "-t", "wheel", "-d", folder, code=0)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def unpacked(wheel, tmp_path_factory):
    """What site-packages gets, used with the packages of this environment."""
    folder = tmp_path_factory.mktemp("site-packages")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def imported_names(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            yield node.module


def test_the_wheel_is_small_and_has_one_package(wheel, unpacked):
    assert wheel.stat().st_size <= MAX_WHEEL_BYTES
    assert {path.name.partition("-")[0] for path in unpacked.iterdir()} == {"plumbline"}
    for path in unpacked.rglob("*.py"):
        wrong = {name for name in imported_names(path) if name.split(".")[0] in MOVED}
        assert not wrong, f"{path} imports {wrong}, which is not below plumbline"
    assert len(list((unpacked / "plumbline/scenarios").rglob("*.yaml"))) > 60


def test_installed_it_compares_engines_and_writes_one_folder(unpacked, tmp_path):
    (tmp_path / ".git").mkdir()  # of the user: not of this project
    done = run_plumbline(*RUN, "--fresh", cwd=tmp_path, path=[unpacked], code=0)
    assert {path.name for path in tmp_path.iterdir()} == {".git", "plumbline-out"}
    assert (tmp_path / "plumbline-out/report.html").is_file()
    assert agreed(done.stdout) >= 14
    run = read_results(tmp_path / "plumbline-out")["run"]
    assert run["commit"] is None and "certified" in run["truth"]
    done = run_plumbline("history", cwd=tmp_path, path=[unpacked], code=2)
    assert "no folder plumbline-out/nightly" in done.stderr


@pytest.mark.timeout(300)
def test_installed_it_runs_on_a_cluster_without_a_checkout(unpacked, tmp_path):
    pytest.importorskip("distributed")
    with cluster(tmp_path, 1, import_path=unpacked) as (address, _):
        done = run_plumbline(*RUN, "--fresh", "--scheduler", address, cwd=tmp_path, path=[unpacked])
    assert done.returncode == 0 and agreed(done.stdout) >= 14, done.stdout + done.stderr


def test_without_an_independent_truth_no_row_agrees(unpacked, tmp_path):
    """python-flint cannot be imported: a module of its name is empty, and has no specification."""
    assert has_independent_truth()
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['flint'] = None\n")
    done = run_plumbline(*RUN, "--json", cwd=tmp_path, path=[tmp_path, unpacked])
    rows = json.loads(done.stdout)["rows"]
    assert {row["verdict"] for row in rows} == {"unresolved"}
    assert all(row["reason"].startswith("no independent truth") for row in rows)


@pytest.mark.full
def test_two_lines_in_an_empty_environment_lead_to_a_verdict(wheel, tmp_path):
    """Then another version of an engine is what runs: the packages beside the wheel do not hide it."""
    environment, folder = tmp_path / "environment", tmp_path / "empty"
    folder.mkdir()
    _run_uv("venv", "--python", sys.executable, str(environment))
    before, start = os.times(), time.monotonic()
    _run_uv("pip", "install", "--python", str(environment / "bin/python"), f"{wheel}[mujoco]")
    program = environment / "bin/plumbline"
    words = [program, "run", "tumbling-ball", "--level", "state"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    after, wall_time = os.times(), time.monotonic() - start
    cpu_time = sum(after[2:4]) - sum(before[2:4])
    assert done.returncode == 0 and agreed(done.stdout) >= 14, done.stdout + done.stderr
    assert cpu_time <= MAX_SECONDS_TO_VERDICT, f"{cpu_time:.1f} s of CPU, {wall_time:.1f} s"
    files = (path for path in environment.rglob("*") if path.is_file() and path.suffix != ".pyc")
    size = sum(path.stat().st_size for path in files)
    assert size <= MAX_INSTALLED_BYTES
    assert {path.name for path in folder.iterdir()} == {"plumbline-out"}
    words += ["--engine", "mujoco@3.13.0", "--json"]
    beside = f"{os.environ['PATH']}{os.pathsep}{Path(sys.prefix).resolve().parent / '.uv/bin'}"
    variables = os.environ | {"PATH": beside}  # uv, as make puts it
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, env=variables, check=False)
    assert json.loads(done.stdout)["run"]["versions"] == {"mujoco@3.13.0": "3.13.0"}


def test_a_release_needs_a_clean_commit_a_new_tag_and_notes():
    changelog = "# Changelog\n\n## Unreleased\n\n## 1.2.0 (2027)\n\n- New: y.\n\n## 1.1.0\n\n- z\n"
    assert release_notes(changelog, "1.2.0") == "- New: y."
    assert release_notes(changelog, "1.2") == "" and release_notes(changelog, "1.1.0") == "- z"
    assert problem("", "v1.1.0\n", changelog, "1.2.0") == ""
    assert "differ" in problem(" M README.md\n", "", changelog, "1.2.0")
    assert "is a tag already" in problem("", "v1.1.0\nv1.2.0\n", changelog, "1.2.0")
    assert "no section" in problem("", "", changelog, "1.3.0")
    changelog = changelog.replace("## Unreleased\n", "## Unreleased\n\n- x\n")
    assert "belong under `## 1.2.0`" in problem("", "", changelog, "1.2.0")
