"""Enclosures of motions: the parts of the proof, planted faults, and what the enclosures must contain."""

import ast
import gzip
import io
import json
import random
import tokenize
from collections import Counter
from dataclasses import replace
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from plumbline.scenario.loader import catalogue, find_scenario_file, load_scenario
from plumbline.truth import enclosure_file
from plumbline.truth.certified import certify_state
from plumbline.truth.enclosure import (
    checked_numbers,
    checked_topology,
    load_checker,
    make_certificate,
    prove_motion,
    reason_not_provable,
)
from plumbline.truth.enclosure_file import MalformedCertificate, parse_certificate
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
NARROW = {"r": 100, "p": 10, "v": 100, "omega": 10}  # radius over error; as measured 43, 6, 49, 4
# every joint but rod and ball, with elements, and a spring between points
TREES = ("sprung-cylinder", "sprung-universal", "spring-pendulum", "balls-with-rotors")
PROVABLE = [
    s
    for s in (load_scenario(path) for path in catalogue().values())
    if s.model.n <= 8 and not reason_not_provable(s.model)
]
PUBLISHED = json.loads((Path(__file__).parents[2] / "docs" / "reference-solutions.json").read_text("utf-8"))


def chain(rods, seed=1):
    return random_chain(np.random.default_rng(seed), rods, loads=True, drag=True)


class Proofs(dict):
    """Model, state, document of the certificate and enclosure by chain, found when first needed."""

    def __missing__(self, name):
        if name in CHAINS:
            model, state = chain(CHAINS[name])
        elif name == "balls-with-rotors":
            model, state = chain([0, 0])
            model = replace(model, armature=np.array([[0.3, 0], [0.1, 0]]), damping=np.array([[0.2, 0]] * 2))
        else:
            scenario = load_scenario(find_scenario_file(name))
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


# the parts of the proof


def imported_modules(path):
    tree = ast.parse(Path(path).read_text(encoding="utf-8"))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    return imported | {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}


def test_the_checker_imports_numpy_flint_and_the_standard_library_only():
    """And the file that reads certificates, which imports NumPy and the standard library only."""
    standard = {"__future__", "collections.abc", "dataclasses", "fractions", "itertools", "typing"}
    assert imported_modules(checker.__file__) == standard | {"numpy", "flint", enclosure_file.__name__}
    standard = {"__future__", "json", "zlib", "dataclasses", "typing"}
    assert imported_modules(enclosure_file.__file__) == standard | {"numpy"}


@pytest.mark.parametrize("name, most", [("enclosure_checker", 300), ("enclosure_file", 100)])
def test_the_checker_has_at_most_300_lines_of_code_and_its_reader_100(name, most):
    """Without docstrings, comments and blank lines."""
    source = Path(enclosure_file.__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = [x for x in ast.walk(ast.parse(source)) if isinstance(x, kinds) and ast.get_docstring(x)]
    documentation = {
        line for node in nodes for line in range(node.body[0].lineno, node.body[0].end_lineno + 1)
    }
    layout = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
    tokens = [x for x in tokenize.generate_tokens(io.StringIO(source).readline) if x.type not in layout]
    lines = {line for x in tokens if x.string for line in range(x.start[0], x.end[0] + 1)}
    assert most / 2 < len(lines - documentation) <= most


def draw_series(rng, rows, columns, radius=0.0, positive=False):
    c = rng.normal(size=(checker.DEGREE + 1, rows, columns))
    return checker._Series(np.abs(c) if positive else c, radius)


def exact(series, s, radius=Fraction(0)):
    """Exact values at s (rows, columns) as fractions, of c + radius r."""
    s = Fraction(s)
    to_fraction = np.frompyfunc(Fraction, 1, 1)
    return sum(to_fraction(c) * s**k for k, c in enumerate(series.c)) + radius * to_fraction(series.r)


def encloses(series, values, s):
    """Whether a series encloses exact values, and whether no radius 4 times smaller would."""
    distance = np.abs(exact(series, s) - values)
    return bool(np.all(distance <= np.frompyfunc(Fraction, 1, 1)(series.r)))


@pytest.mark.parametrize("shapes", [((3, 2), (2, 4)), ((1, 2), (2, 3))], ids=str)
@pytest.mark.parametrize("radius", [0.0, 0.25])
def test_a_product_encloses_the_product(shapes, radius):
    """Radii of both signs; with positive coefficients and s = 1 every term counts in full."""
    rng = np.random.default_rng(3)
    for positive in (False, True):
        a, b = (draw_series(rng, *shape, radius, positive) for shape in shapes)
        found = a @ b
        for s in (0, 0.4, 1):
            for sign in (-1, 0, 1):
                assert encloses(found, exact(a, s, sign) @ exact(b, s, sign), s)
        if positive:  # not wider than the sum of the terms above the degree and those with the radii
            most = exact(found, 1) + np.frompyfunc(Fraction, 1, 1)(found.r)
            assert np.all(most <= (exact(a, 1, 1) @ exact(b, 1, 1)) * Fraction(1 + 1e-8))


def without_terms_above(rng, rows, columns):
    """A series of degree 5: products of two have no terms above DEGREE, only roundings."""
    found = draw_series(rng, rows, columns)
    found.c[6:] = 0
    return checker._Series(found.c)


@pytest.mark.parametrize("rows", [1, 3])
def test_roundings_are_in_the_radii(rows):
    rng = np.random.default_rng(4)
    a, b, c = (without_terms_above(rng, *shape) for shape in ((rows, 3), (3, 5), (rows, 3)))
    unit = (
        2.0**-51
    )  # (F): a sum of K products is off by at most K unit times the sum of their absolute values
    for found, values, margin in (
        (a @ b, lambda s: exact(a, s) @ exact(b, s), unit * (checker.DEGREE + 1) * 3 * (a.total @ b.total)),
        (a + c, lambda s: exact(a, s) + exact(c, s), unit * np.abs(a.c + c.c).sum(0)),
        (a - c, lambda s: exact(a, s) - exact(c, s), unit * np.abs(a.c - c.c).sum(0)),
        (a * 0.3, lambda s: exact(a, s) * Fraction(3, 10), unit * 0.3 * a.total),
        (0.3 * a, lambda s: exact(a, s) * Fraction(3, 10), unit * 0.3 * a.total),
    ):
        assert all(encloses(found, values(Fraction(s)), Fraction(s)) for s in (0, 0.4, 1))
        assert np.allclose(found.r, margin, rtol=1e-8, atol=0)
        assert not encloses(checker._Series(found.c), values(Fraction(1)), Fraction(1)), "nothing was rounded"


def test_products_of_functions_have_their_derivatives():
    """Row: value, derivatives; (f g)' = f g' + g f'."""
    rng = np.random.default_rng(5)
    f, g = (draw_series(rng, 1, 4, radius) for radius in (0.0, 0.125))
    product, shifted = f * g, f + 0.7
    for s in (0, 0.4, 1):
        for sign in (-1, 0, 1):
            (x,), (y,) = exact(f, s, sign), exact(g, s, sign)
            values = np.array([[x[0] * y[0], *(x[0] * y[1:] + y[0] * x[1:])]])
            assert encloses(product, values, s)
        assert encloses(shifted, exact(f, s) + np.array([[Fraction(0.7), 0, 0, 0]]), s)
    assert product.r[0, 0] < 4 * (0.125 * f.total[0, 0] + np.abs(f.c).sum() * np.abs(g.c).sum())


def test_bounds_are_upper_bounds():
    rng = np.random.default_rng(6)
    for _ in range(20):
        x = np.abs(rng.normal(size=(5, 7)))
        squares = sum(Fraction(c) ** 2 for c in x.ravel())
        assert squares < Fraction(float(checker._norm(x))) ** 2 < squares * Fraction(1 + 1e-8)
        rows = checker._norm(x, axis=1)
        assert all(
            sum(Fraction(c) ** 2 for c in row) < Fraction(n) ** 2 for row, n in zip(x, rows, strict=True)
        )
        series = draw_series(rng, 2, 2, 0.5)
        assert np.all(np.abs(exact(series, 1, 1)) <= np.frompyfunc(Fraction, 1, 1)(series.size))
        assert np.allclose(series.size, np.abs(series.c).sum(0) + 0.5, rtol=1e-8)
    assert (
        0 < checker._norm(np.zeros(3)) < 1e-149 and checker._up(0.0) == 2.0**-1000
    )  # underflows are covered
    balls = [arb(-3, 0.5), arb(2), arb("0.1")]
    assert all(
        abs(ball) < arb(float(bound)) for ball, bound in zip(balls, checker._upper(balls), strict=True)
    )
    assert np.allclose(checker._upper(balls), [3.5, 2, 0.1], rtol=1e-8)


def test_guesses_are_inverses():
    rng = np.random.default_rng(7)
    series = draw_series(rng, 3, 3) * 0.01 + checker._Series(checker._constant(np.eye(3)).c)
    inverse = checker._Series(checker._inverse_guess(series.c))
    assert checker._inverse_error(inverse, series, "") < 0.1
    with pytest.raises(checker.Rejected, match="message"):
        checker._inverse_error(inverse, series * 3, "message")
    J = series.c
    P = checker._recurrence(J, np.eye(3), 1)
    for k in range(3):  # (k + 1) P_(k+1) = sum of J_i P_(k-i)
        assert np.allclose((k + 1) * P[k + 1], sum(J[i] @ P[k - i] for i in range(k + 1)))


def test_a_series_at_a_point_encloses_its_values():
    series = draw_series(np.random.default_rng(8), 2, 3)
    for s in (Fraction(0), Fraction(1, 3), Fraction(7, 9), Fraction(1)):
        found = checker._evaluate(series, float(s))
        assert not np.any(found.c[1:])
        assert encloses(found, exact(series, s), 0)
        assert np.all(found.r < 1e-13 * series.total)


def test_variables_enclose_the_candidate_and_its_tube():
    rows = [np.random.default_rng(9).normal(size=length) for length in (checker.DEGREE + 6, 3, 0)]
    found = checker._variables(rows, [0.25, 0.5, 0.75])
    for i, (row, x) in enumerate(zip(rows, found, strict=True)):
        for s in (Fraction(0), Fraction(1, 3), Fraction(1)):
            value = sum(Fraction(c) * s**k for k, c in enumerate(row))
            for move in (Fraction(-1 - i, 4), Fraction(1 + i, 4)):
                slopes = [Fraction(int(k == i)) for k in range(3)]
                assert encloses(x, np.array([[value + move, *slopes]]), s)
        above = np.abs(row[checker.DEGREE + 1 :]).sum()
        assert x.r[0, 0] < (0.25 * (1 + i) + above) * (1 + 1e-8) and np.all(x.r[0, 1:] < 1e-14)


def test_the_next_ellipsoid_contains_the_last_and_the_jump():
    """All e = X w + j with |w| <= radius are T w' with |w'| <= the radius that is returned."""
    rng = np.random.default_rng(10)
    X = rng.normal(size=(4, 4)) @ np.diag([1, 1e-1, 1e-3, 1e-5])
    error, radius, jump = 1e-6, 0.7, np.array([1e-3, 0, 2e-3, 1e-4])
    T, bound = checker._next_ellipsoid(checker._Series(checker._constant(X).c, error), radius, jump)
    assert np.isclose(np.linalg.cond(T), 100)
    largest = 0.0
    for _ in range(300):
        w = rng.normal(size=4)
        moved = (X + error * rng.choice([-1, 1], (4, 4))) @ (w * radius / np.linalg.norm(w))
        e = moved + rng.choice([-1, 1], 4) * jump
        largest = max(largest, float(np.linalg.norm(np.linalg.solve(T, e))))
    assert largest <= bound < 1.5 * largest + 2 * np.linalg.norm(np.abs(np.linalg.inv(T)) @ jump)


@pytest.mark.parametrize("rods", [[0], [1], [0, 1, 0], [1, 1]], ids=str)
def test_the_equations_hold_for_certified_accelerations(rods):
    """Newton-Euler as residual here, solved by elimination in `certified`: two independent forms."""
    model, state = chain(rods, seed=4)
    certified = certify_state(model, state).quantities
    document = json.loads(gzip.decompress(make_certificate(model, state, np.array([0.0, 1e-3]))))
    certificate = parse_certificate(json.dumps(document).encode())
    mechanism = checker._Mechanism(certificate, arb)
    with ctx.workprec(100):
        y = [arb_poly([x]) for x in checker._initial_values(mechanism)]
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
        exactly, rounded = (checker._Mechanism(certificate, number) for number in (arb, float))
        x = np.random.default_rng(6).normal(size=exactly.nq + 2 * exactly.nv)
        n = exactly.nq + exactly.nv
        duals = checker._variables([np.array([c]) for c in x], np.zeros(len(x)))
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
        record = state if field in ("x", "xdot") else model
        array = getattr(record, field).copy()
        last = array[-1:]  # of the joints, not a free body's
        if not np.any(last):
            continue
        largest = np.unravel_index(np.argmax(np.abs(last)), last.shape)
        last[largest] = np.nextafter(last[largest], np.inf)
        if field == "turn":
            last[0, 0, 1] += 2.0**-52  # the largest may be the only one, and is normalised
        changed = replace(record, **{field: array})
        pair = (model, changed) if record is state else (changed, state)
        numbers = {key: hexadecimal(x) for key, x in checked_numbers(*pair).items()}
        try:
            found = enclose(document | numbers)
        except checker.Rejected:
            continue
        assert found.radius("r") + found.radius("p") > 1e-18, f"{field} makes no difference"
        assert overlap(found, prove_motion(*pair, TIMES)[1]), field


def hexadecimal(x):
    return np.frompyfunc(float.hex, 1, 1)(np.asarray(x, dtype=float)).tolist()


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


@pytest.mark.parametrize("name", ["double-tumbling-balls", "tumbling-rod", *TREES[:3], "loaded-tree"])
def test_the_truth_of_runs_is_within_its_claimed_uncertainty(name):
    check_present_truth(load_scenario(find_scenario_file(name)), 0.3)


@pytest.mark.full
@pytest.mark.parametrize("scenario", PROVABLE, ids=lambda s: s.name)
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


@pytest.mark.full
@pytest.mark.parametrize("scenario", [s for s in PROVABLE if s.model.n <= 2], ids=lambda s: s.name)
def test_enclosures_of_small_scenarios_in_two_precisions_overlap_at_every_sample(scenario):
    found = (
        prove_motion(scenario.model, scenario.state, scenario.times, precision=x)[1]
        for x in ("quad", "octuple")
    )
    assert overlap(*found)


@pytest.mark.parametrize("name", PUBLISHED["motions"])
def test_published_solutions_are_proved_again_up_to_their_first_time(name):
    """docs/reference-solutions.json, in quad precision instead of octuple."""
    record, scenario = PUBLISHED["motions"][name], load_scenario(find_scenario_file(name))
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
@pytest.mark.parametrize("power", [0, 1, 5])
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
    record = state if field in ("p", "omega") else model
    array = getattr(record, field).copy()
    largest = np.unravel_index(np.argmax(np.abs(array)), array.shape)  # of an inertia, on the diagonal
    array[largest] = np.nextafter(array[largest], np.inf)
    changed = replace(state, **{field: array}) if record is state else replace(model, **{field: array})
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


def test_the_bound_of_the_defect_holds_and_counts_every_power(proofs):
    """Of the whole polynomials: at the end of a step all terms of a positive one count in full."""
    _, _, document, _ = proofs["ball"]
    certificate = parse_certificate(json.dumps(document).encode())
    mechanism, (length, *rows) = checker._Mechanism(certificate, arb), certificate.steps[0]
    with ctx.workprec(certificate.bits + checker.GUARD_BITS):
        unit = arb(2) ** -certificate.bits
        y, h = [arb_poly([c * unit for c in row]) for row in rows], length * unit
        kinematic, bounds = checker._bound_defect(mechanism, y, h)
        for s in (arb(0), arb(0.3), arb(1)):
            at = [arb_poly([poly(s)]) for poly in y]
            rates = [arb_poly([poly.derivative()(s) / h]) for poly in y[mechanism.nq :]]
            qdot, g = mechanism.equations(at, rates)
            for k, x in enumerate(g):
                assert abs(x(arb(0))) < arb(float(bounds[k]))
            for k, x in enumerate(qdot):
                assert abs(x(arb(0)) * h - y[k].derivative()(s)) < arb(float(kinematic[k]))
        longer = [
            poly + arb_poly([0] * 60 + [arb(2) ** -40]) for poly in y
        ]  # far above the candidate's order
        assert np.all(checker._bound_defect(mechanism, longer, h)[0] > 2.0**-36)


@pytest.mark.parametrize(
    "name, value", [("ROUNDING", 0.0), ("TINY", -1.0), ("UNIT", arb(0.25, 0.25) if TRUTH_TOOLS else None)]
)
def test_a_wrong_constant_of_the_bounds_is_noticed(monkeypatch, proofs, name, value):
    monkeypatch.setattr(checker, name, value)
    with pytest.raises((AssertionError, checker.Rejected)):
        test_roundings_are_in_the_radii(3)
        test_bounds_are_upper_bounds()
        test_the_bound_of_the_defect_holds_and_counts_every_power(proofs)


def test_a_series_that_is_cut_without_its_remainder_is_noticed(monkeypatch):
    usual = checker._convolution

    def cut(a, b):
        found = usual(a, b)
        found[checker.DEGREE + 1 :] = 0
        return found

    monkeypatch.setattr(checker, "_convolution", cut)
    with pytest.raises(AssertionError):
        test_a_product_encloses_the_product(((3, 2), (2, 4)), 0.0)


@pytest.mark.parametrize("name", ["_up", "_norm", "_inverse_guess", "_convolution", "_upper"])
def test_nan_is_never_accepted(proofs, monkeypatch, name):
    usual = getattr(checker, name)
    monkeypatch.setattr(checker, name, lambda *a, **options: usual(*a, **options) * np.nan)
    with pytest.raises(checker.Rejected):
        enclose(proofs["ball"][2])


def test_a_truncated_file_is_malformed(proofs):
    model, state, _, _ = proofs["ball"]
    raw = make_certificate(model, state, TIMES, "a scenario's hash")
    assert json.loads(gzip.decompress(raw))["scenario"] == "a scenario's hash"
    for length in (0, 1, 10, len(raw) // 2, len(raw) - 4):
        with pytest.raises(MalformedCertificate, match="not a complete gzip or JSON file"):
            parse_certificate(raw[:length])


@pytest.mark.parametrize(
    "change, message",
    [
        ({"format": "x"}, "format: expected the text"),
        ({"version": 1}, "version: expected 2"),
        ({"mass": ["nan"]}, "mass: expected finite doubles"),
        ({"mass": [0.5]}, "mass: expected finite doubles"),
        ({"mass": ["-0x1p0"]}, "mass: expected positive"),
        ({"mass": ["0x1p0", "0x1p0"]}, r"mass: expected finite doubles as '0x1.8p\+0', shape \(1,\)"),
        ({"inertia": None}, "inertia: expected finite doubles"),
        ({"inertia": [[["0x1p0"] * 3, ["0x0p0"] * 3, ["0x0p0"] * 3]]}, "inertia: expected symmetric"),
        ({"kind": []}, "kind: expected 1 to 100 of rod, free, ball, .*, not welds alone"),
        ({"kind": ["weld"]}, "kind: expected 1 to 100 of"),
        ({"kind": ["spring"]}, "kind: expected 1 to 100 of"),
        ({"kind": [["ball"]]}, "kind: expected 1 to 100 of"),
        ({"far": [0]}, "far: expected of each joint -1 or a body before it"),
        ({"far": [-2]}, "far: expected of each joint -1 or a body before it"),
        ({"far": [-1, 0]}, "far: expected of each joint -1 or a body before it"),
        ({"far": [True]}, "far: expected of each joint -1 or a body before it"),
        ({"springs": [[0, 1]]}, "springs: expected pairs of bodies, -1 the world"),
        ({"springs": [[0]]}, "springs: expected pairs of bodies, -1 the world"),
        ({"springs": [[0, -1]]}, "spring_point: expected finite doubles"),
        ({"stiffness": [["0x1p0", "0x0p0"]]}, "stiffness: expected zeros of rods, balls and free bodies"),
        ({"mass": ["0x1p-400"]}, "mass: expected finite doubles .* not below 1e-100"),
        ({"bits": 110.0}, "bits: expected an integer from 16 to"),
        ({"bits": True}, "bits: expected an integer"),
        ({"time_exponent": 100}, "time_exponent: expected an integer from -60 to 60"),
        ({"times": ["0x0p0", "0x0p0"]}, "times: expected ascending"),
        ({"steps": []}, "steps: expected a list of steps"),
        ({"steps": [[1]]}, r"steps\[0\]: expected a positive length, then 7 lists"),
        ({"steps": [[0, *[[1]] * 7]]}, r"steps\[0\]: expected a positive length"),
        ({"steps": [[1, *[[1.0]] * 7]]}, r"steps\[0\]: expected lists of at most"),
    ],
)  # fmt: skip
def test_a_malformed_field_is_named(proofs, change, message):
    with pytest.raises(MalformedCertificate, match=message):
        enclose(proofs["ball"][2] | change)


def test_damaged_documents_are_malformed_or_rejected(proofs):
    """No other exception, whatever the document holds."""
    document, draw, outcomes = proofs["ball"][2], random.Random(8), Counter()
    for _ in range(40):
        damaged = json.dumps(damaged_document(document | {"steps": document["steps"][:1]}, draw)).encode()
        with limited_time():
            try:
                checker.enclose_motion(parse_certificate(damaged))
            except (MalformedCertificate, checker.Rejected) as error:
                outcomes[type(error)] += 1
    assert outcomes[MalformedCertificate] and outcomes[checker.Rejected], outcomes


def test_damaged_files_are_malformed_or_read_whole(proofs):
    """The gzip checksum covers the content, not the header."""
    model, state, _, _ = proofs["ball"]
    raw, draw = make_certificate(model, state, TIMES), random.Random(9)
    outcomes = Counter()
    for _ in range(100):
        with limited_time():
            try:
                found = parse_certificate(damaged_bytes(raw, draw))
            except MalformedCertificate:
                outcomes["malformed"] += 1
            else:
                assert found.steps == parse_certificate(raw).steps
    assert outcomes["malformed"] > 50


def test_a_motion_at_rest_is_enclosed():
    scenario = load_scenario(find_scenario_file("rest"))
    _, enclosure = prove_motion(scenario.model, scenario.state, np.array([0.0, 1.0]))
    assert enclosure.radius("r") < 1e-30  # a thousand times the last of the coefficients' 110 bits


def test_a_rejected_candidate_is_tried_again_with_shorter_steps(monkeypatch):
    lengths = []

    def reject(certificate, _):
        lengths.append(certificate.steps[0][0] / 2**certificate.bits)
        raise checker.Rejected("never proved")

    monkeypatch.setattr(checker, "enclose_motion", reject)
    scenario = load_scenario(find_scenario_file("rest"))
    with pytest.raises(checker.Rejected, match="never proved"):
        prove_motion(scenario.model, scenario.state, np.array([0.0, 1.0]))
    assert lengths == [0.5, 0.25, 0.125]


def test_fast_spin_is_enclosed():
    scenario = load_scenario(find_scenario_file("lagrange-top"))
    _, enclosure = prove_motion(scenario.model, scenario.state, TIMES)
    assert enclosure.radius("r") < 1e-24
