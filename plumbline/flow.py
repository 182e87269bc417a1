"""Motions of several models at once by the reference's structured form: what truth and horizon need.

One DOP853 over all of them: equal to single runs within the tolerance, at a fraction of the cost.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.integrate import solve_ivp

from plumbline.kinematics import rate
from plumbline.records import Array, EngineFailure, Model, State, Trajectory
from reference_impl.chain import Chain
from reference_impl.forest import Forest


def flow(models: Sequence[Model], states: Sequence[State], times: Array, rtol: float) -> list[Trajectory]:
    """Trajectories at ``times`` of each model from its state, the notes' raw form (N6).

    Absolute tolerances are ``rtol`` of 1 m, 1, 1 m/s and 1 1/s.  Raises EngineFailure where the
    integrator stops early.
    """
    forest = Forest([Chain(**vars(model)) for model in models])
    size = forest.size
    q = np.concatenate([np.concatenate([s.r, s.p], axis=1) for s in states]).T
    v = np.concatenate([np.concatenate([s.v, rate(s.p, s.omega)], axis=1) for s in states]).T

    def slope(_: float, y: Array) -> Array:
        half = y.reshape(14, size)
        return np.concatenate([half[7:], forest.acceleration(half[:7], half[7:])]).ravel()

    start = np.concatenate([q, v]).ravel()
    found = solve_ivp(slope, (0.0, times[-1]), start, "DOP853", times, rtol=rtol, atol=rtol)
    if not found.success:
        raise EngineFailure(f"DOP853 stopped at t = {found.t[-1]} s: {found.message}")
    y = np.moveaxis(found.y.reshape(14, size, len(times)), 2, 0).swapaxes(1, 2)  # (T, M, 14)
    ends = np.cumsum([model.n for model in models])[:-1]
    steps = int(found.nfev) // 12
    return [
        Trajectory(times, part[..., :3], part[..., 3:7], part[..., 7:10], part[..., 10:], steps)
        for part in np.split(y, ends, axis=1)
    ]
