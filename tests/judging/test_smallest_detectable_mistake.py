"""The coverage table: its figures are what real runs report, and no parameter is blind."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from plumbline.engines.registry import load_adapter
from plumbline.judging.rows import RowContext, Verdict
from plumbline.judging.smallest_detectable_mistake import (
    COVERED_LEVELS,
    WEAK_MISTAKE,
    _measure_further,
    _MotionTolerance,
    _Ratios,
    _relative_effect,
    scenario_coverage,
)
from plumbline.model.datatypes import KINDS
from plumbline.model.invariants import kinetic_energy
from plumbline.model.kinematics import complete_state, kinetic_energy_of_rotors, stack_states
from plumbline.model.sampling import compared_states
from plumbline.studies.coverage_study import blind_spots, summarize_coverage
from plumbline.truth.certified_state import certify_state
from plumbline.truth.parameter_effects import effects_at_states, evaluate_models
from plumbline.truth.parameters import STATE_KINDS, list_parameters, perturb, perturb_model
from plumbline.truth.rounding_bound import EPS, state_rounding_bound
from plumbline.truth.trajectory_truth import accurate_runs, perturbed_motions, resolved_motions
from tests.helpers.catalogue import catalogue_scenario, catalogue_scenarios
from tests.helpers.coverage_confirmation import coverage, is_reported, states
from tests.helpers.nightly_tests import SLOW

QUICK = ("drag-rod", "double-aligned")


def catalogue(most_bodies):
    return [name for name, s in catalogue_scenarios().items() if s.model.n <= most_bodies]


def levels_of(name):
    return ("state",) if catalogue_scenario(name).model.has_loops else COVERED_LEVELS


def confirmed_entries(names, count, seed):
    """Random entries, spread evenly over scenarios and levels; figures of one rounding cannot be halved."""
    rng = np.random.default_rng(seed)
    chosen = []
    while len(chosen) < count:
        name = str(rng.choice(names))
        level = rng.choice(levels_of(name))
        entries = [e for e in coverage(name, str(level)) if e.smallest and e.smallest > 2 * EPS]
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


def test_figures_of_a_free_body_are_those_of_the_wider_bound():
    """Pinocchio's step of a free body, a rigid motion, rounds more than MuJoCo's."""
    (position,) = (e for e in coverage("nesc-tumbling-brick", "step") if e.parameter == "position z")
    assert wrong_figures([position]) == []


@pytest.mark.parametrize(("name", "is_covered"), [("four-bar", False), ("hinge-pendulum", True)])
def test_loops_have_no_entries_of_steps_and_motions(name, is_covered):
    """With a wrong number an overconstrained loop locks: rows of its runs are left out."""
    s, context = catalogue_scenario(name), RowContext(name, "", "reference", "reference", "0")
    levels = ("trajectory", "invariants")
    rows = [
        context.make_row(level, "dop853", "position_limit", Verdict.AGREES, "", compared_until=s.duration)
        for level in levels
    ]
    with patch(
        "plumbline.judging.smallest_detectable_mistake._motion_entries", return_value=["entry"]
    ) as motions:
        found = scenario_coverage(name, s.model, s.state, s.times, [s.state], rows, levels)
    assert motions.called == bool(found) == is_covered
    if not is_covered:
        assert scenario_coverage(name, s.model, s.state, s.times, [s.state], rows, ("step",)) == []


@pytest.mark.parametrize(
    ("names", "count", "seed"),
    [
        (QUICK[:1], 1, 5),
        pytest.param(QUICK, 8, 5, marks=SLOW),
        pytest.param(("hinge-pendulum", "sprung-cylinder"), 6, 8, marks=SLOW),  # trees
        pytest.param(("four-bar",), 6, 9, marks=SLOW),
        # chains of thirty and fifty are left out: the truth of their states alone takes minutes
        pytest.param((), 200, 6, marks=[pytest.mark.full, pytest.mark.timeout(7200)]),
    ],
)
def test_mistakes_of_twice_the_figure_are_reported_and_of_half_are_not(names, count, seed):
    assert wrong_figures(confirmed_entries(names or catalogue(10), count, seed)) == []


def test_weak_effects_of_invariants_are_measured_where_they_pass_the_tolerance():
    """At mistakes of 1e-5 and 4e-5 one seemed to be linear: a figure of 4e-3, where 2e-4 is reported."""
    weak = [e for e in coverage("double-conical", "invariants") if (e.smallest or 0) > 4e-5]
    assert {e.parameter for e in weak} == {"inertia zz", "inertia xz"}
    assert wrong_figures(weak) == []


@pytest.mark.parametrize(
    ("effect", "figure"),
    [
        (lambda size: 1e-16 * (1 + (size > 1e-5)), None),  # an ulp or two: rounding
        (lambda size: 1e-9 * size + 2e-16, 1e-3), (lambda size: 1e-8 * size**2 + 2e-16, 1e-2),
        (lambda size: 1e-13 * size, None),
    ],
)  # fmt: skip
def test_an_effect_is_not_extrapolated(effect, figure):
    """A tolerance of 1e-12 that the first mistakes do not pass, by whatever the effect seems to be."""
    row = RowContext("s", "", "e", "e", "0").make_row("invariants", "i", "norm_drift", Verdict.AGREES, "")
    tolerance = _MotionTolerance(row, "norm_drift", 1e-12, 0)
    by_engine = {"e": _Ratios(1)}
    by_engine["e"].add(0, 13.3, "i norm_drift")

    def measured(chosen, size, is_fine=False):
        return {"norm_drift": np.full((len(chosen), 1), effect(size))}

    _measure_further([tolerance], by_engine, {}, measured)
    ratio = by_engine["e"].ratio[0]
    assert ratio == pytest.approx(1 / figure, rel=0.02) if figure else ratio < 10


@pytest.mark.parametrize(
    ("effect", "figure"),
    [
        (lambda size, step: size, 1e-12),
        (lambda size, step: size * (1 + 0.2 * step**4), 1e-12),
        (lambda size, step: size * step**4, None),  # the integrator's error
        (lambda size, step: size**2, 1e-6),
        (lambda size, step: size**2 + 2e-5 * size * step**4, None),
        (lambda size, step: size**2 * step**4, None),
        (lambda size, step: 1e-14 * (1 + 0.5 * (size > 1e-5)), None),  # rounding
    ],
)
def test_the_order_of_an_effect_is_found(effect, figure):
    """By a mistake of 1e-5, and at steps of two thirds by one of 4e-5 and the same."""
    at = [effect(1e-5, 1.0), effect(4e-5, 2 / 3), effect(1e-5, 2 / 3)]
    ratio = _relative_effect(at[0], at[1:], tolerance=1e-12, size=1e-5)
    assert ratio == pytest.approx(1 / figure if figure else 0.0, rel=0.1)
    without_the_last = _relative_effect(at[0], at[1:2], tolerance=1e-12, size=1e-5)
    if figure == 1e-12:
        assert without_the_last == ratio
    else:  # nothing, or too weak an effect to count without the last
        assert without_the_last * WEAK_MISTAKE <= 1


@pytest.mark.parametrize("name", ["double-tumbling-rods", "drag-rod", "acrobot", "sprung-hinge"])
def test_deviations_are_differences_of_accurate_motions(name):
    s = catalogue_scenario(name)
    times, parameters, mistake = s.times[:9:2], list_parameters(s.model, s.state)[3::11], 1e-3
    cases = [perturb(s.model, s.state, one, mistake) for one in parameters]
    true, *others = accurate_runs([(s.model, s.state), *cases], times)
    for motion in resolved_motions(s.model, s.state, times, parameters):
        for one, other in zip(perturbed_motions(motion, parameters, mistake), others, strict=True):
            for field in ("r", "v"):
                change = getattr(other, field) - getattr(true, field)
                error = getattr(one.run, field) - getattr(one.true, field) - change
                assert np.max(np.abs(error)) <= 0.01 * np.max(np.abs(change)) + 1e-11, one.parameter


@pytest.mark.parametrize("name", ["double-loaded-rods", "loaded-tree", "tree-of-seven-sprung"])
def test_every_number_of_a_model_is_a_parameter(name):
    """One parameter for every number of every field, and a change of one number changes its field only."""
    s = catalogue_scenario(name)
    model, state = s.model, s.state
    parameters, changed_places, fields = list_parameters(model, state), {}, model.fields
    for one in parameters:
        changed, moved = perturb(model, state, one, 1e-3)
        new = changed.fields
        names = [x for x in fields if x != "kind" and not np.array_equal(fields[x], new[x])]
        if one.kind in STATE_KINDS:
            values = ("p", "omega", "u", "udot", "x", "xdot", "r", "v")
            assert names == [] and any(
                not np.array_equal(getattr(state, x), getattr(moved, x)) for x in values
            )
            continue
        assert len(names) == 1, one
        changed_places.setdefault(names[0], set()).update(
            map(tuple, np.argwhere(fields[names[0]] != new[names[0]]))
        )
    held = {x for x in fields if x not in ("kind", "body", "spring_body") and np.any(fields[x])}
    for x in held:
        used = {tuple(place) for place in np.argwhere(fields[x] != 0)}
        if (
            x == "turn"
        ):  # a turn changes all four numbers; of rods, balls without springs and free bodies none
            used = {place for place in used if not KINDS[model.kind[place[0]]].has_attitude}
        if x == "point":
            used = {place for place in used if model.kind[place[0]] != "free"}
        assert used <= changed_places.get(x, set()), x


@pytest.mark.parametrize("name", ["double-loaded-rods", "double-loaded-balls", "loaded-tree"])
def test_effects_at_a_state_are_those_of_differences(name):
    """Against central differences of the reference's whole evaluation.

    The error of a difference is of second order in d: 7e-6 of the effect at d = 1e-3, 7e-8 at 1e-4 and
    rounding below.
    """
    reference, d, rtol = load_adapter("reference"), 1e-4, 1e-6
    s = catalogue_scenario(name)
    model, state = s.model, s.state
    parameters = list_parameters(model, state)
    (effects,) = effects_at_states(model, [state], parameters)
    for i, one in enumerate(parameters):
        plus, minus = (perturb(model, state, one, sign * d) for sign in (1, -1))
        answers = [reference.evaluate(m, [s])[0] for m, s in (plus, minus)]
        for quantity, effect in effects.items():
            if getattr(answers[0], quantity) is None:
                assert not np.any(effect)
                continue
            a, b = (np.atleast_1d(getattr(answer, quantity)) for answer in answers)
            rate = (a - b) / (2 * d * one.scale)
            size = np.max(np.abs(a)) / one.scale
            norms = np.max(np.abs(rate)) if quantity == "mass_matrix" else np.linalg.norm(rate, axis=-1)
            np.testing.assert_allclose(
                effect[i], norms.reshape(effect[i].shape), rtol=rtol, atol=rtol * 1e-3 * size,
                err_msg=f"{one}, {quantity}",
            )  # fmt: skip


def test_effects_in_a_loop_are_those_of_differences():
    """Of numbers with which the loop can still move.

    (f(d) − f(−d)) / 2d is off by the rounding of both answers, each within its bound b, over 2d: by b/d. Its
    term of d² is 0.2 d² of the effect (2e-5 at d = 1e-2), here a thousandth of b/d.
    """
    reference, d = load_adapter("reference"), 1e-4
    s = catalogue_scenario("flyball-governor")
    model, state = s.model, s.state
    kinds = ("mass", "inertia", "force", "moment", "drag_moment", "stiffness", "damping", "effort", "rest")
    some = [one for one in list_parameters(model, state) if one.kind in kinds and one.body < 4]
    effects, bound = effects_at_states(model, [state], some)[0], state_rounding_bound(model, state)
    for i, one in enumerate(some):
        plus, minus = (reference.evaluate(perturb(model, state, one, x)[0], [state])[0] for x in (d, -d))
        for quantity, effect in effects.items():
            rate = np.atleast_1d(getattr(plus, quantity) - getattr(minus, quantity)) / (2 * d * one.scale)
            norms = np.linalg.norm(rate.reshape(*effect[i].shape, -1), axis=-1)
            allowed = np.max(bound.tolerance(quantity)) / (d * one.scale)
            np.testing.assert_allclose(effect[i], norms, rtol=0, atol=allowed, err_msg=f"{one}, {quantity}")


@pytest.mark.parametrize("name", ["bricard", "flyball-governor", "crowded-loops-bare", "crowded-loops-3"])
def test_loops_without_a_mistake_have_the_quantities_of_the_truth(name):
    """With dependent rows, rods, several loops; of changed points, energies are those of whole bodies."""
    model = catalogue_scenario(name).model
    states = compared_states(model, catalogue_scenario(name).state, name, 2)[1:]
    one = next(x for x in list_parameters(model, states[0]) if x.kind == "proximal")
    changed, at = perturb_model(model, one, 0.1), stack_states(states)
    cases = [(model, at), (changed, complete_state(changed, at))]
    found = evaluate_models(model, states, cases)
    for i, state in enumerate(states):
        truth, bound = certify_state(model, state).quantities, state_rounding_bound(model, state)
        for quantity, values in found.items():
            true, own = getattr(truth, quantity), np.max(bound.tolerance(quantity))
            if true is not None:
                np.testing.assert_allclose(values[0, i], true, rtol=0, atol=own, err_msg=quantity)
        own = cases[1][1][i]
        energy = kinetic_energy(changed, own.v, own.omega) + kinetic_energy_of_rotors(changed, own)
        # the same sums of the same size, of points that are off by a tenth
        assert abs(found["kinetic_energy"][1, i] - energy) <= bound.tolerance("kinetic_energy")


def test_the_table_of_a_scenario_has_every_parameter_once():
    s = catalogue_scenario("free-top")
    entries = coverage("free-top", "step")
    names = [(e.body, e.parameter) for e in entries]
    assert len(set(names)) == len(names) == len(list_parameters(s.model, s.state))
    by_name = {e.parameter: e for e in entries}
    assert by_name["mass"].smallest is None and "no acceleration" in by_name["mass"].proof
    assert by_name["inertia xx"].smallest < 1e-11 and not by_name["inertia xx"].proof
    assert by_name["drag_force"].smallest is None and "no acceleration" in by_name["drag_force"].proof


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
    s = catalogue_scenario("double-aligned")
    entries = scenario_coverage(s.name, s.model, s.state, s.times, [s.state], [], ("state",))
    found = blind_spots(entries)
    assert "state level: no scenario sees drag_force of a later body on a rod" in found
    assert not any("mass" in spot or "gravity" in spot for spot in found)
    for one in summarize_coverage(entries):
        assert one["entries"] == one["seen"] + one["invisible"] + one["blind"]


def test_no_parameter_is_blind_at_state_and_step_level():
    """Two bodies or the loaded tree and six states suffice: every kind of joint is among them."""
    entries = []
    for name in [*catalogue(2), "loaded-tree", "tree-of-seven-sprung", "four-bar"]:
        s = catalogue_scenario(name)
        levels = (
            ("state", "step") if s.model.has_chain_joints else ("state",)
        )  # steps of trees: with the motions
        entries += scenario_coverage(s.name, s.model, s.state, s.times, states(name)[:6], [], levels)
    assert blind_spots(entries) == []


@pytest.mark.full
@pytest.mark.timeout(3600)
def test_no_parameter_is_blind_along_motions():
    """At every level, steps of trees included, of up to ten bodies; what is not seen has a proof."""
    entries = [
        entry for name in catalogue(10) for level in levels_of(name) for entry in coverage(name, level)
    ]
    assert blind_spots(entries) == []
    assert [e for e in entries if e.smallest is None and not e.proof] == []
