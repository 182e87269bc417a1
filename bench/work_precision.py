"""Work–precision: CPU time to come within an error at t = 2 s, integrator by integrator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from time import process_time

import numpy as np

from plumbline.engines.adapter import Adapter
from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import maximal_coordinates
from reference_impl.fast.collocation import integrate_collocation
from reference_impl.fast.tree_elimination import fastest_acceleration
from reference_impl.integrate import integrate_dop853

SAMPLE_TIMES = np.array([0.0, 2.0])
TOLERANCES = (1e-3, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-12)


@dataclass(frozen=True)
class WorkPrecisionPoint:
    """One run: step or tolerance, error at the end [m] and CPU time [s]."""

    resolution: float
    error: float
    seconds: float


def reference_positions(model: Model, states: Sequence[State]) -> Array:
    """Compute the positions at t = 2 s by collocation at the tightest tolerance, state by state.

    Args:
        model: the pendulum, N bodies.

    Returns:
        Positions of all bodies (BN, 3) [m].

    """
    runs = [
        integrate_collocation([model], *maximal_coordinates(state), SAMPLE_TIMES, 1e-14) for state in states
    ]
    return np.concatenate([run.r[-1] for run in runs])


def measure_run(
    run: Callable[[], Array], expected: Array, resolution: float, repeats: int = 3
) -> WorkPrecisionPoint:
    """Repeat a run and keep the shortest CPU time.

    Args:
        run: computes the positions at the end (BN, 3) [m].
        expected: the exact positions (BN, 3) [m].
        resolution: step [s] or tolerance, kept with the result.

    Returns:
        Largest error of a body and the shortest CPU time.

    """
    seconds = []
    for _ in range(repeats):
        start = process_time()
        found = run()
        seconds.append(process_time() - start)
    return WorkPrecisionPoint(
        resolution, float(np.max(np.linalg.norm(found - expected, axis=-1))), min(seconds)
    )


def collocation_curve(model: Model, states: Sequence[State], expected: Array) -> list[WorkPrecisionPoint]:
    """Measure the reference's collocation on all states in one batch.

    Args:
        expected: positions at the end (BN, 3) [m].

    Returns:
        One point per tolerance; the time of a run of one step is subtracted.

    """
    chains, start, points = [model] * len(states), maximal_coordinates(*states), []
    for rtol in TOLERANCES:

        def run(until: Array, rtol: float = rtol) -> Array:
            return integrate_collocation(chains, *start, until, rtol, dense=False).r[-1]

        setup = measure_run(lambda run=run: run(SAMPLE_TIMES * 5e-4), expected, rtol).seconds
        point = measure_run(lambda run=run: run(SAMPLE_TIMES), expected, rtol)
        points.append(WorkPrecisionPoint(rtol, point.error, point.seconds - setup))
    return points


def dop853_curve(
    model: Model, states: Sequence[State], expected: Array, structured: bool
) -> list[WorkPrecisionPoint]:
    """Measure the reference's DOP853, state by state.

    Args:
        expected: positions at the end (BN, 3) [m].
        structured: whether the structured form evaluates the right-hand side; else the direct form.

    Returns:
        One point per tolerance.

    """

    def run(rtol: float) -> Array:
        ends = [
            integrate_dop853(
                model,
                *maximal_coordinates(state),
                SAMPLE_TIMES,
                rtol,
                acceleration=fastest_acceleration(model) if structured else None,
            ).r[-1]
            for state in states
        ]
        return np.concatenate(ends)

    return [measure_run(lambda rtol=rtol: run(rtol), expected, rtol, 1) for rtol in TOLERANCES[1::2]]


def fixed_step_curve(
    engine: Adapter,
    integrator: str,
    model: Model,
    states: Sequence[State],
    expected: Array,
    max_seconds: float,
) -> list[WorkPrecisionPoint]:
    """Measure an engine's own integrator with a fixed step, halved until a run takes too long.

    Args:
        expected: positions at the end (BN, 3) [m].
        max_seconds: CPU time of a run [s] after which no finer step is tried.

    Returns:
        One point per step; the time of a run of one step, which builds the engine's model, is subtracted.

    """
    points = []
    for step in (1.6e-2, 8e-3, 4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4, 1.25e-4, 6.25e-5):

        def run(until: Array, step: float = step) -> Array:
            runs = [engine.simulate(model, state, until, integrator, step) for state in states]
            return np.concatenate([run.r[-1] for run in runs])

        setup = measure_run(lambda step=step: run(np.array([0.0, step])), expected, step, 2).seconds
        point = measure_run(lambda: run(SAMPLE_TIMES), expected, step, 2)
        if point.seconds > setup:  # else the time is that of building the model
            points.append(WorkPrecisionPoint(step, point.error, point.seconds - setup))
        if point.seconds > max_seconds:
            break
    return points


def cost_at_error(points: Sequence[WorkPrecisionPoint], error: float) -> float:
    """Interpolate the cost of an error on a work–precision curve, log–log between its points.

    Args:
        points: the curve, coarsest first.
        error: position error [m].

    Returns:
        CPU time [s] at which the curve first reaches the error; NaN if it never does.

    """
    for worse, better in pairwise(points):
        if better.error <= error < worse.error:
            weight = np.log(error / worse.error) / np.log(better.error / worse.error)
            return float(np.exp((1 - weight) * np.log(worse.seconds) + weight * np.log(better.seconds)))
    return points[0].seconds if points and points[0].error <= error else float("nan")
