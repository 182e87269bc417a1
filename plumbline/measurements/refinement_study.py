"""A refinement study that stops where a finer step could not lower its bounds; runs inside a worker.

A verdict on a limit has the bound T = U + R G + (uncertainty of the truth): U the uncertainty of the limit
(`romberg`), R the rounding of a run, G ≥ 1 the growth of perturbations.  R does not fall with the step:
whatever a finer study finds, its bound T′ is R at least.  Where U ≤ μ R therefore

    T ≤ T′ + U ≤ (1 + μ) T′,      μ = `STOP_MARGIN`:

the smallest mistake that the verdict detects is at most μ larger than with all steps.  Of an invariant the
rounding is that of all steps, and in the next run twice as large: there U ≤ R is enough for T ≤ T′.

The rule is given the model and the engine's own runs, and nothing of the truth: a wrong truth cannot end a
study, and a study whose order or whose limit is not resolved goes on to its finest step.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from plumbline.engines import engine_calls
from plumbline.engines.engine_calls import RefinementRun, RefinementStudy
from plumbline.measurements.order_and_limit import ORDER_MARGIN, max_norm, observed_order, romberg
from plumbline.model.datatypes import Array, Float, Integrator, Model, State, Trajectory
from plumbline.model.invariants import INVARIANT_UNITS, Invariants, compute_invariants, invariant_scales
from plumbline.model.kinematics import stretched_length
from plumbline.truth.ground_truth import RUN_ROUNDING  # a constant, no truth

ROUNDING_PER_STEP = 8 * 2.0**-52  # of an invariant, relative to its scale: a handful of operations
STOP_MARGIN = 1 / 8  # μ: what a finer step could lower a bound by, relative to the bound
MIN_RUNS = 4  # three differences between consecutive runs, two orders


def run_refinement_study(
    engine: str,
    integrator: str,
    model: Model,
    state: State,
    times: Float[Array, "samples"],
    steps: Sequence[float],
) -> RefinementStudy:
    """Simulate the same motion at each step until the study is resolved.

    Args:
        times: sample times [s].
        steps: steps [s] or relative tolerances, coarse to fine.

    Returns:
        The runs; of a method with step control at every tolerance.

    Raises:
        MemoryError: the worker reached its memory limit, which the pool reports.

    """
    return engine_calls.run_refinement(engine, integrator, model, state, times, steps, is_resolved)


def scaled_states(
    r: Sequence[Float[Array, "samples bodies 3"]],
    v: Sequence[Float[Array, "samples bodies 3"]],
    length: float,
    speed: float,
) -> list[Float[Array, "samples bodies 6"]]:
    """Put positions and velocities of each run side by side, over their scales.

    Args:
        length: scale of positions [m].
        speed: that of velocities [m/s]; 0 where nothing moves, and every scale is as good.

    """
    return [np.concatenate([a / length, b / (speed or 1.0)], axis=-1) for a, b in zip(r, v, strict=True)]


def is_resolved(model: Model, integrator: Integrator, runs: Sequence[RefinementRun]) -> bool:
    """Return whether order and limits are resolved, so that a finer step could lower no bound by much.

    Args:
        runs: coarse to fine.

    Returns:
        True where the observed order is the declared one, or every difference is rounding, and the limits of
        positions, attitudes and all invariants are known to `STOP_MARGIN` of rounding.

    """
    after_failures = list(itertools.takewhile(lambda run: run.trajectory is not None, reversed(runs)))[::-1]
    trajectories = [run.trajectory for run in after_failures if run.trajectory is not None]
    if integrator.kind != "step" or len(trajectories) < MIN_RUNS:
        return False
    finest, length = trajectories[-1], float(np.sum(stretched_length(model)))
    scales = invariant_scales(model, finest, length)
    r, p, v = (run_samples(after_failures, name) for name in "rpv")
    order = observed_order(
        scaled_states(r, v, length, scales["gap_rate"]), RUN_ROUNDING / 8, integrator.order
    )
    is_declared = order.is_asymptotic and abs((order.value or 0.0) - integrator.order) <= ORDER_MARGIN
    if not (is_declared or order.is_at_rounding_floor):
        return False
    rounding = RUN_ROUNDING + finest.solver_rtol * np.sqrt(finest.steps)
    for samples, scale in ((r, length), (p, 1.0)):  # |δp| is half an angle, whose scale is 2
        limit = romberg(samples, integrator.error_exponents)
        if limit.uncertainty[-1] > STOP_MARGIN * rounding * scale:
            return False
    drifts = [_invariants(model, trajectory) for trajectory in trajectories]
    for name in INVARIANT_UNITS:
        series = [getattr(drift, name) for drift in drifts]
        floor = rounding_floor(finest.steps, scales[name])
        if series[-1] is None or max_norm(series[-1]) <= floor:
            continue
        if romberg(series, integrator.error_exponents).uncertainty[-1] > floor:
            return False
    return True


@lru_cache(maxsize=8)  # every further run of a study asks for those of all before
def _invariants(model: Model, run: Trajectory) -> Invariants:
    return compute_invariants(model, run)


def run_samples(runs: Sequence[RefinementRun], name: str) -> list[Float[Array, "samples bodies width"]]:
    """Collect one field of all runs of a study.

    Args:
        runs: coarse to fine; the finest one succeeded.
        name: of a field of `Trajectory`.

    Returns:
        Per run; NaN where the run failed. Quaternions and their rates have the signs of the
        finest run's.

    """
    assert runs[-1].trajectory is not None
    finest = runs[-1].trajectory
    fine: Array = getattr(finest, name)
    found = []
    for run in runs:
        y = np.full_like(fine, np.nan) if run.trajectory is None else getattr(run.trajectory, name)
        if name in ("p", "pdot") and run.trajectory is not None:
            y = y * np.where(np.sum(run.trajectory.p * finest.p, axis=-1, keepdims=True) < 0, -1.0, 1.0)
        found.append(y)
    return found


def rounding_floor(steps: int, scale: float, accepted_error: float = 0.0) -> float:
    """Return the drift of an invariant that the rounding of all steps explains.

    Args:
        scale: size of the quantities that the invariant is a difference of, in its unit.
        accepted_error: what step control accepts in every step, relative to the scale.

    Returns:
        The drift, in the invariant's unit.

    """
    return (ROUNDING_PER_STEP + accepted_error) * max(steps, 64) * scale
