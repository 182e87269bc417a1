"""What holds of Exudyn alone: its drift, the singularity of its tree, what is not used and why."""

import gc
from dataclasses import replace

import exudyn
import numpy as np
import pytest

from adapters import exudyn_tree_engine
from adapters.exudyn_common import _StepRecorder, make_settings, set_linear_solver, silence_engine
from adapters.exudyn_engine import Exudyn, ExudynChain
from adapters.exudyn_tree_engine import ExudynTree
from plumbline.model.datatypes import EngineFailure, Model, State, Unsupported
from plumbline.model.kinematics import complete_state, joint_vectors
from plumbline.reproduce.engine_client import EngineClient
from plumbline.reproduce.measure import StepMeasure
from plumbline.reproduce.shrink import ReproductionCase
from plumbline.scenario.generator import random_mechanism
from plumbline.truth import rounding_bound
from plumbline.truth.certified_state import certify_state
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.true_answers import true_trajectory

TIMES = np.linspace(0.0, 2.0, 9)


def test_a_tree_that_leaves_masses_out_answers_with_a_singular_matrix_too():
    scenario = random_mechanism(3201, 112)
    variant = next(one for one in ExudynTree.variants if one.kind == "vectors")
    (found,) = ExudynTree().with_variant(variant).evaluate(scenario.model, [scenario.state])
    true = certify_state(scenario.model, scenario.state, mass_matrix=True).quantities
    assert np.max(np.abs(found.mass_matrix - true.mass_matrix)) > 1
    assert np.linalg.matrix_rank(found.mass_matrix) < len(found.mass_matrix)


def swinging_pendulum(joints):
    subject = pendulums.make_model(joints)
    return subject, pendulums.state_from_seed(subject, rate=0.5)


def test_the_trapezoidal_rule_lets_joints_drift_and_index_3_does_not():
    subject, start = swinging_pendulum("br")
    gaps = {}
    for method in ("trapezoidal", "generalized-alpha"):
        for step in (2.0**-8, 2.0**-9):
            run = Exudyn().simulate(subject, start, TIMES, method, step)
            gap = np.linalg.norm(joint_vectors(subject, run.r, run.p), axis=-1) - subject.length
            gaps[method, step] = np.abs(gap).max()
    assert gaps["generalized-alpha", 2.0**-8] < 1e-10
    assert 3 < gaps["trapezoidal", 2.0**-8] / gaps["trapezoidal", 2.0**-9] < 5  # order 2


def test_builtin_initial_accelerations_are_finite_differences():
    """The reason why `evaluate` solves M, C, f and γ itself: Exudyn's own are off by some 1e-6."""
    subject = pendulums.make_model("bb", seed=1)
    start = pendulums.state_from_seed(subject)
    truth = certify_state(subject, start).quantities
    scale = np.abs(truth.acceleration).max()
    with silence_engine():
        chain = ExudynChain(subject, start)
        solver, chosen = exudyn.MainSolverImplicitSecondOrder(), make_settings()
        assert chosen.timeIntegration.generalizedAlpha.computeInitialAccelerations
        assert solver.InitializeSolver(chain.mbs, chosen)
        own = np.reshape(chain.mbs.systemData.GetODE2Coordinates_tt(), (-1, 7))[:, :3]
        solver.FinalizeSolver(chain.mbs, chosen)
    solved = Exudyn().evaluate(subject, [start])[0].acceleration
    assert 1e-9 < np.abs(own - truth.acceleration).max() / scale < 1e-3
    assert np.abs(solved - truth.acceleration).max() / scale < 1e-13


def near_singular_pendulum(rate):
    """A body on a ball that starts about x and is driven about y, off its first axis."""
    subject = replace(pendulums.make_model("b"), gravity=np.zeros(3), moment=np.array([[0.0, 4.0, 0.0]]))
    subject = subject.changed(inertia=0.1 * np.eye(3)[None], proximal=np.zeros((1, 3)))
    zero = np.zeros((1, 3))
    return subject, complete_state(
        subject, State(np.array([[1.0, 0, 0, 0]]), np.array([[rate, 0.0, 0.0]]), zero, zero)
    )


def test_the_tree_reports_singular_angles():
    """A constant body moment turns the first axis into the third; before that the motion is right."""
    subject, start = near_singular_pendulum(1e-3)
    with pytest.raises(Unsupported, match=r"body 1 come near their singularity at t = 0\.2\d* s") as reported:
        ExudynTree().simulate(subject, start, np.array([0.0, 2.0]), "RK44", 2.0**-9)
    stated = float(str(reported.value).split("t = ")[1].split(" s")[0])
    # from rest, ½ (4 / 0.1) t² about the second or third axis of the chart: 84.26° at 0.2712 s
    assert stated == pytest.approx(np.sqrt(2 * np.arccos(0.1) / 40), abs=2.0**-9)
    before = np.array([0.0, 0.25])
    run = ExudynTree().simulate(subject, start, before, "RK44", 2.0**-11)
    true = true_trajectory(subject, start, before)
    assert np.abs(np.abs(run.p[-1] @ true.p[-1].T) - 1).max() < 1e-10


def test_the_tree_reports_singular_angles_of_a_free_body():
    """Three revolutes carry a free body as well: its refusal is one that the column declares."""
    s = catalogue_scenario("spring-pendulum")
    with pytest.raises(Unsupported, match=r"body 1 come near their singularity") as reported:
        ExudynTree().simulate(s.model, s.state, s.times, "RK44", 2.0**-11)
    assert reported.value.gap == "angles"


def test_tree_turns_for_ever_about_its_first_axis():
    """Ten turns about the initial axis: angles grow, nothing is singular."""
    subject, start = near_singular_pendulum(10 * np.pi)
    subject = subject.changed(moment=np.zeros((1, 3)))
    run = ExudynTree().simulate(subject, start, np.linspace(0, 2, 5), "RK44", 2.0**-8)
    assert np.abs(run.v).max() < 1e-13
    assert np.abs(np.abs(run.p[-1, 0]) - np.abs(start.p[0])).max() < 1e-9


def test_a_failed_newton_iteration_is_named_with_time_and_words():
    """A step of 0.25 s through a tumbling pendulum: Newton diverges, and the error reports it."""
    subject = pendulums.make_model("rr")
    start = pendulums.state_from_seed(subject, rate=20.0)
    with pytest.raises(EngineFailure, match=r"stopped at t = .* s after \d+ steps, asked for 8 .*: .+"):
        Exudyn().simulate(subject, start, TIMES, "generalized-alpha", 0.25)


@pytest.mark.parametrize("step", [2.0**-8, 1e-3, 1 / 300])
def test_steps_are_counted(step):
    subject, start = swinging_pendulum("b")
    times = np.arange(0, 4) * (300 * step if step > 1e-3 else 1.0)
    run = Exudyn().simulate(subject, start, times, "trapezoidal", step)
    assert run.steps == round(times[-1] / step)


def test_nothing_is_printed_or_written(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    subject, start = swinging_pendulum("br")
    for engine in (Exudyn(), ExudynTree()):
        engine.evaluate(subject, [start])
        engine.simulate(subject, start, TIMES[:2], engine.integrators[0].name, 2.0**-8)
    hard = pendulums.make_model("rr")
    with pytest.raises(EngineFailure):
        Exudyn().simulate(hard, pendulums.state_from_seed(hard, rate=20.0), TIMES, "generalized-alpha", 0.25)
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("engine", "method"), [(Exudyn(), "trapezoidal"), (ExudynTree(), "RK44")])
def test_a_system_is_freed_after_its_run(engine, method):
    """Random scenarios are thousands of systems in one worker; Python cannot free a cycle through Exudyn."""
    model, state = swinging_pendulum("r")
    engine.step(model, state, method, 1e-3, 2)
    gc.collect()
    assert not [one for one in gc.get_objects() if type(one) is _StepRecorder]


def light_and_heavy_balls():
    """Five balls of 5 g to 47 kg with small inertias: random-11-88, shrunk by `plumbline reproduce`."""
    mass = np.array([0.0054, 5.2, 0.18, 0.0103, 47.3])
    offsets = np.zeros((5, 3)), np.tile([0.0, 0.0, -0.6], (5, 1))
    offsets[0][3] = [0.0, 0.0, 1.0]
    zero = np.zeros(5)
    model = Model.chain(
        mass=mass, inertia=np.tile(np.diag([2e-4, 2e-4, 3e-4]), (5, 1, 1)), proximal=offsets[0],
        distal=offsets[1], length=zero, gravity=np.array([0.0, 0.0, -10.0]), force=np.zeros((5, 3)),
        moment=np.zeros((5, 3)), drag_force=zero, drag_moment=zero,
    )  # fmt: skip
    p = np.resize([[0.6, 0.8, 0.0, 0.0], [0.6, 0.0, 0.8, 0.0]], (5, 4))
    return model, complete_state(model, State(p, *np.zeros((3, 5, 3))))


@pytest.mark.parametrize(("solver", "least", "most"), [("EXUdense", 10, 1000), ("EigenSparse", 0, 1)])
def test_the_trees_dense_solver_loses_digits_where_inertias_differ(solver, least, most, monkeypatch):
    """By its inverse of M, as its bound has it; without that 375 and 0.03 rounding bounds, in rates."""
    real = exudyn_tree_engine.run_solver

    def run(one, mbs, settings, *more, **names):
        set_linear_solver(settings, solver)
        return real(one, mbs, settings, *more, **names)

    monkeypatch.setattr(exudyn_tree_engine, "run_solver", run)
    h = 1.8e-4
    case = ReproductionCase(*light_and_heavy_balls(), until=h, steps=(h,))
    assert StepMeasure(EngineClient("exudyn-tree"), "RK44")(case).ratio <= 1
    monkeypatch.setattr(rounding_bound, "INVERSE_SHARE", 0.0)
    assert least <= StepMeasure(EngineClient("exudyn-tree"), "RK44")(case).ratio <= most
