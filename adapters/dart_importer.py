"""DART's importers of URDF (DartLoader) and MJCF files (MjcfParser).

A body of the reading is a body node; the skeletons of a world stand one after another.  Massless bodies that
the MJCF parser makes up, between several joints of a body, are merged into that body.  T_P, T_C: a joint's
frame in the parent's and in the child's body node; J: its relative Jacobian (ω, v in body axes).

    hinge, slide    q = x
    ball            R(q) = R_Pᵀ R_zero R(x) R_C;  v_e = T v with T = J_ω⁻¹,  Ṫv = −T J̇_ω v_e
    free            X(q) = T_P⁻¹ X(x) T_C;  J v_e = D v with D v = (ω, R_Bᵀ ṙ), so that
                    T = J⁻¹D,  Ṫv = J⁻¹((0, −ω × R_Bᵀ ṙ) − J̇ v_e)

    h  getCoriolisAndGravityForces     h(v = 0)  getGravityForces     v̇  computeForwardDynamics
    f  −damping v − stiffness (q − rest position), the coefficients of DART's joints

`computeForwardDynamics` treats dampers and springs implicitly, by the time step: it is set to zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import dartpy as dart
import numpy as np
from scipy.linalg import block_diag

from adapters.importer_common import (
    LayoutWithOwnVelocities,
    LoadingImporter,
    Refused,
    depth_first,
    joint_from_screw,
    make_body,
    make_joint,
    merge_made_up_bodies,
    names_of_parts,
    pose_of_coordinates,
)
from plumbline.importers.importer import ModelFile
from plumbline.importers.neutral_model import ElementaryJoint, ModelQuantities, NeutralBody
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import rotation_matrix

# Joints with several degrees of freedom, a hinge or slide each; DART keeps one name for all.
MULTIPLE_JOINTS = (
    "PlanarJoint", "UniversalJoint", "EulerJoint", "TranslationalJoint", "TranslationalJoint2D",
)  # fmt: skip


class _Layout(LayoutWithOwnVelocities):
    """Skeletons; a joint's own: DART's joint, the first of its degrees of freedom there, and R_zero."""

    def _gravity(self) -> Any:
        return self.loaded[0].getGravity()

    def _bodies(self) -> list[NeutralBody]:
        bodies: list[NeutralBody] = []
        start = 0
        self.nodes: list[Any] = []
        for skeleton in self.loaded:
            skeleton.setTimeStep(0.0)
            index: dict[str, int] = {}
            for node in _depth_first(skeleton):
                index[node.getName()] = len(bodies)
                bodies.append(self._body(node, index, start))
                self.nodes.append(node)
            start += skeleton.getNumDofs()
        return merge_made_up_bodies(bodies, self.file)

    def _body(self, node: Any, index: dict[str, int], start: int) -> NeutralBody:
        joint, parent, inertia = node.getParentJoint(), node.getParentBodyNode(), node.getInertia()
        T_P, T_C = _frames(joint)
        zero = T_P @ np.linalg.inv(T_C)
        body = make_body(
            node.getName(), -1 if parent is None else index[parent.getName()], zero,
            self._joints(node, joint, T_C), inertia.getMass(), inertia.getLocalCOM(), inertia.getMoment(),
        )  # fmt: skip
        for k, found in enumerate(body.joints):
            dofs = range(joint.getNumDofs()) if found.kind in ("ball", "free") else [k]
            rows = [start + joint.getIndexInSkeleton(dof) for dof in dofs]
            self.places.append(((joint, k, rotation_matrix(body.attitude)), rows))
        return body

    def _joints(self, node: Any, joint: Any, T_C: Array) -> list[ElementaryJoint]:
        kind, name = joint.getType(), joint.getName()
        if kind == "WeldJoint":
            return []
        if kind == "FreeJoint" and node.getParentBodyNode() is None:
            return [self._free_joint(node.getName())]
        if kind == "BallJoint":
            return [make_joint(name, "ball", anchor=T_C[:3, 3], **_numbers(joint, 0))]
        if kind == "RevoluteJoint":
            axis = T_C[:3, :3] @ joint.getAxis()
            return [make_joint(name, "hinge", axis, T_C[:3, 3], **_numbers(joint, 0))]
        if kind == "PrismaticJoint":
            axis = T_C[:3, :3] @ joint.getAxis()
            return [joint_from_screw(name, np.zeros(3), axis, **_numbers(joint, 0))]
        if kind not in MULTIPLE_JOINTS:
            raise NotImplementedError(f"a joint of type {kind}")
        joint.resetPositions()
        screws = np.array(joint.getRelativeJacobian()).T
        names = names_of_parts(self.file, node.getName(), name, len(screws))
        return [
            joint_from_screw(own, screw[:3], screw[3:], **_numbers(joint, k))
            for k, (own, screw) in enumerate(zip(names, screws, strict=True))
        ]

    def _move(self, joint: ElementaryJoint, own: Any, x: Array, v: Array) -> tuple[Any, Any]:
        dart_joint, first, R_zero = own
        T_P, T_C = _frames(dart_joint)
        if joint.kind == "free":
            X = pose_of_coordinates(x)
            there = dart.math.Isometry3(np.linalg.inv(T_P) @ X @ T_C)
            dart_joint.setPositions(dart.dynamics.FreeJoint.convertToPositions(there))
            D = np.zeros((6, 6))
            D[:3, 3:], D[3:, :3] = np.eye(3), X[:3, :3].T
            J = np.array(dart_joint.getRelativeJacobian())
            block = np.linalg.solve(J, D)
            dart_joint.setVelocities(block @ v)
            convective = np.concatenate([np.zeros(3), -np.cross(v[3:], X[:3, :3].T @ v[:3])])
            Jdot = np.array(dart_joint.getRelativeJacobianTimeDeriv())
            return block, np.linalg.solve(J, convective - Jdot @ block @ v)
        if joint.kind == "ball":
            R = T_P[:3, :3].T @ R_zero @ rotation_matrix(x) @ T_C[:3, :3]
            dart_joint.setPositions(dart.dynamics.BallJoint.convertToPositions(R))
            block = np.linalg.inv(np.array(dart_joint.getRelativeJacobian())[:3])
            dart_joint.setVelocities(block @ v)
            return block, -block @ np.array(dart_joint.getRelativeJacobianTimeDeriv())[:3] @ block @ v
        dart_joint.setPosition(first, float(x[0]))
        return 1.0, 0.0

    def _engine_quantities(self, v: Array) -> ModelQuantities:
        ends = np.cumsum([skeleton.getNumDofs() for skeleton in self.loaded])
        for skeleton, values in zip(self.loaded, np.split(v, ends[:-1]), strict=True):
            skeleton.setVelocities(values)
            skeleton.computeForwardDynamics()
        poses = {node.getName(): np.array(node.getWorldTransform().matrix())[:3] for node in self.nodes}
        # DART's potential energy counts springs too
        is_sprung = any(joint.stiffness for joint in self.model.joints)
        return ModelQuantities(
            poses,
            block_diag(*[skeleton.getMassMatrix() for skeleton in self.loaded]),
            self._joined("getCoriolisAndGravityForces"),
            self._joined("getGravityForces"),
            self._passive_force(v),
            self._joined("getAccelerations"),
            float(sum(skeleton.computeKineticEnergy() for skeleton in self.loaded)),
            None if is_sprung else float(sum(s.computePotentialEnergy() for s in self.loaded)),
        )

    def _joined(self, method: str) -> Array:
        return np.concatenate([np.array(getattr(skeleton, method)()) for skeleton in self.loaded])

    def _passive_force(self, v: Array) -> Array:
        force = np.zeros(len(v))
        for (joint, first, _), rows in self.places:
            for dof, row in enumerate(rows, start=first):
                stretch = joint.getPosition(dof) - joint.getRestPosition(dof)
                force[row] = (
                    -joint.getDampingCoefficient(dof) * joint.getVelocity(dof)
                    - joint.getSpringStiffness(dof) * stretch
                )
        return force


class DartImporter(LoadingImporter):
    """DART's URDF loader and MJCF parser."""

    name = "dart"
    title = "DART"
    package = "dartpy"
    formats = ("urdf", "mjcf")
    environment = ".importers"
    layout = _Layout

    def _load(self, file: ModelFile) -> Any:
        if file.format == "mjcf":
            world = dart.utils.MjcfParser.readWorld(file.path)
            skeletons = [world.getSkeleton(k) for k in range(world.getNumSkeletons())] if world else []
        else:
            kinds = dart.utils.DartLoaderRootJointType
            root = kinds.FIXED if file.base == "fixed" else kinds.FLOATING
            loader = dart.utils.DartLoader()
            loader.setOptions(dart.utils.DartLoaderOptions(defaultRootJointType=root))
            skeletons = [skeleton] if (skeleton := loader.parseSkeleton(file.path)) else []
        if not skeletons:
            raise Refused
        return skeletons

    def _refusal_words(self, refusal: str, printed: Sequence[str]) -> str:
        reasons = [line for line in printed if "Error" in line] or printed
        return " ".join(reasons) or "no skeleton was made of the file"


def _depth_first(skeleton: Any) -> list[Any]:
    """DART's order of body nodes has parents first, not always depth first."""
    nodes = [skeleton.getBodyNode(i) for i in range(skeleton.getNumBodyNodes())]
    roots = [node for node in nodes if node.getParentBodyNode() is None]
    return list(
        depth_first(roots, lambda n: [n.getChildBodyNode(k) for k in range(n.getNumChildBodyNodes())])
    )


def _numbers(joint: Any, k: int) -> dict[str, float]:
    return {
        "damping": joint.getDampingCoefficient(k),
        "stiffness": joint.getSpringStiffness(k),
        "spring_reference": joint.getRestPosition(k),
        "friction_loss": joint.getCoulombFriction(k),
    }


def _frames(joint: Any) -> tuple[Array, Array]:
    """T_P and T_C (4, 4)."""
    above, below = joint.getTransformFromParentBodyNode(), joint.getTransformFromChildBodyNode()
    return np.array(above.matrix()), np.array(below.matrix())
