"""The notes' equations for any chain of rods and ball joints, as an engine (state: `reference_common`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np

from adapters.reference_common import DOP853, NotesAdapter, notes_state, state_quantities, trajectory
from plumbline.model.datatypes import Array, Integrator, Model, State, StateQuantities, Trajectory
from plumbline.model.kinematics import joint_coordinates
from reference_impl.direct import DirectSystem, Solution
from reference_impl.fast.collocation import integrate_collocation
from reference_impl.fast.tree_elimination import eliminated_system, fastest_acceleration
from reference_impl.integrate import integrate_dop853


class Reference(NotesAdapter):
    """The notes' own system S x = b (N5) and first-order form (N6), raw."""

    name: ClassVar[str] = "reference"
    title: ClassVar[str] = "Reference (the notes)"
    integrators: ClassVar[tuple[Integrator, ...]] = (
        DOP853,
        Integrator(
            "collocation",
            "tolerance",
            32,
            is_symmetric=True,
            min_rtol=1e-14,
            note="16-point Gauss–Legendre collocation by Picard sweeps on the structured form of the same "
            "equations, no stabilisation; resolution is rtol of the dense output",
        ),
    )

    builds_trees = builds_elements = moves_loops = True
    options = ("dense factors", "O(N) form")

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        system = DirectSystem(model)
        solve: Callable[..., Solution] = system.solve
        if self.option:
            dense = self.option == "dense factors"
            solve = system.solve_with_dense_factors if dense else eliminated_system([model]).solve
        with self._named_failures():
            return [self._quantities(system, state, solve) for state in states]

    @staticmethod
    def _quantities(system: DirectSystem, state: State, solve: Callable[..., Solution]) -> StateQuantities:
        at, elements = notes_state(state), system.elements
        S, _ = system.assemble(*at)
        joint_x = joint_coordinates(system.chain, state)[2]
        x = solve(*at, x=joint_x) if elements else solve(*at)
        energy = elements.evaluate(*at, x=joint_x).potential if elements else 0.0
        solved = x.acceleration, x.pddot, x.joint_reaction, S, x.joint_moment, system.rotor_count
        return state_quantities(system.chain, state, *solved, spring_energy=energy)

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        start, x = notes_state(state), joint_coordinates(model, state)[2]
        with self._named_failures():
            if integrator.name == "collocation":
                system = eliminated_system([model], x)
                return trajectory(integrate_collocation(system, *start, times, resolution))
            by = fastest_acceleration(model)
            return trajectory(integrate_dop853(model, *start, times, resolution, by, x))

    def _simulate_round_trip(
        self, model: Model, state: State, end: float, integrator: Integrator, resolution: float
    ) -> Trajectory:
        times = np.array([0.0, end, 2 * end])
        with self._named_failures():
            system = eliminated_system([model], joint_coordinates(model, state)[2])
            there = integrate_collocation(system, *notes_state(state), times[:2], resolution)
            turned = there.r[-1], there.p[-1], -there.v[-1], -there.pdot[-1]
            system = eliminated_system([model], there.x[-1])
            back = integrate_collocation(system, *turned, times[:2], resolution)
        r, p, v, pdot = (
            np.vstack([getattr(there, name), getattr(back, name)[1:]]) for name in ("r", "p", "v", "pdot")
        )
        return Trajectory(times, r, p, v, pdot, there.steps + back.steps)
