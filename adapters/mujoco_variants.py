"""Other ways to ask MuJoCo about the same mechanism: its options, and spellings of a mechanism.

A `Change` is what the chain's build and evaluation do otherwise; `VARIANTS` lists them with the names that
each exercises.  Solvers, Jacobians and islands concern constraints, and are asked about loops only.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from adapters.pose_functions import xyz_angles
from plumbline.engines.variants import Variant, VariantKind
from plumbline.model.datatypes import Array, Call, Float, Model
from plumbline.model.kinematics import quaternion_conjugate, quaternion_product, rotation_matrix

HINGE_ANGLES = np.array([0.4, -0.7, 1.1])  # rad, about x, y, z in turn: far from singular ones
# Of principal moments that MuJoCo finds by itself: of 1,500 random inertias of 1e-9 … 1e3 kg m² they were
# off by 2.4e-14 at most.
ROUNDING = 1e-12
FRAME_POINT, FRAME_TURN = np.array([0.3, -0.2, 0.5]), np.array([1.0, 2.0, 3.0, 4.0]) / np.sqrt(30.0)


def _turns() -> list[Array]:
    halves = HINGE_ANGLES / 2
    return [np.append(np.cos(h), np.sin(h) * e) for h, e in zip(halves, np.eye(3), strict=True)]


_X, _Y, _Z = _turns()
HINGE_TURN = quaternion_product(quaternion_product(_X, _Y), _Z)
# ω of the body in its own axes = HINGE_RATES (rates of the three hinges)
HINGE_RATES = np.stack(
    [
        rotation_matrix(quaternion_product(_Y, _Z)).T @ np.eye(3)[0],
        rotation_matrix(_Z).T @ np.eye(3)[1],
        np.eye(3)[2],
    ],
    axis=1,
)


BALL = ({"type": mujoco.mjtJoint.mjJNT_BALL},)
HINGES, SLIDES = (
    tuple({"type": getattr(mujoco.mjtJoint, f"mjJNT_{kind}"), "axis": axis} for axis in np.eye(3))
    for kind in ("HINGE", "SLIDE")
)


FEW_JOINTS = 4


def _no_change(*given: Any) -> Any:
    return given if len(given) > 1 else given[0]


NEEDLESS = tuple(  # flags of what no free mechanism without elements has
    f"mjtDisableBit.mjDSBL_{name}"
    for name in (
        "LIMIT", "CONSTRAINT", "EQUALITY", "CLAMPCTRL", "REFSAFE", "SENSOR", "EULERDAMP", "SPRING", "DAMPER",
    )
)  # fmt: skip
BIAS = "mj_rne"
LAST_STAGES = ("mj_fwdActuation", "mj_fwdAcceleration", "mj_fwdConstraint")
STAGES = ("mj_fwdPosition", "mj_energyPos", "mj_fwdVelocity", "mj_energyVel", *LAST_STAGES)
PARTS = (  # the functions that the stages of positions and velocities call
    "mj_kinematics", "mj_comPos", "mj_tendon", "mj_makeM", "mj_factorM", "mj_makeConstraint",
    "mj_projectConstraint", "mj_transmission", "mj_energyPos", "mj_fwdVelocity", "mj_comVel", "mj_passive",
    "mj_referenceConstraint", BIAS, "mj_energyVel", *LAST_STAGES,
)  # fmt: skip
OTHER_PARTS = (
    "mj_fwdKinematics",
    *(x for x in PARTS if x not in ("mj_kinematics", "mj_comPos", "mj_tendon")),
)


@dataclass(frozen=True)
class Change:
    """What is done otherwise; as it stands nothing."""

    describe: Callable[[Any], Any] = _no_change  # MjSpec → MjSpec, before it is compiled
    remake: Callable[[Any, Any], tuple[Any, Any]] = _no_change  # MjModel and MjData → others
    reset: Callable[[Any, Any], None] = mujoco.mj_resetData
    forward: Callable[[Any, Any], None] = mujoco.mj_forward
    has_own_inertia: bool = False  # whether principal inertias are those that MuJoCo computes
    ball_joints: Sequence[Mapping[str, Any]] = BALL  # of bodies and of rods
    free_joints: Sequence[Mapping[str, Any]] = ({"type": mujoco.mjtJoint.mjJNT_FREE},)


def _options(
    iterations: int = 100,
    tolerance: float = 0.0,
    suits: Callable[[Model], bool] = lambda model: is_constrained(model),
    **members: str,
) -> Variant:
    """Set fields of `MjOption` to members of their enumerations; they concern constraints, of loops."""

    def remake(m: Any, d: Any) -> tuple[Any, Any]:
        m.opt.iterations, m.opt.tolerance = iterations, tolerance
        for name, member in members.items():
            enumeration, _, entry = member.partition(".")
            value = getattr(getattr(mujoco, enumeration), entry)
            before = m.opt.disableflags if name == "disableflags" else 0
            setattr(m.opt, name, int(value) | before)
        return m, d

    return Variant("option", tuple(members.values()), Change(remake=remake), suits)


def is_constrained(model: Model) -> bool:
    """Whether soft constraints hold a mechanism: loops, and pitches of joints."""
    return model.has_loops or any(kind.has_pitch for kind in model.kinds)


def _has_few_constraints(model: Model) -> bool:
    """Whether an iteration over all rows is cheap."""
    return is_constrained(model) and len(model.kind) <= FEW_JOINTS


def _is_free(model: Model) -> bool:
    return not is_constrained(model)


def _binary(m: Any, d: Any) -> tuple[Any, Any]:
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "m.mjb")
        mujoco.mj_saveModel(m, path, None)
        m = mujoco.MjModel.from_binary_path(path)
    return m, mujoco.MjData(m)


def _copied_data(m: Any, d: Any) -> tuple[Any, Any]:
    other = mujoco.MjData(m)
    mujoco.mj_copyData(other, m, d)
    return m, other


def _forward_by(*parts: str) -> Callable[[Any, Any], None]:
    """Evaluate by these functions in turn."""

    def forward(m: Any, d: Any) -> None:
        for part in parts:
            more = (0, d.qfrc_bias) if part == BIAS else ()
            getattr(mujoco, part)(m, d, *more)

    return forward


def _forward_with_skips(m: Any, d: Any) -> None:
    """Evaluate at rest, then velocities only, then accelerations only, under the loads that count."""
    v, force = d.qvel.copy(), d.qfrc_applied.copy()
    d.qvel[:], d.qfrc_applied[:] = 0.0, 0.0
    mujoco.mj_forwardSkip(m, d, mujoco.mjtStage.mjSTAGE_NONE, 1)
    d.qvel[:] = v
    mujoco.mj_forwardSkip(m, d, mujoco.mjtStage.mjSTAGE_POS, 1)
    d.qfrc_applied[:] = force
    mujoco.mj_forwardSkip(m, d, mujoco.mjtStage.mjSTAGE_VEL, 0)


def _forward_after_set_state(m: Any, d: Any) -> None:
    """Carry the state and the loads over to data that a reset has emptied."""
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(m, kind))
    mujoco.mj_getState(m, d, state, kind)
    mujoco.mj_resetData(m, d)
    mujoco.mj_setState(m, d, state, kind)
    mujoco.mj_forward(m, d)


def _forward_after_copied_state(m: Any, d: Any) -> None:
    """Carry the state and the loads over to other data and back, positions and velocities once more alone."""
    kind, part = mujoco.mjtState.mjSTATE_INTEGRATION, mujoco.mjtState.mjSTATE_PHYSICS
    other, state = mujoco.MjData(m), np.empty(mujoco.mj_stateSize(m, kind))
    mujoco.mj_copyState(m, d, other, kind)
    mujoco.mj_resetData(m, d)
    mujoco.mj_getState(m, other, state, kind)
    own = np.empty(mujoco.mj_stateSize(m, part))
    mujoco.mj_extractState(m, state, kind, own, part)
    mujoco.mj_copyState(m, other, d, kind)
    d.qpos[:], d.qvel[:] = m.qpos0, 0.0
    mujoco.mj_setState(m, d, own, part)
    mujoco.mj_forward(m, d)


def _with_key(spec: Any) -> Any:
    """Give the model a keyframe."""
    spec.add_key()
    return spec


def _forward_after_keyframe(m: Any, d: Any) -> None:
    """Keep the state in a keyframe and reset the data to it; it has no loads."""
    loads = d.qfrc_applied.copy(), d.xfrc_applied.copy()
    mujoco.mj_setKeyframe(m, d, 0)
    mujoco.mj_resetDataKeyframe(m, d, 0)
    d.qfrc_applied[:], d.xfrc_applied[:] = loads
    mujoco.mj_forward(m, d)


def _forward_from_reference(m: Any, d: Any) -> None:
    """Reach the positions from those of the model by the motion that leads there in one second."""
    motion = np.zeros(m.nv)
    mujoco.mj_differentiatePos(m, motion, 1.0, m.qpos0, d.qpos)
    d.qpos[:] = m.qpos0
    mujoco.mj_integratePos(m, d.qpos, motion, 1.0)
    mujoco.mj_forward(m, d)


def _forward_by_step(*functions: str) -> Callable[[Any, Any], None]:
    """Take the acceleration from the velocity after a step of 1 s, semi-implicit with explicit dampers."""

    def forward(m: Any, d: Any) -> None:
        flags, (q, v, t) = m.opt.disableflags, (d.qpos.copy(), d.qvel.copy(), d.time)
        m.opt.integrator, m.opt.timestep = mujoco.mjtIntegrator.mjINT_EULER, 1.0
        m.opt.disableflags = flags | int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        for function in functions:
            getattr(mujoco, function)(m, d)
        a = d.qvel - v
        d.qpos[:], d.qvel[:], d.time, m.opt.disableflags = q, v, t, flags
        mujoco.mj_forward(m, d)
        d.qacc[:] = a

    return forward


def _forward_by_callback(name: str) -> Callable[[Any, Any], None]:
    """Apply the forces of the joints in a callback of the engine."""

    def forward(m: Any, d: Any) -> None:
        force = d.qfrc_applied.copy()
        place = d.qfrc_passive if name == "passive" else d.qfrc_applied

        def apply(*_: Any) -> None:
            place[:] = place + force if name == "passive" else force

        d.qfrc_applied[:] = 0.0
        getattr(mujoco, f"set_mjcb_{name}")(apply)
        try:
            mujoco.mj_forward(m, d)
        finally:
            getattr(mujoco, f"set_mjcb_{name}")(None)
        d.qfrc_applied[:] = force

    return forward


def _flags(m: Any, d: Any) -> tuple[Any, Any]:
    """Disable what the mechanism has none of."""
    for flag in NEEDLESS:
        m.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, flag.partition(".")[2]))
    return m, d


def _keep(m: Any, d: Any) -> None:
    """Leave what the last state left in the data."""


def _bodies(spec: Any) -> list[Any]:
    return list(spec.bodies)[1:]


def _in_frames(spec: Any) -> Any:
    """Put every body in two frames, one in the other."""
    for body in _bodies(spec):
        back = quaternion_conjugate(FRAME_TURN)
        outer = body.parent.add_frame(pos=FRAME_POINT, quat=FRAME_TURN)
        inner = body.parent.add_frame(pos=-rotation_matrix(back) @ FRAME_POINT, quat=back)
        inner.set_frame(outer)
        body.set_frame(inner)
    return spec


def _oriented(kind: str, field: str, convert: Callable[[Array], Array]) -> Callable[[Any], Any]:
    """Give the attitudes of bodies and of their inertias in another form than as quaternions."""

    def describe(spec: Any) -> Any:
        spec.compiler.degree, spec.compiler.eulerseq = False, list("xyz")
        for body in _bodies(spec):
            for orientation, quat in ((body.alt, body.quat), (body.ialt, body.iquat)):
                orientation.type = getattr(mujoco.mjtOrientation, f"mjORIENTATION_{kind}")
                setattr(orientation, field, convert(np.array(quat)))
        return spec

    return describe


def _euler_angles(q: Float[Array, "4"]) -> Float[Array, "3"]:
    return xyz_angles(rotation_matrix(q / np.linalg.norm(q)))


def _axis_angle(q: Float[Array, "4"]) -> Float[Array, "4"]:
    size = np.linalg.norm(q[1:])
    axis = q[1:] / size if size else np.array([0.0, 0.0, 1.0])
    return np.append(axis, 2 * np.arctan2(size, q[0]))


def _xy_axes(q: Float[Array, "4"]) -> Float[Array, "6"]:
    return rotation_matrix(q / np.linalg.norm(q))[:, :2].T.ravel()


def _has_free_balls(model: Model) -> bool:
    """Whether a tree has balls or rods, and none with elements, which act on rotation vectors."""
    balls = [k for k, kind in enumerate(model.kinds) if kind.holds_no_turn]
    elements = (model.armature, model.damping, model.stiffness, model.effort)
    return _is_free(model) and bool(balls) and not any(np.any(x[balls]) for x in elements)


def _has_inertia(model: Model) -> bool:
    """Whether no body is a point mass or flat to rounding, whose full inertia MuJoCo's compiler refuses."""
    moments = np.linalg.eigvalsh(model.inertia)
    is_flat = moments[:, 2] >= (1 - ROUNDING) * (moments[:, 0] + moments[:, 1])
    return _is_free(model) and not np.any(is_flat)


def _has_free_bodies(model: Model) -> bool:
    return _is_free(model) and bool(np.any(model.free))


def _free(kind: VariantKind, names: Call, **change: Any) -> Variant:
    """Describe a variant of all mechanisms without constraints."""
    return Variant(kind, names, Change(**change), _is_free)


VARIANTS = (
    _free("option", STAGES, forward=_forward_by(*STAGES)),
    Variant("option", PARTS, Change(forward=_forward_by(*PARTS)), lambda _: True),
    _free("option", ("mj_forwardSkip", "mjtStage"), forward=_forward_with_skips),
    _free("option", ("mj_step1",), forward=_forward_by("mj_step1", *LAST_STAGES)),
    _free(
        "option",
        ("mj_getState", "mj_setState", "mj_stateSize", "mj_resetData"),
        forward=_forward_after_set_state,
    ),
    Variant("option", OTHER_PARTS, Change(forward=_forward_by(*OTHER_PARTS)), lambda _: True),
    _free("option", ("mj_copyState", "mj_extractState"), forward=_forward_after_copied_state),
    _free(
        "option",
        ("mj_setKeyframe", "mj_resetDataKeyframe", "MjsKey"),
        describe=_with_key,
        forward=_forward_after_keyframe,
    ),
    _free("option", ("mj_differentiatePos", "mj_integratePos"), forward=_forward_from_reference),
    _free("option", ("mj_Euler",), forward=_forward_by_step("mj_forward", "mj_Euler")),
    _free("option", ("mj_step2",), forward=_forward_by_step("mj_step1", "mj_step2")),
    _free("option", ("set_mjcb_passive",), forward=_forward_by_callback("passive")),
    _free("option", ("set_mjcb_control",), forward=_forward_by_callback("control")),
    Variant(
        "option", NEEDLESS, Change(remake=_flags), lambda model: _is_free(model) and not model.has_elements
    ),
    _free("option", ("MjData",), reset=_keep),
    _free("option", ("mj_copyData",), remake=_copied_data),
    _free("option", ("MjModel",), remake=lambda m, d: pickle.loads(pickle.dumps((m, d)))),
    _free("option", ("MjModel", "MjData"), remake=lambda m, d: (copy(m), copy(d))),
    _free("option", ("mj_saveModel",), remake=_binary),
    # Of Newton's method, on a linear problem: the second and third remove rounding, more can add some.
    _options(3, jacobian="mjtJacobian.mjJAC_SPARSE"),
    _options(
        jacobian="mjtJacobian.mjJAC_SPARSE",
        solver="mjtSolver.mjSOL_CG",
        disableflags="mjtDisableBit.mjDSBL_WARMSTART",
    ),
    # Its error falls as that of Gauss and Seidel's method, by 1 − 3e-4 an iteration at a state of
    # flyball-governor; it stops where an iteration changes little.
    _options(400_000, 1e-34, _has_few_constraints, solver="mjtSolver.mjSOL_PGS"),
    _options(jacobian="mjtJacobian.mjJAC_DENSE", disableflags="mjtDisableBit.mjDSBL_ISLAND"),
    _free("spelling", ("MjSpec",), describe=lambda spec: spec.copy()),
    _free("spelling", ("MjsFrame",), describe=_in_frames),
    _free(
        "spelling",
        ("mjtOrientation.mjORIENTATION_EULER", "MjsOrientation"),
        describe=_oriented("EULER", "euler", _euler_angles),
    ),
    _free(
        "spelling",
        ("mjtOrientation.mjORIENTATION_AXISANGLE",),
        describe=_oriented("AXISANGLE", "axisangle", _axis_angle),
    ),
    _free(
        "spelling", ("mjtOrientation.mjORIENTATION_XYAXES",), describe=_oriented("XYAXES", "xyaxes", _xy_axes)
    ),
    Variant("spelling", ("MjsBody",), Change(has_own_inertia=True), _has_inertia),
    Variant("spelling", ("mjtJoint.mjJNT_HINGE",), Change(ball_joints=HINGES), _has_free_balls),
    Variant("spelling", ("mjtJoint.mjJNT_SLIDE",), Change(free_joints=(*SLIDES, *BALL)), _has_free_bodies),
)
