"""What an engine would return that sees another mechanism, another state, or other rows of the joints.

In joint coordinates a mechanism with loops is a tree whose ends are held together, at the coordinates of the
state; an engine in maximal coordinates evaluates the bodies where they are, loops closed or not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plumbline.model.datatypes import Array, Model, State
from plumbline.model.invariants import kinetic_energy, potential_energy
from plumbline.model.kinematics import (
    angular_velocity,
    complete_state,
    elastic_energy,
    joint_coordinates,
    kinetic_energy_of_rotors,
    quaternion_rate,
    rotate_vectors,
    rotation_matrix,
)
from plumbline.model.loops import cut_open, determinate_projectors, wrench_length
from plumbline.truth.rounding_bound_tree import EndRows, RowChange, tree_solution
from reference_impl.direct import DirectSystem
from reference_impl.joints import constraint_rows

VECTORS = ("acceleration", "angular_acceleration", "joint_reaction", "joint_moment")


@dataclass(frozen=True, eq=False)
class Seen:
    """What an engine evaluates."""

    model: Model
    state: State
    rows: RowChange | None = None  # of its joints
    open_loop: int | None = None  # a loop that it does not close
    end_rows: EndRows | None = None  # of loops; None for the predictor's
    missing_gamma: int | None = None  # a joint whose rows of bodies it evaluates without γ
    is_elsewhere: bool = False  # whether its state closes the loops in another pose


class Predictor:
    """Predicts quantities at states of a mechanism."""

    def __init__(
        self, model: Model, states: Sequence[State], are_bodies_kept: bool, end_rows: EndRows
    ) -> None:
        """Prepare for the states.

        Args:
            are_bodies_kept: whether bodies are where the states have them, not where coordinates put them.
            end_rows: of `tree_solution`, of the loops.

        """
        self.model, self.states, self.are_bodies_kept = model, states, are_bodies_kept
        self.end_rows: EndRows = end_rows
        self.projectors = [determinate_projectors(model, s) if model.has_loops else None for s in states]

    def predict(self, seen: Sequence[Seen], names: Sequence[str]) -> Array:
        """Predict quantities.

        Args:
            seen: what the engine evaluates in place of each state.

        Returns:
            Quantity by quantity, and of each state by state.

        """
        each = [self._values(one, i) for i, one in enumerate(seen)]
        return np.concatenate([np.ravel(values[name]) for name in names for values in each])

    def _values(self, seen: Seen, place: int) -> dict[str, Array]:
        if not self.model.has_loops:
            at = complete_state(seen.model, seen.state)
            return _of_tree(seen.model, at, tree_solution(seen.model, at, rows=seen.rows))
        values = _of_bodies(seen) if self.are_bodies_kept else _of_cut(seen, seen.end_rows or self.end_rows)
        projectors, length = self.projectors[place], wrench_length(self.model)
        if seen.is_elsewhere:
            projectors = determinate_projectors(seen.model, seen.state)
        if projectors is not None:
            wrench = np.concatenate([values["joint_reaction"], values["joint_moment"] / length], axis=1)
            wrench = rotate_vectors(projectors, wrench)
            values |= {"joint_reaction": wrench[:, :3], "joint_moment": wrench[:, 3:] * length}
        return values


def _of_tree(model: Model, at: State, solution: Array) -> dict[str, Array]:
    values: dict[str, Array] = dict(zip(VECTORS, solution, strict=True))
    values["angular_acceleration"] = np.matvec(rotation_matrix(at.p).mT, values["angular_acceleration"])
    return values | _energies(model, at)


def _energies(model: Model, at: State) -> dict[str, Array]:
    kinetic = kinetic_energy(model, at.v, at.omega) + kinetic_energy_of_rotors(model, at)
    potential = potential_energy(model, at.r) + elastic_energy(model, at)
    return {"kinetic_energy": np.asarray(kinetic), "potential_energy": np.asarray(potential)}


def _of_cut(seen: Seen, end_rows: EndRows) -> dict[str, Array]:
    """Quantities in joint coordinates."""
    cut, joints, change = cut_open(seen.model), np.argsort(cut_open(seen.model).place), seen.rows
    there = cut.state(complete_state(seen.model, seen.state))
    rows: RowChange | None = None
    if change is not None:
        rows = lambda k, held, bend: change(int(joints[k]), held, bend)  # noqa: E731
    ends = [pair for i, pair in enumerate(cut.ends) if i != seen.open_loop]
    values = _of_tree(cut.model, there, tree_solution(cut.model, there, ends, rows, end_rows))
    for name in VECTORS:
        values[name] = values[name][cut.place if name.startswith("joint") else cut.place[: seen.model.n]]
    return values


def _of_bodies(seen: Seen) -> dict[str, Array]:
    """Quantities in maximal coordinates, by the notes' rows."""
    model, state = seen.model, seen.state
    at = state.r, state.p, state.v, quaternion_rate(state.p, state.omega)
    system, rows = DirectSystem(model), constraint_rows(model, *at)
    change = np.zeros(len(system.joint))
    change[: len(rows.gamma)] = np.where(rows.joint == seen.missing_gamma, -rows.gamma, 0.0)
    found = system.solve(*at, change, joint_coordinates(model, state)[2])
    assert found.joint_moment is not None
    values = {
        "acceleration": found.acceleration,
        "angular_acceleration": angular_velocity(state.p, found.pddot),
        "joint_reaction": found.joint_reaction,
        "joint_moment": found.joint_moment,
    }
    return values | _energies(model, state)
