"""Exudyn: the URDF loader leaves links on fixed joints out, with their mass.

Two links of 1 kg each, fixed to each other, move as one body of 2 kg.
"""

import tempfile
from pathlib import Path

from exudyn.robotics.utilities import GetURDFrobotData, LoadURDFrobot

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
MODEL = f"""<robot name="r"><link name="base"/><link name="a">{INERTIAL}</link>
  <link name="b">{INERTIAL}</link>
  <joint name="j" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint>
  <joint name="f" type="fixed"><parent link="a"/><child link="b"/></joint></robot>"""

with tempfile.TemporaryDirectory() as folder:
    Path(folder, "r.urdf").write_text(MODEL)
    loaded = LoadURDFrobot("r.urdf", folder)
links = GetURDFrobotData(loaded["robot"], loaded["urdf"], verbose=0)["linkList"]
print("expected 2.0, found", sum(link["mass"] for link in links))
