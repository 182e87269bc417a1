"""The fields of scenario files, their units and limits.

The descriptions here become the field reference (`docs/scenario-files.md`) and the JSON Schema.
SI units; world z up; a body's frame has its origin at the centre of mass.
"""

from __future__ import annotations

import math
import sys
import unicodedata
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

import numpy as np
from annotated_types import Len
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError

from plumbline.model.datatypes import FREE, JOINT_ELEMENTS, KINDS, Array, AxesKind, Float
from plumbline.model.kinematics import quaternion_product, rotation_matrix

SCHEMA_VERSION = 1
MAX_NAME_BYTES = 200  # of a scenario's name in UTF-8; file systems allow 255 for a name with its endings
VALID_NAME = (
    f"a name for files: printable, at most {MAX_NAME_BYTES} bytes, without / and \\, no dot at its start, no "
    "blank at its ends"
)
MAX_BODIES = 20_000
MAX_SAMPLES = 1_000_000
MIN_INERTIA = 1e-30  # kg, m or kg m²: engines divide by it, and squares of the quotient stay finite
INPUT_ROUNDING = 1e-12  # relative: rounding of sixteen typed digits; larger deviations are mistakes
ClosedForm = Literal[
    "rest",
    "planar-pendulum",
    "spherical-pendulum",
    "conical",
    "double-conical",
    "lagrange-top",
    "free-top",
    "small-double",
    "small-chain",
    "damped-oscillator",
]


def invalid_value_error(message: str, valid: str, default_conflicts_with: str = "") -> PydanticCustomError:
    """Make the validation error of a value.

    Args:
        message: what is wrong.
        valid: what would be valid, a noun phrase.
        default_conflicts_with: the field to name instead where the value is a default, so not in the file.

    Returns:
        The error, to be raised by a validator; `plumbline.scenario.validation_messages` reads it.

    """
    context = {"message": message, "valid": valid, "default_conflicts_with": default_conflicts_with}
    return PydanticCustomError("plumbline", "{message}", context)


def _require_printable(value: str | None) -> str | None:
    """Refuse control characters and code points that XML cannot hold; line breaks and tabs may stay."""
    for char in value or "":
        if unicodedata.category(char) in ("Cc", "Cs", "Cn") and char not in "\n\t":
            raise invalid_value_error(f"has the character U+{ord(char):04X}", "printable text")
    return value


def name_error(name: str) -> str:
    """Check that a scenario's name can name a file and be one part of a row's key.

    Args:
        name: any text.

    Returns:
        What is wrong with it, as the end of a sentence; "" where nothing is. `VALID_NAME` says what is valid.

    """
    for char in name:
        if char in "/\\" or not char.isprintable():
            return f"has the character {char if char.isprintable() else f'U+{ord(char):04X}'}"
    if not name or name != name.strip():
        return "has blanks at its ends" if name else "is empty"
    if name.startswith("."):
        return "starts with a dot"
    size = len(name.encode())
    return f"has {size} bytes" if size > MAX_NAME_BYTES else ""


def unit_vector(values: list[float]) -> Float[Array, "n"]:
    """Scale a vector to unit length without overflow or underflow.

    Args:
        values: numbers, not all zero.

    """
    vector = np.array(values, dtype=float)
    vector = vector / np.max(np.abs(vector))
    return np.asarray(vector / np.linalg.norm(vector))


def _require_nonzero(values: list[float] | None) -> list[float] | None:
    """Refuse the zero vector: it has no direction."""
    if values is not None and not any(values):
        raise invalid_value_error("is all zeros, which has no direction", "at least one number other than 0")
    if values is not None and max(map(abs, values)) < sys.float_info.min:
        message = f"is {values!r}, too short: doubles as small lose the digits of the direction"
        raise invalid_value_error(message, "a vector of any usual length; it is normalised")
    return values


def _require_invertible(value: float | list[float] | None) -> float | list[float] | None:
    """Refuse what is not 0 and so small that engines which divide by it overflow."""
    for number in value if isinstance(value, list) else [value]:
        if number is not None and 0 < number < MIN_INERTIA:
            raise invalid_value_error(f"is {number!r}, too small to divide by", f"at least {MIN_INERTIA:g}")
    return value


def _field(description: str, unit: str = "", default: Any = ..., **limits: Any) -> Any:
    """Declare a field; required unless it has a default."""
    return Field(
        default, description=description, json_schema_extra={"unit": unit} if unit else None, **limits
    )


def _optional(description: str, unit: str = "", **limits: Any) -> Any:
    """Declare a field that may be absent."""
    return _field(description, unit, None, **limits)


class SchemaModel(BaseModel):
    """Base of all parts of a scenario file: strict types, no unknown fields, no NaN or infinity."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        frozen=True,
        allow_inf_nan=False,
        # a run whose scenario files are unchanged validates none of them
        defer_build=True,
    )
    alternatives: ClassVar[tuple[str, ...]] = ()  # fields of which exactly one must be given
    omitted: ClassVar[tuple[str, ...]] = ()  # fields that are left out where they have their default

    @model_validator(mode="after")
    def _check_alternatives(self) -> Self:
        given = [name for name in self.alternatives if getattr(self, name) is not None]
        if self.alternatives and len(given) != 1:
            names = ", ".join(self.alternatives)
            what = "gives " + " and ".join(given) if given else f"gives none of {names}"
            raise invalid_value_error(what, f"exactly one of {names}")
        return self

    @model_serializer(mode="wrap")
    def _omit_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what is absent: a scenario's digest depends on its content alone."""
        data: dict[str, Any] = handler(self)
        fields = type(self).model_fields
        return {k: v for k, v in data.items() if k not in self.omitted or v != fields[k].default}


Vector = Annotated[list[float], Len(3, 3)]


class AxisAngle(SchemaModel):
    """A rotation about an axis fixed in the world, right-handed."""

    alternatives = ("angle", "degrees")
    axis: Vector = _field("The axis, world frame; any length but 0.", examples=[[0, 1, 0]])
    angle: float | None = _optional("The angle; or give `degrees`.", "rad")
    degrees: float | None = _optional("The angle; or give `angle`.", "°")

    _axis = field_validator("axis")(_require_nonzero)

    @property
    def radians(self) -> float:
        """The angle in rad."""
        return self.angle if self.angle is not None else math.radians(self.degrees or 0.0)

    def quaternion(self, multiple: float = 1.0) -> Float[Array, "4"]:
        """Return the unit quaternion of a multiple of the rotation.

        Args:
            multiple: factor of the angle.

        """
        half = 0.5 * multiple * self.radians
        return np.concatenate([[math.cos(half)], math.sin(half) * unit_vector(self.axis)])


class Euler(SchemaModel):
    """Three rotations about coordinate axes."""

    alternatives = ("angles", "degrees")
    convention: str = _field(
        "The order of the axes, and whether they turn with the body (`intrinsic`) or stay in the world "
        "(`extrinsic`): `intrinsic zxz` is Euler's own, `intrinsic zyx` is yaw-pitch-roll.",
        pattern="^(intrinsic|extrinsic) (xyx|xyz|xzx|xzy|yxy|yxz|yzx|yzy|zxy|zxz|zyx|zyz)$",
        examples=["intrinsic zxz"],
    )
    angles: Vector | None = _optional("The angles in the order of the axes; or give `degrees`.", "rad")
    degrees: Vector | None = _optional("The angles in the order of the axes; or give `angles`.", "°")


class Attitude(SchemaModel):
    """An attitude: exactly one of the three."""

    alternatives = ("quaternion", "axis_angle", "euler")
    quaternion: Annotated[list[float], Len(4, 4)] | None = _optional(
        "Quaternion (w, x, y, z), scalar first, body → world. Of any length but 0: it is normalised.",
        examples=[[0.5, 0.5, 0.5, 0.5]],
    )
    axis_angle: AxisAngle | None = _optional("A rotation from the world's axes about one axis.")
    euler: Euler | None = _optional("Three rotations with a named convention.")

    _quaternion = field_validator("quaternion")(_require_nonzero)


class Inertia(SchemaModel):
    """Inertia about the centre of mass, body frame: exactly one of principal, six, matrix."""

    alternatives = ("principal", "six", "matrix")
    principal: Vector | None = _optional("The three principal moments.", "kg m²")
    axes: Attitude | None = _optional(
        "With `principal`: the attitude of the principal axes in the body's frame (where `axis` and "
        "`extrinsic` mean the body's axes). Absent: along the body's axes."
    )
    six: Annotated[list[float], Len(6, 6)] | None = _optional(
        "xx, yy, zz, xy, xz, yz of the matrix; off the diagonal with the matrix's own sign, "
        "J_xy = −∫ x y dm.",
        "kg m²",
    )
    matrix: Annotated[list[Vector], Len(3, 3)] | None = _optional("The symmetric 3 × 3 matrix.", "kg m²")

    @field_validator("principal", "six", "matrix")
    @classmethod
    def _check_physical(cls, value: list[Any] | None) -> list[Any] | None:
        if value:
            matrix = _matrix_of(value)
            if np.any(np.abs(matrix - matrix.T) > INPUT_ROUNDING * np.max(np.abs(matrix))):
                raise invalid_value_error("is not symmetric", "a matrix that equals its transpose")
            _require_physical_inertia((matrix + matrix.T) / 2)
        return value

    @model_validator(mode="after")
    def _check_axes(self) -> Inertia:
        if self.axes is not None and self.principal is None:
            raise invalid_value_error("gives axes without principal", "axes beside principal only")
        return self


def _matrix_of(values: list[Any]) -> Array:
    """Build the matrix of its diagonal, of (xx, yy, zz, xy, xz, yz), or of its rows."""
    if len(values) == 6:
        xx, yy, zz, xy, xz, yz = values
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.array(values) if isinstance(values[0], list) else np.diag(values)


def _require_physical_inertia(matrix: Array) -> None:
    """Refuse principal moments that are negative or violate the triangle inequality.

    The sums J1 + J2 − J3 are twice the second moments of the mass, so none is negative.
    """
    values = np.linalg.eigvalsh(matrix)
    shown = ", ".join(f"{value:.6g}" for value in values)
    if values[0] < -INPUT_ROUNDING * abs(values[2]):
        message = f"has the principal moments {shown}, one of them negative"
        raise invalid_value_error(message, "three principal moments that are not negative")
    if values[0] + values[1] < values[2] * (1 - INPUT_ROUNDING):
        message = f"is not a physical inertia: its principal moments {shown} violate the triangle inequality"
        raise invalid_value_error(message, "principal moments of which none exceeds the sum of the other two")


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, (int, float)) and not isinstance(value, bool) else value


# one number per coordinate of a joint; a single number may stand without brackets
PerCoordinate = Annotated[list[float], BeforeValidator(_listed, json_schema_input_type=float | list[float])]


def _require_not_negative(values: list[float] | None) -> list[float] | None:
    for value in values or ():
        if value < 0:
            raise invalid_value_error(f"is {value!r}, below 0", "0 or more")
    return values


class JointElements(SchemaModel):
    """Passive elements of a joint."""

    omitted = JOINT_ELEMENTS
    kind: str
    armature: PerCoordinate | None = _optional(
        "Inertia a of rotors that turn with the rate φ̇ of the joint's coordinate, ½ a φ̇² (kg m², or kg of a "
        "slide). One number, or a list of one per coordinate of the joint. Absent: 0.",
        examples=[0.01],
    )
    damping: PerCoordinate | None = _optional(
        "Coefficient c of a damper, −c φ̇ (N m s, or N s/m of a slide). As many numbers. Absent: 0."
    )
    stiffness: PerCoordinate | None = _optional(
        "Stiffness k of a spring, −k (φ − φ₀) (N m, or N/m of a slide); angles count on beyond π. As many "
        "numbers. Absent: 0."
    )

    _not_negative = field_validator("armature", "damping", "stiffness")(_require_not_negative)
    _invertible = field_validator("armature")(_require_invertible)

    @field_validator("armature", "damping", "stiffness", "rest", "effort", check_fields=False)
    @classmethod
    def _check_element(cls, value: list[float] | None, info: ValidationInfo) -> list[float] | None:
        kind = info.data.get("kind")
        if value is None or kind is None:
            return value
        count = KINDS[kind].element_count
        if not count:
            raise invalid_value_error(f"is given for a {kind} joint, which does not move", "nothing")
        if len(value) != count:
            given = f"has {len(value)} {'number' if len(value) == 1 else 'numbers'}"
            raise invalid_value_error(given, f"{count} for a {kind} joint")
        return value


class Ball(JointElements):
    """A ball joint: the body's proximal point stays where it hangs.

    Its passive elements are the same about every axis; φ is the rotation vector of the body in its parent.
    """

    kind: Literal["ball"] = _field("`ball`.")


class Rod(SchemaModel):
    """A massless rigid rod with a ball joint at both ends (the notes' own joint)."""

    kind: Literal["rod"] = _field("`rod`.")
    length: float = Field(
        description="Length, greater than 0.", json_schema_extra={"unit": "m", "exclusiveMinimum": 0}
    )
    direction: Vector = _field(
        "From where the rod hangs to the body's proximal point, world frame, at t = 0. Of any length but 0: "
        "it is normalised.",
        examples=[[0, 0.6, -0.8]],
    )
    rate: Vector | None = _optional(
        "Rate of change of the (unit) direction at t = 0, world frame, perpendicular to it. Or give "
        "`angular_velocity`; absent: 0.",
        "1/s",
    )
    angular_velocity: Vector | None = _optional(
        "Angular velocity w of the rod at t = 0, world frame: the rate is w × direction, so the part along "
        "the rod has no effect. Or give `rate`.",
        "rad/s",
    )

    @field_validator("length")
    @classmethod
    def _length(cls, value: float) -> float:
        if value == 0:
            valid = "{kind: ball}, or a length above 0"
            raise invalid_value_error("is 0: a rod without length is a ball joint", valid)
        if value < 0:
            raise invalid_value_error(f"is {value!r}, below 0", "a length above 0")
        return value

    _direction = field_validator("direction")(_require_nonzero)

    @field_validator("rate")
    @classmethod
    def _rate(cls, value: list[float] | None, info: ValidationInfo) -> list[float] | None:
        if value and any(value) and "direction" in info.data:
            along = float(unit_vector(value) @ unit_vector(info.data["direction"]))
            if abs(along) > INPUT_ROUNDING:
                raise invalid_value_error(
                    f"has a part along the direction, {along:.3g} of its length",
                    "a rate perpendicular to the direction, or `angular_velocity` instead",
                )
        return value

    @model_validator(mode="after")
    def _check_rates(self) -> Rod:
        if self.rate is not None and self.angular_velocity is not None:
            raise invalid_value_error("gives rate and angular_velocity", "one of them")
        return self


class Articulated(JointElements):
    """A joint with axes in both bodies.

    Its axes x, y, z are fixed in the parent by `frame` and in the body by `body_frame`; at coordinates 0 both
    coincide.  A second motion is about or along the axes as the first has left them.
    """

    kind: AxesKind = _field(
        "; ".join(f"`{kind}`: {KINDS[kind].description}" for kind in get_args(AxesKind)) + "."
    )
    axis: Vector | None = _optional(
        "z of the joint's axes in the parent's frame, parallel to the body's at coordinates 0. Of any length "
        "but 0. Or give `frame`; not for a universal joint or a weld.",
        examples=[[0, 1, 0]],
    )
    pitch: float | None = _optional(
        "How far the body moves along z per angle that it turns; negative: a left-hand screw. Of a helical "
        "joint, and needed there. Not 0.",
        "m/rad",
        examples=[0.02],
    )
    frame: Attitude | None = _optional(
        "Attitude of the joint's axes in the parent's frame. Absent: parallel."
    )
    body_frame: Attitude | None = _optional(
        "Attitude of the joint's axes in the body's frame. Absent: as in the parent's."
    )
    coordinates: list[float] | None = _optional(
        "At t = 0, in the order of the motions: angles [rad] of turns, shifts [m] of slides. Absent: 0."
    )
    rates: list[float] | None = _optional(
        "Their rates at t = 0 [rad/s, m/s]. Absent: 0, in a loop what the rates that are given require."
    )
    rest: PerCoordinate | None = _optional(
        "Coordinates φ₀ at which the springs are unloaded [rad, m]. With `stiffness` only. Absent: 0."
    )
    effort: PerCoordinate | None = _optional(
        "Constant torques [N m] or forces [N] along the coordinates on this body, the opposite on its parent."
        " Absent: 0."
    )

    _axis = field_validator("axis")(_require_nonzero)

    @field_validator("coordinates", "rates")
    @classmethod
    def _check_count(cls, value: list[float] | None, info: ValidationInfo) -> list[float] | None:
        kind = info.data.get("kind")
        if value is not None and kind is not None and len(value) != (count := len(KINDS[kind].motions)):
            raise invalid_value_error(f"has {len(value)} numbers", f"{count} for a {kind} joint")
        return value

    @model_validator(mode="after")
    def _check_fields(self) -> Articulated:
        if self.axis is not None and (self.frame is not None or self.body_frame is not None):
            raise invalid_value_error("gives axis and a frame", "one of them")
        if self.axis is not None and not KINDS[self.kind].is_about_z:
            raise invalid_value_error(f"gives an axis to a {self.kind} joint", "`frame` and `body_frame`")
        if (self.pitch is not None) != KINDS[self.kind].has_pitch:
            given = "no pitch" if self.pitch is None else "a pitch"
            valid = "a pitch where the joint is helical, and only there"
            raise invalid_value_error(f"gives {given} to a {self.kind} joint", valid)
        if self.pitch == 0:
            raise invalid_value_error("gives a pitch of 0", "another pitch, or a hinge")
        if self.rest is not None and self.stiffness is None:
            raise invalid_value_error("gives rest without stiffness", "both, or neither")
        return self


class Free(SchemaModel):
    """No joint: the body moves freely in the world."""

    kind: Literal["free"] = _field("`free`.")
    position: Vector = _field("Of the body's proximal point at t = 0, world frame.", "m", [0.0] * 3)
    velocity: Vector = _field("Of the body's centre of mass at t = 0, world frame.", "m/s", [0.0] * 3)


class Load(SchemaModel):
    """Constant loads on a body."""

    force: Vector = _field("Force at the centre of mass, constant in the world frame.", "N", [0.0] * 3)
    moment: Vector = _field(
        "Moment, constant in the body's frame (the notes' n′): it turns with the body.", "N m", [0.0] * 3
    )


class Drag(SchemaModel):
    """Linear drag on a body."""

    force: float = _field("c_t ≥ 0: the force −c_t ṙ at the centre of mass.", "N s/m", 0.0, ge=0)
    moment: float = _field("c_r ≥ 0: the moment −c_r ω′.", "N m s", 0.0, ge=0)


class Body(SchemaModel):
    """One rigid body; it hangs from its parent: the body before it, or another one, or the world."""

    omitted = ("parent", "anchor")
    name: str | None = _optional(
        "A name that no other body has, except copies by `repeat`; absent: its place in the chain.",
        max_length=80,
        examples=["bob"],
    )
    mass: float = _field("Mass, greater than 0.", "kg", gt=0)
    inertia: Inertia = _field("Inertia about the centre of mass, body frame.")
    joint: Annotated[Ball | Rod | Articulated | Free, Discriminator("kind")] = _field("How the body hangs.")
    parent: str | None = _optional(
        "The name of the body that this one hangs from, above it in the file, or `world`. Absent: the body "
        "before it, for the first the world. The bodies of a branch follow each other."
    )
    anchor: Vector | None = _optional(
        "The point of the parent from which this body hangs, in the parent's frame. Absent: the parent's "
        "`distal`, the origin of the world.",
        "m",
    )
    proximal: Vector = _field(
        "The point of this body by which it hangs, body frame (the notes' s_1, s_3).", "m"
    )
    distal: Vector | None = _optional(
        "The point of this body from which the next one hangs, body frame (the notes' s_2). Needed where a "
        "body follows that has no `anchor`.",
        "m",
    )
    attitude: Attitude | None = _optional(
        "Attitude at t = 0, body → world. Required on rods and balls and for free bodies; on other joints it "
        "follows from the joint's coordinates.",
        validate_default=True,
    )
    angular_velocity: Vector = _field(
        "Angular velocity at t = 0, body frame (the notes' ω′).", "rad/s", [0.0] * 3
    )
    load: Load = Field(default_factory=Load, description="Constant force and moment on this body.")
    drag: Drag = Field(default_factory=Drag, description="Linear drag on this body.")

    _name = field_validator("name")(_require_printable)

    _invertible = field_validator("mass")(_require_invertible)

    @field_validator("attitude")
    @classmethod
    def _check_attitude(cls, value: Attitude | None, info: ValidationInfo) -> Attitude | None:
        joint = info.data.get("joint")
        if joint is not None and (value is None) == KINDS[joint.kind].has_attitude:
            if value is None:
                raise invalid_value_error("is missing", "the attitude at t = 0, body → world")
            raise invalid_value_error(f"is given for a body on a {joint.kind}", "`coordinates` of the joint")
        return value

    @field_validator("angular_velocity")
    @classmethod
    def _check_angular_velocity(cls, value: list[float], info: ValidationInfo) -> list[float]:
        joint = info.data.get("joint")
        if any(value) and joint is not None and not KINDS[joint.kind].has_attitude:
            raise invalid_value_error(f"is given for a body on a {joint.kind}", "`rates` of the joint")
        return value

    @field_validator("parent")
    @classmethod
    def _check_parent(cls, value: str | None, info: ValidationInfo) -> str | None:
        joint = info.data.get("joint")
        if joint is not None and joint.kind == FREE and value not in (None, "world"):
            raise invalid_value_error("is given for a free body", "no parent, or `world`")
        return value


class BodySequence(SchemaModel):
    """Repeated bodies: body j = 0, 1, 2 … of them copies the bodies of `cycle` in turn.

    With `turn`, body j and its rod (direction and rate) are turned together by j times that
    rotation about its axis in the world; the angular velocity, being in the body's frame, goes along.
    """

    repeat: int = _field("Number of bodies.", ge=1, le=MAX_BODIES)
    cycle: list[Body] = _field(
        "The bodies that are copied, one after the other; none has a `parent`.", min_length=1
    )
    turn: AxisAngle | None = _optional("The rotation that body j is turned by, j times. Absent: none.")

    @field_validator("cycle")
    @classmethod
    def _check_cycle(cls, value: list[Body]) -> list[Body]:
        if any(body.parent is not None or not (6 > len(KINDS[body.joint.kind].rows) > 0) for body in value):
            raise invalid_value_error(
                "has a parent, a weld or a free body", "bodies whose parent is the one before"
            )
        return value

    @model_validator(mode="after")
    def _check_turn(self) -> BodySequence:
        if self.turn is not None and any(isinstance(body.joint, Articulated) for body in self.cycle):
            raise invalid_value_error("turns joints with axes", "turn with rods and ball joints only")
        return self


def _item_tag(value: Any) -> str:
    repeats = isinstance(value, BodySequence) or (
        isinstance(value, dict) and ("repeat" in value or "cycle" in value)
    )
    return "sequence" if repeats else "body"


ChainItem = Annotated[
    Annotated[Body, Tag("body")] | Annotated[BodySequence, Tag("sequence")], Discriminator(_item_tag)
]


class Spring(SchemaModel):
    """A spring and damper between two points, of two bodies or of a body and the world.

    It pulls with the tension k (l − l₀) + c l̇ at the distance l.
    """

    bodies: Annotated[list[str], Len(2, 2)] = _field(
        "The names of its two bodies; `world` for a point of the world.", examples=[["world", "bob"]]
    )
    points: Annotated[list[Vector], Len(2, 2)] = _field("A point of each, in the frame of its body.", "m")
    stiffness: float = _field("k ≥ 0.", "N/m", 0.0, ge=0)
    damping: float = _field("c ≥ 0.", "N s/m", 0.0, ge=0)
    length: float = _field("l₀ ≥ 0: the distance at which the spring is unloaded.", "m", 0.0, ge=0)


class ClosingRod(SchemaModel):
    """A massless rigid rod between two points that are there already."""

    kind: Literal["rod"] = _field("`rod`.")
    length: float = _field("Length, greater than 0.", "m", gt=0)


class ClosingJoint(SchemaModel):
    """A joint that closes a loop, between two bodies of the tree or a body and the world.

    It must fit the state at t = 0: within 1e-9 (m, rad) the points and axes that it joins coincide, and the
    rates that are given agree with it to 1e-9.  Its own coordinates follow.
    """

    body: str = _field("The name of its body.", examples=["rocker"])
    parent: str = _field("The name of the other body, or `world`.", default="world")
    joint: Annotated[Ball | ClosingRod | Articulated, Discriminator("kind")] = _field(
        "As for a body, without `coordinates`, `rates`, `direction` and `rate`."
    )
    anchor: Vector = _field("Its point of the parent, in the parent's frame.", "m", [0.0, 0.0, 0.0])
    proximal: Vector = _field("Its point of the body, body frame.", "m")

    @field_validator("joint")
    @classmethod
    def _check_joint(cls, value: Any) -> Any:
        for name in ("coordinates", "rates"):
            if getattr(value, name, None) is not None:
                raise invalid_value_error(f"gives {name}, which follow from the bodies", f"no {name}")
        return value


class Document(SchemaModel):
    """A scenario file: chains, trees and loops of rigid bodies, their initial state, their loads."""

    omitted = ("level", "springs", "closes", "seed")
    schema_version: Literal[1] = _field("Version of this format: 1.")
    name: str | None = _optional(
        "The name in results and of the files made for it, so without `/` and `\\` and no dot at its start; "
        "absent: the file's name.",
        min_length=1,
        max_length=80,
    )
    family: str = _field(
        "Group in reports and for `--family`.",
        default="own",
        min_length=1,
        max_length=40,
        examples=["double"],
    )
    title: str = _field("One line that describes the scenario.", min_length=1, max_length=200)
    purpose: str = _field(
        "Which mistakes this scenario reveals, in a sentence.", min_length=1, max_length=1000
    )
    exact: ClosedForm | None = _optional(
        "The closed-form solution that this scenario has, if any. `small-double` and `small-chain` are "
        "asymptotic: their error shrinks with the square of the amplitude."
    )
    duration: float = _field(
        "Length of the motion that is compared; a whole number of samples.", "s", 2.0, gt=0
    )
    sample: float = _field(
        "Time between compared samples. A binary fraction (1/32 = 0.03125) lets every step 1/2^k hit the "
        "samples exactly.",
        "s",
        0.03125,
        gt=0,
        validate_default=True,
    )
    level: Literal["state", "all"] = _field(
        "What is compared: `all` levels, or only quantities at the initial and nine random states (`state`).",
        default="all",
    )
    gravity: Vector = _field("Acceleration of gravity, world frame.", "m/s²", [0.0, 0.0, -9.81])
    bodies: list[ChainItem] = _field(
        "Bodies, single or repeated, each after its parent.", min_length=1, max_length=MAX_BODIES
    )

    springs: list[Spring] = _field("Springs and dampers between points.", default=[])
    closes: list[ClosingJoint] = _field("Joints that close loops.", default=[])
    seed: str | None = _optional(
        "Words that the random states are drawn from. Absent: the digest of the file's content, texts "
        "included; the digest of before keeps the states where only a text changes.",
        min_length=1,
        max_length=80,
    )

    _text = field_validator("family", "title", "purpose", "seed")(_require_printable)

    @field_validator("name")
    @classmethod
    def _check_name(cls, value: str | None) -> str | None:
        if value is not None and (wrong := name_error(value)):
            raise invalid_value_error(wrong, VALID_NAME)
        return value

    @field_validator("family", "title", "seed")
    @classmethod
    def _one_line(cls, value: str | None) -> str | None:
        if value and (value != value.strip() or "\n" in value or "\t" in value):
            raise invalid_value_error("has line breaks, tabs, or blanks at its ends", "one line of text")
        return value

    @field_validator("sample")
    @classmethod
    def _sample(cls, value: float, info: ValidationInfo) -> float:
        duration = info.data.get("duration", value)
        count = duration / value
        message = f"{duration:g} s is {count:.9g} samples of {value:g} s"
        if count > MAX_SAMPLES:
            raise invalid_value_error(message, f"at most {MAX_SAMPLES} samples", "duration")
        if abs(count - round(count)) > 1e-9 * count or round(count) < 1:
            valid = "a duration that is a whole number of samples"
            raise invalid_value_error(message, valid, "duration")
        return value


def attitude_quaternion(attitude: Attitude) -> Float[Array, "4"]:
    """Return the unit quaternion of an attitude, in whichever form the file gives it.

    Returns:
        Scalar first, body → world, unit to rounding.

    """
    if attitude.quaternion is not None:
        return unit_vector(attitude.quaternion)
    if attitude.axis_angle is not None:
        return unit_vector(attitude.axis_angle.quaternion().tolist())
    assert attitude.euler is not None  # the model has exactly one
    return _euler_quaternion(attitude.euler)


def _euler_quaternion(euler: Euler) -> Array:
    """Return the quaternion (4,); intrinsic abc: q_a q_b q_c, extrinsic: factors in reverse order."""
    order, axes = euler.convention.split()
    angles = euler.angles if euler.angles is not None else [math.radians(a) for a in euler.degrees or ()]
    factors = [
        np.array([math.cos(a / 2), *(math.sin(a / 2) * (axis == c) for c in "xyz")])
        for axis, a in zip(axes, angles, strict=True)
    ]
    if order == "extrinsic":
        factors.reverse()
    return unit_vector(quaternion_product(quaternion_product(factors[0], factors[1]), factors[2]).tolist())


def inertia_matrix(inertia: Inertia) -> Float[Array, "3 3"]:
    """Return the inertia matrix, in whichever form the file gives it.

    Returns:
        About the centre of mass, body frame, exactly symmetric [kg m²].

    """
    matrix = _matrix_of(inertia.principal or inertia.six or inertia.matrix or [])
    if inertia.axes is not None:
        axes = rotation_matrix(attitude_quaternion(inertia.axes))
        matrix = axes @ matrix @ axes.T
    return np.asarray((matrix + matrix.T) / 2)
