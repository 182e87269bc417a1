"""PyBullet: diaginertia of an MJCF file is not read; numbers are kept in single precision."""

import tempfile

import pybullet

MODEL = """<mujoco model="m"><worldbody><body name="b"><joint name="j" type="hinge" axis="0 1 0"/>
  <inertial pos="0.1 0 0" mass="3" diaginertia="1 2 2.5"/></body></worldbody></mujoco>"""

pybullet.connect(pybullet.DIRECT)
with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
    file.write(MODEL)
    file.flush()
    (robot,) = pybullet.loadMJCF(file.name)
links = [pybullet.getDynamicsInfo(robot, k) for k in range(-1, pybullet.getNumJoints(robot))]
(link,) = (info for info in links if info[0] > 0)
print("expected 3.0 (1.0, 2.0, 2.5) (0.1, 0.0, 0.0)")
print("found   ", link[0], link[2], link[3])
