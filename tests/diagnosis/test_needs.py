"""What an unexplained difference needs: planted changes of an engine that are active under conditions."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from plumbline.diagnosis.diagnose import diagnose
from plumbline.diagnosis.needs import find_needs
from plumbline.diagnosis.prediction import Predictor, View
from plumbline.model.datatypes import KINDS, StateQuantities
from plumbline.model.random_mechanisms import ELEMENTS, random_loop_mechanism
from plumbline.model.sampling import random_loop_states, random_states
from plumbline.truth.ground_truth import state_truth
from tests.helpers import pendulums
from tests.helpers.nightly_tests import SLOW
from tests.helpers.random_chains import tree_from_seed
from tests.helpers.tables import table

FIELDS = {
    "gravity": "gravity", "an applied force": "force", "an applied moment": "moment", "drag": "drag_force",
    "a rotor": "armature", "a damper": "damping", "a joint spring": "stiffness", "an effort": "effort",
    "a spring between points": "spring_stiffness",
}  # fmt: skip
HAS = {
    "motion": lambda m, s: np.any(s.v) or np.any(s.omega),
    "products of inertia": lambda m, s: np.any(m.inertia * (1 - np.eye(3))),
    "a closing joint": lambda m, s: m.has_loops,
    "turned axes of joints": lambda m, s: any(
        np.any(turn[:, 1:]) for turn, kind in zip(m.turn, m.kinds, strict=True) if not kind.has_attitude
    ),
    "a branch": lambda m, s: len(set(m.body[: m.n, 0].tolist())) < m.n,
    **{what: partial(lambda name, m, s: np.any(getattr(m, name)), name) for what, name in FIELDS.items()},
    **{f"{n} bodies": partial(lambda n, m, s: m.n >= n, n) for n in range(2, 6)},
    **{f"a {kind} joint": partial(lambda kind, m, s: kind in m.kind, kind) for kind in KINDS},
}
PLANTED = [tuple(case) for case in table(__file__)]


def mechanism(family, conditions):
    """The first mechanism of a family that has all that the conditions are about, and states."""
    for seed in range(1000):
        if family == "chain":
            model = pendulums.make_model("rbrb", loads=True, drag=True, seed=seed)
        elif family == "tree":
            model = tree_from_seed([3, seed], 5, elements=ELEMENTS)
        else:
            model, start = random_loop_mechanism(seed, 5, [("ball", "hinge")[seed % 2]], elements=ELEMENTS)
            states = [start]
        if family != "loop":
            states = random_states(model, 9, seed=6)
        if all(HAS[one](model, states[0]) for one in conditions):
            return model, states if family != "loop" else random_loop_states(model, start, 9, 4)
    raise AssertionError


def wrong_under(conditions):
    """An engine whose acceleration is wrong, as no edit describes, where all conditions hold."""

    def evaluate(model, states):
        found, right = [], Predictor(model, states, View()).right
        for i, state in enumerate(states):
            answer = {q: x[i] if x[i].ndim else float(x[i]) for q, x in right.items()}
            if all(HAS[one](model, state) for one in conditions):
                wrong = np.cos(7 * answer["acceleration"] + 3 * np.sum(state.p)) * (1 + np.arange(3))
                answer["acceleration"] = answer["acceleration"] + wrong
            found.append(StateQuantities(**answer))
        return found

    return evaluate


def cases(step):
    return [
        pytest.param(family, conditions, id=f"{family}: {' and '.join(conditions)}",
                     marks=SLOW if k % step else [])
        for k, (family, *conditions) in enumerate(PLANTED)
    ]  # fmt: skip


@pytest.mark.parametrize(("family", "conditions"), cases(3))
def test_a_difference_needs_exactly_the_conditions_under_which_it_is_there(family, conditions):
    model, states = mechanism(family, conditions)
    needs = find_needs(model, list(states[:4]), ["acceleration"], wrong_under(conditions))["acceleration"]
    assert sorted(needs) == sorted(conditions)


def test_a_quantity_that_a_trial_lacks_shows_nothing():
    """An engine may offer joint moments of some mechanisms only."""
    model, states = mechanism("chain", ("gravity",))
    wrong = wrong_under(("gravity",))

    def evaluate(requested, at):
        found = wrong(requested, at)
        return found if np.any(requested.gravity) else [replace(a, acceleration=None) for a in found]

    needs = find_needs(model, list(states[:2]), ["acceleration"], evaluate)["acceleration"]
    assert "gravity" not in needs


@pytest.mark.parametrize(("family", "conditions"), cases(len(PLANTED)))
def test_the_diagnosis_of_a_difference_that_no_edit_describes_is_what_it_needs(family, conditions):
    model, states = mechanism(family, conditions)
    engine, truth = wrong_under(conditions), state_truth(model, states)
    (cause,) = diagnose(model, engine(model, states), truth, engine).causes
    assert (cause.kind, cause.quantities) == ("unexplained", ("acceleration",))
    assert sorted(cause.needs) == sorted(conditions)
