"""The command `model`: table, causes, exit codes, JSON, report, JUnit, SARIF, known issues."""

import json
import xml.etree.ElementTree as ET
from functools import partial

import pytest

from plumbline.model_files.model_rows import REFUSED
from plumbline.model_files.model_run import ModelPlan, run_model_files
from tests.helpers.commands import invoke

run = partial(invoke, "model", "--jobs", 1)
ROBOT = """<robot name="arm">
<link name="base"><inertial><mass value="3"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
</link><link name="tip"/>
<link name="upper"><inertial><origin xyz="0.1 0.02 0.3" rpy="0.3 -0.2 0.5"/><mass value="2.5"/>
<inertia ixx="0.04" ixy="0.001" ixz="-0.002" iyy="0.05" iyz="0.003" izz="0.03"/></inertial></link>
<joint name="j1" type="revolute"><origin xyz="0 0 0.1"/><parent link="base"/><child link="upper"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="3" velocity="1"/></joint>
<joint name="f" type="fixed"><parent link="upper"/><child link="tip"/></joint>
</robot>
"""
# Pinocchio 4.1 keeps its own gravity, which the file changes
MJCF = """<mujoco model="m"><option gravity="0 0 -1.62"/>
<worldbody><body><joint axis="0 1 0"/>
<inertial pos="0 0 -1" mass="2" diaginertia="1 1 1"/></body></worldbody></mujoco>
"""


def test_importers_that_agree_exit_with_0_and_a_table(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ROBOT)
    result = run(path, "--engine", "mujoco", "--engine", "pinocchio", "--states", 3, code=0)
    assert "3 bodies, 1 degree of freedom" in result.stdout
    assert "✗" not in result.stdout
    assert "not compared: 1 × limit" in result.stdout
    assert "left open: 1 × link without <inertial>" in result.stdout
    assert "✓ agrees  i information" in result.stdout


@pytest.fixture(scope="module")
def differing(tmp_path_factory):
    folder = tmp_path_factory.mktemp("differing")
    path = folder / "moon.xml"
    path.write_text(MJCF)
    result = invoke(
        "model", "--jobs", 1, path, "--engine", "pinocchio", "--states", 3, "--out", folder / "out", "--json"
    )
    return folder, json.loads(result.stdout), result


def test_a_difference_is_named_with_both_values_and_the_line(differing):
    _, document, result = differing
    assert result.exit_code == 1
    (file,) = document["files"]
    (cause,) = file["causes"]
    assert cause["field"] == "gravity"
    assert cause["source"]["line"] == 1
    assert cause["bodies"] == [""]
    assert "reads the gravity of the model as (0, 0, -9.81); the file says (0, 0, -1.62)" in cause["sentence"]
    bad = {row["quantity"] for row in file["rows"] if row["verdict"] == "disagrees"}
    assert bad == {"gravity_force", "bias_force", "acceleration", "potential_energy"}


def test_the_folder_holds_report_junit_and_sarif(differing):
    folder, document, _ = differing
    out = folder / "out"
    assert json.loads((out / "model.json").read_text()) == document
    page = (out / "model.html").read_text()
    assert "reads the gravity of the model" in page
    assert "<script" not in page
    suites = ET.parse(out / "junit.xml").getroot()
    assert suites.find("testsuite").get("failures") == "4"
    (run_,) = json.loads((out / "model.sarif").read_text())["runs"]
    (finding,) = run_["results"]
    assert finding["ruleId"] == "importer/gravity"
    place = finding["locations"][0]["physicalLocation"]
    assert place["artifactLocation"]["uri"].endswith("moon.xml")
    assert place["region"]["startLine"] == 1


def test_a_known_difference_exits_with_0_until_it_is_stale(differing, tmp_path):
    folder, _, _ = differing
    known = tmp_path / "known.yaml"
    known.write_text(
        "- {id: gravity, scenario: '*', engine: pinocchio, level: model, verdict: disagrees,\n"
        "   mechanism: equations, max_ratio: 1e15,\n"
        "   quantity: [gravity_force, bias_force, acceleration, potential_energy],\n"
        "   evidence: this test, reason: gravity of the file is not read}\n"
    )
    arguments = folder / "moon.xml", "--engine", "pinocchio", "--states", 2, "--known", known
    assert run(*arguments).exit_code == 0
    path = tmp_path / "earth.xml"
    path.write_text(MJCF.replace("-1.62", "-9.81"))
    assert run(path, *arguments[1:]).exit_code == 0  # patterns for any file are not stale in one


def test_a_bad_file_exits_with_2_and_does_not_stop_the_others(tmp_path):
    (tmp_path / "good.urdf").write_text(ROBOT)
    (tmp_path / "bad.urdf").write_text(ROBOT.replace('mass value="2.5"', 'mass value="-2.5"'))
    result = run(
        tmp_path / "bad.urdf", tmp_path / "good.urdf", tmp_path / "none.urdf", "--engine", "mujoco",
        "--states", 2, code=2,
    )  # fmt: skip
    assert "bad.urdf:5:77: <mass> value: is -2.5 kg" in result.stderr
    assert "none.urdf: cannot be read: No such file or directory" in result.stderr
    assert "good.urdf: 3 bodies" in result.stdout.replace("[bold]", "")


def test_mujocos_refusal_of_an_mjcf_is_a_bad_file_with_its_line(tmp_path):
    path = tmp_path / "m.xml"
    path.write_text(MJCF.replace('axis="0 1 0"', 'axis="0 1"'))
    result = run(path, "--engine", "mujoco", code=2)
    assert f"{path}:2:18: MuJoCo, which defines MJCF, refuses it" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--engine", "mujco"], "did you mean 'mujoco'?"),
        (["--at", "j1"], "is no JOINT=NUMBER"),
        (["--at", "j1=nan"], "not a finite number"),
        (["--at", "j2=1"], "no hinge or slide 'j2', which --at names; did you mean 'j1'?"),
        (["--states", "0"], "not in the range"),
        (["--root", "nowhere"], "does not exist"),
    ],
)
def test_bad_options_exit_with_2(tmp_path, arguments, message):
    path = tmp_path / "arm.urdf"
    path.write_text(ROBOT)
    result = run(path, *arguments, code=2)
    assert message in " ".join(result.stderr.replace("│", "").split())


LINK = '<link name="NAME"><inertial><mass value="1.5"/><inertia ixx="0.1" ixy="0.02" ixz="0" iyy="0.2" '
LINK += 'iyz="0" izz="0.15"/></inertial></link>'
BOX = "<geometry><box size='0.1 0.1 0.1'/></geometry>"
ASSUMED = f"""<robot name="r"><link name="base"/><link name="a"/>
<link name="b"><visual>{BOX}</visual><collision>{BOX}</collision></link>{LINK.replace("NAME", "d")}
<joint name="j" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint>
<joint name="f" type="fixed"><parent link="a"/><child link="b"/></joint>
<joint name="g" type="fixed"><parent link="b"/><child link="d"/><origin xyz="0 0.2 0.1"/></joint></robot>"""
PLANAR = f"""<robot name="r"><link name="base"/>{LINK.replace("NAME", "a")}
<joint name="p" type="planar"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint></robot>"""
FRAME = """<mujoco model="m"><worldbody><body name="trunk"><joint name="j0" axis="0 0 1"/>
<inertial pos="0 0 0" mass="5" diaginertia="1 1 1"/>
<frame pos="0.2 0 0"><body name="thigh"><joint name="j1"/><inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/>
<body name="shin"><joint name="j2"/><inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/></body></body></frame>
</body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("name", "text", "importer", "phrases"),
    [
        ("assumed.urdf", ASSUMED, "mujoco", ["gives 1 kg in all to bodies without <inertial>: a, b "]),
        ("assumed.urdf", ASSUMED, "pinocchio", []),
        ("planar.urdf", PLANAR, "mujoco", []),
        ("frame.xml", FRAME, "pinocchio", ["leaves out 2 bodies with their joints and masses: thigh "]),
        ("frame.xml", FRAME, "mujoco", []),
    ],
)
def test_features_that_robots_use_are_described_in_their_own_words(tmp_path, name, text, importer, phrases):
    path = tmp_path / name
    path.write_text(text)
    result = run_model_files(ModelPlan((str(path),), (importer,), True, state_count=2), lambda *_: None)
    (file,) = result.files
    explanation = file.explanations.get(importer)
    found = [cause.phrase for cause in explanation.causes] if explanation else []
    assert len(found) == len(phrases), found
    assert all(one.startswith(wanted) for one, wanted in zip(found, phrases, strict=True)), found
    assert result.exit_code == bool(phrases)


@pytest.mark.parametrize("is_named", [False, True])
def test_a_refusal_is_an_answer_and_a_gap_only_where_the_importer_was_named(tmp_path, is_named):
    path = tmp_path / "massless.urdf"
    path.write_text(ROBOT.replace('<joint name="f" type="fixed">', '<joint name="f" type="continuous">'))
    plan = ModelPlan((str(path),), ("mujoco", "pinocchio"), is_named, state_count=2)
    result = run_model_files(plan, lambda *_: None)
    refused = [row for row in result.rows if row.reason.startswith(REFUSED)]
    assert [(row.engine, row.verdict) for row in refused] == [
        ("mujoco", "unsupported" if is_named else "information")
    ]
    assert "mjMINVAL" in refused[0].reason
    assert result.exit_code == is_named
    others = {row.verdict for row in result.rows if row.engine == "pinocchio"}
    assert others == {"agrees", "information"}


def test_an_importer_of_another_format_says_so(tmp_path, monkeypatch):
    for module in ("model_run", "model_rows"):
        monkeypatch.setattr(
            f"plumbline.model_files.{module}.declared_importer_attribute", lambda *_: ["mjcf"]
        )
    path = tmp_path / "arm.urdf"
    path.write_text(ROBOT)
    assert "pinocchio: Pinocchio reads MJCF files only" in run(path, "--engine", "pinocchio", code=1).stdout


def test_a_scenario_file_never_replaces_its_model_file(tmp_path):
    path, link = tmp_path / "arm.urdf", tmp_path / "link.urdf"
    path.write_text(ROBOT)
    link.symlink_to(path)
    for to in (path, link):
        result = run(path, "--to-scenario", to, code=2)
        assert "would overwrite the model file" in result.stderr and path.read_text() == ROBOT


def test_one_state_can_be_given(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ROBOT)
    result = invoke(
        "model", "--jobs", 1, path, "--engine", "mujoco", "--at", "j1=0.3", "--base", "free", "--json", code=0
    )
    (file,) = json.loads(result.stdout)["files"]
    assert file["degrees_of_freedom"] == 7
    assert {row["verdict"] for row in file["rows"]} <= {"agrees", "information"}
    (energy,) = (row for row in file["rows"] if row["quantity"] == "potential_energy")
    assert energy["verdict"] == "information" and "differences between states" in energy["reason"]


def test_a_scenario_file_is_sent_to_run(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text("schema_version: 1\n")
    result = run(path, code=2)
    assert (
        f"{path}:1:1: is not well-formed XML: syntax error; scenario files are for: plumbline run {path}"
        in (result.stderr)
    )
