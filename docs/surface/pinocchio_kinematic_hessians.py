"""Pinocchio's Python module: kinematic Hessians come with their entries in another order.

The Hessian of a ball joint's Jacobian, H[:, i, k] = ∂J[:, i]/∂q_k, against central differences of Jacobians:
as it is returned, and with the same numbers read by columns, as Pinocchio's C++ library keeps them.
"""

import numpy as np
import pinocchio

model = pinocchio.Model()
joint = model.addJoint(0, pinocchio.JointModelSpherical(), pinocchio.SE3.Identity(), "ball")
q, h = pinocchio.integrate(model, pinocchio.neutral(model), np.array([0.3, -0.5, 0.8])), 1e-6
world = pinocchio.ReferenceFrame.WORLD


def jacobian(q):
    """Return the Jacobian of the joint in the world."""
    data = model.createData()
    pinocchio.computeJointJacobians(model, data, q)
    return pinocchio.getJointJacobian(model, data, joint, world).copy()


def moved(step):
    """Return the configuration that a step leads to."""
    return pinocchio.integrate(model, q, step)


true = np.stack([(jacobian(moved(e)) - jacobian(moved(-e))) / (2 * h) for e in h * np.eye(3)], axis=2)
data = model.createData()
pinocchio.computeJointKinematicHessians(model, data, q)
H = np.array(pinocchio.getJointKinematicHessian(model, data, joint, world))
for name, found in (("as returned", H), ("read by columns", H.ravel().reshape(H.shape, order="F"))):
    print(f"{name:15s} off by {np.abs(found - true).max():.1e}")
