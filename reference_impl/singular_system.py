"""The exception of the reference."""

from __future__ import annotations


class SingularSystem(ArithmeticError):
    """S of (N5) is singular, so accelerations and multipliers are not defined; the message names the cause.

    Causes (E1, E7 of the notes): a rod whose ends coincide, p = 0, an inertia or a mass that is not
    positive, joints that do not constrain independently.
    """
