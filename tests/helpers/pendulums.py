"""Moderate random chains by the letters of their joints, states from a seed, and their motion."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from plumbline.model import kinematics
from plumbline.model.datatypes import Array, Model, State, Trajectory
from reference_impl.fast.collocation import integrate_collocation
from tests.helpers.random_chains import random_model, random_state

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
    """A moderate random chain of a pattern, or with one letter of ``joints`` per body."""
    joints = JOINT_PATTERNS.get(joints, joints)
    rng = np.random.default_rng([seed, *joints.encode()])
    return random_model(rng, [j == "r" for j in joints], loads=loads, drag=drag, moderate=True)


def state_from_seed(model: Model, seed: int = 0, rate: float = 3.0) -> State:
    """A random state on the manifold; ``rate`` (rad/s) is the standard deviation of every angular rate."""
    return random_state(seed, model, rate)


def reference_trajectory(model: Model, state: State, times: Array) -> Trajectory:
    """The motion by the reference's collocation, held on its manifold."""
    start = kinematics.maximal_coordinates(state)
    run = integrate_collocation([model], *start, times, 1e-13, project=True)
    return Trajectory(times, run.r, run.p, run.v, run.pdot, run.steps)


def with_negated_quaternions(state: State) -> State:
    """The same state with −p for every second body, the first included."""
    signs = np.where(np.arange(len(state.p)) % 2, 1.0, -1.0)[:, None]
    return replace(state, p=signs * state.p)
