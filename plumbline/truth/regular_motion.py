"""Until when the motion of a mechanism with loops is regular: its accelerations are unique.

Near a singular pose the rows that close the loops lose rank; what follows from them loses digits as their
smallest singular value falls, and beyond the pose another branch may go on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import (
    angular_velocity,
    joint_coordinates,
    quaternion_rate,
    with_joint_coordinates,
)
from plumbline.model.loops import MIN_MOTION_SINGULAR_VALUE, smallest_singular_value
from reference_impl.collocation import integrate_collocation
from reference_impl.tree_elimination import eliminated_system

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
    t, last, value = 0.0, float(times[-1]), smallest_singular_value(model, state)
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
                [value, *(smallest_singular_value(model, _state(model, state, *y)) for y in poses)]
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


def _state(model: Model, start: State, r: Array, p: Array, v: Array, pdot: Array) -> State:
    """The state of a motion's bodies."""
    p = p / np.linalg.norm(p, axis=1, keepdims=True)
    moved = State(p, angular_velocity(p, pdot), start.u, start.udot, r, v, start.x, start.xdot)
    return with_joint_coordinates(model, moved)
