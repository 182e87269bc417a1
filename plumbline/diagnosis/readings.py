"""Table of what an engine or its adapter may read in another frame, or not as the number that it is.

Readings have no amount.  Each is listed for one body, joint or spring, and for all of them together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain, permutations
from typing import Any, NamedTuple

import numpy as np

from plumbline.diagnosis.cause import Cause
from plumbline.diagnosis.edits import PLURALS, WORDS, Edit, field, with_fields
from plumbline.diagnosis.prediction import Case, is_closed, single_states
from plumbline.model.datatypes import (
    BODY_FIELDS,
    JOINT_ELEMENTS,
    SPRING_FIELDS,
    VALUE_AXES,
    Array,
    Model,
    State,
)
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
    stack_states,
)
from plumbline.model.loops import assembled

EQUAL, DIGITS = 1e-12, 10  # of two readings
MAX_PLACES = 12  # bodies in which a field may be another's from each of them on; and readings of one body
Change = Callable[[Case], Case]


class Reading(NamedTuple):
    """A term, how it is read, what that replaces, and where at its place the term is."""

    term: str
    words: str
    pieces: list[Piece]
    where: str = ""


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
    for term, place, words, change in _every_reading(case.model):
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
    for changed, base in ((seen.model, right.model), (seen.state, right.state)):
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


def _every_reading(model: Model) -> Iterator[tuple[str, str, str, Change]]:
    groups: dict[tuple[str, ...], list[list[Piece]]] = {}
    for thing, count, readings in (
        ("body", model.n, _body_readings),
        ("joint", len(model.kind), _joint_readings),
        ("spring", len(model.spring_body), _spring_readings),
    ):
        for k in range(count):
            for term, words, pieces, where in readings(model, k):
                groups.setdefault((thing, term, words, where), []).append(pieces)
                if count <= MAX_PLACES:
                    yield term, f"{thing} {k + 1}{where}", words, _replaced(pieces)
    for (thing, term, words, where), each in groups.items():
        if len(each) > 1:
            everywhere = _replaced(list(chain.from_iterable(each)))
            yield term, f"all {PLURALS[thing]}{where}", words, everywhere
    yield from _fields_of_others(model)
    for term, names in MISSING.items():
        present = [name for name in names if np.any(getattr(model, name))]
        if len(present) > 1:  # one field alone is a cause with a factor
            place = "all joints" if names[0] in JOINT_ELEMENTS else ""
            yield term, place, "missing", _fields(**{name: 0 * getattr(model, name) for name in present})
    for i, j in ((0, 1), (0, 2), (1, 2)):
        order = [j if axis == i else i if axis == j else axis for axis in range(3)]
        axes = f"{'xyz'[i]} and {'xyz'[j]}"
        exchanged = _fields(gravity=model.gravity[order])
        yield "components of gravity", "", f"taken with {axes} exchanged", exchanged
    yield "inputs", "", "rounded to single precision", _rounded_to_single_precision


def _replaced(pieces: list[Piece]) -> Change:
    """Replace parts of fields, each by what the right case makes of it."""

    def change(case: Case) -> Case:
        fields: dict[str, Array] = {}
        for name, k, at, of in pieces:
            value, own = np.asarray(of(_Place(case, k))), VALUE_AXES[name]
            values = fields[name] if name in fields else field(case, name).copy()
            if value.ndim > own - len(at) and values.ndim == own + 1:  # another one at each state
                values = np.repeat(values[None], len(value), 0)
            values[_at(name, k, *at)] = value
            fields[name] = values
        return with_fields(case, **fields)

    return change


def _fields(**values: Any) -> Change:
    return lambda case: with_fields(case, **values)


class _Place:
    """What the fields of a case hold of one body, joint or spring, by their names."""

    def __init__(self, case: Case, k: int) -> None:
        self.case, self.k = case, k

    def __getattr__(self, name: str) -> Array:
        return np.asarray(field(self.case, name)[_at(name, self.k)])

    @property
    def above(self) -> Array:
        """Attitude of the far body."""
        far = int(self.case.model.body[self.k, 0])
        return np.asarray(self.case.state.p[:, far] if far >= 0 else np.eye(4)[:1])

    @property
    def relative(self) -> Array:
        """Attitude relative to the far body."""
        return quaternion_product(quaternion_conjugate(self.above), self.p)

    @property
    def carried(self) -> Array:
        """Angular velocity of the far body, in this body's frame."""
        far = int(self.case.model.body[self.k, 0])
        omega = self.case.state.omega[:, far] if far >= 0 else 0 * self.omega
        return self.to_body(rotate_vectors(rotation_matrix(self.above), omega))

    def to_world(self, x: Array) -> Array:
        return np.asarray(np.matvec(rotation_matrix(self.p), x))

    def to_body(self, x: Array) -> Array:
        return np.asarray(np.matvec(rotation_matrix(self.p).mT, x))

    def turned_inertia(self, times: int, axes: Array | None = None) -> Array:
        """Inertia turned so many times by axes, or by the attitude at each state."""
        A = rotation_matrix(self.p) if axes is None else np.broadcast_to(axes, (len(self.p), 3, 3))
        A = np.linalg.matrix_power(A, times)
        J = A @ self.inertia @ A.mT
        return np.asarray((J + J.mT) / 2)


Read = Callable[[_Place], Any]
Piece = tuple[str, int, tuple[int, ...], Read]  # field, place, where in its value, what is read there


def _at(name: str, k: int, *at: int) -> tuple[Any, ...]:
    return (..., k, *at, *(slice(None),) * (VALUE_AXES[name] - len(at)))


def _constant(name: str, k: int, value: Any, *at: int) -> Piece:
    """Other numbers in place of what a field holds of one place."""
    return name, k, at, lambda _: np.array(value)


# -- bodies --------------------------------------------------------------------------------------------

# term, field, and what is read in place of it; a reading that changes nothing is left out
OF_BODIES: tuple[tuple[str, str, dict[str, Read]], ...] = (
    ("attitude", "p", {
        **{words: partial(lambda read, b: read(b.p), read) for words, read in list(QUATERNIONS.items())[1:]},
        "that relative to its parent": lambda b: b.relative,
        "taken as relative to its parent": lambda b: quaternion_product(b.above, b.p),
        "multiplied in the reverse order, its parent's after the relative one":
            lambda b: quaternion_product(b.relative, b.above),
    }),
    ("angular velocity", "omega", {
        "in the world frame": lambda b: b.to_world(b.omega),
        "turned with Aᵀ instead of A": lambda b: b.to_body(b.omega),
        "that relative to its parent": lambda b: b.omega - b.carried,
        "taken as relative to its parent": lambda b: b.omega + b.carried,
    }),
    ("velocity", "v", {
        "given in the body frame": lambda b: b.to_world(b.v),
        "in the body frame": lambda b: b.to_body(b.v),
    }),
    ("inertia", "inertia", {
        "taken in world axes": lambda b: b.turned_inertia(-1),
        "turned with Aᵀ instead of A": lambda b: b.turned_inertia(-2),
    }),
    ("applied force", "force", {
        "taken in the body frame": lambda b: b.to_world(b.force),
        "rotated with Aᵀ": lambda b: b.to_body(b.force),
    }),
    ("applied moment", "moment", {
        "taken in the world frame": lambda b: b.to_body(b.moment),
        "rotated with A": lambda b: b.to_world(b.moment),
    }),
    ("drag moment", "drag_moment", {
        "that of the drag force's coefficient": lambda b: b.drag_force or b.drag_moment,
    }),
    ("drag force", "drag_force", {
        "that of the drag moment's coefficient": lambda b: b.drag_moment or b.drag_force,
    }),
    ("drag force", "force", {
        "taken with the body-frame velocity": lambda b: b.force + b.drag_force * (b.v - b.to_body(b.v)),
        "taken with the velocity of its joint's point":
            lambda b: b.force - b.drag_force * b.to_world(np.cross(b.omega, b.point[1])),
    }),
    ("drag moment", "moment", {
        "taken with the world-frame angular velocity":
            lambda b: b.moment + b.drag_moment * (b.omega - b.to_world(b.omega)),
        "taken with the angular velocity relative to its parent":
            lambda b: b.moment + b.drag_moment * b.carried,
    }),
)  # fmt: skip


def _body_readings(model: Model, k: int) -> Iterator[Reading]:
    kind = model.kinds[k]
    is_read = {"p": kind.has_attitude, "omega": kind.has_attitude, "v": kind.holds_nothing}
    for term, name, readings in OF_BODIES:
        for words, of in readings.items() if is_read.get(name, True) else ():
            yield Reading(term, words, [(name, k, (), of)])
    attached = [(j, side, model.point[j, side]) for j, side in np.argwhere(model.body == k).tolist()]
    if len(attached) > 1:
        reversed_ = [_constant("point", j, -point, side) for j, side, point in attached]
        yield Reading("attachment points", "reversed", reversed_)
    if len(attached) == 2:
        others = zip(attached, attached[::-1], strict=True)
        exchanged = [_constant("point", j, point, side) for (j, side, _), (*_, point) in others]
        yield Reading("attachment points", "exchanged", exchanged)
    yield from _inertia_readings(model, k)
    points = {} if kind.holds_nothing else {"its joint's": model.proximal[k]}
    points |= {f"joint {j + 1}'s": point for j, side, point in attached if side == 0}
    forces: dict[str, Read] = {
        "applied force": lambda b: b.force,
        "weight": lambda b: b.mass * b.case.model.gravity,
        "drag force": lambda b: -b.drag_force * b.v,
    }
    for which, point in points.items():
        for term, force in forces.items():
            moved = partial(lambda x, of, b: b.moment + np.cross(x, b.to_body(of(b))), point, force)
            yield Reading(term, f"applied at {which} point", [("moment", k, (), moved)])
    for names, words in ((("force", "moment"), "applied force and moment"),
                         (("drag_force", "drag_moment"), "drag force and drag moment")):  # fmt: skip
        pieces = [_constant(name, k, getattr(model, other)[k]) for name, other in (names, names[::-1])]
        yield Reading(words, "exchanged", pieces)


def _inertia_readings(model: Model, k: int) -> Iterator[Reading]:
    """Inertias about another point, turned by the joint's axes, or with other products."""
    J, arm = model.inertia[k], cross_matrix(model.proximal[k])
    if not model.kinds[k].holds_nothing:
        about_point = _constant("inertia", k, J - model.mass[k] * (arm @ arm))
        yield Reading("inertia", "that about its joint's point", [about_point])
    for times, words in TURNS.items() if not model.kinds[k].has_attitude else ():
        of = partial(lambda n, axes, b: b.turned_inertia(n, axes), times, rotation_matrix(model.turn[k, 1]))
        yield Reading("inertia", words, [("inertia", k, (), of)])
    for order in list(permutations(range(3)))[1:]:  # in the right order a factor
        for sign in (-1.0, 1.0):
            other = J.copy()
            for i, j in enumerate(order):
                a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
                other[a, b] = other[b, a] = sign * J[c, d]
            taken = ", ".join("-" * (sign < 0) + PRODUCTS[j] for j in order)
            yield Reading("products of inertia yz, xz, xy", taken, [_constant("inertia", k, other)])


# -- joints --------------------------------------------------------------------------------------------


def _joint_readings(model: Model, k: int) -> Iterator[Reading]:
    kind = model.kinds[k]
    if k < model.n:
        yield from _coordinate_readings(model, k)
    if len(kind.motions) == 2:
        order = [1, 0, *range(2, model.columns)]
        terms = {name: f"{WORDS.get(name, name)} of the two coordinates" for name in JOINT_ELEMENTS}
        terms |= {"x": "coordinates", "xdot": "rates"} if k < model.n else {}
        for name, term in terms.items():
            exchanged = partial(lambda name, j: getattr(j, name)[..., order], name)
            yield Reading(term, "exchanged", [(name, k, (), exchanged)])
    if kind.has_pitch:
        for words, factor in (("reversed", -1.0), ("taken per turn, not per radian", 0.5 / np.pi)):
            yield Reading("pitch", words, [_constant("length", k, factor * model.length[k])])
    if not kind.holds_nothing:
        yield from _point_readings(model, k)
    if not kind.has_attitude:
        yield from _axes_readings(model, k)


def _coordinate_readings(model: Model, k: int) -> Iterator[Reading]:
    motions = model.kinds[k].motions
    of_each: dict[str, Callable[[Array], Array]] = {"reversed": np.negative, "its absolute value": np.abs}

    def coordinate(name: str, i: int, change: Callable[[Array], Array]) -> Piece:
        return name, k, (i,), lambda j: change(getattr(j, name)[..., i])

    for i, (what, _) in enumerate(motions):
        if what == "turn":
            principal = coordinate("x", i, lambda x: np.arctan2(np.sin(x), np.cos(x)))
            yield Reading(f"angle {i + 1}", "its principal value", [principal])
        for name, term in (("x", "coordinate"), ("xdot", "rate")):
            for words, change in of_each.items():
                if name == "x" or len(motions) > 1 or words != "reversed":  # else a factor
                    yield Reading(f"{term} {i + 1}", words, [coordinate(name, i, change)])
        if model.stiffness[k, i]:
            pull = partial(lambda i, j: j.effort[..., i] + j.stiffness[..., i] * j.x[..., i], i)
            yield Reading(f"spring {i + 1}", "without its coordinate", [("effort", k, (i,), pull)])


def _point_readings(model: Model, k: int) -> Iterator[Reading]:
    """Points of joints negated, exchanged, left out, or in other axes."""
    far, near = points = model.point[k]
    for side, where in enumerate(("far", "near")):
        turn = rotation_matrix(model.turn[k, side])
        for words, point in (
            ("reversed", -points[side]),
            ("left out", 0 * points[side]),
            ("that of the other body", points[1 - side]),
            ("given in the axes of the joint", turn @ points[side]),
            ("turned into the axes of the joint", turn.T @ points[side]),
        ):
            yield Reading(f"{where} point", words, [_constant("point", k, point, side)])
    yield Reading("points", "exchanged", [_constant("point", k, (near, far))], " in the two bodies")
    yield Reading("points", "reversed", [_constant("point", k, (-far, -near))], " in both bodies")


def _axes_readings(model: Model, k: int) -> Iterator[Reading]:
    """Frames of joints left out, turned the other way, exchanged or misread; axes reversed or exchanged."""
    kind = model.kinds[k]
    far, near = frames = model.turn[k]

    def turned_by(half: Array) -> Piece:
        return _constant("turn", k, quaternion_product(frames, half))

    for axis in dict.fromkeys(axis for _, axis in kind.motions):
        about = np.roll(np.eye(4)[1], int(axis == 0))  # about y for x, about x for the others
        yield Reading(f"axis {'xyz'[axis]}", "reversed", [turned_by(about)])
    far_body, near_body, both = " in the far body", " in the near body", " in both bodies"
    for sides, where in (((0,), far_body), ((1,), near_body), ((0, 1), both)):
        for words, misread in QUATERNIONS.items():
            pieces = [_constant("turn", k, misread(frames[side]), side) for side in sides]
            yield Reading("axes", words, pieces, where)
    yield Reading("axes", "exchanged", [_constant("turn", k, (near, far))], " in the two bodies")
    yield Reading("axes", "those of the near body", [_constant("turn", k, (near, near))], far_body)
    yield Reading("axes", "those of the far body", [_constant("turn", k, (far, far))], near_body)
    pairs = ((0, 2), (1, 2)) if kind.is_about_z else ((0, 1), (0, 2), (1, 2))
    for i, j in pairs if kind.motions else ():
        about = np.array([0.0, *(np.sqrt(0.5) * (np.eye(3)[i] + np.eye(3)[j]))])
        yield Reading(f"axes {'xyz'[i]} and {'xyz'[j]}", "exchanged", [turned_by(about)])


# -- springs, fields of others, and all ----------------------------------------------------------------


def _spring_readings(model: Model, i: int) -> Iterator[Reading]:
    """Points of springs negated, left out or exchanged; rates not divided by the length."""
    points = model.spring_point[i]
    yield Reading("points", "exchanged", [_constant("spring_point", i, points[::-1])])
    for side, where in enumerate(("first", "second")):
        where = f"{where} point" if model.spring_body[i, side] >= 0 else "world's point"
        for words, point in (("reversed", -points[side]), ("left out", 0 * points[side])):
            yield Reading(where, words, [_constant("spring_point", i, point, side)])
    if model.spring_damping[i]:

        def undivided(place: _Place) -> Array:
            each = single_states(place.case.state)
            spans = np.array([np.linalg.norm(spring_vectors(model, s.r, s.p)[i]) for s in each])
            return np.asarray(spans * model.spring_damping[i])

        yield Reading("rate", "dᵀḋ, not over the length", [("spring_damping", i, (), undivided)])


def _fields_of_others(model: Model) -> Iterator[tuple[str, str, str, Change]]:
    """A field of all bodies, joints or springs taken from another one, or only of those from one on."""
    for name, thing in {
        **dict.fromkeys(JOINT_ELEMENTS, "joint"),
        **dict.fromkeys(("mass", "inertia", *BODY_FIELDS), "body"),
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


def other_branches(model: Model) -> Iterator[tuple[Cause, list[Edit]]]:
    """List joints on the world at whose coordinates an engine may close the loops in other poses.

    Yields:
        The cause, and the poses that guesses lead to; the right one where loops do not close from there.

    """
    turns = [
        (k, i) for k in range(model.n) for i, (what, _) in enumerate(model.kinds[k].motions) if what == "turn"
    ]
    for given in map(int, np.flatnonzero(model.body[: model.n, 0] < 0)):
        if len(model.kinds[given].motions) == 1:
            words = "closed on another branch at the same coordinate"
            cause = Cause("frame", "loops", "", f"{words} of joint {given + 1}")
            yield cause, [Edit(cause, _always(_branch(given, turn))) for turn in (None, *turns)]


def _branch(given: int, turn: tuple[int, int] | None) -> Change:
    """The pose to which loops close, joint ``given`` held, from half a turn more of one angle, or from −x."""

    def pose(model: Model, state: State) -> State:
        x = -state.x if turn is None else state.x.copy()
        if turn is not None:
            x[turn] += np.pi
        x[given] = state.x[given]
        movable = np.ones(rate_count(model.tree), bool)
        movable[own_rates(model)[given]] = False
        try:
            start = complete_state(model, replace(state, x=x))
            other = assembled(model, start, movable, is_pose_kept=True)
        except (ValueError, np.linalg.LinAlgError):
            return state
        return other if is_closed(model, other) else state

    return lambda case: with_fields(
        case, **vars(stack_states([pose(case.model, one) for one in single_states(case.state)]))
    )
