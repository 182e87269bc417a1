"""What Exudyn reports of bodies in maximal coordinates besides the state quantities: outputs and sensors.

Outputs at a point of a body are in the world's axes or, "Local", in the body's, from where they are turned
here into those of the probe frame.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import exudyn
import numpy as np

from adapters.exudyn_common import Output, items
from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array, Call, Model
from plumbline.model.kinematics import rotation_matrix
from plumbline.model.probe_frames import PROBE_ATTITUDE, probe_points

TURN = rotation_matrix(PROBE_ATTITUDE)


def _as_given(values: Array) -> Array:
    return values


def _in_probe_axes(values: Array) -> Array:
    return values @ TURN


def _axes(values: Array) -> Array:
    return (values.reshape(-1, 3, 3) @ TURN).mT.reshape(-1, 3)


def _axes_of_angles(values: Array) -> Array:
    half = values[..., None] / 2
    about = np.concatenate([np.cos(half), np.sin(half) * np.eye(3)], axis=-1)  # x, y and z
    x, y, z = np.moveaxis(rotation_matrix(about), 1, 0)
    return _axes(x @ y @ z)


def _axes_of_poses(values: Array) -> Array:
    return _axes(values.reshape(-1, 4, 4)[:, :3, :3])


def _place_of_poses(values: Array) -> Array:
    return values.reshape(-1, 4, 4)[:, :3, 3]


def _table(module: str, text: str) -> dict[str, str]:
    lines = (line.partition(": ") for line in text.strip().splitlines())
    return {f"{module}.{name}": functions for name, _, functions in lines}


# By module the functions of attitudes and poses; adapters/pose_functions.py describes the forms.  Plücker
# matrices of shifts alone are inverse to those of shifts with turns.
_OF_BOTH = """
EulerParameters2RotationMatrix: p -> R
RotationMatrix2EulerParameters: Q.R -> Q.p
RotXYZ2RotationMatrix: xyz -> R
HomogeneousTransformation: R r -> H
HT2translation: H -> r
HT2rotationMatrix: H -> R
Skew: r -> S
Skew2Vec: S -> r
"""
POSE_FUNCTIONS = {
    **_table("rigidBodyUtilities", _OF_BOTH), **_table("lieGroupBasics", _OF_BOTH),
    **_table("rigidBodyUtilities", """
RotationVector2RotationMatrix: phi -> R
RotationMatrix2RotationVector: Q.R -> Q.phi
RotationMatrix2RotXYZ: Q.R -> Q.xyz
RotationMatrix2RotZYZ: Q.R 0 -> Q.zyz
RotXYZ2EulerParameters: xyz -> p
EulerParameters2G: Q.p -> @pdot w
EulerParameters2GLocal: Q.p -> @pdot wl
RotXYZ2G: Q.xyz -> @xyzdot w
RotXYZ2GLocal: Q.xyz -> @xyzdot wl
RotationVector2G: Q.phi -> @wl w
RotationVector2GLocal: Q.phi -> @wl wl
AngularVelocity2EulerParameters_t: w Q.p -> pdot
AngularVelocity2RotXYZ_t: w Q.xyz -> xyzdot
ComputeSkewMatrix: r -> S
RotationMatrixX: x -> Rx
RotationMatrixY: y -> Ry
RotationMatrixZ: z -> Rz
HTrotateX: x -> Rx
HTrotateY: y -> Ry
HTrotateZ: z -> Rz
HTtranslate: r -> T
HTtranslateX: rx -> Tx
HTtranslateY: ry -> Ty
HTtranslateZ: rz -> Tz
InverseHT: I.H -> H
RotationTranslation2T66: R r -> X
RotationTranslation2T66Inverse: R r -> XI
T66toRotationTranslation: X -> R r
InverseT66toRotationTranslation: XI -> R r
T66toHT: X -> H
T66Inverse: XI -> X
HT2T66Inverse: H -> XI
RotationX2T66: x -> Rx
RotationY2T66: y -> Ry
RotationZ2T66: z -> Rz
Translation2T66: r -> -T
TranslationX2T66: rx -> -Tx
TranslationY2T66: ry -> -Ty
TranslationZ2T66: rz -> -Tz
"""),
    **_table("kinematicTree", """
RotationX2T66Inverse: x -> -Rx
RotationY2T66Inverse: y -> -Ry
RotationZ2T66Inverse: z -> -Rz
TranslationX2T66Inverse: rx -> Tx
TranslationY2T66Inverse: ry -> Ty
TranslationZ2T66Inverse: rz -> Tz
"""),
    **_table("robotics.utilities", "HT2translation: H -> r\nHT2rotationMatrix: H -> R"),
    **_table("lieGroupBasics", """
ExpSO3: phi -> R
ExpS3: phi -> p
ExpSE3: xi -> H
ExpR3xSO3: rphi -> G
TExpR3xSO3: Q.rphi -> @rphidot vwl
TExpR3xSO3Inv: Q.rphi -> @vwl rphidot
LogSO3: Q.R -> Q.skew
LogSE3: Q.H -> Q.log
TExpSO3: Q.phi -> @phidot wl
TExpSO3Inv: Q.phi -> @wl phidot
TExpSE3: Q.xi -> @xidot t
TExpSE3Inv: Q.xi -> @t xidot
CompositionRuleForEulerParameters: M.p K.p -> Q.p
CompositionRuleForRotationVectors: M.phi K.phi -> Q.phi
CompositionRuleRotXYZAnglesRotationVector: M.xyz K.phi -> Q.xyz
CompositionRuleDirectProductR3AndR3RotVec: M.rphi shift -> Q.rphi
CompositionRuleDirectProductR3AndR3RotXYZAngles: M.rxyz shift -> Q.rxyz
CompositionRuleDirectProductR3AndS3: M.rp shift -> Q.rp
CompositionRuleSemiDirectProductR3AndR3RotVec: M.rphi K.xi -> Q.rphi
CompositionRuleSemiDirectProductR3AndR3RotXYZAngles: M.rxyz K.xi -> Q.rxyz
CompositionRuleSemiDirectProductR3AndS3: M.rp K.xi -> Q.rp
R3xSO3Matrix: r R -> G
R3xSO3Matrix2RotationMatrix: G -> R
R3xSO3Matrix2Translation: G -> r
"""),
}  # fmt: skip


def pose_function(name: str, given: Sequence[Any], forms: Sequence[str]) -> Sequence[Any]:
    """Call a function of attitudes or poses."""
    module, _, function = name.rpartition(".")
    result = getattr(import_module(f"exudyn.{module}"), function)(*given)
    return result if len(forms) > 1 and not forms[0].startswith("@") else [result]


class _Output(NamedTuple):
    """What an output of bodies, nodes and markers is."""

    quantity: str  # at a point
    of_node: str = ""  # the same at a centre of mass, where nodes are; empty: nodes have no such output
    has_marker: bool = False  # whether markers have it
    read: Callable[[Array], Array] = _as_given


def _weighted_sum(
    mbs: Any, t: float, sensors: Sequence[Any], factors: Sequence[float], configuration: Any
) -> list[float]:
    values = [
        factor * np.array(mbs.GetSensorValues(sensor, configuration))
        for sensor, factor in zip(sensors, factors, strict=True)
    ]
    return [float(x) for x in np.sum(values, axis=0)]


OUTPUTS = [
    (name, output)
    for name, output in (
        ("Position", _Output("frame_position", "body_position", True)),
        ("RotationMatrix", _Output("frame_axes", "frame_axes", True, _axes)),
        ("Rotation", _Output("frame_axes", "frame_axes", True, _axes_of_angles)),
        ("Velocity", _Output("frame_velocity", "body_velocity", True)),
        ("VelocityLocal", _Output("frame_velocity_local", read=_in_probe_axes)),
        ("AngularVelocity", _Output("frame_angular_velocity", "frame_angular_velocity", True)),
        ("AngularVelocityLocal",
         _Output("frame_angular_velocity_local", "frame_angular_velocity_local", True, _in_probe_axes)),
        ("Acceleration", _Output("frame_acceleration", "body_acceleration")),
        ("AccelerationLocal", _Output("frame_acceleration_local", read=_in_probe_axes)),
        ("AngularAcceleration", _Output("frame_angular_acceleration", "frame_angular_acceleration")),
        ("AngularAccelerationLocal", _Output("frame_angular_acceleration_local", read=_in_probe_axes)),
        ("HomogeneousTransformation", _Output("frame_axes", "frame_axes", True, _axes_of_poses)),
        ("HomogeneousTransformation", _Output("frame_position", "body_position", True, _place_of_poses)),
    )
    if hasattr(Output, name)  # not in older versions
]  # fmt: skip
OF_COORDINATES = {  # of nodes, whose first coordinates are those of the centre of mass
    "CoordinatesTotal": "body_position", "Coordinates_t": "body_velocity",
    "Coordinates_tt": "body_acceleration",
}  # fmt: skip
OF_BODIES = [(name, output.quantity, output.read) for name, output in OUTPUTS]
OF_NODES = [(name, output.of_node, output.read) for name, output in OUTPUTS if output.of_node]
OF_MARKERS = [(name, output.quantity, output.read) for name, output in OUTPUTS if output.has_marker]


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
        self.markers_of_centres = {
            "MarkerBodyPosition": [mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=x)) for x in bodies],
            "MarkerNodePosition": [mbs.AddMarker(items.MarkerNodePosition(nodeNumber=x)) for x in nodes],
            "MarkerNodeRigid": [mbs.AddMarker(items.MarkerNodeRigid(nodeNumber=x)) for x in nodes],
        }
        silent = {"writeToFile": False, "storeInternal": False}
        # by kind, output, quantity and how it is read
        self.sensors: dict[tuple[str, str, str, Callable[[Array], Array]], list[Any]] = defaultdict(list)
        for body, point, node, marker in zip(bodies, self.points, nodes, self.markers, strict=True):
            places: Mapping[str, tuple[list[Any], Mapping[str, Any]]] = {
                "SensorBody": (OF_BODIES, {"bodyNumber": body, "localPosition": point}),
                "SensorNode": (OF_NODES, {"nodeNumber": node}),
                "SensorMarker": (OF_MARKERS, {"markerNumber": marker}),
            }
            for kind, (quantities, place) in places.items():
                for name, quantity, read in quantities:
                    item = getattr(items, kind)(**place, outputVariableType=getattr(Output, name), **silent)
                    self.sensors[kind, name, quantity, read].append(mbs.AddSensor(item))

        velocities = [key for key in self.sensors if key[:2] == ("SensorBody", "Velocity")]
        self.sums = [
            mbs.AddSensor(
                items.SensorUserFunction(
                    sensorNumbers=[sensor, sensor],
                    factors=[0.5, 1.5],
                    sensorUserFunction=_weighted_sum,
                    **silent,
                )
            )
            for sensor in (self.sensors[velocities[0]] if velocities else ())
        ]

    def answer(self) -> dict[str, dict[Call, Array]]:
        """Read all at the current state."""
        mbs, found = self.mbs, defaultdict[str, dict[Call, Array]](dict)
        places = (
            ("GetObjectOutputBody", OF_BODIES, list(zip(self.bodies, self.points, strict=True))),
            ("GetNodeOutput", OF_NODES, [(node,) for node in self.nodes]),
            ("GetMarkerOutput", OF_MARKERS, [(marker,) for marker in self.markers]),
        )
        read: list[tuple[str, str, Call, Callable[[Array], Array], list[Any]]] = [
            (quantity, name, (f"MainSystem.{function}",), of,
             [getattr(mbs, function)(item, getattr(Output, name), *point) for item, *point in given])
            for function, quantities, given in places
            for name, quantity, of in quantities
        ]  # fmt: skip
        read += [
            (quantity, name, ("MainSystem.GetSensorValues", f"itemInterface.{kind}"), of,
             [mbs.GetSensorValues(sensor) for sensor in sensors])
            for (kind, name, quantity, of), sensors in self.sensors.items()
        ]  # fmt: skip
        for quantity, name, call, of, values in read:
            found[quantity][*call, f"OutputVariableType.{name}"] = of(np.array(values))
        add_parts(
            found,
            *(partial(self._add_coordinates, found, *one) for one in OF_COORDINATES.items()),
            partial(self._add_sums, found),
            partial(self._add_dictionary, found),
            *(partial(self._add_configuration, found, one) for one in ("Initial", "Current", "StartOfStep")),
        )
        for kind, markers in self.markers_of_centres.items():
            for name, quantity in (("Position", "body_position"), ("Velocity", "body_velocity")):
                values = [mbs.GetMarkerOutput(marker, getattr(Output, name)) for marker in markers]
                found[quantity][f"itemInterface.{kind}",] = np.array(values)
        data = mbs.systemData
        # not GetODE2CoordinatesTotal, which corrupts memory (docs/surface/exudyn_coordinates_total.py)
        reference = exudyn.ConfigurationType.Reference
        total = np.array(data.GetODE2Coordinates(reference)) + data.GetODE2Coordinates()
        for kind, numbers in (("Node", self.nodes), ("Object", self.bodies)):
            own = np.array([total[getattr(data, f"Get{kind}LTGODE2")(item)][:3] for item in numbers])
            found["body_position"][f"SystemData.Get{kind}LTGODE2", "ConfigurationType.Reference"] = own
        return found

    def _add_coordinates(self, found: dict[str, dict[Call, Array]], name: str, quantity: str) -> None:
        values = [self.mbs.GetNodeOutput(node, getattr(Output, name))[:3] for node in self.nodes]
        found[quantity]["MainSystem.GetNodeOutput", f"OutputVariableType.{name}"] = np.array(values)

    def _add_sums(self, found: dict[str, dict[Call, Array]]) -> None:
        values = np.array([self.mbs.GetSensorValues(sensor) for sensor in self.sums])
        call = ("itemInterface.SensorUserFunction", "itemInterface.SensorUserFunctionSensorUserFunction")
        found["frame_velocity"][call] = values / 2

    def _add_configuration(self, found: dict[str, dict[Call, Array]], name: str) -> None:
        data, configuration = self.mbs.systemData, getattr(exudyn.ConfigurationType, name)
        rates = np.array(data.GetODE2Coordinates_t(configuration))
        own = np.array([rates[np.array(data.GetNodeLTGODE2(node))][:3] for node in self.nodes])
        found["body_velocity"][f"ConfigurationType.{name}",] = own

    def _add_dictionary(self, found: dict[str, dict[Call, Array]]) -> None:
        data = self.mbs.systemData
        rates = np.array(data.GetSystemStateDict()["ODE2Coords_t"])
        own = np.array([rates[np.array(data.GetNodeLTGODE2(node))][:3] for node in self.nodes])
        found["body_velocity"]["SystemData.GetSystemStateDict",] = own
