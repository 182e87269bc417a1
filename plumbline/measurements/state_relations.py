"""Metamorphic relations at a state: the same mechanism described in another way, for the same engine.

Each relation changes model and state so that the effect on every answer is known exactly, and maps the
answers back; or it asks for another algorithm of the same engine.  The two answers may differ by the sum of
the first-order rounding bounds of both sides.  The bounds are the same on both sides (they are homogeneous in
every unit and independent of axes), except for welded halves and other joints: their equations have other
terms.

    rotated world        everything in world axes rotated by Q
    re-chosen body frame body axes rotated by Q: p Q*, s → Q s, J → Q J Qᵀ, ω′ → Q ω′ (inertias become full)
    masses doubled       m, J, loads, drag and elements × 2: the same motion, forces and energies × 2
    lengths × 4          s, ℓ × 4, J × 16, ω and u̇ / 2, moments × 4, c_t / 2, c_r × 8: r̈ and F the same
    time reversed        ω, u̇ → −ω, −u̇, drag and dampers off: r̈, ω̇′, F, energies the same, L → −L
    siblings permuted    branches on the same body in another order: the same answers in that order
    as …                 the engine's other formulation (maximal or minimal coordinates)
    by …                 the engine's other algorithm for the accelerations (dense, sparse, …)
    two welded halves    every body built of two bodies that are rigidly joined
    root moved, joints as rods, inertia as rotors, springs as loads: `plumbline.model.redescription`
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from plumbline.engines.metamorphic_hooks import MetamorphicHooks
from plumbline.engines.no_answer import NoAnswer
from plumbline.engines.registry import load_adapter
from plumbline.measurements.relation_result import OPTION_PREFIX, OTHER_FORMULATION_PREFIX, RelationResult
from plumbline.model.datatypes import Array, Model, State, StateQuantities, Unsupported
from plumbline.model.equivalent import (
    BODY_VECTORS,
    WORLD_VECTORS,
    reorder_bodies,
    rotate_body_frames,
    rotate_world,
    siblings_reversed,
    unrotate,
)
from plumbline.model.kinematics import complete_state, sliding_coordinates
from plumbline.model.redescription import (
    inertia_as_rotors,
    joints_as_rods,
    moved_root,
    springs_as_loads,
    state_of_balls,
)
from plumbline.model.welding import split_bodies
from plumbline.truth.rounding_bound import (
    RoundingBound,
    rounding_bounds,
    state_rounding_bound,
)

WELDED_HALVES = "two welded halves"
ROOT_MOVED, JOINTS_AS_RODS = "root moved", "joints as rods"
INERTIA_AS_ROTORS, SPRINGS_AS_LOADS = "inertia as rotors", "springs as loads"
REDESCRIPTIONS = (ROOT_MOVED, JOINTS_AS_RODS, INERTIA_AS_ROTORS, SPRINGS_AS_LOADS)
MAX_STATES, LONG_CHAIN_BODIES = 4, 12  # states per relation; half of them for chains of more bodies
# What an engine may add to rounding by the uncertainty of its limit: as much again, or this share of the
# quantity's scale.  Limits of MuJoCo's loops of rods are uncertain by up to 1e-7 of it (bricard).
LIMIT_SHARE, MAX_UNCERTAINTY = 2.0, 1e-6
MAX_LOOSENESS = 1e-3  # of both together, over the quantity's scale; bounds of light bodies may be near it
Q = np.array([1.0, 2.0, 3.0, 4.0]) / np.sqrt(30.0)  # unit quaternion that rotates no axis into an axis
QUANTITIES = (
    "acceleration", "angular_acceleration", "joint_reaction", "joint_moment", "kinetic_energy",
    "potential_energy", "angular_momentum",
)  # fmt: skip
Evaluate = Callable[[Model, list[State]], list[StateQuantities]]


def _terms_of_tendons(model: Model, state: State) -> dict[str, Array]:
    """Load what only this needs where it is needed: known issues are read at the start of every run."""
    from plumbline.measurements.tendon_equalities import effects_of_missing_terms

    return effects_of_missing_terms(model, state)


MISSING_TERMS = {"tendon equalities": _terms_of_tendons}  # by the option of an engine that lacks one


def quantity_values(answers: StateQuantities, **factors: float) -> dict[str, Array]:
    """Return the state quantities that an engine offers.

    Args:
        **factors: by name of a quantity, the number to multiply it by.

    Returns:
        By name those of `QUANTITIES` that are not None.

    """
    return {
        q: np.asarray(getattr(answers, q), float) * factors.get(q, 1.0)
        for q in QUANTITIES
        if getattr(answers, q) is not None
    }


def unchanged(model: Model, state: State) -> tuple[Model, State]:
    """Return model and state as they are: the transformation of relations between two algorithms."""
    return model, state


@dataclass(frozen=True)
class Relation:
    """Another description of the same pendulum, or another algorithm for it."""

    name: str
    transform: Callable[[Model, State], tuple[Model, State]] = unchanged
    transform_back: Callable[[StateQuantities], dict[str, Array]] = quantity_values  # of the other answers
    # whether the other equations have other terms, so that their bound is another, of bodies in other order
    has_own_terms: bool = False
    # what the other answers are off by where the engine leaves out a term that known_issues.yaml records
    missing_term: Callable[[Model, State], dict[str, Array]] | None = None


def scale_fields(model: Model, **factors: float | Array) -> Model:
    """Multiply fields of a model.

    Args:
        **factors: by name of a field, the number or numbers to multiply it by.

    """
    return model.changed(**{name: getattr(model, name) * factor for name, factor in factors.items()})


def _unrotated(vectors: Sequence[str]) -> Callable[[StateQuantities], dict[str, Array]]:
    """Answers with some of their vectors rotated back."""
    return lambda answers: unrotate(quantity_values(answers), vectors, Q)


def _scaled(**factors: float) -> Callable[[StateQuantities], dict[str, Array]]:
    """Answers multiplied by a number each."""
    return lambda answers: quantity_values(answers, **factors)


def _double_masses(model: Model, state: State) -> tuple[Model, State]:
    fields = ("mass", "inertia", "force", "moment", "drag_force", "drag_moment")
    elements = ("armature", "damping", "stiffness", "effort", "spring_stiffness", "spring_damping")
    return scale_fields(model, **dict.fromkeys((*fields, *elements), 2.0)), state


def _scale_lengths(model: Model, state: State) -> tuple[Model, State]:
    """Lengths × 4 and times × 2."""
    slides = sliding_coordinates(model)

    def of_joint(turn: float, slide: float) -> Array:
        return np.where(slides, slide, turn)

    factors: dict[str, float | Array] = {
        "point": 4, "length": 4, "inertia": 16, "moment": 4, "drag_force": 0.5, "drag_moment": 8,
        "armature": of_joint(16, 1), "damping": of_joint(8, 0.5), "stiffness": of_joint(4, 0.25),
        "rest": of_joint(1, 4), "effort": of_joint(4, 1),
        "spring_point": 4, "spring_length": 4, "spring_stiffness": 0.25, "spring_damping": 0.5,
    }  # fmt: skip
    large = scale_fields(model, **factors)
    rates = {"omega": state.omega / 2, "udot": state.udot / 2, "v": 2 * state.v}
    x, xdot = of_joint(1, 4)[: model.n] * state.x, of_joint(0.5, 2)[: model.n] * state.xdot
    return large, complete_state(large, replace(state, x=x, xdot=xdot, r=4 * state.r, **rates))


def _reverse_time(model: Model, state: State) -> tuple[Model, State]:
    rates = {name: -getattr(state, name) for name in ("omega", "udot", "v", "xdot")}
    return model, complete_state(model, replace(state, **rates))


def _permute_siblings(model: Model) -> Relation:
    """The relation of a model's branches in another order."""
    order = siblings_reversed(model)
    back = np.append(np.argsort(order), np.arange(model.n, len(model.kind)))

    def in_order(answers: StateQuantities) -> dict[str, Array]:
        found = quantity_values(answers)
        return {q: x[back[: len(x)]] if x.ndim == 2 else x for q, x in found.items()}

    return Relation("siblings permuted", lambda m, state: reorder_bodies(m, state, order), in_order)


def _without(*names: str) -> Callable[[StateQuantities], dict[str, Array]]:
    """Answers but for quantities that are others in the other description."""
    return lambda answers: {q: x for q, x in quantity_values(answers).items() if q not in names}


def _move_root(model: Model) -> Relation | None:
    """The relation of a model with another root.

    Moments are about other points there, and left out; with loops forces too, whose determinate part depends
    on that point.
    """
    moved = moved_root(model)
    if moved is None:
        return None
    place = np.argsort(moved.order)
    sign = np.where(moved.joint < 0, 0.0, np.where(moved.is_reversed, -1.0, 1.0))  # a free root has no force

    def back(answers: StateQuantities) -> dict[str, Array]:
        found = _without("joint_moment", *(["joint_reaction"] if model.has_loops else []))(answers)
        for q in found.keys() & {"acceleration", "angular_acceleration"}:
            found[q] = found[q][place]
        if "joint_reaction" in found:
            found["joint_reaction"] = found["joint_reaction"][moved.joint] * sign[:, None]
        return found

    return Relation(ROOT_MOVED, lambda _, state: (moved.model, moved.state(state)), back, True)


def _redescriptions(model: Model) -> Iterator[Relation]:
    """The relations of the same mechanism made of other joints and elements, as far as it has such.

    Bodies without inertia keep their joints: others leave them free to turn before constraints hold them.
    """
    keeps_joints = model.lacks_inertia
    if not keeps_joints and model.n <= LONG_CHAIN_BODIES and (relation := _move_root(model)) is not None:
        yield relation
    balls, rotors = model if keeps_joints else joints_as_rods(model), inertia_as_rotors(model)
    if balls is not model:
        back = _without("joint_reaction", "joint_moment")
        yield Relation(JOINTS_AS_RODS, lambda _, state: (balls, state_of_balls(balls, state)), back, True)
    if rotors is not model:
        # the momentum of rotors is not counted, nor their moment on the body
        back = _without("angular_momentum", "joint_moment")
        yield Relation(INERTIA_AS_ROTORS, lambda _, state: (rotors, state), back, True)
    if np.any(model.stiffness) or np.any(model.damping) or len(model.spring_body):
        back = _without("potential_energy")
        yield Relation(SPRINGS_AS_LOADS, lambda m, state: (springs_as_loads(m, state), state), back, True)


TIME_REVERSED = Relation("time reversed", _reverse_time, _scaled(angular_momentum=-1.0))
_OF_LENGTHS = {
    "angular_acceleration": 4.0, "joint_moment": 0.25, "kinetic_energy": 0.25, "potential_energy": 0.25,
    "angular_momentum": 0.125,
}  # fmt: skip
STATE_RELATIONS = (
    Relation("rotated world", partial(rotate_world, q=Q), _unrotated(WORLD_VECTORS)),
    Relation("re-chosen body frame", partial(rotate_body_frames, q=Q), _unrotated(BODY_VECTORS)),
    Relation("masses doubled", _double_masses, _scaled(**dict.fromkeys(QUANTITIES[2:], 0.5))),
    Relation("lengths × 4", _scale_lengths, _scaled(**_OF_LENGTHS)),
    TIME_REVERSED,
)


@dataclass(frozen=True)
class StateBounds:
    """Rounding bounds of the relations at states, the same for every engine."""

    usual: list[RoundingBound]
    lossless: list[RoundingBound]  # of the mechanism without dampers and drag; empty where it has none
    others: dict[str, list[RoundingBound]]  # of the other side of relations with terms of their own, by name


def state_bounds(model: Model, states: Sequence[State]) -> StateBounds:
    """Compute the rounding bounds of every relation.

    Args:
        states: states of it; those are used that `compared_states` takes.

    """
    states = compared_states(model, states)
    others = {
        relation.name: [state_rounding_bound(*relation.transform(model, state)) for state in states]
        for relation in _redescriptions(model)
    }
    if not model.has_loops:  # an adapter may cut bodies where loops close, and weld them there
        others[WELDED_HALVES] = rounding_bounds(model, states, split_bodies(model))
    lossless = rounding_bounds(_without_losses(model), states) if model.is_dissipative else []
    return StateBounds(rounding_bounds(model, states), lossless, others)


def compared_states(model: Model, states: Sequence[State]) -> Sequence[State]:
    """Return the states at which relations are checked: the first few."""
    return states[: MAX_STATES if model.n <= LONG_CHAIN_BODIES else MAX_STATES // 2]


def _without_losses(model: Model) -> Model:
    off = ("drag_force", "drag_moment", "damping", "spring_damping")
    return scale_fields(model, **dict.fromkeys(off, 0.0))


def check_state_relations(
    engine: MetamorphicHooks, model: Model, states: Sequence[State], bounds: StateBounds
) -> Iterator[RelationResult]:
    """Check every relation on one engine, at each state.

    Args:
        states: states of it; the first few are used.
        bounds: of `state_bounds` for the same states.

    Yields:
        One result per relation.

    """
    states = compared_states(model, states)
    answers = [evaluate_or_refusal(engine.evaluate, model, state) for state in states]
    others: list[tuple[Relation, Evaluate]] = [
        (relation, engine.evaluate)
        for relation in (*STATE_RELATIONS, *_redescriptions(model))
        if not (relation is TIME_REVERSED and model.is_dissipative)
    ]
    if model.is_dissipative:
        lossless, limits = _without_losses(model), bounds.lossless
        found = [evaluate_or_refusal(engine.evaluate, lossless, state) for state in states]
        yield check_state_relation(TIME_REVERSED, found, engine.evaluate, lossless, states, limits, limits)
    if np.any(np.diff(siblings_reversed(model)) < 0):
        others.append((_permute_siblings(model), engine.evaluate))
    others += [
        (
            Relation(OPTION_PREFIX + option, missing_term=MISSING_TERMS.get(option)),
            engine.with_option(option).evaluate,
        )
        for option in engine.options_for(model)
    ]
    if formulation := engine.other_formulation:
        others.append((Relation(OTHER_FORMULATION_PREFIX + formulation), load_adapter(formulation).evaluate))

    if not model.has_loops:
        welded = Relation(WELDED_HALVES)
        others.append((welded, lambda m, at: engine.with_welded_halves().evaluate(m, at)))
    for relation, evaluate in others:
        of_others = bounds.others.get(relation.name, bounds.usual)
        yield check_state_relation(relation, answers, evaluate, model, states, bounds.usual, of_others)


def evaluate_or_refusal(evaluate: Evaluate, model: Model, state: State) -> StateQuantities | Unsupported:
    """Evaluate one state.

    Args:
        evaluate: the engine's function for a list of states.

    Returns:
        The engine's answers, or the exception with which it refused.

    """
    try:
        (answers,) = evaluate(model, [state])
    except Unsupported as refusal:
        return refusal
    return answers


def _evaluate_together(
    evaluate: Evaluate, problems: Sequence[tuple[Model, State]]
) -> list[StateQuantities | Unsupported]:
    """Evaluate states in one call where they are of equal mechanisms, one by one where the engine refuses."""
    (model, _), *rest = problems
    numbers = [np.asarray(x).tobytes() for x in model.fields.values()]
    if all([np.asarray(x).tobytes() for x in other.fields.values()] == numbers for other, _ in rest):
        with suppress(Unsupported):
            return [*evaluate(model, [state for _, state in problems])]
    return [evaluate_or_refusal(evaluate, *problem) for problem in problems]


def check_state_relation(
    relation: Relation,
    answers: Sequence[StateQuantities | Unsupported],
    evaluate_other: Evaluate,
    model: Model,
    states: Sequence[State],
    bounds: Sequence[RoundingBound],
    other_bounds: Sequence[RoundingBound],
) -> RelationResult:
    """Check one relation at every state that the engine evaluates on both sides.

    Args:
        relation: maps the state there and the answers back.
        answers: the engine's usual answer at each state.
        evaluate_other: evaluates the transformed states.
        states: states of it on the constraint manifold.
        bounds: rounding bound of the usual answer at each state.
        other_bounds: rounding bound of the other answer at each state, mapped back.

    Returns:
        The worst difference over the sum of both bounds, of all states, bodies and quantities; and what is
        left of it without the effect of the relation's missing term.

    """
    worst, count, unexplained = (0.0, "", 0), 0, 0.0
    refused, loose = list[Unsupported](), Counter[str]()
    others = [relation.transform(model, state) for state in states]
    try:
        answered = _evaluate_together(evaluate_other, others)
    except MemoryError:
        raise
    except Exception as error:  # an engine may raise anything, and other relations are to be checked
        return RelationResult(relation.name, None, no_answer=NoAnswer.by(error))
    for index, (state, other) in enumerate(zip(states, answered, strict=True)):
        here = answers[index]
        if isinstance(here, Unsupported) or isinstance(other, Unsupported):
            refused += [one for one in (here, other) if isinstance(one, Unsupported)][:1]
            continue
        count += 1
        mine, theirs = quantity_values(here), relation.transform_back(other)
        missing = relation.missing_term(model, state) if relation.missing_term else {}
        for q in mine.keys() & theirs.keys():
            theirs_allowed = np.asarray(other_bounds[index].tolerance(q))
            if relation.has_own_terms:  # its bodies may have another order
                theirs_allowed = np.max(theirs_allowed)
            both = np.asarray(bounds[index].tolerance(q)) + theirs_allowed
            scale = np.asarray(bounds[index].scale[q])
            most = np.maximum(LIMIT_SHARE * both, MAX_UNCERTAINTY * scale)
            most = np.minimum(most, np.where(scale > 0, MAX_LOOSENESS * scale, np.inf))
            both = both + sum((answer.limit_error or {}).get(q, 0.0) for answer in (here, other))
            loose[q] += bool(np.any(both > most))
            allowed = np.maximum(both, np.finfo(float).tiny)
            difference = theirs[q] - mine[q]
            worst = max(worst, (_largest_ratio(difference, allowed), q, index))
            unexplained = max(unexplained, _largest_ratio(difference - missing.get(q, 0.0), allowed))
    if not count:
        return RelationResult(relation.name, None, no_answer=NoAnswer.by(refused[-1]))
    left = unexplained if relation.missing_term else None
    q, often = max(loose.items(), key=lambda one: one[1], default=("", 0))
    undecided = ""
    if 2 * often > count:
        undecided = (
            f"at {often} of {count} states the {q.replace('_', ' ')} may differ by too much to detect an "
            "error, by rounding or by the uncertainty of the engine's limit"
        )
    remark = f"; refused at {len(refused)} of {len(states)} states: {refused[0]}" if refused else ""
    return RelationResult(relation.name, *worst, count, unexplained=left, undecided=undecided, remark=remark)


def _largest_ratio(difference: Array, allowed: Array) -> float:
    """The largest norm over what is allowed; infinite where one is no number."""
    found = float(np.max(np.linalg.norm(np.atleast_1d(difference), axis=-1) / allowed))
    return np.inf if np.isnan(found) else found
