"""Drake: the pose of an MJCF body with several joints is applied after the first of them.

The body's origin lies on both hinges: it stays at (0, 0, 1) whatever the angles are.
"""

from math import pi

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

MODEL = """<mujoco model="m"><worldbody><body name="b" pos="0 0 1">
  <joint name="x" type="hinge" axis="1 0 0"/>
  <joint name="y" type="hinge" axis="0 1 0"/>
  <inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""

plant = MultibodyPlant(0.0)
Parser(plant).AddModelsFromString(MODEL, "xml")
plant.Finalize()
context = plant.CreateDefaultContext()
plant.SetPositions(context, [pi / 2, 0])
print("expected [0. 0. 1.]")
print("found   ", plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("b")).translation().round(12))
