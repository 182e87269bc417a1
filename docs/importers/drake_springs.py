"""Drake: springs of joints, and the armature of joints without an actuator, are not read from MJCF files.

Armature is a rotor's inertia about the joint: it adds to the mass matrix, whatever drives the joint.
"""

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

MODEL = """<mujoco model="m"><option gravity="0 0 0"/><worldbody><body name="b">
  <joint name="j" type="hinge" axis="0 1 0" stiffness="3" armature="0.5"/>
  <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""

plant = MultibodyPlant(0.0)
Parser(plant).AddModelsFromString(MODEL, "xml")
plant.Finalize()
context = plant.CreateDefaultContext()
plant.SetPositions(context, [0.1])
print("mass matrix: expected 1.5, found", plant.CalcMassMatrix(context)[0, 0])
rate = plant.EvalTimeDerivatives(context).get_generalized_velocity().CopyToVector()
print("acceleration: expected", -3 * 0.1 / 1.5, "found", np.round(rate[0], 12))
