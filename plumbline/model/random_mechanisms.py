"""Random mechanisms: trees with any mix of joints, skew axes, full inertias, loads, elements, and loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np

from plumbline.model.datatypes import BALL, FREE, HINGE, KINDS, WELD, Array, Float, Kind, Model, State
from plumbline.model.features import Place, Role
from plumbline.model.kinematics import (
    complete_state,
    normalised,
    path_to_world,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
)
from plumbline.model.loops import assembled, cut_open
from plumbline.model.sampling import random_states

ELEMENTS = ("armature", "damping", "stiffness", "effort", "springs")
LOOP_KINDS = tuple(name for name, kind in KINDS.items() if not (kind.holds_nothing or kind.is_rigid))
SPRINGS = 4  # between points
MIN_FIRST_SINGULAR_VALUE = 5e-2  # of the unit rows of a new loop's mechanism: away from singular poses


def random_inertias(rng: np.random.Generator, mass: Float[Array, "bodies"]) -> Float[Array, "bodies 3 3"]:
    """Draw inertias of ellipsoids of any attitude, which are always physical.

    Returns:
        Kg m², body frame.

    """
    axes = np.linalg.qr(rng.normal(size=(len(mass), 3, 3)))[0]
    size = rng.uniform(0.1, 0.6, (len(mass), 3)) ** 2
    principal = mass[:, None] / 5 * (size.sum(1, keepdims=True) - size)
    inertia = axes @ (principal[..., None] * axes.swapaxes(-1, -2))
    return np.asarray((inertia + inertia.swapaxes(-1, -2)) / 2)


def random_tree(
    rng: np.random.Generator,
    n: int,
    kinds: Sequence[Kind] = tuple(KINDS),
    loads: bool = True,
    elements: Sequence[str] = (),
) -> Model:
    """Draw a tree in depth-first order; the parent of free bodies is the world, of welds another body.

    Args:
        elements: which of `ELEMENTS` its joints have.

    """
    far: list[int] = []
    chosen: list[Kind] = []
    for k in range(n):
        far.append(int(rng.choice([*path_to_world(far, k - 1), -1])))
        fitting = [kind for kind in kinds if kind != (FREE if far[k] >= 0 else WELD)]
        chosen.append(fitting[rng.integers(len(fitting))] if fitting else HINGE)
    return with_elements(rng, _with_numbers(rng, chosen, far, loads), elements)


def _with_numbers(
    rng: np.random.Generator, chosen: Sequence[Kind], far: Sequence[int], loads: bool = True
) -> Model:
    """Draw the numbers of a tree of given joints."""
    n = len(chosen)
    mass = 10 ** rng.uniform(-0.5, 0.5, n)
    inertia = random_inertias(rng, mass)
    point = 0.3 * rng.normal(size=(n, 2, 3))
    point[[KINDS[kind].holds_nothing for kind in chosen]] = 0
    return Model(
        mass=mass,
        inertia=inertia,
        kind=tuple(chosen),
        body=np.stack([np.array(far), np.arange(n)], axis=1),
        point=point,
        turn=normalised(rng.normal(size=(n, 2, 4))),
        length=np.where([bool(KINDS[kind].own_number) for kind in chosen], rng.uniform(0.2, 1.0, n), 0.0),
        gravity=np.array([0.7, -0.4, -9.7]),
        force=loads * rng.normal(size=(n, 3)),
        moment=loads * 0.3 * rng.normal(size=(n, 3)),
        drag_force=loads * rng.uniform(0.1, 0.3, n),
        drag_moment=loads * rng.uniform(0.01, 0.03, n),
    )


def with_elements(rng: np.random.Generator, model: Model, elements: Sequence[str] = ELEMENTS) -> Model:
    """Add random elements to every joint, closing ones too, and springs between points.

    Args:
        elements: which.

    Returns:
        The mechanism with the elements.

    """
    n, fields = model.n, dict[str, Any]()
    scalar = np.array([[i < len(kind.motions) for i in range(model.columns)] for kind in model.kinds])
    balls = np.array([[kind.is_spherical, *[False] * (model.columns - 1)] for kind in model.kinds])
    for name in ("armature", "damping", "stiffness"):
        if name in elements:
            fields[name] = rng.uniform(0.1, 2.0, scalar.shape) * (scalar | balls)
    if "stiffness" in elements:
        fields["rest"] = rng.normal(size=scalar.shape) * scalar
    if "effort" in elements:
        fields["effort"] = rng.normal(size=scalar.shape) * scalar
    if "springs" in elements and n > 1:
        ends = [rng.choice(n, 2, replace=False) for _ in range(SPRINGS)]
        ends[0][rng.integers(2)] = -1
        fields |= {
            "spring_body": np.array(ends),
            "spring_point": 0.5 * rng.normal(size=(SPRINGS, 2, 3)),
            "spring_stiffness": rng.uniform(1.0, 10.0, SPRINGS),
            "spring_damping": rng.uniform(0.1, 1.0, SPRINGS),
            "spring_length": rng.uniform(0.1, 1.0, SPRINGS),
        }
    return model.changed(**fields)


def close_loop(
    model: Model, state: State, kind: Kind, far: int, near: int, rng: np.random.Generator
) -> Model:
    """Add a joint that fits the state: its coordinates are at random, its far axes and point follow.

    Args:
        far: its far body, −1 the world.
        near: its near body.

    Returns:
        The mechanism with one more closing joint.

    """
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
            if KINDS[kind].has_pitch:
                length = float(rng.uniform(0.2, 1.0))
                point = point + 2 * half * length * rotation_matrix(axes)[:, axis]
        else:
            point = point + rng.normal() * rotation_matrix(axes)[:, axis]
    if KINDS[kind].holds_distance:
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
    )


def random_loop_mechanism(
    seed: int, n: int, kinds: Sequence[Kind], tree: Sequence[Kind] = LOOP_KINDS, elements: Sequence[str] = ()
) -> tuple[Model, State]:
    """Draw a tree whose last bodies are closed by joints of some kinds, at an assembled state.

    Args:
        seed: the same seed gives the same mechanism.
        tree: kinds of the tree's joints.
        elements: which of `ELEMENTS` the joints have.

    Returns:
        The mechanism, whose loops move and whose rows are independent, and the state.

    """
    for attempt in count():
        rng = np.random.default_rng([seed, n, len(kinds), attempt])
        model = random_tree(rng, n, tree)
        (state,) = random_states(model, 1, seed)
        for i, kind in enumerate(kinds):
            near = n - 1 - i
            path = {near}
            while (above := int(model.body[min(path), 0])) >= 0 and rng.random() < 0.7:
                path.add(above)
            world = [] if KINDS[kind].is_rigid else [-1]
            ends = [*world, *(b for b in range(n) if b not in path and b != model.body[near, 0])]
            if not ends:
                break
            model = close_loop(model, state, kind, int(rng.choice(ends)), near, rng)
        if len(model.kind) == n + len(kinds) and _moves(model, state):
            model = with_elements(rng, model, elements)  # of closing joints too
            return model, assembled(model, complete_state(model, state))
    raise AssertionError


class _Node:
    """A body of a mechanism in the making: the kind of its joint, and its children."""

    def __init__(self, kind: Kind) -> None:
        self.kind, self.children, self.place = kind, list[_Node](), -1

    def attach(self, kinds: Sequence[Kind]) -> _Node:
        """Attach a chain to the body and return its last one."""
        last = self
        for kind in kinds:
            last.children.append(_Node(kind))
            last = last.children[-1]
        return last


def mechanism_with_places(
    seed: int, places: Sequence[Place], elements: Sequence[str] = ELEMENTS, is_hub_world: bool = False
) -> tuple[Model, State]:
    """Draw a mechanism that has joints of given kinds in given roles, as far as they can be together.

    A chain of the single joints ends at a hub, or at the world, that carries branches and loops; other loops
    begin at the world.

    Args:
        seed: the same seed gives the same mechanism.
        places: kinds and roles (`plumbline.model.features.Place`); one that comes twice gives two joints.
        elements: which of `ELEMENTS` the joints have.
        is_hub_world: whether branches and loops begin at the world.

    Returns:
        The mechanism, with all loads, whose loops move, and an assembled state.

    """
    for attempt in count():
        rng = np.random.default_rng([seed, attempt])
        world = _Node(WELD)
        shuffled = [places[i] for i in rng.permutation(len(places))]
        wanted: dict[Role, list[Kind]] = {"single": [], "beside": [], "loop": [], "closing": []}
        for kind, role in shuffled:
            wanted[role].append(kind)
        is_base_free = FREE in wanted["single"]
        singles = [kind for kind in wanted["single"] if kind != FREE]
        base = (
            world.attach([FREE if is_base_free else BALL])
            if singles or is_base_free or not is_hub_world
            else world
        )
        last = base.attach(singles)
        if last is world and WELD in (*wanted["beside"], *wanted["closing"], *wanted["loop"]):
            last = world.attach([BALL])
        hub = world if is_hub_world else last
        for kind in wanted["beside"]:
            (world if kind == FREE else last if kind == WELD else hub).attach([kind])
        if len(hub.children) == 1 and wanted["beside"]:
            hub.attach([HINGE])
        rings: list[tuple[_Node, _Node, Kind]] = []
        if wanted["loop"] and not wanted["closing"]:
            wanted["closing"] = [BALL]
        for i, closing in enumerate(wanted["closing"]):
            own = wanted["loop"][i :: len(wanted["closing"])]
            foot = world if FREE in own or (rng.random() < 0.5 and not is_base_free) else hub
            if closing == WELD and foot is world:
                foot = last
            freedom = sum(KINDS[kind].freedom for kind in own)
            while freedom < 6 - KINDS[closing].freedom + 2:
                own.insert(int(rng.integers(len(own) + 1)), BALL)
                freedom += 3
            own.sort(key=lambda kind: (kind != FREE, kind == WELD))  # free bodies first, welds last
            rings.append((foot, (world if FREE in own else foot).attach(own), closing))
        kinds, far = list[Kind](), list[int]()
        _number(world, kinds, far)
        model = _with_numbers(rng, kinds, far)
        (state,) = random_states(model, 1, int(rng.integers(2**32)))
        for foot, near, closing in rings:
            model = close_loop(model, state, closing, foot.place, near.place, rng)
        if not rings or _moves(model, state):
            model = with_elements(rng, model, elements)
            return model, assembled(model, complete_state(model, state))
    raise AssertionError


def _number(node: _Node, kinds: list[Kind], far: list[int]) -> None:
    """List kinds and far bodies of all below a node, depth first."""
    for child in node.children:
        child.place = len(kinds)
        kinds.append(child.kind)
        far.append(node.place)
        _number(child, kinds, far)


def _moves(model: Model, state: State) -> bool:
    """Whether the loops can move, with no row that depends on others, away from singular poses."""
    cut = cut_open(model)
    J = cut.jacobian(cut.state(complete_state(model, state)))
    size = np.linalg.norm(J, axis=1, keepdims=True)
    if np.min(size) < 1e-9:
        return False
    values = np.linalg.svd(J / size)[1]
    moving = J.shape[1] - int(np.sum(cut.model.rods))  # a rod has two rates in three columns
    return J.shape[0] < moving and bool(values[-1] > MIN_FIRST_SINGULAR_VALUE)
