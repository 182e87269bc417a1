"""Defects in mechanisms with loops, planted in real engines: to be reported, and most to be named.

An engine in joint coordinates has a wrong mechanism at the right coordinates, one in maximal coordinates the
right bodies on wrong joints; either evaluates a loop that is not closed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

import reference_impl.direct as direct
from adapters import exudyn_engine, pinocchio_engine
from plumbline.engines.adapter import Adapter
from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Array, Model, State, StateQuantities
from plumbline.model.kinematics import complete_state
from plumbline.model.loops import cut_open, displaced, with_rates
from tests.helpers.planted_axes import turned_by

Evaluate = Callable[[Adapter, Model, State], StateQuantities]


@dataclass(frozen=True)
class LoopDefect:
    """One defect: how an engine evaluates a state."""

    name: str
    scenario: str
    expected: str  # words of the diagnosis; empty: it need only be reported
    engine: str
    evaluate: Evaluate

    def answer(self, model: Model, state: State) -> StateQuantities:
        """What the engine returns, with the checks of an adapter."""
        engine = load_adapter(self.engine)

        class Wrong(type(engine)):  # type: ignore[misc]
            def _evaluate(wrong, model: Model, states: list[State]) -> list[StateQuantities]:
                return [self.evaluate(engine, model, one) for one in states]

        found: list[StateQuantities] = Wrong().evaluate(model, [state])
        return found[0]


def changed(name: str, at: tuple[Any, ...], change: Callable[[Any], Any], is_moved: bool = True) -> Evaluate:
    """Another number; ``is_moved``: at the same joint coordinates, else with the bodies where they are."""

    def evaluate(engine: Adapter, model: Model, state: State) -> StateQuantities:
        values = getattr(model, name).copy()
        values[at] = change(values[at])
        wrong = replace(model, **{name: values})
        return engine._evaluate(wrong, [complete_state(wrong, state) if is_moved else state])[0]

    return evaluate


def _times(factor: float) -> Callable[[Any], Any]:
    return lambda value: factor * value


def _plus(*amount: float) -> Callable[[Any], Any]:
    return lambda value: value + (np.array(amount) if len(amount) > 1 else amount[0])


def _without_velocity_terms(joints: slice) -> Evaluate:
    """γ of some joints is 0."""
    right = direct.constraint_rows

    def wrong(*arguments: Any, **options: Any) -> Any:
        rows = right(*arguments, **options)
        chosen = np.isin(rows.joint, np.arange(rows.joint.max() + 1)[joints])
        return replace(rows, gamma=np.where(chosen, 0.0, rows.gamma))

    def evaluate(engine: Adapter, model: Model, state: State) -> StateQuantities:
        with patch.object(direct, "constraint_rows", wrong):
            return engine._evaluate(model, [state])[0]

    return evaluate


def _loops_without_velocity_terms(engine: Adapter, model: Model, state: State) -> StateQuantities:
    """J q̈ = 0 where it is −J̇ q̇: the constraints are evaluated at rest."""
    chain, right = pinocchio_engine.PinocchioChain, pinocchio_engine.PinocchioChain._closed_acceleration
    pin = pinocchio_engine.pin

    def wrong(self: Any, q: Array, v: Array, torque: Array) -> Array:
        moving = pin.nonLinearEffects(self.pin_model, self.data, q, v)
        resting = pin.nonLinearEffects(self.pin_model, self.data, q, 0 * v)
        return np.asarray(right(self, q, 0 * v, torque - moving + resting))

    with patch.object(chain, "_closed_acceleration", wrong):
        return engine._evaluate(model, [state])[0]


def _without_row(k: int, row: int) -> Evaluate:
    """One of the axes that a joint holds is free."""
    chain = exudyn_engine.ExudynChain

    def evaluate(engine: Adapter, model: Model, state: State) -> StateQuantities:
        with patch.object(exudyn_engine, "ExudynChain", partial(chain, left_out=frozenset({(k, row)}))):
            return engine._evaluate(model, [state])[0]

    return evaluate


def _without_loop(loop: int) -> Evaluate:
    """The ends of one loop are not joined."""

    def evaluate(engine: Adapter, model: Model, state: State) -> StateQuantities:
        cut = cut_open(model)
        ends = tuple(pair for i, pair in enumerate(cut.ends) if i != loop)
        tree = pinocchio_engine.PinocchioChain(cut.model, "crba", ends=ends)
        return cut.source_quantities(tree.quantities(cut.state(state)))

    return evaluate


def _other_branch(given: int, guess: Callable[[Array], Array]) -> Evaluate:
    """The other coordinates that close the loops at the same coordinate of one joint, found from a guess."""

    def evaluate(engine: Adapter, model: Model, state: State) -> StateQuantities:
        return engine._evaluate(model, [other_branch(model, state, given, guess)])[0]

    return evaluate


def other_branch(model: Model, state: State, given: int, guess: Callable[[Array], Array]) -> State:
    """The state of another branch with one coordinate and its rate given."""
    cut = cut_open(model)
    x = guess(state.x)
    x[given] = state.x[given]
    there = cut.state(complete_state(model, replace(state, x=x)))
    place = cut.place[given]  # of hinges and slides alone
    free = np.arange(cut.model.n) != place
    for _ in range(60):
        step = np.zeros(cut.model.n)
        step[free] = np.linalg.lstsq(cut.jacobian(there)[:, free], -cut.gap(there), rcond=1e-9)[0]
        there = displaced(cut.model, there, step / max(1.0, 4 * float(np.max(np.abs(step)))))
    assert np.max(np.abs(cut.gap(there))) < 1e-12
    rates, J = np.zeros(cut.model.n), cut.jacobian(there)
    rates[place] = state.xdot[given, 0]
    rates[free] = np.linalg.lstsq(J[:, free], -J[:, place] * rates[place], rcond=1e-9)[0]
    return cut.source_state(with_rates(cut.model, there, rates))


def _mirrored(x: Array) -> Array:
    return np.asarray(x * [[1], [-1], [-1]])


LOOP_DEFECTS = [
    LoopDefect(
        "mass of a body",
        "four-bar",
        "the mass of body 2 were",
        "pinocchio",
        changed("mass", (1,), _times(1.01)),
    ),
    LoopDefect(
        "inertia of a body",
        "squeezer",
        "the inertia zz of body 5 were",
        "exudyn",
        changed("inertia", (4, 2, 2), _times(1.05)),
    ),
    LoopDefect(
        "an effort's sign",
        "squeezer",
        "the effort of joint 1 had the opposite sign",
        "mujoco",
        changed("effort", (0, 0), _times(-1.0)),
    ),
    LoopDefect(
        "a spring's length",
        "squeezer",
        "the length of spring 1 were",
        "pinocchio",
        changed("spring_length", (0,), _times(1.01)),
    ),
    LoopDefect(
        "a slide's damper",
        "flyball-governor",
        "the damping of joint 4 were doubled",
        "pinocchio",
        changed("damping", (3, 0), _times(2.0)),
    ),
    LoopDefect(
        "a slide's spring left out",
        "flyball-governor",
        "the stiffness of joint 4 were missing",
        "mujoco",
        changed("stiffness", (3, 0), _times(0.0)),
    ),
    LoopDefect(
        "a slide's rest position",
        "flyball-governor",
        "the rest position of joint 4 were",
        "exudyn",
        changed("rest", (3, 0), _plus(0.02)),
    ),
    LoopDefect(
        "length of a rod that closes a loop",
        "flyball-governor",
        "the length of joint 6 were",
        "mujoco",
        changed("length", (5,), _times(1.001)),
    ),
    LoopDefect(
        "length of such a rod, in joint coordinates",
        "flyball-governor",
        "the length of joint 5 were",
        "pinocchio",
        changed("length", (4,), _times(1.0001)),
    ),
    LoopDefect(
        "a rotor that is not there",
        "four-bar",
        "the armature of joint 2 were 0.01",
        "pinocchio",
        changed("armature", (1, 0), _plus(0.01)),
    ),
    LoopDefect(
        "a damper that is not there",
        "slider-crank",
        "the damping of joint 3 were 0.3",
        "exudyn",
        changed("damping", (2, 0), _plus(0.3)),
    ),
    LoopDefect(
        "anchor of the closing joint",
        "four-bar",
        "x of the far point of joint 4 were 0.251 m",
        "pinocchio",
        changed("point", (3, 0, 0), _plus(1e-3)),
    ),
    LoopDefect(
        "anchor of the closing joint, bodies as they are",
        "four-bar",
        "of the far point of joint 4 were",
        "exudyn",
        changed("point", (3, 0, 0), _plus(1e-3), is_moved=False),
    ),
    LoopDefect(
        "axis of a slide",
        "slider-crank",
        "",
        "pinocchio",
        changed("turn", (2, 0), turned_by(1e-3, 0, 0)),
    ),
    LoopDefect(
        "near point of a hinge, bodies as they are",
        "slider-crank",
        "of the near point of joint 2 were",
        "reference",
        changed("point", (1, 1, 0), _plus(1e-3), is_moved=False),
    ),
    LoopDefect(
        "point of an overconstrained loop, bodies as they are",
        "bricard",
        "the near point of joint 3 were",
        "exudyn",
        changed("point", (2, 1, 0), _plus(1e-5), is_moved=False),
    ),
    LoopDefect(
        "axis of an overconstrained loop",
        "bricard",
        "",
        "pinocchio",
        changed("turn", (2, 0), turned_by(1e-7, 0, 0)),
    ),
    LoopDefect(
        "anchor of a spatial loop",
        "flyball-governor",
        "x of the far point of joint 2 were",
        "pinocchio",
        changed("point", (1, 0, 0), _plus(1e-4)),
    ),
    LoopDefect(
        "velocity term of the closing joint missing",
        "four-bar",
        "γ of the rows of joint 4 were missing",
        "reference",
        _without_velocity_terms(slice(3, 4)),
    ),
    LoopDefect(
        "velocity term of a joint of the tree missing",
        "slider-crank",
        "γ of the rows of joint 2 were missing",
        "reference",
        _without_velocity_terms(slice(1, 2)),
    ),
    LoopDefect(
        "velocity term of a rod missing",
        "flyball-governor",
        "γ of the rows of joint 5 were missing",
        "reference",
        _without_velocity_terms(slice(4, 5)),
    ),
    LoopDefect(
        "velocity terms of the loops missing",
        "squeezer",
        "the velocity terms of the rows that close loops were missing",
        "pinocchio",
        _loops_without_velocity_terms,
    ),
    LoopDefect(
        "velocity terms of a spatial loop missing",
        "bricard",
        "the velocity terms of the rows that close loops were missing",
        "pinocchio",
        _loops_without_velocity_terms,
    ),
    LoopDefect(
        "a row of the closing joint left out",
        "slider-crank",
        "the row of joint 4 along x were left out",
        "exudyn",
        _without_row(3, 0),
    ),
    LoopDefect(
        "another row of the closing joint left out",
        "four-bar",
        "the row of joint 4 along y were left out",
        "exudyn",
        _without_row(3, 1),
    ),
    LoopDefect(
        "a loop left open",
        "flyball-governor",
        "the loop of joint 6 were left open",
        "pinocchio",
        _without_loop(1),
    ),
    LoopDefect(
        "a loop of several left open",
        "squeezer",
        "the loop of joint 9 were left open",
        "pinocchio",
        _without_loop(1),
    ),
    LoopDefect(
        "the other branch",
        "four-bar",
        "the loops were closed on another branch at the coordinate of joint 1",
        "pinocchio",
        _other_branch(0, _mirrored),
    ),
    LoopDefect(
        "the other branch of a crank",
        "slider-crank",
        "the loops were closed on another branch at the coordinate of joint 1",
        "mujoco",
        _other_branch(0, lambda x: x * [[1], [1], [-1]] + [[0], [np.pi], [0]]),
    ),
    LoopDefect(
        "gravity",
        "bricard",
        "gravity y were -9.81981",
        "exudyn",
        changed("gravity", (slice(None),), _times(1.001)),
    ),
]
