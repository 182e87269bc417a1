"""The step level: the formulas, honest engines on random pendulums, and planted integrators."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from unittest.mock import patch

import numpy as np
import pytest

from plumbline.engines.engine_calls import StepAttempt, StepEvaluation, run_steps
from plumbline.engines.no_answer import NoAnswer
from plumbline.engines.registry import load_adapter
from plumbline.execution.plan import Plan, TaskKind, task_keys
from plumbline.judging.rows import RowContext, Verdict
from plumbline.judging.step_level import judge_steps
from plumbline.measurements.single_steps import STEP_STATES, run_step_study, step_sizes
from plumbline.model.datatypes import BALL, FREE, KINDS, ROD, SPRING_FIELDS, Unsupported
from plumbline.model.kinematics import complete_state, quaternion_exponential, quaternion_product
from plumbline.model.loops import STABILISATION
from plumbline.model.random_mechanisms import random_loop_mechanism
from plumbline.model.sampling import random_states
from plumbline.model.step_methods import TABLEAUS, ConstrainedMethod, JointSpaceMethod, classical_runge_kutta
from plumbline.scenario.generator import RandomScenarios, random_scenario
from plumbline.scenario.loader import load_scenarios
from plumbline.truth import step_comparison, step_formulas
from plumbline.truth.certified_state import certify_state
from plumbline.truth.step_charts import StepCharts
from plumbline.truth.step_comparison import step_counts
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario, states_of
from tests.helpers.nightly_tests import SLOW, nightly, some_fast
from tests.helpers.pendulums import JOINT_PATTERNS
from tests.helpers.pinocchio_by_crba import steps_by_crba
from tests.helpers.planted_steps import STEP_DEFECTS, stale_velocity, step_defect, velocity_verlet
from tests.helpers.planting import Defect, planted
from tests.helpers.random_chains import tree_from_seed
from tests.helpers.requirements import require_engines, require_extended_precision
from tests.helpers.shared_answers import by_content

require_engines()
require_extended_precision()

ENGINES = ("mujoco", "pinocchio", "exudyn", "exudyn-tree")
CONTEXT = RowContext("steps", "test", "engine", "engine", "0")


def methods(engine):
    return [i for i in load_adapter(engine).integrators if i.method is not None]


def stepped(adapter, integrator, model, states):
    """Steps of an adapter, whatever it steps with."""
    sizes, counts = (
        step_sizes(isinstance(integrator.method, ConstrainedMethod), model, states),
        step_counts(integrator.method),
    )
    with patch("plumbline.engines.engine_calls.load_adapter", lambda _: adapter):
        return run_steps(adapter.name, integrator.name, model, states, sizes, counts)


def rows_of(integrator, model, states, answer):
    return judge_steps(CONTEXT, integrator, model, states, answer).rows


def judged(adapter, integrator, model, states):
    """Rows of an adapter's steps, judged by the integrator's declared method."""
    return rows_of(integrator, model, states, stepped(adapter, integrator, model, states))


@pytest.mark.parametrize(("engine", "name"), [("mujoco", "RK4"), ("pinocchio", "semi-implicit-euler")])
def test_steps_of_bodies_without_inertia_are_judged(engine, name):
    scenario, adapter = catalogue_scenario("point-mass-arm"), load_adapter(engine)
    states = [scenario.state, *random_states(scenario.model, 1, 1)]
    rows = judged(adapter, adapter.integrator(name), scenario.model, states)
    assert len(rows) == 4 and all(row.verdict == Verdict.AGREES for row in rows)


@cache
def subject(joints, has_drag=False, loads=False):
    model = pendulums.make_model(joints, loads=loads, drag=has_drag)
    return model, random_states(model, STEP_STATES, seed=5)


def disagreeing(rows):
    return {row.quantity: row.ratio for row in rows if row.verdict != Verdict.AGREES}


def checked_charts(model, states, atol, **options):
    """Charts whose accelerations equal the certified ones within a part of the largest of their kind.

    In a planar loop those of one kind may be 0, so that the larger ones of both count.
    """
    charts = StepCharts(model, JointSpaceMethod("Runge-Kutta", "joint rotations", 0.2, **options), states)
    found = charts.body_accelerations()
    for i, state in enumerate(states):
        true = certify_state(model, state).quantities
        exact = true.acceleration, true.angular_acceleration
        sizes = [np.max(np.abs(x)) for x in exact]
        for value, one, size in zip(found, exact, sizes, strict=True):
            limit = atol * (max(sizes) if model.has_loops else size)
            np.testing.assert_allclose(value[i].astype(float), one, rtol=0, atol=limit)
    return charts


@pytest.mark.parametrize("joints", list(JOINT_PATTERNS))
def test_accelerations_equal_the_certified_ones(joints):
    model, states = subject(joints, True, True)
    checked_charts(model, states[:1], 4e-16)
    found = step_formulas.first_coordinate_acceleration(model, states[0])
    true = certify_state(model, states[0]).quantities.acceleration
    limit = 4e-16 * np.max(np.abs(true))
    np.testing.assert_allclose(found[:, :3].astype(float), true, rtol=0, atol=limit)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("joints", ["ball", "rod", "balls", "rods", "rod-ball", "ball-rod", "mixed"])
def test_honest_engines_take_the_declared_step(engine, joints):
    model, states = subject(joints, True, True)
    for integrator in methods(engine):
        rows = judged(load_adapter(engine), integrator, model, states)
        assert not disagreeing(rows), [row.reason for row in rows]
        assert all(row.level == "step" and row.ratio < 1 for row in rows)


def test_places_are_bounded_by_what_is_lost_where_a_slow_turn_becomes_fast(monkeypatch):
    """Pinocchio divides 1 − cos t by the square of a stage's turn t; a moment makes the next rate larger."""
    model = replace(tree_from_seed(2, 1, (FREE,)), moment=np.array([[0.3, 0, 0.03]]))
    (state,), adapter = random_states(model, 1, seed=3), load_adapter("pinocchio")
    slow = [replace(state, omega=state.omega * share, v=state.v / 60) for share in (0.02, 0.005, 0.0015)]
    rows = judged(adapter, adapter.integrator("rkmk4"), model, slow)
    assert len(rows) == 4 and not disagreeing(rows), [row.reason for row in rows]
    nothing = step_comparison.Lost(np.zeros(1), np.zeros(1))
    monkeypatch.setattr(step_comparison, "_lost_in_closed_forms", lambda *_: nothing)
    wrong = disagreeing(judged(adapter, adapter.integrator("rkmk4"), model, slow))
    assert wrong.keys() == {"step_position"} and wrong["step_position"] > 100


def test_equations_of_a_branching_tree_of_rods_and_balls_are_compared():
    model = tree_from_seed(2, 4, (ROD, BALL))
    assert model.body[:, 0].tolist() == [-1, 0, 1, -1]
    states, adapter = random_states(model, 2, seed=3), load_adapter("exudyn")
    for integrator in methods("exudyn"):
        answer = stepped(adapter, integrator, model, states)
        rows = rows_of(integrator, model, states, answer)
        assert {"step_equations", "step_first_acceleration"} <= {row.quantity for row in rows}
        assert not disagreeing(rows), [row.reason for row in rows]
        lighter = replace(model, mass=model.mass * [1, 1, 1 - 1e-6, 1])
        wrong = disagreeing(rows_of(integrator, lighter, states, answer))
        assert wrong["step_equations"] > 1


@pytest.mark.parametrize("seed", [0, *nightly(range(1, 12))])
def test_equations_of_trees_on_other_joints_are_compared_where_these_are_together(seed):
    """By constraints on velocities joints part by as much as the step's error, and their forces turn."""
    kinds = [kind for kind in KINDS if kind != "helical"]  # which Exudyn lacks
    model = tree_from_seed(seed, 4, kinds)
    states, adapter = random_states(model, 2, seed=3), load_adapter("exudyn")
    axes = model.turn.copy()
    axes[1, 0] = quaternion_product(axes[1, 0], quaternion_exponential(np.full(3, 1e-7)))
    far = model.point.copy()
    far[1, 0] += 1e-8
    others = {"mass": model.mass * [1, 1, 1 - 1e-9, 1], "inertia": model.inertia * (1 + 1e-8)}
    if not model.kinds[1].holds_nothing:
        others["point"] = far
    if model.kinds[1].motions and not model.kinds[1].holds_distance:
        others["turn"] = axes
    for integrator in methods("exudyn"):
        answer = stepped(adapter, integrator, model, states)
        rows = rows_of(integrator, model, states, answer)
        assert not disagreeing(rows), [row.reason for row in rows]
        if integrator.method.constraint_level == "velocity":
            assert "step_equations" not in {row.quantity for row in rows}
            continue
        for name, value in others.items():
            rows = rows_of(integrator, replace(model, **{name: value}), states, answer)
            assert "step_equations" in disagreeing(rows), name


@cache
def defect_report(defect, loop=""):
    model, states = loop_subject(loop) if loop else subject(defect.mechanism, defect.loaded, defect.loaded)
    integrator = load_adapter(defect.engine).integrator(defect.integrator)
    with planted(defect) as adapter:
        return judged(adapter, integrator, model, states)


SHARED_STEPS = by_content(step_comparison.joint_space_steps)


@pytest.fixture
def shared_steps():
    """The declared steps of a mechanism are computed once for all planted ones."""
    with patch.object(step_comparison, "joint_space_steps", SHARED_STEPS):
        yield


@pytest.mark.usefixtures("shared_steps")
@pytest.mark.parametrize("defect", some_fast(STEP_DEFECTS, 4))
def test_every_other_integrator_is_reported(defect):
    rows = defect_report(defect)
    assert any(row.verdict == Verdict.DISAGREES for row in rows), [row.reason for row in rows]


@pytest.mark.usefixtures("shared_steps")
def test_the_planting_itself_is_honest():
    """The declared step, taken by the helpers that plant others, is not reported."""
    from tests.helpers import planted_steps as steps

    right = partial(steps.runge_kutta, a=steps.CLASSICAL, b=steps.WEIGHTS)
    honest = [
        replace(step_defect("rk4", engine, name, right), mechanism=joints)
        for engine, name in steps.RK4S for joints in ("balls", "rods")
    ]  # fmt: skip
    honest += [replace(step_defect("implicit", "mujoco", "implicit", steps.implicit), loaded=True)]
    honest += [Defect("as-declared", engine="exudyn", integrator=i.name) for i in methods("exudyn")]
    for defect in honest:
        rows = defect_report(defect)
        assert not disagreeing(rows), (defect, [row.reason for row in rows])


@pytest.mark.parametrize("engine", ["mujoco", "pinocchio"])
def test_a_rods_axial_inertia_is_a_part_of_the_method(engine):
    """It changes no motion, but steps on chains of rods: declared wrong, the step is not the declared one."""
    model, states = subject("mixed")
    for integrator in methods(engine):
        wrong = replace(integrator.method, rod_axial_inertia=2 * integrator.method.rod_axial_inertia)
        rows = judged(load_adapter(engine), replace(integrator, method=wrong), model, states)
        assert disagreeing(rows), integrator.name
        single, at = subject("rod")
        assert not disagreeing(judged(load_adapter(engine), replace(integrator, method=wrong), single, at))


def test_a_weight_wrong_by_1e_minus_9_is_reported_on_one_body():
    model, states = subject("ball")
    method = classical_runge_kutta("joint rotations", 0.01 / 3)
    weights = (1 / 6, 1 / 3 + 1e-9, 1 / 3 - 1e-9, 1 / 6)
    integrator = replace(load_adapter("mujoco").integrator("RK4"), method=replace(method, weights=weights))
    assert disagreeing(judged(load_adapter("mujoco"), integrator, model, states))


def test_an_engine_that_refuses_or_fails_has_one_row():
    model, states = subject("balls")
    integrator = load_adapter("exudyn-tree").integrator("RK44")
    refused = StepEvaluation([StepAttempt(0, 0.01, refusal=NoAnswer("angles are singular", True))], 0.1)
    (row,) = rows_of(integrator, model, states, refused)
    assert (row.verdict, row.quantity, row.reason) == (Verdict.UNSUPPORTED, "all", "angles are singular")
    failed = StepEvaluation([StepAttempt(0, 0.01, failure=NoAnswer("it crashed", False, place="in f"))], 0.1)
    (row,) = rows_of(integrator, model, states, failed)
    assert (row.verdict, row.reason, row.extra["place"]) == (Verdict.FAILED, "it crashed", "in f")


def test_rows_count_the_runs_that_were_compared_and_name_refusals():
    (model, states), adapter = subject("balls"), load_adapter("pinocchio")
    integrator, right = adapter.integrator("rkmk4"), type(adapter).step

    def refusing(self, model, state, integrator, step, count):
        if state is states[1] and count > 1:
            raise Unsupported("no more steps")
        return right(self, model, state, integrator, step, count)

    all_runs = 2 * len(states)
    with patch.object(type(adapter), "step", refusing):
        rows = judged(adapter, integrator, model, states)
    said = f"in {all_runs - 2} of {all_runs} runs of 10 steps; the engine refused 2 of them: no more steps"
    assert len(rows) == 4 and all(row.reason.endswith(said) for row in rows)
    with patch.object(step_comparison, "MAX_GROWTH", 1 + 1e-9):
        rows = judged(adapter, integrator, model, states)
    assert all(row.reason.endswith(f" of {all_runs} runs of 10 steps") for row in rows)
    assert not any(f" {all_runs} of {all_runs} runs" in row.reason for row in rows)


def test_a_loose_bound_of_first_accelerations_proves_nothing():
    (model, states), adapter = subject("rod"), load_adapter("exudyn")
    integrator, own = adapter.integrator("trapezoidal"), step_comparison.first_acceleration_bound
    for factor, verdict in ((1, Verdict.AGREES), (1e4, Verdict.UNRESOLVED)):
        wider = partial(lambda factor, *given: factor * own(*given), factor)
        with patch.object(step_comparison, "first_acceleration_bound", wider):
            rows = judged(adapter, integrator, model, states)
        (row,) = (row for row in rows if row.quantity == "step_first_acceleration")
        assert row.verdict == verdict, row


@pytest.mark.parametrize("draw", [(601, 0), (601, 141), (802, 82)])
def test_first_accelerations_are_wrong_by_what_finite_differences_leave(draw):
    """The error grows with the conditioning: 1.1e-5 of the largest in random-601-141, 1e-7 in most chains.

    In random-802-82 all entries of C that meet a rate are 0 at the first state, not those of its derivative.
    """
    scenario = random_scenario(*draw)
    model, states = scenario.model, [scenario.state, *random_states(scenario.model, STEP_STATES - 1, seed=1)]
    integrator = load_adapter("exudyn").integrator("trapezoidal")
    answer = stepped(load_adapter("exudyn"), integrator, model, states)

    def first_row():
        rows = rows_of(integrator, model, states, answer)
        return next(row for row in rows if row.quantity == "step_first_acceleration")

    first = first_row()
    assert first.verdict == Verdict.AGREES
    assert 1e-3 < first.ratio < 0.5, "the bound is that of other differences"
    largest = max(np.max(np.abs(a.run.coordinate_acceleration[0])) for a in answer.attempts)
    for attempt in answer.attempts:
        attempt.run.coordinate_acceleration[0] += 1e-4 * largest
    assert first_row().verdict == Verdict.DISAGREES


@pytest.mark.parametrize("joints", ["rods", "mixed"])
def test_a_coarser_step_is_taken_from_slower_states_only(joints):
    model, states = subject(joints)
    method = load_adapter("mujoco").integrator("RK4").method
    slow = replace(states[0], omega=0 * states[0].omega, udot=0 * states[0].udot, v=0 * states[0].v)
    fast = replace(states[0], omega=50 * np.ones_like(states[0].omega))
    of_fast, of_slow = (
        max(sizes) for sizes in step_sizes(isinstance(method, ConstrainedMethod), model, [fast, slow])
    )
    assert of_fast < 0.2 * of_slow <= 0.2 * 0.0237


RANDOM_COUNT = 100


@pytest.mark.full
@pytest.mark.parametrize(
    ("engine", "name"), [(engine, one.name) for engine in ENGINES for one in methods(engine)]
)
def test_no_honest_engine_is_reported_on_random_scenarios(engine, name):
    """Of wild masses Exudyn's dense solver loses digits; where Pinocchio's aba does, crba has to agree."""
    reported = {}

    def alarms(adapter, integrator, model, states):
        rows = judged(adapter, integrator, model, states)
        return [row.reason for row in rows if row.verdict in (Verdict.DISAGREES, Verdict.FAILED)]

    for scenario in RandomScenarios(12, RANDOM_COUNT):
        states = [scenario.state, *random_states(scenario.model, STEP_STATES - 1, seed=1)]
        is_wild = "wild" in scenario.title and engine == "exudyn-tree"
        adapter = load_adapter(engine)
        integrator = adapter.integrator(name)
        bad = alarms(adapter, integrator, scenario.model, states)
        if bad and engine == "pinocchio":
            with steps_by_crba(adapter):
                bad = alarms(adapter, integrator, scenario.model, states)
        if bad and not is_wild:
            reported[scenario.name] = bad
    assert not reported


# --- trees ---------------------------------------------------------------------------------------

ELEMENTS = ("armature", "damping", "stiffness", "effort", "springs")


@cache
def tree(seed, elements=ELEMENTS, missing=()):
    """A random tree on every kind of joint but some, with elements on those that take them."""
    kinds = [kind for kind in KINDS if kind not in missing]
    model = tree_from_seed(seed, 7, kinds, elements=elements)
    return model, random_states(model, 2, seed=5)


@pytest.mark.parametrize("free", ["point and rotation", "rigid motion"])
@pytest.mark.parametrize("seed", [0, *nightly(range(1, 4))])
@pytest.mark.parametrize("kinds", [tuple(KINDS), ("slide", "ball", "rod")], ids=["every joint", "slides"])
def test_accelerations_of_trees_equal_the_certified_ones(seed, free, kinds):
    model = tree_from_seed(seed, 7, kinds, elements=ELEMENTS)
    states = random_states(model, 2, seed=5)
    links = checked_charts(model, states, 1e-15, free_coordinates=free)
    start = links.bodies(*links.start())
    for i, state in enumerate(states):
        for name in ("r", "v", "omega"):
            value = getattr(state, name)
            scale = max(1.0, np.max(np.abs(value)))
            np.testing.assert_allclose(getattr(start, name)[i].astype(float), value, atol=1e-14 * scale)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("elements", [(), ELEMENTS], ids=["bare", "elements"])
@pytest.mark.parametrize("seed", range(2))
def test_honest_engines_take_the_declared_step_on_trees(engine, elements, seed):
    # a joint that Exudyn lacks, and whose steps in MuJoCo have no formula
    missing = ("helical",) if engine.startswith(("exudyn", "mujoco")) else ()
    model, states = tree(seed, elements, missing)
    for integrator in methods(engine):
        rows = judged(load_adapter(engine), integrator, model, states)
        if engine.startswith("exudyn") and rows[0].verdict == Verdict.UNSUPPORTED:
            assert any(x in rows[0].reason for x in ("rotor", "rotation vector", "spring", "angles"))
            continue
        assert not disagreeing(rows), [row.reason for row in rows]


def branches():
    """Two hinged branches on a sliding body, a damper between them, and a free body."""
    model = tree_from_seed(2, 4, ("hinge",), elements=("damping", "stiffness", "springs"))
    body = np.array([[-1, 0], [0, 1], [0, 2], [-1, 3]])
    springs = {name: getattr(model, name)[:1] for name in SPRING_FIELDS}
    used = np.array([[1, 0], [1, 0], [1, 0], [0, 0]])
    model = replace(
        model, kind=("slide", "hinge", "hinge", "free"), body=body, point=0.2 + 0.1 * model.point,
        damping=0.7 * used, stiffness=2.0 * used, armature=0.0 * used, effort=0.0 * used,
        **(springs | {"spring_body": np.array([[1, 2]]), "spring_damping": np.array([0.8])}),
    )  # fmt: skip
    return model, random_states(model, 3, seed=8)


WRONG_METHODS = {
    "damping explicit for implicit": ("mujoco", "Euler", {"implicit_forces": "none"}),
    "damping implicit for explicit": (
        "pinocchio", "semi-implicit-euler", {"implicit_forces": "joint dampers"},
    ),
    "springs' damping implicit": ("mujoco", "Euler", {"implicit_forces": "applied"}),
    "without Coriolis terms": ("mujoco", "implicit", {"implicit_forces": "applied"}),
    "half the damping": ("mujoco", "implicitfast", {"damping_factor": 0.5}),
    "halves exchanged": ("mujoco", "implicitfast", {"formula": "positions first"}),
    "stale velocity": ("pinocchio", "semi-implicit-euler", {"new_velocity_share": 0.0}),
    "a hinge moved by the old velocity": ("mujoco", "Euler", {"stale_joint": 1}),
    "a free body moved along its twist": ("mujoco", "RK4", {"free_coordinates": "rigid motion"}),
    "a free body moved by point and rotation": (
        "pinocchio", "rkmk4", {"free_coordinates": "point and rotation"},
    ),
    "no correction of rotations": ("pinocchio", "rkmk4", {"correction_terms": 0}),
}  # fmt: skip


@pytest.mark.usefixtures("shared_steps")
@pytest.mark.parametrize("name", some_fast(list(WRONG_METHODS), 4))
def test_every_other_step_of_a_tree_is_reported(name):
    """The same as an engine that takes the other step where the right one is declared."""
    engine, integrator, change = WRONG_METHODS[name]
    model, states = branches()
    method = load_adapter(engine).integrator(integrator)
    assert not disagreeing(judged(load_adapter(engine), method, model, states))
    wrong = replace(method, method=replace(method.method, **change))
    assert disagreeing(judged(load_adapter(engine), wrong, model, states))


@pytest.mark.parametrize(
    "field", ["rest", "stiffness", "damping", "spring_length", "spring_damping", "point"]
)
@pytest.mark.parametrize("engine", ["mujoco", *nightly(("pinocchio", "exudyn-tree"))])
def test_a_wrong_number_of_a_tree_is_reported_by_its_steps(engine, field):
    model, states = branches()
    integrator = methods(engine)[-1]
    answer = stepped(load_adapter(engine), integrator, model, states)
    wrong = replace(model, **{field: getattr(model, field) * (1 + 1e-6) + 1e-6 * (field == "rest")})
    states = [complete_state(wrong, state) for state in states]
    assert disagreeing(rows_of(integrator, wrong, states, answer))


def test_dampers_between_branches_are_explicit():
    """D has the sparsity of M: a formula whose D has all entries is not MuJoCo's."""
    model, states = branches()
    integrator = load_adapter("mujoco").integrator("implicit")
    with patch.object(StepCharts, "_on_one_path", lambda self: np.ones((self.nv, self.nv), bool)):
        assert disagreeing(judged(load_adapter("mujoco"), integrator, model, states))
    with patch.object(StepCharts, "_standalone_columns", lambda _: []):
        fast = load_adapter("mujoco").integrator("implicitfast")
        assert disagreeing(judged(load_adapter("mujoco"), fast, model, states))


def test_a_body_welded_to_a_free_one_is_part_of_it():
    """MuJoCo's implicitfast: D has all forces of a free body with another welded, not hinged, to it."""
    engine, model = load_adapter("mujoco"), branches()[0]
    body = np.array([[-1, 0], [0, 1], [-1, 2], [2, 3]])
    for kind in ("weld", "hinge"):
        used = np.array([[1, 0], [1, 0], [0, 0], [int(kind == "hinge"), 0]])
        pair = replace(
            model, kind=("slide", "hinge", "free", kind), body=body, damping=0.7 * used, stiffness=2.0 * used
        )
        states = random_states(pair, 3, seed=9)
        assert not disagreeing(judged(engine, engine.integrator("implicitfast"), pair, states))


# --- loops ---------------------------------------------------------------------------------------

LOOPS = ("four-bar", "slider-crank", "flyball-governor", "squeezer", "four-bars-2")


@cache
def loop_subject(name):
    scenario = catalogue_scenario(name)
    return scenario.model, states_of(scenario, 1)


@pytest.mark.parametrize("name", [*LOOPS[:3], *nightly(LOOPS[3:])])
def test_accelerations_of_loops_equal_the_certified_ones(name):
    """At the closed states, where a correction of gaps acts on what rounding leaves open only."""
    checked_charts(*loop_subject(name), 1e-12)


def test_accelerations_of_generic_loops_equal_the_certified_ones():
    """A loop in space, on any joints and with elements, whose rows do not depend on others."""
    model, state = random_loop_mechanism(3, 6, ("universal",), elements=ELEMENTS)
    checked_charts(model, [state], 1e-12, free_coordinates="rigid motion")


@pytest.mark.parametrize("engine", ["mujoco", "pinocchio", "exudyn"])
@pytest.mark.parametrize("name", [LOOPS[0], *nightly(LOOPS[1:])])
def test_honest_engines_take_the_declared_step_on_loops(name, engine):
    model, states = loop_subject(name)
    for integrator in methods(engine):
        rows = judged(load_adapter(engine), integrator, model, states)
        assert len(rows) == (1 if engine == "exudyn" else 4)
        assert all(row.verdict == Verdict.AGREES and row.ratio < 0.5 for row in rows), rows


def loop_defects():
    """Steps that need no dexp⁻¹ of theirs, and Exudyn's that are seen in the quadrature."""
    for one in STEP_DEFECTS:
        is_step = one.engine == "pinocchio" and one.integrator == "semi-implicit-euler"
        is_seen = one.engine == "exudyn" and one.name not in (
            "trapezoidal-index-3", "first-accelerations-zero", "first-accelerations-zero-alpha",
        )  # fmt: skip
        if is_seen or (is_step and not one.name.startswith(("first-order-quaternion", "last-joint"))):
            yield one
    yield step_defect("explicit-for-rk4", "pinocchio", "rkmk4", stale_velocity)
    yield step_defect("verlet-for-rk4", "pinocchio", "rkmk4", velocity_verlet)


@pytest.mark.usefixtures("shared_steps")
@pytest.mark.parametrize("defect", some_fast(list(loop_defects()), 5))
def test_every_other_integrator_of_a_loop_is_reported(defect):
    rows = defect_report(defect, "four-bar")
    assert any(row.verdict == Verdict.DISAGREES for row in rows), [row.reason for row in rows]


WRONG_LOOP_METHODS = {
    "no correction of gaps": ("semi-implicit-euler", {"gap_correction": 0.0}),
    "a correction wrong by 1e-6": ("rkmk4", {"gap_correction": 50 * (1 + 1e-6)}),
    "weights wrong by 1e-6": ("rkmk4", {"weights": (1 / 6, 1 / 3 + 1e-6, 1 / 3 - 1e-6, 1 / 6)}),
    "stale velocity": ("semi-implicit-euler", {"new_velocity_share": 0.0}),
    "gaps in the other engine's form": ("rkmk4", {"gap_form": "distance and quaternion"}),
}
IN_MUJOCO = {"semi-implicit-euler": "implicit", "rkmk4": "RK4"}


@pytest.mark.parametrize(
    ("name", "engine"),
    [
        pytest.param(x, engine, marks=SLOW * ("by 1e-6" not in x))
        for x in WRONG_LOOP_METHODS for engine in ("mujoco", "pinocchio")
    ],
)  # fmt: skip
def test_every_other_step_of_a_loop_is_reported(name, engine):
    integrator, change = WRONG_LOOP_METHODS[name]
    model, states = loop_subject("four-bar")
    if engine == "mujoco":
        other = {"gap_form": "logarithm"} if "gap_form" in change else {}
        integrator, change = IN_MUJOCO[integrator], change | other
    method = load_adapter(engine).integrator(integrator)
    wrong = replace(method, method=replace(method.method, **change))
    assert disagreeing(judged(load_adapter(engine), wrong, model, states))


@pytest.mark.parametrize("name", ["sprung-helical", pytest.param("helical-screw", marks=SLOW)])
def test_steps_of_a_slide_that_is_held_at_a_pitch_are_compared(name):
    model, states = loop_subject(name)
    pitched = np.array([kind.has_pitch for kind in model.kinds])
    steeper = replace(model, length=np.where(pitched, model.length * (1 + 1e-9), model.length))
    for integrator in methods("mujoco")[-2:]:
        answer = run_step_study("mujoco", integrator, model, states[:2])
        rows = rows_of(integrator, model, states[:2], answer)
        assert {row.verdict for row in rows} == {Verdict.AGREES} and len(rows) > 8, rows
        assert disagreeing(rows_of(integrator, steeper, states[:2], answer))


def assert_sharp(integrator, model, states, answer, factors):
    """The steps agree, and those of bodies that are heavier by the factors do not."""
    assert not disagreeing(rows_of(integrator, model, states, answer))
    heavier = replace(model, mass=model.mass * factors)
    assert disagreeing(rows_of(integrator, heavier, states, answer))


@pytest.mark.parametrize(
    ("name", "engine", "factors"),
    [
        ("four-bars-2", "mujoco", 1 + 1e-9 * np.arange(5)),
        ("flyball-governor", "pinocchio", [1, 1, 1, 1 + 2e-10]),  # in the mass of the governor's sleeve
        pytest.param("flyball-governor", "mujoco", [1, 1, 1, 1 + 2e-10], marks=SLOW),
    ],
)
def test_a_small_mistake_is_reported_in_every_step_of_a_loop(name, engine, factors):
    """Where a singular pose is on the way, MuJoCo's limit is uncertain by 0.2 m/s in a few steps."""
    model, states = loop_subject(name)
    integrator = (
        methods(engine)[0] if name == "flyball-governor" else load_adapter(engine).integrator("implicit")
    )
    run = replace(run_step_study(engine, integrator, model, states[:1]), attempts=[])
    assert_sharp(integrator, model, states[:1], run, factors)


def test_every_step_of_a_run_of_a_loop_is_compared_with_what_the_limit_is_uncertain_by():
    model, states = loop_subject("slider-crank")
    integrator = load_adapter("mujoco").integrator("implicit")
    answer = run_step_study("mujoco", integrator, model, states[:1])
    limit = answer.run.run.limit_error
    assert np.all(limit[1:] > 0) and np.max(limit) < 1e-11
    assert_sharp(integrator, model, states[:1], answer, [1 + 1e-7, 1, 1])


@pytest.mark.parametrize(
    ("name", "engine", "words"),
    [
        ("bricard", "pinocchio", "not compared: rows of the loops"),
        ("bricard", "mujoco", "not compared: rows of the loops"),
    ],
)
def test_steps_that_have_no_formula_say_why(name, engine, words):
    model, states = loop_subject(name)
    (row,) = judged(load_adapter(engine), methods(engine)[0], model, states)
    assert words in row.reason and row.verdict in (Verdict.UNSUPPORTED, Verdict.INFORMATION)


def test_forces_that_do_not_depend_on_the_motion_have_the_rate_zero():
    model = tree_from_seed(0, 2, ("slide",), loads=False)
    assert step_formulas.fastest_rates(model, random_states(model, 1, 0)) == 0


def test_steps_of_loops_are_small_enough_to_close_gaps():
    model, states = loop_subject("slider-crank")
    slow_states = [replace(s, omega=0 * s.omega, v=0 * s.v, xdot=0 * s.xdot) for s in states]
    sizes = step_sizes(False, model, slow_states)
    assert all(h[1] <= 0.5 / STABILISATION and h[0] < h[1] for h in sizes)
    assert all(np.log2(h) % 1 for pair in sizes for h in pair), "powers of two"


@pytest.mark.parametrize("name", [name for name in TABLEAUS if "first slope" not in name])
def test_tableaus_have_the_order_in_their_names(name):
    stages, weights = TABLEAUS[name]
    order = int(name.split("order ")[1].rstrip(")")) if "order" in name else 4

    def end(count):
        y, h = np.array([1.0, 0.5], np.longdouble), np.longdouble(1) / count
        for _ in range(count):
            k = list[np.ndarray]()
            for row in stages:
                x, v = y + h * sum((np.longdouble(a) * b for a, b in zip(row, k, strict=True)), 0 * y)
                k.append(np.array([v, -np.sin(x) - x * v * v]))
            y = y + h * sum(np.longdouble(w) * b for w, b in zip(weights, k, strict=True))
        return y

    differences = [np.linalg.norm((end(n) - end(2 * n)).astype(float)) for n in (16, 32)]
    assert abs(np.log2(differences[0] / differences[1]) - order) < 0.4


def test_integrators_without_motions_get_steps_of_the_plainest_scenarios_and_no_other_task():
    scenarios = load_scenarios(["planar-top", "long-hinge"])
    alone = {i.name for i in load_adapter("exudyn-tree").integrators if not i.has_motions}
    engines = {"exudyn-tree": load_adapter("exudyn-tree").describe()}
    assert {key.kind for key in task_keys("s", engines, "all") if key.integrator in alone} == {TaskKind.STEP}
    assert not [k for k in task_keys("s", engines, "all", has_other_steps=False) if k.integrator in alone]
    plan = Plan(scenarios, ["exudyn-tree"], has_all_studies=False)
    assert [plan.has_other_steps(s) for s in scenarios] == [False, True]
    assert replace(plan, has_all_studies=True).has_other_steps(scenarios[0])
