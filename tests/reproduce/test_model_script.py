"""Scripts of importers' differences: small files, at most 40 lines, and they print what they claim."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner

from plumbline.cli.main import main
from plumbline.importers.xml_tree import parse_xml, write_xml
from plumbline.reproduce.model_script import MAX_LINES, NoModelScript, write_model_script
from plumbline.reproduce.model_shrink import shrink_tree
from tests.helpers.random_robots import random_urdf

# Pinocchio 4.1 keeps its own gravity and ignores references
MJCF = """<mujoco model="moon">
<compiler angle="radian"/><option gravity="0 0 -1.62" timestep="0.01"/>
<worldbody>
<body name="first" pos="0.1 0.2 0.3">
<joint name="pivot" axis="0 1 0" damping="0.3"/>
<inertial pos="0.123 0 -1" mass="2.345" diaginertia="1 1.2 1.1"/>
<body name="second" pos="0 0 -1"><joint name="elbow" axis="1 0 0"/>
<inertial pos="0 0 -0.5" mass="1.1" diaginertia="1 1 1"/></body>
</body>
</worldbody>
</mujoco>
"""


def test_a_script_shows_the_difference_of_the_smallest_file(tmp_path):
    path = tmp_path / "moon.xml"
    path.write_text(MJCF)
    script = write_model_script(str(path), "pinocchio", "pinocchio", seconds=40)
    assert len(script.text.splitlines()) <= MAX_LINES
    assert "reads the gravity of the model as (0, 0, -9.81)" in script.text.replace("\n", " ")
    assert script.file.count("<body") == 1
    written = tmp_path / "script.py"
    written.write_text(script.text)
    ran = subprocess.run(
        [sys.executable, str(written)], capture_output=True, text=True, cwd=tmp_path, timeout=60
    )
    assert ran.returncode == 0, ran.stderr
    value, expected = map(float, re.search(r": (\S+) expected: (\S+)", ran.stdout).groups())
    assert value == pytest.approx(script.engine_value, rel=1e-12)
    assert expected == script.expected
    assert abs(value - expected) > 1e-6


def test_the_command_lists_and_writes(tmp_path):
    path = tmp_path / "moon.xml"
    path.write_text(MJCF)
    runner, out = CliRunner(), tmp_path / "out"
    arguments = [
        "model",
        str(path),
        "--engine",
        "pinocchio",
        "--states",
        "2",
        "--jobs",
        "1",
        "--out",
        str(out),
    ]
    assert runner.invoke(main, arguments).exit_code == 1
    listed = runner.invoke(main, ["reproduce", str(out)])
    assert listed.exit_code == 0
    key = listed.stdout.split(": ")[0]
    assert key.endswith("moon.xml/pinocchio/model/-/gravity_force")
    assert runner.invoke(main, ["reproduce", str(out), "no/such/key"]).exit_code == 2
    wrong = runner.invoke(main, ["reproduce", str(out), key, "--form", "drake"])
    assert wrong.exit_code == 1
    assert "pinocchio differs; a script for drake cannot show that" in wrong.stderr
    (out / "model.json").write_text(json.dumps({"files": [], "options": {}}))
    assert "nothing differs" in runner.invoke(main, ["reproduce", str(out)]).stderr


def test_an_importer_that_agrees_has_no_script(tmp_path):
    path = tmp_path / "moon.xml"
    path.write_text(MJCF)
    with pytest.raises(NoModelScript, match="does not differ"):
        write_model_script(str(path), "mujoco", "mujoco", seconds=1)


def test_shrinking_keeps_what_is_looked_for_and_drops_the_rest():
    tree = parse_xml(random_urdf(np.random.default_rng(2), 6).encode(), "robot")
    before = write_xml(tree)

    def shows(candidate):
        return any(e.attributes.get("name") == "link4" and e.find("inertial") for e in candidate.walk())

    small = shrink_tree(tree, shows, 20)
    assert write_xml(tree) == before
    assert sum(1 for _ in small.walk()) == 3
    assert write_xml(small).count("link") == 3
