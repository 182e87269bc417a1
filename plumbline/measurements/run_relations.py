"""Metamorphic relations of short runs: reversed in time, and made in another way of the engine.

    reversed in time     a symmetric integrator whose rates are reversed returns to its start, at any step
    by …                 the same run with another linear solver of the engine, or with joints built otherwise

The ends of the two runs may differ by rounding and by the tolerance of the step's solver, both grown as small
perturbations of the motion grow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from plumbline.engines.adapter import Adapter
from plumbline.engines.metamorphic_hooks import MetamorphicHooks
from plumbline.engines.no_answer import NoAnswer
from plumbline.measurements.relation_result import OPTION_PREFIX, RelationResult
from plumbline.model.datatypes import (
    Array,
    EngineFailure,
    Float,
    Integrator,
    Model,
    State,
    Trajectory,
    Unsupported,
)
from plumbline.model.invariants import attitude_error, position_error
from plumbline.model.kinematics import angular_velocity, stretched_length
from plumbline.truth.ground_truth import RUN_ROUNDING
from plumbline.truth.predictability_horizon import perturbation_growth
from plumbline.truth.rounding_bound import remembered_rounding_bound

REVERSED_IN_TIME = "reversed in time"
STEP_DIVISORS = 1, 4, 16  # of the step, tried one after the other where an implicit integrator fails
MAX_TOLERANCE = 1e-4  # of a run's scales; a larger one could hide a mistake
RUN_STEPS = 16  # of a run, one way
STEPS_PER_RADIAN = 32  # at the fastest rate, so that implicit steps can be solved


def _first_step(model: Model, state: State) -> float:
    """The step [s] that is tried first."""
    return float(2.0 ** np.floor(-np.log2(STEPS_PER_RADIAN * fastest_rate(model, state))))


def run_growth(model: Model, state: State) -> list[float]:
    """Compute by how much small perturbations grow in a run with each of the steps, whatever the engine.

    Returns:
        The largest growth up to the end of the run, for each of `STEP_DIVISORS`.

    """
    ends = RUN_STEPS * _first_step(model, state) / np.array(STEP_DIVISORS)
    times = np.unique([0.0, *ends, *ends / 2])
    growth = perturbation_growth(model, state, times)
    return [float(np.max(growth[times <= end])) for end in ends]


def check_run_relations(
    engine: MetamorphicHooks, model: Model, state: State, growth: Sequence[float]
) -> Iterator[RelationResult]:
    """Check the relations of short runs, for every integrator that has one.

    Where an implicit integrator fails, a shorter run with a shorter step follows.

    Args:
        growth: of `run_growth`.

    Yields:
        One result per integrator and relation.

    """
    for option in engine.options_for(model):
        if reason := engine.unmoved_options.get(option):
            yield RelationResult(f"motions by {option}", None, note=reason)
    grown = dict(zip(short_steps(model, state), growth, strict=True))
    yield from with_shorter_steps(
        engine,
        grown,
        lambda integrator, step: check_integrator_relations(
            engine, integrator, model, state, step, grown[step]
        ),
    )


def short_steps(model: Model, state: State) -> list[float]:
    """Return the steps [s] that are tried one after the other."""
    return [_first_step(model, state) / divisor for divisor in STEP_DIVISORS]


def with_shorter_steps(
    engine: MetamorphicHooks,
    steps: Iterable[float],
    check: Callable[[Integrator, float], Iterator[RelationResult]],
) -> Iterator[RelationResult]:
    """Check short runs of every integrator; where an implicit one fails, with the next step."""
    for integrator in (one for one in engine.integrators if one.has_motions):
        results, remark = list[RelationResult](), ""
        for step in steps:
            results = [replace(result, remark=remark) for result in check(integrator, step)]
            no_answers = [one.no_answer for one in results if one.no_answer]
            failures = [one.message for one in no_answers if not one.is_refusal]
            if integrator.kind == "tolerance" or not failures:
                break
            remark = remark or f"; with steps of {step:.4g} s {failures[0]}"
        yield from results


def check_integrator_relations(
    engine: MetamorphicHooks, integrator: Integrator, model: Model, state: State, step: float, growth: float
) -> Iterator[RelationResult]:
    """Check the relations of one integrator's runs.

    Args:
        step: step of the runs [s]; with step control it sets only their duration.
        growth: the largest growth of perturbations in such a run.

    Yields:
        One result per relation.

    """
    end, is_fixed = RUN_STEPS * step, integrator.kind == "step"
    resolution = step if is_fixed else integrator.min_rtol
    driven = _loop_acceleration(model, state) * end

    def result(name: str, ends: tuple[State, State], roundings: int, steps: int) -> RelationResult:
        limit = roundings * run_tolerance(integrator, model, state, end, steps, growth)
        differences = relative_differences(model, *ends, driven)
        return worst_difference_result(name, integrator, differences, limit, steps, resolution, end)

    if integrator.is_symmetric and not model.is_dissipative:
        try:
            run = engine.simulate_round_trip(model, state, end, integrator.name, resolution)
        except (Unsupported, EngineFailure) as refusal:
            yield refused_result(REVERSED_IN_TIME, integrator, refusal)
        else:  # the last row must be the first one with opposite rates
            there_and_back = state_at_sample(run, 0), state_at_sample(run, 2, -1.0)
            yield result(REVERSED_IN_TIME, there_and_back, 1, run.steps)
    ways = engine.options_for(model)
    others = [way for way in ways if integrator.name in engine.motion_options.get(way, ())]
    options = [*engine.linear_solvers, *others]  # other ways to the same steps
    if not (is_fixed and options):
        return
    question = model, state, np.array([0.0, end]), integrator.name, step
    usual = run_or_refusal(engine, *question)
    for option in options:
        name, other = OPTION_PREFIX + option, run_or_refusal(engine.with_option(option), *question)
        if not isinstance(usual, Trajectory):
            yield refused_result(name, integrator, usual)
        elif not isinstance(other, Trajectory):
            yield refused_result(name, integrator, other)
        else:
            yield result(name, (state_at_sample(usual, -1), state_at_sample(other, -1)), 2, RUN_STEPS)


def fastest_rate(model: Model, state: State) -> float:
    """Return the fastest rate of a motion: of a body, of a rod, or of the shortest link as a pendulum.

    With loops also that which an angular acceleration reaches within a radian.

    Returns:
        The rate [1/s]; 1 where everything rests without gravity.

    """
    swing = np.sqrt(np.linalg.norm(model.gravity) / np.min(stretched_length(model)))
    rates = [np.max(np.linalg.norm(rate, axis=1)) for rate in (state.omega, state.udot)]
    return float(max(swing, *rates, np.sqrt(2 * _loop_acceleration(model, state)))) or 1.0


def _loop_acceleration(model: Model, state: State) -> float:
    """The largest angular acceleration [rad/s²] of bodies in loops, which may start from rest; of trees 0."""
    if not model.has_loops:
        return 0.0
    return float(np.max(remembered_rounding_bound(model, state).scale["angular_acceleration"]))


def run_or_refusal(
    engine: Adapter,
    model: Model,
    state: State,
    times: Float[Array, "samples"],
    integrator: str,
    resolution: float,
) -> Trajectory | Unsupported | EngineFailure:
    """Simulate a run, or return the exception with which the engine refused it or failed."""
    try:
        return engine.simulate(model, state, times, integrator, resolution)
    except (Unsupported, EngineFailure) as refusal:
        return refusal


def refused_result(name: str, integrator: Integrator, refusal: Unsupported | EngineFailure) -> RelationResult:
    """Make the result of a run that the engine refused or failed.

    Returns:
        The result, without a ratio.

    """
    return RelationResult(name, None, no_answer=NoAnswer.by(refusal), integrator=integrator.name)


def run_tolerance(
    integrator: Integrator, model: Model, state: State, end: float, steps: int, growth: float
) -> float:
    """Return by how much the end of a run may be off: rounding and the tolerance of its steps, grown.

    On long chains the rounding of accelerations is more than the other rounding of a run: they are off by the
    state-level bound, all the time.  A way back is as long as the way there, and grows perturbations as much:
    without drag the flow is Hamiltonian (except for body-fixed moments, which change little in so short a
    run), and its singular values are pairs σ, 1/σ.

    Args:
        end: duration of the run, one way [s].
        steps: number of its steps, there and back.
        growth: the largest growth of perturbations in it.

    Returns:
        The tolerance, relative to `characteristic_scales` [–].

    """
    of_step = integrator.min_rtol
    # a residual is small compared with the heaviest body's, F = m a of a light one
    if integrator.kind == "step":
        of_step = integrator.solver_rtol * float(np.max(model.mass) / np.min(model.mass))
    driven = _loop_acceleration(model, state) * end
    bound = remembered_rounding_bound(model, state)
    _, spin, speed = characteristic_scales(model, state, driven)
    pushed = end * max(np.max(bound.acceleration) / speed, np.max(bound.angular_acceleration) / spin)
    return (RUN_ROUNDING + of_step * float(np.sqrt(steps)) + pushed) * growth


def characteristic_scales(model: Model, state: State, driven: float = 0.0) -> tuple[float, float, float]:
    """Return the scales that differences of runs are relative to.

    Args:
        driven: rate of rotation that the motion reaches from there [rad/s].

    Returns:
        The stretched pendulum's length [m], its rate of rotation [rad/s] and its speed [m/s].

    """
    length = float(np.sum(stretched_length(model)))
    fall = float(np.sqrt(np.linalg.norm(model.gravity) * length))
    fastest = float(np.max(np.linalg.norm(state.omega, axis=1)))
    spin = max(fall / length, fastest, driven, np.finfo(float).tiny)
    return length, spin, max(spin * length, float(np.max(np.linalg.norm(state.v, axis=1))))


def state_at_sample(run: Trajectory, at: int, sign: float = 1.0) -> State:
    """Return one sample of a run as the engine returned it, on the constraint manifold or off it.

    Args:
        at: index of the sample.
        sign: number to multiply the rates by, ±1.

    Returns:
        The state; the directions of its rods are zero.

    """
    p, pdot = run.p[at], sign * run.pdot[at]
    return State(p, angular_velocity(p, pdot), r=run.r[at], v=sign * run.v[at])


def relative_differences(model: Model, one: State, other: State, driven: float = 0.0) -> dict[str, float]:
    """Compare two samples.

    Args:
        one: a sample, whose rates set the scales.
        driven: of `characteristic_scales`.

    Returns:
        By quantity the largest difference of any body, relative to `characteristic_scales` [–]; of attitudes
        the angle [rad].

    """
    length, spin, speed = characteristic_scales(model, one, driven)
    return {
        "position": float(position_error(one.r, other.r)) / length,
        "attitude": float(attitude_error(one.p, other.p)),
        "velocity": float(position_error(one.v, other.v)) / speed,
        "angular velocity": float(position_error(one.omega, other.omega)) / spin,
    }


def worst_difference_result(
    name: str,
    integrator: Integrator,
    differences: dict[str, float],
    limit: float,
    steps: int,
    resolution: float,
    end: float,
) -> RelationResult:
    """Make the result of a relation of runs.

    Args:
        differences: by quantity, from `relative_differences`.
        limit: tolerance of each difference, from `run_tolerance`.
        resolution: step [s], or relative tolerance.
        end: duration, one way [s].

    Returns:
        The result, of the quantity with the largest difference.

    """
    quantity = max(differences, key=lambda q: differences[q])
    undecided = ""
    if limit > MAX_TOLERANCE:
        undecided = (
            f"runs may differ by {limit:.2g} of their scales, by rounding and by the tolerance of the steps, "
            f"too much to detect an error (limit {MAX_TOLERANCE:g})"
        )
    return RelationResult(
        name, differences[quantity] / limit, quantity, 0, 1, undecided=undecided,
        integrator=integrator.name, steps=steps, resolution=resolution, end_time=end,
    )  # fmt: skip
