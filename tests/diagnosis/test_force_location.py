"""Forces that are others at every state: their place is named, and nothing else is taken for them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from plumbline.diagnosis.diagnose import diagnose
from plumbline.diagnosis.prediction import VECTORS, Predictor, View
from plumbline.diagnosis.readings import reading_edits
from plumbline.diagnosis.terms import Terms
from plumbline.model.kinematics import rotation_matrix
from plumbline.model.sampling import random_states
from plumbline.truth.ground_truth import state_truth
from tests.helpers.nightly_tests import SLOW
from tests.helpers.planting import every_joint
from tests.helpers.tables import table

pytest.importorskip("flint")
STATES = 3
ANOTHER = "another at each state"
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
    terms = Terms(Predictor(model, [truth.states[i]], View()))
    own = truth.quantities[i]
    found = {name: np.array(getattr(own, name)) for name in VECTORS}
    for amount, effect in zip(DRAWS[i], terms.unit_velocity_terms(2), strict=False):
        found = {name: x + amount * effect[name][0] for name, x in found.items()}
    return replace(own, **found)


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
    ("output", "joint moment", "", "of universals about the centres of mass"): other_moment_point,
    ("term", "torque", "joint 2", ANOTHER): added("effort", (1, 0), lambda x: x[0]),
    ("term", "efforts", "joint 3", ANOTHER): added("effort", (2,), lambda x: x[:2]),
    ("term", "force", "spring 1", ANOTHER): spring,
    ("term", "moment", "joint 1", ANOTHER): ball,
    ("term", "moment", "body 3", ANOTHER): added("moment", (2,), lambda x: x[:3]),
    ("term", "force", "body 2", ANOTHER): added("force", (1,), lambda x: x[:3]),
    ("term", "force and moment", "body 3", ANOTHER): both,
    ("term", "velocity term", "joint 3", ANOTHER): velocity_term,
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
    (cause,) = diagnose(model, [NAMED[expected](i) for i in range(STATES)], truth).causes
    assert (cause.kind, cause.term, cause.place, cause.change) == expected and not cause.equal


@pytest.mark.parametrize("answer", few_fast([wrong_wrench, several_bodies, other_inertia]))
def test_other_differences_are_no_force_at_one_place(answer):
    model, truth = right()
    causes = diagnose(model, [answer(i) for i in range(STATES)], truth).causes
    assert [cause.kind for cause in causes] == ["unexplained"]


READINGS = [tuple(case) for case in table(__file__)]


@pytest.mark.parametrize(
    "reading", few_fast(READINGS, "'coordinates'", "xy, xz", "'world-frame", "first point")
)
def test_a_reading_is_named_that_explains_every_state(reading):
    model, truth = right()
    predictor = Predictor(model, truth.states, View())
    edits = {(e.cause.term, e.cause.place, e.cause.change): e for e in reading_edits(predictor.case)}
    seen = predictor.each_state(edits[reading].change(predictor.case, np.zeros(0)))
    answers = [state_truth(*(one[0], [one[1]])).quantities[0] for one in seen]
    (cause,) = diagnose(model, answers, truth).causes
    assert (cause.kind, cause.term, cause.place, cause.change) == ("frame", *reading) and not cause.equal
