"""What Exudyn reports of bodies in maximal coordinates besides the state quantities: outputs and sensors.

Outputs at a point of a body are in the world's axes or, "Local", in the body's, from where they are turned
here into those of the probe frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from importlib import import_module
from typing import Any, NamedTuple

import exudyn
import numpy as np
import scipy.linalg

from adapters.exudyn_common import Output, items, of_module_and_system
from adapters.exudyn_items import add_item_answers
from adapters.exudyn_points import add_point_answers
from adapters.pose_functions import turned
from adapters.surface_record import SurfaceRecord
from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array, Model, State
from plumbline.model.probe_frames import PROBE_TURN, probe_points

FACTORS = [0.5, 1.5]  # of a velocity in the world's axes and in the body's in a sum
FEW_BODIES = 3  # of mechanisms on which what does not depend on the mechanism is compared


def _in_probe_axes(values: Array) -> Array:
    return values @ PROBE_TURN


def _axes(values: Array) -> Array:
    return (values.reshape(-1, 3, 3) @ PROBE_TURN).swapaxes(-1, -2).reshape(-1, 3)


def _axes_of_angles(values: Array) -> Array:
    return _axes(np.array([turned(angles) for angles in values]))


def _axes_of_poses(values: Array) -> Array:
    return _axes(values.reshape(-1, 4, 4)[:, :3, :3])


def _place_of_poses(values: Array) -> Array:
    return values.reshape(-1, 4, 4)[:, :3, 3]


def pose_function(name: str, given: Sequence[Any], forms: Sequence[str]) -> Sequence[Any]:
    """Call a function of attitudes or poses."""
    module, _, last = name.rpartition(".")
    function = getattr(import_module(f"exudyn.{module}"), last)
    result = COMPLETED[last](function, *given) if last in COMPLETED else function(*given)
    return result if len(forms) > 1 and not forms[0].startswith("@") else [result]


def _screw(axis: int, angle: float, shift: float) -> Array:
    """The pose after a turn about a coordinate axis and a shift along it."""
    pose, (i, j) = np.eye(4), np.roll(range(3), -axis)[1:]
    pose[i, i] = pose[j, j] = np.cos(angle)
    pose[j, i] = np.sin(angle)
    pose[i, j] = -pose[j, i]
    pose[axis, 3] = shift
    return pose


def _about_first(axes: Array, R: Array) -> Array:
    """Axes of which only the first is given, turned about it to R."""
    rest = axes.T @ R
    return axes @ _screw(0, np.arctan2(rest[2, 1], rest[1, 1]), 0.0)[:3, :3]


# By function whose result is no attitude or pose of a body what makes one of it.
COMPLETED: Mapping[str, Callable[..., Any]] = {
    "HT0": lambda function, H: function() @ H,
    "RotationMatrix2D": lambda function, angle: scipy.linalg.block_diag(function(angle), 1.0),
    "ComputeOrthonormalBasis": lambda function, R: _about_first(function(2 * R[:, 0]), R),
    "ComputeOrthonormalBasisVectors": lambda function, R: _about_first(np.stack(function(2 * R[:, 0]), 1), R),
    "GramSchmidt": lambda function, R: np.stack(function(2 * R[:, 0], R[:, 0] + 3 * R[:, 1]), 1),
    "projectAngleToPMPi": lambda function, angle: function(angle + 2 * np.pi),
    # H by the inverse of a pose by Denavit-Hartenberg parameters, standard ones and those of Khalil and
    # Kleinfinger, of which the function returns two poses, and by the function's
    "StdDH2HT": lambda function, H, theta, d, a, alpha: (
        H @ _screw(0, -alpha, -a) @ _screw(2, -theta, -d) @ function([theta, d, a, alpha])
    ),
    "ModDHKK2HT": lambda function, H, alpha, d, theta, r: reduce(
        np.matmul, function([alpha, d, theta, r]), H @ _screw(2, -theta, -r) @ _screw(0, -alpha, -d)
    ),
}


class _Output(NamedTuple):
    """An output of bodies, at a point, and whether nodes and markers have it."""

    name: str
    quantity: str
    has_node: bool
    has_marker: bool
    read: Callable[[Array], Array] = np.asarray


def weighted_sum(
    mbs: Any, t: float, sensors: Sequence[Any], factors: Sequence[float], configuration: Any
) -> list[float]:
    """Add what sensors read, each times a factor."""
    values = [
        factor * np.array(mbs.GetSensorValues(sensor, configuration))
        for sensor, factor in zip(sensors, factors, strict=True)
    ]
    return [float(x) for x in np.sum(values, axis=0)]


OUTPUTS = [
    one
    for one in (
        _Output("Position", "frame_position", True, True),
        _Output("RotationMatrix", "frame_axes", True, True, _axes),
        _Output("Rotation", "frame_axes_by_angles", True, True, _axes_of_angles),
        _Output("Velocity", "frame_velocity", True, True),
        _Output("VelocityLocal", "frame_velocity_local", False, False, _in_probe_axes),
        _Output("AngularVelocity", "frame_angular_velocity", True, True),
        _Output("AngularVelocityLocal", "frame_angular_velocity_local", True, True, _in_probe_axes),
        _Output("Acceleration", "frame_acceleration", True, False),
        _Output("AccelerationLocal", "frame_acceleration_local", False, False, _in_probe_axes),
        _Output("AngularAcceleration", "frame_angular_acceleration", True, False),
        _Output("AngularAccelerationLocal", "frame_angular_acceleration_local", False, False, _in_probe_axes),
        _Output("HomogeneousTransformation", "frame_axes", True, True, _axes_of_poses),
        _Output("HomogeneousTransformation", "frame_position", True, True, _place_of_poses),
    )
    if hasattr(Output, one.name)  # not in older versions
]
# Of nodes, which are at centres of mass.
AT_CENTRE = {f"frame_{what}": f"body_{what}" for what in ("position", "velocity", "acceleration")}
OF_NODES = [
    one._replace(quantity=AT_CENTRE.get(one.quantity, one.quantity)) for one in OUTPUTS if one.has_node
]
OF_COORDINATES = {  # of nodes, whose first coordinates are those of the centre of mass
    "CoordinatesTotal": "body_position", "Coordinates_t": "body_velocity",
    "Coordinates_tt": "body_acceleration",
}  # fmt: skip


class Probes(SurfaceRecord):
    """Markers and sensors at the probe points of bodies; they are added before the system is assembled."""

    def __init__(self, mbs: Any, model: Model, bodies: Sequence[Any], nodes: Sequence[Any]) -> None:
        """Add them to the bodies of a system, each of one piece."""
        super().__init__()
        self.mbs, self.bodies, self.nodes = mbs, bodies, nodes
        probes = zip(bodies, [point.tolist() for point in probe_points(model)], strict=True)
        places = [{"bodyNumber": body, "localPosition": point} for body, point in probes]
        markers = [mbs.AddMarker(items.MarkerBodyRigid(**place)) for place in places]
        self.markers_of_centres = {
            "MarkerBodyPosition": [mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=x)) for x in bodies],
            "MarkerNodePosition": [mbs.AddMarker(items.MarkerNodePosition(nodeNumber=x)) for x in nodes],
            "MarkerNodeRigid": [mbs.AddMarker(items.MarkerNodeRigid(nodeNumber=x)) for x in nodes],
        }
        # By output of bodies, nodes and markers: function that reads it, kind of sensors, places and sensors.
        self.readers = list[tuple[_Output, str, str, Sequence[dict[str, Any]], list[Any]]]()
        silent = {"writeToFile": False, "storeInternal": False}
        for function, kind, outputs, given in (
            ("GetObjectOutputBody", "SensorBody", OUTPUTS, places),
            ("GetNodeOutput", "SensorNode", OF_NODES, [{"nodeNumber": node} for node in nodes]),
            ("GetMarkerOutput", "SensorMarker", [one for one in OUTPUTS if one.has_marker],
             [{"markerNumber": marker} for marker in markers]),
        ):  # fmt: skip
            for one in outputs:
                make = partial(getattr(items, kind), outputVariableType=getattr(Output, one.name), **silent)
                self.readers.append((one, function, kind, given, [mbs.AddSensor(make(**x)) for x in given]))
        law = {"factors": FACTORS, "sensorUserFunction": weighted_sum}
        own = {one.quantity: sensors for one, _, kind, _, sensors in self.readers if kind == "SensorBody"}
        self.sums = [
            mbs.AddSensor(items.SensorUserFunction(sensorNumbers=list(pair), **law, **silent))
            for pair in zip(own["frame_velocity"], own["frame_velocity_local"], strict=True)
        ]

    def add_all(self) -> None:
        """Read all at the current state."""
        mbs, data = self.mbs, self.mbs.systemData
        for one, function, kind, places, sensors in self.readers:
            read, output = getattr(mbs, function), getattr(Output, one.name)
            member = f"OutputVariableType.{one.name}"
            direct = [read(item, output, *point) for item, *point in (x.values() for x in places)]
            self.add(one.quantity, f"MainSystem.{function} {member}", one.read(np.array(direct)))
            sensed = np.array([mbs.GetSensorValues(sensor) for sensor in sensors])
            call = f"MainSystem.GetSensorValues itemInterface.{kind} {member}"
            self.add(one.quantity, call, one.read(sensed))
        add_parts(
            self.found,
            *(partial(self._add_coordinates, *one) for one in OF_COORDINATES.items()),
            self._add_sums,
            self._add_dictionary,
            self._add_configurations,
        )
        for kind, markers in self.markers_of_centres.items():
            for name, quantity in (("Position", "body_position"), ("Velocity", "body_velocity")):
                values = [mbs.GetMarkerOutput(marker, getattr(Output, name)) for marker in markers]
                self.add(quantity, f"itemInterface.{kind}", values)
        # not GetODE2CoordinatesTotal, which corrupts memory (docs/surface/exudyn_coordinates_total.py)
        reference = exudyn.ConfigurationType.Reference
        total = np.array(data.GetODE2Coordinates(reference)) + data.GetODE2Coordinates()
        for kind in ("Node", "Object"):
            by = f"SystemData.Get{kind}LTGODE2 ConfigurationType.Reference"
            self.add("body_position", by, self._own(total, kind))

    def add_once(self, model: Model, state: State) -> None:
        """Add what does not depend on the mechanism, and what is slow: of few states."""
        add_point_answers(self, state)
        add_item_answers(self, model, state)
        if not model.has_loops:
            add_parts(self.found, self._add_degrees_of_freedom)

    def _add_degrees_of_freedom(self) -> None:
        for name, compute in of_module_and_system(self.mbs, "ComputeSystemDegreeOfFreedom").items():
            self.add("degrees_of_freedom", name, compute()["degreeOfFreedom"])

    def _own(self, values: Any, kind: str = "Node") -> list[Array]:
        """The first three of each body's or node's own coordinates, of those of the system."""
        where = getattr(self.mbs.systemData, f"Get{kind}LTGODE2")
        numbers = self.nodes if kind == "Node" else self.bodies
        return [np.array(values)[np.array(where(item))][:3] for item in numbers]

    def _add_coordinates(self, name: str, quantity: str) -> None:
        values = [self.mbs.GetNodeOutput(node, getattr(Output, name))[:3] for node in self.nodes]
        self.add(quantity, f"MainSystem.GetNodeOutput OutputVariableType.{name}", values)

    def _add_sums(self) -> None:
        values = np.array([self.mbs.GetSensorValues(sensor) for sensor in self.sums])
        call = "itemInterface.SensorUserFunction itemInterface.SensorUserFunctionSensorUserFunction"
        turns = [self.mbs.GetObjectOutputBody(body, Output.RotationMatrix) for body in self.bodies]
        laws = FACTORS[0] * np.eye(3) + FACTORS[1] * np.reshape(turns, (-1, 3, 3)).swapaxes(1, 2)
        self.add("frame_velocity", call, np.linalg.solve(laws, values[..., None])[..., 0])

    def _add_configurations(self) -> None:
        """Give each configuration rates of its own, but for the initial one, and read them."""
        data, kinds = self.mbs.systemData, exudyn.ConfigurationType
        rates, multiples = (
            np.array(data.GetODE2Coordinates_t()),
            {"Initial": 1, "Current": 2, "StartOfStep": 3},
        )
        for name, factor in multiples.items():
            if factor > 1:
                data.SetODE2Coordinates_t(factor * rates, getattr(kinds, name))
        for name, factor in multiples.items():
            own = np.array(data.GetODE2Coordinates_t(getattr(kinds, name))) / factor
            self.add("body_velocity", f"ConfigurationType.{name}", self._own(own))
        for name in ("Current", "StartOfStep"):
            data.SetODE2Coordinates_t(rates, getattr(kinds, name))

    def _add_dictionary(self) -> None:
        rates = self.mbs.systemData.GetSystemStateDict()["ODE2Coords_t"]
        self.add("body_velocity", "SystemData.GetSystemStateDict", self._own(rates))
