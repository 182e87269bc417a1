"""Answers of engines at a state, and along a short motion, compared with what is true."""

from __future__ import annotations

import numpy as np
import pytest

from plumbline.engines.adapter import Adapter
from plumbline.model.datatypes import Array, Integrator, Model, State, StateQuantities, Trajectory
from plumbline.model.invariants import attitude_error, position_error
from plumbline.model.kinematics import quaternion_rate
from plumbline.truth import TruthUnavailable
from plumbline.truth.rounding_bound import MAX_RELATIVE_BOUND, RoundingBound
from plumbline.truth.taylor import simulate_taylor
from tests.helpers.pendulums import reference_trajectory


def sizes(x: Array | float) -> Array:
    """Sizes of vectors, magnitudes of numbers."""
    return np.linalg.norm(x, axis=-1) if np.shape(x)[-1:] == (3,) else np.abs(x)


def assert_within_bound(found: StateQuantities, truth: StateQuantities, bound: RoundingBound) -> None:
    """Every quantity that has a value and a true value is as near as rounding allows, which is near."""
    compared = 0
    for name in bound.scale:
        answer, value = getattr(found, name), getattr(truth, name)
        if answer is None or value is None:
            continue
        allowed = bound.tolerance(name) + (found.limit_error or {}).get(name, 0.0)
        assert np.all(sizes(np.asarray(answer - value)) <= allowed), name
        assert bound.relative_bound(name) < MAX_RELATIVE_BOUND, name
        compared += 1
    assert compared >= 3


def assert_reported(found: StateQuantities, truth: StateQuantities, bound: RoundingBound) -> None:
    """The accelerations differ from the true ones by more than rounding."""
    assert np.any(sizes(found.acceleration - truth.acceleration) > bound.acceleration)


def true_trajectory(model: Model, state: State, times: Array) -> Trajectory:
    """The motion by Taylor's method in extended precision; by the reference where heyoka is missing."""
    try:
        run, steps = simulate_taylor(model, state, times, "extended")
    except TruthUnavailable:
        return reference_trajectory(model, state, times)
    r, p, v, omega = (np.asarray(getattr(run, name), float) for name in ("r", "p", "v", "omega"))
    return Trajectory(times, r, p, v, quaternion_rate(p, omega), steps)


def converging_runs(
    adapter: Adapter,
    method: Integrator,
    model: Model,
    state: State,
    true: Trajectory,
    resolutions: tuple[float, float],
    order_margin: float,
    floor: float = 0.0,
) -> tuple[list[Trajectory], list[float]]:
    """Two runs and their final errors, whose fall must be that of the method's order above a floor."""
    runs = [adapter.simulate(model, state, true.t, method.name, size) for size in resolutions]
    errors = [float(position_error(x.r, true.r)[-1] + attitude_error(x.p, true.p)[-1]) for x in runs]
    if method.kind == "step" and errors[1] > floor:
        order = np.log2(errors[0] / errors[1])
        assert order == pytest.approx(method.order, abs=order_margin), (method.name, errors)
    return runs, errors
