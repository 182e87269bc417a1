"""In which steps of a run an engine differs: what these have in common, and no step that agrees.

Steps that differ are described by their numbers (from one on, a range, a period), and by a bound of a
quantity of the motion at their start: positions of joints, turns of joints from their reference pose, rates.
A condition holds in every step that differs; those count that fewest steps meet which agree.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from plumbline.diagnosis.cause import Condition, Occurrence, significant
from plumbline.diagnosis.edits import coordinate_place
from plumbline.model.datatypes import Array, Model, State, Trajectory
from plumbline.model.kinematics import (
    angular_velocity,
    coordinates_of_joints,
    quaternion_conjugate,
    quaternion_product,
)

MIN_STEPS = 6  # that differ, and that agree: of fewer, some quantity is the largest by chance
MIN_PERIODS = 3
MAX_EXCEPTIONS = 0.1  # of the steps that meet a condition
NEARLY_ALL = 0.01  # of all steps: where no more agree, every step differs
Mask = NDArray[np.bool_]
Candidate = tuple[Condition, Mask]  # and the steps that meet it


def occurrence_in_run(model: Model, motion: Trajectory, differs: Mask, is_compared: Mask) -> Occurrence:
    """Describe the steps of a run that differ.

    Args:
        motion: the engine's samples, one per step.
        differs: (steps,) at least one.
        is_compared: (steps,) whether a step has a bound.

    """
    first, agrees = int(np.argmax(differs)), is_compared & ~differs
    candidates = list(_of_numbers(differs))
    if min(np.count_nonzero(differs), np.count_nonzero(agrees)) >= MIN_STEPS:
        candidates += _of_motion(model, motion, differs, agrees)
    exceptions = [int(np.count_nonzero(agrees & meets)) for _, meets in candidates]
    fewest = min(exceptions)
    if exceptions[0] <= NEARLY_ALL * len(differs):
        candidates, exceptions, fewest = candidates[:1], exceptions[:1], exceptions[0]
    conditions = [
        condition
        for (condition, meets), count in zip(candidates, exceptions, strict=True)
        if count == fewest and count <= MAX_EXCEPTIONS * np.count_nonzero(meets & is_compared)
    ]
    time = float(motion.t[first])
    counts = int(np.count_nonzero(differs)), int(np.count_nonzero(is_compared))
    return Occurrence(first + 1, time, *counts, tuple(conditions), fewest)


def _of_numbers(differs: Mask) -> Iterator[Candidate]:
    """Every step, a range of steps, every so many."""
    number, at = np.arange(len(differs)), np.flatnonzero(differs)
    first, last = int(at[0]), int(at[-1])
    yield Condition("step", period=1), np.ones_like(differs)
    bounds = first + 1.0, None if last == number[-1] else last + 1.0
    if bounds != (1.0, None):
        yield Condition("step", "", *bounds), (number >= first) & (number <= last)
    period = math.gcd(*np.diff(at).tolist())
    if period > 1 and len(at) >= MIN_PERIODS:
        yield Condition("step", period=period), (number - first) % period == 0


def _of_motion(model: Model, motion: Trajectory, differs: Mask, agrees: Mask) -> Iterator[Candidate]:
    """Bounds of quantities at the start of the steps."""
    quantities = [(name, unit, x[: len(differs)]) for name, unit, x in _quantities(model, motion)]
    quantities += [
        (f"size of the {name}", unit, np.abs(x))
        for name, unit, x in quantities
        if np.min(x[differs]) < 0 < np.max(x[differs])
    ]
    for name, unit, x in quantities:
        for sign in (1.0, -1.0):
            wrong, right = sign * x[differs], sign * x[agrees]
            least, below = np.min(wrong), right[right < np.min(wrong)]
            if not len(below):
                continue
            between = (least + np.max(below)) / 2
            bound = significant(float(sign * between), math.inf, float((least - np.max(below)) / 2))
            bounds = (bound, None) if sign > 0 else (None, bound)
            yield Condition(name, unit, *bounds), sign * x >= least


def _quantities(model: Model, motion: Trajectory) -> Iterator[tuple[str, str, Array]]:
    """Names, units and values (samples,) of positions and rates."""
    p, omega = motion.p, angular_velocity(motion.p, motion.pdot)
    bodies = State(p, omega, r=motion.r, v=motion.v)
    _, _, coordinates, _ = coordinates_of_joints(model, bodies, range(model.n))
    for k, kind in enumerate(model.kinds[: model.n]):
        for i, (what, _) in enumerate(kind.motions):
            x, place = coordinates[:, k, i], coordinate_place(model, k, i)
            if what == "slide":
                yield f"position of {place}", " m", x
            else:
                yield f"angle of {place}", " rad", np.unwrap(x)
        if kind.has_attitude:
            yield f"turn of joint {k + 1}", " rad", _turn(model, p, k)
        yield f"angular velocity of body {k + 1}", " rad/s", np.linalg.norm(omega[:, k], axis=-1)
    if motion.velocities is not None:
        yield "largest rate of a coordinate", "", np.max(np.abs(motion.velocities), axis=-1)


def _turn(model: Model, p: Array, k: int) -> Array:
    """Angle (samples,) [rad] by which a body is turned against its far body."""
    far = int(model.body[k, 0])
    own = p[:, k] if far < 0 else quaternion_product(quaternion_conjugate(p[:, far]), p[:, k])
    return np.asarray(2 * np.arccos(np.minimum(np.abs(own[:, 0]), 1.0)))
