"""PyBullet: damping, armature and ref of joints are not read from MJCF files; gravity is the caller's."""

import tempfile

import pybullet

MODEL = """<mujoco model="m"><option gravity="0 0 -1.62"/><worldbody><body name="b">
  <joint name="j" type="slide" axis="0 0 1" damping="0.7" armature="0.5" ref="0.2"/>
  <geom type="box" size="1 1 1" mass="2"/></body></worldbody></mujoco>"""

pybullet.connect(pybullet.DIRECT)
with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
    file.write(MODEL)
    file.flush()
    (robot,) = pybullet.loadMJCF(file.name)
count = pybullet.getNumJoints(robot)
(joint,) = (k for k in range(count) if pybullet.getJointInfo(robot, k)[2] == pybullet.JOINT_PRISMATIC)
mass = sum(pybullet.getDynamicsInfo(robot, k)[0] for k in range(count))
print("damping: expected 0.7, found", pybullet.getJointInfo(robot, joint)[6])
print("mass matrix: expected", mass + 0.5, "found", pybullet.calculateMassMatrix(robot, [0.0])[0][0])
print("height at 0: expected -0.2, found", pybullet.getLinkState(robot, joint, 0, 1)[4][2])
print("gravity: expected -1.62, found", pybullet.getPhysicsEngineParameters()["gravityAccelerationZ"])
