"""Repeatability: every engine gives the same bits again, and an engine with a memory or noise is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.metamorphic_hooks import metamorphic_hooks
from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.judging.relation_rows import judge_relations
from plumbline.judging.rows import RowContext
from plumbline.measurements.repeatability import check_repeatability
from plumbline.model.datatypes import EngineFailure, Unsupported
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario, states_of
from tests.helpers.relation_checks import check_relations

for name in ("mujoco", "pinocchio", "exudyn"):
    pytest.importorskip(name)

MODEL = pendulums.make_model("rods", loads=True, drag=True)
STATES = [pendulums.state_from_seed(MODEL, seed=k) for k in range(4)]
ULP = np.finfo(float).eps


def rows(adapter, model=MODEL, states=STATES):
    results = list(check_repeatability(metamorphic_hooks(adapter), model, states))
    found = judge_relations(RowContext("s", "f", "e", "Engine", "0"), results).rows
    assert {(row.level, row.quantity) for row in found} == {("relations", "repeatability")}
    return {row.integrator: row for row in found}


def rows_that_agree(engine, *subject):
    """The rows of an engine, one for states and one for each integrator."""
    adapter = load_adapter(engine)
    found = rows(adapter, *subject)
    assert set(found) == {"-", *(one.name for one in adapter.integrators if one.has_motions)}
    assert {row.verdict for row in found.values()} == {"agrees"}, [row.reason for row in found.values()]
    return found


@pytest.mark.parametrize("engine", ENGINES)
def test_every_engine_gives_the_same_bits_again(engine):
    found = rows_that_agree(engine)
    assert all(row.value == row.tolerance == 0 for row in found.values())
    assert found["-"].reason == "repeatability of Engine: 4 states gave the same bits each time"


@pytest.mark.parametrize("engine", ["mujoco", "pinocchio", "exudyn", "reference"])
def test_every_engine_gives_the_same_bits_of_a_loop_again(engine):
    """MuJoCo's are limits of softer runs, which are compared as well."""
    s = catalogue_scenario("slider-crank")
    rows_that_agree(engine, s.model, states_of(s, 2))


def planted(change=None, run=None, engine="mujoco"):
    """The real engine; ``change(memory, k, answer)`` alters answer k of a call, ``run`` a trajectory."""
    real = type(load_adapter(engine))

    class Planted(real):
        integrators = tuple(i for i in real.integrators if i.name in ("Euler", "RK4"))

        def __init__(self):
            super().__init__()
            self.memory = {}

        def _evaluate(self, model, states):
            answers = super()._evaluate(model, states)
            return [change(self.memory, k, a) for k, a in enumerate(answers)] if change else answers

        def _simulate(self, *arguments):
            done = super()._simulate(*arguments)
            return run(self.memory, arguments, done) if run else done

    return Planted()


def previous_call(memory, _, answer):
    before = memory.get("last", 0.0)
    memory["last"] = answer.acceleration
    return replace(answer, acceleration=answer.acceleration + 1e-15 * before)


def place_in_the_call(_, k, answer):
    return replace(answer, joint_reaction=answer.joint_reaction * (1 + k * ULP))


def one_ulp_of_noise(_, __, answer):
    up = np.random.default_rng().random(answer.angular_acceleration.shape) < 0.5
    x = answer.angular_acceleration
    return replace(answer, angular_acceleration=np.where(up, np.nextafter(x, np.inf), x))


def now_and_then_less(memory, _, answer):
    memory["count"] = memory.get("count", 0) + 1
    return replace(answer, mass_matrix=None) if memory["count"] == 6 else answer


def sign_of_zero(memory, _, answer):
    memory["sign"] = -memory.get("sign", 1.0)
    return replace(answer, potential_energy=memory["sign"] * 0.0)


@pytest.mark.parametrize(
    ("change", "quantity", "size"),
    [
        (previous_call, "acceleration", (1e-17, 1e-13)),
        (place_in_the_call, "joint reaction", (ULP / 2, 8 * ULP)),
        (one_ulp_of_noise, "angular acceleration", (ULP / 4, 2 * ULP)),
        (now_and_then_less, "mass matrix", (np.inf, np.inf)),
        (sign_of_zero, "potential energy", (0.0, 0.0)),
    ],
    ids=lambda one: getattr(one, "__name__", None),
)
def test_answers_that_depend_on_the_order_of_questions_or_on_chance_disagree(change, quantity, size):
    row = rows(planted(change))["-"]
    assert row.verdict == "disagrees" and f"the {quantity}" in row.reason, row.reason
    assert size[0] <= row.value <= size[1] and row.tolerance == 0.0
    if np.isfinite(row.value):
        assert f"differs by {row.value:.2g} of its size" in row.reason and "state " in row.reason


def warm_start(memory, _, done):
    before = memory.get("end", 0.0)
    memory["end"] = done.v[-1]
    return replace(done, v=np.concatenate([done.v[:-1], [done.v[-1] + 1e-14 * before]]))


def noise(_, arguments, done):
    if arguments[3].name != "RK4":
        return done
    return replace(done, r=done.r * (1 + ULP * np.random.default_rng().random(done.r.shape)))


def noise_of_the_softer_run(memory, arguments, done):
    return replace(done, softer=noise(memory, arguments, done))


@pytest.mark.parametrize(
    ("run", "wrong"),
    [(warm_start, {"Euler", "RK4"}), (noise, {"RK4"}), (noise_of_the_softer_run, {"RK4"})],
)
def test_runs_that_depend_on_the_run_before_or_on_chance_disagree(run, wrong):
    found = rows(planted(run=run))
    assert {name for name, row in found.items() if row.verdict == "disagrees"} == wrong
    assert "of a run, asked after another run" in found["RK4"].reason and found["RK4"].value > 0


def test_what_is_refused_or_fails_each_time_is_no_difference_and_what_changes_is_one():
    def failing_now_and_then(error, often):
        def run(memory, arguments, done):
            memory["count"] = memory.get("count", 0) + 1
            if arguments[3].name == "RK4" and (often or memory["count"] % 2):
                raise error
            return done

        return run

    assert set(rows(planted(run=failing_now_and_then(Unsupported("singular"), True)))) == {"-", "Euler"}
    failed = rows(planted(run=failing_now_and_then(EngineFailure("diverged"), True)))["RK4"]
    assert (failed.verdict, failed.reason) == ("failed", "diverged")
    for error in (Unsupported("singular"), EngineFailure("diverged")):
        memory = {"count": 1}  # the first run of RK4 succeeds, the one after another run does not

        def second(_, arguments, done, error=error, memory=memory):
            memory["count"] += arguments[3].name == "RK4"
            if memory["count"] == 4:
                raise error
            return done

        row = rows(planted(run=second))["RK4"]
        assert row.verdict == "disagrees" and str(error) in row.reason


def test_states_that_are_refused_alone_are_left_out():
    class Choosy(type(load_adapter("mujoco"))):
        integrators = ()

        def _evaluate(self, model, states):
            if any(state is STATES[1] for state in states):
                raise Unsupported("not this one")
            return super()._evaluate(model, states)

    row = rows(Choosy())["-"]
    assert row.verdict == "agrees" and row.extra["states"] == 3.0
    refused = rows(Choosy(), states=STATES[1:2])["-"]
    assert (refused.verdict, refused.reason) == ("unsupported", "not this one")


def test_the_rows_are_among_the_relations():
    results = check_relations("mujoco", MODEL, STATES[:2])
    assert [r.integrator for r in results if r.relation == "repeatability"] == [
        "-", "Euler", "implicit", "implicitfast", "RK4",
    ]  # fmt: skip
