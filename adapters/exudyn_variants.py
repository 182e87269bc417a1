"""Other ways to describe the same mechanism to Exudyn in maximal coordinates, as users do.

A `Change` is what the build of a chain does otherwise; `VARIANTS` lists them with the names that each
exercises.  A node has coordinates of its own for the attitude, whose rates are B ω′.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from typing import Any

import exudyn
import numpy as np
from exudyn import rigidBodyUtilities

from adapters.exudyn_common import (
    IMPLICIT,
    Ways,
    add_plain,
    call_parts,
    change_item,
    first_known,
    initialize,
    items,
    items_argument,
    known_arguments,
    make_rigid_body,
    sizes_of_body,
    texts,
)
from adapters.pose_functions import Pose, rate_maps
from plumbline.engines.variants import Suits, Variant, both, has, variants_of
from plumbline.model.datatypes import Array, Float, JointKind, Model, Unsupported
from plumbline.model.kinematics import quaternion_rate, rotation_matrix, rotation_vector
from plumbline.model.welding import RigidPart

MIN_COS_MIDDLE_ANGLE = 0.03  # of three angles: below, the rates of the others lose digits
utilities: Any = rigidBodyUtilities  # its functions are untyped
MANY_BODIES = 10
MAX_ATTITUDE_ERROR = 1e-14  # of entries of rotation matrices that the engine has converted
TURN_TO_X = np.roll(np.eye(3), 1, axis=1)  # columns z, x, y: its x axis is the z axis of what it is in


@dataclass(frozen=True)
class Piece:
    """A rigid part of a body at its state."""

    part: RigidPart
    place: Float[Array, "3"]  # m
    velocity: Float[Array, "3"]  # m/s
    turn: Float[Array, "4"]
    spin: Float[Array, "3"]  # rad/s, in its own axes
    gravity: Float[Array, "3"]  # m/s²


@dataclass(frozen=True)
class Joint:
    """What a joint holds together."""

    kind: JointKind
    markers: Sequence[Any]
    bodies: Sequence[Any]
    points: Sequence[Float[Array, "3"]]  # m, in the bodies
    turns: Float[Array, "2 3 3"]  # of the joint's axes in the bodies
    place: Float[Array, "3"]  # of the near point, world
    axes: Float[Array, "3 3"]  # of the near body, world
    rows: Sequence[int]
    length: float


AddedBody = tuple[Any, Any, Array]  # node, body, and B of the rates B ω′ of the node's attitude


def euler_parameter_rates(p: Float[Array, "4"]) -> Float[Array, "4 3"]:
    """Return B of Euler parameters."""
    return quaternion_rate(p, np.eye(3)).T


def _angles(p: Float[Array, "4"]) -> Float[Array, "3"]:
    return np.asarray(Pose(np.zeros(3), p).forms["xyz"])


def _angle_rates(p: Float[Array, "4"]) -> Float[Array, "3 3"]:
    pose = Pose(np.zeros(3), p)
    if abs(np.cos(pose.forms["y"])) < MIN_COS_MIDDLE_ANGLE:
        raise Unsupported("the second of a node's three angles is near ±90°, where they lose digits")
    return np.asarray(np.linalg.inv(rate_maps(pose)["xyzdot"]))


def _weight(marker: Any, gravity: Array, kind: str = "LoadMassProportional") -> Any:
    return getattr(items, kind)(markerNumber=marker, loadVector=gravity.tolist())


def _weight_by_function(marker: Any, gravity: Array) -> Any:
    given = {"loadVector": [0.0] * 3, "loadVectorUserFunction": lambda *_: gravity.tolist()}
    return items.LoadMassProportional(markerNumber=marker, **given)


def _short_body(node: Any, mass: float, J: Array) -> Any:
    sizes = sizes_of_body(mass=mass, inertia=utilities.InertiaTensor2Inertia6D(J))
    return items.RigidBody(nodeNumber=node, **sizes)


def _node(
    kind: str,
    parameters: Callable[[Array], Array] = np.array,
    rates: Callable[[Array], Array] = euler_parameter_rates,
    weight: Callable[[Any, Array], Any] = _weight,
    make_body: Callable[[Any, float, Array], Any] = make_rigid_body,
) -> Any:
    """How a body on a node of this kind is added."""

    def add(mbs: Any, piece: Piece) -> AddedBody:
        reference, B = [*piece.place, *parameters(piece.turn)], rates(piece.turn)
        velocities = [*piece.velocity, *(B @ piece.spin)]
        item = getattr(items, kind)(referenceCoordinates=reference, initialVelocities=velocities)
        node = mbs.AddNode(item)
        body = mbs.AddObject(make_body(node, piece.part.mass, piece.part.inertia))
        mbs.AddLoad(weight(mbs.AddMarker(items.MarkerBodyMass(bodyNumber=body)), piece.gravity))
        return node, body, B

    return add


def _by_helper(add: Callable[..., Any], place: str, velocity: str, turn: str, spin: str) -> Any:
    """Add a body by a function that makes its node too and is given these arguments."""

    def add_body(mbs: Any, piece: Piece) -> AddedBody:
        A = rotation_matrix(piece.turn)
        inertia = utilities.RigidBodyInertia(piece.part.mass, piece.part.inertia)
        given = {place: piece.place, velocity: piece.velocity, turn: A, spin: A @ piece.spin}
        made = add(mbs, inertia=inertia, gravity=piece.gravity.tolist(), **given)
        body = made[1] if isinstance(made, list | tuple) else made
        node = mbs.GetObject(body)["nodeNumber"]
        own = np.array(mbs.GetNode(node)["referenceCoordinates"][3:])  # p or −p
        if np.max(np.abs(rotation_matrix(own) - A)) > MAX_ATTITUDE_ERROR:
            raise Unsupported("RotationMatrix2EulerParameters of Exudyn loses digits at an attitude")
        return node, body, euler_parameter_rates(own)

    return add_body


USUAL_BODY = _node("NodeRigidBodyEP")


def _set_later(modifies: bool) -> Any:
    """Add a body of another mass and at rest, and set both later: parameters, or whole items."""

    def add(mbs: Any, piece: Piece) -> AddedBody:
        other, rest = replace(piece.part, mass=2 * piece.part.mass), np.zeros(3)
        node, body, B = USUAL_BODY(mbs, replace(piece, part=other, velocity=rest, spin=rest))
        rates = [*piece.velocity, *(B @ piece.spin)]
        change_item(mbs, "Node", node, modifies, initialVelocities=rates)
        change_item(mbs, "Object", body, modifies, **sizes_of_body(mass=piece.part.mass))
        return node, body, B

    return add


def _made(owner: str, name: str, given: str, turn: Float[Array, "3 3"] | None = None) -> Any:
    """How a joint is added as an item or by a function of the system or of the utilities, given these.

    Args:
        turn: of its axes in those of the usual one.

    """

    def add(mbs: Any, joint: Joint) -> Any:
        far, near = joint.turns if turn is None else joint.turns @ turn
        values: dict[str, Any] = {
            "markerNumbers": list(joint.markers), "rotationMarker0": far, "rotationMarker1": near,
            "bodyNumbers": list(joint.bodies), "body0": joint.bodies[0], "body1": joint.bodies[1],
            "localPosition0": joint.points[0], "localPosition1": joint.points[1],
            "position": joint.place, "point": joint.place, "axis": joint.axes[:, 2],
            "rotationMatrixAxes": joint.axes, "constrainedAxes": [*joint.rows], "distance": joint.length,
        }  # fmt: skip
        own = {key: values[key] for key in given.split()}
        if owner == "itemInterface":
            return mbs.AddObject(getattr(items, name)(**own))
        if owner == "rigidBodyUtilities":
            own["mbs"] = mbs
        create = getattr(utilities if "mbs" in own else mbs, name)
        if "bodyNumbers" in own:
            own |= items_argument(create, own.pop("bodyNumbers"))
        made = create(**own)
        return made[0] if isinstance(made, list | tuple) else made  # of older versions with its markers

    return add


OF_BALL, OF_ROD = "markerNumbers constrainedAxes", "markerNumbers distance"
ON_AXES = "markerNumbers rotationMarker0 rotationMarker1"
_usual_rod = _made("itemInterface", "ObjectConnectorDistance", OF_ROD)
_usual_ball = _made("itemInterface", "ObjectJointSpherical", OF_BALL)
_usual_other = _made("itemInterface", "ObjectJointGeneric", f"{ON_AXES} constrainedAxes")


def _usual_joint(mbs: Any, joint: Joint) -> Any:
    if joint.kind.holds_distance:
        return _usual_rod(mbs, joint)
    return (_usual_ball if joint.kind.is_spherical else _usual_other)(mbs, joint)


def _moves(*motions: str) -> Callable[[JointKind], bool]:
    """Whether a joint has these motions, in turn, all about or along z."""
    return lambda kind: kind.is_about_z and tuple(what for what, _ in kind.motions) == motions


TURNS, SLIDES, BOTH = _moves("turn"), _moves("slide"), _moves("slide", "turn")


def _ball_of_generic(mbs: Any, joint: Joint) -> Any:
    rows = [*joint.rows, 0, 0, 0]
    return mbs.AddObject(items.ObjectJointGeneric(markerNumbers=list(joint.markers), constrainedAxes=rows))


def _assemble_by_parts(mbs: Any) -> None:
    call_parts(mbs, ASSEMBLY)
    mbs.systemIsConsistent = True  # which only Assemble finds out


def _assemble_and_set_state(mbs: Any) -> None:
    """Carry the state over by all coordinates at once."""
    mbs.Assemble()
    data = mbs.systemData
    state = [np.array(part) for part in data.GetSystemState()]
    data.SetODE2Coordinates_t(0 * state[1])
    data.SetSystemState(state)


ASSEMBLY = "AssembleCoordinates AssembleLTGLists AssembleInitializeSystemCoordinates AssembleSystemInitialize"


@dataclass(frozen=True)
class Change:
    """What is done otherwise; as it stands nothing."""

    add_body: Callable[[Any, Piece], AddedBody] = USUAL_BODY
    add_joint: Callable[[Any, Joint], Any] = _usual_joint
    assemble: Callable[[Any], None] = lambda mbs: mbs.Assemble()
    ways: Ways = field(default_factory=dict)  # of loads and spring-dampers
    solver: Callable[[], Any] = lambda: exudyn.MainSolverImplicitSecondOrder()  # looked up when it is called
    initialize: Callable[[Any, Any, Any], bool] = initialize
    mass_matrix: Callable[[Any, Array], Array] = lambda _, M: M  # of the chain, and the solver's
    jacobian: Callable[[Any, Array], Array] = lambda _, C: C


def is_open(model: Model) -> bool:
    """Whether a mechanism has no loops, and so few bodies that one more dense solve is cheap."""
    return not model.has_loops and model.n <= MANY_BODIES


def _has_no_axes(model: Model) -> bool:
    """Whether rates of constraints follow from outputs: others need a polynomial in the coordinates."""
    return all(kind.has_attitude for kind in model.kinds)


_option = variants_of("option", Change, is_open)
_spelling = variants_of("spelling", Change, is_open)


def _joints(names: str, add: Callable[[Any, Joint], Any], are_meant: Callable[[JointKind], bool]) -> Variant:
    """Describe some joints to the engine in another way."""

    def add_joint(mbs: Any, joint: Joint) -> Any:
        return (add if are_meant(joint.kind) else _usual_joint)(mbs, joint)

    return _spelling(names, lambda model: any(map(are_meant, model.kinds)), add_joint=add_joint)


DRAG = "ObjectConnectorRigidBodySpringDamper"
SHORT_NAMES = {
    "LoadForceVector": "Force", "LoadTorqueVector": "Torque",
    "ObjectConnectorSpringDamper": "SpringDamper", "ObjectConnectorLinearSpringDamper": "LinearSpringDamper",
    "ObjectConnectorTorsionalSpringDamper": "TorsionalSpringDamper",
    "ObjectConnectorRigidBodySpringDamper": "RigidBodySpringDamper",
}  # fmt: skip


def _created_between(function: str, **more: Any) -> Callable[..., Any]:
    """A connector by a function of the system, between the bodies and at the points of its markers."""

    def add(mbs: Any, markerNumbers: Any, **given: Any) -> Any:
        ends, create = [mbs.GetMarker(marker) for marker in markerNumbers], getattr(mbs, function)
        given |= {f"localPosition{i}": end["localPosition"] for i, end in enumerate(ends)}
        bodies = [end["bodyNumber"] for end in ends]
        return create(**items_argument(create, bodies), **given, **known_arguments(create, more))

    return add


def _created_along(mbs: Any, **given: Any) -> Any:
    """A spring-damper by a function of the system, along or about an axis of the first body.

    Its coordinate is zero at the start.
    """
    ends, is_turn = [mbs.GetMarker(marker) for marker in given["markerNumbers"]], "torque" in given
    if is_turn:
        axis = np.asarray(given["rotationMarker0"])[:, 2]
        start = mbs.GetNodeParameter(given["nodeNumber"], "initialCoordinates")[0]
    else:
        axis = np.asarray(given["axisMarker0"])
        (here, turn), (there, _) = (_place_of(mbs, end) for end in ends)
        start = float((turn @ axis) @ (there - here))
    numbers = "stiffness", "damping", "offset", "force", "torque"
    law: dict[str, Any] = {name: given[name] for name in numbers if name in given}
    law["offset"] -= start
    law |= {"position": ends[0]["localPosition"], "axis": axis, "useGlobalFrame": False}
    create = mbs.CreateTorsionalSpringDamper if is_turn else mbs.CreateLinearSpringDamper
    return create(**items_argument(create, [end["bodyNumber"] for end in ends]), **law)


def _place_of(mbs: Any, marker: Any) -> tuple[Array, Array]:
    """The point of a marker in the world, and the axes of its body."""
    body, local = mbs.GetObject(marker["bodyNumber"]), np.array(marker["localPosition"])
    if "nodeNumber" not in body:
        return local, np.eye(3)
    reference = np.array(mbs.GetNode(body["nodeNumber"])["referenceCoordinates"])
    turn = rotation_matrix(reference[3:])
    return reference[:3] + turn @ local, turn


def _created_load(function: str) -> Callable[..., Any]:
    def add(mbs: Any, markerNumber: Any, **given: Any) -> Any:
        marker = mbs.GetMarker(markerNumber)
        place = {name: marker[name] for name in ("bodyNumber", "localPosition")}
        return getattr(mbs, function)(**place, **given)

    return add


def _load_by_function(kind: str) -> Callable[..., Any]:
    def add(mbs: Any, loadVector: Any, **given: Any) -> Any:
        given["loadVectorUserFunction"] = lambda *_: loadVector
        return add_plain(kind, mbs, loadVector=[0.0] * 3, **given)

    return add


def by_function(kind: str, argument: str, law: Callable[..., Any]) -> Callable[..., Any]:
    """A connector whose law a function computes from its parameters and what the engine gives it."""

    def add(mbs: Any, **given: Any) -> Any:
        def user(mbs: Any, t: float, item: int, *motion: Any) -> Any:
            return law(given, *motion)

        return add_plain(kind, mbs, **given, **{argument: user})

    return add


def spring_law(own: Mapping[str, Any], x: float, rate: float, *_: Any) -> float:
    """The law k (x − offset) + d v + constant."""
    constant = own.get("force", own.get("torque", 0.0))
    return float(own["stiffness"] * (x - own.get("offset", 0.0)) + own["damping"] * rate + constant)


def _law_of_drag(own: Mapping[str, Any], shift: Any, turn: Any, *motion: Any) -> list[float]:
    return [float(x) for x in own["damping"] @ np.append(*motion[:2])]


def _law_of_axes(own: Mapping[str, Any], x: Any, rate: Any, *_: Any) -> list[float]:
    return [float(d * one) for d, one in zip(own["damping"], rate, strict=True)]


def _drag_by_two(way: Callable[..., Any]) -> Callable[..., Any]:
    """Drag by a connector of displacements and one of rotations."""

    def add(mbs: Any, damping: Array, markerNumbers: Any, **given: Any) -> Any:
        turning = np.diag(np.append(np.zeros(3), np.diag(damping)[3:]))
        add_plain(DRAG, mbs, damping=turning, markerNumbers=markerNumbers, **given)
        moving = np.diag(damping)[:3].tolist()
        return way(mbs, markerNumbers=markerNumbers, stiffness=[0.0] * 3, damping=moving)

    return add


def _has_elements_that(what: str) -> Suits:
    """Whether a joint with one motion of this kind has a spring, damper or effort."""

    def has(model: Model) -> bool:
        return any(
            one == what and bool(model.stiffness[k, i] or model.damping[k, i] or model.effort[k, i])
            for k, kind in enumerate(model.kinds)
            if not kind.has_attitude
            for i, (one, _) in enumerate(kind.motions)
        )

    return has


HAS: Mapping[str, Suits] = {
    "LoadForceVector": has("force"),
    "LoadTorqueVector": has("moment"),
    DRAG: both(has("drag_force"), has("drag_moment")),
    "ObjectConnectorSpringDamper": lambda model: len(model.spring_body) > 0,
    "ObjectConnectorLinearSpringDamper": _has_elements_that("slide"),
    "ObjectConnectorTorsionalSpringDamper": _has_elements_that("turn"),
}
# under the name of the version; else the drag would act between the points
_NOT_INTRINSIC = first_known(
    exudyn.MainSystem.CreateRigidBodySpringDamper, "useIntrinsicFormulation intrinsicFormulation", False
)
# By kind of item and names what adds it.
WAYS: tuple[tuple[str, str, Callable[..., Any]], ...] = (
    *((kind, f"itemInterface.{short}", partial(add_plain, short)) for kind, short in SHORT_NAMES.items()),
    *(
        way
        for name in ("Force", "Torque")
        for kind in (f"Load{name}Vector",)
        for way in (
            (kind, f"itemInterface.{kind}LoadVectorUserFunction", _load_by_function(kind)),
            (kind, f"MainSystem.Create{name}", _created_load(f"Create{name}")),
        )
    ),
    *(
        (f"ObjectConnector{name}SpringDamper",
         f"itemInterface.ObjectConnector{name}SpringDamperSpring{what}UserFunction",
         by_function(f"ObjectConnector{name}SpringDamper", f"spring{what}UserFunction", spring_law))
        for name, what in (("", "Force"), ("Linear", "Force"), ("Torsional", "Torque"))
    ),
    *(
        (f"ObjectConnector{name}SpringDamper", f"MainSystem.Create{name}SpringDamper", way)
        for name, way in (
            ("", _created_between("CreateSpringDamper")),
            ("Torsional", _created_along),
            ("Linear", _created_along),
            ("RigidBody", _created_between("CreateRigidBodySpringDamper", **_NOT_INTRINSIC)),
        )
    ),
    (DRAG, f"itemInterface.{DRAG}SpringForceTorqueUserFunction",
     by_function(DRAG, "springForceTorqueUserFunction", _law_of_drag)),
    (DRAG, "itemInterface.ObjectConnectorCartesianSpringDamper itemInterface.CartesianSpringDamper",
     _drag_by_two(partial(add_plain, "CartesianSpringDamper"))),
    (DRAG, "itemInterface.ObjectConnectorCartesianSpringDamperSpringForceUserFunction",
     _drag_by_two(
         by_function("ObjectConnectorCartesianSpringDamper", "springForceUserFunction", _law_of_axes)
     )),
    (DRAG, "MainSystem.CreateCartesianSpringDamper",
     _drag_by_two(_created_between("CreateCartesianSpringDamper"))),
)  # fmt: skip


def of_ways(spelling: Callable[..., Variant], end: str = "") -> Sequence[Variant]:
    """List the ways to make items, of mechanisms that have some; of those whose names have this end."""
    return [spelling(names, HAS[kind], ways={kind: way}) for kind, names, way in WAYS if names.endswith(end)]


def _initialize_by_parts(solver: Any, mbs: Any, settings: Any) -> bool:
    """Initialise, and call the parts of it again: without the whole before them they are refused later."""
    if not solver.InitializeSolver(mbs, settings) or not solver.InitializeSolverPreChecks(mbs, settings):
        return False
    call_parts(solver, INITIALISATION, mbs, settings)
    return True


INITIALISATION = (
    "InitializeSolverData PreInitializeSolverSpecific InitializeSolverOutput "
    "InitializeSolverInitialConditions PostInitializeSolverSpecific"
)


def _mass_matrix_of_items(chain: Any, M: Array) -> Array:
    data, found, what = chain.mbs.systemData, np.zeros_like(M), exudyn.ComputeItemType.MassMatrix
    for body in chain.piece_bodies:
        own = data.GetObjectLTGODE2(body)
        found[np.ix_(own, own)] += chain.mbs.ComputeItem(body, what)
    return found


def _jacobian_of_items(chain: Any, C: Array) -> Array:
    data, found = chain.mbs.systemData, C.copy()
    for joint in (one for one in (*chain.joints, *chain.welds) if one is not None):
        rows, columns = list(data.GetObjectLTGAE(joint)), list(data.GetObjectLTGODE2(joint))
        found[rows] = 0
        found[np.ix_(rows, columns)] = chain.mbs.ComputeItem(joint, exudyn.ComputeItemType.ConstraintJacobian)
    return found


def _mass_matrix_of_linearised(chain: Any, _: Array) -> Array:
    function = chain.mbs.ComputeLinearizedSystem
    M, *_others = function(**known_arguments(function, {"autoAssemble": False}))
    return np.asarray(M)


def _is_ball(kind: JointKind) -> bool:
    return kind.is_spherical and not kind.holds_distance


_is_rod: Callable[[JointKind], bool] = attrgetter("holds_distance")


VARIANTS = (
    *(
        _spelling(name, _has_no_axes, add_body=_node(name.removeprefix("itemInterface."), of, rates))
        for name, of, rates in (  # whole names, by which scripts leave out other entries
            ("itemInterface.NodeRigidBodyRxyz", _angles, _angle_rates),
            ("itemInterface.NodeRigidBodyRotVecLG", rotation_vector, lambda _: np.eye(3)),
        )
    ),
    _spelling(
        "MainSystem.CreateRigidBody rigidBodyUtilities.RigidBodyInertia",
        add_body=_by_helper(
            exudyn.MainSystem.CreateRigidBody, "referencePosition", "initialVelocity",
            "referenceRotationMatrix", "initialAngularVelocity",
        ),
    ),
    _spelling(
        "rigidBodyUtilities.AddRigidBody rigidBodyUtilities.GetRigidBodyNode",
        add_body=_by_helper(
            utilities.AddRigidBody, "position", "velocity", "rotationMatrix", "angularVelocity"
        ),
    ),
    _spelling(
        "MainSystem.SetNodeParameter MainSystem.SetObjectParameter", add_body=_set_later(modifies=False)
    ),
    _spelling("MainSystem.ModifyNode MainSystem.ModifyObject", add_body=_set_later(modifies=True)),
    _option(texts("MainSystem", ASSEMBLY, "systemIsConsistent"), assemble=_assemble_by_parts),
    _option("SystemData.GetSystemState SystemData.SetSystemState", assemble=_assemble_and_set_state),
    *of_ways(_spelling),
    _option(
        texts(IMPLICIT, "InitializeSolverPreChecks", INITIALISATION), initialize=_initialize_by_parts
    ),
    _option("MainSolverStatic", solver=lambda: exudyn.MainSolverStatic()),
    _option(
        "MainSystem.ComputeItem ComputeItemType",
        _has_no_axes,
        mass_matrix=_mass_matrix_of_items,
        jacobian=_jacobian_of_items,
    ),
    _option(
        "MainSystem.ComputeLinearizedSystem ComputeLinearizedSystem",
        _has_no_axes,
        mass_matrix=_mass_matrix_of_linearised,
    ),
    _spelling(
        "itemInterface.RigidEP itemInterface.RigidBody itemInterface.Gravity "
        "rigidBodyUtilities.InertiaTensor2Inertia6D",
        add_body=_node("RigidEP", weight=partial(_weight, kind="Gravity"), make_body=_short_body),
    ),
    _spelling(
        "itemInterface.LoadMassProportionalLoadVectorUserFunction",
        add_body=_node("NodeRigidBodyEP", weight=_weight_by_function),
    ),
    *(
        _joints(f"itemInterface.{name}", _made("itemInterface", name, given, turn), are_meant)
        for name, given, are_meant, turn in (
            ("SphericalJoint", OF_BALL, _is_ball, None),
            ("DistanceConstraint", OF_ROD, _is_rod, None),
            ("ObjectJointRevoluteZ", ON_AXES, TURNS, None),
            ("ObjectJointPrismaticX", ON_AXES, SLIDES, TURN_TO_X),
        )
    ),
    _joints("itemInterface.ObjectJointGeneric", _ball_of_generic, _is_ball),
    *(
        _joints(f"{owner}.{name}", _made(owner, name, given), are_meant)
        for owner, name, given, are_meant in (
            ("rigidBodyUtilities", "AddRevoluteJoint", "body0 body1 point axis", TURNS),
            ("rigidBodyUtilities", "AddPrismaticJoint", "body0 body1 point axis", SLIDES),
            ("MainSystem", "CreateRevoluteJoint", "bodyNumbers position axis", TURNS),
            ("MainSystem", "CreatePrismaticJoint", "bodyNumbers position axis", SLIDES),
            ("MainSystem", "CreateGenericJoint", "bodyNumbers position rotationMatrixAxes constrainedAxes",
             BOTH),
            ("MainSystem", "CreateSphericalJoint", "bodyNumbers position constrainedAxes", _is_ball),
            ("MainSystem", "CreateDistanceConstraint",
             "bodyNumbers localPosition0 localPosition1 distance", _is_rod),
        )
    ),
)  # fmt: skip
