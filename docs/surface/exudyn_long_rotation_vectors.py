"""Exudyn: the rotation matrix of a rotation vector that is longer than a whole turn.

RotationVector2RotationMatrix and nodes with rotation vectors take whole turns off the angle, and not off the
vector that they multiply: the matrix is no rotation.
"""

import exudyn as exu
import numpy as np
from exudyn.itemInterface import NodeRigidBodyRotVecLG
from exudyn.rigidBodyUtilities import RotationVector2RotationMatrix

axis = np.array([1.0, 2.0, -2.0]) / 3
short = RotationVector2RotationMatrix(0.7 * axis)
for angle in (0.7, 0.7 + 2 * np.pi, 0.7 + 6 * np.pi):
    vector = angle * axis
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    node = mbs.AddNode(NodeRigidBodyRotVecLG(referenceCoordinates=[0.0, 0.0, 0.0, *vector]))
    mbs.Assemble()
    matrix = mbs.GetNodeOutput(node, exu.OutputVariableType.RotationMatrix, exu.ConfigurationType.Reference)
    off = [np.abs(R - short).max() for R in (RotationVector2RotationMatrix(vector), matrix.reshape(3, 3))]
    print(f"{exu.__version__}, {angle:.2f} rad: function off by {off[0]:.1e}, node off by {off[1]:.1e}")
