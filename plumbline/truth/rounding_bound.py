"""The state-level tolerance: a first-order rounding bound per body and quantity.

An engine that evaluates the Newton–Euler equations of the chain in double precision commits
roundings of a few kinds; each kind is pushed through the inverse of the system and summed:

    tolerance = 64 ε (tB + tS + tJ + d)        ε = 2⁻⁵³

    tB  the terms of each row, rounded once, and the answer itself
    tS  elimination onto the joints: the terms of C M⁻¹ f
    tJ  joint-space engines: the terms of M q̈ + h, as torque pairs at the joints
    d   accumulation of accelerations and forces along the chain

A part for rods held as differences of positions changed no worst ratio in 1,500 random chains (masses over
1e±3, rods of 1e-5 … 1e-2 m, needles, tiny inertias, long levers), so there is none: tJ is above it.  Without
tJ joint-space engines are 1e7 above the rest, without tS maximal coordinates 1e4 (needles).

Every part is homogeneous in each unit, so the bound over its quantity's scale does not change when
lengths, masses or times are measured in other units.  World frame throughout: A ω̇′ has the norm of ω̇′.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import rotation_matrix
from plumbline.model.welding import BodyParts, part_offsets

EPS = 2.0**-53
ROUNDING_FACTOR = 64  # state quantities: worst honest error seen is about a sixth of it (tests/truth/test_rounding_bound.py)
SUM_ROUNDING_FACTOR = 256  # energies and momenta
MAX_RELATIVE_BOUND = 1e-8  # a tolerance above this fraction of its scale could hide a mistake


@dataclass(frozen=True, eq=False)
class RoundingBound:
    """Tolerances for one state; differences of 3-vectors are compared by their Euclidean norm.

    ``scale`` holds, per field, what the tolerance is relative to: max(‖r̈‖, g), the largest moment of the
    body's Euler equation over |J|, max(‖F‖, m g), and the sums of magnitudes behind the scalars.
    """

    acceleration: Array  # (N,) m/s²
    angular_acceleration: Array  # (N,) rad/s²
    joint_reaction: Array  # (N,) N
    kinetic_energy: float  # J
    potential_energy: float  # J
    angular_momentum: float  # kg m²/s, of the norm of the difference
    mass_matrix: float  # kg m², of each entry
    scale: dict[str, Array | float]

    def tolerance(self, quantity: str) -> Array | float:
        """The tolerance of that name: (N,) or a number."""
        return cast("Array | float", getattr(self, quantity))

    def relative_bound(self, quantity: str) -> float:
        """Largest tolerance over its scale; above `BLUNT` a comparison proves little."""
        tolerance, scale = np.asarray(self.tolerance(quantity)), np.asarray(self.scale[quantity])
        return float(np.max(tolerance / np.where(scale > 0, scale, 1.0), initial=0.0, where=scale > 0))

    def describe(self, quantity: str) -> str:
        """One sentence: how the tolerance of that quantity came about."""
        worst = float(np.max(self.tolerance(quantity)))
        if quantity in ("acceleration", "angular_acceleration", "joint_reaction"):
            how = (
                f"{ROUNDING_FACTOR} roundings (2^-53) of the largest terms of the Newton-Euler equations, of their "
                "elimination onto the joints and of the joint-space form, each carried through the inverse"
            )
        else:
            how = f"{SUM_ROUNDING_FACTOR} roundings (2^-53) of the sum of the magnitudes of its terms"
        return f"{how}: at most {worst:.1e}, {self.relative_bound(quantity):.1e} of its scale"


def state_rounding_bound(model: Model, state: State, parts: BodyParts | None = None) -> RoundingBound:
    """Rounding tolerances of every state quantity of ``model`` at ``state`` (SI units, norms).

    ``parts``: of what an engine welds the bodies.  Its terms are those of a piece then: the levers and
    accelerations of one whose centre is c off, longer by ‖c‖ and ‖c‖(‖ω̇‖ + ‖ω‖W), on the mass and least
    inertia of the lightest; and the weld carries the weight and inertia of a piece, with the lever c.

    Needs m > 0 and a positive definite inertia; raises numpy's LinAlgError on a singular system.
    """
    system = _NewtonEulerSystem(model, state)
    body, norm, rods, m = np.arange(model.n), np.linalg.norm, model.rods, model.mass
    sp, sd, omega, a, alpha = system.sp, system.sd, system.omega, system.acceleration, system.alpha
    u, g = state.u, float(norm(model.gravity))
    J, J_min = norm(model.inertia, axis=(1, 2)), np.linalg.eigvalsh(model.inertia)[:, 0]
    load, torque = norm(system.load, axis=1), norm(system.torque, axis=1)

    # ---- sizes of the terms
    nA, nAlpha, nOmega, nF = (norm(x, axis=1) for x in (a, alpha, omega, system.F))
    sp_n, sd_n, rod_rate = norm(sp, axis=1), norm(sd, axis=1), np.where(rods, norm(state.udot, axis=1), 0.0)
    W = np.maximum.accumulate(np.maximum(nOmega, rod_rate))
    arm, light, weld = np.zeros(model.n), m, np.zeros(model.n)
    if parts is not None:
        arm, light = part_offsets(parts), np.array([min(part.mass for part in pieces) for pieces in parts])
        inertias = np.array([[part.inertia for part in pieces] for pieces in parts])
        J_min = np.min(np.linalg.eigvalsh(inertias), axis=(1, 2))
        nA, sp_n, sd_n = nA + arm * (nAlpha + nOmega * W), sp_n + arm, sd_n + arm
        weld = m * (nA + g)
    nF_next, spin = _shift_up(nF), J * nOmega * W
    reach = np.maximum(sp_n * nAlpha, sp_n * nOmega * W)
    hang = np.maximum(nA, np.maximum(sd_n * nAlpha, sd_n * nOmega * W))
    force = np.max([m * nA, m * g, nF, nF_next, load], 0)
    moment = np.max([J * nAlpha, spin, sp_n * nF, sd_n * nF_next, torque, arm * weld], 0)
    joint = np.max([nA, reach, _shift_down(hang), np.where(rods, model.length * rod_rate * W, 0.0)], 0)
    answer = np.stack([np.maximum(nA, g), nAlpha, nF], 1)

    B = system.block_norms()
    tB = _propagate_errors(B, force, moment, joint) + answer

    free = (nF + nF_next + m * g + weld) / light
    turn = (sp_n * nF + sd_n * nF_next + spin + torque) / J_min
    tS = _propagate_errors(B, 0 * m, 0 * m, free + sp_n * turn + _shift_down(free + sd_n * turn))

    # ---- joint space: one joint per ball, two per rod (where it hangs, and its tip)
    of_body = np.concatenate([body[rods], body])  # the body below each joint
    tip = state.r + sp
    at = np.concatenate([(tip - model.length[:, None] * u)[rods], tip])
    below = of_body[:, None] <= body  # (joints, N)
    D = np.where(below, norm(at[:, None] - state.r, axis=2) + arm, 0.0)

    def relative(own: Array, rod: Array) -> Array:
        """Norms (joints,) of what each joint turns by: rods against the body above, bodies against either."""
        above = _shift_down(own)
        turns = np.concatenate([(rod - above)[rods], own - np.where(rods[:, None], rod, above)])
        return np.asarray(norm(turns, axis=1))

    joint_rate, joint_acc = (
        relative(omega, np.cross(u, state.udot)),
        relative(alpha, system.rod_angular_acceleration()),
    )
    mass_scale = (D * m) @ D.T + (below * J) @ below.T
    drive = below @ (J * W**2 + torque) + D @ (m * (g + nA) + load)
    tau = mass_scale @ joint_acc + drive
    tJ = np.einsum("jnq,j->nq", system.torque_pair_responses(), tau)

    swing = D.T @ joint_acc
    carried = m * (nA + swing + g)
    along = np.stack([swing + nA, below.T @ joint_acc, np.cumsum(carried[::-1])[::-1]], 1)

    total = ROUNDING_FACTOR * EPS * (tB + tS + tJ + along)
    rate, speed = below.T @ joint_rate, D.T @ joint_rate
    lever = np.cumsum(sp_n + np.where(rods, model.length, 0.0)) + _shift_down(np.cumsum(sd_n))
    kinetic = float(0.5 * np.sum(m * speed**2 + J * rate**2))
    potential = float(g * np.sum(m * lever))
    momentum = float(np.sum(m * lever * speed + J * rate))
    mass_entry = float(np.max(mass_scale))
    summed = SUM_ROUNDING_FACTOR * EPS
    return RoundingBound(
        acceleration=total[:, 0],
        angular_acceleration=total[:, 1],
        joint_reaction=total[:, 2],
        kinetic_energy=summed * kinetic,
        potential_energy=summed * potential,
        angular_momentum=summed * momentum,
        mass_matrix=summed * mass_entry,
        scale={
            "acceleration": answer[:, 0],
            "angular_acceleration": np.max([nAlpha, moment / J, below.T @ joint_acc], 0),
            "joint_reaction": np.maximum(nF, m * g),
            "kinetic_energy": kinetic,
            "potential_energy": potential,
            "angular_momentum": momentum,
            "mass_matrix": mass_entry,
        },
    )


class _NewtonEulerSystem:
    """The Newton–Euler system of the chain at one state, its inverse and its solution; world axes.

    With x = (r̈, α) per body and F = E λ per joint, E = u for a rod (padded to 3×3) and I for a ball,

        M x − Cᵀ λ = f,    C x = γ,    K = C M⁻¹ Cᵀ

    ``columns`` (N, 3, 3, 9N): r̈, α, F of each body per unit of each row (6N of f, then 3N of γ).
    """

    def __init__(self, model: Model, state: State) -> None:
        n, body, rods = model.n, np.arange(model.n), model.rods
        A = rotation_matrix(state.p)
        inertia = A @ model.inertia @ A.mT
        self.n, self.rods, self.u, self.length = n, rods, state.u, model.length
        self.sp, self.sd = _rotate_vectors(A, model.proximal), _rotate_vectors(A, model.distal)
        self.sd[-1] = 0.0  # nothing hangs there
        self.omega = omega = _rotate_vectors(A, state.omega)
        self.load = model.force - model.drag_force[:, None] * state.v
        self.torque = _rotate_vectors(A, model.moment) - model.drag_moment[:, None] * omega

        E = np.where(rods[:, None, None], state.u[:, :, None] * np.array([1.0, 0.0, 0.0]), np.eye(3))
        C = np.zeros((n, 3, n, 6))
        C[body, :, body, :3], C[body, :, body, 3:] = E.mT, -E.mT @ _cross_matrices(self.sp)
        up, down = body[1:], body[:-1]
        C[up, :, down, :3], C[up, :, down, 3:] = -E[1:].mT, E[1:].mT @ _cross_matrices(self.sd[:-1])
        M_inverse = np.zeros((n, 6, n, 6))
        M_inverse[body, :3, body, :3] = np.eye(3) / model.mass[:, None, None]
        M_inverse[body, 3:, body, 3:] = np.linalg.inv(inertia)
        C_flat, M_flat = C.reshape(3 * n, 6 * n), M_inverse.reshape(6 * n, 6 * n)
        CM = C_flat @ M_flat
        held = np.repeat(~rods, 3).reshape(n, 3) | (np.arange(3) == 0)  # a rod fills one of its three rows
        K = CM @ C_flat.T + np.diag(~held.ravel())
        d = 1 / np.sqrt(np.diag(K))  # equilibrated: units must not decide what a pivot is
        K_inverse = np.linalg.inv(K * d * d[:, None]) * d * d[:, None] * np.outer(held, held)
        X = CM.T @ K_inverse
        x_rows = np.concatenate([M_flat - X @ CM, X], 1).reshape(n, 2, 3, 9 * n)
        F_rows = E @ np.concatenate([-X.T, K_inverse], 1).reshape(n, 3, 9 * n)
        self.inverse_columns = np.concatenate([x_rows, F_rows[:, None]], 1)

        self.centripetal_p, self.centripetal_d = (
            np.cross(omega, np.cross(omega, s)) for s in (self.sp, self.sd)
        )
        gamma = (E.mT @ (_shift_down(self.centripetal_d) - self.centripetal_p)[..., None])[..., 0]
        gamma[:, 0] -= np.where(rods, model.length * np.sum(state.udot**2, -1), 0.0)
        force = model.mass[:, None] * model.gravity + self.load
        moment = self.torque - np.cross(omega, _rotate_vectors(inertia, omega))
        rows = np.concatenate([np.concatenate([force, moment], -1).ravel(), gamma.ravel()])
        self.acceleration, self.alpha, self.F = np.moveaxis(self.inverse_columns @ rows, 1, 0)  # (N, 3) each

    def block_norms(self) -> Array:
        """B (N, 3, N, 3): Frobenius norms of the blocks of the inverse, rows (r̈, α, F), columns (f, n, γ)."""
        n, norm = self.n, np.linalg.norm
        of_x = norm(self.inverse_columns[..., : 6 * n].reshape(n, 3, 3, n, 2, 3), axis=(2, 5))
        of_joint = norm(self.inverse_columns[..., 6 * n :].reshape(n, 3, 3, n, 1, 3), axis=(2, 5))
        return np.concatenate([of_x, of_joint], -1)

    def rod_angular_acceleration(self) -> Array:
        """Angular acceleration (N, 3) of each rod without axial spin, u × d̈/ℓ; 0 for a ball."""
        near = self.acceleration + np.cross(self.alpha, self.sp) + self.centripetal_p
        far = self.acceleration + np.cross(self.alpha, self.sd) + self.centripetal_d
        ell = np.where(self.rods, self.length, np.inf)[:, None]
        return np.cross(self.u, near - _shift_down(far)) / ell

    def torque_pair_responses(self) -> Array:
        """(joints, N, 3): norms of the answers to a unit torque pair at each joint, rods' upper joints first.

        A torque τ on a massless rod is balanced by forces ∓(τ × u)/ℓ at its ends.
        """
        wrench = self.inverse_columns[..., : 6 * self.n].reshape(self.n, 3, 3, self.n, 2, 3)
        force, moment = np.moveaxis(wrench[..., 0, :], 3, 0), np.moveaxis(wrench[..., 1, :], 3, 0)

        def push(k: int, s: Array) -> Array:
            """Answer (N, 3, 3, 3) to a force at a point of body k."""
            return np.asarray(force[k] + moment[k] @ _cross_matrices(s[None])[0])

        upper, lower = [], []
        for k in range(self.n):
            above = moment[k - 1] if k else np.zeros_like(moment[0])
            if not self.rods[k]:
                lower.append(moment[k] - above)
                continue
            ends = push(k, self.sp[k]) - (push(k - 1, self.sd[k - 1]) if k else 0.0)
            through = -ends @ _cross_matrices(self.u[k][None])[0] / self.length[k]  # (τ × u)/ℓ = −ũ τ/ℓ
            upper.append(through - above)
            lower.append(moment[k] - through)
        return np.asarray(np.linalg.norm(np.array(upper + lower), axis=(3, 4)))


def _rotate_vectors(A: Array, s: Array) -> Array:
    """A s per body, (N, 3, 3) and (N, 3)."""
    return (A @ s[..., None])[..., 0]


def _cross_matrices(s: Array) -> Array:
    """s̃ (N, 3, 3): s̃ v = s × v."""
    out = np.zeros((*s.shape, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -s[:, 2], s[:, 1], -s[:, 0]
    return out - out.mT


def _shift_up(v: Array) -> Array:
    """The value of the joint below each body, 0 for the last."""
    return np.concatenate([v[1:], [0.0]])


def _shift_down(v: Array) -> Array:
    """The value, (N,) or (N, 3), of the body above each body, 0 at the pivot."""
    return np.concatenate([np.zeros_like(v[:1]), v[:-1]])


def _propagate_errors(B: Array, force: Array, moment: Array, joint: Array) -> Array:
    """B ρ (N, 3): first-order answer, per body and quantity, to errors of these sizes in the rows."""
    return np.asarray(np.einsum("nqkc,kc->nq", B, np.stack([force, moment, joint], 1)))
