"""How a small perturbation of a scenario grows, and until when its positions can be compared."""

from __future__ import annotations

import numpy as np

from plumbline.flow import flow
from plumbline.kinematics import lift, multiply
from plumbline.measures import attitude_error, position_error
from plumbline.records import Array, Model, State
from plumbline.sampling import seed_of

TWIN = 1e-7  # size of a perturbation, rad and of rates relative to the motion's own
TWINS = 4  # directions tried


def twins(model: Model, state: State, size: float = TWIN, count: int = TWINS) -> list[State]:
    """Neighbours of ``state`` on the manifold: attitudes, directions and rates turned by ``size`` rad."""
    rng = np.random.default_rng(seed_of("twins"))
    found = []
    for _ in range(count):
        turn = size * rng.normal(size=(model.n, 3)) / 2
        quaternion = np.concatenate([np.ones((model.n, 1)), turn], axis=1)
        p = multiply(state.p, quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))
        spread = size * max(float(np.max(np.abs(state.omega))), float(np.max(np.abs(state.udot))), 1.0)
        omega = state.omega + spread * rng.normal(size=(model.n, 3))
        tilt = np.cross(size * rng.normal(size=(model.n, 3)), state.u)
        u = state.u + tilt
        u = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), np.finfo(float).tiny)
        udot = state.udot + np.cross(spread * rng.normal(size=(model.n, 3)), state.u)
        udot = udot - np.sum(udot * u, axis=1, keepdims=True) * u
        found.append(lift(model, p, omega, u, udot))
    return found


def growth(model: Model, state: State, times: Array) -> Array:
    """G (T,), at least 1: how much the worst of several twins has moved away, over the perturbation.

    Distances are in units of the perturbation: of positions over size × the distance from the pivot, of
    attitudes over the size itself, whichever is larger.
    """
    runs = flow([model] * (TWINS + 1), [state, *twins(model, state)], times, 1e-10)
    arm = max(float(np.max(np.linalg.norm(runs[0].r, axis=-1))), 1e-3)
    away = [
        np.maximum(position_error(run.r, runs[0].r) / arm, attitude_error(run.p, runs[0].p))
        for run in runs[1:]
    ]
    return np.asarray(np.maximum(np.max(away, axis=0) / TWIN, 1.0))
