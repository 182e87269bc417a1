"""MuJoCo: a URDF link with inertia and no mass, fixed to another one, loses its inertia.

The two links are one rigid body: their moments of inertia about the common point add up.
"""

import mujoco

INERTIAL = '<inertial><mass value="{}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
MODEL = f"""<robot name="r"><link name="base"/>
  <link name="a">{INERTIAL.format(1)}</link><link name="b">{INERTIAL}</link>
  <joint name="j" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint>
  <joint name="f" type="fixed"><parent link="a"/><child link="b"/></joint></robot>"""

for mass in (1e-6, 0):
    model = mujoco.MjModel.from_xml_string(MODEL.format(mass))
    print(f"mass {mass}: expected 2.0, found {model.body_inertia[-1][2]}")
