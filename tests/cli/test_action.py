"""The GitHub Action: its steps, run by the shell as a runner would."""

import os
import re
import shutil
import subprocess
import sys
from types import MappingProxyType

import pytest
from ruamel.yaml import YAML

from tests.helpers import ROOT
from tests.helpers.model_mutations import FOLDER

ACTION = YAML(typ="safe").load(ROOT / "action.yml")


def run_step(name, folder, variables=MappingProxyType({}), **inputs):
    """One step with the inputs' defaults, in a folder of the user's."""
    (step,) = (step for step in ACTION["runs"]["steps"] if step["name"] == name)
    values = {key: str(given.get("default", "")) for key, given in ACTION["inputs"].items()} | inputs
    environment = {
        key: re.sub(r"\$\{\{ inputs\.(\w+) \}\}", lambda found: values[found[1]], text)
        for key, text in step["env"].items()
    }
    return subprocess.run(
        ["bash", "-eo", "pipefail", "-c", step["run"]],
        cwd=folder, env=os.environ | environment | variables | {"GITHUB_ACTION_PATH": str(ROOT)},
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


@pytest.fixture
def robots(tmp_path):
    for name in ("pendulum.urdf", "arm.urdf"):
        shutil.copy(FOLDER / name, tmp_path)
    (tmp_path / "known.yaml").write_text("")
    return tmp_path


def test_patterns_are_compared_and_results_written(robots):
    done = run_step(
        "Compare", robots, files="*.urdf", baseline="known.yaml", options="--engine mujoco --states 2"
    )
    assert done.returncode == 0, done.stderr
    assert "pendulum.urdf" in done.stdout and "arm.urdf" in done.stdout
    sarif = re.sub(r"\$\{\{ inputs\.report \}\}", "plumbline-model", ACTION["outputs"]["sarif"]["value"])
    assert (robots / sarif).is_file() and (robots / "plumbline-model" / "junit.xml").is_file()


def test_a_bad_file_fails_the_step(robots):
    (robots / "bad.urdf").write_text("<robot name='r'><link name='a'/><link name='a'/></robot>")
    done = run_step("Compare", robots, files="bad.urdf", options="--engine mujoco")
    assert done.returncode == 2 and "bad.urdf:1" in done.stderr


SPY = """
import os
from pathlib import Path

Path({mark!r}).write_text("\\n".join(f"{{k}}={{v}}" for k, v in os.environ.items()))
{toy}"""


def test_an_engine_is_compared_and_sees_no_secret(tmp_path):
    mark, server = tmp_path / "environment", tmp_path / "spy.py"
    toy = (ROOT / "tests/helpers/toy_server.py").read_text()
    server.write_text(SPY.format(mark=str(mark), toy=toy))
    secrets = {"GITHUB_TOKEN": "hush", "DEPLOY_KEY": "hush"}
    given = {"adapter": f"cmd:{sys.executable} spy.py", "scenarios": "tumbling-ball"}
    done = run_step("Compare the engine", tmp_path, secrets, **given)
    assert done.returncode == 0 and "2 agree" in done.stdout, done.stdout + done.stderr
    assert "PATH=" in mark.read_text() and "hush" not in mark.read_text()
    assert (tmp_path / "plumbline-model/results.json").is_file()


def test_an_engine_is_not_run_where_forks_have_secrets(tmp_path):
    event = {"GITHUB_EVENT_NAME": "pull_request_target"}
    done = run_step("Compare the engine", tmp_path, event, adapter="cmd:touch started")
    assert done.returncode == 2 and "use pull_request" in done.stdout
    assert not (tmp_path / "started").exists()
