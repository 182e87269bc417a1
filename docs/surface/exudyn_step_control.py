"""Exudyn: explicit methods with an estimate of errors reject steps by the sign of coordinates.

A mass on a spring, and its mirror image, which takes another number of steps: the error is divided by
atol + rtol max(x₀, x₁) without the absolute values that Hairer, Nørsett and Wanner (Solving Ordinary
Differential Equations I, II.4) have.  And with ``automaticStepSize = False`` steps are rejected too, and the
run ends.
"""

import exudyn as exu

items = exu.itemInterface


def steps(sign, automatic=True, method="ODE23", rtol=1e-6):
    """Return the number of steps of an oscillation around sign × 2 m, or what the engine says."""
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    node = mbs.AddNode(items.Node1D(referenceCoordinates=[2.0 * sign], initialCoordinates=[0.5 * sign]))
    mbs.AddObject(items.ObjectMass1D(nodeNumber=node, mass=1.0))
    marker = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=0))
    mbs.AddLoad(items.LoadCoordinate(markerNumber=marker, load=0.3 * sign))
    ground = mbs.AddNode(items.NodePointGround())
    fixed = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=ground, coordinate=0))
    mbs.AddObject(items.CoordinateSpringDamper(markerNumbers=[fixed, marker], stiffness=4.0))
    mbs.Assemble()
    settings = exu.SimulationSettings()
    time = settings.timeIntegration
    time.verboseMode, time.numberOfSteps, time.endTime = 0, 20, 5.0
    time.automaticStepSize = time.adaptiveStep = automatic
    time.relativeTolerance = time.absoluteTolerance = rtol
    settings.solution.file.write = False
    solver = exu.MainSolverExplicit()
    time.solverType = getattr(exu.DynamicSolverType, method)
    try:
        done = solver.SolveSystem(mbs, settings)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return solver.it.currentStepIndex if done else solver.GetErrorString()


exu.config.printToConsole = False
for method in ("ODE23", "DOPRI5"):
    print(f"{method}: {steps(1, method=method)} steps, mirrored {steps(-1, method=method)}")
    print(f"{method} with automaticStepSize = False: {steps(1, False, method)}")
