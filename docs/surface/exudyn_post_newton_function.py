"""Exudyn (1.13.6 and before): PostNewton looks for the function of the residual.

CSolverImplicitSecondOrderTimeIntUserFunction::PostNewton asks whether a function was set for
ComputeNewtonResidual, and calls the one that was set for PostNewton.  So a function for PostNewton alone is
never called, and a function for ComputeNewtonResidual alone ends the step with bad_function_call.
"""

import exudyn

exudyn.config.printToConsole = False
kinds = exudyn.itemInterface
calls = []


def post_newton(solver, mbs, settings):
    """Accept the step."""
    calls.append("PostNewton")
    return 0.0


def residual(solver, mbs, settings):
    """Say that Newton's method has converged."""
    calls.append("ComputeNewtonResidual")
    return 0.0


for names in (["PostNewton"], ["ComputeNewtonResidual"], ["ComputeNewtonResidual", "PostNewton"]):
    container = exudyn.SystemContainer()
    mbs = container.AddSystem()
    node = mbs.AddNode(kinds.NodePoint(initialVelocities=[1.0, 0.0, 0.0]))
    mbs.AddObject(kinds.ObjectMassPoint(nodeNumber=node, mass=1.0))
    mbs.Assemble()
    settings = exudyn.SimulationSettings()
    settings.solution.file.write = False
    settings.timeIntegration.numberOfSteps, settings.timeIntegration.endTime = 1, 1.0
    settings.timeIntegration.adaptiveStep = False
    solver = exudyn.MainSolverImplicitSecondOrder()
    for name in names:
        function = {"PostNewton": post_newton, "ComputeNewtonResidual": residual}[name]
        getattr(solver, f"SetUserFunction{name}")(mbs, function)
    calls.clear()
    try:
        ended = f"SolveSystem returns {solver.SolveSystem(mbs, settings)}"
    except RuntimeError as error:
        ended = f"RuntimeError: {error}"
    print(f"set: {', '.join(names)}; called: {', '.join(dict.fromkeys(calls)) or 'none'}; {ended}")
