"""The trees' certified quantities as they were before `plumbline.equations`, for comparison.

Composite rigid bodies and recursive Newton–Euler in joint coordinates (`plumbline.truth.certified_tree`),
which loops are still certified by.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from plumbline.model.datatypes import KINDS, Model, State
from plumbline.model.kinematics import own_rates, rate_count
from plumbline.truth.balls import entries
from plumbline.truth.certified_tree import BallTree, equations_of_motion, moving_quantities, quantity_scales


def enclose_tree(flint: Any, model: Model, state: State, mass_matrix: bool) -> dict[str, Any]:
    """Enclose every quantity of a tree at the working precision.

    Args:
        flint: the module python-flint.
        model: the mechanism.
        state: the state, of which the minimal coordinates are used.
        mass_matrix: whether to compute the mass matrix too.

    Returns:
        As `plumbline.truth.certified.enclose_quantities`.

    Raises:
        ZeroDivisionError: the mass matrix is not invertible, at this precision.

    """
    c = BallTree(flint, model, state)
    equations = equations_of_motion(c)
    M, right = equations.M, equations.right
    rates = entries(M.solve(c.mat(len(right), 1, right))) if right else []
    balls = moving_quantities(c, equations, rates)
    if mass_matrix:
        T = _relative_rates(c, equations.first)
        balls["mass_matrix"] = (T.transpose() * M * T).tolist()
    return balls | {"scale": quantity_scales(c, balls)}


def _relative_rates(c: BallTree, first: list[int]) -> Any:
    """The matrix from the rates ν of `StateQuantities.mass_matrix` to the relative ones.

    A ball joint's are A ω′ − ω_far, a rod's besides tᵀ(u̇ − ω_far × u)/tᵀt along its tangents t.
    """
    rows = [[c.arb(0)] * rate_count(c.model) for _ in range(first[-1])]
    spins: list[dict[int, Any]] = []  # of each body: column of ν → its angular velocity, world axes
    rods = np.cumsum(c.model.rods) - 1
    for k, own in enumerate(own_rates(c.model)):
        kind, far = c.model.kind[k], c.far[k]
        above = spins[far] if far >= 0 and kind != "free" else {}
        spin, at = dict(above), first[k]
        if kind == "rod":
            u, _ = c.rod_direction(c.state, k)
            for row, t in enumerate(c.tangents[k]):
                scale = 1 / c.dot(t, t)
                for i in range(3):
                    rows[at + row][3 * int(rods[k]) + i] = t[i, 0] * scale
                for column, w in above.items():
                    rows[at + row][column] = -c.dot(t, c.cross_matrix(w) * u) * scale
            at += 2
        if kind == "free":
            for i in range(3):
                rows[at + i][own.start + i] = c.arb(1)
            at += 3
        if KINDS[kind].has_attitude:
            spin = {}
            for i in range(3):
                spin[own.stop - 3 + i] = w = c.A[k] * c.units[i]
                for row in range(3):
                    rows[at + row][own.stop - 3 + i] = w[row, 0]
            for column, w in above.items():
                for row in range(3):
                    rows[at + row][column] = -w[row, 0]
        else:
            for i in range(c.S[k].ncols()):
                rows[at + i][own.start + i] = c.arb(1)
                spin[own.start + i] = c.mat(3, 1, [c.S[k][row, i] for row in range(3)])
        spins.append(spin)
    return c.mat(rows) if rows else c.mat(0, 0)
