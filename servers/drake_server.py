"""Drake's `MultibodyPlant` as a server: states of trees with loads.

A body's frame B is at its centre of mass. Joint k connects F, at its far point with its axes there, to M, at
its near point: R_WF = A_far R(turn_far), R_WM = A_near R(turn_near).

    ball    BallRpyJoint: q = rpy(R_FM), v = R_WFᵀ (ω_near − ω_far)
    free    no joint: pose and velocity of the body itself
    r̈, ω̇    EvalSpatialAccelerationInWorld of B;  ω̇′ = Aᵀ ω̇
    joint   reaction_forces are on the child, at M, in M's axes
"""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import numpy as np
from answer_lines import answer_lines, rotation
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    PrismaticJoint,
    RevoluteJoint,
    SpatialInertia,
    UnitInertia,
    UniversalJoint,
    WeldJoint,
)

HELLO = {
    "protocol": 1, "name": "drake", "title": "Drake", "version": version("drake"),
    "joints": ["ball", "hinge", "universal", "slide", "weld", "free"], "has": ["trees", "loads"],
    "quantities": ["acceleration", "angular_acceleration", "joint_reaction", "joint_moment", "kinetic_energy",
                   "potential_energy", "angular_momentum"],
}  # fmt: skip
Z = np.array([0.0, 0.0, 1.0])


class Plant:
    """The mechanism as Drake has it."""

    def __init__(self, kind: list[str], **model: Any) -> None:
        self.kind, self.model = kind, model
        self.plant = plant = MultibodyPlant(0.0)
        plant.mutable_gravity_field().set_gravity_vector(model["gravity"])
        self.bodies, self.joints = [], []
        for k, (mass, inertia) in enumerate(zip(model["mass"], model["inertia"], strict=True)):
            xx, yy, zz, xy, xz, yz = (
                inertia[i] / mass for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
            )
            unit = UnitInertia(xx, yy, zz, xy, xz, yz)
            self.bodies.append(plant.AddRigidBody(f"body{k}", SpatialInertia(mass, np.zeros(3), unit)))
            self.joints.append(self._add_joint(k))
        plant.Finalize()
        self.context = plant.CreateDefaultContext()

    def _add_joint(self, k: int) -> Any:
        if self.kind[k] == "free":
            return None
        ends = []
        for i, body in enumerate(self.model["body"][k]):
            at = self.bodies[body] if body >= 0 else self.plant.world_body()
            axes = RotationMatrix(rotation(self.model["turn"][k, i]))
            pose = RigidTransform(axes, self.model["point"][k, i])
            ends.append(self.plant.AddFrame(FixedOffsetFrame(f"{k} {i}", at.body_frame(), pose)))
        name = f"joint{k}"
        made = {
            "ball": lambda: BallRpyJoint(name, *ends), "hinge": lambda: RevoluteJoint(name, *ends, Z),
            "slide": lambda: PrismaticJoint(name, *ends, Z), "universal": lambda: UniversalJoint(name, *ends),
            "weld": lambda: WeldJoint(name, *ends, RigidTransform()),
        }[self.kind[k]]()  # fmt: skip
        return self.plant.AddJoint(made)

    def _set_state(self, A: Any, spin: Any, s: dict[str, Any]) -> None:
        for k, (kind, joint) in enumerate(zip(self.kind, self.joints, strict=True)):
            far = self.model["body"][k, 0]
            if kind == "free":
                pose = RigidTransform(RotationMatrix.ProjectToRotationMatrix(A[k]), s["r"][k])
                self.plant.SetFreeBodyPose(self.context, self.bodies[k], pose)
                moving = SpatialVelocity(spin[k], s["v"][k])
                self.plant.SetFreeBodySpatialVelocity(self.bodies[k], moving, self.context)
            elif kind == "ball":
                above, below = (rotation(self.model["turn"][k, i]) for i in (0, 1))
                F = (A[far] if far >= 0 else np.eye(3)) @ above
                relative = RotationMatrix.ProjectToRotationMatrix(F.T @ A[k] @ below)
                joint.set_angles(self.context, RollPitchYaw(relative).vector())
                joint.set_angular_velocity(self.context, F.T @ (spin[k] - (spin[far] if far >= 0 else 0)))
            elif kind == "universal":
                joint.set_angles(self.context, s["x"][k, :2])
                joint.set_angular_rates(self.context, s["xdot"][k, :2])
            elif kind == "hinge":
                joint.set_angle(self.context, s["x"][k, 0])
                joint.set_angular_rate(self.context, s["xdot"][k, 0])
            elif kind == "slide":
                joint.set_translation(self.context, s["x"][k, 0])
                joint.set_translation_rate(self.context, s["xdot"][k, 0])

    def _load(self, k: int, A: Any, omega: Any, v: Any) -> Any:
        m, load = self.model, ExternallyAppliedSpatialForce()
        moment = A @ (m["moment"][k] - m["drag_moment"][k] * omega)
        load.body_index, load.p_BoBq_B = self.bodies[k].index(), np.zeros(3)
        load.F_Bq_W = SpatialForce(moment, m["force"][k] - m["drag_force"][k] * v)
        return load

    def __call__(self, **s: Any) -> dict[str, Any]:
        """Return the quantities at a state."""
        A, plant, context = [rotation(p) for p in s["p"]], self.plant, self.context
        spin = [a @ omega for a, omega in zip(A, s["omega"], strict=True)]
        self._set_state(A, spin, s)
        n = len(A)
        loads = [self._load(k, A[k], s["omega"][k], s["v"][k]) for k in range(n)]
        plant.get_applied_spatial_force_input_port().FixValue(context, loads)
        moving = [body.EvalSpatialAccelerationInWorld(context) for body in self.bodies]
        found = {
            "acceleration": np.array([a.translational() for a in moving]),
            "angular_acceleration": np.array([A[k].T @ a.rotational() for k, a in enumerate(moving)]),
            "kinetic_energy": plant.CalcKineticEnergy(context),
            "potential_energy": plant.CalcPotentialEnergy(context),
            "angular_momentum": plant.CalcSpatialMomentumInWorldAboutPoint(context, np.zeros(3)).rotational(),
        }
        wrenches, forces = plant.get_reaction_forces_output_port().Eval(context), np.zeros((2, n, 3))
        for k, joint in enumerate(self.joints):
            if joint is not None:
                M, wrench = A[k] @ rotation(self.model["turn"][k, 1]), wrenches[int(joint.index())]
                forces[:, k] = M @ wrench.translational(), M @ wrench.rotational()
        found["joint_reaction"] = forces[0]
        return found | ({"joint_moment": forces[1]} if {*self.kind} != {"ball"} else {})


if __name__ == "__main__":
    answer_lines(HELLO, Plant)
