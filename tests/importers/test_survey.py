"""The survey of public robots: its page from a small document, and the scripts that the page links."""

import subprocess

import pytest

from plumbline.engines.environments import EnvironmentUnavailable, importer_interpreter
from tests.helpers import ROOT
from tools.model_survey.examined import EXAMINED
from tools.model_survey.page import write_page
from tools.model_survey.run import robot_files

SCRIPTS = sorted((ROOT / "docs" / "importers").glob("*.py"))
MAX_LINES = 40


def row(engine, verdict, quantity="mass_matrix", reason="off by 1; rounding explains 0"):
    return {"engine": engine, "verdict": verdict, "quantity": quantity, "reason": reason}


DOCUMENT = {
    "engines": {"mujoco": {"version": "4.0.0"}, "drake": {"version": "1.51.1"}},
    "seconds": 60.0,
    "problems": [{"file": "a/b/broken.urdf", "line": 3, "text": "a/b/broken.urdf:3:1: has no <link>"}],
    "files": [
        {
            "file": "a/b/arm.urdf", "degrees_of_freedom": 1,
            "rows": [row("mujoco", "agrees"), row("drake", "disagrees"), row("dart", "disagrees")],
            "causes": [
                {
                    "engine": "drake", "field": "mass", "body": "link", "joint": "", "count": 1,
                    "source": {"file": "a/b/arm.urdf", "line": 7}, "sentence": "reads the mass as 1",
                }
            ],
        },
        {
            "file": "a/b/arm.xml", "degrees_of_freedom": 1,
            "rows": [row("mujoco", "unsupported", "all", "refused: bad <mesh> in /tmp/x.xml"),
                     row("drake", "information", "all", "Drake reads URDF files only")],
            "causes": [],
        },
    ],
}  # fmt: skip


def test_the_page_counts_files_by_what_happened():
    page = write_page(DOCUMENT, {"robots": "1.0"})
    assert "| URDF | MuJoCo | 1 | 1 | 0 | 0 | 0 | 0 |" in page
    assert "| URDF | Drake | 1 | 0 | 1 | 0 | 0 | 0 |" in page
    assert "| URDF | DART | 1 | 0 | 0 | 1 | 0 | 0 |" in page
    assert "| MJCF | MuJoCo | 1 | 0 | 0 | 0 | 1 | 0 |" in page
    assert "| MJCF | Drake" not in page
    assert "a/…/arm.urdf:7 `link` | [drake_replaced_inertia.py]" in page
    assert "bad ‹mesh› in …" in page
    assert "a/…/broken.urdf:3: has no ‹link›" in page


def test_every_examined_script_exists_and_is_short():
    named = {entry.script for entry in EXAMINED if entry.script}
    assert named == {script.name for script in SCRIPTS} and SCRIPTS
    for script in SCRIPTS:
        assert len(script.read_text(encoding="utf-8").splitlines()) <= MAX_LINES, script.name


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_shows_the_difference_with_the_locked_versions(script):
    try:
        python = importer_interpreter(script.stem.partition("_")[0])
    except EnvironmentUnavailable as error:
        pytest.skip(str(error))
    command = [python or str(ROOT / ".venv" / "bin" / "python"), str(script)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    text = done.stdout.replace("\n", " ")
    expected, found = (part.split("  ")[0] for part in text.rpartition("expected")[2].split("found"))
    assert expected.strip(" ,") != found.strip()


def test_parts_of_models_and_most_alike_objects_are_left_out(tmp_path):
    (tmp_path / "model.xml").write_text("<mujoco/>")
    (tmp_path / "part.xml").write_text("<mujocoinclude/>")
    (tmp_path / "other.xml").write_text("<sdf/>")
    for count in ("01", "02"):
        (tmp_path / f"{count}_humanoids.xml").write_text("<mujoco/>")
    for k in range(12):
        folder = tmp_path / "random_urdfs" / f"{k:03}"
        folder.mkdir(parents=True)
        (folder / f"{k:03}.urdf").write_text("<robot/>")
    names = [path.name for path in robot_files(tmp_path)]
    assert names == [f"{k:03}.urdf" for k in range(10)] + ["01_humanoids.xml", "model.xml"]
