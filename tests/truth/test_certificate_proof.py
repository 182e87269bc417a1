"""Certificates from candidates: what their enclosures must contain, and planted faults."""

import gzip
import json
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from plumbline.model.datatypes import EngineFailure
from plumbline.model.kinematics import stretched_length
from plumbline.truth import TruthUnavailable, certificate_proof, import_truth_tool
from plumbline.truth.certificate_file import Certificate, parse_certificate
from plumbline.truth.certificate_proof import (
    checked_numbers,
    checked_topology,
    load_checker,
    make_certificate,
    prove_motion,
    reason_not_provable,
    time_exponent,
)
from plumbline.truth.certified_state import certify_state
from plumbline.truth.taylor import simulate_taylor
from plumbline.truth.trajectory_truth import judge_claim, trajectory_truth
from tests.helpers import ROOT
from tests.helpers.catalogue import catalogue_scenario, catalogue_scenarios
from tests.helpers.nightly_tests import SLOW, nightly
from tests.helpers.random_chains import random_chain
from tests.helpers.stored_certificates import FOLDER as STORED
from tests.helpers.stored_certificates import stored_mechanism

TRUTH_TOOLS = all(find_spec(module) for module in ("heyoka", "mpmath", "flint"))
pytestmark = pytest.mark.skipif(not TRUTH_TOOLS, reason="the truth tools are not installed")
if TRUTH_TOOLS:
    from flint import arb, arb_poly, ctx

    checker = load_checker()

TIMES = np.arange(4) * 0.05
CHAINS = {"ball": [0], "rod": [1], "rod-ball": [1, 0]}
NAMES = ("r", "p", "v", "omega")
NARROW = {"r": 100, "p": 10, "v": 100, "omega": 10}  # radius over error; as measured 43, 6, 49, 4
# every joint but rod and ball, with elements, and a spring between points
TREES = ("sprung-cylinder", "sprung-universal", "spring-pendulum", "balls-with-elements")
PROVABLE = [s for s in catalogue_scenarios().values() if s.model.n <= 8 and not reason_not_provable(s.model)]
OVERLAPPING = ("free-body-with-rotors", "chain-3-balls", "chain-3-rods")  # besides one and two bodies
MEANT = [s for s in PROVABLE if not s.model.has_chain_joints or s.name == "double-ball-then-rod"]
PUBLISHED = json.loads((ROOT / "docs" / "reference-solutions.json").read_text("utf-8"))


def chain(rods, seed=1):
    return random_chain(seed, rods, loads=True, drag=True)


class Proofs(dict):
    """Model, state, document of the certificate and enclosure by chain, found when first needed."""

    def __missing__(self, name):
        if name in CHAINS:
            model, state = chain(CHAINS[name])
        elif name == "balls-with-elements":
            model, state = chain([0, 0])
            model = replace(model, armature=np.array([[0.3, 0], [0.1, 0]]), damping=np.array([[0.2, 0]] * 2))
            model = replace(model, stiffness=np.array([[3.0, 0], [0.9, 0]]))
        else:
            scenario = catalogue_scenario(name)
            model, state = scenario.model, scenario.state
        raw, enclosure = prove_motion(model, state, TIMES)
        self[name] = model, state, json.loads(gzip.decompress(raw)), enclosure
        return self[name]


@pytest.fixture(scope="module")
def proofs():
    return Proofs()


def enclose(document):
    return checker.enclose_motion(parse_certificate(json.dumps(document).encode()))


def overlap(one, other):
    with ctx.workprec(300):
        return all(
            a.overlaps(b)
            for name in NAMES
            for a, b in zip(getattr(one, name).ravel(), getattr(other, name).ravel(), strict=True)
        )


# which motion is meant: the part of the prover that is trusted


@pytest.mark.parametrize("scenario", MEANT, ids=lambda s: s.name)
def test_the_numbers_of_a_certificate_are_those_of_the_scenario(scenario):
    """The checker's mechanism starts where the scenario does, with any joints; free bodies have no point."""
    model, state = scenario.model, scenario.state
    free = np.array([kind == "free" for kind in model.kind])
    model = replace(model, point=model.point + free[:, None, None])  # has no meaning
    numbers = checked_numbers(model, state)
    certificate = Certificate(
        **checked_topology(model), data=numbers, times=[], time_exponent=0, bits=100, steps=[]
    )
    assert certificate.far == model.body[:, 0].tolist() and certificate.kind == list(model.kind)
    with ctx.workprec(200):
        mechanism = checker.Mechanism(certificate, arb)
        y = checker.initial_values(mechanism)
        motion = checker.Motion(mechanism, y, y[mechanism.nq :])
        vectors = motion.centres(0), motion.centres(1), motion.w
        pairs = zip(vectors, (state.r, state.v, state.omega), strict=True)
        for found, true in pairs:
            assert np.array(found[:-1]).astype(float) == pytest.approx(true, rel=0, abs=1e-12)
    for field in ("mass", "inertia", "force", "moment", "drag_force", "armature", "damping", "stiffness"):
        assert np.array_equal(numbers[field], getattr(model, field)), field


def test_loops_are_refused():
    bricard = catalogue_scenario("bricard")
    with pytest.raises(TruthUnavailable, match="motions of closed loops are not proved"):
        prove_motion(bricard.model, bricard.state, TIMES)
    for name in ("sprung-ball", "sprung-hinge"):
        assert not reason_not_provable(catalogue_scenario(name).model)
    assert "closed loops" in reason_not_provable(catalogue_scenario("bricard").model)


@pytest.mark.parametrize(
    "turn, time, failure, reason",
    [
        pytest.param(3.0, 0.1, EngineFailure, "heyoka stopped", marks=SLOW),
        (3.1405, 1e-5, "Rejected", r"\(8\): near half a turn"),
    ],
)
def test_a_spring_that_comes_to_half_a_turn_is_refused(turn, time, failure, reason):
    """Its moment jumps there, and φ/sin φ has a pole; 3.1405² is between 9.86 and π²."""
    model, state = chain([0])
    model, axis = replace(model, stiffness=np.array([[0.5, 0.0]])), np.array([0.6, 0.0, 0.8])
    p = np.array([[np.cos(turn / 2), *np.sin(turn / 2) * axis]])
    state = replace(state, p=p, omega=np.array([8.0 * axis]))
    with pytest.raises(checker.Rejected if failure == "Rejected" else failure, match=reason):
        prove_motion(model, state, np.array([0.0, time]))


@pytest.mark.parametrize("stiffness", [0.0, 2.0])
@pytest.mark.parametrize("rods", [[0], [1], [0, 1, 0], [1, 1]], ids=str)
def test_the_equations_hold_for_certified_accelerations(rods, stiffness):
    """Newton-Euler as residual here, solved by elimination in `certified_state`: two independent forms."""
    model, state = chain(rods, seed=4)
    of_balls = np.array([[not rod, 0] for rod in rods])
    model = replace(model, stiffness=stiffness * of_balls, armature=0.1 * stiffness * of_balls)
    certified = certify_state(model, state).quantities
    document = json.loads(gzip.decompress(make_certificate(model, state, np.array([0.0, 1e-3]))))
    certificate = parse_certificate(json.dumps(document).encode())
    mechanism = checker.Mechanism(certificate, arb)
    with ctx.workprec(100):
        y = [arb_poly([x]) for x in checker.initial_values(mechanism)]
        unit = float(2.0**certificate.time_exponent)
        vdot = rod_and_body_accelerations(model, state, certified) * unit**2
        qdot, residual = mechanism.equations(y, [arb_poly([arb(float(x))]) for x in vdot])
        scale = float(np.max(np.abs(certified.joint_reaction))) * unit**2
        assert max(abs(float(x(arb(0)).mid())) for x in residual) < 1e-13 * scale
        p, w = state.p[0] / np.linalg.norm(state.p[0]), state.omega[0] * unit
        rate = 0.5 * np.array([-p[1:] @ w, *(p[0] * w + np.cross(p[1:], w))])
        assert np.allclose([float(x(arb(0)).mid()) for x in qdot[:4]], rate, rtol=0, atol=1e-14)


def rod_and_body_accelerations(model, state, certified):
    """v̇ of the checker's coordinates, from accelerations of centres of mass."""
    from plumbline.model.kinematics import rotation_matrix

    found, tip = [], np.zeros(3)
    for k in range(model.n):
        A, w, wdot = rotation_matrix(state.p[k]), state.omega[k], certified.angular_acceleration[k]

        def moved(s, A=A, w=w, wdot=wdot):
            return A @ (np.cross(wdot, s) + np.cross(w, np.cross(w, s)))

        near = certified.acceleration[k] + moved(model.proximal[k])
        found += [*wdot, *((near - tip) / model.length[k] if model.rods[k] else [])]
        tip = certified.acceleration[k] + moved(model.distal[k])
    return np.array(found)


@pytest.mark.parametrize("name", ["rod-ball", *TREES])
def test_derivatives_of_the_equations_agree_with_differences(proofs, name):
    """Of the enclosed functions of s, at s = 0; the differences in 200 bits."""
    certificate = parse_certificate(json.dumps(proofs[name][2]).encode())
    with ctx.workprec(200):
        exactly, rounded = (checker.Mechanism(certificate, number) for number in (arb, float))
        x = np.random.default_rng(6).normal(size=exactly.nq + 2 * exactly.nv)
        n = exactly.nq + exactly.nv
        duals = checker.dual_variables([np.array([c]) for c in x], np.zeros(len(x)))
        found = [f for part in rounded.equations(duals[:n], duals[n:]) for f in part]

        def value(moved, step):
            y = [arb_poly([arb(float(c)) + (step if j == moved else 0)]) for j, c in enumerate(x)]
            return [f(arb(0)) for part in exactly.equations(y[:n], y[n:]) for f in part]

        step = arb(2) ** -100
        at = value(-1, step)
        for f, g in zip(found, at, strict=True):
            assert abs(arb(float(f.c[0, 0, 0])) - g) <= arb(float(f.r[0, 0]))
            assert f.r[0, 0] < 1e-11 * (1 + f.total[0, 0])
        for i in range(len(x)):
            for f, g, moved in zip(found, at, value(i, step), strict=True):
                slope = arb(float(f.c[0, 0, 1 + i]))
                assert abs((moved - g) / step - slope) < arb(float(f.r[0, 1 + i])) + arb(2) ** -60


@pytest.mark.parametrize("name", TREES)
def test_numbers_of_a_tree_off_by_one_ulp_give_wider_balls_that_are_true(proofs, name):
    """Every number of joints, elements and springs that is not zero must be part of the equations."""
    model, state, document, _ = proofs[name]
    fields = ["armature", "damping", "stiffness", "rest", "effort", "x", "xdot", "point", "spring_point"]
    fields += ["spring_length", "spring_stiffness", "spring_damping"]
    for field in fields + ["turn"] * (model.kind[-1] not in ("ball", "free")):
        record = state if field in vars(state) else model
        if not np.any(getattr(record, field)[-1:]):
            continue
        pair = with_one_ulp(model, state, field, slice(-1, None))  # of the joints, not a free body's
        numbers = {key: hexadecimal(x) for key, x in checked_numbers(*pair).items()}
        try:
            found = enclose(document | numbers)
        except checker.Rejected:
            continue
        assert found.radius("r") + found.radius("p") > 1e-18, f"{field} makes no difference"
        assert overlap(found, prove_motion(*pair, TIMES)[1]), field


def with_one_ulp(model, state, field, rows=slice(None)):
    """The mechanism whose largest number in some rows of a field is off by one ulp."""
    record = state if field in vars(state) else model
    array = getattr(record, field).copy()
    part = array[rows]
    largest = np.unravel_index(np.argmax(np.abs(part)), part.shape)  # of an inertia, on the diagonal
    part[largest] = np.nextafter(part[largest], np.inf)
    if field == "turn":
        part[0, 0, 1] += 2.0**-52  # the largest may be the only one, and is normalised
    changed = replace(record, **{field: array})
    return (model, changed) if record is state else (changed, state)


def hexadecimal(x):
    return np.frompyfunc(float.hex, 1, 1)(np.asarray(x, dtype=float)).tolist()


# what an enclosure contains


@pytest.mark.parametrize("name", CHAINS)
def test_an_enclosure_contains_the_motion_in_quad_precision(proofs, name):
    model, state, _, enclosure = proofs[name]
    run, _ = simulate_taylor(model, state, TIMES, "quad")
    assert enclosure.radius("r") < 1e-24 and enclosure.radius("omega") < 1e-22
    with ctx.workprec(200):
        for quantity in NAMES:
            found = getattr(enclosure, quantity).ravel()
            for ball, number in zip(found, np.asarray(getattr(run, quantity)).ravel(), strict=True):
                assert abs(ball.mid() - arb(str(number))) < ball.rad() + arb("1e-28")  # error of the run


@pytest.mark.parametrize(
    "name, radii",
    [("ball", (3.2e-30, 2.5e-29)), ("rod", (1.3e-28, 9.5e-28)), ("rod-ball", (1.3e-27, 1.1e-27))],
)
def test_enclosures_are_as_narrow_as_they_were(proofs, name, radii):
    """A bound that is wider than it need be is true, but a mistake; r [m] and omega [rad/s] as measured."""
    for quantity, radius in zip(("r", "omega"), radii, strict=True):
        assert 0 < proofs[name][3].radius(quantity) < 2 * radius


@pytest.mark.parametrize("name", [*CHAINS, *TREES])
def test_enclosures_of_two_precisions_overlap(proofs, name):
    model, state, _, enclosure = proofs[name]
    _, finer = prove_motion(model, state, TIMES, precision="octuple")
    assert finer.radius("r") < 1e-55
    assert overlap(enclosure, finer)


@pytest.mark.parametrize("name", [*CHAINS, *TREES])
def test_a_motion_from_perturbed_initial_values_stays_inside(proofs, name):
    """The candidate starts 1e-12 beside the state of the file: the balls must reach back to the motion."""
    model, state, document, enclosure = proofs[name]
    moves = 1e-12 * np.random.default_rng(7).normal(size=(model.n, 5))
    moved = replace(state, omega=state.omega + moves[:, :3], xdot=state.xdot + moves[:, 3:])
    _, other = prove_motion(model, moved, TIMES)
    candidate = json.loads(gzip.decompress(make_certificate(model, moved, TIMES)))
    found = enclose(document | {"steps": candidate["steps"]})
    assert 1e-13 < found.radius("omega") < 1e-10
    assert overlap(found, enclosure) and overlap(found, other)
    assert not overlap(enclosure, other)
    for quantity in NAMES if name in CHAINS else ():  # a bound wider than it need be is true, but a mistake
        pairs = zip(getattr(found, quantity).ravel(), getattr(enclosure, quantity).ravel(), strict=True)
        error = max(abs(float((x - y).mid())) for x, y in pairs)
        assert error < found.radius(quantity) < NARROW[quantity] * error


@pytest.mark.parametrize(
    ("name", "duration"),
    [
        *((name, 0.3) for name in ("double-tumbling-balls", "tumbling-rod", *TREES[:3], "loaded-tree")),
        *(pytest.param(s.name, s.duration, marks=pytest.mark.full) for s in PROVABLE),
    ],
)
def test_the_truth_of_runs_is_within_its_claimed_uncertainty(name, duration):
    scenario = catalogue_scenario(name)
    times = scenario.times[scenario.times <= duration + 1e-9]
    _, enclosure = prove_motion(scenario.model, scenario.state, times)
    assert enclosure.radius("r") <= 1e-18
    assert judge_claim(scenario.model, scenario.state, times, enclosure, None) <= 1
    truth = trajectory_truth(scenario.model, scenario.state, times)
    arms = float(np.sum(stretched_length(scenario.model)))
    for k, r in enumerate(enclosure.r):
        error = [[abs(ball - arb(float(x))) for ball, x in zip(*pair, strict=True)]
                 for pair in zip(r, truth.trajectory.r[k], strict=True)]  # fmt: skip
        largest = max(float(np.linalg.norm([float(x.upper()) for x in row])) for row in error)
        # of positions that arms, and slides, add up to
        rounding = 2.0**-53 * max(arms, float(np.max(np.linalg.norm(truth.trajectory.r[k], axis=-1))))
        assert largest <= truth.uncertainty["position"][k] + 2 * rounding + enclosure.radius("r")


@pytest.mark.full
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    "scenario", [s for s in PROVABLE if s.model.n <= 2 or s.name in OVERLAPPING], ids=lambda s: s.name
)
def test_enclosures_of_small_scenarios_in_two_precisions_overlap_at_every_sample(scenario):
    found = (
        prove_motion(scenario.model, scenario.state, scenario.times, precision=x)[1]
        for x in ("quad", "octuple")
    )
    assert overlap(*found)


@pytest.mark.parametrize("name", PUBLISHED["motions"])
def test_published_solutions_are_proved_again_up_to_their_first_time(name):
    """docs/reference-solutions.json, in quad precision instead of octuple."""
    record, scenario = PUBLISHED["motions"][name], catalogue_scenario(name)
    numbers = checked_numbers(scenario.model, scenario.state)
    assert record["doubles"] == {
        key: np.frompyfunc(float.hex, 1, 1)(x).tolist() for key, x in numbers.items()
    }
    assert record == record | checked_topology(scenario.model)
    assert record["times"] == [1, 2, 5, 10] and max(record["radius"]) < 1e-15
    _, found = prove_motion(scenario.model, scenario.state, np.array(record["times"][:1]))
    with ctx.workprec(200):
        for quantity in NAMES:
            texts, balls = np.array(record[quantity][0], dtype=object), getattr(found, quantity)[0]
            for text, ball in zip(texts.ravel(), balls.ravel(), strict=True):
                published = arb(text)
                assert published.overlaps(ball) and published.rad() < 1e-19 * (1 + abs(float(ball)))
                assert not (published + arb("1e-17")).overlaps(ball)


# planted faults


def true_enclosure(document, proof):
    """Whether a document is rejected, or proves balls that contain those of the sound certificate."""
    try:
        found = enclose(document)
    except checker.Rejected as error:
        return str(error)
    assert found.radius("r") > 3 * proof[3].radius("r"), "the fault made no difference"
    assert overlap(found, proof[3])
    return "wider"


@pytest.mark.parametrize("name", [*CHAINS, *TREES])
@pytest.mark.parametrize("bits, expected", [(20, "wider"), (109, "reject")])
@pytest.mark.parametrize("power", [0, *nightly((1, 5))])
def test_a_wrong_coefficient_is_rejected_or_covered(proofs, name, bits, expected, power):
    """Also one that opens a gap between steps."""
    document = json.loads(json.dumps(proofs[name][2]))
    document["steps"][1][1 + power % 3][power] += 1 << (bits if expected == "reject" else 40)
    found = true_enclosure(document, proofs[name])
    assert (found == "wider") == (expected == "wider"), found


@pytest.mark.parametrize("field", ["mass", "inertia", "point", "gravity", "drag_force", "p", "omega"])
def test_a_number_that_is_off_by_one_ulp_gives_wider_balls_that_are_true(proofs, field):
    """The balls must contain the motion of the file's own numbers: proved from a candidate of them."""
    model, state, document, _ = proofs["rod-ball"]
    raw, right = prove_motion(*with_one_ulp(model, state, field), TIMES)
    own = json.loads(gzip.decompress(raw))
    found = enclose(own | {"steps": document["steps"]})
    assert found.radius("r") > 1e3 * right.radius("r")
    assert overlap(found, right)


def test_a_missing_step_is_rejected(proofs):
    document = proofs["rod"][2]
    steps = document["steps"]
    assert "reject" not in true_enclosure(document | {"steps": [steps[0], *steps[2:]]}, proofs["rod"])
    with pytest.raises(checker.Rejected, match=r"the steps end at .* before the last sample"):
        enclose(document | {"steps": steps[:-1]})


def test_a_certificate_names_its_scenario(proofs):
    model, state, document, _ = proofs["ball"]
    assert document["scenario"] == ""
    raw = make_certificate(model, state, TIMES, "hash-of-a-scenario")
    assert json.loads(gzip.decompress(raw)) == document | {"scenario": "hash-of-a-scenario"}
    assert raw[4:8] == bytes(4), "no time of writing: the same input gives the same bytes"
    assert b", " not in gzip.decompress(raw)


def test_a_mechanism_of_more_springs_than_coordinates_is_enclosed():
    """A slide, which has one coordinate, between two springs."""
    scenario = catalogue_scenario("sprung-slide")
    points = np.array([[[0.0, 0.1, 1.0], [0.0, 0.0, 0.1]], [[0.1, 0.0, -1.0], [0.0, 0.0, -0.1]]])
    model = replace(
        scenario.model,
        spring_body=np.array([[-1, 0]] * 2),
        spring_point=points,
        spring_stiffness=np.array([3.0, 2.0]),
        spring_damping=np.array([0.0, 0.1]),
        spring_length=np.array([0.5, 1.5]),
    )
    _, enclosure = prove_motion(model, scenario.state, TIMES)
    assert enclosure.radius("r") < 1e-24


def test_a_rejected_candidate_is_tried_again_with_shorter_steps_and_in_octuple_precision(monkeypatch):
    """And the last rejection is what is said."""
    tried, raw = [], (STORED / "one-ball.json.gz").read_bytes()

    def reject(certificate, on_step):
        assert on_step is progress and certificate.steps
        raise checker.Rejected(f"never proved, try {len(tried)}")

    def progress(*_):
        raise AssertionError("no step was proved")

    monkeypatch.setattr(certificate_proof, "make_certificate", lambda *a: tried.append(a[3:]) or raw)
    monkeypatch.setattr(checker, "enclose_motion", reject)
    with pytest.raises(checker.Rejected, match="never proved, try 5"):
        prove_motion(*chain([0]), TIMES, "some-hash", on_step=progress)
    assert [precision for _, precision, _ in tried] == [*["quad"] * 2, *["octuple"] * 3]
    assert tried == [("some-hash", *x[1:]) for x in tried]
    assert [max_step for *_, max_step in tried] == [0.5, 0.25, 0.5, 0.25, 0.125]


@pytest.mark.parametrize("times", [[0.0], [0.0, 1e-3]], ids=str)
def test_an_octuple_candidate_has_its_digits_and_lengths_have_40(times):
    """230 bits and 116 coefficients; a certificate of the start alone has one step of the least length."""
    raw = make_certificate(*chain([0]), np.array(times), precision="octuple")
    certificate, document = parse_certificate(raw), json.loads(gzip.decompress(raw))
    (step,) = certificate.steps
    assert certificate.bits == 230 and document["scenario"] == ""
    assert {len(row) for row in step[1:]} == {116}
    assert step[0] == max(1, int(np.ceil(np.ldexp(times[-1], 40 - certificate.time_exponent)))) << 190
    assert checker.enclose_motion(certificate).radius("r") < 1e-60


@pytest.mark.parametrize("name", ["rod-hinge-ball", "free-with-slide-and-weld"])
def test_a_candidate_starts_in_the_state_that_the_checker_proves(name):
    """With the coordinates in its order, hinges behind rods and free bodies too."""
    model, state = stored_mechanism(name)
    certificate = parse_certificate(make_certificate(model, state, np.array([0.0, 1e-4])))
    with ctx.workprec(200):
        start = checker.initial_values(checker.Mechanism(certificate, arb))
        for row, x in zip(certificate.steps[0][1:], start, strict=True):
            assert abs(arb(row[0]) / 2**certificate.bits - x) < 1e-32


@pytest.mark.parametrize("last", [(1e-20, 3e-22), (3e-22, 1e-20), (1e-20, 0.0), (0.0, -1e-20)], ids=str)
def test_the_last_two_terms_of_a_step_are_an_eighth_of_the_last_bit(last):
    mp = import_truth_tool("mpmath")
    h = certificate_proof.longest_step([1, 2, 3, 4, 5, *last], 110)
    terms = [abs(c) * h**power for power, c in zip((5, 6), last, strict=True)]
    assert abs(max(terms) * mp.mpf(2) ** 113 - 1) < 1e-12
    assert certificate_proof.longest_step([1, 2, 3, 0, 0], 110) == mp.inf


def test_the_unit_of_time_makes_rates_about_one():
    """The fastest of the rates and of a swing on the shortest lever, as a power of two; not below 2^-10."""
    model, state = chain([1, 0])
    still = replace(state, omega=0 * state.omega, udot=0 * state.udot, xdot=0 * state.xdot)
    point = np.array([[[0.0] * 3, [0.3, 0.0, 0.4]], [[0.0] * 3, [0.0, 3.0, 0.0]]])
    levers = replace(model, point=point, length=np.array([0.25, 0.0]))
    for gravity in 10.0 ** np.arange(-3, 6):
        heavy = replace(levers, gravity=np.array([0.0, 0.6, -0.8]) * gravity)
        assert time_exponent(heavy, still) == -round(np.log2(np.sqrt(gravity / 0.75)))
    for name in ("omega", "udot", "xdot"):
        for rate in (-300.0, 2000.0):
            fast = replace(
                still, **{name: getattr(still, name) + rate * np.eye(2, getattr(still, name).shape[1])}
            )
            assert time_exponent(model, fast) == -round(np.log2(abs(rate)))
    weightless = replace(model, gravity=np.zeros(3))
    assert time_exponent(weightless, still) == 10
    centred = replace(weightless, point=0 * model.point, length=0 * model.length)
    assert time_exponent(centred, still) == 10


def test_a_motion_is_proved_with_shorter_steps_before_more_digits_are_taken():
    """Half a unit of time is too long for the linear part of a conical motion."""
    scenario = catalogue_scenario("conical")
    raw, enclosure = prove_motion(scenario.model, scenario.state, np.array([0.0, 0.5]))
    certificate = parse_certificate(raw)
    assert certificate.bits == 110 and enclosure.radius("r") < 1e-24
    assert {step[0] for step in certificate.steps[:-1]} == {1 << 108}


def test_a_motion_is_enclosed_while_its_steps_shrink():
    """A cart of a millionth of the mass of the bob on its pole, whose lowest point is at 0.4515 s."""
    scenario = catalogue_scenario("light-cart-pole")
    _, enclosure = prove_motion(scenario.model, scenario.state, np.array([0.0, 0.451]))
    assert enclosure.radius("r") < 1e-24


@pytest.mark.full
def test_a_motion_is_enclosed_through_two_nearly_singular_poses():
    """It turns there within microseconds; steps shrink by a million and grow again."""
    scenario = catalogue_scenario("light-cart-pole")
    raw, enclosure = prove_motion(scenario.model, scenario.state, np.arange(33) / 16)
    lengths = [step[0] for step in parse_certificate(raw).steps]
    assert enclosure.radius("r") < 1e-40 and max(lengths) > 1e5 * min(lengths)
