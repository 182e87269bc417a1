"""Forces that are others at every state: their place is named, and nothing else is taken for them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from plumbline.diagnosis.joint_diagnosis import diagnose_joints
from plumbline.diagnosis.joint_prediction import tree_solution
from plumbline.diagnosis.misreadings import misreadings
from plumbline.model.kinematics import rotation_matrix
from plumbline.model.sampling import random_states
from plumbline.truth.ground_truth import state_truth
from tests.helpers.nightly_tests import SLOW
from tests.helpers.planting import every_joint

pytest.importorskip("flint")
STATES = 3
DRAWS = np.random.default_rng(5).normal(size=(STATES, 6))


@cache
def right():
    """Three bodies on a ball, a hinge and a universal joint, with two springs."""
    every = every_joint()
    names = (
        "mass",
        "inertia",
        "force",
        "moment",
        "drag_force",
        "drag_moment",
        "kind",
        "body",
        "point",
        "turn",
    )
    fields = {name: getattr(every, name)[:3] for name in (*names, "length", "armature", "damping")}
    fields |= {name: getattr(every, name)[:3] for name in ("stiffness", "rest", "effort")}
    model = every.changed(**fields, spring_body=np.array([[-1, 1], [0, 2]]))
    return model, state_truth(model, random_states(model, STATES, 8))


def added(name, at, of):
    """A field that has another value at each state."""

    def answer(i):
        model, truth = right()
        values = getattr(model, name).copy()
        values[at] += of(DRAWS[i])
        return state_truth(replace(model, **{name: values}), [truth.states[i]]).quantities[0]

    return answer


def both(i):
    """Another force and moment on the last body."""
    model, truth = right()
    force, moment = model.force.copy(), model.moment.copy()
    force[2] += DRAWS[i, :3]
    moment[2] += DRAWS[i, 3:]
    return state_truth(replace(model, force=force, moment=moment), [truth.states[i]]).quantities[0]


def spring(i):
    """Another tension of the first spring; its energy is right."""
    _, truth = right()
    found = added("spring_length", (0,), lambda x: 0.1 * x[0])(i)
    return replace(found, potential_energy=truth.quantities[i].potential_energy)


def ball(i):
    """Another damping of the ball joint about one axis of the body: a moment on it in the joint."""
    _, truth = right()
    turn = rotation_matrix(truth.states[i].p[0])[:, 0]
    found = added("moment", (0,), lambda x: x[0] * np.eye(3)[0])(i)
    moment = found.joint_moment.copy()
    moment[0] += DRAWS[i, 0] * turn  # on the world it acts with the opposite sign
    return replace(found, joint_moment=moment)


def velocity_term(i):
    """The universal joint's rows with another acceleration."""
    model, truth = right()
    bend = lambda k, held, bend: (held, bend + DRAWS[i] * (k == 2))  # noqa: E731
    r, turn, force, moment = tree_solution(model, truth.states[i], rows=bend)
    local = np.matvec(rotation_matrix(truth.states[i].p).mT, turn)
    own = truth.quantities[i]
    return replace(own, acceleration=r, angular_acceleration=local, joint_reaction=force, joint_moment=moment)


def few_fast(cases, *fast):
    """Of the cases those that contain certain words run fast, the others nightly."""
    return [
        pytest.param(case, marks=[] if any(words in str(case) for words in fast) else SLOW) for case in cases
    ]


def other_moment_point(i):
    """Moments of the universal joint about its body's centre of mass."""
    model, truth = right()
    found, state = truth.quantities[i], truth.states[i]
    arm = rotation_matrix(state.p[2]) @ model.proximal[2]
    moment = found.joint_moment.copy()
    moment[2] += np.cross(arm, found.joint_reaction[2])
    return replace(found, joint_moment=moment)


NAMED = {
    "the moments of universals were about the centres of mass;": other_moment_point,
    "another torque acted along joint 2;": added("effort", (1, 0), lambda x: x[0]),
    "other efforts acted along joint 3;": added("effort", (2,), lambda x: x[:2]),
    "the force of spring 1 were another;": spring,
    "another moment acted in joint 1;": ball,
    "another moment acted on body 3;": added("moment", (2,), lambda x: x[:3]),
    "another force acted on body 2;": added("force", (1,), lambda x: x[:3]),
    "another force and moment acted on body 3;": both,
    "the velocity term of joint 3 were another;": velocity_term,
}


def wrong_wrench(i):
    """Another moment in a joint where accelerations are right."""
    _, truth = right()
    found = truth.quantities[i]
    return replace(found, joint_moment=found.joint_moment + np.outer([0, 0, 1], DRAWS[i, :3]))


def several_bodies(i):
    """Forces on two bodies."""
    return added("force", (slice(3),), lambda x: x[:3] * np.array([[0], [1], [-2]]))(i)


def other_inertia(i):
    """Another inertia at each state: the kinetic energy is another too."""
    return added("inertia", (2,), lambda x: 0.01 * np.abs(x[0]) * np.diag([1, 2, 2.5]))(i)


@pytest.mark.parametrize("expected", few_fast(NAMED))
def test_the_place_of_unknown_forces_is_named(expected):
    model, truth = right()
    text = diagnose_joints(model, [NAMED[expected](i) for i in range(STATES)], truth)
    assert text + ";" == f"behaves as if {expected}"


@pytest.mark.parametrize("answer", few_fast([wrong_wrench, several_bodies, other_inertia]))
def test_other_differences_are_no_force_at_one_place(answer):
    model, truth = right()
    assert "behaves as if" not in diagnose_joints(model, [answer(i) for i in range(STATES)], truth)


@pytest.mark.parametrize(
    "words",
    few_fast(
        [
            "the coordinates of joint 3 were exchanged",
            "rate 1 of joint 3 were its absolute value",
            "the applied moment of all bodies were given in the world frame",
            "the damping of every joint were that of the joint before",
            "the inertia of body 2 were turned against its joint's axes",
            "the stiffness of the two coordinates of joint 3 were exchanged",
            "the drag force and the drag moment of all bodies were exchanged",
            "the products of inertia yz, xz, xy of all bodies were xy, xz, yz",
            "the products of inertia yz, xz, xy of body 2 were -yz, -xz, -xy",
            "the drag moment of all bodies were taken with the world-frame angular velocity",
            "the drag force of body 3 were taken with the velocity of its joint's point",
            "the drag force of body 3 were taken with the body-frame velocity",
            "the world's point of spring 1 were negated",
            "the first point of spring 2 were left out",
            "spring 1 of joint 2 did not count its coordinate",
            "the inertia of every body were that of the first body",
            "the springs, dampers and efforts of all joints were missing",
            "all drags were missing",
        ],
        "coordinates of joint 3 were exchanged",
        "xy, xz, yz",
        "world-frame angular",
        "negated",
    ),
)
def test_a_reading_is_named_that_explains_every_state(words):
    model, truth = right()
    seen = [dict(misreadings(model))[words](model, state) for state in truth.states]
    answers = [state_truth(one.model, [one.state]).quantities[0] for one in seen]
    text = diagnose_joints(model, answers, truth)
    assert text == f"behaves as if {words}"
