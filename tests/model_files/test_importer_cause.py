"""Causes of importers' differences: planted defects of many kinds are reported and named; nothing else is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plumbline.engines.importer_calls import describe_importer, evaluate_model_file, read_model_file
from plumbline.importers.importer import ModelFile
from plumbline.importers.xml_tree import parse_xml, write_xml
from plumbline.judging.rows import Verdict
from plumbline.model_files.model_comparison import model_states
from plumbline.model_files.model_rows import Answer, state_seed
from plumbline.model_files.model_run import ModelPlan, run_model_files
from tests.helpers.importer_columns import MUJOCO, judge_file, prepared_file, read_by_mujoco
from tests.helpers.nightly_tests import some_fast
from tests.helpers.planted_files import MJCF_DEFECTS, URDF_DEFECTS
from tests.helpers.random_robots import random_mjcf, random_urdf

STATES = 4
ROBOTS = 10


def answer_of(importer, file, path):
    """What an importer makes of a file at the states of the file at the path; None where it refuses it."""
    reading = read_model_file(importer, file)
    if reading.model is None:
        return None
    states = model_states(reading.model, STATES, state_seed(path))
    return Answer(reading, states, tuple(evaluate_model_file(importer, file, states)))


def judged(tmp_path, text, mutated, moved=""):
    """Judge MuJoCo, which reads the mutated text, about the file that has the text; a body 1e-17 m off."""
    path, prepared = prepared_file(tmp_path, text)
    other = Path(path).with_stem("other")
    other.write_text(mutated)
    model = read_by_mujoco(prepared)
    answer = answer_of("mujoco", ModelFile(str(other), prepared.file.format), path)
    if answer is None:
        return None
    for one in answer.quantities if moved else ():
        one.poses[moved][0, 3] += 1e-17
    return judge_file(path, model, ("mujoco", MUJOCO, answer), STATES)


def causes_of(result):
    """The causes of the only column that differs."""
    (explanation,) = result.explanations.values()
    return explanation.causes


def planted(tmp_path, name, seed):
    """The result of one planted defect and how it must be named; None where the robot has no such thing."""
    is_urdf = name in URDF_DEFECTS
    rng = np.random.default_rng([seed, len(name), *name.encode()])
    make = random_urdf if is_urdf else random_mjcf
    for _ in range(20):
        text = make(rng, int(rng.integers(3, 6)))
        tree = parse_xml(text.encode(), "robot")
        expected = (URDF_DEFECTS if is_urdf else MJCF_DEFECTS)[name](tree, rng)
        if expected is not None:
            result = judged(tmp_path, text, write_xml(tree))
            if result is not None:
                return result, expected
    raise AssertionError(f"no robot for {name}")


def is_named(result, expected):
    causes = [c for explanation in result.explanations.values() for c in explanation.causes]
    found = {(c.field, change.joint or change.body) for c in causes for change in c.changes}
    return found == {tuple(expected)}


@pytest.mark.parametrize("name", some_fast([*URDF_DEFECTS, *MJCF_DEFECTS], 3))
def test_a_planted_defect_is_reported_and_named(tmp_path, name):
    result, expected = planted(tmp_path, name, 0)
    assert any(row.verdict == Verdict.DISAGREES for row in result.rows), name
    sentences = {e.sentence for e in result.explanations.values()}
    assert is_named(result, expected), (expected, sentences)


@pytest.mark.full
@pytest.mark.timeout(3000)
def test_planted_defects_on_many_robots(tmp_path):
    names = [*URDF_DEFECTS, *MJCF_DEFECTS]
    reported, named, missed = 0, 0, []
    for name in names:
        for seed in range(1, 1 + ROBOTS):
            result, expected = planted(tmp_path, name, seed)
            is_reported = any(row.verdict == Verdict.DISAGREES for row in result.rows)
            reported += is_reported
            named += is_named(result, expected)
            if not is_named(result, expected):
                missed.append((name, seed, expected, [e.sentence for e in result.explanations.values()]))
    total = len(names) * ROBOTS
    print(f"{total} planted, {reported} reported, {named} named right", *missed, sep="\n")
    assert reported >= 0.99 * total
    assert named >= 0.95 * total


def test_an_undisturbed_importer_is_silent(tmp_path):
    rng = np.random.default_rng(5)
    for make in (random_urdf, random_mjcf):
        text = make(rng, 6)
        result = judged(tmp_path, text, text)
        assert {row.verdict for row in result.rows} == {Verdict.AGREES}
        assert not result.explanations


MASSLESS = """<robot name="arm"><link name="base"/>
<link name="upper"><inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>
</inertial></link>
<link name="tip"><inertial><mass value="0"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
<joint name="j" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
<joint name="f" type="fixed"><parent link="upper"/><child link="tip"/></joint></robot>
"""


DISK = """<mujoco><worldbody><body name="disk"><joint name="j" axis="0 0 1"/>
<inertial pos="0 0 0" mass="1" diaginertia="{}"/></body>
<body name="post" pos="{}"><geom size="0.1"/></body></worldbody></mujoco>
"""


def test_a_difference_of_a_few_roundings_is_named(tmp_path):
    """Below what counts as a difference of descriptions, and above the rounding of the mass matrix."""
    text, other = (DISK.format(f"1 1 {moment!r}", "0 0 1") for moment in (1.5, 1.5 * (1 + 2e-12)))
    result = judged(tmp_path, text, other)
    (cause,) = causes_of(result)
    assert (cause.field, cause.changes[0].body) == ("inertia", "disk")


def test_no_part_gets_a_negative_mass(tmp_path):
    """Without a part of 0.1 kg the lumped body is lighter: not by −0.1 kg of the massless link beside it."""
    frame = """<link name="frame"/><joint name="g" type="fixed"><parent link="upper"/><child link="frame"/>
    </joint><link name="tip">"""
    light = MASSLESS.replace('"0.1"', '"0"').replace('<link name="tip">', frame)
    light = light.replace('type="fixed">', 'type="fixed"><origin xyz="0 0 0.5"/>')
    text = light.replace('<mass value="0"/>', '<mass value="0.1"/>')
    result = judged(tmp_path, text, light)
    (cause,) = causes_of(result)
    assert "leaves out the mass and inertia of tip (0.1 kg" in cause.sentence


def test_damping_that_is_held_and_not_applied_is_judged_as_it_is_read(tmp_path):
    text = MASSLESS.replace('value="0"', 'value="1"').replace(
        '<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><dynamics damping="0.3"/>'
    )
    path, prepared = prepared_file(tmp_path, text)
    column = ("pinocchio", describe_importer("pinocchio"), answer_of("pinocchio", prepared.file, path))
    model = prepared.neutral_model(None)
    for damping, verdict in ((0.3, Verdict.AGREES), (0.4, Verdict.DISAGREES)):
        joint = replace(model.joints[0], damping=damping)
        bodies = tuple(replace(b, joints=(joint,)) if b.joints else b for b in model.bodies)
        result = judge_file(path, replace(model, bodies=bodies), column, STATES)
        verdicts = {row.quantity: row.verdict for row in result.rows}
        assert verdicts["damping"] == verdict
        assert verdicts["acceleration"] == Verdict.AGREES


ARMATURE = """<mujoco><worldbody><body name="a"><joint name="j" axis="0 1 0" armature="0.5"/>
<inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/>
<body name="b" pos="0 0 -1"><joint name="k" axis="0 -1 0" armature="0.5"/>
<inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/></body></body></worldbody></mujoco>
"""


def pinocchio_judged(tmp_path, text):
    """What Pinocchio makes of a file, judged by what MuJoCo reads in it."""
    path, prepared = prepared_file(tmp_path, text)
    model = read_by_mujoco(prepared)
    answer = answer_of("pinocchio", prepared.file, path)
    return judge_file(path, model, ("pinocchio", describe_importer("pinocchio"), answer), STATES)


def test_pinocchio_leaves_some_armatures_out_of_its_kinetic_energy(tmp_path):
    """A difference of Pinocchio 4.1.0 itself: of joints whose axis is no positive coordinate axis."""
    result = pinocchio_judged(tmp_path, ARMATURE)
    assert {row.quantity for row in result.rows if row.verdict == Verdict.DISAGREES} == {"kinetic_energy"}
    (cause,) = causes_of(result)
    assert "leaves the armature of joint k out of its kinetic energy" in cause.sentence
    assert "(line 3); this alone explains every quantity" in cause.sentence


ONE = '<mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
BEFORE_TIP, AFTER_TIP = (
    MASSLESS[: MASSLESS.index('<link name="tip">')],
    MASSLESS[MASSLESS.index('<joint name="j"') :],
)
DEFAULT_INERTIAL = [
    BEFORE_TIP + tip + AFTER_TIP
    for tip in ('<link name="tip"/>', f'<link name="tip"><inertial>{ONE}</inertial></link>')
]


def test_a_default_inertial_is_named_by_the_links_that_have_none(tmp_path):
    """What DART 6.20.0 and PyBullet 3.2.7 do with links without <inertial>."""
    result = judged(tmp_path, *DEFAULT_INERTIAL)
    (cause,) = causes_of(result)
    assert cause.field == "default inertial"
    assert "gives 1 kg and an inertia of 1 kg m² to bodies without mass: tip (" in cause.sentence


def test_a_cause_is_proved_beside_the_rounding_of_a_fixed_base(tmp_path):
    """PyBullet places bodies by centres of mass, that of the base too, where a body's own way is zero."""
    base = f'<link name="base"><inertial><origin xyz="0.03 0 0"/>{ONE}</inertial></link>'
    texts = [text.replace('<link name="base"/>', base) for text in DEFAULT_INERTIAL]
    assert base in texts[0]
    result = judged(tmp_path, *texts, moved="upper")
    (cause,) = causes_of(result)
    assert cause.field == "default inertial"


LIFT = """<robot name="lift"><link name="base"/>
<link name="cage"><inertial><mass value="3"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="j" type="prismatic"><origin xyz="0.1 0 0" rpy="0.3 0.2 0.1"/><parent link="base"/>
<child link="cage"/><axis xyz="0 0 2"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>
"""


def test_a_slide_that_is_placed_by_the_length_of_its_axis_is_named(tmp_path):
    """What PyBullet 3.2.7 does: its equations have the unit axis, its poses the file's."""
    path, prepared = prepared_file(tmp_path, LIFT)
    answer = answer_of("mujoco", prepared.file, path)
    far = [replace(state, coordinates=2 * state.coordinates) for state in answer.states]
    placed = evaluate_model_file("mujoco", prepared.file, far)
    both = zip(answer.quantities, placed, strict=True)
    answer = replace(answer, quantities=tuple(replace(own, poses=there.poses) for own, there in both))
    result = judge_file(path, prepared.neutral_model(None), ("mujoco", MUJOCO, answer), STATES)
    (cause,) = causes_of(result)
    assert "multiplies the coordinate of slide j by the length of its axis" in cause.sentence
    assert "that of j by 2 (line 5), but not in its equations; this alone explains" in cause.sentence


def test_several_fixed_links_that_are_left_out_are_named(tmp_path):
    """What Exudyn's loader does with the links on fixed joints."""
    inertial = (
        '<inertial><mass value="0.3"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    )
    parts = "".join(
        f'<link name="{name}">{inertial}</link><joint name="at_{name}" type="fixed">'
        f'<origin xyz="0 0.1 {k}"/><parent link="cage"/><child link="{name}"/></joint>'
        for k, name in enumerate(("lamp", "bell"))
    )
    result = judged(tmp_path, LIFT.replace("</robot>", f"{parts}</robot>"), LIFT)
    (cause,) = causes_of(result)
    assert "leaves out the mass and inertia of lamp, bell (0.6 kg" in cause.sentence


ONE_ROOT = """<mujoco><worldbody><body name="a"><joint name="j" axis="0 1 0"/>
<inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>
"""
SECOND = '<body name="b"><joint name="k"/><inertial pos="1 0 0" mass="1" diaginertia="1 1 1"/></body>'
TWO_ROOTS = ONE_ROOT.replace("</worldbody>", f"{SECOND}</worldbody>")


def test_a_body_that_is_missing_beside_another_cause_is_left_out_and_not_fixed(tmp_path):
    mutated = ONE_ROOT.replace('mass="1"', 'mass="1.5"')
    result = judged(tmp_path, TWO_ROOTS, mutated)
    causes = causes_of(result)
    assert {cause.field for cause in causes} == {"missing body", "mass"}
    assert "leaves out the body b (line 2)" in causes[0].sentence


WHEEL = """<mujoco><worldbody><body name="a"><joint name="j" axis="0 0 1"/>
<inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>
"""
NAMED = {
    # a difference of MuJoCo 4.0.0 itself, seen on robots of pybullet and example-robot-data
    "massless fixed links": (
        MASSLESS, MASSLESS, "leaves out the inertia of tip (0 kg, ",
        "line 4), fixed to body upper; this alone explains every quantity",
    ),
    "a fixed body elsewhere": (
        DISK.format("1 1 1.5", "0 0 1"), DISK.format("1 1 1.5", "0 0 1.25"),
        "reads the position in its parent of body post as (0, 0, 1.25)",
    ),
    "a body on the world left out, not fixed": (TWO_ROOTS, ONE_ROOT, "leaves out the body b (line 2)"),
    "a mass that moves nothing": (
        WHEEL, WHEEL.replace('mass="1"', 'mass="1.001"'),
        "reads the mass of body a as 1.001; the file says 1 (line 2)",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMED)
def test_a_difference_is_named_in_a_sentence(tmp_path, name):
    text, other, *words = NAMED[name]
    (cause,) = causes_of(judged(tmp_path, text, other))
    assert all(one in cause.sentence for one in words), cause.sentence


FREE = """<mujoco><worldbody><body name="a" pos="0 0 1" quat="1 1 0 0"><freejoint/>
<inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/>
<body name="b"><joint name="j" axis="0 1 0"/><inertial pos="1 0 0" mass="1" diaginertia="1 1 1"/></body>
</body></worldbody></mujoco>
"""


def test_a_free_body_whose_coordinates_count_from_elsewhere_is_named(tmp_path):
    """Pinocchio 4.1.0 itself: a root that the file turns by R is displaced by p − R p, here (0, 1, 1)."""
    result = pinocchio_judged(tmp_path, FREE)
    (cause,) = causes_of(result)
    assert "coordinates of the free joint of body a from (0, 1, 1) and not from" in cause.sentence
    assert "this alone explains every quantity" in cause.sentence


TURNED = """<mujoco><default><joint armature="0.1"/></default><worldbody>
<body name="a"><joint name="f" type="free"/><inertial pos="0 0.1 0" mass="1" diaginertia="1 1 1"/></body>
</worldbody></mujoco>
"""


def test_an_armature_that_turns_with_a_free_body_is_named(tmp_path):
    path, _ = prepared_file(tmp_path, TURNED)
    plan = ModelPlan((path,), importers=("pinocchio",), state_count=STATES)
    (file,) = run_model_files(plan, lambda *_: None).files
    (cause,) = file.explanations["pinocchio"].causes
    assert "applies the armature of joint f in the axes of the body, not of the world" in cause.sentence
