"""One right-hand side (or step) of each implementation at the same state, as a call without arguments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import exudyn
import mujoco
import numpy as np
import pinocchio as pin
from scipy import sparse
from scipy.sparse.linalg import splu

from adapters import exudyn_engine, mujoco_engine, pinocchio_engine
from adapters.exudyn_common import make_settings
from plumbline.model.datatypes import BALL, HINGE, ROD, Array, Model, State
from plumbline.model.kinematics import maximal_coordinates
from plumbline.model.random_mechanisms import random_tree
from plumbline.model.sampling import random_states
from reference_impl.direct import DirectSystem, solve_dense
from reference_impl.fast.chain_elimination import StructuredSystem, component_first
from reference_impl.fast.tree_elimination import TreeSystem

Call = Callable[[], object]


def random_pendulum(bodies: int, rods: bool = False, seed: int = 1) -> tuple[Model, State]:
    """Draw a random chain with full inertia tensors and offset attachments.

    Args:
        rods: whether every joint is a rod; else every joint is a ball joint.

    Returns:
        The model and a state on its manifold.

    """
    drawn = random_tree(np.random.default_rng(seed), bodies, (ROD if rods else BALL,), loads=False)
    body, point = np.arange(bodies)[:, None] + [-1, 0], drawn.point.copy()
    point[0, 0] = 0.0
    model = drawn.changed(body=body, point=point)
    (state,) = random_states(model, 1, seed)
    return model, state


def hinge_tree(shape: Literal["chain", "binary tree", "star"], bodies: int) -> tuple[Model, State]:
    """Draw bodies on hinges with full inertia tensors and skew axes.

    Args:
        shape: each body on the one before; two on every body; all on the world.

    Returns:
        The model and a state of it.

    """
    far = np.full(bodies, -1) if shape == "star" else np.arange(bodies) - 1
    waiting = [(-1, 0, bodies)] if shape == "binary tree" else []
    while waiting:  # bodies of a branch follow each other
        above, first, count = waiting.pop()
        far[first], half = above, count // 2
        branches = (first, first + 1, half), (first, first + 1 + half, count - 1 - half)
        waiting += [branch for branch in branches if branch[2] > 0]
    drawn = random_tree(np.random.default_rng(1), bodies, (HINGE,), loads=False)
    model = drawn.changed(body=np.stack([far, np.arange(bodies)], axis=1), kind=(HINGE,) * bodies)
    (state,) = random_states(model, 1, 1)
    return model, state


def tree_call(model: Model, state: State) -> Call:
    """Prepare the reference's elimination of trees.

    Args:
        model: the tree.

    Returns:
        The call that computes the accelerations.

    """
    system = TreeSystem([model])
    r, p, v, pdot = maximal_coordinates(state)
    q, qdot = component_first(r, p), component_first(v, pdot)
    return lambda: system.acceleration(q, qdot)


def pinocchio_crba_call(model: Model, state: State) -> Call:
    """Prepare Pinocchio's composite-rigid-body algorithm with a dense solve.

    Args:
        model: the tree.

    Returns:
        The call that computes the joints' accelerations.

    """
    held = pinocchio_engine.PinocchioChain(model, "crba")
    q, v = held.coordinates(state)
    engine, data = held.pin_model, held.data
    return lambda: np.linalg.solve(pin.crba(engine, data, q), -pin.nonLinearEffects(engine, data, q, v))


def structured_call(model: Model, state: State, batch: int = 1) -> Call:
    """Prepare the reference's structured form.

    Args:
        state: its state; the copies of a batch have rates within ± 10 % of it.
        batch: number of chains that one call evaluates.

    Returns:
        The call that computes the accelerations of all chains.

    """
    forest = StructuredSystem([model]).repeated(batch)
    r, p, v, pdot = maximal_coordinates(state)
    q, qdot = (np.tile(component_first(*pair), batch) for pair in ((r, p), (v, pdot)))
    qdot = qdot * np.repeat(np.linspace(0.9, 1.1, batch), model.n)
    return lambda: forest.acceleration(q, qdot)


def direct_call(model: Model, state: State) -> tuple[sparse.csc_matrix, Array, Call]:
    """Prepare the direct form and assemble its system S x = b.

    Args:
        state: attitudes, directions and rates of its bodies.

    Returns:
        S, b, and the call that assembles and solves the banded system.

    """
    system, at = DirectSystem(model), maximal_coordinates(state)
    values, b, *_ = system._entries(at, None)
    S = sparse.csc_matrix((values, (system._i, system._j)), shape=(system.size, system.size))
    return S, b, lambda: system.solve(*at)


def superlu_call(S: sparse.csc_matrix, b: Array) -> Call:
    """Prepare SciPy's sparse LU of an assembled system: the call factors and solves only.

    Args:
        b: right-hand side.

    Returns:
        The call that solves S x = b.

    """
    return lambda: splu(S).solve(b)


def dense_call(S: sparse.csc_matrix, b: Array) -> Call:
    """Prepare the dense solve of an assembled system: factor, solve and one step of refinement.

    Args:
        S: matrix; it is made dense here.
        b: right-hand side.

    Returns:
        The call that solves S x = b.

    """
    matrix = S.toarray()
    return lambda: solve_dense(matrix, b)


def mujoco_forward_call(model: Model, state: State) -> Call:
    """Prepare MuJoCo's mj_forward.

    Args:
        state: attitudes, directions and rates of its bodies.

    Returns:
        The call that computes MuJoCo's accelerations.

    """
    held = mujoco_engine._MujocoChain(model)
    held.set_state(state)
    return lambda: mujoco.mj_forward(held.m, held.d)


def pinocchio_aba_call(model: Model, state: State) -> Call:
    """Prepare Pinocchio's articulated-body algorithm, pin.aba.

    Args:
        state: attitudes, directions and rates of its bodies.

    Returns:
        The call that computes Pinocchio's accelerations.

    """
    held = pinocchio_engine.PinocchioChain(model, "aba")
    q, v = held.coordinates(state)
    return lambda: pin.aba(held.pin_model, held.data, q, v, held.zero_torque)


def exudyn_steps_call(model: Model, state: State, step: float = 1e-4, count: int = 10) -> tuple[Call, int]:
    """Prepare Exudyn's trapezoidal rule: a step costs about two right-hand sides and a Jacobian.

    Args:
        step: of the integrator [s].

    Returns:
        The call, and its number of steps.

    """
    held = exudyn_engine.ExudynChain(model, state)
    chosen = make_settings()
    chosen.linearSolver.solverType = exudyn.LinearSolverType.EigenSparse
    alpha = chosen.timeIntegration.generalizedAlpha
    alpha.useNewmark = alpha.useIndex2Constraints = True
    chosen.timeIntegration.numberOfSteps = count
    chosen.timeIntegration.endTime = count * step
    return lambda: held.mbs.SolveDynamic(chosen), count
