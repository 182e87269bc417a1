"""MuJoCo: axes of inertia that are turned by 1e-6 rad or less from those of the body are taken as aligned.

A free body with moments of 1, 2 and 2.5 kg m² about axes that are turned about z: its mass matrix has the
product of inertia (1 − 2) sin θ cos θ.  From 1e-6 rad down it is 0.
"""

import mujoco
import numpy as np

for angle in (1e-4, 1e-5, 1e-6, 1e-7):
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(mass=1, inertia=[1, 2, 2.5], ipos=[0, 0, 0], explicitinertial=True)
    body.iquat = [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]
    body.add_freejoint()
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    momentum = np.zeros(6)
    mujoco.mj_mulM(model, data, momentum, np.array([0.0, 0, 0, 1, 0, 0]))
    expected = -np.sin(angle) * np.cos(angle)
    print(f"{angle:g} rad: product of inertia {momentum[4]:.9g}, expected {expected:.9g} kg m²")
