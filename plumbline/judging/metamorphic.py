"""Relations that need no truth: the same pendulum described otherwise, asked of the same engine.

Each relation alters model and state in a way whose effect on every answer is known exactly, and takes
the answers back; or it asks another way of the same engine.  Two answers may differ by the sum of both
sides' first-order rounding bounds; these are the same (they are homogeneous in every unit and know no axes)
but for welded halves, whose terms are their own.

    rotated world        everything in world axes turned by Q
    re-chosen body frame body axes turned by Q: p Q*, s → Q s, J → Q J Qᵀ, ω′ → Q ω′ (an inertia becomes full)
    masses doubled       m, J, loads and drag × 2: the same motion, forces and energies × 2
    lengths × 4          s, ℓ × 4, J × 16, ω and u̇ / 2, moments × 4, c_t / 2, c_r × 8: r̈ and F the same
    time reversed        ω, u̇ → −ω, −u̇ without drag: r̈, ω̇′, F, energies the same, L → −L
    other formulation    the engine's other column (maximal or minimal coordinates) says the same
    by …                 the engine's other algorithm for the accelerations (dense, sparse, …) says the same
    two welded halves    every body two bodies, rigidly joined: the same of the whole

and two of short runs, whose ends may differ by what rounding and the step's solver do, grown on the way:

    reversed in time     a symmetric integrator, its rates reversed, comes back to where it began, at any step
    by …                 the same run with another linear solver of the engine
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from plumbline.engines.adapter import Adapter
from plumbline.engines.registry import adapter
from plumbline.judging.rows import Findings, Subject
from plumbline.model.datatypes import (
    Array,
    EngineFailure,
    Integrator,
    Model,
    State,
    StateQuantities,
    Trajectory,
    Unsupported,
    Verdict,
)
from plumbline.model.invariants import attitude_error, position_error
from plumbline.model.kinematics import angular_velocity, conjugate, lift, multiply, rotation
from plumbline.model.welding import halves
from plumbline.truth.ground_truth import ROUNDING, reach
from plumbline.truth.rounding_bound import Bound, state_bound
from plumbline.truth.sensitivity import growth

AS, BY = "as ", "by "  # how names of relations begin: another formulation, another way of the engine
WELDED, REVERSED = "two welded halves", "reversed in time"
FORMULATIONS = {
    "pinocchio": "pinocchio-maximal",
    "pinocchio-maximal": "pinocchio",
    "exudyn": "exudyn-tree",
    "exudyn-tree": "exudyn",
}
STATES, LONG = 4, 12  # states per relation; half of them for chains above so many bodies
FINER = 1, 4, 16  # steps that an implicit method is given, one after the other, where it fails
STEPS, COARSE = 16, 32  # of a run, one way; to a radian of the fastest rate, for implicit steps to be solved
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
    back: Callable[[StateQuantities], dict[str, Array]]


@dataclass(frozen=True)
class Held:
    """How well one relation held: the worst difference over what is allowed, and where."""

    relation: str
    ratio: float | None  # None where the engine refused every state
    quantity: str
    state: int
    states: int  # that were compared
    refused: str = ""
    verdict: Verdict = "unsupported"  # of a refusal
    integrator: str = "-"  # where it is a relation of runs
    steps: int = 0  # of a run, there and back
    resolution: float = 0.0  # of a run: its step in s, or its relative tolerance
    end: float = 0.0  # s, of a run one way


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


def unrotated(said: StateQuantities) -> dict[str, Array]:
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
    p = multiply(state.p, conjugate(Q))
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    return turned, lift(turned, p, state.omega @ turn.T, state.u, state.udot)


def unframed(said: StateQuantities) -> dict[str, Array]:
    """Body vectors turned back."""
    return {q: x @ rotation(Q) if q == "angular_acceleration" else x for q, x in values(said).items()}


def doubled(model: Model, state: State) -> tuple[Model, State]:
    """All masses, inertias, loads and drags × 2."""
    fields = ("mass", "inertia", "force", "moment", "drag_force", "drag_moment")
    return scaled(model, **dict.fromkeys(fields, 2.0)), state


def halved(said: StateQuantities) -> dict[str, Array]:
    """Forces, energies and momentum / 2."""
    return values(said, **dict.fromkeys(QUANTITIES[2:], 0.5))


def longer(model: Model, state: State) -> tuple[Model, State]:
    """Lengths × 4 and times × 2."""
    big = scaled(
        model, proximal=4.0, distal=4.0, length=4.0, inertia=16.0, moment=4.0, drag_force=0.5, drag_moment=8.0
    )
    return big, lift(big, state.p, state.omega / 2, state.u, state.udot / 2)


def shorter(said: StateQuantities) -> dict[str, Array]:
    """Angular accelerations × 4, energies / 4, momentum / 8."""
    return values(
        said, angular_acceleration=4.0, kinetic_energy=0.25, potential_energy=0.25, angular_momentum=0.125
    )


def reversed_time(model: Model, state: State) -> tuple[Model, State]:
    """The same place, the opposite rates; drag, which knows the direction of time, left out."""
    return model, lift(model, state.p, -state.omega, state.u, -state.udot)


def same(model: Model, state: State) -> tuple[Model, State]:
    """As they are."""
    return model, state


RELATIONS = (
    Relation("rotated world", rotated_world, unrotated),
    Relation("re-chosen body frame", body_frame, unframed),
    Relation("masses doubled", doubled, halved),
    Relation("lengths × 4", longer, shorter),
    Relation("time reversed", reversed_time, lambda said: values(said, angular_momentum=-1.0)),
)


Evaluate = Callable[[Model, list[State]], list[StateQuantities]]


def check(engine: str, model: Model, states: Sequence[State]) -> list[Held]:
    """Every relation on one engine, at each state (to be called in a worker)."""
    chosen = adapter(engine)
    states = states[: STATES if model.n <= LONG else STATES // 2]
    said = [said_of(chosen.evaluate, model, state) for state in states]
    bounds = [state_bound(model, state) for state in states]
    asked: list[tuple[Relation, Evaluate]] = [
        (relation, chosen.evaluate)
        for relation in RELATIONS
        if not (relation.name == "time reversed" and model.has_drag)
    ]
    ways = {BY + option: chosen.by(option) for option in chosen.options}
    if engine in FORMULATIONS:
        ways[AS + FORMULATIONS[engine]] = adapter(FORMULATIONS[engine])
    asked += [(Relation(name, same, values), other.evaluate) for name, other in ways.items()]
    found = [held(relation, said, evaluate, model, states, bounds, bounds) for relation, evaluate in asked]

    def welding(model: Model, states: list[State]) -> list[StateQuantities]:
        return chosen.welding().evaluate(model, states)

    welded = Relation(WELDED, same, values)
    of_halves = [state_bound(model, state, halves(model)) for state in states]
    found.append(held(welded, said, welding, model, states, bounds, of_halves))
    return [*found, *runs(chosen, model, states[0])]


def said_of(evaluate: Evaluate, model: Model, state: State) -> StateQuantities | Unsupported:
    """What is said of one state, or the refusal."""
    try:
        (said,) = evaluate(model, [state])
    except Unsupported as refusal:
        return refusal
    return said


def held(
    relation: Relation,
    said: Sequence[StateQuantities | Unsupported],
    there: Evaluate,
    model: Model,
    states: Sequence[State],
    bounds: Sequence[Bound],
    other_bounds: Sequence[Bound],
) -> Held:
    """One relation at every state that the engine takes on both sides."""
    worst, count, refused = (0.0, "", 0), 0, ""
    for index, state in enumerate(states):
        other_model, other_state = relation.there(model, state)
        here, other = said[index], said_of(there, other_model, other_state)
        if isinstance(here, Unsupported) or isinstance(other, Unsupported):
            refused = str(here if isinstance(here, Unsupported) else other)
            continue
        count += 1
        mine, theirs = values(here), relation.back(other)
        for q in mine.keys() & theirs.keys():
            size = np.linalg.norm(np.atleast_1d(mine[q] - theirs[q]), axis=-1)
            both = np.asarray(bounds[index].tolerance(q)) + other_bounds[index].tolerance(q)
            allowed = np.maximum(both, np.finfo(float).tiny)
            worst = max(worst, (float(np.max(size / allowed)), q, index))
    return Held(relation.name, worst[0] if count else None, worst[1], worst[2], count, refused)


def runs(engine: Adapter, model: Model, state: State) -> Iterator[Held]:
    """The relations of short runs from one state, of every integrator that has one.

    A step too coarse for an implicit one to be solved says nothing: the run is shorter then, and its step.
    """
    step = 2.0 ** float(np.floor(-np.log2(COARSE * quickest(model, state))))
    for integrator in engine.integrators:
        for finer in FINER:
            found = list(of_integrator(engine, integrator, model, state, step / finer))
            if integrator.kind == "tolerance" or all(held.verdict != "failed" for held in found):
                break
        yield from found


def of_integrator(
    engine: Adapter, integrator: Integrator, model: Model, state: State, step: float
) -> Iterator[Held]:
    """The relations of one integrator's runs in steps of ``step``."""
    if integrator.symmetric and not model.has_drag:
        yield retraced(engine, integrator, model, state, step)
    if integrator.kind == "step" and engine.solvers:
        yield from resolved(engine, integrator, model, state, step)


def quickest(model: Model, state: State) -> float:
    """The fastest rate in 1/s: of a body, of a rod, of the shortest link as a pendulum."""
    swing = np.sqrt(np.linalg.norm(model.gravity) / np.min(reach(model)))
    rates = [np.max(np.linalg.norm(rate, axis=1)) for rate in (state.omega, state.udot)]
    return float(max(swing, *rates)) or 1.0


def retraced(engine: Adapter, integrator: Integrator, model: Model, state: State, step: float) -> Held:
    """There and back by a symmetric integrator: the first row with opposite rates."""
    resolution = step if integrator.kind == "step" else integrator.tightest
    end = STEPS * step
    try:
        run = engine.retrace(model, state, end, integrator.name, resolution)
    except (Unsupported, EngineFailure) as refusal:
        return refused(REVERSED, integrator, refusal)
    off = apart(model, row(run, 0), row(run, 2, -1.0))
    limit = allowed(integrator, model, state, end, run.steps)
    return worst_of(REVERSED, integrator, off, limit, run.steps, resolution, end)


def resolved(
    engine: Adapter, integrator: Integrator, model: Model, state: State, step: float
) -> Iterator[Held]:
    """The same run with each of the engine's linear solvers."""
    end = STEPS * step

    def last(way: Adapter) -> Trajectory | Unsupported | EngineFailure:
        try:
            return way.simulate(model, state, np.array([0.0, end]), integrator.name, step)
        except (Unsupported, EngineFailure) as refusal:
            return refusal

    usual = last(engine)
    limit = 2 * allowed(integrator, model, state, end, STEPS)
    for solver in engine.solvers:
        other = last(engine.by(solver))
        if not isinstance(usual, Trajectory):
            yield refused(BY + solver, integrator, usual)
        elif not isinstance(other, Trajectory):
            yield refused(BY + solver, integrator, other)
        else:
            off = apart(model, row(usual, -1), row(other, -1))
            yield worst_of(BY + solver, integrator, off, limit, STEPS, step, end)


def refused(name: str, integrator: Integrator, refusal: Unsupported | EngineFailure) -> Held:
    """A relation of runs that the engine cannot do, or failed to."""
    verdict: Verdict = "unsupported" if isinstance(refusal, Unsupported) else "failed"
    return Held(name, None, "", 0, 0, str(refusal), verdict, integrator.name)


def allowed(integrator: Integrator, model: Model, state: State, end: float, steps: int) -> float:
    """What a run from ``state`` may be off by, of a scale of 1: its rounding and its steps' solver, grown.

    On long chains accelerations, rounded, are off by more than the other roundings of a run: by the
    state-level bound, all the time.  The way back is as long, and what grows on it grew as much on the way
    there: without drag the flow is Hamiltonian (but for body-fixed moments, which change little in so short
    a run), and its singular values come in pairs σ, 1/σ.
    """
    of_step = integrator.tightest
    if integrator.kind == "step":  # the residual is small beside the heaviest body's: F = m a of a light one
        of_step = integrator.solver * float(np.max(model.mass) / np.min(model.mass))
    bound, (_, spin, speed) = state_bound(model, state), sizes(model, state)
    pushed = end * max(np.max(bound.acceleration) / speed, np.max(bound.angular_acceleration) / spin)
    grown = growth(model, state, np.array([0.0, end / 2, end]))
    return float((ROUNDING + of_step * np.sqrt(steps) + pushed) * np.max(grown))


def sizes(model: Model, state: State) -> tuple[float, float, float]:
    """What differences are measured by: the pendulum's length (m), its turn (rad/s), its speed (m/s)."""
    length = float(np.sum(reach(model)))
    fall = float(np.sqrt(np.linalg.norm(model.gravity) * length))
    spin = max(fall / length, float(np.max(np.linalg.norm(state.omega, axis=1))), np.finfo(float).tiny)
    return length, spin, max(spin * length, float(np.max(np.linalg.norm(state.v, axis=1))))


def row(run: Trajectory, at: int, sign: float = 1.0) -> State:
    """One sample as it is, on the manifold or off; its rates times ``sign``."""
    p, pdot = run.p[at], sign * run.pdot[at]
    nothing = np.zeros_like(run.r[at])
    return State(p, angular_velocity(p, pdot), nothing, nothing, run.r[at], sign * run.v[at])


def apart(model: Model, one: State, other: State) -> dict[str, float]:
    """Differences of two samples, each of its size."""
    length, spin, speed = sizes(model, one)
    return {
        "position": float(position_error(one.r, other.r)) / length,
        "attitude": float(attitude_error(one.p, other.p)),
        "velocity": float(position_error(one.v, other.v)) / speed,
        "angular velocity": float(position_error(one.omega, other.omega)) / spin,
    }


def worst_of(
    name: str,
    integrator: Integrator,
    off: dict[str, float],
    limit: float,
    steps: int,
    resolution: float,
    end: float,
) -> Held:
    """A relation of runs to ``end``, from the differences and what each may be."""
    quantity = max(off, key=lambda q: off[q])
    ratio = off[quantity] / limit
    return Held(name, ratio, quantity, 0, 1, "", "unsupported", integrator.name, steps, resolution, end)


def judge_relations(who: Subject, found: Sequence[Held]) -> Findings:
    """One row per relation: the worst difference over what rounding on both sides explains."""
    rows = []
    for one in found:
        if one.ratio is None:
            rows.append(who.row("relations", one.integrator, one.relation, one.verdict, one.refused))
            continue
        name, agrees = one.quantity.replace("_", " "), one.ratio <= 1
        if one.steps:
            bounds, over, where = (
                "what rounding and the step's solver explain",
                f"{one.steps} steps",
                "the end",
            )
            derivation = (
                "worst difference, of the pendulum's length, speed and turn, over (10³ ε + the tolerance of "
                "the step's solver × √steps × the ratio of masses + the state-level rounding bound × time) × "
                "the growth of a small perturbation"
            )
        else:
            bounds, over, where = "the rounding bounds", f"{one.states} states", f"state {one.state}"
            derivation = "worst difference over the sum of both sides' state-level rounding bounds"
        reason = (
            f"{one.relation}: {who.title} says the same of both to {one.ratio:.2g} of {bounds}, {over}"
            if agrees
            else f"{one.relation}: {who.title}'s {name} at {where} differs by {one.ratio:.3g} times {bounds}"
            + ("" if one.steps else " of both")
        )
        of_run = {"resolution": one.resolution, "end": one.end} if one.steps else {}
        rows.append(
            who.row(
                "relations", one.integrator, one.relation, "agrees" if agrees else "disagrees", reason,
                value=one.ratio, tolerance=1.0, derivation=derivation,
                extra={"states": float(one.states), "state": float(one.state), **of_run},
            )
        )  # fmt: skip
    return Findings(rows)
