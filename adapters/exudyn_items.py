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
    IMPLICIT,
    Output,
    change_item,
    coordinate_marker,
    grounded_marker,
    initialized_solver,
    items,
    items_argument,
    make_evaluation_settings,
    make_rigid_body,
    make_settings,
    make_system,
    of_module_and_system,
    sizes_of_body,
    texts,
)
from adapters.pose_functions import Pose, about, homogeneous, turned
from adapters.surface_record import SurfaceRecord
from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array, Float, Model, State
from plumbline.model.kinematics import (
    quaternion_exponential,
    quaternion_rate,
    rotate_vectors,
    rotation_matrix,
)
from plumbline.model.probe_frames import PROBE_TURN, anchor_point, probe_points

AXES = np.eye(3)
utilities: Any = rigidBodyUtilities  # as below, functions are untyped
trees: Any = kinematicTree
robots: Any = robotics
SPACE, PLANES, LINES = [[0, 1, 2]], [[1, 2], [2, 0], [0, 1]], [[0], [1], [2]]  # coordinates of parts
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
    fields = state.r, state.v, turns, spins, arms, model.mass, state.p, model.inertia
    return [Body(*one) for one in zip(*fields, strict=True)]


class _Items(SurfaceRecord):
    """A system to which a part adds items for the bodies, and the rows that it finds."""

    def __init__(self, found: Any, bodies: Sequence[Body], anchor: Array) -> None:
        super().__init__()
        self.found, self.bodies, self.anchor = found, bodies, anchor
        self.masses = np.array([[one.mass] for one in bodies])
        self.places = np.array([one.place for one in bodies])
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

    def point_nodes(self) -> list[Any]:
        """Nodes that have the bodies' places as coordinates."""
        given = [{"initialCoordinates": one.place, "initialVelocities": one.velocity} for one in self.bodies]
        return [self.node("NodePoint", **own) for own in given]

    def rigid_bodies(self) -> list[Any]:
        """Bodies of unit inertia where the bodies are."""
        made = []
        for one in self.bodies:
            given = {"referenceCoordinates": [*one.place, *one.attitude]}
            rates = quaternion_rate(one.attitude, one.turn.T @ one.spin)
            node = self.node("NodeRigidBodyEP", initialVelocities=[*one.velocity, *rates], **given)
            made.append(self.mbs.AddObject(make_rigid_body(node, one.mass, AXES)))
        return made

    def of_body(self, body: Any, output: str, point: Sequence[float] = (0.0, 0.0, 0.0)) -> Array:
        return np.array(self.mbs.GetObjectOutputBody(body, getattr(Output, output), list(point)))

    def of_objects(self, objects: Sequence[Any], output: str) -> Array:
        return np.array([self.mbs.GetObjectOutput(item, getattr(Output, output)) for item in objects])

    def sensed(self, sensors: Sequence[Any]) -> Array:
        return np.array([self.mbs.GetSensorValues(sensor) for sensor in sensors])

    def jacobians(self, constraints: Sequence[Any]) -> Array:
        """Those of constraints, times the velocities of their coordinates."""
        what, data = exudyn.ComputeItemType.ConstraintJacobian, self.mbs.systemData
        rates = np.array(data.GetODE2Coordinates_t())
        columns = [rates[np.array(data.GetObjectLTGODE2(item))] for item in constraints]
        pairs = zip(constraints, columns, strict=True)
        return np.array([np.array(self.mbs.ComputeItem(item, what)) @ own for item, own in pairs])

    def equations(self, constraints: Sequence[Any]) -> Array:
        """What constraints want to be zero."""
        what = exudyn.ComputeItemType.AlgebraicEquations
        return np.array([self.mbs.ComputeItem(item, what) for item in constraints])

    def momenta(self, bodies: Sequence[Any]) -> list[Array]:
        """The system's mass matrix times its velocities, of bodies."""
        solver: Any = exudyn.MainSolverStatic()
        with initialized_solver(solver, self.mbs, make_settings()):
            solver.ComputeMassMatrix(self.mbs)  # ComputeItem fails at mass points
            M = np.array(solver.GetSystemMassMatrix())
        data = self.mbs.systemData
        momenta = M @ np.array(data.GetODE2Coordinates_t())
        return [momenta[np.array(data.GetObjectLTGODE2(body))] for body in bodies]


def add_item_answers(record: SurfaceRecord, model: Model, state: State) -> None:
    """Add what all items say of the bodies of a state."""
    bodies, anchor = bodies_at(model, state), anchor_point(model)
    add_parts(record.found, *(partial(part, _Items(record.found, bodies, anchor)) for part in PARTS))


def _gathered(values: Sequence[Array] | Array, rows: Sequence[Sequence[int]]) -> Array:
    """Vectors of bodies by values of parts, which have these coordinates each: their mean."""
    total = np.zeros((len(values) // len(rows), 3))
    for i, value in enumerate(values):
        own = rows[i % len(rows)]
        total[i // len(rows), own] += value[: len(own)]
    return total / (sum(map(len, rows)) / 3)


def _add_points(node_kind: str, body_kind: str, rows: Sequence[Sequence[int]], s: _Items) -> None:
    """Mass points of some coordinates each, of which half is the reference."""
    nodes, points = [], []
    for one in s.bodies:
        for own in rows:
            half = (one.place[own] / 2).tolist()
            given = {"referenceCoordinates": half, "initialCoordinates": half}
            nodes.append(s.node(node_kind, initialVelocities=one.velocity[own].tolist(), **given))
            along = {"referenceRotation": _to_x(own[0])} if rows is LINES else {}
            points.append(s.body(body_kind, nodes[-1], mass=one.mass, **along))
    s.mbs.Assemble()
    call = texts(ITEM, node_kind, body_kind)
    for quantity, output in (("body_position", "Position"), ("body_velocity", "Velocity")):
        values = np.array([s.of_body(point, output) for point in points])
        in_space = np.sum(values.reshape(-1, len(rows), 3), axis=1)  # of lines, which have directions
        s.add(quantity, call, _gathered(values, rows) if rows is PLANES else in_space)
    s.add("body_velocity", f"{call} {MASS}", _gathered(s.momenta(points), rows) / s.masses)
    if rows is SPACE:
        for output in ("Displacement", "Coordinates"):
            halves = [s.mbs.GetNodeOutput(node, getattr(Output, output)) for node in nodes]
            call = f"{ITEM}.{node_kind} OutputVariableType.{output}"
            s.add("body_position", call, 2 * np.array(halves))


def _add_created_points(s: _Items) -> None:
    create, points = s.mbs.CreateMassPoint, []
    for one in s.bodies:
        given = {"referencePosition": one.place, "initialVelocity": one.velocity}
        points.append(create(**given, **sizes_of_body(mass=one.mass)))
    # before 1.10 with the node
    points = [point[-1] if isinstance(point, list) else point for point in points]
    s.mbs.Assemble()
    call = "MainSystem.CreateMassPoint"
    s.add("body_position", call, [s.of_body(point, "Position") for point in points])
    s.add("body_velocity", call, np.array(s.momenta(points)) / s.masses)


def _add_started_bodies(s: _Items) -> None:
    """Bodies that start elsewhere than at their reference, by half of their places and by a turn."""
    first, then = (rotation_matrix(quaternion_exponential(0.3 * axis)) for axis in AXES[:2])
    call, bodies, attitude = "MainSystem.CreateRigidBody", [], first @ then
    for one in s.bodies:
        # lists, as 1.7 and 1.8 ask whether these are None by !=
        given = {"referencePosition": one.place / 2, "initialDisplacement": (one.place / 2).tolist()}
        given |= {"referenceRotationMatrix": first, "initialRotationMatrix": then.tolist()}
        given |= {"initialVelocity": one.velocity, "initialAngularVelocity": one.spin}
        inertia = utilities.RigidBodyInertia(one.mass, AXES)
        bodies.append(s.mbs.CreateRigidBody(**given, inertia=inertia))
    s.mbs.Assemble()
    s.add("body_position", call, [s.of_body(body, "Position") for body in bodies])
    turns = [s.of_body(body, "RotationMatrix").reshape(3, 3) @ attitude.T for body in bodies]
    s.add_axes(call, [turn @ one.turn @ PROBE_TURN for turn, one in zip(turns, s.bodies, strict=True)])
    spins = [s.of_body(body, "AngularVelocity") for body in bodies]
    s.add("frame_angular_velocity_from_start", call, spins)


def _to_x(axis: int) -> Array:
    """A turn that has a coordinate axis as its first column."""
    return np.roll(AXES, -axis, axis=1)


def _angles(one: Body) -> Array:
    return np.asarray(Pose(one.place, one.attitude).forms["xyz"])


def _add_rotors(body_kind: str, s: _Items) -> None:
    """A rotor about each axis: attitudes are their turns in a row, spins their sum."""
    inertia, rotors = 0.5, []
    frames = [np.roll(_to_x(axis), 2, axis=1) for axis in range(3)]  # whose third column is the axis
    for one in s.bodies:
        for frame, angle, rate in zip(frames, _angles(one), one.spin, strict=True):
            given = {"initialCoordinates": [float(angle)], "initialVelocities": [float(rate)]}
            node = s.node("Node1D", **given)
            rotors.append(s.body(body_kind, node, inertia=inertia, referenceRotation=frame))
    s.mbs.Assemble()
    call = texts(ITEM, "Node1D", body_kind)
    turns = np.reshape([s.of_body(rotor, "RotationMatrix") for rotor in rotors], (-1, 3, 3, 3))
    s.add_axes(call, [x @ y @ z @ PROBE_TURN for x, y, z in turns @ np.array(frames).swapaxes(-1, -2)])
    spins = np.reshape([s.of_body(rotor, "AngularVelocity") for rotor in rotors], (-1, 3, 3))
    s.add("frame_angular_velocity", call, np.sum(spins, axis=1))
    s.add("frame_angular_velocity", f"{call} {MASS}", _gathered(s.momenta(rotors), LINES) / inertia)


def _add_plane_bodies(node_kind: str, body_kind: str, turning: str, sliding: str, s: _Items) -> None:
    """Bodies in the three planes, at half of each velocity, with joints that would hold probe points."""
    inertia, bodies, points, joints = 0.5, [], [], []
    for one in s.bodies:
        reach = one.turn @ one.arm
        for angle, spin, plane in zip(_angles(one).tolist(), one.spin.tolist(), PLANES, strict=True):
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            node = s.node(
                node_kind, initialCoordinates=[*one.place[plane], angle],
                initialVelocities=[*one.velocity[plane] / 2, spin],
            )  # fmt: skip
            bodies.append(s.body(body_kind, node, inertia=inertia, mass=one.mass))
            points.append([*(turn.T @ reach[plane]), 0.0])
            here = s.marker("MarkerBodyRigid", bodyNumber=bodies[-1], localPosition=points[-1])
            there = s.ground([*(one.place + reach)[plane], 0.0])
            joints.append(s.object(turning, there, here))
            for along, across in (([0, 1.0, 0], turn[0]), ([1.0, 0, 0], turn[1])):
                axes = {"axisMarker0": along, "normalMarker1": [*across, 0.0]}
                joints.append(s.object(sliding, there, here, **axes))
    s.mbs.Assemble()

    def read(output: str) -> list[Array]:
        return [s.of_body(body, output, point) for body, point in zip(bodies, points, strict=True)]

    call, by = texts(ITEM, node_kind, body_kind), "MainSystem.ComputeItem"
    turns, momenta = np.tile(AXES, (len(bodies), 1, 1)), s.momenta(bodies)
    for i, turn in enumerate(read("RotationMatrix")):
        turns[i][np.ix_(PLANES[i % 3], PLANES[i % 3])] = turn.reshape(3, 3)[:2, :2]
    s.add_axes(call, [x @ y @ z @ PROBE_TURN for x, y, z in turns.reshape(-1, 3, 3, 3)])
    s.add("frame_position", call, _gathered(read("Position"), PLANES))
    s.add("frame_velocity", call, 2 * _gathered(read("Velocity"), PLANES))
    spins = [spin[2] for spin in read("AngularVelocity")]
    s.add("frame_angular_velocity", call, np.reshape(spins, (-1, 3)))
    s.add("body_velocity", f"{call} {MASS}", 2 * _gathered(momenta, PLANES) / s.masses)
    spun = np.reshape([momentum[2] for momentum in momenta], (-1, 3))
    s.add("frame_angular_velocity", f"{call} {MASS}", spun / inertia)
    held, first, second = np.reshape(s.jacobians(joints), (-1, 3, 2)).swapaxes(0, 1)
    s.add("frame_velocity", f"{ITEM}.{turning} {by}", 2 * _gathered(held, PLANES))
    slid = np.stack([first[:, 0], second[:, 0]], axis=1)
    s.add("frame_velocity", f"{ITEM}.{sliding} {by}", 2 * _gathered(slid, PLANES))
    turned = np.reshape(first[:, 1] - second[:, 1], (-1, 3)) / 2
    s.add("frame_angular_velocity", f"{ITEM}.{sliding} {by}", turned)


def _add_coordinate_constraints(s: _Items) -> None:
    """Constraints of single coordinates, whose equations and Jacobians say places and velocities.

    Half of each coordinate and of each velocity is the constraint's offset.
    """
    fixed, nodes = grounded_marker(s.mbs), s.point_nodes()
    points = [s.body("ObjectMassPoint", node, mass=1.0) for node in nodes]
    long, short = "ObjectConnectorCoordinate", "CoordinateConstraint"
    what, by_user = "OutputVariableType.ConstraintEquation", f"{long}OffsetUserFunction"
    create, made = exudyn.MainSystem.CreateCoordinateConstraint, dict[str, list[Any]]()
    for node, point, one in zip(nodes, points, s.bodies, strict=True):
        halves = zip((one.place / 2).tolist(), (one.velocity / 2).tolist(), strict=True)
        for i, (place, velocity) in enumerate(halves):
            marker = coordinate_marker(s.mbs, node, i)
            by_place = {"offsetUserFunction": lambda *_, x=place: x}
            by_velocity = {"velocityLevel": True, "offsetUserFunction_t": lambda *_, x=velocity: x}
            for call, kind, given in (
                (f"{ITEM}.{long} {what}", long, {"factorValue1": 2.0}),
                (f"{ITEM}.{short} {what}", short, {}),
                (f"{ITEM}.{by_user}", short, by_place),
                (f"{ITEM}.{by_user}_t", short, by_velocity),
            ):
                made.setdefault(call, []).append(s.object(kind, fixed, marker, **given))
            ends = items_argument(create, [None, point])
            joint = create(s.mbs, coordinates=[None, i], offset=place, **ends)
            made.setdefault("MainSystem.CreateCoordinateConstraint", []).append(joint)
    s.mbs.Assemble()
    for (call, joints), factor in zip(made.items(), (0.5, 1.0, 2.0, 2.0, 2.0), strict=True):
        quantity = "body_velocity" if call.endswith("_t") else "body_position"
        s.add(quantity, call, factor * s.of_objects(joints, "ConstraintEquation").reshape(-1, 3))
    rates = s.jacobians(made[f"{ITEM}.{short} {what}"]).reshape(-1, 3)
    s.add("body_velocity", f"{ITEM}.{short} MainSystem.ComputeItem", rates)


def _add_vector_constraints(s: _Items) -> None:
    """Constraints of all coordinates of a node or a body."""
    fixed = s.marker("MarkerNodeCoordinates", nodeNumber=s.node("NodePointGround"))
    nodes = s.point_nodes()
    points = [s.body("ObjectMassPoint", node, mass=1.0) for node in nodes]
    of_nodes = [s.marker("MarkerNodeCoordinates", nodeNumber=node) for node in nodes]
    of_bodies = [s.marker("MarkerObjectODE2Coordinates", objectNumber=point) for point in points]
    own = {"scalingMarker1": 2 * AXES}
    law = {
        "scalingMarker0": np.zeros((3, 1)),
        "constraintUserFunction": lambda mbs, t, item, q, *_: 2 * np.array(q)[-3:],
        "jacobianUserFunction": lambda *_: 2 * AXES,
    }
    long, short = "ObjectConnectorCoordinateVector", "CoordinateVectorConstraint"
    joints = {
        call: [s.object(kind, fixed, marker, **given) for marker in markers]
        for call, kind, markers, given in (
            (texts(ITEM, long, "MarkerNodeCoordinates"), long, of_nodes, own),
            (texts(ITEM, short, "MarkerObjectODE2Coordinates"), short, of_bodies, own),
            (texts(ITEM, f"{long}ConstraintUserFunction {long}JacobianUserFunction"), long, of_nodes, law),
        )
    }
    s.mbs.Assemble()
    for call, own_joints in joints.items():
        s.add("body_position", call, s.equations(own_joints) / 2)
        s.add("body_velocity", call, s.jacobians(own_joints) / 2)


def _add_relative_markers(s: _Items) -> None:
    """Markers of one coordinate of a body or between two, read by connectors."""
    ground, fixed = s.mbs.CreateGround(referencePosition=s.anchor), grounded_marker(s.mbs)
    between, made = "MarkerBodiesRelative", dict[str, list[Any]]()
    for body, one in zip(s.rigid_bodies(), s.bodies, strict=True):
        ends = {"bodyNumbers": [ground, body], "localPosition1": one.arm}
        node = s.mbs.GetObject(body)["nodeNumber"]
        for axis in range(3):
            for kind, given in (
                (f"{between}TranslationCoordinate", {"axis0": AXES[axis], **ends}),
                (f"{between}RotationCoordinate", {"axis0": AXES[axis], **ends}),
                ("MarkerNodeRotationCoordinate", {"nodeNumber": node, "rotationCoordinate": axis}),
            ):
                marker = s.marker(kind, **given)
                connector = s.object("CoordinateSpringDamper", fixed, marker, stiffness=2.0)
                made.setdefault(kind, []).append(connector)
    s.mbs.Assemble()
    for kind, connectors in made.items():
        call, is_shift = f"{ITEM}.{kind}", "Translation" in kind
        call += " MainSystem.CreateGround" * is_shift
        place, rate = (
            s.of_objects(connectors, output).reshape(-1, 3) for output in ("Displacement", "Velocity")
        )
        s.add("frame_velocity" if is_shift else "frame_angular_velocity", call, rate)
        if is_shift:
            s.add("frame_position_from_anchor", f"{call} OutputVariableType.Displacement", place)
        elif not kind.startswith(between):
            turns = np.array([turned(angles) @ PROBE_TURN for angles in place])
            s.add("frame_axes_by_angles", call, np.reshape(turns.swapaxes(-1, -2), (-1, 3)))


def _add_connectors(s: _Items) -> None:
    """Connectors and joints between the anchor and probe points, and what they say of the distance."""
    turn, shift, fixed = PROBE_TURN, s.anchor / 2, s.ground(s.anchor)
    damping, made = 3 * np.eye(6), []
    for body, one in zip(s.rigid_bodies(), s.bodies, strict=True):
        ends = fixed, s.marker("MarkerBodyRigid", bodyNumber=body, localPosition=one.arm)
        made.append((
            s.object("ObjectConnectorCartesianSpringDamper", *ends, stiffness=[2.0] * 3),
            s.object("ObjectConnectorDistance", *ends, distance=1.0),
            s.object("ObjectConnectorRigidBodySpringDamper", *ends, rotationMarker0=turn, damping=damping),
            s.object("ObjectJointGeneric", *ends, rotationMarker0=turn,
                     offsetUserFunction=lambda *_: [*shift, 0.0, 0.0, 0.0]),
        ))  # fmt: skip
    spring, rod, six, joint = zip(*made, strict=True)
    forces, distances = (
        [s.sensor("SensorObject", objectNumber=x, outputVariableType=output) for x in own]
        for own, output in ((spring, Output.Force), (rod, Output.Distance))
    )
    s.mbs.Assemble()
    away, what = "frame_position_from_anchor", "OutputVariableType."
    s.add(away, f"itemInterface.SensorObject {what}Force", s.sensed(forces) / 2)
    s.add("frame_distance", f"itemInterface.SensorObject {what}Distance", s.sensed(distances).reshape(-1, 1))
    for quantity, output, size in (
        (away, "DisplacementLocal", 1),
        ("frame_velocity", "ForceLocal", 3),
        ("frame_angular_velocity", "TorqueLocal", 3),
    ):
        s.add(quantity, f"{what}{output}", s.of_objects(six, output) @ turn.T / size)
    energies = s.of_objects(spring, "PotentialEnergy")  # of a stiffness of 2 N/m
    s.add("frame_distance", f"{what}PotentialEnergy", np.sqrt(energies)[:, None])
    poses = s.of_objects(six, "HomogeneousTransformationLocal").reshape(-1, 4, 4)
    s.add(away, f"{what}HomogeneousTransformationLocal", poses[:, :3, 3] @ turn.T)
    s.add_axes(f"{what}HomogeneousTransformationLocal", turn @ poses[:, :3, :3] @ turn)
    s.add(away, "itemInterface.ObjectJointGenericOffsetUserFunction", s.equations(joint)[:, :3] + shift)


def _add_loads(s: _Items) -> None:
    """Loads of mass times place, by sensors and functions, and with parameters that are set later."""
    mbs, made = s.mbs, []
    for node, one in zip(s.point_nodes(), s.bodies, strict=True):
        s.body("ObjectMassPoint", node, mass=one.mass)
        marker = s.marker("MarkerNodePosition", nodeNumber=node)
        push = (one.mass * one.place).tolist()
        law = {"loadVectorUserFunction": lambda *_, push=push: push}
        made.append([mbs.AddLoad(items.Force(markerNumber=marker, **given)) for given in (law, {}, {})])
        for load, modifies in zip(made[-1][1:], (False, True), strict=True):
            change_item(mbs, "Load", load, modifies, loadVector=push)
    loads, later, changed = zip(*made, strict=True)
    sensors = [s.sensor("SensorLoad", loadNumber=load) for load in loads]
    mbs.Assemble()
    for call, values in (
        ("MainSystem.GetLoadValues", [mbs.GetLoadValues(load) for load in loads]),
        ("itemInterface.SensorLoad", s.sensed(sensors)),
        ("MainSystem.SetLoadParameter", [mbs.GetLoadValues(load) for load in later]),
        ("MainSystem.ModifyLoad", [mbs.GetLoadValues(load) for load in changed]),
        ("MainSystem.GetLoadParameter", [mbs.GetLoadParameter(load, "loadVector") for load in later]),
    ):
        s.add("body_position", call, np.array(values) / s.masses)


def _add_parameters(s: _Items) -> None:
    """Markers at probe points that they are set to later, and sensors that read others later."""
    mbs, bodies, position = s.mbs, s.rigid_bodies(), Output.Position
    made = []
    for body, one in zip(bodies, s.bodies, strict=True):
        markers = [s.marker("MarkerBodyRigid", bodyNumber=body) for _ in range(2)]
        own = {"markerNumber": markers[0], "outputVariableType": Output.Velocity}
        velocity, *sensors = (s.sensor("SensorMarker", **own) for _ in range(3))
        for marker, sensor, modifies in zip(markers, sensors, (False, True), strict=True):
            change_item(mbs, "Marker", marker, modifies, localPosition=one.arm)
            change_item(mbs, "Sensor", sensor, modifies, outputVariableType=position)
        made.append((*markers, velocity, *sensors))
    mbs.Assemble()
    firsts, seconds, velocities, thirds, fourths = zip(*made, strict=True)
    arms = [mbs.GetMarkerParameter(marker, "localPosition") for marker in firsts]
    read = [mbs.GetSensorParameter(velocity, "markerNumber") for velocity in velocities]
    for name, values in (
        ("SetMarkerParameter", [mbs.GetMarkerOutput(one, position) for one in firsts]),
        ("ModifyMarker", [mbs.GetMarkerOutput(one, position) for one in seconds]),
        ("SetSensorParameter", s.sensed(thirds)),
        ("ModifySensor", s.sensed(fourths)),
        ("GetMarkerParameter",
         [s.of_body(body, "Position", arm) for body, arm in zip(bodies, arms, strict=True)]),
        ("GetSensorParameter", [mbs.GetMarkerOutput(one, position) for one in read]),
    ):  # fmt: skip
        s.add("frame_position", f"MainSystem.{name}", values)
    nodes = [mbs.GetObjectParameter(one, "nodeNumber") for one in bodies]
    places = [mbs.GetNodeParameter(node, "referenceCoordinates")[:3] for node in nodes]
    s.add("body_position", "MainSystem.GetNodeParameter", places)


def _add_algebraic_coordinates(s: _Items) -> None:
    zeros = [0.0] * s.places.size
    node = s.node("NodeGenericAE", numberOfAECoordinates=len(zeros), referenceCoordinates=zeros,
                  initialCoordinates=zeros)  # fmt: skip
    s.mbs.Assemble()
    s.mbs.systemData.SetAECoordinates(s.places.ravel())
    found = np.array(s.mbs.GetNodeOutput(node, Output.Coordinates)).reshape(-1, 3)
    s.add("body_position", "itemInterface.NodeGenericAE SystemData.SetAECoordinates", found)


def _add_linear_systems(s: _Items) -> None:
    """A system 2 q̈ + 2 K q = 0 with K of places, half of it by functions: its Jacobian and eigenvalues."""
    sizes = np.abs(s.places).ravel()
    node = s.node("NodeGenericODE2", numberOfODE2Coordinates=len(sizes), referenceCoordinates=0 * sizes,
                  initialCoordinates=0 * sizes, initialCoordinates_t=0 * sizes)  # fmt: skip
    K = np.diag(sizes)
    s.object(
        "ObjectGenericODE2", nodeNumbers=[node], massMatrix=2 * np.eye(len(sizes)), stiffnessMatrix=K,
        forceUserFunction=lambda mbs, t, item, q, *_: (-sizes * q).tolist(),
        jacobianUserFunction=lambda mbs, t, item, q, rates, of_q, of_rates: of_q * K,
    )  # fmt: skip
    s.mbs.Assemble()
    solver: Any = exudyn.MainSolverImplicitSecondOrder()
    with initialized_solver(solver, s.mbs, make_settings()):
        solver.SetSystemJacobian(0 * K)
        solver.ComputeJacobianODE2RHS(s.mbs, scalarFactor_ODE2=-1.0, scalarFactor_ODE2_t=0.0)
        jacobian = np.array(solver.GetSystemJacobian())
    call = f"itemInterface.ObjectGenericODE2JacobianUserFunction {IMPLICIT}.ComputeJacobianODE2RHS"
    s.add("body_position", call, np.sign(s.places) * np.diag(jacobian).reshape(-1, 3) / 2)
    order, found = np.argsort(sizes, kind="stable"), np.zeros(len(sizes))
    for name, function in of_module_and_system(s.mbs, "ComputeODE2Eigenvalues").items():
        found[order] = np.sort(function()[0])
        s.add("body_position", name, np.sign(s.places) * found.reshape(-1, 3))


def _add_equations(s: _Items) -> None:
    """The solver's residual of constraints that hold the bodies in the origin."""
    fixed, joints = s.ground(), []
    for body in s.rigid_bodies():
        marker = s.marker("MarkerBodyPosition", bodyNumber=body)
        joints.append(s.object("ObjectJointSpherical", fixed, marker, constrainedAxes=[1, 1, 1]))
    s.mbs.Assemble()
    solver: Any = exudyn.MainSolverImplicitSecondOrder()
    data = s.mbs.systemData
    with initialized_solver(solver, s.mbs, make_evaluation_settings()):
        for quantity, is_velocity in (("body_position", False), ("body_velocity", True)):
            solver.ComputeAlgebraicEquations(s.mbs, is_velocity)
            own = np.array(solver.GetSystemResidual())[solver.GetODE2size() :]
            found = [own[np.array(data.GetObjectLTGAE(joint))] for joint in joints]
            s.add(quantity, f"{IMPLICIT}.ComputeAlgebraicEquations", found)


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


def _add_inertias(s: _Items) -> None:
    """The momentum about the centre of mass with inertias that functions return, or shapes change."""
    bodies, masses = s.bodies, s.masses.ravel()
    centre = masses @ s.places / np.sum(masses)

    def add(name: str, inertias: Sequence[Array]) -> None:
        total = sum(
            np.cross(one.place - centre, one.mass * one.velocity) + one.turn @ J @ one.turn.T @ one.spin
            for one, J in zip(bodies, inertias, strict=True)
        )
        s.add("centroidal_angular_momentum", name, total)

    given = [one.inertia[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]] for one in bodies]
    add("rigidBodyUtilities.Inertia6D2InertiaTensor", [utilities.Inertia6D2InertiaTensor(x) for x in given])
    apart = [trees.Inertia66toMassCOMinertia(_plucker_inertia(one)) for one in bodies]
    add("kinematicTree.Inertia66toMassCOMinertia", [J for _, _, J in apart])
    shapes = [_shapes(one) for one in bodies]
    for name in shapes[0]:
        pairs = [own[name] for own in shapes]
        own = [one.inertia + (J - true) for one, (J, true) in zip(bodies, pairs, strict=True)]
        add(f"rigidBodyUtilities.{name}", own)


def _add_robots(s: _Items) -> None:
    """Robots of one link on a base half way to the body, with the probe frame as their tool."""
    angle, poses = 0.4, []
    back = homogeneous(about(2, -angle), np.zeros(3))
    for one in s.bodies:
        base = homogeneous(
            PROBE_TURN, one.place / 2
        )  # no farther than the body, by whose size places are rounded
        tool = robots.RobotTool(HT=homogeneous(PROBE_TURN, one.arm))
        robot = robots.Robot(base=robots.RobotBase(HT=base), tool=tool)
        before = np.linalg.inv(base) @ homogeneous(one.turn, one.place) @ back
        robot.AddLink(robots.RobotLink(one.mass, [0.0] * 3, AXES, jointType="Rz", preHT=before))
        poses.append(np.array(robot.JointHT([angle])[0]) @ np.array(robot.GetToolHT()))
    call, found = "robotics.RobotBase robotics.RobotTool", np.array(poses)
    s.add("frame_position", call, found[:, :3, 3])
    s.add_axes(call, found[:, :3, :3])


PARTS: Sequence[Callable[[_Items], None]] = (
    partial(_add_points, "NodePoint", "ObjectMassPoint", SPACE),
    partial(_add_points, "Point", "MassPoint", SPACE),
    _add_created_points, _add_started_bodies,
    partial(_add_points, "NodePoint2D", "ObjectMassPoint2D", PLANES),
    partial(_add_points, "Point2D", "MassPoint2D", PLANES),
    partial(_add_points, "Node1D", "ObjectMass1D", LINES),
    partial(_add_points, "Node1D", "Mass1D", LINES),
    partial(_add_rotors, "ObjectRotationalMass1D"),
    partial(_add_rotors, "Rotor1D"),
    partial(_add_plane_bodies, "NodeRigidBody2D", "ObjectRigidBody2D",
            "ObjectJointRevolute2D", "ObjectJointPrismatic2D"),
    partial(_add_plane_bodies, "Rigid2D", "RigidBody2D", "RevoluteJoint2D", "PrismaticJoint2D"),
    _add_coordinate_constraints, _add_vector_constraints, _add_relative_markers, _add_connectors, _add_loads,
    _add_parameters, _add_algebraic_coordinates, _add_linear_systems, _add_equations,
    _add_inertias, _add_robots,
)  # fmt: skip
