"""Pinocchio's importers of URDF and MJCF files.

A body of the reading is a joint of the compiled model: links on fixed joints are lumped into its inertia.
J: the joint's frame; B: the frame of its body, B = J P with the frame's placement P.

    hinge, slide    q = x;  a continuous joint has q = (cos x, sin x)
    ball            R(q) = R_P R(x) R_Pᵀ, scalar last;  v_e = R_P v
    free            X(q) = O⁻¹ X(x) P⁻¹, scalar last;  v_e = Ad_P (R_Bᵀ ṙ, ω),  so that
                    T = Ad_P diag(R_Bᵀ, 1),  Ṫv = Ad_P (−ω × R_Bᵀ ṙ, 0).  O is the joint's origin in a URDF,
                    from which its coordinates count, and nothing in an MJCF, where they are in the world

Parts of a composite joint (several joints in an MJCF body) are not exposed to Python: their screws at q = 0
are the columns of its motion subspace, and their names come from the file, as Pinocchio keeps only one.
Damping is in the model, and no routine of Pinocchio applies it; `aba` is called without forces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pinocchio as pin

from adapters.importer_common import (
    LoadingImporter,
    Refused,
    free_joint_name,
    joint_from_screw,
    joint_names,
    make_joint,
    pose,
    pose_of_coordinates,
    quaternion_of,
    to_canonical,
)
from plumbline.importers.importer import ModelFile
from plumbline.importers.neutral_model import (
    CanonicalState,
    ElementaryJoint,
    ModelQuantities,
    NeutralBody,
    NeutralModel,
)
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import rotation_matrix


class PinocchioImporter(LoadingImporter):
    """Pinocchio's URDF and MJCF parsers."""

    name = "pinocchio"
    title = "Pinocchio"
    package = "pin"
    formats = ("urdf", "mjcf")
    supported_versions = ">=3.3.1,<5"
    extra_requirements = (("<4", "cmeel-urdfdom<5"), ("<4", "cmeel-tinyxml2<11"))
    unsupported: ClassVar[dict[str, str]] = {
        "passive_force": "no routine of Pinocchio applies the damping that its models hold",
    }

    def _load(self, file: ModelFile) -> Any:
        try:
            return _parsed(file)
        except Exception as error:  # ValueError, RuntimeError and exceptions of Boost
            raise Refused(str(error) or type(error).__name__) from None

    def _describe(self, loaded: Any, file: ModelFile) -> NeutralModel:
        return NeutralModel(loaded.name, _Layout(loaded, file).bodies(), np.array(loaded.gravity.linear))

    def _evaluate(
        self, loaded: Any, file: ModelFile, states: Sequence[CanonicalState]
    ) -> list[ModelQuantities]:
        layout = _Layout(loaded, file)
        return [layout.quantities(state) for state in states]


def _parsed(file: ModelFile) -> Any:
    if file.format == "mjcf":
        return pin.buildModelFromMJCF(file.path)
    if file.base == "fixed":
        return pin.buildModelFromUrdf(file.path)
    return pin.buildModelFromUrdf(file.path, pin.JointModelFreeFlyer())


@dataclass(frozen=True, eq=False)
class _Place:
    """Where a joint's coordinates are in Pinocchio's vectors and in the canonical ones."""

    kind: str  # scalars, continuous, ball or free
    body: NeutralBody
    placement: Any  # of the body's frame in the joint's frame
    origin: Any  # from which a free joint's coordinates count, as the format says
    q: slice
    v: slice
    x: slice
    rate: slice


class _Layout:
    """A parsed model with the order of its joints in the reading."""

    def __init__(self, model: Any, file: ModelFile) -> None:
        self.m = model
        self.data = model.createData()
        self.q_neutral = pin.neutral(model)
        pin.computeJointJacobians(model, self.data, self.q_neutral)
        self.body_frames = [f for f in model.frames if f.type == pin.FrameType.BODY]
        self.file = file
        names = joint_names(file) if file.format == "mjcf" else {}
        self.places: list[_Place] = []
        x = rate = 0
        for j in range(1, model.njoints):  # Pinocchio's order is depth first
            frame = self._frame(j)
            body = self._body(j, frame, names)
            nq, nv, iq, iv = model.nqs[j], model.nvs[j], model.idx_qs[j], model.idx_vs[j]
            kind = self._kind(j)
            nx = nv if kind == "continuous" else nq
            origin = model.jointPlacements[j] if file.format == "urdf" else pin.SE3.Identity()
            self.places.append(
                _Place(
                    kind, body, frame.placement, origin,
                    slice(iq, iq + nq), slice(iv, iv + nv), slice(x, x + nx), slice(rate, rate + nv),
                )
            )  # fmt: skip
            x, rate = x + nx, rate + nv

    def bodies(self) -> tuple[NeutralBody, ...]:
        return tuple(place.body for place in self.places)

    def _kind(self, j: int) -> str:
        short, nq, nv = self.m.joints[j].shortname(), self.m.nqs[j], self.m.nvs[j]
        if "FreeFlyer" in short:
            if self.m.parents[j] != 0:
                raise NotImplementedError("a free joint of a body that has a parent")
            return "free"
        if short == "JointModelSpherical":
            return "ball"
        if nq == nv and (nv == 1 or "Composite" in short):
            return "scalars"
        if (nq, nv) == (2, 1):
            return "continuous"
        raise NotImplementedError(f"a joint of type {short} with {nq} coordinates and {nv} velocities")

    def _frame(self, j: int) -> Any:
        """The frame of the body that the joint moves: the first one added to it."""
        frame = next((f for f in self.body_frames if f.parentJoint == j), None)
        if frame is None:
            raise NotImplementedError(f"joint {self.m.names[j]!r}, which moves no body")
        return frame

    def _body(self, j: int, frame: Any, names: dict[str, list[str]]) -> NeutralBody:
        m, P = self.m, frame.placement
        parent = m.parents[j]
        above = self._frame(parent).placement.inverse() if parent else pin.SE3.Identity()
        zero = above * m.jointPlacements[j] * P
        kind = self._kind(j)
        if kind == "free":
            joints: tuple[ElementaryJoint, ...] = (
                make_joint(free_joint_name(frame.name, self.file), "free"),
            )
        elif kind == "ball":
            joints = (make_joint(m.names[j], "ball", anchor=P.inverse().translation),)
        else:
            joints = self._elementary_joints(j, P, names.get(frame.name, []))
        joints = tuple(
            self._with_passive_fields(joint, int(m.idx_vs[j]) + k) for k, joint in enumerate(joints)
        )
        inertia = P.actInv(m.inertias[j])
        return NeutralBody(
            frame.name, parent - 1, np.array(zero.translation), quaternion_of(zero.rotation), joints,
            float(inertia.mass), np.array(inertia.lever), np.array(inertia.inertia),
        )  # fmt: skip

    def _elementary_joints(self, j: int, P: Any, names: list[str]) -> tuple[ElementaryJoint, ...]:
        """Hinges and slides by the columns of the motion subspace at q = 0."""
        S, own = np.array(self.data.joints[j].S).reshape(6, -1), self.m.names[j]
        if S.shape[1] == 1:
            names = [own]
        elif len(names) != S.shape[1]:
            names = [f"{own}/{k}" for k in range(S.shape[1])]
        joints = []
        for name, column in zip(names, S.T, strict=True):
            screw = P.actInv(pin.Motion(column))
            joint = joint_from_screw(name, np.array(screw.angular), np.array(screw.linear))
            if joint.kind == "hinge" and len(names) == 1:
                joint = replace(joint, anchor=np.array(P.inverse().translation))
            joints.append(joint)
        return tuple(joints)

    def _with_passive_fields(self, joint: ElementaryJoint, v: int) -> ElementaryJoint:
        m = self.m
        friction = m.upperDryFrictionLimit if hasattr(m, "upperDryFrictionLimit") else m.friction
        return replace(
            joint,
            armature=float(m.armature[v]),
            damping=float(m.damping[v]),
            friction_loss=float(friction[v]),
        )

    def quantities(self, state: CanonicalState) -> ModelQuantities:
        """Evaluate Pinocchio's routines at one state."""
        m, d = self.m, self.data
        q, v, T, Tdot_v = self._engine_state(state)
        M = np.triu(pin.crba(m, d, q))  # the lower triangle is not filled before version 3.6
        M = M + np.triu(M, 1).T
        bias = np.array(pin.nonLinearEffects(m, d, q, v))
        gravity = np.array(pin.computeGeneralizedGravity(m, d, q))
        acceleration = np.array(pin.aba(m, d, q, v, np.zeros(m.nv)))
        kinetic = float(pin.computeKineticEnergy(m, d, q, v))
        potential = float(pin.computePotentialEnergy(m, d, q))
        pin.framesForwardKinematics(m, d, q)
        placements = ((f.name, d.oMi[f.parentJoint] * f.placement) for f in self.body_frames if f.parentJoint)
        poses = {name: pose(placement.rotation, placement.translation) for name, placement in placements}
        engine = ModelQuantities(poses, M, bias, gravity, None, acceleration, kinetic, potential)
        return to_canonical(engine, T, Tdot_v)

    def _engine_state(self, state: CanonicalState) -> tuple[Array, Array, Array, Array]:
        """The engine's q and v, T and Ṫv, by the equations of the module's docstring."""
        q = np.array(self.q_neutral)
        n = self.m.nv
        T, Tdot_v = np.zeros((n, n)), np.zeros(n)
        for place in self.places:
            x, rate = state.coordinates[place.x], state.velocities[place.rate]
            block, turned = np.eye(len(rate)), np.zeros(len(rate))
            P = place.placement
            if place.kind == "scalars":
                q[place.q] = x
            elif place.kind == "continuous":
                q[place.q] = np.cos(x[0]), np.sin(x[0])
            elif place.kind == "ball":
                block = np.array(P.rotation)
                q[place.q] = _scalar_last(block @ rotation_matrix(x) @ block.T)
            else:
                X = place.origin.inverse() * pin.SE3(pose_of_coordinates(x)) * P.inverse()
                q[place.q] = [*X.translation, *_scalar_last(X.rotation)]
                R_T = rotation_matrix(x[3:]).T
                turned = P.action @ np.concatenate([-np.cross(rate[3:], R_T @ rate[:3]), np.zeros(3)])
                block[:3, :3] = R_T
                block = P.action @ block
            T[place.v, place.rate] = block
            Tdot_v[place.v] = turned
        return q, T @ state.velocities, T, Tdot_v


def _scalar_last(rotation: Array) -> Array:
    return np.roll(quaternion_of(rotation), -1)
