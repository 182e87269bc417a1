"""What Pinocchio's functions of configurations, derivatives and data arrays say about a motion.

None of them returns a quantity of the motion; each is taken to one by a relation that holds for every
mechanism:

    configurations   a step s leads from q₋ = q ⊖ s to q and from there to q₊: differences, distances and
                     interpolation of these lead back to q.  d = q ⊖ q₋ has ḋ = ∂d/∂q v, and v is the velocity
                     that `dIntegrate` makes of it; q̇ = T v gives v by T's inverse.
    derivatives      terms of velocities are of second degree, so that
                     v̇ = ½ ∂v̇/∂v v + ∂v̇/∂τ (τ − g), of closed loops too.
    data             forces and momenta summed over all joints are those of the mechanism.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array, Call, Float

Motion = tuple[Array, Array, Array]  # q, v and v̇
Found = dict[str, dict[Call, Array]]
SHORT = 3  # joints up to which articulated bodies keep their digits (pinocchio-aba-loses-digits)
STEP = 0.2  # rad, and of translations this share of the distance of the bodies
ARG0, ARG1 = pin.ArgumentPosition.ARG0, pin.ArgumentPosition.ARG1
ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


def relations(
    found: Found, m: pin.Model, frames: Sequence[int], motion: Motion, is_tree: bool, has_parts: bool
) -> list[Callable[[], None]]:
    """Return the parts that add all of one state.

    Args:
        frames: the probe frames by body.
        is_tree: whether the mechanism has no loops.
        has_parts: whether a joint carries several bodies.

    """
    is_fixed = all(joint.shortname() != "JointModelFreeFlyer" for joint in m.joints)
    is_short = is_tree and is_fixed and m.njoints <= SHORT + 1
    parts = [_add_configurations, _add_velocities, _add_tangent_maps, _add_spatial, _add_momenta]
    parts += [] if has_parts else [_add_body_forces]
    parts += [_add_forward_derivatives, _add_batch] if is_short else []
    return [partial(part, found, m, frames, motion) for part in parts]


def add_accelerations(
    found: Found,
    m: pin.Model,
    frames: Sequence[int],
    motion: Motion,
    values: Mapping[Call, Array],
    suffix: str = "by_derivative",
) -> None:
    """Add the accelerations of the probe frames by other v̇."""
    data = m.createData()
    for call, a in values.items():
        pin.forwardKinematics(m, data, *motion[:2], np.ravel(a))
        pin.updateFramePlacements(m, data)
        twists = [pin.getFrameClassicalAcceleration(m, data, f, ALIGNED).vector.copy() for f in frames]
        found[f"frame_acceleration_{suffix}"][call] = np.array(twists)[:, :3]
        found[f"frame_angular_acceleration_{suffix}"][call] = np.array(twists)[:, 3:]


def _step(m: pin.Model, frames: Sequence[int], q: Array) -> Array:
    """A step of tangent vectors: no two entries are alike."""
    data = m.createData()
    angular = np.reshape(pin.computeJointJacobians(m, data, q), (6, m.nv))[3:]
    pin.updateFramePlacements(m, data)
    length = np.mean([np.linalg.norm(data.oMf[f].translation) for f in frames])
    step: Array = STEP * np.cos(1.0 + np.arange(m.nv))
    return np.where(np.any(angular != 0, axis=0), step, length * step)


def _add_configurations(found: Found, m: pin.Model, frames: Sequence[int], motion: Motion) -> None:
    (q, *_), data = motion, m.createData()
    step = _step(m, frames, q)
    before, after, length = pin.integrate(m, q, -step), pin.integrate(m, q, step), np.linalg.norm(step)

    def led(tangent: Array) -> Array:
        return np.asarray(pin.integrate(m, before, tangent))

    reached: dict[Call, Callable[[], Any]] = {
        ("difference", "integrate"): lambda: led(pin.difference(m, before, q)),
        ("distance",): lambda: led(step * (pin.distance(m, before, q) / length)),
        ("squaredDistance",): lambda: led(step * np.sqrt(np.sum(pin.squaredDistance(m, before, q))) / length),
        ("interpolate",): lambda: pin.interpolate(m, before, after, 0.5),
        ("isSameConfiguration", "isNormalized"): lambda: (
            q if pin.isNormalized(m, q) and pin.isSameConfiguration(m, q, q.copy(), 1e-9) else before
        ),
        ("lieGroup", "LieGroup"): lambda: pin.lieGroup(m).integrate(
            before, pin.lieGroup(m).difference(before, q)
        ),
        ("normalize", "framesForwardKinematics"): lambda: pin.normalize(m, q),
        ("RobotWrapper",): lambda: q,
        ("Model", "Model.idx_qs", "Model.nqs"): lambda: np.concatenate(
            [q[at : at + n] for at, n in zip(m.idx_qs, m.nqs, strict=True)]
        ),
    }

    def add(call: Call, configuration: Callable[[], Any]) -> None:
        there = np.ravel(configuration())
        if call == ("RobotWrapper",):
            robot = pin.RobotWrapper(m)
            poses = [robot.framePlacement(there, f).copy() for f in frames]
        else:
            pin.framesForwardKinematics(m, data, there)
            poses = [data.oMf[f].copy() for f in frames]
        found["frame_position"][call] = np.array([pose.translation for pose in poses])
        found["frame_axes"][call] = np.concatenate([pose.rotation.T for pose in poses])

    add_parts(found, *(partial(add, *one) for one in reached.items()))


def _add_velocities(found: Found, m: pin.Model, frames: Sequence[int], motion: Motion) -> None:
    q, v, _ = motion
    step = _step(m, frames, q)
    before, after = pin.integrate(m, q, -step), pin.integrate(m, q, step)
    of_q, of_step = (np.reshape(pin.dIntegrate(m, q, step, at), (m.nv, m.nv)) for at in (ARG0, ARG1))
    to_here = np.reshape(pin.dIntegrate(m, before, step, ARG1), (m.nv, m.nv))

    def square(matrix: Any) -> Array:
        return np.reshape(matrix, (m.nv, m.nv))

    found_v: dict[Call, Any] = {
        ("dDifference", "ArgumentPosition", "ArgumentPosition.ARG1"): to_here
        @ square(pin.dDifference(m, before, q, ARG1))
        @ v,
        ("dDifference", "ArgumentPosition.ARG0"): np.linalg.solve(
            of_q, -of_step @ square(pin.dDifference(m, q, after, ARG0)) @ v
        ),
    }
    for at, matrix in ((ARG0, of_q), (ARG1, of_step)):
        moved = np.ravel(pin.dIntegrateTransport(m, q, step, v[:, None], at))
        found_v["dIntegrateTransport", "dIntegrate", f"ArgumentPosition.{at}"] = np.linalg.solve(
            matrix, moved
        )
    _add_frame_velocities(found, m, frames, q, found_v)


def _add_tangent_maps(found: Found, m: pin.Model, frames: Sequence[int], motion: Motion) -> None:
    q, v, _ = motion
    T, rate = (
        np.reshape(pin.tangentMap(m, q), (m.nq, m.nv)),
        np.ravel(pin.tangentMapProduct(m, q, v[:, None])),
    )
    back, inverse = np.ravel(pin.tangentMapTransposeProduct(m, q, rate[:, None])), np.linalg.pinv(T)
    compact = np.reshape(pin.compactTangentMap(m, q), (m.nq, -1))
    sizes, starts = map(list, pin.getTangentToConfigurationSparsitySegment(m))
    rows = [row[:n] @ v[at : at + n] for row, at, n in zip(compact, starts, sizes, strict=True)]
    velocities: dict[Call, Any] = {
        ("tangentMap", "tangentMapProduct"): inverse @ rate,
        ("compactTangentMap", "getTangentToConfigurationSparsitySegment"): inverse @ np.array(rows),
        ("tangentMapTransposeProduct",): np.linalg.solve(T.T @ T, back),
    }
    _add_frame_velocities(found, m, frames, q, velocities)


def _add_frame_velocities(
    found: Found, m: pin.Model, frames: Sequence[int], q: Array, velocities: Mapping[Call, Any]
) -> None:
    data = m.createData()
    for call, value in velocities.items():
        pin.forwardKinematics(m, data, q, value)
        pin.updateFramePlacements(m, data)
        twists = np.array([pin.getFrameVelocity(m, data, f, ALIGNED).vector for f in frames])
        found["frame_velocity"][call], found["frame_angular_velocity"][call] = np.split(twists, 2, 1)


def _add_spatial(found: Found, m: pin.Model, frames: Sequence[int], motion: Motion) -> None:
    """Add what is read of single joints."""
    (q, v, a), data, derived, chain = motion, m.createData(), m.createData(), m.createData()
    pin.forwardKinematics(m, data, q, v, a)
    pin.computeRNEADerivatives(m, derived, q, v, a)
    J, dAdv = (np.reshape(x, (6, m.nv)) for x in (derived.J, derived.dAdv))
    rows = dict[str, list[Array]](classic=[], square=[], spatial=[], ends=[], turns=[])
    for f in frames:
        j, place = m.frames[f].parentJoint, m.frames[f].placement
        pose = data.oMi[j]
        rows["classic"].append(pin.classicAcceleration(data.v[j], data.a[j], place))
        twist = pin.Motion(data.v[j])
        spatial, turn, arm = data.a[j], twist.angular, place.translation
        here = spatial.linear + np.cross(turn, twist.linear) + np.cross(spatial.angular, arm)
        rows["square"].append(pose.rotation @ (here + pin.skewSquare(turn, turn) @ arm))
        own = [i for k in m.supports[j] for i in range(m.idx_vs[k], m.idx_vs[k] + m.nvs[k])]
        rows["spatial"].append(dAdv[:, own] @ v[own] / 2 + J[:, own] @ a[own])
        pin.computeJointJacobian(m, chain, q, j)
        base = next(i for i in m.supports[j] if i)
        ends = data.oMi[base] * chain.iMf[base] * place
        rows["ends"].append(ends.translation)
        rows["turns"].append(ends.rotation.T)
    found["frame_acceleration_local"]["classicAcceleration",] = np.array(rows["classic"])
    found["frame_acceleration"]["skewSquare",] = np.array(rows["square"])
    by = "computeRNEADerivatives", "Data.dAdv", "Model.idx_vs", "Model.nvs"
    found["frame_spatial_acceleration_at_origin_by_derivative"][by] = np.array(rows["spatial"])[:, :3]
    found["frame_position"]["computeJointJacobian", "Data.iMf"] = np.array(rows["ends"])
    found["frame_axes"]["computeJointJacobian", "Data.iMf"] = np.concatenate(rows["turns"])


def _add_momenta(found: Found, m: pin.Model, frames: Sequence[int], motion: Motion) -> None:
    (q, v, a), data, derived = motion, m.createData(), m.createData()
    pin.computeCentroidalDynamicsDerivatives(m, derived, q, v, a)
    to_centre = pin.SE3(np.eye(3), pin.centerOfMass(m, data, q))
    pin.computeCentroidalMomentum(m, data, q, v)
    of_rate, of_step, of_q = (np.reshape(x, (6, m.nv)) for x in (derived.dFda, derived.dFdv, derived.dHdq))
    composite = m.createData()
    pin.crba(m, composite, q, pin.Convention.LOCAL)
    roots = [j for j in range(1, m.njoints) if m.parents[j] == 0]
    crba = sum((_root_momentum(m, composite, j, v) for j in roots), pin.Force.Zero())
    origin = {
        ("momentum", ""): {
            ("computeCentroidalDynamicsDerivatives", "Data.oh"): derived.oh[0],
            ("computeCentroidalMomentum", "Data.h"): data.h[0],
            ("computeCentroidalDynamicsDerivatives", "Data.dFda"): pin.Force(of_rate @ v),
            ("crba", "Data.Fcrb"): crba,
        },
        ("momentum_rate", ""): {
            ("computeCentroidalDynamicsDerivatives", "Data.of"): derived.of[0],
        },
        ("momentum_rate", "_by_derivative"): {
            ("computeCentroidalDynamicsDerivatives", "Data.dFdv"): pin.Force(of_rate @ a + of_step @ v / 2),
            ("computeCentroidalDynamicsDerivatives", "Data.dHdq"): pin.Force(of_rate @ a + of_q @ v),
        },
    }
    for (name, by), values in origin.items():
        for call, force in values.items():
            at_centre = to_centre.actInv(force)
            found[f"{name}{by}"][call] = at_centre.linear[None].copy()
            angular = name.replace("momentum", "centroidal_angular_momentum")
            found[f"{angular}{by}"][call] = at_centre.angular[None].copy()
    pin.ccrba(m, data, q, v)
    found["total_mass"]["ccrba", "Data.Ig"] = np.array([[data.Ig.mass]])
    parameters = np.concatenate([x.toDynamicParameters()[:4] for x in m.inertias[1:]])
    regressor = np.reshape(pin.computeStaticRegressor(m, data, q), (3, -1))
    static = "computeStaticRegressor", "Data.staticRegressor"
    found["centre_of_mass"][static] = (regressor @ parameters)[None]


def _root_momentum(m: pin.Model, data: pin.Data, joint: int, v: Array) -> pin.Force:
    """The momentum of all that a root joint carries, at the world's origin."""
    return data.liMi[joint].act(pin.Force(np.reshape(data.Fcrb[joint], (6, m.nv)) @ v))


def _add_body_forces(found: Found, m: pin.Model, frames: Sequence[int], motion: Motion) -> None:
    """Add forces on bodies by B, which the data have summed over all bodies beyond a joint."""
    (q, v, a), data, coriolis = motion, m.createData(), m.createData()
    pin.computeRNEADerivatives(m, data, q, v, a)
    pin.computeCoriolisMatrix(m, coriolis, q, v)
    own = [np.array(x) for x in coriolis.B]
    for j in range(m.njoints - 1, 0, -1):
        if m.parents[j]:
            own[m.parents[j]] = own[m.parents[j]] - np.array(coriolis.B[j])
    forces = []
    for f in frames:
        j = m.frames[f].parentJoint
        force = data.oMi[j].act(m.inertias[j]) * data.oa_gf[j] + pin.Force(own[j] @ data.ov[j].vector)
        forces.append((data.oMi[j] * m.frames[f].placement).actInv(force).vector)
    halves = np.split(np.array(forces), 2, 1)
    for quantity, half in zip(("body_force_local", "body_moment_local"), halves, strict=True):
        found[quantity]["computeCoriolisMatrix", "Data.B"] = half


def add_mimic(found: Found, m: pin.Model, motion: Motion, rates: Float[Array, "nv nu"]) -> None:
    """Add the torques where each screw is a turn, and a slide that mimics it."""
    if not any(joint.shortname().startswith("JointModelH") for joint in m.joints):
        return
    (q, v, a), other = motion, pin.Model()
    other.gravity, last, mimics = m.gravity, [0], list[tuple[int, int, float]]()
    for j in range(1, m.njoints):
        joint, place, name = m.joints[j], m.jointPlacements[j], m.names[j]
        parent, kind = last[m.parents[j]], joint.shortname()
        is_screw = kind.startswith("JointModelH")
        made = getattr(pin, kind.replace("ModelH", "ModelR"))() if is_screw else joint
        number = other.addJoint(parent, made, place, name)
        if is_screw:
            slide = getattr(pin, kind.replace("ModelH", "ModelP"))()
            beyond = other.addJoint(number, slide, pin.SE3.Identity(), f"slide of {name}")
            mimics.append((number, beyond, joint.extract().pitch))
            number = beyond
        other.appendBodyToJoint(number, m.inertias[j], pin.SE3.Identity())
        last.append(number)
    for turn, slide, pitch in mimics:
        other = pin.transformJointIntoMimic(other, turn, slide, pitch, 0.0)
    call = "transformJointIntoMimic", "JointModelMimic", "JointDataMimic"
    data, rotors = other.createData(), m.armature
    tau = pin.rnea(other, data, q, v, a).copy()
    momentum = np.reshape(pin.crba(other, data, q), (m.nv, m.nv)) @ v + rotors * v
    found["inverse_dynamics"][call] = (rates.T @ tau)[:, None]
    found["generalized_momentum"][call] = (rates.T @ momentum)[:, None]


def _add_forward_derivatives(found: Found, m: pin.Model, frames: Sequence[int], motion: Motion) -> None:
    (q, v, a), data = motion, m.createData()
    tau, g = pin.rnea(m, data, q, v, a).copy(), pin.computeGeneralizedGravity(m, data, q).copy()
    _, by_v, by_tau = pin.computeABADerivatives(m, data, q, v, tau)
    inverse = np.triu(np.reshape(by_tau, (m.nv, m.nv)))
    inverse = inverse + np.triu(inverse, 1).T
    value = np.reshape(by_v, inverse.shape) @ v / 2 + inverse @ (tau - g)
    by = "computeABADerivatives", "Data.ddq_dv", "Data.ddq_dtau"
    add_accelerations(found, m, frames, motion, {by: value})


def _add_batch(found: Found, m: pin.Model, frames: Sequence[int], motion: Motion) -> None:
    tau = pin.rnea(m, m.createData(), *motion).copy()
    columns = (x[:, None] for x in (*motion[:2], tau))
    a = pin.abaInParallel(1, pin.ModelPool(m, 1), *columns)
    add_accelerations(found, m, frames, motion, {("abaInParallel",): a}, "by_aba")
