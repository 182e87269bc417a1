"""DART's `Skeleton` as a server: states of trees with loads.

A body's frame is at its centre of mass. T_P, T_C: the joint's axes at its far point in the far body, at its
near point in the near one.

    ball    T_P T(q) T_Cᵀ turns near → far body;  J v = A_nearᵀ (ω_near − ω_far), J the relative Jacobian
    free    the same with the pose;  J v = (ω′, Aᵀ ṙ)
    r̈, ω̇′   getCOMLinearAcceleration, in the world; getAngularAcceleration in the body's axes
    joint   getBodyForce: (moment about the centre of mass, force) on the body, in its axes; about the near
            point s the moment is less by s × force
    L       getAngularMomentum: of a body about a point, both in its axes
"""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import dartpy as dart
import numpy as np
from answer_lines import answer_lines, rotation

HELLO = {
    "protocol": 1, "name": "dart", "title": "DART", "version": version("dartpy"),
    "joints": ["ball", "hinge", "universal", "slide", "weld", "free"], "has": ["trees", "loads"],
    "quantities": ["acceleration", "angular_acceleration", "joint_reaction", "joint_moment", "kinetic_energy",
                   "potential_energy", "angular_momentum"],
}  # fmt: skip
NAMES = {"ball": "Ball", "hinge": "Revolute", "universal": "Universal", "slide": "Prismatic", "weld": "Weld",
         "free": "Free"}  # fmt: skip


def pose(axes: Any, point: Any) -> Any:
    """Return the matrix (4, 4) of axes at a point."""
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = axes, point
    return X


class Skeleton:
    """The mechanism as DART has it."""

    def __init__(self, kind: list[str], **model: Any) -> None:
        self.kind, self.model, self.nodes, self.joints = kind, model, [], []
        self.skeleton = dart.dynamics.Skeleton("mechanism")
        self.skeleton.setGravity(model["gravity"])
        for k, name in enumerate(kind):
            far = model["body"][k, 0]
            make = getattr(self.skeleton, f"create{NAMES[name]}JointAndBodyNodePair")
            joint, node = make(self.nodes[far]) if far >= 0 else make()
            node.setInertia(dart.dynamics.Inertia(float(model["mass"][k]), np.zeros(3), model["inertia"][k]))
            ends = [pose(rotation(model["turn"][k, i]), model["point"][k, i]) for i in (0, 1)]
            if name != "free":
                joint.setTransformFromParentBodyNode(dart.math.Isometry3(ends[0]))
                joint.setTransformFromChildBodyNode(dart.math.Isometry3(ends[1]))
            self.nodes.append(node)
            self.joints.append(joint)

    def _set_state(self, k: int, A: Any, spin: Any, s: dict[str, Any]) -> None:
        joint, far = self.joints[k], self.model["body"][k, 0]
        if self.kind[k] == "free":
            there = dart.math.Isometry3(pose(A[k], s["r"][k]))
            joint.setPositions(dart.dynamics.FreeJoint.convertToPositions(there))
            rates = np.concatenate([s["omega"][k], A[k].T @ s["v"][k]])
            joint.setVelocities(np.linalg.solve(np.array(joint.getRelativeJacobian()), rates))
        elif self.kind[k] == "ball":
            above, below = (rotation(self.model["turn"][k, i]) for i in (0, 1))
            R = (A[far] @ above if far >= 0 else above).T @ A[k] @ below
            joint.setPositions(dart.dynamics.BallJoint.convertToPositions(R))
            rates = A[k].T @ (spin[k] - (spin[far] if far >= 0 else 0))
            joint.setVelocities(np.linalg.solve(np.array(joint.getRelativeJacobian())[:3], rates))
        elif self.kind[k] != "weld":
            count = joint.getNumDofs()
            joint.setPositions(s["x"][k, :count])
            joint.setVelocities(s["xdot"][k, :count])

    def __call__(self, **s: Any) -> dict[str, Any]:
        """Return the quantities at a state."""
        A, m, skeleton = [rotation(p) for p in s["p"]], self.model, self.skeleton
        spin = [a @ omega for a, omega in zip(A, s["omega"], strict=True)]
        for k, node in enumerate(self.nodes):
            self._set_state(k, A, spin, s)
            node.clearExternalForces()
        for k, node in enumerate(self.nodes):
            node.addExtForce(m["force"][k] - m["drag_force"][k] * s["v"][k])
            node.addExtTorque(m["moment"][k] - m["drag_moment"][k] * s["omega"][k], True)
        skeleton.computeForwardDynamics()
        wrenches = [np.array(node.getBodyForce()).ravel() for node in self.nodes]
        about_near = [w[:3] - np.cross(m["point"][k, 1], w[3:]) for k, w in enumerate(wrenches)]
        about_origin = [np.ravel(n.getAngularMomentum(-A[k].T @ s["r"][k])) for k, n in enumerate(self.nodes)]
        found = {
            "acceleration": np.array([np.ravel(node.getCOMLinearAcceleration()) for node in self.nodes]),
            "angular_acceleration": np.array(
                [A[k].T @ np.ravel(node.getAngularAcceleration()) for k, node in enumerate(self.nodes)]
            ),
            "joint_reaction": np.array([a @ w[3:] for a, w in zip(A, wrenches, strict=True)]),
            "kinetic_energy": skeleton.computeKineticEnergy(),
            "potential_energy": skeleton.computePotentialEnergy(),
            "angular_momentum": sum(a @ own for a, own in zip(A, about_origin, strict=True)),
        }
        moments = np.array([a @ moment for a, moment in zip(A, about_near, strict=True)])
        return found | ({"joint_moment": moments} if {*self.kind} != {"ball"} else {})


if __name__ == "__main__":
    answer_lines(HELLO, Skeleton)
