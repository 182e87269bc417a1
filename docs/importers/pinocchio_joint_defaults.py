"""Pinocchio: parts of joints are not read from MJCF files.

pos from a default class, the damping of ball joints, and damping that springdamper="T ζ" defines:
2 m / T, m the mass that the joint moves, here 2 · 3 / 0.1 = 60.
"""

import tempfile

import pinocchio

MODEL = """<mujoco><default><joint pos="0 0 0.3"/></default><worldbody><body name="b">{}
  <inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/></body></worldbody></mujoco>"""


def load(joint):
    """Read a model with one joint."""
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(MODEL.format(joint))
        file.flush()
        return pinocchio.buildModelFromMJCF(file.name)


found = load('<joint name="j" axis="0 1 0"/>').jointPlacements[1].translation
print("pos of the defaults: expected [0. 0. 0.3], found", found)
found = load('<joint name="j" type="ball" damping="0.3"/>').damping
print("damping of a ball joint: expected 0.3, found", found)
found = load('<joint name="j" type="slide" springdamper="0.1 0.5"/>').damping
print("damping by springdamper: expected 60, found", found)
