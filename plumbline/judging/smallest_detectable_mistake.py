"""Coverage: the smallest mistake in each parameter that a run of a correct engine would report.

The engine is correct, but its model or initial state has one wrong number. To first order each judged
quantity is off in proportion; the mistake at which the first of them passes its bound is the smallest that
the level reports. docs/coverage.md explains the table.

- state: every quantity at every compared state, within the rounding bound. A mistake in the initial state
  shows at that state only.
- step: one step and ten of the classical Runge-Kutta method, and every step of a run, within the bounds of
  the level.
- trajectory and invariants: the tolerances of the judged rows; the effect is that on the true motion.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plumbline.judging.rows import Level, Row, Verdict
from plumbline.judging.state_level import STATE_UNITS
from plumbline.measurements.single_steps import (
    MAX_STEP_BODIES,
    RUN_STEP_SHARE,
    STEP_STATES,
    run_counts,
    step_sizes,
)
from plumbline.model.datatypes import SPRING_FIELDS, Array, Float, Model, State, Trajectory
from plumbline.model.invariants import (
    INVARIANT_UNITS,
    LIMITS,
    MOTION_UNITS,
    Invariants,
    compute_invariants,
    motion_errors,
)
from plumbline.model.kinematics import (
    angular_velocity,
    complete_state,
    stack_states,
    with_joint_coordinates,
)
from plumbline.model.step_methods import SERIES_TURN, JointSpaceMethod, classical_runge_kutta
from plumbline.truth.parameter_effects import difference_effects, effects_at_states
from plumbline.truth.parameters import STATE_KINDS, Parameter, list_parameters, perturb
from plumbline.truth.predictability_horizon import project_to_manifold
from plumbline.truth.rounding_bound import EPS, TINY, remembered_rounding_bound
from plumbline.truth.step_charts import StepCharts
from plumbline.truth.step_comparison import FormulaSteps, StepsFromSamples
from plumbline.truth.trajectory_truth import (
    MOTION_MISTAKE,
    AccurateMotion,
    PerturbedMotion,
    accurate_motions,
    accurate_runs,
    perturbed_motions,
    resolved_motions,
)

COVERED_LEVELS: tuple[Level, ...] = ("state", "step", "trajectory", "invariants")
MAX_MISTAKE = 0.1  # of a parameter's scale: only larger ones are reported, or none; the level does not see it
WEAK_MISTAKE = 1e-9  # from here on the order of an effect is found by a second mistake …
LARGER_MISTAKE = 4.0  # … that is larger by this factor
LEAST_FALL = 1.8  # at two thirds of a step, of an integrator's error: (4 + 1.5⁴) / 5 if a fifth of it is none
FURTHER_MISTAKES = (5e-4, MAX_MISTAKE / LARGER_MISTAKE)  # where smaller ones pass no tolerance
DOUBTFUL_MISTAKE = 1e-6  # from here on an effect may be rounding of the runs: a proof is tried
NO_EFFECT = 1e-9  # of the largest effect that a term could have: rounding
MAX_SLOWDOWN = 10  # of a motion by a mistake, in steps
RUN_SAMPLES = 33  # of a run, from which steps with a mistake are taken
RUN_MISTAKE = 1e-6  # of a parameter's scale in them, in extended precision
MOTION_SAMPLES = 32  # of a motion, at which the effect of a mistake is measured; or all, where it has fewer
PROOF_SAMPLES = 17  # of the motion, at which a parameter's term is shown to vanish
# of free bodies the coordinates of the wider bound: what it reports, the others report too
STEP_METHOD = classical_runge_kutta(
    "joint rotations", free_coordinates="rigid motion", closed_form_turn=SERIES_TURN
)
_PLACES: dict[str, str] = {
    "state": "at every compared state",
    "step": "at every state that a compared step starts from",
}


@dataclass(frozen=True)
class CoverageEntry:
    """The smallest mistake in one parameter that one level of one scenario reports."""

    scenario: str
    level: Level
    body: int  # from 1; 0 for gravity; of springs between points the number of the spring
    joint: str  # kind of the joint that the body hangs by; "spring"; empty for gravity
    kind: str  # of the parameter, as in `plumbline.truth.parameters.UNITS`
    parameter: str  # kind and component
    value: float
    unit: str
    scale: float  # what ``smallest`` is relative to, in ``unit``
    smallest: float | None  # smallest mistake that is reported, over ``scale``, at least ε; None: none is
    engine: str  # the engine that needs the largest; empty at levels where engines do not differ
    row: str  # integrator and quantity of the row that reports it first
    proof: str = ""  # why no mistake can be seen here, a sentence

    @property
    def is_seen(self) -> bool:
        """Whether the level reports a mistake in this parameter."""
        return self.smallest is not None


class _Ratios:
    """Per parameter the largest error over bound that a relative mistake of 1 makes, and where."""

    def __init__(self, count: int) -> None:
        self.ratio, self.row = np.zeros(count), [""] * count

    def add(self, at: int, ratio: float, row: str) -> None:
        """Keep the larger ratio of a parameter."""
        if ratio > self.ratio[at]:
            self.ratio[at], self.row[at] = ratio, row


def _sharpest(several: Sequence[_Ratios]) -> _Ratios:
    """Of each parameter the largest ratio."""
    found = _Ratios(len(several[0].ratio))
    for one in several:
        for i, (ratio, row) in enumerate(zip(one.ratio, one.row, strict=True)):
            found.add(i, float(ratio), row)
    return found


def scenario_coverage(
    name: str,
    model: Model,
    state: State,
    times: Float[Array, "samples"],
    states: Sequence[State],
    rows: Iterable[Row],
    levels: Sequence[Level] = COVERED_LEVELS,
    part: slice = slice(None),
) -> list[CoverageEntry]:
    """Compute the coverage table of one scenario.

    Args:
        times: its sample times [s].
        states: the states of the levels state and step, the initial one first unless its pose is singular.
        rows: judged rows of the scenario, of correct engines; those that agree count, and only their engines,
            quantities and tolerances.
        levels: of `COVERED_LEVELS`.
        part: which of the parameters, in the order of `list_parameters`; each is measured by itself.

    Returns:
        One entry per level and parameter of the part. At trajectory and invariants level a mistake counts as
        seen if it is reported in every engine that has rows there: the entry is that of the bluntest engine.

    """
    parameters = list_parameters(model, state)[part]
    judged = [row for row in rows if row.scenario == name and row.verdict == Verdict.AGREES]
    found: list[CoverageEntry] = []
    if "state" in levels:
        offered: dict[str, set[str]] = {}
        for row in judged:
            if row.level == "state":
                offered.setdefault(row.engine, set()).add(row.quantity)
        is_initial_compared = np.array_equal(states[0].p, state.p) and np.array_equal(states[0].r, state.r)
        by_quantity = _state_ratios(model, states, parameters, is_initial_compared)
        by_engine = {
            engine: _sharpest([by_quantity[q] for q in STATE_UNITS if q in names])
            for engine, names in (offered or {"": set(STATE_UNITS)}).items()
        }
        proofs = _proofs(model, states, parameters, by_engine, "state")
        if not is_initial_compared:
            why = "the initial pose is singular, and no engine is compared at it"
            proofs |= {i: why for i, one in enumerate(parameters) if one.kind in STATE_KINDS}
        found += _entries(name, "state", model, parameters, by_engine, proofs)
    if "step" in levels and not model.has_loops and model.n <= MAX_STEP_BODIES:
        some = states[:STEP_STATES]
        of_run = run_ratios(STEP_METHOD, model, state, parameters)
        by_engine = {"": _sharpest([_step_ratios(model, some, parameters), of_run])}
        proofs = _proofs(model, some, parameters, by_engine, "step")
        found += _entries(name, "step", model, parameters, by_engine, proofs)
    # with a mistake, an overconstrained loop locks: it has no motion to compare
    motion_levels = [x for x in ("trajectory", "invariants") if x in levels and not model.has_loops]
    of_runs = [row for row in judged if row.level in motion_levels and row.compared_until is not None]
    if of_runs:
        found += _motion_entries(name, model, state, times, parameters, of_runs)
    return found


def _entries(
    name: str, level: Level, model: Model, parameters: Sequence[Parameter], by_engine: Mapping[str, _Ratios],
    proofs: Mapping[int, str],
) -> list[CoverageEntry]:  # fmt: skip
    """The entries of one level: of each parameter the bluntest engine."""
    found = []
    for i, one in enumerate(parameters):
        engine = min(by_engine, key=lambda e: by_engine[e].ratio[i])
        ratio = float(by_engine[engine].ratio[i])
        smallest = max(1 / ratio, EPS) if ratio > 1 / MAX_MISTAKE and i not in proofs else None
        found.append(
            CoverageEntry(
                name,
                level,
                one.body + 1,
                "spring" if one.kind in SPRING_FIELDS else ("", *model.kind)[one.body + 1],
                one.kind,
                one.name,
                one.value,
                one.unit,
                one.scale,
                smallest,
                engine if smallest else "",
                by_engine[engine].row[i] if smallest else "",
                proofs.get(i, ""),
            )
        )
    return found


# -- states ------------------------------------------------------------------------------------------


def _state_ratios(
    model: Model, states: Sequence[State], parameters: Sequence[Parameter], is_initial_first: bool
) -> dict[str, _Ratios]:
    """Effects over rounding bounds at all states, by quantity; mistakes in the initial state at the first."""
    kinds = [one.kind in STATE_KINDS for one in parameters]
    cases = [(np.flatnonzero(np.logical_not(kinds)).tolist(), states)]
    if is_initial_first:
        cases.append((np.flatnonzero(kinds).tolist(), states[:1]))
    ratios = {quantity: _Ratios(len(parameters)) for quantity in STATE_UNITS}
    for indices, some in cases:
        effects = effects_at_states(model, some, [parameters[i] for i in indices])
        for found in _effects_in_sizes(model, some, effects, "state"):
            for quantity, effect in found.items():
                for i, value in zip(indices, effect, strict=True):
                    ratios[quantity].add(i, value * parameters[i].scale, quantity)
        _add_squares(model, some, parameters, indices, ratios)
    return ratios


def _add_squares(
    model: Model, states: Sequence[State], parameters: Sequence[Parameter], indices: Iterable[int],
    ratios: Mapping[str, _Ratios],
) -> None:  # fmt: skip
    """Add the effects that grow with the square of a mistake, where that of first order is not seen."""
    unseen = [i for i in indices if all(one.ratio[i] <= 1 / MAX_MISTAKE for one in ratios.values())]
    some = [parameters[i] for i in unseen]
    if not some:
        return
    scale = np.array([one.scale for one in some])

    def worst(mistake: float) -> dict[str, Array]:
        effects = difference_effects(model, states, some, mistake)
        found = _effects_in_sizes(model, states, effects, "state")
        return {name: np.max([one[name] for one in found], axis=0) * scale * mistake for name in found[0]}

    small = worst(MAX_MISTAKE / 3)
    for name, large in worst(MAX_MISTAKE).items():
        is_square = (large > 1) & (large > LARGER_MISTAKE * small[name])
        for k in np.flatnonzero(is_square):
            ratios[name].add(unseen[k], float(np.sqrt(large[k])) / MAX_MISTAKE, name)


# -- steps -------------------------------------------------------------------------------------------


def _step_ratios(model: Model, states: Sequence[State], parameters: Sequence[Parameter]) -> _Ratios:
    """Effects after one step and ten over the bounds of the step level."""
    sizes = step_sizes(False, model, states)
    starts = [(index, h, None) for index in range(len(states)) for h in sizes[index]]
    steps = FormulaSteps(STEP_METHOD, model, states, starts)
    limits: dict[int, dict[int, dict[str, Array]]] = {}
    for i, count, limit, _ in steps.limits():
        limits.setdefault(i, {})[count] = limit
    ratios = _Ratios(len(parameters))
    for i, counts in limits.items():
        index, h = steps.places[i]
        chosen = [k for k, one in enumerate(parameters) if index == 0 or one.kind not in STATE_KINDS]
        times = np.asarray(h * np.arange(max(counts) + 1), float)
        (accurate,) = accurate_motions(model, states[index], times)
        motions = perturbed_motions(accurate, [parameters[k] for k in chosen])
        for k, motion in zip(chosen, motions, strict=True):
            for count, limit in counts.items():
                for quantity, error in _step_errors(motion, count).items():
                    worst = float(np.max(error / np.maximum(limit[quantity], TINY)))
                    ratios.add(k, worst / MOTION_MISTAKE, quantity)
    return ratios


def run_ratios(
    method: JointSpaceMethod, model: Model, state: State, parameters: Sequence[Parameter]
) -> _Ratios:
    """Effects of mistakes on every step of a run over its bounds, from some samples along the true motion.

    What the mean of the deviations shows besides is not counted: its bound depends on how the engine rounds.

    Args:
        method: a declared formula.
        state: where the run starts.
        parameters: mistakes in them.

    """
    h = RUN_STEP_SHARE * step_sizes(False, model, [state])[0][0]
    times = np.linspace(0, h * max(run_counts(model.n)), RUN_SAMPLES)
    (motion,) = accurate_motions(model, state, times)
    # by the coordinates of the joints alone, so that a mistake which leaves them does not move a sample
    states = complete_state(model, stack_states([state, *_visited_states(motion, RUN_SAMPLES)[1:]]))
    charts = StepCharts(model, method, states)
    steps = StepsFromSamples(method, model, charts, *charts.reported(), h, RUN_SAMPLES)
    ratios = _Ratios(len(parameters))
    for k, one in enumerate(parameters):
        if one.kind in STATE_KINDS:
            off = {"run_samples": steps.start_ratio(perturb(model, state, one, RUN_MISTAKE)[1])}
        else:
            off = steps.mistake_ratios(*perturb(model, states, one, RUN_MISTAKE))
        for quantity, ratio in off.items():
            ratios.add(k, ratio / RUN_MISTAKE, quantity)
    return ratios


def _step_errors(motion: PerturbedMotion, count: int) -> dict[str, Array]:
    """Differences (N,) after some steps, as the step level measures them."""
    run, true = motion.run, motion.true
    omega, true_omega = (angular_velocity(t.p[count], t.pdot[count]) for t in (run, true))
    pairs = {
        "step_position": run.r[count] - true.r[count],
        "step_velocity": run.v[count] - true.v[count],
        "step_rate": omega - true_omega,
        "step_attitude": 2 * (run.p[count] - true.p[count]),
    }
    return {name: np.linalg.norm(x, axis=-1) for name, x in pairs.items()}


# -- motions -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _MotionTolerance:
    """What a row of a run compares: the running maximum of a difference up to a time with a tolerance."""

    row: Row
    quantity: str  # of `MOTION_UNITS`, or an invariant
    tolerance: float
    last_sample: int


def _motion_tolerance(row: Row, times: Array) -> _MotionTolerance | None:
    """The tolerance that a mistake must pass in this row; None where the row compares no motion.

    An invariant that is exactly zero, as the joint gap of a body that turns about the pivot, says nothing of
    the uncertainty that a mistaken motion would have.
    """
    quantity = LIMITS.get(row.quantity, row.quantity)
    if quantity not in (*MOTION_UNITS, *INVARIANT_UNITS) or not row.tolerance:
        return None
    if quantity in INVARIANT_UNITS and row.value == 0:
        return None
    tolerance = float(row.extra.get("limit_tolerance", row.tolerance))
    end = int(np.searchsorted(times, (row.compared_until or 0.0) * (1 + 1e-12), side="right")) - 1
    return _MotionTolerance(row, quantity, tolerance, end)


def _motion_entries(
    name: str, model: Model, state: State, times: Array, parameters: Sequence[Parameter], rows: Sequence[Row]
) -> list[CoverageEntry]:
    """The entries of trajectory and invariants level, by the tolerances of judged rows."""
    tolerances = [one for row in rows if (one := _motion_tolerance(row, times)) is not None]
    if not tolerances:
        return []
    # the work of loads is a quadrature over the samples: fewer would add its error to the effects
    has_power = bool(np.any(model.moment)) or model.has_drag or model.has_elements
    is_work_judged = has_power and any(one.quantity == "energy_drift" for one in tolerances)
    stride = 1 if is_work_judged else max(1, (len(times) - 1) // MOTION_SAMPLES)
    tolerances = [replace(one, last_sample=one.last_sample // stride) for one in tolerances]
    times = times[::stride][: max(one.last_sample for one in tolerances) + 1]
    quantities = {one.quantity for one in tolerances}
    motions = resolved_motions(model, state, times, parameters)

    def measured(chosen: Sequence[int], size: float, is_fine: bool = False) -> dict[str, Array]:
        return _motion_effects(motions[is_fine], [parameters[i] for i in chosen], quantities, size)

    def is_weak(ratios: Mapping[Level, Mapping[str, _Ratios]], i: int) -> bool:
        is_conserved = parameters[i].kind in STATE_KINDS  # the invariants are, from every initial state
        levels = [engines for level, engines in ratios.items() if level != "invariants" or not is_conserved]
        return any(one.ratio[i] <= 1 / WEAK_MISTAKE for engines in levels for one in engines.values())

    effects = measured(range(len(parameters)), MOTION_MISTAKE)
    ratios = _motion_ratios(tolerances, effects)
    # what integrators make of invariants is as sharp as small mistakes: there the steps are always checked
    checked = [
        i
        for i, one in enumerate(parameters)
        if ("invariants" in ratios and one.kind not in STATE_KINDS) or is_weak(ratios, i)
    ]
    finer = _by_index(checked, [measured(checked, LARGER_MISTAKE * MOTION_MISTAKE, is_fine=True)])
    ratios = _motion_ratios(tolerances, effects, finer)
    weak = [i for i in checked if is_weak(ratios, i)]
    for i, same in _by_index(weak, [measured(weak, MOTION_MISTAKE, is_fine=True)]).items():
        finer[i] += same
    ratios = _motion_ratios(tolerances, effects, finer)
    found = []
    visited = _visited_states(motions[0], PROOF_SAMPLES)
    for level, by_engine in ratios.items():
        proofs = _proofs(model, visited, parameters, by_engine, level)
        own = [one for one in tolerances if one.row.level == level]
        _measure_further(own, by_engine, proofs, measured)
        if level == "invariants":
            ratio = np.min([one.ratio for one in by_engine.values()], axis=0)
            unseen = [int(i) for i in np.flatnonzero(ratio <= 1 / MAX_MISTAKE) if i not in proofs]
            proofs |= _conserved(motions[0], parameters, unseen, tolerances)
        found += _entries(name, level, model, parameters, by_engine, proofs)
    return found


def _measure_further(
    tolerances: Sequence[_MotionTolerance], by_engine: Mapping[str, _Ratios], proven: Container[int],
    measured: Callable[..., dict[str, Array]],
) -> None:  # fmt: skip
    """Put in place the ratios of parameters that pass no tolerance at the mistakes that were measured.

    An effect that small may be rounding, or of another order than it seems, and is not extrapolated: a figure
    counts where a mistake that is measured passes the tolerance.

    Args:
        by_engine: the ratios of that level, changed in place.
        proven: indices of parameters that are left as they are.
        measured: from indices, a mistake and whether the steps are the finer ones to the effects
            (`_motion_effects`).

    """
    largest = LARGER_MISTAKE * MOTION_MISTAKE
    for size in FURTHER_MISTAKES:
        ratio = np.min([one.ratio for one in by_engine.values()], axis=0)
        left = [int(i) for i in np.flatnonzero(ratio < 1 / largest) if i not in proven]
        if not left:
            return
        largest = LARGER_MISTAKE * size
        finer = _by_index(range(len(left)), [measured(left, one, is_fine=True) for one in (largest, size)])
        (again,) = _motion_ratios(tolerances, measured(left, size), finer, size).values()
        for engine, one in again.items():
            for i, value, row in zip(left, one.ratio, one.row, strict=True):
                by_engine[engine].ratio[i], by_engine[engine].row[i] = value, row


def _by_index(
    indices: Iterable[int], several: Sequence[Mapping[str, Array]]
) -> dict[int, list[dict[str, Array]]]:
    """Effects (P, T) at several mistakes as those of each parameter."""
    return {i: [{q: x[k] for q, x in one.items()} for one in several] for k, i in enumerate(indices)}


def _conserved(
    motion: AccurateMotion, parameters: Sequence[Parameter], unseen: Sequence[int],
    tolerances: Sequence[_MotionTolerance],
) -> dict[int, str]:  # fmt: skip
    """The parameters with which the invariants stay constant in accurate motions, of mistakes of a tenth.

    Where such a mistake makes a motion of far more steps (wrong axes of a light cart: vibrations of
    microseconds), of a hundredth.
    """
    if not unseen:
        return {}
    least: dict[str, float] = {}
    for one in tolerances:
        if one.quantity in INVARIANT_UNITS:
            least[one.quantity] = min(one.tolerance, least.get(one.quantity, np.inf))
    model, state = motion.model, motion.state
    (run,) = accurate_runs([(model, state)], motion.times)
    true, found = compute_invariants(model, run), {}
    for i in unseen:
        for mistake in (MAX_MISTAKE, MAX_MISTAKE / 10):
            cases = [perturb(model, state, parameters[i], size) for size in (mistake, -mistake)]
            try:
                runs = accurate_runs(cases, motion.times, MAX_SLOWDOWN * run.steps)
            except ArithmeticError:
                continue
            invariants = [compute_invariants(model, one) for one in runs]
            if all(
                np.max(_invariant_change(name, one, true)) <= tolerance
                for name, tolerance in least.items()
                for one in invariants
            ):
                found[i] = f"every invariant is conserved with it too, at mistakes of up to {mistake:g}"
            break
    return found


def _visited_states(motion: AccurateMotion, count: int) -> list[State]:
    """So many states along the motion."""
    model, samples = motion.model, motion.samples.swapaxes(-1, -2)
    along = np.linspace(0, len(samples) - 1, count).astype(int)
    cases = ((q[:, :3], q[:, 3:], rate[:, :3], rate[:, 3:]) for q, rate in samples[along])
    return [with_joint_coordinates(model, project_to_manifold(model, *case)) for case in cases]


def _motion_effects(
    motion: AccurateMotion, parameters: Sequence[Parameter], quantities: set[str], size: float
) -> dict[str, Array]:
    """Running maxima (P, T) of what mistakes of a size do to a motion, by quantity."""
    effects: dict[str, list[Array]] = {quantity: [] for quantity in quantities}
    true: Trajectory | None = None
    for one in perturbed_motions(motion, parameters, size):
        if one.true is not true:
            true = one.true
            invariants = compute_invariants(motion.model, true) if quantities & set(INVARIANT_UNITS) else None
        found = motion_errors(one.run, true)
        if invariants is not None:
            own = compute_invariants(motion.model, one.run)
            for quantity in quantities & set(INVARIANT_UNITS):
                found[quantity] = _invariant_change(quantity, own, invariants)
        for quantity in quantities:
            effects[quantity].append(np.maximum.accumulate(found[quantity]))
    return {quantity: np.array(found) for quantity, found in effects.items()}


def _invariant_change(quantity: str, one: Invariants, other: Invariants) -> Array:
    """The largest difference over all bodies (T,)."""
    difference = getattr(one, quantity) - getattr(other, quantity)
    return np.asarray(np.max(np.linalg.norm(difference, axis=-1), axis=1))


def _motion_ratios(
    tolerances: Sequence[_MotionTolerance], effects: Mapping[str, Array],
    finer: Mapping[int, Sequence[Mapping[str, Array]]] | None = None, size: float = MOTION_MISTAKE,
) -> dict[Level, dict[str, _Ratios]]:  # fmt: skip
    """Effects of mistakes of a size over tolerances by level and engine; of some by the order of the effect.

    Those are given at finer steps too: of a larger mistake, and then perhaps of the same one. An effect that
    falls with the step is the integrator's error, which a run's study extrapolates away.
    """
    finer = finer or {}
    ratios: dict[Level, dict[str, _Ratios]] = {}
    for one in tolerances:
        count = len(effects[one.quantity])
        of_engine = ratios.setdefault(one.row.level, {}).setdefault(one.row.engine, _Ratios(count))
        label = f"{one.row.integrator} {one.row.quantity}"
        for i in range(count):
            effect = float(effects[one.quantity][i, one.last_sample])
            again = [float(x[one.quantity][one.last_sample]) for x in finer.get(i, ())]
            of_engine.add(i, _relative_effect(effect, again, one.tolerance, size), label)
    return ratios


def _relative_effect(effect: float, finer: Sequence[float], tolerance: float, size: float) -> float:
    """The effect of a mistake of 1 over the tolerance, from those that `_motion_ratios` is given."""
    if not finer:
        return effect / tolerance / size
    larger, *same = finer
    growth = larger / max(*same, TINY) if same else larger / max(effect, TINY)
    falls = effect > LEAST_FALL * same[0] if same else LARGER_MISTAKE * effect > LEAST_FALL * larger
    if falls or growth < LARGER_MISTAKE / 2 or (growth > 2 * LARGER_MISTAKE and not same):
        return 0.0  # rounding, or the integrator's error, or not known without the same mistake
    if growth > 2 * LARGER_MISTAKE:  # with the square of the mistake
        return float(np.sqrt(larger / tolerance)) / (LARGER_MISTAKE * size)
    return larger / tolerance / (LARGER_MISTAKE * size)


# -- proofs ------------------------------------------------------------------------------------------


def _proofs(
    model: Model, states: Sequence[State], parameters: Sequence[Parameter], by_engine: Mapping[str, _Ratios],
    level: Level,
) -> dict[int, str]:  # fmt: skip
    """Why parameters that are not seen cannot be seen, by index; those without a reason are left out."""
    found = {}
    if level == "invariants":
        found = {
            i: "the invariants are conserved from every initial state"
            for i, one in enumerate(parameters)
            if one.kind in STATE_KINDS
        }
    ratio = np.min([ratios.ratio for ratios in by_engine.values()], axis=0)
    of_state = np.array([one.kind in STATE_KINDS for one in parameters])
    if level == "state":
        found = _vanishing(model, states[:1], parameters, of_state & (ratio <= 1 / MAX_MISTAKE), level)
    blunt = ratio <= 1 / (MAX_MISTAKE if level == "state" else DOUBTFUL_MISTAKE)
    return found | _vanishing(model, states, parameters, blunt & ~of_state, level)


def _vanishing(
    model: Model, states: Sequence[State], parameters: Sequence[Parameter], doubtful: NDArray[np.bool_],
    level: Level,
) -> dict[int, str]:  # fmt: skip
    """The doubtful parameters with which nothing changes, of mistakes of both signs up to a tenth.

    At state level no compared quantity changes by its bound, along a motion no acceleration by `NO_EFFECT`.
    Changes at smaller mistakes count in proportion.
    """
    what = "quantity" if level == "state" else "acceleration"
    left = [int(i) for i in np.flatnonzero(doubtful)]
    for mistake in (MAX_MISTAKE, -MAX_MISTAKE, MAX_MISTAKE / 3, -MAX_MISTAKE / 3):
        if not left:
            break
        some = [parameters[i] for i in left]
        effects = difference_effects(model, states, some, mistake)
        found = _effects_in_sizes(model, states, effects, level)
        largest = np.max([effect for one in found for effect in one.values()], axis=0)
        scale = np.array([one.scale for one in some])
        left = [i for i, ratio in zip(left, largest * scale * MAX_MISTAKE, strict=True) if ratio <= 1]

    def place(one: Parameter) -> str:
        at_start = one.kind in STATE_KINDS
        return "at the initial state" if at_start else _PLACES.get(level, "along the whole motion")

    return {
        i: f"no {what} {place(parameters[i])} changes with it, at mistakes of up to {MAX_MISTAKE:g}"
        for i in left
    }


def _effects_in_sizes(
    model: Model, states: Sequence[State], effects: Sequence[Mapping[str, Array]], level: Level
) -> list[dict[str, Array]]:
    """Of each state by quantity the largest effect (P,) on any body, over what a change must pass to count.

    At state level that is the bound, at others a fraction of the accelerations.
    """
    names, found = ["acceleration", "angular_acceleration"], []
    for state, effect in zip(states, effects, strict=True):
        bounds = remembered_rounding_bound(model, state)
        if level == "state":
            sizes = {name: np.maximum(bounds.tolerance(name), TINY) for name in STATE_UNITS}
        else:
            sizes = {n: MAX_MISTAKE * NO_EFFECT * np.max(np.asarray(bounds.scale[n])) for n in names}
        with np.errstate(over="ignore"):  # a bound of zero, as that of the energy at rest
            found.append({n: np.max(effect[n] / size, axis=1) for n, size in sizes.items() if n in effect})
    return found
