"""Effects of mistakes in parameters on the state quantities at given states.

Of mechanisms without loops the effects are derivatives by jets; of mechanisms with loops they are differences
of first-order corrections.  Mistakes of a given size are evaluated whole, in doubles.

At a state with S x = b (N5) a changed model, or state, has S′ and b′ at its own positions and velocities of
the same minimal coordinates, and to first order

    x′ = x + S⁻¹ (b′ − S′ x).

All changed models stand side by side as one mechanism, so that b′ − S′ x is assembled once per state.  The
row of a rotor is multiplied by its inertia a, which leaves a J_φ q̈ − μ = −a φ̈₀: linear in a, from a = 0 on.
Loops that a mistake leaves open are not closed again: an engine evaluates the state that it is given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from plumbline.equations.arithmetic import floats, quantity_arrays
from plumbline.equations.jets import Jet, jets, with_slopes
from plumbline.equations.tree import Tree
from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import (
    angular_velocity,
    complete_state,
    joint_coordinates,
    maximal_coordinates,
    quaternion_rate,
    rotate_vectors,
    rotation_matrix,
    spring_vectors,
    stack_states,
)
from plumbline.model.loops import determinate_wrenches
from plumbline.truth.parameters import FRAME_KINDS, STATE_KINDS, Parameter, derivative, perturb, perturb_model
from reference_impl.direct import DirectSystem
from reference_impl.elements import ElementForces
from reference_impl.mechanism import side_by_side

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
        small = [one.kind in FRAME_KINDS and model.kinds[one.body].is_spherical for one in parameters]
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

    def slope(x: Jet) -> Any:
        return np.zeros(x.value.shape[-2:]) if x.slope is None else x.slope

    found = _arrays(tree, (len(parameters), len(states)), slope)
    return {name: _sizes(name, x) for name, x in found.items()}


def _derivatives(model: Model, states: Sequence[State], parameter: Parameter) -> dict[str, Array]:
    if parameter.kind not in STATE_KINDS:
        return derivative(model, states[0], parameter)
    each = [derivative(model, state, parameter) for state in states]
    return {name: np.stack([one[name] for one in each]) for name in each[0]}


def _arrays(tree: Tree, lead: tuple[int, ...], part: Callable[[Any], Any] = lambda x: x) -> dict[str, Array]:
    """All quantities of a tree, or a part of its numbers: (*lead, N, 3), (*lead, 3), (*lead) and matrices."""
    mass_matrix, found = part(tree.mass_matrix()), tree.quantities(tree.solve())
    parts = {name: [*map(part, x)] if isinstance(x, list) else part(x) for name, x in found.items()}
    matrix = np.broadcast_to(mass_matrix, (*lead, *mass_matrix.shape[-2:]))
    return {"mass_matrix": matrix} | quantity_arrays(parts, lead)


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
    with np.errstate(divide="ignore", invalid="ignore"):  # a mechanism may move without inertia
        return _arrays(tree, (len(cases), len(states[0].p)))


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


NO_ROTOR = 1e-200  # kg m² or kg, of a coordinate without a rotor: its row stays


class _Base:
    """S x = b at one state: S⁻¹ of the rows that do not depend on others, and x."""

    def __init__(self, model: Model, state: State, has_elements: bool) -> None:
        self.coordinates = joint_coordinates(model, state)[2]
        at = maximal_coordinates(state)
        plain = DirectSystem(model).solve(*at, x=self.coordinates)
        system = DirectSystem(_with_rotor_rows(model) if has_elements else model)
        S, b = system.assemble(*at, x=self.coordinates)
        c = len(system.joint) - system.rotor_count  # rows of constraints
        used = np.ones(len(b), bool)
        if plain.kept is not None:
            used[7 * model.n :][:c] = plain.kept[:c]
        factor = np.ones(len(b))
        rotors = slice(7 * model.n + c, len(b) - model.n)
        factor[rotors] = -1 / np.diagonal(S)[rotors]
        self.inverse = np.zeros(S.shape)
        self.inverse[np.ix_(used, used)] = np.linalg.inv((S * factor[:, None])[np.ix_(used, used)])
        self.unknowns = self.inverse @ (factor * b)


class ChangedModels:
    """Many changed models of one mechanism side by side, and their solutions at any of its states."""

    def __init__(self, model: Model, changed: Sequence[Model]) -> None:
        """Join the models.

        Args:
            changed: K models with its joints.

        """
        self.model, self.changed = model, changed
        weighed = [replace(m, force=m.force + m.mass[:, None] * m.gravity) for m in changed]
        self.has_elements = any(one.has_joint_elements for one in (model, *changed))
        parts = [_with_rotor_rows(one) for one in weighed] if self.has_elements else weighed
        self.system = DirectSystem(side_by_side(parts))

    def solve(self, base: State, states: State) -> dict[str, Array]:
        """Return the state quantities to first order.

        Args:
            states: of the K models, (K, N, ·) arrays: the same, or nearly the same, minimal coordinates.

        Returns:
            By name of the quantity (K, ...), in its unit, without a mass matrix; of wrenches in loops the
            determinate parts.

        """
        solved, count, system = _Base(self.model, base, self.has_elements), len(self.changed), self.system
        sizes = np.array([3 * self.model.n, 4 * self.model.n, 0, 0, self.model.n])
        sizes[3] = system.rotor_count // count
        sizes[2] = len(solved.unknowns) - sizes.sum()
        ends = np.cumsum(sizes)[:-1]
        own = np.split(np.arange(count * sizes.sum()), count * ends)
        # (K, m) in the printed order
        place = np.concatenate([part.reshape(count, -1) for part in own], axis=1)
        unknowns, rotors = np.empty(place.size), place[:, ends[2] : ends[3]]
        unknowns[place] = solved.unknowns
        factor = np.ones(place.size)
        if system.elements is not None:
            factor[rotors] = system.elements.armature[system.elements.rotors].reshape(count, -1)

        def correction(lack: Array) -> Array:
            found = np.empty_like(lack)
            found[place] = (factor * lack)[place] @ solved.inverse.T
            return found

        r, p, v, omega = (getattr(states, name).reshape(-1, size) for name, size in _SIZES)
        at = r, p, v, quaternion_rate(p, omega)
        coordinates = np.tile(solved.coordinates, (count, 1))
        found, elements = system.corrected(*at, x=coordinates, unknowns=unknowns, correction=correction)
        assert found.joint_moment is not None
        per_copy = {
            "acceleration": found.acceleration,
            "angular_acceleration": angular_velocity(p, found.pddot),
            "joint_reaction": found.joint_reaction,
            "joint_moment": found.joint_moment,
        }
        values = {name: value.reshape(count, -1, 3) for name, value in per_copy.items()}
        names = "joint_reaction", "joint_moment"
        wrenches = determinate_wrenches(self.model, base, *(values[name] for name in names))
        values |= zip(names, wrenches, strict=True)
        return values | self._energies(r, p, v, omega, elements)

    def _energies(
        self, r: Array, p: Array, v: Array, omega: Array, elements: ElementForces | None
    ) -> dict[str, Array]:
        """Energies (K,) and angular momenta (K, 3)."""
        forest, owner, count = self.system.chain, self.system.elements, len(self.changed)
        momentum, spin = forest.mass[:, None] * v, rotate_vectors(forest.inertia, omega)
        kinetic = np.sum(momentum * v + spin * omega, axis=1) / 2
        turned = rotate_vectors(rotation_matrix(p), spin)
        gravity = np.repeat([one.gravity for one in self.changed], self.model.n, axis=0)
        potential = -forest.mass * np.sum(gravity * r, axis=1)
        found = {
            "kinetic_energy": kinetic.reshape(count, -1).sum(axis=1),
            "potential_energy": potential.reshape(count, -1).sum(axis=1),
            "angular_momentum": (np.cross(r, momentum) + turned).reshape(count, -1, 3).sum(axis=1),
        }
        if owner is not None and elements is not None:
            copy = owner.joint // len(self.model.kind)
            length = np.linalg.norm(spring_vectors(forest, r, p), axis=-1) - forest.spring_length
            springs = (forest.spring_stiffness * length**2 / 2).reshape(count, -1).sum(axis=1)
            found["kinetic_energy"] += np.bincount(copy, owner.armature * elements.rate**2 / 2, count)
            found["potential_energy"] += np.bincount(copy, owner.stiffness * elements.stretch**2 / 2, count)
            found["potential_energy"] += springs
        return found


_SIZES = (("r", 3), ("p", 4), ("v", 3), ("omega", 3))


def _with_rotor_rows(model: Model) -> Model:
    """A model whose coordinates all have rotors, if only of a negligible inertia."""
    return replace(model, armature=np.where(model.armature == 0, NO_ROTOR, model.armature))
