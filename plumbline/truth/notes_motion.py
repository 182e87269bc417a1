"""Motions by the notes' equations in the reference's O(bodies) form, for comparison with other methods."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.integrate import solve_ivp

from plumbline.model.datatypes import Array, EngineFailure, Model, State, Trajectory
from plumbline.model.kinematics import quaternion_rate
from reference_impl.collocation import integrate_collocation
from reference_impl.tree_elimination import EliminatedSystem, eliminated_system

NotesIntegrator = Literal["collocation", "dop853"]


def simulate_notes_form(
    model: Model, state: State, times: Array, rtol: float, method: NotesIntegrator = "collocation"
) -> Trajectory:
    """Integrate the notes' equations, by collocation on the manifold or in the raw form (N6) by DOP853.

    After 2 s, the motion on the manifold differs from the truth by 2e-14 m on thirty ball joints and 5e-14 m
    on fifty, the raw form by 7e-13 m and 2e-12 m at any tolerance, because it drifts.

    Args:
        model: the mechanism.
        state: initial state.
        times: (T,) [s] of the samples, times[0] = 0.
        rtol: relative tolerance.
        method: the integrator.

    Returns:
        The motion at ``times``.

    Raises:
        EngineFailure: the integrator stops early.

    """
    system = eliminated_system([model], state.x)
    start = state.r, state.p, state.v, quaternion_rate(state.p, state.omega)
    try:
        if method == "dop853":
            return _simulate_dop853(system, start, times, rtol)
        run = integrate_collocation(system, *start, times, rtol, project=True)
        return Trajectory(times, run.r, run.p, run.v, run.pdot, run.steps)
    except ArithmeticError as error:
        raise EngineFailure(str(error)) from None


def _simulate_dop853(
    system: EliminatedSystem, start: tuple[Array, Array, Array, Array], times: Array, rtol: float
) -> Trajectory:
    """The raw form by DOP853, with absolute tolerances of ``rtol`` times 1 m, 1, 1 m/s and 1 1/s.

    `reference_impl.integrate` scales them with the motion, which is too coarse for a truth.
    """
    n = system.body_count

    def rate(_: float, y: Array) -> Array:
        q, v = np.split(y.reshape(14, n), 2)
        return np.concatenate([v, system.acceleration(q, v)]).ravel()

    first = np.concatenate(start, axis=1).T.ravel()
    run = solve_ivp(rate, (0.0, times[-1]), first, "DOP853", times, rtol=rtol, atol=rtol)
    if not run.success:
        raise ArithmeticError(f"DOP853 stopped at t = {run.t[-1]} s: {run.message}")
    y = np.moveaxis(run.y.reshape(14, n, len(times)), (0, 1, 2), (2, 1, 0))  # (T, N, 14)
    return Trajectory(times, y[..., :3], y[..., 3:7], y[..., 7:10], y[..., 10:], int(run.nfev) // 12)
