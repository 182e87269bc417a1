"""Find what a difference needs, by intervention: the engine is asked again with one thing taken away.

What cannot be taken away without the difference vanishing is what an unexplained difference is known by,
whatever the scenarios in which it shows.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace

import numpy as np

from plumbline.diagnosis.digit_loss import Evaluate
from plumbline.diagnosis.outputs import error_ratio
from plumbline.diagnosis.prediction import Predictor, View
from plumbline.model.datatypes import Model, State
from plumbline.truth.rounding_bound import rounding_bounds

VANISHED = 2.0  # in bounds: the engine's rounding and that of the expected number
SAME_CALL = "other states in the same call"
ABSENT_FIELDS = {  # what is taken away, and the fields of the model that are 0 without it
    "gravity": ("gravity",),
    "an applied force": ("force",),
    "an applied moment": ("moment",),
    "drag": ("drag_force", "drag_moment"),
    "a rotor": ("armature",),
    "a damper": ("damping",),
    "a joint spring": ("stiffness",),
    "an effort": ("effort",),
    "a spring between points": ("spring_stiffness", "spring_damping"),
}

Problem = tuple[Model, list[State]]


def find_needs(
    model: Model, states: list[State], quantities: Collection[str], evaluate: Evaluate
) -> dict[str, tuple[str, ...]]:
    """Return by quantity what cannot be taken away without its difference vanishing.

    Args:
        states: where the quantities are wrong.
        evaluate: evaluates the engine; a trial that it refuses shows nothing.

    """
    if not _wrong(model, states, quantities, evaluate):
        return dict.fromkeys(quantities, (SAME_CALL,))
    needs: dict[str, list[str]] = {quantity: [] for quantity in quantities}
    for what, changed in _without_one(model, states):
        try:
            wrong = _wrong(*changed, quantities, evaluate)
        except Exception:  # an engine may raise anything
            continue
        for quantity in set(quantities) - wrong:
            needs[quantity].append(what)
    return {quantity: tuple(found) for quantity, found in needs.items()}


def _without_one(model: Model, states: list[State]) -> Iterator[tuple[str, Problem]]:
    """The mechanism and its states with one thing taken away."""
    if any(np.any(s.v) or np.any(s.omega) or np.any(s.xdot) for s in states):
        yield "motion", (model, [_at_rest(s) for s in states])
    for what, names in ABSENT_FIELDS.items():
        if any(np.any(getattr(model, name)) for name in names):
            yield what, (_without(model, *names), states)
    if np.any(model.inertia * (1 - np.eye(3))):
        yield "products of inertia", (replace(model, inertia=model.inertia * np.eye(3)), states)
    if model.has_loops:
        yield "a closing joint", (model.tree, states)


def _without(model: Model, *names: str) -> Model:
    changes: dict[str, np.ndarray] = {name: 0 * getattr(model, name) for name in names}
    return replace(model, **changes)  # type: ignore[arg-type]


def _at_rest(s: State) -> State:
    return replace(s, omega=0 * s.omega, udot=0 * s.udot, xdot=0 * s.xdot, v=0 * s.v)


def _wrong(model: Model, states: list[State], quantities: Collection[str], evaluate: Evaluate) -> set[str]:
    """Those of the quantities that differ from what is right at one of the states."""
    answers, right = evaluate(model, states), Predictor(model, states, View()).right
    bounds = rounding_bounds(model, states)
    wrong = set()
    for q in quantities:
        off = np.array([np.asarray(getattr(answer, q), float) for answer in answers]) - right[q]
        if not error_ratio(off, np.array([np.asarray(b.tolerance(q)) for b in bounds])) <= VANISHED:
            wrong.add(q)
    return wrong
