"""First-order effects of mistakes on the state quantities of any mechanism, loops included.

At a state with S x = b (N5) a changed model, or state, has S′ and b′ at its own positions and velocities of
the same minimal coordinates, and to first order

    x′ = x + S⁻¹ (b′ − S′ x).

All changed models stand side by side as one mechanism, so that b′ − S′ x is assembled once per state.  The
row of a rotor is multiplied by its inertia a, which leaves a J_φ q̈ − μ = −a φ̈₀: linear in a, from a = 0 on.
Loops that a mistake leaves open are not closed again: an engine evaluates the state that it is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import (
    angular_velocity,
    joint_coordinates,
    quaternion_rate,
    rotate_vectors,
    rotation_matrix,
    spring_vectors,
)
from plumbline.model.loops import determinate_projectors, wrench_length
from reference_impl.direct import DirectSystem
from reference_impl.elements import ElementForces
from reference_impl.mechanism import side_by_side

NO_ROTOR = 1e-200  # kg m² or kg, of a coordinate without a rotor: its row stays


class _Base:
    """S x = b at one state: S⁻¹ of the rows that do not depend on others, and x."""

    def __init__(self, model: Model, state: State, has_elements: bool) -> None:
        self.coordinates = joint_coordinates(model, state)[2]
        at = state.r, state.p, state.v, quaternion_rate(state.p, state.omega)
        plain = DirectSystem(model).solve(*at, x=self.coordinates)
        system = DirectSystem(_with_rotor_rows(model) if has_elements else model)
        S, b = system.assemble(*at, self.coordinates)
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
        place = np.concatenate(
            [part.reshape(count, -1) for part in own], axis=1
        )  # (K, m) in the printed order
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
        found, elements = system.corrected(*at, coordinates, unknowns, correction)
        assert found.joint_moment is not None
        per_copy = {
            "acceleration": found.acceleration,
            "angular_acceleration": angular_velocity(p, found.pddot),
            "joint_reaction": found.joint_reaction,
            "joint_moment": found.joint_moment,
        }
        values = {name: value.reshape(count, -1, 3) for name, value in per_copy.items()}
        projectors = determinate_projectors(self.model, base) if self.model.has_loops else None
        if projectors is not None:
            length = wrench_length(self.model)
            wrench = np.concatenate([values["joint_reaction"], values["joint_moment"] / length], axis=-1)
            wrench = rotate_vectors(projectors, wrench)
            values |= {"joint_reaction": wrench[..., :3], "joint_moment": wrench[..., 3:] * length}
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
