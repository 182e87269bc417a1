"""Truth along a trajectory, with an uncertainty that is earned by two methods that share nothing.

Heyoka's Taylor method in minimal coordinates at extended precision, and the notes' form by the
reference's collocation in double: other equations, other coordinates, another integrator.  What they differ
by is the uncertainty.  Quad precision is the yardstick of the first (tests).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plumbline.kinematics import rate
from plumbline.measures import attitude_error, position_error
from plumbline.records import Array, Model, State, Trajectory
from plumbline.registry import adapter
from plumbline.truth.taylor import taylor

RTOL = 1e-14  # of the collocation: the notes' form is then limited by rounding
COMPILED = 10  # bodies: 20 s to compile ten, a minute for thirty


@dataclass(frozen=True, eq=False)
class TrajectoryTruth:
    """The motion, and by how much it may be off: running maxima (T,) over bodies, m and rad."""

    trajectory: Trajectory
    position_uncertainty: Array
    attitude_uncertainty: Array
    method: str


def trajectory_truth(model: Model, state: State, times: Array, compiled: int = COMPILED) -> TrajectoryTruth:
    """The motion from ``state`` at ``times`` (T,) s, times[0] = 0.

    Chains of more than ``compiled`` bodies take DOP853 on the notes' form in heyoka's place: another
    integrator but the same equations, and the method says so.  Raises TruthUnavailable without heyoka.
    """
    reference = adapter("reference")
    notes = reference.simulate(model, state, times, "collocation", RTOL)
    if model.n > compiled:
        other = reference.simulate(model, state, times, "dop853", 1e-13)
        run, method = notes, "the notes' form by collocation; uncertainty: its difference from DOP853"
    else:
        found = taylor(model, state, times, "extended")
        p, omega = np.asarray(found.p, float), np.asarray(found.omega, float)
        r, v = np.asarray(found.r, float), np.asarray(found.v, float)
        run, other = Trajectory(times, r, p, v, rate(p, omega), found.steps), notes
        method = (
            "Taylor's method in minimal coordinates and extended precision; uncertainty: its difference "
            "from the notes' form by collocation"
        )
    return TrajectoryTruth(
        run,
        np.maximum.accumulate(position_error(run.r, other.r)),
        np.maximum.accumulate(attitude_error(run.p, other.p)),
        method,
    )
