"""PyBullet: a link on a slide is placed by its coordinate times the length of the file's axis.

The format asks for axes of length one.  Where one is not, the mass matrix is that of the unit axis, as with
other importers; the place is not: at q = 1 m the link is 1 m along z.
"""

import tempfile

import pybullet

INERTIAL = '<inertial><mass value="3"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
FILE = f"""<robot name="lift"><link name="base"/><link name="cage">{INERTIAL}</link>
  <joint name="j" type="prismatic"><parent link="base"/><child link="cage"/><axis xyz="0 0 2"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""

pybullet.connect(pybullet.DIRECT)
with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
    print(FILE, file=file, flush=True)
    robot = pybullet.loadURDF(file.name, useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
pybullet.resetJointState(robot, 0, 1.0)
place = pybullet.getLinkState(robot, 0, computeForwardKinematics=True)[0]
print("mass matrix: expected ((3.0,),), found", pybullet.calculateMassMatrix(robot, [1.0]))
print("position of the cage: expected (0.0, 0.0, 1.0), found", place)
