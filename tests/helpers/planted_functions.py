"""Wrong functions for engines' modules: each must turn a row of the surface or of a variant red."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pkgutil import resolve_name
from typing import Any
from unittest.mock import patch

import numpy as np
import pinocchio

Function = Callable[..., Any]
Wrong = Callable[[Function], Function]  # takes a right function to a wrong one


def times(factor: float) -> Wrong:
    """What returns the right result times a factor."""
    return lambda right: lambda *given: factor * np.asarray(right(*given))


def constant(value: Any) -> Wrong:
    """What returns the same whatever it is given."""
    return lambda _: lambda *_: value


def reordered(*order: int) -> Wrong:
    """What takes its arguments in another order."""
    return lambda right: lambda *given: right(*(given[i] for i in order), *given[len(order) :])


def with_entries(value: float, *where: Any) -> Wrong:
    """What returns the right matrix with other entries in a part of it."""

    def wrong(right: Function) -> Function:
        def change(*given: Any) -> Any:
            found = np.array(right(*given))
            found[where] = value
            return found

        return change

    return wrong


def with_outputs(factor: float, *numbers: int) -> Wrong:
    """What writes some of its arguments times a factor."""

    def wrong(right: Function) -> Function:
        def change(*given: Any) -> None:
            right(*given)
            for i in numbers:
                given[i][:] *= factor

        return change

    return wrong


class TwiceWrongCircle:
    """A group whose difference and step are wrong, and right together."""

    def __init__(self) -> None:
        self.right = RIGHT_CIRCLE()

    def difference(self, before: Any, there: Any) -> Any:
        return -5 * np.array(self.right.difference(before, there))

    def integrate(self, before: Any, step: Any) -> Any:
        return self.right.integrate(before, -np.array(step) / 5)


RIGHT_CIRCLE = pinocchio.liegroups.SO2
DIAGONAL = np.arange(3), np.arange(3)
HALVES = slice(0, 3), slice(3, None)


@contextmanager
def wrong_functions(engine: str, plants: Mapping[str, Wrong]) -> Iterator[None]:
    """Plant wrong functions in an engine's module."""
    with ExitStack() as stack:
        for path, wrong in plants.items():
            whole = f"{engine}.{path}"
            stack.enter_context(patch(whole, wrong(resolve_name(whole))))
        yield


# By engine what is planted: by path of a function what makes a wrong one of it.
SURFACE_PLANTS: Mapping[str, list[dict[str, Wrong]]] = {
    "pinocchio": [
        {"tangentMap": times(-3)},
        {name: times(-3) for name in dir(pinocchio) if "angentMap" in name},
        {"normalize": lambda _: lambda _, q: q},
        {"isNormalized": constant(True)},
        {"isSameConfiguration": constant(True)},
        {"interpolate": reordered(0, 2, 1)},
        {"dIntegrate": times(-3), "dIntegrateTransport": times(-3)},
        {"skewSquare": reordered(1, 0)},
        {"liegroups.SO2": lambda _: TwiceWrongCircle},
        {"skew": with_entries(7.0, *DIAGONAL)},
    ],
    "mujoco": [
        {"mj_jacPointAxis": with_outputs(-2, 3)},
        {"mjd_quatIntegrate": with_outputs(-3, -2)},
        {"mjd_quatIntegrate": with_outputs(-3, -1)},
        {"mjd_subQuat": with_outputs(-3, -1)},
    ],
    "exudyn": [
        {"SystemData.GetODE2Coordinates_t": lambda right: lambda own, *_: right(own)},
        {"SystemData.SetODE2Coordinates_t": constant(None)},
        *(
            {name: with_entries(7.0, *where)}
            for name, *where in (
                ("rigidBodyUtilities.Skew", *DIAGONAL),
                ("rigidBodyUtilities.ComputeSkewMatrix", *DIAGONAL),
                ("lieGroupBasics.LogSO3", *DIAGONAL),
                ("lieGroupBasics.LogSE3", 3, 2),
                ("rigidBodyUtilities.RotationTranslation2T66", *HALVES),
                ("rigidBodyUtilities.RotationX2T66", *HALVES[::-1]),
                ("rigidBodyUtilities.RotationTranslation2T66Inverse", *HALVES[:1] * 2),
                ("rigidBodyUtilities.Translation2T66", *HALVES[:1] * 2),
                ("rigidBodyUtilities.HTtranslateX", *HALVES[:1] * 2),
                ("rigidBodyUtilities.HTrotateX", HALVES[0], 3),
                ("rigidBodyUtilities.HomogeneousTransformation", 3),
                ("rigidBodyUtilities.InverseHT", 3),
                ("lieGroupBasics.R3xSO3Matrix", 6),
            )
        ),
    ],
}
