"""Find what a difference needs, by intervention: the engine is asked again with one thing taken away.

What cannot be taken away without the difference vanishing is what an unexplained difference is known by,
whatever the scenarios in which it shows.  Where a thing can be taken away in several ways (a joint may become
one of several others), the difference must vanish in all of them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from itertools import combinations, islice

import numpy as np

from plumbline.diagnosis.digit_loss import REFUSALS, Evaluate, ask_ratios
from plumbline.diagnosis.prediction import is_closed
from plumbline.model.datatypes import BODY_FIELDS, JOINT_ELEMENTS, JOINT_FIELDS, KINDS, Flags, Model, State
from plumbline.model.kinematics import complete_state

VANISHED = 2.0  # in bounds: the engine's rounding and that of the expected number
MAX_CHOICES, MAX_TRIALS = 100, 3  # of as many bodies, from either end: looked at, and tried
MAX_COUNT = 6  # of bodies that are distinguished from more
SAME_CALL = "other states in the same call"
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
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
    if model.has_loops:
        tree = model.tree, [complete_state(model.tree, s) for s in states]
        needing = _vanished([tree], quantities, evaluate) or set()
        others = set(quantities) - needing  # a tree is asked about faster, and everything can be taken away
        found = find_needs(*tree, others, evaluate) if others else {}
        closed = _needs(model, states, needing, evaluate) if needing else {}
        return found | {q: (*some, "a closing joint") for q, some in closed.items()}
    found = _needs(model, states, quantities, evaluate)
    for q, some in found.items():
        fewest, count = 1, 1
        while count < min(model.n, MAX_COUNT):
            vanished = _vanished(_of_bodies(model, states, count, some), [q], evaluate)
            if vanished == set():
                break
            count += 1
            fewest = fewest if vanished else count  # what it needs is not there with fewer
        if count > fewest:
            found[q] = (*some, f"{count} bodies")
    return found


def _needs(
    model: Model, states: list[State], quantities: Collection[str], evaluate: Evaluate
) -> dict[str, tuple[str, ...]]:
    """What single changes that keep the bodies and loops show."""
    needs: dict[str, list[str]] = {quantity: [] for quantity in quantities}
    for what, ways in _without_one(model, states):
        for quantity in _vanished(ways, quantities, evaluate) or ():
            needs[quantity].append(what)
    return {quantity: tuple(found) for quantity, found in needs.items()}


def _vanished(ways: Iterable[Problem], quantities: Collection[str], evaluate: Evaluate) -> set[str] | None:
    """Those of the quantities that are right in all ways that the engine accepts; None if it accepts none."""
    left, is_answered = set(quantities), False
    for model, states in ways:
        if all(kind.is_rigid for kind in model.kinds):  # nothing moves
            continue
        try:
            left -= _wrong(model, states, left, evaluate)
            is_answered = True
        except REFUSALS:
            continue
        if not left:
            break
    return left if is_answered else None


def _without_one(model: Model, states: list[State]) -> Iterator[tuple[str, Iterable[Problem]]]:
    """The mechanism and its states with one thing taken away."""
    if any(np.any(s.v) or np.any(s.omega) or np.any(s.xdot) for s in states):
        yield "motion", [(model, [_at_rest(s) for s in states])]
    for what, names in ABSENT_FIELDS.items():
        if any(np.any(getattr(model, name)) for name in names):
            yield what, [(model.changed(**{name: 0 * getattr(model, name) for name in names}), states)]
    if np.any(model.inertia * (1 - np.eye(3))):
        yield "products of inertia", [(replace(model, inertia=model.inertia * np.eye(3)), states)]
    for kind in dict.fromkeys(model.kind):
        yield f"a {kind} joint", _with_other_joints(model, states, kind)
    if np.any(_turns(model)):
        turn = np.broadcast_to(IDENTITY, model.turn.shape)
        yield "turned axes of joints", _possible(replace(model, turn=turn), states)
    far = model.body[: model.n, 0]
    if len(set(far.tolist())) < model.n and not model.has_loops:
        body = np.where(model.free[:, None], model.body, model.body[:, 1:] - [1, 0])
        yield "a branch", _possible(replace(model, body=body), states)


def _turns(model: Model) -> Flags:
    """Where a joint's axes are turned in a body (J, 2); joints that have none are not."""
    of_kind = [not kind.has_attitude for kind in model.kinds]
    return np.asarray(np.any(model.turn[..., 1:] != 0, axis=-1) & np.array(of_kind)[:, None])


def _at_rest(s: State) -> State:
    return replace(s, omega=0 * s.omega, udot=0 * s.udot, xdot=0 * s.xdot, v=0 * s.v)


def _possible(model: Model, states: list[State]) -> Iterator[Problem]:
    """The problem at the same coordinates; none where they open loops."""
    at = [complete_state(model, s) for s in states]
    if not model.has_loops or all(is_closed(model, s) for s in at):
        yield model, at


def _with_other_joints(model: Model, states: list[State], kind: str) -> Iterator[Problem]:
    """The mechanism with joints of another kind in place of one kind, the others' elements kept."""
    where = np.array([own == kind for own in model.kind])
    far = model.body[where, 0]
    for other, new in KINDS.items():
        is_elsewhere = (new.is_rigid and np.any(far < 0)) or (new.holds_nothing and np.any(far >= 0))
        if other == kind or is_elsewhere or (new.holds_nothing and np.any(where[model.n :])):
            continue
        kinds = tuple(other if own == kind else own for own in model.kind)
        columns = np.arange(model.columns) < new.element_count
        fields = {name: getattr(model, name) * (columns | ~where[:, None]) for name in JOINT_ELEMENTS}
        if new.is_spherical:
            fields |= {name: fields[name] * ~where[:, None] for name in ("rest", "effort")}
        length = np.where(where, float(bool(new.own_number)), model.length)
        changed = replace(model, kind=kinds, length=length, **fields)
        along = np.where(where[: model.n, None], [0.0, 0.0, -float(new.holds_distance)], 0.0)
        some = where[: model.n, None]
        moved = [replace(s, u=np.where(some, along, s.u), udot=np.where(some, 0.0, s.udot)) for s in states]
        yield from _possible(changed, moved)


def _of_bodies(model: Model, states: list[State], count: int, needs: Collection[str]) -> Iterator[Problem]:
    """Mechanisms of so many of a tree's bodies that have all that a difference needs."""
    for order in (range(model.n), range(model.n)[::-1]):
        choices = islice(combinations(order, count), MAX_CHOICES)
        problems = (_reduced(model, states, sorted(kept)) for kept in choices)
        fitting = (one for one in problems if {what for what, _ in _without_one(*one)} >= set(needs))
        yield from islice(fitting, MAX_TRIALS)


def _reduced(model: Model, states: list[State], kept: list[int]) -> Problem:
    """Some of a tree's bodies, on the nearest ones that are kept; what only others have is given to them."""
    place = {k: i for i, k in enumerate(kept)}
    far = []
    for k in kept:
        above = int(model.body[k, 0])
        while above >= 0 and above not in place:
            above = int(model.body[above, 0])
        far.append(place.get(above, -1))
    names = ("mass", "inertia", *BODY_FIELDS, *JOINT_FIELDS[2:])
    fields = {name: getattr(model, name)[kept] for name in names}
    lacking = np.arange(model.columns) >= np.array([[model.kinds[k].element_count] for k in kept])
    skew = np.any(model.inertia * (1 - np.eye(3)), axis=(1, 2))
    has = {name: np.any(getattr(model, name).reshape(model.n, -1), axis=1) for name in BODY_FIELDS}
    has |= {"turn": np.any(_turns(model), axis=1), "mass": skew, "inertia": skew}
    for name, where in has.items():
        if np.any(where) and not np.any(where[kept]):
            fields[name] = np.resize(getattr(model, name)[where], fields[name].shape)
    for name in JOINT_ELEMENTS:
        if not np.any(fields[name]):
            fields[name] = np.where(lacking, 0.0, np.max(np.abs(getattr(model, name))))
    ends = np.array([[place.get(int(b), -1) for b in pair] for pair in model.spring_body], np.intp)
    ends = ends.reshape(-1, 2)
    ends[np.all(ends < 0, axis=1), 1] = 0
    reduced = replace(
        model,
        kind=tuple(model.kind[k] for k in kept),
        body=np.stack([np.array(far), np.arange(len(kept))], axis=1),
        spring_body=ends,
        **fields,
    )
    some = [s[kept] for s in states]
    return reduced, [complete_state(reduced, s) for s in some]


def _wrong(model: Model, states: list[State], quantities: Collection[str], evaluate: Evaluate) -> set[str]:
    """Those of the quantities that differ from what is right at one of the states, or are not given."""
    ratios = ask_ratios(evaluate, model, states, quantities)
    return {q for q, ratio in ratios.items() if not ratio <= VANISHED}
