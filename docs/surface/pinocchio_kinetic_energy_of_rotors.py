"""Pinocchio: computeKineticEnergy lacks the rotor of a joint about or along a given axis.

A body on one joint, with the same rotor (armature) on each model of it: the engine's kinetic energy, and
½ v · M v with the engine's own mass matrix.
"""

import numpy as np
import pinocchio

axis = np.array([0.0, 0.0, 1.0])
JOINTS = {
    "RZ": pinocchio.JointModelRZ(),
    "RevoluteUnaligned": pinocchio.JointModelRevoluteUnaligned(axis),
    "PZ": pinocchio.JointModelPZ(),
    "PrismaticUnaligned": pinocchio.JointModelPrismaticUnaligned(axis),
    "HZ": pinocchio.JointModelHZ(0.1),
    "HelicalUnaligned": pinocchio.JointModelHelicalUnaligned(axis, 0.1),
}
inertia = pinocchio.Inertia(2.0, np.array([0.1, 0.2, -0.5]), np.diag([0.1, 0.2, 0.15]))
q, v = np.array([0.3]), np.array([1.5])
for name, joint in JOINTS.items():
    model = pinocchio.Model()
    number = model.addJoint(0, joint, pinocchio.SE3.Identity(), "joint")
    model.appendBodyToJoint(number, inertia, pinocchio.SE3.Identity())
    model.armature = np.array([0.7])
    data = model.createData()
    half = float(0.5 * v[0] ** 2 * np.ravel(pinocchio.crba(model, data, q))[0])
    print(f"{name:18s} {pinocchio.computeKineticEnergy(model, data, q, v):.6f} of {half:.6f} J")
