"""The checker of certificates: each bound against exact arithmetic, and stored certificates."""

import ast
import io
import json
import tokenize
from fractions import Fraction
from importlib.util import find_spec
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from plumbline.truth import certificate_file
from plumbline.truth.certificate_file import parse_certificate
from tests.helpers.stored_certificates import NAMES, QUANTITIES, proved, stored_document

pytestmark = pytest.mark.skipif(not find_spec("flint"), reason="the truth tools are not installed")
if find_spec("flint"):
    from flint import arb, arb_poly, ctx

    from plumbline.truth import certificate_checker as checker


def parsed(document):
    return parse_certificate(json.dumps(document).encode())


@pytest.mark.parametrize("name", NAMES)
def test_a_stored_certificate_proves_what_it_did(name):
    """Balls that contain the motion, found in octuple precision, and that are no wider and no narrower."""
    document, steps = stored_document(name), []
    found = checker.enclose_motion(parsed(document), lambda *numbers: steps.append(numbers))
    assert found.times == [float.fromhex(text) for text in document["times"]]
    assert steps == [(k + 1, len(document["steps"])) for k in range(len(document["steps"]))]
    for quantity in QUANTITIES:
        balls, expected = getattr(found, quantity), proved(name)[quantity]
        for ball, text in zip(balls.ravel(), np.ravel(expected["midpoint"]), strict=True):
            assert ball.overlaps(arb(str(text)))
        radii = np.frompyfunc(lambda ball: float(ball.rad()), 1, 1)(balls).astype(float)
        assert found.radius(quantity) == np.max(radii)
        np.testing.assert_allclose(radii, expected["radius"], rtol=1e-6)


def imported_modules(path):
    tree = ast.parse(Path(path).read_text(encoding="utf-8"))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    return imported | {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}


def test_the_checker_imports_numpy_flint_and_the_standard_library_only():
    """And the file that reads certificates, which imports NumPy and the standard library only."""
    standard = {"__future__", "collections.abc", "dataclasses", "fractions", "typing"}
    assert imported_modules(checker.__file__) == standard | {"numpy", "flint", certificate_file.__name__}
    standard = {"__future__", "dataclasses", "typing"}
    assert imported_modules(certificate_file.__file__) == standard | {"json", "zlib", "numpy"}


@pytest.mark.parametrize("name, most", [("certificate_checker", 300), ("certificate_file", 130)])
def test_the_checker_and_its_reader_are_short_enough_to_be_read(name, most):
    """Without docstrings, comments and blank lines."""
    source = Path(certificate_file.__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
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
    return checker.Series(np.abs(c) if positive else c, radius)


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
    return checker.Series(found.c)


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
        assert not encloses(checker.Series(found.c), values(Fraction(1)), Fraction(1)), "nothing was rounded"


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
    assert checker.round_up(1.0) == 1 + 2.0**-30  # (F): ten nested sums of up to 2^15 products
    for _ in range(20):
        x = np.abs(rng.normal(size=(5, 7)))
        squares = sum(Fraction(c) ** 2 for c in x.ravel())
        assert squares < Fraction(float(checker.norm_bound(x))) ** 2 < squares * Fraction(1 + 1e-8)
        rows = checker.norm_bound(x, axis=1)
        assert all(
            sum(Fraction(c) ** 2 for c in row) < Fraction(n) ** 2 for row, n in zip(x, rows, strict=True)
        )
        series = draw_series(rng, 2, 2, 0.5)
        assert np.all(np.abs(exact(series, 1, 1)) <= np.frompyfunc(Fraction, 1, 1)(series.size))
        assert np.allclose(series.size, np.abs(series.c).sum(0) + 0.5, rtol=1e-8)
    assert (
        0 < checker.norm_bound(np.zeros(3)) < 1e-149 and checker.round_up(0.0) == 2.0**-1000
    )  # underflows are covered
    balls = [arb(-3, 0.5), arb(2), arb("0.1")]
    assert all(
        abs(ball) < arb(float(bound)) for ball, bound in zip(balls, checker.upper_bounds(balls), strict=True)
    )
    assert np.allclose(checker.upper_bounds(balls), [3.5, 2, 0.1], rtol=1e-8)


def test_guesses_are_inverses():
    rng = np.random.default_rng(7)
    series = draw_series(rng, 3, 3) * 0.01 + checker.Series(checker.constant_series(np.eye(3)).c)
    inverse = checker.Series(checker.inverse_guess(series.c))
    assert checker.inverse_error(inverse, series, "") < 0.1
    with pytest.raises(checker.Rejected, match="message"):
        checker.inverse_error(inverse, series * 3, "message")
    J = series.c
    P = checker.recurrence(J, np.eye(3), 1)
    for k in range(3):  # (k + 1) P_(k+1) = sum of J_i P_(k-i)
        assert np.allclose((k + 1) * P[k + 1], sum(J[i] @ P[k - i] for i in range(k + 1)))


def test_a_guess_that_is_off_by_more_than_1_is_no_inverse():
    one = checker.Series(checker.constant_series(np.eye(1)).c)
    assert 0.5 <= checker.inverse_error(one, one * 0.5, "") < 0.51
    for factor in (0, 2, -0.5, -0.9):
        with pytest.raises(checker.Rejected, match="message"):
            checker.inverse_error(one, one * factor, "message")


def test_a_series_at_a_point_encloses_its_values():
    series = draw_series(np.random.default_rng(8), 2, 3)
    for s in (Fraction(0), Fraction(1, 3), Fraction(7, 9), Fraction(1)):
        found = checker.evaluate_series(series, float(s))
        assert not np.any(found.c[1:])
        assert encloses(found, exact(series, s), 0)
        assert np.all(found.r < 1e-13 * series.total)


def test_variables_enclose_the_candidate_and_its_tube():
    rows = [np.random.default_rng(9).normal(size=length) for length in (checker.DEGREE + 6, 3, 0)]
    found = checker.dual_variables(rows, [0.25, 0.5, 0.75])
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
    T, bound = checker.next_ellipsoid(checker.Series(checker.constant_series(X).c, error), radius, jump)
    assert np.isclose(np.linalg.cond(T), 100)
    largest = 0.0
    for _ in range(300):
        w = rng.normal(size=4)
        moved = (X + error * rng.choice([-1, 1], (4, 4))) @ (w * radius / np.linalg.norm(w))
        e = moved + rng.choice([-1, 1], 4) * jump
        largest = max(largest, float(np.linalg.norm(np.linalg.solve(T, e))))
    assert largest <= bound < 1.5 * largest + 2 * np.linalg.norm(np.abs(np.linalg.inv(T)) @ jump)


def test_the_roundings_of_the_candidate_are_in_the_radii_of_its_variables():
    """Rational coefficients, each rounded to a double once."""
    coefficients = [Fraction(1, 3 * k) for k in range(1, 9)]
    (x,) = checker.dual_variables([np.array(coefficients, dtype=float)], np.zeros(1))
    values = [sum(c * s**k for k, c in enumerate(coefficients)) for s in (Fraction(1), Fraction(1, 3))]
    for s, value in zip((Fraction(1), Fraction(1, 3)), values, strict=True):
        assert encloses(x, np.array([[value, 1]]), s)
    assert not encloses(checker.Series(x.c), np.array([[values[0], 1]]), Fraction(1)), "nothing was rounded"
    assert np.allclose(x.r, 2.0**-51 * x.total, rtol=1e-8, atol=0)


def test_a_series_at_a_point_that_is_rounded_encloses_its_value():
    """1 - 2^-54 is rounded to 1, which changes s^11 by 11 roundings."""
    s = 1 - Fraction(1, 2**54)
    highest = checker.Series(np.eye(checker.DEGREE + 1)[:, -1].reshape(-1, 1, 1))
    found = checker.evaluate_series(highest, s.numerator / s.denominator)
    assert found.c[0, 0, 0] == 1
    assert encloses(found, np.array([[s**checker.DEGREE]]), Fraction(0))
    assert np.allclose(found.r, 4 * checker.DEGREE * 2.0**-51, rtol=1e-8, atol=0)


# bounds with poor guesses, which need no trust: one that is off by half costs nothing but rounding here


def test_the_next_ellipsoid_contains_matrices_that_are_off_by_their_radii():
    """X = 1 + E, |E_ij| <= 1/2: the largest is 1 + J/2, of norm 3 in four dimensions."""
    T, bound = checker.next_ellipsoid(
        checker.Series(checker.constant_series(np.eye(4)).c, 0.5), 0.7, np.zeros(4)
    )
    assert np.array_equal(np.abs(T), np.eye(4))
    assert 3 * 0.7 <= bound < 3 * 0.7 * (1 + 1e-8)


def test_the_next_ellipsoid_holds_with_a_poor_inverse(monkeypatch):
    """e = 2 w + j is w' itself where T = 1."""
    monkeypatch.setattr(np.linalg, "inv", lambda a: np.full_like(a, 0.5))
    T, bound = checker.next_ellipsoid(checker.constant_series(np.array([[2.0]])), 0.7, np.array([0.125]))
    assert np.array_equal(T, [[1]])
    assert 2 * 0.7 + 0.125 <= bound < (2 * 0.7 + 0.125) * (1 + 1e-8)


def test_the_next_ellipsoid_is_round_in_the_given_scale():
    """Rates of short steps count by what they do in a step: cond(T scale) is 100, not that of T."""
    rng, scale = np.random.default_rng(11), np.array([[1.0], [1.0], [1e-3], [1e-3]])
    X = np.linalg.qr(rng.normal(size=(4, 4)))[0] @ np.diag([1, 1e-1, 1e-4, 1e-5]) @ rng.normal(size=(4, 4))
    T, _ = checker.next_ellipsoid(checker.constant_series(X / scale), 1.0, np.zeros(4), scale)
    assert np.linalg.cond(T * scale) == pytest.approx(100)
    assert np.allclose(T * scale, checker.next_ellipsoid(checker.constant_series(X), 1.0, np.zeros(4))[0])


def test_rates_of_short_steps_have_their_scale(monkeypatch):
    """256 steps in the unit of time are short: a rate counts by 256 times the step."""
    usual, scales, document = checker.next_ellipsoid, [], stored_document("one-rod")
    monkeypatch.setattr(checker, "next_ellipsoid", lambda *a: scales.append(a[3].ravel()) or usual(*a))
    lengths = [step[0] / 2 ** document["bits"] for step in document["steps"]]
    assert checker.FAST * min(lengths) > 1
    checker.enclose_motion(parsed(document))
    assert np.array_equal(scales, np.ones((len(lengths), 13)))
    monkeypatch.setattr(checker, "FAST", 0.25)
    checker.enclose_motion(parsed(document))
    expected = [[1.0] * 7 + [0.25 * length] * 6 for length in lengths]
    assert np.array_equal(scales[len(lengths) :], expected)


class LinearMechanism:
    """v_k' = −stiffness_k y_0, with unit masses; y_0 is a place, or the rate itself where there is none."""

    def __init__(self, stiffness, nq):
        self.stiffness, self.nq, self.nv, self.beta = stiffness, nq, len(stiffness), 0.0

    def equations(self, y, vdot):
        self.beta = vdot[0].r[0, 0]
        residual = [a + y[0] * k for a, k in zip(vdot, self.stiffness, strict=True)]
        return [y[self.nq + i] * 1.0 for i in range(self.nq)], residual


def poor_guesses(monkeypatch, *factors):
    """Inverses are guessed with their rows times factors, of one guess after the other in turn."""
    usual, rest = checker.inverse_guess, cycle(factors)
    monkeypatch.setattr(checker, "inverse_guess", lambda a: np.array(next(rest))[:, None] * usual(a))


@pytest.mark.parametrize(
    "stiffness, defect", [(4095.5, 0.0), (4097.0, 0.0), (600.0, 3495.5), (600.0, 3497.0)]
)
def test_the_tube_of_the_accelerations_contains_them(monkeypatch, stiffness, defect):
    """For |e_0| <= 1 the first is off by stiffness + defect at most, and 16^3 is the least tube tried."""
    poor_guesses(monkeypatch, [0.5, 1.0])
    mechanism = LinearMechanism([stiffness, 0.0], 1)
    *_, theta = checker.linearise(mechanism, [np.zeros(1)] * 5, 1.0, np.array([defect, 0.0]))
    assert 0.5 <= theta < 0.5 + 1e-8
    assert stiffness + defect <= mechanism.beta
    assert np.isclose(mechanism.beta, 16**3 if stiffness + defect < 16**3 else 16**4)


def unstable_step(monkeypatch, h):
    """v' = 2 v; the poor inverse gives P = exp(h s), so that w = v / P grows by exp(h)."""
    poor_guesses(monkeypatch, [0.5], [1.0])
    start = np.zeros(0), np.zeros(1)
    return checker.prove_step(LinearMechanism([-2.0], 0), [np.zeros(1)] * 2, h, start, np.eye(1), 1e-6)


@pytest.mark.parametrize("h", [0.1, 0.15])
def test_the_growth_of_the_error_is_bounded_with_a_poor_inverse_of_the_masses(monkeypatch, h):
    found, rho = unstable_step(monkeypatch, h)
    assert np.isclose(found.total[0, 0], np.exp(h))
    assert 1e-6 * np.exp(h) <= rho < 1e-6 / (1 - h * np.exp(2 * h)) * (1 + 1e-6)


def test_an_error_that_grows_too_fast_is_rejected(monkeypatch):
    """a = h exp(2 h) > 1, so that 1 − a is negative."""
    with pytest.raises(checker.Rejected, match=r"inequality \(5\): the error grows too fast"):
        unstable_step(monkeypatch, 0.5)


@pytest.mark.parametrize("field, rate", [("armature", "vdot"), ("damping", "v")])
def test_a_ball_has_its_moment_with_either_element_alone(field, rate):
    """a ω̇ or c ω about a ball on the world, for each of the two without the other."""
    none, document = {"armature": [["0x0p0"] * 2], "damping": [["0x0p0"] * 2]}, stored_document("one-ball")
    v = {"v": [arb(1), arb(2), arb(3)], "vdot": [arb(4), arb(5), arb(6)]}
    one, two = (
        checker.Mechanism(parsed(document | none | changed), arb)
        for changed in ({}, {field: [["0x1p1", "0x0p0"]]})
    )
    y = [*checker.initial_values(one)[: one.nq], *v["v"]]
    moments = zip(two.equations(y, v["vdot"])[1], one.equations(y, v["vdot"])[1], v[rate], strict=True)
    coefficient = two.data[field][0, 0]
    assert coefficient > 0
    for with_it, without, x in moments:
        assert abs(with_it - without - x * coefficient) < 1e-9


# (8): springs of ball joints

SPRUNG = {"armature": [["0x0p0"] * 2], "damping": [["0x0p0"] * 2], "stiffness": [["0x1p1", "0x0p0"]]}


def sprung_ball(number, terms=None):
    """The mechanism of one ball with a spring alone; ``terms`` is N of (8)."""
    mechanism = checker.Mechanism(parsed(without_steps(stored_document("one-ball") | SPRUNG)), number)
    mechanism.terms = mechanism.terms[:terms]
    return mechanism


def without_steps(document):
    return document | {"steps": [[1, *[[0]] * 9]]}


def turn_rates(mechanism, sigma, constant):
    """The rates of σ and γ as they are and as the turn φ has them, with γ = 1/2 and ψᵀω found from σ̇."""
    y = [constant(x) for x in (0.5, 0.5, -0.5, 0.5, sigma, 0.5, 1.0, -2.0, 0.25)]
    sigma_rate, gamma_rate = mechanism.equations(y, y[-3:])[0][4:]
    return sigma_rate, gamma_rate


def series_of_spring(sigma):
    """f₀(σ) = 3 (sin φ/φ − cos φ)/σ, whose limit at 0 is 1."""
    with ctx.workprec(400):
        phi = arb(sigma).sqrt()
        return 3 * (phi.sinc() - phi.cos()) / phi**2 if sigma else arb(1)


@pytest.mark.parametrize("terms", [1, 2, 3, 5, 12, None])
@pytest.mark.parametrize("sigma", [0.0, 2.0**-40, 1.5, 9.75])
def test_the_ratio_of_a_turn_to_its_sine_changes_as_it_must(terms, sigma):
    """Its rate γ² f₀(σ) σ̇ is enclosed with any number of terms, in balls and in doubles."""
    with ctx.workprec(150):
        change, rate = turn_rates(sprung_ball(arb, terms), sigma, lambda x: arb_poly([x]))
        expected = change(arb(0)) / 4 * series_of_spring(sigma)
        found = rate(arb(0))
        assert found.overlaps(expected) and abs(found - expected).mid() <= found.rad()
        assert terms or found.rad() < 1e-32 * abs(expected)
        largest = abs(change(arb(0))) / 4 * sigma / 10  # of the only term, where f₁ = 1 ± 1
        assert terms != 1 or found.rad() <= largest * (1 + 1e-7) + 1e-40
        rate = turn_rates(sprung_ball(float, terms), sigma, series_without_radius)[1]
        radius = float(rate.r[0, 0])
        assert abs(arb(float(rate.c[0, 0, 0])) - expected) < radius
        assert (terms or 12) < 12 or radius < 1e-12 * abs(float(expected))
        assert terms != 1 or radius <= largest * (1 + 1e-7) + 1e-12


def series_without_radius(x):
    return checker.constant_series(np.array([[x, 0.0]]))


@pytest.mark.parametrize("terms", [1, 3, None])
def test_the_series_of_a_turn_that_changes_is_enclosed_with_few_powers(terms):
    """σ = 2 + s and σ = 2 + s²/2: of f₀ no powers above those of σ are kept, but their sum."""
    with ctx.workprec(150):
        for powers in ([2, 1], [2, 0, 0.5]):
            y = [arb_poly([x]) for x in (0.5, 0.5, -0.5, 0.5, 0, 0.5, 1.0, -2.0, 0.25)]
            y[4] = arb_poly(powers)
            change, rate = sprung_ball(arb, terms).equations(y, y[-3:])[0][4:]
            assert len(rate) == len(powers)
            for s in (arb(0), arb(0.25), arb(1)):
                expected = change(s) / 4 * series_of_spring(y[4](s))
                assert abs(rate(s) - expected).mid() <= rate(s).rad()
                assert terms == 1 or rate(s).rad() < 0.1 * abs(expected)


@pytest.mark.parametrize("is_exact", [True, False])
def test_a_dropped_remainder_of_a_spring_is_noticed(monkeypatch, is_exact):
    """With few terms the sum alone is far from f₀(σ)."""
    usual = checker.Mechanism.__init__

    def without_remainder(self, *arguments):
        usual(self, *arguments)
        if self.exact == is_exact:
            self.unknown = arb(0) if is_exact else checker.constant_series(np.zeros((1, 1)))

    monkeypatch.setattr(checker.Mechanism, "__init__", without_remainder)
    with pytest.raises(AssertionError):
        test_the_ratio_of_a_turn_to_its_sine_changes_as_it_must(2, 1.5)


@pytest.mark.parametrize("sigma, is_near", [(9.859, False), (9.861, True), (-9.861, True), (np.nan, True)])
def test_a_spring_near_half_a_turn_is_rejected(sigma, is_near):
    """Its moment jumps where σ = π², which the tube must not reach: 9.86 is below it and below 10."""
    assert checker.MAX_SIGMA < np.pi**2 < 10

    def turn():
        return turn_rates(sprung_ball(float), sigma, series_without_radius)

    if is_near:
        with pytest.raises(checker.Rejected, match=r"inequality \(8\): near half a turn"):
            turn()
    else:
        assert turn()


def test_a_spring_near_half_a_turn_counts_its_tube():
    wide = {9.8: checker.Series(series_without_radius(9.8).c, np.array([[0.07, 0.0]]))}
    with pytest.raises(checker.Rejected, match="near half a turn"):
        turn_rates(sprung_ball(float), 9.8, lambda x: wide.get(x, series_without_radius(x)))


@pytest.mark.parametrize("degrees", [0, 1e-9, 60, 179])
def test_the_turn_of_a_spring_starts_as_the_attitude_has_it(degrees):
    """σ = φ² and γ = φ/(6 sin φ), for a turn about any axis and either sign of the quaternion."""
    half, axis = np.radians(degrees) / 2, np.array([2.0, -1.0, 2.0]) / 3
    none = [[["0x1p0", *["0x0p0"] * 3]] * 2]
    for sign in (1, -1):
        p = sign * np.array([np.cos(half), *(np.sin(half) * axis)])
        document = stored_document("one-ball") | SPRUNG | {"turn": none, "p": [[x.hex() for x in p.tolist()]]}
        y = checker.initial_values(checker.Mechanism(parsed(without_steps(document)), arb))
        phi = 2 * half
        assert abs(float(y[4]) - phi**2) <= 1e-12 * phi and y[4].rad() < 1e-12
        assert float(y[5]) == pytest.approx(phi / np.sin(phi) / 6 if phi else 1 / 6, rel=1e-10)


def test_a_rod_starts_normalised():
    """u/|u|, and u̇ less what is along it."""
    document = stored_document("one-rod") | {"u": [["0x1p0", "-0x1p1", "0x1p1"]], "udot": [["0x1p0"] * 3]}
    y = checker.initial_values(checker.Mechanism(parsed(document), arb))
    unit = 2.0 ** document["time_exponent"]
    assert np.allclose(np.array(y[4:7], dtype=float), np.array([1, -2, 2]) / 3, rtol=1e-15)
    assert np.allclose(np.array(y[10:], dtype=float), unit * (1 - np.array([1, -2, 2]) / 9), rtol=1e-15)


def test_where_the_steps_end_is_said():
    document = stored_document("one-ball")
    end = document["steps"][0][0] * 2.0 ** (document["time_exponent"] - document["bits"])
    with pytest.raises(checker.Rejected, match=f"^the steps end at {end:g} s, before the last sample"):
        checker.enclose_motion(parsed(document | {"steps": document["steps"][:1]}))


def test_samples_are_at_their_times_of_their_steps(monkeypatch):
    """The first at the start of the first step, exactly."""
    usual, at = checker.sample_at, []
    monkeypatch.setattr(checker, "sample_at", lambda *a: at.append(a[-1]) or usual(*a))
    document = stored_document("one-ball")
    checker.enclose_motion(parsed(document))
    assert float.fromhex(document["times"][0]) == 0 == at[0]
    assert len(at) == len(document["times"]) and all(0 < s <= 1 for s in at[1:])


# planted faults


def test_the_bound_of_the_defect_holds_and_counts_every_power():
    """Of the whole polynomials: at the end of a step all terms of a positive one count in full."""
    certificate = parsed(stored_document("one-ball"))
    mechanism, (length, *rows) = checker.Mechanism(certificate, arb), certificate.steps[0]
    with ctx.workprec(certificate.bits + checker.GUARD_BITS):
        unit = arb(2) ** -certificate.bits
        y, h = [arb_poly([c * unit for c in row]) for row in rows], length * unit
        kinematic, bounds = checker.bound_defect(mechanism, y, h)
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
        assert np.all(checker.bound_defect(mechanism, longer, h)[0] > 2.0**-36)


@pytest.mark.parametrize("name, value", [("ROUNDING", 0.0), ("TINY", -1.0), ("UNIT", (0.25, 0.25))])
def test_a_wrong_constant_of_the_bounds_is_noticed(monkeypatch, name, value):
    monkeypatch.setattr(checker, name, arb(*value) if name == "UNIT" else value)
    with pytest.raises((AssertionError, checker.Rejected)):
        test_roundings_are_in_the_radii(3)
        test_bounds_are_upper_bounds()
        test_the_bound_of_the_defect_holds_and_counts_every_power()


def test_a_series_that_is_cut_without_its_remainder_is_noticed(monkeypatch):
    usual = checker.convolution

    def cut(a, b):
        found = usual(a, b)
        found[checker.DEGREE + 1 :] = 0
        return found

    monkeypatch.setattr(checker, "convolution", cut)
    with pytest.raises(AssertionError):
        test_a_product_encloses_the_product(((3, 2), (2, 4)), 0.0)


@pytest.mark.parametrize("name", ["round_up", "norm_bound", "inverse_guess", "convolution", "upper_bounds"])
def test_nan_is_never_accepted(monkeypatch, name):
    usual = getattr(checker, name)
    monkeypatch.setattr(checker, name, lambda *a, **options: usual(*a, **options) * np.nan)
    with pytest.raises(checker.Rejected, match=r"^step 1 of"):
        checker.enclose_motion(parsed(stored_document("one-ball")))
