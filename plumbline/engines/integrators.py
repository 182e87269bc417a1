"""Time integrators for engines that have none: one-step methods and an error-controlled one.

The configuration q of a system is a point of a Lie group, its velocity v a vector of the Lie algebra.
The methods need the system's accelerations and the group's operations, see `LieGroupSystem`; with ⊕ for
`LieGroupSystem.integrate` they solve q̇ = (d/dε) q ⊕ ε v, v̇ = a(q, v).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from scipy.integrate import DOP853

from plumbline.model.datatypes import Array, EngineFailure, Float

Sample = TypeVar("Sample")


class LieGroupSystem(Protocol):
    """A mechanical system with configurations q (nq,) and velocities v (nv,)."""

    def acceleration(self, q: Float[Array, "nq"], v: Float[Array, "nv"]) -> Float[Array, "nv"]:
        """Evaluate the accelerations."""

    def integrate(self, q: Float[Array, "nq"], displacement: Float[Array, "nv"]) -> Float[Array, "nq"]:
        """Move a configuration along a tangent vector.

        Returns:
            q ⊕ displacement.

        """

    def exponential_coordinate_rate(
        self, q: Float[Array, "nq"], theta: Float[Array, "nv"], v: Float[Array, "nv"]
    ) -> Float[Array, "nv"]:
        """Apply dexp⁻¹ of θ to a velocity.

        Args:
            theta: exponential coordinates θ of a configuration near q.

        Returns:
            θ̇, with which q ⊕ θ moves at the velocity v.

        """

    def configuration_rate(self, q: Float[Array, "nq"], v: Float[Array, "nv"]) -> Float[Array, "nq"]:
        """Map a velocity to the rate of the ambient coordinates."""

    def normalize(self, q: Float[Array, "nq"]) -> Float[Array, "nq"]:
        """Project ambient coordinates onto the group.

        Args:
            q: coordinates near the group.

        Returns:
            The point of the group nearest to q.

        """


def semi_implicit_euler(
    system: LieGroupSystem, q: Float[Array, "nq"], v: Float[Array, "nv"], h: float
) -> tuple[Float[Array, "nq"], Float[Array, "nv"]]:
    """Take one step of v₁ = v + h a(q, v), q₁ = q ⊕ h v₁.

    Args:
        h: step [s].

    """
    v = v + h * system.acceleration(q, v)
    return system.integrate(q, h * v), v


def rkmk4(
    system: LieGroupSystem, q: Float[Array, "nq"], v: Float[Array, "nv"], h: float
) -> tuple[Float[Array, "nq"], Float[Array, "nv"]]:
    """Take one step of the classical Runge–Kutta method in exponential coordinates.

    It solves θ̇ = dexp⁻¹(θ) v, v̇ = a(q ⊕ θ, v) from θ = 0 (Munthe-Kaas, Appl. Numer. Math. 29 (1999)
    115–127).  With θ̇ = v instead the order would be 2.

    Args:
        h: step [s].

    Returns:
        Configuration and velocity after the step.

    """
    accelerate, move, rate = system.acceleration, system.integrate, system.exponential_coordinate_rate
    a1 = accelerate(q, v)  # at θ = 0, where dexp is the identity and θ̇ = v
    theta, v2 = h / 2 * v, v + h / 2 * a1
    w2, a2 = rate(q, theta, v2), accelerate(move(q, theta), v2)
    theta, v3 = h / 2 * w2, v + h / 2 * a2
    w3, a3 = rate(q, theta, v3), accelerate(move(q, theta), v3)
    theta, v4 = h * w3, v + h * a3
    w4, a4 = rate(q, theta, v4), accelerate(move(q, theta), v4)
    return move(q, h / 6 * (v + 2 * w2 + 2 * w3 + w4)), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


def runge_kutta_4(slope: Callable[[Array], Array], y: Float[Array, "..."], h: float) -> Float[Array, "..."]:
    """Take one step of the classical Runge–Kutta method for ẏ = slope(y).

    Args:
        slope: the right-hand side.
        y: array of any shape.
        h: step [s].

    """
    k1 = slope(y)
    k2 = slope(y + h / 2 * k1)
    k3 = slope(y + h / 2 * k2)
    k4 = slope(y + h * k3)
    return np.asarray(y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))


def sample_steps(
    step: Callable[[Sample], Sample], start: Sample, times: Float[Array, "samples"], h: float
) -> list[Sample]:
    """Take steps of fixed size and keep the samples.

    Args:
        step: advances a sample (for example q and v) by one step.
        start: the sample at time 0.
        times: sample times [s], multiples of ``h`` from 0.
        h: step [s].

    Returns:
        The samples at ``times``.

    """
    samples = [start]
    for count in np.diff(np.rint(times / h).astype(int)):
        sample = samples[-1]
        for _ in range(count):
            sample = step(sample)
        samples.append(sample)
    return samples


def dop853(
    system: LieGroupSystem,
    q: Float[Array, "nq"],
    v: Float[Array, "nv"],
    times: Float[Array, "samples"],
    rtol: float,
) -> tuple[Float[Array, "samples nq"], Float[Array, "samples nv"], int]:
    """Integrate q̇, v̇ in ambient coordinates by SciPy's DOP853, with a step that ends at every sample time.

    The integrated q is not normalised; accelerations are evaluated at the normalised q.

    Args:
        times: sample times [s], ascending from 0.
        rtol: relative tolerance, and the absolute one.

    Returns:
        Configurations, velocities and the number of steps.

    Raises:
        EngineFailure: the step size became too small; the message is SciPy's.

    """
    nq = len(q)

    def slope(_: float, y: Array) -> Array:
        q, v = y[:nq], y[nq:]
        a = system.acceleration(system.normalize(q), v)
        return np.concatenate([system.configuration_rate(q, v), a])

    y, steps = np.concatenate([q, v]), 0
    rows = [y]
    solver = DOP853(slope, 0.0, y, times[-1], rtol=rtol, atol=rtol)
    for time in times[1:]:
        solver.t_bound, solver.status = time, "running"
        while solver.status == "running":
            message = solver.step()
            steps += 1
        if solver.status == "failed":
            raise EngineFailure(f"dop853 stopped at t = {solver.t} s: {message}")
        rows.append(solver.y.copy())
    return np.array(rows)[:, :nq], np.array(rows)[:, nq:], steps
