"""The certified truth: enclosures that hold, and the notes' equations, which share nothing with it."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from plumbline.model.datatypes import BODY_FIELDS
from plumbline.truth import TruthUnavailable, import_truth_tool
from plumbline.truth.certified_state import (
    MAX_RELATIVE_RADIUS,
    CertificationFailure,
    certify_state,
    enclose_quantities,
)
from reference_impl.direct import DirectSystem
from reference_impl.euler_parameters import A, L, dAs_dp, dot
from reference_impl.joints import constraint_rows
from tests.helpers.random_chains import random_chain

flint = pytest.importorskip("flint")
mpmath = pytest.importorskip("mpmath")

JOINT_PATTERNS = [[0], [1], [0, 0], [1, 1], [0, 1], [1, 0], [1, 0, 1, 0]]


def exactly(model, state):
    """A chain with ``mpf`` for numbers, and r, p, ṙ, ṗ in which its joints are closed to all digits."""
    exact, root = (np.frompyfunc(function, 1, 1) for function in (mpmath.mpf, mpmath.sqrt))
    names = ("mass", "inertia", "point", "length", "gravity", *BODY_FIELDS)
    model = replace(model, **{name: exact(getattr(model, name)) for name in names})
    p, omega, u, udot = (exact(getattr(state, name)) for name in ("p", "omega", "u", "udot"))
    p = p / root(dot(p, p))[:, None]
    pdot = (L(p).mT @ omega[..., None])[..., 0] / 2
    u = u / np.where(model.rods, root(dot(u, u)), 1)[:, None]
    udot = udot - u * dot(u, udot)[:, None]
    r, v, tip = [], [], np.zeros((2, 3), int)
    for k in range(model.n):
        near, far = (
            np.array([A(p[k]) @ s, dAs_dp(p[k], s) @ pdot[k]]) for s in (model.proximal[k], model.distal[k])
        )
        centre = tip + model.length[k] * np.array([u[k], udot[k]]) - near
        tip = centre + far
        r.append(centre[0])
        v.append(centre[1])
    return model, (np.array(r), p, np.array(v), pdot)


def notes_solution(model, state):
    """r̈, ω̇′ and the joints' forces by (N5) at fifty digits: multipliers, and a dense solve."""
    with mpmath.workdps(50):
        model, at = exactly(model, state)
        S, b = DirectSystem(model).assemble(*at)
        x = np.array(list(mpmath.lu_solve(mpmath.matrix(S.tolist()), mpmath.matrix(b.tolist()))))
        rows, n = constraint_rows(model, *at), model.n
        reaction = np.zeros((n, 3), object)
        np.subtract.at(reaction, rows.joint, x[7 * n : 7 * n + len(rows.joint), None] * rows.r_near)
        pddot = x[3 * n : 7 * n].reshape(n, 4, 1)
        return {
            "acceleration": x[: 3 * n].reshape(n, 3),
            "angular_acceleration": 2 * (L(at[1]) @ pddot)[..., 0],  # L̇ ṗ = 0 (N9)
            "joint_reaction": reaction,
        }


def max_difference(enclosure, other):
    """Largest distance of two lists of 3-vectors, one in balls and one in mpf, at 60 digits."""
    with mpmath.workdps(60):
        pairs = zip((x for row in enclosure for x in row), (y for row in other for y in row), strict=True)
        return float(max(abs(mpmath.mpf(x.mid().str(58, radius=False)) - y) for x, y in pairs))


@pytest.mark.parametrize("rods", JOINT_PATTERNS, ids=str)
@pytest.mark.parametrize("loads", [False, True])
def test_the_notes_full_system_at_fifty_digits_agrees(rods, loads):
    model, state = random_chain(3, rods, mass_decades=1, loads=loads, drag=loads)
    balls, other = enclose_quantities(model, state, 250), notes_solution(model, state)
    for quantity, value in other.items():
        assert max_difference(balls[quantity], value) < 1e-44 * balls["scale"][quantity], quantity


def test_enclosures_contain_the_results_of_a_higher_precision():
    model, state = random_chain(7, [0, 1, 0, 0, 1], mass_decades=2)
    coarse, fine = enclose_quantities(model, state, 120, True), enclose_quantities(model, state, 500, True)
    for quantity in set(coarse) - {"scale"}:
        for x, y in zip(np.ravel(coarse[quantity]), np.ravel(fine[quantity]), strict=True):
            assert x.contains(y), quantity


def test_precision_rises_until_the_radius_is_small():
    model, state = random_chain(1, [0] * 6, mass_decades=3)
    answer = certify_state(model, state, bits=60)
    assert answer.bits > 60
    assert answer.radius["acceleration"] <= MAX_RELATIVE_RADIUS * max(
        max_norm(answer.quantities.acceleration), 9.81
    )


def max_norm(v):
    return float(np.max(np.linalg.norm(v, axis=-1)))


def test_a_singular_system_is_not_certified():
    model, state = random_chain(0, [0, 0])
    inertia = model.inertia.copy()
    inertia[1] = 0.0  # nothing resists a spin about the line from the ball joint to the point mass
    with pytest.raises(CertificationFailure, match="singular"):
        certify_state(model.changed(inertia=inertia), state)


def test_missing_truth_tools_raise_with_an_explanation(monkeypatch):
    monkeypatch.setitem(sys.modules, "flint", None)
    model, state = random_chain(0, [0])
    with pytest.raises(TruthUnavailable, match="truth tools not installed"):
        certify_state(model, state)
    with pytest.raises(ImportError):
        import_truth_tool("flint")
