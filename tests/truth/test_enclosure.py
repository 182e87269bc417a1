"""Enclosures of motions: the parts of the proof, planted faults, and what the enclosures must contain."""

import ast
import gzip
import json
import random
from collections import Counter
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from plumbline.scenario.loader import catalogue, find_scenario_file, load_scenario
from plumbline.truth.certified import certify_state
from plumbline.truth.enclosure import load_checker, make_certificate, prove_motion
from plumbline.truth.taylor import simulate_taylor
from plumbline.truth.trajectory import trajectory_truth
from tests.helpers.mutations import damaged_bytes, damaged_document, limited_time
from tests.helpers.random_chains import random_chain

TRUTH_TOOLS = all(find_spec(module) for module in ("heyoka", "mpmath", "flint"))
pytestmark = pytest.mark.skipif(not TRUTH_TOOLS, reason="the truth tools are not installed")
if TRUTH_TOOLS:
    from flint import arb, arb_poly, ctx

    checker = load_checker()

TIMES = np.arange(4) * 0.05
CHAINS = {"ball": [0], "rod": [1], "rod-ball": [1, 0]}
NAMES = ("r", "p", "v", "omega")
CATALOGUE = [load_scenario(path) for path in catalogue().values()]


def chain(rods, seed=1):
    return random_chain(np.random.default_rng(seed), rods, loads=True, drag=True)


@pytest.fixture(scope="module")
def proofs():
    """Model, state, document of the certificate and enclosure by chain."""
    found = {}
    for name, rods in CHAINS.items():
        model, state = chain(rods)
        raw, enclosure = prove_motion(model, state, TIMES)
        found[name] = model, state, json.loads(gzip.decompress(raw)), enclosure
    return found


def enclose(document):
    return checker.enclose_motion(checker.parse_certificate(json.dumps(document).encode()))


def overlap(one, other):
    with ctx.workprec(300):
        return all(
            a.overlaps(b)
            for name in NAMES
            for a, b in zip(getattr(one, name).ravel(), getattr(other, name).ravel(), strict=True)
        )


# the parts of the proof


def test_the_checker_imports_numpy_flint_and_the_standard_library_only():
    tree = ast.parse(Path(checker.__file__).read_text(encoding="utf-8"))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    standard = {"__future__", "gzip", "json", "math", "sys", "zlib"}
    standard |= {"collections.abc", "dataclasses", "fractions", "pathlib", "typing"}
    assert imported == standard | {"numpy", "numpy.typing", "flint"}


def random_poly(rng, length, radius):
    return arb_poly([arb(float(c), radius) for c in rng.normal(size=length)])


@pytest.mark.parametrize("degree", [0, 3, 7, 8])
def test_a_folded_polynomial_encloses_the_polynomial(degree):
    rng = np.random.default_rng(2)
    for _ in range(20):
        poly = random_poly(rng, 8, 0)
        folded = checker._fold(poly, degree)
        assert folded.degree() <= degree
        for s in (0.0, 0.3, 0.8, 1.0):
            assert folded(arb(s)).overlaps(poly(arb(s)))
            assert folded(arb(s)).contains(poly(arb(s)).mid())


def test_a_product_of_matrices_encloses_the_product():
    rng = np.random.default_rng(3)
    a, b = ([checker._matrix(x) for x in rng.normal(size=(checker.DEGREE + 1, 3, 3))] for _ in range(2))
    found = checker._product(a, b)
    for s in (arb(0), arb(0.4), arb(1)):

        def at(coefficients, s=s):
            return sum((x * s**k for k, x in enumerate(coefficients[1:], 1)), coefficients[0])

        exact = at(a) * at(b)
        assert all(x.contains(y.mid()) for x, y in zip(at(found).entries(), exact.entries(), strict=True))
        bound = checker._magnitude(found).entries()
        assert all(abs(x.mid()) <= y for x, y in zip(exact.entries(), bound, strict=True))


@pytest.mark.parametrize("rods", [[0], [1], [0, 1, 0], [1, 1]], ids=str)
def test_the_equations_hold_for_certified_accelerations(rods):
    """Newton-Euler as residual here, solved by elimination in `certified`: two independent forms."""
    model, state = chain(rods, seed=4)
    certified = certify_state(model, state).quantities
    document = json.loads(gzip.decompress(make_certificate(model, state, np.array([0.0, 1e-3]))))
    certificate = checker.parse_certificate(json.dumps(document).encode())
    mechanism = checker._Mechanism(certificate)
    with ctx.workprec(100):
        y = [checker._Dual(arb_poly([x]), 0) for x in checker._initial_values(mechanism, 100)]
        unit = float(2.0**certificate.time_exponent)
        vdot = rod_and_body_accelerations(model, state, certified) * unit**2
        qdot, residual = mechanism.equations(y, [checker._Dual(arb_poly([arb(float(x))]), 0) for x in vdot])
        scale = float(np.max(np.abs(certified.joint_reaction))) * unit**2
        assert max(abs(float(x.value(arb(0)).mid())) for x in residual) < 1e-13 * scale
        p, w = state.p[0] / np.linalg.norm(state.p[0]), state.omega[0] * unit
        rate = 0.5 * np.array([-p[1:] @ w, *(p[0] * w + np.cross(p[1:], w))])
        assert np.allclose([float(x.value(arb(0)).mid()) for x in qdot[:4]], rate, rtol=0, atol=1e-14)


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


def test_derivatives_of_the_equations_agree_with_differences():
    model, state = chain([1, 0], seed=5)
    certificate = checker.parse_certificate(make_certificate(model, state, np.array([0.0, 1e-3])))
    mechanism = checker._Mechanism(certificate)
    rng = np.random.default_rng(6)
    with ctx.workprec(200):
        x = [arb(float(c)) for c in rng.normal(size=mechanism.nq + 2 * mechanism.nv)]
        n = mechanism.nq + mechanism.nv

        def value(x, slopes):
            duals = [
                checker._Dual(arb_poly([c]), 0, {i: arb_poly([1])} if slopes else None)
                for i, c in enumerate(x)
            ]
            return [f for part in mechanism.equations(duals[:n], duals[n:]) for f in part]

        exact, step = value(x, True), arb(2) ** -60
        for i in range(len(x)):
            moved = value([c + step if j == i else c for j, c in enumerate(x)], False)
            for f, g in zip(exact, moved, strict=True):
                slope = f.slopes[i](arb(0)) if i in f.slopes else arb(0)
                difference = (g.value(arb(0)) - f.value(arb(0))) / step
                assert abs(float((difference - slope).mid())) < 1e-12 * (1 + abs(float(slope.mid())))


# what an enclosure contains


@pytest.mark.parametrize("name", CHAINS)
def test_an_enclosure_contains_the_motion_in_quad_precision(proofs, name):
    model, state, _, enclosure = proofs[name]
    run = simulate_taylor(model, state, TIMES, "quad")
    assert enclosure.radius("r") < 1e-24 and enclosure.radius("omega") < 1e-22
    with ctx.workprec(200):
        for quantity in NAMES:
            found = getattr(enclosure, quantity).ravel()
            for ball, number in zip(found, np.asarray(getattr(run, quantity)).ravel(), strict=True):
                assert abs(ball.mid() - arb(str(number))) < ball.rad() + arb("1e-28")  # error of the run


@pytest.mark.parametrize("name", CHAINS)
def test_enclosures_of_two_precisions_overlap(proofs, name):
    model, state, _, enclosure = proofs[name]
    _, finer = prove_motion(model, state, TIMES, precision="octuple")
    assert finer.radius("r") < 1e-55
    assert overlap(enclosure, finer)


@pytest.mark.parametrize("name", CHAINS)
def test_a_motion_from_perturbed_initial_values_stays_inside(proofs, name):
    """The candidate starts 1e-12 beside the state of the file: the balls must reach back to the motion."""
    model, state, document, enclosure = proofs[name]
    moved = replace(state, omega=state.omega + 1e-12 * np.random.default_rng(7).normal(size=(model.n, 3)))
    _, other = prove_motion(model, moved, TIMES)
    candidate = json.loads(gzip.decompress(make_certificate(model, moved, TIMES)))
    found = enclose(document | {"steps": candidate["steps"]})
    assert 1e-13 < found.radius("omega") < 1e-10
    assert overlap(found, enclosure) and overlap(found, other)
    assert not overlap(enclosure, other)


@pytest.mark.parametrize("name", ["double-tumbling-balls", "tumbling-rod"])
def test_the_truth_of_runs_is_within_its_claimed_uncertainty(name):
    check_present_truth(load_scenario(find_scenario_file(name)), 0.3)


@pytest.mark.full
@pytest.mark.parametrize("scenario", [s for s in CATALOGUE if s.model.n <= 5], ids=lambda s: s.name)
def test_the_truth_of_every_small_scenario_is_within_its_claimed_uncertainty(scenario):
    check_present_truth(scenario, scenario.duration)


def check_present_truth(scenario, duration):
    times = scenario.times[scenario.times <= duration + 1e-9]
    _, enclosure = prove_motion(scenario.model, scenario.state, times)
    truth = trajectory_truth(scenario.model, scenario.state, times)
    assert enclosure.radius("r") <= 1e-18
    for k, r in enumerate(enclosure.r):
        error = [[abs(ball - arb(float(x))) for ball, x in zip(*pair, strict=True)]
                 for pair in zip(r, truth.trajectory.r[k], strict=True)]  # fmt: skip
        rounding = 2.0**-53 * float(np.max(np.abs(truth.trajectory.r[k])))
        largest = max(float(np.linalg.norm([float(x.upper()) for x in row])) for row in error)
        assert largest <= truth.position_uncertainty[k] + 2 * rounding


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


@pytest.mark.parametrize("name", CHAINS)
@pytest.mark.parametrize("bits, expected", [(20, "wider"), (109, "reject")])
@pytest.mark.parametrize("power", [0, 1, 5])
def test_a_wrong_coefficient_is_rejected_or_covered(proofs, name, bits, expected, power):
    """Also one that opens a gap between steps."""
    document = json.loads(json.dumps(proofs[name][2]))
    document["steps"][1][1 + power % 3][power] += 1 << (bits if expected == "reject" else 40)
    found = true_enclosure(document, proofs[name])
    assert (found == "wider") == (expected == "wider"), found


@pytest.mark.parametrize("field", ["mass", "inertia", "proximal", "gravity", "drag_force", "p", "omega"])
def test_a_number_that_is_off_by_one_ulp_gives_wider_balls_that_are_true(proofs, field):
    """The balls must contain the motion of the file's own numbers: proved from a candidate of them."""
    model, state, document, _ = proofs["rod-ball"]
    record = state if field in ("p", "omega") else model
    array = getattr(record, field).copy()
    largest = np.unravel_index(np.argmax(np.abs(array)), array.shape)  # of an inertia, on the diagonal
    array[largest] = np.nextafter(array[largest], np.inf)
    changed = replace(state, **{field: array}) if record is state else model.changed(**{field: array})
    pair = (model, changed) if record is state else (changed, state)
    raw, right = prove_motion(*pair, TIMES)
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


def test_the_bound_of_the_defect_holds_where_series_are_cut_and_contains_the_remainder(proofs, monkeypatch):
    """Series cut six powers below the candidate's order; without the remainder the bound is smaller."""
    _, _, document, _ = proofs["ball"]
    certificate = checker.parse_certificate(json.dumps(document).encode())
    mechanism, (length, *rows) = checker._Mechanism(certificate), certificate.steps[0]
    y = checker._polynomials(rows, certificate.bits)
    usual = checker._fold
    with ctx.workprec(certificate.bits + checker.GUARD_BITS):
        h = arb(length) * arb(2) ** -certificate.bits
        vdot = [poly.derivative() * (1 / h) for poly in y[mechanism.nq :]]
        at_end = [[checker._Dual(arb_poly([poly(arb(1))]), 0) for poly in x] for x in (y, vdot)]
        monkeypatch.setattr(checker, "_fold", lambda poly, degree: usual(poly, max(degree - 6, 0)))
        _, bounds = checker._bound_defect(mechanism, y, vdot, h)
        monkeypatch.setattr(checker, "_fold", lambda poly, degree: poly.truncate(max(degree - 6, 0) + 1))
        _, wrong = checker._bound_defect(mechanism, y, vdot, h)
        monkeypatch.setattr(checker, "_fold", usual)
        for k, g in enumerate(mechanism.equations(*at_end)[1]):
            assert abs(g.value(arb(0))) < bounds[k]
            assert wrong[k] < bounds[k]


def test_a_wrong_bound_of_the_remainder_is_noticed(monkeypatch):
    monkeypatch.setattr(checker, "UNIT", arb(0.25, 0.25))  # [0, ½]
    with pytest.raises(AssertionError):
        test_a_folded_polynomial_encloses_the_polynomial(3)


@pytest.mark.parametrize("name", ["_magnitude", "_norm"])
def test_nan_is_never_accepted(proofs, monkeypatch, name):
    usual = getattr(checker, name)
    monkeypatch.setattr(checker, name, lambda a: usual(a) * arb("nan"))
    with pytest.raises(checker.Rejected):
        enclose(proofs["ball"][2])


def test_a_truncated_file_is_malformed(proofs):
    model, state, _, _ = proofs["ball"]
    raw = make_certificate(model, state, TIMES)
    for length in (0, 1, 10, len(raw) // 2, len(raw) - 4):
        with pytest.raises(checker.MalformedCertificate, match="not a complete gzip or JSON file"):
            checker.parse_certificate(raw[:length])


@pytest.mark.parametrize(
    "change, message",
    [
        ({"format": "x"}, "format: expected the text"),
        ({"version": 2}, "version: expected 1"),
        ({"mass": ["nan"]}, "mass: expected finite doubles"),
        ({"mass": [0.5]}, "mass: expected finite doubles"),
        ({"mass": ["-0x1p0"]}, "mass: expected positive"),
        ({"mass": ["0x1p0", "0x1p0"]}, r"mass: expected finite doubles as '0x1.8p\+0', shape \(1,\)"),
        ({"inertia": None}, "inertia: expected finite doubles"),
        ({"inertia": [[["0x1p0"] * 3, ["0x0p0"] * 3, ["0x0p0"] * 3]]}, "inertia: expected symmetric"),
        ({"length": []}, "length: expected 1 to 100 bodies"),
        ({"length": ["-0x1p0"]}, "length: expected numbers that are not negative"),
        ({"bits": 110.0}, "bits: expected an integer from 16 to"),
        ({"bits": True}, "bits: expected an integer"),
        ({"time_exponent": 100}, "time_exponent: expected an integer from -60 to 60"),
        ({"times": ["0x0p0", "0x0p0"]}, "times: expected ascending"),
        ({"steps": []}, "steps: expected 1 to"),
        ({"steps": [[1]]}, r"steps\[0\]: expected a positive length, then 7 lists"),
        ({"steps": [[0, *[[1]] * 7]]}, r"steps\[0\]: expected a positive length"),
        ({"steps": [[1, *[[1.0]] * 7]]}, r"steps\[0\]: expected lists of at most"),
    ],
)  # fmt: skip
def test_a_malformed_field_is_named(proofs, change, message):
    with pytest.raises(checker.MalformedCertificate, match=message):
        enclose(proofs["ball"][2] | change)


def test_damaged_documents_are_malformed_or_rejected(proofs):
    """No other exception, whatever the document holds."""
    document, draw, outcomes = proofs["ball"][2], random.Random(8), Counter()
    for _ in range(40):
        damaged = json.dumps(damaged_document(document | {"steps": document["steps"][:1]}, draw)).encode()
        with limited_time():
            try:
                checker.enclose_motion(checker.parse_certificate(damaged))
            except (checker.MalformedCertificate, checker.Rejected) as error:
                outcomes[type(error)] += 1
    assert outcomes[checker.MalformedCertificate] and outcomes[checker.Rejected], outcomes


def test_damaged_files_are_malformed_or_read_whole(proofs):
    """The gzip checksum covers the content, not the header."""
    model, state, _, _ = proofs["ball"]
    raw, draw = make_certificate(model, state, TIMES), random.Random(9)
    outcomes = Counter()
    for _ in range(100):
        with limited_time():
            try:
                found = checker.parse_certificate(damaged_bytes(raw, draw))
            except checker.MalformedCertificate:
                outcomes["malformed"] += 1
            else:
                assert found.steps == checker.parse_certificate(raw).steps
    assert outcomes["malformed"] > 50


def test_a_motion_at_rest_is_enclosed():
    scenario = load_scenario(find_scenario_file("rest"))
    _, enclosure = prove_motion(scenario.model, scenario.state, np.array([0.0, 1.0]))
    assert enclosure.radius("r") < 1e-30  # a thousand times the last of the coefficients' 110 bits


def test_fast_spin_is_enclosed():
    scenario = load_scenario(find_scenario_file("lagrange-top"))
    _, enclosure = prove_motion(scenario.model, scenario.state, TIMES)
    assert enclosure.radius("r") < 1e-24
