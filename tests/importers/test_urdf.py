"""The reader of URDF: what each kind of joint means, judged by MuJoCo's and Pinocchio's own readings."""

import numpy as np
import pytest

from plumbline.engines.importer_calls import evaluate_model_file, read_model_file
from plumbline.importers.neutral_model import without_passive_forces
from plumbline.model_files.model_comparison import (
    certify_states,
    joint_permutation,
    mismatches,
    model_states,
    permuted,
    with_names_of,
)
from tests.helpers.importer_columns import prepared_file
from tests.helpers.random_robots import random_urdf


def prepared(tmp_path, text, base="auto"):
    return prepared_file(tmp_path, text, base=base)[1]


def ratios(found, importer, at=None):
    """Error over tolerance by quantity, in the order of the file's joints."""
    model = found.neutral_model(None)
    reading = read_model_file(importer, found.file).model
    order = joint_permutation(model, reading)
    assert order is not None, [(j.name, j.kind) for j in reading.joints]
    answers = evaluate_model_file(importer, found.file, model_states(reading, 3, 1, at))
    if importer == "pinocchio":
        model = without_passive_forces(model)
    truths = certify_states(model, model_states(model, 3, 1, at))
    return {n: m.ratio for n, m in mismatches(model, truths, [permuted(a, order) for a in answers]).items()}


@pytest.mark.parametrize("importer", ["mujoco", "pinocchio"])
@pytest.mark.parametrize("base", ["fixed", "free"])
@pytest.mark.parametrize("kinds", [(), ("revolute", "fixed"), ("prismatic", "continuous")])
def test_importers_that_read_a_file_alike_agree_with_the_own_reader(tmp_path, importer, base, kinds):
    text = random_urdf(np.random.default_rng(len(kinds)), 5, kinds)
    found = ratios(prepared(tmp_path, text, base), importer)
    assert len(found) >= 7
    assert max(found.values()) <= 1, found


EXTENSION = """<mujoco><option gravity="0 0 -1"><flag damper="disable" spring="disable"/></option>
<compiler balanceinertia="true" boundmass="5" boundinertia="7" settotalmass="9" fusestatic="false"/></mujoco>
"""


@pytest.mark.parametrize("base", ["fixed", "free"])
def test_mujocos_extension_of_a_urdf_is_listed_and_does_not_hold(tmp_path, base):
    text = random_urdf(np.random.default_rng(3), 3, ("revolute", "fixed"))
    found = prepared(tmp_path, text.replace("<link", f"{EXTENSION}<link", 1), base)
    assert ("mujoco", 2) in {(f.what, f.source.line) for f in found.urdf_model.not_compared}
    assert max(ratios(found, "mujoco").values()) <= 1


@pytest.mark.parametrize("importer", ["mujoco", "pinocchio"])
def test_a_floating_joint_of_the_root_is_a_free_joint(tmp_path, importer):
    text = random_urdf(np.random.default_rng(3), 3, ("revolute",)).replace("revolute", "floating", 1)
    model = prepared(tmp_path, text).urdf_model
    assert model.joints[0].kind == "free"
    found = ratios(prepared(tmp_path, text), importer)
    assert max(found.values()) <= 1, found


@pytest.mark.parametrize("importer", ["mujoco", "pinocchio"])
@pytest.mark.parametrize("at", [None, {}])
def test_a_floating_joint_of_a_link_that_is_fixed_to_the_root_is_a_free_joint(tmp_path, importer, at):
    text = random_urdf(np.random.default_rng(0), 3, ("revolute",))
    assert '<parent link="base"/><child link="link2"/>' in text
    assert '<parent link="link2"/><child link="link3"/>' in text
    for k, kind in ((2, "fixed"), (3, "floating")):
        text = text.replace(f'name="joint{k}" type="revolute"', f'name="joint{k}" type="{kind}"')
    model = prepared(tmp_path, text).urdf_model
    assert [(joint.kind, joint.damping) for joint in model.joints] == [("hinge", 0.635), ("free", 0.585)]
    found = ratios(prepared(tmp_path, text), importer, at)
    assert max(found.values()) <= 1, found


def test_planar_and_inner_floating_joints_are_elementary_ones(tmp_path):
    robots = (random_urdf(np.random.default_rng(seed), 3, ("revolute",)) for seed in range(50))
    inner = '<parent link="link1"/><child link="link2"/>'
    text = next(robot for robot in robots if inner in robot)
    first, second, third = (f'name="joint{k}" type="revolute"' for k in (1, 2, 3))
    text = text.replace(f"{second}>", f'{second.replace("revolute", "floating")}><dynamics damping="0.5"/>')
    text = text.replace(third, third.replace("revolute", "planar"))
    model = prepared(tmp_path, text).urdf_model
    assert first in text
    kinds = {body.name: [joint.kind for joint in body.joints] for body in model.bodies}
    assert sorted(map(tuple, kinds.values())) == sorted(
        [(), ("hinge",), ("slide", "slide", "slide", "ball"), ("slide", "slide", "hinge")]
    )
    planar = next(b for b in model.bodies if len(b.joints) == 3)
    x, y, angle = (joint.axis for joint in planar.joints)
    floating = next(b for b in model.bodies if len(b.joints) == 4)
    assert [joint.damping for joint in floating.joints] == [0.5] * 4
    np.testing.assert_allclose(np.cross(x, y), angle, atol=1e-15)


QUATERNION = """<robot name="r" version="1.1"><link name="a"/><link name="b"><inertial>
<origin xyz="0.1 0.02 0.3" quat_xyzw="0.1 -0.2 0.3 0.9"/><mass value="2"/>
<inertia ixx="1" ixy="0.1" ixz="0" iyy="1.2" iyz="0" izz="1.3"/></inertial></link>
<joint name="j" type="continuous"><origin xyz="0 1 0" quat_xyzw="2e30 0 0 2e30"/>
<parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint></robot>
"""


def test_origins_have_quaternions_from_version_1_1(tmp_path):
    found = prepared(tmp_path, QUATERNION)
    expected = np.sqrt([0.5, 0.5, 0, 0])  # by a few roundings
    np.testing.assert_allclose(found.urdf_model.bodies[1].attitude, expected, rtol=4 * np.finfo(float).eps)
    assert found.urdf_model.not_compared == ()
    text = QUATERNION.replace("2e30", "2")  # urdfdom squares the numbers
    assert max(ratios(prepared(tmp_path, text), "pinocchio").values()) <= 1


@pytest.mark.parametrize("version", ["1.0", "1", "1.1.1", None])
def test_quaternions_of_other_versions_are_not_read_and_listed(tmp_path, version):
    new = "" if version is None else f'version="{version}"'
    model = prepared(tmp_path, QUATERNION.replace('version="1.1"', new)).urdf_model
    assert {f.what for f in model.not_compared} == {"attribute quat_xyzw of <origin>"}
    np.testing.assert_array_equal(model.bodies[1].attitude, [1, 0, 0, 0])


def test_made_up_names_of_parts_are_no_names_of_the_file(tmp_path):
    text = random_urdf(np.random.default_rng(3), 5, ("revolute",))
    for k, (name, kind) in enumerate(
        [
            ("p", "planar"),
            ("p/x", "prismatic"),
            ("f", "floating"),
            ("f/rotation", "planar"),
            ("p.2", "planar"),
        ],
        start=1,
    ):
        text = text.replace(f'name="joint{k}" type="revolute"', f'name="{name}" type="{kind}"')
    found = prepared(tmp_path, text.replace("floating", "planar"))
    model, reading = found.urdf_model, read_model_file("mujoco", found.file).model
    names = [joint.name for joint in model.joints]
    assert {"p.3/x", "p.3/angle", "p/x", "f/x", "f/rotation/x", "p.2/y"} <= set(names)
    assert len(set(names)) == len(names) == 13
    assert joint_permutation(model, with_names_of(model, reading)) == list(range(13))
    names = [joint.name for joint in prepared(tmp_path, text).urdf_model.joints]
    assert "f.2/rotation" in names and len(set(names)) == len(names)


def test_decimals_are_rounded_once_and_axes_normalised(tmp_path):
    text = random_urdf(np.random.default_rng(5), 1, ("revolute",))
    start = text.index("<axis")
    text = text[:start] + '<axis xyz="1e200 0 1e200"/>' + text[text.index("/>", start) + 2 :]
    text = text.replace("<mass value=", '<mass value="0.1000000000000000055511151231257827" x=', 1)
    model = prepared(tmp_path, text).urdf_model
    assert model.bodies[0].mass == 0.1
    np.testing.assert_array_equal(model.joints[0].axis, np.array([1, 0, 1]) / np.sqrt(2))


MISSPELT = """<robot name="r"><link name="a" colour="red"/>
<link name="b"><inertial><mass value="1"/><mass value="2"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1" unit="g"/></inertial><inertail/></link>
<joint name="j" type="fixed"><parent link="a"/><child link="b"/><orgin xyz="1 0 0"/>
<origin xzy="1 0 0"/><limit effort="1"/></joint></robot>
"""


def test_attributes_and_elements_that_are_not_read_are_listed_with_their_lines(tmp_path):
    model = prepared(tmp_path, MISSPELT).urdf_model
    assert {(f.what, f.name, f.source.line) for f in model.not_compared} == {
        ("attribute colour of <link>", "a", 1), ("attribute unit of <inertia>", "b", 3), ("inertail", "b", 3),
        ("orgin", "j", 4), ("attribute xzy of <origin>", "j", 5),
    }  # fmt: skip
    what = "more than one <mass> in <inertial>: the first is read"
    assert (what, "b", 2) in {(f.what, f.name, f.source.line) for f in model.ambiguous}
    assert model.bodies[1].mass == 1
