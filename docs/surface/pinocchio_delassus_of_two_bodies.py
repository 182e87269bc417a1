"""Pinocchio: the Delassus matrix of a constraint between two bodies lacks the second body.

Two bodies on turning joints are held together at a point: J M⁻¹ Jᵀ with the engine's own J and M, and the
matrices of its factorisation, of computeDelassusMatrix and of computeDampedDelassusMatrixInverse.
"""

import numpy as np
import pinocchio

model = pinocchio.Model()
inertia = pinocchio.Inertia(1.0, np.array([0.2, 0.1, 0.0]), np.diag([0.1, 0.2, 0.3]))
joints = []
for k, at in enumerate(([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])):
    place = pinocchio.SE3(np.eye(3), np.array(at))
    joints.append(model.addJoint(0, pinocchio.JointModelSpherical(), place, f"joint {k}"))
    model.appendBodyToJoint(joints[-1], inertia, pinocchio.SE3.Identity())
q, data = pinocchio.neutral(model), model.createData()
pinocchio.forwardKinematics(model, data, q)
ends = [pinocchio.SE3(np.eye(3), np.array(x)) for x in ([0.5, 0.3, 0.2], [-0.5, 0.3, 0.2])]
constraints, works = pinocchio.StdVec_RigidConstraintModel(), pinocchio.StdVec_RigidConstraintData()
given = joints[0], ends[0], joints[1], ends[1], pinocchio.ReferenceFrame.LOCAL
constraints.append(pinocchio.RigidConstraintModel(pinocchio.ContactType.CONTACT_3D, model, *given))
works.append(constraints[0].createData())
mass = pinocchio.crba(model, data, q, pinocchio.Convention.WORLD)
pinocchio.computeJointJacobians(model, data, q)
constraints[0].calc(model, data, works[0])
J = pinocchio.getConstraintsJacobian(model, data, constraints, works)
first = J * (np.arange(model.nv) < 3)
factors = pinocchio.ConstraintCholeskyDecomposition(model, data, constraints, works)
factors.compute(model, data, constraints, works, 0.0)
both = J @ np.linalg.solve(mass, J.T)
arguments = model, model.createData(), q, constraints, works
print("J M⁻¹ Jᵀ                               ", np.round(np.diag(both), 4))
print("… of the first body alone              ", np.round(np.diag(first @ np.linalg.solve(mass, first.T)), 4))
operator = factors.getInverseOperationalSpaceInertiaMatrix(True)
print("ConstraintCholeskyDecomposition        ", np.round(np.diag(operator), 4))
print(
    "computeDelassusMatrix                  ",
    np.round(np.diag(pinocchio.computeDelassusMatrix(*arguments)), 4),
)
inverse = pinocchio.computeDampedDelassusMatrixInverse(*arguments, 1e-9)
print("1 / computeDampedDelassusMatrixInverse ", np.round(np.diag(np.linalg.inv(inverse)), 4))
