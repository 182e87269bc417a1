"""Drake's importers of URDF and MJCF files, without geometry.

A body of the reading is a body of the `MultibodyPlant`.  X_PF, X_BM: poses of a joint's frames in the bodies
that it connects, B the child.  Massless bodies that the MJCF parser makes up, between several joints of a
body, are merged into that body.

    hinge, slide    q = x
    ball            roll-pitch-yaw(q) = R_M R(x) R_Mᵀ with R_M = R_BMᵀ;  v_e = R_FM R_M v, so that Ṫv = 0
    free            q = (quaternion, position);  v_e = (R_B ω, ṙ), so that Ṫv = 0

    h = CalcBiasTerm − CalcGravityGeneralizedForces;  v̇ by EvalTimeDerivatives of the continuous plant, which
        refuses plants with constraints (mimic joints among them)
    f = damping of the joints, AddInDamping, and what force elements besides gravity add to inverse dynamics

A URDF's root link is free in Drake; with a fixed base it is welded to the world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, MultibodyForces

from adapters.importer_common import (
    LoadingImporter,
    Refused,
    free_joint_name,
    joint_from_screw,
    make_joint,
    merge_made_up_bodies,
    pose,
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


class DrakeImporter(LoadingImporter):
    """Drake's URDF and MJCF parsers."""

    name = "drake"
    title = "Drake"
    package = "drake"
    supported_versions = ">=1.32,<2"  # earlier ones need NumPy 1, and have other signatures
    formats = ("urdf", "mjcf")
    environment = ".importers"

    def _load(self, file: ModelFile) -> Any:
        try:
            return _parsed(file)
        except RuntimeError as error:
            raise Refused(str(error)) from None

    def _describe(self, loaded: Any, file: ModelFile) -> NeutralModel:
        gravity = np.array(loaded.gravity_field().gravity_vector())
        return NeutralModel("", _Layout(loaded, file).bodies, gravity)

    def _evaluate(
        self, loaded: Any, file: ModelFile, states: Sequence[CanonicalState]
    ) -> list[ModelQuantities]:
        layout = _Layout(loaded, file)
        return [layout.quantities(state) for state in states]


def _parsed(file: ModelFile) -> Any:
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(file.path)
    if file.format == "urdf" and file.base == "fixed":
        children = {plant.get_joint(j).child_body().index() for j in plant.GetJointIndices()}
        for index in range(1, plant.num_bodies()):
            if BodyIndex(index) not in children:
                plant.WeldFrames(plant.world_frame(), plant.get_body(BodyIndex(index)).body_frame())
    plant.Finalize()
    return plant


@dataclass(frozen=True, eq=False)
class _Place:
    """Where a joint's coordinates are in Drake's vectors and in the canonical ones."""

    joint: ElementaryJoint
    drake: Any
    R_M: Array  # (3, 3) body axes → axes of the frame M
    q: slice
    v: slice


class _Layout:
    """A plant with the order of its bodies and joints in the reading."""

    def __init__(self, plant: Any, file: ModelFile) -> None:
        self.plant, self.context, self.file = plant, plant.CreateDefaultContext(), file
        joints = [plant.get_joint(j) for j in plant.GetJointIndices()]
        self.parent_joint = {joint.child_body().index(): joint for joint in joints}
        self.rotor_inertia: dict[str, float] = {}
        for index in plant.GetJointActuatorIndices():
            rotor = plant.get_joint_actuator(index)
            inertia = rotor.default_rotor_inertia() * rotor.default_gear_ratio() ** 2
            name = rotor.joint().name()
            self.rotor_inertia[name] = self.rotor_inertia.get(name, 0.0) + inertia
        self.places: list[_Place] = []
        self.order: list[Any] = []
        self._collect(plant.world_body().index())
        position = {index: k for k, index in enumerate(self.order)}
        bodies = [self._body(index, position) for index in self.order]
        self.bodies = tuple(merge_made_up_bodies(bodies, file))

    def _collect(self, parent: Any) -> None:
        """Order the bodies depth first, in Drake's order among siblings."""
        for index, joint in sorted(self.parent_joint.items(), key=lambda item: int(item[0])):
            if joint.parent_body().index() == parent:
                self.order.append(index)
                self._collect(index)

    def _body(self, index: Any, position: dict[Any, int]) -> NeutralBody:
        body, joint = self.plant.get_body(index), self.parent_joint[index]
        X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
        X_MB = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
        X_FM = joint.X_FM() if joint.type_name() == "weld" else RigidTransform()
        zero = X_PF.multiply(X_FM).multiply(X_MB)
        spatial = body.default_spatial_inertia()
        center = np.array(spatial.get_com())
        about_center = spatial.Shift(center).CalcRotationalInertia().CopyToFullMatrix3()
        return NeutralBody(
            body.name(),
            position.get(joint.parent_body().index(), -1),
            np.array(zero.translation()),
            quaternion_of(zero.rotation().matrix()),
            self._joints(joint, body),
            float(body.default_mass()),
            center,
            np.array(about_center),
        )

    def _joints(self, joint: Any, body: Any) -> tuple[ElementaryJoint, ...]:
        X_BM = joint.frame_on_child().GetFixedPoseInBodyFrame()
        R, anchor, kind = X_BM.rotation().matrix(), np.array(X_BM.translation()), joint.type_name()
        if kind == "weld":
            return ()
        if kind == "revolute":
            found = make_joint(joint.name(), "hinge", R @ joint.revolute_axis(), anchor)
        elif kind == "prismatic":
            found = joint_from_screw(joint.name(), np.zeros(3), R @ joint.translation_axis())
        elif kind == "ball_rpy":
            found = make_joint(joint.name(), "ball", anchor=anchor)
        elif kind == "quaternion_floating" and joint.parent_body() is self.plant.world_body():
            found = make_joint(free_joint_name(body.name(), self.file), "free")
        else:
            raise NotImplementedError(f"a joint of type {kind}")
        armature = self.rotor_inertia.get(joint.name(), 0.0)
        damping = float(joint.default_damping_vector()[0])
        found = replace(found, armature=armature, damping=damping)
        q, v = joint.position_start(), joint.velocity_start()
        slices = slice(q, q + joint.num_positions()), slice(v, v + joint.num_velocities())
        self.places.append(_Place(found, joint, R.T, *slices))
        return (found,)

    def quantities(self, state: CanonicalState) -> ModelQuantities:
        """Evaluate Drake's routines at one state."""
        plant, context = self.plant, self.context
        v, T = self._set_state(state)
        M = np.array(plant.CalcMassMatrix(context))
        gravity = np.array(plant.CalcGravityGeneralizedForces(context))
        coriolis = np.array(plant.CalcBiasTerm(context))
        accelerations = self._accelerations()
        poses = {}
        for index in self.order:
            body = plant.get_body(index)
            X = plant.EvalBodyPoseInWorld(context, body)
            poses[body.name()] = pose(X.rotation().matrix(), X.translation())
        has_springs = plant.num_force_elements() > 1  # besides gravity
        engine = ModelQuantities(
            poses, M, coriolis - gravity, -gravity, self._passive_force(coriolis, gravity),
            accelerations, float(plant.CalcKineticEnergy(context)),
            None if has_springs else float(plant.CalcPotentialEnergy(context)),
        )  # fmt: skip
        return to_canonical(engine, T, np.zeros(len(v)))

    def _accelerations(self) -> Array | None:
        """Where the mass matrix is singular, Drake raises: there is no acceleration."""
        if self.plant.num_constraints():
            return None
        try:
            derivatives = self.plant.EvalTimeDerivatives(self.context)
        except RuntimeError as error:
            if "not positive-definite" in str(error):
                return None
            raise
        return np.array(derivatives.get_generalized_velocity().CopyToVector())

    def _passive_force(self, coriolis: Array, gravity: Array) -> Array:
        plant, context = self.plant, self.context
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        needed = plant.CalcInverseDynamics(context, np.zeros(plant.num_velocities()), forces)
        elements = np.asarray(coriolis - needed - gravity)
        if plant.num_force_elements() == 1:  # the difference is rounding
            elements = np.zeros(plant.num_velocities())
        damping = MultibodyForces(plant)
        damping.SetZero()
        for place in self.places:
            place.drake.AddInDamping(context, damping)
        return np.asarray(elements + np.array(damping.generalized_forces()), float)

    def _set_state(self, state: CanonicalState) -> tuple[Array, Array]:
        """Set q and v by the equations of the module's docstring; return v and T."""
        plant = self.plant
        q, n = plant.GetPositions(self.context), plant.num_velocities()
        T = np.zeros((n, n))
        x = rate = 0
        for place in self.places:
            kind, width = place.joint.kind, place.q.stop - place.q.start
            size = place.v.stop - place.v.start
            own = state.coordinates[x : x + (4 if kind == "ball" else width)]
            block = np.eye(size)
            if kind == "ball":
                R_FM = place.R_M @ rotation_matrix(own) @ place.R_M.T
                q[place.q] = RollPitchYaw(RotationMatrix(R_FM)).vector()
                block = R_FM @ place.R_M
            elif kind == "free":
                q[place.q] = np.concatenate([own[3:], own[:3]])
                block = np.zeros((6, 6))
                block[:3, 3:], block[3:, :3] = rotation_matrix(own[3:]), np.eye(3)
            else:
                q[place.q] = own
            T[place.v, rate : rate + size] = block
            x, rate = x + len(own), rate + size
        plant.SetPositions(self.context, q)
        plant.SetVelocities(self.context, T @ state.velocities)
        return np.asarray(T @ state.velocities), T
