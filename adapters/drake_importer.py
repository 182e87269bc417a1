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

A URDF's root link is free in Drake; with a fixed base it is welded to the world.  So are the children of
floating joints, for which Drake adds no joint; they stay free.  Its actuators have no rotor here:
transmissions are not compared.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, MultibodyForces

from adapters.importer_common import (
    LayoutWithOwnVelocities,
    LoadingImporter,
    depth_first,
    joint_from_screw,
    make_body,
    make_joint,
    merge_made_up_bodies,
)
from plumbline.importers.importer import ModelFile
from plumbline.importers.neutral_model import ElementaryJoint, ModelQuantities, NeutralBody
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import rotation_matrix


class _Layout(LayoutWithOwnVelocities):
    """A plant; a joint's own: Drake's joint, R_M (body axes → axes of the frame M), and places in q."""

    def __init__(self, plant: Any, file: ModelFile) -> None:
        rotors = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
        for rotor in rotors if file.format == "urdf" else ():  # of transmissions, by Drake's own elements
            rotor.set_default_rotor_inertia(0.0)
        self.plant, self.context = plant, plant.CreateDefaultContext()
        self.q = plant.GetPositions(self.context)
        joints = [plant.get_joint(j) for j in plant.GetJointIndices()]
        self.parent_joint = {joint.child_body().index(): joint for joint in joints}
        self.rotor_inertia: dict[str, float] = {}
        for rotor in rotors:
            inertia = rotor.default_rotor_inertia() * rotor.default_gear_ratio() ** 2
            name = rotor.joint().name()
            self.rotor_inertia[name] = self.rotor_inertia.get(name, 0.0) + inertia
        world = plant.world_body().index()
        self.order = list(depth_first(self._children(world), self._children))
        super().__init__(plant, file)

    def _children(self, parent: Any) -> list[Any]:
        """Return the bodies on a body, in Drake's order."""
        joints = sorted(self.parent_joint.items(), key=lambda item: int(item[0]))
        return [index for index, joint in joints if joint.parent_body().index() == parent]

    def _gravity(self) -> Any:
        return self.plant.gravity_field().gravity_vector()

    def _bodies(self) -> list[NeutralBody]:
        position = {index: k for k, index in enumerate(self.order)}
        return merge_made_up_bodies([self._body(index, position) for index in self.order], self.file)

    def _body(self, index: Any, position: dict[Any, int]) -> NeutralBody:
        body, joint = self.plant.get_body(index), self.parent_joint[index]
        X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
        X_MB = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
        X_FM = joint.X_FM() if joint.type_name() == "weld" else RigidTransform()
        zero = X_PF.multiply(X_FM).multiply(X_MB).GetAsMatrix34()
        spatial = body.default_spatial_inertia()
        center = np.array(spatial.get_com())
        about_center = spatial.Shift(center).CalcRotationalInertia().CopyToFullMatrix3()
        parent = position.get(joint.parent_body().index(), -1)
        joints = self._joints(joint, body)
        return make_body(body.name(), parent, zero, joints, body.default_mass(), center, about_center)

    def _joints(self, joint: Any, body: Any) -> Iterator[ElementaryJoint]:
        X_BM = joint.frame_on_child().GetFixedPoseInBodyFrame()
        R, anchor = X_BM.rotation().matrix(), X_BM.translation()
        name, kind = joint.name(), joint.type_name()
        if kind == "weld":
            return
        damping = joint.default_damping_vector()[0]
        numbers = {"armature": self.rotor_inertia.get(name, 0.0), "damping": damping}
        if kind == "revolute":
            yield make_joint(name, "hinge", R @ joint.revolute_axis(), anchor, **numbers)
        elif kind == "prismatic":
            yield joint_from_screw(name, np.zeros(3), R @ joint.translation_axis(), **numbers)
        elif kind == "ball_rpy":
            yield make_joint(name, "ball", anchor=anchor, **numbers)
        elif kind == "quaternion_floating" and joint.parent_body() is self.plant.world_body():
            yield self._free_joint(body.name(), **numbers)
        else:
            raise NotImplementedError(f"a joint of type {kind}")
        q, v = joint.position_start(), joint.velocity_start()
        own = joint, R.T, slice(q, q + joint.num_positions())
        self.places.append((own, slice(v, v + joint.num_velocities())))

    def _move(self, joint: ElementaryJoint, own: Any, x: Array, v: Array) -> tuple[Any, Any]:
        _, R_M, at = own
        q, block = x, np.eye(len(v))
        if joint.kind == "ball":
            R_FM = R_M @ rotation_matrix(x) @ R_M.T
            q, block = RollPitchYaw(RotationMatrix(R_FM)).vector(), R_FM @ R_M
        elif joint.kind == "free":
            q, block = np.concatenate([x[3:], x[:3]]), np.zeros((6, 6))
            block[:3, 3:], block[3:, :3] = rotation_matrix(x[3:]), np.eye(3)
        self.q[at] = q
        return block, 0.0

    def _engine_quantities(self, v: Array) -> ModelQuantities:
        plant, context = self.plant, self.context
        plant.SetPositions(context, self.q)
        plant.SetVelocities(context, v)
        M = np.array(plant.CalcMassMatrix(context))
        gravity = np.array(plant.CalcGravityGeneralizedForces(context))
        coriolis = np.array(plant.CalcBiasTerm(context))
        bodies = [plant.get_body(index) for index in self.order]
        poses = {b.name(): plant.EvalBodyPoseInWorld(context, b).GetAsMatrix34() for b in bodies}
        has_springs = plant.num_force_elements() > 1  # besides gravity
        return ModelQuantities(
            poses, M, coriolis - gravity, -gravity, self._passive_force(coriolis, gravity),
            self._accelerations(), float(plant.CalcKineticEnergy(context)),
            None if has_springs else float(plant.CalcPotentialEnergy(context)),
        )  # fmt: skip

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
        elements = coriolis - needed - gravity
        if plant.num_force_elements() == 1:  # the difference is rounding
            elements = np.zeros(plant.num_velocities())
        damping = MultibodyForces(plant)
        damping.SetZero()
        for (joint, _, _), _ in self.places:
            joint.AddInDamping(context, damping)
        return np.asarray(elements + np.array(damping.generalized_forces()), float)


class DrakeImporter(LoadingImporter):
    """Drake's URDF and MJCF parsers."""

    name = "drake"
    title = "Drake"
    package = "drake"
    supported_versions = ">=1.32,<2"  # earlier ones need NumPy 1, and have other signatures
    formats = ("urdf", "mjcf")
    environment = ".importers"
    layout = _Layout
    refusals = (RuntimeError,)

    def _load(self, file: ModelFile) -> Any:
        plant = MultibodyPlant(0.0)
        Parser(plant).AddModels(file.path)
        if file.format == "urdf" and file.base == "fixed":
            children = {child.get("link") for child in ElementTree.parse(file.path).iterfind("joint/child")}
            for index in range(1, plant.num_bodies()):
                body = plant.get_body(BodyIndex(index))
                if body.name() not in children:
                    plant.WeldFrames(plant.world_frame(), body.body_frame())
        plant.Finalize()
        return plant
