"""Until when the motion of a mechanism with loops is regular: its accelerations are unique.

Near a singular pose the rows that close the loops lose rank; what follows from them loses digits as their
smallest singular value falls, and beyond the pose another branch may go on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from plumbline.model.datatypes import Array, Model, State, Trajectory
from plumbline.model.kinematics import (
    angular_velocity,
    joint_coordinates,
    quaternion_rate,
    with_joint_coordinates,
)
from plumbline.model.loops import MIN_MOTION_SINGULAR_VALUE, regular_rank, smallest_singular_value
from reference_impl.fast.collocation import integrate_collocation
from reference_impl.fast.tree_elimination import eliminated_system

RTOL = 1e-9
PARTS = 4  # of a stride, at which singular values are taken
SHORTEST_STRIDE = 1e-3  # of the time between samples


class RegularMotion(NamedTuple):
    """How long a motion is regular."""

    end: float  # s
    is_singular: bool  # whether it ends before the last sample
    singular_value: float  # at the end


def regular_motion(model: Model, state: State, times: Array) -> RegularMotion:
    """Follow a motion until it comes near a singular pose.

    Strides are so short that a singular value that goes on to fall as it falls cannot reach 0 within one.

    Args:
        model: with loops.
        state: initial state, assembled.
        times: (T,) [s] of the samples, times[0] = 0.

    Returns:
        How long the smallest singular value of the rows that hold is at least `MIN_MOTION_SINGULAR_VALUE`.

    Raises:
        ArithmeticError: the integration stops early for another reason.

    """
    rank = regular_rank(model, state)
    t, last, value = 0.0, float(times[-1]), smallest_singular_value(model, state, rank)
    longest = stride = float(np.min(np.diff(times)))
    here, x = (
        (state.r, state.p, state.v, quaternion_rate(state.p, state.omega)),
        joint_coordinates(model, state)[2],
    )
    while t < last * (1 - 1e-12) and value >= MIN_MOTION_SINGULAR_VALUE:
        stride = min(stride, last - t)
        grid = t + stride * np.linspace(0, 1, PARTS + 1)
        try:
            run = integrate_collocation(eliminated_system([model], x), *here, grid, RTOL, project=True)
            poses = zip(run.r[1:], run.p[1:], run.v[1:], run.pdot[1:], strict=True)
            values = np.array(
                [value, *(smallest_singular_value(model, _state(model, state, *y), rank) for y in poses)]
            )
            is_safe = bool(np.all(2 * values[1:] - values[:-1] > 0))  # the next value as the last two go on
        except ArithmeticError:
            if stride < SHORTEST_STRIDE * longest and value > 10 * MIN_MOTION_SINGULAR_VALUE:
                raise
            is_safe = False
        if is_safe:
            t, value, x = float(grid[-1]), float(values[-1]), run.x[-1]
            here, stride = (run.r[-1], run.p[-1], run.v[-1], run.pdot[-1]), min(2 * stride, longest)
        elif stride < SHORTEST_STRIDE * longest:
            return RegularMotion(t, True, value)
        else:
            stride /= 2
    return RegularMotion(t, value < MIN_MOTION_SINGULAR_VALUE, value)


def first_doubt(model: Model, state: State, run: Trajectory) -> float | None:
    """Find out from the samples of a run whether a singular pose may be among or between them.

    Args:
        model: with loops.
        state: its initial state, assembled.
        run: T samples, its loops closed but for the error of steps.

    Returns:
        The time [s] of the first sample whose singular value is below `MIN_MOTION_SINGULAR_VALUE`, or would
        reach 0 before the next one, falling on as it fell: a value that falls to 0 evenly, between samples,
        and rises again is noticed in any case.  None where there is no such sample.

    """
    rank, before = regular_rank(model, state), 0.0
    for t, *sample in zip(run.t, run.r, run.p, run.v, run.pdot, strict=True):
        value = smallest_singular_value(model, _state(model, state, *sample), rank)
        if value < MIN_MOTION_SINGULAR_VALUE or 2 * value <= before:
            return float(t)
        before = value
    return None


def _state(model: Model, start: State, r: Array, p: Array, v: Array, pdot: Array) -> State:
    """The state of a motion's bodies."""
    p = p / np.linalg.norm(p, axis=1, keepdims=True)
    moved = State(p, angular_velocity(p, pdot), start.u, start.udot, r, v, start.x, start.xdot)
    return with_joint_coordinates(model, moved)
