"""The loops' certified quantities as they were before `plumbline.equations`, for comparison.

The mechanism is cut open at its closing joints (`plumbline.model.loops`): each carries a massless body c
that coincides with its near body b.  In coordinates z of the tree's joints (angles and shifts; Cayley's three
numbers of a ball joint, seen from the far body; two tangents of a rod)

    F(z) = (r_b − r_c, −vex(A_bᵀ A_c)) = 0.

As many rows are kept as are independent, and as many coordinates depend on the others, whose doubles are
exact.  Krawczyk's operator proves that the dependent ones have exactly one solution near their doubles, and
encloses it:  K(Z) = z − Y F(z) + (1 − Y F_z(Z)) (Z − z) inside Z, Y ≈ F_z⁻¹.  Rates follow likewise, linear.
The loops' forces λ solve, with `tree`'s joint-space equations and J = F_z for the rates ν,

    M ν̇ + h = Jᵀ λ,    J ν̇ = −(a_b − a_c, α_b − α_c) at ν̇ = 0.

Of dependent rows λ is one of many: only the determinate parts of joint wrenches are unique.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plumbline.equations.balls import entries, midpoints
from plumbline.model.datatypes import KINDS, Array, Model, State
from plumbline.model.loops import CutMechanism, cut_open, independent_rows
from tests.helpers.former_equations.tree import (
    BallTree,
    equations_of_motion,
    moving_quantities,
    quantity_scales,
)

UNIQUENESS_RADIUS = 1e-10  # of dependent coordinates [rad, m], in which the pose is the only one
NEWTON_STEPS = 40


class _BallLoop(BallTree):
    """A tree at coordinates ``z`` (lists of balls per joint, from the state's doubles) and rates ν."""

    def __init__(
        self, flint: Any, model: Model, state: State, z: list[list[Any]], nu: list[list[Any]]
    ) -> None:
        self.z, self.nu = z, nu
        self.chart: list[Any] = []
        super().__init__(flint, model, state)

    def _above(self, k: int) -> tuple[Any, Any, Any]:
        """Attitude and angular velocity of the far body, and its attitude in doubles."""
        far = self.far[k]
        if far < 0:
            return self.eye, self.zero, self.eye
        return self.A[far], self.w[far], self.rotation(self.state.p[far])

    def coordinate(self, k: int, i: int) -> tuple[Any, Any]:
        return self.arb(float(self.state.x[k, i])) + self.z[k][i], self.nu[k][i]

    def attitude(self, k: int) -> tuple[Any, Any]:
        above, w, doubles = self._above(k)
        relative = doubles.transpose() * self.rotation(self.state.p[k])
        A = above * relative * self.rotation_of([self.arb(1), *self.z[k][-3:]])
        return A, w + self.mat(3, 1, self.nu[k][-3:])

    def free_point(self, k: int) -> tuple[Any, Any]:
        return self.vector(self.state.r[k]) + self.mat(3, 1, self.z[k][:3]), self.mat(3, 1, self.nu[k][:3])

    def rod(self, k: int) -> tuple[Any, Any]:
        above, w, doubles = self._above(k)
        given = self.vector(self.state.u[k])
        given = given * (1 / self.dot(given, given).sqrt())
        sides = self._sides(given, k)
        moved = given + sides[0] * self.z[k][0] + sides[1] * self.z[k][1]
        size = 1 / self.dot(moved, moved).sqrt()
        turn = above * doubles.transpose()
        u = turn * moved * size
        tangents = self._sides(u, k)
        ways = [turn * side * size for side in sides]  # ∂u/∂z, but for the part along u
        self.chart.append([[self.dot(t, way) / self.dot(t, t) for way in ways] for t in tangents])
        return u, self.cross_matrix(w) * u + tangents[0] * self.nu[k][0] + tangents[1] * self.nu[k][1]

    def _sides(self, u: Any, k: int) -> list[Any]:
        """The tangents that `BallTree` moves a rod along."""
        first = self.cross_matrix(u) * self.units[int(np.argmin(np.abs(self.state.u[k])))]
        return [first, self.cross_matrix(u) * first]

    def chart_matrix(self) -> Any:
        """The matrix from ż to the rates ν that the columns S stand for."""
        sizes = [len(z) for z in self.z]
        first, rods = np.cumsum([0, *sizes]), iter(self.chart)
        rows = [[self.arb(int(i == j)) for j in range(first[-1])] for i in range(first[-1])]
        for k, kind in enumerate(self.model.kind):
            blocks = []
            if kind == "rod":
                blocks.append((int(first[k]), next(rods)))
            if KINDS[kind].has_attitude:
                d = self.mat(3, 1, self.z[k][-3:])
                spin = self.A[k] * (self.eye - self.cross_matrix(d)) * (2 / (1 + self.dot(d, d)))
                blocks.append((int(first[k + 1]) - 3, spin.tolist()))
            for at, block in blocks:
                for i, row in enumerate(block):
                    rows[at + i][at : at + len(row)] = row
        return self.mat(rows)

    def gap(self, ends: tuple[tuple[int, int], ...]) -> list[Any]:
        """F."""
        found: list[Any] = []
        for b, c in ends:
            R = self.A[b].transpose() * self.A[c]
            found += entries(self.r[b] - self.r[c])
            found += [-(R[i, j] - R[j, i]) / 2 for i, j in ((2, 1), (0, 2), (1, 0))]
        return found

    def rates_jacobian(self, ends: tuple[tuple[int, int], ...], of_gap: bool) -> Any:
        """J (6 L, nν): of relative rates, in body axes, or of F where b and c do not coincide yet."""
        columns = np.cumsum([0, *(S.ncols() for S in self.S)])
        rows: list[list[Any]] = [[self.arb(0)] * int(columns[-1]) for _ in range(6 * len(ends))]
        for loop, (b, c) in enumerate(ends):
            R = self.A[b].transpose() * self.A[c]
            turned = self.A[b].transpose()
            if of_gap:
                turned = (self.eye * (R[0, 0] + R[1, 1] + R[2, 2]) - R) * self.arb("0.5") * turned
            for body, sign in ((b, 1), (c, -1)):
                k = body
                while k >= 0:
                    for i in range(self.S[k].ncols()):
                        spin = self.mat(3, 1, [self.S[k][row, i] for row in range(3)])
                        along = self.mat(3, 1, [self.S[k][row, i] for row in range(3, 6)])
                        along = along + self.cross_matrix(spin) * self.r[body]
                        for row, x in enumerate([*entries(along), *entries(turned * spin)]):
                            at = rows[6 * loop + row]
                            at[int(columns[k]) + i] = at[int(columns[k]) + i] + sign * x
                    k = self.far[k]
        return self.mat(rows)


@dataclass(frozen=True, eq=False)
class _Selection:
    """Which rows are kept, and which coordinates they determine."""

    rows: NDArray[np.intp]
    dependent: NDArray[np.intp]
    inverse: NDArray[np.floating[Any]]  # double inverse of the block


def enclose_loop(flint: Any, model: Model, state: State) -> dict[str, Any]:
    """Enclose every quantity of a mechanism with loops at the working precision.

    Args:
        flint: the module python-flint.
        model: the mechanism.
        state: near an assembled state.

    Returns:
        As `plumbline.truth.certified_state.enclose_quantities`; "scale" has besides the largest gap of the
        rows that were not kept.

    Raises:
        ZeroDivisionError: no pose was proved to exist and to be unique, or a matrix has no inverse.

    """
    cut = _with_massless_parts(model)
    start = cut.state(state)
    sizes = [S.ncols() for S in BallTree(flint, cut.model, start).S]
    none = _per_joint([flint.arb(0)] * sum(sizes), sizes)
    here = _BallLoop(flint, cut.model, start, none, none)
    J = here.rates_jacobian(cut.ends, True) * here.chart_matrix()
    chosen = _select(cut, midpoints(J.tolist()), sizes)
    z = _prove_pose(flint, cut, start, sizes, chosen)
    posed = _BallLoop(flint, cut.model, start, z, none)
    J = posed.rates_jacobian(cut.ends, False)
    kept = flint.arb_mat([[J[int(i), j] for j in range(J.ncols())] for i in chosen.rows])
    moving = _dependent_columns(cut, midpoints(kept.tolist()), chosen.rows, sizes)
    nu = _closed_rates(flint, BallTree(flint, cut.model, start), kept, moving)
    c = _BallLoop(flint, cut.model, start, z, _per_joint(nu, sizes))
    balls = _constrained_motion(flint, c, cut, J, chosen.rows)
    dropped = np.setdiff1d(np.arange(J.nrows()), chosen.rows)
    gap, rate = c.gap(cut.ends), entries(J * flint.arb_mat(len(nu), 1, nu))
    of_body = ("acceleration", "angular_acceleration", "r", "v", "attitude", "angular_velocity")
    at = dict.fromkeys(of_body, cut.place[: model.n])
    at |= dict.fromkeys(("joint_reaction", "joint_moment"), cut.place)
    scale = quantity_scales(c, balls)
    scale["gap"] = max((float(abs(x[int(i)]).upper()) for x in (gap, rate) for i in dropped), default=0.0)
    return {
        name: [ball[int(k)] for k in at[name]] if name in at else ball for name, ball in balls.items()
    } | {"scale": scale}


def _with_massless_parts(model: Model) -> CutMechanism:
    """Cut open; bodies keep their whole mass and inertia."""
    cut, bodies = cut_open(model), cut_open(model).place[: model.n]
    whole = {name: np.zeros_like(getattr(cut.model, name)) for name in ("mass", "inertia")}
    for name, values in whole.items():
        values[bodies] = getattr(model, name)
    return replace(cut, model=replace(cut.model, **whole))


def _per_joint(values: list[Any], sizes: list[int]) -> list[list[Any]]:
    ends = np.cumsum([0, *sizes])
    return [values[ends[k] : ends[k + 1]] for k in range(len(sizes))]


def _select(cut: CutMechanism, J: Array, sizes: list[int]) -> _Selection:
    """Choose independent rows, and the coordinates that they determine."""
    rows = independent_rows(J, cut.row_scale)
    dependent = _dependent_columns(cut, J[rows], rows, sizes)
    return _Selection(rows, dependent, np.linalg.inv(J[np.ix_(rows, dependent)]))


def _dependent_columns(
    cut: CutMechanism, kept: Array, rows: NDArray[np.intp], sizes: list[int]
) -> NDArray[np.intp]:
    """Choose what the kept rows of J determine: what closing joints move by, and the best of the others.

    Of coordinates and of rates each: an attitude's coordinates and its rates have different axes, so that a
    choice that is good for one may be singular for the other.
    """
    from scipy.linalg import qr  # a third of the time in which the command starts

    first, block = np.cumsum([0, *sizes]), kept * cut.row_scale[rows, None]
    parts = [i for k in cut.place[cut.source.n :] for i in range(first[k], first[k + 1])]
    others = np.setdiff1d(np.arange(block.shape[1]), parts)
    own, _ = np.linalg.qr(block[:, parts])
    left = block[:, others] - own @ (own.T @ block[:, others])
    _, _, order = qr(left, mode="economic", pivoting=True)
    return np.sort(np.concatenate([parts, others[order[: len(rows) - len(parts)]]])).astype(np.intp)


def _prove_pose(
    flint: Any, cut: CutMechanism, start: State, sizes: list[int], chosen: _Selection
) -> list[list[Any]]:
    """Enclose the coordinates of the only pose near the doubles."""
    count, dependent = sum(sizes), chosen.dependent
    Y = flint.arb_mat([[flint.arb(float(x)) for x in row] for row in chosen.inverse])
    none = _per_joint([flint.arb(0)] * count, sizes)

    def loop_at(values: list[Any]) -> _BallLoop:
        z = [flint.arb(0)] * count
        for i, value in zip(dependent, values, strict=True):
            z[int(i)] = value
        return _BallLoop(flint, cut.model, start, _per_joint(z, sizes), none)

    def correction(values: list[Any]) -> list[Any]:
        gap = loop_at(values).gap(cut.ends)
        return entries(Y * flint.arb_mat(len(chosen.rows), 1, [gap[int(i)] for i in chosen.rows]))

    middle = [flint.arb(0)] * len(dependent)
    target = 2.0 ** (40 - flint.ctx.prec)
    for _ in range(NEWTON_STEPS):
        step = correction(middle)
        middle = [(m - s).mid() for m, s in zip(middle, step, strict=True)]
        if max(float(abs(s).upper()) for s in step) < target:
            break
    step = correction(middle)

    def contracts(radius: float) -> list[Any]:
        """Z of this radius about the doubles or the middle, where K(Z) lies inside Z."""
        box = [m + flint.arb(0, radius) for m in middle]
        there = loop_at(box)
        J = there.rates_jacobian(cut.ends, True) * there.chart_matrix()
        block = flint.arb_mat([[J[int(i), int(j)] for j in dependent] for i in chosen.rows])
        one = flint.arb_mat([[int(i == j) for j in range(len(box))] for i in range(len(box))])
        spread = flint.arb_mat(len(box), 1, [flint.arb(0, radius)] * len(box))
        change = entries((one - Y * block) * spread)
        found = [m - s + x for m, s, x in zip(middle, step, change, strict=True)]
        if not all(bool(abs(f - m) < radius) for f, m in zip(found, middle, strict=True)):
            raise ZeroDivisionError("no pose is proved to be the only one")
        return found

    contracts(UNIQUENESS_RADIUS)
    if not all(bool(abs(m) < UNIQUENESS_RADIUS) for m in middle):
        raise ZeroDivisionError("the doubles are not near the pose")
    values = contracts(max(4 * max(float(abs(s).upper()) for s in step), target))
    z = [flint.arb(0)] * count
    for i, value in zip(dependent, values, strict=True):
        z[int(i)] = value
    return _per_joint(z, sizes)


def _closed_rates(flint: Any, given: BallTree, kept: Any, dependent: NDArray[np.intp]) -> list[Any]:
    """Rates ν: the independent ones are the state's, the others close the loops."""
    nu = _relative_rates(given)
    for i in dependent:
        nu[int(i)] = flint.arb(0)
    right = kept * flint.arb_mat(len(nu), 1, nu)
    block = flint.arb_mat([[kept[i, int(j)] for j in dependent] for i in range(kept.nrows())])
    for i, value in zip(dependent, entries(block.solve(-right)), strict=True):
        nu[int(i)] = value
    return nu


def _relative_rates(c: BallTree) -> list[Any]:
    """The rates ν of a tree's state."""
    found: list[Any] = []
    for k, kind in enumerate(c.model.kind):
        far_w = c.w[c.far[k]] if c.far[k] >= 0 else c.zero
        if kind == "rod":
            u, udot = c.rod(k)
            swing = udot - c.cross_matrix(far_w) * u
            found += [c.dot(t, swing) / c.dot(t, t) for t in c.tangents[k]]
        if kind == "free":
            found += entries(c.v[k])
        if KINDS[kind].has_attitude:
            found += entries(c.w[k] - far_w)
        found += [c.coordinate(k, i)[1] for i in range(len(KINDS[kind].motions))]
    return found


def _constrained_motion(
    flint: Any, c: _BallLoop, cut: CutMechanism, J: Any, rows: NDArray[np.intp]
) -> dict[str, Any]:
    """Solve for ν̇ and λ, and compute all quantities of the tree's bodies."""
    equations = equations_of_motion(c)
    M = equations.M
    bias: list[Any] = []
    for b, part in cut.ends:
        turned = c.A[b].transpose()
        bias += entries(c.bend[b] - c.bend[part]) + entries(turned * (c.twist[b] - c.twist[part]))
    n, m = len(equations.right), len(rows)
    top = [[M[i, j] for j in range(n)] + [-J[int(row), i] for row in rows] for i in range(n)]
    below = [[J[int(row), j] for j in range(n)] + [flint.arb(0)] * m for row in rows]
    right = equations.right + [-bias[int(row)] for row in rows]
    x = entries(flint.arb_mat(top + below).solve(flint.arb_mat(n + m, 1, right)))
    multiplier = [flint.arb(0)] * (6 * len(cut.ends))
    for row, value in zip(rows, x[n:], strict=True):
        multiplier[int(row)] = value
    applied: dict[int, Any] = {}
    for loop, (b, part) in enumerate(cut.ends):
        force = c.mat(3, 1, multiplier[6 * loop : 6 * loop + 3])
        moment = (
            c.A[b] * c.mat(3, 1, multiplier[6 * loop + 3 : 6 * loop + 6]) + c.cross_matrix(c.r[b]) * force
        )
        wrench = c.mat(6, 1, [*entries(moment), *entries(force)])
        for body, on in ((b, wrench), (part, -wrench)):
            applied[body] = applied[body] + on if body in applied else on
    return moving_quantities(c, equations, x[:n], applied)
