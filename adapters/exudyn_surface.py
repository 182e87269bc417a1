"""What Exudyn reports of bodies in maximal coordinates besides the state quantities: outputs and sensors.

Outputs at a point of a body are in the world's axes or, "Local", in the body's, from where they are turned
here into those of the probe frame.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from adapters.exudyn_common import Output, items
from plumbline.model.datatypes import Array, Model, SurfaceAnswer
from plumbline.model.kinematics import rotation_matrix
from plumbline.model.probe_frames import PROBE_ATTITUDE, probe_points

# By output of a body the quantity; nodes and markers have some of them.
OUTPUTS = {
    "Position": "frame_position",
    "RotationMatrix": "frame_axes",
    "Velocity": "frame_velocity",
    "VelocityLocal": "frame_velocity_local",
    "AngularVelocity": "frame_angular_velocity",
    "AngularVelocityLocal": "frame_angular_velocity_local",
    "Acceleration": "frame_acceleration",
    "AccelerationLocal": "frame_acceleration_local",
    "AngularAcceleration": "frame_angular_acceleration",
    "AngularAccelerationLocal": "frame_angular_acceleration_local",
}
MARKER_OUTPUTS = ("Position", "RotationMatrix", "Velocity", "AngularVelocity", "AngularVelocityLocal")
NODE_OUTPUTS = (*MARKER_OUTPUTS, "Acceleration", "AngularAcceleration")
TURN = rotation_matrix(PROBE_ATTITUDE)


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
        self.sensors: dict[tuple[str, str], list[Any]] = defaultdict(list)
        for body, point, node, marker in zip(bodies, self.points, nodes, self.markers, strict=True):
            places = {
                "SensorBody": (OUTPUTS, {"bodyNumber": body, "localPosition": point}),
                "SensorNode": (NODE_OUTPUTS, {"nodeNumber": node}),
                "SensorMarker": (MARKER_OUTPUTS, {"markerNumber": marker}),
            }
            for kind, (names, place) in places.items():
                for name in names:
                    item = getattr(items, kind)(**place, outputVariableType=getattr(Output, name), **silent)
                    self.sensors[kind, name].append(mbs.AddSensor(item))

    def answer(self) -> SurfaceAnswer:
        """Read all at the current state."""
        mbs, found = self.mbs, dict[str, dict[str, Array]]()
        bodies = list(zip(self.bodies, self.points, strict=True))
        for name in OUTPUTS:
            values = [mbs.GetObjectOutputBody(body, getattr(Output, name), point) for body, point in bodies]
            self._add(found, name, "MainSystem.GetObjectOutputBody", values)
        for function, names, numbers in (
            ("GetNodeOutput", NODE_OUTPUTS, self.nodes),
            ("GetMarkerOutput", MARKER_OUTPUTS, self.markers),
        ):
            for name in names:
                values = [getattr(mbs, function)(item, getattr(Output, name)) for item in numbers]
                self._add(found, name, f"MainSystem.{function}", values)
        for (kind, name), sensors in self.sensors.items():
            call = f"MainSystem.GetSensorValues, itemInterface.{kind}"
            self._add(found, name, call, [mbs.GetSensorValues(sensor) for sensor in sensors])
        return found

    @staticmethod
    def _add(found: dict[str, dict[str, Array]], name: str, call: str, values: list[Any]) -> None:
        quantity, vectors = OUTPUTS[name], np.array(values)
        if "Node" in call:  # nodes are at the centres of mass
            for what in ("position", "velocity", "acceleration"):
                quantity = quantity.replace(f"frame_{what}", f"body_{what}")
        if name == "RotationMatrix":
            vectors = (vectors.reshape(-1, 3, 3) @ TURN).mT.reshape(-1, 3)
        if name.endswith("Local"):
            vectors = vectors @ TURN
        found.setdefault(quantity, {})[f"{call}, OutputVariableType.{name}"] = vectors
