"""What an engine raises keeps its class and place, so that one failure is one finding on every mechanism."""

import numpy as np
import pytest

from plumbline.engines.engine_calls import evaluate_states, run_refinement, run_steps
from plumbline.judging.findings import find_findings
from plumbline.judging.rows import RowContext
from plumbline.judging.state_level import judge_states
from plumbline.model.kinematics import complete_state
from plumbline.model.sampling import random_states
from plumbline.truth.ground_truth import state_truth
from tests.helpers.random_chains import tree_from_seed

ENGINE = """
import numpy as np
from adapters.mujoco_engine import Mujoco
from plumbline.model.datatypes import Unsupported

class Failing(Mujoco):
    name = "failing"

    def _evaluate(self, model, states):
        return self.add_forces(np.zeros(6 * model.n), np.zeros(5 * model.n))

    def add_forces(self, forces, rates):
        return forces + rates

    def _simulate(self, model, *_):
        raise ValueError(f"no run of {model.n} bodies")

    def _step(self, model, *_):
        raise Unsupported(f"no step of {model.n} bodies")
"""


@pytest.fixture
def engine(tmp_path):
    (tmp_path / "failing.py").write_text(ENGINE)
    return f"{tmp_path / 'failing.py'}:Failing"


def mechanism(bodies):
    model = tree_from_seed(bodies, bodies, ("hinge",))
    return model, [complete_state(model, state) for state in random_states(model, 2, 1)]


def test_shapes_in_the_message_of_a_failure_make_no_other_finding(engine):
    rows = []
    for bodies in (2, 3):
        model, states = mechanism(bodies)
        context = RowContext(f"{bodies} bodies", "f", "failing", "The engine", "0")
        rows += judge_states(context, state_truth(model, states), evaluate_states(engine, model, states)).rows
    assert rows[0].reason != rows[1].reason and "(12,) (10,)" in rows[0].reason
    (place,) = {str(row.extra["place"]) for row in rows}
    assert place.startswith("ValueError in ") and place.endswith(" > evaluate > _evaluate > add_forces")
    (found,) = find_findings(rows, {})
    assert len(found.rows) == 2


def test_runs_and_steps_keep_the_place_too(engine):
    model, (state, _) = mechanism(2)
    study = run_refinement(engine, "RK4", model, state, np.array([0.0, 0.1]), [0.1])
    assert study.runs[0].failure.message == "ValueError: no run of 2 bodies"
    assert study.runs[0].failure.place.endswith(" > simulate > _simulate")
    (attempt,) = run_steps(engine, "RK4", model, [state], [[0.1]], [1]).attempts
    assert attempt.refusal.message == "no step of 2 bodies"
    assert attempt.refusal.place.endswith(" > step > _step")
