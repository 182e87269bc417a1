"""Effects of mistakes in parameters on the state quantities at given states.

Effects are derivatives by jets; mistakes of a given size are evaluated whole, in doubles.  Both are of the
tree, cut open where there are loops, at the same minimal coordinates.  Loops that a mistake leaves open are
not closed again: an engine evaluates the state that it is given, closing joints where the bodies put them.
Where rows depend on others, the same are kept as without the mistake.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from plumbline.equations.arithmetic import Arithmetic, floats, quantity_arrays
from plumbline.equations.jets import Jet, jets, with_slopes
from plumbline.equations.tree import Tree
from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import complete_state, stack_states
from plumbline.model.loops import PER_JOINT, CutMechanism, cut_open, determinate_wrenches, independent_rows
from plumbline.truth.loop_closure import shifted_inertia
from plumbline.truth.parameters import STATE_KINDS, Parameter, derivative, perturb, perturb_model

MOVE = 1e-4  # of a parameter, in central differences of the coordinates of closing joints
DIRECTIONS = 32  # of one batch of jets: those of a body or two, which leave the slopes of others 0
MAX_BATCH_BODIES = 16_000  # of one batch: more do not fit the processor's cache

_Any = TypeVar("_Any")
Effects = dict[str, Array]  # by quantity the norms (P, N) per body of vectors, or (P, 1)


def effects_at_states(
    model: Model, states: Sequence[State], parameters: Sequence[Parameter]
) -> list[Effects]:
    """Return the effects of unit changes of parameters of the model or of the states, state by state."""
    if not parameters:
        return [{} for _ in states]
    size = 1 if model.has_loops else max(1, MAX_BATCH_BODIES // DIRECTIONS // model.n)
    found = list[Effects]()
    for some in _batches(states, size):
        parts = [_effects_by_jets(model, some, directions) for directions in _batches(parameters, DIRECTIONS)]
        found += _state_by_state(parts, len(some))
    return found


def _state_by_state(parts: Sequence[Effects], count: int) -> list[Effects]:
    """Join the effects of batches of parameters, and divide them among the states."""
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return [{name: x[:, at] for name, x in joined.items()} for at in range(count)]


def _batches(every: Sequence[_Any], size: int) -> Iterator[Sequence[_Any]]:
    return (every[first : first + size] for first in range(0, len(every), size))


def _effects_by_jets(model: Model, states: Sequence[State], parameters: Sequence[Parameter]) -> Effects:
    """Effects at several states, or at one of a mechanism with loops: (P, S, N) or (P, S, 1)."""
    directions, stacked = [_derivatives(model, states, one) for one in parameters], stack_states(states)
    changed, there = with_slopes(model, stacked, directions)
    if model.has_loops:
        steps = [MOVE * one.scale for one in parameters]
        moved = _moved_trees(model, stacked, directions, steps)
        _, there = with_slopes(model, cut_open(model).state(stacked), moved)

    def slope(x: Jet) -> Any:
        return np.zeros(x.value.shape[-2:]) if x.slope is None else x.slope

    lead = len(parameters), len(states)
    found = _quantities(jets(), cut_open(model), states[0], (changed, there), lead, slope)
    return {name: _sizes(name, x) for name, x in _determinate(model, states[0], found).items()}


def _moved_trees(
    model: Model, state: State, directions: Sequence[Mapping[str, Array]], steps: Sequence[float]
) -> list[dict[str, Array]]:
    """Derivatives of the coordinates of a tree cut open: those of closing joints follow from the bodies.

    Args:
        state: arrays (1, ...).
        directions: derivatives of the model's fields and the state's.
        steps: changes along them.

    """
    every = list(zip(directions, steps, strict=True))
    fields = {name: value[None] for name, value in vars(model).items() if any(name in x for x in directions)}

    def moved(values: Mapping[str, Array], sign: int) -> dict[str, Any]:
        return {
            name: np.array([value + sign * step * one.get(name, 0.0) for one, step in every])
            for name, value in values.items()
        }

    trees = []
    for sign in (1, -1):
        own, there = replace(model, **moved(fields, sign)), State(**moved(vars(state), sign))
        trees.append(cut_open(model).with_numbers(own).state(complete_state(own, there)))
    change = {name: x - getattr(trees[1], name) for name, x in vars(trees[0]).items()}
    # angles of closing joints are between −π and π, and no coordinate moves by more than that
    change["x"] -= 2 * np.pi * np.round(change["x"] / (2 * np.pi))
    return [{name: x[i, 0] / (2 * step) for name, x in change.items()} for i, step in enumerate(steps)]


def _derivatives(model: Model, states: Sequence[State], parameter: Parameter) -> dict[str, Array]:
    if parameter.kind not in STATE_KINDS:
        return derivative(model, states[0], parameter)
    each = [derivative(model, state, parameter) for state in states]
    return {name: np.stack([one[name] for one in each]) for name in each[0]}


def _quantities(
    num: Arithmetic,
    cut: CutMechanism,
    at: State,
    changed: tuple[Model, State],
    lead: tuple[int, ...],
    part: Callable[[Any], Any] = lambda x: x,
) -> dict[str, Array]:
    """All quantities, or a part of their numbers: (*lead, N, 3), (*lead, 3), (*lead) and matrices of trees.

    Args:
        at: a state of the mechanism, at which the rows that do not depend on others are chosen.
        changed: a model of the same joints, and the coordinates of its tree.

    """
    rows, own = list[int](), dict[str, Array]()
    tree = Tree(num, cut.with_numbers(changed[0]).model, changed[1])
    if cut.ends:
        rows = [int(row) for row in independent_rows(cut.jacobian(cut.state(at)), cut.row_scale)]
        tree.shifted = shifted_inertia(cut)
    else:
        matrix = part(tree.mass_matrix())
        own["mass_matrix"] = np.broadcast_to(matrix, (*lead, *matrix.shape[-2:]))
    found = cut.of_source(tree.quantities(tree.solve_joined(cut.ends, rows)))
    if cut.ends:  # sums are over whole bodies, not over parts that the change has taken apart
        whole = Tree(num, cut.with_whole_bodies().with_numbers(changed[0]).model, changed[1])
        found |= whole.sums()
    parts = {name: [*map(part, x)] if isinstance(x, list) else part(x) for name, x in found.items()}
    return own | quantity_arrays(parts, lead)


def _determinate(model: Model, at: State, found: dict[str, Array]) -> dict[str, Array]:
    """Keep of joints' wrenches, or of their changes, the parts that are unique without the changes."""
    wrenches = determinate_wrenches(model, at, *(found[name] for name in PER_JOINT))
    return found | dict(zip(PER_JOINT, wrenches, strict=True))


def _sizes(name: str, change: Array) -> Array:
    """Norms (P, S, N) of vectors per body, (P, S, 1) of the rest: the largest entry of a matrix."""
    if name == "mass_matrix":
        return np.asarray(np.max(np.abs(change), axis=(2, 3))[..., None])
    rows = change.reshape(*change.shape[:2], -1, 3 if change.ndim > 2 else 1)
    return np.asarray(np.linalg.norm(rows, axis=-1))


def difference_effects(
    model: Model, states: Sequence[State], parameters: Sequence[Parameter], mistake: float
) -> list[Effects]:
    """Return the effects of changes of parameters, per unit, by differences of the whole evaluation.

    Args:
        mistake: size of the changes, as a fraction of each scale.

    Returns:
        Per state, as `effects_at_states`.

    """
    parts, size = list[Effects](), max(1, MAX_BATCH_BODIES // (model.n * len(states)))
    for some in _batches(parameters, size):
        cases = [_perturbed(model, states, one, mistake) for one in some]
        evaluated = evaluate_models(model, states, [(model, stack_states(states)), *cases])
        scale = mistake * np.array([one.scale for one in some])[:, None, None]
        parts.append({name: _sizes(name, x[1:] - x[:1]) / scale for name, x in evaluated.items()})
    return _state_by_state(parts, len(states))


def _perturbed(
    model: Model, states: Sequence[State], parameter: Parameter, size: float
) -> tuple[Model, State]:
    """A changed model with its states, stacked; the same minimal coordinates but for a changed one."""
    if parameter.kind in STATE_KINDS:
        return model, stack_states([perturb(model, state, parameter, size)[1] for state in states])
    changed = perturb_model(model, parameter, size)
    return changed, complete_state(changed, stack_states(states))


def evaluate_models(
    model: Model, states: Sequence[State], cases: Sequence[tuple[Model, State]]
) -> dict[str, Array]:
    """Evaluate all state quantities of changed models of one mechanism, in doubles.

    Args:
        model: without changes.
        states: S states of it.
        cases: K mechanisms of as many bodies and joints, each with S states of `complete_state`.

    Returns:
        By quantity (K, S, ...), with the names and units of `StateQuantities`; of loops the determinate
        parts, without mass matrices.

    """
    given, *joints = [(one.kind, one.body.tobytes()) for one in (model, *(own for own, _ in cases))]
    groups = [[i for i, one in enumerate(joints) if one == own] for own in dict.fromkeys(joints)]
    order, each = np.argsort(np.concatenate(groups)), list[dict[str, Array]]()
    for i, base in enumerate(states if model.has_loops else states[:1]):
        some = slice(i, i + 1) if model.has_loops else slice(None)
        parts = []
        for group in groups:
            at = base if joints[group[0]] == given else cases[group[0]][1][i]
            parts.append(_evaluate_together(at, [(cases[k][0], cases[k][1][some]) for k in group]))
        found = {name: np.concatenate([part[name] for part in parts])[order] for name in parts[0]}
        each.append(_determinate(model, base, found))
    return {name: np.concatenate([one[name] for one in each], axis=1) for name in each[0]}


def _evaluate_together(at: State, cases: Sequence[tuple[Model, State]]) -> dict[str, Array]:
    """Evaluate mechanisms with the same joints between the same bodies; of loops at one state of theirs."""
    models, states = zip(*cases, strict=True)
    numbers: dict[str, Any] = {
        name: np.array([getattr(one, name) for one in models])[:, None]
        for name in vars(models[0]).keys() - {"kind", "body", "spring_body"}
    }
    changed, stacked, cut = replace(models[0], **numbers), stack_states(states), cut_open(models[0])
    there = cut.with_numbers(changed).state(stacked)
    with np.errstate(divide="ignore", invalid="ignore"):  # a mechanism may move without inertia
        return _quantities(floats(), cut, at, (changed, there), stacked.p.shape[:2])
