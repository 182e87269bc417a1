"""Relations that need no truth: the same pendulum described otherwise, asked of the same engine.

Each relation alters model and state in a way whose effect on every answer is known exactly, and takes
the answers back.  The first-order rounding bound is the same on both sides (it is homogeneous in every
unit and knows no axes), so two answers may differ by twice that of the original.

    rotated world        everything in world axes turned by Q
    re-chosen body frame body axes turned by Q: p Q*, s → Q s, J → Q J Qᵀ, ω′ → Q ω′ (an inertia becomes full)
    masses doubled       m, J, loads and drag × 2: the same motion, forces and energies × 2
    lengths × 4          s, ℓ × 4, J × 16, ω and u̇ / 2, moments × 4, c_t / 2, c_r × 8: r̈ and F the same
    time reversed        ω, u̇ → −ω, −u̇ without drag: r̈, ω̇′, F, energies the same, L → −L
    other formulation    the engine's other column (maximal or minimal coordinates) says the same
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from plumbline.bound import Bound, state_bound
from plumbline.findings import Findings, Subject
from plumbline.kinematics import lift, multiply, rotation
from plumbline.records import Array, Model, State, StateQuantities, Unsupported
from plumbline.registry import adapter

FORMULATIONS = {
    "pinocchio": "pinocchio-maximal",
    "pinocchio-maximal": "pinocchio",
    "exudyn": "exudyn-tree",
    "exudyn-tree": "exudyn",
}
STATES, LONG = 4, 12  # states per relation; half of them for chains above so many bodies
Q = np.array([1.0, 2.0, 3.0, 4.0]) / np.sqrt(30.0)  # turns no axis into an axis
QUANTITIES = (
    "acceleration", "angular_acceleration", "joint_reaction", "kinetic_energy", "potential_energy",
    "angular_momentum",
)  # fmt: skip


@dataclass(frozen=True)
class Relation:
    """Another description of the same pendulum, and the way back of what is said of it."""

    name: str
    there: Callable[[Model, State], tuple[Model, State]]
    back: Callable[[Model, StateQuantities], dict[str, Array]]


@dataclass(frozen=True)
class Held:
    """How well one relation held: the worst difference over twice the bound, and where."""

    relation: str
    ratio: float | None  # None where the engine refused every state
    quantity: str
    state: int
    states: int  # that were compared
    refused: str = ""


def values(said: StateQuantities, **factors: float) -> dict[str, Array]:
    """The quantities an engine offers, some multiplied."""
    return {
        q: np.asarray(getattr(said, q), float) * factors.get(q, 1.0)
        for q in QUANTITIES
        if getattr(said, q) is not None
    }


def scaled(model: Model, **factors: float) -> Model:
    """Fields of a model multiplied."""
    return replace(model, **{name: getattr(model, name) * factor for name, factor in factors.items()})


def rotated_world(model: Model, state: State) -> tuple[Model, State]:
    """World vectors and attitudes turned by Q."""
    turn = rotation(Q)
    turned = replace(model, gravity=turn @ model.gravity, force=model.force @ turn.T)
    p = multiply(Q, state.p)
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    return turned, lift(turned, p, state.omega, state.u @ turn.T, state.udot @ turn.T)


def unrotated(_: Model, said: StateQuantities) -> dict[str, Array]:
    """World vectors turned back."""
    world = ("acceleration", "joint_reaction", "angular_momentum")
    return {q: x @ rotation(Q) if q in world else x for q, x in values(said).items()}


def body_frame(model: Model, state: State) -> tuple[Model, State]:
    """Body axes turned by Q: a body vector x becomes Q x."""
    turn = rotation(Q)
    inertia = turn @ model.inertia @ turn.T
    turned = replace(
        model,
        inertia=(inertia + inertia.mT) / 2,
        proximal=model.proximal @ turn.T,
        distal=model.distal @ turn.T,
        moment=model.moment @ turn.T,
    )
    p = multiply(state.p, Q * [1.0, -1.0, -1.0, -1.0])
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    return turned, lift(turned, p, state.omega @ turn.T, state.u, state.udot)


def unframed(_: Model, said: StateQuantities) -> dict[str, Array]:
    """Body vectors turned back."""
    return {q: x @ rotation(Q) if q == "angular_acceleration" else x for q, x in values(said).items()}


def doubled(model: Model, state: State) -> tuple[Model, State]:
    """All masses, inertias, loads and drags × 2."""
    fields = ("mass", "inertia", "force", "moment", "drag_force", "drag_moment")
    return scaled(model, **dict.fromkeys(fields, 2.0)), state


def halved(_: Model, said: StateQuantities) -> dict[str, Array]:
    """Forces, energies and momentum / 2."""
    return values(said, **dict.fromkeys(QUANTITIES[2:], 0.5))


def longer(model: Model, state: State) -> tuple[Model, State]:
    """Lengths × 4 and times × 2."""
    big = scaled(
        model, proximal=4.0, distal=4.0, length=4.0, inertia=16.0, moment=4.0, drag_force=0.5, drag_moment=8.0
    )
    return big, lift(big, state.p, state.omega / 2, state.u, state.udot / 2)


def shorter(_: Model, said: StateQuantities) -> dict[str, Array]:
    """Angular accelerations × 4, energies / 4, momentum / 8."""
    return values(
        said, angular_acceleration=4.0, kinetic_energy=0.25, potential_energy=0.25, angular_momentum=0.125
    )


def reversed_time(model: Model, state: State) -> tuple[Model, State]:
    """The same place, the opposite rates; drag, which knows the direction of time, left out."""
    return model, lift(model, state.p, -state.omega, state.u, -state.udot)


def same(_: Model, said: StateQuantities) -> dict[str, Array]:
    """As they are."""
    return values(said)


RELATIONS = (
    Relation("rotated world", rotated_world, unrotated),
    Relation("re-chosen body frame", body_frame, unframed),
    Relation("masses doubled", doubled, halved),
    Relation("lengths × 4", longer, shorter),
    Relation("time reversed", reversed_time, lambda _, said: values(said, angular_momentum=-1.0)),
)


def check(engine: str, model: Model, states: Sequence[State]) -> list[Held]:
    """Every relation on one engine, at each state (to be called in a worker)."""
    chosen = adapter(engine)
    states = states[: STATES if model.n <= LONG else STATES // 2]
    bounds = [state_bound(model, state) for state in states]
    asked: list[tuple[Relation, Callable[[Model, list[State]], list[StateQuantities]]]] = [
        (relation, chosen.evaluate)
        for relation in RELATIONS
        if not (relation.name == "time reversed" and model.has_drag)
    ]
    if engine in FORMULATIONS:
        other = Relation(f"as {FORMULATIONS[engine]}", lambda m, s: (m, s), same)
        asked.append((other, adapter(FORMULATIONS[engine]).evaluate))
    return [held(relation, chosen.evaluate, evaluate, model, states, bounds) for relation, evaluate in asked]


def held(
    relation: Relation,
    here: Callable[[Model, list[State]], list[StateQuantities]],
    there: Callable[[Model, list[State]], list[StateQuantities]],
    model: Model,
    states: Sequence[State],
    bounds: Sequence[Bound],
) -> Held:
    """One relation at every state that the engine takes on both sides."""
    worst, count, refused = (0.0, "acceleration", 0), 0, ""
    for index, (state, bound) in enumerate(zip(states, bounds, strict=True)):
        other_model, other_state = relation.there(model, state)
        try:
            (right,), (said,) = here(model, [state]), there(other_model, [other_state])
        except Unsupported as refusal:
            refused = str(refusal)
            continue
        count += 1
        mine, theirs = values(right), relation.back(other_model, said)
        for q in mine.keys() & theirs.keys():
            off = np.atleast_1d(mine[q] - theirs[q])
            size = np.linalg.norm(off, axis=-1) if np.ndim(mine[q]) else np.abs(off)
            allowed = np.maximum(2 * np.asarray(bound.tolerance(q)), np.finfo(float).tiny)
            worst = max(worst, (float(np.max(size / allowed)), q, index))
    return Held(relation.name, worst[0] if count else None, worst[1], worst[2], count, refused)


def judge_relations(who: Subject, found: Sequence[Held]) -> Findings:
    """One row per relation: the worst difference over what rounding on both sides explains."""
    rows = []
    for one in found:
        if one.ratio is None:
            rows.append(who.row("relations", "-", one.relation, "unsupported", one.refused))
            continue
        name, agrees = one.quantity.replace("_", " "), one.ratio <= 1
        reason = (
            f"{one.relation}: {who.title} says the same of both to {one.ratio:.2g} of the rounding bounds, "
            f"{one.states} states"
            if agrees
            else f"{one.relation}: {who.title}'s {name} at state {one.state} differs by {one.ratio:.3g} "
            "times the rounding bounds of both"
        )
        rows.append(
            who.row(
                "relations", "-", one.relation, "agrees" if agrees else "disagrees", reason,
                value=one.ratio, tolerance=1.0,
                derivation="worst difference over the sum of both sides' state-level rounding bounds",
                extra={"states": float(one.states), "state": float(one.state)},
            )
        )  # fmt: skip
    return Findings(rows)
