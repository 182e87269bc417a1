"""Closed-form motions, independent of every engine and of the notes' equations.

`closed_form_motion` takes a scenario that names its closed form, checks that the scenario fulfils the
conditions of that motion, and returns the motion as a function of time.  The families: planar
pendulum, heavy symmetric top (and spherical pendulum), free top, steady motions (equilibria and conical
motions), small oscillations, damped oscillator.  After 2 s the results are accurate to 3e-15 m and 2e-14 rad
for the scenarios of the catalogue; an axis that passes the vertical at an angle δ loses a factor 1/δ² in its
azimuth.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from plumbline.model.datatypes import Array, Model, State
from plumbline.truth.closed_form.linear_and_steady_motions import (
    damped_oscillator,
    equilibrium,
    small_oscillation,
    steady_rotation,
)
from plumbline.truth.closed_form.motion import ClosedFormMismatch, ClosedFormMotion
from plumbline.truth.closed_form.tops_and_pendulums import (
    free_top,
    lagrange_top,
    planar_pendulum,
    spherical_pendulum,
)

if TYPE_CHECKING:
    from plumbline.scenario.loader import Scenario

__all__ = ["CLOSED_FORMS", "ClosedFormMismatch", "ClosedFormMotion", "closed_form_motion", "exact_samples"]

CLOSED_FORMS: dict[str, Callable[[Model, State], ClosedFormMotion]] = {
    "planar-pendulum": planar_pendulum,
    "spherical-pendulum": spherical_pendulum,
    "lagrange-top": lagrange_top,
    "free-top": free_top,
    "conical": steady_rotation,
    "double-conical": steady_rotation,
    "small-double": small_oscillation,
    "small-chain": small_oscillation,
    "rest": equilibrium,
    "damped-oscillator": damped_oscillator,
}


def closed_form_motion(scenario: Scenario) -> ClosedFormMotion | None:
    """Return the closed-form motion that a scenario names.

    Args:
        scenario: its model and initial state must be the motion that ``closed_form`` names.

    Returns:
        The motion; None where the scenario names no closed form.

    Raises:
        ClosedFormMismatch: the scenario violates a condition of its closed form.

    """
    if scenario.closed_form is None:
        return None
    return CLOSED_FORMS[scenario.closed_form](scenario.model, scenario.state)


def exact_samples(scenario: Scenario, times: Array) -> tuple[Array, Array, str] | None:
    """Sample the closed form that a scenario names, unless it is asymptotic.

    Args:
        scenario: its model and initial state must be the motion that ``closed_form`` names.
        times: (T,) [s].

    Returns:
        Positions (T, N, 3) [m], attitudes (T, N, 4) and the source; None where there is no exact motion.

    Raises:
        ClosedFormMismatch: the scenario violates a condition of its closed form.

    """
    closed = closed_form_motion(scenario)
    return (*closed(times), closed.source) if closed and closed.amplitude == 0 else None
