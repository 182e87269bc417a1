"""What MuJoCo reports of a tree besides the state quantities: sensors, Jacobians, momenta, inverse dynamics.

Each body has a site at its probe frame.  Velocities and accelerations of objects have the rotation first, in
the world's axes or the object's; accelerations are proper ones: MuJoCo's base accelerates with −g.  The mass
matrix counts the rotors (armature), `mj_rne` does not.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from plumbline.model.datatypes import Array, Float, Model, SurfaceAnswer
from plumbline.model.kinematics import rotation_matrix
from plumbline.model.probe_frames import PROBE_ATTITUDE, probe_points

SITE, BODY = "site", "body"
# By sensor the object that it is on, and its quantity.
SENSORS = {
    "FRAMEPOS": (SITE, "frame_position"),
    "FRAMEXAXIS": (SITE, "frame_axes"),
    "FRAMEYAXIS": (SITE, "frame_axes"),
    "FRAMEZAXIS": (SITE, "frame_axes"),
    "FRAMEQUAT": (SITE, "frame_axes"),
    "FRAMELINVEL": (SITE, "frame_velocity"),
    "VELOCIMETER": (SITE, "frame_velocity_local"),
    "FRAMEANGVEL": (SITE, "frame_angular_velocity"),
    "GYRO": (SITE, "frame_angular_velocity_local"),
    "FRAMELINACC": (SITE, "frame_proper_acceleration"),
    "ACCELEROMETER": (SITE, "frame_proper_acceleration_local"),
    "FRAMEANGACC": (SITE, "frame_angular_acceleration"),
    "FORCE": (SITE, "joint_force_local"),
    "TORQUE": (SITE, "joint_moment_local"),
    "SUBTREECOM": (BODY, "subtree_centre"),
    "SUBTREELINVEL": (BODY, "subtree_velocity"),
    "SUBTREEANGMOM": (BODY, "subtree_angular_momentum"),
}
AXES = ("FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS")
Found = dict[str, dict[str, Array]]


def add_probes(spec: Any, links: Sequence[Any], model: Model) -> None:
    """Add a site at the probe frame of every body, and all sensors."""
    objects = {SITE: mujoco.mjtObj.mjOBJ_SITE, BODY: mujoco.mjtObj.mjOBJ_BODY}
    for k, (link, point) in enumerate(zip(links, probe_points(model), strict=True)):
        site = link.add_site()
        site.name, site.pos, site.quat = f"probe {k}", point, PROBE_ATTITUDE
        link.name = f"link {k}"
        for name, (kind, _) in SENSORS.items():
            sensor = spec.add_sensor()
            sensor.name, sensor.type = f"{name} {k}", getattr(mujoco.mjtSensor, f"mjSENS_{name}")
            sensor.objtype = objects[kind]
            sensor.objname = site.name if kind == SITE else link.name


def surface_answer(m: Any, d: Any, links: Sequence[int], rates: Float[Array, "nv nu"]) -> SurfaceAnswer:
    """Read all after the forward dynamics at one state.

    Args:
        links: the engine's bodies.
        rates: takes ν to qvel.

    """
    found: Found = defaultdict(dict)
    sites = [m.site(f"probe {k}").id for k in range(len(links))]
    _add_sensors(found, m, d, len(links))
    _add_frames(found, m, d, links, sites)
    _add_momenta(found, m, d, links)
    _add_torques(found, m, d, rates)
    return found


def _add_sensors(found: Found, m: Any, d: Any, count: int) -> None:
    mujoco.mj_sensorPos(m, d)
    mujoco.mj_sensorVel(m, d)
    mujoco.mj_sensorAcc(m, d)
    read = {name: np.array([d.sensor(f"{name} {k}").data.copy() for k in range(count)]) for name in SENSORS}
    turn = rotation_matrix(read.pop("FRAMEQUAT"))
    axes = [read.pop(name) for name in AXES]
    found["frame_axes"] |= {
        "mjtSensor.mjSENS_FRAMEQUAT": turn.mT.reshape(-1, 3),
        ", ".join(f"mjtSensor.mjSENS_{name}" for name in AXES): np.stack(axes, 1).reshape(-1, 3),
    }
    for name, value in read.items():
        found[SENSORS[name][1]][f"mjtSensor.mjSENS_{name}"] = value


def _add_frames(found: Found, m: Any, d: Any, links: Sequence[int], sites: Sequence[int]) -> None:
    found["frame_position"]["MjData.site_xpos"] = d.site_xpos[sites].copy()
    found["frame_axes"]["MjData.site_xmat"] = d.site_xmat[sites].reshape(-1, 3, 3).mT.reshape(-1, 3).copy()
    found["body_position"] |= {"MjData.xpos": d.xpos[links].copy(), "MjData.xipos": d.xipos[links].copy()}
    spatial: dict[tuple[str, str, bool], list[Array]] = defaultdict(list)
    for site in sites:
        for is_local in (False, True):
            for what, function in (
                ("velocity", "mj_objectVelocity"),
                ("acceleration", "mj_objectAcceleration"),
            ):
                out = np.empty(6)
                getattr(mujoco, function)(m, d, mujoco.mjtObj.mjOBJ_SITE, site, out, int(is_local))
                spatial[what, function, is_local].append(out)
    for (what, function, is_local), values in spatial.items():
        suffix, vectors = "_local" * is_local, np.array(values)
        proper = "proper_" * (what == "acceleration")
        found[f"frame_{proper}{what}{suffix}"][function] = vectors[:, 3:].copy()
        found[f"frame_angular_{what}{suffix}"][function] = vectors[:, :3].copy()
    _add_jacobians(found, m, d, links, sites)


def _add_jacobians(found: Found, m: Any, d: Any, links: Sequence[int], sites: Sequence[int]) -> None:
    rows: dict[str, list[Array]] = defaultdict(list)
    for b, site in zip(links, sites, strict=True):
        p, r = np.zeros((2, 3, m.nv))
        mujoco.mj_jac(m, d, p, r, d.site_xpos[site], b)
        rows["mj_jac"].append(np.concatenate([p @ d.qvel, r @ d.qvel]))
        for call, number in (("mj_jacSite", site), ("mj_jacBody", b), ("mj_jacBodyCom", b)):
            getattr(mujoco, call)(m, d, p, r, number)
            rows[call].append(np.concatenate([p @ d.qvel, r @ d.qvel]))
        dp, dr = np.zeros((2, 3, m.nv))
        mujoco.mj_jacSite(m, d, p, r, site)
        mujoco.mj_jacDot(m, d, dp, dr, d.site_xpos[site], b)
        rows["mj_jacDot"].append(np.concatenate([dp @ d.qvel + p @ d.qacc, dr @ d.qvel + r @ d.qacc]))
        mujoco.mj_jacSubtreeCom(m, d, p, b)
        rows["mj_jacSubtreeCom"].append(p @ d.qvel)
        mujoco.mj_angmomMat(m, d, p, b)
        rows["mj_angmomMat"].append(p @ d.qvel)
    found["subtree_velocity"]["mj_jacSubtreeCom"] = np.array(rows.pop("mj_jacSubtreeCom"))
    found["subtree_angular_momentum"]["mj_angmomMat"] = np.array(rows.pop("mj_angmomMat"))
    for call, values in rows.items():
        vectors = np.array(values)
        what = "acceleration" if call == "mj_jacDot" else "velocity"
        place = "body" if call in ("mj_jacBody", "mj_jacBodyCom") else "frame"
        found[f"{place}_{what}"][call] = vectors[:, :3].copy()
        found[f"frame_angular_{what}"][call] = vectors[:, 3:].copy()


def _add_momenta(found: Found, m: Any, d: Any, links: Sequence[int]) -> None:
    found["subtree_centre"]["MjData.subtree_com"] = d.subtree_com[links].copy()
    found["subtree_velocity"]["MjData.subtree_linvel, mj_subtreeVel"] = d.subtree_linvel[links].copy()
    found["subtree_angular_momentum"]["MjData.subtree_angmom, mj_subtreeVel"] = d.subtree_angmom[links].copy()
    found["total_mass"] |= {"mj_getTotalmass": np.array([[mujoco.mj_getTotalmass(m)]])}
    found["centre_of_mass"]["MjData.subtree_com"] = d.subtree_com[:1].copy()
    found["centre_of_mass_velocity"]["MjData.subtree_linvel"] = d.subtree_linvel[:1].copy()
    found["centroidal_angular_momentum"]["MjData.subtree_angmom"] = d.subtree_angmom[:1].copy()


def _add_torques(found: Found, m: Any, d: Any, rates: Array) -> None:
    v, a = d.qvel.copy(), d.qacc.copy()
    rotors = m.dof_armature * a
    momentum, through, force, tau, gravity = np.zeros((5, m.nv))
    mujoco.mj_mulM(m, d, momentum, v)
    mujoco.mj_solveM(m, d, through[None], momentum[None])
    mujoco.mj_mulM(m, d, through, through.copy())
    mujoco.mj_mulM(m, d, force, a)
    mujoco.mj_rne(m, d, 1, tau)
    dynamics = {"mj_rne": tau.copy(), "MjData.qfrc_bias": d.qfrc_bias + force - rotors}
    mujoco.mj_inverse(m, d)
    dynamics["mj_inverse, MjData.qfrc_inverse"] = d.qfrc_inverse + d.qfrc_passive - rotors
    d.qvel[:] = 0.0
    mujoco.mj_fwdVelocity(m, d)
    mujoco.mj_rne(m, d, 0, gravity)
    for quantity, values in (
        ("generalized_momentum", {"mj_mulM": momentum}),
        ("momentum_through_inverse", {"mj_solveM": through}),
        ("generalized_gravity", {"mj_rne": gravity, "MjData.qfrc_bias, mj_fwdVelocity": d.qfrc_bias}),
        ("inverse_dynamics", dynamics),
    ):
        found[quantity] |= {call: (rates.T @ value)[:, None] for call, value in values.items()}
