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

from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
import pinocchio as pin

from adapters.importer_common import (
    LayoutWithOwnVelocities,
    LoadingImporter,
    Refused,
    joint_from_screw,
    make_body,
    make_joint,
    names_of_parts,
    pose,
    pose_of_coordinates,
)
from plumbline.importers.importer import ModelFile
from plumbline.importers.neutral_model import ElementaryJoint, ModelQuantities, NeutralBody
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import quaternion_of, rotation_matrix


class _Layout(LayoutWithOwnVelocities):
    """A parsed model; a joint's own: P, O, whether it is continuous, and its places in q."""

    def __init__(self, model: Any, file: ModelFile) -> None:
        self.m, self.name = model, model.name
        self.data = model.createData()
        self.q = pin.neutral(model)
        pin.computeJointJacobians(model, self.data, self.q)
        self.body_frames = [f for f in model.frames if f.type == pin.FrameType.BODY]
        super().__init__(model, file)

    def _gravity(self) -> Any:
        return self.m.gravity.linear

    def _bodies(self) -> Iterator[NeutralBody]:
        for j in range(1, self.m.njoints):  # Pinocchio's order is depth first
            yield self._body(j, self._frame(j))

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

    def _body(self, j: int, frame: Any) -> NeutralBody:
        m, P, parent = self.m, frame.placement, self.m.parents[j]
        above = self._frame(parent).placement.inverse() if parent else pin.SE3.Identity()
        zero, inertia = above * m.jointPlacements[j] * P, P.actInv(m.inertias[j])
        return make_body(
            frame.name, parent - 1, zero.homogeneous, self._joints(j, frame),
            inertia.mass, inertia.lever, inertia.inertia,
        )  # fmt: skip

    def _joints(self, j: int, frame: Any) -> Iterator[ElementaryJoint]:
        """Hinges and slides by the columns of the motion subspace at q = 0."""
        m, P, kind, own = self.m, frame.placement, self._kind(j), self.m.names[j]
        S = np.array(self.data.joints[j].S).reshape(6, -1)
        anchor, q, v = P.inverse().translation, m.idx_qs[j], m.idx_vs[j]
        origin = m.jointPlacements[j] if self.file.format == "urdf" else pin.SE3.Identity()
        if kind in ("free", "ball"):
            place = P, origin, False, slice(q, q + m.nqs[j])
            self.places.append((place, slice(v, v + m.nvs[j])))
            numbers = self._numbers(v)
            if kind == "free":
                yield self._free_joint(frame.name, **numbers)
            else:
                yield make_joint(own, "ball", anchor=anchor, **numbers)
            return
        names = [own] if m.nvs[j] == 1 else names_of_parts(self.file, frame.name, own, m.nvs[j])
        for k, (name, column) in enumerate(zip(names, S.T, strict=True)):
            at = slice(q, q + 2) if kind == "continuous" else slice(q + k, q + k + 1)
            self.places.append(((P, origin, kind == "continuous", at), slice(v + k, v + k + 1)))
            screw, numbers = P.actInv(pin.Motion(column)), self._numbers(v + k)
            joint = joint_from_screw(name, screw.angular, screw.linear, **numbers)
            is_alone = joint.kind == "hinge" and len(names) == 1
            yield make_joint(name, "hinge", joint.axis, anchor, **numbers) if is_alone else joint

    def _numbers(self, v: int) -> dict[str, float]:
        m = self.m
        friction = m.upperDryFrictionLimit if hasattr(m, "upperDryFrictionLimit") else m.friction
        return {"armature": m.armature[v], "damping": m.damping[v], "friction_loss": friction[v]}

    def _move(self, joint: ElementaryJoint, own: Any, x: Array, v: Array) -> tuple[Any, Any]:
        P, origin, is_continuous, at = own
        if joint.kind == "ball":
            block = np.array(P.rotation)
            self.q[at] = _scalar_last(block @ rotation_matrix(x) @ block.T)
            return block, 0.0
        if joint.kind == "free":
            X = origin.inverse() * pin.SE3(pose_of_coordinates(x)) * P.inverse()
            self.q[at] = [*X.translation, *_scalar_last(X.rotation)]
            block, R_T = np.eye(6), rotation_matrix(x[3:]).T
            block[:3, :3] = R_T
            turned = np.concatenate([-np.cross(v[3:], R_T @ v[:3]), np.zeros(3)])
            return P.action @ block, P.action @ turned
        self.q[at] = (np.cos(x[0]), np.sin(x[0])) if is_continuous else x
        return 1.0, 0.0

    def _engine_quantities(self, v: Array) -> ModelQuantities:
        m, d, q = self.m, self.data, self.q
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
        return ModelQuantities(poses, M, bias, gravity, None, acceleration, kinetic, potential)


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
    layout = _Layout

    def _load(self, file: ModelFile) -> Any:
        try:
            if file.format == "mjcf":
                return pin.buildModelFromMJCF(file.path)
            root = () if file.base == "fixed" else (pin.JointModelFreeFlyer(),)
            return pin.buildModelFromUrdf(file.path, *root)
        except Exception as error:  # ValueError, RuntimeError and exceptions of Boost
            raise Refused(str(error) or type(error).__name__) from None


def _scalar_last(rotation: Array) -> Array:
    return np.roll(quaternion_of(rotation), -1)
