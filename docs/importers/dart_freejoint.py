"""DART: <freejoint> in an MJCF file is not read; <joint type="free"> is.

A free body has six degrees of freedom.
"""

import tempfile

import dartpy

MODEL = """<mujoco model="m"><worldbody><body name="b">{}
  <geom type="box" size="1 1 1" mass="1"/></body></worldbody></mujoco>"""

for joint in ('<joint type="free"/>', "<freejoint/>"):
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(MODEL.format(joint))
        file.flush()
        skeleton = dartpy.utils.MjcfParser.readWorld(file.name).getSkeleton(0)
    print(f"{joint}: expected 6, found {skeleton.getNumDofs()}")
