"""Settings, parts and functions of Exudyn's solvers, by mass points that are pushed to the bodies' positions.

A point of mass m starts at rest in the origin.  The force m u (1 + t) pushes it, u being the direction of a
body's position and t the time [s]; in a step of 1 s every method makes of it numbers times u, which follow
from the method's formula.  The equations are linear or have the known root u, so that iterations end in
rounding; masses and sizes are the same for all mechanisms, since all points share one tolerance.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from functools import partial
from typing import Any

import exudyn
import numpy as np

from adapters.exudyn_common import (
    EXPLICIT,
    IMPLICIT,
    Output,
    call_parts,
    coordinate_marker,
    grounded_marker,
    initialized_solver,
    items,
    make_rigid_body,
    make_settings,
    make_system,
    set_explicit_method,
    set_linear_solver,
    sizes_of_body,
    texts,
)
from adapters.exudyn_variants import INITIALISATION
from adapters.surface_record import SurfaceRecord
from plumbline.engines.missing_names import add_parts
from plumbline.model.datatypes import Array, EngineFailure, Float, State
from plumbline.model.kinematics import quaternion_exponential, quaternion_product, rotation_vector
from plumbline.model.probe_frames import PROBE_TURN

AXES = np.eye(3)
PULL = 1.0  # 1/s², of the force −m x of points that are pulled back
TURN = np.array([0.3, -0.2, 0.5])  # rad, of bodies that turn for a second
TIGHT = 4e-15  # of Newton's residual, relative: a root has rounding then, and the residual's rounding is less
Factors = tuple[float, float]  # of r in places and velocities after the step


def _factors(gamma: float, beta: float, first: float = 1.0, last: float = 2.0) -> Factors:
    """Return Newmark's: of the accelerations at the start and at the end."""
    return (0.5 - beta) * first + beta * last, (1 - gamma) * first + gamma * last


NEWMARK = {"generalizedAlpha.useNewmark": True}
LINEAR = NEWMARK | {"generalizedAlpha.newmarkBeta": 1 / 6}  # exact where the acceleration is linear in t
BY_NEWMARK, EXACT = _factors(0.5, 0.25), (2 / 3, 1.5)
RUNGE_KUTTA = {"solverType": "RK44"}
LIE = "generalizedAlpha.lieGroup"


Step = tuple[str, Mapping[str, Any], Factors]
# By names of settings their values, relative to those of time integration, and what the step makes of r.
STEPS: Sequence[Step] = (
    ("GeneralizedAlphaSettings.newmarkBeta GeneralizedAlphaSettings.newmarkGamma",
     NEWMARK | {"generalizedAlpha.newmarkBeta": 0.3, "generalizedAlpha.newmarkGamma": 0.6},
     _factors(0.6, 0.3)),
    ("GeneralizedAlphaSettings.resetAccelerations",
     NEWMARK | {"generalizedAlpha.computeInitialAccelerations": False,
                "generalizedAlpha.resetAccelerations": True}, _factors(0.5, 0.25, first=0.0)),
    ("TimeIntegrationSettings.startTime", NEWMARK | {"startTime": 0.5, "endTime": 1.5},
     _factors(0.5, 0.25, 1.5, 2.5)),
    ("TimeIntegrationSettings.reuseConstantMassMatrix",
     NEWMARK | {"reuseConstantMassMatrix": False}, BY_NEWMARK),
    ("TimeIntegrationSettings.computeLoadsJacobian", NEWMARK | {"computeLoadsJacobian": 1},
     _factors(0.5, 0.25, last=(2.0 - PULL / 4) / (1 + PULL / 4))),  # a force −m x pulls besides
    ("NewtonSettings.active", NEWMARK | {"newton.active": False, "newton.maxIterations": 1},
     BY_NEWMARK),
    ("NewtonSettings.useNewtonSolver",
     NEWMARK | {"newton.useNewtonSolver": False, "newton.maxIterations": 1}, BY_NEWMARK),
    ("ExplicitIntegrationSettings.computeMassMatrixInversePerBody",
     RUNGE_KUTTA | {"explicit.computeMassMatrixInversePerBody": True}, EXACT),
    ("ExplicitIntegrationSettings.useLieGroupIntegration",
     RUNGE_KUTTA | {"explicit.useLieGroupIntegration": False}, EXACT),
    ("TimeIntegrationSettings.explicitIntegration",
     {"explicitIntegration.dynamicSolverType": "RK44",
      "explicitIntegration.computeMassMatrixInversePerBody": True}, EXACT),
    *((f"LinearSolverType.{name}", {"linear solver": name} | RUNGE_KUTTA, EXACT)
      for name in ("EigenDense", "EXUdense")),
)  # fmt: skip
# By names of Newton's settings their values, at the search for the root of a cubic equation.
ROOTS: Sequence[tuple[str, Mapping[str, Any]]] = (
    ("SolveStatic MainSystem.SolveStatic StaticSolverSettings", {}),
    ("NewtonSettings.adaptInitialResidual", {"adaptInitialResidual": True}),
    ("NewtonSettings.maximumSolutionNorm", {"maximumSolutionNorm": 1e60}),
    ("NewtonSettings.weightTolerancePerCoordinate", {"weightTolerancePerCoordinate": True}),
    ("NewtonSettings.residualMode", {"residualMode": 1}),
    ("NewtonSettings.newtonResidualMode", {"newtonResidualMode": 1}),
    ("NewtonSettings.numericalDifferentiation NumericalDifferentiationSettings",
     {"numericalDifferentiation.relativeEpsilon": 1e-6, "numericalDifferentiation.minimumCoordinateSize": 0.1,
      "numericalDifferentiation.doSystemWideDifferentiation": True}),
    ("NewtonSettings.modifiedNewtonContractivity NewtonSettings.maxModifiedNewtonIterations",
     {"useModifiedNewton": True, "modifiedNewtonContractivity": 0.1, "maxModifiedNewtonIterations": 3}),
    ("NewtonSettings.maxModifiedNewtonRestartIterations",
     {"useModifiedNewton": True, "maxModifiedNewtonRestartIterations": 2}),
    ("NewtonSettings.modifiedNewtonJacUpdatePerStep",
     {"useModifiedNewton": True, "modifiedNewtonJacUpdatePerStep": True}),
)  # fmt: skip


def _add_point(mbs: Any, mass: float) -> tuple[Any, Any]:
    """Add a mass point in the origin; return its node and a marker."""
    node = mbs.AddNode(items.NodePoint())
    mbs.AddObject(items.ObjectMassPoint(nodeNumber=node, **sizes_of_body(mass=float(mass))))
    return node, mbs.AddMarker(items.MarkerNodePosition(nodeNumber=node))


class _Points:
    """What is pushed, and what a step made of it; ``places``: directions, of ``lengths`` [m]."""

    def __init__(self, record: SurfaceRecord, places: Float[Array, "bodies 3"]) -> None:
        self.record, self.containers = record, list[Any]()
        self.lengths = np.linalg.norm(places, axis=1, keepdims=True)
        self.places = np.where(self.lengths > 0, places, AXES[0]) / np.where(
            self.lengths > 0, self.lengths, 1
        )
        self.count = len(places)
        self.mass = 1.0 + np.arange(self.count) / self.count

    def system(
        self, is_lawful: Callable[[], bool] = lambda: True, pull: float = 0.0, spring: Any = None
    ) -> Any:
        """Assemble the points; where the law of the forces fails they are no numbers after the start.

        Args:
            pull: of a force −m x that is the loads', 1/s².
            spring: adds a spring between a ground and a point, in place of the growth of the force.

        """
        mbs, container = make_system()
        ground = mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=mbs.AddObject(items.ObjectGround())))

        def law(k: int, mbs: Any, t: float, load: Any) -> list[float]:
            push = self.places[k] * (1 + t if is_lawful() or t == 0 else np.nan)
            if pull:
                push = push - pull * np.array(mbs.systemData.GetODE2Coordinates()[3 * k : 3 * k + 3])
            return [float(x) for x in self.mass[k] * push]

        for k, mass in enumerate(self.mass):
            _, marker = _add_point(mbs, mass)
            push = (self.mass[k] * self.places[k]).tolist()
            if spring is not None:
                spring(mbs, [ground, marker], k)
                mbs.AddLoad(items.LoadForceVector(markerNumber=marker, loadVector=push))
            else:
                by = {"loadVectorUserFunction": partial(law, k)}
                mbs.AddLoad(items.LoadForceVector(markerNumber=marker, loadVector=push, **by))
        mbs.Assemble()
        self.containers.append(container)  # read from after steps; 1.8 frees it with the last name for it
        return mbs

    def read(self, mbs: Any) -> tuple[Array, Array]:
        """Return places and velocities."""
        data = mbs.systemData
        x, v = (np.reshape(x, (-1, 3)) for x in (data.GetODE2Coordinates(), data.GetODE2Coordinates_t()))
        return x, v

    def add(self, names: str, directions: Any) -> None:
        """Add positions of bodies, by their directions in a row."""
        self.record.add("body_position", names, np.reshape(directions, (-1, 3)) * self.lengths)

    def add_results(self, names: str, results: Any, factors: Factors) -> None:
        """Add the mean of what places and velocities give: of results, or of a system."""
        results = results if isinstance(results, tuple) else self.read(results)
        x, v = (value / factor for value, factor in zip(results, factors, strict=True))
        self.add(names, (x + v) / 2)


# Of options that versions name otherwise.
SETTERS: Mapping[str, Callable[[Any, str], None]] = {
    "linear solver": set_linear_solver, "solverType": set_explicit_method,
    "explicitIntegration.dynamicSolverType": lambda settings, name: _set(
        settings.timeIntegration, "explicitIntegration.dynamicSolverType",
        getattr(exudyn.DynamicSolverType, name),
    ),
}  # fmt: skip


def _set(owner: Any, path: str, value: Any) -> None:
    """Set an attribute, by a path from an owner."""
    *rest, last = path.split(".")
    for name in rest:
        owner = getattr(owner, name)
    getattr(owner, last)  # a version that lacks it says so by its name
    setattr(owner, last, value)


def _set_all(owner: Any, options: Mapping[str, Any]) -> None:
    """Set options by their paths; deprecated names are options, too."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        for path, value in options.items():
            _set(owner, path, value)


def _settings(options: Mapping[str, Any]) -> Any:
    """Make settings of one step of 1 s."""
    settings = make_settings()
    settings.timeIntegration.numberOfSteps, settings.timeIntegration.endTime = 1, 1.0
    for path, set_option in SETTERS.items():
        if path in options:
            set_option(settings, options[path])
    _set_all(settings.timeIntegration, {path: x for path, x in options.items() if path not in SETTERS})
    return settings


def _solve(mbs: Any, options: Mapping[str, Any], stores: bool = False) -> None:
    """Solve by the solver that the options concern.

    Args:
        stores: whether sensors store what they read.

    """
    is_explicit = any(path.startswith(("solverType", "explicit")) for path in options)
    settings, solver = _settings(options), getattr(exudyn, EXPLICIT if is_explicit else IMPLICIT)()
    if stores:
        settings.solution.sensors.active = True
    if not solver.SolveSystem(mbs, settings):
        raise EngineFailure(f"Exudyn's solver failed: {solver.GetErrorString()}")


def add_point_answers(record: SurfaceRecord, state: State) -> None:
    """Push points to where the bodies of a state are, in all ways, and add where they come."""
    points = _Points(record, state.r)
    add_parts(
        record.found,
        *(partial(_add_step, points, *one) for one in STEPS),
        *(partial(_add_root, points, *one) for one in ROOTS),
        *(partial(part, points) for part in PARTS),
        partial(_add_turns, record, state),
    )


def _add_step(points: _Points, names: str, options: Any, factors: Factors) -> None:
    mbs = points.system(pull=PULL * ("computeLoadsJacobian" in options))
    _solve(mbs, options)
    points.add_results(names, mbs, factors)


def _add_root(points: _Points, names: str, options: Mapping[str, Any]) -> None:
    """Find the displacement x at which m (1 + |x|²) x / 2 is the load m u: it is u."""

    def spring(mbs: Any, markers: Any, k: int) -> None:
        stiffness = float(points.mass[k]) / 2

        def law(mbs: Any, t: float, item: int, x: Any, *rest: Any) -> list[float]:
            strength = stiffness * (1 + x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
            return [float(strength * one) for one in x]

        mbs.AddObject(
            items.ObjectConnectorCartesianSpringDamper(markerNumbers=markers, springForceUserFunction=law)
        )

    mbs = points.system(spring=spring)
    settings = _settings({})
    newton = settings.staticSolver.newton
    newton.relativeTolerance, newton.absoluteTolerance, newton.maxIterations = TIGHT, 1e-300, 100
    _set_all(newton, options)
    settings.staticSolver.verboseMode = 0
    mbs.SolveStatic(settings)
    points.add(names, points.read(mbs)[0])


def _add_adaptive_steps(points: _Points) -> None:
    """Let the force fail at first, so that steps are reduced, and later increased again."""
    adaptive = LINEAR | {"adaptiveStep": True, "adaptiveStepRecoverySteps": 1}
    settings = (
        "adaptiveStepDecrease adaptiveStepIncrease adaptiveStepRecoverySteps adaptiveStepRecoveryIterations"
    )
    for names, options, failures, step, time in (
        (settings, {"adaptiveStepDecrease": 0.3, "adaptiveStepIncrease": 1.5,
                    "adaptiveStepRecoveryIterations": 50}, 1, 2, 0.3 * 2.5),
        ("minimumStepSize", {"adaptiveStepDecrease": 0.1, "minimumStepSize": 0.05}, 2, 1, 0.05),
    ):  # fmt: skip
        trials = list[float]()

        def count(mbs: Any, t: float, trials: list[float] = trials) -> bool:
            trials.append(t)
            return True

        mbs = points.system(is_lawful=lambda: len(trials) > failures)  # noqa: B023
        mbs.SetPreStepUserFunction(count)
        found = _after_step(points, mbs, adaptive | options, step)
        points.add_results(texts("TimeIntegrationSettings", names), found, _exact(time))


def _exact(t: float) -> Factors:
    """What the force makes of r in a time."""
    return t**2 / 2 + t**3 / 6, t + t**2 / 2


def _after_step(points: _Points, mbs: Any, options: Mapping[str, Any], step: int) -> tuple[Array, Array]:
    """Solve, and return places and velocities after so many steps."""
    found = list[tuple[Array, Array]]()

    def read(mbs: Any, t: float) -> bool:
        found.append(points.read(mbs))
        return True

    mbs.SetPostStepUserFunction(read)
    _solve(mbs, options)
    mbs.SetPostStepUserFunction(0)
    return found[step]  # the first is before the first step


def _add_automatic_steps(points: _Points) -> None:
    """Add the second step, as it follows from the error of the first by the formula of Hairer and Wanner.

    The two methods of ODE23 give one velocity and the displacements u (h² / 2 + h³ / 6) and
    u (h² / 2 + 3 h³ / 16) in the first step h.  Signs are put back afterwards, since steps depend on them
    (docs/surface/exudyn_step_control.py).
    """
    h, safety, growth, tolerance = 0.375, 0.3, 1.5, 0.25
    own = copy(points)
    own.places = np.abs(points.places)
    options = {"automaticStepSize": True, "initialStepSize": h, "stepSizeSafety": safety}
    error = h / 48 / (tolerance * (0.5 + 3 * h / 16)) * np.sqrt(np.mean(own.places > 0) / 2)
    by_error = h * safety * error ** (-1 / 3) if error else 0.0
    for names, second, more in (
        ("initialStepSize stepSizeMaxIncrease", growth * h,
         {"stepSizeMaxIncrease": growth, "absoluteTolerance": 1e30}),
        ("stepSizeSafety relativeTolerance", by_error,
         {"stepSizeMaxIncrease": 1e3, "absoluteTolerance": 1e-300, "relativeTolerance": tolerance}),
    ):  # fmt: skip
        mbs = own.system()
        x, v = _after_step(own, mbs, {"solverType": "ODE23"} | options | more, 2)
        signs, call = np.sign(points.places), texts("TimeIntegrationSettings", names)
        points.add_results(call, (signs * x, signs * v), _exact(h + second))


@contextmanager
def _initialized(
    points: _Points, options: Mapping[str, Any], kind: str = IMPLICIT, pull: float = 0.0
) -> Iterator[tuple[Any, Any, Any]]:
    """Initialise a solver for one step of 1 s."""
    mbs, settings, solver = points.system(pull=pull), _settings(options), getattr(exudyn, kind)()
    with initialized_solver(solver, mbs, settings):
        solver.it.currentStepSize, solver.it.currentStepIndex = 1.0, 1
        yield solver, mbs, settings


def _add_parts_of_a_step(points: _Points) -> None:
    """Take a step of generalised-α by its parts, with the parameters that the solver says."""
    with _initialized(points, {"generalizedAlpha.spectralRadius": 0.7}) as (solver, mbs, settings):
        call_parts(solver, "UpdateCurrentTime InitializeStep", mbs, settings)
        solver.ComputeNewtonUpdate(mbs, settings, True)
        x, v = points.read(mbs)
        call_parts(solver, "ComputeNewtonResidual ComputeNewtonJacobian", mbs, settings)
        change = np.linalg.solve(solver.GetSystemJacobian(), solver.GetSystemResidual()).reshape(x.shape)
        beta, gamma, radius = solver.newmarkBeta, solver.newmarkGamma, solver.spectralRadius
        forward = (solver.alphaF - solver.alphaM) / (1 - radius / (radius + 1) + (1 - radius) / (radius + 1))
        factors = _factors(gamma, beta, last=2 * solver.factJacAlgorithmic + forward)
        by = (
            "UpdateCurrentTime InitializeStep ComputeNewtonUpdate ComputeNewtonResidual ComputeNewtonJacobian"
        )
        own = "alphaF alphaM factJacAlgorithmic newmarkBeta newmarkGamma spectralRadius"
        ends = x - change, v - gamma / beta * change
        points.add_results(texts(IMPLICIT, f"{by} {own}"), ends, factors)


def _add_whole_steps(points: _Points) -> None:
    """Take a step by the solver's function, and read what Newton's method and generalised-α keep."""
    af, am, kept = 0.7 / 1.7, 0.4 / 1.7, list[Array]()
    last = (2 * (1 - af) + af - am) / (1 - am)
    gamma = 0.5 + af - am
    beta = (gamma + 0.5) ** 2 / 4
    with _initialized(points, {"generalizedAlpha.spectralRadius": 0.7}) as (solver, mbs, settings):
        settings.timeIntegration.generalizedAlpha.computeInitialAccelerations = True

        def after(mbs: Any, t: float) -> bool:
            kept.append(np.array(solver.GetStartOfStepStateAAlgorithmic()))
            return True

        mbs.SetPostStepUserFunction(after)
        solver.SolveSteps(mbs, settings)
        mbs.SetPostStepUserFunction(0)
        factors = _factors(gamma, beta, last=last)
        points.add_results(f"{IMPLICIT}.SolveSteps", mbs, factors)
        for name, value in (
            ("GetStartOfStepStateAAlgorithmic", kept[-1]),
            ("GetAAlgorithmic", np.array(solver.GetAAlgorithmic()) / last),
            ("GetNewtonSolution", -np.array(solver.GetNewtonSolution()) / (2 * beta * (1 - af) / (1 - am))),
        ):
            points.add(texts(IMPLICIT, name), value)


def _add_changed_newton(points: _Points) -> None:
    """Let Newton's method end after one iteration, by what the solver keeps of its settings."""
    last = 2.0 - PULL * (0.5 - 0.25)  # where the place was not changed by the last acceleration yet
    with _initialized(points, NEWMARK, pull=PULL) as (solver, mbs, settings):
        newton = solver.newton
        _set(newton, "active", False)
        solver.newton = newton
        solver.SolveSteps(mbs, settings)
        factors = _factors(0.5, 0.25, last=last)
        points.add_results(f"{IMPLICIT}.newton", mbs, factors)


def _add_changed_steps(points: _Points) -> None:
    """Take a step of another size, and give the solver a mass matrix."""
    for kind, options, by, reduced in (
        (IMPLICIT, LINEAR, "InitializeStep Newton FinishStep", 0.5), (EXPLICIT, RUNGE_KUTTA, "", 1.0),
    ):  # fmt: skip
        for name, start, end, arguments in (
            ("ReduceStepSize", 1.0, reduced, (1,)), ("IncreaseStepSize", 0.25, 0.5, ()),
        ):  # fmt: skip
            with _initialized(points, options, kind) as (solver, mbs, settings):
                solver.it.currentStepSize = start
                getattr(solver, name)(mbs, settings, *arguments)
                call_parts(solver, "UpdateCurrentTime InitializeStep Newton FinishStep", mbs, settings)
                points.add_results(texts(kind, f"{name} {by}"), mbs, _exact(end))
        with _initialized(points, options, kind) as (solver, *_):
            solver.SetSystemMassMatrix(np.diag(points.places.ravel()))
            points.add(f"{kind}.SetSystemMassMatrix", np.diag(solver.GetSystemMassMatrix()))


def _add_own_functions(points: _Points) -> None:
    """Take steps of which functions in Python are parts."""
    ends, masses = list[tuple[Array, Array]](), np.repeat(points.mass, 3)

    def finish(solver: Any, mbs: Any, settings: Any) -> bool:
        ends.append(points.read(mbs))
        return True

    for functions in (
        {"UpdateCurrentTime": _own_time}, {"InitializeStep": _own_begin}, {"FinishStep": finish},
        {"Newton": partial(_own_newton, masses)}, {"ComputeNewtonUpdate": _own_update},
        # without PostNewton the residual fails: docs/surface/exudyn_post_newton_function.py
        {"ComputeNewtonResidual": _own_residual, "ComputeNewtonJacobian": partial(_own_jacobian, masses),
         "PostNewton": lambda *_: 0.0},
    ):  # fmt: skip
        with _initialized(points, LINEAR) as (solver, mbs, settings):
            for name, function in functions.items():
                getattr(solver, f"SetUserFunction{name}")(mbs, function)
            solver.SolveSteps(mbs, settings)
        found = ends[-1] if "FinishStep" in functions else mbs
        names = " ".join(f"SetUserFunction{name}" for name in functions if name != "PostNewton")
        points.add_results(texts(IMPLICIT, names), found, EXACT)


def _own_time(solver: Any, mbs: Any, settings: Any) -> bool:
    solver.it.currentTime = solver.it.currentStepIndex * solver.it.currentStepSize
    return True


def _own_begin(solver: Any, mbs: Any, settings: Any) -> bool:
    solver.UpdateCurrentTime(mbs, settings)
    mbs.systemData.SetTime(solver.it.currentTime)
    return True


def _own_newton(masses: Array, solver: Any, mbs: Any, settings: Any) -> bool:
    data = mbs.systemData
    before = np.array(data.GetODE2Coordinates_tt())
    solver.ComputeODE2RHS(mbs)
    after = np.array(solver.GetSystemResidual()) / masses
    data.SetODE2Coordinates(before / 3 + after / 6)
    data.SetODE2Coordinates_t(before / 2 + after / 2)
    return True


def _own_update(solver: Any, mbs: Any, settings: Any, initial: bool) -> bool:
    data, beta, gamma = mbs.systemData, solver.newmarkBeta, solver.newmarkGamma
    q, v, a = (np.array(getattr(data, f"GetODE2Coordinates{x}")()) for x in ("", "_t", "_tt"))
    change = np.array(solver.GetNewtonSolution())
    ends = (
        (v + (0.5 - beta) * a, v + (1 - gamma) * a, 0 * a)
        if initial
        else (q - change, v - gamma / beta * change, a - change / beta)
    )
    for name, value in zip(("", "_t", "_tt"), ends, strict=True):
        getattr(data, f"SetODE2Coordinates{name}")(value)
    return True


def _own_residual(solver: Any, mbs: Any, settings: Any) -> float:
    solver.ComputeODE2RHS(mbs)  # which writes the force, of the other sign
    return 0.0 if np.any(mbs.systemData.GetODE2Coordinates_tt()) else 1.0


def _own_jacobian(masses: Array, solver: Any, mbs: Any, settings: Any) -> bool:
    solver.SetSystemJacobian(np.diag(-masses / solver.newmarkBeta))
    return True


def _add_initialisation(points: _Points) -> None:
    """Initialise an explicit solver, and call the parts of it again."""
    parts = INITIALISATION.replace(" InitializeSolverOutput", "")
    with _initialized(points, RUNGE_KUTTA, EXPLICIT) as (solver, mbs, settings):
        call_parts(solver, f"InitializeSolverPreChecks {parts}", mbs, settings)
        solver.SolveSteps(mbs, settings)
    names = texts(EXPLICIT, f"InitializeSolverPreChecks {parts}")
    points.add_results(names, mbs, EXACT)


def _add_stored(points: _Points) -> None:
    """Read the velocities after a step from what sensors stored."""
    mbs = points.system()
    velocity = {"outputVariableType": Output.Velocity, "writeToFile": False, "storeInternal": True}
    nodes = range(points.count)
    sensors = [mbs.AddSensor(items.SensorNode(nodeNumber=node, **velocity)) for node in nodes]
    mbs.Assemble()
    _solve(mbs, LINEAR, stores=True)
    stored = np.array([mbs.GetSensorStoredData(sensor)[-1] for sensor in sensors])  # time and values
    points.add("MainSystem.GetSensorStoredData", stored[:, 1:] / EXACT[1])


def _add_held(points: _Points) -> None:
    """Hold a point beside each, which is pushed as much, by the constraint of its coordinates."""
    mbs, _container = make_system()
    fixed = grounded_marker(mbs)
    for is_held in (False, True):
        for place, mass in zip(points.places, points.mass, strict=True):
            node, marker = _add_point(mbs, mass)
            mbs.AddLoad(items.LoadForceVector(markerNumber=marker, loadVector=(mass * place).tolist()))
            for i in range(3 * is_held):
                own = coordinate_marker(mbs, node, i)
                mbs.AddObject(items.CoordinateConstraint(markerNumbers=[fixed, own]))
    mbs.Assemble()
    settings, solver = _settings({}), exudyn.MainSolverImplicitSecondOrder()
    _set(settings.timeIntegration, "generalizedAlpha.storeInitialAlgebraicCoordinates", True)
    with initialized_solver(solver, mbs, settings):
        force = np.array(mbs.systemData.GetAECoordinates()).reshape(-1, 3)
    of_item = "itemInterface.CoordinateConstraint"
    call = f"GeneralizedAlphaSettings.storeInitialAlgebraicCoordinates {of_item}"
    points.add(call, force / points.mass[:, None])
    _solve(mbs, RUNGE_KUTTA | {"explicit.eliminateConstraints": True})
    velocities = np.array(mbs.systemData.GetODE2Coordinates_t()).reshape(2, -1, 3)
    points.add(f"ExplicitIntegrationSettings.eliminateConstraints {of_item}", np.sum(velocities, axis=0))


PARTS: Sequence[Callable[[_Points], None]] = (
    _add_adaptive_steps, _add_automatic_steps, _add_parts_of_a_step, _add_whole_steps, _add_changed_newton,
    _add_changed_steps, _add_own_functions, _add_initialisation, _add_stored, _add_held,
)  # fmt: skip


def _add_turns(record: SurfaceRecord, state: State) -> None:
    """Turn spheres by a second, from where they come to the attitudes of the bodies, by Lie group nodes."""
    before = [quaternion_product(p, quaternion_exponential(-TURN / 2)) for p in state.p]
    simplified = "GeneralizedAlphaSettings.lieGroupSimplifiedKinematicRelations"
    for names, options in (
        (f"{simplified} GeneralizedAlphaSettings.lieGroupAddTangentOperator",
         {f"{LIE}SimplifiedKinematicRelations": True, f"{LIE}AddTangentOperator": True,
          "linear solver": "EXUdense"}),
        (simplified, {f"{LIE}SimplifiedKinematicRelations": False}),
        ("ExplicitIntegrationSettings.useLieGroupIntegration",
         RUNGE_KUTTA | {"explicit.useLieGroupIntegration": True}),
    ):  # fmt: skip
        mbs, _container = make_system()
        bodies = []
        for p in before:
            given = {"referenceCoordinates": [0.0, 0, 0, *rotation_vector(p)]}
            node = mbs.AddNode(items.NodeRigidBodyRotVecLG(initialVelocities=[0.0, 0, 0, *TURN], **given))
            bodies.append(mbs.AddObject(make_rigid_body(node, 1.0, np.eye(3))))
        mbs.Assemble()
        _solve(mbs, options)
        turns = [mbs.GetObjectOutputBody(body, Output.RotationMatrix, [0.0, 0, 0]) for body in bodies]
        record.add_axes(names, np.array(turns).reshape(-1, 3, 3) @ PROBE_TURN)
