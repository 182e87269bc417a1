"""Exudyn in maximal coordinates: one NodeRigidBodyEP per body, joints as constraints.

Map to the project's frames: node coordinates are (r, p) and their rates (ṙ, ṗ), world frame and scalar
first as here, so nothing is converted.  Exudyn keeps displacements from a reference; the reference is the
initial state itself, so that the displacements start from an exact zero.
The rod's constraint is ‖d‖ - ℓ, so its multiplier is the tension (2ℓ times the notes' λ); reactions are
read as -C_rᵀ λ, whatever the constraint's scale and sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import exudyn
import numpy as np
import scipy.linalg

from adapters.exudyn_common import (
    NEWTON,
    SUPPORTED,
    add_loads,
    items,
    quiet,
    rigid_body,
    run,
    settings,
    sparse,
    system,
    version,
)
from plumbline.adapter import Adapter
from plumbline.kinematics import angular_velocity, rate, rotation
from plumbline.records import Array, EngineFailure, Integrator, Model, State, StateQuantities, Trajectory

Output = exudyn.OutputVariableType


class Chain:
    """The assembled system at one state."""

    def __init__(self, model: Model, state: State) -> None:
        self.mbs, self.container = system()
        mbs = self.mbs
        ground = mbs.AddObject(items.ObjectGround())
        pivot = hang = mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=ground))
        pdot = rate(state.p, state.omega)
        self.nodes, self.bodies, self.joints = [], [], []
        for k in range(model.n):
            node = mbs.AddNode(
                items.NodeRigidBodyEP(
                    referenceCoordinates=[*state.r[k], *state.p[k]], initialVelocities=[*state.v[k], *pdot[k]]
                )
            )
            body = mbs.AddObject(rigid_body(node, model.mass[k], model.inertia[k]))

            def marker(point: Array, body: Any = body) -> Any:
                return mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=body, localPosition=point.tolist()))

            ends = [hang, marker(model.proximal[k])]
            if model.length[k] > 0:
                joint = items.ObjectConnectorDistance(markerNumbers=ends, distance=model.length[k])
            else:
                joint = items.ObjectJointSpherical(markerNumbers=ends)
            self.joints.append(mbs.AddObject(joint))
            self.nodes.append(node)
            self.bodies.append(body)
            weight = mbs.AddMarker(items.MarkerBodyMass(bodyNumber=body))
            mbs.AddLoad(items.LoadMassProportional(markerNumber=weight, loadVector=model.gravity.tolist()))
            add_loads(mbs, model, k, marker(np.zeros(3)), pivot, model.moment[k])
            hang = marker(model.distal[k])
        mbs.Assemble()


class Exudyn(Adapter):
    """Maximal coordinates with Euler parameters: the closest peer of the notes' own form."""

    name = "exudyn"
    title = "Exudyn"
    package = "exudyn"
    supported = SUPPORTED
    integrators: ClassVar[tuple[Integrator, ...]] = (
        Integrator(
            "trapezoidal",
            "step",
            2,
            (2, 4, 6, 8, 10, 12),
            symmetric=True,
            solver=NEWTON,
            note="TrapezoidalIndex2: implicit trapezoidal rule, constraints on velocities",
        ),
        Integrator(
            "generalized-alpha",
            "step",
            2,
            (2, 3, 4, 5, 6),
            solver=NEWTON,
            note="generalized-α with spectral radius 0.9, constraints on positions (index 3)",
        ),
    )

    def version(self) -> str:
        """Version of the Exudyn that runs."""
        return version()

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        with quiet():
            return [evaluate(model, state) for state in states]

    def _simulate(
        self, model: Model, state: State, times: Array, integrator: Integrator, resolution: float
    ) -> Trajectory:
        chosen = settings()
        sparse(chosen)
        alpha = chosen.timeIntegration.generalizedAlpha
        if integrator.name == "trapezoidal":
            alpha.useNewmark = alpha.useIndex2Constraints = True
        else:
            alpha.spectralRadius = 0.9
        with quiet():
            chain = Chain(model, state)
            data = chain.mbs.systemData
            rows = run(
                exudyn.MainSolverImplicitSecondOrder(),
                chain.mbs,
                chosen,
                times,
                resolution,
                lambda: (data.GetODE2Coordinates(), data.GetODE2Coordinates_t()),
            )
        start = np.concatenate([state.r, state.p], axis=1)
        q = start + np.array([row[0] for row in rows]).reshape(-1, model.n, 7)
        qdot = np.array([row[1] for row in rows]).reshape(-1, model.n, 7)
        steps = round(float(times[-1] / resolution))
        return Trajectory(times.copy(), q[..., :3], q[..., 3:], qdot[..., :3], qdot[..., 3:], steps)


def evaluate(model: Model, state: State) -> StateQuantities:
    """Everything from Exudyn's own mass matrix M, right-hand side f, constraint Jacobian C and outputs.

    Its own initial accelerations are finite differences, wrong by some 1e-6, and are not used:

        ⎡ M  Cᵀ ⎤ ⎡ q̈ ⎤   ⎡ f ⎤
        ⎣ C  0  ⎦ ⎣ λ ⎦ = ⎣ γ ⎦,     γ from the accelerations Exudyn gives the attachments at q̈ = 0.
    """
    chain = Chain(model, state)
    mbs, data, n = chain.mbs, chain.mbs.systemData, model.n
    chosen = settings()
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

    pdot = rate(state.p, state.omega)
    gamma = np.zeros(len(C))
    data.SetODE2Coordinates_tt(np.zeros(7 * n))
    for k, (node, joint) in enumerate(zip(chain.nodes, chain.joints, strict=True)):
        gamma[data.GetNodeLTGAE(node)] = -2 * pdot[k] @ pdot[k]
        bend = _relative(model, chain, k, Output.Acceleration)
        if model.length[k] > 0:  # (‖d‖)¨ = (dᵀd̈ + ḋᵀḋ - (‖d‖˙)²) / ‖d‖, and ‖d‖˙ = 0 on the manifold
            d, ddot = (_relative(model, chain, k, what) for what in (Output.Position, Output.Velocity))
            bend = (d @ bend + ddot @ ddot) / np.linalg.norm(d)
        gamma[data.GetObjectLTGAE(joint)] = -bend

    x = _solve(np.block([[M, C.T], [C, np.zeros((len(C), len(C)))]]), np.concatenate([f, gamma]))
    data.SetODE2Coordinates_tt(x[: 7 * n])
    multiplier = x[7 * n :]
    reaction = np.array(
        [
            -C[data.GetObjectLTGAE(joint), 7 * k : 7 * k + 3].T @ multiplier[data.GetObjectLTGAE(joint)]
            for k, joint in enumerate(chain.joints)
        ]
    )

    def output(what: Any) -> Array:
        return np.array([mbs.GetObjectOutputBody(body, what) for body in chain.bodies])

    qdot = np.concatenate([state.v, pdot], axis=1)  # (N, 7)
    momentum = (M @ qdot.ravel()).reshape(n, 7)  # 4LᵀJLṗ = 2LᵀJω′, and L Lᵀ = I gives Jω′ = ½ L (…)
    spin = angular_velocity(state.p, momentum[:, 3:]) / 4  # angular_velocity is 2 L(p) (…)
    r = output(Output.Position)
    weight = (M @ np.tile([*model.gravity, 0, 0, 0, 0], n)).reshape(n, 7)[:, :3]
    basis = _rates(model, state)
    kinetic = 0.5 * np.sum(qdot * momentum)
    if hasattr(Output, "KineticEnergy"):  # an output of bodies since 1.12
        kinetic = np.sum([mbs.GetObjectOutputBody(body, Output.KineticEnergy) for body in chain.bodies])
    return StateQuantities(
        acceleration=output(Output.Acceleration),
        angular_acceleration=output(Output.AngularAccelerationLocal),
        joint_reaction=reaction,
        kinetic_energy=float(kinetic),
        potential_energy=float(-np.sum(weight * r)),  # its own PotentialEnergy is always 0
        angular_momentum=np.sum(np.cross(r, momentum[:, :3]), 0)
        + np.einsum("kij,kj->i", rotation(state.p), spin),
        mass_matrix=basis.T @ M @ basis,
    )


def _relative(model: Model, chain: Chain, k: int, what: Any) -> Array:
    """(3,) an output of joint k: at body k's proximal point less that at the point where the joint hangs."""

    def at(body: int, point: Array) -> Array:
        return np.array(chain.mbs.GetObjectOutputBody(chain.bodies[body], what, point.tolist()))

    here = at(k, model.proximal[k])
    return here - at(k - 1, model.distal[k - 1]) if k else here


def _rates(model: Model, state: State) -> Array:
    """(7N, nu) matrix that takes ν = (u̇ of the rods, ω′ of all bodies) to Exudyn's (ṙ, ṗ) of all bodies."""
    n, rods = model.n, np.flatnonzero(model.rods)
    A = rotation(state.p)
    out = np.zeros((n, 7, 3 * len(rods) + 3 * n))
    tip = np.zeros((3, out.shape[2]))  # rate of the point where the next joint hangs
    for k in range(n):
        turn = slice(3 * (len(rods) + k), 3 * (len(rods) + k) + 3)
        if model.length[k] > 0:
            rod = slice(3 * int(np.searchsorted(rods, k)), 3 * int(np.searchsorted(rods, k)) + 3)
            tip[:, rod] += model.length[k] * (np.eye(3) - np.outer(state.u[k], state.u[k]))
        out[k, :3] = tip
        out[k, :3, turn] -= _moved(A[k], model.proximal[k])
        out[k, 3:, turn] = rate(np.tile(state.p[k], (3, 1)), np.eye(3)).T
        tip = out[k, :3].copy()
        tip[:, turn] += _moved(A[k], model.distal[k])
    return out.reshape(7 * n, -1)


def _moved(A: Array, s: Array) -> Array:
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
