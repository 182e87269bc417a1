"""Pinocchio in maximal coordinates: every body a free flyer, the joints as constraints.

State level only, a second opinion of the same engine on its own chain of spherical joints.

The map.  Body k's joint frame is at its centre of mass with the body's axes,

    q_k = (r_k, p_k as (x, y, z, w)),        v_k = (Aᵀ ṙ_k, ω′_k),        τ_k = (Aᵀ (F - c_t ṙ), n′ - c_r ω′).

Where every joint is a ball, `constraintDynamics` on CONTACT_3D constraints without proximal
damping (exact: these joints are never redundant).  Pinocchio has no distance constraint, so with
a rod among the joints `forwardDynamics`, on rows of the engine's own frame Jacobians J and
accelerations γ at v̇ = 0 of the attachment points: with Δ for near minus far, d = ℓ u,

    ball  ΔJ v̇ + Δγ = 0,        rod  uᵀ ΔJ v̇ + uᵀ Δγ + ℓ u̇ᵀu̇ = 0.

Its other way: the same rows through the engine's inverse of the whole KKT matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import pinocchio as pin

from plumbline.engines.metamorphic_hooks import MetamorphicHooks
from plumbline.model.datatypes import Array, Integrator, Model, State, StateQuantities, Unsupported
from plumbline.model.kinematics import rotation_matrix, velocity_jacobian
from plumbline.model.welding import BodyParts

WORLD_ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
MAX_BODIES = 30  # bodies; the engine's workspace grows with N³: 0.4 GB here, 1.5 GB at 50


class FreeFlyerSystem:
    """A `Model` as free bodies and constraints. Pinocchio's q is (7 N,), its v (6 N,)."""

    def __init__(self, model: Model, parts: BodyParts, inverse: bool = False):
        self.source_model, self.use_kkt_inverse = model, inverse
        self.pin_model = pin.Model()
        self.pin_model.gravity = pin.Motion(model.gravity, np.zeros(3))
        for k in range(model.n):
            joint = self.pin_model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), f"body {k}")
            for part in parts[k]:  # the engine welds what is appended to one joint
                inertia = pin.Inertia(part.mass, np.zeros(3), part.inertia)
                self.pin_model.appendBodyToJoint(joint, inertia, _translation(part.centre))
        # Attachment points of joint k: (joint, placement) on body k, and on body k-1 or the world.
        near = [(k + 1, _translation(model.proximal[k])) for k in range(model.n)]
        far = [(k, _translation(model.distal[k - 1] if k else np.zeros(3))) for k in range(model.n)]
        self.near_frames, self.far_frames = (
            [self._add_frame(*point) for point in points] for points in (near, far)
        )
        self.contacts, self.contact_data = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
        for here, there in zip(near, far, strict=True):
            kind, frame = pin.ContactType.CONTACT_3D, pin.ReferenceFrame.LOCAL
            self.contacts.append(pin.RigidConstraintModel(kind, self.pin_model, *here, *there, frame))
            self.contact_data.append(self.contacts[-1].createData())
        self.data = self.pin_model.createData()
        try:
            pin.initConstraintDynamics(self.pin_model, self.data, self.contacts, self.contact_data)
        except TypeError:  # before 4.0
            pin.initConstraintDynamics(self.pin_model, self.data, self.contacts)

    def _add_frame(self, joint: int, placement: pin.SE3) -> int:
        name = f"point {self.pin_model.nframes}"
        return int(self.pin_model.addFrame(pin.Frame(name, joint, placement, pin.FrameType.OP_FRAME)))

    def quantities(self, state: State) -> StateQuantities:
        """All state quantities at one state."""
        engine, data, model = self.pin_model, self.data, self.source_model
        turn = rotation_matrix(state.p)
        local = np.matvec(turn.mT, state.v)
        q = np.hstack([state.r, np.roll(state.p, -1, axis=1)]).ravel()
        v = np.hstack([local, state.omega]).ravel()
        force = np.matvec(turn.mT, model.force) - model.drag_force[:, None] * local
        moment = model.moment - model.drag_moment[:, None] * state.omega
        tau = np.hstack([force, moment]).ravel()
        if self.use_kkt_inverse or np.any(model.rods):
            reaction = self._solve_constraint_rows(state, q, v, tau)
        else:
            pin.constraintDynamics(engine, data, q, v, tau, self.contacts, self.contact_data)
            reaction = np.matvec(turn, [contact.contact_force.linear for contact in self.contact_data])
        a = data.ddq.reshape(-1, 6)
        w = velocity_jacobian(model, state)
        w.reshape(model.n, 6, -1)[:, :3] = turn.mT @ w.reshape(model.n, 6, -1)[:, :3]
        inertia = pin.crba(engine, data, q)
        momentum = pin.computeCentroidalMomentum(engine, data, q, v)
        return StateQuantities(
            acceleration=np.matvec(turn, a[:, :3] + np.cross(state.omega, local)),
            angular_acceleration=a[:, 3:].copy(),
            joint_reaction=reaction,
            kinetic_energy=float(pin.computeKineticEnergy(engine, data, q, v)),
            potential_energy=float(pin.computePotentialEnergy(engine, data, q)),
            angular_momentum=momentum.angular + np.cross(data.com[0], momentum.linear),
            mass_matrix=w.T @ inertia @ w,
        )

    def _solve_constraint_rows(self, state: State, q: Array, v: Array, tau: Array) -> Array:
        """Solve with own constraint rows into ``data.ddq``; the joint reactions (N, 3), world."""
        engine, data, model = self.pin_model, self.data, self.source_model
        pin.forwardKinematics(engine, data, q, v, np.zeros(engine.nv))
        pin.computeJointJacobians(engine, data, q)
        pin.updateFramePlacements(engine, data)
        jacobian, drift, directions = [], [], []
        for k in range(model.n):
            both = self.near_frames[k], self.far_frames[k]
            j_near, j_far = (pin.getFrameJacobian(engine, data, f, WORLD_ALIGNED)[:3] for f in both)
            g_near, g_far = (
                pin.getFrameClassicalAcceleration(engine, data, f, WORLD_ALIGNED).linear for f in both
            )
            along = state.u[k : k + 1] if model.length[k] > 0 else np.eye(3)
            jacobian.append(along @ (j_near - j_far))
            drift.append(along @ (g_near - g_far) + model.length[k] * state.udot[k] @ state.udot[k])
            directions.append(along)
        rows, bend = np.vstack(jacobian), np.concatenate(drift)
        if self.use_kkt_inverse:
            force = tau - pin.nonLinearEffects(engine, data, q, v)
            inverse = pin.computeKKTContactDynamicMatrixInverse(engine, data, q, rows, 0.0)
            x = inverse @ np.concatenate([force, -bend])
            data.ddq, multiplier = x[: engine.nv], -x[engine.nv :]
        else:
            pin.forwardDynamics(engine, data, q, v, tau, rows, bend, 0.0)
            multiplier = data.lambda_c
        ends = np.cumsum([len(along) for along in directions])[:-1]
        multipliers = np.split(multiplier, ends)
        return np.array([along.T @ m for along, m in zip(directions, multipliers, strict=True)])


def _translation(point: Array) -> pin.SE3:
    return pin.SE3(np.eye(3), point)


class PinocchioMaximal(MetamorphicHooks):
    """Pinocchio's constrained dynamics of free bodies; evaluates states, does not integrate."""

    name: ClassVar[str] = "pinocchio-maximal"
    title: ClassVar[str] = "Pinocchio, maximal coordinates"
    package: ClassVar[str] = "pin"
    reproduction_template = "pinocchio-maximal"
    other_formulation = "pinocchio"
    supported_versions = ">=3.3.1,<5"
    extra_requirements = (
        ("<4", "cmeel-urdfdom<5"),
        ("<4", "cmeel-tinyxml2<11"),
    )  # what those wheels were linked with
    integrators: ClassVar[tuple[Integrator, ...]] = ()
    options = ("inverse of the KKT matrix",)
    welding_unsupported_reason = ""

    def version(self) -> str:
        """Version of the pin wheel."""
        return str(pin.__version__)

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        if model.n > MAX_BODIES:
            raise Unsupported(
                f"the engine's workspace for {model.n} free bodies, growing with their cube, is too large; "
                f"in maximal coordinates Pinocchio is asked about {MAX_BODIES} at most"
            )
        flyers = FreeFlyerSystem(model, self.body_pieces(model), inverse=bool(self.option))
        return [flyers.quantities(state) for state in states]

    def _simulate(self, *_: object) -> None:  # type: ignore[override]
        raise Unsupported("Pinocchio in maximal coordinates is compared at state level only")
