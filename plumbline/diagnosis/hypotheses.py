"""Table of hypotheses: what may be wrong in the inputs or equations of an engine or its adapter.

Every `Cause` is one change, of a number (`_number_causes`), of a factor on fields or velocity terms of all
bodies (`FACTORS`) or of one (`BODY_FACTORS`), or of a convention for all bodies or for one (`CONVENTIONS`).
Its description completes "behaves as if …".
Bodies and rods count from 1; axes x, y, z are those of the body unless stated otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from plumbline.diagnosis.defect_model import (
    MODEL_FIELDS,
    DefectCase,
    centre_positions_and_velocities,
    relative_rates,
)
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import (
    cross_matrix,
    quaternion_conjugate,
    quaternion_product,
    rotate_vectors,
    rotation_matrix,
)

AXES = "xyz"
MAX_BODIES_OF_BODY_CONVENTIONS = 12  # of longer chains conventions are tried for all bodies together only
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
    """Another frame, order, sign or reference point for some fields, of all bodies or of one.

    In ``description`` {of} becomes "" or " of body k", and {its} "the" or "its"; without {of} the convention
    is one for all bodies together.
    """

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


def _relative_attitudes(c: DefectCase) -> Array:
    """q₁* q₂ (B, N, 4): attitude of every body relative to the body before, of the first its own."""
    before = quaternion_conjugate(np.concatenate([_identity_attitude(c), c.p[:, :-1]], axis=1))
    return _unit(quaternion_product(before, c.p))


def _identity_attitude(c: DefectCase) -> Array:
    return np.broadcast_to([1.0, 0.0, 0.0, 0.0], (len(c.p), 1, 4))


def _unit(p: Array) -> Array:
    return np.asarray(p / np.linalg.norm(p, axis=-1, keepdims=True))


def _in_reverse_order(c: DefectCase) -> Array:
    """Attitudes (B, N, 4) where that of the body before and the relative one are multiplied as q₁₂ q₁."""
    before = np.concatenate([_identity_attitude(c), c.p[:, :-1]], axis=1)
    return _unit(quaternion_product(_relative_attitudes(c), before))


def _as_relative_attitudes(c: DefectCase) -> Array:
    """Attitudes (B, N, 4) where the absolute one is multiplied by that of the body before: q₁ q₂."""
    return _unit(quaternion_product(np.concatenate([_identity_attitude(c), c.p[:, :-1]], axis=1), c.p))


def _moment_of(point: str, force: Callable[[DefectCase], Array]) -> Callable[[DefectCase], dict[str, Array]]:
    """Change of a model in which a world force acts at a point of the body: n′ + s × AᵀF."""
    return lambda c: {"moment": c.moment + np.cross(getattr(c, point), to_body(c, force(c)))}


def _drag_force(c: DefectCase) -> Array:
    """−c_t ṙ (B, N, 3)."""
    return np.asarray(-c.drag_force[..., None] * centre_positions_and_velocities(c)[1])


def _weight(c: DefectCase) -> Array:
    """Weight m g of each body (B, N, 3)."""
    return np.asarray(c.mass[..., None] * c.gravity[:, None])


def _drag_from_velocity(c: DefectCase, velocity: Array) -> dict[str, Array]:
    """−c_t times another velocity (B, N, 3)."""
    return {"drag_force": 0 * c.drag_force, "force": c.force - c.drag_force[..., None] * velocity}


def _drag_from_rate(c: DefectCase, rate: Array) -> dict[str, Array]:
    """−c_r times another rate (B, N, 3)."""
    return {"drag_moment": 0 * c.drag_moment, "moment": c.moment - c.drag_moment[..., None] * rate}


def _velocity_of_proximal_point(c: DefectCase) -> Array:
    _, v = centre_positions_and_velocities(c)
    return np.asarray(v + to_world(c, np.cross(c.omega, c.proximal)))


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

# Fields of one body, all of them not zero there, multiplied by a factor that should be 1; and the subject.
BODY_FACTORS = (
    (("mass", "inertia"), "mass and inertia of body {k}"),
    (("inertia",), "inertia of body {k}"),
    (("omega",), "angular rate ω′ of body {k}"),
    (("udot",), "rod rate u̇ of rod {k}"),
    (("force",), "the applied force of body {k}"),
    (("moment",), "the applied moment of body {k}"),
    (("force", "moment"), "the applied loads of body {k}"),
    (("drag_force",), "the drag force of body {k}"),
    (("drag_moment",), "the drag moment of body {k}"),
    (("drag_force", "drag_moment"), "the drag of body {k}"),
    (("gyroscopic_factor",), "the gyroscopic term of body {k}"),
    (("proximal_factor",), "the proximal term of γ of body {k}"),
    (("distal_factor",), "the distal term of γ of body {k}"),
    (("rod_factor",), "the rod term of γ of rod {k}"),
)

CONVENTIONS = (
    Convention("the rotation matrix{of} were transposed", lambda c: {"p": quaternion_conjugate(c.p)}),
    Convention("the quaternion order{of} were wrong: (p0, e) read as (e, p0)",
               lambda c: {"p": np.roll(c.p, -1, -1)}),
    Convention("the quaternion order{of} were wrong: (e, p0) read as (p0, e)",
               lambda c: {"p": np.roll(c.p, 1, -1)}),
    Convention("the quaternion product{of} were taken in the reverse order (the attitude of its parent after "
               "the relative one)", lambda c: {"p": _in_reverse_order(c)}),
    Convention("the attitude{of} relative to its parent were used as the absolute one",
               lambda c: {"p": _relative_attitudes(c)}),
    Convention("the absolute attitude{of} were used as the one relative to its parent",
               lambda c: {"p": _as_relative_attitudes(c)}),
    Convention("the angular velocity{of} relative to its parent were used as the absolute one",
               lambda c: {"omega": relative_rates(c)}),
    Convention("the absolute angular velocity{of} were used as the one relative to its parent",
               lambda c: {"omega": 2 * c.omega - relative_rates(c)}),
    Convention("the world-frame angular velocity{of} were used as the body-frame one",
               lambda c: {"omega": to_world(c, c.omega)}),
    Convention("the body-frame angular velocity{of} were transformed with Aᵀ instead of A",
               lambda c: {"omega": to_body(c, c.omega)}),
    Convention("the inertia{of} in world axes were used as the inertia in body axes",
               lambda c: {"inertia": rotation_matrix(c.p).mT @ c.inertia @ rotation_matrix(c.p)}),
    Convention("the inertia{of} in body axes were rotated with Aᵀ instead of A",
               lambda c: {"inertia": _inertia_rotated_backwards(c)}),
    Convention("the inertia{of} about the proximal point were used as that about the centre of mass",
               lambda c: {"inertia": _inertia_about_proximal(c)}),
    Convention("products of inertia{of} were missing", lambda c: {"inertia": c.inertia * np.eye(3)}),
    Convention("products of inertia{of} had the opposite sign",
               lambda c: {"inertia": c.inertia * (2 * np.eye(3) - 1)}),
    Convention("proximal and distal points{of} were exchanged",
               lambda c: {"proximal": c.distal, "distal": c.proximal}),
    Convention("attachment points{of} had the opposite sign",
               lambda c: {"proximal": -c.proximal, "distal": -c.distal}),
    Convention("gravity's x and y were exchanged", lambda c: {"gravity": c.gravity[:, [1, 0, 2]]}),
    Convention("gravity's x and z were exchanged", lambda c: {"gravity": c.gravity[:, [2, 1, 0]]}),
    Convention("gravity's y and z were exchanged", lambda c: {"gravity": c.gravity[:, [0, 2, 1]]}),
    Convention("the applied force{of} were taken in the body frame instead of the world frame",
               lambda c: {"force": to_world(c, c.force)}, "force"),
    Convention("the applied force{of} were rotated with Aᵀ", lambda c: {"force": to_body(c, c.force)},
               "force"),
    Convention("the applied moment{of} were taken in the world frame instead of the body frame",
               lambda c: {"moment": to_body(c, c.moment)}, "moment"),
    Convention("the applied moment{of} were rotated with A", lambda c: {"moment": to_world(c, c.moment)},
               "moment"),
    *(Convention(f"the applied {name} of another body, {which}, were used", change, name)
      for name in ("force", "moment")
      for which, change in (
          ("the previous one", lambda c, name=name: {name: np.roll(getattr(c, name), 1, 1)}),
          ("the next one", lambda c, name=name: {name: np.roll(getattr(c, name), -1, 1)}),
          ("the one counted from the other end", lambda c, name=name: {name: getattr(c, name)[:, ::-1]}),
      )),
    *(Convention(f"the {name}{{of}} acted at {{its}} {point} point instead of the centre of mass",
                 _moment_of(point, force), needs)
      for point in ("proximal", "distal")
      for name, force, needs in (("applied force", lambda c: c.force, "force"),
                                 ("weight", _weight, "gravity"),
                                 ("drag force", _drag_force, "drag_force"))),
    Convention("the drag force{of} were taken in the body frame instead of the world frame",
               lambda c: _drag_from_velocity(c, to_body(c, centre_positions_and_velocities(c)[1])),
               "drag_force"),
    Convention("the drag force{of} were computed from the velocity of the proximal point",
               lambda c: _drag_from_velocity(c, _velocity_of_proximal_point(c)), "drag_force"),
    Convention("the drag moment{of} were taken in the world frame instead of the body frame",
               lambda c: _drag_from_rate(c, to_world(c, c.omega)), "drag_moment"),
    Convention("the drag moment{of} were computed from the angular velocity relative to its parent",
               lambda c: _drag_from_rate(c, relative_rates(c)), "drag_moment"),
    Convention("the drag coefficients c_t and c_r{of} were exchanged",
               lambda c: {"drag_force": c.drag_moment, "drag_moment": c.drag_force}, "drag_force"),
    Convention("the drag coefficient c_t{of} were used as c_r", lambda c: {"drag_moment": c.drag_force},
               "drag_force"),
    Convention("the drag coefficient c_r{of} were used as c_t", lambda c: {"drag_force": c.drag_moment},
               "drag_moment"),
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
        for names, subject in BODY_FACTORS:
            if _is_factor_of_body(case, names, k):
                yield _factor_cause(subject.format(k=k + 1), None, _multiply_fields_of_body(names, k))
    for convention in CONVENTIONS:
        yield from _convention_causes(case, convention)


def _is_factor_of_body(case: DefectCase, names: tuple[str, ...], k: int) -> bool:
    """Whether a factor on fields of body k has an effect that no factor on all bodies has."""
    if case.n == 1:
        return names == ("inertia",)
    if names == ("distal_factor",):
        return k + 1 < case.n
    if names == ("rod_factor",):
        return bool(case.length[0, k] > 0)
    return all(bool(np.any(getattr(case, name)[:, k])) for name in names)


def format_significant(x: float, reference: float, resolution: float) -> str:
    """Format a number with the digits that show its difference from a reference.

    Args:
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
    weight = float(np.max(case.mass) * (np.max(np.abs(case.gravity)) or 1.0))
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
            yield _entry_cause(case, "force", (k, i), f"applied force {axis} {body}", "N", weight)
            yield _entry_cause(
                case, "moment", (k, i), f"applied moment {axis} {body}", "N m", weight * length
            )
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
    has_balls_only = not _has_rods(case)
    every = np.ones(case.n, bool)
    joints = [("every joint", every)] if has_balls_only else []
    for k in range(case.n):
        one = np.arange(case.n) == k
        if case.n > 1:
            if has_balls_only:
                joints.append((f"joint {k + 1}", one))
            for name, motion, unit, scale in (
                ("drag_moment", "rotation", "N m s", inertia),
                ("drag_force", "translation", "N s/m", float(np.max(case.mass))),
            ):
                if case.n > 1 and not np.any(getattr(case, name)[:, k]):  # else a factor on it
                    acted = f"{unit} acted on the {motion} of body {k + 1}"
                    yield _amount_cause(_add_to_field(name, one), "damping of", acted, scale)
    for which, chosen in joints:
        yield _amount_cause(
            _add_to_field("armature", chosen), f"the armature of {which} were", "kg m² (model: 0)", inertia
        )
        yield _amount_cause(_damp_joints(chosen), f"viscous damping in {which} of", "N m s acted", inertia)


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


def _add_to_field(name: str, bodies: Array) -> Alter:
    """Add x to a field (B, N) of some bodies."""
    return lambda c, x: replace(c, **{name: getattr(c, name) + np.where(bodies, x, 0.0)})


def _damp_joints(joints: Array) -> Alter:
    """Moments −x w at some ball joints, and x w on the body before, w its relative rate."""

    def alter(c: DefectCase, x: float) -> DefectCase:
        torque = -x * relative_rates(c) * joints[:, None]
        world = to_world(c, torque)
        reaction = np.concatenate([world[:, 1:], np.zeros_like(world[:, :1])], axis=1)
        return replace(c, moment=c.moment + torque - to_body(c, reaction))

    return alter


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


def _multiply_fields_of_body(names: tuple[str, ...], k: int) -> Alter:
    def alter(c: DefectCase, x: float) -> DefectCase:
        changed = {name: getattr(c, name).copy() for name in names}
        for value in changed.values():
            value[:, k] *= x
        return replace(c, **changed)

    return alter


def _convention_causes(case: DefectCase, convention: Convention) -> Iterator[Cause]:
    """A convention for all bodies together, and for every body that it alters where that are several."""
    if not np.any(getattr(case, convention.needs)):
        return
    altered = convention.change(case)
    per_body = [
        k
        for k in range(case.n)
        if any(
            np.any(x[:, k] != getattr(case, name)[:, k]) for name, x in altered.items() if name != "gravity"
        )
    ]
    has_bodies = "{of}" in convention.description
    bodies = per_body if has_bodies and 1 < case.n <= MAX_BODIES_OF_BODY_CONVENTIONS else []
    if len(bodies) != 1 and (per_body or "gravity" in altered):
        words = convention.description.format(of="", its="the")
        yield Cause(lambda c, _: replace(c, **convention.change(c)), lambda *_: words)
    for k in bodies:
        yield _body_convention_cause(convention, k)


def _body_convention_cause(convention: Convention, k: int) -> Cause:
    def alter(c: DefectCase, _: float) -> DefectCase:
        changed = convention.change(c)
        for name, value in changed.items():
            right = getattr(c, name).copy()
            right[:, k] = value[:, k]
            changed[name] = right
        return replace(c, **changed)

    words = convention.description.format(of=f" of body {k + 1}", its="its")
    return Cause(alter, lambda *_: words)


def _inertia_rotated_backwards(c: DefectCase) -> Array:
    """Inertia in body axes that an engine sees which computes AᵀJA in place of AJAᵀ in world axes."""
    a = rotation_matrix(c.p)
    return np.asarray(a.mT @ (a.mT @ c.inertia @ a) @ a)


def _inertia_about_proximal(c: DefectCase) -> Array:
    """J − m s̃ s̃, the parallel-axis theorem (B, N, 3, 3)."""
    arm = cross_matrix(c.proximal)
    return np.asarray(c.inertia - c.mass[..., None, None] * (arm @ arm))


def _rounded_to_single_precision(c: DefectCase) -> dict[str, Array]:
    """All inputs in single precision, the quaternions normalised again."""
    names = (*MODEL_FIELDS, "p", "omega", "u", "udot")
    out = {name: np.asarray(getattr(c, name), np.float32).astype(float) for name in names}
    return out | {"p": out["p"] / np.linalg.norm(out["p"], axis=-1, keepdims=True)}
