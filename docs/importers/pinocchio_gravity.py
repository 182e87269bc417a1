"""Pinocchio: <option gravity> of an MJCF file is not read.

On a body of 2 kg whose slide points along gravity the generalised force of gravity is 2 * 1.62 N.
"""

import tempfile

import numpy as np
import pinocchio

MODEL = """<mujoco><option gravity="0 0 -1.62"/><worldbody><body name="b">
  <joint name="j" type="slide" axis="0 0 1"/>
  <inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/></body></worldbody></mujoco>"""

with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
    file.write(MODEL)
    file.flush()
    model = pinocchio.buildModelFromMJCF(file.name)
force = pinocchio.computeGeneralizedGravity(model, model.createData(), np.zeros(1))
print(f"expected {2 * 1.62}, found {force[0]}")
