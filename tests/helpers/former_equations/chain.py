"""The chains' certified quantities as they were before `plumbline.equations`, for comparison.

The Newton–Euler equations are solved for the joint forces: eliminated onto the joints, the system is
symmetric, positive definite and block-tridiagonal, so that a chain costs O(N).  With s̃ the cross-product
matrix, and s and I in world axes, the mobility between two points of a body is

    Y(s, t) = 1/m − s̃ I⁻¹ t̃        (force at t → acceleration at s)

and joint k, with E = 1 for a ball and u for a rod, requires E_kᵀ d̈_k = −ℓ u̇² (rod) or 0 (ball), with the
force F_k = E_k λ_k.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from plumbline.equations.balls import entries, midpoints
from plumbline.model.datatypes import Model, State
from plumbline.truth.certified_state import term_scales
from tests.helpers.former_equations.tree import BallArithmetic


def enclose_chain(flint: Any, model: Model, state: State, mass_matrix: bool) -> dict[str, Any]:
    """Enclose every quantity of a chain on rods and balls at the working precision."""
    return _solve_and_enclose(_BallChain(flint, model, state), mass_matrix)


class _BallChain(BallArithmetic):
    """Model and state in balls: every vector is a 3×1 ``arb_mat`` in world axes; ``J`` is in body axes."""

    def __init__(self, flint: Any, model: Model, state: State) -> None:
        super().__init__(flint, model)
        self.A = [self.rotation(p) for p in state.p]
        self.ell = [self.arb(float(length)) for length in model.length]
        self.w = [a * self.vector(w) for a, w in zip(self.A, state.omega, strict=True)]
        self.sp = [a * self.vector(s) for a, s in zip(self.A, model.proximal, strict=True)]
        self.sd = [a * self.vector(s) for a, s in zip(self.A, model.distal, strict=True)]
        self.I = [a * J * a.transpose() for a, J in zip(self.A, self.J, strict=True)]
        self.I_inverse = [a * J.inv() * a.transpose() for a, J in zip(self.A, self.J, strict=True)]
        self.u, self.udot = [], []
        for k in range(self.n):
            u, udot = self.rod_direction(state, k) if model.rods[k] else (self.zero, self.zero)
            self.u.append(u)
            self.udot.append(udot)
        self.r, self.v = self.positions_and_velocities()

    def positions_and_velocities(self) -> tuple[list[Any], list[Any]]:
        """Centres of mass and their velocities, from the pivot outwards."""
        tip, tip_v, r, v = self.zero, self.zero, [], []
        for k in range(self.n):
            w = self.cross_matrix(self.w[k])
            r.append(tip + self.u[k] * self.ell[k] - self.sp[k])
            v.append(tip_v + self.udot[k] * self.ell[k] - w * self.sp[k])
            tip, tip_v = r[k] + self.sd[k], v[k] + w * self.sd[k]
        return r, v


def _solve_and_enclose(c: _BallChain, mass_matrix: bool) -> dict[str, Any]:
    """All quantities of `enclose_quantities`."""
    free, turn, F = _solve_joint_forces(c)
    acceleration, angular, kinetic, potential, momentum = [], [], c.arb(0), c.arb(0), c.zero
    for k in range(c.n):
        below = F[k + 1] if k + 1 < c.n else c.zero
        acceleration.append(free[k] + (F[k] - below) * (1 / c.m[k]))
        couple = c.cross_matrix(c.sp[k]) * F[k] - c.cross_matrix(c.sd[k]) * below
        angular.append(c.A[k].transpose() * (turn[k] + c.I_inverse[k] * couple))
        spin = c.I[k] * c.w[k]
        kinetic += (c.m[k] * c.dot(c.v[k], c.v[k]) + c.dot(c.w[k], spin)) / 2
        potential -= c.m[k] * c.dot(c.g, c.r[k])
        momentum += c.cross_matrix(c.r[k]) * c.v[k] * c.m[k] + spin
    balls: dict[str, Any] = {
        "acceleration": [entries(a) for a in acceleration],
        "angular_acceleration": [entries(a) for a in angular],
        "joint_reaction": [entries(f) for f in F],
        "kinetic_energy": [kinetic],
        "potential_energy": [potential],
        "angular_momentum": entries(momentum),
        "r": [entries(r) for r in c.r],
        "v": [entries(v) for v in c.v],
        "attitude": [entries(A) for A in c.A],
        "angular_velocity": [entries(A.transpose() * w) for A, w in zip(c.A, c.w, strict=True)],
    }
    if mass_matrix:
        balls["mass_matrix"] = _mass_matrix(c)
    return balls | {"scale": _term_scales(c, balls)}


def _solve_joint_forces(c: _BallChain) -> tuple[list[Any], list[Any], list[Any]]:
    """Accelerations r̈ and A ω̇′ without joint forces, and joint forces F, by block elimination."""
    model, n = c.model, c.n
    free, turn, near, far, Ypp, Ypd, Ydd = [], [], [], [], [], [], []
    for k in range(n):
        force = c.vector(model.force[k]) - c.v[k] * c.arb(float(model.drag_force[k])) + c.g * c.m[k]
        moment = c.A[k] * c.vector(model.moment[k]) - c.w[k] * c.arb(float(model.drag_moment[k]))
        w, sp, sd = c.cross_matrix(c.w[k]), c.cross_matrix(c.sp[k]), c.cross_matrix(c.sd[k])
        free.append(force * (1 / c.m[k]))
        turn.append(c.I_inverse[k] * (moment - w * (c.I[k] * c.w[k])))
        near.append(free[k] - sp * turn[k] + w * (w * c.sp[k]))
        far.append(free[k] - sd * turn[k] + w * (w * c.sd[k]))
        inverse_mass = c.eye * (1 / c.m[k])
        Ypp.append(inverse_mass - sp * c.I_inverse[k] * sp)
        Ypd.append(inverse_mass - sp * c.I_inverse[k] * sd)
        Ydd.append(inverse_mass - sd * c.I_inverse[k] * sd)

    # K λ = e: forward elimination, back-substitution
    E = [c.u[k] if model.rods[k] else c.eye for k in range(n)]
    pivot: list[Any] = []
    rhs: list[Any] = []
    off: list[Any] = []
    for k in range(n):
        D, e = Ypp[k], near[k] * -1
        if k:
            D, e = D + Ydd[k - 1], e + far[k - 1]
        D, e = E[k].transpose() * D * E[k], E[k].transpose() * e
        if model.rods[k]:
            e = e - c.mat(1, 1, [c.ell[k] * c.dot(c.udot[k], c.udot[k])])
        if k:
            off.append((E[k - 1].transpose() * Ypd[k - 1] * E[k]) * -1)
            gain = off[-1].transpose() * pivot[-1]
            D, e = D - gain * off[-1], e - gain * rhs[-1]
        pivot.append(D.inv())
        rhs.append(e)
    F: list[Any] = [None] * n
    multiplier = None
    for k in reversed(range(n)):
        e = rhs[k] if multiplier is None else rhs[k] - off[k] * multiplier
        multiplier = pivot[k] * e
        F[k] = E[k] * multiplier
    return free, turn, F


def _mass_matrix(c: _BallChain) -> list[list[Any]]:
    """M (nu, nu) of `StateQuantities.mass_matrix`, from the velocities Σ T_bi ν_i of the centres b.

    T_bi = c_i is the same for every body below i, so that with μ_j the mass below j, M_ij = c_iᵀ (m_j T_jj +
    μ_j c_j) for i < j.
    """
    rods = [k for k in range(c.n) if c.model.rods[k]]
    mass_below = [sum(c.m[k + 1 :], c.arb(0)) for k in range(c.n)]
    # per column: its body, and the velocities of the centres below it and of its own centre
    columns = []
    for k in rods:
        u_cross = c.cross_matrix(c.u[k])
        swing = u_cross * u_cross * -c.ell[k]
        columns.append((k, swing, swing))
    for k in range(c.n):
        sp, sd = c.cross_matrix(c.sp[k]), c.cross_matrix(c.sd[k])
        columns.append((k, (sp - sd) * c.A[k], sp * c.A[k]))
    size = 3 * len(columns)
    M = [[c.arb(0)] * size for _ in range(size)]
    for i, (bi, below_i, own_i) in enumerate(columns):
        for j, (bj, below_j, own_j) in enumerate(columns):
            if bj < bi:
                continue
            at_j = own_i if bi == bj else below_i
            block = at_j.transpose() * own_j * c.m[bj] + below_i.transpose() * below_j * mass_below[bj]
            if i == j and i >= len(rods):
                block = block + c.J[bi]
            for row in range(3):
                for column in range(3):
                    M[3 * i + row][3 * j + column] = block[row, column]
                    M[3 * j + column][3 * i + row] = block[row, column]
    return M


def _term_scales(c: _BallChain, balls: dict[str, Any]) -> dict[str, float]:
    """Sizes of the terms of each quantity, see `term_scales`."""
    norm, model = np.linalg.norm, c.model
    lever = float(np.sum(norm(model.proximal, axis=1) + norm(model.distal, axis=1) + model.length))
    spins = c.w + [c.cross_matrix(c.u[k]) * c.udot[k] for k in range(c.n)]
    rate = float(np.max(norm(midpoints([entries(w) for w in spins]), axis=1)))
    return term_scales(model, balls, lever, rate)
