"""Exudyn in maximal coordinates: one NodeRigidBodyEP per body, joints as constraints.

Map to the project's frames: node coordinates are (r, p) and their rates (ṙ, ṗ), world frame and scalar
first as here, so nothing is converted.  Exudyn keeps displacements from a reference; the reference is the
initial state itself, so that the displacements start from an exact zero.
The rod's constraint is ‖d‖ - ℓ, so its multiplier is the tension (2ℓ times the notes' λ); reactions are
read as -C_rᵀ λ, whatever the constraint's scale and sign.

Welded halves are nodes of their own with a rigid joint between: the body hangs by its first half, the next
body on its last, and what is said of the body is said of the point on its first half where its centre is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import exudyn
import numpy as np
import scipy.linalg

from adapters.exudyn_common import (
    NEWTON_TOLERANCE,
    SUPPORTED_VERSIONS,
    add_loads,
    items,
    make_rigid_body,
    make_settings,
    make_system,
    run_solver,
    set_linear_solver,
    silence_engine,
    version,
)
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
from plumbline.model.kinematics import angular_velocity, quaternion_rate, rotation_matrix
from plumbline.model.welding import BodyParts, undivided_bodies

Output = exudyn.OutputVariableType


class ExudynChain:
    """The assembled system at one state; the pieces of all bodies in a row.

    ``first[k]``, ``last[k]``: the pieces that body k hangs by and that the next one hangs on;
    ``of[i]``, ``centre[i]``: the body of piece i and where in it the piece's own centre of mass is.
    """

    def __init__(self, model: Model, state: State, parts: BodyParts | None = None) -> None:
        self.mbs, self.container = make_system()
        mbs, parts = self.mbs, parts or undivided_bodies(model)
        ground = mbs.AddObject(items.ObjectGround())
        pivot = hang = mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=ground))
        self.nodes, self.joints, self.welds = [], [], []
        self.piece_bodies: list[Any] = []
        self.first_piece, self.last_piece, self.body_of_piece = [], [], []
        self.piece_centre = [part.centre for pieces in parts for part in pieces]
        self.qdot = np.empty((len(self.piece_centre), 7))
        turn, pdot, gravity = (
            rotation_matrix(state.p),
            quaternion_rate(state.p, state.omega),
            model.gravity.tolist(),
        )
        for k in range(model.n):
            self.first_piece.append(len(self.piece_bodies))
            for part in parts[k]:
                arm = turn[k] @ part.centre, turn[k] @ np.cross(state.omega[k], part.centre)
                qdot = self.qdot[len(self.piece_bodies)] = *(state.v[k] + arm[1]), *pdot[k]
                node = mbs.AddNode(
                    items.NodeRigidBodyEP(
                        referenceCoordinates=[*(state.r[k] + arm[0]), *state.p[k]], initialVelocities=[*qdot]
                    )
                )
                body = mbs.AddObject(make_rigid_body(node, part.mass, part.inertia))
                weight = mbs.AddMarker(items.MarkerBodyMass(bodyNumber=body))
                mbs.AddLoad(items.LoadMassProportional(markerNumber=weight, loadVector=gravity))
                self.nodes.append(node)
                self.piece_bodies.append(body)
                self.body_of_piece.append(k)
            self.last_piece.append(len(self.piece_bodies) - 1)
            ends = [hang, self.add_marker(self.first_piece[k], model.proximal[k])]
            if model.length[k] > 0:
                joint = items.ObjectConnectorDistance(markerNumbers=ends, distance=model.length[k])
            else:
                joint = items.ObjectJointSpherical(markerNumbers=ends)
            self.joints.append(mbs.AddObject(joint))
            if self.last_piece[k] > self.first_piece[k]:
                middle = [
                    self.add_marker(piece, np.zeros(3)) for piece in (self.first_piece[k], self.last_piece[k])
                ]
                self.welds.append(mbs.AddObject(items.ObjectJointGeneric(markerNumbers=middle)))
            add_loads(
                mbs, model, k, self.add_marker(self.first_piece[k], np.zeros(3)), pivot, model.moment[k]
            )
            hang = self.add_marker(self.last_piece[k], model.distal[k])
        mbs.Assemble()

    def add_marker(self, piece: int, point: Array) -> Any:
        """A marker on a piece, at a point of its body."""
        local = (point - self.piece_centre[piece]).tolist()
        return self.mbs.AddMarker(
            items.MarkerBodyRigid(bodyNumber=self.piece_bodies[piece], localPosition=local)
        )

    def output_at(self, piece: int, output_type: Any, point: Array) -> Array:
        """(3,) an output of a piece at a point of its body."""
        local = (point - self.piece_centre[piece]).tolist()
        return np.array(self.mbs.GetObjectOutputBody(self.piece_bodies[piece], output_type, local))


class Exudyn(MetamorphicHooks):
    """Maximal coordinates with Euler parameters: the closest peer of the notes' own form."""

    name = "exudyn"
    title = "Exudyn"
    package = "exudyn"
    reproduction_template = "exudyn"
    other_formulation = "exudyn-tree"
    supported_versions = SUPPORTED_VERSIONS
    integrators: ClassVar[tuple[Integrator, ...]] = (
        Integrator(
            "trapezoidal",
            "step",
            2,
            (2, 4, 6, 8, 10, 12),
            is_symmetric=True,
            solver_rtol=NEWTON_TOLERANCE,
            note="TrapezoidalIndex2: implicit trapezoidal rule, constraints on velocities",
        ),
        Integrator(
            "generalized-alpha",
            "step",
            2,
            (2, 3, 4, 5, 6),
            solver_rtol=NEWTON_TOLERANCE,
            note="generalized-α with spectral radius 0.9, constraints on positions (index 3)",
        ),
    )

    usual_linear_solver = "EigenSparse"
    linear_solvers = ("EXUdense", "EigenDense")
    welding_unsupported_reason = ""

    def version(self) -> str:
        """Version of the Exudyn that runs."""
        return version()

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        with silence_engine():
            return [evaluate_state(model, state, self.body_pieces(model)) for state in states]

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        with silence_engine():
            chain = ExudynChain(model, state)
            rows = self._run_samples(chain, times, integrator, resolution)
        return trajectory_from_samples(model, state, times, rows, resolution)

    def _simulate_round_trip(
        self, model: Model, state: State, end: float, integrator: Integrator, resolution: float
    ) -> Trajectory:
        initial, leg = exudyn.ConfigurationType.Initial, np.array([0.0, end])
        with silence_engine():
            chain = ExudynChain(model, state)
            data = chain.mbs.systemData
            there = self._run_samples(chain, leg, integrator, resolution)
            q, qdot, qddot = there[-1]
            data.SetODE2Coordinates(q, initial)
            data.SetODE2Coordinates_t(-qdot, initial)
            data.SetODE2Coordinates_tt(qddot, initial)  # carried from step to step: a part of its state
            data.SetTime(0.0, initial)
            back = self._run_samples(chain, leg, integrator, resolution, compute_initial_accelerations=False)
        return trajectory_from_samples(
            model, state, np.array([0.0, end, 2 * end]), [*there, back[-1]], resolution
        )

    def _run_samples(
        self,
        chain: ExudynChain,
        times: Array,
        integrator: Integrator,
        step: float,
        compute_initial_accelerations: bool = True,
    ) -> list[tuple[Array, Array, Array]]:
        """Displacements, rates, accelerations (7N,) at ``times``; ``afresh``: the first accelerations too."""
        chosen, data = make_settings(), chain.mbs.systemData
        set_linear_solver(chosen, self.option or self.usual_linear_solver)
        alpha = chosen.timeIntegration.generalizedAlpha
        alpha.computeInitialAccelerations = compute_initial_accelerations
        if integrator.name == "trapezoidal":
            alpha.useNewmark = alpha.useIndex2Constraints = True
        else:
            alpha.spectralRadius = 0.9
        parts = data.GetODE2Coordinates, data.GetODE2Coordinates_t, data.GetODE2Coordinates_tt
        solver = exudyn.MainSolverImplicitSecondOrder()
        return run_solver(solver, chain.mbs, chosen, times, step, lambda: tuple(part() for part in parts))


def trajectory_from_samples(
    model: Model, state: State, times: Array, rows: list[tuple[Array, Array, Array]], step: float
) -> Trajectory:
    """What was read of a run from ``state``."""
    start = np.concatenate([state.r, state.p], axis=1)
    q = start + np.array([row[0] for row in rows]).reshape(-1, model.n, 7)
    qdot = np.array([row[1] for row in rows]).reshape(-1, model.n, 7)
    return Trajectory(
        times.copy(), q[..., :3], q[..., 3:], qdot[..., :3], qdot[..., 3:], round(float(times[-1] / step))
    )


def evaluate_state(model: Model, state: State, parts: BodyParts) -> StateQuantities:
    """Everything from Exudyn's own mass matrix M, right-hand side f, constraint Jacobian C and outputs.

    Its own initial accelerations are finite differences, wrong by some 1e-6, and are not used:

        ⎡ M  Cᵀ ⎤ ⎡ q̈ ⎤   ⎡ f ⎤
        ⎣ C  0  ⎦ ⎣ λ ⎦ = ⎣ γ ⎦,     γ from the accelerations Exudyn gives the attachments at q̈ = 0.

    Pieces of one body turn alike, so that γ of a weld's rotations is 0.
    """
    chain = ExudynChain(model, state, parts)
    mbs, data, n = chain.mbs, chain.mbs.systemData, len(chain.piece_bodies)
    chosen = make_settings()
    chosen.timeIntegration.generalizedAlpha.computeInitialAccelerations = False
    solver: Any = exudyn.MainSolverImplicitSecondOrder()
    if not solver.InitializeSolver(mbs, chosen):
        raise EngineFailure(f"Exudyn could not initialise its solver: {solver.GetErrorString()}")
    try:
        solver.ComputeMassMatrix(mbs)
        M = np.array(solver.GetSystemMassMatrix())  # (7N, 7N)
        solver.ComputeODE2RHS(mbs)
        f = np.array(solver.GetSystemResidual())[: 7 * n]
        solver.SetSystemJacobian(
            np.zeros_like(solver.GetSystemJacobian())
        )  # it is added to, and starts unset
        solver.ComputeJacobianAE(mbs)
        C = np.array(solver.GetSystemJacobian())[7 * n :, : 7 * n]
    finally:
        solver.FinalizeSolver(mbs, chosen)

    gamma = np.zeros(len(C))
    data.SetODE2Coordinates_tt(np.zeros(7 * n))
    for i, node in enumerate(chain.nodes):
        gamma[data.GetNodeLTGAE(node)] = -2 * chain.qdot[i, 3:] @ chain.qdot[i, 3:]
    for k, joint in enumerate(chain.joints):
        bend = _relative_joint_output(model, chain, k, Output.Acceleration)
        if model.length[k] > 0:  # (‖d‖)¨ = (dᵀd̈ + ḋᵀḋ - (‖d‖˙)²) / ‖d‖, and ‖d‖˙ = 0 on the manifold
            d, ddot = (
                _relative_joint_output(model, chain, k, what) for what in (Output.Position, Output.Velocity)
            )
            bend = (d @ bend + ddot @ ddot) / np.linalg.norm(d)
        gamma[data.GetObjectLTGAE(joint)] = -bend
    for weld, one, other in zip(chain.welds, chain.first_piece, chain.last_piece, strict=False):
        rows = data.GetObjectLTGAE(weld)[:3]
        there, here = (chain.output_at(piece, Output.Acceleration, np.zeros(3)) for piece in (other, one))
        bend = there - here
        gamma[rows] = -C[rows, 7 * other : 7 * other + 3] @ bend

    x = _solve(np.block([[M, C.T], [C, np.zeros((len(C), len(C)))]]), np.concatenate([f, gamma]))
    data.SetODE2Coordinates_tt(x[: 7 * n])
    multiplier = x[7 * n :]
    reaction = np.array(
        [
            -C[data.GetObjectLTGAE(joint), 7 * i : 7 * i + 3].T @ multiplier[data.GetObjectLTGAE(joint)]
            for i, joint in zip(chain.first_piece, chain.joints, strict=True)
        ]
    )

    def output(output_type: Any) -> Array:
        return np.array([chain.output_at(i, output_type, np.zeros(3)) for i in chain.first_piece])

    momentum = (M @ chain.qdot.ravel()).reshape(n, 7)  # 4LᵀJLṗ = 2LᵀJω′, and L Lᵀ = I gives Jω′ = ½ L (…)
    p = state.p[chain.body_of_piece]
    spin = angular_velocity(p, momentum[:, 3:]) / 4  # angular_velocity is 2 L(p) (…)
    r = np.array([mbs.GetObjectOutputBody(body, Output.Position) for body in chain.piece_bodies])
    weight = (M @ np.tile([*model.gravity, 0, 0, 0, 0], n)).reshape(n, 7)[:, :3]
    kinetic = 0.5 * np.sum(chain.qdot * momentum)
    if hasattr(Output, "KineticEnergy"):  # an output of bodies since 1.12
        kinetic = np.sum([mbs.GetObjectOutputBody(body, Output.KineticEnergy) for body in chain.piece_bodies])
    basis = (
        None if chain.welds else _coordinate_rate_map(model, state)
    )  # of pieces the engine has no mass matrix on ν
    return StateQuantities(
        acceleration=output(Output.Acceleration),
        angular_acceleration=output(Output.AngularAccelerationLocal),
        joint_reaction=reaction,
        kinetic_energy=float(kinetic),
        potential_energy=float(-np.sum(weight * r)),  # its own PotentialEnergy is always 0
        angular_momentum=np.sum(np.cross(r, momentum[:, :3]), 0)
        + np.einsum("kij,kj->i", rotation_matrix(p), spin),
        mass_matrix=None if basis is None else basis.T @ M @ basis,
    )


def _relative_joint_output(model: Model, chain: ExudynChain, k: int, output_type: Any) -> Array:
    """(3,) an output of joint k: at body k's proximal point less that at the point where the joint hangs."""
    here = chain.output_at(chain.first_piece[k], output_type, model.proximal[k])
    return here - chain.output_at(chain.last_piece[k - 1], output_type, model.distal[k - 1]) if k else here


def _coordinate_rate_map(model: Model, state: State) -> Array:
    """(7N, nu) matrix that takes ν = (u̇ of the rods, ω′ of all bodies) to Exudyn's (ṙ, ṗ) of all bodies."""
    n, rods = model.n, np.flatnonzero(model.rods)
    A = rotation_matrix(state.p)
    out = np.zeros((n, 7, 3 * len(rods) + 3 * n))
    tip = np.zeros((3, out.shape[2]))  # rate of the point where the next joint hangs
    for k in range(n):
        turn = slice(3 * (len(rods) + k), 3 * (len(rods) + k) + 3)
        if model.length[k] > 0:
            rod = slice(3 * int(np.searchsorted(rods, k)), 3 * int(np.searchsorted(rods, k)) + 3)
            tip[:, rod] += model.length[k] * (np.eye(3) - np.outer(state.u[k], state.u[k]))
        out[k, :3] = tip
        out[k, :3, turn] -= _point_velocity_map(A[k], model.proximal[k])
        out[k, 3:, turn] = quaternion_rate(np.tile(state.p[k], (3, 1)), np.eye(3)).T
        tip = out[k, :3].copy()
        tip[:, turn] += _point_velocity_map(A[k], model.distal[k])
    return out.reshape(7 * n, -1)


def _point_velocity_map(A: Array, s: Array) -> Array:
    """(3, 3) with d(A s)/dt = (…) ω′ for the body-fixed point s."""
    return np.stack([A @ np.cross(axis, s) for axis in np.eye(3)], axis=1)


def _solve(S: Array, b: Array) -> Array:
    """S x = b of a symmetric S, equilibrated, refined once with extended-precision residuals."""
    scale = 1 / np.sqrt(np.max(np.abs(S), axis=1))
    factor = scipy.linalg.lu_factor(S * scale[:, None] * scale)
    x = scale * scipy.linalg.lu_solve(factor, scale * b)
    for _ in range(2):
        residual = np.asarray(b - S.astype(np.longdouble) @ x, dtype=float)
        x += scale * scipy.linalg.lu_solve(factor, scale * residual)
    return np.asarray(x)
