"""Step level: one step and ten of the declared method, against its formula in extended precision.

Engines in joint coordinates are compared with the formula itself: positions, attitudes and rates per body,
within a rounding bound.  With b the state-level bounds of accelerations, W and V the largest rate and speed
of any link up to body k, n its place among the links, ℓ the chain's stretched length up to it, ε = 2⁻⁵³:

    ω′  3 h (b_α + c) + 32 ε n W        ṙ  3 h (b_a + c ℓ) + 32 ε n max(V, W ℓ)
    p   h (bound of ω′) + 32 ε n          r  h (bound of ṙ) + 32 ε n ℓ

b holds the error of the accelerations, the factor 3 the stages elsewhere, the second term the roundings of
quaternion products and of the way from joint rates to the bodies', c = h W Σ (b_α of the links before, and of
rods about their own axes) what relative rates pass on.  Ten steps: the sum over the steps, times
the growth of perturbations, as one.

Engines that solve a step iteratively are compared in parts that need no iteration: the quadrature of their
own accelerations, the residual of their equations, and their first accelerations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from plumbline.engines.calls import StepEvaluation, run_steps
from plumbline.judging.rows import JudgingResult, Row, RowContext, Verdict
from plumbline.model.datatypes import Array, Integrator, Model, State, StepRun
from plumbline.model.kinematics import angular_velocity, state_from_minimal
from plumbline.model.sampling import derive_seed
from plumbline.model.step_methods import ConstrainedMethod, JointSpaceMethod, StepMethod
from plumbline.processes.workers import Pickled
from plumbline.truth.ground_truth import stretched_length
from plumbline.truth.rounding_bound import EPS, RoundingBound, state_rounding_bound
from plumbline.truth.step_formulas import (
    HAS_EXTENDED_PRECISION,
    LinkStates,
    constrained_quadrature,
    constrained_residual,
    engine_coordinates,
    fastest_rates,
    first_coordinate_acceleration,
    joint_space_steps,
)

STEP_SIZES = (0.01, 0.0237)  # s; large: a bound grows as h, the effect of a wrong formula faster
MAX_STEP_RATE = 10.0  # rad/s; in faster motions the steps are smaller: explicit methods become unstable
STEP_STATES = 5  # the initial state and random ones
MAX_STEP_BODIES = 10
STEP_ROUNDINGS = 32
ACCELERATION_FACTOR = 3.0
DISTURBANCE = 1e-9  # of rates, to measure the growth of perturbations
FIRST_ACCELERATION_RTOL = 1e-5  # Exudyn's are finite differences, off by 1e-7 of the largest
MAX_STEP_BOUND = 1e-6  # of the accelerations' effect; a looser bound could hide a mistake
MAX_GROWTH = 1e4  # of perturbations; beyond it the method itself is unstable, and nothing is compared
STEP_UNITS = {"step_position": "m", "step_attitude": "rad", "step_velocity": "m/s", "step_rate": "rad/s"}
CONSTRAINED_UNITS = {
    "step_quadrature": "1",
    "step_equations": "N",
    "step_first_acceleration": "m/s²",
}


def step_counts(method: StepMethod | None) -> tuple[int, ...]:
    """Choose after how many steps engine and formula are compared.

    Args:
        method: the declared formula.

    Returns:
        Counts, ascending; few where each step is compared with the one before.

    """
    return (1, 3) if isinstance(method, ConstrainedMethod) else (1, 10)


def run_step_study(
    engine: str, integrator: Integrator, model: Model, states: Sequence[State]
) -> StepEvaluation:
    """Take the steps that `judge_steps` judges (to be called in a worker).

    Args:
        engine: name of the engine in the registry.
        integrator: one of its integrators, with a declared formula.
        model: the pendulum.
        states: states of it.

    Returns:
        The steps.

    """
    assert integrator.method is not None
    sizes = _remembered_step_sizes(
        isinstance(integrator.method, ConstrainedMethod), Pickled.of((model, states))
    )
    return run_steps(engine, integrator.name, model, states, sizes, step_counts(integrator.method))


@lru_cache(maxsize=4)
def _remembered_step_sizes(has_constraints: bool, arguments: Pickled) -> list[list[float]]:
    """The steps of a scenario, whose integrators a worker gets in a row."""
    return step_sizes(has_constraints, *arguments.load())


def step_sizes(has_constraints: bool, model: Model, states: Sequence[State]) -> list[list[float]]:
    """Choose the steps from each state: `STEP_SIZES`, in proportion smaller where the motion is fast.

    Args:
        has_constraints: whether the declared formula is a `ConstrainedMethod`.
        model: the pendulum.
        states: states of it.

    Returns:
        Steps [s] per state: `STEP_SIZES` × `MAX_STEP_RATE` over the fastest rate, where that is larger.  It
        is the largest of √(2 |p̈|) = (α² + ω⁴/4)^¼ of a body, of |u̇| of a rod, of the linearised equations'
        eigenvalues, and for methods with constraints of √(F |s| / J) of a joint's force, doubled: their
        Newton iteration leaves that stiffness out and diverges at large steps.

    """
    norm, found = np.linalg.norm, []
    for state, fastest in zip(states, fastest_rates(model, states), strict=True):
        turning = np.asarray(first_coordinate_acceleration(model, state)[:, 3:], float)
        squares = [2 * np.max(norm(turning, axis=1)), np.max(norm(state.udot, axis=1)) ** 2, fastest**2]
        if has_constraints:
            force = np.asarray(state_rounding_bound(model, state).scale["joint_reaction"])
            lever = norm(model.proximal, axis=1) + norm(model.distal, axis=1)
            squares.append(np.max(force * lever / np.linalg.eigvalsh(model.inertia)[:, 0]))
            squares = [4 * np.max(squares)]
        rate = float(np.sqrt(np.max(squares)))
        found.append([h * min(1.0, MAX_STEP_RATE / rate if rate > 0 else 1.0) for h in STEP_SIZES])
    return found


@dataclass
class _Comparisons:
    """Errors of one quantity over bodies, states and steps."""

    errors: list[float] = field(default_factory=list)
    bounds: list[float] = field(default_factory=list)
    looseness: list[float] = field(default_factory=list)  # bound over the effect of the accelerations
    places: list[str] = field(default_factory=list)

    def add(self, errors: Array, bounds: Array, effects: Array, place: str) -> None:
        """Add the errors (K,) of the bodies, or of one body, at one place."""
        for k, (error, bound, effect) in enumerate(zip(errors, bounds, effects, strict=True)):
            self.errors.append(float(error))
            self.bounds.append(float(bound))
            self.looseness.append(float(bound / effect) if effect > 0 else 0.0)
            self.places.append(f"body {k + 1}, {place}")


def judge_steps(
    context: RowContext, integrator: Integrator, model: Model, states: Sequence[State], answer: StepEvaluation
) -> JudgingResult:
    """Judge the steps of one integrator by its declared formula.

    Args:
        context: scenario and engine.
        integrator: the integrator, with a declared method.
        model: the pendulum.
        states: the states that the steps start from.
        answer: the engine's steps, or why there are none.

    Returns:
        One row per quantity.

    """
    method, verdict, reason = integrator.method, Verdict.UNSUPPORTED, ""
    attempts = [attempt for attempt in answer.attempts if attempt.run is not None]
    runs = [(attempt.state, attempt.step, attempt.run) for attempt in attempts if attempt.run is not None]
    if isinstance(method, ConstrainedMethod):
        failures = [attempt.failure for attempt in answer.attempts]
    else:
        failures = [attempt.failure for attempt in answer.attempts if attempt.run is None]
    if any(failures):
        verdict, reason = Verdict.FAILED, next(filter(None, failures))
    elif not runs:
        reason = next(attempt.refusal for attempt in answer.attempts)
    elif not HAS_EXTENDED_PRECISION:
        reason = "the formulas need an extended precision that this machine does not have"
    if reason:
        return JudgingResult([context.make_row("step", integrator.name, "all", verdict, reason)])
    if isinstance(method, JointSpaceMethod):
        starts = [(index, h, run.angle_axes) for index, h, run in runs]
        steps = FormulaSteps(method, model, states, starts)
        for i, attempt in enumerate(attempts):
            if attempt.failure and steps.is_stable(i):
                row = context.make_row("step", integrator.name, "all", Verdict.FAILED, attempt.failure)
                return JudgingResult([row])
        found, units = steps.compare([run for *_, run in runs]), STEP_UNITS
    else:
        assert isinstance(method, ConstrainedMethod)
        found, units = _compare_parts(method, model, states, runs), CONSTRAINED_UNITS
    alias = None if model.has_drag else integrator.alias_of  # with drag the two methods differ
    complete = sum(not (attempt.refusal or attempt.failure) for attempt in answer.attempts)
    note = f"{complete} runs of {max(step_counts(method))} steps"
    return JudgingResult(
        [
            _row(context, integrator, quantity, units[quantity], comparisons, note, alias, answer.cpu_time)
            for quantity, comparisons in found.items()
        ]
    )


def _row(
    context: RowContext, integrator: Integrator, quantity: str, unit: str, found: _Comparisons, note: str,
    alias: str | None, cpu_time: float,
) -> Row:  # fmt: skip
    """The row of one quantity: its worst ratio decides, unless most bounds are too loose."""
    error, bound = np.array(found.errors), np.array(found.bounds)
    ratios = error / np.maximum(bound, np.finfo(float).tiny)
    at, looseness = int(np.argmax(ratios)), np.array(found.looseness)
    ratio, is_sharp = float(ratios[at]), looseness <= MAX_STEP_BOUND
    name = quantity.removeprefix("step_").replace("_", " ")
    if ratio > 1:
        verdict = Verdict.DISAGREES
        reason = (
            f"{context.title} does not take the declared step of {integrator.name}: {name} off by "
            f"{error[at]:.3g} {unit} ({found.places[at]}), {ratio:.3g} times the rounding bound"
        )
    elif not ratio <= 1 or np.mean(is_sharp) < 0.5:
        verdict = Verdict.UNRESOLVED
        reason = (
            f"inconclusive: at {np.mean(~is_sharp):.0%} of the comparisons the rounding bound is above "
            f"{MAX_STEP_BOUND:g} of the accelerations' effect, too loose to detect an error"
        )
    else:
        verdict = Verdict.AGREES
        reason = f"{name} within {ratio:.2g} of the rounding bound of the declared step in {note}"
    return context.make_row(
        "step", integrator.name, quantity, verdict, reason, unit,
        value=float(error[at]), tolerance=float(bound[at]), ratio=ratio, alias_of=alias, cpu_time=cpu_time,
        derivation=f"{bound[at]:.2g} {unit} at {found.places[at]}; in the median {np.median(looseness):.1g} "
        "of the accelerations' effect on a step; truth: the declared formula in extended precision "
        "(docs/integrators.md)",
        extra={"comparisons": float(len(error)), "bound_relative": float(np.median(looseness))},
    )  # fmt: skip


# -- joint coordinates -------------------------------------------------------------------------------


class FormulaSteps:
    """The declared steps from several states, and from states nearby that show how differences grow."""

    def __init__(
        self, method: JointSpaceMethod, model: Model, states: Sequence[State],
        starts: Sequence[tuple[int, float, Array | None]],
    ) -> None:  # fmt: skip
        """Take the steps.

        Args:
            method: the declared formula.
            model: the pendulum.
            states: states of it.
            starts: of each run the index of its state, the step [s], and the axes of revolute joints or None.

        """
        self.method, self.model, self.places = method, model, [(index, h) for index, h, _ in starts]
        self.starts, sizes = [states[index] for index, *_ in starts], [h for _, h, _ in starts]
        axes = [angle_axes for *_, angle_axes in starts]
        self.bounds = {index: state_rounding_bound(model, states[index]) for index, *_ in starts}
        disturbed = [_disturbed(model, states[index], self.bounds[index]) for index, *_ in starts]
        count = max(step_counts(method))
        both = joint_space_steps(model, self.starts + disturbed, sizes + sizes, method, count, axes + axes)
        self.true = [[_pick(links, i) for links in both] for i in range(len(starts))]
        self.growth = np.empty((len(starts), count + 1))  # of perturbations, running maximum
        for i, (index, h, _) in enumerate(starts):
            weights = self.step_bound((self.starts[i],), (self.bounds[index],), h, 1)
            apart = [_separation(links, i, len(starts), weights) for links in both]
            self.growth[i] = np.maximum.accumulate(np.array(apart) / apart[0])

    def is_stable(self, i: int) -> bool:
        """Find out whether the method itself goes through.

        Args:
            i: index of the start.

        Returns:
            Whether perturbations grow by less than `MAX_GROWTH`.

        """
        return bool(self.growth[i, -1] < MAX_GROWTH)

    def limits(self) -> Iterator[tuple[int, int, dict[str, Array], dict[str, Array]]]:
        """Compute the limits of errors after every number of steps that is compared.

        Yields:
            Index of the start, number of steps, and by quantity the limits and what a limit is compared with,
            (N,) each.

        """
        for i, (index, h) in enumerate(self.places):
            for count in step_counts(self.method):
                if not self.growth[i, count] < MAX_GROWTH:
                    continue
                end = _rounded(self.true[i][count])
                ends = self.bounds[index], state_rounding_bound(self.model, end)
                bound = self.step_bound((self.starts[i], end), ends, h, count)
                grown = {name: count * self.growth[i, count] * limit for name, limit in bound.items()}
                yield i, count, grown, _effects(ends, h, count)

    def compare(self, runs: Sequence[StepRun]) -> dict[str, _Comparisons]:
        """Compare engines' steps with the formula's, body by body.

        Args:
            runs: one per start, with as many steps as the engine took.

        Returns:
            Errors and bounds by quantity.

        """
        found = {quantity: _Comparisons() for quantity in STEP_UNITS}
        for i, count, limit, scale in self.limits():
            if count >= len(runs[i].trajectory.t):
                continue
            index, h = self.places[i]
            place = f"state {index}, {count} step{'s' * (count > 1)} of {h:g} s"
            for quantity, error in _errors(self.true[i][count], runs[i], count).items():
                found[quantity].add(error, limit[quantity], scale[quantity], place)
        return found

    def step_bound(
        self, ends: tuple[State, ...], bounds: tuple[RoundingBound, ...], h: float, count: int
    ) -> dict[str, Array]:
        """Compute the bounds of one of several steps.

        Args:
            ends: the states at the ends of the steps.
            bounds: rounding bounds at ``ends``.
            h: step [s].
            count: number of steps.

        Returns:
            By quantity the bounds (N,), in its unit of `STEP_UNITS`.

        """
        norm, model = np.linalg.norm, self.model
        rate = np.max([np.maximum(norm(s.omega, axis=1), norm(s.udot, axis=1)) for s in ends], axis=0)
        speed = np.max([norm(s.v, axis=1) for s in ends], axis=0)
        W, V = np.maximum.accumulate(rate), np.maximum.accumulate(speed)
        arm = np.cumsum(stretched_length(model))
        rounding = STEP_ROUNDINGS * EPS * (np.arange(1, model.n + 1) + np.cumsum(model.rods))
        turning, acceleration, torque = (
            np.max([getattr(b, name) for b in bounds], axis=0)
            for name in ("angular_acceleration", "acceleration", "rod_torque")
        )
        # Rates are kept relative to the link before: what rounding does to one link, and to the spin of a
        # rod, reaches those beyond it once they have turned against it.
        above = np.concatenate([[0.0], turning[:-1]])
        if self.method.coordinates == "joint rotations":
            axial = self.method.rod_axial_inertia * np.trace(model.inertia, axis1=1, axis2=2)
            above = above + torque / axial
        leaked = count * np.minimum(1.0, h * W) * np.cumsum(above)
        omega = ACCELERATION_FACTOR * h * (turning + leaked) + rounding * W
        velocity = ACCELERATION_FACTOR * h * (acceleration + leaked * arm) + rounding * np.maximum(V, W * arm)
        return {
            "step_rate": omega,
            "step_velocity": velocity,
            "step_attitude": count * h * omega + rounding,
            "step_position": count * h * velocity + rounding * arm,
        }


def _pick(links: LinkStates, i: int) -> LinkStates:
    return LinkStates(*(getattr(links, name)[i] for name in LinkStates.__match_args__))


def _disturbed(model: Model, state: State, bound: RoundingBound) -> State:
    """A state nearby: rates off in random directions, in the proportions in which roundings disturb them."""
    rng = np.random.default_rng(derive_seed("disturbed step"))
    tolerance = np.asarray(bound.angular_acceleration)
    size = DISTURBANCE * max(float(np.max(np.linalg.norm(state.omega, axis=1))), 1.0) / np.max(tolerance)
    omega = state.omega + (size * tolerance)[:, None] * rng.normal(size=(model.n, 3))
    return state_from_minimal(model, state.p, omega, state.u, state.udot)


def _separation(links: LinkStates, i: int, count: int, weights: dict[str, Array]) -> float:
    """How far the motion nearby is from motion i of ``count``, in units of the bounds of a step."""
    found = []
    for name, quantity in (("omega", "step_rate"), ("v", "step_velocity")):
        motions = getattr(links, name)
        with np.errstate(all="ignore"):
            apart = np.asarray(motions[i] - motions[i + count], float)
            found.append(np.linalg.norm(apart, axis=-1) / weights[quantity])
    return float(np.max(found))


def _rounded(links: LinkStates) -> State:
    parts = (np.asarray(getattr(links, name), float) for name in ("p", "omega", "u", "udot", "r", "v"))
    return State(*parts)


def _errors(true: LinkStates, run: StepRun, count: int) -> dict[str, Array]:
    """Differences (N,) per body; quaternions as they are, not normalised."""
    t = run.trajectory
    p = t.p[count].astype(np.longdouble)
    gaps = [np.linalg.norm(np.asarray(sign * p - true.p, float), axis=-1) for sign in (1, -1)]
    omega = angular_velocity(p, t.pdot[count])
    pairs = {
        "step_position": (t.r[count], true.r),
        "step_velocity": (t.v[count], true.v),
        "step_rate": (omega, true.omega),
    }
    found = {name: np.linalg.norm(np.asarray(a - b, float), axis=-1) for name, (a, b) in pairs.items()}
    return found | {"step_attitude": 2 * np.minimum(*gaps)}


def _effects(bounds: tuple[RoundingBound, RoundingBound], h: float, count: int) -> dict[str, Array]:
    """The accelerations' effect (N,) on each quantity: what a bound is compared with."""
    turning, acceleration = (
        h * count * np.max([np.asarray(b.scale[name]) for b in bounds], axis=0)
        for name in ("angular_acceleration", "acceleration")
    )
    return {
        "step_rate": turning,
        "step_velocity": acceleration,
        "step_attitude": h * turning,
        "step_position": h * acceleration,
    }


# -- constraints and an iterative solver -------------------------------------------------------------


def _compare_parts(
    method: ConstrainedMethod,
    model: Model,
    states: Sequence[State],
    runs: Sequence[tuple[int, float, StepRun]],
) -> dict[str, _Comparisons]:
    found = {quantity: _Comparisons() for quantity in CONSTRAINED_UNITS}
    for index, h, run in runs:
        place = f"state {index}, steps of {h:g} s"
        q, qdot, qddot = engine_coordinates(run)
        size = [np.max(np.abs(np.asarray(x, float)), axis=-1) for x in (q, qdot, qddot)]
        size[2] = np.maximum.accumulate(size[2], axis=0)  # the averaged a depends on all earlier ones
        predicted_q, predicted_rate = constrained_quadrature(method, run, h)
        roundings = STEP_ROUNDINGS * EPS
        before = np.maximum(size[1][:-1], size[1][1:])
        errors = (
            (predicted_q - q[1:], roundings * (size[0][1:] + h * before + h * h * size[2][1:]), h * h),
            (predicted_rate - qdot[1:], roundings * (before + h * size[2][1:]), h),
        )
        for difference, bound, power in errors:
            error = np.asarray(np.max(np.abs(difference), axis=-1), float)  # (T − 1, N)
            worst = np.argmax(error / np.maximum(bound, np.finfo(float).tiny), axis=0)
            body = np.arange(model.n)
            found["step_quadrature"].add(
                error[worst, body], bound[worst, body], power * size[2][1:][worst, body], place
            )
        residual = constrained_residual(model, method, run)
        allowed = (
            np.maximum(method.solver_atol, method.solver_rtol * residual.size) + roundings * residual.size
        )
        worst_step = int(np.argmax(residual.residual / allowed))
        found["step_equations"].add(
            residual.residual[worst_step : worst_step + 1], allowed[worst_step : worst_step + 1],
            residual.size[worst_step : worst_step + 1], place,
        )  # fmt: skip
        first = first_coordinate_acceleration(model, states[index])
        allowed = FIRST_ACCELERATION_RTOL * np.full(model.n, float(np.max(np.abs(first))))
        error = np.asarray(np.max(np.abs(first - qddot[0]), axis=-1), float)
        found["step_first_acceleration"].add(error, allowed, np.zeros(model.n), place)
    return found
