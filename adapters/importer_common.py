"""Parts shared by the importer columns: canonical velocities, screws of joints, what a library prints."""

from __future__ import annotations

import os
import re
import tempfile
import xml.etree.ElementTree as ElementTree
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib import metadata
from typing import Any, ClassVar, TypeVar

import numpy as np

from plumbline.importers.importer import Importer, ModelFile, Reading
from plumbline.importers.neutral_model import (
    CanonicalState,
    ElementaryJoint,
    JointKind,
    ModelQuantities,
    NeutralBody,
    NeutralModel,
)
from plumbline.model.datatypes import Array, Float
from plumbline.model.kinematics import quaternion_of, quaternion_product, rotation_matrix

MAX_WARNINGS = 20
Node = TypeVar("Node")
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_ROTATION_EPSILON = 1e-12  # |ω| of a unit screw below which the motion is a displacement


def to_canonical(
    quantities: ModelQuantities, T: Float[Array, "n n"], Tdot_v: Float[Array, "n"]
) -> ModelQuantities:
    """Transform quantities in an engine's velocities v_e = T v to canonical velocities v.

    M = TᵀM_eT,  h = Tᵀ(M_e Ṫv + h_e),  f = Tᵀf_e,  v̇ = T⁻¹(v̇_e − Ṫv).

    Args:
        quantities: in the engine's velocities.

    Returns:
        The quantities in canonical velocities; those that are None stay so.

    Raises:
        ValueError: there is a bias force without a mass matrix.

    """
    M, h, a = quantities.mass_matrix, quantities.bias_force, quantities.acceleration
    if h is not None and M is None:
        raise ValueError("a bias force in canonical velocities needs the mass matrix")

    def turned(force: Array | None) -> Array | None:
        return None if force is None else T.T @ force

    return replace(
        quantities,
        mass_matrix=None if M is None else T.T @ M @ T,
        bias_force=turned(None if h is None or M is None else M @ Tdot_v + h),
        gravity_force=turned(quantities.gravity_force),
        passive_force=turned(quantities.passive_force),
        acceleration=None if a is None else np.asarray(np.linalg.solve(T, a - Tdot_v), float),
    )


def joint_from_screw(
    name: str, angular: Float[Array, "3"], linear: Float[Array, "3"], **numbers: float
) -> ElementaryJoint:
    """Describe a joint of one degree of freedom by its motion at the reference.

    Args:
        angular: angular velocity of the body at unit rate, body axes.
        linear: velocity of the body frame's origin at unit rate, body axes [m].
        **numbers: armature, damping and the like.

    Returns:
        A hinge through the point of its axis that is next to the body frame's origin, or a slide.

    """
    size = float(np.linalg.norm(angular))
    if size > _ROTATION_EPSILON:
        return make_joint(name, "hinge", angular / size, np.cross(angular, linear) / size**2, **numbers)
    return make_joint(name, "slide", linear / np.linalg.norm(linear), **numbers)


def make_joint(
    name: str, kind: JointKind, axis: Any = (0, 0, 0), anchor: Any = (0, 0, 0), **numbers: float
) -> ElementaryJoint:
    """Make a joint with arrays of its own.

    Args:
        axis: unit vector (3,), body frame.
        anchor: point (3,) [m], body frame.
        **numbers: armature, damping and the like.

    """
    given: dict[str, Any] = {field: float(value) for field, value in numbers.items()}
    return ElementaryJoint(name, kind, np.array(axis, float), np.array(anchor, float), **given)


def make_body(
    name: str,
    parent: int,
    X: Float[Array, "3 4"],
    joints: Iterable[ElementaryJoint],
    mass: Any,
    center: Any,
    inertia: Any,
) -> NeutralBody:
    """Make a body with arrays of its own.

    Args:
        X: pose or (4, 4) in the parent, where the joints are at their reference.
        center: centre of mass (3,) [m], body frame.
        inertia: about the centre of mass (3, 3) [kg m²], body axes.

    """
    position, center, inertia = (np.array(x, float) for x in (X[:3, 3], center, inertia))
    attitude = quaternion_of(X[:3, :3])
    return NeutralBody(name, parent, position, attitude, tuple(joints), float(mass), center, inertia)


def depth_first(roots: Iterable[Node], children: Callable[[Node], Iterable[Node]]) -> Iterator[Node]:
    """Go through trees: a parent first, then each of its children with all that is below it."""
    pending = list(roots)[::-1]
    while pending:
        yield (node := pending.pop())
        pending += list(children(node))[::-1]


def pose(rotation: Float[Array, "3 3"], origin: Float[Array, "3"]) -> Float[Array, "3 4"]:
    """Return the matrix of a pose.

    Args:
        rotation: body → world.
        origin: of the body frame [m], world.

    Returns:
        Rotation and origin side by side.

    """
    return np.hstack([np.asarray(rotation, float), np.asarray(origin, float).reshape(3, 1)])


def pose_of_coordinates(x: Float[Array, "7"]) -> Float[Array, "4 4"]:
    """Return the pose that the canonical coordinates of a free joint give.

    Args:
        x: position [m] and unit quaternion.

    Returns:
        The pose of the body frame in the world.

    """
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix(x[3:]), x[:3]
    return matrix


def free_joint_name(body: str, file: ModelFile) -> str:
    """Return the name of a body's free joint, which most engines do not keep: the file's, if it has one."""
    return _own_names(file, body, [f"{body}/free"])[0]


def names_of_parts(file: ModelFile, body: str, joint: str, count: int) -> list[str]:
    """Return names of the joints that an engine has made one of: the file's, or the one's with numbers."""
    return _own_names(file, body, [f"{joint}/{k}" for k in range(count)])


def _own_names(file: ModelFile, body: str, made_up: list[str]) -> list[str]:
    names = joint_names(file).get(body, [])
    return names if len(names) == len(made_up) else made_up


def joint_names(file: ModelFile) -> dict[str, list[str]]:
    """Read the names of the joints of each body of an MJCF file, in their order, by the body's name."""
    if file.format != "mjcf":
        return {}
    root = ElementTree.parse(file.path).getroot()
    return {
        body.get("name", ""): [joint.get("name", "") for joint in body if joint.tag in ("joint", "freejoint")]
        for body in root.iter("body")
    }


def merge_made_up_bodies(bodies: Sequence[NeutralBody], file: ModelFile) -> list[NeutralBody]:
    """Merge massless bodies that an importer made up for the joints of a body of an MJCF file.

    The joints J_i of the upper body, seen from the lower body with pose P in it, are P⁻¹J_iP.

    Args:
        bodies: of the engine's model; depth first.
        file: the file; one that is no MJCF changes nothing.

    Returns:
        The bodies that the file names, and those with mass or with several children.

    """
    if file.format != "mjcf":
        return list(bodies)
    named = joint_names(file)
    children = [[k for k, b in enumerate(bodies) if b.parent == i] for i in range(len(bodies))]
    kept, moved = list(bodies), list(range(len(bodies)))
    for i, upper in enumerate(bodies):
        if upper.mass == 0 and upper.name not in named and len(children[i]) == 1:
            (k,) = children[i]
            upper, lower = kept[i], kept[k]
            R, R_upper = rotation_matrix(lower.attitude), rotation_matrix(upper.attitude)
            joints = tuple(
                replace(
                    joint,
                    axis=R.T @ joint.axis,
                    anchor=R.T @ (joint.anchor - lower.position) if joint.kind == "hinge" else joint.anchor,
                )
                for joint in upper.joints
            )
            kept[k] = replace(
                lower,
                parent=upper.parent,
                position=upper.position + R_upper @ lower.position,
                attitude=quaternion_product(upper.attitude, lower.attitude),
                joints=joints + lower.joints,
            )
            moved[i] = -1
    places = {i: k for k, i in enumerate(i for i in moved if i >= 0)}
    return [replace(kept[i], parent=places.get(kept[i].parent, -1)) for i in places]


class Refused(Exception):
    """An engine does not load a file; the message has its words, or is empty where it only printed them."""


class Layout(ABC):
    """What an engine made of a file, in the order of the reading: its bodies, and its routines at a state."""

    name = ""  # of the model, where the engine keeps it

    def __init__(self, loaded: Any, file: ModelFile) -> None:
        """Describe the engine's object; raises NotImplementedError with what the column does not know."""
        self.loaded, self.file = loaded, file
        self.model = NeutralModel(self.name, tuple(self._bodies()), np.array(self._gravity(), float))

    @abstractmethod
    def _bodies(self) -> Iterable[NeutralBody]:
        """Describe the bodies, depth first."""

    @abstractmethod
    def _gravity(self) -> Any:
        """Return the gravity (3,) [m/s²]."""

    @abstractmethod
    def quantities(self, state: CanonicalState) -> ModelQuantities:
        """Compute the quantities with the engine's own routines."""

    def _free_joint(self, body: str, **numbers: float) -> ElementaryJoint:
        return make_joint(free_joint_name(body, self.file), "free", **numbers)


class LayoutWithOwnVelocities(Layout):
    """A layout of an engine whose velocities are others than the canonical ones: v_e = T v."""

    def __init__(self, loaded: Any, file: ModelFile) -> None:
        """Describe the engine's object and note where its joints are."""
        self.places: list[tuple[Any, Any]] = []  # of each joint: the engine's own, and indices of velocities
        super().__init__(loaded, file)

    def quantities(self, state: CanonicalState) -> ModelQuantities:
        """Move the joints, compute in the engine's velocities and transform to canonical ones."""
        n = len(state.velocities)
        T, Tdot_v = np.zeros((n, n)), np.zeros(n)
        for (own, rows), (joint, x, v) in zip(self.places, self.model.joint_slices(), strict=True):
            T[rows, v], Tdot_v[rows] = self._move(joint, own, state.coordinates[x], state.velocities[v])
        return to_canonical(self._engine_quantities(T @ state.velocities), T, Tdot_v)

    @abstractmethod
    def _move(self, joint: ElementaryJoint, own: Any, x: Array, v: Array) -> tuple[Any, Any]:
        """Set a joint's coordinates in the engine; return its block of T and its part of Ṫv."""

    @abstractmethod
    def _engine_quantities(self, v: Array) -> ModelQuantities:
        """Compute the quantities at the engine's velocities, in these velocities."""


class LoadingImporter(Importer):
    """An importer whose engine loads a file into an object, which a layout describes and evaluates."""

    layout: ClassVar[type[Layout]]
    refusals: ClassVar[tuple[type[Exception], ...]] = (Refused,)  # exceptions with the engine's words

    def version(self) -> str:
        """Return the version of the engine, as the metadata of its wheel have it."""
        return metadata.version(self.package)

    def read(self, file: ModelFile) -> Reading:
        """Load a file; return the description of what the engine made of it, or the engine's refusal."""
        refusal = None
        with captured_output() as printed:
            try:
                loaded = self._load(file)
            except self.refusals as words:
                refusal = str(words)
        if refusal is not None:
            return Reading(self.version(), refusal=self._refusal_words(refusal, printed))
        try:
            model = self.layout(loaded, file).model
        except NotImplementedError as kind:
            return Reading(self.version(), refusal=f"this column does not describe {kind}")
        return Reading(self.version(), model)

    def evaluate(self, file: ModelFile, states: Sequence[CanonicalState]) -> list[ModelQuantities]:
        """Compute the quantities with the engine's own routines, at states of what `read` returned."""
        with captured_output():
            layout = self.layout(self._load(file), file)
            return [layout.quantities(state) for state in states]

    @abstractmethod
    def _load(self, file: ModelFile) -> Any:
        """Load a file; raise one of `refusals` with the engine's words."""

    def _refusal_words(self, refusal: str, printed: Sequence[str]) -> str:
        return refusal or " ".join(printed)


@contextmanager
def captured_output() -> Iterator[list[str]]:
    """Collect what libraries print while a file is loaded.

    Yields:
        A list that holds the printed lines, without repetitions, at the end of the block.

    """
    lines: list[str] = []
    with tempfile.TemporaryFile() as sink:
        kept = [os.dup(1), os.dup(2)]
        try:
            os.dup2(sink.fileno(), 1)
            os.dup2(sink.fileno(), 2)
            yield lines
        finally:
            for descriptor, old in zip((1, 2), kept, strict=True):
                os.dup2(old, descriptor)
                os.close(old)
            sink.seek(0)
            text = _COLOURS.sub("", sink.read(200_000).decode(errors="replace"))
            lines.extend(list(dict.fromkeys(line.strip() for line in text.splitlines() if line.strip())))
            del lines[MAX_WARNINGS:]
