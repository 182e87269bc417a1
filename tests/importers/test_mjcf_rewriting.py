"""Equivalent rewritings of an MJCF file: MuJoCo compiles each to the same model; defects are reported."""

from pathlib import Path

import numpy as np
import pytest

from plumbline.engines.importer_calls import read_model_file
from plumbline.importers.mjcf import body_elements
from plumbline.importers.mjcf_rewriting import rewritings
from plumbline.importers.xml_tree import write_xml
from plumbline.judging.rows import RowContext
from plumbline.model_files.model_rows import rewriting_row
from plumbline.model_files.prepared_file import prepare_file
from tests.helpers.importer_columns import prepared_file, read_by_mujoco
from tests.helpers.random_robots import random_mjcf

ROBOT = """<mujoco model="m"><compiler angle="degree" eulerseq="zyX"/>
<default><joint damping="0.5" axis="0 1 0"/><geom density="700" size="0.05"/>
  <default class="stiff"><joint stiffness="7" armature="0.25" ref="20"/><geom euler="10 20 30"/>
    <default class="soft"><joint stiffness="2" type="slide"/></default></default></default>
<worldbody>
<frame pos="1 2 3" euler="30 40 50" childclass="stiff">
  <body name="one" pos="0.1 0 0" xyaxes="1 0.2 0 -0.2 1 0.3">
    <joint name="j1" springref="10" range="-90 90"/><joint name="j2" class="soft"/>
    <inertial pos="0.1 0.2 0.3" euler="5 15 25" mass="2" diaginertia="0.1 0.2 0.25"/>
    <body name="arm" pos="0 0 0.4" zaxis="1 1 3" childclass="soft">
      <joint name="j3"/><geom type="capsule" fromto="0 0 0 0.3 0.2 0.1"/>
      <geom type="cylinder" size="0.05 0.2" pos="0.1 0 0" axisangle="1 2 3 40"/>
      <geom type="box" size="0.1 0.2 0.3" mass="0.4" quat="1 2 3 4"/></body>
    <body name="hand" axisangle="1 1 0 35"><joint name="j4" type="ball" range="0 60"/>
      <inertial pos="0 0 0" mass="1" fullinertia="0.1 0.2 0.15 0.01 0.02 0.03"/></body>
  </body></frame>
<body name="two" euler="1 2 3"><freejoint name="free"/><geom type="ellipsoid" size="0.1 0.2 0.3"/>
  <geom type="sphere" pos="0 1 0"/></body>
</worldbody><actuator><motor joint="j1"/></actuator></mujoco>
"""
NAMES = [
    "defaults expanded", "frames around bodies", "frames flattened", "angles in the other unit",
    "inertias re-expressed", "geoms replaced by their inertials", "other names and order",
]  # fmt: skip
CONTEXT = RowContext("robot.xml", "model file", "mujoco", "MuJoCo", "4.0.0")


def judged(folder, text, defect=lambda tree: None):
    """Judge a compiler that is MuJoCo's with a defect: it compiles a changed file."""
    _, prepared = prepared_file(folder, text)

    def compiled(tree):
        defect(tree)
        (folder / "changed.xml").write_text(write_xml(tree))
        return read_model_file("mujoco", prepare_file(str(folder / "changed.xml"), folder).file)

    written = rewritings(prepared.tree)
    found = {name: compiled(tree) for name, tree in written.items()}
    return written, rewriting_row(CONTEXT, compiled(prepared.tree).model, found)


def test_mujoco_compiles_every_rewriting_to_the_same_model(tmp_path):
    written, row = judged(tmp_path, ROBOT)
    assert list(written) == NAMES
    assert row.verdict == "agrees", row.reason
    assert "refuses" not in row.reason


def test_rewritings_differ_from_the_file_in_what_they_name(tmp_path):
    written, _ = judged(tmp_path, ROBOT)
    text = {name: write_xml(tree) for name, tree in written.items()}
    assert "damping" not in text["defaults expanded"].partition("<worldbody>")[0]
    assert text["frames around bodies"].count("<frame") == 4
    assert "<frame" not in text["frames flattened"]
    assert 'angle="radian"' in text["angles in the other unit"]
    assert text["inertias re-expressed"].count("fullinertia") == 1
    assert "<geom" not in text["geoms replaced by their inertials"].partition("<worldbody>")[2]
    assert all("<motor" not in one for one in text.values())


def drop(attribute, *tags):
    def defect(tree):
        for element in tree.walk():
            if element.tag in tags:
                element.attributes.pop(attribute, None)

    return defect


def degrees_only(tree):
    for compiler in tree.find_all("compiler"):
        if compiler.attributes.get("angle") == "radian":
            del compiler.attributes["angle"]


def diagonal_only(tree):
    for element in tree.walk():
        if "fullinertia" in element.attributes:
            words = element.attributes["fullinertia"].split()
            element.attributes["fullinertia"] = " ".join([*words[:3], "0 0 0"])


def capsules_as_cylinders(tree):
    for element in tree.walk():
        if element.tag == "geom" and element.attributes.get("type") == "capsule":
            element.attributes["type"] = "cylinder"


def first_body_heavier(tree):
    body = next(element for element in tree.walk() if element.tag == "body")
    for inertial in body.find_all("inertial"):
        inertial.attributes["mass"] = "3"


@pytest.mark.parametrize(
    ("defect", "names"),
    [
        (drop("childclass", "body", "frame"), {"defaults expanded"}),
        (drop("pos", "frame"), {"frames around bodies", "frames flattened"}),
        (drop("euler", "frame"), {"frames around bodies", "frames flattened"}),
        (degrees_only, {"angles in the other unit"}),
        (diagonal_only, {"inertias re-expressed"}),
        (capsules_as_cylinders, {"geoms replaced by their inertials"}),
        (first_body_heavier, {"other names and order"}),
        (drop("eulerseq", "compiler"), {"frames flattened"}),
        (drop("zaxis", "body"), {"frames around bodies"}),
    ],
)
def test_a_simulated_defect_of_the_compiler_is_reported_with_the_rewriting(tmp_path, defect, names):
    written, row = judged(tmp_path, ROBOT, defect)
    assert row.verdict == "disagrees"
    assert names <= {name for name in written if f"with {name}, " in row.reason}, row.reason
    assert ", as written " in row.reason


def refuse_frames(tree):
    """A file that MuJoCo refuses where bodies have frames around them."""
    for element in tree.walk():
        if element.tag == "frame" and not element.attributes.get("childclass"):
            element.attributes["pos"] = "0"


def test_a_rewriting_that_is_refused_hides_behind_no_other(tmp_path):
    _, row = judged(tmp_path, ROBOT, refuse_frames)
    assert row.verdict == "information"
    assert "the same model of 6 equivalent rewritings" in row.reason
    assert "it refuses the file with frames around bodies: " in row.reason


@pytest.mark.parametrize("seed", range(6))
def test_random_robots_compile_alike(tmp_path, seed):
    _, row = judged(tmp_path, random_mjcf(np.random.default_rng(seed), 6))
    assert row.verdict == "agrees", row.reason


def test_files_with_what_is_not_covered_have_no_rewriting(tmp_path):
    text = ROBOT.replace("</worldbody>", '<replicate count="2"><body/></replicate></worldbody>')
    path = tmp_path / "robot.xml"
    path.write_text(text)
    assert rewritings(prepare_file(str(path), tmp_path).tree) == {}


TWO_DEFAULTS = """<mujoco>
<default><default class="a"><joint damping="1"/></default></default>
<default class="main"><joint armature="5"/><default class="b"><joint damping="2"/></default></default>
<worldbody><body name="b"><joint name="j" class="a" axis="0 1 0"/><joint name="k"/><joint name="l" class="b"/>
<inertial pos="0 0 -1" mass="2" diaginertia="1 1 1"/></body></worldbody></mujoco>
"""


def test_a_class_inherits_from_the_defaults_before_it(tmp_path):
    _, row = judged(tmp_path, TWO_DEFAULTS)
    assert row.verdict == "agrees", row.reason
    joints = read_by_mujoco(prepared_file(tmp_path, TWO_DEFAULTS)[1]).joints
    assert [joint.armature for joint in joints] == [0.0, 5.0, 5.0]
    assert [joint.fields["armature"].line for joint in joints if "armature" in joint.fields] == [3, 3]


@pytest.mark.parametrize(
    "default",
    [
        '<geom type="capsule" size=".1 .3" euler="0 90 0" pos="0.2 0 0"/>',
        '<default class="v"><geom type="capsule" size=".1 .2" quat="0.7 0 0.7 0"/></default>',
        '<geom type="capsule" fromto="0 0 0 0 0.2 1" size=".1"/>',
    ],
)
def test_frames_are_flattened_around_geoms_that_inherit_a_pose(tmp_path, default):
    name = 'childclass="v"' if "class" in default else ""
    text = f"""<mujoco><default>{default}</default><worldbody><body name="b"><joint name="j" axis="0 1 0"/>
<frame pos="1 0 1" euler="0 10 20" {name}><geom/></frame></body></worldbody></mujoco>"""
    written, row = judged(tmp_path, text)
    assert "frames flattened" in written
    assert row.verdict == "agrees" and "refuses" not in row.reason, row.reason


def test_joints_in_frames_keep_their_order(tmp_path):
    text = """<mujoco><worldbody><body name="b"><frame euler="0 0 30"><joint name="j1" axis="0 1 0"/></frame>
<frame pos="0 0 1"><body name="c"><joint name="k"/><geom size="0.1"/></body></frame>
<frame euler="0 0 60"><joint name="j2" axis="1 0 0"/></frame><body name="d"/>
<inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
    written, row = judged(tmp_path, text)
    assert row.verdict == "agrees", row.reason
    body = next(body_elements(written["other names and order"]))
    assert [child.tag for child in body.children] == ["frame", "body", "frame", "frame", "inertial"]


ALIGNED = """<mujoco><compiler alignfree="true"/>
<default><default class="f"><joint type="free"/></default></default>
<worldbody>
<body name="a"><freejoint/><inertial pos="0.1 0 0" mass="2" diaginertia="1 2.5 2"/></body>
<body name="b"><joint class="f"/><geom pos="0 0 1" size=".3 .2 .1" type="box"/></body>
</worldbody></mujoco>
"""


def test_inertias_that_a_body_frame_is_aligned_with_are_not_written_otherwise(tmp_path):
    inertias = {"inertias re-expressed", "geoms replaced by their inertials"}
    written, row = judged(tmp_path, ALIGNED)
    assert row.verdict == "agrees" and not inertias & written.keys(), row.reason
    written, row = judged(tmp_path, ALIGNED.replace("<freejoint/>", '<freejoint align="false"/>'))
    assert row.verdict == "agrees" and inertias & written.keys() == {"inertias re-expressed"}, row.reason
    text = ALIGNED.replace('<compiler alignfree="true"/>', "").replace(
        "<freejoint/>", '<freejoint align="true"/>'
    )
    written, row = judged(tmp_path, text)
    assert row.verdict == "agrees" and inertias & written.keys() == {"geoms replaced by their inertials"}


@pytest.mark.parametrize("name", ["0.xml", "1.xml", "6.xml", "rewritings"])
def test_rewritings_are_written_beside_a_copy_of_any_name(tmp_path, name):
    path, scratch = tmp_path / name, tmp_path / "scratch"
    path.write_text(ROBOT.replace('<freejoint name="free"/>', "<freejoint/>"))
    scratch.mkdir()
    prepared = prepare_file(str(path), scratch)
    copied = Path(prepared.file.path).read_text()
    written = [file.path for file in prepared.write_rewritings(scratch).values()]
    assert len({prepared.file.path, *written}) == 1 + len(NAMES)
    assert Path(prepared.file.path).read_text() == copied
