"""Exudyn: about an axis that is none of x, y, z the URDF loader turns the link and not what it carries.

The loader makes the axis the link's z axis.  The centre of mass (0, 1, 0) is then at R^T (0, 1, 0), where R,
the first three columns of preHT, turns z to the axis (0, 0.6, 0.8).
"""

import tempfile
from pathlib import Path

import numpy as np
from exudyn.robotics.utilities import GetURDFrobotData, LoadURDFrobot

MODEL = """<robot name="r"><link name="base"/><link name="a"><inertial><origin xyz="0 1 0"/><mass value="1"/>
  <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0.6 0.8"/></joint>
</robot>"""

with tempfile.TemporaryDirectory() as folder:
    Path(folder, "r.urdf").write_text(MODEL)
    loaded = LoadURDFrobot("r.urdf", folder)
(link,) = GetURDFrobotData(loaded["robot"], loaded["urdf"], verbose=0)["linkList"]
R = np.array(link["preHT"])[:3, :3]
print("expected", (R.T @ [0, 1, 0]).round(12), "found", np.array(link["com"]))
