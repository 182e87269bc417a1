"""Random pendulums and states for the tests: full inertia tensors, offset attachments, any mix of joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import state_from_minimal
from plumbline.model.random_mechanisms import random_inertias


def random_model(
    rng: np.random.Generator,
    rods: Sequence[bool | int],
    mass_decades: float = 0.0,
    loads: bool = False,
    drag: bool = False,
) -> Model:
    """A chain with a rod at each joint k with rods[k]; masses are log-uniform over ± ``decades``."""
    n = len(rods)
    mass = 10 ** rng.uniform(-mass_decades, mass_decades, n)
    return Model.chain(
        mass=mass,
        inertia=random_inertias(rng, mass),
        proximal=0.3 * rng.normal(size=(n, 3)),
        distal=0.3 * rng.normal(size=(n, 3)) * (np.arange(n) < n - 1)[:, None],
        length=np.where(np.array(rods, dtype=bool), rng.uniform(0.2, 1.0, n), 0.0),
        gravity=np.array([0.0, 0.0, -9.81]),
        force=loads * mass[:, None] * rng.normal(size=(n, 3)),
        moment=loads * mass[:, None] * rng.normal(size=(n, 3)),
        drag_force=drag * mass * rng.uniform(0, 1, n),
        drag_moment=drag * mass * rng.uniform(0, 0.1, n),
    )


def random_state(rng: np.random.Generator, model: Model, rate: float = 2.0) -> State:
    """A state on the manifold; ``rate`` (rad/s) is the standard deviation of every angular rate."""
    n, rod = model.n, model.rods[:, None]
    p = rng.normal(size=(n, 4))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    u = rng.normal(size=(n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    udot = np.cross(rate * rng.normal(size=(n, 3)), u)
    omega = rate * rng.normal(size=(n, 3))
    return state_from_minimal(model, p, omega, np.where(rod, u, 0.0), np.where(rod, udot, 0.0))


def random_chain(
    rng: np.random.Generator, rods: Sequence[bool | int], rate: float = 2.0, **options: float | bool
) -> tuple[Model, State]:
    """A random model, ``options`` as `random_model`, and a random state of it."""
    model = random_model(rng, rods, **options)  # type: ignore[arg-type]
    return model, random_state(rng, model, rate)


def in_other_units(
    model: Model, state: State, length: float, mass: float, time: float
) -> tuple[Model, State]:
    """The same pendulum with lengths, masses and times measured in other units (values multiplied)."""
    force = mass * length / time**2
    scaled = model.changed(
        mass=model.mass * mass,
        inertia=model.inertia * mass * length**2,
        proximal=model.proximal * length,
        distal=model.distal * length,
        length=model.length * length,
        gravity=model.gravity * length / time**2,
        force=model.force * force,
        moment=model.moment * force * length,
        drag_force=model.drag_force * mass / time,
        drag_moment=model.drag_moment * mass * length**2 / time,
    )
    return scaled, state_from_minimal(scaled, state.p, state.omega / time, state.u, state.udot / time)


def norms_per_body(difference: Array) -> Array:
    """Euclidean norm per body."""
    return np.asarray(np.linalg.norm(difference, axis=-1))
