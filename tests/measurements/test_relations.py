"""Relations that need no truth: they hold on every engine, and each breaks under a defect of its kind."""

from dataclasses import replace
from functools import cache
from itertools import product
from unittest.mock import patch

import numpy as np
import pytest

from plumbline.diagnosis.prediction import Predictor, View
from plumbline.engines.metamorphic_hooks import metamorphic_hooks
from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.judging.relation_rows import judge_relations
from plumbline.judging.rows import RowContext
from plumbline.measurements.run_relations import (
    check_integrator_relations,
    fastest_rate,
    relative_differences,
    run_growth,
    run_tolerance,
    state_at_sample,
)
from plumbline.measurements.state_relations import (
    QUANTITIES,
    STATE_RELATIONS,
    WELDED_HALVES,
    check_state_relation,
)
from plumbline.model.datatypes import EngineFailure, Unsupported
from plumbline.model.welding import split_bodies, split_body
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers import pendulums
from tests.helpers.nightly_tests import SLOW
from tests.helpers.planted_defects import STATE_DEFECTS
from tests.helpers.planting import Defect, answer_change, model_change, number_change, plant
from tests.helpers.random_chains import random_chain
from tests.helpers.relation_checks import check_relations, check_run_relations, check_state_relations
from tests.helpers.requirements import require_engines
from tests.helpers.shared_answers import sharing

require_engines()


@pytest.fixture(scope="module", autouse=True)
def shared_bounds():
    """Engines with and without a defect are judged by the same bounds."""
    with sharing("plumbline.measurements.state_relations", "rounding_bounds"):
        yield


def state_relation(engine, relation):
    """One relation of an engine on two balls; the others are not computed after it."""
    model = pendulums.make_model("balls")
    found = check_state_relations(metamorphic_hooks(engine), model, random_states_of(model))
    return next(result for result in found if result.relation == relation)


def random_states_of(model):
    return [pendulums.state_from_seed(model, seed) for seed in range(3)]


@pytest.mark.parametrize("joints", ["ball", "rods", "mixed"])
def test_the_ways_back_are_those_of_the_equations(joints):
    """Each relation on an independent solution, loads and drag included: the algebra of there and back."""
    model = pendulums.make_model(joints, loads=True, drag=True)
    for relation in STATE_RELATIONS:
        here = model if relation.name != "time reversed" else pendulums.make_model(joints, loads=True)
        for state in random_states_of(here):
            right = Predictor(here, [state], View()).right
            other_model, other_state = relation.transform(here, state)
            reported = {q: x[0] for q, x in Predictor(other_model, [other_state], View()).right.items()}
            back = relation.transform_back(_as_state_quantities(reported))
            for q, x in back.items():
                np.testing.assert_allclose(x, right[q][0], rtol=1e-11, atol=1e-11 * np.max(np.abs(right[q])))


def _as_state_quantities(reported):
    from plumbline.model.datatypes import StateQuantities

    return StateQuantities(**{q: x if np.ndim(x) else float(x) for q, x in reported.items()})


@pytest.mark.parametrize(
    ("engine", "joints"),
    [(e, joints) for e in ENGINES for joints in ("balls", "rod-ball") if e != "reference-printed"]
    + [("reference-printed", "rods")],
)
def test_every_engine_keeps_every_relation(engine, joints):
    model = pendulums.make_model(joints, loads=True)
    found = check_relations(engine, model, random_states_of(model))
    rows = judge_relations(RowContext("s", "f", engine, engine, "0"), found).rows
    refused = [row.quantity for row in rows if row.verdict == "unsupported"]
    closes_no_loops = engine in ("pinocchio-aba", "exudyn-tree", "reference-printed")
    welds_nothing = engine in ("reference", "reference-printed", "exudyn-tree")
    assert refused == ["root moved"] * closes_no_loops + ["two welded halves"] * welds_nothing
    assert len(rows) >= (6 if engine == "reference-printed" else 7) and len(
        {(row.integrator, row.quantity) for row in rows}
    ) == len(rows)
    disagreeing = [row.quantity for row in rows if row.verdict == "disagrees"]
    # known_issues.yaml records that they leave out a term
    assert disagreeing == ["by tendon equalities"] * (engine == "mujoco" and "rod" in joints)
    assert all(r.extra["unexplained"] <= 1 for r in rows if r.quantity in disagreeing)
    unmoved = [row.quantity for row in rows if row.verdict == "information"]
    assert unmoved == ["motions by tendon equalities"] * len(disagreeing)
    others = [row for row in rows if row.quantity not in refused + disagreeing + unmoved]
    assert all(row.verdict == "agrees" for row in others), [row.reason for row in rows]


def defect_named(name):
    return next(d for d in STATE_DEFECTS if d.name == name)


DEFECTS_BY_RELATION = {
    "rotated world": (
        defect_named("gravity-z"),
        defect_named("gravity-axes"),
        defect_named("bodies-exchanged"),
    ),
    "re-chosen body frame": (
        defect_named("inertia-products-dropped"),
        defect_named("inertia-xx-1e-6"),
        defect_named("centre-0.1mm"),
    ),
    "masses doubled": (
        defect_named("damping-1e-6"),
        Defect("gram", inputs=number_change("mass", 0, by=1e-3)),
    ),
    "lengths × 4": (
        defect_named("distal-1e-5"),
        defect_named("centre-0.1mm"),
        defect_named("potential-origin"),
    ),
    "time reversed": (
        defect_named("damping-1e-6"),
        defect_named("spatial-acceleration"),
        Defect("helical", inputs=model_change(lambda m, s: {"moment": m.moment + 1e-6 * s.omega})),
    ),
    "as exudyn-tree": (replace(defect_named("mass-1-1e-5"), engine="exudyn"),),
}


@pytest.mark.parametrize("relation", DEFECTS_BY_RELATION)
def test_a_defect_of_its_kind_breaks_it(relation):
    broken = {d.name: state_relation(plant(d), relation).ratio > 1 for d in DEFECTS_BY_RELATION[relation]}
    assert any(broken.values()) and broken[DEFECTS_BY_RELATION[relation][0].name], broken


def test_a_refused_state_is_left_out_and_a_refusing_engine_is_reported():
    class Refusing(type(load_adapter("mujoco"))):
        name = "refusing"

        def _evaluate(self, model, requested):
            raise Unsupported("not on a Monday")

    model = pendulums.make_model("ball")
    with patch("plumbline.measurements.relations.load_adapter", lambda _: Refusing()):
        rows = judge_relations(
            RowContext("s", "f", "e", "E", "0"), check_relations("mujoco", model, random_states_of(model))
        ).rows
    of_states = [row for row in rows if row.integrator == "-"]  # its runs are as before
    assert {(row.verdict, row.reason) for row in of_states} == {("unsupported", "not on a Monday")}


def test_noise_breaks_what_is_not_bitwise():
    """An engine that loses digits is seen without any truth: as aba on thirty balls is."""
    rng = np.random.default_rng(5)
    noisy = Defect("noise", answers=answer_change(
        "acceleration", lambda _, __, a: a * (1 + 1e-9 * rng.normal(size=a.shape))))  # fmt: skip
    engine = plant(noisy)
    model = pendulums.make_model("balls")
    with patch("plumbline.measurements.relations.load_adapter", lambda _: engine):
        found = check_relations("mujoco", model, random_states_of(model))
    for result in found:
        if result.integrator == "-":  # its runs are as before; a repetition must be the same to the bit
            assert result.ratio > (0 if result.relation == "repeatability" else 1), result.relation


# -- the engine's other ways, and welded halves -----------------------------------------------------


def defect_in_default_formulation(defect):
    """The real engine with a defect in its usual way alone: its other ways and welded bodies are sound."""
    real = type(load_adapter(defect.engine))
    engine = plant(defect)
    engine.with_option = lambda option: real().with_option(option)
    engine.with_welded_halves = lambda: real().with_welded_halves()
    return engine


OPTION_RELATIONS = [
    (engine, f"by {option}") for engine in ENGINES for option in type(load_adapter(engine)).options
]
WELDING_RELATIONS = [
    (engine, "two welded halves")
    for engine in ENGINES
    if not type(load_adapter(engine)).welding_unsupported_reason
]


@pytest.mark.parametrize("defect", ["inertia-xx-1e-6", pytest.param("distal-1e-5", marks=SLOW)])
@pytest.mark.parametrize(("engine", "relation"), OPTION_RELATIONS + WELDING_RELATIONS)
def test_a_defect_in_one_way_of_the_engine_breaks_it(engine, relation, defect):
    faulty = defect_in_default_formulation(replace(defect_named(defect), engine=engine))
    found = state_relation(faulty, relation)
    assert found.ratio > 1, found


@pytest.mark.parametrize("change", ["inertia", "centre", "mass"])
@pytest.mark.parametrize("engine", [engine for engine, _ in WELDING_RELATIONS])
def test_a_half_that_is_welded_wrongly_breaks_it(engine, change):
    """One number of one half off by 1e-6 of it: what the engine welds is not the body then."""

    def wrong(model):
        one, other = (parts := split_bodies(model))[-1]
        parts[-1] = one, replace(other, **{change: getattr(other, change) * (1 + 1e-6)})
        return parts

    with patch("plumbline.engines.metamorphic_hooks.split_bodies", wrong):
        found = state_relation(load_adapter(engine), WELDED_HALVES)
    assert found.ratio > 1, found


@pytest.mark.parametrize("shape", [[2.0, 3.0, 4.0], [1.0, 1.0, 2.0], [1.0, 1.0, 1e-6], [1.0, 1.0, 1.0]])
def test_two_halves_are_physical_and_make_the_body(shape):
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    inertia = turn @ np.diag(shape) @ turn.T
    inertia = (inertia + inertia.T) / 2
    pair = split_body(3.0, inertia)
    size, eye = np.linalg.norm(inertia), np.eye(3)
    assert sum(part.mass for part in pair) == 3.0
    assert np.all(pair[0].mass * pair[0].centre + pair[1].mass * pair[1].centre == 0)
    assert np.linalg.norm(pair[0].centre) > 0.3 * np.sqrt(size / 3.0) / 2
    together = sum(
        part.inertia + part.mass * (part.centre @ part.centre * eye - np.outer(part.centre, part.centre))
        for part in pair
    )
    np.testing.assert_allclose(together, inertia, rtol=0, atol=1e-15 * size)
    for part in pair:
        a, b, c = np.linalg.eigvalsh(part.inertia)
        assert a > 0 and a + b >= c - 1e-15 * size
        assert a >= shape[0 if shape[0] < shape[2] else 2] / 8 * (1 - 1e-9)


def test_halves_have_roundings_of_their_own():
    """Hung at its centre a body has no potential energy to round; its halves' must cancel."""
    model = pendulums.make_model("ball")
    model = model.changed(proximal=0 * model.proximal)
    at = pendulums.state_from_seed(model, 1)
    plain, welded = state_rounding_bound(model, at), state_rounding_bound(model, at, split_bodies(model))
    assert plain.potential_energy == 0 < welded.potential_energy
    (whole,), (two,) = (
        e.evaluate(model, [at]) for e in (load_adapter("mujoco"), load_adapter("mujoco").with_welded_halves())
    )
    assert 0 <= abs(two.potential_energy - whole.potential_energy) <= welded.potential_energy
    for q in set(QUANTITIES) - {"joint_moment"}:  # chains have none
        assert np.all(np.asarray(welded.tolerance(q)) >= plain.tolerance(q))
    with patch(
        "plumbline.measurements.state_relations.check_state_relation", wraps=check_state_relation
    ) as requested:
        check_relations("mujoco", model, [at])
    (_, *_, (one,), (other,)) = next(
        c.args for c in requested.call_args_list if c.args[0].name == WELDED_HALVES
    )
    assert one.potential_energy == 0 and other.potential_energy == welded.potential_energy


@pytest.mark.parametrize("joints", ["mixed", "balls-10"])
def test_mujoco_s_solvers_have_nothing_to_do(joints):
    """Solver and Jacobian are of active constraints: without any, the answers are the same bit for bit."""
    mujoco = pytest.importorskip("mujoco")
    engine = pytest.importorskip("adapters.mujoco_engine")
    model = pendulums.make_model(joints, loads=True, drag=True)
    usual = load_adapter("mujoco").evaluate(model, random_states_of(model))
    kinds, jacobians = ("PGS", "CG", "NEWTON"), ("DENSE", "SPARSE")
    for kind, jacobian in product(kinds, jacobians):
        chain = engine._MujocoChain(model)
        chain.m.opt.solver = getattr(mujoco.mjtSolver, f"mjSOL_{kind}")
        chain.m.opt.jacobian = getattr(mujoco.mjtJacobian, f"mjJAC_{jacobian}")
        for at, right in zip(random_states_of(model), usual, strict=True):
            reported = chain.quantities(at)
            assert chain.d.nefc == 0
            compared = {q: value for q, value in vars(right).items() if value is not None}
            assert {"acceleration", "joint_reaction"} <= set(compared)
            assert all(np.array_equal(getattr(reported, q), value) for q, value in compared.items())


def test_an_option_that_there_is_not_is_refused():
    with pytest.raises(KeyError, match="dense mass matrix"):
        load_adapter("mujoco").with_option("sparse")
    with pytest.raises(Unsupported, match="rigidly"):
        load_adapter("reference").with_welded_halves()


# -- short runs ------------------------------------------------------------------------------------


LINEAR_SOLVER_RELATIONS = "by EXUdense", "by EigenDense"  # besides the usual one


@cache
def exudyn_adapter():
    return pytest.importorskip("adapters.exudyn_engine").Exudyn


def trapezoidal_integrator():
    return exudyn_adapter()().integrator("trapezoidal")


def relation_result(engine, relation, joints="balls", integrator="trapezoidal"):
    model = pendulums.make_model(joints)
    (found,) = (
        held
        for held in check_run_relations(engine, model, pendulums.state_from_seed(model, 1))
        if (held.relation, held.integrator) == (relation, integrator)
    )
    return found


def test_runs_take_sixteen_steps_of_at_most_a_thirtieth_of_a_radian_each_way():
    model = pendulums.make_model("balls")
    at = pendulums.state_from_seed(model, 1)
    found = list(check_run_relations(exudyn_adapter()(), model, at))
    assert [(held.integrator, held.relation) for held in found] == [
        ("trapezoidal", "reversed in time"),
        *(("trapezoidal", name) for name in LINEAR_SOLVER_RELATIONS),
        *(("generalized-alpha", name) for name in LINEAR_SOLVER_RELATIONS),
    ]
    for held in found:
        assert held.steps == (32 if held.relation == "reversed in time" else 16)
        assert held.end_time == 16 * held.resolution and np.log2(held.resolution) % 1 == 0
        assert 0.5 < 32 * fastest_rate(model, at) * held.resolution <= 1
    reference = load_adapter("reference")
    (back,) = check_run_relations(reference, model, at)
    (method,) = (method for method in reference.integrators if method.is_symmetric)
    assert (back.end_time, back.resolution) == (found[0].end_time, method.min_rtol)


@pytest.mark.parametrize("joints", ["balls", "rods", "mixed"])
def test_a_symmetric_integrator_comes_back(joints):
    assert relation_result(exudyn_adapter()(), "reversed in time", joints).ratio < 0.3
    assert relation_result(load_adapter("reference"), "reversed in time", joints, "collocation").ratio < 0.3


def with_drag(real):
    """A millionth of a newton metre second on every body: it knows the direction of time."""

    class Damped(real):
        def _simulate_round_trip(self, model, *more):
            return super()._simulate_round_trip(model.changed(drag_moment=np.full(model.n, 1e-6)), *more)

    return Damped


@pytest.mark.parametrize("engine", ["exudyn", "reference"])
def test_damping_is_not_reversed(engine):
    real = with_drag(type(load_adapter(engine)))
    integrator = next(i.name for i in real.integrators if i.is_symmetric)
    assert relation_result(real(), "reversed in time", integrator=integrator).ratio > 1


def test_a_scheme_that_is_not_symmetric_does_not_come_back():
    class Alpha(exudyn_adapter()):
        integrators = tuple(replace(i, is_symmetric=True) for i in exudyn_adapter().integrators)

    assert relation_result(Alpha(), "reversed in time").ratio < 0.3
    assert relation_result(Alpha(), "reversed in time", integrator="generalized-alpha").ratio > 1e3


def test_accelerations_that_are_not_carried_break_the_way_back():
    class Forgetful(exudyn_adapter()):
        def _run_samples(self, chain, times, settings, step):
            settings.timeIntegration.generalizedAlpha.computeInitialAccelerations = True
            return super()._run_samples(chain, times, settings, step)

    assert relation_result(Forgetful(), "reversed in time").ratio > 1


@pytest.mark.parametrize("engine", ["exudyn", "exudyn-tree"])
def test_a_linear_solver_that_solves_something_else_is_seen(engine):
    sound = load_adapter(engine)
    faulty = plant(replace(defect_named("distal-1e-5"), engine=engine))
    sound.with_option = faulty.with_option
    for held in check_run_relations(
        sound, model := pendulums.make_model("balls"), pendulums.state_from_seed(model, 1)
    ):
        assert (held.ratio > 1) == held.relation.startswith("by "), held


def test_drag_is_not_reversed_and_a_failing_run_is_reported():
    model = pendulums.make_model("ball", drag=True)
    found = list(check_run_relations(exudyn_adapter()(), model, pendulums.state_from_seed(model)))
    assert found and not any(held.relation == "reversed in time" for held in found)

    class Failing(exudyn_adapter()):
        def _run_samples(self, *_, **__):
            raise EngineFailure("it stopped")

    model = pendulums.make_model("ball")
    found = list(check_run_relations(Failing(), model, pendulums.state_from_seed(model)))
    rows = judge_relations(RowContext("s", "f", "e", "E", "0"), found).rows
    assert {(row.verdict, row.reason) for row in rows} == {("failed", "it stopped")}
    solved = [(name, way) for name in ("trapezoidal", "generalized-alpha") for way in LINEAR_SOLVER_RELATIONS]
    assert [(row.integrator, row.quantity) for row in rows] == [("trapezoidal", "reversed in time"), *solved]


def test_a_solver_with_which_a_run_fails_is_reported():
    class Half(exudyn_adapter()):
        def with_option(self, option):
            found = super().with_option(option)
            found._simulate = failing
            return found

    def failing(*_):
        raise EngineFailure("it stopped")

    model = pendulums.make_model("ball")
    back, *others = check_integrator_relations(
        Half(), trapezoidal_integrator(), model, pendulums.state_from_seed(model), 1 / 512, 1.5
    )
    assert back.ratio < 0.3
    assert [(h.relation, h.integrator, h.no_answer.message) for h in others] == [
        (way, "trapezoidal", "it stopped") for way in LINEAR_SOLVER_RELATIONS
    ]
    assert not any(h.no_answer.is_refusal for h in others)


def test_two_solvers_may_both_be_off():
    found = relation_result(exudyn_adapter()(), "by EigenDense", "mixed")
    model = pendulums.make_model("mixed")
    at = pendulums.state_from_seed(model, 1)
    ends = [
        state_at_sample(
            way.simulate(model, at, np.array([0.0, found.end_time]), "trapezoidal", found.resolution), -1
        )
        for way in (exudyn_adapter()(), exudyn_adapter()().with_option("EigenDense"))
    ]
    grown = run_growth(model, at)[0]
    limit = 2 * run_tolerance(trapezoidal_integrator(), model, at, found.end_time, 16, grown)
    assert found.ratio > 0
    assert found.ratio == pytest.approx(max(relative_differences(model, *ends).values()) / limit, rel=1e-9), (
        "the same runs"
    )


def test_runs_by_tolerance_have_no_solvers_and_are_not_tried_finer():
    tried = []

    class Failing(type(load_adapter("reference"))):
        linear_solvers = ("never",)

        def _simulate_round_trip(self, *_):
            tried.append(1)
            raise EngineFailure("it stopped")

    model = pendulums.make_model("ball")
    (held,) = check_run_relations(Failing(), model, pendulums.state_from_seed(model))
    assert (held.relation, held.no_answer.message, len(tried)) == ("reversed in time", "it stopped", 1)


def test_a_step_too_coarse_to_be_solved_is_taken_finer():
    tried = []

    class Stiff(exudyn_adapter()):
        def _run_samples(self, chain, times, settings, step):
            tried.append(step)
            if step > max(tried) / 4:
                raise EngineFailure("no convergence")
            return super()._run_samples(chain, times, settings, step)

    found = relation_result(Stiff(), "reversed in time")
    assert found.ratio < 0.3 and min(tried) == max(tried) / 4


def test_a_light_body_among_heavy_ones_is_solved_less_sharply():
    """The step's residual is small beside the heaviest body's: 2.6 times over without the ratio of masses."""
    rng = np.random.default_rng([7, 174])
    n, _ = int(rng.integers(1, 9)), rng.choice(3)
    rods, rate = list(rng.random(n) < 0.4), float(rng.choice([0.5, 2, 10]))
    loads, _ = rng.random() < 0.5, rng.random()
    model, state = random_chain(rng, rods, mass_decades=3, rate=rate, loads=bool(loads))
    assert np.max(model.mass) > 1e2 * np.min(model.mass)
    (held,) = (
        h for h in check_run_relations(exudyn_adapter()(), model, state) if h.relation == "reversed in time"
    )
    assert held.ratio < 0.3
