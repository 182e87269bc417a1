"""Random states on the constraint manifold of a scenario, and the seeds they come from."""

from __future__ import annotations

import hashlib

import numpy as np

from plumbline.kinematics import lift
from plumbline.records import Model, State


def seed_of(*parts: str) -> int:
    """A seed that depends on the words given and on nothing else (not on hash randomisation)."""
    return int.from_bytes(hashlib.sha256("\0".join(parts).encode()).digest()[:8], "big")


def random_states(model: Model, count: int, seed: int) -> list[State]:
    """``count`` states of the model's geometry: attitudes and rod directions uniform, rates slow to fast.

    Rates are Gaussian with a standard deviation drawn per state, log-uniform from a tenth to
    four times the pendulum's own rate √(g/ℓ), so that gravity dominates in some states and the
    velocity terms in others.  u and u̇ are zero where the joint is a ball joint.
    """
    rng = np.random.default_rng(seed)
    reach = np.linalg.norm(model.proximal, axis=1) + model.length
    own_rate = np.sqrt(max(float(np.linalg.norm(model.gravity)), 1e-3) / max(float(np.mean(reach)), 1e-3))
    states = []
    for _ in range(count):
        p = rng.normal(size=(model.n, 4))
        p /= np.linalg.norm(p, axis=1, keepdims=True)
        spread = own_rate * 10 ** rng.uniform(-1.0, np.log10(4.0))
        omega = spread * rng.normal(size=(model.n, 3))
        u = rng.normal(size=(model.n, 3))
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        udot = np.cross(spread * rng.normal(size=(model.n, 3)), u)
        rod = model.rods[:, None]
        states.append(lift(model, p, omega, np.where(rod, u, 0.0), np.where(rod, udot, 0.0)))
    return states
