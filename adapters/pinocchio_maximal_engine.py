"""Pinocchio in maximal coordinates: every body a free flyer, the joints as constraints.

Evaluates states only: a second formulation beside the chain of spherical joints in `pinocchio_engine`.

Frames, quaternion order and offsets.  Body k's joint frame is at its centre of mass with the body's axes;
p is scalar first here and scalar last in Pinocchio; velocities are in the body's own frame:

    q_k = (r_k, p_k as (x, y, z, w)),        v_k = (Aᵀ ṙ_k, ω′_k),        τ_k = (Aᵀ (F - c_t ṙ), n′ - c_r ω′).

Where every joint is a ball, `constraintDynamics` on CONTACT_3D constraints without proximal
damping (exact: these joints are never redundant).  Pinocchio has no distance constraint, so with
a rod among the joints `forwardDynamics`, on rows of the engine's own frame Jacobians J and
accelerations γ at v̇ = 0 of the attachment points: with Δ for near minus far, d = ℓ u,

    ball  ΔJ v̇ + Δγ = 0,        rod  uᵀ ΔJ v̇ + uᵀ Δγ + ℓ u̇ᵀu̇ = 0.

Other joints hold the near point against the far body's point where it is, and the body's turn, in the
directions that their motions leave: rows of the same Jacobians and accelerations (`_relative_motion`).

The option "inverse of the KKT matrix" solves the same rows with the engine's inverse of the whole matrix.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import pinocchio as pin

from adapters.pinocchio_common import (
    WORLD_ALIGNED,
    PinocchioAdapter,
    add_frame,
    append_parts,
    energies_and_momentum,
    init_constraint_dynamics,
    point_acceleration,
    rigid_constraints,
    translation,
)
from plumbline.model.datatypes import Array, Indices, Model, State, StateQuantities, Unsupported
from plumbline.model.kinematics import (
    JointFrame,
    joint_coordinates,
    rotate_vectors,
    rotation_matrix,
    velocity_jacobian,
)
from plumbline.model.loops import independent_rows
from plumbline.model.welding import BodyParts

MAX_BODIES = 30  # bodies; the engine's workspace grows with N³: 0.4 GB here, 1.5 GB at 50


class _FreeFlyerSystem:
    """A `Model` as free bodies and constraints. Pinocchio's q is (7 N,), its v (6 N,)."""

    def __init__(self, model: Model, parts: BodyParts, use_kkt_inverse: bool = False):
        self.source_model, self.parts, self.use_kkt_inverse = model, parts, use_kkt_inverse
        self.pin_model = pin.Model()
        self.pin_model.gravity = pin.Motion(model.gravity, np.zeros(3))
        for k in range(model.n):
            joint = self.pin_model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), f"body {k}")
            append_parts(self.pin_model, joint, parts[k], pin.SE3.Identity())
        # Attachment points of joint k: (engine joint, place) on its bodies; joint 0 is the world.
        far, near = (
            [(int(b) + 1, translation(at)) for b, at in zip(model.body[:, i], model.point[:, i], strict=True)]
            for i in (0, 1)
        )
        self.near_frames, self.far_frames = (
            [add_frame(self.pin_model, f"{side} {k}", *place) for k, place in enumerate(places)]
            for side, places in (("near", near), ("far", far))
        )
        kind, pairs = pin.ContactType.CONTACT_3D, zip(near, far, strict=True)
        self.contacts, self.contact_data = rigid_constraints(kind, self.pin_model, pairs)
        self.data = self.pin_model.createData()
        self.allowed = np.zeros((len(model.kind), 6))  # accelerations that the joints' rates cause
        init_constraint_dynamics(self.pin_model, self.data, self.contacts, self.contact_data)

    def _coordinates(self, state: State) -> tuple[Array, Array, Array, Array]:
        """Return q, v and τ, and v of unit rates."""
        model, turn = self.source_model, rotation_matrix(state.p)
        self.u, self.udot, self.x, self.xdot = joint_coordinates(model, state)
        local = rotate_vectors(turn.swapaxes(-1, -2), state.v)
        q = np.hstack([state.r, np.roll(state.p, -1, axis=1)]).ravel()
        v = np.hstack([local, state.omega]).ravel()
        force = rotate_vectors(turn.swapaxes(-1, -2), model.force) - model.drag_force[:, None] * local
        moment = model.moment - model.drag_moment[:, None] * state.omega
        rates = velocity_jacobian(model, state)
        rates.reshape(model.n, 6, -1)[:, :3] = turn.swapaxes(-1, -2) @ rates.reshape(model.n, 6, -1)[:, :3]
        return q, v, np.hstack([force, moment]).ravel(), rates

    def quantities(self, state: State) -> StateQuantities:
        """Return all state quantities at one state."""
        engine, data, model = self.pin_model, self.data, self.source_model
        turn, (q, v, tau, rates) = rotation_matrix(state.p), self._coordinates(state)
        if self.use_kkt_inverse or model.has_loops or not all(kind.is_spherical for kind in model.kinds):
            reaction, moment, _ = self._solve_constraint_rows(q, v, tau)
        else:
            pin.constraintDynamics(engine, data, q, v, tau, self.contacts, self.contact_data)
            reaction = rotate_vectors(turn, np.array([one.contact_force.linear for one in self.contact_data]))
            moment = np.zeros_like(reaction)
        a = data.ddq.reshape(-1, 6)
        inertia = pin.crba(engine, data, q)
        return StateQuantities(
            acceleration=rotate_vectors(turn, a[:, :3] + np.cross(state.omega, v.reshape(-1, 6)[:, :3])),
            angular_acceleration=a[:, 3:].copy(),
            joint_reaction=reaction,
            joint_moment=moment,
            mass_matrix=rates.T @ inertia @ rates,
            **energies_and_momentum(engine, data, q, v),
        )

    def written(self, state: State) -> dict[str, Any]:
        """Return bodies, joints' points and directions, and the state with its loads, as numbers."""
        model = self.source_model
        masses = [
            (k + 1, part.centre, float(part.mass), part.inertia)
            for k, own in enumerate(self.parts)
            for part in own
        ]
        q, v, tau, rates = self._coordinates(state)
        kept = self._solve_constraint_rows(q, v, tau)[2]
        fields = {"q": q, "v": v, "torque": tau, "joint_rates": rates, "kept": kept}
        fields |= {"omega": state.omega, "A": rotation_matrix(state.p)}
        joints = []
        for k, (kind, bodies) in enumerate(zip(model.kinds, model.body + 1, strict=True)):
            bend = model.length[k] * self.udot[k] @ self.udot[k] if kind.holds_distance else 0.0
            ends = list(zip(bodies.tolist(), model.point[k], strict=True))
            joints.append((ends, self._held_directions(k), self.allowed[k], bend, kind.has_attitude))
        uses_contacts = all(kind.is_spherical for kind in model.kinds) and not model.has_loops
        return {"joints": joints, "masses": masses, "contacts": uses_contacts, "fields": fields}

    def _solve_constraint_rows(self, q: Array, v: Array, tau: Array) -> tuple[Array, Array, Indices]:
        """Solve with rows built here into ``data.ddq``; return forces, moments (N, 3) and rows used."""
        engine, data, model = self.pin_model, self.data, self.source_model
        pin.forwardKinematics(engine, data, q, v, np.zeros(engine.nv))
        pin.computeJointJacobians(engine, data, q)
        pin.updateFramePlacements(engine, data)
        rows, drifts, directions = [np.zeros((0, engine.nv))], [np.zeros(0)], []
        for k in range(len(model.kind)):
            jacobian, drift = self._relative_motion(k)
            held = self._held_directions(k)
            rows.append(held @ jacobian)
            bend = held @ drift
            if model.rods[k]:
                bend = bend + model.length[k] * self.udot[k] @ self.udot[k]
            drifts.append(bend)
            directions.append(held)
        constraints, bend = np.vstack(rows), np.concatenate(drifts)
        kept = independent_rows(constraints) if model.has_loops else np.arange(len(bend))
        multiplier = np.zeros(len(bend))
        constraints, bend = constraints[kept], bend[kept]
        if self.use_kkt_inverse:
            force = tau - pin.nonLinearEffects(engine, data, q, v)
            inverse = pin.computeKKTContactDynamicMatrixInverse(engine, data, q, constraints, 0.0)
            x = inverse @ np.concatenate([force, -bend])
            data.ddq, multiplier[kept] = x[: engine.nv], -x[engine.nv :]
        else:
            pin.forwardDynamics(engine, data, q, v, tau, constraints, bend, 0.0)
            multiplier[kept] = data.lambda_c
        parts = np.split(multiplier, np.cumsum([len(held) for held in directions])[:-1])
        wrench = np.array([held.T @ part for held, part in zip(directions, parts, strict=True)])
        return wrench[:, :3], wrench[:, 3:], kept

    def _relative_motion(self, k: int) -> tuple[Array, Array]:
        """Jacobian (6, nv) of joint k, and its acceleration at v̇ = 0 less what allowed rates cause.

        Of the near point against the point of the far body where it is, and of the angular velocity.  The
        rates ṡ of slides and Ω of turns, each carried by the angular velocity w of those before, cause the
        relative accelerations 2 ω_far × ṡ and Σ w × Ω.
        """
        engine, data, model = self.pin_model, self.data, self.source_model
        frames = self.near_frames[k], self.far_frames[k]
        j_near, j_far = (pin.getFrameJacobian(engine, data, f, WORLD_ALIGNED) for f in frames)
        drift_near, drift_far = (
            np.concatenate([
                point_acceleration(engine, data, f),
                pin.getFrameAcceleration(engine, data, f, WORLD_ALIGNED).angular,
            ])
            for f in frames
        )  # fmt: skip
        jacobian, drift = j_near - j_far, drift_near - drift_far
        self.allowed[k] = 0.0
        if model.kinds[k].has_attitude:
            return jacobian, drift
        placements = [data.oMf[f] for f in frames]
        d = placements[0].translation - placements[1].translation
        spin = pin.getFrameVelocity(engine, data, frames[1], WORLD_ALIGNED).angular
        jacobian[:3] -= -pin.skew(d) @ j_far[3:]
        drift[:3] -= np.cross(drift_far[3:], d) + np.cross(spin, np.cross(spin, d))
        carried = spin.copy()
        joint = JointFrame(model, k, placements[1].rotation)
        for (_, along, about), rate in zip(joint.axes(self.x[k]), self.xdot[k], strict=False):
            if along is not None:
                self.allowed[k, :3] += 2 * np.cross(spin, along * rate)
            if about is not None:
                self.allowed[k, 3:] += np.cross(carried, about * rate)
                carried = carried + about * rate
        return jacobian, drift - self.allowed[k]

    def _held_directions(self, k: int) -> Array:
        """Rows (c, 6) of the near point's velocity and of the angular velocity that joint k holds."""
        model, kind = self.source_model, self.source_model.kinds[k]
        if kind.has_attitude:
            push = self.u[k : k + 1] if kind.holds_distance else np.eye(3)[: len(kind.rows)]
            return np.hstack([push, 0 * push])
        far = self.data.oMf[self.far_frames[k]].rotation
        axes = JointFrame(model, k, far).axes(self.x[k])
        pushes = _complement([axis for axis, along, _ in axes if along is not None])
        turns = _complement([axis for axis, _, about in axes if about is not None])
        held = [np.hstack([pushes, 0 * pushes]), np.hstack([0 * turns, turns])]
        if kind.has_pitch:
            axis = axes[0].axis
            held.append(np.array([[*axis, *(-model.length[k] * axis)]]))
        return np.vstack(held)


def _complement(axes: list[Array]) -> Array:
    """Orthonormal vectors (3 − m, 3) perpendicular to m independent ones."""
    return np.linalg.svd(np.reshape(axes, (-1, 3)))[2][len(axes) :]


class PinocchioMaximal(PinocchioAdapter):
    """Pinocchio's constrained dynamics of free bodies; evaluates states, does not integrate."""

    name = "pinocchio-maximal"
    title = "Pinocchio, maximal coordinates"
    reproduction_template = "pinocchio-maximal"
    other_formulation = "pinocchio"
    integrators = ()
    unsupported: ClassVar[Mapping[str, str]] = {
        "integrators": "Pinocchio in maximal coordinates is compared at state level only"
    }
    gaps: ClassVar[Mapping[str, str]] = {
        "bodies": "the engine's workspace grows with the cube of the number of free bodies",
        "point masses": "Pinocchio's constraint solvers invert the mass matrix, singular for bodies "
        "without inertia",
    }
    builds_trees = True
    options = loop_options = unwritten_ways = ("inverse of the KKT matrix",)

    def written(self, model: Model, state: State, moves: bool = False) -> dict[str, Any]:
        """Return the numbers of the engine's model at a state, see `_FreeFlyerSystem.written`."""
        return _FreeFlyerSystem(model, self.body_pieces(model)).written(state)

    def _evaluate(self, model: Model, states: Sequence[State]) -> list[StateQuantities]:
        if model.n > MAX_BODIES:
            raise Unsupported(
                f"the engine's workspace for {model.n} free bodies, growing with their cube, is too large; "
                f"in maximal coordinates Pinocchio is asked about {MAX_BODIES} at most",
                "bodies",
            )
        flyers = _FreeFlyerSystem(model, self.body_pieces(model), use_kkt_inverse=bool(self.option))
        return [flyers.quantities(state) for state in states]
