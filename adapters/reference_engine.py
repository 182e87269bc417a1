"""The notes as an engine among the others: `reference_impl` behind the contract.

State: ṗ = ½ L(p)ᵀ ω′ on the way in; ω̇′ = 2 L(p) p̈ on the way out (L̇ ṗ = 0, N9).
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from plumbline.engines.metamorphic_hooks import MetamorphicHooks
from plumbline.model.datatypes import (
    Array,
    EngineFailure,
    Integrator,
    Model,
    State,
    StateQuantities,
    Trajectory,
)
from plumbline.model.kinematics import velocity_jacobian
from reference_impl import collocation
from reference_impl.direct import DirectSystem, Solution
from reference_impl.errors import SingularSystem
from reference_impl.euler_parameters import A, L, euler_parameter_rate
from reference_impl.integrate import IntegrationResult, integrate_dop853
from reference_impl.structured import StructuredSystem


class Reference(MetamorphicHooks):
    """The notes' own system S x = b (N5) and first-order form (N6), raw."""

    name: ClassVar[str] = "reference"
    title: ClassVar[str] = "Reference (the notes)"
    package: ClassVar[str] = "plumbline"
    reproduction_template = "reference"
    integrators: ClassVar[tuple[Integrator, ...]] = (
        Integrator(
            "dop853",
            "tolerance",
            8,
            min_rtol=1e-13,
            note="scipy's DOP853 on y = (r, p, ṙ, ṗ), no stabilisation; resolution is rtol, atol is rtol "
            "times the natural size of each part of y",
        ),
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

    options = ("dense factors", "O(N) form")
    welding_unsupported_reason = "the notes know ball joints and rods, no joint that holds two bodies rigidly"

    def version(self) -> str:
        """Version of this checkout."""
        project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
        return str(project["project"]["version"])

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        system = DirectSystem(model)
        solve: Callable[..., Solution] = system.solve
        if self.option:
            dense = self.option == "dense factors"
            solve = system.solve_with_dense_factors if dense else StructuredSystem([model]).solve
        return [state_quantities(system, model, state, solve) for state in states]

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        pdot = euler_parameter_rate(state.p, state.omega)
        try:
            if integrator.name == "collocation":
                start = state.r, state.p, state.v, pdot
                run: IntegrationResult = collocation.integrate_collocation([model], *start, times, resolution)
            else:
                run = integrate_dop853(model, state.r, state.p, state.v, pdot, times, resolution)
        except ArithmeticError as error:
            raise EngineFailure(f"{self.title}: {error}") from error
        return Trajectory(t=run.t, r=run.r, p=run.p, v=run.v, pdot=run.pdot, steps=run.steps)

    def _simulate_round_trip(
        self, model: Model, state: State, end: float, integrator: Integrator, resolution: float
    ) -> Trajectory:
        def legs(r: Array, p: Array, v: Array, pdot: Array) -> IntegrationResult:
            return collocation.integrate_collocation([model], r, p, v, pdot, np.array([0.0, end]), resolution)

        try:
            there = legs(state.r, state.p, state.v, euler_parameter_rate(state.p, state.omega))
            back = legs(there.r[-1], there.p[-1], -there.v[-1], -there.pdot[-1])
        except ArithmeticError as error:
            raise EngineFailure(f"{self.title}: {error}") from error
        names, times = ("r", "p", "v", "pdot"), np.array([0.0, end, 2 * end])
        rows = {name: np.vstack([getattr(there, name), getattr(back, name)[1:]]) for name in names}
        return Trajectory(t=times, **rows, steps=there.steps + back.steps)


def state_quantities(
    system: DirectSystem, model: Model, state: State, solve: Callable[..., Solution]
) -> StateQuantities:
    """All that the notes say of one state, S x = b solved by ``solve``."""
    try:
        x = solve(state.r, state.p, state.v, euler_parameter_rate(state.p, state.omega))
    except SingularSystem as error:
        raise EngineFailure(f"{Reference.title}: {error}") from error
    momentum = model.mass[:, None] * state.v
    spin = (model.inertia @ state.omega[..., None])[..., 0]  # J ω′, body frame
    world_spin = (A(state.p) @ spin[..., None])[..., 0]
    return StateQuantities(
        acceleration=x.acceleration,
        angular_acceleration=2 * (L(state.p) @ x.pddot[..., None])[..., 0],
        joint_reaction=x.joint_reaction,
        kinetic_energy=float(np.sum(momentum * state.v) + np.sum(state.omega * spin)) / 2,
        potential_energy=-float(np.sum(model.mass * (state.r @ model.gravity))),
        angular_momentum=np.sum(np.cross(state.r, momentum) + world_spin, axis=0),
        mass_matrix=notes_mass_matrix(system, model, state),
    )


def notes_mass_matrix(system: DirectSystem, model: Model, state: State) -> Array:
    """diag(M, 4 LᵀJL) of (N5) in the contract's rates: Zᵀ S_top Z with (ṙ, ṗ) = Z ν and ṗ = ½ Lᵀ ω′."""
    n = model.n
    S, _ = system.assemble(state.r, state.p, state.v, euler_parameter_rate(state.p, state.omega))
    bodies = velocity_jacobian(model, state).reshape(n, 6, -1)
    pdot = L(state.p).swapaxes(-1, -2) @ bodies[:, 3:] / 2
    z = np.concatenate([bodies[:, :3].reshape(3 * n, -1), pdot.reshape(4 * n, -1)])
    return np.asarray(z.T @ S[: 7 * n, : 7 * n] @ z)
