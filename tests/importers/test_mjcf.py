"""MJCF files: sources through includes and default classes, names, copies, and what stripping keeps."""

import pytest

from plumbline.engines.importer_calls import read_model_file
from plumbline.importers.xml_tree import ModelFileError
from plumbline.model_files.prepared_file import package_folder, prepare_file

MAIN = """<mujoco model="m">
<compiler angle="degree"/>
<default>
<joint damping="0.5"/>
<default class="stiff">
<joint stiffness="7" armature="0.25"/>
</default>
</default>
<option><flag gravity="disable"/></option>
<include file="parts/arm.xml"/>
<actuator><motor name="drive" joint="elbow"/></actuator>
</mujoco>
"""
ARM = """<mujocoinclude><worldbody>
<body childclass="stiff">
<freejoint/>
<inertial pos="0 0 1" mass="2" diaginertia="1 1 1"/>
<body name="fore">
<joint name="elbow" ref="90"
  range="0 90"/>
<joint axis="1 0 0"/>
<geom type="box" size="1 1 1" mass="3"/>
</body></body></worldbody></mujocoinclude>
"""


@pytest.fixture
def model(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "robot.xml").write_text(MAIN)
    (tmp_path / "parts" / "arm.xml").write_text(ARM)
    prepared = prepare_file(str(tmp_path / "robot.xml"), tmp_path / "parts")
    return prepared.neutral_model(read_model_file("mujoco", prepared.file))


def test_unnamed_bodies_and_joints_are_named_by_their_line(model):
    assert [body.name for body in model.bodies] == ["body@2", "fore"]
    assert [joint.name for joint in model.joints] == ["body@2/free", "elbow", "joint@8"]


def test_numbers_have_sources_through_includes_and_default_classes(model):
    elbow = model.joints[1]
    places = {name: (source.file.split("/")[-1], source.line) for name, source in elbow.fields.items()}
    assert places == {
        "reference": ("arm.xml", 6), "damping": ("robot.xml", 4), "stiffness": ("robot.xml", 6),
        "armature": ("robot.xml", 6),
    }  # fmt: skip
    assert elbow.reference == pytest.approx(1.5707963267948966)
    assert (elbow.damping, elbow.stiffness, elbow.armature) == (0.5, 7.0, 0.25)
    first, fore = model.bodies
    assert (first.fields["mass"].line, fore.fields["mass"].line) == (4, 9)


def test_features_that_are_not_compared_are_listed_with_their_lines(model):
    found = {(f.what, f.name, f.source.line) for f in model.not_compared}
    assert found == {("actuator", "drive", 11), ("limit", "elbow", 6)}


def test_gravity_that_a_flag_switches_off_is_zero(model):
    assert not model.gravity.any()
    assert model.gravity_source.line == 9


def test_stripping_keeps_geometry_that_defines_the_mass(tmp_path):
    text = MAIN.replace('<include file="parts/arm.xml"/>', ARM.replace("mujocoinclude", "frame"))
    text = text.replace("<frame>", "").replace("</frame>", "")
    mesh = '<asset><mesh name="x" file="missing.stl"/></asset>'
    geom = '<geom type="mesh" mesh="x"/>'
    (tmp_path / "robot.xml").write_text(
        text.replace("<actuator>", f"{mesh}<actuator>").replace("<freejoint/>", f"<freejoint/>{geom}")
    )
    with pytest.raises(ModelFileError, match=r"there is no file 'missing\.stl'"):
        prepare_file(str(tmp_path / "robot.xml"), tmp_path)
    (tmp_path / "copy").mkdir()
    prepared = prepare_file(str(tmp_path / "robot.xml"), tmp_path / "copy", strip=True)
    found = prepared.neutral_model(read_model_file("mujoco", prepared.file))
    assert [body.mass for body in found.bodies] == [2.0, 3.0]


def test_the_base_of_an_mjcf_is_its_own(tmp_path):
    (tmp_path / "robot.xml").write_text(MAIN.replace('<include file="parts/arm.xml"/>', ""))
    with pytest.raises(ModelFileError, match="says itself whether its base moves"):
        prepare_file(str(tmp_path / "robot.xml"), tmp_path, base="free")


def test_the_root_is_the_nearest_package(tmp_path):
    folder = tmp_path / "package" / "urdf"
    folder.mkdir(parents=True)
    assert package_folder(folder / "robot.urdf") == folder.resolve()
    (tmp_path / "package" / "package.xml").write_text("<package/>")
    assert package_folder(folder / "robot.urdf") == folder.parent.resolve()
