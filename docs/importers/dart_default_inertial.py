"""DART: a URDF link without <inertial> gets a mass of 1 kg and moments of 1 kg m².

The format leaves open what such a link weighs; many robots use it for frames, which weigh nothing.
"""

import tempfile

import dartpy

MODEL = '<robot name="r"><link name="frame"/></robot>'

with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
    file.write(MODEL)
    file.flush()
    skeleton = dartpy.utils.DartLoader().parseSkeleton(file.name)
body = skeleton.getBodyNode("frame")
print("expected 0.0 [0. 0. 0.]")
print("found   ", body.getMass(), body.getInertia().getMoment().diagonal())
