"""Accelerations of bodies from those of joint coordinates, which is all that many engines return.

The derivative of the forward kinematics along the motion, by a complex step: x(t + i h) = x + i h ẋ is exact
to rounding for a tiny h, because nothing is subtracted.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from plumbline.model.datatypes import Array, EngineFailure, Float, JointKind, Model, State
from plumbline.model.kinematics import complete_state, quaternion_rate, rotate_vectors, rotation_matrix

BallRates = Literal["body", "relative, near axes", "relative, far axes"]
_STEP = 2.0**-300


def lift_acceleration(
    model: Model, state: State, joints: Float[Array, "nu"], ball_rates: BallRates, label: str
) -> tuple[Float[Array, "bodies 3"], Float[Array, "bodies 3"]]:
    """Compute the accelerations of all bodies from those of the joint coordinates.

    Args:
        joints: joint by joint of the tree: ü and ω̇′ of rods, ω̇′ of balls, r̈ and ω̇′ of free bodies, ẍ of the
            others.
        ball_rates: what stands for ω̇′ of balls: itself, or the rate of ω − ω_far in the axes of one of the
            bodies.
        label: what returned the numbers, for the message.

    Returns:
        r̈, world frame, and ω̇′, body frame.

    Raises:
        EngineFailure: there are more numbers, or fewer.

    """
    tree = model.tree
    sizes = [_count(kind) for kind in tree.kinds]
    if joints.shape != (sum(sizes),):
        raise EngineFailure(f"{label} has shape {joints.shape}, expected ({sum(sizes)},)")
    rates = {"p": quaternion_rate(state.p, state.omega), "u": state.udot, "r": state.v, "x": state.xdot}
    # the minimal coordinates a moment later
    moved = {name: x + _STEP * 1j * rates.get(name, 0.0) for name, x in vars(state).items()}
    given = np.split(joints, np.cumsum(sizes)[:-1])
    for k, (kind, own) in enumerate(zip(tree.kinds, given, strict=True)):
        step = _STEP * 1j * own
        if not kind.has_attitude:
            moved["xdot"][k, : len(step)] += step
            continue
        if kind.holds_distance:
            moved["udot"][k] += step[:3]
        elif kind.holds_nothing:
            moved["v"][k] += step[:3]
        if kind.is_spherical and ball_rates != "body":
            moved["omega"][k] = _absolute_rate(model, state, moved, k, step[-3:], ball_rates)
        else:
            moved["omega"][k] += step[-3:]
    later = complete_state(model, State(**moved))
    return later.v.imag / _STEP, later.omega.imag / _STEP


def _count(kind: JointKind) -> int:
    """How many numbers a joint has in the list."""
    if not kind.has_attitude:
        return len(kind.motions)
    return 3 if kind.is_spherical else 6


def _absolute_rate(
    model: Model, state: State, moved: dict[str, Any], k: int, step: Any, ball_rates: BallRates
) -> Array:
    """ω′ of the body on ball joint k a moment later, from its relative angular velocity."""
    far = int(model.body[k, 0])
    near_axes = rotation_matrix(state.p[k])
    later = rotation_matrix(moved["p"][k])
    if far < 0:
        spin, spin_later, above, above_later = np.zeros(3), np.zeros(3), np.eye(3), np.eye(3)
    else:  # the bodies before k are complete
        before = complete_state(model, State(**moved))
        above, above_later = rotation_matrix(state.p[far]), rotation_matrix(before.p[far])
        spin = rotate_vectors(above, state.omega[far])
        spin_later = rotate_vectors(above_later, before.omega[far])
    if ball_rates == "relative, near axes":
        axes, axes_later = near_axes, later
    else:
        axes, axes_later = above, above_later
    relative = axes.T @ (near_axes @ state.omega[k] - spin) + step
    return np.asarray(later.T @ (spin_later + axes_later @ relative))
