"""MJCF files: sources through includes and default classes, names, copies, and what stripping keeps."""

from functools import partial

import mujoco
import pytest

from plumbline.importers.xml_tree import ModelFileError
from plumbline.judging.rows import Verdict
from plumbline.model_files.model_run import ModelPlan, run_model_files
from plumbline.model_files.prepared_file import package_folder, prepare_file
from tests.helpers.importer_columns import prepared_file, read_by_mujoco
from tests.helpers.refusals import refusal

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
    return read_by_mujoco(prepared)


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


LISTED = """<mujoco><worldbody>
<body name="b"><joint name="j"/><inertial pos="0 0 -1" mass="2" diaginertia="1 1 1"/></body></worldbody>
<contact><exclude body1="b" body2="world"/></contact>
<sensor><jointpos joint="j"/></sensor>
<keyframe><key qpos="1"/></keyframe>
</mujoco>
"""


@pytest.mark.parametrize("strip", [False, True])
def test_what_is_not_compared_is_listed_without_geometry_too(tmp_path, strip):
    _, prepared = prepared_file(tmp_path, LISTED, strip=strip)
    found = read_by_mujoco(prepared).not_compared
    assert [(f.what, f.source.line) for f in found] == [("contact", 3), ("sensor", 4), ("keyframe", 5)]


def test_gravity_that_a_flag_switches_off_is_zero(model):
    assert not model.gravity.any()
    assert model.gravity_source.line == 9


@pytest.mark.parametrize(
    ("options", "gravity", "line"),
    [
        ('<option gravity="0 0 -9.81"/>\n<option gravity="0 0 -2"/>', -2.0, 3),
        ('<option gravity="0 0 -2">\n<flag gravity="enable"/></option>', -2.0, 2),
        ('<option><flag gravity="disable"/></option>\n<option><flag gravity="enable"/></option>', -9.81, 0),
        ('<option><flag gravity="enable"/></option>\n<option><flag gravity="disable"/></option>', 0.0, 3),
        ('<option density="0"/>', -9.81, 0),
    ],
)
def test_gravity_has_the_place_of_the_option_that_holds(tmp_path, options, gravity, line):
    _, prepared = prepared_file(tmp_path, LISTED.replace("<mujoco>", f"<mujoco>\n{options}\n"))
    model = read_by_mujoco(prepared)
    assert model.gravity[2] == gravity and model.gravity_source.line == line


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
    found = read_by_mujoco(prepared)
    assert [body.mass for body in found.bodies] == [2.0, 3.0]


STRIPPED = """<mujoco model="m">
<asset><mesh file="own.stl"/><mesh name="other" file="missing.stl"/><hfield name="own" file="no.png"/></asset>
<worldbody>
<body name="b"><joint name="j"/><inertial pos="0 0 1" mass="2" diaginertia="1 1 1"/>
<frame pos="1 0 0"><geom type="mesh" mesh="other"/></frame><geom name="pulley" size="0.1"/>
<site name="end" pos="0 0 1"/></body>
<body name="c"><joint name="k"/><geom type="mesh" mesh="own"/></body>
<site name="start" pos="1 1 1"/>
</worldbody>
<tendon><spatial><site site="start"/><geom geom="pulley"/><site site="end"/></spatial></tendon>
<custom><tuple name="t"><element objtype="geom" objname="g" prm="0"/></tuple></custom>
</mujoco>
"""


def test_stripping_leaves_out_each_mesh_that_no_mass_needs(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(STRIPPED)
    (problem,) = refusal(partial(prepare_file, strip=True), str(path), tmp_path).problems
    assert problem.line == 2 and problem.column == 8
    assert "'own.stl'" in problem.message and "the mass of a body without <inertial>" in problem.hint
    path.write_text(STRIPPED.replace('type="mesh" mesh="own"', 'size="0.1" mass="3"'))
    (tmp_path / "copy").mkdir()
    prepared = prepare_file(str(path), tmp_path / "copy", strip=True)
    found = read_by_mujoco(prepared)  # the tendon has its pulley
    assert [body.mass for body in found.bodies] == [2.0, 3.0]


def test_a_scene_and_the_robot_that_it_includes_are_in_one_world(tmp_path):
    (tmp_path / "robot.xml").write_text(f"<mujoco>{STRIPPED.split('</asset>')[1]}".replace("other", "own"))
    scene = '<mujoco><include file="robot.xml"/>\n<worldbody><body name="floor"/></worldbody></mujoco>'
    (tmp_path / "scene.xml").write_text(scene)
    prepared = prepare_file(str(tmp_path / "scene.xml"), tmp_path, strip=False)
    (world,) = prepared.tree.find_all("worldbody")
    assert [body.attributes["name"] for body in world.find_all("body")] == ["b", "c", "floor"]
    assert prepared.tree.find("tendon") is not None


NOT_LINEAR = """<mujoco model="m">
<option><flag spring="disable"/></option>
<default><default class="d"><joint damping="1 2 3" stiffness="5 6"/></default></default>
<worldbody>
<body name="b"><joint class="d" name="j" axis="0 1 0" springyield="0.1" springref="0.5"/>
<inertial pos="0.1 0 0" mass="1" diaginertia="1 1 1"/></body>
<flexcomp name="f" type="grid" count="2 2 2" spacing=".1 .1 .1" pos="0 0 1" dim="3" mass="1">
<elasticity young="1e4" poisson=".2" damping=".01"/></flexcomp>
</worldbody>
<actuator><motor name="drive" joint="j" damping="7" armature="1"/></actuator></mujoco>
"""


@pytest.mark.parametrize("is_sprung", [False, True])
def test_forces_that_the_neutral_model_does_not_have_are_listed_and_not_compared(tmp_path, is_sprung):
    path = tmp_path / "robot.xml"
    path.write_text(NOT_LINEAR.replace('spring="disable"', "") if is_sprung else NOT_LINEAR)
    plan = ModelPlan((str(path),), importers=("mujoco",), state_count=2)
    (file,) = run_model_files(plan, lambda *_: None).files
    assert {row.verdict for row in file.rows} == {Verdict.AGREES}
    found = {(f.what, f.name, f.source.line) for f in file.model.not_compared}
    assert found == {
        ("damping that is not linear", "j", 3), ("stiffness that is not linear", "j", 3),
        ("yield of a spring", "j", 5), ("flex", "f", 7), ("actuator", "drive", 10),
    }  # fmt: skip
    joint = file.model.joints[0]
    assert (joint.damping, joint.stiffness) == (1.0, 5.0 if is_sprung else 0.0)


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


MESHES = """<mujoco>COMPILER<asset><mesh name="x" file="NAME"/></asset>
<worldbody><body name="b"><joint axis="0 1 0"/><geom type="mesh" mesh="x"/></body></worldbody></mujoco>
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def load_with_its_copy(folder, text):
    """Load a file that has the text in MuJoCo, and the copy of it in which all joints have names."""
    (folder / "robot.xml").write_text(text)
    mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    (folder / "copy").mkdir()
    mujoco.MjModel.from_xml_path(prepare_file(str(folder / "robot.xml"), folder / "copy").file.path)


@pytest.mark.parametrize(
    ("compiler", "name", "place"),
    [
        ('strippath="true" meshdir="m"', "foo/bar/x.obj", "m/x.obj"),
        ('strippath="true" meshdir="m"', "x.obj", "m/x.obj"),
        ('strippath="true"', "foo\\x.obj", "x.obj"),
        ('strippath="true"/><compiler strippath="false"', "foo/x.obj", "foo/x.obj"),
        ('meshdir="nowhere"/><compiler assetdir="m"', "x.obj", "m/x.obj"),
        ('meshdir="m" assetdir="nowhere"', "x.obj", "m/x.obj"),
    ],
)
def test_a_mesh_is_where_mujoco_looks(tmp_path, compiler, name, place):
    text = MESHES.replace("COMPILER", f"<compiler {compiler}/>").replace("NAME", name)
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / place).write_text(TETRAHEDRON)
    load_with_its_copy(tmp_path, text)


@pytest.mark.parametrize("place", ["sub/t/x.obj", "m/x.obj"])
def test_files_beside_an_included_file_are_found(tmp_path, monkeypatch, place):
    monkeypatch.chdir(tmp_path)
    for folder in ("sub/t", "m"):
        (tmp_path / folder).mkdir(parents=True)
    inner = MESHES.replace("COMPILER", "").replace("NAME", "x.obj").replace("mujoco>", "mujocoinclude>")
    (tmp_path / "sub" / "t" / "b.xml").write_text(inner)
    (tmp_path / "sub" / "a.xml").write_text('<mujocoinclude><include file="t/b.xml"/></mujocoinclude>')
    text = '<mujoco><compiler meshdir="m"/><include file="sub/a.xml"/></mujoco>'
    (tmp_path / place).write_text(TETRAHEDRON)
    load_with_its_copy(tmp_path, text)
    found = prepare_file("robot.xml", tmp_path / "copy").tree
    assert {element.source.file for element in found.walk() if element.tag == "mesh"} == {"sub/t/b.xml"}


def test_the_mesh_of_a_flex_is_in_the_folder_of_meshes(tmp_path):
    (tmp_path / "m").mkdir()
    (tmp_path / "m" / "x.obj").write_text(TETRAHEDRON)
    flex = '<flexcomp name="f" type="mesh" file="x.obj" dim="2" mass="1" rigid="true"/>'
    body = '<body name="b"><joint axis="0 1 0"/><geom size="0.1"/></body>'
    text = f'<mujoco><compiler meshdir="m"/><worldbody>{body}{flex}</worldbody></mujoco>'
    load_with_its_copy(tmp_path, text)


def test_stripping_leaves_no_name_of_a_texture_and_no_skin(tmp_path):
    text = """<mujoco><default><material texture="t"/>
<default class="c"><material><layer texture="t" role="rgb"/></material></default></default>
<asset><texture name="t" type="2d" file="no.png"/><material name="m"/><material name="n" class="c"/></asset>
<worldbody><body name="b"><joint name="j" axis="0 1 0"/><geom size=".1" pos="0 0 1" material="m"/>
<light texture="t" type="image" name="l"/></body></worldbody>
<deformable><skin file="missing.skn"/></deformable></mujoco>"""
    _, prepared = prepared_file(tmp_path, text, strip=True)
    assert [body.name for body in read_by_mujoco(prepared).bodies] == ["b"]


FLUID = """<mujoco>
<option density="1000" viscosity="0.1"/>
<option density="0" wind="1 0 0"/>
<worldbody>
<body name="held" mocap="true"><geom size=".1"/></body>
<body name="b"><joint name="j"/><inertial pos="0 0 -1" mass="2" diaginertia="1 1 1"/></body>
</worldbody></mujoco>
"""


def test_fluids_and_bodies_that_a_user_moves_are_listed(tmp_path):
    _, prepared = prepared_file(tmp_path, FLUID)
    found = read_by_mujoco(prepared).not_compared
    assert [(f.what, f.name, f.source.line) for f in found] == [("mocap body", "held", 5), ("fluid", "", 2)]
    _, prepared = prepared_file(tmp_path, FLUID.replace("0.1", "0"))
    assert [f.what for f in read_by_mujoco(prepared).not_compared] == ["mocap body"]
