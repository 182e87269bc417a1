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
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from adapters.pinocchio_relations import add_mimic, relations
from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array, Call, Float, Model
from plumbline.model.kinematics import rotation_matrix
from plumbline.model.probe_frames import PROBE_ATTITUDE, probe_points

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
POSE_FUNCTIONS = {  # adapters/pose_functions.py describes the forms
    "exp3": "phi -> R", "log3": "Q.R -> Q.phi", "exp3_quat": "phi -> xyzw", "exp": "phi -> R",
    "log": "Q.R -> Q.phi",
    "Jexp3": "Q.phi -> @phidot wl", "Jlog3": "Q.R -> @wl phidot", "skew": "r -> S", "unSkew": "S -> r",
    "exp6": "xi -> H", "log6": "Q.H -> Q.xi", "exp6_quat": "xi -> rxyzw", "log6_quat": "Q.rxyzw -> Q.xi",
    "Jexp6": "Q.xi -> @xidot t", "Jlog6": "Q.H -> @t xidot",
    "XYZQUATToSE3": "rxyzw -> H", "SE3ToXYZQUAT": "H -> rxyzw", "SE3ToXYZQUATtuple": "H -> rxyzw",
    "rpy.rpyToMatrix": "rpy -> R", "rpy.matrixToRpy": "Q.R -> Q.rpy", "rpy.rotate": "'x' x -> Rx",
    "rpy.computeRpyJacobian": "Q.rpy -> @rpydot wl", "rpy.computeRpyJacobianInverse": "Q.rpy -> @wl rpydot",
    "liegroups.SO3": "L.xyzw Q.phi -> xyzw", "liegroups.SE3": "L.rxyzw Q.xi -> rxyzw",
    "liegroups.R3": "L.r dr -> r", "liegroups.R2": "L.r dr -> r", "liegroups.R1": "L.r dr -> r",
    "liegroups.Rn": "L.r dr -> r", "liegroups.SO2": "rz z -> Rz", "liegroups.SE2": "rz rx ry z -> Rz r",
}  # fmt: skip
OF_MOTIONS = ("exp6", "Jexp6")  # take a pin.Motion
ANGULAR = {"velocity": "velocity", "acceleration": "acceleration", SPATIAL: "acceleration"}
Found = dict[str, dict[Call, Array]]


def add_probe_frames(
    pin_model: pin.Model, joints: Sequence[int], placements: Sequence[pin.SE3], model: Model
) -> list[int]:
    """Add the probe frames of all bodies.

    Args:
        joints: by body the joint that carries it.
        placements: of each body's frame in that joint's frame.

    """
    turn = rotation_matrix(PROBE_ATTITUDE)
    return [
        int(pin_model.addFrame(pin.Frame(f"probe {k}", j, place * pin.SE3(turn, x), pin.FrameType.OP_FRAME)))
        for k, (j, place, x) in enumerate(zip(joints, placements, probe_points(model), strict=True))
    ]


def surface_answer(
    pin_model: pin.Model,
    frames: Sequence[int],
    bodies: Sequence[pin.Inertia],
    motion: tuple[Float[Array, "nq"], Float[Array, "nv"], Float[Array, "nv"]],
    rates: Float[Array, "nv nu"] | None,
) -> Found:
    """Evaluate all at one state.

    Args:
        frames: the probe frames by body.
        bodies: inertias of the bodies, in their joints' frames.
        motion: q, v and v̇.
        rates: takes ν to v; None of loops, whose parts of bodies are no bodies.

    """
    found: Found = defaultdict(dict)
    joints = {pin_model.frames[f].parentJoint for f in frames}
    has_parts = rates is None or len(joints) < len(frames)
    add_parts(
        found,
        lambda: _add_frames(found, pin_model, frames, motion),
        lambda: _add_data(found, pin_model, frames, motion),
        lambda: _add_regressors(found, pin_model, frames, bodies, motion),
        lambda: _add_centres(found, pin_model, frames, motion, rates is None),
        *relations(found, pin_model, frames, motion, is_tree=rates is not None, has_parts=has_parts),
    )
    if rates is not None:
        add_parts(
            found,
            lambda: _add_torques(found, pin_model, motion, rates),
            lambda: _add_batch(found, pin_model, motion, rates),
            lambda: add_mimic(found, pin_model, motion, rates),
        )
    return found


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
    """Step from one place in the plane, or from one angle, to another as the group's difference says."""
    *place, angle = given
    before, there = (
        np.array([*(x * (1.0 - shift) for x in place), np.cos(angle - shift), np.sin(angle - shift)])
        for shift in (0.5, 0.0)
    )
    *moved, c, s = group.integrate(before, group.difference(before, there))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return [turn, np.array([*moved, height])][: 1 + bool(place)]


def _product(matrix: Any, x: Array) -> Array:
    """Multiply; Pinocchio returns a matrix of one column as a vector."""
    return np.reshape(matrix, (-1, len(x))) @ x


def _rate(by_q: Any, by_v: Any, v: Array, a: Array) -> Array:
    """The rate of something whose derivatives by q and v these are."""
    return _product(by_q, v) + _product(by_v, a)


class _Twists:
    """Spatial vectors at the probe frames in one reference frame: by function, what they are, algorithm."""

    def __init__(self, m: pin.Model, data: pin.Data, name: str) -> None:
        self.m, self.data, self.frame, self.name = m, data, FRAMES[name], name
        self.reference = getattr(pin.ReferenceFrame, name)
        self.found: dict[tuple[str, str, str], list[Array]] = defaultdict(list)

    def add(
        self, function: str, what: str, twist: Any, f: int, by: str = "", is_of_joint: bool = False
    ) -> None:
        """Add one of probe frame f, or of its joint, which is moved there."""
        vector = np.array(getattr(twist, "vector", twist))
        if is_of_joint:
            joint, place = self.m.frames[f].parentJoint, self.m.frames[f].placement
            if what == "acceleration":  # a classical one is moved as the spatial one
                what, velocity = SPATIAL, pin.getVelocity(self.m, self.data, joint, self.reference)
                vector[:3] -= np.cross(velocity.angular, velocity.linear)
            moves = {"LOCAL": place, "WORLD": pin.SE3.Identity()}
            aligned = pin.SE3(np.eye(3), self.data.oMi[joint].rotation @ place.translation)
            vector = moves.get(self.name, aligned).actInv(pin.Motion(vector)).vector
        self.found[function, what, by].append(vector)

    def store(self, found: Found) -> None:
        """Put all into the answer."""
        frame = self.frame
        for (function, what, by), values in self.found.items():
            call, halves = (
                (*function.split(), f"ReferenceFrame.{self.name}"),
                np.split(np.array(values), 2, 1),
            )
            found[f"frame_{what}{frame.of_point}{by}"][call] = halves[0]
            found[f"frame_angular_{ANGULAR[what]}{frame.of_rotation}{by}"][call] = halves[1]


def _add_frames(
    found: Found, m: pin.Model, frames: Sequence[int], motion: tuple[Array, Array, Array]
) -> None:
    (q, v, a), data, derived, other = motion, m.createData(), m.createData(), m.createData()
    pin.forwardKinematics(m, data, q, v, a)
    pin.updateFramePlacements(m, data)
    pin.computeForwardKinematicsDerivatives(m, derived, q, v, a)
    pin.updateFramePlacements(m, derived)
    pin.computeJointJacobiansTimeVariation(m, data, q, v)
    pin.computeJointKinematicHessians(m, derived, q)
    for name in FRAMES:
        twists = _Twists(m, data, name)
        reference, of_rate = twists.reference, twists.frame.of_rate
        for f in frames:
            joint = m.frames[f].parentJoint
            _read_twists(twists, "Frame", f, f, derived, v, a)
            _read_twists(twists, "Joint", joint, f, derived, v, a)
            _read_hessian(twists, "Joint", joint, f, derived, v, a)
            _read_hessian(twists, "Frame", f, f, derived, v, a)
            J = np.array(pin.computeFrameJacobian(m, other, q, f, reference))
            rate = _rate(pin.frameJacobianTimeVariation(m, other, q, v, f, reference), J, v, a)
            twists.add("computeFrameJacobian", "velocity", _product(J, v), f)
            twists.add("frameJacobianTimeVariation", of_rate, rate, f, "_by_jacobian_rate")
            if name == "LOCAL":
                J = pin.computeJointJacobian(m, other, q, joint)
                twists.add("computeJointJacobian", "velocity", _product(J, v), f, is_of_joint=True)
        twists.store(found)
        if name != "WORLD":
            _add_points(found, m, derived, frames, name, v, a)


def _read_twists(
    twists: _Twists, of: str, number: int, f: int, derived: pin.Data, v: Array, a: Array
) -> None:
    """Add what all functions of a frame or a joint give."""
    is_of_joint = of == "Joint"
    plain = "" if is_of_joint else of

    def read(function: str, data: pin.Data = twists.data) -> Any:
        return getattr(pin, function)(twists.m, data, number, twists.reference)

    J, dJ = read(f"get{of}Jacobian"), read(f"get{of}JacobianTimeVariation")
    by_q, by_v = read(f"get{of}VelocityDerivatives", derived)[:2]
    *_, of_v, of_a = read(f"get{of}AccelerationDerivatives", derived)
    by = "_by_derivative"
    for function, what, twist, how in (
        (f"get{plain}Velocity", "velocity", read(f"get{plain}Velocity"), ""),
        (f"get{plain}Acceleration", SPATIAL, read(f"get{plain}Acceleration"), ""),
        (f"get{of}Jacobian", "velocity", _product(J, v), ""),
        (f"get{of}JacobianTimeVariation", twists.frame.of_rate, _rate(dJ, J, v, a), "_by_jacobian_rate"),
        (
            f"get{of}VelocityDerivatives computeForwardKinematicsDerivatives",
            "velocity",
            _product(by_v, v),
            by,
        ),
        # the derivatives of vectors in the world's axes are those of spatial ones
        (f"get{of}VelocityDerivatives", SPATIAL, _rate(by_q, by_v, v, a), by),
        (f"get{of}AccelerationDerivatives", SPATIAL, _rate(of_v, of_a, v / 2, a), by),
    ):
        twists.add(function, what, twist, f, how, is_of_joint)
    if twists.name != "WORLD":
        function = f"get{plain}ClassicalAcceleration"
        twists.add(function, "acceleration", read(function), f, "", is_of_joint)


def _read_hessian(
    twists: _Twists, of: str, number: int, f: int, derived: pin.Data, v: Array, a: Array
) -> None:
    """Add J̇ v + J v̇ with J̇ by the Hessian, whose numbers come in C++'s order.

    docs/surface/pinocchio_kinematic_hessians.py shows that order.
    """
    is_of_joint, given = of == "Joint", (twists.m, twists.data, number, twists.reference)
    J = getattr(pin, f"get{of}Jacobian")(*given)
    H = np.array(getattr(pin, f"get{of}KinematicHessian")(twists.m, derived, number, twists.reference))
    H = H.ravel().reshape(H.shape, order="F")
    function, what = f"get{of}KinematicHessian computeJointKinematicHessians", twists.frame.of_rate
    twists.add(function, what, _rate(H @ v, J, v, a), f, "_by_jacobian_rate", is_of_joint)


def _add_points(
    found: Found, m: pin.Model, derived: pin.Data, frames: Sequence[int], name: str, v: Array, a: Array
) -> None:
    """Add what derivatives of points' velocities and accelerations say; points have no angular part."""
    frame, reference = FRAMES[name], getattr(pin.ReferenceFrame, name)
    rows = defaultdict[tuple[str, str], list[Array]](list)
    for f in frames:
        place = m.frames[f].parentJoint, m.frames[f].placement, reference
        by_q, by_v = pin.getPointVelocityDerivatives(m, derived, *place)
        *_, of_v, of_a = pin.getPointClassicAccelerationDerivatives(m, derived, *place)
        function = "getPointVelocityDerivatives"
        rows["velocity", function].append(_product(by_v, v))
        what = "spatial_acceleration" if name == "LOCAL" else "acceleration"
        rows[what, function].append(_rate(by_q, by_v, v, a))
        acceleration = _rate(of_v, of_a, v / 2, a)
        rows["acceleration", "getPointClassicAccelerationDerivatives"].append(acceleration)
    for (what, function), values in rows.items():
        found[f"frame_{what}{frame.of_point}_by_derivative"][function,] = np.array(values)


def _add_data(found: Found, m: pin.Model, frames: Sequence[int], motion: tuple[Array, Array, Array]) -> None:
    """Add what algorithms leave in their data, joint by joint."""
    (q, v, a), data, derived = motion, m.createData(), m.createData()
    pin.rnea(m, data, q, v, a)
    pin.computeRNEADerivatives(m, derived, q, v, a)
    pin.forwardKinematics(m, data, q, v, a)
    pin.updateFramePlacements(m, data)
    pin.computeJointJacobiansTimeVariation(m, data, q, v)
    pin.updateGlobalPlacements(m, data)
    chained = [pin.SE3.Identity()]
    for joint in range(1, m.njoints):
        chained.append(chained[m.parents[joint]] * data.liMi[joint])
    spatial, places = (
        "spatial_acceleration",
        [(m.frames[f].parentJoint, m.frames[f].placement) for f in frames],
    )
    poses = {
        ("forwardKinematics", "Data.oMi"): [data.oMi[j] * place for j, place in places],
        ("Data.liMi",): [chained[j] * place for j, place in places],
        ("updateFramePlacements", "Data.oMf"): [data.oMf[f].copy() for f in frames],
        ("updateFramePlacement",): [pin.updateFramePlacement(m, data, f).copy() for f in frames],
        ("updateGlobalPlacements",): [data.oMi[j] * place for j, place in places],
    }
    for call, found_poses in poses.items():
        found["frame_position"][call] = np.array([pose.translation for pose in found_poses])
        found["frame_axes"][call] = np.concatenate([pose.rotation.T for pose in found_poses])
    weight = pin.Motion(m.gravity.linear, np.zeros(3))
    for what, at, by, values in (
        ("velocity", "_local", ("forwardKinematics", "Data.v"), data.v),
        (spatial, "_local", ("forwardKinematics", "Data.a"), data.a),
        (spatial, "_local", ("rnea", "Data.a_gf"),
         [x + pose.actInv(weight) for x, pose in zip(data.a_gf, data.oMi, strict=True)]),
        ("velocity", "_at_origin", ("computeRNEADerivatives", "Data.ov"), derived.ov),
        (spatial, "_at_origin", ("computeRNEADerivatives", "Data.oa"), derived.oa),
        (spatial, "_at_origin", ("computeRNEADerivatives", "Data.oa_gf"),
         [x + weight for x in derived.oa_gf]),
    ):  # fmt: skip
        twists = [place.actInv(values[j]) if at == "_local" else values[j] for j, place in places]
        found[f"frame_{what}{at}"][by] = np.array([twist.linear for twist in twists])
        turn = "_local" if at == "_local" else ""
        found[f"frame_angular_{ANGULAR[what]}{turn}"][by] = np.array([twist.angular for twist in twists])
    J, dJ = (np.reshape(x, (6, m.nv)) for x in (data.J, data.dJ))
    columns = [
        np.concatenate([np.arange(m.idx_vs[i], m.idx_vs[i] + m.nvs[i]) for i in m.supports[j]]).astype(int)
        for j, _ in places
    ]
    velocity = np.array([J[:, own] @ v[own] for own in columns])
    rate = np.array([dJ[:, own] @ v[own] + J[:, own] @ a[own] for own in columns])
    found["frame_velocity_at_origin"]["computeJointJacobians", "Data.J"] = velocity[:, :3]
    by = "computeJointJacobiansTimeVariation", "Data.dJ"
    found["frame_spatial_acceleration_at_origin_by_jacobian_rate"][by] = rate[:, :3]


def _add_centres(
    found: Found, m: pin.Model, frames: Sequence[int], motion: tuple[Array, Array, Array], has_parts: bool
) -> None:
    (q, v, a), data, derived = motion, m.createData(), m.createData()
    found["total_mass"]["computeTotalMass",] = np.array([[pin.computeTotalMass(m)]])
    pin.centerOfMass(m, data, q, v, a)
    for quantity, name in (("", "com"), ("_velocity", "vcom"), ("_acceleration", "acom")):
        values = getattr(data, name)
        found[f"centre_of_mass{quantity}"]["centerOfMass", f"Data.{name}"] = values[0][None].copy()
    jacobian = np.reshape(pin.jacobianCenterOfMass(m, data, q), (3, -1)).copy()
    found["centre_of_mass_velocity"]["jacobianCenterOfMass", "Data.Jcom"] = _product(data.Jcom, v)[None]
    pin.computeForwardKinematicsDerivatives(m, derived, q, v, a)
    pin.centerOfMass(m, derived, q, v)
    rate = _rate(pin.getCenterOfMassVelocityDerivatives(m, derived), jacobian, v, a)
    found["centre_of_mass_acceleration_by_derivative"]["getCenterOfMassVelocityDerivatives",] = rate[None]
    joints = [m.frames[f].parentJoint for f in frames]
    if not has_parts and len(set(joints)) == len(joints):  # no joint carries two bodies
        _add_subtrees(found, m, joints, motion)
    momenta = {
        ("computeCentroidalMomentum", "Data.hg"): pin.computeCentroidalMomentum(m, data, q, v).vector.copy(),
        ("computeCentroidalMap", "Data.Ag"): _product(pin.computeCentroidalMap(m, data, q), v),
        ("ccrba",): _product(pin.ccrba(m, data, q, v), v),
    }
    variation = pin.computeCentroidalMomentumTimeVariation(m, data, q, v, a).vector.copy()
    rates = {("computeCentroidalMomentumTimeVariation", "Data.dhg"): variation}
    dAg = np.array(pin.computeCentroidalMapTimeVariation(m, data, q, v))
    by_map = {
        ("computeCentroidalMapTimeVariation", "Data.dAg"): _rate(dAg, data.Ag, v, a),
        ("dccrba",): _rate(pin.dccrba(m, data, q, v), data.Ag, v, a),
    }
    pin.computeCentroidalDynamicsDerivatives(m, derived, q, v, a)
    by_derivative = dict[Call, Array]()
    again = m.createData()
    pin.computeRNEADerivatives(m, again, q, v, a)
    for name, (h_q, _, of_v, of_a) in (
        ("compute", pin.computeCentroidalDynamicsDerivatives(m, derived, q, v, a)),
        ("get", pin.getCentroidalDynamicsDerivatives(m, again)),
    ):
        by_derivative[f"{name}CentroidalDynamicsDerivatives",] = (
            _rate(h_q, of_a, v, a) + _rate(of_v, of_a, v / 2, a)
        ) / 2
    for suffix, twists in (
        ("", momenta), ("_rate", rates), ("_rate_by_map_rate", by_map),
        ("_rate_by_derivative", by_derivative),
    ):  # fmt: skip
        for call, twist in twists.items():
            found[f"momentum{suffix}"][call] = twist[None, :3].copy()
            found[f"centroidal_angular_momentum{suffix}"][call] = twist[None, 3:].copy()


def _add_subtrees(
    found: Found, m: pin.Model, joints: Sequence[int], motion: tuple[Array, Array, Array]
) -> None:
    (q, v, a), data, other = motion, m.createData(), m.createData()
    pin.centerOfMass(m, data, q, v, a, True)
    poses = [data.oMi[j] for j in joints]
    centres = [pose.act(data.com[j]) for j, pose in zip(joints, poses, strict=True)]
    found["subtree_centre"]["centerOfMass",] = np.array(centres)
    for quantity, values in (("velocity", data.vcom), ("acceleration", data.acom)):
        turned = [pose.rotation @ values[j] for j, pose in zip(joints, poses, strict=True)]
        found[f"subtree_{quantity}"]["centerOfMass",] = np.array(turned)
    pin.computeSubtreeMasses(m, data)
    found["subtree_mass"]["computeSubtreeMasses", "Data.mass"] = np.array([[data.mass[j]] for j in joints])
    velocities = [_product(pin.jacobianSubtreeCenterOfMass(m, other, q, j), v) for j in joints]
    found["subtree_velocity"]["jacobianSubtreeCenterOfMass",] = np.array(velocities)
    pin.jacobianCenterOfMass(m, other, q)
    velocities = [_product(pin.getJacobianSubtreeCenterOfMass(m, other, j), v) for j in joints]
    found["subtree_velocity"]["getJacobianSubtreeCenterOfMass",] = np.array(velocities)
    pin.crba(m, other, q, pin.Convention.LOCAL)
    centres = [pose.act(other.Ycrb[j].lever) for j, pose in zip(joints, poses, strict=True)]
    found["subtree_centre"]["Data.Ycrb",] = np.array(centres)
    pin.ccrba(m, other, q, v)
    found["subtree_centre"]["Data.oYcrb",] = np.array([other.oYcrb[j].lever for j in joints])


def _add_regressors(
    found: Found, m: pin.Model, frames: Sequence[int], bodies: Sequence[pin.Inertia],
    motion: tuple[Array, Array, Array],
) -> None:  # fmt: skip
    (q, v, a), data = motion, m.createData()
    pin.rnea(m, data, q, v, a)
    forces = defaultdict[str, list[pin.Force]](list)
    pin.updateFramePlacements(m, data)
    for f, inertia in zip(frames, bodies, strict=True):
        j, place = m.frames[f].parentJoint, m.frames[f].placement
        own, here = inertia.toDynamicParameters(), place.actInv(inertia).toDynamicParameters()
        forces["bodyRegressor"].append(
            place.actInv(pin.Force(pin.bodyRegressor(data.v[j], data.a_gf[j]) @ own))
        )
        forces["jointBodyRegressor"].append(place.actInv(pin.Force(pin.jointBodyRegressor(m, data, j) @ own)))
        forces["frameBodyRegressor"].append(pin.Force(pin.frameBodyRegressor(m, data, f) @ here))
    for function, values in forces.items():
        found["body_force_local"][function,] = np.array([force.linear for force in values])
        found["body_moment_local"][function,] = np.array([force.angular for force in values])
    pin.forwardKinematics(m, data, q, v)
    own_twists = [
        (m.jointPlacements[j].inverse() * data.liMi[j]).act(
            data.v[j] - data.liMi[j].actInv(data.v[m.parents[j]])
        )
        for j in range(1, m.njoints)
    ]
    turns = np.concatenate([twist.vector for twist in own_twists])
    velocities = {
        "computeJointKinematicRegressor": [
            pin.computeJointKinematicRegressor(
                m, data, m.frames[f].parentJoint, pin.ReferenceFrame.LOCAL, m.frames[f].placement
            ) @ turns
            for f in frames
        ],
        "computeFrameKinematicRegressor": [
            pin.computeFrameKinematicRegressor(m, data, f, pin.ReferenceFrame.LOCAL) @ turns for f in frames
        ],
    }  # fmt: skip
    for function, twists in velocities.items():
        found["frame_velocity_local"][function,] = np.array([twist[:3] for twist in twists])
        found["frame_angular_velocity_local"][function,] = np.array([twist[3:] for twist in twists])


def _add_torques(found: Found, m: pin.Model, motion: tuple[Array, Array, Array], rates: Array) -> None:
    (q, v, a), data, zero, terms = motion, m.createData(), np.zeros(m.nv), m.createData()
    pin.computeAllTerms(m, terms, q, v)
    M = _add_products(found, m, motion, terms, rates)
    none = pin.StdVec_Force()
    none.extend([pin.Force.Zero()] * m.njoints)
    gravity: dict[Call, Array] = {
        ("computeGeneralizedGravity", "Data.g"): pin.computeGeneralizedGravity(m, data, q).copy(),
        ("computeStaticTorque",): pin.computeStaticTorque(m, data, q, none).copy(),
    }
    tau, rotors = pin.rnea(m, data, q, v, a).copy(), m.armature * a
    parameters = np.concatenate([inertia.toDynamicParameters() for inertia in m.inertias[1:]])
    rest = pin.rnea(m, data, q, zero, a)  # without the terms of velocities
    coriolis = _product(pin.computeCoriolisMatrix(m, data, q, v), v) + rest
    derived = m.createData()
    _, of_v, of_a = pin.computeRNEADerivatives(m, derived, q, v, a)
    by_regressor = _product(pin.computeJointTorqueRegressor(m, data, q, v, a), parameters)
    dynamics = {  # with the rotors
        ("rnea", "Data.tau"): tau,
        ("nonLinearEffects",): pin.nonLinearEffects(m, data, q, v) + M @ a,
        ("nle", "Data.nle"): pin.nle(m, data, q, v) + M @ a,
        ("computeAllTerms", "Data.nle"): terms.nle + M @ a,
        ("computeJointTorqueRegressor", "Data.jointTorqueRegressor"): by_regressor + rotors,
    }
    derivative = _rate(of_v, of_a, v / 2, a) + gravity["computeGeneralizedGravity", "Data.g"]
    again = pin.rnea(m, data, q, v, pin.aba(m, data, q, v, tau).copy())
    _add_energies(found, m, parameters, motion, none)
    found["generalized_gravity"] |= _on_rates(gravity, rates)
    for by, values in (
        ("", dynamics),
        ("_by_derivative", {("computeRNEADerivatives", "Data.dtau_dv"): derivative}),
        ("_by_aba", {("aba", "Data.ddq"): again}),
        (
            "_by_coriolis_matrix",
            {
                ("computeCoriolisMatrix", "Data.C"): coriolis,
                ("getCoriolisMatrix",): _product(pin.getCoriolisMatrix(m, derived), v) + rest,
            },
        ),
    ):
        own = {call: value - rotors for call, value in values.items()}
        found[f"inverse_dynamics{by}"] |= _on_rates(own, rates)


def _add_batch(found: Found, m: pin.Model, motion: tuple[Array, Array, Array], rates: Array) -> None:
    """Add what batched calls return, which the wheels of some versions lack."""
    tau = np.ravel(pin.rneaInParallel(1, pin.ModelPool(m, 1), *(x[:, None] for x in motion)))
    own: dict[Call, Array] = {("rneaInParallel", "ModelPool"): tau - m.armature * motion[2]}
    found["inverse_dynamics"] |= _on_rates(own, rates)


def _on_rates(forces: dict[Call, Array], rates: Array) -> dict[Call, Array]:
    """Forces on ν in place of those on v."""
    return {call: (rates.T @ value)[:, None] for call, value in forces.items()}


def _add_products(
    found: Found, m: pin.Model, motion: tuple[Array, Array, Array], terms: pin.Data, rates: Array
) -> Array:
    """Add products with the mass matrix, its factors and its inverse; return the matrix."""
    (q, v, _), data = motion, m.createData()
    M = np.reshape(pin.crba(m, data, q), (m.nv, m.nv)).copy()
    momentum = M @ v
    pin.cholesky.decompose(m, data)
    U, D, upper = np.reshape(data.U, M.shape), np.ravel(data.D), np.triu(np.reshape(terms.M, M.shape))
    world = np.reshape(pin.crba(m, m.createData(), q, pin.Convention.WORLD), M.shape)
    momenta = {
        ("crba", "Data.M"): momentum,
        ("crba", "Convention", "Convention.WORLD"): world @ v,
        ("cholesky.decompose", "Data.U", "Data.D"): U @ (D * (U.T @ v)),
        ("computeAllTerms", "Data.M"): upper @ v + np.triu(upper, 1).T @ v,
    }
    through = {
        ("cholesky.decompose", "cholesky.solve"): M @ np.ravel(pin.cholesky.solve(m, data, momentum)),
        ("cholesky.computeMinv",): M @ _product(pin.cholesky.computeMinv(m, data), momentum),
    }
    by_aba: dict[Call, Array] = {
        ("computeMinverse", "Data.Minv"): M @ _product(pin.computeMinverse(m, data, q), momentum)
    }
    found["generalized_momentum"] |= _on_rates(momenta, rates)
    found["momentum_through_inverse"] |= _on_rates(through, rates)
    found["momentum_through_inverse_by_aba"] |= _on_rates(by_aba, rates)
    return M


def _add_energies(
    found: Found, m: pin.Model, parameters: Array, motion: tuple[Array, Array, Array], none: pin.StdVec_Force
) -> None:
    (q, v, a), data, terms = motion, m.createData(), m.createData()
    of_rotors = float(m.armature @ v**2) / 2
    kinetic = {
        ("computeKineticEnergy", "Data.kinetic_energy"): pin.computeKineticEnergy(m, data, q, v),
        ("computeKineticEnergyRegressor", "Data.kineticEnergyRegressor"): of_rotors
        + float(pin.computeKineticEnergyRegressor(m, data, q, v) @ parameters),
    }
    gravity = {
        ("computePotentialEnergy", "Data.potential_energy"): pin.computePotentialEnergy(m, data, q),
        ("computePotentialEnergyRegressor", "Data.potentialEnergyRegressor"): float(
            pin.computePotentialEnergyRegressor(m, data, q) @ parameters
        ),
    }
    both = {("computeMechanicalEnergy", "Data.mechanical_energy"): pin.computeMechanicalEnergy(m, data, q, v)}
    g = pin.computeGeneralizedGravity(m, terms, q).copy()
    second = {
        ("computeGeneralizedGravityDerivatives",): pin.computeGeneralizedGravityDerivatives(
            m, terms, q
        ).copy(),
        ("computeStaticTorqueDerivatives",): pin.computeStaticTorqueDerivatives(m, terms, q, none).copy(),
        ("computeRNEADerivatives", "Data.dtau_dq"): pin.computeRNEADerivatives(m, terms, q, 0 * v, 0 * v)[
            0
        ].copy(),
    }
    rates = {call: float(v @ _product(matrix, v) + g @ a) for call, matrix in second.items()}
    for quantity, values in (
        ("kinetic_energy", kinetic), ("gravity_energy", gravity), ("mechanical_energy", both),
        ("gravity_energy_second_rate", rates),
    ):  # fmt: skip
        found[quantity] |= {call: np.array([[value]]) for call, value in values.items()}
