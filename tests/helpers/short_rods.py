"""The ball joint as the limit ℓ → 0 of the notes' rod (E1), along states on the slow manifold.

A short rod turns fast, at √(tension/(m ℓ)) rad/s, unless it already points where the ball joint would pull.
With F the ball joint's force on the body (N, world frame), u = −F/‖F‖ and u̇ its rate along the ball's
motion start the rod there, up to O(ℓ).  Accelerations and motions then differ from the ball's by O(ℓ).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reference_impl.fast.chain_elimination import StructuredSystem
from reference_impl.fast.collocation import BatchIntegrationResult, integrate_collocation
from reference_impl.mechanism import Array, Mechanism


@dataclass(frozen=True, eq=False)
class RodLengthStudy:
    """Rods of several lengths beside their limit."""

    length: Array  # (K,) m
    acceleration: Array  # (K,) m/s², largest ‖r̈ − r̈_ball‖ at the start
    reaction: Array  # (K,) N, largest ‖F − F_ball‖ at the start
    position: Array  # (K,) m, largest distance from the ball's motion over the sample times
    observed_order: (
        Array  # (3, K − 1) observed order in ℓ of each, from neighbours: 1 where the ball is the limit
    )
    runs: tuple[BatchIntegrationResult, ...]


def replace_balls_by_rods(
    ball: Mechanism, r: Array, p: Array, v: Array, pdot: Array, length: float
) -> tuple[Mechanism, Array, Array]:
    """The chain with every ball joint made a rod of ``length`` m, and its r, ṙ (N, 3) on the slow manifold.

    r, ṙ (N, 3), p, ṗ (N, 4) are of the ball-jointed chain; p and ṗ stay.  Raises ValueError where
    a joint carries no force, so that no direction is the slow one.
    """
    u, udot = slow_manifold_directions(ball, r, p, v, pdot)
    rods = ball.changed(length=np.full(ball.n, length))
    return rods, r + np.cumsum(length * u, axis=0), v + np.cumsum(length * udot, axis=0)


def slow_manifold_directions(
    ball: Mechanism, r: Array, p: Array, v: Array, pdot: Array
) -> tuple[Array, Array]:
    """U = −F/‖F‖ (N, 3) of the ball joints' forces, and u̇ (1/s) along the ball's motion.

    u̇ is the slope of the polynomial of degree 8 through u at nine times of the next instant.
    """
    forest = StructuredSystem([ball])
    omega = 2 * np.linalg.norm(pdot, axis=1).max()
    reach = np.abs(np.concatenate([ball.proximal, ball.distal])).max()
    instant = 0.1 / max(omega, float(np.sqrt(np.linalg.norm(ball.gravity) / reach)))
    times = instant * (1 - np.cos(np.pi * np.arange(9) / 8)) / 2
    run = integrate_collocation(forest, r, p, v, pdot, times, 1e-13)
    force = np.stack(
        [forest.solve(*state).joint_reaction for state in zip(run.r, run.p, run.v, run.pdot, strict=True)]
    )
    size = np.linalg.norm(force, axis=-1, keepdims=True)
    if np.any(size[0] == 0):
        raise ValueError(
            f"joint {int(np.argmin(size[0])) + 1} carries no force: a rod there has no slow direction"
        )
    u = -force / size
    fit = np.polynomial.chebyshev.chebfit(2 * times / instant - 1, u.reshape(9, -1), 8)
    slope = np.polynomial.chebyshev.chebval(-1.0, np.polynomial.chebyshev.chebder(fit)) * 2 / instant
    udot = np.asarray(slope).reshape(-1, 3)
    return u[0], udot - u[0] * np.sum(u[0] * udot, axis=1, keepdims=True)


def study_rod_limit(
    ball: Mechanism,
    r: Array,
    p: Array,
    v: Array,
    pdot: Array,
    lengths: Sequence[float],
    times: Array,
    rtol: float,
) -> RodLengthStudy:
    """The family of ``lengths`` (m) beside the ball-jointed chain: state, motion over ``times``, rates."""
    limit = StructuredSystem([ball]).solve(r, p, v, pdot)
    motion = integrate_collocation([ball], r, p, v, pdot, times, rtol)
    found, runs = [], []
    for length in lengths:
        rods, r0, v0 = replace_balls_by_rods(ball, r, p, v, pdot, length)
        x = StructuredSystem([rods]).solve(r0, p, v0, pdot)
        run = integrate_collocation([rods], r0, p, v0, pdot, times, rtol)
        runs.append(run)
        found.append(
            [
                _largest_norm(x.acceleration - limit.acceleration),
                _largest_norm(x.joint_reaction - limit.joint_reaction),
                _largest_norm(run.r - motion.r),
            ]
        )
    error = np.array(found).T
    rate = np.diff(np.log(error)) / np.diff(np.log(lengths))
    return RodLengthStudy(np.array(lengths), error[0], error[1], error[2], rate, tuple(runs))


def _largest_norm(difference: Array) -> float:
    """The largest norm of 3-vectors (..., 3)."""
    return float(np.max(np.linalg.norm(difference, axis=-1)))
