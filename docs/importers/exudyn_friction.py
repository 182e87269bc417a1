"""Exudyn: the URDF loader reads no damping, and a joint's friction becomes viscous friction.

`friction` is a force in N m, `damping` a coefficient in N m s/rad; the loader's motorViscousFriction is a
coefficient too, which the caller applies.  It comes from the Robotics Toolbox, which sets B to the friction.
"""

import tempfile
from pathlib import Path

from exudyn.robotics.utilities import GetURDFrobotData, LoadURDFrobot

MODEL = """<robot name="r"><link name="base"/><link name="a"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
    <dynamics damping="0.7" friction="0.2"/></joint></robot>"""

with tempfile.TemporaryDirectory() as folder:
    Path(folder, "r.urdf").write_text(MODEL)
    loaded = LoadURDFrobot("r.urdf", folder)
(link,) = GetURDFrobotData(loaded["robot"], loaded["urdf"], verbose=0)["linkList"]
print("expected 0.7, found", link["motorViscousFriction"])
