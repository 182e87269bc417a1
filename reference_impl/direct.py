"""S x = b (N1–N5) for N bodies on joints: assembled, solved, and the multipliers as forces (E5).

In a loop rows may depend on others.  Rows are then kept by a pivoted QR of the scaled rows, of C without its
part along p, which the normalisation rows hold; the kept ones determine r̈ and p̈.  λ is determined up to the
null space of these rows' transpose: it is 0 in the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, qr
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from reference_impl.arrays import Array, Bool, Flags, Float, Indices, Int, Motion
from reference_impl.elements import ElementForces, Elements
from reference_impl.euler_parameters import A, L, angular_velocity, dot
from reference_impl.joints import ConstraintRows, constraint_rows, joint_of_rows, of_far_body
from reference_impl.mechanism import Mechanism
from reference_impl.singular_system import SingularSystem

EPS = float(np.finfo(float).eps)
RANK_TOLERANCE = 1e-11  # of scaled rows: below it a row of a loop depends on the others
RUN_RANK_TOLERANCE = 1e-6  # the same along a run, whose drift makes dependent rows look independent


@dataclass(frozen=True, eq=False)
class Solution:
    """The unknowns x of (N5) and what they mean (E5)."""

    acceleration: Float[Array, "bodies 3"]  # m/s², r̈, world frame
    pddot: Float[Array, "bodies 4"]  # 1/s², p̈
    # λ by row of `joint`: N/m for a rod's row, N for a ball's three, a φ̈ for a rotor's at the end
    multiplier: Float[Array, "c"]
    # λ_E: no physical meaning, not comparable across formulations (E2)
    norm_multiplier: Float[Array, "bodies"]
    joint: Int[Indices, "c"]  # the joint of each row
    tension: Float[Array, "joints"]  # N, 2 ℓ λ of the rods, positive in tension; NaN at ball joints
    # N, force on the near body at the near point, world frame: −C_rᵀ λ, with elements
    joint_reaction: Float[Array, "joints 3"]
    joint_moment: Float[Array, "joints 3"]  # N m, moment on that body about that point, world frame
    kept: Bool[Flags, "c"] | None = None  # of loops: False where a row depends on others, left out


class DirectSystem:
    """S x = b of one chain; the sparsity of S is found once, S and b are assembled for every state.

    `assemble` is the specification: S and b dense, blocks and signs as printed in (N5), unknowns in
    the printed order (r̈, p̈, λ, λ_E).  `solve` takes the same entries body by body, in the order
    (λ_k, r̈_k, p̈_k, λ_E,k), where they fill a band of width 10 beside the diagonal whatever N is.
    Rotors' rows and unknowns stand behind λ (`elements`).
    """

    def __init__(self, chain: Mechanism) -> None:
        self.chain = chain
        self.elements = Elements(chain) if chain.has_elements else None
        rotors = self.elements.joint[self.elements.rotors] if self.elements else np.zeros(0, np.intp)
        self.rotor_count = len(rotors)
        self._run_rows: NDArray[np.intp] | None = None
        self._run_independence = 0.0  # the least that the rows of a run may have
        self._checked: tuple[Array, float] = np.zeros(0), 0.0  # rows of a run, and their independence
        n, joint = chain.n, np.concatenate([joint_of_rows(chain), rotors])
        c = len(joint)
        r, p = np.arange(3 * n).reshape(n, 3), 3 * n + np.arange(4 * n).reshape(n, 4)
        row, norm = 7 * n + np.arange(c), 7 * n + c + np.arange(n)
        self.joint, self.size = joint, 8 * n + c
        self._rods = chain.rods
        self._masses = np.repeat(chain.mass, 3)
        self._drag = chain.has_drag
        self._weight = chain.mass[:, None] * chain.gravity + chain.force
        far, near = chain.body[joint].T
        self._far = np.flatnonzero(far >= 0)
        far = far[self._far]
        # Where each block of `_blocks` stands: rows and columns, broadcast against each other.
        places = [
            (r, r),
            (p[:, :, None], p[:, None, :]),
            (row[c - self.rotor_count :],) * 2,
            (row[:, None], r[near]),
            (row[self._far, None], r[far]),
            (row[:, None], p[near]),
            (row[self._far, None], p[far]),
            (norm[:, None], p),
        ]
        i, j = (np.concatenate([np.broadcast_arrays(*x)[side].ravel() for x in places]) for side in (0, 1))
        self._lower = sum(np.broadcast(*x).size for x in places[:3])  # constraint blocks stand in S twice
        self._i, self._j = np.concatenate([i, j[self._lower :]]), np.concatenate([j, i[self._lower :]])

        body = _band_order(chain)
        owner = np.concatenate([np.repeat(body, 3), np.repeat(body, 4), body[near], body])
        kind = np.repeat([1, 2, 0, 3], [3 * n, 4 * n, c, n])
        self._order = np.lexsort((np.arange(self.size), kind, owner))  # position in the band → printed
        place = np.argsort(self._order)
        i, j = place[self._i], place[self._j]
        self._width = int(np.max(np.abs(i - j)))
        self._band = (2 * self._width + i - j, j)
        by_row = np.argsort(i, kind="stable")
        self._row_start = np.searchsorted(i[by_row], np.arange(self.size))
        self._by_row, self._row, self._column = by_row, i[by_row], j[by_row]
        self._unsort = np.argsort(by_row)

    def assemble(
        self, *motion: *Motion
    ) -> tuple[Float[Array, "unknowns unknowns"], Float[Array, "unknowns"]]:
        """Assemble S and b of (N5), on or off the constraints.

        Args:
            motion: r, p, ṙ and ṗ.

        Returns:
            S (m, m) and b (m,), m = 8 N + c, for x = (r̈, p̈, λ, λ_E).

        """
        values, b, *_ = self._entries(motion, None)
        return self._dense(values), b

    def solve(
        self,
        *motion: *Motion,
        gamma_defect: float | Float[Array, "c"] = 0.0,
        x: Float[Array, "bodies 2"] | None = None,
    ) -> Solution:
        """Solve (N5).

        Args:
            motion: r, p, ṙ and ṗ.
            gamma_defect: added to γ, one number or one per row: a planted fault of known growth (E4).
            x: joint coordinates near which angles of springs are taken; absent: principal values.

        Returns:
            r̈, p̈, λ, λ_E and the forces at the joints.

        Raises:
            SingularSystem: S is singular; the message names the body and the cause (E1, E7).

        """
        if self.chain.has_loops:
            found, kept = self._loop_unknowns(motion, gamma_defect, x, is_run=False)
            return replace(self._solution_from_unknowns(motion[1], *found), kept=kept)
        found = self.solve_unknowns(*motion, gamma_defect=gamma_defect, x=x)
        return self._solution_from_unknowns(motion[1], *found)

    def solve_unknowns(
        self,
        *motion: *Motion,
        gamma_defect: float | Float[Array, "c"] = 0.0,
        x: Float[Array, "joints coordinates"] | None = None,
    ) -> tuple[Float[Array, "unknowns"], ConstraintRows, ElementForces | None]:
        """Solve (N5) for its unknowns alone; in loops 0 for multipliers of rows that depend on others.

        S is equilibrated symmetrically by powers of two (its blocks have the units kg, kg m² and m,
        and would otherwise decide the pivots), factored with partial pivoting and refined once.  Measured
        on chains of four, masses over 1e±3: |S x − b| ≤ 1.0 ε (|S||x| + |b|) in every row, where it is up to
        830 ε without the refinement; more passes of equilibration change nothing.

        Args:
            motion: r, p, ṙ and ṗ.
            gamma_defect: added to γ, one number or one per row: a planted fault of known growth (E4).
            x: as for `solve`.

        Returns:
            x (m,) in the printed order, the rows of the constraints and rotors, and what elements there are.

        Raises:
            SingularSystem: S is singular; the message names the body and the cause (E1, E7).

        """
        if self.chain.has_loops:
            return self._loop_unknowns(motion, gamma_defect, x, is_run=True)[0]
        with np.errstate(all="ignore"):  # an overflow raises SingularSystem below
            values, b, joints, elements = self._solvable_entries(motion, gamma_defect, x)

        entries = values[self._by_row]
        scale = power_of_two_scale(np.maximum.reduceat(np.abs(entries), self._row_start))
        entries *= scale[self._row] * scale[self._column]
        band = np.zeros((3 * self._width + 1, self.size))
        band[self._band] = entries[self._unsort]
        lu, pivots, _ = lapack.dgbtrf(band, self._width, self._width, overwrite_ab=True)
        _check_pivots(self.chain, lu[2 * self._width])
        right = b[self._order] * scale
        y, _ = lapack.dgbtrs(lu, self._width, self._width, right, pivots)
        residual = right - np.add.reduceat(entries * y[self._column], self._row_start)
        y += lapack.dgbtrs(lu, self._width, self._width, residual, pivots)[0]
        solution = np.empty(self.size)
        solution[self._order] = y * scale
        return solution, joints, elements

    def solve_with_dense_factors(
        self, *motion: *Motion, x: Float[Array, "joints coordinates"] | None = None
    ) -> Solution:
        """Solve (N5) by dense factors of the assembled S, an independent way to the x of `solve`.

        Args:
            motion: r, p, ṙ and ṗ.
            x: as for `solve`.

        Returns:
            As `solve`.

        """
        values, b, joints, elements = self._entries(motion, x)
        return self._solution_from_unknowns(motion[1], solve_dense(self._dense(values), b), joints, elements)

    def _loop_unknowns(
        self, motion: Motion, gamma_defect: float | Float[Array, "c"], x: Array | None, is_run: bool
    ) -> tuple[tuple[Array, ConstraintRows, ElementForces | None], NDArray[np.bool_]]:
        """As `solve_unknowns`, by dense factors; and which of the rows are kept."""
        n, c, plain = self.chain.n, len(self.joint), len(self.joint) - self.rotor_count
        p = motion[1]
        values, b, joints, elements = self._solvable_entries(motion, gamma_defect, x)
        S = self._dense(values)
        rows = S[7 * n : 7 * n + plain, : 7 * n].copy()
        of_p = rows[:, 3 * n :].reshape(plain, n, 4)
        of_p -= p * (dot(of_p, p) / dot(p, p))[..., None]
        rows *= 1 / np.linalg.norm(rows, axis=1)[:, None]
        used = np.ones(self.size, bool)
        used[7 * n : 7 * n + plain] = False
        kept = self._rows_of_run(rows) if is_run else independent_rows(rows, RANK_TOLERANCE)
        used[7 * n + kept] = True
        unknowns = np.zeros(self.size)
        unknowns[used] = solve_dense(S[np.ix_(used, used)], b[used])
        return (unknowns, joints, elements), used[7 * n : 7 * n + c]

    def _rows_of_run(self, rows: Array) -> NDArray[np.intp]:
        """The rows of a loop that a run keeps, as many as at its start, where it is assembled.

        A step's stages are off the constraints by its error, where dependent rows look independent and other
        rows give other accelerations: they stay the same until they are ten times as near to dependence.
        """
        kept = self._run_rows
        if kept is None or not self._are_independent(rows[kept]):
            chosen = (RUN_RANK_TOLERANCE, None) if kept is None else (0.0, len(kept))
            self._run_rows = kept = independent_rows(rows, *chosen)
            self._checked = rows[kept], _independence(rows[kept])
            self._run_independence = 0.1 * self._checked[1]
        return kept

    def _are_independent(self, rows: Array) -> bool:
        """Whether rows are as independent as those of the run must be."""
        checked, value = self._checked
        # A singular value changes by no more than the norm of the change of the rows (Weyl).
        if value - np.linalg.norm(rows - checked) < self._run_independence:
            value = _independence(rows)
            self._checked = rows, value
        return value >= self._run_independence

    def _dense(self, values: Array) -> Array:
        S = np.zeros((self.size, self.size), values.dtype)
        S[self._i, self._j] = values
        return S

    def _solvable_entries(
        self, motion: Motion, gamma_defect: float | Array, x: Array | None
    ) -> tuple[Array, Array, ConstraintRows, ElementForces | None]:
        """`_entries` with γ changed, of a state at which they are finite and no rod or p vanishes."""
        values, b, joints, elements = self._entries(motion, x)
        b[7 * self.chain.n :][: len(self.joint)] += gamma_defect
        check_state_solvable(self.chain, *motion[:2], joints.d, self._rods, (values, b, motion[2]))
        return values, b, joints, elements

    def _entries(
        self, motion: Motion, x: Float[Array, "joints coordinates"] | None
    ) -> tuple[Array, Array, ConstraintRows, ElementForces | None]:
        """The entries of S in the order of `_i`, `_j`, then b, and the rows and elements they come from."""
        chain, elements, rotors = self.chain, None, np.zeros(0)
        _, p, v, pdot = motion
        joints = constraint_rows(chain, *motion)
        if self.elements:
            elements = self.elements.evaluate(*motion, x=x)
            rotors = self.elements.armature[self.elements.rotors]
            joints = self.elements.with_rotors(joints, elements)
        L_, L_rate = L(p), L(pdot)
        JL = chain.inertia @ L_
        blocks = (
            self._masses,  # M
            4 * (L_.swapaxes(-1, -2) @ JL),  # 4 LᵀJL
            -1 / rotors,
            joints.r_near,  # C_r
            -joints.r_near[self._far],
            joints.p_near,  # C_p
            joints.p_far[self._far],
            2 * p,  # C_E,p
        )
        values = np.concatenate([np.ravel(block) for block in blocks])
        force, moment = self._weight, chain.moment
        if self._drag:
            force = force - chain.drag_force[:, None] * v
            moment = moment - chain.drag_moment[:, None] * angular_velocity(p, pdot)
        quadratic = chain.inertia @ (L_rate @ p[..., None])
        p_force = 8 * (L_rate.swapaxes(-1, -2) @ quadratic) + 2 * (L_.swapaxes(-1, -2) @ moment[..., None])
        if elements:
            force, p_force = force + elements.force, p_force + elements.p_force[..., None]
        b = np.concatenate([force.ravel(), p_force.ravel(), joints.gamma, -2 * dot(pdot, pdot)])
        return np.concatenate([values, values[self._lower :]]), b, joints, elements

    def _solution_from_unknowns(
        self, p: Array, x: Array, joints: ConstraintRows, elements: ElementForces | None
    ) -> Solution:
        """The parts of x, and λ as forces."""
        n, c = self.chain.n, len(self.joint)
        multiplier = x[7 * n : 7 * n + c]
        return Solution(
            acceleration=x[: 3 * n].reshape(n, 3),
            pddot=x[3 * n : 7 * n].reshape(n, 4),
            multiplier=multiplier,
            norm_multiplier=x[7 * n + c :],
            joint=self.joint,
            **joint_forces(self.chain, p, joints, multiplier, elements),
        )


def joint_forces(
    mechanism: Mechanism,
    p: Float[Array, "bodies 4"],
    rows: ConstraintRows,
    multiplier: Float[Array, "c"],
    elements: ElementForces | None = None,
) -> dict[str, Any]:
    """Compute what the rows and the elements of the joints do to the near bodies.

    A ½ L Q_p is the moment about the centre of mass; L p = 0 takes the normalisation's share out (E2).

    Returns:
        The fields ``tension``, ``joint_reaction`` and ``joint_moment`` of `Solution`.

    """
    force, of_p = np.zeros((len(mechanism.kind), 3)), np.zeros((len(mechanism.kind), 4))
    np.subtract.at(force, rows.joint, multiplier[:, None] * rows.r_near)
    np.subtract.at(of_p, rows.joint, multiplier[:, None] * rows.p_near)
    if elements:
        np.add.at(force, elements.joint, elements.torque[:, None] * elements.r_near)
        np.add.at(of_p, elements.joint, elements.torque[:, None] * elements.p_near)
    tension, rod = np.full(len(mechanism.kind), np.nan), mechanism.rods
    tension[rod] = 2 * mechanism.length[rod] * multiplier[rod[rows.joint]]
    p = p[mechanism.body[:, 1]]
    turn = A(p)
    near = (turn @ mechanism.point[:, 1, :, None])[..., 0]
    about_centre = (turn @ (L(p) @ of_p[..., None]))[..., 0] / 2
    moment = np.asarray(about_centre - np.cross(near, force))
    return {"tension": tension, "joint_reaction": force, "joint_moment": moment}


def _band_order(chain: Mechanism) -> NDArray[np.intp]:
    """Places (N,) of the bodies and their joints in the band: near each other where joined."""
    far, near = chain.body[chain.body[:, 0] >= 0].T
    order = reverse_cuthill_mckee(csr_array((np.ones(len(far)), (far, near)), (chain.n, chain.n)))

    def width(place: NDArray[np.intp]) -> int:  # about; rows stand before their near bodies
        distance = place[near] - place[far]
        return int(np.max(np.where(distance > 0, 2 * distance, 1 - 2 * distance), initial=0))

    return min(np.argsort(order), np.arange(chain.n), key=width)


def independent_rows(
    rows: Float[Array, "c m"], tolerance: float, count: int | None = None
) -> Int[Indices, "kept"]:
    """Find rows that do not depend on others, by a pivoted QR; of rows that do equally well the first.

    Without that order rounding would choose among them, another set from step to step of a run.

    Args:
        rows: of any scale.
        tolerance: part of the largest pivot below which a row depends on others.
        count: how many at most.

    Returns:
        Their numbers, in order.

    Raises:
        SingularSystem: a row is not finite.

    """
    if not np.isfinite(rows).all():
        raise SingularSystem("the rows of a loop are not finite")
    factor = np.linspace(1.0, 0.5, len(rows)) / np.linalg.norm(rows, axis=1)
    _, triangle, order = qr((rows * factor[:, None]).T, mode="economic", pivoting=True)
    size = np.abs(np.diagonal(triangle))
    return np.sort(order[: int(np.sum(size > tolerance * size[0]))][:count])


def _independence(rows: Array) -> float:
    """The smallest singular value of scaled rows."""
    return float(np.linalg.svd(rows, compute_uv=False)[-1])


def solve_dense(S: Float[Array, "m m"], b: Float[Array, "m"]) -> Float[Array, "m"]:
    """Solve S x = b by dense factors, equilibrated and refined once like `DirectSystem.solve_unknowns`.

    Raises:
        SingularSystem: S is singular to rounding.

    """
    scale = power_of_two_scale(np.max(np.abs(S), axis=1))
    S = S * scale[:, None] * scale
    lu, pivots, _ = lapack.dgetrf(S)
    if is_singular(np.diagonal(lu)):
        raise SingularSystem("S is singular to rounding")
    x, _ = lapack.dgetrs(lu, pivots, b * scale)
    x += lapack.dgetrs(lu, pivots, b * scale - S @ x)[0]
    return np.asarray(x * scale)


def power_of_two_scale(largest: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the powers of two nearest below 1/√largest; scaling by them rounds nothing.

    Args:
        largest: largest magnitude in each row.

    Returns:
        ; 1 where ``largest`` is 0.

    """
    return np.where(largest > 0, np.ldexp(1.0, -(np.frexp(largest)[1] // 2)), 1.0)


def is_singular(pivots: Float[Array, "m"]) -> bool:
    """Return whether an equilibrated matrix is singular to rounding.

    Args:
        pivots: diagonal of its triangular factor.

    Returns:
        True where the smallest is within m ε of the largest.

    """
    size = np.abs(pivots)
    return not bool(np.min(size) > len(size) * EPS * np.max(size))


def check_state_solvable(
    chain: Mechanism,
    r: Float[Array, "bodies 3"],
    p: Float[Array, "bodies 4"],
    d: Float[Array, "joints 3"],
    rods: Bool[Flags, "joints"],
    entries: tuple[Float[Array, "..."], ...],
) -> None:
    """Check that the state alone does not make S singular (E1, E7).

    Args:
        r: positions [m], world frame.
        d: vectors along the rods [m].  One below its own rounding (16 ε of the vectors that it is the
            sum of) counts as zero, because a row made of it would be noise.
        rods: True where joint k is a rod.
        entries: arrays that must be finite: entries of S and b, and ṙ.

    Raises:
        SingularSystem: with the cause and the body.

    """
    if not np.isfinite(sum(x.sum() for x in (*entries, d))):  # a sum is finite only where its terms are
        bad = ~(np.isfinite(r).all(-1) & np.isfinite(p).all(-1))
        where = f"the position of body {int(np.argmax(bad)) + 1}" if bad.any() else "a rate or a load"
        raise SingularSystem(f"{where} is not finite, so S x = b has no meaning")
    norms = dot(p, p)
    if not norms.all():
        body = int(np.argmin(norms)) + 1
        raise SingularSystem(f"p of body {body} is 0: 4 LᵀJL and the normalisation row vanish with it (E7)")
    if not rods.any():
        return
    spans = [r[chain.body[:, 1]], of_far_body(r, chain.body[:, 0]), chain.point[:, 1], chain.point[:, 0]]
    rounding = 16 * EPS * np.max(np.abs(spans), axis=(0, 2))
    collapsed = rods & (np.sqrt(dot(d, d)) <= rounding)
    if collapsed.any():
        body = int(np.argmax(collapsed)) + 1
        raise SingularSystem(
            f"the rod above body {body} has length 0: at d = 0 C = dᵀd has no gradient, C_r is 0 and C_p "
            "at most a multiple of the normalisation row pᵀ (E1, E2); a joint of length 0 is a ball, d = 0"
        )


def _check_pivots(chain: Mechanism, pivots: Array) -> None:
    """Raise SingularSystem with the likeliest cause where the factored S is singular to rounding."""
    if not is_singular(pivots):
        return
    if np.any(chain.mass <= 0):
        raise SingularSystem(f"the mass of body {int(np.argmin(chain.mass)) + 1} is {np.min(chain.mass)} kg")
    principal = np.linalg.eigvalsh(chain.inertia)
    flat = principal[:, 0] <= chain.n * EPS * principal[:, 2]
    if flat.any():
        body = int(np.argmax(flat))
        raise SingularSystem(
            f"the inertia of body {body + 1} is singular, principal values {principal[body].tolist()} kg m², "
            "so 4 LᵀJL has rank 2 or less (E7)"
        )
    raise SingularSystem("the joint rows are not independent at this state: S is singular to rounding")
