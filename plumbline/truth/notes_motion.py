"""Motions by the notes' equations in the reference's O(bodies) form, for comparison with other methods."""

from __future__ import annotations

from typing import Literal

from plumbline.model.datatypes import Array, EngineFailure, Model, State, Trajectory
from plumbline.model.kinematics import joint_coordinates, quaternion_rate
from reference_impl.fast.collocation import integrate_collocation
from reference_impl.fast.tree_elimination import eliminated_acceleration, eliminated_system
from reference_impl.integrate import IntegrationResult, integrate_dop853

NotesIntegrator = Literal["collocation", "dop853"]


def simulate_notes_form(
    model: Model, state: State, times: Array, rtol: float, method: NotesIntegrator = "collocation"
) -> Trajectory:
    """Integrate the notes' equations, by collocation on the manifold or in the raw form (N6) by DOP853.

    After 2 s, the motion on the manifold differs from the truth by 2e-14 m on thirty ball joints and 5e-14 m
    on fifty, the raw form by 7e-13 m and 2e-12 m at any tolerance, because it drifts.

    Args:
        times: (T,) [s] of the samples, times[0] = 0.
        rtol: relative tolerance.

    Returns:
        The motion at ``times``.

    Raises:
        EngineFailure: the integrator stops early.

    """
    start, x = (
        (state.r, state.p, state.v, quaternion_rate(state.p, state.omega)),
        joint_coordinates(model, state)[2],
    )
    run: IntegrationResult
    try:
        if (
            method == "dop853"
        ):  # absolute tolerances of 1 m, 1, 1 m/s and 1 1/s: those by default are too coarse
            form = eliminated_acceleration(model)
            run = integrate_dop853(model, *start, times, rtol, form, x=x, atol=rtol)
        else:
            system = eliminated_system([model], x)
            run = integrate_collocation(system, *start, times, rtol, project=True)
    except ArithmeticError as error:
        raise EngineFailure(str(error)) from None
    return Trajectory(times, run.r, run.p, run.v, run.pdot, run.steps, state.x)
