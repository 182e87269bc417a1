"""DART: an MJCF body without pos is put at its first <geom>.

The default of pos is 0 0 0: a geom's pose says where the geom is in its body.
"""

import tempfile

import dartpy

MODEL = """<mujoco model="m"><worldbody><body name="a"><joint name="j" type="hinge" axis="0 1 0"/>
  <geom type="sphere" size="0.1"/><body name="b"{}><geom type="sphere" size="0.1" pos="0.5 0 0"/></body>
</body></worldbody></mujoco>"""

for pos in (' pos="0 0 0"', ""):
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(MODEL.format(pos))
        file.flush()
        skeleton = dartpy.utils.MjcfParser.readWorld(file.name).getSkeleton(0)
    print("expected [0. 0. 0.], found", skeleton.getBodyNode("b").getWorldTransform().translation())
