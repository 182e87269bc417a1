"""What Exudyn reports of bodies in maximal coordinates besides the state quantities: outputs and sensors.

Outputs at a point of a body are in the world's axes or, "Local", in the body's, from where they are turned
here into those of the probe frame.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from adapters.exudyn_common import Output, items
from plumbline.model.datatypes import Array, Call, Model, SurfaceAnswer
from plumbline.model.kinematics import rotation_matrix
from plumbline.model.probe_frames import PROBE_ATTITUDE, probe_points

TURN = rotation_matrix(PROBE_ATTITUDE)


def _as_given(values: Array) -> Array:
    return values


def _in_probe_axes(values: Array) -> Array:
    return values @ TURN


def _axes(values: Array) -> Array:
    return (values.reshape(-1, 3, 3) @ TURN).mT.reshape(-1, 3)


class _Output(NamedTuple):
    """What an output of bodies, nodes and markers is."""

    quantity: str  # at a point
    of_node: str = ""  # the same at a centre of mass, where nodes are; empty: nodes have no such output
    has_marker: bool = False  # whether markers have it
    read: Callable[[Array], Array] = _as_given


OUTPUTS = {
    "Position": _Output("frame_position", "body_position", True),
    "RotationMatrix": _Output("frame_axes", "frame_axes", True, _axes),
    "Velocity": _Output("frame_velocity", "body_velocity", True),
    "VelocityLocal": _Output("frame_velocity_local", read=_in_probe_axes),
    "AngularVelocity": _Output("frame_angular_velocity", "frame_angular_velocity", True),
    "AngularVelocityLocal": _Output(
        "frame_angular_velocity_local", "frame_angular_velocity_local", True, _in_probe_axes
    ),
    "Acceleration": _Output("frame_acceleration", "body_acceleration"),
    "AccelerationLocal": _Output("frame_acceleration_local", read=_in_probe_axes),
    "AngularAcceleration": _Output("frame_angular_acceleration", "frame_angular_acceleration"),
    "AngularAccelerationLocal": _Output("frame_angular_acceleration_local", read=_in_probe_axes),
}
OF_BODIES = {name: output.quantity for name, output in OUTPUTS.items()}
OF_NODES = {name: output.of_node for name, output in OUTPUTS.items() if output.of_node}
OF_MARKERS = {name: output.quantity for name, output in OUTPUTS.items() if output.has_marker}


class Probes:
    """Markers and sensors at the probe points of bodies; they are added before the system is assembled."""

    def __init__(self, mbs: Any, model: Model, bodies: Sequence[Any], nodes: Sequence[Any]) -> None:
        """Add them to the bodies of a system, each of one piece."""
        self.mbs, self.bodies, self.nodes = mbs, bodies, nodes
        self.points = [point.tolist() for point in probe_points(model)]
        self.markers = [
            mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=body, localPosition=point))
            for body, point in zip(bodies, self.points, strict=True)
        ]
        silent = {"writeToFile": False, "storeInternal": False}
        self.sensors: dict[tuple[str, str, str], list[Any]] = defaultdict(list)  # by kind, output, quantity
        for body, point, node, marker in zip(bodies, self.points, nodes, self.markers, strict=True):
            places: Mapping[str, tuple[Mapping[str, str], Mapping[str, Any]]] = {
                "SensorBody": (OF_BODIES, {"bodyNumber": body, "localPosition": point}),
                "SensorNode": (OF_NODES, {"nodeNumber": node}),
                "SensorMarker": (OF_MARKERS, {"markerNumber": marker}),
            }
            for kind, (quantities, place) in places.items():
                for name, quantity in quantities.items():
                    item = getattr(items, kind)(**place, outputVariableType=getattr(Output, name), **silent)
                    self.sensors[kind, name, quantity].append(mbs.AddSensor(item))

    def answer(self) -> SurfaceAnswer:
        """Read all at the current state."""
        mbs, found = self.mbs, defaultdict[str, dict[Call, Array]](dict)
        places = (
            ("GetObjectOutputBody", OF_BODIES, list(zip(self.bodies, self.points, strict=True))),
            ("GetNodeOutput", OF_NODES, [(node,) for node in self.nodes]),
            ("GetMarkerOutput", OF_MARKERS, [(marker,) for marker in self.markers]),
        )
        read: list[tuple[str, str, Call, list[Any]]] = [
            (quantity, name, (f"MainSystem.{function}",),
             [getattr(mbs, function)(item, getattr(Output, name), *point) for item, *point in given])
            for function, quantities, given in places
            for name, quantity in quantities.items()
        ]  # fmt: skip
        read += [
            (quantity, name, ("MainSystem.GetSensorValues", f"itemInterface.{kind}"),
             [mbs.GetSensorValues(sensor) for sensor in sensors])
            for (kind, name, quantity), sensors in self.sensors.items()
        ]  # fmt: skip
        for quantity, name, call, values in read:
            found[quantity][*call, f"OutputVariableType.{name}"] = OUTPUTS[name].read(np.array(values))
        return found
