"""The equations in objects: numbers of mpmath, against balls."""

import flint
import mpmath
import numpy as np
import pytest

from plumbline.equations.arithmetic import balls, objects
from plumbline.equations.tree import Tree
from plumbline.model.datatypes import KINDS
from plumbline.model.random_mechanisms import ELEMENTS
from plumbline.model.sampling import random_states
from tests.helpers.random_chains import tree_from_seed

DIGITS, BITS = 60, 400


@pytest.mark.parametrize("kinds", [("rod", "ball"), tuple(KINDS)], ids=len)
def test_numbers_of_many_digits_lie_in_the_balls(kinds):
    model = tree_from_seed(3, 8, kinds, elements=ELEMENTS)
    (state,) = random_states(model, 1, 2)
    wrench = {3: (np.arange(3.0), np.ones(3)), 5: (np.ones(3), np.arange(3.0))}
    with mpmath.workdps(DIGITS), flint.ctx.workprec(BITS):
        found = []
        for num in (objects(mpmath, mpmath.mpf), balls(flint)):
            tree = Tree(num, model, state)
            wrenches = [{k: tuple(map(num.vector, pair)) for k, pair in wrench.items()}]
            solution = tree.solve(wrenches)
            parts = [*solution.acceleration, *solution.turning, *solution.force, tree.mass_matrix()]
            found.append([x for part in parts for row in part.tolist() for x in row])
        assert len(found[0]) == len(found[1]) > 100
        for number, ball in zip(*found, strict=True):
            middle = mpmath.mpf(ball.mid().str(DIGITS, radius=False))
            assert abs(number - middle) <= 1e-50 * max(1, abs(middle))
