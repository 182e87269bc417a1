"""Motions of mechanisms by the notes' equations: many side by side, by collocation with common steps.

Imports SciPy: not in a run's own process.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from plumbline.model.datatypes import Array, Model, State, Trajectory
from plumbline.model.kinematics import joint_coordinates, maximal_coordinates
from reference_impl.arrays import Motion
from reference_impl.fast.collocation import BatchIntegrationResult, integrate_collocation
from reference_impl.fast.tree_elimination import EliminatedSystem, eliminated_system

Cases = Sequence[tuple[Model, State]]  # of loops all with the same joints between the same bodies


def side_by_side(cases: Cases) -> tuple[EliminatedSystem, Motion]:
    """Return the notes' system of all mechanisms, and r, p, ṙ and ṗ of all bodies."""
    x = np.concatenate([joint_coordinates(*case)[2] for case in cases])
    start = maximal_coordinates(*(state for _, state in cases))
    return eliminated_system([model for model, _ in cases], x), start


def integrate_batch(cases: Cases, times: Array, rtol: float, **options: Any) -> BatchIntegrationResult:
    """Integrate mechanisms from their states.

    Args:
        times: (T,) sample times [s], ascending from the initial time.
        options: of `integrate_collocation`.

    """
    system, start = side_by_side(cases)
    return integrate_collocation(system, *start, times, rtol, **options)


def trajectories(run: BatchIntegrationResult, cases: Cases) -> list[Trajectory]:
    """Return the motion of each mechanism of a batch."""
    ends = np.cumsum([model.n for model, _ in cases])[:-1]
    parts = zip(*(np.split(y, ends, axis=1) for y in (run.r, run.p, run.v, run.pdot)), strict=True)
    return [
        Trajectory(run.t, r, p, v, pdot, run.steps, state.x)
        for (_, state), (r, p, v, pdot) in zip(cases, parts, strict=True)
    ]
