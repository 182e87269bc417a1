"""What an engine with a given defect would say of a state: Newton–Euler in double precision, many at once.

A `Case` is B pendulums of N bodies at one state each; besides the model's numbers it has a factor on
each velocity term, 1 in an engine without defect.  Written apart from `reference_impl`, and fast rather
than certified: its own rounding stays below the bound that answers are compared with (one refinement
of an equilibrated solve).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.linalg import lapack

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import rotation_matrix

MODEL_FIELDS = (
    "mass", "inertia", "proximal", "distal", "length", "gravity", "force", "moment", "drag_force",
    "drag_moment",
)  # fmt: skip
STATE_FIELDS = ("p", "omega", "u", "udot")
HALF_BANDWIDTH = 17  # a body's nine equations have unknowns of its own and of both neighbours
MAX_DENSE_UNKNOWNS = 60  # unknowns up to which a batch is solved faster whole


@dataclass(frozen=True, eq=False)
class DefectCase:
    """B pendulums, one state each; fields as in `Model` and `State` with a leading axis B."""

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
    gyroscopic_factor: Array  # (B,) factor of ω′ × J ω′ (the notes' 8 L̇ᵀJL̇p)
    proximal_factor: Array  # (B,) factor of ω × (ω × s) of the near body in γ
    distal_factor: Array  # (B,) … of the far body
    rod_factor: Array  # (B,) factor of ℓ u̇² in a rod's γ

    @property
    def n(self) -> int:
        """Number of bodies."""
        return int(self.mass.shape[1])

    def model_and_state(self, b: int) -> tuple[Model, State]:
        """Pendulum b as model and lifted state; the factors of the terms stay behind."""
        model = Model(**{name: getattr(self, name)[b] for name in MODEL_FIELDS})
        r, v = centre_positions_and_velocities(self)
        return model, State(**{name: getattr(self, name)[b] for name in STATE_FIELDS}, r=r[b], v=v[b])


def make_defect_case(model: Model, states: Sequence[State]) -> DefectCase:
    """One model at several states, without defect."""
    size = len(states)
    ones = np.ones(size)
    return DefectCase(
        **{name: np.repeat(getattr(model, name)[None], size, 0) for name in MODEL_FIELDS},
        **{name: np.array([getattr(s, name) for s in states]) for name in STATE_FIELDS},
        gyroscopic_factor=ones, proximal_factor=ones, distal_factor=ones, rod_factor=ones,
    )  # fmt: skip


def concatenate_cases(cases: Sequence[DefectCase]) -> DefectCase:
    """All pendulums of several cases of the same size, in order."""
    names = [f.name for f in fields(DefectCase)]
    return replace(cases[0], **{n: np.concatenate([getattr(c, n) for c in cases]) for n in names})


def rotate_vectors(a: Array, s: Array) -> Array:
    """A s per body, (…, 3, 3) and (…, 3)."""
    return np.asarray((a @ s[..., None])[..., 0])


def skew(s: Array) -> Array:
    """s̃ (…, 3, 3)."""
    out = np.zeros((*s.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -s[..., 2], s[..., 1], -s[..., 0]
    return out - out.swapaxes(-1, -2)


def centre_positions_and_velocities(c: DefectCase) -> tuple[Array, Array]:
    """Centres of mass and their velocities (B, N, 3), from the pivot outwards."""
    a = rotation_matrix(c.p)
    near, far = rotate_vectors(a, c.proximal), rotate_vectors(a, c.distal)
    near_v, far_v = (rotate_vectors(a, np.cross(c.omega, s)) for s in (c.proximal, c.distal))
    rod, rod_v = c.length[..., None] * c.u, c.length[..., None] * c.udot

    def chain(first: Array, own: Array, carried: Array) -> Array:
        before = np.cumsum(first - own + carried, axis=1) - (first - own + carried)
        return np.asarray(before + first - own)

    return chain(rod, near, far), chain(rod_v, near_v, far_v)


def evaluate_case(c: DefectCase) -> dict[str, Array]:
    """Accelerations and joint reactions (B, N, 3), energies (B,), angular momentum (B, 3)."""
    r, v = centre_positions_and_velocities(c)
    a = rotation_matrix(c.p)
    spin = rotate_vectors(c.inertia, c.omega)
    acceleration, angular, reaction = solve_newton_euler(c, a, v, spin)
    momentum = np.sum(np.cross(r, c.mass[..., None] * v) + rotate_vectors(a, spin), axis=1)
    return {
        "acceleration": acceleration,
        "angular_acceleration": angular,
        "joint_reaction": reaction,
        "kinetic_energy": 0.5 * np.sum(c.mass * np.sum(v * v, -1) + np.sum(c.omega * spin, -1), axis=1),
        "potential_energy": -np.sum(c.mass * np.einsum("bki,bi->bk", r, c.gravity), axis=1),
        "angular_momentum": momentum,
    }


def solve_newton_euler(c: DefectCase, a: Array, v: Array, spin: Array) -> tuple[Array, Array, Array]:
    """r̈ (world), ω̇′ (body), F (world), each (B, N, 3), of force, moment and joint equations."""
    size, n = c.mass.shape
    S, b = np.zeros((size, n, 9, n, 9)), np.zeros((size, n, 9))
    eye, near, far, at = np.eye(3), skew(c.proximal), skew(c.distal), a.swapaxes(-1, -2)
    load = c.force - c.drag_force[..., None] * v
    b[..., :3] = c.mass[..., None] * c.gravity[:, None] + load
    b[..., 3:6] = (
        c.moment - c.drag_moment[..., None] * c.omega
        - c.gyroscopic_factor[:, None, None] * np.cross(c.omega, spin)
    )  # fmt: skip
    bent = [rotate_vectors(a, np.cross(c.omega, np.cross(c.omega, s))) for s in (c.proximal, c.distal)]
    gamma = -c.proximal_factor[:, None, None] * bent[0]
    gamma[:, 1:] += c.distal_factor[:, None, None] * bent[1][:, :-1]
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
    b[..., 6:] = gamma
    for i in map(int, np.flatnonzero(rod.any(0))):
        held = rod[:, i]
        u, udot = c.u[held, i], c.udot[held, i]
        bend = c.rod_factor[held] * c.length[held, i] * np.sum(udot * udot, -1)
        rows = np.einsum("bi,bijk->bjk", u, S[held, i, 6:].reshape(-1, 3, n, 9))
        first = np.cross(u, np.eye(3)[np.argmin(np.abs(u), axis=-1)])
        first /= np.linalg.norm(first, axis=-1, keepdims=True)
        S[held, i, 6:] = 0.0
        S[held, i, 6] = rows
        S[held, i, 7, i, 6:], S[held, i, 8, i, 6:] = first, np.cross(u, first)
        b[held, i, 6] = np.sum(u * b[held, i, 6:], -1) - bend
        b[held, i, 7:] = 0.0
    x = solve_with_refinement(S.reshape(size, 9 * n, 9 * n), b.reshape(size, 9 * n)).reshape(size, n, 9)
    return x[..., :3], x[..., 3:6], x[..., 6:]


def solve_with_refinement(S: Array, b: Array) -> Array:
    """S x = b, (B, m, m) and (B, m), rows and columns scaled by powers of two, refined once."""
    row = np.exp2(-np.round(np.log2(np.max(np.abs(S), axis=2))))
    column = np.exp2(-np.round(np.log2(np.max(np.abs(S) * row[..., None], axis=1))))
    scaled, right = S * row[..., None] * column[:, None], b * row
    solve = (
        banded_solver(scaled)
        if S.shape[1] > MAX_DENSE_UNKNOWNS
        else lambda y: np.linalg.solve(scaled, y[..., None])[..., 0]
    )
    x = solve(right)
    x = x + solve(right - rotate_vectors(scaled, x))
    return np.asarray(column * x)


def banded_solver(S: Array) -> Callable[[Array], Array]:
    """The solution (B, m) of S x = y for any y, from factors of S (B, m, m) within its band."""
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

    def solve_newton_euler(y: Array) -> Array:
        parts = zip(factors, y, strict=True)
        return np.array(
            [lapack.dgbtrs(lu, HALF_BANDWIDTH, HALF_BANDWIDTH, one, pivots)[0] for (lu, pivots), one in parts]
        )

    return solve_newton_euler
