"""Rows that are products of two vectors (L1–L3), exactly and off the manifold; the direct form of trees."""

from fractions import Fraction

import numpy as np
import pytest

from plumbline.model.datatypes import KINDS, Model
from plumbline.model.kinematics import maximal_coordinates
from plumbline.model.random_mechanisms import random_tree
from plumbline.model.sampling import random_states
from reference_impl.fast.chain_elimination import StructuredSystem
from reference_impl.joints import constraint_rows
from tests.helpers.random_chains import tree_from_seed

# the rod's row is the notes' own, and an angle is no polynomial
TESTED_KINDS = [name for name, kind in KINDS.items() if kind.rows and not kind.own_number]


def rationals(rng, *shape):
    numbers = [Fraction(int(a), int(b)) for a, b in rng.integers(1, 9, (int(np.prod(shape)), 2)) * [[1, 1]]]
    signs = rng.choice([-1, 1], len(numbers))
    return np.array([int(s) * x for s, x in zip(signs, numbers, strict=True)], object).reshape(shape)


@pytest.mark.parametrize("far", [-1, 0], ids=["on the world", "on a body"])
@pytest.mark.parametrize("kind", TESTED_KINDS)
def test_rates_and_gamma_of_every_row_are_exact(kind, far):
    """Along q + t v every row is a polynomial of degree 4 at most: five points give Ċ and C̈ in rationals."""
    rng = np.random.default_rng([len(kind), far + 1])
    n, none = far + 2, np.zeros(far + 2)
    model = Model(
        mass=none, inertia=none, kind=("free",) * (n - 1) + (kind,),
        body=np.array([[-1, 0], [far, n - 1]][2 - n :]), point=rationals(rng, n, 2, 3),
        turn=rationals(rng, n, 2, 4), length=none, gravity=none, force=none, moment=none,
        drag_force=none, drag_moment=none,
    )  # fmt: skip
    r, p, v, pdot = (rationals(rng, n, size) for size in (3, 4, 3, 4))
    along = [constraint_rows(model, r + t * v, p + t * pdot, v, pdot).C for t in range(-2, 3)]
    first = (along[0] - 8 * along[1] + 8 * along[3] - along[4]) / Fraction(12)
    second = (-along[0] + 16 * along[1] - 30 * along[2] + 16 * along[3] - along[4]) / Fraction(12)
    rows = constraint_rows(model, r, p, v, pdot)
    assert len(first) == len(KINDS[kind].rows)
    assert np.array_equal(first, rows.constraint_rate(v, pdot)) and any(first)
    assert np.array_equal(second, -rows.gamma) and any(second)


@pytest.mark.parametrize("seed", range(10))
def test_states_of_trees_are_on_the_manifold_and_rows_differentiate_off_it(seed):
    rng = np.random.default_rng(seed)
    model = random_tree(rng, 8)
    for state in random_states(model, 2, seed):
        at = maximal_coordinates(state)
        rows = constraint_rows(model, *at)
        speed = max(1.0, np.max(np.abs(state.v)), np.max(np.abs(state.omega)))
        np.testing.assert_allclose(rows.C, 0, atol=1e-14)
        np.testing.assert_allclose(rows.constraint_rate(*at[2:]), 0, atol=1e-14 * speed)

        r, p, v, pdot = (x + 0.2 * rng.normal(size=x.shape) for x in at)
        step = 1e-30
        moved = constraint_rows(model, r + 1j * step * v, p + 1j * step * pdot, v, pdot)
        rows = constraint_rows(model, r, p, v, pdot)
        held = np.array([model.kind[k] != "rod" for k in rows.joint], bool)  # rods: E2, E3
        rate = rows.constraint_rate(v, pdot)
        scale = max(1.0, np.max(np.abs(rows.gamma)))
        np.testing.assert_allclose((moved.C.imag / step)[held], rate[held], atol=1e-13 * scale)
        bend = moved.constraint_rate(v, pdot).imag / step
        np.testing.assert_allclose(bend[held], -rows.gamma[held], atol=1e-13 * scale)


def test_the_structured_form_refuses_trees():
    with pytest.raises(ValueError, match="chains of rods and balls"):
        StructuredSystem([tree_from_seed(0, 3, ("hinge",))])
