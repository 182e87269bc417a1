"""A model file as a mechanism: the same accelerations as the file's, and what it leaves out in words."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plumbline.importers.lumping import lump_fixed_bodies
from plumbline.importers.neutral_model import ElementaryJoint, NeutralBody, NeutralModel
from plumbline.importers.xml_tree import ModelFileError
from plumbline.model.datatypes import State
from plumbline.model.kinematics import (
    complete_state,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
)
from plumbline.model.lift import lift_acceleration
from plumbline.model_files import mechanism_of_file
from plumbline.model_files.certified_model import certify_model
from plumbline.model_files.mechanism_of_file import (
    fastest_decay,
    load_model_file,
    mechanism_of_model,
)
from plumbline.model_files.model_comparison import model_states
from plumbline.scenario.loader import load_scenario, scenario_from_dict
from plumbline.truth.certified_state import certify_state
from tests.helpers.commands import invoke
from tests.helpers.importer_columns import prepared_file, read_by_mujoco
from tests.helpers.random_robots import random_mjcf, random_urdf
from tests.helpers.terminal_counts import agreed

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def without_free_damping(model):
    """Mechanisms have no dampers on free bodies: these are among what is left out."""
    bodies = [
        replace(b, joints=tuple(replace(j, damping=0.0) if j.kind == "free" else j for j in b.joints))
        for b in model.bodies
    ]
    return replace(model, bodies=tuple(bodies))


def reference_attitudes(model):
    found = []
    for body in model.bodies:
        above = IDENTITY if body.parent < 0 else found[body.parent]
        found.append(quaternion_product(above, body.attitude))
    return found


def accelerations(model, scenario, at):
    """(r̈, ω̇′) of the mechanism's bodies at a state of the file: by the mechanism, and by the file's v̇."""
    m, turns = scenario.model, reference_attitudes(model)
    p, omega, u, udot, r, v = np.tile(IDENTITY, (m.n, 1)), *np.zeros((5, m.n, 3))
    x, xdot = np.zeros((2, m.n, m.columns))
    vdot, given, k, filled = certify_model(model, at).quantities.acceleration, [], 0, 0
    places = iter(model.joint_slices())
    for body, a in zip(model.bodies, turns, strict=True):
        R = rotation_matrix(a)
        for _ in body.joints:
            joint, own, rates = next(places)
            coordinates, velocities, rate = at.coordinates[own], at.velocities[rates], vdot[rates]
            if joint.kind in ("hinge", "slide"):
                x[k, filled] = coordinates[0] - joint.reference
                xdot[k, filled] = velocities[0]
                given += rate.tolist()
                filled += 1
                k, filled = (k + 1, 0) if filled == len(m.kinds[k].motions) else (k, filled)
                continue
            now = complete_state(m, State(p, omega, u, udot, r, v, x, xdot))
            far, turn = int(m.body[k, 0]), coordinates[-4:]
            if joint.kind == "ball":
                relative = quaternion_product(quaternion_product(a, turn), quaternion_conjugate(a))
                p[k] = quaternion_product(now.p[far] if far >= 0 else IDENTITY, relative)
                above = rotation_matrix(now.p[far]) @ now.omega[far] if far >= 0 else np.zeros(3)
                omega[k] = rotation_matrix(p[k]).T @ above + R @ velocities
                given += (R @ rate).tolist()
            else:
                p[k] = quaternion_product(turn, quaternion_conjugate(a))
                omega[k] = R @ velocities[3:]
                arm = rotation_matrix(turn) @ body.center
                spin, spun = (rotation_matrix(turn) @ w for w in (velocities[3:], rate[3:]))
                r[k], v[k] = coordinates[:3] + arm, velocities[:3] + np.cross(spin, arm)
                centre = rate[:3] + np.cross(spun, arm) + np.cross(spin, np.cross(spin, arm))
                given += [*centre, *(R @ rate[3:])]
            k += 1
    state = complete_state(m, State(p, omega, u, udot, r, v, x, xdot))
    own = certify_state(m, state).quantities
    lifted = lift_acceleration(m, state, np.array(given), "relative, near axes", "the file")
    return (own.acceleration, own.angular_acceleration), lifted


@pytest.mark.parametrize("seed", range(8))
def test_random_robots_accelerate_as_their_mechanisms(tmp_path, seed, monkeypatch):
    monkeypatch.setattr(mechanism_of_file, "SHARE", 2.0**-30)  # parts between joints nearly without mass
    rng = np.random.default_rng(seed)
    path, prepared = prepared_file(tmp_path, (random_urdf, random_mjcf)[seed % 2](rng, 4))
    model = without_free_damping(lump_fixed_bodies(read_by_mujoco(prepared)))
    scenario = scenario_from_dict(mechanism_of_model(model, (), path), "robot")
    has_parts = scenario.model.n > len(model.bodies)
    for at in model_states(model, 2, seed):
        for own, lifted in zip(*accelerations(model, scenario, at), strict=True):
            # between bodies with and without mass digits are lost
            assert own == pytest.approx(
                lifted, rel=0, abs=(1e-6 if has_parts else 1e-11) * np.max(np.abs(lifted))
            )


def joint(name, kind, axis, anchor=(0.0, 0.0, 0.0), **more):
    return ElementaryJoint(name, kind, np.array(axis, float), np.array(anchor, float), **more)


def one_body(*joints, mass=2.0, inertia=(1.0, 1.5, 2.0)):
    turn, center = np.array([0.6, 0.0, 0.8, 0.0]), np.array([0.1, 0.2, -0.5])
    body = NeutralBody("b", -1, np.array([0.3, 0.0, 1.0]), turn, joints, mass, center, np.diag(inertia))
    return NeutralModel("m", (body,), np.array([0.0, 0.0, -9.81]))


@pytest.mark.parametrize(
    ("joints", "kinds"),
    [
        ([joint("a", "hinge", [1, 0, 0]), joint("b", "hinge", [0, 1, 0])], ["universal"]),
        ([joint("a", "hinge", [1, 0, 0]), joint("b", "hinge", [0, 1, 0], [0, 0, 0.1])], ["hinge", "hinge"]),
        ([joint("a", "hinge", [1, 0, 0]), joint("b", "hinge", [0.6, 0.8, 0])], ["hinge", "hinge"]),
        ([joint("a", "slide", [0, 0, 1]), joint("b", "hinge", [0, 0, 1], [0.2, 0, 0])], ["cylindrical"]),
        ([joint("a", "slide", [0, 0, 1]), joint("b", "hinge", [0, 0, -1])], ["slide", "hinge"]),
        ([joint("a", "ball", [0, 0, 0], [0, 0, 0.3])], ["ball"]),
    ],
)
def test_joints_of_one_body_are_one_joint_where_a_kind_has_their_motions(joints, kinds):
    elements = [replace(j, damping=0.3, stiffness=2.0, armature=0.1, reference=0.0) for j in joints]
    model = one_body(*elements)
    content = mechanism_of_model(model, (), "m.xml")
    scenario = scenario_from_dict(content, "m")
    assert list(scenario.model.kind) == kinds
    assert ("part between joints" in content["purpose"]) == (len(kinds) > 1)
    assert sum(scenario.model.mass) == model.bodies[0].mass
    if len(kinds) == 1:
        for at in model_states(model, 3, 1):
            for own, lifted in zip(*accelerations(model, scenario, at), strict=True):
                assert own == pytest.approx(lifted, rel=0, abs=1e-13 * np.max(np.abs(lifted)))


def test_what_a_mechanism_does_not_have_is_listed():
    model = one_body(joint("f", "free", [0, 0, 0], damping=1.0), inertia=(1.0, 1.0, 4.0))
    content = mechanism_of_model(model, (), "m.xml")
    assert "damping of a free joint" in content["purpose"]
    assert "inertia that no distribution of mass has" in content["purpose"]
    moments = np.linalg.eigvalsh(scenario_from_dict(content, "m").model.inertia[0])
    assert moments[0] + moments[1] >= moments[2] * (1 - 1e-12)


def test_a_moving_body_without_mass_is_a_bad_file_and_so_is_one_where_nothing_moves():
    hinge = joint("j", "hinge", [0, 1, 0])
    with pytest.raises(ModelFileError, match="body 'b' moves and has no mass"):
        mechanism_of_model(one_body(hinge, mass=0.0), (), "m.urdf")
    with pytest.raises(ModelFileError, match=r"nothing in it moves.*--base free"):
        mechanism_of_model(one_body(), (), "m.urdf")


ROBOT = """<robot name="arm">
<link name="base"><visual><geometry><mesh filename="package://lost/base.dae"/></geometry></visual></link>
<link name="upper"><inertial><origin xyz="0.1 0 -0.3"/><mass value="2.5"/>
<inertia ixx="0.04" ixy="0.001" ixz="-0.002" iyy="0.05" iyz="0.003" izz="0.03"/></inertial></link>
<link name="finger"><inertial><mass value="0.5"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="3" velocity="1"/><dynamics damping="0.1"/></joint>
<joint name="grip" type="prismatic"><origin xyz="0 0 -0.6"/><parent link="upper"/><child link="finger"/>
<axis xyz="1 0 0"/><mimic joint="shoulder" multiplier="0.1"/></joint>
</robot>
"""


def plumbline(*arguments):
    return invoke(*map(str, arguments))


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ROBOT)
    return path


def test_a_robot_runs_and_what_is_left_out_comes_first(robot, tmp_path):
    out = tmp_path / "out"
    robot.write_text(ROBOT.replace("</robot>", "<gazebo/></robot>"))
    found = plumbline("run", robot, "--level", "state", "--engine", "mujoco", "--jobs", 1, "--out", out)
    assert found.exit_code == 0, found.output
    assert agreed(found.stdout) >= 8
    first = found.stderr.splitlines()[0]
    assert "1 × limit (shoulder, line" in first
    assert "1 × mimic (grip, line" in first
    assert "1 × gazebo (line" in first  # an element outside of the links
    assert "contacts" in first


def test_a_robot_is_written_as_a_scenario_file_and_is_the_same_mechanism(robot, tmp_path):
    file = tmp_path / "arm.yaml"
    found = plumbline("model", robot, "--to-scenario", file)
    assert found.exit_code == 0, found.output
    assert "1 × mimic" in found.stdout
    written, (read_again, _) = load_scenario(file), load_model_file(robot)
    assert written.digest == read_again.digest
    assert plumbline("model", robot, robot, "--to-scenario", file).exit_code == 2


def test_the_base_of_a_robot_is_free_on_demand(robot):
    for base in ("auto", "fixed"):
        assert load_model_file(robot, base)[0].model.kind == ("hinge", "slide")
    with pytest.raises(ModelFileError, match="body 'base' moves and has no mass"):
        load_model_file(robot, "free")
    inertial = ROBOT[ROBOT.index("<inertial>") : ROBOT.index('</link>\n<link name="finger"')]
    robot.write_text(ROBOT.replace('<link name="base">', f'<link name="base">{inertial}'))
    assert load_model_file(robot, "free")[0].model.kind == ("free", "hinge", "slide")


def test_a_robot_whose_dampers_no_step_follows_is_compared_at_states(robot):
    assert load_model_file(robot)[0].level == "all"
    robot.write_text(ROBOT.replace('damping="0.1"', 'damping="50000"'))
    scenario, document = load_model_file(robot)
    assert scenario.level == document["level"] == "state"
    assert "its dampers stop motions within" in scenario.purpose
    M = np.array([[0.05 + 2.5 * 0.1**2 + 2.5 * 0.3**2 + 0.01 + 0.5 * 0.6**2, 0.5 * 0.6], [0.5 * 0.6, 0.5]])
    expected = 50000 * np.linalg.inv(M)[0, 0]  # the slide has no damper
    assert fastest_decay(scenario.model, scenario.state) == pytest.approx(expected, rel=1e-6)


CLOSED = """<mujoco><worldbody>
<body name="crank"><joint axis="0 1 0"/><inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/>
<body name="rod" pos="0 0 -2" euler="0 50 0"><joint axis="0 1 0"/>
<inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/>
<body name="tip" pos="0 0 -2"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></body></body>
</worldbody><equality><connect name="loop" body1="tip" anchor="0 0 -1"/>
<joint name="gear" joint1="j"/><connect name="off" active="false" body1="rod" anchor="0 0 0"/></equality>
</mujoco>"""


def test_a_loop_of_an_equality_is_closed_by_a_ball_and_the_other_equalities_are_listed(tmp_path):
    path = tmp_path / "closed.xml"
    path.write_text(CLOSED.replace('<joint axis="0 1 0"/>', '<joint name="j" axis="0 1 0"/>', 1))
    scenario, document = load_model_file(path)
    assert scenario.model.kind == ("hinge", "hinge", "ball")
    assert scenario.model.body[2].tolist() == [-1, 1]
    angle = np.radians(50)
    end = np.array([-3 * np.sin(angle), 0, -2 - 3 * np.cos(angle)])  # of the rod with its tip, in the world
    assert document["closes"][0]["anchor"] == pytest.approx(end, abs=1e-15)
    assert "2 × equality (gear, line 7" in scenario.purpose
    assert "1 of its equalities are rigid ball joints" in scenario.purpose
    out = tmp_path / "out"
    found = plumbline("run", path, "--level", "state", "--engine", "pinocchio", "--jobs", 1, "--out", out)
    assert found.exit_code == 0 and "agree" in found.stdout, found.output


@pytest.mark.parametrize(
    ("head", "attribute", "count"),
    [
        ('<default><equality active="false"/></default>', "", 0),
        ('<default><equality active="false"/></default>', 'active="true"', 1),
        ('<default><default class="off"><equality active="false"/></default></default>', "", 1),
        ('<default><default class="off"><equality active="false"/></default></default>', 'class="off"', 0),
        ('<option><flag equality="disable"/></option>', "", 0),
        ('<option><flag constraint="disable"/></option>', "", 0),
        ('<option><flag equality="disable"/></option><option><flag equality="enable"/></option>', "", 1),
    ],
)
def test_an_equality_that_is_not_active_closes_no_loop(tmp_path, head, attribute, count):
    path = tmp_path / "closed.xml"
    text = CLOSED.replace('<joint name="gear" joint1="j"/>', "").replace("<mujoco>", f"<mujoco>{head}")
    path.write_text(text.replace('name="loop"', f'name="loop" {attribute}'))
    scenario, document = load_model_file(path)
    assert len(document.get("closes", [])) == count
    assert f"{2 - count} × equality" in scenario.purpose


def test_sixty_bodies_are_a_mechanism(tmp_path):
    long = tmp_path / "long.urdf"
    long.write_text(random_urdf(np.random.default_rng(3), 60))
    assert load_model_file(long)[0].model.n == 60


def test_included_files_of_another_folder_need_the_root_that_holds_both(tmp_path):
    (tmp_path / "main").mkdir(), (tmp_path / "parts").mkdir()
    main, part = tmp_path / "main" / "m.xml", tmp_path / "parts" / "p.xml"
    main.write_text('<mujoco><worldbody><include file="../parts/p.xml"/></worldbody></mujoco>')
    body = '<body><joint/><inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/></body>'
    part.write_text(f"<mujocoinclude>{body}</mujocoinclude>")
    refused = plumbline("model", main, "--to-scenario", tmp_path / "m.yaml")
    assert refused.exit_code == 2 and "is outside" in refused.output and "--root" in refused.output
    assert plumbline("model", main, "--to-scenario", tmp_path / "m.yaml", "--root", tmp_path).exit_code == 0
    run = "run", main, "--level", "state", "--engine", "mujoco", "--jobs", 1, "--out", tmp_path / "out"
    assert plumbline(*run).exit_code == 2
    found = plumbline(*run, "--root", tmp_path)
    assert found.exit_code == 0 and agreed(found.output) >= 8, found.output


def test_a_bad_robot_is_bad_usage(tmp_path):
    for name, text, words in (
        ("lost.urdf", None, "no such file"),
        ("cut.urdf", ROBOT[:300], "not well-formed"),
        ("still.urdf", '<robot name="r"><link name="a"/></robot>', "nothing in it moves"),
        (
            "m.xml",
            "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>",
            "MuJoCo, which defines MJCF",
        ),
    ):
        path = tmp_path / name
        if text is not None:
            path.write_text(text)
        found = plumbline("run", path, "--level", "state")
        assert found.exit_code == 2, (name, found.output)
        assert words.lower() in found.output.lower()
        assert str(Path(path)) in found.output
