"""State quantities of mechanisms with a given defect: Newton–Euler equations in double precision, in batches.

A `DefectCase` is B mechanisms of N bodies at one state each; besides the numbers of the model it has for each
body a factor on each velocity term, 1 in an engine without defect, and armature of its joint, then 0.
Independent of `reference_impl`, and fast rather than certified: an equilibrated solve with one
refinement keeps its rounding below the bounds of the comparison.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.linalg import lapack

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import cross, cross_matrix, rotate_vectors, rotation_matrix

MODEL_FIELDS = (
    "mass", "inertia", "proximal", "distal", "length", "gravity", "force", "moment", "drag_force",
    "drag_moment",
)  # fmt: skip
STATE_FIELDS = ("p", "omega", "u", "udot")
HALF_BANDWIDTH = 17  # the nine equations of a body contain its own unknowns and those of both neighbours
MAX_DENSE_UNKNOWNS = 60  # up to here a dense solve of the batch is faster


@dataclass(frozen=True, eq=False)
class DefectCase:
    """B mechanisms, one state each; fields as in `Model` and `State`, with a leading axis B."""

    mass: Array
    inertia: Array
    proximal: Array
    distal: Array
    length: Array
    gravity: Array
    force: Array
    moment: Array
    drag_force: Array
    drag_moment: Array
    p: Array
    omega: Array
    u: Array
    udot: Array
    gyroscopic_factor: Array  # (B, N) factor of ω′ × J ω′ (the notes' 8 L̇ᵀJL̇p)
    proximal_factor: Array  # (B, N) factor of ω × (ω × s) of the lower body in γ
    distal_factor: Array  # (B, N) … of the upper body
    rod_factor: Array  # (B, N) factor of ℓ u̇² in a rod's γ
    armature: Array  # (B, N) kg m², inertia of joint k against the body before, in ball joints only

    @property
    def n(self) -> int:
        """Number of bodies."""
        return int(self.mass.shape[1])

    def model_and_state(self, b: int) -> tuple[Model, State]:
        """Extract one mechanism; factors on velocity terms and armature are dropped.

        Args:
            b: index of the mechanism, 0 … B − 1.

        Returns:
            Its model, and its state with r and v computed from the minimal coordinates.

        """
        model = Model.chain(**{name: getattr(self, name)[b] for name in MODEL_FIELDS})
        r, v = centre_positions_and_velocities(self)
        return model, State(**{name: getattr(self, name)[b] for name in STATE_FIELDS}, r=r[b], v=v[b])


def make_defect_case(model: Model, states: Sequence[State]) -> DefectCase:
    """Put one model at several states into a batch.

    Args:
        model: the mechanism, used for every state.
        states: B states, of which the minimal coordinates are used.

    Returns:
        The batch without defect.

    """
    size = len(states)
    ones = np.ones((size, model.n))
    return DefectCase(
        **{name: np.repeat(getattr(model, name)[None], size, 0) for name in MODEL_FIELDS},
        **{name: np.array([getattr(s, name) for s in states]) for name in STATE_FIELDS},
        gyroscopic_factor=ones, proximal_factor=ones, distal_factor=ones, rod_factor=ones, armature=0 * ones,
    )  # fmt: skip


def concatenate_cases(cases: Sequence[DefectCase]) -> DefectCase:
    """Join batches of mechanisms that have the same number of bodies.

    Returns:
        One batch, in the order of ``cases``.

    """
    names = [f.name for f in fields(DefectCase)]
    return replace(cases[0], **{n: np.concatenate([getattr(c, n) for c in cases]) for n in names})


def select_states(case: DefectCase, states: Sequence[int]) -> DefectCase:
    """Take some mechanisms out of a batch.

    Args:
        states: their indices, 0 … B − 1.

    Returns:
        A batch of those, in the given order.

    """
    return replace(case, **{f.name: getattr(case, f.name)[list(states)] for f in fields(DefectCase)})


def relative_rates(c: DefectCase) -> Array:
    """Return the angular velocity of every body relative to the body before it.

    Returns:
        ω′ − A₂ᵀA₁ω′₁ (B, N, 3), in each body's own frame; of the first body its absolute one.

    """
    return _relative_rates(c, rotation_matrix(c.p))


def _relative_rates(c: DefectCase, a: Array) -> Array:
    return np.asarray(c.omega - _carried_rates(c, a))


def _carried_rates(c: DefectCase, a: Array) -> Array:
    """A₂ᵀA₁ω′₁ (B, N, 3): angular velocity of the body before in each body's frame; 0 for the first."""
    world = rotate_vectors(a, c.omega)
    before = np.concatenate([np.zeros_like(world[:, :1]), world[:, :-1]], axis=1)
    return rotate_vectors(a.mT, before)


def centre_positions_and_velocities(c: DefectCase) -> tuple[Array, Array]:
    """Compute the centres of mass and their velocities from the minimal coordinates.

    Returns:
        r [m] and ṙ [m/s], (B, N, 3) each, world frame.

    """
    return _centre_positions_and_velocities(c, rotation_matrix(c.p))


def _centre_positions_and_velocities(c: DefectCase, a: Array) -> tuple[Array, Array]:
    near, far = rotate_vectors(a, c.proximal), rotate_vectors(a, c.distal)
    near_v, far_v = (rotate_vectors(a, cross(c.omega, s)) for s in (c.proximal, c.distal))
    rod, rod_v = c.length[..., None] * c.u, c.length[..., None] * c.udot
    r = np.cumsum(rod - near + far, axis=1) - far
    return r, np.cumsum(rod_v - near_v + far_v, axis=1) - far_v


def evaluate_case(c: DefectCase) -> dict[str, Array]:
    """Evaluate the state quantities of every mechanism, with its defects.

    Returns:
        The fields of `StateQuantities` by name, units and frames as there: accelerations and joint reactions
        (B, N, 3), energies (B,), angular momentum (B, 3).

    Raises:
        LinAlgError: a mechanism is singular.

    """
    a = rotation_matrix(c.p)
    r, v = _centre_positions_and_velocities(c, a)
    spin = rotate_vectors(c.inertia, c.omega)
    acceleration, angular, reaction = _solve_newton_euler(c, a, v, spin)
    momentum = np.sum(cross(r, c.mass[..., None] * v) + rotate_vectors(a, spin), axis=1)
    return {
        "acceleration": acceleration,
        "angular_acceleration": angular,
        "joint_reaction": reaction,
        "kinetic_energy": 0.5
        * np.sum(
            c.mass * np.sum(v * v, -1)
            + np.sum(c.omega * spin, -1)
            + c.armature * np.sum(_relative_rates(c, a) ** 2, -1),
            axis=1,
        ),
        "potential_energy": -np.sum(c.mass * np.einsum("bki,bi->bk", r, c.gravity), axis=1),
        "angular_momentum": momentum,
    }


def _solve_newton_euler(c: DefectCase, a: Array, v: Array, spin: Array) -> tuple[Array, Array, Array]:
    """r̈ (world), ω̇′ (body), F (world), each (B, N, 3), from the force, moment and joint equations.

    ``a`` (B, N, 3, 3) are rotation matrices, ``v`` velocities of the centres, ``spin`` = J ω′ (B, N, 3).
    """
    size, n = c.mass.shape
    S, b = np.zeros((size, n, 9, n, 9)), np.zeros((size, n, 9))
    eye, near, far, at = np.eye(3), cross_matrix(c.proximal), cross_matrix(c.distal), a.mT
    load = c.force - c.drag_force[..., None] * v
    b[..., :3] = c.mass[..., None] * c.gravity[:, None] + load
    b[..., 3:6] = (
        c.moment - c.drag_moment[..., None] * c.omega
        - c.gyroscopic_factor[..., None] * cross(c.omega, spin)
    )  # fmt: skip
    centripetal = [rotate_vectors(a, cross(c.omega, cross(c.omega, s))) for s in (c.proximal, c.distal)]
    b[..., 6:] = -c.proximal_factor[..., None] * centripetal[0]
    b[:, 1:, 6:] += (c.distal_factor[..., None] * centripetal[1])[:, :-1]
    rod = c.length > 0
    for i in range(n):
        S[:, i, :3, i, :3] = c.mass[:, i, None, None] * eye
        S[:, i, :3, i, 6:] = -eye
        S[:, i, 3:6, i, 3:6] = c.inertia[:, i]
        S[:, i, 3:6, i, 6:] = -near[:, i] @ at[:, i]
        if i + 1 < n:
            S[:, i, :3, i + 1, 6:] = eye
            S[:, i, 3:6, i + 1, 6:] = far[:, i] @ at[:, i]
        S[:, i, 6:, i, :3], S[:, i, 6:, i, 3:6] = eye, -a[:, i] @ near[:, i]
        if i:
            S[:, i, 6:, i - 1, :3], S[:, i, 6:, i - 1, 3:6] = -eye, a[:, i - 1] @ far[:, i - 1]
    if np.any(c.armature):
        _add_armature(c, a, S, b)
    for i in map(int, np.flatnonzero(rod.any(0))):
        held = rod[:, i]
        u, udot = c.u[held, i], c.udot[held, i]
        centripetal_rod = c.rod_factor[held, i] * c.length[held, i] * np.sum(udot * udot, -1)
        rows = np.einsum("bi,bijk->bjk", u, S[held, i, 6:].reshape(-1, 3, n, 9))
        first = cross(u, np.eye(3)[np.argmin(np.abs(u), axis=-1)])
        first /= np.linalg.norm(first, axis=-1, keepdims=True)
        S[held, i, 6:] = 0.0
        S[held, i, 6] = rows
        S[held, i, 7, i, 6:], S[held, i, 8, i, 6:] = first, cross(u, first)
        b[held, i, 6] = np.sum(u * b[held, i, 6:], -1) - centripetal_rod
        b[held, i, 7:] = 0.0
    x = _solve_with_refinement(S.reshape(size, 9 * n, 9 * n), b.reshape(size, 9 * n)).reshape(size, n, 9)
    return x[..., :3], x[..., 3:6], x[..., 6:]


def _add_armature(c: DefectCase, a: Array, S: Array, b: Array) -> None:
    """Add −I ẇ to the moments of each body and its opposite to the body before, w its relative rate.

    ẇ = ω̇′ − R ω̇′₁ + w × R ω′₁ with R = A₂ᵀA₁ (B, 3, 3), from the first body's frame into the second's.
    """
    carried = _carried_rates(c, a)
    bias = cross(c.omega - carried, carried)
    for i in range(c.n):
        inertia = c.armature[:, i, None, None]
        S[:, i, 3:6, i, 3:6] += inertia * np.eye(3)
        b[:, i, 3:6] -= inertia[:, 0] * bias[:, i]
        if i:
            turn = a[:, i].mT @ a[:, i - 1]
            S[:, i, 3:6, i - 1, 3:6] -= inertia * turn
            S[:, i - 1, 3:6, i, 3:6] -= inertia * turn.mT
            S[:, i - 1, 3:6, i - 1, 3:6] += inertia * np.eye(3)
            b[:, i - 1, 3:6] += inertia[:, 0] * rotate_vectors(turn.mT, bias[:, i])


def _solve_with_refinement(S: Array, b: Array) -> Array:
    """Solution x (B, m) of S x = b, rows and columns scaled by powers of two, refined once."""
    row = np.exp2(-np.round(np.log2(np.max(np.abs(S), axis=2))))
    column = np.exp2(-np.round(np.log2(np.max(np.abs(S) * row[..., None], axis=1))))
    scaled, right = S * row[..., None] * column[:, None], b * row
    solve = (
        _banded_solver(scaled)
        if S.shape[1] > MAX_DENSE_UNKNOWNS
        else lambda y: np.linalg.solve(scaled, y[..., None])[..., 0]
    )
    x = solve(right)
    x = x + solve(right - rotate_vectors(scaled, x))
    return np.asarray(column * x)


def _banded_solver(S: Array) -> Callable[[Array], Array]:
    """Return the map from y to the solution x of S x = y, from LU factors of S (B, m, m) within its band."""
    m = S.shape[1]
    i, j = np.indices((m, m)).reshape(2, -1)
    inside = np.abs(i - j) <= HALF_BANDWIDTH
    i, j = i[inside], j[inside]
    factors = []
    for one in S:
        band = np.zeros((3 * HALF_BANDWIDTH + 1, m))
        band[2 * HALF_BANDWIDTH + i - j, j] = one[i, j]
        lu, pivots, singular = lapack.dgbtrf(band, HALF_BANDWIDTH, HALF_BANDWIDTH, overwrite_ab=True)
        if singular:
            raise np.linalg.LinAlgError("Singular matrix")
        factors.append((lu, pivots))

    def solve(y: Array) -> Array:
        parts = zip(factors, y, strict=True)
        return np.array(
            [lapack.dgbtrs(lu, HALF_BANDWIDTH, HALF_BANDWIDTH, one, pivots)[0] for (lu, pivots), one in parts]
        )

    return solve
