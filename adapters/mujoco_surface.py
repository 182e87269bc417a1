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

from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array, Call, Float, Model
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
    "mj_jacBody": ("body_velocity", "frame_angular_velocity"),
    "mj_jacBodyCom": ("body_velocity", "frame_angular_velocity"),
    "mj_jacPointAxis": ("frame_velocity",),
    "mj_jacDot": ("frame_acceleration", "frame_angular_acceleration"),
    "mj_jacSubtreeCom": ("subtree_velocity",),
    "mj_angmomMat": ("subtree_angular_momentum",),
}
# Calls that leave the forces of inverse dynamics.
INVERSES = (("mj_inverse",), ("mj_inverseSkip",))
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
    "mju_quatIntegrate": "M.p K.phi 1 -> Q.p",
}  # fmt: skip
SIZES = {"p": 4, "R": 9, "r": 3, "phi": 3, "w": 3, "pdot": 4, "2pdot": 4}


def pose_function(name: str, given: Sequence[Any], forms: Sequence[str]) -> list[Any]:
    """Call a function of attitudes or poses; its results come first."""
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
    for name in ENERGIES:
        sensor = spec.add_sensor()
        sensor.name, sensor.type = name, getattr(mujoco.mjtSensor, f"mjSENS_{name}")


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
        lambda: _add_torques(found, m, d, rates),
    )
    return found


def _add_sensors(found: Found, m: Any, d: Any, count: int, elastic: float) -> None:
    for stage in SENSOR_STAGES:
        getattr(mujoco, stage)(m, d)
    kinetic, potential = (d.sensor(name).data.copy()[None] for name in ENERGIES)
    found["kinetic_energy"]["mjtSensor.mjSENS_E_KINETIC",] = kinetic
    found["gravity_energy"]["mjtSensor.mjSENS_E_POTENTIAL",] = potential - elastic
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


def _add_frames(found: Found, m: Any, d: Any, links: Sequence[int], sites: Sequence[int]) -> None:
    found["frame_position"]["MjData.site_xpos",] = d.site_xpos[sites].copy()
    found["frame_axes"]["MjData.site_xmat",] = d.site_xmat[sites].reshape(-1, 3, 3).mT.reshape(-1, 3).copy()
    found["body_position"] |= {
        ("MjData.xpos",): d.xpos[links].copy(),
        ("MjData.xipos",): d.xipos[links].copy(),
    }
    for function, quantities in OBJECT_MOTIONS.items():
        for is_local, suffix in enumerate(("", "_local")):
            vectors = np.empty((len(sites), 6))
            for site, out in zip(sites, vectors, strict=True):
                getattr(mujoco, function)(m, d, mujoco.mjtObj.mjOBJ_SITE, site, out, is_local)
            for quantity, half in zip(quantities, np.split(vectors, 2, axis=1), strict=True):
                found[quantity + suffix][function,] = half.copy()
    _add_jacobians(found, m, d, links, sites)


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
        for call, number in (("mj_jacBody", b), ("mj_jacBodyCom", b), ("mj_jacSite", site)):
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
    mujoco.mj_solveM2(m, d, back[None], momentum[None], np.sqrt(d.qLDiagInv))
    found["kinetic_energy"] |= {
        ("mj_mulM2",): np.array([[root @ root / 2]]),
        ("mj_solveM2",): np.array([[back @ back / 2]]),
        ("MjData.energy",): d.energy[1:, None].copy(),
    }


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
    of_gravity["mj_applyFT",] = pulls
    for quantity, values in (
        ("generalized_momentum", {("mj_mulM",): momentum}),
        ("momentum_through_inverse", {("mj_solveM",): through}),
        ("generalized_gravity", of_gravity),
        ("inverse_dynamics", dynamics),
    ):
        found[quantity] |= {call: (rates.T @ value)[:, None] for call, value in values.items()}
