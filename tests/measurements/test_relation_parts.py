"""The arithmetic behind the relations: what is compared, over what, and what the rows say."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from plumbline.engines.no_answer import NoAnswer
from plumbline.engines.registry import load_adapter
from plumbline.judging.relation_rows import judge_relations
from plumbline.judging.rows import RowContext
from plumbline.measurements.relation_result import RelationResult
from plumbline.measurements.run_relations import (
    characteristic_scales,
    fastest_rate,
    refused_result,
    relative_differences,
    run_tolerance,
    state_at_sample,
    with_shorter_steps,
    worst_difference_result,
)
from plumbline.measurements.state_relations import (
    QUANTITIES,
    Relation,
    check_state_relation,
    evaluate_or_refusal,
    quantity_values,
    scale_fields,
    unchanged,
)
from plumbline.model.datatypes import EngineFailure, Integrator, StateQuantities, Trajectory, Unsupported
from plumbline.model.kinematics import angular_velocity, quaternion_product, quaternion_rate, stretched_length
from plumbline.truth.ground_truth import RUN_ROUNDING
from plumbline.truth.predictability_horizon import perturbation_growth
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.relation_checks import check_relations

MODEL = pendulums.make_model("br")
STATES = [pendulums.state_from_seed(MODEL, seed=k) for k in range(3)]
WHO = RowContext("s", "f", "e", "E", "0")
METHOD = Integrator("trapezoidal", "step", 2, is_symmetric=True)


def test_values_are_what_is_offered_times_its_factor():
    reported = StateQuantities(np.ones((2, 3)), 2 * np.ones((2, 3)), kinetic_energy=3.0)
    found = quantity_values(reported, kinetic_energy=0.5, joint_reaction=9.0)
    assert set(found) == {"acceleration", "angular_acceleration", "kinetic_energy"}
    assert found["kinetic_energy"] == 1.5 and np.array_equal(found["acceleration"], reported.acceleration)
    twice = scale_fields(MODEL, mass=2.0, length=3.0)
    assert np.array_equal(twice.mass, 2 * MODEL.mass) and np.array_equal(twice.length, 3 * MODEL.length)
    assert np.array_equal(twice.inertia, MODEL.inertia)


def self_relation_result(*shifts, relation=None, refuse=(), refuse_here=()):
    """The relation of an engine with itself, answers shifted: (state, quantity, so many bounds of both)."""
    bounds = [state_rounding_bound(MODEL, s) for s in STATES]
    reported = list(load_adapter("reference").evaluate(MODEL, STATES))
    other = list(reported)
    for index, quantity, by in shifts:
        x = np.asarray(getattr(reported[index], quantity))
        off = by * 2 * np.asarray(bounds[index].tolerance(quantity))
        off = off[:, None] * [0.6, 0, -0.8] if x.ndim == 2 else off * np.eye(3)[0] if x.ndim else -off
        other[index] = replace(other[index], **{quantity: x + off})
    requested = iter(range(3))

    def there(_model, states):  # all in one call, or one by one
        indices = range(3) if len(states) == 3 else [next(requested)]
        for index in refuse:
            if index in indices:
                raise Unsupported(f"not state {index}")
        return [other[index] for index in indices]

    reported = [Unsupported(f"nor state {k}") if k in refuse_here else x for k, x in enumerate(reported)]
    relation = relation or Relation("as itself", unchanged, quantity_values)
    return check_state_relation(relation, reported, there, MODEL, STATES, bounds, bounds)


@pytest.mark.parametrize("quantity", [q for q in QUANTITIES if q != "joint_moment"])  # chains have none
@pytest.mark.parametrize("by", [0.9, 1.1, 40.0])
def test_a_relation_is_as_far_off_as_its_worst_quantity_over_both_bounds(quantity, by):
    found = self_relation_result((0, "kinetic_energy", 0.5), (2, quantity, by))
    # off is rounded where it is added: by half a unit of a quantity whose bound is 540 units and more
    assert found.ratio == pytest.approx(by, rel=1e-3)
    assert (found.quantity, found.worst_state, found.state_count) == (quantity, 2, 3)
    assert (found.relation, found.integrator, found.steps, found.no_answer) == ("as itself", "-", 0, None)


def test_equal_answers_and_refused_ones():
    assert self_relation_result().ratio == 0.0
    some = self_relation_result((0, "acceleration", 5.0), (1, "acceleration", 3.0), refuse=(0,))
    assert (some.state_count, some.worst_state) == (2, 1) and some.no_answer is None
    assert some.ratio == pytest.approx(3, rel=1e-3)  # rounded as above
    (row,) = judge_relations(WHO, [some]).rows
    assert row.reason.endswith("; refused at 1 of 3 states: not state 0")
    mine = self_relation_result((2, "acceleration", 5.0), (1, "acceleration", 3.0), refuse_here=(2,))
    assert (mine.state_count, mine.worst_state, mine.no_answer) == (2, 1, None)
    none = self_relation_result(refuse=(0, 1, 2))
    assert (none.ratio, none.quantity, none.worst_state, none.state_count) == (None, "", 0, 0)
    assert none.no_answer.is_refusal

    def refusing(_model, _states):
        raise Unsupported("never")

    assert str(evaluate_or_refusal(refusing, MODEL, STATES[0])) == "never"


def test_an_option_by_which_the_engine_fails_is_a_failure_of_its_own_row():
    def failing(_model, _states):
        raise AttributeError("no such option")

    answers = load_adapter("reference").evaluate(MODEL, STATES)
    bounds = [state_rounding_bound(MODEL, state) for state in STATES]
    found = check_state_relation(Relation("by it"), answers, failing, MODEL, STATES, bounds, bounds)
    assert (found.relation, found.ratio, found.no_answer.is_refusal) == ("by it", None, False)
    (row,) = judge_relations(WHO, [found]).rows
    assert row.verdict == "failed" and "no such option" in row.reason
    assert row.extra["place"].startswith("AttributeError in ") and row.extra["place"].endswith(" > failing")


@pytest.mark.parametrize(("uncertain", "verdict"), [(0, "agrees"), (1, "agrees"), (2, "unresolved")])
def test_agreement_within_an_uncertainty_of_the_engines_own_is_undecided(uncertain, verdict):
    """It may be as large as rounding at every state, and larger at less than half of them."""
    answers = load_adapter("reference").evaluate(MODEL, STATES)
    bounds = [state_rounding_bound(MODEL, state) for state in STATES]
    reported = []
    for k, (answer, bound) in enumerate(zip(answers, bounds, strict=True)):
        wrong = k < uncertain
        limit_error = {"acceleration": 1e3 if wrong else float(np.min(bound.acceleration))}
        acceleration = answer.acceleration * (1.3 if wrong else 1.0)
        reported.append(replace(answer, acceleration=acceleration, limit_error=limit_error))
    relation = Relation("by it", unchanged, quantity_values)
    found = check_state_relation(relation, answers, lambda *_: reported, MODEL, STATES, bounds, bounds)
    (row,) = judge_relations(WHO, [found]).rows
    assert row.verdict == verdict and found.ratio < 1
    assert uncertain < 2 or "at 2 of 3 states the acceleration may differ by too much" in row.reason
    off = replace(found, ratio=1.5)
    assert judge_relations(WHO, [off]).rows[0].verdict == "disagrees"


@pytest.mark.parametrize(("rtol", "verdict"), [(1e-9, "agrees"), (1e-3, "unresolved")])
def test_agreement_of_runs_within_a_large_tolerance_of_the_step_is_undecided(rtol, verdict):
    loose = replace(METHOD, solver_rtol=rtol)
    limit = run_tolerance(loose, MODEL, STATES[0], end=0.1, steps=16, growth=1.0)
    found = worst_difference_result("reversed in time", loose, {"position": limit / 2}, limit, 16, 0.01, 0.1)
    assert judge_relations(WHO, [found]).rows[0].verdict == verdict


def test_a_run_that_failed_with_a_larger_step_is_named():
    engine = SimpleNamespace(integrators=[METHOD])

    def check(integrator, step):
        failure = NoAnswer(f"it stopped at {step:g}", is_refusal=False) if step > 0.1 else None
        ratio = None if failure else 0.5
        yield RelationResult("by it", ratio, no_answer=failure, integrator=integrator.name, steps=8)

    rows = judge_relations(WHO, [*with_shorter_steps(engine, [0.4, 0.2, 0.1], check)]).rows
    assert [row.verdict for row in rows] == ["agrees"]
    assert rows[0].reason.endswith("over 8 steps; with steps of 0.4 s it stopped at 0.4")


def test_runs_are_measured_by_length_turn_and_speed():
    at = STATES[0]
    length, g = float(np.sum(stretched_length(MODEL))), np.linalg.norm(MODEL.gravity)
    spin = max(np.sqrt(g * length) / length, *np.linalg.norm(at.omega, axis=1))
    speed = max(spin * length, *np.linalg.norm(at.v, axis=1))
    assert characteristic_scales(MODEL, at) == pytest.approx((length, spin, speed), rel=1e-14)
    still = replace(at, omega=0 * at.omega, v=0 * at.v)
    assert characteristic_scales(MODEL, still) == pytest.approx(
        (length, np.sqrt(g / length), np.sqrt(g * length)), rel=1e-14
    )
    fast = replace(still, v=np.array([[0, 0, 40.0], [0, 50.0, 0]]))
    assert characteristic_scales(MODEL, fast)[2] == 50.0
    assert characteristic_scales(replace(MODEL, gravity=np.zeros(3)), still)[1] == np.finfo(float).tiny
    turn = np.array([np.cos(5e-4), np.sin(5e-4), 0, 0])
    other = replace(
        at,
        r=at.r + np.array([[0, 0, 0], [3e-3, 0, 4e-3]]),
        p=quaternion_product(at.p, np.tile(turn, (2, 1))),
        v=at.v + np.array([[0, 2e-3, 0], [0, 0, 0]]),
        omega=at.omega + np.array([[0, 0, 0], [0, 0, 7e-3]]),
    )
    assert relative_differences(MODEL, at, other) == pytest.approx(
        {
            "position": 5e-3 / length,
            "attitude": 1e-3,
            "velocity": 2e-3 / speed,
            "angular velocity": 7e-3 / spin,
        },
        rel=1e-9,  # distances of 1e-3 and more between numbers of size 1 … 50
    )
    unit = 2.0**-20
    differences = {"position": unit, "velocity": 3 * unit, "attitude": 2 * unit}
    found = worst_difference_result("reversed in time", METHOD, differences, unit / 2, 64, 0.25, 8.0)
    assert found == RelationResult(
        "reversed in time",
        6.0,
        "velocity",
        0,
        1,
        integrator="trapezoidal",
        steps=64,
        resolution=0.25,
        end_time=8.0,
    )


def test_a_sample_is_taken_as_it_is_and_back_with_opposite_rates():
    at = STATES[1]
    r, p, v = (np.stack([0 * x, x]) for x in (at.r, at.p, at.v))
    run = Trajectory(np.array([0.0, 1.0]), r, p, v, np.stack([0 * at.p, quaternion_rate(at.p, at.omega)]), 1)
    for sign in (1.0, -1.0):
        found = state_at_sample(run, -1, sign)
        assert np.array_equal(found.r, at.r) and np.array_equal(found.p, at.p)
        assert np.array_equal(found.v, sign * at.v)
        assert found.omega == pytest.approx(sign * angular_velocity(at.p, run.pdot[1]), abs=1e-14)
        for nothing in (found.u, found.udot):
            assert nothing.shape == (2, 3) and not np.any(nothing)
    assert not np.any(state_at_sample(run, 0).r)


def test_the_quickest_is_a_body_a_rod_or_the_shortest_link():
    at, g = STATES[0], np.linalg.norm(MODEL.gravity)
    still = replace(at, omega=0 * at.omega, udot=0 * at.udot)
    assert fastest_rate(MODEL, still) == pytest.approx(
        np.sqrt(g / np.min(stretched_length(MODEL))), rel=1e-14
    )
    assert fastest_rate(MODEL, replace(still, omega=np.array([[0, 3.0, 4.0], [90.0, 0, 0]]))) == 90.0
    assert fastest_rate(MODEL, replace(still, udot=np.array([[0, 0, 0], [30.0, 0, 40.0]]))) == 50.0
    assert fastest_rate(replace(MODEL, gravity=np.zeros(3)), still) == 1.0


def test_a_loop_that_a_motor_starts_from_rest_is_as_fast_as_its_acceleration_makes_it():
    squeezer = catalogue_scenario("squeezer")
    assert np.max(np.abs(squeezer.state.omega)) == 0 == np.max(np.abs(squeezer.model.gravity))
    assert fastest_rate(squeezer.model, squeezer.state) > np.sqrt(2 * 1.4e4)  # ω̇ = 1.4e4 rad/s² at the start


def test_rows_say_what_held_what_did_not_and_what_was_refused():
    one = RelationResult("masses doubled", 0.25, "joint_reaction", 2, 4)
    off = replace(one, ratio=1.5)
    run = RelationResult(
        "reversed in time",
        0.5,
        "velocity",
        0,
        1,
        integrator="trapezoidal",
        steps=64,
        resolution=0.25,
        end_time=8.0,
    )
    lost = refused_result("by sparse", METHOD, EngineFailure("it stopped"))
    never = refused_result("by sparse", METHOD, Unsupported("no such solver"))
    stopped = NoAnswer("it stopped", False, place="EngineFailure")
    assert lost == RelationResult("by sparse", None, no_answer=stopped, integrator="trapezoidal")
    assert (one.no_answer, one.integrator, one.steps) == (None, "-", 0)
    rows = judge_relations(
        WHO, [one, off, replace(one, ratio=1.0), run, replace(run, ratio=7.0), lost, never]
    ).rows
    assert [r.verdict for r in rows] == [
        "agrees", "disagrees", "agrees", "agrees", "disagrees", "failed", "unsupported",
    ]  # fmt: skip
    assert {r.level for r in rows} == {"relations"}
    assert [r.integrator for r in rows] == ["-"] * 3 + ["trapezoidal"] * 4
    assert [r.value for r in rows] == [0.25, 1.5, 1.0, 0.5, 7.0, None, None]
    assert [r.tolerance for r in rows] == [1.0] * 5 + [None] * 2
    assert rows[0].extra == {"states": 4.0, "state": 2.0}
    assert rows[3].extra == {"states": 1.0, "state": 0.0, "resolution": 0.25, "end": 8.0}
    assert "sum of the state-level rounding bounds of both sides" in rows[0].derivation
    assert "growth of a small perturbation" in rows[3].derivation
    assert "agree within 0.25 of the sum of both rounding bounds, over 4 states" in rows[0].reason
    assert (
        "the joint reaction of E at state 2 differs by 1.5 times the sum of both rounding bounds"
        in rows[1].reason
    )
    assert (
        "within 0.5 of what rounding and the tolerance of the step's solver explain, over 64 steps"
        in rows[3].reason
    )
    assert "velocity of E at the end differs by 7 times" in rows[4].reason
    assert rows[4].reason.endswith("what rounding and the tolerance of the step's solver explain")
    assert [r.reason for r in rows[5:]] == ["it stopped", "no such solver"]
    assert [r.quantity for r in rows][:2] == ["masses doubled"] * 2


@pytest.mark.parametrize("kind", ["step", "tolerance"])
def test_a_run_may_be_off_by_its_rounding_its_solver_and_its_accelerations_grown(kind):
    model, at, end, steps = MODEL.changed(mass=np.array([1.0, 2.0])), STATES[2], 0.5, 81
    method = Integrator("x", kind, 2, solver_rtol=1e-9, min_rtol=3e-9)
    bound, (_, spin, speed) = state_rounding_bound(model, at), characteristic_scales(model, at)
    ratio = 2.0
    solved = (1e-9 * ratio if kind == "step" else 3e-9) * 9
    pushed = end * max(max(bound.acceleration) / speed, max(bound.angular_acceleration) / spin)
    grown = max(perturbation_growth(model, at, np.array([0, end / 2, end])))
    assert grown > 1.1
    limit = run_tolerance(method, model, at, end, steps, grown)
    assert limit == pytest.approx((RUN_ROUNDING + solved + pushed) * grown, rel=1e-12, abs=0)
    bare = replace(method, solver_rtol=0.0, min_rtol=0.0)
    assert run_tolerance(bare, model, at, end, steps, grown) == pytest.approx(
        (RUN_ROUNDING + pushed) * grown, rel=1e-12, abs=0
    )


@pytest.mark.parametrize("drag", [False, True])
def test_every_relation_is_tried_and_time_reversed_with_drag_switched_off(drag):
    model = pendulums.make_model("b", drag=drag)
    names = [
        found.relation for found in check_relations("pinocchio", model, [pendulums.state_from_seed(model)])
    ]
    assert names[0] == "repeatability", "an adapter that was not called before"
    names = [name for name in names if name != "repeatability"]
    expected = ["rotated world", "re-chosen body frame", "masses doubled", "lengths × 4"]
    expected.insert(0 if drag else 4, "time reversed")  # with drag from other answers, asked for first
    assert names[:5] == expected
    assert "as pinocchio-maximal" in names and "two welded halves" in names


@pytest.mark.parametrize("engine", ["pinocchio", "pinocchio-maximal", "exudyn", "exudyn-tree"])
def test_both_columns_of_an_engine_are_compared(engine):
    pytest.importorskip(engine.split("-")[0])
    other = load_adapter(engine).other_formulation
    assert load_adapter(other).other_formulation == engine
    model = pendulums.make_model("b")
    assert f"as {other}" in [
        found.relation for found in check_relations(engine, model, [pendulums.state_from_seed(model)])
    ]


def test_relations_of_long_chains_use_half_as_many_states():
    pytest.importorskip("mujoco")
    for bodies, states in ((12, 4), (13, 2)):
        model = pendulums.make_model("b" * bodies)
        found = check_relations(
            "mujoco", model, [pendulums.state_from_seed(model, seed=k, rate=0.5) for k in range(6)]
        )
        assert {one.state_count for one in found if not one.steps and one.ratio is not None} == {states}
