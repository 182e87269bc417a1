"""Pinocchio: rates of Jacobians, Coriolis matrix and rate of the centroidal map of a composite joint.

A body on RX and RY, as one composite joint and as two joints with nothing between: each rate against a
central difference of what it is the rate of.  Of the composite joint all three lack the rate of its second
axis.
"""

import numpy as np
import pinocchio


def build(is_composite):
    """Build the model of a body on RX and RY."""
    model = pinocchio.Model()
    parts = [pinocchio.JointModelRX(), pinocchio.JointModelRY()]
    if is_composite:
        joint = pinocchio.JointModelComposite()
        for part in parts:
            joint.addJoint(part)
        parts = [joint]
    last = 0
    for i, part in enumerate(parts):
        last = model.addJoint(last, part, pinocchio.SE3.Identity(), f"joint {i}")
    inertia = pinocchio.Inertia(2.0, np.array([0.1, 0.2, -0.5]), np.diag([0.1, 0.2, 0.15]))
    model.appendBodyToJoint(last, inertia, pinocchio.SE3.Identity())
    return model


q, v, h = np.array([0.3, 0.7]), np.array([1.1, -0.8]), 1e-6
for name in ("composite", "two joints"):
    model = build(name == "composite")
    data = model.createData()

    def difference(function, model=model, data=data):
        """Return the rate of a function of q, by a central difference."""
        return (function(model, data, q + h * v) - function(model, data, q - h * v)) / (2 * h)

    off = {
        "Jacobian": pinocchio.computeJointJacobiansTimeVariation(model, data, q, v)
        - difference(lambda *x: pinocchio.computeJointJacobians(*x).copy()),
        "Coriolis": pinocchio.computeCoriolisMatrix(model, data, q, v) @ v
        + pinocchio.computeGeneralizedGravity(model, data, q)
        - pinocchio.nonLinearEffects(model, data, q, v),
        "centroidal map": pinocchio.dccrba(model, data, q, v)
        - difference(lambda *x: pinocchio.computeCentroidalMap(*x).copy()),
    }
    print(f"{name:11s}", ", ".join(f"{what}: off by {np.abs(x).max():.1e}" for what, x in off.items()))
