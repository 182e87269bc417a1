"""How a small perturbation of a motion grows, and until when its positions can be compared.

The motion and several neighbours, perturbed in random directions of the minimal coordinates, are integrated
in one batch.  A neighbour whose distance has grown ten thousandfold is moved back to its initial distance
(Benettin's method), so that G remains the growth of a small perturbation however large it becomes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plumbline.model.datatypes import Array, Model, State, Trajectory
from plumbline.model.invariants import attitude_error, position_error
from plumbline.model.kinematics import (
    angular_velocity,
    complete_state,
    cross,
    normalised,
    quaternion_conjugate,
    quaternion_product,
    quaternion_rate,
)
from plumbline.model.loops import assembled
from plumbline.model.sampling import derive_seed

PERTURBATION_SIZE = 1e-7  # of each angle [rad], of each rate relative to the largest rate of the motion
PERTURBATION_COUNT = 4  # random directions
# growth after which a neighbour is moved back, while its distance is still small
RENORMALISATION_GROWTH = 1e4
RTOL = 1e-10  # the steps are common, so that motion and neighbours have nearly the same error

HORIZON_TOLERANCE = 1e-9  # m: positions are compared while the error to be expected stays below this


def predictability_horizon(
    times: Array,
    growth: Array,
    initial_error: float | Array,
    uncertainty: float | Array = 0.0,
    tolerance: float = HORIZON_TOLERANCE,
) -> float:
    """Return T_h, the last sample time up to which positions of a motion can be compared [s].

    The error to be expected at a time is an initial error, grown as small perturbations of this motion grow,
    plus the uncertainty of what is compared with; its running maximum must not exceed the tolerance.

    Args:
        times: (T,) sample times [s].
        growth: (T,) growth G of a small perturbation, from `perturbation_growth` [–].
        initial_error: rounding of a run before growth, one number or (T,) [m].
        uncertainty: of the true positions, one number or (T,) [m].
        tolerance: the largest tolerable error [m].

    Returns:
        T_h; 0 where not even the first sample is within the tolerance.

    """
    expected = np.maximum.accumulate(initial_error * growth + uncertainty)
    good = np.flatnonzero(expected <= tolerance)
    return float(times[good[-1]]) if len(good) else 0.0


def perturbation_growth(model: Model, state: State, times: Array) -> Array:
    """Compute the growth G of small perturbations of a motion.

    Distances are in units of the perturbation: of positions over size × the largest distance from the pivot,
    of attitudes over the size itself, whichever is larger.

    Args:
        times: (T,) [s] of the samples.

    Returns:
        (T,) largest growth over all perturbations, at least 1.

    """
    return perturbation_growth_and_runs(model, state, times, [])[0]


def perturbation_growth_and_runs(
    model: Model, state: State, times: Array, other_models: Sequence[tuple[Model, State]]
) -> tuple[Array, list[Trajectory]]:
    """Compute the growth of small perturbations, and motions of other models in the same batch.

    Args:
        times: (T,) [s] of the samples.
        other_models: K models of as many bodies, with their initial states.

    Returns:
        The growth (T,) of `perturbation_growth`, and 1 + K runs: the unperturbed motion and the others.

    """
    neighbours = range(1, PERTURBATION_COUNT + 1)
    cases = [(model, one) for one in (state, *perturbed_states(model, state))] + [*other_models]
    r, p, v, pdot, x = _integrate_batch(cases, times)
    unperturbed = [0, *range(PERTURBATION_COUNT + 1, len(cases))]
    runs = [Trajectory(times, r[k], p[k], v[k], pdot[k], 0) for k in unperturbed]
    size, growth = np.full(PERTURBATION_COUNT, PERTURBATION_SIZE), np.empty((PERTURBATION_COUNT, len(times)))
    earlier_growth, done, arm = np.ones(PERTURBATION_COUNT), 0, 1e-3
    while True:
        arm = max(arm, float(np.max(np.linalg.norm(r[0], axis=-1))))
        distance = np.array(
            [np.maximum(position_error(r[k], r[0]) / arm, attitude_error(p[k], p[0])) for k in neighbours]
        )
        growth[:, done : done + distance.shape[1]] = earlier_growth[:, None] * distance / size[:, None]
        far = np.flatnonzero(np.any(distance > RENORMALISATION_GROWTH * PERTURBATION_SIZE, axis=0))
        stop = max(int(far[0]), 1) if len(far) else distance.shape[1] - 1
        if done + stop >= len(times) - 1:
            return np.asarray(np.maximum(np.max(growth, axis=0), 1.0)), runs
        base, *moved = (
            replace(
                project_to_manifold(model, *(y[k, stop] for y in (r, p, v, pdot))), x=x[k, stop, : model.n]
            )
            for k in (0, *neighbours)
        )
        size = np.minimum(distance[:, stop], PERTURBATION_SIZE)
        earlier_growth = earlier_growth * distance[:, stop] / size
        parts = size / distance[:, stop]
        near = [_interpolate_states(model, base, at, part) for at, part in zip(moved, parts, strict=True)]
        done += stop
        some = times[done : done + 2 * stop + 1]
        r, p, v, pdot, x = _integrate_batch([(model, one) for one in (base, *near)], some)


def perturbed_states(
    model: Model, state: State, perturbation_size: float = PERTURBATION_SIZE, count: int = PERTURBATION_COUNT
) -> list[State]:
    """Create neighbours of a state on the constraint manifold, with normally distributed perturbations.

    Args:
        perturbation_size: standard deviation of each angle [rad], and of each rate relative to the largest
            rate of the state (or 1 rad/s).

    Returns:
        The neighbours, always the same for the same arguments.

    """
    rng = np.random.default_rng(derive_seed("twins"))
    fastest = max(float(np.max(np.abs(state.omega))), float(np.max(np.abs(state.udot))), 1.0)
    found = []
    for _ in range(count):
        turn = perturbation_size * rng.normal(size=(model.n, 3)) / 2
        quaternion = np.concatenate([np.ones((model.n, 1)), turn], axis=1)
        p = normalised(quaternion_product(state.p, normalised(quaternion)))
        spread = perturbation_size * fastest
        omega = state.omega + spread * rng.normal(size=(model.n, 3))
        u = state.u + cross(perturbation_size * rng.normal(size=(model.n, 3)), state.u)
        udot = state.udot + cross(spread * rng.normal(size=(model.n, 3)), state.u)
        u = u / np.maximum(
            np.linalg.norm(u, axis=1, keepdims=True), np.finfo(float).tiny
        )  # 0 of other joints
        udot = udot - np.sum(udot * u, axis=1, keepdims=True) * u
        others: tuple[Array, ...] = state.x, state.r, state.xdot, state.v
        if not all(kind.holds_no_turn for kind in model.kinds[: model.n]):  # these are coordinates too
            sizes = (perturbation_size, perturbation_size, spread, spread)
            others = tuple(y + size * rng.normal(size=y.shape) for y, size in zip(others, sizes, strict=True))
        x, r, xdot, v = others
        near = complete_state(model, State(p, omega, u, udot, r, v, x, xdot))
        found.append(assembled(model, near))
    return found


def _integrate_batch(cases: Sequence[tuple[Model, State]], times: Array) -> list[Array]:
    """r, p, ṙ, ṗ, x (runs, T, N, ·) of a batch of mechanisms of as many bodies, from times[0]."""
    from plumbline.truth.notes_motion import integrate_batch  # with SciPy: not in a run's own process

    run = integrate_batch(cases, times, RTOL)
    return [np.array(np.split(y, len(cases), axis=1)) for y in (run.r, run.p, run.v, run.pdot, run.x)]


def project_to_manifold(model: Model, r: Array, p: Array, v: Array, pdot: Array) -> State:
    """Return the state on the constraint manifold next to an integrated one.

    Joint coordinates are not computed.

    Args:
        r: (N, 3) centres of mass [m], world frame.
        p: (N, 4) quaternions, normalised here.
        v: (N, 3) ṙ [m/s].
        pdot: (N, 4) ṗ [1/s].

    """
    from reference_impl.fast.chain_elimination import component_first
    from reference_impl.fast.tree_elimination import eliminated_system

    q, qdot = eliminated_system([model]).project(component_first(r, p), component_first(v, pdot))
    p = np.ascontiguousarray(q[3:].T)
    return State(p, angular_velocity(p, qdot[3:].T), r=q[:3].T, v=qdot[:3].T)


def _interpolate_states(model: Model, base: State, other: State, part: float) -> State:
    """The state at the fraction ``part`` of the way from ``base`` to a close ``other``."""
    turn = quaternion_product(quaternion_conjugate(base.p), other.p)
    turn = turn * np.where(turn[:, :1] < 0, -1.0, 1.0)
    turn[:, 1:] *= part
    turn[:, 0] = np.sqrt(1 - np.sum(turn[:, 1:] ** 2, 1))
    p, names = quaternion_product(base.p, turn), ("omega", "r", "v")
    omega, r, v = (getattr(base, x) + part * (getattr(other, x) - getattr(base, x)) for x in names)
    return replace(project_to_manifold(model, r, p, v, quaternion_rate(p, omega)), x=base.x)
