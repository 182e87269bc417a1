"""What Pinocchio's functions of configurations, derivatives and data arrays say about a motion.

None of them returns a quantity of the motion; each is taken to one by a relation that holds for every
mechanism:

    configurations   a step s leads from q₋ = q ⊖ s to q and from there to q₊: differences, distances and
                     interpolation of these lead back to q.  d = q ⊖ q₋ has ḋ = ∂d/∂q v, and v is the velocity
                     that `dIntegrate` makes of it; q̇ = T v gives v by our own formulas.
    derivatives      terms of velocities are of second degree, so that
                     v̇ = ½ ∂v̇/∂v v + ∂v̇/∂τ (τ − g), of closed loops too.  Of trees ∂v̇/∂τ is M⁻¹, and has lost
                     digits (pinocchio-computeMinverse-loses-digits): it is compared by itself, and taken off
                     ∂v̇/∂v, M v̇ = ½ (∂v̇/∂τ)⁻¹ ∂v̇/∂v v + τ − g.
    data             forces and momenta summed over all joints are those of the mechanism.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

from adapters.pinocchio_common import armature, axis_of, field_of, rebuilt
from adapters.pinocchio_probes import Probed
from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import angular_velocity, rotation_matrix

SHORT = 3  # joints up to which articulated bodies keep their digits (pinocchio-aba-loses-digits)
STEP = 0.2  # rad, and of translations this share of the distance of the bodies
SHARE = 0.3  # of the way between two configurations, from the first
LONG = 1.5  # of quaternions
ARG0, ARG1 = pin.ArgumentPosition.ARG0, pin.ArgumentPosition.ARG1


def relations(s: Probed) -> Sequence[Callable[[Probed], None]]:
    """Return the parts that add all of one state."""
    is_fixed = all(joint.shortname() != "JointModelFreeFlyer" for joint in s.m.joints)
    is_short = s.rates is not None and is_fixed and s.m.njoints <= SHORT + 1
    parts = [_add_configurations, _add_velocities, _add_tangent_maps, _add_spatial, _add_momenta]
    parts += [] if s.has_parts else [_add_body_forces]
    return [*parts, *([_add_forward_derivatives, _add_batch] if is_short else [])]


def _step(s: Probed) -> Array:
    """A step of tangent vectors: no two entries are alike."""
    data = s.workspace()
    angular = s.square(pin.computeJointJacobians(s.m, data, s.q))[3:]
    pin.updateFramePlacements(s.m, data)
    length = np.mean([np.linalg.norm(data.oMf[f].translation) for f in s.frames])
    step: Array = STEP * np.cos(1.0 + np.arange(s.m.nv))
    return np.where(np.any(angular != 0, axis=0), step, length * step)


def _add_configurations(s: Probed) -> None:
    m, q, step, data = s.m, s.q, _step(s), s.workspace()
    before, beyond = pin.integrate(m, q, -step), pin.integrate(m, q, step * (1 - SHARE) / SHARE)
    length, long = np.linalg.norm(step), np.array(q)
    for at in _quaternions(m):
        long[at] *= LONG

    def is_told_apart() -> bool:
        """Whether Pinocchio tells q from configurations that are not normalized, or not the same."""
        is_unit = [pin.isNormalized(m, x) for x in (q, long)]
        is_same = [pin.isSameConfiguration(m, q, x, 1e-9) for x in (q.copy(), before)]
        return is_unit == [True, bool(np.array_equal(q, long))] and is_same == [True, False]

    def led(tangent: Array) -> Array:
        return np.asarray(pin.integrate(m, before, tangent))

    reached: dict[str, Callable[[], Any]] = {
        "difference integrate": lambda: led(pin.difference(m, before, q)),
        "distance": lambda: led(step * (pin.distance(m, before, q) / length)),
        "squaredDistance": lambda: led(step * np.sqrt(np.sum(pin.squaredDistance(m, before, q))) / length),
        "interpolate": lambda: pin.interpolate(m, before, beyond, SHARE),
        "isSameConfiguration isNormalized": lambda: q if is_told_apart() else before,
        "lieGroup LieGroup": lambda: pin.lieGroup(m).integrate(before, pin.lieGroup(m).difference(before, q)),
        "normalize framesForwardKinematics": lambda: pin.normalize(m, long),
        "Model Model.idx_qs Model.nqs": lambda: np.concatenate(
            [q[at : at + n] for at, n in zip(m.idx_qs, m.nqs, strict=True)]
        ),
    }

    def add(call: str, configuration: Callable[[], Any]) -> None:
        pin.framesForwardKinematics(m, data, np.ravel(configuration()))
        s.add_poses(call, [data.oMf[f] for f in s.frames])

    def add_robot() -> None:
        robot = pin.RobotWrapper(m)
        s.add_poses("RobotWrapper", [robot.framePlacement(q, f).copy() for f in s.frames])

    add_parts(s.found, *(partial(add, *one) for one in reached.items()), add_robot)


def _add_velocities(s: Probed) -> None:
    m, q, v, step = s.m, s.q, s.v, _step(s)
    before, after = pin.integrate(m, q, -step), pin.integrate(m, q, step)
    of_q, of_step = (s.square(pin.dIntegrate(m, q, step, at)) for at in (ARG0, ARG1))
    to_here = s.square(pin.dIntegrate(m, before, step, ARG1))
    from_here, to_there = (s.square(pin.dDifference(m, q, after, at)) for at in (ARG0, ARG1))
    found = {
        "dDifference ArgumentPosition ArgumentPosition.ARG1": to_here
        @ s.square(pin.dDifference(m, before, q, ARG1))
        @ v,
        "dDifference ArgumentPosition.ARG0": np.linalg.solve(of_q, -of_step @ from_here @ v),
    }
    for at in (ARG0, ARG1):  # ∂(q ⊕ s)/∂q and ∂(q ⊕ s)/∂s times v, of which the difference is s
        moved = np.ravel(pin.dIntegrateTransport(m, q, step, v[:, None], at))
        back = to_there @ moved
        call = f"dIntegrateTransport dIntegrate ArgumentPosition.{at}"
        found[call] = np.linalg.solve(from_here, -back) if at == ARG0 else back
    s.add_velocities(found)


def _quaternions(m: pin.Model) -> list[slice]:
    """Where the configuration has them."""
    balls = ("JointModelSpherical", "JointModelFreeFlyer")
    ends = [joint.idx_q + joint.nq for joint in m.joints if joint.shortname() in balls]
    return [slice(end - 4, end) for end in ends]


def _velocity_map(s: Probed) -> Array:
    """Return the matrix that takes q̇ to v by our own formulas."""
    m, found = s.m, np.zeros((s.m.nv, s.m.nq))
    for joint in list(m.joints)[1:]:
        own = found[joint.idx_v : joint.idx_v + joint.nv, joint.idx_q : joint.idx_q + joint.nq]
        if joint.nq == joint.nv:
            own[:] = np.eye(joint.nq)
            continue
        p = np.roll(s.q[joint.idx_q : joint.idx_q + joint.nq][-4:], 1)
        own[-3:, -4:] = np.roll(np.stack([angular_velocity(p, rate) for rate in np.eye(4)], 1), -1, axis=1)
        own[:-3, :-4] = rotation_matrix(p).T[: joint.nv - 3, : joint.nv - 3]
    return found


def _add_tangent_maps(s: Probed) -> None:
    m, q, v, back = s.m, s.q, s.v, _velocity_map(s)
    T = np.linalg.pinv(back)
    T[np.abs(T) < 1e-15] = 0.0  # rounding between coordinates that do not meet, of which one may rest
    compact = np.reshape(pin.compactTangentMap(m, q), (m.nq, -1))
    sizes, starts = map(list, pin.getTangentToConfigurationSparsitySegment(m))
    rows = [row[:n] @ v[at : at + n] for row, at, n in zip(compact, starts, sizes, strict=True)]
    turned = np.ravel(pin.tangentMapTransposeProduct(m, q, (T @ v)[:, None]))
    s.add_velocities({
        "tangentMap": back @ (s.square(pin.tangentMap(m, q)) @ v),
        "tangentMapProduct": back @ np.ravel(pin.tangentMapProduct(m, q, v[:, None])),
        "compactTangentMap getTangentToConfigurationSparsitySegment": back @ np.array(rows),
        "tangentMapTransposeProduct": np.linalg.solve(T.T @ T, turned),
    })  # fmt: skip


def _add_spatial(s: Probed) -> None:
    """Add what is read of single joints."""
    m, data, derived, chain = s.m, s.workspace(), s.workspace(), s.workspace()
    pin.forwardKinematics(m, data, s.q, s.v, s.a)
    pin.computeRNEADerivatives(m, derived, s.q, s.v, s.a)
    J, dAdv = s.square(derived.J), s.square(derived.dAdv)
    classic, square, spatial, ends = (list[Any]() for _ in range(4))
    for j, place in zip(s.joints, s.places, strict=True):
        classic.append(pin.classicAcceleration(data.v[j], data.a[j], place))
        twist = pin.Motion(data.v[j])
        rate, turn, arm = data.a[j], twist.angular, place.translation
        here = rate.linear + np.cross(turn, twist.linear) + np.cross(rate.angular, arm)
        # ω × (ω × r), with two factors that differ, as r × r = 0
        other = turn + np.linalg.norm(turn) / (np.linalg.norm(arm) or 1.0) * arm
        square.append(data.oMi[j].rotation @ (here + pin.skewSquare(turn, other) @ arm))
        own = s.columns(j)
        spatial.append(dAdv[:3, own] @ s.v[own] / 2 + J[:3, own] @ s.a[own])
        pin.computeJointJacobian(m, chain, s.q, j)
        base = next(i for i in m.supports[j] if i)
        ends.append(data.oMi[base] * chain.iMf[base] * place)
    s.add("frame_acceleration_local", "classicAcceleration", classic)
    s.add("frame_acceleration", "skewSquare", square)
    by = "computeRNEADerivatives Data.dAdv Model.idx_vs Model.nvs"
    s.add("frame_spatial_acceleration_at_origin_by_derivative", by, spatial)
    s.add_poses("computeJointJacobian Data.iMf", ends)


def _add_momenta(s: Probed) -> None:
    m, (q, v, a) = s.m, s.motion
    data, derived, composite = s.workspace(), s.workspace(), s.workspace()
    pin.computeCentroidalDynamicsDerivatives(m, derived, q, v, a)
    to_centre = pin.SE3(np.eye(3), pin.centerOfMass(m, data, q))
    pin.computeCentroidalMomentum(m, data, q, v)
    of_rate, of_step, of_q = map(s.square, (derived.dFda, derived.dFdv, derived.dHdq))
    pin.crba(m, composite, q, pin.Convention.LOCAL)
    roots = [j for j in range(1, m.njoints) if m.parents[j] == 0]
    by = "computeCentroidalDynamicsDerivatives"
    rate, turned = pin.Force(of_rate @ a + of_step @ v / 2), pin.Force(of_rate @ a + of_q @ v)
    for suffix, call, force in (  # at the world's origin
        ("", f"{by} Data.oh", derived.oh[0]),
        ("", "computeCentroidalMomentum Data.h", data.h[0]),
        ("", f"{by} Data.dFda", pin.Force(of_rate @ v)),
        ("", "crba Data.Fcrb",
         sum((_root_momentum(s, composite, j) for j in roots), pin.Force.Zero())),
        ("_rate_by_derivative", f"{by} Data.of", derived.of[0]),
        ("_rate_by_derivative", f"{by} Data.dFdv", rate),
        ("_rate_by_derivative", f"{by} Data.dHdq", turned),
    ):  # fmt: skip
        s.add_momentum(call, to_centre.actInv(force), suffix)
    pin.ccrba(m, data, q, v)
    s.add("total_mass", "ccrba Data.Ig", data.Ig.mass)
    parameters = np.concatenate([x.toDynamicParameters()[:4] for x in m.inertias[1:]])
    regressor = np.reshape(pin.computeStaticRegressor(m, data, q), (3, -1))
    s.add("centre_of_mass", "computeStaticRegressor Data.staticRegressor", regressor @ parameters)


def _root_momentum(s: Probed, data: pin.Data, joint: int) -> pin.Force:
    """The momentum of all that a root joint carries, at the world's origin."""
    return data.liMi[joint].act(pin.Force(s.square(data.Fcrb[joint]) @ s.v))


def _add_body_forces(s: Probed) -> None:
    """Add forces on bodies by B, which the data have summed over all bodies beyond a joint."""
    m, data, coriolis = s.m, s.workspace(), s.workspace()
    pin.computeRNEADerivatives(m, data, s.q, s.v, s.a)
    pin.computeCoriolisMatrix(m, coriolis, s.q, s.v)
    shared = field_of(coriolis, "B")
    own = [np.array(x) for x in shared]
    for j in range(m.njoints - 1, 0, -1):
        if m.parents[j]:
            own[m.parents[j]] = own[m.parents[j]] - np.array(shared[j])
    forces = []
    for j, place in zip(s.joints, s.places, strict=True):
        force = data.oMi[j].act(m.inertias[j]) * data.oa_gf[j] + pin.Force(own[j] @ data.ov[j].vector)
        forces.append((data.oMi[j] * place).actInv(force))
    s.add_twists(("body_force_local", "body_moment_local"), "computeCoriolisMatrix Data.B", forces)


def mimics(s: Probed) -> Sequence[Callable[[Probed], None]]:
    """Return the parts of models where each screw is a turn and a slide that mimics it."""
    has_screws = any(joint.shortname().startswith("JointModelH") for joint in s.m.joints)
    parts = (_add_mimic_torques, _add_mimic_momenta) if has_screws else ()
    return [partial(part, along_axis=given) for part in parts for given in (False, True)]


def _with_mimics(s: Probed, along_axis: bool) -> tuple[str, pin.Model]:
    """The model, and the names that it uses; slides may be those along a given axis."""

    def parts(joint: Any) -> list[Any]:
        kind = joint.shortname()
        if not kind.startswith("JointModelH"):
            return [joint]
        turn, slide = (getattr(pin, kind.replace("ModelH", f"Model{letter}"))() for letter in "RP")
        return [turn, pin.JointModelPrismaticUnaligned(axis_of(joint)) if along_axis else slide]

    other, last = rebuilt(s.m, parts)
    for joint, number in zip(s.m.joints, last, strict=True):
        if joint.shortname().startswith("JointModelH"):
            pitch = joint.extract().pitch
            other = pin.transformJointIntoMimic(other, number - 1, number, pitch, 0.0)
    kinds = "JointModelPrismaticUnaligned" if along_axis else ""
    return f"transformJointIntoMimic JointModelMimic JointDataMimic {kinds}", other


def _add_mimic_torques(s: Probed, along_axis: bool) -> None:
    call, other = _with_mimics(s, along_axis)
    s.add_forces("inverse_dynamics", {call: pin.rnea(other, other.createData(), *s.motion).copy()})


def _add_mimic_momenta(s: Probed, along_axis: bool) -> None:
    call, other = _with_mimics(s, along_axis)
    momentum = s.square(pin.crba(other, other.createData(), s.q)) @ s.v + armature(s.m) * s.v
    s.add_forces("generalized_momentum", {call: momentum})


def _add_forward_derivatives(s: Probed) -> None:
    m, (q, v, a), data = s.m, s.motion, s.workspace()
    tau, g = pin.rnea(m, data, q, v, a).copy(), pin.computeGeneralizedGravity(m, data, q).copy()
    M = s.square(pin.crba(m, s.workspace(), q))
    _, by_v, by_tau = pin.computeABADerivatives(m, data, q, v, tau)
    inverse = np.triu(s.square(by_tau))
    inverse = inverse + np.triu(inverse, 1).T
    by = "computeABADerivatives Data.ddq_dtau"
    s.add_forces("momentum_through_inverse_by_aba", {by: M @ (inverse @ (M @ v))})
    velocity_terms = np.linalg.solve(inverse, s.square(by_v) @ v / 2)
    by = "computeABADerivatives Data.ddq_dv"
    s.add_accelerations(by, np.linalg.solve(M, velocity_terms + tau - g), "by_inverse")


def _add_batch(s: Probed) -> None:
    tau = pin.rnea(s.m, s.workspace(), *s.motion).copy()
    a = pin.abaInParallel(1, pin.ModelPool(s.m, 1), *(x[:, None] for x in (s.q, s.v, tau)))
    s.add_accelerations("abaInParallel", a, "by_aba")
