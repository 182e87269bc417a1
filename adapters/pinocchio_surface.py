"""What Pinocchio reports of a tree besides the state quantities: frames, centres of mass, momenta, torques.

Reference frames: LOCAL has the origin and the axes of the frame, LOCAL_WORLD_ALIGNED its origin and the
world's axes, WORLD gives the spatial vector at the world's origin.  A frame's acceleration is the spatial one
but for `getFrameClassicalAcceleration` and for the rate of the Jacobian in LOCAL_WORLD_ALIGNED.  `rnea` and
`crba` count the rotors, which are taken out of torques here.

What a joint has is taken to the probe frame on it.  Derivatives are compared along v, by what holds for every
mechanism: terms of velocities are of second degree, so that ∂τ/∂v v is twice them; a velocity's derivatives
by q and v, times v and v̇, are its rate; and v · ∂g/∂q v + g · v̇ is the second rate of the energy of gravity.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from adapters.pinocchio_common import armature, joint_of
from adapters.pinocchio_probes import Probed
from adapters.pinocchio_relations import mimics, relations
from adapters.pose_functions import Pose, about
from plumbline.engines.missing_names import FAILED_PARTS, MISSING_NAMES, add_parts
from plumbline.model.datatypes import Array
from plumbline.model.kinematics import cross

SPATIAL = "spatial_acceleration"


class _Frame(NamedTuple):
    """What vectors in a reference frame are."""

    of_point: str = ""  # suffix of quantities of points
    of_rotation: str = ""  # … of rotations
    of_rate: str = SPATIAL  # what J̇ q̇ + J q̈ is


FRAMES = {
    "LOCAL_WORLD_ALIGNED": _Frame(of_rate="acceleration"),
    "LOCAL": _Frame("_local", "_local"),
    "WORLD": _Frame("_at_origin"),
}
OF_MOTIONS = ("exp6", "Jexp6")  # take a pin.Motion
PLANE_SHIFT = 0.5  # rad, of a step in the plane, and of translations this share
ANGULAR = {"velocity": "velocity", "acceleration": "acceleration", SPATIAL: "acceleration"}
# Ways that take the rates of the joints' axes, and what is compared of them where joints are composite.
BY_RATES = ("jacobian_rate", "map_rate", "coriolis_matrix", "derivative", "inverse")
OF_COMPOSITES = ("frame_acceleration", "momentum_rate", "inverse_dynamics")
BY_RATE, BY_DERIVATIVE = "_by_jacobian_rate", "_by_derivative"
Reading = tuple[str, str, str, Any]  # functions, what they return, by what, and the spatial vector
Reader = Callable[[Probed, str, str, int, pin.Data, pin.Data], Iterator[Reading]]


def add_surface(states: Sequence[Probed], bodies: Sequence[pin.Inertia]) -> None:
    """Evaluate all at some states, part by part: data of 50 bodies are 100 MB, made for the first state.

    Args:
        bodies: inertias of the bodies, in their joints' frames.

    """
    for parts in zip(*(_parts(s, bodies) for s in states), strict=True):
        workspaces = list[pin.Data]()
        for s, part in zip(states, parts, strict=True):
            s.workspaces, s.used = workspaces, 0
            add_parts(s.found, partial(part, s))


def _parts(s: Probed, bodies: Sequence[pin.Inertia]) -> list[Callable[[Probed], None]]:
    """What adds all of one state."""
    parts: list[Callable[[Probed], None]] = [
        _add_frames,
        _add_hessians,
        _add_data,
        _add_centres,
        *relations(s),
    ]
    parts += [partial(_add_regressors, bodies=bodies)]
    return parts + ([] if s.rates is None else [_add_torques, _add_batch, *mimics(s)])


def add_composites(s: Probed, whole: Probed) -> None:
    """Add what a model with composite joints reports; apart what takes their axes' rates, which it lacks."""
    for quantity, calls in whole.found.items():
        base, _, by = quantity.partition("_by_")
        if by in BY_RATES and base not in OF_COMPOSITES:
            continue
        quantity = f"{base}_of_composite_joints" if by in BY_RATES else quantity
        names = () if quantity in (FAILED_PARTS, MISSING_NAMES) else ("JointModelComposite",)
        s.found[quantity] |= {(*call, *names): value for call, value in calls.items()}


def pose_function(name: str, given: Sequence[Any], _: Sequence[str]) -> list[Any]:
    """Call a function of attitudes or poses."""
    function = pin
    for part in name.split("."):
        function = getattr(function, part)
    if name in ("liegroups.SO2", "liegroups.SE2"):
        return _plane_function(function(), *given)
    if name.startswith("liegroups"):
        size = int(name[-1]) if name[-1].isdigit() and len(name) == len("liegroups.R1") else len(given[0])
        group = function(size) if name == "liegroups.Rn" else function()
        starts = range(len(given[0]) - size, -1, -1)
        found = np.zeros(len(given[0]))
        for at in starts:
            found[at : at + size] = group.integrate(*(np.ravel(x)[at : at + size] for x in given))
        return [found]
    arguments = [pin.SE3(x) if np.shape(x) == (4, 4) else x for x in given]
    result = function(*(map(pin.Motion, given) if name in OF_MOTIONS else arguments))
    return [result.homogeneous if isinstance(result, pin.SE3) else getattr(result, "vector", result)]


def _plane_function(group: Any, height: float, *given: float) -> list[Any]:
    """Step from one place in the plane, or from one angle, to another: by our tangent and by the group's."""
    *place, angle = given
    before, there = (
        np.array([*(x * (1.0 - shift) for x in place), np.cos(angle - shift), np.sin(angle - shift)])
        for shift in (PLANE_SHIFT, 0.0)
    )
    tangent, turn = np.array([PLANE_SHIFT]), about(2, angle - PLANE_SHIFT)
    if place:
        shift = turn.T @ [*(PLANE_SHIFT * np.array(place)), 0.0]
        half = PLANE_SHIFT / 2
        tangent = Pose(shift, np.array([np.cos(half), 0.0, 0.0, np.sin(half)])).forms["xi"][[0, 1, 5]]
    ways = tangent, group.difference(before, there)
    *moved, c, s = np.mean([group.integrate(before, way) for way in ways], axis=0)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return [turn, np.array([*moved, height])][: 1 + bool(place)]


def _add_frames(s: Probed) -> None:
    data, derived = s.moved(), s.workspace()
    pin.computeForwardKinematicsDerivatives(s.m, derived, s.q, s.v, s.a)
    pin.updateFramePlacements(s.m, derived)
    pin.computeJointJacobiansTimeVariation(s.m, data, s.q, s.v)
    for name in FRAMES:
        _add_readings(s, name, data, derived, _readings)
        if name != "WORLD":
            _add_points(s, derived, name)
    for name in FRAMES:
        _add_readings(s, name, data, derived, _computed)


def _add_hessians(s: Probed) -> None:
    data, derived = s.moved(), s.workspace()
    pin.computeJointJacobians(s.m, data, s.q)
    pin.computeJointKinematicHessians(s.m, derived, s.q)
    for name in FRAMES:
        _add_readings(s, name, data, derived, _by_hessian)


def _add_readings(s: Probed, name: str, data: pin.Data, derived: pin.Data, read: Reader) -> None:
    """Add in one reference frame what functions of frames return, and those of joints moved to frames."""
    found, frame = defaultdict[tuple[str, str, str], list[Any]](list), FRAMES[name]
    for f, joint in zip(s.frames, s.joints, strict=True):
        of_joint = (_at_frame(s, name, f, data, x) for x in read(s, name, "Joint", joint, data, derived))
        for function, what, by, twist in (*read(s, name, "Frame", f, data, derived), *of_joint):
            found[function, what, by].append(twist)
    for (function, what, by), twists in found.items():
        of_point, of_rotation = f"frame_{what}{frame.of_point}{by}", f"{ANGULAR[what]}{frame.of_rotation}{by}"
        call = f"{function} ReferenceFrame.{name}"
        s.add_twists((of_point, f"frame_angular_{of_rotation}"), call, twists)


def _computed(s: Probed, name: str, of: str, f: int, other: pin.Data, _: pin.Data) -> Iterator[Reading]:
    """What functions say that need no other before, and change the data."""
    reference = getattr(pin.ReferenceFrame, name)
    if of == "Joint":
        if name == "LOCAL":
            J = s.square(pin.computeJointJacobian(s.m, other, s.q, f))
            yield "computeJointJacobian", "velocity", "", J @ s.v
        return
    J = s.square(pin.computeFrameJacobian(s.m, other, s.q, f, reference))
    rate = s.rate(pin.frameJacobianTimeVariation(s.m, other, s.q, s.v, f, reference), J)
    yield "computeFrameJacobian", "velocity", "", J @ s.v
    yield "frameJacobianTimeVariation", FRAMES[name].of_rate, BY_RATE, rate


def _at_frame(s: Probed, name: str, f: int, data: pin.Data, reading: Reading) -> Reading:
    """Move what a function of a joint returns to the frame on it."""
    function, what, by, twist = reading
    vector, frame = np.array(getattr(twist, "vector", twist)), s.m.frames[f]
    joint, place = joint_of(frame), frame.placement
    if what == "acceleration":  # a classical one is moved as the spatial one
        velocity = pin.getVelocity(s.m, data, joint, getattr(pin.ReferenceFrame, name))
        what, vector[:3] = SPATIAL, vector[:3] - cross(velocity.angular, velocity.linear)
    aligned = pin.SE3(np.eye(3), data.oMi[joint].rotation @ place.translation)
    move = {"LOCAL": place, "WORLD": pin.SE3.Identity()}.get(name, aligned)
    return function, what, by, move.actInv(pin.Motion(vector))


def _readings(
    s: Probed, name: str, of: str, number: int, data: pin.Data, derived: pin.Data
) -> Iterator[Reading]:
    """What all functions of a frame or a joint return."""

    def read(function: str, of_data: pin.Data = data) -> Any:
        return getattr(pin, function)(s.m, of_data, number, getattr(pin.ReferenceFrame, name))

    plain, of_rate = of.replace("Joint", ""), FRAMES[name].of_rate
    J, dJ = read(f"get{of}Jacobian"), read(f"get{of}JacobianTimeVariation")
    by_q, by_v = read(f"get{of}VelocityDerivatives", derived)[:2]
    *_, of_v, of_a = read(f"get{of}AccelerationDerivatives", derived)
    yield f"get{plain}Velocity", "velocity", "", read(f"get{plain}Velocity").copy()
    yield f"get{plain}Acceleration", SPATIAL, "", read(f"get{plain}Acceleration").copy()
    yield f"get{of}Jacobian", "velocity", "", s.square(J) @ s.v
    yield f"get{of}JacobianTimeVariation", of_rate, BY_RATE, s.rate(dJ, J)
    function = f"get{of}VelocityDerivatives"
    yield f"{function} computeForwardKinematicsDerivatives", "velocity", BY_DERIVATIVE, s.square(by_v) @ s.v
    # the derivatives of vectors in the world's axes are those of spatial ones
    yield function, SPATIAL, BY_DERIVATIVE, s.rate(by_q, by_v)
    yield f"get{of}AccelerationDerivatives", SPATIAL, BY_DERIVATIVE, s.rate(of_v, of_a, s.v / 2)
    if name != "WORLD":
        function = f"get{plain}ClassicalAcceleration"
        yield function, "acceleration", "", read(function).copy()


def _by_hessian(
    s: Probed, name: str, of: str, number: int, data: pin.Data, derived: pin.Data
) -> Iterator[Reading]:
    """What Hessians say, in C++'s order: docs/surface/pinocchio_kinematic_hessians.py."""
    reference = getattr(pin.ReferenceFrame, name)
    J = getattr(pin, f"get{of}Jacobian")(s.m, data, number, reference)
    H = np.array(getattr(pin, f"get{of}KinematicHessian")(s.m, derived, number, reference))
    rate = s.rate(H.ravel().reshape(H.shape, order="F") @ s.v, J)
    call = f"get{of}KinematicHessian computeJointKinematicHessians"
    yield call, FRAMES[name].of_rate, BY_RATE, rate


def _add_points(s: Probed, derived: pin.Data, name: str) -> None:
    """Add what derivatives of points' velocities and accelerations say; points have no angular part."""
    reference, rows = getattr(pin.ReferenceFrame, name), defaultdict[tuple[str, str], list[Array]](list)
    what = SPATIAL if name == "LOCAL" else "acceleration"
    for place in zip(s.joints, s.places, strict=True):
        by_q, by_v = pin.getPointVelocityDerivatives(s.m, derived, *place, reference)
        *_, of_v, of_a = pin.getPointClassicAccelerationDerivatives(s.m, derived, *place, reference)
        rows["velocity", "getPointVelocityDerivatives"].append(s.square(by_v) @ s.v)
        rows[what, "getPointVelocityDerivatives"].append(s.rate(by_q, by_v))
        rows["acceleration", "getPointClassicAccelerationDerivatives"].append(s.rate(of_v, of_a, s.v / 2))
    for (what, function), values in rows.items():
        s.add(f"frame_{what}{FRAMES[name].of_point}_by_derivative", function, values)


def _add_data(s: Probed) -> None:
    """Add what algorithms leave in their data, joint by joint."""
    m, data, derived = s.m, s.workspace(), s.workspace()
    pin.rnea(m, data, s.q, s.v, s.a)
    pin.computeRNEADerivatives(m, derived, s.q, s.v, s.a)
    pin.forwardKinematics(m, data, s.q, s.v, s.a)
    pin.updateFramePlacements(m, data)
    pin.computeJointJacobiansTimeVariation(m, data, s.q, s.v)
    pin.updateGlobalPlacements(m, data)
    chained = [pin.SE3.Identity()]
    for joint in range(1, m.njoints):
        chained.append(chained[m.parents[joint]] * data.liMi[joint])
    places = list(zip(s.joints, s.places, strict=True))
    s.add_poses("forwardKinematics Data.oMi", [data.oMi[j] * place for j, place in places])
    s.add_poses("Data.liMi", [chained[j] * place for j, place in places])
    s.add_poses("updateFramePlacements Data.oMf", [data.oMf[f] for f in s.frames])
    s.add_poses("updateFramePlacement", [pin.updateFramePlacement(m, data, f).copy() for f in s.frames])
    s.add_poses("updateGlobalPlacements", [data.oMi[j] * place for j, place in places])
    weight = pin.Motion(m.gravity.linear, np.zeros(3))
    for what, at, by, values in (
        ("velocity", "_local", "forwardKinematics Data.v", data.v),
        (SPATIAL, "_local", "forwardKinematics Data.a", data.a),
        (SPATIAL, "_local", "rnea Data.a_gf",
         [x + pose.actInv(weight) for x, pose in zip(data.a_gf, data.oMi, strict=True)]),
        ("velocity", "_at_origin", "computeRNEADerivatives Data.ov", derived.ov),
        (SPATIAL, "_at_origin", "computeRNEADerivatives Data.oa", derived.oa),
        (SPATIAL, "_at_origin", "computeRNEADerivatives Data.oa_gf",
         [x + weight for x in derived.oa_gf]),
    ):  # fmt: skip
        is_local = at == "_local"
        twists = [place.actInv(values[j]) if is_local else values[j].copy() for j, place in places]
        turning = f"frame_angular_{ANGULAR[what]}{'_local' * is_local}"
        s.add_twists((f"frame_{what}{at}", turning), by, twists)
    J, dJ = s.square(data.J), s.square(data.dJ)
    columns = [s.columns(j) for j in s.joints]
    velocity = [J[:3, own] @ s.v[own] for own in columns]
    rate = [dJ[:3, own] @ s.v[own] + J[:3, own] @ s.a[own] for own in columns]
    s.add("frame_velocity_at_origin", "computeJointJacobians Data.J", velocity)
    by = "computeJointJacobiansTimeVariation Data.dJ"
    s.add("frame_spatial_acceleration_at_origin_by_jacobian_rate", by, rate)


def _add_centres(s: Probed) -> None:
    m, (q, v, a), data, derived = s.m, s.motion, s.workspace(), s.workspace()
    s.add("total_mass", "computeTotalMass", pin.computeTotalMass(m))
    pin.centerOfMass(m, data, q, v, a)
    pin.forwardKinematics(m, derived, q, v, a)
    for quantity, name, level in (
        ("", "com", "POSITION"), ("_velocity", "vcom", "VELOCITY"), ("_acceleration", "acom", "ACCELERATION"),
    ):  # fmt: skip
        s.add(f"centre_of_mass{quantity}", f"centerOfMass Data.{name}", getattr(data, name)[0])
        pin.centerOfMass(m, derived, getattr(pin.KinematicLevel, level))
        call = f"centerOfMass KinematicLevel KinematicLevel.{level}"
        s.add(f"centre_of_mass{quantity}", call, getattr(derived, name)[0])
    jacobian = s.square(pin.jacobianCenterOfMass(m, data, q))
    s.add("centre_of_mass_velocity", "jacobianCenterOfMass Data.Jcom", s.square(data.Jcom) @ v)
    pin.computeForwardKinematicsDerivatives(m, derived, q, v, a)
    pin.centerOfMass(m, derived, q, v)
    function = "getCenterOfMassVelocityDerivatives"
    rate = s.rate(getattr(pin, function)(m, derived), jacobian)
    s.add("centre_of_mass_acceleration_by_derivative", function, rate)
    if s.rates is not None and len(set(s.joints)) == len(s.joints):  # no joint carries two bodies
        _add_subtrees(s)
    momentum = pin.computeCentroidalMomentum(m, data, q, v).copy()
    s.add_momentum("computeCentroidalMomentum Data.hg", momentum)
    by_map = s.square(pin.computeCentroidalMap(m, data, q)) @ v
    s.add_momentum("computeCentroidalMap Data.Ag", by_map)
    s.add_momentum("ccrba", s.square(pin.ccrba(m, data, q, v)) @ v)
    variation = pin.computeCentroidalMomentumTimeVariation(m, data, q, v, a).copy()
    s.add_momentum("computeCentroidalMomentumTimeVariation Data.dhg", variation, "_rate")
    rate = s.rate(np.array(pin.computeCentroidalMapTimeVariation(m, data, q, v)), data.Ag)
    s.add_momentum("computeCentroidalMapTimeVariation Data.dAg", rate, "_rate_by_map_rate")
    s.add_momentum("dccrba", s.rate(pin.dccrba(m, data, q, v), data.Ag), "_rate_by_map_rate")
    pin.computeRNEADerivatives(m, data, q, v, a)
    for name, (h_q, _, of_v, of_a) in (
        ("compute", pin.computeCentroidalDynamicsDerivatives(m, derived, q, v, a)),
        ("get", pin.getCentroidalDynamicsDerivatives(m, data)),
    ):
        rate = (s.rate(h_q, of_a) + s.rate(of_v, of_a, v / 2)) / 2
        s.add_momentum(f"{name}CentroidalDynamicsDerivatives", rate, "_rate_by_derivative")


def _add_subtrees(s: Probed) -> None:
    m, (q, v, a), data, other = s.m, s.motion, s.workspace(), s.workspace()
    pin.centerOfMass(m, data, q, v, a, True)
    poses = [(j, data.oMi[j].copy()) for j in s.joints]
    s.add("subtree_centre", "centerOfMass", [pose.act(data.com[j]) for j, pose in poses])
    for quantity, values in (("velocity", data.vcom), ("acceleration", data.acom)):
        s.add(f"subtree_{quantity}", "centerOfMass", [pose.rotation @ values[j] for j, pose in poses])
    pin.computeSubtreeMasses(m, data)
    s.add("subtree_mass", "computeSubtreeMasses Data.mass", [[data.mass[j]] for j in s.joints])
    velocities = [s.square(pin.jacobianSubtreeCenterOfMass(m, other, q, j)) @ v for j in s.joints]
    s.add("subtree_velocity", "jacobianSubtreeCenterOfMass", velocities)
    pin.jacobianCenterOfMass(m, other, q)
    velocities = [s.square(pin.getJacobianSubtreeCenterOfMass(m, other, j)) @ v for j in s.joints]
    s.add("subtree_velocity", "getJacobianSubtreeCenterOfMass", velocities)
    pin.crba(m, other, q, pin.Convention.LOCAL)
    s.add("subtree_centre", "Data.Ycrb", [pose.act(other.Ycrb[j].lever) for j, pose in poses])
    pin.ccrba(m, other, q, v)
    s.add("subtree_centre", "Data.oYcrb", [other.oYcrb[j].lever.copy() for j in s.joints])


def _add_regressors(s: Probed, bodies: Sequence[pin.Inertia]) -> None:
    m, data, moved, local = s.m, s.workspace(), s.moved(), pin.ReferenceFrame.LOCAL
    pin.rnea(m, data, s.q, s.v, s.a)
    pin.updateFramePlacements(m, data)
    forces, velocities = (defaultdict[str, list[Any]](list) for _ in range(2))
    own_twists = [
        (m.jointPlacements[j].inverse() * moved.liMi[j]).act(
            moved.v[j] - moved.liMi[j].actInv(moved.v[m.parents[j]])
        )
        for j in range(1, m.njoints)
    ]
    turns = np.concatenate([twist.vector for twist in own_twists])
    for f, j, place, inertia in zip(s.frames, s.joints, s.places, bodies, strict=True):
        own, here = inertia.toDynamicParameters(), place.actInv(inertia).toDynamicParameters()
        of_body = pin.bodyRegressor(data.v[j], data.a_gf[j]) @ own
        forces["bodyRegressor"].append(place.actInv(pin.Force(of_body)))
        forces["jointBodyRegressor"].append(place.actInv(pin.Force(pin.jointBodyRegressor(m, data, j) @ own)))
        forces["frameBodyRegressor"].append(pin.frameBodyRegressor(m, data, f) @ here)
        of_joint = pin.computeJointKinematicRegressor(m, moved, j, local, place) @ turns
        velocities["computeJointKinematicRegressor"].append(of_joint)
        of_frame = pin.computeFrameKinematicRegressor(m, moved, f, local) @ turns
        velocities["computeFrameKinematicRegressor"].append(of_frame)
    for function, values in forces.items():
        s.add_twists(("body_force_local", "body_moment_local"), function, values)
    for function, values in velocities.items():
        s.add_twists(("frame_velocity_local", "frame_angular_velocity_local"), function, values)


def _add_torques(s: Probed) -> None:
    m, (q, v, a), data = s.m, s.motion, s.workspace()
    terms, derived, zero = s.workspace(), s.workspace(), np.zeros(m.nv)
    pin.computeAllTerms(m, terms, q, v)
    M, none = _add_products(s, terms), pin.StdVec_Force()
    none.extend([pin.Force.Zero()] * m.njoints)
    g = pin.computeGeneralizedGravity(m, data, q).copy()
    static = {"computeStaticTorque": pin.computeStaticTorque(m, data, q, none).copy()}
    s.add_forces("generalized_gravity", {"computeGeneralizedGravity Data.g": g} | static)
    tau, rotors = pin.rnea(m, data, q, v, a).copy(), armature(m) * a
    parameters = np.concatenate([inertia.toDynamicParameters() for inertia in m.inertias[1:]])
    _add_energies(s, parameters, g, none)
    rest = pin.rnea(m, data, q, zero, a).copy()  # without the terms of velocities
    coriolis = s.square(pin.computeCoriolisMatrix(m, data, q, v)) @ v + rest
    _, of_v, of_a = pin.computeRNEADerivatives(m, derived, q, v, a)
    by_regressor = np.reshape(pin.computeJointTorqueRegressor(m, data, q, v, a), (-1, len(parameters)))
    again = pin.rnea(m, data, q, v, pin.aba(m, data, q, v, tau).copy())
    dynamics = {  # with the rotors
        "": {
            "rnea Data.tau": tau,
            "nonLinearEffects": pin.nonLinearEffects(m, data, q, v) + M @ a,
            "nle Data.nle": pin.nle(m, data, q, v) + M @ a,
            "computeAllTerms Data.nle": terms.nle + M @ a,
            "computeJointTorqueRegressor Data.jointTorqueRegressor": by_regressor @ parameters + rotors,
        },
        "_by_derivative": {"computeRNEADerivatives Data.dtau_dv": s.rate(of_v, of_a, v / 2) + g},
        "_by_aba": {"aba Data.ddq": again},
        "_by_coriolis_matrix": {
            "computeCoriolisMatrix Data.C": coriolis,
            "getCoriolisMatrix": s.square(pin.getCoriolisMatrix(m, derived)) @ v + rest,
        },
    }
    for by, values in dynamics.items():
        s.add_forces(f"inverse_dynamics{by}", {call: value - rotors for call, value in values.items()})


def _add_batch(s: Probed) -> None:
    """Add what batched calls return, which the wheels of some versions lack."""
    tau = np.ravel(pin.rneaInParallel(1, pin.ModelPool(s.m, 1), *(x[:, None] for x in s.motion)))
    s.add_forces("inverse_dynamics", {"rneaInParallel ModelPool": tau - armature(s.m) * s.a})


def _add_products(s: Probed, terms: pin.Data) -> Array:
    """Add products with the mass matrix, its factors and its inverse; return the matrix."""
    m, q, v, data = s.m, s.q, s.v, s.workspace()
    M = s.square(pin.crba(m, data, q))
    momentum = M @ v
    pin.cholesky.decompose(m, data)
    U, D, upper = s.square(data.U), np.ravel(data.D), np.triu(s.square(terms.M))
    world = s.square(pin.crba(m, s.workspace(), q, pin.Convention.WORLD))
    momenta = {
        "crba Data.M": momentum,
        "crba Convention Convention.WORLD": world @ v,
        "cholesky.decompose Data.U Data.D": U @ (D * (U.T @ v)),
        "computeAllTerms Data.M": upper @ v + np.triu(upper, 1).T @ v,
    }
    through = {
        "cholesky.decompose cholesky.solve": M @ np.ravel(pin.cholesky.solve(m, data, momentum)),
        "cholesky.computeMinv": M @ (s.square(pin.cholesky.computeMinv(m, data)) @ momentum),
    }
    by_aba = M @ (s.square(pin.computeMinverse(m, data, q)) @ momentum)
    s.add_forces("generalized_momentum", momenta)
    s.add_forces("momentum_through_inverse", through)
    s.add_forces("momentum_through_inverse_by_aba", {"computeMinverse Data.Minv": by_aba})
    return M


def _add_energies(s: Probed, parameters: Array, g: Array, none: pin.StdVec_Force) -> None:
    m, (q, v, a), data, zero = s.m, s.motion, s.workspace(), np.zeros(s.m.nv)
    kinetic = pin.computeKineticEnergyRegressor(m, data, q, v) @ parameters + armature(m) @ v**2 / 2
    gravity = pin.computePotentialEnergyRegressor(m, data, q) @ parameters
    both = pin.computeMechanicalEnergy(m, data, q, v)
    by_gravity = pin.computeGeneralizedGravityDerivatives(m, data, q).copy()
    by_torque = pin.computeStaticTorqueDerivatives(m, data, q, none).copy()
    by_rnea = pin.computeRNEADerivatives(m, data, q, zero, zero)[0].copy()
    for quantity, call, value in (
        ("kinetic_energy", "computeKineticEnergy Data.kinetic_energy",
         pin.computeKineticEnergy(m, data, q, v)),
        ("kinetic_energy", "computeKineticEnergyRegressor Data.kineticEnergyRegressor", kinetic),
        ("gravity_energy", "computePotentialEnergy Data.potential_energy",
         pin.computePotentialEnergy(m, data, q)),
        ("gravity_energy", "computePotentialEnergyRegressor Data.potentialEnergyRegressor", gravity),
        ("mechanical_energy", "computeMechanicalEnergy Data.mechanical_energy", both),
        *(
            ("gravity_energy_second_rate_by_derivative", call, v @ s.square(matrix) @ v + g @ a)
            for call, matrix in (
                ("computeGeneralizedGravityDerivatives", by_gravity),
                ("computeStaticTorqueDerivatives", by_torque),
                ("computeRNEADerivatives Data.dtau_dq", by_rnea),
            )
        ),
    ):  # fmt: skip
        s.add(quantity, call, value)
