"""Random pendulums and states for the tests: full inertia tensors, offset attachments, any mix of joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import complete_state
from plumbline.model.random_mechanisms import random_inertias, random_tree

Source = np.random.Generator | int | Sequence[int]  # of random numbers: a generator, or the seed of one


def random_model(
    rng: Source,
    rods: Sequence[bool | int],
    mass_decades: float = 0.0,
    loads: bool = False,
    drag: bool = False,
    moderate: bool = False,
) -> Model:
    """A chain with a rod at each joint k with rods[k]; masses are log-uniform over ± ``mass_decades``.

    A ``moderate`` one has masses of 0.5 … 2 kg, joints 0.25 m from the centres of mass, rods of 0.4 m, loads
    of a third and gravity along no axis, so that motions of some seconds are smooth.
    """
    rng, n = np.random.default_rng(rng), len(rods)
    decades = np.log10(2) if moderate else mass_decades
    mass = 10 ** rng.uniform(-decades, decades, n)
    inertia = random_inertias(rng, mass)
    proximal, distal = points = rng.normal(size=(2, n, 3))
    points *= 0.25 / np.linalg.norm(points, axis=-1, keepdims=True) if moderate else 0.3
    length = np.full(n, 0.4) if moderate else rng.uniform(0.2, 1.0, n)
    load = loads * (0.3 if moderate else 1.0) * mass[:, None]
    return Model.chain(
        mass=mass,
        inertia=inertia,
        proximal=proximal,
        distal=distal * (np.arange(n) < n - 1)[:, None],
        length=np.where(np.array(rods, dtype=bool), length, 0.0),
        gravity=np.array([0.7, -0.4, -9.7] if moderate else [0.0, 0.0, -9.81]),
        force=load * rng.normal(size=(n, 3)),
        moment=load * rng.normal(size=(n, 3)),
        drag_force=drag * mass * rng.uniform(0, 1, n),
        drag_moment=drag * mass * rng.uniform(0, 0.1, n),
    )


def random_state(rng: Source, model: Model, rate: float = 2.0) -> State:
    """A state on the manifold; ``rate`` (rad/s) is the standard deviation of every angular rate."""
    rng, n, rod = np.random.default_rng(rng), model.n, model.rods[:, None]
    p = rng.normal(size=(n, 4))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    u = rng.normal(size=(n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    udot = np.cross(rate * rng.normal(size=(n, 3)), u)
    omega = rate * rng.normal(size=(n, 3))
    return complete_state(model, State(p, omega, np.where(rod, u, 0.0), np.where(rod, udot, 0.0)))


def random_chain(
    rng: Source, rods: Sequence[bool | int], rate: float = 2.0, **options: float | bool
) -> tuple[Model, State]:
    """A random model, ``options`` as `random_model`, and a random state of it."""
    rng = np.random.default_rng(rng)
    model = random_model(rng, rods, **options)  # type: ignore[arg-type]
    return model, random_state(rng, model, rate)


def tree_from_seed(seed: int | Sequence[int], *arguments: Any, **options: Any) -> Model:
    """A random tree, arguments as `random_tree`."""
    return random_tree(np.random.default_rng(seed), *arguments, **options)


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
    return scaled, complete_state(scaled, State(state.p, state.omega / time, state.u, state.udot / time))


def norms_per_body(difference: Array) -> Array:
    """Euclidean norm per body."""
    return np.asarray(np.linalg.norm(difference, axis=-1))
