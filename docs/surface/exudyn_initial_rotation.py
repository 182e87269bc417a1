"""Exudyn: CreateRigidBody converts the initial angular velocity with the reference attitude.

A body that starts at another attitude than that of its reference, by initialRotationMatrix, has another
angular velocity than the one that is given in the world.  Before 1.9 it has another attitude, too.
"""

import exudyn as exu
import numpy as np
from exudyn.rigidBodyUtilities import RigidBodyInertia, RotationMatrixX, RotationMatrixZ

GIVEN = np.array([0.3, -0.2, 0.5])  # rad/s


def started(turn):
    """Return the angular velocity [rad/s] of a body that starts turned from its reference, and the turn."""
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    body = mbs.CreateRigidBody(
        initialRotationMatrix=turn.tolist(),  # 1.7 and 1.8 take no array
        initialAngularVelocity=GIVEN,
        inertia=RigidBodyInertia(1.0, np.eye(3)),
    )
    mbs.Assemble()
    output = exu.OutputVariableType
    spin, attitude = (
        np.array(mbs.GetObjectOutputBody(body, what, [0.0, 0.0, 0.0]))
        for what in (output.AngularVelocity, output.RotationMatrix)
    )
    return spin, attitude.reshape(3, 3)


for turn in (np.eye(3), RotationMatrixX(0.7) @ RotationMatrixZ(0.4)):
    spin, attitude = started(turn)
    print(f"attitude off by {np.max(np.abs(attitude - turn)):.0e}, angular velocity by {spin - GIVEN} rad/s")
