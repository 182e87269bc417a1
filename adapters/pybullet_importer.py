"""PyBullet's importers of URDF and MJCF files.

A body of the reading is a link of a multibody.  Its frame follows from the pose of its inertial frame I:
X_B = X_I X_BI⁻¹, which PyBullet's own read-out does in single precision.  Axes and anchors are measured: the
pose of a link with its joint at one half and at zero gives the screw.

    hinge, slide    q = x
    free            `calculateMassMatrix` takes the base at the origin: v_e = (R_Iᵀ ω, R_Iᵀ (R_Bᵀ ṙ + ω × c))
                    with I's pose (R_I, c) in the base link

    M   calculateMassMatrix      h   calculateInverseDynamics, of fixed bases only; it takes gravity in the
                                     axes of the base's inertial frame, R_Iᵀ g

Massless links that the MJCF loader makes up for joints are merged into the link of the body.
URDF files are loaded with URDF_USE_INERTIA_FROM_FILE: without it PyBullet computes inertias from geometry.
Gravity is never a file's in PyBullet, the caller sets it: here −9.81 m/s² along z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar

import numpy as np
import pybullet as bullet

from adapters.importer_common import (
    LoadingImporter,
    Refused,
    free_joint_name,
    joint_from_screw,
    make_joint,
    merge_made_up_bodies,
    pose,
    pose_of_coordinates,
    quaternion_of,
    to_canonical,
)
from plumbline.importers.importer import ModelFile
from plumbline.importers.neutral_model import (
    CanonicalState,
    ElementaryJoint,
    ModelQuantities,
    NeutralBody,
    NeutralModel,
)
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import rotation_matrix

GRAVITY = (0.0, 0.0, -9.81)  # m/s²
PROBE = 0.5  # rad or m: displacement by which a joint's screw is measured
BASE = -1  # PyBullet's index of the base link


class PybulletImporter(LoadingImporter):
    """PyBullet's loadURDF and loadMJCF."""

    name = "pybullet"
    title = "PyBullet"
    package = "pybullet"
    formats = ("urdf", "mjcf")
    environment = ".importers"
    extra_requirements = (("<3.2.7", "numpy<2"),)
    unsupported: ClassVar[dict[str, str]] = {
        "passive_force": "PyBullet has no routine that returns the forces of dampers",
        "acceleration": "PyBullet has no routine that returns accelerations",
        "kinetic_energy": "PyBullet has no routine that returns energies",
        "potential_energy": "PyBullet has no routine that returns energies",
        "bias_force": "calculateInverseDynamics is used for fixed bases only",
        "gravity_force": "calculateInverseDynamics is used for fixed bases only",
    }

    def _load(self, file: ModelFile) -> Any:
        try:
            ids = _loaded(file)
        except bullet.error as error:
            ids = str(error)
        if isinstance(ids, str):
            raise Refused(ids)
        return ids

    def _describe(self, loaded: Any, file: ModelFile) -> NeutralModel:
        return NeutralModel("", _Layout(loaded, file).bodies, np.array(GRAVITY))

    def _evaluate(
        self, loaded: Any, file: ModelFile, states: Sequence[CanonicalState]
    ) -> list[ModelQuantities]:
        layout = _Layout(loaded, file)
        return [layout.quantities(state) for state in states]

    def _refusal_words(self, refusal: str, printed: Sequence[str]) -> str:
        return " ".join([refusal, *printed])


@cache
def _server() -> int:
    return int(bullet.connect(bullet.DIRECT))


def _loaded(file: ModelFile) -> Any:
    _server()
    bullet.resetSimulation()
    bullet.setGravity(*GRAVITY)
    if file.format == "mjcf":
        return list(bullet.loadMJCF(file.path))
    is_fixed = file.base == "fixed"
    return [bullet.loadURDF(file.path, useFixedBase=is_fixed, flags=bullet.URDF_USE_INERTIA_FROM_FILE)]


@dataclass(frozen=True, eq=False)
class _Place:
    """A joint of the reading and the link that it moves."""

    joint: ElementaryJoint
    body: int  # PyBullet's id of the multibody
    link: int


class _Layout:
    """Multibodies with the order of their links and joints in the reading."""

    def __init__(self, ids: Sequence[int], file: ModelFile) -> None:
        self.ids, self.file = ids, file
        self.places: list[_Place] = []
        self.links: list[tuple[int, int, str]] = []
        bodies: list[NeutralBody] = []
        for body in ids:
            infos = [bullet.getJointInfo(body, k) for k in range(bullet.getNumJoints(body))]
            index: dict[int, int] = {}
            for link in _depth_first([info[16] for info in infos]):
                index[link] = len(bodies)
                bodies.append(self._body(body, link, infos, index))
        self.bodies = tuple(merge_made_up_bodies(bodies, file))

    def _body(self, body: int, link: int, infos: list[Any], index: dict[int, int]) -> NeutralBody:
        mass, _, diagonal, center, turn = bullet.getDynamicsInfo(body, link)[:5]
        R = rotation_matrix(np.roll(turn, 1))
        joints: tuple[ElementaryJoint, ...] = ()
        if link == BASE:
            name, parent, zero = bullet.getBodyInfo(body)[0].decode(), -1, _link_pose(body, BASE)
            if mass > 0:  # a fixed base has no mass in Bullet
                joints = (make_joint(free_joint_name(name, self.file), "free"),)
        else:
            name, parent = infos[link][12].decode(), index[infos[link][16]]
            zero = np.linalg.inv(_link_pose(body, infos[link][16])) @ _link_pose(body, link)
            joints = self._joints(body, link, infos[link], zero)
        self.links.append((body, link, name))
        self.places += [_Place(joint, body, link) for joint in joints]
        return NeutralBody(
            name, parent, zero[:3, 3].copy(), quaternion_of(zero[:3, :3]), joints, float(mass),
            np.array(center), R @ np.diag(diagonal) @ R.T,
        )  # fmt: skip

    def _joints(self, body: int, link: int, info: Any, zero: Array) -> tuple[ElementaryJoint, ...]:
        name, kind = info[1].decode(), info[2]
        if kind == bullet.JOINT_FIXED:
            return ()
        if kind not in (bullet.JOINT_REVOLUTE, bullet.JOINT_PRISMATIC):
            raise NotImplementedError(f"joint {name!r} of PyBullet's type {kind}")
        bullet.resetJointState(body, link, PROBE)
        moved = np.linalg.inv(zero) @ np.linalg.inv(_link_pose(body, info[16])) @ _link_pose(body, link)
        bullet.resetJointState(body, link, 0.0)
        if kind == bullet.JOINT_PRISMATIC:
            joint = joint_from_screw(name, np.zeros(3), moved[:3, 3])
        else:
            R = moved[:3, :3]
            axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
            axis /= np.linalg.norm(axis)
            # moved = Trans(a) Rot Trans(−a): the part of a across the axis solves (1 − R) a = t
            anchor = np.asarray(np.linalg.lstsq(np.eye(3) - R, moved[:3, 3], rcond=1e-9)[0], float)
            joint = make_joint(name, "hinge", axis, anchor)
        return (replace(joint, damping=float(info[6]), friction_loss=float(info[7])),)

    def quantities(self, state: CanonicalState) -> ModelQuantities:
        """Evaluate PyBullet's routines at one state."""
        self._set_state(state)
        poses = {name: _link_pose(body, link)[:3] for body, link, name in self.links}
        poses = {name: pose(X[:, :3], X[:, 3]) for name, X in poses.items()}
        n = len(state.velocities)
        M, bias, gravity = np.zeros((n, n)), np.zeros(n), np.zeros(n)
        T = np.eye(n)
        is_fixed = True
        k = x = 0
        for body in self.ids:
            own = [place for place in self.places if place.body == body]
            if not own:
                continue
            base = 6 if own[0].joint.kind == "free" else 0
            count = base + sum(1 for place in own if place.link != BASE)
            if base:
                is_fixed = False
                T[k : k + 6, k : k + 6] = _base_map(body, state.coordinates[x : x + 7])
            q = list(state.coordinates[x + (7 if base else 0) : x + (7 if base else 0) + count - base])
            v = list(state.velocities[k + base : k + count])
            rows = slice(k, k + count)
            if q or base:
                M[rows, rows] = (
                    bullet.calculateMassMatrix(body, q) if bullet.getNumJoints(body) else _mass_of_base(body)
                )
            if q and not base:
                zero = [0.0] * len(q)
                bullet.setGravity(*(_matrix(*bullet.getBasePositionAndOrientation(body))[:3, :3].T @ GRAVITY))
                bias[rows] = bullet.calculateInverseDynamics(body, q, v, zero)
                gravity[rows] = bullet.calculateInverseDynamics(body, q, zero, zero)
            x, k = x + (7 if base else 0) + count - base, k + count
        found = ModelQuantities(poses, M, bias if is_fixed else None, gravity if is_fixed else None)
        return to_canonical(found, T, np.zeros(n))

    def _set_state(self, state: CanonicalState) -> None:
        x = 0
        for place in self.places:
            if place.joint.kind == "free":
                X = pose_of_coordinates(state.coordinates[x : x + 7]) @ _inertial_pose(place.body)
                turn = np.roll(quaternion_of(X[:3, :3]), -1)
                bullet.resetBasePositionAndOrientation(place.body, list(X[:3, 3]), list(turn))
                x += 7
            else:
                bullet.resetJointState(place.body, place.link, float(state.coordinates[x]))
                x += 1


def _base_map(body: int, x: Array) -> Array:
    """The map (6, 6) of a base's canonical velocities to Bullet's."""
    inertial, R_B = _inertial_pose(body), rotation_matrix(x[3:])
    R_I, c = inertial[:3, :3], inertial[:3, 3]
    across = np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])
    block = np.zeros((6, 6))
    block[:3, 3:], block[3:, :3], block[3:, 3:] = R_I.T, R_I.T @ R_B.T, -R_I.T @ across
    return block


def _mass_of_base(body: int) -> Array:
    """`calculateMassMatrix` needs a second link: of a single one it is what `getDynamicsInfo` says."""
    mass, _, diagonal = bullet.getDynamicsInfo(body, BASE)[:3]
    return np.diag([*diagonal, mass, mass, mass])


def _inertial_pose(body: int) -> Array:
    """Pose (4, 4) of the base's inertial frame in the base link."""
    return _matrix(*bullet.getDynamicsInfo(body, BASE)[3:5])


def _link_pose(body: int, link: int) -> Array:
    if link == BASE:
        X_I = _matrix(*bullet.getBasePositionAndOrientation(body))
        return np.asarray(X_I @ np.linalg.inv(_inertial_pose(body)))
    center = bullet.getLinkState(body, link, computeForwardKinematics=True)  # 4 and 5 are single precision
    inertial = _matrix(*bullet.getDynamicsInfo(body, link)[3:5])
    return np.asarray(_matrix(center[0], center[1]) @ np.linalg.inv(inertial))


def _matrix(position: Sequence[float], turn: Sequence[float]) -> Array:
    return pose_of_coordinates(np.array([*position, turn[3], *turn[:3]]))


def _depth_first(parents: Sequence[int]) -> list[int]:
    """The base and the links, parents first, children of a link together."""
    order: list[int] = []
    pending = [BASE]
    while pending:
        link = pending.pop()
        order.append(link)
        pending += [k for k in reversed(range(len(parents))) if parents[k] == link]
    return order
