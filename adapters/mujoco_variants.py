"""Other ways to ask MuJoCo about the same mechanism: its options, and spellings of a mechanism.

A `Change` is what the chain's build and evaluation do otherwise; `VARIANTS` lists them with the names that
each exercises.  Solvers, Jacobians and islands concern constraints, and are asked about loops only.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import reduce
from operator import attrgetter, or_
from pathlib import Path
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np

from adapters import mujoco_actuation as actuation
from adapters import mujoco_shapes as shapes
from adapters.mujoco_common import (
    DOFS,
    MAX_AWAKE,
    bodies_of,
    compiler_of,
    dense_rows,
    member,
    named_joints,
    set_attributes,
    through_inverse,
)
from adapters.pose_functions import FIXED_PLACE, OTHER_TURN, Pose, rate_maps
from plumbline.engines.variants import Suits, Variant, both, every, has, names_of_column, variants_of
from plumbline.model.datatypes import Array, EngineFailure, Model, Unsupported
from plumbline.model.kinematics import quaternion_product
from plumbline.model.probe_frames import PROBE_ATTITUDE

HINGE_ANGLES = np.array([0.4, -0.7, 1.1])  # rad, about x, y, z in turn: far from singular ones
# Of principal moments that MuJoCo finds by itself: of 1,500 random inertias of 1e-9 … 1e3 kg m² they were
# off by 2.4e-14 at most.
ROUNDING = 1e-12
HINGE_TURN = np.array([1.0, 0.0, 0.0, 0.0])
for _half, _axis in zip(HINGE_ANGLES / 2, np.eye(3), strict=True):
    HINGE_TURN = quaternion_product(HINGE_TURN, np.append(np.cos(_half), np.sin(_half) * _axis))
# ω of the body in its own axes = HINGE_RATES (rates of the three hinges)
HINGE_RATES = rate_maps(Pose(np.zeros(3), HINGE_TURN))["xyzdot"]
BALL = ({"type": mujoco.mjtJoint.mjJNT_BALL},)
FREE = ({"type": mujoco.mjtJoint.mjJNT_FREE},)
HINGES, SLIDES = (
    tuple({"type": getattr(mujoco.mjtJoint, f"mjJNT_{kind}"), "axis": axis} for axis in np.eye(3))
    for kind in ("HINGE", "SLIDE")
)


FEW_JOINTS = 4
WRONG = "wrong"  # of what is switched off
TIMES = 0.7, 0.4  # s
LONG_STEP = 2.0**20  # s: of one step of Euler's method, in which v₁ = v₀ + h a to the rounding of h a
# Of what rows of constraints demand, what a solver may leave: 1e-15 was measured where PGS had converged, and
# 1e-10 to 1e-7 where it had not.
MAX_LEFT = 1e-12


def _no_change(*given: Any) -> Any:
    return given if len(given) > 1 else given[0]


NEEDLESS = " ".join(  # flags of what no free mechanism without elements has
    f"mjtDisableBit.mjDSBL_{name}"
    for name in (
        "LIMIT", "CONSTRAINT", "EQUALITY", "CLAMPCTRL", "REFSAFE", "SENSOR", "EULERDAMP", "SPRING", "DAMPER",
    )
)  # fmt: skip
BIAS = "mj_rne"
MOTORS = "mjtDyn.mjDYN_NONE mjtBias.mjBIAS_NONE mjtObj.mjOBJ_ACTUATOR"
SHAPES = (
    "mjtInertiaFromGeom MjsGeom MjsMesh mjtGeom mjtMeshInertia mjtGeomInertia "
    "mjtGeomInertia.mjINERTIA_VOLUME mjtGeomInertia.mjINERTIA_SHELL"
)
LAST_STAGES = "mj_fwdActuation mj_fwdAcceleration mj_fwdConstraint"
STAGES = f"mj_fwdPosition mj_energyPos mj_fwdVelocity mj_energyVel {LAST_STAGES}"
PARTS = (  # the functions that the stages of positions and velocities call, after kinematics
    "mj_makeM mj_factorM mj_makeConstraint mj_projectConstraint mj_transmission mj_energyPos mj_fwdVelocity "
    f"mj_comVel mj_passive mj_referenceConstraint {BIAS} mj_energyVel {LAST_STAGES}"
)
# By function what it finds once more, after `mj_fwdVelocity`.
FOUND_AGAIN = {
    "mj_comVel": "cvel cdof_dot", "mj_passive": "qfrc_passive", BIAS: "qfrc_bias",
    "mj_referenceConstraint": "efc_aref",
}  # fmt: skip


@dataclass(frozen=True)
class Change:
    """What is done otherwise; as it stands nothing."""

    describe: Callable[[Any], Any] = _no_change  # MjSpec → MjSpec, before it is compiled
    remake: Callable[[Any, Any], tuple[Any, Any]] = _no_change  # MjModel and MjData → others
    reset: Callable[[Any, Any], None] = mujoco.mj_resetData
    forward: Callable[[Any, Any], None] = mujoco.mj_forward
    has_own_inertia: bool = False  # whether principal inertias are those that MuJoCo computes
    # whether the description has all numbers, but for what no massless body can have
    is_described: bool = False
    ball_joints: Sequence[Mapping[str, Any]] = BALL  # of bodies and of rods
    free_joints: Sequence[Mapping[str, Any]] = FREE

    @property
    def is_after_compiling(self) -> bool:
        """Whether the description is the usual one."""
        usual = self.describe is _no_change and not self.has_own_inertia and not self.is_described
        return usual and self.ball_joints is BALL and self.free_joints is FREE


def _set_options(**values: Any) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Set fields of `MjOption` before data are made: numbers, members, flags besides those that are set."""

    def remake(m: Any, d: Any) -> tuple[Any, Any]:
        for name, value in values.items():
            given = value
            if isinstance(value, str):
                set_already = getattr(m.opt, name) if name.endswith("flags") else 0
                given = reduce(or_, [int(member(one)) for one in value.split()], set_already)
            setattr(m.opt, name, given)
        return m, mujoco.MjData(m)

    return remake


def _with_needless(m: Any, d: Any) -> tuple[Any, Any]:
    """Give joints springs, dampers and limits, all of them switched off."""
    m.jnt_stiffness[:] = m.dof_damping[:] = 1.0
    m.jnt_limited[m.jnt_type != FREE[0]["type"]], m.jnt_range[:] = True, [10.0, 11.0]
    return _set_options(disableflags=NEEDLESS)(m, d)


def is_constrained(model: Model) -> bool:
    """Whether soft constraints hold a mechanism: loops, and pitches of joints."""
    return _has_loops(model) or _has_pitches(model)


def _has_few_constraints(model: Model) -> bool:
    """Whether an iteration over all rows is cheap."""
    return is_constrained(model) and len(model.kind) <= FEW_JOINTS


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


def _forward_by(parts: str) -> Callable[[Any, Any], None]:
    """Evaluate by functions with these names in turn."""

    def forward(m: Any, d: Any) -> None:
        for part in parts.split():
            for name in FOUND_AGAIN.get(part, "").split():
                getattr(d, name)[:] = 1.0
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


def _state_of(m: Any, d: Any, kind: int) -> Array:
    state = np.empty(mujoco.mj_stateSize(m, kind))
    mujoco.mj_getState(m, d, state, kind)
    return state


def _forward_after_set_state(m: Any, d: Any) -> None:
    """Carry the state and the loads over to data that a reset has emptied."""
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = _state_of(m, d, kind)
    mujoco.mj_resetData(m, d)
    mujoco.mj_setState(m, d, state, kind)
    mujoco.mj_forward(m, d)


def _forward_after_copied_state(m: Any, d: Any) -> None:
    """Carry the state and the loads over to other data and back, positions and velocities once more alone."""
    kind, part = mujoco.mjtState.mjSTATE_INTEGRATION, mujoco.mjtState.mjSTATE_PHYSICS
    other, own = mujoco.MjData(m), np.empty(mujoco.mj_stateSize(m, part))
    mujoco.mj_copyState(m, d, other, kind)
    mujoco.mj_resetData(m, d)
    mujoco.mj_extractState(m, _state_of(m, other, kind), kind, own, part)
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
    """Reach the positions from those of the model by a motion that leads there, and in less time."""
    motion, (slow, fast) = np.zeros(m.nv), TIMES
    mujoco.mj_differentiatePos(m, motion, slow, m.qpos0, d.qpos)
    d.qpos[:] = m.qpos0
    mujoco.mj_integratePos(m, d.qpos, motion * (slow / fast), fast)
    mujoco.mj_forward(m, d)


@contextmanager
def _long_step(m: Any) -> Iterator[None]:
    """Set a step of `LONG_STEP`, semi-implicit with explicit dampers, by which velocities change."""
    flags = m.opt.disableflags
    m.opt.integrator, m.opt.timestep = mujoco.mjtIntegrator.mjINT_EULER, LONG_STEP
    m.opt.disableflags = flags | int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    yield
    m.opt.disableflags = flags


def _forward_by_step(functions: str) -> Callable[[Any, Any], None]:
    """Take the acceleration from the velocity after a step."""

    def forward(m: Any, d: Any) -> None:
        q, v, t = d.qpos.copy(), d.qvel.copy(), d.time
        with _long_step(m):
            for function in functions.split():
                getattr(mujoco, function)(m, d)
        a = (d.qvel - v) / LONG_STEP
        d.qpos[:], d.qvel[:], d.time = q, v, t
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
        with actuation.callbacks(**{name: apply}):
            mujoco.mj_forward(m, d)
        d.qfrc_applied[:] = force

    return forward


def _forward_by_rollout(m: Any, d: Any) -> None:
    """The same by a batch of one step, under the loads as controls."""
    full, loads = mujoco.mjtState.mjSTATE_FULLPHYSICS, mujoco.mjtState.mjSTATE_QFRC_APPLIED
    loads = int(loads) | int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
    state, control = _state_of(m, d, full), _state_of(m, d, loads)
    other = mujoco.MjData(m)
    with _long_step(m):
        after, _ = mujoco.rollout.rollout(m, other, state[None], control[None, None], control_spec=loads)
        mujoco.mj_setState(m, other, np.ravel(after), full)
    mujoco.mj_forward(m, d)
    d.qacc[:] = (other.qvel - d.qvel) / LONG_STEP


def _forward_with_checks(m: Any, d: Any) -> None:
    """Normalise quaternions that are too long, and check all numbers."""
    balls, free = (m.jnt_qposadr[m.jnt_type == kind[0]["type"]] for kind in (BALL, FREE))
    at = np.append(balls, free + 3)[:, None] + np.arange(4)
    d.qpos[at] *= 1.5
    mujoco.mj_normalizeQuat(m, d.qpos)
    if not np.allclose(np.linalg.norm(d.qpos[at], axis=1), 1.0, rtol=0.0, atol=ROUNDING):
        raise EngineFailure("mj_normalizeQuat leaves quaternions that are not of length 1")
    mujoco.mj_checkPos(m, d)
    mujoco.mj_checkVel(m, d)
    mujoco.mj_forward(m, d)
    mujoco.mj_checkAcc(m, d)


def _default_options(m: Any, d: Any) -> tuple[Any, Any]:
    """Set all options anew, among them a thick medium in motion."""
    flags, gravity = m.opt.disableflags, m.opt.gravity.copy()
    m.opt.density, m.opt.viscosity, m.opt.wind = 1e3, 1.0, np.ones(3)
    mujoco.mj_defaultOption(m.opt)
    m.opt.disableflags, m.opt.gravity = flags, gravity
    return m, d


def _forward_by_constraint_matrix(m: Any, d: Any) -> None:
    """Solve for the forces of constraints by their matrix, that of dual solvers, and by its root."""
    mujoco.mj_forward(m, d)
    root = dense_rows(d.efc_Y, m, d, "efc_Y")
    matrices = dense_rows(d.efc_AR, m, d, "efc_AR", len(d.efc_b)), root @ root.T + np.diag(d.efc_R)
    d.efc_force[:] = -sum(np.linalg.solve(matrix, d.efc_b) for matrix in matrices) / 2
    mujoco.mj_mulJacTVec(m, d, d.qfrc_constraint, d.efc_force)
    d.qacc[:] = through_inverse(m, d, d.qfrc_smooth + d.qfrc_constraint)


def _constraint_forces(m: Any, d: Any, softness: Array, reference: Array) -> Array:
    """Solve for the forces of constraints by their Jacobian."""
    rows = dense_rows(d.efc_J, m, d, "efc_J")
    through, product = np.zeros_like(rows), np.zeros(len(rows))
    mujoco.mj_solveM(m, d, through, rows)
    mujoco.mj_mulJacVec(m, d, product, d.qacc_smooth)
    return np.asarray(np.linalg.solve(rows @ through.T + np.diag(softness), reference - product))


def _forward_by_constraint_rows(m: Any, d: Any) -> None:
    """Solve for them by what makes up their softness, and let MuJoCo find them from the residuals."""
    mujoco.mj_forward(m, d)
    impedance = np.reshape(d.efc_KBIP, (-1, 4))[:, 2]
    force = _constraint_forces(m, d, d.efc_diagA * (1 - impedance) / impedance, d.efc_aref)
    mujoco.mj_constraintUpdate(m, d, -force / d.efc_D, None, 0)
    d.qacc[:] = through_inverse(m, d, d.qfrc_smooth + d.qfrc_constraint)


def _forward_by_islands(m: Any, d: Any) -> None:
    """Average what the arrays of islands say of accelerations, and of the forces of constraints."""
    mujoco.mj_forward(m, d)
    rows, dofs, size = d.map_iefc2efc, d.map_idof2dof[: d.nidof], len(d.efc_force)
    softness, reference, own = np.ones((3, size))
    softness[rows], reference[rows], own[rows] = d.iefc_R, d.iefc_aref, d.iefc_force
    d.efc_force[:] = (own + _constraint_forces(m, d, softness, reference)) / 2
    total, of_forces, smooth = d.qfrc_smooth.copy(), *np.zeros((2, m.nv))
    total[dofs] = d.ifrc_smooth + d.ifrc_constraint
    mujoco.mj_mulJacTVec(m, d, of_forces, own)
    d.qacc[:] = smooth[:] = d.qacc_smooth
    smooth[dofs], d.qacc[dofs] = d.iacc_smooth, d.iacc
    d.qacc[:] = (d.qacc + through_inverse(m, d, total) + smooth + through_inverse(m, d, of_forces)) / 3


def _forward_by_switched_welds(m: Any, d: Any) -> None:
    """Switch the equalities on that are off in the model, but for those that would hold what moves."""
    d.eq_active[:] = [not m.equality(i).name.startswith(WRONG) for i in range(m.neq)]
    mujoco.mj_forward(m, d)


def _switched_off(spec: Any) -> Any:
    """Switch all equalities off, and others that would hold hinges and slides where they are not."""
    joints = [joint for joint in named_joints(spec) if DOFS[joint.type] == 1]
    for joint in joints:
        equality = set_attributes(spec.add_equality(), type=mujoco.mjtEq.mjEQ_JOINT, name1=joint.name)
        equality.name, equality.data[0] = f"{WRONG} {joint.name}", 10.0
        if hasattr(equality, "objtype"):
            equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
    for equality in spec.equalities:
        equality.active = False
    return spec


def _never_asleep(spec: Any) -> Any:
    for body in bodies_of(spec):
        if body.parent.name == "world":
            body.sleep = mujoco.mjtSleepPolicy.mjSLEEP_NEVER
    return spec


def _forward_after_steps(m: Any, d: Any) -> None:
    """Take steps of zero length, until all that may fall asleep has."""
    step, m.opt.timestep = m.opt.timestep, 0.0
    d.xfrc_applied[:] += 0.0  # −0 is a load that keeps bodies awake
    for _ in range(MAX_AWAKE):
        mujoco.mj_step(m, d)
    m.opt.timestep = step
    mujoco.mj_forward(m, d)


def _keep(m: Any, d: Any) -> None:
    """Leave what the last state left in the data."""


def _in_frames(spec: Any) -> Any:
    """Put every body in two frames, one in the other, no farther than it is: bodies may be at the origin."""
    for body in bodies_of(spec):
        pose = Pose(np.array(body.pos), np.array(body.quat) / np.linalg.norm(body.quat))
        place = np.linalg.norm(pose.r) * FIXED_PLACE
        frames = Pose(place, PROBE_ATTITUDE), Pose(place[::-1], OTHER_TURN)
        outer, inner = (body.parent.add_frame(pos=frame.r, quat=frame.p) for frame in frames)
        own = (frames[0] * frames[1]).inverse() * pose
        body.pos, body.quat = own.r, own.p
        inner.set_frame(outer)
        body.set_frame(inner)
    return spec


def _oriented(kind: str, convert: Callable[[Pose], Array]) -> Variant:
    """Give the attitudes of bodies and of their inertias in another form than as quaternions."""

    def describe(spec: Any) -> Any:
        compiler = compiler_of(spec)
        compiler.degree, compiler.eulerseq = False, list("xyz")
        for body in bodies_of(spec):
            for orientation, quat in ((body.alt, body.quat), (body.ialt, body.iquat)):
                orientation.type = member(f"mjtOrientation.mjORIENTATION_{kind}")
                pose = Pose(np.zeros(3), np.array(quat) / np.linalg.norm(quat))
                setattr(orientation, kind.lower(), convert(pose))
        return spec

    more = " MjsOrientation" if kind == "EULER" else ""
    return _spelling(f"mjtOrientation.mjORIENTATION_{kind}{more}", describe=describe)


def _has_free_balls(model: Model) -> bool:
    """Whether there are balls or rods, and none with elements, which act on rotation vectors."""
    balls = [k for k, kind in enumerate(model.kinds) if kind.holds_no_turn]
    elements = (model.armature, model.damping, model.stiffness, model.effort)
    return bool(balls) and not any(np.any(x[balls]) for x in elements)


def _has_inertia(model: Model) -> bool:
    """Whether no body is a point mass or flat to rounding, whose full inertia MuJoCo's compiler refuses."""
    moments = np.linalg.eigvalsh(model.inertia)
    return bool(np.all(moments[:, 2] < (1 - ROUNDING) * (moments[:, 0] + moments[:, 1])))


def _is_free(model: Model) -> bool:
    return not is_constrained(model)


_has_loops: Suits = attrgetter("has_loops")
_has_pitches: Suits = lambda model: any(kind.has_pitch for kind in model.kinds)  # noqa: E731
_option = variants_of("option", Change, _is_free)
_spelling = variants_of("spelling", Change, _is_free)


_of_constraints = variants_of("option", Change, is_constrained)
_of_loops = variants_of("option", Change, _has_loops)


def _forward_to_convergence(m: Any, d: Any) -> None:
    """Refuse accelerations and forces that do not fulfil J q̈ + R f = a, as after too few iterations."""
    mujoco.mj_forward(m, d)
    free, left = np.zeros((2, d.nefc))
    for given, rows in ((d.qacc_smooth, free), (d.qacc, left)):
        mujoco.mj_mulJacVec(m, d, rows, given)
        rows -= d.efc_aref
    left += d.efc_R * d.efc_force
    if np.max(np.abs(left), initial=0.0) > MAX_LEFT * np.max(np.abs(free), initial=0.0):
        raise Unsupported(f"the solver has not converged after {m.opt.iterations} iterations")


def _by_parts(kinematics: str) -> Variant:
    """Call the parts of the stages one by one."""
    names = f"{kinematics} {PARTS}"
    return variants_of("option", Change, every)(names, forward=_forward_by(names))


def _options(
    suits: Suits = every, forward: Callable[[Any, Any], None] = mujoco.mj_forward, **values: Any
) -> Variant:
    """Set options that concern constraints; the texts among them are its names."""
    names = " ".join(value for value in values.values() if isinstance(value, str))
    set_options = _set_options(**{"iterations": 100, "tolerance": 0.0} | values)
    return _of_constraints(names, suits, remake=set_options, forward=forward)


def _of_shapes(by: str, describe: Callable[[Any], Any], suits: Suits) -> Variant:
    """Describe bodies of geoms."""
    names = f"mjtInertiaFromGeom.mjINERTIAFROMGEOM_{by} {SHAPES}"
    return _spelling(names, both(_has_inertia, suits), has_own_inertia=True, describe=describe)


def _actuated(
    ways: actuation.Ways,
    read: str = "",
    names: str = "",
    suits: Suits = has("effort"),  # noqa: B008
) -> Variant:
    """Let actuators exert what the joints have."""
    own = actuation.names_of(ways)
    of_motors = f"mjtSensor.mjSENS_{read} {MOTORS} MjData.ctrl" if read else "mjtDyn MjData.act"
    describe, forward = actuation.with_actuators(ways, read), actuation.forward_by_actuators(ways, read)
    every = names or f"{own} {of_motors} mjtTrn.mjTRN_JOINT"
    return _spelling(every, suits, describe=describe, forward=forward)


# Of Newton's method, on a linear problem: the second and third remove rounding, more can add some.
THREE: dict[str, Any] = {"iterations": 3, "tolerance": 0.0}
SPARSE: dict[str, Any] = {"jacobian": "mjtJacobian.mjJAC_SPARSE"}


VARIANTS = (
    _option(STAGES, forward=_forward_by(STAGES)),
    _by_parts("mj_kinematics mj_comPos mj_tendon"),
    _option("mj_forwardSkip mjtStage", forward=_forward_with_skips),
    _option("mj_step1", forward=_forward_by(f"mj_step1 {LAST_STAGES}")),
    _option("mj_getState mj_setState mj_stateSize mj_resetData mjtState", forward=_forward_after_set_state),
    _by_parts("mj_fwdKinematics"),
    _option("mj_copyState mj_extractState", forward=_forward_after_copied_state),
    _option(
        "mj_setKeyframe mj_resetDataKeyframe MjsKey", describe=_with_key, forward=_forward_after_keyframe
    ),
    _option("mj_differentiatePos mj_integratePos", forward=_forward_from_reference),
    _option("mj_Euler", forward=_forward_by_step("mj_forward mj_Euler")),
    _option(
        "mj_step mjtIntegrator mjtIntegrator.mjINT_EULER MjOption.integrator MjOption.timestep",
        forward=_forward_by_step("mj_step"),
    ),
    _option("mj_step2", forward=_forward_by_step("mj_step1 mj_step2")),
    _option("set_mjcb_passive", forward=_forward_by_callback("passive")),
    _option("set_mjcb_control", forward=_forward_by_callback("control")),
    _option(NEEDLESS, lambda model: not model.has_elements, remake=_with_needless),
    _option("MjData", reset=_keep),
    _option("mj_copyData", remake=_copied_data),
    _option("MjModel", remake=lambda m, d: pickle.loads(pickle.dumps((m, d)))),
    _option("MjModel MjData", remake=lambda m, d: (copy(m), copy(d))),
    _option("mj_saveModel", remake=_binary),
    _option("rollout.rollout", forward=_forward_by_rollout),
    _option("mj_normalizeQuat mj_checkPos mj_checkVel mj_checkAcc", forward=_forward_with_checks),
    _option("mj_defaultOption", remake=_default_options),
    _of_constraints(
        "mj_mulJacTVec MjData.efc_AR MjData.efc_b MjData.efc_Y MjData.efc_R",
        remake=_set_options(**THREE, **SPARSE, solver="mjtSolver.mjSOL_PGS"),
        forward=_forward_by_constraint_matrix,
    ),
    _of_constraints(
        "mj_mulJacVec mj_constraintUpdate MjData.efc_J MjData.efc_aref MjData.efc_D MjData.efc_diagA "
        "MjData.efc_KBIP",
        remake=_set_options(**THREE, **SPARSE),
        forward=_forward_by_constraint_rows,
    ),
    _of_loops(
        "mj_island MjData.iacc MjData.iefc_force MjData.iacc_smooth MjData.ifrc_smooth "
        "MjData.ifrc_constraint MjData.iefc_R MjData.iefc_aref",
        remake=_set_options(**THREE, **SPARSE),
        forward=_forward_by_islands,
    ),
    _of_loops("MjData.eq_active", describe=_switched_off, forward=_forward_by_switched_welds),
    _of_loops(
        "MjOption.ls_iterations MjOption.ls_tolerance",
        # other limits than by default: Newton's whole step is right of a linear problem, whatever they are
        remake=_set_options(**THREE, ls_iterations=7, ls_tolerance=1e-3),
    ),
    _option(
        "mjtEnableBit.mjENBL_SLEEP mjtSleepPolicy MjOption.sleep_tolerance",
        describe=_never_asleep,
        # of what may sleep, all is slow enough
        remake=_set_options(sleep_tolerance=1e9, enableflags="mjtEnableBit.mjENBL_SLEEP"),
        forward=_forward_after_steps,
    ),
    _options(iterations=3, **SPARSE),
    _options(**SPARSE, solver="mjtSolver.mjSOL_CG", disableflags="mjtDisableBit.mjDSBL_WARMSTART"),
    # Its error falls as that of Gauss and Seidel's method, by 1 − 3e-4 an iteration at a state of
    # flyball-governor; it stops where an iteration changes little.
    _options(
        _has_few_constraints,
        _forward_to_convergence,
        iterations=400_000,
        tolerance=1e-34,
        solver="mjtSolver.mjSOL_PGS",
    ),
    _options(jacobian="mjtJacobian.mjJAC_DENSE", disableflags="mjtDisableBit.mjDSBL_ISLAND"),
    _actuated(actuation.STATELESS, "ACTUATORFRC"),
    _actuated(actuation.WITH_STATE),
    _actuated(
        actuation.SERVO,
        "JOINTACTFRC",
        "mjtGain.mjGAIN_FIXED mjtBias.mjBIAS_AFFINE mjtSensor.mjSENS_JOINTACTFRC",
        has("stiffness", "damping"),
    ),
    _actuated(actuation.PID, names="mjtGain.mjGAIN_PID mjtDyn.mjDYN_PID mjtCtrlInput"),
    _spelling(
        f"{actuation.CALLBACKS} {actuation.names_of(actuation.BY_CALLBACK)}",
        has("effort"),
        describe=actuation.with_actuators(actuation.BY_CALLBACK),
        forward=actuation.forward_by_callbacks,
    ),
    _spelling(
        "mjtWrap.mjWRAP_JOINT mjtTendon mjtObj.mjOBJ_TENDON mjtSensor.mjSENS_TENDONACTFRC "
        "mjtTrn.mjTRN_TENDON",
        both(
            has("effort", "stiffness", "damping", "armature"),
            lambda model: any(kind.motions for kind in model.kinds),
        ),
        describe=actuation.with_fixed_tendons,
        remake=actuation.elements_on_tendons,
        forward=actuation.forward_by_tendons,
    ),
    _option(
        "MjOption.disableactuator mjtLimited",
        describe=actuation.with_far_limits,
        remake=_set_options(disableactuator=1 << actuation.GROUP_OFF),
        forward=actuation.forward_with_group_off,
    ),
    _spelling(
        "MjData.qfrc_gravcomp", describe=actuation.with_gravcomp, forward=actuation.forward_without_gravity
    ),
    _spelling(
        "MjsBody MjData.qfrc_gravcomp",
        lambda model: any(kind.is_rigid for kind in model.kinds),  # fixed to others
        describe=actuation.with_gravcomp_of_attached,
        forward=actuation.forward_without_gravity,
    ),
    _option("mjtDisableBit.mjDSBL_GRAVITY", forward=actuation.forward_without_gravity),
    _spelling("MjSpec", _has_inertia, is_described=True, describe=lambda spec: spec.copy()),
    _spelling("MjsFrame", describe=_in_frames),
    _oriented("EULER", lambda pose: pose.forms["xyz"]),
    _oriented("AXISANGLE", lambda pose: np.append(pose.forms["axis"], pose.forms["angle"])),
    _oriented("XYAXES", lambda pose: pose.R[:, :2].T.ravel()),
    _spelling("mjtOrientation.mjORIENTATION_ZAXIS", describe=shapes.in_z_frames),
    _spelling("MjsDefault", _has_inertia, is_described=True, describe=shapes.attached),
    _spelling(
        "MjsBody mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE",
        _has_inertia,
        has_own_inertia=True,
        describe=shapes.without_shapes,
    ),
    _of_shapes("AUTO", shapes.of_shapes, has("rods")),
    _of_shapes("TRUE", shapes.of_shapes_only, lambda model: not np.any(model.rods)),
    variants_of("spelling", Change, _has_loops)("mjtEq.mjEQ_CONNECT", describe=shapes.welds_as_points),
    _spelling("mjtJoint.mjJNT_HINGE", _has_free_balls, ball_joints=HINGES),
    _spelling("mjtJoint.mjJNT_SLIDE", has("free"), free_joints=(*SLIDES, *BALL)),
)  # fmt: skip


COLUMN_NAMES = names_of_column(
    "mujoco",
    {
        "without constraints": _is_free,
        "balls and rods": lambda model: any(kind.holds_no_turn for kind in model.kinds),
        "free bodies": has("free"),
        "loops": _has_loops,
        "pitches": _has_pitches,
        "springs between points": lambda model: len(model.spring_body) > 0,
        "moments and drag": has("moment", "drag_force", "drag_moment"),
    },
)
