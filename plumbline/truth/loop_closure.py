"""A mechanism with loops in ball arithmetic: a proof that its pose is the only one, and what its tree does.

The mechanism is cut open at its closing joints (`plumbline.model.loops`): each carries a part c of its near
body b that coincides with b.  In coordinates z of the tree's joints (angles and shifts; Cayley's three
numbers of a ball joint, seen from the far body; two tangents of a rod)

    F(z) = (r_b − r_c, −vex(A_bᵀ A_c)) = 0.

As many rows are kept as are independent, and as many coordinates depend on the others, whose doubles are
exact.  Krawczyk's operator proves that the dependent ones have exactly one solution near their doubles, and
encloses it:  K(Z) = z − Y F(z) + (1 − Y F_z(Z)) (Z − z) inside Z, Y ≈ F_z⁻¹.  Rates follow likewise, linear.
Of dependent rows the forces that hold b and c together (`Tree.solve_joined`) are one of many: only the
determinate parts of joint wrenches are unique.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from plumbline.equations.arithmetic import balls as ball_arithmetic
from plumbline.equations.arithmetic import entries, midpoints
from plumbline.equations.tree import Solution, Tree
from plumbline.model.datatypes import ZERO_INERTIA, Array, Model, State
from plumbline.model.kinematics import path_to_world
from plumbline.model.loops import CutMechanism, cut_open, independent_rows

UNIQUENESS_RADIUS = 1e-10  # of dependent coordinates [rad, m], in which the pose is the only one
NEWTON_STEPS = 40


class _LoopTree(Tree):
    """A tree at coordinates ``z`` (lists of balls per joint, from the state's doubles) and rates ν.

    ν are relative: tangents of a rod, shifts of a free body, turns about the world's axes, ẋ.
    """

    def __init__(
        self, flint: Any, model: Model, state: State, z: list[list[Any]], nu: list[list[Any]]
    ) -> None:
        self.mat, self.arb, self.z, self.nu = flint.arb_mat, flint.arb, z, nu
        self.chart: dict[int, list[list[Any]]] = {}
        super().__init__(ball_arithmetic(flint), model, state)

    def _above(self, k: int) -> tuple[Any, Any, Any]:
        """Attitude and angular velocity of the far body, and its attitude in doubles."""
        far = self.far[k]
        if far < 0:
            return self.one, self.zero, self.one
        return self.A[far], self.w[far], self.rotation(self.state.p[far])

    def coordinate(self, k: int, i: int) -> tuple[Any, Any]:
        return self.arb(float(self.state.x[k, i])) + self.z[k][i], self.nu[k][i]

    def attitude(self, k: int) -> tuple[Any, Any]:
        above, w, doubles = self._above(k)
        relative = doubles.transpose() * self.rotation(self.state.p[k])
        A = above * relative * self.rotation_of([self.arb(1), *self.z[k][-3:]])
        return A, w + self.mat(3, 1, self.nu[k][-3:])

    def free_point(self, k: int) -> tuple[Any, Any]:
        r, _ = super().free_point(k)
        return r + self.mat(3, 1, self.z[k][:3]), self.mat(3, 1, self.nu[k][:3])

    def rod_direction(self, k: int) -> tuple[Any, Any]:
        above, w, doubles = self._above(k)
        given, _ = super().rod_direction(k)
        sides = _tangents(self, given, k)
        moved = given + sides[0] * self.z[k][0] + sides[1] * self.z[k][1]
        size = 1 / self.num.sqrt(self.num.dot(moved, moved))
        turn = above * doubles.transpose()
        u = turn * moved * size
        tangents = _tangents(self, u, k)
        ways = [turn * side * size for side in sides]  # ∂u/∂z, but for the part along u
        self.chart[k] = [[self.num.dot(t, way) / self.num.dot(t, t) for way in ways] for t in tangents]
        return u, self.num.cross(w, u) + tangents[0] * self.nu[k][0] + tangents[1] * self.nu[k][1]

    def chart_matrix(self) -> Any:
        """The matrix from ż to ν."""
        first = np.cumsum([0, *map(len, self.z)])
        rows = [[self.arb(int(i == j)) for j in range(first[-1])] for i in range(first[-1])]
        for k, kind in enumerate(self.model.kinds):
            blocks = [(int(first[k]), self.chart[k])] if k in self.chart else []
            if kind.has_attitude:
                d = self.mat(3, 1, self.z[k][-3:])
                spin = self.A[k] * (self.one - self.num.cross_matrix(d)) * (2 / (1 + self.num.dot(d, d)))
                blocks.append((int(first[k + 1]) - 3, spin.tolist()))
            for at, block in blocks:
                for i, row in enumerate(block):
                    rows[at + i][at : at + len(row)] = row
        return self.mat(rows)

    def motions(self, k: int) -> tuple[Any, Any]:
        """Velocities of the near point and angular velocities that each of joint k's rates gives."""
        kind, num, zero = self.model.kinds[k], self.num, self.zero
        units = [self.mat(3, 1, [int(i == j) for i in range(3)]) for j in range(3)]
        pairs = [(e, zero) for e in units] if kind.holds_nothing else []
        if kind.holds_distance:
            swing = self.blocks[k][0]
            pairs += [(t * swing.length, zero) for t in _tangents(self, swing.u, k)]
        if kind.has_attitude:
            pairs += [(zero, e) for e in units]
        else:
            moves = [(block.along, block.about) for block in self.blocks[k]]
            pairs += [tuple(zero if e is None else e for e in pair) for pair in moves]
        empty = self.mat(3, 0)
        slides, turns = zip(*pairs, strict=True) if pairs else ((), ())
        return (num.columns(slides), num.columns(turns)) if pairs else (empty, empty)

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
        columns = np.cumsum([0, *map(len, self.z)])
        out = self.mat(6 * len(ends), int(columns[-1]))
        motions: dict[int, tuple[Any, Any]] = {}
        for loop, (b, c) in enumerate(ends):
            R = self.A[b].transpose() * self.A[c]
            turned = self.A[b].transpose()
            if of_gap:
                turned = (self.one * (R[0, 0] + R[1, 1] + R[2, 2]) - R) * self.arb("0.5") * turned
            for body, sign in ((b, 1), (c, -1)):
                for k in path_to_world(self.far, body):
                    motions[k] = slides, turns = motions.get(k) or self.motions(k)
                    lever = self.num.cross_matrix(self.r[k] + self.near[k] - self.r[body])
                    for block, at in ((slides + lever * turns, 6 * loop), (turned * turns, 6 * loop + 3)):
                        for row in range(3):
                            for i in range(block.ncols()):
                                place = at + row, int(columns[k]) + i
                                out[place] = out[place] + sign * block[row, i]
        return out


def _tangents(tree: Tree, u: Any, k: int) -> list[Any]:
    """Two vectors across rod k, of which a small change of u changes little."""
    unit = tree.num.vector(np.eye(3)[int(np.argmin(np.abs(tree.state.u[k])))])
    first = tree.num.cross(u, unit)
    return [first, tree.num.cross(u, first)]


def solve_loop(flint: Any, model: Model, state: State) -> tuple[Tree, Solution, CutMechanism, float]:
    """Enclose the pose, the rates, and the accelerations and wrenches at the working precision.

    Args:
        state: near an assembled state.

    Returns:
        The tree cut open, its loops closed; what it does; how it is cut; and the largest gap of the rows
        that were not kept.

    Raises:
        ZeroDivisionError: no pose was proved to exist and to be unique, or a matrix has no inverse.

    """
    cut = cut_open(model)
    start = cut.state(state)
    given = Tree(ball_arithmetic(flint), cut.model, start)
    sizes = [kind.freedom for kind in cut.model.kinds]  # relative rates
    none = _per_joint([flint.arb(0)] * sum(sizes), sizes)
    here = _LoopTree(flint, cut.model, start, none, none)
    J = here.rates_jacobian(cut.ends, True) * here.chart_matrix()
    doubles = midpoints(J.tolist())
    rows = independent_rows(doubles, cut.row_scale)
    z = _prove_pose(flint, cut, start, sizes, rows, doubles[rows])
    posed = _LoopTree(flint, cut.model, start, z, none)
    J = posed.rates_jacobian(cut.ends, False)
    kept = flint.arb_mat([[J[int(i), j] for j in range(J.ncols())] for i in rows])
    moving = _dependent_columns(cut, midpoints(kept.tolist()), rows, sizes)
    nu = _closed_rates(flint, given, kept, moving)
    c = _LoopTree(flint, cut.model, start, z, _per_joint(nu, sizes))
    c.shifted = shifted_inertia(cut)
    dropped = np.setdiff1d(np.arange(J.nrows()), rows)
    gap, rate = c.gap(cut.ends), entries(J * flint.arb_mat(len(nu), 1, nu))
    widest = max((float(abs(x[int(i)]).upper()) for x in (gap, rate) for i in dropped), default=0.0)
    return c, c.solve_joined(cut.ends, [int(row) for row in rows]), cut, widest


def shifted_inertia(cut: CutMechanism) -> dict[int, float]:
    """Inertia that parts get and their bodies lose: open, the tree may not turn a body without any.

    Since b and c move as one, only the forces between them change.
    """
    inertia, found = cut.model.inertia, dict[int, float]()
    share = 2.0 ** np.round(np.log2(np.max(np.trace(inertia, axis1=1, axis2=2)) or 1.0))
    for b, c in cut.ends:
        principal = np.linalg.eigvalsh(inertia[b])
        if principal[0] <= ZERO_INERTIA * principal[2]:
            found[b] = found.get(b, 0.0) - share
            found[c] = share
    return found


def _per_joint(values: list[Any], sizes: list[int]) -> list[list[Any]]:
    ends = np.cumsum([0, *sizes])
    return [values[ends[k] : ends[k + 1]] for k in range(len(sizes))]


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
    flint: Any, cut: CutMechanism, start: State, sizes: list[int], rows: NDArray[np.intp], kept: Array
) -> list[list[Any]]:
    """Enclose the coordinates of the only pose near the doubles, by rows of J, ``kept`` in doubles."""
    count, dependent = sum(sizes), _dependent_columns(cut, kept, rows, sizes)
    Y = flint.arb_mat([[flint.arb(float(x)) for x in row] for row in np.linalg.inv(kept[:, dependent])])
    none = _per_joint([flint.arb(0)] * count, sizes)

    def placed(values: list[Any]) -> list[list[Any]]:
        z = [flint.arb(0)] * count
        for i, value in zip(dependent, values, strict=True):
            z[int(i)] = value
        return _per_joint(z, sizes)

    def loop_at(values: list[Any]) -> _LoopTree:
        return _LoopTree(flint, cut.model, start, placed(values), none)

    def correction(values: list[Any]) -> list[Any]:
        gap = loop_at(values).gap(cut.ends)
        return entries(Y * flint.arb_mat(len(rows), 1, [gap[int(i)] for i in rows]))

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
        block = flint.arb_mat([[J[int(i), int(j)] for j in dependent] for i in rows])
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
    return placed(contracts(max(4 * max(float(abs(s).upper()) for s in step), target)))


def _closed_rates(flint: Any, given: Tree, kept: Any, dependent: NDArray[np.intp]) -> list[Any]:
    """Rates ν: the independent ones are the state's, the others close the loops."""
    nu = _relative_rates(given)
    for i in dependent:
        nu[int(i)] = flint.arb(0)
    right = kept * flint.arb_mat(len(nu), 1, nu)
    block = flint.arb_mat([[kept[i, int(j)] for j in dependent] for i in range(kept.nrows())])
    for i, value in zip(dependent, entries(block.solve(-right)), strict=True):
        nu[int(i)] = value
    return nu


def _relative_rates(c: Tree) -> list[Any]:
    """The rates ν of a tree's state."""
    num, found = c.num, list[Any]()
    for k, kind in enumerate(c.model.kinds):
        far_w = c.w[c.far[k]] if c.far[k] >= 0 else c.zero
        if kind.holds_distance:
            u, udot = c.rod_direction(k)
            swing = udot - num.cross(far_w, u)
            found += [num.dot(t, swing) / num.dot(t, t) for t in _tangents(c, u, k)]
        if kind.holds_nothing:
            found += entries(c.v[k])
        if kind.has_attitude:
            found += entries(c.w[k] - far_w)
        found += [c.coordinate(k, i)[1] for i in range(len(kind.motions))]
    return found
