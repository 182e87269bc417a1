"""The state-level tolerance: a first-order rounding bound per body and quantity.

An engine that evaluates the Newton–Euler equations of the chain in double precision commits
roundings of a few kinds; each kind is pushed through the inverse of the system and summed:

    tolerance = 64 ε (tB + tX + tS + tJ + d)        ε = 2⁻⁵³

    tB  the terms of each row, rounded once, and the answer itself
    tX  rods held as positions and velocities: their direction is a small difference of large r
    tS  elimination onto the joints: the terms of C M⁻¹ f
    tJ  joint-space engines: the terms of M q̈ + h, as torque pairs at the joints
    d   accumulation of accelerations and forces along the chain

Every part is homogeneous in each unit, so the bound over its quantity's scale does not change when
lengths, masses or times are measured in other units.  World frame throughout: A ω̇′ has the norm of ω̇′.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from plumbline.kinematics import rotation
from plumbline.records import Array, Model, State

EPS = 2.0**-53
ROUNDINGS = 64  # state quantities: worst honest error seen is about a sixth of it (tests/test_bound.py)
SUMMANDS = 256  # energies and momenta
BLUNT = 1e-8  # a tolerance above this fraction of its scale could hide a mistake


@dataclass(frozen=True, eq=False)
class Bound:
    """Tolerances for one state; differences of 3-vectors are compared by their Euclidean norm.

    ``scale`` holds, per field, what the tolerance is relative to: max(‖r̈‖, g), max(‖ω̇‖, the joints'
    angular accelerations), max(‖F‖, m g), and the sums of magnitudes behind the scalars.
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

    def bluntness(self, quantity: str) -> float:
        """Largest tolerance over its scale; above `BLUNT` a comparison proves little."""
        tolerance, scale = np.asarray(self.tolerance(quantity)), np.asarray(self.scale[quantity])
        return float(np.max(tolerance / np.where(scale > 0, scale, 1.0), initial=0.0, where=scale > 0))

    def explain(self, quantity: str) -> str:
        """One sentence: how the tolerance of that quantity came about."""
        worst = float(np.max(self.tolerance(quantity)))
        if quantity in ("acceleration", "angular_acceleration", "joint_reaction"):
            how = (
                f"{ROUNDINGS} roundings (2^-53) of the largest terms of the Newton-Euler equations, of their "
                "elimination onto the joints and of the joint-space form, each carried through the inverse"
            )
        else:
            how = f"{SUMMANDS} roundings (2^-53) of the sum of the magnitudes of its terms"
        return f"{how}: at most {worst:.1e}, {self.bluntness(quantity):.1e} of its scale"


def state_bound(model: Model, state: State) -> Bound:
    """Rounding tolerances of every state quantity of ``model`` at ``state`` (SI units, norms).

    Needs m > 0 and a positive definite inertia; raises numpy's LinAlgError on a singular system.
    """
    n = model.n
    body, norm = np.arange(n), np.linalg.norm
    A = rotation(state.p)
    inertia = A @ model.inertia @ A.mT  # (N, 3, 3) world axes
    sp, sd = _turn(A, model.proximal), _turn(A, model.distal)
    sd[-1] = 0.0  # nothing hangs there
    omega, u, udot = _turn(A, state.omega), state.u, state.udot
    g = float(norm(model.gravity))
    load = model.force - model.drag_force[:, None] * state.v
    torque = _turn(A, model.moment) - model.drag_moment[:, None] * omega
    J, J_min = norm(model.inertia, axis=(1, 2)), np.linalg.eigvalsh(model.inertia)[:, 0]
    rods, m = model.rods, model.mass
    ell = np.where(rods, model.length, np.inf)

    # ---- S_r: M x − Cᵀ λ = f, C x = γ, x = (r̈, α), F = E λ with E = u for a rod, I for a ball
    E = np.where(rods[:, None, None], u[:, :, None] * np.array([1.0, 0.0, 0.0]), np.eye(3))
    C = np.zeros((n, 3, n, 6))
    C[body, :, body, :3], C[body, :, body, 3:] = E.mT, -E.mT @ _cross(sp)
    C[body[1:], :, body[:-1], :3], C[body[1:], :, body[:-1], 3:] = -E[1:].mT, E[1:].mT @ _cross(sd[:-1])
    M_inverse = np.zeros((n, 6, n, 6))
    M_inverse[body, :3, body, :3] = np.eye(3) / m[:, None, None]
    M_inverse[body, 3:, body, 3:] = np.linalg.inv(inertia)
    C_flat, M_flat = C.reshape(3 * n, 6 * n), M_inverse.reshape(6 * n, 6 * n)
    CM = C_flat @ M_flat
    held = np.repeat(~rods, 3).reshape(n, 3) | (np.arange(3) == 0)  # a rod fills one of its three rows
    K = CM @ C_flat.T + np.diag(~held.ravel())
    d = 1 / np.sqrt(np.diag(K))
    K_inverse = np.linalg.inv(K * d * d[:, None]) * d * d[:, None] * np.outer(held, held)
    X = CM.T @ K_inverse  # (6N, 3N): x per joint row
    S_inverse = np.block([[M_flat - X @ CM, X], [-X.T, K_inverse]])  # rows (r̈, α)…, λ…
    S_inverse = np.concatenate(
        [_rows(S_inverse[: 6 * n], 2), _rows(S_inverse[6 * n :], 1)], 1
    )  # (N, 3, 3, 9N)
    S_inverse[:, 2] = E @ S_inverse[:, 2]  # λ → F
    columns = S_inverse.reshape(n, 3, 3, 9 * n)
    by_x = columns[..., : 6 * n].reshape(n, 3, 3, n, 2, 3)
    B = np.concatenate(
        [norm(by_x, axis=(2, 5)), norm(columns[..., 6 * n :].reshape(n, 3, 3, n, 1, 3), axis=(2, 5))], -1
    )

    centripetal_p, centripetal_d = (np.cross(omega, np.cross(omega, s)) for s in (sp, sd))
    gamma = -centripetal_p
    gamma[1:] += centripetal_d[:-1]
    gamma = (E.mT @ gamma[..., None])[..., 0]
    gamma[:, 0] -= np.where(rods, model.length * np.sum(udot**2, -1), 0.0)
    f = np.concatenate(
        [m[:, None] * model.gravity + load, torque - np.cross(omega, _turn(inertia, omega))], -1
    )
    x, F = _solve(columns, f, gamma)
    a, alpha = x[:, 0], x[:, 1]

    # ---- sizes of the terms
    nA, nF, nAlpha, nOmega = norm(a, axis=1), norm(F, axis=1), norm(alpha, axis=1), norm(omega, axis=1)
    sp_n, sd_n, rod_rate = norm(sp, axis=1), norm(sd, axis=1), np.where(rods, norm(udot, axis=1), 0.0)
    W = np.maximum.accumulate(np.maximum(nOmega, rod_rate))
    nF_next, spin = _next(nF), J * nOmega * W
    reach = np.maximum(sp_n * nAlpha, sp_n * nOmega * W)
    hang = np.maximum(nA, np.maximum(sd_n * nAlpha, sd_n * nOmega * W))
    force = np.max([m * nA, m * g, nF, nF_next, norm(load, axis=1)], 0)
    moment = np.max([J * nAlpha, spin, sp_n * nF, sd_n * nF_next, norm(torque, axis=1)], 0)
    joint = np.max([nA, reach, _previous(hang), np.where(rods, model.length * rod_rate * W, 0.0)], 0)
    answer = np.stack([np.maximum(nA, g), nAlpha, nF], 1)

    tB = _through(B, force, moment, joint) + answer

    # rods: u = d/ℓ where d is a difference of positions of size R, its rate one of velocities of size V
    tip, tip_v = state.r + sp, state.v + np.cross(omega, sp)
    R = np.max([norm(tip, axis=1), norm(state.r, axis=1), _previous(norm(state.r, axis=1))], 0) / ell
    V = np.max([norm(tip_v, axis=1), norm(state.v, axis=1), _previous(norm(state.v, axis=1))], 0)
    FR, FR_next = nF * R, _next(nF * R)
    tX = _through(B, np.maximum(FR, FR_next), np.maximum(sp_n * FR, sd_n * FR_next), joint * R + rod_rate * V)
    tX[:, 2] += FR

    free = (nF + nF_next + m * g) / m
    turn = (sp_n * nF + sd_n * nF_next + spin + norm(torque, axis=1)) / J_min
    tS = _through(B, 0 * m, 0 * m, free + sp_n * turn + _previous(free + sd_n * turn))

    # ---- joint space: one joint per ball, two per rod (where it hangs, and its tip)
    of_body = np.concatenate([body[rods], body])  # the body below each joint
    at = np.concatenate([(tip - model.length[:, None] * u)[rods], tip])
    below = of_body[:, None] <= body  # (joints, N)
    D = np.where(below, norm(at[:, None] - state.r, axis=2), 0.0)
    rod_omega, d_dot2 = np.cross(u, udot), _joint_acceleration(a, alpha, sp, sd, centripetal_p, centripetal_d)
    rod_alpha = np.cross(u, d_dot2) / ell[:, None]
    joint_rate = norm(
        np.concatenate(
            [
                (rod_omega - _previous(omega))[rods],
                omega - np.where(rods[:, None], rod_omega, _previous(omega)),
            ]
        ),
        axis=1,
    )
    joint_acc = norm(
        np.concatenate(
            [
                (rod_alpha - _previous(alpha))[rods],
                alpha - np.where(rods[:, None], rod_alpha, _previous(alpha)),
            ]
        ),
        axis=1,
    )
    mass_scale = (D * m) @ D.T + (below * J) @ below.T
    drive = below @ (J * W**2 + norm(torque, axis=1)) + D @ (m * (g + nA) + norm(load, axis=1))
    tau = mass_scale @ joint_acc + drive
    pairs = _torque_pairs(columns, rods, u, ell, sp, sd)  # (joints, N, 3)
    tJ = np.einsum("jnq,j->nq", pairs, tau)

    swing = D.T @ joint_acc
    carried = m * (nA + swing + g)
    along = np.stack([swing + nA, below.T @ joint_acc, np.cumsum(carried[::-1])[::-1]], 1)

    total = ROUNDINGS * EPS * (tB + tX + tS + tJ + along)
    rate, speed = below.T @ joint_rate, D.T @ joint_rate
    lever = np.cumsum(sp_n + np.where(rods, model.length, 0.0)) + _previous(np.cumsum(sd_n))
    kinetic = float(0.5 * np.sum(m * speed**2 + J * rate**2))
    potential = float(g * np.sum(m * lever))
    momentum = float(np.sum(m * lever * speed + J * rate))
    mass_entry = float(np.max(mass_scale))
    summed = SUMMANDS * EPS
    return Bound(
        acceleration=total[:, 0],
        angular_acceleration=total[:, 1],
        joint_reaction=total[:, 2],
        kinetic_energy=summed * kinetic,
        potential_energy=summed * potential,
        angular_momentum=summed * momentum,
        mass_matrix=summed * mass_entry,
        scale={
            "acceleration": answer[:, 0],
            "angular_acceleration": np.maximum(nAlpha, below.T @ joint_acc),
            "joint_reaction": np.maximum(nF, m * g),
            "kinetic_energy": kinetic,
            "potential_energy": potential,
            "angular_momentum": momentum,
            "mass_matrix": mass_entry,
        },
    )


def _turn(A: Array, s: Array) -> Array:
    """A s per body, (N, 3, 3) and (N, 3)."""
    return (A @ s[..., None])[..., 0]


def _cross(s: Array) -> Array:
    """s̃ (N, 3, 3): s̃ v = s × v."""
    out = np.zeros((*s.shape, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -s[:, 2], s[:, 1], -s[:, 0]
    return out - out.mT


def _next(v: Array) -> Array:
    """The value of the joint below each body, 0 for the last."""
    return np.concatenate([v[1:], [0.0]])


def _previous(v: Array) -> Array:
    """The value, (N,) or (N, 3), of the body above each body, 0 at the pivot."""
    return np.concatenate([np.zeros_like(v[:1]), v[:-1]])


def _rows(block: Array, kinds: int) -> Array:
    """(3·kinds·N, c) → (N, kinds, 3, c)."""
    return block.reshape(-1, kinds, 3, block.shape[1])


def _through(B: Array, force: Array, moment: Array, joint: Array) -> Array:
    """B ρ (N, 3): first-order answer, per body and quantity, to errors of these sizes in the rows."""
    n = len(force)
    rho = np.stack([force, moment, joint], 1)
    return np.asarray(B.reshape(3 * n, 3 * n) @ rho.ravel()).reshape(n, 3)


def _solve(columns: Array, f: Array, gamma: Array) -> tuple[Array, Array]:
    """The answer x (N, 2, 3) and F (N, 3) from the inverse."""
    answer = columns @ np.concatenate([f.ravel(), gamma.ravel()])
    return answer[:, :2], answer[:, 2]


def _joint_acceleration(a: Array, alpha: Array, sp: Array, sd: Array, cp: Array, cd: Array) -> Array:
    """d̈ (N, 3): acceleration of each proximal point relative to where it hangs."""
    near = a + np.cross(alpha, sp) + cp
    far = a + np.cross(alpha, sd) + cd
    near[1:] -= far[:-1]
    return near


def _torque_pairs(
    columns: Array, rods: NDArray[np.bool_], u: Array, ell: Array, sp: Array, sd: Array
) -> Array:
    """(joints, N, 3): norms of the answers to a unit torque pair at each joint, rods' upper joints first.

    A torque τ on a massless rod is balanced by forces ∓(τ × u)/ℓ at its ends.
    """
    n = len(rods)
    wrench = columns[..., : 6 * n].reshape(n, 3, 3, n, 2, 3)
    force, moment = (
        np.moveaxis(wrench[..., 0, :], 3, 0),
        np.moveaxis(wrench[..., 1, :], 3, 0),
    )  # (N, n, 3, 3, 3)

    def push(k: int, s: Array) -> Array:  # force at a point of body k
        return np.asarray(force[k] + moment[k] @ _cross(s[None])[0])

    upper, lower = [], []
    for k in range(n):
        above = moment[k - 1] if k else np.zeros_like(moment[0])
        if not rods[k]:
            lower.append(moment[k] - above)
            continue
        ends = push(k, sp[k]) - (push(k - 1, sd[k - 1]) if k else 0.0)
        through = -ends @ _cross(u[k][None])[0] / ell[k]  # G = (τ × u)/ℓ = −ũ τ/ℓ
        upper.append(through - above)
        lower.append(moment[k] - through)
    return np.asarray(np.linalg.norm(np.array(upper + lower), axis=(3, 4)))
