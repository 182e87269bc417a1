"""Drake: settotalmass, flag gravity, and joint defaults through a class without <joint> are not read.

A class of MJCF has all defaults of the class that it is in.  <flag gravity="disable"/> means no gravity.
"""

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

MODEL = """<mujoco model="m"><compiler settotalmass="14"/>
<option><flag gravity="disable"/></option>
<default><joint damping="0.4"/><default class="c"><geom type="sphere"/></default></default>
<worldbody><body name="b" childclass="c"><joint name="j" type="hinge" axis="0 1 0"/><geom size="0.1"/></body>
</worldbody></mujoco>"""

plant = MultibodyPlant(0.0)
Parser(plant).AddModelsFromString(MODEL, "xml")
plant.Finalize()
print("damping: expected 0.4, found", plant.GetJointByName("j").default_damping())
print("mass: expected 14, found", plant.GetBodyByName("b").default_mass())
print("gravity: expected [0. 0. 0.], found", plant.gravity_field().gravity_vector())
