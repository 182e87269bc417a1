"""The certified truth: enclosures that hold, and two formulations that share nothing with it."""

import sys

import numpy as np
import pytest

from plumbline.truth import TruthUnavailable, import_truth_tool
from plumbline.truth.certified_state import (
    MAX_RELATIVE_RADIUS,
    CertificationFailure,
    certify_state,
    enclose_quantities,
)
from tests.helpers.notes_system_multiprecision import notes_solution
from tests.helpers.random_chains import random_chain

flint = pytest.importorskip("flint")
mpmath = pytest.importorskip("mpmath")

JOINT_PATTERNS = [[0], [1], [0, 0], [1, 1], [0, 1], [1, 0], [1, 0, 1, 0]]


def max_difference(enclosure, other):
    """Largest distance of two lists of 3-vectors, one in balls and one in mpf, at 60 digits."""
    with mpmath.workdps(60):
        pairs = zip((x for row in enclosure for x in row), (y for row in other for y in row), strict=True)
        return float(max(abs(mpmath.mpf(x.mid().str(58, radius=False)) - y) for x, y in pairs))


@pytest.mark.parametrize("rods", JOINT_PATTERNS, ids=str)
@pytest.mark.parametrize("loads", [False, True])
def test_the_notes_full_system_at_fifty_digits_agrees(rods, loads):
    model, state = random_chain(np.random.default_rng(3), rods, mass_decades=1, loads=loads, drag=loads)
    balls, other = enclose_quantities(model, state, 250), notes_solution(model, state)
    for quantity, value in other.items():
        assert max_difference(balls[quantity], value) < 1e-44 * balls["scale"][quantity], quantity


def test_enclosures_contain_the_results_of_a_higher_precision():
    model, state = random_chain(np.random.default_rng(7), [0, 1, 0, 0, 1], mass_decades=2)
    coarse, fine = enclose_quantities(model, state, 120, True), enclose_quantities(model, state, 500, True)
    for quantity in set(coarse) - {"scale"}:
        for x, y in zip(np.ravel(coarse[quantity]), np.ravel(fine[quantity]), strict=True):
            assert x.contains(y), quantity


def test_precision_rises_until_the_radius_is_small():
    model, state = random_chain(np.random.default_rng(1), [0] * 6, mass_decades=3)
    answer = certify_state(model, state, bits=60)
    assert answer.bits > 60
    assert answer.radius["acceleration"] <= MAX_RELATIVE_RADIUS * max(
        max_norm(answer.quantities.acceleration), 9.81
    )


def max_norm(v):
    return float(np.max(np.linalg.norm(v, axis=-1)))


def test_a_singular_system_is_not_certified():
    model, state = random_chain(np.random.default_rng(0), [0, 0])
    inertia = model.inertia.copy()
    inertia[1] = 0.0  # nothing resists a spin about the line from the ball joint to the point mass
    with pytest.raises(CertificationFailure, match="singular"):
        certify_state(model.changed(inertia=inertia), state)


def test_missing_truth_tools_raise_with_an_explanation(monkeypatch):
    monkeypatch.setitem(sys.modules, "flint", None)
    model, state = random_chain(np.random.default_rng(0), [0])
    with pytest.raises(TruthUnavailable, match="truth tools not installed"):
        certify_state(model, state)
    with pytest.raises(ImportError):
        import_truth_tool("flint")
