"""What Pinocchio reports of a tree besides the state quantities: frames, centres of mass, momenta, torques.

Reference frames: LOCAL has the origin and the axes of the frame, LOCAL_WORLD_ALIGNED its origin and the
world's axes, WORLD gives the spatial vector at the world's origin.  A frame's acceleration is the spatial one
but for `getFrameClassicalAcceleration` and for the rate of the Jacobian in LOCAL_WORLD_ALIGNED.  `rnea` and
`crba` count the rotors, which are taken out of torques here.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from plumbline.model.datatypes import Array, Call, Float, Model, SurfaceAnswer
from plumbline.model.kinematics import rotation_matrix
from plumbline.model.probe_frames import PROBE_ATTITUDE, probe_points


class _Frame(NamedTuple):
    """What vectors in a reference frame are."""

    of_point: str = ""  # suffix of quantities of points
    of_rotation: str = ""  # … of rotations
    of_rate: str = "spatial_acceleration"  # what J̇ q̇ + J q̈ is


FRAMES = {
    "LOCAL_WORLD_ALIGNED": _Frame(of_rate="acceleration"),
    "LOCAL": _Frame("_local", "_local"),
    "WORLD": _Frame("_at_origin"),
}
ANGULAR = {"velocity": "velocity", "acceleration": "acceleration", "spatial_acceleration": "acceleration"}
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
    motion: tuple[Float[Array, "nq"], Float[Array, "nv"], Float[Array, "nv"]],
    rates: Float[Array, "nv nu"],
) -> SurfaceAnswer:
    """Evaluate all at one state.

    Args:
        frames: the probe frames by body.
        motion: q, v and v̇.
        rates: takes ν to v.

    """
    found: Found = defaultdict(dict)
    _add_frames(found, pin_model, frames, motion)
    _add_centres(found, pin_model, motion)
    _add_torques(found, pin_model, motion, rates)
    return found


def _product(matrix: Any, x: Array) -> Array:
    """Multiply; Pinocchio returns a matrix of one column as a vector."""
    return np.reshape(matrix, (-1, len(x))) @ x


def _add_frames(
    found: Found, m: pin.Model, frames: Sequence[int], motion: tuple[Array, Array, Array]
) -> None:
    (q, v, a), data = motion, m.createData()
    pin.forwardKinematics(m, data, q, v, a)
    pin.updateFramePlacements(m, data)
    places = {
        "updateFramePlacements": [data.oMf[f].copy() for f in frames],
        "updateFramePlacement": [pin.updateFramePlacement(m, data, f).copy() for f in frames],
    }
    for function, poses in places.items():
        found["frame_position"][function,] = np.array([pose.translation for pose in poses])
        found["frame_axes"][function,] = np.concatenate([pose.rotation.T for pose in poses])
    pin.computeJointJacobiansTimeVariation(m, data, q, v)
    other = m.createData()
    for name, frame in FRAMES.items():
        reference = getattr(pin.ReferenceFrame, name)
        # by function, what its vectors are, by which algorithm
        twists: dict[tuple[str, str, str], list[Array]] = defaultdict(list)
        for f in frames:

            def read(function: str, f: int = f, reference: Any = reference) -> Any:
                return getattr(pin, function)(m, data, f, reference)

            J, dJ = read("getFrameJacobian"), read("getFrameJacobianTimeVariation")
            rates = {"getFrameJacobianTimeVariation": _product(dJ, v) + _product(J, a)}
            velocities = {
                "getFrameVelocity": read("getFrameVelocity").vector,
                "getFrameJacobian": _product(J, v),
            }
            J = np.array(pin.computeFrameJacobian(m, other, q, f, reference))
            dJ = pin.frameJacobianTimeVariation(m, other, q, v, f, reference)
            velocities["computeFrameJacobian"] = _product(J, v)
            rates["frameJacobianTimeVariation"] = _product(dJ, v) + _product(J, a)
            for function, twist in velocities.items():
                twists[function, "velocity", ""].append(twist)
            for function, twist in rates.items():
                twists[function, frame.of_rate, "_by_jacobian_rate"].append(twist)
            function = "getFrameAcceleration"
            twists[function, "spatial_acceleration", ""].append(read(function).vector)
            if reference != pin.ReferenceFrame.WORLD:
                function = "getFrameClassicalAcceleration"
                twists[function, "acceleration", ""].append(read(function).vector)
        for (function, what, by), values in twists.items():
            call, (linear, angular) = (function, f"ReferenceFrame.{name}"), np.split(np.array(values), 2, 1)
            found[f"frame_{what}{frame.of_point}{by}"][call] = linear
            found[f"frame_angular_{ANGULAR[what]}{frame.of_rotation}{by}"][call] = angular


def _add_centres(found: Found, m: pin.Model, motion: tuple[Array, Array, Array]) -> None:
    (q, v, a), data = motion, m.createData()
    found["total_mass"]["computeTotalMass",] = np.array([[pin.computeTotalMass(m)]])
    pin.centerOfMass(m, data, q, v, a)
    for quantity, values in (("", data.com), ("_velocity", data.vcom), ("_acceleration", data.acom)):
        found[f"centre_of_mass{quantity}"]["centerOfMass",] = values[0][None].copy()
    jacobian = pin.jacobianCenterOfMass(m, data, q)
    found["centre_of_mass_velocity"]["jacobianCenterOfMass",] = _product(jacobian, v)[None]
    momenta = {
        "computeCentroidalMomentum": pin.computeCentroidalMomentum(m, data, q, v).vector.copy(),
        "computeCentroidalMap": _product(pin.computeCentroidalMap(m, data, q), v),
        "ccrba": _product(pin.ccrba(m, data, q, v), v),
    }
    rates = {
        "computeCentroidalMomentumTimeVariation": pin.computeCentroidalMomentumTimeVariation(
            m, data, q, v, a
        ).vector.copy(),
    }
    by_map = {
        "computeCentroidalMapTimeVariation": _product(pin.computeCentroidalMapTimeVariation(m, data, q, v), v)
        + _product(data.Ag, a),
        "dccrba": _product(pin.dccrba(m, data, q, v), v) + _product(data.Ag, a),
    }
    for suffix, twists in (("", momenta), ("_rate", rates), ("_rate_by_map_rate", by_map)):
        for function, twist in twists.items():
            found[f"momentum{suffix}"][function,] = twist[None, :3].copy()
            found[f"centroidal_angular_momentum{suffix}"][function,] = twist[None, 3:].copy()


def _add_torques(found: Found, m: pin.Model, motion: tuple[Array, Array, Array], rates: Array) -> None:
    (q, v, a), data, zero = motion, m.createData(), np.zeros(m.nv)
    none = pin.StdVec_Force()
    none.extend([pin.Force.Zero()] * m.njoints)
    M = np.reshape(pin.crba(m, data, q), (m.nv, m.nv)).copy()
    momentum = M @ v
    pin.cholesky.decompose(m, data)
    through = {
        ("cholesky.decompose", "cholesky.solve"): np.ravel(pin.cholesky.solve(m, data, momentum)),
        ("cholesky.computeMinv",): _product(pin.cholesky.computeMinv(m, data), momentum),
    }
    by_aba = {("computeMinverse",): _product(pin.computeMinverse(m, data, q), momentum)}
    gravity = {
        ("computeGeneralizedGravity",): pin.computeGeneralizedGravity(m, data, q).copy(),
        ("computeStaticTorque",): pin.computeStaticTorque(m, data, q, none).copy(),
    }
    tau = pin.rnea(m, data, q, v, a).copy()
    parameters = np.concatenate([inertia.toDynamicParameters() for inertia in m.inertias[1:]])
    rotors = m.armature * a
    again = pin.rnea(m, data, q, v, pin.aba(m, data, q, v, tau)) - rotors
    rest = pin.rnea(m, data, q, zero, a) - rotors  # without the terms of velocities
    coriolis = _product(pin.computeCoriolisMatrix(m, data, q, v), v) + rest
    dynamics = {
        ("rnea",): tau - rotors,
        ("nonLinearEffects",): pin.nonLinearEffects(m, data, q, v) + M @ a - rotors,
        ("computeJointTorqueRegressor",): _product(
            pin.computeJointTorqueRegressor(m, data, q, v, a), parameters
        ),
    }
    for quantity, values in (
        ("generalized_momentum", {("crba",): momentum}),
        ("momentum_through_inverse", {call: M @ x for call, x in through.items()}),
        ("momentum_through_inverse_by_aba", {call: M @ x for call, x in by_aba.items()}),
        ("generalized_gravity", gravity),
        ("inverse_dynamics", dynamics),
        ("inverse_dynamics_by_aba", {("aba",): again}),
        ("inverse_dynamics_by_coriolis_matrix", {("computeCoriolisMatrix",): coriolis}),
    ):
        found[quantity] |= {call: (rates.T @ value)[:, None] for call, value in values.items()}
