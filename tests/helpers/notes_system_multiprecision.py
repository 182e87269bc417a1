"""A second formulation of the truth: the notes' full system S x = b (N5) solved with mpmath at 50 digits.

Euler parameters, p̈ and the normalisation multipliers, dense LU: nothing shared with `certified_state` but the
minimal state.  Costs (9N … 12N)³, so it is a check on small chains.
"""

from __future__ import annotations

from typing import Any

from plumbline.model.datatypes import Model, State
from plumbline.truth import import_truth_tool


def notes_solution(model: Model, state: State, digits: int = 50) -> dict[str, Any]:
    """r̈, ω̇′ and the force on each body at its proximal point: N lists of 3 ``mpf``, SI, usual frames.

    Raises TruthUnavailable without mpmath, ZeroDivisionError where S is singular.
    """
    mp = import_truth_tool("mpmath")
    with mp.workdps(digits):
        return _solve_notes_system(mp, model, state)


def _solve_notes_system(mp: Any, model: Model, state: State) -> dict[str, Any]:
    n, at = model.n, _UnknownLayout(model)
    S, b = mp.zeros(at.size), mp.zeros(at.size, 1)
    p, rods, far, tip_v = [], {}, None, mp.zeros(3, 1)
    for k in range(n):
        q = _column_vector(mp, state.p[k])
        q /= mp.norm(q)
        q_dot = _L(mp, q).T * _column_vector(mp, state.omega[k]) / 2
        u, u_dot = _column_vector(mp, state.u[k]), _column_vector(mp, state.udot[k])
        if model.rods[k]:
            u /= mp.norm(u)
            u_dot -= u * (u.T * u_dot)[0]
        proximal, distal = (_W(mp, q, s) for s in (model.proximal[k], model.distal[k]))
        quad_p, quad_d = (_W(mp, q_dot, s) * q_dot for s in (model.proximal[k], model.distal[k]))
        d, d_dot = u * mp.mpf(float(model.length[k])), u_dot * mp.mpf(float(model.length[k]))
        v = tip_v + d_dot - proximal * q_dot
        tip_v = v + distal * q_dot

        # (N1), (N2), (N4)
        L, L_dot, J = _L(mp, q), _L(mp, q_dot), mp.matrix(model.inertia[k].tolist())
        m, omega = mp.mpf(float(model.mass[k])), _column_vector(mp, state.omega[k])
        moment = _column_vector(mp, model.moment[k]) - omega * float(model.drag_moment[k])
        force = (
            _column_vector(mp, model.force[k])
            - v * float(model.drag_force[k])
            + m * _column_vector(mp, model.gravity)
        )
        _set_block(S, at.r(k), at.r(k), m * mp.eye(3))
        _set_block(S, at.p(k), at.p(k), 4 * L.T * J * L)
        _set_block(S, at.p(k), at.norm(k), 2 * q)
        _set_block(S, at.norm(k), at.p(k), 2 * q.T)
        _set_block(b, at.r(k), 0, force)
        _set_block(b, at.p(k), 0, 8 * L_dot.T * J * L_dot * q + 2 * L.T * moment)
        _set_block(b, at.norm(k), 0, -2 * q_dot.T * q_dot)

        # (N3): a ball is d = 0, a rod dᵀd = ℓ²
        blocks = [(at.r(k), mp.eye(3)), (at.p(k), proximal)]
        gamma = -quad_p
        if far is not None:
            blocks += [(at.r(k - 1), -mp.eye(3)), (at.p(k - 1), -far[0])]
            gamma += far[1]
        if model.rods[k]:
            blocks = [(column, 2 * d.T * block) for column, block in blocks]
            gamma = 2 * d.T * gamma - 2 * d_dot.T * d_dot
            rods[k] = d
        for column, block in blocks:
            _set_block(S, at.joint(k), column, block)
            _set_block(S, column, at.joint(k), block.T)
        _set_block(b, at.joint(k), 0, gamma)
        far = (distal, quad_d)
        p.append(q)

    x = mp.lu_solve(S, b)
    acceleration, angular, reaction = [], [], []
    for k in range(n):
        acceleration.append(list(x[at.r(k) : at.r(k) + 3]))
        p_ddot = x[at.p(k) : at.p(k) + 4]
        angular.append(list(2 * _L(mp, p[k]) * p_ddot))  # L̇ ṗ = 0 (N9)
        lam = x[at.joint(k) : at.joint(k) + (1 if model.rods[k] else 3)]
        reaction.append(list(-2 * lam[0] * rods[k] if model.rods[k] else -lam))
    return {"acceleration": acceleration, "angular_acceleration": angular, "joint_reaction": reaction}


class _UnknownLayout:
    """Where each unknown of (N5) stands: r̈, p̈, λ, λ_E."""

    def __init__(self, model: Model) -> None:
        self.n = model.n
        width = [1 if rod else 3 for rod in model.rods]
        self.joints = [7 * self.n + sum(width[:k]) for k in range(self.n)]
        self.normal = 7 * self.n + sum(width)
        self.size = self.normal + self.n

    def r(self, k: int) -> int:
        return 3 * k

    def p(self, k: int) -> int:
        return 3 * self.n + 4 * k

    def joint(self, k: int) -> int:
        return self.joints[k]

    def norm(self, k: int) -> int:
        return self.normal + k


def _set_block(target: Any, row: int, column: int, block: Any) -> None:
    for i in range(block.rows):
        for j in range(block.cols):
            target[row + i, column + j] = block[i, j]


def _column_vector(mp: Any, v: Any) -> Any:
    return mp.matrix([float(x) for x in v])


def _cross_matrix(mp: Any, e: Any) -> Any:
    return mp.matrix([[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]])


def _LG(mp: Any, p: Any, sign: int) -> Any:
    """[−e, p0 I ∓ ẽ]."""
    e = p[1:4]
    out = mp.zeros(3, 4)
    _set_block(out, 0, 0, -e)
    _set_block(out, 0, 1, p[0] * mp.eye(3) + sign * _cross_matrix(mp, e))
    return out


def _L(mp: Any, p: Any) -> Any:
    return _LG(mp, p, -1)


def _G(mp: Any, p: Any) -> Any:
    return _LG(mp, p, 1)


def _W(mp: Any, p: Any, s: Any) -> Any:
    """∂(A s)/∂p = 2 G(p) B(s) + 2 s pᵀ (N8)."""
    s = _column_vector(mp, s)
    B = mp.zeros(4)
    _set_block(B, 0, 1, -s.T)
    _set_block(B, 1, 0, s)
    _set_block(B, 1, 1, -_cross_matrix(mp, s))
    return 2 * _G(mp, p) * B + 2 * s * p.T
