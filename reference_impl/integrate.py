"""The notes' first-order form (N6), raw: no stabilisation, so that its drift is a result (E4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import DOP853

from reference_impl import notes
from reference_impl.arrays import Array, Float, Motion
from reference_impl.direct import DirectSystem
from reference_impl.elements import Elements
from reference_impl.euler_parameters import angular_velocity
from reference_impl.mechanism import Mechanism

# r̈ and p̈, (7 N,), at r, p, ṙ, ṗ (N, ·) and joint coordinates (N, 2), near which angles of springs are taken
Acceleration = Callable[[Array, Array, Array, Array, Array | None], Array]


@dataclass(frozen=True, eq=False)
class IntegrationResult:
    """Samples of a motion as integrated: p is neither normalised nor projected."""

    t: Float[Array, "samples"]  # s
    r: Float[Array, "samples bodies 3"]  # m
    p: Float[Array, "samples bodies 4"]
    v: Float[Array, "samples bodies 3"]  # m/s, ṙ
    pdot: Float[Array, "samples bodies 4"]  # 1/s
    steps: int  # steps taken
    evaluations: int  # of the right-hand side


def pack_state(*motion: *Motion) -> Float[Array, "entries"]:
    """Concatenate y = (r, p, ṙ, ṗ) (N6)."""
    return np.concatenate([x.ravel() for x in motion])


def unpack_state(y: Float[Array, "... entries"], n: int) -> Motion:
    """Split y = (r, p, ṙ, ṗ) (N6) into its parts.

    Returns:
        r (..., N, 3), p (..., N, 4), ṙ (..., N, 3) and ṗ (..., N, 4).

    """
    lead, q, rate = y.shape[:-1], y[..., : 7 * n], y[..., 7 * n :]
    r, v = (part[..., : 3 * n].reshape(*lead, n, 3) for part in (q, rate))
    p, pdot = (part[..., 3 * n :].reshape(*lead, n, 4) for part in (q, rate))
    return r, p, v, pdot


def direct_acceleration(chain: Mechanism, gamma_defect: float | Float[Array, "c"] = 0.0) -> Acceleration:
    """Return the right-hand side of the direct form.

    Args:
        gamma_defect: added to γ, one number or one per row: a planted fault of known growth (E4).

    Returns:
        r̈ and p̈ (7 N,) as a function of r, p, ṙ, ṗ.

    """
    system = DirectSystem(chain)

    def acceleration(r: Array, p: Array, v: Array, pdot: Array, x: Array | None = None) -> Array:
        return system.solve_unknowns(r, p, v, pdot, gamma_defect=gamma_defect, x=x)[0][: 7 * chain.n]

    return acceleration


def notes_acceleration(chain: Mechanism) -> Acceleration:
    """Return the right-hand side by the equations exactly as the notes print them.

    Args:
        chain: one or two bodies on rods.

    Returns:
        r̈ and p̈ (7 N,) as a function of r, p, ṙ, ṗ.

    """

    def acceleration(r: Array, p: Array, v: Array, pdot: Array, _: Array | None = None) -> Array:
        return notes.solve_system(chain, r, p, v, pdot)[: 7 * chain.n]

    return acceleration


def state_scales(chain: Mechanism, *motion: *Motion) -> Float[Array, "entries"]:
    """Return the size that each part of y has in this motion, for absolute tolerances.

    A coordinate that passes through zero needs no more digits there than the motion as a whole: the
    stretched mechanism for r, 1 for p, and for the rates the larger of the initial ones and of those that
    falling through the chain's own length reaches.

    Args:
        motion: initial r, p, ṙ and ṗ.

    Returns:
        In the units of y.

    """
    r, p, v, pdot = motion
    span = float(np.sum(chain.length + np.linalg.norm(chain.proximal, axis=1)))
    span += float(np.sum(np.linalg.norm(chain.point[1:, 0], axis=1)) + np.linalg.norm(chain.point[0, 0]))
    span = max(span, float(np.max(np.abs(r)))) or 1.0
    fall = float(np.sqrt(np.linalg.norm(chain.gravity) * span))
    omega = float(np.max(np.abs(angular_velocity(p, pdot))))
    speed = max(fall, float(np.max(np.abs(v))), omega * span)
    sizes = (span, 1.0, speed, max(speed / span, omega) / 2)
    return np.repeat(sizes, np.array([3, 4, 3, 4]) * chain.n)


def integrate_dop853(
    chain: Mechanism,
    r: Float[Array, "bodies 3"],
    p: Float[Array, "bodies 4"],
    v: Float[Array, "bodies 3"],
    pdot: Float[Array, "bodies 4"],
    times: Float[Array, "samples"],
    rtol: float,
    acceleration: Acceleration | None = None,
    x: Float[Array, "joints 2"] | None = None,
    atol: float | None = None,
) -> IntegrationResult:
    """Integrate (N6) by scipy's DOP853; the turns of angles with springs are counted step by step.

    Args:
        r: initial positions [m].
        p: initial Euler parameters.
        v: initial velocities ṙ [m/s].
        pdot: initial rates ṗ [1/s].
        times: sample times [s], ascending from the initial time; samples are dense output.
        rtol: relative tolerance, 2.2e-14 at least.
        acceleration: the right-hand side; the direct form by default.
        x: initial joint coordinates near which the angles of springs are taken; absent: principal
            values.
        atol: absolute tolerance, in the units of y; ``rtol`` times `state_scales` by default.

    Returns:
        The motion at ``times``.

    Raises:
        SingularSystem: S is singular on the way.
        ArithmeticError: the step size vanishes.

    """
    n, accelerate = chain.n, acceleration or direct_acceleration(chain)
    elements, size = Elements(chain), 14 * n
    y0, sizes = pack_state(r, p, v, pdot), state_scales(chain, r, p, v, pdot)
    if not sizes.all():  # at rest without gravity: what loads and springs reach
        reached = np.sqrt(np.max(np.abs(accelerate(r, p, v, pdot, x))) * np.tile(sizes[: 7 * n], 2))
        sizes = np.where(sizes > 0, sizes, np.where(reached > 0, reached, 1.0))
    limits = rtol * sizes
    limits = limits if atol is None else np.full(size, atol)
    samples = np.empty((len(times), size))
    samples[0], done, steps = y0, 1, 0

    def rate(_: float, y: Array) -> Array:
        """(N6) ẏ = (ṙ, ṗ, r̈, p̈)."""
        return np.concatenate([y[7 * n :], accelerate(*unpack_state(y, n), x)])

    solver = DOP853(rate, times[0], y0, times[-1], rtol=rtol, atol=limits)
    while done < len(times):
        if elements.has_winding_angles:  # no angle changes by half a turn within a step
            x = elements.coordinates(*unpack_state(solver.y, n), x=x)[0]
        message = solver.step()
        if solver.status == "failed":
            raise ArithmeticError(f"DOP853 stopped at t = {solver.t} s: {message}")
        steps += 1
        reached = int(np.searchsorted(times, solver.t, side="right"))
        if reached > done:
            samples[done:reached] = solver.dense_output()(times[done:reached]).T
            if times[reached - 1] == solver.t:
                samples[reached - 1] = solver.y
            done = reached
    return IntegrationResult(times, *unpack_state(samples, n), steps, solver.nfev)
