"""How a small perturbation of a motion grows, and until when its positions can be compared.

Twin runs in several random directions tangent to the manifold (of the minimal coordinates), all in one
batch; a twin that has moved away ten thousandfold is brought back to the size it began with (Benettin), so
that G stays the growth of a small perturbation however large it gets.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.invariants import attitude_error, position_error
from plumbline.model.kinematics import (
    angular_velocity,
    joint_vectors,
    quaternion_conjugate,
    quaternion_product,
    quaternion_rate,
    rotation_matrix,
    state_from_minimal,
)
from plumbline.model.sampling import derive_seed
from reference_impl.collocation import integrate_collocation
from reference_impl.structured import StructuredSystem

PERTURBATION_SIZE = (
    1e-7  # size of a perturbation: of each angle in rad, of each rate relative to the motion's own
)
PERTURBATION_COUNT = 4  # directions tried
RENORMALISATION_GROWTH = 1e4  # growth after which a twin is brought back, well before it stops being small
RTOL = 1e-10  # common steps: the error of the base and of the twins is nearly the same


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
    """G (T,), at least 1: how much the worst of several twins has moved away, over the perturbation.

    Distances are in units of the perturbation: of positions over size × the largest distance from the
    pivot, of attitudes over the size itself, whichever is larger.
    """
    return perturbation_growth_and_runs(model, state, times, [])[0]


def perturbation_growth_and_runs(
    model: Model, state: State, times: Array, other_models: Sequence[tuple[Model, State]]
) -> tuple[Array, Array, Array]:
    """G (T,), and r, p (1 + others, T, N, ·) of the model and ``others``, as many bodies, in common steps."""
    forest = StructuredSystem([model] * (PERTURBATION_COUNT + 1) + [m for m, _ in other_models])
    states = [state, *perturbed_states(model, state), *(s for _, s in other_models)]
    size, grown = np.full(PERTURBATION_COUNT, PERTURBATION_SIZE), np.empty((PERTURBATION_COUNT, len(times)))
    scale, done, arm = np.ones(PERTURBATION_COUNT), 0, 1e-3
    r, p, v, pdot = _integrate_batch(forest, states, times)
    shown = [0, *range(PERTURBATION_COUNT + 1, len(states))]
    beside = r[shown], p[shown]
    while True:
        arm = max(arm, float(np.max(np.linalg.norm(r[0], axis=-1))))
        away = np.array(
            [
                np.maximum(position_error(r[k], r[0]) / arm, attitude_error(p[k], p[0]))
                for k in range(1, PERTURBATION_COUNT + 1)
            ]
        )
        grown[:, done : done + away.shape[1]] = scale[:, None] * away / size[:, None]
        far = np.flatnonzero(np.any(away > RENORMALISATION_GROWTH * PERTURBATION_SIZE, axis=0))
        stop = max(int(far[0]), 1) if len(far) else away.shape[1] - 1
        if done + stop >= len(times) - 1:
            break
        base, *close = (
            _project_to_manifold(model, r[k, stop], p[k, stop], v[k, stop], pdot[k, stop])
            for k in range(PERTURBATION_COUNT + 1)
        )
        size = np.minimum(away[:, stop], PERTURBATION_SIZE)
        scale = scale * away[:, stop] / size
        near = [
            _interpolate_states(model, base, twin, part)
            for twin, part in zip(close, size / away[:, stop], strict=True)
        ]
        done += stop
        if other_models:
            forest, other_models = (
                StructuredSystem([model]).repeated(PERTURBATION_COUNT + 1),
                [],
            )
        r, p, v, pdot = _integrate_batch(forest, [base, *near], times[done : done + 2 * stop + 1])
    return np.asarray(np.maximum(np.max(grown, axis=0), 1.0)), *beside


def perturbed_states(
    model: Model, state: State, perturbation_size: float = PERTURBATION_SIZE, count: int = PERTURBATION_COUNT
) -> list[State]:
    """Neighbours of ``state`` on the manifold: attitudes, directions and rates turned by ``size`` rad."""
    rng = np.random.default_rng(derive_seed("twins"))
    found = []
    for _ in range(count):
        turn = perturbation_size * rng.normal(size=(model.n, 3)) / 2
        quaternion = np.concatenate([np.ones((model.n, 1)), turn], axis=1)
        p = quaternion_product(state.p, quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))
        spread = perturbation_size * max(
            float(np.max(np.abs(state.omega))), float(np.max(np.abs(state.udot))), 1.0
        )
        omega = state.omega + spread * rng.normal(size=(model.n, 3))
        u = state.u + np.cross(perturbation_size * rng.normal(size=(model.n, 3)), state.u)
        udot = state.udot + np.cross(spread * rng.normal(size=(model.n, 3)), state.u)
        found.append(_make_state(model, p, omega, u, udot))
    return found


def _integrate_batch(
    forest: StructuredSystem, states: list[State], times: Array
) -> tuple[Array, Array, Array, Array]:
    """r, p, ṙ, ṗ (runs, T, N, ·) of a batch of states of one model, from times[0]."""
    r, p, v = (np.concatenate([getattr(state, name) for state in states]) for name in ("r", "p", "v"))
    pdot = np.concatenate([quaternion_rate(state.p, state.omega) for state in states])
    run = integrate_collocation(forest, r, p, v, pdot, times, RTOL)
    parts = (np.split(x, len(states), axis=1) for x in (run.r, run.p, run.v, run.pdot))
    r_, p_, v_, pdot_ = (np.array(part) for part in parts)
    return r_, p_, v_, pdot_


def _project_to_manifold(model: Model, r: Array, p: Array, v: Array, pdot: Array) -> State:
    """The state on the manifold that a raw one, (N, ·) each, stands for."""
    p = p / np.linalg.norm(p, axis=1, keepdims=True)
    omega = angular_velocity(p, pdot)
    A = rotation_matrix(p)
    ends = [(A @ np.cross(omega, points)[..., None])[..., 0] + v for points in (model.proximal, model.distal)]
    gap_rate = ends[0] - np.concatenate([np.zeros((1, 3)), ends[1][:-1]])
    ell = np.where(model.rods, model.length, np.inf)[:, None]
    return _make_state(model, p, omega, joint_vectors(model, r, p) / ell, gap_rate / ell)


def _interpolate_states(model: Model, base: State, twin: State, part: float) -> State:
    """The state that lies ``part`` of the way from ``base`` to its neighbour ``twin``."""
    turn = quaternion_product(quaternion_conjugate(base.p), twin.p)
    turn = turn * np.where(turn[:, :1] < 0, -1.0, 1.0)
    turn[:, 1:] *= part
    turn[:, 0] = np.sqrt(1 - np.sum(turn[:, 1:] ** 2, 1))
    mixed = (getattr(base, x) + part * (getattr(twin, x) - getattr(base, x)) for x in ("omega", "u", "udot"))
    return _make_state(model, quaternion_product(base.p, turn), *mixed)


def _make_state(model: Model, p: Array, omega: Array, u: Array, udot: Array) -> State:
    """The lifted state of coordinates that may be off their unit spheres; u and u̇ only where rods are."""
    rods = model.rods[:, None]
    u = np.where(rods, u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), np.finfo(float).tiny), 0.0)
    udot = np.where(rods, udot - np.sum(udot * u, axis=1, keepdims=True) * u, 0.0)
    return state_from_minimal(model, p / np.linalg.norm(p, axis=1, keepdims=True), omega, u, udot)
