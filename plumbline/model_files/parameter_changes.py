"""Parameters in which two descriptions of a model file differ: found, made in a model, and put into words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from plumbline.importers.neutral_model import ElementaryJoint, NeutralBody, NeutralModel, Source
from plumbline.model.datatypes import Array
from plumbline.model.grouping import grouped
from plumbline.model.kinematics import rotation_matrix
from plumbline.scenario.line_and_column_errors import first_words

RELATIVE_CHANGE = 1e-11  # differences of descriptions below this are rounding
JOINT_FIELDS = ("axis", "anchor", "reference", "armature", "damping", "stiffness", "spring_reference")
BODY_FIELDS = ("position", "attitude", "mass", "center", "inertia")
LENGTHS = ("position", "center", "anchor")  # whose rounding is that of the largest length
OMITTED_FIELDS = ("damping", "stiffness", "armature", "spring_reference")  # may be held and not applied
DEFAULT_INERTIAL = "default inertial"  # 1 kg and 1 kg m² for each body without mass
ASSUMED_INERTIAL = "assumed inertial"  # other values for bodies without <inertial>, as from geometry
FRAME = "frame"
SLIDE_SCALE = "displacement"  # of a slide, in the poses alone: its coordinate times a number
ORIGIN = "origin"  # from which a free body's coordinates count
MISSING = "missing body"
ADDITIONAL = "additional body"
ARMATURE_ENERGY = "armature in the kinetic energy"
TURNED_ARMATURE = "armature in body axes"  # of a free joint, on rates of change in the axes of its body
NOT_IN_THE_MODEL = (
    ARMATURE_ENERGY,
    FRAME,
    SLIDE_SCALE,
    ORIGIN,
    TURNED_ARMATURE,
)  # change quantities, not the equations
FIELD_WORDS = {
    "center": "centre of mass", "spring_reference": "spring reference", "position": "position in its parent",
    "attitude": "attitude in its parent", "reference": "reference coordinate", "joints": "joints",
}  # fmt: skip
SHOWN_NAMES, SHOWN_PLACES = 4, 6  # of several


@dataclass(frozen=True, eq=False)
class Change:
    """One parameter that differs."""

    field: str
    body: str  # empty: the whole model
    joint: str  # empty: the body
    own: Any  # as the file says
    theirs: Any  # as the importer reads it
    source: Source
    also: Mapping[str, Any] | None = None  # what changes with it in the body that carries it
    carrier: str = ""  # the body that this one is fixed to, where it is not the body itself
    is_omitted: bool = False  # the importer's description has the file's value, its dynamics leave it out

    @property
    def word(self) -> str:
        """The parameter, in words."""
        return FIELD_WORDS.get(self.field, self.field)

    @property
    def said(self) -> str:
        """What the file says."""
        return format_value(self.own, self.theirs)

    @property
    def read(self) -> str:
        """What the importer reads."""
        return format_value(self.theirs, self.own)

    @property
    def owner(self) -> str:
        """What the parameter belongs to, in words."""
        if self.joint:
            return f"joint {self.joint}"
        return f"body {self.body}" if self.body else "the model"


def change_of(
    field: str,
    body: NeutralBody,
    joint: ElementaryJoint | None,
    own: Any,
    theirs: Any,
    said: str = "",
    **more: Any,
) -> Change:
    """Make a change with the place where the file says the parameter.

    Args:
        field: the parameter.
        joint: of the body; None: the parameter is the body's.
        own: as the file says.
        theirs: as the importer reads it.
        said: the field whose place is meant, where it is another one.
        **more: other fields of the change.

    """
    owner = joint or body
    source = owner.fields.get(said or field, owner.source)
    return Change(field, body.name, joint.name if joint else "", own, theirs, source, **more)


def differences(
    own: NeutralModel, theirs: NeutralModel, least: float = RELATIVE_CHANGE, has_rest_poses: bool = False
) -> list[Change]:
    """List the parameters in which two descriptions differ by more than rounding.

    Args:
        own: the neutral model, fixed bodies lumped.
        theirs: an importer's description, fixed bodies lumped.
        least: relative difference from which on two numbers differ.
        has_rest_poses: whether poses of free bodies count, which are coordinates of their joints.

    Returns:
        The changes that turn the first into the second; the structure of bodies and joints first.

    """
    named = {body.name: body for body in theirs.bodies}
    size = max((float(np.linalg.norm(body.position)) for body in own.bodies), default=0.0)
    parents = [parent_names(model) for model in (own, theirs)]
    own_names = {body.name for body in own.bodies}
    extra = [body for body in theirs.bodies if body.name not in own_names]
    found = [Change(ADDITIONAL, body.name, "", None, body, Source("", 0)) for body in extra]
    if differs(own.gravity, theirs.gravity, 0.0, least):
        found.append(Change("gravity", "", "", own.gravity, theirs.gravity, own.gravity_source))
    for body in own.bodies:
        other = named.get(body.name)
        if other is None:
            continue
        above = [names[body.name] for names in parents]
        if above[0] != above[1]:
            found.append(Change("parent", body.name, "", above[0], above[1], body.source))
        for joint, read in zip(body.joints, other.joints, strict=True):
            unsprung = ("spring_reference",) if joint.stiffness == 0 == read.stiffness else ()
            found += _field_changes(JOINT_FIELDS, body, joint, read, size, least, unsprung)
        is_free = bool(body.joints) and body.joints[0].kind == "free"
        # a free joint's coordinates are those of the body frame
        skipped: tuple[str, ...] = ("position", "attitude") if is_free and not has_rest_poses else ()
        skipped += ("center",) if body.mass == 0 == other.mass else ()
        found += _field_changes(BODY_FIELDS, body, None, other, size, least, skipped)
    return found


def _field_changes(
    fields: Sequence[str],
    body: NeutralBody,
    joint: ElementaryJoint | None,
    read: NeutralBody | ElementaryJoint,
    size: float,
    least: float,
    skipped: Sequence[str],
) -> Iterator[Change]:
    """Differences of one body, or of one of its joints, from what was read."""
    for field in fields:
        values = getattr(joint or body, field), getattr(read, field)
        views = values
        if field == "attitude":
            views = rotation_matrix(values[0]), rotation_matrix(values[1])
        elif field == "anchor":
            views = _across(joint), _across(read)
        if field not in skipped and differs(*views, size if field in LENGTHS else 0.0, least):
            yield change_of(field, body, joint, *values)


def _across(joint: Any) -> Array:
    """The anchor without its part along a hinge's axis, which moves nothing."""
    if joint.kind != "hinge":
        return np.asarray(joint.anchor, float)
    return np.asarray(joint.anchor - joint.axis * float(joint.axis @ joint.anchor), float)


def differs(own: Any, theirs: Any, scale: float = 0.0, least: float = RELATIVE_CHANGE) -> bool:
    """Whether numbers differ by more than a share of the largest of them, and of a scale."""
    a, b = np.asarray(own, float), np.asarray(theirs, float)
    size = max(float(np.max(np.abs(a))), float(np.max(np.abs(b))), scale)
    return bool(np.max(np.abs(a - b)) > least * size)


def parent_names(model: NeutralModel) -> dict[str, str]:
    """Name the parent of each body."""
    return {b.name: model.bodies[b.parent].name if b.parent >= 0 else "world" for b in model.bodies}


def joint_kinds(joints: Sequence[ElementaryJoint]) -> list[tuple[str, str]]:
    """List name and kind of joints."""
    return [(joint.name, joint.kind) for joint in joints]


def omissions(model: NeutralModel) -> list[list[Change]]:
    """List terms of a model that an engine's dynamics may leave out or turn, per field all joints together.

    Args:
        model: a model, fixed bodies lumped.

    Returns:
        Groups of changes that set the field to zero.

    """
    joints = [(body, joint) for body in model.bodies for joint in body.joints]
    groups = [
        [
            change_of(field, body, joint, value, 0.0, is_omitted=True)
            for body, joint in joints
            if (value := getattr(joint, field))
        ]
        for field in OMITTED_FIELDS
    ]
    groups.append([
        change_of(TURNED_ARMATURE, body, joint, 0.0, joint.armature, "armature", is_omitted=True)
        for body, joint in joints
        if joint.kind == "free" and joint.armature
    ])  # fmt: skip
    if np.any(model.gravity):
        gravity = model.gravity, np.zeros(3), model.gravity_source
        groups.append([Change("gravity", "", "", *gravity, is_omitted=True)])
    return [group for group in groups if group]


def energy_omissions(model: NeutralModel) -> list[list[Change]]:
    """List armatures that a kinetic energy may leave out, by joints along coordinate axes and alone or not.

    Args:
        model: a model, fixed bodies lumped.

    Returns:
        Groups of changes, a change per joint with an armature.

    """
    rotors = [(body, joint) for body in model.bodies for joint in body.joints if joint.armature]
    # engines have own joint types for the coordinate axes
    groups = grouped(rotors, lambda pair: (bool(np.max(pair[1].axis) == 1), len(pair[0].joints) > 1))
    return [
        [
            change_of(ARMATURE_ENERGY, body, joint, joint.armature, 0.0, "armature", is_omitted=True)
            for body, joint in group
        ]
        for group in groups.values()
    ]


def apply_changes(own: NeutralModel, theirs: NeutralModel, changes: Sequence[Change]) -> NeutralModel:
    """Make changes in a model.

    Args:
        own: the neutral model, fixed bodies lumped.
        theirs: the importer's description, from which additional bodies are taken.
        changes: of `differences` and `omissions`.

    """
    bodies = {body.name: body for body in own.bodies}
    parents = parent_names(own) | {
        c.body: parent_names(theirs)[c.body] for c in changes if c.field == ADDITIONAL
    }
    gravity = own.gravity
    for change in changes:
        if change.field in NOT_IN_THE_MODEL:
            continue
        if change.field == "gravity":
            gravity = change.theirs
        elif change.field == ADDITIONAL:
            bodies[change.body] = change.theirs
        elif change.field == "parent":
            parents[change.body] = change.theirs
        elif change.joint:
            body = bodies[change.body]
            joints = tuple(
                replace(joint, **{change.field: change.theirs}) if joint.name == change.joint else joint
                for joint in body.joints
            )
            bodies[change.body] = replace(body, joints=joints)
        else:
            name = change.carrier or change.body
            bodies[name] = replace(bodies[name], **(change.also or {change.field: change.theirs}))
    return replace(own, bodies=_ordered(bodies, parents), gravity=gravity)


def _ordered(bodies: Mapping[str, NeutralBody], parents: Mapping[str, str]) -> tuple[NeutralBody, ...]:
    """Bodies with the indices of their parents, parents first; without a parent: on the world."""
    placed: dict[str, int] = {}
    found: list[NeutralBody] = []
    waiting = list(bodies.values())
    while waiting:
        ready = [b for b in waiting if parents[b.name] in placed or parents[b.name] not in bodies]
        for body in ready or waiting[:1]:
            placed[body.name] = len(found)
            found.append(replace(body, parent=placed.get(parents[body.name], -1)))
        done = {body.name for body in found}
        waiting = [body for body in waiting if body.name not in done]
    return tuple(found)


def describe_difference(own: NeutralModel, theirs: NeutralModel) -> str:
    """Describe the first parameter in which two readings of equivalent files differ.

    Args:
        theirs: of the rewritten file, with the names of the first.

    Returns:
        A clause; empty where they differ by rounding only.

    """
    named = {body.name: body for body in theirs.bodies}
    for body in own.bodies:
        if body.name not in named:
            return f"there is no body {body.name}"
        kinds = [_joint_words(b.joints) for b in (named[body.name], body)]
        if kinds[0] != kinds[1]:
            return f"the joints of body {body.name} are {kinds[0]}, as written {kinds[1]}"
    changes = differences(own, theirs, has_rest_poses=True)
    if not changes:
        return ""
    first = changes[0]
    if first.field == ADDITIONAL:
        return f"there is another body, {first.body}"
    more = f" ({len(changes)} parameters differ)" if len(changes) > 1 else ""
    return f"the {first.word} of {first.owner} is {first.read}, as written {first.said}{more}"


def describe_changes(members: Sequence[Change]) -> str:
    """Say what an importer does to one field, as a verb phrase."""
    first, count = members[0], len(members)
    names = first_words([change.joint or change.body for change in members], SHOWN_NAMES)
    places = [f"{change.body} ({change.source})" for change in members]
    kind = "joints" if first.joint else "bodies"
    owners = first.owner if count == 1 else f"{count} {kind} ({names})"
    if first.field == FRAME:
        return (
            f"puts the frame of {count} bodies ({names}) elsewhere in the body, that of {first.body} at "
            f"{format_value(first.theirs[:, 3], np.zeros(3))} ({first.source}), which moves no mass"
        )
    if first.field == ORIGIN:
        return (
            f"counts the coordinates of the free joint of body {first.body} from {first.read} and not "
            f"from the world's origin ({first.source}), so that all its bodies are displaced"
        )
    if first.field == SLIDE_SCALE:
        slides = f"slide {first.joint}" if count == 1 else f"{count} slides ({names})"
        return (
            f"multiplies the coordinate of {slides} by the length of its axis where it places bodies, "
            f"that of {first.joint} by {first.read} ({first.source}), but not in its equations"
        )
    if first.field == DEFAULT_INERTIAL:
        bodies = first_words(places, SHOWN_PLACES, "", "; ")
        return f"gives 1 kg and an inertia of 1 kg m² to bodies without mass: {bodies}"
    if first.field == ASSUMED_INERTIAL:
        mass = sum(change.theirs for change in members)
        bodies = first_words(places, SHOWN_PLACES, "", "; ")
        return f"gives {mass:.6g} kg in all to bodies without <inertial>: {bodies}"
    if first.field == MISSING:
        what = "the body" if count == 1 else f"{count} bodies with their joints and masses:"
        return f"leaves out {what} {first_words(places, SHOWN_PLACES)}"
    if first.field == ADDITIONAL:
        bodies = first_words([change.body for change in members], SHOWN_PLACES, "")
        return f"adds {'body' if count == 1 else 'bodies'} {bodies}"
    if first.field == "inertial":
        parts = [f"{change.body} ({change.own:.4g} kg, {change.source})" for change in members]
        what = "mass and inertia" if first.own else "inertia"
        where = "" if first.body == first.carrier else f", fixed to body {first.carrier}"
        return f"leaves out the {what} of {first_words(parts, SHOWN_PLACES, '')}{where}"
    if first.field == "joints":
        return "; ".join(
            f"reads the joints of body {c.body} as {_joint_words(c.theirs)}; "
            f"the file says {_joint_words(c.own)} ({c.source})"
            for c in members[:3]
        )
    if first.field == ARMATURE_ENERGY:
        return f"leaves the armature of {owners} out of its kinetic energy ({first.source})"
    if first.field == TURNED_ARMATURE:
        return f"applies the armature of {owners} in the axes of the body, not of the world ({first.source})"
    if first.is_omitted:
        return f"holds the {first.word} of {owners} but leaves it out of its equations ({first.source})"
    if count == 1:
        return (
            f"reads the {first.word} of {owners} as {first.read}; the file says {first.said} ({first.source})"
        )
    values = {change.read for change in members}
    as_ = f"as {values.pop()}" if len(values) == 1 else "otherwise"
    return (
        f"reads the {first.word} of {count} {kind} {as_} ({names}); "
        f"of {first.owner} the file says {first.said} ({first.source}), it reads {first.read}"
    )


def _joint_words(joints: Sequence[ElementaryJoint]) -> str:
    return ", ".join(f"{joint.kind} {joint.name}" for joint in joints) or "none (fixed)"


def format_value(value: Any, other: Any) -> str:
    """Write a value with as many digits as it needs to differ from another one.

    Args:
        value: a number, an array or a text.
        other: the value that it is compared with.

    """
    if isinstance(value, str):
        return value
    a, b = np.asarray(value, float), np.asarray(other, float)
    for digits in (4, 7, 10, 13, 17):
        if a.shape != b.shape or _text(a, digits) != _text(b, digits):
            break
    return _text(a, digits)


def _text(a: Array, digits: int) -> str:
    if a.ndim == 0:
        return f"{float(a) + 0.0:.{digits}g}"  # no negative zero
    return "(" + ", ".join(_text(part, digits) for part in a) + ")"
