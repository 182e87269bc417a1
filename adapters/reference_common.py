"""What the reference columns share: from the solution of S x = b to the contract's quantities.

State: ṗ = ½ L(p)ᵀ ω′ on the way in; ω̇′ = 2 L(p) p̈ on the way out (L̇ ṗ = 0, N9).  With y = (ṙ, ṗ) and
T = diag(M, 4 LᵀJL), the upper left block of S, the kinetic energy is ½ yᵀ T y (N1, N2).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from plumbline import __version__
from plumbline.engines.metamorphic_hooks import MetamorphicHooks
from plumbline.model.datatypes import (
    Array,
    EngineFailure,
    Float,
    Integrator,
    Model,
    State,
    StateQuantities,
    Trajectory,
)
from plumbline.model.kinematics import velocity_jacobian
from reference_impl.arrays import Motion
from reference_impl.euler_parameters import A, L, euler_parameter_rate
from reference_impl.integrate import IntegrationResult

DOP853 = Integrator(
    "dop853",
    "tolerance",
    8,
    min_rtol=1e-13,
    note="scipy's DOP853 on y = (r, p, ṙ, ṗ), no stabilisation; resolution is rtol, atol is rtol "
    "times the natural size of each part of y",
)


class NotesAdapter(MetamorphicHooks):
    """Declarations common to both columns of the notes' equations."""

    package = "plumbline"
    welding_unsupported_reason = "the notes know ball joints and rods, no joint that holds two bodies rigidly"

    def version(self) -> str:
        """Return the version of this checkout."""
        return __version__

    @contextmanager
    def _named_failures(self) -> Iterator[None]:
        """Report what the equations cannot be solved for as a failure of the column."""
        try:
            yield
        except ArithmeticError as error:
            raise EngineFailure(f"{self.title}: {error}") from error


def notes_state(state: State) -> Motion:
    """Convert a state to the notes' variables.

    Returns:
        r [m], p, ṙ [m/s] and ṗ [1/s].

    """
    return state.r, state.p, state.v, euler_parameter_rate(state.p, state.omega)


def state_quantities(
    model: Model,
    state: State,
    acceleration: Float[Array, "bodies 3"],
    pddot: Float[Array, "bodies 4"],
    reaction: Float[Array, "joints 3"],
    S: Float[Array, "unknowns unknowns"],
    moment: Float[Array, "joints 3"] | None = None,
    rotor_count: int = 0,
    spring_energy: float = 0.0,
) -> StateQuantities:
    """Compute the contract's quantities of one state from the solution of S x = b.

    Args:
        state: one on the constraint manifold.
        acceleration: r̈ [m/s²], world frame.
        pddot: p̈ [1/s²].
        reaction: forces on the bodies at their joints' near points [N], world frame (E5).
        S: the matrix of (N5), of which rows and columns of r̈ and p̈ are used.
        moment: moments on the bodies about these points [N m], world frame; absent for chains of rods
            and balls, where it is 0.
        rotor_count: rows of rotors in S, behind those of the constraints.
        spring_energy: potential energy of springs [J].

    """
    n = model.n
    r, p, v, pdot = notes_state(state)
    rotors = slice(len(S) - n - rotor_count, len(S) - n)  # rows J_φ with −1/a on the diagonal
    J = S[rotors, : 7 * n]
    T, y = S[: 7 * n, : 7 * n] - J.T / np.diag(S)[rotors] @ J, np.concatenate([v.ravel(), pdot.ravel()])
    # The contract's mass matrix is Zᵀ T Z with y = Z ν.
    bodies = velocity_jacobian(model, state).reshape(n, 6, -1)
    pdot_rows = L(p).swapaxes(-1, -2) @ bodies[:, 3:] / 2
    Z = np.concatenate([bodies[:, :3].reshape(3 * n, -1), pdot_rows.reshape(4 * n, -1)])
    spin = A(p) @ model.inertia @ state.omega[..., None]
    return StateQuantities(
        acceleration=acceleration,
        angular_acceleration=2 * (L(p) @ pddot[..., None])[..., 0],
        joint_reaction=reaction,
        joint_moment=moment,
        kinetic_energy=float(y @ T @ y) / 2,
        potential_energy=spring_energy - float(np.sum(model.mass * (r @ model.gravity))),
        angular_momentum=np.sum(np.cross(r, model.mass[:, None] * v) + spin[..., 0], axis=0),
        mass_matrix=None if model.has_loops else Z.T @ T @ Z,
    )


def trajectory(run: IntegrationResult) -> Trajectory:
    """Convert a run of the reference's integrators."""
    return Trajectory(t=run.t, r=run.r, p=run.p, v=run.v, pdot=run.pdot, steps=run.steps)
