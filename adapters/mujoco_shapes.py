"""Other descriptions for MuJoCo's compiler: bodies of geoms, frames by their z axes, loops by points."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from adapters.mujoco_common import bodies_of, children_of, compiler_of
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
    for k, body in enumerate(bodies_of(spec)):
        if np.isnan(body.fullinertia[0]):
            continue
        xx, yy, zz, xy, xz, yz = body.fullinertia
        moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, axes.ravel())
        mass, body.explicitinertial, body.fullinertia = body.mass, False, np.full(6, np.nan)
        body.ipos = np.full(3, np.nan)
        round_part = ROUND * (np.sum(moments) - 2 * np.max(moments))
        piece, own = SHARE * mass, round_part / 3
        radius = np.sqrt(own / piece)
        for kind, size, is_shell in (
            ("SPHERE", [np.sqrt(5 / 2) * radius, 0, 0], False),
            ("SPHERE", [np.sqrt(3 / 2) * radius, 0, 0], True),
            ("CYLINDER", [np.sqrt(2) * radius, np.sqrt(3 / 2) * radius, 0], False),
        ):
            _add_geom(body, kind, piece, size, quat, is_shell)
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


def _add_geom(body: Any, kind: str, mass: float, size: Any, quat: Array, is_shell: bool = False) -> Any:
    geom = body.add_geom()
    geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")
    geom.size, geom.mass, geom.quat, geom.contype, geom.conaffinity = size, mass, quat, 0, 0
    if is_shell:
        geom.typeinertia = mujoco.mjtGeomInertia.mjINERTIA_SHELL
    return geom


def _add_mesh(spec: Any, body: Any, name: str, mass: float, half: Array, quat: Array) -> None:
    mesh = spec.add_mesh()
    mesh.name, mesh.inertia = name, mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    mesh.uservert, mesh.userface = (signs * half).ravel(), MESH_FACES.ravel()
    _add_geom(body, "MESH", mass, [0, 0, 0], quat).meshname = name


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
                site = body.add_site()
                site.name, site.pos = name, place
            one = weld if i == 2 else spec.add_equality()
            one.solref, one.solimp = weld.solref, weld.solimp
            one.type, one.objtype = mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtObj.mjOBJ_SITE
            one.name1, one.name2 = names
    return spec


def attached(spec: Any) -> Any:
    """Attach the whole to an empty one, whose defaults have another rotor, damper and spring of joints."""
    attach, other = mujoco.MjSpec.attach, mujoco.MjSpec()
    compiler_of(other).autolimits = False
    other.default.joint.armature = 3.0
    attach(other, spec, frame=other.worldbody.add_frame(), prefix="attached ")
    return other
