"""Truth along a trajectory; its uncertainty is the difference of two methods that share no equation.

The first is heyoka's Taylor method in minimal coordinates (`taylor`), the second the notes' equations on the
constraint manifold by collocation, O(bodies): other equations, coordinates and integrator. Their difference
is the rounding of the second: in extended precision the first is far more accurate, as a comparison with quad
precision shows (tests).

By the notes' form are also the effects of mistakes in parameters on a motion, differences of two runs, and
until when the motion of a mechanism with loops is regular, its accelerations unique.  Near a singular pose
the rows that close the loops lose rank; what follows from them loses digits as their smallest singular value
falls, and beyond the pose another branch may go on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from plumbline.engines.integrators import runge_kutta_4
from plumbline.model.datatypes import Array, EngineFailure, Model, State, Trajectory
from plumbline.model.invariants import attitude_error, motion_error, motion_errors, motion_samples
from plumbline.model.kinematics import (
    angular_velocity,
    joint_coordinates,
    maximal_coordinates,
    normalised,
    quaternion_rate,
    with_joint_coordinates,
)
from plumbline.model.loops import (
    MIN_MOTION_SINGULAR_VALUE,
    cut_open,
    regular_rank,
    smallest_singular_value,
    smallest_singular_values,
)
from plumbline.truth import TruthUnavailable
from plumbline.truth.certificate_proof import ProvedMotion, prove_motion, round_enclosure
from plumbline.truth.notes_motion import integrate_batch, side_by_side, trajectories
from plumbline.truth.parameters import Parameter, perturb
from plumbline.truth.step_formulas import fastest_rates
from plumbline.truth.taylor import Precision, simulate_taylor
from reference_impl.arrays import Motion
from reference_impl.fast.chain_elimination import component_first
from reference_impl.fast.collocation import BatchIntegrationResult, integrate_collocation
from reference_impl.fast.tree_elimination import EliminatedSystem, eliminated_system, fastest_acceleration
from reference_impl.integrate import IntegrationResult, integrate_dop853

if TYPE_CHECKING:
    from plumbline.truth.certificate_checker import Enclosure

NOTES_RTOL = 1e-13  # of the notes' form: at 1e-14 it is no closer to extended precision, the rest is rounding
# In double precision both methods round alike: of seven and eight bodies (squeezer, tree-of-seven-sprung)
# the first was off by up to 1.7 times the difference.  2 s of ten bodies take 1.3 s in extended precision,
# 0.6 s in double; of fifty 14 s and 4 s.
MAX_EXTENDED_PRECISION_BODIES = 10
MAX_COMPILED_BODIES = 50  # the equations of fifty bodies take 2 s to compile
NOTES_METHOD = "the notes' form by collocation"
ROUNDING = 2.0**-51  # of a motion stored in double, relative to its size
ClosedFormSamples = tuple[Array, Array, str]  # r (T, N, 3) m and p (T, N, 4) of a closed form, and its source


@dataclass(frozen=True, eq=False)
class TrajectoryTruth:
    """The true motion and its uncertainty."""

    trajectory: Trajectory
    # by the names of `MOTION_UNITS` (T,) in its unit, largest of any body up to each time
    uncertainty: Mapping[str, Array]
    method: str  # the two methods, in words


def trajectory_truth(
    model: Model,
    state: State,
    times: Array,
    closed_form: ClosedFormSamples | None = None,
    max_compiled_bodies: int = MAX_COMPILED_BODIES,
    proof: ProvedMotion | None = None,
) -> TrajectoryTruth:
    """Compute the motion by two methods, or take it from a proof.

    Where heyoka is missing, fails, or the chain has more than ``max_compiled_bodies``, DOP853 on the notes'
    equations takes its place: another integrator but the same equations, and ``method`` states that.

    Args:
        times: (T,) [s] of the samples, times[0] = 0.
        closed_form: samples of a closed form at ``times``; they replace r and p of the result; velocities
            remain those of the first method, uncertain by the difference between the two.
        max_compiled_bodies: longest chain that heyoka compiles; 0 to avoid heyoka.
        proof: the motion as a certificate proves it, if there is one; nothing is computed then.

    Returns:
        The motion and the differences between the two methods, or the radii of the proof.

    Raises:
        EngineFailure: the integrator of the notes' form stops early.

    """
    if proof is not None:
        run = replace(proof.trajectory, initial_x=state.x)
        return TrajectoryTruth(run, proof.radius, proof.method)
    notes = simulate_notes_form(model, state, times, NOTES_RTOL)
    try:
        run, method = _simulate_minimal_coordinates(model, state, times, max_compiled_bodies)
        other, other_method = notes, NOTES_METHOD
    except Exception as error:  # whatever fails in heyoka, the notes' form remains
        failure = str(error) if isinstance(error, TruthUnavailable) else f"{type(error).__name__}: {error}"
        run, method, other_method = notes, NOTES_METHOD, f"the same by DOP853, no Taylor series: {failure}"
        other = simulate_notes_form(model, state, times, NOTES_RTOL, "dop853")
    uncertainty = motion_errors(run, other)
    if closed_form is not None:
        r, p, source = closed_form
        of_velocities = f"of velocities that of {method} from {other_method}"
        other, other_method, method = run, f"{method}; {of_velocities}", f"closed form: {source}"
        # rates refer to the sign of the quaternion
        run = replace(run, r=r, p=p, pdot=quaternion_rate(p, angular_velocity(run.p, run.pdot)))
        found = motion_errors(run, other)
        uncertainty |= {name: found[name] for name in ("position", "attitude")}
    return TrajectoryTruth(run, uncertainty, f"{method}; uncertainty: its difference from {other_method}")


def prove_and_judge_claim(
    model: Model, state: State, times: Array, closed_form: ClosedFormSamples | None = None
) -> tuple[ProvedMotion, float]:
    """Prove a motion, and compare the error of the truth by two methods with the uncertainty that it claims.

    Args:
        times: (T,) [s] of the samples, times[0] = 0.
        closed_form: as for `trajectory_truth`.

    Returns:
        The proved motion, and the largest error over claim of any sample, as `judge_claim` has it.

    Raises:
        Rejected: no candidate could be proved.
        TruthUnavailable: a truth tool is not installed.
        EngineFailure: an integrator stops early.

    """
    _, enclosure = prove_motion(model, state, times)
    return round_enclosure(enclosure), judge_claim(model, state, times, enclosure, closed_form)


def judge_claim(
    model: Model, state: State, times: Array, enclosure: Enclosure, closed_form: ClosedFormSamples | None
) -> float:
    """Compare the error of the truth by two methods with the uncertainty that it claims.

    Args:
        times: (T,) [s] of the samples, times[0] = 0.
        closed_form: as for `trajectory_truth`.

    Returns:
        The largest error over claim of any sample; the claim includes the rounding of both motions to double.

    Raises:
        EngineFailure: an integrator stops early.

    """
    proof = round_enclosure(enclosure)
    truth = trajectory_truth(model, state, times, closed_form)
    run, right = truth.trajectory, proof.trajectory
    samples, ratios = motion_samples(run), []
    for name, true in motion_samples(right).items():
        error = motion_error(name, samples[name], true)
        size = 4.0 if name == "attitude" else float(np.max(np.abs(true)))
        claim = truth.uncertainty[name] + proof.radius[name] + ROUNDING * size
        # 0 of 0 at a fixed point
        ratios.append(np.divide(error, claim, out=np.zeros_like(error), where=error != 0))
    return float(np.max(ratios))


def _simulate_minimal_coordinates(
    model: Model, state: State, times: Array, max_compiled_bodies: int
) -> tuple[Trajectory, str]:
    """The motion by Taylor's method in minimal coordinates, and the name of the method."""
    if model.n > max_compiled_bodies:
        raise TruthUnavailable(f"not used for more than {max_compiled_bodies} bodies")
    precision: Precision = "extended" if model.n <= MAX_EXTENDED_PRECISION_BODIES else "double"
    found, steps = simulate_taylor(model, state, times, precision)
    r, p, v, omega = (np.asarray(getattr(found, name), float) for name in ("r", "p", "v", "omega"))
    run = Trajectory(times, r, p, v, quaternion_rate(p, omega), steps, state.x)
    coordinates = (
        "coordinates of the tree without its closing joints" if model.has_loops else "minimal coordinates"
    )
    return run, f"Taylor's method in {coordinates} and {precision} precision"


NotesIntegrator = Literal["collocation", "dop853"]


def simulate_notes_form(
    model: Model, state: State, times: Array, rtol: float, method: NotesIntegrator = "collocation"
) -> Trajectory:
    """Integrate the notes' equations, by collocation on the manifold or in the raw form (N6) by DOP853.

    After 2 s, the motion on the manifold differs from the truth by 2e-14 m on thirty ball joints and 5e-14 m
    on fifty, the raw form by 7e-13 m and 2e-12 m at any tolerance, because it drifts.

    Args:
        times: (T,) [s] of the samples, times[0] = 0.
        rtol: relative tolerance.

    Returns:
        The motion at ``times``.

    Raises:
        EngineFailure: the integrator stops early.

    """
    run: IntegrationResult
    try:
        # absolute tolerances of 1 m, 1, 1 m/s and 1 1/s: those by default are too coarse
        if method == "dop853":
            form, x = fastest_acceleration(model), joint_coordinates(model, state)[2]
            start = maximal_coordinates(state)
            run = integrate_dop853(model, *start, times, rtol, form, x=x, atol=rtol)
        else:
            run = integrate_batch([(model, state)], times, rtol, project=True)
    except ArithmeticError as error:
        raise EngineFailure(str(error)) from None
    return Trajectory(times, run.r, run.p, run.v, run.pdot, run.steps, state.x)


MOTION_MISTAKE = 1e-5  # of a parameter's scale, in the runs that show its effect on the motion
MOTION_STEP = 2.0**-6  # s, largest step of those runs
MOTION_RTOL = 1e-13  # of the motion without mistakes
MAX_DEVIATION_ERROR = 1e-3  # of the largest deviation, what finer steps may change
MAX_REFINEMENT = 16  # of the first steps
DEVIATION_ORDER, REFINEMENT_MARGIN = 4, 1.1  # of the steps' number, where the error falls as the order says
TRIED_PARAMETERS = 8  # with mistakes in which steps are chosen
MAX_STEP_ANGLE = 0.25  # rad that the fastest mode turns in a step
MAX_STIFFNESS = 1.5  # of a step times the fastest rate of springs and dampers; stable up to 2.78
TINY_RATE = 1e-3  # rad/s
MAX_BATCH_BODIES = 4000  # of one batch of runs: more do not fit the processor's cache


@dataclass(frozen=True, eq=False)
class AccurateMotion:
    """A motion to nearly rounding, at the stages of the Runge-Kutta steps of deviations from it."""

    model: Model
    state: State
    times: Array  # (T,) samples [s]
    substeps: int  # steps between two samples
    y: Array  # (2 (T − 1) substeps + 1, 2, 7, N): (r; p) and (ṙ; ṗ) at the ends and midpoints of steps

    @property
    def samples(self) -> Array:
        """The motion at the samples, (T, 2, 7, N)."""
        return self.y[:: 2 * self.substeps]


@dataclass(frozen=True, eq=False)
class PerturbedMotion:
    """A motion with a mistake in one parameter, and the same without it."""

    parameter: Parameter
    run: Trajectory
    true: Trajectory  # of the same object for all motions of a batch


def accurate_motions(
    model: Model, state: State, times: Array, substeps: Sequence[int] = (1,)
) -> list[AccurateMotion]:
    """Simulate a motion by collocation.

    Args:
        model: the mechanism, without loops.
        times: (T,) sample times [s], equally spaced.
        substeps: numbers of steps between two samples.

    Returns:
        The motion, for each number of steps. A steady motion stays as steady as it can.

    Raises:
        ArithmeticError: as `integrate_collocation`.

    """
    grids = [np.linspace(times[0], times[-1], 2 * count * (len(times) - 1) + 1) for count in substeps]
    every = np.unique(np.concatenate(grids))
    run = integrate_batch([(model, state)], every, MOTION_RTOL)
    y = np.stack([np.concatenate([run.r, run.p], axis=-1), np.concatenate([run.v, run.pdot], axis=-1)], 1)
    stages = [y[np.searchsorted(every, grid)].swapaxes(-1, -2) for grid in grids]
    return [
        AccurateMotion(model, state, times, count, at) for count, at in zip(substeps, stages, strict=True)
    ]


def accurate_runs(
    cases: Sequence[tuple[Model, State]], times: Array, max_steps: float = np.inf
) -> list[Trajectory]:
    """Simulate motions by collocation, with common steps.

    Args:
        cases: mechanisms without loops, with the same joints between the same bodies, and initial states.
        times: (T,) sample times [s].
        max_steps: as of `integrate_collocation`.

    Returns:
        The motions, each on its joints.

    Raises:
        ArithmeticError: as `integrate_collocation`.

    """
    run = integrate_batch(cases, times, MOTION_RTOL, project=True, max_steps=max_steps)
    return trajectories(run, cases)


def resolved_motions(
    model: Model, state: State, times: Array, parameters: Sequence[Parameter]
) -> tuple[AccurateMotion, AccurateMotion]:
    """Simulate a motion with steps that resolve how mistakes grow.

    Args:
        model: the mechanism, without loops.
        times: (T,) sample times [s], equally spaced.
        parameters: mistakes in some of them are tried.

    Returns:
        The motion, for steps that resolve it and for steps of two thirds of their length.

    """
    turning = max(TINY_RATE, *np.linalg.norm(state.omega, axis=1) / 2)
    stiffest = float(fastest_rates(model, [state])[0]) if model.has_elements else TINY_RATE
    step = min(MOTION_STEP, MAX_STEP_ANGLE / turning, MAX_STIFFNESS / max(stiffest, TINY_RATE))
    first = pairs = max(1, int(np.ceil((times[1] - times[0]) / step / 2)))
    tried = parameters[:: -(-len(parameters) // TRIED_PARAMETERS)]
    while True:
        coarse, fine = accurate_motions(model, state, times, (2 * pairs, 3 * pairs))
        runs = [list(perturbed_motions(motion, tried)) for motion in (coarse, fine)]
        error = max(np.max(attitude_error(a.run.p, b.run.p)) for a, b in zip(*runs, strict=True))
        allowed = MAX_DEVIATION_ERROR * max(np.max(attitude_error(x.run.p, x.true.p)) for x in runs[1])
        if error <= allowed or pairs == MAX_REFINEMENT * first:
            return coarse, fine
        ratio = error / allowed if allowed else np.inf
        more = REFINEMENT_MARGIN * ratio ** (1 / DEVIATION_ORDER)
        pairs = int(min(np.ceil(pairs * more), MAX_REFINEMENT * first))


def perturbed_motions(
    motion: AccurateMotion, parameters: Sequence[Parameter], mistake: float = MOTION_MISTAKE
) -> Iterator[PerturbedMotion]:
    """Simulate a motion with each parameter off by a fraction of its scale.

    What is integrated is the deviation δ from the accurate motion (Encke's method; Battin, An Introduction to
    the Mathematics and Methods of Astrodynamics, section 10.1), with f' the mistaken equations of motion:

        δ̇ = f'(y + δ) − f(y)

    so that the error of a step is relative to the deviation, however fast the motion itself is. Steps of
    order 8 cost 1.7 times as much in a chain of 50 bodies: there stability limits them.

    Args:
        motion: without mistakes.
        parameters: of `list_parameters`.

    Yields:
        The motions, in the order of the parameters.

    """
    model, state = motion.model, motion.state
    size = max(1, MAX_BATCH_BODIES // model.n - 1)
    for first in range(0, len(parameters), size):
        part = parameters[first : first + size]
        cases = [(model, state), *(perturb(model, state, one, mistake) for one in part)]
        true, *runs = _simulate_batch(motion, cases)
        for parameter, run in zip(part, runs, strict=True):
            yield PerturbedMotion(parameter, run, true)


def _simulate_batch(motion: AccurateMotion, cases: Sequence[tuple[Model, State]]) -> list[Trajectory]:
    """Runs of all cases by their deviations from the first, the accurate motion, each on its joints."""
    times, substeps, n = motion.times, motion.substeps, motion.model.n
    system, (r, p, v, pdot) = side_by_side(cases)

    def true(stage: int) -> Array:
        return np.tile(motion.y[stage], len(cases))  # (2, 7, M)

    delta = np.stack([component_first(r, p), component_first(v, pdot)]) - true(0)
    x = system.x

    def slope(stages: Iterator[int], delta: Array) -> Array:
        q, rate = true(next(stages)) + delta
        acceleration = system.acceleration(q, rate, x=x)
        return np.stack([delta[1], acceleration - np.tile(acceleration[:, :n], len(cases))])

    samples, stage = [true(0) + delta], 0
    for h in np.diff(times):
        for _ in range(substeps):
            visited = iter((stage, stage + 1, stage + 1, stage + 2))
            delta = runge_kutta_4(partial(slope, visited), delta, h / substeps)
            stage += 2
            if system.winding:  # full turns of springs' angles go on from step to step
                r, p, v, pdot = (part.T for q in true(stage) + delta for part in (q[:3], q[3:]))
                x = system.winding.coordinates(r, p, v, pdot, x=x)[0]
        y = true(stage) + delta
        samples.append(np.stack(system.project(y[0], y[1])))
    # (cases, 2, T, N, 7)
    found = np.array(samples).reshape(len(times), 2, 7, len(cases), -1).transpose(3, 1, 0, 4, 2)
    return [
        Trajectory(times, q[..., :3], q[..., 3:], rate[..., :3], rate[..., 3:], substeps, start.x)
        for (_, start), (q, rate) in zip(cases, found, strict=True)
    ]


REGULARITY_RTOL = 1e-9
STRIDE_PARTS = 4  # of a stride, at which singular values are taken
SHORTEST_STRIDE = 1e-3  # of the time between samples
STEPS_PER_STRIDE = 64  # of the shortest stride; more than those whose length depends on the first guess


class RegularMotion(NamedTuple):
    """How long a motion is regular."""

    end: float  # s
    is_singular: bool  # whether it ends before the last sample
    singular_value: float  # at the end


def regular_motion(model: Model, state: State, times: Array) -> RegularMotion:
    """Follow a motion until it comes near a singular pose.

    Where the whole motion at once does not show that it is regular, it is followed in strides so short that a
    singular value that goes on to fall as it falls cannot reach 0 within one.

    Args:
        model: with loops.
        state: initial state, assembled.
        times: (T,) [s] of the samples, times[0] = 0.

    Returns:
        How long the smallest singular value of the rows that hold is at least `MIN_MOTION_SINGULAR_VALUE`.

    Raises:
        ArithmeticError: the integration stops early for another reason.

    """
    rank = regular_rank(model, state)
    t, last, value = 0.0, float(times[-1]), smallest_singular_value(model, state, rank)
    interval = float(np.min(np.diff(times)))
    longest = stride = last
    system, here = side_by_side([(model, state)])
    while t < last * (1 - 1e-12) and value >= MIN_MOTION_SINGULAR_VALUE:
        stride = min(stride, last - t)
        parts = STRIDE_PARTS * max(1, int(np.ceil(stride / interval)))
        grid = t + stride * np.linspace(0, 1, parts + 1)
        most = parts if stride > interval else np.inf  # steps: near a singular pose they become short
        try:
            run = integrate_collocation(system, *here, grid, REGULARITY_RTOL, project=True, max_steps=most)
            values = np.append(value, _singular_values(model, run, rank)[1:])
            is_safe = bool(np.all(2 * values[1:] - values[:-1] > 0))  # the next value as the last two go on
        except ArithmeticError:
            if stride < SHORTEST_STRIDE * interval and value > 10 * MIN_MOTION_SINGULAR_VALUE:
                raise
            is_safe = False
        if stride > interval and not (is_safe and np.all(values >= MIN_MOTION_SINGULAR_VALUE)):
            longest = stride = interval
        elif is_safe:
            t, value, stride = float(grid[-1]), float(values[-1]), min(2 * stride, longest)
            system, here = _end_of(run, model)
        elif stride < SHORTEST_STRIDE * interval:
            return RegularMotion(t, True, value)
        else:
            stride /= 2
    return RegularMotion(t, value < MIN_MOTION_SINGULAR_VALUE, value)


def resolved_motion_end(model: Model, state: State, last: float, step: float) -> float:
    """Follow a motion until step control needs more steps than a fixed step would take.

    Collocation has a high order, and its steps are long where a motion is smooth: at least 0.014 s on a
    Furuta pendulum in its first second.  Where it needs more than the fixed steps, the motion is too fast for
    these, as when a light body is thrown back within microseconds (steps of 2e-7 s on light-cart-pole).

    Args:
        model: without loops.
        state: initial state.
        last: how long the motion is followed at most [s].
        step: the fixed step [s].

    Returns:
        The time [s] from which on the next `STEPS_PER_STRIDE` steps do not suffice, or ``last``.

    """
    t, stride = 0.0, STEPS_PER_STRIDE * step
    system, here = side_by_side([(model, state)])
    while t < last * (1 - 1e-12):
        end = min(t + stride, last)
        try:
            run = integrate_collocation(
                system, *here, np.array([t, end]), REGULARITY_RTOL, max_steps=stride / step
            )
        except ArithmeticError:
            if stride <= STEPS_PER_STRIDE * step:
                return t
            stride /= 2
            continue
        t, stride = end, 2 * stride
        system, here = _end_of(run, model)
    return last


def _end_of(run: BatchIntegrationResult, model: Model) -> tuple[EliminatedSystem, Motion]:
    """The notes' system and the motion at the end of a run, from where it goes on."""
    return eliminated_system([model], run.x[-1]), (run.r[-1], run.p[-1], run.v[-1], run.pdot[-1])


def first_doubt(model: Model, state: State, run: Trajectory) -> float | None:
    """Find out from the samples of a run whether a singular pose may be among or between them.

    Args:
        model: with loops.
        state: its initial state, assembled.
        run: T samples, its loops closed but for the error of steps.

    Returns:
        The time [s] of the first sample whose singular value is below `MIN_MOTION_SINGULAR_VALUE`, or would
        reach 0 before the next one, falling on as it fell: a value that falls to 0 evenly, between samples,
        and rises again is noticed in any case.  None where there is no such sample.

    """
    rank, before = regular_rank(model, state), 0.0
    for i, t in enumerate(run.t):
        value = float(_singular_values(model, run.at(slice(i, i + 1)), rank)[0])
        if value < MIN_MOTION_SINGULAR_VALUE or 2 * value <= before:
            return float(t)
        before = value
    return None


def _singular_values(model: Model, run: Trajectory | IntegrationResult, rank: int) -> Array:
    """The smallest singular values (T,) at the samples of a motion."""
    p, cut = normalised(run.p), cut_open(model)
    moved = State(p, angular_velocity(p, run.pdot), r=run.r, v=run.v)
    return smallest_singular_values(cut, cut.state(with_joint_coordinates(model, moved)), rank)
