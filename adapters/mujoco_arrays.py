"""What MuJoCo's arrays say of the motion of a tree, each read on its own, and products of them by ours.

Spatial vectors have the rotation first, in the world's axes, about the centre of mass of the tree that is
attached to the world; ``cinert`` and ``crb`` are (J_xx, J_yy, J_zz, J_xy, J_xz, J_yz, m c, m) about that
point.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from adapters.mujoco_common import structure_of, symmetric
from adapters.mujoco_probes import Probed
from plumbline.model.datatypes import Array, Float
from plumbline.model.kinematics import (
    cross,
    cross_matrix,
    quaternion_exponential,
    quaternion_product,
    rotate_vectors,
    rotation_matrix,
)
from plumbline.model.probe_frames import PROBE_TURN

SensorKinds = tuple[str, str]  # of a joint: what report its position and its rate


def _add_motions(s: Probed) -> None:
    m, d = s.m, s.d
    velocity, rates = np.zeros((2, m.nbody, 6))
    for b in range(1, m.nbody):
        own = slice(m.body_dofadr[b], m.body_dofadr[b] + m.body_dofnum[b])
        # subtrees of one root share the reference point
        velocity[b] = velocity[m.body_parentid[b]] + d.qvel[own] @ d.cdof[own]
        rates[b] = rates[m.body_parentid[b]] + d.qacc[own] @ d.cdof[own] + d.qvel[own] @ d.cdof_dot[own]
    _, speed = _at_point(s, d.cvel)
    turned = cross(d.cvel[s.links, :3], speed)
    for name, vectors, moving, added in (
        ("cvel", d.cvel, "velocity", 0.0),
        ("cdof", velocity, "velocity", 0.0),
        ("cacc", d.cacc, "proper_acceleration", turned),
        ("cdof_dot", rates, "acceleration", turned),
    ):
        spin, at = _at_point(s, vectors)
        s.add(f"frame_{moving}", f"MjData.{name}", at + added)
        s.add(f"frame_angular_{moving.removeprefix('proper_')}", f"MjData.{name}", spin)
    moved, roots = np.zeros((len(s.links), 6)), d.subtree_com[m.body_rootid[s.links]]
    for body, site, old, out in zip(s.links, s.sites, roots, moved, strict=True):
        mujoco.mju_transformSpatial(out, d.cvel[body], 0, d.site_xpos[site], old, d.site_xmat[site])
    quantities = "frame_angular_velocity_local", "frame_velocity_local"
    s.add_halves(quantities, "mju_transformSpatial", moved)


def _add_views(s: Probed) -> None:
    """Read by named views, and the sensors from the array of all."""
    s.add("body_position", "MjData.body", [s.d.body(b).xpos for b in s.links])
    s.add("frame_position", "MjData.site", [s.d.site(site).xpos for site in s.sites])
    for kind, quantity, read, size in (
        ("geom", "frame_position", "xpos", 1.0),
        ("camera", "frame_position", "xpos", 1.0),
        ("cam", "frame_position", "xpos", 1.0),
        ("tendon", "frame_distance", "length", 1.5),
        ("ten", "frame_distance", "length", 1.5),
        ("actuator", "frame_distance", "length", 3.0),
    ):
        views = [getattr(getattr(s.d, kind)(f"probe {k}"), read) for k in range(len(s.links))]
        s.add(quantity, f"MjData.{kind}", np.array([np.ravel(view) for view in views]) / size)
    s.add("frame_position", "MjData.sensor", s.sensors("FRAMEPOS"))


def _at_point(s: Probed, vectors: Array) -> tuple[Array, Array]:
    """Angular part, and linear part at the probe points, of a spatial vector per body."""
    lever = s.d.site_xpos[s.sites] - s.d.subtree_com[s.m.body_rootid[s.links]]
    own = vectors[s.links]
    return own[:, :3], own[:, 3:] + cross(own[:, :3], lever)


def _add_attitudes(s: Probed) -> None:
    d, inertial = s.d, rotation_matrix(s.m.body_iquat[s.links]).swapaxes(-1, -2) @ PROBE_TURN
    places, turns = np.zeros((len(s.links), 3)), np.zeros((len(s.links), 9))
    same, call = mujoco.mjtSameFrame.mjSAMEFRAME_NONE, "mj_local2Global mjtSameFrame"
    for site, body, place, turn in zip(s.sites, s.links, places, turns, strict=True):
        mujoco.mj_local2Global(d, place, turn, s.m.site_pos[site], s.m.site_quat[site], body, same)
    s.add_attitudes(call, turns)
    s.add("frame_position", call, places)
    for name in ("xquat", "xmat", "ximat", "xiquat", "site_xquat"):  # older versions lack the last
        of = None if name == "site_xquat" else inertial if name[1] == "i" else PROBE_TURN
        ids = s.sites if name == "site_xquat" else s.links
        s.add_attitudes(f"MjData.{name}", getattr(d, name)[ids], of)


def _own_motion(m: Any, d: Any, b: int, sensors: set[SensorKinds]) -> tuple[Array, Array, list[Array]]:
    """A body in its parent by what sensors report of its joints, whose kinds are noted.

    Returns:
        Position, attitude, and the angular velocities of the joints in the body's frame.

    """
    quat, moved = m.body_quat[b].copy(), m.body_pos[b].copy()
    rates = [np.zeros(3)]
    for j in _joints(m, b):
        if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:  # it has no sensor
            at = m.jnt_qposadr[j]
            moved, quat = d.qpos[at : at + 3], d.qpos[at + 3 : at + 7]
            rates.append(d.qvel[m.jnt_dofadr[j] + 3 :][:3])
            continue
        is_ball = m.jnt_type[j] == mujoco.mjtJoint.mjJNT_BALL
        kinds = ("BALLQUAT", "BALLANGVEL") if is_ball else ("JOINTPOS", "JOINTVEL")
        sensors.add(kinds)
        own, w = (d.sensor(f"{kind} {m.joint(j).name}").data for kind in kinds)
        if not is_ball:
            shift = (own[0] - m.qpos0[m.jnt_qposadr[j]]) * m.jnt_axis[j]
            if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE:
                moved = moved + rotation_matrix(quat) @ shift
                continue
            own, w = quaternion_exponential(shift / 2), w[0] * m.jnt_axis[j]
        rates = [rotation_matrix(own).T @ x for x in rates] + [w]
        near = moved + rotation_matrix(quat) @ m.jnt_pos[j]
        quat = quaternion_product(quat, own)
        moved = near - rotation_matrix(quat) @ m.jnt_pos[j]
    return moved, quat, rates


def _joints(m: Any, b: int) -> range:
    return range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b])


def _add_joint_frames(s: Probed) -> None:
    """Go from joint to joint by what sensors report of each, and by the frames of the joints."""
    m, d, links = s.m, s.d, s.links
    turn, (spin, place, along) = np.tile(np.eye(3), (m.nbody, 1, 1)), np.zeros((3, m.nbody, 3))
    sensors = set[SensorKinds]()
    for b in range(1, m.nbody):
        up = m.body_parentid[b]
        moved, quat, rates = _own_motion(m, d, b, sensors)
        own_turn, rate = rotation_matrix(quat), turn[up].T @ spin[up]
        turn[b], place[b] = turn[up] @ own_turn, place[up] + turn[up] @ moved
        spin[b] = turn[b] @ (own_turn.T @ rate + sum(rates))
        along[b] = spin[up]
        for j in _joints(m, b):
            if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE:
                along[b] = along[b] + d.qvel[m.jnt_dofadr[j]] * d.xaxis[j]
            elif m.jnt_type[j] != mujoco.mjtJoint.mjJNT_SLIDE:
                along[b] = along[b] + turn[b] @ rates[-1]
    if sensors:
        positions, turnings = (
            " ".join(f"mjtSensor.mjSENS_{kind}" for kind in kinds)
            for kinds in zip(*sorted(sensors), strict=True)
        )
        s.add("body_position", positions, place[links])
        s.add_axes(positions, turn[links] @ PROBE_TURN)
        s.add("frame_angular_velocity", turnings, spin[links])
    if np.any(m.jnt_type == mujoco.mjtJoint.mjJNT_HINGE):
        s.add("frame_angular_velocity", "MjData.xaxis", along[links])
    has_joint = m.body_jntnum[links] > 0
    if np.any(has_joint):
        _add_joint_views(s)
        anchored = d.xpos[links].copy()
        last = (m.body_jntadr[links] + m.body_jntnum[links] - 1)[has_joint]
        arms = rotate_vectors(d.xmat[links].reshape(-1, 3, 3)[has_joint], m.jnt_pos[last])
        # a slide moves the body after the anchor was found
        is_moved = m.jnt_type[last] == mujoco.mjtJoint.mjJNT_SLIDE
        anchored[has_joint] = np.where(is_moved[:, None], anchored[has_joint], d.xanchor[last] - arms)
        if not np.all(is_moved):
            s.add("body_position", "MjData.xanchor", anchored)


def _add_joint_views(s: Probed) -> None:
    """Add the velocities by views of joints."""
    for kind in ("joint", "jnt"):
        velocity = np.zeros((s.m.nbody, 6))
        for b in range(1, s.m.nbody):
            velocity[b] = velocity[s.m.body_parentid[b]]
            for j in _joints(s.m, b):
                one = getattr(s.d, kind)(j)
                velocity[b] += np.ravel(one.qvel) @ np.reshape(one.cdof, (-1, 6))
        s.add("frame_angular_velocity", f"MjData.{kind}", velocity[s.links, :3])


def spatial_inertia(ten: Float[Array, "10"]) -> Float[Array, "6 6"]:
    """The matrix of one of ``cinert`` or ``crb``."""
    moment = cross_matrix(ten[6:9])
    return np.block([[symmetric(ten[:6]), moment], [moment.T, ten[9] * np.eye(3)]])


def _add_inertias(s: Probed) -> None:
    """Kinetic energies by inertias of bodies, of composites, and by the factors of the mass matrix."""
    m, d, v = s.m, s.d, s.d.qvel
    rotors = float(m.dof_armature @ v**2)
    total = sum(d.cvel[b] @ spatial_inertia(d.cinert[b]) @ d.cvel[b] for b in range(1, m.nbody))
    s.add("kinetic_energy", "MjData.cinert", (total + rotors) / 2)
    total, d.crb[:] = rotors, 0.0
    mujoco.mj_crb(m, d)
    for i in range(m.nv):
        momentum, j = spatial_inertia(d.crb[m.dof_bodyid[i]]) @ d.cdof[i] * v[i], i
        total += momentum @ d.cdof[i] * v[i]
        while (j := m.dof_parentid[j]) >= 0:
            total += 2 * momentum @ d.cdof[j] * v[j]
    s.add("kinetic_energy", "mj_crb MjData.crb", total / 2)
    total, of = 0.0, structure_of(m, d, "M")
    for i, (at, count) in enumerate(zip(of.M_rowadr, of.M_rownnz, strict=True)):
        of_row = slice(at, at + count - 1)
        pivot = v[i] + d.qLD[of_row] @ v[of.M_colind[of_row]]
        total += d.qLD[at + count - 1] * pivot**2
    s.add("kinetic_energy", "MjData.qLD", total / 2)


def _add_wrenches(s: Probed) -> None:
    """Balance every body, from the last to the first: what its joint carries."""
    m, d = s.m, s.d
    wrench = np.zeros((m.nbody, 6))
    for b in reversed(range(1, m.nbody)):
        J = spatial_inertia(d.cinert[b])
        momentum, w, v = J @ d.cvel[b], d.cvel[b, :3], d.cvel[b, 3:]
        turned = np.append(cross(w, momentum[:3]) + cross(v, momentum[3:]), cross(w, momentum[3:]))
        wrench[b] += J @ d.cacc[b] + turned - d.cfrc_ext[b]
        wrench[m.body_parentid[b]] += wrench[b]
    lever = d.subtree_com[m.body_rootid[s.links]] - d.site_xpos[s.sites]
    local, force = d.site_xmat[s.sites].reshape(-1, 3, 3).swapaxes(-1, -2), wrench[s.links, 3:]
    moment = wrench[s.links, :3] + cross(lever, force)
    s.add("joint_force_local", "MjData.cfrc_ext", rotate_vectors(local, force))
    s.add("joint_moment_local", "MjData.cfrc_ext", rotate_vectors(local, moment))


# Add all after `mj_forward` and `mj_rnePostConstraint`.
ARRAYS = _add_motions, _add_views, _add_wrenches, _add_joint_frames, _add_inertias, _add_attitudes
