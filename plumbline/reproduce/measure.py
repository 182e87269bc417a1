"""Measure by how much an engine disagrees on a case: at a state, in a relation, in a refinement study.

Called in a worker. An engine of another version is called in that version's environment; truths and bounds
are always those of this checkout.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from plumbline.engines import engine_calls
from plumbline.engines.engine_calls import RefinementRun
from plumbline.engines.registry import load_adapter
from plumbline.judging.invariant_drift import invariant_rows
from plumbline.judging.refinement_analysis import RefinementAnalysis
from plumbline.judging.rows import Row, RowContext, Verdict
from plumbline.judging.trajectory_level import FINEST_RUN_SHOWN, LIMIT_QUANTITIES, trajectory_rows
from plumbline.measurements.relation_result import OTHER_FORMULATION_PREFIX
from plumbline.measurements.state_relations import (
    STATE_RELATIONS,
    WELDED_HALVES,
    Relation,
    quantity_values,
    unchanged,
)
from plumbline.model.datatypes import Array, Integrator, StateQuantities
from plumbline.model.invariants import MOTION_UNITS, motion_samples
from plumbline.model.step_methods import JointSpaceMethod, describe_method
from plumbline.model.welding import split_bodies
from plumbline.reproduce.engine_client import EngineClient
from plumbline.reproduce.shrink import ReproductionCase, smallest_case
from plumbline.truth import TruthUnavailable
from plumbline.truth.certified_state import certify_state
from plumbline.truth.ground_truth import MotionTruth, motion_truth
from plumbline.truth.rounding_bound import state_rounding_bound
from plumbline.truth.step_comparison import FormulaSteps

LIMITS = (*LIMIT_QUANTITIES, *FINEST_RUN_SHOWN)
WORK_SAMPLES = 64  # of a run where the work of moments and drag is integrated
TINY = 1e-300


@dataclass(frozen=True, eq=False)
class StateEvidence:
    """A state at which the engine's answers differ from the expected ones."""

    case: ReproductionCase
    ratio: float  # largest error over its bound
    truth: dict[str, Array]  # expected value of each quantity
    bound: dict[str, Array]  # (N,) or a number: of the norm of the error, per body; of each entry of a matrix
    certified: bool  # whether the truth is certified; else the notes' equations in double precision


@dataclass(frozen=True, eq=False)
class RelationEvidence:
    """A state for which the engine's two answers differ."""

    case: ReproductionCase
    ratio: float  # largest difference over its bound
    name: str  # of the relation
    variant: str  # how the engine computes the second answer ("by …", "two welded halves"); empty as usual
    other: ReproductionCase  # the second description of the state
    other_engine: str  # the engine that evaluates it
    back: dict[str, Array]  # (3, 3) or a number per quantity: takes the second answer back to the first
    bound: dict[str, Array]  # of both answers


@dataclass(frozen=True, eq=False)
class MotionEvidence:
    """A refinement study whose order, limit or drift is off."""

    case: ReproductionCase
    ratio: float
    times: Array  # (T,) s
    integrator: Integrator
    ordered: bool  # whether the observed order is in dispute
    drifts: tuple[str, ...]  # invariants that are in dispute
    sizes: tuple[float, float]  # m and m/s: scales of r and v where orders are observed
    expected: dict[str, Array]  # at the end, of each quantity whose limit is in dispute
    uncertain: dict[str, float]  # what each of them may be off by, per body; attitudes as quaternions
    eliminated: dict[str, int]  # how many powers of the step Romberg's scheme eliminates, per quantity


@dataclass(frozen=True, eq=False)
class StepEvidence:
    """A few steps that are not those of the declared formula."""

    case: ReproductionCase
    ratio: float
    times: Array  # (2,) s, start and end
    count: int  # of steps
    integrator: Integrator
    formula: str  # in words
    expected: dict[str, Array]  # at the end
    bound: dict[str, Array]  # (N,)


Evidence = StateEvidence | RelationEvidence | MotionEvidence | StepEvidence


@dataclass(frozen=True)
class Disagreement:
    """The rows of one cell that disagree, as far as they can be measured again."""

    engine: EngineClient
    level: str
    quantities: tuple[str, ...]
    integrator: str  # "-" at a state
    case: ReproductionCase
    ratio: float  # the largest ratio of the rows
    seconds: float  # for shrinking [s]

    def measure(self, case: ReproductionCase) -> Evidence | None:
        """Measure by how much a case shows this disagreement.

        Returns:
            The evidence, or None where the engine or the truth refuses the case.

        """
        return self._measure(case)

    @cached_property
    def _measure(self) -> Callable[[ReproductionCase], Evidence | None]:
        if self.level == "state":
            return StateMeasure(self.engine, self.quantities)
        if self.level == "relations":
            return RelationMeasure(self.engine, self.quantities[0])
        if self.level == "step":
            return StepMeasure(self.engine, self.integrator)
        return ConvergenceMeasure(self.engine, self.integrator, self.level, self.quantities)

    def shrink(self) -> Evidence | None:
        """Find the smallest case that shows this disagreement.

        Returns:
            Its evidence, or None where the engine, called again, agrees.

        Raises:
            OutOfTime: no case was found in time.

        """
        ratio = self.ratio
        if not self.case.steps:
            evidence = self.measure(self.case)
            ratio = evidence.ratio if evidence else 0.0
        # the CPU time of another environment's process is not counted in this process
        clock = time.monotonic if self.engine.python else time.process_time
        cases = [self.case]
        if self.level == "step":  # one step shows most
            cases.insert(0, replace(self.case, until=self.case.steps[0]))
        for case in cases:
            found = smallest_case(case, self._measure, ratio, self.seconds, clock)
            if found is not None:
                break
        return cast("Evidence | None", found)


def _error_size(error: Array, quantity: str) -> Array:
    """Size of an error as the verdicts measure it: per body, of a vector, of a number, of each entry."""
    if quantity == "mass_matrix" or error.ndim == 0:
        return np.asarray(np.max(np.abs(error)))
    return np.asarray(np.linalg.norm(error, axis=-1))


def _largest_ratio(found: dict[str, Array], right: dict[str, Array], bound: dict[str, Array]) -> float:
    """Largest error over its bound, of the quantities that have a bound."""
    off = [np.max(_error_size(found[q] - right[q], q) / np.maximum(bound[q], TINY)) for q in bound]
    return float(max(off, default=0.0))


@dataclass(frozen=True)
class StateMeasure:
    """Error of an engine's answers at a state, over the bounds of rounding."""

    engine: EngineClient
    quantities: tuple[str, ...]

    def __call__(self, case: ReproductionCase) -> StateEvidence | None:
        """Measure a case; None where the engine, the truth or the bound refuses it."""
        model, state, certified = case.model, case.state, True
        try:
            answers = self.engine.evaluate(model, state)
            allowed = state_rounding_bound(model, state)
            try:
                truth = certify_state(model, state, mass_matrix="mass_matrix" in self.quantities).quantities
            except TruthUnavailable:
                (truth,), certified = load_adapter("reference").evaluate(model, [state]), False
        except Exception:
            return None
        offered = [q for q in self.quantities if getattr(answers, q) is not None]
        found, right = ({q: np.asarray(getattr(x, q), float) for q in offered} for x in (answers, truth))
        bound = {q: np.asarray(allowed.tolerance(q), float) for q in offered}
        return StateEvidence(case, _largest_ratio(found, right, bound), right, bound, certified)


@dataclass(frozen=True)
class RelationMeasure:
    """Difference of an engine's two answers for one state, over the bounds of rounding of both."""

    engine: EngineClient
    name: str  # of the relation
    back: dict[str, Array] = field(default_factory=dict)  # see `inverse_transforms`: the same for every case

    def __call__(self, case: ReproductionCase) -> RelationEvidence | None:
        """Measure a case; None where the two answers cannot be compared."""
        model, state, engine = case.model, case.state, self.engine
        relation = next((r for r in STATE_RELATIONS if r.name == self.name), None)
        variant = "" if relation or self.name.startswith(OTHER_FORMULATION_PREFIX) else self.name
        relation = relation or Relation(self.name, unchanged, quantity_values)
        if self.name.startswith(OTHER_FORMULATION_PREFIX):
            engine = replace(engine, name=self.name.removeprefix(OTHER_FORMULATION_PREFIX))
        if model.has_drag and self.name == "time reversed":
            return None
        try:
            other = ReproductionCase(*relation.transform(model, state))
            first = quantity_values(self.engine.evaluate(model, state))
            answers = engine.evaluate(other.model, other.state, variant)
            bounds = [state_rounding_bound(model, state)] * 2
            if variant == WELDED_HALVES:
                bounds[1] = state_rounding_bound(model, state, split_bodies(model))
        except Exception:
            return None
        second = relation.transform_back(answers)
        if not self.back:
            self.back.update(inverse_transforms(relation, answers))
        both = [q for q in first if q in second]
        bound = {q: np.sum([np.asarray(b.tolerance(q), float) for b in bounds], axis=0) for q in both}
        back = {q: self.back[q] for q in both}
        ratio = _largest_ratio(first, second, bound)
        return RelationEvidence(case, ratio, self.name, variant, other, engine.name, back, bound)


def inverse_transforms(relation: Relation, answers: StateQuantities) -> dict[str, Array]:
    """Find how a relation takes each quantity back, by applying it to unit vectors.

    Args:
        relation: how the second description of a state is made and its answers are taken back.
        answers: the engine's answers for the second description of a state.

    Returns:
        Per quantity a factor, or a matrix (3, 3) that acts on the last axis.

    Raises:
        NotImplementedError: the relation does something else, which a script could not express in numbers.

    """
    found: dict[str, Array] = {}
    for q, value in relation.transform_back(answers).items():
        given = np.asarray(getattr(answers, q), float)

        def back(y: Any, q: str = q) -> Array:
            return np.asarray(relation.transform_back(replace(answers, **{q: y}))[q], float)

        if given.ndim == 0:
            way = back(1.0)
        else:
            units = [back(np.broadcast_to(e, given.shape)).reshape(-1, 3)[0] for e in np.eye(3)]
            way = np.stack(units, axis=1)
            way = way[0, 0] if np.all(way == way[0, 0] * np.eye(3)) else way
        again = given @ way.T if np.ndim(way) else way * given
        limit = 1e-9 * np.max(np.abs(value))
        if np.shape(again) != np.shape(value) or not np.allclose(again, value, rtol=0, atol=limit):
            raise NotImplementedError(f"relation {relation.name!r} does not act on each body by a matrix")
        found[q] = way
    return found


@dataclass(frozen=True)
class StepMeasure:
    """Difference of an engine's steps from the declared formula, over the bounds of rounding."""

    engine: EngineClient
    method: str  # name of the integrator

    def __call__(self, case: ReproductionCase) -> StepEvidence | None:
        """Measure a case; None where the engine refuses it or the formula goes through a singularity."""
        (h,), model, state = case.steps, case.model, case.state
        count = round(case.until / h)
        if abs(case.until / h - count) > 1e-9:
            return None
        try:
            integrator = self.engine.integrator(self.method)
            answer = self.engine.call(engine_calls.run_steps, self.method, model, [state], [[h]], [count])
            method, run = integrator.method, answer.attempts[0].run
            if not isinstance(method, JointSpaceMethod) or run is None:
                return None
            steps = FormulaSteps(method, model, [state], [(0, h, run.angle_axes)], [count])
            ((_, _, limits, _),) = steps.limits()
            ratio = max(max(c.ratios) for c in steps.compare([run]).values())
        except Exception:
            return None
        true = steps.true[0][count]
        names = {"step_position": "r", "step_attitude": "p", "step_velocity": "v", "step_rate": "omega"}
        return StepEvidence(
            case, ratio, np.array([0.0, case.until]), count, integrator, describe_method(method),
            {quantity: np.asarray(getattr(true, name), float) for quantity, name in names.items()},
            # attitudes are compared as quaternions
            {quantity: limits[quantity] / (2 if name == "p" else 1) for quantity, name in names.items()},
        )  # fmt: skip


@dataclass
class ConvergenceMeasure:
    """Order, limit and drifts of a refinement study, judged by the rules of a run."""

    engine: EngineClient
    method: str
    level: str  # "trajectory" or "invariants"
    quantities: tuple[str, ...]
    cache: dict[tuple[object, ...], tuple[MotionTruth, dict[float, RefinementRun]]] = field(
        default_factory=dict
    )  # of the last motion: cases that differ in their steps share its runs

    @cached_property
    def integrator(self) -> Integrator:
        """The integrator as the engine's adapter declares it."""
        return self.engine.integrator(self.method)

    def sample_times(self, case: ReproductionCase) -> Array | None:
        """Choose sample times: start and end, more where the work of moments or drag is integrated.

        Args:
            case: the refinement study.

        Returns:
            Times (T,) [s], or None where the steps are too coarse for the work.

        """
        model, count = case.model, 1
        if self.level == "invariants" and (model.has_drag or np.any(model.moment)):
            count = min(WORK_SAMPLES, round(case.until / case.steps[0]))
            if count < 16:
                return None
        return np.linspace(0.0, case.until, count + 1)

    def run(self, case: ReproductionCase, times: Array) -> tuple[MotionTruth, list[RefinementRun]]:
        """Run the refinement study, and compute its truth.

        Args:
            case: the refinement study.
            times: sample times (T,) [s].

        Returns:
            The truth, and the engine's runs from coarse to fine.

        """
        motion = (*replace(case, steps=()).content, len(times))
        if motion not in self.cache:
            self.cache.clear()
            self.cache[motion] = motion_truth(case.model, case.state, times, None), {}
        truth, runs = self.cache[motion]
        missing = [h for h in case.steps if h not in runs]
        if missing:
            study = self.engine.call(
                engine_calls.run_refinement, self.method, case.model, case.state, times, missing
            )
            runs.update({run.resolution: run for run in study.runs})
        return truth, [runs[h] for h in case.steps]

    def __call__(self, case: ReproductionCase) -> MotionEvidence | None:
        """Measure a case; None where the engine or the truth refuses it."""
        times = self.sample_times(case)
        if times is None:
            return None
        try:
            truth, runs = self.run(case, times)
        except Exception:
            return None
        if any(run.trajectory is None for run in runs):
            return None
        context = RowContext("", "", self.engine.name, self.engine.name, "")
        analysis = RefinementAnalysis(context, case.model, truth, self.integrator, runs, case.until)
        of_invariants = self.level == "invariants"
        found = invariant_rows(analysis) if of_invariants else trajectory_rows(analysis)
        rows, wanted = {row.quantity: row for row in found}, set(self.quantities)
        groups = [wanted] if of_invariants else [g for g in ({"order"}, set(LIMITS)) if g & wanted]
        ratios = [max((_excess(rows[q]) for q in group if q in rows), default=0.0) for group in groups]
        series, limits = self._disputed_series(analysis, rows)
        expected = {q: samples[-1] for q, samples in motion_samples(truth.trajectory).items()}
        uncertain = {
            q: float(row.tolerance or 0.0) / (2 if q == "attitude" else 1) for q, row in limits.items()
        }
        return MotionEvidence(
            case,
            min(ratios, default=0.0),
            times,
            self.integrator,
            ordered="order" in wanted and "order" in rows,
            drifts=tuple(series) if of_invariants else (),
            sizes=(truth.length, analysis.invariant_scales["gap_rate"]),
            expected={q: expected[q] if q in expected else _zeros(case, q) for q in series},
            uncertain=uncertain,
            eliminated={q: analysis.extrapolated_limit(ys).eliminated_powers for q, ys in series.items()},
        )

    def _disputed_series(
        self, analysis: RefinementAnalysis, rows: dict[str, Row]
    ) -> tuple[dict[str, Sequence[Array]], dict[str, Row]]:
        """Samples of each quantity whose limit is in dispute, and the row that judges the limit."""
        if self.level == "invariants":
            judged = [q for q in self.quantities if q in rows]
            off = [q for q in judged if rows[q].verdict == Verdict.DISAGREES] or judged
            drifts: dict[str, Sequence[Array]] = {
                q: [getattr(d, q) for d in analysis.invariant_drifts] for q in off
            }
            return drifts, {q: rows[q] for q in off}
        if not set(LIMITS) & set(self.quantities):
            return {}, {}
        limits = {q: rows[f"{q}_limit"] for q in MOTION_UNITS if rows.get(f"{q}_limit")}
        limits = {q: row for q, row in limits.items() if row.tolerance}
        return {q: analysis.samples[q] for q in limits}, limits


def _zeros(case: ReproductionCase, invariant: str) -> Array:
    """Expected drift of an invariant: one number, or one row for each body."""
    width = {"joint_gap": 3, "gap_rate": 3, "norm_drift": 1}.get(invariant)
    return np.zeros((case.model.n, width) if width else ())


def _excess(row: Row) -> float:
    """Error over tolerance of a row that disagrees, else 0."""
    return float(row.ratio or 0.0) if row.verdict == Verdict.DISAGREES else 0.0
