"""What MuJoCo's arrays say of the motion of a tree, each read on its own, and products of them by ours.

Spatial vectors have the rotation first, in the world's axes, about the centre of mass of the tree that is
attached to the world; ``cinert`` and ``crb`` are (J_xx, J_yy, J_zz, J_xy, J_xz, J_yz, m c, m) about that
point.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array, Call, Float
from plumbline.model.kinematics import quaternion_exponential, quaternion_product, rotation_matrix
from plumbline.model.probe_frames import PROBE_ATTITUDE

PROBE = rotation_matrix(PROBE_ATTITUDE)
Found = dict[str, dict[Call, Array]]
SCALAR = {mujoco.mjtJoint.mjJNT_HINGE: "HINGE", mujoco.mjtJoint.mjJNT_SLIDE: "SLIDE"}


def add_arrays(found: Found, m: Any, d: Any, links: Sequence[int], sites: Sequence[int]) -> None:
    """Add all after `mj_forward` and `mj_rnePostConstraint`; all answers are of the bodies ``links``."""
    add_parts(
        found,
        lambda: _add_motions(found, m, d, links, sites),
        lambda: _add_views(found, d, links, sites),
        lambda: _add_wrenches(found, m, d, links, sites),
        lambda: _add_joint_frames(found, m, d, links),
        lambda: _add_inertias(found, m, d),
        lambda: _add_attitudes(found, m, d, links, sites),
    )


def _add_motions(found: Found, m: Any, d: Any, links: Sequence[int], sites: Sequence[int]) -> None:
    point, root = d.site_xpos[sites], d.subtree_com[m.body_rootid[links]]
    velocity, dots = np.zeros((2, m.nbody, 6))
    for b in range(1, m.nbody):
        own = slice(m.body_dofadr[b], m.body_dofadr[b] + m.body_dofnum[b])
        # subtrees of one root share the reference point
        velocity[b] = velocity[m.body_parentid[b]] + d.qvel[own] @ d.cdof[own]
        dots[b] = dots[m.body_parentid[b]] + d.qacc[own] @ d.cdof[own] + d.qvel[own] @ d.cdof_dot[own]
    for name, vectors in (("cvel", d.cvel), ("cdof", velocity)):
        spin, at = _at_point(vectors[links], point - root)
        found["frame_velocity"][f"MjData.{name}",] = at
        found["frame_angular_velocity"][f"MjData.{name}",] = spin
    lever, speed = point - root, found["frame_velocity"]["MjData.cvel",]
    for name, vectors in (("cacc", d.cacc), ("cdof_dot", dots)):
        spin, at = _at_point(vectors[links], lever)
        quantity = "frame_proper_acceleration" if name == "cacc" else "frame_acceleration"
        found[quantity][f"MjData.{name}",] = at + np.cross(d.cvel[links, :3], speed)
        found["frame_angular_acceleration"][f"MjData.{name}",] = spin.copy()
    _add_spatial_transforms(found, d, links, sites, root)


def _add_spatial_transforms(
    found: Found, d: Any, links: Sequence[int], sites: Sequence[int], root: Array
) -> None:
    moved = np.zeros((len(links), 6))
    for body, site, old, out in zip(links, sites, root, moved, strict=True):
        mujoco.mju_transformSpatial(out, d.cvel[body], 0, d.site_xpos[site], old, d.site_xmat[site])
    found["frame_angular_velocity_local"]["mju_transformSpatial",] = moved[:, :3]
    found["frame_velocity_local"]["mju_transformSpatial",] = moved[:, 3:]


def _add_views(found: Found, d: Any, links: Sequence[int], sites: Sequence[int]) -> None:
    """Read by named views, and the sensors from the array of all."""
    found["body_position"]["MjData.body",] = np.array([d.body(b).xpos.copy() for b in links])
    found["frame_position"]["MjData.site",] = np.array([d.site(s).xpos.copy() for s in sites])
    count = range(len(links))
    for kind, quantity, read, size in (
        ("geom", "frame_position", "xpos", 1.0),
        ("camera", "frame_position", "xpos", 1.0),
        ("cam", "frame_position", "xpos", 1.0),
        ("tendon", "frame_distance", "length", 1.5),
        ("ten", "frame_distance", "length", 1.5),
        ("actuator", "frame_distance", "length", 3.0),
    ):
        views = [getattr(getattr(d, kind)(f"probe {k}"), read) for k in count]
        found[quantity][f"MjData.{kind}",] = np.array([np.ravel(view) for view in views]) / size
    value = np.array([d.sensor(f"FRAMEPOS {k}").data.copy() for k in count])
    found["frame_position"]["MjData.sensor",] = value


def _at_point(vectors: Float[Array, "n 6"], lever: Float[Array, "n 3"]) -> tuple[Array, Array]:
    return vectors[:, :3].copy(), vectors[:, 3:] + np.cross(vectors[:, :3], lever)


def _axes(turn: Array) -> Array:
    """Rows of the axes of the probe frames, of attitudes (N, 3, 3) of bodies."""
    return np.asarray((turn @ PROBE).mT.reshape(-1, 3))


def _add_attitudes(found: Found, m: Any, d: Any, links: Sequence[int], sites: Sequence[int]) -> None:
    none, inertial = np.broadcast_to(np.eye(3), (len(links), 3, 3)), rotation_matrix(m.body_iquat[links])
    probe = np.broadcast_to(PROBE, none.shape)
    for name, own, ids in (
        ("site_xquat", probe, sites), ("xquat", none, links), ("xmat", none, links),
        ("xiquat", inertial, links), ("ximat", inertial, links),
    ):  # fmt: skip
        turn = getattr(d, name)[ids]
        turn = rotation_matrix(turn) if name.endswith("quat") else turn.reshape(-1, 3, 3)
        found["frame_axes"][f"MjData.{name}",] = _axes(turn @ own.mT)
    places, turns = np.zeros((len(links), 3)), np.zeros((len(links), 9))
    same = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    for site, body, place, turn in zip(sites, links, places, turns, strict=True):
        mujoco.mj_local2Global(d, place, turn, m.site_pos[site], m.site_quat[site], body, same)
    found["frame_axes"]["mj_local2Global", "mjtSameFrame"] = turns.reshape(-1, 3, 3).mT.reshape(-1, 3)
    found["frame_position"]["mj_local2Global", "mjtSameFrame"] = places


def _own_motion(m: Any, d: Any, b: int, sensors: set[str]) -> tuple[Array, Array, list[Array]]:
    """A body in its parent by what sensors report of its joints, whose kinds are noted.

    Returns:
        Position, attitude, and the angular velocities of the joints in the body's frame.

    """
    quat, moved = m.body_quat[b].copy(), m.body_pos[b].copy()
    joints = range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b])
    rates = [np.zeros(3)]
    for j in joints:
        name = SCALAR.get(mujoco.mjtJoint(m.jnt_type[j]))
        if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:  # it has no sensor
            at = m.jnt_qposadr[j]
            moved, quat = d.qpos[at : at + 3], d.qpos[at + 3 : at + 7]
            rates.append(d.qvel[m.jnt_dofadr[j] + 3 :][:3])
            continue
        if name is None:
            sensors |= {"BALLQUAT", "BALLANGVEL"}
            own, w = (d.sensor(f"{kind} {m.joint(j).name}").data for kind in ("BALLQUAT", "BALLANGVEL"))
            rates = [rotation_matrix(own).T @ x for x in rates] + [w]
        else:
            sensors |= {"JOINTPOS", "JOINTVEL"}
            q, v = (float(d.sensor(f"{kind} {m.joint(j).name}").data[0]) for kind in ("JOINTPOS", "JOINTVEL"))
            q -= m.qpos0[m.jnt_qposadr[j]]
            if name == "SLIDE":
                moved = moved + rotation_matrix(quat) @ (q * m.jnt_axis[j])
                continue
            own = quaternion_exponential(q * m.jnt_axis[j] / 2)
            rates = [rotation_matrix(own).T @ x for x in rates] + [v * m.jnt_axis[j]]
        near = moved + rotation_matrix(quat) @ m.jnt_pos[j]
        quat = quaternion_product(quat, own)
        moved = near - rotation_matrix(quat) @ m.jnt_pos[j]
    return moved, quat, rates


def _add_joint_frames(found: Found, m: Any, d: Any, links: Sequence[int]) -> None:
    """Go from joint to joint by what sensors report of each, and by the frames of the joints."""
    turn, spin = np.broadcast_to(np.eye(3), (m.nbody, 3, 3)).copy(), np.zeros((m.nbody, 3))
    place, along = np.zeros((m.nbody, 3)), np.zeros((m.nbody, 3))
    sensors = set[str]()
    for b in range(1, m.nbody):
        up = m.body_parentid[b]
        moved, quat, rates = _own_motion(m, d, b, sensors)
        rate = turn[up].T @ spin[up]
        joints = range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b])
        own_turn = rotation_matrix(quat)
        turn[b], place[b] = turn[up] @ own_turn, place[up] + turn[up] @ moved
        spin[b] = turn[b] @ (own_turn.T @ rate + sum(rates))
        along[b] = spin[up]
        for j in joints:
            if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE:
                along[b] = along[b] + d.qvel[m.jnt_dofadr[j]] * d.xaxis[j]
            elif m.jnt_type[j] != mujoco.mjtJoint.mjJNT_SLIDE:
                along[b] = along[b] + turn[b] @ rates[-1]
    by = tuple(f"mjtSensor.mjSENS_{kind}" for kind in sorted(sensors))
    positions = tuple(x for x in by if x.endswith(("POS", "QUAT")))
    if by:
        found["body_position"][positions], found["frame_axes"][positions] = place[links], _axes(turn[links])
        found["frame_angular_velocity"][tuple(x for x in by if x not in positions)] = spin[links]
    if np.any(m.jnt_type == mujoco.mjtJoint.mjJNT_HINGE):
        found["frame_angular_velocity"]["MjData.xaxis",] = along[links]
    has_joint = m.body_jntnum[links] > 0
    if np.any(has_joint):
        _add_joint_views(found, m, d, links)
        anchored = d.xpos[links].copy()
        last = (m.body_jntadr[links] + m.body_jntnum[links] - 1)[has_joint]
        arms = np.matvec(d.xmat[links].reshape(-1, 3, 3)[has_joint], m.jnt_pos[last])
        anchored[has_joint] = d.xanchor[last] - arms
        # a slide moves the body after the anchor was found
        is_moved = m.jnt_type[last] == mujoco.mjtJoint.mjJNT_SLIDE
        anchored[np.flatnonzero(has_joint)[is_moved]] = d.xpos[links][has_joint][is_moved]
        if not np.all(is_moved):
            found["body_position"]["MjData.xanchor",] = anchored


def _add_joint_views(found: Found, m: Any, d: Any, links: Sequence[int]) -> None:
    """Add the velocities by views of joints."""
    for kind in ("joint", "jnt"):
        velocity = np.zeros((m.nbody, 6))
        for b in range(1, m.nbody):
            velocity[b] = velocity[m.body_parentid[b]]
            for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]):
                one = getattr(d, kind)(j)
                velocity[b] += np.ravel(one.qvel) @ np.reshape(one.cdof, (-1, 6))
        found["frame_angular_velocity"][f"MjData.{kind}",] = velocity[links, :3]


def spatial_inertia(ten: Float[Array, "10"]) -> Float[Array, "6 6"]:
    """The matrix of one of ``cinert`` or ``crb``."""
    xx, yy, zz, xy, xz, yz, *moment, mass = ten
    x, y, z = moment
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.block([[J, cross], [cross.T, mass * np.eye(3)]])


def _add_inertias(found: Found, m: Any, d: Any) -> None:
    """Kinetic energies by inertias of bodies, of composites, and by the factors of the mass matrix."""
    energy = found["kinetic_energy"]
    v = d.qvel
    rotors = float(m.dof_armature @ v**2)
    total = sum(d.cvel[b] @ spatial_inertia(d.cinert[b]) @ d.cvel[b] for b in range(1, m.nbody))
    energy["MjData.cinert",] = np.array([[(total + rotors) / 2]])
    total, d.crb[:] = rotors, 0.0
    mujoco.mj_crb(m, d)
    for i in range(m.nv):
        momentum, j = spatial_inertia(d.crb[m.dof_bodyid[i]]) @ d.cdof[i] * v[i], i
        total += momentum @ d.cdof[i] * v[i]
        while (j := m.dof_parentid[j]) >= 0:
            total += 2 * momentum @ d.cdof[j] * v[j]
    energy["mj_crb", "MjData.crb"] = np.array([[total / 2]])
    total = 0.0
    for i, (at, count) in enumerate(zip(m.M_rowadr, m.M_rownnz, strict=True)):
        of_row = slice(at, at + count - 1)
        pivot = v[i] + d.qLD[of_row] @ v[m.M_colind[of_row]]
        total += d.qLD[at + count - 1] * pivot**2
    energy["MjData.qLD",] = np.array([[total / 2]])


def _add_wrenches(found: Found, m: Any, d: Any, links: Sequence[int], sites: Sequence[int]) -> None:
    """Balance every body, from the last to the first: what its joint carries."""
    wrench = np.zeros((m.nbody, 6))
    for b in reversed(range(1, m.nbody)):
        J = spatial_inertia(d.cinert[b])
        momentum, w, v = J @ d.cvel[b], d.cvel[b, :3], d.cvel[b, 3:]
        turned = np.append(np.cross(w, momentum[:3]) + np.cross(v, momentum[3:]), np.cross(w, momentum[3:]))
        wrench[b] += J @ d.cacc[b] + turned - d.cfrc_ext[b]
        wrench[m.body_parentid[b]] += wrench[b]
    lever = d.subtree_com[m.body_rootid[links]] - d.site_xpos[sites]
    local = d.site_xmat[sites].reshape(-1, 3, 3).mT
    moment = wrench[links, :3] + np.cross(lever, wrench[links, 3:])
    found["joint_force_local"]["MjData.cfrc_ext",] = np.matvec(local, wrench[links, 3:])
    found["joint_moment_local"]["MjData.cfrc_ext",] = np.matvec(local, moment)
