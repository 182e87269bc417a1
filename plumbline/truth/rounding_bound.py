"""The tolerance of the state level: a first-order rounding bound per body and quantity.

An engine that evaluates the Newton–Euler equations of the chain in double precision commits a few kinds of
roundings.  Each kind is propagated through the inverse of the system, and the results are added:

    tolerance = 64 ε (tB + tS + tJ + d),    ε = 2⁻⁵³

    tB  every term of each equation, rounded once, and the result itself
    tS  elimination onto the joints: the terms of C M⁻¹ f
    tJ  joint-space engines: the terms of M q̈ + h, as torque pairs at the joints
    d   accumulation of accelerations and forces along the chain

Arms that an engine finds as differences of positions are off by a rounding of these: terms of tB count a
share of the position too, which is the larger one where it is above 32 arms (rods of 100 m and more).
Without tJ joint-space engines exceed the bound by 1e7, without tS maximal coordinates by 1e4 (needles).

Every part is homogeneous in each unit, so the ratio of the bound to its quantity's scale does not change when
lengths, masses or times are measured in other units.  World frame throughout: A ω̇′ has the norm of ω̇′.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import cross, cross_matrix, rotate_vectors, rotation_matrix
from plumbline.model.welding import BodyParts, part_offsets
from plumbline.processes.workers import Pickled
from plumbline.truth.rounding_bound_tree import POSITION_SHARE, tree_tolerances

EPS = 2.0**-53
ROUNDING_FACTOR = 64  # state quantities; the worst error of a sound engine is about a sixth of it (tests)
SUM_ROUNDING_FACTOR = 256  # energies, momenta, entries of the mass matrix
MAX_RELATIVE_BOUND = 1e-8  # a tolerance above this fraction of its scale could hide a mistake


@dataclass(frozen=True, eq=False)
class RoundingBound:
    """Tolerances at one state; differences of 3-vectors are compared by their Euclidean norm.

    ``scale`` holds per field what the tolerance is relative to: max(‖r̈‖, g), the largest moment in the body's
    Euler equation over |J|, max(‖F‖, m g), and the sums of magnitudes behind the scalars.
    """

    acceleration: Array  # (N,) m/s²
    angular_acceleration: Array  # (N,) rad/s²
    joint_reaction: Array  # (N,) N
    kinetic_energy: float  # J
    potential_energy: float  # J
    angular_momentum: float  # kg m²/s
    mass_matrix: float  # kg m², of each entry
    scale: dict[str, Array | float]
    rod_torque: Array  # (N,) N m, of the torques at both ends of the rod that body k hangs by; 0 for a ball
    joint_moment: Array | None = None  # (N,) N m; absent for chains of rods and balls, which have none

    def tolerance(self, quantity: str) -> Array | float:
        """Look up a tolerance by the name of its quantity.

        Args:
            quantity: a field of `StateQuantities`.

        Returns:
            (N,) per body for vectors per body, else one number, in the unit of the quantity.

        """
        return cast("Array | float", getattr(self, quantity))

    def relative_bound(self, quantity: str) -> float:
        """Return the largest ratio of a tolerance to its scale.

        Args:
            quantity: a field of `StateQuantities`.

        Returns:
            The ratio; above `MAX_RELATIVE_BOUND` agreement would prove little.

        """
        tolerance, scale = np.asarray(self.tolerance(quantity)), np.asarray(self.scale[quantity])
        return float(np.max(tolerance / np.where(scale > 0, scale, 1.0), initial=0.0, where=scale > 0))

    def describe(self, quantity: str) -> str:
        """Explain in one sentence how a tolerance was derived.

        Args:
            quantity: a field of `StateQuantities`.

        Returns:
            The sentence, with the largest tolerance and its ratio to the scale.

        """
        if quantity in ("acceleration", "angular_acceleration", "joint_reaction", "joint_moment"):
            how = (
                f"{ROUNDING_FACTOR} roundings (2^-53) of the largest terms of the Newton-Euler equations, of "
                "their elimination onto the joints and of the joint-space form, each propagated through the "
                "inverse"
            )
        else:
            how = f"{SUM_ROUNDING_FACTOR} roundings (2^-53) of the sum of the magnitudes of its terms"
        largest = float(np.max(self.tolerance(quantity)))
        return f"{how}: at most {largest:.1e}, {self.relative_bound(quantity):.1e} of its scale"


def remembered_rounding_bound(model: Model, state: State) -> RoundingBound:
    """Compute the bound of `state_rounding_bound`, or return that of an earlier call with the same numbers.

    Args:
        state: the state at which quantities are compared.

    Returns:
        The tolerances and their scales; not to be changed.

    """
    return _remembered(Pickled.of((model, state)))


@lru_cache(maxsize=64)  # a worker gets the integrators of a scenario in a row
def _remembered(arguments: Pickled) -> RoundingBound:
    return state_rounding_bound(*arguments.load())


def state_rounding_bound(model: Model, state: State, parts: BodyParts | None = None) -> RoundingBound:
    """Compute the rounding tolerances of every state quantity.

    Args:
        model: the mechanism; masses > 0, inertias positive definite.
        state: the state at which quantities are compared.
        parts: the rigid parts that an engine welds each body from, where it does.  The terms are those of a
            part then: for a part whose centre is c away, levers are longer by ‖c‖ and accelerations by
            ‖c‖(‖ω̇‖ + ‖ω‖W), mass and least inertia are those of the lightest part, and the weld carries the
            weight and inertia of a part with the lever c.

    Returns:
        The tolerances, in SI units, and their scales.

    Raises:
        LinAlgError: the system is singular.

    """
    if not model.is_chain:
        return _tree_bound(model, state)
    system = NewtonEulerSystem(model, state)
    terms = _TermSizes(model, state, system, parts)
    joints = _JointSpaceTerms(model, state, system, terms)
    m, J, g = terms.m, terms.J, terms.g
    moment = np.max(
        [
            J * terms.alpha,
            terms.spin,
            terms.sp * terms.F,
            terms.sd * terms.F_next,
            terms.torque,
            terms.arm * terms.weld,
            terms.place * terms.F,
            terms.place * terms.F_next,
            POSITION_SHARE * m * np.linalg.norm(state.v, axis=1) ** 2,
        ],
        0,
    )
    result = np.stack([np.maximum(terms.a, g), terms.alpha, terms.F], 1)
    tB = system.propagate(terms.force(), moment, terms.joint()) + result
    tS = system.propagate(0 * m, 0 * m, terms.elimination())
    tJ = np.einsum("jnq,j->nq", system.torque_pair_responses(), joints.torque)
    swing = joints.D.T @ joints.acceleration
    turning = joints.is_below.T @ joints.acceleration
    carried = np.cumsum((m * (terms.a + swing + g))[::-1])[::-1]
    d = np.stack([swing + terms.a, turning, carried], 1)
    total = ROUNDING_FACTOR * EPS * (tB + tS + tJ + d)

    rod_torque = np.zeros(model.n)
    rod_torque[model.rods] = joints.torque[: model.rods.sum()]
    rod_torque += np.where(model.rods, joints.torque[model.rods.sum() :], 0.0)

    rate, speed = joints.is_below.T @ joints.rate, joints.D.T @ joints.rate
    with_place = np.maximum(speed, terms.place * rate)
    lever = np.cumsum(terms.sp + model.length) + _from_previous(np.cumsum(terms.sd))
    kinetic = float(0.5 * np.sum(m * speed * with_place + J * rate**2))
    potential = float(g * np.sum(m * lever))
    momentum = float(np.sum(m * lever * with_place + J * rate))
    mass_entry = float(np.max(joints.mass_matrix))
    return RoundingBound(
        acceleration=total[:, 0],
        angular_acceleration=total[:, 1],
        joint_reaction=total[:, 2],
        kinetic_energy=SUM_ROUNDING_FACTOR * EPS * kinetic,
        potential_energy=SUM_ROUNDING_FACTOR * EPS * potential,
        angular_momentum=SUM_ROUNDING_FACTOR * EPS * momentum,
        mass_matrix=SUM_ROUNDING_FACTOR * EPS * mass_entry,
        scale={
            "acceleration": result[:, 0],
            "angular_acceleration": np.max([terms.alpha, moment / J, turning], 0),
            "joint_reaction": np.maximum(terms.F, m * g),
            "kinetic_energy": kinetic,
            "potential_energy": potential,
            "angular_momentum": momentum,
            "mass_matrix": mass_entry,
        },
        rod_torque=ROUNDING_FACTOR * EPS * rod_torque,
    )


def _tree_bound(model: Model, state: State) -> RoundingBound:
    """The tolerances of a mechanism that is not a chain of rods and balls."""
    total, scale, sums, rod_torque = tree_tolerances(model, state)
    total = ROUNDING_FACTOR * EPS * total
    return RoundingBound(
        acceleration=total[: model.n, 0],
        angular_acceleration=total[: model.n, 1],
        joint_reaction=total[:, 2],
        joint_moment=total[:, 3],
        scale=scale,
        rod_torque=ROUNDING_FACTOR * EPS * rod_torque,
        **{name: SUM_ROUNDING_FACTOR * EPS * size for name, size in sums.items()},
    )


class _TermSizes:
    """Magnitudes (N,) of the terms in the equations of each body, with norms named as their vectors."""

    def __init__(
        self, model: Model, state: State, system: NewtonEulerSystem, parts: BodyParts | None
    ) -> None:
        norm, n = np.linalg.norm, model.n
        self.m, self.g, self.J = model.mass, float(norm(model.gravity)), norm(model.inertia, axis=(1, 2))
        vectors = system.acceleration, system.alpha, system.omega, system.F, system.sp, system.sd
        self.a, self.alpha, self.omega, self.F, self.sp, self.sd = (norm(x, axis=1) for x in vectors)
        self.place = POSITION_SHARE * norm(state.r, axis=1)
        self.load, self.torque = norm(system.load, axis=1), norm(system.torque, axis=1)
        self.lightest, self.least_inertia = self.m, np.linalg.eigvalsh(model.inertia)[:, 0]
        self.arm = self.weld = np.zeros(n)  # lever and force of the weld
        rod_rate = np.where(model.rods, norm(state.udot, axis=1), 0.0)
        # largest rate of any body or rod between the pivot and here
        self.W = np.maximum.accumulate(np.maximum(self.omega, rod_rate))
        self.centripetal_rod = model.length * rod_rate * self.W
        if parts is not None:
            self.arm = part_offsets(parts)
            self.lightest = np.array([min(part.mass for part in pieces) for pieces in parts])
            inertias = np.array([[part.inertia for part in pieces] for pieces in parts])
            self.least_inertia = np.min(np.linalg.eigvalsh(inertias), axis=(1, 2))
            self.a = self.a + self.arm * (self.alpha + self.omega * self.W)
            self.sp, self.sd = self.sp + self.arm, self.sd + self.arm
            self.weld = self.m * (self.a + self.g)
        self.F_next = np.append(self.F[1:], 0.0)
        self.spin = self.J * self.omega * self.W

    def force(self) -> Array:
        """Largest term of each Newton equation [N]."""
        return np.asarray(np.max([self.m * self.a, self.m * self.g, self.F, self.F_next, self.load], 0))

    def joint(self) -> Array:
        """Largest term of each joint's acceleration equation [m/s²]."""
        near, far = (
            np.max([self.a, s * self.alpha, s * self.omega * self.W], 0)
            for s in (np.maximum(self.sp, self.place), self.sd)
        )
        return np.asarray(np.max([near, _from_previous(far), self.centripetal_rod], 0))

    def elimination(self) -> Array:
        """Terms of C M⁻¹ f in each joint's equation [m/s²]."""
        free = (self.F + self.F_next + self.m * self.g + self.weld) / self.lightest
        turn = (self.sp * self.F + self.sd * self.F_next + self.spin + self.torque) / self.least_inertia
        return np.asarray(free + self.sp * turn + _from_previous(free + self.sd * turn))


class _JointSpaceTerms:
    """Terms of M q̈ + h with one joint per ball and two per rod (its upper end, and its tip).

    Joints are ordered as in `NewtonEulerSystem.torque_pair_responses`.
    """

    def __init__(self, model: Model, state: State, system: NewtonEulerSystem, terms: _TermSizes) -> None:
        norm, rods, body = np.linalg.norm, model.rods, np.arange(model.n)
        tip = state.r + system.sp
        position = np.concatenate([(tip - model.length[:, None] * state.u)[rods], tip])
        self.is_below = np.concatenate([body[rods], body])[:, None] <= body  # (joints, N)
        distance = norm(position[:, None] - state.r, axis=2) + terms.arm
        self.D = np.where(self.is_below, distance, 0.0)  # (joints, N) m, joint to centre

        def relative(of_body: Array, of_rod: Array) -> Array:
            """Norms (joints,): rods against the body above, bodies against their rod or the body above."""
            above = _from_previous(of_body)
            turns = [(of_rod - above)[rods], of_body - np.where(rods[:, None], of_rod, above)]
            return np.asarray(norm(np.concatenate(turns), axis=1))

        self.rate = relative(system.omega, cross(state.u, state.udot))
        self.acceleration = relative(system.alpha, system.rod_angular_acceleration())
        m, J = terms.m, terms.J
        self.mass_matrix = (self.D * m) @ self.D.T + (self.is_below * J) @ self.is_below.T
        h = self.is_below @ (J * terms.W**2 + terms.torque) + self.D @ (m * (terms.g + terms.a) + terms.load)
        self.torque = self.mass_matrix @ self.acceleration + h


class NewtonEulerSystem:
    """The Newton–Euler system of the chain at one state, its inverse and its solution; world axes.

    With x = (r̈, α) per body and F = E λ per joint, E = u for a rod (padded to 3×3) and I for a ball,

        M x − Cᵀ λ = f,    C x = γ,    K = C M⁻¹ Cᵀ

    ``inverse_columns`` (N, 3, 3, 9N): r̈, α, F of each body per unit of each row (6N of f, then 3N of γ).
    """

    def __init__(self, model: Model, state: State) -> None:
        """Assemble, invert and solve the system.

        Args:
            state: a state on the constraint manifold.

        """
        n, body, rods = model.n, np.arange(model.n), model.rods
        A = rotation_matrix(state.p)
        inertia = A @ model.inertia @ A.mT
        self.n, self.rods, self.u, self.length = n, rods, state.u, model.length
        self.sp, self.sd = rotate_vectors(A, model.proximal), rotate_vectors(A, model.distal)
        self.sd[-1] = 0.0  # nothing is attached there
        self.omega = omega = rotate_vectors(A, state.omega)
        self.load = model.force - model.drag_force[:, None] * state.v
        self.torque = rotate_vectors(A, model.moment) - model.drag_moment[:, None] * omega

        E = np.where(rods[:, None, None], state.u[:, :, None] * np.array([1.0, 0.0, 0.0]), np.eye(3))
        C = np.zeros((n, 3, n, 6))
        C[body, :, body, :3], C[body, :, body, 3:] = E.mT, -E.mT @ cross_matrix(self.sp)
        up, down = body[1:], body[:-1]
        C[up, :, down, :3], C[up, :, down, 3:] = -E[1:].mT, E[1:].mT @ cross_matrix(self.sd[:-1])
        M_inverse = np.zeros((n, 6, n, 6))
        M_inverse[body, :3, body, :3] = np.eye(3) / model.mass[:, None, None]
        M_inverse[body, 3:, body, 3:] = np.linalg.inv(inertia)
        C_flat, M_flat = C.reshape(3 * n, 6 * n), M_inverse.reshape(6 * n, 6 * n)
        CM = C_flat @ M_flat
        held = np.repeat(~rods, 3).reshape(n, 3) | (np.arange(3) == 0)  # a rod uses one of its three rows
        K = CM @ C_flat.T + np.diag(~held.ravel())
        d = 1 / np.sqrt(np.diag(K))  # equilibrated: pivots must not depend on the units
        K_inverse = np.linalg.inv(K * d * d[:, None]) * d * d[:, None] * np.outer(held, held)
        X = CM.T @ K_inverse
        x_rows = np.concatenate([M_flat - X @ CM, X], 1).reshape(n, 2, 3, 9 * n)
        F_rows = E @ np.concatenate([-X.T, K_inverse], 1).reshape(n, 3, 9 * n)
        self.inverse_columns = np.concatenate([x_rows, F_rows[:, None]], 1)

        self.centripetal_p, self.centripetal_d = (cross(omega, cross(omega, s)) for s in (self.sp, self.sd))
        gamma = (E.mT @ (_from_previous(self.centripetal_d) - self.centripetal_p)[..., None])[..., 0]
        gamma[:, 0] -= np.where(rods, model.length * np.sum(state.udot**2, -1), 0.0)
        force = model.mass[:, None] * model.gravity + self.load
        moment = self.torque - cross(omega, rotate_vectors(inertia, omega))
        rows = np.concatenate([np.concatenate([force, moment], -1).ravel(), gamma.ravel()])
        self.acceleration, self.alpha, self.F = np.moveaxis(self.inverse_columns @ rows, 1, 0)  # (N, 3) each

    def propagate(self, force: Array, moment: Array, joint: Array) -> Array:
        """Compute the first-order change for errors in the rows: Frobenius norms of the inverse's 3×3 blocks.

        Args:
            force: sizes (N,) of the errors in the force rows [N].
            moment: sizes (N,) in the moment rows [N m].
            joint: sizes (N,) in the joint rows [m/s²].

        Returns:
            (N, 3) of r̈ [m/s²], α [rad/s²] and F [N].

        """
        n, norm = self.n, np.linalg.norm
        of_body = norm(self.inverse_columns[..., : 6 * n].reshape(n, 3, 3, n, 2, 3), axis=(2, 5))
        of_joint = norm(self.inverse_columns[..., 6 * n :].reshape(n, 3, 3, n, 1, 3), axis=(2, 5))
        B = np.concatenate([of_body, of_joint], -1)
        return np.asarray(np.einsum("nqkc,kc->nq", B, np.stack([force, moment, joint], 1)))

    def rod_angular_acceleration(self) -> Array:
        """Compute the angular acceleration of each rod without axial spin, u × d̈/ℓ.

        Returns:
            (N, 3) [rad/s²], world frame; 0 for a ball.

        """
        near = self.acceleration + cross(self.alpha, self.sp) + self.centripetal_p
        far = self.acceleration + cross(self.alpha, self.sd) + self.centripetal_d
        ell = np.where(self.rods, self.length, np.inf)[:, None]
        return cross(self.u, near - _from_previous(far)) / ell

    def torque_pair_responses(self) -> Array:
        """Compute the norms of the response to a unit torque pair at each joint.

        A torque τ on a massless rod is balanced by forces ∓(τ × u)/ℓ at its ends.

        Returns:
            (joints, N, 3) of r̈, α and F, the rods' upper joints first.

        """
        wrench = self.inverse_columns[..., : 6 * self.n].reshape(self.n, 3, 3, self.n, 2, 3)
        force, moment = np.moveaxis(wrench[..., 0, :], 3, 0), np.moveaxis(wrench[..., 1, :], 3, 0)

        def push(k: int, s: Array) -> Array:
            """Response (N, 3, 3, 3) to a force at a point of body k."""
            return np.asarray(force[k] + moment[k] @ cross_matrix(s))

        upper, lower = [], []
        for k in range(self.n):
            above = moment[k - 1] if k else np.zeros_like(moment[0])
            if not self.rods[k]:
                lower.append(moment[k] - above)
                continue
            ends = push(k, self.sp[k]) - (push(k - 1, self.sd[k - 1]) if k else 0.0)
            through = -ends @ cross_matrix(self.u[k]) / self.length[k]  # (τ × u)/ℓ = −ũ τ/ℓ
            upper.append(through - above)
            lower.append(moment[k] - through)
        return np.asarray(np.linalg.norm(np.array(upper + lower), axis=(3, 4)))


def _from_previous(v: Array) -> Array:
    """Value (N,) or (N, 3) at the body above each body, 0 at the pivot."""
    return np.concatenate([np.zeros_like(v[:1]), v[:-1]])
