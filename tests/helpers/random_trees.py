"""Random trees for the tests: any mix of joints, skew axes, full inertias, loads and drag."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from plumbline.model.datatypes import KINDS, Array, Kind, Model

ELEMENTS = ("armature", "damping", "stiffness", "effort", "springs")


def random_tree(
    rng: np.random.Generator,
    n: int,
    kinds: Sequence[Kind] = tuple(KINDS),
    loads: bool = True,
    elements: Sequence[str] = (),
) -> Model:
    """A tree of n bodies in depth-first order; free bodies hang on the world only, welds never."""
    far: list[int] = []
    chosen: list[Kind] = []
    for k in range(n):
        path = [k - 1]
        while path[-1] >= 0:
            path.append(far[path[-1]])
        far.append(int(rng.choice(path)))
        fitting = [kind for kind in kinds if kind != ("free" if far[k] >= 0 else "weld")]
        chosen.append(fitting[rng.integers(len(fitting))] if fitting else "hinge")
    mass = 10 ** rng.uniform(-0.5, 0.5, n)
    axes = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    size = rng.uniform(0.1, 0.6, (n, 3)) ** 2
    principal = mass[:, None] / 5 * (size.sum(1, keepdims=True) - size)  # ellipsoids: always physical
    inertia = axes @ (principal[..., None] * axes.mT)
    point = 0.3 * rng.normal(size=(n, 2, 3))
    point[[kind == "free" for kind in chosen]] = 0
    bare = Model(
        mass=mass,
        inertia=(inertia + inertia.mT) / 2,
        kind=tuple(chosen),
        body=np.stack([far, np.arange(n)], axis=1),
        point=point,
        turn=_unit(rng.normal(size=(n, 2, 4))),
        length=np.where([kind == "rod" for kind in chosen], rng.uniform(0.2, 1.0, n), 0.0),
        gravity=np.array([0.7, -0.4, -9.7]),
        force=loads * rng.normal(size=(n, 3)),
        moment=loads * 0.3 * rng.normal(size=(n, 3)),
        drag_force=loads * rng.uniform(0.1, 0.3, n),
        drag_moment=loads * rng.uniform(0.01, 0.03, n),
    )
    return with_elements(rng, bare, elements) if elements else bare


def with_elements(rng: np.random.Generator, model: Model, elements: Sequence[str] = ELEMENTS) -> Model:
    """The mechanism with random elements on every joint, and two springs between points."""
    n, fields = model.n, dict[str, Any]()
    scalar = np.array([[i < len(KINDS[kind].motions) for i in range(2)] for kind in model.kind])
    balls = np.array([[kind == "ball", False] for kind in model.kind])
    for name in ("armature", "damping", "stiffness"):
        if name in elements:
            fields[name] = rng.uniform(0.1, 2.0, (n, 2)) * (scalar | balls)
    if "stiffness" in elements:
        fields["rest"] = rng.normal(size=(n, 2)) * scalar
    if "effort" in elements:
        fields["effort"] = rng.normal(size=(n, 2)) * scalar
    if "springs" in elements and n > 1:
        fields |= {
            "spring_body": np.array([rng.choice(np.arange(-1, n), 2, replace=False) for _ in range(2)]),
            "spring_point": 0.5 * rng.normal(size=(2, 2, 3)),
            "spring_stiffness": rng.uniform(1.0, 10.0, 2),
            "spring_damping": rng.uniform(0.1, 1.0, 2),
            "spring_length": rng.uniform(0.1, 1.0, 2),
        }
    return model.changed(**fields)


def _unit(q: Array) -> Array:
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))
