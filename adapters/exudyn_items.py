"""Nodes, bodies, markers, joints, loads and sensors of Exudyn that no column builds a mechanism of.

Each is put where a body of the mechanism is, in a system of its own, and says where the body is, how it moves
or what pushes it.  What is plane or one-dimensional is there once per coordinate axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import exudyn
import numpy as np
from exudyn import kinematicTree, rigidBodyUtilities, robotics

from adapters.exudyn_common import (
    Output,
    initialized_solver,
    items,
    known_arguments,
    make_rigid_body,
    make_settings,
    make_system,
    sizes_of_body,
)
from adapters.pose_functions import Pose
from adapters.surface_record import SurfaceRecord
from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array, Call, Float, Model, State
from plumbline.model.kinematics import quaternion_rate, rotate_vectors, rotation_matrix
from plumbline.model.probe_frames import PROBE_ATTITUDE, anchor_point, probe_points

AXES = np.eye(3)
IMPLICIT = "MainSolverImplicitSecondOrder"
utilities: Any = rigidBodyUtilities  # as below, functions are untyped
trees: Any = kinematicTree
robots: Any = robotics
PLANES = [(1, 2), (2, 0), (0, 1)]  # coordinates in the planes normal to x, y and z
ITEM, MASS = "itemInterface", "MainSolverStatic"


class Body(NamedTuple):
    """A body at its state; vectors in the world but for ``arm``, which is in the body, to its probe point."""

    place: Float[Array, "3"]
    velocity: Float[Array, "3"]
    turn: Float[Array, "3 3"]
    spin: Float[Array, "3"]
    arm: Float[Array, "3"]
    mass: float
    attitude: Float[Array, "4"]
    inertia: Float[Array, "3 3"]


def bodies_at(model: Model, state: State) -> list[Body]:
    """List the bodies of a state."""
    turns = rotation_matrix(state.p)
    spins, arms = rotate_vectors(turns, state.omega), probe_points(model)
    fields = state.r, state.v, turns, spins, arms, model.mass, state.p, np.asarray(model.inertia)
    return [Body(*one) for one in zip(*fields, strict=True)]


class _Items(SurfaceRecord):
    """A system to which a part adds items, and the rows that it finds."""

    def __init__(self, found: Any) -> None:
        super().__init__()
        self.found = found
        self.mbs, self.container = make_system()

    def node(self, kind: str, **given: Any) -> Any:
        return self.mbs.AddNode(getattr(items, kind)(**given))

    def body(self, kind: str, node: Any, **given: Any) -> Any:
        sizes = sizes_of_body(**{name: given.pop(name) for name in ("mass", "inertia") if name in given})
        return self.mbs.AddObject(getattr(items, kind)(nodeNumber=node, **sizes, **given))

    def object(self, kind: str, *markers: Any, **given: Any) -> Any:
        own = {"markerNumbers": list(markers)} if markers else {}
        return self.mbs.AddObject(getattr(items, kind)(**own, **given))

    def marker(self, kind: str, **given: Any) -> Any:
        return self.mbs.AddMarker(getattr(items, kind)(**given))

    def sensor(self, kind: str, **given: Any) -> Any:
        return self.mbs.AddSensor(getattr(items, kind)(writeToFile=False, storeInternal=False, **given))

    def ground(self, place: Any = (0.0, 0.0, 0.0)) -> Any:
        """A rigid marker of the world."""
        body = self.mbs.AddObject(items.ObjectGround())
        return self.marker("MarkerBodyRigid", bodyNumber=body, localPosition=list(place))

    def of_body(self, body: Any, output: str, point: Sequence[float] = (0.0, 0.0, 0.0)) -> Array:
        return np.array(self.mbs.GetObjectOutputBody(body, getattr(Output, output), list(point)))

    def of_object(self, item: Any, output: str) -> Array:
        return np.array(self.mbs.GetObjectOutput(item, getattr(Output, output)))

    def jacobian(self, item: Any) -> Array:
        """Of a constraint, times the velocities of its coordinates."""
        what, data = exudyn.ComputeItemType.ConstraintJacobian, self.mbs.systemData
        rates = np.array(data.GetODE2Coordinates_t())[np.array(data.GetObjectLTGODE2(item))]
        return np.asarray(np.array(self.mbs.ComputeItem(item, what)) @ rates)


def _call(*names: str) -> Call:
    return tuple(f"{ITEM}.{name}" for name in names)


def add_item_answers(record: SurfaceRecord, model: Model, state: State) -> None:
    """Add what all items say of the bodies of a state."""
    bodies, anchor = bodies_at(model, state), anchor_point(model)
    add_parts(record.found, *(partial(_add_part_of_items, record, part, bodies, anchor) for part in PARTS))


def _add_part_of_items(
    record: SurfaceRecord, part: Callable[..., None], bodies: Sequence[Body], anchor: Array
) -> None:
    part(_Items(record.found), bodies, anchor)


def _momenta(s: _Items, bodies: Sequence[Any]) -> list[Array]:
    """The system's mass matrix times its velocities, of bodies."""
    solver: Any = exudyn.MainSolverStatic()
    with initialized_solver(solver, s.mbs, make_settings()):
        solver.ComputeMassMatrix(s.mbs)  # ComputeItem fails at mass points
        M = np.array(solver.GetSystemMassMatrix())
    data = s.mbs.systemData
    momenta = M @ np.array(data.GetODE2Coordinates_t())
    return [momenta[np.array(data.GetObjectLTGODE2(body))] for body in bodies]


def _add_points(node_kind: str, body_kind: str) -> Callable[..., None]:
    """Mass points: half of each place is the reference."""

    def add(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
        nodes, points = [], []
        for one in bodies:
            half = (one.place / 2).tolist()
            given = {
                "referenceCoordinates": half,
                "initialCoordinates": half,
                "initialVelocities": one.velocity,
            }
            nodes.append(s.node(node_kind, **given))
            points.append(s.body(body_kind, nodes[-1], mass=one.mass))
        s.mbs.Assemble()
        call = _call(node_kind, body_kind)
        s.add("body_position", call, [s.of_body(point, "Position") for point in points])
        s.add("body_velocity", call, [s.of_body(point, "Velocity") for point in points])
        masses = np.array([one.mass for one in bodies])[:, None]
        s.add("body_velocity", (*call, MASS), np.array(_momenta(s, points)) / masses)
        for output in ("Displacement", "Coordinates"):
            values = [s.mbs.GetNodeOutput(node, getattr(Output, output)) for node in nodes]
            call = *_call(node_kind), f"OutputVariableType.{output}"
            s.add("body_position", call, 2 * np.array(values))

    return add


def _add_created_points(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    points = [
        s.mbs.CreateMassPoint(
            referencePosition=one.place, initialVelocity=one.velocity, **sizes_of_body(mass=one.mass)
        )
        for one in bodies
    ]
    points = [
        point[-1] if isinstance(point, list) else point for point in points
    ]  # before 1.10 with the node
    s.mbs.Assemble()
    call = ("MainSystem.CreateMassPoint",)
    s.add("body_position", call, [s.of_body(point, "Position") for point in points])
    masses = np.array([one.mass for one in bodies])[:, None]
    s.add("body_velocity", call, np.array(_momenta(s, points)) / masses)


def _add_plane_points(node_kind: str, body_kind: str) -> Callable[..., None]:
    """Mass points in the three planes, of whose coordinates each is in two."""

    def add(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
        made = []
        for k, one in enumerate(bodies):
            for plane in map(list, PLANES):
                given = {"initialCoordinates": one.place[plane], "initialVelocities": one.velocity[plane]}
                made.append((k, plane, s.body(body_kind, s.node(node_kind, **given), mass=one.mass)))
        s.mbs.Assemble()
        places, velocities, momenta = np.zeros((3, len(bodies), 3))
        for (k, plane, body), momentum in zip(made, _momenta(s, [x[-1] for x in made]), strict=True):
            places[k, plane] += s.of_body(body, "Position")[:2] / 2
            velocities[k, plane] += s.of_body(body, "Velocity")[:2] / 2
            momenta[k, plane] += momentum / (2 * bodies[k].mass)
        call = _call(node_kind, body_kind)
        s.add("body_position", call, places)
        s.add("body_velocity", call, velocities)
        s.add("body_velocity", (*call, MASS), momenta)

    return add


def _to_x(axis: int) -> Array:
    """A turn that has a coordinate axis as its first column."""
    return np.roll(AXES, -axis, axis=1)


def _add_lines(body_kind: str) -> Callable[..., None]:
    """A mass on a line along each axis."""

    def add(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
        lines = []
        for one in bodies:
            for axis in range(3):
                half = [float(one.place[axis] / 2)]
                given = {"referenceCoordinates": half, "initialCoordinates": half}
                node = s.node("Node1D", initialVelocities=[float(one.velocity[axis])], **given)
                lines.append(s.body(body_kind, node, referenceRotation=_to_x(axis), mass=one.mass))
        s.mbs.Assemble()
        call = _call("Node1D", body_kind)
        for quantity, output in (("body_position", "Position"), ("body_velocity", "Velocity")):
            values = [s.of_body(line, output) for line in lines]
            s.add(quantity, call, np.sum(np.reshape(values, (-1, 3, 3)), axis=1))
        momenta = np.reshape(_momenta(s, lines), (-1, 3))
        masses = np.array([one.mass for one in bodies])[:, None]
        s.add("body_velocity", (*call, MASS), momenta / masses)

    return add


def _turn_about(values: Any) -> list[Array]:
    """The turns by these angles about x, y and z."""
    half = np.asarray(values)[:, None] / 2
    return list(rotation_matrix(np.concatenate([np.cos(half), np.sin(half) * AXES], axis=1)))


def _probe_axes(turns: Any) -> list[Array]:
    """The attitudes of probe frames of bodies whose turns about x, y and z are given."""
    return [x @ y @ z @ rotation_matrix(PROBE_ATTITUDE) for x, y, z in turns]


def _angles(one: Body) -> Array:
    return np.asarray(Pose(one.place, one.attitude).forms["xyz"])


def _add_rotors(body_kind: str) -> Callable[..., None]:
    """A rotor about each axis: attitudes are their turns in a row, spins their sum."""

    def add(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
        inertia, rotors = 0.5, []
        frames = [np.roll(_to_x(axis), 2, axis=1) for axis in range(3)]  # whose third column is the axis
        for one in bodies:
            for frame, angle, rate in zip(frames, _angles(one), one.spin, strict=True):
                given = {"initialCoordinates": [float(angle)], "initialVelocities": [float(rate)]}
                node = s.node("Node1D", **given)
                rotors.append(s.body(body_kind, node, inertia=inertia, referenceRotation=frame))
        s.mbs.Assemble()
        call = _call("Node1D", body_kind)
        turns = [s.of_body(rotor, "RotationMatrix").reshape(3, 3) for rotor in rotors]
        own = np.reshape([turn @ frame.T for turn, frame in zip(turns, frames * len(bodies), strict=True)],
                         (-1, 3, 3, 3))  # fmt: skip
        s.add_axes(call, _probe_axes(own))
        spins = np.reshape([s.of_body(rotor, "AngularVelocity") for rotor in rotors], (-1, 3, 3))
        s.add("frame_angular_velocity", call, np.sum(spins, axis=1))
        momenta = np.reshape(_momenta(s, rotors), (-1, 3))
        s.add("frame_angular_velocity", (*call, MASS), momenta / inertia)

    return add


def _add_plane_bodies(node_kind: str, body_kind: str, turning: str, sliding: str) -> Callable[..., None]:
    """Bodies in the three planes, at half of each velocity, with joints that would hold probe points."""

    def add(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
        made = []
        for k, one in enumerate(bodies):
            reach = one.turn @ one.arm
            for axis, plane in enumerate(map(list, PLANES)):
                angle, inertia = float(_angles(one)[axis]), 0.5
                turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
                node = s.node(
                    node_kind, initialCoordinates=[*one.place[plane], angle],
                    initialVelocities=[*one.velocity[plane] / 2, float(one.spin[axis])],
                )  # fmt: skip
                body = s.body(body_kind, node, inertia=inertia, mass=one.mass)
                point = [*(turn.T @ reach[plane]), 0.0]
                here = s.marker("MarkerBodyRigid", bodyNumber=body, localPosition=point)
                there = s.ground([*(one.place + reach)[plane], 0.0])
                across = [[*(turn.T @ normal), 0.0] for normal in np.eye(2)]
                joints = [s.object(turning, there, here)]
                joints += [
                    s.object(sliding, there, here, axisMarker0=[*along, 0.0], normalMarker1=normal)
                    for along, normal in zip(np.eye(2)[::-1].tolist(), across, strict=True)
                ]
                made.append((k, axis, plane, body, point, joints))
        s.mbs.Assemble()
        count, place, velocity = len(bodies), *np.zeros((2, len(bodies), 3))
        held, slid, spins, turned, momenta, spun = np.zeros((6, count, 3))
        turns = np.tile(np.eye(3), (count, 3, 1, 1))
        own = _momenta(s, [one[3] for one in made])
        for (k, axis, plane, body, point, joints), momentum in zip(made, own, strict=True):
            place[k, plane] += s.of_body(body, "Position", point)[:2] / 2
            velocity[k, plane] += s.of_body(body, "Velocity", point)[:2]
            spins[k, axis] = s.of_body(body, "AngularVelocity")[2]
            turns[k, axis][np.ix_(plane, plane)] = s.of_body(body, "RotationMatrix").reshape(3, 3)[:2, :2]
            held[k, plane] += s.jacobian(joints[0])
            rows = np.array([s.jacobian(joint) for joint in joints[1:]])
            slid[k, plane] += rows[:, 0]
            turned[k, axis] = (rows[0, 1] - rows[1, 1]) / 2
            momenta[k, plane] += momentum[:2] / bodies[k].mass
            spun[k, axis] = momentum[2] / inertia
        call, by = _call(node_kind, body_kind), "MainSystem.ComputeItem"
        s.add_axes(call, _probe_axes(turns))
        s.add("frame_position", call, place)
        s.add("frame_velocity", call, velocity)
        s.add("frame_angular_velocity", call, spins)
        s.add("body_velocity", (*call, MASS), momenta)
        s.add("frame_angular_velocity", (*call, MASS), spun)
        s.add("frame_velocity", (*_call(turning), by), held)
        s.add("frame_velocity", (*_call(sliding), by), slid)
        s.add("frame_angular_velocity", (*_call(sliding), by), turned)

    return add


def _own_points(s: _Items, bodies: Sequence[Body]) -> list[Any]:
    """Nodes that have the bodies' places as coordinates."""
    return [
        s.node("NodePoint", initialCoordinates=one.place, initialVelocities=one.velocity) for one in bodies
    ]


def _add_coordinate_constraints(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    """Constraints of single coordinates, whose equations and Jacobians say places and velocities.

    Half of each coordinate and of each velocity is the constraint's offset.
    """
    ground = s.node("NodePointGround")
    fixed = s.marker("MarkerNodeCoordinate", nodeNumber=ground, coordinate=0)
    nodes = _own_points(s, bodies)
    points = [s.body("ObjectMassPoint", node, mass=1.0) for node in nodes]
    long, short = "ObjectConnectorCoordinate", "CoordinateConstraint"
    made: dict[str, list[Any]] = {}
    for node, point, one in zip(nodes, points, bodies, strict=True):
        halves = zip((one.place / 2).tolist(), (one.velocity / 2).tolist(), strict=True)
        for i, (place, velocity) in enumerate(halves):
            marker = s.marker("MarkerNodeCoordinate", nodeNumber=node, coordinate=i)
            by_place = {"offsetUserFunction": lambda mbs, t, item, offset, x=place: x}
            by_velocity = {
                "velocityLevel": True, "offsetUserFunction_t": lambda mbs, t, item, offset, x=velocity: x
            }  # fmt: skip
            for name, kind, given in (
                (long, long, {"factorValue1": 2.0}), (short, short, {}),
                (f"{long}OffsetUserFunction", short, by_place),
                (f"{long}OffsetUserFunction_t", short, by_velocity),
            ):  # fmt: skip
                made.setdefault(name, []).append(s.object(kind, fixed, marker, **given))
            create, ends = exudyn.MainSystem.CreateCoordinateConstraint, [None, point]
            names = known_arguments(
                create, dict.fromkeys(("itemNumbers", "bodyOrNodeList", "bodyNumbers"), ends)
            )
            own = dict([*names.items()][:1])  # under the name of the version
            joint = create(s.mbs, coordinates=[None, i], offset=place, **own)
            made.setdefault("created", []).append(joint)
    s.mbs.Assemble()
    what = "OutputVariableType.ConstraintEquation"
    for name, quantity, call, factor in (
        (long, "body_position", (*_call(long), what), 0.5),
        (short, "body_position", (*_call(short), what), 1.0),
        (f"{long}OffsetUserFunction", "body_position", _call(f"{long}OffsetUserFunction"), 2.0),
        (f"{long}OffsetUserFunction_t", "body_velocity", _call(f"{long}OffsetUserFunction_t"), 2.0),
        ("created", "body_position", ("MainSystem.CreateCoordinateConstraint",), 2.0),
    ):
        values = np.reshape([s.of_object(joint, "ConstraintEquation") for joint in made[name]], (-1, 3))
        s.add(quantity, call, factor * values)
    rates = np.reshape([s.jacobian(joint) for joint in made[short]], (-1, 3))
    s.add("body_velocity", (*_call(short), "MainSystem.ComputeItem"), rates)


def _add_vector_constraints(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    """Constraints of all coordinates of a node or a body."""
    ground = s.node("NodePointGround")
    fixed = s.marker("MarkerNodeCoordinates", nodeNumber=ground)
    nodes = _own_points(s, bodies)
    points = [s.body("ObjectMassPoint", node, mass=1.0) for node in nodes]
    of_nodes = [s.marker("MarkerNodeCoordinates", nodeNumber=node) for node in nodes]
    of_bodies = [s.marker("MarkerObjectODE2Coordinates", objectNumber=point) for point in points]
    own = {"scalingMarker1": 2 * AXES}
    law = {
        "scalingMarker0": np.zeros((3, 1)),
        "constraintUserFunction": lambda mbs, t, item, q, rates, is_velocity: 2 * np.array(q)[-3:],
        "jacobianUserFunction": lambda mbs, t, item, q, rates, is_velocity: 2 * AXES,
    }
    long, short = "ObjectConnectorCoordinateVector", "CoordinateVectorConstraint"
    joints = {
        call: [s.object(kind, fixed, marker, **given) for marker in markers]
        for call, kind, markers, given in (
            (_call(long, "MarkerNodeCoordinates"), long, of_nodes, own),
            (_call(short, "MarkerObjectODE2Coordinates"), short, of_bodies, own),
            (_call(f"{long}ConstraintUserFunction", f"{long}JacobianUserFunction"), long, of_nodes, law),
        )
    }
    s.mbs.Assemble()
    what = exudyn.ComputeItemType.AlgebraicEquations
    for call, own_joints in joints.items():
        equations = [np.array(s.mbs.ComputeItem(joint, what)) for joint in own_joints]
        s.add("body_position", call, np.array(equations) / 2)
        s.add("body_velocity", call, np.array([s.jacobian(joint) for joint in own_joints]) / 2)


def _rigid_bodies(s: _Items, bodies: Sequence[Body]) -> list[Any]:
    """Bodies of unit inertia where the bodies are."""
    made = []
    for one in bodies:
        rates = quaternion_rate(one.attitude, one.turn.T @ one.spin)
        node = s.node(
            "NodeRigidBodyEP", referenceCoordinates=[*one.place, *one.attitude],
            initialVelocities=[*one.velocity, *rates],
        )  # fmt: skip
        made.append(s.mbs.AddObject(make_rigid_body(node, one.mass, AXES)))
    return made


def _add_relative_markers(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    """Markers of one coordinate of a body or between two, read by connectors."""
    ground = s.mbs.CreateGround(referencePosition=anchor)
    fixed = s.marker("MarkerNodeCoordinate", nodeNumber=s.node("NodePointGround"), coordinate=0)
    made: dict[str, list[Any]] = {}
    for body, one in zip(_rigid_bodies(s, bodies), bodies, strict=True):
        ends = {"bodyNumbers": [ground, body], "localPosition1": one.arm}
        node = s.mbs.GetObject(body)["nodeNumber"]
        for axis in range(3):
            for kind, given in (
                ("MarkerBodiesRelativeTranslationCoordinate", {"axis0": AXES[axis], **ends}),
                ("MarkerBodiesRelativeRotationCoordinate", {"axis0": AXES[axis], **ends}),
                ("MarkerNodeRotationCoordinate", {"nodeNumber": node, "rotationCoordinate": axis}),
            ):
                marker = s.marker(kind, **given)
                connector = s.object("CoordinateSpringDamper", fixed, marker, stiffness=2.0)
                made.setdefault(kind, []).append(connector)
    s.mbs.Assemble()
    for kind, moved, turned in (
        ("MarkerBodiesRelativeTranslationCoordinate", "frame_position_from_anchor", "frame_velocity"),
        ("MarkerBodiesRelativeRotationCoordinate", "", "frame_angular_velocity"),
        ("MarkerNodeRotationCoordinate", "axes", "frame_angular_velocity"),
    ):
        call = _call(kind) + (("MainSystem.CreateGround",) if kind.endswith("TranslationCoordinate") else ())
        place, rate = (
            np.reshape([s.of_object(one, output) for one in made[kind]], (-1, 3))
            for output in ("Displacement", "Velocity")
        )
        s.add(turned, call, rate)
        if moved == "axes":
            turns = _probe_axes([_turn_about(angles) for angles in place])
            s.add("frame_axes_by_angles", call, np.reshape(np.array(turns).mT, (-1, 3)))
        elif moved:
            s.add(moved, (*call, "OutputVariableType.Displacement"), place)


def _add_connectors(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    """Connectors and joints between the anchor and probe points, and what they say of the distance."""
    turn, shift = rotation_matrix(PROBE_ATTITUDE), anchor / 2
    fixed = s.ground(anchor)
    made = []
    for body, one in zip(_rigid_bodies(s, bodies), bodies, strict=True):
        marker = s.marker("MarkerBodyRigid", bodyNumber=body, localPosition=one.arm)
        made.append((
            s.object("ObjectConnectorCartesianSpringDamper", fixed, marker, stiffness=[2.0] * 3),
            s.object("ObjectConnectorDistance", fixed, marker, distance=1.0),
            s.object("ObjectConnectorRigidBodySpringDamper", fixed, marker, rotationMarker0=turn,
                     damping=3 * np.eye(6)),
            s.object("ObjectJointGeneric", fixed, marker, rotationMarker0=turn,
                     offsetUserFunction=lambda mbs, t, item, given: [*shift, 0.0, 0.0, 0.0]),
        ))  # fmt: skip
    spring, rod, six, joint = zip(*made, strict=True)
    sensors = {
        "Force": [s.sensor("SensorObject", objectNumber=x, outputVariableType=Output.Force) for x in spring],
        "Distance": [
            s.sensor("SensorObject", objectNumber=x, outputVariableType=Output.Distance) for x in rod
        ],
    }
    s.mbs.Assemble()
    sensed = {name: np.array([s.mbs.GetSensorValues(x) for x in own]) for name, own in sensors.items()}
    away, what = "frame_position_from_anchor", "OutputVariableType."
    s.add(away, (*_call("SensorObject"), f"{what}Force"), sensed["Force"] / 2)
    s.add("frame_distance", (*_call("SensorObject"), f"{what}Distance"), sensed["Distance"].reshape(-1, 1))
    local = np.array([s.of_object(one, "DisplacementLocal") for one in six])
    s.add(away, (f"{what}DisplacementLocal",), local @ turn.T)
    for quantity, output in (("frame_velocity", "ForceLocal"), ("frame_angular_velocity", "TorqueLocal")):
        values = np.array([s.of_object(one, output) for one in six])
        s.add(quantity, (f"{what}{output}",), values @ turn.T / 3)
    energies = np.array([[s.of_object(one, "PotentialEnergy")] for one in spring])  # of a stiffness of 2 N/m
    s.add("frame_distance", (f"{what}PotentialEnergy",), np.sqrt(energies))
    poses = np.reshape([s.of_object(one, "HomogeneousTransformationLocal") for one in six], (-1, 4, 4))
    s.add(away, (f"{what}HomogeneousTransformationLocal",), poses[:, :3, 3] @ turn.T)
    s.add_axes((f"{what}HomogeneousTransformationLocal",), turn @ poses[:, :3, :3] @ turn)
    equations = np.array([s.mbs.ComputeItem(one, exudyn.ComputeItemType.AlgebraicEquations) for one in joint])
    s.add(away, _call("ObjectJointGenericOffsetUserFunction"), equations[:, :3] + shift)


def _seen(item: dict[str, Any]) -> dict[str, Any]:
    """The parameters of an item that are given once, and not for drawing."""
    return {name: value for name, value in item.items() if not name.startswith("V") and "HT" not in name}


def _add_loads(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    """Loads of mass times place, by sensors and functions, and with parameters that are set later."""
    loads, later, changed = [], [], []
    for node, one in zip(_own_points(s, bodies), bodies, strict=True):
        s.body("ObjectMassPoint", node, mass=one.mass)
        marker = s.marker("MarkerNodePosition", nodeNumber=node)
        push = (one.mass * one.place).tolist()

        def law(mbs: Any, t: float, load: Any, push: Any = push) -> Any:
            return push

        loads.append(s.mbs.AddLoad(items.Force(markerNumber=marker, loadVectorUserFunction=law)))
        later.append(s.mbs.AddLoad(items.Force(markerNumber=marker)))
        changed.append(s.mbs.AddLoad(items.Force(markerNumber=marker)))
        s.mbs.SetLoadParameter(later[-1], "loadVector", push)
        s.mbs.ModifyLoad(changed[-1], _seen(s.mbs.GetLoad(changed[-1])) | {"loadVector": push})
    sensors = [s.sensor("SensorLoad", loadNumber=load) for load in loads]
    s.mbs.Assemble()
    masses = np.array([one.mass for one in bodies])[:, None]
    for call, values in (
        (("MainSystem.GetLoadValues",), [s.mbs.GetLoadValues(load) for load in loads]),
        (_call("SensorLoad"), [s.mbs.GetSensorValues(sensor) for sensor in sensors]),
        (("MainSystem.SetLoadParameter",), [s.mbs.GetLoadValues(load) for load in later]),
        (("MainSystem.ModifyLoad",), [s.mbs.GetLoadValues(load) for load in changed]),
        (("MainSystem.GetLoadParameter",), [s.mbs.GetLoadParameter(load, "loadVector") for load in later]),
    ):
        s.add("body_position", call, np.array(values) / masses)


def _add_parameters(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    """Markers at probe points that they are set to later, and sensors that read others later."""
    made = []
    for body, one in zip(_rigid_bodies(s, bodies), bodies, strict=True):
        first, second = (s.marker("MarkerBodyRigid", bodyNumber=body) for _ in range(2))
        s.mbs.SetMarkerParameter(first, "localPosition", one.arm)
        s.mbs.ModifyMarker(second, _seen(s.mbs.GetMarker(second)) | {"localPosition": one.arm})
        velocity = s.sensor("SensorMarker", markerNumber=first, outputVariableType=Output.Velocity)
        third, fourth = (
            s.sensor("SensorMarker", markerNumber=first, outputVariableType=Output.Velocity) for _ in range(2)
        )
        s.mbs.SetSensorParameter(third, "outputVariableType", Output.Position)
        s.mbs.ModifySensor(fourth, _seen(s.mbs.GetSensor(fourth)) | {"outputVariableType": Output.Position})
        made.append((body, first, second, velocity, third, fourth))
    s.mbs.Assemble()
    body, first, second, velocity, third, fourth = zip(*made, strict=True)
    position = Output.Position
    for name, values in (
        ("SetMarkerParameter", [s.mbs.GetMarkerOutput(one, position) for one in first]),
        ("ModifyMarker", [s.mbs.GetMarkerOutput(one, position) for one in second]),
        ("SetSensorParameter", [s.mbs.GetSensorValues(one) for one in third]),
        ("ModifySensor", [s.mbs.GetSensorValues(one) for one in fourth]),
        ("GetMarkerParameter", [
            s.of_body(one, "Position", s.mbs.GetMarkerParameter(marker, "localPosition"))
            for one, marker in zip(body, first, strict=True)
        ]),
        ("GetSensorParameter", [
            s.mbs.GetMarkerOutput(s.mbs.GetSensorParameter(one, "markerNumber"), position) for one in velocity
        ]),
    ):  # fmt: skip
        s.add("frame_position", (f"MainSystem.{name}",), np.array(values))
    nodes = [s.mbs.GetObjectParameter(one, "nodeNumber") for one in body]
    places = [s.mbs.GetNodeParameter(node, "referenceCoordinates")[:3] for node in nodes]
    s.add("body_position", ("MainSystem.GetNodeParameter",), places)


def _add_algebraic_coordinates(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    count = 3 * len(bodies)
    node = s.node("NodeGenericAE", numberOfAECoordinates=count, referenceCoordinates=[0.0] * count,
                  initialCoordinates=[0.0] * count)  # fmt: skip
    s.mbs.Assemble()
    places = np.array([one.place for one in bodies])
    s.mbs.systemData.SetAECoordinates(places.ravel())
    found = np.array(s.mbs.GetNodeOutput(node, Output.Coordinates)).reshape(-1, 3)
    s.add("body_position", (*_call("NodeGenericAE"), "SystemData.SetAECoordinates"), found)


def _add_linear_systems(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    """A system 2 q̈ + 2 K q = 0 with K of places, half of it by functions: its Jacobian and eigenvalues."""
    places = np.array([one.place for one in bodies])
    sizes = np.abs(places).ravel()
    node = s.node("NodeGenericODE2", numberOfODE2Coordinates=len(sizes), referenceCoordinates=0 * sizes,
                  initialCoordinates=0 * sizes, initialCoordinates_t=0 * sizes)  # fmt: skip
    K = np.diag(sizes)
    s.object(
        "ObjectGenericODE2", nodeNumbers=[node], massMatrix=2 * np.eye(len(sizes)), stiffnessMatrix=K,
        forceUserFunction=lambda mbs, t, item, q, rates: (-sizes * q).tolist(),
        jacobianUserFunction=lambda mbs, t, item, q, rates, of_q, of_rates: of_q * K,
    )  # fmt: skip
    s.mbs.Assemble()
    solver: Any = exudyn.MainSolverImplicitSecondOrder()
    with initialized_solver(solver, s.mbs, make_settings()):
        solver.SetSystemJacobian(0 * K)
        solver.ComputeJacobianODE2RHS(s.mbs, scalarFactor_ODE2=-1.0, scalarFactor_ODE2_t=0.0)
        jacobian = np.array(solver.GetSystemJacobian())
    call = *_call("ObjectGenericODE2JacobianUserFunction"), f"{IMPLICIT}.ComputeJacobianODE2RHS"
    s.add("body_position", call, (np.sign(places.ravel()) * np.diag(jacobian) / 2).reshape(-1, 3))
    order, found = np.argsort(sizes, kind="stable"), np.zeros(len(sizes))
    module: Any = exudyn
    name = "ComputeODE2Eigenvalues"
    for owner, function in (("", partial(module.ComputeODE2Eigenvalues, s.mbs)),
                            ("MainSystem.", s.mbs.ComputeODE2Eigenvalues)):  # fmt: skip
        found[order] = np.sort(function()[0])
        s.add("body_position", (f"{owner}{name}",), np.sign(places) * found.reshape(-1, 3))


def _add_equations(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    """The solver's residual of constraints that hold the bodies in the origin."""
    fixed, joints = s.ground(), []
    for body in _rigid_bodies(s, bodies):
        marker = s.marker("MarkerBodyPosition", bodyNumber=body)
        joints.append(s.object("ObjectJointSpherical", fixed, marker, constrainedAxes=[1, 1, 1]))
    s.mbs.Assemble()
    solver: Any = exudyn.MainSolverImplicitSecondOrder()
    settings, data = make_settings(), s.mbs.systemData
    settings.timeIntegration.generalizedAlpha.computeInitialAccelerations = False

    with initialized_solver(solver, s.mbs, settings):
        for quantity, is_velocity in (("body_position", False), ("body_velocity", True)):
            solver.ComputeAlgebraicEquations(s.mbs, is_velocity)
            own = np.array(solver.GetSystemResidual())[solver.GetODE2size() :]
            found = [own[np.array(data.GetObjectLTGAE(joint))] for joint in joints]
            s.add(quantity, (f"{IMPLICIT}.ComputeAlgebraicEquations",), found)


def _plucker_inertia(one: Body) -> Array:
    """The inertia about the probe point as a 6 × 6 matrix, angular part first."""
    cross = np.cross(AXES, one.arm).T * one.mass
    return np.block([[one.inertia + cross @ cross.T / one.mass, cross], [cross.T, one.mass * AXES]])


def _shapes(one: Body) -> dict[str, tuple[Any, Array]]:
    """Shapes about as large as a body, and their inertias by textbooks."""
    size = float(np.sqrt(np.trace(one.inertia) / (2 * one.mass)))
    m, a = (one.mass, size) if size > 0 else (0.0, 1.0)  # points have shapes without mass
    make, inner, outer = utilities, 0.5 * a, 1.5 * a
    volume = 2 * a * np.pi * (outer**2 - inner**2)
    along, across = (outer**2 + inner**2) / 2, (outer**2 + inner**2) / 4 + a**2 / 3
    point = a * np.array([0.6, -0.5, 0.7])
    cylinders = [
        make.InertiaCylinder(m / (3 * volume), 2 * a, outer, axis, inner).inertiaTensor for axis in range(3)
    ]
    return {
        "InertiaCuboid": (
            make.InertiaCuboid(m / (6 * a**3), [a, 2 * a, 3 * a]).inertiaTensor,
            m * a**2 / 12 * np.diag([13.0, 10.0, 5.0]),
        ),
        "InertiaRodX": (make.InertiaRodX(m, a).inertiaTensor, m * a**2 / 12 * np.diag([0.0, 1.0, 1.0])),
        "InertiaSphere": (make.InertiaSphere(m, a).inertiaTensor, 0.4 * m * a**2 * AXES),
        "InertiaHollowSphere": (make.InertiaHollowSphere(m, a).inertiaTensor, 2 / 3 * m * a**2 * AXES),
        "InertiaCylinder": (sum(cylinders), m * (along + 2 * across) / 3 * AXES),
        "InertiaMassPoint": (
            make.InertiaMassPoint(m).Translated(point).inertiaTensor,
            m * (point @ point * AXES - np.outer(point, point)),
        ),
    }


def _add_inertias(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    """The momentum about the centre of mass with inertias that functions return, or shapes change."""
    masses = np.array([one.mass for one in bodies])
    centre = masses @ np.array([one.place for one in bodies]) / np.sum(masses)

    def add(name: str, inertias: Sequence[Array]) -> None:
        total = sum(
            np.cross(one.place - centre, one.mass * one.velocity) + one.turn @ J @ one.turn.T @ one.spin
            for one, J in zip(bodies, inertias, strict=True)
        )
        s.add("centroidal_angular_momentum", (name,), total)

    given = [one.inertia[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]] for one in bodies]
    add("rigidBodyUtilities.Inertia6D2InertiaTensor", [utilities.Inertia6D2InertiaTensor(x) for x in given])
    apart = [trees.Inertia66toMassCOMinertia(_plucker_inertia(one)) for one in bodies]
    add("kinematicTree.Inertia66toMassCOMinertia", [J for _, _, J in apart])
    shapes = [_shapes(one) for one in bodies]
    for name in shapes[0]:
        pairs = [own[name] for own in shapes]
        own = [one.inertia + (J - true) for one, (J, true) in zip(bodies, pairs, strict=True)]
        add(f"rigidBodyUtilities.{name}", own)


def _pose(turn: Array, place: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, place
    return pose


def _add_robots(s: _Items, bodies: Sequence[Body], anchor: Array) -> None:
    """Robots of one link on a base at the anchor, with the probe frame as their tool."""
    base, angle, poses = _pose(rotation_matrix(PROBE_ATTITUDE), anchor), 0.4, []
    turned = _pose(_turn_about([0.0, 0.0, -angle])[2], np.zeros(3))
    for one in bodies:
        robot = robots.Robot(
            base=robots.RobotBase(HT=base),
            tool=robots.RobotTool(HT=_pose(rotation_matrix(PROBE_ATTITUDE), one.arm)),
        )
        before = np.linalg.inv(base) @ _pose(one.turn, one.place) @ turned
        robot.AddLink(robots.RobotLink(one.mass, [0.0] * 3, AXES, jointType="Rz", preHT=before))
        poses.append(np.array(robot.JointHT([angle])[0]) @ np.array(robot.GetToolHT()))
    call, found = ("robotics.RobotBase", "robotics.RobotTool"), np.array(poses)
    s.add("frame_position", call, found[:, :3, 3])
    s.add_axes(call, found[:, :3, :3])


PARTS: Sequence[Callable[..., None]] = (
    _add_points("NodePoint", "ObjectMassPoint"), _add_points("Point", "MassPoint"), _add_created_points,
    _add_plane_points("NodePoint2D", "ObjectMassPoint2D"), _add_plane_points("Point2D", "MassPoint2D"),
    _add_lines("ObjectMass1D"), _add_lines("Mass1D"),
    _add_rotors("ObjectRotationalMass1D"), _add_rotors("Rotor1D"),
    _add_plane_bodies(
        "NodeRigidBody2D", "ObjectRigidBody2D", "ObjectJointRevolute2D", "ObjectJointPrismatic2D"
    ),
    _add_plane_bodies("Rigid2D", "RigidBody2D", "RevoluteJoint2D", "PrismaticJoint2D"),
    _add_coordinate_constraints, _add_vector_constraints, _add_relative_markers, _add_connectors, _add_loads,
    _add_parameters, _add_algebraic_coordinates, _add_linear_systems, _add_equations,
    _add_inertias, _add_robots,
)  # fmt: skip
