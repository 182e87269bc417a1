"""What MuJoCo reports of a tree besides the state quantities: sensors, Jacobians, momenta, inverse dynamics.

Each body has a site at its probe frame.  Velocities and accelerations of objects have the rotation first, in
the world's axes or the object's; accelerations are proper ones: MuJoCo's base accelerates with −g.  The mass
matrix counts the rotors (armature), `mj_rne` does not.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from copy import copy
from functools import partial
from typing import Any, NamedTuple

import mujoco
import numpy as np

from adapters.mujoco_arrays import ARRAYS
from adapters.mujoco_common import (
    DOFS,
    MAX_AWAKE,
    add_actuator,
    add_sensor,
    data_like,
    dense_rows,
    member,
    named_joints,
    set_attributes,
    structure_of,
    through_inverse,
    times_mass,
)
from adapters.mujoco_probes import ANCHOR, Probed
from adapters.pose_functions import Pose, rate_maps
from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array, Model
from plumbline.model.kinematics import quaternion_product, rotation_matrix
from plumbline.model.probe_frames import PROBE_ATTITUDE, anchor_point, probe_points

SENSOR_CLASSES = "MjsSensor mjtSensor"
TENDON_CLASSES = "MjsTendon MjsTendonPath MjsWrap mjtWrap"
WRAPS = "mjtWrap.mjWRAP_SITE mjtWrap.mjWRAP_PULLEY"
# By sensor of distances from the anchor its quantity, and what one metre of a distance is there.
DISTANCE_SENSORS = {
    "TENDONPOS": ("TENDON", "frame_distance", 1.5),
    "TENDONVEL": ("TENDON", "frame_distance_rate", 1.5),
    "ACTUATORPOS": ("ACTUATOR", "frame_distance", 3.0),
    "ACTUATORVEL": ("ACTUATOR", "frame_distance_rate", 3.0),
}
# By sensor its quantity: on the sites of the probe frames, and on the bodies.
SITE_SENSORS = {
    "FRAMEPOS": "frame_position",
    "FRAMEXAXIS": "frame_axes",
    "FRAMEYAXIS": "frame_axes",
    "FRAMEZAXIS": "frame_axes",
    "FRAMEQUAT": "frame_axes",
    "FRAMELINVEL": "frame_velocity",
    "VELOCIMETER": "frame_velocity_local",
    "FRAMEANGVEL": "frame_angular_velocity",
    "GYRO": "frame_angular_velocity_local",
    "FRAMELINACC": "frame_proper_acceleration",
    "ACCELEROMETER": "frame_proper_acceleration_local",
    "FRAMEANGACC": "frame_angular_acceleration",
    "FORCE": "joint_force_local",
    "TORQUE": "joint_moment_local",
}
BODY_SENSORS = {
    "SUBTREECOM": "subtree_centre",
    "SUBTREELINVEL": "subtree_velocity",
    "SUBTREEANGMOM": "subtree_angular_momentum",
}
RELATIVE_SENSORS = ("FRAMEPOS", "FRAMEQUAT", "FRAMELINVEL", "FRAMEANGVEL")  # in the first probe frame, too
JOINT_SENSORS, BALL_SENSORS = ("JOINTPOS", "JOINTVEL"), ("BALLQUAT", "BALLANGVEL")
ENERGIES = ("E_KINETIC", "E_POTENTIAL")
AXES = ("FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS")
# By function of an object's motion the quantities of its two halves, rotation and point.
OBJECT_MOTIONS = {
    "mj_objectVelocity": ("frame_angular_velocity", "frame_velocity"),
    "mj_objectAcceleration": ("frame_angular_acceleration", "frame_proper_acceleration"),
}
# Of a Jacobian the quantities of its two parts, point and rotation.
AT_FRAME = ("frame_velocity", "frame_angular_velocity")
AT_BODY = ("body_velocity", "frame_angular_velocity")
INVERSE_STAGES = ("mj_invPosition", "mj_invVelocity", "mj_invConstraint")
STILL_SENSORS = {"FRAMELINACC": False, "ACCELEROMETER": True}  # by name whether in own axes


class Clamp(NamedTuple):
    """What makes the forces of dampers zero in a step."""

    ranges: str  # array of the model, none of early forces
    flags: str  # array of the model
    is_of_actuators: bool  # whether these are of the actuators, or of what they act on
    transmission: str  # of the dampers
    names: str  # that only a step with it uses


CLAMPS = (
    Clamp("actuator_forcerange", "actuator_forcelimited", True, "mjtTrn.mjTRN_TENDON",
          "mjtBias.mjBIAS_AFFINE mjtTrn.mjTRN_TENDON"),
    Clamp("tendon_actfrcrange", "tendon_actfrclimited", False, "mjtTrn.mjTRN_TENDON",
          "mjtBias.mjBIAS_AFFINE mjtObj.mjOBJ_TENDON"),
    Clamp("jnt_actfrcrange", "jnt_actfrclimited", False, "mjtTrn.mjTRN_JOINT",
          "mjtBias.mjBIAS_AFFINE mjtTrn.mjTRN_JOINT"),
    Clamp("", "actuator_actearly", True, "mjtTrn.mjTRN_TENDON",
          "mjtGain.mjGAIN_AFFINE mjtDyn.mjDYN_INTEGRATOR"),
)  # fmt: skip
SENSOR_STAGES = ("mj_sensorPos", "mj_sensorVel", "mj_sensorAcc")
TIME = 0.7  # s, of a turn
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
        of_first, of_second = np.zeros((2, 3, 3))
        mujoco.mjd_subQuat(q, other, of_first, of_second)
        pose = Pose(np.zeros(3), between)
        return [
            rate_maps(pose)["phidot"] @ matrix @ moved
            for matrix, moved in ((of_first, spin), (-of_second, pose.R @ spin))
        ]
    if name == "mjd_quatIntegrate":
        by_turn, by_velocity, by_scale = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
        mujoco.mjd_quatIntegrate(*given, by_turn.ravel(), by_velocity.ravel(), by_scale)
        return [by_velocity] if forms[0].startswith("@") else [by_turn.T, by_scale]
    if name == "mju_quat2Vel":
        velocity = np.empty(3)
        mujoco.mju_quat2Vel(velocity, given[0], TIME)
        return [TIME * velocity]
    arguments = [np.ravel(x) if isinstance(x, np.ndarray) else x for x in given]
    results = [np.empty(SIZES[form.rpartition(".")[2]]) for form in forms]
    if name == "mju_quatIntegrate":  # in place
        results, arguments = [given[0].copy()], [given[1] / TIME, TIME]
    getattr(mujoco, name)(*results, *arguments)
    return results


def add_probes(spec: Any, links: Sequence[Any], model: Model) -> None:
    """Add a site at the probe frame of every body, and all sensors."""
    for k, (link, point) in enumerate(zip(links, probe_points(model), strict=True)):
        site = set_attributes(link.add_site(), name=f"probe {k}", pos=point, quat=PROBE_ATTITUDE)
        link.name = f"link {k}"
        for kind, one, sensors in (("SITE", site, SITE_SENSORS), ("BODY", link, BODY_SENSORS)):
            for name in sensors:
                add_sensor(spec, name, kind, one.name, f"{name} {k}")
    kinds = mujoco.mjtSensor.__members__
    for name in ENERGIES:  # of which `_add_energies` reports what the version lacks
        if (kind := kinds.get(f"mjSENS_{name}")) is not None:
            set_attributes(spec.add_sensor(), name=name, type=kind)
    own = {mujoco.mjtJoint.mjJNT_BALL: BALL_SENSORS, mujoco.mjtJoint.mjJNT_FREE: ()}
    for joint in named_joints(spec):
        for name in own.get(joint.type, JOINT_SENSORS):
            add_sensor(spec, name, "JOINT", joint.name)
        if DOFS[joint.type] == 1:
            add_actuator(spec, f"on {joint.name}", "JOINT", joint.name, np.eye(6)[0])
    _add_relative_probes(spec, links, model)


def _add_relative_probes(spec: Any, links: Sequence[Any], model: Model) -> None:
    """Add to every probe frame a geom and a camera, sensors that refer to the first, and a tendon.

    The tendon is slack: from the anchor to the probe frame and, behind a pulley that halves it, back.
    Actuators without a force are on it and between the two frames.
    """
    anchor = spec.worldbody.add_site()
    set_attributes(anchor, name=ANCHOR, pos=anchor_point(model), quat=PROBE_ATTITUDE)
    far = 1e3 * (1.0 + float(np.linalg.norm(anchor.pos)))  # it is not reached
    for name in STILL_SENSORS:
        add_sensor(spec, name, "SITE", ANCHOR)
    for k, (link, point) in enumerate(zip(links, probe_points(model), strict=True)):
        probe = f"probe {k}"
        shape, camera = link.add_geom(), link.add_camera()
        for one in (shape, camera):
            set_attributes(one, name=probe, pos=point, quat=PROBE_ATTITUDE)
        shape.size[0], shape.contype, shape.conaffinity, shape.mass = 1e-3, 0, 0, 0.0
        for name in RELATIVE_SENSORS:
            sensor = add_sensor(spec, name, "SITE", probe, f"{name} in first {k}")
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_SITE, "probe 0"
        limited = mujoco.mjtLimited.mjLIMITED_TRUE
        tendon = set_attributes(spec.add_tendon(), name=probe, limited=limited, range=[0.0, far])
        for end in (ANCHOR, probe, "", probe, ANCHOR):
            _ = tendon.wrap_site(end) if end else tendon.wrap_pulley(2.0)
        add_actuator(spec, probe, "TENDON", probe, 2.0 * np.eye(6)[0], dyntype=mujoco.mjtDyn.mjDYN_INTEGRATOR)
        for i, gear in enumerate(np.eye(6)[:3]):
            add_actuator(spec, f"{probe} {i}", "SITE", probe, gear, refsite=ANCHOR)
        slide = {"slidersite": ANCHOR, "cranklength": 1.0}
        add_actuator(spec, f"{probe} crank", "SLIDERCRANK", probe, np.eye(6)[0], **slide)
        for name in ("TENDONLIMITPOS", "TENDONLIMITVEL"):
            add_sensor(spec, name, "TENDON", probe, f"{name} {k}")
        for name, (kind, _, _) in DISTANCE_SENSORS.items():
            add_sensor(spec, name, kind, probe, f"{name} {k}")


def add_surface(s: Probed) -> None:
    """Read all after the forward dynamics at one state."""
    parts = (_add_sensors, _add_energies, _add_frames, _add_momenta, _add_relative, _add_still, _add_cranks,
             _add_tendon_limits, _add_asleep, *ARRAYS, _add_torques)  # fmt: skip
    add_parts(s.found, *(partial(part, s) for part in parts))


def _add_sensors(s: Probed) -> None:
    for stage in SENSOR_STAGES:
        getattr(mujoco, stage)(s.m, s.d)
    for name, quantity in (SITE_SENSORS | BODY_SENSORS).items():
        if quantity != "frame_axes":
            stage = SENSOR_STAGES[s.m.sensor_needstage[s.m.sensor(f"{name} 0").id] - 1]
            s.add(quantity, f"mjtSensor.mjSENS_{name} {stage}", s.sensors(name))
    s.add_attitudes("mjtSensor.mjSENS_FRAMEQUAT", s.sensors("FRAMEQUAT"))
    axes = np.stack([s.sensors(name) for name in AXES], 1)
    s.add("frame_axes", " ".join(f"mjtSensor.mjSENS_{name}" for name in AXES), axes.reshape(-1, 3))
    places = np.array([int(s.m.sensor(f"FRAMEPOS {k}").adr[0]) for k in range(len(s.links))])
    values = s.d.sensordata[places[:, None] + np.arange(3)]
    s.add("frame_position", f"MjData.sensordata {SENSOR_CLASSES}", values)


def _add_energies(s: Probed) -> None:
    for name, quantity in (("E_KINETIC", "kinetic_energy"), ("E_POTENTIAL", "potential_energy")):
        _ = member(f"mjtSensor.mjSENS_{name}")
        s.add(quantity, f"mjtSensor.mjSENS_{name}", s.d.sensor(name).data)


def _add_frames(s: Probed) -> None:
    m, d, geoms = s.m, s.d, s.ids("geom")
    ids: dict[str, Any] = {"SITE": s.sites, "GEOM": geoms, "CAMERA": s.ids("camera"), "XBODY": s.links}
    for name in ("xpos", "xipos"):
        s.add("body_position", f"MjData.{name}", getattr(d, name)[s.links])
    for name, kind in (("site", "SITE"), ("geom", "GEOM"), ("cam", "CAMERA")):
        s.add("frame_position", f"MjData.{name}_xpos", getattr(d, f"{name}_xpos")[ids[kind]])
        s.add_attitudes(f"MjData.{name}_xmat", getattr(d, f"{name}_xmat")[ids[kind]])
    for kind, own in ids.items():
        for function, quantities in OBJECT_MOTIONS.items():
            for is_local, suffix in enumerate(("", "_local") if kind != "XBODY" else ("",)):
                vectors = np.empty((len(own), 6))
                for one, out in zip(own, vectors, strict=True):
                    getattr(mujoco, function)(m, d, member(f"mjtObj.mjOBJ_{kind}"), one, out, is_local)
                turning, moving = quantities
                if kind == "XBODY":  # the body's centre
                    vectors[:, 3:] += m.opt.gravity * ("proper" in moving)
                    moving = moving.replace("frame_", "body_").replace("proper_", "")
                s.add_halves((turning + suffix, moving + suffix), f"{function} mjtObj.mjOBJ_{kind}", vectors)
    _add_jacobians(s)
    s.add_attitudes("MjData.geom_xquat", d.geom_xquat[geoms])


def _add_relative(s: Probed) -> None:
    """Add what refers to the first probe frame and to the anchor."""
    m, d = s.m, s.d
    for name in RELATIVE_SENSORS:
        value = s.sensors(f"{name} in first")
        if name == "FRAMEQUAT":
            value = rotation_matrix(value).swapaxes(-1, -2).reshape(-1, 3)
        s.add(f"{SITE_SENSORS[name]}_in_first", f"mjtSensor.mjSENS_{name}", value)
    for name, (_, quantity, size) in DISTANCE_SENSORS.items():
        s.add(quantity, f"mjtSensor.mjSENS_{name}", s.sensors(name) / size)
    tendons, on_tendons = s.ids("tendon"), s.ids("actuator")
    jacobian = dense_rows(d.ten_J, m, d, "ten_J")[tendons]
    ends = d.wrap_xpos.reshape(-1, 3)[d.ten_wrapadr[tendons][:, None] + np.arange(2)]
    moment = dense_rows(d.actuator_moment, m, d, "moment")
    # a spatial tendon has a row of both points per straight piece or pulley
    away, by = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1), "mjtTrn.mjTRN_TENDON"
    for quantity, call, value in (
        ("", f"MjData.ten_length {WRAPS} {TENDON_CLASSES}", d.ten_length[tendons] / 1.5),
        ("", "MjData.wrap_xpos", away),
        ("_rate", f"MjData.ten_velocity {WRAPS}", d.ten_velocity[tendons] / 1.5),
        ("_rate", "MjData.ten_J", jacobian @ d.qvel / 1.5),
        ("", f"MjData.actuator_length {by}", d.actuator_length[on_tendons] / 3.0),
        ("_rate", f"MjData.actuator_velocity {by}", d.actuator_velocity[on_tendons] / 3.0),
        ("_rate", f"MjData.actuator_moment {by}", moment[on_tendons] @ d.qvel / 3.0),
    ):
        s.add(f"frame_distance{quantity}", call, value[:, None])
    on_sites = np.stack([s.ids("actuator", f" {i}") for i in range(3)], 1)
    turn, by = d.site_xmat[m.site(ANCHOR).id].reshape(3, 3), "mjtTrn.mjTRN_SITE"
    length, speeds = d.actuator_length[on_sites] @ turn.T, d.actuator_velocity[on_sites] @ turn.T
    s.add("frame_position_from_anchor", f"MjData.actuator_length {by}", length)
    s.add("frame_velocity", f"MjData.actuator_velocity {by}", speeds)
    s.add("frame_velocity", f"MjData.actuator_moment {by}", (moment @ d.qvel)[on_sites] @ turn.T)


def _add_still(s: Probed) -> None:
    """Add accelerations relative to that reported of the anchor, which does not move."""
    m, d, anchor = s.m, s.d, s.m.site(ANCHOR).id
    turns = [d.site_xmat[site].reshape(3, 3) for site in (anchor, *s.sites)]
    for name, is_local in STILL_SENSORS.items():
        own = [d.sensor(f"{name} {ANCHOR}").data.copy(), *s.sensors(name)]
        still, *moving = (turn @ x if is_local else x for turn, x in zip(turns, own, strict=True))
        s.add("frame_acceleration", f"mjtSensor.mjSENS_{name}", np.array(moving) - still)
    vectors = np.zeros((len(turns), 6))
    for site, out in zip((anchor, *s.sites), vectors, strict=True):
        mujoco.mj_objectAcceleration(m, d, mujoco.mjtObj.mjOBJ_SITE, site, out, 0)
    call = "mj_objectAcceleration mjtObj.mjOBJ_SITE"
    s.add("frame_acceleration", call, vectors[1:, 3:] - vectors[0, 3:])


def _add_cranks(s: Probed) -> None:
    """Add the distances from the anchor by slides along its axis, with cranks that reach them."""
    own, cranks, anchor = copy(s.m), s.ids("actuator", " crank"), s.m.site(ANCHOR).id
    arms = s.d.site_xpos[s.sites] - s.d.site_xpos[anchor]
    own.actuator_cranklength[cranks] = L = 1.5 * np.linalg.norm(arms, axis=1)
    other, axis = data_like(own, s.d), s.d.site_xmat[anchor].reshape(3, 3)[:, 2]
    mujoco.mj_fwdPosition(own, other)
    mujoco.mj_fwdVelocity(own, other)
    along, speed = arms @ axis, s.sensors("FRAMELINVEL") @ axis
    rest = along - other.actuator_length[cranks]
    distance, by = np.sqrt(L**2 + along**2 - rest * np.abs(rest)), "mjtTrn.mjTRN_SLIDERCRANK"
    moment = dense_rows(other.actuator_moment, own, other, "moment")
    s.add("frame_distance", f"MjData.actuator_length {by}", distance[:, None])
    for name, rate in (("velocity", other.actuator_velocity[cranks]), ("moment", moment[cranks] @ s.d.qvel)):
        change = (along * speed - rest * (speed - rate)) / distance
        s.add("frame_distance_rate", f"MjData.actuator_{name} {by}", change[:, None])


def _add_tendon_limits(s: Probed) -> None:
    """Let the limits of the tendons count from where they are, in another model, and read the sensors."""
    own, far, limit = copy(s.m), 2 * float(np.max(s.d.ten_length)), "mjtConstraint.mjCNSTR_LIMIT_TENDON"
    own.tendon_margin[s.ids("tendon")] = far
    other = data_like(own, s.d)
    mujoco.mj_forward(own, other)
    rows = np.flatnonzero(other.efc_type == member(limit))
    if len(rows) < len(s.links):
        return  # a distance that nothing changes has no row
    rows = rows[np.argsort(other.efc_id[rows])]
    place, speed = (s.sensors(f"TENDONLIMIT{x}", other) for x in ("POS", "VEL"))
    away, margin, rate = (other.efc_pos[rows, None], other.efc_margin[rows, None], other.efc_vel[rows, None])
    s.add("frame_distance", f"MjData.efc_pos {limit}", away / 1.5)
    s.add("frame_distance", f"MjData.efc_margin {limit}", (place + margin) / 1.5)
    s.add("frame_distance_rate", f"MjData.efc_vel {limit}", rate / 1.5)
    s.add("frame_distance", f"mjtSensor.mjSENS_TENDONLIMITPOS {limit}", (place + far) / 1.5)
    s.add("frame_distance_rate", f"mjtSensor.mjSENS_TENDONLIMITVEL {limit}", speed / 1.5)


def _add_asleep(s: Probed) -> None:
    """Let all fall asleep where it is, since it is slow enough, and add the energy of its position."""
    own = copy(s.m)
    own.tree_sleep_policy[:] = member("mjtSleepPolicy.mjSLEEP_ALLOWED")
    own.opt.enableflags |= int(member("mjtEnableBit.mjENBL_SLEEP"))
    own.opt.sleep_tolerance, own.opt.timestep = 1e9, 0.0  # nothing moves: at the height 0 the bound is 0, too
    other = data_like(own, s.d)
    for _ in range(MAX_AWAKE):
        mujoco.mj_step(own, other)
    s.add("potential_energy", "mj_energyPos mjtSleepPolicy", other.energy[0])


def _add_jacobians(s: Probed) -> None:
    m, d, rows = s.m, s.d, defaultdict[tuple[str, str], list[Array]](list)
    for b, site in zip(s.links, s.sites, strict=True):
        (p, r), (dp, dr) = np.zeros((2, 2, 3, m.nv))
        point, geom = d.site_xpos[site], m.geom(m.site(site).name).id
        axis = d.site_xmat[site].reshape(3, 3)[:, 0].copy()
        for call, arguments, quantities in (
            ("mj_jac", (p, r, point, b), AT_FRAME),
            ("mj_jacPointAxis", (p, r, point, axis, b), AT_FRAME),
            ("mj_jacBody", (p, r, b), AT_BODY),
            ("mj_jacBodyCom", (p, r, b), AT_BODY),
            ("mj_jacSite", (p, r, site), AT_FRAME),
            ("mj_jacGeom", (p, r, geom), AT_FRAME),
            ("mj_jacDot", (dp, dr, point, b), ("frame_acceleration", "frame_angular_acceleration")),
            ("mj_jacSubtreeCom", (p, b), ("subtree_velocity",)),
            ("mj_angmomMat", (p, b), ("subtree_angular_momentum",)),
        ):
            getattr(mujoco, call)(m, d, *arguments)
            values = [p @ d.qvel, r @ d.qvel]
            if call == "mj_jac":
                along = axis * (axis @ values[1])
            if call == "mj_jacPointAxis":  # ω × axis
                values[1] = along + np.cross(axis, values[1])
            if call == "mj_jacDot":
                values = [dp @ d.qvel + p @ d.qacc, dr @ d.qvel + r @ d.qacc]
            for quantity, value in zip(quantities, values, strict=False):
                rows[quantity, call].append(value)
    for (quantity, call), vectors in rows.items():
        s.add(quantity, call, vectors)


def _add_momenta(s: Probed) -> None:
    s.add("total_mass", "mj_getTotalmass", mujoco.mj_getTotalmass(s.m))
    for name, of_subtree, of_all in (
        ("subtree_com", "subtree_centre", "centre_of_mass"),
        ("subtree_linvel", "subtree_velocity", "centre_of_mass_velocity"),
        ("subtree_angmom", "subtree_angular_momentum", "centroidal_angular_momentum"),
    ):
        values, by = getattr(s.d, name), "" if name == "subtree_com" else "mj_subtreeVel"
        s.add(of_subtree, f"MjData.{name} {by}", values[s.links])
        s.add(of_all, f"MjData.{name}", values[0])


def _add_factors(s: Probed) -> None:
    """Add ½ |x|² of what roots of the mass matrix and of its inverse give: kinetic energies."""
    m, d, root, back = s.m, s.d, *np.zeros((2, s.m.nv))
    mujoco.mj_mulM2(m, d, root, d.qvel)
    diagonal = (np.sqrt(d.qLDiagInv),) if not hasattr(d, "qLDiagSqrtInv") else ()  # of older versions
    mujoco.mj_solveM2(m, d, back[None], times_mass(m, d, d.qvel)[None], *diagonal)
    s.add("kinetic_energy", "mj_mulM2", root @ root / 2)
    s.add("kinetic_energy", "mj_solveM2 MjData.qLDiagInv", back @ back / 2)
    s.add("kinetic_energy", "MjData.energy", d.energy[1])


def _add_sum(s: Probed) -> None:
    """Add the kinetic energy by M added to nothing."""
    m, v, added = s.m, s.d.qvel, np.zeros(s.m.nM)
    columns = np.zeros(m.nM, np.int32)  # the binding's size, of which versions fill nC or all
    of = structure_of(m, s.d, "M")
    columns[: len(of.M_colind)] = of.M_colind
    mujoco.mj_addM(m, s.d, added, of.M_rownnz.copy(), of.M_rowadr.copy(), columns)
    lower = dense_rows(added, m, s.d, "M")
    s.add("kinetic_energy", "mj_addM", v @ (lower @ v + np.tril(lower, -1).T @ v) / 2)


def _add_torques(s: Probed) -> None:
    m, d = s.m, s.d
    v, a, rotors = d.qvel.copy(), d.qacc.copy(), m.dof_armature * d.qacc
    _add_factors(s)
    tau, gravity, pulls = np.zeros((3, m.nv))
    momentum = times_mass(m, d, v)
    through = times_mass(m, d, through_inverse(m, d, momentum))
    mujoco.mj_rne(m, d, 1, tau)
    bias = d.qfrc_bias + times_mass(m, d, a) - rotors
    dynamics = {"mj_rne": tau.copy(), "MjData.qfrc_bias": bias}
    for function, stage in (("mj_inverse", ()), ("mj_inverseSkip", (mujoco.mjtStage.mjSTAGE_NONE, 1))):
        d.qfrc_inverse[:] = 0.0
        getattr(mujoco, function)(m, d, *stage)
        dynamics[f"{function} MjData.qfrc_inverse"] = d.qfrc_inverse + d.qfrc_passive - rotors
    dynamics |= _joint_forces(m, d)
    dynamics[" ".join(INVERSE_STAGES)] = _inverse_by_stages(m, d)
    add_parts(s.found, partial(_add_implicit_steps, s), partial(_add_sum, s))
    d.qvel[:] = 0.0
    mujoco.mj_fwdVelocity(m, d)
    mujoco.mj_rne(m, d, 0, gravity)
    for b in range(1, m.nbody):
        weight = -m.body_mass[b] * m.opt.gravity
        mujoco.mj_applyFT(m, d, weight, np.zeros(3), d.xipos[b], b, pulls)
    of_gravity = {
        "mj_rne": gravity, "MjData.qfrc_bias mj_fwdVelocity": d.qfrc_bias, "mj_applyFT": pulls,
        "mj_setTotalmass": _gravity_of_twice_the_mass(m, d) / 2,
    }  # fmt: skip
    s.add_forces("generalized_momentum", {"mj_mulM": momentum})
    s.add_forces("momentum_through_inverse", {"mj_solveM": through})
    s.add_forces("generalized_gravity", of_gravity)
    s.add_forces("inverse_dynamics", dynamics)


def _gravity_of_twice_the_mass(m: Any, d: Any) -> Array:
    m, force = copy(m), np.zeros(m.nv)
    mujoco.mj_setTotalmass(m, 2 * mujoco.mj_getTotalmass(m))
    other = data_like(m, d)
    mujoco.mj_fwdPosition(m, other)
    mujoco.mj_rne(m, other, 0, force)
    return force


def _joint_forces(m: Any, d: Any) -> dict[str, Array]:
    """What acts on the bodies by the arrays of forces, without what rotors take."""
    pushes, rotors = np.zeros(m.nv), m.dof_armature * d.qacc
    for b in range(1, m.nbody):
        mujoco.mj_applyFT(m, d, d.xfrc_applied[b, :3], d.xfrc_applied[b, 3:], d.xipos[b], b, pushes)
    found = {
        "MjData.qfrc_smooth": d.qfrc_bias + d.qfrc_smooth - rotors,
        "MjData.qacc_smooth": d.qfrc_bias + times_mass(m, d, d.qacc_smooth) - rotors,
        "MjData.qfrc_applied MjData.xfrc_applied": d.qfrc_passive + d.qfrc_applied + pushes - rotors,
    }
    parts = {"spring": (m.jnt_stiffness, m.tendon_stiffness), "damper": (m.dof_damping, m.tendon_damping)}
    names = " ".join(f"MjData.qfrc_{part}" for part, own in parts.items() if any(map(np.any, own)))
    if names:
        passive = d.qfrc_spring + d.qfrc_damper
        found[f"{names} MjData.qfrc_passive"] = passive + d.qfrc_applied + pushes - rotors
    return found


def _inverse_by_stages(m: Any, d: Any) -> Array:
    """Inverse dynamics by its stages in other data."""
    other, force = data_like(m, d, "qacc"), np.zeros(m.nv)
    for stage in INVERSE_STAGES:
        getattr(mujoco, stage)(m, other)
    mujoco.mj_rne(m, other, 1, force)
    return np.asarray(force - other.qfrc_constraint)


def _add_implicit_steps(s: Probed) -> None:
    """Take a step by each implicit method; its matrix, less what it adds to M, gives the energy."""
    m, d, v = s.m, s.d, s.d.qvel
    own = copy(m)
    # Bodies turn by 0.1 rad at most. No shorter: the change of a velocity is known to ε of the velocity.
    turning, speed, change = (float(np.max(np.abs(x), initial=0.0)) for x in (d.cvel[:, :3], v, d.qacc))
    rate = max(turning, change / (speed + change or 1.0))
    h = own.opt.timestep = 0.1 / (rate or 1.0)
    own.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)  # loads are applied ones
    is_free = np.any(m.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    for name in ("IMPLICIT", "IMPLICITFAST", "EULER"):
        # since 3.11 the fast method turns free bodies by a matrix of their own
        if not np.any(m.dof_damping) if name == "EULER" else name == "IMPLICITFAST" and is_free:
            continue
        other = data_like(own, d, "qfrc_applied", "xfrc_applied")
        own.opt.integrator = member(f"mjtIntegrator.mjINT_{name}")
        mujoco.mj_forward(own, other)
        if name == "EULER":
            mujoco.mj_Euler(own, other)
            _add_discrete_inverse(s, own, name, other)
            L = dense_rows(other.qH, m, other, "M")
            pivots, added = v + (L - np.diag(np.diag(L))) @ v, h * m.dof_damping @ v**2
            s.add("kinetic_energy", "MjData.qH", (np.diag(L) @ pivots**2 - added) / 2)
            s.add("kinetic_energy", "MjData.qHDiagInv", ((pivots / other.qHDiagInv) @ pivots - added) / 2)
            continue
        mujoco.mj_implicit(own, other)
        _add_discrete_inverse(s, own, name, other)
        D = dense_rows(other.qDeriv, m, other, "D")
        if name == "IMPLICIT":
            LU = dense_rows(other.qLU, m, other, "D")
            twice = ((np.triu(LU, 1) + np.eye(m.nv)).T @ v) @ (np.tril(LU) @ v) + h * v @ D @ v
            s.add("kinetic_energy", "MjData.qLU", twice / 2)
        call = f"mj_implicit mjtIntegrator.mjINT_{name}"
        _add_force_of_step(s, f"{call} MjData.qDeriv mjtDisableBit.mjDSBL_ACTUATION", other, D, h)
        add_parts(s.found, *(partial(_add_clamped_step, s, own, clamp, call, D) for clamp in CLAMPS))


def _add_discrete_inverse(s: Probed, m: Any, name: str, end: Any) -> None:
    """Add what inverse dynamics make of the change of the velocities in a step by an integrator."""
    own, other = copy(m), data_like(m, s.d)
    own.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    other.qacc[:] = (end.qvel - s.d.qvel) / m.opt.timestep
    mujoco.mj_inverse(own, other)
    force = other.qfrc_inverse + s.d.qfrc_passive - m.dof_armature * s.d.qacc
    call = f"mjtEnableBit.mjENBL_INVDISCRETE mjtIntegrator.mjINT_{name}"
    s.add_forces("inverse_dynamics", {call: force})


def _add_force_of_step(s: Probed, call: str, end: Any, D: Array, h: float) -> None:
    """Add the force by the change of the velocities in an implicit step, of the matrix M − h D."""
    m, d, change = s.m, s.d, end.qvel - s.d.qvel
    force = d.qfrc_bias + times_mass(m, d, change / h) - D @ change - m.dof_armature * d.qacc
    s.add_forces("inverse_dynamics", {call: force})


def _add_clamped_step(s: Probed, usual: Any, clamp: Clamp, call: str, D: Array) -> None:
    """Take an implicit step with dampers on tendons or joints whose force is zero.

    By a limit, or by activations that are zero at the end of the step, from where the force comes early.
    """
    own = copy(usual)
    a = np.flatnonzero(own.actuator_trntype == member(clamp.transmission))
    if not len(a):
        return
    own.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    own.actuator_gainprm[:] = own.actuator_biasprm[:] = 0.0  # of all others
    of = a if clamp.is_of_actuators else own.actuator_trnid[a, 0]
    getattr(own, clamp.flags)[of] = True
    if clamp.ranges:
        getattr(own, clamp.ranges)[of] = 0.0
        own.actuator_biastype[a], own.actuator_biasprm[a, 2] = mujoco.mjtBias.mjBIAS_AFFINE, -7.0
    else:
        own.actuator_gaintype[a], own.actuator_gainprm[a, 2] = mujoco.mjtGain.mjGAIN_AFFINE, -7.0
    other = data_like(own, s.d, "qfrc_applied", "xfrc_applied")
    other.act[:], other.ctrl[:] = 1.0, -1.0 / own.opt.timestep
    mujoco.mj_forward(own, other)
    mujoco.mj_implicit(own, other)
    _add_force_of_step(s, f"{call} {clamp.names}", other, D, own.opt.timestep)
