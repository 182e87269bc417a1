"""Table of what an engine or its adapter may read in another frame, or not as the number that it is.

Readings have no amount.  Each is listed for one body, joint or spring, and for all of them together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from plumbline.diagnosis.cause import Cause
from plumbline.diagnosis.edits import WORDS, Edit, field, with_fields
from plumbline.diagnosis.prediction import TRAILING, Case, single_states
from plumbline.model.datatypes import JOINT_ELEMENTS, SPRING_FIELDS, Array, Model, State
from plumbline.model.kinematics import (
    complete_state,
    cross_matrix,
    own_rates,
    quaternion_conjugate,
    quaternion_product,
    rate_count,
    rotate_vectors,
    rotation_matrix,
    spring_vectors,
)
from plumbline.model.loops import assembled, loop_gaps

CLOSED = 1e-9  # m, rad: a larger gap is an open loop
EQUAL, DIGITS = 1e-12, 10  # of two readings
MAX_PLACES = 12  # bodies in which a field may be another's from each of them on; and readings of one body
Change = Callable[[Case], Case]


class Reading(NamedTuple):
    """A term, how it is changed, what that does to a case, and where at its place the term is."""

    term: str
    words: str
    change: Change
    where: str = ""


PLURALS = {"body": "bodies", "joint": "joints", "spring": "springs"}
MISSING = {
    "springs and dampers": ("damping", "stiffness"),
    "springs and efforts": ("stiffness", "effort"),
    "springs, dampers and efforts": ("damping", "stiffness", "effort"),
    "elements": ("armature", "damping", "stiffness", "effort"),
    "springs and dampers between points": ("spring_damping", "spring_stiffness"),
}
PRODUCTS = ("yz", "xz", "xy")  # entries of an inertia by the axis that they leave out
TURNS = {1: "turned as its joint's axes", -1: "turned against its joint's axes",
         2: "turned twice as its joint's axes", -2: "turned twice against its joint's axes"}  # fmt: skip
QUATERNIONS: dict[str, Callable[[Array], Array]] = {
    "not turned": lambda q: np.broadcast_to(np.eye(4)[0], q.shape),
    "turned the other way": quaternion_conjugate,
    "read with the scalar last": lambda q: np.roll(q, 1, -1),
    "given with the scalar last": lambda q: np.roll(q, -1, -1),
}


def reading_edits(case: Case) -> Iterator[Edit]:
    """List the readings of a mechanism that change it, each once."""
    known: set[object] = {()}
    for term, place, words, change in _every_reading(case):
        key = change_key(change(case), case)
        if key in known:
            continue
        known.add(key)
        yield Edit(Cause("frame", term, place, words), _always(change))


def _always(change: Change) -> Callable[[Case, Array], Case]:
    return lambda case, _: change(case)


def change_key(seen: Case, right: Case) -> tuple[tuple[str, bytes], ...]:
    """Return what a case changes, to be compared.

    Quaternions ±q are the same, and of rigid joints only the relative turn counts.
    """
    found = list[tuple[str, bytes]]()
    for changed, base in zip(seen, right, strict=True):
        for name, value in vars(base).items():
            x = getattr(changed, name)
            if x is value:
                continue
            size = float(np.max(np.abs(value), initial=0.0)) or 1.0
            if name in ("turn", "p"):
                x, value = (_attitude_key(q, right.model if name == "turn" else None) for q in (x, value))
                size = 1.0
            if np.max(np.abs(x - value), initial=0.0) > EQUAL * size:
                found.append((name, (np.round(x / size, DIGITS) + 0.0).tobytes()))
    return tuple(found)


def _attitude_key(q: Array, model: Model | None) -> Array:
    if model is not None:
        q = q.copy()
        for k, kind in enumerate(model.kinds):
            if kind.is_rigid:
                q[..., k, 0, :] = quaternion_product(q[..., k, 0, :], quaternion_conjugate(q[..., k, 1, :]))
                q[..., k, 1, :] = np.eye(4)[0]
    return np.asarray(q[..., :, None] * q[..., None, :])


def _every_reading(case: Case) -> Iterator[tuple[str, str, str, Change]]:
    model = case.model
    groups: dict[tuple[str, ...], list[Change]] = {}
    for thing, count, readings in (
        ("body", model.n, _body_readings),
        ("joint", len(model.kind), _joint_readings),
        ("spring", len(model.spring_body), _spring_readings),
    ):
        for k in range(count):
            for term, words, change, where in (Reading(*one) for one in readings(case, k)):
                groups.setdefault((thing, term, words, where), []).append(change)
                if count <= MAX_PLACES:
                    yield term, f"{thing} {k + 1}{where}", words, change
    for (thing, term, words, where), changes in groups.items():
        if len(changes) > 1:
            yield term, f"all {PLURALS[thing]}{where}", words, _one_after_another(changes)
    yield from _fields_of_others(model)
    for term, names in MISSING.items():
        present = [name for name in names if np.any(getattr(model, name))]
        if len(present) > 1:  # one field alone is a cause with a factor
            place = "all joints" if names[0] in JOINT_ELEMENTS else ""
            yield term, place, "missing", _fields(**{name: 0 * getattr(model, name) for name in present})
    for i, j in ((0, 1), (0, 2), (1, 2)):
        order = [j if axis == i else i if axis == j else axis for axis in range(3)]
        axes = f"{'xyz'[i]} and {'xyz'[j]}"
        yield (
            "components of gravity",
            "",
            f"taken with {axes} exchanged",
            _fields(gravity=model.gravity[order]),
        )
    yield "inputs", "", "rounded to single precision", _rounded_to_single_precision


def _one_after_another(changes: Sequence[Change]) -> Change:
    """The same reading of all places; each sees the right state of the others."""

    def change(case: Case) -> Case:
        changed = [one(case) for one in changes]
        found = changed[0]
        for other in changed[1:]:
            found = _merged(case, found, other)
        return found

    return change


def _merged(right: Case, one: Case, other: Case) -> Case:
    """Both changes; where both change a field, what the second changes of it."""
    fields = {}
    for base, a, b in zip(right, one, other, strict=True):
        for name, value in vars(base).items():
            x, y = getattr(a, name), getattr(b, name)
            if y is not value:
                fields[name] = y if x is value else np.where(y != value, y, x)
    return with_fields(one, **fields)


def _fields(**values: Any) -> Change:
    return lambda case: with_fields(case, **values)


def _row(name: str, k: int, of: Callable[[Case], Array]) -> Change:
    """Replace what a field holds of one place, by one value or one per state."""

    def change(case: Case) -> Case:
        value, values, own = np.asarray(of(case)), field(case, name), TRAILING[name]
        is_lifted = value.ndim > own and values.ndim == own + 1
        values = np.repeat(values[None], len(value), 0) if is_lifted else values.copy()
        at: tuple[Any, ...] = (..., k, *(slice(None),) * own)
        values[at] = value
        return with_fields(case, **{name: values})

    return change


def _constant(name: str, k: int, value: Any) -> Change:
    """Replace what a field holds of one place by other numbers."""
    return _row(name, k, lambda _: np.array(value))


# -- bodies --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Body:
    """What readings take of body k at the states of a case."""

    k: int
    far: int

    def p(self, c: Case) -> Array:
        return c.state.p[:, self.k]

    def omega(self, c: Case) -> Array:
        return c.state.omega[:, self.k]

    def v(self, c: Case) -> Array:
        return c.state.v[:, self.k]

    def above(self, c: Case) -> Array:
        return c.state.p[:, self.far]

    def relative(self, c: Case) -> Array:
        return quaternion_product(quaternion_conjugate(self.above(c)), self.p(c))

    def to_world(self, c: Case, x: Array) -> Array:
        return np.asarray(np.matvec(rotation_matrix(self.p(c)), x))

    def to_body(self, c: Case, x: Array) -> Array:
        return np.asarray(np.matvec(rotation_matrix(self.p(c)).mT, x))

    def carried(self, c: Case) -> Array:
        """Angular velocity of the far body, in this body's frame."""
        return self.to_body(c, rotate_vectors(rotation_matrix(self.above(c)), c.state.omega[:, self.far]))


def _rows(
    term: str, name: str, k: int, readings: Mapping[str, Callable[[Case], Array]]
) -> list[tuple[Any, ...]]:
    return [(term, words, _row(name, k, of)) for words, of in readings.items()]


def _body_readings(case: Case, k: int) -> Iterator[tuple[Any, ...]]:
    model = case.model
    kind, b = model.kinds[k], _Body(k, int(model.body[k, 0]))
    if kind.has_attitude:
        attitudes: dict[str, Callable[[Case], Array]] = {
            words: partial(lambda read, c: read(b.p(c)), read)
            for words, read in list(QUATERNIONS.items())[1:]
        }
        rates = {
            "in the world frame": lambda c: b.to_world(c, b.omega(c)),
            "turned with Aᵀ instead of A": lambda c: b.to_body(c, b.omega(c)),
        }
        if b.far >= 0:
            attitudes |= {
                "that relative to its parent": b.relative,
                "taken as relative to its parent": lambda c: quaternion_product(b.above(c), b.p(c)),
                "multiplied in the reverse order, its parent's after the relative one": lambda c: (
                    quaternion_product(b.relative(c), b.above(c))
                ),
            }
            rates |= {
                "that relative to its parent": lambda c: b.omega(c) - b.carried(c),
                "taken as relative to its parent": lambda c: b.omega(c) + b.carried(c),
            }
        yield from _rows("attitude", "p", k, attitudes)
        yield from _rows("angular velocity", "omega", k, rates)
    if kind.holds_nothing:
        velocities = {
            "given in the body frame": lambda c: b.to_world(c, b.v(c)),
            "in the body frame": lambda c: b.to_body(c, b.v(c)),
        }
        yield from _rows("velocity", "v", k, velocities)
    yield from _attachment_readings(model, k)
    yield from _inertia_readings(model, k)
    yield from _load_readings(model, b)


def _attachment_readings(model: Model, k: int) -> Iterator[tuple[Any, ...]]:
    """All points of joints on a body with the opposite sign, or two of them exchanged."""
    on_body = model.body == k
    if np.sum(on_body) < 2:
        return

    def reversed_points(c: Case) -> Case:
        return with_fields(c, point=np.where(on_body[..., None], -c.model.point, c.model.point))

    def exchanged(c: Case) -> Case:
        points = c.model.point.copy()
        points[..., on_body, :] = points[..., on_body, :][..., ::-1, :]
        return with_fields(c, point=points)

    yield "attachment points", "reversed", reversed_points
    if np.sum(on_body) == 2:
        yield "attachment points", "exchanged", exchanged


def _inertia_readings(model: Model, k: int) -> Iterator[tuple[Any, ...]]:
    J, arm = model.inertia[k], cross_matrix(model.proximal[k])

    def turned(by: Callable[[Array], Array]) -> Callable[[Case], Array]:
        def of(c: Case) -> Array:
            A = by(rotation_matrix(c.state.p[:, k]))
            return np.asarray((A @ J @ A.mT + (A @ J @ A.mT).mT) / 2)

        return of

    readings = {
        "taken in world axes": turned(lambda A: A.mT),
        "turned with Aᵀ instead of A": turned(lambda A: A.mT @ A.mT),
    }
    if not model.kinds[k].holds_nothing:
        readings["that about its joint's point"] = lambda c: J - model.mass[k] * (arm @ arm)
    for times, words in TURNS.items() if not model.kinds[k].has_attitude else ():
        axes = np.linalg.matrix_power(rotation_matrix(model.turn[k, 1]), times)
        readings[words] = turned(partial(lambda axes, _: axes, axes))
    yield from _rows("inertia", "inertia", k, readings)
    for order in list(permutations(range(3)))[1:]:  # in the right order a factor
        for sign in (-1.0, 1.0):
            other = J.copy()
            for i, j in enumerate(order):
                a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
                other[a, b] = other[b, a] = sign * J[c, d]
            taken = ", ".join("-" * (sign < 0) + PRODUCTS[j] for j in order)
            yield "products of inertia yz, xz, xy", taken, _constant("inertia", k, other)


def _load_readings(model: Model, b: _Body) -> Iterator[tuple[Any, ...]]:
    """Loads and drag in other axes, at other points, exchanged, or of other velocities."""
    k = b.k
    force, moment, c_t, c_r = model.force[k], model.moment[k], model.drag_force[k], model.drag_moment[k]

    def more(name: str, of: Callable[[Case], Array]) -> Change:
        return _row(name, k, lambda c: field(c, name)[..., k, :] + of(c))

    def at_point(point: Array, of: Callable[[Case], Array]) -> Change:
        return more("moment", lambda c: np.cross(point, b.to_body(c, of(c))))

    def of_point(c: Case) -> Array:
        return b.to_world(c, np.cross(b.omega(c), model.proximal[k]))

    forces = {
        "taken in the body frame": lambda c: b.to_world(c, force),
        "rotated with Aᵀ": lambda c: b.to_body(c, force),
    }
    moments = {
        "taken in the world frame": lambda c: b.to_body(c, moment),
        "rotated with A": lambda c: b.to_world(c, moment),
    }
    yield from _rows("applied force", "force", k, forces) + _rows("applied moment", "moment", k, moments)
    points = {} if model.kinds[k].holds_nothing else {"its joint's": model.proximal[k]}
    points |= {f"joint {j + 1}'s": model.point[j, 0] for j, far in enumerate(model.body[:, 0]) if far == k}
    for which, point in points.items():
        where = f"applied at {which} point"
        yield "applied force", where, at_point(point, lambda c: force)
        yield "weight", where, at_point(point, lambda c: model.mass[k] * model.gravity)
        yield "drag force", where, at_point(point, lambda c: -c_t * b.v(c))
    for names, words in ((("force", "moment"), "applied force and moment"),
                         (("drag_force", "drag_moment"), "drag force and drag moment")):  # fmt: skip
        changes = [_constant(name, k, getattr(model, other)[k]) for name, other in (names, names[::-1])]
        yield words, "exchanged", partial(lambda one, other, case: other(one(case)), *changes)
    if c_t != c_r:
        if c_t:
            yield "drag moment", "that of the drag force's coefficient", _constant("drag_moment", k, c_t)
        if c_r:
            yield "drag force", "that of the drag moment's coefficient", _constant("drag_force", k, c_r)
    drags = {
        "taken with the body-frame velocity": lambda c: c_t * (b.v(c) - b.to_body(c, b.v(c))),
        "taken with the velocity of its joint's point": lambda c: -c_t * of_point(c),
    }
    rates = {
        "taken with the world-frame angular velocity": lambda c: (
            c_r * (b.omega(c) - b.to_world(c, b.omega(c)))
        )
    }
    if b.far >= 0:
        rates["taken with the angular velocity relative to its parent"] = lambda c: c_r * b.carried(c)
    yield from (("drag force", words, more("force", of)) for words, of in drags.items())
    yield from (("drag moment", words, more("moment", of)) for words, of in rates.items())


# -- joints --------------------------------------------------------------------------------------------


def _joint_readings(case: Case, k: int) -> Iterator[tuple[Any, ...]]:
    model = case.model
    kind = model.kinds[k]
    if k < model.n:
        yield from _coordinate_readings(model, k)
    if len(kind.motions) == 2:
        for name in JOINT_ELEMENTS:
            pair = getattr(model, name)[k]
            yield (
                f"{WORDS.get(name, name)} of the two coordinates", "exchanged",
                _row(name, k, lambda c, pair=pair: pair[[1, 0, *range(2, len(pair))]]),  # type: ignore[misc]
            )  # fmt: skip
    if kind.has_pitch:
        for words, factor in (("reversed", -1.0), ("taken per turn, not per radian", 0.5 / np.pi)):
            yield "pitch", words, _row("length", k, lambda c, x=factor: x * c.model.length[..., k])  # type: ignore[misc]
    if not kind.holds_nothing:
        yield from _point_readings(model, k)
    if not kind.has_attitude:
        yield from _axes_readings(model, k)


def _coordinate_readings(model: Model, k: int) -> Iterator[tuple[Any, ...]]:
    motions = model.kinds[k].motions

    def coordinate(name: str, i: int, change: Callable[[Array], Array]) -> Change:
        def of(case: Case) -> Array:
            values = field(case, name)[:, k].copy()
            values[:, i] = change(values[:, i])
            return values

        return _row(name, k, of)

    for i, (what, _) in enumerate(motions):
        if what == "turn":
            principal = coordinate("x", i, lambda x: np.arctan2(np.sin(x), np.cos(x)))
            yield f"angle {i + 1}", "its principal value", principal
        for name, words in (("x", "coordinate"), ("xdot", "rate")):
            if name == "x" or len(motions) > 1:  # else a factor
                yield f"{words} {i + 1}", "reversed", coordinate(name, i, lambda x: -x)
            yield f"{words} {i + 1}", "its absolute value", coordinate(name, i, np.abs)
        if model.stiffness[k, i]:
            yield f"spring {i + 1}", "without its coordinate", _unmoved_spring(k, i)
    if len(motions) == 2:
        for name, words in (("x", "coordinates"), ("xdot", "rates")):
            yield words, "exchanged", _row(name, k, lambda c, name=name: field(c, name)[:, k, ::-1])  # type: ignore[misc]


def _unmoved_spring(k: int, i: int) -> Change:
    """A joint's spring that pulls with its rest position alone."""

    def change(case: Case) -> Case:
        effort = np.repeat(case.model.effort[None], len(case.state.x), 0)
        effort[:, k, i] += case.model.stiffness[k, i] * case.state.x[:, k, i]
        return with_fields(case, effort=effort)

    return change


def _point_readings(model: Model, k: int) -> Iterator[tuple[Any, ...]]:
    """Points of joints negated, exchanged, left out, or in other axes."""
    far, near = points = model.point[k]
    readings = {("points", "exchanged", " in the two bodies"): (near, far)}
    for side, where in enumerate(("far", "near")):
        turn = rotation_matrix(model.turn[k, side])
        for words, point in (
            ("reversed", -points[side]),
            ("left out", 0 * points[side]),
            ("that of the other body", points[1 - side]),
            ("given in the axes of the joint", turn @ points[side]),
            ("turned into the axes of the joint", turn.T @ points[side]),
        ):
            readings[f"{where} point", words, ""] = (point, near) if side == 0 else (far, point)
    readings["points", "reversed", " in both bodies"] = (-far, -near)
    for (term, words, where), pair in readings.items():
        yield term, words, _constant("point", k, pair), where


def _axes_readings(model: Model, k: int) -> Iterator[tuple[Any, ...]]:
    """Frames of joints left out, turned the other way, exchanged or misread; axes reversed or exchanged."""
    kind = model.kinds[k]
    motions = [axis for _, axis in kind.motions]
    far, near = frames = model.turn[k]
    readings: dict[tuple[str, str, str], tuple[Array, Array]] = {}
    for axis in dict.fromkeys(motions):
        half = np.roll(np.eye(4)[1], int(axis == 0))  # about y for x, about x for the others
        pair = (quaternion_product(far, half), quaternion_product(near, half))
        readings[f"axis {'xyz'[axis]}", "reversed", ""] = pair
    far_body, near_body, both, two = (
        f" in {of}" for of in ("the far body", "the near body", "both bodies", "the two bodies")
    )
    for sides, where in (((0,), far_body), ((1,), near_body), ((0, 1), both)):
        for words, misread in QUATERNIONS.items():
            read = [misread(q) if side in sides else q for side, q in enumerate(frames)]
            readings["axes", words, where] = read[0], read[1]
    readings["axes", "exchanged", two] = near, far
    readings["axes", "those of the near body", far_body] = near, near
    readings["axes", "those of the far body", near_body] = far, far
    pairs = ((0, 2), (1, 2)) if kind.is_about_z else ((0, 1), (0, 2), (1, 2))
    for i, j in pairs if motions else ():
        half = np.array([0.0, *(np.sqrt(0.5) * (np.eye(3)[i] + np.eye(3)[j]))])
        pair = (quaternion_product(far, half), quaternion_product(near, half))
        readings[f"axes {'xyz'[i]} and {'xyz'[j]}", "exchanged", ""] = pair
    for (term, words, where), pair in readings.items():
        yield term, words, _constant("turn", k, pair), where


# -- springs, fields of others, and all ----------------------------------------------------------------


def _spring_readings(case: Case, i: int) -> Iterator[tuple[Any, ...]]:
    """Points of springs negated, left out or exchanged; rates not divided by the length."""
    model = case.model
    points = model.spring_point[i]
    yield "points", "exchanged", _constant("spring_point", i, points[::-1])
    for side, where in enumerate(("first", "second")):
        where = f"{where} point" if model.spring_body[i, side] >= 0 else "world's point"
        for words, point in (("reversed", -points[side]), ("left out", 0 * points[side])):
            pair = (point, points[1]) if side == 0 else (points[0], point)
            yield where, words, _constant("spring_point", i, pair)
    if model.spring_damping[i]:

        def undivided(c: Case) -> Array:
            each = single_states(c.state)
            spans = np.array([np.linalg.norm(spring_vectors(model, s.r, s.p)[i]) for s in each])
            return np.asarray(spans * model.spring_damping[i])

        yield "rate", "dᵀḋ, not over the length", _row("spring_damping", i, undivided)


def _fields_of_others(model: Model) -> Iterator[tuple[str, str, str, Change]]:
    """A field of all bodies, joints or springs taken from another one, or only of those from one on."""
    body_values = ("mass", "inertia", "force", "moment", "drag_force", "drag_moment")
    for name, thing in {
        **dict.fromkeys(JOINT_ELEMENTS, "joint"),
        **dict.fromkeys(body_values, "body"),
        **dict.fromkeys(SPRING_FIELDS[1:], "spring"),
    }.items():
        values, term = getattr(model, name), WORDS.get(name, name)
        count = len(values)
        if count < 2:
            continue
        places = np.arange(count)
        few = count - 2 if 3 <= count <= MAX_PLACES else 1  # from how many places on
        sources = {
            f"that of the {thing} before": (np.maximum(places - 1, 0), few),
            f"that of the {thing} after": (np.minimum(places + 1, count - 1), 1),
            f"that of the first {thing}": (0 * places, few),
            f"that of the {thing} counted from the other end": (places[::-1], 1),
        }
        if thing != "spring":
            hangs_on = np.where(model.body[:count, 0] < 0, places, model.body[:count, 0])
            sources[f"that of the {thing} on which it hangs"] = (hangs_on, few)
        for words, (source, starts) in sources.items():
            for first in range(starts):
                taken = np.where(places > first, source, places) if first else source
                moved = values[taken] * _has_place(model, name)
                if np.sum(moved != values) >= 2:  # a single number is a cause of its own
                    which = f"{PLURALS[thing]} {first + 2} to {count}" if first else f"every {thing}"
                    yield term, which, words, _fields(**{name: moved})


def _has_place(model: Model, name: str) -> Array:
    """Where a field has a meaning: elements on a joint's coordinates (J, 2), 1 for all other fields."""
    if name not in JOINT_ELEMENTS:
        return np.ones(1)
    is_idle = name in ("rest", "effort")
    counts = [len(kind.motions) or int(kind.is_spherical and not is_idle) for kind in model.kinds]
    return np.asarray(np.arange(model.columns) < np.array(counts)[:, None], float)


def _rounded_to_single_precision(case: Case) -> Case:
    """All inputs in single precision, the quaternions normalised again."""
    model = {
        name: np.asarray(value, np.float32).astype(float)
        for name, value in vars(case.model).items()
        if isinstance(value, np.ndarray) and value.dtype == float
    }
    state = {name: np.asarray(value, np.float32).astype(float) for name, value in vars(case.state).items()}
    for fields, name in ((model, "turn"), (state, "p")):
        fields[name] = fields[name] / np.linalg.norm(fields[name], axis=-1, keepdims=True)
    return with_fields(case, **model, **state)


# -- loops ---------------------------------------------------------------------------------------------


def other_branches(model: Model) -> Iterator[tuple[Cause, list[Callable[[State], State]]]]:
    """List joints on the world at whose coordinates an engine may close the loops in other poses.

    Yields:
        The cause, and the poses that guesses lead to.

    """
    turns = [
        (k, i) for k in range(model.n) for i, (what, _) in enumerate(model.kinds[k].motions) if what == "turn"
    ]
    guesses: list[Callable[[Array], Array]] = [lambda x: -x, *map(_turned_over, turns)]
    for given in map(int, np.flatnonzero(model.body[: model.n, 0] < 0)):
        if len(model.kinds[given].motions) == 1:
            words = "closed on another branch at the same coordinate"
            cause = Cause("frame", "loops", "", f"{words} of joint {given + 1}")
            yield cause, [_branch(model, given, guess) for guess in guesses]


def _turned_over(turn: tuple[int, int]) -> Callable[[Array], Array]:
    """A guess: one angle is half a turn more."""

    def guess(x: Array) -> Array:
        y = x.copy()
        y[turn] += np.pi
        return y

    return guess


def _branch(model: Model, given: int, guess: Callable[[Array], Array]) -> Callable[[State], State]:
    """The pose to which loops close from a guess of the coordinates (N, 2), joint ``given`` held."""

    def pose(state: State) -> State:
        x = guess(state.x)
        x[given] = state.x[given]
        movable = np.ones(rate_count(model.tree), bool)
        movable[own_rates(model)[given]] = False
        start = complete_state(model, State(**(vars(state) | {"x": x})))
        other = assembled(model, start, movable, is_pose_kept=True)
        if max(map(np.max, loop_gaps(model, other))) > CLOSED:
            raise ValueError("the loops do not close from this guess")
        return other

    return pose
