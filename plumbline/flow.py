"""Motions of several models at once by the reference's structured form: what truth and horizon need."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.integrate import solve_ivp

from plumbline.kinematics import rate
from plumbline.records import Array, EngineFailure, Model, State, Trajectory
from reference_impl import collocation
from reference_impl.chain import Chain
from reference_impl.forest import Forest

Method = Literal["collocation", "dop853"]


def flow(
    models: Sequence[Model],
    states: Sequence[State],
    times: Array,
    rtol: float,
    method: Method = "collocation",
) -> list[Trajectory]:
    """Trajectories at ``times`` of each model from its state, the notes' raw form (N6), in common steps.

    Raises EngineFailure where the integrator stops early.
    """
    forest = Forest([Chain(**vars(model)) for model in models])
    r, p, v, omega = (np.concatenate([getattr(s, k) for s in states]) for k in ("r", "p", "v", "omega"))
    pdot = rate(p, omega)
    try:
        if method == "collocation":
            run = collocation.integrate(forest, r, p, v, pdot, times, rtol)
            parts, steps = (run.r, run.p, run.v, run.pdot), run.steps
        else:
            parts, steps = dop853(forest, (r, p, v, pdot), times, rtol)
    except ArithmeticError as error:
        raise EngineFailure(str(error)) from None
    ends = np.cumsum([model.n for model in models])[:-1]
    each = zip(*(np.split(part, ends, axis=1) for part in parts), strict=True)
    return [Trajectory(times, r_, p_, v_, pdot_, steps) for r_, p_, v_, pdot_ in each]


def dop853(
    forest: Forest, start: tuple[Array, Array, Array, Array], times: Array, rtol: float
) -> tuple[tuple[Array, Array, Array, Array], int]:
    """The same motions by DOP853; absolute tolerances are ``rtol`` of 1 m, 1, 1 m/s and 1 1/s."""
    r, p, v, pdot = start
    size = forest.size

    def slope(_: float, y: Array) -> Array:
        half = y.reshape(14, size)
        return np.concatenate([half[7:], forest.acceleration(half[:7], half[7:])]).ravel()

    first = np.concatenate([r, p, v, pdot], axis=1).T.ravel()
    found = solve_ivp(slope, (0.0, times[-1]), first, "DOP853", times, rtol=rtol, atol=rtol)
    if not found.success:
        raise ArithmeticError(f"DOP853 stopped at t = {found.t[-1]} s: {found.message}")
    y = np.moveaxis(found.y.reshape(14, size, len(times)), (0, 1, 2), (2, 1, 0))  # (T, M, 14)
    return (y[..., :3], y[..., 3:7], y[..., 7:10], y[..., 10:]), int(found.nfev) // 12
