"""Springs, dampers, efforts and rotors of joints by MuJoCo's actuators and tendons, and shapes of bodies.

Each takes over, for one evaluation, what the joints have: the forces are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np

from adapters.mujoco_common import (
    DOFS,
    add_actuator,
    add_sensor,
    bodies_of,
    children_of,
    dense_rows,
    member,
    named_joints,
    set_attributes,
    through_inverse,
)
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import rotation_matrix

J = mujoco.mjtJoint
Ways = Mapping[str, Mapping[str, str]]  # by way of an effort what its actuators have besides a gear
GEAR, COEFFICIENT = -2.0, 0.5  # of actuators; of joints in fixed tendons
STATELESS: Ways = {
    "motor": {}, "affine": {"gaintype": "mjtGain.mjGAIN_AFFINE"},
    "parent": {"trntype": "mjtTrn.mjTRN_JOINTINPARENT"},
}  # fmt: skip
WITH_STATE: Ways = {
    "integrator": {"dyntype": "mjtDyn.mjDYN_INTEGRATOR"}, "filter": {"dyntype": "mjtDyn.mjDYN_FILTER"},
    "exact": {"dyntype": "mjtDyn.mjDYN_FILTEREXACT"},
}  # fmt: skip
BY_CALLBACK: Ways = {
    "user": {"gaintype": "mjtGain.mjGAIN_USER", "biastype": "mjtBias.mjBIAS_USER"},
    "own state": {"dyntype": "mjtDyn.mjDYN_USER"},
}
PID: Ways = {"pid": {"gaintype": "mjtGain.mjGAIN_PID"}}
PID_GAINS = np.array([3.0, 2.0, 4.0])  # of position, velocity and integral
CALLBACKS = "set_mjcb_act_gain set_mjcb_act_bias set_mjcb_act_dyn"
SERVO: Ways = {"servo": {"biastype": "mjtBias.mjBIAS_AFFINE"}, "motor": {}}
USER_RATE = 0.5  # of an activation, per control
GROUP_OFF = 3  # of actuators that are off
FAR = 1e6  # of limits that are never reached [rad, m, N or N m]


def with_actuators(ways: Ways, read: str = "") -> Callable[[Any], Any]:
    """Add to every rate of every joint an actuator of each way, without a force so far.

    Args:
        read: sensors of their forces to add.

    """

    def describe(spec: Any) -> Any:
        for joint in named_joints(spec):
            for way, members in ways.items():
                for i in range(DOFS[joint.type]):
                    actuator = add_actuator(
                        spec, f"{way} of {joint.name} {i}", "JOINT", joint.name, GEAR * np.eye(6)[i]
                    )
                    actuator.gainprm[0], actuator.dynprm[0] = 1.0, 0.1
                    set_attributes(actuator, **{name: member(one) for name, one in members.items()})
                    if way == "pid":
                        inputs = mujoco.mjtCtrlInput
                        total = sum(map(int, (inputs.mjINPUT_POS, inputs.mjINPUT_VEL, inputs.mjINPUT_FF)))
                        kp, kv, ki = PID_GAINS
                        actuator.set_to_pid(kp=kp, kv=kv, ki=ki, ctrlspec=total)
                    actuator.actearly = "dyntype" in members
                    if actuator.dyntype == mujoco.mjtDyn.mjDYN_USER:
                        actuator.actdim = 1
        if read:
            _add_sensors(spec, read)
        return spec

    return describe


def _add_sensors(spec: Any, kind: str) -> None:
    """Add sensors of the forces of actuators: of each, or at scalar joints or tendons."""
    of, elements = {
        "JOINTACTFRC": ("JOINT", [x for x in named_joints(spec) if DOFS[x.type] == 1]),
        "ACTUATORFRC": ("ACTUATOR", spec.actuators),
        "TENDONACTFRC": ("TENDON", spec.tendons),
    }[kind]
    for i, one in enumerate(elements):
        one.name = one.name or f"{of} {i}"
        add_sensor(spec, kind, of, one.name)


def _dofs(m: Any, j: int) -> int:
    """Count the rates of a joint."""
    return DOFS[J(m.jnt_type[j])]


def _actuators(m: Any, way: str) -> Iterator[tuple[int, int, int]]:
    """The actuators of a way, with joint and rate."""
    for j in range(m.njnt):
        for i in range(_dofs(m, j)):
            yield m.actuator(f"{way} of {m.joint(j).name} {i}").id, j, i


def _set_efforts(m: Any, d: Any, ways: Ways, effort: Array) -> None:
    """Share the efforts of all joints equally among the ways."""
    for way, members in ways.items():
        share = effort / len(ways)
        for a, j, i in _actuators(m, way):
            at, rate = m.jnt_qposadr[j], m.jnt_dofadr[j] + i
            wanted = share[rate]
            turned = _dofs(m, j) - 3  # where the attitude of a free joint starts
            if way == "parent" and 0 <= turned <= i:
                first = m.jnt_dofadr[j] + turned
                q = d.qpos[at + turned : at + turned + 4]
                wanted = (rotation_matrix(q / np.linalg.norm(q)) @ share[first : first + 3])[i - turned]
            if way == "affine":
                length, speed = GEAR * d.qpos[at] * (_dofs(m, j) == 1), GEAR * d.qvel[rate]
                gain = 2.0, 0.5 * bool(length) / (1 + abs(length)), 0.5 / (1 + abs(speed))
                m.actuator_gainprm[a, :3] = gain
                wanted /= np.dot(gain, [1.0, length, speed])
            if way == "pid":
                _set_pid(m, d, a, wanted / GEAR, (j, rate))
            elif "dyntype" in members:
                _set_activation(m, d, a, wanted / GEAR)
            else:
                d.ctrl[_control(m, a)] = wanted / GEAR


def _set_activation(m: Any, d: Any, a: int, force: float) -> None:
    """Let the force be there at the end of a step, which it is taken from early."""
    kind, share = mujoco.mjtDyn(m.actuator_dyntype[a]), m.opt.timestep / m.actuator_dynprm[a, 0]
    control = d.ctrl[_control(m, a)] = 2.0 * force
    if kind == mujoco.mjtDyn.mjDYN_FILTEREXACT:
        share = 1 - np.exp(-share)
    is_filter = kind in (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
    by_control = (
        share if is_filter else m.opt.timestep * (USER_RATE if kind == mujoco.mjtDyn.mjDYN_USER else 1.0)
    )
    d.act[m.actuator_actadr[a]] = (force - by_control * control) / (1.0 - share * is_filter)


def _set_pid(m: Any, d: Any, a: int, force: float, place: tuple[int, int]) -> None:
    """Let a quarter of a force come from each of position, velocity, feedforward and integral."""
    j, rate = place
    at = m.actuator_ctrladr[a]
    if _dofs(m, j) > 1:  # whose lengths are another matter
        m.actuator_biasprm[a] = m.actuator_gainprm[a] = 0.0
        d.ctrl[at : at + 3] = 0.0, 0.0, force
        return
    length, speed = GEAR * d.qpos[m.jnt_qposadr[j]], GEAR * d.qvel[rate]
    kp, kv, ki = PID_GAINS
    d.ctrl[at : at + 3] = length + force / 4 / kp, speed + force / 4 / kv, force / 4
    d.act[m.actuator_actadr[a]] = force / 4 / ki


def _control(m: Any, a: int) -> int:
    """The control of an actuator; in older versions they have the same number."""
    return int(m.actuator_ctrladr[a]) if hasattr(m, "actuator_ctrladr") else a


def forward_by_actuators(ways: Ways, read: str = "") -> Callable[[Any, Any], None]:
    """Let actuators exert the efforts, and servos be springs and dampers, for one evaluation.

    Args:
        read: sensors by whose forces the acceleration is found.

    """

    def forward(m: Any, d: Any) -> None:
        effort, saved = d.qfrc_applied.copy(), (m.jnt_stiffness.copy(), m.dof_damping.copy())
        d.qfrc_applied[:] = 0.0
        if "servo" in ways:
            _set_servos(m, d)
        _set_efforts(m, d, {way: x for way, x in ways.items() if way != "servo"}, effort)
        mujoco.mj_forward(m, d)
        if read:
            _accelerate_by_sensors(m, d, read)
        m.jnt_stiffness[:], m.dof_damping[:] = saved
        d.qfrc_applied[:] = effort
        if "servo" in ways:
            mujoco.mj_energyPos(m, d)  # servos have no energy

    return forward


def _set_servos(m: Any, d: Any) -> None:
    for a, j, i in _actuators(m, "servo"):
        rate = m.jnt_dofadr[j] + i
        m.actuator_biasprm[a, 2] = -m.dof_damping[rate] / GEAR**2
        if _dofs(m, j) == 1:  # a ball's spring stays
            stiffness = float(np.ravel(m.jnt_stiffness[j])[0]) / GEAR**2
            m.actuator_gainprm[a, 0], m.actuator_biasprm[a, 1] = stiffness, -stiffness
            d.ctrl[_control(m, a)] = GEAR * m.qpos_spring[m.jnt_qposadr[j]]
            m.jnt_stiffness[j] = 0.0
        else:
            m.actuator_gainprm[a, 0] = 0.0
    m.dof_damping[:] = 0.0


def _accelerate_by_sensors(m: Any, d: Any, kind: str) -> None:
    """Find the acceleration with the forces of actuators that sensors report."""
    force = d.qfrc_actuator.copy()
    if kind == "JOINTACTFRC":
        for j in range(m.njnt):
            if _dofs(m, j) == 1:
                force[m.jnt_dofadr[j]] = d.sensor(f"{kind} {m.joint(j).name}").data[0]
    else:
        moment = dense_rows(d.actuator_moment, m, d, "moment")
        exerted = np.array([d.sensor(f"{kind} {m.actuator(a).name}").data[0] for a in range(len(moment))])
        force = exerted @ moment
    d.qacc[:] = through_inverse(m, d, d.qfrc_smooth - d.qfrc_actuator + force)


@contextmanager
def callbacks(**functions: Callable[..., Any]) -> Iterator[None]:
    """Let the engine call functions, by the name of each callback."""
    for name, function in functions.items():
        getattr(mujoco, f"set_mjcb_{name}")(function)
    try:
        yield
    finally:
        for name in functions:
            getattr(mujoco, f"set_mjcb_{name}")(None)


def forward_by_callbacks(m: Any, d: Any) -> None:
    """Exert the efforts by gains, biases and activations that callbacks return."""

    def bias(_: Any, data: Any, a: int) -> float:
        return float(-data.ctrl[_control(m, a)])

    def rate(_: Any, data: Any, a: int) -> float:
        return float(USER_RATE * data.ctrl[_control(m, a)])

    with callbacks(act_gain=lambda *_: 2.0, act_bias=bias, act_dyn=rate):
        forward_by_actuators(BY_CALLBACK)(m, d)


# -- tendons -----------------------------------------------------------------------------------------


def with_fixed_tendons(spec: Any) -> Any:
    """Add a tendon on every hinge and slide, with a motor."""
    for joint in named_joints(spec):
        if DOFS[joint.type] == 1:
            tendon = spec.add_tendon()
            tendon.name = f"of {joint.name}"
            tendon.wrap_joint(joint.name, COEFFICIENT)
            add_actuator(spec, tendon.name, "TENDON", tendon.name, GEAR * np.eye(6)[0])
    _add_sensors(spec, "TENDONACTFRC")
    return spec


def elements_on_tendons(m: Any, d: Any) -> tuple[Any, Any]:
    """Move springs, dampers and rotors of hinges and slides to their tendons."""
    for j, t in _tendons(m):
        rate = m.jnt_dofadr[j]
        m.tendon_stiffness[t] = m.jnt_stiffness[j] / COEFFICIENT**2
        m.tendon_damping[t], m.tendon_armature[t] = (
            x[rate] / COEFFICIENT**2 for x in (m.dof_damping, m.dof_armature)
        )
        m.tendon_lengthspring[t] = COEFFICIENT * m.qpos_spring[m.jnt_qposadr[j]]
        m.jnt_stiffness[j] = m.dof_damping[rate] = m.dof_armature[rate] = 0.0
    return m, d


def _tendons(m: Any) -> list[tuple[int, int]]:
    """Pairs of hinge or slide and tendon."""
    scalar = [j for j in range(m.njnt) if _dofs(m, j) == 1]
    return [(j, m.tendon(f"of {m.joint(j).name}").id) for j in scalar]


def forward_by_tendons(m: Any, d: Any) -> None:
    """Exert the efforts of hinges and slides by motors on their tendons, as their sensors report them.

    The accelerations go through inverse dynamics and back, wrong with rotors of tendons before 3.3.4.
    These report the motors' forces without their gear: docs/surface/mujoco_tendon_actuator_force.py.
    """
    effort = d.qfrc_applied.copy()
    for j, t in _tendons(m):
        rate = m.jnt_dofadr[j]
        a = m.actuator(m.tendon(t).name).id
        d.ctrl[_control(m, a)] = effort[rate] / (GEAR * COEFFICIENT)
        d.qfrc_applied[rate] = 0.0
    mujoco.mj_forward(m, d)
    total = d.qfrc_smooth.copy()
    for j, t in _tendons(m):
        rate, sensor = m.jnt_dofadr[j], d.sensor(f"TENDONACTFRC {m.tendon(t).name}")
        total[rate] += COEFFICIENT * GEAR * sensor.data[0] - effort[rate]
    d.qacc[:] = through_inverse(m, d, total)
    mujoco.mj_inverse(m, d)
    d.qacc[:] = through_inverse(m, d, d.qfrc_inverse + d.qfrc_passive - d.qfrc_bias)
    d.qfrc_applied[:] = effort


# -- what has no effect ------------------------------------------------------------------------------


def with_far_limits(spec: Any) -> Any:
    """Limit joints, controls and forces where nothing reaches, and add motors that are switched off."""
    limited, far = mujoco.mjtLimited.mjLIMITED_TRUE, [-FAR, FAR]
    for joint in named_joints(spec):
        if joint.type != J.mjJNT_FREE:
            joint.limited, joint.range = limited, [0.0, FAR] if joint.type == J.mjJNT_BALL else far
        if DOFS[joint.type] == 1:
            joint.actfrclimited, joint.actfrcrange = limited, far
        add_actuator(spec, f"off {joint.name}", "JOINT", joint.name, np.eye(6)[0], group=GROUP_OFF)
    for actuator in spec.actuators:
        set_attributes(actuator, forcelimited=limited, ctrllimited=limited, forcerange=far, ctrlrange=far)
    return spec


def forward_with_group_off(m: Any, d: Any) -> None:
    """Give the actuators that are off something to exert."""
    for a in range(m.nu):
        if m.actuator(a).name.startswith("off "):
            d.ctrl[a] = 1.0 + a
    mujoco.mj_forward(m, d)


def forward_without_gravity(m: Any, d: Any) -> None:
    """Apply weights as forces on the bodies whose gravity is compensated, or on all with gravity off."""
    loads, flags, share = d.xfrc_applied.copy(), m.opt.disableflags, m.body_gravcomp
    d.xfrc_applied[:, :3] += ((share if np.any(share) else 1.0) * m.body_mass)[:, None] * m.opt.gravity
    if not np.any(share):
        m.opt.disableflags = flags | int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    mujoco.mj_forward(m, d)
    m.opt.disableflags = flags
    d.xfrc_applied[:] = loads
    mujoco.mj_energyPos(m, d)


def with_gravcomp(spec: Any) -> Any:
    """Mark all bodies, so that the compiler counts them."""
    for body in bodies_of(spec):
        body.gravcomp = 1.0
    return spec


def with_gravcomp_of_attached(spec: Any) -> Any:
    """Mark the bodies that are fixed to others."""
    for body in bodies_of(spec):
        body.gravcomp = 0.0 if children_of(body, "joint") else 1.0
    return spec


def names_of(ways: Ways) -> str:
    """The members that ways have."""
    return " ".join(dict.fromkeys(member for members in ways.values() for member in members.values()))
