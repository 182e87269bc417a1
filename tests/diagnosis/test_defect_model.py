"""The fast model of a diagnosis against certified truth: dense for few bodies, banded for many."""

import numpy as np
import pytest

from plumbline.diagnosis.defect_model import MAX_DENSE_UNKNOWNS, evaluate_case, make_defect_case
from plumbline.model.sampling import random_states
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers import pendulums

pytest.importorskip("flint")


@pytest.mark.parametrize("joints", ["rb", "brbbrbrrbbrb"])
def test_the_model_agrees_with_certified_truth(joints):
    model = pendulums.make_model(joints, loads=True, drag=True)
    assert (9 * model.n > MAX_DENSE_UNKNOWNS) == (len(joints) > 6)
    states = random_states(model, 3, 5)
    answers = evaluate_case(make_defect_case(model, states))
    for k, state in enumerate(states):
        truth, bound = certify_state(model, state).quantities, state_rounding_bound(model, state)
        for quantity, x in answers.items():
            off = np.atleast_1d(x[k] - getattr(truth, quantity))
            size = np.linalg.norm(off, axis=-1) if x.ndim > 1 else np.abs(off)
            assert np.all(size <= bound.tolerance(quantity)), quantity


def test_a_singular_chain_raises():
    model = pendulums.make_model("b" * 8)
    broken = make_defect_case(model, random_states(model, 1, 1))
    broken.mass[:] = 0.0
    broken.inertia[:] = 0.0
    with pytest.raises(np.linalg.LinAlgError), np.errstate(all="ignore"):
        evaluate_case(broken)
