"""Long runs of one integrator: planned, run and reduced inside a worker, which returns no trajectory."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass, replace

import numpy as np

from plumbline.engines.calls import format_exception
from plumbline.engines.registry import load_adapter
from plumbline.judging.convergence import step_unit
from plumbline.model.datatypes import Array, Integrator, Model, State, Trajectory, Unsupported
from plumbline.model.invariants import INVARIANT_UNITS, compute_invariants, invariant_scales
from plumbline.truth.ground_truth import stretched_length

# By order: coarsest and finest step, as -log2 of seconds.
LONG_RUN_STEP_EXPONENTS = {1: (9, 11), 2: (7, 9), 4: (7, 9)}
RTOL_FACTORS = (1e6, 1e4)  # relative tolerances of a method with step control, over its tightest
# By order: most steps × bodies of the finest run; a step of order 1 is cheap.
MAX_BODY_STEPS = {1: 2**18, 2: 2**17, 4: 2**17}
MAX_BODY_SECONDS = 100.0  # most s × bodies with step control, whose steps are not known beforehand
WINDOW_ENDS = (0.1, 1.0, 10.0, 100.0, 1000.0)  # s: largest drifts are kept up to each, and up to the end
MIN_WINDOW_SECONDS = 1.0  # s: shortest run that is tried, decade by decade, where longer ones fail
BLOCK_COUNT = 16  # blocks of time in each window
ADAPTIVE_SAMPLE_SPACING = 0.125  # s between samples of a method with step control, which ends a step at each


@dataclass(frozen=True)
class LongRunPlan:
    """How long and how finely one integrator runs; shorter than requested where that costs too much."""

    seconds: float
    resolutions: tuple[float, ...]  # steps [s] or relative tolerances, coarse to fine
    requested_seconds: float  # s

    @property
    def shortening_note(self) -> str:
        """The end of a derivation that says what was left out, "" for nothing."""
        if self.seconds == self.requested_seconds:
            return ""
        return f"; the limit of steps × bodies allows {self.seconds:g} s of {self.requested_seconds:g} s"


@dataclass(frozen=True, eq=False)
class DriftWindow:
    """The drift of one invariant up to one time, in the invariant's unit."""

    max_drift: float
    max_drift_first_half: float  # largest in the first half of the window
    block_drifts: Array  # (BLOCK_COUNT,) largest distance from the value at the block's beginning


@dataclass(frozen=True, eq=False)
class LongRun:
    """One run, reduced; dictionaries have one entry per window that it reached, by its end [s]."""

    resolution: float  # step [s], or relative tolerance
    steps: int
    reached_time: float  # s
    failure: str | None  # of the longest run that was tried, where a shorter one replaces it
    work_uncertainty: dict[float, float]  # J
    invariant_scales: dict[float, dict[str, float]]  # by window and invariant
    windows: dict[str, dict[float, DriftWindow]]  # by invariant and window
    cpu_time: float  # s, failed runs included


@dataclass(frozen=True, eq=False)
class LongRunStudy:
    """All long runs of one integrator, coarse to fine."""

    runs: list[LongRun]
    plan: LongRunPlan
    unsupported: str | None = None


def plan_long_run(
    integrator: Integrator, bodies: int, seconds: float, sample_interval: float = 1.0
) -> LongRunPlan:
    """Choose the affordable length and the resolutions of long runs.

    Args:
        integrator: has fixed steps of an order, or a tolerance.
        bodies: number of bodies.
        seconds: requested length [s].
        sample_interval: time between samples [s].

    Returns:
        The plan; its length is halved until the finest run keeps to `MAX_BODY_STEPS` or `MAX_BODY_SECONDS`.

    """
    if integrator.kind == "tolerance":
        affordable = MAX_BODY_SECONDS / bodies
        resolutions = tuple(integrator.min_rtol * factor for factor in RTOL_FACTORS)
    else:
        coarse, fine = LONG_RUN_STEP_EXPONENTS[integrator.order]
        affordable = MAX_BODY_STEPS[integrator.order] / bodies / 2**fine
        resolutions = tuple(step_unit(sample_interval) * 2.0**-k for k in range(coarse, fine + 1))
    halvings = max(0, int(np.ceil(np.log2(seconds / affordable))))
    return LongRunPlan(seconds / 2**halvings, resolutions, seconds)


def run_long_run_study(
    engine: str, integrator: str, model: Model, state: State, sample_interval: float, plan: LongRunPlan
) -> LongRunStudy:
    """Run at every resolution of a plan; a run that fails is repeated a decade shorter.

    Args:
        engine: name of the engine.
        integrator: name of its integrator.
        model: the pendulum.
        state: the initial state.
        sample_interval: the scenario's time between samples [s].
        plan: length and resolutions.

    Returns:
        The reduced runs, or the reason why the engine refused.

    Raises:
        MemoryError: the worker's limit was reached.

    """
    adapter = load_adapter(engine)
    sample_interval = _sample_spacing(adapter.integrator(integrator), model, sample_interval)
    lengths = [t for t in _window_ends(plan.seconds) if t >= min(MIN_WINDOW_SECONDS, plan.seconds)]
    runs: list[LongRun] = []
    for resolution in plan.resolutions:
        begin, failure, trajectory = time.process_time(), None, None
        for seconds in reversed(lengths):
            times = np.arange(round(seconds / sample_interval) + 1, dtype=np.float64) * sample_interval
            try:
                trajectory = adapter.simulate(model, state, times, integrator, resolution)
                break
            except Unsupported as refusal:
                return LongRunStudy(runs, plan, str(refusal))
            except MemoryError:
                raise
            except Exception as error:  # an engine may raise anything; its message belongs in the results
                failure = failure or format_exception(error)
        runs.append(_reduce_run(model, trajectory, resolution, failure, begin))
    return LongRunStudy(runs, plan)


def _window_ends(seconds: float) -> list[float]:
    """Ends of the windows [s]: the decades and ``seconds`` itself."""
    return [*(end for end in WINDOW_ENDS if end < seconds), seconds]


def _sample_spacing(integrator: Integrator, model: Model, sample_interval: float) -> float:
    """Time between samples [s]: longer with step control, unless the work's quadrature needs them all."""
    if integrator.kind == "tolerance" and not (model.has_drag or np.any(model.moment)):
        sample_interval *= max(1, round(ADAPTIVE_SAMPLE_SPACING / sample_interval))
    return sample_interval


def _reduce_run(
    model: Model, run: Trajectory | None, resolution: float, failure: str | None, begin: float
) -> LongRun:
    """Reduce a run that began at ``begin`` (process time [s]) to its windows."""
    if run is None:
        return LongRun(resolution, 0, 0.0, failure, {}, {}, {}, time.process_time() - begin)
    length, end = float(np.sum(stretched_length(model))), float(run.t[-1])
    windows: dict[str, dict[float, DriftWindow]] = {}
    scales, work_uncertainty = {}, {}
    for window_end in _window_ends(end):
        number = int(np.searchsorted(run.t, window_end)) + 1
        part = replace(run, **{name: getattr(run, name)[:number] for name in ("t", "r", "p", "v", "pdot")})
        invariants = compute_invariants(model, part)
        scales[window_end] = invariant_scales(model, part, length)
        work_uncertainty[window_end] = invariants.work_uncertainty
        for quantity in INVARIANT_UNITS:
            series = getattr(invariants, quantity)
            if series is not None:
                windows.setdefault(quantity, {})[window_end] = _reduce_window(series)
    cost = time.process_time() - begin
    return LongRun(resolution, run.steps, end, failure, work_uncertainty, scales, windows, cost)


def _reduce_window(series: Array) -> DriftWindow:
    """Reduce an invariant's signed samples (T, M, width)."""

    def largest(part: Array, origin: Array | float) -> float:
        return float(np.max(np.linalg.norm(part - origin, axis=-1)))

    edges = np.linspace(0, len(series) - 1, BLOCK_COUNT + 1).astype(int)
    blocks = [largest(series[a : b + 1], series[a]) for a, b in itertools.pairwise(edges)]
    return DriftWindow(largest(series, 0.0), largest(series[: len(series) // 2 + 1], 0.0), np.array(blocks))
