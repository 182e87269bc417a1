"""Exudyn's own accelerations at the start of an implicit run (for `test_environments`)."""

from __future__ import annotations

import exudyn

from adapters.exudyn_common import make_settings, set_linear_solver, silence_engine
from adapters.exudyn_engine import ExudynChain


def initial_accelerations(model, state, solver):
    """(N, 3) r̈ in m/s², as the implicit solver with that linear solver finds them at t = 0."""
    with silence_engine():
        chain, chosen = ExudynChain(model, state), make_settings()
        set_linear_solver(chosen, solver)
        chosen.timeIntegration.generalizedAlpha.computeInitialAccelerations = True
        stepper = exudyn.MainSolverImplicitSecondOrder()
        assert stepper.InitializeSolver(chain.mbs, chosen)
        found = chain.mbs.systemData.GetODE2Coordinates_tt().copy()
        stepper.FinalizeSolver(chain.mbs, chosen)
    return found.reshape(model.n, 7)[:, :3]
