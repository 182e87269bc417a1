"""The table of joint kinds: what each holds and what it leaves free.

A new kind is one entry here and its word in `AxesKind`.  With x, y, z the joint's axes in the far body,
X, Y, Z in the near one and d from the far to the near point, the rows and coordinates besides those of the
notes' rod and ball are

    hinge        d; xᵀZ, yᵀZ                   φ = atan2(yᵀX, xᵀX)
    universal    d; xᵀY                        φ₁ = atan2(zᵀY, yᵀY), φ₂ = atan2(xᵀZ, xᵀX)
    slide        xᵀd, yᵀd; xᵀY, yᵀZ, zᵀX       zᵀd
    cylindrical  xᵀd, yᵀd; xᵀZ, yᵀZ            zᵀd, φ as of the hinge
    planar       zᵀd; xᵀZ, yᵀZ                 xᵀd, yᵀd, φ as of the hinge
    helical      xᵀd, yᵀd, zᵀd − h φ; xᵀZ, yᵀZ     φ as of the hinge, with all full turns; pitch h
    weld         d; xᵀY, yᵀZ, zᵀX
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

# joints with axes in both bodies
AxesKind = Literal["hinge", "universal", "slide", "cylindrical", "planar", "helical", "weld"]
Kind = Literal["rod", "ball", "free"] | AxesKind


@dataclass(frozen=True)
class JointKind:
    """What a joint holds, and what it leaves free."""

    # Rows C = uᵀw by the names of u and w: i, j, k the world's axes, x, y, z the joint's in the far body,
    # X, Y, Z in the near one, d from the far to the near point.
    rows: tuple[tuple[str, str], ...]
    # Its scalar coordinates from the far body on: turns about or slides along one of the axes 0, 1, 2.
    motions: tuple[tuple[Literal["turn", "slide"], int], ...] = ()
    has_attitude: bool = False  # whether p of the near body is a coordinate, not a result
    has_pitch: bool = False  # whether its turn moves it along the axis: zᵀd is its pitch times the turn

    @cached_property
    def holds_distance(self) -> bool:
        """Whether it holds the distance of its two points, not the points together."""
        return ("d", "d") in self.rows

    @cached_property
    def own_number(self) -> str:
        """What its number in `Mechanism.length` is: "length" [m], "pitch" [m/rad], or empty."""
        return "length" if self.holds_distance else "pitch" * self.has_pitch

    @cached_property
    def holds_nothing(self) -> bool:
        """Whether the near body is free."""
        return not self.rows

    @cached_property
    def is_unbounded(self) -> bool:
        """Whether its near point may go any distance from the far one."""
        return self.holds_nothing or self.has_pitch or bool(self.slide_axes)

    @cached_property
    def holds_points(self) -> bool:
        """Whether it holds its two points together, among other things."""
        return self.rows[:3] == _POINT

    @cached_property
    def is_spherical(self) -> bool:
        """Whether it holds its two points together and nothing else: its elements act about every axis."""
        return self.rows == _POINT

    @cached_property
    def freedom(self) -> int:
        """How many independent rates it leaves."""
        return 6 - len(self.rows)

    @cached_property
    def is_rigid(self) -> bool:
        """Whether it leaves no motion."""
        return self.freedom == 0

    @cached_property
    def holds_no_turn(self) -> bool:
        """Whether it transmits a force and no moment, but those of its elements."""
        return self.has_attitude and not self.holds_nothing

    @cached_property
    def element_count(self) -> int:
        """How many numbers each of its elements has."""
        return 1 if self.is_spherical else len(self.motions)

    @cached_property
    def turn_axes(self) -> tuple[int, ...]:
        """The axes of its turns, in order."""
        return tuple(axis for what, axis in self.motions if what == "turn")

    @cached_property
    def slide_axes(self) -> tuple[int, ...]:
        """The axes of its slides, in order."""
        return tuple(axis for what, axis in self.motions if what == "slide")

    @cached_property
    def motion_names(self) -> tuple[str, ...]:
        """A name for each motion: what it does; of several that do the same, with the letter of the axis."""
        names = [what for what, _ in self.motions]
        of_several = {"turn": "{}", "slide": "slide {}"}
        return tuple(
            what if names.count(what) == 1 else of_several[what].format("xyz"[axis])
            for what, axis in self.motions
        )

    @cached_property
    def is_about_z(self) -> bool:
        """Whether it has motions, all of them about or along z: the axes x and y have no part in them."""
        return {axis for _, axis in self.motions} == {2}

    @cached_property
    def is_reversible(self) -> bool:
        """Whether with its bodies exchanged it is a joint of the same kind with the negative coordinates."""
        return len({axis for _, axis in self.motions}) < 2 or not self.slide_axes

    @cached_property
    def exchanges_axes(self) -> bool:
        """Whether with its bodies exchanged its axes x and y, and its two turns, change places."""
        return len(self.turn_axes) == 2

    @cached_property
    def description(self) -> str:
        """What the near body does, as seen from the far one."""
        verbs = {"turn": "turns about", "slide": "moves along"}
        if self.has_pitch:
            verbs["turn"] = "moves by its pitch per angle along, and turns about,"
        return (
            " and then ".join(f"{verbs[what]} {'xyz'[axis]}" for what, axis in self.motions)
            or "does not move"
        )


_POINT = (("i", "d"), ("j", "d"), ("k", "d"))
_ATTITUDE = (("x", "Y"), ("y", "Z"), ("z", "X"))
KINDS: dict[Kind, JointKind] = {
    "rod": JointKind((("d", "d"),), has_attitude=True),
    "ball": JointKind(_POINT, has_attitude=True),
    "hinge": JointKind((*_POINT, ("x", "Z"), ("y", "Z")), (("turn", 2),)),
    "universal": JointKind((*_POINT, ("x", "Y")), (("turn", 0), ("turn", 1))),
    "slide": JointKind((("x", "d"), ("y", "d"), *_ATTITUDE), (("slide", 2),)),
    "cylindrical": JointKind((("x", "d"), ("y", "d"), ("x", "Z"), ("y", "Z")), (("slide", 2), ("turn", 2))),
    "planar": JointKind((("z", "d"), ("x", "Z"), ("y", "Z")), (("slide", 0), ("slide", 1), ("turn", 2))),
    "helical": JointKind(
        (("x", "d"), ("y", "d"), ("z", "d"), ("x", "Z"), ("y", "Z")), (("turn", 2),), has_pitch=True
    ),
    "weld": JointKind((*_POINT, *_ATTITUDE)),
    "free": JointKind((), has_attitude=True),
}


def column_count(kinds: Iterable[Kind]) -> int:
    """Columns of joint coordinates and elements: 2, or as many as one of the joints has motions."""
    return max([2, *(len(KINDS[kind].motions) for kind in kinds)])


# of joints that the program makes itself
ROD: Kind = "rod"
BALL: Kind = "ball"
HINGE: Kind = "hinge"
CYLINDRICAL: Kind = "cylindrical"
WELD: Kind = "weld"
FREE: Kind = "free"
