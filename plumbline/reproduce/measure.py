"""Measure by how much an engine disagrees on a case: at a state, in a relation, in a refinement study.

Called in a worker. An engine of another version is called in that version's environment; truths and bounds
are always those of this checkout.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from plumbline.engines import engine_calls
from plumbline.engines.engine_calls import RefinementRun
from plumbline.engines.registry import load_adapter
from plumbline.judging.invariant_drift import invariant_rows
from plumbline.judging.refinement_analysis import RefinementAnalysis
from plumbline.judging.rows import Row, RowContext, Verdict
from plumbline.judging.state_level import VARIANT_QUANTITIES
from plumbline.judging.trajectory_level import FINEST_RUN_SHOWN, trajectory_rows
from plumbline.measurements.relation_result import OTHER_FORMULATIONS
from plumbline.measurements.state_relations import (
    QUANTITIES,
    STATE_RELATIONS,
    TIME_REVERSED,
    WELDED_HALVES,
    scale_fields,
)
from plumbline.model.datatypes import Array, Float, Integrator
from plumbline.model.invariants import LIMITS, motion_samples
from plumbline.model.step_methods import JointSpaceMethod, describe_method
from plumbline.model.welding import split_bodies
from plumbline.reproduce.engine_client import EngineClient
from plumbline.reproduce.shrink import ReproductionCase, smallest_case
from plumbline.reproduce.surface_source import surface_source, surface_value
from plumbline.truth import TruthUnavailable
from plumbline.truth.certified_state import certify_state
from plumbline.truth.ground_truth import MotionTruth, motion_truth, state_truth
from plumbline.truth.rounding_bound import state_rounding_bound
from plumbline.truth.step_comparison import FormulaSteps

TRUTH_QUANTITIES = (*LIMITS, *FINEST_RUN_SHOWN)
TRANSFORMS = {relation.name: relation.transform for relation in STATE_RELATIONS}
WORK_SAMPLES = 64  # of a run where the work of moments and drag is integrated
TINY = 1e-300


@dataclass(frozen=True, eq=False)
class Evidence:
    """A case in which an engine is wrong, and what is right there: the search and the script share it."""

    case: ReproductionCase
    ratio: float  # largest error over its bound
    engine: str  # that is wrong, without a version
    expected: dict[str, Array]  # value of each quantity, at a state or at the end of a run
    # (N,) or a number: of the norm of the error, per body (of attitudes as quaternions), or of each entry
    bound: dict[str, Array]
    variant: str = field(default="", kw_only=True)  # how the engine computes: "by …", "two welded halves"

    def written(self, engine: EngineClient) -> dict[str, Any]:
        """Write what the engine holds of the case, for the script.

        Args:
            engine: the one whose rows disagree; this evidence may be about its other formulation.

        Raises:
            Unsupported: the adapter cannot write it; the message is the reason.

        """
        moves, case = bool(self.case.steps), self.case
        return replace(engine, name=self.engine).write(case.model, case.state, self.variant, moves)


@dataclass(frozen=True, eq=False)
class StateEvidence(Evidence):
    """A state at which the engine's answers differ from the expected ones."""

    certified: bool  # whether the truth is certified; else the notes' equations in double precision
    relation: str = ""  # of this state, by which it was found


@dataclass(frozen=True, eq=False)
class SurfaceEvidence(Evidence):
    """A state at which one call of an engine is wrong about a quantity of the surface."""

    call: str = field(kw_only=True)  # its names, or those of a variant

    def written(self, engine: EngineClient) -> dict[str, Any]:
        """Write what the adapter does for the quantity."""
        (quantity,), case = self.expected, self.case
        return {"source": engine.call(surface_source, case.model, case.state, quantity, self.call)}


@dataclass(frozen=True, eq=False)
class StepEvidence(Evidence):
    """A few steps that are not those of the declared formula."""

    integrator: Integrator
    times: Float[Array, "2"]  # s, start and end
    count: int  # of steps
    formula: str  # in words


@dataclass(frozen=True, eq=False)
class MotionEvidence(Evidence):
    """A refinement study whose order, limit or drift is off."""

    integrator: Integrator
    times: Float[Array, "samples"]  # s
    ordered: bool  # whether the observed order is in dispute
    drifts: tuple[str, ...]  # invariants that are in dispute
    sizes: tuple[float, float]  # m and m/s: scales of r and v where orders are observed
    eliminated: dict[str, int]  # how many powers of the step Romberg's scheme eliminates, per quantity


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
    call: str = ""  # of a row of the surface, the names of what is wrong

    @cached_property
    def measure(self) -> Callable[[ReproductionCase], Evidence | None]:
        """Return what measures by how much a case shows this disagreement.

        It returns the evidence, or None where the engine or the truth refuses the case.
        """
        if self.level == "state":
            return StateMeasure(self.engine, self.quantities)
        if self.level == "surface":
            return SurfaceMeasure(self.engine, self.quantities[0], self.call)
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
        found = (smallest_case(case, self.measure, ratio, self.seconds, clock) for case in cases)
        return next((evidence for evidence in found if evidence is not None), None)


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
    quantities: tuple[str, ...] = QUANTITIES
    variant: str = ""

    def __call__(self, case: ReproductionCase) -> StateEvidence | None:
        """Measure a case; None where the engine, the truth or the bound refuses it."""
        model, state, certified = case.model, case.state, True
        try:
            answers = self.engine.evaluate(model, state, self.variant)
            parts = [split_bodies(model)] if self.variant == WELDED_HALVES else []
            allowed = state_rounding_bound(model, state, *parts)
            try:
                truth = certify_state(model, state, mass_matrix="mass_matrix" in self.quantities).quantities
            except TruthUnavailable:
                (truth,), certified = load_adapter("reference").evaluate(model, [state]), False
        except Exception:
            return None
        offered = [q for q in self.quantities if getattr(answers, q) is not None]
        found, right = ({q: np.asarray(getattr(x, q), float) for q in offered} for x in (answers, truth))
        uncertain = answers.limit_error or {}
        bound = {q: np.asarray(allowed.tolerance(q), float) + uncertain.get(q, 0.0) for q in offered}
        ratio = _largest_ratio(found, right, bound)
        return StateEvidence(case, ratio, self.engine.name, right, bound, certified, variant=self.variant)


@dataclass(frozen=True)
class SurfaceMeasure:
    """Error of what one call of an engine says of a quantity of the surface, over its bound."""

    engine: EngineClient
    quantity: str
    call: str  # its names, or those of a variant

    def __call__(self, case: ReproductionCase) -> SurfaceEvidence | None:
        """Measure a case; None where the engine, the truth or the bound refuses it."""
        model, state, name = case.model, case.state, self.quantity
        if usual := VARIANT_QUANTITIES.get(name):
            evidence = StateMeasure(self.engine, (usual,), self.call)(case)
            if evidence is None or not evidence.expected:
                return None
            right, bound, ratio = evidence.expected[usual], evidence.bound[usual], evidence.ratio
        else:
            try:
                value = self.engine.call(surface_value, model, state, name, self.call)
                truth = state_truth(model, [state]).surface[name]
                right, bound = truth.value[0], truth.tolerance[0]
                ratio = _largest_ratio({name: value}, {name: right}, {name: bound})
            except Exception:
                return None
        return SurfaceEvidence(case, ratio, self.engine.name, {name: right}, {name: bound}, call=self.call)


@dataclass(frozen=True)
class RelationMeasure:
    """Errors of the two answers that a relation compares.

    Where they differ by more than the bounds of both, one of them is off by more than its own.
    """

    engine: EngineClient
    name: str  # of the relation

    def __call__(self, case: ReproductionCase) -> StateEvidence | None:
        """Measure a case by the answer that is farther off; None where the two cannot be compared."""
        first, other = self.answers(case)
        if first is None or other is None:
            return None
        return replace(max(first, other, key=lambda found: found.ratio), relation=self.name)

    def answers(self, case: ReproductionCase) -> tuple[StateEvidence | None, StateEvidence | None]:
        """Measure the engine's usual answer, and the other one."""
        usual, transform = StateMeasure(self.engine), TRANSFORMS.get(self.name)
        if self.name == TIME_REVERSED.name:
            case = replace(case, model=scale_fields(case.model, drag_force=0.0, drag_moment=0.0))
        if name := OTHER_FORMULATIONS.get(self.name):
            other = replace(usual, engine=replace(self.engine, name=name))(case)
        elif transform is not None:
            other = usual(ReproductionCase(*transform(case.model, case.state)))
        else:
            other = replace(usual, variant=self.name)(case)
        return usual(case), other


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
            ratio = max(max(c.ratios.ravel()) for c in steps.compare([run]).values())
        except Exception:
            return None
        true = steps.true[count][0]
        names = {"step_position": "r", "step_attitude": "p", "step_velocity": "v", "step_rate": "omega"}
        return StepEvidence(
            case, ratio, self.engine.name,
            {quantity: np.asarray(getattr(true, name), float) for quantity, name in names.items()},
            {quantity: limits[quantity] / (2 if name == "p" else 1) for quantity, name in names.items()},
            integrator, np.array([0.0, case.until]), count, describe_method(method),
        )  # fmt: skip


@dataclass
class ConvergenceMeasure:
    """Order, limit and drifts of a refinement study, judged by the rules of a run."""

    engine: EngineClient
    method: str
    level: str  # "trajectory" or "invariants"
    quantities: tuple[str, ...]
    # of the last motion: cases that differ in their steps share its runs
    cache: dict[tuple[object, ...], tuple[MotionTruth, dict[float, RefinementRun]]] = field(
        default_factory=dict
    )

    @cached_property
    def integrator(self) -> Integrator:
        """The integrator as the engine's adapter declares it."""
        return self.engine.integrator(self.method)

    def sample_times(self, case: ReproductionCase) -> Float[Array, "samples"] | None:
        """Choose sample times: start and end, more where the work of moments or drag is integrated.

        Args:
            case: the refinement study.

        Returns:
            Times [s], or None where the steps are too coarse for the work.

        """
        model, count = case.model, 1
        if self.level == "invariants" and (
            model.is_dissipative or np.any(model.moment) or np.any(model.effort)
        ):
            count = min(WORK_SAMPLES, round(case.until / case.steps[0]))
            if count < 16:
                return None
        return np.linspace(0.0, case.until, count + 1)

    def run(
        self, case: ReproductionCase, times: Float[Array, "samples"]
    ) -> tuple[MotionTruth, list[RefinementRun]]:
        """Run the refinement study, and compute its truth.

        Args:
            case: the refinement study.
            times: sample times [s].

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
        groups = [wanted] if of_invariants else [g for g in ({"order"}, set(TRUTH_QUANTITIES)) if g & wanted]
        ratios = [max((_excess(rows[q]) for q in group if q in rows), default=0.0) for group in groups]
        series, limits = self._disputed_series(analysis, rows)
        expected = {q: samples[-1] for q, samples in motion_samples(truth.trajectory).items()}
        uncertain = {q: (row.tolerance or 0.0) / (2 if q == "attitude" else 1) for q, row in limits.items()}
        return MotionEvidence(
            case,
            min(ratios, default=0.0),
            self.engine.name,
            {q: expected[q] if q in expected else _zeros(case, q) for q in series},
            {q: np.asarray(x, float) for q, x in uncertain.items()},
            self.integrator,
            times,
            ordered="order" in wanted and "order" in rows,
            drifts=tuple(series) if of_invariants else (),
            sizes=(truth.length, analysis.invariant_scales["gap_rate"] or 1.0),
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
        if not set(TRUTH_QUANTITIES) & set(self.quantities):
            return {}, {}
        limits = {of: rows[q] for q, of in LIMITS.items() if rows.get(q)}
        limits = {q: row for q, row in limits.items() if row.tolerance}
        return {q: analysis.samples[q] for q in limits}, limits


def _zeros(case: ReproductionCase, invariant: str) -> Array:
    """Expected drift of an invariant: one number, or one row for each joint or body."""
    joints, bodies = len(case.model.kind), case.model.n
    shapes = {"joint_gap": (joints, 3), "gap_rate": (joints, 3), "norm_drift": (bodies, 1)}
    return np.zeros(shapes.get(invariant, ()))


def _excess(row: Row) -> float:
    """Error over tolerance of a row that disagrees, else 0."""
    return float(row.ratio or 0.0) if row.verdict == Verdict.DISAGREES else 0.0
