"""Random states on the constraint manifold of a scenario, and the seeds they come from."""

from __future__ import annotations

import hashlib

import numpy as np

from plumbline.model.datatypes import KINDS, Model, State
from plumbline.model.kinematics import forward_kinematics


def derive_seed(*parts: str) -> int:
    """Derive a seed from words; the same on every machine and in every process.

    Args:
        *parts: the words, for example a purpose and a scenario's digest.

    Returns:
        A whole number below 2⁶⁴.

    """
    return int.from_bytes(hashlib.sha256("\0".join(parts).encode()).digest()[:8], "big")


def compared_states(model: Model, state: State, digest: str, count: int) -> list[State]:
    """Draw the states at which a scenario is compared.

    Args:
        model: the scenario's mechanism.
        state: its initial state.
        digest: hash of its numbers, which the draw depends on.
        count: how many random states.

    Returns:
        The initial state, then the random ones.

    """
    return [state, *random_states(model, count, derive_seed("states", digest))]


def random_states(model: Model, count: int, seed: int) -> list[State]:
    """Draw states of the model: attitudes and rod directions uniform, rates slow to fast.

    Angles are uniform over ±3 rad, shifts and free positions Gaussian over 1 m.
    Rates are Gaussian with a standard deviation drawn per state, log-uniform from a tenth to four times the
    pendulum's own rate √(g/ℓ), so that gravity dominates in some states and the velocity terms in others.

    Args:
        model: the chain of N bodies; only its geometry and gravity count.
        count: how many states.
        seed: the same seed gives the same states.

    Returns:
        The states, on the constraint manifold; ``u`` and ``udot`` are zero where the joint is a ball joint.

    """
    rng = np.random.default_rng(seed)
    hanging_length = np.linalg.norm(model.proximal, axis=1) + model.length
    own_rate = np.sqrt(
        max(float(np.linalg.norm(model.gravity)), 1e-3) / max(float(np.mean(hanging_length)), 1e-3)
    )
    p, omega, u, udot = (np.zeros((count, model.n, size)) for size in (4, 3, 3, 3))
    for k in range(count):
        p[k] = rng.normal(size=(model.n, 4))
        spread = own_rate * 10 ** rng.uniform(-1.0, np.log10(4.0))
        omega[k] = spread * rng.normal(size=(model.n, 3))
        u[k] = rng.normal(size=(model.n, 3))
        udot[k] = spread * rng.normal(size=(model.n, 3))
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    u, udot = (np.where(model.rods[:, None], x, 0.0) for x in (u, np.cross(udot, u)))
    free = np.array([kind == "free" for kind in model.kind])[:, None]
    x, xdot, r, v = (np.zeros((count, model.n, size)) for size in (2, 2, 3, 3))
    for k in range(count if set(model.kind) - {"rod", "ball"} else 0):
        for i, kind in enumerate(model.kind):
            for j, (motion, _) in enumerate(KINDS[kind].motions):
                x[k, i, j] = rng.uniform(-3, 3) if motion == "turn" else rng.normal()
        spread = own_rate * 10 ** rng.uniform(-1.0, np.log10(4.0))
        xdot[k] = spread * rng.normal(size=xdot[k].shape)
        r[k], v[k] = (np.where(free, size * rng.normal(size=r[k].shape), 0.0) for size in (1.0, spread))
    p, omega, r, v = forward_kinematics(model, p, omega, u, udot, r, v, x, xdot)
    return [State(*parts) for parts in zip(p, omega, u, udot, r, v, x, xdot, strict=True)]
