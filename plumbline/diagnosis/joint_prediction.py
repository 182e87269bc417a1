"""What an engine would return that sees another mechanism, another state, or other rows of the joints.

In joint coordinates a mechanism with loops is a tree whose ends are held together, at the coordinates of the
state; an engine in maximal coordinates evaluates the bodies where they are, loops closed or not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from plumbline.equations.responses import EndRows, Responses
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
from reference_impl.direct import DirectSystem
from reference_impl.joints import constraint_rows

# What joint k holds, as a defect changes it: the directions E (6, c), and the relative acceleration (6,) that
# velocities cause.
RowChange = Callable[[int, Array, Array], tuple[Array, Array]]
RELEASED = 1e-9  # of a direction: what a change of rows leaves of it
MAX_CONDITION = 1e14  # of the inertia that released directions have
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
            end_rows: of `Responses`, of the loops.

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
    solution = tree_solution(cut.model, there, ends, rows, end_rows, cut.row_scale)
    values = _of_tree(cut.model, there, solution)
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


def tree_solution(
    model: Model,
    state: State,
    ends: Sequence[tuple[int, int]] = (),
    rows: RowChange | None = None,
    end_rows: EndRows = "accelerations",
    row_scale: Array | None = None,
) -> Array:
    """Solve the equations of a tree in doubles, with changed rows of its joints.

    Args:
        ends: pairs of bodies that are joined besides, parts of one body.
        rows: changes what joints hold.
        row_scale: factors that make the rows of the ends comparable.

    Returns:
        (4, N, 3): r̈ [m/s²], ω̇ [rad/s²], and force [N] and moment [N m] of the joints; world axes.

    """
    scale = None if row_scale is None else row_scale[: 6 * len(ends)]
    found = Responses(model, [state], ends, scale, end_rows)
    solution = found.solution[0]  # (N, 4, 3)
    if rows is not None:
        true = [(held[0], -own) for held, own in zip(found.held, found.velocity_terms()[0], strict=True)]
        changed = [rows(k, *own) for k, own in enumerate(true)]
        jumps = [-held.T @ (bend - old) for (held, old), (_, bend) in zip(true, changed, strict=True)]
        responses = found.to_joints()[0]
        solution = solution + responses @ np.concatenate(jumps)
        solution = _released(solution, responses, found.indeterminate[0], true, changed)
    return np.asarray(np.moveaxis(solution, 0, 1))


def _released(
    solution: Array,
    responses: Array,
    indeterminate: Array,
    true: Sequence[tuple[Array, Array]],
    changed: Sequence[tuple[Array, Array]],
) -> Array:
    """Let joints move where they no longer hold: by as much as makes their wrenches there 0."""
    along = np.zeros((sum(held.shape[1] for held, _ in true), 0))  # directions that are released
    wrench = np.zeros((0, 6 * len(true)))
    first = 0
    for k, ((held, _), (left, _)) in enumerate(zip(true, changed, strict=True)):
        last = first + held.shape[1]
        if left.shape[1] < held.shape[1]:
            free = np.linalg.svd(held.T @ left)[0][:, left.shape[1] :]
            own, rows = np.zeros((len(along), free.shape[1])), np.zeros((free.shape[1], 6 * len(true)))
            own[first:last], rows[:, 6 * k : 6 * k + 6] = free, (held @ free).T
            along, wrench = np.concatenate([along, own], 1), np.concatenate([wrench, rows])
        first = last
    if not len(wrench):
        return solution
    lost = wrench @ indeterminate  # released where others hold as well, a joint does not move
    _, sizes, directions = np.linalg.svd(lost.T)
    moving = directions[int(np.sum(sizes > RELEASED)) :].T
    of_joints = responses[:, 2:].reshape(len(indeterminate), -1) @ along
    now = wrench @ solution[:, 2:].ravel()
    inertia = moving.T @ wrench @ of_joints @ moving
    if inertia.size and np.linalg.cond(inertia) > MAX_CONDITION:
        raise np.linalg.LinAlgError("a body can turn without inertia")
    amounts = np.linalg.solve(inertia, -moving.T @ now)
    solution = solution + responses @ (along @ moving @ amounts)
    balance = indeterminate @ np.linalg.lstsq(lost, -(wrench @ solution[:, 2:].ravel()), RELEASED)[0]
    solution[:, 2:] += balance.reshape(-1, 2, 3)
    return solution
