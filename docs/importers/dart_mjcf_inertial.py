"""DART: of an MJCF body's <inertial>, mass and centre count only beside a <geom>, moments never."""

import tempfile

import dartpy

MODEL = """<mujoco model="m"><worldbody><body name="b"><joint name="j" type="hinge" axis="0 1 0"/>
  <inertial pos="0.5 0 0" mass="3" diaginertia="1 2 2.5"/>{}</body></worldbody></mujoco>"""

for geom in ("", '<geom type="box" size="1 1 1"/>'):
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(MODEL.format(geom))
        file.flush()
        skeleton = dartpy.utils.MjcfParser.readWorld(file.name).getSkeleton(0)
    body = skeleton.getBodyNode(0)
    print("expected 3.0 [0.5 0. 0.] [1. 2. 2.5]")
    print("found   ", body.getMass(), body.getLocalCOM(), body.getInertia().getMoment().diagonal())
