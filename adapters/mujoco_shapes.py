"""Other descriptions for MuJoCo's compiler: bodies of geoms, frames by their z axes, loops by points."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from adapters.mujoco_common import (
    bodies_of,
    children_of,
    compiler_of,
    principal_inertia,
    set_attributes,
    symmetric,
)
from plumbline.model.datatypes import Array, Float
from plumbline.model.kinematics import quaternion_conjugate, quaternion_product, rotation_matrix

SHARE = 0.1  # of the mass in each of three round shapes and in a mesh
ROUND = 0.3  # of what moments of inertia leave for round shapes
MESH_FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # fmt: skip


def of_shapes(spec: Any) -> Any:
    """Make every body with a full inertia of a box, a mesh, an ellipsoid, a ball, a shell and a cylinder."""
    shell = {"typeinertia": mujoco.mjtGeomInertia.mjINERTIA_SHELL}
    for k, body in enumerate(bodies_of(spec)):
        if np.isnan(body.fullinertia[0]):
            continue
        moments, quat = principal_inertia(symmetric(body.fullinertia))
        mass, body.explicitinertial, body.fullinertia = body.mass, False, np.full(6, np.nan)
        body.ipos = np.full(3, np.nan)
        round_part = ROUND * (np.sum(moments) - 2 * np.max(moments))
        piece, own = SHARE * mass, round_part / 3
        radius = np.sqrt(own / piece)
        for kind, size, own_kind in (
            ("SPHERE", [np.sqrt(5 / 2) * radius, 0, 0], {}),
            ("SPHERE", [np.sqrt(3 / 2) * radius, 0, 0], shell),
            ("CYLINDER", [np.sqrt(2) * radius, np.sqrt(3 / 2) * radius, 0], {}),
        ):
            _add_geom(body, kind, piece, size, quat, **own_kind)
        rest = (moments - round_part) / 2  # of the ellipsoid, and of box and mesh
        others = (1 - 3 * SHARE) / 2 * mass
        _add_geom(body, "ELLIPSOID", others, np.sqrt(5) * _half_sizes(rest, others), quat)
        vertices = np.float32(np.sqrt(3) * _half_sizes(rest * piece / others, piece)).astype(float)
        _add_mesh(spec, body, f"mesh {k}", piece, vertices, quat)
        of_mesh = piece / 3 * (vertices @ vertices - vertices**2)  # vertices are single precision
        _add_geom(body, "BOX", others - piece, np.sqrt(3) * _half_sizes(rest - of_mesh, others - piece), quat)
    return spec


def of_shapes_only(spec: Any) -> Any:
    """The same where the compiler is to look at nothing else."""
    compiler_of(spec).inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    return of_shapes(spec)


def _half_sizes(moments: Float[Array, "3"], mass: float) -> Float[Array, "3"]:
    """Root mean squares of the coordinates."""
    return np.sqrt((np.sum(moments) / 2 - moments) / mass)


def _add_geom(body: Any, kind: str, mass: float, size: Any, quat: Array, **given: Any) -> Any:
    own = {"type": getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"), "size": size, "mass": mass, "quat": quat}
    return set_attributes(body.add_geom(), **own, contype=0, conaffinity=0, **given)


def _add_mesh(spec: Any, body: Any, name: str, mass: float, half: Array, quat: Array) -> None:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    exact, faces = mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT, MESH_FACES.ravel()
    vertices = (signs * half).ravel()
    set_attributes(spec.add_mesh(), name=name, inertia=exact, uservert=vertices, userface=faces)
    _add_geom(body, "MESH", mass, [0, 0, 0], quat, meshname=name)


def without_shapes(spec: Any) -> Any:
    """Give bodies shapes that do not count."""
    compiler_of(spec).inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    for body in bodies_of(spec):
        _add_geom(body, "BOX", 7.0, [1, 2, 3], np.array([1.0, 0, 0, 0]))
    return spec


def in_z_frames(spec: Any) -> Any:
    """Put every body in a frame that has its z axis, and turn it about that."""
    for body in bodies_of(spec):
        quat = np.array(body.quat) / np.linalg.norm(body.quat)
        z = rotation_matrix(quat)[:, 2]
        least = np.array([1 + z[2], -z[1], z[0], 0.0])
        size = np.linalg.norm(least)
        if size < 1e-3:  # which of the half turns the compiler takes is rounding
            continue
        frame = body.parent.add_frame()
        frame.pos, body.pos = np.array(body.pos), np.zeros(3)
        frame.alt.type, frame.alt.zaxis = mujoco.mjtOrientation.mjORIENTATION_ZAXIS, z
        body.quat = quaternion_product(quaternion_conjugate(least / size), quat)
        body.set_frame(frame)
    return spec


def welds_as_points(spec: Any) -> Any:
    """Hold the two parts of a body at three points each in place of a weld."""
    for e, weld in enumerate(list(spec.equalities)):
        if weld.type != mujoco.mjtEq.mjEQ_WELD:
            continue
        bodies = [spec.site(name).parent for name in (weld.name1, weld.name2)]
        arms = [joint.pos for body in bodies for joint in children_of(body, "joint")]
        length = max((float(np.linalg.norm(arm)) for arm in arms), default=0.0)
        for i, place in enumerate((length or 1.0) * np.eye(3)):
            names = [f"point {e} {i} {side}" for side in (1, 2)]
            for body, name in zip(bodies, names, strict=True):
                set_attributes(body.add_site(), name=name, pos=place)
            one = weld if i == 2 else spec.add_equality()
            point = {"type": mujoco.mjtEq.mjEQ_CONNECT, "objtype": mujoco.mjtObj.mjOBJ_SITE}
            given = {"solref": weld.solref, "solimp": weld.solimp, "name1": names[0], "name2": names[1]}
            set_attributes(one, **point, **given)
    return spec


def attached(spec: Any) -> Any:
    """Attach the whole to an empty one, whose default has another rotor of joints."""
    attach, other = mujoco.MjSpec.attach, mujoco.MjSpec()
    compiler_of(other).autolimits = compiler_of(other).degree = False
    other.option.gravity = spec.option.gravity
    other.default.joint.armature = 3.0
    attach(other, spec, frame=other.worldbody.add_frame(), prefix="attached ")
    return other
