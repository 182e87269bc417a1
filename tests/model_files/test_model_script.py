"""Scripts of importers' differences: small files, at most 40 lines, and they print what they claim."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner

from plumbline.cli.main import main
from plumbline.engines.environments import EnvironmentUnavailable, importer_interpreter
from plumbline.importers.neutral_model import ElementaryJoint, ModelQuantities, NeutralBody, NeutralModel
from plumbline.importers.xml_tree import parse_xml, write_xml
from plumbline.model_files import model_script
from plumbline.model_files.certified_model import CertifiedModelQuantities
from plumbline.model_files.model_comparison import mismatches_as_read
from plumbline.model_files.model_run import ModelPlan
from plumbline.model_files.model_script import MAX_LINES, NoModelScript, write_model_script
from plumbline.model_files.xml_shrink import shrink_tree
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


def plan_of(path, importer):
    return ModelPlan((str(path),), (importer,))


def printed_numbers(script, ran):
    """The engine's number and the right one, which a script prints; they differ."""
    assert ran.returncode == 0, ran.stderr
    value, expected = map(float, re.search(r": (\S+) expected: (\S+)", ran.stdout).groups())
    assert value == pytest.approx(script.number.engine_value, rel=1e-12)
    assert expected == script.number.expected
    assert abs(value - expected) > 1e-6
    return value, expected


def test_a_script_shows_the_difference_of_the_smallest_file(tmp_path):
    path = tmp_path / "moon.xml"
    path.write_text(MJCF)
    script = write_model_script(plan_of(path, "pinocchio"), "pinocchio", seconds=40)
    assert len(script.text.splitlines()) <= MAX_LINES
    assert "reads the gravity of the model as (0, 0, -9.81)" in script.text.replace("\n", " ")
    assert script.file.count("<body") == 1
    written = tmp_path / "script.py"
    written.write_text(script.text)
    ran = subprocess.run(
        [sys.executable, str(written)], capture_output=True, text=True, cwd=tmp_path, timeout=60
    )
    value, expected = printed_numbers(script, ran)
    difference, allowed = map(float, re.search(r"difference: (\S+) allowed: (\S+)", ran.stdout).groups())
    assert (
        difference == value - expected
        and allowed == pytest.approx(script.number.allowed, rel=0.01)
        and allowed < 1e-12
    )


ARM = """<robot name="r"><link name="base"/>
<link name="a"><inertial><origin xyz="0.1 1 0"/><mass value="1.5"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.15"/></inertial></link>
<joint name="j" type="continuous"><parent link="base"/><child link="a"/>
<axis xyz="AXIS</joint></robot>
"""


@pytest.mark.parametrize(
    ("axis", "words"),
    [
        ('0 0.6 0.8"/>', "reads the axis of joint j as (0, 0, 1)"),
        ('0 0 1"/><dynamics damping="0.5" friction="0.2"/>', "reads the damping of joint j as "),
    ],
)
def test_a_script_of_exudyns_loader(tmp_path, axis, words):
    """The loader turns links about oblique axes, and takes the file's friction for a viscous one."""
    try:
        python = importer_interpreter("exudyn")
    except EnvironmentUnavailable as error:
        pytest.skip(str(error))
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.replace("AXIS", axis))
    script = write_model_script(plan_of(path, "exudyn"), "exudyn", seconds=30, since="Since version 1.9.0.")
    assert len(script.text.splitlines()) <= MAX_LINES
    head = " ".join(script.text.split('"""')[1].split())
    assert words in head and "Since version 1.9.0." in head
    ran = subprocess.run([python, "-W", "ignore", "-c", script.text], capture_output=True, text=True)
    printed_numbers(script, ran)


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
    for words in ((key, "no/such/key"), (key, "--form", "pinochio")):
        assert runner.invoke(main, ["reproduce", str(out), *words]).exit_code == 2
        assert not (out / "scripts").exists()
    wrong = runner.invoke(main, ["reproduce", str(out), key, "--form", "drake"])
    assert wrong.exit_code == 1
    assert "pinocchio differs; a script for drake cannot show that" in wrong.stderr
    options = json.loads((out / "model.json").read_text())["options"]
    (out / "model.json").write_text(json.dumps({"files": [], "options": {}}))
    damaged = runner.invoke(main, ["reproduce", str(out)])
    assert damaged.exit_code == 2 and "model.json: no results of `plumbline model`" in damaged.stderr
    (out / "model.json").write_text(json.dumps({"files": [], "options": options}))
    assert "nothing differs" in runner.invoke(main, ["reproduce", str(out)]).stderr


def test_rounding_beside_an_expected_zero_is_no_evidence():
    """The gravity of the file has no x; the gravity read leaves a rounded zero on a slide along x."""
    truth, read = (
        CertifiedModelQuantities(ModelQuantities({}, gravity_force=np.zeros(2)), {"gravity_force": limits})
        for limits in (np.zeros(2), np.array([4e-14, 1e-3]))
    )
    joints = tuple(ElementaryJoint(name, "slide", np.eye(3)[0], np.zeros(3)) for name in "ab")
    body = NeutralBody("m", -1, np.zeros(3), np.array([1.0, 0, 0, 0]), joints, 1.0, np.zeros(3), np.eye(3))
    reading = NeutralModel("", (body,), np.zeros(3))
    for force, ratio in ((0.0, 0.575), (2e-3, 2.0)):
        answer = ModelQuantities({}, gravity_force=np.array([2.3e-14, force]))
        found = mismatches_as_read(reading, truth, read, answer, [0, 1])["gravity_force"]
        assert found.ratio == pytest.approx(ratio)
    assert (found.place, found.value, found.expected, found.tolerance) == ((1,), 2e-3, 0.0, 1e-3)


def test_a_script_that_prints_another_number_is_not_handed_out(tmp_path, monkeypatch):
    path = tmp_path / "moon.xml"
    path.write_text(MJCF)
    monkeypatch.setattr(model_script, "EXPECTED", '"""\nprint(" 1.0 expected: 2.0")\nraise SystemExit\n"""')
    with pytest.raises(NoModelScript, match="does not show"):
        write_model_script(plan_of(path, "pinocchio"), "pinocchio", seconds=0)


def test_an_importer_that_agrees_has_no_script(tmp_path):
    path = tmp_path / "moon.xml"
    path.write_text(MJCF)
    with pytest.raises(NoModelScript, match="does not differ"):
        write_model_script(plan_of(path, "mujoco"), "mujoco", seconds=1)


def end_the_worker(*_):
    os._exit(1)


def test_a_file_that_is_gone_and_a_worker_that_is_lost_are_named(tmp_path, monkeypatch):
    path = tmp_path / "moon.xml"
    with pytest.raises(NoModelScript, match=r"moon\.xml.*No such file"):
        write_model_script(plan_of(path, "pinocchio"), "pinocchio", seconds=0)
    path.write_text(MJCF)
    monkeypatch.setattr(model_script, "evaluate_model_file", end_the_worker)
    with pytest.raises(NoModelScript, match="does not show"):
        write_model_script(plan_of(path, "pinocchio"), "pinocchio", seconds=0)


def test_shrinking_keeps_what_is_looked_for_and_drops_the_rest():
    tree = parse_xml(random_urdf(np.random.default_rng(2), 6).encode(), "robot")
    before = write_xml(tree)

    def shows(candidate):
        return any(e.attributes.get("name") == "link4" and e.find("inertial") for e in candidate.walk())

    small = shrink_tree(tree, shows, 20)
    assert write_xml(tree) == before
    assert sum(1 for _ in small.walk()) == 3
    assert write_xml(small).count("link") == 3
