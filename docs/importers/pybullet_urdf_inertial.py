"""PyBullet: inertias of URDF links are diagonalised roughly; links without <inertial> get 1 kg, 1 kg m².

The file's moments are numbers of few digits; the format leaves open what a link without <inertial> weighs.
"""

import tempfile

import numpy as np
import pybullet

INERTIA = np.array([[0.7, 0.01, 0.02], [0.01, 0.8, 0.03], [0.02, 0.03, 0.9]])
MODEL = """<robot name="r"><link name="base"/>
  <link name="a"><inertial><mass value="1"/>
    <inertia ixx="0.7" iyy="0.8" izz="0.9" ixy="0.01" ixz="0.02" iyz="0.03"/></inertial></link>
  <joint name="j" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint>
</robot>"""

pybullet.connect(pybullet.DIRECT)
with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
    file.write(MODEL)
    file.flush()
    robot = pybullet.loadURDF(file.name, flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
_, _, moments, _, turn = pybullet.getDynamicsInfo(robot, 0)[:5]
R = np.array(pybullet.getMatrixFromQuaternion(turn)).reshape(3, 3)
print("expected errors of 1e-16, found", np.abs(R @ np.diag(moments) @ R.T - INERTIA).max())
print("base: expected 0.0, found", *pybullet.getDynamicsInfo(robot, -1)[:1])
