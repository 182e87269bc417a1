"""Table of the numbers that an engine may have wrong: of bodies, joints, elements, springs and the state.

An edit replaces one number or three, or multiplies fields by a factor: of one place, of all, or from one on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from plumbline.diagnosis.cause import Cause, CauseKind
from plumbline.diagnosis.prediction import Case
from plumbline.model.datatypes import JOINT_ELEMENTS, SPRING_FIELDS, VALUE_AXES, Array, Model
from plumbline.model.kinematics import quaternion_exponential, quaternion_product, rotation_matrix
from plumbline.truth import parameters

AXES: tuple[tuple[Any, str], ...] = ((0, " x"), (1, " y"), (2, " z"), (slice(None), ""))  # and all three
ASKEW = 1e-6  # of a direction: it lies along an axis but for rounding
NumberChange = Callable[[Case, Array], Case]
PLURALS = {"body": "bodies", "joint": "joints", "spring": "springs"}
LENGTHS = (" m", " rad")  # units of a mechanism's geometry, by which loops may open
WORDS = {"rest": "rest position", "force": "applied force", "moment": "applied moment",
         "drag_force": "drag force", "drag_moment": "drag moment", "omega": "angular velocity ω′",
         "udot": "rod rate u̇", "xdot": "rates", "spring_point": "point", "spring_length": "length",
         "spring_stiffness": "stiffness", "spring_damping": "damping"}  # fmt: skip
OF_SPRINGS = {name: f"{WORDS[name]} of springs between points" for name in SPRING_FIELDS[2:]}
UNITS = {name: f" {unit}" for name, unit in parameters.UNITS.items()}


@dataclass(frozen=True, eq=False)
class Edit:
    """A change of what an engine evaluates, by the numbers x, of which ``nominal`` are right; or by none.

    Of a term that is linear it has the effect (m,) on the quantities, in their units, per unit of its amount
    in place of the change.
    """

    cause: Cause
    change: NumberChange | None = None
    scale: float = 1.0  # natural size of a change of x
    can_vanish: bool = True  # whether factors 0, 2 and −1 are possible
    effect: Array | None = None
    begin: float | None = None  # where the fit of the number begins; by default at the right one

    @property
    def nominal(self) -> Array:
        """The right numbers; none of what has no amount."""
        return np.array(self.cause.nominal)

    @property
    def start(self) -> Array:
        """The numbers where their fit begins."""
        return self.nominal if self.begin is None else np.array([self.begin])


# -- changes of fields ---------------------------------------------------------------------------------


def with_fields(case: Case, **fields: Any) -> Case:
    """Replace fields of the model or of the state."""
    of_state = {name: fields.pop(name) for name in list(fields) if hasattr(case.state, name)}
    model = replace(case.model, **fields) if fields else case.model
    state = replace(case.state, **of_state) if of_state else case.state
    return Case(model, state, case.method, case.read)


def field(case: Case, name: str) -> Array:
    """Return a field of the model or of the state."""
    return np.asarray(getattr(case.state if hasattr(case.state, name) else case.model, name))


def at_place(name: str, at: tuple[Any, ...]) -> NumberChange:
    """Replace one number of a field, or one vector."""

    def change(case: Case, x: Array) -> Case:
        values = field(case, name).copy()
        values[(..., *at)] = x[0] if len(x) == 1 else x
        if name == "inertia":
            values[(..., at[0], at[2], at[1])] = x[0]
        return with_fields(case, **{name: values})

    return change


def scaled(masks: Mapping[str, Any]) -> NumberChange:
    """Multiply fields by a factor where masks that broadcast against them are 1."""

    def change(case: Case, x: Array) -> Case:
        fields = {name: field(case, name) * (1 + (x[0] - 1) * mask) for name, mask in masks.items()}
        return with_fields(case, **fields)

    return change


def added(name: str, where: Array) -> NumberChange:
    """Add an amount to a field at places of a mask."""
    return lambda case, x: with_fields(case, **{name: field(case, name) + x[0] * where})


def turned(name: str, at: tuple[int, ...], axes: Array) -> NumberChange:
    """Turn quaternions by a rotation vector in themselves, of components along axes."""

    def change(case: Case, x: Array) -> Case:
        values, by = field(case, name).copy(), quaternion_exponential(np.asarray(x) @ axes / 2)
        where: tuple[Any, ...] = (..., *at, slice(None))
        values[where] = quaternion_product(values[where], by)
        return with_fields(case, **{name: values})

    return change


def _shifted_centre(k: int, axis: int) -> NumberChange:
    """Displace a centre of mass: what is attached to the body moves the other way."""

    def change(case: Case, x: Array) -> Case:
        point, springs = case.model.point.copy(), case.model.spring_point.copy()
        point[..., axis] -= x[0] * (case.model.body == k)
        springs[..., axis] -= x[0] * (case.model.spring_body == k)
        return with_fields(case, point=point, spring_point=springs)

    return change


def _slide_axis(model: Model, k: int) -> Array:
    return rotation_matrix(model.turn[k, 0])[:, model.kinds[k].motions[0][1]]


def _shifted_slide(k: int) -> NumberChange:
    """Count a slide's coordinate, spring included, from a point further along its axis."""

    def change(case: Case, x: Array) -> Case:
        model, along = case.model, _slide_axis(case.model, k)
        point, rest = model.point.copy(), model.rest.copy()
        point[..., k, 0, :] += x[0] * along
        rest[..., k, 0] -= x[0]
        return with_fields(case, point=point, rest=rest)

    return change


def gyroscopic_moment(case: Case) -> Array:
    """Return ω′ × J ω′ (S, N, 3)."""
    omega = case.state.omega
    return np.cross(omega, np.matvec(case.model.inertia, omega))


def _gyroscopic(where: Array) -> NumberChange:
    def change(case: Case, x: Array) -> Case:
        less = (x[0] - 1) * where[:, None] * gyroscopic_moment(case)
        return with_fields(case, moment=case.model.moment - less)

    return change


# -- tables --------------------------------------------------------------------------------------------


def number_edits(case: Case) -> Iterator[Edit]:
    """List the edits of one number, and of vectors: points, turns of axes, loads and gravity."""
    yield from _gravity(case.model)
    yield from _bodies(case.model)
    yield from _joints(case.model)
    yield from _factors(case)
    yield from _absent(case.model)


def _edit(
    term: str, place: str, change: NumberChange, nominal: Any, scale: float = 1.0, unit: str = "",
    general: str = "", can_vanish: bool = True, kind: CauseKind = "number",
) -> Edit:  # fmt: skip
    numbers = tuple(float(x) for x in np.ravel(nominal))
    return Edit(
        Cause(kind, term, place, nominal=numbers, unit=unit, general=general), change, scale, can_vanish
    )


def _number(
    model: Model, term: str, place: str, name: str, at: tuple[Any, ...], scale: float = 0.0, unit: str = "",
    general: str = "", can_vanish: bool = True,
) -> Edit:  # fmt: skip
    """Edit one number of a field, or one vector; its own size is the scale where none is given."""
    value, general = getattr(model, name)[at], general or WORDS.get(name, name)
    size = scale or abs(float(value)) or 1.0
    return _edit(term, place, at_place(name, at), value, size, unit, general, can_vanish)


def _factor(term: str, place: str, change: NumberChange, **more: Any) -> Edit:
    return _edit(term, place, change, 1.0, unit="×", **more)


def _gravity(model: Model) -> Iterator[Edit]:
    size = float(np.linalg.norm(model.gravity)) or 1.0
    if np.count_nonzero(model.gravity) > 1:  # else it is a component
        yield _factor("size of gravity", "", scaled({"gravity": 1.0}), general="gravity")
    for i, axis in AXES:
        term = f"{axis.strip()} component of gravity" if axis else "vector of gravity"
        yield _number(model, term, "", "gravity", (i,), size, UNITS["gravity"])


def _bodies(model: Model) -> Iterator[Edit]:
    size = float(np.linalg.norm(model.gravity)) or 1.0
    length = float(np.max(np.abs(model.point))) or 1.0
    for k in range(model.n):
        place, mass = f"body {k + 1}", float(model.mass[k])
        yield _number(model, "mass", place, "mass", (k,), mass, UNITS["mass"], can_vanish=False)
        trace = float(np.trace(model.inertia[k])) or mass * length**2  # a point mass may be given one
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
            term, unit = f"inertia {'xyz'[i]}{'xyz'[j]}", UNITS["inertia"]
            yield _number(model, term, place, "inertia", (k, i, j), trace, unit, can_vanish=i != j)
        for a, axis in AXES:
            for name, weight in (("force", mass * size), ("moment", mass * size * length)):
                yield _number(model, f"{WORDS[name]}{axis}", place, name, (k, a), weight, UNITS[name])
            if axis and not model.kinds[k].holds_nothing:
                term = "centre of mass"
                yield _edit(f"{term}{axis}", place, _shifted_centre(k, a), 0.0, length, " m", term)
            if axis and model.kinds[k].has_attitude:
                change = turned("p", (k,), np.eye(3)[[a]])
                yield _edit(f"attitude about{axis}", place, change, 0.0, 1.0, " rad", "attitude")
        for name, weight in (("drag_force", mass), ("drag_moment", trace)):
            if not getattr(model, name)[k]:
                yield _number(model, WORDS[name], place, name, (k,), weight, UNITS[name])


def coordinates(model: Model) -> list[tuple[int, int]]:
    """Joint and column of all coordinates that can have elements."""
    return [(k, i) for k, kind in enumerate(model.kinds) for i in range(kind.element_count)]


def coordinate_place(model: Model, k: int, i: int) -> str:
    """Name a coordinate of a joint."""
    names = model.kinds[k].motion_names
    return f"joint {k + 1}" + (f" {names[i]}" if len(names) > 1 else "")


def _joints(model: Model) -> Iterator[Edit]:
    for k, i in coordinates(model):
        for name in JOINT_ELEMENTS:
            if name not in ("rest", "effort") or not model.kinds[k].is_spherical:
                yield _number(model, WORDS.get(name, name), coordinate_place(model, k, i), name, (k, i))
    for i in range(len(model.spring_body)):
        for name in SPRING_FIELDS[2:]:
            yield _number(model, WORDS[name], f"spring {i + 1}", name, (i,), general=OF_SPRINGS[name])
    for k, kind in enumerate(model.kinds):
        if kind.holds_nothing:
            continue
        place = f"joint {k + 1}"
        if own := kind.own_number:
            size, unit = abs(float(model.length[k])) or 0.1, " m" if kind.holds_distance else " m/rad"
            yield _number(model, own, place, "length", (k,), size, unit, own, not kind.holds_distance)
        if kind.motions and kind.motions[0][0] == "slide" and _shift_is_askew(model, k):
            yield _edit("origin of the slide", place, _shifted_slide(k), 0.0, 0.1, " m")
        for (side, where), (a, axis) in product(enumerate(("far", "near")), AXES):
            term = f"{where} point"
            yield _number(model, f"{term}{axis}", place, "point", (k, side, a), 0.1, " m", term)
            if not kind.has_attitude and (side == 0 or not kind.is_rigid):  # equal to a far turn
                axes, term = np.atleast_2d(np.eye(3)[a]), f"turn{axis and ' about' + axis} of the axes"
                change, side_place = turned("turn", (k, side), axes), f"{place} in the {where} body"
                yield _edit(term, side_place, change, np.zeros(len(axes)), 0.1, " rad", "turn of the axes")


def _shift_is_askew(model: Model, k: int) -> bool:
    """Whether another origin of a slide is more than a coordinate of its far point."""
    return bool(model.stiffness[k, 0] or np.count_nonzero(np.abs(_slide_axis(model, k)) > ASKEW) > 1)


@dataclass(frozen=True)
class _Factor:
    """Fields that are multiplied by one factor: of all bodies, joints or springs, of each, or from one on."""

    term: str
    names: tuple[str, ...]
    thing: str
    part: Any = 1.0  # of a field's entries, 1 where they are multiplied
    is_of_each: bool = False
    is_from_one_on: bool = True
    can_vanish: bool = True
    general: str = ""


FACTORS = (
    _Factor("mass and inertia", ("mass", "inertia"), "body", is_of_each=True, can_vanish=False),
    _Factor("mass", ("mass",), "body", can_vanish=False),
    _Factor("inertia", ("inertia",), "body", is_of_each=True, can_vanish=False),
    _Factor("products of inertia", ("inertia",), "body", 1 - np.eye(3), is_of_each=True),
    _Factor("applied force", ("force",), "body", is_of_each=True),
    _Factor("applied moment", ("moment",), "body", is_of_each=True),
    _Factor("applied loads", ("force", "moment"), "body", is_of_each=True),
    _Factor("drag force", ("drag_force",), "body", is_of_each=True),
    _Factor("drag moment", ("drag_moment",), "body", is_of_each=True),
    _Factor("drag", ("drag_force", "drag_moment"), "body", is_of_each=True),
    _Factor("angular velocity ω′", ("omega",), "body", is_of_each=True),
    _Factor("rod rate u̇", ("udot",), "joint", is_of_each=True, is_from_one_on=False),
    _Factor("rates", ("xdot",), "joint", is_of_each=True, is_from_one_on=False),
    *(_Factor(WORDS.get(name, name), (name,), "joint") for name in JOINT_ELEMENTS),
    _Factor("far point", ("point",), "joint", np.eye(2)[0][:, None]),
    _Factor("near point", ("point",), "joint", np.eye(2)[1][:, None]),
    *(_Factor(WORDS[name], (name,), "spring", general=OF_SPRINGS[name]) for name in SPRING_FIELDS[2:]),
)


def _factors(case: Case) -> Iterator[Edit]:
    """One factor on fields."""
    model = case.model
    of_attitude = np.array([kind.has_attitude for kind in model.kinds[: model.n]])
    for one in FACTORS:
        counts = [_entries(case, name, one.part) for name in one.names]
        has = np.all([count > 0 for count in counts], axis=0)
        has = has & of_attitude if one.names == ("omega",) else has
        number, places = np.arange(len(has)), np.flatnonzero(has).tolist()
        # of a vector or products with one entry it is a number's
        is_several = np.sum(counts, axis=0) > (2 if np.ndim(one.part) == 2 else 1)
        is_number = one.thing == "body" and VALUE_AXES[one.names[0]] and one.names[0] != "omega"
        chosen = [
            (f"{one.thing} {k + 1}", number == k)
            for k in (places if one.is_of_each else [])
            if is_several[k] or not is_number
        ]
        for first in places[: len(places) - 1 if one.is_from_one_on else min(len(places) - 1, 1)]:
            which = (
                f"all {PLURALS[one.thing]}"
                if first == places[0]
                else f"{PLURALS[one.thing]} {first + 1} to {len(has)}"
            )
            chosen.append((which, has & (number >= first)))
        for place, where in chosen:
            masks = {name: where.reshape(-1, *(1,) * VALUE_AXES[name]) * one.part for name in one.names}
            more = {"can_vanish": one.can_vanish, "general": one.general}
            yield _factor(one.term, place, scaled(masks), **more)
    for name, what in product(JOINT_ELEMENTS, ("slide", "turn")):
        values, mask = getattr(model, name), np.zeros(getattr(model, name).shape)
        for k, i in coordinates(model):
            mask[k, i] = values[k, i] != 0 and [*model.kinds[k].motions, ("turn", 0)][i][0] == what
        if 1 < np.sum(mask) < np.count_nonzero(values):
            yield _factor(WORDS.get(name, name), f"all {what}s", scaled({name: mask}))
    rates = [name for name in ("omega", "udot", "xdot") if np.any(_entries(case, name, 1.0))]
    if len(rates) > 1:
        yield _factor("rates of every kind", "", scaled(dict.fromkeys(rates, 1.0)))
    sized = ("point", "length", *(("spring_point", "spring_length") if len(model.spring_body) else ()))
    if not any(kind.slide_axes for kind in model.kinds):
        yield _factor("lengths", "the mechanism", scaled(dict.fromkeys(sized, 1.0)), can_vanish=False)
    spins = np.any(gyroscopic_moment(case), axis=(0, 2))
    spinning = [(f"body {k + 1}", np.arange(model.n) == k) for k in np.flatnonzero(spins).tolist()]
    for place, where in spinning + [("all bodies", spins)] * (len(spinning) > 1):
        yield _factor("gyroscopic term", place, _gyroscopic(where), kind="term")


def _entries(case: Case, name: str, part: Any) -> Array:
    """(places,) how many entries of a field are not zero at each place."""
    values = field(case, name)
    if hasattr(case.state, name):
        values = np.any(values, axis=0)
    return np.asarray(np.count_nonzero(values * part, axis=tuple(range(1, values.ndim))))


def _absent(model: Model) -> Iterator[Edit]:
    """One amount in all places of what the mechanism has nowhere."""
    sizes = {"drag_force": float(np.max(model.mass)), "drag_moment": float(np.max(model.inertia))}
    for name, scale in sizes.items():
        if model.n > 1 and not np.any(getattr(model, name)):
            yield _edit(WORDS[name], "all bodies", added(name, np.ones(model.n)), 0.0, scale, UNITS[name])
    where = np.zeros(model.armature.shape)
    for at in coordinates(model):
        where[at] = 1.0
    for name in ("armature", "damping"):
        if np.sum(where) > 1 and not np.any(getattr(model, name)):
            yield _edit(name, "all joints", added(name, where), 0.0, float(np.max(model.inertia)))
