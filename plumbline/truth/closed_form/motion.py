"""Result type, conditions and geometry that the families of closed-form motions share.

Notation: ẑ is up (against gravity), c the body axis from the pivot to the centre of mass; quaternions have
their scalar first and rotate body vectors into world vectors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import rotation_matrix
from plumbline.processes.exceptions import PlumblineError

CONDITION_RTOL = 1e-12  # relative: by how much rounded inputs may violate a condition


class ClosedFormMismatch(PlumblineError, ValueError):
    """The scenario violates a condition of its closed form; the message names the condition."""


@dataclass(frozen=True)
class ClosedFormMotion:
    """A motion known in closed form.

    ``evaluate`` maps times (T,) [s] to positions r (T, N, 3) [m] and attitudes p (T, N, 4); ``source`` names
    the book and section.  ``amplitude`` [rad] is 0 for an exact solution; for small oscillations it is the
    largest angle, and the relative error is of the order of its square, growing with time as the true
    frequencies differ from the linear ones.
    """

    evaluate: Callable[[Array], tuple[Array, Array]]
    source: str
    amplitude: float = 0.0

    def __call__(self, times: Array) -> tuple[Array, Array]:
        """Evaluate the motion.

        Args:
            times: (T,) [s] since the initial state.

        Returns:
            Centres of mass r (T, N, 3) [m], world frame, and attitudes p (T, N, 4), body → world.

        """
        return self.evaluate(np.atleast_1d(np.asarray(times, dtype=float)))


def require(holds: bool | np.bool_, condition: str) -> None:
    """Refuse a scenario that violates a condition.

    Args:
        condition: completes "this closed form needs …".

    Raises:
        ClosedFormMismatch: ``holds`` is false.

    """
    if not holds:
        raise ClosedFormMismatch(f"this closed form needs {condition}")


def require_gravity_without_loads(model: Model) -> tuple[Array, float]:
    """Check that gravity is the only applied force.

    Returns:
        The upward unit vector (3,), world frame, and |g| [m/s²].

    Raises:
        ClosedFormMismatch: there are loads or drag, or no gravity.

    """
    require_no_loads(model)
    gravity = float(np.linalg.norm(model.gravity))
    require(gravity > 0, "gravity")
    return -model.gravity / gravity, gravity


def require_no_loads(model: Model) -> None:
    """Check that no force, moment or drag is applied.

    Raises:
        ClosedFormMismatch: there are loads or drag.

    """
    require(not model.has_loads and not model.has_drag, "no loads and no drag")


def require_single_body(model: Model, rod: bool) -> None:
    """Check that the mechanism is one body on the right kind of joint.

    Args:
        rod: whether the joint must be a rod; otherwise it must be a ball joint.

    Raises:
        ClosedFormMismatch: there are more bodies or the joint is of the other kind.

    """
    require(model.n == 1, "one body")
    require(bool(model.rods[0]) == rod, "a rod" if rod else "a ball joint")


def require_heavy_body_on_ball(model: Model, state: State) -> tuple[Array, Array, float, float]:
    """Check that the mechanism is one body on a ball joint, driven by gravity alone.

    Returns:
        The body's rotation matrix A (3, 3), the upward unit vector (3,) in the world frame, |g| [m/s²] and
        the distance from the pivot to the centre of mass [m].

    Raises:
        ClosedFormMismatch: the scenario is not of that kind.

    """
    up, gravity = require_gravity_without_loads(model)
    require_single_body(model, rod=False)
    lever = float(np.linalg.norm(model.proximal[0]))
    require(lever > 0, "a lever between pivot and centre of mass")
    return rotation_matrix(state.p[0]), up, gravity, lever


def inertia_about_pivot(model: Model) -> Array:
    """Return the inertia of the first body about the pivot (parallel-axis theorem).

    Args:
        model: a mechanism whose first joint is a ball joint.

    Returns:
        (3, 3) [kg m²], body frame.

    """
    s = model.proximal[0]
    return np.asarray(model.inertia[0] + model.mass[0] * (s @ s * np.eye(3) - np.outer(s, s)))


def axis_angle_quaternions(axis: Array, angle: Array) -> Array:
    """Return the quaternions of rotations about one axis.

    Args:
        axis: (3,) unit vector.
        angle: (T, ...) [rad].

    Returns:
        (T, ..., 4) unit quaternions.

    """
    half = np.asarray(angle)[..., None] / 2
    return np.concatenate([np.cos(half), np.sin(half) * axis], -1)
