"""Take single steps of fixed-step integrators: from which states, of which sizes; runs inside a worker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from plumbline.engines.engine_calls import StepAttempt, StepEvaluation, run_steps
from plumbline.model.datatypes import ZERO_INERTIA, Integrator, Model, State
from plumbline.model.loops import STABILISATION
from plumbline.model.step_methods import ConstrainedMethod
from plumbline.processes.worker_pool import Pickled
from plumbline.truth.rounding_bound import remembered_rounding_bound
from plumbline.truth.step_comparison import step_counts
from plumbline.truth.step_formulas import fastest_rates, first_coordinate_acceleration

STEP_SIZES = (0.01, 0.0237)  # s; large: a bound grows as h, the effect of a wrong formula faster
MAX_STEP_RATE = 10.0  # rad/s; in faster motions the steps are smaller: explicit methods become unstable
# rad/s, of loops and held slides: at the larger step gaps close by half as fast as h a = 1, where Euler's
# method rings
GAP_RATE = 2 * STABILISATION * MAX_STEP_RATE * STEP_SIZES[-1]
STEP_STATES = 5  # the initial state and random ones
MAX_STEP_BODIES = 10  # of single steps
RUN_STEP_SHARE = 0.79  # of the smaller one: the step of a run, no power of two
RUN_STEPS, MIN_RUN_STEPS = 600, 18
RUN_REFINEMENTS = (4, 16)
RUN_WORK = 25_000  # steps × bodies²: the bounds' time grows so


def run_step_study(
    engine: str, integrator: Integrator, model: Model, states: Sequence[State]
) -> StepEvaluation:
    """Take the steps of one integrator (to be called in a worker).

    Args:
        integrator: one of its integrators, with a declared formula.

    """
    assert integrator.method is not None
    sizes = _remembered_step_sizes(
        isinstance(integrator.method, ConstrainedMethod), Pickled.of((model, states))
    )
    if not integrator.has_motions:
        count = len(states) if model.n <= MAX_STEP_BODIES else 1
        counts = step_counts(integrator.method)
        return run_steps(engine, integrator.name, model, states[:count], sizes[:count], counts)
    h, counts = RUN_STEP_SHARE * sizes[0][0], run_counts(model.n)
    tried = list[StepAttempt]()
    cpu_time = 0.0
    for finer in (1, *RUN_REFINEMENTS):  # a motion may become faster than it is at the start
        run = run_steps(engine, integrator.name, model, states[:1], [[h / finer]], counts)
        tried += run.attempts
        cpu_time += run.cpu_time
        if not tried[-1].failure:
            break
    single = StepEvaluation([], 0.0)
    if model.n <= MAX_STEP_BODIES or model.has_loops:
        single = run_steps(engine, integrator.name, model, states, sizes, step_counts(integrator.method))
    return replace(single, cpu_time=single.cpu_time + cpu_time, run=tried[-1], larger=tuple(tried[:-1]))


def run_counts(bodies: int) -> tuple[int, ...]:
    """Choose of how many steps a run is that is judged step by step.

    Returns:
        Counts, ascending: the largest, and those for runs that end earlier, as at an angle's singularity.

    """
    count = min(RUN_STEPS, max(MIN_RUN_STEPS, RUN_WORK // bodies**2))
    return count // 9, count // 3, count


@lru_cache(maxsize=4)
def _remembered_step_sizes(has_constraints: bool, arguments: Pickled) -> list[list[float]]:
    """The steps of a scenario, whose integrators a worker gets in a row."""
    return step_sizes(has_constraints, *arguments.load())


def step_sizes(has_constraints: bool, model: Model, states: Sequence[State]) -> list[list[float]]:
    """Choose the steps from each state: `STEP_SIZES`, in proportion smaller where the motion is fast.

    Args:
        has_constraints: whether the declared formula is a `ConstrainedMethod`.

    Returns:
        Steps [s] per state: `STEP_SIZES` × `MAX_STEP_RATE` over the fastest rate, where that is larger.  Of
        loops and pitches it is `GAP_RATE` at least: engines' corrections of gaps have to be stable.  Else it
        is the largest of √(2 |p̈|) = (α² + ω⁴/4)^¼ of a body, of |u̇| of a rod, of the linearised equations'
        eigenvalues, and for methods with constraints of √(F |s| / J) of a joint's force, doubled: their
        Newton iteration leaves that stiffness out and diverges at large steps.

    """
    norm, found = np.linalg.norm, []
    for state, fastest in zip(states, fastest_rates(model, states), strict=True):
        turning = np.asarray(first_coordinate_acceleration(model, state)[:, 3:], float)
        squares = [2 * np.max(norm(turning, axis=1)), np.max(norm(state.udot, axis=1)) ** 2, fastest**2]
        if has_constraints:
            bound = remembered_rounding_bound(model, state)
            force, near = np.asarray(bound.scale["joint_reaction"]), model.body[:, 1]
            lever, principal = norm(model.point[:, 1], axis=1), np.linalg.eigvalsh(model.inertia)
            least = np.where(principal[:, 0] > ZERO_INERTIA * principal[:, 2], principal[:, 0], np.inf)
            on_body = model.body[:, 0] >= 0
            beyond = np.zeros(model.n)
            np.maximum.at(beyond, model.body[on_body, 0], norm(model.point[on_body, 0], axis=1))
            squares.append(np.max(force * (lever + beyond[near]) / least[near]))
            moment = np.where([kind.holds_no_turn for kind in model.kinds], 0.0, bound.scale["joint_moment"])
            squares.append(np.max(moment / least[near]))
            squares = [4 * np.max(squares)]
        if model.has_loops or any(kind.has_pitch for kind in model.kinds):
            squares.append(GAP_RATE**2)
        rate = float(np.sqrt(np.max(squares)))
        found.append([h * min(1.0, MAX_STEP_RATE / rate if rate > 0 else 1.0) for h in STEP_SIZES])
    return found
