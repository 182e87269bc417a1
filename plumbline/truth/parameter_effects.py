"""Effects of mistakes in parameters on the state quantities at given states.

Of mechanisms without loops the effects are derivatives by jets; of mechanisms with loops they are differences
of first-order corrections (`linear_effects`).  Mistakes of a given size are evaluated whole, in doubles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from plumbline.equations.arithmetic import floats
from plumbline.equations.jets import Jet, jets, with_slopes
from plumbline.equations.tree import Tree
from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import complete_state, stack_states
from plumbline.truth.linear_effects import ChangedModels
from plumbline.truth.parameters import STATE_KINDS, Parameter, derivative, perturb, perturb_model

STATE_MISTAKE = 1e-4  # of a state's parameters, in central differences of loops
LOOP_MISTAKE = 0.02  # of a loop's: rounding in the difference is below a bound, its error below 0.1 %
DIRECTIONS = 32  # of one batch of jets: those of a body or two, which leave the slopes of others 0
MAX_BATCH_BODIES = 16_000  # of one batch: more do not fit the processor's cache

_Any = TypeVar("_Any")
Effects = dict[str, Array]  # by quantity the norms (P, N) per body of vectors, or (P, 1)


def effects_at_states(
    model: Model, states: Sequence[State], parameters: Sequence[Parameter]
) -> list[Effects]:
    """Return the effects of unit changes of parameters of the model or of the states, state by state."""
    if model.has_loops:
        # the spring of a ball joint jumps at half a turn, which a smaller difference hardly ever meets
        small = [one.kind.endswith("frame") and model.kinds[one.body].is_spherical for one in parameters]
        sizes = [
            STATE_MISTAKE if is_small or one.kind in STATE_KINDS else LOOP_MISTAKE
            for one, is_small in zip(parameters, small, strict=True)
        ]
        return difference_effects(model, states, parameters, sizes, is_central=True)
    if not parameters:
        return [{} for _ in states]
    found, size = list[Effects](), max(1, MAX_BATCH_BODIES // DIRECTIONS // model.n)
    for some in _batches(states, size):
        parts = [_effects_by_jets(model, some, directions) for directions in _batches(parameters, DIRECTIONS)]
        found += [
            {name: np.concatenate([part[name][:, at] for part in parts]) for name in parts[0]}
            for at in range(len(some))
        ]
    return found


def _batches(every: Sequence[_Any], size: int) -> Iterator[Sequence[_Any]]:
    return (every[first : first + size] for first in range(0, len(every), size))


def _effects_by_jets(model: Model, states: Sequence[State], parameters: Sequence[Parameter]) -> Effects:
    """Effects at several states, (P, S, N) or (P, S, 1)."""
    directions = [_derivatives(model, states, one) for one in parameters]
    tree = Tree(jets(), *with_slopes(model, stack_states(states), directions))

    def slope(x: Jet) -> Array:
        shape = len(parameters), len(states), *x.value.shape[-2:]
        return np.broadcast_to(0.0 if x.slope is None else x.slope, shape)

    return {name: _sizes(name, x) for name, x in _arrays(tree, slope).items()}


def _derivatives(model: Model, states: Sequence[State], parameter: Parameter) -> dict[str, Array]:
    if parameter.kind not in STATE_KINDS:
        return derivative(model, states[0], parameter)
    each = [derivative(model, state, parameter) for state in states]
    return {name: np.stack([one[name] for one in each]) for name in each[0]}


def _arrays(tree: Tree, array_of: Callable[[Any], Array]) -> dict[str, Array]:
    """All quantities of a tree as arrays (..., N, 3), (..., 3), (...) and (..., nu, nu)."""
    found = {"mass_matrix": array_of(tree.mass_matrix())}
    for name, value in tree.quantities(tree.solve()).items():
        if isinstance(value, list):
            found[name] = np.stack([array_of(x)[..., 0] for x in value], axis=-2)
        else:
            array = array_of(value)[..., 0]
            found[name] = array if array.shape[-1] > 1 else array[..., 0]
    return found


def _sizes(name: str, change: Array) -> Array:
    """Norms (P, S, N) of vectors per body, (P, S, 1) of the rest: the largest entry of a matrix."""
    if name == "mass_matrix":
        return np.asarray(np.max(np.abs(change), axis=(2, 3))[..., None])
    rows = change.reshape(*change.shape[:2], -1, 3 if change.ndim > 2 else 1)
    return np.asarray(np.linalg.norm(rows, axis=-1))


def difference_effects(
    model: Model,
    states: Sequence[State],
    parameters: Sequence[Parameter],
    mistake: float | Sequence[float],
    is_central: bool = False,
) -> list[Effects]:
    """Return the effects of changes of parameters, per unit, by differences of the whole evaluation.

    Args:
        mistake: sizes of the changes, as fractions of each scale.
        is_central: whether differences are from the opposite mistake, or from none.

    Returns:
        Per state, as `effects_at_states`.

    """
    parts, other = list[Effects](), -1 if is_central else 0
    size = max(1, MAX_BATCH_BODIES // (2 * model.n * (1 if model.has_loops else len(states))))
    sized = list(zip(parameters, np.broadcast_to(mistake, len(parameters)), strict=True))
    for part in _batches(sized, size):
        pairs = [_perturbed(model, states, one, sign * size) for one, size in part for sign in (1, other)]
        scale = (1 - other) * np.array([size * one.scale for one, size in part])
        evaluated = (
            evaluate_to_first_order(model, states, pairs) if model.has_loops else evaluate_models(pairs)
        )
        changes = {name: values[::2] - values[1::2] for name, values in evaluated.items()}  # (P, S, ...)
        parts.append({name: _sizes(name, x) / scale[:, None, None] for name, x in changes.items()})
    return [
        {name: np.concatenate([part[name][:, at] for part in parts]) for name in parts[0]}
        for at in range(len(states))
    ]


def _perturbed(
    model: Model, states: Sequence[State], parameter: Parameter, size: float
) -> tuple[Model, State]:
    """A changed model with its states, stacked; the same minimal coordinates but for a changed one."""
    if parameter.kind in STATE_KINDS:
        return model, stack_states([perturb(model, state, parameter, size)[1] for state in states])
    changed, stacked = perturb_model(model, parameter, size), stack_states(states)
    return changed, complete_state(changed, stacked) if model.has_loops else stacked


def evaluate_models(cases: Sequence[tuple[Model, State]]) -> dict[str, Array]:
    """Evaluate all state quantities of many mechanisms without loops, in doubles.

    Args:
        cases: mechanisms of as many bodies, each with S states of `stack_states`.

    Returns:
        By quantity (cases, S, ...), with the names and units of `StateQuantities`.

    """
    joints = [(model.kind, model.body.tobytes()) for model, _ in cases]
    groups = [[i for i, one in enumerate(joints) if one == own] for own in dict.fromkeys(joints)]
    parts = [_evaluate_together([cases[i] for i in group]) for group in groups]
    order = np.argsort(np.concatenate(groups))
    return {name: np.concatenate([part[name] for part in parts])[order] for name in parts[0]}


def _evaluate_together(cases: Sequence[tuple[Model, State]]) -> dict[str, Array]:
    """Evaluate mechanisms with the same joints between the same bodies."""
    models, states = zip(*cases, strict=True)
    numbers = {
        name: np.array([getattr(one, name) for one in models])[:, None]
        for name in vars(models[0]).keys() - {"kind", "body", "spring_body"}
    }
    tree = Tree(floats(), replace(models[0], **numbers), stack_states(states))
    shape = len(cases), len(states[0].p)
    with np.errstate(divide="ignore", invalid="ignore"):  # a mechanism may move without inertia
        return _arrays(tree, lambda x: np.broadcast_to(x, (*shape, *x.shape[-2:])))


def evaluate_to_first_order(
    model: Model, states: Sequence[State], cases: Sequence[tuple[Model, State]]
) -> dict[str, Array]:
    """Evaluate all state quantities of changed models of one mechanism with loops.

    Args:
        cases: changed mechanisms, each with its S states of `stack_states`.

    Returns:
        As `evaluate_models`, without mass matrices.

    """
    changed, per_state = ChangedModels(model, [one for one, _ in cases]), []
    for at, base in enumerate(states):
        there = {name: np.array([getattr(own, name)[at] for _, own in cases]) for name in vars(base)}
        per_state.append(changed.solve(base, State(**there)))
    return {name: np.stack([one[name] for one in per_state], axis=1) for name in per_state[0]}
