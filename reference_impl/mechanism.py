"""The mechanism that the equations are written for: rigid bodies on joints, a tree and what closes it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np

from reference_impl.arrays import Array, Bool, Flags, Float, Indices, Int
from reference_impl.joint_kinds import BALL, KINDS, ROD, JointKind, Kind, column_count

ZERO_INERTIA = 1e-14  # a principal moment that is this part of the largest is the rounding of 0
JOINT_ELEMENTS = ("armature", "damping", "stiffness", "rest", "effort")
SPRING_FIELDS = ("spring_body", "spring_point", "spring_stiffness", "spring_damping", "spring_length")


_Found = TypeVar("_Found")


def _remembered(find: Callable[[Mechanism], _Found]) -> Callable[[Mechanism], _Found]:
    """Remember what is computed of a mechanism by its identity, outside of its fields."""
    return lru_cache(maxsize=64)(find)


def _no_pairs() -> Array:
    return np.zeros((0, 2))


def _no_numbers() -> Array:
    return np.zeros(0)


JOINT_FIELDS = ("kind", "body", "point", "turn", "length", *JOINT_ELEMENTS)
BODY_FIELDS = ("force", "moment", "drag_force", "drag_moment")  # besides mass and inertia


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A tree of N rigid bodies: joint k < N holds body k, its near body, on a far body or on the world (−1).

    The far body of a joint comes before the near one, and the bodies of a branch follow each other (depth
    first).  Joints k ≥ N close loops, between any two bodies or a body and the world; J joints in all, as
    many as bodies in a tree.  A "rod" is the notes' massless rigid rod with a ball joint at both ends, a
    "ball" its limit ℓ → 0 (E1).  A chain, each body on the one before and the first on the world's origin, is
    made by `chain`; N = 1 and N = 2 on rods are the notes' own pendulums.  Leading axes are a batch.
    """

    mass: Float[Array, "*#batch bodies"]  # kg
    inertia: Float[Array, "*#batch bodies 3 3"]  # kg m², J about the centre of mass, body frame
    kind: tuple[Kind, ...]  # (J,) of the joints
    body: Int[Indices, "joints 2"]  # far and near; in the tree body[k, 0] < body[k, 1] = k
    point: Float[Array, "*#batch joints 2 3"]  # m, far and near, each in the frame of its body
    turn: Float[Array, "*#batch joints 2 4"]  # unit quaternions: the joint's axes in both bodies
    # The one number of its own that a kind may have, `JointKind.own_number`; 0 for other joints: m, ℓ of a
    # rod; m/rad, the pitch of a turn that moves along its axis
    length: Float[Array, "*#batch joints"]
    gravity: Float[Array, "*#batch 3"]  # m/s², world frame
    force: Float[Array, "*#batch bodies 3"]  # N, constant applied force at the centre of mass, world frame
    moment: Float[Array, "*#batch bodies 3"]  # N m, constant applied moment n′, body frame
    drag_force: Float[Array, "*#batch bodies"]  # N s/m, c_t: F = −c_t ṙ at the centre of mass
    drag_moment: Float[Array, "*#batch bodies"]  # N m s, c_r: n′ = −c_r ω′
    # Passive elements of the scalar coordinates φ of each joint, zeros where there are none; of a ball joint
    # the first number holds about every axis, and φ is the rotation vector of the near body in the far one.
    # kg m² or kg, a: rotors that turn with φ̇, ½ a φ̇²
    armature: Float[Array, "*#batch joints coordinates"] = field(default_factory=_no_pairs)
    # N m s or N s/m, c: −c φ̇
    damping: Float[Array, "*#batch joints coordinates"] = field(default_factory=_no_pairs)
    # N m or N/m, k: −k (φ − φ₀)
    stiffness: Float[Array, "*#batch joints coordinates"] = field(default_factory=_no_pairs)
    rest: Float[Array, "*#batch joints coordinates"] = field(default_factory=_no_pairs)  # rad or m, φ₀
    # N m or N, constant, on the near body along φ
    effort: Float[Array, "*#batch joints coordinates"] = field(default_factory=_no_pairs)
    # springs and dampers between two points, each of a body or of the world (−1): tension k (l − l₀) + c l̇ at
    # the distance l
    spring_body: Int[Indices, "springs 2"] = field(default_factory=lambda: np.zeros((0, 2), np.intp))
    # m, each in the frame of its body, or of the world
    spring_point: Float[Array, "*#batch springs 2 3"] = field(default_factory=lambda: np.zeros((0, 2, 3)))
    spring_stiffness: Float[Array, "*#batch springs"] = field(default_factory=_no_numbers)  # N/m
    spring_damping: Float[Array, "*#batch springs"] = field(default_factory=_no_numbers)  # N s/m
    spring_length: Float[Array, "*#batch springs"] = field(default_factory=_no_numbers)  # m, l₀

    def __post_init__(self) -> None:
        """Give joints without passive elements zeros, and all elements a column per coordinate."""
        given = [getattr(self, name) for name in JOINT_ELEMENTS]
        columns = max([column_count(self.kind), *(x.shape[-1] for x in given)])
        for name, values in zip(JOINT_ELEMENTS, given, strict=True):
            if values.shape[-2:] != (len(self.kind), columns):
                # Leading axes are a batch: the steps of implicit methods add to the rotors' inertias.
                full = np.zeros((*values.shape[:-2], len(self.kind), columns), values.dtype)
                full[..., : values.shape[-2], : values.shape[-1]] = values
                object.__setattr__(self, name, full)

    @classmethod
    def chain(
        cls,
        proximal: Float[Array, "bodies 3"],
        distal: Float[Array, "bodies 3"],
        length: Float[Array, "bodies"],
        **fields: Any,
    ) -> Mechanism:
        """Make an open chain on rods and ball joints, hung from the world's origin.

        Args:
            proximal: the joint of body k: the notes' s_1 of body 1, s_3 of body 2; body frame [m].
            distal: the joint of body k+1 on body k: s_2; body frame, unused for the last body [m].
            length: of the rods, 0 for a ball joint [m].
            fields: masses, inertias, gravity, loads and drag as they are named here.

        """
        k = np.arange(len(length))
        far = np.concatenate([np.zeros_like(distal[:1]), distal[:-1]])
        return cls(
            kind=_chain_kinds(length),
            body=np.stack([k - 1, k], axis=1),
            point=np.stack([far, proximal], axis=1),
            turn=np.tile([1.0, 0.0, 0.0, 0.0], (len(k), 2, 1)),
            length=length,
            **fields,
        )

    def changed(self, **changes: Any) -> Mechanism:
        """Copy the mechanism with other values of some fields.

        Args:
            **changes: fields by name.  Of a chain also ``proximal`` and ``distal`` as `chain` takes them.  A
                new ``length`` decides which of the rods and balls are rods.

        """
        near, far = changes.pop("proximal", None), changes.pop("distal", None)
        point = changes.get("point", self.point)
        if near is not None:
            changes["point"] = point = np.stack([point[:, 0], near], axis=1)
        if far is not None:
            hang = np.concatenate([np.zeros_like(far[:1]), far[:-1]])
            changes["point"] = np.stack([hang, point[:, 1]], axis=1)
        if "length" in changes and "kind" not in changes:
            kinds = zip(self.kind, _chain_kinds(changes["length"]), strict=True)
            changes["kind"] = tuple(new if old in (ROD, BALL) else old for old, new in kinds)
        return replace(self, **changes)

    @property
    def fields(self) -> dict[str, Any]:
        """The fields by name; no elements where there are none."""
        absent = JOINT_ELEMENTS[: 0 if self.has_joint_elements else None]
        absent += SPRING_FIELDS[: 0 if len(self.spring_body) else None]
        return {name: value for name, value in vars(self).items() if name not in absent}

    @classmethod
    def from_fields(cls, fields: dict[str, Any]) -> Mechanism:
        """Make a mechanism of its `fields`.

        Args:
            fields: as `fields` returns them; lists will do for arrays.

        """
        integers = ("body", "spring_body")
        arrays = {
            name: np.array(value, np.intp if name in integers else float)
            for name, value in fields.items()
            if name != "kind"
        }
        return cls(kind=tuple(fields["kind"]), **arrays)

    @property
    def n(self) -> int:
        """Number of bodies."""
        return int(self.mass.shape[-1])

    @property
    def kinds(self) -> tuple[JointKind, ...]:
        """(J,) the entries of `KINDS`."""
        return _entries(self.kind)

    @property
    def has_joint_moments(self) -> bool:
        """Whether a joint transmits a moment: those of bare rods and balls are 0."""
        return self.has_joint_elements or not all(kind.holds_no_turn for kind in self.kinds)

    @property
    @_remembered
    def has_chain_joints(self) -> bool:
        """Whether every body hangs from the one before, the first from the world, by a bare rod or ball."""
        if self.has_loops or self.has_elements or not all(kind.holds_no_turn for kind in self.kinds):
            return False
        return bool(np.all(self.body[:, 0] == np.arange(self.n) - 1))

    @property
    def has_loops(self) -> bool:
        """Whether joints close loops."""
        return len(self.kind) > self.n

    @property
    @_remembered
    def lacks_inertia(self) -> bool:
        """Whether a body has no inertia about some axis: a point mass, or a thin rod."""
        if not np.all(np.isfinite(self.inertia)):
            return False
        principal = np.linalg.eigvalsh(self.inertia)
        return bool(np.any(principal[:, 0] <= ZERO_INERTIA * principal[:, 2]))

    @property
    def tree(self) -> Mechanism:
        """The mechanism without its closing joints; itself where there are none."""
        return _tree_of(self) if self.has_loops else self

    @property
    def proximal(self) -> Float[Array, "... 3"]:
        """The point by which body k hangs, the near point of joint k [m], body frame."""
        return self.point[:, 1]

    @property
    def distal(self) -> Float[Array, "... 3"]:
        """The point of body k on which body k+1 of a chain hangs [m], body frame; 0 for the last."""
        return np.concatenate([self.point[1:, 0], np.zeros_like(self.point[:1, 0])])

    @property
    def columns(self) -> int:
        """Columns of joint coordinates and elements: 2, or as many as a joint has motions."""
        return int(self.armature.shape[-1])

    @property
    def rods(self) -> Bool[Flags, "joints"]:
        """True where joint k is a rod."""
        return np.array([kind.holds_distance for kind in self.kinds], bool)

    @property
    def free(self) -> Bool[Flags, "joints"]:
        """True where joint k leaves its body free."""
        return np.array([kind.holds_nothing for kind in self.kinds], bool)

    @property
    @_remembered
    def has_joint_elements(self) -> bool:
        """Whether any joint has a rotor, a damper, a spring or an effort."""
        return any(np.any(getattr(self, name)) for name in JOINT_ELEMENTS)

    @property
    def has_elements(self) -> bool:
        """Whether there are passive elements or efforts, of joints or between points."""
        return self.has_joint_elements or len(self.spring_body) > 0

    @property
    def has_drag(self) -> bool:
        """Whether any body feels drag."""
        return bool(np.any(self.drag_force) or np.any(self.drag_moment))

    @property
    def is_dissipative(self) -> bool:
        """Whether drag or a damper takes energy out."""
        return self.has_drag or bool(np.any(self.damping) or np.any(self.spring_damping))

    @property
    def has_loads(self) -> bool:
        """Whether any constant force or moment is applied."""
        return bool(np.any(self.force) or np.any(self.moment))


def side_by_side(mechanisms: Sequence[Mechanism]) -> Mechanism:
    """Join mechanisms to one.

    Args:
        mechanisms: of any bodies and joints; of loops the rows are right, but joint k holds another body.

    Returns:
        All of them, without gravity, which may differ between them.

    """
    first = np.cumsum([0, *(mechanism.n for mechanism in mechanisms)])
    columns = max(mechanism.columns for mechanism in mechanisms)
    fields: dict[str, Any] = {}
    for name in vars(mechanisms[0]):
        parts = [getattr(mechanism, name) for mechanism in mechanisms]
        if name in JOINT_ELEMENTS:
            parts = [np.pad(part, ((0, 0), (0, columns - part.shape[1]))) for part in parts]
        if name == "kind":
            fields[name] = sum(parts, ())
        elif name in ("body", "spring_body"):
            fields[name] = np.concatenate(
                [np.where(x < 0, x, x + at) for x, at in zip(parts, first, strict=False)]
            )
        else:
            fields[name] = np.zeros(3) if name == "gravity" else np.concatenate(parts)
    return Mechanism(**fields)


@_remembered
def _tree_of(mechanism: Mechanism) -> Mechanism:
    return replace(mechanism, **{name: getattr(mechanism, name)[: mechanism.n] for name in JOINT_FIELDS})


@lru_cache(maxsize=64)
def _entries(kinds: tuple[Kind, ...]) -> tuple[JointKind, ...]:
    return tuple(KINDS[kind] for kind in kinds)


def _chain_kinds(length: Array) -> tuple[Kind, ...]:
    """Rods where there is a length, balls elsewhere."""
    return tuple(ROD if size > 0 else BALL for size in length)
