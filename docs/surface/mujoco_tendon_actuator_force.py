"""MuJoCo's sensor of the actuator force at a tendon leaves out the gears; the sensor at a joint has them.

A slide carries a tendon along it, with coefficient 1: what acts on the tendon acts on the slide.  Two motors
are on the tendon, with gears 2 and −1 and the same control 1: they pull with 2 − 1 = 1 N, which the array of
forces and the sensor at the joint say.  The sensor at the tendon says 1 + 1 = 2 N.  The limit of the total
force at a tendon, actuatorfrcrange, is of the same sum.
"""

import mujoco

XML = """
<mujoco>
  <worldbody>
    <body>
      <joint name="slide" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
    </body>
  </worldbody>
  <tendon><fixed name="tendon"><joint joint="slide" coef="1"/></fixed></tendon>
  <actuator><motor tendon="tendon" gear="2"/><motor tendon="tendon" gear="-1"/></actuator>
  <sensor><tendonactuatorfrc tendon="tendon"/><jointactuatorfrc joint="slide"/></sensor>
</mujoco>
"""
m = mujoco.MjModel.from_xml_string(XML)
d = mujoco.MjData(m)
d.ctrl[:] = 1.0
mujoco.mj_forward(m, d)
print(
    f"MuJoCo {mujoco.__version__}: {d.qfrc_actuator[0]} N act on the slide, its acceleration is {d.qacc[0]}"
)
print(f"sensor at the joint {d.sensordata[1]} N, sensor at the tendon {d.sensordata[0]} N")
