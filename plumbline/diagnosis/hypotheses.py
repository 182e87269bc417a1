"""What may be wrong in an engine or its adapter, one change each: of a number, a term, or an answer.

A `Cause` alters what the engine computes with, by an amount to be fitted or as a whole; a `Reading`
alters what it gives back.  Bodies count from 1, axes are x, y, z of the body unless said otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from plumbline.diagnosis.defect_model import (
    MODEL_FIELDS,
    DefectCase,
    centre_positions_and_velocities,
    rotate_vectors,
)
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import quaternion_conjugate, rotation_matrix

AXES = "xyz"


@dataclass(frozen=True)
class Cause:
    """The engine computes with ``alter(case, x)`` where ``x = usual`` would be right.

    ``scale`` is the natural size of a change of x; None for a change that is made as a whole, with
    nothing to fit.  ``words(x)`` completes "behaves as if …".
    """

    alter: Callable[[DefectCase, float], DefectCase]
    describe: Callable[[float, float], str]  # of x and of its resolution
    nominal: float = 0.0
    scale: float | None = None


@dataclass(frozen=True)
class OutputDefect:
    """What is given back as ``quantity`` is ``of(case, right answers)`` instead of the right answer."""

    quantity: str
    compute: Callable[[DefectCase, dict[str, Array]], Array]
    describe: str


def format_significant(x: float, usual: float, resolution: float) -> str:
    """``x`` with as many digits as its difference to ``usual`` needs (three of them) and can bear."""
    if x == 0:
        return "0"
    finest = max(abs(x - usual) * 1e-3, resolution, abs(x) * 1e-15)
    return f"{x:.{int(np.clip(np.ceil(np.log10(abs(x) / finest)), 3, 15))}g}"


def parameter_description(what: str, usual: float, unit: str) -> Callable[[float, float], str]:
    """Words for a number of the model."""
    tail = f" {unit}" if unit else ""

    def words(x: float, fine: float) -> str:
        return f"{what} were {format_significant(x, usual, fine)}{tail} instead of {format_significant(usual, x, fine)}{tail}"

    return words


def factor_description(what: str, missing: str | None = None) -> Callable[[float, float], str]:
    """Words for a factor that should be 1."""

    def words(x: float, fine: float) -> str:
        near = max(10 * fine, 1e-9)
        if abs(x) <= near:
            return missing or f"{what} were missing"
        for value, said in ((2.0, "were doubled"), (-1.0, "had the opposite sign"), (0.5, "were halved")):
            if abs(x - value) <= near:
                return f"{what} {said}"
        return f"{what} were {format_significant(x, 1.0, fine)} times as large"

    return words


def offset_description(what: str, unit: str, tail: str = "") -> Callable[[float, float], str]:
    """Words for an amount that should be 0."""
    return lambda x, fine: f"{what} {format_significant(x, 0.0, fine)} {unit}{tail}"


def all_causes(case: DefectCase) -> Iterator[Cause]:
    """Every cause that this pendulum could show: numbers, conventions, terms."""
    yield from parameter_causes(case)
    yield from scaling_causes(case)
    yield from convention_causes(case)
    yield from velocity_term_causes(case)


def set_entry(
    name: str, at: tuple[int, ...], mirror: tuple[int, ...] | None = None
) -> Callable[..., DefectCase]:
    """Set one entry of a field in every pendulum (and its mirror, of a symmetric matrix)."""

    def alter(c: DefectCase, x: float) -> DefectCase:
        value = getattr(c, name).copy()
        for index in {at, mirror or at}:
            value[(slice(None), *index)] = x
        return replace(c, **{name: value})

    return alter


def parameter_causes(case: DefectCase) -> Iterator[Cause]:
    """Each number of the model."""
    n = case.n

    def entry(name: str, at: tuple[int, ...], what: str, unit: str, scale: float) -> Cause:
        usual = float(getattr(case, name)[(0, *at)])
        mirror = (at[0], at[2], at[1]) if name == "inertia" else None
        return Cause(set_entry(name, at, mirror), parameter_description(what, usual, unit), usual, scale)

    reach = float(np.max(np.abs(case.proximal)) + np.max(np.abs(case.distal)) + np.max(case.length))
    for k in range(n):
        body = f"of body {k + 1}"
        yield entry("mass", (k,), f"mass {body}", "kg", float(case.mass[0, k]))
        size = float(np.max(np.abs(case.inertia[0, k])))
        for i in range(3):
            for j in range(i, 3):
                yield entry("inertia", (k, i, j), f"inertia {AXES[i]}{AXES[j]} {body}", "kg m²", size)
        if case.length[0, k] > 0:
            yield entry("length", (k,), f"length of rod {k + 1}", "m", float(case.length[0, k]))
        for i in range(3):
            yield entry("proximal", (k, i), f"proximal {AXES[i]} {body}", "m", reach)
            if k + 1 < n:
                yield entry("distal", (k, i), f"distal {AXES[i]} {body}", "m", reach)
            yield Cause(
                shift_centre_of_mass(k, i),
                offset_description(f"centre of mass {body} were displaced by", "m", f" in {AXES[i]}"),
                0.0,
                reach,
            )
            yield Cause(
                rotate_body(k, i),
                offset_description(f"attitude {body} were turned by", "rad", f" about its {AXES[i]}"),
                0.0,
                1.0,
            )
    g = float(np.linalg.norm(case.gravity[0]))
    for i in range(3):
        yield entry("gravity", (i,), f"gravity {AXES[i]}", "m/s²", g or 1.0)


def shift_centre_of_mass(k: int, i: int) -> Callable[[DefectCase, float], DefectCase]:
    """The centre of mass of body k at x along axis i: its attachments move the other way."""

    def alter(c: DefectCase, x: float) -> DefectCase:
        near, far = c.proximal.copy(), c.distal.copy()
        near[:, k, i] -= x
        far[:, k, i] -= x
        return replace(c, proximal=near, distal=far)

    return alter


def rotate_body(k: int, i: int) -> Callable[[DefectCase, float], DefectCase]:
    """The attitude of body k turned by x about its own axis i."""

    def alter(c: DefectCase, x: float) -> DefectCase:
        p = c.p.copy()
        w, e = c.p[:, k, :1], c.p[:, k, 1:]
        axis = np.eye(3)[i]
        half_c, half_s = np.cos(x / 2), np.sin(x / 2)
        p[:, k, :1] = w * half_c - e[:, i : i + 1] * half_s
        p[:, k, 1:] = e * half_c + half_s * (w * axis + np.cross(e, axis))
        return replace(c, p=p)

    return alter


def multiply_fields(
    *names: str, bodies: slice | int = slice(None)
) -> Callable[[DefectCase, float], DefectCase]:
    """Fields multiplied by x."""

    def alter(c: DefectCase, x: float) -> DefectCase:
        changed = {}
        for name in names:
            value = getattr(c, name).copy()
            if value.ndim == 1 or name == "gravity":
                value = value * x
            else:
                value[:, bodies] = value[:, bodies] * x
            changed[name] = value
        return replace(c, **changed)

    return alter


def scaling_causes(case: DefectCase) -> Iterator[Cause]:
    """Several numbers multiplied together."""
    yield Cause(multiply_fields("mass", "inertia"), factor_description("all masses and inertias"), 1.0, 1.0)
    yield Cause(multiply_fields("proximal", "distal", "length"), factor_description("all lengths"), 1.0, 1.0)
    yield Cause(multiply_fields("inertia"), factor_description("all inertias"), 1.0, 1.0)
    yield Cause(multiply_fields("mass"), factor_description("all masses"), 1.0, 1.0)
    if np.count_nonzero(case.gravity[0]) > 1:  # along one axis it is that number
        yield Cause(
            multiply_fields("gravity"),
            factor_description("gravity's size", "there were no gravity"),
            1.0,
            1.0,
        )
    for k in range(case.n):
        yield Cause(
            multiply_fields("inertia", bodies=k), factor_description(f"inertia of body {k + 1}"), 1.0, 1.0
        )
    yield Cause(multiply_fields("omega"), factor_description("angular rates ω′"), 1.0, 1.0)
    yield Cause(multiply_fields("udot"), factor_description("rod rates u̇"), 1.0, 1.0)
    if np.any(case.length):
        yield Cause(multiply_fields("omega", "udot"), factor_description("all rates"), 1.0, 1.0)
    if np.any(case.drag_force):
        yield Cause(
            multiply_fields("drag_force"),
            factor_description("drag on forces", "it were without drag on forces"),
            1.0,
            1.0,
        )
    if np.any(case.drag_moment):
        yield Cause(
            multiply_fields("drag_moment"),
            factor_description("drag on moments", "it were without drag on moments"),
            1.0,
            1.0,
        )
    if np.any(case.force):
        yield Cause(multiply_fields("force"), factor_description("applied forces"), 1.0, 1.0)
    if np.any(case.moment):
        yield Cause(multiply_fields("moment"), factor_description("applied moments"), 1.0, 1.0)
    if np.any(case.force) and np.any(case.moment):
        yield Cause(
            multiply_fields("force", "moment"),
            factor_description("applied loads", "it were without applied loads"),
            1.0,
            1.0,
        )

    def more(name: str) -> Callable[[DefectCase, float], DefectCase]:
        return lambda c, x: replace(c, **{name: getattr(c, name) + x})

    yield Cause(
        more("drag_moment"), offset_description("damping of", "N m s", " acted on the turning of every body"),
        0.0, float(np.max(np.linalg.norm(case.inertia[0], axis=(1, 2)))),
    )  # fmt: skip
    yield Cause(
        more("drag_force"), offset_description("damping of", "N s/m", " acted on the motion of every body"),
        0.0, float(np.max(case.mass)),
    )  # fmt: skip


def convention_causes(case: DefectCase) -> Iterator[Cause]:
    """Frames, orders, signs: changes made as a whole."""

    def whole(words: str, change: Callable[[DefectCase], dict[str, Array]]) -> Cause:
        return Cause(lambda c, _: replace(c, **change(c)), lambda *_: words)

    yield whole(
        "rotation transposed (Aᵀ in place of A) were used", lambda c: {"p": quaternion_conjugate(c.p)}
    )
    yield whole("quaternion order were another: (p0, e) read as (e, p0)", roll_axis("p", -1))
    yield whole("quaternion order were another: (e, p0) read as (p0, e)", roll_axis("p", 1))
    yield whole(
        "world rate were taken for the body rate",
        lambda c: {"omega": rotate_vectors(rotation_matrix(c.p), c.omega)},
    )
    yield whole(
        "body rate were turned into the world frame the wrong way",
        lambda c: {"omega": rotate_vectors(rotation_matrix(c.p).swapaxes(-1, -2), c.omega)},
    )
    yield whole(
        "inertia in world axes were taken for inertia in body axes",
        lambda c: {"inertia": rotation_matrix(c.p).swapaxes(-1, -2) @ c.inertia @ rotation_matrix(c.p)},
    )
    yield whole(
        "inertia about the proximal point were given as that about the centre of mass", inertia_about_proximal
    )
    yield whole("products of inertia were missing", lambda c: {"inertia": c.inertia * np.eye(3)})
    yield whole(
        "products of inertia had the opposite sign",
        lambda c: {"inertia": c.inertia * (2 * np.eye(3) - 1)},
    )
    yield whole(
        "proximal and distal points were exchanged",
        lambda c: {"proximal": c.distal, "distal": c.proximal},
    )
    yield whole("offsets had the opposite sign", lambda c: {"proximal": -c.proximal, "distal": -c.distal})
    for order in ([1, 0, 2], [2, 1, 0], [0, 2, 1]):
        pair = " and ".join(AXES[i] for i in range(3) if order[i] != i)
        yield whole(f"gravity's {pair} were exchanged", reorder_axis("gravity", order))
    if np.any(case.force):
        yield whole(
            "applied force in the body frame were given as that in the world frame",
            lambda c: {"force": rotate_vectors(rotation_matrix(c.p), c.force)},
        )
    if np.any(case.moment):
        yield whole(
            "applied moment in the world frame were given as that in the body frame",
            lambda c: {"moment": rotate_vectors(rotation_matrix(c.p).swapaxes(-1, -2), c.moment)},
        )
    yield whole("single precision were used for all inputs", round_to_single_precision)


def roll_axis(name: str, shift: int) -> Callable[[DefectCase], dict[str, Array]]:
    """A field's last axis rolled."""
    return lambda c: {name: np.roll(getattr(c, name), shift, -1)}


def reorder_axis(name: str, order: list[int]) -> Callable[[DefectCase], dict[str, Array]]:
    """A field's last axis in another order."""
    return lambda c: {name: getattr(c, name)[..., order]}


def inertia_about_proximal(c: DefectCase) -> dict[str, Array]:
    """J + m (s² I − s sᵀ)."""
    s = c.proximal
    square = np.sum(s * s, -1)[..., None, None] * np.eye(3) - s[..., :, None] * s[..., None, :]
    return {"inertia": c.inertia + c.mass[..., None, None] * square}


def round_to_single_precision(c: DefectCase) -> dict[str, Array]:
    """All inputs through single precision, the quaternions normalised again."""
    out = {
        name: np.asarray(getattr(c, name), np.float32).astype(float)
        for name in (*MODEL_FIELDS, "p", "omega", "u", "udot")
    }
    out["p"] /= np.linalg.norm(out["p"], axis=-1, keepdims=True)
    return out


def velocity_term_causes(case: DefectCase) -> Iterator[Cause]:
    """Velocity terms, each with a factor that should be 1."""
    yield Cause(multiply_fields("gyroscopic_factor"), factor_description("the gyroscopic term (8 L̇ᵀJL̇p)"), 1.0, 1.0)
    yield Cause(multiply_fields("proximal_factor", "distal_factor", "rod_factor"), factor_description("γ (J̇v)"), 1.0, 1.0)
    if case.n > 1:
        yield Cause(
            multiply_fields("proximal_factor"),
            factor_description("the near term of γ (ω × ω × s of the body that hangs)"),
            1.0,
            1.0,
        )
        yield Cause(
            multiply_fields("distal_factor"),
            factor_description("the far term of γ (ω × ω × s of the body above)"),
            1.0,
            1.0,
        )
    if np.any(case.length):
        yield Cause(multiply_fields("rod_factor"), factor_description("the rod term of γ (ḋᵀḋ)"), 1.0, 1.0)


BODY_PERMUTATIONS: dict[str, Callable[[Array], Array]] = {
    "the next one": lambda x: np.roll(x, -1, 1),
    "the one before": lambda x: np.roll(x, 1, 1),
    "the one counted from the other end": lambda x: x[:, ::-1],
}


def in_body_frame(name: str) -> Callable[[DefectCase, dict[str, Array]], Array]:
    """Aᵀ x of a quantity."""
    return lambda c, q: rotate_vectors(rotation_matrix(c.p).swapaxes(-1, -2), q[name])


def transform_quantity(
    name: str, change: Callable[[Array], Array]
) -> Callable[[DefectCase, dict[str, Array]], Array]:
    """A quantity's rows changed."""
    return lambda _, q: change(q[name])


def output_defects() -> Iterator[OutputDefect]:
    """What an answer may be instead of what it is said to be."""

    def world(c: DefectCase, x: Array) -> Array:
        return rotate_vectors(rotation_matrix(c.p), x)

    a, alpha, f = "acceleration", "angular_acceleration", "joint_reaction"
    yield OutputDefect(
        a, lambda c, q: q[a] - np.cross(world(c, c.omega), centre_positions_and_velocities(c)[1]),
        "spatial acceleration (r̈ − ω × ṙ) were given as the classical one",
    )  # fmt: skip
    yield OutputDefect(a, lambda c, q: q[a] - c.gravity[:, None], "acceleration less gravity were given")
    yield OutputDefect(a, lambda c, q: q[a] + c.gravity[:, None], "acceleration plus gravity were given")
    yield OutputDefect(
        a,
        lambda c, q: q[a] + world(
            c, np.cross(q[alpha], c.proximal) + np.cross(c.omega, np.cross(c.omega, c.proximal))
        ),
        "acceleration of the proximal point were given",
    )  # fmt: skip
    for name in (a, f):
        what = name.replace("_", " ")
        yield OutputDefect(name, in_body_frame(name), f"{what} in the body frame were given")
    yield OutputDefect(
        alpha, lambda c, q: world(c, q[alpha]), "angular acceleration in the world frame were given"
    )
    for name in (a, alpha, f):
        what = name.replace("_", " ")
        for which, change in BODY_PERMUTATIONS.items():
            yield OutputDefect(
                name, transform_quantity(name, change), f"{what} of another body, {which}, were given"
            )
    t, h = "kinetic_energy", "angular_momentum"
    yield OutputDefect(
        t, lambda c, q: q[t] - rotational_energy(c), "kinetic energy without rotation were given"
    )
    yield OutputDefect(t, lambda c, q: rotational_energy(c), "kinetic energy of rotation alone were given")
    yield OutputDefect(
        h, angular_momentum_about_centre, "angular momentum about the centre of mass were given"
    )
    yield OutputDefect(
        h, lambda c, q: np.sum(world(c, rotate_vectors(c.inertia, c.omega)), axis=1),
        "angular momentum of the bodies about their own centres were given",
    )  # fmt: skip
    yield OutputDefect(
        h, lambda c, q: q[h] - np.sum(world(c, rotate_vectors(c.inertia, c.omega)), axis=1),
        "angular momentum without the bodies' own spin were given",
    )  # fmt: skip


def rotational_energy(c: DefectCase) -> Array:
    """½ Σ ω′·J ω′ (B,)."""
    return np.asarray(0.5 * np.sum(c.omega * rotate_vectors(c.inertia, c.omega), axis=(1, 2)))


def angular_momentum_about_centre(c: DefectCase, q: dict[str, Array]) -> Array:
    """Angular momentum about the common centre of mass (B, 3)."""
    r, v = centre_positions_and_velocities(c)
    m = c.mass[..., None]
    centre_of_all = np.sum(m * r, axis=1) / np.sum(m, axis=1)
    return np.asarray(q["angular_momentum"] - np.cross(centre_of_all, np.sum(m * v, axis=1)))
