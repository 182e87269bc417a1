"""Exudyn: the rotation matrix of a rotation vector that is longer than a whole turn.

RotationVector2RotationMatrix takes whole turns off the angle, and not off the vector that it multiplies:
what it returns is no rotation.
"""

import exudyn
import numpy as np
from exudyn.rigidBodyUtilities import RotationVector2RotationMatrix

axis = np.array([1.0, 2.0, -2.0]) / 3
for angle in (0.7, 0.7 + 2 * np.pi, 0.7 + 6 * np.pi):
    R = RotationVector2RotationMatrix(angle * axis)
    short = RotationVector2RotationMatrix(0.7 * axis)
    print(
        f"{exudyn.__version__}, {angle:.2f} rad: R off by {np.abs(R - short).max():.1e}, "
        f"R Rᵀ from the identity by {np.abs(R @ R.T - np.eye(3)).max():.1e}"
    )
