"""What an adapter declares about one step of a fixed-step integrator: the formula, by its parameters.

docs/integrators.md states each formula with its source; `plumbline.truth.step_formulas` evaluates them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class JointSpaceMethod:
    """An explicit or linearly implicit step in joint coordinates, q and v being configuration and velocity.

    With v̇ = a(q, v), and ⊕ for a joint-wise displacement:

        semi-implicit Euler   v₁ = v + h (M + h D)⁻¹ M a,   q₁ = q ⊕ h v₁,   D = −∂(M a)/∂v of some forces
        Runge-Kutta           θ̇ = dexp⁻¹(θ) v,   v̇ = a(q ⊕ θ, v),   from θ = 0;   q₁ = q ⊕ θ₁

    Coordinates "joint rotations": each ball joint and each rod's upper end has a relative quaternion, and as
    its velocity the relative angular velocity in the child's frame; q ⊕ t = q exp(t). "joint angles":
    revolute joints; q ⊕ t = q + t and dexp⁻¹ is the identity.
    """

    formula: Literal["semi-implicit Euler", "Runge-Kutta"]
    coordinates: Literal["joint rotations", "joint angles"]
    # A rod's inertia about its own axis over the trace of the inertia that it carries. It changes no motion,
    # but a step: relative rates on a rod give it an axial spin of O(h²).
    rod_axial_inertia: float = 1.0
    implicit_forces: Literal["none", "applied", "all"] = "none"  # forces in D: drag; drag and Coriolis terms
    stages: tuple[tuple[float, ...], ...] = ()  # the tableau's rows below the diagonal
    weights: tuple[float, ...] = ()


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


StepMethod = JointSpaceMethod | ConstrainedMethod


def classical_runge_kutta(
    coordinates: Literal["joint rotations", "joint angles"], rod_axial_inertia: float = 1.0
) -> JointSpaceMethod:
    """Return the classical Runge-Kutta method of order 4.

    Args:
        coordinates: of `JointSpaceMethod`.
        rod_axial_inertia: of `JointSpaceMethod`; of no effect for joint angles.

    Returns:
        The method.

    """
    return JointSpaceMethod(
        "Runge-Kutta",
        coordinates,
        rod_axial_inertia,
        stages=((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)),
        weights=(1 / 6, 1 / 3, 1 / 3, 1 / 6),
    )


def generalized_alpha(spectral_radius: float, *, solver_atol: float, solver_rtol: float) -> ConstrainedMethod:
    """Return the generalised-α method with constraints on positions (index 3).

    Args:
        spectral_radius: ρ at infinite frequency, 0 … 1.
        solver_atol: absolute tolerance of Newton's iteration [N and m].
        solver_rtol: its tolerance relative to the norm of the first residual.

    Returns:
        The method; parameters by Chung and Hulbert, J. Appl. Mech. 60 (1993) 371-375.

    """
    alpha_m = (2 * spectral_radius - 1) / (spectral_radius + 1)
    alpha_f = spectral_radius / (spectral_radius + 1)
    gamma = 0.5 + alpha_f - alpha_m
    beta = 0.25 * (gamma + 0.5) ** 2
    return ConstrainedMethod(alpha_m, alpha_f, beta, gamma, "position", solver_atol, solver_rtol)
