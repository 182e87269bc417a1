"""Pinocchio: some masses of geoms are not read from MJCF files.

A mass that a default class gives, compiler settotalmass, and geoms that collide with nothing, which have
mass in MJCF like others (1000 kg/m³ × 4/3 π 0.1³ = 4.18879 kg).
"""

import tempfile
from math import pi

import pinocchio

BODY = '<worldbody><body name="b"><joint name="j"/>{}</body></worldbody>'
GEOM = '<geom type="sphere" size="0.1"/>'
CASES = (
    ("mass of the defaults", '<default><geom mass="1"/></default>', GEOM, 1.0),
    ("settotalmass", '<compiler settotalmass="14"/>', GEOM, 14.0),
    ("no collision", "", GEOM.replace("/>", ' contype="0" conaffinity="0"/>'), 1000 * 4 / 3 * pi * 1e-3),
)

for name, head, geom, expected in CASES:
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(f"<mujoco>{head}{BODY.format(geom)}</mujoco>")
        file.flush()
        model = pinocchio.buildModelFromMJCF(file.name)
    print(f"{name}: expected {expected:.5f} kg, found {model.inertias[1].mass:.5f} kg")
