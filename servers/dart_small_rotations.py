"""DART: the rotation of a ball joint by less than 1e-3 rad is off by θ³/6.

The rotation about the x axis by θ has sin θ off its diagonal.
"""

from importlib.metadata import version
from math import sin

import dartpy

print(f"dartpy {version('dartpy')}")
for angle in (1.01e-3, 0.99e-3, 0.5e-3):
    found = dartpy.dynamics.BallJoint.convertToRotation([angle, 0.0, 0.0])[2, 1]
    print(f"{angle:.2e} rad: expected {sin(angle):.16e}, found {found:.16e}, off by {found - sin(angle):.1e}")
