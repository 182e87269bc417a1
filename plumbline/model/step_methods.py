"""What an adapter declares about one step of a fixed-step integrator: the formula, by its parameters.

docs/integrators.md states each formula with its source; `plumbline.truth.step_formulas` evaluates them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, Literal

# rad: below it the terms of series that are left out of 1 − cos t are smaller than rounding
SERIES_TURN = 2.0**-13


@dataclass(frozen=True)
class JointSpaceMethod:
    """An explicit or linearly implicit step in joint coordinates, q and v being configuration and velocity.

    With v̇ = a(q, v), and ⊕ for a joint-wise displacement:

        semi-implicit Euler   v₁ = v + h (M + h D)⁻¹ M a,   q₁ = q ⊕ h v₁,   D = −∂(M a)/∂v of some forces
        positions first       q₁ = q ⊕ h v,   v₁ = v + h a(q₁, v)
        velocity Verlet       q₁ = q ⊕ (h v + ½ h² a),   v₁ = v + ½ h (a + a(q₁, v + ½ h a))
        Runge-Kutta           θ̇ = dexp⁻¹(θ) v,   v̇ = a(q ⊕ θ, v),   from θ = 0;   q₁ = q ⊕ θ₁

    Coordinates "joint rotations": each ball joint and each rod's upper end has a relative quaternion, and as
    its velocity the relative angular velocity in the child's frame; q ⊕ t = q exp(t). "joint angles":
    revolute joints; q ⊕ t = q + t and dexp⁻¹ is the identity.  Coordinates of hinges, slides and their like
    are numbers in both.

    `Trajectory.coordinates` and ``velocities`` have them joint by joint: of a rod its turn, a quaternion
    (scalar first) that takes z to its direction, or its two angles; then of its body, or of a ball, the turn
    against the rod or the far body, in the bodies' axes, a quaternion or three angles; of other joints x.  A
    free body has its quaternion, then r, in "joint angles" r, then the angles; its velocity is ṙ, or that in
    body axes of a "rigid motion", then that of the turn.

    The fields from ``new_velocity_share`` on are for formulas that an engine may take in place of its own.
    """

    formula: Literal["semi-implicit Euler", "positions first", "velocity Verlet", "Runge-Kutta"]
    coordinates: Literal["joint rotations", "joint angles"]
    # A rod's inertia about its own axis over `rod_inertias`. It changes no motion, but a step: relative rates
    # on a rod give it an axial spin of O(h²).
    rod_axial_inertia: float = 1.0
    # forces in D: dampers of joints; drag and all dampers; all forces, Coriolis terms included
    implicit_forces: Literal["none", "joint dampers", "applied", "all"] = "none"
    # of a free body: r and ṙ in the world beside its rotation, or a rigid motion with the twist in its frame
    free_coordinates: Literal["point and rotation", "rigid motion"] = "point and rotation"
    gap_correction: float = 0.0  # a [1/s]: gaps x of loops are to follow ẍ = −2 a ẋ − a² x
    # x: the logarithm of the pose of one end in the other, followed as a twist; or the distance of their
    # points in the world, and the vector of the quaternion from the second end to the first
    gap_form: Literal["logarithm", "distance and quaternion"] = "logarithm"
    # joints with a pitch are cylindrical ones, x too is how far the slide is off the pitch times the turn
    holds_pitches: bool = False
    # a is the product of the inverse of M and the forces f: M a then is off by ε |M| |M⁻¹| |f|, not by ε |f|
    inverts_mass_matrix: bool = False
    # rad; from it on turns and rigid motions go by closed forms, which lose digits of 1 − cos t over t²
    closed_form_turn: float = inf
    stages: tuple[tuple[float, ...], ...] = ()  # the tableau's rows below the diagonal
    weights: tuple[float, ...] = ()
    new_velocity_share: float = 1.0  # x in q₁ = q ⊕ h (x v₁ + (1−x) v): 0 is explicit Euler
    stale_joint: int | None = None  # a joint whose position is moved by the old velocity
    is_rotation_exact: bool = True  # else quaternions are moved by p + h ṗ and normalised
    damping_factor: float = 1.0  # on D
    is_damping_symmetric: bool = False  # (D + Dᵀ)/2 in place of D
    correction_terms: int | None = None  # of dexp⁻¹ after v; None: all
    step_factor: float = 1.0  # on h
    acceleration_factor: float = 1.0  # on all accelerations
    rate_factor: float = 1.0  # on the velocities after a step
    substeps: int = 1  # so many steps of h / substeps each
    reuses_acceleration: bool = False  # the first of a step is the last one computed in the step before


@dataclass(frozen=True)
class ConstrainedMethod:
    """A generalised-α or Newmark step in maximal coordinates q = (r, p) with multipliers λ.

    (1−αm) a₁ + αm a₀ = (1−αf) q̈₁ + αf q̈₀,   a₀ = q̈₀ at the start
    q₁ = q₀ + h q̇₀ + h² ((½−β) a₀ + β a₁),   q̇₁ = q̇₀ + h ((1−γ) a₀ + γ a₁)
    M(q₁) q̈₁ + C(q₁)ᵀ λ₁ = f(q₁, q̇₁),   g(q₁) = 0 or ġ(q₁, q̇₁) = 0
    """

    alpha_m: float
    alpha_f: float
    beta: float
    gamma: float
    constraint_level: Literal["position", "velocity"]
    # Newton's iteration ends below solver_atol, or solver_rtol × the first residual [N, and m or m/s].
    solver_atol: float
    solver_rtol: float
    difference_step: float  # of q in the forward differences of C(q) q̇ that the first q̈ contains [m or 1]


StepMethod = JointSpaceMethod | ConstrainedMethod


def classical_runge_kutta(
    coordinates: Literal["joint rotations", "joint angles"], rod_axial_inertia: float = 1.0, **fields: Any
) -> JointSpaceMethod:
    """Return the classical Runge-Kutta method of order 4.

    Args:
        coordinates: of `JointSpaceMethod`.
        rod_axial_inertia: of `JointSpaceMethod`; of no effect for joint angles.
        fields: further ones of `JointSpaceMethod`.

    """
    name = "the classical Runge–Kutta method"
    return runge_kutta(name, coordinates, rod_axial_inertia=rod_axial_inertia, **fields)


# Explicit Runge-Kutta methods: the tableau's rows below the diagonal, and weights.
_CLASSICAL, _R = (1 / 6, 1 / 3, 1 / 3, 1 / 6), 5.0**0.5
TABLEAUS: Mapping[str, tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]] = {
    "the explicit midpoint rule (order 2)": (((), (0.5,)), (0.0, 1.0)),
    "Heun's method of order 2": (((), (1.0,)), (0.5, 0.5)),
    "Kutta's method of order 3": (((), (0.5,), (-1.0, 2.0)), (1 / 6, 2 / 3, 1 / 6)),
    # Z. Math. Phys. 45 (1900) 23-38
    "Heun's method of order 3": (((), (1 / 3,), (0.0, 2 / 3)), (0.25, 0.0, 0.75)),
    # Appl. Math. Lett. 2 (1989) 321-325; the fourth stage is for the estimate of errors alone
    "Bogacki and Shampine's method of order 3": (
        ((), (0.5,), (0.0, 0.75)), (2 / 9, 1 / 3, 4 / 9)),
    "the classical Runge–Kutta method": (((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), _CLASSICAL),
    "the classical Runge–Kutta method with its third stage by the first slope":
        (((), (0.5,), (0.5, 0.0), (0.0, 0.0, 1.0)), _CLASSICAL),
    "Kutta's 3/8 rule": (((), (1 / 3,), (-1 / 3, 1.0), (1.0, -1.0, 1.0)), (1 / 8, 3 / 8, 3 / 8, 1 / 8)),
    "Dormand and Prince's method of order 5": (  # J. Comput. Appl. Math. 6 (1980) 19-26; likewise the seventh
        ((), (1 / 5,), (3 / 40, 9 / 40), (44 / 45, -56 / 15, 32 / 9),
         (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
         (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656)),
        (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84)),
    "Butcher's method of order 6": (  # J. Austral. Math. Soc. 4 (1964) 179-194
        ((), (0.5 - _R / 10,), (-_R / 10, 0.5 + _R / 5),
         (7 * _R / 20 - 0.75, _R / 4 - 0.25, 1.5 - 7 * _R / 10),
         (1 / 12 - _R / 60, 0.0, 1 / 6, 7 * _R / 60 + 0.25),
         (1 / 12 + _R / 60, 0.0, 0.75 - 5 * _R / 12, 1 / 6, 3 * _R / 10 - 0.5),
         (1 / 6, 0.0, 25 * _R / 12 - 55 / 12, -7 * _R / 12 - 25 / 12, 5 - 2 * _R, 2.5 + _R / 2)),
        (1 / 12, 0.0, 0.0, 0.0, 5 / 12, 5 / 12, 1 / 12)),
}  # fmt: skip


def runge_kutta(
    name: str, coordinates: Literal["joint rotations", "joint angles"], **fields: Any
) -> JointSpaceMethod:
    """Return a method of `TABLEAUS`, with further fields of `JointSpaceMethod`."""
    stages, weights = TABLEAUS[name]
    return JointSpaceMethod("Runge-Kutta", coordinates, **fields, stages=stages, weights=weights)


def generalized_alpha(
    spectral_radius: float, *, solver_atol: float, solver_rtol: float, difference_step: float
) -> ConstrainedMethod:
    """Return the generalised-α method with constraints on positions (index 3).

    Args:
        spectral_radius: ρ at infinite frequency, 0 … 1.
        solver_atol: absolute tolerance of Newton's iteration [N and m].
        solver_rtol: its tolerance relative to the norm of the first residual.
        difference_step: of `ConstrainedMethod`.

    Returns:
        The method; parameters by Chung and Hulbert, J. Appl. Mech. 60 (1993) 371-375.

    """
    alpha_m = (2 * spectral_radius - 1) / (spectral_radius + 1)
    alpha_f = spectral_radius / (spectral_radius + 1)
    gamma = 0.5 + alpha_f - alpha_m
    beta = 0.25 * (gamma + 0.5) ** 2
    return ConstrainedMethod(
        alpha_m, alpha_f, beta, gamma, "position", solver_atol, solver_rtol, difference_step
    )


def describe_method(method: JointSpaceMethod) -> str:
    """Write the declared formula as one line of text.

    Returns:
        The formula with its symbols explained, without its coordinates' definition.

    """
    if method.formula == "semi-implicit Euler":
        forces = {"applied": "the applied forces", "all": "all forces, Coriolis terms included"}
        of = forces.get(method.implicit_forces)
        if of is None:
            return "v1 = v + h a(q, v); q1 = q exp(h v1), joint by joint"
        return f"v1 = v + h inv(M + h D) M a, D = -d(f)/dv of {of}; q1 = q exp(h v1), joint by joint"
    if method.formula != "Runge-Kutta":
        return method.formula
    rows = "; ".join(", ".join(f"{x:.6g}" for x in row) for row in method.stages[1:])
    weights = ", ".join(f"{x:.6g}" for x in method.weights)
    slope = "theta' = inv(dexp(theta)) v" if method.coordinates == "joint rotations" else "theta' = v"
    return f"Runge-Kutta on {slope}, v' = a(q + theta, v), with stages ({rows}) and weights ({weights})"
