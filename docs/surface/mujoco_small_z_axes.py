"""MuJoCo leaves out the turn of a frame whose zaxis is within 1e-7 rad of its parent's z axis.

A body is turned about x by an angle, once by zaxis and once by a quaternion.
"""

import mujoco
import numpy as np

XML = '<mujoco><worldbody><body {}="{}"><geom size="1"/></body></worldbody></mujoco>'
for angle in (1e-8, 1e-7, 1.1e-7, 1e-6):
    z = (0.0, -np.sin(angle), np.cos(angle))
    quat = (np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0)
    turns = []
    for name, given in (("zaxis", z), ("quat", quat)):
        m = mujoco.MjModel.from_xml_string(XML.format(name, " ".join(f"{x:.17g}" for x in given)))
        turns.append(2 * m.body_quat[1, 1])
    print(f"MuJoCo {mujoco.__version__}: {angle:g} rad: {turns[0]:.4g} by zaxis, {turns[1]:.4g} by quat")
