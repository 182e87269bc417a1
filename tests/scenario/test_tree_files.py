"""Scenario files with parents and joints with axes: what they build, and what they refuse, where."""

import numpy as np
import pytest
from pydantic import ValidationError

from plumbline.model.datatypes import JOINT_ELEMENTS
from plumbline.model.kinematics import rotation_matrix
from plumbline.scenario.line_and_column_errors import ScenarioError
from plumbline.scenario.loader import load_scenario_text
from plumbline.storage.results_schema import _Scenario
from reference_impl.mechanism import Mechanism
from tests.helpers.refusals import refusal
from tests.helpers.tables import table

HEAD = "schema_version: 1\ntitle: t\npurpose: p\nbodies:\n"
BODY = "mass: 1, inertia: {principal: [1, 1, 1]}, proximal: [0, 0, 1]"


def text_of(*bodies, springs=()):
    text = HEAD + "".join(f"  - {{{BODY}, {body}}}\n" for body in bodies)
    return text + "springs:\n" * bool(springs) + "".join(f"  - {{{s}}}\n" for s in springs)


def load(*bodies, springs=()):
    return load_scenario_text(text_of(*bodies, springs=springs))


def problems(*bodies, springs=()):
    return map(str, refusal(load_scenario_text, text_of(*bodies, springs=springs)).problems)


def test_a_tree_is_built_as_written():
    s = load(
        "name: a, joint: {kind: hinge, axis: [0, 2, 0], coordinates: [0.5], rates: [2]}, distal: [0, 0, -1]",
        "name: b, joint: {kind: slide, axis: [1, 0, 0], coordinates: [0.25], rates: [-1]}",
        "parent: a, anchor: [1, 2, 3], joint: {kind: ball}, attitude: {quaternion: [1, 0, 0, 0]}",
        "parent: world, anchor: [4, 0, 0], joint: {kind: universal, coordinates: [0.1, 0.2]}",
        "joint: {kind: free, position: [1, 1, 1], velocity: [0, 0, 2]}, attitude: {quaternion: [0, 1, 0, 0]}",
    )
    assert s.model.kind == ("hinge", "slide", "ball", "universal", "free")
    assert s.model.body[:, 0].tolist() == [-1, 0, 0, -1, -1] and not s.model.has_chain_joints
    np.testing.assert_array_equal(
        s.model.point[:, 0], [[0, 0, 0], [0, 0, -1], [1, 2, 3], [4, 0, 0], [0, 0, 0]]
    )
    axis = rotation_matrix(s.model.turn[:2, 0])[..., 2]
    np.testing.assert_allclose(axis, [[0, 1, 0], [1, 0, 0]], atol=1e-15)
    c, sin = np.cos(0.5), np.sin(0.5)
    np.testing.assert_allclose(
        s.state.r[0], [-sin, 0, -c], atol=1e-15
    )  # hangs from the origin, turned about y
    np.testing.assert_allclose(s.state.v[0], 2 * np.array([-c, 0, sin]), atol=1e-15)
    np.testing.assert_allclose(s.state.r[1], [-3 * sin + 0.25 * c, 0, -3 * c - 0.25 * sin], atol=1e-15)
    np.testing.assert_array_equal(s.state.r[4], [1, 1, 2])  # its proximal point is at the position
    assert s.state.x.tolist() == [[0.5, 0], [0.25, 0], [0, 0], [0.1, 0.2], [0, 0]]


@pytest.mark.parametrize("axis", [[0, 0, 1], [0, 0, -1], [1e-9, 0, -1], [1, -2, -0.5], [3, 1, 0]])
def test_an_axis_may_point_anywhere(axis):
    s = load(f"joint: {{kind: hinge, axis: {axis}}}")
    wanted = np.array(axis) / np.linalg.norm(axis)
    np.testing.assert_allclose(rotation_matrix(s.model.turn[0, 1])[:, 2], wanted, atol=1e-15)


BALL = "joint: {kind: ball}, attitude: {quaternion: [1, 0, 0, 0]}"
MISTAKES, ELEMENT_MISTAKES = (table(__file__, name) for name in ("mistakes", "elements"))


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named_with_their_place(name):
    found = "\n".join(problems(*MISTAKES[name]["bodies"]))
    assert all(word in found for word in MISTAKES[name]["words"]), found


ARM = "name: arm, joint: {kind: hinge, axis: [0, 0, 1]}, distal: [0, 0, -1]"
BOB = f"name: bob, {BALL}"


@pytest.mark.parametrize("more", [
    f"  - {{{BODY}, parent: bob, anchor: [0, 0, 1], {BALL}}}\n",
    "springs:\n  - {bodies: [world, bob], points: [[0, 0, 1], [0, 1, 0]], stiffness: 1}\n",
])  # fmt: skip
def test_repeated_bodies_share_their_name_and_it_names_none_of_them(more):
    repeated = f"  - {{repeat: 2, cycle: [{{{BODY}, {BOB}, distal: [0, 0, -1]}}]}}\n"
    assert load_scenario_text(HEAD + repeated).body_names == ("bob", "bob")
    with pytest.raises(ScenarioError, match="is 'bob', the name of 2 bodies"):
        load_scenario_text(HEAD + repeated + more)


def test_passive_elements_are_built_as_written():
    s = load(
        ARM.replace("1]}", "1], armature: 0.5, stiffness: [3], rest: 1, effort: -2}"),
        f"name: bob, {BALL.replace('ball', 'ball, damping: 0.25, armature: 1')}",
        "joint: {kind: universal, damping: [1, 2], effort: [0, 4]}, parent: arm",
        springs=(
            "bodies: [world, bob], points: [[0, 0, 1], [0, 1, 0]], stiffness: 7, length: 0.5",
            "bodies: [bob, arm], points: [[0, 0, 3], [0, 0, 0]], damping: 2",
        ),
    ).model
    assert s.armature.tolist() == [[0.5, 0], [1, 0], [0, 0]]
    assert s.damping.tolist() == [[0, 0], [0.25, 0], [1, 2]]
    assert s.stiffness.tolist() == [[3, 0], [0, 0], [0, 0]] and s.rest.tolist() == [[1, 0], [0, 0], [0, 0]]
    assert s.effort.tolist() == [[-2, 0], [0, 0], [0, 4]]
    assert s.spring_body.tolist() == [[-1, 1], [1, 0]] and s.spring_point[0].tolist() == [
        [0, 0, 1],
        [0, 1, 0],
    ]
    assert s.spring_stiffness.tolist() == [7, 0] and s.spring_damping.tolist() == [0, 2]
    assert s.spring_length.tolist() == [0.5, 0]
    again = Mechanism.from_fields({k: np.asarray(v).tolist() for k, v in s.fields.items()})
    assert all(np.array_equal(getattr(again, name), value) for name, value in vars(s).items())


def test_a_chain_with_an_element_is_no_bare_chain_and_bare_files_keep_their_digest():
    bare, damped = load(BALL), load(BALL.replace("ball", "ball, damping: 1"))
    assert bare.model.has_chain_joints and not damped.model.has_chain_joints and damped.model.has_elements
    assert "springs" not in bare.document and set(bare.document["bodies"][0]["joint"]) == {"kind"}
    assert bare.digest != damped.digest
    assert not set(bare.model.fields) & {"armature", "spring_body"}
    assert set(load(ARM, BOB).model.fields) & {"armature", "spring_body"} == set()


def spring(bodies, more="stiffness: 1", points="[[0, 0, 1], [0, 1, 0]]"):
    return (f"bodies: {bodies}, points: {points}, {more}",)


@pytest.mark.parametrize("name", ELEMENT_MISTAKES)
def test_mistakes_in_elements_are_named_with_their_place(name):
    case = ELEMENT_MISTAKES[name]
    found = "\n".join(problems(case["first"], f"parent: world, {BOB}", springs=case["springs"]))
    assert all(word in found for word in case["words"]), found


def test_stored_models_need_no_elements_and_check_those_they_have():
    model = load(ARM.replace("1]}", "1], damping: 2}"), BOB, springs=spring("[world, bob]")).model
    stored = {k: np.asarray(v).tolist() for k, v in model.fields.items()}
    about = {"family": "tree", "title": "t", "bodies": 2}
    _Scenario.model_validate(about | {"model": stored})
    _Scenario.model_validate(about | {"model": {k: v for k, v in stored.items() if k not in JOINT_ELEMENTS}})
    for name in ("damping", "spring_point", "spring_length"):
        with pytest.raises(ValidationError, match=f"model.{name} does not fit"):
            _Scenario.model_validate(about | {"model": stored | {name: [[1.0]]}})
