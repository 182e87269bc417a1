"""What both Exudyn formulations share: settings, loads at a centre of mass, and a watched run."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from inspect import signature
from typing import Any, TypeVar

import exudyn
import numpy as np

from plumbline.model.datatypes import Array, EngineFailure, Model

items: Any = exudyn.itemInterface  # its constructors are untyped

Sample = TypeVar("Sample")
SUPPORTED_VERSIONS = ">=1.9,<2"
ENGINE_ERROR: type[Exception] = getattr(exudyn, "ExudynError", RuntimeError)  # its own errors, since 1.12

NEWTON_TOLERANCE = 1e-12  # relative and absolute; at the engine's defaults extrapolation stops at 2e-9


@contextlib.contextmanager
def silence_engine() -> Iterator[None]:
    """A scratch working directory and no console output: Exudyn writes to both."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch, contextlib.chdir(scratch):
        if not hasattr(exudyn, "config"):  # before 1.10; it has no way to ask what was set before
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


def make_system() -> tuple[Any, Any]:
    """An empty system and the container that keeps it alive."""
    container = exudyn.SystemContainer()
    return container.AddSystem(), container


def make_settings() -> Any:
    """Fixed steps, Newton to `NEWTON`, nothing written."""
    chosen: Any = exudyn.SimulationSettings()
    if hasattr(chosen, "solution"):
        chosen.solution.file.write = False
        chosen.solution.sensors.active = False
    else:  # before 1.12
        chosen.solutionSettings.writeSolutionToFile = False
        chosen.solutionSettings.sensorsStoreAndWriteFiles = False
    time = chosen.timeIntegration
    time.verboseMode = 0
    time.adaptiveStep = False
    time.automaticStepSize = False
    time.newton.absoluteTolerance = time.newton.relativeTolerance = NEWTON_TOLERANCE
    time.newton.maxIterations = 100  # its Jacobian leaves out C_qᵀλ's, so that taut rods converge linearly
    return chosen


def make_rigid_body(node: Any, mass: float, J: Array) -> Any:
    """A body of that mass and inertia (about its centre of mass, its own axes) on a node."""
    sizes = {"mass": mass, "inertia": [J[0, 0], J[1, 1], J[2, 2], J[1, 2], J[0, 2], J[0, 1]]}
    if "mass" not in signature(items.ObjectRigidBody).parameters:  # before 1.12
        sizes = {f"physics{name.capitalize()}": value for name, value in sizes.items()}
    return items.ObjectRigidBody(nodeNumber=node, **sizes)


def set_linear_solver(settings: Any, name: str) -> None:
    """The linear solver of that name."""
    kind = getattr(exudyn.LinearSolverType, name)
    if hasattr(settings, "linearSolver"):
        settings.linearSolver.solverType = kind
    else:  # before 1.12
        settings.linearSolverType = kind


def set_rk44(settings: Any) -> None:
    """RK44, without the accelerations at the end of a step, which nothing here reads."""
    time, kind = settings.timeIntegration, exudyn.DynamicSolverType.RK44
    if hasattr(time, "solverType"):
        time.solverType = kind
        time.explicit.computeEndOfStepAccelerations = False
    else:  # before 1.12
        time.explicitIntegration.dynamicSolverType = kind
        time.explicitIntegration.computeEndOfStepAccelerations = False


def version() -> str:
    """Version of the Exudyn that runs."""
    config = getattr(exudyn, "config", None)  # since 1.10
    return str(exudyn.GetVersionString() if config is None else config.Version())


def add_loads(mbs: Any, model: Model, k: int, marker: Any, ground: Any, moment: Array) -> None:
    """Applied force (world), moment (marker's frame, turning with it) and drag at a centre-of-mass marker.

    All are evaluated wherever the integrator evaluates forces.  Drag is a damper to the ground with
    isotropic damping: F = -c_t ṙ, and -c_r ω in the world is -c_r ω′ in the body.
    """
    if np.any(model.force[k]):
        mbs.AddLoad(items.LoadForceVector(markerNumber=marker, loadVector=model.force[k].tolist()))
    if np.any(moment):
        mbs.AddLoad(items.LoadTorqueVector(markerNumber=marker, loadVector=moment.tolist(), bodyFixed=True))
    if model.drag_force[k] or model.drag_moment[k]:
        damping = np.diag(np.repeat([model.drag_force[k], model.drag_moment[k]], 3))
        mbs.AddObject(
            items.ObjectConnectorRigidBodySpringDamper(
                markerNumbers=[ground, marker], stiffness=np.zeros((6, 6)), damping=damping
            )
        )


def run_solver(
    solver: Any,
    mbs: Any,
    settings: Any,
    times: Array,
    step: float,
    read_sample: Callable[[], Sample],
    check_step: Callable[[float], None] | None = None,
) -> list[Sample]:
    """What ``read`` finds at each of ``times``; ``watch(t)`` is called after every step and may raise.

    Raises EngineFailure with the engine's own words where a step fails, and where the number of
    steps or the final time is not the one asked for: Exudyn reports an early stop as a success.
    """
    steps = round(float(times[-1] / step))
    wanted = set(np.rint(times / step).astype(int).tolist())
    rows = [read_sample()]
    if steps == 0:
        return rows
    taken = 0
    stopped: Exception | None = None

    def after_step(mbs: Any, t: float) -> bool:
        nonlocal taken, stopped
        if t == 0:  # it is called once before the first step
            return True
        taken += 1
        try:
            if check_step is not None:
                check_step(t)
            if taken in wanted:
                rows.append(read_sample())
        except Exception as error:  # carried around the engine, which would wrap it in one of its own
            stopped = error
        return stopped is None

    mbs.SetPostStepUserFunction(after_step)
    settings.timeIntegration.numberOfSteps = steps
    settings.timeIntegration.endTime = float(times[-1])
    try:
        finished = solver.SolveSystem(mbs, settings)
    except (RuntimeError, ValueError, ENGINE_ERROR) as error:
        raise EngineFailure(f"Exudyn stopped after {taken} of {steps} steps: {error}") from error
    if stopped is not None:
        raise stopped
    end = mbs.systemData.GetTime()
    if not finished or taken != steps or abs(end - times[-1]) > 1e-9 * times[-1]:
        words = " ".join(str(solver.GetErrorString()).split()) or "no reason given"
        raise EngineFailure(
            f"Exudyn stopped at t = {end} s after {taken} steps, asked for {steps} to {times[-1]} s: {words}"
        )
    return rows
