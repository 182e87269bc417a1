"""What decides a row at state level, on answers made for it."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.engine_calls import Evaluation, run_refinement
from plumbline.engines.no_answer import NoAnswer
from plumbline.engines.registry import load_adapter
from plumbline.judging.known_issues import KnownIssues, project_known_issues
from plumbline.judging.rows import RowContext
from plumbline.judging.state_level import STATE_UNITS, judge_states
from plumbline.judging.trajectory_level import judge_trajectory
from plumbline.model.sampling import random_states
from plumbline.truth.ground_truth import StateTruth, motion_truth
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers import pendulums

MODEL = pendulums.make_model("bb")
STATES = random_states(MODEL, 3, 1)
WHO = RowContext("s", "f", "reference", "Reference", "0")

# An error is added to accelerations and so rounded: half a unit in each of three components, of bounds that
# are 1478 units and more, is 1.2e-3 of half a bound.
ADDED = 2e-3
CHAIN_QUANTITIES = [quantity for quantity in STATE_UNITS if quantity != "joint_moment"]


def test_the_reason_of_an_inconclusive_row_states_the_measured_bound():
    bounds = [
        replace(b, acceleration=1e6 * b.acceleration) for b in map(state_rounding_bound, [MODEL] * 3, STATES)
    ]
    row = judge_shifted_answers((1, 1, 0.5), bounds=bounds).rows[0]
    assert (row.level, row.integrator, row.quantity, row.unit) == ("state", "-", "acceleration", "m/s²")
    assert row.verdict == "unresolved" and row.reason.startswith("inconclusive: the rounding bound is ")
    assert row.tolerance == bounds[1].acceleration[1] and row.ratio == pytest.approx(0.5)
    assert "at 3 of 3 states and in 6 of 6 comparisons" in row.reason and row.extra["compared_states"] == 0.0


def right_answers():
    return load_adapter("reference").evaluate(MODEL, STATES)


def sharp_bounds():
    return [state_rounding_bound(MODEL, s) for s in STATES]


def loosened(*states, body=slice(None), by=1e6):
    """The bounds with those of the acceleration at some states too loose, or not a number."""
    found = sharp_bounds()
    for state in states:
        acceleration = found[state].acceleration.copy()
        acceleration[body] *= by
        found[state] = replace(found[state], acceleration=acceleration)
    return found


@pytest.mark.parametrize(("loose", "verdict"), [((0,), "agrees"), ((0, 2), "unresolved")])
@pytest.mark.parametrize(
    ("body", "by"), [(slice(None), 1e6), (slice(None), np.nan), (1, np.nan), (1, np.inf), (0, 1e6)]
)
def test_each_state_counts_only_with_its_own_bound(loose, verdict, body, by):
    row = judge_shifted_answers((1, 0, 0.5), bounds=loosened(*loose, body=body, by=by)).rows[0]
    assert row.verdict == verdict, row.reason
    assert f"at {len(loose)} of 3 states and in " in row.reason
    assert row.extra["compared_states"] == 3 - len(loose) and row.ratio == pytest.approx(0.5, rel=ADDED)
    if verdict == "agrees":
        assert row.reason.startswith("acceleration within 0.5 of the rounding bound at 2 states; ")


@pytest.mark.parametrize(("by", "verdict"), [(0.3, "unresolved"), (1e-6, "agrees")])
def test_a_wrong_body_with_a_loose_bound_is_not_behind_one_with_a_sharp_bound(by, verdict):
    """Off by a share of its bound, which is 1e-4 of its scale, while the other is nearer to its own."""
    bounds = loosened(0, 1, 2, body=1, by=1e9)
    off = [(state, body, share) for state in range(3) for body, share in ((0, 0.5), (1, by))]
    row = judge_shifted_answers(*off, bounds=bounds).rows[0]
    assert row.verdict == verdict, row.reason
    assert row.extra["body"] == 1


@pytest.mark.parametrize("by", [1e6, np.nan])
def test_a_disagreement_in_any_state_decides_whatever_the_other_bounds_are(by):
    bounds = loosened(0, 1, 2, body=1, by=by)
    assert judge_shifted_answers((1, 0, 1.5), bounds=bounds).rows[0].verdict == "disagrees", (
        "a sharp body of a loose state"
    )
    assert judge_shifted_answers((2, 1, 1.5), bounds=loosened(0, 1, 2)).rows[0].verdict == "disagrees"


@pytest.mark.parametrize("drag", [False, True])
def test_implicitfast_is_an_alias_of_euler_only_without_drag(drag):
    """And where it is called one, it is Euler to the last bit."""
    model, times = pendulums.make_model("b", drag=drag), np.linspace(0, 0.5, 9)
    state = pendulums.state_from_seed(model, seed=2, rate=0.5)
    truth, mujoco = motion_truth(model, state, times, None), load_adapter("mujoco")
    steps = [2.0**-k for k in range(9, 13)]
    runs = {
        name: run_refinement("mujoco", name, model, state, times, steps) for name in ("Euler", "implicitfast")
    }
    same = np.array_equal(*(c.runs[-1].trajectory.r for c in runs.values()))
    fast = mujoco.integrator("implicitfast")
    rows = judge_trajectory(WHO, model, truth, fast, runs["implicitfast"]).rows
    assert {row.alias_of for row in rows} == ({None} if drag else {"Euler"})
    assert same is not drag


def judge_shifted_answers(*off, bounds=None, **evaluation):
    """Findings on answers that are ``off`` by so many bounds of acceleration: (state, body, bounds)."""
    right, bounds = right_answers(), bounds or sharp_bounds()
    reported = list(right)
    for state, body, by in off:
        shift = np.zeros((2, 3))
        shift[body] = by * bounds[state].acceleration[body] * np.array([2.0, -1.0, 2.0]) / 3
        reported[state] = replace(reported[state], acceleration=reported[state].acceleration + shift)
    answer = {"quantities": reported, "cpu_time": 0.25} | evaluation
    return judge_states(WHO, StateTruth(STATES, right, bounds, "itself"), Evaluation(**answer))


def test_the_row_is_of_the_body_that_is_worst_by_its_own_bound():
    bounds = sharp_bounds()
    # The larger error in m/s² is elsewhere: body 1 of state 0 gets a bound a thousand times as wide.
    wide = bounds[0].acceleration * [1e3, 1.0]
    bounds[0] = replace(bounds[0], acceleration=wide)
    small = [b.scale | {"acceleration": 1e-2 * b.scale["acceleration"]} for b in bounds]
    bounds = [replace(b, scale=scale) for b, scale in zip(bounds, small, strict=True)]
    found = judge_shifted_answers((0, 0, 0.5), (1, 0, 1.5), (2, 1, 3.0), bounds=bounds)
    row = found.rows[0]
    sharp = bounds[2].acceleration[1]
    assert (row.quantity, row.verdict, row.unit, row.level) == ("acceleration", "disagrees", "m/s²", "state")
    assert row.value == pytest.approx(3 * sharp, rel=ADDED, abs=0) and row.tolerance == sharp
    assert (row.extra["state"], row.extra["body"], row.extra["states"]) == (2.0, 2.0, 3.0)
    assert row.ratio == pytest.approx(3, rel=ADDED)
    assert row.cpu_time == 0.25
    assert "state 2, body 2" in row.reason and "2 of 3 states disagree" in row.reason
    assert row.derivation.endswith("truth: itself")
    (name, table), *_ = found.tables
    assert name == "states" and (table["scenario"], table["engine"]) == ("s", "reference")
    assert table["quantity"] == "acceleration"
    assert table["state"].tolist() == [0, 1, 2] and table["body"].tolist() == [0, 0, 1]
    assert table["error"] == pytest.approx(
        [0.5 * wide[0], 1.5 * bounds[1].acceleration[0], 3 * sharp], rel=ADDED, abs=0
    )
    assert table["bound"][[0, 2]].tolist() == [wide[0], sharp]
    scales = [bounds[i].scale["acceleration"][body] for i, body in ((0, 0), (1, 0), (2, 1))]
    assert table["scale"].tolist() == scales
    assert row.extra["relative"] == pytest.approx(max(table["error"] / scales), rel=1e-12, abs=0)
    relative = max(np.max(b.acceleration / b.scale["acceleration"]) for b in bounds)
    assert row.extra["bound_relative"] == pytest.approx(relative, rel=1e-12, abs=0)
    (_, table), *_ = judge_shifted_answers((0, 0, 0.5), (0, 1, 0.9), bounds=bounds).tables
    assert table["body"][0] == 1, "nearer to its bound, though less far off"


@pytest.mark.parametrize(("by", "expected"), [(0.98, "agrees"), (1.02, "disagrees")])
def test_one_bound_is_the_border(by, expected):
    rows = judge_shifted_answers((1, 0, by)).rows
    assert rows[0].verdict == expected
    assert all(
        row.verdict == "agrees" and row.value == 0 for row in rows[1:] if row.quantity != "mass_matrix"
    )
    assert [row.quantity for row in rows] == CHAIN_QUANTITIES
    assert [row.unit for row in rows] == ["m/s²", "rad/s²", "N", "J", "J", "kg m²/s", "kg m²"]
    assert {(row.level, row.integrator, row.engine) for row in rows} == {("state", "-", "reference")}
    assert rows[1].reason == "angular acceleration within 0 of the rounding bound at 3 states"
    assert rows[0].extra["bound_relative"] < 1e-9 and rows[1].ratio == 0.0


def test_quantities_that_an_engine_does_not_offer_or_deliver_are_reported():
    right = right_answers()
    less = [*right[:2], replace(right[2], joint_reaction=None)]
    rows = judge_shifted_answers(quantities=less).rows
    (row,) = (row for row in rows if row.quantity == "joint_reaction")
    assert (row.verdict, row.unit, row.level, row.integrator) == ("unsupported", "N", "state", "-")
    assert row.reason == "Reference offers no joint reaction of its own"
    assert len(rows) == len(CHAIN_QUANTITIES)
    for is_refusal, verdict in ((True, "unsupported"), (False, "failed")):
        (row,) = judge_shifted_answers(no_answer=NoAnswer("because", is_refusal)).rows
        assert (row.quantity, row.verdict, row.reason) == ("all", verdict, "because")
        assert (row.integrator, row.level, row.value) == ("-", "state", None)


def test_vectors_count_by_their_length_and_matrices_by_their_worst_entry():
    right = right_answers()
    matrix = right[0].mass_matrix.copy()
    matrix[0, 1] -= 1.0
    matrix[3, 4] += 0.5
    momentum = right[0].angular_momentum + np.array([2.0, 3.0, 6.0])
    energy = right[0].kinetic_energy - 5.0
    changed = replace(right[0], mass_matrix=matrix, angular_momentum=momentum, kinetic_energy=energy)
    rows = {row.quantity: row for row in judge_shifted_answers(quantities=[changed, *right[1:]]).rows}
    assert rows["mass_matrix"].value == 1.0
    assert rows["angular_momentum"].value == pytest.approx(7, rel=1e-12)
    assert rows["kinetic_energy"].value == pytest.approx(5, rel=1e-12)
    assert all(rows[q].extra["body"] == 1 for q in ("mass_matrix", "angular_momentum", "kinetic_energy"))


@pytest.mark.parametrize(("share", "verdict"), [(0.5, "disagrees"), (1.5, "agrees"), (1e6, "unresolved")])
def test_the_uncertainty_of_a_limit_widens_the_bound_and_is_stated(share, verdict):
    """An extrapolated answer off by two bounds, with an uncertainty of so many bounds."""
    reported, bounds = right_answers(), sharp_bounds()
    answers = [
        replace(
            a,
            acceleration=a.acceleration + [0, 0, 2] * b.acceleration[:, None],
            limit_error={"acceleration": share * float(np.max(b.acceleration))},
        )
        for a, b in zip(reported, bounds, strict=True)
    ]
    truth = StateTruth(STATES, reported, bounds, "itself")
    rows = judge_states(WHO, truth, Evaluation(answers)).rows
    row, others = rows[0], rows[1:]
    largest = share * max(float(np.max(b.acceleration)) for b in bounds)
    assert row.quantity == "acceleration" and row.verdict == verdict
    assert row.extra["limit_error"] == largest and f"{largest:.2g} m/s²" in row.derivation
    assert not any("limit" in other.derivation or "limit_error" in other.extra for other in others)


@pytest.mark.parametrize(("by", "is_known"), [(1.0, False), (1e6, True)])
def test_loose_bounds_of_random_chains_excuse_no_uncertainty_that_an_engine_states(by, is_known):
    """Unless the bounds are loose without it, too."""
    bounds = loosened(0, 1, 2, by=by)
    answers = [replace(a, limit_error={"acceleration": 1e3}) for a in right_answers()]
    truth = StateTruth(STATES, right_answers(), bounds, "itself")
    row = judge_states(replace(WHO, scenario="random-5-1"), truth, Evaluation(answers)).rows[0]
    assert (row.quantity, row.verdict) == ("acceleration", "unresolved")
    (found,) = KnownIssues(project_known_issues(), has_extra_refinements=False).mark_known([row], 2)
    assert (found.known_issue is not None) is is_known, found.reason


def test_a_scale_of_zero_is_no_reason_to_be_blunt():
    """At rest there is no kinetic energy, no tolerance for it, and 0 = 0."""
    still = [replace(s, omega=0 * s.omega, v=0 * s.v) for s in STATES]
    right = load_adapter("reference").evaluate(MODEL, still)
    bounds = [state_rounding_bound(MODEL, s) for s in still]
    found = judge_states(WHO, StateTruth(still, right, bounds, "itself"), Evaluation(right))
    row = next(row for row in found.rows if row.quantity == "kinetic_energy")
    assert (row.verdict, row.value, row.tolerance) == ("agrees", 0.0, 0.0)
    assert (row.extra["relative"], row.extra["bound_relative"]) == (0.0, 0.0)
