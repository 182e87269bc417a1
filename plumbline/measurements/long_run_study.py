"""Long runs of one integrator: planned, run and reduced inside a worker, which returns no trajectory."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass, replace

import numpy as np

from plumbline.engines.no_answer import NoAnswer, attempt
from plumbline.engines.registry import load_adapter
from plumbline.measurements.drift_order import (
    BLOCK_COUNT,
    MAX_RELATIVE_DRIFT,
    DriftWindow,
    InvariantDrift,
    LongRun,
)
from plumbline.measurements.order_and_limit import step_unit
from plumbline.model.datatypes import Array, Integrator, Model, State, Trajectory
from plumbline.model.invariants import INVARIANT_UNITS, compute_invariants, invariant_scales, kinetic_energy
from plumbline.model.kinematics import angular_velocity, stretched_length
from plumbline.truth.ground_truth import singular_note

# By order: coarsest and finest step, as -log2 of the `step_unit`.
LONG_RUN_STEP_EXPONENTS = {1: (9, 11), 2: (7, 9), 4: (7, 9)}
RTOL_FACTORS = (1e6, 1e4)  # relative tolerances of a method with step control, over its tightest
# By order: most steps × bodies of the finest run; a step of order 1 is cheap.
MAX_BODY_STEPS = {1: 2**18, 2: 2**17, 4: 2**17}
# most time, in the unit of s, × bodies with step control, whose steps are not known beforehand
MAX_BODY_SECONDS = 100.0
# of `time_unit`: largest drifts are kept up to each, and the end
WINDOW_ENDS = (0.1, 1.0, 10.0, 100.0, 1000.0)
MAX_HALVINGS = 2  # of the finest step, where a run stops although its energy is in range
MIN_WINDOW = 1.0  # of `time_unit`: shortest run that is tried, decade by decade, where longer ones fail
MAX_SPACING_OF_WORK = 0.03125  # s between samples where work is integrated: its rule has degree 15
ADAPTIVE_SAMPLE_SPACING = 0.125  # s between samples of a method with step control, which ends a step at each


@dataclass(frozen=True)
class LongRunPlan:
    """How long and how finely one integrator runs; shorter than requested where that costs too much."""

    seconds: float
    resolutions: tuple[float, ...]  # steps [s] or relative tolerances, coarse to fine
    requested_seconds: float  # s
    time_unit: float = 1.0  # s, less for a motion faster than steps of seconds resolve
    is_too_fast: bool = False  # whether the runs end there because the motion after it asks for shorter steps

    @property
    def shortening_note(self) -> str:
        """The end of a derivation that says what was left out, "" for nothing."""
        if self.seconds == self.requested_seconds:
            return ""
        compared = f"{self.seconds:g} s of {self.requested_seconds:g} s"
        if self.is_too_fast:
            return f"; steps of {self.resolutions[-1]:g} s resolve {compared}, then the motion is too fast"
        return f"; the limit of steps × bodies allows {compared}"


@dataclass(frozen=True, eq=False)
class LongRunStudy:
    """All long runs of one integrator, coarse to fine."""

    runs: list[LongRun]
    plan: LongRunPlan
    refusal: NoAnswer | None = None
    singular: str = ""  # why the runs end before the plan's length: a pose that is singular, or nearly so

    @property
    def is_in_doubt(self) -> bool:
        """Whether the finest run failed, or its energy leaves its range: the motion may be too fast."""
        if self.refusal:
            return False
        finest = self.runs[-1]
        return finest.failure is not None or leaves_range(finest, self.plan.seconds)


def plan_long_run(
    integrator: Integrator, bodies: int, seconds: float, sample_interval: float = 1.0, duration: float = 1.0
) -> LongRunPlan:
    """Choose the affordable length and the resolutions of long runs.

    Args:
        integrator: has fixed steps of an order, or a tolerance.
        seconds: requested length [s].
        sample_interval: the scenario's time between samples [s].
        duration: of the scenario [s]; where its samples are closer than the steps of seconds, a fast motion,
            steps and length are those of seconds in proportion to it.

    Returns:
        The plan; its length is halved until the finest run keeps to `MAX_BODY_STEPS` or `MAX_BODY_SECONDS`.

    """
    coarse, fine = LONG_RUN_STEP_EXPONENTS.get(integrator.order, LONG_RUN_STEP_EXPONENTS[4])
    unit, usual = (step_unit(sample_interval, length, coarse) for length in (duration, 1.0))
    if integrator.kind == "tolerance":
        affordable = MAX_BODY_SECONDS * (unit / usual) / bodies
        resolutions = tuple(integrator.min_rtol * factor for factor in RTOL_FACTORS)
    else:
        affordable = MAX_BODY_STEPS[integrator.order] * (unit / usual) / bodies / 2**fine
        resolutions = tuple(unit * 2.0**-k for k in range(coarse, fine + 1))
    halvings = max(0, int(np.ceil(np.log2(seconds / affordable))))
    return LongRunPlan(seconds / 2**halvings, resolutions, seconds, unit / usual)


def run_long_run_study(
    engine: str, integrator: str, model: Model, state: State, sample_interval: float, plan: LongRunPlan
) -> LongRunStudy:
    """Run at every resolution of a plan; a run that fails is repeated a decade shorter.

    Where a drift falls too slowly one more run, with half the step, decides: the blocks of a run are not
    independent.  A violent moment opens the joints of an index-2 method for all times after it, so that all
    its later blocks drift too far (ten balls with Exudyn's trapezoidal method: orders 1.8, 1.0 and then 3.6).
    Where the finest run stops, its energy in range, shorter steps show whether the steps were at fault: of a
    Furuta pendulum that its motor spins up, Newton's iteration in Exudyn converges for 10, 21, 44 and 98 s
    with steps of 2⁻⁷ to 2⁻¹⁰ s.

    Args:
        sample_interval: the scenario's time between samples [s].
        plan: length and resolutions.

    Returns:
        The reduced runs, or the reason why the engine refused; with loops up to a singular pose, of others up
        to where no step of the plan resolves the motion.

    Raises:
        MemoryError: the worker's limit was reached.

    """
    adapter = load_adapter(engine)
    method = adapter.integrator(integrator)
    spacing = _sample_spacing(method, model, sample_interval, plan)

    def runs_until(end: float, is_checked: bool = False) -> tuple[LongRunStudy, float | None]:
        """All runs; where they are checked and a pose may be singular, those up to it, and when [s]."""
        lengths = [t for t in _window_ends(end, plan) if t >= min(MIN_WINDOW * plan.time_unit, end)]
        runs: list[LongRun] = []
        resolutions = list(plan.resolutions)
        for resolution in resolutions:
            begin, failure, trajectory = time.process_time(), None, None
            for seconds in reversed(lengths):
                times = _samples(seconds, spacing)
                found = attempt(adapter.simulate, model, state, times, integrator, resolution)
                if not isinstance(found, NoAnswer):
                    trajectory = replace(found, t=times)  # the engine's own sum of steps is rounded
                    break
                if found.is_refusal:
                    return LongRunStudy(runs, plan, found), None
                failure = failure or found
            runs.append(_reduce_run(model, plan, trajectory, resolution, failure, begin))
            doubt = _first_doubt(model, state, trajectory, runs[-1], end) if is_checked else None
            if doubt is not None:
                return LongRunStudy(runs, plan), doubt
            more = len(runs) - len(plan.resolutions)
            stops = 0 <= more < MAX_HALVINGS and _stops_in_range(runs[-1], end)
            if stops or (more == 0 and _falls_too_slowly(runs, method, plan)):
                resolutions.append(resolution**2 / resolutions[-2])  # the loop goes on with it
        return LongRunStudy(runs, plan), None

    study, doubt = runs_until(plan.seconds, is_checked=model.has_loops)
    times = _samples(plan.seconds, spacing)
    if doubt is not None:
        end, singular = _regular_length(model, state, times[times <= doubt + spacing])
        study, _ = runs_until(end if singular else plan.seconds)
        return replace(study, singular=singular)
    if method.kind == "step" and not model.has_loops and study.is_in_doubt:
        end = _resolved_length(model, state, times, plan.resolutions[-1])
        if end < plan.seconds:
            plan = replace(plan, seconds=end, is_too_fast=True)
            study, _ = runs_until(end)
    return study


def decisive_windows(run: LongRun, quantity: str, plan: LongRunPlan) -> list[float]:
    """The ends [s] of the windows of a run that are long enough to decide, longest first."""
    ends = sorted(run.windows[quantity], reverse=True)
    return [end for end in ends if end >= MIN_WINDOW * plan.time_unit] or [run.reached_time]


def _falls_too_slowly(runs: list[LongRun], integrator: Integrator, plan: LongRunPlan) -> bool:
    """Whether some drift falls slower than the method's order."""
    return any(
        InvariantDrift(runs, integrator, quantity, end).falls_too_slowly
        for quantity in runs[-1].windows
        for end in decisive_windows(runs[-1], quantity, plan)
    )


def leaves_range(run: LongRun, seconds: float) -> bool:
    """Return whether the energy, drifting on as it did, would leave its range: too coarse a step.

    Args:
        run: that reached a window's end.
        seconds: the length that was planned [s].

    Returns:
        Whether the drift, as the power of time that the last two windows show, or in proportion to time
        where that is more, passes `MAX_RELATIVE_DRIFT` of its scale.

    """
    windows = run.windows["energy_drift"]
    *earlier, end = sorted(windows)
    drift, growth = windows[end].max_drift, 1.0
    if earlier and windows[earlier[-1]].max_drift > 0:
        growth = max(growth, np.log(drift / windows[earlier[-1]].max_drift) / np.log(end / earlier[-1]))
    drift *= (seconds / end) ** growth
    return bool(drift > MAX_RELATIVE_DRIFT * run.invariant_scales[end]["energy_drift"])


def _stops_in_range(run: LongRun, seconds: float) -> bool:
    """Whether a run failed although its energy was not leaving its range."""
    return run.failure is not None and not (run.windows and leaves_range(run, seconds))


def _samples(seconds: float, spacing: float) -> Array:
    return np.arange(round(seconds / spacing) + 1, dtype=np.float64) * spacing


def _first_doubt(
    model: Model, state: State, run: Trajectory | None, reduced: LongRun, seconds: float
) -> float | None:
    """When [s] a run may have come to a singular pose, its energy in range; inf where it failed in range."""
    from plumbline.truth.trajectory_truth import first_doubt  # with SciPy: not in a run's own process

    if run is None:
        return np.inf
    drift = np.abs(compute_invariants(model, run).energy_drift[:, 0, 0])
    kinetic = np.maximum.accumulate(kinetic_energy(model, run.v, angular_velocity(run.p, run.pdot)))
    scale = np.maximum(kinetic, reduced.invariant_scales[min(reduced.invariant_scales)]["energy_drift"])
    out = np.flatnonzero(drift > MAX_RELATIVE_DRIFT * scale)  # the step is too coarse from there on
    number = int(out[0]) if len(out) else len(run.t)
    part = run.at(slice(number))
    found = first_doubt(model, state, part)
    if found is None and _stops_in_range(reduced, seconds):
        return np.inf
    return found


def _regular_length(model: Model, state: State, times: Array) -> tuple[float, str]:
    """The last sample [s] before the motion comes to a singular pose, and what to say of it."""
    from plumbline.truth.trajectory_truth import regular_motion

    try:
        regular = regular_motion(model, state, times)
    except ArithmeticError:  # it ends for another reason: the engine's runs are judged as they are
        return float(times[-1]), ""
    if not regular.is_singular:
        return float(times[-1]), ""
    return float(times[times <= regular.end][-1]), singular_note(regular.end)


def _resolved_length(model: Model, state: State, times: Array, step: float) -> float:
    """The last sample [s] up to which steps resolve the motion; the last one where they never do."""
    from plumbline.truth.trajectory_truth import resolved_motion_end

    end = resolved_motion_end(model, state, float(times[-1]), step)
    return float(times[times <= end][-1]) or float(times[-1])


def _window_ends(seconds: float, plan: LongRunPlan) -> list[float]:
    """Ends of the windows [s]: the decades and ``seconds`` itself."""
    return [*(end * plan.time_unit for end in WINDOW_ENDS if end * plan.time_unit < seconds), seconds]


def _sample_spacing(integrator: Integrator, model: Model, sample_interval: float, plan: LongRunPlan) -> float:
    """Time between samples [s]: longer with step control, unless the work's quadrature needs them close."""
    has_power = model.is_dissipative or np.any(model.moment) or np.any(model.effort)
    if has_power:
        sample_interval = min(sample_interval, MAX_SPACING_OF_WORK)
    elif integrator.kind == "tolerance":
        sample_interval *= max(1, round(ADAPTIVE_SAMPLE_SPACING / sample_interval))
    if integrator.kind == "tolerance":
        return sample_interval
    return max(sample_interval, plan.resolutions[0])  # every run samples at the ends of steps


def _reduce_run(
    model: Model,
    plan: LongRunPlan,
    run: Trajectory | None,
    resolution: float,
    failure: NoAnswer | None,
    begin: float,
) -> LongRun:
    """Reduce a run that began at ``begin`` (process time [s]) to its windows."""
    if run is None:
        return LongRun(resolution, 0, 0.0, failure, {}, {}, {}, time.process_time() - begin)
    length, end = float(np.sum(stretched_length(model))), float(run.t[-1])
    windows: dict[str, dict[float, DriftWindow]] = {}
    scales, uncertainty = {}, {}
    for window_end in _window_ends(end, plan):
        number = int(np.searchsorted(run.t, window_end)) + 1
        part = run.at(slice(number))
        invariants = compute_invariants(model, part)
        scales[window_end] = invariant_scales(model, part, length)
        uncertainty[window_end] = invariants.uncertainty
        for quantity in INVARIANT_UNITS:
            series = getattr(invariants, quantity)
            if series is not None:
                windows.setdefault(quantity, {})[window_end] = _reduce_window(series)
    cost = time.process_time() - begin
    return LongRun(resolution, run.steps, end, failure, uncertainty, scales, windows, cost, run.solver_rtol)


def _reduce_window(series: Array) -> DriftWindow:
    """Reduce an invariant's signed samples (T, M, width)."""

    def largest(part: Array, origin: Array | float) -> float:
        return float(np.max(np.linalg.norm(part - origin, axis=-1)))

    edges = np.linspace(0, len(series) - 1, BLOCK_COUNT + 1).astype(int)
    blocks = [largest(series[a : b + 1], series[a]) for a, b in itertools.pairwise(edges)]
    return DriftWindow(largest(series, 0.0), largest(series[: len(series) // 2 + 1], 0.0), np.array(blocks))
