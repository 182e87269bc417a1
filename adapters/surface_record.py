"""What the files about engines' surfaces share: the answer of one state, to which functions add rows."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np

from plumbline.model.datatypes import Array, Call, Float

Answer = dict[str, dict[Call, Array]]  # by quantity and names of the engine that find it


class SurfaceRecord:
    """By quantity and names the rows found; ``rates`` takes ν to the engine's velocities, if it has any."""

    def __init__(self, rates: Float[Array, "nv nu"] | None = None) -> None:
        self.found = defaultdict[str, dict[Call, Array]](dict)
        self.rates = rates

    def add(self, quantity: str, names: str, value: Any) -> None:
        """Add rows, found by these names of the engine: of all bodies, or one of the mechanism."""
        self.found[quantity][tuple(names.split())] = np.array(np.atleast_2d(value), float)

    def add_halves(self, quantities: tuple[str, str], names: str, vectors: Any) -> None:
        """Add the two halves of spatial vectors."""
        for quantity, half in zip(quantities, np.split(np.atleast_2d(vectors), 2, 1), strict=True):
            self.add(quantity, names, half)

    def add_axes(self, names: str, turns: Any) -> None:
        """Add the axes of the probe frames, of attitudes as matrices."""
        self.add("frame_axes", names, np.reshape(np.array(turns).swapaxes(-1, -2), (-1, 3)))

    def add_forces(self, quantity: str, forces: Mapping[str, Array]) -> None:
        """Add forces on ν in place of those on the engine's velocities, by the names that find them."""
        assert self.rates is not None
        for names, force in forces.items():
            self.add(quantity, names, (self.rates.T @ force)[:, None])
