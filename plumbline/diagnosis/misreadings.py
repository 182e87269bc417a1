"""What an engine may read in another frame, or not as the number that it is: causes without an amount."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from plumbline.diagnosis.joint_causes import one_number
from plumbline.model.datatypes import KINDS, Model, State
from plumbline.model.kinematics import complete_state, rotation_matrix, spring_vectors

Misreading = Callable[[Model, State], tuple[Model, State]]


def misreadings(model: Model) -> Iterator[tuple[str, Misreading]]:
    """List what an engine may read in another frame, or not as the number that it is.

    Args:
        model: the mechanism.

    Yields:
        Words that complete "behaves as if", and the mechanism and the state that the engine sees.

    """
    for k in range(model.n):
        of = f"of body {k + 1}"
        if KINDS[model.kind[k]].has_attitude:
            yield f"the world-frame angular velocity {of} were used", _turned_state("omega", k, False)
        if model.kind[k] == "free":
            yield f"the velocity {of} were given in the body frame", _turned_state("v", k, False)
            yield f"the body-frame velocity {of} were used", _turned_state("v", k, True)
        if np.any(model.force[k]):
            yield f"the applied force {of} were given in the body frame", _turned_load("force", k, False)
        if np.any(model.moment[k]):
            yield f"the applied moment {of} were given in the world frame", _turned_load("moment", k, True)
        for i, (what, _) in enumerate(KINDS[model.kind[k]].motions):
            if what == "turn":
                words = f"angle {i + 1} of joint {k + 1} were its principal value"
                yield words, _coordinate("x", k, i, lambda x: float(np.arctan2(np.sin(x), np.cos(x))))
            for name, words in (("x", "coordinate"), ("xdot", "rate")):
                text = f"{words} {i + 1} of joint {k + 1} had the opposite sign"
                yield text, _coordinate(name, k, i, lambda x: -x)
    for number in map(int, np.flatnonzero(model.spring_damping)):
        yield f"the rate of spring {number + 1} were dᵀḋ, not over the length", _undivided_rate(number)


def _turned_state(name: str, k: int, to_body: bool) -> Misreading:
    def misread(model: Model, state: State) -> tuple[Model, State]:
        values, turn = getattr(state, name).copy(), rotation_matrix(state.p[k])
        values[k] = (turn.T if to_body else turn) @ values[k]
        return model, replace(state, **{name: values})

    return misread


def _turned_load(name: str, k: int, to_body: bool) -> Misreading:
    def misread(model: Model, state: State) -> tuple[Model, State]:
        turn = rotation_matrix(complete_state(model, state).p[k])
        values = getattr(model, name).copy()
        values[k] = (turn.T if to_body else turn) @ values[k]
        return replace(model, **{name: values}), state

    return misread


def _coordinate(name: str, k: int, i: int, change: Callable[[float], float]) -> Misreading:
    def misread(model: Model, state: State) -> tuple[Model, State]:
        values = getattr(state, name).copy()
        values[k, i] = change(float(values[k, i]))
        return model, replace(state, **{name: values})

    return misread


def _undivided_rate(i: int) -> Misreading:
    def misread(model: Model, state: State) -> tuple[Model, State]:
        length = float(np.linalg.norm(spring_vectors(model, state.r, state.p)[i]))
        return one_number("spring_damping", (i,))(model, length * float(model.spring_damping[i])), state

    return misread
