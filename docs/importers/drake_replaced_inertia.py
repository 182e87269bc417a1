"""Drake: where mass and inertia of a URDF link are not those of a rigid body, others replace them.

The file says a mass of 0, and moments of inertia of (0.1, 0.1, 0.3) that violate A + B >= C.  Drake warns.
"""

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

MODEL = """<robot name="r"><link name="a"><inertial><mass value="{}"/>
  <inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""

for mass, *moments in ((0, 0.001, 0.001, 0.001), (1, 0.1, 0.1, 0.3)):
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(MODEL.format(mass, *moments), "urdf")
    plant.Finalize()
    link = plant.GetBodyByName("a")
    inertia = link.default_spatial_inertia().CalcRotationalInertia().get_moments()
    print("expected", mass, moments)
    print("found   ", link.default_mass(), inertia)
