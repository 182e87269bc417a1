"""Small generic pendulums for tests: full inertias, offset attachments, nothing in a special direction."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from plumbline.model import kinematics
from plumbline.model.datatypes import Array, Model, State, Trajectory
from reference_impl.collocation import integrate_collocation
from tests.helpers.random_chains import random_state

JOINT_PATTERNS = {  # b: hung by a ball joint, r: by a rod
    "ball": "b",
    "rod": "r",
    "balls": "bb",
    "rods": "rr",
    "rod-ball": "rb",
    "ball-rod": "br",
    "mixed": "rbbrr",
    "balls-10": "b" * 10,
    "rods-10": "r" * 10,
}


@cache
def make_model(joints: str, loads: bool = False, drag: bool = False, seed: int = 0) -> Model:
    """A pendulum with one letter of ``joints`` per body, drawn from ``seed``."""
    n = len(joints)
    rng = np.random.default_rng([seed, *joints.encode()])
    inertia = []
    for _ in range(n):
        frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        a, b, c = rng.uniform(0.01, 0.04, 3)  # of three masses on axes: any such tensor is physical
        inertia.append(frame @ np.diag([b + c, a + c, a + b]) @ frame.T)
    J = np.array(inertia)
    return Model.chain(
        mass=rng.uniform(0.5, 2.0, n),
        inertia=(J + J.transpose(0, 2, 1)) / 2,
        proximal=0.25 * _unit(rng, n),
        distal=0.25 * _unit(rng, n),
        length=np.where([j == "r" for j in joints], 0.4, 0.0),
        gravity=np.array([0.7, -0.4, -9.7]),
        force=loads * rng.normal(size=(n, 3)),
        moment=loads * 0.3 * rng.normal(size=(n, 3)),
        drag_force=drag * rng.uniform(0.1, 0.3, n),
        drag_moment=drag * rng.uniform(0.01, 0.03, n),
    )


def state_from_seed(model: Model, seed: int = 0, rate: float = 3.0) -> State:
    """A random state on the manifold; ``rate`` (rad/s) is the standard deviation of every angular rate."""
    return random_state(np.random.default_rng(seed), model, rate)


def reference_trajectory(model: Model, state: State, times: Array) -> Trajectory:
    """The motion by the reference's collocation, held on its manifold."""
    start = state.r, state.p, state.v, kinematics.quaternion_rate(state.p, state.omega)
    run = integrate_collocation([model], *start, times, 1e-13, project=True)
    return Trajectory(times, run.r, run.p, run.v, run.pdot, run.steps)


def with_negated_quaternions(state: State) -> State:
    """The same state with −p for every second body, the first included."""
    signs = np.where(np.arange(len(state.p)) % 2, 1.0, -1.0)[:, None]
    return replace(state, p=signs * state.p)


def _unit(rng: np.random.Generator, n: int) -> Array:
    x = rng.normal(size=(n, 3))
    return np.asarray(x / np.linalg.norm(x, axis=1, keepdims=True))
