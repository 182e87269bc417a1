"""The fields of scenario files, their units and limits.

The descriptions here become the field reference (`docs/scenario-files.md`) and the JSON Schema.
SI units; world z up; a body's frame has its origin at the centre of mass.
"""

from __future__ import annotations

import math
import unicodedata
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Len
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from plumbline.model.datatypes import Array
from plumbline.model.kinematics import quaternion_product, rotation_matrix

SCHEMA_VERSION = 1
MAX_BODIES = 20_000
MAX_SAMPLES = 1_000_000
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


def _require_printable(value: str) -> str:
    """Refuse control characters and code points that XML cannot hold; line breaks and tabs may stay."""
    for char in value:
        if unicodedata.category(char) in ("Cc", "Cs", "Cn") and char not in "\n\t":
            raise invalid_value_error(f"has the character U+{ord(char):04X}", "printable text")
    return value


def unit_vector(values: list[float]) -> Array:
    """Scale a vector to unit length without overflow or underflow.

    Args:
        values: numbers, not all zero.

    Returns:
        The unit vector.

    """
    vector = np.array(values, dtype=float)
    vector = vector / np.max(np.abs(vector))
    return np.asarray(vector / np.linalg.norm(vector))


def _require_nonzero(values: list[float]) -> list[float]:
    """Refuse the zero vector: it has no direction."""
    if not any(values):
        raise invalid_value_error("is all zeros, which has no direction", "at least one number other than 0")
    return values


class SchemaModel(BaseModel):
    """Base of all parts of a scenario file: strict types, no unknown fields, no NaN or infinity."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    def _require_exactly_one(self, *names: str) -> None:
        """Refuse none or several of the alternatives."""
        given = [name for name in names if getattr(self, name) is not None]
        if len(given) != 1:
            what = "gives none of " + ", ".join(names) if not given else "gives " + " and ".join(given)
            raise invalid_value_error(what, "exactly one of " + ", ".join(names))


Vector = Annotated[list[float], Len(3, 3)]


class AxisAngle(SchemaModel):
    """A rotation about an axis fixed in the world, right-handed."""

    axis: Vector = Field(description="The axis, world frame; any length but 0.", examples=[[0, 1, 0]])
    angle: float | None = Field(
        None, description="The angle; or give `degrees`.", json_schema_extra={"unit": "rad"}
    )
    degrees: float | None = Field(
        None, description="The angle; or give `angle`.", json_schema_extra={"unit": "°"}
    )

    _axis = field_validator("axis")(_require_nonzero)

    @model_validator(mode="after")
    def _check_alternatives(self) -> AxisAngle:
        self._require_exactly_one("angle", "degrees")
        return self

    @property
    def radians(self) -> float:
        """The angle in rad."""
        return self.angle if self.angle is not None else math.radians(self.degrees or 0.0)

    def quaternion(self, multiple: float = 1.0) -> Array:
        """Return the unit quaternion of a multiple of the rotation.

        Args:
            multiple: factor of the angle.

        Returns:
            (4,) scalar first.

        """
        half = 0.5 * multiple * self.radians
        return np.concatenate([[math.cos(half)], math.sin(half) * unit_vector(self.axis)])


class Euler(SchemaModel):
    """Three rotations about coordinate axes."""

    convention: str = Field(
        description="The order of the axes, and whether they turn with the body (`intrinsic`) or stay in the "
        "world (`extrinsic`): `intrinsic zxz` is Euler's own, `intrinsic zyx` is yaw-pitch-roll.",
        pattern="^(intrinsic|extrinsic) (xyx|xyz|xzx|xzy|yxy|yxz|yzx|yzy|zxy|zxz|zyx|zyz)$",
        examples=["intrinsic zxz"],
    )
    angles: Vector | None = Field(
        None,
        description="The angles in the order of the axes; or give `degrees`.",
        json_schema_extra={"unit": "rad"},
    )
    degrees: Vector | None = Field(
        None,
        description="The angles in the order of the axes; or give `angles`.",
        json_schema_extra={"unit": "°"},
    )

    @model_validator(mode="after")
    def _check_alternatives(self) -> Euler:
        self._require_exactly_one("angles", "degrees")
        return self


class Attitude(SchemaModel):
    """An attitude: exactly one of the three."""

    quaternion: Annotated[list[float], Len(4, 4)] | None = Field(
        None,
        description="Quaternion (w, x, y, z), scalar first, body → world. "
        "Of any length but 0: it is normalised.",
        examples=[[0.5, 0.5, 0.5, 0.5]],
    )
    axis_angle: AxisAngle | None = Field(None, description="A rotation from the world's axes about one axis.")
    euler: Euler | None = Field(None, description="Three rotations with a named convention.")

    @field_validator("quaternion")
    @classmethod
    def _quaternion(cls, value: list[float] | None) -> list[float] | None:
        return _require_nonzero(value) if value else value

    @model_validator(mode="after")
    def _check_alternatives(self) -> Attitude:
        self._require_exactly_one("quaternion", "axis_angle", "euler")
        return self


class Inertia(SchemaModel):
    """Inertia about the centre of mass, body frame: exactly one of principal, six, matrix."""

    principal: Vector | None = Field(
        None, description="The three principal moments.", json_schema_extra={"unit": "kg m²"}
    )
    axes: Attitude | None = Field(
        None,
        description="With `principal`: the attitude of the principal axes in the body's frame (where `axis` "
        "and `extrinsic` mean the body's axes). Absent: along the body's axes.",
    )
    six: Annotated[list[float], Len(6, 6)] | None = Field(
        None,
        description="xx, yy, zz, xy, xz, yz of the matrix; off the diagonal with the matrix's own sign, "
        "J_xy = −∫ x y dm.",
        json_schema_extra={"unit": "kg m²"},
    )
    matrix: Annotated[list[Vector], Len(3, 3)] | None = Field(
        None, description="The symmetric 3 × 3 matrix.", json_schema_extra={"unit": "kg m²"}
    )

    @field_validator("principal")
    @classmethod
    def _principal(cls, value: list[float] | None) -> list[float] | None:
        if value:
            _require_physical_inertia(np.diag(value))
        return value

    @field_validator("six")
    @classmethod
    def _six(cls, value: list[float] | None) -> list[float] | None:
        if value:
            _require_physical_inertia(_symmetric_matrix(value))
        return value

    @field_validator("matrix")
    @classmethod
    def _matrix(cls, value: list[list[float]] | None) -> list[list[float]] | None:
        if value:
            matrix = np.array(value)
            if np.any(np.abs(matrix - matrix.T) > INPUT_ROUNDING * np.max(np.abs(matrix))):
                raise invalid_value_error("is not symmetric", "a matrix that equals its transpose")
            _require_physical_inertia((matrix + matrix.T) / 2)
        return value

    @model_validator(mode="after")
    def _check_alternatives(self) -> Inertia:
        self._require_exactly_one("principal", "six", "matrix")
        if self.axes is not None and self.principal is None:
            raise invalid_value_error("gives axes without principal", "axes beside principal only")
        return self


def _symmetric_matrix(six: list[float]) -> Array:
    """Build the matrix of xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _require_physical_inertia(matrix: Array) -> None:
    """Refuse principal moments that are not positive or violate the triangle inequality.

    The sums J1 + J2 − J3 are twice the second moments of the mass, so none is negative.
    """
    values = np.linalg.eigvalsh(matrix)
    shown = ", ".join(f"{value:.6g}" for value in values)
    if values[0] <= INPUT_ROUNDING * values[2]:
        raise invalid_value_error(
            f"has the principal moments {shown}, not all positive", "three positive principal moments"
        )
    if values[0] + values[1] < values[2] * (1 - INPUT_ROUNDING):
        raise invalid_value_error(
            f"is not a physical inertia: its principal moments {shown} violate the triangle inequality",
            "principal moments of which none exceeds the sum of the other two",
        )


class Ball(SchemaModel):
    """A ball joint: the body's proximal point stays where it hangs."""

    kind: Literal["ball"] = Field(description="`ball`.")


class Rod(SchemaModel):
    """A massless rigid rod with a ball joint at both ends (the notes' own joint)."""

    kind: Literal["rod"] = Field(description="`rod`.")
    length: float = Field(
        description="Length, greater than 0.", json_schema_extra={"unit": "m", "exclusiveMinimum": 0}
    )
    direction: Vector = Field(
        description="From where the rod hangs to the body's proximal point, world frame, at t = 0. Of any "
        "length but 0: it is normalised.",
        examples=[[0, 0.6, -0.8]],
    )
    rate: Vector | None = Field(
        None,
        description="Rate of change of the (unit) direction at t = 0, world frame, perpendicular to it. "
        "Or give `angular_velocity`; absent: 0.",
        json_schema_extra={"unit": "1/s"},
    )
    angular_velocity: Vector | None = Field(
        None,
        description="Angular velocity w of the rod at t = 0, world frame: the rate is w × direction, so the "
        "part along the rod has no effect. Or give `rate`.",
        json_schema_extra={"unit": "rad/s"},
    )

    @field_validator("length")
    @classmethod
    def _length(cls, value: float) -> float:
        if value == 0:
            raise invalid_value_error(
                "is 0: a rod without length is a ball joint", "{kind: ball}, or a length above 0"
            )
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
    def _check_alternatives(self) -> Rod:
        if self.rate is not None and self.angular_velocity is not None:
            raise invalid_value_error("gives rate and angular_velocity", "one of them")
        return self


class Load(SchemaModel):
    """Constant loads on a body."""

    force: Vector = Field(
        default=[0.0, 0.0, 0.0],
        description="Force at the centre of mass, constant in the world frame.",
        json_schema_extra={"unit": "N"},
    )
    moment: Vector = Field(
        default=[0.0, 0.0, 0.0],
        description="Moment, constant in the body's frame (the notes' n′): it turns with the body.",
        json_schema_extra={"unit": "N m"},
    )


class Drag(SchemaModel):
    """Linear drag on a body."""

    force: float = Field(
        default=0.0,
        ge=0,
        description="c_t ≥ 0: the force −c_t ṙ at the centre of mass.",
        json_schema_extra={"unit": "N s/m"},
    )
    moment: float = Field(
        default=0.0, ge=0, description="c_r ≥ 0: the moment −c_r ω′.", json_schema_extra={"unit": "N m s"}
    )


class Body(SchemaModel):
    """One rigid body; it hangs from the body before it, the first from the pivot at the world's origin."""

    name: str | None = Field(
        None,
        max_length=80,
        description="A name for readers; absent: its place in the chain.",
        examples=["bob"],
    )
    mass: float = Field(gt=0, description="Mass, greater than 0.", json_schema_extra={"unit": "kg"})
    inertia: Inertia = Field(description="Inertia about the centre of mass, body frame.")
    joint: Annotated[Ball | Rod, Discriminator("kind")] = Field(description="How the body hangs.")
    proximal: Vector = Field(
        description="The point of this body by which it hangs, body frame (the notes' s_1, s_3).",
        json_schema_extra={"unit": "m"},
    )
    distal: Vector | None = Field(
        None,
        description="The point of this body from which the next one hangs, body frame (the notes' s_2). "
        "Needed where a body follows.",
        json_schema_extra={"unit": "m"},
    )
    attitude: Attitude = Field(description="Attitude at t = 0, body → world.")
    angular_velocity: Vector = Field(
        [0.0, 0.0, 0.0],
        description="Angular velocity at t = 0, body frame (the notes' ω′).",
        json_schema_extra={"unit": "rad/s"},
    )
    load: Load = Field(default_factory=Load, description="Constant force and moment on this body.")
    drag: Drag = Field(default_factory=Drag, description="Linear drag on this body.")

    _name = field_validator("name")(lambda value: _require_printable(value) if value else value)


class BodySequence(SchemaModel):
    """Repeated bodies: body j = 0, 1, 2 … of them copies the bodies of `cycle` in turn.

    With `turn`, body j and its rod (direction and rate) are turned together by j times that
    rotation about its axis in the world; the angular velocity, being in the body's frame, goes along.
    """

    repeat: int = Field(ge=1, le=MAX_BODIES, description="Number of bodies.")
    cycle: list[Body] = Field(min_length=1, description="The bodies that are copied, one after the other.")
    turn: AxisAngle | None = Field(
        None, description="The rotation that body j is turned by, j times. Absent: none."
    )


def _item_tag(value: Any) -> str:
    is_sequence = (
        "repeat" in value or "cycle" in value if isinstance(value, dict) else isinstance(value, BodySequence)
    )
    return "sequence" if is_sequence else "body"


ChainItem = Annotated[
    Annotated[Body, Tag("body")] | Annotated[BodySequence, Tag("sequence")], Discriminator(_item_tag)
]


class Document(SchemaModel):
    """A scenario file: one open chain of rigid bodies, its initial state, its loads."""

    schema_version: Literal[1] = Field(description="Version of this format: 1.")
    name: str | None = Field(
        None, min_length=1, max_length=80, description="The name in results; absent: the file's name."
    )
    family: str = Field(
        "own",
        min_length=1,
        max_length=40,
        description="Group in reports and for `--family`.",
        examples=["double"],
    )
    title: str = Field(min_length=1, max_length=200, description="One line that describes the scenario.")
    purpose: str = Field(
        min_length=1, max_length=1000, description="Which mistakes this scenario reveals, in a sentence."
    )
    exact: ClosedForm | None = Field(
        None,
        description="The closed-form solution that this scenario has, if any. `small-double` and "
        "`small-chain` are asymptotic: their error shrinks with the square of the amplitude.",
    )
    duration: float = Field(
        2.0,
        gt=0,
        description="Length of the motion that is compared; a whole number of samples.",
        json_schema_extra={"unit": "s"},
    )
    sample: float = Field(
        0.03125,
        gt=0,
        validate_default=True,
        description="Time between compared samples. A binary fraction (1/32 = 0.03125) lets every step "
        "1/2^k hit the samples exactly.",
        json_schema_extra={"unit": "s"},
    )
    gravity: Vector = Field(
        [0.0, 0.0, -9.81],
        description="Acceleration of gravity, world frame.",
        json_schema_extra={"unit": "m/s²"},
    )
    bodies: list[ChainItem] = Field(
        min_length=1,
        max_length=MAX_BODIES,
        description="The chain, from the pivot outwards: single and repeated bodies.",
    )

    _text = field_validator("name", "family", "title", "purpose")(
        lambda value: _require_printable(value) if value else value
    )

    @field_validator("name", "family", "title")
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
        message = f"{duration:g} s are {count:.9g} samples of {value:g} s"
        if count > MAX_SAMPLES:
            raise invalid_value_error(message, f"at most {MAX_SAMPLES} samples", "duration")
        if abs(count - round(count)) > 1e-9 * count or round(count) < 1:
            valid = "a duration that is a whole number of samples"
            raise invalid_value_error(message, valid, "duration")
        return value


def attitude_quaternion(attitude: Attitude) -> Array:
    """Return the unit quaternion of an attitude, in whichever form the file gives it.

    Args:
        attitude: a checked field.

    Returns:
        (4,) scalar first, body → world, unit to rounding.

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


def inertia_matrix(inertia: Inertia) -> Array:
    """Return the inertia matrix, in whichever form the file gives it.

    Args:
        inertia: a checked field.

    Returns:
        (3, 3) about the centre of mass, body frame, exactly symmetric [kg m²].

    """
    if inertia.six is not None:
        return _symmetric_matrix(inertia.six)
    if inertia.matrix is not None:
        matrix = np.array(inertia.matrix)
        return np.asarray((matrix + matrix.T) / 2)
    assert inertia.principal is not None  # the model has exactly one
    if inertia.axes is None:
        return np.diag(inertia.principal)
    axes = rotation_matrix(attitude_quaternion(inertia.axes))
    matrix = axes @ np.diag(inertia.principal) @ axes.T
    return np.asarray((matrix + matrix.T) / 2)
