"""Steps of an engine against its declared formula: differences, and the bounds that rounding explains.

Engines in joint coordinates are compared with the formula itself: positions, attitudes and rates per body,
within a rounding bound.  With b the state-level bounds of accelerations, W and V the largest rate and speed
of any link up to body k, n its place among the links, ℓ the chain's stretched length up to it, ε = 2⁻⁵³:

    ω′  3 h (b_α + c) + 32 ε n W        ṙ  3 h (b_a + c ℓ) + 32 ε n max(V, W ℓ)
    p   h (bound of ω′) + 32 ε n          r  h (bound of ṙ) + 32 ε n ℓ

b holds the error of the accelerations, the engine's and the formula's own, the factor 3 the stages
elsewhere, the second term the roundings of quaternion products and of the way from joint rates to the
bodies', c = h W Σ (b_α of the links before, and of rods about their own axes) what relative rates pass on.
Ten steps: the sum over the steps, times the growth of perturbations, as one.

Of loops b is that of an engine that solves at joint coordinates of its own (`rounding_bounds`).

Where a method takes closed forms, what they lose of slow turns is added (`_lost_in_closed_forms`).

Engines that solve a step iteratively are compared in parts that need no iteration: the quadrature of their
own accelerations, the residual of their equations, and their first accelerations.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plumbline.equations.arithmetic import floats, stacked
from plumbline.equations.tree import Tree
from plumbline.model.datatypes import KINDS, Array, Model, State, StepRun, Trajectory
from plumbline.model.kinematics import (
    angular_velocity,
    bodies_beyond,
    complete_state,
    cross,
    rod_inertias,
    rotate_vectors,
    rotation_matrix,
    stack_states,
    stretched_length,
)
from plumbline.model.sampling import derive_seed
from plumbline.model.step_methods import ConstrainedMethod, JointSpaceMethod, StepMethod
from plumbline.truth.rounding_bound import (
    EPS,
    ROUNDING_FACTOR,
    SUM_ROUNDING_FACTOR,
    TINY,
    RoundingBound,
    bounds_at,
    remembered_rounding_bound,
)
from plumbline.truth.step_charts import BodyStates, LongDouble, StepCharts
from plumbline.truth.step_formulas import (
    constrained_quadrature,
    constrained_residual,
    coordinates_after,
    engine_coordinates,
    fastest_rates,
    first_acceleration_bound,
    first_coordinate_acceleration,
    has_written_rows,
    joint_space_steps,
    projected_residual,
    steps_in_charts,
)

STEP_ROUNDINGS = 32
ACCELERATION_FACTOR = 3.0
ACCELERATIONS = ("angular_acceleration", "acceleration", "rod_torque")  # whose bounds a step's depends on
DISTURBANCE = 1e-9  # of rates, to measure the growth of perturbations
ANGLE_ROUNDINGS = 4
MAX_STRETCH = 2e-15  # of a joint's quaternions
MIN_MIDDLE_COSINE = 0.1  # of the second of two or three angles: at 0 two of their axes are one
# Distance of a sample from the declared end of its step, over the sizes there, beyond which bounds and
# effects do not use the sample: it would widen its own bound.
STRAY = 1e-3
MAX_DISTANCE = 10.0  # of bodies from where their mechanism hangs, or from its free body, over its size
MAX_COSINE_CHANGE = 1 / 2  # of that cosine in a step, over itself
MAX_TURN = 1.0  # rad, step × fastest rate: beyond it explicit methods become unstable, and bounds do not hold
SAMPLE_STRIDE = 8  # of the samples at which what changes slowly is estimated: rates, the formula's own errors
LOST_DIGITS = 4.0  # by how much errors of one size may differ by chance
# Roundings that are alike in all steps, of those in a bound: see `RunSteps._mean`.
CONSTANT_ROUNDINGS, CONSTANT_FACTORS = 16 / STEP_ROUNDINGS, 12 / ROUNDING_FACTOR / ACCELERATION_FACTOR
MEAN_ALARM = 1e-9  # how probable it is that chance alone passes the bound of a mean
CLOCK_ROUNDINGS = 2  # of a time that is a sum of steps
RESIDUAL_STEPS = 2  # after one, Euler does not show the axial inertia of rods
MAX_GROWTH = 1e4  # of perturbations; beyond it the method itself is unstable, and nothing is compared
# By the quantity of a row what it is of, and its unit; "1" are multiples of what rounding explains.
_MOTION = {"position": "m", "attitude": "rad", "velocity": "m/s", "rate": "rad/s"}
STEP_QUANTITIES = {f"step_{of}": (of, unit) for of, unit in _MOTION.items()}
CONSTRAINED_QUANTITIES = {
    f"step_{of}": (of, unit)
    for of, unit in {"quadrature": "1", "equations": "N", "first_acceleration": "m/s²"}.items()
}
RUN_QUANTITIES = {  # at every step of a run
    f"run_{of}": (of, unit)
    for of, unit in {
        **_MOTION, "energy": "J", "momentum": "kg m²/s", "mean": "1", "samples": "1",
        "quadrature": "1", "equations": "N",
    }.items()
}  # fmt: skip

Runs = Sequence[tuple[int, float, StepRun]]  # index of the state, step [s], steps


def step_counts(method: StepMethod | None) -> tuple[int, ...]:
    """Choose after how many steps engine and formula are compared.

    Returns:
        Counts, ascending; few where each step is compared with the one before.

    """
    return (1, 3) if isinstance(method, ConstrainedMethod) else (1, 10)


@dataclass(frozen=True)
class Place:
    """Where steps are compared."""

    state: int  # index
    step: float  # s
    count: int  # of steps

    def __str__(self) -> str:
        return f"state {self.state}, {self.count} step{'s' * (self.count > 1)} of {self.step:g} s"


@dataclass(frozen=True, eq=False)
class StepDeviations:
    """One quantity at many steps: how far an engine's steps are off the declared ones."""

    errors: Array  # (steps, K)
    bounds: Array  # (steps, K) what rounding explains
    effects: Array  # (steps, K) of the accelerations on the quantity; 0 where they have none
    # (steps,) why a step has no bound, by the condition of the motion alone; empty where all have one
    left_out: NDArray[np.str_] = field(default_factory=lambda: np.array([], str))
    places: Sequence[Place] = field(default=(), kw_only=True)  # of each, where it is not one of a run

    @property
    def ratios(self) -> Array:
        """Errors over their bounds (steps, K); 0 at steps that have none."""
        return np.where(self.is_left_out[:, None], 0.0, self.ratios_of_all)

    @property
    def ratios_of_all(self) -> Array:
        """Errors (steps, K) over what the bounds would be, were they valid at every step."""
        return np.asarray(self.errors / np.maximum(self.bounds, TINY))

    @property
    def looseness(self) -> Array:
        """Bounds over the effects of the accelerations (steps, K)."""
        has_effect = self.effects > 0
        return np.divide(self.bounds, self.effects, out=np.zeros_like(self.bounds), where=has_effect)

    @property
    def is_left_out(self) -> NDArray[np.bool_]:
        """(steps,) whether a step has no bound."""
        return self.left_out != "" if len(self.left_out) else np.zeros(len(self.errors), bool)


def joined(parts: Sequence[StepDeviations]) -> StepDeviations:
    """Put the worst of several deviations in place of all, body by body."""
    worst = np.argmax([part.ratios for part in parts], axis=0)[None]
    columns = ([getattr(part, name) for part in parts] for name in ("errors", "bounds", "effects"))
    return StepDeviations(*(np.take_along_axis(np.array(x), worst, 0)[0] for x in columns))


def _at_places(
    rows: Iterable[tuple[str, Place, Array, Array, Array]], quantities: Iterable[str]
) -> dict[str, StepDeviations]:
    """By quantity what is compared at many places: there errors, bounds and effects (K,)."""
    found: dict[str, list[Any]] = {quantity: [] for quantity in quantities}
    for quantity, *row in rows:
        found[quantity].append(row)
    return {
        quantity: StepDeviations(
            *(np.array([row[i] for row in some]) for i in (1, 2, 3)), places=[row[0] for row in some]
        )
        for quantity, some in found.items()
    }


# -- joint coordinates -------------------------------------------------------------------------------


_EndBounds = tuple[tuple[RoundingBound, RoundingBound], dict[str, Array]]


class FormulaSteps:
    """The declared steps from several states, and from states nearby that show how differences grow."""

    def __init__(
        self, method: JointSpaceMethod, model: Model, states: Sequence[State],
        starts: Sequence[tuple[int, float, Array | None]], counts: Sequence[int] = (),
    ) -> None:  # fmt: skip
        """Take the steps.

        Args:
            starts: of each run the index of its state, the step [s], and the axes of revolute joints or None.
            counts: numbers of steps that are compared, ascending; empty for `step_counts`.

        """
        self.method, self.model, self.places = method, model, [(index, h) for index, h, _ in starts]
        self.starts, sizes = [states[index] for index, *_ in starts], [h for _, h, _ in starts]
        axes = [angle_axes for *_, angle_axes in starts]
        used = list(dict.fromkeys(index for index, *_ in starts))
        bounds = acceleration_bounds(method, model, stack_states([states[index] for index in used]))
        nearby = {index: _disturbed(model, states[index], bounds[i]) for i, index in enumerate(used)}
        self.bounds = bounds[np.array([used.index(index) for index, *_ in starts])]
        disturbed = [nearby[index] for index, *_ in starts]
        self.counts = tuple(counts) or step_counts(method)
        self._end_bounds: dict[tuple[int, int], _EndBounds] = {}
        count, every = max(self.counts), np.arange(len(starts))
        both = joint_space_steps(model, self.starts + disturbed, sizes + sizes, method, count, axes + axes)
        self.true = [links[every] for links in both]  # by number of steps
        weights = self._step_bounds(every, 1, (stack_states(self.starts), self.bounds))
        apart = np.array([_separations(links, len(starts), weights) for links in both])
        # (starts, steps) of perturbations, running maximum
        self.growth = np.maximum.accumulate(apart / apart[0], axis=0).T

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
        for i, (_, h) in enumerate(self.places):
            for count in self.counts:
                if not self.growth[i, count] < MAX_GROWTH:
                    continue
                ends, bound = self._bounds_after(i, count)
                grown = {name: count * self.growth[i, count] * limit for name, limit in bound.items()}
                yield i, count, grown, _effects([end.scale for end in ends], h, count)

    def compare(self, runs: Sequence[StepRun]) -> dict[str, StepDeviations]:
        """Compare engines' steps with the formula's, body by body.

        Args:
            runs: one per start, with as many steps as the engine took.

        Returns:
            Errors and bounds by quantity.

        """
        return _at_places(self._compared(runs), STEP_QUANTITIES)

    def _compared(self, runs: Sequence[StepRun]) -> Iterator[tuple[str, Place, Array, Array, Array]]:
        for i, count, limit, scale in self.limits():
            motion = runs[i].trajectory
            if count >= len(motion.t):
                continue
            place, soft = Place(*self.places[i], count), _limit_errors(runs[i])
            off = _differences(_reported(motion, count), self.true[count][i])
            for quantity, error in _norms(off).items():
                lacking = count * float(np.max(soft[quantity][:count]))
                allowed = limit[quantity] + self.growth[i, count] * lacking
                yield quantity, place, error, allowed, scale[quantity]

    def residuals(self, method: JointSpaceMethod, runs: Sequence[StepRun], model: Model) -> Array:
        """Return the differences of an engine's first steps from those of another formula or mechanism.

        Args:
            method: the other formula, in the same coordinates.
            runs: the engine's steps, as given before.

        Returns:
            One vector over all runs, bodies and components after `RESIDUAL_STEPS` steps, each in rounding
            bounds of the declared formula.

        """
        sizes, axes = [h for _, h in self.places], [run.angle_axes for run in runs]
        motions = joint_space_steps(model, self.starts, sizes, method, RESIDUAL_STEPS, axes)
        found = []
        for i, run in enumerate(runs):
            count = min(RESIDUAL_STEPS, len(run.trajectory.t) - 1)
            _, bound = self._bounds_after(i, count)
            off = _differences(_reported(run.trajectory, count), motions[count][i])
            for name, difference in off.items():
                found.append((difference / (count * bound[name][:, None])).ravel())
        return np.concatenate(found)

    def _bounds_after(self, i: int, count: int) -> _EndBounds:
        """Rounding bounds at both ends of a run's first steps, and those of the steps; computed once."""
        if (i, count) not in self._end_bounds:  # of all runs that go through at once
            passes = self.growth[:, count] < MAX_GROWTH
            runs = np.flatnonzero(passes | (np.arange(len(passes)) == i))
            states, first = self.true[count][runs].rounded(), self.bounds[runs]
            bounds = acceleration_bounds(self.method, self.model, states)
            ends = (stack_states([self.starts[j] for j in runs]), first), (states, bounds)
            limits = self._step_bounds(runs, count, *ends)
            for at, j in enumerate(runs.tolist()):
                limit = {name: x[at] for name, x in limits.items()}
                self._end_bounds[j, count] = (first[at], bounds[at]), limit
        return self._end_bounds[i, count]

    def _step_bounds(
        self, runs: NDArray[np.intp], count: int, *ends: tuple[State, RoundingBound]
    ) -> dict[str, Array]:
        """Bounds (runs, N) of one of the first steps by quantity, from the states at their ends."""
        sizes = [_sizes(states, vars(bounds)) for states, bounds in ends]
        largest = {name: np.max([one[name] for one in sizes], axis=0) for name in sizes[0]}
        h = np.array([h for _, h in self.places])[runs, None]
        passed = (links[runs].rounded() for links in self.true[: count + 1])
        lost = _lost_in_closed_forms(self.method, self.model, passed, largest["speed"], h)
        return step_bound(self.method, self.model, largest, h, count, lost)


def acceleration_bounds(method: JointSpaceMethod, model: Model, states: State) -> RoundingBound:
    """Compute the bounds of accelerations in steps.

    Args:
        states: S of them.

    Returns:
        The state level's, and what the correction of gaps adds, or on trees the formula's own errors;
        arrays (S, ...).

    """
    bounds = bounds_at(model, states, method=method)
    if model.has_loops:
        return bounds
    scale = np.stack([bounds.scale[name] for name in ("acceleration", "angular_acceleration")], axis=1)
    added = _formula_errors(model, states, scale)
    return replace(
        bounds,
        acceleration=bounds.acceleration + added[:, 0],
        angular_acceleration=bounds.angular_acceleration + added[:, 1],
    )


def _sizes(states: State, bounds: Mapping[str, Array]) -> dict[str, Array]:
    """What a step's bound depends on (S, N), at S states and in units of their bounds."""
    norm = np.linalg.norm
    return {name: bounds[name] for name in ACCELERATIONS} | {
        "rate": np.maximum(norm(states.omega, axis=-1), norm(states.udot, axis=-1)),
        "speed": norm(states.v, axis=-1),
        "place": norm(states.r, axis=-1),
    }


def step_bound(
    method: JointSpaceMethod, model: Model, sizes: dict[str, Array], h: float | Array, count: int,
    lost: Lost | None = None,
) -> dict[str, Array]:  # fmt: skip
    """Compute the bounds of one of several steps.

    Args:
        sizes: of `_sizes`, (..., N): the largest at the ends of the steps.
        h: step [s], or (..., 1).
        lost: what closed forms lose in it.

    Returns:
        By quantity the bounds (..., N), in its unit of `STEP_QUANTITIES`.

    """
    rate, speed, turning, acceleration = (
        sizes[name] for name in ("rate", "speed", "angular_acceleration", "acceleration")
    )
    kinds, path = model.kind[: model.n], _paths(model)  # of the joints of the tree
    # an angle of x rad is rounded to ε |x|
    turned = ANGLE_ROUNDINGS * EPS * (sizes.get("turned", np.zeros(model.n)) @ path.T)
    if lost is not None:
        turned = turned + lost.turn
        # accelerations of stages that are turned by so much more than a rounding, by so much more
        more = 1 + np.max(lost.turn, axis=-1, keepdims=True) / (ROUNDING_FACTOR * EPS)
        turning, acceleration = turning * more, acceleration * more
    W, V = (np.max(np.where(path, x[..., None, :], 0.0), -1) for x in (rate, speed))
    arm = _arms(model, sizes)
    links = [
        max(1, len(kind.motions)) + kind.holds_distance + (method.holds_pitches and kind.has_pitch)
        for kind in map(KINDS.__getitem__, kinds)
    ]
    # Some engines normalise quaternions only beyond 1e-15; rotations have their lengths squared.
    stretched = np.minimum(sizes.get("stretched", np.zeros(model.n)), MAX_STRETCH)
    rounding = STEP_ROUNDINGS * EPS * (path @ np.array(links)) + 4 * (stretched @ path.T)
    passed_on = _passed_on(method, model, sizes, h, count)
    omega = ACCELERATION_FACTOR * h * (turning + passed_on["step_rate"]) + rounding * W
    velocity = ACCELERATION_FACTOR * h * (acceleration + passed_on["step_velocity"])
    velocity += rounding * np.maximum(V, W * arm)
    if lost is not None and (len(model.spring_body) or model.has_loops):
        # springs and corrections of gaps feel the places of stages: (h ω)² <= 1 of their errors, over a step
        felt = np.max(lost.place, axis=-1, keepdims=True) / h
        velocity += felt
        gyration = np.sqrt(np.min(np.linalg.eigvalsh(model.inertia), axis=-1).clip(0) / model.mass)
        omega += np.where(gyration > 0, felt / np.maximum(gyration, TINY), 0.0)
    if method.free_coordinates == "rigid motion":  # ṙ is kept in the body's axes, which turn
        velocity += np.where(model.free[: model.n], count * h * omega * speed, 0.0) @ path.T
    return {
        "step_rate": omega,
        "step_velocity": velocity,
        "step_attitude": count * h * omega + rounding + turned,
        "step_position": count * h * velocity + (rounding + turned) * arm + (lost.place if lost else 0.0),
    }


class Lost(NamedTuple):
    """How far off closed forms of slow turns put the bodies in a step."""

    place: Array  # (..., N) m
    turn: Array  # (..., N) rad


def _lost_in_closed_forms(
    method: JointSpaceMethod, model: Model, states: Iterable[State], speed: Array, h: float | Array
) -> Lost:
    """Bound what is lost in a step by a method that takes closed forms of turns and of rigid motions.

    The forms divide 1 − cos t by the square of the turn t = t n.  A cosine that is off by its last place, ε,
    makes the quotient off by ε / t²: a translation by ε / t of itself, in exp6 at the end of a step and in
    Jexp6 at the stages of Runge-Kutta; and Jexp3, there, the rate ω by ε ω⊥ / t, where ⊥ is across n.
    Besides, Jexp6 has β = 1/t² − sin t / (2 t (1 − cos t)), off by 2 ε / t⁴, and β′/t, by −2/t² of that.
    Of a translation p and a rate ω they make a velocity, off by

        2 ε / t³ |(n·p) ω⊥ + (p⊥·ω⊥) n|  <=  2 ε p ω⊥ / t³

    and by 8 ε p ω / t, as the two are rounded each (measured: half of the first at most, as the cosine is
    rounded to ε/2).  Stages move by p = h V / 2 and turn by t = h Ω / 2, where Ω is the rate of the stage
    before, not ω: a body that turns slowly at the start of a step and fast in it loses most.

    Args:
        states: S each, at the ends of the steps.
        speed: (S, N) m/s, the largest of them.
        h: step [s], or (S, 1).

    """
    if method.closed_form_turn == np.inf:
        return Lost(np.zeros_like(speed), np.zeros_like(speed))
    norm, rates = np.linalg.norm, np.array([_relative_rates(model, state) for state in states])
    start, end = rates[:-1], rates[1:]
    if method.formula == "Runge-Kutta":
        turn = h / 2 * norm([start, (start + end) / 2], axis=-1)
        fastest, change = np.maximum(norm(start, axis=-1), norm(end, axis=-1)), h * norm(end - start, axis=-1)
    else:
        turn = h * norm(end, axis=-1)[None]
        fastest = change = np.zeros_like(turn[0])
    t, is_closed = np.maximum(turn, method.closed_form_turn), turn > method.closed_form_turn / 2
    place, turned = (
        EPS * np.max(np.where(is_closed, lost, 0.0), axis=(0, 1, 2))
        for lost in (change / t**3 + (2 + 4 * h * fastest) / t, change / t)
    )
    path = _paths(model)
    return Lost(np.where(model.free[: model.n], h * speed * place, 0.0) @ path.T, turned @ path.T)


def _relative_rates(model: Model, states: State) -> Array:
    """Rates (2, S, N, 3) [rad/s], world, of what is kept as a quaternion; 0 of other joints.

    Of free bodies, balls and rods against the body before, and of bodies against their rods.
    """
    far, rod = model.body[: model.n, 0], model.rods[: model.n, None]
    turning = np.array([kind.has_attitude for kind in model.kinds[: model.n]])[:, None]
    bodies = rotate_vectors(rotation_matrix(states.p), states.omega)
    of_rods = cross(states.u, states.udot)
    before = np.where((far >= 0)[:, None], bodies[..., far, :], 0.0)
    of_joints = np.where(rod, of_rods, bodies) - before
    return np.where(turning, [of_joints, np.where(rod, bodies - of_rods, 0.0)], 0.0)


def _arms(model: Model, sizes: dict[str, Array]) -> Array:
    """Lengths (..., N) [m] from the world to each body."""
    path, slides = _paths(model), [kind.is_unbounded for kind in model.kinds[: model.n]]
    place = np.max(np.where(path, sizes["place"][..., None, :], 0.0), -1)
    return np.asarray(path @ stretched_length(model) + place * any(slides))


def _passed_on(
    method: JointSpaceMethod, model: Model, sizes: dict[str, Array], h: float | Array, count: int
) -> dict[str, Array]:
    """Bound the errors of accelerations (..., N) that relative rates pass on to the bodies beyond.

    Rates are kept relative to the link before: what rounding does to one link, and to the spin of a rod,
    reaches those beyond it once they have turned against it.
    """
    far = model.body[: model.n, 0]
    path, slides = _paths(model), np.array([kind.is_unbounded for kind in model.kinds[: model.n]])
    W, torque = np.max(np.where(path, sizes["rate"][..., None, :], 0.0), -1), sizes["rod_torque"]
    above, shifted = (
        np.where(far >= 0, x[..., far], 0.0)
        for x in (sizes["angular_acceleration"], sizes["acceleration"] * (slides @ path > 0))
    )
    if method.coordinates == "joint rotations":
        axial = method.rod_axial_inertia * rod_inertias(model)
        # of other joints there is no torque here
        above = above + np.divide(torque, axial, out=np.zeros_like(torque), where=torque > 0)
    leaked, passed = (count * np.minimum(1.0, h * W) * (x @ path.T) for x in (above, shifted))
    return {"step_rate": leaked, "step_velocity": leaked * _arms(model, sizes) + passed}


def _sample_bound(method: JointSpaceMethod, model: Model, sizes: dict[str, Array]) -> dict[str, Array]:
    """Bound what rounding leaves between coordinates and the bodies' motion that they map to.

    Places and attitudes as in a step without accelerations.  The relative rates uⱼ of the joints are added up
    along a path, each turned by an attitude that is off by the roundings ρⱼ up to it, and at a lever ℓ ahead,
    or about a common point, as the centre of the tree: as far away as the furthest body.

        ω′  Σ ρⱼ |uⱼ|        ṙ  ℓ Σ ρⱼ |uⱼ| + ρ max(V, W ℓ)

    Args:
        sizes: of `_sizes`, and of `StepCharts.coordinate_sizes`, (S, N).

    Returns:
        By quantity the bounds (S, N), in its unit of `STEP_UNITS`.

    """
    bound = step_bound(method, model, sizes, 0.0, 0)
    far, path = model.body[: model.n, 0], _paths(model)
    relative = sizes["rate"] + np.where(far >= 0, sizes["rate"][..., far], 0.0)
    turned = (bound["step_attitude"] * relative) @ path.T
    lever = bound["step_position"] / np.maximum(bound["step_attitude"], TINY)
    lever = np.maximum(lever, np.max(sizes["place"], axis=-1, keepdims=True))
    bound |= {"step_rate": turned, "step_velocity": bound["step_velocity"] + turned * lever}
    return {name: np.maximum(x, TINY) for name, x in bound.items()}


def _rod_spins(model: Model, charts: StepCharts, v: Array, states: State) -> Array:
    """(S, N) rates [rad/s] of rods about themselves, which move no body; 0 of other joints.

    They start from 0 and stay there, but for rounding, where a step resolves the motion.

    Args:
        v: (S, nv) in the charts.

    """
    found = np.zeros(states.r.shape[:-1])
    for k, place in enumerate(charts.place):
        chart, far = charts.of_rod.get(place), model.body[k, 0]
        if chart is None or not charts.charts[chart].is_group:  # of angles none is the rod's about itself
            continue
        found[:, k] = v[:, charts.own[chart].stop - 1]
        if far >= 0:  # about the same axis, with which the body before turns already
            carried = rotate_vectors(rotation_matrix(states.p[:, far]), states.omega[:, far])
            found[:, k] += np.sum(carried * states.u[:, k], axis=-1)
    return np.abs(found)


def _rates(model: Model, charts: StepCharts, v: Array, states: State) -> Array:
    """(S, N) rates [rad/s] of bodies, of their rods, and of these about themselves, as `_rod_spins`."""
    norm = np.linalg.norm
    rates = norm(states.omega, axis=-1), norm(states.udot, axis=-1), _rod_spins(model, charts, v, states)
    return np.asarray(np.max(rates, axis=0))


def _formula_errors(model: Model, states: State, scale: Array) -> Array:
    """(S, 2, N) errors of r̈ and ω̇′ by the formula itself, in extended precision.

    Its recursion loses digits where light bodies carry heavy ones, as in doubles, where the same loss shows
    and is larger by the ratio of the two precisions.  Of the samples of a run, the largest loss counts, in
    itself or over ``scale`` (S, 2, N), whichever is less, so that one sample that is far off does not
    widen the bounds of the others.
    """
    count = len(states.p)
    some = _every_few(count)
    state, found = states[some], list[Any]()
    for dtype in (np.float64, LongDouble):
        tree = Tree(floats(dtype), model, state)
        solution = tree.solve()
        each = solution.acceleration, tree.in_bodies(solution.turning)
        found.append(np.stack([stacked(x, (len(some),)) for x in each], axis=1))
    size = np.linalg.norm(np.asarray(found[0] - found[1], float), axis=-1)
    share = float(np.finfo(LongDouble).eps / np.finfo(float).eps)
    lost = np.asarray(LOST_DIGITS * share * size)
    if len(some) == count:
        return lost
    scale = np.maximum(scale, TINY)
    share_of_scale = np.fmax.reduce(lost / scale[some])
    return np.asarray(np.fmin(np.fmax.reduce(lost), share_of_scale * scale), float)


def _every_few(count: int) -> NDArray[np.intp]:
    """Indices of every `SAMPLE_STRIDE`-th of so many samples, and of the last; of few, all."""
    stride = SAMPLE_STRIDE if count > 4 * SAMPLE_STRIDE else 1
    return np.unique(np.append(np.arange(0, count, stride), count - 1))


def _spread(values: Array, some: NDArray[np.intp]) -> Array:
    """Give each sample the larger of the two values around it, of those at some samples."""
    at = np.searchsorted(some, np.arange(some[-1] + 1))
    return np.maximum(values[at], values[np.maximum(at - 1, 0)])


def _paths(model: Model) -> NDArray[np.bool_]:
    """[k, b] whether body b is k or between k and the world."""
    return np.ascontiguousarray(bodies_beyond(model).T)


def _disturbed(model: Model, state: State, bound: RoundingBound) -> State:
    """A state nearby: rates off in random directions, in the proportions in which roundings disturb them."""
    rng = np.random.default_rng(derive_seed("disturbed step"))
    tolerance = np.asarray(bound.angular_acceleration)
    size = DISTURBANCE * max(float(np.max(np.linalg.norm(state.omega, axis=1))), 1.0) / np.max(tolerance)
    omega = state.omega + (size * tolerance)[:, None] * rng.normal(size=(model.n, 3))
    xdot = state.xdot + (size * tolerance)[:, None] * rng.normal(size=state.xdot.shape)
    v = state.v + (size * np.asarray(bound.acceleration))[:, None] * rng.normal(size=(model.n, 3))
    return complete_state(model, replace(state, omega=omega, xdot=xdot, v=v))


def _separations(links: BodyStates, count: int, weights: dict[str, Array]) -> Array:
    """How far the motions nearby are from the first ``count``, (count,) in units of the bounds of a step."""
    found = []
    for name, quantity in (("omega", "step_rate"), ("v", "step_velocity")):
        motions = getattr(links, name)
        with np.errstate(all="ignore"):
            apart = np.asarray(motions[:count] - motions[count:], float)
            found.append(np.linalg.norm(apart, axis=-1) / weights[quantity])
    return np.asarray(np.max(found, axis=(0, 2)))


def _reported(t: Trajectory, at: int | slice | NDArray[np.intp]) -> State:
    """Samples of an engine's motion, their attitudes in extended precision."""
    p: Any = t.p[at].astype(np.longdouble)
    return State(p, angular_velocity(p, t.pdot[at]), r=t.r[at], v=t.v[at])


def _differences(one: State, other: State) -> dict[str, Array]:
    """Differences (..., N, ·) of bodies; of attitudes twice those of quaternions as they are."""
    sign = np.where(np.sum(one.p * other.p, axis=-1, keepdims=True) < 0, -1, 1)
    pairs: dict[str, tuple[Any, Any]] = {
        "step_position": (one.r, other.r),
        "step_velocity": (one.v, other.v),
        "step_rate": (one.omega, other.omega),
        "step_attitude": (2 * sign * one.p, 2 * other.p),
    }
    return {name: np.asarray(a - b, float) for name, (a, b) in pairs.items()}


def _norms(differences: dict[str, Array]) -> dict[str, Array]:
    """Sizes (..., N)."""
    return {name: np.linalg.norm(x, axis=-1) for name, x in differences.items()}


def _limit_errors(run: StepRun) -> dict[str, Array]:
    """By quantity what the steps (steps, 1) are uncertain by, where they are limits of softer ones."""
    errors = run.limit_error
    if errors is None:
        errors = np.zeros((len(run.trajectory.t), len(_MOTION)))
    return {f"step_{of}": error[1:, None] for of, error in zip(_MOTION, errors.T, strict=True)}


def _effects(scales: Sequence[Mapping[str, Array | float]], h: float, count: int = 1) -> dict[str, Array]:
    """The accelerations' effect (..., N) on each quantity, from those at both ends: a bound's scale."""
    turning, acceleration = (
        h * count * np.max([np.asarray(scale[name]) for scale in scales], axis=0)
        for name in ("angular_acceleration", "acceleration")
    )
    return {
        "step_rate": turning,
        "step_velocity": acceleration,
        "step_attitude": h * turning,
        "step_position": h * acceleration,
    }


# -- every step of a run -----------------------------------------------------------------------------


class StepsFromSamples:
    """The declared step from each of many samples, and what rounding explains in it."""

    def __init__(
        self, method: JointSpaceMethod, model: Model, charts: StepCharts, coordinates: Array,
        velocities: Array, h: float, count: int, uncertainty: dict[str, Array] | None = None,
    ) -> None:  # fmt: skip
        """Take the steps.

        Args:
            charts: of the coordinates.
            coordinates: (S, Σ ·) of `Trajectory`.
            velocities: (S, nv).
            h: step [s].
            count: steps start from so many of the samples; where there is one more, each ends at the next.
            uncertainty: (count, 1) of the steps' results besides rounding, by quantity of `STEP_QUANTITIES`.

        Raises:
            EngineFailure: there are other coordinates than the mechanism has.

        """
        self.method, self.model, self.h, self.charts = method, model, h, charts
        q, v = charts.divided(coordinates, velocities)
        self.velocities = v
        self.here = charts.bodies(q, v)
        self.start = [at[:count] for at in q]
        ends, declared = coordinates_after(charts, q, v, [h])  # of the last sample too: it is one tree
        ends, self.declared = [at[:count] for at in ends], declared[:count]
        self.after = charts.bodies(ends, self.declared)
        self.states = self.here.rounded()
        self.bounds = acceleration_bounds(method, model, self.states)
        self.middle_cosine = charts.middle_cosine(q)
        sizes = _sizes(self.states, vars(self.bounds)) | charts.coordinate_sizes(coordinates)
        sizes["rate"] = _rates(model, charts, v, self.states)
        # Angles whose axes meet at the cosine c have rates of W/c and accelerations of (α + W²/c²)/c; their
        # torques, too, are converted by a matrix of norm 1/c.
        converted = 1 / np.maximum(self.middle_cosine, TINY)[:, None]
        self.fastest = np.max(sizes["rate"], axis=-1)  # (S,) rad/s, W of all bodies
        of_samples = _sample_bound(method, model, sizes)
        self.declared_ends, self.end_cosine = self.after.rounded(), charts.middle_cosine(ends)
        self.strays = self._find_strays(count)
        # (count,) samples besides the starts that bounds look at; where an end strays, none but the start,
        # as the size of the mistake would widen its own bound
        self.ends = np.where(self.strays, np.arange(count), np.arange(len(v))[-count:])
        self.uncertainty = uncertainty or dict.fromkeys(STEP_QUANTITIES, np.zeros((count, 1)))
        self.of_samples = {name: x * converted for name, x in of_samples.items()}
        between = {name: np.maximum(x[:count], x[self.ends]) for name, x in sizes.items()}
        of_torques = np.maximum(converted[:count], converted[self.ends]) ** 4
        passed = self.states[:count], self.states[self.ends]
        self.lost = _lost_in_closed_forms(method, model, passed, between["speed"], h)
        of_step = step_bound(method, model, between, h, 1, self.lost)
        self.of_step = {name: x * of_torques + self.uncertainty[name] for name, x in of_step.items()}
        self.is_of_one_pose = method.formula == "semi-implicit Euler" and method.implicit_forces != "all"
        self.of_totals = self._total_bounds(count, between)

    def _find_strays(self, count: int) -> NDArray[np.bool_]:
        """Find the steps (count,) whose samples at the end are nowhere near the declared end."""
        there, apart = self.declared_ends, _norms(_differences(self.here[-count:], self.after))
        reach = float(np.sum(stretched_length(self.model)))
        rate = np.max(_rates(self.model, self.charts, self.declared, there), axis=-1)
        sizes = {
            "step_position": np.max(np.linalg.norm(there.r, axis=-1), axis=-1) + reach,
            "step_attitude": np.ones(count),
            "step_velocity": np.max(np.linalg.norm(there.v, axis=-1), axis=-1) + rate * reach,
            "step_rate": rate,
        }
        near = [np.max(x, axis=-1) <= STRAY * np.maximum(sizes[name], TINY) for name, x in apart.items()]
        return np.asarray(~np.all(near, axis=0))

    def _total_bounds(self, count: int, between: dict[str, Array]) -> dict[str, Array]:
        """Bound the errors (count,) of energy [J] and angular momentum about the origin [kg m²/s].

        Each is that of its sum, and what the moments do that rounding leaves in the equations of the joints,
        as often as in a rate's bound: by their power; inner forces change no momentum, so that it is off by
        these moments and the roundings of all bodies' rates.  Where a joint to the world has a moment about
        the origin, it is off as all rates together.  The equations hold at one pose: in methods that use
        those of several, or derivatives by the rates, what relative rates pass on changes both totals.
        """

        def of_both_ends(x: Any) -> Array:
            return np.asarray(np.maximum(x[:count], x[self.ends]))

        bounds, model, reach = self.bounds, self.model, np.linalg.norm(self.states.r, axis=-1)
        share = ACCELERATION_FACTOR * self.h / np.maximum(self.middle_cosine, TINY) ** 4
        energy = of_both_ends(bounds.kinetic_energy + bounds.potential_energy + share * bounds.joint_power)
        reach, inertia = of_both_ends(reach), np.linalg.norm(model.inertia, axis=(1, 2))
        passed_on = _passed_on(self.method, model, between, 0.0 if self.is_of_one_pose else self.h, 1)
        passed_on = {name: of_both_ends(share)[:, None] * x for name, x in passed_on.items()}
        unsure = {name: x + self.uncertainty[name] for name, x in passed_on.items()}
        energy += (model.mass * between["speed"] * unsure["step_velocity"]).sum(-1)
        energy += (between["rate"] * unsure["step_rate"]) @ inertia
        accelerations = of_both_ends(bounds.scale["acceleration"])
        energy += (model.mass * accelerations * self.lost.place).sum(-1)
        rates, own = self.of_step, np.zeros(count)
        if _is_momentum_free(model):
            rates = {name: of_both_ends(self.of_samples[name]) + x for name, x in passed_on.items()}
            own = of_both_ends(share * bounds.joint_terms)
        off = (model.mass * reach * rates["step_velocity"]).sum(-1) + rates["step_rate"] @ inertia
        off += (model.mass * between["speed"] * self.lost.place).sum(-1)
        return {"energy": energy, "momentum": of_both_ends(bounds.angular_momentum) + own + off}

    def mistake_ratios(self, model: Model, states: State) -> dict[str, float]:
        """Compute what an engine with another mechanism would be off by, over what rounding explains.

        Args:
            model: the mechanism, with a mistake.
            states: of the samples (S, ...), in it.

        Returns:
            The largest by quantity of `RUN_UNITS`; of `run_mean` none.

        """
        charts = StepCharts(model, self.method, states)
        q, v = charts.divided(*charts.reported())
        ends = coordinates_after(charts, q, v, [self.h])
        # the engine reports bodies of its mechanism at its coordinates, from which the declared step starts
        here, declared, true = self._step_from(q, v)
        reported = charts.bodies(*ends)
        found = dict[str, float]()
        for quantity, error in _norms(_differences(reported, true)).items():
            found[quantity.replace("step", "run")] = float(np.max(error / self.of_step[quantity]))
        at_samples = _norms(_differences(charts.bodies(q, v), here))
        found["run_samples"] = max(float(np.max(x / self.of_samples[name])) for name, x in at_samples.items())
        for name, error in self._total_errors(q, ends[1], declared, self.charts.bodies(*ends), true).items():
            found[f"run_{name}"] = float(np.max(error / np.maximum(self.of_totals[name], TINY)))
        return found

    def _step_from(self, q: list[Array], v: Array) -> tuple[BodyStates, Array, BodyStates]:
        """The bodies at coordinates, the rates after a declared step, and the bodies there."""
        samples = [*self.start, self.velocities[: len(v)]]
        if all(map(np.array_equal, [*q, v], samples)):  # as most mistakes leave them
            return self.here[: len(v)], self.declared, self.after
        ends, declared = coordinates_after(self.charts, q, v, [self.h])
        return self.charts.bodies(q, v), declared, self.charts.bodies(ends, declared)

    def _total_errors(
        self, start: list[Array], rates: Array, declared: Array, read: BodyStates, true: BodyStates
    ) -> dict[str, Array]:
        """Differences (S,) of energy [J] and angular momentum [kg m²/s], within `_total_bounds`.

        Where the equations of one pose make the step, the new rates count at that pose: at another, a
        difference of relative rates that moves no body there moves those that have turned against each other.

        Args:
            start: coordinates at which the steps start.
            rates: (S, nv) after them; ``declared``: by the formula.
            read: the bodies after the steps; ``true``: by the formula.

        """
        if self.is_of_one_pose:
            read, true = (self.charts.bodies(start, v) for v in (rates, declared))
        return {name: _sizes_of(getattr(read, name) - getattr(true, name)) for name in self.of_totals}

    def start_ratio(self, state: State) -> float:
        """Compute by how much a first sample at another state would be off, over what rounding explains."""
        off = _norms(_differences(state, self.states[0]))
        return max(float(np.max(x / (2 * self.of_samples[name][0]))) for name, x in off.items())


def _directions(vectors: Array) -> Array:
    """Unit vectors (..., 3); 0 of 0."""
    size = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(size > 0, size, 1.0))


def _is_momentum_free(model: Model) -> bool:
    """Whether no joint to the world has a moment about the origin: balls and rods there, free bodies."""
    roots = np.flatnonzero(model.body[: model.n, 0] < 0)
    return not model.has_loops and all(
        model.kinds[k].holds_nothing or (model.kinds[k].is_spherical and not np.any(model.point[k, 0]))
        for k in roots
    )


def _sizes_of(difference: Array) -> Array:
    """Sizes (S,) of numbers (S,) or vectors (S, 3)."""
    x = np.asarray(difference, float)
    return np.asarray(np.abs(x) if x.ndim == 1 else np.linalg.norm(x, axis=-1))


class RunSteps(StepsFromSamples):
    """Every step of a run: each of the engine's samples against the declared step from the one before.

    The step starts from the engine's own coordinates.  That they are those of the samples that it reports,
    that the first one is the state that it was given, and the times are compared as well.
    """

    def __init__(
        self, method: JointSpaceMethod, model: Model, state: State, h: float, run: StepRun
    ) -> None:  # fmt: skip
        """Take the declared step from every sample but the last.

        Args:
            state: that the engine was given.
            h: step [s].
            run: with coordinates.

        Raises:
            EngineFailure: there are other coordinates than the mechanism has.

        """
        motion = run.trajectory
        assert motion.coordinates is not None and motion.velocities is not None
        self.own = motion.coordinates, motion.velocities
        self.state, self.motion, self.angle_axes = state, motion, run.angle_axes
        charts = StepCharts(model, method, [state], [run.angle_axes])
        count = len(motion.velocities) - 1
        super().__init__(method, model, charts, *self.own, h, count, _limit_errors(run))

    def compare(self) -> dict[str, StepDeviations]:
        """Compare every step.

        Returns:
            By quantity of `RUN_QUANTITIES`.

        """
        found, bounds = dict[str, StepDeviations](), self.bounds
        scale = {name: np.asarray(bounds.scale[name]) for name in ACCELERATIONS[:2]}
        of_ends = [{name: x[some] for name, x in scale.items()} for some in (slice(-1), self.ends)]
        effects = _effects(of_ends, self.h)
        off = _differences(_reported(self.motion, slice(1, None)), self.after)
        for quantity, error in _norms(off).items():
            name, _ = STEP_QUANTITIES[quantity]
            found[f"run_{name}"] = StepDeviations(error, self.of_step[quantity], effects[quantity])
        totals = self._total_errors(self.start, self.velocities[1:], self.declared, self.here[1:], self.after)
        for name, error in totals.items():
            parts = ("kinetic_energy", "potential_energy") if name == "energy" else ("angular_momentum",)
            scale_of = np.sum([getattr(bounds, part) for part in parts], axis=0)
            found[f"run_{name}"] = StepDeviations(
                error[:, None],
                self.of_totals[name][:, None],
                scale_of[self.ends, None] / (EPS * SUM_ROUNDING_FACTOR),
            )
        left_out = self._left_out_steps()
        found = {name: replace(x, left_out=left_out) for name, x in found.items()}
        found["run_mean"] = self._mean(off, found)
        found["run_samples"] = self._samples()
        return found

    def _left_out_steps(self) -> NDArray[np.str_]:
        """Find the steps (steps,) for which no bound is given, and why; whether they agree plays no part.

        The step does not resolve the motion there, or slides have carried bodies far away against the
        mechanism's size, or angles are near the pose in which two of their axes are one: at a cosine below
        `MIN_MIDDLE_COSINE`, or that a step changes by `MAX_COSINE_CHANGE` of itself.  A free body may be
        anywhere, and others count from it; but for loops, whose gaps are rounded as places are.
        Where a step starts and where the declared one ends count; where the engine's own ends does not.
        The fastest rate is estimated at every `SAMPLE_STRIDE`-th sample and counts up to the next ones.
        """
        model, h, starts, some = self.model, self.h, self.states[:-1], _every_few(len(self.velocities))
        with np.errstate(all="ignore"):
            rates = _spread(fastest_rates(model, [self.states[n] for n in some]), some)[1:]
            if at := np.flatnonzero(self.strays).tolist():  # samples beyond them are of another motion
                own = [one[n] for one in (starts, self.declared_ends) for n in at]
                rates[at] = np.max(np.reshape(fastest_rates(model, own), (2, -1)), axis=0)
        # implicit steps divide by 1 − step × rate, and the rates may change between these samples
        most = MAX_TURN / 2 if self.method.implicit_forces == "all" else MAX_TURN
        size = np.sum(stretched_length(model)) + np.max(np.linalg.norm(model.point, axis=2))
        first = np.argmax(_paths(model), axis=1)  # of the bodies between each and the world
        free = model.free[first] & (not model.has_loops)
        fast = ~(rates * h <= most)
        far, singular = np.zeros((2, len(rates)), bool)
        end_rates = np.max(_rates(model, self.charts, self.declared, self.declared_ends), axis=-1)
        for states, fastest, cosine in (
            (starts, self.fastest[:-1], self.middle_cosine[:-1]),
            (self.declared_ends, end_rates, self.end_cosine),
        ):
            fast |= ~(fastest * h <= most)
            apart = states.r - np.where(free[:, None], states.r[:, first], 0.0)
            far |= ~(np.max(np.linalg.norm(apart, axis=-1), axis=-1) <= MAX_DISTANCE * size)
            change = h * fastest / np.maximum(cosine, TINY)
            is_clear = (cosine >= MIN_MIDDLE_COSINE) & (change <= MAX_COSINE_CHANGE * cosine)
            singular |= (cosine < 1) & ~is_clear
        reasons = (
            (fast, f"step × fastest rate is above {most:g}"),
            (far, f"a body is beyond {MAX_DISTANCE:g} sizes of the mechanism"),
            (singular, "an angle is too near its singular pose"),
        )
        return np.select([where for where, _ in reasons], [why for _, why in reasons], "")

    def _mean(self, off: dict[str, Array], found: dict[str, StepDeviations]) -> StepDeviations:
        """Mean over the run of the deviations of rates in one direction, over what explains it.

        A mistake that is smaller than the rounding of one step has one direction in all of them: that of what
        the step changes (masses), of the rate (drag), or of an axis (of the world for velocities, as gravity
        and forces; of the body for its rate, as moments).  What is rounded alike in all steps are constants.
        In a bound of rates, 32 ε per joint: three constant rotations (of the joint in both bodies, of the
        inertia's axes) of five roundings each, at most 16.  In 64 ε of each term of the equations: four
        constant factors (a mass, two arms, an inertia), each off by at most three (stored, turned, summed),
        12, at one stage of the three in `ACCELERATION_FACTOR`.  Chance is bounded with the probability
        `MEAN_ALARM` by the empirical Bernstein inequality, from the sample variance and the largest deviation
        (Maurer and Pontil, COLT 2009, theorem 4).
        """
        before, means, kept = self.here, list[Array](), ~found["run_rate"].is_left_out
        n = np.count_nonzero(kept)
        if n < 2:
            none = np.zeros((1, self.model.n))
            every = np.full_like(none, np.inf)
            return StepDeviations(none, every, every, np.array(["no step has a bound"]))
        often = np.log(4 / MEAN_ALARM)
        gaps = self.h * np.moveaxis(self.bounds.of_gaps[:-1], 1, 0)
        of_gaps = dict(zip(("velocity", "rate"), gaps, strict=True))
        for name, field_name in (("rate", "omega"), ("velocity", "v")):
            change = np.asarray(getattr(self.after, field_name) - getattr(before, field_name)[:-1], float)
            own = np.asarray(getattr(before, field_name)[:-1], float)
            deviations = off[f"step_{name}"][kept]
            directed = [np.sum(deviations * x[kept], -1) for x in (_directions(change), _directions(own))]
            along = np.stack([*directed, *np.moveaxis(deviations, -1, 0)], 1)  # (steps, 5, N)
            of_step = found[f"run_{name}"].bounds[kept]
            rounding = np.minimum(self.of_samples[f"step_{name}"][:-1][kept], of_step)
            constant = CONSTANT_ROUNDINGS * rounding + CONSTANT_FACTORS * (of_step - rounding)
            # arms and axes make gaps that are the same in all steps, and so may be what a limit lacks
            constant += of_gaps[name][kept] + self.uncertainty[f"step_{name}"][kept]
            constant = np.minimum(constant, of_step)
            chance = np.std(along, axis=0, ddof=1) * np.sqrt(2 * often / n)
            chance += 7 * 2 * np.max(np.abs(along), axis=0) * often / (3 * (n - 1))
            allowed = np.mean(constant, axis=0) + chance
            means += list(np.abs(np.mean(along, axis=0)) / np.maximum(allowed, TINY))
        mean = np.max(means, axis=0)[None]
        return StepDeviations(mean, np.ones_like(mean), np.full_like(mean, np.inf))

    def _samples(self) -> StepDeviations:
        """Samples against the coordinates, the first against the given state, and the times."""
        off = _norms(_differences(_reported(self.motion, slice(None)), self.here))
        mapped = [x / self.of_samples[name] for name, x in off.items()]
        of_start = {name: 2 * x[0] for name, x in self.of_samples.items()}  # both are rounded
        return sample_deviations(self.motion, self.state, self.h, of_start, mapped)

    def differences_from(
        self, method: JointSpaceMethod, model: Model, run: StepRun, at: NDArray[np.intp]
    ) -> Array:
        """Compare some steps with those of another formula or mechanism.

        Args:
            run: the engine's steps, or what its samples should be.
            at: numbers of the steps, from 0.

        Returns:
            By quantity, step and body vectors of three or four components (4, steps, N, 4), in rounding
            bounds of the declared formula.

        """
        charts = StepCharts(model, method, [self.state], [self.angle_axes])
        start = charts.divided(*(x[at] for x in self.own))
        after = charts.bodies(*coordinates_after(charts, *start, [self.h]))
        off = _differences(_reported(run.trajectory, at + 1), after)
        padded = [
            np.pad(x / self.of_step[name][at][..., None], ((0, 0), (0, 0), (0, 4 - x.shape[-1])))
            for name, x in off.items()
        ]
        return np.array(padded)


def resolves_steps(
    method: JointSpaceMethod, model: Model, state: State, h: float, count: int, run: StepRun | None,
    angle_axes: Array | None,
) -> bool:  # fmt: skip
    """Find out whether the declared formula itself resolves a motion with this step.

    Args:
        state: that a run starts from; ``angle_axes``: its coordinates, as of `StepRun`.
        h: step [s].
        count: of steps, from the start.
        run: the first of them, with coordinates; the others start from its end.

    """
    charts, done = StepCharts(model, method, [state], [angle_axes]), 0
    start = charts.start()
    if run is not None and run.trajectory.coordinates is not None and run.trajectory.velocities is not None:
        done = len(run.trajectory.t) - 1
        start = charts.divided(run.trajectory.coordinates[-1:], run.trajectory.velocities[-1:])
    with np.errstate(all="ignore"):
        passed = steps_in_charts(charts, *start, [h], count - done)
        rates = np.array([np.linalg.norm(np.asarray(links.omega, float), axis=-1) for links in passed])
        return bool(np.max(rates) * h <= MAX_TURN)


def sample_deviations(
    motion: Trajectory, state: State, h: float, of_start: dict[str, Array], mapped: Sequence[Array] = ()
) -> StepDeviations:
    """Compare the first sample of a run with the given state, and the times and the number of steps.

    Args:
        state: that the engine was given.
        h: step [s].
        of_start: bounds (N,) of the first sample, by quantity of `STEP_QUANTITIES`.
        mapped: how far samples (T, N) are off an engine's coordinates, in bounds.

    """
    count = np.arange(len(motion.t))
    late = np.abs(motion.t - count * h) / (CLOCK_ROUNDINGS * EPS * h * (1 + count) ** 2)
    late[-1] = np.inf if motion.steps != count[-1] else late[-1]
    worst = np.max([np.broadcast_to(late[:, None], motion.r.shape[:2]), *mapped], axis=0)
    for name, x in _norms(_differences(_reported(motion, 0), state)).items():
        worst[0] = np.maximum(worst[0], x / np.maximum(of_start[name], TINY))
    return StepDeviations(worst, np.ones_like(worst), np.full_like(worst, np.inf))


# -- constraints and an iterative solver -------------------------------------------------------------


def compare_parts(
    method: ConstrainedMethod, model: Model, states: Sequence[State], runs: Runs
) -> dict[str, StepDeviations]:
    """Compare an iterative engine's steps in parts that need no iteration.

    Args:
        states: states that the steps start from.

    Returns:
        The differences by quantity: quadrature, equations, first acceleration.

    """
    found = _at_places(_compared_parts(method, model, states, runs), CONSTRAINED_QUANTITIES)
    return {quantity: one for quantity, one in found.items() if len(one.errors)}


def _compared_parts(
    method: ConstrainedMethod, model: Model, states: Sequence[State], runs: Runs
) -> Iterator[tuple[str, Place, Array, Array, Array]]:
    first: dict[int, tuple[Array, Array]] = {}  # by state: first accelerations and their bounds
    for index, h, run in runs:
        place = Place(index, h, len(run.trajectory.t) - 1)
        for name, parts in constrained_deviations(method, model, run, h).items():
            for part in parts:
                worst, body = np.argmax(part.ratios, axis=0), np.arange(part.errors.shape[1])
                errors, bounds, effects = (x[worst, body] for x in (part.errors, part.bounds, part.effects))
                yield f"step_{name}", place, errors, bounds, effects
        if not has_written_rows(model):
            continue
        if index not in first:
            solved = remembered_rounding_bound(model, states[index])
            allowed = first_acceleration_bound(model, method, states[index]) + np.maximum(
                solved.acceleration, solved.angular_acceleration
            )
            first[index] = first_coordinate_acceleration(model, states[index]), allowed
        true, allowed = first[index]
        error = np.asarray(np.max(np.abs(true - engine_coordinates(run)[2][0]), axis=-1), float)
        size = np.full(model.n, float(np.max(np.abs(true))))
        yield "step_first_acceleration", place, error, allowed, size


def constrained_deviations(
    method: ConstrainedMethod, model: Model, run: StepRun, h: float
) -> dict[str, list[StepDeviations]]:
    """Compare every step in parts that need no iteration.

    Returns:
        Quadrature of q and of q̇, and the equations where they are written here.

    """
    found = {
        "quadrature": [
            StepDeviations(np.max(np.abs(difference), axis=-1), bound, effect)
            for difference, bound, effect in _quadrature_differences(method, run, h, model.has_loops)
        ]
    }
    if has_written_rows(model):
        residual = constrained_residual(model, method, run)
    elif method.constraint_level == "position" and not (model.has_loops or model.has_elements):
        residual = projected_residual(model, run)
    else:
        return found
    allowed = np.maximum(method.solver_atol, method.solver_rtol * residual.size)
    allowed = allowed + STEP_ROUNDINGS * EPS * residual.size
    columns = (x[:, None] for x in (residual.residual, allowed, residual.size))
    return found | {"equations": [StepDeviations(*columns)]}


def constrained_samples(run: StepRun, state: State, h: float) -> StepDeviations:
    """Compare a run's samples, times and number of steps with what was asked for, as `sample_deviations`.

    The coordinates are those of the samples; the first ones are the state's own, and its rates are converted.
    """
    sizes = {
        "step_position": np.linalg.norm(state.r, axis=-1),
        "step_attitude": np.ones(len(state.r)),
        "step_velocity": np.linalg.norm(state.v, axis=-1),
        "step_rate": np.linalg.norm(state.omega, axis=-1),
    }
    of_start = {name: STEP_ROUNDINGS * EPS * size for name, size in sizes.items()}
    return sample_deviations(run.trajectory, state, h, of_start)


def quadrature_residuals(method: ConstrainedMethod, runs: Runs, has_loops: bool) -> Array:
    """Return the differences of an engine's steps from the quadrature of its accelerations.

    Args:
        method: a formula, declared or not.
        has_loops: whether they are of a mechanism with loops.

    Returns:
        One vector over all runs, steps, bodies and coordinates, each in rounding bounds.

    """
    found = []
    for _, h, run in runs:
        for difference, bound, _ in _quadrature_differences(method, run, h, has_loops):
            found.append((difference / np.maximum(bound, TINY)[..., None]).ravel())
    return np.concatenate(found)


def _quadrature_differences(
    method: ConstrainedMethod, run: StepRun, h: float, has_loops: bool
) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
    """Of q and q̇: differences (T − 1, N, 7), their bounds and the accelerations' effect (T − 1, N)."""
    q, qdot, qddot = engine_coordinates(run)
    size = [np.max(np.abs(np.asarray(x, float)), axis=-1) for x in (q, qdot, qddot)]
    if has_loops:  # a body may be held still, whose iterates move as the others'
        size[2] = np.broadcast_to(np.max(size[2], axis=1, keepdims=True), size[2].shape)
    size[2] = np.maximum.accumulate(size[2], axis=0)  # the averaged a depends on all earlier ones
    off_q, off_rate = (
        np.asarray(predicted - found[1:], float)
        for predicted, found in zip(constrained_quadrature(method, run, h), (q, qdot), strict=True)
    )
    roundings, before = STEP_ROUNDINGS * EPS, np.maximum(size[1][:-1], size[1][1:])
    of_q, of_rate = h * h * size[2][1:], h * size[2][1:]  # the accelerations' effects
    return (
        (off_q, roundings * (size[0][1:] + h * before + of_q), of_q),
        (off_rate, roundings * (before + of_rate), of_rate),
    )
