"""Steps of an engine against its declared formula: differences, and the bounds that rounding explains.

Engines in joint coordinates are compared with the formula itself: positions, attitudes and rates per body,
within a rounding bound.  With b the state-level bounds of accelerations, W and V the largest rate and speed
of any link up to body k, n its place among the links, ℓ the chain's stretched length up to it, ε = 2⁻⁵³:

    ω′  3 h (b_α + c) + 32 ε n W        ṙ  3 h (b_a + c ℓ) + 32 ε n max(V, W ℓ)
    p   h (bound of ω′) + 32 ε n          r  h (bound of ṙ) + 32 ε n ℓ

b holds the error of the accelerations, the factor 3 the stages elsewhere, the second term the roundings of
quaternion products and of the way from joint rates to the bodies', c = h W Σ (b_α of the links before, and of
rods about their own axes) what relative rates pass on.  Ten steps: the sum over the steps, times
the growth of perturbations, as one.

Of loops b is larger by what the roundings of gaps and of their rates (32 ε (ℓ′, 1) and 32 ε (V + W ℓ′, W) in
length and angle, ℓ′ the mechanism's size) leave in accelerations, a² and 2 a times their sum with the
method's correction a, through the forces that close the loops, M⁻¹ Jᵀ (J M⁻¹ Jᵀ)⁻¹.

Engines that solve a step iteratively are compared in parts that need no iteration: the quadrature of their
own accelerations, the residual of their equations, and their first accelerations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from plumbline.model.datatypes import KINDS, Array, Kind, Model, State, StepRun
from plumbline.model.kinematics import (
    angular_velocity,
    complete_state,
    mass_matrix,
    stretched_length,
    velocity_jacobian,
)
from plumbline.model.loops import RANK_TOLERANCE, cut_open
from plumbline.model.sampling import derive_seed
from plumbline.model.step_methods import ConstrainedMethod, JointSpaceMethod, StepMethod
from plumbline.truth.rounding_bound import EPS, RoundingBound, remembered_rounding_bound
from plumbline.truth.step_charts import BodyStates
from plumbline.truth.step_formulas import (
    constrained_quadrature,
    constrained_residual,
    engine_coordinates,
    first_acceleration_bound,
    first_coordinate_acceleration,
    joint_space_steps,
)

STEP_ROUNDINGS = 32
ACCELERATION_FACTOR = 3.0
DISTURBANCE = 1e-9  # of rates, to measure the growth of perturbations
RESIDUAL_STEPS = 2  # after one, Euler does not show the axial inertia of rods
MAX_GROWTH = 1e4  # of perturbations; beyond it the method itself is unstable, and nothing is compared
STEP_UNITS = {"step_position": "m", "step_attitude": "rad", "step_velocity": "m/s", "step_rate": "rad/s"}
CONSTRAINED_UNITS = {
    "step_quadrature": "1",
    "step_equations": "N",
    "step_first_acceleration": "m/s²",
}

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


@dataclass
class Comparisons:
    """Errors of one quantity over bodies, states and steps."""

    errors: list[float] = field(default_factory=list)
    bounds: list[float] = field(default_factory=list)
    looseness: list[float] = field(default_factory=list)  # bound over the effect of the accelerations
    bodies: list[int] = field(default_factory=list)  # from 0
    places: list[Place] = field(default_factory=list)

    @property
    def ratios(self) -> list[float]:
        """Errors over their bounds."""
        tiny = np.finfo(float).tiny
        return [error / max(bound, tiny) for error, bound in zip(self.errors, self.bounds, strict=True)]

    def add(self, errors: Array, bounds: Array, effects: Array, place: Place) -> None:
        """Add the errors of the bodies, or of one body, at one place.

        Args:
            errors: (K,) sizes of differences.
            bounds: (K,) what rounding explains, in the same unit.
            effects: (K,) effect of the accelerations on the quantity.

        """
        for k, (error, bound, effect) in enumerate(zip(errors, bounds, effects, strict=True)):
            self.errors.append(float(error))
            self.bounds.append(float(bound))
            self.looseness.append(float(bound / effect) if effect > 0 else 0.0)
            self.bodies.append(k)
            self.places.append(place)


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
        used = dict.fromkeys(index for index, *_ in starts)
        self.bounds = {index: self._acceleration_bound(states[index]) for index in used}
        nearby = {index: _disturbed(model, states[index], self.bounds[index]) for index in used}
        disturbed = [nearby[index] for index, *_ in starts]
        self.counts = tuple(counts) or step_counts(method)
        self._end_bounds: dict[tuple[int, int], _EndBounds] = {}
        count = max(self.counts)
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
        for i, (_, h) in enumerate(self.places):
            for count in self.counts:
                if not self.growth[i, count] < MAX_GROWTH:
                    continue
                ends, bound = self._bounds_after(i, count)
                grown = {name: count * self.growth[i, count] * limit for name, limit in bound.items()}
                yield i, count, grown, _effects(ends, h, count)

    def compare(self, runs: Sequence[StepRun]) -> dict[str, Comparisons]:
        """Compare engines' steps with the formula's, body by body.

        Args:
            runs: one per start, with as many steps as the engine took.

        Returns:
            Errors and bounds by quantity.

        """
        found = {quantity: Comparisons() for quantity in STEP_UNITS}
        for i, count, limit, scale in self.limits():
            if count >= len(runs[i].trajectory.t):
                continue
            index, h = self.places[i]
            place = Place(index, h, count)
            for quantity, error in _errors(self.true[i][count], runs[i], count).items():
                found[quantity].add(error, limit[quantity], scale[quantity], place)
        return found

    def residuals(self, method: JointSpaceMethod, runs: Sequence[StepRun]) -> Array:
        """Return the differences of an engine's first steps from those of another formula.

        Args:
            method: the other formula, in the same coordinates.
            runs: the engine's steps, as given before.

        Returns:
            One vector over all runs, bodies and components after `RESIDUAL_STEPS` steps, each in rounding
            bounds of the declared formula.

        """
        sizes, axes = [h for _, h in self.places], [run.angle_axes for run in runs]
        motions = joint_space_steps(self.model, self.starts, sizes, method, RESIDUAL_STEPS, axes)
        found = []
        for i, run in enumerate(runs):
            count = min(RESIDUAL_STEPS, len(run.trajectory.t) - 1)
            _, bound = self._bounds_after(i, count)
            for name, difference in _differences(_pick(motions[count], i), run, count).items():
                found.append((difference / (count * bound[name][:, None])).ravel())
        return np.concatenate(found)

    def _bounds_after(self, i: int, count: int) -> _EndBounds:
        """Rounding bounds at both ends of a run's first steps, and those of the steps; computed once."""
        if (i, count) not in self._end_bounds:
            (index, h), end = self.places[i], _rounded(self.true[i][count])
            ends = self.bounds[index], self._acceleration_bound(end)
            self._end_bounds[i, count] = ends, self.step_bound((self.starts[i], end), ends, h, count)
        return self._end_bounds[i, count]

    def _acceleration_bound(self, state: State) -> RoundingBound:
        """The state level's bound, and what the correction of gaps adds to its accelerations."""
        bound, rate = remembered_rounding_bound(self.model, state), self.method.gap_correction
        if not (self.model.has_loops and rate):
            return bound
        moving, turning = _correction_roundings(self.model, state, rate)
        return replace(
            bound,
            acceleration=bound.acceleration + moving,
            angular_acceleration=bound.angular_acceleration + turning,
        )

    def step_bound(
        self, ends: tuple[State, ...], bounds: tuple[RoundingBound, ...], h: float, count: int
    ) -> dict[str, Array]:
        """Compute the bounds of one of several steps.

        Args:
            ends: the states at the ends of the steps.
            bounds: rounding bounds at ``ends``.
            h: step [s].

        Returns:
            By quantity the bounds (N,), in its unit of `STEP_UNITS`.

        """
        norm, model = np.linalg.norm, self.model
        kinds, far = model.kind[: model.n], model.body[: model.n, 0]  # of the joints of the tree
        path, slides = _paths(far), np.array([_slides(kind) for kind in kinds])
        rate = np.max([np.maximum(norm(s.omega, axis=1), norm(s.udot, axis=1)) for s in ends], axis=0)
        speed = np.max([norm(s.v, axis=1) for s in ends], axis=0)
        W, V = (np.max(np.where(path, x, 0.0), axis=1) for x in (rate, speed))
        arm = path @ stretched_length(model)
        if np.any(slides):
            arm = arm + np.max([np.max(np.where(path, norm(s.r, axis=1), 0.0), axis=1) for s in ends], axis=0)
        links = [max(1, len(KINDS[kind].motions)) + KINDS[kind].holds_distance for kind in kinds]
        rounding = STEP_ROUNDINGS * EPS * (path @ np.array(links))
        turning, acceleration, torque = (
            np.max([getattr(b, name) for b in bounds], axis=0)
            for name in ("angular_acceleration", "acceleration", "rod_torque")
        )
        # Rates are kept relative to the link before: what rounding does to one link, and to the spin of a
        # rod, reaches those beyond it once they have turned against it.
        above, shifted = (
            np.where(far >= 0, x[far], 0.0) for x in (turning, acceleration * (slides @ path > 0))
        )
        if self.method.coordinates == "joint rotations":
            axial = self.method.rod_axial_inertia * np.trace(model.inertia, axis1=1, axis2=2)
            # bodies on rods have inertia; of others there is no torque here
            above = above + np.divide(torque, axial, out=np.zeros_like(axial), where=torque > 0)
        leaked, passed = (count * np.minimum(1.0, h * W) * (path @ x) for x in (above, shifted))
        omega = ACCELERATION_FACTOR * h * (turning + leaked) + rounding * W
        velocity = ACCELERATION_FACTOR * h * (acceleration + leaked * arm + passed)
        velocity += rounding * np.maximum(V, W * arm)
        if self.method.free_coordinates == "rigid motion" and self.method.formula == "Runge-Kutta":
            # closed forms of dexp⁻¹ of a rigid motion divide differences by the square of the turn
            free = np.array([KINDS[kind].holds_nothing for kind in kinds])
            turn = np.clip(h * rate, 1e-4, 1.0)  # rad
            velocity += path @ np.where(free, STEP_ROUNDINGS * EPS * speed / turn**2, 0.0)
        return {
            "step_rate": omega,
            "step_velocity": velocity,
            "step_attitude": count * h * omega + rounding,
            "step_position": count * h * velocity + rounding * arm,
        }


def _correction_roundings(model: Model, state: State, rate: float) -> Array:
    """(2, N) r̈ and ω̇′ by the roundings of gaps that a method corrects with a rate a [1/s]."""
    cut = cut_open(model)
    there, scale, norm = cut.state(state), cut.row_scale, np.linalg.norm
    of_bodies = velocity_jacobian(cut.model, there).reshape(cut.model.n, 6, -1)
    J = np.concatenate([of_bodies[b] - of_bodies[c] for b, c in cut.ends]) * scale[:, None]
    # a rod has no rate along itself, and M no inverse
    pushed = np.linalg.pinv(mass_matrix(cut.model, there), hermitian=True) @ J.T
    response = pushed @ np.linalg.pinv(J @ pushed, rcond=RANK_TOLERANCE, hermitian=True) * scale
    size = np.max(norm(state.r, axis=1)) + np.max(norm(model.point, axis=2))
    turning = np.max(norm(state.omega, axis=1))
    moving = np.max(norm(state.v, axis=1)) + turning * size
    rows = STEP_ROUNDINGS * EPS * (rate**2 * np.array([size, 1.0]) + 2 * rate * np.array([moving, turning]))
    found = np.abs(of_bodies @ response) @ np.tile(np.repeat(rows, 3), len(cut.ends))
    return np.asarray(norm(found.reshape(-1, 2, 3), axis=2)[cut.place[: model.n]].T)


def _paths(far: NDArray[np.intp]) -> NDArray[np.bool_]:
    """[k, b] whether body b is k or between k and the world, from each body's far body."""
    path = np.eye(len(far), dtype=bool)
    for k, above in enumerate(far):
        path[k] |= path[above] & (above >= 0)
    return path


def _slides(kind: Kind) -> bool:
    return KINDS[kind].holds_nothing or bool(KINDS[kind].slide_axes)


def _pick(links: BodyStates, i: int) -> BodyStates:
    return BodyStates(*(getattr(links, name)[i] for name in BodyStates.__match_args__))


def _disturbed(model: Model, state: State, bound: RoundingBound) -> State:
    """A state nearby: rates off in random directions, in the proportions in which roundings disturb them."""
    rng = np.random.default_rng(derive_seed("disturbed step"))
    tolerance = np.asarray(bound.angular_acceleration)
    size = DISTURBANCE * max(float(np.max(np.linalg.norm(state.omega, axis=1))), 1.0) / np.max(tolerance)
    omega = state.omega + (size * tolerance)[:, None] * rng.normal(size=(model.n, 3))
    xdot = state.xdot + (size * tolerance)[:, None] * rng.normal(size=state.xdot.shape)
    v = state.v + (size * np.asarray(bound.acceleration))[:, None] * rng.normal(size=(model.n, 3))
    return complete_state(model, replace(state, omega=omega, xdot=xdot, v=v))


def _separation(links: BodyStates, i: int, count: int, weights: dict[str, Array]) -> float:
    """How far the motion nearby is from motion i of ``count``, in units of the bounds of a step."""
    found = []
    for name, quantity in (("omega", "step_rate"), ("v", "step_velocity")):
        motions = getattr(links, name)
        with np.errstate(all="ignore"):
            apart = np.asarray(motions[i] - motions[i + count], float)
            found.append(np.linalg.norm(apart, axis=-1) / weights[quantity])
    return float(np.max(found))


def _rounded(links: BodyStates) -> State:
    names = ("p", "omega", "u", "udot", "r", "v", "x", "xdot")
    return State(*(np.asarray(getattr(links, name), float) for name in names))


def _differences(true: BodyStates, run: StepRun, count: int) -> dict[str, Array]:
    """Differences (N, ·) per body; of attitudes twice those of quaternions as they are, not normalised."""
    t = run.trajectory
    p = t.p[count].astype(np.longdouble)
    sign = np.where(np.sum(p * true.p, axis=-1, keepdims=True) < 0, -1, 1)
    pairs = {
        "step_position": (t.r[count], true.r),
        "step_velocity": (t.v[count], true.v),
        "step_rate": (angular_velocity(p, t.pdot[count]), true.omega),
        "step_attitude": (2 * sign * p, 2 * true.p),
    }
    return {name: np.asarray(a - b, float) for name, (a, b) in pairs.items()}


def _errors(true: BodyStates, run: StepRun, count: int) -> dict[str, Array]:
    """Sizes (N,) of the differences."""
    found = _differences(true, run, count)
    return {name: np.linalg.norm(difference, axis=-1) for name, difference in found.items()}


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


def compare_parts(
    method: ConstrainedMethod,
    model: Model,
    states: Sequence[State],
    runs: Runs,
) -> dict[str, Comparisons]:
    """Compare an iterative engine's steps in parts that need no iteration.

    Args:
        states: states that the steps start from.

    Returns:
        The differences by quantity: quadrature, equations, first acceleration.

    """
    found = {quantity: Comparisons() for quantity in CONSTRAINED_UNITS}
    first: dict[int, tuple[Array, Array]] = {}  # by state: first accelerations and their bounds
    for index, h, run in runs:
        place = Place(index, h, len(run.trajectory.t) - 1)
        for difference, bound, effect in _quadrature_differences(method, run, h, model.has_loops):
            error = np.max(np.abs(difference), axis=-1)  # (T − 1, N)
            worst = np.argmax(error / np.maximum(bound, np.finfo(float).tiny), axis=0)
            body = np.arange(model.n)
            found["step_quadrature"].add(error[worst, body], bound[worst, body], effect[worst, body], place)
        if not model.has_chain_joints:  # the rows of its other joints off |p| = 1 are not written here
            continue
        residual = constrained_residual(model, method, run)
        allowed = (
            np.maximum(method.solver_atol, method.solver_rtol * residual.size)
            + STEP_ROUNDINGS * EPS * residual.size
        )
        worst_step = int(np.argmax(residual.residual / allowed))
        found["step_equations"].add(
            residual.residual[worst_step : worst_step + 1], allowed[worst_step : worst_step + 1],
            residual.size[worst_step : worst_step + 1], place,
        )  # fmt: skip
        if index not in first:
            solved = remembered_rounding_bound(model, states[index])
            allowed = first_acceleration_bound(model, method, states[index]) + np.maximum(
                solved.acceleration, solved.angular_acceleration
            )
            first[index] = first_coordinate_acceleration(model, states[index]), allowed
        true, allowed = first[index]
        error = np.asarray(np.max(np.abs(true - engine_coordinates(run)[2][0]), axis=-1), float)
        found["step_first_acceleration"].add(error, allowed, np.zeros(model.n), place)
    return {quantity: one for quantity, one in found.items() if one.errors}


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
            found.append((difference / np.maximum(bound, np.finfo(float).tiny)[..., None]).ravel())
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
    predicted_q, predicted_rate = constrained_quadrature(method, run, h)
    roundings = STEP_ROUNDINGS * EPS
    before = np.maximum(size[1][:-1], size[1][1:])
    return (
        (
            np.asarray(predicted_q - q[1:], float),
            roundings * (size[0][1:] + h * before + h * h * size[2][1:]),
            h * h * size[2][1:],
        ),
        (
            np.asarray(predicted_rate - qdot[1:], float),
            roundings * (before + h * size[2][1:]),
            h * size[2][1:],
        ),
    )
