"""The chain of bodies that the notes' equations are written for, usable without the rest of the project."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Chain:
    """An open chain of N rigid bodies, each hung from the one before and the first from the world origin.

    ``length[k] > 0`` makes joint k the notes' massless rigid rod with a ball joint at both ends,
    ``length[k] == 0`` the ball joint, its limit ℓ → 0 (E1).  N = 1 and
    N = 2 on rods are the notes' own pendulums.
    """

    mass: Array  # (N,) kg
    inertia: Array  # (N, 3, 3) kg m², J about the centre of mass, body frame
    proximal: Array  # (N, 3) m, body frame: s_1 of body 1, s_3 of body 2, where the body hangs
    distal: Array  # (N, 3) m, body frame: s_2 of body 1, where the next one hangs; unused for the last
    length: Array  # (N,) m, ℓ of joint k
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
