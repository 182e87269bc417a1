"""Truth along a trajectory, with an uncertainty that is earned by two methods that share nothing.

Heyoka's Taylor method in minimal coordinates, and the notes' form on its manifold by the reference's
collocation: other equations, other coordinates, another integrator.  What they differ by is the
uncertainty.  It is the second's rounding: in extended precision the first is better by far, as quad precision
says, which is its yardstick (tests).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from plumbline.model.datatypes import Array, Model, State, Trajectory
from plumbline.model.invariants import attitude_error, position_error
from plumbline.model.kinematics import quaternion_rate
from plumbline.truth import TruthUnavailable
from plumbline.truth.notes_motion import simulate_notes_form
from plumbline.truth.taylor import Precision, simulate_taylor

NOTES_RTOL = 1e-13  # of the notes' form: at 1e-14 it is no closer to extended precision, the rest is rounding
MAX_EXTENDED_PRECISION_BODIES = (
    5  # bodies: 2 s of ten take 2.0 s in extended precision, 0.6 s in double; fifty 14 s and 4 s
)
MAX_COMPILED_BODIES = 50  # bodies: 2 s to compile fifty
ClosedFormSamples = tuple[Array, Array, str]  # a closed form's r (T, N, 3) m, p (T, N, 4), and its source


@dataclass(frozen=True, eq=False)
class TrajectoryTruth:
    """The motion, and by how much it may be off: running maxima (T,) over bodies, m and rad."""

    trajectory: Trajectory
    position_uncertainty: Array
    attitude_uncertainty: Array
    method: str


def trajectory_truth(
    model: Model,
    state: State,
    times: Array,
    closed_form: ClosedFormSamples | None = None,
    max_compiled_bodies: int = MAX_COMPILED_BODIES,
) -> TrajectoryTruth:
    """The motion from ``state`` at ``times`` (T,) s, times[0] = 0; r and p are those of ``exact`` if given.

    Without heyoka, where it fails and for more than ``compiled`` bodies, DOP853 on the notes' form stands in:
    another integrator but the same equations, and the method says so and why.
    Raises EngineFailure where the notes' form stops early.
    """
    try:
        run, method = simulate_minimal_coordinates(model, state, times, max_compiled_bodies)
    except Exception as error:  # whatever befell heyoka, the truth is not lost for it
        run, method = simulate_notes_form(model, state, times, NOTES_RTOL), "the notes' form by collocation"
        if closed_form is None:
            other = simulate_notes_form(model, state, times, NOTES_RTOL, "dop853")
            why = error if isinstance(error, TruthUnavailable) else f"{type(error).__name__}: {error}"
            against = f"the same by DOP853, no Taylor series: {why}"
    else:
        if closed_form is None:
            other, against = (
                simulate_notes_form(model, state, times, NOTES_RTOL),
                "the notes' form by collocation",
            )
    if closed_form is not None:
        r, p, source = closed_form
        other, against, method = run, method, f"closed form: {source}"
        run = replace(run, r=r, p=p)
    return TrajectoryTruth(
        run,
        np.maximum.accumulate(position_error(run.r, other.r)),
        np.maximum.accumulate(attitude_error(run.p, other.p)),
        f"{method}; uncertainty: its difference from {against}",
    )


def simulate_minimal_coordinates(
    model: Model, state: State, times: Array, max_compiled_bodies: int
) -> tuple[Trajectory, str]:
    """The motion by Taylor's method in minimal coordinates, and what to call that."""
    if model.n > max_compiled_bodies:
        raise TruthUnavailable(f"not asked of more than {max_compiled_bodies} bodies")
    precision: Precision = "extended" if model.n <= MAX_EXTENDED_PRECISION_BODIES else "double"
    found = simulate_taylor(model, state, times, precision)
    r, p, v, omega = (np.asarray(getattr(found, name), float) for name in ("r", "p", "v", "omega"))
    run = Trajectory(times, r, p, v, quaternion_rate(p, omega), found.steps)
    return run, f"Taylor's method in minimal coordinates and {precision} precision"
