"""Pinocchio: of an MJCF file only the first body in <worldbody> is read.

Two bodies on a hinge each have two degrees of freedom.
"""

import tempfile

import pinocchio

BODY = """<body name="{}"><joint axis="0 1 0" name="{}"/>
  <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>"""
MODEL = f"<mujoco><worldbody>{BODY.format('a', 'j')}{BODY.format('b', 'k')}</worldbody></mujoco>"

with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
    file.write(MODEL)
    file.flush()
    model = pinocchio.buildModelFromMJCF(file.name)
print(f"expected 2, found {model.nv}: {list(model.names)}")
