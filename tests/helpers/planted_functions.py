"""Wrong functions for engines' modules: each must turn a row of the surface or of a variant red."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pkgutil import resolve_name
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
import pinocchio

Function = Callable[..., Any]
Wrong = Callable[[Any], Any]  # takes a right function, or an enumeration, to a wrong one


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


def with_argument(number: int, value: Any) -> Wrong:
    """What ignores one of its arguments."""
    return lambda right: lambda *given: right(*given[:number], value, *given[number + 1 :])


def after(change: Callable[..., Any]) -> Wrong:
    """What comes after a change of its arguments."""

    def wrong(right: Function) -> Function:
        def changed(*given: Any) -> Any:
            change(*given)
            return right(*given)

        return changed

    return wrong


def with_members(**values: int) -> Wrong:
    """An enumeration of which some members have other values."""
    return lambda right: SimpleNamespace(**{name: int(x) for name, x in right.__members__.items()} | values)


def _with_other_cranks(right: Function) -> Function:
    """Let sliders be on the other side of their cranks' ends."""

    def changed(m: Any, d: Any) -> None:
        right(m, d)
        for a in np.flatnonzero(m.actuator_trntype == mujoco.mjtTrn.mjTRN_SLIDERCRANK):
            end, slider = m.actuator_trnid[a]
            arm = d.site_xpos[end] - d.site_xpos[slider]
            along = arm @ d.site_xmat[slider].reshape(3, 3)[:, 2]
            root = np.sqrt(max(0.0, m.actuator_cranklength[a] ** 2 + along**2 - arm @ arm))
            d.actuator_length[a] += 2 * root

    return changed


def _integrate_filters(m: Any, *_: Any) -> None:
    m.actuator_dyntype[m.actuator_dyntype == mujoco.mjtDyn.mjDYN_FILTER] = mujoco.mjtDyn.mjDYN_INTEGRATOR


def _forget_filters_decay(m: Any, *_: Any) -> None:
    kinds = mujoco.mjtDyn
    m.actuator_dyntype[m.actuator_dyntype == kinds.mjDYN_FILTEREXACT] = kinds.mjDYN_INTEGRATOR


def _switch_all_on(_: Any, d: Any) -> None:
    d.eq_active[:] = 1


def _let_all_sleep(m: Any, *_: Any) -> None:
    m.tree_sleep_policy[:] = mujoco.mjtSleepPolicy.mjSLEEP_ALLOWED


def _forget_discrete_steps(m: Any, _: Any) -> None:
    m.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)


def _copied_with(change: Callable[[Any], Any]) -> Wrong:
    """What returns a description that is changed."""

    def wrong(right: Function) -> Function:
        def copied(*given: Any) -> Any:
            found = right(*given)
            change(found)
            return found

        return copied

    return wrong


def _forget_gravity(spec: Any) -> None:
    spec.option.gravity = [0.0, 0.0, 0.0]


def _double_masses(spec: Any) -> None:
    for body in list(spec.bodies)[1:]:
        body.mass = 2 * body.mass


def _forget_stiffness(spec: Any) -> None:
    for joint in spec.joints:
        joint.stiffness = 0 * np.array(joint.stiffness)


def _forget_own_defaults(right: Function) -> Function:
    """Attach, and let the rotor of the other's default be that of every joint."""

    def attach(whole: Any, part: Any, **given: Any) -> Any:
        found = right(whole, part, **given)
        for joint in whole.joints:
            joint.armature = whole.default.joint.armature
        return found

    return attach


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
        {"mju_quat2Vel": with_argument(2, 1.0)},
        {"mju_quatIntegrate": with_argument(2, 1.0)},
        {"mj_inverse": after(_forget_discrete_steps)},
        {"mj_fwdPosition": _with_other_cranks},
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
# Of MuJoCo a name of the variant, and what is planted: in trees with elements, or in a loop.
VARIANT_PLANTS: list[tuple[str, dict[str, Wrong]]] = [
    (
        "mj_integratePos",
        {"mj_differentiatePos": with_argument(2, 1.0), "mj_integratePos": with_argument(3, 1.0)},
    ),
    ("mj_normalizeQuat", {"mj_normalizeQuat": constant(None)}),
    ("mj_defaultOption", {"mj_defaultOption": constant(None)}),
    ("MjsFrame", {"MjsBody.set_frame": constant(None)}),
    ("MjsFrame", {"MjsFrame.set_frame": constant(None)}),
    ("set_mjcb_act_dyn", {"set_mjcb_act_dyn": constant(None)}),
    ("mjtDyn.mjDYN_FILTER", {"mj_forward": after(_integrate_filters)}),
    ("mjtDyn.mjDYN_FILTEREXACT", {"mj_forward": after(_forget_filters_decay)}),
    ("MjsDefault", {"MjSpec.attach": _forget_own_defaults}),
    ("MjSpec", {"MjSpec.copy": _copied_with(_forget_gravity)}),
    ("MjSpec", {"MjSpec.copy": _copied_with(_double_masses)}),
    ("MjSpec", {"MjSpec.copy": _copied_with(_forget_stiffness)}),
    ("mjtSleepPolicy", {"mj_step": after(_let_all_sleep)}),
    ("mj_comVel", {"mj_comVel": constant(None)}),
    ("mj_comVel", {"mj_passive": constant(None)}),
    ("mj_comVel", {"mj_rne": constant(None)}),
    ("mjtDisableBit.mjDSBL_SPRING", {"mjtDisableBit": with_members(mjDSBL_SPRING=0)}),
    ("mjtDisableBit.mjDSBL_DAMPER", {"mjtDisableBit": with_members(mjDSBL_DAMPER=0)}),
    ("mjtDisableBit.mjDSBL_LIMIT", {"mjtDisableBit": with_members(mjDSBL_LIMIT=0, mjDSBL_CONSTRAINT=0)}),
]
LOOP_PLANTS: list[tuple[str, dict[str, Wrong]]] = [
    ("MjData.eq_active", {"mj_forward": after(_switch_all_on)}),
    ("mj_referenceConstraint", {"mj_referenceConstraint": constant(None)}),
]
