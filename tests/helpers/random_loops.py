"""Random mechanisms with loops for the tests: a random tree, closed where it stands by joints of any kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import numpy as np

from plumbline.model.datatypes import JOINT_ELEMENTS, KINDS, Kind, Model, State
from plumbline.model.kinematics import (
    complete_state,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
)
from plumbline.model.loops import assembled, cut_open
from plumbline.model.sampling import random_states
from tests.helpers.random_trees import random_tree

TREE_KINDS: tuple[Kind, ...] = ("rod", "ball", "hinge", "universal", "slide", "cylindrical")


def close_loop(
    model: Model, state: State, kind: Kind, far: int, near: int, rng: np.random.Generator
) -> Model:
    """Add a joint that fits the state: its coordinates are at random, its far axes and point follow."""
    a = rotation_matrix(state.p)
    at, turn = 0.3 * rng.normal(size=3), rng.normal(size=4)
    turn /= np.linalg.norm(turn)
    point = state.r[near] + a[near] @ at
    axes = quaternion_product(state.p[near], turn)  # the joint's axes in the world, as the near body has them
    length = 0.0
    for what, axis in KINDS[kind].motions[::-1]:
        if what == "turn":
            half = rng.uniform(-1, 1)
            axes = quaternion_product(axes, np.array([np.cos(half), *(np.sin(half) * np.eye(3)[axis])]))
        else:
            point = point + rng.normal() * rotation_matrix(axes)[:, axis]
    if kind == "rod":
        step = rng.normal(size=3)
        point, length = point + step, float(np.linalg.norm(step))
    if far >= 0:
        point = a[far].T @ (point - state.r[far])
        axes = quaternion_product(quaternion_conjugate(state.p[far]), axes)
    return replace(
        model,
        kind=(*model.kind, kind),
        body=np.vstack([model.body, [[far, near]]]),
        point=np.concatenate([model.point, [[point, at]]]),
        turn=np.concatenate([model.turn, [[axes / np.linalg.norm(axes), turn]]]),
        length=np.append(model.length, length),
        **{name: np.vstack([getattr(model, name), np.zeros((1, 2))]) for name in JOINT_ELEMENTS},
    )


def random_loops(
    seed: int, n: int, kinds: Sequence[Kind], tree: Sequence[Kind] = TREE_KINDS
) -> tuple[Model, State]:
    """A random tree of n bodies whose last ones are closed by joints of the kinds, at an assembled state."""
    for attempt in count():
        rng = np.random.default_rng([seed, n, len(kinds), attempt])
        model = random_tree(rng, n, tree)
        (state,) = random_states(model, 1, seed)
        for i, kind in enumerate(kinds):
            near = n - 1 - i
            path = {near}
            while (above := int(model.body[min(path), 0])) >= 0 and rng.random() < 0.7:
                path.add(above)
            world = [] if kind == "weld" else [-1]
            ends = [*world, *(b for b in range(n) if b not in path and b != model.body[near, 0])]
            if not ends:
                break
            model = close_loop(model, state, kind, int(rng.choice(ends)), near, rng)
        if len(model.kind) == n + len(kinds) and _moves(model, state):
            return model, assembled(model, complete_state(model, state))
    raise AssertionError


def _moves(model: Model, state: State) -> bool:
    """Whether the loops can move, with no row that depends on others, away from singular poses."""
    cut = cut_open(model)
    J = cut.jacobian(cut.state(state))
    size = np.linalg.norm(J, axis=1, keepdims=True)
    if np.min(size) < 1e-9:
        return False
    values = np.linalg.svd(J / size)[1]
    return J.shape[0] < J.shape[1] and bool(values[-1] > 5e-2)
