"""Probe frames: one on each body, at which what an engine reports of points and frames is compared.

They are at no special place and have no special attitude, so that no term of a velocity or an acceleration of
a point vanishes and no two axes can be exchanged unseen.
"""

from __future__ import annotations

import numpy as np

from plumbline.model.datatypes import Array, Float, Model
from plumbline.model.kinematics import rotation_matrix

PROBE_ATTITUDE = np.array([1.0, 2.0, 3.0, 4.0]) / np.sqrt(30.0)  # quaternion, probe axes → body axes
PROBE_TURN = rotation_matrix(PROBE_ATTITUDE)
_DIRECTION = np.array([2.0, -3.0, 6.0]) / 7.0


def probe_points(model: Model) -> Float[Array, "bodies 3"]:
    """Place the probe frames.

    Returns:
        Their origins [m] from the centres of mass, in the bodies' axes: half as far from the near point as
        that is from the centre, or as far as the body's radius of gyration where the two coincide.

    """
    near = model.proximal[: model.n]  # of each body's own joint
    arm = np.linalg.norm(near, axis=-1)
    gyration = np.sqrt(np.linalg.norm(model.inertia, axis=(1, 2)) / model.mass)
    size = np.where(arm > 0, arm / 2, gyration)
    return np.asarray(near + size[:, None] * _DIRECTION)


def anchor_point(model: Model) -> Float[Array, "3"]:
    """A point of the world [m] from which distances are taken; no chain reaches it."""
    lengths = (np.linalg.norm(model.point, axis=-1), model.length[:, None])
    reach = sum(float(np.sum(np.abs(x))) for x in lengths) + float(np.sum(np.abs(model.proximal)))
    return np.asarray(2 * max(reach, float(np.max(np.abs(probe_points(model))))) * _DIRECTION)
