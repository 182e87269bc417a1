"""Parts shared by both Exudyn formulations: settings, loads at a centre of mass, a run with its checks."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from inspect import Parameter, signature
from typing import Any

import exudyn
import numpy as np

from plumbline.engines.metamorphic_hooks import MetamorphicHooks
from plumbline.model.datatypes import Array, EngineFailure, Float, Model

Sample = tuple[Array, ...]
items: Any = exudyn.itemInterface  # its constructors are untyped
Output: Any = exudyn.OutputVariableType
IMPLICIT, EXPLICIT = "MainSolverImplicitSecondOrder", "MainSolverExplicit"

Ways = Mapping[str, Callable[..., Any]]  # by kind of item what adds one in another way, with its parameters


def add_plain(kind: str, mbs: Any, **given: Any) -> Any:
    """Add a load, connector or joint of a kind."""
    add = mbs.AddLoad if kind in LOADS else mbs.AddObject
    return add(getattr(items, kind)(**given))


def add_item(mbs: Any, ways: Ways, kind: str, **given: Any) -> Any:
    """Add the same, in another way where there is one."""
    return ways.get(kind, partial(add_plain, kind))(mbs, **given)


def change_item(mbs: Any, kind: str, number: Any, modifies: bool, **given: Any) -> None:
    """Change parameters of an item: one by one, or with all others but those for drawing."""
    if modifies:
        item = getattr(mbs, f"Get{kind}")(number)
        own = {name: value for name, value in item.items() if not name.startswith("V") and "HT" not in name}
        getattr(mbs, f"Modify{kind}")(number, own | given)
        return
    for name, value in given.items():
        getattr(mbs, f"Set{kind}Parameter")(number, name, value)


def of_module_and_system(mbs: Any, name: str) -> Mapping[str, Callable[..., Any]]:
    """A function that the module has and systems have as well, by its names."""
    return {name: partial(getattr(exudyn, name), mbs), f"MainSystem.{name}": getattr(mbs, name)}


def texts(owner: str, *names: str) -> str:
    """The names of a class or module in one text."""
    return " ".join(f"{owner}.{name}" for name in " ".join(names).split())


LOADS = ("LoadForceVector", "LoadTorqueVector", "Force", "Torque")
NEWTON_TOLERANCE = 1e-12  # relative and absolute; at the engine's defaults extrapolation stops at 2e-9
MAX_NEWTON_TOLERANCE = 1e-10  # where positions of bodies far away are rounded more coarsely than the other

NO_TOLERANCE = 1e30


class ExudynAdapter(MetamorphicHooks):
    """Declarations common to all columns of Exudyn."""

    package = "exudyn"
    supported_versions = ">=1.7,<2"  # of 1.7 states only: it cannot call a function after each step
    extra_requirements = (("<1.9", "numpy<2"),)  # beside NumPy 2 every array reads as zeros

    def version(self) -> str:
        """Return the version of the Exudyn that is loaded."""
        config = getattr(exudyn, "config", None)  # since 1.10
        return str(exudyn.GetVersionString() if config is None else config.Version())


def make_system() -> tuple[Any, Any]:
    """Make an empty system.

    Returns:
        The system, and the container that keeps it alive.

    """
    container = exudyn.SystemContainer()
    return container.AddSystem(), container


def make_settings() -> Any:
    """Make settings with fixed steps, Newton iterations to `NEWTON_TOLERANCE` and no files."""
    settings: Any = exudyn.SimulationSettings()
    _write_no_files(settings)
    time = settings.timeIntegration
    time.verboseMode = 0
    time.adaptiveStep = False
    time.automaticStepSize = False
    time.newton.absoluteTolerance = time.newton.relativeTolerance = NEWTON_TOLERANCE
    time.newton.maxIterations = 100  # its Jacobian leaves out C_qᵀλ's, so that taut rods converge linearly
    return settings


def make_evaluation_settings() -> Any:
    """Make settings for single evaluations, without initial accelerations."""
    settings = make_settings()
    settings.timeIntegration.generalizedAlpha.computeInitialAccelerations = False
    return settings


def add_loads(
    mbs: Any, model: Model, k: int, marker: Any, ground: Any, moment: Float[Array, "3"], ways: Ways
) -> None:
    """Apply the loads of a body at its centre of mass, evaluated wherever the integrator evaluates forces.

    Drag is a damper to the ground with isotropic damping: F = -c_t ṙ, and -c_r ω in the world is -c_r ω′ in
    the body.

    Args:
        moment: the applied moment [N m] in the marker's frame, with which it turns.

    """
    if np.any(model.force[k]):
        force = model.force[k].tolist()
        add_item(mbs, ways, "LoadForceVector", markerNumber=marker, loadVector=force)
    if np.any(moment):
        given = {"markerNumber": marker, "loadVector": moment.tolist()}
        add_item(mbs, ways, "LoadTorqueVector", **given, bodyFixed=True)
    if model.drag_force[k] or model.drag_moment[k]:
        damping = np.diag(np.repeat([model.drag_force[k], model.drag_moment[k]], 3))
        given = {"markerNumbers": [ground, marker], "stiffness": np.zeros((6, 6)), "damping": damping}
        add_item(mbs, ways, "ObjectConnectorRigidBodySpringDamper", **given)


def add_point_springs(mbs: Any, model: Model, marker: Callable[[int, Array], Any], ways: Ways) -> None:
    """Add the springs and dampers between points, for which a function adds markers on bodies."""
    for i, (bodies, points) in enumerate(zip(model.spring_body, model.spring_point, strict=True)):
        add_item(
            mbs, ways, "ObjectConnectorSpringDamper",
            markerNumbers=[marker(int(body), point) for body, point in zip(bodies, points, strict=True)],
            referenceLength=float(model.spring_length[i]), stiffness=float(model.spring_stiffness[i]),
            damping=float(model.spring_damping[i]),
        )  # fmt: skip


def coordinate_marker(mbs: Any, node: Any, coordinate: int) -> Any:
    """Add a marker at a coordinate of a node."""
    return mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=coordinate))


def grounded_marker(mbs: Any) -> Any:
    """Add a marker of a coordinate that does not move."""
    return coordinate_marker(mbs, mbs.AddNode(items.NodePointGround()), 0)


def written_items(mbs: Any) -> list[tuple[str, dict[str, str]]]:
    """Return the items of a system in the order of their numbers: kind, and parameters as code."""
    found = []
    for kind in ("Node", "Object", "Marker", "Load", "Sensor"):
        for i in range(getattr(mbs.systemData, f"NumberOf{kind}s")()):
            item = getattr(mbs, f"Get{kind}")(i)
            own = [k for k in item if not k.startswith(("V", "temp", "name"))]
            own = [k for k in own if not k.endswith(("HT", "HTs", "UserFunction"))]
            found.append((kind, {k: _code(item[k]) for k in own}))
    return found


def _code(value: Any) -> str:
    """Return Python code of a parameter; numbers of items are integers."""
    if isinstance(value, np.ndarray):
        return repr(value.tolist())
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_code, value))}]"
    if isinstance(value, bool | int | float | str):
        return repr(value)
    kind = type(value).__name__
    if kind in ("Vector3DList", "Matrix3DList"):
        return f"exu.{kind}({_code([np.array(value[i]) for i in range(len(value))])})"
    if kind == "MatrixContainer":
        return _code(np.array(value.Convert2DenseMatrix()))
    return f"exu.{value}" if hasattr(value, "__members__") else repr(int(value))


def initialize(solver: Any, mbs: Any, settings: Any) -> bool:
    """Initialise a solver as usual; returns whether it succeeded."""
    return bool(solver.InitializeSolver(mbs, settings))


@contextlib.contextmanager
def initialized_solver(
    solver: Any, mbs: Any, settings: Any, by: Callable[[Any, Any, Any], bool] = initialize
) -> Iterator[None]:
    """Initialise a solver for a single evaluation, and finalise it at the end.

    Args:
        solver: one of Exudyn's main solvers, not initialised.
        mbs: the assembled system.
        by: takes these and the settings.

    Yields:
        Nothing.

    Raises:
        EngineFailure: the solver could not be initialised.

    """
    if not by(solver, mbs, settings):
        raise EngineFailure(f"Exudyn could not initialise its solver: {solver.GetErrorString()}")
    try:
        yield
    finally:
        solver.FinalizeSolver(mbs, settings)


def call_parts(solver: Any, parts: str, *given: Any) -> list[Any]:
    """Call the functions of a solver with these names in turn."""
    return [getattr(solver, part)(*given) for part in parts.split()]


def mass_matrix_and_force(solver: Any, mbs: Any) -> tuple[Float[Array, "nq nq"], Float[Array, "nq"]]:
    """Evaluate M and f of M q̈ = f, without constraints."""
    solver.ComputeMassMatrix(mbs)
    M = np.array(solver.GetSystemMassMatrix())
    solver.ComputeODE2RHS(mbs)
    return M, np.array(solver.GetSystemResidual())[: len(M)]


class _StepRecorder:
    """The function that Exudyn calls after every step: checks, samples, and carries exceptions out."""

    def __init__(
        self, sampled_steps: set[int], read_sample: Callable[[], Sample], check_step: Callable[[float], None]
    ) -> None:
        self.sampled_steps, self.read_sample, self.check_step = sampled_steps, read_sample, check_step
        self.samples, self.clock = [read_sample()], [0.0]
        self.taken = 0
        self.error: Exception | None = None

    def after_step(self, _: Any, t: float) -> bool:
        if t == 0:  # Exudyn calls once before the first step: its initial accelerations are there now
            self.samples[0] = self.read_sample()
            return True
        self.taken += 1
        try:
            self.check_step(t)
            if self.taken in self.sampled_steps:
                self.samples.append(self.read_sample())
                self.clock.append(t)
        except Exception as error:  # Exudyn would wrap it in one of its own
            self.error = error
        return self.error is None


def run_solver(
    solver: Any,
    mbs: Any,
    settings: Any,
    times: Float[Array, "samples"],
    step: float,
    read_sample: Callable[[], Sample],
    check_step: Callable[[float], None] = lambda _: None,
) -> tuple[list[Sample], Float[Array, "samples"]]:
    """Run a solver in fixed steps.

    Args:
        solver: a solver with ``SolveSystem``.
        mbs: the assembled system.
        settings: its settings; the number of steps and the end time are set here.
        times: sample times [s], multiples of the step from 0.
        step: step [s].
        check_step: called with the time after every step; may raise.

    Returns:
        The samples at ``times``, and their times [s] by the engine's own clock.

    Raises:
        EngineFailure: a step failed, or the number of steps or the final time is not what was requested
            (Exudyn reports an early stop as a success); the message ends with Exudyn's own.

    """
    steps = round(float(times[-1] / step))
    recorder = _StepRecorder(set(np.rint(times / step).astype(int).tolist()), read_sample, check_step)
    if steps == 0:
        return recorder.samples, np.array(recorder.clock)
    mbs.SetPostStepUserFunction(recorder.after_step)
    settings.timeIntegration.numberOfSteps = steps
    settings.timeIntegration.endTime = float(times[-1])
    try:
        finished = solver.SolveSystem(mbs, settings)
    except (RuntimeError, ValueError, ENGINE_ERROR) as error:
        raise EngineFailure(f"Exudyn stopped after {recorder.taken} of {steps} steps: {error}") from error
    finally:
        mbs.SetPostStepUserFunction(0)  # the recorder holds the system: together they would never be freed
    if recorder.error is not None:
        raise recorder.error
    end = mbs.systemData.GetTime()
    if not finished or recorder.taken != steps or abs(end - times[-1]) > 1e-9 * times[-1]:
        message = " ".join(str(solver.GetErrorString()).split()) or "no reason given"
        raise EngineFailure(
            f"Exudyn stopped at t = {end} s after {recorder.taken} steps, "
            f"asked for {steps} to {times[-1]} s: {message}"
        )
    return recorder.samples, np.array(recorder.clock)


# -- calls that differ between versions --------------------------------------------------------------

ENGINE_ERROR: type[Exception] = getattr(exudyn, "ExudynError", RuntimeError)  # its own errors, since 1.12


@contextlib.contextmanager
def silence_engine() -> Iterator[None]:
    """Run in a scratch working directory without console output: Exudyn writes to both.

    Yields:
        Nothing.

    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch, contextlib.chdir(scratch):
        if not hasattr(exudyn, "config"):  # before 1.10; the earlier setting cannot be read
            exudyn.SetWriteToConsole(False)
            exudyn.SuppressWarnings(True)
            yield
            return
        before = exudyn.config.printToConsole, exudyn.config.suppressWarnings
        exudyn.config.printToConsole, exudyn.config.suppressWarnings = False, True
        try:
            yield
        finally:
            exudyn.config.printToConsole, exudyn.config.suppressWarnings = before


def _write_no_files(settings: Any) -> None:
    if hasattr(settings, "solution"):
        settings.solution.file.write = False
        settings.solution.sensors.active = False
    else:  # before 1.12
        settings.solutionSettings.writeSolutionToFile = False
        settings.solutionSettings.sensorsStoreAndWriteFiles = False


def make_rigid_body(node: Any, mass: float, J: Float[Array, "3 3"]) -> Any:
    """Describe a body with six degrees of freedom to Exudyn.

    Args:
        node: the node that holds its coordinates.
        mass: mass [kg].
        J: inertia [kg m²] about its centre of mass, in its own axes.

    Returns:
        The item, to be added to a system.

    """
    inertia = [J[0, 0], J[1, 1], J[2, 2], J[1, 2], J[0, 2], J[0, 1]]
    return items.ObjectRigidBody(nodeNumber=node, **sizes_of_body(mass=mass, inertia=inertia))


def sizes_of_body(**sizes: Any) -> Mapping[str, Any]:
    """Name mass and inertia of a body as the version does."""
    if "mass" not in _parameters(items.ObjectRigidBody):  # before 1.12
        sizes = {f"physics{name.capitalize()}": value for name, value in sizes.items()}
    return sizes


def known_arguments(function: Callable[..., Any], given: Mapping[str, Any]) -> Mapping[str, Any]:
    """Leave out what older versions of a function have not."""
    own = getattr(function, "__func__", function)  # of a method of a system, which would be kept alive
    return {name: value for name, value in given.items() if name in _parameters(own)}


def first_known(function: Callable[..., Any], names: str, value: Any) -> Mapping[str, Any]:
    """Give a value by the first of the names that this version of a function has."""
    return dict([*known_arguments(function, dict.fromkeys(names.split(), value)).items()][:1])


def items_argument(function: Callable[..., Any], ends: Sequence[Any]) -> Mapping[str, Any]:
    """Give the items that a function connects by their name in this version."""
    return first_known(function, "itemNumbers bodyNumbers bodyOrNodeList", ends)


@cache
def _parameters(function: Callable[..., Any]) -> Mapping[str, Parameter]:
    """Return a function's parameters: every body of every system asks for them."""
    return signature(function).parameters


def kinetic_energy(mbs: Any, bodies: list[Any], quadratic_form: float) -> float:
    """Read the kinetic energy of bodies.

    Args:
        mbs: the assembled system.
        quadratic_form: ½ q̇ᵀ M q̇ [J] with the engine's mass matrix, for versions before 1.12, in which
            bodies have no such output.

    Returns:
        The energy [J].

    """
    if not hasattr(Output, "KineticEnergy"):
        return quadratic_form
    return float(np.sum([mbs.GetObjectOutputBody(body, Output.KineticEnergy) for body in bodies]))


def set_linear_solver(settings: Any, name: str) -> None:
    """Choose the linear solver.

    Args:
        name: a member of ``exudyn.LinearSolverType``.

    """
    kind = getattr(exudyn.LinearSolverType, name)
    if hasattr(settings, "linearSolver"):
        settings.linearSolver.solverType = kind
        settings.linearSolver.reuseAnalyzedPattern = True  # the same bits, 10 % quicker on ten bodies
    else:  # before 1.12
        settings.linearSolverType = kind


def set_explicit_method(settings: Any, name: str) -> None:
    """Choose an explicit method, without the accelerations at the end of a step, which nothing here reads.

    Args:
        name: a member of ``exudyn.DynamicSolverType``.

    """
    time, kind = settings.timeIntegration, getattr(exudyn.DynamicSolverType, name)
    time.absoluteTolerance = NO_TOLERANCE  # methods with an error estimate reject steps whatever is set
    if hasattr(time, "solverType"):
        time.solverType = kind
        time.explicit.computeEndOfStepAccelerations = False
    else:  # before 1.12
        time.explicitIntegration.dynamicSolverType = kind
        time.explicitIntegration.computeEndOfStepAccelerations = False
