"""The notes' equations exactly as printed, as an engine: the single and the double pendulum on rods.

State: `reference_common`.  The reaction is the force of the rod on the body, −2 λ d with d from where the rod
hangs to the body's attachment (E5).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from adapters.reference_common import DOP853, NotesAdapter, notes_state, state_quantities, trajectory
from plumbline.model.datatypes import (
    Array,
    Integrator,
    Model,
    State,
    StateQuantities,
    Trajectory,
    Unsupported,
)
from plumbline.model.kinematics import joint_vectors
from reference_impl.integrate import integrate_dop853, notes_acceleration
from reference_impl.notes import assemble_system, solve_system


class ReferencePrinted(NotesAdapter):
    """S1–S5, D1–D6 and S x = b (N5) as formulation.md prints them, and the first-order form (N6)."""

    name: ClassVar[str] = "reference-printed"
    title: ClassVar[str] = "Reference (the notes as printed)"
    integrators: ClassVar[tuple[Integrator, ...]] = (DOP853,)
    unsupported: ClassVar[Mapping[str, str]] = {
        "balls": "the notes print a rod at every joint; a ball joint is their limit of length 0 (E1)",
        "chains": "the notes print the equations of one and of two bodies",
    }

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        self._check_printed(model)
        with self._named_failures():
            return [self._quantities(model, state) for state in states]

    def _quantities(self, model: Model, state: State) -> StateQuantities:
        n, at = model.n, notes_state(state)
        x = solve_system(model, *at)
        acceleration, pddot, multiplier = np.split(x, [3 * n, 7 * n, 8 * n])[:3]
        reaction = -2 * multiplier[:, None] * joint_vectors(model, state.r, state.p)
        S, _ = assemble_system(model, *at)
        return state_quantities(model, state, acceleration.reshape(n, 3), pddot.reshape(n, 4), reaction, S)

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        self._check_printed(model)
        with self._named_failures():
            by = notes_acceleration(model)
            return trajectory(integrate_dop853(model, *notes_state(state), times, resolution, by))

    def _check_printed(self, model: Model) -> None:
        if not np.all(model.rods):
            raise Unsupported(self.unsupported["balls"], "balls")
        if model.n > 2:
            raise Unsupported(f"{self.unsupported['chains']}, not of {model.n}", "chains")
