"""Where an unknown force acts by which an engine differs from the truth: in a joint, in springs, on a body.

A difference that no number and no other reading explains may still be that of forces at one place, another
at each state: a term of a formula that is wrong, stale, or applied at a wrong point.  The effect of a
force on accelerations and joint wrenches is linear, so that its amounts at every state follow from least
squares; the place with the fewest amounts that leaves nothing but rounding is named.  Energies have to be
right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from plumbline.diagnosis.joint_causes import one_number
from plumbline.model.datatypes import Array, Model
from plumbline.model.kinematics import quaternion_exponential, quaternion_product

Place = tuple[str, list[Model]]  # words, and the mechanism with each of its forces
RANK_TOLERANCE = 1e-9  # of effects: a force that changes nothing


def force_places(model: Model) -> Iterator[list[Place]]:
    """List the places of forces by the number of amounts that are unknown at a state.

    Args:
        model: a tree.

    Yields:
        Places of one amount, of all springs together, of two amounts, of three and of six; of a single body
        a moment on it and in its ball joint.

    """
    single, joints, balls = list[Place](), list[Place](), list[Place]()
    for k, kind in enumerate(model.kinds):
        motions = kind.motions
        for i, (what, _) in enumerate(motions):
            which = f" {kind.motion_names[i]}" * (len(motions) > 1)
            words = f"another {'force' if what == 'slide' else 'torque'} acted along joint {k + 1}{which}"
            effort = one_number("effort", (k, i))(model, model.effort[k, i] + 1.0)
            single.append((words, [effort]))
        if kind.is_spherical:
            balls.append((f"another moment acted in joint {k + 1}", _moments_in_ball(model, k)))
        if len(motions) > 1:
            joints.append(
                (f"other efforts acted along joint {k + 1}", [one for _, (one,) in single[-len(motions) :]])
            )
    springs = [
        one_number("spring_stiffness", (i,))(model, model.spring_stiffness[i] + 1.0)
        for i in range(len(model.spring_body))
    ]
    single += [(f"the force of spring {i + 1} were another", [one]) for i, one in enumerate(springs)]
    yield single
    if len(springs) > 1:
        yield [("the forces of the springs between points were others", springs)]
    yield joints
    loads = {
        name: [
            [one_number(name, (k,))(model, getattr(model, name)[k] + e) for e in np.eye(3)]
            for k in range(model.n)
        ]
        for name in ("force", "moment")
    }
    on_bodies = [
        (f"another {name} acted on body {k + 1}", loads[name][k]) for name in loads for k in range(model.n)
    ]
    if model.n == 1:  # a force and a moment on the only body explain any accelerations and wrenches
        if balls:
            yield on_bodies[1:] + balls
        return
    yield on_bodies + balls
    if len(balls) > 1:
        yield [("other moments acted in the ball joints", [one for _, some in balls for one in some])]
    both = [loads["force"][k] + loads["moment"][k] for k in range(model.n)]
    yield [(f"another force and moment acted on body {k + 1}", some) for k, some in enumerate(both)]


def _moments_in_ball(model: Model, k: int) -> list[Model]:
    """Three other moments between the bodies of a ball joint: of a spring that rests at other attitudes."""
    sprung = one_number("stiffness", (k, 0))(model, model.stiffness[k, 0] or 1.0)
    turns = (quaternion_product(model.turn[k, 1], quaternion_exponential(e / 2)) for e in np.eye(3))
    return [one_number("turn", (k, 1))(sprung, turn) for turn in turns]


def locate_force(
    model: Model,
    effects: Callable[[Sequence[Model]], Array],
    wanted: Array,
    states: NDArray[np.intp],
    accepted: float,
) -> list[str]:
    """Find where unknown forces explain a difference.

    Args:
        model: a tree.
        effects: of mechanisms (M) on accelerations and joint wrenches (M, m), in bounds.
        wanted: the difference (m,) in bounds.
        states: (m,) the state of each of its numbers.
        accepted: what may be left of it, in bounds.

    Returns:
        Words that complete "behaves as if", one entry per place with the same number of amounts.

    """
    for places in force_places(model):
        columns = iter(effects([one for _, models in places for one in models]) if places else ())
        found = []
        for words, models in places:
            basis: Array = np.stack([next(columns) for _ in models], axis=1)
            if is_spanned(basis, wanted, states, accepted):
                found.append(words)
        if found:
            return found
    return []


def is_spanned(basis: Array, wanted: Array, states: NDArray[np.intp], accepted: float) -> bool:
    """Decide whether some amounts at each state leave nothing of a difference.

    Args:
        basis: effects (m, amounts), in bounds.
        wanted: the difference (m,) in bounds.
        states: (m,) the state of each of its numbers.
        accepted: what may be left of it, in bounds.

    Returns:
        Whether amounts found by least squares leave at most that.

    """
    for state in np.unique(states):
        here, there = basis[states == state], wanted[states == state]
        size = np.max(np.abs(here), axis=0)
        here = here[:, size > 0] / size[size > 0]
        amounts = np.linalg.lstsq(here, there, rcond=RANK_TOLERANCE)[0]
        if np.max(np.abs(there - here @ amounts)) > accepted:
            return False
    return True
