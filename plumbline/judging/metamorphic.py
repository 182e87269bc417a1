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
from plumbline.engines.metamorphic_hooks import MetamorphicHooks, metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.judging.rows import JudgingResult, RowContext, Verdict
from plumbline.model.datatypes import (
    Array,
    EngineFailure,
    Integrator,
    Model,
    State,
    StateQuantities,
    Trajectory,
    Unsupported,
)
from plumbline.model.invariants import attitude_error, position_error
from plumbline.model.kinematics import (
    angular_velocity,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    state_from_minimal,
)
from plumbline.model.welding import split_bodies
from plumbline.truth.ground_truth import RUN_ROUNDING, stretched_length
from plumbline.truth.rounding_bound import RoundingBound, state_rounding_bound
from plumbline.truth.sensitivity import perturbation_growth

OTHER_FORMULATION_PREFIX, OPTION_PREFIX = (
    "as ",
    "by ",
)  # how names of relations begin: another formulation, another way of the engine
WELDED_HALVES, REVERSED_IN_TIME = "two welded halves", "reversed in time"
MAX_STATES, LONG_CHAIN_BODIES = 4, 12  # states per relation; half of them for chains above so many bodies
STEP_DIVISORS = 1, 4, 16  # steps that an implicit method is given, one after the other, where it fails
RUN_STEPS, STEPS_PER_RADIAN = (
    16,
    32,
)  # of a run, one way; to a radian of the fastest rate, for implicit steps to be solved
Q = np.array([1.0, 2.0, 3.0, 4.0]) / np.sqrt(30.0)  # turns no axis into an axis
QUANTITIES = (
    "acceleration", "angular_acceleration", "joint_reaction", "kinetic_energy", "potential_energy",
    "angular_momentum",
)  # fmt: skip


@dataclass(frozen=True)
class Relation:
    """Another description of the same pendulum, and the way back of what is said of it."""

    name: str
    transform: Callable[[Model, State], tuple[Model, State]]
    transform_back: Callable[[StateQuantities], dict[str, Array]]


@dataclass(frozen=True)
class RelationResult:
    """How well one relation held: the worst difference over what is allowed, and where."""

    relation: str
    ratio: float | None  # None where the engine refused every state
    quantity: str
    worst_state: int
    state_count: int  # that were compared
    refusal_reason: str = ""
    verdict: Verdict = Verdict.UNSUPPORTED  # of a refusal
    integrator: str = "-"  # where it is a relation of runs
    steps: int = 0  # of a run, there and back
    resolution: float = 0.0  # of a run: its step in s, or its relative tolerance
    end_time: float = 0.0  # s, of a run one way


def quantity_values(answers: StateQuantities, **factors: float) -> dict[str, Array]:
    """The quantities an engine offers, some multiplied."""
    return {
        q: np.asarray(getattr(answers, q), float) * factors.get(q, 1.0)
        for q in QUANTITIES
        if getattr(answers, q) is not None
    }


def scale_fields(model: Model, **factors: float) -> Model:
    """Fields of a model multiplied."""
    return replace(model, **{name: getattr(model, name) * factor for name, factor in factors.items()})


def rotate_world(model: Model, state: State) -> tuple[Model, State]:
    """World vectors and attitudes turned by Q."""
    turn = rotation_matrix(Q)
    turned = replace(model, gravity=turn @ model.gravity, force=model.force @ turn.T)
    p = quaternion_product(Q, state.p)
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    return turned, state_from_minimal(turned, p, state.omega, state.u @ turn.T, state.udot @ turn.T)


def unrotate_world(answers: StateQuantities) -> dict[str, Array]:
    """World vectors turned back."""
    world = ("acceleration", "joint_reaction", "angular_momentum")
    return {q: x @ rotation_matrix(Q) if q in world else x for q, x in quantity_values(answers).items()}


def rotate_body_frames(model: Model, state: State) -> tuple[Model, State]:
    """Body axes turned by Q: a body vector x becomes Q x."""
    turn = rotation_matrix(Q)
    inertia = turn @ model.inertia @ turn.T
    turned = replace(
        model,
        inertia=(inertia + inertia.mT) / 2,
        proximal=model.proximal @ turn.T,
        distal=model.distal @ turn.T,
        moment=model.moment @ turn.T,
    )
    p = quaternion_product(state.p, quaternion_conjugate(Q))
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    return turned, state_from_minimal(turned, p, state.omega @ turn.T, state.u, state.udot)


def unrotate_body_frames(answers: StateQuantities) -> dict[str, Array]:
    """Body vectors turned back."""
    return {
        q: x @ rotation_matrix(Q) if q == "angular_acceleration" else x
        for q, x in quantity_values(answers).items()
    }


def double_masses(model: Model, state: State) -> tuple[Model, State]:
    """All masses, inertias, loads and drags × 2."""
    fields = ("mass", "inertia", "force", "moment", "drag_force", "drag_moment")
    return scale_fields(model, **dict.fromkeys(fields, 2.0)), state


def halve_forces(answers: StateQuantities) -> dict[str, Array]:
    """Forces, energies and momentum / 2."""
    return quantity_values(answers, **dict.fromkeys(QUANTITIES[2:], 0.5))


def scale_lengths(model: Model, state: State) -> tuple[Model, State]:
    """Lengths × 4 and times × 2."""
    big = scale_fields(
        model, proximal=4.0, distal=4.0, length=4.0, inertia=16.0, moment=4.0, drag_force=0.5, drag_moment=8.0
    )
    return big, state_from_minimal(big, state.p, state.omega / 2, state.u, state.udot / 2)


def unscale_lengths(answers: StateQuantities) -> dict[str, Array]:
    """Angular accelerations × 4, energies / 4, momentum / 8."""
    return quantity_values(
        answers, angular_acceleration=4.0, kinetic_energy=0.25, potential_energy=0.25, angular_momentum=0.125
    )


def reverse_time(model: Model, state: State) -> tuple[Model, State]:
    """The same place, the opposite rates; drag, which knows the direction of time, left out."""
    return model, state_from_minimal(model, state.p, -state.omega, state.u, -state.udot)


def unchanged(model: Model, state: State) -> tuple[Model, State]:
    """As they are."""
    return model, state


STATE_RELATIONS = (
    Relation("rotated world", rotate_world, unrotate_world),
    Relation("re-chosen body frame", rotate_body_frames, unrotate_body_frames),
    Relation("masses doubled", double_masses, halve_forces),
    Relation("lengths × 4", scale_lengths, unscale_lengths),
    Relation("time reversed", reverse_time, lambda answers: quantity_values(answers, angular_momentum=-1.0)),
)


Evaluate = Callable[[Model, list[State]], list[StateQuantities]]


def check_relations(engine: str, model: Model, states: Sequence[State]) -> list[RelationResult]:
    """Every relation on one engine, at each state (to be called in a worker)."""
    chosen = metamorphic_hooks(load_adapter(engine))
    states = states[: MAX_STATES if model.n <= LONG_CHAIN_BODIES else MAX_STATES // 2]
    said = [evaluate_or_refusal(chosen.evaluate, model, state) for state in states]
    bounds = [state_rounding_bound(model, state) for state in states]
    asked: list[tuple[Relation, Evaluate]] = [
        (relation, chosen.evaluate)
        for relation in STATE_RELATIONS
        if not (relation.name == "time reversed" and model.has_drag)
    ]
    ways: dict[str, Adapter] = {
        OPTION_PREFIX + option: chosen.with_option(option) for option in chosen.options
    }
    if other := chosen.other_formulation:
        ways[OTHER_FORMULATION_PREFIX + other] = load_adapter(other)
    asked += [(Relation(name, unchanged, quantity_values), way.evaluate) for name, way in ways.items()]
    found = [
        check_state_relation(relation, said, evaluate, model, states, bounds, bounds)
        for relation, evaluate in asked
    ]

    def welding(model: Model, states: list[State]) -> list[StateQuantities]:
        return chosen.with_welded_halves().evaluate(model, states)

    welded = Relation(WELDED_HALVES, unchanged, quantity_values)
    of_halves = [state_rounding_bound(model, state, split_bodies(model)) for state in states]
    found.append(check_state_relation(welded, said, welding, model, states, bounds, of_halves))
    return [*found, *check_run_relations(chosen, model, states[0])]


def evaluate_or_refusal(evaluate: Evaluate, model: Model, state: State) -> StateQuantities | Unsupported:
    """What is said of one state, or the refusal."""
    try:
        (said,) = evaluate(model, [state])
    except Unsupported as refusal:
        return refusal
    return said


def check_state_relation(
    relation: Relation,
    answers: Sequence[StateQuantities | Unsupported],
    evaluate_other: Evaluate,
    model: Model,
    states: Sequence[State],
    bounds: Sequence[RoundingBound],
    other_bounds: Sequence[RoundingBound],
) -> RelationResult:
    """One relation at every state that the engine takes on both sides."""
    worst, count, refused = (0.0, "", 0), 0, ""
    for index, state in enumerate(states):
        other_model, other_state = relation.transform(model, state)
        here, other = answers[index], evaluate_or_refusal(evaluate_other, other_model, other_state)
        if isinstance(here, Unsupported) or isinstance(other, Unsupported):
            refused = str(here if isinstance(here, Unsupported) else other)
            continue
        count += 1
        mine, theirs = quantity_values(here), relation.transform_back(other)
        for q in mine.keys() & theirs.keys():
            size = np.linalg.norm(np.atleast_1d(mine[q] - theirs[q]), axis=-1)
            both = np.asarray(bounds[index].tolerance(q)) + other_bounds[index].tolerance(q)
            allowed = np.maximum(both, np.finfo(float).tiny)
            worst = max(worst, (float(np.max(size / allowed)), q, index))
    return RelationResult(relation.name, worst[0] if count else None, worst[1], worst[2], count, refused)


def check_run_relations(engine: MetamorphicHooks, model: Model, state: State) -> Iterator[RelationResult]:
    """The relations of short runs from one state, of every integrator that has one.

    A step too coarse for an implicit one to be solved says nothing: the run is shorter then, and its step.
    """
    step = 2.0 ** float(np.floor(-np.log2(STEPS_PER_RADIAN * fastest_rate(model, state))))
    for integrator in engine.integrators:
        for finer in STEP_DIVISORS:
            found = list(check_integrator_relations(engine, integrator, model, state, step / finer))
            if integrator.kind == "tolerance" or all(held.verdict != Verdict.FAILED for held in found):
                break
        yield from found


def check_integrator_relations(
    engine: MetamorphicHooks, integrator: Integrator, model: Model, state: State, step: float
) -> Iterator[RelationResult]:
    """The relations of one integrator's runs in steps of ``step``."""
    if integrator.is_symmetric and not model.has_drag:
        yield check_time_reversal(engine, integrator, model, state, step)
    if integrator.kind == "step" and engine.linear_solvers:
        yield from check_linear_solvers(engine, integrator, model, state, step)


def fastest_rate(model: Model, state: State) -> float:
    """The fastest rate in 1/s: of a body, of a rod, of the shortest link as a pendulum."""
    swing = np.sqrt(np.linalg.norm(model.gravity) / np.min(stretched_length(model)))
    rates = [np.max(np.linalg.norm(rate, axis=1)) for rate in (state.omega, state.udot)]
    return float(max(swing, *rates)) or 1.0


def check_time_reversal(
    engine: MetamorphicHooks, integrator: Integrator, model: Model, state: State, step: float
) -> RelationResult:
    """There and back by a symmetric integrator: the first row with opposite rates."""
    resolution = step if integrator.kind == "step" else integrator.min_rtol
    end = RUN_STEPS * step
    try:
        run = engine.simulate_round_trip(model, state, end, integrator.name, resolution)
    except (Unsupported, EngineFailure) as refusal:
        return refused_result(REVERSED_IN_TIME, integrator, refusal)
    off = relative_differences(model, state_at_sample(run, 0), state_at_sample(run, 2, -1.0))
    limit = run_tolerance(integrator, model, state, end, run.steps)
    return worst_difference_result(REVERSED_IN_TIME, integrator, off, limit, run.steps, resolution, end)


def check_linear_solvers(
    engine: MetamorphicHooks, integrator: Integrator, model: Model, state: State, step: float
) -> Iterator[RelationResult]:
    """The same run with each of the engine's linear solvers."""
    end = RUN_STEPS * step

    def last(way: Adapter) -> Trajectory | Unsupported | EngineFailure:
        try:
            return way.simulate(model, state, np.array([0.0, end]), integrator.name, step)
        except (Unsupported, EngineFailure) as refusal:
            return refusal

    usual = last(engine)
    limit = 2 * run_tolerance(integrator, model, state, end, RUN_STEPS)
    for solver in engine.linear_solvers:
        other = last(engine.with_option(solver))
        if not isinstance(usual, Trajectory):
            yield refused_result(OPTION_PREFIX + solver, integrator, usual)
        elif not isinstance(other, Trajectory):
            yield refused_result(OPTION_PREFIX + solver, integrator, other)
        else:
            off = relative_differences(model, state_at_sample(usual, -1), state_at_sample(other, -1))
            yield worst_difference_result(
                OPTION_PREFIX + solver, integrator, off, limit, RUN_STEPS, step, end
            )


def refused_result(name: str, integrator: Integrator, refusal: Unsupported | EngineFailure) -> RelationResult:
    """A relation of runs that the engine cannot do, or failed to."""
    verdict: Verdict = Verdict.UNSUPPORTED if isinstance(refusal, Unsupported) else Verdict.FAILED
    return RelationResult(name, None, "", 0, 0, str(refusal), verdict, integrator.name)


def run_tolerance(integrator: Integrator, model: Model, state: State, end: float, steps: int) -> float:
    """What a run from ``state`` may be off by, of a scale of 1: its rounding and its steps' solver, grown.

    On long chains accelerations, rounded, are off by more than the other roundings of a run: by the
    state-level bound, all the time.  The way back is as long, and what grows on it grew as much on the way
    there: without drag the flow is Hamiltonian (but for body-fixed moments, which change little in so short
    a run), and its singular values come in pairs σ, 1/σ.
    """
    of_step = integrator.min_rtol
    if integrator.kind == "step":  # the residual is small beside the heaviest body's: F = m a of a light one
        of_step = integrator.solver_rtol * float(np.max(model.mass) / np.min(model.mass))
    bound, (_, spin, speed) = state_rounding_bound(model, state), characteristic_scales(model, state)
    pushed = end * max(np.max(bound.acceleration) / speed, np.max(bound.angular_acceleration) / spin)
    grown = perturbation_growth(model, state, np.array([0.0, end / 2, end]))
    return float((RUN_ROUNDING + of_step * np.sqrt(steps) + pushed) * np.max(grown))


def characteristic_scales(model: Model, state: State) -> tuple[float, float, float]:
    """What differences are measured by: the pendulum's length (m), its turn (rad/s), its speed (m/s)."""
    length = float(np.sum(stretched_length(model)))
    fall = float(np.sqrt(np.linalg.norm(model.gravity) * length))
    spin = max(fall / length, float(np.max(np.linalg.norm(state.omega, axis=1))), np.finfo(float).tiny)
    return length, spin, max(spin * length, float(np.max(np.linalg.norm(state.v, axis=1))))


def state_at_sample(run: Trajectory, at: int, sign: float = 1.0) -> State:
    """One sample as it is, on the manifold or off; its rates times ``sign``."""
    p, pdot = run.p[at], sign * run.pdot[at]
    nothing = np.zeros_like(run.r[at])
    return State(p, angular_velocity(p, pdot), nothing, nothing, run.r[at], sign * run.v[at])


def relative_differences(model: Model, one: State, other: State) -> dict[str, float]:
    """Differences of two samples, each of its size."""
    length, spin, speed = characteristic_scales(model, one)
    return {
        "position": float(position_error(one.r, other.r)) / length,
        "attitude": float(attitude_error(one.p, other.p)),
        "velocity": float(position_error(one.v, other.v)) / speed,
        "angular velocity": float(position_error(one.omega, other.omega)) / spin,
    }


def worst_difference_result(
    name: str,
    integrator: Integrator,
    differences: dict[str, float],
    limit: float,
    steps: int,
    resolution: float,
    end: float,
) -> RelationResult:
    """A relation of runs to ``end``, from the differences and what each may be."""
    quantity = max(differences, key=lambda q: differences[q])
    ratio = differences[quantity] / limit
    return RelationResult(
        name, ratio, quantity, 0, 1, "", Verdict.UNSUPPORTED, integrator.name, steps, resolution, end
    )


def judge_relations(context: RowContext, found: Sequence[RelationResult]) -> JudgingResult:
    """One row per relation: the worst difference over what rounding on both sides explains."""
    rows = []
    for one in found:
        if one.ratio is None:
            rows.append(
                context.make_row("relations", one.integrator, one.relation, one.verdict, one.refusal_reason)
            )
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
            bounds, over, where = (
                "the rounding bounds",
                f"{one.state_count} states",
                f"state {one.worst_state}",
            )
            derivation = "worst difference over the sum of both sides' state-level rounding bounds"
        reason = (
            f"{one.relation}: {context.title} says the same of both to {one.ratio:.2g} of {bounds}, {over}"
            if agrees
            else f"{one.relation}: {context.title}'s {name} at {where} differs by {one.ratio:.3g} times {bounds}"
            + ("" if one.steps else " of both")
        )
        of_run = {"resolution": one.resolution, "end": one.end_time} if one.steps else {}
        rows.append(
            context.make_row(
                "relations", one.integrator, one.relation, Verdict.AGREES if agrees else Verdict.DISAGREES, reason,
                value=one.ratio, tolerance=1.0, derivation=derivation,
                extra={"states": float(one.state_count), "state": float(one.worst_state), **of_run},
            )
        )  # fmt: skip
    return JudgingResult(rows)
