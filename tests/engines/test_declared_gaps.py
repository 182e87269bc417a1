"""Gaps that a column declares are expected; refusals that it does not declare, and false ones, count."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines import engine_calls
from plumbline.engines.registry import ENGINES, load_adapter
from plumbline.judging import known_issues
from plumbline.judging.rows import RowContext
from plumbline.judging.state_level import judge_states
from plumbline.model.datatypes import EngineFailure, Unsupported
from plumbline.model.sampling import random_states
from plumbline.truth.ground_truth import state_truth
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario

CONTEXT = RowContext("s", "f", "reference", "Reference", "1")


def rows_of(adapter, monkeypatch, joints="bb"):
    """State-level rows of an adapter, as a run gets them."""
    monkeypatch.setattr(engine_calls, "load_adapter", lambda _: adapter)
    model = pendulums.make_model(joints)
    states = random_states(model, 2, seed=1)
    return judge_states(
        CONTEXT, state_truth(model, states), engine_calls.evaluate_states("reference", model, states, [])
    ).rows


def make_adapter(**attributes):
    base = type(load_adapter("reference"))
    return type("Changed", (base,), attributes)()


def refusing(gap):
    def evaluate(self, model, states):
        raise Unsupported("not on a Monday", gap)

    return evaluate


def test_a_refusal_by_a_declared_gap_is_expected(monkeypatch):
    adapter = make_adapter(unsupported={"balls": "no balls here"}, _evaluate=refusing("balls"))
    (row,) = rows_of(adapter, monkeypatch)
    assert (row.verdict, row.known_issue, row.reason) == ("unsupported", "balls", "not on a Monday")
    assert row.is_declared


@pytest.mark.parametrize("gap", ["", "balls", "loops"])
def test_a_refusal_that_is_not_declared_counts(gap, monkeypatch):
    (row,) = rows_of(make_adapter(_evaluate=refusing(gap)), monkeypatch)
    assert (row.verdict, row.known_issue) == ("unsupported", None)


@pytest.mark.parametrize("gap", ["mass_matrix", "integrators"])
def test_a_gap_of_a_quantity_or_of_motions_is_no_reason_to_refuse_states(gap, monkeypatch):
    adapter = make_adapter(unsupported={gap: "there is none"}, _evaluate=refusing(gap))
    (row,) = rows_of(adapter, monkeypatch)
    assert (row.verdict, row.known_issue, row.is_declared) == ("unsupported", None, False)


def test_a_refusal_for_what_the_mechanism_does_not_have_is_a_failure(monkeypatch):
    adapter = make_adapter(unsupported={"rods": "no rods here"}, _evaluate=refusing("rods"))
    (row,) = rows_of(adapter, monkeypatch)
    assert row.verdict == "failed" and "for its rods, and it has none" in row.reason
    with pytest.raises(EngineFailure):
        adapter.evaluate(model := pendulums.make_model("b"), random_states(model, 1, seed=1))


def test_a_quantity_that_is_declared_missing_and_returned_is_a_failure(monkeypatch):
    adapter = make_adapter(unsupported={"mass_matrix": "there is no mass matrix"})
    (row,) = rows_of(adapter, monkeypatch)
    assert row.verdict == "failed" and "returns the mass_matrix" in row.reason


def test_a_missing_quantity_is_expected_where_it_is_declared(monkeypatch):
    whole = type(load_adapter("reference"))

    def without_energy(self, model, states):
        return [replace(a, kinetic_energy=None) for a in whole._evaluate(self, model, states)]

    for declared, known in (({}, None), ({"kinetic_energy": "no energy"}, "kinetic_energy")):
        rows = rows_of(make_adapter(unsupported=declared, _evaluate=without_energy), monkeypatch)
        (gap,) = [row for row in rows if row.verdict == "unsupported"]
        assert (gap.quantity, gap.known_issue) == ("kinetic_energy", known)


@pytest.mark.parametrize("gap", ["balls", "chains"])
def test_the_engine_never_gets_a_mechanism_with_a_declared_gap(gap, monkeypatch):
    def evaluate(self, model, states):
        raise AssertionError("the engine was reached")

    (row,) = rows_of(make_adapter(gaps={gap: "not here"}, _evaluate=evaluate), monkeypatch)
    assert (row.known_issue, row.is_declared, row.reason) == (gap, True, "not here")


def test_an_entry_for_a_declared_gap_is_used_and_not_stale(monkeypatch):
    adapter = make_adapter(unsupported={"balls": "no balls here"}, _evaluate=refusing("balls"))
    rows = rows_of(adapter, monkeypatch)
    entry = known_issues.KnownIssue("mine", "s", "reference", "unsupported", "a test", "a test")
    excuses = known_issues.KnownIssues([entry], has_extra_refinements=False)
    assert [row.known_issue for row in excuses.mark_known(rows, 2)] == ["mine"]
    assert excuses.stale_issues(is_full_matrix=True) == []


def test_a_refusal_keeps_its_gap_between_processes():
    again = pickle.loads(pickle.dumps(Unsupported("not here", "rods")))
    assert (str(again), again.gap) == ("not here", "rods")


@pytest.mark.parametrize("engine", ENGINES)
def test_every_refusal_in_the_catalogue_is_declared(engine):
    """The base class or the adapter refuses with a declared gap, or evaluates."""
    adapter = load_adapter(engine)
    names = (
        "double-tumbling-rods",
        "sprung-ball",
        "sprung-universal",
        "four-bar",
        "point-mass-arm",
        "furuta",
    )
    for name in names:
        s = catalogue_scenario(name)
        found = engine_calls.evaluate_states(engine, s.model, [s.state], [])
        if found.no_answer:
            assert found.no_answer.gap, f"{engine}, {name}: {found.no_answer.message}"
        else:
            assert np.all(np.isfinite(found.quantities[0].acceleration)) and adapter.name == engine
