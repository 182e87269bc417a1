"""A tree of MuJoCo at a state with probe frames on its bodies, and what is found of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from adapters.surface_record import SurfaceRecord
from plumbline.model.datatypes import Array, Float, Indices, Int
from plumbline.model.kinematics import rotation_matrix

ANCHOR = "anchor"  # site of the world, with the attitude of probe frames


class Probed(SurfaceRecord):
    """Model and data after the forward dynamics; ``links``: the bodies."""

    def __init__(self, m: Any, d: Any, links: Sequence[int], rates: Float[Array, "nv nu"]) -> None:
        super().__init__(rates)
        self.m, self.d, self.links = m, d, list(links)
        self.sites = self.ids("site")

    def ids(self, kind: str, end: str = "") -> Int[Indices, "bodies"]:
        """Numbers of the sites, tendons or others of the probe frames."""
        return np.array([getattr(self.m, kind)(f"probe {k}{end}").id for k in range(len(self.links))])

    def sensors(self, name: str, data: Any = None) -> Float[Array, "bodies d"]:
        """What sensors of this kind at all bodies say, in other data where some are given."""
        return np.array([(data or self.d).sensor(f"{name} {k}").data.copy() for k in range(len(self.links))])

    def add_attitudes(
        self, names: str, attitudes: Float[Array, "bodies d"], of: Float[Array, "bodies 3 3"] | None = None
    ) -> None:
        """Add the axes of the probe frames by quaternions or matrices: theirs, or those times others."""
        turns = rotation_matrix(attitudes) if attitudes.shape[-1] == 4 else attitudes.reshape(-1, 3, 3)
        self.add_axes(names, turns if of is None else turns @ of)
