"""Every integrator of every engine on mechanisms with loops: it converges to the truth with its order."""

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Unsupported
from plumbline.model.invariants import compute_invariants, motion_errors, position_error
from plumbline.truth.trajectory_truth import simulate_notes_form
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.nightly_tests import SLOW
from tests.helpers.shared_answers import sharing
from tests.helpers.true_answers import converging_runs

EPS = np.finfo(float).eps
TIMES = np.arange(5) / 32
STEPS = 2.0**-8, 2.0**-9
# An error C hᵖ (1 + c h), c ≤ 64/s: six times the fastest joint rate, 10.6 rad/s, enough at order 4.
NEXT_TERM = 64 * STEPS[1]
ORDER_MARGIN = np.log2(1 + NEXT_TERM)  # of log₂ of two errors, (1 + 2 c h) / (1 + c h)
TOLERANCES = 1e-8, 1e-11
ENGINES = ["reference", "mujoco", "pinocchio", "exudyn"]


@pytest.fixture(scope="module", autouse=True)
def shared_truths():
    """True motions are the same for every engine."""
    with sharing(__name__, "simulate_notes_form"):
        yield


@pytest.mark.parametrize("name", ["four-bar", "slider-crank", "bricard"])
@pytest.mark.parametrize("engine", ENGINES)
def test_motions_of_loops_converge_to_the_truth(engine, name):
    s, adapter = catalogue_scenario(name), load_adapter(engine)
    true = simulate_notes_form(s.model, s.state, TIMES, 1e-13)
    assert adapter.integrators
    for method in adapter.integrators:
        resolutions = STEPS if method.kind == "step" else TOLERANCES
        runs, errors = converging_runs(adapter, method, s.model, s.state, true, resolutions, ORDER_MARGIN)
        gaps = [np.max(np.abs(compute_invariants(s.model, run).joint_gap)) for run in runs]
        if method.kind == "step":
            weight = 1 / (2.0**method.order - 1)
            limit = position_error(runs[1].r + weight * (runs[1].r - runs[0].r), true.r)[-1]
            assert limit < (1 + weight) * NEXT_TERM * position_error(runs[1].r, true.r)[-1], method.name
            assert gaps[1] < max(gaps[0], 10 * EPS) and gaps[1] < 4 * errors[1], method.name  # of two bodies
        else:  # errors grow by less than a hundred over 1/8 s
            assert errors[1] < 100 * TOLERANCES[1] and gaps[1] < 100 * TOLERANCES[1], method.name
        np.testing.assert_allclose(
            runs[1].v[0], s.state.v, rtol=0, atol=100 * EPS * np.max(np.abs(s.state.v))
        )


def test_mujoco_states_how_far_its_soft_loops_are_from_rigid_ones():
    s, adapter = catalogue_scenario("four-bar"), load_adapter("mujoco")
    true = simulate_notes_form(s.model, s.state, TIMES, 1e-13)
    run = adapter.simulate(s.model, s.state, TIMES, "RK4", 2.0**-10)
    assert run.softer is not None
    limit_errors = motion_errors(run, run.softer)
    assert all(0 < limit_error[-1] < 1e-10 for limit_error in limit_errors.values())
    error, softness = np.max(position_error(run.r, true.r)), limit_errors["position"][-1]
    assert error < 1e-8 and softness < 1e-11


@pytest.mark.parametrize("engine", ["pinocchio-maximal", "exudyn-tree"])
def test_other_columns_refuse_motions_of_loops(engine):
    s, adapter = catalogue_scenario("four-bar"), load_adapter(engine)
    for method in adapter.integrators:
        with pytest.raises(Unsupported, match=r"loops|closes"):
            adapter.simulate(s.model, s.state, TIMES, method.name, 2.0**-8)


@pytest.mark.parametrize(("name", "steps"), [("bricard", 60), pytest.param("slider-crank", 400, marks=SLOW)])
def test_a_run_keeps_its_independent_rows(name, steps):
    """Chosen anew in every stage, off the constraints, the rows differ: runs stall or end as singular."""
    case = catalogue_scenario(name)
    run = load_adapter("reference").simulate(
        case.model, case.state, np.array([0.0, 1.0, 2.0]), "dop853", 1e-13
    )
    assert run.steps < steps
