"""Pinocchio's exp6 loses three digits where the turn is a little more than 1e-4 rad.

The translation of exp6 of (v, ω) is the sum of Wᵏ v / (k + 1)! with W ω-skew, a series that converges at once
for small ω.  exp6 has (1 − cos θ) / θ² in place of it, and a short series below 1.2e-4 rad only.
"""

import numpy as np
import pinocchio as pin

v, axis = np.array([1.0, 2.0, -1.5]), np.array([2.0, -1.0, 2.0]) / 3
for angle in (1e-1, 1e-2, 1e-3, 1.3e-4, 1e-4, 1e-5):
    translation, term = np.zeros(3), v
    for k in range(1, 20):
        translation, term = translation + term, np.cross(angle * axis, term) / (k + 1)
    pose = pin.exp6(pin.Motion(np.concatenate([v, angle * axis])))
    off = np.max(np.abs(pose.translation - translation))
    print(f"Pinocchio {pin.__version__}: turn by {angle:g} rad: translation off by {off:.1g} of 2.7")
