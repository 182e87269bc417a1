"""MuJoCo's boundmass puts the mass of a body that has none at twice the body's offset from its parent.

A hinge carries a body and, 1 m away and rigidly, one with no shape and no inertia, as the dummy links of URDF
files are.  With boundmass="1" it has 1 kg, which adds 1 kg m² about the hinge.  MuJoCo adds 4 kg m²: the
centre of mass in the body's own frame, body_ipos, is the body's position in its parent's.  Of the same body
with a shape of 1e-9 kg it adds 1 kg m².
"""

import mujoco
import numpy as np

XML = """
<mujoco>
  <compiler boundmass="1"/>
  <worldbody>
    <body>
      <joint axis="0 1 0"/>
      <inertial pos="0 0 0" mass="5" diaginertia="1 1 1"/>
      <body pos="1 0 0">{}</body>
    </body>
  </worldbody>
</mujoco>
"""
for shape in ("", '<geom size="1e-3" mass="1e-9"/>'):
    m = mujoco.MjModel.from_xml_string(XML.format(shape))
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    inertia = np.zeros(1)
    mujoco.mj_mulM(m, d, inertia, np.ones(1))
    print(f"MuJoCo {mujoco.__version__}, {shape or 'no shape'}: {m.body_mass[2]} kg at {m.body_ipos[2]}:")
    print(f"    {inertia[0]:.9g} kg m² about the hinge, expected 2")
