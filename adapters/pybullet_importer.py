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
from functools import cache
from typing import Any, ClassVar

import numpy as np
import pybullet as bullet

from adapters.importer_common import (
    LayoutWithOwnVelocities,
    LoadingImporter,
    depth_first,
    joint_from_screw,
    make_body,
    make_joint,
    merge_made_up_bodies,
    pose_of_coordinates,
)
from plumbline.importers.importer import ModelFile
from plumbline.importers.neutral_model import ElementaryJoint, ModelQuantities, NeutralBody
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import cross_matrix, quaternion_of, rotation_matrix

GRAVITY = (0.0, 0.0, -9.81)  # m/s²
PROBE = 0.5  # rad or m: displacement by which a joint's screw is measured
BASE = -1  # PyBullet's index of the base link


class _Layout(LayoutWithOwnVelocities):
    """Multibodies; a joint's own: PyBullet's id of its multibody, and the link that it moves."""

    def _gravity(self) -> Any:
        return GRAVITY

    def _bodies(self) -> list[NeutralBody]:
        self.links: list[tuple[int, int, str]] = []
        bodies: list[NeutralBody] = []
        for body in self.loaded:
            infos = [bullet.getJointInfo(body, k) for k in range(bullet.getNumJoints(body))]
            links = range(len(infos))
            below = {link: [k for k in links if infos[k][16] == link] for link in (BASE, *links)}
            index: dict[int, int] = {}
            for link in depth_first([BASE], below.__getitem__):
                index[link] = len(bodies)
                bodies.append(self._body(body, link, infos, index))
        return merge_made_up_bodies(bodies, self.file)

    def _body(self, body: int, link: int, infos: list[Any], index: dict[int, int]) -> NeutralBody:
        mass, _, diagonal, center, turn = bullet.getDynamicsInfo(body, link)[:5]
        R = rotation_matrix(np.roll(turn, 1))
        if link == BASE:
            name, parent, zero = bullet.getBodyInfo(body)[0].decode(), -1, _link_pose(body, BASE)
            joints = [self._free_joint(name)] if mass > 0 else []  # a fixed base has no mass in Bullet
        else:
            name, parent = infos[link][12].decode(), index[infos[link][16]]
            zero = np.linalg.inv(_link_pose(body, infos[link][16])) @ _link_pose(body, link)
            joints = self._joints(body, link, infos[link], zero)
        self.links.append((body, link, name))
        for joint in joints:
            row = self.places[-1][1].stop if self.places else 0
            rows = slice(row, row + (6 if joint.kind == "free" else 1))
            self.places.append(((body, link), rows))
        return make_body(name, parent, zero, joints, mass, center, R @ np.diag(diagonal) @ R.T)

    def _joints(self, body: int, link: int, info: Any, zero: Array) -> list[ElementaryJoint]:
        name, kind, numbers = info[1].decode(), info[2], {"damping": info[6], "friction_loss": info[7]}
        if kind == bullet.JOINT_FIXED:
            return []
        if kind not in (bullet.JOINT_REVOLUTE, bullet.JOINT_PRISMATIC):
            raise NotImplementedError(f"joint {name!r} of PyBullet's type {kind}")
        bullet.resetJointState(body, link, PROBE)
        moved = np.linalg.inv(zero) @ np.linalg.inv(_link_pose(body, info[16])) @ _link_pose(body, link)
        bullet.resetJointState(body, link, 0.0)
        if kind == bullet.JOINT_PRISMATIC:
            return [joint_from_screw(name, np.zeros(3), moved[:3, 3], **numbers)]
        R = moved[:3, :3]
        axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        axis /= np.linalg.norm(axis)
        # moved = Trans(a) Rot Trans(−a): the part of a across the axis solves (1 − R) a = t
        anchor = np.linalg.lstsq(np.eye(3) - R, moved[:3, 3], rcond=1e-9)[0]
        return [make_joint(name, "hinge", axis, anchor, **numbers)]

    def _move(self, joint: ElementaryJoint, own: Any, x: Array, v: Array) -> tuple[Any, Any]:
        body, link = own
        if joint.kind != "free":
            bullet.resetJointState(body, link, float(x[0]))
            return 1.0, 0.0
        inertial, R_B = _inertial_pose(body), rotation_matrix(x[3:])
        X = pose_of_coordinates(x) @ inertial
        turn = np.roll(quaternion_of(X[:3, :3]), -1)
        bullet.resetBasePositionAndOrientation(body, list(X[:3, 3]), list(turn))
        R_I, c = inertial[:3, :3], inertial[:3, 3]
        block = np.zeros((6, 6))
        block[:3, 3:], block[3:, :3], block[3:, 3:] = R_I.T, R_I.T @ R_B.T, -R_I.T @ cross_matrix(c)
        return block, 0.0

    def _engine_quantities(self, v: Array) -> ModelQuantities:
        poses = {name: _link_pose(body, link)[:3] for body, link, name in self.links}
        n, is_fixed = len(v), not any(link == BASE for (_, link), _ in self.places)
        M, bias, gravity = np.zeros((n, n)), np.zeros(n), np.zeros(n)
        for body in self.loaded:
            own = [(link, rows) for (b, link), rows in self.places if b == body]
            if not own:
                continue
            rows = slice(own[0][1].start, own[-1][1].stop)
            q = [bullet.getJointState(body, link)[0] for link, _ in own if link != BASE]
            is_single = not bullet.getNumJoints(body)
            M[rows, rows] = _mass_of_base(body) if is_single else bullet.calculateMassMatrix(body, q)
            if own[0][0] != BASE:
                zero = [0.0] * len(q)
                bullet.setGravity(*(_matrix(*bullet.getBasePositionAndOrientation(body))[:3, :3].T @ GRAVITY))
                bias[rows] = bullet.calculateInverseDynamics(body, q, v[rows].tolist(), zero)
                gravity[rows] = bullet.calculateInverseDynamics(body, q, zero, zero)
        return ModelQuantities(poses, M, bias if is_fixed else None, gravity if is_fixed else None)


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
    layout = _Layout
    refusals = (bullet.error,)

    def _load(self, file: ModelFile) -> Any:
        _server()
        bullet.resetSimulation()
        bullet.setGravity(*GRAVITY)
        if file.format == "mjcf":
            return list(bullet.loadMJCF(file.path))
        is_fixed, flags = file.base == "fixed", bullet.URDF_USE_INERTIA_FROM_FILE
        return [bullet.loadURDF(file.path, useFixedBase=is_fixed, flags=flags)]

    def _refusal_words(self, refusal: str, printed: Sequence[str]) -> str:
        return " ".join([refusal, *printed])


@cache
def _server() -> int:
    return int(bullet.connect(bullet.DIRECT))


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
        return X_I @ np.linalg.inv(_inertial_pose(body))
    center = bullet.getLinkState(body, link, computeForwardKinematics=True)  # 4 and 5 are single precision
    inertial = _matrix(*bullet.getDynamicsInfo(body, link)[3:5])
    return _matrix(center[0], center[1]) @ np.linalg.inv(inertial)


def _matrix(position: Sequence[float], turn: Sequence[float]) -> Array:
    return pose_of_coordinates(np.array([*position, turn[3], *turn[:3]]))
