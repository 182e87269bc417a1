"""Relations that need no truth: they hold on every engine, and each breaks under a defect of its kind."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from plumbline.findings import Subject
from plumbline.records import Unsupported
from plumbline.registry import ENGINES, adapter
from plumbline.relations import RELATIONS, check, judge_relations
from plumbline.suspect import answer, case
from tests import pendulums
from tests.pendulums import JOINTS
from tests.planted import STATE_DEFECTS, Defect, field, model_change, parameter, plant

for engine in ("mujoco", "pinocchio", "exudyn"):
    pytest.importorskip(engine)


def states(model):
    return [pendulums.state(model, seed) for seed in range(3)]


@pytest.mark.parametrize("joints", ["ball", "rods", "mixed"])
def test_the_ways_back_are_those_of_the_equations(joints):
    """Each relation on an independent solution, loads and drag included: the algebra of there and back."""
    model = pendulums.model(JOINTS[joints], loads=True, drag=True)
    for relation in RELATIONS:
        here = model if relation.name != "time reversed" else pendulums.model(JOINTS[joints], loads=True)
        for state in states(here):
            right = answer(case(here, [state]))
            other_model, other_state = relation.there(here, state)
            said = {q: x[0] for q, x in answer(case(other_model, [other_state])).items()}
            back = relation.back(other_model, _quantities(said))
            for q, x in back.items():
                np.testing.assert_allclose(x, right[q][0], rtol=1e-11, atol=1e-11 * np.max(np.abs(right[q])))


def _quantities(said):
    from plumbline.records import StateQuantities

    return StateQuantities(**{q: x if np.ndim(x) else float(x) for q, x in said.items()})


@pytest.mark.parametrize("joints", ["balls", "rod-ball"])
@pytest.mark.parametrize("engine", [e for e in ENGINES if "@" not in e])
def test_every_engine_keeps_every_relation(engine, joints):
    model = pendulums.model(JOINTS[joints], loads=True)
    found = check(engine, model, states(model))
    rows = judge_relations(Subject("s", "f", engine, engine, "0"), found).rows
    assert len(rows) >= 5 and all(row.verdict == "agrees" for row in rows), [r.reason for r in rows]


def of(name: str) -> Defect:
    return next(d for d in STATE_DEFECTS if d.name == name)


BROKEN = {
    "rotated world": (of("gravity-z"), of("gravity-axes"), of("bodies-exchanged")),
    "re-chosen body frame": (of("inertia-products-dropped"), of("inertia-xx-1e-6"), of("centre-0.1mm")),
    "masses doubled": (
        of("damping-1e-6"),
        Defect("gram", "mass of body 1 by 1e-3 kg", inputs=parameter("mass", 0, by=1e-3)),
    ),
    "lengths × 4": (of("distal-1e-5"), of("centre-0.1mm"), of("potential-origin")),
    "time reversed": (
        of("damping-1e-6"),
        of("spatial-acceleration"),
        Defect(
            "helical", "n′ + 1e-6 ω′", inputs=model_change(lambda m, s: {"moment": m.moment + 1e-6 * s.omega})
        ),
    ),
    "as exudyn-tree": (replace(of("mass-1-1e-5"), engine="exudyn"),),
}


@pytest.mark.parametrize("relation", BROKEN)
def test_a_defect_of_its_kind_breaks_it(relation):
    model = pendulums.model(JOINTS["balls"])
    broken = {}
    for defect in BROKEN[relation]:
        engine = plant(type(adapter(defect.engine)), defect)
        with patch(
            "plumbline.relations.adapter", lambda n, e=engine, d=defect: e if n == d.engine else adapter(n)
        ):
            broken |= {defect.name: any(h.relation == relation and h.ratio > 1
                                        for h in check(defect.engine, model, states(model)))}  # fmt: skip
    assert any(broken.values()) and broken[BROKEN[relation][0].name], broken


def test_a_refused_state_is_left_out_and_a_refusing_engine_is_told():
    class Refusing(type(adapter("mujoco"))):
        name = "refusing"

        def _evaluate(self, model, asked):
            raise Unsupported("not on a Monday")

    model = pendulums.model(JOINTS["ball"])
    with patch("plumbline.relations.adapter", lambda _: Refusing()):
        rows = judge_relations(Subject("s", "f", "e", "E", "0"), check("mujoco", model, states(model))).rows
    assert {(row.verdict, row.reason) for row in rows} == {("unsupported", "not on a Monday")}


def test_noise_breaks_what_is_not_bitwise():
    """An engine that loses digits is seen without any truth: as aba on thirty balls is."""
    rng = np.random.default_rng(5)
    noisy = Defect("noise", "1e-9", answers=field(
        "acceleration", lambda _, __, a: a * (1 + 1e-9 * rng.normal(size=a.shape))))  # fmt: skip
    engine = plant(type(adapter("mujoco")), noisy)
    model = pendulums.model(JOINTS["balls"])
    with patch("plumbline.relations.adapter", lambda _: engine):
        assert all(h.ratio > 1 for h in check("mujoco", model, states(model)))
