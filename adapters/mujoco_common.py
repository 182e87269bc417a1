"""What the files about MuJoCo share: elements of specs, products with matrices, sparse rows, warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np

from plumbline.model.datatypes import Array, Float

DOFS = {
    mujoco.mjtJoint.mjJNT_FREE: 6, mujoco.mjtJoint.mjJNT_BALL: 3,
    mujoco.mjtJoint.mjJNT_HINGE: 1, mujoco.mjtJoint.mjJNT_SLIDE: 1,
}  # fmt: skip
MAX_AWAKE = 12  # steps after which what may sleep does


def member(name: str) -> Any:
    """A member of an enumeration, as mjtSolver.mjSOL_CG."""
    enumeration, _, entry = name.partition(".")
    return getattr(getattr(mujoco, enumeration), entry)


def set_attributes(element: Any, **attributes: Any) -> Any:
    """Set attributes of an element of a spec; only later versions take them as arguments."""
    for name, value in attributes.items():
        setattr(element, name, value)
    return element


def add_sensor(spec: Any, kind: str, of: str, target: str, name: str = "") -> Any:
    """Add a sensor to an element, named by its kind and the element unless it has a name."""
    return set_attributes(
        spec.add_sensor(), name=name or f"{kind} {target}", type=member(f"mjtSensor.mjSENS_{kind}"),
        objtype=member(f"mjtObj.mjOBJ_{of}"), objname=target,
    )  # fmt: skip


def add_actuator(
    spec: Any, name: str, transmission: str, target: str, gear: Float[Array, "6"], **attributes: Any
) -> Any:
    """Add one that is named and drives an element."""
    trntype = member(f"mjtTrn.mjTRN_{transmission}")
    given = {"name": name, "target": target, "trntype": trntype, "gear": gear}
    return set_attributes(spec.add_actuator(), **given, **attributes)


def compiler_of(spec: Any) -> Any:
    """The compiler's options; in 3.2.0 to 3.2.4 they are attributes of the spec itself."""
    return getattr(spec, "compiler", spec)


def children_of(body: Any, kind: str = "body") -> list[Any]:
    """What a body has of one kind; older versions have no lists."""
    found = [getattr(body, f"first_{kind}")()]
    while found[-1]:
        found.append(getattr(body, f"next_{kind}")(found[-1]))
    return found[:-1]


def bodies_of(spec: Any) -> list[Any]:
    """All bodies but the world, parents first."""
    _ = spec.bodies  # 3.2.0 has none, and crashes where a body has no children
    found = children_of(spec.worldbody)
    for body in found:
        found += children_of(body)
    return found


def named_joints(spec: Any) -> list[Any]:
    """The joints of a spec; those without a name are given one."""
    joints = [joint for body in bodies_of(spec) for joint in children_of(body, "joint")]
    for j, joint in enumerate(joints):
        joint.name = joint.name or f"joint {j}"
    return joints


def data_like(m: Any, d: Any, *names: str) -> Any:
    """Other data with the positions and the velocities of some, and more arrays."""
    other = mujoco.MjData(m)
    for name in ("qpos", "qvel", *names):
        getattr(other, name)[:] = getattr(d, name)
    return other


def times_mass(m: Any, d: Any, v: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """Return M v."""
    product = np.zeros(m.nv)
    mujoco.mj_mulM(m, d, product, np.array(v))
    return product


def through_inverse(m: Any, d: Any, force: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """Return M⁻¹ f."""
    found = np.zeros((1, m.nv))
    mujoco.mj_solveM(m, d, found, np.array(force)[None])
    return np.asarray(found[0])


def structure_of(m: Any, d: Any, name: str) -> Any:
    """What has the structure of a sparse matrix: the model, in older versions the data."""
    return d if hasattr(d, f"{name}_rowadr") else m


def dense_rows(
    values: Float[Array, "*stored"], m: Any, d: Any, name: str, width: int = 0
) -> Float[Array, "rows width"]:
    """A sparse matrix as a dense one, of as many columns as rates by default; old versions hold it so."""
    if values.ndim == 2:
        return values
    of, width = structure_of(m, d, name), width or m.nv
    counts, starts, columns = (getattr(of, f"{name}_{x}") for x in ("rownnz", "rowadr", "colind"))
    if values.size == len(counts) * width and not np.any(counts):
        return np.reshape(values, (-1, width))
    dense = np.zeros((len(counts), width))
    for row, start, count in zip(dense, starts, counts, strict=True):
        row[columns[start : start + count]] = values[start : start + count]
    return dense


def full_mass_matrix(m: Any, d: Any) -> Float[Array, "nv nv"]:
    """Return the dense mass matrix; `mj_fullM` of older versions (3.4 among them) takes others."""
    M = np.zeros((m.nv, m.nv))
    try:
        mujoco.mj_fullM(m, d, M)
    except TypeError:
        mujoco.mj_fullM(m, M, d.qM)
    return M


def principal_inertia(J: Float[Array, "3 3"]) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
    """Return principal inertias and the quaternion of their axes; MuJoCo's own are less accurate."""
    values, axes = np.linalg.eigh(J)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    q = np.empty(4)
    mujoco.mju_mat2Quat(q, axes.ravel())
    return values, q


def symmetric(six: Float[Array, "6"]) -> Float[Array, "3 3"]:
    """Return the matrix whose entries xx, yy, zz, xy, xz, yz these are."""
    return np.asarray(six)[[[0, 3, 4], [3, 1, 5], [4, 5, 2]]]


@contextmanager
def warnings_to(receive: Callable[[str], Any]) -> Iterator[None]:
    """Give MuJoCo's warnings to a function; else they go to a log file in the current folder."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(receive)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
