"""Rows of the surface: what engines report besides the state quantities, against the certified motion."""

import os
import signal
from copy import copy
from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio
import pytest

from adapters import exudyn_surface, mujoco_surface
from plumbline.engines.engine_calls import Evaluation, evaluate_states, evaluate_variants, stack_answers
from plumbline.engines.missing_names import FAILED_PARTS, IS_APART, add_parts
from plumbline.engines.no_answer import NoAnswer
from plumbline.engines.registry import load_adapter
from plumbline.engines.surface import SURFACES
from plumbline.judging.findings import find_findings
from plumbline.judging.rows import RowContext, Verdict, most_wrong_call
from plumbline.judging.state_level import judge_variants
from plumbline.judging.surface_rows import judge_surface
from plumbline.model.datatypes import Unsupported
from plumbline.model.kinematics import complete_state, quaternion_product, rotation_matrix
from plumbline.model.sampling import random_states
from plumbline.studies.exercised_names import exercised_names
from plumbline.truth.ground_truth import StateTruth, state_truth
from plumbline.truth.surface_truth import SURFACE_QUANTITIES, SurfaceTruth
from tests.helpers.catalogue import catalogue_scenario, states_of
from tests.helpers.planted_functions import LOOP_PLANTS, SURFACE_PLANTS, VARIANT_PLANTS, wrong_functions
from tests.helpers.random_chains import tree_from_seed

WHO = RowContext("s", "f", "e", "The engine", "0")
KINDS = ("rod", "ball", "hinge", "slide", "cylindrical", "free", "weld")
RECORDED = {name for name in SURFACE_QUANTITIES if name.endswith("_of_composite_joints")}  # pinocchio
# the same, of every mechanism that is asked for it
WRONG = {
    "exudyn": {
        "body_velocity_by_tangent_operator",
        "frame_angular_velocity_from_start",
        "frame_axes_by_whole_turns",
    }
}


def mechanism(kinds, seed=5, bodies=4):
    model = tree_from_seed(seed, bodies, kinds)
    return model, random_states(model, 3, seed)


@pytest.fixture(scope="module")
def tree():
    model, states = mechanism(KINDS, bodies=7)
    return model, states, state_truth(model, states)


def answers_of(engine, model, states):
    return stack_answers(load_adapter(engine).surface(model, states))


def verdicts(truth, answers):
    rows = judge_surface(WHO, truth, Evaluation([], surface=answers))
    return {row.quantity: row.verdict for row in rows}


def assert_all_but_wrong_agree(engine, found):
    wrong = {name for name, verdict in found.items() if verdict != Verdict.AGREES}
    assert len(found) >= 10 and wrong == WRONG.get(engine, set()) & set(found), found


def assert_changes_are_seen(truth, answers):
    """Relative ones of 1e-6."""
    more = {name: {call: x * (1 + 1e-6) for call, x in calls.items()} for name, calls in answers.items()}
    assert set(verdicts(truth, more).values()) == {Verdict.DISAGREES}


def assert_agree(rows):
    assert {row.verdict for row in rows} == {Verdict.AGREES}, [row.reason for row in rows]


def rows_of_variants(truth, variants):
    return judge_variants(WHO, truth, Evaluation([], variants=variants))


@pytest.fixture(scope="module")
def few_bodies():
    model, states = mechanism(("rod", "ball"), bodies=2)
    return model, states, state_truth(model, states)


@pytest.mark.parametrize(
    ("engine", "given"), [*((name, "tree") for name in SURFACES), ("exudyn", "few_bodies")]
)
def test_every_call_agrees_and_a_relative_change_of_1e_6_is_seen(engine, given, request):
    model, states, truth = request.getfixturevalue(given)
    answers = answers_of(engine, model, states)
    found = verdicts(truth, answers)
    assert_all_but_wrong_agree(engine, found)
    calls = {name for by_call in answers.values() for call in by_call for name in call}
    evaluation = Evaluation([], surface=answers)
    assert set(exercised_names(truth, evaluation)) == calls


@pytest.fixture(scope="module")
def red_surface_rows(tree, few_bodies):
    """Return what lists the rows of an engine that do not agree."""

    def red(engine):
        model, states, truth = few_bodies if engine == "exudyn" else tree
        found = verdicts(truth, answers_of(engine, model, states))
        return {name for name, verdict in found.items() if verdict != Verdict.AGREES}

    return red


@pytest.mark.parametrize(
    ("engine", "plants"),
    [
        pytest.param(engine, plants, id=f"{engine}-{'-'.join(plants)}")
        for engine, some in SURFACE_PLANTS.items()
        for plants in some
    ],
)
def test_a_wrong_function_of_an_engine_is_seen(engine, plants, red_surface_rows):
    with wrong_functions(engine, plants):
        assert red_surface_rows(engine) - WRONG.get(engine, set())


@pytest.fixture(scope="module")
def moving_parts():
    """Trees without loads and with elements, and a loop."""
    bare = tree_from_seed(2, 3, ("hinge", "ball", "free"), loads=False)
    sprung = tree_from_seed(2, 4, ("hinge", "slide", "ball"), elements=("stiffness", "damping", "effort"))
    loop = catalogue_scenario("slider-crank")
    states = [random_states(bare, 2, 2), random_states(sprung, 2, 2), states_of(loop, 2)[:1]]
    models = bare, sprung, loop.model
    return {
        name: (model, own, state_truth(model, own))
        for name, model, own in zip(("bare", "sprung", "loop"), models, states, strict=True)
    }


@pytest.mark.parametrize(
    ("given", "name", "plants"),
    [
        pytest.param(given, name, plants, id=f"{name}-{'-'.join(plants)}-{number}")
        for given, some in (("tree", VARIANT_PLANTS), ("loop", LOOP_PLANTS))
        for number, (name, plants) in enumerate(some)
    ],
)
def test_a_wrong_function_is_seen_by_the_variant_of_its_name(given, name, plants, moving_parts):
    if given == "tree":
        given = "bare" if name.startswith(("mjtDisableBit", "mjtSleep")) else "sprung"
    model, states, truth = moving_parts[given]
    adapter = copy(load_adapter("mujoco"))
    adapter.variants = [one for one in adapter.variants if name in one.names]
    assert_agree(rows_of_variants(truth, evaluate_variants(adapter, model, states)))
    with wrong_functions("mujoco", plants):
        rows = rows_of_variants(truth, evaluate_variants(adapter, model, states))
    assert {row.verdict for row in rows} & {Verdict.DISAGREES, Verdict.FAILED}


def test_mujocos_frames_leave_a_body_at_the_origin_there():
    s = catalogue_scenario("free-top")
    adapter, states = copy(load_adapter("mujoco")), states_of(s, 2)
    adapter.variants = [one for one in adapter.variants if "MjsFrame" in one.names]
    assert_agree(rows_of_variants(state_truth(s.model, states), evaluate_variants(adapter, s.model, states)))


def test_exudyns_sum_of_two_sensors_tells_them_apart(few_bodies, monkeypatch):
    model, states, truth = few_bodies
    weighted = exudyn_surface.weighted_sum
    exchanged = lambda mbs, t, sensors, *rest: weighted(mbs, t, sensors[::-1], *rest)  # noqa: E731
    monkeypatch.setattr(exudyn_surface, "weighted_sum", exchanged)
    assert verdicts(truth, answers_of("exudyn", model, states))["frame_velocity"] == Verdict.DISAGREES


def test_what_exudyn_is_asked_once_is_asked_until_something_turns(few_bodies):
    model, states, _ = few_bodies
    still = replace(states[0], v=0 * states[0].v, omega=0 * states[0].omega, xdot=0 * states[0].xdot)
    answers = load_adapter("exudyn").surface(model, [complete_state(model, still), *states[:2]])
    asked = ["degrees_of_freedom" in answer for answer in answers]
    assert asked == [True, True, False]


def test_exudyns_solvers_and_items_are_compared_on_few_bodies(few_bodies):
    model, states, truth = few_bodies
    answers = answers_of("exudyn", model, states)
    calls = {name for by_call in answers.values() for call in by_call for name in call}
    assert {"NewtonSettings.residualMode", "SolveStatic", "itemInterface.RigidBody2D"} <= calls
    found = verdicts(truth, answers)
    assert "failed parts" not in answers and found["degrees_of_freedom"] == Verdict.AGREES
    assert WRONG["exudyn"] <= found.keys()
    assert truth.surface["degrees_of_freedom"].value[0, 0, 0] == 3 * model.n + 2 * sum(model.rods)


def test_angles_near_their_singularity_are_allowed_the_digits_that_they_lose():
    model, states = mechanism(("ball",), bodies=1)
    half = np.arcsin(1.0 - 1e-8) / 2  # the middle of three angles
    state = replace(states[0], p=np.array([[np.cos(half), 0.0, np.sin(half), 0.0]]))
    surface = state_truth(model, [complete_state(model, state)]).surface
    lost = surface["frame_axes_by_angles"].tolerance / surface["frame_axes"].tolerance
    assert np.all((lost > 5e3) & (lost < 1e4))


@pytest.mark.parametrize(
    ("engine", "speed", "rate", "way"),
    [
        ("mujoco", 1e4, 1.0, ("inverse_dynamics", "mj_implicit")),  # a change of velocity over a step
        (
            "pinocchio",
            1.0,
            1e3,
            ("gravity_energy_second_rate_by_derivative", "computeStaticTorqueDerivatives"),
        ),  # by the origin
    ],
)
def test_free_bodies_at_high_speeds_and_rates_are_within_the_bound(engine, speed, rate, way):
    model, states = mechanism(("free",), bodies=1)
    r, v, omega = (x / np.linalg.norm(x) for x in (states[0].r, states[0].v, states[0].omega))
    state = complete_state(model, replace(states[0], r=3 * r, v=speed * v, omega=rate * omega))
    quantity, name = way
    answers = {quantity: answers_of(engine, model, [state])[quantity]}
    assert any(name in call for call in answers[quantity])
    assert verdicts(state_truth(model, [state]), answers) == {quantity: Verdict.AGREES}


@pytest.mark.parametrize("engine", SURFACES)
def test_places_near_the_origin_of_a_long_mechanism_are_within_their_bounds(engine):
    model, _ = mechanism(("ball",), bodies=2)
    model = replace(model, point=model.point * np.array([[[1e-3], [1e-3]], [[1e-3], [1e3]]]))
    states = random_states(model, 3, 1)
    found = verdicts(state_truth(model, states), answers_of(engine, model, states))
    wrong = {name for name, verdict in found.items() if verdict == Verdict.DISAGREES}
    assert wrong == WRONG.get(engine, set()) & set(found), wrong


@pytest.mark.parametrize("engine", SURFACES)
def test_the_velocity_of_a_body_that_turns_about_its_centre_is_zero_within_its_bound(engine):
    model, _ = mechanism(("ball",), seed=1, bodies=3)
    model = replace(model, point=model.point * np.array([0.0, 1.0, 1.0])[:, None, None])
    states = random_states(model, 3, 1)
    truth, answers = state_truth(model, states), answers_of(engine, model, states)
    names = {name for name in ("body_velocity", "frame_velocity") if name in answers}
    found = verdicts(truth, {name: answers[name] for name in names})
    assert names and found == dict.fromkeys(names, Verdict.AGREES)
    assert not np.any([state.v[0] for state in states])


def test_energies_of_heavy_bodies_on_springs_and_dampers_in_weak_gravity_are_within_their_bounds():
    model = tree_from_seed(0, 2, ("hinge",), elements=("stiffness", "damping"))
    model = replace(model, mass=1e5 * model.mass, inertia=1e5 * model.inertia, gravity=1e-12 * model.gravity)
    states = random_states(model, 3, 1)
    answers = answers_of("mujoco", model, states)
    energies = {name: answers[name] for name in ("kinetic_energy", "potential_energy")}
    calls = {name for by_call in energies.values() for call in by_call for name in call}
    assert calls >= {"MjData.qH", "mjtSensor.mjSENS_E_POTENTIAL"}
    found = verdicts(state_truth(model, states), energies)
    assert found == dict.fromkeys(energies, Verdict.AGREES)


@pytest.mark.parametrize("engine", ["pinocchio", "exudyn"])
def test_bodies_of_a_loop_are_compared_and_a_relative_change_of_1e_6_is_seen(engine):
    s = catalogue_scenario("slider-crank")
    states = states_of(s, 2)[:2]
    truth, answers = state_truth(s.model, states), answers_of(engine, s.model, states)
    found = verdicts(truth, answers)
    assert_all_but_wrong_agree(engine, found)
    assert_changes_are_seen(truth, answers)


@pytest.mark.parametrize(("engine", "count"), [("mujoco", 30), ("pinocchio", 20), ("exudyn", 15)])
def test_every_variant_agrees_and_a_relative_change_of_1e_6_is_seen(engine, count, tree):
    model, states, truth = tree
    evaluation = Evaluation([], variants=evaluate_variants(load_adapter(engine), model, states))
    assert_agree(judge_variants(WHO, truth, evaluation))
    names = {name for variants in evaluation.variants.values() for call in variants for name in call}
    assert len(names) >= count and set(exercised_names(truth, evaluation)) == names


def test_exudyns_ways_for_trees_agree_and_its_tree_of_vectors_gives_slides_the_last_mass():
    model, states = mechanism(("slide", "hinge"), seed=1)
    bare = dict.fromkeys(("force", "moment", "drag_force", "drag_moment"), 0)
    model = replace(model, **{name: 0 * getattr(model, name) for name in bare})
    truth, adapter = state_truth(model, states), load_adapter("exudyn-tree")
    variants = evaluate_variants(adapter, model, states)
    rows = rows_of_variants(truth, variants)
    wrong = {row.quantity for row in rows if row.verdict != Verdict.AGREES}
    assert wrong == {f"{name}_by_vectors" for name in (
        "acceleration", "angular_acceleration", "kinetic_energy", "mass_matrix",
    )}  # fmt: skip
    names = {name for calls in variants.values() for call in calls for name in call}
    assert len(names) > 15 and "kinematicTree.KinematicTree33" in names


@pytest.mark.parametrize("engine", ["mujoco", "exudyn-tree"])
def test_slow_motions_without_loads_agree_by_steps(engine):
    model = tree_from_seed(6, 3, ("hinge",), loads=False)
    model = replace(model, gravity=np.zeros(3))
    slow = [
        replace(s, v=1e-6 * s.v, omega=1e-6 * s.omega, xdot=1e-6 * s.xdot) for s in random_states(model, 3, 6)
    ]
    states = [complete_state(model, state) for state in slow]
    variants = evaluate_variants(load_adapter(engine), model, states)
    assert any({"SolveDynamic", "mj_step"} & set(names) for names in variants["option"])
    assert_agree(rows_of_variants(state_truth(model, states), {"option": variants["option"]}))


def test_variants_of_flat_bodies_and_of_frames_turned_by_quarters_agree():
    model, _ = mechanism(("hinge",))
    about_x, about_y = np.array([0.8, 0.6, 0.0, 0.0]), np.array([1.0, 0.0, 1.0, 0.0]) / np.sqrt(2)
    turn = np.broadcast_to(np.stack([quaternion_product(about_x, about_y), [1.0, 0, 0, 0]]), model.turn.shape)
    plates = np.stack([R @ np.diag([0.1, 0.2, 0.3]) @ R.T for R in rotation_matrix(model.turn[:, 0])])
    model = replace(model, turn=turn, inertia=(plates + plates.swapaxes(1, 2)) / 2)
    states = random_states(model, 3, 1)
    truth = state_truth(model, states)
    variants = evaluate_variants(load_adapter("mujoco"), model, states)
    assert_agree(rows_of_variants(truth, variants))


def test_a_variant_that_fails_or_is_wrong_is_named(tree):
    _, _, truth = tree
    right = truth.quantities[:2]
    wrong = [replace(one, acceleration=one.acceleration * 1.001) for one in right]
    variants = {"option": {("a",): right, ("b", "c"): wrong, ("d",): NoAnswer("it crashed", False)}}
    variants["spelling"] = {("e",): NoAnswer("not so", True)}
    rows = rows_of_variants(truth, variants)
    bad = {row.quantity: row for row in rows if row.verdict != Verdict.AGREES}
    assert set(bad) == {"all_by_option", "acceleration_by_option", "all_by_spelling"} and len(rows) > 3
    failed, refused = bad["all_by_option"], bad["all_by_spelling"]
    assert (failed.verdict, failed.reason) == (Verdict.FAILED, "by d: it crashed")
    assert (refused.verdict, refused.reason) == (Verdict.UNSUPPORTED, "by e: not so")
    reason = bad["acceleration_by_option"].reason
    assert reason.startswith("by b, c: the acceleration of The engine is off by") and "too" not in reason


@pytest.mark.parametrize("kind", ["universal", "planar"])
def test_pinocchios_rates_of_composite_joints_disagree_and_those_of_single_ones_are_compared(kind):
    model, states = mechanism((kind,), bodies=2)
    truth, answers = state_truth(model, states), answers_of("pinocchio", model, states)
    found = verdicts(truth, answers)
    assert {name for name, verdict in found.items() if verdict != Verdict.AGREES} == RECORDED
    assert_changes_are_seen(truth, answers)
    assert set(verdicts(truth, answers_of("mujoco", model, states)).values()) == {Verdict.AGREES}


def test_an_answer_of_another_shape_disagrees_and_a_failure_is_a_row(tree):
    _, _, truth = tree
    short = {"frame_position": {("f",): truth.surface["frame_position"].value[:, :1]}}
    assert verdicts(truth, short) == {"frame_position": Verdict.DISAGREES}
    (row,) = judge_surface(WHO, truth, Evaluation([], surface_failure=NoAnswer("it crashed", False)))
    assert (row.verdict, row.quantity, row.reason) == (Verdict.FAILED, "all", "it crashed")


def surface_rows_of_pinocchio(tree, monkeypatch, change):
    """Rows where what the adapter returns at each state is changed."""
    model, states, truth = tree

    class Changed(type(load_adapter("pinocchio"))):
        def _surface(self, model, states):
            return change(super()._surface(model, states))

    monkeypatch.setattr("plumbline.engines.engine_calls.load_adapter", lambda _: Changed())
    return judge_surface(WHO, truth, evaluate_states("pinocchio", model, states, ["surface"]))


def refused(_):
    raise Unsupported("it has not converged")


def without_first_velocity(answers):
    del answers[0]["frame_velocity"]
    return answers


@pytest.mark.parametrize(
    ("change", "verdict", "reason"),
    [
        (refused, Verdict.UNSUPPORTED, "it has not converged"),
        (without_first_velocity, Verdict.INFORMATION, "up to the first state at which The engine does not"),
        (lambda answers: answers[:1], Verdict.FAILED, "pinocchio._surface answered 1 of 3 states"),
        (lambda answers: [one | {"frame_velocitty": {("f",): np.ones((1, 3))}} for one in answers],
         Verdict.FAILED, "the surface of The engine has unknown quantities: frame_velocitty"),
    ],
)  # fmt: skip
def test_nothing_that_an_engine_does_not_answer_as_asked_is_left_out(
    tree, monkeypatch, change, verdict, reason
):
    rows = surface_rows_of_pinocchio(tree, monkeypatch, change)
    (told,) = (row for row in rows if row.quantity == "all")
    assert told.verdict == verdict and reason in told.reason


def test_calls_are_compared_up_to_the_first_state_at_which_a_part_failed():
    velocities = {"frame_velocity": {("f",): np.ones((1, 3))}}
    failed = {FAILED_PARTS: {("f", ""): np.ones((1, 1))}}
    found = stack_answers([velocities, velocities, failed, velocities])
    assert len(found["frame_velocity"][("f",)]) == 2 and list(found[FAILED_PARTS]) == [("f", "")]
    assert stack_answers([failed, velocities])["frame_velocity"] == {}


def test_states_count_that_are_answered():
    assert row_of_two_bodies([[0], [0]], [1e-12] * 2, [1.0] * 2, answered=3).extra["states"] == 3


def test_a_loose_bound_is_no_agreement(tree):
    _, _, truth = tree
    mass = truth.surface["total_mass"]
    loose = replace(truth, surface={"total_mass": replace(mass, tolerance=mass.scale)})
    assert verdicts(loose, {"total_mass": {("f",): mass.value}}) == {"total_mass": Verdict.UNRESOLVED}


def row_of_two_bodies(value, tolerance, scale, answered=8):
    """The row of two calls that return (8, 2, 3) velocities at the first states, of which all are 0."""
    true = SurfaceTruth(np.zeros((8, 2, 3)), np.full((8, 2), tolerance), np.full((8, 2), scale))
    truth = StateTruth([], [], [], "none", surface={"frame_velocity": true})
    answers = {("f",): np.full((8, 2, 1), value)[..., [0, 0, 0]] / np.sqrt(3), ("g",): true.value}
    first = {call: values[:answered] for call, values in answers.items()}
    (row,) = judge_surface(WHO, truth, Evaluation([], surface={"frame_velocity": first}))
    return row


@pytest.mark.parametrize(
    ("value", "tolerance", "scale", "verdict"),
    [
        ([[0], [0]], [1e-12, 1e-12], [1.0, 1.0], Verdict.AGREES),
        ([[0], [5]], [1e-12, np.nan], [1.0, 1.0], Verdict.UNRESOLVED),
        ([[0], [5]], [1e-12, np.nan], [1.0, 0.0], Verdict.UNRESOLVED),
        ([[5], [0]], [1e-12, np.nan], [1.0, 1.0], Verdict.DISAGREES),
        ([[5], [5]], [1e3, 1e3], [0.0, 0.0], Verdict.UNRESOLVED),
        ([[0], [0]], [0.0, 0.0], [0.0, 0.0], Verdict.AGREES),
        ([[0], [1e-6]], [1e-12, 1e-5], [1e4, 1e-5], Verdict.UNRESOLVED),
        ([[0], [1e-14]], [1e-12, 1e-5], [1e4, 1e-5], Verdict.AGREES),
        ([[0], [1e-14]], [1e-12, 1e-12], [1.0, 0.0], Verdict.AGREES),
    ],
)
def test_no_body_agrees_without_a_sharp_tolerance_of_its_own(value, tolerance, scale, verdict):
    row = row_of_two_bodies(value, tolerance, scale)
    assert row.verdict == verdict, row.reason
    assert row.ratio >= 0 and "nan" not in row.reason


def test_a_wrong_call_is_named(tree):
    model, states, truth = tree
    answers = evaluate_states("mujoco", model, states, ["surface"]).surface["frame_angular_velocity_local"]
    wrong = {call: value * ("mjtSensor.mjSENS_GYRO" not in call) for call, value in answers.items()}
    evaluation = Evaluation([], surface={"frame_angular_velocity_local": wrong})
    (row,) = judge_surface(WHO, truth, evaluation)
    assert row.verdict == Verdict.DISAGREES
    assert "by mjtSensor.mjSENS_GYRO, mj_sensorVel is off by" in row.reason and "too" not in row.reason
    assert row.extra["failed_calls"] == "mjtSensor.mjSENS_GYRO, mj_sensorVel"


def test_of_calls_that_are_off_by_about_as_much_the_first_names_the_finding():
    assert most_wrong_call({"a": 2.0, "c": 1e6, "b": 5e5}) == "b"
    assert most_wrong_call({"a": 2.0, "c": np.inf}) == "c"


def test_calls_are_what_findings_are_about_whatever_quantities_they_get_wrong(tree):
    model, _, truth = tree
    right = truth.quantities[:2]
    wrong = [replace(one, acceleration=one.acceleration * 2, kinetic_energy=one.kinetic_energy * 2)
             for one in right]  # fmt: skip
    variants = {"option": {("a",): right, ("b", "c"): wrong}}
    rows = rows_of_variants(truth, variants)
    assert {row.extra["failed_calls"] for row in rows if row.verdict == Verdict.DISAGREES} == {"b, c"}
    masses = dict.fromkeys((("e",), ("d",)), 2 * truth.surface["total_mass"].value)
    rows += judge_surface(WHO, truth, Evaluation([], surface={"total_mass": masses}))
    found = find_findings(rows, {"s": model.n})
    assert {f.title: set(f.quantities) for f in found} == {
        "wrong by b, c": {"acceleration_by_option", "kinetic_energy_by_option"},
        "wrong by d": {"total_mass"},
    }


def test_names_that_a_version_lacks_are_listed_and_the_rest_is_compared(tree, monkeypatch):
    model, states, truth = tree
    monkeypatch.delattr(pinocchio, "ModelPool")
    monkeypatch.delattr(pinocchio.rpy, "rotate")
    monkeypatch.delattr(pinocchio, "JointModelSphericalZYX")
    evaluation = evaluate_states("pinocchio", model, states)
    rows = judge_surface(WHO, truth, evaluation)
    (told,) = (row for row in rows if row.quantity == "all")
    assert told.verdict == Verdict.INFORMATION
    assert told.reason.startswith("version 0 has no ModelPool, rotate:")
    (told,) = (row for row in judge_variants(WHO, truth, evaluation) if row.quantity == "all_by_spelling")
    assert told.verdict == Verdict.INFORMATION and told.reason.endswith(
        "this version of Pinocchio has no JointModelSphericalZYX"
    )
    assert {row.quantity for row in rows} > {"inverse_dynamics", "momentum", "frame_axes"}


def test_a_variant_that_is_undecided_or_refuses_or_lacks_a_quantity_is_not_behind_others(tree):
    _, _, truth = tree
    right = truth.quantities[:2]
    unsure = [replace(one, acceleration=2 * one.acceleration, limit_error={"acceleration": 1e9})
              for one in right]  # fmt: skip
    less = [right[0], replace(right[1], joint_reaction=None)]
    variants = {"option": {("a",): right, ("b",): unsure, ("c", "d"): less, ("e",): NoAnswer("why", True)}}
    rows = judge_variants(WHO, truth, Evaluation(list(truth.quantities), variants=variants))
    found = {row.quantity: row for row in rows}
    assert found["acceleration_by_option"].verdict == Verdict.UNRESOLVED
    assert found["acceleration_by_option"].reason.startswith("by b: inconclusive: ")
    assert found["joint_reaction_by_option"].verdict == Verdict.AGREES
    missing = found["all_by_option"]
    assert missing.verdict == Verdict.UNSUPPORTED and missing.extra["failed_calls"] == "c, d\ne"
    assert missing.reason == "by c, d: it returns no joint reaction; by e: why"


def test_a_name_that_this_project_lacks_is_a_failure(tree, monkeypatch):
    model, states, _ = tree
    monkeypatch.delattr(mujoco_surface, "SENSOR_STAGES")
    found = evaluate_states("mujoco", model, states, ["surface"])
    ((words, place),) = found.surface[FAILED_PARTS]
    assert words == "add sensors: NameError: name 'SENSOR_STAGES' is not defined"
    assert place.startswith("NameError in ") and place.endswith("add_sensors")
    assert "frame_position" in found.surface, "the other parts are compared"
    with pytest.raises(AttributeError):
        add_parts({}, lambda: np.a_name_of_a_package_that_every_environment_has)


def test_a_part_that_fails_or_ends_its_process_costs_that_part_only():
    found = {}

    def add_singular():
        found["momentum"] = {("before",): np.ones((1, 3))}
        np.linalg.inv(np.zeros((2, 2)))

    def add_crash(signal_number):
        os.kill(os.getpid(), signal_number)

    def add_inverse(names, size):
        np.linalg.inv(np.zeros((size, size)))

    def add_energy():
        found["energy"] = {("energy",): np.ones((1, 1))}

    token = IS_APART.set(True)
    try:
        crash = partial(add_crash, signal.SIGKILL)
        add_parts(found, add_singular, crash, partial(add_inverse, "mj_inverse mj_rne", 2), add_energy)
    finally:
        IS_APART.reset(token)
    assert {words for words, _ in found.pop(FAILED_PARTS)} == {
        "add singular: LinAlgError: Singular matrix",
        "add crash: crashed: the process died of SIGKILL",
        "add inverse mj_inverse mj_rne: LinAlgError: Singular matrix",
    }
    assert set(found) == {"momentum", "energy"}
