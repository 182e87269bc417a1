"""What MuJoCo reports of a tree besides the state quantities: sensors, Jacobians, momenta, inverse dynamics.

Each body has a site at its probe frame.  Velocities and accelerations of objects have the rotation first, in
the world's axes or the object's; accelerations are proper ones: MuJoCo's base accelerates with −g.  The mass
matrix counts the rotors (armature), `mj_rne` does not.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from copy import copy
from typing import Any

import mujoco
import numpy as np

from adapters.mujoco_arrays import add_arrays
from adapters.pose_functions import Pose, rate_maps
from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array, Call, Float, Model
from plumbline.model.kinematics import quaternion_product, rotation_matrix
from plumbline.model.probe_frames import PROBE_ATTITUDE, anchor_point, probe_points

SITE, BODY = "site", "body"
ANCHOR = "anchor"  # site of the world, with the attitude of probe frames
SENSOR_CLASSES = ("MjsSensor", "mjtSensor")
TENDON_CLASSES = ("MjsTendon", "MjsTendonPath", "MjsWrap", "mjtWrap")
WRAPS = ("mjtWrap.mjWRAP_SITE", "mjtWrap.mjWRAP_PULLEY")
# By sensor that refers to the first probe frame its quantity.
RELATIVE_SENSORS = {
    "FRAMEPOS": "frame_position_in_first",
    "FRAMEQUAT": "frame_axes_in_first",
    "FRAMELINVEL": "frame_velocity_in_first",
    "FRAMEANGVEL": "frame_angular_velocity_in_first",
}
# By sensor of distances from the anchor its quantity, and what one metre of a distance is there.
DISTANCE_SENSORS = {
    "TENDONPOS": ("TENDON", "frame_distance", 1.5),
    "TENDONVEL": ("TENDON", "frame_distance_rate", 1.5),
    "ACTUATORPOS": ("ACTUATOR", "frame_distance", 3.0),
    "ACTUATORVEL": ("ACTUATOR", "frame_distance_rate", 3.0),
}
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
JOINT_SENSORS, BALL_SENSORS = ("JOINTPOS", "JOINTVEL"), ("BALLQUAT", "BALLANGVEL")
ENERGIES = ("E_KINETIC", "E_POTENTIAL")
AXES = ("FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS")
# By function of an object's motion the quantities of its two halves, rotation and point.
OBJECT_MOTIONS = {
    "mj_objectVelocity": ("frame_angular_velocity", "frame_velocity"),
    "mj_objectAcceleration": ("frame_angular_acceleration", "frame_proper_acceleration"),
}
# By function of a Jacobian the quantities of its two parts, point and rotation.
JACOBIANS = {
    "mj_jac": ("frame_velocity", "frame_angular_velocity"),
    "mj_jacSite": ("frame_velocity", "frame_angular_velocity"),
    "mj_jacGeom": ("frame_velocity", "frame_angular_velocity"),
    "mj_jacBody": ("body_velocity", "frame_angular_velocity"),
    "mj_jacBodyCom": ("body_velocity", "frame_angular_velocity"),
    "mj_jacPointAxis": ("frame_velocity",),
    "mj_jacDot": ("frame_acceleration", "frame_angular_acceleration"),
    "mj_jacSubtreeCom": ("subtree_velocity",),
    "mj_angmomMat": ("subtree_angular_momentum",),
}
# Calls that leave the forces of inverse dynamics.
INVERSES = (("mj_inverse",), ("mj_inverseSkip",))
INVERSE_STAGES = ("mj_invPosition", "mj_invVelocity", "mj_invConstraint")
Found = dict[str, dict[Call, Array]]
SENSOR_STAGES = ("mj_sensorPos", "mj_sensorVel", "mj_sensorAcc")
# adapters/pose_functions.py describes the forms
POSE_FUNCTIONS = {
    "mju_axisAngle2Quat": "axis angle -> p", "mju_euler2Quat": "xyz 'xyz' -> p", "mju_mat2Quat": "R -> p",
    "mju_mulPose": "L.r L.p Q.r Q.p -> r p", "mju_mulQuat": "L.p Q.p -> p",
    "mju_mulQuatAxis": "Q.p wl -> 2pdot",
    "mju_negPose": "I.r I.p -> r p", "mju_negQuat": "I.p -> p", "mju_quat2Mat": "p -> R",
    "mju_quat2Vel": "Q.p 1 -> Q.phi", "mju_rotVecQuat": "wl Q.p -> w", "mju_trnVecPose": "L.r L.p Q.r -> r",
    "mju_derivQuat": "Q.p w -> pdot", "mju_subQuat": "Q.p M.p -> K.phi",
    "mju_quatIntegrate": "M.p K.phi 1 -> Q.p", "mju_quatZ2Vec": "R -> p",
    "mjd_quatIntegrate": "K.phi 1 -> K.R", "mjd_subQuat": "Q.p M.p K.p wl -> wl",
}  # fmt: skip
SIZES = {"p": 4, "R": 9, "r": 3, "phi": 3, "w": 3, "pdot": 4, "2pdot": 4}


def pose_function(name: str, given: Sequence[Any], forms: Sequence[str]) -> list[Any]:
    """Call a function of attitudes or poses; its results come first."""
    if name == "mju_quatZ2Vec":  # the turn about that axis is free
        q, R = np.empty(4), given[0]
        mujoco.mju_quatZ2Vec(q, np.ascontiguousarray(R[:, 2]))
        rest = rotation_matrix(q).T @ R
        half = np.arctan2(rest[1, 0], rest[0, 0]) / 2
        return [quaternion_product(q, np.array([np.cos(half), 0.0, 0.0, np.sin(half)]))]
    if name == "mjd_subQuat":
        q, other, between, spin = given
        of_first = np.zeros((3, 3))
        mujoco.mjd_subQuat(q, other, of_first, None)
        return [rate_maps(Pose(np.zeros(3), between))["phidot"] @ of_first @ spin]
    if name == "mjd_quatIntegrate":
        by_turn, by_velocity, by_scale = np.empty(9), np.empty(9), np.empty(3)
        mujoco.mjd_quatIntegrate(*given, by_turn, by_velocity, by_scale)
        return [by_turn.reshape(3, 3).T]
    arguments = [np.ravel(x) if isinstance(x, np.ndarray) else x for x in given]
    results = [np.empty(SIZES[form.rpartition(".")[2]]) for form in forms]
    if name == "mju_quatIntegrate":  # in place
        results = [arguments.pop(0).copy()]
    getattr(mujoco, name)(*results, *arguments)
    return results


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
    for name in ENERGIES if hasattr(mujoco.mjtSensor, "mjSENS_E_KINETIC") else ():
        sensor = spec.add_sensor()
        sensor.name, sensor.type = name, getattr(mujoco.mjtSensor, f"mjSENS_{name}")
    _add_joint_sensors(spec)
    _add_relative_probes(spec, links, model)


def _add_relative_probes(spec: Any, links: Sequence[Any], model: Model) -> None:
    """Add to every probe frame a geom and a camera, sensors that refer to the first, and a tendon.

    The tendon is slack: from the anchor to the probe frame and, behind a pulley that halves it, back.
    Actuators without a force are on it and between the two frames.
    """
    anchor = spec.worldbody.add_site()
    anchor.name, anchor.pos, anchor.quat = ANCHOR, anchor_point(model), PROBE_ATTITUDE
    for k, (link, point) in enumerate(zip(links, probe_points(model), strict=True)):
        for one in (link.add_geom(), link.add_camera()):
            one.name, one.pos, one.quat = f"probe {k}", point, PROBE_ATTITUDE
        shape = link.geoms[-1]
        shape.size[0], shape.contype, shape.conaffinity, shape.mass = 1e-3, 0, 0, 0.0
        for name in RELATIVE_SENSORS:
            sensor = _sensor(spec, f"{name} in first {k}", name, "SITE", f"probe {k}")
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_SITE, "probe 0"
        tendon = spec.add_tendon()
        tendon.name, tendon.limited = f"probe {k}", mujoco.mjtLimited.mjLIMITED_TRUE
        tendon.range = [0.0, 1e3 * (1.0 + float(np.linalg.norm(anchor.pos)))]  # it is not reached
        for end in (ANCHOR, f"probe {k}", "", f"probe {k}", ANCHOR):
            _ = tendon.wrap_site(end) if end else tendon.wrap_pulley(2.0)
        _actuator(spec, f"probe {k}", "TENDON", f"probe {k}", 2.0 * np.eye(6)[0])
        for i, gear in enumerate(np.eye(6)[:3]):
            _actuator(spec, f"probe {k} {i}", "SITE", f"probe {k}", gear).refsite = ANCHOR
        for name in ("TENDONLIMITPOS", "TENDONLIMITVEL"):
            _sensor(spec, f"{name} {k}", name, "TENDON", f"probe {k}")
        for name, (kind, _, _) in DISTANCE_SENSORS.items():
            _sensor(spec, f"{name} {k}", name, kind, f"probe {k}")


def _sensor(spec: Any, name: str, kind: str, of: str, target: str) -> Any:
    sensor = spec.add_sensor()
    sensor.name, sensor.type = name, getattr(mujoco.mjtSensor, f"mjSENS_{kind}")
    sensor.objtype, sensor.objname = getattr(mujoco.mjtObj, f"mjOBJ_{of}"), target
    return sensor


def _actuator(spec: Any, name: str, transmission: str, target: str, gear: Array) -> Any:
    actuator = spec.add_actuator()
    actuator.name, actuator.target, actuator.gear = name, target, gear
    actuator.trntype = getattr(mujoco.mjtTrn, f"mjTRN_{transmission}")
    return actuator


def _add_joint_sensors(spec: Any) -> None:
    """Add sensors of all joints but free ones, named by the joint's name."""
    kinds = {mujoco.mjtJoint.mjJNT_BALL: BALL_SENSORS, mujoco.mjtJoint.mjJNT_FREE: ()}
    joints = [joint for body in spec.bodies for joint in body.joints]
    for j, joint in enumerate(joints):
        joint.name = joint.name or f"joint {j}"
        for name in kinds.get(joint.type, JOINT_SENSORS):
            sensor = spec.add_sensor()
            sensor.name, sensor.type = f"{name} {joint.name}", getattr(mujoco.mjtSensor, f"mjSENS_{name}")
            sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_JOINT, joint.name


def surface_answer(
    m: Any, d: Any, links: Sequence[int], rates: Float[Array, "nv nu"], elastic: float
) -> Found:
    """Read all after the forward dynamics at one state.

    Args:
        links: the engine's bodies.
        rates: takes ν to qvel.
        elastic: energy of the springs [J].

    """
    found: Found = defaultdict(dict)
    sites = [m.site(f"probe {k}").id for k in range(len(links))]
    add_parts(
        found,
        lambda: _add_sensors(found, m, d, len(links), elastic),
        lambda: _add_frames(found, m, d, links, sites),
        lambda: _add_momenta(found, m, d, links),
        lambda: _add_relative(found, m, d, len(links)),
        lambda: _add_tendon_limits(found, m, d, len(links)),
    )
    add_arrays(found, m, d, links, sites)
    add_parts(found, lambda: _add_torques(found, m, d, rates))
    return found


def _add_sensors(found: Found, m: Any, d: Any, count: int, elastic: float) -> None:
    for stage in SENSOR_STAGES:
        getattr(mujoco, stage)(m, d)
    read = {name: np.array([d.sensor(f"{name} {k}").data.copy() for k in range(count)]) for name in SENSORS}
    turn = rotation_matrix(read.pop("FRAMEQUAT"))
    axes = [read.pop(name) for name in AXES]
    found["frame_axes"] |= {
        ("mjtSensor.mjSENS_FRAMEQUAT",): turn.mT.reshape(-1, 3),
        tuple(f"mjtSensor.mjSENS_{name}" for name in AXES): np.stack(axes, 1).reshape(-1, 3),
    }
    for name, value in read.items():
        stage = SENSOR_STAGES[m.sensor_needstage[m.sensor(f"{name} 0").id] - 1]
        found[SENSORS[name][1]][f"mjtSensor.mjSENS_{name}", stage] = value
    places = [int(m.sensor(f"FRAMEPOS {k}").adr[0]) for k in range(count)]
    found["frame_position"]["MjData.sensordata", *SENSOR_CLASSES] = d.sensordata[
        np.array(places)[:, None] + np.arange(3)
    ]
    # last: older versions lack them
    _ = mujoco.mjtSensor.mjSENS_E_KINETIC
    kinetic, potential = (d.sensor(name).data.copy()[None] for name in ENERGIES)
    found["kinetic_energy"]["mjtSensor.mjSENS_E_KINETIC",] = kinetic
    found["gravity_energy"]["mjtSensor.mjSENS_E_POTENTIAL",] = potential - elastic


def _add_frames(found: Found, m: Any, d: Any, links: Sequence[int], sites: Sequence[int]) -> None:
    found["frame_position"]["MjData.site_xpos",] = d.site_xpos[sites].copy()
    found["frame_axes"]["MjData.site_xmat",] = d.site_xmat[sites].reshape(-1, 3, 3).mT.reshape(-1, 3).copy()
    found["body_position"] |= {
        ("MjData.xpos",): d.xpos[links].copy(),
        ("MjData.xipos",): d.xipos[links].copy(),
    }
    geoms, cameras = ([x(f"probe {k}").id for k in range(len(links))] for x in (m.geom, m.camera))
    found["frame_position"] |= {
        ("MjData.geom_xpos",): d.geom_xpos[geoms].copy(),
        ("MjData.cam_xpos",): d.cam_xpos[cameras].copy(),
    }
    found["frame_axes"] |= {
        ("MjData.geom_xmat",): d.geom_xmat[geoms].reshape(-1, 3, 3).mT.reshape(-1, 3),
        ("MjData.cam_xmat",): d.cam_xmat[cameras].reshape(-1, 3, 3).mT.reshape(-1, 3),
    }
    for kind, ids in (("SITE", sites), ("GEOM", geoms), ("CAMERA", cameras), ("XBODY", links)):
        for function, quantities in OBJECT_MOTIONS.items():
            for is_local, suffix in enumerate(("", "_local") if kind != "XBODY" else ("",)):
                vectors = np.empty((len(ids), 6))
                for one, out in zip(ids, vectors, strict=True):
                    getattr(mujoco, function)(
                        m, d, getattr(mujoco.mjtObj, f"mjOBJ_{kind}"), one, out, is_local
                    )
                for quantity, half in zip(quantities, np.split(vectors, 2, axis=1), strict=True):
                    if kind == "XBODY" and "proper" in quantity:  # the body's centre
                        quantity, half = "body_acceleration", half + m.opt.gravity
                    elif kind == "XBODY" and quantity == "frame_velocity":
                        quantity = "body_velocity"
                    found[quantity + suffix][function, f"mjtObj.mjOBJ_{kind}"] = half.copy()
    _add_jacobians(found, m, d, links, sites)
    found["frame_axes"]["MjData.geom_xquat",] = rotation_matrix(d.geom_xquat[geoms]).mT.reshape(-1, 3)


def _add_relative(found: Found, m: Any, d: Any, count: int) -> None:
    """Add what refers to the first probe frame and to the anchor."""
    for name, quantity in RELATIVE_SENSORS.items():
        value = np.array([d.sensor(f"{name} in first {k}").data.copy() for k in range(count)])
        if name == "FRAMEQUAT":
            value = rotation_matrix(value).mT.reshape(-1, 3)
        found[quantity][f"mjtSensor.mjSENS_{name}",] = value
    for name, (_, quantity, size) in DISTANCE_SENSORS.items():
        value = np.array([d.sensor(f"{name} {k}").data / size for k in range(count)])
        found[quantity][f"mjtSensor.mjSENS_{name}",] = value
    tendons = np.array([m.tendon(f"probe {k}").id for k in range(count)])
    jacobian = _rows(d.ten_J, m if hasattr(m, "ten_J_rowadr") else d, "ten_J", m.nv)[tendons]
    ends = d.wrap_xpos.reshape(-1, 3)[d.ten_wrapadr[tendons][:, None] + np.arange(2)]
    # a spatial tendon has a row of both points per straight piece or pulley
    away = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)[:, None]
    found["frame_distance"] |= {
        ("MjData.ten_length", *WRAPS, *TENDON_CLASSES): d.ten_length[tendons, None] / 1.5,
        ("MjData.wrap_xpos",): away,
    }
    found["frame_distance_rate"] |= {
        ("MjData.ten_velocity", *WRAPS): d.ten_velocity[tendons, None] / 1.5,
        ("MjData.ten_J",): (jacobian @ d.qvel)[:, None] / 1.5,
    }
    on_tendons = np.array([m.actuator(f"probe {k}").id for k in range(count)])
    moment = _rows(d.actuator_moment, d, "moment", m.nv)
    found["frame_distance"]["MjData.actuator_length", "mjtTrn.mjTRN_TENDON"] = (
        d.actuator_length[on_tendons, None] / 3.0
    )
    found["frame_distance_rate"] |= {
        ("MjData.actuator_velocity", "mjtTrn.mjTRN_TENDON"): d.actuator_velocity[on_tendons, None] / 3.0,
        ("MjData.actuator_moment", "mjtTrn.mjTRN_TENDON"): (moment[on_tendons] @ d.qvel)[:, None] / 3.0,
    }
    on_sites = np.array([[m.actuator(f"probe {k} {i}").id for i in range(3)] for k in range(count)])
    anchor = m.site(ANCHOR).id
    turn = d.site_xmat[anchor].reshape(3, 3)
    found["frame_position_from_anchor"]["MjData.actuator_length", "mjtTrn.mjTRN_SITE"] = (
        d.actuator_length[on_sites] @ turn.T
    )
    found["frame_velocity"] |= {
        ("MjData.actuator_velocity", "mjtTrn.mjTRN_SITE"): d.actuator_velocity[on_sites] @ turn.T,
        ("MjData.actuator_moment", "mjtTrn.mjTRN_SITE"): (moment @ d.qvel)[on_sites] @ turn.T,
    }


def _add_tendon_limits(found: Found, m: Any, d: Any, count: int) -> None:
    """Let the limits of the tendons count from where they are, in another model, and read the sensors."""
    own = copy(m)
    far = 2 * float(np.max(d.ten_length))
    for k in range(count):
        own.tendon_margin[own.tendon(f"probe {k}").id] = far
    other = mujoco.MjData(own)
    other.qpos[:], other.qvel[:] = d.qpos, d.qvel
    mujoco.mj_forward(own, other)
    if np.count_nonzero(other.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON) < count:
        return  # a distance that nothing changes has no row
    place, speed = (
        np.array([other.sensor(f"TENDONLIMIT{x} {k}").data.copy() for k in range(count)])
        for x in ("POS", "VEL")
    )
    limit = "mjtConstraint.mjCNSTR_LIMIT_TENDON"
    found["frame_distance"]["mjtSensor.mjSENS_TENDONLIMITPOS", limit] = (place + far) / 1.5
    found["frame_distance_rate"]["mjtSensor.mjSENS_TENDONLIMITVEL", limit] = speed / 1.5


def _rows(values: Array, of: Any, name: str, width: int) -> Float[Array, "rows width"]:
    """A sparse matrix as a dense one; old versions hold it so."""
    if values.ndim == 2:
        return values
    counts, starts, columns = (getattr(of, f"{name}_{x}") for x in ("rownnz", "rowadr", "colind"))
    dense = np.zeros((len(counts), width))
    for row, start, count in zip(dense, starts, counts, strict=True):
        row[columns[start : start + count]] = values[start : start + count]
    return dense


def _add_jacobians(found: Found, m: Any, d: Any, links: Sequence[int], sites: Sequence[int]) -> None:
    rows: dict[tuple[str, str], list[Array]] = defaultdict(list)

    def add(call: str, *values: Array) -> None:
        for quantity, value in zip(JACOBIANS[call], values, strict=True):
            rows[quantity, call].append(value)

    for b, site in zip(links, sites, strict=True):
        (p, r), (dp, dr) = np.zeros((2, 2, 3, m.nv))
        mujoco.mj_jac(m, d, p, r, d.site_xpos[site], b)
        add("mj_jac", p @ d.qvel, r @ d.qvel)
        axis = d.site_xmat[site].reshape(3, 3)[:, 0].copy()
        mujoco.mj_jacPointAxis(m, d, p, r, d.site_xpos[site], axis, b)
        add("mj_jacPointAxis", p @ d.qvel)
        geom = m.geom(m.site(site).name).id
        numbers = {"mj_jacBody": b, "mj_jacBodyCom": b, "mj_jacSite": site, "mj_jacGeom": geom}
        for call, number in numbers.items():
            getattr(mujoco, call)(m, d, p, r, number)
            add(call, p @ d.qvel, r @ d.qvel)
        mujoco.mj_jacDot(m, d, dp, dr, d.site_xpos[site], b)
        add("mj_jacDot", dp @ d.qvel + p @ d.qacc, dr @ d.qvel + r @ d.qacc)
        for call in ("mj_jacSubtreeCom", "mj_angmomMat"):
            getattr(mujoco, call)(m, d, p, b)
            add(call, p @ d.qvel)
    for (quantity, call), vectors in rows.items():
        found[quantity][call,] = np.array(vectors)


def _add_momenta(found: Found, m: Any, d: Any, links: Sequence[int]) -> None:
    found["subtree_centre"]["MjData.subtree_com",] = d.subtree_com[links].copy()
    found["subtree_velocity"]["MjData.subtree_linvel", "mj_subtreeVel"] = d.subtree_linvel[links].copy()
    found["subtree_angular_momentum"]["MjData.subtree_angmom", "mj_subtreeVel"] = d.subtree_angmom[
        links
    ].copy()
    found["total_mass"]["mj_getTotalmass",] = np.array([[mujoco.mj_getTotalmass(m)]])
    found["centre_of_mass"]["MjData.subtree_com",] = d.subtree_com[:1].copy()
    found["centre_of_mass_velocity"]["MjData.subtree_linvel",] = d.subtree_linvel[:1].copy()
    found["centroidal_angular_momentum"]["MjData.subtree_angmom",] = d.subtree_angmom[:1].copy()


def _add_factors(found: Found, m: Any, d: Any) -> None:
    """Add ½ |x|² of what roots of the mass matrix and of its inverse give: kinetic energies."""
    root, momentum, back = np.zeros((3, m.nv))
    mujoco.mj_mulM2(m, d, root, d.qvel)
    mujoco.mj_mulM(m, d, momentum, d.qvel)
    diagonal = (np.sqrt(d.qLDiagInv),) if not hasattr(d, "qLDiagSqrtInv") else ()  # of older versions
    mujoco.mj_solveM2(m, d, back[None], momentum[None], *diagonal)
    found["kinetic_energy"] |= {
        ("mj_mulM2",): np.array([[root @ root / 2]]),
        ("mj_solveM2", "MjData.qLDiagInv"): np.array([[back @ back / 2]]),
        ("MjData.energy",): d.energy[1:, None].copy(),
    }


def _add_sum(found: Found, m: Any, d: Any) -> None:
    """Add the kinetic energy by M added to nothing."""
    added, columns = np.zeros(m.nM), np.zeros(m.nM, np.int32)  # the binding's sizes; it fills nC
    columns[: m.nC] = m.M_colind
    mujoco.mj_addM(m, d, added, m.M_rownnz.copy(), m.M_rowadr.copy(), columns)
    lower = _rows(added, m, "M", m.nv)
    through = lower @ d.qvel + np.tril(lower, -1).T @ d.qvel
    found["kinetic_energy"]["mj_addM",] = np.array([[d.qvel @ through / 2]])


def _add_torques(found: Found, m: Any, d: Any, rates: Array) -> None:
    v, a = d.qvel.copy(), d.qacc.copy()
    rotors = m.dof_armature * a
    _add_factors(found, m, d)
    momentum, through, force, tau, gravity = np.zeros((5, m.nv))
    mujoco.mj_mulM(m, d, momentum, v)
    mujoco.mj_solveM(m, d, through[None], momentum[None])
    mujoco.mj_mulM(m, d, through, through.copy())
    mujoco.mj_mulM(m, d, force, a)
    mujoco.mj_rne(m, d, 1, tau)
    dynamics: dict[Call, Array] = {
        ("mj_rne",): tau.copy(),
        ("MjData.qfrc_bias",): d.qfrc_bias + force - rotors,
    }
    for call in INVERSES:
        d.qfrc_inverse[:] = 0.0
        for function in call:
            stage = (mujoco.mjtStage.mjSTAGE_NONE, 1) if function == "mj_inverseSkip" else ()
            getattr(mujoco, function)(m, d, *stage)
        dynamics[*call, "MjData.qfrc_inverse"] = d.qfrc_inverse + d.qfrc_passive - rotors
    dynamics |= _joint_forces(m, d)
    dynamics[INVERSE_STAGES] = _inverse_by_stages(m, d, tau)
    add_parts(
        found,
        lambda: found["kinetic_energy"].update(_implicit_steps(m, d, dynamics)),
        lambda: _add_sum(found, m, d),
    )
    if not np.any(m.dof_damping):
        flags = m.opt.enableflags
        m.opt.enableflags = flags | int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
        mujoco.mj_inverse(m, d)
        dynamics["mjtEnableBit.mjENBL_INVDISCRETE",] = d.qfrc_inverse + d.qfrc_passive - rotors
        m.opt.enableflags = flags
    d.qvel[:] = 0.0
    mujoco.mj_fwdVelocity(m, d)
    mujoco.mj_rne(m, d, 0, gravity)
    of_gravity = {("mj_rne",): gravity, ("MjData.qfrc_bias", "mj_fwdVelocity"): d.qfrc_bias}
    pulls = np.zeros(m.nv)
    for b in range(1, m.nbody):
        weight = -m.body_mass[b] * m.opt.gravity
        mujoco.mj_applyFT(m, d, weight, np.zeros(3), d.xipos[b], b, pulls)
    of_gravity["mj_setTotalmass",] = _gravity_of_twice_the_mass(m, d) / 2
    of_gravity["mj_applyFT",] = pulls
    for quantity, values in (
        ("generalized_momentum", {("mj_mulM",): momentum}),
        ("momentum_through_inverse", {("mj_solveM",): through}),
        ("generalized_gravity", of_gravity),
        ("inverse_dynamics", dynamics),
    ):
        found[quantity] |= {call: (rates.T @ value)[:, None] for call, value in values.items()}


def _gravity_of_twice_the_mass(m: Any, d: Any) -> Array:
    m, force = copy(m), np.zeros(m.nv)
    mujoco.mj_setTotalmass(m, 2 * mujoco.mj_getTotalmass(m))
    other = mujoco.MjData(m)
    other.qpos[:] = d.qpos
    mujoco.mj_fwdPosition(m, other)
    mujoco.mj_rne(m, other, 0, force)
    return force


def _joint_forces(m: Any, d: Any) -> dict[Call, Array]:
    """What acts on the bodies by the arrays of forces, without what rotors take."""
    pushes, rotors, through = np.zeros((3, m.nv))
    for b in range(1, m.nbody):
        mujoco.mj_applyFT(m, d, d.xfrc_applied[b, :3], d.xfrc_applied[b, 3:], d.xipos[b], b, pushes)
    rotors = m.dof_armature * d.qacc
    mujoco.mj_mulM(m, d, through, d.qacc_smooth)
    found: dict[Call, Array] = {
        ("MjData.qfrc_smooth",): d.qfrc_bias + d.qfrc_smooth - rotors,
        ("MjData.qacc_smooth",): d.qfrc_bias + through - rotors,
        ("MjData.qfrc_applied", "MjData.xfrc_applied"): d.qfrc_passive + d.qfrc_applied + pushes - rotors,
    }
    parts = {"spring": bool(np.any(m.jnt_stiffness) or np.any(m.tendon_stiffness))}
    parts["damper"] = bool(np.any(m.dof_damping) or np.any(m.tendon_damping))
    if any(parts.values()):
        names = tuple(f"MjData.qfrc_{part}" for part, is_there in parts.items() if is_there)
        found[*names, "MjData.qfrc_passive"] = (
            d.qfrc_spring + d.qfrc_damper + d.qfrc_applied + pushes - rotors
        )
    return found


def _inverse_by_stages(m: Any, d: Any, force: Array) -> Array:
    """Inverse dynamics by its stages in other data."""
    other = mujoco.MjData(m)
    other.qpos[:], other.qvel[:], other.qacc[:] = d.qpos, d.qvel, d.qacc
    for stage in INVERSE_STAGES:
        getattr(mujoco, stage)(m, other)
    mujoco.mj_rne(m, other, 1, force)
    return np.asarray(force - other.qfrc_constraint)


def _implicit_steps(m: Any, d: Any, dynamics: dict[Call, Array]) -> dict[Call, Array]:
    """Take a step by each implicit method; its matrix, less what it adds to M, gives the energy."""
    found, size = dict[Call, Array](), max(float(np.max(np.abs(d.qvel), initial=0.0)), 1.0)
    own, rotors = (copy(m), m.dof_armature * d.qacc)
    own.opt.timestep = h = 0.1 / size
    own.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)  # loads are applied ones
    energy, is_free = np.array([[0.5]]), np.any(m.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    for name in ("IMPLICIT", "IMPLICITFAST", "EULER"):
        # since 3.11 the fast method turns free bodies by a matrix of their own
        if not np.any(m.dof_damping) if name == "EULER" else name == "IMPLICITFAST" and is_free:
            continue
        other = mujoco.MjData(own)
        other.qpos[:], other.qvel[:], v = d.qpos, d.qvel, d.qvel
        other.qfrc_applied[:], other.xfrc_applied[:] = d.qfrc_applied, d.xfrc_applied
        own.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{name}")
        mujoco.mj_forward(own, other)
        if name == "EULER":
            mujoco.mj_Euler(own, other)
            L = _rows(other.qH, m, "M", m.nv)
            pivots = L @ v + (1 - np.diag(L)) * v
            twice = np.diag(L) @ pivots**2 - h * m.dof_damping @ v**2
            found["MjData.qH",] = twice * energy
            inverse = (pivots / other.qHDiagInv) @ pivots - h * m.dof_damping @ v**2
            found["MjData.qHDiagInv",] = inverse * energy
            continue
        mujoco.mj_implicit(own, other)
        D = _rows(other.qDeriv, m, "D", m.nv)
        if name == "IMPLICIT":
            LU = _rows(other.qLU, m, "D", m.nv)
            upper = np.triu(LU, 1) + np.eye(m.nv)
            found["MjData.qLU",] = ((upper.T @ v) @ (np.tril(LU) @ v) + h * v @ D @ v) * energy
        change = np.zeros(m.nv)
        mujoco.mj_mulM(m, d, change, (other.qvel - v) / h)
        change -= D @ (other.qvel - v)
        call = "mj_implicit", f"mjtIntegrator.mjINT_{name}", "MjData.qDeriv", "mjtDisableBit.mjDSBL_ACTUATION"
        dynamics[call] = d.qfrc_bias + change - rotors
    return found
