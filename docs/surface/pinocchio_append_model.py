"""Pinocchio: appendModel makes a model with the usual gravity and no rotors, whatever its two models have."""

import numpy as np
import pinocchio

one, other = pinocchio.Model(), pinocchio.buildSampleModelManipulator()
one.gravity = other.gravity = pinocchio.Motion(np.array([1.0, 2.0, 3.0]), np.zeros(3))
other.armature = np.full(other.nv, 0.25)  # kg m²
both = pinocchio.appendModel(one, other, 0, pinocchio.SE3.Identity())
for name, model in (("first", one), ("second", other), ("both", both)):
    print(f"{name:6s}", model.gravity.linear, model.armature)
