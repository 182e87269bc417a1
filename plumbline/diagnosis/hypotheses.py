"""Table of hypotheses: what may be wrong in the inputs or equations of an engine or its adapter.

Every `Cause` is one change, of a number (`_number_causes`), of a factor on fields or velocity terms
(`FACTORS`), or of a convention (`CONVENTIONS`).  Its description completes "behaves as if …".
Bodies and rods count from 1; axes x, y, z are those of the body unless stated otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from plumbline.diagnosis.defect_model import MODEL_FIELDS, DefectCase
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import (
    cross_matrix,
    quaternion_conjugate,
    quaternion_product,
    rotate_vectors,
    rotation_matrix,
)

AXES = "xyz"
Alter = Callable[[DefectCase, float], DefectCase]


@dataclass(frozen=True)
class Cause:
    """The hypothesis that the engine computes with ``alter(case, x)``, where x = ``nominal`` is right.

    ``describe(x, resolution)`` completes "behaves as if …".  ``scale`` is the natural size of a change of x;
    None for a convention, which has no amount to fit.
    """

    alter: Alter
    describe: Callable[[float, float], str]
    nominal: float = 0.0
    scale: float | None = None


@dataclass(frozen=True)
class Factor:
    """Fields multiplied together by a factor that should be 1."""

    fields: tuple[str, ...]
    subject: str
    if_zero: str | None = None  # description of the factor 0; default "{subject} were missing"
    applies: Callable[[DefectCase], bool] = lambda case: True


@dataclass(frozen=True)
class Convention:
    """Another frame, order, sign or reference point for some fields."""

    description: str
    change: Callable[[DefectCase], dict[str, Array]]
    needs: str = "mass"  # a field that must not be zero for the convention to matter


def to_world(case: DefectCase, v: Array) -> Array:
    """Rotate vectors from the body frames into the world frame.

    Args:
        case: mechanisms and states, of which the attitudes are used.
        v: (B, N, 3) vectors, body frames.

    Returns:
        A v, (B, N, 3), world frame.

    """
    return rotate_vectors(rotation_matrix(case.p), v)


def to_body(case: DefectCase, v: Array) -> Array:
    """Rotate vectors from the world frame into the body frames.

    Args:
        case: mechanisms and states, of which the attitudes are used.
        v: (B, N, 3) vectors, world frame.

    Returns:
        Aᵀ v, (B, N, 3), body frames.

    """
    return rotate_vectors(rotation_matrix(case.p).mT, v)


def _has_rods(case: DefectCase) -> bool:
    return bool(np.any(case.length))


def _has_two_bodies(case: DefectCase) -> bool:
    return case.n > 1


FACTORS = (
    Factor(("mass", "inertia"), "all masses and inertias"),
    Factor(("proximal", "distal", "length"), "all lengths"),
    Factor(("inertia",), "all inertias"),
    Factor(("mass",), "all masses"),
    Factor(("gravity",), "gravity's size", "there were no gravity",  # along one axis: see `gravity z`
           lambda case: int(np.count_nonzero(case.gravity[0])) > 1),
    Factor(("omega",), "angular rates ω′"),
    Factor(("udot",), "rod rates u̇"),
    Factor(("omega", "udot"), "all rates", None, _has_rods),
    Factor(("drag_force",), "drag on forces", "it were without drag on forces"),
    Factor(("drag_moment",), "drag on moments", "it were without drag on moments"),
    Factor(("force",), "applied forces"),
    Factor(("moment",), "applied moments"),
    Factor(("force", "moment"), "applied loads", "it were without applied loads",
           lambda case: bool(np.any(case.force) and np.any(case.moment))),
    Factor(("gyroscopic_factor",), "the gyroscopic term (8 L̇ᵀJL̇p)"),
    Factor(("proximal_factor", "distal_factor", "rod_factor"), "γ (J̇v)"),
    Factor(("proximal_factor",), "the proximal term of γ (ω × ω × s of the lower body)", None,
           _has_two_bodies),
    Factor(("distal_factor",), "the distal term of γ (ω × ω × s of the upper body)", None, _has_two_bodies),
    Factor(("rod_factor",), "the rod term of γ (ḋᵀḋ)", None, _has_rods),
)  # fmt: skip

CONVENTIONS = (
    Convention("the rotation matrix were transposed", lambda c: {"p": quaternion_conjugate(c.p)}),
    Convention("the quaternion order were wrong: (p0, e) read as (e, p0)",
               lambda c: {"p": np.roll(c.p, -1, -1)}),
    Convention("the quaternion order were wrong: (e, p0) read as (p0, e)",
               lambda c: {"p": np.roll(c.p, 1, -1)}),
    Convention("the world-frame angular velocity were used as the body-frame one",
               lambda c: {"omega": to_world(c, c.omega)}),
    Convention("the body-frame angular velocity were transformed with Aᵀ instead of A",
               lambda c: {"omega": to_body(c, c.omega)}),
    Convention("the inertia in world axes were used as the inertia in body axes",
               lambda c: {"inertia": rotation_matrix(c.p).mT @ c.inertia @ rotation_matrix(c.p)}),
    Convention("the inertia about the proximal point were used as that about the centre of mass",
               lambda c: {"inertia": _inertia_about_proximal(c)}),
    Convention("products of inertia were missing", lambda c: {"inertia": c.inertia * np.eye(3)}),
    Convention("products of inertia had the opposite sign",
               lambda c: {"inertia": c.inertia * (2 * np.eye(3) - 1)}),
    Convention("proximal and distal points were exchanged",
               lambda c: {"proximal": c.distal, "distal": c.proximal}),
    Convention("attachment points had the opposite sign",
               lambda c: {"proximal": -c.proximal, "distal": -c.distal}),
    Convention("gravity's x and y were exchanged", lambda c: {"gravity": c.gravity[:, [1, 0, 2]]}),
    Convention("gravity's x and z were exchanged", lambda c: {"gravity": c.gravity[:, [2, 1, 0]]}),
    Convention("gravity's y and z were exchanged", lambda c: {"gravity": c.gravity[:, [0, 2, 1]]}),
    Convention("the applied force were taken in the body frame instead of the world frame",
               lambda c: {"force": to_world(c, c.force)}, "force"),
    Convention("the applied moment were taken in the world frame instead of the body frame",
               lambda c: {"moment": to_body(c, c.moment)}, "moment"),
    Convention("all inputs were rounded to single precision", lambda c: _rounded_to_single_precision(c)),
)  # fmt: skip


def all_causes(case: DefectCase) -> Iterator[Cause]:
    """List every cause that can have an effect on a mechanism.

    Args:
        case: the mechanism, without defect, at the states to be explained.

    Yields:
        Causes, numbers first, then factors, then conventions.

    """
    yield from _number_causes(case)
    for factor in FACTORS:
        if factor.applies(case):
            yield _factor_cause(factor.subject, factor.if_zero, _multiply_fields(factor.fields))
    for k in range(case.n):
        yield _factor_cause(f"inertia of body {k + 1}", None, _multiply_inertia(k))
    for convention in CONVENTIONS:
        if np.any(getattr(case, convention.needs)):
            yield _convention_cause(convention)


def format_significant(x: float, reference: float, resolution: float) -> str:
    """Format a number with the digits that show its difference from a reference.

    Args:
        x: the number.
        reference: the number it is compared with; three digits of the difference are shown.
        resolution: uncertainty of ``x``; no digit below it is shown.

    Returns:
        ``x`` with 3 to 15 significant digits.

    """
    if x == 0:
        return "0"
    last = max(abs(x - reference) * 1e-3, resolution, abs(x) * 1e-15)
    return f"{x:.{int(np.clip(np.ceil(np.log10(abs(x) / last)), 3, 15))}g}"


# --- numbers of the model and the state ----------------------------------------------------------


def _number_causes(case: DefectCase) -> Iterator[Cause]:
    """Every number of the model, centre of mass and attitude of every body, and damping."""
    length = float(np.max(np.abs(case.proximal)) + np.max(np.abs(case.distal)) + np.max(case.length))
    for k in range(case.n):
        body = f"of body {k + 1}"
        yield _entry_cause(case, "mass", (k,), f"mass {body}", "kg", float(case.mass[0, k]))
        inertia = float(np.max(np.abs(case.inertia[0, k])))
        for i in range(3):
            for j in range(i, 3):
                name = f"inertia {AXES[i]}{AXES[j]} {body}"
                yield _entry_cause(case, "inertia", (k, i, j), name, "kg m²", inertia)
        if case.length[0, k] > 0:
            rod = float(case.length[0, k])
            yield _entry_cause(case, "length", (k,), f"length of rod {k + 1}", "m", rod)
        for i, axis in enumerate(AXES):
            yield _entry_cause(case, "proximal", (k, i), f"proximal {axis} {body}", "m", length)
            if k + 1 < case.n:
                yield _entry_cause(case, "distal", (k, i), f"distal {axis} {body}", "m", length)
            displaced = f"centre of mass {body} were displaced by"
            yield _amount_cause(_shift_centre_of_mass(k, i), displaced, f"m in {axis}", length)
            rotated = f"attitude {body} were rotated by"
            yield _amount_cause(_rotate_body(k, i), rotated, f"rad about its {axis} axis", 1.0)
    gravity = float(np.linalg.norm(case.gravity[0]))
    for i, axis in enumerate(AXES):
        yield _entry_cause(case, "gravity", (i,), f"gravity {axis}", "m/s²", gravity or 1.0)
    inertia = float(np.max(np.linalg.norm(case.inertia[0], axis=(1, 2))))
    damping = "damping of", "N m s acted on the rotation of every body"
    yield _amount_cause(lambda c, x: replace(c, drag_moment=c.drag_moment + x), *damping, inertia)
    damping = "damping of", "N s/m acted on the translation of every body"
    yield _amount_cause(
        lambda c, x: replace(c, drag_force=c.drag_force + x), *damping, float(np.max(case.mass))
    )


def _entry_cause(
    case: DefectCase, name: str, at: tuple[int, ...], what: str, unit: str, scale: float
) -> Cause:
    """One entry of a field, and its mirror in an inertia, has another value."""
    nominal = float(getattr(case, name)[(0, *at)])

    def alter(c: DefectCase, x: float) -> DefectCase:
        value = getattr(c, name).copy()
        for index in {at, (*at[:1], *at[:0:-1])} if name == "inertia" else {at}:
            value[(slice(None), *index)] = x
        return replace(c, **{name: value})

    def describe(x: float, resolution: float) -> str:
        engine, model = format_significant(x, nominal, resolution), format_significant(nominal, x, resolution)
        return f"{what} were {engine} {unit} (model: {model} {unit})"

    return Cause(alter, describe, nominal, scale)


def _amount_cause(alter: Alter, before: str, after: str, scale: float) -> Cause:
    """An amount that should be 0."""
    return Cause(
        alter, lambda x, resolution: f"{before} {format_significant(x, 0.0, resolution)} {after}", 0.0, scale
    )


def _shift_centre_of_mass(k: int, i: int) -> Alter:
    """Displace the centre of mass of body k by x along axis i: its attachments move the other way."""

    def alter(c: DefectCase, x: float) -> DefectCase:
        shift = np.zeros((c.n, 3))
        shift[k, i] = x
        return replace(c, proximal=c.proximal - shift, distal=c.distal - shift)

    return alter


def _rotate_body(k: int, i: int) -> Alter:
    """Rotate the attitude of body k by x about its own axis i."""

    def alter(c: DefectCase, x: float) -> DefectCase:
        p, turn = c.p.copy(), np.zeros(4)
        turn[0], turn[i + 1] = np.cos(x / 2), np.sin(x / 2)
        p[:, k] = quaternion_product(p[:, k], turn)
        return replace(c, p=p)

    return alter


# --- factors and conventions ---------------------------------------------------------------------


def _factor_cause(subject: str, if_zero: str | None, alter: Alter) -> Cause:
    """A factor that should be 1."""

    def describe(x: float, resolution: float) -> str:
        near = max(10 * resolution, 1e-9)
        if abs(x) <= near:
            return if_zero or f"{subject} were missing"
        for value, change in ((2.0, "were doubled"), (-1.0, "had the opposite sign"), (0.5, "were halved")):
            if abs(x - value) <= near:
                return f"{subject} {change}"
        return f"{subject} were {format_significant(x, 1.0, resolution)} times as large"

    return Cause(alter, describe, 1.0, 1.0)


def _multiply_fields(names: tuple[str, ...]) -> Alter:
    return lambda c, x: replace(c, **{name: x * getattr(c, name) for name in names})


def _multiply_inertia(k: int) -> Alter:
    return lambda c, x: replace(c, inertia=c.inertia * np.where(np.arange(c.n) == k, x, 1.0)[:, None, None])


def _convention_cause(convention: Convention) -> Cause:
    return Cause(lambda c, _: replace(c, **convention.change(c)), lambda *_: convention.description)


def _inertia_about_proximal(c: DefectCase) -> Array:
    """J − m s̃ s̃, the parallel-axis theorem (B, N, 3, 3)."""
    arm = cross_matrix(c.proximal)
    return np.asarray(c.inertia - c.mass[..., None, None] * (arm @ arm))


def _rounded_to_single_precision(c: DefectCase) -> dict[str, Array]:
    """All inputs in single precision, the quaternions normalised again."""
    names = (*MODEL_FIELDS, "p", "omega", "u", "udot")
    out = {name: np.asarray(getattr(c, name), np.float32).astype(float) for name in names}
    return out | {"p": out["p"] / np.linalg.norm(out["p"], axis=-1, keepdims=True)}
