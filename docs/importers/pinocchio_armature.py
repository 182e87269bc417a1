"""Pinocchio: computeKineticEnergy leaves out the armature of hinges whose axis is none of x, y, z.

crba counts it, and so do both about the axis (0, 1, 0).  A hinge with armature a and inertia I has the
kinetic energy (I + a) v² / 2 = (1 + 0.5) / 2 at v = 1.
"""

import tempfile

import numpy as np
import pinocchio

MODEL = """<mujoco><worldbody><body name="b"><joint name="j" axis="0 -1 0" armature="0.5"/>
  <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""

with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
    file.write(MODEL)
    file.flush()
    model = pinocchio.buildModelFromMJCF(file.name)
data, q, v = model.createData(), np.zeros(1), np.ones(1)
print("expected", pinocchio.crba(model, data, q)[0, 0] / 2, end=" ")
print("found", pinocchio.computeKineticEnergy(model, data, q, v))
