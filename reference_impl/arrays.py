"""Types of arrays with their shapes, as ``Float[Array, "bodies 3"]``.

Tests check them (tests/helpers/array_checks.py); elsewhere a type with a shape is the type of the array.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
AnyArray = NDArray[Any]  # float, extended, complex or exact entries
Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]

if TYPE_CHECKING:
    from jaxtyping import Bool as Bool
    from jaxtyping import Float as Float
    from jaxtyping import Int as Int
    from jaxtyping import Shaped as Shaped
else:

    class Shaped:
        """The types of arrays, whatever their shapes."""

        def __class_getitem__(cls, item: tuple[Any, str]) -> Any:
            """Return the type of the array."""
            return item[0]

    Bool = Float = Int = Shaped

# r [m] and ṙ [m/s] in the world frame, p and ṗ [1/s], as r, p, ṙ, ṗ
Motion = tuple[
    Shaped[AnyArray, "bodies 3"],
    Shaped[AnyArray, "bodies 4"],
    Shaped[AnyArray, "bodies 3"],
    Shaped[AnyArray, "bodies 4"],
]
