"""PyBullet: joints of an MJCF file without type, which are hinges, and <freejoint> are not read."""

import tempfile

import pybullet

MODEL = """<mujoco model="m"><worldbody><body name="b">{}<geom type="box" size="1 1 1"/>
  </body></worldbody></mujoco>"""

pybullet.connect(pybullet.DIRECT)
for joint in ('<joint name="j" type="hinge" axis="0 1 0"/>', '<joint name="j" axis="0 1 0"/>'):
    pybullet.resetSimulation()
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(MODEL.format(joint))
        file.flush()
        (robot,) = pybullet.loadMJCF(file.name)
    names = [pybullet.getJointInfo(robot, k)[1] for k in range(pybullet.getNumJoints(robot))]
    print(f"{joint}: expected a joint j, found {names}")
