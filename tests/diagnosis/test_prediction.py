"""Predictions of a diagnosis against certified truth: chains, trees and loops, many mechanisms at once."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.diagnosis.prediction import Case, Predictor, View
from plumbline.model.sampling import random_states
from plumbline.truth.ground_truth import state_truth
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario, states_of

pytest.importorskip("flint")


def subject(name):
    if name in ("rb", "brbbrbrrbbrb"):
        model = pendulums.make_model(name, loads=True, drag=True)
        return model, random_states(model, 3, 5)
    scenario = catalogue_scenario(name)
    return scenario.model, states_of(scenario, 2)


@pytest.mark.parametrize(
    "name", ["rb", "brbbrbrrbbrb", "tree-of-seven-sprung", "flyball-governor", "bricard"]
)
@pytest.mark.parametrize("view", [View(), View(are_bodies_kept=True)], ids=["coordinates", "bodies"])
def test_predictions_agree_with_certified_truth(name, view):
    model, states = subject(name)
    if view.are_bodies_kept and not model.has_loops:
        return  # of trees the coordinates place the bodies
    truth, right = state_truth(model, states), Predictor(model, states, view).right
    for k, (quantities, bound) in enumerate(zip(truth.quantities, truth.bounds, strict=True)):
        for quantity, x in right.items():
            if (exact := getattr(quantities, quantity)) is None:
                continue
            off = np.asarray(x[k] - exact)
            size = np.linalg.norm(off, axis=-1) if off.ndim else np.abs(off)
            assert np.all(size <= bound.tolerance(quantity)), quantity


@pytest.mark.parametrize("name", ["rb", "tree-of-seven-sprung", "four-bar"])
def test_lanes_of_a_batch_are_the_mechanisms_one_by_one(name):
    """Other masses, points and states, one of them at each state; each lane as if it were evaluated alone."""
    model, states = subject(name)
    predictor = Predictor(model, states, View())
    right = predictor.case
    moment = np.stack([model.moment + 0.1 * (1 + s) for s in range(len(states))])
    cases = [
        right,
        Case(replace(model, mass=1.5 * model.mass), right.state),
        Case(replace(model, point=1.001 * model.point), right.state),
        Case(replace(model, moment=moment), right.state),
    ]
    found = predictor.predict(cases)
    for lane, case in enumerate(cases):
        alone = predictor.predict([case])
        for name_, x in found.items():
            np.testing.assert_allclose(x[lane], alone[name_][0], rtol=1e-12, atol=1e-12 * np.max(np.abs(x)))
    assert np.max(np.abs(found["acceleration"][1:] - found["acceleration"][0])) > 1e-6
    each = Predictor(replace(model, moment=moment[1]), states[1:2], View()).right
    np.testing.assert_allclose(found["acceleration"][3, 1], each["acceleration"][0], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", ["rb", "four-bar"])
def test_a_singular_mechanism_is_not_a_number_and_the_others_of_its_batch_are(name):
    model, states = subject(name)
    predictor = Predictor(model, states, View())
    empty = replace(model, mass=0 * model.mass, inertia=0 * model.inertia)
    found = predictor.predict([predictor.case, Case(empty, predictor.case.state)])["acceleration"]
    assert np.all(np.isfinite(found[0])) and not np.all(np.isfinite(found[1]))
