"""Diagnoses of answers made from the truth; those of engines are in `tests/execution/test_planted_*`."""

from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from plumbline.diagnosis.cause import Cause, describe, significant
from plumbline.diagnosis.diagnose import diagnose
from plumbline.diagnosis.edits import number_edits
from plumbline.diagnosis.prediction import QUANTITIES, Predictor, View, error_ratio
from plumbline.model.kinematics import (
    complete_state,
    rotation_matrix,
    spring_vectors,
)
from plumbline.model.loops import determinate_part
from plumbline.model.sampling import random_states
from plumbline.truth.ground_truth import state_truth
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario, states_of
from tests.helpers.nightly_tests import SLOW, nightly

pytest.importorskip("flint")
CHAIN, TREE, LOOP = "chain", "double-hinge-skew", "flyball-governor"


@cache
def known(name=CHAIN, count=8):
    if name == CHAIN or set(name) <= set("rb"):
        model = pendulums.make_model("bb" if name == CHAIN else name)
        return model, state_truth(model, random_states(model, count, seed=4))
    scenario = catalogue_scenario(name)
    states = states_of(scenario, count - 1)
    return scenario.model, state_truth(scenario.model, states)


def changed(quantity, to, name=CHAIN, count=8):
    """Model, answers and truth: the truth with ``to(index, value, bound)`` for one quantity."""
    model, truth = known(name, count)
    reported = [
        replace(a, **{quantity: to(i, getattr(a, quantity), np.asarray(b.tolerance(quantity)))})
        for i, (a, b) in enumerate(zip(truth.quantities, truth.bounds, strict=True))
    ]
    return model, reported, truth


def answers_of(changed_model, truth):
    """What an engine with another mechanism would return at the same coordinates."""
    states = [complete_state(changed_model, state) for state in truth.states]
    return state_truth(changed_model, states).quantities


def identity(cause):
    return cause.kind, cause.term, cause.place, cause.change


# -- outputs -----------------------------------------------------------------------------------------

TEN = {
    "reversed reaction": ("joint_reaction", "with the opposite sign", lambda m, s, a, b: -a.joint_reaction),
    "r̈ in body axes": ("acceleration", "in the body frame",
                        lambda m, s, a, b: np.matvec(rotation_matrix(s.p).mT, a.acceleration)),
    "α in world axes": ("angular_acceleration", "in the world frame",
                        lambda m, s, a, b: np.matvec(rotation_matrix(s.p), a.angular_acceleration)),
    "two bodies exchanged": ("acceleration", "", lambda m, s, a, b: a.acceleration[[1, 0, *range(2, m.n)]]),
    "2 T": ("kinetic_energy", "multiplied by", lambda m, s, a, b: 2 * a.kinetic_energy),
    "T/2": ("kinetic_energy", "multiplied by", lambda m, s, a, b: a.kinetic_energy / 2),
    "−V": ("potential_energy", "with the opposite sign", lambda m, s, a, b: -a.potential_energy),
    "proper acceleration": ("acceleration", "minus gravity", lambda m, s, a, b: a.acceleration - m.gravity),
    "stale r̈": ("acceleration", "of the previous state (a stale field)", lambda m, s, a, b: b.acceleration),
    "single precision": ("acceleration", "rounded to single precision",
                         lambda m, s, a, b: np.asarray(np.float32(a.acceleration), float)),
}  # fmt: skip


@cache
def cause_of_output(name, mistake):
    model, truth = known(name)
    quantity, _, of = TEN[mistake]
    before = [truth.quantities[-1], *truth.quantities[:-1]]
    reported = [
        replace(a, **{quantity: of(model, s, a, b)})
        for s, a, b in zip(truth.states, truth.quantities, before, strict=True)
    ]
    (cause,) = diagnose(model, reported, truth).causes
    return cause


FAST_ON_TREES = ("α in world axes", "two bodies exchanged", "−V")
FAST_ON_LOOPS = ("2 T",)  # each takes a second


@pytest.mark.parametrize(
    ("name", "mistake"),
    [
        pytest.param(name, mistake, marks=[] if mistake in fast else SLOW)
        for name, fast in ((CHAIN, TEN), (TREE, FAST_ON_TREES), (LOOP, FAST_ON_LOOPS))
        for mistake in TEN
    ],
)
def test_elementary_mistakes_in_outputs_are_named(name, mistake):
    cause, (quantity, change, _) = cause_of_output(name, mistake), TEN[mistake]
    assert (cause.kind, cause.term) == ("output", quantity.replace("_", " ")) and not cause.equal
    if mistake == "two bodies exchanged":
        assert cause.change == "exchanged" if name == LOOP else "of another body" in cause.change
    else:
        assert cause.change == change
        assert cause.amount == {"2 T": (2.0,), "T/2": (0.5,)}.get(mistake, ())


@pytest.mark.parametrize("name", [CHAIN, *nightly((TREE, LOOP))])
def test_different_mistakes_in_one_quantity_stay_apart(name):
    of_accelerations = [m for m, (quantity, *_) in TEN.items() if quantity == "acceleration"]
    pairs = list(combinations(of_accelerations, 2))
    assert len(pairs) == 10
    for one, other in pairs:
        assert cause_of_output(name, one).identity != cause_of_output(name, other).identity


def carried(model, forces):
    """Forces (N, 3) of bodies summed over those that each joint carries."""
    found = np.zeros((len(model.kind), 3))
    for body in range(model.n):
        k = body
        while k >= 0:
            found[k] += forces[body]
            k = model.body[k, 0]
    return found


def spring_forces(model, state, _):
    d = spring_vectors(model, state.r, state.p)
    ends = [state.v[b] + rotation_matrix(state.p[b]) @ np.cross(state.omega[b], x) if b >= 0 else np.zeros(3)
            for pair, points in zip(model.spring_body, model.spring_point, strict=True)
            for b, x in zip(pair, points, strict=True)]  # fmt: skip
    forces = np.zeros((model.n, 3))
    for i, (one, other) in enumerate(model.spring_body):
        length = np.linalg.norm(d[i])
        rate = d[i] @ (ends[2 * i + 1] - ends[2 * i]) / length
        pull = model.spring_stiffness[i] * (length - model.spring_length[i]) + model.spring_damping[i] * rate
        for body, sign in ((one, 1.0), (other, -1.0)):
            if body >= 0:
                forces[body] += sign * pull * d[i] / length
    return forces


def weights(model, state, _):
    return model.mass[:, None] * model.gravity


def closing_forces(model, state, answer):
    forces = np.zeros((model.n, 3))
    far, near = model.body[model.n]
    forces[near] += answer.joint_reaction[model.n]
    if far >= 0:
        forces[far] -= answer.joint_reaction[model.n]
    return forces


def with_parts(parts, model, truth):
    """Answers whose joint forces count parts of them otherwise."""
    reported = []
    for state, a in zip(truth.states, truth.quantities, strict=True):
        more = sum(share * carried(model, of(model, state, a)) for of, share in parts)
        reported.append(determinate(model, state, replace(a, joint_reaction=a.joint_reaction + more)))
    return reported


SPRUNG = "tree-of-seven-sprung"
PARTS = [
    (SPRUNG, "without the springs between points", [(spring_forces, 1)]),
    (SPRUNG, "with the springs between points of the opposite sign", [(spring_forces, 2)]),
    (SPRUNG, "with twice the weights", [(weights, -1)]),
    (SPRUNG, "with the weights multiplied by", [(weights, -0.25)]),
    (LOOP, "without that of the closing joint 5", [(closing_forces, 1)]),
    (SPRUNG, "without the weights and without the springs between points",
     [(weights, 1), (spring_forces, 1)]),
]  # fmt: skip
FAST_PARTS = (0, 3)


@pytest.mark.parametrize(
    ("name", "change", "parts"),
    [pytest.param(*part, id=part[1], marks=[] if k in FAST_PARTS else SLOW) for k, part in enumerate(PARTS)],
)
def test_a_joint_force_that_counts_a_part_otherwise_is_named(name, change, parts):
    model, truth = known(name, 5)
    causes = diagnose(model, with_parts(parts, model, truth), truth).causes
    assert {(cause.kind, cause.term) for cause in causes} == {("output", "joint reaction")}, causes
    assert sorted(cause.change for cause in causes) == sorted(change.split(" and "))
    assert all(cause.amount == ((1.25,) if "multiplied" in change else ()) for cause in causes)


def test_multipliers_of_welds_that_are_taken_for_their_moments_are_named():
    """As MuJoCo 3.13.0 does where a body is cut and welded: twice the moment, in the body's axes."""
    model, truth = known(LOOP, 5)
    reported = []
    for state, a in zip(truth.states, truth.quantities, strict=True):
        moment = a.joint_moment.copy()
        for k in range(model.n, len(model.kind)):
            far, body = model.body[k]
            A, J, omega = rotation_matrix(state.p[body]), model.inertia[body], state.omega[body]
            spin = A @ (J @ a.angular_acceleration[body] + np.cross(omega, J @ omega))
            arm = A @ model.point[k, 1]
            weld = spin / 2 - a.joint_moment[k] - np.cross(arm, a.joint_reaction[k])
            off = 2 * A.T @ weld - weld
            moment[k] -= off
            for at, sign in ((far, -1), (body, 1)):
                while at >= 0:
                    moment[at] += sign * off
                    at = model.body[at, 0]
        reported.append(determinate(model, state, replace(a, joint_moment=moment)))
    (cause,) = diagnose(model, reported, truth).causes
    assert cause.change == "with the moments of the welds in cut bodies doubled and in body axes", cause
    assert not cause.equal and cause.term == "joint moment"


def determinate(model, state, answer):
    return replace(determinate_part(model, state, answer), mass_matrix=None) if model.has_loops else answer


def test_the_part_of_one_body_in_a_sum_is_named():
    model, truth = known()
    energy = [0.5 * s.omega[1] @ model.inertia[1] @ s.omega[1] for s in truth.states]
    model, reported, truth = changed("kinetic_energy", lambda i, x, b: x - energy[i])
    (cause,) = diagnose(model, reported, truth).causes
    assert identity(cause) == ("output", "kinetic energy", "", "without the rotation of body 2")


@pytest.mark.parametrize("quantity", QUANTITIES[:3])
@pytest.mark.parametrize(
    ("to", "change", "amount"),
    [
        (lambda i, x, b: 1.25 * x, "multiplied by", (1.25,)),
        (lambda i, x, b: x + np.array([1e-3, 0, 2e-3]), "with a constant added at every state", ()),
    ],
)
def test_a_misread_quantity_is_named(quantity, to, change, amount):
    (cause,) = diagnose(*changed(quantity, to)).causes
    assert identity(cause) == ("output", quantity.replace("_", " "), "", change) and cause.amount == amount


@pytest.mark.parametrize(
    ("name", "to", "expected"),
    [
        ("joint_reaction", lambda x: x * [[1], [-1]], ("joint 2", "with the opposite sign")),
        ("acceleration", lambda x: 1.5 * x * [[1], [0]] + x * [[0], [1]], ("body 1", "multiplied by")),
    ],
)
def test_a_misread_quantity_of_one_body_is_named(name, to, expected):
    (cause,) = diagnose(*changed(name, lambda i, x, b: to(x))).causes
    assert identity(cause) == ("output", name.replace("_", " "), *expected)


def test_an_origin_elsewhere_is_named_with_its_height():
    (cause,) = diagnose(*changed("potential_energy", lambda i, x, b: x + 0.75)).causes
    assert cause.change.startswith("with another origin") and cause.amount == (0.75,)


def test_of_two_wrong_outputs_both_are_named_and_of_one_with_noise_the_other():
    rng = np.random.default_rng(2)
    model, reported, truth = changed("kinetic_energy", lambda i, x, b: 2 * x)
    both = [replace(a, potential_energy=-a.potential_energy) for a in reported]
    causes = diagnose(model, both, truth).causes
    assert [identity(c)[1::2] for c in causes] == [
        ("kinetic energy", "multiplied by"), ("potential energy", "with the opposite sign")
    ]  # fmt: skip
    noise = [replace(a, acceleration=a.acceleration * (1 + 1e-6 * rng.normal(size=(2, 3)))) for a in reported]
    named, unexplained = diagnose(model, noise, truth).causes
    assert named.term == "kinetic energy" and identity(unexplained) == ("unexplained", "acceleration", "", "")


# -- numbers, alone and in pairs ---------------------------------------------------------------------


def test_fitted_numbers_have_the_digits_that_the_fit_determines():
    model, truth = known()
    for value in (0.0248, model.mass[1] + 1e-7):
        lighter = replace(model, mass=np.array([model.mass[0], value]))
        (cause,) = diagnose(model, answers_of(lighter, truth), truth).causes
        assert identity(cause) == ("number", "mass", "body 2", "") and cause.nominal == (model.mass[1],)
        assert abs(cause.amount[0] - value) <= max(cause.uncertainty, 1e-3 * abs(value - model.mass[1]))
        assert cause.uncertainty < 1e-9
    (cause,) = diagnose(model, answers_of(replace(model, mass=model.mass * [1, 0.5]), truth), truth).causes
    assert cause.change == "halved"


def test_a_component_that_is_zero_within_its_uncertainty_is_zero():
    assert significant(-4.7e-14, 1.0, 1e-13) == 0.0
    assert significant(0.024800001, 0.1, 1e-8) == 0.0248
    assert significant(1.00000326e-06, 0.0, 1e-11) == 1e-06
    assert significant(1.00000001, 1.0, 1e-15) == 1.00000001
    model, truth = known()
    turned = replace(model, gravity=np.array([0.0, 0.0, -9.0]))
    (cause,) = diagnose(model, answers_of(turned, truth), truth).causes
    assert cause.amount in ((0.0, 0.0, -9.0), (-9.0,)), cause


PAIRS = [
    (CHAIN, ("mass", "body 1"), ("inertia xx", "body 2")),
    (CHAIN, ("near point y", "joint 2"), ("mass", "body 1")),
    (CHAIN, ("damping", "joint 1"), ("inertia xy", "body 2")),  # or the drag moment of body 1
    (TREE, ("mass", "body 2"), ("damping", "joint 1")),
    (TREE, ("near point x", "joint 2"), ("inertia yy", "body 1")),
    (LOOP, ("mass", "body 1"), ("damping", "joint 2")),
    (LOOP, ("applied moment x", "body 4"), ("centre of mass y", "body 2")),
]


@pytest.mark.parametrize("pair", PAIRS)
def test_two_wrong_numbers_are_separated(pair):
    name, *places = pair
    model, truth = known(name, 5)
    case = Predictor(model, truth.states, View()).case
    wrong = case
    for edit in number_edits(case):
        if (edit.cause.term, edit.cause.place) in places:
            x = edit.nominal * 1.01 if np.all(edit.nominal) else np.array([0.01 * edit.scale])
            wrong = edit.change(wrong, x)
    causes = diagnose(model, answers_of(wrong.model, truth), truth).causes
    named = {(c.term, c.place) for one in causes for c in (one, *one.equal)}
    assert len(causes) == 2 and set(places) <= named, describe(causes)


def test_a_factor_is_named_beside_the_number_that_has_the_same_effect():
    """A hinge shows one moment of inertia alone: the whole inertia may be larger."""
    model, truth = known(TREE, 5)
    larger = model.inertia * np.array([1.03, 1.0])[:, None, None]
    (cause,) = diagnose(model, answers_of(replace(model, inertia=larger), truth), truth).causes
    assert (cause.term, cause.place) == ("inertia yy", "body 1")
    assert ("inertia", "body 1", (1.03,)) in [(one.term, one.place, one.amount) for one in cause.equal]


def test_an_output_and_a_term_that_is_left_out_are_found_without_a_search(monkeypatch):
    model, truth = known(LOOP, 5)
    monkeypatch.setattr("plumbline.diagnosis.fit.number_edits", lambda _: pytest.fail("a search"))
    _, change, parts = PARTS[4]
    (cause,) = diagnose(model, with_parts(parts, model, truth), truth).causes
    assert cause.change == change


@pytest.mark.parametrize("name", [CHAIN, TREE, LOOP])
def test_a_wrong_number_and_a_wrong_output_are_separated(name):
    model, truth = known(name, 5)
    heavier = answers_of(replace(model, mass=model.mass * [1.01, *[1.0] * (model.n - 1)]), truth)
    reported = [replace(a, potential_energy=-a.potential_energy) for a in heavier]
    causes = diagnose(model, reported, truth).causes
    assert [(c.term, c.place, c.change) for c in causes] == [
        ("mass", "body 1", ""), ("potential energy", "", "with the opposite sign")
    ]  # fmt: skip


@pytest.mark.filterwarnings("error:invalid value:RuntimeWarning")
def test_a_wrong_output_is_separated_where_an_energy_is_zero_without_rounding():
    """Without gravity and springs the bound of the potential energy is 0."""
    model, truth = known("free-body-with-rotors")
    assert truth.bounds[0].tolerance("potential_energy") == 0
    heavier = replace(model, mass=model.mass * [1.01, 1, 1, 1])
    wrong = [replace(a, kinetic_energy=2 * a.kinetic_energy) for a in answers_of(heavier, truth)]
    mass, energy = diagnose(model, wrong, truth).causes
    assert identity(mass) == ("number", "mass", "body 1", "")
    assert identity(energy) == ("output", "kinetic energy", "", "multiplied by")


def test_a_defect_in_the_dynamics_alone_is_named():
    """Energies and momentum are found from the right numbers."""
    model, truth = known()
    wrong = answers_of(replace(model, mass=model.mass * [1, 1.001]), truth)
    names = QUANTITIES[:3]
    reported = [
        replace(a, **{q: getattr(b, q) for q in names}) for a, b in zip(truth.quantities, wrong, strict=True)
    ]
    (cause,) = diagnose(model, reported, truth).causes
    assert identity(cause)[:3] == ("number", "mass", "body 2")


# -- what is not named -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [CHAIN, TREE, LOOP])
def test_noise_is_not_named(name):
    rng = np.random.default_rng(1)
    model, reported, truth = changed(
        "acceleration", lambda i, x, b: x * (1 + 1e-6 * rng.normal(size=x.shape)), name, 5
    )
    found = diagnose(model, reported, truth)
    (cause,) = found.causes
    assert identity(cause) == ("unexplained", "acceleration", "", "")
    assert found.text == ("no number, term, frame or output, and no two of them, explains the acceleration")


def test_a_difference_within_the_bound_is_in_the_mass_matrix_and_one_near_it_is_close():
    (cause,) = diagnose(*changed("acceleration", lambda i, x, b: x + 0.4 * b[:, None])).causes
    assert cause.term == "mass matrix"
    (cause,) = diagnose(*changed("acceleration", lambda i, x, b: x + 4.0 * b[:, None])).causes
    assert (cause.kind, cause.change) == ("unexplained", "close")


def test_a_quantity_close_to_its_bound_is_not_named_beside_a_wrong_one():
    model, reported, truth = changed("acceleration", lambda i, x, b: 1.25 * x)
    reported = [
        replace(a, potential_energy=a.potential_energy + 5 * b.potential_energy)
        for a, b in zip(reported, truth.bounds, strict=True)
    ]
    (cause,) = diagnose(model, reported, truth).causes
    assert identity(cause)[1::2] == ("acceleration", "multiplied by")


def test_two_states_show_neither_a_constant_nor_a_stale_field(monkeypatch):
    """Of thirteen bodies two states are looked at, too few to see a pattern over states."""
    monkeypatch.setattr("plumbline.diagnosis.fit.number_edits", lambda _: [])  # which takes seconds
    model, reported, truth = changed("acceleration", lambda i, x, b: x + 0.5, "b" * 13, 9)
    assert diagnose(model, reported, truth).causes[0].kind == "unexplained"


def test_error_ratios_are_in_units_of_the_bounds():
    vectors = np.array([[[3.0, 4, 0], [0, 0, 1]], [[0, 0, 0], [6, 0, 8]]])
    assert error_ratio(vectors, np.array([[1.0, 1.0], [1.0, 4.0]])) == 5.0
    assert error_ratio(np.array([-3.0, 2.0]), np.array([1.0, 1.0])) == 3.0
    assert error_ratio(np.array([1.0]), np.array([0.0])) > 1e300
    assert np.isnan(error_ratio(np.array([np.nan]), np.array([1.0])))


# -- what an unexplained difference needs ------------------------------------------------------------


def engine_of(change):
    """An engine that returns the truth, changed."""

    def evaluate(model, states):
        right = state_truth(model, states).quantities
        return [change(model, s, a) for s, a in zip(states, right, strict=True)]

    return evaluate


def test_a_trial_that_the_engine_refuses_shows_nothing_and_the_next_one_runs():
    model, reported, truth = changed("acceleration", lambda i, x, b: np.cos(9 * x) + 5)

    def evaluate(requested, states):
        if not any(np.any(s.omega) for s in states):
            raise RuntimeError("no weight")
        if not np.any(requested.gravity):
            return state_truth(requested, states).quantities
        return engine_of(lambda m, s, a: replace(a, acceleration=np.cos(9 * a.acceleration) + 5))(
            requested, states
        )

    (cause,) = diagnose(model, reported, truth, evaluate).causes
    assert cause.needs == ("gravity",)
    assert describe([cause]).endswith("explains the acceleration; its difference vanishes without gravity")


def test_a_difference_that_does_not_show_again_needs_the_other_states():
    model, reported, truth = changed("acceleration", lambda i, x, b: np.cos(9 * x) + 5)
    (cause,) = diagnose(model, reported, truth, engine_of(lambda m, s, a: a)).causes
    assert cause.needs == ("other states in the same call",)


# -- sentences ---------------------------------------------------------------------------------------


SENTENCES = {
    "the mass of body 2 were 1.5 kg instead of 1 kg": Cause(
        "number", "mass", "body 2", "", (1.5,), (1.0,), " kg"
    ),
    "the inertia of all bodies were doubled": Cause(
        "number", "inertia", "all bodies", "doubled", (2.0,), (1.0,), "×"
    ),
    "the attitude of body 1 were turned the other way": Cause(
        "frame", "attitude", "body 1", "turned the other way"
    ),
    "the velocity term of joint 3 were missing": Cause(
        "term", "velocity term", "joint 3", "missing", (0.0,), (1.0,), "×"
    ),
    "it returned the kinetic energy multiplied by 2": Cause(
        "output", "kinetic energy", "", "multiplied by", (2.0,), (1.0,)
    ),
}


@pytest.mark.parametrize(("sentence", "cause"), SENTENCES.items())
def test_a_sentence_is_made_of_the_record(sentence, cause):
    assert describe([cause]) == f"behaves as if {sentence}"
    both = describe([replace(cause, equal=(cause,)), cause])
    assert both == (
        f"behaves as if {sentence}; the data cannot distinguish this from: {sentence}; and {sentence}"
    )
