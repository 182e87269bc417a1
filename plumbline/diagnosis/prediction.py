"""What an engine with a mistake would return: many mistakes and states in one batch, in doubles.

In joint coordinates a mechanism with loops is a tree whose ends are held together, at the coordinates of the
state; an engine in maximal coordinates evaluates the bodies where they are, loops closed or not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plumbline.equations.arithmetic import floats, quantity_arrays
from plumbline.equations.responses import EndRows, Responses
from plumbline.equations.tree import SUMS, Tree
from plumbline.model.datatypes import Array, Model, State, StateQuantities, StepRun
from plumbline.model.invariants import angular_momentum, kinetic_energy, potential_energy
from plumbline.model.kinematics import (
    angular_velocity,
    complete_state,
    elastic_energy,
    joint_coordinates,
    kinetic_energy_of_rotors,
    maximal_coordinates,
    rotate_vectors,
    stack_states,
)
from plumbline.model.loops import cut_open, determinate_projectors, loop_gaps, wrench_length
from plumbline.truth.ground_truth import StateTruth
from plumbline.truth.rounding_bound import TINY, RoundingBound
from reference_impl.direct import DirectSystem
from reference_impl.joints import constraint_rows
from reference_impl.singular_system import SingularSystem

VECTORS = ("acceleration", "angular_acceleration", "joint_reaction", "joint_moment")
WRENCHES = VECTORS[2:]
QUANTITIES = (*VECTORS, *SUMS)
CONSTANT_FIELDS = ("kind", "body", "spring_body")
CLOSED = 1e-9  # m, rad and their rates: a larger gap is an open loop
MAX_BATCH_BODIES = 12_000  # of one batch
Answers = dict[str, Array]  # by quantity (S, N, 3), (S, 3) or (S,), or with an axis of lanes before


def values_of(answers: Sequence[StateQuantities], quantity: str) -> Array:
    """Return a quantity (S, ...) of S answers."""
    return np.asarray([getattr(answer, quantity) for answer in answers], float)


def tolerances(
    bounds: Sequence[RoundingBound], quantity: str, answers: Sequence[StateQuantities] = ()
) -> Array:
    """Return what rounding explains at S states, (S,) or (S, N), with the uncertainty of engines' limits."""
    found = np.array([np.asarray(bound.tolerance(quantity)) for bound in bounds])
    limits = np.array([(answer.limit_error or {}).get(quantity, 0.0) for answer in answers] or 0.0)
    return np.asarray((found.T + limits).T)


def per_entry(bound: Array, values: Array) -> Array:
    """Return bounds (S,) or (S, N) that broadcast against values; of a bound of 0 nothing counts."""
    bound = np.where(bound > 0, bound, np.inf)
    return bound[..., None] if values.ndim > bound.ndim else bound


def error_ratio(difference: Array, bound: Array) -> float:
    """Return the largest ‖difference‖/bound, of (S,) scalars or (S, ..., 3) vectors; NaN where any is."""
    size = np.abs(difference) if difference.ndim == 1 else np.linalg.norm(difference, axis=-1)
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.max(size / np.maximum(bound, TINY), initial=0.0))


def error_ratios(reported: Sequence[StateQuantities], truth: StateTruth, quantity: str) -> Array:
    """Return the errors (S,) of a quantity in bounds, of the worst body; 0 where there is none."""
    if any(getattr(answer, quantity) is None for answer in (*reported, *truth.quantities)):
        return np.zeros(len(reported))
    off = values_of(reported, quantity) - values_of(truth.quantities, quantity)
    bound = tolerances(truth.bounds, quantity, reported)
    found = [error_ratio(off[i : i + 1], bound[i : i + 1]) for i in range(len(off))]
    return np.where(np.isnan(found), np.inf, found)


@dataclass(frozen=True)
class Case:
    """What an engine evaluates in place of S states: fields of the model may be others at each state.

    Or what it takes steps of, by a formula.
    """

    model: Model
    state: State  # arrays (S, ...)
    method: Any = None  # a formula of the declared one's class
    read: Callable[[StepRun], StepRun] | None = None  # samples as an engine may hold them → right ones

    def right_samples(self, run: StepRun) -> StepRun:
        """Return a run whose samples are what they should be."""
        return self.read(run) if self.read else run


@dataclass(frozen=True)
class View:
    """How an engine takes a state, and which quantities are explained."""

    quantities: tuple[str, ...] = QUANTITIES
    are_bodies_kept: bool = False  # where the states have them, not where coordinates put them
    end_rows: EndRows = "accelerations"  # of loops that are not closed there


class Predictor:
    """Predicts quantities at S states of a mechanism."""

    def __init__(self, model: Model, states: Sequence[State], view: View) -> None:
        """Prepare for the states."""
        self.case, self.view, self.count = Case(model, stack_states(states)), view, len(states)
        self.states = states
        self.projectors = projectors_at(model, states)

    @cached_property
    def right(self) -> Answers:
        """The quantities without a mistake."""
        return {name: x[0] for name, x in self._evaluate([self.case]).items()}

    def predict(self, cases: Sequence[Case]) -> Answers:
        """Predict quantities of many cases.

        Returns:
            By name (lanes, S, ...); not numbers where a case is no mechanism.

        """
        size = max(1, MAX_BATCH_BODIES // (self.count * self.case.model.n))
        parts = [self._evaluate(cases[i : i + size]) for i in range(0, len(cases), size)]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _evaluate(self, cases: Sequence[Case]) -> Answers:
        try:
            with np.errstate(all="ignore"):
                if self.view.are_bodies_kept:
                    found = self.of_bodies([one for case in cases for one in self.each_state(case)])
                else:
                    found = self._of_cuts(cases) if self.case.model.has_loops else self._of_trees(cases)
                return {name: x.reshape(len(cases), self.count, *x.shape[1:]) for name, x in found.items()}
        except (np.linalg.LinAlgError, SingularSystem, ValueError, ZeroDivisionError):
            if len(cases) == 1:
                return {name: np.full((1, *x.shape), np.nan) for name, x in self.right.items()}
            half = len(cases) // 2  # the others of the batch may be mechanisms
            first, second = self._evaluate(cases[:half]), self._evaluate(cases[half:])
            return {name: np.concatenate([x, second[name]]) for name, x in first.items()}

    def _of_trees(self, cases: Sequence[Case]) -> Answers:
        tree = Tree(floats(), *self._stacked(cases))
        return quantity_arrays(tree.quantities(tree.solve()), (len(tree.state.p),))

    def _stacked(self, cases: Sequence[Case]) -> tuple[Model, State]:
        """One model and state of arrays (lanes times S, ...); what is the same in all has no such axis."""
        like, changes = self.case.model, dict[str, Any]()
        for name, value in vars(like).items():
            given = [getattr(case.model, name) for case in cases]
            if name not in CONSTANT_FIELDS and any(one is not value for one in given):
                changes[name] = np.concatenate(
                    [np.broadcast_to(x, (self.count, *value.shape)) for x in given]
                )
        names = vars(self.case.state)
        fields = {name: np.concatenate([getattr(case.state, name) for case in cases]) for name in names}
        return replace(like, **changes), State(**fields)

    def each_state(self, case: Case) -> Iterator[tuple[Model, State]]:
        """Split a case into the models and states that it is made of."""
        like = self.case.model
        for s, state in enumerate(single_states(case.state)):
            changes = {
                name: getattr(case.model, name)[s]
                for name, value in vars(like).items()
                if name not in CONSTANT_FIELDS and getattr(case.model, name).ndim > value.ndim
            }
            yield replace(case.model, **changes) if changes else case.model, state

    def cut(self, model: Model, state: State) -> tuple[Model, State]:
        """Cut loops open: model and state (B, ...), of which fields of the model may lack the axis.

        Args:
            model: the mechanism, perhaps with other numbers.
            state: of which the minimal coordinates are used.

        """
        cut = cut_open(self.case.model).with_numbers(model)
        return cut.model, cut.state(complete_state(model, state))

    def _of_cuts(self, cases: Sequence[Case]) -> Answers:
        """Quantities in joint coordinates, of loops cut open."""
        model, state = self.cut(*self._stacked(cases))
        cut = cut_open(self.case.model)
        found = Responses(model, state, cut.ends, cut.row_scale, self.view.end_rows)
        projectors = [self.projectors[i % self.count] for i in range(len(state.p))]
        sums = quantity_arrays(found.tree.sums(), (len(state.p),))
        return self.vectors(found.solution, found.tree, cut.place, projectors) | sums

    def vectors(
        self, solution: Array, tree: Tree, joints: NDArray[np.intp], projectors: Sequence[Array | None]
    ) -> Answers:
        """Read the mechanism's vectors from a solution (S, N, 4, 3) of a tree, with where its joints are."""
        found = dict(zip(VECTORS, np.moveaxis(solution, 2, 0), strict=True))
        turns = np.stack([np.broadcast_to(A, (len(solution), 3, 3)) for A in tree.A], 1)
        found["angular_acceleration"] = np.matvec(turns.mT, found["angular_acceleration"])
        for name, x in found.items():
            found[name] = x[:, joints if name in WRENCHES else joints[: self.case.model.n]]
        return determinate(self.case.model, found, projectors)

    def of_bodies(self, seen: Sequence[tuple[Model, State]], missing_gamma: Sequence[int] = ()) -> Answers:
        """Predict quantities of bodies where they are, in maximal coordinates; (lanes times S, ...)."""
        each = [maximal_quantities(*one, missing_gamma) for one in seen]
        answers = {name: np.stack([one[name] for one in each]) for name in QUANTITIES}
        projectors = [self.projectors[i % self.count] for i in range(len(each))]
        return determinate(self.case.model, answers, projectors)


def is_closed(model: Model, state: State) -> bool:
    """Whether loops are closed at a state, rates included."""
    with np.errstate(all="ignore"):  # where points of rods coincide
        gap = max(map(np.max, loop_gaps(model, state)))
    return bool(gap <= CLOSED * max(1.0, float(np.max(np.abs(state.v)))))


def single_states(state: State) -> list[State]:
    """Split arrays (S, ...) into states."""
    return [state[s] for s in range(len(state.p))]


def projectors_at(model: Model, states: Sequence[State]) -> list[Array | None]:
    """Return what rows that depend on others leave of the joints' wrenches; None where it is everything."""
    return [determinate_projectors(model, state) if model.has_loops else None for state in states]


def determinate(model: Model, answers: Answers, projectors: Sequence[Array | None]) -> Answers:
    """Keep of the joints' wrenches what rows that depend on others leave determinate."""
    if all(one is None for one in projectors):
        return answers
    length = wrench_length(model)
    wrench = np.concatenate([answers["joint_reaction"], answers["joint_moment"] / length], axis=-1)
    for i, projector in enumerate(projectors):
        if projector is not None:
            wrench[i] = rotate_vectors(projector, wrench[i])
    return answers | {"joint_reaction": wrench[..., :3], "joint_moment": wrench[..., 3:] * length}


def maximal_quantities(model: Model, state: State, missing_gamma: Sequence[int]) -> Answers:
    """Evaluate quantities in maximal coordinates, by the notes' rows.

    Args:
        missing_gamma: joints whose rows have no γ.

    """
    at = maximal_coordinates(state)
    system, rows = DirectSystem(model), constraint_rows(model, *at)
    change = np.zeros(len(system.joint))
    change[: len(rows.gamma)] = np.where(np.isin(rows.joint, missing_gamma), -rows.gamma, 0.0)
    found = system.solve(*at, gamma_defect=change, x=joint_coordinates(model, state)[2])
    assert found.joint_moment is not None
    return {
        "acceleration": found.acceleration,
        "angular_acceleration": angular_velocity(state.p, found.pddot),
        "joint_reaction": found.joint_reaction,
        "joint_moment": found.joint_moment,
        "kinetic_energy": kinetic_energy(model, state.v, state.omega)
        + kinetic_energy_of_rotors(model, state),
        "potential_energy": potential_energy(model, state.r) + elastic_energy(model, state),
        "angular_momentum": angular_momentum(model, state.r, state.p, state.v, state.omega),
    }
