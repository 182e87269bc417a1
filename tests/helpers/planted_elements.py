"""Defects of joints and passive elements, planted in real adapters: to be reported, and most to be named."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from plumbline.model.datatypes import SPRING_FIELDS, Array, Model, State, StateQuantities
from plumbline.model.kinematics import (
    elastic_energy,
    kinetic_energy_of_rotors,
    quaternion_product,
    rotation_matrix,
)
from plumbline.model.random_mechanisms import random_tree

Change = Callable[[Model], Model]
Answer = Callable[[Model, State, StateQuantities], StateQuantities]


@dataclass(frozen=True)
class ElementDefect:
    """One defect: the engine is given another model, or its answer is altered."""

    name: str
    expected: str = ""  # words of the diagnosis; empty: it need only be reported
    engine: str = "mujoco"
    change: Change | None = None
    answer: Answer | None = None


def subject() -> Model:
    """Five bodies on every joint that moves, in one branch, with elements on every coordinate."""
    rng = np.random.default_rng(11)
    tree = random_tree(rng, 5, elements=("armature", "damping", "stiffness", "effort", "springs"))
    kinds = ("ball", "hinge", "universal", "slide", "cylindrical")
    bare = replace(tree, kind=kinds, body=np.array([[-1, 0], [0, 1], [1, 2], [2, 3], [1, 4]]))
    used = np.array([[1, 0], [1, 0], [1, 1], [1, 0], [1, 1]])
    fields: dict[str, Array] = {
        name: np.where(used, rng.uniform(0.2, 2.0, (5, 2)), 0.0)
        for name in ("armature", "damping", "stiffness")
    }
    fields |= {name: np.where(used, rng.normal(size=(5, 2)), 0.0) for name in ("rest", "effort")}
    fields["rest"][0] = fields["effort"][0] = 0.0
    point = np.where(
        np.all(bare.point == 0, axis=2, keepdims=True), 0.3 * rng.normal(size=(5, 2, 3)), bare.point
    )
    springs = {name: getattr(bare, name)[:2] for name in SPRING_FIELDS}
    springs["spring_body"] = np.array([[-1, 3], [2, 4]])
    return bare.changed(point=point, length=np.zeros(5), **fields, **springs)


def scaled(name: str, at: tuple[int, ...], factor: float) -> Change:
    """One number of the model multiplied."""

    def change(model: Model) -> Model:
        values = getattr(model, name).copy()
        values[at] *= factor
        return replace(model, **{name: values})

    return change


def turned(k: int, side: int, axis: int) -> Change:
    """The axes of a joint in one body turned by 1e-6 rad."""

    def change(model: Model) -> Model:
        turn = model.turn.copy()
        turn[k, side] = quaternion_product(turn[k, side], np.array([1.0, *(5e-7 * np.eye(3)[axis])]))
        return replace(model, turn=turn / np.linalg.norm(turn, axis=-1, keepdims=True))

    return change


def moved(k: int, side: int, axis: int) -> Change:
    """A point of a joint moved by 1e-6 m."""

    def change(model: Model) -> Model:
        point = model.point.copy()
        point[k, side, axis] += 1e-6
        return replace(model, point=point)

    return change


def _elements() -> Iterator[ElementDefect]:
    where = {
        (0, 0): "joint 1", (1, 0): "joint 2", (2, 0): "joint 3 x", (2, 1): "joint 3 y",
        (3, 0): "joint 4", (4, 0): "joint 5 slide", (4, 1): "joint 5 turn",
    }  # fmt: skip
    words = {"rest": "the rest position of", "effort": "the effort of"}
    for index, (at, joint) in enumerate(where.items()):
        for name in ("armature", "damping", "stiffness", "rest", "effort"):
            if at == (0, 0) and name in ("rest", "effort"):
                continue
            signed = name not in ("armature", "stiffness")  # an engine refuses negative ones
            for factor in [(0.0, 2.0, 1 + 1e-6, -1.0)[(index + len(name)) % (3 + signed)]]:
                engine = ("mujoco", "pinocchio", "pinocchio-aba")[index % 3]
                expected = f"{words.get(name, f'the {name} of')} {joint} "
                yield ElementDefect(
                    f"{name} of {joint} × {factor:g}", expected, engine, scaled(name, at, factor)
                )
    for name in ("stiffness", "damping", "length"):
        for i in range(2):
            subject_ = f"the {name} of spring {i + 1}"
            yield ElementDefect(
                f"{subject_} × 1.1", subject_, "pinocchio", scaled(f"spring_{name}", (i,), 1.1)
            )
    for name in ("armature", "damping", "stiffness", "effort"):
        every = replace_all(name, 0.0)
        yield ElementDefect(f"no {name}", f"the {name} of all joints were missing", change=every)
    degrees = replace_all("rest", np.pi / 180)
    yield ElementDefect("rest in degrees", "the rest position of all joints were 0.017453292", change=degrees)


def replace_all(name: str, factor: float) -> Change:
    """A field multiplied."""
    return lambda model: replace(model, **{name: factor * getattr(model, name)})


def _rotor_in_moment(model: Model, state: State, found: StateQuantities) -> StateQuantities:
    """The moment of the slide's joint counts its rotor's force as carried by the joint."""
    assert found.joint_reaction is not None
    reaction = found.joint_reaction.copy()
    reaction[3] += model.armature[3, 0] * found.acceleration[3]
    return replace(found, joint_reaction=reaction)


def _without_rotors(model: Model, state: State, found: StateQuantities) -> StateQuantities:
    assert found.kinetic_energy is not None
    return replace(found, kinetic_energy=found.kinetic_energy - kinetic_energy_of_rotors(model, state))


def _without_springs(model: Model, state: State, found: StateQuantities) -> StateQuantities:
    assert found.potential_energy is not None
    return replace(found, potential_energy=found.potential_energy - elastic_energy(model, state))


def _bodies() -> Iterator[ElementDefect]:
    """Numbers of the bodies of a tree: mass, inertia, loads, drags, gravity."""
    yield ElementDefect("mass of body 3", "the mass of body 3 were", "pinocchio", scaled("mass", (2,), 1.001))
    yield ElementDefect(
        "inertia of body 2", "the inertia xx of body 2", change=scaled("inertia", (1, 0, 0), 1.01)
    )
    yield ElementDefect("gravity", "gravity were", change=replace_all("gravity", 1.001))
    for name, words in (("force", "applied force"), ("moment", "applied moment")):
        dropped = scaled(name, (1,), 0.0)
        yield ElementDefect(f"no {name} on body 2", f"the {words} of body 2 were missing", change=dropped)
    for name in ("drag_force", "drag_moment"):
        words = f"the {name.replace('_', ' ')} of body 4 were"
        yield ElementDefect(f"{name} of body 4", words, "pinocchio", scaled(name, (3,), 0.0))


def _arm_reversed(model: Model, state: State, found: StateQuantities) -> StateQuantities:
    """The moments of joints with the arm to the centre of mass of the whole reversed."""
    assert found.joint_moment is not None and found.joint_reaction is not None
    near = state.r + np.matvec(rotation_matrix(state.p), model.proximal)
    whole = model.mass @ state.r / np.sum(model.mass)
    lever = np.cross(near - whole, found.joint_reaction)
    return replace(found, joint_moment=found.joint_moment + 2 * lever)


ELEMENT_DEFECTS = [
    *_bodies(),
    ElementDefect(
        "moments with the arm reversed",
        "arm of joint moments to the centre of mass of the whole counted -1 times",
        answer=_arm_reversed,
    ),
    *_elements(),
    ElementDefect("axis in the far body", "axes of joint 2 in the far body about x", change=turned(1, 0, 0)),
    ElementDefect(
        "axis in the near body", "axes of joint 4 in the near body about y", change=turned(3, 1, 1)
    ),
    ElementDefect("far point", "of the far point of joint 5", "pinocchio", change=moved(4, 0, 1)),
    ElementDefect("near point", "of the near point of joint 3", "pinocchio", change=moved(2, 1, 2)),
    ElementDefect("rotor counted in a joint's force", answer=_rotor_in_moment),
    ElementDefect(
        "kinetic energy of rotors", "kinetic energy without that of the rotors", answer=_without_rotors
    ),
    ElementDefect(
        "energy of springs", "potential energy without that of the springs", answer=_without_springs
    ),
    ElementDefect(
        "whole turns forgotten", change=lambda m: replace(m, rest=m.rest + 2 * np.pi * (m.rest != 0))
    ),
]
