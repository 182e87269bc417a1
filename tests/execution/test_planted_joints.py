"""Defects of bodies, joints and elements in trees and loops: each is reported, and named by its place."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.diagnosis.diagnose import diagnose
from plumbline.engines.registry import load_adapter
from plumbline.model.kinematics import rotation_matrix
from plumbline.model.sampling import random_states
from plumbline.truth.ground_truth import state_truth
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.nightly_tests import SLOW, slow, some_fast
from tests.helpers.planted_defects import STATE_DEFECTS
from tests.helpers.planted_joints import ELEMENT_DEFECTS, JOINT_DEFECTS, LOOP_DEFECTS
from tests.helpers.planting import (
    EVERY_JOINT,
    RANDOM_LOOP,
    Defect,
    assert_named,
    diagnosis,
    evaluated,
    subject,
)
from tests.helpers.requirements import require_engines

require_engines()


@pytest.mark.parametrize(
    "defect", [*some_fast(ELEMENT_DEFECTS, 1), *some_fast(JOINT_DEFECTS, 6), *some_fast(LOOP_DEFECTS, 6)]
)
def test_every_defect_is_reported(defect):
    assert evaluated(defect)[1], f"nothing reports {defect.name}"


@pytest.mark.parametrize(
    "defect",
    [
        case
        for defects, step in ((ELEMENT_DEFECTS, 16), (JOINT_DEFECTS, 24), (LOOP_DEFECTS, 14))
        for case in some_fast([d for d in defects if d.expected], step)
    ],
)
def test_every_defect_with_words_is_named(defect):
    assert_named(defect)


@slow
@pytest.mark.parametrize("defect", [d for d in LOOP_DEFECTS if not d.expected], ids=lambda d: d.name)
def test_a_defect_without_words_gets_no_wrong_name(defect):
    assert "behaves as if" not in diagnosis(defect)


USED = {(d.engine, d.mechanism) for d in (*ELEMENT_DEFECTS, *JOINT_DEFECTS, *LOOP_DEFECTS)}
USED -= {("mujoco", "wrecking-ball")}  # known_issues.yaml: the rounding of its moments exceeds the bound


CLEAN = [
    Defect(f"{engine} on {mechanism}", engine=engine, mechanism=mechanism)
    for engine, mechanism in sorted(USED | {("reference", EVERY_JOINT), ("pinocchio", RANDOM_LOOP)})
]


@pytest.mark.parametrize("clean", some_fast(CLEAN, 4))
def test_the_engines_without_defect_are_not_reported(clean):
    assert evaluated(clean)[1] == []


def test_a_misread_velocity_that_only_energies_show_is_named_without_gravity():
    scenario = catalogue_scenario("free-body-with-rotors")
    model, states = scenario.model, random_states(scenario.model, 3, seed=2)
    truth = state_truth(model, states)
    assert not np.any(model.gravity) and truth.bounds[0].tolerance("potential_energy") == 0
    turned = [replace(s, v=np.matvec(rotation_matrix(s.p), s.v)) for s in truth.states]
    found = load_adapter("pinocchio").evaluate(model, turned)
    assert "the velocity of body 1 were given in the body frame" in diagnose(model, found, truth).text


def is_applicable(defect, mechanism):
    """Whether the mechanism has what a defect of chains alters: a rod, a free attitude, a pose at rest."""
    model, truth = subject(mechanism)
    if mechanism == RANDOM_LOOP and defect.name in OF_BODIES_NOT_JOINTS:
        return False
    given = [defect.inputs(model, s) for s in truth.states] if defect.inputs else []
    return not defect.inputs or any(
        not np.array_equal(getattr(x, name), value)
        for pair, right in zip(given, ((model, state) for state in truth.states), strict=True)
        for x, own in zip(pair, right, strict=True)
        for name, value in vars(own).items()
    )


# The formula for the answer has one joint per body.
OF_BODIES_NOT_JOINTS = (
    "reaction-in-body-frame", "reaction-1-in-body", "reaction-without-loads", "reaction-without-drag",
)  # fmt: skip


@pytest.mark.parametrize("step", [10, pytest.param(1, marks=SLOW)])
@pytest.mark.parametrize("mechanism", [EVERY_JOINT, RANDOM_LOOP])
def test_defects_of_chains_are_reported_in_trees_and_loops(mechanism, step):
    """Those of numbers, conventions and answers, wherever they make a difference; fast every tenth."""
    chosen = [d for d in STATE_DEFECTS if not d.patch and d.name != "digits-lost-along-chain"]
    moved = [
        replace(d, engine="pinocchio", mechanism=mechanism, loaded=False)
        for d in chosen
        if is_applicable(d, mechanism)
    ]
    assert len(moved) > 0.8 * len(chosen)
    assert not [d.name for d in moved[::step] if not evaluated(d)[1]]
