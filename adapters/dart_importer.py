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
from dataclasses import dataclass, replace
from typing import Any

import dartpy as dart
import numpy as np

from adapters.importer_common import (
    LoadingImporter,
    Refused,
    free_joint_name,
    joint_from_screw,
    joint_names,
    make_joint,
    merge_made_up_bodies,
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

# Joints with several degrees of freedom, a hinge or slide each; DART keeps one name for all.
MULTIPLE_JOINTS = (
    "PlanarJoint", "UniversalJoint", "EulerJoint", "TranslationalJoint", "TranslationalJoint2D",
)  # fmt: skip


class DartImporter(LoadingImporter):
    """DART's URDF loader and MJCF parser."""

    name = "dart"
    title = "DART"
    package = "dartpy"
    formats = ("urdf", "mjcf")
    environment = ".importers"

    def _load(self, file: ModelFile) -> Any:
        skeletons = _loaded(file)
        if not skeletons:
            raise Refused
        return skeletons

    def _describe(self, loaded: Any, file: ModelFile) -> NeutralModel:
        return NeutralModel("", _Layout(loaded, file).bodies, np.array(loaded[0].getGravity()))

    def _evaluate(
        self, loaded: Any, file: ModelFile, states: Sequence[CanonicalState]
    ) -> list[ModelQuantities]:
        layout = _Layout(loaded, file)
        return [layout.quantities(state) for state in states]

    def _refusal_words(self, refusal: str, printed: Sequence[str]) -> str:
        reasons = [line for line in printed if "Error" in line] or printed
        return " ".join(reasons) or "no skeleton was made of the file"


def _loaded(file: ModelFile) -> list[Any]:
    if file.format == "mjcf":
        world = dart.utils.MjcfParser.readWorld(file.path)
        return [world.getSkeleton(k) for k in range(world.getNumSkeletons())] if world else []
    kinds = dart.utils.DartLoaderRootJointType
    root = kinds.FIXED if file.base == "fixed" else kinds.FLOATING
    loader = dart.utils.DartLoader()
    loader.setOptions(dart.utils.DartLoaderOptions(defaultRootJointType=root))
    skeleton = loader.parseSkeleton(file.path)
    return [skeleton] if skeleton else []


@dataclass(frozen=True, eq=False)
class _Place:
    """A joint of the reading, DART's joint, and the places of its velocities in DART's order."""

    joint: ElementaryJoint
    dart: Any
    body: NeutralBody
    skeleton: int
    v: list[int]  # in its skeleton


class _Layout:
    """Skeletons with the order of their bodies and joints in the reading."""

    def __init__(self, skeletons: list[Any], file: ModelFile) -> None:
        self.skeletons, self.file = skeletons, file
        self.places: list[_Place] = []
        bodies: list[NeutralBody] = []
        for s, skeleton in enumerate(skeletons):
            skeleton.setTimeStep(0.0)
            first = len(bodies)
            index: dict[str, int] = {}
            for node in _depth_first(skeleton):
                index[node.getName()] = len(bodies)
                bodies.append(self._body(node, index, s))
            assert len(bodies) - first == skeleton.getNumBodyNodes()
        self.bodies = tuple(merge_made_up_bodies(bodies, file))

    def _body(self, node: Any, index: dict[str, int], s: int) -> NeutralBody:
        joint, parent = node.getParentJoint(), node.getParentBodyNode()
        T_P, T_C = _frames(joint)
        zero = T_P @ np.linalg.inv(T_C)
        inertia = node.getInertia()
        body = NeutralBody(
            node.getName(), -1 if parent is None else index[parent.getName()], zero[:3, 3].copy(),
            quaternion_of(zero[:3, :3]), self._joints(node, joint, T_C), float(inertia.getMass()),
            np.array(inertia.getLocalCOM()), np.array(inertia.getMoment()),
        )  # fmt: skip
        for k, found in enumerate(body.joints):
            dofs = range(joint.getNumDofs()) if found.kind in ("ball", "free") else [k]
            places = [joint.getIndexInSkeleton(dof) for dof in dofs]
            self.places.append(_Place(found, joint, body, s, places))
        return body

    def _joints(self, node: Any, joint: Any, T_C: Array) -> tuple[ElementaryJoint, ...]:
        kind, name = joint.getType(), joint.getName()
        if kind == "WeldJoint":
            return ()
        if kind == "FreeJoint" and node.getParentBodyNode() is None:
            return (make_joint(free_joint_name(node.getName(), self.file), "free"),)
        if kind == "BallJoint":
            joints: tuple[ElementaryJoint, ...] = (make_joint(name, "ball", anchor=T_C[:3, 3]),)
        elif kind == "RevoluteJoint":
            joints = (make_joint(name, "hinge", T_C[:3, :3] @ joint.getAxis(), T_C[:3, 3]),)
        elif kind == "PrismaticJoint":
            joints = (joint_from_screw(name, np.zeros(3), T_C[:3, :3] @ joint.getAxis()),)
        elif kind in MULTIPLE_JOINTS:
            joint.resetPositions()
            screws = np.array(joint.getRelativeJacobian()).T
            names = joint_names(self.file).get(node.getName(), []) if self.file.format == "mjcf" else []
            if len(names) != len(screws):
                names = [f"{name}/{k}" for k in range(len(screws))]
            joints = tuple(joint_from_screw(n, s[:3], s[3:]) for n, s in zip(names, screws, strict=True))
        else:
            raise NotImplementedError(f"a joint of type {kind}")
        return tuple(
            replace(
                found,
                damping=float(joint.getDampingCoefficient(k)),
                stiffness=float(joint.getSpringStiffness(k)),
                spring_reference=float(joint.getRestPosition(k)),
                friction_loss=float(joint.getCoulombFriction(k)),
            )
            for k, found in enumerate(joints)
        )

    def quantities(self, state: CanonicalState) -> ModelQuantities:
        """Evaluate DART's routines at one state."""
        T, Tdot_v = self._set_state(state)
        v = T @ state.velocities
        for skeleton, values in zip(self.skeletons, np.split(v, self._ends()[:-1]), strict=True):
            skeleton.setVelocities(values)
            skeleton.computeForwardDynamics()
        poses = {
            node.getName(): np.array(node.getWorldTransform().matrix())[:3]
            for skeleton in self.skeletons
            for node in _depth_first(skeleton)
        }
        poses = {name: pose(matrix[:, :3], matrix[:, 3]) for name, matrix in poses.items()}
        engine = ModelQuantities(
            poses,
            _block_diagonal([np.array(skeleton.getMassMatrix()) for skeleton in self.skeletons]),
            self._joined("getCoriolisAndGravityForces"),
            self._joined("getGravityForces"),
            self._passive_force(),
            self._joined("getAccelerations"),
            float(sum(skeleton.computeKineticEnergy() for skeleton in self.skeletons)),
            self._gravity_potential(),
        )
        return to_canonical(engine, T, Tdot_v)

    def _ends(self) -> Array:
        return np.cumsum([skeleton.getNumDofs() for skeleton in self.skeletons])

    def _joined(self, method: str) -> Array:
        return np.concatenate([np.array(getattr(skeleton, method)()) for skeleton in self.skeletons])

    def _passive_force(self) -> Array:
        force = np.zeros(self._ends()[-1])
        for place in self.places:
            joint, start = place.dart, self._start(place)
            for k, v in enumerate(place.v):
                dof = self._dof(place) + k
                stretch = joint.getPosition(dof) - joint.getRestPosition(dof)
                force[start + v] = (
                    -joint.getDampingCoefficient(dof) * joint.getVelocity(dof)
                    - joint.getSpringStiffness(dof) * stretch
                )
        return force

    def _gravity_potential(self) -> float | None:
        """DART's potential energy counts springs too."""
        if any(place.joint.stiffness for place in self.places):
            return None
        return float(sum(skeleton.computePotentialEnergy() for skeleton in self.skeletons))

    def _start(self, place: _Place) -> int:
        return int(self._ends()[place.skeleton] - self.skeletons[place.skeleton].getNumDofs())

    def _dof(self, place: _Place) -> int:
        return int(place.v[0] - place.dart.getIndexInSkeleton(0))

    def _set_state(self, state: CanonicalState) -> tuple[Array, Array]:
        """Set q by the equations of the module's docstring and v; return T and Ṫv."""
        n = int(self._ends()[-1])
        T, Tdot_v = np.zeros((n, n)), np.zeros(n)
        x = rate = 0
        for place in self.places:
            joint, size = place.dart, len(place.v)
            width = {"ball": 4, "free": 7}.get(place.joint.kind, 1)
            own, v = state.coordinates[x : x + width], state.velocities[rate : rate + size]
            block, turned = np.eye(size), np.zeros(size)
            T_P, T_C = _frames(joint)
            if place.joint.kind == "free":
                X = pose_of_coordinates(own)
                q = dart.dynamics.FreeJoint.convertToPositions(_isometry(np.linalg.inv(T_P) @ X @ T_C))
                joint.setPositions(q)
                D = np.zeros((6, 6))
                D[:3, 3:], D[3:, :3] = np.eye(3), X[:3, :3].T
                J = np.array(joint.getRelativeJacobian())
                block = np.linalg.solve(J, D)
                joint.setVelocities(block @ v)
                convective = np.concatenate([np.zeros(3), -np.cross(v[3:], X[:3, :3].T @ v[:3])])
                Jdot = np.array(joint.getRelativeJacobianTimeDeriv())
                turned = np.linalg.solve(J, convective - Jdot @ block @ v)
            elif place.joint.kind == "ball":
                R = T_P[:3, :3].T @ rotation_matrix(place.body.attitude) @ rotation_matrix(own) @ T_C[:3, :3]
                joint.setPositions(dart.dynamics.BallJoint.convertToPositions(R))
                J = np.array(joint.getRelativeJacobian())[:3]
                block = np.linalg.inv(J)
                joint.setVelocities(block @ v)
                turned = -block @ np.array(joint.getRelativeJacobianTimeDeriv())[:3] @ block @ v
            else:
                joint.setPosition(self._dof(place), float(own[0]))
            rows = [self._start(place) + k for k in place.v]
            T[rows, rate : rate + size] = block
            Tdot_v[rows] = turned
            x, rate = x + width, rate + size
        return T, Tdot_v


def _depth_first(skeleton: Any) -> list[Any]:
    """DART's order of body nodes has parents first, not always depth first."""
    nodes = [skeleton.getBodyNode(i) for i in range(skeleton.getNumBodyNodes())]
    order: list[Any] = []

    def add(node: Any) -> None:
        order.append(node)
        for k in range(node.getNumChildBodyNodes()):
            add(node.getChildBodyNode(k))

    for node in nodes:
        if node.getParentBodyNode() is None:
            add(node)
    return order


def _frames(joint: Any) -> tuple[Array, Array]:
    """T_P and T_C (4, 4)."""
    above, below = joint.getTransformFromParentBodyNode(), joint.getTransformFromChildBodyNode()
    return np.array(above.matrix()), np.array(below.matrix())


def _isometry(matrix: Array) -> Any:
    return dart.math.Isometry3(matrix)


def _block_diagonal(blocks: list[Array]) -> Array:
    n = sum(len(block) for block in blocks)
    joined, k = np.zeros((n, n)), 0
    for block in blocks:
        joined[k : k + len(block), k : k + len(block)] = block
        k += len(block)
    return joined
