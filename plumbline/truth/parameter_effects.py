"""First-order effects of a mistake in one parameter: on state quantities, and on a motion.

State quantities: with x = (r̈, α) and F the solution of the Newton-Euler system S at one state, a change of a
parameter θ of the model changes what the equations lack at that solution, and

    δ(r̈, α, F) = S⁻¹ (δf − δM x + δCᵀ λ, δγ − δC x)

Every term of a chain is written out below, one per kind of parameter. Mistakes in a tree and in the state
itself are evaluated by central differences, motions by differences of two runs, all with the reference's O(N)
form.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from plumbline.engines.integrators import runge_kutta_4
from plumbline.model.datatypes import Array, Model, State, Trajectory
from plumbline.model.invariants import (
    angular_momentum,
    attitude_error,
    joint_vector_rates,
    kinetic_energy,
    potential_energy,
)
from plumbline.model.kinematics import (
    angular_velocity,
    complete_state,
    cross_matrix,
    elastic_energy,
    forward_kinematics,
    joint_vectors,
    kinetic_energy_of_rotors,
    mass_matrix,
    quaternion_rate,
    rotate_vectors,
    rotation_matrix,
    velocity_jacobian,
)
from plumbline.truth.linear_effects import ChangedModels
from plumbline.truth.parameters import (
    AXES,
    INERTIA_ENTRIES,
    STATE_KINDS,
    Parameter,
    perturb,
    perturb_model,
)
from plumbline.truth.rounding_bound import NewtonEulerSystem
from plumbline.truth.step_formulas import fastest_rates
from reference_impl.fast.chain_elimination import component_first
from reference_impl.fast.collocation import integrate_collocation
from reference_impl.fast.tree_elimination import TreeSystem, eliminated_system

STATE_MISTAKE = 1e-4  # of a state's parameters, in central differences
TREE_MISTAKE = 0.02  # of a tree's: rounding in the difference is below a bound, its error below 0.1 %
MOTION_MISTAKE = 1e-5  # of a parameter's scale, in the runs that show its effect on the motion
MOTION_STEP = 2.0**-6  # s, largest step of those runs
MOTION_RTOL = 1e-13  # of the motion without mistakes
MAX_DEVIATION_ERROR = 1e-3  # of the largest deviation, what finer steps may change
MAX_HALVINGS = 4
TRIED_PARAMETERS = 8  # with mistakes in which steps are chosen
MAX_STEP_ANGLE = 0.25  # rad that the fastest mode turns in a step
MAX_STIFFNESS = 1.5  # of a step times the fastest rate of springs and dampers; stable up to 2.78
TINY_RATE = 1e-3  # rad/s
MAX_BATCH_BODIES = 4000  # of one batch of runs: more do not fit the processor's cache


class StateSensitivity:
    """The Newton-Euler solution at one state, and how parameters of the model change it."""

    def __init__(self, model: Model, state: State) -> None:
        """Solve the equations at the state.

        Args:
            state: a state on the constraint manifold.

        """
        self.model, self.state = model, state
        self.system = NewtonEulerSystem(model, state)
        self.A = rotation_matrix(state.p)
        self.omega = rotate_vectors(self.A, state.omega)
        turning = cross_matrix(self.omega)
        self.turning, self.swing = turning, cross_matrix(self.system.alpha) + turning @ turning
        self.pull = cross_matrix(self.system.F)
        self.momentum = model.mass[:, None] * state.v
        self.spin = rotate_vectors(self.A, rotate_vectors(model.inertia, state.omega))
        # of body k and all beyond it
        self.mass_beyond, self.first_moment_beyond, self.momentum_beyond = (
            _suffix_sum(x) for x in (model.mass, model.mass[:, None] * state.r, self.momentum)
        )
        self.W = velocity_jacobian(model, state).reshape(model.n, 6, -1)
        self.W_beyond = _suffix_sum(model.mass[:, None, None] * self.W[:, :3])

    def terms(self, parameter: Parameter) -> Array:
        """Return what a unit change of a parameter adds to the equations at the solution.

        Args:
            parameter: of the model, not of the state.

        Returns:
            (N, 9): of each body the force [N] and moment [N m] in its equations of motion (world frame), and
            the acceleration [m/s²] in its joint's rows, per unit of the parameter.

        """
        model, system, k = self.model, self.system, parameter.body
        rows = np.zeros((model.n, 9))
        if parameter.kind == "gravity":
            rows[:, AXES.index(parameter.entry)] = model.mass
        elif parameter.kind == "mass":
            rows[k, :3] = model.gravity - system.acceleration[k]
        elif parameter.kind == "inertia":
            E, w = _entry(parameter), self.state.omega[k]
            body_alpha = self.A[k].T @ system.alpha[k]
            rows[k, 3:6] = -self.A[k] @ (E @ body_alpha) - self.turning[k] @ (self.A[k] @ (E @ w))
        elif parameter.kind == "force":
            rows[k, AXES.index(parameter.entry)] = 1.0
        elif parameter.kind == "moment":
            rows[k, 3:6] = self.A[k][:, AXES.index(parameter.entry)]
        elif parameter.kind == "drag_force":
            rows[k, :3] = -self.state.v[k]
        elif parameter.kind == "drag_moment":
            rows[k, 3:6] = -self.omega[k]
        else:
            self._add_geometry(parameter, rows)
        return rows

    def _add_geometry(self, parameter: Parameter, rows: Array) -> None:
        """A point's own terms, those of its joint, and the drag of the velocities beyond it."""
        model, k = self.model, parameter.body
        arm, speed, first = self._shift(parameter)
        rows[first:, :3] -= model.drag_force[first:, None] * speed
        if parameter.kind == "length":
            rows[k, 6] = -np.sum(self.state.udot[k] ** 2)
            return
        swing = self.swing[k] @ arm
        if parameter.kind == "proximal":  # arm = −A e: the centre moves away from the point
            rows[k, 3:6] = self.pull[k] @ arm
            rows[k, 6:] = self._joint_row(k, swing)
        elif k + 1 < model.n:
            rows[k, 3:6] = self.pull[k + 1] @ arm
            rows[k + 1, 6:] = self._joint_row(k + 1, swing)

    def _shift(self, parameter: Parameter) -> tuple[Array, Array, int]:
        """Displacement and velocity of all bodies from the third result on, per unit of a length."""
        k = parameter.body
        if parameter.kind == "length":
            return self.state.u[k], self.state.udot[k], k
        sign, first = (-1.0, k) if parameter.kind == "proximal" else (1.0, k + 1)
        arm = sign * self.A[k][:, AXES.index(parameter.entry)]
        return arm, self.turning[k] @ arm, first

    def _joint_row(self, k: int, acceleration: Array) -> Array:
        """The rows of joint k that an acceleration enters."""
        if not self.model.rods[k]:
            return acceleration
        return np.array([self.state.u[k] @ acceleration, 0.0, 0.0])

    def effects(self, parameters: Sequence[Parameter]) -> dict[str, Array]:
        """Return the effects of unit changes of parameters on every state quantity.

        Args:
            parameters: P parameters of the model, not of the state.

        Returns:
            By name of the quantity the norms (P, N) per body of vectors, or (P, 1), per unit of the
            parameter.

        """
        n, names = self.model.n, ("acceleration", "angular_acceleration", "joint_reaction")
        rows = np.array([self.terms(parameter) for parameter in parameters])  # (P, N, 9)
        flat = np.concatenate([rows[..., :6].reshape(-1, 6 * n), rows[..., 6:].reshape(-1, 3 * n)], axis=1)
        inverse = self.system.inverse_columns.reshape(9 * n, 9 * n)
        solved = (flat @ inverse.T).reshape(len(parameters), n, 3, 3)
        found = {name: np.linalg.norm(solved[:, :, i], axis=-1) for i, name in enumerate(names)}
        scalars = np.array([self._scalars(parameter) for parameter in parameters])
        for i, name in enumerate(("kinetic_energy", "potential_energy", "angular_momentum", "mass_matrix")):
            found[name] = scalars[:, i : i + 1]
        return found

    def _scalars(self, parameter: Parameter) -> tuple[float, float, float, float]:
        """Changes of both energies, of the angular momentum and of the largest entry of the mass matrix."""
        model, state, k = self.model, self.state, parameter.body
        if parameter.kind == "gravity":
            return 0.0, abs(float(self.first_moment_beyond[0, AXES.index(parameter.entry)])), 0.0, 0.0
        if parameter.kind == "mass":
            v, r, W = state.v[k], state.r[k], self.W[k, :3]
            largest = float(np.max(np.sum(W * W, axis=0), initial=0.0))
            return float(v @ v) / 2, abs(float(r @ model.gravity)), _norm(cross_matrix(r) @ v), largest
        if parameter.kind == "inertia":
            E, w = _entry(parameter), state.omega[k]
            return abs(float(w @ E @ w)) / 2, 0.0, _norm(E @ w), 1.0
        if parameter.kind not in ("proximal", "distal", "length"):
            return 0.0, 0.0, 0.0, 0.0
        arm, speed, first = self._shift(parameter)
        if first >= model.n:
            return 0.0, 0.0, 0.0, 0.0
        momentum = (
            cross_matrix(arm) @ self.momentum_beyond[first]
            + cross_matrix(self.first_moment_beyond[first]) @ speed
        )
        return (
            abs(float(self.momentum_beyond[first] @ speed)),
            abs(float(self.mass_beyond[first] * (model.gravity @ arm))),
            _norm(momentum),
            self._mass_matrix_change(parameter, arm, first),
        )

    def _mass_matrix_change(self, parameter: Parameter, arm: Array, first: int) -> float:
        """Largest entry of Σ m (δWᵀ W + Wᵀ δW): δW has the columns of one rod or body only."""
        model, k = self.model, parameter.body
        rods = int(np.sum(model.rods))
        if parameter.kind == "length":
            at = 3 * int(np.sum(model.rods[:k]))
            change = np.eye(3) - np.outer(self.state.u[k], self.state.u[k])
        else:
            at = 3 * (rods + k)
            change = -cross_matrix(arm) @ self.A[k]  # column j: velocity of the arm's end by ω′ about axis j
        block = change.T @ self.W_beyond[first]
        own = block[:, at : at + 3] + block[:, at : at + 3].T
        block[:, at : at + 3] = own
        return float(np.max(np.abs(block)))


def _entry(parameter: Parameter) -> Array:
    """The symmetric unit matrix (3, 3) of an entry of the inertia."""
    found = np.zeros((3, 3))
    i, j = INERTIA_ENTRIES[parameter.entry]
    found[i, j] = found[j, i] = 1.0
    return found


def _norm(v: Array) -> float:
    return float(np.sqrt(v @ v))


def _suffix_sum(x: Array) -> Array:
    """Sums over body k and all beyond it."""
    return np.asarray(np.cumsum(x[::-1], axis=0)[::-1])


def effects_at_states(
    model: Model, states: Sequence[State], parameters: Sequence[Parameter]
) -> list[dict[str, Array]]:
    """Return the effects of unit changes of a model's parameters at many states.

    Args:
        model: the mechanism, a tree.
        parameters: P parameters of the model, not of the state.

    Returns:
        Per state as `StateSensitivity.effects`: its terms for chains, central differences for other trees.

    """
    if model.is_chain:
        return [StateSensitivity(model, state).effects(parameters) for state in states]
    # the spring of a ball joint jumps at half a turn, which a smaller difference hardly ever meets
    winds = [one.kind.endswith("frame") and model.kind[one.body] == "ball" for one in parameters]
    order = np.argsort(winds, kind="stable")
    split = len(parameters) - sum(winds)
    parts = [
        difference_effects(model, states, [parameters[i] for i in some], mistake)
        for some, mistake in ((order[:split], TREE_MISTAKE), (order[split:], STATE_MISTAKE))
        if len(some)
    ]
    back = np.argsort(order)
    return [
        {name: np.concatenate([part[at][name] for part in parts])[back] for name in parts[0][at]}
        for at in range(len(states))
    ]


def difference_effects(
    model: Model,
    states: Sequence[State],
    parameters: Sequence[Parameter],
    mistake: float = STATE_MISTAKE,
    is_central: bool = True,
) -> list[dict[str, Array]]:
    """Return the effects of unit changes of parameters by differences of the whole evaluation.

    Args:
        model: the mechanism, a tree.
        states: S states of it, on the constraint manifold.
        parameters: P parameters of the model or of the states.
        mistake: size of the differences, as a fraction of each scale.
        is_central: whether differences are from the opposite mistake, or from none.

    Returns:
        Per state, as `StateSensitivity.effects`.

    """
    found: list[dict[str, list[Array]]] = [{} for _ in states]
    at_once = 1 if model.has_loops else len(states)
    size = max(1, MAX_BATCH_BODIES // (2 * model.n * at_once))
    for first in range(0, len(parameters), size):
        part = parameters[first : first + size]
        other = -1 if is_central else 0
        pairs = [_perturbed(model, states, one, sign * mistake) for one in part for sign in (1, other)]
        scale = (1 - other) * mistake * np.array([one.scale for one in part])
        evaluated = (
            evaluate_to_first_order(model, states, pairs) if model.has_loops else evaluate_models(pairs)
        )
        for name, values in evaluated.items():  # (2P, S, ...)
            change = values[::2] - values[1::2]
            change = change / scale.reshape(-1, *(1,) * (change.ndim - 1))
            for at, own in enumerate(found):
                own.setdefault(name, []).append(_sizes(name, change[:, at]))
    return [{name: np.concatenate(parts) for name, parts in own.items()} for own in found]


def _sizes(name: str, change: Array) -> Array:
    """Norms (P, N) of vectors per body, (P, 1) of the rest: the largest entry of a matrix."""
    if name == "mass_matrix":
        return np.asarray(np.max(np.abs(change), axis=(1, 2))[:, None])
    return np.asarray(np.linalg.norm(change.reshape(len(change), -1, 3 if change.ndim > 1 else 1), axis=-1))


def _perturbed(
    model: Model, states: Sequence[State], parameter: Parameter, size: float
) -> tuple[Model, State]:
    """A changed model with its states, stacked; the same minimal coordinates but for a changed one."""
    if parameter.kind in STATE_KINDS:
        states = [perturb(model, state, parameter, size)[1] for state in states]
    stacked = stack_states(states)
    if parameter.kind in STATE_KINDS:
        return model, stacked
    changed = perturb_model(model, parameter, size)
    return changed, complete_state(changed, stacked)


def stack_states(states: Sequence[State]) -> State:
    """Put states into one, of arrays with a leading axis.

    Returns:
        The states, (S, ...) arrays.

    """
    return State(**{name: np.array([getattr(s, name) for s in states]) for name in vars(states[0])})


def evaluate_models(cases: Sequence[tuple[Model, State]]) -> dict[str, Array]:
    """Evaluate all state quantities of many trees at once, in the reference's O(N) form.

    Args:
        cases: mechanisms of as many bodies, each with S states of `stack_states`.

    Returns:
        By quantity (cases, S, ...), with the names and units of `StateQuantities`.

    """
    if not any(model.lacks_inertia for model, _ in cases):
        return _evaluate_together(cases)
    # dense factors are of mechanisms with the same rows, and each rotor is a row
    patterns = [np.flatnonzero(model.armature).tobytes() for model, _ in cases]
    groups = [[i for i, one in enumerate(patterns) if one == own] for own in dict.fromkeys(patterns)]
    parts = [_evaluate_together([cases[i] for i in group]) for group in groups]
    order = np.argsort(np.concatenate(groups))
    return {name: np.concatenate([part[name] for part in parts])[order] for name in parts[0]}


def _evaluate_together(cases: Sequence[tuple[Model, State]]) -> dict[str, Array]:
    count = len(cases[0][1].p)
    r, p, v, omega, x = (
        np.concatenate([np.concatenate(getattr(state, name)) for _, state in cases])
        for name in ("r", "p", "v", "omega", "x")
    )
    system = eliminated_system([model for model, _ in cases for _ in range(count)], x)
    solved = system.solve(r, p, v, quaternion_rate(p, omega))
    vectors = {
        "acceleration": solved.acceleration,
        "angular_acceleration": angular_velocity(p, solved.pddot),
        "joint_reaction": solved.joint_reaction,
    }
    if solved.joint_moment is not None:
        vectors["joint_moment"] = solved.joint_moment
    found = {name: value.reshape(len(cases), count, -1, 3) for name, value in vectors.items()}
    scalars = [_energies(model, state) for model, state in cases]
    return found | {name: np.array([one[name] for one in scalars]) for name in scalars[0]}


def evaluate_to_first_order(
    model: Model, states: Sequence[State], cases: Sequence[tuple[Model, State]]
) -> dict[str, Array]:
    """Evaluate all state quantities of changed models of one mechanism with loops.

    Args:
        cases: changed mechanisms, each with its S states of `stack_states`.

    Returns:
        As `evaluate_models`, without mass matrices.

    """
    changed, per_state = ChangedModels(model, [one for one, _ in cases]), []
    for at, base in enumerate(states):
        there = {name: np.array([getattr(own, name)[at] for _, own in cases]) for name in vars(base)}
        per_state.append(changed.solve(base, State(**there)))
    return {name: np.stack([one[name] for one in per_state], axis=1) for name in per_state[0]}


def _energies(model: Model, state: State) -> dict[str, Array]:
    """Energies, angular momentum and mass matrix at stacked states."""
    kinetic = kinetic_energy(model, state.v, state.omega)
    potential = potential_energy(model, state.r)
    if model.has_elements:
        each = [State(*values) for values in zip(*vars(state).values(), strict=True)]
        kinetic = kinetic + [kinetic_energy_of_rotors(model, one) for one in each]
        potential = potential + [elastic_energy(model, one) for one in each]
    return {
        "kinetic_energy": kinetic,
        "potential_energy": potential,
        "angular_momentum": angular_momentum(model, state.r, state.p, state.v, state.omega),
        "mass_matrix": mass_matrix(model, state),
    }


# -- motions -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class AccurateMotion:
    """A motion to nearly rounding, at the stages of the Runge-Kutta steps of deviations from it."""

    model: Model
    state: State
    times: Array  # (T,) samples [s]
    substeps: int  # steps between two samples
    y: Array  # (2 (T − 1) substeps + 1, 2, 7, N): (r; p) and (ṙ; ṗ) at the ends and midpoints of steps

    @property
    def samples(self) -> Array:
        """The motion at the samples, (T, 2, 7, N)."""
        return self.y[:: 2 * self.substeps]


@dataclass(frozen=True, eq=False)
class PerturbedMotion:
    """A motion with a mistake in one parameter, and the same without it."""

    parameter: Parameter
    run: Trajectory
    true: Trajectory  # of the same object for all motions of a batch


def accurate_motion(model: Model, state: State, times: Array, substeps: int) -> AccurateMotion:
    """Simulate a motion by collocation.

    Args:
        model: the mechanism, without loops.
        times: (T,) sample times [s], equally spaced.

    Returns:
        The motion. A steady motion stays as steady as it can.

    Raises:
        ArithmeticError: as `integrate_collocation`.

    """
    stages = np.linspace(times[0], times[-1], 2 * substeps * (len(times) - 1) + 1)
    start = state.r, state.p, state.v, quaternion_rate(state.p, state.omega)
    run = integrate_collocation(eliminated_system([model], state.x), *start, stages, MOTION_RTOL)
    y = np.stack([np.concatenate([run.r, run.p], axis=-1), np.concatenate([run.v, run.pdot], axis=-1)], 1)
    return AccurateMotion(model, state, times, substeps, y.swapaxes(-1, -2))


def accurate_runs(
    cases: Sequence[tuple[Model, State]], times: Array, max_steps: float = np.inf
) -> list[Trajectory]:
    """Simulate motions by collocation, with common steps.

    Args:
        cases: mechanisms without loops, with the same joints between the same bodies, and initial states.
        times: (T,) sample times [s].
        max_steps: as of `integrate_collocation`.

    Returns:
        The motions, each on its joints.

    Raises:
        ArithmeticError: as `integrate_collocation`.

    """
    system = eliminated_system([model for model, _ in cases], np.concatenate([s.x for _, s in cases]))
    r, p, v, w = (np.concatenate([getattr(s, name) for _, s in cases]) for name in ("r", "p", "v", "omega"))
    start = r, p, v, quaternion_rate(p, w)
    run = integrate_collocation(system, *start, times, MOTION_RTOL, project=True, max_steps=max_steps)
    parts = zip(*(np.split(x, len(cases), axis=1) for x in (run.r, run.p, run.v, run.pdot)), strict=True)
    return [
        Trajectory(times, r, p, v, pdot, run.steps, state.x)
        for (_, state), (r, p, v, pdot) in zip(cases, parts, strict=True)
    ]


def resolved_motions(
    model: Model, state: State, times: Array, parameters: Sequence[Parameter]
) -> tuple[AccurateMotion, AccurateMotion]:
    """Simulate a motion with steps that resolve how mistakes grow.

    Args:
        model: the mechanism, without loops.
        times: (T,) sample times [s], equally spaced.
        parameters: mistakes in some of them are tried.

    Returns:
        The motion, for steps that resolve it and for steps of two thirds of their length.

    """
    turning = max(TINY_RATE, *np.linalg.norm(state.omega, axis=1) / 2)
    stiffest = float(fastest_rates(model, [state])[0]) if model.has_elements else TINY_RATE
    step = min(MOTION_STEP, MAX_STEP_ANGLE / turning, MAX_STIFFNESS / max(stiffest, TINY_RATE))
    pairs = max(1, int(np.ceil((times[1] - times[0]) / step / 2)))
    tried = parameters[:: -(-len(parameters) // TRIED_PARAMETERS)]
    for halving in range(MAX_HALVINGS + 1):
        coarse, fine = (accurate_motion(model, state, times, many * pairs) for many in (2, 3))
        runs = [list(perturbed_motions(motion, tried)) for motion in (coarse, fine)]
        errors = [np.max(attitude_error(a.run.p, b.run.p)) for a, b in zip(*runs, strict=True)]
        sizes = [np.max(attitude_error(one.run.p, one.true.p)) for one in runs[1]]
        if max(errors) <= MAX_DEVIATION_ERROR * max(sizes) or halving == MAX_HALVINGS:
            break
        pairs *= 2
    return coarse, fine


def perturbed_motions(
    motion: AccurateMotion, parameters: Sequence[Parameter], mistake: float = MOTION_MISTAKE
) -> Iterator[PerturbedMotion]:
    """Simulate a motion with each parameter off by a fraction of its scale.

    What is integrated is the deviation δ from the accurate motion (Encke's method; Battin, An Introduction to
    the Mathematics and Methods of Astrodynamics, section 10.1), with f' the mistaken equations of motion:

        δ̇ = f'(y + δ) − f(y)

    so that the error of a step is relative to the deviation, however fast the motion itself is. Steps of
    order 8 cost 1.7 times as much in a chain of 50 bodies: there stability limits them.

    Args:
        motion: without mistakes.
        parameters: of `list_parameters`.

    Yields:
        The motions, in the order of the parameters.

    """
    model, state = motion.model, motion.state
    size = max(1, MAX_BATCH_BODIES // model.n - 1)
    for first in range(0, len(parameters), size):
        part = parameters[first : first + size]
        cases = [(model, state), *(perturb(model, state, one, mistake) for one in part)]
        true, *runs = _simulate_batch(motion, cases)
        for parameter, run in zip(part, runs, strict=True):
            yield PerturbedMotion(parameter, run, true)


def _simulate_batch(motion: AccurateMotion, cases: Sequence[tuple[Model, State]]) -> list[Trajectory]:
    """Runs of all cases by their deviations from the first, which is the accurate motion, unstabilised."""
    times, substeps, n = motion.times, motion.substeps, motion.model.n
    system = eliminated_system([model for model, _ in cases], np.concatenate([s.x for _, s in cases]))
    r, p, v = (np.concatenate([getattr(state, name) for _, state in cases]) for name in ("r", "p", "v"))
    pdot = quaternion_rate(p, np.concatenate([state.omega for _, state in cases]))

    def true(stage: int) -> Array:
        return np.tile(motion.y[stage], len(cases))  # (2, 7, M)

    delta = np.stack([component_first(r, p), component_first(v, pdot)]) - true(0)
    winding = system.winding if isinstance(system, TreeSystem) else None
    x = system.x if isinstance(system, TreeSystem) else None

    def slope(stages: Iterator[int], delta: Array) -> Array:
        q, rate = true(next(stages)) + delta
        if isinstance(system, TreeSystem):
            acceleration = system.acceleration(q, rate, x=x)
        else:
            acceleration = system.acceleration(q, rate)
        return np.stack([delta[1], acceleration - np.tile(acceleration[:, :n], len(cases))])

    samples, stage = [true(0) + delta], 0
    for h in np.diff(times):
        for _ in range(substeps):
            visited = iter((stage, stage + 1, stage + 1, stage + 2))
            delta = runge_kutta_4(partial(slope, visited), delta, h / substeps)
            stage += 2
            if winding:  # full turns of springs' angles go on from step to step
                r, p, v, pdot = (part.T for q in true(stage) + delta for part in (q[:3], q[3:]))
                x = winding.coordinates(r, p, v, pdot, x)[0]
        y = true(stage) + delta
        samples.append(np.stack(system.project(y[0], y[1])) if isinstance(system, TreeSystem) else y)
    # (cases, 2, T, N, 7)
    found = np.moveaxis(
        np.array(samples).reshape(len(times), 2, 7, len(cases), -1), (3, 1, 0, 4, 2), (0, 1, 2, 3, 4)
    )
    return [
        _on_manifold(
            model, Trajectory(times, q[..., :3], q[..., 3:], rate[..., :3], rate[..., 3:], substeps, start.x)
        )
        for (model, start), (q, rate) in zip(cases, found, strict=True)
    ]


def _on_manifold(model: Model, run: Trajectory) -> Trajectory:
    """The run of a chain with unit quaternions, and points that satisfy the joints exactly."""
    if not model.is_chain:  # its samples have been projected
        return run
    omega = angular_velocity(run.p, run.pdot)
    ell = np.where(model.rods, model.length, np.inf)[:, None]
    u = joint_vectors(model, run.r, run.p) / ell
    u = u / np.where(model.rods[:, None], np.linalg.norm(u, axis=-1, keepdims=True), 1.0)
    udot = joint_vector_rates(model, run, omega) / ell
    udot = udot - np.sum(udot * u, axis=-1, keepdims=True) * u
    p = run.p / np.linalg.norm(run.p, axis=-1, keepdims=True)
    _, _, r, v = forward_kinematics(model, p, omega, u, udot)
    return Trajectory(run.t, r, p, v, quaternion_rate(p, omega), run.steps)
