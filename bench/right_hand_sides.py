"""One right-hand side (or step) of each implementation at the same state, as a call without arguments."""

from __future__ import annotations

from collections.abc import Callable

import exudyn
import mujoco
import numpy as np
import pinocchio as pin
from scipy import sparse
from scipy.sparse.linalg import splu

from adapters import exudyn_engine, mujoco_engine, pinocchio_engine
from adapters.exudyn_common import make_settings
from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import quaternion_rate
from reference_impl.direct import DirectSystem, solve_dense
from reference_impl.structured import StructuredSystem, component_first
from tests.helpers.random_chains import random_chain

Call = Callable[[], object]


def random_pendulum(bodies: int, rods: bool = False, seed: int = 1) -> tuple[Model, State]:
    """A random chain with full inertia tensors and offset attachments."""
    return random_chain(np.random.default_rng(seed), [rods] * bodies)


def structured_call(model: Model, state: State, batch: int = 1) -> Call:
    """The reference's structured form; ``batch`` chains in one call, each at a state of its own."""
    forest = StructuredSystem([model]).repeated(batch)
    q, v = (
        np.tile(x, batch)
        for x in (
            component_first(state.r, state.p),
            component_first(state.v, quaternion_rate(state.p, state.omega)),
        )
    )
    v = v * np.repeat(np.linspace(0.9, 1.1, batch), model.n)
    return lambda: forest.acceleration(q, v)


def direct_call(model: Model, state: State) -> tuple[sparse.csc_matrix, Array, Call]:
    """The direct form: S (sparse) and b assembled, and the banded solve of a state from scratch."""
    system, pdot = DirectSystem(model), quaternion_rate(state.p, state.omega)
    values, b, *_ = system._entries(state.r, state.p, state.v, pdot)
    S = sparse.csc_matrix((values, (system._i, system._j)), shape=(system.size, system.size))
    return S, b, lambda: system.solve(state.r, state.p, state.v, pdot)


def superlu_call(S: sparse.csc_matrix, b: Array) -> Call:
    """Sparse LU of the same S: factor and solve only, S handed over assembled and in SuperLU's format."""
    return lambda: splu(S).solve(b)


def dense_call(S: sparse.csc_matrix, b: Array) -> Call:
    """The dense direct form: factor, solve and one refinement, S handed over assembled."""
    matrix = S.toarray()
    return lambda: solve_dense(matrix, b)


def mujoco_forward_call(model: Model, state: State) -> Call:
    """MuJoCo's mj_forward."""
    held = mujoco_engine._MujocoChain(model)
    held.set_state(state)
    return lambda: mujoco.mj_forward(held.m, held.d)


def pinocchio_aba_call(model: Model, state: State) -> Call:
    """Pinocchio's aba."""
    held = pinocchio_engine.PinocchioChain(model, "aba")
    q, v = held.coordinates(state)
    return lambda: pin.aba(held.pin_model, held.data, q, v, held.zero_torque)


def exudyn_steps_call(model: Model, state: State, step: float = 1e-4, count: int = 10) -> tuple[Call, int]:
    """Exudyn's trapezoidal steps, ``count`` to a call; a step is some two right-hand sides and a Jacobian."""
    held = exudyn_engine.ExudynChain(model, state)
    chosen = make_settings()
    chosen.linearSolver.solverType = exudyn.LinearSolverType.EigenSparse
    alpha = chosen.timeIntegration.generalizedAlpha
    alpha.useNewmark = alpha.useIndex2Constraints = True
    chosen.timeIntegration.numberOfSteps = count
    chosen.timeIntegration.endTime = count * step
    return lambda: held.mbs.SolveDynamic(chosen), count
