"""MuJoCo before 3.14: moments of joints (`cfrc_int`) count the multipliers of a weld for its moment.

A body that a weld alone holds has nothing to carry in its free joint.  The rows of a weld's attitude are
those of a quaternion: the multipliers of a moment N on its second body, of attitude A, are 2 Aᵀ N.  In 3.2.0
to 3.13.0 the moment in the free joint is 2 Aᵀ N − N.
"""

import mujoco

XML = """<mujoco><worldbody>
  <body name="held" pos="0 0 1" quat="0.8 0.2 0.4 0.4"><freejoint/>
    <inertial mass="2" pos="0.1 0.2 0.3" diaginertia="1 2 2.5"/></body>
</worldbody><equality><weld body1="world" body2="held"/></equality></mujoco>"""
model = mujoco.MjModel.from_xml_string(XML)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
mujoco.mj_rnePostConstraint(model, data)
A, multipliers = data.xmat[1].reshape(3, 3), data.efc_force[3:6]
print("MuJoCo", mujoco.__version__)
print("moment in the free joint", data.cfrc_int[1, :3], "N m, expected 0")
print("multipliers less moment ", multipliers - A @ multipliers / 2, "N m")
