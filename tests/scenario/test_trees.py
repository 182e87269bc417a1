"""Scenario files with parents and joints with axes: what they build, and what they refuse, where."""

import numpy as np
import pytest

from plumbline.model.kinematics import rotation_matrix
from plumbline.scenario.errors import ScenarioError
from plumbline.scenario.loader import load_scenario_text

HEAD = "schema_version: 1\ntitle: t\npurpose: p\nbodies:\n"
BODY = "mass: 1, inertia: {principal: [1, 1, 1]}, proximal: [0, 0, 1]"


def load(*bodies):
    return load_scenario_text(HEAD + "".join(f"  - {{{BODY}, {body}}}\n" for body in bodies))


def problems(*bodies):
    with pytest.raises(ScenarioError) as error:
        load(*bodies)
    return [str(problem) for problem in error.value.problems]


def test_a_tree_is_built_as_written():
    s = load(
        "name: a, joint: {kind: hinge, axis: [0, 2, 0], coordinates: [0.5], rates: [2]}, distal: [0, 0, -1]",
        "name: b, joint: {kind: slide, axis: [1, 0, 0], coordinates: [0.25], rates: [-1]}",
        "parent: a, anchor: [1, 2, 3], joint: {kind: ball}, attitude: {quaternion: [1, 0, 0, 0]}",
        "parent: world, anchor: [4, 0, 0], joint: {kind: universal, coordinates: [0.1, 0.2]}",
        "joint: {kind: free, position: [1, 1, 1], velocity: [0, 0, 2]}, attitude: {quaternion: [0, 1, 0, 0]}",
    )
    assert s.model.kind == ("hinge", "slide", "ball", "universal", "free")
    assert s.model.body[:, 0].tolist() == [-1, 0, 0, -1, -1] and not s.model.is_chain
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
MISTAKES = {
    "unknown": (
        (f"name: arm, {BALL}", f"parent: amr, {BALL}"),
        ["6:", "parent: is 'amr', no body's name", "'arm'"],
    ),
    "itself": ((f"name: a, parent: a, {BALL}",), ["5:", "parent: is 'a', which is not above this body"]),
    "later": ((f"parent: b, {BALL}", f"name: b, parent: world, {BALL}"), ["5:", "which is not above"]),
    "twice": (
        (f"name: a, {BALL}", f"name: a, parent: world, {BALL}", f"parent: a, anchor: [0, 0, 0], {BALL}"),
        ["7:", "the name of 2 bodies"],
    ),
    "branch": (
        (
            f"name: a, {BALL}", f"name: b, parent: a, anchor: [0, 0, 0], {BALL}",
            f"name: c, parent: a, anchor: [0, 0, 0], {BALL}", f"parent: b, anchor: [0, 0, 0], {BALL}",
        ),
        ["8:", "whose branch ended above"],
    ),
    "no distal": (
        (f"name: a, {BALL}", f"parent: a, {BALL}"),
        ["6:", "anchor: is missing: the parent has no distal"],
    ),
    "no axis": (("joint: {kind: hinge, axis: [0, 0, 0]}",), ["5:", "axis: is all zeros"]),
    "two axes": (
        ("joint: {kind: hinge, axis: [0, 0, 1], frame: {quaternion: [1, 0, 0, 0]}}",),
        ["gives axis and a frame"],
    ),
    "axis of a weld": (
        (f"{BALL}, distal: [0, 0, 0]", "joint: {kind: weld, axis: [0, 0, 1]}"),
        ["6:", "gives an axis"],
    ),
    "weld to the world": (("joint: {kind: weld}",), ["5:", "welds a body to the world"]),
    "coordinates": (
        ("joint: {kind: hinge, coordinates: [1, 2]}",),
        ["5:", "coordinates: has 2 numbers", "1 for a hinge"],
    ),
    "attitude": (
        ("joint: {kind: hinge}, attitude: {quaternion: [1, 0, 0, 0]}",),
        ["5:", "attitude: is given for a body on a hinge"],
    ),
    "no attitude": (("joint: {kind: ball}",), ["5:", "attitude: is missing"]),
    "rates": (
        ("joint: {kind: hinge}, angular_velocity: [1, 0, 0]",),
        ["5:", "angular_velocity: is given for a body"],
    ),
    "free on a body": (
        (f"name: a, {BALL}", "parent: a, joint: {kind: free}, attitude: {quaternion: [1, 0, 0, 0]}"),
        ["6:", "parent: is given for a free body"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named_with_their_place(name):
    bodies, words = MISTAKES[name]
    found = "\n".join(problems(*bodies))
    assert all(word in found for word in words), found
