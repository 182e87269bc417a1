"""The mechanism that the equations are written for: an open chain of rigid bodies on rods and ball joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mechanism:
    """An open chain of N rigid bodies, each hung from the one before and the first from the world origin.

    Joint k connects body k to body k−1, joint 0 to the pivot.  ``length[k] > 0`` makes it the notes'
    massless rigid rod with a ball joint at both ends, ``length[k] == 0`` a ball joint, the limit ℓ → 0 (E1).
    N = 1 and N = 2 on rods are the notes' own pendulums.
    """

    mass: Array  # (N,) kg
    inertia: Array  # (N, 3, 3) kg m², J about the centre of mass, body frame
    proximal: Array  # (N, 3) m, body frame, where body k hangs: s_1 of body 1, s_3 of body 2
    distal: Array  # (N, 3) m, body frame, where body k+1 hangs on body k: s_2; unused for the last body
    length: Array  # (N,) m, ℓ of joint k, 0 for a ball joint
    gravity: Array  # (3,) m/s², world frame
    force: Array  # (N, 3) N, constant applied force at the centre of mass, world frame
    moment: Array  # (N, 3) N m, constant applied moment n′, body frame
    drag_force: Array  # (N,) N s/m, c_t: F = −c_t ṙ at the centre of mass
    drag_moment: Array  # (N,) N m s, c_r: n′ = −c_r ω′

    @property
    def n(self) -> int:
        """Number of bodies."""
        return len(self.mass)

    @property
    def rods(self) -> NDArray[np.bool_]:
        """(N,) True where joint k is a rod."""
        return np.asarray(self.length > 0)

    @property
    def has_drag(self) -> bool:
        """Whether any body feels drag."""
        return bool(np.any(self.drag_force) or np.any(self.drag_moment))

    @property
    def has_loads(self) -> bool:
        """Whether any constant force or moment is applied."""
        return bool(np.any(self.force) or np.any(self.moment))
