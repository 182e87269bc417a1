"""Axes, frames and points of joints that an engine has wrong: to be reported, and most to be named.

Large turns and turns about skew axes among them, in trees of the catalogue.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from plumbline.model.datatypes import Array, Model, State, StateQuantities
from plumbline.model.kinematics import (
    complete_state,
    quaternion_conjugate,
    quaternion_exponential,
    quaternion_product,
    rotation_matrix,
)

See = Callable[[Model, State], tuple[Model, State]]
FAR, NEAR = 0, 1
BOTH = (FAR, NEAR)


@dataclass(frozen=True)
class JointDefect:
    """One defect: what the engine sees in place of a mechanism and a state, or another answer."""

    name: str
    scenario: str
    expected: str  # words of the diagnosis; empty: it need only be reported
    see: See
    engine: str = "mujoco"
    others: tuple[str, ...] = ()  # what the data cannot distinguish from it
    without: tuple[str, ...] = ()  # quantities that the engine does not return

    def answered(self, found: StateQuantities) -> StateQuantities:
        """The answer without some quantities."""
        return replace(found, **dict.fromkeys(self.without))


def seen(change: Callable[[Model], Model]) -> See:
    """The engine has another model, at the same joint coordinates."""

    def see(model: Model, state: State) -> tuple[Model, State]:
        changed = change(model)
        return changed, complete_state(changed, state)

    return see


def frames(k: int, sides: tuple[int, ...], change: Callable[[Array], Array]) -> See:
    """Another quaternion of a joint's axes."""

    def changed(model: Model) -> Model:
        turn = model.turn.copy()
        for side in sides:
            turn[k, side] = change(turn[k, side])
        return replace(model, turn=turn / np.linalg.norm(turn, axis=-1, keepdims=True))

    return seen(changed)


def turned_by(*vector: float) -> Callable[[Array], Array]:
    """Turned by a rotation vector, in the axes themselves."""
    half = quaternion_exponential(np.array(vector) / 2)
    return lambda q: quaternion_product(q, half)


def exchanged(*axes: int) -> Callable[[Array], Array]:
    """Two axes exchanged, the third reversed."""
    along = np.zeros(3)
    along[list(axes)] = np.pi / np.sqrt(2)
    return turned_by(*along)


def points(k: int, change: Callable[[Array], Array]) -> See:
    """Other points (2, 3) of a joint."""

    def changed(model: Model) -> Model:
        point = model.point.copy()
        point[k] = change(point[k])
        return replace(model, point=point)

    return seen(changed)


def _exchanged_frames(k: int) -> See:
    def changed(model: Model) -> Model:
        turn = model.turn.copy()
        turn[k] = turn[k, ::-1]
        return replace(model, turn=turn)

    return seen(changed)


def _offset(k: int, size: float) -> See:
    """The coordinate of a slide counts from another point."""

    def see(model: Model, state: State) -> tuple[Model, State]:
        x = state.x.copy()
        x[k, 0] += size
        return model, complete_state(model, replace(state, x=x))

    return see


def _rest(k: int, size: float) -> See:
    def changed(model: Model) -> Model:
        rest = model.rest.copy()
        rest[k, 0] += size
        return replace(model, rest=rest)

    return seen(changed)


def _in_joint_axes(k: int) -> See:
    def changed(model: Model) -> Model:
        point = model.point.copy()
        point[k, 0] = rotation_matrix(model.turn[k, 0]) @ point[k, 0]
        return replace(model, point=point)

    return seen(changed)


def _negated(side: int) -> Callable[[Array], Array]:
    sign = np.ones((2, 1))
    sign[side] = -1.0
    return lambda pair: pair * sign


def _moved(side: int, *by: float) -> Callable[[Array], Array]:
    shift = np.zeros((2, 3))
    shift[side] = by
    return lambda pair: pair + shift


def _scalar_last(q: Array) -> Array:
    """A quaternion with the scalar last, read as one with the scalar first."""
    return np.roll(q, -1)


JOINT_DEFECTS = [
    JointDefect(
        "universal: axes exchanged",
        "sprung-universal",
        "x and y of joint 1 were exchanged",
        frames(0, BOTH, exchanged(0, 1)),
    ),
    JointDefect(
        "universal in a tree: axes exchanged",
        "loaded-tree",
        "x and y of joint 3 were exchanged",
        frames(2, BOTH, exchanged(0, 1)),
        "pinocchio",
    ),
    JointDefect(
        "universal: second axis reversed",
        "tree-of-seven-sprung",
        "axis y of joint 3 were reversed",
        frames(2, BOTH, turned_by(np.pi, 0, 0)),
    ),
    JointDefect(
        "universal: far frame turned the other way",
        "sprung-without-rotors",
        "axes of joint 4 in the far body were turned the other way",
        frames(3, (FAR,), quaternion_conjugate),
        "pinocchio",
    ),
    JointDefect(
        "universal: far frame turned by 0.3 rad",
        "universal-pendulum",
        "the axes of joint 1 in the far body were turned by",
        frames(0, (FAR,), turned_by(0.2, -0.1, 0.2)),
    ),
    JointDefect(
        "universal: near frame turned by 1e-5 rad",
        "tree-of-seven",
        "the axes of joint 3 in the near body were turned by",
        frames(2, (NEAR,), turned_by(6e-6, 3e-6, -7e-6)),
        "exudyn",
    ),
    JointDefect(
        "universal: near frame with the scalar last",
        "loaded-tree",
        "of joint 3 in the near body were given with the scalar last",
        frames(2, (NEAR,), _scalar_last),
    ),
    JointDefect(
        "weld: frame left out",
        "tree-of-seven-sprung",
        "the axes of joint 4 in the far body were not turned",
        frames(3, (FAR,), lambda q: np.eye(4)[0]),
        "pinocchio-aba",
    ),
    JointDefect(
        "weld: frames exchanged",
        "loaded-tree",
        "the axes of joint 4 in the two bodies were exchanged",
        _exchanged_frames(3),
        "pinocchio",
    ),
    JointDefect(
        "weld: turned by a quarter about a skew axis",
        "wrecking-ball",
        "the axes of joint 2 in the far body were turned by 1.5707963",
        frames(1, (FAR,), turned_by(*(np.pi / 2 * np.array([0.6, 0.0, 0.8])))),
    ),
    JointDefect(
        "weld: turned by 1e-5 rad",
        "tree-of-seven-sprung",
        "the axes of joint 4 in the far body were turned by",
        frames(3, (FAR,), turned_by(4e-6, -5e-6, 8e-6)),
        "pinocchio",
    ),
    JointDefect(
        "slide: axis reversed",
        "sprung-slider-on-arm",
        "axis z of joint 2 were reversed",
        frames(1, BOTH, turned_by(np.pi, 0, 0)),
    ),
    JointDefect(
        "slide: along another axis",
        "loaded-tree",
        "x and z of joint 5 were exchanged",
        frames(4, BOTH, exchanged(0, 2)),
        "pinocchio",
    ),
    JointDefect(
        "slide: another origin",
        "sprung-slider-on-arm",
        "the origin of the slide of joint 2 were 0.05 m",
        _offset(1, 0.05),
    ),
    JointDefect(
        "slide: another rest position, energies returned",
        "sprung-slide",
        "the rest position of joint 1 were",
        _rest(0, 0.03),
        "pinocchio",
    ),
    JointDefect(
        "slide: another rest position, no energies",
        "sprung-slider-on-arm",
        "the rest position of joint 2",
        _rest(1, 0.03),
        others=("the effort of joint 2",),
        without=("potential_energy",),
    ),
    JointDefect(
        "far point negated",
        "robot-arm",
        "the far point of joint 3 were negated",
        points(2, _negated(FAR)),
        "pinocchio",
    ),
    JointDefect(
        "points exchanged",
        "tree-of-seven",
        "the points of joint 5 in the two bodies were exchanged",
        points(4, lambda pair: pair[::-1]),
    ),
    JointDefect(
        "near point moved askew",
        "open-governor",
        "the near point of joint 2 were (",
        points(1, _moved(NEAR, 0.01, -0.02, 0.005)),
        "pinocchio-aba",
    ),
    JointDefect(
        "far point in the joint's axes",
        "furuta",
        "the far point of joint 2 were given in the axes of the joint",
        _in_joint_axes(1),
    ),
    JointDefect(
        "hinge: turned by 0.7 rad",
        "double-hinge-skew",
        "the axes of joint 2 in the far body were turned by",
        frames(1, (FAR,), turned_by(0.4, 0.5, -0.3)),
        "pinocchio",
    ),
    JointDefect(
        "cylindrical: near frame left out",
        "tree-of-seven",
        "the axes of joint 5 in the near body were not turned",
        frames(4, (NEAR,), lambda q: np.eye(4)[0]),
    ),
    JointDefect(
        "cylindrical: both frames turned the other way",
        "tree-of-seven-sprung",
        "the axes of joint 5 in both bodies were turned the other way",
        frames(4, BOTH, quaternion_conjugate),
        "pinocchio",
    ),
    JointDefect(
        "weld: turned by 1.2 rad",
        "loaded-tree",
        "the axes of joint 4 in the far body were turned by",
        frames(3, (FAR,), turned_by(0.7, -0.8, 0.6)),
        "pinocchio",
    ),
]
