"""The coverage table: its figures are what real runs report, and no parameter is blind."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.judging.coverage import COVERED_LEVELS, scenario_coverage
from plumbline.model.sampling import random_states
from plumbline.scenario import loader as scenarios
from plumbline.studies.coverage import blind_spots, summarize_coverage
from plumbline.truth.parameter_effects import StateSensitivity, initial_state_effects
from plumbline.truth.parameters import STATE_KINDS, UNITS, list_parameters, perturb
from plumbline.truth.rounding_bound import EPS
from tests.helpers import pendulums
from tests.helpers.coverage_confirmation import coverage, is_reported, scenario, states

QUICK = ("drag-rod", "double-aligned")


def generic(pattern="rods"):
    model = pendulums.make_model(pendulums.JOINT_PATTERNS[pattern], loads=True, drag=True)
    return model, random_states(model, 1, seed=4)[0]


def catalogue(most_bodies):
    models = {name: scenario(name).model for name in scenarios.catalogue()}
    return [name for name, model in models.items() if model.is_chain and model.n <= most_bodies]


def confirmed_entries(names, count, seed):
    """Random entries, spread evenly over scenarios and levels; figures of one rounding cannot be halved."""
    rng = np.random.default_rng(seed)
    chosen = []
    while len(chosen) < count:
        name, level = rng.choice(names), rng.choice(COVERED_LEVELS)
        entries = [e for e in coverage(str(name), str(level)) if e.smallest and e.smallest > 2 * EPS]
        if entries:
            chosen.append(entries[rng.integers(len(entries))])
    return chosen


def wrong_figures(entries):
    found = []
    for entry in entries:
        if is_reported(entry, 0.5):
            found.append(f"reported at half: {entry}")
        if not is_reported(entry, 2.0):
            found.append(f"not reported at twice: {entry}")
    return found


def test_mistakes_of_twice_the_figure_are_reported_and_of_half_are_not():
    assert wrong_figures(confirmed_entries(QUICK, 8, seed=5)) == []


@pytest.mark.full
@pytest.mark.timeout(7200)
def test_two_hundred_figures_of_the_catalogue():
    """Chains of thirty and fifty are left out: the truth of their states alone takes minutes."""
    assert wrong_figures(confirmed_entries(catalogue(10), 200, seed=6)) == []


def test_every_number_of_a_model_is_a_parameter():
    model, state = generic()
    parameters = list_parameters(model, state)
    counts = {kind: sum(one.kind == kind for one in parameters) for kind in UNITS}
    n = model.n
    assert counts == {
        "gravity": 3, "mass": n, "inertia": 6 * n, "proximal": 3 * n, "distal": 3 * (n - 1), "length": n,
        "force": 3 * n, "moment": 3 * n, "drag_force": n, "drag_moment": n, "attitude": 3 * n,
        "omega": 3 * n, "direction": 2 * n, "rod_rate": 2 * n,
    }  # fmt: skip
    assert set(model.fields) == set(UNITS) - set(STATE_KINDS)
    for one in parameters:
        changed, moved = perturb(model, state, one, 1e-3)
        names = {
            name for name in model.fields if not np.array_equal(getattr(model, name), getattr(changed, name))
        }
        assert names == (set() if one.kind in STATE_KINDS else {one.kind}), one
        if one.kind in STATE_KINDS:
            assert any(
                not np.array_equal(getattr(state, x), getattr(moved, x)) for x in ("p", "omega", "u", "udot")
            )


def test_effects_at_a_state_are_those_of_differences():
    """The terms written out for models against central differences of the whole evaluation.

    Their error is of second order in d: 7e-6 of the effect at d = 1e-3, 7e-8 at 1e-4 and rounding below.
    """
    from plumbline.engines.registry import load_adapter

    reference, d = load_adapter("reference"), 1e-4
    for pattern in ("rods", "balls"):
        model, state = generic(pattern)
        parameters = list_parameters(model, state)
        of_model = [one for one in parameters if one.kind not in STATE_KINDS]
        of_state = [one for one in parameters if one.kind in STATE_KINDS]
        for effects, chosen in (
            (StateSensitivity(model, state).effects(of_model), of_model),
            (initial_state_effects(model, state, of_state), of_state),
        ):
            for i, one in enumerate(chosen):
                plus, minus = (perturb(model, state, one, sign * d) for sign in (1, -1))
                answers = [reference.evaluate(m, [s])[0] for m, s in (plus, minus)]
                for quantity, effect in effects.items():
                    a, b = (np.atleast_1d(getattr(answer, quantity)) for answer in answers)
                    rate = (a - b) / (2 * d * one.scale)
                    size = np.max(np.abs(a)) / one.scale
                    norms = (
                        np.max(np.abs(rate)) if quantity == "mass_matrix" else np.linalg.norm(rate, axis=-1)
                    )
                    np.testing.assert_allclose(
                        effect[i], norms.reshape(effect[i].shape), rtol=1e-6, atol=1e-9 * size,
                        err_msg=f"{one}, {quantity}",
                    )  # fmt: skip


def test_the_table_of_a_scenario_has_every_parameter_once():
    s = scenario("free-top")
    entries = coverage("free-top", "step")
    names = [(e.body, e.parameter) for e in entries]
    assert len(set(names)) == len(names) == len(list_parameters(s.model, s.state))
    by_name = {e.parameter: e for e in entries}
    assert by_name["mass"].smallest is None and "joint forces alone" in by_name["mass"].proof
    assert by_name["inertia xx"].smallest < 1e-11 and not by_name["inertia xx"].proof
    assert by_name["drag_force"].smallest is None and "c ṙ, is zero" in by_name["drag_force"].proof


def test_proofs_hold_for_large_changes():
    """A mass of ten times the size, and a third of the inertia, change nothing in these motions."""
    planar = {e.parameter: e for e in coverage("planar-small", "trajectory")}
    assert planar["inertia zz"].proof and planar["inertia xz"].proof and not planar["inertia yy"].proof
    assert not is_reported(replace(planar["inertia zz"], smallest=-0.3), 1.0)
    assert not is_reported(replace(planar["inertia xz"], smallest=0.1), 1.0)
    top = {e.parameter: e for e in coverage("free-top", "trajectory")}
    assert top["mass"].proof and not is_reported(replace(top["mass"], smallest=9.0), 1.0)


def test_blind_spots_are_found():
    """Without drag on a later body, and without rods, sentences say so."""
    s = scenario("double-aligned")
    entries = scenario_coverage(s.name, s.model, s.state, s.times, [s.state], [], ("state",))
    found = blind_spots(entries)
    assert "state level: no scenario sees drag_force of a later body on a rod" in found
    assert not any("mass" in spot or "gravity" in spot for spot in found)
    for one in summarize_coverage(entries):
        assert one.entries == one.seen + one.invisible + one.blind


def test_no_parameter_is_blind_at_state_and_step_level():
    """Two bodies and six states suffice: later bodies on rods and on balls are among them."""
    entries = []
    for name in catalogue(2):
        s = scenario(name)
        arguments = s.name, s.model, s.state, s.times, states(name)[:6], []
        entries += scenario_coverage(*arguments, ("state", "step"))
    assert blind_spots(entries) == []


@pytest.mark.full
@pytest.mark.timeout(3600)
def test_no_parameter_is_blind_along_motions():
    """At every level, on chains of up to ten bodies; what is not seen has a proof.

    In motions that are steady to rounding only, an effect may be neither zero nor above rounding.
    """
    entries = [entry for name in catalogue(10) for level in COVERED_LEVELS for entry in coverage(name, level)]
    assert blind_spots(entries) == []
    unproven = {entry.scenario for entry in entries if entry.smallest is None and not entry.proof}
    assert [name for name in unproven if scenario(name).closed_form is None] == []
