"""Motions by the reference's O(bodies) form of the notes' equations: single ones, many at once, and mistakes.

The effects of mistakes in parameters on a motion are differences of two runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from plumbline.engines.integrators import runge_kutta_4
from plumbline.model.datatypes import Array, EngineFailure, Model, State, Trajectory
from plumbline.model.invariants import attitude_error, joint_vector_rates
from plumbline.model.kinematics import (
    angular_velocity,
    forward_kinematics,
    joint_coordinates,
    joint_vectors,
    quaternion_rate,
)
from plumbline.truth.parameters import Parameter, perturb
from plumbline.truth.step_formulas import fastest_rates
from reference_impl.fast.chain_elimination import component_first
from reference_impl.fast.collocation import integrate_collocation
from reference_impl.fast.tree_elimination import TreeSystem, eliminated_acceleration, eliminated_system
from reference_impl.integrate import IntegrationResult, integrate_dop853

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
    start, x = (
        (state.r, state.p, state.v, quaternion_rate(state.p, state.omega)),
        joint_coordinates(model, state)[2],
    )
    run: IntegrationResult
    try:
        if (
            method == "dop853"
        ):  # absolute tolerances of 1 m, 1, 1 m/s and 1 1/s: those by default are too coarse
            form = eliminated_acceleration(model)
            run = integrate_dop853(model, *start, times, rtol, form, x=x, atol=rtol)
        else:
            system = eliminated_system([model], x)
            run = integrate_collocation(system, *start, times, rtol, project=True)
    except ArithmeticError as error:
        raise EngineFailure(str(error)) from None
    return Trajectory(times, run.r, run.p, run.v, run.pdot, run.steps, state.x)


MOTION_MISTAKE = 1e-5  # of a parameter's scale, in the runs that show its effect on the motion
MOTION_STEP = 2.0**-6  # s, largest step of those runs
MOTION_RTOL = 1e-13  # of the motion without mistakes
MAX_DEVIATION_ERROR = 1e-3  # of the largest deviation, what finer steps may change
MAX_HALVINGS = 4
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


def accurate_motion(model: Model, state: State, times: Array, substeps: int) -> AccurateMotion:
    """Simulate a motion by collocation.

    Args:
        model: the mechanism, without loops.
        times: (T,) sample times [s], equally spaced.

    Returns:
        The motion. A steady motion stays as steady as it can.

    Raises:
        ArithmeticError: as `integrate_collocation`.

    """
    stages = np.linspace(times[0], times[-1], 2 * substeps * (len(times) - 1) + 1)
    start = state.r, state.p, state.v, quaternion_rate(state.p, state.omega)
    run = integrate_collocation(eliminated_system([model], state.x), *start, stages, MOTION_RTOL)
    y = np.stack([np.concatenate([run.r, run.p], axis=-1), np.concatenate([run.v, run.pdot], axis=-1)], 1)
    return AccurateMotion(model, state, times, substeps, y.swapaxes(-1, -2))


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
    system = eliminated_system([model for model, _ in cases], np.concatenate([s.x for _, s in cases]))
    r, p, v, w = (np.concatenate([getattr(s, name) for _, s in cases]) for name in ("r", "p", "v", "omega"))
    start = r, p, v, quaternion_rate(p, w)
    run = integrate_collocation(system, *start, times, MOTION_RTOL, project=True, max_steps=max_steps)
    parts = zip(*(np.split(x, len(cases), axis=1) for x in (run.r, run.p, run.v, run.pdot)), strict=True)
    return [
        Trajectory(times, r, p, v, pdot, run.steps, state.x)
        for (_, state), (r, p, v, pdot) in zip(cases, parts, strict=True)
    ]


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
    pairs = max(1, int(np.ceil((times[1] - times[0]) / step / 2)))
    tried = parameters[:: -(-len(parameters) // TRIED_PARAMETERS)]
    for halving in range(MAX_HALVINGS + 1):
        coarse, fine = (accurate_motion(model, state, times, many * pairs) for many in (2, 3))
        runs = [list(perturbed_motions(motion, tried)) for motion in (coarse, fine)]
        errors = [np.max(attitude_error(a.run.p, b.run.p)) for a, b in zip(*runs, strict=True)]
        sizes = [np.max(attitude_error(one.run.p, one.true.p)) for one in runs[1]]
        if max(errors) <= MAX_DEVIATION_ERROR * max(sizes) or halving == MAX_HALVINGS:
            break
        pairs *= 2
    return coarse, fine


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
    """Runs of all cases by their deviations from the first, which is the accurate motion, unstabilised."""
    times, substeps, n = motion.times, motion.substeps, motion.model.n
    system = eliminated_system([model for model, _ in cases], np.concatenate([s.x for _, s in cases]))
    r, p, v = (np.concatenate([getattr(state, name) for _, state in cases]) for name in ("r", "p", "v"))
    pdot = quaternion_rate(p, np.concatenate([state.omega for _, state in cases]))

    def true(stage: int) -> Array:
        return np.tile(motion.y[stage], len(cases))  # (2, 7, M)

    delta = np.stack([component_first(r, p), component_first(v, pdot)]) - true(0)
    winding = system.winding if isinstance(system, TreeSystem) else None
    x = system.x if isinstance(system, TreeSystem) else None

    def slope(stages: Iterator[int], delta: Array) -> Array:
        q, rate = true(next(stages)) + delta
        if isinstance(system, TreeSystem):
            acceleration = system.acceleration(q, rate, x=x)
        else:
            acceleration = system.acceleration(q, rate)
        return np.stack([delta[1], acceleration - np.tile(acceleration[:, :n], len(cases))])

    samples, stage = [true(0) + delta], 0
    for h in np.diff(times):
        for _ in range(substeps):
            visited = iter((stage, stage + 1, stage + 1, stage + 2))
            delta = runge_kutta_4(partial(slope, visited), delta, h / substeps)
            stage += 2
            if winding:  # full turns of springs' angles go on from step to step
                r, p, v, pdot = (part.T for q in true(stage) + delta for part in (q[:3], q[3:]))
                x = winding.coordinates(r, p, v, pdot, x)[0]
        y = true(stage) + delta
        samples.append(np.stack(system.project(y[0], y[1])) if isinstance(system, TreeSystem) else y)
    # (cases, 2, T, N, 7)
    found = np.moveaxis(
        np.array(samples).reshape(len(times), 2, 7, len(cases), -1), (3, 1, 0, 4, 2), (0, 1, 2, 3, 4)
    )
    runs = [
        Trajectory(times, q[..., :3], q[..., 3:], rate[..., :3], rate[..., 3:], substeps, start.x)
        for (_, start), (q, rate) in zip(cases, found, strict=True)
    ]
    if isinstance(system, TreeSystem):  # whose samples have been projected
        return runs
    return [_on_manifold(model, run) for (model, _), run in zip(cases, runs, strict=True)]


def _on_manifold(model: Model, run: Trajectory) -> Trajectory:
    """The run of a chain with unit quaternions, and points that satisfy the joints exactly."""
    omega = angular_velocity(run.p, run.pdot)
    ell = np.where(model.rods, model.length, np.inf)[:, None]
    u = joint_vectors(model, run.r, run.p) / ell
    u = u / np.where(model.rods[:, None], np.linalg.norm(u, axis=-1, keepdims=True), 1.0)
    udot = joint_vector_rates(model, run, omega) / ell
    udot = udot - np.sum(udot * u, axis=-1, keepdims=True) * u
    p = run.p / np.linalg.norm(run.p, axis=-1, keepdims=True)
    _, _, r, v = forward_kinematics(model, p, omega, u, udot)
    return Trajectory(run.t, r, p, v, quaternion_rate(p, omega), run.steps)
