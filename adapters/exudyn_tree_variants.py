"""Other ways to describe and evaluate a kinematic tree of Exudyn: functions in Python, robots, loads.

A `TreeChange` is what the column of minimal coordinates does otherwise; `VARIANTS` lists them with the names
that each exercises.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, cast

import exudyn
import numpy as np
from exudyn import kinematicTree, rigidBodyUtilities, robotics

from adapters.exudyn_common import (
    EXPLICIT,
    Ways,
    add_plain,
    call_parts,
    coordinate_marker,
    grounded_marker,
    initialized_solver,
    items,
    make_settings,
    set_explicit_method,
    set_linear_solver,
    texts,
)
from adapters.exudyn_variants import by_function, is_open, of_ways, spring_law
from adapters.pose_functions import homogeneous
from plumbline.engines.variants import both, has, variants_of
from plumbline.model.datatypes import Array, EngineFailure, Float, Model

utilities: Any = rigidBodyUtilities  # as below, functions are untyped
trees: Any = kinematicTree
robots: Any = robotics
# To make the shapes of links, which nothing here draws, takes longer than the tree. One shape replaces all.
_SHAPE = {"type": "Line", "color": [0.0, 0.0, 0.0, 1.0], "data": [0.0] * 6}
_UNDRAWN = robots.VRobotLink(showMBSjoint=False, showCOM=False, graphicsData=[_SHAPE])
LONG_STEP = 2.0**20  # s: of one step of Euler's method, in which v₁ = v₀ + h a to the rounding of h a


def pose_of(link: Any) -> Float[Array, "4 4"]:
    """The joint of a link in the link before, at its start."""
    return homogeneous(link.axes_in_parent, link.offset)


def short_type(link: Any) -> str:
    """The kind of its joint as functions in Python have it: Rz, Px, …."""
    name = str(link.joint).rpartition(".")[2]
    return name[0] + name[-1].lower()


def robot_of(links: Sequence[Any], gravity: Float[Array, "3"]) -> Any:
    """Make a robot of links."""
    robot = robots.Robot(gravity=gravity.tolist(), referenceConfiguration=[0.0] * len(links))
    for link in links:
        robot.AddLink(
            robots.RobotLink(
                link.mass, link.centre, link.inertia, preHT=pose_of(link), jointType=short_type(link),
                parent=link.parent, visualization=_UNDRAWN,
            )
        )  # fmt: skip
    return robot


def _add_by_tree_links(mbs: Any, links: Sequence[Any], gravity: Array, rates: Array) -> tuple[Any, Any]:
    made = []
    for link in links:
        inertia = utilities.RigidBodyInertia()
        inertia.SetWithCOMinertia(link.mass, link.inertia, link.centre)
        made.append(
            utilities.TreeLink(
                inertia, jointType=link.joint, jointHT=pose_of(link), parent=link.parent, graphicsDataList=[]
            )
        )
    tree = mbs.CreateKinematicTree(
        listOfTreeLinks=made, initialCoordinates_t=rates.tolist(), gravity=gravity.tolist(),
        baseGraphicsDataList=[],
    )  # fmt: skip
    return mbs.GetObject(tree)["nodeNumber"], tree


def _add_robot(mbs: Any, links: Sequence[Any], gravity: Array, rates: Array) -> tuple[Any, Any]:
    made = robot_of(links, gravity).CreateKinematicTree(mbs)
    node = made["nodeGeneric"]
    mbs.SetNodeParameter(node, "initialCoordinates_t", rates.tolist())
    return node, made["objectKinematicTree"]


Matrices = tuple[Array, Array]  # M and M⁻¹ f


def _by_plucker_matrices(tree: Any, _: Matrices) -> Matrices:
    links = tree.linkage.links
    inertias = [trees.MassCOMinertia2T66(link.mass, link.centre, link.inertia) for link in links]
    poses = [utilities.HT2T66Inverse(pose_of(link)) for link in links]
    own = trees.KinematicTree66(
        [short_type(link) for link in links], poses, inertias, [link.parent for link in links],
        tree.model.gravity.tolist(),
    )  # fmt: skip
    return _of_python(own, tree)


def _by_vectors(tree: Any, _: Matrices) -> Matrices:
    links = tree.linkage.links
    about_joints = [
        x.inertia + x.mass * (x.centre @ x.centre * np.eye(3) - np.outer(x.centre, x.centre)) for x in links
    ]
    own = trees.KinematicTree33(
        [short_type(x) for x in links], [x.axes_in_parent for x in links], [x.offset for x in links],
        about_joints, [x.centre for x in links], [x.mass for x in links], [x.parent for x in links],
        tree.model.gravity.tolist(),
    )  # fmt: skip
    return _of_python(own, tree)


def _by_robot(tree: Any, _: Matrices) -> Matrices:
    return _of_python(robot_of(tree.linkage.links, tree.model.gravity).GetKinematicTree66(), tree)


def _of_python(own: Any, tree: Any) -> Matrices:
    M, bias = own.ComputeMassMatrixAndForceTerms(np.zeros(own.Size()), tree.initial_angle_rates)
    # The matrix of a tree that leaves masses out may be singular: the smallest accelerations are its own.
    return np.array(M), -np.linalg.lstsq(M, bias, rcond=None)[0]


def _by_step(run: Callable[[Any, Any], bool]) -> Callable[[Any, Matrices], Matrices]:
    """F = M a with the a of one long step of Euler's method."""

    def evaluate(tree: Any, matrices: Matrices) -> Matrices:
        settings, before = make_settings(), tree.initial_angle_rates
        set_explicit_method(settings, "ExplicitEuler")
        set_linear_solver(settings, "EigenSparse")  # EXUdense loses digits (docs/integrators.md)
        settings.timeIntegration.numberOfSteps = 1
        settings.timeIntegration.endTime = LONG_STEP
        data = tree.mbs.systemData
        if not run(tree.mbs, settings):
            raise EngineFailure("Exudyn's step of Euler's method failed")
        after = np.array(data.GetODE2Coordinates_t())
        data.SetODE2Coordinates(0 * after)
        data.SetODE2Coordinates_t(before)
        return matrices[0], (after - before) / LONG_STEP

    return evaluate


def _run_by_parts(parts: str) -> Callable[[Any, Any], bool]:
    """Take the step by these parts of a solver."""

    def run(mbs: Any, settings: Any) -> bool:
        solver: Any = exudyn.MainSolverExplicit()
        with initialized_solver(solver, mbs, settings):
            solver.it.currentStepSize, solver.it.currentStepIndex = LONG_STEP, 1
            return False not in call_parts(solver, parts, mbs, settings)

    return run


EULER: Any = exudyn.DynamicSolverType.ExplicitEuler
BEGIN, BY_NEWTON = "UpdateCurrentTime InitializeStep", "UpdateCurrentTime InitializeStep Newton FinishStep"
STEPS: Mapping[str, Callable[[Any, Any], bool]] = {
    "SolveDynamic": lambda mbs, settings: bool(exudyn.SolveDynamic(mbs, settings, solverType=EULER)),
    "MainSystem.SolveDynamic": lambda mbs, settings: bool(mbs.SolveDynamic(settings, solverType=EULER)),
    f"DynamicSolverType.ExplicitEuler {texts(EXPLICIT, BY_NEWTON)}": _run_by_parts(BY_NEWTON),
    f"{EXPLICIT}.DiscontinuousIteration": _run_by_parts(f"{BEGIN} DiscontinuousIteration FinishStep"),
    f"{EXPLICIT}.SolveSteps": _run_by_parts("SolveSteps"),
}


def _grounded(add: Callable[..., Any]) -> Callable[..., None]:
    """Springs, dampers and efforts of coordinates, one by one, against a grounded node."""

    def add_all(mbs: Any, node: Any, a: Array, c: Array, k: Array, force: Array) -> None:
        fixed = grounded_marker(mbs)
        for link in np.flatnonzero((c != 0) | (k != 0)):
            markers = [fixed, coordinate_marker(mbs, node, int(link))]
            add(mbs, markerNumbers=markers, stiffness=float(k[link]), damping=float(c[link]))
        _add_rest(mbs, node, a, force)

    return add_all


def _add_rest(mbs: Any, node: Any, a: Array, force: Array) -> None:
    for link in np.flatnonzero(force):
        marker = coordinate_marker(mbs, node, int(link))
        mbs.AddLoad(items.LoadCoordinate(markerNumber=marker, load=float(force[link])))
    if np.any(a):
        mbs.AddObject(items.ObjectGenericODE2(nodeNumbers=[node], massMatrix=np.diag(a)))


def _law_of(c: Array, k: Array, force: Array) -> Callable[..., list[float]]:
    """What acts on coordinates, as a function of a system or an item."""

    def law(mbs: Any, t: float, item: int, q: Any, rates: Any) -> list[float]:
        return [float(x) for x in force - k * np.array(q) - c * np.array(rates)]

    return law


def _generic_by_functions(mbs: Any, node: Any, a: Array, c: Array, k: Array, force: Array) -> None:
    given = {"forceUserFunction": _law_of(c, k, force), "massMatrixUserFunction": lambda *_: np.diag(a)}
    mbs.AddObject(items.ObjectGenericODE2(nodeNumbers=[node], **given))


def _load_by_function(mbs: Any, node: Any, a: Array, c: Array, k: Array, force: Array) -> None:
    law_of_all = _law_of(c, k, force)
    for link in range(len(a)):
        marker = coordinate_marker(mbs, node, link)

        def law(mbs: Any, t: float, load: float, link: int = link) -> float:
            data = mbs.systemData
            return law_of_all(mbs, t, 0, data.GetODE2Coordinates(), data.GetODE2Coordinates_t())[link]

        mbs.AddLoad(items.LoadCoordinate(markerNumber=marker, load=0.0, loadUserFunction=law))
    _add_rest(mbs, node, a, 0 * force)


def _tree_by_function(mbs: Any, node: Any, a: Array, c: Array, k: Array, force: Array) -> None:
    """Give the tree, the first object, a function of its generalised forces."""
    tree = mbs.GetObjectNumber(mbs.GetObject(0)["name"])
    mbs.SetObjectParameter(tree, "forceUserFunction", _law_of(c, k, force))
    _add_rest(mbs, node, a, 0 * force)


def _usual_tree(mbs: Any, links: Sequence[Any], gravity: Array, rates: Array) -> tuple[Any, Any]:
    zeros, module = [0.0] * len(links), cast("Any", exudyn)
    matrices, vectors = module.Matrix3DList, module.Vector3DList
    given = {
        "referenceCoordinates": zeros,
        "initialCoordinates": zeros,
        "initialCoordinates_t": rates.tolist(),
    }
    node = mbs.AddNode(items.NodeGenericODE2(**given, numberOfODE2Coordinates=len(links)))
    tree = items.ObjectKinematicTree(
        nodeNumber=node,
        gravity=gravity.tolist(),
        jointTypes=[link.joint for link in links],
        linkParents=[link.parent for link in links],
        jointTransformations=matrices([link.axes_in_parent for link in links]),
        jointOffsets=vectors([link.offset for link in links]),
        linkInertiasCOM=matrices([link.inertia for link in links]),
        linkCOMs=vectors([link.centre for link in links]),
        linkMasses=[link.mass for link in links],
    )
    return node, mbs.AddObject(tree)


def _usual_elements(mbs: Any, node: Any, a: Array, c: Array, k: Array, force: Array) -> None:
    matrices = {"massMatrix": np.diag(a), "dampingMatrix": np.diag(c), "stiffnessMatrix": np.diag(k)}
    mbs.AddObject(items.ObjectGenericODE2(nodeNumbers=[node], **matrices, forceVector=force))


@dataclass(frozen=True)
class TreeChange:
    """What is done otherwise; as it stands nothing."""

    add_tree: Callable[..., tuple[Any, Any]] = _usual_tree  # of a system, links, gravity and rates
    # of a system, node, rotors, dampers, springs and forces
    add_elements: Callable[..., None] = _usual_elements
    matrices: Callable[[Any, Matrices], Matrices] = lambda _, matrices: matrices
    ways: Ways = field(default_factory=dict)


def _is_plain(model: Model) -> bool:
    """Whether nothing but gravity acts on a mechanism."""
    return not (model.has_elements or model.has_loads or model.has_drag or len(model.spring_body))


def _is_serial(model: Model) -> bool:
    return _is_plain(model) and np.array_equal(model.body[:, 0], np.arange(model.n) - 1)


_option = variants_of("option", TreeChange, is_open)
_spelling = variants_of("spelling", TreeChange, is_open)
HAS_ELEMENTS = has("stiffness", "damping")
CONNECTORS = "CoordinateSpringDamper", "CoordinateSpringDamperExt"

VARIANTS = (
    _spelling("MainSystem.CreateKinematicTree rigidBodyUtilities.TreeLink", add_tree=_add_by_tree_links),
    _spelling("robotics.Robot robotics.RobotLink", add_tree=_add_robot),
    _option(
        "kinematicTree.KinematicTree66 kinematicTree.CRM kinematicTree.CRF "
        "kinematicTree.JointTransformMotionSubspace66 kinematicTree.MassCOMinertia2T66",
        _is_plain,
        matrices=_by_plucker_matrices,
    ),
    variants_of("vectors", TreeChange, both(is_open, _is_plain))(
        "kinematicTree.KinematicTree33 kinematicTree.JointTransformMotionSubspace", matrices=_by_vectors
    ),
    _option("kinematicTree.Inertia2T66", _is_serial, matrices=_by_robot),
    *(_option(names, matrices=_by_step(run)) for names, run in STEPS.items()),
    *(
        _spelling(f"itemInterface.{name} itemInterface.ObjectConnector{name}", HAS_ELEMENTS,
                  add_elements=_grounded(partial(add_plain, name)))
        for name in CONNECTORS
    ),
    *(
        _spelling(f"itemInterface.ObjectConnector{name}SpringForceUserFunction", HAS_ELEMENTS,
                  add_elements=_grounded(by_function(name, "springForceUserFunction", spring_law)))
        for name in CONNECTORS
    ),
    *(
        _spelling(names, suits, add_elements=add)
        for names, add, suits in (
            ("itemInterface.ObjectGenericODE2ForceUserFunction "
             "itemInterface.ObjectGenericODE2MassMatrixUserFunction", _generic_by_functions, HAS_ELEMENTS),
            ("itemInterface.ObjectKinematicTreeForceUserFunction", _tree_by_function, HAS_ELEMENTS),
            ("itemInterface.LoadCoordinateLoadUserFunction itemInterface.MarkerNodeCoordinate",
             _load_by_function, HAS_ELEMENTS),
            ("itemInterface.LoadCoordinate itemInterface.NodePointGround",
             _grounded(partial(add_plain, "ObjectConnectorCoordinateSpringDamper")), has("effort")),
        )
    ),
    *of_ways(_spelling, "LoadVectorUserFunction"),
)  # fmt: skip
