"""DART: springs, armature and ref of joints, and <option gravity>, are not read from MJCF files.

The body is a ball of 1 kg on an arm of 1 m; at q = 0 the hinge's coordinate is off its ref by −90°, so that
the arm, drawn along z, points along −x.
"""

import tempfile

import dartpy

MODEL = """<mujoco model="m"><option gravity="0 0 -1.62"/><compiler angle="degree"/>
  <worldbody><body name="b" pos="0 0 0">
    <joint name="j" type="hinge" axis="0 1 0" pos="0 0 -1" ref="90" stiffness="3" armature="0.5"/>
    <geom type="sphere" size="0.1" mass="1"/></body></worldbody></mujoco>"""

with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
    file.write(MODEL)
    file.flush()
    world = dartpy.utils.MjcfParser.readWorld(file.name)
skeleton = world.getSkeleton(0)
joint, body = skeleton.getJoint(0), skeleton.getBodyNode(0)
print("gravity: expected [0. 0. -1.62], found", skeleton.getGravity())
print("stiffness: expected 3.0, found", joint.getSpringStiffness(0))
print("position: expected [-1. 0. -1.], found", body.getWorldTransform().translation())
moment = body.getInertia().getMoment()[1, 1]
print("mass matrix: expected", moment + 1 + 0.5, "found", skeleton.getMassMatrix()[0, 0])
