"""MuJoCo before 4.0: cdof and cdof_dot of a joint by its name or number are not the joint's.

In 3.2.0, 3.2.7, 3.3.2, 3.6.0, 3.12.0 and 3.13.0 `data.joint(j).cdof` starts at the j-th number of the array,
place of the j-th row.  In 4.0.0 both ways give the same.
"""

import mujoco
import numpy as np

XML = """
<mujoco>
  <worldbody>
    <body>
      <joint axis="1 0 0"/><geom size=".1" pos=".3 0 0"/>
      <body pos="1 0 0"><joint axis="0 1 0"/><joint axis="0 0 1"/><geom size=".1" pos=".2 0 0"/></body>
    </body>
  </worldbody>
</mujoco>
"""
m = mujoco.MjModel.from_xml_string(XML)
d = mujoco.MjData(m)
d.qvel[:] = 1.0
mujoco.mj_forward(m, d)
for name in ("cdof", "cdof_dot", "qvel", "xaxis"):
    views = [np.ravel(getattr(d.joint(j), name)) for j in range(3)]
    is_same = np.array_equal(views, np.reshape(getattr(d, name), (3, -1)))
    print(f"MuJoCo {mujoco.__version__}: {name} by joints is {'' if is_same else 'not '}the array's")
